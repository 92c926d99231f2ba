"""Checks of the logs: whether they cover the time of the readings, and whether their temperature sensors are sound."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.alignment.sensor_health import examine_sensors
from fusion.alignment.zone_shift import likely_zone_shift
from fusion.consistency.checks import Check, Severity

#: Temperatures of the environment log.
_CONTACT_SENSORS = ("air_temperature", "material_temperature")
#: Share of the readings that a log has to cover.
_LEAST_COVERED = 0.9
#: A gap is a stretch without a sample that is longer than this, s, and ten times the usual step.
_GAP_S = 600.0
#: A log that covers less than this share of the readings, and begins and ends with them after a shift, is on another clock, ...
_COVERED_NOW = 0.6
#: ... both ends within this time, s: loggers are switched on and off by hand.
_SAME_END_S = 900.0


def check_log(
    log: xr.Dataset | None, times: NDArray[np.datetime64], *, name: str, file: str, endangers: str
) -> list[Check]:
    """Check that a log covers the time of the readings.

    Parameters
    ----------
    log : Dataset or None
        Along ``time`` (UTC); None where nothing was logged.
    times : (n,) ndarray of datetime64
        Times of the readings, UTC; NaT where a reading has no time.
    name : str
        ``environment`` or ``drivers``.
    file : str
        The file, for the message.
    endangers : str
        Figures that follow the log.

    Returns
    -------
    list of Check
        Empty where nothing was logged.
    """
    if log is None or log.sizes["time"] == 0:
        return []
    readings = times[~np.isnat(times)]
    if readings.size == 0:
        return []
    covered = _covered(log["time"].values, readings)
    passed = covered >= _LEAST_COVERED
    gaps = not passed and _reaches_both_ends(log["time"].values, readings)
    late_s = None if passed or gaps else likely_zone_shift(readings, log["time"].values)
    clear = late_s is not None and covered < _COVERED_NOW and _same_ends(log["time"].values, readings, late_s)
    first, last = (np.datetime_as_string(log["time"].values[k], unit="s") for k in (0, -1))
    span = f"{np.datetime_as_string(readings.min(), unit='s')}Z to {np.datetime_as_string(readings.max(), unit='s')}Z"
    return [
        Check(
            f"{name}_coverage",
            covered,
            _LEAST_COVERED,
            passed,
            f"{file} ({first}Z to {last}Z) covers {100.0 * covered:.0f} % of the readings ({span})"
            + ("; the others lie in gaps of the log" if gaps else "")
            + ("." if late_s is None else f", and nearly all of them if its clock is {_hours(late_s)}."),
            "" if passed else _remedy(file, gaps=gaps),
            endangers,
            Severity.CONTRADICTION if covered == 0.0 or clear else Severity.DOUBT,
        )
    ]


def check_contact_sensors(environment: xr.Dataset | None, drivers: xr.Dataset | None, *, file: str) -> list[Check]:
    """Check that the temperature sensors of the environment log are sound.

    Parameters
    ----------
    environment : Dataset or None
        Along ``time`` (UTC) with ``air_temperature`` and ``material_temperature``, degC.
    drivers : Dataset or None
        Logged loads, and temperatures (unit degC), which take part in the prediction and are examined as well.
    file : str
        The environment log, for the message.

    Returns
    -------
    list of Check
        ``contact_sensors``: how many are clearly faulty (docs/method/sensor-health.md); empty where nothing was logged.
    """
    if environment is None or environment.sizes["time"] == 0:
        return []
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
    clear = [fault for fault in faults if fault.is_clear]
    names = [f"{list(columns)[fault.sensor].replace('_', ' ')} {fault.words}" for fault in clear]
    return [
        Check(
            "contact_sensors",
            float(len(clear)),
            0.0,
            not clear,
            f"{file}: {'; '.join(names)}."
            if clear
            else f"No contact sensor of {file} jumps, ramps, sticks or falls silent by itself.",
            f"Look at contact and cable, and leave the log out from then on ({file})." if clear else "",
            "compensation by the log, and every cause that follows it",
        )
    ]


def _same_ends(logged: NDArray[np.datetime64], readings: NDArray[np.datetime64], late_s: float) -> bool:
    """Whether a log begins and ends with the readings once its clock is put right."""
    ends = ((logged[[0, -1]] - [readings.min(), readings.max()]) / np.timedelta64(1, "s")) - late_s
    return bool(np.all(np.abs(ends) <= _SAME_END_S))


def _reaches_both_ends(logged: NDArray[np.datetime64], readings: NDArray[np.datetime64]) -> bool:
    """Whether a log begins before nearly all readings and ends after nearly all of them, so that what it lacks are gaps inside it."""
    return bool(np.mean((readings >= logged[0]) & (readings <= logged[-1])) >= _LEAST_COVERED)


def _remedy(file: str, *, gaps: bool) -> str:
    if gaps:
        return f"Log without a break in the next test; what happened in the gaps of {file} is not known."
    return (
        f"Check the date, the clock and the time zone of {file} (write its times with their zone, or time_zone), or leave it out "
        "of the campaign file."
    )


def _hours(late_s: float) -> str:
    return f"{abs(late_s) / 3600.0:g} h {'late' if late_s > 0.0 else 'early'}"


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
