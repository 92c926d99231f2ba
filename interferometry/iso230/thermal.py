"""ISO 230-3: what temperature does to the displacement of a machine over hours.

The four tests (environmental temperature variation error, rotating spindle, moving linear axis, rotary motion) are named in the scope of
ISO 230-3:2020 (iso.org). The text of the standard is not open. What is computed here:

* The range of a displacement, largest minus smallest: so does a maker's manual of a spindle analyser that refers to ISO 230-3 (Lion
  Precision, M017-7500, "total drift per axis").
* Over the first 60 min, over the whole test and over its last 60 min: no open text was found that states these periods.
* Readings are averaged over one minute before, so that the range is not that of their noise: no open text. A mean is that of the middle of
  its minute; start and end of the test are on the lines through the first and the last two means, the end of the first hour and the start
  of the last on those between their neighbours.
* The tilt is the difference of two displacements over the distance of their sensors: geometry, for angles this small.
* The settling time is the time after which a displacement stays within a tenth of its whole range about its mean of the last 60 min, for
  two hours at least: no open text.
* Scale and zero of a linear axis are slope and value at its first target of a straight line through the drift of all targets; with two
  targets they are those of the end positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr

from interferometry.common import Array

HOUR_S = 3600.0
#: Readings are averaged over this time, s.
AVERAGED_S = 60.0
#: A displacement has settled where it stays within this share of its whole range.
SETTLED_SHARE = 0.1
#: Turns in which profile and drift of an axis are found where readings are missing; each leaves about the missing share of the error.
_TURNS = 20
#: Time for which it must have stayed there, s.
SETTLED_FOR_S = 2.0 * HOUR_S


@dataclass(frozen=True)
class Distortion:
    """How far a quantity moved, in its own unit: largest less smallest value in the first hour, the whole test and the last hour, NaN where
    the test is shorter, last value less the first, and time after which it has settled, s, NaN where it has not.
    """

    first_hour: float
    whole: float
    last_hour: float
    change: float
    settling_s: float


def average(seconds: Array, values: Array) -> tuple[Array, Array]:
    """Average values (samples, n) over pieces of time, s; NaN counts as missing. Return mean time and means of the pieces that hold
    samples.
    """
    number = np.floor(seconds / AVERAGED_S).astype(int)
    time, means = (pd.DataFrame(one).groupby(number).mean().to_numpy() for one in (seconds, values))
    return time[:, 0], means


def with_ends(seconds: Array, values: Array, end_s: float) -> tuple[Array, Array]:
    """Return times and means (n, k) with the values at the start, s = 0, and at the end, on lines through the two nearest means."""
    for at_s, near, other in ((0.0, 0, 1), (end_s, -1, -2)):
        if seconds.size < 2 or seconds[0] <= at_s <= seconds[-1]:
            continue
        slope = (values[near] - values[other]) / (seconds[near] - seconds[other])
        place = 0 if near == 0 else seconds.size
        values = np.insert(values, place, values[near] + slope * (at_s - seconds[near]), axis=0)
        seconds = np.insert(seconds, place, at_s)
    return seconds, values


def evaluate_distortion(seconds: Array, values: Array) -> Distortion:
    """Evaluate the course of one quantity, (n,), NaN where it is missing; the last of the times, s, is the end of the test for all
    quantities.
    """
    known = np.isfinite(values)
    since, end_s = (seconds - seconds[0])[known], float(seconds[-1] - seconds[0])
    values = values[known]
    if values.size < 2:
        return Distortion(*[np.nan] * 5)
    first, last = since <= HOUR_S, since >= end_s - HOUR_S
    is_long = end_s >= HOUR_S
    whole = float(np.ptp(values))
    settling = np.nan
    if is_long and last.any():
        outside = np.abs(values - values[last].mean()) > SETTLED_SHARE * whole
        after = int(np.flatnonzero(outside).max(initial=-1)) + 1
        if after < since.size and since[after] <= end_s - SETTLED_FOR_S:
            settling = float(since[after])
    return Distortion(
        first_hour=_range(values[first], np.interp(HOUR_S, since, values)) if is_long else np.nan,
        whole=whole,
        last_hour=_range(values[last], np.interp(end_s - HOUR_S, since, values)) if is_long else np.nan,
        change=float(values[-1] - values[0]),
        settling_s=settling,
    )


def _range(values: Array, edge: float) -> float:
    """Return the largest less the smallest value of an hour, with that at its edge, NaN of fewer than two."""
    return float(np.ptp(np.r_[values, edge])) if values.size > 1 else np.nan


def scatter(values: Array) -> float:
    """Return the standard deviation of the noise of a slow course (n,) from its second differences."""
    second = np.diff(values[np.isfinite(values)], 2)
    return float(np.std(second) / np.sqrt(6.0)) if second.size else np.nan


def tilt(first_um: Array, second_um: Array, *, distance_mm: float) -> Array:
    """Return the tilt, um/m (microradian), that two displacements (n,) in um show over the distance of their sensors."""
    return (second_um - first_um) / distance_mm * 1e3


def axis_courses(deviations: xr.Dataset) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """Return the drift of a linear axis by a straight line through each cycle: mean times of the cycles, s (NaN without times), ``zero``
    and ``end`` at the first and last target, um, and ``scale``, um/m, and their standard uncertainties from the scatter about the line.
    """
    readings = deviations["deviation"].transpose("cycle", "direction", "target")
    values = readings.values.reshape(readings.sizes["cycle"], -1)
    position = deviations["position"].values.astype(float)
    length = float(np.ptp(position))
    # One target alone shows no line: its courses are NaN.
    share = np.tile((position - position.min()) / (length or 1.0), readings.sizes["direction"])
    line = np.column_stack([np.ones(share.size), share])
    known = np.isfinite(values)
    found = np.zeros((len(values), 2))
    inverse = np.full((len(values), 2, 2), np.nan)
    for cycle, here in enumerate(known):
        if np.unique(share[here]).size > 1:
            inverse[cycle] = np.linalg.inv(line[here].T @ line[here])
    # The profile is the mean of what the lines leave, the lines fit what the profile leaves: where readings are missing, in turn.
    for _ in range(_TURNS if not known.all() else 2):
        left = np.where(known, values - found @ line.T, 0.0)
        drift = np.where(known, values - left.sum(axis=0) / np.maximum(known.sum(axis=0), 1), 0.0)
        found = np.nan_to_num(np.einsum("cij,cj->ci", inverse, drift @ line))
    residual = np.where(known, drift - found @ line.T, 0.0)
    free = max(1, int(known.sum()) - 2 * len(values) - share.size)
    covariance = float((residual**2).sum()) / free * inverse
    found = np.where(np.isfinite(inverse[:, 0, :]), found, np.nan)
    times = deviations["time"].transpose("cycle", "direction", "target").values.astype("datetime64[ns]")
    elapsed = (times - np.fmin.reduce(times, axis=None)) / np.timedelta64(1, "s")
    seconds = np.array([np.mean(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in elapsed])
    metres = length * 1e-3
    courses = {"zero": found[:, 0], "end": found.sum(axis=1), "scale": found[:, 1] / metres}
    variance = {
        "zero": covariance[:, 0, 0],
        "end": covariance.sum(axis=(1, 2)),
        "scale": covariance[:, 1, 1] / metres**2,
    }
    return seconds, courses, {name: np.sqrt(one) for name, one in variance.items()}
