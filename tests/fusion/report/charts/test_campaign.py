"""Charts of a campaign in parts: what was measured, and where drift and field agree, can be drawn before anything is modelled."""

from __future__ import annotations

from pathlib import Path

from fusion.products.contracts import read_fusion, read_product
from fusion.products.results import read_results
from fusion.report.charts.campaign import draw_attributed, draw_campaign, draw_measured, draw_modelled, draw_placed


def test_each_chart_is_drawn_once_and_together_they_are_all(results_folder: Path) -> None:
    results = read_results(results_folder)
    fields, deviations = (read_product(results_folder, name) for name in ("fields", "deviations"))
    fused = read_fusion(results_folder)
    datasets = {"fields": fields, "deviations": deviations, "fusion": fused}
    assert results.correlation is not None
    source = results.correlation.source
    root, standing_out = fused.to_dataset(), {one.target for one in results.anomalies or ()}
    parts = [
        draw_measured(fields, deviations, root),
        draw_attributed(fused, source.part, results.correlation.least_p),
        draw_modelled(deviations, root, standing_out),
        draw_placed(results, fields, deviations["position"], None),
    ]
    measured, attributed, modelled, placed = (set(part.charts) for part in parts)
    assert len(measured | attributed | modelled | placed) == sum(len(part.charts) for part in parts)
    assert {"rise_history", "registration", "drift_map", "iso230", "timeline", "drift_temperature"} <= measured
    assert {"clusters", "region_targets"} <= attributed
    assert {"history", "anomalies", "contributions"} <= modelled
    assert placed == {"thermal_map"}
    both = draw_campaign(results, datasets)
    assert list(both.charts) == [name for part in parts for name in part.charts]
    assert both.thermal_map == parts[-1].thermal_map and both.thermal_map is not None


def test_an_instrument_that_is_not_there_has_no_charts(results_folder: Path) -> None:
    deviations = read_product(results_folder, "deviations")
    assert "rise_history" not in draw_measured(None, deviations).charts
    assert draw_measured(None, None).charts == {}
