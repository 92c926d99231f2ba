"""L2 - One clock for camera and machine: the table's seen motion laid over its commanded motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.motion import FAR_MM, Motion, commanded_position

Array = NDArray[Any]

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


class ClockError(ValueError):
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
