"""Checks of the logs: whether they cover the time of the readings, hold loads, and whether their temperature sensors are sound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import both_ends, covered_share, likely_zone_shift
from fusion.analysis.alignment.sensor_health import Kind, examine_sensors
from fusion.analysis.consistency.checks import CLOCK, LOG, Found, check, judge
from fusion.common import Array
from fusion.results.recursion import first_order_weights

#: Temperatures of the environment log.
_CONTACT_SENSORS = ("air_temperature", "material_temperature")
#: Share of the readings that a log has to cover.
_LEAST_COVERED = 0.9
#: A gap is a stretch without a sample that is longer than this, s, and ten times the usual step.
_GAP_S = 600.0
#: A log that ends longer before the first reading, or begins longer after the last one, than this, s, is of another test: conditions are
#: often noted once or twice, before and after.
_APART_S = 3600.0
#: A log that covers less than this share of the readings, and begins and ends with them after a shift, is on another clock, ...
_COVERED_NOW = 0.6
#: ... both ends within this time, s: loggers are switched on and off by hand.
_SAME_END_S = 900.0
#: Minutes of a month: a log that is longer has an even grid of no more times than this, or than its rows.
_MONTH_MIN = 43_200
#: Rises in a row without a fall that chance makes less than once in a million: a counter.
_COUNTED = 20
#: Share of the variance of a load's response that may depend on whether it is held or interpolated between two rows.
_BETWEEN_ROWS = 0.25
#: Time constants of a source of heat through which a load is seen, s: 5 and 20 min.
SOURCE_S = (300.0, 1200.0)


@check("source", LOG, waits=True)
def environment_coverage(environment: xr.Dataset, reading_time: xr.DataArray) -> Found | None:
    """Share of the readings between two samples of the log that are no gap apart: at least `_LEAST_COVERED`; a contradiction where it
    ends, or begins, more than `_APART_S` s before or after all readings, or covers less than `_COVERED_NOW` where a shift by whole
    quarter hours brings both ends of the log within `_SAME_END_S` s of those of the readings.
    """
    return _coverage(environment, reading_time)


@check("source", LOG, waits=True)
def drivers_coverage(drivers: xr.Dataset, reading_time: xr.DataArray) -> Found | None:
    """The same for the drivers' log."""
    return _coverage(drivers, reading_time)


@check("source", LOG)
def drivers_kind(drivers: xr.Dataset) -> Found | None:
    """Changes of a load, all of one sign, or growing for long and beginning again near zero: fewer than `_COUNTED`, else a counter;
    single rows of both signs among zeros: changes of a load; share of the variance of the response of a source of 5 min that depends on
    whether the load is held or interpolated from row to row: at most `_BETWEEN_ROWS`, else events, or rows that are too rare.
    """
    loads = loads_of(drivers)
    if not loads:
        return None
    at = np.asarray((drivers["time"].values - drivers["time"].values[0]) / np.timedelta64(1, "s"), float)
    found = []
    for name, load in loads.items():
        if kind := _other_kind(load):
            found.append({"name": name, **kind})
        elif (share := _between_rows(at, load)) > _BETWEEN_ROWS:
            found.append({"name": name, "kind": "rare", "share": share})
    return judge(len(found), 0.0, found=found)


@check("source", CLOCK, waits=True)
def sensors_coverage(sensors: xr.Dataset, reading_time: xr.DataArray) -> Found | None:
    """The same as for the environment log, for the contact sensors' log where it stands for the camera."""
    return _coverage(sensors, reading_time)


def _coverage(log: xr.Dataset, reading_time: xr.DataArray) -> Found | None:
    """Check that a log covers the time of the readings."""
    times = reading_time.values.ravel()
    readings = times[~np.isnat(times)]
    if log.sizes["time"] == 0 or readings.size == 0:
        return None
    logged = log["time"].values
    covered = _covered(logged, readings)
    passed = covered >= _LEAST_COVERED
    # Where the log begins before nearly all readings and ends after them, what it lacks are gaps inside it.
    gaps = not passed and covered_share(readings, logged) >= _LEAST_COVERED
    late_s = None if passed or gaps else likely_zone_shift(readings, logged)
    clear = late_s is not None and covered < _COVERED_NOW and _same_ends(logged, readings, late_s)
    apart_s = max(readings.min() - logged[-1], logged[0] - readings.max()) / np.timedelta64(1, "s")
    ends = both_ends(logged, readings)
    contradicts = bool(apart_s > _APART_S or clear)
    return judge(covered, _LEAST_COVERED, passed=passed, contradicts=contradicts, ends=ends, gaps=gaps, late_s=late_s)


@check("source", LOG)
def contact_sensors(environment: xr.Dataset, drivers: xr.Dataset | None = None) -> Found | None:
    """Temperatures of the environment log, and those in degC of the drivers' log, each predicted from the others, the loads and its past
    ([sensor-health.md](sensor-health.md)); only a clear fault counts, and no sensor that shows one reading throughout.
    """
    if environment.sizes["time"] == 0:
        return None
    start = environment["time"].values[0]
    seconds = np.asarray((environment["time"].values - start) / np.timedelta64(1, "s"), float)
    columns = {name: environment[name].values for name in _CONTACT_SENSORS if name in environment}
    loads = []
    if drivers is not None:
        at = np.asarray((drivers["time"].values - start) / np.timedelta64(1, "s"), float)
        for name, values in drivers.data_vars.items():
            if values.attrs.get("units") == "degC":
                columns[str(name)] = np.interp(seconds, at, values.values, left=np.nan, right=np.nan)
            else:
                loads.append(np.interp(seconds, at, values.values))
    faults = examine_sensors(
        seconds, np.column_stack(list(columns.values())), np.column_stack(loads) if loads else None
    )
    # One reading throughout is that of a stable room or of a stuck sensor: `material_still` tells which where the table is seen.
    changing = {
        sensor for sensor, column in enumerate(columns.values()) if np.unique(column[np.isfinite(column)]).size > 1
    }
    clear = [
        fault
        for fault in faults
        if fault.is_clear and not fault.readings and (fault.kind is not Kind.STUCK or fault.sensor in changing)
    ]
    return judge(
        len(clear), 0.0, faults=[(list(columns)[fault.sensor].replace("_", " "), fault.words) for fault in clear]
    )


def _same_ends(logged: NDArray[np.datetime64], readings: NDArray[np.datetime64], late_s: float) -> bool:
    """Whether a log begins and ends with the readings once its clock is put right."""
    ends = ((logged[[0, -1]] - [readings.min(), readings.max()]) / np.timedelta64(1, "s")) - late_s
    return bool(np.all(np.abs(ends) <= _SAME_END_S))


def _covered(logged: NDArray[np.datetime64], readings: NDArray[np.datetime64]) -> float:
    """Share of the readings that lie between two samples of a log that are no gap apart."""
    seconds = (logged - logged[0]) / np.timedelta64(1, "s")
    at = (readings - logged[0]) / np.timedelta64(1, "s")
    if seconds.size < 2:
        return 0.0
    steps = np.diff(seconds)
    place = np.searchsorted(seconds, at, side="right") - 1
    inside = (place >= 0) & (at <= seconds[-1])
    step = steps[np.clip(place, 0, steps.size - 1)]
    return float(np.mean(inside & (step <= max(_GAP_S, 10.0 * float(np.median(steps))))))


def _other_kind(load: Array) -> dict[str, Any]:
    """What a column counts or how it changes in place of a load, by its own shape; empty where that does not tell."""
    load = load[np.isfinite(load)]
    steps = np.diff(load)
    rises, falls = steps[steps > 0.0], steps[steps < 0.0]
    changes, rows = rises.size + falls.size, load.size
    if changes >= _COUNTED and not (rises.size and falls.size):
        return {"kind": "counter", "changes": changes, "rows": rows, "grows": rises.size > 0}
    # It begins again near zero each time, and grows for long in between.
    reset = load[1:][steps < 0.0]
    if falls.size >= 2 and rises.size >= _COUNTED * falls.size and reset.max() <= rises.max():
        return {"kind": "reset", "changes": rises.size, "rows": rows, "resets": falls.size}
    moves = np.flatnonzero(load)
    single = moves.size >= 4 and moves.size < 0.5 * rows and (np.diff(moves) > 1).all()
    if single and load.min() < 0.0 < load.max():
        return {"kind": "changes", "rows": moves.size}
    return {}


def loads_of(log: xr.Dataset | None, *, constant: bool = False) -> dict[str, Array]:
    """The loads of a log by name; `constant`: also those that never change."""
    columns = {} if log is None else log.data_vars
    return {
        str(name): column.values.astype(float)
        for name, column in columns.items()
        if _is_load(column, constant=constant)
    }


def _is_load(column: xr.DataArray, *, constant: bool = False) -> bool:
    """Whether a column may drive the field: numbers that change and are no temperature."""
    if column.dtype.kind not in "fiu" or str(column.attrs.get("units", "")) in ("degC", "K"):
        return False
    finite = np.isfinite(column.values)
    return int(finite.sum()) >= 2 and (constant or float(np.ptp(column.values[finite])) > 0.0)


def even_times(at: Array) -> Array:
    """Even times from the first row of a log to its last, s: a minute apart, or as many as the log has rows or a month has minutes."""
    return np.arange(at[0], at[-1] + 1.0, max(60.0, float(at[-1] - at[0]) / max(at.size, _MONTH_MIN)))


def _between_rows(at: Array, load: Array) -> float:
    """Share of the variance of a quick source's response that differs between a load held from row to row and one interpolated."""
    known = np.isfinite(load)
    grid = even_times(at)
    held = load[known][np.searchsorted(at[known], grid, side="right").clip(1) - 1]
    courses = np.column_stack([np.interp(grid, at[known], load[known]), held])
    # At even times an exponential average of what each step adds, without a kernel to load.
    step = grid[1] - grid[0] if grid.size > 1 else SOURCE_S[0]
    decay, now, before = first_order_weights(SOURCE_S[0], step)
    added = (now * courses[1:] + before * courses[:-1]) / (1.0 - decay)
    averages = pd.DataFrame(np.vstack([courses[:1], added])).ewm(alpha=1.0 - decay, adjust=False)
    responses = averages.mean().to_numpy()
    return float(np.var(responses[:, 1] - responses[:, 0]) / max(float(np.var(responses[:, 1])), 1e-30))
