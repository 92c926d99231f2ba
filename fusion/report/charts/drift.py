"""Charts of the joint estimate: drift of every position over time, drift-free profile."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.models import Label, LinearColorMapper
from bokeh.plotting import figure

from fusion.report.charts.style import (
    MARKERS,
    Chart,
    add_band,
    add_colour_bar,
    add_hover,
    add_zero_line,
    new_figure,
    ordered_colours,
    span_words,
)
from fusion.report.wording import number
from interferometry.figures import ARROWS, COLOURS, hours_since_start


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
    renderer = drawn.multi_line(
        xs="hours", ys="drift", line_color="colour", line_width=1.6, hover_line_width=3.5,
        source={
            "hours": [hours[:, place] for place in order],
            "drift": [lines[:, place] for place in order],
            "colour": colours,
            "position": position[order],
        },
    )  # fmt: skip
    add_hover(
        drawn, [("position", "@position{0.###} mm"), ("time", "$x{0.00} h"), ("drift", "$y{0.00} µm")], [renderer]
    )
    for rank, place in ((0, order[0]), (position.size - 1, order[-1])):
        _name_end(drawn, hours[:, place], lines[:, place], f"{position[place]:g} mm", colours[rank])
    mapper = LinearColorMapper(ordered_colours(256), low=float(position.min()), high=float(position.max()))
    add_colour_bar(drawn, mapper, "position / mm", place="below")
    change = np.nanmean(lines[-1] - lines[0])
    far = np.nanargmax(np.nanmax(np.abs(lines), axis=0))
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
    return first - 0.02 * (last - first), last + 0.12 * (last - first)


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
        source = {"x": x, "y": value, "half": half, "target": row["target"].values}
        style = {"color": COLOURS[direction], "legend_label": ARROWS[direction]}
        drawn.line("x", "y", source=source, line_width=1.6, **style)
        points = drawn.scatter("x", "y", source=source, marker=MARKERS[direction], size=7, **style)
        add_hover(drawn, [("position", "@x{0.###} mm"), (ARROWS[direction], "@y{0.00} ± @half{0.00} µm")], [points])
        columns[f"profile, {ARROWS[direction]} / µm"] = value
        columns[f"95 % band ±, {ARROWS[direction]} / µm"] = half
    rows = "; ".join(
        f"{ARROWS[direction]} {span_words(drift['profile'].sel(direction=direction), 'µm')}"
        for direction in drift["direction"].values
    )
    seen = f"Drift-free deviation over {span_words(x, 'mm')} of the axis: {rows}."
    return Chart(drawn, seen, columns)
