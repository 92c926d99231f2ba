"""L3 - A weighted average of the drift over its readings, with its exact covariance, in two passes.

Averages over time need the covariance between different times, which a smoother does not give. The state is therefore
augmented with the running average itself (an accumulator): after the last reading the filter knows it as well as
smoothing would, and a backward pass gives its covariance with the drift at every reading (Durbin and Koopman, Time
series analysis by state space methods, 2012, section 4.7 on covariances of smoothed states).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from interferometry import kalman
from interferometry.statespace import DriftSystem

Array = NDArray[np.float64]


@njit(cache=True)
def _accumulate(
    seconds: Array,
    loadings: Array,
    order: int,
    ratios: Array,
    variance: Array,
    observed: NDArray[np.bool_],
    weights: Array,
    columns: Array,
) -> tuple[Array, Array, Array]:
    """Average (components, p), its covariance (components, components) and that with the drift (n, components, components)."""
    n, components = loadings.shape
    p = columns.shape[1]
    m = components * order
    size = m + components
    state = np.zeros((size, p))
    covariance = np.zeros((size, size))
    seen = np.zeros(size)
    kept = np.zeros((n, size, size))
    gains = np.zeros((n, size))
    for k in range(n):
        step = seconds[k] - seconds[k - 1] if k > 0 else 0.0
        if order == 2:
            for c in range(components):
                for j in range(p):
                    state[2 * c, j] += step * state[2 * c + 1, j]
        kalman.predict(covariance, order, ratios, step)
        kept[k] = covariance
        if observed[k]:
            spread = variance[k]
            for i in range(size):
                seen[i] = 0.0
                for c in range(components):
                    seen[i] += covariance[i, c * order] * loadings[k, c]
            for c in range(components):
                spread += loadings[k, c] * seen[c * order]
            for j in range(p):
                error = columns[k, j]
                for c in range(components):
                    error -= loadings[k, c] * state[c * order, j]
                for i in range(size):
                    state[i, j] += seen[i] * error / spread
            for i in range(size):
                gains[k, i] = seen[i] / spread
                for j in range(size):
                    covariance[i, j] -= seen[i] * seen[j] / spread
        if weights[k] != 0.0:
            for c in range(components):
                for j in range(p):
                    state[m + c, j] += weights[k] * state[c * order, j]
                for j in range(size):
                    covariance[m + c, j] += weights[k] * covariance[c * order, j]
                for j in range(size):
                    covariance[j, m + c] += weights[k] * covariance[j, c * order]
    with_drift = np.empty((n, components, components))
    onward = np.zeros((components, size))
    for c in range(components):
        onward[c, m + c] = 1.0
    for k in range(n - 1, -1, -1):
        if k < n - 1 and order == 2:
            step = seconds[k + 1] - seconds[k]
            for c in range(components):
                for i in range(components):
                    onward[i, 2 * c + 1] += step * onward[i, 2 * c]
        for c in range(components):
            for i in range(components):
                onward[i, c * order] += weights[k] * onward[i, m + c]
        for i in range(components):
            pulled = 0.0
            for j in range(size):
                pulled += onward[i, j] * gains[k, j]
            for c in range(components):
                onward[i, c * order] -= pulled * loadings[k, c]
        for c in range(components):
            for i in range(components):
                with_drift[k, c, i] = 0.0
                for j in range(size):
                    with_drift[k, c, i] += kept[k, c * order, j] * onward[i, j]
    return state[m:], covariance[m:, m:], with_drift


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
    return _accumulate(
        system.seconds,
        system.loadings,
        system.order,
        system.ratios,
        system.variance,
        system.observed,
        np.ascontiguousarray(weights, float),
        np.ascontiguousarray(columns, float),
    )
