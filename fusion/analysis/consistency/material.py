"""Camera against contact sensors: a material sensor of the environment log, and sensors on the plan.

An emissivity error appears as a gain, a reflected-temperature error as an offset.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.consistency.checks import CAMERA, LOG, Found, check, judge
from fusion.analysis.consistency.series import (
    LEAST_CHANGE_K,
    LEAST_FRAMES,
    FieldSeries,
    Logged,
    field_at,
    log_with_camera,
)
from fusion.common import Array

#: Largest difference between camera and sensors in standard uncertainties.
_LIMIT = 3.0
#: Standard uncertainty of the rise under a surface probe relative to that of the surface (contact, stem conduction), as a share of it.
_CONTACT = 0.02
#: Time constants of a material sensor that are tried, s: from a thermocouple in a hole to a magnetic probe.
SENSOR_LAGS_S = (0.0, 180.0, 360.0, 600.0, 900.0)
#: The sensor follows the table only where the course of a cell leaves less than this share of its standard deviation.
LEAST_FOLLOWED = 0.3
#: Resolution of a logged temperature, K: smaller differences mean nothing.
RESOLUTION_K = 0.01
#: Share by which the rise under a surface probe may differ from that of the surface: contact and stem conduction, 2 standard
#: uncertainties.
_CONTACT_SHARE = 2.0 * _CONTACT
#: The same where the sensor's place is not stated: several cells follow alike, and their rises differ by some per cent.
_UNKNOWN_PLACE = 0.07
#: Drift of the camera's zero within a test that its correction leaves, K.
_CAMERA_DRIFT_K = 0.05
#: Share of the log's standard deviation that the cell most like it leaves at most: beyond, they share less than half of its variance.
_LARGEST_LEFT = 0.7
#: Share of the change of the least changing cell that the log has at least: a sensor on the table, also one in poor contact, shows more.
_LEAST_SHARE = 0.5
#: Differences over this time show the slope without a slow drift of the camera, s.
_SHORT_TERM_S = 1200.0
#: A cell is as good as the best one where the misfit is no larger by this many units of log-likelihood.
_AS_GOOD = 6.0
#: Accuracy, K, to which a surface probe follows its place: where that is not stated, cells within this cannot be distinguished.
_PROBE_K = 0.03
#: Largest difference of the levels, K: twice the accuracy of a thermal camera of 2 K.
_LARGEST_LEVEL_K = 4.0
#: Parts of a test that are left out in turn, and coverage factor of 95 % for the standard deviation that they give (Student's t, 5
#: degrees of freedom; JCGM 100:2008, G.3).
_PARTS, _PARTS_95 = 6, 2.57


def compare_course(cells: Array, logged: Array) -> tuple[Array, float]:
    """Return what a constant and a positive multiple of every cell leave of a logged temperature, and its standard deviation, K."""
    centred, target = cells - cells.mean(axis=0), logged - logged.mean()
    product = np.maximum(centred.T @ target, 0.0)
    explained = product**2 / np.maximum((centred**2).sum(axis=0), 1e-12)
    left = np.maximum(target @ target - explained, 0.0)
    return np.sqrt(left / logged.size), float(target.std())


def rise_share_u(near: FieldSeries | None, log: xr.Dataset | None, *, stated: bool) -> float | None:
    """Standard uncertainty of the camera's rise, as a share of it, that a material sensor shows: at a stated place by all slopes that fit,
    else by what no place explains; None where it tells nothing.
    """
    logged = log_with_camera(near, log)
    slopes = None if logged is None else _slopes(logged, logged.material, stated=stated)
    if slopes is None:
        return None
    # What is seen and not corrected belongs to the uncertainty (rectangular, JCGM 100:2008, 4.3.7 and F.2.4.5). A place that nobody
    # stated is no measurement of the scale: that it could lie elsewhere says nothing of the camera.
    off = max(abs(slope - 1.0) for slope in slopes) if stated else abs(_off(slopes))
    return float(np.hypot(_CONTACT, off / np.sqrt(3.0))) if stated or off > 0.0 else None


def share_of_zero(near: FieldSeries, log: xr.Dataset | None, zero_K: Array, gain_u: float) -> tuple[float, float]:
    """Mean and root mean square of the share of a change at the frames, (n,) K, that is one of the camera's zero: from nothing to all of it
    (rectangular), by what the material sensor at this place shows of it beside a gain that is known to `gain_u`.
    """
    shares, logged = np.linspace(0.0, 1.0, 101), log_with_camera(near, log)
    weight, best = np.ones(shares.size), np.inf
    if logged is not None and logged.inside.sum() >= LEAST_FRAMES:
        inside, material = logged.inside, logged.material
        for lag_s in SENSOR_LAGS_S:
            zero = respond(zero_K[:, None], near.seconds, time_constant_s=lag_s)[inside, 0]
            columns = np.column_stack([zero - zero.mean(), material - material.mean()])
            off = near.lagged(lag_s)[inside, 0] - material
            # What a probe leaves of a course is no noise: a test tells as many values as it has parts.
            known = columns.T * _PARTS / len(off) / _PROBE_K**2
            covariance = np.linalg.pinv(known @ columns + np.diag([0.0, 1.0 / (gain_u**2 + _CONTACT**2)]))
            values = covariance @ known @ (off - off.mean())
            left = float(np.var(off - columns @ values))
            if left < best:
                best, variance = left, max(float(covariance[0, 0]), 1e-12) * max(left / _PROBE_K**2, 1.0)
                apart = (shares - values[0]) ** 2 / (2.0 * variance)
                weight = np.exp(apart.min() - apart)
    weight = weight / weight.sum()
    return float(weight @ shares), float(np.sqrt(weight @ shares**2))


@check("fields", CAMERA, waits=True)
def material_course(logged: Logged) -> Found:
    """Share of the standard deviation of the logged material temperature that a constant and a positive multiple of the cell most like it
    leave, over all time constants of the sensor, where the log changes by 1 K: at most `_LARGEST_LEFT`, so that half of the variance is
    shared.
    """
    left, inside, material = 0.0, logged.inside, logged.material
    if logged.tells:
        courses = [compare_course(logged.near.lagged(lag_s)[inside], material) for lag_s in SENSOR_LAGS_S]
        left = min(float(unexplained_K.min()) for unexplained_K, _ in courses) / max(courses[0][1], RESOLUTION_K)
    return judge(left, _LARGEST_LEFT, change_K=logged.change_K)


@check("fields", LOG, waits=True)
def material_still(logged: Logged) -> Found:
    """Change of the logged material temperature over that of the least changing cell (of the cell at the sensor, where its place is
    stated), where that is 1 K at least: at least `_LEAST_SHARE`.
    """
    least_K = float(np.ptp(logged.near.lagged(SENSOR_LAGS_S[-1])[logged.inside], axis=0).min())
    testable = least_K >= LEAST_CHANGE_K and logged.inside.sum() >= LEAST_FRAMES
    share = logged.change_K / least_K if testable else 1.0
    facts = {"change_K": logged.change_K, "least_K": least_K, "testable": testable, "level": logged.material[0]}
    return judge(share, _LEAST_SHARE, passed=share >= _LEAST_SHARE, **facts)


@check("fields", CAMERA, waits=True)
def material_rise(place_stated: bool, logged: Logged | None = None) -> Found:
    """The camera's rise over that of the logged material temperature, as a range over the parts of its course: contains 1 within
    `_CONTACT_SHARE` (`_UNKNOWN_PLACE` where the sensor's place is not stated) plus `_CAMERA_DRIFT_K` K over the change of the log; a
    range wider than twice the limit confirms nothing, as of a zero that swings.
    """
    if logged is None:
        return judge(0.0, _UNKNOWN_PLACE, verified=False, slopes=None, change_K=None)
    limit = _rise_limit(logged.material, stated=place_stated)
    slopes = _slopes(logged, logged.material, stated=place_stated)
    off = 0.0 if slopes is None else _off(slopes)
    verified = slopes is not None and place_stated and slopes[1] - slopes[0] <= 2.0 * limit
    facts: dict[str, Any] = {"change_K": logged.change_K, "stated": place_stated, "slopes": slopes}
    return judge(off, limit, passed=abs(off) <= limit, verified=verified, **facts)


@check("fields", CAMERA)
def material_gain(logged: Logged, place_stated: bool) -> Found | None:
    """Change of the camera's rise per K of the logged one through the test, at the stated place, beside a steady drift of the zero, a
    time constant of the sensor and its unknown state at the first frame; beyond its uncertainty of 95 % (delete-a-group jackknife over 6
    parts), the least of what the time constants that fit as well as the best one ask for ([below](#temperature)): at most as
    `material_rise`.
    """
    if not place_stated:
        return None
    near, inside, material = logged.near, logged.inside, logged.material
    limit, seconds = _rise_limit(material, stated=True), near.seconds[inside]
    passed = np.asarray((seconds - seconds.mean()) / np.ptp(seconds))
    lagged = [near.lagged(lag_s)[inside, 0] for lag_s in SENSOR_LAGS_S]
    # What a sensor makes of the course between two frames is not noise: its weight is judged by leaving out parts of the test.
    part = np.minimum((_PARTS * np.arange(len(material))) // len(material), _PARTS - 1)
    fits = []
    # A sensor shows the place through a time constant between two of those that are tried, from a state that is not known: what was
    # before the first frame fades with that time constant, and in a table that warms ever more slowly it looks like a change of gain.
    for (faster, slower), lag_s in zip(pairwise(lagged), SENSOR_LAGS_S[1:], strict=True):
        centred, fades = faster - faster.mean(), np.exp(-seconds / lag_s)
        design = np.column_stack(
            [np.ones(len(centred)), centred, slower - slower.mean(), passed, passed * centred, fades]
        )
        found = np.array(
            [np.linalg.lstsq(design[part != k], material[part != k], rcond=None)[0] for k in range(-1, _PARTS)]
        )
        gains = found[:, 1] + found[:, 2]
        if (gains > 0.0).all():
            changes = -found[:, 4] / gains
            rest = material - design @ found[0]
            fits.append((float(rest @ rest), float(changes[0]), float(np.sqrt((_PARTS - 1) * np.var(changes[1:])))))
    # Of the time constants that fit as well as the best one, the one that asks for the least change.
    as_good = min((left for left, _, _ in fits), default=0.0) * np.exp(2.0 * _AS_GOOD / len(material))
    change, u = min(
        ((change, u) for left, change, u in fits if left <= as_good),
        key=lambda fit: abs(fit[0]) - _PARTS_95 * fit[1],
        default=(0.0, np.inf),
    )
    testable = logged.tells and u <= limit
    value = max(abs(change) - _PARTS_95 * u, 0.0) if testable else 0.0
    return judge(value, limit, testable=testable, change=change, expanded_u=_PARTS_95 * u)


@check("fields", CAMERA)
def material_level(logged: Logged) -> Found:
    """The logged level against the levels of the table's cells: at most `_LARGEST_LEVEL_K` K apart."""
    return _level(logged, logged.material)


@check("fields", LOG, waits=True)
def environment_columns(logged: Logged, place_stated: bool) -> Found | None:
    """Whether the logged air temperature shows course, rise and level of the table, and the material temperature does not: no."""
    if logged.air is None:
        return None
    material, air = (_agrees(logged, one, stated=place_stated) for one in (logged.material, logged.air))
    return judge(air and not material, 0.0)


def _agrees(logged: Logged, temperature: Array, *, stated: bool) -> bool:
    """Whether a logged temperature shows course, rise and level of the table."""
    slopes = _slopes(logged, temperature, stated=stated)
    if slopes is None or abs(_off(slopes)) > _rise_limit(temperature, stated=stated):
        return False
    return _level(logged, temperature).passed


def _rise_limit(temperature: Array, *, stated: bool) -> float:
    """Share by which the camera's rise may differ from that of the log."""
    return (_CONTACT_SHARE if stated else _UNKNOWN_PLACE) + _CAMERA_DRIFT_K / max(
        float(np.ptp(temperature)), LEAST_CHANGE_K
    )


def _off(slopes: tuple[float, float]) -> float:
    """Distance of a range of slopes from 1, with its sign; 0 where it contains 1."""
    low, high = slopes
    return max(low - 1.0, 0.0) - max(1.0 - high, 0.0)


def _slopes(logged: Logged, temperature: Array, *, stated: bool) -> tuple[float, float] | None:
    """Smallest and largest slope of the camera over the log that the data allow; None where it changes little or no cell follows it."""
    near, inside = logged.near, logged.inside
    if float(np.ptp(temperature)) < LEAST_CHANGE_K or inside.sum() < LEAST_FRAMES:
        return None
    step = max(1, round(_SHORT_TERM_S / float(np.median(np.diff(near.seconds[inside])))))
    courses = []
    for lag_s in SENSOR_LAGS_S:
        cells = near.lagged(lag_s)[inside]
        courses.append((*compare_course(cells, temperature), cells))
    best = max(min(float(unexplained_K.min()) for unexplained_K, _, _ in courses), 0.5 * RESOLUTION_K)
    if best > LEAST_FOLLOWED * courses[0][1]:
        return None
    as_good = best * float(np.exp(_AS_GOOD / temperature.size))
    if not stated:
        as_good = max(as_good, _PROBE_K)
    slopes = []
    for unexplained_K, _, cells in courses:
        chosen = cells[:, unexplained_K <= as_good]
        for camera, log in (
            (chosen, temperature),
            (chosen[step:] - chosen[:-step], temperature[step:] - temperature[:-step]),
        ):
            camera, log = camera - camera.mean(axis=0), log - log.mean()
            product = log @ camera
            follows = product > 0.0
            slopes += [product[follows] / (log @ log), (camera**2).sum(axis=0)[follows] / product[follows]]
    all_slopes = np.concatenate(slopes)
    return float(all_slopes.min()), float(all_slopes.max())


def _level(logged: Logged, temperature: Array) -> Found:
    """Distance of a logged level from the levels of the table."""
    level, table = float(np.median(temperature)), np.median(logged.near.temperature[logged.inside], axis=0)
    low, high = float(table.min()), float(table.max())
    off = max(low - level, 0.0) - max(level - high, 0.0)
    return judge(off, _LARGEST_LEVEL_K, passed=abs(off) <= _LARGEST_LEVEL_K, low=low, high=high, level=level)


@check("fields", CAMERA, waits=True)
def sensors_rise(
    fields: xr.Dataset, sensor_temperature: xr.DataArray, sensor_x_mm: Array, sensor_y_mm: Array, sensor_u_K: float
) -> Found | None:
    """The camera's rise at the places of contact sensors against theirs: within `_LIMIT` standard uncertainties."""
    compared = []
    for k, name in enumerate(sensor_temperature["sensor"].values):
        seen = field_at(fields, (float(sensor_x_mm[k]), float(sensor_y_mm[k])))
        if seen is None:
            continue
        at = seen.since_start(sensor_temperature["time"].values)
        inside = (seen.seconds >= at[0]) & (seen.seconds <= at[-1])
        if inside.sum() < 2:
            continue
        logged = np.interp(seen.seconds[inside], at, sensor_temperature.values[:, k])
        camera = seen.temperature[inside, 0]
        # Means over the first and the last tenth: what is compared is the rise, not its noise.
        ends = max(1, int(inside.sum()) // 10)
        rises = [float(values[-ends:].mean() - values[:ends].mean()) for values in (camera, logged)]
        cell = fields["temperature_rise_u"].isel(cycle=-1).sel(x=sensor_x_mm[k], y=sensor_y_mm[k], method="nearest")
        u = float(np.sqrt(np.nan_to_num(float(cell)) ** 2 + 2.0 * sensor_u_K**2 + (_CONTACT * rises[1]) ** 2))
        compared.append((abs(rises[0] - rises[1]) / u, str(name), rises[0], rises[1], u))
    if not compared:
        return None
    worst, sensor, camera_K, sensor_K, u_K = max(compared)
    facts: dict[str, Any] = {"sensor": sensor, "camera_K": camera_K, "sensor_K": sensor_K, "u_K": u_K}
    return judge(worst, _LIMIT, compared=len(compared), **facts)
