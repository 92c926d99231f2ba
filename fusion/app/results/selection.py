"""What is chosen on the screen *Results*: a cycle, a position, and places on the plan; every part of the screen watches it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import param
from bokeh.events import Tap
from bokeh.models import Span
from bokeh.plotting import figure

from fusion.app.turn import in_turn
from interferometry.figures import ACCENT

#: What a coordinate of a chart is, so that a click on it chooses something.
Axis = str
POSITION, CYCLE, HOURS = "position", "cycle", "hours"


class Place(NamedTuple):
    """A place on the plan whose temperature is shown over time.

    Attributes
    ----------
    x_mm, y_mm : float
        Its middle, mm.
    size_mm : float
        Side of the square over which the mean is taken, mm; 0: one cell.
    unit : {"mm", "px"}
        "px": all three are pixels of the picture that stands for the plan.
    """

    x_mm: float
    y_mm: float
    size_mm: float
    unit: str = "mm"

    @property
    def words(self) -> str:
        """The place as a legend names it."""
        size = f", {self.size_mm:g} {self.unit} square" if self.size_mm else ""
        return f"x {self.x_mm:.0f} {self.unit}, y {self.y_mm:.0f} {self.unit}{size}"


class Selection(param.Parameterized):
    """The choice of one page.

    Attributes
    ----------
    cycle : int
        Number of a cycle.
    target : int or None
        Number of a target; None without a laser.
    places : list of Place
        In the order in which they were added.
    """

    cycle: int = param.Integer()
    target: int | None = param.Integer(default=None, allow_None=True)
    places: list[Place] = param.List(item_type=Place)

    def watch(self, update: Callable[[], None], name: str) -> param.parameterized.Watcher:
        """Let a chart follow one of the choices.

        Parameters
        ----------
        update : callable
            Changes the chart.
        name : {"cycle", "target", "places"}
            The choice.

        Returns
        -------
        Watcher
            For ``param.unwatch``.
        """
        return self.param.watch(lambda event: in_turn(update), name)

    def add(self, place: Place) -> None:
        """Add a place, once."""
        if place not in self.places:
            self.places = [*self.places, place]


class Linker:
    """Links charts to a selection: a line at what is chosen, and a click that chooses.

    Parameters
    ----------
    selection : Selection
        Of the page.
    targets : sequence of (int, float)
        Number and position (mm) of every target.
    cycles : (n,) ndarray
        Numbers of the cycles.
    hours : (n,) ndarray or None
        Their times on the axes of the charts, h; None where there are none.
    """

    def __init__(
        self, selection: Selection, targets: list[tuple[int, float]], cycles: np.ndarray, hours: np.ndarray | None
    ) -> None:
        self._selection = selection
        self._targets, self._cycles, self._hours = targets, cycles, hours

    def link(self, drawn: figure, *, x: Axis = "", y: Axis = "") -> Callable[[], None]:
        """Mark the selection in a chart, and let a click on it choose.

        Parameters
        ----------
        drawn : figure
            The chart.
        x, y : {"", "position", "cycle", "hours"}
            What its axes show.

        Returns
        -------
        callable
            Ends the link, for a chart that is drawn anew.
        """
        watchers = []
        for axis, dimension in ((x, "height"), (y, "width")):
            if axis and (axis != HOURS or self._hours is not None):
                watchers.append(self._mark(drawn, axis, dimension))

        def choose(event: Tap) -> None:
            for axis, at in ((x, event.x), (y, event.y)):
                if axis and at is not None:
                    self._choose(axis, float(at))

        drawn.on_event(Tap, choose)

        def end() -> None:
            for watcher in watchers:
                self._selection.param.unwatch(watcher)

        return end

    def _mark(self, drawn: figure, axis: Axis, dimension: str) -> param.parameterized.Watcher:
        """Draw a line at what is chosen, and move it with the choice."""
        span = Span(
            location=self._place(axis), dimension=dimension, line_color=ACCENT, line_width=2, line_dash="dashed", name=f"chosen {axis}"
        )  # fmt: skip
        drawn.add_layout(span)
        watched = "target" if axis == POSITION else "cycle"
        return self._selection.watch(lambda: span.update(location=self._place(axis)), watched)

    def _place(self, axis: Axis) -> float | None:
        """Return where the selection lies on an axis; None where it has no place there."""
        if axis == POSITION:
            return dict(self._targets).get(self._selection.target or 0)
        at = np.flatnonzero(self._cycles == self._selection.cycle)
        if not at.size:
            return None
        if axis == CYCLE:
            return float(self._selection.cycle)
        hours = float(self._hours[at[0]]) if self._hours is not None else float("nan")
        return hours if np.isfinite(hours) else None

    def _choose(self, axis: Axis, at: float) -> None:
        """Choose what lies nearest on an axis."""
        if axis == POSITION and self._targets:
            self._selection.target = min(self._targets, key=lambda one: abs(one[1] - at))[0]
        elif axis in (CYCLE, HOURS) and self._cycles.size:
            shown = self._cycles.astype(float) if axis == CYCLE else self._hours
            if shown is not None and np.isfinite(shown).any():
                self._selection.cycle = int(self._cycles[int(np.nanargmin(np.abs(shown - at)))])
