"""Maps of the attribution: steps of significance, no colour where nothing is significant, labels that can be read."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.report.charts import attribution


def picture(chart: attribution.Chart) -> np.ndarray:
    (cells,) = [r for r in chart.figure.renderers if type(r.glyph).__name__ == "Image"]
    return cells.data_source.data["image"][0]


def test_significance_has_four_steps(plan_of_cells: xr.Dataset) -> None:
    chart = attribution.plot_significance(plan_of_cells, "common")
    np.testing.assert_array_equal(picture(chart), [[0.5, 1.5, 2.5], [np.nan] * 3])
    assert chart.seen == ("2 of 6 cells are significant at 0.05; the strongest is at x 5 mm, y 5 mm (p 0.005).")
    assert chart.figure.title.text == "drift common to all positions"


def test_sensitivity_is_blank_where_it_is_not_significant(plan_of_cells: xr.Dataset) -> None:
    chart = attribution.plot_sensitivity(plan_of_cells, "common")
    np.testing.assert_allclose(picture(chart), [[0.5, 3.0, np.nan], [np.nan] * 3])
    assert chart.figure.legend[0].items[0].label.value == "not significant (p > 0.05)"
    assert "sensitivity 0.50 to 3.00 µm/K" in chart.seen
    assert chart.columns["sensitivity / (µm/K)"].size == 6


def test_nothing_significant_is_said(plan_of_cells: xr.Dataset) -> None:
    none = plan_of_cells.assign(p_value=plan_of_cells["p_value"] * 0 + 0.4)
    assert attribution.plot_significance(none, "common").seen.startswith("No cell of 6 is significant at 0.05")


def test_modes_clusters_and_regions_of_a_campaign(fused: xr.DataTree) -> None:
    maps = fused.children["correlation"]
    modes = maps.children["modes"].to_dataset()
    chart = attribution.plot_mode(modes, 1, "common")
    np.testing.assert_allclose(picture(chart), modes["pattern"].sel(mode=1), rtol=1e-6)
    assert chart.figure.title.text.startswith("mode 1: ")
    clusters = maps.children["clusters"].to_dataset()
    chart = attribution.plot_clusters(clusters)
    shown = next(r for r in chart.figure.renderers if type(r.glyph).__name__ == "Text").data_source.data
    points = np.column_stack([shown["x"], shown["y"]])
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(len(points)) * 1e9
    assert apart.min() >= 22.0
    assert chart.seen.startswith(f"{int(clusters['cluster'].max())} groups of cells")
    if "target_regions" in maps.children:
        targets = maps.children["target_regions"].to_dataset()
        region = str(targets["region"].values[0])
        chart = attribution.plot_region_targets(targets, region, fused.to_dataset()["position"])
        np.testing.assert_allclose(chart.columns["sensitivity / (µm/K)"], targets["sensitivity"].sel(region=region))


def test_a_rate_carries_its_own_uncertainty() -> None:
    # Binomial: sqrt(0.05 * 0.95 / 200) = 1.54 %, and twice that is stated.
    assert attribution.rate_text(0.05, checks=200) == "5.0 ± 3.1 %"


def test_the_caption_states_false_alarms_and_detection_limit(fused: xr.DataTree) -> None:
    text = attribution.caption_of(fused.children["correlation"], "common")
    assert text.startswith("False alarms of this map, in simulations without a source: ")
    assert "Detection limit at 80 % power: " in text
