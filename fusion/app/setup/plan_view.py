"""The plan of the table: the thermogram on it, the axis and the emissivity regions, drawn by click and drag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import PanEnd, PanStart, Tap
from bokeh.models import Arrow, ColumnDataSource, NormalHead
from numpy.typing import NDArray

from fusion.app.elements import heading, paragraph
from fusion.app.setup.drawing import ACCENT, INK, TEAL, drawing
from fusion.app.setup.fiducials import Placed
from thermography._typing import Array
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

_ORIGIN, _DIRECTION, _REGION = "Axis origin", "Axis direction", "Emissivity region"
#: Cells of the thermogram on the plan, along its longer side.
_CELLS = 280


@dataclass(frozen=True)
class Plan:
    """What is drawn on the plan.

    Attributes
    ----------
    width_mm, height_mm : float, mm
        Its sides.
    origin_mm : tuple of float or None
        Point under the spindle at axis position 0.
    direction : tuple of float or None
        How that point moves as the position grows.
    positions_mm : tuple of float
        Axis positions of the targets.
    regions : tuple of (str, (n, 2) ndarray)
        Names and corners, mm, of emissivity regions.
    """

    width_mm: float
    height_mm: float
    origin_mm: tuple[float, float] | None = None
    direction: tuple[float, float] | None = None
    positions_mm: tuple[float, ...] = ()
    regions: tuple[tuple[str, Array], ...] = field(default=())

    def targets_mm(self) -> Array:
        """Return the plan points (x, y) under the spindle at the targets, (n, 2) mm; none where the axis is not known."""
        if self.origin_mm is None or self.direction is None:
            return np.zeros((0, 2))
        along = np.array(self.direction, float) / np.hypot(*self.direction)
        targets: Array = np.array(self.origin_mm) + np.array(self.positions_mm or (0.0, 100.0))[:, None] * along
        return targets


def on_plan(frame: NDArray[np.float64], registration: Registration, plan: Plan) -> NDArray[np.float64]:
    """Return a thermogram as the plan shows it.

    Parameters
    ----------
    frame : (row, column) ndarray, degC
        Thermogram.
    registration : Registration
        Of the frame.
    plan : Plan
        Gives the sides.

    Returns
    -------
    (y, x) ndarray, degC
        The pixel next to every cell, NaN outside the frame.
    """
    side = max(plan.width_mm, plan.height_mm) / _CELLS
    grid = PlanGrid(side * round(plan.width_mm / side), side * max(round(plan.height_mm / side), 1), side)
    places = np.rint(registration.to_sensor(grid.centres_mm)).astype(int)
    column, row = places[..., 0], places[..., 1]
    inside = (column >= 0) & (column < frame.shape[1]) & (row >= 0) & (row < frame.shape[0])
    shown = np.full(grid.shape, np.nan)
    shown[inside] = frame[row[inside], column[inside]]
    return shown


class PlanView:
    """The plan, on which axis and regions are drawn.

    Parameters
    ----------
    on_origin, on_direction : callable
        Take a drawn origin (x, y) in mm, and a drawn direction (dx, dy).
    on_region : callable
        Takes two opposite corners of a drawn region, mm.
    """

    def __init__(
        self,
        on_origin: Callable[[float, float], None],
        on_direction: Callable[[float, float], None],
        on_region: Callable[[tuple[float, float], tuple[float, float]], None],
    ) -> None:
        self._on_origin, self._on_direction, self._on_region = on_origin, on_direction, on_region
        self._plan: Plan | None = None
        self._start: tuple[float, float] | None = None
        self._mode = pn.widgets.RadioButtonGroup(label="A click draws", options=[_ORIGIN, _DIRECTION, _REGION])
        self._picture = pn.Column(sizing_mode="stretch_width")
        self.view = pn.Column(
            heading("Axis and regions on the plan", level=3),
            paragraph(
                "Click the point under the spindle at axis position 0, then a point to which it moves as the position grows. An emissivity "
                "region is dragged from corner to corner. The fields below take the same as numbers.",
                kind="note",
            ),
            self._mode,
            self._picture,
            sizing_mode="stretch_width",
        )

    def show(self, plan: Plan, placed: Placed, frame: NDArray[np.float64] | None) -> None:
        """Show a plan.

        Parameters
        ----------
        plan : Plan
            What is drawn.
        placed : Placed
            Fiducials.
        frame : (row, column) ndarray or None, degC
            Thermogram, shown where its registration is known.
        """
        self._plan = plan
        drawn = drawing(
            (0, plan.width_mm),
            (plan.height_mm, 0),
            x_label="x (mm)",
            y_label="y (mm)",
            size_px=(1100, min(round(1040 * plan.height_mm / plan.width_mm) + 60, 1100)),
        )
        if frame is not None and placed.registration is not None:
            seen = on_plan(frame, placed.registration, plan)
            if np.isfinite(seen).any():
                low, high = np.nanpercentile(seen, (1, 99))
                shades = np.nan_to_num(
                    np.clip((seen - low) * (200 / max(high - low, 1e-6)) + 55, 0, 255), nan=255.0
                ).astype(np.uint8)
                drawn.image([shades], x=0, y=0, dw=plan.width_mm, dh=plan.height_mm, palette="Greys256")
        marks = [(one.x_mm, one.y_mm) for one in placed.fiducials if np.isfinite([one.x_mm, one.y_mm]).all()]
        if marks:
            drawn.scatter(
                *np.array(marks).T.tolist(), marker="circle", size=9, line_color=TEAL, fill_alpha=0, line_width=2
            )
        for name, corners in plan.regions:
            drawn.patch(*corners.T.tolist(), fill_color=ACCENT, fill_alpha=0.15, line_color=ACCENT, line_width=2)
            drawn.text(
                [corners[0, 0]],
                [corners[0, 1]],
                [name],
                text_color=ACCENT,
                text_font_size="12px",
                background_fill_color="#ffffff",
            )
        _draw_axis(drawn, plan)
        drawn.on_event(Tap, self._on_tap)
        drawn.on_event(PanStart, self._on_drag)
        drawn.on_event(PanEnd, self._on_drop)
        self._picture[:] = [pn.pane.Bokeh(drawn, sizing_mode="scale_width")]

    def _on_tap(self, event: Any) -> None:
        if self._mode.value == _ORIGIN:
            self._mode.value = _DIRECTION
            self._on_origin(event.x, event.y)
        elif self._mode.value == _DIRECTION and self._plan is not None and self._plan.origin_mm is not None:
            dx, dy = event.x - self._plan.origin_mm[0], event.y - self._plan.origin_mm[1]
            if dx or dy:
                self._on_direction(dx, dy)

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
    drawn.scatter([plan.origin_mm[0]], [plan.origin_mm[1]], marker="cross", size=18, line_color=INK, line_width=3)
    targets = plan.targets_mm()
    if not len(targets):
        return
    end = targets[np.argmax(np.array(plan.positions_mm or (0.0, 100.0)))]
    drawn.scatter(*targets.T.tolist(), marker="circle", size=6, color=INK)
    line = ColumnDataSource({"x0": [plan.origin_mm[0]], "y0": [plan.origin_mm[1]], "x1": [end[0]], "y1": [end[1]]})
    head = NormalHead(size=12, fill_color=INK, line_color=INK)
    drawn.add_layout(
        Arrow(end=head, source=line, x_start="x0", y_start="y0", x_end="x1", y_end="y1", line_color=INK, line_width=2)
    )


def corners_of(region: dict[str, Any], millimetres: Callable[[str], float]) -> Array | None:
    """Return the corners of a region as a campaign file writes it, (n, 2) mm; None where they cannot be read.

    Parameters
    ----------
    region : dict
        Table ``[[thermography.region]]``.
    millimetres : callable
        Reads a length.
    """
    try:
        points = [[millimetres(text) for text in corner] for corner in region.get("polygon") or region["rectangle"]]
    except (KeyError, TypeError, ValueError):
        return None
    if "rectangle" in region and not region.get("polygon"):
        (x0, y0), (x1, y1) = points
        points = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    return np.array(points, float)


def region_table(name: str, emissivity: str, corners: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Return a rectangular region as a campaign file writes it.

    Parameters
    ----------
    name : str
        Of the region.
    emissivity : str
        With its uncertainty, such as "0.35 +- 0.05".
    corners : sequence of (float, float), mm
        Two opposite corners.
    """
    return {
        "name": name,
        "rectangle": [[f"{round(value, 1):g} mm" for value in corner] for corner in corners],
        "emissivity": emissivity,
    }
