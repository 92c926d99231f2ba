"""Charts of a record show measured and predicted displacements, drivers in their own unit; the hold-out is shaded."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from bokeh.models import BoxAnnotation

from fusion.report.charts import record as charts


@pytest.fixture
def record() -> xr.Dataset:
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(10) * np.timedelta64(1, "h")
    both, rng = ("time", "channel"), np.random.default_rng(3)
    return xr.Dataset(
        {
            "displacement": (both, rng.normal(size=(10, 1))),
            "predicted_declared": (both, rng.normal(size=(10, 1))),
            "predicted_final": (both, rng.normal(size=(10, 1))),
            "predicted_u": ("channel", [0.1]),
            "contribution": (("effect", *both), rng.normal(size=(2, 10, 1))),
            "temperature": (("time", "sensor"), np.outer(np.arange(10.0), np.arange(1.0, 7.0))),
            "driver": (("time", "driver_name"), np.linspace(0.0, 1.0, 10)[:, None]),
            "driver_size": ("driver_name", [3000.0]),
            "driver_units": ("driver_name", np.array(["1/min"], dtype=object)),
            "sealed": ("time", np.arange(10) >= 8),
        },
        coords={
            "time": time,
            "channel": ["X"],
            "sensor": [f"t{k}" for k in range(6)],
            "driver_name": ["speed"],
            "effect": ["a_b", "c"],
        },
    )


def test_the_prediction_stands_beside_the_measurement(record: xr.Dataset) -> None:
    chart = charts.plot_prediction(record, "X")
    np.testing.assert_array_equal(chart.columns["measured / µm"], record["displacement"].sel(channel="X"))
    (shade,) = chart.figure.select(BoxAnnotation)
    assert (shade.left, shade.right) == (8.0, 9.0)


def test_the_band_is_of_the_fit_and_in_the_hold_out_of_the_prediction(record: xr.Dataset) -> None:
    band = charts.plot_prediction(record, "X").columns["95 % band ± / µm"]
    missed = (record["displacement"] - record["predicted_final"]).values[:8]
    np.testing.assert_allclose(band[:8], 2 * np.sqrt(np.mean(missed**2)))
    np.testing.assert_allclose(band[8:], 0.2)


def test_residuals_and_contributions(record: xr.Dataset) -> None:
    columns = charts.plot_residuals(record, "X").columns
    expected = (record["displacement"] - record["predicted_final"]).sel(channel="X")
    np.testing.assert_allclose(columns["measured − final model / µm"], expected)
    assert list(charts.plot_contributions(record, "X").columns)[1:] == ["a b / µm", "c / µm"]


def test_only_the_sensors_that_move_most_have_a_colour_of_their_own(record: xr.Dataset) -> None:
    chart = charts.plot_temperatures(record)
    names = [item.label.value for item in chart.figure.legend[0].items]
    assert names == ["other sensors", "t5", "t4", "t3", "t2"]
    assert "those that move most are t5, t4, t3 and t2" in chart.seen


def test_a_driver_is_in_its_own_unit(record: xr.Dataset) -> None:
    chart = charts.plot_drivers(record)
    assert chart.figure.yaxis.axis_label == "speed / 1/min"
    np.testing.assert_allclose(chart.columns["speed / 1/min"][-1], 3000.0)
    two = xr.concat([record, record.assign_coords(driver_name=["load"])], "driver_name", data_vars="minimal")
    both = charts.plot_drivers(two)
    assert len(both.figure.children) == 2


def test_runs_that_are_held_out_are_shaded_each(record: xr.Dataset) -> None:
    runs = record.assign(run=("time", [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]), elapsed=("time", np.arange(10) * 3600.0))
    runs["sealed"] = ("time", np.isin(runs["run"], [2, 5]))
    shades = list(charts.plot_residuals(runs, "X").figure.select(BoxAnnotation))
    assert sorted((shade.left, shade.right) for shade in shades) == [(2.0, 3.0), (8.0, 9.0)]
