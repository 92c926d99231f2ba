"""Single readings of a test: what a table gives, the checks that hold for every table, and the Dataset of all."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from interferometry.common import ENVIRONMENT_ATTRIBUTES
from interferometry.deviations import (
    DIRECTIONS,
    DUPLICATE,
    OUT_OF_ORDER,
    UNREADABLE,
    Flag,
    build_deviations,
    detect_out_of_order,
    set_flag,
)
from interferometry.io.faults import BadReading, LaserFormatError, LeftOut, Numerals, raise_if_mostly_invalid
from interferometry.io.renishaw import START_BYTES, is_ecmc_log, read_ecmc_log, read_rtl
from interferometry.io.tables import (
    UNIT_WORDS,
    UNITS,
    DateOrder,
    DelimitedTable,
    Grid,
    Heading,
    describe_time_zone,
    find_direction,
    find_unit,
    fold,
    parse_time,
    read_grids,
    read_heading,
    read_timed_rows,
    shown,
    split_unit,
    table_below,
)

#: Positions closer than this are one, mm or deg.
POSITION_TOLERANCE = 1e-4
#: From mm to um, and from deg to arcsec.
FINE = {"length": 1e3, "angle": 3600.0}
Kind = Literal["length", "angle"]
Cell = tuple[int, str, int]


@dataclass(frozen=True)
class Reading:
    """One reading: its line (from 1), cycle (from 1), direction ("positive", "negative") and target (from 1).

    ``position`` in mm or deg, ``time`` in UTC or NaT, ``deviation`` (actual minus target) in um or arcsec.
    """

    line: int
    cycle: int
    direction: str
    target: int
    position: float
    time: np.datetime64
    deviation: float

    @property
    def cell(self) -> Cell:
        """Cycle, direction and target."""
        return self.cycle, self.direction, self.target


@dataclass
class Readings:
    """What a table gives, before it is checked: readings, lines left out, first line with each time zone (none of a file without times),
    cells with a line that cannot be used, columns not read, and what the reader assumed, in sentences.
    """

    path: Path
    kind: Kind = "length"
    readings: list[Reading] = field(default_factory=list)
    zones: dict[str, int] = field(default_factory=dict)
    unreadable: set[Cell] = field(default_factory=set)
    ignored: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left_out = LeftOut(self.path)

    @contextmanager
    def collect(self, line: int, cell: Cell) -> Iterator[None]:
        """Leave a line out and mark its cell where its reading raises `BadReading`."""
        before = len(self.left_out.lines)
        with self.left_out.collect(line):
            yield
        if len(self.left_out.lines) > before:
            self.unreadable.add(cell)


def check_and_assemble(given: Readings) -> xr.Dataset:
    """Check the readings of a table and lay them out by cycle, direction and target."""
    path, left_out = given.path, given.left_out
    raise_if_mostly_invalid(path, len(given.readings), left_out.lines)
    readings, duplicates = _drop_duplicates(given.readings, left_out)
    readings = _drop_misplaced(readings, left_out, "mm" if given.kind == "length" else "deg")
    time = {"origin": "none", "reference": "the file holds no times"}
    if given.zones:
        readings = _drop_wrong_times(readings, left_out)
        _check_cycles(path, readings)
        given.notes += _note_of_minutes(readings)
        time = {"origin": "recorded", "reference": describe_time_zone(path, given.zones)}
    deviations = _assemble(readings)
    deviations = _flag_cells(deviations, UNREADABLE, given.unreadable)
    deviations = _flag_cells(deviations, DUPLICATE, duplicates)
    if given.zones:
        deviations = set_flag(deviations, OUT_OF_ORDER, detect_out_of_order(deviations))
    deviations["time"].attrs.update(time)
    if given.kind == "angle":
        deviations["deviation"].attrs["units"] = "arcsec"
        deviations["position"].attrs["units"] = "deg"
    left_out.note_in(deviations)
    deviations.attrs.update(columns_ignored=json.dumps(given.ignored), notes=json.dumps(given.notes))
    return deviations


def turn_by_travel(given: Readings) -> None:
    """Exchange the directions where "forward" runs led to smaller positions; without times they are taken as positive."""
    passes: dict[tuple[int, str], list[Reading]] = defaultdict(list)
    for reading in given.readings:
        passes[reading.cycle, reading.direction].append(reading)
    votes = 0
    for (_, direction), group in passes.items():
        if len(group) < 2 or any(np.isnat(reading.time) for reading in group):
            continue
        group.sort(key=lambda reading: reading.time)
        travel = group[-1].position - group[0].position
        votes += int(np.sign(travel)) * (1 if direction == DIRECTIONS[0] else -1)
    if votes < 0:
        other = dict(zip(DIRECTIONS, DIRECTIONS[::-1], strict=True))
        given.readings = [replace(reading, direction=other[reading.direction]) for reading in given.readings]
        given.unreadable = {(cycle, other[direction], target) for cycle, direction, target in given.unreadable}
        given.notes.append("the forward runs lead to smaller positions: they are the negative direction")
    elif votes == 0:
        given.notes.append("forward was taken as the positive direction: the file gives no times that tell the travel")


def number_targets(positions: Sequence[float]) -> list[int]:
    """Return the number of the target at each position, from 1 at the smallest."""
    values, inverse = np.unique(np.asarray(positions, dtype="f8"), return_inverse=True)
    group = np.concatenate([[0], np.cumsum(np.diff(values) > POSITION_TOLERANCE)])
    return (group[inverse] + 1).tolist()


def _drop_duplicates(readings: list[Reading], left_out: LeftOut) -> tuple[list[Reading], set[Cell]]:
    first: dict[Cell, Reading] = {}
    repeated: set[Cell] = set()
    for reading in readings:
        if reading.cell in first:
            repeated.add(reading.cell)
            reason = (
                f"cycle {reading.cycle} {reading.direction} target {reading.target} already occurs on line "
                f"{first[reading.cell].line}, which is kept"
            )
            left_out.add(reading.line, str(reading.deviation), reason)
        else:
            first[reading.cell] = reading
    return list(first.values()), repeated


def _drop_misplaced(readings: list[Reading], left_out: LeftOut, unit: str) -> list[Reading]:
    """Leave out readings whose position is not the one that 90 % of their target's readings have."""
    by_target: dict[int, list[Reading]] = defaultdict(list)
    for reading in readings:
        by_target[reading.target].append(reading)
    kept: list[Reading] = []
    positions: dict[int, float] = {}
    for target, group in sorted(by_target.items()):
        typical = positions[target] = float(np.median([reading.position for reading in group]))
        off = [reading for reading in group if abs(reading.position - typical) > POSITION_TOLERANCE]
        if len(off) > max(1, 0.1 * len(group)):
            raise LaserFormatError(
                f"{left_out.path}: target {target} is at {off[0].position} {unit} on line {off[0].line} but at {typical} {unit} "
                f"elsewhere ({len(off)} of {len(group)} readings disagree); the position is the programmed one, the same in every cycle: "
                "correct it"
            )
        for reading in off:
            left_out.add(reading.line, str(reading.position), f"target {target} is at {typical} {unit} elsewhere")
        kept += [reading for reading in group if reading not in off]
    for first, second in itertools.pairwise(sorted(positions, key=positions.__getitem__)):
        if abs(positions[first] - positions[second]) <= POSITION_TOLERANCE:
            raise LaserFormatError(
                f"{left_out.path}: targets {first} and {second} are both at {positions[first]} {unit}; number each position once"
            )
    return kept


def _drop_wrong_times(readings: list[Reading], left_out: LeftOut) -> list[Reading]:
    """Leave out single readings whose time lies beyond the middle of the neighbouring cycles."""
    times: dict[int, list[int]] = defaultdict(list)
    for reading in readings:
        times[reading.cycle].append(int(reading.time.astype("i8")))
    numbers = sorted(times)
    middles = [float(np.median(times[number])) for number in numbers]
    steps = np.diff(middles)
    if not steps.size or np.any(steps <= 0):
        return readings
    typical = float(np.median(steps))
    middles = [middles[0] - typical, *middles, middles[-1] + typical]
    bounds = dict(zip(numbers, zip(middles, middles[2:], strict=False), strict=True))
    kept = []
    for reading in readings:
        early, late = bounds[reading.cycle]
        if early <= reading.time.astype("i8") <= late:
            kept.append(reading)
        else:
            left_out.add(reading.line, str(reading.time), f"is not a time within cycle {reading.cycle}")
    return kept


def _note_of_minutes(readings: list[Reading]) -> list[str]:
    """Tell that the times have no seconds, so that several readings seem to be taken at one instant."""
    times = np.array([reading.time for reading in readings])
    shared = len(times) - len(np.unique(times))
    if not shared or np.any(times != times.astype("datetime64[m]")):
        return []
    return [
        f"warning: the times have no seconds, and {shared} readings share theirs with others: export them with seconds"
    ]


def _check_cycles(path: Path, readings: list[Reading]) -> None:
    """Raise where cycles run backwards or overlap in time."""
    cycles: dict[int, list[Reading]] = defaultdict(list)
    for reading in readings:
        cycles[reading.cycle].append(reading)
    for before, after in itertools.pairwise(sorted(cycles)):
        last = max(cycles[before], key=lambda reading: reading.time)
        first = min(cycles[after], key=lambda reading: reading.time)
        if first.time <= last.time:
            raise LaserFormatError(
                f"{path}: cycle {after} begins at {first.time} (line {first.line}) before cycle {before} ends at {last.time} "
                f"(line {last.line}); cycles must follow each other in time: correct the cycle numbers or the clock"
            )


def _assemble(readings: Sequence[Reading]) -> xr.Dataset:
    cycles = sorted({reading.cycle for reading in readings})
    position = {reading.target: reading.position for reading in readings}
    targets = sorted(position)
    row = {cycle: i for i, cycle in enumerate(cycles)}
    column = {target: i for i, target in enumerate(targets)}
    deviation = np.full((len(cycles), 2, len(targets)), np.nan)
    time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    for reading in readings:
        index = row[reading.cycle], DIRECTIONS.index(reading.direction), column[reading.target]
        deviation[index], time[index] = reading.deviation, reading.time
    return build_deviations(cycles, targets, np.array([position[target] for target in targets]), deviation, time)


def _flag_cells(deviations: xr.Dataset, flag: Flag, cells: set[Cell]) -> xr.Dataset:
    where = np.zeros(deviations["deviation"].shape, dtype=bool)
    cycles, targets = deviations["cycle"].values.tolist(), deviations["target"].values.tolist()
    for cycle, direction, target in cells:
        if cycle in cycles and target in targets:
            where[cycles.index(cycle), DIRECTIONS.index(direction), targets.index(target)] = True
    return set_flag(deviations, flag, where)


# Tables with one reading per line: cycle, direction, position, deviation and time in columns of any order and
# language.

_ROLES = ("cycle", "run", "direction", "target", "position", "measured", "deviation", "date", "time")
#: A number with a word before it, such as "Cycle 1" or "P3".
_NAMED_NUMBER = re.compile(r"[^\W\d_]+[\s.]*(\d+)")
_NOT_FROM_ONE = "is not a whole number from 1"


@dataclass(frozen=True)
class LongTable:
    """A table with one reading per line whose header, on a line, was understood: column of each role, unit of positions and deviations
    (keys of `UNITS`), and headings that name nothing known.
    """

    grid: Grid
    line: int
    columns: dict[str, int]
    units: dict[str, str]
    width: int
    rows: list[tuple[int, list[str]]]
    ignored: list[str]


def find_long_table(grid: Grid) -> LongTable | None:
    """Return the table of a grid whose header names at least cycle or run, direction, position and deviation; None without one."""
    for at, (line, fields) in enumerate(grid.rows):
        headings = [read_heading(text) for text in fields]
        roles = {heading.role for heading in headings}
        if {"position", "direction"} <= roles and roles & {"cycle", "run"} and roles & {"deviation", "measured"}:
            return _understand(grid, at, line, headings)
    return None


def what_is_missing(grid: Grid) -> str:
    """Return, in words, what the line that looks most like a header has and what it lacks."""

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
    """Read the lines of a table."""
    path, numerals, columns = table.grid.path, table.grid.numerals, table.columns
    stated = ", ".join(f"{role} in {unit}" for role, unit in table.units.items())
    kind = _kind_of(table.units.values(), f"{table.grid.place}, line {table.line}: {stated}")
    given = Readings(path, kind, ignored=table.ignored)
    role = "deviation" if "deviation" in columns else "measured"
    unit = UNITS[table.units[role]]
    labels: list[_Label] = []
    for line, fields in table.rows:
        with given.left_out.collect(line):
            labels.append(_label(table, line, fields, numerals))
    labels = _renumber(table, labels, given)
    order = DateOrder.of(path, [(label.line, _time_text(table, label.fields)) for label in labels])
    for label in labels:
        cell = label.number, label.direction, label.target
        with given.collect(label.line, cell):
            time: np.datetime64 = np.datetime64("NaT", "ns")
            zone = None
            if "time" in columns:
                time, zone = parse_time(_time_text(table, label.fields), order)
            value = numerals.reading(label.fields[columns[role]]) * unit.factor
            if role == "measured":
                value -= label.position
            if zone is not None:
                given.zones.setdefault(zone, label.line)
            # Rounded to a thousandth of a nanometre: the factors of the units have no exact binary value.
            deviation = round(value * FINE[unit.kind], 6)
            given.readings.append(Reading(label.line, *cell, label.position, time, deviation))
    given.left_out.lines.sort(key=lambda each: each.line)
    if not all(label.signed for label in labels):
        turn_by_travel(given)
    return given


def _kind_of(units: Iterable[str], given: str) -> Kind:
    """Return whether the units are those of a linear or of a rotary axis."""
    kinds = {UNITS[unit].kind for unit in units}
    if kinds == {"angle"}:
        return "angle"
    if kinds == {"length"}:
        return "length"
    raise LaserFormatError(f"{given}; give both as lengths (linear axis) or both as angles (rotary axis)")


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
            given.left_out.add(label.line, "0", _NOT_FROM_ONE)
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


# Tables of position by run: one row per target and one column per run, or one row per run and one column per target.

#: Rows above and below the one that names the positions, in which directions and numbers of runs may stand.
_ROWS_ABOVE, _ROWS_BELOW = 2, 3
#: Fewest targets and runs by which a table is recognised.
_FEWEST_TARGETS = 2
#: More than any table of positions by run has; rows are given the width of the widest one, which must not fill the memory.
_MOST_CELLS = 5_000_000


@dataclass(frozen=True)
class Run:
    """A column (or row) of deviations: its headings joined, number of the run or cycle, whether the word for the direction names the sign
    of the travel, unit (a key of `UNITS`), and line and text of each reading in the order of the positions.
    """

    text: str
    number: int | None
    direction: str
    signed: bool
    unit: str | None
    values: list[tuple[int, str]]


@dataclass
class WideTable:
    """A table of position by run whose headings were understood: line of the row that names the positions, line and text of each position,
    units (keys of `UNITS`), runs, and headings of columns that are none.
    """

    grid: Grid
    line: int
    positions: list[tuple[int, str]]
    position_unit: str | None
    deviation_unit: str | None
    runs: list[Run]
    ignored: list[str] = field(default_factory=list)


def find_wide_table(grid: Grid) -> WideTable | None:
    """Return the table of position by run in a grid, None without one."""
    width = max(len(fields) for _, fields in grid.rows)
    if width * len(grid.rows) > _MOST_CELLS:
        return None
    cells = [[*fields, *[""] * (width - len(fields))] for _, fields in grid.rows]
    lines = [line for line, _ in grid.rows]
    for at, row in enumerate(cells):
        headings = [read_heading(text) for text in row]
        # Without a column of positions, that of the targets gives them: "Target" is the usual word for both.
        name = "position" if any(heading.role == "position" for heading in headings) else "target"
        for column, heading in enumerate(headings):
            if heading.role == name:
                found = _positions_below(grid, cells, lines, at, column, heading)
                if found is not None:
                    return found
        found = _positions_in_one_row(grid, cells, lines, at)
        if found is not None:
            return found
    return None


def _is_number(text: str, numerals: Numerals) -> bool:
    try:
        numerals.number(text)
    except BadReading:
        return False
    return True


def _positions_below(
    grid: Grid, cells: list[list[str]], lines: list[int], at: int, column: int, heading: Heading
) -> WideTable | None:
    """Return the table whose positions stand below their heading, with one run per column to the right."""
    near = range(at + 1, min(at + 1 + _ROWS_BELOW, len(cells)))
    first = next((i for i in near if _is_number(cells[i][column], grid.numerals)), len(cells))
    data = [i for i in range(first, len(cells)) if _is_number(cells[i][column], grid.numerals)]
    if len(data) < _FEWEST_TARGETS:
        return None
    if heading.role == "target" and [cells[i][column] for i in data] == [str(k + 1) for k in range(len(data))]:
        return None
    above = [i for i in range(max(0, at - _ROWS_ABOVE), at) if _names_runs(cells[i][column + 1 :])]
    block = [cells[i] for i in (*above, *range(at, first))]
    if len(block) > 1:
        block = [_fill(row, column + 1) for row in block]
    candidates = [
        ([row[j] for row in block if row[j]], [(lines[i], cells[i][j]) for i in data], f"column {j + 1}")
        for j in range(column + 1, len(cells[at]))
    ]
    runs, ignored = _read_runs([one for one in candidates if one[0] or any(text for _, text in one[1])])
    titles = [text for row in cells[:first] for text in row]
    unit = heading.unit or find_unit(cells[first - 1][column].strip("[]() "))
    positions = [(lines[i], cells[i][column]) for i in data]
    return WideTable(grid, lines[at], positions, unit, _deviation_unit(titles), runs, ignored) if runs else None


def _positions_in_one_row(grid: Grid, cells: list[list[str]], lines: list[int], at: int) -> WideTable | None:
    """Return the table whose positions stand in one row, with one run per row below and its labels before the numbers."""
    row = cells[at]
    labels = [
        j for j, text in enumerate(row) if read_heading(text.split("\\")[0]).role in ("run", "cycle", "direction")
    ]
    if not labels:
        return None
    after = max(labels) + 1
    split = [split_unit(text) for text in row]
    places = [j for j in range(after, len(row)) if _is_number(split[j][0], grid.numerals)]
    if len(places) < _FEWEST_TARGETS:
        return None
    runs, ignored = _read_runs(
        ([cells[i][j] for j in labels if cells[i][j]], [(lines[i], cells[i][j]) for j in places], f"line {lines[i]}")
        for i in range(at + 1, len(cells))
        if any(cells[i])
    )
    ignored = [row[j] for j in range(after, len(row)) if row[j] and j not in places] + ignored
    titles = [text for fields in cells[: at + 1] for text in fields]
    unit = next((split[j][1] for j in places if split[j][1]), None) or _position_unit(titles)
    positions = [(lines[at], split[j][0]) for j in places]
    return WideTable(grid, lines[at], positions, unit, _deviation_unit(titles), runs, ignored) if runs else None


def _fill(row: Sequence[str], start: int) -> list[str]:
    """Return a row of headings in which every blank takes the text before it, as merged cells leave it in a file of text."""
    filled = list(row)
    for j in range(start + 1, len(filled)):
        filled[j] = filled[j] or filled[j - 1]
    return filled


def _names_runs(texts: Sequence[str]) -> bool:
    """Return whether a row names directions or numbers of runs, so that it belongs to the headings and not to the title."""
    named = [text for text in texts if text]
    return len(set(named)) > 1 and all(_wide_label(text) is not None for text in named)


def _wide_label(text: str) -> tuple[int | None, tuple[str, bool] | None, str | None] | None:
    """Return number, direction and unit that a heading of a run holds; None where it holds anything else."""
    name, unit = split_unit(text)
    if unit is None and find_unit(text.strip("[]() ")) is not None:
        return None, None, find_unit(text.strip("[]() "))
    numbers = set(re.findall(r"\d+", name))
    if len(numbers) > 1:
        return None
    rest = re.sub(r"\d+", " ", name).replace("第", " ").replace("次", " ").replace("#", " ").strip()
    direction: tuple[str, bool] | None = None
    for word in re.findall(r"[+\-−–↑↓]|[^\s+\-−–↑↓,;:/().\[\]]+", rest):
        found = find_direction(word)
        if found is not None and direction in (None, found):
            direction = found
        elif not (read_heading(word).role in ("run", "cycle", "deviation", "direction") or fold(word) in ("no", "nr")):
            return None
    return (int(next(iter(numbers))) if numbers else None), direction, unit


def _read_run(texts: list[str], values: list[tuple[int, str]]) -> Run | None:
    """Return a run from its headings; None where they hold anything but number, direction and unit, as "mean +" does."""
    labels = [_wide_label(text) for text in texts]
    if not texts or None in labels or not any(text for _, text in values):
        return None
    found = [label for label in labels if label is not None]
    directions = {label[1] for label in found if label[1] is not None}
    numbers = {label[0] for label in found if label[0] is not None}
    if len(directions) != 1 or len(numbers) > 1:
        return None
    direction, signed = next(iter(directions))
    unit = next((label[2] for label in found if label[2] is not None), None)
    return Run(" ".join(texts), next(iter(numbers), None), direction, signed, unit, values)


def _read_runs(candidates: Iterable[tuple[list[str], list[tuple[int, str]], str]]) -> tuple[list[Run], list[str]]:
    """Return the runs among columns or rows of headings and values, and what the others are called, by their headings or their place."""
    runs: list[Run] = []
    ignored: list[str] = []
    for texts, values, place in candidates:
        run = _read_run(texts, values)
        if run is None:
            ignored.append(" ".join(texts) or place)
        else:
            runs.append(run)
    return runs, ignored


def _deviation_unit(titles: Sequence[str]) -> str | None:
    """Return the unit that a title such as "Deviations [µm]" or "Unit: µm" gives."""
    for i, text in enumerate(titles):
        name, unit = split_unit(re.sub(r"\s*[:=]\s*", " ", text))
        following = find_unit(titles[i + 1].strip("[]() ")) if i + 1 < len(titles) else None
        if fold(name) in UNIT_WORDS and (unit or following):
            return unit or following
        if unit and any(read_heading(part).role == "deviation" for part in name.split("\\")):
            return unit
    return None


def _position_unit(titles: Sequence[str]) -> str | None:
    r"""Return the unit that a title or corner such as "Run \ Position [mm]" gives."""
    parts = [read_heading(part.strip()) for text in titles for part in text.split("\\")]
    return next((heading.unit for heading in parts if heading.role == "position" and heading.unit), None)


def read_wide_table(table: WideTable) -> Readings:
    """Read the readings of a table of position by run."""
    path, numerals = table.grid.path, table.grid.numerals
    notes: list[str] = []
    kind, position_unit, fine_unit = _wide_units(table, notes)
    given = Readings(path, kind, ignored=table.ignored, notes=notes)
    factor = UNITS[position_unit].factor
    positions = [numerals.number(text) * factor for _, text in table.positions]
    targets = number_targets(positions)
    for run, cycle in zip(table.runs, _cycles(table), strict=True):
        fine = UNITS[run.unit or fine_unit].factor * FINE[kind]
        for (line, text), target, position in zip(run.values, targets, positions, strict=True):
            if not text:
                continue
            cell = cycle, run.direction, target
            with given.collect(line, cell):
                deviation = round(numerals.reading(text) * fine, 6)
                given.readings.append(Reading(line, *cell, position, np.datetime64("NaT", "ns"), deviation))
    if not all(run.signed for run in table.runs):
        turn_by_travel(given)
    return given


def _wide_units(table: WideTable, notes: list[str]) -> tuple[Kind, str, str]:
    """Return the kind of axis, the unit of the positions, and that of runs without one; what no heading states is noted as taken."""
    stated = table.deviation_unit or next((run.unit for run in table.runs if run.unit), None)
    known = table.position_unit or stated
    usual = ("deg", "arcsec") if known and UNITS[known].kind == "angle" else ("mm", "um")
    position, deviation = table.position_unit or usual[0], stated or usual[1]
    for name, unit, taken in (("positions", table.position_unit, position), ("deviations", stated, deviation)):
        if unit is None:
            notes.append(f"warning: no heading states the unit of the {name}: taken as {taken}")
    units = sorted({run.unit or deviation for run in table.runs})
    told = f"positions in {position}, deviations in {', '.join(units)}"
    return _kind_of([*units, position], f"{table.grid.place}, line {table.line}: {told}"), position, deviation


def _cycles(table: WideTable) -> list[int]:
    """Return the cycle of each run: its number, or its place among the runs of its direction."""
    numbers = [run.number for run in table.runs]
    if any(number is None for number in numbers) and any(number is not None for number in numbers):
        unnumbered = next(run.text for run in table.runs if run.number is None)
        raise LaserFormatError(
            f"{table.grid.place}, line {table.line}: {unnumbered!r} has no number, but other runs have; number every run"
        )
    up, down = ({run.number for run in table.runs if run.direction == direction} for direction in DIRECTIONS)
    if None in numbers or (up and down and not up & down):
        counts = {direction: itertools.count(1) for direction in DIRECTIONS}
        return [next(counts[run.direction]) for run in table.runs]
    first = min(number for number in numbers if number is not None)
    return [number + (1 if first == 0 else 0) for number in numbers if number is not None]


# Readers of deviations and environment: the kind of file is recognised, and every unusable line is listed in the
# result.


class Layout(NamedTuple):
    """A layout of deviations: its row in docs/formats.md, what finds it in the first bytes of a file or in a grid, and what reads it.

    A file is read by its path and what was stated of feed (mm/min) and dwell (s), a table by what was found.
    """

    name: str
    find: Callable[[Any], Any]
    read: Callable[..., Any]


#: What `read_deviations` reads, in the order in which a file is held against it: files of laser programs, and tables.
FILES = (
    Layout("Renishaw linear test, .rtl", lambda start: b"HEADER::" in start, read_rtl),
    Layout("logs of the ecmc test tools, .dat", is_ecmc_log, lambda path, feed, dwell: read_ecmc_log(path)),
)
TABLES = (
    Layout("table, one reading per line", find_long_table, read_long_table),
    Layout("table of position by run", find_wide_table, read_wide_table),
)

DEVIATION_COLUMNS = ("cycle", "direction", "target", "position_mm", "time", "deviation_um")

#: Heading of the tables of averages that laser programs write as a report.
_AVERAGES = b"Bidirectional Avg Error"
#: The header of a log stands within so many rows.
_HEADER_WITHIN = 40
#: Heading of a further column of the environment file, ``"name [unit]"``; a name begins with a letter, as a variable of NetCDF does.
_WITH_UNIT = re.compile(r"\s*([^\W\d_][^/\[\]()]{0,99}?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]\s*")
#: Column of the environment file, variable, kind of quantity, smallest and largest plausible value. Below 1 % of humidity lies a
#: fraction of 1, and no workshop.
ENVIRONMENT_COLUMNS = (
    ("air_temperature_degC", "air_temperature", "temperature", -9.0, 60.0),
    ("air_pressure_hPa", "air_pressure", "pressure", 500.0, 1200.0),
    ("relative_humidity_percent", "relative_humidity", "humidity", 1.0, 100.0),
    ("material_temperature_degC", "material_temperature", "temperature", -9.0, 80.0),
)
AIR_AND_MATERIAL = tuple(name for _, name, *_ in ENVIRONMENT_COLUMNS)


def read_deviations(
    path: str | Path,
    *,
    feed_mm_per_min: float | None = None,
    dwell_s: float | None = None,
    sheet: str | None = None,
    rotary: bool = False,
) -> xr.Dataset:
    r"""Read positioning deviations from a file.

    Parameters
    ----------
    path : str or pathlib.Path
        Delimited text or a spreadsheet (.xlsx, .xls, .ods) with one reading per line (columns cycle, direction, target, position_mm,
        time, deviation_um) or with one column or row per run; a Renishaw linear test (.rtl); or a log of the ecmc test tools (.dat).
        The kind of file is recognised from its content; headings may be English, German, French, Spanish or Chinese and carry their
        unit (docs/formats.md).
    feed_mm_per_min : float, optional
        Feed between targets, mm/min.
    dwell_s : float, optional
        Time at rest at each target, s. With both, the times of readings, which a .rtl does not hold, are reconstructed more closely.
        Ignored where every reading has its own time.
    sheet : str, optional
        Name of the sheet of a spreadsheet; None: the only one that holds a table of deviations.
    rotary : bool, optional
        Whether a rotary axis is accepted: its positions are in deg and its deviations in arcsec, as the units of the variables say.

    Returns
    -------
    xarray.Dataset
        Keeps `interferometry.common.DEVIATIONS`: ``deviation`` (um), ``time`` (UTC) and ``quality_flag`` (cycle, direction, target),
        ``position`` (mm; target). ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason),
        ``attrs["notes"]`` one of what the reader assumed;
        ``time.attrs["origin"]`` is "recorded", "reconstructed" or "none"; ``time_u`` is the standard uncertainty of reconstructed
        times, s.

    Raises
    ------
    LaserFormatError
        The file cannot be used as a whole, or it is of a rotary axis and `rotary` is False.
    OSError
        The file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    Notes
    -----
    Quantities as in ISO 230-2:2014, clause 3.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "laser.csv"
    >>> _ = path.write_text("cycle,direction,target,position_mm,time,deviation_um\n"
    ...                     "1,positive,1,0,2026-03-09T06:30:00Z,0.12\n"
    ...                     "1,positive,2,100,2026-03-09T06:30:22Z,1.48\n")
    >>> test = read_deviations(path)
    >>> test["deviation"].sel(direction="positive").values.tolist()
    [[0.12, 1.48]]
    """
    path = Path(path)
    start = _start_of(path)
    if (program := _of_a_program(start)) is not None:
        return program.read(path, feed_mm_per_min, dwell_s)
    if _AVERAGES in start:
        raise LaserFormatError(
            f"{path}: a report of averages over runs holds no single reading; export the readings of every run"
        )
    deviations = _read_table_of_deviations(path, sheet)
    if deviations["deviation"].attrs["units"] != "um" and not rotary:
        raise LaserFormatError(
            f"{path}: the positions are angles; a rotary axis is evaluated by ISO 230-2 alone, without a camera and not while it is "
            "measured: heat and expansion are explained along a linear axis; give the readings alone to thermofuse run or iso230"
        )
    return deviations


def _start_of(path: Path) -> bytes:
    """Return the beginning of a file, by which the files of laser programs are known."""
    with path.open("rb") as stream:
        return stream.read(START_BYTES)


def _of_a_program(start: bytes) -> Layout | None:
    """Return the layout of the laser program whose files begin so."""
    return next((one for one in FILES if one.find(start)), None)


def _read_table_of_deviations(path: Path, sheet: str | None) -> xr.Dataset:
    """Read delimited text or a spreadsheet: one reading per line, or position by run."""
    grids = read_grids(path, sheet=sheet)
    found: dict[str, Readings] = {}
    for grid in grids:
        for one in TABLES:
            if (table := one.find(grid)) is not None:
                found.setdefault(grid.sheet, one.read(table))
                break
    if len(found) > 1:
        raise LaserFormatError(
            f"{path}: the sheets {', '.join(map(repr, found))} each hold a table of deviations; name one of them (sheet = ...), or save it "
            "as a file of its own"
        )
    if not found:
        raise LaserFormatError(
            f"{grids[0].place}: no table of deviations; {what_is_missing(grids[0])}; expected one reading per line with the "
            f"columns {','.join(DEVIATION_COLUMNS)}, or a table of position by run such as 'Position [mm],1+ [um],1- [um],2+ [um]'"
        )
    return check_and_assemble(next(iter(found.values())))


def holds_deviations(path: Path) -> bool:
    """Return whether a file has a layout of deviations, whatever is in it."""
    return _of_a_program(_start_of(path)) is not None or any(
        one.find(grid) for grid in read_grids(path) for one in TABLES
    )


def is_environment_log(path: Path) -> bool:
    """Return whether a file is a table of air and material conditions, and not one of deviations."""
    if _of_a_program(_start_of(path)) is not None:
        return False
    roles = [
        {read_heading(text).role for text in fields}
        for grid in read_grids(path)
        for _, fields in grid.rows[:_HEADER_WITHIN]
    ]
    return any({"air_temperature", "air_pressure"} & found and not {"deviation", "measured"} & found for found in roles)


def read_environment(path: str | Path) -> xr.Dataset:
    r"""Read logged air and material conditions from delimited text or a spreadsheet.

    Parameters
    ----------
    path : str or pathlib.Path
        With the columns time, air_temperature_degC, air_pressure_hPa, relative_humidity_percent and material_temperature_degC, or
        headings in another language or unit (docs/formats.md). Further columns with a unit in their heading, such as
        ``room [degC]``, are read as they are.

    Returns
    -------
    xarray.Dataset
        Dim time (UTC, increasing): ``air_temperature`` and ``material_temperature`` (degC), ``air_pressure`` (hPa),
        ``relative_humidity`` (percent); further columns by their names in their own units, NaN where there is no number;
        ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason).

    Raises
    ------
    LaserFormatError
        A column is missing, or fewer than half of the lines can be used.
    OSError
        The file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    Notes
    -----
    The conditions that the index of air needs (Ciddor 1996, Appl. Opt. 35, 1566).

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "environment.csv"
    >>> _ = path.write_text("time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC\n"
    ...                     "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n")
    >>> float(read_environment(path)["air_pressure"][0])
    1000.2
    """
    path = Path(path)
    table, time, columns = _environment_table(path)
    variables = {name: ENVIRONMENT_ATTRIBUTES[name] for _, name, *_ in ENVIRONMENT_COLUMNS}
    beside = _further_columns(table, {time, *(text for text, _ in columns.values())} | variables.keys())
    variables |= {name: {"units": unit, "long_name": name} for name, unit in beside.values()}

    def parse(fields: dict[str, str]) -> list[float]:
        values = []
        for (column, _, _, low, high), (text, unit) in zip(ENVIRONMENT_COLUMNS, columns.values(), strict=True):
            value = table.numerals.reading(fields[text]) * UNITS[unit].factor + UNITS[unit].offset
            if not low <= value <= high:
                raise BadReading(fields[text], f"is outside {low:g} .. {high:g}, the range of {column} in its unit")
            values.append(value)
        return [*values, *(_number_or_nan(table, fields[text]) for text in beside)]

    return read_timed_rows(table, variables, parse, time=time)


def _further_columns(table: DelimitedTable, taken: Collection[str]) -> dict[str, tuple[str, str]]:
    """Name and unit of the columns of other quantities by heading; those without a unit, or with a role of their own, are none."""
    found: dict[str, tuple[str, str]] = {}
    for text in table.columns:
        match = _WITH_UNIT.fullmatch(text)
        if match is None or text in taken or read_heading(match[1]).role is not None:
            continue
        if match[1] not in taken and match[1] not in {name for name, _ in found.values()}:
            found[text] = match[1], match[2]
    return found


def _number_or_nan(table: DelimitedTable, text: str) -> float:
    try:
        return table.numerals.reading(text)
    except BadReading:
        return np.nan


def _environment_table(path: Path) -> tuple[DelimitedTable, str, dict[str, tuple[str, str]]]:
    """Return the table of a log, the column of times, and heading and unit of each variable."""
    best: tuple[int, str] = (-99, "")
    for grid in read_grids(path):
        for at, (line, fields) in enumerate(grid.rows):
            headings = {heading.role: heading for heading in map(read_heading, fields)}
            columns = {name: headings[name] for _, name, *_ in ENVIRONMENT_COLUMNS if name in headings}
            lacking = [
                column for column, name, *_ in ENVIRONMENT_COLUMNS if name not in columns or not columns[name].unit
            ]
            lacking += [] if "time" in headings else ["time"]
            if lacking:
                found = f"line {line} lacks {', '.join(lacking)}"
                best = max(best, (-len(lacking), found), key=lambda each: each[0])
                continue
            for _, name, kind, *_ in ENVIRONMENT_COLUMNS:
                if UNITS[columns[name].unit or ""].kind != kind:
                    raise LaserFormatError(
                        f"{path}, line {line}: the unit of {columns[name].text!r} is none of a {kind}; correct the heading"
                    )
            named = {name: (heading.text, heading.unit or "") for name, heading in columns.items()}
            return table_below(grid, at), headings["time"].text, named
    expected = ",".join(("time", *(column for column, *_ in ENVIRONMENT_COLUMNS)))
    raise LaserFormatError(
        f"{path}: no table of air and material: {best[1]}; expected {expected!r} (the heading names the unit, which may be another)"
    )
