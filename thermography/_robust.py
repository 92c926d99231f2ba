"""Scatter of values among which some do not belong."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

#: Median absolute deviation of a standard normal distribution.
_NORMAL_MEDIAN = float(special.ndtri(0.75))


def scatter_by_median(values: ArrayLike, *, centre: float | None = None) -> float:
    """Standard deviation of normal values by their median absolute deviation, which up to half of them cannot spoil.

    Parameters
    ----------
    values : array_like
        Of any shape; NaN are left out.
    centre : float, optional
        From which the deviations count, in the unit of the values; their median by default.

    Returns
    -------
    float
        In the unit of the values; NaN without values.

    Notes
    -----
    Hampel, "The influence curve and its role in robust estimation", J. Am. Stat. Assoc. 69 (1974) 383. Written here because
    ``scipy.stats``, which has the same, takes a quarter of a second and 20 MB to load, at every start of the command.
    """
    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if known.size == 0:
        return float("nan")
    about = np.median(known) if centre is None else centre
    return float(np.median(np.abs(known - about))) / _NORMAL_MEDIAN
