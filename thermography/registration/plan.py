"""The table plan: its grid of cells in millimetres and the disc fiducials that lie on it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError

REQUIRED_COLUMNS = ("name", "x_mm", "y_mm", "diameter_mm")
HINT_COLUMNS = ("column_px", "row_px")
MARKER_COLUMN = "marker"
#: Markers in the dictionary.
MARKERS = 50


class FiducialError(ThermographyError):
    """A fiducial file does not hold what a registration needs; the message names file, line, value and remedy."""


@dataclass(frozen=True)
class PlanGrid:
    """The table plan as a grid of square cells; (0, 0) mm is the plan's corner, not the first cell's centre.

    Raises
    ------
    ThermographyError
        A size is not positive or is not a whole number of cells.
    """

    width_mm: float
    height_mm: float
    cell_size_mm: float

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm", "cell_size_mm"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ThermographyError(f"{name} = {getattr(self, name)} mm; the plan needs a positive length")
        for name in ("width_mm", "height_mm"):
            cells = getattr(self, name) / self.cell_size_mm
            if abs(cells - round(cells)) > 1e-6:
                raise ThermographyError(
                    f"{name} = {getattr(self, name)} mm is not a whole number of cells of {self.cell_size_mm} mm; "
                    "choose a cell size that divides both sides of the plan"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells (y, x)."""
        return round(self.height_mm / self.cell_size_mm), round(self.width_mm / self.cell_size_mm)

    @property
    def x_mm(self) -> Array:
        """Cell centres along x, shape (x,), mm."""
        return (np.arange(self.shape[1]) + 0.5) * self.cell_size_mm

    @property
    def y_mm(self) -> Array:
        """Cell centres along y, shape (y,), mm."""
        return (np.arange(self.shape[0]) + 0.5) * self.cell_size_mm

    def contains(self, points_mm: Array, *, margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Tell which points, shape (..., 2), lie on the plan at least `margin_mm` from its edge."""
        x, y = points_mm[..., 0], points_mm[..., 1]
        inside_x = (x >= margin_mm) & (x <= self.width_mm - margin_mm)
        return inside_x & (y >= margin_mm) & (y <= self.height_mm - margin_mm)


@dataclass(frozen=True)
class Fiducial:
    """A disc on the table plan; the pixel position, where given, is only a hint of where to look for it.

    With a `marker` number it is an ArUco marker (4 x 4, one of 50) within a circle of that diameter, which tells only which plan this is.
    """

    name: str
    x_mm: float
    y_mm: float
    diameter_mm: float
    column_px: float | None = None
    row_px: float | None = None
    marker: int | None = None

    @property
    def hint_px(self) -> tuple[float, float] | None:
        """The hinted (column, row) in px, or None."""
        if self.column_px is None or self.row_px is None:
            return None
        return self.column_px, self.row_px


def read_fiducials(path: str | Path) -> list[Fiducial]:
    """Read a fiducial table with the columns name, x_mm, y_mm, diameter_mm and, optionally, column_px, row_px, marker.

    Parameters
    ----------
    path
        CSV file; an empty pixel position means that there is no hint for that disc. A number in `marker` makes the row an ArUco marker.

    Returns
    -------
    list[Fiducial]
        In the order of the file, a name or place listed twice included: `register` reports it.

    Raises
    ------
    FiducialError
        A column is missing, a value is not a finite number, a diameter is not positive, or fewer than four discs are listed.
    """
    path = Path(path)
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        header = [column.strip() for column in reader.fieldnames or []]
        missing = [column for column in REQUIRED_COLUMNS if column not in header]
        if missing:
            raise FiducialError(
                f"{path}:1: no column {', '.join(missing)}; "
                f"the first line must read {','.join(REQUIRED_COLUMNS + HINT_COLUMNS)} (the last two may be left out)"
            )
        reader.fieldnames = header
        fiducials = [_parse(path, reader.line_num, row) for row in reader if any(row.values())]
    discs = sum(one.marker is None for one in fiducials)
    if discs < 4:
        raise FiducialError(f"{path}: lists {discs} fiducials; a plan is located by at least 4")
    return fiducials


def mask_discs(points_mm: Array, fiducials: Sequence[Fiducial], *, margin_mm: Array | float) -> NDArray[np.bool_]:
    """Tell which plan points, shape (..., 2), lie on a disc or nearer than `margin_mm` to its rim."""
    masked = np.zeros(points_mm.shape[:-1], bool)
    for disc in fiducials:
        distance = np.hypot(points_mm[..., 0] - disc.x_mm, points_mm[..., 1] - disc.y_mm)
        masked |= distance < disc.diameter_mm / 2 + margin_mm
    return masked


def _parse(path: Path, line: int, row: dict[str, str]) -> Fiducial:
    name = (row["name"] or "").strip()
    if not name:
        raise FiducialError(f"{path}:{line}: name is empty; give every fiducial a name")
    x_mm, y_mm, diameter_mm = (_number(path, line, column, row[column]) for column in REQUIRED_COLUMNS[1:])
    if diameter_mm <= 0:
        raise FiducialError(f"{path}:{line}: diameter_mm = {row['diameter_mm']}; a disc has a positive diameter")
    marker = (row.get(MARKER_COLUMN) or "").strip()
    if marker:
        if not marker.isdecimal() or int(marker) >= MARKERS:
            raise FiducialError(
                f"{path}:{line}: marker = {marker!r}; give the number of an ArUco marker, 0 to {MARKERS - 1}"
            )
        return Fiducial(name, x_mm, y_mm, diameter_mm, marker=int(marker))
    hints = [(row.get(column) or "").strip() for column in HINT_COLUMNS]
    if all(hints):
        column_px, row_px = (
            _number(path, line, column, text) for column, text in zip(HINT_COLUMNS, hints, strict=True)
        )
        return Fiducial(name, x_mm, y_mm, diameter_mm, column_px, row_px)
    if any(hints):
        raise FiducialError(f"{path}:{line}: {name} has one of column_px, row_px; give both or neither")
    return Fiducial(name, x_mm, y_mm, diameter_mm)


def _number(path: Path, line: int, column: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise FiducialError(
            f"{path}:{line}: {column} = {text!r} is not a number; write it with a decimal point and no unit"
        )
    return value
