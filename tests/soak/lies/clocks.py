"""Clocks that lie: late, early, stepped, of another zone, day or year, running at a wrong rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd

from tests.soak.lies.campaigns import HALF
from tests.soak.lies.folder import START, Plant, Seconds, edit_frames, edit_table, edit_times, in_turn, key
from tests.soak.lies.lie import Lie

CLOCK = r"clock|time zone|\bzone|hours? apart|\bdate\b"
LASER = r"laser.*(time|clock|zone|date)|(time|clock|zone|date).*laser|clock"
ENVIRONMENT = r"environment.*(time|clock|date|shift|late|early|cover|day)"
DRIVERS = r"(drivers|duty|load).*(time|clock|date|shift|late|early|cover|day)"
HOUR_S, YEAR_S = 3600.0, 365 * 86400.0
_MIDDLE_S = (HALF - 1) * 252.0


def camera_clock(change: Callable[[Seconds], Seconds]) -> Plant:
    """Change the times of the frames, in s since the start of the test."""
    start = np.datetime64(START.tz_localize(None), "ms")

    def edit(number, frame):
        seconds = (frame.time - start) / np.timedelta64(1, "s")
        changed = float(change(np.array([seconds]))[0])
        return replace(frame, time=start + np.timedelta64(round(1e3 * changed), "ms"))

    return edit_frames(edit)


def late(shift_s: float) -> Callable[[Seconds], Seconds]:
    return lambda seconds: seconds + shift_s


def fast(share: float) -> Callable[[Seconds], Seconds]:
    return lambda seconds: seconds * (1.0 + share)


def stepped(shift_s: float) -> Callable[[Seconds], Seconds]:
    return lambda seconds: seconds + np.where(seconds >= _MIDDLE_S, shift_s, 0.0)


def whole_day(table: pd.DataFrame) -> pd.DataFrame:
    """A log that begins two hours before the test and ends two hours after it; what it shows there is that of the test, mirrored."""
    times = pd.to_datetime(table["time"], utc=True, format="ISO8601")
    before, after = table.iloc[120:0:-1], table.iloc[-2:-122:-1]
    longer = pd.concat([before, table, after], ignore_index=True)
    minutes = times.iloc[0] + pd.to_timedelta(np.arange(-120, len(table) + 120), unit="min")
    return longer.assign(time=minutes.strftime("%Y-%m-%dT%H:%M:%S+00:00"))


def half_without_zone(table: pd.DataFrame) -> pd.DataFrame:
    bare = table["time"].str.removesuffix("+00:00")
    return table.assign(time=bare.where(table["cycle"] >= HALF, table["time"]))


LIES = (
    Lie("camera clock 1 h late (stated 0 s)", CLOCK, camera_clock(late(HOUR_S))),
    Lie("camera clock 1 h early (stated 0 s)", CLOCK, camera_clock(late(-HOUR_S))),
    Lie("camera clock 2 h late (stated 0 s)", CLOCK, camera_clock(late(2 * HOUR_S))),
    Lie("camera clock 6 h late (stated 0 s)", CLOCK, camera_clock(late(6 * HOUR_S))),
    Lie("camera clock 20 min late (stated 0 s)", CLOCK, camera_clock(late(1200.0))),
    Lie("camera clock 40 min late (stated 0 s)", CLOCK, camera_clock(late(2400.0))),
    Lie("camera clock nearly one cycle late (stated 0 s)", CLOCK, camera_clock(late(240.0))),
    Lie("camera clock one cycle late (stated 0 s)", CLOCK, camera_clock(late(252.0))),
    Lie(
        "camera clock 1 h late (nothing stated)",
        CLOCK,
        in_turn(camera_clock(late(HOUR_S)), key("thermography", "clock_offset", None)),
    ),
    Lie(
        "camera clock 15 min late, stated with the wrong sign",
        CLOCK,
        in_turn(camera_clock(late(900.0)), key("thermography", "clock_offset", '"-900 s"')),
    ),
    Lie("camera clock gains 60 s/h", CLOCK, camera_clock(fast(60.0 / HOUR_S))),
    Lie("camera clock gains 10 min/h", CLOCK, camera_clock(fast(600.0 / HOUR_S))),
    Lie("camera clock reset to 2001 in the middle", CLOCK, camera_clock(stepped(-25 * YEAR_S))),
    Lie("camera clock set to summer time in the middle", CLOCK, camera_clock(stepped(HOUR_S))),
    Lie("camera clock set back 10 min in the middle", CLOCK, camera_clock(stepped(-600.0))),
    Lie("camera clock of the year before", CLOCK, camera_clock(late(-YEAR_S))),
    Lie("laser log in local time without zone (+1 h)", LASER, edit_times("laser.csv", late(HOUR_S), zone="")),
    Lie("laser log set to summer time in the middle", LASER, edit_times("laser.csv", stepped(HOUR_S))),
    Lie("laser log set back 1 h in the middle", LASER, edit_times("laser.csv", stepped(-HOUR_S))),
    Lie("laser log of the year before", LASER, edit_times("laser.csv", late(-YEAR_S))),
    Lie("laser log with its zone in the first half only", LASER, edit_table("laser.csv", half_without_zone)),
    Lie(
        "laser times written to the minute",
        LASER,
        edit_times("laser.csv", lambda seconds: 60.0 * np.floor(seconds / 60.0)),
    ),
    Lie("environment log 1 h late", ENVIRONMENT, edit_times("environment.csv", late(HOUR_S))),
    Lie(
        "environment log of the whole day, 1 h late",
        ENVIRONMENT,
        in_turn(edit_table("environment.csv", whole_day), edit_times("environment.csv", late(HOUR_S))),
    ),
    Lie("environment of another day", ENVIRONMENT, edit_times("environment.csv", late(-86400.0))),
    Lie("drivers log 1 h late", DRIVERS, edit_times("drivers.csv", late(HOUR_S))),
    Lie("drivers log 1 h early", DRIVERS, edit_times("drivers.csv", late(-HOUR_S))),
    Lie("drivers log 20 min late", DRIVERS, edit_times("drivers.csv", late(1200.0))),
    Lie("drivers log gains 10 min/h", DRIVERS, edit_times("drivers.csv", fast(600.0 / HOUR_S))),
    Lie(
        "drivers log of the whole day, 1 h late",
        DRIVERS,
        in_turn(edit_table("drivers.csv", whole_day), edit_times("drivers.csv", late(HOUR_S))),
    ),
    Lie(
        "drivers log of the whole day, 20 min early",
        DRIVERS,
        in_turn(edit_table("drivers.csv", whole_day), edit_times("drivers.csv", late(-1200.0))),
    ),
    Lie("drivers of another day", DRIVERS, edit_times("drivers.csv", late(-86400.0))),
)
