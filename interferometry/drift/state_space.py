"""Linear drift model in state-space form: readings' times, loadings and variances, with its filter and smoother.

Each drift component is a random walk or an integrated random walk that starts at zero, and enters every reading with a known loading.
The model is stated in :mod:`interferometry.drift.gls`, the recursions are in :mod:`interferometry.drift.kalman`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from interferometry._typing import Array
from interferometry.drift import kalman
from interferometry.errors import InterferometryError

Order = Literal[1, 2]

#: From so many columns on their products are formed block by block, by products of whole matrices; fewer are multiplied on the way.
MANY_COLUMNS = 64
#: Readings of a block.
_ROWS_AT_ONCE = 256


class DriftModelError(InterferometryError):
    """The readings or columns cannot be fitted; the message names what is wrong and what to do."""


class Smoothed(NamedTuple):
    """What the smoother returns for p columns filtered alike; variances in units of sigma^2.

    Attributes
    ----------
    levels : (n, components, p) ndarray
        Smoothed drift levels, in the units of the columns.
    level_covariance : (n, components, components) ndarray
        Covariance of the levels, the columns' coefficients being known.
    u : (n, p) ndarray
        Smoothing errors (Durbin and Koopman 2012, eq. 4.69): ``variance * u`` is the estimated noise of each reading, ``u / D`` its
        deletion residual, the reading minus its prediction from all others.
    D : (n,) ndarray
        Variance of u; ``1 / D`` is the variance of the deletion residual. Zero where the reading is not observed.
    """

    levels: Array
    level_covariance: Array
    u: Array
    D: Array


@dataclass(frozen=True)
class DriftSystem:
    """Times, loadings and relative variances of n readings, with the process noise of their drift.

    Attributes
    ----------
    seconds : (n,) ndarray
        Time of each reading, s, not decreasing.
    loadings : (n, components) ndarray
        How each drift component enters each reading.
    order : {1, 2}
        1 random walk, 2 integrated random walk.
    ratios : (components,) ndarray
        Process noise over reading variance, per s (order 1) or per s^3 (order 2).
    variance : (n,) ndarray
        Relative variance of each reading, 1 for an ordinary one.
    observed : (n,) ndarray of bool
        False for a held-out reading: it does not update the drift and is predicted in open loop.
    process_noise_scale : (n,) ndarray or None
        Factor on the ratios in the step before each reading; None where the process noise is constant.
    """

    seconds: Array
    loadings: Array
    order: Order
    ratios: Array
    variance: Array
    observed: NDArray[np.bool_]
    process_noise_scale: Array | None = None

    @property
    def step_scales(self) -> Array:
        """Factor on the ratios in the step before each reading, (n,); ones where the process noise is constant."""
        return np.ones(self.seconds.size) if self.process_noise_scale is None else self.process_noise_scale

    def _filter_covariance(self, keep: bool) -> tuple[Array, Array, Array]:
        return kalman.filter_covariance(
            self.seconds, self.loadings, self.order, self.ratios, self.step_scales, self.variance, self.observed, keep
        )

    def innovations(self, columns: Array) -> tuple[Array, Array]:
        """One-step prediction errors (n, p) of columns (n, p), and their variances (n,) in units of sigma^2."""
        gains, innovation_variances, _ = self._filter_covariance(False)
        innovations, _ = kalman.filter_columns(
            self.seconds, self.loadings, self.order, gains, np.ascontiguousarray(columns), False
        )
        return innovations, innovation_variances

    def whitening(self, columns: int) -> Whitening:
        """Start to whiten so many columns, some readings after others."""
        gains, innovation_variances, _ = self._filter_covariance(False)
        return Whitening(self, gains, np.sqrt(innovation_variances), np.zeros((gains.shape[1], columns)))

    def normal_equations(self, columns: Array) -> tuple[Array, float]:
        """Gram matrix (p, p) of the whitened columns (n, p) of the observed readings, and the log-determinant of their covariance."""
        if columns.shape[1] >= MANY_COLUMNS:
            return self._normal_equations_by_blocks(columns)
        return kalman.normal_equations(
            self.seconds,
            self.loadings,
            self.order,
            self.ratios,
            self.step_scales,
            self.variance,
            self.observed,
            np.ascontiguousarray(columns),
        )

    def _normal_equations_by_blocks(self, columns: Array) -> tuple[Array, float]:
        whitening = self.whitening(columns.shape[1])
        gram = np.zeros((columns.shape[1], columns.shape[1]))
        for start in range(0, columns.shape[0], _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            whitened = whitening.whiten(columns[rows].copy())[self.observed[rows]]
            gram += whitened.T @ whitened
        return gram, 2.0 * float(np.log(whitening.roots[self.observed]).sum())

    def whiten(self, columns: Array) -> tuple[Array, float]:
        """Standardised innovations of the observed readings (n_observed, p), and the log-determinant of their covariance."""
        innovations, innovation_variances = self.innovations(columns)
        kept = innovation_variances[self.observed]
        return innovations[self.observed] / np.sqrt(kept)[:, None], float(np.log(kept).sum())

    def smooth(self, columns: Array) -> Smoothed:
        """Smooth the drift that columns (n, p) imply, and the noise of every reading."""
        gains, innovation_variances, covariances = self._filter_covariance(True)
        filtered = self.seconds, self.loadings, self.order, gains
        parts = []
        # The states of all columns at all readings are needed on the way back, not afterwards: some columns at a time.
        for some in np.array_split(columns, max(1, columns.shape[1] // MANY_COLUMNS), axis=1):
            innovations, states = kalman.filter_columns(*filtered, np.ascontiguousarray(some), True)
            parts.append(
                kalman.smooth(*filtered, innovation_variances, self.observed, innovations, states, covariances)
            )
        if len(parts) == 1:
            return Smoothed(*parts[0])
        levels, covariance, u, variance = zip(*parts, strict=True)
        return Smoothed(np.concatenate(levels, axis=2), covariance[0], np.concatenate(u, axis=1), variance[0])


@dataclass
class Whitening:
    """The filter of many columns on its way through the readings, so that not all readings need be held at once.

    Attributes
    ----------
    system : DriftSystem
        Of n readings.
    gains : (n, m) ndarray
        Of the filter.
    roots : (n,) ndarray
        Square roots of the innovation variances, in units of sigma.
    state : (m, p) ndarray
        Of every column, after the readings so far.
    done : int
        Number of these readings.
    """

    system: DriftSystem
    gains: Array
    roots: Array
    state: Array
    done: int = 0

    def whiten(self, rows: Array) -> Array:
        """Standardised innovations of the next readings, (some, p); overwrites ``rows``."""
        system = self.system
        kalman.whiten_rows(
            system.seconds, system.loadings, system.order, self.gains, self.roots, self.done, self.state, rows
        )
        self.done += rows.shape[0]
        return rows


def start_columns(seconds: Array, loadings: Array, order: Order) -> Array:
    """Return the fixed effects of the drift's start: its levels, and for an integrated random walk also its rates.

    Parameters
    ----------
    seconds : (n,) ndarray
        Time of each reading, s.
    loadings : (n, components) ndarray
    order : {1, 2}

    Returns
    -------
    (n, components * order) ndarray
        The loadings, then (order 2) the loadings times the hours, whose coefficients are rates per hour.
    """
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
    process_noise_scale: Array | None = None,
) -> DriftSystem:
    """Build a drift system from checked, contiguous arrays.

    Parameters
    ----------
    seconds : (n,) array_like
        Time of each reading, s, not decreasing.
    loadings : (n, components) array_like
        How each drift component enters each reading.
    order : {1, 2}
        1 random walk, 2 integrated random walk.
    ratios : (components,) array_like
        Process noise over reading variance, per s (order 1) or per s^3 (order 2).
    variance : (n,) array_like, optional
        Relative variance of each reading; None: 1 for all.
    observed : (n,) array_like of bool, optional
        Readings that update the drift; None: all.
    process_noise_scale : (n,) array_like, optional
        Factor on the ratios in the step before each reading; None: constant process noise.

    Returns
    -------
    DriftSystem

    Raises
    ------
    DriftModelError
        Times decrease or are not finite, or the loadings do not have one row per reading.
    """
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
        None if process_noise_scale is None else np.ascontiguousarray(process_noise_scale, float),
    )
