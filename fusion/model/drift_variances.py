"""How much drift there may be: the grids of drift variances over which a likelihood is maximised or drawn from.

A drift that was estimated without a candidate has already taken up part of what the candidate explains, so its variances are chosen anew
for every candidate from a grid about their estimate. The grids reach from no drift to ten times as much, because the simulated data of
the null hypothesis hold that much and a strong drift must not be mistaken for an effect there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion._typing import Array
from interferometry.drift.gls import DriftFit, fit_fixed_effects
from interferometry.drift.state_space import DriftSystem

#: log10 factors on the variances of a common drift and of a stretch: as estimated, less of one or both, more of one or both.
SHIFT_AND_STRETCH = (
    (0.0, 0.0),
    (-1.0, 0.0),
    (-2.5, 0.0),
    (0.0, -1.0),
    (0.0, -2.5),
    (-1.0, -1.0),
    (-2.5, -2.5),
    (-6.0, -6.0),
    (0.5, 0.5),
    (1.0, 0.0),
    (0.0, 1.0),
    (1.0, 1.0),
)
#: The same for the single drift of a channel.
SINGLE = ((-6.0,), (-2.5,), (-1.0,), (0.0,), (0.5,), (1.0,))
#: log10 factors among which the variances of simulated data are drawn.
_PLAUSIBLE = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])


def scaled_systems(
    fit: DriftFit, exponents: Sequence[Sequence[float]], *, over: DriftSystem | None = None
) -> list[DriftSystem]:
    """Scale the estimated drift variances of a fit by every set of factors of a grid.

    Parameters
    ----------
    fit : the fit whose variances are at the centre of the grid
    exponents : sets of log10 factors, one factor for each component of the drift; a shorter set is repeated
    over : readings on which the drift is laid; by default those of the fit

    Returns
    -------
    list of DriftSystem
        One for each set, in the order of the grid.
    """
    system = fit.system if over is None else over
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    return [replace(system, ratios=centre * np.resize(10.0 ** np.asarray(one), centre.size)) for one in exponents]


def least_ratio(system: DriftSystem) -> float:
    """Variance ratio of a drift that can hardly be told from none.

    Parameters
    ----------
    system : the drift and its readings

    Returns
    -------
    float
        Variance per second (order 1) or per cubic second (order 2), relative to that of a reading, of a drift whose standard deviation
        at the end of the readings is a quarter of one reading's noise.
    """
    span = float(system.seconds[-1] - system.seconds[0])
    return 0.0625 / span if system.order == 1 else 3.0 * 0.0625 / span**3


def plausible_ratios(fit: DriftFit, rng: np.random.Generator, *, draws: int) -> Array:
    """Draw drift variances that the readings leave possible, in proportion to their restricted likelihood.

    A drift that was estimated as zero may well be present; simulating none would make every slow course look significant.

    Parameters
    ----------
    fit : the fit whose variances are in doubt
    rng : source of random numbers
    draws : number of draws

    Returns
    -------
    (draws, components) ndarray
        Variance ratios.
    """
    centre = np.maximum(fit.system.ratios, least_ratio(fit.system))
    components = centre.size
    exponents = np.stack(np.meshgrid(*[_PLAUSIBLE] * components, indexing="ij"), axis=-1).reshape(-1, components)
    tried = centre * 10.0**exponents
    likelihood = np.array(
        [
            fit_fixed_effects(replace(fit.system, ratios=ratios), fit.response, fit.design).log_likelihood
            for ratios in tried
        ]
    )
    weight = np.exp(likelihood - likelihood.max())
    return tried[rng.choice(weight.size, size=draws, p=weight / weight.sum())]
