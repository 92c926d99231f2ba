"""Consistency checks of the logs: a log of another day, a log that ends early, a log with a long gap."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.checks import Check, Severity
from fusion.consistency.logs import check_contact_sensors, check_log

START = np.datetime64("2026-03-09T06:30", "ns")
READINGS = START + np.arange(0, 4 * 3600, 8).astype("m8[s]")


def log(first_s: float, last_s: float, step_s: float = 60.0) -> xr.Dataset:
    seconds = np.arange(first_s, last_s + 1.0, step_s)
    return xr.Dataset(coords={"time": START + (seconds * 1e9).astype("m8[ns]")})


def check(dataset: xr.Dataset) -> Check:
    (only,) = check_log(dataset, READINGS, name="drivers", file="drivers.csv", endangers="loads")
    return only


def test_a_log_over_the_whole_test_passes() -> None:
    assert check(log(-60.0, 4 * 3600.0)).passed


def test_a_log_of_another_day_is_a_contradiction() -> None:
    found = check(log(86400.0, 86400.0 + 4 * 3600.0))
    assert found.severity is Severity.CONTRADICTION and found.value == 0.0
    assert found.evidence.startswith(
        "drivers.csv (2026-03-10T06:30:00Z to 2026-03-10T10:30:00Z) covers 0 % of the readings"
    )
    assert "Check the date, the clock and the time zone of drivers.csv" in found.remedy


@pytest.mark.parametrize(("last_s", "share"), [(2 * 3600.0, 0.5), (3600.0, 0.25)])
def test_a_log_that_ends_early_is_doubted(last_s: float, share: float) -> None:
    found = check(log(0.0, last_s))
    assert not found.passed and found.severity is Severity.DOUBT
    # One reading more or less at the end.
    assert found.value == pytest.approx(share, abs=0.002)


@pytest.mark.parametrize(("late_s", "words"), [(10_800.0, "3 h late"), (-9000.0, "2.5 h early")])
def test_a_log_of_another_time_zone_is_a_contradiction_that_names_the_shift(late_s: float, words: str) -> None:
    found = check(log(late_s, late_s + 4 * 3600.0))
    assert found.severity is Severity.CONTRADICTION and found.value < 0.6
    assert f"nearly all of them if its clock is {words}." in found.evidence and "time_zone" in found.remedy


def test_a_log_that_may_have_been_started_late_is_only_doubted() -> None:
    # Half of the test is covered, and after a shift all of it; but this log goes on for hours after the test.
    found = check(log(7200.0, 10 * 3600.0))
    assert found.severity is Severity.DOUBT and "2 h late" in found.evidence
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
    assert found.evidence.endswith("; the others lie in gaps of the log.")
    assert found.remedy.startswith("Log without a break") and "clock" not in found.remedy


def test_what_was_not_logged_is_not_checked() -> None:
    assert check_log(None, READINGS, name="drivers", file="", endangers="") == []
    nothing = np.full(3, np.datetime64("NaT"))
    assert check_log(log(0.0, 60.0), nothing, name="drivers", file="", endangers="") == []


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


def test_a_contact_sensor_that_jumps_alone_is_doubted_by_name() -> None:
    (sound,) = check_contact_sensors(environment(), drivers(0.0), file="environment.csv")
    assert (sound.code, sound.passed, sound.value) == ("contact_sensors", True, 0.0)
    (doubted,) = check_contact_sensors(environment(2.0), None, file="environment.csv")
    assert not doubted.passed
    assert doubted.evidence.startswith("environment.csv: material temperature jumps by 2 K from 2.9")
    assert check_contact_sensors(None, None, file="environment.csv") == []


def test_a_temperature_among_the_drivers_is_examined_and_its_load_is_not() -> None:
    (doubted,) = check_contact_sensors(environment(), drivers(3.0), file="environment.csv")
    assert doubted.evidence.startswith("environment.csv: nut jumps by 3 K from 2.9")
