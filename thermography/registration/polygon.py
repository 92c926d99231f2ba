"""Polygons on the table plan: which points lie inside, and how much of every plan cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import points_in_poly

from thermography._typing import Array
from thermography.errors import ThermographyError

#: Points per cell and side by which a polygon's share of a cell is counted.
_POINTS_PER_SIDE = 10


class PolygonError(ThermographyError):
    """A polygon encloses nothing or does not lie on the seen plan; the message names it and its place."""


@dataclass(frozen=True, eq=False)
class Polygon:
    """A simple polygon on the table plan.

    Attributes
    ----------
    name : str
        Names the polygon in messages.
    corners_mm : (n, 2) ndarray, mm
        Corners (x, y) in order, at least three, either sense; the last one is joined to the first.

    Raises
    ------
    PolygonError
        There are fewer than three corners, or they are not pairs.

    Examples
    --------
    >>> triangle = Polygon("triangle", [(0, 0), (100, 0), (0, 50)])
    >>> triangle.contains([(20, 20), (90, 40)])
    array([ True, False])
    """

    name: str
    corners_mm: Array

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners_mm, float)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise PolygonError(
                f"{self.name}: corners have shape {corners.shape}; a polygon needs at least three (x, y) in mm"
            )
        object.__setattr__(self, "corners_mm", corners)

    def contains(self, points_mm: ArrayLike) -> NDArray[np.bool_]:
        """Tell which plan points lie inside.

        Parameters
        ----------
        points_mm : (..., 2) array, mm
            Plan points (x, y).

        Returns
        -------
        (...) ndarray of bool
            By the even-odd rule of `skimage.measure.points_in_poly`; points on an edge may lie on either side of it.
        """
        points = np.asarray(points_mm, float)
        inside: NDArray[np.bool_] = points_in_poly(points.reshape(-1, 2), self.corners_mm)
        return inside.reshape(points.shape[:-1])

    def cell_shares(self, x_mm: Array, y_mm: Array) -> Array:
        """Share of the area of every cell that lies inside, counted by 10 x 10 points per cell.

        Parameters
        ----------
        x_mm, y_mm : (x,) and (y,) ndarray, mm
            Centres of square cells in equal steps, rising.

        Returns
        -------
        (y, x) ndarray
            0 to 1.

        Raises
        ------
        PolygonError
            The polygon touches no cell.
        """
        cell_mm = float(x_mm[1] - x_mm[0])
        low, high = self.corners_mm.min(axis=0), self.corners_mm.max(axis=0)
        columns = np.flatnonzero((x_mm + cell_mm / 2 > low[0]) & (x_mm - cell_mm / 2 < high[0]))
        rows = np.flatnonzero((y_mm + cell_mm / 2 > low[1]) & (y_mm - cell_mm / 2 < high[1]))
        shares = np.zeros((len(y_mm), len(x_mm)))
        if rows.size and columns.size:
            steps = ((np.arange(_POINTS_PER_SIDE) + 0.5) / _POINTS_PER_SIDE - 0.5) * cell_mm
            x, y = np.meshgrid((x_mm[columns, None] + steps).ravel(), (y_mm[rows, None] + steps).ravel())
            inside = self.contains(np.stack([x, y], axis=-1))
            per_cell = inside.reshape(len(rows), _POINTS_PER_SIDE, len(columns), _POINTS_PER_SIDE)
            shares[np.ix_(rows, columns)] = per_cell.mean(axis=(1, 3))
        if not shares.any():
            extent = f"x {low[0]:g}..{high[0]:g}, y {low[1]:g}..{high[1]:g} mm"
            raise PolygonError(f"{self.name}: ({extent}) holds no part of the plan; give its corners in plan mm")
        return shares
