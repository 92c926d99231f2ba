"""Generalised least squares under a drift that wanders in real time.

Readings ``y`` at irregular times are explained by fixed effects and by a few drift components, each a random walk or an
integrated random walk, which enter every reading with a known loading::

    y_k = x_k' beta + sum_c loading_kc * d_c(t_k) + e_k        e_k ~ N(0, sigma^2 * v_k)

The noise e may have a memory: a part of it with an exponential correlation in time, as turbulent air along a laser's beam makes it.

For a positioning test the components are a common shift (loading 1) and a stretch (loading = position); for a record of several
displacement channels there is one component per channel. All components start at zero: their start is a fixed effect, and
:func:`~interferometry.drift.kalman.start_columns` gives the columns that a design must span for that. The variances of the
drift are estimated by restricted maximum likelihood; one likelihood costs O(n) in the number of readings.

In this order: the fit under given variances; the search for the variances; the average of a drift over its readings, with its
covariance; a test of serial dependence.

Sources: Harvey (1989), *Forecasting, structural time series models and the Kalman filter*; Durbin and Koopman (2012), *Time series
analysis by state space methods*, 2nd ed., chapter 4 (filter and smoother) and section 7.2 (likelihood); Patterson and Thompson (1971),
Biometrika 58, 545 (restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from interferometry.common import Array
from interferometry.drift.kalman import (
    MANY_COLUMNS,
    DriftModelError,
    DriftSystem,
    Memory,
    Order,
    Smoothed,
    drift_system,
    innovation_variance,
    predict_covariance,
    predict_state,
    start_columns,
    start_covariance,
    sweep,
    update_covariance,
    update_state,
)
from thermofuse.compiled import njit

#: Search limits of log10(process noise over reading variance) of either order, in units that make the drift of one hour comparable to the
#: noise of one reading: from a drift far below the noise to one that hides everything else. A random walk that is a hundred times the noise
#: passes for noise itself; an integrated one stays smooth, and a good laser reads 10 nm with 100 um of drift.
_LOG_RATIO_LIMITS: dict[Order, tuple[float, float]] = {1: (-14.0, 4.0), 2: (-14.0, 8.0)}
#: A drift within so many decades of a limit, and a log-likelihood that is lower by less (chi-squared, 95 %), cannot be told from it.
_NEAR_LIMIT, _AS_LIKELY = 1.5, 1.92
#: What a search takes for minus the log-likelihood where there is no model, per decade of drift.
_NO_MODEL = 1e20
#: How far a search goes before it looks again, its step for a gradient, and the least drift at which it starts, decades.
_BOX, _STEP, _LEAST_START = 1.5, 1e-3, -3.0
#: A search goes on to another box where the last one raised the log-likelihood by at least this much, through so many at most.
_LEAST_RISE, _MOST_BOXES = 0.01, 12
#: A reading whose deletion residual exceeds this many standard deviations is down-weighted (robust fit).
_OUTLIER_LIMIT = 3.0
#: Multiple of that limit beyond which no residual is distinguished from a larger one.
_LARGEST_EXCESS = 1e6
#: A whitened column is collinear with those before it where they leave less than this share of its squared length unexplained.
_DEPENDENCE_TOLERANCE = 1e-10
#: Share of the whitened response's square that each degree of freedom loses to rounding in its sums.
_ROUNDING = float(np.finfo(float).eps)
#: Values of parts of the coefficients' uncertainty that are smoothed together, 16 MB: their states at all readings are held.
_SHARED_VALUES = 2**21
#: Columns that fewer than this share of the readings have are few enough for their own recursion.
_FEW_READINGS = 0.1
#: Sites of single fixed effects that take part in the search for the variances of the drift at most, and at least where fewer have
#: enough readings for its variances to 7 %.
_MOST_SITES, _LEAST_SITES, _ENOUGH_READINGS = 160, 40, 10_000
#: The drift is taken as an integrated random walk only if that raises the restricted log-likelihood by this much: where both fit,
#: the random walk is the safer nuisance, because it extrapolates less.
_SMOOTH_MARGIN = 2.0
#: Process noise that settles has two parameters more; by the Bayesian information criterion they have to raise the log-likelihood of
#: some thousand readings by 8.
_SETTLING_MARGIN = 8.0
#: First guess of the settling time as a share of the test, and its search limits: less than a hundredth concerns a cycle or two.
_SETTLING_SHARE, _SETTLING_LIMITS = 1.0 / 15.0, (1.0 / 100.0, 1.0)
#: Largest exponent of the settling.
_FASTEST_SETTLING = 6.0
#: Correlation times of the noise at which a search starts, and its limits, in median times between readings: what lasts longer than a
#: pass is a drift. Shares of the variance at which it starts, and their limits.
_MEMORY_TIMES, _MEMORY_TIME_LIMITS = (1.0, 2.0, 4.0), (0.3, 10.0)
_MEMORY_SHARES, _MEMORY_SHARE_LIMITS = (0.3, 0.8), (0.0, 0.98)
#: Where the memory is not in the model the drift stands in for it: the search starts from so many decades less of drift, too.
_LESS_DRIFT = (0.0, -2.0, -4.0)
#: The memory has two parameters more, as the settling.
_MEMORY_MARGIN = 8.0
#: Autocorrelations by which innovations are tested, and the level above which they are white and need no memory.
_WHITE_LAGS, _WHITE_LEVEL = 6, 0.05
#: Searches of the variances after the first one, and re-weightings before each, of a robust fit.
_ROBUST_ROUNDS = 2
_ROBUST_PASSES = 3
#: Shortest series whose von Neumann ratio may be taken as normally distributed.
_SHORTEST_SERIES = 8


@dataclass(frozen=True)
class DriftFit:
    """A generalised least-squares fit under a drift system.

    Attributes
    ----------
    system : with the estimated variance ratios, and the variances of down-weighted readings
    response : (n,), readings, in the order of time
    design : (n, p), the caller's columns, then the rate columns of an integrated random walk
    coefficients : (p,), in the response's unit per unit of the column
    covariance : (p, p), of the coefficients
    sigma : standard deviation of one ordinary reading (relative variance 1), in the response's unit
    log_likelihood : restricted log-likelihood; comparable only between fits with the same design
    rss : whitened residual sum of squares
    """

    system: DriftSystem
    response: Array
    design: Design
    coefficients: Array
    covariance: Array
    sigma: float
    log_likelihood: float
    rss: float

    @property
    def coefficients_u(self) -> Array:
        """Standard uncertainty of the coefficients, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def noise_hidden(self) -> bool:
        """Whether a drift hides the noise: that it is as large as a search allows is as likely, so that nothing tells `sigma`."""
        limit = _log_ratio_unit(self.system) + _LOG_RATIO_LIMITS[self.system.order][1]
        near = np.log10(np.maximum(self.system.ratios, 1e-300)) > limit - _NEAR_LIMIT
        if not near.any():
            return False
        at_limit = replace(self.system, ratios=np.where(near, 10.0**limit, self.system.ratios))
        likelihood = _log_likelihood(at_limit, _Problem.of(self.response, self.design))
        return likelihood > self.log_likelihood - _AS_LIKELY

    @property
    def drift_rate(self) -> Array:
        """Standard deviation of each drift component's increment over one hour (order 1), in the response's unit."""
        scale, power = (1.0, 1.0) if self.system.order == 1 else (1.0 / 3.0, 3.0)
        return self.sigma * np.sqrt(self.system.ratios * scale * 3600.0**power)

    def residual(self) -> Array:
        """Response minus fixed effects, drift included, (n,)."""
        return self.response - self.design @ self.coefficients

    @cached_property
    def smoothed(self) -> Smoothed:
        """What all readings say of the drift at each of them: the residual, smoothed."""
        return self.system.smooth(self.residual()[:, None])

    def shares(self) -> Iterator[tuple[Array, Smoothed]]:
        """Parts (p, some) of the coefficients' uncertainty that are independent, of unit variance, and what is smoothed of each."""
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        at_once = max(1, _SHARED_VALUES // self.response.size)
        for start in range(0, root.shape[1], at_once):
            some = root[:, start : start + at_once]
            yield some, self.system.smooth(self.design @ some)

    def noise(self) -> tuple[Array, Array]:
        """Each reading's estimated noise (n,) and its relative variance (n,): sum(noise^2) / sum(variance) estimates sigma^2."""
        return self.system.independent * self.smoothed.u[:, 0], self.system.independent**2 * self.smoothed.D

    def whole_noise(self) -> tuple[Array, Array]:
        """What the drift leaves of each reading, with what it shares with others (n,), and the variance of that drift in sigma^2 (n,)."""
        loadings, smoothed = self.system.loadings, self.smoothed
        drift = np.einsum("nc,nc->n", loadings, smoothed.levels[:, :, 0])
        return self.residual() - drift, np.einsum("nc,ncd,nd->n", loadings, smoothed.level_covariance, loadings)

    def innovations(self) -> Array:
        """Each observed reading minus its prediction from those before it, in standard deviations of the prediction."""
        return np.asarray(self.system.whiten(self.residual()[:, None])[0][:, 0] / self.sigma)

    def white_noise(self) -> Array:
        """Noise of every reading in standard deviations, without the part that it shares with others (n,)."""
        if self.system.memory is not None:
            # Estimates from all readings are correlated where the noise has a memory; errors of predicting from those before are not.
            return self.innovations()
        noise, share = self.noise()
        return np.asarray(noise / (self.sigma * np.sqrt(np.maximum(share, 1e-12))))

    def deletion_residuals(self, least_sigma: float = 0.0) -> Array:
        """Each reading minus its prediction from all others, in standard deviations of an ordinary reading, of at least ``least_sigma``
        (n,); NaN if not observed.
        """
        smoothed = self.smoothed
        with np.errstate(divide="ignore", invalid="ignore"):
            ordinary = 1.0 / smoothed.D + (1.0 - self.system.variance) * self.system.independent / self.system.variance
            standardised = (smoothed.u[:, 0] / smoothed.D) / (max(self.sigma, least_sigma) * np.sqrt(ordinary))
        return np.where(smoothed.D > 0, standardised, np.nan)


def fit_fixed_effects(system: DriftSystem, response: Array, design: Design) -> DriftFit:
    """Fit fixed effects by generalised least squares, the system's variance ratios as given."""
    return _solve(system, _Problem.of(response, design))


def log_likelihoods(fit: DriftFit, ratios: Array) -> Array:
    """Restricted log-likelihoods (k,) of the same readings and fixed effects under other variance ratios (k, components)."""
    problem = _Problem.of(fit.response, fit.design)
    return np.array([_solve(replace(fit.system, ratios=tried), problem).log_likelihood for tried in ratios])


#: Columns of a design; those of very many sites are held by the readings that have them.
Design: TypeAlias = "Array | scipy.sparse.csr_array"


def _beside(design: Design, columns: Array) -> Design:
    """Return a design with further columns."""
    if scipy.sparse.issparse(design):
        return scipy.sparse.csr_array(scipy.sparse.hstack([design, columns]))
    return np.column_stack([design, columns])


def _dense(design: Design) -> Array:
    return design if isinstance(design, np.ndarray) else np.asarray(design.toarray())


@dataclass(frozen=True)
class _Problem:
    """Response and design of a search, checked once: ``columns`` holds both, or the dense ones of both where many columns are of ``few``
    readings; by ``place`` (1 + p,) among dense and few. ``least`` (p,) is the whitened length of a vanishing column.
    """

    response: Array
    design: Design
    columns: Array
    few: scipy.sparse.csr_array | None
    place: NDArray[np.int64]
    least: Array

    @classmethod
    def of(cls, response: Array, design: Design) -> _Problem:
        few, place = None, np.arange(1 + design.shape[1])
        own = place[:0]
        if design.shape[1] >= MANY_COLUMNS:
            by_column = scipy.sparse.csc_array(design)
            own = np.flatnonzero(np.diff(by_column.indptr) < _FEW_READINGS * design.shape[0])
        if own.size >= MANY_COLUMNS:
            others = np.setdiff1d(place[:-1], own)
            columns = np.column_stack([response, by_column[:, others].toarray()])
            few = scipy.sparse.csr_array(by_column[:, own])
            place[np.r_[0, 1 + others, 1 + own]] = np.arange(place.size)
        else:
            columns = np.column_stack([response, _dense(design)])
        if not (np.isfinite(columns).all() and (few is None or np.isfinite(few.data).all())):
            raise DriftModelError(
                "response and design must be finite; leave readings without a value out before the fit"
            )
        largest = np.abs(columns).max(axis=0, initial=0.0)
        if few is not None:
            largest = np.concatenate([largest, np.abs(few).max(axis=0).toarray().ravel()])
        return cls(response, design, columns, few, place, 1e-12 * np.maximum(1.0, largest[place][1:]))

    def normal_equations(self, system: DriftSystem) -> tuple[Array, float]:
        """Gram matrix of the whitened response and design, and the log-determinant of the readings' covariance."""
        if self.few is None:
            return system.normal_equations(self.columns)
        gram, log_determinant = system.sparse_normal_equations(self.columns, self.few)
        return gram[np.ix_(self.place, self.place)], log_determinant


def _solve(system: DriftSystem, problem: _Problem) -> DriftFit:
    """Least squares on the swept Gram matrix, and the restricted log-likelihood with sigma^2 concentrated out."""
    gram, log_determinant = problem.normal_equations(system)
    scale = np.sqrt(np.diag(gram)[1:])
    vanishing = np.flatnonzero(scale < problem.least)
    if vanishing.size:
        raise DriftModelError(f"columns {vanishing.tolist()} of the design vanish; leave them out")
    scale_all = np.concatenate([[1.0], scale])
    swept, log_normal, dependent = _sweep(gram / np.outer(scale_all, scale_all))
    if dependent >= 0:
        raise DriftModelError(f"column {dependent} of the design depends linearly on those before it; leave it out")
    freedom = int(system.observed.sum()) - scale.size
    if freedom <= 0:
        raise DriftModelError(
            f"{freedom + scale.size} readings cannot determine {scale.size} coefficients; measure more cycles"
        )
    # What is left below the rounding of the sums is not known: taken for nothing, it would be of infinite likelihood.
    rss = max(float(swept[0, 0]), freedom * _ROUNDING * float(gram[0, 0]))
    sigma2 = rss / freedom
    log_normal += 2.0 * float(np.log(scale).sum())
    log_likelihood = -0.5 * (freedom * np.log(max(sigma2, 1e-300)) + log_determinant + log_normal)
    return DriftFit(
        system,
        problem.response,
        problem.design,
        coefficients=swept[1:, 0] / scale,
        covariance=sigma2 * swept[1:, 1:] / np.outer(scale, scale),
        sigma=float(np.sqrt(sigma2)),
        log_likelihood=float(log_likelihood),
        rss=rss,
    )


def _sweep(gram: Array) -> tuple[Array, float, int]:
    """Sweep a scaled Gram matrix as `sweep` does; one of many columns by its Cholesky factor, which takes a tenth of the time."""
    if gram.shape[0] >= MANY_COLUMNS:
        lower, failed = scipy.linalg.lapack.dpotrf(gram[1:, 1:], lower=1)
        pivots = np.diag(lower) ** 2
        if not failed and pivots.min() >= _DEPENDENCE_TOLERANCE:
            inverse, _ = scipy.linalg.lapack.dpotri(lower, lower=1)
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
            along = scipy.linalg.solve_triangular(lower, gram[1:, 0], lower=True)
            swept = np.empty_like(gram)
            swept[0, 0], swept[0, 1:], swept[1:, 1:] = gram[0, 0] - along @ along, 0.0, inverse
            swept[1:, 0] = scipy.linalg.solve_triangular(lower, along, lower=True, trans="T")
            return swept, float(np.log(pivots).sum()), -1
    return sweep(gram, _DEPENDENCE_TOLERANCE)


def _maximise(system: DriftSystem, response: Array, design: Design, start: Array | None) -> DriftFit:
    """Restricted maximum likelihood of the variance ratios by quasi-Newton steps in their logarithm (L-BFGS-B)."""
    problem = _Problem.of(response, design)
    searched, few = _for_search(system, problem, _ENOUGH_READINGS)
    unit = _log_ratio_unit(system)
    low, high = (np.full(unit.size, limit) for limit in _LOG_RATIO_LIMITS[system.order])

    def ratios(log_ratio: Array) -> Array:
        return np.asarray(10.0 ** (unit + np.clip(log_ratio, low, high)))

    def likelihood(log_ratio: Array) -> float:
        return _log_likelihood(replace(searched, ratios=ratios(log_ratio)), few)

    # Far below the noise the likelihood is level, and no gradient leads back.
    given = 0.0 if start is None else np.maximum(np.log10(np.maximum(start, 1e-300)) - unit, _LEAST_START)
    best, _ = _search(likelihood, np.clip(given, low, high), low, high)
    return _solve(replace(system, ratios=ratios(best)), problem)


def _search(likelihood: Callable[[Array], float], start: Array, low: Array, high: Array) -> tuple[Array, float]:
    """Return where a log-likelihood is largest between limits, and its value there, by quasi-Newton steps (L-BFGS-B)."""

    def cost(x: Array) -> float:
        found = -likelihood(x)
        # Less drift is nearer to a model.
        return found if np.isfinite(found) else _NO_MODEL * 2.0 ** float((x - start).sum())

    def with_gradient(x: Array) -> tuple[float, Array]:
        here, step = cost(x), np.where(x + _STEP > high, -_STEP, _STEP)
        return here, np.array([cost(x + one) - here for one in np.diag(step)]) / step

    best, least = start, np.inf
    # A first step as long as a gradient makes it would end where the likelihood is level: the search moves on box by box.
    for _ in range(_MOST_BOXES):
        box = np.maximum(best - _BOX, low), np.minimum(best + _BOX, high)
        optimum = scipy.optimize.minimize(
            with_gradient,
            best,
            jac=True,
            method="L-BFGS-B",
            bounds=[*zip(*box, strict=True)],
            options={"ftol": 1e-7, "gtol": 0.02},
        )
        best, before, least = optimum.x, least, optimum.fun
        at_edge = (best <= box[0]) & (box[0] > low) | (best >= box[1]) & (box[1] < high)
        if not at_edge.any() or before - least < _LEAST_RISE:
            break
    return best, -least


def _log_likelihood(system: DriftSystem, problem: _Problem) -> float:
    """Restricted log-likelihood; -inf where a drift far out in a search hides a column, or everything: no model there."""
    try:
        return _solve(system, problem).log_likelihood
    except DriftModelError:
        return -np.inf


def _log_ratio_unit(system: DriftSystem) -> Array:
    """Logarithm of the ratio of each component at which its drift over one hour is comparable to the noise of one reading."""
    return np.log10(1.0 / 3600.0 ** (1.0 if system.order == 1 else 3.0)) - 2 * np.log10(
        np.maximum(np.abs(system.loadings).max(axis=0), 1e-12)
    )


def _for_search(system: DriftSystem, problem: _Problem, enough: int | None = None) -> tuple[DriftSystem, _Problem]:
    """Return the readings by which the variances of the drift are searched for: all, or those of some of very many sites."""
    if problem.design.shape[1] <= _LEAST_SITES:
        return system, problem
    by_column = scipy.sparse.csc_array(problem.design)
    own = scipy.sparse.csr_array(by_column[:, np.diff(by_column.indptr) < problem.design.shape[0] / _LEAST_SITES])
    each = system.seconds.size / max(own.shape[1], 1)
    most = _MOST_SITES if enough is None else int(np.clip(enough / each, _LEAST_SITES, _MOST_SITES))
    if own.shape[1] <= most:
        return system, problem
    own.sort_indices()
    site = np.full(own.shape[0], -1)
    has_one = np.diff(own.indptr) > 0
    site[has_one] = own.indices[own.indptr[:-1][has_one]]
    sites = np.unique(site)
    chosen = sites[np.round(np.linspace(0, sites.size - 1, most)).astype(int)]
    rows = np.isin(site, chosen)
    design = problem.design[rows]
    design = design[:, abs(design).sum(axis=0) > 0]
    few = replace(
        system,
        seconds=system.seconds[rows],
        loadings=system.loadings[rows],
        variance=system.variance[rows],
        observed=system.observed[rows],
        process_noise_scale=None if system.process_noise_scale is None else system.process_noise_scale[rows],
    )
    return few, _Problem.of(problem.response[rows], design)


def settling_noise_scale(seconds: Array, time_s: float, exponent: float) -> Array:
    """Return a process-noise scale that falls from 1 as a power of the time since the first reading, as in a warm-up."""
    return (1.0 + (seconds - seconds[0]) / time_s) ** -exponent


def _fit_settling(fit: DriftFit) -> DriftFit:
    """Return the fit with larger process noise at the start, if that raises the restricted log-likelihood by at least 8."""
    system, problem = fit.system, _Problem.of(fit.response, fit.design)
    span = float(system.seconds[-1] - system.seconds[0])
    searched, few = _for_search(system, problem)
    constant = fit.log_likelihood if few is problem else _solve(searched, few).log_likelihood
    components = system.ratios.size
    # Of the mean over the test; with a little room, so that a fit at the limit can settle at all.
    low, high = (limit + _log_ratio_unit(system) for limit in _LOG_RATIO_LIMITS[system.order])
    limits = [
        *zip(low, high + 0.01, strict=True),
        np.log10(span * np.array(_SETTLING_LIMITS)),
        (0.0, _FASTEST_SETTLING),
    ]

    def settling(x: Array, seconds: Array) -> Array:
        return settling_noise_scale(seconds, 10.0 ** x[-2], x[-1])

    def at_start(x: Array) -> Array:
        return np.asarray(10.0 ** x[:components] / settling(x, searched.seconds).mean())

    def likelihood(x: Array) -> float:
        scale = settling(x, searched.seconds)
        return _log_likelihood(replace(searched, ratios=at_start(x), process_noise_scale=scale), few)

    starts = [np.r_[np.log10(system.ratios), np.log10(_SETTLING_SHARE * span), exponent] for exponent in (1.0, 2.0)]
    likely = [likelihood(start) for start in starts]
    if max(likely) < constant:
        return fit
    best, largest = _search(likelihood, starts[int(np.argmax(likely))], *np.array(limits).T)
    if largest < constant + _SETTLING_MARGIN:
        return fit
    # By all components together: one that hardly moves may have any size.
    unit = 10.0 ** _log_ratio_unit(system)
    start_scale = float((at_start(best) / unit).sum() / (system.ratios / unit).sum())
    scale = np.maximum(1.0, start_scale * settling(best, system.seconds))
    return _solve(replace(system, process_noise_scale=scale), problem)


def _is_white(innovations: Array) -> bool:
    """Whether the first autocorrelations of innovations are those of white noise (Ljung and Box 1978, Biometrika 65, 297)."""
    n = innovations.size
    if n <= 2 * _WHITE_LAGS:
        return True
    # A few readings far from the others would hide what all share.
    centred = np.clip(innovations, -_OUTLIER_LIMIT, _OUTLIER_LIMIT)
    centred = centred - centred.mean()
    lagged = np.array([centred[lag:] @ centred[:-lag] for lag in range(1, _WHITE_LAGS + 1)]) / (centred @ centred)
    statistic = n * (n + 2.0) * float((lagged**2 / (n - np.arange(1.0, _WHITE_LAGS + 1))).sum())
    return bool(scipy.special.chdtrc(_WHITE_LAGS, statistic) > _WHITE_LEVEL)


def _fit_memory(fit: DriftFit) -> DriftFit:
    """Return the fit with noise that neighbouring readings share, if that raises the restricted log-likelihood by at least 8."""
    system, problem = fit.system, _Problem.of(fit.response, fit.design)
    between_s = float(np.median(np.diff(system.seconds)))
    if between_s <= 0.0 or _is_white(fit.innovations()):
        return fit
    searched, few = _for_search(system, problem)
    constant = fit.log_likelihood if few is problem else _solve(searched, few).log_likelihood
    low, high = (limit + _log_ratio_unit(system) for limit in _LOG_RATIO_LIMITS[system.order])
    bounds = np.array([*zip(low, high, strict=True), _MEMORY_SHARE_LIMITS, np.log10(_MEMORY_TIME_LIMITS)])

    def with_memory(x: Array, over: DriftSystem) -> DriftSystem:
        share, time_s = float(np.clip(x[-2], *_MEMORY_SHARE_LIMITS)), between_s * 10.0 ** float(x[-1])
        return replace(over, ratios=10.0 ** np.clip(x[:-2], low, high), memory=Memory(share, time_s))

    def likelihood(x: Array) -> float:
        return _log_likelihood(with_memory(x, searched), few)

    drift = np.log10(np.maximum(system.ratios, 1e-300))
    starts = [
        np.r_[np.clip(drift + less, low, high), share, np.log10(time)]
        for less in _LESS_DRIFT
        for share in _MEMORY_SHARES
        for time in _MEMORY_TIMES
    ]
    likely = [likelihood(start) for start in starts]
    guess = starts[int(np.argmax(likely))]
    # The search gains some units over the best start at most; without a start near the margin there is nothing to find.
    if max(likely) < constant:
        return fit
    best, largest = _search(likelihood, guess, *bounds.T)
    if largest < constant + _MEMORY_MARGIN:
        return fit
    return _solve(with_memory(best, system), problem)


def estimate(
    seconds: Array,
    loadings: Array,
    response: Array,
    design: Design,
    *,
    order: Order | None = None,
    robust: bool = False,
    settling: bool = False,
    memory: bool = False,
    start: Array | None = None,
    observed: NDArray[np.bool_] | None = None,
    variance: Array | None = None,
    least_sigma: float = 0.0,
) -> DriftFit:
    """Fit fixed effects and the variances of the drift together by restricted maximum likelihood; no reading is an outlier by less than
    ``least_sigma`` lets it be.
    """
    trends = start_columns(seconds, loadings, 2)[:, loadings.shape[1] :]
    with_trends = _beside(design, trends)

    def system(chosen: Order, ratios: Array) -> DriftSystem:
        return drift_system(seconds, loadings, order=chosen, ratios=ratios, variance=variance, observed=observed)

    neutral, found = np.ones(loadings.shape[1]), None
    if order is None:
        walk = _maximise(system(1, neutral), response, with_trends, None)
        smooth = _maximise(system(2, neutral), response, with_trends, None)
        # A search can lose a component on its way: where the smooth drift is likelier by the sizes that the walk has, it starts there.
        as_walk = 10.0 ** (np.log10(walk.system.ratios) - _log_ratio_unit(walk.system) + _log_ratio_unit(smooth.system))
        if _log_likelihood(system(2, as_walk), _Problem.of(response, with_trends)) > smooth.log_likelihood:
            again = _maximise(system(2, neutral), response, with_trends, as_walk)
            smooth = max((smooth, again), key=lambda fit: fit.log_likelihood)
        order, start = 1, walk.system.ratios
        if smooth.log_likelihood > walk.log_likelihood + _SMOOTH_MARGIN:
            order, found = 2, smooth
    columns = design if order == 1 else with_trends
    fit = found or _maximise(system(order, neutral), response, columns, start)
    if robust:
        for _ in range(_ROBUST_ROUNDS):
            for _ in range(_ROBUST_PASSES):
                # Relative variances (n,) under which a reading far from the others is down-weighted (redescending weight function).
                # Where the others leave no scatter an outlier is any multiple of it; the square of that has to stay a number.
                deletion = np.abs(np.nan_to_num(fit.deletion_residuals(least_sigma)))
                excess = np.minimum(deletion / _OUTLIER_LIMIT, _LARGEST_EXCESS)
                fit = fit_fixed_effects(
                    replace(fit.system, variance=np.where(excess > 1.0, excess**2, 1.0)), response, columns
                )
            if (fit.system.variance == 1.0).all():
                break
            fit = _maximise(fit.system, response, columns, fit.system.ratios)
    if memory:
        fit = _fit_memory(fit)
    return _fit_settling(fit) if settling else fit


def average_drift(system: DriftSystem, weights: Array, columns: Design) -> tuple[Array, Array, Array]:
    """Average the drift that columns imply over the readings, with the exact covariance of the average, in two passes."""
    weights = np.ascontiguousarray(weights, float)
    averages = []
    for start in range(0, columns.shape[1], MANY_COLUMNS):
        some = np.ascontiguousarray(_dense(columns[:, start : start + MANY_COLUMNS]), float)
        state, covariance, predicted, gains = _filter_with_average(*system.arrays, weights, some)
        averages.append(state[covariance.shape[0] - system.loadings.shape[1] :])
    m = covariance.shape[0] - system.loadings.shape[1]
    with_drift = _covariance_with_average(
        system.seconds, system.loadings, system.order, system.memory_array, weights, predicted, gains
    )
    return np.hstack(averages), covariance[m:, m:], with_drift


@njit()
def _filter_with_average(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    memory: Array,
    process_noise_scale: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    weights: Array,
    columns: Array,
) -> tuple[Array, Array, Array, Array]:
    """Filter with the average as part of the state."""
    n, components = loadings.shape
    covariance = start_covariance(components * order, memory, components)
    size = covariance.shape[0]
    m = size - components
    state = np.zeros((size, columns.shape[1]))
    cross_covariance, innovation = np.zeros(size), np.empty(columns.shape[1])
    predicted = np.zeros((n, components, size))
    gains = np.zeros((n, size))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict_state(state, components, order, memory, step)
        predict_covariance(covariance, order, ratios, memory, process_noise_scale[k], step)
        for c in range(components):
            for i in range(size):
                predicted[k, c, i] = covariance[c * order, i]
        if observed[k]:
            total = innovation_variance(covariance, order, loadings, k, memory, variance[k], cross_covariance)
            update_covariance(covariance, cross_covariance, total)
            for i in range(size):
                gains[k, i] = cross_covariance[i] / total
            update_state(state, order, loadings, k, memory, columns[k], gains[k], innovation)
        if weights[k] != 0.0:
            for c in range(components):
                for j in range(columns.shape[1]):
                    state[m + c, j] += weights[k] * state[c * order, j]
                for i in range(size):
                    covariance[m + c, i] += weights[k] * covariance[c * order, i]
                for i in range(size):
                    covariance[i, m + c] += weights[k] * covariance[i, c * order]
    return state, covariance, predicted, gains


@njit()
def _covariance_with_average(
    seconds: Array, loadings: Array, order: int, memory: Array, weights: Array, predicted: Array, gains: Array
) -> Array:
    """Covariance (n, components, components) of the drift at every reading with the average, in units of sigma^2."""
    n, components = loadings.shape
    last = components * order
    m = last + (1 if memory.size else 0)
    size = m + components
    with_drift = np.zeros((n, components, components))
    onward = np.zeros((components, size))
    for c in range(components):
        onward[c, m + c] = 1.0
    for k in range(n - 1, -1, -1):
        step = seconds[k + 1] - seconds[k] if k < n - 1 else 0.0
        if memory.size:
            for i in range(components):
                onward[i, last] *= np.exp(-step / memory[1])
        if order == 2:
            for c in range(components):
                for i in range(components):
                    onward[i, 2 * c + 1] += step * onward[i, 2 * c]
        for i in range(components):
            effect_of_innovation = 0.0
            for c in range(components):
                onward[i, c * order] += weights[k] * onward[i, m + c]
            for j in range(size):
                effect_of_innovation += onward[i, j] * gains[k, j]
            for c in range(components):
                onward[i, c * order] -= effect_of_innovation * loadings[k, c]
            if memory.size:
                onward[i, last] -= effect_of_innovation
        for c in range(components):
            for i in range(components):
                for j in range(size):
                    with_drift[k, c, i] += predicted[k, c, j] * onward[i, j]
    return with_drift


def von_neumann_p_value(series: Array) -> float:
    """Return the one-sided p-value of positive serial dependence by the von Neumann ratio; 1 for a constant or too short series.

    The ratio is the sum of the squared successive differences over the sum of squares about the mean. Under independence its expectation
    is 2 and its variance 4 (n - 2) / (n^2 - 1) (von Neumann 1941, Ann. Math. Stat. 12, 367); a normal distribution is used.
    """
    n = series.size
    if n < _SHORTEST_SERIES or np.ptp(series) == 0:
        return 1.0
    centred = series - series.mean()
    ratio = float((np.diff(series) ** 2).sum() / (centred**2).sum())
    deviation = np.sqrt(4.0 * (n - 2.0) / (n**2 - 1.0))
    return float(scipy.special.ndtr((ratio - 2.0) / deviation))


# Memory of the noise over the cycles that all positions have alike.

#: Largest order of the autoregression.
MOST_MEMORY_CYCLES = 3


@dataclass(frozen=True)
class Autoregression:
    """Autoregression over the cycles.

    Attributes
    ----------
    weights : (order,), of the values one, two, ... cycles before; empty for noise without memory.
    innovation_share : variance of the innovations over that of the series, 1 without memory
    """

    weights: Array
    innovation_share: float

    @property
    def long_run(self) -> float:
        """Variance of a mean over many cycles, over that of independent values with the same scatter."""
        return self.innovation_share / (1.0 - float(self.weights.sum())) ** 2

    def innovations(self, values: Array) -> Array:
        """Take the memory from series."""
        order = self.weights.size
        if not order:
            return values
        whitened = values.copy()
        for lag, weight in enumerate(self.weights, start=1):
            whitened[:, lag:] -= weight * values[:, :-lag]
        whitened[:, :order] = values[:, :order] * np.sqrt(self.innovation_share)
        return np.asarray(whitened - whitened.mean(axis=1, keepdims=True))

    def with_memory(self, white: Array) -> Array:
        """Give white series (cycles, series) this memory, their variance kept."""
        made = np.sqrt(self.innovation_share) * white
        for cycle in range(1, len(made)):
            for lag, weight in enumerate(self.weights[:cycle], start=1):
                made[cycle] += weight * made[cycle - lag]
        return np.asarray(made)


NO_MEMORY = Autoregression(np.empty(0), 1.0)
#: Patterns of a motion in common that are taken from series before their own memory is estimated.
_COMMON_PATTERNS = 2
#: Memories from one cycle to the next that are simulated, so often, to learn what the patterns and the means take of them.
_SIMULATED_MEMORY, _SIMULATIONS = np.linspace(0.0, 0.9, 10), 20
#: Standard deviations by which an estimate must exceed what independent noise gives.
_LEAST_MEMORY = 3.0


def memory_of_each(values: Array) -> Autoregression:
    """Estimate the memory from one cycle to the next that series (series, cycles) have alike and each by itself.

    What series do together is a motion and no noise: their leading patterns are taken out first. That takes slow noise, too, and a short
    series knows its mean badly; simulated series of the same shape tell how much (indirect inference).
    """
    if min(values.shape) <= 4 * _COMMON_PATTERNS:
        return NO_MEMORY
    measured, independent = _lag_one(values), _lag_one_by_memory(*values.shape, 1)[0]
    if measured < independent.mean() + _LEAST_MEMORY * independent.std(ddof=1):
        return NO_MEMORY
    estimates = _lag_one_by_memory(*values.shape, _SIMULATED_MEMORY.size)
    weight = float(np.interp(measured, np.maximum.accumulate(estimates.mean(axis=1)), _SIMULATED_MEMORY))
    return Autoregression(np.array([weight]), 1.0 - weight**2)


@lru_cache(maxsize=8)
def _lag_one_by_memory(series: int, cycles: int, memories: int) -> Array:
    """What is estimated of the first simulated memories, (memories, simulations); of one campaign all fits ask for the same shapes."""
    rng = np.random.default_rng(0)
    estimates = np.empty((memories, _SIMULATIONS))
    for row, weight in zip(estimates, _SIMULATED_MEMORY[:memories], strict=True):
        memory = Autoregression(np.array([weight]), 1.0 - weight**2)
        row[:] = [_lag_one(memory.with_memory(rng.normal(size=(cycles, series))).T) for _ in row]
    return estimates


def _lag_one(values: Array) -> float:
    """Median correlation of successive values of series (series, cycles) beside their leading patterns; 0 where these are all there is."""
    own = values - values.mean(axis=1, keepdims=True)
    of_cycles = own.shape[1] <= own.shape[0]
    gram = own.T @ own if of_cycles else own @ own.T
    patterns = scipy.linalg.eigh(gram, subset_by_index=[len(gram) - _COMMON_PATTERNS, len(gram) - 1])[1]
    own -= (own @ patterns) @ patterns.T if of_cycles else patterns @ (patterns.T @ own)
    squares = (own**2).sum(axis=1)
    own, squares = own[squares > 0], squares[squares > 0]
    return float(np.median((own[:, 1:] * own[:, :-1]).sum(axis=1) / squares)) if squares.size else 0.0


def typical_memory(values: Array) -> Autoregression:
    """Estimate the memory that series have alike."""
    squares = (values**2).sum(axis=1)
    rows, squares = values[squares > 0], squares[squares > 0]
    cycles = values.shape[1]
    if not rows.size or cycles <= MOST_MEMORY_CYCLES:
        return NO_MEMORY
    lags = range(MOST_MEMORY_CYCLES + 1)
    typical = np.array([np.median((rows[:, lag:] * rows[:, : cycles - lag]).sum(axis=1) / squares) for lag in lags])
    best, chosen = 0.0, NO_MEMORY
    for order in range(1, MOST_MEMORY_CYCLES + 1):
        weights = scipy.linalg.solve_toeplitz(typical[:order], typical[1 : order + 1])
        share = 1.0 - float(weights @ typical[1 : order + 1])
        if share <= 0.0 or weights.sum() >= 1.0:
            continue
        criterion = rows.size * np.log(share) + order * np.log(rows.size)
        if criterion < best:
            best, chosen = criterion, Autoregression(weights, share)
    return chosen
