"""The table plan: its grid of square cells and the fiducials that lie on it, in millimetres."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import points_in_poly

from thermography.common import Array, ThermographyError

_REQUIRED_COLUMNS = ("name", "x_mm", "y_mm", "diameter_mm")
_HINT_COLUMNS = ("column_px", "row_px")
_MARKER_COLUMN = "marker"
#: Markers in the dictionary `thermography.registration.discs.DICTIONARY`.
_MARKER_COUNT = 50


class FiducialError(ThermographyError):
    """A fiducial file does not hold what a registration needs; the message names file, line, value and remedy."""


@dataclass(frozen=True)
class PlanGrid:
    """The table plan as a grid of square cells.

    The origin (0, 0) mm is a corner of the plan, not the centre of the first cell; x runs along the columns of a field (y, x),
    y along its rows.

    Attributes
    ----------
    width_mm, height_mm : float, mm
        Extent of the plan along x and y, whole multiples of the cell size.
    cell_size_mm : float, mm
        Side of a cell.

    Raises
    ------
    ThermographyError
        A length is not positive, or a side of the plan is not a whole number of cells.

    Examples
    --------
    >>> grid = PlanGrid(width_mm=700, height_mm=180, cell_size_mm=5)
    >>> grid.shape
    (36, 140)
    >>> float(grid.x_mm[0])
    2.5
    """

    width_mm: float
    height_mm: float
    cell_size_mm: float

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm", "cell_size_mm"):
            length = getattr(self, name)
            if not isinstance(length, Real) or not 0 < float(length) < np.inf:
                raise ThermographyError(f"{name} = {length} mm; the plan needs a positive length")
        for name, side in (("width_mm", self.width_mm), ("height_mm", self.height_mm)):
            cells = side / self.cell_size_mm
            if abs(cells - round(cells)) > 1e-6:
                raise ThermographyError(
                    f"{name} = {side} mm is not a whole number of cells of {self.cell_size_mm} mm; choose one that divides both"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells (y, x)."""
        return round(self.height_mm / self.cell_size_mm), round(self.width_mm / self.cell_size_mm)

    @property
    def x_mm(self) -> Array:
        """Cell centres along x, (x,) mm."""
        return (np.arange(self.shape[1]) + 0.5) * self.cell_size_mm

    @property
    def y_mm(self) -> Array:
        """Cell centres along y, (y,) mm."""
        return (np.arange(self.shape[0]) + 0.5) * self.cell_size_mm

    @property
    def centres_mm(self) -> Array:
        """Cell centres (x, y), shape (y, x, 2), mm."""
        return np.stack(np.meshgrid(self.x_mm, self.y_mm), axis=-1)

    def outline_mm(self, points_per_side: int) -> Array:
        """Points on the edge of the plan, in order around it.

        Parameters
        ----------
        points_per_side : int
            Including both corners of the side; every corner is listed twice.

        Returns
        -------
        (4 * points_per_side, 2) ndarray, mm
        """
        t = np.linspace(0, 1, points_per_side)
        zero, one = np.zeros_like(t), np.ones_like(t)
        sides = ((t, zero), (one, t), (1 - t, one), (zero, 1 - t))
        return np.concatenate([np.stack(side, axis=-1) for side in sides]) * (self.width_mm, self.height_mm)

    def contains(self, points_mm: Array, *, margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Tell which points lie on the plan.

        Parameters
        ----------
        points_mm : (..., 2) ndarray, mm
            Plan points (x, y).
        margin_mm : float, mm
            Least distance from the edge of the plan.

        Returns
        -------
        (...) ndarray of bool
        """
        x, y = points_mm[..., 0], points_mm[..., 1]
        inside_x = (x >= margin_mm) & (x <= self.width_mm - margin_mm)
        return inside_x & (y >= margin_mm) & (y <= self.height_mm - margin_mm)


@dataclass(frozen=True)
class Fiducial:
    """A disc on the table whose plan position is known, a point picked by hand, or an ArUco marker that identifies the plan.

    Attributes
    ----------
    name : str
    x_mm, y_mm : mm, centre on the plan
    diameter_mm : mm, of the disc, or of the circle that contains the marker with its quiet zone; 0 for a point
    column_px, row_px : float or None, px
        Hint where the disc appears in the frame; it may be wrong by tens of pixels. None: no hint. Of a point, its place itself.
    marker : number in the dictionary of 4 x 4 ArUco markers, 0 to 49; None for a disc
    u_mm : float, mm
        Standard uncertainty of x_mm and of y_mm in the list; 0 takes the list as exact but for the scatter that its places show.
    """

    name: str
    x_mm: float
    y_mm: float
    diameter_mm: float
    column_px: float | None = None
    row_px: float | None = None
    marker: int | None = None
    u_mm: float = 0.0

    @property
    def is_point(self) -> bool:
        """Whether this is a corner, bore or bolt whose place in the frame was picked by hand, not a painted disc."""
        return self.marker is None and self.diameter_mm == 0

    @property
    def hint_px(self) -> tuple[float, float] | None:
        """The hinted (column, row) in px, or None."""
        if self.column_px is None or self.row_px is None:
            return None
        return self.column_px, self.row_px


def read_fiducials(path: str | Path) -> list[Fiducial]:
    r"""Read the fiducials of a table plan from a CSV file.

    Parameters
    ----------
    path : str or Path
        CSV file with the columns ``name``, ``x_mm``, ``y_mm``, ``diameter_mm`` and, optionally, ``column_px``, ``row_px`` (an
        empty position means that there is no hint for that disc) and ``marker`` (a number makes the row an ArUco marker). Where
        ``diameter_mm`` is empty, nothing is painted: the row is a point that was picked by hand at ``column_px``, ``row_px``.

    Returns
    -------
    list of Fiducial
        In the order of the file. Duplicates of a name or a position are kept: `register` reports them.

    Raises
    ------
    FiducialError
        A column is missing, a value is not a finite number, a diameter is not positive, or fewer than four discs are listed.
    OSError
        The file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    Notes
    -----
    Columns and their meaning: docs/method/registration.md.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "fiducials.csv"
    >>> lines = ["name,x_mm,y_mm,diameter_mm", "F1,40,20,16", "F2,660,20,16", "F3,40,160,16", "F4,660,160,16"]
    >>> _ = path.write_text("\n".join(lines))
    >>> read_fiducials(path)[1]
    Fiducial(name='F2', x_mm=660.0, y_mm=20.0, diameter_mm=16.0, column_px=None, row_px=None, marker=None, u_mm=0.0)
    """
    path = Path(path)
    lines = read_lines(path, _REQUIRED_COLUMNS, FiducialError, optional=_HINT_COLUMNS)
    fiducials = [_parse(path, line, row) for line, row in lines if any(row.values())]
    discs = sum(fiducial.marker is None for fiducial in fiducials)
    points = sum(fiducial.is_point for fiducial in fiducials)
    if discs < 4:
        raise FiducialError(f"{path}: lists {discs} fiducials; a plan is located by at least 4")
    if points not in (0, discs):
        raise FiducialError(
            f"{path}: lists {discs - points} discs and {points} points without diameter_mm; a plan is located by discs or by points, "
            "not by both: give every disc its diameter, or leave it empty everywhere and give column_px,row_px"
        )
    return fiducials


def read_lines(
    path: Path, columns: Sequence[str], error: type[Exception], *, optional: Sequence[str] = ()
) -> list[tuple[int, dict[str, str]]]:
    """Return the lines of a CSV file of named places, each with its number; raise `error` where it is no such file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            header = [column.strip() for column in reader.fieldnames or []]
            missing = [column for column in columns if column not in header]
            if missing:
                left_out = " (the last two may be left out)" if optional else ""
                raise error(
                    f"{path}:1: no column {', '.join(missing)}; the first line must read {','.join((*columns, *optional))}{left_out}"
                )
            reader.fieldnames = header
            return [(reader.line_num, row) for row in reader]
    except UnicodeDecodeError as fault:
        raise error(f"{path}: byte {fault.start} is not UTF-8; save the file as CSV in UTF-8") from None
    except csv.Error as fault:
        raise error(f"{path}: is not CSV ({fault}); save the file as CSV in UTF-8") from None


def mask_discs(points_mm: Array, fiducials: Sequence[Fiducial], *, margin_mm: Array | float) -> NDArray[np.bool_]:
    """Tell which plan points lie on a fiducial or near its rim, where a pixel does not show the table's temperature."""
    masked = np.zeros(points_mm.shape[:-1], bool)
    across, down = np.ascontiguousarray(np.moveaxis(points_mm, -1, 0))
    for disc in fiducials:
        reach = np.broadcast_to(disc.diameter_mm / 2 + np.asarray(margin_mm, float), masked.shape)
        # Few points are near a disc; the distance of all would take ten times as long. The allowance covers the rounding of the distance.
        box = reach * (1 + 1e-9)
        near = (np.abs(across - disc.x_mm) <= box) & (np.abs(down - disc.y_mm) <= box)
        masked[near] |= np.hypot(across[near] - disc.x_mm, down[near] - disc.y_mm) < reach[near]
    return masked


def _parse(path: Path, line: int, row: dict[str, str]) -> Fiducial:
    name = (row["name"] or "").strip()
    if not name:
        raise FiducialError(f"{path}:{line}: name is empty; give every fiducial a name")
    point = not (row["diameter_mm"] or "").strip()
    x_mm, y_mm = (_number(path, line, column, row[column]) for column in _REQUIRED_COLUMNS[1:3])
    diameter_mm = 0.0 if point else _number(path, line, "diameter_mm", row["diameter_mm"])
    if diameter_mm <= 0 and not point:
        raise FiducialError(
            f"{path}:{line}: diameter_mm = {row['diameter_mm']}; a disc has a positive diameter, a point picked by hand an empty one"
        )
    marker = (row.get(_MARKER_COLUMN) or "").strip()
    if marker:
        if not marker.isdecimal() or int(marker) >= _MARKER_COUNT:
            raise FiducialError(f"{path}:{line}: marker = {marker!r}; give an ArUco number, 0 to {_MARKER_COUNT - 1}")
        if point:
            raise FiducialError(f"{path}:{line}: diameter_mm is empty; give the circle that contains the marker")
        return Fiducial(name, x_mm, y_mm, diameter_mm, marker=int(marker))
    hints = [(row.get(column) or "").strip() for column in _HINT_COLUMNS]
    if all(hints):
        column_px, row_px = (_number(path, line, key, text) for key, text in zip(_HINT_COLUMNS, hints, strict=True))
        return Fiducial(name, x_mm, y_mm, diameter_mm, column_px, row_px)
    if any(hints):
        raise FiducialError(f"{path}:{line}: {name} has one of column_px, row_px; give both or neither")
    if point:
        raise FiducialError(
            f"{path}:{line}: {name} has neither diameter_mm (of a painted disc) nor column_px, row_px (of a point picked in a frame)"
        )
    return Fiducial(name, x_mm, y_mm, diameter_mm)


def _number(path: Path, line: int, column: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise FiducialError(f"{path}:{line}: {column} = {text!r} is not a number; write it with a point and no unit")
    return value


# Polygons on the table plan: which points lie inside, and how much of every plan cell.

#: Points per cell and side by which a polygon's share of a cell is counted.
_POINTS_PER_SIDE = 10


class PolygonError(ThermographyError):
    """A polygon encloses nothing or does not lie on the seen plan; the message names it and its place."""


@dataclass(frozen=True, eq=False)
class Polygon:
    """A named simple polygon on the table plan: at least three corners (n, 2), mm, in order and in either sense."""

    name: str
    corners_mm: Array

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners_mm, float)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise PolygonError(f"{self.name}: corners have shape {corners.shape}; give at least three (x, y) in mm")
        object.__setattr__(self, "corners_mm", corners)

    def contains(self, points_mm: ArrayLike) -> NDArray[np.bool_]:
        """Tell which plan points lie inside."""
        points = np.asarray(points_mm, float)
        inside: NDArray[np.bool_] = points_in_poly(points.reshape(-1, 2), self.corners_mm)
        return inside.reshape(points.shape[:-1])

    def cell_shares(self, x_mm: Array, y_mm: Array) -> Array:
        """Share of the area of every cell that lies inside, counted by 10 x 10 points per cell."""
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
