"""The screen *Live*: a course of cycles, its charts and words, and in a browser a campaign that is followed and stopped by keyboard."""

import shutil

import numpy as np
import xarray as xr

from fusion.app.live import (
    Course,
    LiveScreen,
    LiveSession,
    enough_words,
    plot_course,
    plot_field,
    plot_rise,
    plot_standard,
    standing,
)
from fusion.app.parts import State
from fusion.pipeline.watch import Enough, FinishedCycle, LiveState
from tests.fusion.app.texts import texts
from tests.fusion.campaign_parts import keep_cycles

NAT = np.datetime64("NaT", "ns")


def state_of(number, *, low=20.0, warnings=()):
    """A state after a cycle of two targets."""
    field = xr.DataArray(np.full((2, 3), low), dims=("y", "x"), coords={"y": [5.0, 15.0], "x": [5.0, 15.0, 25.0]})
    cycle = FinishedCycle(number, NAT, NAT, 3, field, (low, low + 2.0), 0.5 * number, np.array([1.0, 2.0]) * number)
    enough = Enough(number, 1.0 / number, 40, "") if number > 1 else None
    return LiveState(
        3 * number, 4 * number, number, cycle, {"A": 4.0} if number > 1 else {}, "cycles 1 to 2", enough, warnings
    )


def test_a_course_keeps_numbers_of_every_cycle_one_field_and_the_latest_warnings():
    course = Course()
    for number, low in ((1, 20.0), (2, 18.0), (3, 21.0)):
        course.take(state_of(number, low=low))
    course.take(LiveState(99, 98, 3, None, {}, "", None, ("late",)))
    assert [one.number for one in course.cycles] == [1, 2, 3]
    assert [(one.mean_drift_um, one.last_drift_um) for one in course.cycles] == [(1.5, 2.0), (3.0, 4.0), (4.5, 6.0)]
    assert course.with_field.number == 3 and course.field_range_degC == (18.0, 23.0)
    assert all(one.field is None for one in course.cycles)
    assert course.iso230_um == {2: {"A": 4.0}, 3: {"A": 4.0}}
    assert (course.frames, course.readings, course.warnings) == (99, 98, ["late"])
    assert course.enough.cycles == 3
    course = Course()
    for number in range(1, 50):
        course.take(state_of(number, warnings=(f"warning {number}",)))
    assert course.warnings[0] == "warning 20" and len(course.warnings) == 30


def test_a_running_test_is_followed_until_it_is_ended(copied, tmp_path):
    """Six cycles of the laser alone; the last one is finished when following ends."""
    text = (copied / "campaign.toml").read_text(encoding="utf-8")
    laser = text[: text.index("[thermography]")] + text[text.index("[interferometry]") : text.index("[drivers]")]
    rows = (copied / "laser.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "campaign.toml").write_text(laser.replace("material_sensor", "# material_sensor"), encoding="utf-8")
    for name in ("laser.csv", "environment.csv"):
        shutil.copy(copied / name, tmp_path / name)
    (tmp_path / "laser.csv").write_text("\n".join(rows[: 1 + 6 * 12]) + "\n", encoding="utf-8")
    session = LiveSession(tmp_path / "campaign.toml", wanted_u_um=0.5, poll_s=0.01)
    assert session.runs
    session.end(60.0)
    assert not session.runs and session.fault == ""
    assert [one.number for one in session.course.cycles] == [1, 2, 3, 4, 5, 6]
    assert session.course.readings == 72 and session.course.with_field is None and session.version > 0


def test_charts_say_what_is_seen_and_nothing_is_drawn_before_a_cycle_is_finished():
    assert [plot(Course()) for plot in (plot_field, plot_course, plot_rise, plot_standard)] == [None] * 4
    course = Course()
    for number in (1, 2, 3):
        course.take(state_of(number))
    field, drift, rise, standard = (plot(course) for plot in (plot_field, plot_course, plot_rise, plot_standard))
    assert "in cycle 3: 20.00 to 20.00 °C" in field.seen
    assert "3 cycles, drift: mean of the targets 1.50 to 4.50 µm" in drift.seen
    assert [chart.figure.yaxis.axis_label for chart in (drift, rise)] == ["drift / µm", "rise of the table / K"]
    assert standard.seen == "By ISO 230-2, cycles 1 to 2: A 4.00 µm."


def test_it_says_whether_the_cycles_are_enough():
    course = Course()
    assert enough_words(course, 0.1) == "Whether the cycles are enough cannot be told yet."
    for number in range(1, 5):
        course.take(state_of(number))
    assert enough_words(course, 0.1) == (
        "The cycles are not enough yet: after 4 of them the standard uncertainty of a position against the first one is 0.25 µm, and 40 "
        "cycles reach 0.1 µm."
    )
    assert "Following: 4 finished cycles, 12 frames, 16 readings." in standing(course, 0.1, runs=True)


def test_a_missing_campaign_and_one_outside_the_folder_are_named(tmp_path):
    screen = LiveScreen(State(root=tmp_path))
    screen._on_start(None)
    assert "no such campaign file" in texts([screen.view])
    screen._campaign.value = "/etc/passwd"
    screen._on_start(None)
    assert "outside" in texts([screen.view])


def test_a_test_is_followed_and_stopped_by_keyboard(app, new_page):
    keep_cycles(app[1] / "laser.csv", *range(1, 7))
    page = new_page(app[0], width=390)
    page.get_by_role("button", name="Live", exact=True).press("Enter")
    page.get_by_role("button", name="Follow", exact=True).press("Enter")
    page.get_by_text("Following: 5 finished cycles").wait_for(timeout=60_000)
    page.get_by_role("button", name="Stop following").press("Enter")
    page.get_by_text("No longer followed: 6 finished cycles").wait_for(timeout=60_000)
    page.get_by_text("Temperature of the table in cycle").wait_for()
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
