"""Coarse cells and thinned frames: what the checks of clocks and temperatures look at."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.field_series import field_at, thin_fields

START = np.datetime64("2026-03-09T06:30", "ns")


def fields(frames: int, step_s: float) -> xr.Dataset:
    time = START + (1e9 * step_s * np.arange(frames)).astype("m8[ns]")
    x, y = np.arange(2.5, 100.0, 5.0), np.arange(2.5, 60.0, 5.0)
    values = 20.0 + np.arange(frames)[:, None, None] + 0.1 * x + 0.0 * y[:, None]
    return xr.Dataset({"frame_temperature": (("time", "y", "x"), values)}, {"time": time, "y": y, "x": x})


def test_cells_are_means_of_20_mm_and_frames_a_minute_apart() -> None:
    series = thin_fields(fields(60, 20.0))
    assert series is not None
    np.testing.assert_array_equal(series.seconds, 60.0 * np.arange(20))
    assert series.temperature.shape == (20, 5 * 3)
    np.testing.assert_allclose(series.x_mm[:5], [10.0, 30.0, 50.0, 70.0, 90.0])
    np.testing.assert_allclose(series.temperature[0, :5], 20.0 + 0.1 * series.x_mm[:5])


def test_a_cell_that_is_not_always_seen_is_left_out() -> None:
    holed = fields(20, 60.0)
    holed["frame_temperature"][7, 0, 0] = np.nan
    series = thin_fields(holed)
    assert series is not None and series.temperature.shape == (20, 14)
    assert thin_fields(holed.where(False)) is None
    assert thin_fields(fields(11, 60.0)) is None


def test_the_temperature_at_a_place_is_that_of_a_plane_through_the_cells_about_it() -> None:
    holed = fields(20, 60.0)
    # A disc beside the place hides some of its cells; linear along x, so that a plane is exact.
    holed["frame_temperature"][:, 2:5, 8:11] = np.nan
    place = field_at(holed, (42.0, 17.0))
    assert place is not None
    np.testing.assert_allclose(place.temperature[:, 0], 20.0 + np.arange(20) + 4.2)
    far = field_at(holed, (500.0, 10.0))
    assert far is not None
    np.testing.assert_allclose(far.temperature[:, 0], 20.0 + np.arange(20) + 9.75)
    assert field_at(fields(11, 60.0), (42.0, 17.0)) is None


def test_a_sensor_follows_with_its_time_constant() -> None:
    series = thin_fields(fields(40, 60.0))
    assert series is not None
    # A ramp of 1 K a minute is followed 3 min late after many time constants: 3 K below.
    assert series.temperature[-1, 0] - series.lagged(180.0)[-1, 0] == pytest.approx(3.0, abs=1e-4)
    assert series.since_start(np.array([START + np.timedelta64(90, "s")])).tolist() == [90.0]
