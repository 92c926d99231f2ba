"""The rise along the measured line from contact sensors, against fields that can be integrated by hand."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.align import AlignmentError, AxisGeometry
from fusion.alignment.sensor_line import add_sensor_line

AXIS = AxisGeometry((500.0, 90.0), (-1.0, 0.0))
START = np.datetime64("2026-03-09T08:00", "ns")


def readings() -> xr.Dataset:
    time = START + np.arange(12).reshape(2, 2, 3) * np.timedelta64(60, "s")
    return xr.Dataset(
        {"time": (("cycle", "direction", "target"), time), "position": ("target", np.array([0.0, 150.0, 300.0]))}
    )


def sensors(rise_K: np.ndarray) -> xr.DataArray:
    """Two samples: 20 degC everywhere, then risen."""
    times = START + np.array([0, 660]) * np.timedelta64(1, "s")
    return xr.DataArray(np.stack([np.full(rise_K.size, 20.0), 20.0 + rise_K]), {"time": times}, ("time", "sensor"))


def test_a_rise_that_grows_along_the_axis_is_integrated_exactly() -> None:
    # The plan's x falls as the axis position grows: sensors at axis positions 0, 100 and 300 mm, 0.01 K/mm.
    x = np.array([500.0, 400.0, 200.0])
    fused = add_sensor_line(readings(), sensors(np.array([0.0, 1.0, 3.0])), x, np.full(3, 90.0), AXIS, file="t.csv")
    np.testing.assert_allclose(fused["axis_integral_series"].values[-1], [0.0, 112.5, 450.0], rtol=1e-9)
    assert fused["mean_rise_series"].values.tolist() == [0.0, pytest.approx(4.0 / 3.0)]


def test_what_the_straight_line_misses_is_stated() -> None:
    x, y = np.array([500.0, 350.0, 200.0]), np.full(3, 90.0)
    even = add_sensor_line(readings(), sensors(np.ones(3)), x, y, AXIS, file="t.csv")
    bent = add_sensor_line(readings(), sensors(np.array([1.0, 2.0, 1.0])), x, y, AXIS, file="t.csv")
    assert float(even["interpolation_u"]) == 0.0
    # Each of three sensors is missed by 1 K at the second of two samples.
    assert float(bent["interpolation_u"]) == pytest.approx(np.sqrt(0.5))
    assert float(bent["axis_scale_u"]) == pytest.approx(np.sqrt(0.5) / 1.0)


@pytest.mark.parametrize("x", [[500.0], [500.0, 400.0], [500.0, 500.0]])
def test_sensors_that_do_not_span_half_of_the_travel_are_refused(x: list[float]) -> None:
    with pytest.raises(AlignmentError, match=r"t\.csv: \d places along the axis span \d+% of the travel"):
        add_sensor_line(readings(), sensors(np.ones(len(x))), np.array(x), np.full(len(x), 90.0), AXIS, file="t.csv")


def test_sensors_of_another_day_are_refused() -> None:
    other = sensors(np.ones(2)).assign_coords(time=sensors(np.ones(2))["time"] + np.timedelta64(1, "D"))
    with pytest.raises(AlignmentError, match="another time than the readings"):
        add_sensor_line(readings(), other, np.array([500.0, 200.0]), np.full(2, 90.0), AXIS, file="t.csv")
