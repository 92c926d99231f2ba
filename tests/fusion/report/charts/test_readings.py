"""Charts of the readings show the numbers of the products, both approaches on one scale."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.products.grouped import group
from fusion.report.charts.readings import plot_cycles, plot_history, plot_windows


def test_both_approaches_have_one_scale_and_every_cycle_a_line(deviations: xr.Dataset) -> None:
    charts = [plot_cycles(deviations, side) for side in ("positive", "negative")]
    ends = {(chart.figure.y_range.start, chart.figure.y_range.end) for chart in charts}
    assert len(ends) == 1
    lines = charts[1].figure.renderers[0].data_source.data
    assert lines["order"].tolist() == deviations["cycle"].values.tolist()
    first = deviations["deviation"].sel(direction="negative").isel(cycle=0)
    np.testing.assert_array_equal(lines["ys"][0], first)
    assert charts[0].seen.startswith("Deviation of 24 cycles, positive approach: ")
    assert len(charts[0].columns["deviation / µm"]) == 24 * 6


def test_the_history_holds_readings_and_the_line_through_them(deviations: xr.Dataset) -> None:
    drift = group(deviations, "drift")
    chart = plot_history(deviations, drift, 2)
    read = deviations["deviation"].sel(target=2, direction="positive")
    np.testing.assert_array_equal(chart.columns["deviation, positive approach / µm"], read)
    noise = drift["noise"].sel(target=2, direction="positive")
    np.testing.assert_allclose(chart.columns["profile and drift, positive approach / µm"], read - noise)
    assert chart.figure.title.text == f"position 2 ({float(deviations['position'].sel(target=2)):g} mm)"


def test_windows_beside_the_whole_test(deviations: xr.Dataset) -> None:
    windows = group(deviations, "iso")
    chart = plot_windows(windows)
    np.testing.assert_array_equal(chart.columns["A / µm"], windows["A"][:-1])
    np.testing.assert_allclose(chart.columns["U(R), k = 2 / µm"], 2 * windows["R_u"][:-1])
    whole = [r.glyph.y for r in chart.figure.renderers if type(r.glyph).__name__ == "HSpan"]
    assert whole == pytest.approx([float(windows[name][-1]) for name in "ARB"])
    assert chart.figure.y_range.start == 0.0
