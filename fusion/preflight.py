"""L4 - Before the long work: do both recordings meet in time, and do their clocks seem to agree?"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.alignment import AlignmentError, camera_on_laser_clock
from fusion.results import Notice

_QUARTER_HOUR_S = 900.0
_DAY_S = 86_400.0
#: A shift by whole quarter hours is taken for a wrong time zone where it lifts the share of readings covered from below the
#: first to above the second.
_COVERED_NOW, _COVERED_SHIFTED = 0.6, 0.95


def check_clocks(
    deviations: xr.Dataset, frame_time: NDArray[np.datetime64], *, clock_offset_s: float | None, source: str
) -> list[Notice]:
    """Return a notice for readings outside the frames' time; refuse recordings that never meet or differ by a time zone.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    frame_time : (n,) datetime64
        Times of the frames on the camera's clock, sorted.
    clock_offset_s : float or None
        Camera clock minus laser clock from the campaign file, None where it is left out.
    source : str
        Campaign file, for the message.

    Raises
    ------
    AlignmentError
        If frames and readings never meet, or would meet after a shift by whole quarter hours.
    """
    readings = deviations["time"].values
    readings = readings[~np.isnat(readings)]
    if readings.size == 0:
        raise AlignmentError(f"{source}: no reading has a time; readings and frames cannot be brought together")
    frames = camera_on_laser_clock(frame_time, clock_offset_s or 0.0)
    covered = _covered(readings, frames, 0.0)
    shift = _likely_zone_shift(readings, frames)
    span = (
        f"frames {shown(frames[0])} to {shown(frames[-1])}, readings {shown(readings.min())} to {shown(readings.max())}"
    )
    if covered < _COVERED_NOW and shift is not None:
        raise AlignmentError(
            f"{source}: the clocks look {abs(shift) / 3600:g} h apart, as in two time zones ({span}, so {covered:.0%} of the readings lie "
            f'between frames); write thermography.clock_offset = "{(clock_offset_s or 0.0) + shift:g} s" (camera clock minus laser '
            "clock) if so, or give the times of both with their zone"
        )
    if covered == 0.0:
        raise AlignmentError(
            f"{source}: frames and readings never meet ({span}); set thermography.clock_offset (camera clock minus laser clock), "
            "or check that both folders belong to the same test"
        )
    return []


def _covered(readings: NDArray[np.datetime64], frames: NDArray[np.datetime64], shift_s: float) -> float:
    """Return the share of readings between the first and the last frame, the frames being `shift_s` earlier than they say."""
    shift = np.timedelta64(round(shift_s * 1e9), "ns")
    return float(np.mean((readings >= frames[0] - shift) & (readings <= frames[-1] - shift)))


def _likely_zone_shift(readings: NDArray[np.datetime64], frames: NDArray[np.datetime64]) -> float | None:
    """Return the shift in s by whole quarter hours within a day that makes frames and readings meet best, if nearly all do."""
    shifts = np.arange(-_DAY_S, _DAY_S + 1, _QUARTER_HOUR_S)
    shares = np.array([_covered(readings, frames, float(shift)) for shift in shifts])
    best = np.flatnonzero(shares == shares.max())
    nearest = best[np.argmin(np.abs(shifts[best]))]
    return float(shifts[nearest]) if shares[nearest] >= _COVERED_SHIFTED and shifts[nearest] != 0 else None


def shown(time: np.datetime64) -> str:
    """Return a time to the second with its zone."""
    return f"{np.datetime_as_string(time, unit='s')}Z"
