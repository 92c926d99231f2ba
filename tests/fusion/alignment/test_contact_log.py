"""Contact sensors as a product: rises since the first common sample, the camera at their places, what is wrong with one."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.contact_log import describe_sensors, join_sensors
from fusion.alignment.sensor_health import Kind, SensorFault
from fusion.report.charts.sensors import plot_sensors

START = np.datetime64("2026-03-09T08:00", "ns")
TIMES = START + 60 * np.arange(10) * np.timedelta64(1, "s")
X, Y = np.array([10.0, 30.0]), np.array([10.0, 10.0])


def logged() -> xr.DataArray:
    """Two sensors that warm by 0.1 and 0.2 K a minute; the second gives nothing at first."""
    values = 20.0 + np.arange(10.0)[:, None] * np.array([0.1, 0.2])
    values[0, 1] = np.nan
    return xr.DataArray(values, {"time": TIMES, "sensor": ["t1", "t2"]}, ("time", "sensor"))


def fields() -> xr.Dataset:
    """A plan of two cells from the third minute on, 0.1 K a minute in both."""
    frames = 25.0 + 0.1 * np.arange(7.0)[:, None, None] * np.ones((1, 1, 2))
    return xr.Dataset(
        {"frame_temperature": (("time", "y", "x"), frames)}, {"time": TIMES[3:], "y": [10.0], "x": [10.0, 30.0]}
    )


def test_without_a_camera_a_rise_counts_from_the_first_reading() -> None:
    first, second = describe_sensors(join_sensors(logged(), X, Y, (), None), file="t.csv")
    assert first["rise_K"] == pytest.approx(0.9) and second["rise_K"] == pytest.approx(1.6)
    assert first["camera_rise_K"] is None and first["used"] and first["fault"] == "" and first["fault_time"] is None


def test_beside_a_camera_both_rises_count_from_the_first_common_sample() -> None:
    first, second = describe_sensors(join_sensors(logged(), X, Y, (), fields()), file="t.csv")
    assert (first["rise_K"], first["camera_rise_K"]) == (pytest.approx(0.6), pytest.approx(0.6))
    assert (second["rise_K"], second["camera_rise_K"]) == (pytest.approx(1.2), pytest.approx(0.6))


def test_a_faulty_sensor_is_shown_up_to_its_fault() -> None:
    fault = SensorFault(1, Kind.JUMP, True, 300.0, 10.0, 5.0)
    joined = join_sensors(logged(), X, Y, (fault,), None)
    _, second = describe_sensors(joined, file="t.csv")
    # The last sample before the fault is that of minute 4, three minutes after the sensor's first.
    assert not second["used"] and second["rise_K"] == pytest.approx(0.6)
    assert second["fault"].startswith("jumps by 5 K") and second["fault_time"] == "2026-03-09T08:05:00Z"
    chart = plot_sensors(joined)
    assert "t2 0.60 K" in chart.seen and len(chart.columns["rise / K"]) == 20
