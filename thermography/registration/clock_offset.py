"""One clock for camera and machine: the table's seen motion laid over its commanded motion.

Where a machine was sent at any time, and how well frames that saw the table fix its offset, zero, feed and rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from thermography._typing import Array
from thermography.errors import ThermographyError

#: The seen table must travel at least this many times the uncertainty of its place.
LEAST_TRAVEL = 20.0
#: Another offset makes the clock ambiguous if its misfit is less than this much larger, ...
AMBIGUITY = 1.5
#: ... and no more than this many frames speak for the better one.
DECIDING_FRAMES = 8
#: Offsets nearer together than this belong to one minimum, s.
ONE_MINIMUM_S = 5.0
#: Consecutive groups of frames that are left out in turn for the uncertainty (delete-a-group jackknife).
GROUPS = 20


class ClockError(ThermographyError):
    """Nothing determines the clock offset; the message says why and what to give instead."""


@dataclass(frozen=True)
class ClockOffset:
    """Camera clock minus machine clock.

    Attributes
    ----------
    offset_s, offset_u_s
        At the middle of the frames, with its standard uncertainty.
    rate, rate_u
        Seconds gained per second by the camera's clock; zero where the record is too short to tell.
    start_mm
        Axis position at which the table was registered.
    feed_mm_per_min
        Used for the commanded motion; fitted where it was not given.
    rms_mm
        Seen minus commanded position.
    frames
        Frames that took part.
    """

    offset_s: float
    offset_u_s: float
    rate: float
    rate_u: float
    start_mm: float
    feed_mm_per_min: float
    rms_mm: float
    frames: int


def estimate_clock_offset(
    frame_time: ArrayLike,
    seen_mm: ArrayLike,
    seen_u_mm: ArrayLike,
    reading_time: ArrayLike,
    reading_mm: ArrayLike,
    *,
    feed_mm_per_min: float | None = None,
    reading_at: float = 1.0,
    search_s: float = 900.0,
    expected_s: float = 0.0,
) -> ClockOffset:
    """Estimate how far the camera's clock is ahead of the machine's, from where the table is seen and where it was sent.

    Parameters
    ----------
    frame_time, seen_mm, seen_u_mm
        Per frame: UTC time on the camera's clock, the table's displacement along the axis (any zero), its standard uncertainty;
        NaN where the table was not found.
    reading_time, reading_mm
        Per reading of the laser: UTC time on the machine's clock, and the target; in any order, NaT left out.
    feed_mm_per_min
        Feed between targets; fitted if not given.
    reading_at
        When during the stand the readings are taken, see `commanded_position`. The motion alone cannot tell this from a clock
        offset: half a stand of error here is half a stand of error of the offset.
    search_s, expected_s
        Offsets from ``expected_s - search_s`` to ``expected_s + search_s`` are considered.

    Returns
    -------
    ClockOffset
        Its uncertainty comes from leaving out groups of frames in turn, so that it covers what the motion model gets wrong from
        one part of the test to another.

    Raises
    ------
    ClockError
        The table is not seen to travel, too few frames meet the readings in time, or two offsets fit about equally well.
    """
    frame_s, origin = _seconds(frame_time)
    reading_s, _ = _seconds(reading_time, origin)
    seen, seen_u, target = (np.asarray(values, float) for values in (seen_mm, seen_u_mm, reading_mm))
    known = np.isfinite(frame_s) & np.isfinite(seen)
    order = np.argsort(reading_s)
    order = order[np.isfinite(reading_s[order]) & np.isfinite(target[order])]
    frame_s, seen, seen_u = frame_s[known], seen[known], np.nan_to_num(seen_u[known], nan=1.0)
    reading_s, target = reading_s[order], target[order]
    _check_travel(seen, seen_u, target)
    # Until the feed is known, the table is taken to travel all the time between readings: wrong by less than FAR_MM.
    feed = feed_mm_per_min / 60 if feed_mm_per_min is not None else 1e-9
    start = _search(frame_s, seen, reading_s, target, feed, reading_at, expected_s, search_s)
    model = Motion(frame_s, seen, reading_s, target, None if feed_mm_per_min is None else feed, reading_at)
    best, u = _fit(model, start)
    residual = model.residual(best)
    inside = np.isfinite(residual)
    return ClockOffset(
        offset_s=float(best[0]),
        offset_u_s=float(u[0]),
        rate=float(best[3]),
        rate_u=float(u[3]),
        start_mm=float(-best[1]),
        feed_mm_per_min=float(60 * best[2]),
        rms_mm=float(np.sqrt(np.mean(residual[inside] ** 2))),
        frames=int(inside.sum()),
    )


def _fit(model: Motion, start: float) -> tuple[Array, Array]:
    """Offset, zero, feed and rate near an offset, and their standard uncertainties, (4,) each."""
    fits = model.fits(start)
    best = fits[0]
    groups = np.array_split(np.arange(len(model.seen)), min(GROUPS, len(model.seen) // 5))
    left_out = np.array([model.without(group).fit(best) for group in groups])
    u = np.sqrt((len(groups) - 1) / len(groups) * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
    # A jackknife of few groups scatters by itself: never less than the scatter of the residuals gives.
    u = np.maximum(u, model.formal_u(best))
    # Solutions that the frames cannot tell apart: any offset up to the farthest is as good, a rectangular distribution (GUM 4.3.7).
    u = np.hypot(u, np.abs(fits - best).max(axis=0) / np.sqrt(3))
    u[0] = max(u[0], model.profile_u(best, u[0] / 4))
    return best, u


def _search(
    frame_s: Array,
    seen: Array,
    reading_s: Array,
    target: Array,
    feed: float,
    reading_at: float,
    expected_s: float,
    search_s: float,
) -> float:
    """The offset that fits best on a grid; refused where another one fits about as well."""
    offsets = expected_s + np.arange(-search_s, search_s + 0.25, 0.5)
    costs = np.array([_cost(frame_s - offset, seen, reading_s, target, feed, reading_at) for offset in offsets])
    best = int(np.argmin(costs))
    if costs[best] > 0.9 * FAR_MM:
        raise ClockError(
            f"frames and readings do not meet within {search_s:g} s of an offset of {expected_s:g} s; check the time zones (all times "
            "are UTC), or give clock_offset"
        )
    apart = np.abs(offsets - offsets[best]) > ONE_MINIMUM_S
    # Only other minima count: the flanks of the best one are not other answers.
    lower = np.r_[False, (costs[1:-1] <= costs[:-2]) & (costs[1:-1] <= costs[2:]), False]
    near = costs < AMBIGUITY * costs[best] + 0.02 * FAR_MM
    rivals = np.flatnonzero(apart & lower & near & ((costs - costs[best]) * len(seen) < DECIDING_FRAMES * FAR_MM))
    if rivals.size:
        named = ", ".join(f"{offsets[i]:.1f}" for i in rivals[:4])
        raise ClockError(
            f"the motion fits clock offsets of {offsets[best]:.1f} s and {named} s about equally well (a periodic test); give "
            "clock_offset, or frames from before the first reading to after the last"
        )
    return float(offsets[best])


def _cost(machine_s: Array, seen: Array, reading_s: Array, target: Array, feed: float, reading_at: float) -> float:
    """Mean absolute misfit, mm, cut at `FAR_MM`; frames outside the readings count as far."""
    residual = seen - commanded_position(machine_s, reading_s, target, feed, reading_at=reading_at)
    inside = np.isfinite(residual)
    if inside.sum() < 5:
        return FAR_MM
    near = np.minimum(np.abs(residual[inside] - np.median(residual[inside])), FAR_MM)
    return float((near.sum() + FAR_MM * (~inside).sum()) / len(seen))


def _check_travel(seen: Array, seen_u: Array, target: Array) -> None:
    if len(seen) < 20:
        raise ClockError(
            f"the table is found in {len(seen)} frames; 20 are needed for a clock offset, or give clock_offset"
        )
    if len(target) < 3:
        raise ClockError(f"{len(target)} readings have a time; a clock offset needs at least 3, or give clock_offset")
    travel, sent = float(np.ptp(seen)), float(np.ptp(target))
    if travel < LEAST_TRAVEL * float(np.median(seen_u)) or travel < 0.1 * sent:
        raise ClockError(
            f"the table is seen to travel {travel:.2f} mm where it was sent over {sent:g} mm: frames of a still table do not determine "
            'a clock offset; give clock_offset, or leave both clocks on UTC and write clock_offset = "0 s"'
        )


def _seconds(times: ArrayLike, origin: np.datetime64 | None = None) -> tuple[Array, np.datetime64]:
    """Seconds since an origin (the first time by default), NaN for NaT, and the origin."""
    stamps = np.asarray(times, "datetime64[ns]").ravel()
    if origin is None:
        origin = stamps[~np.isnat(stamps)].min()
    seconds = (stamps - origin) / np.timedelta64(1, "ns") / 1e9
    return np.where(np.isnat(stamps), np.nan, seconds), origin


#: Residuals beyond this count no further in the search: whoever is that far off is simply elsewhere, mm.
FAR_MM = 20.0
#: Below this length of record the rate of one clock against the other is taken as zero, s.
RATE_AFTER_S = 3600.0
#: From here on a deviation counts as itself, not as its square, mm.
HUBER_MM = 0.5
#: What the grid of starts misfits by its steps alone, mm.
GRID_MM = 1.0
#: How far from the best offset, and at how many offsets either way, others are compared with it, s.
PROFILE_S, PROFILE_STEPS = 4.0, 30
#: Feeds that are tried, as parts of what the readings need at least.
FEEDS = np.geomspace(1.0, 20.0, 40)


def commanded_position(
    time_s: Array, reading_s: Array, reading_mm: Array, feed_mm_s: float, *, reading_at: float = 1.0
) -> Array:
    """Axis position (mm) of a positioning test at any time: stand, read, go on at the feed to the next target, stand.

    Parameters
    ----------
    time_s
        Times wanted, any shape, s.
    reading_s, reading_mm
        Times of the readings in order, and the targets, (readings,).
    feed_mm_s
        Between targets; where it is too slow to arrive, the table arrives at the next reading.
    reading_at
        When during the stand the reading is taken: 0 on arrival, 1 just before going on, as a controller with a dwell time does.

    Returns
    -------
    ndarray
        NaN before the first and after the last reading: nothing is known of what the machine did there.
    """
    gap = np.diff(reading_s)
    stand = np.maximum(gap - np.abs(np.diff(reading_mm)) / feed_mm_s, 0.0)
    leave = reading_s[:-1] + (1 - reading_at) * stand
    arrive = reading_s[1:] - reading_at * stand
    way_s = np.concatenate([[reading_s[0]], np.column_stack([leave, arrive]).ravel(), [reading_s[-1]]])
    way_mm = np.concatenate(
        [[reading_mm[0]], np.column_stack([reading_mm[:-1], reading_mm[1:]]).ravel(), [reading_mm[-1]]]
    )
    return np.interp(time_s, way_s, way_mm, left=np.nan, right=np.nan)


@dataclass(frozen=True)
class Motion:
    """Seen against commanded motion; parameters are offset (s), zero of the seen position (mm), feed (mm/s) and clock rate."""

    frame_s: Array
    seen: Array
    reading_s: Array
    target: Array
    feed: float | None
    reading_at: float

    @property
    def middle(self) -> float:
        """Time at which the offset holds, s."""
        return float(self.frame_s.mean())

    def without(self, group: Array) -> Motion:
        """The same without some frames."""
        return replace(self, frame_s=np.delete(self.frame_s, group), seen=np.delete(self.seen, group))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of the parameters are fitted."""
        return np.array([True, True, self.feed is None, np.ptp(self.frame_s) > RATE_AFTER_S])

    def formal_u(self, best: Array) -> Array:
        """Standard uncertainties of the parameters as if the residuals were independent and the model linear, (4,)."""
        steps = np.diag([0.02, 0.01, 1e-3 * best[2], 1e-6])[self.free]
        columns = [(self.residual(best + step) - self.residual(best - step)) / (2 * step.sum()) for step in steps]
        jacobian = np.nan_to_num(np.stack(columns, axis=-1))
        residual = np.nan_to_num(self.residual(best))
        variance = float(residual @ residual) / max(int(np.count_nonzero(residual)) - len(steps), 1)
        u = np.zeros(4)
        u[self.free] = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
        return u

    def residual(self, parameters: Array) -> Array:
        """Seen minus commanded position, mm; NaN where the machine's is not known."""
        offset, zero, feed, rate = parameters
        machine_s = self.frame_s - offset - rate * (self.frame_s - self.middle)
        commanded = commanded_position(machine_s, self.reading_s, self.target, feed, reading_at=self.reading_at)
        residual: Array = self.seen - zero - commanded
        return residual

    def fits(self, offset: float) -> Array:
        """Solutions near an offset that the frames cannot tell apart at three standard deviations, (solutions, 4), best first."""
        found = np.array([self.fit(start) for start in self._starts(offset)])
        misfits = np.array([self.misfit(one) for one in found])
        order = np.argsort(misfits)
        alike = misfits[order] <= misfits[order[0]] * (1 + 9 / len(self.seen))
        return found[order[alike]]

    def misfit(self, parameters: Array) -> float:
        """Mean squared residual, mm2, none counted as farther than `FAR_MM`."""
        return float(np.nanmean(np.minimum(np.abs(self.residual(parameters)), FAR_MM) ** 2))

    def fit(self, start: Array, *, offset_free: bool = True) -> Array:
        """Least squares of the near, least absolute deviations of the far frames."""
        free = self.free & np.array([offset_free, True, True, True])
        scale = np.array([1.0, 1.0, 1.0, 1e-5])

        def residuals(values: Array) -> Array:
            parameters = start.copy()
            parameters[free] = values * scale[free]
            parameters[2] = max(parameters[2], 1e-3)
            return np.nan_to_num(self.residual(parameters), nan=0.0)

        found = least_squares(
            residuals,
            start[free] / scale[free],
            loss="soft_l1",
            f_scale=HUBER_MM,
            diff_step=1e-4,
            x_scale="jac",
            xtol=1e-10,
        )
        best = start.copy()
        best[free] = found.x * scale[free]
        return best

    def _starts(self, offset: float) -> list[Array]:
        """Offset, zero and feed to start from: the best of a grid, and the outermost ones that fit about as well.

        Frames at a few phases of the motion only (every 10 s of a motion of 6 s) leave feed and offset to each other.
        """
        grid = np.array(
            [(offset + step, 0.0, feed, 0.0) for feed in self._feeds for step in np.arange(-4.0, 4.25, 0.5)]
        )
        costs = self._centre(grid)
        alike = grid[costs <= 1.5 * costs.min() + GRID_MM]
        outer = [alike[np.argmin(alike[:, k])] for k in (0, 2)] + [alike[np.argmax(alike[:, k])] for k in (0, 2)]
        return [grid[np.argmin(costs)], *outer]

    @property
    def _feeds(self) -> list[float]:
        if self.feed is not None:
            return [self.feed]
        moves = np.abs(np.diff(self.target)) / np.diff(self.reading_s)
        return list(float(np.median(moves[moves > 0])) * FEEDS)

    def _centre(self, grid: Array) -> Array:
        """Give each set of parameters the zero that suits it; return their mean absolute misfits, mm."""
        costs = np.empty(len(grid))
        for i, parameters in enumerate(grid):
            parameters[1] = 0.0
            residual = self.residual(parameters)
            parameters[1] = np.nanmedian(residual)
            costs[i] = np.nanmean(np.minimum(np.abs(residual - parameters[1]), FAR_MM))
        return costs

    def profile_u(self, best: Array, step_s: float) -> float:
        """Standard uncertainty of the offset about the best one, from how well every other offset fits with all else free, s.

        Frames that always meet the motion at the same phases leave feed and offset to each other, or see the table standing only: then
        a whole range of offsets fits alike, and neither the curvature at the best one nor leaving out frames shows it. Offsets count by
        their likelihood, ``exp(-chi2 / 2)``, those about `step_s` apart near the best one and farther apart away from it.
        """
        growth = np.linspace(0.0, 1.0, PROFILE_STEPS)
        away = step_s * (PROFILE_S / step_s) ** growth
        offsets = best[0] + np.concatenate([-away[::-1], [0.0], away])
        misfits = np.array([self._best_misfit(offset, best) for offset in offsets])
        least = misfits.min()
        likelihood = np.exp(-0.5 * len(self.seen) * (misfits - least) / least)
        square = np.trapezoid(likelihood * (offsets - best[0]) ** 2, offsets) / np.trapezoid(likelihood, offsets)
        return float(np.sqrt(square))

    def _best_misfit(self, offset: float, best: Array) -> float:
        """Misfit at one offset, the other parameters fitted from the best of several feeds and from those of the best offset."""
        grid = np.array([(offset, 0.0, feed, best[3]) for feed in self._feeds] + [(offset, *best[1:])])
        costs = self._centre(grid)
        return min(self.misfit(self.fit(start, offset_free=False)) for start in (grid[np.argmin(costs)], grid[-1]))
