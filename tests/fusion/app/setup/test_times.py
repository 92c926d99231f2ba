"""Recordings on one clock, and the offset that two time zones explain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.app.setup.times import Bar, coverage, estimate, recordings_of, shifted
from fusion.starting.folder import scan_folder
from fusion.starting.time_bars import Recording


@pytest.fixture
def recordings() -> list[Recording]:
    start = np.datetime64("2026-03-09T06:00", "ns")
    minutes = np.timedelta64(1, "m") * np.arange(121)
    return [
        Recording("frames", start + np.timedelta64(2, "h") + minutes),
        Recording("readings", start + minutes[5:110]),
    ]


def test_every_recording_of_a_folder_is_there(campaign_folder: Path) -> None:
    names = [one.name for one in recordings_of(scan_folder(campaign_folder))]
    assert names == ["frames", "readings", "environment", "drivers"]


def test_two_time_zones_are_estimated_and_cover_the_readings(recordings: list[Recording]) -> None:
    assert coverage(recordings, 0.0).startswith("0% of the readings")
    assert estimate(recordings) == pytest.approx(7200.0, abs=900.0)
    assert coverage(recordings, 7200.0) == "100% of the readings lie between the first and the last frame."


def test_the_offset_moves_the_frames_alone(recordings: list[Recording]) -> None:
    (frames, readings), (moved, same) = shifted(recordings, 0.0), shifted(recordings, 7200.0)
    assert moved == Bar("frames", frames.start - np.timedelta64(2, "h"), frames.end - np.timedelta64(2, "h"))
    assert same == readings


def test_one_recording_alone_has_neither_coverage_nor_estimate(recordings: list[Recording]) -> None:
    assert coverage(recordings[:1], 0.0) == "" and estimate(recordings[1:]) is None
