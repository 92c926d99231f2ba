"""What was recorded when, and the environment and the drivers on the same time axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from bokeh.layouts import column
from bokeh.models import LayoutDOM
from bokeh.plotting import figure

from fusion.report.charts.style import (
    CATEGORIES,
    Chart,
    add_hover,
    fix_range,
    new_figure,
    shared_range,
    span_words,
)
from fusion.report.wording import join, number, print_unit

_TIME = "time since first reading / h"
#: A recording has a gap where nothing comes for this many of its usual intervals.
_GAP = 1.8


def plot_timeline(fused: xr.Dataset) -> Chart:
    """Draw bars of what was recorded when, with gaps, and below them environment and drivers in their own units.

    Parameters
    ----------
    fused : Dataset
        Root of fusion.nc: ``time`` of the readings, ``frame_time``, ``environment_time`` and ``driver_time`` with their series.

    Returns
    -------
    Chart
    """
    times = fused["time"]
    start = np.nanmin(times.values)
    recorded = {"readings": np.asarray(((times - start) / np.timedelta64(1, "h")).mean(["direction", "target"]), float)}
    for name, dim in (("frames", "frame_time"), ("environment log", "environment_time"), ("driver log", "driver_time")):
        if dim in fused.dims:
            recorded[name] = _hours(fused[dim].values, start)
    spans = {name: recorded_spans(hours) for name, hours in recorded.items()}
    bars = _plot_spans(spans)
    series = [str(name) for name in fused.data_vars if fused[name].dims in (("environment_time",), ("driver_time",))]
    below: list[figure] = []
    for at, name in enumerate(series):
        below.append(_plot_series(fused[name], _hours(fused[fused[name].dims[0]].values, start), at, bars))
    for drawn in (bars, *below)[:-1]:
        drawn.xaxis.axis_label = None
    shown: LayoutDOM = column(bars, *below, sizing_mode="stretch_width") if below else bars
    gaps = [f"{name} {len(parts) - 1}" for name, parts in spans.items() if len(parts) > 1]
    said = [
        f"{_words(name)} {span_words(fused[name], print_unit(str(fused[name].attrs.get('units', '1'))))}"
        for name in series
    ]
    seen = (
        f"Recorded over {number(float(max(np.nanmax(hours) for hours in recorded.values())), 2)} h: {join(list(recorded))}; "
        f"{'gaps: ' + ', '.join(gaps) if gaps else 'no gaps'}." + (f" {'; '.join(said)}." if said else "")
    )
    rows = [(name, low, high) for name, parts in spans.items() for low, high in parts]
    columns: dict[str, Sequence[str] | np.ndarray] = {
        "recording": [name for name, *_ in rows],
        f"first, {_TIME}": np.array([low for _, low, _ in rows]),
        f"last, {_TIME}": np.array([high for *_, high in rows]),
    }
    return Chart(shown, seen, columns)


def recorded_spans(hours: np.ndarray) -> list[tuple[float, float]]:
    """Return the spans without a gap of a recording: first and last time of each.

    Parameters
    ----------
    hours : (n,) ndarray
        Times, h; NaN are left out.

    Returns
    -------
    list of (float, float)
        A gap is an interval above 1.8 times the 90 % quantile of the intervals: one missing value is a gap, uneven intervals are not.
    """
    known = np.sort(hours[np.isfinite(hours)])
    if known.size < 2:
        return [(float(known[0]), float(known[0]))] if known.size else []
    steps = np.diff(known)
    breaks = np.flatnonzero(steps > _GAP * float(np.quantile(steps, 0.9)))
    firsts, lasts = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [known.size - 1]])
    return [(float(known[first]), float(known[last])) for first, last in zip(firsts, lasts, strict=True)]


def _hours(times: np.ndarray, start: np.datetime64) -> np.ndarray:
    hours = (times - start) / np.timedelta64(1, "h")
    return np.asarray(hours[np.isfinite(hours)], float)


def _plot_spans(spans: dict[str, list[tuple[float, float]]]) -> figure:
    """Draw one bar for every span of every recording."""
    names = list(spans)
    every = [end for parts in spans.values() for part in parts for end in part]
    low, high = shared_range(np.array(every))
    drawn = new_figure(x=_TIME, y="", height=60 + 22 * len(names), y_range=names[::-1], x_range=(low, high))
    for at, name in enumerate(names):
        parts = spans[name]
        source = {"y": [name] * len(parts), "left": [part[0] for part in parts], "right": [part[1] for part in parts]}
        bar = drawn.hbar(y="y", left="left", right="right", height=0.55, color=CATEGORIES[at], source=source)
        add_hover(drawn, [("", name), ("from", "@left{0.00} h"), ("to", "@right{0.00} h")], [bar])
    return drawn


def _plot_series(values: xr.DataArray, hours: np.ndarray, at: int, above: figure) -> figure:
    """Draw one logged quantity below the bars, on the same time axis."""
    unit = print_unit(str(values.attrs.get("units", "1")))
    words = _words(str(values.name))
    drawn = new_figure(x=_TIME, y=unit or "1", title=words, height=118)
    drawn.x_range = above.x_range
    drawn.yaxis.ticker.desired_num_ticks = 3
    low, high = shared_range(values.values)
    fix_range(drawn, low, high)
    line = drawn.line(hours, values.values, line_color=CATEGORIES[at % len(CATEGORIES)], line_width=1.7)
    add_hover(drawn, [("time", "@x{0.00} h"), (words, f"@y{{0.00}} {unit}")], [line])
    return drawn


def _words(name: str) -> str:
    return name.removesuffix("_series").replace("_", " ")
