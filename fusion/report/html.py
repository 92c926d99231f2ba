"""report.html: one self-contained file, made from the products alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from fusion.attribution.family_wise import LEVEL
from fusion.errors import FusionError
from fusion.products.contracts import is_file_list, read_fusion, read_product, require_own
from fusion.products.grouped import group, has
from fusion.products.results import RecordLoop, Results, read_results
from fusion.report import record_section, summary_section
from fusion.report.attribution_section import leading_region
from fusion.report.charts import attribution, drift, iso230, neighbours, plan, prediction, readings, sensors, timeline
from fusion.report.charts import loop as closed_loop
from fusion.report.charts.style import Chart
from fusion.report.charts.thermal_map import plot_thermal_map
from fusion.report.page import render_page
from interferometry.figures import evaluate_common_start, hours_since_start

#: Products that a report draws, where a campaign has them.
_DRAWN = ("fields", "deviations", "fusion", "sensors")


class ProductsError(FusionError):
    """A folder that does not hold the products of a finished run."""


def render_report(
    results: Results,
    provenance: Mapping[str, Any],
    datasets: Mapping[str, Any],
    *,
    joint: Mapping[str, Any] | None = None,
) -> str:
    """Return the report of a run as HTML text.

    Parameters
    ----------
    results : Results
        Results of the run, see `fusion.products.results.read_results`.
    provenance : mapping
        Content of provenance.json.
    datasets : mapping
        ``fields`` and ``deviations`` (Dataset) and ``fusion`` (DataTree) as they were written; those that a campaign does not
        have may be absent. A ``record`` (Dataset) stands alone.
    joint : mapping, optional
        What this campaign and another one of the machine agree on: ``other`` (its title), ``causes`` (places in words),
        ``table`` (Table of the places, None without any), ``rows`` (name and text of every part of the drift).

    Returns
    -------
    str
        One HTML page that needs no other file and no network.

    Raises
    ------
    KeyError
        If the products lack what the results refer to, because they belong to different runs.

    Notes
    -----
    Maps that exceed three million values are thinned in cycles and averaged in cells, and the page says so. Terms of
    ISO 230-2:2014; expanded uncertainties with k = 2 (GUM 6.2).

    Examples
    --------
    >>> from pathlib import Path
    >>> page = render_report(read_results(Path("results")), provenance, datasets)  # doctest: +SKIP
    """
    if "record" in datasets:
        return render_page(
            "record.html.j2",
            record_section.draw_record(datasets["record"]),
            results=results,
            provenance=provenance,
            summary=record_section.describe_record(results, provenance, datasets["record"]),
        )
    charts, thermal_map = _draw_charts(results, datasets), None
    if "fields" in datasets:
        position = datasets["deviations"]["position"] if "deviations" in datasets else None
        thermal_map = plot_thermal_map(
            datasets["fields"], results.hotspots or (), position, sensors=results.sensors or ()
        )
        charts["thermal_map"] = thermal_map.chart
    return render_page(
        "report.html.j2",
        charts,
        results=results,
        provenance=provenance,
        summary=summary_section.describe_campaign(results, provenance, datasets, joint),
        thermal_map=thermal_map,
    )


def report_of(folder: Path) -> str:
    """Return the report of a finished run, made anew from its products.

    Parameters
    ----------
    folder : Path
        Results folder.

    Returns
    -------
    str
        See `render_report`.

    Raises
    ------
    ResultsError, ProductsError, DamagedProductError
        If the folder does not hold the products of a finished run, as that run wrote them.
    """
    results = read_results(folder)
    require_own(folder, ["results.json"])
    origin = folder / "provenance.json"
    if not origin.is_file():
        raise ProductsError(f"{origin} is missing; run the campaign again, with --resume to keep what is finished")
    try:
        provenance = json.loads(origin.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ProductsError(
            f"{origin}: not JSON ({error}); run the campaign again, with --resume to keep what is finished"
        ) from None
    if not _is_provenance(provenance):
        raise ProductsError(
            f"{origin}: not the provenance of a run; run the campaign again, with --resume to keep what is finished"
        )
    if isinstance(results.loop, RecordLoop):
        return render_report(results, provenance, {"record": read_product(folder, "record")})
    there = [name for name in _DRAWN if (folder / f"{name}.nc").is_file()]
    read = {name: read_fusion(folder) if name == "fusion" else read_product(folder, name) for name in there}
    return render_report(results, provenance, read)


def _is_provenance(content: Any) -> bool:
    """Whether JSON holds what a report tells of a run's origin: its inputs, versions and parameters."""
    if not isinstance(content, dict):
        return False
    parts = [content.get(key) for key in ("inputs", "versions", "parameters")]
    if not (all(isinstance(part, dict) for part in parts) and isinstance(content["parameters"].get("campaign"), dict)):
        return False
    return is_file_list(content["inputs"])


def _draw_charts(results: Results, datasets: Mapping[str, Any]) -> dict[str, Chart]:
    """Return every chart that the data allow, by name."""
    charts: dict[str, Chart] = {}
    fields, deviations, fused = (datasets.get(name) for name in ("fields", "deviations", "fusion"))
    if fields is not None:
        charts["rise_history"] = plan.plot_rise_history(fields)
        if "fiducial" in fields.sizes:
            charts["registration"] = plan.plot_registration(fields)
    if deviations is not None:
        charts |= _reading_charts(deviations)
        charts |= _drift_charts(results, deviations) if has(deviations, "drift") else {}
    if "sensors" in datasets:
        charts["sensors"] = sensors.plot_sensors(datasets["sensors"])
    if fused is not None:
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


def _drift_charts(results: Results, deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts of the drift of the readings."""
    joint, position = group(deviations, "drift"), deviations["position"]
    flagged = {anomaly.target for anomaly in results.anomalies or ()}
    shown = min(flagged, default=int(deviations["target"][min(3, deviations.sizes["target"] - 1)]))
    windows = group(deviations, "iso")
    both: dict[str, Chart] = {}
    if len(_sides(deviations)) == 2:
        both["reversal"] = drift.plot_reversal(joint, position)
        # The last window is the whole test.
        both |= {"windows": readings.plot_windows(windows)} if windows.sizes["window"] > 1 else {}
    return {
        "deviation_map": drift.plot_deviation_map(deviations),
        "drift_map": drift.plot_drift_map(joint, position),
        "history": readings.plot_history(deviations, joint, shown),
        "drift": drift.plot_drift(joint, deviations),
        "profile": drift.plot_profile(joint, position),
        **both,
        "anomalies": drift.plot_position_scatter(joint, position, flagged),
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
