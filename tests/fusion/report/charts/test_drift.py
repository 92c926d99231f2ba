"""Drift and profile: the lines are the numbers of the products, the text says what is seen."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from bokeh.models import BoxAnnotation

from fusion.products.grouped import group
from fusion.report.charts.drift import (
    plot_deviation_map,
    plot_drift,
    plot_drift_map,
    plot_position_scatter,
    plot_profile,
    plot_reversal,
)
from fusion.report.wording import number


@pytest.fixture
def readings() -> tuple[xr.Dataset, xr.Dataset]:
    """Group drift and deviations of 3 cycles and 2 targets (at 100 and 0 mm): the drift is the cycle at 100 mm and half of it at 0."""
    cycle, target, direction = [1, 2, 3], [1, 2], ["positive", "negative"]
    value = np.broadcast_to(np.array([0.0, 1.0, 2.0])[:, None, None] * np.array([1.0, 0.5]), (3, 2, 2))
    dims = ("cycle", "direction", "target")
    start = np.datetime64("2026-03-09T06:00", "ns")
    time = start + (np.arange(3)[:, None, None] * np.timedelta64(60, "m")) + np.zeros((3, 2, 2), "timedelta64[ns]")
    coords = {"cycle": cycle, "direction": direction, "target": target}
    drift = xr.Dataset(
        {
            "drift": (dims, value),
            "drift_u": (dims, np.full((3, 2, 2), 0.1)),
            "profile": (("direction", "target"), [[4.0, 0.0], [3.0, -1.0]]),
            "profile_u": (("direction", "target"), np.full((2, 2), 0.25)),
        },
        coords,
    )
    deviations = xr.Dataset({"time": (dims, time), "position": (("target",), [100.0, 0.0])}, coords)
    return drift, deviations


def test_drift_of_every_position(readings: tuple[xr.Dataset, xr.Dataset]) -> None:
    chart = plot_drift(*readings)
    (lines,) = [r for r in chart.figure.renderers if "order" in r.data_source.data]
    assert lines.data_source.data["order"].tolist() == [0.0, 100.0]
    assert [line.tolist() for line in lines.data_source.data["ys"]] == [[0.0, 0.5, 1.0], [0.0, 1.0, 2.0]]
    assert lines.data_source.data["xs"][0].tolist() == [0.0, 1.0, 2.0]
    assert chart.figure.yaxis.axis_label == "drift / µm"
    assert chart.seen == (
        "Drift of 2 positions over 2.0 h: 0.00 to 2.00 µm; from the first to the last cycle it changes by 1.5 µm on average, "
        "and the largest drift is at 100 mm."
    )
    assert chart.columns["cycle"].tolist() == [1, 1, 2, 2, 3, 3]
    np.testing.assert_allclose(chart.columns["95 % band ± / µm"], 0.2)


def test_a_first_cycle_and_a_position_without_drift_are_left_out_of_the_sentence(
    readings: tuple[xr.Dataset, xr.Dataset],
) -> None:
    drift, deviations = (one.copy(deep=True) for one in readings)
    drift["drift"][{"cycle": 0}] = np.nan
    drift["drift"][{"target": 1}] = np.nan
    mean = drift["drift"].mean("direction")
    change = float((mean.isel(cycle=-1) - mean.isel(cycle=1)).mean())
    assert f"it changes by {number(change, 2)} µm on average" in plot_drift(drift, deviations).seen


def test_profile_with_its_band(readings: tuple[xr.Dataset, xr.Dataset]) -> None:
    drift, deviations = readings
    chart = plot_profile(drift, deviations["position"])
    points = [r for r in chart.figure.renderers if "half" in r.data_source.data]
    points = points[::2]  # each interval shares the source of its marks
    assert points[0].data_source.data["y"].tolist() == [0.0, 4.0]
    assert points[0].data_source.data["half"].tolist() == [0.5, 0.5]
    assert list(chart.columns)[1] == "profile, positive approach / µm"
    assert chart.seen == (
        "Drift-free deviation over 0.00 to 100.00 mm of the axis: positive approach 0.00 to 4.00 µm; "
        "negative approach −1.00 to 3.00 µm."
    )


def test_reversal_and_scatter_of_a_campaign(deviations: xr.Dataset) -> None:
    drift, position = group(deviations, "drift"), deviations["position"]
    chart = plot_reversal(drift, position)
    np.testing.assert_array_equal(chart.columns["reversal / µm"], drift["reversal"])
    assert chart.figure.yaxis.axis_label == "positive − negative / µm"
    chart = plot_position_scatter(drift, position, {2, 5})
    shades = sorted(shade.left for shade in chart.figure.select(BoxAnnotation))
    assert shades == [30.0, 180.0]
    assert chart.seen.endswith("marked as standing out: 50 mm and 200 mm.")
    assert plot_position_scatter(drift, position, set()).seen.endswith("none is marked as standing out.")


def test_a_map_over_cycle_and_position(readings: tuple[xr.Dataset, xr.Dataset], deviations: xr.Dataset) -> None:
    drift, at = readings
    chart = plot_drift_map(drift, at["position"])
    cells = chart.figure.renderers[0].data_source.data
    assert cells["value"].tolist() == [0.0, 0.0, 0.5, 1.0, 1.0, 2.0]
    assert (cells["bottom"][0], cells["top"][0]) == (-50.0, 50.0)
    assert (cells["left"][0], cells["right"][0]) == (0.5, 1.5)
    assert chart.seen == "Drift of 3 cycles at 2 positions: 0.00 to 2.00 µm; the largest size is in cycle 3 at 100 mm."
    mapper = chart.figure.renderers[0].glyph.fill_color.transform
    assert mapper.low == -mapper.high
    about = plot_deviation_map(deviations).columns["deviation from the mean of the position / µm"]
    np.testing.assert_allclose(np.reshape(about, (24, 6)).mean(axis=0), 0.0, atol=1e-12)
