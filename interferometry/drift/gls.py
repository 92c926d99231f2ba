"""Generalised least squares under a drift that wanders in real time.

Readings ``y`` at irregular times are explained by fixed effects and by a few drift components, each a random walk or an
integrated random walk, which enter every reading with a known loading::

    y_k = x_k' beta + sum_c loading_kc * d_c(t_k) + e_k        e_k ~ N(0, sigma^2 * v_k)

For a positioning test the components are a common shift (loading 1) and a stretch (loading = position); for a record of several
displacement channels there is one component per channel. All components start at zero: their start is a fixed effect, and
:func:`start_columns` gives the columns that a design must span for that. Filtering costs O(n) in the number of readings.

Sources: Harvey (1989), *Forecasting, structural time series models and the Kalman filter*; Durbin and Koopman (2012), *Time series
analysis by state space methods*, sections 4.4-4.5 (smoothing and disturbances) and 7.2 (restricted likelihood).

A weighted average of the drift over its readings, with its exact covariance, in two passes.

Averages over time need the covariance between different times, which a smoother does not give. The state is therefore
augmented with the running average itself (an accumulator): after the last reading the filter knows it as well as
smoothing would, and a backward pass gives its covariance with the drift at every reading (Durbin and Koopman, Time
series analysis by state space methods, 2012, section 4.7 on covariances of smoothed states).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import optimize

from interferometry._typing import Array
from interferometry.drift import kalman
from interferometry.drift.state_space import DriftModelError, DriftSystem, Order, drift_system, start_columns

__all__ = [
    "Array",
    "DriftFit",
    "DriftModelError",
    "DriftSystem",
    "Order",
    "drift_system",
    "estimate",
    "fit_fixed_effects",
    "start_columns",
]

#: Search limits of log10(drift variance ratio): from a drift that nobody can see to one that hides everything else.
_LOG_RATIO_LIMITS = (-14.0, 4.0)
_FIRST_STEP = 1.5
#: A reading whose deletion residual exceeds this many standard deviations is given a larger variance (robust fit).
_OUTLIER_LIMIT = 3.0
#: A whitened column of which less than this share is not explained by the others counts as dependent.
_DEPENDENCE_TOLERANCE = 1e-10
#: A drift is called smooth (integrated walk) only on this much more restricted log-likelihood: where both fit, the rougher one is
#: the safer nuisance, because it claims less of what lies ahead.
_SMOOTH_MARGIN = 2.0
#: A drift that settles has two parameters more; by the Bayesian information criterion they have to raise the log-likelihood of some
#: thousand readings by 8.
_SETTLING_MARGIN = 8.0
#: First guess of its time as a share of the test, and search limits: below a hundredth it concerns a cycle or two.
_SETTLING_SHARE, _SETTLING_LIMITS = 1.0 / 15.0, (1.0 / 100.0, 1.0)
_FASTEST_SETTLING = 6.0
_ROBUST_ROUNDS = 2
_ROBUST_PASSES = 3


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


def fit_fixed_effects(system: DriftSystem, response: Array, design: Array) -> DriftFit:
    """Generalised least squares of response (n,) on design (n, p) with the system's drift variances as given.

    Raises
    ------
    DriftModelError
        if a value is not finite, or if the columns are linearly dependent after whitening.
    """
    return _solve(system, _Problem.of(response, design))


@dataclass(frozen=True)
class _Problem:
    """What every fit of a search has in common.

    columns (n, 1 + p) holds response and design side by side; least (p,) is the whitened size under which a column vanishes.
    """

    response: Array
    design: Array
    columns: Array
    least: Array

    @classmethod
    def of(cls, response: Array, design: Array) -> _Problem:
        columns = np.column_stack([response, design])
        if not np.isfinite(columns).all():
            raise DriftModelError(
                "response and design must be finite; leave readings without a value out before the fit"
            )
        return cls(response, design, columns, 1e-12 * np.maximum(1.0, np.abs(design).max(axis=0, initial=0.0)))


def _solve(system: DriftSystem, problem: _Problem) -> DriftFit:
    gram, log_determinant = system.normal_equations(problem.columns)
    scale = np.sqrt(np.diag(gram)[1:])
    vanishing = np.flatnonzero(scale < problem.least)
    if vanishing.size:
        raise DriftModelError(f"columns {vanishing.tolist()} of the design vanish; leave them out")
    scale_all = np.concatenate([[1.0], scale])
    swept, log_normal, dependent = kalman.sweep(gram / np.outer(scale_all, scale_all), _DEPENDENCE_TOLERANCE)
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
        response=problem.response,
        design=problem.design,
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
    problem = _Problem.of(response, design)
    # Ratios are searched per component in units that make the drift over one hour comparable to one reading's noise.
    unit = np.log10(1.0 / 3600.0 ** (1.0 if system.order == 1 else 3.0)) - 2 * np.log10(
        np.maximum(np.abs(system.loadings).max(axis=0), 1e-12)
    )

    def fitted(log_ratio: Array) -> DriftFit:
        ratios = 10.0 ** (unit + np.clip(log_ratio, low, high))
        return _solve(replace(system, ratios=ratios), problem)

    guess = np.zeros(components) if start is None else np.clip(np.log10(np.maximum(start, 1e-300)) - unit, low, high)
    # Steps that would leave the limits go the other way: clipped, they would leave the simplex without volume.
    step = np.where(guess + _FIRST_STEP > high, -_FIRST_STEP, _FIRST_STEP)
    simplex = np.vstack([guess, guess + np.diag(step)])
    found = optimize.minimize(
        lambda log_ratio: -fitted(log_ratio).log_likelihood,
        guess,
        method="Nelder-Mead",
        bounds=[_LOG_RATIO_LIMITS] * components,
        options={
            "initial_simplex": simplex,
            "xatol": 0.03,
            "fatol": 1e-3,
            "maxfev": 120 * components,
        },
    )
    return fitted(found.x)


def settling_pace(seconds: Array, time_s: float, exponent: float) -> Array:
    """Factor (n,) on the drift's variance that starts at 1 and falls as a power of the time since the first reading.

    A warm-up is a sum of exponentials from fast to slow, whose curvature falls about like that. With one constant variance the
    drift is taken to be as calm at the start as it is later: it is then smoothed too much there, and its bands are too narrow.
    """
    return (1.0 + (seconds - seconds[0]) / time_s) ** -exponent


def _settle(fit: DriftFit) -> DriftFit:
    """Return the fit with a livelier drift at the start, where the readings clearly say that it settles; else the fit as it was.

    Later on the drift keeps the variance of the fit, though the likelihood would lower it: the rougher drift claims less.
    """
    system, problem = fit.system, _Problem.of(fit.response, fit.design)
    span = float(system.seconds[-1] - system.seconds[0])
    first = _SETTLING_SHARE * span

    def fitted(log_ratio: Array, time_s: float, exponent: float) -> DriftFit:
        pace = settling_pace(system.seconds, time_s, exponent)
        return _solve(replace(system, ratios=10.0**log_ratio, pace=pace), problem)

    def scaled(exponent: float) -> Array:
        return np.log10(system.ratios / settling_pace(system.seconds, first, exponent).mean())

    likely = max((1.0, 2.0), key=lambda exponent: fitted(scaled(exponent), first, exponent).log_likelihood)
    if fitted(scaled(likely), first, likely).log_likelihood < fit.log_likelihood:
        return fit
    components = system.ratios.size
    guess = np.r_[scaled(likely), np.log10(first), likely]
    limits = np.log10(span * np.array(_SETTLING_LIMITS))
    found = optimize.minimize(
        lambda x: -fitted(x[:components], 10.0 ** x[-2], x[-1]).log_likelihood,
        guess,
        method="Nelder-Mead",
        bounds=[(None, None)] * components + [tuple(limits), (0.0, _FASTEST_SETTLING)],
        options={
            "initial_simplex": np.vstack([guess, guess + np.diag([1.0] * components + [0.5, 1.0])]),
            "xatol": 0.03,
            "fatol": 1e-2,
            "maxfev": 80 * guess.size,
        },
    )
    settled = fitted(found.x[:components], 10.0 ** found.x[-2], found.x[-1]).system
    if -found.fun < fit.log_likelihood + _SETTLING_MARGIN:
        return fit
    livelier = float(np.exp(np.log(settled.ratios / system.ratios).mean()))
    return _solve(replace(system, pace=np.maximum(1.0, livelier * settled.paces)), problem)


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
    settling: bool = False,
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
    settling : bool
        Let the drift's variance be larger at the start where the restricted likelihood clearly asks for it, as in a warm-up.
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
    return _settle(fit) if settling else fit


@njit(cache=True)
def _filter(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    pace: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    weights: Array,
    columns: Array,
) -> tuple[Array, Array, Array, Array]:
    """Filter with the average as part of the state: last state (size, p) and covariance (size, size), predicted covariances, gains."""
    n, components = loadings.shape
    m = components * order
    size = m + components
    state = np.zeros((size, columns.shape[1]))
    covariance = np.zeros((size, size))
    seen, error = np.zeros(size), np.empty(columns.shape[1])
    predicted = np.zeros((n, size, size))
    gains = np.zeros((n, size))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        kalman.advance(state[:m], order, step)
        kalman.predict(covariance, order, ratios, pace[k], step)
        predicted[k] = covariance
        if observed[k]:
            spread = kalman.look(covariance, order, loadings, k, variance[k], seen)
            kalman.learn(covariance, seen, spread)
            kalman.correct(state, order, loadings, k, columns[k], seen, spread, error)
            for i in range(size):
                gains[k, i] = seen[i] / spread
        if weights[k] != 0.0:
            for c in range(components):
                state[m + c] += weights[k] * state[c * order]
                covariance[m + c] += weights[k] * covariance[c * order]
                covariance[:, m + c] += weights[k] * covariance[:, c * order]
    return state, covariance, predicted, gains


@njit(cache=True)
def _carry_back(seconds: Array, loadings: Array, order: int, weights: Array, predicted: Array, gains: Array) -> Array:
    """Covariance (n, components, components) of the drift at every reading with the average, in units of sigma^2."""
    n, components = loadings.shape
    m = components * order
    size = m + components
    with_drift = np.zeros((n, components, components))
    onward = np.zeros((components, size))
    for c in range(components):
        onward[c, m + c] = 1.0
    for k in range(n - 1, -1, -1):
        if k < n - 1 and order == 2:
            step = seconds[k + 1] - seconds[k]
            for c in range(components):
                for i in range(components):
                    onward[i, 2 * c + 1] += step * onward[i, 2 * c]
        for i in range(components):
            pulled = 0.0
            for c in range(components):
                onward[i, c * order] += weights[k] * onward[i, m + c]
            for j in range(size):
                pulled += onward[i, j] * gains[k, j]
            for c in range(components):
                onward[i, c * order] -= pulled * loadings[k, c]
        for c in range(components):
            for i in range(components):
                for j in range(size):
                    with_drift[k, c, i] += predicted[k, c * order, j] * onward[i, j]
    return with_drift


def average_drift(system: DriftSystem, weights: Array, columns: Array) -> tuple[Array, Array, Array]:
    """Average the drift that columns imply over the readings.

    Parameters
    ----------
    system : DriftSystem
    weights : (n,) ndarray
        One per reading.
    columns : (n, p) ndarray
        Response and design, or any columns to be filtered.

    Returns
    -------
    average : (components, p) ndarray
        Weighted sum of the smoothed drift of each column.
    covariance : (components, components) ndarray
        Of the average's error, the coefficients being known, in units of sigma^2.
    with_drift : (n, components, components) ndarray
        Covariance of the error of each reading's drift (second axis) with that of the average (third), likewise.
    """
    weights = np.ascontiguousarray(weights, float)
    state, covariance, predicted, gains = _filter(
        system.seconds,
        system.loadings,
        system.order,
        system.ratios,
        system.paces,
        system.variance,
        system.observed,
        weights,
        np.ascontiguousarray(columns, float),
    )
    m = system.loadings.shape[1] * system.order
    with_drift = _carry_back(system.seconds, system.loadings, system.order, weights, predicted, gains)
    return state[m:], covariance[m:, m:], with_drift
