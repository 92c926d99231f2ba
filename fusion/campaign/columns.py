"""How a logged table is laid out and what its columns hold, proposed from names, units and values, for somebody to confirm."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fusion.campaign import logs
from fusion.campaign.config import HeaderRows, LoggedTable
from fusion.campaign.values import (
    DAY_NUMBERS,
    TIME_UNITS,
    column_conversion,
    column_unit,
    conversion,
    has_unit,
    is_time,
    is_unit,
    name_and_unit,
    role_of_unit,
    unit_name,
)
from fusion.common import FusionError
from fusion.results.numbers import span
from fusion.results.progress import listed
from interferometry.io import tables
from interferometry.io.faults import BadReading, LaserFormatError, RejectedLine
from interferometry.io.spreadsheets import cell_text, is_workbook
from thermofuse.resources import by_word, vocabulary
from thermofuse.units import SHARE, find_unit

_VOCABULARY = vocabulary("logs")

#: What a column may hold; only the three in the middle are written into ``[record.columns]``.
ROLES = ("time", "temperature", "displacement", "driver", "out")
_NO_NUMBERS, _NOT_KNOWN = "no numbers", "not known"
#: Of a column whose unit is to be stated.
UNIT_NOT_KNOWN = "unit not known"
#: What only the values of a column tell: that it is a temperature, and its unit.
_BY_VALUES, _UNIT_BY_VALUES = "by its values", "unit by its values"
_OF_SPREAD = "spread, limit or dew point"
_COUNTS = "whole numbers: counts? then one count with its unit, as 0.0125 mm"
#: Comment of Klipper's logs: millimetres of one step of the motor.
_STEP = re.compile(r"#\s*step_dist\w*\s*=\s*([\d.]+)\s*$")
#: Years in which days that are counted from a date are told by their numbers: 2000 to 2040.
_DAYS_FROM, _DAYS_TO = 10957.0, 25568.0
_TIME = re.compile(r"(time|t$|ts$|elapsed|seconds$|sec$|minutes$|min$|hours$|datetime|last_changed$|时间|時間)", re.I)
#: Marks of loggers and drivers of sensors for "no reading" that look like numbers.
_MARKS = tuple(_VOCABULARY["marks"])
#: Words in brackets that may be a unit, beside which a temperature has no usual one; a factor beside a unit.
_NO_UNITS, _OF_SIGNALS = frozenset(_VOCABULARY["no_units"]), frozenset(_VOCABULARY["of_signals"])
_FACTOR = re.compile(r"[x×*·/]?\s*\d[\d.,eE^/+-]*\s*[x×*·]?|[x×*·]")
#: What a DS18B20 gives before its first conversion, degC and degF (Maxim, data sheet 19-7487), this far from its neighbours, K.
_POWER_ON, _POWER_ON_JUMP = (85.0, 185.0), 5.0
#: A mark lies this far outside the other values of its column.
_FAR = 50.0
#: No machine grows so far by heat, mm: an axis that moves does.
_FARTHEST_MM = 20.0
#: Heading that states from when seconds count, that instant, and between which numbers of seconds the years of such times lie: GPS (less
#: the leap seconds since 2017), Unix, LabVIEW.
_EPOCHS = (
    (re.compile(r"gps", re.I), "1980-01-05T23:59:42Z", 6e8, 2.5e9),
    (re.compile(r"unix|epoch|posix", re.I), "1970-01-01T00:00:00Z", 1e9, 2.5e9),
    (re.compile(r"labview|1904", re.I), "1904-01-01T00:00:00Z", 3.2e9, 4.5e9),
)
#: Later seconds of Unix would be GPS times after 2030.
_UNIX_ALONE = (1.6e9, 2.5e9)
#: An uncertainty: u(T1), ±.
_SPREAD = re.compile(r"^(u|s|σ)\s*\(|±|\+/?-$")
#: An error beside the column that has it.
_ERROR_OF = re.compile(r"(.+?)[\s_]+err(?:or)?", re.I)
#: Units of a speed of rotation, whose sign n is that of a count too.
_OF_SPEED = ("rpm", "RPM", "1/min", "U/min", "tr/min", "r/min", "rev/min", "min-1", "min^-1", "1/s")
#: A unit of a rate of change.
_RATE = re.compile(r".+/\s*(s|sec|min|h|hr)")
#: A line above a table that states units.
_OF_UNITS = re.compile(r"\bunit|einheit|unité|unidad", re.I)
#: Heading of a time as a channel of its own has it: Time_X, Time - X, Time.1.
_OWN_TIME = re.compile(r"(time|zeit|temps|tiempo)(?![^\W\d_])", re.I)
#: Headings that say what the numbers of a time of day are.
_MINUTES_FIRST, _HOURS_FIRST = re.compile(r"\bm+:s+\b", re.I), re.compile(r"\bh+:m+", re.I)
#: Shortest and longest thermal test, by which a number without unit is told to be seconds, minutes or milliseconds.
_LENGTHS_S = np.array([1800.0, 1e7])
#: Words of headings, the plain ones before those of one or two letters.
_WORDS = tuple((one["name"], frozenset(one["words"])) for one in _VOCABULARY["role"])
#: Words of a column that counts, and of one that says nothing of what it holds, where no other word stands beside them.
_COUNTING, _SAYING_NOTHING = frozenset(_VOCABULARY["counting"]), frozenset(_VOCABULARY["saying_nothing"])
#: Letters of a word by which a longer one that ends with it is known.
_SHORTEST_ENDING = 4
#: Most columns of a table with a line for every change: date, time, channel, value, unit, quality.
_WIDEST_LONG = 6
#: Lines that repeat time and channel are more only where several series have the same names: an alarm at the time of a value is rare.
_SAME_TIME = 0.1
#: Columns of a table of changes that say how a value was read.
_STATE = re.compile(r"quality|alarm|status|severity|state|flag|güte", re.I)
#: Units at the end of a heading, after a space or an underscore.
_SUFFIXES = by_word(_VOCABULARY["suffixes"])
_SUFFIXES_OF = {role: by_word(suffixes) for role, suffixes in _VOCABULARY["suffixes_of"].items()}
_UNIT_OF_WORD = by_word(_VOCABULARY["unit_of_word"])


class ColumnsError(FusionError):
    """A correction of proposed columns that is none; the message says how one is written."""


@dataclass(frozen=True)
class Column:
    """A column, what it is proposed to hold, its unit, its first values, the range of its numbers, and what is to be known of it.

    ``told`` says where its unit stands; empty where it is stated nowhere.
    """

    heading: str
    role: str
    unit: str = ""
    first: tuple[str, ...] = ()
    low: float = float("nan")
    high: float = float("nan")
    remark: str = ""
    told: str = ""

    @property
    def is_guessed(self) -> bool:
        """Whether only its values tell its unit."""
        return self.remark in (_BY_VALUES, _UNIT_BY_VALUES, _COUNTS)

    @property
    def span(self) -> str:
        """Range of the numbers in words, empty where the column has none."""
        return span(np.array([self.low, self.high])) if np.isfinite(self.low) else ""


@dataclass(frozen=True)
class TableProposal:
    """A logged table: keys of ``[record]`` that say how it is laid out, and its columns; `asked` are keys that the file does not tell.

    ``time`` holds the times of its rows in UTC, none where nothing states their unit, and ``reference`` how they came to it, in words;
    ``attrs`` lists the lines that are left out, and those at which the clock goes back, as the attributes of the record read from it;
    ``refused`` says why its rows cannot be a record.
    """

    path: Path
    keys: dict[str, Any]
    columns: tuple[Column, ...]
    rows: int
    asked: dict[str, str] = field(default_factory=dict)
    time: np.ndarray = field(default_factory=lambda: np.array([], "M8[ns]"), compare=False)
    reference: str = ""
    attrs: Mapping[str, str] = field(default_factory=dict)
    refused: str = ""

    def of(self, role: str) -> tuple[Column, ...]:
        """Return the columns of a role."""
        return tuple(column for column in self.columns if column.role == role)

    @property
    def lacking(self) -> list[str]:
        """Roles that a record needs and no column of this table has."""
        return [role for role in ("temperature", "displacement") if not self.of(role)]

    @property
    def lacks(self) -> str:
        """What a record needs and this table does not have, in words; empty where it has all."""
        if not (lacking := self.lacking):
            return ""
        known = listed(f"{column.heading} ({column.role})" for column in self.columns if column.role != "out")
        return (
            f"a table of {len(self.columns)} columns and {self.rows} rows without a {' and a '.join(lacking)}, which a record needs"
            f"{f'; found: {known}' if known else ''}; a column is named with its unit, such as T1 [degC] or Z [um]"
        )

    @property
    def may_be_record(self) -> bool:
        """Whether temperatures and displacements are found, or something that may be the displacement."""
        remarks, temperatures = [column.remark for column in self.columns], self.of("temperature")
        # One of two temperatures that only their values tell may be the displacement, as the signal of a sensor may.
        signal = any(one.unit in _OF_SIGNALS and (one.role == "driver" or one.remark) for one in self.columns)
        guessed = signal or _NOT_KNOWN in remarks or (_BY_VALUES in remarks and len(temperatures) > 1)
        return not self.lacks or (guessed and (bool(temperatures) or _BY_VALUES in remarks))

    def lines(self) -> Iterator[str]:
        """Yield the columns as a table of text: number, heading, first values, role and unit."""
        rows = [("", "column", "first values", "range", "role", "unit", "")]
        rows += [
            (str(k), one.heading, ", ".join(one.first), one.span, one.role, one.unit, one.remark)
            for k, one in enumerate(self.columns, start=1)
        ]
        widths = [min(max(map(len, cells)), 36) for cells in zip(*rows, strict=True)]
        for row in rows:
            cells = (f"{cell[:width]:<{width}}" for cell, width in zip(row, [*widths[:-1], 99], strict=True))
            yield "  ".join(cells).rstrip()

    def corrected(self, text: str) -> TableProposal:
        """Return it with other roles and units: ``3-5 = temperature degC; 7 = out``."""
        columns = list(self.columns)
        for part in filter(str.strip, text.split(";")):
            match = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*=\s*(\w+)\s*(.*?)\s*", part)
            role = next((role for role in ROLES if match and role.startswith(match[3].lower())), None)
            numbers = range(int(match[1]), int(match[2] or match[1]) + 1) if match else range(0)
            if match is None or role is None or not numbers or not set(numbers) <= set(range(1, len(columns) + 1)):
                raise ColumnsError(
                    f'"{part.strip()}" is no correction; write number or range of the column, role ({", ".join(ROLES)}) and unit: '
                    "3-5 = temperature degC; 7 = out"
                )
            for number in numbers:
                before = columns[number - 1]
                usual, remark = _usual_unit(role, before)
                if role == "displacement" and before.unit in _OF_SIGNALS:
                    usual, remark = before.unit, UNIT_NOT_KNOWN
                unit = match[4] or (before.unit if _is_unit_of(role, before.unit) else "")
                columns[number - 1] = replace(before, role=role, unit=unit or usual, remark="" if unit else remark)
        times = [column for column in columns if column.role == "time"]
        if times == list(self.of("time")):
            return replace(self, columns=tuple(columns))
        kept = {
            key: value
            for key, value in self.keys.items()
            if key not in ("time", "every", "time_unit", "time_format", "date_order", "start", "long")
        }
        if not times:
            return replace(self, columns=tuple(columns), keys=kept, asked={"every": ""})
        keys, asked = kept | {"time": [one.heading for one in times]}, dict[str, str]()
        if times[0].unit:
            keys["time_unit"] = times[0].unit
        elif times[0].span:
            _place_times(times[0].heading, np.array([times[0].low, times[0].high]), "", keys, asked)
        return replace(self, columns=tuple(columns), keys=keys, asked=asked)


def propose_runs(proposals: Sequence[TableProposal]) -> TableProposal:
    """Propose for several tables with the same headings: as for the first, without the columns that one of them cannot give."""
    first, *others = proposals
    lost = {column.heading for other in others for column in other.of("out") if column.remark == _NO_NUMBERS}
    columns = [
        replace(one, role="out", remark="not in every run") if one.heading in lost else one for one in first.columns
    ]
    marks = sorted({mark for table in (first, *others) for mark in table.keys.get("missing", [])})
    return replace(first, columns=tuple(columns), keys=first.keys | ({"missing": marks} if marks else {}))


def propose_table(path: Path) -> TableProposal:
    """Read a logged table, and propose how it is laid out and what its columns hold."""
    sheets, head = _head(path)
    sheet = next(iter(sheets), None)
    keys = _of_labview(head) or _of_campbell(head) or _of_monitor(head) or _header_rows(path, head)
    header = HeaderRows.model_validate(keys["header_rows"]) if "header_rows" in keys else None
    rows = logs.read_rows(path, sheet=sheet, header=header)
    keys |= {"sheet": sheet} if sheet else {}
    frame, asked = rows.frame, {"sheet": " or ".join(sheets[1:])} if sheets[1:] else {}
    if frame.empty:
        raise LaserFormatError(f"{path}: no rows below the header")
    units = dict[str, str]()
    keys |= {} if "long" in keys else _long(path, rows, asked, units)
    if "long" in keys:
        channels = frame.groupby(logs.stripped(frame[keys["long"]["channel"]]).replace("", None))
        groups = {str(name): values[keys["long"]["value"]] for name, values in channels}
        columns, marks = _columns(groups, units)
        if all(column.remark == _BY_VALUES for column in columns if column.role == "temperature"):
            # Channels have names: what none of them calls a temperature is a position, a count, a state.
            columns = [replace(one, role="out") if one.remark == _BY_VALUES else one for one in columns]
    else:
        times = (keys["time"],) if "time" in keys else () if "every" in keys else _times(rows, keys, asked)
        if len(times) == 1 and "time_unit" not in asked:
            layout = {key: value for key, value in keys.items() if key not in ("time", "header_rows", "sheet")}
            _refuse_own_times(path, rows, LoggedTable.model_validate(layout), times[0])
        columns, marks = _columns({str(name): frame[name] for name in frame.columns if name not in times}, rows.units)
        # A spreadsheet counts times in days.
        in_days = not head[0][1] and keys.get("time_unit") == "h"
        not_known = "time_unit" in asked and (in_days or any(_stated_units(rows, name) for name in times))
        remark = UNIT_NOT_KNOWN if not_known else ""
        timed = (Column(name, "time", keys.get("time_unit", ""), _first(frame[name]), remark=remark) for name in times)
        columns = [*timed, *columns]
    above = _units_above(rows.above)
    steps = [match[1] for _, text, _ in head if (match := _STEP.match(text))]
    for k, one in enumerate(columns):
        if one.role in above and one.remark == _UNIT_BY_VALUES:
            columns[k] = replace(one, unit=above[one.role], remark="", told="line above the table")
        elif steps and one.remark == _COUNTS:
            columns[k] = replace(one, unit=f"{steps[0]} mm", remark="counts, of step_dist")
    if marks:
        rows = logs.read_rows(path, sheet=sheet, header=header, missing=marks)
    time, reference, lines, refused = _read(path, rows, keys)
    lost = {line.line for line in lines["left_out"]}
    used = [name for one in columns if one.role in ROLES[1:-1] for name in rows.marks.get(one.heading, ())]
    lines["marks"] = [mark for mark in used if mark.line not in lost]
    return TableProposal(
        path,
        keys | ({"missing": marks} if marks else {}),
        tuple(columns),
        len(frame) + len(rows.left_out) - len(lines["left_out"]),
        asked,
        time[:0] if "time_unit" in asked else time,
        reference,
        {name: json.dumps([asdict(line) for line in of_name]) for name, of_name in lines.items()},
        refused,
    )


def _read(
    path: Path, rows: logs.Rows, keys: Mapping[str, Any]
) -> tuple[np.ndarray, str, dict[str, list[RejectedLine]], str]:
    """Return the times of a table, how they came to UTC in words, by the attribute that holds them the lines that a record leaves out, and
    those at which its clock goes back, and why a record refuses them.
    """
    headings = keys["long"]["time"] if "long" in keys else keys.get("time")
    if headings is None:
        return np.array([], "M8[ns]"), "", {"left_out": rows.left_out}, ""
    layout = LoggedTable.model_validate({key: value for key, value in keys.items() if key not in ("long", "time")})
    time, reference, without = logs.read_times(
        path, rows, layout, [headings] if isinstance(headings, str) else headings
    )
    keep = ~np.isnat(time)
    lines, refused = {"left_out": sorted([*rows.left_out, *without], key=lambda line: line.line)}, ""
    try:
        lines["clock"] = (
            [] if "long" in keys else tables.where_clock_goes_back(path, rows.frame.index[keep], time[keep])
        )
    except LaserFormatError as error:
        refused = str(error).removeprefix(f"{path}, ")
    return time[keep], reference, lines, refused


def _columns(groups: Mapping[str, pd.Series], units: Mapping[str, str]) -> tuple[list[Column], list[float]]:
    """Propose what every column holds, and which numbers are marks for no reading in all of them."""
    numbers = {heading: _finite(series) for heading, series in groups.items()}
    found = {heading: [mark for mark in _MARKS if _is_mark(mark, values)] for heading, values in numbers.items()}
    columns = [
        _column(heading, units.get(heading, ""), series, numbers[heading][~np.isin(numbers[heading], found[heading])])
        for heading, series in groups.items()
    ]
    for k, (heading, series) in enumerate(groups.items()):
        if columns[k].role == "temperature" and (mark := _power_on(numbers[heading])):
            found[heading].append(mark)
            rest = numbers[heading][~np.isin(numbers[heading], found[heading])]
            columns[k] = _column(heading, units.get(heading, ""), series, rest)
    names = {name_and_unit(heading)[0] for heading in groups}
    for k, column in enumerate(columns):
        if (of := _ERROR_OF.fullmatch(name_and_unit(column.heading)[0])) and of[1] in names:
            columns[k] = replace(column, role="out", remark=_OF_SPREAD)
    used = [column.heading for column in columns if column.role != "out"]
    marks = {mark for heading in used for mark in found[heading]}
    return columns, sorted(
        mark for mark in marks if all(mark in found[name] or mark not in numbers[name] for name in used)
    )


# Where names, units and values stand.


def _head(path: Path) -> tuple[list[str], list[tuple[int, str, list[str]]]]:
    """Return the sheet of a table and others like it, none of a text, and its first lines that are not empty: number, text and fields."""
    if is_workbook(path.read_bytes()):
        name, rows, alike = logs.sheet_of(path)
        sheets = [name, *alike] if name else []
        return sheets, [(line, "", [cell_text(cell) for cell in cells]) for line, cells in rows[: logs.HEAD]]
    lines = logs.text_lines(path)[: logs.HEAD]
    delimiter = tables.delimiter_of_values(
        max(lines[len(lines) // 2 :], key=lambda line: len(line.strip()), default="")
    )
    split = ((k, line, [text.strip() for text in tables.fields_of(line, delimiter)]) for k, line in enumerate(lines, 1))
    return [], [row for row in split if row[1].strip()]


def _units_above(lines: Iterable[str]) -> dict[str, str]:
    """Return the unit of a role that lines such as "Temperature unit: Fahrenheit" state."""
    fields = [part.strip() for line in lines if _OF_UNITS.search(line) for part in re.split(r"[:;,=\t/]", line)]
    stated = {
        unit.name for text in fields if (unit := find_unit(text)) is not None and unit.kind in ("temperature", "length")
    }
    roles = [role_of_unit(unit) for unit in stated]
    return {role: unit for role, unit in zip(roles, stated, strict=True) if roles.count(role) == 1}


def _of_labview(head: list[tuple[int, str, list[str]]]) -> dict[str, Any]:
    """Return the layout of a LabVIEW measurement file: two headers, the second with the unit, the step and the start of every channel."""
    if not head or not head[0][1].startswith("LabVIEW Measurement"):
        return {}
    ends = [k for k, (_, text, _) in enumerate(head) if text.startswith("***End_of_Header***")]
    stated = {fields[0]: (line, fields[1:]) for line, _, fields in head[: ends[-1] if ends else 0] if len(fields) > 1}
    if not {"Date", "Time", "X_Columns"} <= stated.keys() or ends[-1] + 1 == len(head):
        return {}
    names = head[ends[-1] + 1][0]
    header = {"names": names, "values": names + 1}
    if "Y_Unit_Label" in stated:
        header["units"] = stated["Y_Unit_Label"][0]
    keys: dict[str, Any] = {"header_rows": header}
    date, clock = (stated[name][1][0].replace("/", "-").replace(",", ".") for name in ("Date", "Time"))
    keys["start"] = f"{date}T{clock[:15]}"
    if stated["X_Columns"][1][0] == "No" and "Delta_X" in stated:
        keys["every"] = f"{stated['Delta_X'][1][0].replace(',', '.')} s"
    else:
        keys |= {"time": "X_Value", "time_unit": "s"}
    return keys


def _of_campbell(head: list[tuple[int, str, list[str]]]) -> dict[str, Any]:
    """Return the layout of a table of Campbell's loggers, TOA5: station, names, units, kind of processing."""
    is_toa5 = bool(head) and head[0][2][:1] == ["TOA5"]
    return {"header_rows": {"names": 2, "units": 3, "values": 5}, "time": "TIMESTAMP"} if is_toa5 else {}


def _of_monitor(head: list[tuple[int, str, list[str]]]) -> dict[str, Any]:
    """Return the layout of what EPICS' camonitor prints: channel, date, time, value, state of the alarm."""
    matching = [line for line, text, _ in head if logs.MONITORED.match(text)]
    if len(matching) < max(logs.ROWS_OF_VALUES, len(head) / 2):
        return {}
    return {"header_rows": {"values": 1}, "long": {"time": ["2", "3"], "channel": "1", "value": "4"}}


def _header_rows(path: Path, head: list[tuple[int, str, list[str]]]) -> dict[str, Any]:
    """Return where the names, the units and the values of any other table stand, nothing where the names are its first line."""
    rows = [(line, fields) for line, text, fields in head if not text.startswith("#")]
    first = logs.first_of_values(rows)
    if first is None:
        raise LaserFormatError(
            f"{path}: no rows of numbers below one another; export it again with its readings, or move it out of the folder"
        )
    width = len(rows[first][1])
    above = [(line, fields) for line, fields in rows[:first] if sum(map(bool, fields)) > width / 2]
    if not above:
        if not _numbers_channels(rows[first : first + 1 + logs.ROWS_OF_VALUES]):
            return {"header_rows": {"values": rows[first][0]}}
        above, first = [rows[first]], first + 1
    header = {"names": above[-1][0], "values": rows[first][0]}
    given = [text for text in above[-1][1] if text]
    # Names may be blank above the second of two columns.
    over = [(line, fields) for line, fields in rows[:first] if line < above[-1][0] and sum(map(bool, fields)) > 1]
    # Names do not repeat, as degC above every thermocouple does.
    repeats = sum(map(is_unit, given)) > 1 and len(set(given)) < len(given)
    if over and (repeats or 2 * sum(map(is_unit, given)) >= len(given)):
        header |= {"names": over[-1][0], "units": above[-1][0]}
    elif over and _is_over(over[-1][1], above[-1][1]):
        header["units"] = over[-1][0]
    usual = {"names": rows[0][0], "values": rows[0][0] + 1}
    return {} if header == usual else {"header_rows": header}


def _is_over(groups: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a row of names of several columns each stands above another one, as a blank below it, or units that are only there, tell."""
    if len(groups) != len(names) or all(groups):
        return False
    blank = any(group and not name for group, name in zip(groups, names, strict=True))
    with_unit = any(is_unit(column_unit(text)) for text in groups) and not any(map(column_unit, names))
    return blank or with_unit or any(_word(text)[1] in ROLES[1:3] for text in groups)


def _numbers_channels(rows: Sequence[tuple[int, list[str]]]) -> bool:
    """Whether the first row holds names, with channels that are called by whole numbers, above rows of values."""
    (_, names), *values = rows
    words = [k for k, name in enumerate(names) if name and not logs.VALUE.fullmatch(name)]
    return (
        bool(words and values)
        and all(name.isdecimal() for k, name in enumerate(names) if name and k not in words)
        and all(len(fields) == len(names) and logs.VALUE.fullmatch(fields[words[0]].strip()) for _, fields in values)
    )


def _long(path: Path, rows: logs.Rows, asked: dict[str, str], units: dict[str, str]) -> dict[str, Any]:
    """Return the layout of a table with a line for every change: a time, a name that recurs, a number; add the units of its channels."""
    frame, keys, open_ = rows.frame, dict[str, Any](), dict[str, str]()
    # A column that says one thing throughout says nothing of a line.
    telling = [str(name) for name in frame if frame[name].nunique() > 1]
    written = {name: logs.stripped(frame[name]) for name in telling if not pd.api.types.is_numeric_dtype(frame[name])}
    if len(frame.columns) < 3 or not written:
        return {}
    times = _times(rows, keys, open_)
    written = {name: texts for name, texts in written.items() if name not in times}
    numbers = {name for name in written if np.isfinite(logs.numbers_in(frame[name])).mean() > 0.5}
    distinct = {name: set(texts) - {""} for name, texts in written.items()}
    of_units = [name for name, texts in distinct.items() if texts and all(map(is_unit, texts))]
    names = {name: len(texts) for name, texts in distinct.items() if name not in (*numbers, *of_units)}
    channel = max(names, key=names.__getitem__, default="")
    if not times or not 1 < names.get(channel, 0) < len(frame) / 3:
        return {}
    # What is the same on all lines of a channel describes it, as the number of its table does.
    of_channel = frame.groupby(written[channel])[telling].nunique().max()
    telling = [name for name in telling if name in (*times, channel, *of_units) or of_channel[name] > 1]
    values = [name for name in telling if name not in (*times, *names, *of_units)]
    values = [name for name in values if not _STATE.search(str(name))] or values
    if len(telling) > _WIDEST_LONG or len(values) != 1:
        return {}
    more = [str(name) for name in names if name in telling and name != channel]
    if (
        more
        and frame.duplicated([*times, channel]).mean() > _SAME_TIME > frame.duplicated([*times, channel, *more]).mean()
    ):
        raise LaserFormatError(
            f"{path}: lines of one time and one {channel} differ by {listed(more)}; give those of each {more[0]} in a file of "
            "their own, or write both names in one column"
        )
    asked |= open_
    for name, unit in sorted(set(zip(written[channel], written[of_units[0]], strict=True))) if of_units else ():
        # Two units of one channel are none.
        if unit and unit_name(units.setdefault(name, unit)) != unit_name(unit):
            units[name] += f" or {unit}"
    return {"long": {"time": keys.pop("time"), "channel": channel, "value": str(values[0])}, **keys}


# Which column holds the times, and how they are written.


def _times(rows: logs.Rows, keys: dict[str, Any], asked: dict[str, str]) -> tuple[str, ...]:
    """Return the headings of the times; write into `keys` how they are to be read, and into `asked` what nothing tells."""
    frame = rows.frame
    parts = [str(name) for name in frame.columns if str(name).strip().casefold() in logs.PARTS]
    whole = logs.parts_of_time(frame, parts)
    if whole is not None and _mostly(whole.notna()):
        keys["time"] = parts
        return tuple(parts)
    samples = {name: _sample(frame[name]) for name in frame.columns if not pd.api.types.is_numeric_dtype(frame[name])}
    # A line of text among numbers, as a footer or a second header is, leaves a column one of numbers.
    texts = [
        name
        for name, sample in samples.items()
        if not _mostly(np.isfinite(logs.numbers_in(pd.Series(sample, dtype=object))))
    ]
    named = [name for name in frame.columns if _is_time_name(name, rows.units.get(name, ""))]
    days = [name for name in texts if _mostly(np.isfinite(tables.elapsed_s(samples[name])))]
    named = [*(name for name in named if name not in days), *(name for name in named if name in days)]
    # A first column without a name that grows, and does not count rows, is the time.
    for name in [*named, *texts, *(["1"] if frame.columns[0] == "1" and not _counts(frame["1"]) else [])]:
        if name not in texts:
            if not _grows(frame[name]):
                continue
            keys["time"] = name
            stated = _stated_units(rows, name)
            known = next((unit for unit in stated if unit in TIME_UNITS), "")
            _place_times(name, _finite(frame[name]), known, keys, asked)
            if stated and not known and "time_unit" in asked:
                asked["time_unit"] += f", in {stated[0]}: {UNIT_NOT_KNOWN}"
            return (name,)
        for columns in ([name, *[two for two in days if two != name][:1]], [name]):
            written = _sample(logs.written_times(frame, columns))
            order = _order_of(logs.stripped(logs.written_times(frame, columns)).tolist(), asked)
            if name in days and columns == [name]:
                keys["time"], heading = name, f"{name} {rows.units.get(name, '')}"
                two = all(text.count(":") == 1 for text in written) and not _HOURS_FIRST.search(heading)
                # Less than 24 minutes would be no test.
                if _MINUTES_FIRST.search(heading) or (two and np.nanmax(tables.elapsed_s(written)) >= 86400.0):
                    keys["time_format"] = "%M:%S"
                    asked |= {} if _MINUTES_FIRST.search(heading) else {"time_format": "%H:%M"}
                elif two and tables.elapsed_s(written)[0] == 0.0:
                    # Counted from zero, either; a time of day begins elsewhere.
                    keys["time_format"], asked["time_format"] = "%H:%M", "%M:%S"
                return (name,)
            if _mostly([_is_read(text, tables.DateOrder(order)) for text in written]):
                behind = list(frame.columns)[list(frame.columns).index(columns[-1]) + 1 :][:1]
                # Times of whole seconds repeat without it.
                columns += [one for one in behind if logs.is_fraction(one) and frame[one].nunique() > 1]
                keys |= {"time": columns if len(columns) > 1 else name} | ({"date_order": order} if order else {})
                return tuple(columns)
            asked.pop("date_order", None)
    # Times that are not understood are named.
    places = [
        (samples[name][0], name, int(frame.index[frame[name].notna()][0]))
        for name in named
        if name in texts and samples[name]
    ][:1]
    told = [f'{text!r} in the column "{name}", line {line}, is no time that is read' for text, name, line in places]
    asked["every"] = "".join(told)
    return ()


def _refuse_own_times(path: Path, rows: logs.Rows, layout: LoggedTable, time: str) -> None:
    """Refuse a table of which another column of times does not run as the first: its channels have a clock each."""
    for name in filter(_OWN_TIME.match, map(str, rows.frame.columns.drop(time))):
        stated = (*_stated_units(rows, name), layout.time_unit, *_stated_units(rows, time))
        own = layout.model_copy(update={"time_unit": next((unit for unit in stated if unit in TIME_UNITS), None)})
        try:
            first, other = logs.read_times(path, rows, layout, [time])[0], logs.read_times(path, rows, own, [name])[0]
        except (FusionError, LaserFormatError):
            continue
        first, other = np.array([first, other])[:, ~(np.isnat(first) | np.isnat(other))].astype("i8")
        if first.size > 1 and (np.diff(other) >= 0).all() and abs(np.ptp(other) - np.ptp(first)) > 0.01 * np.ptp(first):
            raise LaserFormatError(
                f'{path}: the times of the columns "{time}" and "{name}" do not run alike, so that channels have a clock each; write all '
                "of them one below the other, in columns of time, channel and value"
            )


def _stated_units(rows: logs.Rows, name: str) -> list[str]:
    """Return the units that the row of units and the heading state of a column."""
    alone = name.strip() if unit_name(name.strip()) in TIME_UNITS else ""
    return [unit_name(unit) for unit in (rows.units.get(name, ""), column_unit(name), alone) if unit.strip("- ")]


def _is_time_name(heading: str, unit: str) -> bool:
    """Whether a heading, or its unit in a row of units, is that of a time or a date."""
    name, in_heading = name_and_unit(heading)
    named = _TIME.match(name) is not None and role_of_unit(unit or in_heading) != "temperature"
    return is_time(heading) or named or not {unit_name(unit), unit_name(heading.strip())}.isdisjoint(TIME_UNITS)


def _sample(column: pd.Series) -> list[str]:
    """Return some fifty texts of a column, from all of its rows that have one."""
    texts = logs.stripped(column.dropna())
    texts = texts[texts != ""]
    return texts.iloc[:: max(1, len(texts) // 50)].tolist()


def _mostly(each: Iterable[object]) -> bool:
    """Whether something holds for more than half, as a reader asks of the lines of a file."""
    return bool(np.mean([bool(one) for one in each] or [False]) > 0.5)


def _finite(column: pd.Series) -> np.ndarray:
    numbers = logs.numbers_in(column)
    return numbers[np.isfinite(numbers)]


def _grows(column: pd.Series) -> bool:
    numbers, _ = logs.unwrapped(_finite(column))
    return numbers.size > 1 and bool(numbers[-1] > numbers[0]) and float((np.diff(numbers) >= 0).mean()) > 0.98


def _counts(column: pd.Series) -> bool:
    return bool((np.diff(_finite(column)) == 1.0).all())


def _place_times(heading: str, numbers: np.ndarray, known: str, keys: dict[str, Any], asked: dict[str, str]) -> None:
    """Write the unit of times that are numbers into `keys`, and from when they count; into `asked` what nothing states."""
    for unit in [known] if known else ("s", "ms", "us", "ns"):
        seconds = numbers[0] * conversion(unit, "s")[0] if unit not in DAY_NUMBERS else 0.0
        for stated, start, low, high in _EPOCHS:
            if low < seconds < high and (stated.search(heading) or stated is not _EPOCHS[0][0]):
                keys |= {"start": start} | ({} if known else {"time_unit": unit})
                if not (stated.search(heading) or _UNIX_ALONE[0] < seconds < _UNIX_ALONE[1]):
                    asked["start"] = " or ".join(other for _, other, *_ in _EPOCHS)
                return
    if known:
        keys |= {"time_unit": known} if known in DAY_NUMBERS or unit_name(heading.strip()) == known else {}
        return
    for unit, of_1970 in DAY_NUMBERS.items():
        if _DAYS_FROM < numbers[0] - of_1970 < _DAYS_TO and not (numbers == np.round(numbers)).all():
            keys["time_unit"], asked["time_unit"] = unit, f"{numbers[0]:.6f} to {numbers[-1]:.6f}"
            return
    whole, minutes, seconds = numbers == np.round(numbers), numbers // 100 % 100, numbers % 100
    if whole.all() and 10_000 <= numbers.max() < 240_000 and 30 < minutes.max() < 60 > seconds.max():
        # Seconds that are counted go through 6000 to 9999.
        keys["time_format"], asked["time_format"] = "%H%M%S", ""
        return
    shortest, longest = _LENGTHS_S / max(float(numbers[-1] - numbers[0]), 1e-9)
    units = (unit for unit in ("s", "min", "h", "ms", "us", "ns") if shortest <= conversion(unit, "s")[0] <= longest)
    keys["time_unit"] = next(units, "h")
    asked["time_unit"] = f"{_plain(float(numbers[0]))} to {_plain(float(numbers[-1]))}"


def _order_of(texts: Sequence[str], asked: dict[str, str]) -> str:
    """Return what stands first in dates, where only their course tells it; write into `asked` what else may."""
    with suppress(LaserFormatError):
        tables.DateOrder.of(Path(), enumerate(texts))
        return ""
    # A clock of AM and PM without blanks is an English one, as dates with the month first are; years of two digits are the latest.
    usual = "month first" if re.search(r"\d ?[AP]M", " ".join(texts)) else "day first"
    dates = next((found for text in texts if len(found := tables.possible_dates(text)) > 1), {})
    usual = "year first" if "year first" in dates and dates["year first"] == max(dates.values()) else usual
    first, *others = sorted(tables.closest_orders(texts), key=usual.__ne__) or [""]
    asked |= {"date_order": " or ".join(others)} if others else {}
    return first


def _is_read(text: str, order: tables.DateOrder) -> bool:
    """Whether a text is a time."""
    with suppress(BadReading):
        return bool(tables.parse_time(text, order))
    return False


# What a column holds, and its unit.


def _column(heading: str, unit: str, series: pd.Series, numbers: np.ndarray) -> Column:
    """Propose role and unit of a column from its unit, the words of its heading, and its values."""
    name, in_heading = name_and_unit(heading)
    word, role = _word(name)
    # 1 is a unit, but of no temperature.
    is_apart = not is_unit(in_heading) or (role == "temperature" and in_heading == "1")
    of_place = "[" not in heading and is_apart and (in_heading.isdecimal() or in_heading.isalpha())
    if of_place and in_heading.casefold() not in _NO_UNITS and role != "displacement":
        in_heading = ""  # TC(1), T (air): a number or a word, no unit
    # What the last word of a name means depends on the others: in is an inlet beside a temperature.
    suffixes = _SUFFIXES | _SUFFIXES_OF.get(role, {})
    behind = tables.read_heading(name).unit
    share = behind.name if behind is not None and SHARE.search(name) else ""
    ending = share or suffixes.get(
        re.split(r"[\s_/,;]+", re.sub(r"\.\d+$", "", name))[-1].casefold().replace("μ", "µ"), ""
    )
    told = "row of units" if unit.strip("- ") else "heading" if in_heading or ending else ""
    unit = unit_name(unit.strip("- ") or in_heading or ending)
    first = _first(series)
    if not numbers.size:
        return Column(heading, "out", unit, first, remark=_NO_NUMBERS)
    low, high = float(numbers.min()), float(numbers.max())
    known = Column(heading, "out", unit, first, low, high, told=told)
    warm = 12.0 < float(np.median(numbers)) < 80.0 and not (numbers == np.round(numbers)).all()
    if word in _COUNTING and unit in _OF_SPEED:
        role = ""  # n in 1/min is a speed
    if role == "spread" or _SPREAD.search(name):
        return replace(known, remark=_OF_SPREAD)
    if role == "setpoint":
        # What is commanded acts as a load does; a commanded position does not.
        place = "displacement" in (role_of_unit(unit) if unit else "", _word(name.casefold().replace(word, ""))[1])
        if place or low == high:
            return replace(known, remark="set point" if place else "constant")
        return replace(known, role="driver", unit=unit or "1", remark="set point")
    if unit:
        return _by_unit(known, word, role, warm=warm, count=numbers.size)
    return _by_name(known, name, word, role, warm=warm)


def _by_unit(known: Column, word: str, role: str, *, warm: bool, count: int) -> Column:
    """Give a column that states a unit its role: that of the unit, unless its name says otherwise."""
    unit, low, high = known.unit, known.low, known.high
    of_unit = role_of_unit(unit)
    if role in ("temperature", "displacement") and _RATE.fullmatch(unit) and not is_unit(unit):
        return replace(known, remark="a rate")
    if of_unit == "temperature" and low == high and count > logs.HEAD:
        # What a logger writes for a sensor that is not there, and nothing that a drift could follow.
        return replace(known, remark="constant")
    if of_unit == "displacement" and (high - low) * column_conversion(unit, "mm")[0] > _FARTHEST_MM:
        return replace(known, remark=f"moves farther than {_FARTHEST_MM:g} mm: no thermal displacement")
    if of_unit == "driver" and not is_unit(unit) and role != "driver":
        # A factor whose sense is not known stands beside the unit.
        of_rest = role_of_unit(_FACTOR.sub("", unit).strip())
        return replace(known, role=role or ("out" if of_rest == "driver" else of_rest), remark=UNIT_NOT_KNOWN)
    found = find_unit(unit) if of_unit == "driver" and role != "driver" else None
    kind = found.kind if found is not None else ""
    if unit == "deg" and kind and warm:
        # "Grad" and "°" alone may be degrees Celsius.
        return replace(known, role=role or "temperature", remark=UNIT_NOT_KNOWN)
    if kind in ("angle", "time") or unit in ("um/m", "µm/m"):
        return replace(known, remark="a time" if kind == "time" else "no load")
    if role == "displacement" and unit in _OF_SIGNALS:
        return replace(known, remark=UNIT_NOT_KNOWN)
    of_another = (
        (role in ("temperature", "displacement") and unit == "1")
        or (role == "displacement" and of_unit == "driver" and '"' in known.heading)
        or (role == "temperature" and of_unit == "displacement" and (len(word) > 2 or unit in ("m", "in")))
    )
    if of_another:
        return replace(known, role=role, remark=UNIT_NOT_KNOWN)
    # Of a logger "Last" is the last reading, and no load.
    taken = role == "out" or (role == "driver" and of_unit == "displacement" and word != "last")
    return replace(known, role=role if taken and of_unit != "temperature" else of_unit)


def _by_name(known: Column, name: str, word: str, role: str, *, warm: bool) -> Column:
    """Give a column without a unit the role of its name, else of its values, and the unit that is usual there."""
    low, high = known.low, known.high
    if role == "out":
        return known
    if role in ("temperature", "displacement") and any(map(has_unit, re.findall(r"[\[(]([^\])]*)", name))):
        return replace(known, role=role, unit=name, remark=UNIT_NOT_KNOWN)
    if low == high:
        return replace(known, remark="constant")
    if role == "driver":
        return replace(known, role=role, unit=_UNIT_OF_WORD.get(word, "1"))
    if role == "temperature" or (role == "" and warm and _says_nothing(name)):
        unit, remark = _usual_unit("temperature", known)
        return replace(known, role="temperature", unit=unit, remark=remark if role else _BY_VALUES)
    if role == "displacement" or (role == "" and max(abs(low), abs(high)) < 1e-3):
        unit, remark = _usual_unit("displacement", known)
        return replace(known, role="displacement", unit=unit, remark=remark)
    # A balance and a voltage have the numbers of a temperature too.
    return replace(known, remark=_BY_VALUES if role == "" and warm else _NOT_KNOWN)


def _says_nothing(name: str) -> bool:
    """Whether a name is a number, or only calls a column a channel."""
    return _SAYING_NOTHING.issuperset(re.findall(r"[^\W\d_]+", name.casefold()))


def _word(name: str) -> tuple[str, str]:
    """Return the word of a name that tells its role, and the role; empty where none does."""
    words = re.findall(r"[^\W\d_]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name.rpartition(":")[2]).casefold())
    if words and _COUNTING.issuperset(words):
        return words[0], "out"
    for role, known in _WORDS:
        found = next((word for word in words if word in known), "")
        if found:
            return found, role
    # Lagertemperatur, airtemp, 主軸温度.
    endings = ((end, role) for role, known in _WORDS for end in known if len(end) >= _SHORTEST_ENDING or end > "\u2e80")
    return next(((end, role) for end, role in endings if any(word.endswith(end) for word in words)), ("", ""))


def _usual_unit(role: str, column: Column) -> tuple[str, str]:
    """Return the unit in which the numbers of a column are usual ones of a role, and what is to be known of it."""
    span = column.high - column.low
    if role == "temperature":
        # Kelvins of a machine are above what its degrees Celsius reach.
        return ("K" if column.low > 250.0 and column.high < 450.0 else "degC"), _UNIT_BY_VALUES
    if role != "displacement":
        return ("1" if role == "driver" else ""), ""
    # Thermal displacements are micrometres to tenths of millimetres.
    unit = "um" if span >= 2.0 else "mm" if span >= 2e-3 else "m"
    whole = column.low.is_integer() and column.high.is_integer()
    return unit, _COUNTS if whole else _UNIT_BY_VALUES


def _is_unit_of(role: str, unit: str) -> bool:
    """Whether a column of a role may be in a unit."""
    if role == "time":
        return unit in TIME_UNITS
    return role in ("driver", "out") or role_of_unit(unit) == role


def _is_mark(mark: float, numbers: np.ndarray) -> bool:
    """Whether a number is a mark for no reading: far outside all others, or the only one of its column."""
    others = numbers[~np.isin(numbers, _MARKS)]
    if others.size == 0 or mark not in numbers:
        return mark in numbers
    far = _FAR + float(np.ptp(others))
    return mark < float(others.min()) - far or mark > float(others.max()) + far


def _power_on(numbers: np.ndarray) -> float:
    """Return the number of a DS18B20 without a conversion where each stands far from the readings before and after it; 0 without one."""
    for mark in _POWER_ON:
        readings = numbers[~np.isin(numbers, _MARKS)]
        at = np.flatnonzero(readings == mark)
        others = readings[readings != mark]
        if at.size and others.size > 1:
            following = at - np.arange(at.size)
            beside = [others[np.clip(following + step, 0, others.size - 1)] for step in (-1, 0)]
            least = _POWER_ON_JUMP + 20.0 * float(np.median(np.abs(np.diff(others))))
            if np.min(np.abs(np.array(beside) - mark)) > least:
                return mark
    return 0.0


def _first(series: pd.Series) -> tuple[str, ...]:
    return tuple(_plain(value) for value in series.iloc[:3])


def _plain(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)[:24]
