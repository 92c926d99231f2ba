"""The charts of a campaign's report, in the parts in which a run comes to know what they show.

What was measured, and where drift and field agree, wait for no model and can be drawn while it is fitted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.common import own_name
from fusion.report.campaign import leading_region
from fusion.report.charts import model, plan, readings
from fusion.report.charts.embedded import Drawn, Figure
from fusion.report.charts.model import draw_record, draw_thermal_tests
from fusion.report.charts.plan import add_marks, add_names, draw_both, draw_picture, plot_thermal_map
from fusion.report.charts.style import (
    DIVERGING,
    Chart,
    Courses,
    add_series,
    draw,
    embed,
    new_figure,
    of_rank,
    span_words,
)
from fusion.results.numbers import fixed
from fusion.results.results import Results
from fusion.results.store import group, has
from interferometry.plots import ACCENT, evaluate_common_start, hours_since_start
from thermography.evaluation import count_temperatures, read_profile
from thermography.io.region import Region


def draw_campaign(results: Results, datasets: Mapping[str, Any]) -> Drawn:
    """Draw all charts of the report of a campaign or a record."""
    if "record" in datasets:
        return Drawn(embed({**draw_record(datasets["record"]), **draw_thermal_tests(results.iso230_3 or ())}))
    fields, deviations, fused = (datasets.get(name) for name in ("fields", "deviations", "fusion"))
    drawn = draw_measured(fields, deviations, None if fused is None else fused.to_dataset())
    if results.regions and "thermograms" in datasets:
        series = results.thermograms.series if results.thermograms else results.regions[0].camera
        drawn = drawn.with_more(draw_pictures(datasets["thermograms"], series))
    correlation = results.correlation
    if fused is not None and correlation is not None and "correlation" in fused.children:
        drawn = drawn.with_more(draw_attributed(fused, correlation.source.part, correlation.p_resolution))
    if deviations is not None:
        found = xr.Dataset() if fused is None else fused.to_dataset()
        drawn = drawn.with_more(draw_modelled(deviations, found, {one.target for one in results.anomalies or ()}))
    position = None if deviations is None else deviations["position"]
    return drawn.with_more(draw_placed(results, fields, position, datasets.get("sensors")))


def draw_measured(fields: xr.Dataset | None, deviations: xr.Dataset | None, fused: xr.Dataset | None = None) -> Drawn:
    """Draw what was measured and evaluated before anything is modelled."""
    charts: dict[str, Chart] = {}
    if fields is not None:
        charts |= {"rise_history": plan.plot_rise_history(fields), "contact_sheet": plan.plot_contact_sheet(fields)}
    if deviations is not None:
        charts |= _reading_charts(deviations)
        charts |= _drift_charts(deviations) if has(deviations, "estimate") else {}
    if fused is not None:
        charts |= _clock_charts(fused, deviations)
    return Drawn(embed(charts))


def draw_pictures(thermograms: xr.Dataset, series: str) -> Drawn:
    """Draw the pictures in degC."""
    return Drawn(embed(draw_thermograms(thermograms, series)))


def draw_attributed(fused: xr.DataTree, channel: str, least_p: float | None) -> Drawn:
    """Draw where drift and field agree."""
    return Drawn(embed(_correlation_charts(fused, channel, least_p)))


def draw_modelled(deviations: xr.Dataset, fused: xr.Dataset, standing_out: Set[int]) -> Drawn:
    """Draw what a model of the drift found, and the positions that stand out."""
    charts: dict[str, Chart] = {}
    if has(deviations, "estimate"):
        joint = group(deviations, "estimate")
        shown = min(standing_out, default=int(deviations["target"][min(3, deviations.sizes["target"] - 1)]))
        charts["history"] = readings.plot_history(deviations, joint, shown)
        charts["anomalies"] = readings.plot_position_scatter(joint, deviations["position"], standing_out)
    if has(fused, "loop"):
        charts |= _loop_charts(group(fused, "loop"), deviations)
    return Drawn(embed(charts))


def draw_placed(
    results: Results, fields: xr.Dataset | None, position: xr.DataArray | None, logged: xr.Dataset | None
) -> Drawn:
    """Draw the thermal map with all places that were found on it, and the contact sensors."""
    charts: dict[str, Chart] = {}
    controls = None
    if logged is not None:
        charts["sensors"] = plan.plot_sensors(logged)
    if fields is not None:
        correlation = results.correlation
        followed = correlation.source.area if correlation and correlation.verdict == "attributable" else None
        if "fiducial" in fields.sizes:
            charts["registration"] = plan.plot_registration(fields, results.hotspots or (), followed)
        charts["thermal_map"], controls = plot_thermal_map(
            fields, results.hotspots or (), position, sensors=results.sensors or (), followed=followed,
            standing_out={one.target for one in results.anomalies or ()},
        )  # fmt: skip
    return Drawn(embed({**charts, **draw_thermal_tests(results.iso230_3 or ())}), controls)


def _clock_charts(fused: xr.Dataset, deviations: xr.Dataset | None) -> dict[str, Chart]:
    """The charts of both recordings on one clock."""
    charts: dict[str, Chart] = {}
    if "time" in fused:
        charts["timeline"] = readings.plot_timeline(fused)
    if "local_rise" in fused:
        charts["axis_temperature"] = plan.plot_axis_temperature(fused)
        if deviations is not None:
            charts["drift_temperature"] = plan.plot_drift_temperature(fused, group(deviations, "estimate"))
    return charts


def _reading_charts(deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts that need neither the times of the readings nor their drift; without neighbour differences that of the standard alone."""
    position, sides = deviations["position"], _sides(deviations)
    standard = (
        {"iso230": readings.plot_test(group(deviations, "quoted"), position)} if has(deviations, "quoted") else {}
    )
    if not has(deviations, "comparison"):
        return standard
    shifted = evaluate_common_start(deviations)
    from_start = "deviation from the start"
    return {
        **{f"deviations_{side}": readings.plot_cycles(deviations, side) for side in sides},
        **{f"common_start_{side}": readings.plot_cycles(shifted, side, quantity=from_start) for side in sides},
        "scatter": readings.plot_scatter_comparison(group(deviations, "comparison"), position),
        "mean_differences": readings.plot_mean_differences(group(deviations, "neighbours"), position),
        "chart": readings.plot_reference_chart(group(deviations, "chart"), position),
        **standard,
    }


def _sides(deviations: xr.Dataset) -> list[str]:
    """The directions of approach in which readings were taken."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    return [str(side) for side in read["direction"].values[read.values]]


def _drift_charts(deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the drift of the readings."""
    joint, position = group(deviations, "estimate"), deviations["position"]
    windows = group(deviations, "iso")
    both: dict[str, Chart] = {}
    if len(_sides(deviations)) == 2:
        both["reversal"] = readings.plot_reversal(joint, position)
        # The last window is the whole test.
        both |= {"windows": readings.plot_windows(windows)} if readings.has_windows(windows) else {}
    return {
        "drift": readings.plot_drift(joint, deviations),
        "profile": readings.plot_profile(joint, position),
        **both,
    }


def _correlation_charts(fused: xr.DataTree, channel: str, least_p: float | None) -> dict[str, Chart]:
    """The maps of the leading part of the drift, the modes, and the leading region by target."""
    maps = fused.children["correlation"]
    cells, position = maps.to_dataset(), fused.to_dataset()["position"]
    charts: dict[str, Chart] = {}
    if bool((cells["p_value"].sel(channel=channel) <= model.LEAST_SHOWN).any()):
        charts["significance"] = model.plot_significance(cells, channel)
    if bool((cells["p_value"].sel(channel=channel) <= ATTRIBUTION_LEVEL).any()):
        charts["sensitivity"] = model.plot_sensitivity(cells, channel)
    if "modes" in maps.children:
        modes = maps.children["modes"].to_dataset()
        # The table has them all.
        followed = modes["mode"].values[(modes["p_value"] <= ATTRIBUTION_LEVEL).any("channel").values]
        charts |= {f"mode_{mode}": model.plot_mode(modes, int(mode), channel, least_p) for mode in followed}
    if "target_regions" in maps.children:
        region, targets = leading_region(maps), maps.children["target_regions"].to_dataset()
        charts["region_targets"] = model.plot_region_targets(targets, region, position)
    return charts


def _loop_charts(loop: xr.Dataset, deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the closed loop."""
    charts = {"contributions": model.plot_contributions(loop, deviations)}
    if "held_out_error_final" in loop and bool(loop["held_out_error_final"].notnull().any()):
        charts["held_out_errors"] = model.plot_held_out_errors(loop, deviations)
    hours = hours_since_start(deviations).mean(["direction", "target"]).values
    for step in range(loop.sizes.get("step", 0)):
        errors = xr.Dataset({name: loop[f"block_error_{name}"].isel(step=step) for name in ("before", "after")})
        charts[f"block_errors_{step}"] = model.plot_block_errors(errors, hours, "cycle")
    return charts


# A camera that measures alone: the hottest picture, temperatures over time, and what changed from first to last.

#: Regions that are drawn over time: more lines cannot be told apart.
MOST_LINES = 8
#: Share of the pixels that lie beyond the colour scale of a picture at either end, so that single ones do not set it.
_BEYOND = 0.1
#: Most pixels of a picture that is drawn, and of one whose values the reader can download; larger ones are averaged in blocks.
_DRAWN, _DOWNLOADED = 400_000, 40_000
#: Classes of a histogram.
_CLASSES = 60
#: Units of a time axis: from how many seconds, unit, seconds.
_TIMES = ((7200.0, "h", 3600.0), (120.0, "min", 60.0), (0.0, "s", 1.0))


def draw_thermograms(thermograms: xr.Dataset, series: str) -> dict[str, Chart]:
    """Draw what the pictures show."""
    picture = thermograms[["thermogram", "flag"]].rename(thermogram="temperature")
    regions = [Region(one["name"], one["kind"], one["points"]) for one in json.loads(thermograms.attrs["outlines"])]
    rows, columns = picture["temperature"].shape
    lines = [one for one in regions if one.kind == "line" and not one.is_cut((rows, columns))]
    charts = {"thermogram": plot_thermogram(thermograms), "histogram": plot_histogram(picture)}
    if lines:
        charts["profile"] = plot_profiles(picture, lines[:MOST_LINES])
    of_series = thermograms.isel(time=np.flatnonzero(thermograms["camera"].values == series))
    if np.unique(of_series["time"].values).size > 1:
        charts["region_history"] = plot_regions(of_series)
    if "difference" in thermograms:
        charts["difference"] = plot_difference(thermograms["difference"].values)
    return charts


def plot_thermogram(thermograms: xr.Dataset) -> Chart:
    """Draw the hottest picture with its regions and the places of its extremes."""
    values, flag = thermograms["thermogram"].values, thermograms["flag"].values
    calibrated = values[(flag == 0) & np.isfinite(values)]
    # Where pixels are beyond the calibrated range, the scale ends with it.
    marked = bool(calibrated.size and flag.any())
    ends = (calibrated.min(), calibrated.max()) if marked else np.nanpercentile(values, (_BEYOND, 100.0 - _BEYOND))
    low, high = (float(value) for value in ends)
    drawn = _draw(values, low, high if high > low else low + 1.0, "temperature / °C", marked=marked)
    for outline in json.loads(thermograms.attrs["outlines"]):
        _draw_outline(drawn, outline)
    places = {}
    for name, marker, at in (
        ("highest", "triangle", np.nanargmax(values)),
        ("lowest", "inverted_triangle", np.nanargmin(values)),
    ):
        row, column = np.unravel_index(int(at), values.shape)
        places[name] = f"{fixed(float(values[row, column]), 1)} °C at column {column}, row {row}"
        add_marks(drawn, [float(column)], [float(row)], marker, 9)
    beyond = int(np.count_nonzero(flag))
    seen = (
        f"Thermogram {thermograms.attrs['hottest']} of {values.shape[1]} by {values.shape[0]} pixels: highest {places['highest']}, lowest "
        f"{places['lowest']}; {beyond} pixels outside the calibrated range."
    )
    return Chart(drawn, seen, _columns(values, "temperature / °C"))


def _draw(values: np.ndarray, low: float, high: float, label: str, **looks: Any) -> Figure:
    """Draw a picture of any size with its places in pixels of the sensor."""
    means, block = _averaged(values, _DRAWN)
    return draw_picture(means, low, high, label, block=block, **looks)


def _averaged(values: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """Return a picture of so many pixels at most, each the mean of a block, and the side of a block."""
    block = int(np.ceil(np.sqrt(values.size / most)))
    rows, columns = (size // block for size in values.shape)
    whole = values[: rows * block, : columns * block]
    return whole.reshape(rows, block, columns, block).mean(axis=(1, 3)), block


def _columns(values: np.ndarray, label: str) -> dict[str, np.ndarray]:
    """Return what the reader can download of a picture, one row per pixel or block."""
    means, block = _averaged(values, _DOWNLOADED)
    row, column = block * np.indices(means.shape) + (block - 1) / 2
    return {"column / px": column.ravel(), "row / px": row.ravel(), label: means.ravel()}


def _draw_outline(drawn: Figure, outline: dict[str, Any]) -> None:
    """Draw a region with its name."""
    points = np.array(outline["points"], float)
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    if outline["kind"] == "spot":
        add_marks(drawn, [left], [top], "cross", 13)
    elif outline["kind"] == "ellipse":
        turn = np.linspace(0.0, 2.0 * np.pi, 61)
        points = np.column_stack(
            [(left + right + (right - left) * np.cos(turn)) / 2, (top + bottom + (bottom - top) * np.sin(turn)) / 2]
        )
    elif outline["kind"] == "box":
        points = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    if outline["kind"] in ("box", "polygon"):
        points = np.vstack([points, points[:1]])
    if len(points) > 1:
        draw_both(drawn, *points.T)
    inside = right < 0.85 * drawn.x_range.end
    offset, align = (6, "left") if inside else (-6, "right")
    add_names(drawn, [right], [top], [outline["name"]], x_offset=offset, y_offset=-4, text_align=align)


def plot_regions(thermograms: xr.Dataset) -> Chart:
    """Draw maximum and mean of the whole picture and the mean of every region over time."""
    seconds = (thermograms["time"].values - thermograms["time"].values[0]) / np.timedelta64(1, "s")
    unit, scale = next((unit, scale) for least, unit, scale in _TIMES if seconds[-1] >= least)
    drawn = new_figure(x=f"time since the first picture / {unit}", y="temperature / °C", height=380, legend_columns=3)
    whole, *regions = thermograms["region"].values[: MOST_LINES - 1]
    highest, above = thermograms["maximum"], thermograms["overrange"] > 0
    lines = [
        ("highest of the picture", highest.sel(region=whole), above.sel(region=whole)),
        ("mean of the picture", thermograms["mean"].sel(region=whole), xr.zeros_like(above.sel(region=whole))),
        *((str(name), highest.sel(region=name), above.sel(region=name)) for name in regions),
    ]
    columns: dict[str, Any] = {f"time / {unit}": seconds / scale}
    told = []
    for rank, (name, values, beyond) in enumerate(lines):
        looks = of_rank(rank)
        marker = "circle" if seconds.size <= 100 else None
        add_series(drawn, seconds / scale, values.where(~beyond).values, name=name, marker=marker, size=4.0, **looks)
        if beyond.any():
            # The limit of the range is no temperature that was measured: what was there lies above it.
            times, limits = (each[beyond.values] for each in (seconds / scale, values.values))
            looks = {"colour": looks["colour"], "line": False, "marker": "triangle"}
            add_series(drawn, times, limits, name="above the calibrated range", **looks)
        columns[own_name(f"{name} / °C", columns)] = values.values
        told.append(f"{name} {span_words(values, '°C')}{' and above' if beyond.any() else ''}")
    return Chart(drawn, f"Temperatures in {seconds.size} pictures: {'; '.join(told)}.", columns)


def plot_profiles(picture: xr.Dataset, lines: Sequence[Region]) -> Chart:
    """Draw the temperatures along lines."""
    drawn = new_figure(x="distance along the line / px", y="temperature / °C", legend_columns=3)
    courses = Courses(drawn, unit="°C")
    for rank, line in enumerate(lines):
        along = read_profile(picture, line)
        courses.columns[own_name(f"{line.name}, distance / px", courses.columns)] = along["distance"].values
        courses.add(along["distance"].values, along.values, line.name, **of_rank(rank))
    longest = max(len(values) for values in courses.columns.values())
    for name, values in courses.columns.items():
        courses.columns[name] = np.pad(values, (0, longest - len(values)), constant_values=np.nan)
    return courses.chart("Temperatures along lines")


def plot_histogram(picture: xr.Dataset) -> Chart:
    """Draw how many pixels have which temperature; the columns to download say how many are warmer (isotherm)."""
    counts = count_temperatures(picture, bins=_CLASSES)
    values, width = counts["temperature"].values, float(counts["temperature"].diff("temperature").mean())
    most = float(values[counts.values.argmax()])
    drawn = new_figure(x="temperature / °C", y="pixels", y_type="log", height=300)
    some = counts.values > 0
    left, right = (values - width / 2)[some], (values + width / 2)[some]
    looks: dict[str, Any] = {"fill_color": ACCENT, "line_color": "#ffffff"}
    draw(drawn, "Quad", left=left, right=right, top=counts.values[some], bottom=0.5, **looks)
    seen = f"Histogram of {int(counts.sum())} pixels within the calibrated range, most at {fixed(most, 1)} °C."
    warmer = counts.values[::-1].cumsum()[::-1]
    return Chart(
        drawn, seen, {"temperature / °C": values, "pixels": counts.values, "pixels from this class up": warmer}
    )


def plot_difference(values: np.ndarray) -> Chart:
    """Draw the last picture minus the first."""
    most = float(np.nanpercentile(np.abs(values), 100.0 - _BEYOND)) or 1.0
    drawn = _draw(values, -most, most, "change / K", colours=DIVERGING)
    seen = f"Change of every pixel from the first picture to the last: {span_words(values, 'K')}."
    return Chart(drawn, seen, _columns(values, "change / K"))
