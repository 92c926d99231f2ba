"""Chart of a test by ISO 230-2: means and ±2 s of both approaches over the targets, with A, E and B."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.models import Label, Whisker
from bokeh.models.sources import ColumnDataSource
from bokeh.plotting import figure

from fusion.report.charts.style import (
    MARKERS,
    Chart,
    add_band,
    add_hover,
    add_zero_line,
    new_figure,
    span_words,
)
from fusion.report.wording import number
from interferometry.figures import ARROWS, COLOURS, INK, MUTED


def plot_test(settled: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the chart of the standard: mean deviation and ±2 s of each approach, with the spans of A and E and the place of B.

    Parameters
    ----------
    settled : Dataset
        What `interferometry.iso230.evaluate_iso230` returns.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    order = np.argsort(position.values, kind="stable")
    settled, x = settled.isel(target=order), position.values[order].astype(float)
    room = 0.24 * (np.ptp(x) or 1.0)
    left = x[0] - 0.04 * room
    drawn = new_figure(x="position / mm", y="deviation / µm", height=420, x_range=(left, x[-1] + room))
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"target": settled["target"].values, "position / mm": x}
    for direction in settled["direction"].values:
        row = settled.sel(direction=direction)
        mean, s = row["mean_unidirectional"].values, row["standard_deviation"].values
        if not np.isfinite(mean).any():
            continue
        name = ARROWS[direction]
        add_band(drawn, x, mean - 2 * s, mean + 2 * s, COLOURS[direction])
        source = ColumnDataSource({"x": x, "y": mean, "low": mean - 2 * s, "high": mean + 2 * s, "s": s})
        drawn.line("x", "y", source=source, line_width=1.6, color=COLOURS[direction], legend_label=f"mean, {name}")
        whisker = Whisker(base="x", upper="high", lower="low", source=source, line_color=COLOURS[direction])
        for head in (whisker.upper_head, whisker.lower_head):
            head.update(line_color=COLOURS[direction], size=8)
        drawn.add_layout(whisker)
        points = drawn.scatter(
            "x",
            "y",
            source=source,
            marker=MARKERS[direction],
            size=7,
            color=COLOURS[direction],
            legend_label=f"mean, {name}",
        )
        add_hover(
            drawn, [("position", "@x{0.###} mm"), (f"mean {name}", "@y{0.00} µm"), ("s", "@s{0.00} µm")], [points]
        )
        columns |= {f"mean, {name} / µm": mean, f"s, {name} / µm": s}
    if np.isfinite(settled["mean_bidirectional"]).any():
        drawn.line(x, settled["mean_bidirectional"].values, color=INK, line_dash="dotted", legend_label="mean of both")
        _mark_reversal(drawn, settled, x)
    _mark_spans(drawn, settled, x[-1], room)
    return Chart(drawn, _seen(settled, x), columns)


def _mark_spans(drawn: figure, settled: xr.Dataset, end: float, room: float) -> None:
    """Draw the spans of A and E beside the data, where both approaches were measured, else those of the one approach."""
    mean, s = settled["mean_unidirectional"].values, settled["standard_deviation"].values
    if not np.isfinite(mean).any():
        return
    # Labels stand beside their spans at two heights: at one height they would be written over each other.
    spans = (("A", mean - 2 * s, mean + 2 * s, 0.15, 0.3), ("E", mean, mean, 0.62, 0.6))
    for symbol, low, high, share, height in spans:
        at, bottom, top = end + share * room, float(np.nanmin(low)), float(np.nanmax(high))
        drawn.segment([at], [bottom], [at], [top], line_color=INK, line_width=1.4)
        for level in (bottom, top):
            drawn.segment([end], [level], [at], [level], line_color=MUTED, line_dash="dashed", line_width=0.8)
        drawn.add_layout(
            Label(
                x=at, y=bottom + height * (top - bottom), text=f"{symbol} {top - bottom:.2f}", text_color=INK, text_font_size="12px",
                x_offset=4, y_offset=-8,
            )
        )  # fmt: skip


def _mark_reversal(drawn: figure, settled: xr.Dataset, x: np.ndarray) -> None:
    """Draw the reversal error B at the target where it is largest."""
    reversal = settled["reversal"].values
    k = int(np.nanargmax(np.abs(reversal)))
    ends, s = settled["mean_unidirectional"].values[:, k], settled["standard_deviation"].values[:, k]
    drawn.segment([x[k]], [ends.min()], [x[k]], [ends.max()], line_color=INK, line_width=3)
    drawn.add_layout(
        Label(
            x=float(x[k]), y=float((ends + 2 * s).max()), text=f"B {abs(reversal[k]):.2f}", text_color=INK, text_font_size="12px",
            x_offset=-16, y_offset=6,
        )
    )  # fmt: skip


def _seen(settled: xr.Dataset, x: np.ndarray) -> str:
    """Return the text alternative."""
    rows = [
        f"{ARROWS[direction]} {span_words(settled['mean_unidirectional'].sel(direction=direction), 'µm')}"
        for direction in settled["direction"].values
        if np.isfinite(settled["mean_unidirectional"].sel(direction=direction)).any()
    ]
    values = ", ".join(
        f"{symbol} {number(float(settled[symbol]))} µm" for symbol in "AEB" if np.isfinite(settled[symbol])
    )
    return f"Mean deviation over {span_words(x, 'mm')} of the axis with ±2 s: {'; '.join(rows)}." + (
        f" {values}." if values else ""
    )


def plot_single_runs(deviations: xr.Dataset) -> Chart:
    """Draw the deviations of a test of one cycle, which has no standard deviation.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``; every reading is shown.

    Returns
    -------
    Chart
    """
    drawn = new_figure(x="position / mm", y="deviation / µm", height=420)
    add_zero_line(drawn)
    ordered = deviations.sortby("position")
    x = ordered["position"].values
    columns: dict[str, np.ndarray] = {"target": ordered["target"].values, "position / mm": x}
    seen = []
    for direction in ordered["direction"].values:
        for cycle in ordered["cycle"].values:
            y = ordered["deviation"].sel(direction=direction, cycle=cycle).values
            if not np.isfinite(y).any():
                continue
            name = ARROWS[direction]
            drawn.line(x, y, color=COLOURS[direction], line_width=1.6, legend_label=name)
            points = drawn.scatter(x, y, marker=MARKERS[direction], size=7, color=COLOURS[direction], legend_label=name)
            add_hover(drawn, [("position", "$x{0.###} mm"), (name, "$y{0.00} µm")], [points])
            columns[f"cycle {cycle}, {name} / µm"] = y
            seen.append(f"{name} {span_words(y, 'µm')}")
    return Chart(drawn, f"Single deviations over {span_words(x, 'mm')} of the axis: {'; '.join(seen)}.", columns)
