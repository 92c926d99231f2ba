"""L3 - Generalised least squares under a drift that wanders in real time.

Readings ``y`` at irregular times are explained by fixed effects and by a few drift components, each a random walk or an
integrated random walk, which enter every reading with a known loading::

    y_k = x_k' beta + sum_c loading_kc * d_c(t_k) + e_k        e_k ~ N(0, sigma^2 * v_k)

For a positioning test the components are a common shift (loading 1) and a stretch (loading = position); for a record of several
displacement channels there is one component per channel. All components start at zero: their start is a fixed effect, and
:func:`start_columns` gives the columns that a design must span for that. Filtering costs O(n) in the number of readings.

Sources: Harvey (1989), *Forecasting, structural time series models and the Kalman filter*; Durbin and Koopman (2012), *Time series
analysis by state space methods*, sections 4.4-4.5 (smoothing and disturbances) and 7.2 (restricted likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import optimize

Array = NDArray[np.float64]
Order = Literal[1, 2]

#: Search limits of log10(drift variance ratio): from a drift that nobody can see to one that hides everything else.
_LOG_RATIO_LIMITS = (-14.0, 4.0)
#: A reading whose deletion residual exceeds this many standard deviations is given a larger variance (robust fit).
_OUTLIER_LIMIT = 3.0
#: A whitened column of which less than this share is not explained by the others counts as dependent.
_DEPENDENCE_TOLERANCE = 1e-10
#: A drift is called smooth (integrated walk) only on this much more restricted log-likelihood: where both fit, the rougher one is
#: the safer nuisance, because it claims less of what lies ahead.
_SMOOTH_MARGIN = 2.0
_ROBUST_ROUNDS = 2
_ROBUST_PASSES = 3


class DriftModelError(ValueError):
    """The readings or columns cannot be fitted; the message names what is wrong and what to do."""


@njit(cache=True)
def _gains(
    seconds: Array, loadings: Array, order: int, ratios: Array, variance: Array, observed: NDArray[np.bool_], keep: bool
) -> tuple[Array, Array, Array]:
    """Kalman gains (n, m), innovation variances (n,) in units of sigma^2, and predicted covariances (n, m, m) if kept."""
    n, components = loadings.shape
    m = components * order
    gains = np.zeros((n, m))
    spread = np.empty(n)
    kept = np.zeros((n if keep else 1, m, m))
    covariance = np.zeros((m, m))
    seen = np.zeros(m)
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        for c in range(components):
            level = c * order
            if order == 2:
                rate = level + 1
                for j in range(m):
                    covariance[level, j] += step * covariance[rate, j]
                for j in range(m):
                    covariance[j, level] += step * covariance[j, rate]
                covariance[level, level] += ratios[c] * step**3 / 3.0
                covariance[level, rate] += ratios[c] * step**2 / 2.0
                covariance[rate, level] += ratios[c] * step**2 / 2.0
                covariance[rate, rate] += ratios[c] * step
            else:
                covariance[level, level] += ratios[c] * step
        if keep:
            kept[k] = covariance
        spread[k] = variance[k]
        for i in range(m):
            seen[i] = 0.0
            for c in range(components):
                seen[i] += covariance[i, c * order] * loadings[k, c]
        for c in range(components):
            spread[k] += loadings[k, c] * seen[c * order]
        if observed[k]:
            for i in range(m):
                gains[k, i] = seen[i] / spread[k]
            for i in range(m):
                for j in range(m):
                    covariance[i, j] -= seen[i] * seen[j] / spread[k]
    return gains, spread, kept


@njit(cache=True)
def _innovations(
    seconds: Array, loadings: Array, order: int, gains: Array, columns: Array, keep: bool
) -> tuple[Array, Array]:
    """One-step prediction errors (n, p) of every column under the same gains, and predicted states (n, m, p) if kept."""
    n, components = loadings.shape
    m = gains.shape[1]
    p = columns.shape[1]
    errors = np.empty((n, p))
    kept = np.zeros((n if keep else 1, m, p))
    state = np.zeros((m, p))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        if order == 2:
            for c in range(components):
                for j in range(p):
                    state[2 * c, j] += step * state[2 * c + 1, j]
        if keep:
            kept[k] = state
        for j in range(p):
            predicted = 0.0
            for c in range(components):
                predicted += loadings[k, c] * state[c * order, j]
            errors[k, j] = columns[k, j] - predicted
        for i in range(m):
            gain = gains[k, i]
            if gain != 0.0:
                for j in range(p):
                    state[i, j] += gain * errors[k, j]
    return errors, kept


@njit(cache=True)
def _smooth(
    seconds: Array,
    loadings: Array,
    order: int,
    gains: Array,
    spread: Array,
    observed: NDArray[np.bool_],
    errors: Array,
    states: Array,
    covariances: Array,
) -> tuple[Array, Array, Array, Array]:
    """Backward pass: smoothed levels (n, components, p), their covariances (n, components, components), u (n, p) and D (n,)."""
    n, components = loadings.shape
    m = gains.shape[1]
    p = errors.shape[1]
    levels = np.empty((n, components, p))
    level_covariance = np.empty((n, components, components))
    u = np.zeros((n, p))
    d = np.zeros(n)
    r = np.zeros((m, p))
    big_n = np.zeros((m, m))
    for k in range(n - 1, -1, -1):
        if k < n - 1 and order == 2:
            step = seconds[k + 1] - seconds[k]
            for c in range(components):
                for j in range(p):
                    r[2 * c + 1, j] += step * r[2 * c, j]
                for j in range(m):
                    big_n[2 * c + 1, j] += step * big_n[2 * c, j]
                for j in range(m):
                    big_n[j, 2 * c + 1] += step * big_n[j, 2 * c]
        if observed[k]:
            nk = big_n @ gains[k]
            d[k] = 1.0 / spread[k] + gains[k] @ nk
            for j in range(p):
                projected = 0.0
                for i in range(m):
                    projected += gains[k, i] * r[i, j]
                u[k, j] = errors[k, j] / spread[k] - projected
            h = np.zeros(m)
            for c in range(components):
                h[c * order] = loadings[k, c]
            for i in range(m):
                for j in range(p):
                    r[i, j] += h[i] * u[k, j]
            for i in range(m):
                for j in range(m):
                    big_n[i, j] += h[i] * h[j] * d[k] - h[i] * nk[j] - nk[i] * h[j]
        predicted = covariances[k]
        shift = predicted @ r
        smoothed = predicted - predicted @ big_n @ predicted
        for c in range(components):
            for j in range(p):
                levels[k, c, j] = states[k, c * order, j] + shift[c * order, j]
            for e in range(components):
                level_covariance[k, c, e] = smoothed[c * order, e * order]
    return levels, level_covariance, u, d


@njit(cache=True)
def _gram(errors: Array, spread: Array, observed: NDArray[np.bool_]) -> Array:
    """Sum of outer products of the standardised prediction errors (p, p); threaded BLAS is slower at this size."""
    n, p = errors.shape
    gram = np.zeros((p, p))
    for k in range(n):
        if observed[k]:
            weight = 1.0 / spread[k]
            for i in range(p):
                scaled = errors[k, i] * weight
                if scaled != 0.0:
                    for j in range(p):
                        gram[i, j] += scaled * errors[k, j]
    return gram


@njit(cache=True)
def _sweep(matrix: Array, tolerance: float) -> tuple[Array, float, int]:
    """Sweep a scaled Gram matrix (response first) on every design column (Goodnight 1979, The American Statistician 33, 149).

    Returns the swept matrix (residual sum of squares, coefficients, inverse), the log-determinant of the design's block,
    and the first column that depends on those before it, or -1.
    """
    swept = matrix.copy()
    size = swept.shape[0]
    log_determinant = 0.0
    for k in range(1, size):
        pivot = swept[k, k]
        if pivot < tolerance:
            return swept, log_determinant, k - 1
        log_determinant += np.log(pivot)
        row = swept[k] / pivot
        for i in range(size):
            if i != k:
                factor = swept[i, k]
                for j in range(size):
                    swept[i, j] -= factor * row[j]
                swept[i, k] = -factor / pivot
        swept[k] = row
        swept[k, k] = 1.0 / pivot
    return swept, log_determinant, -1


@dataclass(frozen=True)
class DriftSystem:
    """Readings' times and loadings with the variances of their drift.

    Attributes
    ----------
    seconds : (n,) time of each reading in s, not decreasing
    loadings : (n, components) how each drift component enters each reading
    order : 1 random walk, 2 integrated random walk
    ratios : (components,) drift variance over reading variance, per s (order 1) or per s^3 (order 2)
    variance : (n,) relative variance of each reading, 1 for an ordinary one
    observed : (n,) False for a reading that must not update the drift (held out: predicted in open loop)
    """

    seconds: Array
    loadings: Array
    order: Order
    ratios: Array
    variance: Array
    observed: NDArray[np.bool_]

    def _filter(self, keep: bool) -> tuple[Array, Array, Array]:
        return _gains(self.seconds, self.loadings, self.order, self.ratios, self.variance, self.observed, keep)

    def innovations(self, columns: Array) -> tuple[Array, Array]:
        """Prediction errors (n, p) of columns (n, p), and their variances (n,) in units of sigma^2."""
        gains, spread, _ = self._filter(False)
        errors, _ = _innovations(self.seconds, self.loadings, self.order, gains, np.ascontiguousarray(columns), False)
        return errors, spread

    def whiten(self, columns: Array) -> tuple[Array, float]:
        """Standardised prediction errors of the observed readings (n_observed, p), and the log-determinant of their covariance."""
        errors, spread = self.innovations(columns)
        kept = spread[self.observed]
        return errors[self.observed] / np.sqrt(kept)[:, None], float(np.log(kept).sum())

    def smooth(self, columns: Array) -> tuple[Array, Array, Array, Array]:
        """Smoothed drift levels (n, components, p) of columns (n, p), covariance (n, components, components), u (n, p) and D (n,).

        ``u / D`` is each observed reading's deletion residual, ``1 / D`` its variance, ``variance * u`` its estimated noise
        (Durbin and Koopman, 4.69).
        """
        gains, spread, covariances = self._filter(True)
        errors, states = _innovations(
            self.seconds, self.loadings, self.order, gains, np.ascontiguousarray(columns), True
        )
        return _smooth(
            self.seconds, self.loadings, self.order, gains, spread, self.observed, errors, states, covariances
        )


@dataclass(frozen=True)
class DriftFit:
    """A generalised least-squares fit under a drift system.

    Attributes
    ----------
    system : the drift system, with the estimated variance ratios
    design : (n, p) columns; those the caller gave come first, start columns of an integrated walk follow
    coefficients, covariance : (p,) and (p, p)
    sigma : standard deviation of one ordinary reading
    log_likelihood : restricted log-likelihood (comparable only between fits with the same design)
    rss : whitened residual sum of squares
    """

    system: DriftSystem
    response: Array
    design: Array
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
    def drift_rate(self) -> Array:
        """Standard deviation of each drift component's increment over one hour (order 1), in the response's unit."""
        power = 1.0 if self.system.order == 1 else 3.0
        scale = 1.0 if self.system.order == 1 else 1.0 / 3.0
        return self.sigma * np.sqrt(self.system.ratios * scale * 3600.0**power)

    def residual(self) -> Array:
        """Response minus fixed effects, drift left in, (n,)."""
        return self.response - self.design @ self.coefficients

    def drift(self) -> tuple[Array, Array]:
        """Drift levels at every reading (n, components) and their covariance (n, components, components).

        The covariance holds the smoother's share and that of the estimated coefficients.
        """
        columns = np.column_stack([self.response, self.design])
        levels, covariance, _, _ = self.system.smooth(columns)
        through = levels[:, :, 1:]
        drift = levels[:, :, 0] - through @ self.coefficients
        return drift, self.sigma**2 * covariance + through @ self.covariance @ through.transpose(0, 2, 1)

    def noise(self) -> tuple[Array, Array]:
        """Each reading's estimated noise (n,) and its relative variance (n,), which sum(noise^2) / sum(variance) makes a variance."""
        _, _, u, d = self.system.smooth(self.residual()[:, None])
        return self.system.variance * u[:, 0], self.system.variance**2 * d

    def deletion_residuals(self) -> Array:
        """Each reading against its prediction from all others, in standard deviations of an ordinary reading (n,)."""
        _, _, u, d = self.system.smooth(self.residual()[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            ordinary = 1.0 / d - self.system.variance + 1.0
            standardised = (u[:, 0] / d) / (self.sigma * np.sqrt(ordinary))
        return np.where(d > 0, standardised, np.nan)


def start_columns(seconds: Array, loadings: Array, order: Order) -> Array:
    """Fixed effects of the drift's start: levels, and for an integrated walk also rates per hour, (n, components * order)."""
    if order == 1:
        return loadings
    return np.column_stack([loadings, loadings * (seconds / 3600.0)[:, None]])


def drift_system(
    seconds: Array,
    loadings: Array,
    *,
    order: Order,
    ratios: Array,
    variance: Array | None = None,
    observed: NDArray[np.bool_] | None = None,
) -> DriftSystem:
    """Build a drift system; raises DriftModelError where times run backwards, are missing, or shapes disagree."""
    seconds = np.ascontiguousarray(seconds, float)
    loadings = np.ascontiguousarray(loadings, float)
    n = seconds.size
    if loadings.ndim != 2 or loadings.shape[0] != n:
        raise DriftModelError(f"loadings has shape {loadings.shape}; expected ({n}, number of drift components)")
    if not np.isfinite(seconds).all() or (np.diff(seconds) < 0).any():
        raise DriftModelError("seconds must be finite and must not decrease; sort the readings by time first")
    return DriftSystem(
        seconds,
        loadings,
        order,
        np.ascontiguousarray(ratios, float),
        np.ones(n) if variance is None else np.ascontiguousarray(variance, float),
        np.ones(n, bool) if observed is None else np.ascontiguousarray(observed, bool),
    )


def fit_fixed_effects(system: DriftSystem, response: Array, design: Array) -> DriftFit:
    """Generalised least squares of response (n,) on design (n, p) with the system's drift variances as given.

    Raises
    ------
    DriftModelError
        if a value is not finite, or if the columns are linearly dependent after whitening.
    """
    if not (np.isfinite(response).all() and np.isfinite(design).all()):
        raise DriftModelError("response and design must be finite; leave readings without a value out before the fit")
    errors, spread = system.innovations(np.column_stack([response, design]))
    gram = _gram(errors, spread, system.observed)
    log_determinant = float(np.log(spread[system.observed]).sum())
    scale = np.sqrt(np.diag(gram)[1:])
    vanishing = np.flatnonzero(scale < 1e-12 * np.maximum(1.0, np.abs(design).max(axis=0, initial=0.0)))
    if vanishing.size:
        raise DriftModelError(f"columns {vanishing.tolist()} of the design vanish; leave them out")
    scale_all = np.concatenate([[1.0], scale])
    swept, log_normal, dependent = _sweep(gram / np.outer(scale_all, scale_all), _DEPENDENCE_TOLERANCE)
    if dependent >= 0:
        raise DriftModelError(f"column {dependent} of the design depends linearly on those before it; leave it out")
    freedom = int(system.observed.sum()) - scale.size
    if freedom <= 0:
        raise DriftModelError(
            f"{freedom + scale.size} readings cannot determine {scale.size} coefficients; measure more cycles"
        )
    rss = max(float(swept[0, 0]), 0.0)
    sigma2 = rss / freedom
    log_normal += 2.0 * float(np.log(scale).sum())
    log_likelihood = -0.5 * (freedom * np.log(max(sigma2, 1e-300)) + log_determinant + log_normal)
    return DriftFit(
        system=system,
        response=response,
        design=design,
        coefficients=swept[1:, 0] / scale,
        covariance=sigma2 * swept[1:, 1:] / np.outer(scale, scale),
        sigma=float(np.sqrt(sigma2)),
        log_likelihood=float(log_likelihood),
        rss=rss,
    )


def _maximise(system: DriftSystem, response: Array, design: Array, start: Array | None) -> DriftFit:
    """Restricted maximum likelihood of the variance ratios by a bounded simplex in their logarithm."""
    low, high = _LOG_RATIO_LIMITS
    components = system.loadings.shape[1]
    # Ratios are searched per component in units that make the drift over one hour comparable to one reading's noise.
    unit = np.log10(1.0 / 3600.0 ** (1.0 if system.order == 1 else 3.0)) - 2 * np.log10(
        np.maximum(np.abs(system.loadings).max(axis=0), 1e-12)
    )

    def fitted(log_ratio: Array) -> DriftFit:
        ratios = 10.0 ** (unit + np.clip(log_ratio, low, high))
        return fit_fixed_effects(replace(system, ratios=ratios), response, design)

    guess = np.zeros(components) if start is None else np.clip(np.log10(np.maximum(start, 1e-300)) - unit, low, high)
    simplex = np.vstack([guess, guess + 1.5 * np.eye(components)])
    found = optimize.minimize(
        lambda log_ratio: -fitted(log_ratio).log_likelihood,
        guess,
        method="Nelder-Mead",
        bounds=[_LOG_RATIO_LIMITS] * components,
        options={
            "initial_simplex": np.clip(simplex, low, high),
            "xatol": 0.03,
            "fatol": 1e-3,
            "maxfev": 120 * components,
        },
    )
    return fitted(found.x)


def _downweight(fit: DriftFit) -> Array:
    """Relative variances (n,) under which a reading far from all others stops to pull, with a redescending influence."""
    excess = np.abs(np.nan_to_num(fit.deletion_residuals())) / _OUTLIER_LIMIT
    return np.where(excess > 1.0, excess**2, 1.0)


def estimate(
    seconds: Array,
    loadings: Array,
    response: Array,
    design: Array,
    *,
    order: Order | None = None,
    robust: bool = False,
    start: Array | None = None,
    observed: NDArray[np.bool_] | None = None,
    variance: Array | None = None,
) -> DriftFit:
    """Fit fixed effects and the drift's variances together by restricted maximum likelihood.

    Parameters
    ----------
    seconds, loadings, response, design : (n,), (n, components), (n,), (n, p)
        Readings sorted by time. The design must span the loadings (a drift starts at zero).
    order : 1, 2 or None
        None chooses between both by the restricted likelihood with identical fixed effects (statistics study, section 1.2).
    robust : bool
        Give readings whose deletion residual exceeds 3 standard deviations a larger variance, and repeat.
    start : (components,) variance ratios to start from.
    observed : (n,) readings that may inform the fit; the others are predicted in open loop.
    variance : (n,) relative variances of the readings.

    Returns
    -------
    DriftFit
        The start rates of an integrated walk are appended to the design, after the caller's columns.
    """
    trends = start_columns(seconds, loadings, 2)[:, loadings.shape[1] :]
    with_trends = np.column_stack([design, trends])

    def system(chosen: Order, ratios: Array) -> DriftSystem:
        return drift_system(seconds, loadings, order=chosen, ratios=ratios, variance=variance, observed=observed)

    neutral = np.ones(loadings.shape[1])
    if order is None:
        walk = _maximise(system(1, neutral), response, with_trends, None)
        smooth = _maximise(system(2, neutral), response, with_trends, None)
        order = 2 if smooth.log_likelihood > walk.log_likelihood + _SMOOTH_MARGIN else 1
        start = (walk if order == 1 else smooth).system.ratios
    columns = design if order == 1 else with_trends
    fit = _maximise(system(order, neutral), response, columns, start)
    if robust:
        for _ in range(_ROBUST_ROUNDS):
            for _ in range(_ROBUST_PASSES):
                fit = fit_fixed_effects(replace(fit.system, variance=_downweight(fit)), response, columns)
            if (fit.system.variance == 1.0).all():
                break
            fit = _maximise(fit.system, response, columns, fit.system.ratios)
    return fit
