"""Recordings on one clock, and the offset that two time zones explain."""

import numpy as np
import pytest

from fusion.app.setup.times import Bar, TimesView, coverage, estimate, recordings_of, shifted
from fusion.campaign.inspect import Recording, scan_folder

MINUTES = np.datetime64("2026-03-09T06:00", "ns") + np.timedelta64(1, "m") * np.arange(121)


@pytest.fixture
def recordings():
    return [Recording("frames", MINUTES + np.timedelta64(2, "h")), Recording("readings", MINUTES[5:110])]


def test_every_recording_of_a_folder_is_there(campaign_folder):
    names = [one.name for one in recordings_of(scan_folder(campaign_folder))]
    assert names == ["frames", "readings", "environment", "drivers"]


def test_two_time_zones_are_estimated_and_the_offset_moves_the_frames_alone(recordings):
    assert coverage(recordings, 0.0).startswith("0% of the readings")
    assert estimate(recordings) == pytest.approx(7200.0, abs=900.0)
    assert coverage(recordings, 7200.0) == "100% of the readings lie between the first and the last frame."
    (frames, readings), (moved, same) = shifted(recordings, 0.0), shifted(recordings, 7200.0)
    assert moved == Bar("frames", frames.start - np.timedelta64(2, "h"), frames.end - np.timedelta64(2, "h"))
    assert same == readings
    assert coverage(recordings[:1], 0.0) == "" and estimate(recordings[1:]) is None


def test_the_slider_moves_the_frames_and_the_estimate_is_offered():
    chosen = []
    view = TimesView(chosen.append)
    view.show([Recording("frames", MINUTES + np.timedelta64(1, "h")), Recording("readings", MINUTES[10:100])], 0.0)
    assert view._take.visible and "two time zones" in view._told.object and not chosen
    view._slider.value = 60.0
    assert chosen == [60.0]
    assert view._bars.data["start"][0] == MINUTES[0] + np.timedelta64(59, "m")
    view._take.clicks += 1
    assert 0 < chosen[-1] <= 3600.0 and not view._take.visible
    assert "100% of the readings" in view._told.object


def test_a_folder_without_times_shows_nothing():
    view = TimesView(lambda offset: None)
    view.show([], 0.0)
    assert not view.view.visible
