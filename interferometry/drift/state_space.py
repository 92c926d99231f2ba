"""Drift components that wander in time: the system of equations behind the drift estimate, and what its filter returns.

Each component is a random walk or an integrated random walk from zero, and enters every reading with a known loading; equations
and sources in :mod:`interferometry.drift.gls`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from interferometry._typing import Array
from interferometry.drift import kalman
from interferometry.errors import InterferometryError

Order = Literal[1, 2]


class DriftModelError(InterferometryError):
    """The readings or columns cannot be fitted; the message names what is wrong and what to do."""


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
    pace : (n,) factor on the ratios in the step before each reading; None for a drift of constant liveliness
    """

    seconds: Array
    loadings: Array
    order: Order
    ratios: Array
    variance: Array
    observed: NDArray[np.bool_]
    pace: Array | None = None

    @property
    def paces(self) -> Array:
        """Factor on the ratios in the step before each reading, (n,)."""
        return np.ones(self.seconds.size) if self.pace is None else self.pace

    def _filter(self, keep: bool) -> tuple[Array, Array, Array]:
        return kalman.gains(
            self.seconds, self.loadings, self.order, self.ratios, self.paces, self.variance, self.observed, keep
        )

    def innovations(self, columns: Array) -> tuple[Array, Array]:
        """Prediction errors (n, p) of columns (n, p), and their variances (n,) in units of sigma^2."""
        gains, spread, _ = self._filter(False)
        errors, _ = kalman.innovations(
            self.seconds, self.loadings, self.order, gains, np.ascontiguousarray(columns), False
        )
        return errors, spread

    def normal_equations(self, columns: Array) -> tuple[Array, float]:
        """Gram matrix (p, p) of the whitened columns (n, p) of the observed readings, and the log-determinant of their covariance."""
        return kalman.normal_equations(
            self.seconds,
            self.loadings,
            self.order,
            self.ratios,
            self.paces,
            self.variance,
            self.observed,
            np.ascontiguousarray(columns),
        )

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
        errors, states = kalman.innovations(
            self.seconds, self.loadings, self.order, gains, np.ascontiguousarray(columns), True
        )
        return kalman.smooth(
            self.seconds, self.loadings, self.order, gains, spread, self.observed, errors, states, covariances
        )


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
    pace: Array | None = None,
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
        None if pace is None else np.ascontiguousarray(pace, float),
    )
