"""How far coefficients move when a target or a part of the test is left out: what a fit's own uncertainty cannot know.

The uncertainty of a least-squares fit holds where the model lacks nothing. An effect that the model lacks bends a coefficient, and bends it
differently at other targets and at other times; a wrong scale of the temperature or of the readings is the same everywhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.model.fit import ModelFit
from interferometry.drift.gls import fit_fixed_effects
from interferometry.drift.state_space import DriftModelError

#: Parts of the test of equal numbers of cycles: each long enough for a load to switch, and enough of them for a variance.
PARTS = 6


def coefficient_spread(model: ModelFit) -> Array:
    """Standard deviation of every coefficient by the delete-a-group jackknife, over targets and over parts of the test.

    Parameters
    ----------
    model : ModelFit
        Fitted model; the variances of its drift are kept.

    Returns
    -------
    (p,) ndarray
        In the units of ``model.fit.coefficients``, for the terms' columns; what is known beforehand of a coefficient is left out. NaN for
        columns of the profile, infinite where a coefficient rests on one target or one part alone.

    Notes
    -----
    With the K values x_k, each without one group, s^2 = (K - 1)/K sum (x_k - mean)^2 (Efron and Tibshirani 1993, An introduction to the
    bootstrap, chapter 11). The deviations over targets and over parts are independent contrasts and are added in squares.
    """
    readings = model.readings.subset(model.used)
    cycles = np.unique(readings.cycle)
    part = np.searchsorted(cycles, readings.cycle) * PARTS // cycles.size
    return np.hypot(_jackknife(model, readings.target_index), _jackknife(model, part))


def _jackknife(model: ModelFit, group: NDArray[np.int64]) -> Array:
    values = np.array([_without(model, group == number) for number in np.unique(group)])
    count = values.shape[0]
    spread = np.sqrt((count - 1.0) ** 2 / count * values.var(axis=0, ddof=1))
    spread[np.isnan(values).any(axis=0)] = np.inf
    spread[: model.profile.shape[1]] = np.nan
    return spread


def _without(model: ModelFit, left_out: NDArray[np.bool_]) -> Array:
    """Coefficients (p,) from the other readings; NaN for those that they do not determine."""
    fit = model.fit
    kept = (fit.design[~left_out] != 0.0).any(axis=0)
    coefficients = np.full(kept.size, np.nan)
    try:
        rest = fit_fixed_effects(
            replace(fit.system, observed=fit.system.observed & ~left_out), fit.response, fit.design[:, kept]
        )
    except DriftModelError:
        return coefficients
    coefficients[kept] = rest.coefficients
    return coefficients
