"""Consistency checks of the clocks: the recording that is late is named, delays that physics makes are none."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency import logs
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.clocks import QUARTERS, Recording
from fusion.analysis.consistency.courses import (
    _coarse_kind,
    compare_drift,
    compare_load,
    compare_material,
)
from fusion.analysis.consistency.series import FieldSeries, field_at, thin_fields
from fusion.pipeline.consistency import Check, run_checks, without_consequences
from fusion.report.wording import sentences
from tests.fusion.analysis.consistency.twin_fields import (
    FILES,
    SENSOR_MM,
    check_clocks,
    clocks,
    late,
    recorded,
    with_late,
    without_ends,
)


@pytest.mark.long
@pytest.mark.parametrize("effect", ["", "unseen_heat_source", "thermal_lag"])
def test_sound_clocks_pass(effect: str) -> None:
    test = recorded(effect=effect)
    inputs = (test.environment, test.drivers, test.fields)
    kept = [one.copy(deep=True) for one in inputs]
    for one in (test, without_ends(test)):
        assert all(check.passed and check.value == 0.0 for check in clocks(one).values())
    assert all(one.identical(before) for one, before in zip(inputs, kept, strict=True))


@pytest.mark.parametrize(("name", "minutes"), [*zip(FILES, (-60.0, 15.0, 120.0, -15.0), strict=True)])
def test_the_odd_clock_is_named_and_no_other(name: str, minutes: float) -> None:
    found = clocks(with_late(recorded(), name, minutes), drift=False)
    assert [code for code, check in found.items() if not check.passed] == [f"{name}_clock"]
    odd = found[f"{name}_clock"]
    assert odd.value == minutes
    assert f'clock_offset = "{60.0 * minutes:g} s" under [{name}]' in odd.remedy


@pytest.mark.parametrize("name", FILES)
def test_where_recordings_are_not_begun_together_their_courses_tell(name: str) -> None:
    found = clocks(with_late(without_ends(recorded()), name, 60.0))
    assert [code for code, check in found.items() if not check.passed] == [f"{name}_clock"]
    assert found[f"{name}_clock"].value == pytest.approx(60.0, abs=15.0)


def test_two_recordings_have_no_majority() -> None:
    test = recorded()
    two = [
        Recording(name, FILES[name][1], getattr(test, FILES[name][0])["time"].values.ravel(), name) for name in FILES
    ]
    laser, _, environment, _ = two
    late_log = Recording(
        "environment", "environment.csv", late(test.environment, 60.0)["time"].values, "interferometry"
    )
    checks = check_clocks([laser, late_log])
    assert [code for code, check in checks.items() if not check.passed] == ["clocks"]
    assert checks["clocks"].value == 60.0
    assert "laser.csv is taken as 1 h early or environment.csv is taken as 1 h late" in checks["clocks"].evidence
    assert all(check.passed for check in check_clocks([laser, environment]).values())
    assert check_clocks([laser]) == {}
    moment = Recording("drivers", "drivers.csv", laser.sorted[:1], "drivers")
    assert all(check.passed for check in check_clocks([laser, moment]).values()), (
        "one row has no ends to begin and end with"
    )


def test_two_against_two_are_not_accused() -> None:
    test = with_late(with_late(recorded(), "environment", 60.0), "drivers", 60.0)
    found = clocks(test, drift=False)
    assert [code for code, check in found.items() if not check.passed] == ["clocks"]
    assert "no single clock explains it" in found["clocks"].evidence


def test_where_nothing_varies_nothing_is_told() -> None:
    test = without_ends(recorded(duty="constant"))
    found = clocks(with_late(test, "drivers", -15.0), drift=False)
    assert all(check.passed for check in found.values())
    assert "whether it is an hour off cannot be told" in found["drivers_clock"].evidence
    field = thin_fields(test.fields)
    assert compare_load(field, test.drivers) == [] == compare_load(None, test.drivers)
    assert compare_material(field, None) == []


def test_a_load_that_drives_nothing_seen_tells_nothing_and_a_logged_temperature_is_no_load() -> None:
    test = recorded()
    field = thin_fields(test.fields)
    assert all(evidence.cost.max() <= 1.0 for evidence in compare_load(field, recorded(seed=6).drivers))
    coolant = test.drivers.assign(duty=test.drivers["duty"].assign_attrs(units="degC"))
    assert compare_load(field, coolant) == []


def test_a_material_temperature_contradicts_every_delay_but_its_own() -> None:
    test = recorded()
    (evidence,) = compare_material(field_at(test.fields, SENSOR_MM), late(test.environment, 60.0))
    assert [quarters for quarters in QUARTERS if evidence.cost[evidence.at("environment", quarters)] <= 1.0] == [3, 4]
    (drift,) = compare_drift(test.readings())
    assert drift.cost[drift.at("camera", 0)] <= 1.0


def test_what_a_wrong_clock_makes_doubtful_waits_until_it_is_right() -> None:
    said = {
        "value": 9.0,
        "limit": 0.0,
        "passed": False,
        "remedy": "",
        "endangers": "",
        "assumption": "",
        "conditional": (),
    }
    clock, other = (Check(code=code, evidence="It is off.", **said) for code in ("laser_clock", "datum"))
    covered = Check(code="drivers_coverage", evidence="Half.", contradicts=True, **said)
    kept = without_consequences([clock, covered, other])
    assert [check.code for check in kept] == ["laser_clock", "datum"]
    assert kept[0].contradicts and "drivers_coverage" in kept[0].evidence
    assert without_consequences([clock, covered, other], ["laser_clock"]) == [clock, covered, other]


def of_load(field: FieldSeries | None, drivers: xr.Dataset | None) -> dict[str, Check]:
    """The checks of a load by itself, and against the field."""
    inputs = Inputs(field=field, drivers=drivers, drivers_file="drivers.csv")
    return {check.code: check for phase in ("source", "fields") for check in run_checks(phase, inputs)}


def loads(values: np.ndarray, units: str = "1") -> xr.Dataset:
    drivers = recorded().drivers
    changed = drivers["duty"].copy(data=values)
    changed.attrs["units"] = units
    return xr.Dataset({"duty": changed})


@pytest.mark.parametrize("switched", [False, True])
@pytest.mark.parametrize("from_middle", [100.0, 0.01])
def test_a_share_that_becomes_per_cent_is_doubted(from_middle: float, switched: bool) -> None:
    test = recorded()
    duty = test.drivers["duty"].values.astype(float)
    duty = (duty > np.median(duty)).astype(float) if switched else duty
    half = np.arange(duty.size) >= duty.size // 2
    log = loads(np.where(half, from_middle, 1.0) * duty * (1.0 if from_middle > 1.0 else 100.0))
    check = of_load(thin_fields(test.fields), log)["drivers_scale"]
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
    check = of_load(field, loads(1500.0 * np.where(half, 60.0, 1.0) * duty, "1/min"))["drivers_scale"]
    assert not check.passed and "% of the field's rate unexplained" in check.evidence
    sound = of_load(field, loads(1500.0 * duty, "1/min"))["drivers_scale"]
    assert sound.passed and sound.value == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda duty: np.cumsum(duty), "duty only grows, in"),
        (lambda duty: duty[np.diff(duty, prepend=-1.0) != 0.0], "in a log of events"),
        (lambda duty: duty[::-1], "read backwards in time"),
        (lambda duty: np.roll(duty, duty.size // 3), "of the same log put at other times explain as much or more"),
    ],
)
def test_logs_that_are_no_load_of_the_table_are_doubted_and_named(change, words: str) -> None:
    test = recorded(duty="switched")
    field, duty = thin_fields(test.fields), test.drivers["duty"]
    changed = np.flatnonzero(np.diff(duty.values, prepend=-1.0)) if "events" in words else slice(None)
    log = xr.Dataset({"duty": duty[changed].copy(data=change(duty.values.astype(float)))})
    assert words in " ".join(check.evidence for check in of_load(field, log).values() if not check.passed)


@pytest.mark.parametrize(
    ("load", "words"),
    [
        ([0.3, 0.3, 0.3], "stays at one value"),
        ([0, 1, 0, 0, 0, 1, 0], "holds marks"),
        ([0, 1, 1, 0, 0, 1, 1], "knows two states"),
        ([0.1, 0.5, 0.5, 0.3, 0.5, 0.2, 0.4, 0.1], "is 0.5, its largest value, in 38 % of the rows"),
        # Switched from level to level.
        ([0.0, 1.0, 1.0, 0.3, 1.0, 0.3, 0.6, 0.8, 1.0], ""),
        ([0.1, *[0.4] * 20, *[0.9] * 40, *[0.2] * 20, 0.7], "changes every 20 min only"),
        ([0.1, 0.5, 0.5, 0.3, 0.2, 0.4, 0.1], ""),
    ],
)
def test_a_log_that_shows_less_than_the_load_is_named_after_its_shape(load, words: str) -> None:
    found = _coarse_kind(60.0 * np.arange(len(load)), np.array(load, float))
    assert in_words(found).startswith(words) and bool(found) == bool(words)


def in_words(kind: dict[str, object]) -> str:
    return " ".join(sentences("kind_of_load", kind, template="consistency.j2")) if kind else ""


@pytest.mark.parametrize(
    ("load", "words"),
    [
        (np.arange(60.0), "only grows, in 59 of 60 rows: a counter"),
        (np.tile(np.arange(30.0), 3), "grows in 87 of 90 rows and begins again near zero 2 times"),
        (
            np.diff([0.0, 0.0, 1.0, 1.0, 1.0, 0.4, 0.4, 0.4, 0.9, 0.9, 0.9, 0.0, 0.0, 0.0]),
            "is zero but in 4 single rows",
        ),
        # A load that ramps up slowly and is switched off once, one that is switched, and the speed of an axis that goes to and fro.
        (np.r_[np.linspace(0.0, 1.0, 60), np.zeros(30)], ""),
        (np.tile([0.0, 0.0, 1.0, 1.0, 0.4, 0.4], 20), ""),
        (np.tile([0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, -2.0, -2.0], 10), ""),
    ],
)
def test_a_counter_and_changes_of_a_load_are_told_by_their_shape(load, words: str) -> None:
    found = logs._other_kind(np.asarray(load))
    assert in_words(found).startswith(words) and bool(found) == bool(words)


def test_what_two_loads_heat_together_need_not_be_explained_by_either() -> None:
    test = recorded(duty="switched")
    field, duty = thin_fields(test.fields), test.drivers["duty"].values.astype(float)
    # Half of the levels in either log: neither shows the heat by itself.
    first = np.arange(duty.size) // 45 % 2 == 0
    log = test.drivers.assign(duty=("time", np.where(first, duty, 0.0)), other=("time", np.where(first, 0.0, duty)))
    check = of_load(field, log)["drivers_course"]
    assert check.passed and "with all that was logged" in check.evidence


def test_a_load_that_drives_the_table_a_staircase_and_a_constant_one_are_loads() -> None:
    for duty in ("random", "switched"):
        test = recorded(duty=duty)
        field = thin_fields(test.fields)
        size = test.drivers.sizes["time"]
        staircase = test.drivers.assign(duty=("time", np.linspace(0.0, 5.0, size).round()))
        checks = [*of_load(field, test.drivers).values(), *of_load(None, staircase).values()]
        assert len(checks) == 4 and all(check.passed for check in checks)
    constant = xr.Dataset({"duty": test.drivers["duty"].copy(data=np.ones(size))})
    assert of_load(None, constant) == of_load(field, None) == {}


def test_an_even_grid_has_a_time_for_each_minute_of_a_log_but_no_more_than_a_month_has() -> None:
    np.testing.assert_array_equal(logs.even_times(np.array([-30.0, 600.0])), np.arange(-30.0, 601.0, 60.0))
    decades = logs.even_times(np.array([0.0, 7.8e8]))
    assert decades.size == 30 * 24 * 60 + 1
    assert decades[-1] == pytest.approx(7.8e8)


@pytest.mark.parametrize(("before", "after"), [(0.01, 0.9), (1.0, 57.0), (1.0, 100.0)])
def test_a_small_share_before_a_large_one_and_numbers_of_programs_are_no_per_cent(before: float, after: float) -> None:
    test = recorded()
    log = loads(np.where(np.arange(test.drivers.sizes["time"]) < 60, before, after))
    check = of_load(thin_fields(test.fields), log)["drivers_scale"]
    assert check.passed
    assert "drivers_scale" not in of_load(None, log)


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
    assert field_at(fields(11, 60.0), (42.0, 17.0)) is None


def test_a_place_that_some_frames_show_is_followed_in_these_and_one_that_too_few_show_is_not() -> None:
    travelling = fields(20, 60.0)
    # The table carries the place out of view, and a cell beside it a frame earlier.
    travelling["frame_temperature"][5:12, :, 6:] = np.nan
    travelling["frame_temperature"][4, 3, 8] = np.nan
    place = field_at(travelling, (42.0, 17.0))
    assert place is not None
    shown = np.delete(np.arange(20), np.arange(4, 12))
    np.testing.assert_array_equal(place.seconds, 60.0 * shown)
    np.testing.assert_allclose(place.temperature[:, 0], 20.0 + shown + 4.2)
    travelling["frame_temperature"][:10, :, :] = np.nan
    assert field_at(travelling, (42.0, 17.0)) is None
    # No cell within 20 mm: another place tells nothing.
    assert field_at(fields(20, 60.0), (500.0, 10.0)) is None


def test_a_sensor_follows_with_its_time_constant() -> None:
    series = thin_fields(fields(40, 60.0))
    assert series is not None
    # A ramp of 1 K a minute is followed 3 min late after many time constants: 3 K below.
    assert series.temperature[-1, 0] - series.lagged(180.0)[-1, 0] == pytest.approx(3.0, abs=1e-4)
    assert series.since_start(np.array([START + np.timedelta64(90, "s")])).tolist() == [90.0]
