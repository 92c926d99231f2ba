"""Logs of positioning tests as the ecmc test tools write them: assignments such as ``REF_DATA_FWD[target,cycle]=value``."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import xarray as xr

from interferometry.deviations import build_deviations
from interferometry.io.encodings import decode_text
from interferometry.io.faults import BadReading, LaserFormatError, RejectedLine
from interferometry.io.numerals import parse_number

_ASSIGNMENT = re.compile(r"^(TGT_DATA|REF_DATA_FWD|REF_DATA_BWD|UNIT|CYCLES|POSITIONS)(?:\[(\d+)(?:,(\d+))?\])?=(.*)$")
_UM_PER_UNIT = {"mm": 1e3, "um": 1.0, "m": 1e6}
#: Digits of the number of a target or cycle; a damaged file may name the billionth.
_MOST_DIGITS = 5
_DIRECTION = {"REF_DATA_FWD": 0, "REF_DATA_BWD": 1}


def is_ecmc_log(start: bytes) -> bool:
    """Return whether a file is such a log.

    Parameters
    ----------
    start : bytes
        The first bytes of the file; some thousand are enough.

    Returns
    -------
    bool
    """
    return b"REF_DATA_FWD[" in start or b"TGT_DATA[" in start


def read_ecmc_log(path: Path) -> xr.Dataset:
    """Read a log that holds target and measured positions, but no times.

    Parameters
    ----------
    path : pathlib.Path

    Returns
    -------
    xarray.Dataset
        Keeps ``contract.DEVIATIONS``; deviations are measured minus target position, forward is the positive direction; every time is
        NaT (``time.attrs["origin"]`` is "none").

    Raises
    ------
    LaserFormatError
        The unit is unknown, or targets or cycles differ from the counts that the file states.
    """
    stated: dict[str, str] = {}
    target_at: dict[int, float] = {}
    readings: dict[tuple[int, int, int], float] = {}
    left_out: list[RejectedLine] = []
    for line, text in enumerate(decode_text(path, path.read_bytes()).splitlines(), start=1):
        match = _ASSIGNMENT.match(text.strip())
        if match is None:
            continue
        name, target, cycle, value = match.groups()
        if target is None:
            stated[name] = value.strip()
            continue
        try:
            number = parse_number(value)
        except BadReading as fault:
            left_out.append(RejectedLine(path.name, line, value, fault.reason))
            continue
        needed = [target] if name == "TGT_DATA" else [target, cycle]
        if not all(index and len(index) <= _MOST_DIGITS and int(index) > 0 for index in needed):
            left_out.append(RejectedLine(path.name, line, text, "names no target or cycle from 1"))
            continue
        if name == "TGT_DATA":
            target_at[int(target)] = number
        else:
            readings[int(cycle) - 1, _DIRECTION[name], int(target) - 1] = number
    unit = stated.get("UNIT", "mm")
    if unit not in _UM_PER_UNIT:
        raise LaserFormatError(f"{path}: UNIT={unit} is not known; use one of {', '.join(_UM_PER_UNIT)}")
    cycles, targets = _counts(path, stated, target_at, readings)
    scale = _UM_PER_UNIT[unit]
    position = np.array([target_at[target] for target in range(1, targets + 1)])
    deviation = np.full((cycles, 2, targets), np.nan)
    for index, measured in readings.items():
        deviation[index] = (measured - position[index[2]]) * scale
    time = np.full(deviation.shape, np.datetime64("NaT", "ns"))
    dataset = build_deviations(range(1, cycles + 1), range(1, targets + 1), position * scale / 1e3, deviation, time)
    dataset["time"].attrs.update(origin="none", reference="the file holds no times")
    missing = int(np.isnan(deviation).sum())
    dataset.attrs.update(source=path.name, left_out=json.dumps([asdict(line) for line in left_out]), missing=missing)
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
