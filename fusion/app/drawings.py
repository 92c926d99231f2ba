"""Drawings to scale: a millimetre, or a pixel, is as long in both directions whatever the width of the screen."""

from __future__ import annotations

from typing import Any, TypeAlias

import panel as pn
from bokeh.document import Document
from bokeh.models import Range1d
from bokeh.plotting import figure
from bokeh.util.serialization import make_id

from fusion.app.parts import Parts, column, note, paragraph, schedule_update
from fusion.report.charts.embedded import Model, document
from fusion.report.charts.style import Chart, new_figure
from interferometry.plots import INK

#: First and last value of an axis as it is drawn; a descending pair turns it round.
Ends: TypeAlias = tuple[float, float]


def figure_of(drawn: Model) -> Any:
    """Return a chart of the report as a model of the library, which a page changes while it is shown."""
    # A page holds many charts, whose models are told apart by their names.
    read = Document.from_json(document(drawn, names=f"{make_id()}-"))
    (root,) = read.roots
    read.clear()  # a model belongs to one document
    return root


def keep_scale(drawn: figure, x: Ends, y: Ends) -> figure:
    """Show these ranges to scale: the height follows the width that the page leaves to the drawing."""
    drawn.update(x_range=Range1d(*x), y_range=Range1d(*y), match_aspect=False)
    ratio = abs((y[1] - y[0]) / (x[1] - x[0]))

    def follow() -> None:
        around = drawn.outer_height - drawn.inner_height
        # A drawing that is hidden has no size.
        if drawn.inner_width > 0 and around > 0:
            drawn.height = round(drawn.inner_width * ratio + around)

    # The page tells the sizes one after the other.
    drawn.on_change("inner_width", lambda attr, old, new: schedule_update(follow))
    return drawn


def scaled_drawing(x: Ends, y: Ends, *, x_name: str, y_name: str, width_px: int) -> figure:
    """Return an empty drawing to scale, at most `width_px` wide."""
    drawn = keep_scale(figure_of(new_figure(x=x_name, y=y_name)), x, y)
    drawn.update(max_width=width_px)
    return drawn


def add_cross(drawn: figure, x: float, y: float) -> None:
    """Mark a place by a cross, dark on light, which is seen on any colour and on a dark page."""
    for colour, size, width in (("#ffffff", 20, 6), (INK, 18, 2.5)):
        drawn.scatter([x], [y], marker="cross", size=size, line_color=colour, line_width=width)


def to_scale(drawn: figure) -> figure:
    """Show a map of the report to scale in whatever width the page has."""
    return keep_scale(drawn, *((ends.start, ends.end) for ends in (drawn.x_range, drawn.y_range)))


def shown_chart(drawn: Model) -> pn.pane.Bokeh:
    """Return a chart of the report as wide as the page leaves to it, a map to scale."""
    made = figure_of(drawn)
    return shown_drawing(to_scale(made) if made.name == "plan" else made)


def shown_drawing(drawn: figure) -> pn.pane.Bokeh:
    """Return a drawing as wide as the page leaves to it."""
    return pn.pane.Bokeh(drawn, sizing_mode="stretch_width")


def shown(chart: Chart, caption: str) -> pn.viewable.Viewable:
    """Return a chart of the report with its caption and what is seen, in words."""
    return column(paragraph(caption), shown_chart(chart.figure), note(chart.seen))


def shown_if(chart: Chart | None, caption: str) -> Parts:
    """Return a chart with its caption where there is one."""
    return [] if chart is None else [shown(chart, caption)]
