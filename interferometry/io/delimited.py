"""Delimited text files with a header line: columns by name, unusable lines listed by number."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import xarray as xr

from interferometry.errors import InterferometryError

#: Values that instruments write for "no reading"; Renishaw's is -1e20.
SENTINEL_MAGNITUDE = 1e19
#: Attribute ``reference`` of times from a file that gives no zone.
NO_ZONE = "no zone in the file: taken as UTC"


class LaserFormatError(InterferometryError):
    """A laser or environment file that cannot be used as a whole; the message names file, place, value and remedy."""


@dataclass(frozen=True)
class RejectedLine:
    """One line of a file that was left out.

    Attributes
    ----------
    path : str
        Name of the file.
    line : int
        Its number, from 1.
    value : str
        The text that could not be used.
    reason : str
        Why, as the predicate of a sentence about the value ("is not a number").
    """

    path: str
    line: int
    value: str
    reason: str


class BadReading(InterferometryError):
    """A line that cannot be used; it is caught by the reader, which lists the line as a `RejectedLine`.

    Parameters
    ----------
    value : str
        The text that could not be used.
    reason : str
        Why, as the predicate of a sentence about the value.
    """

    def __init__(self, value: str, reason: str) -> None:
        super().__init__(f"{value!r}: {reason}")
        self.value = value
        self.reason = reason


@dataclass(frozen=True)
class DelimitedTable:
    """A delimited file: its column names and its rows with their line numbers.

    Attributes
    ----------
    path : pathlib.Path
    columns : tuple of str
        Names of the header line, stripped.
    rows : list of (int, list of str)
        Number of each line in the file, from 1, and its fields.
    decimal_comma : bool
        Whether numbers may be written "0,64", as spreadsheets do where semicolons separate the fields.
    """

    path: Path
    columns: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    decimal_comma: bool

    def records(self) -> Iterator[tuple[int, dict[str, str] | None]]:
        """Yield line number and fields by column name; None where the number of fields is wrong."""
        for line, fields in self.rows:
            yield line, dict(zip(self.columns, fields, strict=True)) if len(fields) == len(self.columns) else None

    def number(self, text: str) -> float:
        """Return a finite number; raises `BadReading` where the text is none."""
        cleaned = text.strip().replace(",", ".") if self.decimal_comma else text.strip()
        try:
            value = float(cleaned)
        except ValueError:
            raise BadReading(text, "is not a number") from None
        if not math.isfinite(value) or abs(value) >= SENTINEL_MAGNITUDE:
            raise BadReading(text, "is not a finite number")
        return value

    def count(self, text: str) -> int:
        """Return a whole number from 1; raises `BadReading` where the text is none."""
        value = self.number(text)
        if value != int(value) or value < 1:
            raise BadReading(text, "is not a whole number from 1")
        return int(value)


def read_table(path: Path, required: tuple[str, ...]) -> DelimitedTable:
    """Read a delimited text file and check that it has the required columns.

    Byte-order marks, CR LF line ends, empty lines, lines that start with ``#``, and commas, semicolons or tabs between the
    fields are all accepted.

    Parameters
    ----------
    path : pathlib.Path
    required : tuple of str
        Names of the columns that must exist; others are allowed.

    Returns
    -------
    DelimitedTable

    Raises
    ------
    LaserFormatError
        The file is empty or not UTF-8 text, or a column is missing or repeated.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise LaserFormatError(f"{path}: byte {fault.start} is not UTF-8 text; save the file as CSV in UTF-8") from None
    _, header = find_header(text.splitlines())
    if not header:
        raise LaserFormatError(f"{path}: the file is empty; expected a header line {','.join(required)}")
    delimiter = delimiter_of(header)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    lines = [
        (reader.line_num, fields)
        for fields in reader
        if any(f.strip() for f in fields) and not fields[0].startswith("#")
    ]
    head_line, names = lines[0][0], tuple(name.strip() for name in lines[0][1])
    missing = [name for name in required if name not in names]
    if missing:
        raise LaserFormatError(
            f"{path}, line {head_line}: no column {', '.join(missing)}; the header is {','.join(names)!r}, "
            f"expected {','.join(required)!r} (names carry the unit: convert the values and rename the column)"
        )
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise LaserFormatError(
            f"{path}, line {head_line}: column {', '.join(repeated)} occurs more than once; keep one"
        )
    return DelimitedTable(path, names, lines[1:], delimiter == ";")


def find_header(lines: Iterable[str]) -> tuple[int, str]:
    """Find the header: the first line that is neither empty nor starts with ``#``.

    Parameters
    ----------
    lines : iterable of str
        Of the file, from the first.

    Returns
    -------
    before : int
        Number of lines before the header.
    header : str
        The line; "" where there is none.
    """
    return next(((i, line) for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), (0, ""))


def delimiter_of(header: str) -> str:
    """Return the delimiter of a header line: comma, semicolon or tab, whichever it contains most often.

    Parameters
    ----------
    header : str

    Returns
    -------
    str
        One character.
    """
    return max(",;\t", key=header.count)


def read_timed_rows(
    table: DelimitedTable, variables: Mapping[str, Mapping[str, str]], parse: Callable[[dict[str, str]], list[float]]
) -> xr.Dataset:
    """Read the rows of a table that has a column ``time`` into a Dataset.

    Parameters
    ----------
    table : DelimitedTable
    variables : mapping of str to mapping
        Attributes (units and others) of the variables by name, in the order in which `parse` returns their values.
    parse : callable
        Takes the fields of a line by column, returns its values; raises `BadReading` where one cannot be used.

    Returns
    -------
    xarray.Dataset
        The variables along ``time`` (UTC, increasing); ``attrs["left_out"]`` is a JSON list of the lines left out.

    Raises
    ------
    LaserFormatError
        Fewer than half of the lines can be used, or only some times have a zone.
    """
    rows: dict[np.datetime64, list[float]] = {}
    left_out: list[RejectedLine] = []
    zones: dict[str, int] = {}
    for line, fields in table.records():
        try:
            if fields is None:
                raise BadReading("", f"does not have {len(table.columns)} fields")
            time, zone = parse_time(fields["time"])
            if time in rows:
                raise BadReading(fields["time"], "occurs on an earlier line too, which is kept")
            rows[time] = parse(fields)
        except BadReading as fault:
            left_out.append(RejectedLine(table.path.name, line, fault.value, fault.reason))
            continue
        zones.setdefault(zone, line)
    raise_if_mostly_invalid(table.path, len(rows), left_out)
    times = sorted(rows)
    values = np.array([rows[time] for time in times])
    dataset = xr.Dataset(
        {name: (("time",), values[:, column], dict(attrs)) for column, (name, attrs) in enumerate(variables.items())},
        coords={"time": np.array(times, dtype="datetime64[ns]")},
        attrs={"source": table.path.name, "left_out": json.dumps([asdict(line) for line in left_out])},
    )
    dataset["time"].attrs["reference"] = describe_time_zone(table.path, zones)
    return dataset


def parse_time(text: str) -> tuple[np.datetime64, str]:
    """Parse an ISO 8601 time.

    Parameters
    ----------
    text : str
        Such as 2026-03-09T06:30:05+00:00; a time without a zone is taken as UTC.

    Returns
    -------
    time : numpy.datetime64
        UTC, in ns.
    zone : str
        Its zone as +hhmm; "" where the text has none.

    Raises
    ------
    BadReading
        The text is not a time.
    """
    try:
        stamp = datetime.fromisoformat(text.strip())
    except ValueError:
        raise BadReading(text, "is not an ISO 8601 time such as 2026-03-09T06:30:05+00:00") from None
    zone = "" if stamp.tzinfo is None else stamp.strftime("%z")
    utc = stamp if stamp.tzinfo is None else stamp.astimezone(UTC).replace(tzinfo=None)
    return np.datetime64(utc, "ns"), zone


def raise_if_mostly_invalid(path: Path, kept: int, left_out: list[RejectedLine]) -> None:
    """Raise where fewer than half of the lines can be used: that is a fault of the file, not of single readings.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    kept : int
        Number of lines that can be used.
    left_out : list of RejectedLine
        Those that cannot.

    Raises
    ------
    LaserFormatError
        There are no lines, or more lines were left out than kept.
    """
    if kept == 0 and not left_out:
        raise LaserFormatError(f"{path}: no reading below the header; export the measured values again")
    if kept < len(left_out):
        first = left_out[0]
        raise LaserFormatError(
            f"{path}: {len(left_out)} of {kept + len(left_out)} lines cannot be used, the first is line {first.line}: "
            f"{first.value!r} {first.reason}; correct that column"
        )


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
