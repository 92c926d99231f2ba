"""Charts of the joint estimate: drift of every position over time, drift-free profile."""

from __future__ import annotations

from collections.abc import Set

import numpy as np
import xarray as xr
from bokeh.models import BoxAnnotation, Label, LinearColorMapper
from bokeh.plotting import figure

from fusion.report.charts.style import (
    DIVERGING,
    MARKERS,
    Chart,
    add_band,
    add_colour_bar,
    add_hover,
    add_ordered_lines,
    add_series,
    add_zero_line,
    fix_range,
    new_figure,
    ordered_colours,
    palette,
    shared_range,
    span_words,
)
from fusion.report.wording import join, number
from interferometry.figures import ACCENT, ARROWS, COLOURS, INK, hours_since_start


def plot_drift(drift: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw the drift of every position over time, mean of both approaches; the ends of the axis are named and have their 95 % band.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    hours = hours_since_start(deviations).mean("direction").transpose("cycle", "target").values
    lines = drift["drift"].mean("direction").transpose("cycle", "target").values
    band = 2 * drift["drift_u"].mean("direction").transpose("cycle", "target").values
    position = deviations["position"].values
    order = np.argsort(position, kind="stable")
    colours = ordered_colours(position.size)
    drawn = new_figure(x="time since first reading / h", y="drift / µm", height=360, x_range=_with_room(hours))
    add_zero_line(drawn)
    for rank in (0, position.size - 1):
        place = order[rank]
        add_band(
            drawn, hours[:, place], lines[:, place] - band[:, place], lines[:, place] + band[:, place], colours[rank]
        )
    add_ordered_lines(
        drawn,
        [hours[:, place] for place in order],
        [lines[:, place] for place in order],
        position[order],
        "position / mm",
    )
    for rank, place in ((0, order[0]), (position.size - 1, order[-1])):
        _name_end(drawn, hours[:, place], lines[:, place], f"{position[place]:g} mm", colours[rank])
    courses = [line[np.isfinite(line)] for line in lines.T]
    change = np.mean([course[-1] - course[0] for course in courses if course.size])
    far = np.argmax([np.abs(course).max(initial=-1.0) for course in courses])
    seen = (
        f"Drift of {position.size} positions over {number(float(np.nanmax(hours)), 2)} h: {span_words(lines, 'µm')}; from the first to the "
        f"last cycle it changes by {number(float(change), 2)} µm on average, and the largest drift is at {position[far]:g} mm."
    )
    cycles = np.repeat(drift["cycle"].values, position.size)
    return Chart(
        drawn,
        seen,
        {
            "cycle": cycles,
            "position / mm": np.tile(position, len(lines)),
            "time since first reading / h": hours.ravel(),
            "drift / µm": lines.ravel(),
            "95 % band ± / µm": band.ravel(),
        },
    )


def _with_room(hours: np.ndarray) -> tuple[float, float]:
    """Return the range of the times, with room for names at the right."""
    first, last = float(np.nanmin(hours)), float(np.nanmax(hours))
    return first - 0.02 * (last - first), last + 0.18 * (last - first)


def _name_end(drawn: figure, x: np.ndarray, y: np.ndarray, text: str, colour: str) -> None:
    """Write a name at the last point of a line."""
    valid = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if valid.size:
        drawn.add_layout(
            Label(
                x=float(x[valid[-1]]), y=float(y[valid[-1]]), text=text, text_color=colour, text_font_size="11px", x_offset=4,
                y_offset=-6,
            )
        )  # fmt: skip


def plot_profile(drift: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the drift-free profile of both approaches with its 95 % band.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    drawn = new_figure(x="position / mm", y="deviation / µm")
    add_zero_line(drawn)
    order = np.argsort(position.values, kind="stable")
    drift, x = drift.isel(target=order), position.values[order].astype(float)
    columns: dict[str, np.ndarray] = {"position / mm": x}
    for direction in drift["direction"].values:
        row = drift.sel(direction=direction)
        value, half = row["profile"].values, 2 * row["profile_u"].values
        add_band(drawn, x, value - half, value + half, COLOURS[direction])
        add_series(
            drawn, x, value, name=ARROWS[direction], colour=COLOURS[direction], marker=MARKERS[direction], half=half
        )
        columns[f"profile, {ARROWS[direction]} / µm"] = value
        columns[f"95 % band ±, {ARROWS[direction]} / µm"] = half
    rows = "; ".join(
        f"{ARROWS[direction]} {span_words(drift['profile'].sel(direction=direction), 'µm')}"
        for direction in drift["direction"].values
    )
    seen = f"Drift-free deviation over {span_words(x, 'mm')} of the axis: {rows}."
    return Chart(drawn, seen, columns)


def plot_reversal(drift: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the reversal (positive minus negative approach) of every position with its 95 % interval.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    drawn = new_figure(x="position / mm", y="positive − negative / µm")
    add_zero_line(drawn)
    x, value, half = position.values.astype(float), drift["reversal"].values, 2 * drift["reversal_u"].values
    add_series(drawn, x, value, name="reversal", colour=INK, line=False, marker="circle", half=half, legend=False)
    apart = int((np.abs(value) > half).sum())
    seen = f"Reversal of {x.size} positions: {span_words(value, 'µm')}; {apart} of them differ from zero by more than their 95 % interval."
    return Chart(drawn, seen, {"position / mm": x, "reversal / µm": value, "95 % interval ± / µm": half})


def plot_position_scatter(drift: xr.Dataset, position: xr.DataArray, flagged: Set[int]) -> Chart:
    """Draw the random scatter of every position and approach with its 95 % interval; flagged positions are shaded.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.
    flagged : set of int
        Targets that stand out.

    Returns
    -------
    Chart
    """
    x = position.values.astype(float)
    step = float(np.median(np.diff(np.sort(x)))) if x.size > 1 else 1.0
    drawn = new_figure(x="position / mm", y="scatter s / µm")
    for target in sorted(flagged):
        place = float(position.sel(target=target))
        drawn.add_layout(
            BoxAnnotation(
                left=place - 0.4 * step, right=place + 0.4 * step, fill_color=ACCENT, fill_alpha=0.12, level="underlay"
            )
        )
    columns: dict[str, np.ndarray] = {"position / mm": x}
    for shift, direction in zip((-0.12, 0.12), drift["direction"].values, strict=False):
        value, half = (drift[name].sel(direction=direction).values for name in ("scatter", "scatter_u"))
        add_series(
            drawn, x + shift * step, value, name=ARROWS[direction], colour=COLOURS[direction], line=False,
            marker=MARKERS[direction], half=2 * half,
        )  # fmt: skip
        columns[f"scatter, {ARROWS[direction]} / µm"] = value
        columns[f"95 % interval ±, {ARROWS[direction]} / µm"] = 2 * half
    highest = float((drift["scatter"] + 2 * drift["scatter_u"]).max())
    fix_range(drawn, 0.0, 1.06 * highest if np.isfinite(highest) else 1.0)
    places = join([f"{float(position.sel(target=target)):g} mm" for target in sorted(flagged)])
    seen = f"Random scatter of {x.size} positions: {span_words(drift['scatter'], 'µm')}; " + (
        f"marked as standing out: {places}." if flagged else "none is marked as standing out."
    )
    return Chart(drawn, seen, columns)


def plot_drift_map(drift: xr.Dataset, position: xr.DataArray) -> Chart:
    """Draw the drift as colours over cycle and position, mean of both approaches.

    Parameters
    ----------
    drift : Dataset
        Group ``drift`` of deviations.nc.
    position : (target,) DataArray
        Target positions, mm.

    Returns
    -------
    Chart
    """
    return cycle_map(drift["drift"].mean("direction"), position, "drift / µm")


def plot_deviation_map(deviations: xr.Dataset) -> Chart:
    """Draw the readings as colours over cycle and position, mean of both approaches, each position about its mean over the cycles.

    Parameters
    ----------
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    read = deviations["deviation"].mean("direction")
    return cycle_map(read - read.mean("cycle"), deviations["position"], "deviation from the mean of the position / µm")


def cycle_map(values: xr.DataArray, position: xr.DataArray, label: str) -> Chart:
    """Draw values as colours over cycle and position; a value that is missing is left blank.

    Parameters
    ----------
    values : (cycle, target) DataArray
        Signed, in the unit of `label`.
    position : (target,) DataArray
        Target positions, mm.
    label : str
        "quantity / unit".

    Returns
    -------
    Chart
    """
    order = np.argsort(position.values, kind="stable")
    field = values.transpose("cycle", "target").values[:, order]
    cycle, place = values["cycle"].values.astype(float), position.values[order].astype(float)
    quantity, _, unit = label.rpartition(" / ")
    low, high = shared_range(field, symmetrical=True)
    mapper = LinearColorMapper(palette(DIVERGING), low=low, high=high, nan_color="#ffffff")
    (left, right), (bottom, top) = edges(cycle), edges(place)
    drawn = new_figure(
        x="cycle", y="position / mm", height=300, x_range=(left[0], right[-1]), y_range=(bottom[0], top[-1])
    )
    drawn.grid.grid_line_color = None
    across, along = field.shape
    cells = drawn.quad(
        left="left", right="right", bottom="bottom", top="top", line_color=None,
        fill_color={"field": "value", "transform": mapper},
        source={
            "left": np.repeat(left, along), "right": np.repeat(right, along), "bottom": np.tile(bottom, across),
            "top": np.tile(top, across), "value": field.ravel(), "cycle": np.repeat(cycle, along), "place": np.tile(place, across),
        },
    )  # fmt: skip
    tips = [("cycle", "@cycle{0}"), ("position", "@place{0.[000]} mm"), (quantity, f"@value{{0.00}} {unit}")]
    add_hover(drawn, tips, [cells])
    add_colour_bar(drawn, mapper, label)
    largest = np.unravel_index(np.nanargmax(np.abs(field)), field.shape)
    seen = (
        f"{quantity.capitalize()} of {across} cycles at {along} positions: {span_words(field, unit)}; the largest size is in cycle "
        f"{cycle[largest[0]]:.0f} at {place[largest[1]]:g} mm."
    )
    columns = {
        "cycle": np.repeat(cycle, along).astype(int),
        "position / mm": np.tile(place, across),
        label: field.ravel(),
    }
    return Chart(drawn, seen, columns)


def edges(middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the cells about points along an axis: half-way to the neighbours.

    Parameters
    ----------
    middle : (n,) ndarray
        Rising.

    Returns
    -------
    low, high : (n,) ndarray
    """
    if middle.size < 2:
        return middle - 0.5, middle + 0.5
    between = (middle[1:] + middle[:-1]) / 2
    first, last = 2 * middle[0] - between[0], 2 * middle[-1] - between[-1]
    return np.concatenate([[first], between]), np.concatenate([between, [last]])
