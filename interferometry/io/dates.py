"""Dates and times of a whole file: ISO 8601 and the usual other orders, refused where the file does not settle the order."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from interferometry.io.faults import BadReading, LaserFormatError

#: Attribute ``reference`` of times from a file that gives no zone.
NO_ZONE = "no zone in the file: taken as UTC"
#: Years of measurements; others are damage, and the first and last years of the calendar have no UTC.
_YEARS = (1950, 2199)

_MONTHS = {
    name: month
    for month, names in enumerate(
        (
            "jan januar january janv janvier ene enero jän jänner",
            "feb februar february fév févr février fev fevr fevrier febrero",
            "mar mär märz mrz march mars marzo",
            "apr april avr avril abr abril",
            "may mai mayo",
            "jun juni june juin junio",
            "jul juli july juil juillet julio",
            "aug august août aout ago agosto",
            "sep sept september septembre septiembre",
            "oct okt october oktober octobre octubre",
            "nov november novembre noviembre",
            "dec dez december dezember déc décembre decembre dic diciembre",
        ),
        start=1,
    )
    for name in names.split()
}
_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,](?P<fraction>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?"
)
_NUMERIC = re.compile(
    rf"(?P<a>\d{{1,4}})\s*(?P<mark>[./-])\s*(?P<b>\d{{1,2}})\s*[./-]\s*(?P<c>\d{{1,4}})\.?[,T\s]+{_CLOCK}"
)
_NAMED = re.compile(rf"(?P<a>\d{{1,2}}|[^\W\d]+)[.\s-]+(?P<b>\d{{1,2}}|[^\W\d]+)[.,\s-]+(?P<c>\d{{4}})[,T\s]+{_CLOCK}")
_CHINESE = re.compile(rf"(?P<a>\d{{4}})年(?P<b>\d{{1,2}})月(?P<c>\d{{1,2}})日\s*{_CLOCK}")


@dataclass(frozen=True)
class DateOrder:
    """The order of day and month in the dates of a file.

    Attributes
    ----------
    month_first : bool or None
        Whether the month stands before the day where neither the year nor dots decide; None where no date of the file settles it.
    """

    month_first: bool | None = None

    @classmethod
    def of(cls, path: Path, lines: Iterable[tuple[int, str]]) -> DateOrder:
        """Find the order from all dates of a file: one number beyond 12 decides.

        Parameters
        ----------
        path : pathlib.Path
            For the message.
        lines : iterable of (int, str)
            Number of each line and its time.

        Returns
        -------
        DateOrder

        Raises
        ------
        LaserFormatError
            Some dates can only have the day first and others only the month; or no date decides, and day and month differ.
        """
        decided: dict[bool, tuple[int, str]] = {}
        open_question: tuple[int, str] | None = None
        for line, text in lines:
            match = _NUMERIC.fullmatch(text.strip())
            if match is None or len(match["a"]) > 2 or match["mark"] == ".":
                continue
            first, second = int(match["a"]), int(match["b"])
            if first > 12 >= second:
                decided.setdefault(False, (line, text))
            elif second > 12 >= first:
                decided.setdefault(True, (line, text))
            elif first != second:
                open_question = open_question or (line, text)
        if len(decided) == 2:
            (day_line, day), (month_line, month) = decided[False], decided[True]
            raise LaserFormatError(
                f"{path}: the date {day!r} on line {day_line} has the day first, {month!r} on line {month_line} the month; "
                "write all dates as 2026-03-09"
            )
        if open_question is not None and not decided:
            line, text = open_question
            raise LaserFormatError(
                f"{path}, line {line}: {text!r} may have the day or the month first, and no date of the file settles it; "
                "write the dates as 2026-03-09"
            )
        return cls(next(iter(decided), None))


def parse_time(text: str, order: DateOrder | None = None) -> tuple[np.datetime64, str]:
    """Parse a time.

    Parameters
    ----------
    text : str
        ISO 8601, such as 2026-03-09T06:30:05+00:00, or a date in another order and a time of day: "9.3.2026 6:30:05",
        "03/09/2026 6:30 PM", "9 Mar 2026 06:30".
    order : DateOrder, optional
        Of the file; without it dates are only read where their order is plain (year first, dots, names of months).

    Returns
    -------
    time : numpy.datetime64
        UTC, in ns; a time without a zone is taken as UTC.
    zone : str
        Its zone as +hhmm; "" where the text has none.

    Raises
    ------
    BadReading
        The text is not a time.

    Examples
    --------
    >>> parse_time("9.3.2026 6:30:05,25")
    (np.datetime64('2026-03-09T06:30:05.250000000'), '')
    """
    stripped = text.strip()
    try:
        stamp = datetime.fromisoformat(stripped)
    except ValueError:
        stamp = _other_order(text, stripped, order or DateOrder())
    if not _YEARS[0] <= stamp.year <= _YEARS[1]:
        raise BadReading(text, f"lies outside the years {_YEARS[0]} to {_YEARS[1]}")
    zone = "" if stamp.tzinfo is None else stamp.strftime("%z")
    utc = stamp if stamp.tzinfo is None else stamp.astimezone(UTC).replace(tzinfo=None)
    return np.datetime64(utc, "ns"), zone


def _other_order(text: str, stripped: str, order: DateOrder) -> datetime:
    match = _NUMERIC.fullmatch(stripped) or _CHINESE.fullmatch(stripped) or _NAMED.fullmatch(stripped)
    wrong = BadReading(text, "is not an ISO 8601 time such as 2026-03-09T06:30:05+00:00")
    if match is None:
        raise wrong
    year, month, day = _date(match, order, wrong, text)
    hour = int(match["hour"])
    if match["half"]:
        if not 1 <= hour <= 12:
            raise wrong
        hour = hour % 12 + (12 if match["half"][0] in "Pp" else 0)
    fraction = (match["fraction"] or "").ljust(6, "0")[:6]
    clock = f"{hour:02d}:{match['minute']}:{match['second'] or '00'}.{fraction or '000000'}"
    zone = {"Z": "+00:00", "UTC": "+00:00", "GMT": "+00:00", None: ""}.get(match["zone"], match["zone"])
    try:
        return datetime.fromisoformat(f"{year:04d}-{month:02d}-{day:02d}T{clock}{zone}")
    except ValueError:
        raise wrong from None


def _date(match: re.Match[str], order: DateOrder, wrong: BadReading, text: str) -> tuple[int, int, int]:
    """Return year, month and day."""
    a, b, c = match["a"], match["b"], match["c"]
    named = next((name for name in (a, b) if not name.isdecimal()), None)
    if named is not None:
        month = _MONTHS.get(named.casefold())
        day = b if named == a else a
        if month is None or not day.isdecimal():
            raise wrong
        return int(c), month, int(day)
    if len(a) == 4:
        return int(a), int(b), int(c)
    if match.re is _NAMED:
        raise wrong
    if len(c) != 4:
        raise BadReading(text, "has a year of two digits; write it with four")
    if match["mark"] == "." or int(a) == int(b):
        return int(c), int(b), int(a)
    if order.month_first is None:
        raise BadReading(text, "may have the day or the month first; write the date as 2026-03-09")
    return (int(c), int(a), int(b)) if order.month_first else (int(c), int(b), int(a))


def describe_time_zone(path: Path, zones: dict[str, int]) -> str:
    """Return how the times of a file were converted to UTC, in words.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    zones : dict of str to int
        Number of the first line with each zone (+hhmm; "" for none).

    Returns
    -------
    str
        For the attribute ``reference`` of the times.

    Raises
    ------
    LaserFormatError
        Some times have a zone and some have none: the meaning of the latter is unknown.
    """
    if "" in zones and len(zones) > 1:
        other = next(zone for zone in zones if zone)
        raise LaserFormatError(
            f"{path}: the time on line {zones['']} has no zone, that on line {zones[other]} has {other}; write all of them with a zone"
        )
    if "" in zones:
        return NO_ZONE
    if set(zones) == {"+0000"}:
        return "UTC in the file"
    return "converted to UTC from " + ", ".join(sorted(zones))
