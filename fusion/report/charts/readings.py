"""Charts of the readings: every cycle over position, one position over time, ISO 230-2 windows along the test."""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import Any

import numpy as np
import xarray as xr

from fusion.report.charts.embedded import Figure, Model, field, source
from fusion.report.charts.style import (
    CATEGORIES,
    MARKERS,
    Chart,
    Courses,
    add_band,
    add_hover,
    add_label,
    add_ordered_lines,
    add_series,
    column,
    draw,
    fix_range,
    literal,
    new_figure,
    of_direction,
    ordered_colours,
    shade,
    shared_range,
    span_words,
)
from fusion.results.numbers import join, number, print_unit
from interferometry.drift.estimate import scatter_limits
from interferometry.plots import ACCENT, ARROWS, COLOURS, INK, MUTED, hours_since_start

# Charts of the joint estimate: drift of every position over time, drift-free profile.


def plot_drift(drift: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw the drift of every position over time, mean of both approaches; the ends of the axis are named and have their 95 % band."""
    hours = hours_since_start(deviations).mean("direction").transpose("cycle", "target").values
    lines = drift["drift_since_first"].mean("direction").transpose("cycle", "target").values
    band = 2 * drift["drift_since_first_u"].mean("direction").transpose("cycle", "target").values
    position = deviations["position"].values
    order = np.argsort(position, kind="stable")
    colours = ordered_colours(position.size)
    # Room for names at the right.
    first_h, last_h = float(np.nanmin(hours)), float(np.nanmax(hours))
    times = (first_h - 0.02 * (last_h - first_h), last_h + 0.3 * (last_h - first_h))
    drawn = new_figure(x="time since first reading / h", y="drift / µm", height=360, x_range=times, zero=True)
    ends = (0, position.size - 1)
    for rank in ends:
        line, half = lines[:, order[rank]], band[:, order[rank]]
        add_band(drawn, hours[:, order[rank]], line - half, line + half, colours[rank])
    add_ordered_lines(drawn, list(hours.T[order]), list(lines.T[order]), position[order], "position / mm")
    for rank in ends:
        x, y = hours[:, order[rank]], lines[:, order[rank]]
        valid = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        if valid.size:
            last, name = valid[-1], f"{position[order[rank]]:g} mm"
            add_label(drawn, float(x[last]), float(y[last]), name, offset=(4, -6), colour=colours[rank], size="11px")
    courses = [line[np.isfinite(line)] for line in lines.T]
    change = np.mean([course[-1] - course[0] for course in courses if course.size])
    far = np.argmax([np.abs(course).max(initial=-1.0) for course in courses])
    seen = (
        f"Drift of {position.size} positions over {number(float(np.nanmax(hours)), 2)} h: {span_words(lines, 'µm')}; from the first to the "
        f"last cycle it changes by {number(float(change), 2)} µm on average, and the largest drift is at {position[far]:g} mm."
    )
    columns = {
        "cycle": np.repeat(drift["cycle"].values, position.size),
        "position / mm": np.tile(position, len(lines)),
        "time since first reading / h": hours.ravel(),
        "drift / µm": lines.ravel(),
        "95 % band ± / µm": band.ravel(),
    }
    return Chart(drawn, seen, columns)


def plot_profile(drift: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the drift-free profile of both approaches with its 95 % band."""
    order = np.argsort(position.values, kind="stable")
    drift, x = drift.isel(target=order), position.values[order].astype(float)
    courses = Courses(new_figure(x="position / mm", y="deviation / µm", zero=True), {"position / mm": x})
    for direction in drift["direction"].values:
        row, name = drift.sel(direction=direction), ARROWS[direction]
        value, half = row["profile"].values, 2 * row["profile_u"].values
        add_band(courses.figure, x, value - half, value + half, COLOURS[direction])
        looks = {"half": half, **of_direction(direction)}
        courses.add(x, value, name, f"profile, {name} / µm", f"95 % band ±, {name} / µm", **looks)
    return courses.chart(f"Drift-free deviation over {span_words(x, 'mm')} of the axis")


def plot_reversal(drift: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the reversal (positive minus negative approach) of every position with its 95 % interval."""
    drawn = new_figure(x="position / mm", y="positive − negative / µm", zero=True)
    x, value, half = position.values.astype(float), drift["reversal"].values, 2 * drift["reversal_u"].values
    add_series(drawn, x, value, name="reversal", colour=INK, line=False, marker="circle", half=half, legend=False)
    apart = int((np.abs(value) > half).sum())
    seen = f"Reversal of {x.size} positions: {span_words(value, 'µm')}; {apart} of them differ from zero by more than their 95 % interval."
    return Chart(drawn, seen, {"position / mm": x, "reversal / µm": value, "95 % interval ± / µm": half})


def plot_position_scatter(drift: xr.Dataset, position: xr.DataArray, flagged: Set[int]) -> Chart:
    """Draw the random scatter of every position and approach with its 95 % limits; flagged positions are shaded."""
    x = position.values.astype(float)
    step = float(np.median(np.diff(np.sort(x)))) if x.size > 1 else 1.0
    drawn = new_figure(x="position / mm", y="scatter s / µm")
    for target in sorted(flagged):
        place = float(position.sel(target=target))
        shade(drawn, place - 0.4 * step, place + 0.4 * step, 0.12)
    courses, highest = Courses(drawn, {"position / mm": x}), 0.0
    for shift, direction in zip((-0.12, 0.12), drift["direction"].values, strict=False):
        row = drift.sel(direction=direction)
        value = row["scatter"].values
        low, high = scatter_limits(value, row["scatter_freedom"].values, float(drift["sigma"]))
        name, half = ARROWS[direction], np.stack([value - low, high - value])
        looks = {"line": False, "half": half, **of_direction(direction)}
        courses.add(x + shift * step, value, name, f"scatter, {name} / µm", f"95 % limits, {name} / µm", **looks)
        highest = np.fmax(highest, np.fmax.reduce(high))
    fix_range(drawn, 0.0, 1.06 * highest if highest else 1.0)
    places = join([f"{float(position.sel(target=target)):g} mm" for target in sorted(flagged)])
    seen = f"Random scatter of {x.size} positions: {span_words(drift['scatter'], 'µm')}; " + (
        f"marked as standing out: {places}." if flagged else "none is marked as standing out."
    )
    return Chart(drawn, seen, courses.columns)


# Chart of a test by ISO 230-2: means and ±2 s of both approaches over the targets, with A, E and B.


def plot_test(quoted: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the chart of the standard: mean deviation and ±2 s of each approach, with the spans of A and E and the place of B."""
    order = np.argsort(position.values, kind="stable")
    quoted, x = quoted.isel(target=order), position.values[order].astype(float)
    room = 0.24 * (np.ptp(x) or 1.0)
    left = x[0] - 0.04 * room
    unit, along = (print_unit(str(values.attrs.get("units", "um"))) for values in (quoted["A"], position))
    shown = (left, x[-1] + room)
    drawn = new_figure(x=f"position / {along}", y=f"deviation / {unit}", height=360, x_range=shown, zero=True)
    columns: dict[str, np.ndarray] = {"target": quoted["target"].values, f"position / {along}": x}
    for direction in quoted["direction"].values:
        row = quoted.sel(direction=direction)
        mean, s = row["mean_unidirectional"].values, row["standard_deviation"].values
        if not np.isfinite(mean).any():
            continue
        name = ARROWS[direction]
        add_band(drawn, x, mean - 2 * s, mean + 2 * s, COLOURS[direction])
        held = source({"x": x, "y": mean, "low": mean - 2 * s, "high": mean + 2 * s, "s": s})
        colour = COLOURS[direction]
        draw(drawn, "Line", x="x", y="y", columns=held, line_width=1.6, line_color=colour, named=name)
        heads = {f"{side}_head": Model("TeeHead", line_color=colour, size=8) for side in ("upper", "lower")}
        ends = {"base": field("x"), "upper": field("high"), "lower": field("low")}
        drawn.add(Model("Whisker", **ends, **heads, source=held, line_color=colour))
        points = draw(
            drawn, "Scatter", x="x", y="y", columns=held, named=name, marker=MARKERS[direction], size=7, line_color=colour,
            fill_color=colour,
        )  # fmt: skip
        tips = [("position", f"@x{{0.###}} {along}"), (f"mean {name}", f"@y{{0.00}} {unit}")]
        add_hover(drawn, [*tips, ("s", f"@s{{0.00}} {unit}")], [points])
        columns |= {f"mean, {name} / {unit}": mean, f"s, {name} / {unit}": s}
    if np.isfinite(quoted["mean_bidirectional"]).any():
        mean = quoted["mean_bidirectional"].values
        draw(drawn, "Line", x=x, y=mean, named="mean of both", line_color=INK, line_dash="dotted")
        _mark_reversal(drawn, quoted, x)
    _mark_spans(drawn, quoted, x[-1], room)
    return Chart(drawn, _seen(quoted, x, unit, along), columns)


def _mark_spans(drawn: Figure, quoted: xr.Dataset, end: float, room: float) -> None:
    """Draw the spans of A and E to the right of the data, where both approaches were measured, else those of the one approach."""
    mean, s = quoted["mean_unidirectional"].values, quoted["standard_deviation"].values
    # Labels are at two heights: at one height they would be written over each other.
    spans = (("A", mean - 2 * s, mean + 2 * s, 0.1, 0.3), ("E", mean, mean, 0.9, 0.6))
    for symbol, low, high, share, height in spans:
        if not np.isfinite(low).any():
            continue
        at, bottom, top = end + share * room, float(np.nanmin(low)), float(np.nanmax(high))
        draw(drawn, "Segment", x0=at, y0=bottom, x1=at, y1=top, line_color=INK, line_width=1.4)
        for level in (bottom, top):
            thin: dict[str, Any] = {"line_color": MUTED, "line_dash": "dashed", "line_width": 0.8}
            draw(drawn, "Segment", x0=end, y0=level, x1=at, y1=level, **thin)
        # That of the outer span stands on its left: what leaves the frame is cut in a narrow chart.
        looks: dict[str, Any] = {"offset": (-4, -8), "align": "right"} if symbol == "E" else {"offset": (4, -8)}
        add_label(drawn, at, bottom + height * (top - bottom), f"{symbol} {number(top - bottom)}", **looks)


def _mark_reversal(drawn: Figure, quoted: xr.Dataset, x: np.ndarray) -> None:
    """Draw the reversal error B at the target where it is largest."""
    reversal = quoted["reversal"].values
    k = int(np.nanargmax(np.abs(reversal)))
    ends, s = quoted["mean_unidirectional"].values[:, k], quoted["standard_deviation"].values[:, k]
    draw(drawn, "Segment", x0=x[k], y0=ends.min(), x1=x[k], y1=ends.max(), line_color=INK, line_width=3)
    top = float((ends + 2 * s).max())
    at, offset = (top, (-16, 6)) if np.isfinite(top) else (float(ends.mean()), (6, -8))
    add_label(drawn, float(x[k]), at, f"B {number(abs(reversal[k]))}", offset=offset)


def _seen(quoted: xr.Dataset, x: np.ndarray, unit: str, along: str) -> str:
    """Return the text alternative."""
    means = {
        direction: quoted["mean_unidirectional"].sel(direction=direction) for direction in quoted["direction"].values
    }
    rows = [f"{ARROWS[side]} {span_words(mean, unit)}" for side, mean in means.items() if np.isfinite(mean).any()]
    known = [symbol for symbol in "AEB" if np.isfinite(quoted[symbol])]
    values = ", ".join(f"{symbol} {number(float(quoted[symbol]))} {unit}" for symbol in known)
    told = f"Mean deviation over {span_words(x, along)} of the axis with ±2 s: {'; '.join(rows)}."
    return f"{told} {values}." if values else told


# Charts of the differences between neighbouring positions.


def _links(links: xr.DataArray, position: xr.DataArray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (mm) of the further and of the nearer target of every pair."""
    along = position["target"].values[np.argsort(position.values, kind="stable")].tolist()
    nearer = [along[along.index(int(target)) - 1] for target in links.values]
    return position.sel(target=links.values).values.astype(float), position.sel(target=nearer).values.astype(float)


def plot_scatter_comparison(comparison: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the standard deviation of the differences of neighbours and the conventional one of each position."""
    place, _ = _links(comparison["link"], position)
    drawn = new_figure(x="position / mm", y="standard deviation / µm", y_type="log")
    courses = Courses(drawn, {"position / mm": place})
    for name, text, dash in (("differenced", "differences", "solid"), ("conventional", "conventional", "dashed")):
        for direction in comparison["direction"].values:
            values, looks = comparison[name].sel(direction=direction).values, {"dash": dash, **of_direction(direction)}
            courses.add(place, values, f"{text}, {direction}", f"s of the {text}, {ARROWS[direction]} / µm", **looks)
    seen = (
        f"Standard deviation of {place.size} positions: of the differences {span_words(comparison['differenced'], 'µm')}, conventional "
        f"{span_words(comparison['conventional'], 'µm')}."
    )
    return Chart(drawn, seen, courses.columns)


def plot_mean_differences(neighbours: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the mean difference of neighbouring positions, nearer minus further, with its 95 % interval."""
    further, nearer = _links(neighbours["link"], position)
    middle, step = (further + nearer) / 2, float(np.median(further - nearer))
    drawn = new_figure(x="middle of the pair / mm", y="nearer − further position, mean / µm", zero=True)
    courses = Courses(drawn, {"nearer position / mm": nearer, "further position / mm": further})
    for shift, direction in zip((-0.1, 0.1), neighbours["direction"].values, strict=False):
        value, u = (neighbours[key].sel(direction=direction).values for key in ("mean_difference", "mean_difference_u"))
        name, looks = ARROWS[direction], {"line": False, "half": 2 * u, **of_direction(direction)}
        x, headings = middle + shift * step, (f"nearer − further, {name} / µm", f"95 % ±, {name} / µm")
        courses.add(x, value, name, *headings, **looks)
    seen = (
        f"Mean difference of {middle.size} pairs of neighbours, nearer minus further: {span_words(neighbours['mean_difference'], 'µm')}; "
        "below zero the deviation grows along the axis."
    )
    return Chart(drawn, seen, courses.columns)


def plot_reference_chart(chart: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the deviation chart from the reference value at the first position, with borders of twice the scatter of the differences."""
    order = np.argsort(position.sel(target=chart["target"]).values, kind="stable")
    chart = chart.isel(target=order)
    place = position.sel(target=chart["target"]).values.astype(float)
    drawn = new_figure(x="position / mm", y="deviation / µm", zero=True)
    columns: dict[str, np.ndarray] = {"position / mm": place}
    for direction in chart["direction"].values:
        value, border = (chart[name].sel(direction=direction).values for name in ("chart", "border_s"))
        name, looks = ARROWS[direction], dict[str, Any](line_color=COLOURS[direction], line_dash="dashed")
        add_series(drawn, place, value, name=name, **of_direction(direction))
        for sign in (-1, 1):
            draw(drawn, "Line", x=place, y=value + sign * border, named=f"±2 s, {direction}", **looks)
        columns |= {f"deviation, {name} / µm": value, f"border ±, {name} / µm": border}
    seen = f"Deviation from the reference at {place[0]:g} mm: {span_words(chart['chart'], 'µm')} over {place.size} positions."
    return Chart(drawn, seen, columns)


def plot_cycles(deviations: xr.Dataset, direction: str, *, quantity: str = "deviation") -> Chart:
    """Draw the readings of every cycle over position for one direction of approach; both directions have the same y range."""
    order = np.argsort(deviations["position"].values, kind="stable")
    every = deviations["deviation"].transpose("cycle", "direction", "target")
    lines = every.sel(direction=direction).values[:, order]
    place, cycles = deviations["position"].values[order].astype(float), deviations["cycle"].values
    drawn = new_figure(
        x="position / mm", y=f"{quantity} / µm", title=ARROWS[direction], y_range=shared_range(every.values), zero=True
    )
    add_ordered_lines(drawn, [place] * len(lines), list(lines), cycles, "cycle")
    mean = every.sel(direction=direction).mean("cycle").values[order]
    seen = (
        f"{quantity.capitalize()} of {len(lines)} cycles, {ARROWS[direction]}: {span_words(lines, 'µm')}; the mean over the cycles goes "
        f"from {number(float(mean[0]), 2)} µm at {place[0]:g} mm to {number(float(mean[-1]), 2)} µm at {place[-1]:g} mm."
    )
    columns = {"cycle": np.repeat(cycles, place.size), "position / mm": np.tile(place, len(lines))}
    return Chart(drawn, seen, {**columns, f"{quantity} / µm": lines.ravel()})


def plot_history(deviations: xr.Dataset, drift: xr.Dataset, target: int) -> Chart:
    """Draw the readings at one position over time with profile and drift as estimated and the 95 % band of the drift."""
    hours, place = hours_since_start(deviations), float(deviations["position"].sel(target=target))
    drawn = new_figure(x="time since first reading / h", y="deviation / µm", title=f"position {target} ({place:g} mm)")
    columns: dict[str, np.ndarray] = {"cycle": deviations["cycle"].values}
    for direction in deviations["direction"].values:
        chosen = {"direction": direction, "target": target}
        x, read = hours.sel(chosen).values, deviations["deviation"].sel(chosen).values
        line = read - drift["noise"].sel(chosen).values
        half = 2 * drift["drift_u"].sel(chosen).values
        add_band(drawn, x, line - half, line + half, COLOURS[direction])
        name = ARROWS[direction]
        add_series(drawn, x, line, name=f"estimate, {direction}", colour=COLOURS[direction])
        add_series(drawn, x, read, name=f"readings, {direction}", line=False, **of_direction(direction))
        columns |= {
            f"time, {name} / h": x,
            f"deviation, {name} / µm": read,
            f"profile and drift, {name} / µm": line,
            f"95 % band ±, {name} / µm": half,
        }
    every = deviations["deviation"].sel(target=target)
    seen = f"Readings at {place:g} mm over {every.sizes['cycle']} cycles: {span_words(every, 'µm')}, with the estimated drift through them."
    return Chart(drawn, seen, columns)


def has_windows(windows: xr.Dataset) -> bool:
    """Tell whether a test has several windows, with the values of both approaches that their chart shows."""
    return windows.sizes.get("window", 0) > 2 and bool(windows["A"].notnull().any())


def plot_windows(windows: xr.Dataset) -> Chart:
    """Draw accuracy A, repeatability R and reversal B of five-cycle windows along the test; dotted: all cycles as one window."""
    unit = print_unit(str(windows["A"].attrs.get("units", "um")))
    short, whole = windows.isel(window=slice(None, -1)), windows.isel(window=-1)
    drawn = new_figure(x="middle cycle of the window", y=f"A, R, B / {unit}")
    middle = short["middle_cycle"].values
    courses = Courses(drawn, {"middle cycle": middle})
    shown = (
        ("A", INK, "accuracy A", "circle"),
        ("R", ACCENT, "repeatability R", "square"),
        ("B", MUTED, "reversal B", "diamond"),
    )
    for shift, (name, colour, text, marker) in enumerate(shown):
        x, value = middle + 0.25 * (shift - 1), short[name].values
        looks: dict[str, Any] = {"colour": colour, "marker": marker, "half": 2 * short[f"{name}_u"].values}
        courses.add(x, value, text, f"{name} / {unit}", f"U({name}), k = 2 / {unit}", **looks)
        draw(drawn, "HSpan", y=float(whole[name]), line_color=colour, line_dash="dotted", line_width=1.5)
    top = max(float(np.nanmax(short[name] + 2 * short[f"{name}_u"])) for name in "ARB")
    fix_range(drawn, 0.0, 1.05 * max(top, float(whole["A"])))
    seen = (
        f"{middle.size} windows of five cycles: A {span_words(short['A'], unit)}, R {span_words(short['R'], unit)}, B "
        f"{span_words(short['B'], unit)}; all cycles as one window give A {number(float(whole['A']))} {unit} and "
        f"R {number(float(whole['R']))} {unit}."
    )
    return Chart(drawn, seen, courses.columns)


# What was recorded when, and the environment and the drivers on the same time axis.

_TIME = "time since first reading / h"
#: A recording has a gap where nothing comes for this many of its usual intervals.
_GAP = 1.8


def plot_timeline(fused: xr.Dataset) -> Chart:
    """Draw bars of what was recorded when, with gaps, and below them environment and drivers in their own units."""
    times = fused["time"]
    start = np.nanmin(times.values)
    recorded = {"readings": np.asarray(((times - start) / np.timedelta64(1, "h")).mean(["direction", "target"]), float)}
    for name, dim in (("frames", "frame_time"), ("environment log", "environment_time"), ("driver log", "driver_time")):
        if dim in fused.dims:
            recorded[name] = _hours(fused[dim].values, start)
    spans = {name: recorded_spans(hours) for name, hours in recorded.items()}
    bars = _plot_spans(spans)
    series = [str(name) for name in fused.data_vars if fused[name].dims in (("environment_time",), ("driver_time",))]
    below: list[Figure] = []
    for at, name in enumerate(series):
        below.append(_plot_series(fused[name], _hours(fused[fused[name].dims[0]].values, start), at, bars))
    for drawn in (bars, *below)[:-1]:
        drawn.xaxis.axis_label = None
    shown = column([bars, *below]) if below else bars
    gaps = [f"{name} {len(parts) - 1}" for name, parts in spans.items() if len(parts) > 1]
    units = {name: print_unit(str(fused[name].attrs.get("units", "1"))) for name in series}
    said = [f"{_words(fused[name])} {span_words(fused[name], unit)}" for name, unit in units.items()]
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
    """Return the spans without a gap of a recording: first and last time of each."""
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


def _plot_spans(spans: dict[str, list[tuple[float, float]]]) -> Figure:
    """Draw one bar for every span of every recording."""
    names = list(spans)
    every = [end for parts in spans.values() for part in parts for end in part]
    low, high = shared_range(np.array(every))
    drawn = new_figure(x=_TIME, y="", height=60 + 22 * len(names), y_range=names[::-1], x_range=(low, high))
    for at, name in enumerate(names):
        parts = spans[name]
        ends: dict[str, Any] = {"left": [part[0] for part in parts], "right": [part[1] for part in parts]}
        bar = draw(
            drawn,
            "HBar",
            y=[name] * len(parts),
            **ends,
            height=0.55,
            line_color=CATEGORIES[at],
            fill_color=CATEGORIES[at],
        )
        add_hover(drawn, [("", name), ("from", "@left{0.00} h"), ("to", "@right{0.00} h")], [bar])
    return drawn


def _plot_series(values: xr.DataArray, hours: np.ndarray, at: int, above: Figure) -> Figure:
    """Draw one logged quantity below the bars, on the same time axis."""
    unit = print_unit(str(values.attrs.get("units", "1")))
    words = _words(values)
    drawn = new_figure(x=_TIME, y=unit, title=words, height=118)
    drawn.x_range = above.x_range
    drawn.yaxis.ticker = Model("BasicTicker", desired_num_ticks=2)
    low, high = shared_range(values.values)
    fix_range(drawn, low, high)
    line = draw(drawn, "Line", x=hours, y=values.values, line_color=CATEGORIES[at % len(CATEGORIES)], line_width=1.7)
    add_hover(drawn, [("time", "@x{0.00} h"), (words, f"@y{{0.00}} {literal(unit)}")], [line])
    return drawn


def _words(series: xr.DataArray) -> str:
    """Return the name of a logged quantity: that of a driver as its file writes it."""
    name = str(series.name).removesuffix("_series")
    return name if series.dims == ("driver_time",) else name.replace("_", " ")
