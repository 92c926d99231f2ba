"""Charts of neighbour differences: in mm, with the sign of the difference stated."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.products.grouped import group
from fusion.report.charts import neighbours


def test_standard_deviations_side_by_side(deviations: xr.Dataset) -> None:
    comparison = group(deviations, "comparison")
    chart = neighbours.plot_scatter_comparison(comparison, deviations["position"])
    assert chart.figure.yaxis.axis_label == "standard deviation / µm (logarithmic)"
    assert chart.columns["position / mm"].tolist() == [50.0, 100.0, 150.0, 200.0, 250.0]
    expected = comparison["differenced"].sel(direction="negative")
    np.testing.assert_array_equal(chart.columns["s of the differences, negative approach / µm"], expected)


def test_the_sign_of_the_mean_difference_is_on_its_axis(deviations: xr.Dataset) -> None:
    links = group(deviations, "neighbours")
    chart = neighbours.plot_mean_differences(links, deviations["position"])
    assert chart.figure.yaxis.axis_label == "nearer − further position, mean / µm"
    read = deviations["deviation"].sel(direction="positive")
    by_hand = (read.sel(target=1) - read.sel(target=2)).mean("cycle")
    np.testing.assert_allclose(chart.columns["nearer − further, positive approach / µm"][0], by_hand)
    assert (chart.columns["nearer position / mm"][0], chart.columns["further position / mm"][0]) == (0.0, 50.0)


def test_the_reference_chart_has_its_borders(deviations: xr.Dataset) -> None:
    found = group(deviations, "chart")
    chart = neighbours.plot_reference_chart(found, deviations["position"])
    np.testing.assert_array_equal(
        chart.columns["deviation, positive approach / µm"], found["chart"].sel(direction="positive")
    )
    np.testing.assert_array_equal(
        chart.columns["border ±, positive approach / µm"], found["border_s"].sel(direction="positive")
    )
    assert "Deviation from the reference at 0 mm" in chart.seen
