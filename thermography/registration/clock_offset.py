"""Offset of the camera's clock against the machine's: the observed motion of the table fitted to its commanded motion.

The commanded motion follows from the readings of a positioning test (time and target position) and the feed between them. A coarse
search finds the offset whose misfit is smallest, of several alike the one nearest to what is expected; least squares then fit offset,
zero of the observed position, feed and clock rate; the uncertainty is the largest of several estimates, because each of them fails in
some campaigns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from thermography.common import Array, ThermographyError

#: The observed travel of the table must be at least this many times the uncertainty of its position.
_LEAST_TRAVEL = 20.0
#: Two offsets are ambiguous if the misfit of the second is less than this many times that of the first, ...
_AMBIGUITY = 1.5
#: ... and the difference amounts to fewer than this many frames at `_FAR_MM`.
_DECIDING_FRAMES = 8
#: Offsets nearer than this to each other belong to one minimum, s.
_ONE_MINIMUM_S = 5.0
#: Step of the search, s.
_SEARCH_STEP_S = 0.5
#: Largest number of groups of the delete-a-group jackknife: consecutive frames.
_GROUPS = 20
#: Residuals are limited to this value in searches, mm: beyond it a frame contradicts the offset, however far it is.
_FAR_MM = 20.0
#: In shorter records the clock rate is taken as zero, s.
_RATE_AFTER_S = 3600.0
#: Residuals above this count linearly instead of squared (soft L1 loss), mm.
_LOSS_SCALE_MM = 0.5
#: Misfit that the steps of the starting grid alone cause, mm.
_GRID_MM = 1.0
#: Range, s, and number of steps either way of the profile of the misfit over the offset.
_PROFILE_S, _PROFILE_STEPS = 4.0, 30
#: Feeds tried, as multiples of the median feed that the readings require at least.
_FEEDS = np.geomspace(1.0, 20.0, 40)
#: Feeds are fitted from this one on, mm/s.
_LEAST_FEED_MM_S = 1e-3
#: Slowest feed, mm/s: the table arrives at the very time of the next reading.
_SLOWEST_MM_S = 1e-9


class ClockError(ThermographyError):
    """Nothing determines the clock offset; the message gives the reason and what to give instead."""


@dataclass(frozen=True)
class ClockOffset:
    """Time of the camera's clock minus that of the machine's at the middle of the frames, s, and its rate, 0 in records shorter than an
    hour, with standard uncertainties; zero (mm) and feed of the axis, fitted where not given; rms of observed minus commanded position,
    mm; and other offsets that fit about as well (periodic test), s.
    """

    offset_s: float
    offset_u_s: float
    rate: float
    rate_u: float
    start_mm: float
    feed_mm_per_min: float
    rms_mm: float
    frames: int
    rivals_s: tuple[float, ...] = ()


def estimate_clock_offset(
    frame_time: ArrayLike,
    table_mm: ArrayLike,
    table_u_mm: ArrayLike,
    reading_time: ArrayLike,
    target_mm: ArrayLike,
    *,
    feed_mm_per_min: float | None = None,
    reading_phase: float | None = None,
    search_s: float = 900.0,
    expected_s: float = 0.0,
) -> ClockOffset:
    """Estimate the offset of the camera's clock against the machine's from the observed and the commanded motion of the table.

    Where the instant of the reading within the stand is not known (`reading_phase` None: 0 on arrival, 1 just before the table moves on),
    the offset is that of the middle of the stand and its uncertainty contains the whole stand.
    """
    frame_s, origin = _seconds(frame_time)
    reading_s, _ = _seconds(reading_time, origin)
    table, table_u, target = (np.asarray(values, float) for values in (table_mm, table_u_mm, target_mm))
    located = np.isfinite(frame_s) & np.isfinite(table)
    order = np.argsort(reading_s)
    order = order[np.isfinite(reading_s[order]) & np.isfinite(target[order])]
    _check_travel(table[located], np.nan_to_num(table_u[located], nan=1.0), target[order])
    feed = None if feed_mm_per_min is None else feed_mm_per_min / 60
    phase = 1.0 if reading_phase is None else reading_phase
    variance = float(np.median(np.nan_to_num(table_u[located], nan=0.0))) ** 2
    motion = _Motion(frame_s[located], table[located], reading_s[order], target[order], feed, phase, variance)
    coarse_s, rivals_s = _search(motion, expected_s, search_s)
    best, u = _fit(motion, coarse_s)
    residual = motion.residual(best)
    inside = np.isfinite(residual)
    # The motion does not show when within the stand the laser read: a rectangular distribution (JCGM 100:2008, 4.3.7).
    stand_s = float(np.median(_stands_s(motion.reading_s, motion.target_mm, best[2]))) if reading_phase is None else 0.0
    return ClockOffset(
        offset_s=float(best[0]) - stand_s / 2,
        offset_u_s=float(np.hypot(u[0], stand_s / np.sqrt(12))),
        rate=float(best[3]),
        rate_u=float(u[3]),
        start_mm=float(-best[1]),
        feed_mm_per_min=float(60 * best[2]),
        rms_mm=float(np.sqrt(np.mean(residual[inside] ** 2))),
        frames=int(inside.sum()),
        rivals_s=rivals_s,
    )


def commanded_position(
    time_s: Array, reading_s: Array, target_mm: Array, feed_mm_s: float, *, reading_phase: float = 1.0
) -> Array:
    """Axis position during a positioning test: dwell at a target position, take the reading, move on at the feed, dwell."""
    dwell = _stands_s(reading_s, target_mm, feed_mm_s)
    leave = reading_s[:-1] + (1 - reading_phase) * dwell
    arrive = reading_s[1:] - reading_phase * dwell
    way_s = np.concatenate([[reading_s[0]], np.column_stack([leave, arrive]).ravel(), [reading_s[-1]]])
    way_mm = np.concatenate([[target_mm[0]], np.column_stack([target_mm[:-1], target_mm[1:]]).ravel(), [target_mm[-1]]])
    return np.interp(time_s, way_s, way_mm, left=np.nan, right=np.nan)


def _stands_s(reading_s: Array, target_mm: Array, feed_mm_s: float) -> Array:
    """How long the table stands between one reading and the next, s."""
    return np.maximum(np.diff(reading_s) - np.abs(np.diff(target_mm)) / feed_mm_s, 0.0)


def _seconds(times: ArrayLike, origin: np.datetime64 | None = None) -> tuple[Array, np.datetime64]:
    """Seconds since an origin (the first time by default), NaN for NaT, and the origin."""
    stamps = np.asarray(times, "datetime64[ns]").ravel()
    if origin is None:
        origin = stamps[~np.isnat(stamps)].min()
    seconds = (stamps - origin) / np.timedelta64(1, "ns") / 1e9
    return np.where(np.isnat(stamps), np.nan, seconds), origin


def _check_travel(table: Array, table_u: Array, target: Array) -> None:
    if len(table) < 20:
        raise ClockError(f"the table is found in {len(table)} frames; 20 are needed, or give clock_offset")
    if len(target) < 3:
        raise ClockError(f"{len(target)} readings have a time; a clock offset needs at least 3, or give clock_offset")
    observed, commanded = float(np.ptp(table)), float(np.ptp(target))
    if observed < _LEAST_TRAVEL * float(np.median(table_u)) or observed < 0.1 * commanded:
        raise ClockError(
            f"the observed travel of the table is {observed:.2f} mm, the commanded travel {commanded:g} mm: "
            "frames of a still table do not determine a clock offset; give clock_offset, or leave both clocks on UTC "
            'and write clock_offset = "0 s"'
        )


@dataclass(frozen=True)
class _Motion:
    """Observed against commanded motion; a feed of None, mm/s, is fitted.

    The parameters of the model, (4,), are the offset (s), the zero of the observed position (mm), the feed (mm/s) and the clock
    rate (s/s).
    """

    frame_s: Array
    table_mm: Array
    reading_s: Array
    target_mm: Array
    feed_mm_s: float | None
    reading_phase: float
    #: Of an observed position as stated, mm2; smaller residuals, as of positions without noise, leave the offset no better known.
    variance_mm2: float

    @property
    def middle_s(self) -> float:
        """Time at which the offset holds."""
        return float(self.frame_s.mean())

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of the parameters are fitted."""
        return np.array([True, True, self.feed_mm_s is None, np.ptp(self.frame_s) > _RATE_AFTER_S])

    @property
    def feeds(self) -> list[float]:
        """Feeds to start a fit from, mm/s."""
        if self.feed_mm_s is not None:
            return [self.feed_mm_s]
        required = np.abs(np.diff(self.target_mm)) / np.diff(self.reading_s)
        return list(float(np.median(required[required > 0])) * _FEEDS)

    def without(self, group: Array) -> _Motion:
        """The motion without some frames."""
        return replace(self, frame_s=np.delete(self.frame_s, group), table_mm=np.delete(self.table_mm, group))

    def residual(self, parameters: Array) -> Array:
        """Observed minus commanded position, mm; NaN where the commanded one is unknown."""
        offset, zero, feed, rate = parameters
        at_s = self.frame_s - offset - rate * (self.frame_s - self.middle_s)
        commanded = commanded_position(at_s, self.reading_s, self.target_mm, feed, reading_phase=self.reading_phase)
        return self.table_mm - zero - commanded

    def misfit(self, parameters: Array) -> float:
        """Mean squared residual, mm2, residuals limited to `_FAR_MM`."""
        return float(np.nanmean(np.minimum(np.abs(self.residual(parameters)), _FAR_MM) ** 2))

    def centre(self, grid: Array) -> Array:
        """Set the zero of every set of parameters, (sets, 4), to the median residual; their mean absolute misfits, (sets,) mm."""
        misfits = np.empty(len(grid))
        for i, parameters in enumerate(grid):
            parameters[1] = 0.0
            residual = self.residual(parameters)
            parameters[1] = np.nanmedian(residual)
            misfits[i] = np.nanmean(np.minimum(np.abs(residual - parameters[1]), _FAR_MM))
        return misfits

    def fit(self, start: Array, *, offset_free: bool = True) -> Array:
        """Robust least squares: small residuals count squared, large ones linearly."""
        free = self.free & np.array([offset_free, True, True, True])
        scale = np.array([1.0, 1.0, 1.0, 1e-5])

        def residuals(values: Array) -> Array:
            parameters = start.copy()
            parameters[free] = values * scale[free]
            parameters[2] = max(parameters[2], _LEAST_FEED_MM_S)
            return np.nan_to_num(self.residual(parameters), nan=0.0)

        solution = scipy.optimize.least_squares(
            residuals,
            start[free] / scale[free],
            loss="soft_l1",
            f_scale=_LOSS_SCALE_MM,
            diff_step=1e-4,
            x_scale="jac",
            xtol=1e-10,
        )
        best = start.copy()
        best[free] = solution.x * scale[free]
        best[2] = max(best[2], _LEAST_FEED_MM_S)
        return best


def _search(motion: _Motion, expected_s: float, search_s: float) -> tuple[float, tuple[float, ...]]:
    """Offset of the smallest misfit on a grid, s, and others that fit as well; of several alike the nearest to the expected one."""
    # Until the feed is known, the table is taken to move all the time between readings: wrong by less than _FAR_MM.
    feed = motion.feed_mm_s if motion.feed_mm_s is not None else _SLOWEST_MM_S
    offsets = expected_s + np.arange(-search_s, search_s + _SEARCH_STEP_S / 2, _SEARCH_STEP_S)
    misfits = np.array([_search_misfit(motion, offset, feed) for offset in offsets])
    best = int(np.argmin(misfits))
    if misfits[best] > 0.9 * _FAR_MM:
        raise ClockError(
            f"frames and readings do not overlap within {search_s:g} s of an offset of {expected_s:g} s; check the time zones (all times "
            "are UTC), or give clock_offset"
        )
    apart = np.abs(offsets - offsets[best]) > _ONE_MINIMUM_S
    # Only other minima are rivals, not the flanks of the best one.
    minimum = np.r_[False, (misfits[1:-1] <= misfits[:-2]) & (misfits[1:-1] <= misfits[2:]), False]
    similar = misfits < _AMBIGUITY * misfits[best] + 0.02 * _FAR_MM
    undecided = (misfits - misfits[best]) * len(motion.table_mm) < _DECIDING_FRAMES * _FAR_MM
    rivals = np.flatnonzero(apart & minimum & similar & undecided)
    alike = np.sort(offsets[np.append(rivals, best)])
    nearest = float(alike[np.argmin(np.abs(alike - expected_s))])
    if alike.size > 1 and abs(nearest - expected_s) > 0.5 * float(np.diff(alike).min()):
        named = ", ".join(f"{offset:.1f}" for offset in alike[:5])
        raise ClockError(
            f"the motion fits clock offsets of {named} s about equally well (a periodic test), none of them within half a period of the "
            f"expected {expected_s:g} s; give clock_offset, or frames from before the first reading to after the last"
        )
    return nearest, tuple(float(offset) for offset in alike if offset != nearest)


def _search_misfit(motion: _Motion, offset: float, feed_mm_s: float) -> float:
    """Mean absolute misfit about its median, limited to `_FAR_MM`, which is also that of frames outside the readings, mm."""
    residual = motion.residual(np.array([offset, 0.0, feed_mm_s, 0.0]))
    inside = np.isfinite(residual)
    if inside.sum() < 5:
        return _FAR_MM
    limited = np.minimum(np.abs(residual[inside] - np.median(residual[inside])), _FAR_MM)
    return float((limited.sum() + _FAR_MM * (~inside).sum()) / len(residual))


def _fit(motion: _Motion, offset: float) -> tuple[Array, Array]:
    """Parameters fitted near an offset, and their standard uncertainties, (4,) each."""
    # Fits near an offset whose misfits differ by less than three standard deviations, (fits, 4), best first.
    fits = np.array([motion.fit(start) for start in _starts(motion, offset)])
    misfits = np.array([motion.misfit(parameters) for parameters in fits])
    order = np.argsort(misfits)
    frames = len(motion.table_mm)
    alike = misfits[order] <= misfits[order[0]] + 9 / frames * max(misfits[order[0]], motion.variance_mm2)
    solutions = fits[order[alike]]
    best = solutions[0]
    groups = np.array_split(np.arange(frames), min(_GROUPS, frames // 5))
    left_out = np.array([motion.without(group).fit(best) for group in groups])
    u = np.sqrt((len(groups) - 1) / len(groups) * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
    # A jackknife of few groups scatters: it is never less than the scatter of the residuals implies.
    u = np.maximum(u, _formal_u(motion, best))
    # Solutions that the frames cannot distinguish: a rectangular distribution up to the farthest one (JCGM 100:2008, 4.3.7).
    u = np.hypot(u, np.abs(solutions - best).max(axis=0) / np.sqrt(3))
    u[0] = max(u[0], _profile_u(motion, best, u[0] / 4))
    return best, u


def _starts(motion: _Motion, offset: float) -> list[Array]:
    """Parameters to start from: the best of a grid of offsets and feeds, and the outermost ones that fit about equally well."""
    steps = np.arange(-4.0, 4.25, 0.5)
    grid = np.array([(offset + step, 0.0, feed, 0.0) for feed in motion.feeds for step in steps])
    misfits = motion.centre(grid)
    alike = grid[misfits <= 1.5 * misfits.min() + _GRID_MM]
    outer = [alike[np.argmin(alike[:, k])] for k in (0, 2)] + [alike[np.argmax(alike[:, k])] for k in (0, 2)]
    return [grid[np.argmin(misfits)], *outer]


def _formal_u(motion: _Motion, best: Array) -> Array:
    """Standard uncertainties of the parameters for independent residuals and a linear model, (4,)."""
    steps = np.diag([0.02, 0.01, 1e-3 * best[2], 1e-6])[motion.free]
    columns = [(motion.residual(best + step) - motion.residual(best - step)) / (2 * step.sum()) for step in steps]
    jacobian = np.nan_to_num(np.stack(columns, axis=-1))
    residual = np.nan_to_num(motion.residual(best))
    variance = max(
        float(residual @ residual) / max(int(np.count_nonzero(residual)) - len(steps), 1), motion.variance_mm2
    )
    u = np.zeros(4)
    u[motion.free] = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
    return u


def _profile_u(motion: _Motion, best: Array, step_s: float) -> float:
    """Standard uncertainty of the offset from its profile likelihood, all other parameters fitted at every offset, s."""
    growth = np.linspace(0.0, 1.0, _PROFILE_STEPS)
    away = step_s * (_PROFILE_S / step_s) ** growth
    offsets = best[0] + np.concatenate([-away[::-1], [0.0], away])
    misfits = np.array([_profile_misfit(motion, offset, best) for offset in offsets])
    least = float(misfits.min())
    likelihood = np.exp(-0.5 * len(motion.table_mm) * (misfits - least) / max(least, motion.variance_mm2))
    variance = np.trapezoid(likelihood * (offsets - best[0]) ** 2, offsets) / np.trapezoid(likelihood, offsets)
    return float(np.sqrt(variance))


def _profile_misfit(motion: _Motion, offset: float, best: Array) -> float:
    """Misfit at one offset, the other parameters fitted from the best of several feeds and from those of the best offset."""
    grid = np.array([(offset, 0.0, feed, best[3]) for feed in motion.feeds] + [(offset, *best[1:])])
    misfits = motion.centre(grid)
    return min(motion.misfit(motion.fit(start, offset_free=False)) for start in (grid[np.argmin(misfits)], grid[-1]))
