"""Tables with one reading per line: cycle, direction, position, deviation and time in columns of any order and language."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from interferometry.io.dates import DateOrder, parse_time
from interferometry.io.delimited import Grid, shown
from interferometry.io.faults import BadReading, LaserFormatError, RejectedLine
from interferometry.io.headings import UNITS, Heading, find_direction, find_unit, read_heading
from interferometry.io.numerals import Numerals
from interferometry.io.readings import FINE, Kind, Reading, Readings, number_targets, turn_by_travel

_ROLES = ("cycle", "run", "direction", "target", "position", "measured", "deviation", "date", "time")
#: A number with a word before it, such as "Cycle 1" or "P3".
_NAMED_NUMBER = re.compile(r"[^\W\d_]+[\s.]*(\d+)")
_NOT_FROM_ONE = "is not a whole number from 1"


@dataclass(frozen=True)
class LongTable:
    """A table with one reading per line whose header was understood.

    Attributes
    ----------
    grid : Grid
    line : int
        Of the header.
    columns : dict of str to int
        Index of the column of each role.
    units : dict of str to str
        Unit of ``position`` and of ``deviation`` or ``measured``; key of `headings.UNITS`.
    width : int
        Number of columns.
    rows : list of (int, list of str)
        Those below the header.
    ignored : list of str
        Headings that name nothing known.
    """

    grid: Grid
    line: int
    columns: dict[str, int]
    units: dict[str, str]
    width: int
    rows: list[tuple[int, list[str]]]
    ignored: list[str]


def find_long_table(grid: Grid) -> LongTable | None:
    """Return the table of a grid whose header names at least cycle or run, direction, position and deviation; None without one.

    Parameters
    ----------
    grid : Grid

    Raises
    ------
    LaserFormatError
        A column occurs twice, or position or deviation has no unit.
    """
    for at, (line, fields) in enumerate(grid.rows):
        headings = [read_heading(text) for text in fields]
        roles = {heading.role for heading in headings}
        if (
            "position" in roles
            and "direction" in roles
            and roles & {"cycle", "run"}
            and roles & {"deviation", "measured"}
        ):
            return _understand(grid, at, line, headings)
    return None


def what_is_missing(grid: Grid) -> str:
    """Return, in words, what the line that looks most like a header has and what it lacks.

    Parameters
    ----------
    grid : Grid
    """

    def named(fields: Sequence[str]) -> list[str]:
        roles = [read_heading(text).role for text in fields]
        return [role for role in _ROLES if role in roles]

    line, fields = max(grid.rows, key=lambda row: len(named(row[1])))
    found = named(fields)
    needed = {
        "a cycle": {"cycle", "run"},
        "a direction": {"direction"},
        "a position": {"position"},
        "a deviation": {"deviation", "measured"},
    }
    lacking = [name for name, roles in needed.items() if not roles & set(found)]
    if not found:
        return f"line {line} is {shown(fields)}"
    return (
        f"line {line} has columns of {', '.join(found)}, but no column of {', '.join(lacking)}: it is {shown(fields)}"
    )


def _understand(grid: Grid, at: int, line: int, headings: list[Heading]) -> LongTable:
    columns: dict[str, int] = {}
    for index, heading in enumerate(headings):
        if heading.role not in _ROLES:
            continue
        if heading.role in columns:
            first = headings[columns[heading.role]].text
            same = f"column {heading.text} occurs more than once"
            both = f"the columns {first!r} and {heading.text!r} both name the {heading.role}"
            raise LaserFormatError(f"{grid.place}, line {line}: {same if first == heading.text else both}; keep one")
        columns[heading.role] = index
    if "deviation" in columns:
        columns.pop("measured", None)
    rows = grid.rows[at + 1 :]
    units = {
        role: heading.unit for heading in headings if (role := heading.role) in ("position", "measured", "deviation")
    }
    if rows and None in units.values() and _is_row_of_units(rows[0][1]):
        units = {role: unit or find_unit(_cell(rows[0][1], columns.get(role))) for role, unit in units.items()}
        rows = rows[1:]
    for role in ("position", "deviation" if "deviation" in columns else "measured"):
        if units[role] is None:
            text = headings[columns[role]].text
            raise LaserFormatError(
                f"{grid.place}, line {line}: the column {text!r} has no unit; write it in the heading, for example "
                f'"{text} [{"um" if role == "deviation" else "mm"}]"'
            )
    rows = _with_signs(rows, columns["direction"])
    ignored = [heading.text for i, heading in enumerate(headings) if heading.text and i not in columns.values()]
    width = max(i for i, heading in enumerate(headings) if heading.text) + 1
    return LongTable(grid, line, columns, {role: unit for role, unit in units.items() if unit}, width, rows, ignored)


def _with_signs(rows: list[tuple[int, list[str]]], column: int) -> list[tuple[int, list[str]]]:
    """Return rows in which the direction "1" is "+1" where others are "-1": a 1 beside a 2 would only number them."""
    if not any(row[column : column + 1] == ["-1"] for _, row in rows):
        return rows
    return [
        (line, [*row[:column], "+1", *row[column + 1 :]] if row[column : column + 1] == ["1"] else row)
        for line, row in rows
    ]


def _is_row_of_units(fields: list[str]) -> bool:
    texts = [text.strip("[]() ") for text in fields if text]
    return bool(texts) and all(find_unit(text) is not None for text in texts)


def _cell(fields: Sequence[str], index: int | None) -> str:
    return fields[index].strip("[]() ") if index is not None and index < len(fields) else ""


@dataclass(frozen=True)
class _Label:
    """Where a line belongs, with numbers as they stand in the file."""

    line: int
    fields: list[str]
    number: int
    direction: str
    signed: bool
    target: int
    position: float


def read_long_table(table: LongTable) -> Readings:
    """Read the lines of a table.

    Parameters
    ----------
    table : LongTable

    Returns
    -------
    Readings

    Raises
    ------
    LaserFormatError
        Position and deviation have units of different kinds, or the order of day and month is not settled.
    """
    path, numerals = table.grid.path, table.grid.numerals
    given = Readings(path, _kind(table), ignored=table.ignored)
    labels: list[_Label] = []
    for line, fields in table.rows:
        try:
            labels.append(_label(table, line, fields, numerals))
        except BadReading as fault:
            given.left_out.append(RejectedLine(path.name, line, fault.value, fault.reason))
    labels = _renumber(table, labels, given)
    order = DateOrder.of(path, [(label.line, _time_text(table, label.fields)) for label in labels])
    for label in labels:
        try:
            time, zone = _time(table, label.fields, order)
            deviation = _deviation(table, label, numerals)
        except BadReading as fault:
            given.left_out.append(RejectedLine(path.name, label.line, fault.value, fault.reason))
            given.unreadable.add((label.number, label.direction, label.target))
            continue
        if zone is not None:
            given.zones.setdefault(zone, label.line)
        given.readings.append(
            Reading(label.line, label.number, label.direction, label.target, label.position, time, deviation)
        )
    given.left_out.sort(key=lambda each: each.line)
    if not all(label.signed for label in labels):
        turn_by_travel(given)
    return given


def _kind(table: LongTable) -> Kind:
    """Return whether the axis is linear or rotary."""
    kinds = {role: UNITS[unit].kind for role, unit in table.units.items()}
    if len(set(kinds.values())) > 1 or not set(kinds.values()) <= {"length", "angle"}:
        given = ", ".join(f"{role} in {table.units[role]}" for role in kinds)
        raise LaserFormatError(
            f"{table.grid.place}, line {table.line}: {given}; give both as lengths (linear axis) or both as angles (rotary axis)"
        )
    return "angle" if "angle" in kinds.values() else "length"


def _label(table: LongTable, line: int, fields: list[str], numerals: Numerals) -> _Label:
    columns = table.columns
    if len(fields) <= max(columns.values()) or any(fields[table.width :]):
        raise BadReading("", f"does not have {table.width} fields")
    direction = find_direction(fields[columns["direction"]])
    if direction is None:
        raise BadReading(fields[columns["direction"]], "is neither 'positive' nor 'negative'")
    number = _count(fields[columns["cycle" if "cycle" in columns else "run"]], numerals)
    target = _count(fields[columns["target"]], numerals) if "target" in columns else 0
    position = numerals.reading(fields[columns["position"]]) * UNITS[table.units["position"]].factor
    return _Label(line, fields, number, *direction, target, position)


def _count(text: str, numerals: Numerals) -> int:
    """Return a whole number from 0, which stands for the first where a file counts from 0."""
    named = _NAMED_NUMBER.fullmatch(text)
    value = numerals.number(named[1] if named else text)
    if value != int(value) or value < 0:
        raise BadReading(text, _NOT_FROM_ONE)
    return int(value)


def _renumber(table: LongTable, labels: list[_Label], given: Readings) -> list[_Label]:
    """Return the labels with cycles and targets numbered from 1."""
    if "cycle" not in table.columns:
        labels = _cycles_of_runs(labels)
    numbers = _from_one([label.number for label in labels], "cycles", given.notes)
    if "target" in table.columns:
        targets = _from_one([label.target for label in labels], "targets", given.notes)
    else:
        targets = number_targets([label.position for label in labels])
    kept = []
    for label, number, target in zip(labels, numbers, targets, strict=True):
        if number and target:
            kept.append(replace(label, number=number, target=target))
        else:
            given.left_out.append(RejectedLine(given.path.name, label.line, "0", _NOT_FROM_ONE))
    return kept


def _from_one(numbers: list[int], name: str, notes: list[str]) -> list[int]:
    """Return numbers from 1; where 0 occurs about as often as 1, the file counts from 0."""
    counted = Counter(numbers)
    if 2 * counted[0] < counted[1] or not counted[0]:
        return numbers
    notes.append(f"the file numbers its {name} from 0: 1 was added")
    return [number + 1 for number in numbers]


def _cycles_of_runs(labels: list[_Label]) -> list[_Label]:
    """Return labels with cycles for runs: a run of both directions is a cycle; else the runs of each direction are counted."""
    directions: dict[int, set[str]] = defaultdict(set)
    for label in labels:
        directions[label.number].add(label.direction)
    if any(len(both) == 2 for both in directions.values()):
        return labels
    cycle = {
        run: 1 + sum(directions[earlier] == directions[run] for earlier in directions if earlier < run)
        for run in directions
    }
    return [replace(label, number=cycle[label.number]) for label in labels]


def _time_text(table: LongTable, fields: list[str]) -> str:
    """Return date and time of a line as one text; "" where the table has no times."""
    time = fields[table.columns["time"]] if "time" in table.columns else ""
    if "date" not in table.columns:
        return time
    # A spreadsheet gives a date as midnight, and a time of day as one of its first day.
    return f"{fields[table.columns['date']].split('T')[0]} {time.split('T')[-1]}"


def _time(table: LongTable, fields: list[str], order: DateOrder) -> tuple[np.datetime64, str | None]:
    if "time" not in table.columns:
        return np.datetime64("NaT", "ns"), None
    return parse_time(_time_text(table, fields), order)


def _deviation(table: LongTable, label: _Label, numerals: Numerals) -> float:
    """Return the deviation of a line in um or arcsec."""
    role = "deviation" if "deviation" in table.columns else "measured"
    unit = UNITS[table.units[role]]
    value = numerals.reading(label.fields[table.columns[role]]) * unit.factor
    if role == "measured":
        value -= label.position
    # Rounded to a thousandth of a nanometre: the factors of the units have no exact binary value.
    return round(value * FINE[unit.kind], 6)
