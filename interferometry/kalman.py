"""L3 - The recursions behind the drift estimate, compiled: gains, prediction errors, smoothing, and least squares by sweeping.

The state holds one level per drift component (order 1) or level and rate (order 2); readings come at irregular times. Equations:
Durbin and Koopman (2012), sections 4.3-4.5.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def predict(covariance: Array, order: int, ratios: Array, step: float) -> None:
    """Carry the state's covariance over a step in s, in place."""
    m = covariance.shape[0]
    for c in range(ratios.size):
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


@njit(cache=True)
def gains(
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
        predict(covariance, order, ratios, step)
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
def gram(errors: Array, spread: Array, observed: NDArray[np.bool_]) -> Array:
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
