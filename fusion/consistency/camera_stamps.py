"""Checks of the times that the camera writes: order of the frames, rate of its clock, place in the motion of the axis."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.consistency.checks import Check
from thermography.io.frame import FrameReference

#: Frames nearer to each other than this share of a cycle are one burst.
_BURST_SHARE = 0.25
#: Scatter about a straight line, in cycles, up to which bursts keep their place in the cycle: triggered by the test, not by a timer.
_LOCKED_CYCLES = 0.03
#: Fewest bursts from which a rate is told, and share of the cycles that must have one.
_LEAST_BURSTS, _LEAST_SHARE = 12, 0.6
#: Largest slip from one burst to the next, in cycles: a timer of another period slips more, no clock gains a fifth.
_LARGEST_STEP = 0.2
#: Largest slip over the test, in cycles: a tenth of a cycle is what triggering by hand or by the axis makes.
_LARGEST_SLIP = 0.1
#: Share of the frames that may be stamped while the axis was away from position 0.
_AWAY_SHARE = 0.5
#: Share of the steps from name to name that may go back in time before the names tell no order: nobody sets a clock at every fifth frame.
_SET_BACK_SHARE = 0.2
#: In the order of their times frames are regular where no step is shorter or longer than these multiples of the median: a clock that was
#: set back lays its frames between or upon those before.
_REGULAR_STEPS = (0.8, 3.0)
_FIGURES = "all fields at the readings, the declared coefficients, and every cause"
_NUMBERED = re.compile(r"(.*?)(\d+)\D*")


def check_order(frames: Sequence[FrameReference]) -> list[Check]:
    """Check that the times of frames do not go backwards from one to the next.

    Parameters
    ----------
    frames : sequence of FrameReference
        In any order; those without a time are left out. Frames follow each other within a file, and from file to file where only a
        number in the name differs, by one.

    Returns
    -------
    list of Check
        ``camera_stamps``; empty where there are no frames.
    """
    timed = [frame for frame in frames if not np.isnat(frame.time)]
    if not timed:
        return []
    ordered = sorted(timed, key=lambda frame: (_numbered(frame.path), frame.index))
    steps = [(before, after) for before, after in itertools.pairwise(ordered) if _follows(before, after)]
    back = [(before, after) for before, after in steps if after.time < before.time]
    if back and _renamed(back, len(steps), np.sort(np.array([frame.time for frame in timed]))):
        told = f"The names of the frames do not follow their times ({len(back)} of {len(steps)} steps go back); the times were taken."
        return [Check("camera_stamps", 0.0, 0.0, True, told, "", _FIGURES)]
    named = "; ".join(
        f"{after.path.name}{f' frame {after.index}' if after.index else ''} is {(before.time - after.time) / np.timedelta64(1, 's'):.0f} s "
        f"before {before.path.name}"
        for before, after in back[:3]
    )
    return [
        Check(
            "camera_stamps",
            float(len(back)),
            0.0,
            not back,
            f"The camera's clock goes backwards {len(back)} times: {named}."
            if back
            else "The camera's clock goes forward.",
            "Check whether the camera's clock was set during the test; leave out the frames before or after."
            if back
            else "",
            _FIGURES,
        )
    ]


def _renamed(back: Sequence[tuple[FrameReference, FrameReference]], steps: int, times: NDArray[np.datetime64]) -> bool:
    """Whether it is the names that are out of order, not the clock: of files alone, many, or regular in the order of their times."""
    if any(before.path == after.path for before, after in back):
        return False
    if len(back) >= _SET_BACK_SHARE * steps and len(back) > 1:
        return True
    seconds = np.diff(times) / np.timedelta64(1, "s")
    low, high = (multiple * float(np.median(seconds)) for multiple in _REGULAR_STEPS)
    return bool(np.all((seconds >= low) & (seconds <= high)))


def _numbered(path: Path) -> tuple[str, str, int]:
    """Folder, stem and number of a file."""
    match = _NUMBERED.fullmatch(path.stem)
    return (str(path.parent), *((match.group(1), int(match.group(2))) if match else (path.stem, 0)))


def _follows(before: FrameReference, after: FrameReference) -> bool:
    if before.path == after.path:
        return after.index > before.index
    (folder, stem, number), (next_folder, next_stem, next_number) = _numbered(before.path), _numbered(after.path)
    return (folder, stem, number + 1) == (next_folder, next_stem, next_number)


@dataclass(frozen=True)
class _Locked:
    """Bursts that keep their place in the cycle but for a steady slip.

    Attributes
    ----------
    slip_cycles : float
        Over the time of the bursts.
    gain : float, s/s
        Seconds that the camera's clock gains per second on the cycles.
    """

    slip_cycles: float
    gain: float


def check_phase(frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> list[Check]:
    """Check the rate of the camera's clock, and whether frames of a still table are stamped while the axis stands at position 0.

    Parameters
    ----------
    frame_time : (n,) ndarray of datetime64
        Times of the frames on the laser's clock, sorted.
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.

    Returns
    -------
    list of Check
        ``camera_rate`` and ``camera_phase``. Both need frames that are taken once per cycle at the same place in it; where the camera runs
        by a timer of its own, nothing is told.
    """
    seconds, cycle_end, reading_s, position_mm = _motion(frame_time, deviations)
    period = float(np.median(np.diff(cycle_end))) if cycle_end.size > 1 else np.nan
    locked = _lock(seconds, cycle_end, period) if cycle_end.size >= _LEAST_BURSTS else None
    limit_s_per_h = 3600.0 * _LARGEST_SLIP * period / float(np.ptp(seconds)) if np.isfinite(period) else 0.0
    if locked is None:
        told = "The frames keep no fixed place in the cycle: cannot be told."
        return [
            Check("camera_rate", 0.0, limit_s_per_h, True, told, "", _FIGURES),
            Check("camera_phase", 0.0, _AWAY_SHARE, True, told, "", _FIGURES),
        ]
    rate = 3600.0 * locked.gain
    steady = abs(locked.slip_cycles) <= _LARGEST_SLIP
    away = _away_share(seconds, reading_s, position_mm)
    home = away <= _AWAY_SHARE
    return [
        Check(
            "camera_rate",
            rate,
            limit_s_per_h,
            steady,
            f"The camera's clock gains {rate:+.3g} s/h on the cycles of the laser ({locked.slip_cycles:+.2f} cycles over the test).",
            ""
            if steady
            else (
                "Check the camera's clock against that of the laser at start and end; where a timer of the camera takes the frames, beside "
                "a table that does not move in its view, accept camera_rate."
            ),
            _FIGURES,
        ),
        Check(
            "camera_phase",
            away,
            _AWAY_SHARE,
            home,
            f"{100.0 * away:.0f} % of the frames are stamped while the axis was away from position 0.",
            ""
            if home
            else (
                'Check clock_offset: with table = "still" every frame shows the table at axis position 0. Where the axis does not move the '
                "table in the camera's view, accept camera_phase."
            ),
            _FIGURES,
        ),
    ]


def _motion(frame_time: NDArray[np.datetime64], deviations: xr.Dataset) -> tuple[Array, Array, Array, Array]:
    """Frames, ends of the cycles and readings in s since the first frame, and the axis positions of the readings, mm."""
    time = deviations["time"].values.astype("datetime64[ns]")
    position = np.broadcast_to(deviations["position"].values, time.shape)
    since = (time - frame_time[0].astype("datetime64[ns]")) / np.timedelta64(1, "s")
    timed = ~np.isnat(time)
    order = np.argsort(since[timed])
    ends = np.array([row[known].max() for row, known in zip(since, timed, strict=True) if known.any()])
    frames = (frame_time - frame_time[0]) / np.timedelta64(1, "s")
    return np.asarray(frames, float), ends, since[timed][order], position[timed][order]


def _lock(seconds: Array, cycle_end: Array, period: float) -> _Locked | None:
    """Bursts of frames against the ends of the cycles; None where they keep no place."""
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
    slip = float(line[0] * np.ptp(starts))
    step = abs(float(line[0] * np.median(np.diff(starts))))
    return _Locked(slip, float(line[0] * period)) if scatter <= _LOCKED_CYCLES and step <= _LARGEST_STEP else None


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
