"""Charts of the closed loop and of a record: what the model misses in the held-out cycles, and what each effect contributes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.common import own_name
from fusion.report.campaign import DRAWN, shown_channels
from fusion.report.charts.embedded import Figure, source
from fusion.report.charts.plan import Extent, add_cells, add_marks, extent_of, new_plan
from fusion.report.charts.style import (
    BEFORE,
    CATEGORIES,
    DIVERGING,
    Chart,
    Courses,
    add_band,
    add_colour_bar,
    add_hold_out,
    add_hover,
    add_series,
    column,
    draw,
    fix_range,
    fixed_ticks,
    mapper,
    new_figure,
    of_direction,
    of_rank,
    palette,
    shared_range,
    span_words,
)
from fusion.report.wording import CHANNELS, effect_words, region_words
from fusion.results.numbers import alike, duration, join, number, p_cell, p_words, print_unit
from fusion.results.parts import ThermalTest
from interferometry.plots import COLOURS, INK, hours_since_start

# Maps and charts of the correlation: sensitivity and significance of cells, thermal modes, regions by target.

#: Upper ends of the steps in which a p-value is shown, their colours, and their names; above the last one a cell is left blank.
_P_STEPS = (0.01, 0.05, 0.1)
#: Largest p-value that a map shows.
LEAST_SHOWN = _P_STEPS[-1]
_P_COLOURS = ("#3b0f70", "#b63679", "#fbb18b")
_P_NAMES = {0.5: "≤ 0.01", 1.5: "≤ 0.05", 2.5: "≤ 0.1"}


def _add_blank(drawn: Figure, extent: Extent, name: str) -> None:
    """Hatch the plan, which shows wherever no cell is coloured."""
    left, right, bottom, top = extent
    draw(
        drawn, "Quad", left=left, right=right, bottom=bottom, top=top, fill_color="#ffffff", line_color=None,
        hatch_pattern="right_diagonal_line", hatch_color="#9aa7ad", hatch_scale=7, hatch_weight=0.6, level="image", named=name,
    )  # fmt: skip


def _cell_columns(maps: xr.Dataset, **layers: np.ndarray) -> dict[str, np.ndarray]:
    """Return the cells of the plan with values, one row each."""
    x, y = np.meshgrid(maps["x"].values, maps["y"].values)
    return {"x / mm": x.ravel(), "y / mm": y.ravel(), **{name: values.ravel() for name, values in layers.items()}}


def plot_sensitivity(maps: xr.Dataset, channel: str) -> Chart:
    """Draw the sensitivity of one part of the drift to every cell; cells whose family-wise p is above 0.05 are hatched."""
    chosen, extent = maps.sel(channel=channel), extent_of(maps)
    values, p = chosen["sensitivity"].values, chosen["p_value"].fillna(1.0).values
    passed = p <= ATTRIBUTION_LEVEL
    limit = float(np.nanmax(np.abs(values[passed]))) if passed.any() else 1.0
    colours = mapper(palette(DIVERGING), -limit, limit, nan_color="rgba(0, 0, 0, 0)")
    drawn = new_plan(extent, title=CHANNELS.get(channel, channel))
    _add_blank(drawn, extent, "not significant (p > 0.05)")
    tips = [("sensitivity", "@own{0.00} µm/K"), ("family-wise p", "@p{0.000}")]
    add_cells(drawn, np.where(passed, values, np.nan), extent, colours, tips, own=values, p=p)
    add_colour_bar(drawn, colours, "sensitivity / (µm/K)")
    return Chart(
        drawn,
        _where(maps, passed, p, f"sensitivity {span_words(values[passed], 'µm/K')}" if passed.any() else ""),
        _cell_columns(maps, **{"sensitivity / (µm/K)": values, "family-wise p": p}),
    )


def plot_significance(maps: xr.Dataset, channel: str) -> Chart:
    """Draw the family-wise p-value of every cell in steps; cells above 0.1 are hatched."""
    extent, p = extent_of(maps), maps["p_value"].sel(channel=channel).fillna(1.0).values
    step = np.digitize(p, _P_STEPS, right=True).astype(float)
    colours = mapper(_P_COLOURS, 0.0, float(len(_P_STEPS)), nan_color="rgba(0, 0, 0, 0)")
    drawn = new_plan(extent, title=CHANNELS.get(channel, channel))
    _add_blank(drawn, extent, "p > 0.1")
    blank = step == len(_P_STEPS)
    add_cells(drawn, np.where(blank, np.nan, step + 0.5), extent, colours, [("family-wise p", "@p{0.000}")], p=p)
    # Names instead of numbers.
    add_colour_bar(drawn, colours, "family-wise p").update(
        ticker=fixed_ticks([*_P_NAMES]), major_label_overrides=_P_NAMES
    )
    return Chart(drawn, _where(maps, p <= ATTRIBUTION_LEVEL, p, ""), _cell_columns(maps, **{"family-wise p": p}))


def _where(maps: xr.Dataset, passed: np.ndarray, p: np.ndarray, more: str) -> str:
    """Say how many cells are significant and where the strongest is."""
    row, column = np.unravel_index(np.argmin(p), p.shape)
    place = f"x {float(maps['x'][column]):.0f} mm, y {float(maps['y'][row]):.0f} mm (p {p_cell(float(p.min()))})"
    if not passed.any():
        return f"No cell of {p.size} is significant at 0.05; the closest is at {place}."
    return f"{int(passed.sum())} of {p.size} cells are significant at 0.05{', ' + more if more else ''}; the strongest is at {place}."


def plot_mode(modes: xr.Dataset, mode: int, channel: str, least_p: float | None = None) -> Chart:
    """Draw the pattern of a thermal mode, relative to the cell marked by a cross, with its p-value and lag in one part of the drift."""
    one, extent = modes.sel(mode=mode), extent_of(modes)
    p, lag = (float(one[name].sel(channel=channel)) for name in ("p_value", "lag"))
    significant = p <= ATTRIBUTION_LEVEL
    title = f"mode {mode}: {'significant, ' if significant else ''}p {p_cell(p, least_p)}, lag {duration(lag)}"
    drawn = new_plan(extent, title=title)
    colours = mapper(palette("PuOr_r"), -1.0, 1.0, nan_color="#e1e5e7")
    pattern = one["pattern"].values
    add_cells(drawn, pattern, extent, colours, [("warming relative to the cross", "@image{0.00}")])
    x, y = float(one["at_x"]), float(one["at_y"])
    add_marks(drawn, [x], [y], "cross", 14)
    add_colour_bar(drawn, colours, "warming relative to the cross")
    seen = (
        f"Thermal mode {mode}, strongest at x {x:.0f} mm, y {y:.0f} mm; it {'correlates' if significant else 'does not correlate'} with "
        f"the {CHANNELS.get(channel, channel)} ({p_words(p, least_p)})."
    )
    return Chart(drawn, seen, _cell_columns(modes, **{"warming relative to the cross": pattern}))


def plot_region_targets(targets: xr.Dataset, region: str, position: xr.DataArray) -> Chart:
    """Draw the sensitivity of every target and direction to one region, tested singly, with 95 % interval for all; filled: p <= 0.05."""
    chosen = targets.sel(region=region)
    step = float(np.median(np.diff(np.sort(position.values)))) if position.size > 1 else 1.0
    drawn = new_figure(x="position / mm", y="sensitivity / (µm/K)", title=region_words(region), zero=True)
    place = position.sel(target=chosen["series_target"].values).values.astype(float)
    value = chosen["sensitivity"].values
    # Series that an older program tested have no interval.
    half = chosen.get("sensitivity_half_width", xr.full_like(chosen["sensitivity"], np.nan)).values
    side, passed = chosen["series_direction"].values, chosen["p_value"].values <= ATTRIBUTION_LEVEL
    for shift, direction in ((-0.1, "positive"), (0.1, "negative")):
        for rows, words in ((passed, "p ≤ 0.05"), (~passed, "p > 0.05")):
            here = rows & (side == direction)
            if not here.any():
                continue
            name, looks = f"{direction}, {words}", of_direction(direction)
            add_series(drawn, place[here] + shift * step, value[here], name=name, line=False, half=half[here], **looks)
            if words == "p > 0.05":
                drawn.renderers[-1].glyph.fill_color = "#ffffff"
    seen = (
        f"Sensitivity of {value.size} series to {region_words(region)}: {span_words(value, 'µm/K')}; {int(passed.sum())} of them are "
        "significant by themselves."
    )
    columns = {
        "position / mm": place, "approach": side, "sensitivity / (µm/K)": value, "95 % interval ± / (µm/K)": half,
        "family-wise p": chosen["p_value"].values,
    }  # fmt: skip
    return Chart(drawn, seen, columns)


_TIME = "time since first reading / h"


_DECLARED: dict[str, Any] = {"colour": BEFORE, "dash": "dashed"}
_FINAL: dict[str, Any] = {"colour": COLOURS["positive"], "dash": "solid"}


def _stages(loop: xr.Dataset) -> list[tuple[str, str, dict[str, Any]]]:
    """Return ending of the variables, name and looks of what to draw: before and after, or one where nothing was added."""
    before, after = loop["residual_declared"], loop["residual_final"]
    if np.allclose(before, after, atol=1e-9, equal_nan=True):
        return [("final", "declared model, nothing added", _FINAL)]
    return [("declared", "declared model", _DECLARED), ("final", "with the added effects", _FINAL)]


def plot_contributions(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw what each effect of the final model contributes over time at the far end of the axis, positive approach."""
    far = int(deviations["target"][int(np.argmax(np.abs(deviations["position"].values)))])
    place = float(deviations["position"].sel(target=far))
    hours = hours_since_start(deviations).sel(target=far, direction="positive").values
    title = f"at {place:g} mm, positive approach"
    drawn = new_figure(x=_TIME, y="contribution / µm", title=title, legend_columns=1, zero=True)
    courses = Courses(drawn, {"cycle": loop["cycle"].values, _TIME: hours})
    for at, effect in enumerate(str(name) for name in loop["effect"].values):
        line = loop["contribution"].sel(effect=effect, target=far, direction="positive").values
        courses.add(hours, line, effect_words(effect).name, **of_rank(at))
    return courses.chart(f"Contributions at {place:g} mm over time")


def plot_held_out_errors(loop: xr.Dataset, deviations: xr.Dataset) -> Chart:
    """Draw what each prediction missed in the cycles that took no part in any choice: dots for readings, lines for means of a cycle."""
    hours = hours_since_start(deviations)
    middle = hours.mean(["direction", "target"]).values
    held = loop["held_out_error_final"].notnull().any(["direction", "target"]).values
    raw = deviations["deviation"] - deviations["deviation"].isel(cycle=~held).mean("cycle")
    first, last = (float(end(hours.values[held])) for end in (np.nanmin, np.nanmax))
    times = (max(0.0, 2 * first - last), last + 0.02)
    drawn = new_figure(x=_TIME, y="measured − predicted / µm", height=360, x_range=times, zero=True)
    add_hold_out(drawn, first, last)
    columns: dict[str, np.ndarray] = {"cycle": loop["cycle"].values, _TIME: middle}
    series: list[tuple[xr.DataArray, str, dict[str, Any]]] = [
        (raw, "drift as measured", {"colour": CATEGORIES[3], "dash": "dotted"}),
        (loop["held_out_error_last_value"], "last value repeated", {"colour": CATEGORIES[2], "dash": "dotdash"}),
        (loop["held_out_error_declared"], "declared model", _DECLARED),
        (loop["held_out_error_final"], "with the added effects", _FINAL),
    ]
    parts = []
    for values, text, looks in series if len(_stages(loop)) > 1 else series[:-1]:
        mean = values.mean(["direction", "target"]).values
        add_series(drawn, middle, mean, name=text, width=2.2, **looks)
        columns[f"{text}, mean of the cycle / µm"] = mean
        if values is raw:
            continue
        colour = looks["colour"]
        dots = {"line_color": colour, "fill_color": colour, "line_alpha": 0.45, "fill_alpha": 0.45}
        draw(drawn, "Scatter", x=hours.values.ravel(), y=values.values.ravel(), named=text, size=2.5, **dots)
        parts.append(f"{text} {number(float(np.sqrt(np.nanmean(values.values**2))))} µm rms")
    seen = (
        f"Errors of predicting the {int(held.sum())} cycles that were held out: {'; '.join(parts)}; the drift as measured moves over "
        f"{span_words(columns['drift as measured, mean of the cycle / µm'], 'µm')}."
    )
    return Chart(drawn, seen, columns)


# Errors of predicting blocks of a test from the others, before and after an effect was added: what tells of every
# kind of effect.


def plot_block_errors(errors: xr.Dataset, hours: np.ndarray, along: str) -> Chart:
    """Draw the errors of predicting blocks from the others over time, without an effect and with it."""
    others = [name for name in errors.dims if name != along]
    x = "time since first reading / h" if along == "cycle" else "time since start / h"
    drawn = new_figure(x=x, y="prediction error, rms / µm", height=300)
    courses = Courses(drawn, {along: errors[along].values, x: hours} if along == "cycle" else {x: hours})
    for name, text, looks in (("before", "without the effect", _DECLARED), ("after", "with it", _FINAL)):
        size = np.sqrt((errors[name] ** 2).mean(others).values)
        courses.add(hours, size, text, marker="circle" if along == "cycle" else None, **looks)
    highest = np.nanmax([courses.columns["without the effect / µm"], courses.columns["with it / µm"]])
    fix_range(drawn, 0.0, 1.05 * float(highest))
    before, after = alike([float(np.sqrt((errors[name] ** 2).mean())) for name in ("before", "after")])
    counted = int(np.isfinite(courses.columns["with it / µm"]).sum())
    unit = "cycles" if along == "cycle" else "blocks of time"
    seen = (
        f"Errors in {counted} {unit} that were left out and predicted from the others: {before} µm rms without the effect, {after} µm "
        "with it."
    )
    return Chart(drawn, seen, courses.columns)


# A record: measured and predicted displacements, residuals, contributions, temperatures and drivers.

_SINCE_START, _AFTER, _PALE = "time since start / h", COLOURS["positive"], "#b3bdc2"
#: Sensors that are named; a legend of dozens hides the chart.
_NAMED = 4


def plot_prediction(record: xr.Dataset, channel: str) -> Chart:
    """Draw one channel as measured and as predicted by the declared and by the final model; the hold-out is shaded."""
    hours, chosen = hours_of(record), record.sel(channel=channel)
    names = ("displacement", "predicted_declared", "predicted_final")
    measured, declared, final = (chosen[name].values for name in names)
    held = record["sealed"].values
    # Root mean square by which the final model misses what it was fitted to, µm.
    missed_fit = float(np.sqrt(np.nanmean((measured - final)[~held] ** 2)))
    half = 2 * np.where(held, float(chosen["predicted_u"]), missed_fit)
    drawn = new_figure(x=_SINCE_START, y="displacement / µm", title=channel, height=340)
    _shade_hold_out(record, drawn)
    add_band(drawn, hours, final - half, final + half, _AFTER, "95 % band")
    add_series(drawn, hours, declared, name="declared model", colour=BEFORE, dash="dashed")
    add_series(drawn, hours, final, name="final model", colour=_AFTER, width=2.2)
    if "predicted_anchored" in record:
        add_series(
            drawn, hours, chosen["predicted_anchored"].values, name="from the last value", colour=INK, dash="dotted"
        )
    add_series(drawn, hours, measured, name="measured", colour=INK, width=1.2)
    left = (measured - final)[held & np.isfinite(measured - final)]
    missed = float(np.sqrt(np.mean(left**2))) if left.size else float("nan")
    seen = (
        f"{channel} measured from {span_words(measured, 'µm')}; where it was held out, the final model misses it by "
        f"{number(missed)} µm rms."
    )
    columns = {
        _SINCE_START: hours, "measured / µm": measured, "declared model / µm": declared, "final model / µm": final,
        "95 % band ± / µm": half, "held out": held.astype(int),
    }  # fmt: skip
    return Chart(drawn, seen, columns)


def plot_residuals(record: xr.Dataset, channel: str) -> Chart:
    """Draw the residuals of both models in one channel over time."""
    hours, chosen = hours_of(record), record.sel(channel=channel)
    drawn = new_figure(x=_SINCE_START, y="measured − predicted / µm", title=channel, zero=True)
    _shade_hold_out(record, drawn)
    courses = Courses(drawn, {_SINCE_START: hours})
    stages = (("declared", "declared model", BEFORE, "dashed"), ("final", "final model", _AFTER, "solid"))
    for ending, name, colour, dash in stages:
        missed = (chosen["displacement"] - chosen[f"predicted_{ending}"]).values
        courses.add(hours, missed, name, column=f"measured − {name} / µm", colour=colour, dash=dash)
    return courses.chart(f"What the models miss in {channel} over time")


def plot_temperatures(record: xr.Dataset) -> Chart:
    """Draw the rise of every sensor since the first block; the sensors that rise most have a colour and a name each."""
    hours = hours_of(record)
    rise = (record["temperature"] - record["temperature"].isel(time=0)).transpose("time", "sensor").values
    names = [str(name) for name in record["sensor"].values]
    order = np.argsort(-np.ptp(rise, axis=0))
    drawn = new_figure(x=_SINCE_START, y="rise / K", height=340, zero=True)
    others = order[_NAMED:]
    if others.size:
        held = source({"xs": [hours] * others.size, "ys": list(rise.T[others]), "name": [names[k] for k in others]})
        looks: dict[str, Any] = {"xs": "xs", "ys": "ys", "line_color": _PALE, "line_width": 1.1}
        lines = draw(drawn, "MultiLine", columns=held, named="other sensors", hovered={"line_color": INK}, **looks)
        add_hover(drawn, [("sensor", "@name"), ("time", "$x{0.00} h"), ("rise", "$y{0.00} K")], [lines])
    for rank, k in enumerate(order[:_NAMED]):
        add_series(drawn, hours, rise[:, k], name=names[k], width=2.0, **of_rank(rank))
    seen = f"Rise of {len(names)} sensors: {span_words(rise, 'K')}; those that move most are {join([names[k] for k in order[:_NAMED]])}."
    return Chart(
        drawn, seen, {_SINCE_START: hours, **{f"rise of {name} / K": rise[:, k] for k, name in enumerate(names)}}
    )


def plot_drivers(record: xr.Dataset) -> Chart:
    """Draw every driver in its own unit, one below the other on one time axis."""
    hours = hours_of(record)
    columns: dict[str, np.ndarray] = {_SINCE_START: hours}
    parts: list[Figure] = []
    said = []
    for k, name in enumerate(str(driver) for driver in record["driver_name"].values):
        unit = print_unit(str(record["driver_units"].values[k]))
        values = record["driver"].values[:, k] * float(record["driver_size"].values[k])
        drawn = new_figure(x=_SINCE_START, y=unit, title=name, height=200)
        if parts:
            drawn.x_range = parts[0].x_range
        fix_range(drawn, *shared_range(values, np.zeros(1)))
        add_series(drawn, hours, values, name=name, colour=CATEGORIES[k % len(CATEGORIES)], legend=False)
        parts.append(drawn)
        columns[own_name(f"{name} / {unit}" if unit else name, columns)] = values
        said.append(f"{name} {span_words(values, unit).strip()}")
    shown = parts[0] if len(parts) == 1 else column(parts)
    return Chart(shown, f"Logged drivers over time: {'; '.join(said)}.", columns)


def plot_channel_contributions(record: xr.Dataset, channel: str) -> Chart:
    """Draw what each term of the final model contributes to one channel, about its mean."""
    hours = hours_of(record)
    drawn = new_figure(x=_SINCE_START, y="contribution / µm", title=channel, legend_columns=1, zero=True)
    _shade_hold_out(record, drawn)
    courses = Courses(drawn, {_SINCE_START: hours})
    for k, effect in enumerate(str(name) for name in record["effect"].values):
        values = record["contribution"].sel(channel=channel).isel(effect=k).values
        courses.add(hours, values, effect_words(effect).name, **of_rank(k))
    return courses.chart(f"Contributions to {channel} over time")


def _shade_hold_out(record: xr.Dataset, drawn: Figure) -> None:
    """Shade the hold-out, each run that is held out separately."""
    hours, held_out = hours_of(record), record["sealed"].values
    run = record["run"].values if "run" in record else np.zeros(hours.size, int)
    for one in np.unique(run[held_out]):
        here = hours[held_out & (run == one)]
        add_hold_out(drawn, float(here[0]), float(here[-1]))


def hours_of(record: xr.Dataset) -> np.ndarray:
    """Return the time of every block since the start of the record in hours; of several runs, the time between them left out."""
    if "elapsed" in record:
        return np.asarray(record["elapsed"].values / 3600.0)
    time = record["time"].values
    return np.asarray((time - time[0]) / np.timedelta64(1, "h"), float)


def draw_record(record: xr.Dataset) -> dict[str, Chart]:
    """Return the charts of a record by name."""
    drawn = {"temperatures": plot_temperatures(record)}
    if record.sizes["driver_name"]:
        drawn["drivers"] = plot_drivers(record)
    for k, name in enumerate(shown_channels(record)):
        drawn[f"prediction_{k}"] = plot_prediction(record, name)
        drawn[f"residual_{k}"] = plot_residuals(record, name)
        if record.sizes["effect"]:
            drawn[f"contribution_{k}"] = plot_channel_contributions(record, name)
    for step in range(record.sizes.get("step", 0)):
        errors = xr.Dataset({name: record[f"block_error_{name}"].isel(step=step) for name in ("before", "after")})
        drawn[f"block_errors_{step}"] = plot_block_errors(errors, hours_of(record), "time")
    return drawn


def draw_thermal_tests(tests: Sequence[ThermalTest]) -> dict[str, Chart]:
    """Return the charts of every test: what has the same unit over time."""
    charts = {}
    for k, test in enumerate(tests):
        for unit in dict.fromkeys(one.unit for one in test.courses):
            shown = [one for one in test.courses if one.unit == unit][:DRAWN]
            printed = print_unit(unit)
            drawn = new_figure(
                x="time since start / h",
                y=f"{'temperature' if unit == 'degC' else 'drift'} / {printed}",
                legend_columns=4,
            )
            courses = Courses(drawn, {"time since start / h": np.array(shown[0].hours)}, unit=printed)
            for rank, one in enumerate(shown):
                courses.add(np.array(one.hours), np.array(one.values, float), one.name, **of_rank(rank))
            charts[f"thermal_{k}_{unit.replace('/', '_')}"] = courses.chart("Course of the test")
    return charts
