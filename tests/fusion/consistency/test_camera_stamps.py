"""Consistency checks of the camera's stamps: order, rate of its clock, place in the motion of the axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.consistency.camera_stamps import check_order, check_phase
from fusion.consistency.checks import Check
from tests.fusion.consistency.twin_fields import recorded
from thermography.io.flir import FrameReference, index_frames


def phase(seconds_late: float = 0.0, *, gain_s_per_h: float = 0.0, keep: slice = slice(None)) -> dict[str, Check]:
    test = recorded()
    true = test.fields["time"].values
    since = (true - true[0]) / np.timedelta64(1, "s")
    stamps = true + (1e9 * (seconds_late + gain_s_per_h / 3600.0 * since)).astype("m8[ns]")
    return {check.code: check for check in check_phase(stamps[keep], test.deviations)}


def test_frames_at_the_end_of_each_cycle_pass() -> None:
    found = phase()
    assert found["camera_rate"].passed and found["camera_rate"].value == pytest.approx(0.0, abs=0.01)
    assert found["camera_phase"].passed and found["camera_phase"].value == 0.0


@pytest.mark.parametrize("gain", [60.0, 600.0, -60.0])
def test_a_clock_that_gains_is_doubted_and_its_rate_said(gain: float) -> None:
    found = phase(gain_s_per_h=gain)
    assert not found["camera_rate"].passed
    # Places are counted in cycles of the camera's own clock: 1/6 of a gain of 600 s/h is of second order.
    assert found["camera_rate"].value == pytest.approx(gain, rel=0.2)


def test_a_clock_that_gains_some_seconds_passes() -> None:
    assert phase(gain_s_per_h=3.0)["camera_rate"].passed


@pytest.mark.parametrize("minutes", [20.0, 60.0, -60.0])
def test_frames_that_are_stamped_in_the_motion_are_doubted(minutes: float) -> None:
    found = phase(60.0 * minutes)
    assert found["camera_rate"].passed
    assert not found["camera_phase"].passed and found["camera_phase"].value > 0.9
    assert "clock_offset" in found["camera_phase"].remedy


def test_missing_frames_change_nothing() -> None:
    found = phase(keep=slice(0, 40))
    assert found["camera_rate"].passed and found["camera_phase"].passed
    assert not phase(gain_s_per_h=60.0, keep=slice(0, 40))["camera_rate"].passed


@pytest.mark.parametrize("interval_s", [10.0, 60.0, 190.0, 400.0])
def test_a_camera_on_its_own_timer_tells_nothing(interval_s: float) -> None:
    test = recorded()
    first, last = test.fields["time"].values[[0, -1]]
    stamps = np.arange(first, last, np.timedelta64(round(interval_s), "s"))
    found = check_phase(stamps, test.deviations)
    assert [check.passed for check in found] == [True, True]
    assert all("cannot be told" in check.evidence for check in found)


def test_few_cycles_tell_nothing() -> None:
    test = recorded()
    short = test.deviations.isel(cycle=slice(0, 8))
    assert all(check.passed for check in check_phase(test.fields["time"].values[:8], short))
    no_times = test.deviations.assign(time=xr.full_like(test.deviations["time"], np.datetime64("NaT")))
    assert all(check.passed for check in check_phase(test.fields["time"].values, no_times))


@pytest.fixture
def frames(campaign_folder: Path) -> list[FrameReference]:
    references, _ = index_frames(sorted((campaign_folder / "thermal").iterdir()))
    return references[:6]


def test_a_clock_that_was_set_back_is_doubted(frames: list[FrameReference]) -> None:
    (sound,) = check_order(frames)
    assert sound.passed
    back = [*frames[:3], *(replace(frame, time=frame.time - np.timedelta64(1, "h")) for frame in frames[3:])]
    (found,) = check_order(sorted(back, key=lambda frame: frame.time))
    assert not found.passed and found.value == 1.0
    assert "IR_0004.jpg is 3420 s before IR_0003.jpg" in found.evidence
    assert check_order([]) == []


def test_a_counter_that_starts_anew_is_no_clock_set_back(frames: list[FrameReference]) -> None:
    folder = frames[0].path.parent
    names = ("IR_9998.jpg", "IR_9999.jpg", "IR_0001.jpg", "IR_0002.jpg")
    renamed = [replace(frame, path=folder / name) for frame, name in zip(frames, names, strict=False)]
    assert check_order(renamed)[0].passed


def test_frames_of_one_file_go_by_their_index(frames: list[FrameReference]) -> None:
    sequence = [replace(frame, path=Path("a.seq"), index=k) for k, frame in enumerate(frames)]
    assert check_order(sequence)[0].passed
    swapped = [replace(sequence[0], index=1), replace(sequence[1], index=0), *sequence[2:]]
    assert not check_order(swapped)[0].passed


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
    for renamed in (shuffled, two_exchanged):
        (check,) = check_order(numbered(renamed, like))
        assert check.passed and "the times were taken" in check.evidence
    set_back = seconds - np.where(np.arange(40) >= 20, 600.0, 0.0)
    other_year = seconds - np.where(np.arange(40) >= 20, 25 * 365 * 86400.0, 0.0)
    for wrong in (set_back, other_year, seconds - np.where(np.arange(40) >= 20, 504.0, 0.0)):
        (check,) = check_order(numbered(wrong, like))
        assert not check.passed and "goes backwards 1 times" in check.evidence
