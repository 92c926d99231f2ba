"""Single readings of a test: what a table gives, the checks that hold for every table, and the Dataset of all."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

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
from interferometry.io.faults import (
    MOST_CELLS,
    BadReading,
    LaserFormatError,
    LeftOut,
    Numerals,
    raise_if_mostly_invalid,
    raise_if_too_many,
)
from interferometry.io.renishaw import (
    START_BYTES,
    is_ecmc_log,
    is_ecmc_report,
    read_ecmc_log,
    read_ecmc_report,
    read_rtl,
)
from interferometry.io.tables import (
    PLAIN_VALUE,
    UNIT_WORDS,
    DateOrder,
    DelimitedTable,
    Grid,
    Heading,
    by_direction_letter,
    describe_time_zone,
    find_direction,
    fold,
    is_direction_letter,
    parse_time,
    read_grids,
    read_heading,
    read_timed_rows,
    shown,
    split_unit,
    table_below,
    unit_of_test,
)
from thermofuse.units import UNITS, Unit, UnitName

#: Positions closer than this are one, mm or deg.
POSITION_TOLERANCE = 1e-4
#: From mm to um, and from deg to arcsec.
FINE = {"length": 1e3, "angle": 3600.0}
Kind = Literal["length", "angle"]
#: Directions of successive runs, of a table that names none.
Directions = Literal["positive first", "negative first", "positive", "negative"]
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
    deviations = _assemble(path, readings)
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


@dataclass(frozen=True)
class Stated:
    """What a campaign file, or a caller, states of a table that does not say it itself: directions of its runs, names of units."""

    directions: Directions | None = None
    position_unit: UnitName | None = None
    deviation_unit: UnitName | None = None

    def unit(self, role: str, of_table: Unit | None, place: str) -> Unit | None:
        """Return the unit of positions or deviations, as the table or this says it."""
        stated: UnitName | None = getattr(self, f"{role}_unit")
        if stated and of_table not in (None, UNITS[stated]):
            raise LaserFormatError(
                f"{place}: the table states the unit {of_table.name} of the {role}s; remove {role}_unit"
            )
        return UNITS[stated] if stated else of_table


_NOTHING = Stated()


class NotStated(LaserFormatError):
    """A table that does not say what the `keys` of a campaign file, and parameters of `read_deviations`, state."""

    def __init__(self, place: str, lacking: Mapping[str, str]) -> None:
        self.keys = tuple(lacking)
        remedy = " and ".join(f"{key} as one of {', '.join(map(repr, get_args(_CHOICES[key])))}" for key in lacking)
        super().__init__(
            f"{place}: {'; '.join(lacking.values())}; write it in the table, or state {remedy}, under [interferometry] in a campaign "
            "file or to read_deviations"
        )


_CHOICES = {"directions": Directions, "position_unit": UnitName, "deviation_unit": UnitName}


def passes_by_order(positions: Sequence[float], runs: Sequence[int]) -> list[tuple[int, str]] | None:
    """Return number from 1 and direction of the pass of each reading, in measuring order; None where the order does not tell both.

    A pass ends where the axis turns, where a target is read again from the other side, and where another run begins.
    """
    passes: list[list[int]] = []
    signs: list[int] = []
    for i, position in enumerate(positions):
        step = position - positions[i - 1] if i and runs[i] == runs[i - 1] else np.nan
        sign = 0 if abs(step) <= POSITION_TOLERANCE else int(np.sign(np.nan_to_num(step)))
        if not passes or np.isnan(step):
            passes.append([i])
            signs.append(0)
        elif sign == 0:
            if not signs[-1]:
                return None
            passes.append([i])
            signs.append(-signs[-1])
        elif sign == signs[-1] or (len(passes[-1]) == 1 and not signs[-1]):
            passes[-1].append(i)
            signs[-1] = sign
        elif len(passes[-1]) == 1:
            # A target that is read twice on the way was not approached from the other side.
            return None
        else:
            passes.append([i])
            signs.append(sign)
    targets = len(set(number_targets(positions)))
    whole = [len(rows) >= targets / 2 for rows in passes[:-1]]
    if set(signs) != {-1, 1} or targets < 3 or not all(whole):
        return None
    return [
        (number, DIRECTIONS[0] if sign > 0 else DIRECTIONS[1])
        for number, (rows, sign) in enumerate(zip(passes, signs, strict=True), start=1)
        for _ in rows
    ]


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


def _assemble(path: Path, readings: Sequence[Reading]) -> xr.Dataset:
    cycles = sorted({reading.cycle for reading in readings})
    position = {reading.target: reading.position for reading in readings}
    targets = sorted(position)
    raise_if_too_many(path, len(cycles), len(targets))
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
    """A table with one reading per line whose header, on a line, was understood: column of each role, units of positions and deviations,
    and headings that name nothing known.
    """

    grid: Grid
    line: int
    columns: dict[str, int]
    units: dict[str, Unit]
    width: int
    rows: list[tuple[int, list[str]]]
    ignored: list[str]


def find_long_table(grid: Grid) -> LongTable | None:
    """Return the table of a grid whose header names position and deviation, and cycle or run unless the order of the positions tells it."""
    for at, (line, fields) in enumerate(grid.rows):
        headings = [read_heading(text) for text in fields]
        roles = [heading.role for heading in headings]
        if "position" in roles and {"deviation", "measured"} & {*roles}:
            numbered = {"cycle", "run"} & {*roles} or (
                "direction" not in roles and _turns(grid, at, roles.index("position"))
            )
            if numbered:
                return _understand(grid, at, line, headings)
    return None


def _turns(grid: Grid, at: int, column: int) -> bool:
    """Return whether the positions below a row tell the direction of each reading by their order."""
    below = [_cell(fields, column) for _, fields in grid.rows[at + 1 :]]
    positions = [grid.numerals.number(text) for text in below if _is_number(text, grid.numerals)]
    return passes_by_order(positions, [0] * len(positions)) is not None


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
    rows = grid.rows[at + 1 :]
    units = {
        role: heading.unit for heading in headings if (role := heading.role) in ("position", "measured", "deviation")
    }
    if rows and None in units.values() and _is_row_of_units(rows[0][1]):
        units = {role: unit or unit_of_test(_cell(rows[0][1], columns.get(role))) for role, unit in units.items()}
        rows = rows[1:]
    if "deviation" in columns and units.get("measured") is None:
        columns.pop("measured", None)
    if "direction" in columns:
        rows = _with_words(rows, columns["direction"])
        if rows and not any(find_direction(_cell(row, columns["direction"])) for _, row in rows):
            del columns["direction"]
    ignored = [heading.text for i, heading in enumerate(headings) if heading.text and i not in columns.values()]
    width = max(i for i, heading in enumerate(headings) if heading.text) + 1
    return LongTable(grid, line, columns, {role: unit for role, unit in units.items() if unit}, width, rows, ignored)


def _with_words(rows: list[tuple[int, list[str]]], column: int) -> list[tuple[int, list[str]]]:
    """Return rows in which a direction is a word that stands for itself: a 1 beside a -1 is +1, beside a 2 it only numbers them; F beside R
    is forward.
    """
    found = {row[column] for _, row in rows if len(row) > column}
    words = by_direction_letter({text for text in found if is_direction_letter(text)}) | (
        {"1": "+1"} if "-1" in found else {}
    )
    return [
        (line, [*row[:column], *(words.get(text, text) for text in row[column : column + 1]), *row[column + 1 :]])
        for line, row in rows
    ]


def _is_row_of_units(fields: list[str]) -> bool:
    texts = [text.strip("[]() ") for text in fields if text]
    return bool(texts) and all(unit_of_test(text) is not None for text in texts)


def _cell(fields: Sequence[str], index: int | None) -> str:
    return fields[index].strip("[]() ") if index is not None and index < len(fields) else ""


@dataclass(frozen=True)
class _Label:
    """A value, where it belongs, with numbers as they stand in the file, its own unit, and what stands beside it."""

    line: int
    number: int
    direction: str
    signed: bool
    target: int
    position: float
    value: str
    unit: Unit | None = None
    measured: str = ""
    time: str = ""


@dataclass(frozen=True)
class _Labelled:
    """Values of a table, and units of their positions, of themselves and of measured positions beside them, None where it has none.

    ``of_positions``: the values are measured positions by their heading; ``in_order``: the lines may follow each other as they were
    measured; ``numbered``, ``cycles``: the table numbers runs, or cycles.
    """

    grid: Grid
    line: int
    given: Readings
    labels: list[_Label]
    position: Unit | None
    value: Unit | None
    measured: Unit | None = None
    of_positions: bool = False
    in_order: bool = False
    timed: bool = False
    numbered: bool = True
    cycles: bool = False

    @property
    def place(self) -> str:
        """File and line of the heading."""
        return f"{self.grid.place}, line {self.line}"


def read_long_table(table: LongTable, stated: Stated = _NOTHING) -> Readings:
    """Read the lines of a table with one reading in each."""
    columns, units = table.columns, table.units
    given, labels = Readings(table.grid.path, ignored=table.ignored), list[_Label]()
    for line, fields in table.rows:
        with given.left_out.collect(line):
            labels.append(_label(table, line, fields))
    of_positions = "deviation" not in columns
    return _read_labels(
        _Labelled(
            table.grid, table.line, given, labels, units.get("position"), units.get("measured" if of_positions else "deviation"),
            measured=None if of_positions else units.get("measured"), of_positions=of_positions, in_order=True, timed="time" in columns,
            numbered=bool({"cycle", "run"} & columns.keys()), cycles="cycle" in columns,
        ),
        stated,
    )  # fmt: skip


def _read_labels(table: _Labelled, stated: Stated) -> Readings:
    """Return the readings of a table: directions and units as it names them, as its values tell or as they are stated, numbers from 1."""
    given, numerals, labels = table.given, table.grid.numerals, table.labels
    if not labels:
        return given
    order = DateOrder.of(given.path, [(label.line, label.time) for label in labels] if table.timed else [])
    position = stated.unit("position", table.position, table.place)
    value = stated.unit("deviation", table.value, table.place)
    numbers = np.array([numerals.number(one.value) if _is_number(one.value, numerals) else np.nan for one in labels])
    ratio = value.factor / position.factor if value and position else 1.0
    places = np.array([label.position for label in labels])
    near = np.abs(ratio * numbers - places) < _NEAR * np.ptp(places)
    of_positions = table.of_positions or bool(near[np.isfinite(numbers)].all() and near.any())
    value = value or (position if of_positions else None)
    lacking = {}
    if position is None:
        lacking["position_unit"] = "no heading states a unit of the positions that is read"
    if value is None:
        largest = f", the largest of which is {np.nanmax(np.abs(numbers), initial=0.0):g}"
        lacking["deviation_unit"] = f"no heading states a unit of the deviations that is read{largest}"
    if position is not None and position.factor != 1.0:
        labels = [replace(label, position=label.position * position.factor) for label in labels]
    # Each text is read once, though the order of the readings asks for their times before they are taken.
    at = cache(partial(parse_time, order=order))
    if isinstance(directed := _with_directions(table, labels, at, stated.directions), str):
        lacking["directions"] = directed
    if lacking or position is None or value is None or isinstance(directed, str):
        raise NotStated(table.place, lacking)
    units = {value, *(label.unit for label in labels if label.unit)}
    told = f"positions in {position.name}, deviations in {', '.join(sorted(unit.name for unit in units))}"
    given.kind = _kind_of([*units, position], f"{table.place}: {told}")
    if of_positions and not table.of_positions:
        given.notes.append("the values are measured positions: the target positions were subtracted")
    measured: list[float] = []
    for label in _renumber(table, directed):
        cell = label.number, label.direction, label.target
        with given.collect(label.line, cell):
            time, zone = at(label.time) if table.timed else (np.datetime64("NaT", "ns"), None)
            reading = numerals.reading(label.value) * (label.unit or value).factor
            if of_positions:
                reading -= label.position
            elif table.measured is not None:
                known = _is_number(label.measured, numerals)
                beside = numerals.number(label.measured) * table.measured.factor if known else np.nan
                measured.append(beside - label.position)
            if zone is not None:
                given.zones.setdefault(zone, label.line)
            # Rounded to a thousandth of a nanometre: the factors of the units have no exact binary value.
            deviation = round(reading * FINE[given.kind], 6)
            given.readings.append(Reading(label.line, *cell, label.position, time, deviation))
    given.left_out.lines.sort(key=lambda each: each.line)
    _compare_signs(given, np.array(measured) * FINE[given.kind])
    return given


def _compare_signs(given: Readings, differences: np.ndarray) -> None:
    """Turn deviations that are target minus measured, as the measured positions beside them tell."""
    stated = np.array([reading.deviation for reading in given.readings])
    if differences.size != stated.size or not np.isfinite(differences).any():
        return

    def apart(factor: float) -> float:
        return float(np.nanmedian(np.abs(differences - factor * stated)))

    if apart(-1) < 0.3 * min(apart(1), apart(0)):
        given.readings = [replace(reading, deviation=-reading.deviation) for reading in given.readings]
        given.notes.append(
            "warning: the deviations of the file are target minus measured; their sign was turned (ISO 230-2)"
        )
    elif (factor := min((1, 1e-3, 1e3, 1 / 25.4, 25.4), key=apart)) != 1 and apart(factor) < 0.1 * apart(0):
        raise LaserFormatError(
            f"{given.path}: in the units of the headings the deviations are {1 / factor:g} times the difference of measured and target "
            "position of the same lines; correct the unit in one heading"
        )


def _with_directions(
    table: _Labelled,
    labels: list[_Label],
    at: Callable[[str], tuple[np.datetime64, str]],
    directions: Directions | None,
) -> list[_Label] | str:
    """Return labels with their directions: as the table names them, as the order of the positions in time tells, or as stated; why none of
    these is known.
    """
    if table.timed:
        with suppress(BadReading):
            times = [at(label.time)[0] for label in labels]
            labels = [labels[at] for at in np.argsort(times, kind="stable")]
    runs = [(label.number, label.direction) for label in labels]
    named = all(label.direction for label in labels)
    if named and not (table.in_order and _contradicts(labels)):
        if directions is not None:
            raise LaserFormatError(f"{table.place}: the table names the direction of its runs; remove directions")
        return _turned(table, labels)
    positions = [label.position for label in labels]
    passes = None if named else passes_by_order(positions, [number for number, _ in runs])
    if passes is not None:
        table.given.notes.append("the direction of each run follows from the order of its positions")
        there = Counter(number for number, _ in {*zip((number for number, _ in runs), passes, strict=True)})
        numbered = table.numbered and max(there.values()) <= 2
        return [
            replace(label, number=label.number if numbered else number, direction=direction)
            for label, (number, direction) in zip(labels, passes, strict=True)
        ]
    if directions is None or len({*zip(runs, number_targets(positions), strict=True)}) < len(labels):
        return (
            "the runs named negative lead to larger positions and the others to smaller ones, against the sign of the travel"
            if named
            else "no heading or column names the direction of the runs, and the order of the positions does not tell it"
        )
    of_run = dict(zip(dict.fromkeys(runs), _state_directions(directions, len({*runs})), strict=True))
    return [replace(label, direction=of_run[run]) for label, run in zip(labels, runs, strict=True)]


def _ways(labels: Sequence[_Label], *, signed: bool) -> list[int]:
    """Return for every run whose direction has a sign, or has none, whether it goes with (1) or against it, in the order of the lines."""
    runs = [[*run] for _, run in itertools.groupby(labels, lambda one: (one.number, one.direction))]
    return [
        int(np.sign(run[-1].position - run[0].position)) * (1 if run[0].direction == DIRECTIONS[0] else -1)
        for run in runs
        if run[0].signed == signed and len(run) > 1
    ]


def _contradicts(labels: Sequence[_Label]) -> bool:
    """Whether every run goes against the sign of the direction that it is given."""
    return max(_ways(labels, signed=True), default=0) < 0


def _turned(table: _Labelled, labels: list[_Label]) -> list[_Label]:
    """Return labels whose "forward" is the positive direction, or where the times show that it leads to smaller positions the negative."""
    if all(label.signed for label in labels):
        return labels
    votes = sum(_ways(labels, signed=False)) if table.timed else 0
    if votes > 0:
        return labels
    smaller = "the forward runs lead to smaller positions: they are the negative direction"
    unknown = "forward was taken as the positive direction: the file gives no times that tell the travel"
    table.given.notes.append(smaller if votes else unknown)
    other = dict(zip(DIRECTIONS, DIRECTIONS[::-1], strict=True)) if votes else {}
    return [replace(label, direction=other.get(label.direction, label.direction)) for label in labels]


def _state_directions(directions: Directions, runs: int) -> list[str]:
    """Return the direction of each of so many successive runs."""
    first = DIRECTIONS.index(directions.split()[0])
    return [DIRECTIONS[(first + (run if directions.endswith("first") else 0)) % 2] for run in range(runs)]


def _kind_of(units: Iterable[Unit], given: str) -> Kind:
    """Return whether the units are those of a linear or of a rotary axis."""
    kinds = {unit.kind for unit in units}
    if kinds == {"angle"}:
        return "angle"
    if kinds == {"length"}:
        return "length"
    raise LaserFormatError(f"{given}; give both as lengths (linear axis) or both as angles (rotary axis)")


def _label(table: LongTable, line: int, fields: list[str]) -> _Label:
    columns, numerals = table.columns, table.grid.numerals
    if len(fields) <= max(columns.values()) or any(fields[table.width :]):
        raise BadReading("", f"does not have {table.width} fields")
    direction: tuple[str, bool] | None = ("", True)
    if "direction" in columns:
        direction = find_direction(fields[columns["direction"]])
    if direction is None:
        raise BadReading(fields[columns["direction"]], "is neither 'positive' nor 'negative'")
    numbers = next((columns[role] for role in ("cycle", "run") if role in columns), None)
    number = 0 if numbers is None else _count(fields[numbers], numerals)
    target = _count(fields[columns["target"]], numerals) if "target" in columns else 0
    where = numerals.reading(fields[columns["position"]])
    measured = fields[columns["measured"]] if "measured" in columns else ""
    value = fields[columns["deviation"]] if "deviation" in columns else measured
    return _Label(line, number, *direction, target, where, value, None, measured, _time_text(table, fields))


def _count(text: str, numerals: Numerals) -> int:
    """Return a whole number from 0, which stands for the first where a file counts from 0."""
    named = _NAMED_NUMBER.fullmatch(text)
    value = numerals.number(named[1] if named else text)
    if value != int(value) or value < 0:
        raise BadReading(text, _NOT_FROM_ONE)
    return int(value)


def _renumber(table: _Labelled, labels: list[_Label]) -> list[_Label]:
    """Return the labels with cycles and targets numbered from 1."""
    given = table.given
    if not table.cycles:
        labels = _cycles_of_runs(labels)
    numbers = _from_one([label.number for label in labels], "cycles", given.notes)
    if any(label.target for label in labels):
        targets = _from_one([label.target for label in labels], "targets", given.notes)
    else:
        targets = number_targets([label.position for label in labels])
    kept = []
    for label, number, target in zip(labels, numbers, targets, strict=True):
        if number and target:
            same = (number, target) == (label.number, label.target)
            kept.append(label if same else replace(label, number=number, target=target))
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
#: Values closer to their targets than this share of the travel are measured positions.
_NEAR = 0.02
#: Words beside the number of a run: axis, "number" and the sign of ISO 230-2.
_BESIDE_NUMBERS = ("no", "nr", "j", "x", "y", "z", "u", "w", "c")


@dataclass(frozen=True)
class Run:
    """A column (or row) of deviations: its headings joined, number of the run or cycle, direction ("" where nothing names it), whether the
    word for it names the sign of the travel, unit, and line and text of each reading in the order of the positions.
    """

    text: str
    number: int | None
    direction: str
    signed: bool
    unit: Unit | None
    values: list[tuple[int, str]]


@dataclass
class WideTable:
    """A table of position by run whose headings were understood: line of the row that names the positions, line and text of each position,
    units, runs, and headings of columns that are none.
    """

    grid: Grid
    line: int
    positions: list[tuple[int, str]]
    position_unit: Unit | None
    deviation_unit: Unit | None
    runs: list[Run]
    ignored: list[str] = field(default_factory=list)


def find_wide_table(grid: Grid) -> WideTable | None:
    """Return the table of position by run in a grid, blocks under titles such as "Forward" and "Reverse" joined; None without one."""
    titles = [
        at for at, (_, fields) in enumerate(grid.rows) if _titles_direction(" ".join(filter(None, fields)), fields)
    ]
    blocks = [
        replace(grid, rows=grid.rows[: titles[0]] + grid.rows[at + 1 : end], title=" ".join(grid.rows[at][1]))
        for at, end in itertools.pairwise([*titles, len(grid.rows)])
    ]
    tables = [table for block in blocks if block.rows and (table := _find_block(block)) is not None]
    return join_tables(tables) if len(tables) > 1 else _find_block(grid)


def _titles_direction(title: str, fields: Sequence[str] = ()) -> bool:
    """Return whether a line, or the name of a sheet, is a title such as "Forward" or "Run 2, reverse" above the runs of one direction."""
    label = _wide_label(title) if title and sum(map(bool, fields)) < 3 else None
    return label is not None and label[1] is not None and find_direction(label[1][0]) is not None


def join_tables(tables: Sequence[WideTable]) -> WideTable:
    """Return one table of the runs of several, whose positions are those of the first."""
    first = tables[0]
    known = np.array([first.grid.numerals.number(text) for _, text in first.positions])
    runs = list(first.runs)
    for table in tables[1:]:
        values: dict[int, int] = {}
        for row, (line, text) in enumerate(table.positions):
            apart = np.abs(known - table.grid.numerals.number(text))
            if apart.min() > POSITION_TOLERANCE:
                raise LaserFormatError(
                    f"{table.grid.place}, line {line}: position {text} of {table.grid.title!r} does not occur in {first.grid.title!r}; "
                    "give every run the same positions"
                )
            values[int(apart.argmin())] = row
        for run in table.runs:
            there = [run.values[values[i]] if i in values else (table.line, "") for i in range(known.size)]
            runs.append(replace(run, values=there))
    unit = next((table.deviation_unit for table in tables if table.deviation_unit), None)
    ignored = list(dict.fromkeys(text for table in tables for text in table.ignored))
    return replace(first, runs=runs, ignored=ignored, deviation_unit=unit)


def _find_block(grid: Grid) -> WideTable | None:
    """Return the table of position by run in a grid with one title."""
    width = max(len(fields) for _, fields in grid.rows)
    # Rows are given the width of the widest one, which must not fill the memory.
    if width * len(grid.rows) > MOST_CELLS:
        return None
    cells = [[*fields, *[""] * (width - len(fields))] for _, fields in grid.rows]
    heads = (at for at, row in enumerate(cells) if any(text and not PLAIN_VALUE.fullmatch(text) for text in row))
    for at in heads:
        headings = [read_heading(text) for text in cells[at]]
        # Without a column of positions, that of the targets gives them: "Target" is the usual word for both.
        name = "position" if any(heading.role == "position" for heading in headings) else "target"
        below = (_positions_below(grid, cells, at, column) for column, one in enumerate(headings) if one.role == name)
        if (across := _directions_below_positions(grid, cells, at)) is not None:
            return across
        for found in (*below, _positions_in_one_row(grid, cells, at)):
            if found is not None and (read := _read_runs(grid, found.candidates))[0]:
                ignored, titles = (
                    [*found.beside, *read[1]],
                    [text for fields in cells[: found.first] for text in fields],
                )
                unit = found.unit or _position_unit(titles)
                return WideTable(
                    grid, grid.rows[at][0], found.positions, unit, _deviation_unit(titles), read[0], ignored
                )
    return None


class _Found(NamedTuple):
    """What may be a table of position by run: row of its first values, line and text of each position, their unit, headings, values and
    place of what may be runs, and what else stands in the row of the positions.
    """

    first: int
    positions: list[tuple[int, str]]
    unit: Unit | None
    candidates: list[tuple[list[str], list[tuple[int, str]], str]]
    beside: list[str]


def _is_number(text: str, numerals: Numerals) -> bool:
    try:
        numerals.number(text)
    except BadReading:
        return False
    return True


def _positions_below(grid: Grid, cells: list[list[str]], at: int, column: int) -> _Found | None:
    """Return positions that stand below their heading, with what may be a run in each column to the right."""
    near = range(at + 1, min(at + 1 + _ROWS_BELOW, len(cells)))
    first = next((i for i in near if _is_number(cells[i][column], grid.numerals)), len(cells))
    data = [i for i in range(first, len(cells)) if _is_number(cells[i][column], grid.numerals)]
    heading, texts = read_heading(cells[at][column]), [cells[i][column] for i in data]
    numbered = heading.role == "target" and texts == [str(k + 1) for k in range(len(data))]
    if len(data) < _FEWEST_TARGETS or numbered:
        return None
    above = [i for i in range(max(0, at - _ROWS_ABOVE), at) if _names_runs(cells[i][column + 1 :])]
    block = [cells[i] for i in (*above, *range(at, first))]
    block = [_fill(row, column + 1) for row in block] if len(block) > 1 else block
    candidates = [
        ([row[j] for row in block if row[j]], [(grid.rows[i][0], cells[i][j]) for i in data], f"column {j + 1}")
        for j in range(column + 1, len(cells[at]))
    ]
    filled = [one for one in candidates if one[0] or any(text for _, text in one[1])]
    unit = heading.unit or unit_of_test(cells[first - 1][column])
    return _Found(first, [(grid.rows[i][0], cells[i][column]) for i in data], unit, filled, [])


def _positions_in_one_row(grid: Grid, cells: list[list[str]], at: int) -> _Found | None:
    """Return positions that stand in one row, with what may be a run in each row below, its labels before the numbers."""
    named = [read_heading(text.split("\\")[0]).role in ("run", "cycle", "direction") for text in cells[at]]
    labels, split = [j for j, label in enumerate(named) if label], [split_unit(text) for text in cells[at]]
    after = max(labels, default=len(split)) + 1
    places = [j for j in range(after, len(split)) if _is_number(split[j][0], grid.numerals)]
    if len(places) < _FEWEST_TARGETS:
        return None
    candidates = [
        ([row[j] for j in labels if row[j]], [(line, row[j]) for j in places], f"line {line}")
        for (line, _), row in zip(grid.rows[at + 1 :], cells[at + 1 :], strict=True)
    ]
    unit = next((split[j][1] for j in places if split[j][1]), None)
    beside = [cells[at][j] for j in range(after, len(split)) if cells[at][j] and j not in places]
    return _Found(at + 1, [(grid.rows[at][0], split[j][0]) for j in places], unit, candidates, beside)


def _directions_below_positions(grid: Grid, cells: list[list[str]], at: int) -> WideTable | None:
    """Return the table of the annexes of ISO 230-2: positions in one row, both directions below each, and a row for every cycle."""
    headings = [read_heading(text) for text in cells[at]]
    label = next((j for j, heading in enumerate(headings) if heading.role == "position"), len(headings))
    near = range(at + 1, min(at + 1 + _ROWS_BELOW, len(cells)))
    named = ({j: find_direction(text) for j, text in enumerate(cells[i]) if j > label and text} for i in near)
    below, ways = next(
        (
            (i, ways)
            for i, ways in zip(near, named, strict=True)
            if None not in ways.values() and len({*ways.values()}) == 2
        ),
        (0, {}),
    )
    places = _fill(cells[at], label + 1)
    columns = [j for j in ways if _is_number(places[j], grid.numerals)]
    if len(columns) < 2 * _FEWEST_TARGETS or len(columns) < len(ways):
        return None
    of_way = {way: [j for j in columns if ways[j] == way] for way in dict.fromkeys(ways.values()) if way is not None}
    positions = [[places[j] for j in of_one] for of_one in of_way.values()]
    start = min(columns)
    texts = [[text for text in row[:start] if text and read_heading(text).role != "deviation"] for row in cells]
    told = [_wide_label(" ".join(text)) for text in texts]
    values = [i for i in range(below + 1, len(cells)) if any(_is_number(cells[i][j], grid.numerals) for j in columns)]
    of_cycles = {i: one[0] for i in values if (one := told[i]) is not None and one[0] is not None}
    if positions[0] != positions[1] or not of_cycles:
        return None
    runs = [
        Run(" ".join(texts[i]), number, *way, None, [(grid.rows[i][0], cells[i][j]) for j in of_way[way]])
        for i, number in of_cycles.items()
        for way in of_way
    ]
    titles = [text for row in cells for text in row[:start]]
    line, ignored = grid.rows[at][0], [" ".join(texts[i]) for i in values if i not in of_cycles]
    places_told = [(line, text) for text in positions[0]]
    return WideTable(grid, line, places_told, headings[label].unit, _deviation_unit(titles), runs, ignored)


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


def _wide_label(text: str) -> tuple[int | None, tuple[str, bool] | None, Unit | None] | None:
    """Return number, direction (a letter, where it has one) and unit that a heading of a run holds; None where it holds anything else."""
    name, unit = split_unit(text)
    if unit is None and unit_of_test(text) is not None:
        return None, None, unit_of_test(text)
    numbers = set(re.findall(r"\d+", name))
    if len(numbers) > 1:
        return None
    rest = re.sub(r"\d+", " ", name).replace("第", " ").replace("次", " ").replace("#", " ").replace("=", " ").strip()
    direction: tuple[str, bool] | None = None
    for word in re.findall(
        r"[+\-−–↑↓→←]|[^\s+\-−–↑↓→←,;:/().\[\]]+", re.sub("<-+(?!>)", "←", re.sub("(?<!<)-+>", "→", rest))
    ):
        found = find_direction(word) or ((fold(word), False) if is_direction_letter(word) else None)
        if found is not None and (direction is None or found[0] == direction[0]):
            # "Forward ↑": the arrow names the sign.
            direction = found[0], found[1] or (direction is not None and direction[1])
        elif not (
            read_heading(word).role in ("run", "cycle", "deviation", "direction") or fold(word) in _BESIDE_NUMBERS
        ):
            return None
    return (int(next(iter(numbers))) if numbers else None), direction, unit


def _read_run(texts: list[str], values: list[tuple[int, str]], title: str) -> Run | None:
    """Return a run from its headings, and from the title above what they lack; None where they hold anything but number, direction and
    unit, as "mean +" does, or neither number nor direction.
    """
    labels = [_wide_label(text) for text in texts]
    if not texts or None in labels or not any(text for _, text in values):
        return None
    found = [label for label in labels if label is not None]
    directions = {label[1] for label in found if label[1] is not None}
    numbers = {label[0] for label in found if label[0] is not None}
    if not directions and _titles_direction(title) and (above := _wide_label(title)) and above[1]:
        directions, numbers = {above[1]}, numbers or {one for one in above[:1] if one is not None}
    if len(directions) > 1 or len(numbers) > 1 or not (directions or numbers):
        return None
    direction, signed = next(iter(directions), ("", True))
    unit = next((label[2] for label in found if label[2] is not None), None)
    return Run(" ".join(texts), next(iter(numbers), None), direction, signed, unit, values)


def _read_runs(
    grid: Grid, candidates: Iterable[tuple[list[str], list[tuple[int, str]], str]]
) -> tuple[list[Run], list[str]]:
    """Return the runs among columns or rows of headings and values, and what the others are called, by their headings or their place."""
    read = [(" ".join(texts) or place, _read_run(texts, values, grid.title)) for texts, values, place in candidates]
    letters = {run.direction for _, run in read if run is not None and is_direction_letter(run.direction)}
    words = {letter: find_direction(word) for letter, word in by_direction_letter(letters).items()}
    for at, (text, run) in enumerate(read):
        if run is not None and run.direction in letters:
            direction, signed = words.get(run.direction) or ("", True)
            read[at] = text, replace(run, direction=direction, signed=signed)
    # Beside runs whose direction is named, others are none.
    directed = any(run is not None and run.direction for _, run in read)
    kept = [run is not None and bool(run.direction if directed else run.number is not None) for _, run in read]
    runs = [run for (_, run), keep in zip(read, kept, strict=True) if run is not None and keep]
    return runs, [text for (text, _), keep in zip(read, kept, strict=True) if not keep]


def _deviation_unit(titles: Sequence[str]) -> Unit | None:
    """Return the unit that a title such as "Deviations [µm]" or "Unit: µm" gives."""
    for i, text in enumerate(titles):
        name, unit = split_unit(re.sub(r"\s*[:=]\s*", " ", text))
        following = unit_of_test(titles[i + 1]) if i + 1 < len(titles) else None
        if fold(name) in UNIT_WORDS and (unit or following):
            return unit or following
        if unit and any(read_heading(part).role == "deviation" for part in name.split("\\")):
            return unit
    return None


def _position_unit(titles: Sequence[str]) -> Unit | None:
    r"""Return the unit that a title or corner such as "Run \ Position [mm]" gives."""
    parts = [read_heading(part.strip()) for text in titles for part in text.split("\\")]
    return next((heading.unit for heading in parts if heading.role == "position" and heading.unit), None)


def read_wide_table(table: WideTable, stated: Stated) -> Readings:
    """Read the values of a table of position by run."""
    numerals = table.grid.numerals
    of_runs = next((run.unit for run in table.runs if run.unit), None)
    if table.deviation_unit and of_runs not in (None, table.deviation_unit):
        raise LaserFormatError(
            f"{table.grid.place}: the deviations are in {table.deviation_unit.name} by the title and in {of_runs.name} by the headings of "
            "the runs; correct one of them"
        )
    numbers = [run.number for run in table.runs]
    numbered = None not in numbers
    if not numbered and any(number is not None for number in numbers):
        unnumbered = next(run.text for run in table.runs if run.number is None)
        raise LaserFormatError(
            f"{table.grid.place}, line {table.line}: {unnumbered!r} has no number, but other runs have; number every run"
        )
    labels = [
        _Label(line, number if run.number is None else run.number, run.direction, run.signed, 0, numerals.number(place), text, run.unit)
        for number, run in enumerate(table.runs, start=1)
        for (line, text), (_, place) in zip(run.values, table.positions, strict=True)
        if text
    ]  # fmt: skip
    return _read_labels(
        _Labelled(
            table.grid, table.line, Readings(table.grid.path, ignored=table.ignored), labels, table.position_unit,
            table.deviation_unit or of_runs, numbered=numbered,
            cycles=numbered and {run.direction for run in table.runs} in ({"positive"}, {"negative"}),
        ),
        stated,
    )  # fmt: skip


# Readers of deviations and environment: the kind of file is recognised, and every unusable line is listed in the
# result.


class Layout(NamedTuple):
    """A layout of deviations: its row in docs/formats.md, what finds it in the first bytes of a file or in a grid, and what reads it.

    A file is read by its path and what was stated of feed (mm/min) and dwell (s), a table by what was found and what was stated of it.
    """

    name: str
    find: Callable[[Any], Any]
    read: Callable[..., Any]


#: What `read_deviations` reads, in the order in which a file is held against it: files of laser programs, and tables.
FILES = (
    Layout("Renishaw linear test, .rtl", lambda start: b"HEADER::" in start.upper(), read_rtl),
    Layout("logs of the ecmc test tools, .dat", is_ecmc_log, lambda path, feed, dwell: read_ecmc_log(path)),
    Layout("reports of the ecmc test tools, .md", is_ecmc_report, lambda path, feed, dwell: read_ecmc_report(path)),
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
    ("relative_humidity_percent", "relative_humidity", "share", 1.0, 100.0),
    ("material_temperature_degC", "material_temperature", "temperature", -9.0, 80.0),
)
AIR_AND_MATERIAL = tuple(name for _, name, *_ in ENVIRONMENT_COLUMNS)


def read_deviations(
    path: str | Path,
    *,
    feed_mm_per_min: float | None = None,
    dwell_s: float | None = None,
    sheet: str | None = None,
    directions: Directions | None = None,
    position_unit: UnitName | None = None,
    deviation_unit: UnitName | None = None,
    rotary: bool = False,
) -> xr.Dataset:
    r"""Read positioning deviations from a file.

    Parameters
    ----------
    path : str or pathlib.Path
        Delimited text or a spreadsheet (.xlsx, .xls, .ods) with one reading per line (columns cycle, direction, target, position_mm,
        time, deviation_um) or with one column or row per run; a Renishaw linear test (.rtl); or a log or report of the ecmc test tools
        (.dat, .md).
        The kind of file is recognised from its content; headings may be English, German, French, Spanish or Chinese and carry their
        unit (docs/formats.md).
    feed_mm_per_min : float, optional
        Feed between targets, mm/min.
    dwell_s : float, optional
        Time at rest at each target, s. With both, the times of readings, which a .rtl does not hold, are reconstructed more closely.
        Ignored where every reading has its own time.
    sheet : str, optional
        Name of the sheet of a spreadsheet; None: the only one that holds a table of deviations, or one for each direction.
    directions : {"positive first", "negative first", "positive", "negative"}, optional
        From which side the targets were approached, of a table that names no direction and whose order of positions does not tell it: in
        alternating runs, of which the first is named, or always from the same side.
    position_unit, deviation_unit : {"um", "mm", "m", "nm", "in", "mil", "uin", "deg", "arcmin", "arcsec"}, optional
        Unit of the positions, and of the deviations, of a table that states none.
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
        The file cannot be used as a whole, it is of a rotary axis and `rotary` is False, or what it does not say, `directions` or a unit,
        is not given, or given though it says it.
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
    stated = Stated(directions, position_unit, deviation_unit)
    for name, choices in _CHOICES.items():
        if (given := getattr(stated, name)) not in (None, *get_args(choices)):
            raise LaserFormatError(f"{name}={given!r} is none of {', '.join(map(repr, get_args(choices)))}")
    start = _start_of(path)
    if (program := _of_a_program(start)) is not None:
        return program.read(path, feed_mm_per_min, dwell_s)
    if _AVERAGES in start:
        raise LaserFormatError(
            f"{path}: a report of averages over runs holds no single reading; export the readings of every run"
        )
    deviations = _read_table_of_deviations(path, sheet, stated)
    if deviations["deviation"].attrs["units"] != "um" and not rotary:
        raise LaserFormatError(
            f"{path}: the positions are angles; a rotary axis is evaluated by ISO 230-2 alone, without a camera and not while it is "
            "measured: heat and expansion are explained along a linear axis; give the readings alone (read_deviations: rotary=True)"
        )
    return deviations


def _start_of(path: Path) -> bytes:
    """Return the beginning of a file, by which the files of laser programs are known, as ASCII where it is UTF-16."""
    with path.open("rb") as stream:
        return stream.read(START_BYTES).replace(b"\0", b"")


def _of_a_program(start: bytes) -> Layout | None:
    """Return the layout of the laser program whose files begin so."""
    return next((one for one in FILES if one.find(start)), None)


def _read_table_of_deviations(path: Path, sheet: str | None, stated: Stated) -> xr.Dataset:
    """Read delimited text or a spreadsheet: one reading per line, or position by run."""
    grids = read_grids(path, sheet=sheet)
    found: dict[str, tuple[Layout, Any]] = {}
    for grid in grids:
        for one in TABLES:
            if (table := one.find(grid)) is not None:
                found.setdefault(grid.sheet, (one, table))
                break
    if len(found) > 1 and all(
        isinstance(table, WideTable) and _titles_direction(name) for name, (_, table) in found.items()
    ):
        found = {"": (TABLES[1], join_tables([table for _, table in found.values()]))}
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
    layout, table = next(iter(found.values()))
    return check_and_assemble(layout.read(table, stated))


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


def holds_environment(path: Path) -> bool:
    """Return whether a log of air and material has all columns that the compensation of a laser needs."""
    with suppress(LaserFormatError):
        return bool(_environment_table(path))
    return False


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
            value = table.numerals.reading(fields[text]) * unit.factor + unit.offset
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


def _environment_table(path: Path) -> tuple[DelimitedTable, str, dict[str, tuple[str, Unit]]]:
    """Return the table of a log, the column of times, and heading and unit of each variable."""
    best: tuple[int, str] = (-99, "")
    for grid in read_grids(path):
        for at, (line, fields) in enumerate(grid.rows):
            headings = {heading.role: heading for heading in map(read_heading, fields)}
            columns = {name: headings[name] for _, name, *_ in ENVIRONMENT_COLUMNS if name in headings}
            lacking = [
                f"a unit of {columns[name].text!r} that is read" if name in columns else column
                for column, name, *_ in ENVIRONMENT_COLUMNS
                if name not in columns or not columns[name].unit
            ]
            lacking += [] if "time" in headings else ["time"]
            if lacking:
                found = f"line {line} lacks {', '.join(lacking)}"
                best = max(best, (-len(lacking), found), key=lambda each: each[0])
                continue
            named = {name: (heading.text, heading.unit) for name, heading in columns.items() if heading.unit}
            for _, name, kind, *_ in ENVIRONMENT_COLUMNS:
                if named[name][1].kind != kind:
                    raise LaserFormatError(
                        f"{path}, line {line}: the unit of {named[name][0]!r} is none of a {kind}; correct the heading"
                    )
            return table_below(grid, at), headings["time"].text, named
    expected = ",".join(("time", *(column for column, *_ in ENVIRONMENT_COLUMNS)))
    raise LaserFormatError(
        f"{path}: no table of air and material: {best[1]}; expected {expected!r} (the heading names the unit, which may be another); a "
        "log that does not hold all of these is named as file under [drivers]"
    )
