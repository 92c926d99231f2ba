"""Consistency checks of the frames of a series: changed settings, implausible parameters, another range."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.consistency import RULES
from fusion.analysis.consistency.camera import (
    compare_phase,
    file_warnings,
    find_gaps,
    gap_words,
    mean_rise,
    zero_share,
)
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.clocks import QUARTERS
from fusion.analysis.consistency.series import Motion
from fusion.pipeline.consistency import Check, _worded, run_checks
from fusion.results.axis import RegistrationPart
from tests.fusion.analysis.consistency.twin_fields import recorded
from thermography.fields.objects import describe_part, find_abrupt_parts
from thermography.io.flir import FrameReference, index_frames
from thermography.io.frame import CalibratedRange

STATED = {
    "emissivity",
    "reflected_temperature_K",
    "atmospheric_temperature_K",
    "relative_humidity",
    "object_distance_m",
}


@pytest.fixture
def frames(campaign_folder: Path) -> list[FrameReference]:
    references, _ = index_frames(sorted((campaign_folder / "thermal").iterdir()))
    return references[:6]


def failed(frames: list[FrameReference], overridden: set[str]) -> dict[str, str]:
    inputs = Inputs(frames=frames, file_warnings=file_warnings(frames, overridden=overridden))
    return {check.code: check.evidence for check in run_checks("source", inputs) if not check.passed}


def test_a_sound_series_passes(frames: list[FrameReference]) -> None:
    assert failed(frames, STATED) == {} and failed(frames, set()) == {}


def with_parameters(frame: FrameReference, **changed: float) -> FrameReference:
    return replace(frame, parameters=replace(frame.parameters, **changed))


def with_camera(frame: FrameReference, **changed: str) -> FrameReference:
    return replace(frame, camera=replace(frame.camera, **changed))


@pytest.mark.parametrize(("error", "expected"), [(1.0, set()), (1.05, {"camera_settings"})])
def test_another_range_is_no_fault_where_its_own_parameters_continue_the_temperatures(
    frames: list[FrameReference], monkeypatch: pytest.MonkeyPatch, error: float, expected: set[str]
) -> None:
    """Half as many counts by half R1; with an R1 that is 5 % wrong, the temperatures jump by 3 K."""
    kind, read = type(frames[0]), type(frames[0]).read_counts

    def by_the_range(frame: FrameReference) -> np.ndarray:
        counts, offset = read(frame), frame.parameters.planck_o
        halved = np.rint(0.5 * (counts + offset) - offset).astype(np.uint16)
        return counts if frame.limits.maximum_K < 2000.0 else halved

    monkeypatch.setattr(kind, "read_counts", by_the_range)
    r1 = 0.5 * error * frames[0].parameters.planck_r1
    limits = CalibratedRange(273.15, 2273.15, 0, 65535)
    switched = [replace(with_parameters(frame, planck_r1=r1), limits=limits) for frame in frames[3:]]
    assert set(failed([*frames[:3], *switched], STATED)) == expected


def hot(frame: FrameReference) -> FrameReference:
    limits = CalibratedRange(573.15, 2273.15, frame.limits.raw_minimum, frame.limits.raw_maximum)
    return replace(frame, limits=limits)


@pytest.mark.parametrize(
    ("change", "first", "overridden", "code"),
    [
        (lambda frame: with_parameters(frame, emissivity=0.7), 3, set(), "camera_settings"),
        (lambda frame: with_parameters(frame, emissivity=0.7), 3, STATED, None),
        (hot, 3, STATED, "camera_settings"),
        (hot, 0, STATED, "camera_range"),
        (lambda frame: with_camera(frame, lens_model="FOL76"), 3, STATED, "camera_settings"),
        (lambda frame: with_camera(frame, serial="other"), 3, STATED, "camera_settings"),
        (lambda frame: with_parameters(frame, reflected_temperature_K=571.15), 0, set(), "camera_parameters"),
        (lambda frame: with_parameters(frame, reflected_temperature_K=571.15), 0, STATED, None),
    ],
)
def test_what_changes_from_a_frame_on_or_is_implausible_is_doubted_unless_it_is_stated(
    frames: list[FrameReference],
    change: Callable[[FrameReference], FrameReference],
    first: int,
    overridden: set[str],
    code: str | None,
) -> None:
    found = failed([*frames[:first], *map(change, frames[first:])], overridden)
    assert code in found if code else not found


# Consistency checks of the camera's stamps: order, rate of its clock, place in the motion of the axis.


def phase(seconds_late: float = 0.0, *, gain_s_per_h: float = 0.0, keep: slice = slice(None)) -> dict[str, Check]:
    test = recorded()
    true = test.fields["time"].values
    since = (true - true[0]) / np.timedelta64(1, "s")
    stamps = true + (1e9 * (seconds_late + gain_s_per_h / 3600.0 * since)).astype("m8[ns]")
    return {check.code: check for check in check_phase(stamps[keep], test.deviations)}


def check_phase(stamps: np.ndarray, deviations: xr.Dataset) -> list[Check]:
    return run_checks("source", Inputs(motion=Motion.of(stamps, deviations)))


def check_order(frames: list[FrameReference]) -> Check:
    inputs, rule = Inputs(frames=frames), RULES["camera_stamps"]
    found = rule.make(inputs)
    assert found is not None
    return _worded(rule, found, inputs)


def of_fields(fields: xr.Dataset) -> list[Check]:
    return run_checks("fields", Inputs(fields=fields))


def test_frames_at_the_end_of_each_cycle_pass() -> None:
    found = phase()
    assert found["camera_rate"].passed and found["camera_rate"].value == pytest.approx(0.0, abs=0.01)
    assert found["camera_phase"].passed and found["camera_phase"].value == 0.0
    assert phase(gain_s_per_h=3.0)["camera_rate"].passed


@pytest.mark.parametrize("gain", [60.0, 600.0, -60.0])
def test_a_clock_that_gains_is_doubted_and_its_rate_said(gain: float) -> None:
    found = phase(gain_s_per_h=gain)
    assert not found["camera_rate"].passed
    # Places are counted in cycles of the camera's own clock: 1/6 of a gain of 600 s/h is of second order.
    assert found["camera_rate"].value == pytest.approx(gain, rel=0.2)


@pytest.mark.parametrize("minutes", [20.0, 60.0, -60.0])
def test_frames_that_are_stamped_in_the_motion_are_doubted(minutes: float) -> None:
    found = phase(60.0 * minutes)
    assert found["camera_rate"].passed
    assert not found["camera_phase"].passed and found["camera_phase"].value > 0.9
    assert "clock_offset" in found["camera_phase"].remedy


@pytest.mark.parametrize("interval_s", [10.0, 60.0, 190.0, 400.0])
def test_a_camera_on_its_own_timer_tells_nothing(interval_s: float) -> None:
    test = recorded()
    first, last = test.fields["time"].values[[0, -1]]
    stamps = np.arange(first, last, np.timedelta64(round(interval_s), "s"))
    found = check_phase(stamps, test.deviations)
    assert [check.passed for check in found] == [True, True]
    assert all("cannot be tested" in check.evidence for check in found)


def test_the_place_in_the_cycle_tells_how_late_the_camera_is() -> None:
    test = recorded()
    (found,) = compare_phase(Motion.of(test.fields["time"].values + np.timedelta64(1, "h"), test.deviations))
    told = dict(zip(QUARTERS, found.cost, strict=True))
    assert told[0] == 2.0 and told[4] == 0.0, "all frames away, twice the limit; none where an hour is taken off"


def test_few_cycles_tell_nothing() -> None:
    test = recorded()
    short = test.deviations.isel(cycle=slice(0, 8))
    assert all(check.passed for check in check_phase(test.fields["time"].values[:8], short))
    no_times = test.deviations.assign(time=xr.full_like(test.deviations["time"], np.datetime64("NaT")))
    assert all(check.passed for check in check_phase(test.fields["time"].values, no_times))


def test_a_counter_that_starts_anew_is_no_clock_set_back(frames: list[FrameReference]) -> None:
    folder = frames[0].path.parent
    names = ("IR_9998.jpg", "IR_9999.jpg", "IR_0001.jpg", "IR_0002.jpg")
    renamed = [replace(frame, path=folder / name) for frame, name in zip(frames, names, strict=False)]
    assert check_order(renamed).passed


def test_frames_of_one_file_go_by_their_index(frames: list[FrameReference]) -> None:
    sequence = [replace(frame, path=Path("a.seq"), index=k) for k, frame in enumerate(frames)]
    assert check_order(sequence).passed
    swapped = [replace(sequence[0], index=1), replace(sequence[1], index=0), *sequence[2:]]
    assert not check_order(swapped).passed


def numbered(seconds: np.ndarray, like: FrameReference) -> list[FrameReference]:
    """Frames of consecutively numbered files with these times."""
    start = np.datetime64("2026-03-09T06:30:00", "ms")
    return [
        replace(
            like,
            path=Path(f"/test/IR_{number:04d}.jpg"),
            index=0,
            time=start + np.timedelta64(round(1e3 * second), "ms"),
        )
        for number, second in enumerate(seconds)
    ]


def test_renamed_files_are_no_fault_of_the_clock(campaign_folder: Path) -> None:
    like = index_frames(sorted((campaign_folder / "thermal").iterdir())[:1])[0][0]
    seconds = 252.0 * np.arange(40)
    shuffled = np.random.default_rng(3).permutation(seconds)
    two_exchanged = seconds.copy()
    two_exchanged[[7, 32]] = seconds[[32, 7]]
    for renamed in (shuffled, shuffled**1.5, two_exchanged):
        check = check_order(numbered(renamed, like))
        assert check.passed and "the times were taken" in check.evidence
    set_back = seconds - np.where(np.arange(40) >= 20, 600.0, 0.0)
    other_year = seconds - np.where(np.arange(40) >= 20, 25 * 365 * 86400.0, 0.0)
    for wrong in (set_back, other_year, seconds - np.where(np.arange(40) >= 20, 504.0, 0.0)):
        check = check_order(numbered(wrong, like))
        assert not check.passed and "goes backwards 1 times" in check.evidence


# What the frames show over the series: stretches without a check of the place, frames left out or repeated, parts that jump.


START = np.datetime64("2026-03-09T06:30", "ns")
FRAMES, ROWS, COLUMNS = 40, 9, 35


def fields(change_K: np.ndarray | None = None, **remarks: list) -> xr.Dataset:
    """A table that warms smoothly by 5 K at one end, with a source that is switched at frame 15, and 20 mK of noise."""
    rng = np.random.default_rng(4)
    minutes = 4.2 * np.arange(FRAMES)
    place = np.linspace(0.0, 1.0, COLUMNS)
    warm = 5.0 * (1.0 - np.exp(-minutes / 60.0))[:, None, None] * place
    late = np.maximum(minutes - 63.0, 0.0)[:, None, None] / 60.0 * np.exp(-(((place - 0.3) / 0.1) ** 2))
    stack = 23.0 + warm + late + rng.normal(0.0, 0.02, (FRAMES, ROWS, COLUMNS))
    lists = ("knocks", "unchecked_stretches", "frames_damaged", "frames_obstructed", "frames_shaken", "frames_repeated")
    attrs: dict[str, list] = {name: [] for name in lists}
    dataset = xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), stack if change_K is None else stack + change_K),
            "frame_count": ("time", np.ones(FRAMES, int)),
        },
        coords={
            "time": START + np.round(60e9 * minutes).astype("m8[ns]"),
            "y": 20.0 * np.arange(ROWS),
            "x": 20.0 * np.arange(COLUMNS),
        },
        attrs={name: json.dumps(value) for name, value in (attrs | remarks).items()},
    )
    parts = [describe_part(part, dataset) for part in find_abrupt_parts(dataset["frame_temperature"])]
    return dataset.assign_attrs(abrupt_parts=json.dumps(parts))


def doubted_places(dataset: xr.Dataset) -> dict[str, Check]:
    return {check.code: check for check in of_fields(dataset) if not check.passed}


def test_a_common_step_of_the_camera_is_no_jump_of_a_part() -> None:
    step = np.where(np.arange(FRAMES) < 20, 0.0, 0.8)[:, None, None]
    # A third of all frames may be left out: 20 of 60.
    assert doubted_places(fields(step, frames_damaged=["a.jpg#0"] * 20)) == {}


def test_a_long_stretch_without_a_check_is_doubted_and_named() -> None:
    stretch = {"first": "a.jpg#0", "last": "b.jpg#0", "frames": 8}
    check = doubted_places(fields(unchecked_stretches=[stretch]))["camera_place"]
    assert check.value == pytest.approx(0.2) and "a.jpg#0 to b.jpg#0 (8 frames)" in check.evidence
    assert doubted_places(fields(unchecked_stretches=[stretch | {"frames": 2}])) == {}


def moving(across_mm: np.ndarray, **remarks: list) -> xr.Dataset:
    """A table that moves, located in every frame to 0.03 mm."""
    rng = np.random.default_rng(5)
    across = across_mm + rng.normal(0.0, 0.03, len(across_mm))
    base = fields(**remarks).drop_vars("frame_temperature")
    times = START + 10 * np.arange(len(across)) * np.timedelta64(1, "s")
    return base.assign(table_across=("frame_time", across)).assign_coords(frame_time=times)


def test_a_moving_table_is_not_displaced_across_its_axis_nor_lost() -> None:
    straight = 0.02 * np.sin(np.arange(200) / 7.0)
    assert doubted_places(moving(straight)) == {}
    knocked = doubted_places(moving(straight + 0.6 * (np.arange(200) >= 120)))
    assert set(knocked) == {"camera_place"}
    assert (
        "by +0.6" in knocked["camera_place"].evidence
        and "from 2026-03-09T06:50:00Z on" in knocked["camera_place"].evidence
    )
    lost = doubted_places(moving(straight, frames_unplaced=[f"a.seq#{i}" for i in range(60)]))
    assert "60 in which the moving table is not located" in lost["frames_left_out"].evidence
    assert doubted_places(moving(straight[:4])) == {}


def test_readings_in_a_gap_between_frames_are_counted() -> None:
    dataset = fields()
    readings = xr.DataArray(dataset["time"].values[:, None] + np.array([30, 60], "m8[s]"), dims=("cycle", "target"))
    (sound,) = run_checks("fields", Inputs(frame_time=dataset["time"].values, reading_time=readings))
    assert sound.passed and sound.value == 0.0
    kept = np.delete(dataset["time"].values, np.arange(14, 23))
    (check,) = run_checks("fields", Inputs(frame_time=kept, reading_time=readings))
    # Nine frames are missing, so that ten intervals of 4.2 min lie between the frames about them.
    assert not check.passed and check.value == 0.25
    assert "42 min from 2026-03-09T07:24:36Z to 2026-03-09T08:06:36Z" in check.evidence
    assert [gap_words(gap) for gap in find_gaps(kept)] == ["42 min from 2026-03-09T07:24:36Z to 2026-03-09T08:06:36Z"]
    # Three intervals are not longer than three.
    assert not find_gaps(np.delete(dataset["time"].values, [14, 15]))
    (alone,) = run_checks("fields", Inputs(frame_time=kept[:1], reading_time=readings))
    assert alone.passed


def test_a_long_series_is_checked_piece_by_piece_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    lit = np.zeros((FRAMES, ROWS, COLUMNS))
    lit[18:28, 2:6, 10:16] = 1.0
    lit[:, 0, :3] = np.nan
    at_once = [of_fields(fields(change_K)) for change_K in (None, lit)]
    monkeypatch.setattr("thermography.large_arrays.PIECE_BYTES", 7 * 8 * ROWS * COLUMNS)
    assert [of_fields(fields(change_K)) for change_K in (None, lit)] == at_once


# What a registration leaves to doubt.


SOUND = {
    "leave_one_out_mm": {f"F{i}": 0.02 for i in range(1, 13)},
    "fiducials_listed": 12,
    "unchecked": [],
    "contradicted_hints": [],
    "mirrored": False,
    "span": 0.66,
    "area_ratio": 1.004,
    "rms_mm": 0.02,
    "frames_rejected": [],
}


def doubts(**changed) -> list[str]:
    part = RegistrationPart.model_validate({**SOUND, **changed})
    checks = run_checks("plan", Inputs(registration=part, fiducials_file="fiducials.csv"))
    return [check.code for check in checks if not check.passed]


def test_a_sound_registration_is_not_doubted():
    assert doubts() == []
    assert doubts(area_ratio=None) == []
    assert doubts(contradicted_hints=["F1", "F2"], leave_one_out_mm={f"F{i}": 0.0 for i in range(6)}) == []


@pytest.mark.parametrize(("zero_u_K", "passed"), [(0.2, True), (0.8, False)])
def test_a_zero_that_may_be_more_than_a_third_of_the_rise_is_doubted(zero_u_K: float, passed: bool) -> None:
    rise = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 9.0])
    shown = {"pattern_K": 0.02, "disc": "F3", "zero_K": 0.6, "warming_K": 2.5}
    fields = xr.Dataset(
        {
            "temperature_rise": (("cycle", "y", "x"), rise[:, None, None] * np.ones((1, 2, 2))),
            "camera_correction_u": ("cycle", [*[zero_u_K] * 5, np.nan]),
        },
        attrs={"discs": json.dumps(shown)},
    )
    share = zero_u_K / np.sqrt(np.mean(rise[:5] ** 2))
    assert zero_share(fields) == pytest.approx(share)
    _, zero = of_fields(fields)
    assert zero.passed is passed and "reference_patch" in zero.remedy and zero.verified is not zero.passed
    assert (f"{100.0 * share:.0f} % of the rise" in zero.evidence) is not passed


def test_a_picture_that_no_disc_confirms_is_not_verified() -> None:
    (picture,) = of_fields(xr.Dataset(attrs={"discs": json.dumps({"untested": "the table moves"})}))
    assert picture.passed and not picture.verified and "(the table moves)" in picture.evidence and picture.remedy


def test_the_mean_rise_of_a_long_test_takes_no_memory_of_all_its_fields(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    rise = rng.normal(2.0, 1.0, (600, 90, 100)).astype(np.float32)
    rise[:, :10] = np.nan
    rise[7] = np.nan
    xr.Dataset({"temperature_rise": (("cycle", "y", "x"), rise)}).to_netcdf(tmp_path / "fields.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "fields.nc", engine="h5netcdf") as fields:
        mean_rise(fields.isel(cycle=slice(2)))
        tracemalloc.start()
        means = mean_rise(fields)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    # A piece is 4 MB in double precision; the fields are 22 MB, and their mean at once takes them twice.
    assert peak < rise.nbytes / 2
    np.testing.assert_allclose(np.delete(means, 7), np.delete(rise, 7, axis=0)[:, 10:].mean((1, 2)), rtol=1e-5)
    assert np.isnan(means[7])
