"""Noise that neighbouring readings of a pass share, as turbulent air along the beam makes it.

A correlation of some ten seconds is neither independent noise nor drift of the machine. The drift estimate follows a part of it, and its
uncertainty has to say so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from interferometry._typing import Array
from interferometry.drift.state_space import DriftSystem

#: Correlation times that are tried, s; longer ones are a drift within the pass.
CORRELATION_TIMES_S = (5.0, 10.0, 20.0, 40.0)
#: Standard errors by which the correlation must be known before it is taken into account.
LEAST_SIGNIFICANCE = 4.0
#: Fewest complete passes from which a correlation is estimated.
LEAST_PASSES = 20
_REALISATIONS = 32
_SEED = 0


@dataclass(frozen=True)
class AirNoise:
    """Noise with an exponential correlation in time, beside independent noise.

    Attributes
    ----------
    variance_um2 : float
        Of the correlated part.
    correlation_time_s : float
    independent_um2 : float
        Variance of the independent part.
    """

    variance_um2: float
    correlation_time_s: float
    independent_um2: float


def estimate_air_noise(
    residual: Array, seconds: Array, loadings: Array, *, number: NDArray[np.int64], position: Array
) -> AirNoise | None:
    """Estimate the correlated noise from the covariance of the readings within a pass.

    Parameters
    ----------
    residual : (n,) ndarray
        Readings minus profile, um, in the order of time.
    seconds : (n,) ndarray
        Time of each reading, s.
    loadings : (n, components) ndarray
        Share of each drift component in each reading; their shapes are taken from every pass.
    number : (n,) ndarray of int
        Number of the pass of each reading, odd in one direction and even in the other.
    position : (n,) ndarray, mm

    Returns
    -------
    AirNoise or None
        None where the correlation is not significant or there are too few complete passes.

    Notes
    -----
    docs/method/drift-estimation.md. With M the projection off the shapes of the drift, the mean of r r' over the passes is a non-negative
    combination of M (independent noise) and M R M (R exponential in time).
    """
    rows = _complete_passes(number, position)
    count, targets = rows.shape
    if count < LEAST_PASSES or targets < loadings.shape[1] + 3:
        return None
    passes = residual[rows]
    for odd in (0, 1):
        direction = number[rows[:, 0]] % 2 == odd
        if direction.any():
            passes[direction] -= np.median(passes[direction], axis=0)
    known = loadings[rows[0]]
    free = np.eye(targets) - known @ np.linalg.pinv(known)
    remainder = passes @ free
    covariance = remainder.T @ remainder / count
    # Both directions visit the targets in opposite order; only times between readings enter.
    elapsed = np.median(np.abs(seconds[rows] - seconds[rows[:, :1]]), axis=0)
    lag = np.abs(elapsed[:, None] - elapsed)
    fits = []
    for correlation_time in CORRELATION_TIMES_S:
        air = free @ np.exp(-lag / correlation_time) @ free
        basis = np.column_stack([free.ravel(), air.ravel()])
        scale = np.linalg.norm(basis, axis=0)
        weights, misfit = optimize.nnls(basis / scale, covariance.ravel())
        fits.append((misfit, correlation_time, weights / scale, air))
    _, correlation_time, (independent, variance), air = min(fits, key=lambda fit: fit[0])
    # The part of the correlation that independent noise cannot make: its mean over the passes is zero without correlation.
    contrast = air - free * float((air * free).sum() / (free * free).sum())
    by_pass = np.einsum("pi,ij,pj->p", remainder, contrast, remainder)
    if variance <= 0.0 or by_pass.mean() <= LEAST_SIGNIFICANCE * by_pass.std() / np.sqrt(count):
        return None
    return AirNoise(float(variance), float(correlation_time), float(independent))


def _complete_passes(number: NDArray[np.int64], position: Array) -> NDArray[np.int64]:
    """Index of every reading of the complete passes, by position, (pass, target)."""
    _, index, count = np.unique(number, return_inverse=True, return_counts=True)
    targets = np.unique(position).size
    rows = np.flatnonzero(count[index.ravel()] == targets)
    return rows[np.lexsort((position[rows], index.ravel()[rows]))].reshape(-1, targets)


def drift_covariance(system: DriftSystem, air: AirNoise, sigma_um: float) -> Array:
    """Return what correlated noise adds to the covariance of the drift levels.

    Parameters
    ----------
    system : DriftSystem
        With its fitted variances.
    air : AirNoise
    sigma_um : float
        Standard deviation of a reading that the fit assumes independent.

    Returns
    -------
    (components, components) ndarray, um2
        Mean over the readings of the covariance of the smoothed noise minus that of independent noise, without its negative part.

    Notes
    -----
    Both are obtained by smoothing simulated noise with the fitted gains (Monte Carlo of a linear estimator, GUM Supplement 1).
    """
    rng = np.random.default_rng(_SEED)
    shape = (system.seconds.size, _REALISATIONS)
    kept = np.exp(-np.diff(system.seconds) / air.correlation_time_s)
    correlated = rng.standard_normal(shape)
    for k, share in enumerate(kept, start=1):
        correlated[k] = share * correlated[k - 1] + np.sqrt(1.0 - share**2) * correlated[k]
    white = rng.standard_normal(shape)
    true = np.sqrt(air.variance_um2) * correlated + np.sqrt(air.independent_um2) * white
    levels = system.smooth(np.hstack([true, sigma_um * white])).levels
    of_true, assumed = (
        np.einsum("kcr,ker->ce", part, part) / (shape[0] * _REALISATIONS) for part in np.split(levels, 2, axis=2)
    )
    values, vectors = np.linalg.eigh(of_true - assumed)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
