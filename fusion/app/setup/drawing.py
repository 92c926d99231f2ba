"""Drawings of the screen *Set up*: white on every page, with colours that are told apart by everyone."""

from __future__ import annotations

from typing import Any

from bokeh.plotting import figure

#: Of the report.
TEAL, ACCENT, INK = "#0f5c6e", "#8a1c4a", "#1f2a30"


def drawing(
    x: Any, y: Any, *, x_label: str, y_label: str, size_px: tuple[int, int], scaled: bool = True, **more: Any
) -> Any:
    """Return an empty drawing.

    Parameters
    ----------
    x, y : tuple of float, or Range
        From left to right and from bottom to top.
    x_label, y_label : str
        Names of the axes with their units.
    size_px : (int, int)
        Width and height where there is room; it shrinks with the page.
    scaled : bool
        Whether its height shrinks too.
    **more
        Options of Bokeh's figure.

    Returns
    -------
    figure
        Of Bokeh.
    """
    drawn = figure(
        x_range=x,
        y_range=y,
        x_axis_label=x_label,
        y_axis_label=y_label,
        toolbar_location=None,
        tools="",
        width=size_px[0],
        height=size_px[1],
        max_width=size_px[0],
        sizing_mode="scale_width" if scaled else "stretch_width",
        background_fill_color="#ffffff",
        border_fill_color="#ffffff",
        **more,
    )
    drawn.axis.axis_label_text_font_style = "normal"
    drawn.axis.axis_label_text_color = drawn.axis.major_label_text_color = INK
    drawn.min_border_right = 12
    return drawn
