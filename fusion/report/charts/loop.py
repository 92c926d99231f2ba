"""Charts of the closed loop: what the model misses over time, position, direction and period, and what each effect contributes."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts.style import (
    BEFORE,
    CATEGORIES,
    DASHES,
    Chart,
    add_hold_out,
    add_series,
    add_zero_line,
    fix_range,
    new_figure,
    span_words,
)
from fusion.report.wording import effect_words, number
from interferometry.figures import COLOURS, MUTED, hours_since_start

_TIME, _AFTER = "time since first reading / h", COLOURS["positive"]


def _stages(loop: xr.Dataset) -> list[tuple[str, str, str, str]]:
    """Return ending of the variables, colour, dash and name of what to draw: before and after, or one where nothing was added."""
    before, after = loop["residual_declared"], loop["residual_final"]
    if np.allclose(before, after, atol=1e-9, equal_nan=True):
        return [("final", _AFTER, "solid", "declared model, nothing added")]
    return [
        ("declared", BEFORE, "dashed", "declared model"),
        ("final", _AFTER, "solid", "with the added effects"),
    ]


def plot_held_out_positions(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw the error of predicting the held-out cycles at every position, both approaches together.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc, with ``held_out_error_declared`` and ``held_out_error_final``.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    order = np.argsort(deviations["position"].values, kind="stable")
    place = deviations["position"].values[order].astype(float)
    drawn = new_figure(x="position / mm", y="error of prediction, rms / µm")
    columns: dict[str, np.ndarray] = {"position / mm": place}
    parts = []
    for (ending, colour, dash, text), marker in zip(_stages(loop), ("square", "circle"), strict=False):
        error = np.sqrt((loop[f"held_out_error_{ending}"] ** 2).mean(["cycle", "direction"]).values[order])
        add_series(drawn, place, error, name=text, colour=colour, dash=dash, marker=marker)
        columns[f"{text} / µm"] = error
        parts.append(f"{text} {span_words(error, 'µm')}, largest at {place[int(np.nanargmax(error))]:g} mm")
    fix_range(drawn, 0.0, 1.08 * float(np.nanmax([columns[name] for name in list(columns)[1:]])))
    return Chart(drawn, f"Error of predicting the held-out cycles by position: {'; '.join(parts)}.", columns)


def plot_residual_direction(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw half the difference of the residuals of both approaches over time, before and after the loop.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    hours = hours_since_start(deviations).mean(["direction", "target"]).values
    drawn = new_figure(x=_TIME, y="(positive − negative) / 2 / µm")
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"cycle": loop["cycle"].values, _TIME: hours}
    parts = []
    for ending, colour, dash, text in _stages(loop):
        residual = loop[f"residual_{ending}"].mean("target")
        odd = ((residual.sel(direction="positive") - residual.sel(direction="negative")) / 2).values
        add_series(drawn, hours, odd, name=text, colour=colour, dash=dash)
        columns[f"{text} / µm"] = odd
        parts.append(f"{text} {span_words(odd, 'µm')}")
    return Chart(drawn, f"Residual that changes sign with the approach, over time: {'; '.join(parts)}.", columns)


def plot_residual_spectrum(loop: xr.Dataset) -> Chart:
    """Draw the power of the innovations over period, before and after the loop, with the limit that noise alone hardly exceeds.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.

    Returns
    -------
    Chart
    """
    drawn = new_figure(x="period / min", y="power over that of noise", x_type="log")
    columns: dict[str, np.ndarray] = {"period / min": loop["period"].values}
    highest, limit, parts = 0.0, float("nan"), []
    for ending, colour, dash, text in _stages(loop):
        power = loop[f"periodogram_{ending}"]
        limit = float(power.attrs["limit"])
        add_series(drawn, power["period"].values, power.values, name=text, colour=colour, dash=dash)
        columns[f"{text}, power over that of noise"] = power.values
        at = int(np.nanargmax(power.values))
        parts.append(f"{text} {number(float(power[at]), 2)} at {number(float(power['period'][at]), 2)} min")
        highest = max(highest, float(power[at]))
    drawn.hspan(limit, line_color=MUTED, line_dash="dashed", line_width=1.5, legend_label="95 % limit of noise")
    fix_range(drawn, 0.0, 1.08 * max(highest, limit))
    seen = f"Power of the innovations over period; strongest: {'; '.join(parts)}; noise alone stays below {number(limit, 2)}."
    return Chart(drawn, seen, columns)


def plot_residual_events(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw the cumulative sum of the innovations: without trend where nothing happens, with a kink at an event.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    hours = hours_since_start(deviations).transpose("cycle", "direction", "target").values.ravel()
    drawn = new_figure(x=_TIME, y="sum of innovations / √n")
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {}
    parts = []
    for ending, colour, dash, text in _stages(loop):
        values = loop[f"innovation_{ending}"].transpose("cycle", "direction", "target").values.ravel()
        valid = np.flatnonzero(np.isfinite(values) & np.isfinite(hours))
        order = valid[np.argsort(hours[valid], kind="stable")]
        walk = np.cumsum(values[order]) / np.sqrt(order.size)
        add_series(drawn, hours[order], walk, name=text, colour=colour, dash=dash)
        columns = {_TIME: hours[order], **columns, f"{text}, sum of innovations / √n": walk}
        parts.append(f"{text} {span_words(walk, '').strip()}")
    return Chart(drawn, f"Running sum of the innovations over time: {'; '.join(parts)}.", columns)


def plot_contributions(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw what each effect of the final model contributes over time at the far end of the axis, positive approach.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    far = int(deviations["target"][int(np.argmax(np.abs(deviations["position"].values)))])
    place = float(deviations["position"].sel(target=far))
    hours = hours_since_start(deviations).sel(target=far, direction="positive").values
    drawn = new_figure(x=_TIME, y="contribution / µm", title=f"at {place:g} mm, positive approach", legend_columns=1)
    add_zero_line(drawn)
    columns: dict[str, np.ndarray] = {"cycle": loop["cycle"].values, _TIME: hours}
    parts = []
    for at, effect in enumerate(str(name) for name in loop["effect"].values):
        line = loop["contribution"].sel(effect=effect, target=far, direction="positive").values
        words = effect_words(effect).name
        add_series(
            drawn, hours, line, name=words, colour=CATEGORIES[at % len(CATEGORIES)], dash=DASHES[at % len(DASHES)]
        )
        columns[f"{words} / µm"] = line
        parts.append(f"{words} {span_words(line, 'µm')}")
    return Chart(drawn, f"Contributions at {place:g} mm over time: {'; '.join(parts)}.", columns)


def plot_held_out_errors(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw what each prediction missed in the cycles that took no part in any choice: dots for readings, lines for means of a cycle.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc, with ``held_out_error_declared``, ``..._final`` and ``..._last_value``.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart

    Notes
    -----
    Open loop: nothing of these cycles was used. The root mean squares of the dots are the errors that the report quotes. The raw
    drift, mean over positions and approaches about its mean before the hold-out, stands beside them.
    """
    hours = hours_since_start(deviations)
    middle = hours.mean(["direction", "target"]).values
    held = loop["held_out_error_final"].notnull().any(["direction", "target"]).values
    raw = deviations["deviation"] - deviations["deviation"].isel(cycle=~held).mean("cycle")
    first, last = (float(end(hours.values[held])) for end in (np.nanmin, np.nanmax))
    drawn = new_figure(
        x=_TIME, y="measured − predicted / µm", height=360, x_range=(max(0.0, 2 * first - last), last + 0.02)
    )
    add_zero_line(drawn)
    add_hold_out(drawn, first, last)
    columns: dict[str, np.ndarray] = {"cycle": loop["cycle"].values, _TIME: middle}
    series = [
        (raw, "drift as measured", CATEGORIES[3], "dotted"),
        (loop["held_out_error_last_value"], "last value repeated", CATEGORIES[2], "dotdash"),
        (loop["held_out_error_declared"], "declared model", BEFORE, "dashed"),
    ]
    if len(_stages(loop)) > 1:
        series.append((loop["held_out_error_final"], "with the added effects", _AFTER, "solid"))
    parts = []
    for values, text, colour, dash in series:
        mean = values.mean(["direction", "target"]).values
        add_series(drawn, middle, mean, name=text, colour=colour, dash=dash, width=2.2)
        columns[f"{text}, mean of the cycle / µm"] = mean
        if values is raw:
            continue
        drawn.scatter(
            hours.values.ravel(), values.values.ravel(), size=2.5, color=colour, alpha=0.45, legend_label=text
        )
        parts.append(f"{text} {number(float(np.sqrt(np.nanmean(values.values**2))))} µm rms")
    seen = (
        f"Errors of predicting the {int(held.sum())} cycles that were held out: {'; '.join(parts)}; the drift as measured moves over "
        f"{span_words(columns['drift as measured, mean of the cycle / µm'], 'µm')}."
    )
    return Chart(drawn, seen, columns)


def plot_predicted_measured(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw predicted against measured deviations of the cycles that were held out, with the line on which both are equal.

    Parameters
    ----------
    loop : Dataset
        Group ``loop`` of fusion.nc, with ``held_out_error_declared`` and ``held_out_error_final``.
    deviations : Dataset
        Content of deviations.nc.

    Returns
    -------
    Chart
    """
    measured = deviations["deviation"]
    drawn = new_figure(x="measured deviation / µm", y="predicted deviation / µm", height=360)
    columns: dict[str, np.ndarray] = {}
    parts = []
    for (ending, colour, _, text), marker in zip(_stages(loop), ("x", "circle"), strict=False):
        error = loop[f"held_out_error_{ending}"]
        here = error.notnull().values & measured.notnull().values
        read, predicted = measured.values[here], (measured - error).values[here]
        add_series(drawn, read, predicted, name=text, colour=colour, line=False, marker=marker, size=4.5)
        columns |= {"measured deviation / µm": read, f"predicted, {text} / µm": predicted}
        parts.append(f"{text} {number(float(np.sqrt(np.mean((read - predicted) ** 2))))} µm rms from the line")
    ends = [float(np.min(columns["measured deviation / µm"])), float(np.max(columns["measured deviation / µm"]))]
    drawn.line(ends, ends, line_color=MUTED, line_dash="dashed", legend_label="predicted = measured")
    return Chart(drawn, f"Predicted against measured deviation of the held-out cycles: {'; '.join(parts)}.", columns)
