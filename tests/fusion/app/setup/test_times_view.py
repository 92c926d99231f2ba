"""The slider moves the frames, and the estimate is taken by a button."""

from __future__ import annotations

import numpy as np

from fusion.app.setup.times_view import TimesView
from fusion.starting.time_bars import Recording

MINUTES = np.datetime64("2026-03-09T06:00", "ns") + np.timedelta64(1, "m") * np.arange(121)


def test_the_slider_moves_the_frames_and_the_estimate_is_offered() -> None:
    chosen: list[float] = []
    view = TimesView(chosen.append)
    view.show([Recording("frames", MINUTES + np.timedelta64(1, "h")), Recording("readings", MINUTES[10:100])], 0.0)
    assert view._take.visible and "two time zones" in view._told.object and not chosen
    view._slider.value = 60.0
    assert chosen == [60.0]
    assert view._bars.data["start"][0] == MINUTES[0] + np.timedelta64(59, "m")
    view._take.clicks += 1
    assert 0 < chosen[-1] <= 3600.0 and not view._take.visible
    assert "100% of the readings" in view._told.object


def test_a_folder_without_times_shows_nothing() -> None:
    view = TimesView(lambda offset: None)
    view.show([], 0.0)
    assert not view.view.visible
