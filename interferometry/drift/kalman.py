"""The recursions behind the drift estimate, compiled: gains, prediction errors, smoothing, and least squares by sweeping.

The state holds one level per drift component (order 1) or level and rate (order 2); readings come at irregular times. Equations:
Durbin and Koopman (2012), sections 4.3-4.5.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from interferometry._typing import Array


@njit(cache=True)
def predict(covariance: Array, order: int, ratios: Array, pace: float, step: float) -> None:
    """Carry the state's covariance over a step in s, in place; pace multiplies the ratios during it."""
    m = covariance.shape[0]
    for c in range(ratios.size):
        level, ratio = c * order, ratios[c] * pace
        if order == 2:
            rate = level + 1
            for j in range(m):
                covariance[level, j] += step * covariance[rate, j]
            for j in range(m):
                covariance[j, level] += step * covariance[j, rate]
            covariance[level, level] += ratio * step**3 / 3.0
            covariance[level, rate] += ratio * step**2 / 2.0
            covariance[rate, level] += ratio * step**2 / 2.0
            covariance[rate, rate] += ratio * step
        else:
            covariance[level, level] += ratio * step


@njit(cache=True)
def look(covariance: Array, order: int, loadings: Array, k: int, variance: float, seen: Array) -> float:
    """Innovation variance of reading k in units of sigma^2; its covariance with the state is left in `seen`."""
    components = loadings.shape[1]
    for i in range(covariance.shape[0]):
        seen[i] = 0.0
        for c in range(components):
            seen[i] += covariance[i, c * order] * loadings[k, c]
    spread = variance
    for c in range(components):
        spread += loadings[k, c] * seen[c * order]
    return spread


@njit(cache=True)
def learn(covariance: Array, seen: Array, spread: float) -> None:
    """Take from the state's covariance what a reading tells, in place."""
    m = covariance.shape[0]
    precision = 1.0 / spread
    for i in range(m):
        for j in range(m):
            covariance[i, j] -= seen[i] * seen[j] * precision


@njit(cache=True)
def advance(state: Array, order: int, step: float) -> None:
    """Carry the expected state (m, p) of every column over a step in s, in place."""
    if order == 2:
        for c in range(state.shape[0] // 2):
            level, rate = state[2 * c], state[2 * c + 1]
            for j in range(level.size):
                level[j] += step * rate[j]


@njit(cache=True)
def correct(
    state: Array, order: int, loadings: Array, k: int, reading: Array, seen: Array, spread: float, error: Array
) -> None:
    """Leave the prediction errors (p,) of reading k in `error`, and move the expected state (m, p) by them, in place."""
    for j in range(error.size):
        error[j] = reading[j]
    for c in range(loadings.shape[1]):
        level, loading = state[c * order], loadings[k, c]
        for j in range(error.size):
            error[j] -= loading * level[j]
    for i in range(seen.size):
        gain, one = seen[i] / spread, state[i]
        for j in range(error.size):
            one[j] += gain * error[j]


@njit(cache=True)
def gains(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    pace: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    keep: bool,
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
        predict(covariance, order, ratios, pace[k], step)
        if keep:
            kept[k] = covariance
        spread[k] = look(covariance, order, loadings, k, variance[k], seen)
        if observed[k]:
            for i in range(m):
                gains[k, i] = seen[i] / spread[k]
            learn(covariance, seen, spread[k])
    return gains, spread, kept


@njit(cache=True)
def innovations(
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
        advance(state, order, step)
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
def smooth(
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
    nk = np.zeros(m)
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
            d[k] = 1.0 / spread[k]
            for i in range(m):
                nk[i] = 0.0
                for j in range(m):
                    nk[i] += big_n[i, j] * gains[k, j]
                d[k] += gains[k, i] * nk[i]
            for j in range(p):
                u[k, j] = errors[k, j] / spread[k]
            for i in range(m):
                for j in range(p):
                    u[k, j] -= gains[k, i] * r[i, j]
            for c in range(components):
                loading, level = loadings[k, c], c * order
                for j in range(p):
                    r[level, j] += loading * u[k, j]
                for j in range(m):
                    big_n[level, j] -= loading * nk[j]
                    big_n[j, level] -= loading * nk[j]
                for e in range(components):
                    big_n[level, e * order] += loading * loadings[k, e] * d[k]
        smooth_levels(order, covariances[k], states[k], r, big_n, levels[k], level_covariance[k])
    return levels, level_covariance, u, d


@njit(cache=True)
def smooth_levels(
    order: int, predicted: Array, state: Array, r: Array, big_n: Array, levels: Array, level_covariance: Array
) -> None:
    """Leave the smoothed levels (components, p) and their covariance (components, components) of one reading in the last two."""
    components, p = levels.shape
    m = predicted.shape[0]
    for c in range(components):
        own = predicted[c * order]
        for j in range(p):
            levels[c, j] = state[c * order, j]
        for i in range(m):
            for j in range(p):
                levels[c, j] += own[i] * r[i, j]
        for e in range(components):
            other = predicted[e * order]
            level_covariance[c, e] = own[e * order]
            for i in range(m):
                for j in range(m):
                    level_covariance[c, e] -= own[i] * big_n[i, j] * other[j]


@njit(cache=True)
def normal_equations(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    pace: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    columns: Array,
) -> tuple[Array, float]:
    """Gram matrix (p, p) of the columns' standardised prediction errors, and the log-determinant of the readings' covariance.

    One pass over the readings, of which only the state and the errors of the last four are kept: a likelihood then costs its
    arithmetic, where a long test would otherwise wait for memory.
    """
    n, components = loadings.shape
    p = columns.shape[1]
    covariance = np.zeros((components * order, components * order))
    seen = np.zeros(components * order)
    state = np.zeros((components * order, p))
    errors, precision, held = np.zeros((4, p)), np.zeros(4), 0
    gram = np.zeros((p, p))
    log_determinant = 0.0
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        predict(covariance, order, ratios, pace[k], step)
        advance(state, order, step)
        if not observed[k]:
            continue
        spread = look(covariance, order, loadings, k, variance[k], seen)
        learn(covariance, seen, spread)
        correct(state, order, loadings, k, columns[k], seen, spread, errors[held])
        log_determinant += np.log(spread)
        precision[held] = 1.0 / spread
        held += 1
        if held == 4:
            _add_products(gram, errors, precision)
            held = 0
    precision[held:] = 0.0
    _add_products(gram, errors, precision)
    for i in range(p):
        for j in range(i):
            gram[j, i] = gram[i, j]
    return gram, log_determinant


@njit(cache=True)
def _add_products(gram: Array, errors: Array, precision: Array) -> None:
    """Add the weighted outer products of four rows to the lower triangle; four at a time load and store it a quarter as often."""
    a, b, c, d = errors[0], errors[1], errors[2], errors[3]
    for i in range(a.size):
        wa, wb, wc, wd = precision[0] * a[i], precision[1] * b[i], precision[2] * c[i], precision[3] * d[i]
        row = gram[i]
        for j in range(i + 1):
            row[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@njit(cache=True)
def sweep(matrix: Array, tolerance: float) -> tuple[Array, float, int]:
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
