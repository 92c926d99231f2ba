"""Checks of the clocks against one another, loads and material temperature against the field, the field against the drift; scale of loads.

Each compares two courses at many shifts of one clock. A shift is doubted only where it lies outside the delays that physics makes and
explains far more than every delay within them; where the data cannot tell, the check is passed and says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.consistency.checks import Check, judge
from fusion.analysis.consistency.field_series import FieldSeries
from fusion.analysis.consistency.logs import LEAST_FOLLOWED, RESOLUTION_K, SENSOR_LAGS_S, compare_course
from fusion.analysis.drift_model.fit import SHIFT_AND_STRETCH, Term, fit_model, scaled_systems
from fusion.analysis.drift_model.gains import by_width, profile_gains
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

#: Time constants of source and table through which a load is seen, s: 5 and 20 min; half an hour, two and ten hours.
_SOURCE_S, _TABLE_S = (300.0, 1200.0), (1800.0, 7200.0, 36_000.0)
#: Leading modes of the field's rate: source and table make two, the rest is noise.
_MODES = 2
#: Share of the variance of the field's rate that the load must explain, and the factor by which a shift must lessen what is left: half
#: the standard deviation.
_LEAST_EXPLAINED, _LEFT_RATIO = 0.6, 4.0
#: A load whose largest value grows or falls by this factor from one sample to the next may have changed its unit; ...
_SCALE_JUMP = 20.0
#: ... by one of these: minutes or seconds, per cent, thousands, hours or seconds.
_SCALES = (60.0, 100.0, 1000.0, 3600.0)
#: Largest load in per cent: drives may be overloaded.
_PER_CENT = 200.0
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


@dataclass(frozen=True)
class Shift:
    """A shift of a clock that explains two courses better than every delay of physics.

    Attributes
    ----------
    seconds : by how much the log is late, s
    left, left_within : what the shift leaves unexplained, and what the best delay of physics leaves, as shares of the standard deviation
    """

    seconds: float
    left: float
    left_within: float


def check_material_clock(near: FieldSeries | None, log: xr.Dataset | None, *, file: str) -> list[Check]:
    """Check the clock of the environment log: the material temperature follows the camera's."""
    if near is None or log is None or "material_temperature" not in log:
        return []
    shift = _material_shift(near, near.since_start(log["time"].values), log["material_temperature"].values)
    return [_log_check("environment_clock", file, "material temperature", shift)]


def _material_shift(near: FieldSeries, at: Array, logged: Array) -> Shift | None:
    """Shift by which the log follows a cell, None where the delays of physics do nearly as well or no shift does."""
    courses = [near.lagged(lag_s) for lag_s in SENSOR_LAGS_S]
    left, spread = np.full(_LOG_SHIFTS_S.size, np.inf), np.ones(_LOG_SHIFTS_S.size)
    for k, shift in enumerate(_LOG_SHIFTS_S):
        inside = (near.seconds + shift >= at[0]) & (near.seconds + shift <= at[-1])
        if inside.sum() < max(12, _LEAST_COMMON * near.seconds.size):
            continue
        target = np.interp(near.seconds[inside] + shift, at, logged)
        compared = [compare_course(cells[inside], target) for cells in courses]
        left[k] = max(min(float(unexplained_K.min()) for unexplained_K, _ in compared), RESOLUTION_K)
        spread[k] = max(compared[0][1], RESOLUTION_K)
    within = _delays(_SENSOR_EARLY_S)
    if not np.isfinite(left[within]).any():
        return None
    share = left / spread
    best, allowed = int(np.argmin(share)), np.flatnonzero(within)[np.argmin(share[within])]
    if within[best] or share[best] > LEAST_FOLLOWED or share[allowed] < _MISFIT_RATIO * share[best]:
        return None
    return Shift(float(_LOG_SHIFTS_S[best]), float(share[best]), float(share[allowed]))


def _delays(early_s: float) -> NDArray[np.bool_]:
    """Which of the shifts are no larger than the delays of physics."""
    return np.asarray((-early_s <= _LOG_SHIFTS_S) & (np.abs(_LOG_SHIFTS_S) <= _LOG_DELAY_S))


def check_load_clock(field: FieldSeries | None, log: xr.Dataset | None, *, file: str) -> list[Check]:
    """Check the clock of the drivers' log: the field's rate follows the load."""
    loads = [] if log is None else [column for column in log.data_vars.values() if _is_load(column)]
    if field is None or log is None or not loads:
        return []
    at, rate = field.since_start(log["time"].values), _Rate.of(field)
    shifts = [_load_shift(rate, at, column.values.astype(float)) for column in loads]
    best = min((shift for shift in shifts if shift is not None), key=lambda shift: shift.left, default=None)
    return [_log_check("drivers_clock", file, "load", best)]


def check_load_scale(field: FieldSeries | None, log: xr.Dataset | None, *, file: str) -> list[Check]:
    """Check that a load keeps its unit: a share does not become per cent, and where a size jumps, the field's rate must follow."""
    loads = {} if log is None else {str(name): column for name, column in log.data_vars.items() if _is_load(column)}
    if field is None or log is None or not loads:
        return []
    at, rate = field.since_start(log["time"].values), _Rate.of(field)
    value, evidence = 1.0, f"No change of scale of the loads in {file} detected."
    for name, column in loads.items():
        load = column.values.astype(float)
        for start, factor in _scale_jumps(load):
            share = str(column.attrs.get("units", "")) == "1" and _share_and_per_cent(load, start)
            reason = "a share and per cent" if share else _rate_against_jump(rate, at, load, start, factor)
            if reason:
                value = 100.0 if share else max(factor, 1.0 / factor)
                since = np.datetime_as_string(log["time"].values[start], unit="s")
                size = "larger" if factor > 1.0 else "smaller"
                evidence = f"{name} in {file} is some {value:.0f} times {size} from {since}Z on: {reason}."
    remedy = f"Write all rows of {file} in one unit; a share is 0 to 1 or, throughout, per cent."
    return [judge("drivers_scale", value, _SCALE_JUMP, evidence, remedy, passed=value == 1.0)]


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
    """Whether a load is 0 to 1 on one side of a jump and up to some hundred on the other; flags and numbers of programs are whole."""
    sides = sorted((load[:start], load[start:]), key=lambda side: float(np.nanmax(np.abs(side))))
    share, other = (side[np.isfinite(side)] for side in sides)
    fractional = bool(np.any(share != np.rint(share)))
    shares = fractional and share.min() >= 0.0 and share.max() <= 1.0
    return bool(shares and other.min() >= 0.0 and 0.01 * _PER_CENT < other.max() <= _PER_CENT)


def _rate_against_jump(rate: _Rate, at: Array, load: Array, start: int, factor: float) -> str:
    """Why the field contradicts a jump of a load; empty where it does not."""
    corrected = np.where(np.arange(load.size) < start, load, load / factor)
    left, left_corrected = _load_left(rate, at, load), _load_left(rate, at, corrected)
    if left_corrected > 1.0 - _LEAST_EXPLAINED or left < _LEFT_RATIO * left_corrected:
        return ""
    as_logged, without = (100.0 * np.sqrt(share) for share in (left, left_corrected))
    return f"the load leaves {as_logged:.0f} % of the field's rate unexplained as it is logged, {without:.0f} % without that factor"


def _load_left(rate: _Rate, at: Array, load: Array) -> float:
    """Share of the variance of the field's rate that a load leaves, at the best delay of physics."""
    return float(rate.left(rate.columns(at, load, _LOG_SHIFTS_S[_delays(_LOG_DELAY_S)])).min())


def _is_load(column: xr.DataArray) -> bool:
    """Whether a column may drive the field: numbers that change and are no temperature."""
    if column.dtype.kind not in "fiu" or str(column.attrs.get("units", "")) in ("degC", "K"):
        return False
    finite = np.isfinite(column.values)
    return int(finite.sum()) >= 2 and float(np.ptp(column.values[finite])) > 0.0


@dataclass(frozen=True)
class _Rate:
    """Increments of the field's leading modes from frame to frame, whitened as a random walk, without a slow trend.

    Attributes
    ----------
    seconds : (n + 1,) times of the frames, s
    weight : (n,) one over the square root of each step
    trend : (n, 3) orthonormal columns of a steady rate and of a warm-up before the log
    modes : (n, 2) the increments
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
        grid = np.arange(at[0], at[-1] + 1.0, 60.0)
        finite = np.isfinite(load)
        steps = np.interp(grid, at[finite], load[finite])[:, None]
        shapes = [
            respond(respond(steps, grid, time_constant_s=source), grid, time_constant_s=table)[:, 0]
            for source in _SOURCE_S
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


def _load_shift(rate: _Rate, at: Array, load: Array) -> Shift | None:
    """Shift by which the field's rate follows a load, None where the delays of physics do nearly as well or chance does."""
    columns = rate.columns(at, load)
    shapes, left = columns.shape[1], rate.left(columns)
    flat = columns.reshape(-1, columns.shape[-1])
    within = np.repeat(_delays(_LOG_DELAY_S), shapes)
    best, allowed = int(np.argmin(left)), int(np.flatnonzero(within)[np.argmin(left[within])])
    if within[best] or 1.0 - left[best] < _LEAST_EXPLAINED or left[allowed] < _LEFT_RATIO * left[best]:
        return None
    if _chance_gain(rate, flat, within, flat[allowed]) >= np.log(left[allowed] / left[best]):
        return None
    return Shift(float(_LOG_SHIFTS_S[best // shapes]), float(np.sqrt(left[best])), float(np.sqrt(left[allowed])))


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


def _log_check(code: str, file: str, what: str, shift: Shift | None) -> Check:
    """The check of a log's clock, in minutes late."""
    limit_min = _LOG_DELAY_S / 60.0
    if shift is None:
        return judge(code, 0.0, limit_min, f"No clock offset of {file} detected beyond thermal and sensor lags.")
    minutes = shift.seconds / 60.0
    late = f"{abs(minutes):.0f} min {'late' if minutes > 0.0 else 'early'}"
    return judge(
        code,
        minutes,
        limit_min,
        f"{what[0].upper()}{what[1:]} and field agree where {file} is taken as {late} against the camera: they then leave "
        f"{100.0 * shift.left:.0f} % of each other unexplained, as stated at least {100.0 * shift.left_within:.0f} %.",
        f"Check the clock and the time zone of {file}; if another log is off by the same amount, those of the camera (clock_offset).",
        passed=False,
    )


def check_camera_clock(readings: Readings) -> list[Check]:
    """Check the clock of the camera against the laser's: the drift of the readings follows the field."""
    if "mean_rise" not in readings.series:
        return []
    limit = _STRUCTURE_DELAY_S / 60.0
    gain = _gain_of_shifts(readings)
    within = np.abs(_CAMERA_SHIFTS_S) <= _STRUCTURE_DELAY_S
    best = int(np.argmax(gain))
    more = float(gain[best] - gain[within].max())
    if more < _LEAST_GAIN or more < _GAIN_SHARE * gain[best]:
        none = f"No clock offset of the camera detected beyond the thermal lag of the machine; {_noticed(gain)}."
        return [judge("camera_clock", 0.0, limit, none)]
    near = gain >= gain[best] - 2.0
    low, high = _CAMERA_SHIFTS_S[near].min() / 60.0, _CAMERA_SHIFTS_S[near].max() / 60.0
    minutes = float(_CAMERA_SHIFTS_S[best]) / 60.0
    late = f"{abs(minutes):.0f} min {'late' if minutes > 0.0 else 'early'}"
    return [
        judge(
            "camera_clock",
            minutes,
            limit,
            f"The drift of the readings follows the field where the camera's clock is taken as {late} ({low:.0f} to {high:.0f} min) "
            f"against the laser's; the likelihood gains {more:.0f} over the stated offset.",
            "Check clock_offset, the camera's clock, and the time zone of the laser's file (time_zone).",
            passed=False,
        )
    ]


def _noticed(gain: Array) -> str:
    """From which shift on a wrong clock would have been noticed, as no delay of the machine does nearly as well."""
    best = float(gain.max())
    needed = max(_LEAST_GAIN, _GAIN_SHARE * best)
    least = None
    for size in _CAMERA_SHIFTS_S[_CAMERA_SHIFTS_S > _STRUCTURE_DELAY_S][::-1]:
        delays = [np.abs(_CAMERA_SHIFTS_S - shift) <= _STRUCTURE_DELAY_S for shift in (-size, size)]
        if any(best - gain[inside].max() < needed for inside in delays):
            break
        least = float(size)
    if least is None:
        return f"a clock that is off by up to {_CAMERA_SHIFTS_S[-1] / 60.0:.0f} min would not be detected here"
    return f"one that is off by {least / 60.0:.0f} min or more would have been detected"


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
