"""Charts of the axis: their numbers are those of the products, intervals are k = 2, missing values are gaps."""

import html

import numpy as np
import pytest
import xarray as xr

from fusion.report.charts import readings as neighbours
from fusion.report.charts.readings import (
    plot_cycles,
    plot_drift,
    plot_position_scatter,
    plot_profile,
    plot_reversal,
    plot_test,
    plot_windows,
)
from fusion.report.charts.style import Courses, literal, new_figure
from fusion.results.numbers import number
from fusion.results.store import group
from interferometry.iso230 import evaluate_iso230
from tests.fusion.report.charts.conftest import parts_of
from tests.interferometry.iso230.made_tests import by_hand, test_made


@pytest.fixture
def still_readings():
    """Group drift and deviations of 3 cycles and 2 targets (at 100 and 0 mm): the drift is the cycle at 100 mm and half of it at 0."""
    cycle, target, direction = [1, 2, 3], [1, 2], ["positive", "negative"]
    value = np.broadcast_to(np.array([0.0, 1.0, 2.0])[:, None, None] * np.array([1.0, 0.5]), (3, 2, 2))
    dims = ("cycle", "direction", "target")
    start = np.datetime64("2026-03-09T06:00", "ns")
    time = start + (np.arange(3)[:, None, None] * np.timedelta64(60, "m")) + np.zeros((3, 2, 2), "timedelta64[ns]")
    coords = {"cycle": cycle, "direction": direction, "target": target}
    drift = xr.Dataset(
        {
            "drift_since_first": (dims, value),
            "drift_since_first_u": (dims, np.full((3, 2, 2), 0.1)),
            "profile": (("direction", "target"), [[4.0, 0.0], [3.0, -1.0]]),
            "profile_u": (("direction", "target"), np.full((2, 2), 0.25)),
        },
        coords,
    )
    deviations = xr.Dataset({"time": (dims, time), "position": (("target",), [100.0, 0.0])}, coords)
    return drift, deviations


def test_drift_of_every_position(still_readings):
    chart = plot_drift(*still_readings)
    (lines,) = [r for r in chart.figure.renderers if "order" in r.data_source.data]
    assert lines.data_source.data["order"].tolist() == [0.0, 100.0]
    assert [line.tolist() for line in lines.data_source.data["ys"]] == [[0.0, 0.5, 1.0], [0.0, 1.0, 2.0]]
    assert lines.data_source.data["xs"][0].tolist() == [0.0, 1.0, 2.0]
    assert chart.figure.yaxis.axis_label == "drift / µm"
    assert all(part in chart.seen for part in ("2 positions", "2.0 h: 0.00 to 2.00 µm", "by 1.5 µm", "at 100 mm"))
    assert chart.columns["cycle"].tolist() == [1, 1, 2, 2, 3, 3]
    np.testing.assert_allclose(chart.columns["95 % band ± / µm"], 0.2)


def test_a_first_cycle_and_a_position_without_drift_are_left_out_of_the_sentence(still_readings):
    drift, deviations = (one.copy(deep=True) for one in still_readings)
    drift["drift_since_first"][{"cycle": 0}] = np.nan
    drift["drift_since_first"][{"target": 1}] = np.nan
    mean = drift["drift_since_first"].mean("direction")
    change = float((mean.isel(cycle=-1) - mean.isel(cycle=1)).mean())
    assert f"it changes by {number(change, 2)} µm on average" in plot_drift(drift, deviations).seen


def test_profile_with_its_band(still_readings):
    drift, deviations = still_readings
    chart = plot_profile(drift, deviations["position"])
    points = [r for r in chart.figure.renderers if "half" in r.data_source.data]
    points = points[::2]  # each interval shares the source of its marks
    assert points[0].data_source.data["y"].tolist() == [0.0, 4.0]
    assert points[0].data_source.data["half"].tolist() == [0.5, 0.5]
    assert list(chart.columns)[1] == "profile, positive approach / µm"
    assert "positive approach 0.00 to 4.00 µm; negative approach −1.00 to 3.00 µm." in chart.seen


def test_reversal_and_scatter_of_a_campaign(deviations):
    drift, position = group(deviations, "estimate"), deviations["position"]
    chart = plot_reversal(drift, position)
    np.testing.assert_array_equal(chart.columns["reversal / µm"], drift["reversal"])
    assert chart.figure.yaxis.axis_label == "positive − negative / µm"
    chart = plot_position_scatter(drift, position, {2, 5})
    shades = sorted(shade.left for shade in parts_of(chart.figure, "BoxAnnotation"))
    assert shades == [30.0, 180.0]
    assert chart.seen.endswith("marked as standing out: 50 mm and 200 mm.")
    assert plot_position_scatter(drift, position, set()).seen.endswith("none is marked as standing out.")


def test_both_approaches_have_one_scale_and_every_cycle_a_line(deviations):
    charts = [plot_cycles(deviations, side) for side in ("positive", "negative")]
    ends = {(chart.figure.y_range.start, chart.figure.y_range.end) for chart in charts}
    assert len(ends) == 1
    lines = charts[1].figure.renderers[1].data_source.data
    assert lines["order"].tolist() == deviations["cycle"].values.tolist()
    first = deviations["deviation"].sel(direction="negative").isel(cycle=0)
    np.testing.assert_array_equal(lines["ys"][0], first)
    assert charts[0].seen.startswith("Deviation of 24 cycles, positive approach: ")
    assert len(charts[0].columns["deviation / µm"]) == 24 * 6


def test_windows_beside_the_whole_test(deviations):
    windows = group(deviations, "iso")
    chart = plot_windows(windows)
    np.testing.assert_array_equal(chart.columns["A / µm"], windows["A"][:-1])
    np.testing.assert_allclose(chart.columns["U(R), k = 2 / µm"], 2 * windows["R_u"][:-1])
    whole = [r.glyph.y for r in chart.figure.renderers if r.glyph.kind == "HSpan"]
    assert whole == pytest.approx([float(windows[name][-1]) for name in "ARB"])
    assert chart.figure.y_range.start == 0.0


def test_neighbours_side_by_side_with_sign_and_borders(deviations):
    comparison = group(deviations, "comparison")
    chart = neighbours.plot_scatter_comparison(comparison, deviations["position"])
    assert chart.figure.yaxis.axis_label == "standard deviation / µm (logarithmic)"
    assert chart.columns["position / mm"].tolist() == [50.0, 100.0, 150.0, 200.0, 250.0]
    expected = comparison["differenced"].sel(direction="negative")
    np.testing.assert_array_equal(chart.columns["s of the differences, negative approach / µm"], expected)
    links = group(deviations, "neighbours")
    chart = neighbours.plot_mean_differences(links, deviations["position"])
    assert chart.figure.yaxis.axis_label == "nearer − further position, mean / µm"
    read = deviations["deviation"].sel(direction="positive")
    by_hand = (read.sel(target=1) - read.sel(target=2)).mean("cycle")
    np.testing.assert_allclose(chart.columns["nearer − further, positive approach / µm"][0], by_hand)
    assert (chart.columns["nearer position / mm"][0], chart.columns["further position / mm"][0]) == (0.0, 50.0)
    found = group(deviations, "chart")
    chart = neighbours.plot_reference_chart(found, deviations["position"])
    for heading, name in (
        ("deviation, positive approach / µm", "chart"),
        ("border ±, positive approach / µm", "border_s"),
    ):
        np.testing.assert_array_equal(chart.columns[heading], found[name].sel(direction="positive"))
    assert "Deviation from the reference at 0 mm" in chart.seen


def test_means_and_spans_are_those_of_the_readings():
    x = np.random.default_rng(5).normal(0, 1, (5, 2, 6)) + 3.0 * np.arange(6)
    test = test_made(x)
    chart = plot_test(evaluate_iso230(test), test["position"])
    np.testing.assert_allclose(chart.columns["mean, positive approach / \u00b5m"], x[:, 0].mean(axis=0))
    np.testing.assert_allclose(chart.columns["s, negative approach / \u00b5m"], x[:, 1].std(axis=0, ddof=1))
    true = by_hand(x)
    texts = {label.text for label in parts_of(chart.figure, "Label")}
    assert texts == {f"{symbol} {number(true[symbol])}" for symbol in "AEB"}
    assert chart.seen.startswith("Mean deviation over 0.00 to 50.00 mm of the axis with \u00b12 s: positive approach ")


def test_one_cycle_of_a_rotary_axis_has_its_readings_and_units():
    test = test_made(np.arange(12.0).reshape(1, 2, 6))
    test["deviation"].attrs["units"], test["position"].attrs["units"] = "arcsec", "deg"
    chart = plot_test(evaluate_iso230(test), test["position"])
    assert chart.columns["mean, negative approach / arcsec"] == pytest.approx(np.arange(6.0, 12.0))
    assert {label.text for label in parts_of(chart.figure, "Label")} == {"E 11.0", "B 6.00"}
    assert "0.00 to 50.00 deg" in chart.seen and "µm" not in chart.seen


def test_the_labels_of_both_spans_stand_apart():
    test = test_made(np.random.default_rng(5).normal(0, 0.1, (5, 2, 6)) + 3.0 * np.arange(6))
    chart = plot_test(evaluate_iso230(test), test["position"])
    labels = {label.text[0]: label for label in parts_of(chart.figure, "Label")}
    # Text of 12 px is a fifteenth of the chart's height.
    assert labels["E"].y - labels["A"].y > 15.0 / 15
    assert labels["A"].x < labels["E"].x


@pytest.mark.parametrize("name", ["@y", "$x", "@{y}{0.0}", "<b>T</b>", "a & b", "'q' \"q\"", "Größe"])
def test_a_name_under_the_pointer_is_neither_a_field_nor_markup(name):
    """Bokeh replaces what stands after @ and $ and reads the rest as HTML."""
    shown = literal(name)
    assert not set("@$<>") & set(shown) and html.unescape(shown) == name


def test_columns_to_download_stay_two_where_names_make_their_headings_alike():
    courses = Courses(new_figure(x="time / h", y="rise / µm"))
    for value in (1.0, 2.0, 3.0):
        courses.add(np.zeros(2), np.full(2, value), "a", colour="black")
    assert [values[0] for values in courses.columns.values()] == [1.0, 2.0, 3.0]
