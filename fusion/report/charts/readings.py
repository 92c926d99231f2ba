"""Charts of the readings: every cycle over position, one position over time, ISO 230-2 windows along the test."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.style import (
    MARKERS,
    Chart,
    add_band,
    add_ordered_lines,
    add_series,
    add_zero_line,
    fix_range,
    new_figure,
    shared_range,
    span_words,
)
from fusion.report.wording import number
from interferometry.figures import ACCENT, ARROWS, COLOURS, INK, MUTED, hours_since_start


def plot_cycles(deviations: xr.Dataset, direction: str, *, quantity: str = "deviation") -> Chart:
    """Draw the readings of every cycle over position for one direction of approach; both directions have the same y range.

    Parameters
    ----------
    deviations : Dataset
        ``deviation`` (um; cycle, direction, target) and ``position`` (mm; target).
    direction : {"positive", "negative"}
        Direction of approach.
    quantity : str
        What the y axis shows.

    Returns
    -------
    Chart
    """
    order = np.argsort(deviations["position"].values, kind="stable")
    every = deviations["deviation"].transpose("cycle", "direction", "target")
    lines = every.sel(direction=direction).values[:, order]
    place, cycles = deviations["position"].values[order].astype(float), deviations["cycle"].values
    drawn = new_figure(
        x="position / mm", y=f"{quantity} / µm", title=ARROWS[direction], y_range=shared_range(every.values)
    )
    add_ordered_lines(drawn, [place] * len(lines), list(lines), cycles, "cycle")
    add_zero_line(drawn)
    mean = every.sel(direction=direction).mean("cycle").values[order]
    seen = (
        f"{quantity.capitalize()} of {len(lines)} cycles, {ARROWS[direction]}: {span_words(lines, 'µm')}; the mean over the cycles goes "
        f"from {number(float(mean[0]), 2)} µm at {place[0]:g} mm to {number(float(mean[-1]), 2)} µm at {place[-1]:g} mm."
    )
    columns = {
        "cycle": np.repeat(cycles, place.size),
        "position / mm": np.tile(place, len(lines)),
        f"{quantity} / µm": lines.ravel(),
    }
    return Chart(drawn, seen, columns)


def plot_history(deviations: xr.Dataset, drift: xr.Dataset, target: int) -> Chart:
    """Draw the readings at one position over time with profile and drift as estimated and the 95 % band of the drift.

    Parameters
    ----------
    deviations : Dataset
        Content of deviations.nc.
    drift : Dataset
        Its group ``drift``.
    target : int
        Number of the position.

    Returns
    -------
    Chart
    """
    hours, place = hours_since_start(deviations), float(deviations["position"].sel(target=target))
    drawn = new_figure(x="time since first reading / h", y="deviation / µm", title=f"position {target} ({place:g} mm)")
    columns: dict[str, np.ndarray] = {"cycle": deviations["cycle"].values}
    for direction in deviations["direction"].values:
        chosen = {"direction": direction, "target": target}
        x, read = hours.sel(chosen).values, deviations["deviation"].sel(chosen).values
        line = read - drift["noise"].sel(chosen).values
        half = 2 * drift["drift_u"].sel(chosen).values
        add_band(drawn, x, line - half, line + half, COLOURS[direction])
        name, colour = ARROWS[direction], COLOURS[direction]
        add_series(drawn, x, line, name=f"estimate, {direction}", colour=colour)
        add_series(drawn, x, read, name=f"readings, {direction}", colour=colour, line=False, marker=MARKERS[direction])
        columns |= {
            f"time, {name} / h": x,
            f"deviation, {name} / µm": read,
            f"profile and drift, {name} / µm": line,
            f"95 % band ±, {name} / µm": half,
        }
    every = deviations["deviation"].sel(target=target)
    seen = f"Readings at {place:g} mm over {every.sizes['cycle']} cycles: {span_words(every, 'µm')}, with the estimated drift through them."
    return Chart(drawn, seen, columns)


def plot_windows(windows: xr.Dataset) -> Chart:
    """Draw accuracy A, repeatability R and reversal B of five-cycle windows along the test; dotted: all cycles as one window.

    Parameters
    ----------
    windows : Dataset
        Group ``iso`` of deviations.nc: one entry per window, the last one the whole test.

    Returns
    -------
    Chart
    """
    short, whole = windows.isel(window=slice(None, -1)), windows.isel(window=-1)
    drawn = new_figure(x="middle cycle of the window", y="A, R, B / µm")
    middle = short["middle_cycle"].values
    columns: dict[str, np.ndarray] = {"middle cycle": middle}
    for shift, (name, colour, text, marker) in enumerate(
        (
            ("A", INK, "accuracy A", "circle"),
            ("R", ACCENT, "repeatability R", "square"),
            ("B", MUTED, "reversal B", "diamond"),
        )
    ):
        value, half = short[name].values, 2 * short[f"{name}_u"].values
        add_series(drawn, middle + 0.25 * (shift - 1), value, name=text, colour=colour, marker=marker, half=half)
        drawn.hspan(float(whole[name]), line_color=colour, line_dash="dotted", line_width=1.5)
        columns |= {f"{name} / µm": value, f"U({name}), k = 2 / µm": half}
    top = max(float(np.nanmax(short[name] + 2 * short[f"{name}_u"])) for name in "ARB")
    fix_range(drawn, 0.0, 1.05 * max(top, float(whole["A"])))
    seen = (
        f"{middle.size} windows of five cycles: A {span_words(short['A'], 'µm')}, R {span_words(short['R'], 'µm')}, B "
        f"{span_words(short['B'], 'µm')}; all cycles as one window give A {number(float(whole['A']))} µm and "
        f"R {number(float(whole['R']))} µm."
    )
    return Chart(drawn, seen, columns)
