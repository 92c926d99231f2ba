"""Times: ISO 8601, the usual other orders, and the file as a whole deciding between day and month."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from interferometry.io.dates import DateOrder, describe_time_zone, parse_time
from interferometry.io.faults import BadReading, LaserFormatError

PATH = Path("t.csv")


def test_times_become_utc_and_keep_their_zone() -> None:
    assert parse_time("2026-03-09T06:30:05+01:00") == (np.datetime64("2026-03-09T05:30:05"), "+0100")
    assert parse_time("2026-03-09T06:30:05") == (np.datetime64("2026-03-09T06:30:05"), "")


@pytest.mark.parametrize(
    "text",
    [
        "9.3.2026 6:30:05",
        "09.03.2026 06:30:05",
        "2026/03/09 06:30:05",
        "2026.3.9 6:30:05",
        "9 Mar 2026 06:30:05",
        "9-Mar-2026 06:30:05",
        "9. März 2026, 06:30:05",
        "Mar 9, 2026 6:30:05 AM",
        "9 mars 2026 06:30:05",
        "9 marzo 2026 06:30:05",
        "2026年3月9日 6:30:05",
    ],
)
def test_dates_of_plain_order_are_read(text: str) -> None:
    assert parse_time(text) == (np.datetime64("2026-03-09T06:30:05"), "")


def test_halves_of_the_day_fractions_and_zones_are_read() -> None:
    assert parse_time("9.3.2026 12:30:05 AM")[0] == np.datetime64("2026-03-09T00:30:05")
    assert parse_time("9.3.2026 6:30 pm")[0] == np.datetime64("2026-03-09T18:30:00")
    assert parse_time("9.3.2026 6:30:05,25")[0] == np.datetime64("2026-03-09T06:30:05.25")
    assert parse_time("9.3.2026 6:30:05 +02:00") == (np.datetime64("2026-03-09T04:30:05"), "+0200")


@pytest.mark.parametrize(("decider", "expected"), [("13/3/2026 6:00", "2026-03-09"), ("3/13/2026 6:00", "2026-09-03")])
def test_one_date_beyond_the_twelfth_decides_for_the_file(decider: str, expected: str) -> None:
    order = DateOrder.of(PATH, [(2, "9/3/2026 6:30"), (3, decider)])
    assert parse_time("9/3/2026 6:30", order)[0] == np.datetime64(f"{expected}T06:30")


def test_dates_that_no_line_settles_are_refused_with_their_line() -> None:
    with pytest.raises(LaserFormatError, match=r"line 2: '9/3/2026 6:30' may have the day or the month first"):
        DateOrder.of(PATH, [(2, "9/3/2026 6:30"), (3, "3/3/2026 6:30")])
    with pytest.raises(
        LaserFormatError, match=r"'13/3/2026 6:00' on line 2 has the day first, '3/13/2026 6:00' on line 3"
    ):
        DateOrder.of(PATH, [(2, "13/3/2026 6:00"), (3, "3/13/2026 6:00")])
    # The third of March is the same in both orders.
    assert parse_time("3/3/2026 6:30", DateOrder.of(PATH, [(2, "3/3/2026 6:30")]))[0] == np.datetime64(
        "2026-03-03T06:30"
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("half past six", "is not an ISO 8601 time"),
        ("31.2.2026 06:30", "is not an ISO 8601 time"),
        ("9.3.2026 25:30", "is not an ISO 8601 time"),
        ("9.3.2026 13:30 PM", "is not an ISO 8601 time"),
        ("9 Foo 2026 06:30", "is not an ISO 8601 time"),
        ("9.3.26 06:30", "has a year of two digits"),
        ("0001-01-01T00:00+14:00", "lies outside the years 1950 to 2199"),
        ("9/3/2026 6:30", "may have the day or the month first"),
    ],
)
def test_what_is_no_time_is_named(text: str, reason: str) -> None:
    with pytest.raises(BadReading, match=reason):
        parse_time(text)


def test_zones_are_described_and_must_not_be_mixed_with_none() -> None:
    assert describe_time_zone(PATH, {"+0000": 2}) == "UTC in the file"
    assert describe_time_zone(PATH, {"": 2}) == "no zone in the file: taken as UTC"
    assert describe_time_zone(PATH, {"+0200": 2, "+0100": 5}) == "converted to UTC from +0100, +0200"
    with pytest.raises(LaserFormatError, match=r"the time on line 7 has no zone, that on line 2 has \+0100"):
        describe_time_zone(PATH, {"+0100": 2, "": 7})
