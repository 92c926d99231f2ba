"""What all charts share: sizes, axes, colours that hold on white and for colour-blind readers, legends, hover."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import xarray as xr

from fusion.common import own_name
from fusion.report.charts.embedded import EmbeddedChart, Figure, Model, document, field, in_script, source
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
#: Colours of the scales by name, from low to high, in equal steps: inferno of matplotlib; RdBu and PuOr of ColorBrewer.
_SCALES = {
    SEQUENTIAL: "000003 0A0723 200C4A 3C0965 570F6D 70196E 892269 A32B61 BB3754 D04544 E35832 F0701E F98C09 FBAA0E F8C931 F1E864 FCFEA4",
    DIVERGING: "053061 2166ac 4393c3 92c5de d1e5f0 f7f7f7 fddbc7 f4a582 d6604d b2182b 67001f",
    "PuOr_r": "2d004b 542788 8073ac b2abd2 d8daeb f7f7f7 fee0b6 fdb863 e08214 b35806 7f3b08",
}
#: What of matplotlib's viridis is dark enough to be read on white (contrast of at least 3 : 1): lines that have an order.
_ORDERED = "440154 481A6C 45327F 3E4888 355C8C 2D6E8E 267F8E 20918C 1FA286"
#: Labels of logarithmic axes: 1, 2 and 5 of every decade.
_LOG_TICKS = [step * 10.0**decade for decade in range(-6, 7) for step in (1, 2, 5)]
_DATES = {
    "minutes": "%H:%M",
    "hourmin": "%H:%M",
    "hours": "%H:%M",
    "days": "%Y-%m-%d",
    "months": "%Y-%m",
    "years": "%Y",
}
_FONT = "system-ui, Segoe UI, Roboto, Helvetica Neue, DejaVu Sans, sans-serif"


#: What is shown under the pointer: name and value, as Bokeh writes it.
Tips: TypeAlias = Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Chart:
    """A chart as a page shows it: a figure or a column of several; one sentence that says what is seen, for readers who do not see it;
    columns of one length that the reader can download, by heading with unit.
    """

    figure: Model
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
) -> Figure:
    """Return an empty figure in the common style: as wide as its place in the page, legend above the data, on demand the line of zero."""
    axes = [_axis(_announced(x, x_type), x_type, x_range), _axis(_announced(y, y_type), y_type, y_range)]
    heading: dict[str, Any] = {"text_font": _FONT, "text_font_size": "13px", "text_color": INK}
    legend = Model(
        "Legend", orientation="horizontal", ncols=legend_columns, border_line_color=None, background_fill_alpha=0.0, margin=0, padding=2,
        label_text_font=_FONT, label_text_font_size="11px", label_text_color=INK, click_policy="hide", spacing=8, label_height=14, items=[],
    )  # fmt: skip
    drawn = Figure(
        "Figure", height=height, sizing_mode="stretch_width", toolbar_location=None, background_fill_color="#ffffff",
        border_fill_color="#ffffff", outline_line_color=None, min_border_right=14,
        # A name from a file is no formula, which Bokeh would look for between signs such as $$.
        title=Model("Title", text=Model("PlainText", text=title), **heading) if title else None,
        x_range=_range(x_range), y_range=_range(y_range), x_scale=_scale(x_type, x_range), y_scale=_scale(y_type, y_range),
        below=axes[:1], left=axes[1:], above=[legend], renderers=[],
        center=[Model("Grid", dimension=at, axis=axis, grid_line_color=GRID) for at, axis in enumerate(axes)],
        toolbar=Model("Toolbar", tools=[Model("PanTool"), Model("WheelZoomTool")], active_drag=None, active_scroll=None),
    )  # fmt: skip
    if zero:
        draw(drawn, "HSpan", y=0.0, line_color=MUTED, line_width=1, level="underlay")
    return drawn


#: Ends of an axis, or its names; None: the range of what is drawn.
_Ends: TypeAlias = tuple[float, float] | Sequence[str] | None


def _is_named(ends: _Ends) -> bool:
    return ends is not None and isinstance(ends[0], str)


def _range(ends: _Ends) -> Model:
    """Return a range."""
    if ends is None:
        return Model("DataRange1d")
    if _is_named(ends):
        return Model("FactorRange", factors=list(ends))
    return Model("Range1d", start=ends[0], end=ends[1])


def _scale(kind: str, ends: _Ends) -> Model:
    """Return what turns values into pixels."""
    return Model("CategoricalScale" if _is_named(ends) else "LogScale" if kind == "log" else "LinearScale")


def _axis(label: str, kind: str, ends: _Ends) -> Model:
    """Return an axis in the common style."""
    made = Model(
        "CategoricalAxis" if _is_named(ends) else {"log": "LogAxis", "datetime": "DatetimeAxis"}.get(kind, "LinearAxis"),
        axis_label=label, axis_label_text_font=_FONT, axis_label_text_font_size="12px", axis_label_text_font_style="normal",
        axis_label_text_color=INK, major_label_text_font=_FONT, major_label_text_font_size="11px",
        major_label_text_color=INK, axis_line_color=MUTED, major_tick_line_color=MUTED, minor_tick_line_color=None,
    )  # fmt: skip
    if kind == "log":
        made.ticker = fixed_ticks(_LOG_TICKS)
    if kind == "datetime":
        made.update(
            formatter=Model("DatetimeTickFormatter", **_DATES), major_label_policy=Model("NoOverlap", min_distance=8)
        )
    return made


def fixed_ticks(places: Sequence[float]) -> Model:
    """Return labels at these places of an axis."""
    return Model("FixedTicker", ticks=list(places))


def _announced(label: str, scale: str) -> str:
    return f"{label} (logarithmic)" if scale == "log" else label


def add_hover(drawn: Figure, tips: Tips, renderers: Sequence[Model]) -> Model:
    """Show the values under the pointer."""
    tool = Model("HoverTool", tooltips=list(tips), renderers=list(renderers))
    drawn.toolbar.tools.append(tool)
    return tool


def literal(name: str) -> str:
    """Return a name from a file as it stands in a value under the pointer, which Bokeh reads as HTML with fields after @ and $."""
    return html.escape(name).replace("@", "&#64;").replace("$", "&#36;")


def draw(
    drawn: Figure, kind: str, *, columns: Model | None = None, named: str = "", level: str = "glyph", hovered: Any = None, **looks: Any
) -> Model:  # fmt: skip
    """Draw marks of one of Bokeh's kinds, and name them in the legend; arrays among their looks are columns, which a text may name, too."""
    own = {key: given for key, given in looks.items() if isinstance(given, list | np.ndarray)}
    held = source({}) if columns is None else columns
    held.data.update(own)

    def of_column(key: str, given: Any) -> Any:
        if key in own:
            return field(key)
        return field(given) if isinstance(given, str) and given in held.data else given

    def glyph(looks: Mapping[str, Any]) -> Model:
        return Model(kind, **{key: of_column(key, given) for key, given in looks.items()})

    mark = Model(
        "GlyphRenderer", data_source=held, glyph=glyph(looks), level=level, hover_glyph=glyph(looks | hovered) if hovered else None,
        nonselection_glyph=None, muted_glyph=None,
    )  # fmt: skip
    drawn.renderers.append(mark)
    items = drawn.legend.items
    label = {"type": "value", "value": named}
    if same := [item for item in items if item.label == label]:
        same[0].renderers.append(mark)
    elif named:
        items.append(Model("LegendItem", label=label, renderers=[mark]))
    return mark


def add_series(
    drawn: Figure,
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
    held = source({"x": np.asarray(x), "y": np.asarray(y)})
    common: dict[str, Any] = {"columns": held, "named": name if legend else "", "line_color": colour}
    parts = []
    if half is not None:
        below, above = np.broadcast_to(half, (2, len(y)))
        held.data.update(half=above, low=np.asarray(y) - below, high=np.asarray(y) + above)
        draw(drawn, "Segment", **common, x0="x", y0="low", x1="x", y1="high", line_width=1.3)
    if line:
        parts.append(draw(drawn, "Line", **common, x="x", y="y", line_dash=dash, line_width=width))
    if marker is not None:
        parts.append(draw(drawn, "Scatter", **common, x="x", y="y", marker=marker, size=size, fill_color=colour))
    (along, unit), (quantity, y_unit) = (_parts(axis.axis_label) for axis in (drawn.xaxis, drawn.yaxis))
    bars_shown = "" if half is None else " ± @half{0.000}" if np.ndim(half) == 1 else " (@low{0.000} to @high{0.000})"
    tips = [
        ("", literal(name)),
        (along, f"@x{{0.[000]}} {unit}"),
        (quantity, f"@y{{0.000}}{bars_shown} {literal(y_unit)}"),
    ]
    add_hover(drawn, tips, parts[-1:])


class Courses:
    """Named series of one figure as they are drawn: what the reader can download of them, and what is seen of each, in words."""

    def __init__(self, drawn: Figure, columns: Mapping[str, np.ndarray] | None = None, *, unit: str = "µm") -> None:
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
    drawn: Figure,
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
    looks = {"text_color": colour, "text_font_size": size, "text_align": align}
    drawn.add(Model("Label", x=x, y=y, text=text, x_offset=across, y_offset=up, **looks))


def _parts(label: str) -> tuple[str, str]:
    """Return quantity and unit of the label of an axis."""
    quantity, _, unit = label.partition(" / ")
    return quantity, unit.removesuffix(" (logarithmic)")


def add_ordered_lines(
    drawn: Figure, xs: Sequence[np.ndarray], ys: Sequence[np.ndarray], order: np.ndarray, label: str
) -> None:
    """Draw one line for each value of an ordered quantity, such as a cycle, with colour bar and values under the pointer."""
    (along, x_unit), (quantity, y_unit) = (_parts(axis.axis_label) for axis in (drawn.xaxis, drawn.yaxis))
    held = source(
        {"xs": list(xs), "ys": list(ys), "order": np.asarray(order, float), "colour": ordered_colours(len(order))}
    )
    looks: dict[str, Any] = {"xs": "xs", "ys": "ys", "line_color": "colour", "line_width": 1.4}
    lines = draw(drawn, "MultiLine", columns=held, hovered={"line_width": 3.5}, **looks)
    name, unit = _parts(label)
    tips = [(name, f"@order{{0.[000]}} {unit}"), (along, f"$x{{0.[00]}} {x_unit}"), (quantity, f"$y{{0.00}} {y_unit}")]
    add_hover(drawn, tips, [lines])
    low, high = float(np.min(order)), float(np.max(order))
    add_colour_bar(drawn, mapper(ordered_colours(256), low, high if high > low else low + 1), label)


def add_hold_out(drawn: Figure, low: float, high: float) -> None:
    """Shade the part of a test that took no part in any choice."""
    shade(drawn, low, high, 0.08)


def shade(drawn: Figure, low: float, high: float | None, alpha: float) -> None:
    """Shade what lies between two places of the horizontal axis, or from one on."""
    drawn.add(Model("BoxAnnotation", left=low, right=high, fill_color=ACCENT, fill_alpha=alpha, level="underlay"))


def add_band(drawn: Figure, x: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str, name: str = "") -> None:
    """Shade what lies between two lines; a gap in either is a gap."""
    x, low, high = (np.asarray(values, float) for values in (x, low, high))
    valid = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    for piece in np.split(np.arange(x.size), np.flatnonzero(np.diff(valid.astype(int))) + 1):
        if piece.size and valid[piece[0]]:
            looks: dict[str, Any] = {"fill_color": colour, "fill_alpha": 0.18, "level": "underlay"}
            draw(drawn, "VArea", named=name, x=x[piece], y1=low[piece], y2=high[piece], **looks)


def mapper(colours: Sequence[str], low: float, high: float, **beyond: str) -> Model:
    """Return what gives values their colours; `beyond` those of values outside and of none."""
    return Model("LinearColorMapper", palette=list(colours), low=low, high=high, **beyond)


#: Looks of a scale of colours.
COLOUR_BAR: dict[str, Any] = {
    "title_text_font": _FONT, "title_text_font_size": "11px", "title_text_font_style": "normal", "title_text_color": INK,
    "major_label_text_font": _FONT, "major_label_text_font_size": "11px", "major_label_text_color": INK, "bar_line_color": None,
    "major_tick_line_color": MUTED, "background_fill_color": None, "padding": 4,
}  # fmt: skip


def add_colour_bar(drawn: Figure, colours: Model, label: str, *, place: str = "below") -> Model:
    """Put the scale of the colours at a map or ordered lines."""
    length, breadth = ("width", "height") if place == "below" else ("height", "width")
    bar = Model("ColorBar", color_mapper=colours, title=label, **{length: "auto", breadth: 10}, **COLOUR_BAR)
    drawn.add(bar, place)
    return bar


def palette(name: str = SEQUENTIAL) -> list[str]:
    """Return the colours of a scale from low to high."""
    return list(_steps(_SCALES[name], 256))


def ordered_colours(count: int) -> list[str]:
    """Return the colours of lines that have an order, such as cycles or positions, from dark to lighter."""
    return list(_steps(_ORDERED, count))


@cache
def _steps(colours: str, count: int) -> tuple[str, ...]:
    """Return colours between those of a scale in equal steps."""
    known = np.array([list(bytes.fromhex(colour)) for colour in colours.split()], float)
    at = np.linspace(0, len(known) - 1, count)
    mixed = np.stack([np.interp(at, np.arange(len(known)), part) for part in known.T], axis=1).astype(np.uint8)
    return tuple(f"#{bytes(colour).hex()}" for colour in mixed)


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


def fix_range(drawn: Figure, low: float, high: float) -> None:
    """Set the y range of a chart."""
    drawn.y_range = _range((low, high))


def span_words(values: np.ndarray | xr.DataArray, unit: str) -> str:
    """Return the smallest and the largest value, NaN left out, as "−1.25 to 3.00 µm", for text alternatives."""
    return span(values, unit, ".2f").replace("-", "−")


# Charts in a page: each with its text alternative and its data.


def embed(charts: Mapping[str, Chart]) -> dict[str, EmbeddedChart]:
    """Return charts ready for a template."""
    for chart in charts.values():
        _prepare(chart)
    return {
        name: EmbeddedChart(
            name, chart.seen, _height(chart), in_script(json.dumps(_item(name, chart), separators=(",", ":")), "</")
        )
        for name, chart in charts.items()
    }


def _prepare(chart: Chart) -> None:
    """Add to a chart what it lets the reader download."""
    columns = {heading: _compact(np.asarray(values)) for heading, values in chart.columns.items()}
    chart.figure.tags = [source(columns), *chart.figure.properties.get("tags", [])]


def _item(name: str, chart: Chart) -> dict[str, object]:
    """Return a chart as BokehJS embeds it, its document of one root."""
    doc = document(chart.figure)
    return {"target_id": f"drawing-{name}", "root_id": doc["roots"][0]["id"], "doc": doc}


def _compact(values: np.ndarray) -> np.ndarray:
    """Return a column as it travels: numbers in single precision (seven digits), everything else as text."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
    return values.astype(str).astype(object)


def _height(chart: Chart) -> int:
    """Return the height of a chart in CSS px: its own, or the sum of what a column of charts holds."""
    plots = chart.figure.properties.get("children", [chart.figure])
    return sum(int(plot.height) for plot in plots)


def column(parts: Sequence[Figure]) -> Model:
    """Return figures one below another, as wide as the page."""
    return Model("Column", children=list(parts), sizing_mode="stretch_width")
