"""What all charts share: sizes, axes, colours that hold on white and for colour-blind readers, legends, hover."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import bokeh
import numpy as np
import xarray as xr
from bokeh import palettes
from bokeh.core.properties import value
from bokeh.core.serialization import Serializer
from bokeh.document import Document
from bokeh.model import Model
from bokeh.models import (
    BoxAnnotation,
    ColorBar,
    ColorMapper,
    ColumnDataSource,
    FixedTicker,
    GlyphRenderer,
    HoverTool,
    Label,
    LayoutDOM,
    Legend,
    LegendItem,
    LinearColorMapper,
    PanTool,
    PlainText,
    Plot,
    Range1d,
    WheelZoomTool,
    glyphs,
)
from bokeh.plotting import figure

from fusion.common import own_name
from fusion.report.charts.embedded import EmbeddedChart, in_script
from fusion.results.numbers import span
from interferometry.plots import ACCENT, COLOURS, GRID, INK, MUTED

#: Colours of named lines, each readable on white and distinguishable by colour-blind readers together with the dashes of `DASHES`.
CATEGORIES = (COLOURS["positive"], COLOURS["negative"], "#6a3d9a", INK, "#4d7c0f", "#a0447f", "#1f66b0", "#7a5c00")
DASHES = ("solid", "dashed", "dotdash", "dotted")
#: Colour of what a model said before anything was added.
BEFORE = "#76858c"
#: Marker of each direction of approach.
MARKERS = {"positive": "triangle", "negative": "inverted_triangle"}
#: Perceptually uniform scale for quantities, and a diverging one with its middle at zero; both hold for colour-blind readers.
SEQUENTIAL, DIVERGING = "inferno", "RdBu_r"
#: Colours of the scales by name, from low to high, as Bokeh brings them.
_SCALES = {SEQUENTIAL: palettes.Inferno256, DIVERGING: palettes.RdBu11, "PuOr_r": palettes.PuOr11}
#: Share of the scale of ordered lines that is dark enough to be read on white (contrast of at least 3 : 1).
_DARK_SHARE = 0.58
#: Labels of logarithmic axes: 1, 2 and 5 of every decade.
_LOG_TICKS = [step * 10.0**decade for decade in range(-6, 7) for step in (1, 2, 5)]
_FONT = "system-ui, Segoe UI, Roboto, Helvetica Neue, DejaVu Sans, sans-serif"


#: What is shown under the pointer: name and value, as Bokeh writes it.
Tips: TypeAlias = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Chart:
    """A chart as a page shows it: a Bokeh figure or layout; one sentence that says what is seen, for readers who do not see it; columns of
    one length that the reader can download, by heading with unit.
    """

    figure: LayoutDOM
    seen: str
    columns: Mapping[str, Sequence[Any] | np.ndarray]


def new_figure(
    *,
    x: str,
    y: str,
    title: str = "",
    height: int = 320,
    x_range: tuple[float, float] | Sequence[str] | None = None,
    y_range: tuple[float, float] | Sequence[str] | None = None,
    x_type: str = "auto",
    y_type: str = "auto",
    legend_columns: int = 2,
    zero: bool = False,
) -> figure:
    """Return an empty figure in the common style: as wide as its place in the page, legend above the data, on demand the line of zero."""
    ranges: dict[str, Any] = {"x_range": x_range, "y_range": y_range}
    drawn = figure(
        height=height, sizing_mode="stretch_width", tools="", toolbar_location=None, title=title or None,
        x_axis_label=_announced(x, x_type), y_axis_label=_announced(y, y_type), x_axis_type=x_type, y_axis_type=y_type,
        background_fill_color="#ffffff", border_fill_color="#ffffff", outline_line_color=None, min_border_right=14,
        **{name: given for name, given in ranges.items() if given is not None},
    )  # fmt: skip
    drawn.add_tools(PanTool(), WheelZoomTool())
    drawn.toolbar.active_drag = drawn.toolbar.active_scroll = None
    for axis in drawn.axis:
        axis.update(
            axis_label_text_font=_FONT, axis_label_text_font_size="12px", axis_label_text_font_style="normal",
            axis_label_text_color=INK, major_label_text_font=_FONT, major_label_text_font_size="11px",
            major_label_text_color=INK, axis_line_color=MUTED, major_tick_line_color=MUTED, minor_tick_line_color=None,
        )  # fmt: skip
    for axis, scale in ((drawn.xaxis, x_type), (drawn.yaxis, y_type)):
        if scale == "log":
            axis.ticker = FixedTicker(ticks=_LOG_TICKS)
    drawn.grid.grid_line_color = GRID
    if title:
        # A name from a file is no formula, which Bokeh would look for between signs such as $$.
        drawn.title.update(text=PlainText(text=title), text_font=_FONT, text_font_size="13px", text_color=INK)
    drawn.add_layout(
        Legend(
            orientation="horizontal", ncols=legend_columns, border_line_color=None, background_fill_alpha=0.0, margin=0, padding=2,
            label_text_font=_FONT, label_text_font_size="11px", label_text_color=INK, click_policy="hide", spacing=8, label_height=14,
        ),
        "above",
    )  # fmt: skip
    if zero:
        draw(drawn, "HSpan", y=0.0, line_color=MUTED, line_width=1, level="underlay")
    return drawn


def _announced(label: str, scale: str) -> str:
    return f"{label} (logarithmic)" if scale == "log" else label


def add_hover(drawn: figure, tips: Tips, renderers: Sequence[GlyphRenderer]) -> None:
    """Show the values under the pointer."""
    drawn.add_tools(HoverTool(tooltips=list(tips), renderers=list(renderers)))


def literal(name: str) -> str:
    """Return a name from a file as it stands in a value under the pointer, which Bokeh reads as HTML with fields after @ and $."""
    return html.escape(name).replace("@", "&#64;").replace("$", "&#36;")


def draw(
    drawn: figure, kind: str, *, source: Any = None, named: str = "", level: str = "glyph", hovered: Any = None, **looks: Any
) -> GlyphRenderer:  # fmt: skip
    """Draw marks of one of Bokeh's kinds, arrays among their looks being columns, and name them in the legend. Bokeh's own methods make
    each mark three times, for what is selected and what is muted.
    """
    columns = {key: given for key, given in looks.items() if isinstance(given, list | np.ndarray)}
    held = source if isinstance(source, ColumnDataSource) else ColumnDataSource({**(source or {}), **columns})
    looks, made = looks | {key: key for key in columns}, getattr(glyphs, kind)
    under = made(**looks | hovered) if hovered else None
    others: dict[str, Any] = {"level": level, "hover_glyph": under, "nonselection_glyph": None, "muted_glyph": None}
    mark = drawn.add_glyph(held, made(**looks), **others)
    items = drawn.legend[0].items
    if same := [item for item in items if item.label == value(named)]:
        same[0].renderers.append(mark)
    elif named:
        items.append(LegendItem(label=value(named), renderers=[mark]))
    return mark


def add_series(
    drawn: figure,
    x: np.ndarray,
    y: np.ndarray,
    *,
    name: str,
    colour: str,
    dash: str = "solid",
    line: bool = True,
    marker: str | None = None,
    half: np.ndarray | None = None,
    width: float = 1.7,
    size: float = 7.0,
    legend: bool = True,
) -> None:
    """Draw a named series with its values under the pointer; `half` the length (n,) of its error bars to either side, or (2, n) of each."""
    source = ColumnDataSource({"x": np.asarray(x), "y": np.asarray(y)})
    common: dict[str, Any] = {"source": source, "named": name if legend else "", "line_color": colour}
    parts = []
    if half is not None:
        below, above = np.broadcast_to(half, (2, len(y)))
        source.data = {**source.data, "half": above, "low": np.asarray(y) - below, "high": np.asarray(y) + above}
        draw(drawn, "Segment", **common, x0="x", y0="low", x1="x", y1="high", line_width=1.3)
    if line:
        parts.append(draw(drawn, "Line", **common, x="x", y="y", line_dash=dash, line_width=width))
    if marker is not None:
        parts.append(draw(drawn, "Scatter", **common, x="x", y="y", marker=value(marker), size=size, fill_color=colour))
    (along, unit), (quantity, y_unit) = (_parts(axis.axis_label) for axis in (drawn.xaxis[0], drawn.yaxis[0]))
    bars_shown = "" if half is None else " ± @half{0.000}" if np.ndim(half) == 1 else " (@low{0.000} to @high{0.000})"
    tips = [
        ("", literal(name)),
        (along, f"@x{{0.[000]}} {unit}"),
        (quantity, f"@y{{0.000}}{bars_shown} {literal(y_unit)}"),
    ]
    add_hover(drawn, tips, parts[-1:])


class Courses:
    """Named series of one figure as they are drawn: what the reader can download of them, and what is seen of each, in words."""

    def __init__(self, drawn: figure, columns: Mapping[str, np.ndarray] | None = None, *, unit: str = "µm") -> None:
        self.figure, self.columns, self.told, self.unit = drawn, dict(columns or {}), list[str](), unit

    def add(
        self, x: np.ndarray, y: np.ndarray, name: str, column: str = "", bars: str = "", seen: str = "", **looks: Any
    ) -> None:
        """Draw a series; `column` and `seen` where they are not its name with the unit and its span, `bars` heads half its error bars,
        or both ends of those that are unequal.
        """
        add_series(self.figure, x, y, name=name, **looks)
        self.columns[own_name(column or f"{name} / {self.unit}", self.columns)] = y
        if bars and np.ndim(looks["half"]) == 1:
            self.columns[bars] = looks["half"]
        elif bars:
            below, above = looks["half"]
            self.columns |= {f"{bars}, from": y - below, f"{bars}, to": y + above}
        self.told.append(f"{name} {seen or span_words(y, self.unit)}")

    def chart(self, subject: str) -> Chart:
        """Return the chart, with what is seen of every series after the subject."""
        return Chart(self.figure, f"{subject}: {'; '.join(self.told)}.", self.columns)


def of_direction(direction: str) -> dict[str, Any]:
    """Return colour and marker of a series of one direction of approach."""
    return {"colour": COLOURS[direction], "marker": MARKERS[direction]}


def of_rank(rank: int) -> dict[str, Any]:
    """Return colour and dash of one of several named lines."""
    return {"colour": CATEGORIES[rank % len(CATEGORIES)], "dash": DASHES[rank % len(DASHES)]}


def add_label(
    drawn: figure,
    x: float,
    y: float,
    text: str,
    *,
    offset: tuple[int, int],
    colour: str = INK,
    size: str = "12px",
    align: str = "left",
) -> None:
    """Write a text at a point, moved by an offset in px."""
    across, up = offset
    drawn.add_layout(
        Label(
            x=x, y=y, text=text, text_color=colour, text_font_size=size, text_align=align, x_offset=across, y_offset=up
        )
    )


def _parts(label: str) -> tuple[str, str]:
    """Return quantity and unit of the label of an axis."""
    quantity, _, unit = label.partition(" / ")
    return quantity, unit.removesuffix(" (logarithmic)")


def add_ordered_lines(
    drawn: figure, xs: Sequence[np.ndarray], ys: Sequence[np.ndarray], order: np.ndarray, label: str
) -> None:
    """Draw one line for each value of an ordered quantity, such as a cycle, with colour bar and values under the pointer."""
    (along, x_unit), (quantity, y_unit) = (_parts(axis.axis_label) for axis in (drawn.xaxis[0], drawn.yaxis[0]))
    source = {"xs": list(xs), "ys": list(ys), "order": np.asarray(order, float), "colour": ordered_colours(len(order))}
    looks: dict[str, Any] = {"xs": "xs", "ys": "ys", "line_color": "colour", "line_width": 1.4}
    lines = draw(drawn, "MultiLine", source=source, hovered={"line_width": 3.5}, **looks)
    name, unit = _parts(label)
    tips = [(name, f"@order{{0.[000]}} {unit}"), (along, f"$x{{0.[00]}} {x_unit}"), (quantity, f"$y{{0.00}} {y_unit}")]
    add_hover(drawn, tips, [lines])
    low, high = float(np.min(order)), float(np.max(order))
    add_colour_bar(drawn, LinearColorMapper(ordered_colours(256), low=low, high=high if high > low else low + 1), label)


def add_hold_out(drawn: figure, low: float, high: float) -> None:
    """Shade the part of a test that took no part in any choice."""
    drawn.add_layout(BoxAnnotation(left=low, right=high, fill_color=ACCENT, fill_alpha=0.08, level="underlay"))


def add_band(drawn: figure, x: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str, name: str = "") -> None:
    """Shade what lies between two lines; a gap in either is a gap."""
    x, low, high = (np.asarray(values, float) for values in (x, low, high))
    valid = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    for piece in np.split(np.arange(x.size), np.flatnonzero(np.diff(valid.astype(int))) + 1):
        if piece.size and valid[piece[0]]:
            ends = {"x": x[piece], "y1": low[piece], "y2": high[piece]}
            draw(drawn, "VArea", **ends, fill_color=colour, fill_alpha=0.18, named=name, level="underlay")


def add_colour_bar(
    drawn: figure, mapper: ColorMapper, label: str, *, ticks: Sequence[float] | None = None, place: str = "below"
) -> None:
    """Put the scale of the colours at a map or ordered lines."""
    bar = ColorBar(
        color_mapper=mapper, title=label, width="auto" if place == "below" else 10, height=10 if place == "below" else "auto",
        title_text_font=_FONT, title_text_font_size="11px", title_text_font_style="normal", title_text_color=INK,
        major_label_text_font=_FONT, major_label_text_font_size="11px", major_label_text_color=INK, bar_line_color=None,
        major_tick_line_color=MUTED, background_fill_color=None, padding=4,
        **({} if ticks is None else {"ticker": FixedTicker(ticks=list(ticks))}),
    )  # fmt: skip
    drawn.add_layout(bar, place)


def palette(name: str = SEQUENTIAL) -> list[str]:
    """Return the colours of a scale from low to high."""
    return list(palettes.interp_palette(_SCALES[name], 256))


def ordered_colours(count: int) -> list[str]:
    """Return the colours of lines that have an order, such as cycles or positions, from dark to lighter."""
    dark = palettes.Viridis256[: round(_DARK_SHARE * 256)]
    return list(palettes.interp_palette(dark, count))


def shared_range(*values: np.ndarray, symmetrical: bool = False) -> tuple[float, float]:
    """Return one range for charts that are compared: all values with a margin of 4 %."""
    every = np.concatenate([np.ravel(part) for part in values])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if every.size else (0.0, 1.0)
    if symmetrical:
        high = max(abs(low), abs(high))
        low = -high
    margin = 0.04 * (high - low) or 0.5
    return low - margin, high + margin


def fix_range(drawn: figure, low: float, high: float) -> None:
    """Set the y range of a chart."""
    drawn.y_range = Range1d(low, high)


def span_words(values: np.ndarray | xr.DataArray, unit: str) -> str:
    """Return the smallest and the largest value, NaN left out, as "−1.25 to 3.00 µm", for text alternatives."""
    return span(values, unit, ".2f").replace("-", "−")


# Charts in a page: each with its text alternative and its data.


def embed(charts: Mapping[str, Chart]) -> dict[str, EmbeddedChart]:
    """Return charts ready for a template."""
    for chart in charts.values():
        _prepare(chart)
    return {
        name: EmbeddedChart(name, chart.seen, _height(chart), in_script(json.dumps(item, separators=(",", ":")), "</"))
        for (name, chart), item in zip(charts.items(), _items(charts), strict=True)
    }


def _prepare(chart: Chart) -> None:
    """Add to a chart what it lets the reader download."""
    columns = {heading: _compact(np.asarray(values)) for heading, values in chart.columns.items()}
    chart.figure.tags = [ColumnDataSource(columns), *chart.figure.tags]


def _items(charts: Mapping[str, Chart]) -> list[dict[str, object]]:
    """Return what `bokeh.embed.json_item` returns of every chart; it also looks for mistakes in every drawing, for most of the time."""
    empty = Document(title="").to_json(deferred=False)
    items: list[dict[str, object]] = []
    for name, chart in charts.items():
        names = {"target_id": f"drawing-{name}", "root_id": chart.figure.id}
        drawing = _Sparing(deferred=False).encode(chart.figure)
        items.append({**names, "doc": {**empty, "roots": [drawing]}, "version": bokeh.__version__})
    return items


class _Sparing(Serializer):
    """Writes models as Bokeh does, which also makes the default of every property that it then leaves out, for most of the time."""

    def _encode(self, obj: Any) -> Any:
        if not isinstance(obj, Model):
            return super()._encode(obj)
        self.add_ref(obj, obj.ref)
        known = obj._property_values.keys() | obj._unstable_default_values.keys()
        values = obj.query_properties_with_values(
            lambda one: one.serialized and one.name in known, include_defaults=False
        )
        attributes = {key: self.encode(value) for key, value in values.items()}
        written = {"type": "object", "name": obj.__qualified_model__, "id": obj.id}
        return {**written, "attributes": attributes} if attributes else written


def _compact(values: np.ndarray) -> np.ndarray:
    """Return a column as it travels: numbers in single precision (seven digits), everything else as text."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
    return values.astype(str).astype(object)


def _plots(chart: Chart) -> list[Plot]:
    """Return the figure of a chart, or those of a layout."""
    return [chart.figure] if isinstance(chart.figure, Plot) else list(chart.figure.select({"type": Plot}))


def _height(chart: Chart) -> int:
    """Return the height of a chart in CSS px: its own, or the sum of what a column of charts holds."""
    own = chart.figure.height
    return int(own) if own is not None else sum(int(plot.height or 0) for plot in _plots(chart))
