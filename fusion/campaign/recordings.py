"""Recordings of a folder on the clock of the laser, and what an offset of the camera's clock does to them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from fusion.analysis.alignment.align import camera_on_laser_clock, covered_share, likely_zone_shift
from fusion.campaign.inspect import FolderContent, Kind, Recording
from fusion.common import FusionError
from interferometry.common import InterferometryError
from thermography.io.other_cameras import index_recordings

FRAMES, READINGS = "frames", "readings"


class Bar(NamedTuple):
    """A stretch of a recording without a gap, UTC on the laser's clock."""

    name: str
    start: np.datetime64
    end: np.datetime64


def recordings_of(content: FolderContent) -> list[Recording]:
    """Return what was recorded when, each by its own clock; files without times or with faults are left out, as the table names them."""
    found = []
    if content.frames and not content.of_temperatures:
        frames, _ = index_recordings(content.frame_files)
        found.append(Recording(FRAMES, np.array([frame.time for frame in frames], "datetime64[ns]")))
    for name, kind in ((READINGS, Kind.DEVIATIONS), ("environment", Kind.ENVIRONMENT), ("drivers", Kind.DRIVERS)):
        for one in content.of(kind)[:1]:
            with suppress(FusionError, InterferometryError):
                found.append(Recording(name, one.content["time"].values.astype("datetime64[ns]").ravel()))
    return [one for one in found if one.stretches()]


def shifted(recordings: Sequence[Recording], clock_offset_s: float) -> list[Bar]:
    """Return the recordings as bars on the laser's clock."""
    bars = []
    for one in recordings:
        times = camera_on_laser_clock(one.times, clock_offset_s) if one.name == FRAMES else one.times
        bars += [Bar(one.name, start, end) for start, end in Recording(one.name, times).stretches()]
    return bars


def coverage(recordings: Sequence[Recording], clock_offset_s: float) -> str:
    """Say how much of the readings lies between the frames."""
    both = _frames_and_readings(recordings)
    if both is None:
        return ""
    frames, readings = both
    share = covered_share(readings, camera_on_laser_clock(frames, clock_offset_s))
    return f"{share:.0%} of the readings lie between the first and the last frame."


def estimate(recordings: Sequence[Recording]) -> float | None:
    """Return the clock offset by whole quarter hours that two time zones would explain, s."""
    both = _frames_and_readings(recordings)
    return None if both is None else likely_zone_shift(both[1], both[0])


def _frames_and_readings(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray] | None:
    named = {one.name: np.sort(one.times[~np.isnat(one.times)]) for one in recordings}
    return (named[FRAMES], named[READINGS]) if FRAMES in named and READINGS in named else None
