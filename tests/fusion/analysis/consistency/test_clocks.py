"""Consistency checks of the clocks: a shift that is planted is said, delays that physics makes are none."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency.checks import Check
from fusion.analysis.consistency.clocks import (
    check_camera_clock,
    check_load_clock,
    check_load_scale,
    check_material_clock,
)
from fusion.analysis.consistency.field_series import field_at, thin_fields
from tests.fusion.analysis.consistency.twin_fields import SENSOR_MM, Recorded, late, recorded


def logs(test: Recorded, *, environment: float = 0.0, drivers: float = 0.0, camera: float = 0.0) -> dict[str, Check]:
    fields = late(test.fields, camera)
    field, near = thin_fields(fields), field_at(fields, SENSOR_MM)
    checks = [
        *check_material_clock(near, late(test.environment, environment), file="environment.csv"),
        *check_load_clock(field, late(test.drivers, drivers), file="drivers.csv"),
    ]
    return {check.code: check for check in checks}


@pytest.mark.parametrize("effect", ["", "unseen_heat_source", "thermal_lag"])
def test_sound_clocks_pass(effect: str) -> None:
    test = recorded(effect=effect)
    inputs = (test.environment, test.drivers, test.fields)
    kept = [one.copy(deep=True) for one in inputs]
    assert all(check.passed and check.value == 0.0 for check in logs(test).values())
    assert all(one.identical(before) for one, before in zip(inputs, kept, strict=True))
    (camera,) = check_camera_clock(test.readings())
    assert camera.passed
    assert "detected beyond the thermal lag" in camera.evidence


@pytest.mark.parametrize("minutes", [-60.0, 30.0])
def test_a_late_log_is_doubted_and_the_shift_said(minutes: float) -> None:
    found = logs(recorded(), environment=minutes, drivers=minutes)
    # Shifts are tried in steps of 2 min.
    assert found["environment_clock"].value == pytest.approx(minutes, abs=4.0)
    assert found["drivers_clock"].value == pytest.approx(minutes, abs=4.0)
    assert not found["environment_clock"].passed and not found["drivers_clock"].passed


def test_only_the_log_that_is_late_is_doubted_and_named() -> None:
    found = logs(recorded(), drivers=60.0)
    assert found["environment_clock"].passed
    minutes = found["drivers_clock"].value
    assert f"drivers.csv is taken as {minutes:.0f} min late against the camera" in found["drivers_clock"].evidence
    assert "Check the clock and the time zone of drivers.csv" in found["drivers_clock"].remedy


def test_a_camera_that_is_late_is_off_against_both_logs_and_the_drift() -> None:
    test = recorded()
    found = logs(test, camera=60.0)
    assert found["environment_clock"].value == pytest.approx(-60.0, abs=4.0)
    assert found["drivers_clock"].value == pytest.approx(-60.0, abs=4.0)
    moved = Recorded(test.axis, test.deviations, late(test.fields, 60.0), test.environment, test.drivers)
    (camera,) = check_camera_clock(moved.readings())
    assert not camera.passed and camera.value == pytest.approx(60.0, abs=10.0)
    assert "the camera's clock is taken as" in camera.evidence and "clock_offset" in camera.remedy


def test_where_nothing_varies_nothing_is_told() -> None:
    test = recorded(duty="constant")
    assert set(logs(test)) == {"environment_clock"}
    assert check_load_clock(None, test.drivers, file="") == []
    assert check_material_clock(thin_fields(test.fields), None, file="") == []


def test_a_load_that_drives_nothing_seen_is_not_doubted_and_a_logged_temperature_is_no_load() -> None:
    test = recorded()
    field = thin_fields(test.fields)
    (check,) = check_load_clock(field, recorded(seed=6).drivers, file="drivers.csv")
    assert check.passed
    coolant = test.drivers.assign(duty=test.drivers["duty"].assign_attrs(units="degC"))
    assert check_load_clock(field, coolant, file="drivers.csv") == []


def loads(values: np.ndarray, units: str = "1") -> xr.Dataset:
    drivers = recorded().drivers
    changed = drivers["duty"].copy(data=values)
    changed.attrs["units"] = units
    return xr.Dataset({"duty": changed})


@pytest.mark.parametrize("from_middle", [100.0, 0.01])
def test_a_share_that_becomes_per_cent_is_doubted(from_middle: float) -> None:
    test = recorded()
    duty = test.drivers["duty"].values.astype(float)
    half = np.arange(duty.size) >= duty.size // 2
    log = loads(np.where(half, from_middle, 1.0) * duty * (1.0 if from_middle > 1.0 else 100.0))
    (check,) = check_load_scale(thin_fields(test.fields), log, file="drivers.csv")
    assert not check.passed and check.value == 100.0
    assert check.evidence.startswith(
        f"duty in drivers.csv is some 100 times {'larger' if from_middle > 1.0 else 'smaller'}"
    )
    assert check.evidence.endswith("a share and per cent.")


def test_a_jump_of_another_unit_is_held_against_the_rate_of_the_field() -> None:
    test = recorded(duty="switched")
    duty = test.drivers["duty"].values.astype(float)
    half = np.arange(duty.size) >= duty.size // 2
    field = thin_fields(test.fields)
    (check,) = check_load_scale(field, loads(1500.0 * np.where(half, 60.0, 1.0) * duty, "1/min"), file="drivers.csv")
    assert not check.passed and "% of the field's rate unexplained" in check.evidence
    (sound,) = check_load_scale(field, loads(1500.0 * duty, "1/min"), file="drivers.csv")
    assert sound.passed and sound.value == 1.0


@pytest.mark.parametrize(("before", "after"), [(0.01, 0.9), (1.0, 57.0)])
def test_a_small_share_before_a_large_one_and_numbers_of_programs_are_no_per_cent(before: float, after: float) -> None:
    test = recorded()
    log = loads(np.where(np.arange(test.drivers.sizes["time"]) < 60, before, after))
    (check,) = check_load_scale(thin_fields(test.fields), log, file="drivers.csv")
    assert check.passed
    assert check_load_scale(None, log, file="drivers.csv") == []


# Coarse cells and thinned frames: what the checks of clocks and temperatures look at.


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
