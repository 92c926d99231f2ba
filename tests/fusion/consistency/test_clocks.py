"""Consistency checks of the clocks: a shift that is planted is said, delays that physics makes are none."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.checks import Check
from fusion.consistency.clocks import check_camera_clock, check_load_clock, check_load_scale, check_material_clock
from fusion.consistency.field_series import field_at, thin_fields
from tests.fusion.consistency.twin_fields import SENSOR_MM, Recorded, late, recorded


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
    assert all(check.passed and check.value == 0.0 for check in logs(test).values())
    (camera,) = check_camera_clock(test.readings())
    assert camera.passed
    assert "would have been noticed" in camera.evidence or "cannot be told" in camera.evidence


@pytest.mark.parametrize("minutes", [-60.0, 30.0, 60.0])
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


def test_a_load_that_drives_nothing_seen_is_not_doubted() -> None:
    test = recorded()
    unrelated = recorded(seed=6).drivers
    (check,) = check_load_clock(thin_fields(test.fields), unrelated, file="drivers.csv")
    assert check.passed


def test_a_logged_temperature_is_no_load() -> None:
    test = recorded()
    coolant = test.drivers.assign(duty=test.drivers["duty"].assign_attrs(units="degC"))
    assert check_load_clock(thin_fields(test.fields), coolant, file="drivers.csv") == []


def test_inputs_stay_as_they_were() -> None:
    test = recorded()
    kept = test.environment.copy(deep=True), test.drivers.copy(deep=True), test.fields.copy(deep=True)
    logs(test)
    assert test.environment.identical(kept[0]) and test.drivers.identical(kept[1])
    assert np.array_equal(test.fields["frame_temperature"], kept[2]["frame_temperature"])


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


def test_a_small_share_before_a_large_one_is_no_per_cent() -> None:
    test = recorded()
    load = np.where(np.arange(test.drivers.sizes["time"]) < 60, 0.01, 0.9)
    (check,) = check_load_scale(thin_fields(test.fields), loads(load), file="drivers.csv")
    assert check.passed


def test_a_number_of_a_program_is_no_per_cent() -> None:
    test = recorded()
    number = np.where(np.arange(test.drivers.sizes["time"]) < 60, 1.0, 57.0)
    (check,) = check_load_scale(thin_fields(test.fields), loads(number), file="drivers.csv")
    assert check.passed
    assert check_load_scale(None, loads(number), file="drivers.csv") == []
