"""Consistency checks of the logs: a log of another day, a log that ends early, a log with a long gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.material import rise_share_u, share_of_zero
from fusion.analysis.consistency.series import FieldSeries, field_at, log_with_camera, thin_fields
from fusion.pipeline.consistency import Check, _together, run_checks
from tests.fusion.analysis.consistency.twin_fields import SENSOR_MM, recorded, scaled

START = np.datetime64("2026-03-09T06:30", "ns")
READINGS = START + np.arange(0, 4 * 3600, 8).astype("m8[s]")


def log(first_s: float, last_s: float, step_s: float = 60.0) -> xr.Dataset:
    seconds = np.arange(first_s, last_s + 1.0, step_s)
    return xr.Dataset(coords={"time": START + (seconds * 1e9).astype("m8[ns]")})


def check(dataset: xr.Dataset) -> Check:
    (only,) = covered(dataset, READINGS)
    return only


def covered(drivers: xr.Dataset | None, readings: np.ndarray) -> list[Check]:
    return run_checks(
        "source", Inputs(drivers=drivers, drivers_file="drivers.csv", reading_time=xr.DataArray(readings, dims="time"))
    )


def test_a_log_of_another_day_is_a_contradiction() -> None:
    found = check(log(86400.0, 86400.0 + 4 * 3600.0))
    assert found.contradicts and found.value == 0.0
    assert found.evidence.startswith(
        "drivers.csv (2026-03-10T06:30:00Z to 2026-03-10T10:30:00Z) covers 0 % of the readings"
    )
    assert "Check the date, the clock and the time zone of drivers.csv" in found.remedy


@pytest.mark.parametrize("noted_s", [[-600.0], [1800.0], [-600.0, -540.0, 15_000.0, 15_060.0]])
def test_conditions_noted_before_or_after_the_test_are_no_contradiction(noted_s: list[float]) -> None:
    noted = log(0.0, 0.0).isel(time=[0] * len(noted_s)).assign_coords(time=START + np.array(noted_s).astype("m8[s]"))
    found = check(noted)
    assert not found.contradicts and found.value == 0.0


@pytest.mark.parametrize(("last_s", "share"), [(4 * 3600.0, 1.0), (2 * 3600.0, 0.5), (3600.0, 0.25)])
def test_a_log_that_ends_early_is_doubted(last_s: float, share: float) -> None:
    found = check(log(-60.0, last_s))
    assert found.passed is (share == 1.0) and not found.contradicts
    # One reading more or less at the end.
    assert found.value == pytest.approx(share, abs=0.002)


@pytest.mark.parametrize(("late_s", "words"), [(10_800.0, "3 h late"), (-9000.0, "2.5 h early")])
def test_a_log_of_another_time_zone_is_a_contradiction_that_names_the_shift(late_s: float, words: str) -> None:
    found = check(log(late_s, late_s + 4 * 3600.0))
    assert found.contradicts and found.value < 0.6
    assert f"nearly all of them if its clock is {words}." in found.evidence and "time_zone" in found.remedy


def test_a_log_that_may_have_been_started_late_is_only_doubted() -> None:
    # Half of the test is covered, and after a shift all of it; but this log goes on for hours after the test.
    found = check(log(7200.0, 10 * 3600.0))
    assert not found.contradicts and "2 h late" in found.evidence
    # An hour late: three quarters are covered, the shift is named.
    assert "if its clock is 1 h late" in check(log(3600.0, 5 * 3600.0)).evidence


def test_a_log_with_a_long_gap_is_doubted() -> None:
    whole = log(0.0, 4 * 3600.0)
    holed = whole.sel(
        time=(whole["time"] < START + np.timedelta64(3600, "s")) | (whole["time"] > START + np.timedelta64(7200, "s"))
    )
    found = check(holed)
    assert found.value == pytest.approx(0.75, abs=0.01)
    # Its clock is right, so that nobody is sent to look at it.
    assert found.evidence.endswith("; the others fall into gaps of the log.")
    assert found.remedy.startswith("Log without a break") and "clock" not in found.remedy


def test_what_was_not_logged_is_not_checked() -> None:
    assert covered(None, READINGS) == []
    nothing = np.full(3, np.datetime64("NaT", "ns"))
    assert covered(log(0.0, 60.0), nothing) == []


def environment(jump_K: float = 0.0) -> xr.Dataset:
    """Five hours of air and material temperature once a minute, of which the material jumps after three."""
    rng = np.random.default_rng(8)
    course = 22.0 + np.cumsum(rng.normal(0.0, 0.01, 300))
    columns = {"air_temperature": course, "material_temperature": course + jump_K * (np.arange(300) >= 180)}
    time = START + np.arange(300) * np.timedelta64(60, "s")
    noisy = {name: ("time", np.round(one + rng.normal(0.0, 0.01, 300), 2)) for name, one in columns.items()}
    return xr.Dataset(noisy, coords={"time": time})


def drivers(jump_K: float) -> xr.Dataset:
    """A load and the temperature of a screw nut, logged with the environment."""
    logged = environment(jump_K)
    load = (np.arange(300) // 20 % 2).astype(float)
    nut = logged["material_temperature"].values
    return xr.Dataset(
        {"speed": ("time", load, {"units": "1/min"}), "nut": ("time", nut, {"units": "degC"})},
        coords={"time": logged["time"]},
    )


def contact_sensors(environment: xr.Dataset | None, drivers: xr.Dataset | None = None) -> Check:
    inputs = Inputs(environment=environment, drivers=drivers, environment_file="environment.csv")
    return next(check for check in run_checks("source", inputs) if check.code == "contact_sensors")


def test_a_stable_room_that_shows_one_digit_is_sound() -> None:
    """A material that moves by 0.05 K reads the same at a resolution of 0.1 K, while the air swings with its conditioning."""
    hours = np.arange(300) / 60.0
    columns = {"air_temperature": 20.0 + 0.4 * np.sin(12.0 * hours), "material_temperature": 20.5 + 0.01 * hours}
    time = START + np.arange(300) * np.timedelta64(60, "s")
    room = xr.Dataset({name: ("time", np.round(one, 1)) for name, one in columns.items()}, coords={"time": time})
    assert np.ptp(room["material_temperature"].values) == 0.0
    assert contact_sensors(room).passed


def test_a_temperature_among_the_drivers_is_examined_and_its_load_is_not() -> None:
    doubted = contact_sensors(environment(), drivers(3.0))
    assert doubted.evidence.startswith("environment.csv: nut jumps by 3 K from 2.9")


# Contact sensors on the table: sound by themselves, and as warm as the camera sees their places.


MINUTES = START + 60 * np.arange(120) * np.timedelta64(1, "s")
WARMING = 4.0 * (1.0 - np.exp(-np.arange(120) / 40.0))


def logged(*shares: float, seed: int = 3) -> xr.DataArray:
    """Sensors that show a share of the warming each, with 0.02 K of noise."""
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (120, len(shares)))
    values = 20.0 + WARMING[:, None] * np.array(shares) + noise
    return xr.DataArray(
        values, {"time": MINUTES, "sensor": [f"t{k + 1}" for k in range(len(shares))]}, ("time", "sensor")
    )


def fields() -> xr.Dataset:
    """A plan of 5 x 9 cells of 20 mm that warms alike everywhere."""
    frames = np.broadcast_to(20.0 + WARMING[:, None, None], (120, 5, 9))
    plan = {"time": MINUTES, "y": 10.0 + 20.0 * np.arange(5), "x": 10.0 + 20.0 * np.arange(9)}
    rise_u = (("cycle", "y", "x"), np.full((2, 5, 9), 0.05))
    return xr.Dataset({"frame_temperature": (("time", "y", "x"), frames), "temperature_rise_u": rise_u}, plan)


def sensors_rise(temperature: xr.DataArray) -> list[Check]:
    x, y = np.array([30.0, 130.0]), np.array([30.0, 70.0])
    inputs = Inputs(fields=fields(), sensor_temperature=temperature, sensor_x_mm=x, sensor_y_mm=y, sensor_u_K=0.1)
    return run_checks("fields", inputs)


def test_sensors_of_another_time_are_not_compared() -> None:
    late = logged(1.0).assign_coords(time=MINUTES + np.timedelta64(1, "D"))
    assert sensors_rise(late) == []


# Consistency checks of camera and environment log: an emissivity is a slope, a reflection an offset; logs of another course.


def checks(factor: float = 1.0, *, seed: int = 5, offset_K: float = 0.0, stated: bool = True) -> dict[str, Check]:
    test = recorded(seed)
    fields = scaled(test.fields, factor)
    fields["frame_temperature"] = fields["frame_temperature"] + offset_K
    return of_log(test.environment, fields, stated=stated)


def of_log(environment: xr.Dataset, fields: xr.Dataset, *, stated: bool) -> dict[str, Check]:
    near = field_at(fields, SENSOR_MM) if stated else thin_fields(fields)
    return {check.code: check for check in check_material(near, environment, stated=stated)}


def check_material(near: FieldSeries | None, environment: xr.Dataset | None, *, stated: bool) -> list[Check]:
    logged = log_with_camera(near, environment)
    inputs = Inputs(logged=logged, place_stated=stated, environment_file="environment.csv")
    return list(_together(run_checks("fields", inputs)))


@pytest.mark.parametrize("planted", [0.0, 0.5, 1.0])
def test_a_sensor_shows_how_much_of_a_change_is_the_zero_of_the_camera(planted: float) -> None:
    test = recorded()
    near = field_at(test.fields, SENSOR_MM)
    assert near is not None
    change_K = np.linspace(0.0, 1.0, len(near.seconds))
    off = replace(near, temperature=near.temperature + planted * change_K[:, None])
    mean, rms = share_of_zero(off, test.environment, change_K, 0.01)
    # A probe follows its place within 0.03 K, and its contact is known to 2 % of a rise of some kelvin.
    assert mean == pytest.approx(planted, abs=0.15) and mean <= rms <= mean + 0.1
    unknown = share_of_zero(off, None, change_K, 0.01)
    assert unknown == pytest.approx((0.5, 1.0 / np.sqrt(3.0)), abs=0.01)


def test_a_sensor_measures_the_scale_at_a_stated_place_and_elsewhere_only_contradicts_it() -> None:
    test = recorded()
    at_place = rise_share_u(field_at(test.fields, SENSOR_MM), test.environment, stated=True)
    # The contact of a surface probe is known to 2 %.
    assert at_place is not None and 0.02 <= at_place < 0.025
    assert rise_share_u(thin_fields(test.fields), test.environment, stated=False) is None
    # A rise that no place explains: what it exceeds the best one by, as a rectangular distribution.
    off = checks(1.94, stated=False)["material_rise"].value
    beyond = rise_share_u(thin_fields(scaled(test.fields, 1.94)), test.environment, stated=False)
    assert off > 0.2 and beyond == pytest.approx(np.hypot(0.02, off / np.sqrt(3.0)))
    assert checks(stated=True)["material_rise"].verified
    unknown = checks(stated=False)["material_rise"]
    assert not unknown.verified and "material_sensor under [interferometry]" in unknown.remedy


def test_a_gain_that_falls_through_the_test_is_doubted_and_a_steady_drift_of_the_zero_is_not() -> None:
    test = recorded()
    passed = xr.DataArray(np.linspace(0.0, 1.0, test.fields.sizes["time"]), dims="time")
    shown = test.fields["frame_temperature"]
    dirty = test.fields.assign(frame_temperature=24.0 + (1.0 - 0.15 * passed) * (shown - 24.0))
    creeps = test.fields.assign(frame_temperature=shown + 0.5 * passed)
    found = of_log(test.environment, dirty, stated=True)["material_gain"]
    # The value is what lies beyond the uncertainty; a transmission that falls to 0.85 lets the log grow to 1 / 0.85 of what is shown.
    assert not found.passed and 0.08 < found.value < 1.0 / 0.85 - 1.0 and "window" in found.remedy
    for fields in (test.fields, creeps):
        assert of_log(test.environment, fields, stated=True)["material_gain"].passed


def test_a_zero_that_swings_leaves_the_scale_unverified_and_a_steady_drift_does_not() -> None:
    test = recorded()
    passed = xr.DataArray(np.linspace(0.0, 1.0, test.fields.sizes["time"]), dims="time")
    shown = test.fields["frame_temperature"]
    swings = test.fields.assign(frame_temperature=shown + 0.5 * np.sin(4.0 * np.pi * passed))
    creeps = test.fields.assign(frame_temperature=shown + 0.05 * passed)
    unsure, sure = (of_log(test.environment, one, stated=True)["material_rise"] for one in (swings, creeps))
    assert unsure.passed and not unsure.verified and "do not change in proportion" in unsure.evidence
    assert "reference_patch" in unsure.remedy
    assert sure.passed and sure.verified


# The rise grows nearly as the reciprocal of the emissivity: 0.97 over 0.90, over 0.50, and over 1.0.
@pytest.mark.parametrize("factor", [1.078, 1.94, 0.85])
def test_a_wrong_emissivity_is_doubted(factor: float) -> None:
    found = checks(factor)
    assert not found["material_rise"].passed
    assert found["material_rise"].value == pytest.approx(factor - 1.0, abs=0.03)
    assert "emissivity" in found["material_rise"].remedy


def with_material(environment: xr.Dataset, values: np.ndarray) -> xr.Dataset:
    return environment.assign(material_temperature=environment["material_temperature"].copy(data=values))


@pytest.mark.parametrize("stated", [True, False])
def test_a_log_backwards_or_of_another_hour_is_not_followed(stated: bool) -> None:
    test = recorded()
    material = test.environment["material_temperature"].values
    for values in (material[::-1], np.roll(material, -material.size // 3)):
        course = of_log(with_material(test.environment, values), test.fields, stated=stated)["material_course"]
        assert not course.passed and course.evidence.startswith(
            "The material temperature in environment.csv changes by"
        )


def test_a_sensor_that_stands_still_is_doubted_where_the_table_warms() -> None:
    test = recorded()
    still = with_material(test.environment, np.full(test.environment.sizes["time"], 25.13))
    found = of_log(still, test.fields, stated=True)
    assert [code for code, check in found.items() if not check.passed] == ["material_still"]
    assert "stays at 25.13 degC to the last digit" in found["material_still"].evidence
    early = test.fields.isel(time=slice(0, 14))
    assert of_log(still, early, stated=True)["material_still"].evidence.endswith("cannot be tested.")


def test_exchanged_columns_are_named() -> None:
    test = recorded()
    log = test.environment
    air, material = log["air_temperature"].values, log["material_temperature"].values
    exchanged = with_material(log.assign(air_temperature=log["air_temperature"].copy(data=material)), air)
    found = of_log(exchanged, test.fields, stated=True)
    assert not found["environment_columns"].passed and "look exchanged" in found["environment_columns"].evidence
    # What the exchange explains names it before it blames the camera.
    others = [check for code, check in found.items() if not check.passed and code != "environment_columns"]
    assert all(check.remedy.startswith("See environment_columns first") for check in others)
    assert checks()["environment_columns"].passed


def test_a_small_change_tells_nothing() -> None:
    test = recorded()
    short = test.fields.isel(time=slice(0, 12))
    found = of_log(test.environment, scaled(short, 1.9), stated=False)
    assert found["material_rise"].passed and not found["material_rise"].verified
    assert rise_share_u(thin_fields(short), test.environment, stated=False) is None


def test_without_a_log_or_a_field_nothing_confirms_the_scale() -> None:
    test = recorded()
    without = test.environment.drop_vars("material_temperature")
    for near, log in ((None, test.environment), (thin_fields(test.fields), None), (thin_fields(test.fields), without)):
        (check,) = check_material(near, log, stated=False)
        assert (
            check.code == "material_rise" and check.passed and not check.verified and "material_sensor" in check.remedy
        )
        assert check.conditional == ("field",)
    assert "environment_columns" not in of_log(test.environment.drop_vars("air_temperature"), test.fields, stated=False)
