"""report.html: one self-contained file, made from the products alone."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from fusion.products.grouped import group, has
from fusion.products.results import Results
from fusion.report import plots_attribution, plots_model, plots_plan, record_section, summary_section
from fusion.report.attribution_section import leading_region
from fusion.report.charts.drift import plot_drift, plot_profile
from fusion.report.charts.style import Chart
from fusion.report.page import render_page
from interferometry import figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
            {},
            results=results,
            provenance=provenance,
            summary=record_section.describe_record(results, provenance, datasets["record"]),
            drawings={
                name: _svg_text(draw, name) for name, draw in record_section.draw_record(datasets["record"]).items()
            },
        )
    return render_page(
        "report.html.j2",
        _draw_charts(datasets),
        results=results,
        provenance=provenance,
        summary=summary_section.describe_campaign(results, provenance, datasets, joint),
        drawings=_draw_figures(results, datasets),
        maps=_embed_maps(datasets["fields"], results) if "fields" in datasets else None,
    )


def _draw_charts(datasets: Mapping[str, Any]) -> dict[str, Chart]:
    """Return every chart that the data allow, by name."""
    charts: dict[str, Chart] = {}
    if "deviations" in datasets:
        deviations = datasets["deviations"]
        drift = group(deviations, "drift")
        charts["drift"] = plot_drift(drift, deviations)
        charts["profile"] = plot_profile(drift, deviations["position"])
    return charts


def _draw_figures(results: Results, datasets: Mapping[str, Any]) -> dict[str, str]:
    """Return every figure that the data allow, by name, as SVG text."""
    charts: dict[str, Callable[[], Axes]] = {}
    if "fields" in datasets:
        fields = datasets["fields"]
        charts["registration"] = lambda: plots_plan.plot_registration(fields)
        charts["rise_history"] = lambda: plots_plan.plot_rise_history(fields)
    if "deviations" in datasets:
        charts |= _drift_charts(results, datasets["deviations"])
    fused = datasets.get("fusion")
    if fused is not None and results.correlation is not None and "correlation" in fused.children:
        charts |= _correlation_charts(fused, results.correlation.source.part)
    if fused is not None and has(fused.to_dataset(), "loop") and "deviations" in datasets:
        loop, deviations = group(fused.to_dataset(), "loop"), datasets["deviations"]
        charts["residual_time"] = lambda: plots_model.plot_residual_time(loop, deviations)
        charts["residual_position"] = lambda: plots_model.plot_residual_position(loop, deviations)
        charts["residual_direction"] = lambda: plots_model.plot_residual_direction(loop, deviations)
        charts["residual_spectrum"] = lambda: plots_model.plot_residual_spectrum(loop)
        charts["residual_events"] = lambda: plots_model.plot_residual_events(loop, deviations)
        charts["contributions"] = lambda: plots_model.plot_contributions(loop, deviations)
    return {name: _svg_text(draw, name) for name, draw in charts.items()}


def _drift_charts(results: Results, deviations: xr.Dataset) -> dict[str, Callable[[], Axes]]:
    """The charts that need the readings alone."""
    drift, chart, position = group(deviations, "drift"), group(deviations, "chart"), deviations["position"]
    flagged = {anomaly.target for anomaly in results.anomalies or ()}
    shown = min(flagged, default=int(deviations["target"][min(3, deviations.sizes["target"] - 1)]))
    return {
        "deviations_positive": lambda: figures.plot_deviation_chart(deviations, direction="positive"),
        "deviations_negative": lambda: figures.plot_deviation_chart(deviations, direction="negative"),
        "common_start": lambda: figures.plot_deviation_chart(figures.evaluate_common_start(deviations)),
        "history": lambda: figures.plot_position_history(
            figures.evaluate_position_history(deviations, target=shown), drift=drift
        ),
        "scatter": lambda: figures.plot_comparison(group(deviations, "comparison")),
        "mean_differences": lambda: figures.plot_mutual_deviations(group(deviations, "neighbours")),
        "chart": lambda: figures.plot_reference_chart(chart.assign(position=position.sel(target=chart["target"]))),
        "windows": lambda: plots_model.plot_windows(group(deviations, "iso")),
        "reversal": lambda: plots_model.plot_reversal(drift, position),
        "anomalies": lambda: plots_model.plot_position_scatter(drift, flagged),
    }


def _correlation_charts(fused: xr.DataTree, channel: str) -> dict[str, Callable[[], Axes]]:
    """The maps of the leading part of the drift, the modes, the clusters, and the leading region by target."""
    maps = fused.children["correlation"]
    cells, position = maps.to_dataset(), fused.to_dataset()["position"]
    charts: dict[str, Callable[[], Axes]] = {
        "sensitivity": lambda: plots_attribution.plot_cells(
            cells, "sensitivity", channel, label="sensitivity / (µm/K)"
        ),
        "significance": lambda: plots_attribution.plot_cells(cells, "p_value", channel, label="family-wise p"),
        "clusters": lambda: plots_attribution.plot_clusters(maps.children["clusters"].to_dataset()),
    }
    if "modes" in maps.children:
        charts["modes"] = lambda: plots_attribution.plot_modes(maps.children["modes"].to_dataset(), channel)
    if "target_regions" in maps.children:
        region, targets = leading_region(maps), maps.children["target_regions"].to_dataset()
        charts["region_targets"] = lambda: plots_attribution.plot_region_targets(targets, region, position)
    return charts


def _svg_text(draw: Callable[[], Axes], name: str) -> str:
    """Return a chart as an SVG element whose identifiers start with `name`, so that several fit into one page."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    with mpl.rc_context({**figures.STYLE, "backend": "Agg"}):
        figure = draw().get_figure(root=True)
        assert figure is not None
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        plt.close(figure)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{name.replace("_", " ")}" ', 1)


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
    palette = np.round(mpl.colormaps[plots_plan.HEAT_MAP](np.arange(256))[:, :3] * 255).astype(int)
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
