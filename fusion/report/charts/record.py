"""Charts of a record: measured and predicted displacements, residuals, contributions, temperatures and drivers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from fusion.common import own_name
from fusion.report.campaign import DRAWN, shown_channels
from fusion.report.charts.model import plot_block_errors
from fusion.report.charts.models import Figure, source
from fusion.report.charts.style import (
    BEFORE,
    CATEGORIES,
    Chart,
    Courses,
    add_band,
    add_hold_out,
    add_hover,
    add_series,
    column,
    draw,
    fix_range,
    new_figure,
    of_rank,
    shared_range,
    span_words,
)
from fusion.report.wording import effect_words
from fusion.results.numbers import join, number, print_unit
from fusion.results.parts import ThermalTest
from interferometry.plots import COLOURS, INK

_TIME, _AFTER, _PALE = "time since start / h", COLOURS["positive"], "#b3bdc2"
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
    drawn = new_figure(x=_TIME, y="displacement / µm", title=channel, height=340)
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
        _TIME: hours, "measured / µm": measured, "declared model / µm": declared, "final model / µm": final, "95 % band ± / µm": half,
        "held out": held.astype(int),
    }  # fmt: skip
    return Chart(drawn, seen, columns)


def plot_residuals(record: xr.Dataset, channel: str) -> Chart:
    """Draw the residuals of both models in one channel over time."""
    hours, chosen = hours_of(record), record.sel(channel=channel)
    drawn = new_figure(x=_TIME, y="measured − predicted / µm", title=channel, zero=True)
    _shade_hold_out(record, drawn)
    courses = Courses(drawn, {_TIME: hours})
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
    drawn = new_figure(x=_TIME, y="rise / K", height=340, zero=True)
    others = order[_NAMED:]
    if others.size:
        held = source({"xs": [hours] * others.size, "ys": list(rise.T[others]), "name": [names[k] for k in others]})
        looks: dict[str, Any] = {"xs": "xs", "ys": "ys", "line_color": _PALE, "line_width": 1.1}
        lines = draw(drawn, "MultiLine", columns=held, named="other sensors", hovered={"line_color": INK}, **looks)
        add_hover(drawn, [("sensor", "@name"), ("time", "$x{0.00} h"), ("rise", "$y{0.00} K")], [lines])
    for rank, k in enumerate(order[:_NAMED]):
        add_series(drawn, hours, rise[:, k], name=names[k], width=2.0, **of_rank(rank))
    seen = f"Rise of {len(names)} sensors: {span_words(rise, 'K')}; those that move most are {join([names[k] for k in order[:_NAMED]])}."
    return Chart(drawn, seen, {_TIME: hours, **{f"rise of {name} / K": rise[:, k] for k, name in enumerate(names)}})


def plot_drivers(record: xr.Dataset) -> Chart:
    """Draw every driver in its own unit, one below the other on one time axis."""
    hours = hours_of(record)
    columns: dict[str, np.ndarray] = {_TIME: hours}
    parts: list[Figure] = []
    said = []
    for k, name in enumerate(str(driver) for driver in record["driver_name"].values):
        unit = print_unit(str(record["driver_units"].values[k]))
        values = record["driver"].values[:, k] * float(record["driver_size"].values[k])
        drawn = new_figure(x=_TIME, y=unit, title=name, height=200)
        if parts:
            drawn.x_range = parts[0].x_range
        fix_range(drawn, *shared_range(values, np.zeros(1)))
        add_series(drawn, hours, values, name=name, colour=CATEGORIES[k % len(CATEGORIES)], legend=False)
        parts.append(drawn)
        columns[own_name(f"{name} / {unit}" if unit else name, columns)] = values
        said.append(f"{name} {span_words(values, unit).strip()}")
    shown = parts[0] if len(parts) == 1 else column(parts)
    return Chart(shown, f"Logged drivers over time: {'; '.join(said)}.", columns)


def plot_contributions(record: xr.Dataset, channel: str) -> Chart:
    """Draw what each term of the final model contributes to one channel, about its mean."""
    hours = hours_of(record)
    drawn = new_figure(x=_TIME, y="contribution / µm", title=channel, legend_columns=1, zero=True)
    _shade_hold_out(record, drawn)
    courses = Courses(drawn, {_TIME: hours})
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
            drawn[f"contribution_{k}"] = plot_contributions(record, name)
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
