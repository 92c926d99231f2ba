"""Checks of the logs: whether they cover the time of the readings, and whether their temperature sensors are sound."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.align import covered_share, likely_zone_shift
from fusion.analysis.alignment.sensor_health import Kind, examine_sensors
from fusion.analysis.consistency.checks import Check, Severity, judge
from fusion.analysis.consistency.field_series import FieldSeries, field_at
from fusion.common import Array

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


def check_log(log: xr.Dataset | None, times: NDArray[np.datetime64], *, name: str, file: str) -> list[Check]:
    """Check that a log covers the time of the readings."""
    if log is None or log.sizes["time"] == 0:
        return []
    readings = times[~np.isnat(times)]
    if readings.size == 0:
        return []
    logged = log["time"].values
    covered = _covered(logged, readings)
    passed = covered >= _LEAST_COVERED
    # Where the log begins before nearly all readings and ends after them, what it lacks are gaps inside it.
    gaps = not passed and covered_share(readings, logged) >= _LEAST_COVERED
    late_s = None if passed or gaps else likely_zone_shift(readings, logged)
    clear = late_s is not None and covered < _COVERED_NOW and _same_ends(logged, readings, late_s)
    first, last, start, end = (
        f"{np.datetime_as_string(time, unit='s')}Z" for time in (*logged[[0, -1]], readings.min(), readings.max())
    )
    apart_s = max(readings.min() - logged[-1], logged[0] - readings.max()) / np.timedelta64(1, "s")
    evidence = f"{file} ({first} to {last}) covers {100.0 * covered:.0f} % of the readings ({start} to {end})"
    if gaps:
        evidence += "; the others fall into gaps of the log"
    if late_s is not None:
        hours = f"{abs(late_s) / 3600.0:g} h {'late' if late_s > 0.0 else 'early'}"
        evidence += f", and nearly all of them if its clock is {hours}"
    return [
        judge(
            f"{name}_coverage",
            covered,
            _LEAST_COVERED,
            f"{evidence}.",
            f"Log without a break in the next test; what happened in the gaps of {file} is not known."
            if gaps
            else f"Check the date, the clock and the time zone of {file} (write its times with their zone, or time_zone), or leave it out "
            "of the campaign file.",
            passed=passed,
            severity=Severity.CONTRADICTION if apart_s > _APART_S or clear else Severity.DOUBT,
        )
    ]


def check_contact_sensors(environment: xr.Dataset | None, drivers: xr.Dataset | None, *, file: str) -> list[Check]:
    """Check that the temperature sensors of the environment log are sound."""
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
    # One reading throughout is that of a stable room or of a stuck sensor: `material_still` tells which where the table is seen.
    changing = {
        sensor for sensor, column in enumerate(columns.values()) if np.unique(column[np.isfinite(column)]).size > 1
    }
    clear = [fault for fault in faults if fault.is_clear and (fault.kind is not Kind.STUCK or fault.sensor in changing)]
    names = [f"{list(columns)[fault.sensor].replace('_', ' ')} {fault.words}" for fault in clear]
    return [
        judge(
            "contact_sensors",
            len(names),
            0.0,
            f"{file}: {'; '.join(names)}.",
            f"Check contact and cable, and leave the log out from then on ({file}).",
            sound=f"No contact sensor of {file} shows a step, ramp, stuck-at or drop-out fault.",
        )
    ]


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


# Contact sensors on the table against each other, and against the camera that sees their places.

#: Largest difference between camera and sensors in standard uncertainties.
_LIMIT = 3.0
#: Standard uncertainty of the rise under a surface probe relative to that of the surface (contact, stem conduction), as a share of it.
_CONTACT = 0.02


def compare_sensors(
    fields: xr.Dataset, temperature: xr.DataArray, x_mm: Array, y_mm: Array, *, u_K: float
) -> list[Check]:
    """Check the camera's rise at the places of contact sensors against theirs."""
    compared = []
    for k, name in enumerate(temperature["sensor"].values):
        seen = field_at(fields, (float(x_mm[k]), float(y_mm[k])))
        if seen is None:
            continue
        at = seen.since_start(temperature["time"].values)
        inside = (seen.seconds >= at[0]) & (seen.seconds <= at[-1])
        if inside.sum() < 2:
            continue
        logged = np.interp(seen.seconds[inside], at, temperature.values[:, k])
        camera = seen.temperature[inside, 0]
        # Means over the first and the last tenth: what is compared is the rise, not its noise.
        ends = max(1, int(inside.sum()) // 10)
        rises = [float(values[-ends:].mean() - values[:ends].mean()) for values in (camera, logged)]
        cell = fields["temperature_rise_u"].isel(cycle=-1).sel(x=x_mm[k], y=y_mm[k], method="nearest")
        u = float(np.sqrt(np.nan_to_num(float(cell)) ** 2 + 2.0 * u_K**2 + (_CONTACT * rises[1]) ** 2))
        compared.append((abs(rises[0] - rises[1]) / u, str(name), rises[0], rises[1], u))
    if not compared:
        return []
    worst, sensor, camera_K, sensor_K, u = max(compared)
    return [
        judge(
            "sensors_rise",
            worst,
            _LIMIT,
            f"At {sensor} the camera shows a rise of {camera_K:.2f} K, the sensor of {sensor_K:.2f} K; standard uncertainty of the "
            f"difference {u:.2f} K ({len(compared)} sensors compared, this one differs most).",
            "Check emissivity and reflected_temperature, the places of the sensors and their contact.",
        )
    ]


# Camera and environment log against each other: an emissivity error appears as a gain, a reflected-temperature error
# as an offset.

#: Time constants of a material sensor that are tried, s: from a thermocouple in a hole to a magnetic probe.
SENSOR_LAGS_S = (0.0, 180.0, 360.0, 600.0, 900.0)
#: The sensor follows the table only where the course of a cell leaves less than this share of its standard deviation.
LEAST_FOLLOWED = 0.3
#: Resolution of a logged temperature, K: smaller differences mean nothing.
RESOLUTION_K = 0.01
#: Share by which the rise under a surface probe may differ from that of the surface: contact and stem conduction, 2 standard
#: uncertainties of 2 %.
_CONTACT_SHARE = 0.04
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
#: Fewest frames from which a course can be distinguished from another one.
_LEAST_FRAMES = 12
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
#: What confirms the scale of the camera's rise.
_KEEP_IN_VIEW = (
    "Keep a surface of constant temperature in view (reference_patch under [thermography]), which shows the camera's zero, and check the "
    "contact of the material sensor."
)
_STATE_PLACE = (
    "State where the material sensor sits on the table: material_sensor under [interferometry], its place on the plan."
)


def compare_course(cells: Array, logged: Array) -> tuple[Array, float]:
    """Return what a constant and a positive multiple of every cell leave of a logged temperature, and its standard deviation, K."""
    centred, target = cells - cells.mean(axis=0), logged - logged.mean()
    product = np.maximum(centred.T @ target, 0.0)
    explained = product**2 / np.maximum((centred**2).sum(axis=0), 1e-12)
    left = np.maximum(target @ target - explained, 0.0)
    return np.sqrt(left / logged.size), float(target.std())


def _material(near: FieldSeries | None, log: xr.Dataset | None) -> tuple[Array, Array] | None:
    """Whether the log covers each frame, and the logged material temperature at those that it covers."""
    if near is None or log is None or "material_temperature" not in log:
        return None
    at = near.since_start(log["time"].values)
    inside = (near.seconds >= at[0]) & (near.seconds <= at[-1])
    if inside.sum() < 2:
        return None
    return inside, np.interp(near.seconds[inside], at, log["material_temperature"].values)


def rise_share_u(near: FieldSeries | None, log: xr.Dataset | None, *, stated: bool) -> float | None:
    """Standard uncertainty of the camera's rise, as a share of it, that a material sensor leaves; None where it tells nothing."""
    compared = _material(near, log)
    if near is None or compared is None:
        return None
    slopes = _slopes(near, *compared, stated=stated)
    # Every scale at which some place of the sensor fits is as likely (rectangular, JCGM 100:2008, 4.3.7).
    return (
        None if slopes is None else float(np.hypot(_CONTACT, max(abs(slope - 1.0) for slope in slopes) / np.sqrt(3.0)))
    )


def check_material(near: FieldSeries | None, log: xr.Dataset | None, *, stated: bool, file: str) -> list[Check]:
    """Check course, rise and level of the camera's temperature and the logged material temperature against each other."""
    compared = _material(near, log)
    if near is None or log is None or compared is None:
        words = "Scale not verified: no material temperature is logged with the frames, which would confirm the camera's rise."
        remedy = "Log a contact sensor on the table (material_temperature in the environment log), and state its place (material_sensor)."
        return [judge("material_rise", 0.0, _UNKNOWN_PLACE, words, unverified=remedy)]
    inside, logged = compared
    checks = [
        _same_course(near, inside, logged, file=file),
        _still(near, inside, logged, file=file),
        _rise(near, inside, logged, stated=stated),
        *([_gain(near, inside, logged)] if stated else []),
        _level(near.temperature[inside], logged),
    ]
    if "air_temperature" not in log:
        return checks
    air = np.interp(near.seconds[inside], near.since_start(log["time"].values), log["air_temperature"].values)
    columns = judge(
        "environment_columns",
        not _agrees(near, inside, logged, stated=stated) and _agrees(near, inside, air, stated=stated),
        0.0,
        f"In {file} the air temperature follows the table in time course, rise and level, and the material temperature does not: the "
        "columns look exchanged.",
        f"Check the headings air_temperature and material_temperature of {file}.",
        sound=f"The columns of air and material temperature in {file} do not look exchanged.",
    )
    if columns.passed:
        return [*checks, columns]
    first = "See environment_columns first: with both columns exchanged, camera and log agree. "
    return [*(one if one.passed else replace(one, remedy=first + one.remedy) for one in checks), columns]


def _same_course(near: FieldSeries, inside: Array, logged: Array, *, file: str) -> Check:
    """Correlation of material and surface temperature: low where frames are out of order, a clock is off, or the sensor sits elsewhere."""
    change = float(np.ptp(logged))
    left = 0.0
    if change >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES:
        # Share of the log's standard deviation that a constant and a positive multiple of the most similar cell leave.
        courses = [compare_course(near.lagged(lag_s)[inside], logged) for lag_s in SENSOR_LAGS_S]
        left = min(float(unexplained_K.min()) for unexplained_K, _ in courses) / max(courses[0][1], RESOLUTION_K)
    logs = f"The material temperature in {file} changes by {change:.2g} K"
    return judge(
        "material_course",
        left,
        _LARGEST_LEFT,
        f"{logs}; no surface temperature on the table correlates with it: the best one leaves {100.0 * left:.0f} % unexplained.",
        f"Check the order, the times and the day of the frames and of the rows of {file}, its columns, and whether the sensor sits on "
        "the table.",
        sound=f"{logs}; consistent with the table.",
    )


def _still(near: FieldSeries, inside: Array, logged: Array, *, file: str) -> Check:
    """A sensor that shows less than every part of the table does is stuck, or sits elsewhere."""
    change = float(np.ptp(logged))
    least = float(np.ptp(near.lagged(SENSOR_LAGS_S[-1])[inside], axis=0).min())
    testable = least >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES
    share = change / least if testable else 1.0
    shown = f"changes by {change:.2g} K" if change > 0.0 else f"stays at {logged[0]:g} degC to the last digit"
    return judge(
        "material_still",
        share,
        _LEAST_SHARE,
        f"The material temperature in {file} {shown}, the table by at least {least:.2g} K{'' if testable else ': cannot be tested'}.",
        f"Check the material sensor: its cable, its column in {file}, and whether it sits on the table.",
        passed=share >= _LEAST_SHARE,
    )


def _agrees(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> bool:
    """Whether a logged temperature shows course, rise and level of the table."""
    slopes = _slopes(near, inside, logged, stated=stated)
    if slopes is None or abs(_off(slopes)) > _rise_limit(logged, stated=stated):
        return False
    return _level(near.temperature[inside], logged).passed


def _rise(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> Check:
    """The camera's rise per K of the logged one."""
    change, limit = float(np.ptp(logged)), _rise_limit(logged, stated=stated)
    slopes = _slopes(near, inside, logged, stated=stated)
    if slopes is None:
        untestable = (
            f"Scale not verified: the logged material temperature changes by {change:.2g} K and does not show it."
        )
        remedy = "State the emissivity with its uncertainty." if stated else _STATE_PLACE
        return judge("material_rise", 0.0, limit, untestable, unverified=remedy)
    off = _off(slopes)
    where = "at the sensor's place" if stated else "where it resembles the sensor most"
    open_scale = _STATE_PLACE if not stated else _KEEP_IN_VIEW if slopes[1] - slopes[0] > 2.0 * limit else ""
    why = "the two do not change in proportion" if stated else "the place of the material sensor is not known"
    unknown = f"Scale not verified, {why}. " if open_scale and abs(off) <= limit else ""
    return judge(
        "material_rise",
        off,
        limit,
        f"{unknown}The camera's rise {where} is {slopes[0]:.3g} to {slopes[1]:.3g} times that of the logged material temperature, which "
        f"changes by {change:.2g} K.",
        "Check emissivity, object_distance and reflected_temperature (a rise that is too large comes from an emissivity that is too "
        "small), the drift of the camera, and whether the sensor sits on the table (material_sensor under [interferometry]).",
        passed=abs(off) <= limit,
        unverified=open_scale,
    )


def _gain(near: FieldSeries, inside: Array, logged: Array) -> Check:
    """Change through the test of the camera's rise per K of the logged one, apart from a steady drift of its zero."""
    limit, seconds = _rise_limit(logged, stated=True), near.seconds[inside]
    passed = np.asarray((seconds - seconds.mean()) / np.ptp(seconds))
    lagged = [near.lagged(lag_s)[inside, 0] for lag_s in SENSOR_LAGS_S]
    # What a sensor makes of the course between two frames is not noise: its weight is judged by leaving out parts of the test.
    part = np.minimum((_PARTS * np.arange(len(logged))) // len(logged), _PARTS - 1)
    fits = []
    # A sensor shows the place through a time constant between two of those that are tried, from a state that is not known: what was
    # before the first frame fades with that time constant, and in a table that warms ever more slowly it looks like a change of gain.
    for (faster, slower), lag_s in zip(pairwise(lagged), SENSOR_LAGS_S[1:], strict=True):
        centred, fades = faster - faster.mean(), np.exp(-seconds / lag_s)
        design = np.column_stack(
            [np.ones(len(centred)), centred, slower - slower.mean(), passed, passed * centred, fades]
        )
        found = np.array(
            [np.linalg.lstsq(design[part != k], logged[part != k], rcond=None)[0] for k in range(-1, _PARTS)]
        )
        gains = found[:, 1] + found[:, 2]
        if (gains > 0.0).all():
            changes = -found[:, 4] / gains
            rest = logged - design @ found[0]
            fits.append((float(rest @ rest), float(changes[0]), float(np.sqrt((_PARTS - 1) * np.var(changes[1:])))))
    # Of the time constants that fit as well as the best one, the one that asks for the least change.
    as_good = min((left for left, _, _ in fits), default=0.0) * np.exp(2.0 * _AS_GOOD / len(logged))
    change, u = min(
        ((change, u) for left, change, u in fits if left <= as_good),
        key=lambda fit: abs(fit[0]) - _PARTS_95 * fit[1],
        default=(0.0, np.inf),
    )
    testable = float(np.ptp(logged)) >= _LEAST_CHANGE_K and inside.sum() >= _LEAST_FRAMES and u <= limit
    evidence = (
        "The camera's rise at the sensor's place per K of the logged material temperature changes by "
        f"{change:+.2g} ± {_PARTS_95 * u:.2g} from the first to the last frame."
    )
    untestable = "The logged material temperature does not show whether the camera's gain stayed the same."
    return judge(
        "material_gain",
        max(abs(change) - _PARTS_95 * u, 0.0) if testable else 0.0,
        limit,
        evidence if testable else untestable,
        "Check the window before the camera (dirt, condensation) and its transmission, what the table reflects, and the sensor's contact.",
    )


def _rise_limit(logged: Array, *, stated: bool) -> float:
    """Share by which the camera's rise may differ from that of the log."""
    return (_CONTACT_SHARE if stated else _UNKNOWN_PLACE) + _CAMERA_DRIFT_K / max(
        float(np.ptp(logged)), _LEAST_CHANGE_K
    )


def _off(slopes: tuple[float, float]) -> float:
    """Distance of a range of slopes from 1, with its sign; 0 where it contains 1."""
    low, high = slopes
    return max(low - 1.0, 0.0) - max(1.0 - high, 0.0)


def _slopes(near: FieldSeries, inside: Array, logged: Array, *, stated: bool) -> tuple[float, float] | None:
    """Smallest and largest slope of the camera over the log that the data allow; None where it changes little or no cell follows it."""
    if float(np.ptp(logged)) < _LEAST_CHANGE_K or inside.sum() < _LEAST_FRAMES:
        return None
    step = max(1, round(_SHORT_TERM_S / float(np.median(np.diff(near.seconds[inside])))))
    courses = []
    for lag_s in SENSOR_LAGS_S:
        cells = near.lagged(lag_s)[inside]
        courses.append((*compare_course(cells, logged), cells))
    best = max(min(float(unexplained_K.min()) for unexplained_K, _, _ in courses), 0.5 * RESOLUTION_K)
    if best > LEAST_FOLLOWED * courses[0][1]:
        return None
    as_good = best * float(np.exp(_AS_GOOD / logged.size))
    if not stated:
        as_good = max(as_good, _PROBE_K)
    slopes = []
    for unexplained_K, _, cells in courses:
        chosen = cells[:, unexplained_K <= as_good]
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
    return judge(
        "material_level",
        off,
        _LARGEST_LEVEL_K,
        f"The table reads {table.min():.1f} to {table.max():.1f} degC, the logged material temperature {level:.1f} degC.",
        "Check reflected_temperature, emissivity, the stored transmission, and where the material sensor sits.",
        passed=abs(off) <= _LARGEST_LEVEL_K,
    )
