"""Tables of position by run: one row per target and one column per run, or one row per run and one column per target."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from interferometry.io.delimited import Grid
from interferometry.io.faults import BadReading, LaserFormatError, RejectedLine
from interferometry.io.headings import UNITS, Heading, find_direction, find_unit, fold, read_heading, split_unit
from interferometry.io.numerals import Numerals
from interferometry.io.readings import FINE, Kind, Reading, Readings, number_targets, turn_by_travel

#: Rows above and below the one that names the positions, in which directions and numbers of runs may stand.
_ROWS_ABOVE, _ROWS_BELOW = 2, 3
#: Fewest targets and runs by which a table is recognised.
_FEWEST_TARGETS = 2
#: More than any table of positions by run has; rows are given the width of the widest one, which must not fill the memory.
_MOST_CELLS = 5_000_000
_UNIT_WORDS = {"unit", "units", "einheit", "einheiten", "unite", "unites", "unidad", "unidades", "单位"}


@dataclass(frozen=True)
class Run:
    """A column (or row) of deviations.

    Attributes
    ----------
    text : str
        Its headings, joined.
    number : int or None
        Of the run or cycle; None where none stands there.
    direction : str
        "positive" or "negative".
    signed : bool
        Whether the word names the sign of the travel.
    unit : str or None
        Key of `headings.UNITS`.
    values : list of (int, str)
        Line and text of each reading, in the order of the positions.
    """

    text: str
    number: int | None
    direction: str
    signed: bool
    unit: str | None
    values: list[tuple[int, str]]


@dataclass
class WideTable:
    """A table of position by run whose headings were understood.

    Attributes
    ----------
    grid : Grid
    line : int
        Of the row that names the positions.
    positions : list of (int, str)
        Line and text of each target position.
    position_unit, deviation_unit : str or None
        Keys of `headings.UNITS`.
    runs : list of Run
    ignored : list of str
        Headings of columns that are no runs.
    """

    grid: Grid
    line: int
    positions: list[tuple[int, str]]
    position_unit: str | None
    deviation_unit: str | None
    runs: list[Run]
    ignored: list[str] = field(default_factory=list)


def find_wide_table(grid: Grid) -> WideTable | None:
    """Return the table of position by run in a grid, None without one.

    Parameters
    ----------
    grid : Grid
    """
    width = max(len(fields) for _, fields in grid.rows)
    if width * len(grid.rows) > _MOST_CELLS:
        return None
    cells = [[*fields, *[""] * (width - len(fields))] for _, fields in grid.rows]
    lines = [line for line, _ in grid.rows]
    numerals = grid.numerals
    for at, row in enumerate(cells):
        for column, text in enumerate(row):
            heading = read_heading(text)
            if heading.role == "position":
                found = _positions_below(grid, cells, lines, numerals, at, column, heading)
                if found is not None:
                    return found
        found = _positions_beside(grid, cells, lines, numerals, at)
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
    grid: Grid, cells: list[list[str]], lines: list[int], numerals: Numerals, at: int, column: int, heading: Heading
) -> WideTable | None:
    """Return the table whose positions stand below their heading, with one run per column to the right."""
    first = next(
        (i for i in range(at + 1, min(at + 1 + _ROWS_BELOW, len(cells))) if _is_number(cells[i][column], numerals)),
        None,
    )
    if first is None:
        return None
    data = [i for i in range(first, len(cells)) if _is_number(cells[i][column], numerals)]
    if len(data) < _FEWEST_TARGETS:
        return None
    above = [i for i in range(max(0, at - _ROWS_ABOVE), at) if _names_runs(cells[i][column + 1 :])]
    block = [cells[i] for i in (*above, *range(at, first))]
    if len(block) > 1:
        block = [_fill(row, column + 1) for row in block]
    runs: list[Run] = []
    ignored: list[str] = []
    for j in range(column + 1, len(cells[at])):
        texts = [row[j] for row in block if row[j]]
        values = [(lines[i], cells[i][j]) for i in data]
        run = _read_run(texts, values)
        if run is not None:
            runs.append(run)
        elif texts or any(text for _, text in values):
            ignored.append(" ".join(texts) or f"column {j + 1}")
    if not runs:
        return None
    titles = [text for row in cells[:first] for text in row]
    unit = heading.unit or find_unit(cells[first - 1][column].strip("[]() "))
    positions = [(lines[i], cells[i][column]) for i in data]
    return WideTable(grid, lines[at], positions, unit, _deviation_unit(titles), runs, ignored)


def _positions_beside(
    grid: Grid, cells: list[list[str]], lines: list[int], numerals: Numerals, at: int
) -> WideTable | None:
    """Return the table whose positions stand in one row, with one run per row below and its labels before the numbers."""
    row = cells[at]
    labels = [
        j for j, text in enumerate(row) if read_heading(text.split("\\")[0]).role in ("run", "cycle", "direction")
    ]
    if not labels:
        return None
    after = max(labels) + 1
    split = [split_unit(text) for text in row]
    places = [j for j in range(after, len(row)) if _is_number(split[j][0], numerals)]
    if len(places) < _FEWEST_TARGETS:
        return None
    runs: list[Run] = []
    ignored = [row[j] for j in range(after, len(row)) if row[j] and j not in places]
    for i in range(at + 1, len(cells)):
        texts = [cells[i][j] for j in labels if cells[i][j]]
        run = _read_run(texts, [(lines[i], cells[i][j]) for j in places])
        if run is not None:
            runs.append(run)
        elif any(cells[i]):
            ignored.append(" ".join(texts) or f"line {lines[i]}")
    if not runs:
        return None
    titles = [text for fields in cells[: at + 1] for text in fields]
    unit = next((split[j][1] for j in places if split[j][1]), None) or _position_unit(titles)
    positions = [(lines[at], split[j][0]) for j in places]
    return WideTable(grid, lines[at], positions, unit, _deviation_unit(titles), runs, ignored)


def _fill(row: Sequence[str], start: int) -> list[str]:
    """Return a row of headings in which every blank takes the text before it, as merged cells leave it in a file of text."""
    filled = list(row)
    for j in range(start + 1, len(filled)):
        filled[j] = filled[j] or filled[j - 1]
    return filled


def _names_runs(texts: Sequence[str]) -> bool:
    """Return whether a row names directions or numbers of runs, so that it belongs to the headings and not to the title."""
    named = [text for text in texts if text]
    return len(set(named)) > 1 and all(_label(text) is not None for text in named)


def _label(text: str) -> tuple[int | None, tuple[str, bool] | None, str | None] | None:
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
        elif read_heading(word).role not in ("run", "cycle", "deviation", "direction") and fold(word) not in (
            "no",
            "nr",
        ):
            return None
    return (int(next(iter(numbers))) if numbers else None), direction, unit


def _read_run(texts: list[str], values: list[tuple[int, str]]) -> Run | None:
    """Return a run from its headings; None where they hold anything but number, direction and unit, as "mean +" does."""
    labels = [_label(text) for text in texts]
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


def _deviation_unit(titles: Sequence[str]) -> str | None:
    """Return the unit that a title such as "Deviations [µm]" or "Unit: µm" gives."""
    for i, text in enumerate(titles):
        name, unit = split_unit(re.sub(r"\s*[:=]\s*", " ", text))
        following = find_unit(titles[i + 1].strip("[]() ")) if i + 1 < len(titles) else None
        if fold(name) in _UNIT_WORDS and (unit or following):
            return unit or following
        if unit and any(read_heading(part).role == "deviation" for part in name.split("\\")):
            return unit
    return None


def _position_unit(titles: Sequence[str]) -> str | None:
    r"""Return the unit that a title or corner such as "Run \ Position [mm]" gives."""
    parts = [read_heading(part.strip()) for text in titles for part in text.split("\\")]
    return next((heading.unit for heading in parts if heading.role == "position" and heading.unit), None)


def read_wide_table(table: WideTable) -> Readings:
    """Read the readings of a table of position by run.

    Parameters
    ----------
    table : WideTable

    Returns
    -------
    Readings
        Without times. Empty cells are missing readings.

    Raises
    ------
    LaserFormatError
        A unit is missing, positions and deviations are of different kinds, or only some runs are numbered.
    """
    path, numerals = table.grid.path, table.grid.numerals
    kind = _kind(table)
    given = Readings(path, kind, ignored=table.ignored)
    factor = UNITS[table.position_unit or ""].factor
    positions = [numerals.number(text) * factor for _, text in table.positions]
    targets = number_targets(positions)
    for run, cycle in zip(table.runs, _cycles(table), strict=True):
        fine = UNITS[run.unit or table.deviation_unit or ""].factor * FINE[kind]
        for (line, text), target, position in zip(run.values, targets, positions, strict=True):
            if not text:
                continue
            try:
                deviation = round(numerals.reading(text) * fine, 6)
            except BadReading as fault:
                given.left_out.append(RejectedLine(path.name, line, fault.value, fault.reason))
                given.unreadable.add((cycle, run.direction, target))
                continue
            given.readings.append(
                Reading(line, cycle, run.direction, target, position, np.datetime64("NaT", "ns"), deviation)
            )
    if not all(run.signed for run in table.runs):
        turn_by_travel(given)
    return given


def _kind(table: WideTable) -> Kind:
    place = f"{table.grid.place}, line {table.line}"
    if table.position_unit is None:
        raise LaserFormatError(
            f'{place}: the positions have no unit; write it in their heading, for example "Position [mm]"'
        )
    units = {run.unit or table.deviation_unit for run in table.runs}
    if None in units:
        raise LaserFormatError(
            f'{place}: the deviations have no unit; write it in the headings, for example "Run 1 + [um]", or above them as "Unit: um"'
        )
    kinds = {UNITS[unit or ""].kind for unit in (*units, table.position_unit)}
    if len(kinds) > 1 or not kinds <= {"length", "angle"}:
        raise LaserFormatError(
            f"{place}: positions in {table.position_unit}, deviations in {', '.join(sorted(map(str, units)))}; "
            "give both as lengths (linear axis) or both as angles (rotary axis)"
        )
    return "angle" if kinds == {"angle"} else "length"


def _cycles(table: WideTable) -> list[int]:
    """Return the cycle of each run: its number, or its place among the runs of its direction."""
    numbers = [run.number for run in table.runs]
    if any(number is None for number in numbers) and any(number is not None for number in numbers):
        unnumbered = next(run.text for run in table.runs if run.number is None)
        raise LaserFormatError(
            f"{table.grid.place}, line {table.line}: {unnumbered!r} has no number, but other runs have; number every run"
        )
    by_direction = {
        direction: [run.number for run in table.runs if run.direction == direction]
        for direction in ("positive", "negative")
    }
    shared = set(by_direction["positive"]) & set(by_direction["negative"])
    if None in numbers or (not shared and all(by_direction.values())):
        counted = {"positive": 0, "negative": 0}
        cycles = []
        for run in table.runs:
            counted[run.direction] += 1
            cycles.append(counted[run.direction])
        return cycles
    first = min(number for number in numbers if number is not None)
    return [number + (1 if first == 0 else 0) for number in numbers if number is not None]
