"""Shifts by whole quarter hours: found where they cover the readings, not where nothing does."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.zone_shift import covered_share, likely_zone_shift

START = np.datetime64("2026-03-09T06:30", "ns")
READINGS = START + np.arange(0, 4 * 3600, 8).astype("m8[s]")


def span(first_s: float, last_s: float) -> np.ndarray:
    return START + np.array([first_s, last_s], "m8[s]")


def test_the_share_of_readings_within_a_recording() -> None:
    assert covered_share(READINGS, span(0, 4 * 3600)) == 1.0
    assert covered_share(READINGS, span(3600, 5 * 3600)) == pytest.approx(0.75, abs=0.001)
    assert covered_share(READINGS, span(3600, 5 * 3600), late_s=3600.0) == 1.0


@pytest.mark.parametrize("late_s", [900, -900, 3600, -5400, 20_700])
def test_a_shift_by_quarter_hours_is_found(late_s: int) -> None:
    assert likely_zone_shift(READINGS, span(late_s, late_s + 4 * 3600)) == late_s


def test_a_recording_that_covers_or_never_can_has_no_shift() -> None:
    assert likely_zone_shift(READINGS, span(-60, 4 * 3600 + 60)) is None
    assert likely_zone_shift(READINGS, span(0, 2 * 3600)) is None
    assert likely_zone_shift(READINGS, span(100 * 3600, 104 * 3600)) is None
