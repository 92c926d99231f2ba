"""The charts of a campaign's report, in the parts in which a run comes to know what they show.

What was measured, and where drift and field agree, wait for no model and can be drawn while it is fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any

import xarray as xr

from fusion.analysis.levels import ATTRIBUTION_LEVEL
from fusion.report.campaign import leading_region
from fusion.report.charts import model, plan, readings
from fusion.report.charts.embedded import Drawn
from fusion.report.charts.plan import plot_thermal_map
from fusion.report.charts.record import draw_record, draw_thermal_tests
from fusion.report.charts.style import Chart, embed
from fusion.report.charts.thermograms import draw_thermograms
from fusion.results.results import Results
from fusion.results.store import group, has
from interferometry.plots import evaluate_common_start, hours_since_start


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
