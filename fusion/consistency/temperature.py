"""Checks of the camera's temperatures by the logged material temperature: an emissivity is a slope, a reflection an offset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from fusion._typing import Array
from fusion.consistency.checks import Check
from fusion.consistency.field_series import FieldSeries

#: Time constants of a material sensor that are tried, s: from a thermocouple in a hole to a magnetic probe.
SENSOR_LAGS_S = (0.0, 180.0, 360.0, 600.0, 900.0)
#: The sensor follows the table only where the course of a cell leaves less than this share of its standard deviation.
LEAST_FOLLOWED = 0.3
#: Resolution of a logged temperature, K: smaller differences mean nothing.
RESOLUTION_K = 0.01
#: Share by which the rise under a surface probe may differ from that of the surface: contact and stem conduction, 2 standard
#: uncertainties of 2 %.
_CONTACT = 0.04
#: The same where the sensor's place is not stated: several cells follow alike, and their rises differ by some per cent.
_UNKNOWN_PLACE = 0.07
#: Drift of the camera's zero within a test that its correction leaves, K.
_CAMERA_DRIFT_K = 0.05
#: Smallest change of the logged temperature that can tell a slope, K.
_LEAST_CHANGE_K = 1.0
#: Correlation with the log that the cell most like it has at least; below, with most of the variance, all of the table runs against it.
_AGAINST = -0.5
#: Differences over this time show the slope without a slow drift of the camera, s.
_SHORT_TERM_S = 1200.0
#: A cell is as good as the best one where the misfit is no larger by this many units of log-likelihood.
_AS_GOOD = 6.0
#: So well, K, a surface probe shows the course of its place: where it is not stated, cells that follow it within this cannot be told apart.
_PROBE_K = 0.03
#: Largest difference of the levels, K: twice the accuracy of a thermal camera of 2 K.
_LARGEST_LEVEL_K = 4.0
_FIGURES = "temperatures, rises, the declared coefficients, and every cause that follows the field"


@dataclass(frozen=True)
class Course:
    """How well the cells follow a logged temperature.

    Attributes
    ----------
    unexplained_K : (cells,) ndarray, K
        Root mean square that a constant and a positive multiple of the cell leave.
    spread_K : float, K
        Standard deviation of the log.
    """

    unexplained_K: Array
    spread_K: float


def compare_course(cells: Array, logged: Array) -> Course:
    """Hold a logged temperature against the course of every cell.

    Parameters
    ----------
    cells : (n, cells) ndarray, degC
    logged : (n,) ndarray, degC

    Returns
    -------
    Course
    """
    centred, target = cells - cells.mean(axis=0), logged - logged.mean()
    product = np.maximum(centred.T @ target, 0.0)
    explained = product**2 / np.maximum((centred**2).sum(axis=0), 1e-12)
    left = np.maximum(target @ target - explained, 0.0)
    return Course(np.sqrt(left / logged.size), float(target.std()))


def check_material(near: FieldSeries | None, log: xr.Dataset | None, *, stated: bool) -> list[Check]:
    """Check rise and level of the camera's temperature against the logged material temperature.

    Parameters
    ----------
    near : FieldSeries or None
        Temperature of the table at the sensor's place, or of all cells; None where too few frames show it.
    log : Dataset or None
        Environment along ``time`` (UTC) with ``material_temperature``, degC.
    stated : bool
        Whether the sensor's place is stated; else the cell whose course is most like the log stands for it.

    Returns
    -------
    list of Check
        ``material_course``, ``material_rise`` and ``material_level``; empty where nothing was logged or no field is there.
    """
    if near is None or log is None or "material_temperature" not in log:
        return []
    at = near.since_start(log["time"].values)
    inside = (near.seconds >= at[0]) & (near.seconds <= at[-1])
    if inside.sum() < 2:
        return []
    logged = np.interp(near.seconds[inside], at, log["material_temperature"].values)
    return [
        _same_course(near, inside, logged),
        _rise(near, inside, logged, stated=stated),
        _level(near.temperature[inside], logged),
    ]


def _same_course(near: FieldSeries, inside: Array, logged: Array) -> Check:
    """A table that cools while its sensor warms was filmed in another order, at another time, or is not what the sensor measures."""
    change = float(np.ptp(logged))
    likeness = 1.0
    if change >= _LEAST_CHANGE_K and float(np.ptp(near.temperature[inside], axis=0).max()) >= _LEAST_CHANGE_K:
        likeness = max(_largest_correlation(near.lagged(lag_s)[inside], logged) for lag_s in SENSOR_LAGS_S)
    passed = likeness >= _AGAINST
    return Check(
        "material_course",
        likeness,
        _AGAINST,
        passed,
        f"The logged material temperature changes by {change:.2g} K; "
        + (
            "the table does not run against it."
            if passed
            else "every part of the table that the camera shows runs against it."
        ),
        ""
        if passed
        else "Check the order and the times of the frames, the clock of the log, and whether the sensor sits on the table.",
        _FIGURES,
    )


def _largest_correlation(cells: Array, logged: Array) -> float:
    """Correlation of the log with the cell that is most like it."""
    centred, target = cells - cells.mean(axis=0), logged - logged.mean()
    size = np.sqrt((centred**2).sum(axis=0) * (target @ target))
    return float((target @ centred / np.maximum(size, 1e-12)).max())


def _rise(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> Check:
    """The camera's rise per K of the logged one."""
    change = float(np.ptp(logged))
    slopes = _slopes(near, inside, logged, stated=stated) if change >= _LEAST_CHANGE_K and inside.sum() >= 12 else None
    limit = (_CONTACT if stated else _UNKNOWN_PLACE) + _CAMERA_DRIFT_K / max(change, _LEAST_CHANGE_K)
    if slopes is None:
        told = f"The logged material temperature changes by {change:.2g} K and does not show the camera's scale: cannot be told."
        return Check("material_rise", 0.0, limit, True, told, "", _FIGURES)
    low, high = slopes
    off = max(low - 1.0, 0.0) - max(1.0 - high, 0.0)
    passed = abs(off) <= limit
    where = "at the sensor's place" if stated else "where its course is most like the sensor's"
    return Check(
        "material_rise",
        off,
        limit,
        passed,
        f"The camera's rise {where} is {low:.3g} to {high:.3g} times that of the logged material temperature, which changes by "
        f"{change:.2g} K.",
        ""
        if passed
        else (
            "Check emissivity, object_distance and reflected_temperature (a rise that is too large comes from an emissivity that is too "
            "small), the drift of the camera, and whether the sensor sits on the table (material_sensor under [interferometry])."
        ),
        _FIGURES,
    )


def _slopes(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> tuple[float, float] | None:
    """Smallest and largest slope of the camera over the log that the data allow; None where no cell follows the log.

    The slope is taken from levels and from differences over 20 min, each with the error in the log and in the camera (Frisch 1934:
    the true slope lies between both regressions), for all cells and sensor lags that fit as well as the best.
    """
    step = max(1, round(_SHORT_TERM_S / float(np.median(np.diff(near.seconds[inside])))))
    courses = []
    for lag_s in SENSOR_LAGS_S:
        cells = near.lagged(lag_s)[inside]
        courses.append((compare_course(cells, logged), cells))
    spread = courses[0][0].spread_K
    best = max(min(float(course.unexplained_K.min()) for course, _ in courses), 0.5 * RESOLUTION_K)
    if best > LEAST_FOLLOWED * spread:
        return None
    as_good = best * float(np.exp(_AS_GOOD / logged.size))
    if not stated:
        as_good = max(as_good, _PROBE_K)
    slopes = []
    for course, cells in courses:
        chosen = cells[:, course.unexplained_K <= as_good]
        for camera, log in ((chosen, logged), (chosen[step:] - chosen[:-step], logged[step:] - logged[:-step])):
            camera, log = camera - camera.mean(axis=0), log - log.mean()
            product = log @ camera
            follows = product > 0.0
            slopes += [product[follows] / (log @ log), (camera**2).sum(axis=0)[follows] / product[follows]]
    all_slopes = np.concatenate(slopes)
    return float(all_slopes.min()), float(all_slopes.max())


def _level(cells: Array, logged: Array) -> Check:
    """Distance of the logged level from the levels of the table."""
    level, table = float(np.median(logged)), np.median(cells, axis=0)
    off = max(float(table.min()) - level, 0.0) - max(level - float(table.max()), 0.0)
    passed = abs(off) <= _LARGEST_LEVEL_K
    return Check(
        "material_level",
        off,
        _LARGEST_LEVEL_K,
        passed,
        f"The table reads {table.min():.1f} to {table.max():.1f} degC, the logged material temperature {level:.1f} degC.",
        ""
        if passed
        else "Check reflected_temperature, emissivity, the stored transmission, and where the material sensor sits.",
        _FIGURES,
    )
