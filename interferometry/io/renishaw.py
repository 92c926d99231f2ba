"""Readers of Renishaw linear tests (.rtl), and of logs (.dat) and reports (.md) of the ecmc test tools."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from interferometry.deviations import DIRECTIONS, build_deviations
from interferometry.io.faults import (
    SENTINEL_MAGNITUDE,
    BadReading,
    LaserFormatError,
    LeftOut,
    parse_number,
    raise_if_too_many,
)
from interferometry.io.tables import NO_ZONE, decode_text, encoding_of, read_heading

#: Bytes by which the file of a laser program is told.
START_BYTES = 4096

# Logs of positioning tests as the ecmc test tools write them: assignments such as
# ``REF_DATA_FWD[target,cycle]=value``.

_ASSIGNMENT = re.compile(r"^(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD|UNIT|CYCLES|POSITIONS)(?:\[(\d+)(?:,(\d+))?\])?=(.*)$")
_UM_PER_UNIT = {"mm": 1e3, "um": 1.0, "m": 1e6}
#: Digits of the number of a target or cycle; a damaged file may name the billionth.
_MOST_DIGITS = 5
_DIRECTION = {"REF_DATA_FWD": 0, "REF_DATA_BWD": 1}
#: Words of the heading above a table of a report, and what an assignment of its values is called in a log.
_REPORTED = {"Data forward direction": "REF_DATA_FWD", "Data backward direction": "REF_DATA_BWD"}
#: Line and its text; name, target and cycle of a value (the numbers as text, None of what is stated of the test), and the value.
_Entry = tuple[int, str, str, str | None, str | None, str]


def is_ecmc_log(start: bytes) -> bool:
    """Return whether a file is such a log."""
    return b"REF_DATA_FWD[" in start or b"TGT_DATA[" in start


def read_ecmc_log(path: Path) -> xr.Dataset:
    """Read a log that holds target and measured positions, but no times."""
    lines = enumerate(decode_text(path, path.read_bytes()).splitlines(), start=1)
    found = [(line, text, match) for line, text in lines if (match := _ASSIGNMENT.match(text.strip()))]
    return _assemble_ecmc(path, ((line, text, one[1], one[2], one[3], one[4]) for line, text, one in found))


def is_ecmc_report(start: bytes) -> bool:
    """Return whether a file is a report with the targets and measured positions in tables of Markdown."""
    return b"tgt_pos(i)" in start


def read_ecmc_report(path: Path) -> xr.Dataset:
    """Read the first two tables of a report, forward and backward, with one line per target and one column per cycle."""
    name, units = "", list[str | None]()
    found: list[_Entry] = []
    for line, text in enumerate(decode_text(path, path.read_bytes()).splitlines(), start=1):
        fields = [field.strip() for field in text.strip().strip("|").split("|")]
        if text.startswith("#"):
            name, units = next((name for word, name in _REPORTED.items() if word in text), ""), []
        elif text.startswith("i ") and "tgt_pos" in text and "ref_pos" in text:
            units = [unit.name if (unit := read_heading(field).unit) else None for field in fields[1:]]
            found.append((line, text, "UNIT", None, None, units[0] or "none"))
        elif name and units and fields[0].isdecimal():
            if len(fields) != len(units) + 1 or len(set(units)) > 1:
                raise LaserFormatError(
                    f"{path}, line {line}: {text!r} is no line of a target and {len(units)} positions in one unit"
                )
            found.append((line, text, "TGT_DATA", fields[0], None, fields[1]))
            found += [
                (line, text, name, fields[0], str(cycle), value) for cycle, value in enumerate(fields[2:], start=1)
            ]
    note = (
        "warning: forward and backward are those of the report, and the public programs that write it exchange them; take the log (.dat) "
        "where the sign of the reversal matters"
    )
    return _assemble_ecmc(path, found).assign_attrs(notes=json.dumps([note]))


def _assemble_ecmc(path: Path, entries: Iterable[_Entry]) -> xr.Dataset:
    """Return the deviations that what was stated of a test gives."""
    stated: dict[str, str] = {}
    target_at: dict[int, float] = {}
    readings: dict[tuple[int, int, int], float] = {}
    left_out = LeftOut(path)
    for line, text, name, target, cycle, value in entries:
        if target is None:
            stated[name] = value.strip()
            continue
        with left_out.collect(line):
            number = parse_number(value)
            needed = [target] if name == "TGT_DATA" else [target, cycle]
            if not all(index and len(index) <= _MOST_DIGITS and int(index) > 0 for index in needed):
                raise BadReading(text, "names no target or cycle from 1")
            if name == "TGT_DATA":
                stated_before = target_at.setdefault(int(target), number)
            else:
                stated_before = readings.setdefault((int(cycle or 0) - 1, _DIRECTION[name], int(target) - 1), number)
            if stated_before != number:
                raise BadReading(text, f"is stated before as {stated_before:g}; the first is kept")
    unit = stated.get("UNIT", "mm")
    if unit not in _UM_PER_UNIT:
        raise LaserFormatError(f"{path}: UNIT={unit} is not known; use one of {', '.join(_UM_PER_UNIT)}")
    cycles, targets = _counts(path, stated, target_at, readings)
    raise_if_too_many(path, cycles, targets)
    scale = _UM_PER_UNIT[unit]
    position = np.array([target_at[target] for target in range(1, targets + 1)])
    deviation = np.full((cycles, 2, targets), np.nan)
    for index, measured in readings.items():
        deviation[index] = (measured - position[index[2]]) * scale
    time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    dataset = build_deviations(range(1, cycles + 1), range(1, targets + 1), position * scale / 1e3, deviation, time)
    dataset["time"].attrs.update(origin="none", reference="the file holds no times")
    left_out.note_in(dataset)
    return dataset


def _counts(
    path: Path, stated: dict[str, str], target_at: dict[int, float], readings: dict[tuple[int, int, int], float]
) -> tuple[int, int]:
    """Return the numbers of cycles and targets, after comparing those that were read with those that the file states."""
    if not target_at or not readings:
        raise LaserFormatError(f"{path}: no TGT_DATA or no REF_DATA_FWD/REF_DATA_BWD; export the test again")
    targets, cycles = max(target_at), max(index[0] for index in readings) + 1
    if sorted(target_at) != list(range(1, targets + 1)) or max(index[2] for index in readings) + 1 > targets:
        raise LaserFormatError(
            f"{path}: TGT_DATA gives targets {sorted(target_at)}, but readings refer to others; give each its position"
        )
    empty = sorted(set(range(cycles)) - {index[0] for index in readings})
    if empty:
        raise LaserFormatError(
            f"{path}: there is a cycle {cycles}, but no reading of cycle {empty[0] + 1}; the file is damaged, export the test again"
        )
    for name, count in (("CYCLES", cycles), ("POSITIONS", targets)):
        if name in stated and stated[name] != str(count):
            raise LaserFormatError(
                f"{path}: {name}={stated[name]}, but {count} were found; the file is cut short or joined from two, export the test again"
            )
    return cycles, targets


#: A temperature sensor that is not connected reads -10 degC.
UNCONNECTED_DEGC = -10.0
USER_TEXT = ("machine", "serial_number", "date", "by", "axis", "location", "title")
#: "2014-10-08 10:53:49"; the last digit of the seconds may be lost to a control byte.
_TIME = re.compile(r"(\d{4})[-/.](\d\d)[-/.](\d\d)[ T]+(\d\d):(\d\d):(\d)(\d?)")
#: "10:46 Dec 12 2016", without seconds.
_TIME_WITHOUT_SECONDS = re.compile(r"(\d\d):(\d\d) ([A-Z][a-z]{2}) (\d\d?) (\d{4})")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


#: Name of a section -> its lines with their numbers.
_Sections = dict[str, list[tuple[int, str]]]


@dataclass
class _Run:
    """One run of the DEVIATIONS block: its targets and deviations in measuring order."""

    number: int
    targets: list[int] = field(default_factory=list)
    deviations: list[float] = field(default_factory=list)

    @property
    def is_empty(self) -> bool:
        return not any(math.isfinite(value) for value in self.deviations)


def read_rtl(path: Path, feed_mm_per_min: float | None = None, dwell_s: float | None = None) -> xr.Dataset:
    """Read a Renishaw linear test."""
    content = path.read_bytes()
    text = content.decode(encoding_of(content) or "latin-1", "replace")
    if "\ndata:" in text[:START_BYTES].lower():
        raise LaserFormatError(
            f"{path}: a dynamic capture (.rtx) has no target positions; name the file of a linear test (.rtl)"
        )
    sections = _split_sections(path, text)
    kind = _keyed(sections.get("HEADER", [])).get("filetype", "rtl")
    if kind.lower() != "rtl":
        raise LaserFormatError(
            f"{path}: File type is {kind}, not rtl; only linear tests hold positioning deviations in um: name the file of that test"
        )
    targets = _parse_targets(path, sections)
    runs, left_out = _parse_runs(path, sections, len(targets))
    # The second of the flags says that the test was measured in one direction.
    flags = _keyed(sections["TARGET DATA"]).get("flags", "").split()
    notes = _clear_filled_runs(runs, unidirectional=flags[1:2] == ["1"])
    start, end, start_u = _parse_test_times(sections)
    schedule, schedule_u = _rebuild_schedule(runs, targets, start, end, feed_mm_per_min, dwell_s)
    deviation, seconds = _lay_out(path, runs, targets, schedule)
    time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    if start is not None:
        taken = np.isfinite(seconds)
        time[taken] = start + (seconds[taken] * 1e9).astype("timedelta64[ns]")
    cycles = deviation.shape[0]
    dataset = build_deviations(range(1, cycles + 1), range(1, len(targets) + 1), targets, deviation, time)
    if start is None:
        dataset["time"].attrs.update(origin="none", reference="the file holds no start and end that can be read")
    else:
        dataset["time"].attrs.update(origin="reconstructed", reference=NO_ZONE)
        named = {"units": "s", "long_name": "standard uncertainty of time"}
        dataset["time_u"] = ((), math.hypot(start_u, schedule_u), named)
    dataset = dataset.assign(_parse_environment(sections))
    # Keys of the user text are localised, their order is not.
    values = [content.split(":", 1)[1].strip() for _, content in sections.get("USER-TEXT", []) if ":" in content]
    left_out.note_in(dataset)
    dataset.attrs.update(
        runs_empty=json.dumps([run.number for run in runs if run.is_empty]),
        notes=json.dumps(notes),
        user_text=json.dumps(dict(zip(USER_TEXT, values, strict=False))),
    )
    return dataset


def _lay_out(
    path: Path, runs: list[_Run], targets: np.ndarray, schedule: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return deviations in um and seconds since the start, (cycle, direction, target), from the runs in measuring order."""
    directions = [_direction(run, targets) for run in runs]
    cycles = [directions[: i + 1].count(direction) for i, direction in enumerate(directions)]
    raise_if_too_many(path, max(cycles, default=1), len(targets))
    deviation = np.full((max(cycles, default=1), 2, len(targets)), np.nan)
    seconds = np.full(deviation.shape, np.nan)
    for run, direction, cycle, instants in zip(runs, directions, cycles, schedule, strict=True):
        for target, value, instant in zip(run.targets, run.deviations, instants, strict=True):
            index = cycle - 1, DIRECTIONS.index(direction), target - 1
            deviation[index], seconds[index] = value, instant if math.isfinite(value) else math.nan
    return deviation, seconds


def _split_sections(path: Path, text: str) -> _Sections:
    sections: _Sections = {}
    current: list[tuple[int, str]] = []
    for line, content in enumerate(re.split(r"\r\n|\n|\r", text), start=1):
        if content.rstrip().endswith("::") and content[:1].isalpha():
            current = sections.setdefault(" ".join(content.upper().strip(" :\t").split()), [])
        elif content.strip():
            current.append((line, content))
    for name in ("TARGET DATA", "DEVIATIONS", "EOF"):
        if name not in sections:
            raise LaserFormatError(
                f"{path}: no section {name}::; the file is cut short, copy it again from the measuring computer"
            )
    return sections


def _clear_filled_runs(runs: list[_Run], unidirectional: bool) -> list[str]:
    """Take the zeros with which some programs fill the reverse runs of a unidirectional test as missing; return what to tell."""
    zero = [run for run in runs if run.deviations and all(value == 0 for value in run.deviations)]
    if not zero or len(zero) == len(runs):
        return []
    named = ", ".join(str(run.number) for run in zero)
    if not unidirectional:
        return [f"warning: every reading of run {named} is 0: was it filled in instead of measured?"]
    for run in zero:
        run.deviations = [math.nan] * len(run.deviations)
    return [
        f"run {named} holds nothing but zeros and the flags say that one direction was measured: taken as not measured"
    ]


def _keyed(section: list[tuple[int, str]]) -> dict[str, str]:
    """Return values by key, letter case and spaces of the key ignored ("Date Time" and "DateTime" both occur)."""
    return {key: value for key, (_, value) in _keyed_lines(section).items()}


def _keyed_lines(section: list[tuple[int, str]]) -> dict[str, tuple[int, str]]:
    """Return the line number and the value by key, as `_keyed`; of a key that comes twice the last."""
    pairs = ((line, content.partition(":")) for line, content in section if ":" in content)
    return {_key(name): (line, value.strip()) for line, (name, _, value) in pairs}


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _parse_targets(path: Path, sections: _Sections) -> np.ndarray:
    section = sections["TARGET DATA"]
    count = _whole(path, section, "Target-count", 0)
    begin = next(
        (i for i, (_, content) in enumerate(section) if re.match(r"targets\s*:", content, re.IGNORECASE)), None
    )
    numbers: list[float] = []
    for line, content in section[begin + 1 :] if begin is not None else []:
        if ":" in content:
            break
        try:
            numbers += [parse_number(word) for word in content.replace(",", ".").split()]
        except BadReading:
            raise LaserFormatError(
                f"{path}, line {line}: {content.strip()!r} is not a row of target positions in mm; copy the file again"
            ) from None
    if len(numbers) != count or count == 0:
        raise LaserFormatError(
            f"{path}: Target-count is {count}, but {len(numbers)} target positions follow; the file is damaged, "
            "copy it again from the measuring computer"
        )
    return np.array(numbers)


def _whole(path: Path, section: list[tuple[int, str]], name: str, default: int) -> int:
    """Return the whole number that a line of a section gives, `default` where there is no such line."""
    line, text = _keyed_lines(section).get(_key(name), (0, ""))
    if not text:
        return default
    if not re.fullmatch(r"\d{1,9}", text):
        raise LaserFormatError(
            f"{path}, line {line}: {name} is {text!r} and not a whole number; copy the file again from the measuring computer"
        )
    return int(text)


def _decimal(word: str) -> float:
    """Return a number of any size; ValueError where the word is none, as "1_2.5", which Python would read as 12.5."""
    value = float("" if "_" in word else word.replace("\u2212", "-"))
    if math.isnan(value):
        raise ValueError(word)
    return value


def _parse_runs(path: Path, sections: _Sections, targets: int) -> tuple[list[_Run], LeftOut]:
    runs: dict[int, _Run] = {}
    left_out = LeftOut(path)
    for line, content in sections["DEVIATIONS"]:
        words = content.replace(",", ".").split()
        if words[0].lower() == "run":
            continue
        try:
            run, target, value = int(words[0]), int(words[1]), _decimal(words[2])
        except (ValueError, IndexError):
            left_out.add(line, content.strip(), "is not 'run target deviation'")
            continue
        rows = runs.get(run) or _Run(run)
        if not 1 <= target <= targets or run < 1:
            left_out.add(line, content.strip(), f"names no run from 1 or no target of 1..{targets}")
        elif target in rows.targets:
            left_out.add(line, content.strip(), f"repeats run {run} target {target}, the first is kept")
        else:
            runs[run] = rows
            rows.targets.append(target)
            rows.deviations.append(value if abs(value) < SENTINEL_MAGNITUDE else math.nan)
    stated = _whole(path, sections.get("RUNS", []), "Run-count", max(runs, default=0))
    if not runs or max(runs) > stated:
        raise LaserFormatError(
            f"{path}: Run-count is {stated}, but DEVIATIONS holds runs {sorted(runs)}; the file is damaged, "
            "copy it again from the measuring computer"
        )
    return [runs[number] for number in sorted(runs)], left_out


def _direction(run: _Run, targets: np.ndarray) -> str:
    """Return the direction of approach: by the order of the positions, by odd or even number where a run has one target."""
    travel = targets[run.targets[-1] - 1] - targets[run.targets[0] - 1]
    if travel == 0:
        return DIRECTIONS[(run.number - 1) % 2]
    return DIRECTIONS[0] if travel > 0 else DIRECTIONS[1]


def _parse_test_times(sections: _Sections) -> tuple[np.datetime64 | None, np.datetime64 | None, float]:
    """Return start, end and the standard uncertainty of the start in s: 10 or 60 s / sqrt(12) where a digit or the seconds are lost."""
    text = _keyed(sections.get("ENVIRONMENT", [])).get("datetime", "")
    times, lost = [], 0.0
    try:
        for year, month, day, hour, minute, tens, ones in _TIME.findall(text):
            lost = math.hypot(lost, 0.0 if ones else 10 / math.sqrt(12))
            times.append(np.datetime64(f"{year}-{month}-{day}T{hour}:{minute}:{tens}{ones or 5}", "ns"))
        for hour, minute, month, day, year in _TIME_WITHOUT_SECONDS.findall(text):
            lost = math.hypot(lost, 60 / math.sqrt(12))
            number = _MONTHS.index(month) + 1
            times.append(np.datetime64(f"{year}-{number:02d}-{int(day):02d}T{hour}:{minute}:30", "ns"))
    except ValueError:
        return None, None, 0.0
    if len(times) != 2 or not times[0] <= times[1]:
        return None, None, 0.0
    return times[0], times[1], lost


def _rebuild_schedule(
    runs: list[_Run],
    targets: np.ndarray,
    start: np.datetime64 | None,
    end: np.datetime64 | None,
    feed_mm_per_min: float | None,
    dwell_s: float | None,
) -> tuple[list[np.ndarray], float]:
    """Return, per run, seconds since the start of the test, and their standard uncertainty."""
    measured = [run for run in runs if not run.is_empty]
    count = sum(len(run.targets) for run in measured)
    duration = float((end - start) / np.timedelta64(1, "s")) if start is not None and end is not None else 0.0
    step = duration / max(count, 1)
    turn = step
    travel: dict[int, np.ndarray] = {run.number: np.full(len(run.targets) - 1, step) for run in measured}
    if feed_mm_per_min and dwell_s is not None and measured:
        for run in measured:
            travel[run.number] = np.abs(np.diff(targets[np.array(run.targets) - 1])) / feed_mm_per_min * 60 + dwell_s
        moving = sum(float(times.sum()) for times in travel.values())
        turn = (duration - moving) / len(measured)
        if turn < 0:
            travel = {number: times * duration / moving for number, times in travel.items()}
            turn = 0.0
    now, schedule = 0.0, []
    for run in runs:
        if run.is_empty:
            schedule.append(np.full(len(run.targets), np.nan))
            continue
        instants = now + turn + np.concatenate([[0.0], np.cumsum(travel[run.number])])
        now = float(instants[-1])
        schedule.append(instants)
    return schedule, max(step, turn) / (2 * math.sqrt(3))


def _parse_environment(sections: _Sections) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
    keyed = _keyed(sections.get("ENVIRONMENT", []))
    wanted = (
        ("airtemp", "air_temperature", "degC", 1.0),
        ("airpress", "air_pressure", "hPa", 10.0),
        ("airhumid", "relative_humidity", "percent", 1.0),
        ("envfactor", "environment_factor", "um", 1.0),
        ("expcoeff", "expansion_coefficient", "ppm/K", 1.0),
    )
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = {}
    for key, name, unit, scale in wanted:
        if key in keyed:
            variables[name] = (("instant",), _pair(keyed[key]) * scale, {"units": unit})
    material = [_pair(keyed[f"mattemp{sensor}"]) for sensor in (1, 2, 3) if f"mattemp{sensor}" in keyed]
    if material:
        data = np.where(np.array(material) == UNCONNECTED_DEGC, np.nan, material)
        variables["material_temperature"] = (("sensor", "instant"), data, {"units": "degC"})
    return variables


def _pair(text: str) -> np.ndarray:
    """Return the start and end values of one line of the ENVIRONMENT block (a status may follow them); NaN for what is no number."""
    values = []
    for word in text.replace(",", ".").split()[:2]:
        try:
            values.append(parse_number(word))
        except BadReading:
            values.append(math.nan)
    return np.array([*values, math.nan, math.nan][:2])
