"""The charts of a campaign's report: those of what was measured, which wait for no model, and those of what was found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import xarray as xr

from fusion.attribution.family_wise import LEVEL
from fusion.products.grouped import group, has
from fusion.products.results import Results
from fusion.report.attribution_section import leading_region
from fusion.report.charts import attribution, drift, iso230, neighbours, plan, prediction, readings, sensors, timeline
from fusion.report.charts import loop as closed_loop
from fusion.report.charts.embedding import EmbeddedChart, embed
from fusion.report.charts.style import Chart
from fusion.report.charts.thermal_map import MapControls, plot_thermal_map
from interferometry.figures import evaluate_common_start, hours_since_start


class Drawn(NamedTuple):
    """Charts as a page takes them in.

    Attributes
    ----------
    charts : dict of str to EmbeddedChart
        By name.
    thermal_map : MapControls or None
        What the reader can choose of the thermal map; None where it is not among the charts.
    """

    charts: dict[str, EmbeddedChart]
    thermal_map: MapControls | None = None

    def with_more(self, more: Drawn) -> Drawn:
        """Return these charts and others.

        Parameters
        ----------
        more : Drawn
            The others.
        """
        return Drawn(self.charts | more.charts, more.thermal_map or self.thermal_map)


def draw_campaign(results: Results, datasets: Mapping[str, Any]) -> Drawn:
    """Draw all charts of a campaign's report.

    Parameters
    ----------
    results : Results
        Results of the run.
    datasets : mapping
        As for `fusion.report.html.render_report`.

    Returns
    -------
    Drawn
    """
    return draw_measured(datasets.get("fields"), datasets.get("deviations")).with_more(draw_found(results, datasets))


def draw_measured(fields: xr.Dataset | None, deviations: xr.Dataset | None) -> Drawn:
    """Draw what was measured and evaluated before anything is modelled.

    Parameters
    ----------
    fields, deviations : Dataset, optional
        Contents of fields.nc and deviations.nc.

    Returns
    -------
    Drawn
    """
    charts: dict[str, Chart] = {}
    if fields is not None:
        charts["rise_history"] = plan.plot_rise_history(fields)
        if "fiducial" in fields.sizes:
            charts["registration"] = plan.plot_registration(fields)
    if deviations is not None:
        charts |= _reading_charts(deviations)
        charts |= _drift_charts(deviations) if has(deviations, "drift") else {}
    return Drawn(embed(charts))


def draw_found(results: Results, datasets: Mapping[str, Any]) -> Drawn:
    """Draw what was found in the measurements.

    Parameters
    ----------
    results : Results
        Results of the run.
    datasets : mapping
        As for `fusion.report.html.render_report`.

    Returns
    -------
    Drawn
    """
    charts: dict[str, Chart] = {}
    controls = None
    fields, deviations, fused = (datasets.get(name) for name in ("fields", "deviations", "fusion"))
    if deviations is not None and has(deviations, "drift"):
        charts |= _anomaly_charts(results, deviations)
    if "sensors" in datasets:
        charts["sensors"] = sensors.plot_sensors(datasets["sensors"])
    if fused is not None:
        charts |= _fusion_charts(results, fused, deviations)
    if fields is not None:
        position = None if deviations is None else deviations["position"]
        charts["thermal_map"], controls = plot_thermal_map(
            fields, results.hotspots or (), position, sensors=results.sensors or ()
        )
    return Drawn(embed(charts), controls)


def _fusion_charts(results: Results, fused: xr.DataTree, deviations: xr.Dataset | None) -> dict[str, Chart]:
    """The charts of both recordings on one clock, of the attribution and of the closed loop."""
    charts: dict[str, Chart] = {}
    root = fused.to_dataset()
    if "time" in root:
        charts["timeline"] = timeline.plot_timeline(root)
    if "local_rise" in root:
        charts["axis_temperature"] = plan.plot_axis_temperature(root)
        if deviations is not None:
            charts["drift_temperature"] = plan.plot_drift_temperature(root, group(deviations, "drift"))
    if results.correlation is not None and "correlation" in fused.children:
        charts |= _correlation_charts(fused, results.correlation.source.part, results.correlation.least_p)
    if has(root, "loop") and deviations is not None:
        charts |= _loop_charts(group(root, "loop"), deviations)
    return charts


def _reading_charts(deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts that need neither the times of the readings nor their drift."""
    position, shifted, sides = deviations["position"], evaluate_common_start(deviations), _sides(deviations)
    return {
        **{f"deviations_{side}": readings.plot_cycles(deviations, side) for side in sides},
        **{
            f"common_start_{side}": readings.plot_cycles(shifted, side, quantity="deviation from a common start")
            for side in sides
        },
        "scatter": neighbours.plot_scatter_comparison(group(deviations, "comparison"), position),
        "mean_differences": neighbours.plot_mean_differences(group(deviations, "neighbours"), position),
        "chart": neighbours.plot_reference_chart(group(deviations, "chart"), position),
        **({"iso230": iso230.plot_test(group(deviations, "settled"), position)} if has(deviations, "settled") else {}),
    }


def _sides(deviations: xr.Dataset) -> list[str]:
    """The directions of approach in which readings were taken."""
    read = deviations["deviation"].notnull().any(("cycle", "target"))
    return [str(side) for side in read["direction"].values[read.values]]


def _drift_charts(deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the drift of the readings."""
    joint, position = group(deviations, "drift"), deviations["position"]
    windows = group(deviations, "iso")
    both: dict[str, Chart] = {}
    if len(_sides(deviations)) == 2:
        both["reversal"] = drift.plot_reversal(joint, position)
        # The last window is the whole test.
        both |= {"windows": readings.plot_windows(windows)} if windows.sizes["window"] > 1 else {}
    return {
        "deviation_map": drift.plot_deviation_map(deviations),
        "drift_map": drift.plot_drift_map(joint, position),
        "drift": drift.plot_drift(joint, deviations),
        "profile": drift.plot_profile(joint, position),
        **both,
    }


def _anomaly_charts(results: Results, deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the positions that stand out."""
    joint = group(deviations, "drift")
    flagged = {anomaly.target for anomaly in results.anomalies or ()}
    shown = min(flagged, default=int(deviations["target"][min(3, deviations.sizes["target"] - 1)]))
    return {
        "history": readings.plot_history(deviations, joint, shown),
        "anomalies": drift.plot_position_scatter(joint, deviations["position"], flagged),
    }


def _correlation_charts(fused: xr.DataTree, channel: str, least_p: float | None) -> dict[str, Chart]:
    """The maps of the leading part of the drift, the modes, the clusters, and the leading region by target."""
    maps = fused.children["correlation"]
    cells, position = maps.to_dataset(), fused.to_dataset()["position"]
    charts = {"clusters": attribution.plot_clusters(maps.children["clusters"].to_dataset())}
    if bool((cells["p_value"].sel(channel=channel) <= attribution.LEAST_SHOWN).any()):
        charts["significance"] = attribution.plot_significance(cells, channel)
    if bool((cells["p_value"].sel(channel=channel) <= LEVEL).any()):
        charts["sensitivity"] = attribution.plot_sensitivity(cells, channel)
    if "modes" in maps.children:
        modes = maps.children["modes"].to_dataset()
        charts |= {
            f"mode_{mode}": attribution.plot_mode(modes, int(mode), channel, least_p) for mode in modes["mode"].values
        }
    if "target_regions" in maps.children:
        region, targets = leading_region(maps), maps.children["target_regions"].to_dataset()
        charts["region_targets"] = attribution.plot_region_targets(targets, region, position)
    return charts


def _loop_charts(loop: xr.Dataset, deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the closed loop."""
    charts = {
        "residual_direction": closed_loop.plot_residual_direction(loop, deviations),
        "residual_spectrum": closed_loop.plot_residual_spectrum(loop),
        "residual_events": closed_loop.plot_residual_events(loop, deviations),
        "contributions": closed_loop.plot_contributions(loop, deviations),
    }
    if "held_out_error_final" in loop and bool(loop["held_out_error_final"].notnull().any()):
        charts["held_out_errors"] = closed_loop.plot_held_out_errors(loop, deviations)
        charts["held_out_positions"] = closed_loop.plot_held_out_positions(loop, deviations)
        charts["predicted_measured"] = closed_loop.plot_predicted_measured(loop, deviations)
    hours = hours_since_start(deviations).mean(["direction", "target"]).values
    for step in range(loop.sizes.get("step", 0)):
        errors = xr.Dataset({name: loop[f"block_error_{name}"].isel(step=step) for name in ("before", "after")})
        charts[f"block_errors_{step}"] = prediction.plot_block_errors(errors, hours, "cycle")
    return charts
