"""Readers of deviations and environment: the kind of file is recognised, and every unusable line is listed in the result."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

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
from interferometry.io.delimited import (
    BadReading,
    DelimitedTable,
    LaserFormatError,
    RejectedLine,
    describe_time_zone,
    parse_time,
    raise_if_mostly_invalid,
    read_table,
    read_timed_rows,
)
from interferometry.io.ecmc import is_ecmc_log, read_ecmc_log
from interferometry.io.renishaw import read_rtl

DEVIATION_COLUMNS = ("cycle", "direction", "target", "position_mm", "time", "deviation_um")
POSITION_TOLERANCE_MM = 1e-4

#: Column of the environment file, variable, unit, smallest and largest plausible value.
ENVIRONMENT_COLUMNS = (
    ("air_temperature_degC", "air_temperature", "degC", -9.0, 60.0),
    ("air_pressure_hPa", "air_pressure", "hPa", 500.0, 1200.0),
    ("relative_humidity_percent", "relative_humidity", "percent", 0.0, 100.0),
    ("material_temperature_degC", "material_temperature", "degC", -9.0, 80.0),
)


@dataclass(frozen=True)
class _Reading:
    line: int
    cycle: int
    direction: str
    target: int
    position: float
    time: np.datetime64
    deviation: float


def read_deviations(
    path: str | Path, *, feed_mm_per_min: float | None = None, dwell_s: float | None = None
) -> xr.Dataset:
    r"""Read positioning deviations from a file.

    Parameters
    ----------
    path : str or pathlib.Path
        A CSV file with the columns cycle, direction, target, position_mm, time, deviation_um; a Renishaw linear test (.rtl); or a
        log of the ecmc test tools (.dat). The kind of file is recognised from its content.
    feed_mm_per_min : float, optional
        Feed between targets, mm/min.
    dwell_s : float, optional
        Time at rest at each target, s. With both, the times of readings, which a .rtl does not hold, are reconstructed more closely.
        Ignored where every reading has its own time.

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``: ``deviation`` (um), ``time`` (UTC) and ``quality_flag`` (cycle, direction, target), ``position``
        (mm; target). ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason);
        ``time.attrs["origin"]`` is "recorded", "reconstructed" or "none"; ``time_u`` is the standard uncertainty of reconstructed
        times, s.

    Raises
    ------
    LaserFormatError
        The file cannot be used as a whole.
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
    start = path.read_bytes()[:4096]
    if b"HEADER::" in start and b"\nData:" in start:
        raise LaserFormatError(
            f"{path}: a dynamic capture has no targets; read it with interferometry.io.renishaw.read_rtx"
        )
    if b"HEADER::" in start:
        return read_rtl(path, feed_mm_per_min=feed_mm_per_min, dwell_s=dwell_s)
    if is_ecmc_log(start):
        return read_ecmc_log(path)
    return _read_deviations_csv(path)


def _read_deviations_csv(path: Path) -> xr.Dataset:
    table = read_table(path, DEVIATION_COLUMNS)
    readings, left_out, zones, unreadable = _parse_readings(table)
    raise_if_mostly_invalid(path, len(readings), left_out)
    readings, duplicates = _drop_duplicates(path, readings, left_out)
    readings = _drop_misplaced(path, readings, left_out)
    readings = _drop_wrong_times(path, readings, left_out)
    _check_cycles(path, readings)
    time_reference = describe_time_zone(path, zones)
    deviations = _assemble(readings)
    deviations = _flag_cells(deviations, UNREADABLE, unreadable)
    deviations = _flag_cells(deviations, DUPLICATE, duplicates)
    deviations = set_flag(deviations, OUT_OF_ORDER, detect_out_of_order(deviations))
    deviations["time"].attrs.update(origin="recorded", reference=time_reference)
    ignored = [name for name in table.columns if name not in DEVIATION_COLUMNS]
    deviations.attrs.update(
        source=path.name,
        left_out=json.dumps([asdict(line) for line in left_out]),
        missing=int(np.isnan(deviations["deviation"].values).sum()),
        columns_ignored=json.dumps(ignored),
    )
    return deviations


def _parse_readings(
    table: DelimitedTable,
) -> tuple[list[_Reading], list[RejectedLine], dict[str, int], set[tuple[int, str, int]]]:
    readings: list[_Reading] = []
    left_out: list[RejectedLine] = []
    zones: dict[str, int] = {}
    unreadable: set[tuple[int, str, int]] = set()
    for line, fields in table.records():
        cell: tuple[int, str, int] | None = None
        try:
            if fields is None:
                raise BadReading("", f"does not have {len(table.columns)} fields")
            direction = fields["direction"].strip().lower()
            if direction not in DIRECTIONS:
                raise BadReading(fields["direction"], "is neither 'positive' nor 'negative'")
            cell = (table.count(fields["cycle"]), direction, table.count(fields["target"]))
            time, zone = parse_time(fields["time"])
            reading = _Reading(
                line, *cell, table.number(fields["position_mm"]), time, table.number(fields["deviation_um"])
            )
        except BadReading as fault:
            left_out.append(RejectedLine(table.path.name, line, fault.value, fault.reason))
            if cell is not None:
                unreadable.add(cell)
            continue
        zones.setdefault(zone, line)
        readings.append(reading)
    return readings, left_out, zones, unreadable


def _drop_duplicates(
    path: Path, readings: list[_Reading], left_out: list[RejectedLine]
) -> tuple[list[_Reading], set[tuple[int, str, int]]]:
    first: dict[tuple[int, str, int], _Reading] = {}
    repeated: set[tuple[int, str, int]] = set()
    for reading in readings:
        cell = (reading.cycle, reading.direction, reading.target)
        if cell in first:
            repeated.add(cell)
            reason = (
                f"cycle {reading.cycle} {reading.direction} target {reading.target} already stands on line {first[cell].line}, "
                "which is kept"
            )
            left_out.append(RejectedLine(path.name, reading.line, str(reading.deviation), reason))
        else:
            first[cell] = reading
    return list(first.values()), repeated


def _drop_misplaced(path: Path, readings: list[_Reading], left_out: list[RejectedLine]) -> list[_Reading]:
    """Leave out readings whose position is not the one that 90 % of their target's readings have."""
    by_target: dict[int, list[_Reading]] = defaultdict(list)
    for reading in readings:
        by_target[reading.target].append(reading)
    kept: list[_Reading] = []
    for target, group in sorted(by_target.items()):
        typical = float(np.median([reading.position for reading in group]))
        off = [reading for reading in group if abs(reading.position - typical) > POSITION_TOLERANCE_MM]
        if len(off) > max(1, 0.1 * len(group)):
            raise LaserFormatError(
                f"{path}: target {target} stands at {off[0].position} mm on line {off[0].line} but at {typical} mm elsewhere "
                f"({len(off)} of {len(group)} readings disagree); position_mm is the programmed position, the same in every cycle"
            )
        for reading in off:
            reason = f"target {target} stands at {typical} mm elsewhere"
            left_out.append(RejectedLine(path.name, reading.line, str(reading.position), reason))
        kept += [reading for reading in group if reading not in off]
    positions = {target: group[0].position for target, group in by_target.items()}
    for first, second in itertools.pairwise(sorted(positions, key=positions.__getitem__)):
        if abs(positions[first] - positions[second]) <= POSITION_TOLERANCE_MM:
            raise LaserFormatError(
                f"{path}: targets {first} and {second} both stand at {positions[first]} mm; number each position once"
            )
    return kept


def _drop_wrong_times(path: Path, readings: list[_Reading], left_out: list[RejectedLine]) -> list[_Reading]:
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


def _cycle_centres(readings: Sequence[_Reading]) -> dict[int, float]:
    times: dict[int, list[int]] = defaultdict(list)
    for reading in readings:
        times[reading.cycle].append(int(reading.time.astype("i8")))
    return {cycle: float(np.median(values)) for cycle, values in times.items()}


def _check_cycles(path: Path, readings: list[_Reading]) -> None:
    """Raise where cycles run backwards or overlap in time."""
    ends: dict[int, tuple[_Reading, _Reading]] = {}
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


def _assemble(readings: Sequence[_Reading]) -> xr.Dataset:
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


def _flag_cells(deviations: xr.Dataset, flag: Flag, cells: set[tuple[int, str, int]]) -> xr.Dataset:
    where = np.zeros(deviations["deviation"].shape, dtype=bool)
    cycles, targets = deviations["cycle"].values.tolist(), deviations["target"].values.tolist()
    for cycle, direction, target in cells:
        if cycle in cycles and target in targets:
            where[cycles.index(cycle), DIRECTIONS.index(direction), targets.index(target)] = True
    return set_flag(deviations, flag, where)


def read_environment(path: str | Path) -> xr.Dataset:
    r"""Read logged air and material conditions from a CSV file.

    Parameters
    ----------
    path : str or pathlib.Path
        With the columns time (ISO 8601), air_temperature_degC, air_pressure_hPa, relative_humidity_percent and
        material_temperature_degC.

    Returns
    -------
    xarray.Dataset
        Dim time (UTC, increasing): ``air_temperature`` and ``material_temperature`` (degC), ``air_pressure`` (hPa),
        ``relative_humidity`` (percent); ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason).

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
    table = read_table(path, ("time", *(column for column, *_ in ENVIRONMENT_COLUMNS)))
    on_scale = {"units_metadata": "temperature: on_scale"}
    variables = {
        name: {"units": unit, **(on_scale if unit == "degC" else {})} for _, name, unit, _, _ in ENVIRONMENT_COLUMNS
    }

    def parse(fields: dict[str, str]) -> list[float]:
        return [_plausible(table, column, fields[column], low, high) for column, _, _, low, high in ENVIRONMENT_COLUMNS]

    return read_timed_rows(table, variables, parse)


def _plausible(table: DelimitedTable, column: str, text: str, low: float, high: float) -> float:
    value = table.number(text)
    if not low <= value <= high:
        raise BadReading(text, f"lies outside {low:g} .. {high:g}, the range of {column} in its unit")
    return value
