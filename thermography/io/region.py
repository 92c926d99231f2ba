"""A part of the picture that is evaluated: spot, box, ellipse, line or polygon, in pixels of the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography.common import Array, ThermographyError

RegionKind = Literal["spot", "box", "ellipse", "line", "polygon"]
#: Kind -> fewest and most points.
_POINTS: dict[str, tuple[int, float]] = {
    "spot": (1, 1),
    "box": (2, 2),
    "ellipse": (2, 2),
    "line": (2, np.inf),
    "polygon": (3, np.inf),
}


@dataclass(frozen=True)
class Region:
    """A part of the picture.

    Attributes
    ----------
    name : str
        Label on the screen of the camera, or as the user gives it.
    kind : {"spot", "box", "ellipse", "line", "polygon"}
        A spot is one pixel; a line may have more than two points.
    points : tuple of (column, row)
        In pixels, the centre of the first pixel being (0, 0): the spot, two opposite corners of a box or of the box around an ellipse, the
        points of a line, the corners of a polygon. The pixels named belong to the region.
    emissivity : float or None
        Of the surface in the region; None: that of the picture.

    Raises
    ------
    ThermographyError
        Where the kind is unknown, points are missing or too many, or the emissivity is no fraction.

    Examples
    --------
    >>> Region("bearing", "box", ((10, 20), (29, 39)), emissivity=0.9).pixels((120, 160))[:2]
    (slice(20, 40, None), slice(10, 30, None))
    """

    name: str
    kind: RegionKind
    points: tuple[tuple[float, float], ...]
    emissivity: float | None = None

    def __post_init__(self) -> None:
        where = f"region {self.name!r}"
        if self.kind not in _POINTS:
            raise ThermographyError(f"{where}: kind = {self.kind!r}; give one of {', '.join(get_args(RegionKind))}")
        fewest, most = _POINTS[self.kind]
        places = np.asarray(self.points, float)
        if places.ndim != 2 or places.shape[1] != 2 or not np.isfinite(places).all():
            raise ThermographyError(f"{where}: points = {self.points!r}; give (column, row) of every point, in pixels")
        if not fewest <= len(places) <= most:
            wanted = f"{fewest}" if fewest == most else f"{fewest} or more"
            raise ThermographyError(f"{where}: a {self.kind} of {len(places)} points; it has {wanted}")
        if self.emissivity is not None and not 0 < self.emissivity <= 1:
            raise ThermographyError(f"{where}: emissivity = {self.emissivity:g}; give a fraction above 0 and up to 1")
        object.__setattr__(self, "points", tuple((float(column), float(row)) for column, row in self.points))

    def pixels(self, shape: tuple[int, int]) -> tuple[slice, slice, NDArray[np.uint8]]:
        """Return rows and columns of the region in a picture of (rows, columns), and which pixels between them belong to it.

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of the picture.

        Returns
        -------
        rows, columns : slice
            Of the smallest window around the region.
        mask : (row, column) ndarray of uint8
            1 in the region, else 0.

        Raises
        ------
        ThermographyError
            Where no pixel of the region lies in the picture.
        """
        rows, columns = shape
        places = self.path() if self.kind == "line" else np.rint(np.asarray(self.points)).astype(np.int64)
        low, high = np.maximum(places.min(axis=0), 0), np.minimum(places.max(axis=0), (columns - 1, rows - 1))
        mask = np.zeros(np.maximum(high - low + 1, 0)[::-1], np.uint8)
        if not mask.size:
            pass
        elif self.kind == "line":
            inside = ((places >= low) & (places <= high)).all(axis=1)
            mask[tuple((places[inside] - low).T[::-1])] = 1
        elif self.kind == "polygon":
            cv2.fillPoly(mask, [(places - low).astype(np.int32)], 1)
        elif self.kind == "ellipse":
            centre, half = places.mean(axis=0), (np.ptp(places, axis=0) + 1) / 2
            row, column = np.ogrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
            mask[((column - centre[0]) / half[0]) ** 2 + ((row - centre[1]) / half[1]) ** 2 <= 1] = 1
        else:
            mask[:] = 1
        if not mask.any():
            raise ThermographyError(
                f"region {self.name!r}: {self.kind} at {', '.join(f'{c:g},{r:g}' for c, r in self.points)} lies outside the picture "
                f"of {columns} x {rows} pixels; give (column, row) from 0,0 to {columns - 1},{rows - 1}"
            )
        return slice(int(low[1]), int(high[1]) + 1), slice(int(low[0]), int(high[0]) + 1), mask

    def is_cut(self, shape: tuple[int, int]) -> bool:
        """Return whether a part of the region lies outside a picture of (rows, columns)."""
        places = np.rint(np.asarray(self.points))
        return bool((places < 0).any() or (places >= shape[::-1]).any())

    def path(self) -> Array:
        """Pixels from the first point over the others to the last, (n, 2) column and row."""
        points = np.rint(np.asarray(self.points)).astype(np.int64)
        parts = [points[:1]]
        for begin, end in pairwise(points):
            steps = np.linspace(0, 1, int(np.abs(end - begin).max()) + 1)[1:, None]
            parts.append(np.rint(begin + steps * (end - begin)).astype(np.int64))
        return np.concatenate(parts)
