"""The plan of the table: the thermogram on it, the axis and the emissivity regions, drawn by click and drag."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import panel as pn
from bokeh.events import Pan, PanEnd, PanStart, Tap
from bokeh.models import Arrow, ColorBar, ColumnDataSource, HoverTool, LinearColorMapper, NormalHead
from bokeh.palettes import Greys256
from bokeh.plotting import figure
from numpy.typing import NDArray

from fusion.app.drawings import add_cross, scaled_drawing, shown_drawing
from fusion.app.parts import beside, column, heading, markup, note, paragraph_markup, table
from fusion.campaign.values import QuantityError, read_quantity
from fusion.common import FusionError
from fusion.report.charts.plan import NAME
from fusion.report.charts.style import COLOUR_BAR
from fusion.results.store import write_text
from interferometry.plots import ACCENT, COLOURS, INK
from thermography.common import Array, ThermographyError
from thermography.io.other_cameras import StackOptions, index_recordings
from thermography.radiometry.planck import calibrate
from thermography.registration.discs import detect_discs
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.register import Registration, register, register_points

# Drawings of the screen *Set up*, in the style of the report.

TEAL = COLOURS["positive"]
_LABEL = {"text_font_size": "12px", "background_fill_color": "#ffffff"}
#: The darkest fifth is left out: lines are drawn over the picture.
_GREYS = Greys256[56:]


def add_thermogram(drawn: figure, seen: Array, corner: tuple[float, float], size: tuple[float, float]) -> None:
    """Draw temperatures (row, column; degC) in light greys, on which lines are seen, with their scale and the value under the pointer."""
    low, high = (float(limit) for limit in np.nanpercentile(seen, (0.5, 99.5)))
    high = max(high, low + 0.1)
    greys = LinearColorMapper(_GREYS, low=low, high=high, nan_color="#ffffff")
    (x, y), (width, height) = corner, size
    cells = drawn.image([seen.astype(np.float32)], x=x, y=y, dw=width, dh=height, color_mapper=greys)
    tips = [("x, y", "$x{0}, $y{0}"), ("temperature", "@image{0.00} °C")]
    drawn.add_tools(HoverTool(tooltips=tips, renderers=[cells]))
    drawn.add_layout(ColorBar(color_mapper=greys, title="temperature / °C", height=10, **COLOUR_BAR), "below")


# Fiducials in a thermogram: found by the registration, or placed by hand with the residual of every place.

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

    ``residual_mm`` is the distance on the plan between place and listed position by name; no registration where fewer than four are
    placed, or they contradict one another.
    """

    fiducials: tuple[Fiducial, ...] = ()
    residual_mm: dict[str, float] = field(default_factory=dict)
    registration: Registration | None = None
    message: str = ""

    def named(self, name: str) -> Fiducial:
        """Return the fiducial of a name."""
        return next(one for one in self.fiducials if one.name == name)


def first_thermogram(paths: Sequence[Path], *, of_temperatures: bool = False) -> NDArray[np.float64]:
    """Return the temperatures of the first frame of a series."""
    start = np.datetime64("2000-01-01", "ns")
    options = StackOptions(scale=np.nextafter(1.0, 2.0), unit="degC", start=start, interval_s=1.0)
    frames, rejected = index_recordings(paths[:1], options if of_temperatures else None)
    if not frames:
        reason = rejected[0].reason if rejected else "there is none"
        raise FiducialsError(f"no frame can be shown: {reason}; copy the file again from the camera")
    return np.asarray(calibrate(frames[0].read_counts(), frames[0].parameters), float)


def find(frame: NDArray[np.float64], fiducials: Sequence[Fiducial], grid: PlanGrid | None) -> Placed:
    """Find listed fiducials in a frame, as a run does."""
    shown = [one for one in fiducials if _is_complete(one)]
    try:
        found = register(frame, shown, grid=grid)
    except ThermographyError as error:
        return replace(place(fiducials, frame.shape), message=f"Not found automatically: {error}")
    discs = ((one, found.located.get(one.name)) for one in fiducials)
    placed = tuple(
        replace(one, column_px=disc.column_px if disc else None, row_px=disc.row_px if disc else None)
        for one, disc in discs
    )
    left_out = "".join(f" {name}: {reason}." for name, reason in found.left_out.items())
    return Placed(placed, _residuals(found, placed), found, _agreement(found) + left_out)


def place(fiducials: Sequence[Fiducial], shape: tuple[int, ...]) -> Placed:
    """Tell how well places that were picked agree with the listed positions."""
    listed = tuple(fiducials)
    picked = [one for one in listed if one.hint_px is not None and _is_complete(one)]
    if len(picked) < 4:
        told = f"{len(picked)} of at least 4 fiducials have a place in the frame and a position on the plan."
        return Placed(listed, message=told)
    try:
        found = register_points({one.name: one.hint_px for one in picked if one.hint_px}, picked, (shape[0], shape[1]))
    except ThermographyError as error:
        return Placed(listed, message=f"The places contradict one another: {error}")
    residuals = _residuals(found, picked)
    outside = [name for name in residuals if name not in found.located]
    apart = "".join(f" {name} lies {residuals[name]:.2f} mm from where the others expect it." for name in outside)
    return Placed(listed, residuals, found, _agreement(found) + apart)


def snapped(frame: NDArray[np.float64], column_px: float, row_px: float) -> tuple[float, float]:
    """Return the centre of the disc at a click, or the click itself where there is none."""
    at = (column_px, row_px)
    near = [spot for spot in detect_discs(frame) if math.dist((spot.column_px, spot.row_px), at) <= _SNAP_PX]
    # Noise makes small spots, a disc a large one.
    disc = max(near, key=lambda spot: spot.area_px, default=None)
    return at if disc is None else (disc.column_px, disc.row_px)


def added(placed: Placed, column_px: float, row_px: float, shape: tuple[int, ...]) -> tuple[Placed, str]:
    """Add a fiducial at a place of the frame."""
    taken = {one.name for one in placed.fiducials}
    name = next(f"F{number}" for number in range(1, len(taken) + 2) if f"F{number}" not in taken)
    x_mm = y_mm = math.nan
    if placed.registration is not None:
        x_mm, y_mm = np.round(placed.registration.to_plan(np.array([column_px, row_px])), 1).tolist()
    diameter = placed.fiducials[-1].diameter_mm if placed.fiducials else 0.0
    return place([*placed.fiducials, Fiducial(name, x_mm, y_mm, diameter, column_px, row_px)], shape), name


def changed(placed: Placed, name: str, shape: tuple[int, ...], **values: float) -> Placed:
    """Change a fiducial: its place in the frame, its position on the plan, its diameter."""
    fiducials = replaced(placed.fiducials, name, **values)
    found = place(fiducials, shape)
    others = place([one for one in fiducials if one.name != name], shape).registration
    return found if found.registration is not None or others is None else seen_by(others, fiducials, name)


def replaced(fiducials: Sequence[Fiducial], name: str, **values: float) -> list[Fiducial]:
    """Return fiducials, one of them with other values."""
    return [replace(one, **values) if one.name == name else one for one in fiducials]  # type: ignore[arg-type]


def seen_by(others: Registration, fiducials: Sequence[Fiducial], name: str) -> Placed:
    """Tell where one fiducial lies by a registration to which it has not contributed, as while it is dragged."""
    residuals = _residuals(others, fiducials)
    told = f" {name} lies {residuals[name]:.2f} mm from where the others expect it." if name in residuals else ""
    return Placed(tuple(fiducials), residuals, others, _agreement(others) + told)


def removed(placed: Placed, name: str, shape: tuple[int, ...]) -> Placed:
    """Take a fiducial away."""
    return place([one for one in placed.fiducials if one.name != name], shape)


def nearest(placed: Placed, column_px: float, row_px: float, *, reach_px: float) -> str | None:
    """Return the name of the fiducial next to a place of the frame, None where none is within reach."""
    shown = [(math.dist(one.hint_px, (column_px, row_px)), one.name) for one in placed.fiducials if one.hint_px]
    distance, name = min(shown, default=(math.inf, ""))
    return name if distance <= reach_px else None


def write_picked(folder: Path, placed: Placed) -> Path:
    """Write the fiducials with their places as a list that a campaign names."""
    if lacking := ", ".join(one.name for one in placed.fiducials if not _is_complete(one)):
        raise FiducialsError(f"{lacking}: the position on the plan is missing; type x and y in mm, or remove it")
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for one in placed.fiducials:
        picked = ["", ""] if one.hint_px is None else [f"{value:.2f}" for value in one.hint_px]
        diameter = "" if one.is_point else f"{one.diameter_mm:g}"
        writer.writerow([one.name, f"{one.x_mm:g}", f"{one.y_mm:g}", diameter, *picked, one.marker])
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


# The first thermogram with its fiducials, which are dragged, added and removed, and the residual of each.

#: A pointer this close to a fiducial means it, as a share of the width of the frame.
_REACH = 0.025
#: The picture is smoothed for the eye by this standard deviation; fiducials are found in the frame itself.
_SMOOTHED_PX = 0.8
#: Residuals above this are drawn in the colour of a warning, mm: a calliper is better.
_LARGE_MM = 0.5
#: Smaller residuals are told in the table alone, mm.
_TOLD_MM = 0.1
_POSITIONS = {"x_mm": "x on the plan (mm)", "y_mm": "y on the plan (mm)", "diameter_mm": "Diameter (mm)"}
_PLACES = {"column_px": "Column in the frame (px)", "row_px": "Row in the frame (px)"}


class FrameView:
    """Fiducials in the first thermogram as they are `placed`; `on_change` is called whenever they have changed."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self.placed = Placed()
        self._changed = on_change
        self._frame: NDArray[np.float64] = np.zeros((0, 0))
        self._grid: PlanGrid | None = None
        self._dragged: str | None = None
        self._others: Registration | None = None
        self._filling = False
        self._points = ColumnDataSource({"x": [], "y": [], "label": [], "colour": []})
        self._message, self._picture, self._table = markup(""), column(), column()
        self._chosen = pn.widgets.Select(label="Fiducial", options=[], width=160)
        self._numbers = {
            key: pn.widgets.FloatInput(label=label, width=190, step=0.5, format="0.00")
            for key, label in (_POSITIONS | _PLACES).items()
        }
        self._adds = pn.widgets.Toggle(label="Add by click", value=False)
        search, add, remove = (pn.widgets.Button(label=name) for name in ("Find automatically", "Add one", "Remove it"))
        search.on_click(lambda event: self._take(find(self._frame, self.placed.fiducials, self._grid)))
        add.on_click(lambda event: self._add(self._frame.shape[1] / 2, self._frame.shape[0] / 2))
        remove.on_click(self._remove)
        self._chosen.param.watch(lambda event: self._fill(), "value")
        for key, entry in self._numbers.items():
            entry.param.watch(lambda event, key=key: self._type(key, event.new), "value")
        title = heading("Fiducials in the first thermogram", level=3)
        controls = column(beside(search, self._adds, add), beside(self._chosen, *self._numbers.values(), remove))
        self.view = column(title, self._message, self._picture, controls, self._table)

    def show(self, frame: NDArray[np.float64], placed: Placed, grid: PlanGrid | None) -> None:
        """Show a frame with fiducials."""
        self._frame, self._grid = frame, grid
        rows, columns = frame.shape
        ends = (-0.5, columns - 0.5), (rows - 0.5, -0.5)
        drawn = scaled_drawing(*ends, x_name="column / px", y_name="row / px", width_px=820)
        smooth = cv2.GaussianBlur(frame, (0, 0), _SMOOTHED_PX)
        add_thermogram(drawn, smooth, (-0.5, -0.5), (columns, rows))
        ring = {"marker": "circle_cross", "size": 18, "line_color": "colour", "fill_alpha": 0.0, "line_width": 2}
        drawn.scatter("x", "y", source=self._points, **ring)
        label = {"text_color": "colour", **_LABEL, "background_fill_alpha": 0.75}
        drawn.text("x", "y", "label", source=self._points, x_offset=10, y_offset=-8, **label)
        on_event = {PanStart: self._on_start, Pan: self._on_drag, PanEnd: self._on_end, Tap: self._on_tap}
        for kind, answer in on_event.items():
            drawn.on_event(kind, answer)
        self._picture[:] = [shown_drawing(drawn)]
        self._take(placed)

    def _take(self, placed: Placed, *, choose: str | None = None) -> None:
        """Show other fiducials."""
        self.placed = placed
        names = [one.name for one in placed.fiducials]
        if self._chosen.options != names:
            self._chosen.options = names
        if choose is not None or self._chosen.value not in names:
            self._chosen.value = choose or (names[0] if names else None)
        self._draw()
        self._fill()
        rows = []
        for one in placed.fiducials:
            x, y = (f"{value:g}" if math.isfinite(value) else "?" for value in (one.x_mm, one.y_mm))
            diameter = f"{one.diameter_mm:g}" if one.diameter_mm else "point"
            seen = f"{one.column_px:.1f}, {one.row_px:.1f}" if one.hint_px else "not in the frame"
            residual = f"{placed.residual_mm[one.name]:.2f}" if one.name in placed.residual_mm else "–"
            rows.append((one.name, x, y, diameter, seen, residual))
        columns = ("fiducial", "x (mm)", "y (mm)", "diameter (mm)", "place (px)", "residual (mm)")
        caption = "Fiducials, and how far each lies from where the others expect it"
        self._table[:] = [table(columns, rows, caption=caption)]
        self._changed()

    def _draw(self) -> None:
        """Draw the places, and tell how they agree."""
        shown = [one for one in self.placed.fiducials if one.hint_px is not None]
        residuals = [self.placed.residual_mm.get(one.name, 0.0) for one in shown]
        self._points.data = {
            "x": [one.column_px for one in shown],
            "y": [one.row_px for one in shown],
            "label": [
                one.name + (f" {residual:.2f} mm" if residual >= _TOLD_MM else "")
                for one, residual in zip(shown, residuals, strict=True)
            ],
            "colour": [ACCENT if residual > _LARGE_MM else "#00627a" for residual in residuals],
        }
        kind = "done" if self.placed.residual_mm else "warning"
        self._message.object = paragraph_markup(self.placed.message, kind=kind)

    def _fill(self) -> None:
        """Show the numbers of the chosen fiducial."""
        name = self._chosen.value
        for entry in self._numbers.values():
            entry.disabled = name is None
        if name is None:
            return
        one = self.placed.named(name)
        self._filling = True
        for key, entry in self._numbers.items():
            value = getattr(one, key)
            entry.value = None if value is None or not math.isfinite(value) else round(value, 2)
        self._filling = False

    def _type(self, key: str, value: float | None) -> None:
        """Take a typed number."""
        if self._filling or value is None or self._chosen.value is None:
            return
        name = self._chosen.value
        one, values = self.placed.named(name), {key: float(value)}
        if key in _PLACES and one.hint_px is None:
            values = {"column_px": 0.0, "row_px": 0.0} | values
        self._take(changed(self.placed, name, self._frame.shape, **values))

    def _add(self, column_px: float, row_px: float) -> None:
        placed, name = added(self.placed, column_px, row_px, self._frame.shape)
        self._take(placed, choose=name)

    def _remove(self, event: object) -> None:
        if self._chosen.value is not None:
            self._take(removed(self.placed, self._chosen.value, self._frame.shape))

    def _nearest(self, event: Any) -> str | None:
        return nearest(self.placed, event.x, event.y, reach_px=max(_REACH * self._frame.shape[1], 6.0))

    def _on_start(self, event: Any) -> None:
        self._dragged = self._nearest(event)
        if self._dragged is not None:
            self._others = removed(self.placed, self._dragged, self._frame.shape).registration

    def _on_drag(self, event: Any) -> None:
        """Move a fiducial, and tell how far it lies from where the others expect it."""
        if self._dragged is not None and self._others is not None:
            moved = replaced(self.placed.fiducials, self._dragged, column_px=event.x, row_px=event.y)
            self.placed = seen_by(self._others, moved, self._dragged)
            self._draw()

    def _on_end(self, event: Any) -> None:
        if self._dragged is not None:
            name, self._dragged = self._dragged, None
            there = {"column_px": event.x, "row_px": event.y}
            self._take(changed(self.placed, name, self._frame.shape, **there), choose=name)

    def _on_tap(self, event: Any) -> None:
        name = self._nearest(event)
        if name is not None:
            self._chosen.value = name
        elif self._adds.value:
            self._add(*snapped(self._frame, event.x, event.y))


#: A point of the plan, mm, or of the picture, px.
Place: TypeAlias = tuple[float, float]
_ORIGIN, _DIRECTION, _REGION = "Axis origin", "Axis direction", "Region"
#: Free margin around the plan, as a share of its longer side.
_ROOM = 0.02
#: Cells of the thermogram on the plan, along its longer side.
_CELLS = 280


@dataclass(frozen=True)
class Plan:
    """What is drawn on the plan: the point under the spindle at axis position 0, how it moves, targets, names and corners of regions.

    Where the picture is the plan, its lengths are in px.
    """

    width_mm: float
    height_mm: float
    origin_mm: tuple[float, float] | None = None
    direction: tuple[float, float] | None = None
    positions_mm: tuple[float, ...] = ()
    regions: tuple[tuple[str, Array], ...] = ()
    unit: str = "mm"

    @property
    def shown_positions_mm(self) -> tuple[float, ...]:
        """Axis positions of the targets; without readings the beginning of the axis."""
        return self.positions_mm or (0.0, 100.0)

    def targets_mm(self) -> Array:
        """Return the plan points (x, y) under the spindle at the targets, (n, 2) mm; none where the axis is not known."""
        if self.origin_mm is None or self.direction is None:
            return np.zeros((0, 2))
        along = np.array(self.direction, float) / np.hypot(*self.direction)
        targets: Array = np.array(self.origin_mm) + np.array(self.shown_positions_mm)[:, None] * along
        return targets


def on_plan(frame: NDArray[np.float64], registration: Registration, plan: Plan) -> NDArray[np.float64]:
    """Return a thermogram as the plan shows it."""
    side = max(plan.width_mm, plan.height_mm) / _CELLS
    grid = PlanGrid(side * round(plan.width_mm / side), side * max(round(plan.height_mm / side), 1), side)
    places = np.rint(registration.to_sensor(grid.centres_mm)).astype(int)
    column, row = places[..., 0], places[..., 1]
    inside = (column >= 0) & (column < frame.shape[1]) & (row >= 0) & (row < frame.shape[0])
    shown = np.full(grid.shape, np.nan)
    shown[inside] = frame[row[inside], column[inside]]
    return shown


class PlanView:
    """The plan, on which an origin (x, y), a direction (dx, dy), points of a region and two ends of one are drawn, mm."""

    def __init__(
        self,
        on_origin: Callable[[float, float], None],
        on_direction: Callable[[float, float], None],
        on_point: Callable[[Place], None],
        on_region: Callable[[Place, Place], None],
    ) -> None:
        self._on_origin, self._on_direction, self._on_point, self._on_region = (
            on_origin,
            on_direction,
            on_point,
            on_region,
        )
        self._plan: Plan | None = None
        self._start: Place | None = None
        self._mode = pn.widgets.RadioButtonGroup(label="A click draws", options=[_ORIGIN, _DIRECTION, _REGION])
        self._picture = column()
        how = (
            "Axis: click the point under the spindle at axis position 0, then a point to which it moves as the position grows. Region: "
            "choose its shape below, then click its points, or drag from corner to corner or end to end. The fields below take the same "
            "as numbers."
        )
        self.view = column(heading("Axis and regions", level=3), note(how), self._mode, self._picture)

    def show(self, plan: Plan, placed: Placed, frame: NDArray[np.float64] | None) -> None:
        """Show a plan."""
        self._plan = plan
        in_px = plan.unit == "px"
        self._mode.visible = not in_px
        if in_px:
            self._mode.value = _REGION
        # The centre of the first pixel is (0, 0), the corner of a plan in mm too; its cross and the discs at its rim are seen whole.
        left = -0.5 if in_px else 0.0
        room = 0.0 if in_px else _ROOM * max(plan.width_mm, plan.height_mm)
        ranges = (left - room, plan.width_mm + left + room), (plan.height_mm + left + room, left - room)
        # A tall plan stays as high as a screen.
        width_px = round(min(1100, 900 * plan.width_mm / plan.height_mm + 60))
        drawn = scaled_drawing(*ranges, x_name=f"x / {plan.unit}", y_name=f"y / {plan.unit}", width_px=width_px)
        if frame is not None and (in_px or placed.registration is not None):
            seen = frame if placed.registration is None else on_plan(frame, placed.registration, plan)
            if np.isfinite(seen).any():
                add_thermogram(drawn, seen, (left, left), (plan.width_mm, plan.height_mm))
        x, y = [one.x_mm for one in placed.fiducials], [one.y_mm for one in placed.fiducials]
        drawn.scatter(x, y, marker="circle", size=9, line_color=TEAL, fill_alpha=0, line_width=2)
        names = [one.name for one in placed.fiducials]
        drawn.text(x, y, names, x_offset=7, y_offset=-4, text_color=TEAL, background_fill_alpha=0.75, **_LABEL)
        if not in_px:
            add_cross(drawn, 0.0, 0.0)
            drawn.text([0], [0], ["origin"], x_offset=6, y_offset=16, **NAME)
        for name, corners in plan.regions:
            drawn.patch(*corners.T.tolist(), fill_color=ACCENT, fill_alpha=0.15, line_color=ACCENT, line_width=2)
            drawn.scatter(*corners.T.tolist(), marker="circle", size=5, color=ACCENT)
            drawn.text(corners[:1, 0], corners[:1, 1], [name], text_color=ACCENT, **_LABEL)
        _draw_axis(drawn, plan)
        drawn.on_event(Tap, self._on_tap)
        drawn.on_event(PanStart, self._on_drag)
        drawn.on_event(PanEnd, self._on_drop)
        self._picture[:] = [shown_drawing(drawn)]

    def _on_tap(self, event: Any) -> None:
        if self._mode.value == _ORIGIN:
            self._mode.value = _DIRECTION
            self._on_origin(event.x, event.y)
        elif self._mode.value == _DIRECTION and self._plan is not None and self._plan.origin_mm is not None:
            dx, dy = event.x - self._plan.origin_mm[0], event.y - self._plan.origin_mm[1]
            if dx or dy:
                self._on_direction(dx, dy)
        elif self._mode.value == _REGION:
            self._on_point((event.x, event.y))

    def _on_drag(self, event: Any) -> None:
        self._start = (event.x, event.y) if self._mode.value == _REGION else None

    def _on_drop(self, event: Any) -> None:
        if self._start is not None:
            start, self._start = self._start, None
            self._on_region(start, (event.x, event.y))


def _draw_axis(drawn: Any, plan: Plan) -> None:
    """Draw the origin, the targets, and the way from the first to the last."""
    if plan.origin_mm is None:
        return
    x, y = plan.origin_mm
    add_cross(drawn, x, y)
    targets = plan.targets_mm()
    if len(targets):
        drawn.scatter(*targets.T.tolist(), marker="circle", size=6, color=INK)
        x_end, y_end = targets[np.argmax(plan.shown_positions_mm)]
        head = NormalHead(size=12, fill_color=INK, line_color=INK)
        drawn.add_layout(Arrow(end=head, x_start=x, y_start=y, x_end=x_end, y_end=y_end, line_color=INK, line_width=2))


#: Shapes of a region that are drawn, with the fewest and the most points of each.
SHAPES = {"rectangle": (2, 2), "polygon": (3, 99), "line": (2, 2), "spot": (1, 1)}


def corners_of(region: dict[str, Any]) -> Array | None:
    """Return the outline of a region as a campaign file writes it, (n, 2) mm or px; None where it cannot be read."""
    try:
        shape = next(name for name in (*SHAPES, "ellipse") if region.get(name))
        written = [region[shape]] if shape == "spot" else region[shape]
        unit = "px" if "px" in str(written) else "mm"
        points = np.array([[read_quantity(text, unit) for text in one] for one in written], float)
    except (StopIteration, QuantityError, ValueError, TypeError):
        return None
    return outline(shape, points)


def outline(shape: str, points: Array) -> Array:
    """Return the points (n, 2) of a shape as a line around it is drawn through them."""
    if shape == "ellipse":
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        middle, half = points.mean(axis=0), np.ptp(points, axis=0) / 2
        return np.asarray(middle + half * np.column_stack([np.cos(angle), np.sin(angle)]))
    if shape == "rectangle" and len(points) == 2:
        (x0, y0), (x1, y1) = points
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return points


def region_table(name: str, emissivity: str, shape: str, points: Sequence[Place], unit: str = "mm") -> dict[str, Any]:
    """Return a region as a campaign file writes it; without an emissivity, that of the frames."""
    written = [[f"{round(value, 1):g} {unit}" for value in point] for point in points]
    of_shape = written[0] if shape == "spot" else written
    return {"name": name, shape: of_shape, **({"emissivity": emissivity} if emissivity else {})}


# Regions, maybe with an emissivity of their own, as a list that is added to and taken from.


class RegionsView:
    """Regions as the campaign file writes them, in mm or px, and the one that is drawn now; `on_change` is called when one has changed."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self.regions: list[dict[str, Any]] = []
        self._changed, self._unit = on_change, "mm"
        self._shape = pn.widgets.Select(label="Shape of the region", options=list(SHAPES), width=150)
        self._points = pn.widgets.TextInput(label="Its points", placeholder="100, 20; 180, 60", width=280)
        self._name = pn.widgets.TextInput(label="Name of the region", width=190)
        self._emissivity = pn.widgets.TextInput(label="Its emissivity", placeholder="0.35 +- 0.05", width=190)
        self._chosen = pn.widgets.Select(label="Regions", options=[], width=190)
        self._told = markup("")
        add, remove = pn.widgets.Button(label="Add the region"), pn.widgets.Button(label="Remove the region")
        add.on_click(self._add)
        remove.on_click(self._remove)
        self._shape.param.watch(lambda event: self._take([]), "value")
        self._points.param.watch(lambda event: self._changed(), "value")
        fields = beside(self._shape, self._points, self._name, self._emissivity, add)
        title = heading("Regions", level=3)
        self.view = column(title, fields, beside(self._chosen, remove), self._told)

    @property
    def outlines(self) -> list[tuple[str, Array]]:
        """Names and outlines of all regions, and of the one that is being drawn."""
        drawn = [(str(one.get("name", "")), corners_of(one)) for one in self.regions]
        points = self._read()
        drawn.append((self._name.value, outline(self._shape.value, np.array(points, float)) if points else None))
        return [(name, corners) for name, corners in drawn if corners is not None]

    def show(self, regions: list[dict[str, Any]], unit: str | None = None) -> None:
        """Show regions, whose unit stays where none is given."""
        self.regions, self._unit = regions, unit or self._unit
        self._points.label = f"Its points, x, y in {self._unit}"
        names = [str(one.get("name", "")) for one in regions]
        self._chosen.param.update(options=names, value=names[-1] if names else None)

    def take_point(self, point: Place) -> None:
        """Take a place that was clicked as the next point; one more than the shape has begins it anew."""
        points = self._read() or []
        self._take([*points, point] if len(points) < SHAPES[self._shape.value][1] else [point])

    def take_corners(self, one: Place, other: Place) -> None:
        """Take both ends of what was dragged."""
        if self._shape.value in ("polygon", "spot"):
            self._shape.value = "rectangle"
        self._take([one, other])

    def _take(self, points: Sequence[Place]) -> None:
        self._points.value = "; ".join(f"{x:.1f}, {y:.1f}" for x, y in points)
        enough = len(points) >= SHAPES[self._shape.value][0]
        told = "Give the region a name, and an emissivity where it has its own, then add it." if enough else ""
        self._told.object = paragraph_markup(told, kind="done")

    def _read(self) -> list[Place] | None:
        """Return the points that are written, None where they are no pairs of numbers."""
        try:
            pairs = [one.split(",") for one in self._points.value.split(";") if one.strip()]
            return [(float(x), float(y)) for x, y in pairs]
        except ValueError:
            return None

    def _add(self, event: object) -> None:
        points, shape = self._read() or [], self._shape.value
        name, emissivity = self._name.value.strip(), self._emissivity.value.strip()
        least, most = SHAPES[shape]
        if not name or name in [one.get("name") for one in self.regions] or not least <= len(points) <= most:
            corners = {"rectangle": "two opposite corners", "line": "two ends", "spot": "one point"}
            asked = f"{corners.get(shape, 'three corners or more')} as x, y in {self._unit}"
            self._told.object = paragraph_markup(f"A {shape} needs a name of its own and {asked}.", kind="fault")
            return
        self.show([*self.regions, region_table(name, emissivity, shape, points, self._unit)])
        self._name.value = self._emissivity.value = ""
        self._take([])
        self._changed()

    def _remove(self, event: object) -> None:
        self.show([one for one in self.regions if one.get("name") != self._chosen.value])
        self._changed()
