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
