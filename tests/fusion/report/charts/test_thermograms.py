"""Charts of a camera that measures alone: the scale ends with the calibrated range, and no limit is drawn as a temperature."""

import json

import numpy as np
import pytest
import xarray as xr

from fusion.report.charts.campaign import plot_regions, plot_thermogram
from fusion.report.charts.plan import BEYOND
from tests.fusion.report.charts.conftest import parts_of


@pytest.fixture
def thermograms():
    """Five pictures of 40 by 60 pixels; in two of them the middle is above the limit of 300 degC."""
    row, column = np.mgrid[0:40, 0:60]
    values = 20.0 + 380.0 * np.exp(-((row - 20) ** 2 + (column - 30) ** 2) / 50.0)
    times = np.datetime64("2026-01-01", "ns") + 10 * np.arange(5) * np.timedelta64(10**9, "ns")
    of_region = {
        "maximum": [[100.0], [200.0], [300.0], [300.0], [250.0]], "mean": [[30.0]] * 5, "overrange": [[0], [0], [4], [9], [0]],
    }  # fmt: skip
    return xr.Dataset(
        {
            "thermogram": (("row", "column"), values),
            "flag": (("row", "column"), (values > 300.0).astype(np.uint8)),
            **{name: (("time", "region"), given) for name, given in of_region.items()},
        },
        {"time": times, "region": ["whole picture"]},
        {"outlines": json.dumps([]), "hottest": "a.jpg"},
    )


def test_the_scale_ends_with_the_calibrated_range(thermograms):
    chart = plot_thermogram(thermograms)
    (bar,) = parts_of(chart.figure, "ColorBar")
    calibrated = thermograms["thermogram"].where(thermograms["flag"] == 0)
    assert bar.color_mapper.high == pytest.approx(float(calibrated.max())) and bar.color_mapper.high <= 300.0
    assert bar.color_mapper.high_color == BEYOND
    within = plot_thermogram(thermograms.assign(flag=0 * thermograms["flag"]))
    (bar,) = parts_of(within.figure, "ColorBar")
    assert bar.color_mapper.high > 300.0 and "high_color" not in bar.color_mapper.properties


def test_a_mark_at_the_rim_is_whole(thermograms):
    drawn = plot_thermogram(thermograms).figure
    assert drawn.x_range.start < -1 and drawn.x_range.end > 60 and drawn.y_range.end < -1


def test_what_is_above_the_range_is_marked_and_no_part_of_the_curve(thermograms):
    chart = plot_regions(thermograms)
    marks = {one.glyph.marker: one.data_source.data for one in chart.figure.renderers if one.glyph.kind == "Scatter"}
    assert marks["triangle"]["x"].tolist() == [20.0, 30.0] and marks["triangle"]["y"].tolist() == [300.0, 300.0]
    curve = next(one.data_source.data["y"] for one in chart.figure.renderers if one.glyph.kind == "Line")
    np.testing.assert_array_equal(np.isnan(curve), [False, False, True, True, False])
    assert "and above" in chart.seen
    assert len(plot_regions(thermograms.assign(overrange=0 * thermograms["overrange"])).figure.legend.items) == 2
