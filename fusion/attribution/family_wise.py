"""Test many temperatures as sources of several drift series, with one family-wise error probability.

Temperatures come in sets (cells, thermal modes, regions). All sets share the series simulated under the null hypothesis and one error
probability: for every set and series the maximum statistic is measured in units of its own null distribution, and the largest of these is
compared with its null distribution.

Sources: Westfall and Young (1993), *Resampling-based multiple testing* (maxima over tests of different kind); Benjamini and
Hochberg (1995), J. R. Stat. Soc. B 57, 289.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution.drift_channels import DriftSeries
from fusion.attribution.likelihood_ratio import (
    Array32,
    NullBank,
    Whitened,
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    tiles,
    whiten_series,
)
from fusion.attribution.warm_up import Excitation, nuisance_columns
from fusion.model.side_by_side import side_by_side

#: Time constants of the first-order lags between temperature and drift, s.
LAGS_S = (0.0, 600.0, 1200.0, 2400.0, 3600.0, 5400.0)
#: Number of simulated series on which the false alarm rate is measured.
CHECKS = 199
#: Family-wise level of the verdicts.
LEVEL = 0.05
#: Standard normal quantile of 0.8: an effect this many standard uncertainties above the threshold is detected with 80 % power.
_POWER_80 = 0.8416
#: Bins of the pooled null distribution of the statistic of one cell.
_BINS = np.concatenate([np.arange(0.0, 40.0, 0.1), [np.inf]])

#: Mean length of the blocks of whitened residuals that are permuted, as a share of the session. Switched loads leave traces of several
#: cycles in the residuals; permuting single values gave twice the nominal rate of false alarms there.
_RUN_SHARE = 0.1


@dataclass(frozen=True)
class FieldSeries:
    """Temperatures to test, one candidate per column.

    Attributes
    ----------
    seconds : (frames,) ndarray, s
        Time since the first frame.
    values : (frames, columns) ndarray, K
        Temperature minus its mean over time.
    """

    seconds: Array
    values: Array


@dataclass(frozen=True)
class FamilyTest:
    """Result for one set of temperatures; columns are cells, modes or regions.

    Attributes
    ----------
    names : tuple of str, (channels,)
        Drift channels, with ``"joint"`` (common and proportional together) last where both exist.
    statistic : (channels, columns) ndarray
        Profile likelihood ratio at the best lag.
    lag_index : (channels, columns) ndarray of int
        Index of that lag.
    p_value : (channels, columns) ndarray
        Family-wise p-value over everything tested.
    q_value : (channels, columns) ndarray
        False-discovery rate within the channel.
    coefficient, coefficient_u : (channels, columns) ndarray, um/K
        Sensitivity of the drift and its standard uncertainty; of the joint channel at the far end of travel.
    detectable : (channels, columns) ndarray, um/K
        Detection limit: the sensitivity that is detected with 80 % power.
    threshold : (channels,) ndarray
        Statistic at the family-wise level.
    false_alarm_rate : float
        Share of the fresh simulated series in which any column of this set passed its threshold; NaN without such series.
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
class FittedNull:
    """Drift and noise of one series without any source.

    Attributes
    ----------
    order : int
        0 no drift, 1 random walk, 2 integrated random walk.
    sigma : float, um
        Noise of one value.
    drift_per_hour : float, um
        Standard deviation of the drift over one hour.
    """

    order: int
    sigma: float
    drift_per_hour: float


@dataclass(frozen=True)
class AttributionResult:
    """Result for all sets together.

    Attributes
    ----------
    sets : mapping of str to FamilyTest
        Result per set, in the order given.
    nulls : tuple of FittedNull
        Fitted null model of every series.
    draws : int
        Number of simulated series behind the p-values.
    false_alarm_rate : float
        Share of the fresh simulated series in which any column of any set passed.
    """

    sets: Mapping[str, FamilyTest]
    nulls: tuple[FittedNull, ...]
    draws: int
    false_alarm_rate: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def evaluate_candidates(
    series: Sequence[DriftSeries],
    candidates: Mapping[str, FieldSeries],
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
    """Test all columns of all sets as sources of all series, with one family-wise error over sets, columns, lags and series.

    Parameters
    ----------
    series : sequence of DriftSeries
        Drift channels on the clock of the field. The first two, where they are ``"common"`` and ``"proportional"``, are also tested
        together at the same lag.
    candidates : mapping of str to FieldSeries
        Sets of temperatures by name, all at the same instants.
    excitation : Excitation
        How the field was excited; decides whether a warm-up is part of every hypothesis.
    lags_s : sequence of float, s
        Time constants of the first-order lags.
    draws : int
        Number of simulated series that set the thresholds (the whitened residuals of the series, block-permuted), at least 19.
    checks : int
        Number of fresh simulated series (Gaussian innovations) on which the false alarm rate is measured.
    favour : mapping of str to float
        Sets with a larger share of the error probability: by how much sooner they pass, in units of the distance from the median of
        their null maxima to the 95 % point.
    beside : sequence of (n, k) ndarray, K
        For every series, regressors that every hypothesis contains as well: sources that are taken as given.
    rng : Generator
        Source of the simulated series.
    progress : callable, optional
        Called with the finished share, 0 to 1.

    Returns
    -------
    AttributionResult
    """
    sources = _prepare_sources(series, candidates, excitation, lags_s, beside, draws, checks, rng)
    names = [channel.name for channel in series]
    if names[:2] == ["common", "proportional"]:
        names.append("joint")
    columns = sum(field.values.shape[1] for field in candidates.values())
    tallies, done = [], 0
    for field in candidates.values():
        tallies.append(_Tally(len(names), field.values.shape[1], draws + checks))
        for cells in _test_field(sources, field, len(lags_s), tallies[-1]):
            if progress is not None:
                progress((done + cells.stop) / columns)
        done += field.values.shape[1]
    return _conclude(names, tallies, candidates, favour, sources, draws, checks)


def _prepare_sources(
    series: Sequence[DriftSeries],
    candidates: Mapping[str, FieldSeries],
    excitation: Excitation,
    lags_s: Sequence[float],
    beside: Sequence[Array],
    draws: int,
    checks: int,
    rng: np.random.Generator,
) -> list[_Source]:
    """Fit the null model of every series, simulate under it, and prepare the regressors."""
    operators = lag_operators(next(iter(candidates.values())).seconds, lags_s)
    given = beside or [np.empty((channel.values.size, 0)) for channel in series]
    banks = [
        null_bank(
            channel.values,
            channel.seconds,
            channel.variance,
            np.column_stack([nuisance_columns(channel.seconds, excitation), columns]),
        )
        for channel, columns in zip(series, given, strict=True)
    ]
    return [
        _Source(bank, whiten_series(bank, stack), _lagged_sampling(channel, operators))
        for channel, bank, stack in zip(series, banks, _draw(series, banks, draws, checks, rng), strict=True)
    ]


def _conclude(
    names: Sequence[str],
    tallies: Sequence[_Tally],
    candidates: Mapping[str, FieldSeries],
    favour: Mapping[str, float],
    sources: Sequence[_Source],
    draws: int,
    checks: int,
) -> AttributionResult:
    """Turn the tallies of all sets into p-values, thresholds and false alarm rates."""
    maxima = np.concatenate([tally.maxima for tally in tallies])
    ease = np.repeat([favour.get(name, 0.0) for name in candidates], len(names))
    p_values, thresholds = _family_wise([row for tally in tallies for row in tally.statistic], maxima[:, :draws], ease)
    alarms = (maxima[:, draws:] > thresholds[:, None]).reshape(len(candidates), len(names), checks)
    rows = [slice(k * len(names), (k + 1) * len(names)) for k in range(len(candidates))]
    banks = [source.bank for source in sources]
    return AttributionResult(
        sets={
            name: tally.finish(names, np.stack(p_values[row]), thresholds[row], _rate(alarms[k]))
            for k, (name, tally, row) in enumerate(zip(candidates, tallies, rows, strict=True))
        },
        # The whitenings at all grid points, which are large, end here.
        nulls=tuple(FittedNull(bank.fitted.order, bank.sigma, bank.drift_per_hour) for bank in banks),
        draws=draws,
        false_alarm_rate=_rate(alarms.reshape(len(candidates) * len(names), checks)),
    )


def _rate(alarms: NDArray[np.bool_]) -> float:
    """Share of the simulated series (rows, series) in which any row raised an alarm; NaN without series."""
    return float(alarms.any(axis=0).mean()) if alarms.size else float("nan")


@dataclass(frozen=True)
class _Source:
    """One drift series ready to be tested.

    Attributes
    ----------
    bank : null models of the series
    whitened : the series and its simulated ones, whitened
    response : (lags, n, frames) from temperatures to the regressors under every lag
    """

    bank: NullBank
    whitened: Whitened
    response: Array32


class _Tally:
    """Running results of one set over its tiles."""

    def __init__(self, channels: int, columns: int, nulls: int) -> None:
        self.statistic = np.zeros((channels, columns))
        self.lag_index = np.zeros((channels, columns), np.int64)
        self.maxima = np.zeros((channels, nulls))
        self.pooled = np.zeros((channels, _BINS.size - 1))
        # Coefficient, its standard uncertainty, and its standard uncertainty under the fitted null model.
        self.effects = np.zeros((3, channels, columns))

    def finish(self, names: Sequence[str], p_value: Array, threshold: Array, false_alarm_rate: float) -> FamilyTest:
        """Result of the set, from its p-values (channels, columns) and thresholds (channels,)."""
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

    def add(self, channel: int, cells: slice, shown: _Channel) -> None:
        """Enter what a tile of cells shows in one channel."""
        best = shown.best
        self.statistic[channel, cells] = best[0]
        self.lag_index[channel, cells] = shown.chosen
        self.effects[:, channel, cells] = shown.effects
        if best.shape[0] > 1:
            self.maxima[channel] = np.maximum(self.maxima[channel], best[1:].max(axis=1))
            bins = np.minimum((best[1:] / _BINS[1]).astype(np.int64), _BINS.size - 2)
            self.pooled[channel] += np.bincount(bins.ravel(), minlength=_BINS.size - 1)


def _lagged_sampling(series: DriftSeries, operators: Sequence[Array]) -> Array32:
    """How a series samples the field under every lag, (lags, n, frames)."""
    return np.stack([series.sampling @ operator for operator in operators]).astype(np.float32)


@dataclass(frozen=True)
class _Channel:
    """What a tile of cells shows in one channel.

    Attributes
    ----------
    best : (1 + simulated, cells) largest ratio over the lags
    chosen : (cells,) lag of the largest ratio of the measured series
    effects : (3, cells) coefficient, its uncertainty, and that under the fitted null model, at that lag
    """

    best: Array32
    chosen: NDArray[np.int64]
    effects: Array


def _test_field(sources: Sequence[_Source], field: FieldSeries, lags: int, tally: _Tally) -> Iterator[slice]:
    """Test a set tile by tile; yields each slice of columns that is done."""
    values = field.values.astype(np.float32)
    joint = tally.statistic.shape[0] > len(sources)
    places = [slice(tile.start // lags, tile.stop // lags) for tile in tiles(values.shape[1] * lags, lags)]
    tested = side_by_side(lambda cells: _test_tile(sources, values[:, cells], lags, joint), places)
    for cells, channels in zip(places, tested, strict=True):
        for channel, shown in enumerate(channels):
            tally.add(channel, cells, shown)
        yield cells


def _test_tile(sources: Sequence[_Source], field: Array32, lags: int, joint: bool) -> list[_Channel]:
    """Test a tile of temperatures (frames, cells) against every series, and against the first two together where asked for."""
    count = field.shape[1]
    regressors = [_respond_tile(source.response, field) for source in sources]
    ratios = [
        likelihood_ratios(source.bank, source.whitened, columns).reshape(-1, count, lags)
        for source, columns in zip(sources, regressors, strict=True)
    ]
    summed = [[k] for k in range(len(sources))]
    if joint:
        ratios.append(ratios[0] + ratios[1])
        # The joint effect is that at the far end of travel: common plus proportional at +1.
        summed.append([0, 1])
    channels = []
    for ratio, together in zip(ratios, summed, strict=True):
        chosen = ratio[0].argmax(axis=1)
        columns = np.arange(count) * lags + chosen
        parts = np.stack([_estimate(sources[k], regressors[k][:, columns]) for k in together])
        effects = np.stack([parts[:, 0].sum(axis=0), *np.hypot.reduce(parts[:, 1:])])
        # Lag after lag: over an axis as short as that of the lags `max` takes six times as long.
        channels.append(_Channel(reduce(np.maximum, ratio.transpose(2, 0, 1)), chosen, effects))
    return channels


def _estimate(source: _Source, regressors: Array32) -> Array:
    """Coefficients of regressors (n, columns), their uncertainties, and those under the fitted null model, (3, columns)."""
    estimate = estimate_effects(source.bank, regressors, whitened=source.whitened)
    return np.stack([estimate.coefficient, estimate.coefficient_u, estimate.null_u])


def _draw(
    series: Sequence[DriftSeries], banks: Sequence[NullBank], draws: int, checks: int, rng: np.random.Generator
) -> list[Array]:
    """The measured series, `draws` simulated with its permuted residuals, and `checks` with Gaussian ones, stacked."""
    longest = max(channel.values.size for channel in series)
    orders = np.stack([_shuffle_blocks(longest, rng) for _ in range(draws)])
    stacks = []
    for channel, bank in zip(series, banks, strict=True):
        n = channel.values.size
        # A shorter series keeps the order of those places that it has.
        shared = orders if n == longest else np.stack([order[order < n] for order in orders])
        fresh = np.empty((checks, n), np.int64)
        permuted = resample(bank, shared, rng=rng)
        stacks.append(np.vstack([channel.values, permuted, resample(bank, fresh, rng=rng, gaussian=True)]))
    return stacks


def _shuffle_blocks(length: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """A permutation of 0..length-1 in blocks, so that the effect of one event on its neighbours stays with it."""
    cuts = np.flatnonzero(rng.random(length) < 1.0 / (_RUN_SHARE * length))
    turned = np.roll(np.arange(length), int(rng.integers(length)))
    blocks = np.split(turned, cuts[cuts > 0])
    return np.concatenate([blocks[k] for k in rng.permutation(len(blocks))])


def _respond_tile(response: Array32, cells: Array32) -> Array32:
    """Regressors (n, cells * lags), lags innermost, of cells (frames, cells) under responses (lags, n, frames)."""
    lagged = np.tensordot(response, cells, axes=(2, 0))
    return np.ascontiguousarray(lagged.transpose(1, 2, 0)).reshape(lagged.shape[1], -1)


def _family_wise(statistics: Sequence[Array], maxima: Array, ease: Array) -> tuple[list[Array], Array]:
    """Family-wise p-value of every row of statistics, and thresholds (rows,), from the maxima (rows, draws) of the simulated series.

    A row is one series in one set. Rows of very different length share one error probability because each is measured in its own unit,
    the distance from the median of its maxima to their 95 % point; the largest such value over the rows is ranked. Measured and simulated
    maxima set the units together, so that the rank is exact for any number of draws. `ease` (rows,) is added to the values of a row: it
    gives the row a larger share of the error probability, at the cost of the others.
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
    # What passes exceeds all but the share LEVEL of the simulated series.
    limit = largest[draws - max(int(np.floor(LEVEL * (draws + 1))), 1)]
    return p_values, middle + limit * unit


def _false_discovery(statistic: Array, counts: Array) -> Array:
    """Benjamini-Hochberg q-values of one channel from the pooled null distribution of the statistic of one cell."""
    above = np.cumsum(counts[::-1])[::-1]
    place = np.clip(np.searchsorted(_BINS, statistic, side="right") - 1, 0, counts.size - 1)
    p = (above[place] + 1.0) / (counts.sum() + 1.0)
    order = np.argsort(p)
    scaled = p[order] * p.size / np.arange(1, p.size + 1)
    q = np.empty_like(p)
    q[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return q
