"""Laser and environment files to Datasets; every line that cannot be used is listed, none is dropped in silence."""

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
    sort_readings,
)
from interferometry.io.delimited import (
    BadReading,
    LaserFormatError,
    Rejected,
    Table,
    join_zones,
    parse_time,
    read_table,
    read_timed_rows,
    refuse_hopeless,
)
from interferometry.io.ecmc import is_ecmc_log, read_ecmc_log
from interferometry.io.renishaw import read_rtl

__all__ = ["LaserFormatError", "Rejected", "read_deviations", "read_environment", "sort_readings"]

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
    """Read deviations from a CSV file, a Renishaw .rtl, or a log of a positioning test (ISO 230-2 .dat).

    Parameters
    ----------
    path : str or pathlib.Path
        The kind of file is told from its content.
    feed_mm_per_min, dwell_s : float, optional
        Feed between targets and time at rest at each: with them the times of readings that a .rtl does not hold are rebuilt
        more closely. Ignored where every reading has its own time.

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``: deviation in um and time in UTC (cycle, direction, target), position in mm (target),
        quality_flag. ``attrs["left_out"]`` is a JSON list of the lines left out (path, line, value, reason);
        ``time.attrs["origin"]`` is "recorded" or "reconstructed", and where it was rebuilt ``time_u`` is its standard
        uncertainty in s.

    Raises
    ------
    LaserFormatError
        The file cannot be used as a whole.
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
    refuse_hopeless(path, len(readings), left_out)
    readings, duplicates = _drop_duplicates(path, readings, left_out)
    readings = _drop_misplaced(path, readings, left_out)
    readings = _drop_wrong_times(path, readings, left_out)
    _check_cycles(path, readings)
    time_reference = join_zones(path, zones)
    deviations = _assemble(readings)
    deviations = _flag_cells(deviations, UNREADABLE, unreadable)
    deviations = _flag_cells(deviations, DUPLICATE, duplicates)
    deviations = set_flag(deviations, OUT_OF_ORDER, detect_out_of_order(deviations))
    deviations["time"].attrs.update(origin="recorded", reference=time_reference)
    ignored = [name for name in table.columns if name not in DEVIATION_COLUMNS]
    deviations.attrs.update(
        source=path.name,
        left_out=json.dumps([asdict(one) for one in left_out]),
        missing=int(np.isnan(deviations["deviation"].values).sum()),
        columns_ignored=json.dumps(ignored),
    )
    return deviations


def _parse_readings(table: Table) -> tuple[list[_Reading], list[Rejected], dict[str, int], set[tuple[int, str, int]]]:
    readings: list[_Reading] = []
    left_out: list[Rejected] = []
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
            left_out.append(Rejected(table.path.name, line, fault.value, fault.reason))
            if cell is not None:
                unreadable.add(cell)
            continue
        zones.setdefault(zone, line)
        readings.append(reading)
    return readings, left_out, zones, unreadable


def _drop_duplicates(
    path: Path, readings: list[_Reading], left_out: list[Rejected]
) -> tuple[list[_Reading], set[tuple[int, str, int]]]:
    first: dict[tuple[int, str, int], _Reading] = {}
    repeated: set[tuple[int, str, int]] = set()
    for one in readings:
        cell = (one.cycle, one.direction, one.target)
        if cell in first:
            repeated.add(cell)
            reason = f"cycle {one.cycle} {one.direction} target {one.target} already stands on line {first[cell].line}, which is kept"
            left_out.append(Rejected(path.name, one.line, str(one.deviation), reason))
        else:
            first[cell] = one
    return list(first.values()), repeated


def _drop_misplaced(path: Path, readings: list[_Reading], left_out: list[Rejected]) -> list[_Reading]:
    """Leave out readings whose position is not the one that 90 % of their target's readings have."""
    by_target: dict[int, list[_Reading]] = defaultdict(list)
    for one in readings:
        by_target[one.target].append(one)
    kept: list[_Reading] = []
    for target, group in sorted(by_target.items()):
        usual = float(np.median([one.position for one in group]))
        off = [one for one in group if abs(one.position - usual) > POSITION_TOLERANCE_MM]
        if len(off) > max(1, 0.1 * len(group)):
            raise LaserFormatError(
                f"{path}: target {target} stands at {off[0].position} mm on line {off[0].line} but at {usual} mm elsewhere "
                f"({len(off)} of {len(group)} readings disagree); position_mm is the programmed position, the same in every cycle"
            )
        for one in off:
            left_out.append(
                Rejected(path.name, one.line, str(one.position), f"target {target} stands at {usual} mm elsewhere")
            )
        kept += [one for one in group if one not in off]
    places = {target: group[0].position for target, group in by_target.items()}
    for first, second in zip(
        sorted(places, key=places.__getitem__), sorted(places, key=places.__getitem__)[1:], strict=False
    ):
        if abs(places[first] - places[second]) <= POSITION_TOLERANCE_MM:
            raise LaserFormatError(
                f"{path}: targets {first} and {second} both stand at {places[first]} mm; number each position once"
            )
    return kept


def _drop_wrong_times(path: Path, readings: list[_Reading], left_out: list[Rejected]) -> list[_Reading]:
    """Leave out single readings whose time lies beyond the middle of the neighbouring cycles."""
    centres = _cycle_centres(readings)
    numbers = sorted(centres)
    if len(numbers) < 2:
        return readings
    steps = np.diff([centres[number] for number in numbers])
    if np.any(steps <= 0):
        return readings
    usual = float(np.median(steps))
    bounds: dict[int, tuple[float, float]] = {}
    for at, number in enumerate(numbers):
        early = centres[numbers[at - 1]] if at else centres[number] - usual
        late = centres[numbers[at + 1]] if at + 1 < len(numbers) else centres[number] + usual
        bounds[number] = (early, late)
    kept = []
    for one in readings:
        if bounds[one.cycle][0] <= one.time.astype("i8") <= bounds[one.cycle][1]:
            kept.append(one)
        else:
            left_out.append(Rejected(path.name, one.line, str(one.time), f"is not a time within cycle {one.cycle}"))
    return kept


def _cycle_centres(readings: Sequence[_Reading]) -> dict[int, float]:
    times: dict[int, list[int]] = defaultdict(list)
    for one in readings:
        times[one.cycle].append(int(one.time.astype("i8")))
    return {cycle: float(np.median(values)) for cycle, values in times.items()}


def _check_cycles(path: Path, readings: list[_Reading]) -> None:
    """Raise where cycles run backwards or overlap in time."""
    ends: dict[int, tuple[_Reading, _Reading]] = {}
    for one in readings:
        low, high = ends.get(one.cycle, (one, one))
        ends[one.cycle] = (min(low, one, key=lambda r: r.time), max(high, one, key=lambda r: r.time))
    numbers = sorted(ends)
    for number, following in itertools.pairwise(numbers):
        last, first = ends[number][1], ends[following][0]
        if first.time <= last.time:
            raise LaserFormatError(
                f"{path}: cycle {following} begins at {first.time} (line {first.line}) before cycle {number} ends at {last.time} "
                f"(line {last.line}); cycles must follow each other in time: correct the cycle numbers or the clock"
            )


def _assemble(readings: Sequence[_Reading]) -> xr.Dataset:
    cycles = sorted({one.cycle for one in readings})
    position = {one.target: one.position for one in readings}
    targets = sorted(position)
    row = {cycle: at for at, cycle in enumerate(cycles)}
    column = {target: at for at, target in enumerate(targets)}
    deviation = np.full((len(cycles), 2, len(targets)), np.nan)
    time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    for one in readings:
        at = row[one.cycle], DIRECTIONS.index(one.direction), column[one.target]
        deviation[at], time[at] = one.deviation, one.time
    return build_deviations(cycles, targets, np.array([position[target] for target in targets]), deviation, time)


def _flag_cells(deviations: xr.Dataset, flag: Flag, cells: set[tuple[int, str, int]]) -> xr.Dataset:
    where = np.zeros(deviations["deviation"].shape, dtype=bool)
    cycles, targets = deviations["cycle"].values.tolist(), deviations["target"].values.tolist()
    for cycle, direction, target in cells:
        if cycle in cycles and target in targets:
            where[cycles.index(cycle), DIRECTIONS.index(direction), targets.index(target)] = True
    return set_flag(deviations, flag, where)


def read_environment(path: str | Path) -> xr.Dataset:
    """Read logged air and material conditions from a CSV file.

    Returns
    -------
    xarray.Dataset
        Dim time (UTC, sorted): air_temperature and material_temperature in degC, air_pressure in hPa, relative_humidity in
        percent; ``attrs["left_out"]`` lists the lines left out.

    Raises
    ------
    LaserFormatError
        A column is missing, or more lines are bad than good.
    """
    path = Path(path)
    table = read_table(path, ("time", *(column for column, *_ in ENVIRONMENT_COLUMNS)))
    on_scale = {"units_metadata": "temperature: on_scale"}
    variables = {
        name: {"units": unit, **(on_scale if unit == "degC" else {})} for _, name, unit, _, _ in ENVIRONMENT_COLUMNS
    }

    def parse(fields: dict[str, str]) -> list[float]:
        return [_plausible(table, fields[column], low, high) for column, _, _, low, high in ENVIRONMENT_COLUMNS]

    return read_timed_rows(table, variables, parse)


def _plausible(table: Table, text: str, low: float, high: float) -> float:
    value = table.number(text)
    if not low <= value <= high:
        raise BadReading(text, f"lies outside {low:g} .. {high:g}, the range of this column's unit")
    return value
