"""Positions whose readings scatter more, or less, than before: each against the change of all others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from thermography._robust import scatter_by_median

Array = NDArray[np.float64]

#: Degrees of freedom that a position must have in both tests to be compared.
_LEAST_FREEDOM = 2.0


@dataclass(frozen=True)
class ScatterChange:
    """Change of the scatter at one position.

    Attributes
    ----------
    position_mm : float
    before_um, after_um : float
        Standard deviation of a reading after profile and drift were subtracted, um.
    p_value : float
        Two-sided, of this position by itself.
    """

    position_mm: float
    before_um: float
    after_um: float
    p_value: float


def compare_scatters(
    position_mm: Array, before_um: Array, after_um: Array, before_freedom: Array, after_freedom: Array
) -> list[ScatterChange]:
    """Compare the scatter at every position of two tests.

    Parameters
    ----------
    position_mm : (n,) ndarray
        Positions, mm.
    before_um, after_um : (n,) ndarray
        Scatter, um; a position without one is left out.
    before_freedom, after_freedom : (n,) ndarray
        Its degrees of freedom.

    Returns
    -------
    list of ScatterChange
        In the order of the positions; empty with fewer than five of them.

    Notes
    -----
    Air and laser may scatter more on one day than on another, at all positions alike: the ratio of the variances at a position is taken
    over the median ratio and tested with F. Where the ratios differ from position to position by more than normal readings allow, by
    their median absolute deviation, the degrees of freedom are lowered until they do not.
    """
    used = (before_um > 0) & (after_um > 0) & (before_freedom >= _LEAST_FREEDOM) & (after_freedom >= _LEAST_FREEDOM)
    if used.sum() < 5:
        return []
    place, one, other = position_mm[used], before_um[used], after_um[used]
    freedoms = np.stack([before_freedom[used], after_freedom[used]]) * (1.0 - 1.0 / used.sum())
    ratio = 2.0 * np.log(other / one)
    beyond = ratio - np.median(ratio)
    expected = special.polygamma(1, freedoms / 2.0).sum(axis=0)
    spread = scatter_by_median(beyond / np.sqrt(expected), centre=0.0)
    earlier, later = np.maximum(freedoms / max(spread, 1.0) ** 2, 1.0)
    f_ratio = np.exp(beyond) * special.fdtri(later, earlier, 0.5)
    p = 2.0 * np.minimum(special.fdtrc(later, earlier, f_ratio), special.fdtr(later, earlier, f_ratio))
    return [
        ScatterChange(float(at), float(was), float(now), float(min(chance, 1.0)))
        for at, was, now, chance in zip(place, one, other, p, strict=True)
    ]
