"""What all charts share: scrolling passes over them, their colours are readable on white, their ranges are comparable."""

from __future__ import annotations

import numpy as np
import pytest
from bokeh.models import ColorBar, HoverTool, LinearColorMapper

from fusion.report.charts import style


def contrast_with_white(colour: str) -> float:
    """Contrast ratio of WCAG 2.2."""
    parts = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return 1.05 / (float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05)


@pytest.mark.parametrize("colour", [*style.CATEGORIES, style.BEFORE, *style.ordered_colours(60)])
def test_every_line_is_readable_on_white(colour: str) -> None:
    assert contrast_with_white(colour) >= 3.0  # WCAG 2.2, 1.4.11


def test_a_chart_lets_the_page_scroll_and_names_its_axes() -> None:
    drawn = style.new_figure(x="position / mm", y="power", y_type="log", title="X")
    assert drawn.toolbar.active_scroll is None
    assert drawn.toolbar.active_drag is None
    assert (drawn.xaxis.axis_label, drawn.yaxis.axis_label) == ("position / mm", "power (logarithmic)")
    assert drawn.sizing_mode == "stretch_width"
    assert drawn.legend[0] in drawn.above
    other = style.new_figure(x="x", y="y", like=drawn)
    assert other.x_range is drawn.x_range


def test_a_band_has_the_gaps_of_its_values() -> None:
    drawn = style.new_figure(x="x", y="y")
    low = np.array([0.0, 1.0, np.nan, 3.0, 4.0])
    style.add_band(drawn, np.arange(5.0), low, low + 1, "#000000")
    pieces = [renderer.data_source.data["x"].tolist() for renderer in drawn.renderers]
    assert pieces == [[0.0, 1.0], [3.0, 4.0]]


def test_the_colour_bar_says_quantity_and_ticks() -> None:
    drawn = style.new_figure(x="x", y="y")
    style.add_colour_bar(drawn, LinearColorMapper(style.palette(), low=0, high=1), "rise / K", ticks=[0, 0.5, 1])
    (bar,) = drawn.select(ColorBar)
    assert bar.title == "rise / K"
    assert list(bar.ticker.ticks) == [0, 0.5, 1]


def test_hover_shows_values_of_the_given_marks() -> None:
    drawn = style.new_figure(x="x", y="y")
    line = drawn.line([0, 1], [0, 1])
    style.add_hover(drawn, [("drift", "@y{0.00} µm")], [line])
    (hover,) = drawn.select(HoverTool)
    assert hover.renderers == [line]
    assert hover.tooltips == [("drift", "@y{0.00} µm")]


def test_compared_charts_share_a_range() -> None:
    low, high = style.shared_range(np.array([-1.0, np.nan]), np.array([3.0]))
    assert (low, high) == pytest.approx((-1.16, 3.16))
    assert style.shared_range(np.array([-1.0, 3.0]), symmetrical=True) == pytest.approx((-3.24, 3.24))
    assert style.shared_range(np.array([np.nan])) == pytest.approx((-0.04, 1.04))
    drawn = style.new_figure(x="x", y="y")
    style.fix_range(drawn, low, high)
    assert (drawn.y_range.start, drawn.y_range.end) == (low, high)


def test_zero_is_marked() -> None:
    drawn = style.new_figure(x="x", y="y")
    style.add_zero_line(drawn)
    assert drawn.renderers[0].glyph.y == 0.0


def test_extent_in_words() -> None:
    assert style.span_words(np.array([-1.25, np.nan, 3.0]), "µm") == "−1.25 to 3.00 µm"
    assert style.span_words(np.array([np.nan]), "µm") == "without values"
