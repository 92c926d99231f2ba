"""Memory of the noise over the cycles that all positions have alike.

Readings of one position need not be independent from cycle to cycle: the air changes slowly, a bearing settles. Tests that permute cycles
then take the noise for a motion, and a mean over the cycles is less certain than its scatter says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from interferometry._typing import Array

#: Largest order of the autoregression.
MOST_MEMORY_CYCLES = 3


@dataclass(frozen=True)
class Autoregression:
    """Autoregression over the cycles.

    Attributes
    ----------
    weights : (order,) ndarray
        Of the values one, two, ... cycles before; empty for noise without memory.
    innovation_share : float
        Variance of the innovations over that of the series, 1 without memory.
    """

    weights: Array
    innovation_share: float

    @property
    def long_run(self) -> float:
        """Variance of a mean over many cycles, over that of independent values with the same scatter."""
        return self.innovation_share / (1.0 - float(self.weights.sum())) ** 2

    def innovations(self, values: Array) -> Array:
        """Take the memory from series.

        Parameters
        ----------
        values : (series, cycle) ndarray
            Each with mean zero, in any unit; 0 where missing.

        Returns
        -------
        (series, cycle) ndarray
            Innovations with mean zero. The first cycles have no predecessors: they keep their values, brought to the innovations' variance.
        """
        order = self.weights.size
        if not order:
            return values
        whitened = values.copy()
        for lag, weight in enumerate(self.weights, start=1):
            whitened[:, lag:] -= weight * values[:, :-lag]
        whitened[:, :order] = values[:, :order] * np.sqrt(self.innovation_share)
        return np.asarray(whitened - whitened.mean(axis=1, keepdims=True))


def typical_memory(values: Array) -> Autoregression:
    """Estimate the memory that series have alike.

    Parameters
    ----------
    values : (series, cycle) ndarray
        Noise of each position and direction over the cycles, each with mean zero, in any unit; 0 where missing.

    Returns
    -------
    Autoregression
        Of the median autocorrelation at every lag (Yule and Walker), so that positions that move by themselves hardly enter; its order, at
        most `MOST_MEMORY_CYCLES`, by the Bayesian information criterion.

    References
    ----------
    Brockwell P.J., Davis R.A. (1991), *Time series: theory and methods*, 2nd ed., section 8.1.
    """
    none = Autoregression(np.empty(0), 1.0)
    squares = (values**2).sum(axis=1)
    rows, squares = values[squares > 0], squares[squares > 0]
    cycles = values.shape[1]
    if not rows.size or cycles <= MOST_MEMORY_CYCLES:
        return none
    lags = range(MOST_MEMORY_CYCLES + 1)
    typical = np.array([np.median((rows[:, lag:] * rows[:, : cycles - lag]).sum(axis=1) / squares) for lag in lags])
    best, chosen = 0.0, none
    for order in range(1, MOST_MEMORY_CYCLES + 1):
        weights = linalg.solve_toeplitz(typical[:order], typical[1 : order + 1])
        share = 1.0 - float(weights @ typical[1 : order + 1])
        if share <= 0.0 or weights.sum() >= 1.0:
            continue
        criterion = rows.size * np.log(share) + order * np.log(rows.size)
        if criterion < best:
            best, chosen = criterion, Autoregression(weights, share)
    return chosen
