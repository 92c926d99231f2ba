"""Errors of predicting each block of cycles from the others: what a model is worth where the hold-out set says nothing.

A drift that is carried forward has learnt an early step by the time of the hold-out set, so the error there is the same with the step and
without it. Between readings before and after a block that is left out the drift is interpolated, which cannot make a step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.model.fit import ModelFit
from fusion.model.least_squares import solve

#: Blocks of cycles, each as long as the hold-out set; all but the first are left out in turn. The first alone knows in which state the
#: machine was when the log began, so that nothing predicts it.
_BLOCKS = 5


def cross_errors(model: ModelFit, event_s: float | None = None) -> Array:
    """Errors of predicting blocks of cycles from all others.

    Parameters
    ----------
    model : fitted to n readings; the drift's variances are kept, its level and all coefficients come from the other blocks
    event_s : for an event, its instant, s since the first reading: only the block around it is left out and counted, because elsewhere
        the drift has learnt its level

    Returns
    -------
    (n,) ndarray, um
        NaN at a reading that no block holds, and at one of a site that the other blocks do not hold.
    """
    errors = np.full(int(model.used.sum()), np.nan)
    for block in _cycle_blocks(model) if event_s is None else [_around(model, event_s)]:
        errors[block] = _left_out(model, block)
    return errors


def _cycle_blocks(model: ModelFit) -> list[NDArray[np.bool_]]:
    """Consecutive fifths of the cycles but the first, as masks of the used readings."""
    cycle = model.readings.cycle[model.used]
    numbers = np.unique(cycle)
    block = np.searchsorted(numbers, cycle) * _BLOCKS // numbers.size
    return [block == number for number in range(1, _BLOCKS)]


def _around(model: ModelFit, event_s: float) -> NDArray[np.bool_]:
    """A fifth of the cycles around an event, fewer where that would leave none on one side."""
    cycle = model.readings.cycle[model.used]
    numbers = np.unique(cycle)
    later = model.readings.seconds[model.used] >= event_s
    at = int(np.searchsorted(numbers, cycle[later][0] if later.any() else numbers[-1]))
    half = max(1, min(numbers.size // (2 * _BLOCKS), at - 1, numbers.size - at - 1))
    place = np.searchsorted(numbers, cycle)
    return (place >= at - half) & (place < at + half)


def _left_out(model: ModelFit, block: NDArray[np.bool_]) -> Array:
    """Errors of predicting the readings of a block from those outside it, um."""
    fit = model.fit
    system = replace(fit.system, observed=~block)
    columns = np.column_stack([fit.response, fit.design])
    whitened, _ = system.whiten(columns)
    y, x = whitened[:, :1], whitened[:, 1:]
    for place, prior in model.priors():
        row = np.zeros((1, x.shape[1]))
        row[0, place] = fit.sigma / prior.u
        y, x = np.vstack([y, [[fit.sigma * prior.mean / prior.u]]]), np.vstack([x, row])
    coefficients = solve(x.T @ x, x.T @ y)[:, 0]
    levels = system.smooth(columns).levels
    drift = np.einsum("nc,ncp->np", fit.system.loadings, levels)
    through = columns[:, 1:] - drift[:, 1:]
    errors = columns[:, 0] - drift[:, 0] - through @ coefficients
    site = model.readings.site[model.used]
    return np.where(np.isin(site, site[~block]), errors, np.nan)[block]
