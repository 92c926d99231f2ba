"""Recordings of a folder on one time axis, and what an offset of the camera's clock does to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.alignment.align import camera_on_laser_clock
from fusion.alignment.zone_shift import covered_share, likely_zone_shift
from fusion.campaign.logged_tables import read_drivers
from fusion.errors import FusionError
from fusion.starting.folder import FolderContent
from fusion.starting.kinds import Kind
from fusion.starting.time_bars import Recording
from interferometry.errors import InterferometryError
from interferometry.io.readers import read_deviations, read_environment
from thermography.errors import ThermographyError
from thermography.io.frame_readers import index_recordings

FRAMES, READINGS = "frames", "readings"


@dataclass(frozen=True)
class Bar:
    """A stretch of a recording without a gap.

    Attributes
    ----------
    name : str
        Recording.
    start, end : datetime64
        UTC, on the laser's clock.
    """

    name: str
    start: np.datetime64
    end: np.datetime64


def recordings_of(content: FolderContent) -> list[Recording]:
    """Return what was recorded when, each by its own clock; files without times or with faults are left out, as the table names them.

    Parameters
    ----------
    content : FolderContent
        What the folder holds.
    """
    found = []
    if content.frames and not content.of_temperatures:
        frames, _ = index_recordings(content.frame_files)
        found.append(Recording(FRAMES, np.array([frame.time for frame in frames], "datetime64[ns]")))
    readers: tuple[tuple[str, Kind, Callable[[Path], object]], ...] = (
        (READINGS, Kind.DEVIATIONS, read_deviations),
        ("environment", Kind.ENVIRONMENT, read_environment),
        ("drivers", Kind.DRIVERS, read_drivers),
    )
    for name, kind, read in readers:
        for one in content.of(kind)[:1]:
            try:
                table = read(one.path)
            except (FusionError, InterferometryError, ThermographyError):
                continue
            found.append(Recording(name, np.asarray(table["time"].values, "datetime64[ns]").ravel()))  # type: ignore[index]
    return [one for one in found if one.stretches()]


def shifted(recordings: Sequence[Recording], clock_offset_s: float) -> list[Bar]:
    """Return the recordings as bars on the laser's clock.

    Parameters
    ----------
    recordings : sequence of Recording
        Each by its own clock.
    clock_offset_s : float, s
        Camera clock minus laser clock.
    """
    bars = []
    for one in recordings:
        times = camera_on_laser_clock(one.times, clock_offset_s) if one.name == FRAMES else one.times
        bars += [Bar(one.name, start, end) for start, end in Recording(one.name, times).stretches()]
    return bars


def coverage(recordings: Sequence[Recording], clock_offset_s: float) -> str:
    """Say how much of the readings lies between the frames.

    Parameters
    ----------
    recordings : sequence of Recording
        Each by its own clock.
    clock_offset_s : float, s
        Camera clock minus laser clock.
    """
    both = _frames_and_readings(recordings)
    if both is None:
        return ""
    frames, readings = both
    share = covered_share(readings, camera_on_laser_clock(frames, clock_offset_s))
    return f"{share:.0%} of the readings lie between the first and the last frame."


def estimate(recordings: Sequence[Recording]) -> float | None:
    """Return the clock offset by whole quarter hours that two time zones would explain, s.

    Parameters
    ----------
    recordings : sequence of Recording
        Each by its own clock.

    Returns
    -------
    float or None
        None where no such offset brings the frames over the readings better than none does. An offset by seconds is estimated by the run,
        from frames that show the table moving.
    """
    both = _frames_and_readings(recordings)
    return None if both is None else likely_zone_shift(both[1], both[0])


def _frames_and_readings(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray] | None:
    named = {one.name: np.sort(one.times[~np.isnat(one.times)]) for one in recordings}
    return (named[FRAMES], named[READINGS]) if FRAMES in named and READINGS in named else None
