"""Checks of the camera's temperatures and of the environment log by each other: an emissivity is a slope, a reflection an offset."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
#: Share of the log's standard deviation that the cell most like it leaves at most: beyond, they share less than half of its variance.
_LARGEST_LEFT = 0.7
#: Share of the change of the least changing cell that the log has at least: a sensor on the table, also one in poor contact, shows more.
_LEAST_SHARE = 0.5
#: Fewest frames from which a course can be told from another one.
_LEAST_FRAMES = 12
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


def check_material(near: FieldSeries | None, log: xr.Dataset | None, *, stated: bool, file: str) -> list[Check]:
    """Check course, rise and level of the camera's temperature and the logged material temperature against each other.

    Parameters
    ----------
    near : FieldSeries or None
        Temperature of the table at the sensor's place, or of all cells; None where too few frames show it.
    log : Dataset or None
        Environment along ``time`` (UTC) with ``material_temperature`` and perhaps ``air_temperature``, degC.
    stated : bool
        Whether the sensor's place is stated; else the cell whose course is most like the log stands for it.
    file : str
        The file, for the message.

    Returns
    -------
    list of Check
        ``material_course``, ``material_still``, ``material_rise``, ``material_level``, and ``environment_columns`` where the air was
        logged; empty where no material temperature was logged or no field is there.
    """
    if near is None or log is None or "material_temperature" not in log:
        return []
    at = near.since_start(log["time"].values)
    inside = (near.seconds >= at[0]) & (near.seconds <= at[-1])
    if inside.sum() < 2:
        return []
    logged = np.interp(near.seconds[inside], at, log["material_temperature"].values)
    checks = [
        _same_course(near, inside, logged, file=file),
        _still(near, inside, logged, file=file),
        _rise(near, inside, logged, stated=stated),
        _level(near.temperature[inside], logged),
    ]
    if "air_temperature" not in log:
        return checks
    air = np.interp(near.seconds[inside], at, log["air_temperature"].values)
    columns = _columns(near, inside, logged, air, stated=stated, file=file)
    if columns.passed:
        return [*checks, columns]
    first = "See environment_columns first: with both columns exchanged, camera and log agree. "
    return [*(one if one.passed else replace(one, remedy=first + one.remedy) for one in checks), columns]


def _same_course(near: FieldSeries, inside: Array, logged: Array, *, file: str) -> Check:
    """A table whose sensor shows another course was filmed in another order, at another time, or is not what the sensor measures."""
    change = float(np.ptp(logged))
    left = _share_left(near, inside, logged) if change >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES else 0.0
    passed = left <= _LARGEST_LEFT
    follows = f"no part of the table that the camera shows follows it: the most similar one leaves {100.0 * left:.0f} % unexplained."
    return Check(
        "material_course",
        left,
        _LARGEST_LEFT,
        passed,
        f"The material temperature in {file} changes by {change:.2g} K; "
        + ("the table does not contradict its course." if passed else follows),
        ""
        if passed
        else (
            f"Check the order, the times and the day of the frames and of the rows of {file}, its columns, and whether the sensor sits on "
            "the table."
        ),
        _FIGURES,
    )


def _share_left(near: FieldSeries, inside: Array, logged: Array) -> float:
    """Share of the log's standard deviation that a constant and a positive multiple of the most similar cell leave."""
    courses = [compare_course(near.lagged(lag_s)[inside], logged) for lag_s in SENSOR_LAGS_S]
    return min(float(course.unexplained_K.min()) for course in courses) / max(courses[0].spread_K, RESOLUTION_K)


def _still(near: FieldSeries, inside: Array, logged: Array, *, file: str) -> Check:
    """A sensor that shows less than every part of the table does stands still, or sits elsewhere."""
    change = float(np.ptp(logged))
    least = float(np.ptp(near.lagged(SENSOR_LAGS_S[-1])[inside], axis=0).min())
    told = least >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES
    share = change / least if told else 1.0
    passed = share >= _LEAST_SHARE
    shown = f"changes by {change:.2g} K" if change > 0.0 else f"stays at {logged[0]:g} degC to the last digit"
    return Check(
        "material_still",
        share,
        _LEAST_SHARE,
        passed,
        f"The material temperature in {file} {shown}, the table by at least {least:.2g} K{'' if told else ': cannot be told'}.",
        ""
        if passed
        else f"Check the material sensor: its cable, its column in {file}, and whether it sits on the table.",
        "material compensation, and every cause that follows the material temperature",
    )


def _columns(near: FieldSeries, inside: Array, logged: Array, air: Array, *, stated: bool, file: str) -> Check:
    """Whether camera and log agree only with the columns of air and material exchanged."""
    exchanged = not _agrees(near, inside, logged, stated=stated) and _agrees(near, inside, air, stated=stated)
    return Check(
        "environment_columns",
        float(exchanged),
        0.0,
        not exchanged,
        f"In {file} the air temperature follows the table in course, rise and level, and the material temperature does not: the columns "
        "look exchanged."
        if exchanged
        else f"The columns of air and material temperature in {file} do not look exchanged.",
        f"Check the headings air_temperature and material_temperature of {file}." if exchanged else "",
        "index of air, dead path and material compensation",
    )


def _agrees(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> bool:
    """Whether a logged temperature shows course, rise and level of the table."""
    slopes = _told_slopes(near, inside, logged, stated=stated)
    if slopes is None or abs(_off(slopes)) > _rise_limit(logged, stated=stated):
        return False
    return _level(near.temperature[inside], logged).passed


def _rise(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> Check:
    """The camera's rise per K of the logged one."""
    change, limit = float(np.ptp(logged)), _rise_limit(logged, stated=stated)
    slopes = _told_slopes(near, inside, logged, stated=stated)
    if slopes is None:
        told = f"The logged material temperature changes by {change:.2g} K and does not show the camera's scale: cannot be told."
        return Check("material_rise", 0.0, limit, True, told, "", _FIGURES)
    low, high = slopes
    off = _off(slopes)
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


def _rise_limit(logged: Array, *, stated: bool) -> float:
    """Share by which the camera's rise may differ from that of the log."""
    return (_CONTACT if stated else _UNKNOWN_PLACE) + _CAMERA_DRIFT_K / max(float(np.ptp(logged)), _LEAST_CHANGE_K)


def _off(slopes: tuple[float, float]) -> float:
    """Distance of a range of slopes from 1, with its sign; 0 where it contains 1."""
    low, high = slopes
    return max(low - 1.0, 0.0) - max(1.0 - high, 0.0)


def _told_slopes(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> tuple[float, float] | None:
    """`_slopes` where the log changes enough and there are frames enough."""
    enough = float(np.ptp(logged)) >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES
    return _slopes(near, inside, logged, stated=stated) if enough else None


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
