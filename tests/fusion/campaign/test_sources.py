"""Tests of the windows that stand for cycles where no laser gives them."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.campaign.sources import cycles_of_frames, usual_window_s

START = np.datetime64("2026-03-09T08:00", "ns")


def frames(*minutes: float) -> np.ndarray:
    return START + np.round(np.array(minutes) * 60e9).astype("timedelta64[ns]")


def test_windows_follow_each_other_and_hold_every_frame() -> None:
    times = frames(*range(13))
    cycles = cycles_of_frames(times, 300.0)
    assert cycles.number.tolist() == [1, 2, 3]
    assert (cycles.bounds[1:, 0] == cycles.bounds[:-1, 1]).all()
    inside = (times[:, None] >= cycles.bounds[:, 0]) & (times[:, None] < cycles.bounds[:, 1])
    assert inside.sum(axis=1).tolist() == [1] * 13


def test_a_window_without_a_frame_is_left_out_and_the_number_says_so() -> None:
    assert cycles_of_frames(frames(0, 1, 17), 300.0).number.tolist() == [1, 4]


@pytest.mark.parametrize(
    ("times", "window_s"),
    [
        (frames(*np.arange(0, 240)), 300.0),  # four hours: 48 windows of 5 min
        (frames(*np.arange(0, 10, 1 / 60)), 10.0),  # ten minutes at 1 Hz: 60 windows of 10 s
        (frames(0, 45, 90), 3600.0),  # a frame in 45 min: an hour is the first usual length that holds one
        (frames(0, 1), 60.0),
        (frames(*np.arange(0, 0.004, 0.0005)), 0.05),  # 0.2 s at 33 Hz: shorter than every usual length
        (frames(0, 0.0661), 2.0),  # two frames 4 s apart: two windows
        (frames(0, 1e-8), 6e-7),
    ],
)
def test_the_usual_window_is_a_round_time_and_makes_at_most_sixty(times: np.ndarray, window_s: float) -> None:
    assert usual_window_s(times) == window_s
    assert cycles_of_frames(times, window_s).number.size <= 61
