"""L4 - The test behind the maps: many temperatures as sources of several drift series, with one family-wise error.

Sources: Westfall and Young (1993), *Resampling-based multiple testing* (smallest p over channels against its own null); Benjamini and
Hochberg (1995), J. R. Stat. Soc. B 57, 289.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.attribution_kernel import (
    Array32,
    Estimate,
    NullBank,
    Whitened,
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    tiles,
    whiten_series,
)
from fusion.channels import Array, DriftSeries, lag_operators
from fusion.excitation import Excitation, warm_up_columns

#: Time constants of the first-order lags, s.
LAGS_S = (0.0, 600.0, 1200.0, 2400.0, 3600.0, 5400.0)
#: Family-wise level of the verdicts.
LEVEL = 0.05
#: Standard normal quantile of 0.8: an effect is found with 80 % power this many uncertainties above the threshold.
_POWER_80 = 0.8416
#: Bins of the pooled null distribution of one cell's statistic.
_BINS = np.concatenate([np.arange(0.0, 40.0, 0.1), [np.inf]])

#: Mean length of the runs of whitened residuals that stay together when they are put into other orders. Switched loads leave traces of
#: several cycles in the residuals; single values in free order gave twice the promised false alarms there.
_BLOCK = 10


@dataclass(frozen=True)
class Film:
    """Temperatures to test: columns over time.

    Attributes
    ----------
    seconds : (frames,) s since the first frame
    values : (frames, columns) temperature minus its mean over time, K
    """

    seconds: Array
    values: Array


@dataclass(frozen=True)
class Tested:
    """What the test of one film found; columns are cells, regions or modes.

    Attributes
    ----------
    names : (channels,) with "joint" (common and proportional together) last where both exist
    statistic, lag_index : (channels, columns) likelihood ratio and the lag that it was reached at
    p_value, q_value : (channels, columns) family-wise over everything tested, and false-discovery rate within the channel
    coefficient, coefficient_u, detectable : (channels, columns) um per K
    threshold : (channels,) of the statistic at the family-wise level
    null_maxima : (draws, channels) maximum statistic of every redrawn null
    false_alarm_rate : share of fresh nulls in which anything passed the threshold
    """

    names: tuple[str, ...]
    statistic: Array
    lag_index: NDArray[np.int64]
    p_value: Array
    q_value: Array
    coefficient: Array
    coefficient_u: Array
    detectable: Array
    threshold: Array
    null_maxima: Array
    false_alarm_rate: float
    banks: tuple[NullBank, ...]


@threadpool_limits.wrap(limits=1, user_api="blas")
def evaluate_film(
    series: Sequence[DriftSeries],
    film: Film,
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    checks: int = 199,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Tested:
    """Test all columns of a film as sources of all series, with one family-wise error over columns, lags and series.

    The first two series, where they are "common" and "proportional", are also tested together at the same lag. The first `draws`
    nulls (the series' own whitened residuals in other orders) set the threshold, `checks` fresh ones (Gaussian) measure what passes it.
    """
    operators = lag_operators(film.seconds, lags_s)
    banks = tuple(
        null_bank(one.values, one.seconds, one.variance, nuisance_columns(one.seconds, excitation)) for one in series
    )
    sources = [
        _Source(bank, whiten_series(bank, stack), _seen_through(one, operators))
        for one, bank, stack in zip(series, banks, _draw(series, banks, draws, checks, rng), strict=True)
    ]
    names = [one.name for one in series]
    if names[:2] == ["common", "proportional"]:
        names.append("joint")
    cells32 = film.values.astype(np.float32)
    columns, lags = film.values.shape[1], len(lags_s)
    tally = _Tally(len(names), columns, draws + checks)
    for tile in tiles(columns * lags, lags):
        cells = slice(tile.start // lags, tile.stop // lags)
        _test_tile(sources, cells32[:, cells], cells, lags, tally)
        if progress is not None:
            progress(tile.stop / (columns * lags))
    calibration, check = tally.maxima[:, :draws], tally.maxima[:, draws:]
    p_value, threshold = _family_wise(tally.statistic, calibration)
    return Tested(
        names=tuple(names),
        statistic=tally.statistic,
        lag_index=tally.lag_index,
        p_value=p_value,
        q_value=np.stack([_false_discovery(*pair) for pair in zip(tally.statistic, tally.pooled, strict=True)]),
        coefficient=tally.effects[0],
        coefficient_u=tally.effects[1],
        detectable=(np.sqrt(threshold)[:, None] + _POWER_80) * tally.effects[2],
        threshold=threshold,
        null_maxima=calibration.T,
        false_alarm_rate=float((check >= threshold[:, None]).any(axis=0).mean()) if checks else float("nan"),
        banks=banks,
    )


@dataclass(frozen=True)
class _Source:
    """One series ready to be tested: its nulls, all its draws whitened, and how it sees the film under every lag."""

    bank: NullBank
    whitened: Whitened
    response: Array32


class _Tally:
    """Running results over the tiles."""

    def __init__(self, channels: int, columns: int, nulls: int) -> None:
        self.statistic = np.zeros((channels, columns))
        self.lag_index = np.zeros((channels, columns), np.int64)
        self.maxima = np.zeros((channels, nulls))
        self.pooled = np.zeros((channels, _BINS.size - 1))
        # Coefficient, its uncertainty, and its uncertainty under the fitted null.
        self.effects = np.zeros((3, channels, columns))

    def add(self, channel: int, cells: slice, ratio: Array32, effects: Array) -> None:
        """Enter ratios (1 + nulls, cells, lags) and effects (3, cells, lags) of one channel."""
        best = ratio.max(axis=2)
        chosen = ratio[0].argmax(axis=1)
        self.statistic[channel, cells] = best[0]
        self.lag_index[channel, cells] = chosen
        self.effects[:, channel, cells] = np.take_along_axis(effects, chosen[None, :, None], axis=2)[:, :, 0]
        if best.shape[0] > 1:
            self.maxima[channel] = np.maximum(self.maxima[channel], best[1:].max(axis=1))
            bins = np.minimum((best[1:] / _BINS[1]).astype(np.int64), _BINS.size - 2)
            self.pooled[channel] += np.bincount(bins.ravel(), minlength=_BINS.size - 1)


def _seen_through(series: DriftSeries, operators: Sequence[Array]) -> Array32:
    """How a series sees the film under every lag, (lags, n, frames)."""
    return np.stack([series.sampling @ operator for operator in operators]).astype(np.float32)


def _test_tile(sources: Sequence[_Source], film32: Array32, cells: slice, lags: int, tally: _Tally) -> None:
    """Test a tile of cells against every series, and the first two together where the tally has room for that."""
    count = cells.stop - cells.start
    ratios, effects = [], []
    for source in sources:
        regressors = _respond_tile(source.response, film32)
        ratios.append(likelihood_ratios(source.bank, source.whitened, regressors).reshape(-1, count, lags))
        effects.append(_stack(estimate_effects(source.bank, regressors)).reshape(3, count, lags))
    if tally.statistic.shape[0] > len(sources):
        ratios.append(ratios[0] + ratios[1])
        # The joint effect is that at the far end of travel: common plus proportional at +1.
        effects.append(
            np.stack([effects[0][0] + effects[1][0], *[np.hypot(effects[0][row], effects[1][row]) for row in (1, 2)]])
        )
    for channel, (ratio, effect) in enumerate(zip(ratios, effects, strict=True)):
        tally.add(channel, cells, ratio, effect)


def _stack(estimate: Estimate) -> Array:
    return np.stack([estimate.coefficient, estimate.coefficient_u, estimate.null_u])


def nuisance_columns(seconds: Array, excitation: Excitation) -> Array:
    """Columns of every hypothesis: level and trend, and where a warm-up dominates also free exponentials."""
    centred = (seconds - seconds.mean()) / max(float(np.ptp(seconds)), 1e-9)
    columns = np.column_stack([np.ones_like(seconds), centred])
    if not excitation.protected:
        return columns
    return np.column_stack([columns, warm_up_columns(seconds)])


def _draw(
    series: Sequence[DriftSeries], banks: Sequence[NullBank], draws: int, checks: int, rng: np.random.Generator
) -> list[Array]:
    """The measured series, `draws` nulls with its residuals in other orders, and `checks` nulls with Gaussian ones, stacked."""
    longest = max(one.values.size for one in series)
    orders = np.stack([_shuffle_blocks(longest, rng) for _ in range(draws)]) if draws else np.empty((0, longest), int)
    stacks = []
    for one, bank in zip(series, banks, strict=True):
        n = one.values.size
        # A shorter series keeps the order of those places that it has.
        own = orders if n == longest else np.stack([order[order < n] for order in orders])
        fresh = np.empty((checks, n), np.int64)
        stacks.append(np.vstack([one.values, resample(bank, own, rng), resample(bank, fresh, rng, gaussian=True)]))
    return stacks


def _shuffle_blocks(length: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """A new order of 0..length-1 that keeps runs of about ten together: what one event does to its neighbours stays with it."""
    cuts = np.flatnonzero(rng.random(length) < 1.0 / _BLOCK)
    turned = np.roll(np.arange(length), int(rng.integers(length)))
    blocks = np.split(turned, cuts[cuts > 0])
    return np.concatenate([blocks[k] for k in rng.permutation(len(blocks))])


def _respond_tile(response: Array32, cells: Array32) -> Array32:
    """Regressors (n, cells * lags), lags innermost, of film cells (frames, cells) under responses (lags, n, frames)."""
    seen = np.tensordot(response, cells, axes=(2, 0))
    return np.ascontiguousarray(seen.transpose(1, 2, 0)).reshape(seen.shape[1], -1)


def _family_wise(statistic: Array, maxima: Array) -> tuple[Array, Array]:
    """Family-wise p (channels, columns) and thresholds (channels,): smallest p over channels against its own null."""
    channels, draws = maxima.shape
    ordered = np.sort(maxima, axis=1)

    def exceed(channel: int, values: Array) -> Array:
        return (draws - np.searchsorted(ordered[channel], values, side="left") + 1.0) / (draws + 1.0)

    smallest = np.sort(np.min([exceed(c, maxima[c]) for c in range(channels)], axis=0))
    single = np.stack([exceed(c, statistic[c]) for c in range(channels)])
    p_value = (np.searchsorted(smallest, single, side="right") + 1.0) / (draws + 1.0)
    # The largest single-channel p that is still significant after the step over channels sets each channel's threshold.
    admitted = smallest[max(int(np.floor(LEVEL * (draws + 1))) - 1, 0)]
    rank = np.clip(np.ceil((1.0 - admitted) * (draws + 1)).astype(int), 1, draws) - 1
    return np.minimum(p_value, 1.0), ordered[:, rank]


def _false_discovery(statistic: Array, counts: Array) -> Array:
    """Benjamini-Hochberg q values of one channel from the pooled null distribution of one cell's statistic."""
    above = np.cumsum(counts[::-1])[::-1]
    place = np.clip(np.searchsorted(_BINS, statistic, side="right") - 1, 0, counts.size - 1)
    p = (above[place] + 1.0) / (counts.sum() + 1.0)
    order = np.argsort(p)
    scaled = p[order] * p.size / np.arange(1, p.size + 1)
    q = np.empty_like(p)
    q[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return q
