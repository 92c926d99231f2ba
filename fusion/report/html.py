"""report.html: one self-contained file, made from the products alone."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from fusion.attribution.family_wise import LEVEL
from fusion.products.grouped import group, has
from fusion.products.results import Results
from fusion.report import record_section, summary_section
from fusion.report.attribution_section import leading_region
from fusion.report.charts import attribution, drift, neighbours, plan, readings, timeline
from fusion.report.charts import loop as closed_loop
from fusion.report.charts.style import Chart
from fusion.report.page import render_page
from interferometry.figures import evaluate_common_start

#: Largest number of map values in the file; above it cycles are thinned and cells are averaged, and the report says so.
_MAP_BUDGET = 2_000_000
_MISSING = -32768
_LAYERS = (("rise", "temperature_rise", "K"), ("temperature", "temperature", "°C"))


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
        ``sources`` (rows of cells: place, part of the drift, first and second session, verdict), ``rows`` (name and text).

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
    Charts are SVG, fields are 16-bit maps. Recordings whose maps exceed two million values are thinned in cycles and averaged in cells,
    and the page says so. Terms of ISO 230-2:2014; expanded uncertainties with k = 2 (GUM 6.2).

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
    return render_page(
        "report.html.j2",
        _draw_charts(results, datasets),
        results=results,
        provenance=provenance,
        summary=summary_section.describe_campaign(results, provenance, datasets, joint),
        maps=_embed_maps(datasets["fields"], results) if "fields" in datasets else None,
    )


def _draw_charts(results: Results, datasets: Mapping[str, Any]) -> dict[str, Chart]:
    """Return every chart that the data allow, by name."""
    charts: dict[str, Chart] = {}
    fields, deviations, fused = (datasets.get(name) for name in ("fields", "deviations", "fusion"))
    if fields is not None:
        charts |= {"registration": plan.plot_registration(fields), "rise_history": plan.plot_rise_history(fields)}
    if deviations is not None:
        charts |= _drift_charts(results, deviations)
    if fused is not None:
        root = fused.to_dataset()
        if "time" in root:
            charts["timeline"] = timeline.plot_timeline(root)
        if "local_rise" in root:
            charts["axis_temperature"] = plan.plot_axis_temperature(root)
            if deviations is not None:
                charts["drift_temperature"] = plan.plot_drift_temperature(root, group(deviations, "drift"))
        if results.correlation is not None and "correlation" in fused.children:
            charts |= _correlation_charts(fused, results.correlation.source.part)
        if has(root, "loop") and deviations is not None:
            charts |= _loop_charts(group(root, "loop"), deviations)
    return charts


def _drift_charts(results: Results, deviations: xr.Dataset) -> dict[str, Chart]:
    """The charts that need the readings alone."""
    joint, position = group(deviations, "drift"), deviations["position"]
    flagged = {anomaly.target for anomaly in results.anomalies or ()}
    shown = min(flagged, default=int(deviations["target"][min(3, deviations.sizes["target"] - 1)]))
    shifted = evaluate_common_start(deviations)
    return {
        **{f"deviations_{side}": readings.plot_cycles(deviations, side) for side in ("positive", "negative")},
        **{
            f"common_start_{side}": readings.plot_cycles(shifted, side, quantity="deviation from a common start")
            for side in ("positive", "negative")
        },
        "deviation_map": drift.plot_deviation_map(deviations),
        "drift_map": drift.plot_drift_map(joint, position),
        "history": readings.plot_history(deviations, joint, shown),
        "drift": drift.plot_drift(joint, deviations),
        "profile": drift.plot_profile(joint, position),
        "reversal": drift.plot_reversal(joint, position),
        "scatter": neighbours.plot_scatter_comparison(group(deviations, "comparison"), position),
        "mean_differences": neighbours.plot_mean_differences(group(deviations, "neighbours"), position),
        "chart": neighbours.plot_reference_chart(group(deviations, "chart"), position),
        "windows": readings.plot_windows(group(deviations, "iso")),
        "anomalies": drift.plot_position_scatter(joint, position, flagged),
    }


def _correlation_charts(fused: xr.DataTree, channel: str) -> dict[str, Chart]:
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
        charts |= {f"mode_{mode}": attribution.plot_mode(modes, int(mode), channel) for mode in modes["mode"].values}
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
    return charts


def _embed_maps(fields: xr.Dataset, results: Results) -> dict[str, Any]:
    """Return the interactive map of the table: per-cycle fields as 16-bit numbers with offset and step, in JSON."""
    kept, note = _thin(fields[[variable for _, variable, _ in _LAYERS]])
    x, y = kept["x"].values, kept["y"].values
    half = float(np.median(np.diff(x))) / 2
    layers = {name: _layer(name, kept[variable].values, unit) for name, variable, unit in _LAYERS}
    content = {
        "nx": x.size, "ny": y.size,
        "x0": x[0] - half, "x1": x[-1] + half, "y0": y[0] - half, "y1": y[-1] + half,
        "cycles": [f"cycle {cycle}" for cycle in kept["cycle"].values],
        "layers": layers,
        "line": _line(fields),
        "hotspots": [{"x_mm": spot.x_mm, "y_mm": spot.y_mm} for spot in results.hotspots or ()],
    }  # fmt: skip
    text = json.dumps(content, default=float).replace("</", "<\\/")
    return {"entries": [{"json": text, "layers": list(layers), "count": kept.sizes["cycle"]}], "note": note}


def _thin(fields: xr.Dataset) -> tuple[xr.Dataset, str]:
    """Return the fields within the budget: every n-th cycle, then averages of blocks of cells; and the sentence that says so."""
    cells, cycles = fields.sizes["x"] * fields.sizes["y"], fields.sizes["cycle"]
    note = []
    block = int(np.ceil(np.sqrt(max(1.0, cells * len(_LAYERS) * min(cycles, 25) / _MAP_BUDGET))))
    if block > 1:
        fields = fields.coarsen(x=block, y=block, boundary="trim").mean()
        note.append(f"The map shows means of {block} × {block} cells")
    every = int(np.ceil(fields.sizes["x"] * fields.sizes["y"] * len(_LAYERS) * cycles / _MAP_BUDGET))
    if every > 1:
        chosen = sorted({*range(0, cycles, every), cycles - 1})
        fields = fields.isel(cycle=chosen)
        note.append(f"{len(chosen)} of {cycles} cycles")
    return fields, f"{', '.join(note)}; fields.nc holds all." if note else ""


def _layer(name: str, values: np.ndarray, unit: str) -> dict[str, Any]:
    """Return one quantity as 16-bit numbers in base64, with the range and palette that show it."""
    import matplotlib as mpl

    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    step = max((high - low) / 60000.0, 1e-6)
    stored = np.where(np.isfinite(values), np.round((values - low) / step) - 30000, _MISSING).astype("<i2")
    palette = np.round(mpl.colormaps["inferno"](np.arange(256))[:, :3] * 255).astype(int)
    return {
        "name": name, "unit": unit, "offset": low + 30000 * step, "step": step,
        "low": float(np.nanpercentile(values, 0.1)), "high": float(np.nanpercentile(values, 99.9)),
        "palette": palette.tolist(), "values": base64.b64encode(stored.tobytes()).decode(),
    }  # fmt: skip


def _line(fields: xr.Dataset) -> list[list[float]]:
    """Return the plan points of the targets along the measured line; none where no laser measured."""
    if "target_x" not in fields:
        return []
    return np.stack([fields["target_x"].values, fields["target_y"].values], axis=1).tolist()
