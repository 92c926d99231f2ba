"""The test behind the maps: many temperatures as sources of several drift series, with one family-wise error.

Temperatures come in sets (cells, thermal modes, regions). All sets share the redrawn nulls and one error probability: for every set
and series the maximum statistic is measured in units of its own null, and the largest of these is compared with its null.

Sources: Westfall and Young (1993), *Resampling-based multiple testing* (maxima over tests of different kind); Benjamini and
Hochberg (1995), J. R. Stat. Soc. B 57, 289.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution.drift_channels import DriftSeries
from fusion.attribution.likelihood_ratio import (
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
from fusion.attribution.warm_up import Excitation, warm_up_columns

#: Time constants of the first-order lags, s.
LAGS_S = (0.0, 600.0, 1200.0, 2400.0, 3600.0, 5400.0)
#: Fresh nulls on which the rate of false alarms is measured.
CHECKS = 199
#: Family-wise level of the verdicts.
LEVEL = 0.05
#: Standard normal quantile of 0.8: an effect is found with 80 % power this many uncertainties above the threshold.
_POWER_80 = 0.8416
#: Bins of the pooled null distribution of one cell's statistic.
_BINS = np.concatenate([np.arange(0.0, 40.0, 0.1), [np.inf]])

#: Mean length of the runs of whitened residuals that stay together when they are put into other orders, as a share of the session.
#: Switched loads leave traces of several cycles in the residuals; single values in free order gave twice the promised false alarms there.
_RUN_SHARE = 0.1


@dataclass(frozen=True)
class FieldSeries:
    """Temperatures to test: columns over time.

    Attributes
    ----------
    seconds : (frames,) s since the first frame
    values : (frames, columns) temperature minus its mean over time, K
    """

    seconds: Array
    values: Array


@dataclass(frozen=True)
class FamilyTest:
    """What the test of one set of temperatures found; columns are cells, modes or regions.

    Attributes
    ----------
    names : (channels,) with "joint" (common and proportional together) last where both exist
    statistic, lag_index : (channels, columns) likelihood ratio and the lag that it was reached at
    p_value, q_value : (channels, columns) family-wise over everything tested, and false-discovery rate within the channel
    coefficient, coefficient_u, detectable : (channels, columns) um per K
    threshold : (channels,) of the statistic at the family-wise level
    false_alarm_rate : share of fresh nulls in which anything of this set passed its threshold
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
    false_alarm_rate: float


@dataclass(frozen=True)
class AttributionResult:
    """What the test of all sets found.

    Attributes
    ----------
    sets : findings per set, in the order given
    banks : fitted null of every series
    draws : redrawn nulls behind the p values
    false_alarm_rate : share of fresh nulls in which anything of any set passed
    """

    sets: Mapping[str, FamilyTest]
    banks: tuple[NullBank, ...]
    draws: int
    false_alarm_rate: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def evaluate_films(
    series: Sequence[DriftSeries],
    films: Mapping[str, FieldSeries],
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    draws: int = 499,
    checks: int = CHECKS,
    favour: Mapping[str, float] = MappingProxyType({}),
    beside: Sequence[Array] = (),
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> AttributionResult:
    """Test all columns of all films as sources of all series, with one family-wise error over films, columns, lags and series.

    The first two series, where they are "common" and "proportional", are also tested together at the same lag. The first `draws`
    nulls (the series' own whitened residuals in other orders) set the thresholds, `checks` fresh ones (Gaussian) measure what passes.

    Parameters
    ----------
    series : drift series, all on the films' clock
    films : sets of temperatures by name, all at the same instants
    favour : sets that get a larger share of the error probability, by how much sooner they pass: in units of the distance from the
        median of a set's null maxima to their 95 % point
    beside : for every series, columns (n, k) that every hypothesis contains as well: sources that are taken as given
    """
    seconds = next(iter(films.values())).seconds
    operators = lag_operators(seconds, lags_s)
    given = beside or [np.empty((one.values.size, 0)) for one in series]
    banks = tuple(
        null_bank(
            one.values, one.seconds, one.variance, np.column_stack([nuisance_columns(one.seconds, excitation), columns])
        )
        for one, columns in zip(series, given, strict=True)
    )
    sources = [
        _Source(bank, whiten_series(bank, stack), _seen_through(one, operators))
        for one, bank, stack in zip(series, banks, _draw(series, banks, draws, checks, rng), strict=True)
    ]
    names = [one.name for one in series]
    if names[:2] == ["common", "proportional"]:
        names.append("joint")
    whole = sum(film.values.shape[1] for film in films.values())
    tallies, done = [], 0
    for film in films.values():
        tallies.append(_Tally(len(names), film.values.shape[1], draws + checks))
        for cells in _test_film(sources, film, len(lags_s), tallies[-1]):
            if progress is not None:
                progress((done + cells.stop) / whole)
        done += film.values.shape[1]
    maxima = np.concatenate([tally.maxima for tally in tallies])
    ease = np.repeat([favour.get(name, 0.0) for name in films], len(names))
    p_values, thresholds = _family_wise([row for tally in tallies for row in tally.statistic], maxima[:, :draws], ease)
    alarms = (maxima[:, draws:] > thresholds[:, None]).reshape(len(films), len(names), checks)
    rows = [slice(k * len(names), (k + 1) * len(names)) for k in range(len(films))]
    return AttributionResult(
        sets={
            name: tally.finish(names, np.stack(p_values[row]), thresholds[row], _rate(alarms[k]))
            for k, (name, tally, row) in enumerate(zip(films, tallies, rows, strict=True))
        },
        banks=banks,
        draws=draws,
        false_alarm_rate=_rate(alarms.reshape(len(films) * len(names), checks)),
    )


def _rate(alarms: NDArray[np.bool_]) -> float:
    """Share of the nulls (rows, nulls) in which any row raised an alarm; NaN without nulls."""
    return float(alarms.any(axis=0).mean()) if alarms.size else float("nan")


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

    def finish(self, names: Sequence[str], p_value: Array, threshold: Array, false_alarm_rate: float) -> FamilyTest:
        """Findings of the set, once its p values (channels, columns) and thresholds (channels,) are known."""
        return FamilyTest(
            names=tuple(names),
            statistic=self.statistic,
            lag_index=self.lag_index,
            p_value=p_value,
            q_value=np.stack([_false_discovery(*pair) for pair in zip(self.statistic, self.pooled, strict=True)]),
            coefficient=self.effects[0],
            coefficient_u=self.effects[1],
            detectable=(np.sqrt(threshold)[:, None] + _POWER_80) * self.effects[2],
            threshold=threshold,
            false_alarm_rate=false_alarm_rate,
        )

    def add(self, channel: int, cells: slice, ratio: Array32, chosen: NDArray[np.int64], effects: Array) -> None:
        """Enter ratios (1 + nulls, cells, lags) of one channel, the chosen lags (cells,) and the effects there (3, cells)."""
        best = ratio.max(axis=2)
        self.statistic[channel, cells] = best[0]
        self.lag_index[channel, cells] = chosen
        self.effects[:, channel, cells] = effects
        if best.shape[0] > 1:
            self.maxima[channel] = np.maximum(self.maxima[channel], best[1:].max(axis=1))
            bins = np.minimum((best[1:] / _BINS[1]).astype(np.int64), _BINS.size - 2)
            self.pooled[channel] += np.bincount(bins.ravel(), minlength=_BINS.size - 1)


def _seen_through(series: DriftSeries, operators: Sequence[Array]) -> Array32:
    """How a series sees the film under every lag, (lags, n, frames)."""
    return np.stack([series.sampling @ operator for operator in operators]).astype(np.float32)


def _test_film(sources: Sequence[_Source], film: FieldSeries, lags: int, tally: _Tally) -> Iterator[slice]:
    """Test a film tile by tile; yields each slice of columns that is done."""
    values = film.values.astype(np.float32)
    for tile in tiles(values.shape[1] * lags, lags):
        cells = slice(tile.start // lags, tile.stop // lags)
        _test_tile(sources, values[:, cells], cells, lags, tally)
        yield cells


def _test_tile(sources: Sequence[_Source], film32: Array32, cells: slice, lags: int, tally: _Tally) -> None:
    """Test a tile of cells against every series, and the first two together where the tally has room for that."""
    count = cells.stop - cells.start
    regressors = [_respond_tile(source.response, film32) for source in sources]
    ratios = [
        likelihood_ratios(source.bank, source.whitened, moved).reshape(-1, count, lags)
        for source, moved in zip(sources, regressors, strict=True)
    ]
    members = [[k] for k in range(len(sources))]
    if tally.statistic.shape[0] > len(sources):
        ratios.append(ratios[0] + ratios[1])
        # The joint effect is that at the far end of travel: common plus proportional at +1.
        members.append([0, 1])
    for channel, (ratio, together) in enumerate(zip(ratios, members, strict=True)):
        chosen = ratio[0].argmax(axis=1)
        columns = np.arange(count) * lags + chosen
        parts = np.stack([_stack(estimate_effects(sources[k].bank, regressors[k][:, columns])) for k in together])
        tally.add(channel, cells, ratio, chosen, np.stack([parts[:, 0].sum(axis=0), *np.hypot.reduce(parts[:, 1:])]))


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
    """A new order of 0..length-1 that keeps runs together: what one event does to its neighbours stays with it."""
    cuts = np.flatnonzero(rng.random(length) < 1.0 / (_RUN_SHARE * length))
    turned = np.roll(np.arange(length), int(rng.integers(length)))
    blocks = np.split(turned, cuts[cuts > 0])
    return np.concatenate([blocks[k] for k in rng.permutation(len(blocks))])


def _respond_tile(response: Array32, cells: Array32) -> Array32:
    """Regressors (n, cells * lags), lags innermost, of film cells (frames, cells) under responses (lags, n, frames)."""
    seen = np.tensordot(response, cells, axes=(2, 0))
    return np.ascontiguousarray(seen.transpose(1, 2, 0)).reshape(seen.shape[1], -1)


def _family_wise(statistics: Sequence[Array], maxima: Array, ease: Array) -> tuple[list[Array], Array]:
    """Family-wise p of every row of statistics, and thresholds (rows,), from the rows' maxima (rows, draws) in the same nulls.

    A row is one series in one set. Rows of very different length have one error probability together because each is measured in its own
    unit, the distance from the median of its maxima to their 95 % point; the largest such value over the rows is ranked. Measured and
    redrawn maxima set the units together, so that the rank is exact for any number of draws. `ease` (rows,) is added to a row's values:
    it gives the row a larger share of the error probability, at the others' cost.
    """
    draws = maxima.shape[1]
    measured = np.array([values.max() for values in statistics])
    middle, upper = np.quantile(np.column_stack([measured, maxima]), [0.5, 0.95], axis=1)
    unit = np.maximum(upper - middle, 1e-9)
    middle = middle - ease * unit
    largest = np.sort(((maxima - middle[:, None]) / unit[:, None]).max(axis=0))
    p_values = []
    for values, centre, step in zip(statistics, middle, unit, strict=True):
        reached = draws - np.searchsorted(largest, (values - centre) / step, side="left")
        p_values.append((reached + 1.0) / (draws + 1.0))
    # What passes exceeds all but the share LEVEL of the nulls.
    limit = largest[draws - max(int(np.floor(LEVEL * (draws + 1))), 1)]
    return p_values, middle + limit * unit


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
