"""Charts of a campaign in two parts: what was measured can be drawn before anything is modelled."""

from __future__ import annotations

from pathlib import Path

from fusion.products.contracts import read_fusion, read_product
from fusion.products.results import read_results
from fusion.report.charts.campaign import draw_campaign, draw_found, draw_measured


def test_each_chart_is_drawn_once_and_together_they_are_all(results_folder: Path) -> None:
    results = read_results(results_folder)
    fields, deviations = (read_product(results_folder, name) for name in ("fields", "deviations"))
    datasets = {"fields": fields, "deviations": deviations, "fusion": read_fusion(results_folder)}
    measured, found = draw_measured(fields, deviations), draw_found(results, datasets)
    assert not set(measured.charts) & set(found.charts)
    assert {"rise_history", "registration", "drift_map", "iso230"} <= set(measured.charts)
    assert {"thermal_map", "anomalies", "contributions", "timeline"} <= set(found.charts)
    both = draw_campaign(results, datasets)
    assert list(both.charts) == [*measured.charts, *found.charts]
    assert both.thermal_map == found.thermal_map and both.thermal_map is not None


def test_an_instrument_that_is_not_there_has_no_charts(results_folder: Path) -> None:
    deviations = read_product(results_folder, "deviations")
    assert "rise_history" not in draw_measured(None, deviations).charts
    assert draw_measured(None, None).charts == {}
