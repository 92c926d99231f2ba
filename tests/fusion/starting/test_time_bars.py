"""Bars of time: filled where there are samples, empty in gaps, one axis for all."""

from __future__ import annotations

import numpy as np

from fusion.starting.time_bars import Recording, time_bars

START = np.datetime64("2026-03-09T06:00:00", "ns")


def every(minutes: float, first_min: float, last_min: float) -> np.ndarray:
    steps = np.arange(first_min, last_min + 1e-9, minutes)
    return START + (steps * 60e9).astype("timedelta64[ns]")


def test_bars_lie_on_one_axis() -> None:
    lines = time_bars(
        [
            Recording("frames", every(2, 60, 120)),
            Recording("laser", every(1, 0, 60)),
            Recording("log", every(5, 0, 120)),
        ],
        width=40,
    )
    assert lines[0] == f"frames  {'·' * 20}{'█' * 20}"
    assert lines[1] == f"laser   {'█' * 20}{'·' * 20}"
    assert lines[2] == f"log     {'█' * 40}"
    assert lines[3] == "UTC     2026-03-09 06:00 2.0 h  2026-03-09 08:00"


def test_gaps_and_recordings_without_times_are_named() -> None:
    gap = np.concatenate([every(1, 0, 30), every(1, 90, 120)])
    untimed = np.full(3, np.datetime64("NaT", "ns"))
    lines = time_bars([Recording("frames", gap), Recording("laser", untimed)], width=40)
    assert lines[0] == f"frames  {'█' * 10}{'·' * 20}{'█' * 10}  1 gap"
    assert lines[1] == f"laser   no times{'·' * 32}"
    assert time_bars([Recording("laser", untimed)]) == []


def test_one_sample_is_seen() -> None:
    lines = time_bars([Recording("a", every(1, 0, 0)), Recording("b", every(1, 0, 60))], width=30)
    assert lines[0] == f"a    {'█'}{'·' * 29}"
    assert Recording("same", np.repeat(START, 4)).stretches() == [(START, START)]


def test_a_test_without_a_date_counts_from_its_start() -> None:
    seconds = np.datetime64("1970-01-01", "ns") + (np.arange(0, 36_000, 60) * 10**9).astype("timedelta64[ns]")
    assert time_bars([Recording("record", seconds)], width=40)[1] == f"        start{'':<29}10.0 h"
