"""Stamps of the frames of a still table, held against the motion of the axis."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array

#: Frames nearer to each other than this share of a cycle are one burst.
_BURST_SHARE = 0.25
#: Scatter about a straight line, in cycles, up to which bursts keep their place in the cycle: triggered by the test, not by a timer.
_LOCKED_CYCLES = 0.03
#: Fewest bursts from which a rate is estimated, and share of the cycles that must have one.
_LEAST_BURSTS, _LEAST_SHARE = 12, 0.6
#: Largest slip from one burst to the next, in cycles: a timer of another period slips more, no clock gains a fifth.
_LARGEST_STEP = 0.2


@dataclass(frozen=True)
class Motion:
    """Stamps of the frames of a still table, ends of cycles and readings, s since the first frame, and the position of the axis at the
    readings.
    """

    seconds: Array
    cycle_end: Array
    reading_s: Array
    position_mm: Array

    @classmethod
    def of(cls, frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> Motion:
        """Bring both to one clock."""
        time = deviations["time"].values.astype("datetime64[ns]")
        position = np.broadcast_to(deviations["position"].values, time.shape)
        since = (time - frame_time[0].astype("datetime64[ns]")) / np.timedelta64(1, "s")
        timed = ~np.isnat(time)
        order = np.argsort(since[timed])
        ends = np.array([row[known].max() for row, known in zip(since, timed, strict=True) if known.any()])
        frames = (frame_time - frame_time[0]) / np.timedelta64(1, "s")
        return cls(np.asarray(frames, float), ends, since[timed][order], position[timed][order])

    @property
    def period_s(self) -> float:
        """Of the cycles; nan of less than two."""
        return float(np.median(np.diff(self.cycle_end))) if self.cycle_end.size > 1 else np.nan

    @cached_property
    def locked(self) -> tuple[float, float] | None:
        """Steady slip of the bursts of frames on the cycles, in cycles over the test and in s/h; None where they keep no place."""
        return _lock(self.seconds, self.cycle_end, self.period_s) if self.cycle_end.size >= _LEAST_BURSTS else None

    def away_share(self, late_s: float = 0.0) -> float:
        """Share of the frames, were they late, that are stamped while the axis was away from position 0."""
        return _away_share(self.seconds - late_s, self.reading_s, self.position_mm)


def _lock(seconds: Array, cycle_end: Array, period: float) -> tuple[float, float] | None:
    """As `Motion.locked`."""
    starts = seconds[np.concatenate([[True], np.diff(seconds) > _BURST_SHARE * period])]
    number = np.interp(starts, cycle_end, np.arange(cycle_end.size))
    before, after = starts < cycle_end[0], starts > cycle_end[-1]
    number[before] = (starts[before] - cycle_end[0]) / period
    number[after] = cycle_end.size - 1 + (starts[after] - cycle_end[-1]) / period
    place = np.unwrap(number - np.round(number), period=1.0)
    if starts.size < max(_LEAST_BURSTS, _LEAST_SHARE * cycle_end.size):
        return None
    line = np.polyfit(starts, place, 1)
    scatter = float(np.std(place - np.polyval(line, starts)))
    step = abs(float(line[0] * np.median(np.diff(starts))))
    if scatter > _LOCKED_CYCLES or step > _LARGEST_STEP:
        return None
    return float(line[0] * np.ptp(starts)), 3600.0 * float(line[0] * period)


def _away_share(seconds: Array, reading_s: Array, position_mm: Array) -> float:
    """Share of the frames, of those between first and last reading, with readings of one cycle away from axis position 0 on both sides."""
    steps = np.diff(np.unique(np.abs(position_mm)))
    near_mm = 0.5 * float(steps.min()) if steps.size else 0.0
    typical = 3.0 * float(np.median(np.diff(reading_s)))
    after = np.searchsorted(reading_s, seconds)
    inside = (after > 0) & (after < reading_s.size)
    at = np.clip(after, 1, reading_s.size - 1)
    moving = (reading_s[at] - reading_s[at - 1] <= typical) & (
        np.minimum(np.abs(position_mm[at]), np.abs(position_mm[at - 1])) > near_mm
    )
    return float(np.mean(moving[inside])) if inside.any() else 0.0
