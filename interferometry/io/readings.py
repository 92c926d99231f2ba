"""Single readings of a test: what a table gives, the checks that hold for every table, and the Dataset of all."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr

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
from interferometry.io.dates import describe_time_zone
from interferometry.io.faults import LaserFormatError, RejectedLine, raise_if_mostly_invalid

#: Positions closer than this are one, mm or deg.
POSITION_TOLERANCE = 1e-4
#: From mm to um, and from deg to arcsec.
FINE = {"length": 1e3, "angle": 3600.0}
Kind = Literal["length", "angle"]
Cell = tuple[int, str, int]


@dataclass(frozen=True)
class Reading:
    """One reading of a test.

    Attributes
    ----------
    line : int
        Its line or row in the file, from 1.
    cycle : int
        From 1.
    direction : str
        "positive" or "negative".
    target : int
        From 1.
    position : float
        Target position, mm (rotary axes: deg).
    time : numpy.datetime64
        UTC; NaT where the file gives none.
    deviation : float
        Actual minus target position, um (rotary axes: arcsec).
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
    """What a table gives, before it is checked.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    kind : {"length", "angle"}
        Whether the axis is linear or rotary.
    readings : list of Reading
        In the order of the file.
    left_out : list of RejectedLine
        Lines that cannot be used.
    zones : dict of str to int
        Number of the first line with each time zone; empty where the file gives no times.
    unreadable : set of (int, str, int)
        Cells for which there is a line that cannot be used.
    ignored : list of str
        Columns that were not read.
    notes : list of str
        What the reader assumed, in sentences.
    """

    path: Path
    kind: Kind = "length"
    readings: list[Reading] = field(default_factory=list)
    left_out: list[RejectedLine] = field(default_factory=list)
    zones: dict[str, int] = field(default_factory=dict)
    unreadable: set[Cell] = field(default_factory=set)
    ignored: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_and_assemble(given: Readings) -> xr.Dataset:
    """Check the readings of a table and lay them out by cycle, direction and target.

    Parameters
    ----------
    given : Readings

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``; of a rotary axis ``deviation`` is in arcsec and ``position`` in deg. ``attrs``: ``left_out``
        (JSON list of lines), ``missing`` (number of readings), ``columns_ignored`` and ``notes`` (JSON lists of str).

    Raises
    ------
    LaserFormatError
        Fewer than half of the lines can be used, targets change their positions, or cycles overlap in time.
    """
    path, left_out = given.path, given.left_out
    raise_if_mostly_invalid(path, len(given.readings), left_out)
    readings, duplicates = _drop_duplicates(path, given.readings, left_out)
    readings = _drop_misplaced(path, readings, left_out, "mm" if given.kind == "length" else "deg")
    timed = bool(given.zones)
    if timed:
        readings = _drop_wrong_times(path, readings, left_out)
        _check_cycles(path, readings)
        given.notes += _note_of_minutes(readings)
        reference = describe_time_zone(path, given.zones)
    deviations = _assemble(readings)
    deviations = _flag_cells(deviations, UNREADABLE, given.unreadable)
    deviations = _flag_cells(deviations, DUPLICATE, duplicates)
    if timed:
        deviations = set_flag(deviations, OUT_OF_ORDER, detect_out_of_order(deviations))
        deviations["time"].attrs.update(origin="recorded", reference=reference)
    else:
        deviations["time"].attrs.update(origin="none", reference="the file holds no times")
    if given.kind == "angle":
        deviations["deviation"].attrs["units"] = "arcsec"
        deviations["position"].attrs["units"] = "deg"
    deviations.attrs.update(
        source=path.name,
        left_out=json.dumps([asdict(line) for line in left_out]),
        missing=int(np.isnan(deviations["deviation"].values).sum()),
        columns_ignored=json.dumps(given.ignored),
        notes=json.dumps(given.notes),
    )
    return deviations


def turn_by_travel(given: Readings) -> None:
    """Exchange the directions where "forward" runs led to smaller positions; without times they are taken as positive.

    Parameters
    ----------
    given : Readings
        Of a table whose words for the directions only name the order of the runs; changed in place.
    """
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
    """Return the number of the target at each position, from 1 at the smallest.

    Parameters
    ----------
    positions : sequence of float
        Target positions of readings, mm or deg.
    """
    values, inverse = np.unique(np.asarray(positions, dtype="f8"), return_inverse=True)
    group = np.concatenate([[0], np.cumsum(np.diff(values) > POSITION_TOLERANCE)])
    return (group[inverse] + 1).tolist()


def _drop_duplicates(
    path: Path, readings: list[Reading], left_out: list[RejectedLine]
) -> tuple[list[Reading], set[Cell]]:
    first: dict[Cell, Reading] = {}
    repeated: set[Cell] = set()
    for reading in readings:
        if reading.cell in first:
            repeated.add(reading.cell)
            reason = (
                f"cycle {reading.cycle} {reading.direction} target {reading.target} already stands on line "
                f"{first[reading.cell].line}, which is kept"
            )
            left_out.append(RejectedLine(path.name, reading.line, str(reading.deviation), reason))
        else:
            first[reading.cell] = reading
    return list(first.values()), repeated


def _drop_misplaced(path: Path, readings: list[Reading], left_out: list[RejectedLine], unit: str) -> list[Reading]:
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
                f"{path}: target {target} stands at {off[0].position} {unit} on line {off[0].line} but at {typical} {unit} elsewhere "
                f"({len(off)} of {len(group)} readings disagree); the position is the programmed one, the same in every cycle: correct it"
            )
        for reading in off:
            reason = f"target {target} stands at {typical} {unit} elsewhere"
            left_out.append(RejectedLine(path.name, reading.line, str(reading.position), reason))
        kept += [reading for reading in group if reading not in off]
    for first, second in itertools.pairwise(sorted(positions, key=positions.__getitem__)):
        if abs(positions[first] - positions[second]) <= POSITION_TOLERANCE:
            raise LaserFormatError(
                f"{path}: targets {first} and {second} both stand at {positions[first]} {unit}; number each position once"
            )
    return kept


def _drop_wrong_times(path: Path, readings: list[Reading], left_out: list[RejectedLine]) -> list[Reading]:
    """Leave out single readings whose time lies beyond the middle of the neighbouring cycles."""
    centres = _cycle_centres(readings)
    numbers = sorted(centres)
    if len(numbers) < 2:
        return readings
    steps = np.diff([centres[number] for number in numbers])
    if np.any(steps <= 0):
        return readings
    typical = float(np.median(steps))
    bounds: dict[int, tuple[float, float]] = {}
    for i, number in enumerate(numbers):
        early = centres[numbers[i - 1]] if i else centres[number] - typical
        late = centres[numbers[i + 1]] if i + 1 < len(numbers) else centres[number] + typical
        bounds[number] = (early, late)
    kept = []
    for reading in readings:
        early, late = bounds[reading.cycle]
        if early <= reading.time.astype("i8") <= late:
            kept.append(reading)
        else:
            reason = f"is not a time within cycle {reading.cycle}"
            left_out.append(RejectedLine(path.name, reading.line, str(reading.time), reason))
    return kept


def _cycle_centres(readings: Sequence[Reading]) -> dict[int, float]:
    times: dict[int, list[int]] = defaultdict(list)
    for reading in readings:
        times[reading.cycle].append(int(reading.time.astype("i8")))
    return {cycle: float(np.median(values)) for cycle, values in times.items()}


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
    ends: dict[int, tuple[Reading, Reading]] = {}
    for reading in readings:
        low, high = ends.get(reading.cycle, (reading, reading))
        ends[reading.cycle] = (min(low, reading, key=lambda r: r.time), max(high, reading, key=lambda r: r.time))
    numbers = sorted(ends)
    for number, following in itertools.pairwise(numbers):
        last, first = ends[number][1], ends[following][0]
        if first.time <= last.time:
            raise LaserFormatError(
                f"{path}: cycle {following} begins at {first.time} (line {first.line}) before cycle {number} ends at {last.time} "
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
