"""Courses of two recordings at many shifts of one clock: loads and material temperature against the field, the field against the drift.

A lateness is contradicted where another one explains far more than it does with every delay that physics makes. The scale of the loads is
checked on the way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.consistency.checks import LOG, Found, check, judge
from fusion.analysis.consistency.clocks import COURSES, QUARTER_S, QUARTERS, Evidence
from fusion.analysis.consistency.logs import SOURCE_S, even_times, loads_of
from fusion.analysis.consistency.material import LEAST_FOLLOWED, RESOLUTION_K, SENSOR_LAGS_S, compare_course
from fusion.analysis.consistency.series import LEAST_FRAMES, FieldSeries
from fusion.analysis.drift_model.gains import by_width, profile_gains
from fusion.analysis.drift_model.model import SHIFT_AND_STRETCH, Term, fit_model, scaled_systems
from fusion.analysis.effects.effect import Candidate
from fusion.common import Array
from interferometry.drift.kalman import DriftModelError

#: Shifts of a log that are tried, s: three hours, as far as time zones of one country lie apart, in steps of two minutes.
_LOG_SHIFTS_S = np.arange(-10_800.0, 10_801.0, 120.0)
#: Delays of a log against the field that are no clock's, s: a sensor follows late; heat takes minutes from a source to the surface, and a
#: source of another time constant than those tried looks early or late.
_SENSOR_EARLY_S, _LOG_DELAY_S = 300.0, 900.0
#: A shift must leave this many times less of the material temperature than every delay of physics does (variance ratio of 9, which
#: two series of eight independent values each show by chance once in 200 times).
_MISFIT_RATIO = 3.0
#: Share of the frames that a shifted log must still cover.
_LEAST_COMMON = 0.5

#: Time constants of the table through which a load is seen, s: half an hour, two and ten hours.
_TABLE_S = (1800.0, 7200.0, 36_000.0)
#: Leading modes of the field's rate: source and table make two, the rest is noise.
_MODES = 2
#: Share of the variance of the field's rate that the load must explain, and the factor by which a shift must lessen what is left: half
#: the standard deviation.
_LEAST_EXPLAINED, _LEFT_RATIO = 0.6, 4.0
#: The same of a load that was read backwards: a sound one leaves less than its reverse does.
_BACKWARDS_RATIO = 2.0
#: A load whose largest value grows or falls by this factor from one sample to the next may have changed its unit; ...
_SCALE_JUMP = 20.0
#: ... by one of these: minutes or seconds, per cent, thousands, hours or seconds.
_SCALES = (60.0, 100.0, 1000.0, 3600.0)
#: Largest load in per cent: drives may be overloaded.
_PER_CENT = 200.0
#: A load that explains less than the same log does at half of all other times, of which so many are tried, is not what heats the table.
#: That is told where the load's standard deviation is a quarter of its largest value, so that it shapes what it heats, and where the
#: field's rate has a structure (normal deviate of its correlation from frame to frame, p = 1e-3) that warms some part by half a kelvin
#: apart from a steady trend: a room that swings by 2 K in an hour warms a table of 40 mm by less.
_OTHER_TIMES, _MOST_OTHER_TIMES, _LEAST_VARIATION, _STRUCTURED, _LEAST_WARMED_K = 60, 0.5, 0.25, 3.1, 0.5
#: Share of the rows with the largest value from which a load may have been clipped, where it is reached more than once; and the shortest
#: time between changes, s, from which a load may be a mean: the frames resolve less.
_CLIPPED_SHARE, _HELD_S = 0.2, 900.0
#: Values from which on it is unlikely that a load which is switched among levels meets each of them but the largest once.
_LEVELS = 4
#: Resampled courses, none of which may gain as much, from blocks of this length, s.
_DRAWS, _BLOCK_S = 400, 1800.0

#: Shifts of the camera's clock that are tried on the drift, s.
_CAMERA_SHIFTS_S = np.arange(-7200.0, 7201.0, 300.0)
#: Delays between field and drift that structures out of sight make, s.
_STRUCTURE_DELAY_S = 1800.0
#: Log-likelihood that a shift must gain over every delay of a structure, and its share of all that the field explains. The gain is not
#: that of chance alone (some 8 for 49 shifts at 1 in 1000): an undeclared effect of its own course next to a weak field makes twice that.
_LEAST_GAIN, _GAIN_SHARE = 25.0, 0.5
#: Time constants, min, of a warm-up of laser and machine that may be fitted with the field.
_WARM_UPS_MIN = (15.0, 60.0)


def compare_material(near: FieldSeries | None, log: xr.Dataset | None) -> list[Evidence]:
    """Compare the logged material temperature with the camera's: what they say of the clock of the environment log."""
    if near is None or log is None or "material_temperature" not in log:
        return []
    at, logged = near.since_start(log["time"].values), log["material_temperature"].values
    courses = [near.lagged(lag_s) for lag_s in SENSOR_LAGS_S]
    share = np.full(_LOG_SHIFTS_S.size, np.inf)
    for k, shift in enumerate(_LOG_SHIFTS_S):
        inside = (near.seconds + shift >= at[0]) & (near.seconds + shift <= at[-1])
        if inside.sum() < max(LEAST_FRAMES, _LEAST_COMMON * near.seconds.size):
            continue
        target = np.interp(near.seconds[inside] + shift, at, logged)
        compared = [compare_course(cells[inside], target) for cells in courses]
        left = max(min(float(unexplained_K.min()) for unexplained_K, _ in compared), RESOLUTION_K)
        share[k] = left / max(compared[0][1], RESOLUTION_K)
    if share.min() > LEAST_FOLLOWED:
        return []
    what = "material temperature and field"
    return _as_evidence(share, _SENSOR_EARLY_S, _MISFIT_RATIO, second="environment", what=what)


def _as_evidence(misfit: Array, early_s: float, ratio: float, *, second: str, what: str) -> list[Evidence]:
    """What the misfits of a log at all shifts contradict: a lateness whose delays of physics all leave more than the best by a ratio."""

    def least(lateness_s: float, early_s: float, delay_s: float) -> float:
        within = (lateness_s - early_s <= _LOG_SHIFTS_S) & (lateness_s + delay_s >= _LOG_SHIFTS_S)
        return float(misfit[within].min(initial=np.inf))

    seconds, best = QUARTER_S * QUARTERS, float(misfit.min())
    cost, near = (
        np.log([least(s, *delays) / best for s in seconds]) / np.log(ratio)
        for delays in ((early_s, _LOG_DELAY_S), (0.5 * QUARTER_S, 0.5 * QUARTER_S))
    )
    if not np.isfinite(cost[seconds == 0.0]).all():
        # Too little of both was recorded at the same time.
        return []
    # What was not tried is contradicted as far as anything is.
    cost, near = (np.where(np.isfinite(one), one, one[np.isfinite(one)].max()) for one in (cost, near))
    return [Evidence("camera", second, cost, near, COURSES, what)]


def compare_load(field: FieldSeries | None, log: xr.Dataset | None) -> list[Evidence]:
    """Compare the loads with the rate of the field: what the load that explains most of it says of the clock of the drivers' log."""
    loads = loads_of(log)
    if field is None or log is None or not loads:
        return []
    at, rate = field.since_start(log["time"].values), _Rate.of(field)
    columns, left = min(
        ((one, rate.left(one)) for one in (rate.columns(at, load) for load in loads.values())),
        key=lambda of_load: float(of_load[1].min()),
    )
    if 1.0 - float(left.min()) < _LEAST_EXPLAINED:
        return []
    shapes = columns.shape[1]
    within = np.repeat(np.abs(_LOG_SHIFTS_S) <= _LOG_DELAY_S, shapes)
    flat, allowed = columns.reshape(-1, columns.shape[-1]), int(np.flatnonzero(within)[np.argmin(left[within])])
    gain = float(np.log(left[allowed] / left.min()))
    if gain > np.log(_LEFT_RATIO) and _chance_gain(rate, flat, within, flat[allowed]) >= gain:
        return []
    misfit = left.reshape(-1, shapes).min(axis=1)
    return _as_evidence(misfit, _LOG_DELAY_S, _LEFT_RATIO, second="drivers", what="load and field")


@check("fields", LOG)
def drivers_scale(field: FieldSeries, drivers: xr.Dataset) -> Found | None:
    """Largest value of a load before and after a sample at which it grows or falls by `_SCALE_JUMP` times: no column of unit 1 that is 0
    to 1 on one side, with fractions, and up to `_PER_CENT` on the other, or has all its levels there a hundred times as large; else, no
    factor of 60, 100, 1000 or 3600 without which the load leaves `_LEFT_RATIO` times less of the field's rate, and explains
    `_LEAST_EXPLAINED` of it.
    """
    loads = loads_of(drivers)
    if not loads:
        return None
    at, rate = field.since_start(drivers["time"].values), _Rate.of(field)
    value, facts = 1.0, dict[str, Any]()
    for name, load in loads.items():
        for start, factor in _scale_jumps(load):
            share = str(drivers[name].attrs.get("units", "")) == "1" and _share_and_per_cent(load, start)
            left = None if share else _left_without(rate, at, load, start, factor)
            if share or left is not None:
                value = 100.0 if share else max(factor, 1.0 / factor)
                since = np.datetime_as_string(drivers["time"].values[start], unit="s")
                facts = {"name": name, "grows": factor > 1.0, "since": since, "left": left}
    return judge(value, _SCALE_JUMP, passed=value == 1.0, **facts)


@check("fields", LOG)
def drivers_course(field: FieldSeries, drivers: xr.Dataset, environment: xr.Dataset | None = None) -> Found | None:
    """Share of the variance of the field's rate that the best load leaves, against the same log at `_OTHER_TIMES` other times, and
    backwards; tested where the load's standard deviation is at least `_LEAST_VARIATION` of its largest value and the rate has a structure
    of its own: doubted where all loads and the logged air together leave more than 0.4, and it leaves no less than at half of the other
    times or the log's own shape says that it shows less than the load ([below](#clocks)); or where backwards it leaves `_BACKWARDS_RATIO`
    times less and explains `_LEAST_EXPLAINED`.
    """
    loads = loads_of(drivers, constant=True)
    if not loads:
        return None
    at, rate = field.since_start(drivers["time"].values), _Rate.of(field)
    grid = even_times(at)
    courses = {name: np.interp(grid, at[np.isfinite(load)], load[np.isfinite(load)]) for name, load in loads.items()}
    lefts = {name: _load_left(rate, grid, course) for name, course in courses.items()}
    name = min(lefts, key=lambda one: lefts[one])
    course, left = courses[name], lefts[name]
    beside = [courses[other] for other in courses if other != name]
    if environment is not None and "air_temperature" in environment:
        air = environment["air_temperature"].dropna("time")
        beside += [np.interp(grid, field.since_start(air["time"].values), air.values)] if air.size else []
    together = _load_left(rate, grid, course, *beside)
    structured, explains_little = _is_structured(field, rate), together > 1.0 - _LEAST_EXPLAINED
    told = structured and course.std() >= _LEAST_VARIATION * np.abs(course).max()
    left_backwards = _load_left(rate, grid, course[::-1])
    is_backwards = told and left_backwards <= 1.0 - _LEAST_EXPLAINED and left > _BACKWARDS_RATIO * left_backwards
    at_other_times = 0.0
    if told and not is_backwards and explains_little:
        rolls = np.linspace(0, course.size, _OTHER_TIMES, endpoint=False, dtype=int)[1:]
        at_other_times = float(np.mean([_load_left(rate, grid, np.roll(course, k)) <= left for k in rolls]))
    constant = float(np.ptp(course)) == 0.0
    coarse = _coarse_kind(at, loads[name]) if explains_little and (_bends(field) if constant else structured) else {}
    return judge(
        left,
        1.0 - _LEAST_EXPLAINED,
        passed=not (is_backwards or coarse or at_other_times > _MOST_OTHER_TIMES),
        name=name,
        together=together if beside else None,
        backwards=left_backwards if is_backwards else None,
        coarse=coarse,
        at_other_times=at_other_times,
    )


def _coarse_kind(at: Array, load: Array) -> dict[str, Any]:
    """What a log that shows less than the load holds instead, by its own shape; empty where that does not tell."""
    at, load = at[np.isfinite(load)], load[np.isfinite(load)]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(load)) + 1])
    if starts.size == 1:
        return {"kind": "constant"}
    values, rows = np.unique(load, return_counts=True)
    lengths = np.diff([*starts, load.size])
    if values.size == 2:
        marks = bool((lengths[load[starts] == values[np.argmin(rows)]] == 1).all())
        return {"kind": "marks" if marks else "switch"}
    # Where other values than the largest and that at rest come back as well, the load is switched from level to level.
    _, times = np.unique(load[starts], return_counts=True)
    is_cut_off = times[-1] > 1 and times.size > _LEVELS and (times[1:-1] == 1).all()
    if is_cut_off and rows[-1] >= _CLIPPED_SHARE * load.size:
        return {"kind": "clipped", "largest": values[-1], "share": rows[-1] / load.size}
    # The first and the last stretch may have been cut off.
    held_s = np.diff(at[starts[1:]])
    if held_s.size > 1 and held_s.min() >= _HELD_S and np.allclose(held_s / held_s.min() % 1.0, 0.0, atol=0.01):
        return {"kind": "mean", "minutes": held_s.min() / 60.0}
    return {}


def _bends(field: FieldSeries) -> bool:
    """Whether half of the table changes in a course that no warm-up makes: a source that nobody logged bends a part of it."""
    fading = [np.exp(-field.seconds / time_constant_s) for time_constant_s in (*SOURCE_S, *_TABLE_S[:2])]
    smooth = np.column_stack([np.ones(field.seconds.size), field.seconds, *fading])
    bent = field.temperature - smooth @ np.linalg.lstsq(smooth, field.temperature, rcond=None)[0]
    return _follows(_Rate.of(field)) and bool(np.median(np.ptp(bent, axis=0)) > _LEAST_WARMED_K)


def _is_structured(field: FieldSeries, rate: _Rate) -> bool:
    """Whether the field changes in a course of its own that a load must follow."""
    steady = np.polynomial.polynomial.polyvander(field.seconds, 1)
    bent = field.temperature - steady @ np.linalg.lstsq(steady, field.temperature, rcond=None)[0]
    return _follows(rate) and bool(np.ptp(bent, axis=0).max() > _LEAST_WARMED_K)


def _follows(rate: _Rate) -> bool:
    """Whether the leading mode's rate is correlated from frame to frame."""
    leading = rate.modes[:, 0]
    follows = float(leading[1:] @ leading[:-1]) / max(float(leading @ leading), 1e-30) * np.sqrt(leading.size)
    return bool(follows > _STRUCTURED)


def _scale_jumps(load: Array) -> Iterator[tuple[int, float]]:
    """First sample on another scale, and the factor of `_SCALES` next to that of the largest values, or its inverse."""
    size = np.where(np.isfinite(load), np.abs(load), 0.0)
    for sizes, falls in ((size, False), (size[::-1], True)):
        largest = np.maximum.accumulate(sizes)
        jumps = np.flatnonzero((largest[:-1] > 0.0) & (sizes[1:] > _SCALE_JUMP * largest[:-1]))
        if jumps.size:
            ratio = largest[-1] / largest[jumps[-1]]
            scale = min(_SCALES, key=lambda known: abs(np.log(known / ratio)))
            yield (size.size - jumps[-1] - 1, 1.0 / scale) if falls else (int(jumps[-1]) + 1, scale)


def _share_and_per_cent(load: Array, start: int) -> bool:
    """Whether a load is 0 to 1 on one side of a jump and up to some hundred on the other; flags and numbers of programs are whole, and
    their levels do not all grow a hundredfold at once.
    """
    sides = sorted((load[:start], load[start:]), key=lambda side: float(np.nanmax(np.abs(side))))
    share, other = (side[np.isfinite(side)] for side in sides)
    levels = np.unique(share)
    same_levels = levels.size > 1 and bool(np.isin(other, 100.0 * levels).all())
    shares = (same_levels or bool(np.any(share != np.rint(share)))) and share.min() >= 0.0 and share.max() <= 1.0
    return bool(shares and other.min() >= 0.0 and 0.01 * _PER_CENT < other.max() <= _PER_CENT)


def _left_without(rate: _Rate, at: Array, load: Array, start: int, factor: float) -> tuple[float, float] | None:
    """Shares of the field's rate that a load leaves as it is logged and without its jump, where these contradict the jump; None else."""
    corrected = np.where(np.arange(load.size) < start, load, load / factor)
    left, left_corrected = _load_left(rate, at, load), _load_left(rate, at, corrected)
    if left_corrected > 1.0 - _LEAST_EXPLAINED or left < _LEFT_RATIO * left_corrected:
        return None
    return float(np.sqrt(left)), float(np.sqrt(left_corrected))


def _load_left(rate: _Rate, at: Array, *loads: Array) -> float:
    """Share of the variance of the field's rate that loads leave, one taken out after the other at its best delay of physics."""
    delays_s = _LOG_SHIFTS_S[np.abs(_LOG_SHIFTS_S) <= _LOG_DELAY_S]
    share = 1.0
    for load in loads:
        columns = rate.columns(at, load, delays_s)
        left = rate.left(columns)
        best = int(left.argmin())
        taken = columns.reshape(left.size, -1)[best]
        share *= float(left[best])
        rate = replace(rate, modes=rate.modes - np.outer(taken, taken @ rate.modes))
    return share


@dataclass(frozen=True)
class _Rate:
    """Increments (n, 2) of the field's leading modes from frame to frame (n + 1 times, s), whitened as a random walk by `weight` (n,), one
    over the square root of each step; `trend` (n, 3) holds orthonormal columns of a steady rate and of a warm-up before the log.
    """

    seconds: Array
    weight: Array
    trend: Array
    modes: Array

    @classmethod
    def of(cls, field: FieldSeries) -> _Rate:
        steps = np.diff(field.seconds)
        weight = 1.0 / np.sqrt(steps)
        increments = np.diff(field.temperature, axis=0)
        _, _, patterns = np.linalg.svd(increments, full_matrices=False)
        fading = [np.diff(-np.exp(-field.seconds / time_constant_s)) for time_constant_s in _TABLE_S[:2]]
        trend, _ = np.linalg.qr(np.column_stack([steps, *fading]) * weight[:, None])
        modes = (increments @ patterns[:_MODES].T) * weight[:, None]
        return cls(field.seconds, weight, trend, modes - trend @ (trend.T @ modes))

    def columns(self, at: Array, load: Array, shifts_s: NDArray[np.floating] = _LOG_SHIFTS_S) -> Array:
        """Unit responses to a load, (shifts, shapes, n), whitened and freed of the trend; zero where a load does not change."""
        grid = even_times(at)
        finite = np.isfinite(load)
        steps = np.interp(grid, at[finite], load[finite])[:, None]
        shapes = [
            respond(respond(steps, grid, time_constant_s=source), grid, time_constant_s=table)[:, 0]
            for source in SOURCE_S
            for table in _TABLE_S
        ]
        columns = np.empty((len(shifts_s), len(shapes), self.weight.size))
        length = np.empty((*columns.shape[:2], 1))
        # Shift after shift and in place: the columns of a long test fill the memory.
        for place, shift in enumerate(shifts_s):
            own = columns[place]
            for row, shape in zip(own, shapes, strict=True):
                row[:] = np.diff(np.interp(self.seconds + shift, grid, shape)) * self.weight
            own -= (own @ self.trend) @ self.trend.T
            length[place] = np.linalg.norm(own, axis=-1, keepdims=True)
        columns /= np.maximum(length, 1e-12)
        columns[~(length[..., 0] > 1e-9 * max(float(length.max()), 1e-12))] = 0.0
        return columns

    def left(self, columns: Array) -> Array:
        """Share of the modes' variance that each unit response (shifts, shapes, n) leaves, (shifts * shapes,)."""
        explained = ((columns.reshape(-1, columns.shape[-1]) @ self.modes) ** 2).sum(axis=1)
        return 1.0 - explained / max(float((self.modes**2).sum()), 1e-30)


def _chance_gain(rate: _Rate, columns: Array, within: NDArray[np.bool_], kept: Array) -> float:
    """Largest gain of a shift over the delays of physics in courses that follow a kept delay, (n,), and blocks of their own remainder."""
    rng = np.random.default_rng(1)
    fitted = np.outer(kept, kept @ rate.modes)
    remainder = rate.modes - fitted
    count = remainder.shape[0]
    block = max(2, round(_BLOCK_S * float(np.median(rate.weight)) ** 2))
    blocks = -(-count // block)
    starts = rng.integers(0, count, (_DRAWS, blocks, 1))
    places = ((starts + np.arange(block)) % count).reshape(_DRAWS, -1)[:, :count]
    signs = np.repeat(rng.choice([-1.0, 1.0], (_DRAWS, blocks)), block, axis=1)[:, :count]
    largest = 0.0
    for place, sign in zip(places, signs, strict=True):
        drawn = fitted + remainder[place] * sign[:, None]
        drawn -= rate.trend @ (rate.trend.T @ drawn)
        explained = ((columns @ drawn) ** 2).sum(axis=1)
        total = float((drawn**2).sum())
        gain = np.log((total - explained[within].max()) / (total - explained.max()))
        largest = max(largest, float(gain))
    return largest


def compare_drift(readings: Readings) -> list[Evidence]:
    """Compare the drift of the readings with the field: what they say of the camera's clock."""
    if "mean_rise" not in readings.series:
        return []
    gain = _gain_of_shifts(readings)
    best = float(gain.max())

    def lost(delay_s: float) -> Array:
        """What every lateness loses against the best; beyond those that are tried, as much as any of them."""
        within = np.abs(_CAMERA_SHIFTS_S - QUARTER_S * QUARTERS[:, None]) <= delay_s
        loss: Array = best - np.where(within, gain, -np.inf).max(axis=1)
        tried = np.isfinite(loss)
        return np.where(tried, loss, loss[tried].max()) / max(_LEAST_GAIN, _GAIN_SHARE * best)

    return [Evidence("laser", "camera", lost(_STRUCTURE_DELAY_S), lost(0.5 * QUARTER_S), COURSES, "drift and field")]


def _gain_of_shifts(readings: Readings) -> Array:
    """Gain in log-likelihood by the field at every shift of the camera's clock over no field at all, (shifts,)."""
    fading = [np.exp(-readings.seconds / (60.0 * minutes)) for minutes in _WARM_UPS_MIN]
    warm_up = np.column_stack([column * loading for column in fading for loading in readings.loadings.T])
    terms = [Term("warm_up", _candidate(warm_up)), Term("field", _candidate(_field_columns(readings, 0.0)))]
    try:
        model = fit_model(readings, terms)
    except DriftModelError:
        return np.zeros(_CAMERA_SHIFTS_S.size)
    candidates = [_candidate(_field_columns(readings, float(shift))) for shift in _CAMERA_SHIFTS_S]
    used = np.ones(readings.seconds.size, bool)
    gains = profile_gains(
        scaled_systems(model.fit, SHIFT_AND_STRETCH),
        readings.response[:, None],
        np.column_stack([model.profile, warm_up]),
        by_width(candidates, used),
    )
    return gains.gain[:, 0]


def _candidate(columns: Array) -> Candidate:
    return Candidate(columns, {}, ("um",) * columns.shape[1])


def _field_columns(readings: Readings, late_s: float) -> Array:
    """Expansion and offset by a field whose clock is late, (n, 2)."""
    columns = []
    for name, scale in (("axis_integral", 1e-3), ("mean_rise", 1.0)):
        series = readings.series[name]
        columns.append(scale * readings.at(Series(series.seconds - late_s, series.values, series.units)))
    return np.column_stack(columns)
