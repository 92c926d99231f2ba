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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.analysis.alignment.first_order_lag import lag_operators
from fusion.analysis.attribution.drift_channels import DriftSeries, TargetSeries
from fusion.analysis.attribution.modes import Excitation, nuisance_columns
from fusion.analysis.drift_model.gains import side_by_side
from fusion.analysis.levels import ATTRIBUTION_LEVEL, CHECKS
from fusion.common import Array
from interferometry.drift.kalman import DriftSystem, Order, drift_system
from thermofuse.compiled import njit
from thermography.large_arrays import empty_array, one_by_one

# Profile likelihood ratios of many regressors against one drift series, with the drift variance estimated again under
# each.

Array32 = NDArray[np.float32]

#: Drift over one hour in units of the noise of one value: below the first it has no effect, above the last it hides every source.
_WALK_PER_HOUR = 0.1 * 3.0 ** np.arange(8)
_INTEGRATED_PER_HOUR = 0.1 * 3.0 ** np.arange(10)
#: Columns of one tile: with a thousand simulated series the products of a tile stay in the second-level cache.
_TILE = 512
#: Score of a regressor without information: above that of any other, and finite.
_NOTHING = 1e6
#: A whitened regressor that keeps less than this share of its length given the nuisance regressors carries no information.
_VANISHING = 1e-5


@dataclass(frozen=True)
class Whitening:
    """One grid point: a drift of given order (0 none, 1 random walk, 2 integrated random walk) and variance.

    ``per_hour`` is the standard deviation of the increment of the drift over one hour over the noise of one value, ``basis`` (n, k) an
    orthonormal basis of the whitened nuisance regressors, ``log_penalty`` the log-determinant terms over the degrees of freedom.
    """

    order: int
    per_hour: float
    system: DriftSystem
    basis: Array
    log_penalty: float

    @property
    def project(self) -> Array:
        """Whitens and removes the nuisance regressors, (n, n); made when it is asked for, as all of a long test fill the memory."""
        white, _ = self.system.whiten(np.eye(self.system.seconds.size))
        return np.asarray(white - self.basis @ (self.basis.T @ white))

    @property
    def colour(self) -> Array:
        """Inverse of the whitening, (n, n); made when it is asked for, as few grid points are asked."""
        white, _ = self.system.whiten(np.eye(self.system.seconds.size))
        return np.asarray(_invert_lower(white))


@njit(nogil=True)
def _invert_lower(lower: Array) -> Array:
    """Inverse of a lower triangular matrix; threaded BLAS is slower at this size."""
    n = lower.shape[0]
    inverse = np.zeros((n, n))
    for j in range(n):
        inverse[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total += lower[i, k] * inverse[k, j]
            inverse[i, j] = -total / lower[i, i]
    return inverse


@dataclass(frozen=True)
class Grid:
    """Whitenings at every grid point, for all series that share instants, variances and nuisance regressors.

    ``freedom`` is the number of values minus nuisance regressors, ``scale`` the median relative variance of the values.
    """

    whitenings: tuple[Whitening, ...]
    freedom: int
    scale: float


@dataclass(frozen=True)
class NullBank(Grid):
    """The null models of one series (n,) in um at all grid points.

    ``whitened`` is the series whitened at every grid point, without the nuisance regressors; ``best`` the grid point of highest restricted
    likelihood without any regressor, ``sigma`` the noise there (um) of a value of relative variance 1; ``log_likelihood`` is restricted.
    """

    values: Array
    whitened: tuple[Array, ...]
    best: int
    sigma: float
    log_likelihood: Array

    @property
    def fitted(self) -> Whitening:
        """The null model of highest restricted likelihood."""
        return self.whitenings[self.best]

    @property
    def drift_per_hour(self) -> float:
        """Standard deviation of the fitted drift over one hour, um."""
        return self.fitted.per_hour * self.sigma


def whitening_grid(seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> Grid:
    """Compute the whitening at every grid point."""
    n = seconds.size
    scale = float(np.median(variance))
    freedom = n - nuisance.shape[1]
    whitenings = []
    drifts = [(0, 0.0), *((1, float(rate)) for rate in _WALK_PER_HOUR)]
    drifts += [(2, float(rate)) for rate in _INTEGRATED_PER_HOUR] if integrated else []
    for order, per_hour in drifts:
        ratio = scale * per_hour**2 / 3600.0 if order < 2 else scale * per_hour**2 * 3.0 / 3600.0**3
        kind: Order = 2 if order == 2 else 1
        system = drift_system(seconds, np.ones((n, 1)), order=kind, ratios=np.array([ratio]), variance=variance)
        white, log_determinant = system.whiten(np.eye(n))
        basis, triangle = np.linalg.qr(white @ nuisance)
        log_normal = 2.0 * float(np.log(np.abs(np.diag(triangle))).sum())
        penalty = float(log_determinant + log_normal) / freedom
        whitenings.append(Whitening(order, per_hour, system, basis, penalty))
    return Grid(tuple(whitenings), freedom, scale)


def fit_null(grid: Grid, values: Array) -> NullBank:
    """Fit the null model to a series: the grid point of highest restricted likelihood."""
    whitened = tuple(point.project @ values for point in grid.whitenings)
    rss = np.array([(white**2).sum() for white in whitened])
    score = np.log(np.maximum(rss, 1e-300)) + np.array([point.log_penalty for point in grid.whitenings])
    best = int(np.argmin(score))
    sigma = float(np.sqrt(grid.scale * rss[best] / grid.freedom))
    log_likelihood = -0.5 * grid.freedom * score
    return NullBank(grid.whitenings, grid.freedom, grid.scale, values, whitened, best, sigma, log_likelihood)


def null_bank(values: Array, seconds: Array, variance: Array, nuisance: Array, *, integrated: bool = True) -> NullBank:
    """Compute the whitenings for one series and fit the null model to it; see `whitening_grid` and `fit_null`."""
    return fit_null(whitening_grid(seconds, variance, nuisance, integrated=integrated), values)


def resample(bank: NullBank, orders: NDArray[np.int64], *, rng: np.random.Generator, gaussian: bool = False) -> Array:
    """Simulate series under the null hypothesis: drift variances drawn by their likelihood, whitened residuals permuted."""
    weight = np.exp(bank.log_likelihood - bank.log_likelihood.max())
    chosen = rng.choice(weight.size, size=orders.shape[0], p=weight / weight.sum())
    series = np.empty(orders.shape)
    for g in np.unique(chosen):
        null = bank.whitenings[g]
        rows = np.flatnonzero(chosen == g)
        residual = bank.whitened[g]
        spread = float(np.sqrt(residual @ residual / bank.freedom))
        if gaussian:
            innovations = spread * rng.standard_normal((rows.size, residual.size))
        else:
            # What the nuisance regressors removed from the residuals is put back at random: without it, block permutations would
            # lack slow variation, and their maxima would be too small.
            removed = spread * rng.standard_normal((rows.size, null.basis.shape[1])) @ null.basis.T
            innovations = np.take_along_axis(residual + removed, orders[rows], axis=1)
        series[rows] = innovations @ null.colour.T
    return series


@dataclass(frozen=True)
class Whitened:
    """Series (draws, n) whitened at every grid point, the measured one first, in single precision; in temporary files where they are long.

    ``projects`` are `Whitening.project` of every grid point, ``penalised`` (grid, draws) sums of squares times ``penalty``, the determinant
    terms up to a common factor, and ``null_score`` (draws,) the smallest of them over the grid.
    """

    projects: Array32
    series: Array32
    penalised: Array32
    penalty: Array32
    null_score: Array32
    freedom: int


def whiten_series(bank: NullBank, series: Array) -> Whitened:
    """Whiten series at every grid point."""
    count, n = len(bank.whitenings), series.shape[1]
    projects = empty_array((count, n, n), np.float32)
    projected = empty_array((count, *series.shape), np.float32)
    squares = np.empty(projected.shape[:2])
    filled = zip(bank.whitenings, one_by_one(projects), one_by_one(projected), strict=True)
    for g, (point, project, white) in enumerate(filled):
        exact = point.project
        whole = series @ exact.T
        project[:], white[:], squares[g] = exact, whole, (whole**2).sum(axis=1)
    log_penalty = np.array([point.log_penalty for point in bank.whitenings])
    # Only ratios of scores count; a common factor keeps single precision away from its limits.
    reference = np.log(squares[:, 0]) + log_penalty
    penalty = np.exp(log_penalty - reference.min())
    penalised = squares * penalty[:, None]
    return Whitened(
        projects,
        projected,
        penalised.astype(np.float32),
        penalty.astype(np.float32),
        penalised.min(axis=0).astype(np.float32),
        bank.freedom,
    )


def _unit_regressors(project: Array32, regressors: Array32) -> tuple[Array32, Array32]:
    """Whitened regressors (n, columns) of length one, and their lengths (columns,); those without information are zero."""
    white = project @ regressors
    length = np.sqrt(np.einsum("ij,ij->j", white, white))
    size = np.sqrt(np.einsum("ij,ij->j", regressors, regressors))
    useful = length > _VANISHING * np.maximum(size, np.float32(1e-30)) * np.abs(project).max()
    white *= np.where(useful, 1.0 / np.where(useful, length, 1.0), 0.0).astype(np.float32)
    return white, np.where(useful, length, np.float32(0.0))


@njit(nogil=True, fastmath={"nnan", "ninf", "nsz"})
def _take_best(products: Array32, penalised: Array32, penalty: np.float32, best: Array32) -> None:
    """Lower best (draws, columns) to the penalised residual squares of this grid point where they are smaller."""
    draws, columns = products.shape
    for b in range(draws):
        whole = penalised[b]
        for j in range(columns):
            best[b, j] = min(best[b, j], whole - penalty * products[b, j] * products[b, j])


@njit(nogil=True, fastmath={"nnan", "ninf", "nsz"})
def _log_ratio(null_score: Array32, best: Array32, freedom: float) -> None:
    """Turn best (draws, columns) into likelihood ratios in place; a regressor can only help, so the ratio is at least 0."""
    draws, columns = best.shape
    for b in range(draws):
        whole = null_score[b]
        for j in range(columns):
            best[b, j] = freedom * np.log(whole / max(best[b, j], np.float32(1e-6) * whole))


def likelihood_ratios(whitened: Whitened, regressors: Array32) -> Array32:
    """Return the profile likelihood ratio of every regressor for every series."""
    return _test_regressors(whitened, regressors)[0]


def _test_regressors(whitened: Whitened, regressors: Array32) -> tuple[Array32, Array32, Array32]:
    """Likelihood ratios (draws, columns); products of the first series with the whitened regressors, their lengths, (grid, columns)."""
    draws = whitened.series.shape[1]
    best = np.empty((draws, regressors.shape[1]), np.float32)
    best[:] = whitened.null_score[:, None]
    products, lengths = np.empty((2, len(whitened.projects), regressors.shape[1]), np.float32)
    for g, (project, series) in enumerate(zip(one_by_one(whitened.projects), one_by_one(whitened.series), strict=True)):
        unit, lengths[g] = _unit_regressors(project, regressors)
        product = series @ unit
        products[g] = product[0]
        _take_best(product, whitened.penalised[g], whitened.penalty[g], best)
    _log_ratio(whitened.null_score, best, float(whitened.freedom))
    return best, products, lengths


@dataclass(frozen=True)
class Fits:
    """Fits of regressors to one series at every grid point, (grid, columns): coefficients, their standard uncertainties, and scores.

    A score is -2 log of the restricted likelihood over the degrees of freedom ``freedom``. Uncertainty and score are infinite where a
    regressor carries no information. ``null`` is the grid point of the fitted null model.
    """

    coefficient: Array
    coefficient_u: Array
    score: Array
    freedom: int
    null: int

    @staticmethod
    def of(bank: NullBank, products: Array32, lengths: Array32) -> Fits:
        """From products of the whitened series with whitened regressors of length one, and the lengths of these, (grid, columns)."""
        informative = lengths > 0
        safe = np.where(informative, lengths, 1.0).astype(float)
        squares = np.array([series @ series for series in bank.whitened])[:, None]
        rss = np.maximum(squares - products.astype(float) ** 2, 1e-300)
        penalty = np.array([point.log_penalty for point in bank.whitenings])[:, None]
        return Fits(
            products / safe,
            np.where(informative, np.sqrt(rss / (bank.freedom - 1)) / safe, np.inf),
            np.where(informative, np.log(rss) + penalty, np.inf),
            bank.freedom,
            bank.best,
        )

    def take(self, columns: NDArray[np.int64]) -> Fits:
        """The fits of some of the regressors."""
        coefficient, coefficient_u, score = (
            one[:, columns] for one in (self.coefficient, self.coefficient_u, self.score)
        )
        return Fits(coefficient, coefficient_u, score, self.freedom, self.null)

    @property
    def best(self) -> Array:
        """Coefficients (columns,) at the grid point of highest likelihood."""
        return np.take_along_axis(self.coefficient, self.score.argmin(axis=0)[None], axis=0)[0]

    @property
    def null_u(self) -> Array:
        """Standard uncertainties (columns,) under the fitted null model."""
        square = self.coefficient_u[self.null] ** 2 * (self.freedom - 1) + self.coefficient[self.null] ** 2
        return np.asarray(np.sqrt(square / self.freedom))

    def average(self) -> tuple[Array, Array, Array]:
        """Over the drifts of the grid by their likelihood: log of its sum, mean and variance of the coefficients, (columns,) each."""
        lowest = np.minimum(self.score.min(axis=0), _NOTHING)
        weight = np.exp(-0.5 * self.freedom * (self.score - lowest))
        total = np.maximum(weight.sum(axis=0), 1e-300)
        weight /= total
        mean = (weight * self.coefficient).sum(axis=0)
        square = np.where(weight > 0, self.coefficient_u, 0.0) ** 2
        variance = (weight * (square + (self.coefficient - mean) ** 2)).sum(axis=0)
        return -0.5 * self.freedom * lowest + np.log(total), mean, variance

    def limits(self, ratio: float) -> tuple[Array, Array]:
        """Lowest and highest coefficient (columns,) whose likelihood ratio to the best is at most `ratio`, the drift profiled."""
        lowest = np.minimum(self.score.min(axis=0), _NOTHING)
        margin = lowest + ratio / self.freedom - self.score
        inside = margin >= 0
        u = np.where(inside, self.coefficient_u, 0.0)
        half = u * np.sqrt((self.freedom - 1) * np.expm1(np.where(inside, margin, 0.0)))
        low = np.where(inside, self.coefficient - half, np.inf).min(axis=0)
        high = np.where(inside, self.coefficient + half, -np.inf).max(axis=0)
        known = lowest < _NOTHING
        return np.where(known, low, -np.inf), np.where(known, high, np.inf)


@dataclass(frozen=True)
class Estimate:
    """Effect of each regressor at its most likely drift and alternative, um/K, with its standard uncertainty over all of them.

    ``coefficient_u`` is the root mean square distance of the truth from the coefficient, averaged by likelihood over the drifts of the
    grid and the alternatives (time constants) of a regressor: that of the most likely ones alone is too small by half where the data do
    not decide. ``null_u`` is the uncertainty under the fitted null model, from which the detection limit follows.
    """

    coefficient: Array
    coefficient_u: Array
    null_u: Array


def combine_fits(fits: Sequence[Fits], chosen: NDArray[np.int64]) -> Estimate:
    """Estimate the sum of the effects of each regressor on several series.

    The columns are alternatives of the regressors, those of one regressor beside each other; ``chosen`` says which of them is reported.
    """
    shape = (chosen.size, -1)
    evidence, mean, variance = (
        np.sum(parts, axis=0).reshape(shape) for parts in zip(*(one.average() for one in fits), strict=True)
    )
    columns = np.arange(chosen.size) * evidence.shape[1] + chosen
    parts = [one.take(columns) for one in fits]
    coefficient = np.sum([one.best for one in parts], axis=0)
    weight = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    square = (weight * (variance + (mean - coefficient[:, None]) ** 2)).sum(axis=1) / weight.sum(axis=1)
    known = np.all([np.isfinite(one.score).any(axis=0) for one in parts], axis=0)
    return Estimate(
        coefficient, np.where(known, np.sqrt(square), np.inf), np.hypot.reduce([one.null_u for one in parts])
    )


#: Shares of a likelihood ratio that the first of two effects may take.
_SPLITS = np.sin(np.linspace(0.0, np.pi / 2, 9)) ** 2


def joint_limits(fits: Sequence[Fits], ratio: float) -> tuple[Array, Array]:
    """Return the limits of an effect on one series, or of the sum of those on two, at a likelihood ratio; no looser than the test."""
    if len(fits) == 1:
        return fits[0].limits(ratio)
    parts = [np.add(fits[0].limits(share * ratio), fits[1].limits((1.0 - share) * ratio)) for share in _SPLITS]
    low, high = np.stack(parts, axis=1)
    return low.min(axis=0), high.max(axis=0)


def estimate_effects(bank: NullBank, regressors: Array32) -> Estimate:
    """Estimate the coefficient of every regressor, with the drift variance profiled."""
    fits = fit_regressors(bank, regressors)
    return combine_fits([fits], np.zeros(regressors.shape[1], np.int64))


def fit_regressors(bank: NullBank, regressors: Array32) -> Fits:
    """Fit every regressor at every grid point."""
    shape = (len(bank.whitenings), regressors.shape[1])
    products, lengths = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for g, (point, series) in enumerate(zip(bank.whitenings, bank.whitened, strict=True)):
        unit, lengths[g] = _unit_regressors(point.project.astype(np.float32), regressors)
        products[g] = series.astype(np.float32) @ unit
    return Fits.of(bank, products, lengths)


def tiles(columns: int, group: int) -> Sequence[slice]:
    """Return slices of whole groups of columns, about 512 wide."""
    step = max(_TILE // group, 1) * group
    return [slice(start, min(start + step, columns)) for start in range(0, columns, step)]


def monte_carlo_p(statistic: Array | Array32, simulated: Array) -> Array:
    """Return the Monte Carlo p-values of statistics from simulated ones (draws,), the measured series counted among them."""
    reached = simulated.size - np.searchsorted(np.sort(simulated), statistic, side="left")
    return np.asarray((reached + 1.0) / (simulated.size + 1.0))


#: Time constants of the first-order lags between temperature and drift, s.
LAGS_S = (0.0, 600.0, 1200.0, 2400.0, 3600.0, 5400.0)
#: Standard normal quantile of 0.8: an effect this many standard uncertainties above the threshold is detected with 80 % power.
_POWER_80 = 0.8416
#: Bins of the pooled null distribution of the statistic of one cell.
_BINS = np.concatenate([np.arange(0.0, 40.0, 0.1), [np.inf]])

#: Mean length of the runs of whitened residuals that are permuted: a tenth of the session, and at least so many seconds, up to a quarter
#: of it. A switched load leaves a trace in the residuals for as long as its heat spreads, however short the session is: permuting single
#: values gave twice the nominal rate of false alarms, runs of 21 min in sessions of 3.5 h one and a half times.
_RUN_SHARE, _RUN_S, _MOST_OF_SESSION = 0.1, 2520.0, 0.25


@dataclass(frozen=True)
class FieldSeries:
    """Temperatures to test (frames, candidates), K about their means over time; seconds since the first frame."""

    seconds: Array
    values: Array


@dataclass(frozen=True)
class FamilyTest:
    """Result for one set of temperatures over channels and columns, which are cells, modes or regions.

    The channel ``"joint"`` (common and proportional together) is last where both exist; its coefficients are at the far end of travel.
    Statistics are profile likelihood ratios at the best lag, p-values family-wise over everything tested, q-values false-discovery rates
    within the channel, coefficients um/K. ``low`` and ``high`` limit them at their lag, for everything tested at once with 95 %: they hold
    0 exactly where p is above the level (``"joint"``: at least there, as one end of travel may stay where the other moves).
    ``detectable`` are found with 80 % power, ``threshold`` (channels,) is the statistic at the family-wise level. The false alarm rate is
    the share of fresh simulated series in which any column passed; NaN without such series.
    """

    names: tuple[str, ...]
    statistic: Array
    lag_index: NDArray[np.int64]
    p_value: Array
    q_value: Array
    coefficient: Array
    coefficient_u: Array
    low: Array
    high: Array
    detectable: Array
    threshold: Array
    false_alarm_rate: float


@dataclass(frozen=True)
class FittedNull:
    """Drift and noise of one series without any source: order as in `Whitening`, noise of one value and drift over one hour in um."""

    order: int
    sigma: float
    drift_per_hour: float


@dataclass(frozen=True)
class AttributionResult:
    """Result for all sets together, in the order given; `draws` simulated series are behind the p-values."""

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
    conditional_on: Sequence[Array] = (),
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> AttributionResult:
    """Test all columns of all sets as sources of all series, with one family-wise error over sets, columns, lags and series."""
    operators = lag_operators(next(iter(candidates.values())).seconds, lags_s)
    given = conditional_on or [np.empty((channel.values.size, 0)) for channel in series]
    banks = [
        null_bank(
            channel.values,
            channel.seconds,
            channel.variance,
            np.column_stack([nuisance_columns(channel.seconds, excitation), columns]),
        )
        for channel, columns in zip(series, given, strict=True)
    ]
    sources = [
        _Source(bank, whiten_series(bank, stack), channel.lagged_sampling(operators).astype(np.float32))
        for channel, bank, stack in zip(series, banks, _draw(series, banks, draws, checks, rng), strict=True)
    ]
    names = [channel.name for channel in series]
    if names[:2] == ["common", "proportional"]:
        names.append("joint")
    columns = sum(field.values.shape[1] for field in candidates.values())
    tallies, done = {}, 0
    for name, field in candidates.items():
        tallies[name] = _Tally(len(names), field.values.shape[1], draws + checks)
        for cells in _test_field(sources, field, len(lags_s), tallies[name]):
            if progress is not None:
                progress((done + cells.stop) / columns)
        done += field.values.shape[1]
    return _conclude(names, tallies, favour, banks, draws)


def _conclude(
    names: Sequence[str], tallies: Mapping[str, _Tally], favour: Mapping[str, float], banks: Sequence[NullBank], draws: int
) -> AttributionResult:  # fmt: skip
    """Turn the tallies of all sets into p-values, thresholds and false alarm rates."""
    maxima = np.concatenate([tally.maxima for tally in tallies.values()])
    statistics = [row for tally in tallies.values() for row in tally.statistic]
    ease = np.repeat([favour.get(name, 0.0) for name in tallies], len(names))
    p_values, thresholds = _family_wise(statistics, maxima[:, :draws], ease)
    alarms = maxima[:, draws:] > thresholds[:, None]
    sets = {}
    for k, (name, tally) in enumerate(tallies.items()):
        rows = slice(k * len(names), (k + 1) * len(names))
        sets[name] = tally.finish(names, np.stack(p_values[rows]), thresholds[rows], _rate(alarms[rows]))
    # The whitenings at all grid points, which are large, end here.
    nulls = tuple(FittedNull(bank.fitted.order, bank.sigma, bank.drift_per_hour) for bank in banks)
    return AttributionResult(sets, nulls, draws, _rate(alarms))


def _rate(alarms: NDArray[np.bool_]) -> float:
    """Share of the simulated series (rows, series) in which any row raised an alarm; NaN without series."""
    return float(alarms.any(axis=0).mean()) if alarms.size else float("nan")


@dataclass(frozen=True)
class _Source:
    """One drift series ready to be tested; `response` (lags, n, frames) leads from temperatures to the regressors under every lag."""

    bank: NullBank
    whitened: Whitened
    response: Array32


@dataclass(frozen=True)
class _Shown:
    """What a tile of temperatures shows in one channel.

    The largest ratios over the lags (1 + simulated, cells), the lag of the measured series (cells,), the effect, and the fits at that lag,
    of both series where two are tested together.
    """

    best: Array32
    chosen: NDArray[np.int64]
    effect: Estimate
    fits: list[Fits]


class _Tally:
    """Running results of one set over its tiles."""

    def __init__(self, channels: int, columns: int, nulls: int) -> None:
        self.statistic = np.zeros((channels, columns))
        self.lag_index = np.zeros((channels, columns), np.int64)
        self.maxima = np.zeros((channels, nulls))
        self.pooled = np.zeros((channels, _BINS.size - 1))
        # Coefficient, its standard uncertainty, and its standard uncertainty under the fitted null model.
        self.effects = np.zeros((3, channels, columns))
        self.fits: list[list[tuple[slice, list[Fits]]]] = [[] for _ in range(channels)]

    def finish(self, names: Sequence[str], p_value: Array, threshold: Array, false_alarm_rate: float) -> FamilyTest:
        """Result of the set, from its p-values (channels, columns) and thresholds (channels,)."""
        low, high = np.zeros((2, *p_value.shape))
        for channel, tiles_of in enumerate(self.fits):
            for cells, parts in tiles_of:
                low[channel, cells], high[channel, cells] = joint_limits(parts, threshold[channel])
                if len(parts) == 1:
                    # The drifts of the grid are few: between the limits of two of them may be a gap, in which 0 lies.
                    passed, effect = p_value[channel, cells] <= ATTRIBUTION_LEVEL, self.effects[0, channel, cells]
                    np.maximum(low[channel, cells], 0.0, out=low[channel, cells], where=passed & (effect > 0))
                    np.minimum(high[channel, cells], 0.0, out=high[channel, cells], where=passed & (effect < 0))
        return FamilyTest(
            names=tuple(names),
            statistic=self.statistic,
            lag_index=self.lag_index,
            p_value=p_value,
            q_value=np.stack([_false_discovery(*pair) for pair in zip(self.statistic, self.pooled, strict=True)]),
            coefficient=self.effects[0],
            coefficient_u=self.effects[1],
            low=low,
            high=high,
            detectable=(np.sqrt(threshold)[:, None] + _POWER_80) * self.effects[2],
            threshold=threshold,
            false_alarm_rate=false_alarm_rate,
        )

    def add(self, channel: int, cells: slice, shown: _Shown) -> None:
        """Enter what a tile of cells shows in one channel."""
        best = shown.best
        self.statistic[channel, cells] = best[0]
        self.lag_index[channel, cells] = shown.chosen
        effect = shown.effect
        self.effects[:, channel, cells] = effect.coefficient, effect.coefficient_u, effect.null_u
        self.fits[channel].append((cells, shown.fits))
        if best.shape[0] > 1:
            self.maxima[channel] = np.maximum(self.maxima[channel], best[1:].max(axis=1))
            bins = np.minimum((best[1:] / _BINS[1]).astype(np.int64), _BINS.size - 2)
            self.pooled[channel] += np.bincount(bins.ravel(), minlength=_BINS.size - 1)


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


def _test_tile(sources: Sequence[_Source], field: Array32, lags: int, joint: bool) -> list[_Shown]:
    """Test a tile of temperatures (frames, cells) against every series, and against the first two together where asked for."""
    count = field.shape[1]
    ratios, fits = [], []
    for source in sources:
        best, products, lengths = _test_regressors(source.whitened, _respond_tile(source.response, field))
        ratios.append(best.reshape(-1, count, lags))
        fits.append(Fits.of(source.bank, products, lengths))
    summed = [[k] for k in range(len(sources))]
    if joint:
        ratios.append(ratios[0] + ratios[1])
        # The joint effect is that at the far end of travel: common plus proportional at +1.
        summed.append([0, 1])
    channels = []
    for ratio, together in zip(ratios, summed, strict=True):
        chosen = ratio[0].argmax(axis=1)
        columns = np.arange(count) * lags + chosen
        parts = [fits[k] for k in together]
        # Lag after lag: over an axis as short as that of the lags `max` takes six times as long.
        best = reduce(np.maximum, ratio.transpose(2, 0, 1))
        channels.append(_Shown(best, chosen, combine_fits(parts, chosen), [one.take(columns) for one in parts]))
    return channels


def _draw(
    series: Sequence[DriftSeries], banks: Sequence[NullBank], draws: int, checks: int, rng: np.random.Generator
) -> list[Array]:
    """The measured series, `draws` simulated with its permuted residuals, and `checks` with Gaussian ones, stacked."""
    longest = max(channel.values.size for channel in series)
    duration_s = max(float(np.ptp(channel.seconds)) for channel in series)
    share = min(max(_RUN_SHARE, _RUN_S / duration_s), _MOST_OF_SESSION)
    orders = np.stack([_shuffle_blocks(longest, share, rng) for _ in range(draws)])
    stacks = []
    for channel, bank in zip(series, banks, strict=True):
        n = channel.values.size
        # A shorter series keeps the order of those places that it has.
        shared = orders if n == longest else np.stack([order[order < n] for order in orders])
        fresh = np.empty((checks, n), np.int64)
        permuted = resample(bank, shared, rng=rng)
        stacks.append(np.vstack([channel.values, permuted, resample(bank, fresh, rng=rng, gaussian=True)]))
    return stacks


def _shuffle_blocks(length: int, share: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """A permutation of 0..length-1 in blocks of a mean share of it, so that the effect of one event on its neighbours stays with it."""
    cuts = np.flatnonzero(rng.random(length) < 1.0 / (share * length))
    turned = np.roll(np.arange(length), int(rng.integers(length)))
    blocks = np.split(turned, cuts[cuts > 0])
    return np.concatenate([blocks[k] for k in rng.permutation(len(blocks))])


def _respond_tile(response: Array32, cells: Array32) -> Array32:
    """Regressors (n, cells * lags), lags innermost, of cells (frames, cells) under responses (lags, n, frames)."""
    lagged = np.tensordot(response, cells, axes=(2, 0))
    return np.ascontiguousarray(lagged.transpose(1, 2, 0)).reshape(lagged.shape[1], -1)


def _family_wise(statistics: Sequence[Array], maxima: Array, ease: Array) -> tuple[list[Array], Array]:
    """Family-wise p-value of every row of statistics, and thresholds (rows,), from the maxima (rows, draws) of the simulated series."""
    measured = np.array([values.max() for values in statistics])
    middle, upper = np.quantile(np.column_stack([measured, maxima]), [0.5, 0.95], axis=1)
    unit = np.maximum(upper - middle, 1e-9)
    middle = middle - ease * unit
    largest = np.sort(((maxima - middle[:, None]) / unit[:, None]).max(axis=0))
    scaled = zip(statistics, middle, unit, strict=True)
    p_values = [monte_carlo_p((values - centre) / step, largest) for values, centre, step in scaled]
    return p_values, middle + _limit(largest) * unit


def _limit(largest: Array) -> float:
    """What passes exceeds all but the share ATTRIBUTION_LEVEL of the simulated series, whose largest statistics (draws,) are in order."""
    return float(largest[largest.size - max(int(np.floor(ATTRIBUTION_LEVEL * (largest.size + 1))), 1)])


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


# Test every cell against every target and direction, fast: whitening fixed under the null, maxima over permutations
# in tiles.

_ROWS = 1000
#: Relative variance of a value that is missing.
_NO_WEIGHT = 1e8
#: Largest share of the squares of a series that one temperature can explain: beyond it lies the single precision of the products.
_MOST_EXPLAINED = 1.0 - 1e-6


@dataclass(frozen=True)
class Screening:
    """Result of the screening over series and columns: likelihood ratios at the best lag, sensitivities (um/K) there, family-wise p-values.

    ``half_width`` of the intervals that hold for all series and columns at once with 95 %: p is at most the level exactly where a
    sensitivity is larger. ``maxima`` (permutations, series) are the largest statistics; without permutations p and interval are NaN.
    """

    statistic: Array32
    lag_index: NDArray[np.int8]
    sensitivity: Array32
    sensitivity_u: Array32
    half_width: Array32
    maxima: Array
    p_value: Array32


@njit(nogil=True, fastmath={"nnan", "ninf", "nsz", "reassoc", "contract"})
def _largest(products: Array32, weight: Array32, largest: Array32) -> None:
    """Raise largest (rows,) to the rows' largest squared product (rows, columns) times the columns' weight."""
    rows, columns = products.shape
    for b in range(rows):
        best = largest[b]
        for j in range(columns):
            best = max(best, products[b, j] * products[b, j] * weight[j])
        largest[b] = best


@njit(nogil=True)
def _keep_best(
    product: Array32,
    weight: Array32,
    size: np.float32,
    lag: int,
    share: Array32,
    best_lag: NDArray[np.int8],
    coefficient: Array32,
    best_weight: Array32,
) -> None:
    """Keep this lag (of one series, along the columns) where it explains more than those before it."""
    for j in range(product.size):
        explained = product[j] * product[j] * weight[j]
        if explained > share[j]:
            share[j] = explained
            best_lag[j] = lag
            coefficient[j] = product[j] * weight[j] * size
            best_weight[j] = weight[j]


@threadpool_limits.wrap(limits=1, user_api="blas")
def screen(
    targets: TargetSeries,
    field: FieldSeries,
    excitation: Excitation,
    *,
    lags_s: Sequence[float] = LAGS_S,
    permutations: int = 999,
    rng: np.random.Generator,
) -> Screening:
    """Test every column of a field against every target and direction."""
    seconds = targets.seconds
    nuisance = nuisance_columns(seconds, excitation)
    present = np.isfinite(targets.values)
    # A missing value gets a variance that leaves it without weight, so that all series keep the same instants.
    variance = np.where(present, 1.0, _NO_WEIGHT)
    values = np.where(present, targets.values, np.nanmean(targets.values, axis=1, keepdims=True))
    grids: dict[bytes, Grid] = {}
    banks, groups = [], dict[tuple[int, bytes], list[int]]()
    for k, row in enumerate(values):
        pattern = present[k].tobytes()
        if pattern not in grids:
            grids[pattern] = whitening_grid(seconds, variance[k], nuisance)
        banks.append(fit_null(grids[pattern], row))
        groups.setdefault((banks[k].best, pattern), []).append(k)
    orders = np.argsort(rng.random((permutations, seconds.size)), axis=1)
    operators = [targets.sampling @ operator for operator in lag_operators(field.seconds, lags_s)]
    tasks = [_Group(banks, rows, orders, operators) for rows in groups.values()]
    columns = field.values.shape[1]
    result = _Result(present.sum(axis=1) - nuisance.shape[1], columns)
    values32 = field.values.astype(np.float32, copy=False)
    for start in range(0, columns, _TILE):
        tile = slice(start, min(start + _TILE, columns))
        for task in tasks:
            task.test(np.ascontiguousarray(values32[:, tile]), tile, result)
    return result.finish(tasks, permutations)


class _Group:
    """Series (k, n) that share one whitening, with their permutations (k * permutations, n), whitened and of length one.

    ``operators`` (lags, n, frames) lead from temperatures to whitened temperatures; ``size`` (k,) is the length of the series, um.
    """

    def __init__(
        self, banks: Sequence[NullBank], rows: list[int], orders: NDArray[np.int64], operators: Sequence[Array]
    ) -> None:
        null = banks[rows[0]].fitted
        self.rows = np.array(rows)
        residuals = np.stack([null.project @ banks[k].values for k in rows])
        self.size = np.sqrt((residuals**2).sum(axis=1))
        # A permuted series is coloured by the drift and fitted again, as the measured one was.
        again = (null.project @ null.colour).T
        drawn = np.concatenate([row[orders] @ again for row in residuals])
        length = np.sqrt((drawn**2).sum(axis=1))
        self.residuals = (residuals / self.size[:, None]).astype(np.float32)
        self.permuted = (drawn / np.maximum(length, 1e-300)[:, None]).astype(np.float32)
        self.operators = np.stack([null.project @ operator for operator in operators]).astype(np.float32)
        #: Largest share of explained squares of every permutation.
        self.maxima = np.zeros(self.permuted.shape[0], np.float32)

    def test(self, values: Array32, tile: slice, result: _Result) -> None:
        """Test one tile of temperatures (frames, columns) under all lags, for all series and permutations."""
        for lag, operator in enumerate(self.operators):
            white = operator @ values
            square = np.einsum("ij,ij->j", white, white)
            weight = np.where(square > 0, 1.0 / np.where(square > 0, square, 1.0), 0.0).astype(np.float32)
            product = self.residuals @ white
            for row, (k, size) in enumerate(zip(self.rows, self.size, strict=True)):
                _keep_best(product[row], weight, np.float32(size), lag, *result.of(k, tile))
            for start in range(0, self.permuted.shape[0], _ROWS):
                part = slice(start, start + _ROWS)
                _largest(self.permuted[part] @ white, weight, self.maxima[part])


class _Result:
    """Running best lag as squared correlations of whitened series, (series, columns)."""

    def __init__(self, freedom: NDArray[np.int64], columns: int) -> None:
        shape = (freedom.size, columns)
        self.freedom, self.lag = freedom, np.zeros(shape, np.int8)
        self.share, self.coefficient, self.weight = (np.zeros(shape, np.float32) for _ in range(3))

    def of(self, series: int, tile: slice) -> tuple[NDArray[Any], ...]:
        """What is kept of one series in a tile, to be written."""
        return tuple(kept[series, tile] for kept in (self.share, self.lag, self.coefficient, self.weight))

    def finish(self, groups: Sequence[_Group], permutations: int) -> Screening:
        """Turn shares of explained squares into likelihood ratios, and compare them with the maxima over all series."""
        share = np.minimum(self.share, _MOST_EXPLAINED)
        statistic = _target_log_ratio(share, self.freedom[:, None])
        shares = np.zeros((permutations, self.freedom.size))
        size = np.zeros(self.freedom.size)
        for group in groups:
            size[group.rows] = group.size
            shares[:, group.rows] = group.maxima.reshape(group.rows.size, permutations).T
        maxima = _target_log_ratio(np.minimum(shares, _MOST_EXPLAINED), self.freedom[None, :])
        p_value, threshold = np.full(statistic.shape, np.nan, np.float32), np.nan
        if permutations:
            largest = np.sort(maxima.max(axis=1))
            p_value, threshold = monte_carlo_p(statistic, largest).astype(np.float32), _limit(largest)
        spread = np.sqrt((1.0 - share) * self.weight) * size[:, None]
        u = spread / np.sqrt(self.freedom - 1)[:, None]
        half = spread * np.sqrt(np.expm1(threshold / self.freedom))[:, None]
        found = (self.coefficient, u.astype(np.float32), half.astype(np.float32))
        return Screening(statistic.astype(np.float32), self.lag, *found, maxima, p_value)


def _target_log_ratio(share: Array | Array32, freedom: NDArray[np.int64]) -> Array:
    """Likelihood ratios from shares of explained squares."""
    return np.asarray(-freedom * np.log1p(-share), float)
