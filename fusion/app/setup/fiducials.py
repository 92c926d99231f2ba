"""Fiducials in a thermogram: found by the registration, or placed by hand with the residual of every place."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FusionError
from fusion.products.store import write_text
from thermography.errors import ThermographyError
from thermography.io.frame_readers import index_recordings
from thermography.io.temperature_frames import StackOptions
from thermography.radiometry.planck import calibrate
from thermography.registration.discs import detect_discs
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.register import Registration, register, register_points

#: Name of the list that the application writes; a list that was there before stays.
PICKED = "fiducials_picked.csv"
_COLUMNS = ("name", "x_mm", "y_mm", "diameter_mm", "column_px", "row_px", "marker")
#: A click this close to a disc means its centre, px.
_SNAP_PX = 12.0


class FiducialsError(FusionError):
    """Fiducials that cannot be found or written; the message says why and what to do."""


@dataclass(frozen=True)
class Placed:
    """Fiducials with their places in the frame, and how well these agree.

    Attributes
    ----------
    fiducials : tuple of Fiducial
        ``column_px`` and ``row_px`` are the places, None where one has none yet.
    residual_mm : dict of str to float
        Distance on the plan between the place and the listed position, by name; empty where nothing can be told.
    registration : Registration or None
        None where fewer than four are placed, or they contradict one another.
    message : str
        Why nothing can be told, or how well the places agree.
    """

    fiducials: tuple[Fiducial, ...] = ()
    residual_mm: dict[str, float] = field(default_factory=dict)
    registration: Registration | None = None
    message: str = ""

    def named(self, name: str) -> Fiducial:
        """Return the fiducial of a name."""
        return next(one for one in self.fiducials if one.name == name)


def first_thermogram(paths: Sequence[Path], *, of_temperatures: bool = False) -> NDArray[np.float64]:
    """Return the temperatures of the first frame of a series.

    Parameters
    ----------
    paths : sequence of Path
        Its files.
    of_temperatures : bool
        Whether they hold temperatures of another camera; these are shown as they are stored.

    Returns
    -------
    (row, column) ndarray, degC
        With the parameters that the frame stores.

    Raises
    ------
    FiducialsError
        If no frame can be read.
    ThermographyError
        If its pixels are damaged.
    """
    options = StackOptions(
        scale=np.nextafter(1.0, 2.0), unit="degC", start=np.datetime64("2000-01-01", "ns"), interval_s=1.0
    )
    frames, rejected = index_recordings(paths[:1], options if of_temperatures else None)
    if not frames:
        reason = rejected[0].reason if rejected else "there is none"
        raise FiducialsError(f"no frame can be shown: {reason}; copy the file again from the camera")
    return np.asarray(calibrate(frames[0].read_counts(), frames[0].parameters), float)


def find(frame: NDArray[np.float64], fiducials: Sequence[Fiducial], grid: PlanGrid | None) -> Placed:
    """Find listed fiducials in a frame, as a run does.

    Parameters
    ----------
    frame : (row, column) ndarray, degC
        Thermogram.
    fiducials : sequence of Fiducial
        As listed; places serve as hints.
    grid : PlanGrid or None
        The plan.

    Returns
    -------
    Placed
        Without a place for those that were not found; the message names them.
    """
    shown = [one for one in fiducials if _is_complete(one)]
    try:
        found = register(frame, shown, grid=grid)
    except ThermographyError as error:
        return replace(place(fiducials, frame.shape), message=f"Not found automatically: {error}")
    placed = tuple(
        replace(one, column_px=disc.column_px, row_px=disc.row_px)
        if disc is not None
        else replace(one, column_px=None, row_px=None)
        for one, disc in ((one, found.located.get(one.name)) for one in fiducials)
    )
    left_out = "".join(f" {name}: {reason}." for name, reason in found.left_out.items())
    return Placed(placed, _residuals(found, placed), found, _agreement(found) + left_out)


def place(fiducials: Sequence[Fiducial], shape: tuple[int, ...]) -> Placed:
    """Tell how well places that were picked agree with the listed positions.

    Parameters
    ----------
    fiducials : sequence of Fiducial
        With their places.
    shape : (int, int)
        Rows and columns of the frame.

    Returns
    -------
    Placed
        With the residual of every place where at least four are picked.
    """
    listed = tuple(fiducials)
    picked = [one for one in listed if one.hint_px is not None and _is_complete(one)]
    if len(picked) < 4:
        return Placed(
            listed,
            message=f"{len(picked)} of at least 4 fiducials have a place in the frame and a position on the plan.",
        )
    try:
        found = register_points({one.name: one.hint_px for one in picked if one.hint_px}, picked, (shape[0], shape[1]))
    except ThermographyError as error:
        return Placed(listed, message=f"The places contradict one another: {error}")
    residuals = _residuals(found, picked)
    outside = [name for name in residuals if name not in found.located]
    apart = "".join(f" {name} lies {residuals[name]:.2f} mm from where the others expect it." for name in outside)
    return Placed(listed, residuals, found, _agreement(found) + apart)


def snapped(frame: NDArray[np.float64], column_px: float, row_px: float) -> tuple[float, float]:
    """Return the centre of the disc at a click, or the click itself where there is none.

    Parameters
    ----------
    frame : (row, column) ndarray, degC
        Thermogram.
    column_px, row_px : float, px
        The click.
    """
    near = [
        spot for spot in detect_discs(frame) if math.hypot(spot.column_px - column_px, spot.row_px - row_px) <= _SNAP_PX
    ]
    # Noise makes small spots, a disc a large one.
    disc = max(near, key=lambda spot: spot.area_px, default=None)
    return (column_px, row_px) if disc is None else (disc.column_px, disc.row_px)


def added(placed: Placed, column_px: float, row_px: float, shape: tuple[int, ...]) -> tuple[Placed, str]:
    """Add a fiducial at a place of the frame.

    Parameters
    ----------
    placed : Placed
        Present ones.
    column_px, row_px : float, px
        Place of the new one.
    shape : (int, int)
        Rows and columns of the frame.

    Returns
    -------
    Placed
        With the new one, whose position on the plan is estimated from the others; NaN where they do not determine it.
    str
        Its name.
    """
    taken = {one.name for one in placed.fiducials}
    name = next(f"F{number}" for number in range(1, len(taken) + 2) if f"F{number}" not in taken)
    x_mm = y_mm = math.nan
    if placed.registration is not None:
        x_mm, y_mm = np.round(placed.registration.to_plan(np.array([column_px, row_px])), 1).tolist()
    diameter = placed.fiducials[-1].diameter_mm if placed.fiducials else 0.0
    return place([*placed.fiducials, Fiducial(name, x_mm, y_mm, diameter, column_px, row_px)], shape), name


def changed(placed: Placed, name: str, shape: tuple[int, ...], **values: float) -> Placed:
    """Change a fiducial: its place in the frame, its position on the plan, its diameter.

    Parameters
    ----------
    placed : Placed
        Present ones.
    name : str
        Which.
    shape : (int, int)
        Rows and columns of the frame.
    **values : float
        Attributes of `Fiducial`.
    """
    fiducials = [replace(one, **values) if one.name == name else one for one in placed.fiducials]  # type: ignore[arg-type]
    found = place(fiducials, shape)
    others = place([one for one in fiducials if one.name != name], shape).registration
    return found if found.registration is not None or others is None else seen_by(others, fiducials, name)


def seen_by(others: Registration, fiducials: Sequence[Fiducial], name: str) -> Placed:
    """Tell where one fiducial lies by a registration to which it has not contributed, as while it is dragged.

    Parameters
    ----------
    others : Registration
        By the other fiducials.
    fiducials : sequence of Fiducial
        All of them.
    name : str
        Which one.
    """
    residuals = _residuals(others, fiducials)
    told = f" {name} lies {residuals[name]:.2f} mm from where the others expect it." if name in residuals else ""
    return Placed(tuple(fiducials), residuals, others, _agreement(others) + told)


def removed(placed: Placed, name: str, shape: tuple[int, ...]) -> Placed:
    """Take a fiducial away.

    Parameters
    ----------
    placed : Placed
        Present ones.
    name : str
        Which.
    shape : (int, int)
        Rows and columns of the frame.
    """
    return place([one for one in placed.fiducials if one.name != name], shape)


def nearest(placed: Placed, column_px: float, row_px: float, *, reach_px: float) -> str | None:
    """Return the name of the fiducial next to a place of the frame, None where none is within reach.

    Parameters
    ----------
    placed : Placed
        Present ones.
    column_px, row_px : float, px
        The place.
    reach_px : float, px
        Largest distance.
    """
    distances = {
        one.name: math.hypot(one.column_px - column_px, one.row_px - row_px)
        for one in placed.fiducials
        if one.column_px is not None and one.row_px is not None
    }
    name = min(distances, key=distances.__getitem__, default=None)
    return name if name is not None and distances[name] <= reach_px else None


def write_picked(folder: Path, placed: Placed) -> Path:
    """Write the fiducials with their places as a list that a campaign names.

    Parameters
    ----------
    folder : Path
        Of the campaign.
    placed : Placed
        What is written.

    Returns
    -------
    Path
        ``fiducials_picked.csv``.

    Raises
    ------
    FiducialsError
        If a position on the plan is missing.
    """
    lacking = [one.name for one in placed.fiducials if not _is_complete(one)]
    if lacking:
        raise FiducialsError(
            f"{', '.join(lacking)}: the position on the plan is missing; type x and y in mm, or remove it"
        )
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for one in placed.fiducials:
        picked = ["", ""] if one.hint_px is None else [f"{value:.2f}" for value in one.hint_px]
        diameter = "" if one.is_point else f"{one.diameter_mm:g}"
        writer.writerow(
            [one.name, f"{one.x_mm:g}", f"{one.y_mm:g}", diameter, *picked, "" if one.marker is None else one.marker]
        )
    return write_text(folder / PICKED, lines.getvalue())


def _is_complete(one: Fiducial) -> bool:
    return math.isfinite(one.x_mm) and math.isfinite(one.y_mm)


def _residuals(found: Registration, fiducials: Sequence[Fiducial]) -> dict[str, float]:
    """Return the residual of every place, mm, also of those that the fit leaves out."""
    residuals = dict(found.residual_mm)
    for one in fiducials:
        if one.hint_px is not None and one.name not in residuals and _is_complete(one):
            x_mm, y_mm = found.to_plan(np.array(one.hint_px)).tolist()
            residuals[one.name] = math.hypot(x_mm - one.x_mm, y_mm - one.y_mm)
    return residuals


def _agreement(found: Registration) -> str:
    """Say how well the places agree."""
    if not math.isfinite(found.rms_mm):
        return "4 places determine the plan exactly; a fifth shows whether they agree."
    worst = max(found.residual_mm, key=found.residual_mm.__getitem__)
    largest = f"{found.residual_mm[worst]:.2f} mm at {worst}"
    return f"{len(found.located)} fiducials agree: residual {found.rms_mm:.2f} mm rms, largest {largest}."
