"""The first thermogram with its fiducials, which are dragged, added and removed, and the residual of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import panel as pn
from bokeh.events import Pan, PanEnd, PanStart, Tap
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from fusion.app.elements import heading, paragraph_markup, table
from fusion.app.setup import fiducials as places
from fusion.app.setup.drawing import ACCENT, drawing
from fusion.app.setup.fiducials import Placed
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

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
    """Fiducials in the first thermogram.

    Parameters
    ----------
    on_change : callable
        Called whenever the fiducials have changed.

    Attributes
    ----------
    placed : Placed
        The fiducials as they are shown.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self.placed = Placed()
        self._changed = on_change
        self._frame: NDArray[np.float64] = np.zeros((0, 0))
        self._grid: PlanGrid | None = None
        self._dragged: str | None = None
        self._others: Registration | None = None
        self._filling = False
        self._points = ColumnDataSource({"x": [], "y": [], "label": [], "colour": []})
        self._message = pn.pane.HTML("", sizing_mode="stretch_width")
        self._picture = pn.Column(sizing_mode="stretch_width")
        self._table = pn.Column(sizing_mode="stretch_width")
        self._chosen = pn.widgets.Select(label="Fiducial", options=[], width=160)
        self._numbers = {
            key: pn.widgets.FloatInput(label=label, width=190, step=0.5, format="0.00")
            for key, label in (_POSITIONS | _PLACES).items()
        }
        self._adds = pn.widgets.Toggle(label="Add by click", value=False)
        find, add, remove = (pn.widgets.Button(label=name) for name in ("Find automatically", "Add one", "Remove it"))
        find.on_click(lambda event: self._take(places.find(self._frame, self.placed.fiducials, self._grid)))
        add.on_click(lambda event: self._add(self._frame.shape[1] / 2, self._frame.shape[0] / 2))
        remove.on_click(self._remove)
        self._chosen.param.watch(lambda event: self._fill(), "value")
        for key, field in self._numbers.items():
            field.param.watch(lambda event, key=key: self._type(key, event.new), "value")
        self._controls = pn.Column(
            pn.FlexBox(find, self._adds, add),
            pn.FlexBox(self._chosen, *self._numbers.values(), remove),
            sizing_mode="stretch_width",
        )

    @property
    def view(self) -> pn.viewable.Viewable:
        """The part of the screen."""
        return pn.Column(
            heading("Fiducials in the first thermogram", level=3),
            self._message,
            self._picture,
            self._controls,
            self._table,
            sizing_mode="stretch_width",
        )

    def show(self, frame: NDArray[np.float64], placed: Placed, grid: PlanGrid | None) -> None:
        """Show a frame with fiducials.

        Parameters
        ----------
        frame : (row, column) ndarray, degC
            Thermogram.
        placed : Placed
            Fiducials.
        grid : PlanGrid or None
            The plan.
        """
        self._frame, self._grid = frame, grid
        rows, columns = frame.shape
        drawn = drawing(
            (-0.5, columns - 0.5),
            (rows - 0.5, -0.5),
            x_label="column (px)",
            y_label="row (px)",
            size_px=(820, round(770 * rows / columns) + 50),
        )
        smooth = cv2.GaussianBlur(frame, (0, 0), _SMOOTHED_PX)
        low, high = np.nanpercentile(smooth, (0.5, 99.5))
        shades = np.clip((smooth - low) * (255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
        drawn.image([shades], x=-0.5, y=-0.5, dw=columns, dh=rows, palette="Greys256")
        drawn.scatter(
            "x",
            "y",
            source=self._points,
            marker="circle_cross",
            size=18,
            line_color="colour",
            fill_alpha=0.0,
            line_width=2,
        )
        drawn.text(
            "x",
            "y",
            "label",
            source=self._points,
            x_offset=10,
            y_offset=-8,
            text_color="colour",
            text_font_size="12px",
            background_fill_color="#ffffff",
            background_fill_alpha=0.75,
        )
        drawn.on_event(PanStart, self._on_start)
        drawn.on_event(Pan, self._on_drag)
        drawn.on_event(PanEnd, self._on_end)
        drawn.on_event(Tap, self._on_tap)
        self._picture[:] = [pn.pane.Bokeh(drawn, sizing_mode="scale_width")]
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
        rows = [
            (
                one.name,
                *(f"{value:g}" if math.isfinite(value) else "?" for value in (one.x_mm, one.y_mm)),
                f"{one.diameter_mm:g}" if one.diameter_mm else "point",
                f"{one.column_px:.1f}, {one.row_px:.1f}" if one.hint_px else "not in the frame",
                f"{placed.residual_mm[one.name]:.2f}" if one.name in placed.residual_mm else "–",
            )
            for one in placed.fiducials
        ]
        columns = ("fiducial", "x (mm)", "y (mm)", "diameter (mm)", "place (px)", "residual (mm)")
        self._table[:] = [
            table(columns, rows, caption="Fiducials, and how far each lies from where the others expect it")
        ]
        self._changed()

    def _draw(self) -> None:
        """Draw the places, and tell how they agree."""
        shown = [one for one in self.placed.fiducials if one.column_px is not None and one.row_px is not None]
        residual = self.placed.residual_mm
        self._points.data = {
            "x": [one.column_px for one in shown],
            "y": [one.row_px for one in shown],
            "label": [
                one.name + (f" {residual[one.name]:.2f} mm" if residual.get(one.name, 0.0) >= _TOLD_MM else "")
                for one in shown
            ],
            "colour": [ACCENT if residual.get(one.name, 0.0) > _LARGE_MM else "#00627a" for one in shown],
        }
        self._message.object = paragraph_markup(self.placed.message, kind="done" if residual else "warning")

    def _fill(self) -> None:
        """Show the numbers of the chosen fiducial."""
        name = self._chosen.value
        for field in self._numbers.values():
            field.disabled = name is None
        if name is None:
            return
        one = self.placed.named(name)
        self._filling = True
        try:
            for key, field in self._numbers.items():
                value = getattr(one, key)
                field.value = None if value is None or not math.isfinite(value) else round(value, 2)
        finally:
            self._filling = False

    def _type(self, key: str, value: float | None) -> None:
        """Take a typed number."""
        if self._filling or value is None or self._chosen.value is None:
            return
        name = self._chosen.value
        one, values = self.placed.named(name), {key: float(value)}
        if key in _PLACES and one.hint_px is None:
            values = {"column_px": 0.0, "row_px": 0.0} | values
        self._take(places.changed(self.placed, name, self._frame.shape, **values))

    def _add(self, column_px: float, row_px: float) -> None:
        placed, name = places.added(self.placed, column_px, row_px, self._frame.shape)
        self._take(placed, choose=name)

    def _remove(self, event: object) -> None:
        if self._chosen.value is not None:
            self._take(places.removed(self.placed, self._chosen.value, self._frame.shape))

    def _nearest(self, event: Any) -> str | None:
        return places.nearest(self.placed, event.x, event.y, reach_px=max(_REACH * self._frame.shape[1], 6.0))

    def _on_start(self, event: Any) -> None:
        self._dragged = self._nearest(event)
        if self._dragged is not None:
            self._others = places.removed(self.placed, self._dragged, self._frame.shape).registration

    def _on_drag(self, event: Any) -> None:
        """Move a fiducial, and tell how far it lies from where the others expect it."""
        if self._dragged is None or self._others is None:
            return
        moved = [
            replace(one, column_px=event.x, row_px=event.y) if one.name == self._dragged else one
            for one in self.placed.fiducials
        ]
        self.placed = places.seen_by(self._others, moved, self._dragged)
        self._draw()

    def _on_end(self, event: Any) -> None:
        if self._dragged is not None:
            name, self._dragged = self._dragged, None
            self._take(
                places.changed(self.placed, name, self._frame.shape, column_px=event.x, row_px=event.y), choose=name
            )

    def _on_tap(self, event: Any) -> None:
        name = self._nearest(event)
        if name is not None:
            self._chosen.value = name
        elif self._adds.value:
            self._add(*places.snapped(self._frame, event.x, event.y))
