"""Logged tables: the drivers of a campaign, and a record of sensors and channels over time."""

from __future__ import annotations

import fnmatch
import io
import json
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate, chain, count
from pathlib import Path
from typing import Any
from unicodedata import normalize
from zoneinfo import available_timezones

import numpy as np
import pandas as pd
import xarray as xr
from pandas.io.parsers import TextParser  # type: ignore[attr-defined]

from fusion.analysis.alignment.sensor_health import SensorFault, examine_readings, examine_sensors
from fusion.campaign.config import Campaign, CampaignError, ColumnTable, HeaderRows, LoggedTable, RecordTable
from fusion.campaign.time_zones import bring_to_utc, from_zone
from fusion.campaign.values import (
    BESIDE,
    DAY_NUMBERS,
    TIME_UNITS,
    QuantityError,
    column_conversion,
    has_unit,
    is_unit,
    name_and_unit,
    role_of_unit,
    unit_name,
)
from fusion.common import Array, FusionError
from fusion.results.progress import counted
from interferometry.io import tables
from interferometry.io.faults import (
    SENTINEL_MAGNITUDE,
    THOUSANDS,
    LaserFormatError,
    Numerals,
    RejectedLine,
    parts_thousands,
    raise_if_mostly_invalid,
)
from interferometry.io.spreadsheets import Cell, cell_text, is_workbook, read_cells
from thermofuse.resources import by_word, vocabulary
from thermofuse.units import find_unit

#: Warning of pandas about a line with more fields than the header.
_SKIPPED = re.compile(r"Skipping line (\d+): expected (\d+) fields, saw (\d+)")
#: What the readings and the model call their own variables: a driver of that name would stand in their place.
_TAKEN = (
    "cycle", "direction", "target", "position", "time", "deviation", "quality_flag", "inside_frames", "effect", "period", "mean_rise",
    "axis_integral", "local_rise", "patch_mean_rise", "patch_axis_integral", "driver_time", "environment_time", "frame_time", "correlation",
    "warm_up",
)  # fmt: skip
#: Seconds beyond these are damaged numbers: LabVIEW counts from 1904, 4.5e9 s reach to 2046.
_LONGEST_RECORD_S = 4.5e9
#: A log in which no channel writes for so many of their usual intervals is interrupted: at random, 1 in 2**10.
_LONGEST_SILENCE = 10.0
#: A zone by its place, in a heading.
_PLACE = re.compile(r"[A-Z][a-z]+/[A-Z][\w+-]+(?:/[A-Z]\w+)?")
#: A line above a table that states the zone of its times.
_OF_ZONE = re.compile(r"zone|zona|fuseau|(utc|gmt).?offset", re.IGNORECASE)
_OFFSET = re.compile(r"(?<!\d)([+-]\d\d):?(\d\d)")
#: Heading of the milliseconds beside a time.
_MILLISECONDS = re.compile(r"ms(ec)?|milliseconds?|sub ?sec", re.IGNORECASE)
#: Names of columns that hold a part of a time each -> the part.
PARTS = by_word(vocabulary("logs")["parts"])
#: Counters of loggers, in bits, and the largest step over which they are seen to begin again, in usual steps.
_COUNTERS, _LARGEST_STEP = (16, 32), 2.0
#: A heading in quotes that goes on in the next line, as Excel's Alt+Enter writes it, and the most lines of such headings.
_OPEN_HEADING = re.compile(r'(?:^|[,;\t])\s*"[^"]*$')
_LONGEST_HEADER = 20
#: Comma as a decimal mark, words, and words with one space between them.
_COMMA_NUMBER = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_WORDS, _APART = re.compile(r"\S+"), re.compile(r"\S+(?: \S+)*")
#: How spaces part names (words, with a unit in brackets, up to one), and values (words, with AM or PM, and with the date before it).
_UNIT = r"[\[(][^\])]*[\])]"
_NAMES = (_WORDS, _APART, re.compile(rf"\S+(?: {{1,2}}{_UNIT})?"), re.compile(rf"[^\s\[(][^\[(]*{_UNIT}"))
_HALF = r"\d+:\d\d\S*(?: [AaPp]\.?[Mm]\.?)?|\S+"
_VALUES = (_WORDS, re.compile(_HALF), re.compile(rf"(?:\d+[-/.]\d+[-/.]\d+ )?{_HALF}"))
#: Most rows that hold all channels of a table whose channels stand on rows apart, and stretches in each of which every channel has one.
_TOGETHER, _STRETCHES = 0.01, 10
#: Lines with nothing but a rule.
_RULED = re.compile(r"[\s=_+-]*")
#: Lines in which the values of a table have begun.
HEAD = 200
#: Rows of values, one below the other, that are no accident.
ROWS_OF_VALUES = 3
#: Rows that may stand between them: an empty one, a remark, a header that is repeated.
_ROWS_BETWEEN = 2
VALUE = re.compile(r"[-+]?\s*[\d.,]*\d[\d.,]*([eE][-+]?\d+)?|nan|[-+]?inf|n/?a|\d{1,4}[-/.:]\d{1,2}[-/.:].*", re.I)
#: Lines of values by which the columns of a text are found.
_SAMPLE = 200
#: Channel, date, time and value as EPICS' camonitor prints them.
MONITORED = re.compile(r"\S+\s+\d{4}-\d\d-\d\d\s\d\d:\d\d:\d\d(\.\d+)?\s+\S")
#: Temperature at which air boils: nothing in a shop is colder, K.
_LIQUID_AIR_K = 79.0
#: A unit of each role, for a message.
_EXAMPLES = {"temperature": '"degC"', "displacement": '"um" (or "mm")', "driver": '"1/min" (or "1" for a pure number)'}
#: What a line that sums up those above it is called.
_SUMMARY = re.compile(rf"(?<![^\W\d_])({'|'.join(vocabulary('logs')['summaries'])})(?![^\W\d_])", re.IGNORECASE)
#: Texts by which a log of changes says that a channel gives no value any more.
_NOT_CONNECTED = vocabulary("logs")["not_connected"]
#: Most lines of a table that sum it up.
_MOST_SUMMARIES = 5
#: Where seconds count from in a table whose start is not stated.
NO_START = np.datetime64("1970-01-01", "ns")


class TableError(CampaignError):
    """A logged table that cannot be used; the message names file, column and remedy."""


def split_heading(path: Path, heading: str) -> tuple[str, str]:
    """Return name and unit of a heading such as ``"t1 [degC]"`` or ``"t1(°C)"``."""
    name, unit = name_and_unit(heading)
    if not unit and name == heading.strip():
        raise TableError(
            f'{path}: the column "{heading}" has no unit; write it in the heading, for example "{heading} [1]" for a pure number'
        )
    return name, unit


def match_columns(patterns: Iterable[str], headings: Iterable[str]) -> tuple[str, ...]:
    """Return the headings that column names or patterns (``*`` for any text) select, in the order of the file."""
    headings = list(headings)
    selected: set[str] = set()
    for pattern in patterns:
        escaped = normalize("NFC", pattern).replace("[", "[[]")
        # A heading that is called so is meant, whatever else it would match as a pattern; é may be one character or two.
        matching = {pattern} & set(headings) or {
            heading for heading in headings if fnmatch.fnmatchcase(normalize("NFC", heading), escaped)
        }
        if not matching:
            raise CampaignError(f'no column is named "{pattern}"; the file has: {", ".join(headings)}')
        selected |= matching
    return tuple(heading for heading in headings if heading in selected)


def read_drivers(path: str | Path, layout: LoggedTable | None = None) -> xr.Dataset:
    """Read what was logged beside the instruments: loads, speeds, coolant.

    Parameters
    ----------
    path : str or Path
        Table with a column ``time`` and columns named ``"name [unit]"``.
    layout : LoggedTable, optional
        What a campaign file says of a table that is laid out in another way.

    Returns
    -------
    Dataset
        Every column over ``time`` in its own unit; times with a zone in UTC, others as they are.

    Raises
    ------
    TableError
        A heading, a time or a number cannot be read; the message names file, line and column.

    Notes
    -----
    docs/formats.md lists the kinds of tables.

    Examples
    --------
    >>> from fusion import align
    >>> fused = align(deviations, fields, axis, drivers=read_drivers("drivers.csv"))  # doctest: +SKIP
    """
    log = _read_log(Path(path), layout)
    for name in map(str, log.data_vars):
        if "/" in name:
            raise TableError(
                f'{path}: the column "{name}" has a / in its name, by which the parts of a product are told apart; call it for example '
                f'"{name.replace("/", "-")}"'
            )
        if name in _TAKEN or name.startswith("loop_") or name.endswith("_series"):
            raise TableError(
                f'{path}: the column "{name}" has the name of a result; rename it, for example "logged {name}"'
            )
    return log


def _read_log(path: Path, layout: LoggedTable | None = None) -> xr.Dataset:
    """Read a table of columns over time, each in its own unit."""
    table = tables.read_table(path, ("time",)) if layout is None else _laid_out(path, layout)
    headings = {column: split_heading(path, column) for column in table.columns if column != "time"}
    if not headings:
        raise TableError(
            f'{path}: there is no column apart from time; add one named "name [unit]", or leave [drivers] out'
        )
    names = Counter(column if column == "time" else split_heading(path, column)[0] for column in table.columns)
    repeated = sorted(name for name, times in names.items() if times > 1)
    if repeated:
        raise TableError(f"{path}: more than one column is named {', '.join(repeated)}; give each its own name")
    variables = {name: {"units": unit, "long_name": name} for name, unit in headings.values()}
    return tables.read_timed_rows(
        table, variables, lambda fields: [table.numerals.number(fields[column]) for column in headings]
    )


def _laid_out(path: Path, layout: LoggedTable) -> tables.DelimitedTable:
    """Return a table as a campaign file describes it, with the headings and times that it would have if it said everything itself."""
    rows = read_rows(path, sheet=layout.sheet, header=layout.header_rows, missing=layout.missing)
    named = layout.time or (() if layout.every_s is not None else ("time",))
    time, reference, _ = read_times(path, rows, layout, named)
    zone = "" if reference == tables.NO_ZONE else "Z"
    written = [f"{stamp}{zone}" for stamp in np.datetime_as_string(time, unit="us")]
    others = [str(name) for name in rows.frame.columns if name not in named]
    used = match_columns(layout.columns, others) if layout.columns else others
    stated = {
        heading: column for pattern, column in layout.columns.items() for heading in match_columns([pattern], others)
    }
    names, headings = Counter(name_and_unit(heading)[0] for heading in used), []
    for heading in used:
        name, in_heading = name_and_unit(heading)
        # Channels that only their places tell apart are called by their whole headings; a / parts a product.
        name = (re.sub(r"[()\[\]]", "", heading) if names[name] > 1 else name).replace("/", "-")
        unit = (stated[heading].unit if heading in stated else "") or rows.units.get(heading, "") or in_heading
        headings.append(f"{name} [{unit_name(unit)}]" if unit else heading)
    texts = rows.frame[list(used)].map(str).to_numpy().tolist()
    lines = [
        (int(line), [stamp, *fields]) for line, stamp, fields in zip(rows.frame.index, written, texts, strict=True)
    ]
    return tables.DelimitedTable(path, ("time", *headings), lines, Numerals.of_columns(zip(*texts, strict=True)))


@dataclass(frozen=True, eq=False)
class Rows:
    """A logged table as text and numbers, by lines of its file; its units by heading, lines that do not fit or sum the others up, by
    heading cells that are no readings, and the lines above its names.
    """

    frame: pd.DataFrame
    units: Mapping[str, str]
    left_out: list[RejectedLine]
    marks: Mapping[str, list[RejectedLine]] = field(default_factory=dict)
    above: Sequence[str] = ()


def read_run(campaign: Campaign, path: Path) -> xr.Dataset:
    """Read one table of a ``[record]``: temperatures, displacements and drivers over time."""
    record = campaign.record
    if record is None:
        raise TableError(f"{campaign.path}: there is no [record] in this campaign")
    rows = read_rows(path, sheet=record.sheet, header=record.header_rows, missing=record.missing)
    frame = rows.frame
    lost = pd.Series(False, frame.index)
    if record.long is not None:
        # camonitor prints "*** Disconnected" or "*** Not connected (PV not found)" in place of a value, or of the time as well.
        written = frame[frame.columns.intersection([*record.long.time, record.long.value])].apply(stripped)
        lost = written.apply(
            lambda column: column.str.startswith("***") | column.str.casefold().isin(_NOT_CONNECTED)
        ).any(axis=1)
        for heading in (record.long.channel, record.long.value):
            _find(path, heading, frame)
    time, reference, left_out = read_times(path, rows, record, record.time or (record.long.time if record.long else ()))
    left_out = [*rows.left_out, *(line for line in left_out if not lost.get(line.line, False))]
    left_out.sort(key=lambda line: line.line)
    headings, held = [str(name) for name in frame.columns if name not in (record.time or ())], list[dict[str, Any]]()
    if record.long is not None:
        of_lines = stripped(frame[record.long.channel])
        numbers = pd.Series(numbers_in(frame[record.long.value]), frame.index)
        headings = sorted(of_lines[numbers.notna() & (of_lines != "")].unique())
        left_out += [
            RejectedLine(path.name, int(line), str(frame.at[line, record.long.value]), "is of no channel")
            for line in frame.index[(of_lines == "") & ~np.isnat(time)]
        ]
    columns = columns_of(path, headings, rows.units, record)
    used, goes_back = {role: list(of_role) for role, of_role in columns.items()}, list[RejectedLine]()
    if record.long is not None:
        stamps = pd.Series(time, frame.index)
        # A connection that is lost without a time was lost after the line before.
        stamps = stamps.fillna(stamps.ffill().where(lost))
        lines = pd.DataFrame({"time": stamps, "channel": of_lines, "value": numbers})
        # camonitor prints the value of a channel without a reading as 0, with the severity of its alarm behind it.
        beside = frame.drop(columns=[record.long.value, record.long.channel, *record.long.time])
        invalid = beside.isin(["INVALID"]).any(axis=1)
        lines["value"] = lines["value"].mask(invalid | lost)
        taken = lines["channel"].isin([name for of_role in used.values() for name in of_role]) & lines["time"].notna()
        left_out += [
            RejectedLine(
                path.name,
                int(line),
                str(frame.at[line, record.long.value]),
                "is INVALID" if invalid[line] else "is not a number",
            )
            for line in lines.index[taken & lines["value"].isna() & ~lost]
        ]
        not_connected = [f"{name} (line {line})" for line, name in lines["channel"][lost].items()]
        frame, time, held = _by_channel(path, lines[taken], not_connected, used)
    else:
        timed = ~np.isnat(time)
        goes_back = tables.where_clock_goes_back(path, frame.index[timed], time[timed])
        if len(apart := _lines_apart(frame, time, used)):
            frame, time, held = _by_channel(path, apart, [], used)
    keep = ~np.isnat(time)
    order = np.argsort(time[keep], kind="stable")

    def block(role: str, unit: str | None) -> tuple[list[str], list[str], np.ndarray]:
        names, units, values = [], [], []
        for heading, (name, given) in columns[role].items():
            numbers = numbers_in(frame[heading])[keep][order]
            if np.isnan(numbers).all():
                raise TableError(
                    f'{path}: the column "{heading}" contains no numbers; name another one in the campaign file'
                )
            names.append(name)
            units.append(given if unit is None else unit)
            values.append(numbers if unit is None else in_unit(numbers, given, unit, column=heading, path=path))
            if unit == "degC" and is_rise(numbers, given):
                rises.append(name)
            if (limits := ranges.get(heading)) is not None:
                if unit != "degC":
                    raise TableError(
                        f'{path}: the column "{heading}" is no temperature, and has a range; remove range under [record.columns]'
                    )
                values[-1][(values[-1] < limits[0]) | (values[-1] > limits[1])] = np.nan
        return names, units, np.array(values).reshape(len(names), int(keep.sum())).T

    rises = list[str]()
    ranges = {
        heading: stated.range
        for pattern, stated in record.columns.items()
        if stated.range is not None
        for heading in match_columns([pattern], headings)
    }
    sensors, _, temperature = block("temperature", "degC")
    channels, _, displacement = block("displacement", "um")
    drivers, driver_units, driver = block("driver", None)
    lost_lines = {line.line for line in left_out}
    marks = [
        mark
        for of_role in columns.values()
        for heading in of_role
        for mark in rows.marks.get(heading, ())
        if mark.line not in lost_lines
    ]
    celsius = {"units": "degC", "units_metadata": "temperature: on_scale"}
    table = xr.Dataset(
        {
            "temperature": (("time", "sensor"), temperature, celsius),
            "displacement": (("time", "channel"), displacement, {"units": "um"}),
            "driver": (("time", "driver_name"), driver, {"long_name": "logged drivers, units in driver_units"}),
            "driver_units": (("driver_name",), np.array(driver_units, dtype=object)),
        },
        coords={"time": time[keep][order], "sensor": sensors, "channel": channels, "driver_name": drivers},
        attrs={
            "source": path.name,
            "units": json.dumps(
                {name: unit_name(rows.units.get(name, "")) for of_role in columns.values() for name in of_role}
            ),
            "left_out": json.dumps([asdict(line) for line in left_out]),
            "clock": json.dumps([asdict(line) for line in goes_back]),
            "marks": json.dumps([asdict(line) for line in marks]),
            "held": json.dumps(held),
            "rises": json.dumps(rises),
        },
    )
    table["time"].attrs["reference"] = reference
    return bring_to_utc(table, campaign.zone_of("record"), file=path.name)


def columns_of(
    path: Path, headings: list[str], units: Mapping[str, str], record: RecordTable
) -> dict[str, dict[str, tuple[str, str]]]:
    """Return the name and the unit of every column that a record uses, by role and heading."""
    stated: dict[str, ColumnTable] = {}
    # A column that is named goes before one that a pattern matches.
    for pattern, column in sorted(record.columns.items(), key=lambda item: "*" not in item[0]):
        stated |= dict.fromkeys(match_columns([pattern], headings), column)
    roles: dict[str, dict[str, tuple[str, str]]] = {"temperature": {}, "displacement": {}, "driver": {}}
    listed = {"temperature": record.temperatures, "displacement": record.displacements, "driver": record.drivers}
    role_by_heading = {
        heading: role for role, patterns in listed.items() for heading in match_columns(patterns, headings)
    } or dict.fromkeys(stated)
    for heading in filter(role_by_heading.__contains__, headings):
        column, (name, in_heading) = stated.get(heading, ColumnTable()), name_and_unit(heading)
        elsewhere = unit_name(column.unit or units.get(heading, ""))
        unit = elsewhere or in_heading
        role = role_by_heading[heading] or column.role or role_of_unit(unit)
        if not unit and name == heading.strip():
            raise TableError(
                f'{path}: the column "{heading}" has no unit; write it under [record.columns]: "{heading}" = {_EXAMPLES[role]}'
            )
        # TC(1) and TC(2) of a logger are two names, whose units stand elsewhere.
        roles[role][heading] = (heading if elsewhere and in_heading not in ("", elsewhere) else name, unit)
    for of_role in roles.values():
        # Columns that only their units tell apart are called by their whole headings, which may be the name of another one.
        while repeated := [name for name, times in Counter(name for name, _ in of_role.values()).items() if times > 1]:
            of_role |= {heading: (heading, unit) for heading, (name, unit) in of_role.items() if name in repeated}
    used = {heading for of_role in roles.values() for heading in of_role}
    example = next((heading for heading in reversed(headings) if heading not in used), headings[-1])
    for role in ("temperature", "displacement"):
        if not roles[role]:
            raise TableError(
                f'{path}: no column is a {role}; write one under [record.columns], such as "{example}" = {_EXAMPLES[role]}'
            )
    return roles


def read_rows(
    path: Path, *, sheet: str | None = None, header: HeaderRows | None = None, missing: Sequence[float | str] = ()
) -> Rows:
    """Read a whole table, text or a sheet of a spreadsheet; without `header` its first line that is no comment holds the names."""
    with path.open("rb") as file:
        workbook = is_workbook(file.read(8))
    try:
        rows = None if workbook else _read_text(path, header)
    except LaserFormatError:
        raise
    except (ValueError, OSError, pd.errors.ParserError) as error:
        raise TableError(f"{path}: cannot be read as a table: {error}; save it as CSV in UTF-8 or as XLSX") from None
    rows = _numbers_of_cells(path, rows or _read_sheet(path, sheet, header))
    return _without_marks(path, rows, [mark for mark in missing if not isinstance(mark, str)])


def _read_sheet(path: Path, sheet: str | None, header: HeaderRows | None) -> Rows:
    """Read one sheet of a spreadsheet with the types that pandas gives the columns."""
    _, rows, _ = sheet_of(path, sheet)
    first = rows[0][0]
    header = header or HeaderRows(names=first, values=first + 1)
    by_line = {line: [cell_text(cell) for cell in cells] for line, cells in rows if line < header.values}
    below = [(line, cells) for line, cells in rows if line >= header.values]
    names = by_line.get(header.names or 0) or [str(k + 1) for k in range(len(rows[0][1]))]
    frame = TextParser([names, *(cells for _, cells in below)]).read()
    # Lines are counted in the file.
    frame.index = pd.Index([line for line, _ in below])
    above = [" ".join(filter(None, cells)) for line, cells in by_line.items() if line < (header.names or 0)]
    return _named(frame, header, by_line.get(header.units or 0, []), [], above)


def sheet_of(path: Path, name: str | None = None) -> tuple[str, list[tuple[int, list[Cell]]], list[str]]:
    """Return name and rows of a sheet, and the other sheets with its headings; no name where none is needed.

    Without a name it is the first with rows of values, beside which those of the same times stand.
    """
    sheets = read_cells(path, as_stored=True)
    if name is not None and name not in sheets:
        raise TableError(f"{path}: there is no sheet {name!r}; the sheets are {', '.join(map(repr, sheets))}")
    heads = {one: [(line, [*map(cell_text, cells)]) for line, cells in rows[:HEAD]] for one, rows in sheets.items()}
    places = {one: first_of_values(rows) for one, rows in heads.items()}
    firsts = {one: at for one, at in places.items() if at is not None and at + 1 < len(heads[one])}
    used = name or next(iter(firsts or sheets))
    rows, times = sheets[used], [cells[0] for _, cells in sheets[used]]
    others = [] if name else [one for one in firsts if one != used]
    alike = [one for one in others if heads[one][: firsts[one]] == heads[used][: firsts[used]]]
    beside = [one for one in others if one not in alike and [cells[0] for _, cells in sheets[one]] == times]
    for one in beside:
        rows = [(line, [*cells, *more[1:]]) for (line, cells), (_, more) in zip(rows, sheets[one], strict=True)]
    return ("" if beside or (used == next(iter(sheets)) and not alike) else used), rows, alike


def first_of_values(rows: Sequence[tuple[int, list[str]]]) -> int | None:
    """Return the place of the first row of values, None where there is none."""
    of_values = [_is_of_values(fields) for _, fields in rows]
    firsts = [
        k for k in range(len(rows)) if _begin_values(rows, of_values, range(k, k + ROWS_OF_VALUES + _ROWS_BETWEEN))
    ]
    widths = [len(fields) for _, fields in rows]
    # Above its names a logger lists start, end and trigger, its channels and their ranges, in rows of other widths.
    usual = (k for k in firsts if 2 * widths[k:].count(widths[k]) > len(rows) - k and not any(of_values[k - 1 : k]))
    first = next(usual, next(iter(firsts), None))
    # The first row alone may hold the serial number of a logger behind its values.
    while first and of_values[first - 1] and widths[first - 1] > widths[first]:
        first -= 1
    return first


def _is_of_values(fields: Sequence[str]) -> bool:
    """Whether a row holds little but numbers and times, with a number in it."""
    texts = [text.strip() for text in fields if text.strip()]
    return sum(VALUE.fullmatch(text) is not None or has_unit(text) for text in texts) >= max(1, len(texts) / 2)


def _begin_values(rows: Sequence[tuple[int, list[str]]], of_values: Sequence[bool], places: range) -> bool:
    """Whether the first of some rows and enough others as wide are rows of values."""
    near = [of_values[k] and len(rows[k][1]) == len(rows[places[0]][1]) for k in places[: len(rows) - places[0]]]
    return near[0] and sum(near) >= min(ROWS_OF_VALUES, len(near))


def text_lines(path: Path, header: HeaderRows | None = None) -> list[str]:
    """Return the lines of a text, each with its end, and tabs between fields that spaces part; the rest of a line of headings that one of
    them breaks is empty.
    """
    lines = list(io.StringIO(tables.decode_text(path, path.read_bytes()), newline=None))
    for delimiter in (*tables.DELIMITERS, None):
        tables.raise_if_too_wide(path, lines, delimiter)
    first, heading = tables.find_header(lines)
    if _OPEN_HEADING.search(heading):
        quotes = accumulate(line.count('"') for line in lines[first : first + _LONGEST_HEADER])
        end = next((k for k, number in enumerate(quotes, first + 1) if number % 2 == 0), first + 1)
        headings = " ".join(line.strip("\n ") for line in lines[first:end])
        # Lines are counted in the file.
        lines[first:end] = [f"{headings}\n", *["\n"] * (end - first - 1)]
    middle = [line for line in lines[len(lines) // 2 :] if line.strip() and not line.startswith("#")][:_SAMPLE]
    spaced = [line for line in middle if _is_spaced(line)]
    return _tabulated(path, lines, spaced, header) if len(spaced) > len(middle) / 2 else lines


# Text in aligned columns: a name of several words and an empty cell are told by what stands above and below them.


def _is_spaced(line: str) -> bool:
    """Whether the values of a line are parted by spaces alone, its commas decimal ones."""
    words = line.split()
    return (
        not any(mark in line for mark in ";\t|")
        and sum(word.lstrip("+-.")[:1].isdigit() for word in words) > 1
        and all(_COMMA_NUMBER.fullmatch(word) for word in words if "," in word)
    )


def _tabulated(path: Path, lines: list[str], sample: list[str], header: HeaderRows | None) -> list[str]:
    """Return the lines of a text in columns of spaces with tabs between their fields; what fits no columns stays whole."""
    if sum(MONITORED.match(line) is not None for line in sample) > len(sample) / 2:
        return ["\t".join(line.split()) + "\n" for line in lines]
    usual = {one: Counter(len(one.findall(line)) for line in sample).most_common(1)[0][0] for one in _VALUES}
    first = next(k for k, line in enumerate(lines) if _is_spaced(line) and len(line.split()) == usual[_WORDS])
    above = [k for k in range(header.values - 1 if header else first) if not _RULED.fullmatch(lines[k])]
    above = [k for k in above if not lines[k].startswith("#")]
    asked = [k for k in above if len(lines[k].split()) > 1][-2:]
    if header is not None:
        asked = [line - 1 for line in (header.names, header.units) if line]
    parts = next(
        (one for one in _VALUES for k in asked if any(len(names.findall(lines[k])) == usual[one] for names in _NAMES)),
        _WORDS,
    )
    width = usual[parts]
    places = [row for line in sample if len(row := [part.span() for part in parts.finditer(line)]) == width]
    spans = [(min(start for start, _ in column), max(end for _, end in column)) for column in zip(*places, strict=True)]

    def placed(line: str, pattern: re.Pattern[str]) -> list[str] | None:
        """Return each part in the column below or above which it stands alone; None where one stands elsewhere."""
        fields = [""] * width
        for part in pattern.finditer(line):
            over = [k for k, (a, b) in enumerate(spans) if part.start() < b and a < part.end()]
            if len(over) != 1 or fields[over[0]]:
                return None
            fields[over[0]] = part[0]
        return fields

    def named(line: str) -> list[str] | None:
        """Return the fields of a line of names or units; None where nothing tells to which columns they belong."""
        in_order = next(
            (found for one in _NAMES if len(found := one.findall(line)) == width and "/" not in found), None
        )
        by_place = placed(line, _APART) if len(_APART.findall(line)) > 1 else None
        return None if in_order and by_place not in (None, in_order) else in_order or by_place

    told = {k: named(lines[k]) for k in above}
    units = [text for text in told.get(asked[-1]) or () if text] if asked else []
    if header is None and sum(map(is_unit, units)) <= len(units) / 2:
        asked = asked[-1:]
    for k in asked:
        if told[k] is None:
            raise LaserFormatError(
                f"{path}, line {k + 1}: {tables.shown([lines[k].strip()])} does not name the {width} columns of values below it; part "
                "names and values by tabs or semicolons and give every name on this line, or write header_rows = "
                f"{{values = {first + 1}}} in the campaign file, with which the columns are called by their numbers"
            )
    tabulated = []
    for k, line in enumerate(lines):
        fields = told[k] if k in told else parts.findall(line)
        if fields is not None and len(fields) < width:
            # A line that ends before the last column may have lost any of its values.
            fields = placed(line, _WORDS) if len(line.strip("\n")) > spans[-1][0] else None
        tabulated.append("\t".join(fields) + "\n" if fields else "\n" if _RULED.fullmatch(line) else line)
    return tabulated


def _read_text(path: Path, header: HeaderRows | None) -> Rows:
    """Read delimited text with the dialect that its header line, or without one its first line of values, shows."""
    lines = text_lines(path, header)
    if header is None:
        before, _ = tables.find_header(lines)
        header = HeaderRows(names=before + 1, values=before + 2)
    below = lines[header.values - 1 :]
    if header.names:
        names = "".join(lines[header.names - 1 : header.names])
        values = max(below[:_SAMPLE], key=len, default="")
        delimiter = next((mark for mark in "\t;," if mark in values and mark in names), tables.delimiter_of(names))
    else:
        delimiter = tables.delimiter_of_values("".join(below[:1]))
        width = max((len(tables.fields_of(line, delimiter)) for line in below), default=0)
        names = (delimiter or " ").join(str(k + 1) for k in range(width))
    decimal = Numerals.of(text for line in below[:_SAMPLE] for text in tables.fields_of(line, delimiter)).decimal
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", pd.errors.ParserWarning)
        frame = pd.read_csv(
            io.StringIO("".join([names.strip("\n"), "\n", *below])),
            sep=delimiter or r"\s+",
            decimal=decimal or ".",
            skipinitialspace=True,
            index_col=False,
            on_bad_lines="warn",
            low_memory=False,  # in parts, a column could be numbers above and text below
        )
    if any("loss of data" in str(warning.message) for warning in caught):
        raise FusionError("the lines hold more fields than the header names; name every column")
    skipped = {
        int(line) - 2: (due, saw) for warning in caught for line, due, saw in _SKIPPED.findall(str(warning.message))
    }
    # Lines are counted in the file; a quoted field may go over several of them.
    quoted = np.cumsum([0, *(line.count('"') for line in below)])[:-1] % 2 == 1
    for begins in (np.full(len(below), True), ~quoted):
        numbers = np.flatnonzero(begins)
        blank = " \r\n" if delimiter == "\t" else None
        held = [n for k, n in enumerate(numbers) if below[n].strip(blank) and k not in skipped]
        if len(held) == len(frame):
            break
    else:
        raise FusionError("quotation marks that open and do not close; remove them")
    frame.index = pd.Index(np.array(held, int) + header.values)
    for name, column in frame.items():
        if not pd.api.types.is_numeric_dtype(column):
            frame[name] = _ungrouped(path, column, decimal)
    left_out = [
        RejectedLine(path.name, int(numbers[k]) + header.values, f"{saw} fields", f"{due} were expected")
        for k, (due, saw) in skipped.items()
    ]
    units = tables.fields_of(lines[header.units - 1], delimiter) if header.units else []
    return _named(frame, header, units, left_out, lines[: (header.names or 1) - 1])


def _ungrouped(path: Path, column: pd.Series, decimal: str) -> pd.Series:
    """Return the whole numbers of a column without marks between thousands, where it shows that its marks are these."""
    texts = stripped(column)
    grouped = texts[texts.map(THOUSANDS.fullmatch).notna()]
    mark = "." if "." in "".join(grouped[:1]) else ","
    if grouped.empty or mark == decimal or Numerals.of(texts).examples:
        return column
    if parts_thousands(texts):
        return texts.where(texts.map(THOUSANDS.fullmatch).isna(), texts.str.replace(mark, "")).mask(column.isna())
    if decimal and len(grouped) > len(column) / 2:
        raise LaserFormatError(
            f'{path}, line {grouped.index[0]}: {grouped.iloc[0]!r} in the column "{column.name}" may part thousands or decimals, as '
            f"{decimal!r} is the decimal mark elsewhere; write this column without marks between thousands, or all with one decimal mark"
        )
    return column


def _named(
    frame: pd.DataFrame, header: HeaderRows, units: list[str], left_out: list[RejectedLine], above: Sequence[str]
) -> Rows:
    """Return rows with the names of their columns, and their units, without the spaces around them."""
    names: dict[str, None] = {}
    grouped = (header.units or 0) < (header.names or 0) and 2 * sum(map(is_unit, units)) < sum(map(bool, units))
    over = [text.strip() for text in units] if grouped else []
    for k, name in enumerate(frame.columns):
        plain, unnamed = str(name).strip(), f"Unnamed: {k}"
        if over[k : k + 1]:
            # A name over several columns, as of merged cells: its unit is that of each.
            over[k] = over[k] or (over[k - 1] if k and plain != unnamed else "")
            group, unit = name_and_unit(over[k])
            plain = over[k] if plain == unnamed else f"{group} {plain}{f' [{unit}]' if unit else ''}".strip()
        elif plain == unnamed and names and (unit := "".join(units[k : k + 1]).strip()):
            # A name above two columns: the second is told by its unit.
            plain = f"{name_and_unit(next(reversed(names)))[0]} [{unit}]"
        # As pandas numbers headings that are alike.
        names[next(one for one in chain([plain], (f"{plain}.{n}" for n in count(1))) if one not in names)] = None
    frame.columns = list(names)
    for number in frame.select_dtypes("number"):
        # 20260309063000 is no number.
        if frame[number].between(19e12, 22e12).all():
            frame[str(number)] = frame[number].map("{:.0f}".format).str.replace(r"^(\d{8})", r"\1T", regex=True)
    of_names = {} if over else dict(zip(frame.columns, units, strict=False))
    return Rows(frame, {str(name): unit.strip("[]() ") for name, unit in of_names.items()}, left_out, above=above)


def _numbers_of_cells(path: Path, rows: Rows) -> Rows:
    """Return rows whose numbers stand without the unit beside them in their cells; refuse a column that is stated to be in two units."""
    frame, in_cells, before = rows.frame, dict[str, str](), ""
    for name in map(str, frame.columns):
        left, before = before, name
        if pd.api.types.is_numeric_dtype(frame[name]):
            continue
        texts = stripped(frame[name])
        if left and texts.nunique() == 1 and find_unit(texts.iloc[0]) and not name_and_unit(left)[1]:
            in_cells[left] = texts.iloc[0]  # a column of values, and one of their unit
        sample = texts[texts != ""].iloc[:_SAMPLE]
        if 2 * sum(map(has_unit, sample)) > len(sample):
            frame[name], in_cells[name] = _unit_in_cells(path, name, texts)
    for name in map(str, frame.columns):
        written = name_and_unit(name)[1], rows.units.get(name, ""), in_cells.get(name, "")
        stated = zip(("heading", "row of units", "cells"), map(find_unit, written), strict=True)
        known = {unit: place for place, unit in stated if unit is not None}
        if len(known) > 1:
            both = " and in ".join(f"{unit.name} by its {place}" for unit, place in known.items())
            raise TableError(f'{path}: the column "{name}" is in {both}; correct one of them')
    return replace(rows, units={**rows.units, **in_cells})


def _without_marks(path: Path, rows: Rows, missing: Sequence[float]) -> Rows:
    """Return rows without lines that sum the others up and marks for no reading, both named."""
    frame, odd, summaries = rows.frame, dict[str, list[RejectedLine]](), dict[int, str]()
    for name in map(str, frame.columns):
        cells, numbers = frame[name], numbers_in(frame[name])
        is_odd = np.isin(numbers, missing) | (np.abs(numbers) >= SENTINEL_MAGNITUDE)
        if not pd.api.types.is_numeric_dtype(cells):
            texts = stripped(cells)
            if 2 * np.isfinite(numbers).sum() <= (texts != "").sum():
                named = texts[texts.map(_SUMMARY.fullmatch).notna()]
                summaries |= dict(named) if len(named) <= min(_MOST_SUMMARIES, len(frame) / 10) else {}
                continue
            is_odd |= np.isnan(numbers) & (texts != "").to_numpy()
        found = zip(cells.index[is_odd].tolist(), cells[is_odd], strict=True)
        odd[name] = [
            RejectedLine(path.name, line, str(cell).strip(), f"is no reading of {name}") for line, cell in found
        ]
        frame[name] = cells.mask(is_odd & np.isfinite(numbers)) if is_odd.any() else cells
    _refuse_another_header(path, odd, rows.units)
    summaries |= {one.line: one.value for cells in odd.values() for one in cells if _SUMMARY.search(one.value)}
    marks = {name: [one for one in cells if not _SUMMARY.search(one.value)] for name, cells in odd.items()}
    left_out = [RejectedLine(path.name, line, text, "sums up other lines") for line, text in sorted(summaries.items())]
    return replace(rows, frame=frame.drop(index=list(summaries)), left_out=[*rows.left_out, *left_out], marks=marks)


def _refuse_another_header(path: Path, odd: Mapping[str, Sequence[RejectedLine]], units: Mapping[str, str]) -> None:
    """Refuse a line among the values whose cells head their columns anew, by other names or units."""
    of_units, anew = Counter[int](), dict[int, tuple[str, str, str]]()
    for name, cells in odd.items():
        known = units.get(name, "").strip("- ") or name_and_unit(name)[1]
        for one in cells:
            unit, alone = name_and_unit(one.value)[1], is_unit(one.value)
            heads = (is_unit(unit) and unit != unit_name(known)) or (one.value != name and one.value in odd)
            # A unit alone may be a state; a row of them heads what is below it.
            of_units[one.line] += 2 if heads else alone and one.value not in ("-", "1")
            if heads or (known and alone and unit_name(one.value) != unit_name(known)):
                anew[one.line] = one.value, name, known
    for line, (text, name, known) in anew.items():
        if of_units[line] > 1:
            raise TableError(
                f'{path}, line {line}: {text!r} heads the column "{name}"{f", in {known} so far," if known else ""} anew; give what was '
                "logged before and after this line in files of its own"
            )


def _unit_in_cells(path: Path, name: str, texts: pd.Series) -> tuple[pd.Series, str]:
    """Return the numbers of cells such as "23.5 °C", in the unit that most of them have, and that unit."""
    parts = [BESIDE.fullmatch(text) for text in texts]
    written = [unit_name(part[2]) if part else "" for part in parts]
    most = Counter(filter(None, written)).most_common(1)[0][0]
    numerals, whole = Numerals.of(part[1] for part in parts if part), find_unit(most)
    values = []
    for line, part, unit in zip(texts.index, parts, written, strict=True):
        value, one = math.nan, find_unit(unit)
        with suppress(tables.BadReading):
            value = numerals.number(part[1]) if part else math.nan
        if unit != most and part and (one is None or whole is None or one.kind != whole.kind):
            raise TableError(f'{path}, line {line}: the column "{name}" is in {most}, here in {unit}; write one unit')
        if unit != most and one and whole:
            value = (value * one.factor + one.offset - whole.offset) / whole.factor
        values.append(value)
    return pd.Series(values, texts.index), most


def numbers_in(column: pd.Series) -> np.ndarray:
    """Return the numbers of a column, NaN where a row has none."""
    if pd.api.types.is_numeric_dtype(column):
        return column.to_numpy(dtype="f8", na_value=np.nan)
    # A logger of two decimals writes some hundred numbers, each a thousand times.
    code, different = pd.factorize(column.map(str))
    numerals = Numerals.of(different)

    def number(text: str) -> float:
        try:
            return numerals.number(text)
        except tables.BadReading:
            return float("nan")

    return np.array([number(text) for text in different])[code]


def _lines_apart(frame: pd.DataFrame, time: np.ndarray, used: Mapping[str, list[str]]) -> pd.DataFrame:
    """Return time, channel and value of a table that holds its channels on rows apart, as several loggers' rows one below the other by
    their times are; empty where rows hold all of them, or a channel ends.
    """
    names = [name for role in ("temperature", "displacement", "driver") for name in used[role]]
    numbers = pd.DataFrame({name: numbers_in(frame[name]) for name in names}, frame.index)[~np.isnat(time)]
    felt = numbers[[*used["temperature"], *used["displacement"]]].notna()
    stretches = np.array_split(felt.to_numpy(), min(_STRETCHES, len(felt)))
    if felt.all(axis=1).mean() > _TOGETHER or not (
        all(one.any(axis=0).all() for one in stretches) and numbers.notna().any().all()
    ):
        return pd.DataFrame()
    lines = numbers.assign(time=time[~np.isnat(time)]).melt("time", var_name="channel", ignore_index=False)
    return lines.dropna(subset="value").sort_values("time", kind="stable")


def _by_channel(
    path: Path, lines: pd.DataFrame, not_connected: list[str], used: Mapping[str, list[str]]
) -> tuple[pd.DataFrame, np.ndarray, list[dict[str, Any]]]:
    """Return a column for every channel from lines of time, channel and value, the times of its rows, and how values were held between
    lines.
    """
    described: dict[str, Any] = {"file": path.name, "lost": not_connected}
    # A value goes before an alarm of the same time.
    each = {str(name): of_one.groupby("time")["value"].last() for name, of_one in lines.groupby("channel")}
    wide = pd.DataFrame(each)
    first = wide.index.to_numpy("M8[ns]")[0]
    seconds = {
        name: (values.index.to_numpy("M8[ns]") - first) / np.timedelta64(1, "s") for name, values in each.items()
    }
    felt = [name for name in (*used["displacement"], *used["temperature"]) if seconds[name].size > 1]
    usual = {name: _usual_step_s(seconds[name]) for name in felt}
    # Between two lines of the displacement that is logged most often nothing is measured that could be explained.
    fastest = min((name for name in used["displacement"] if name in usual), key=usual.__getitem__, default="")
    if wide.notna().all(axis=None) or not fastest:
        return wide, wide.index.to_numpy("M8[ns]"), [described] if not_connected else []
    at_all = np.unique(np.concatenate(list(seconds.values())))
    start, end = seconds[fastest][0], at_all[-1]
    # Bursts and long pauses: no more rows than lines.
    step_s = max(usual[fastest], (end - start) / len(lines))
    grid = start + step_s * np.arange(round((end - start) / step_s) + 1)
    # A line belongs to the row that is nearest to it.
    before = {name: np.searchsorted(at, grid + step_s / 2) - 1 for name, at in seconds.items()}
    held = {name: np.where(row >= 0, each[name].to_numpy()[row], np.nan) for name, row in before.items()}
    longest_s = _LONGEST_SILENCE * float(np.median(list(usual.values())))
    kept = grid - at_all[np.searchsorted(at_all, grid + step_s / 2) - 1] <= longest_s
    waits = {name: float(np.diff(at).max(initial=0.0)) for name, at in seconds.items()}
    slowest = max(waits, key=waits.__getitem__)
    described |= {"step_s": step_s, "longest_s": longest_s, "fastest": fastest, "slowest": slowest, "wait_s": waits[slowest]}  # fmt: skip
    return pd.DataFrame(held)[kept], (first + np.round(grid * 1e9).astype("m8[ns]"))[kept], [described]


def _usual_step_s(seconds: Array) -> float:
    """Return the time between two lines of a channel, s: the mean, where pauses count for as many as fit by the median."""
    between = np.diff(seconds)
    return float(between.sum() / max(1.0, np.rint(between / np.median(between)).sum()))


def _find(path: Path, heading: str, frame: pd.DataFrame) -> None:
    """Refuse a table without a column that the campaign file names."""
    if heading not in frame.columns:
        raise TableError(f'{path}: no column is named "{heading}"; the file has: {", ".join(frame.columns)}')


def stripped(column: pd.Series) -> pd.Series:
    """Return the texts of a column without the spaces around them, empty where a row has none."""
    return column.astype(object).fillna("").astype(str).str.strip()


def written_times(frame: pd.DataFrame, headings: Sequence[str]) -> pd.Series:
    """Return the times as a table writes them, those of a date and a time of day joined; missing where one of the two is."""
    if len(headings) == 1:
        return frame[headings[0]]
    parts = frame[list(headings)]
    if is_fraction(headings[-1]):
        parts = parts.assign(**{headings[-1]: [f".{number:03.0f}" for number in numbers_in(parts[headings[-1]])]})
    joined = pd.Series([" ".join(map(str, row)) for row in parts.itertuples(index=False)], frame.index, dtype=object)
    return joined.str.replace(" .", ".", regex=False).where(frame[list(headings)].notna().all(axis=1))


def is_fraction(heading: str) -> bool:
    """Whether a heading is that of the milliseconds of a time beside it."""
    return _MILLISECONDS.fullmatch(heading.strip()) is not None


def read_times(
    path: Path, rows: Rows, record: LoggedTable, headings: Sequence[str]
) -> tuple[np.ndarray, str, list[RejectedLine]]:
    """Return times, NaT where a row has none, how they came to UTC in words, and the list of the rows without a time."""
    frame = rows.frame
    for heading in headings:
        _find(path, heading, frame)
    if record.every_s is not None:
        return *_after_start(np.arange(len(frame)) * record.every_s, record, path), []
    texts = stripped(written_times(frame, headings))
    parts = parts_of_time(frame, headings)
    seconds = numbers_in(frame[headings[0]]) if len(headings) == 1 else np.full(len(frame), np.nan)
    if record.time_format is not None:
        time, words = _formatted_times(path, texts, record)
    elif parts is not None:
        time, words = parts.to_numpy("M8[ns]"), tables.NO_ZONE
    elif 2 * np.isfinite(seconds).sum() > seconds.size:
        time, words = _counted_times(path, seconds, rows, record, headings[0])
    elif 2 * np.isfinite(elapsed := tables.elapsed_s(texts)).sum() > elapsed.size:
        time, words = _after_start(elapsed, record, path)
    else:
        lines = [(int(line), text) for line, text in zip(frame.index, texts, strict=True)]
        order = tables.DateOrder(record.date_order) if record.date_order else tables.DateOrder.of(path, lines)
        time, zones = np.full(len(texts), np.datetime64("NaT", "ns")), dict[str, int]()
        for at, (line, text) in enumerate(lines):
            with suppress(tables.BadReading):
                time[at], zone = tables.parse_time(text, order)
                zones.setdefault(zone, line)
        words = tables.describe_time_zone(path, zones) if zones else ""
    for said in (" ".join(headings), *filter(_OF_ZONE.search, rows.above)):
        if words == tables.NO_ZONE and (zone := _zone_in(said)):
            time, words = from_zone(time, zone, file=path.name), f"converted to UTC from {zone}, as the heading says"
    same = np.flatnonzero(np.diff(time) == np.timedelta64(0)) + 1
    # What alone repeats a time, at the end, sums up the rows above it.
    same = (
        same if same.size <= _MOST_SUMMARIES and (same == len(time) - np.arange(same.size, 0, -1)).all() else same[:0]
    )
    time[same] = np.datetime64("NaT")
    timed = ~np.isnat(time)
    cells = frame[list(headings)]
    written = [" ".join(map(str, row.dropna())) for _, row in cells[~timed].iterrows()]
    left_out = [
        RejectedLine(path.name, int(frame.index[at]), text, "repeats the time above" if at in same else "is not a time")
        for at, text in zip(np.flatnonzero(~timed), written, strict=True)
    ]
    raise_if_mostly_invalid(
        path, int(timed.sum()), left_out, last=int(frame.index[timed].max()) if timed.any() else None
    )
    return time, words, left_out


def _zone_in(heading: str) -> str:
    """Return the zone that a heading or a line above it states, as UTC+02:00 or by its place; empty where it states none."""
    place = next((name for name in _PLACE.findall(heading) if name in available_timezones()), "")
    if _OF_ZONE.search(heading) and (bare := _OFFSET.search(heading)):
        return f"UTC{bare[1]}:{bare[2]}"
    zone = "" if "offset" in heading.lower() else tables.zone_of(heading)
    return f"UTC{zone[:3]}:{zone[3:]}" if zone else place


def parts_of_time(frame: pd.DataFrame, headings: Sequence[str]) -> pd.Series | None:
    """Return the times that columns such as Day, Hour and Minute, or Year to Second, make; None where they are no such parts."""
    parts = {PARTS.get(heading.strip().casefold(), ""): pd.to_numeric(frame[heading], "coerce") for heading in headings}
    if "" in parts or len(parts) < max(2, len(headings)):
        return None
    return pd.to_datetime(pd.DataFrame({"year": 1970, "month": 1, "day": 1} | parts), errors="coerce")


def _counted_times(
    path: Path, counts: np.ndarray, rows: Rows, record: LoggedTable, heading: str
) -> tuple[np.ndarray, str]:
    """Return times that are numbers, NaT where a row has none, and how they came to UTC."""
    unit = record.time_unit or rows.units.get(heading, "") or name_and_unit(heading)[1]
    if not unit:
        raise TableError(
            f'{path}: the times in the column "{heading}" are numbers without a unit; write time_unit = "s" (or '
            f"{', '.join(unit for unit in TIME_UNITS if unit != 's')}) in the campaign file, where it names this one"
        )
    if unit in DAY_NUMBERS:
        # To the millisecond: in a day since the year 0 a double resolves 0.01 ms.
        return _since(NO_START, np.round((counts - DAY_NUMBERS[unit]) * 86_400e3) / 1e3), tables.NO_ZONE
    on, again = unwrapped(counts)
    time, words = _after_start(in_unit(on, unit, "s", column=heading, path=path), record, path)
    return time, words + again


def unwrapped(counts: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the numbers of a counter of 16 or 32 bits that begins again at 0 as if it counted on, and that it did in words."""
    known = np.isfinite(counts)
    for bits in _COUNTERS:
        on = tables.counted_on(counts, 2.0**bits)
        steps = np.diff(on[known])
        over = steps[steps != np.diff(counts[known])]
        if over.size and steps.min() > 0.0 and over.max() <= _LARGEST_STEP * np.median(steps):
            return (
                on,
                f"; its counter of {bits} bits begins again at 0 ({counted(over.size, 'time')}) and is counted on",
            )
    return counts, ""


def _after_start(elapsed: np.ndarray, record: LoggedTable, path: Path) -> tuple[np.ndarray, str]:
    """Return the times that lie `elapsed` seconds after the start of a record, NaT where that is no number of a time."""
    start, zone = NO_START, "+0000"
    if record.start is not None:
        try:
            start, zone = tables.parse_time(record.start)  # type: ignore[assignment]
        except tables.BadReading as fault:
            raise TableError(f'start = "{record.start}": {fault.reason}, needed for {path}') from None
    return _since(start, elapsed), tables.describe_time_zone(path, {zone: 0})


def _since(start: np.datetime64, elapsed: np.ndarray) -> np.ndarray:
    """Return the times that lie `elapsed` seconds after a start, NaT where that is no number of a time."""
    known = np.abs(elapsed) < _LONGEST_RECORD_S
    time = start + np.where(known, np.round(np.where(known, elapsed, 0.0) * 1e9), 0).astype("m8[ns]")
    time[~known] = np.datetime64("NaT")
    return time


def _formatted_times(path: Path, texts: pd.Series, record: LoggedTable) -> tuple[np.ndarray, str]:
    """Return the times of ``time_format``, NaT where a row has none, and how they came to UTC; times of day from the first midnight."""
    form = str(record.time_format)
    if form == "%H%M%S":
        texts = texts.str.removesuffix(".0").str.zfill(6)
    try:
        times = pd.to_datetime(texts, format=form, errors="coerce", utc="%z" in form)
    except ValueError as error:
        raise TableError(f'{path}: time_format = "{form}": {error}; for example "%Y/%m/%d-%H:%M:%S"') from None
    if not set(re.findall(r"%-?([a-zA-Z])", form)) & set("dDjcxs"):
        elapsed = tables.elapsed_s(texts, of_minutes=form.startswith("%M"))
        if np.isnan(elapsed).all():
            elapsed = tables.counted_on((times - times.dt.normalize()).dt.total_seconds().to_numpy("f8"), 86400.0)
        return _after_start(elapsed, record, path)
    aware = times.dt.tz is not None
    return times.dt.tz_localize(None).to_numpy("M8[ns]"), tables.describe_time_zone(path, {"+0000" if aware else "": 0})


def in_unit(values: np.ndarray, unit: str, target: str, *, column: str, path: Path) -> np.ndarray:
    """Return the values of a column in the canonical unit `target`; kelvins that no machine has are those of a rise."""
    try:
        factor, offset = column_conversion(unit, target)
    except QuantityError as error:
        raise TableError(f'{path}: the column "{column}": {error}') from None
    return values * factor + (0.0 if target == "degC" and is_rise(values, unit) else offset)


def is_rise(values: np.ndarray, unit: str) -> bool:
    """Whether numbers in a unit are differences of temperatures: kelvins of which most are colder than liquid air."""
    return unit_name(unit) == "K" and bool(np.nanmedian(values) < _LIQUID_AIR_K)


# Contact sensors of a campaign: their temperatures over time, and their places on the plan.


@dataclass(frozen=True, eq=False)
class ContactSensors:
    """Temperatures of contact sensors on the table, degC, as logged, the faulty sensors among them; NaN where a sensor gave nothing.

    ``logged_x_mm`` and ``logged_y_mm`` are places on the plan; ``u_K`` is the standard uncertainty of one sensor; sensors with a clear
    fault (docs/method/sensor-health.md) are left out of everything that is calculated.
    """

    file: str
    logged: xr.DataArray
    logged_x_mm: Array
    logged_y_mm: Array
    u_K: float
    faults: tuple[SensorFault, ...] = ()

    @property
    def sound(self) -> list[int]:
        """Places among the logged sensors of those that are used."""
        faulty = {fault.sensor for fault in self.faults}
        return [k for k in range(self.logged.sizes["sensor"]) if k not in faulty]

    @property
    def temperature(self) -> xr.DataArray:
        """Temperatures of the sound sensors at the times at which all of them gave one, (time, sensor) degC."""
        return self.logged.isel(sensor=self.sound).dropna("time")

    @property
    def x_mm(self) -> Array:
        """Places of the sound sensors along x, (sensors,) mm."""
        return self.logged_x_mm[self.sound]

    @property
    def y_mm(self) -> Array:
        """Places of the sound sensors along y, (sensors,) mm."""
        return self.logged_y_mm[self.sound]

    @property
    def names(self) -> list[str]:
        """Names of the sound sensors."""
        return [str(name) for name in self.logged["sensor"].values[self.sound]]


def read_sensors(campaign: Campaign) -> ContactSensors | None:
    """Read the contact sensors of a campaign."""
    table, plan = campaign.sensors, campaign.plan
    if table is None or plan is None or plan.size_mm is None:
        return None
    path = campaign.resolve(table.file)
    zone = campaign.zone_of("sensors")
    logged = bring_to_utc(_read_log(path), zone, file=table.file, late_s=table.clock_offset_s)
    names = [str(name) for name in logged.data_vars]
    places = _read_places(campaign.resolve(table.places), names, plan.size_mm)
    columns = [
        in_unit(column.values, str(column.attrs["units"]), "degC", column=str(name), path=path)
        for name, column in logged.data_vars.items()
    ]
    temperature = xr.DataArray(
        np.stack(columns, axis=-1), dims=("time", "sensor"), coords={"time": logged["time"], "sensor": names}
    )
    temperature["time"].attrs.update(logged["time"].attrs)
    seconds = np.asarray((temperature["time"].values - temperature["time"].values[0]) / np.timedelta64(1, "s"), float)
    found = examine_sensors(seconds, temperature.values)
    faults = tuple(fault for fault in found if fault.is_clear and not fault.readings)
    temperature.values = examine_readings(seconds, temperature.values, None, quantity="temperature")[1]
    if len(faults) == len(names):
        named = "; ".join(f"{names[fault.sensor]} {fault.words}" for fault in faults)
        raise TableError(f"{path}: no contact sensor is sound ({named}); repeat the test, or remove [sensors]")
    x_mm, y_mm = np.array([places[name] for name in names]).T
    return ContactSensors(table.file, temperature, x_mm, y_mm, table.temperature_u_K, faults)


def _read_places(path: Path, names: list[str], size_mm: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Read ``name,x_mm,y_mm`` of every sensor, each on the plan."""
    table = tables.read_table(path, ("name", "x_mm", "y_mm"))
    places: dict[str, tuple[float, float]] = {}
    for line, fields in table.records():
        if fields is None:
            raise TableError(f"{path}, line {line}: it does not have the fields of the heading; write name,x_mm,y_mm")
        try:
            place = (table.numerals.number(fields["x_mm"]), table.numerals.number(fields["y_mm"]))
        except tables.BadReading as fault:
            raise TableError(f"{path}, line {line}: {fault.reason}; write the place in mm") from None
        if not (0.0 <= place[0] <= size_mm[0] and 0.0 <= place[1] <= size_mm[1]):
            raise TableError(
                f"{path}, line {line}: x {place[0]:g} mm, y {place[1]:g} mm is outside the plan of {size_mm[0]:g} x {size_mm[1]:g} mm; "
                "correct the place, or plan.size"
            )
        written = fields["name"].strip()
        alike = [name for name in names if normalize("NFC", name) == normalize("NFC", written)]
        places[alike[0] if written not in names and alike else written] = place
    strange = sorted(set(names) ^ set(places))
    if strange:
        raise TableError(
            f"{path}: {', '.join(strange)} is in only one of the two files; every sensor needs a column of temperatures and a place"
        )
    return places
