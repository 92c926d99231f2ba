"""Places on the plan as areas: the cells that belong together around a peak, and the rectangle that names them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from fusion._typing import Array

#: Cells that reach at least this share of the peak of a mode belong to its place.
IN_MODE = 0.5


@dataclass(frozen=True)
class Area:
    """A part of the plan by the rectangle around it.

    Attributes
    ----------
    x_low_mm, x_high_mm, y_low_mm, y_high_mm : float, mm
        Edges of its outermost cells.
    """

    x_low_mm: float
    x_high_mm: float
    y_low_mm: float
    y_high_mm: float


def piece_with_peak(strength: Array, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the connected piece of cells that holds the strongest one.

    Parameters
    ----------
    strength : (y, x) ndarray
        What the strongest cell is strongest in, any unit, without NaN.
    inside : (y, x) ndarray of bool
        Cells that may belong to it, the strongest one among them; cells that touch at a corner are connected.

    Returns
    -------
    (y, x) ndarray of bool
    """
    labels, _ = ndimage.label(inside, np.ones((3, 3)))
    return np.asarray(labels == labels[np.unravel_index(int(strength.argmax()), strength.shape)], bool)


def mode_cells(pattern: Array) -> NDArray[np.bool_]:
    """Return the cells of a thermal mode: connected to its peak, with at least half of its strength.

    Parameters
    ----------
    pattern : (y, x) ndarray
        1 at the peak, NaN where nothing was seen.

    Returns
    -------
    (y, x) ndarray of bool
    """
    strength = np.abs(np.nan_to_num(pattern))
    return piece_with_peak(strength, strength >= IN_MODE)


def area_of(cells: NDArray[np.bool_], plan: xr.Dataset) -> Area | None:
    """Return the rectangle around some cells.

    Parameters
    ----------
    cells : (y, x) ndarray of bool
        Cells of the plan.
    plan : Dataset
        With ``x`` and ``y`` of the cells, mm, evenly spaced.

    Returns
    -------
    Area or None
        None without any cell.

    Examples
    --------
    >>> plan = xr.Dataset(coords={"y": [5.0, 15.0], "x": [5.0, 15.0, 25.0]})
    >>> area_of(np.array([[False, True, True], [False, False, False]]), plan)
    Area(x_low_mm=10.0, x_high_mm=30.0, y_low_mm=0.0, y_high_mm=10.0)
    """
    if not cells.any():
        return None
    x, y = plan["x"].values, plan["y"].values
    half = float(np.median(np.diff(x))) / 2
    across, along = x[cells.any(axis=0)], y[cells.any(axis=1)]
    return Area(
        float(across.min() - half), float(across.max() + half), float(along.min() - half), float(along.max() + half)
    )
