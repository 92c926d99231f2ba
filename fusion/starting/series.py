"""A series of thermal frames in about ten lines: one camera? gaps in time? the same settings? anything left out?"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from fusion.products.notices import counted, listed
from fusion.report.wording import duration, join, moment
from fusion.starting.time_bars import Recording
from thermography.errors import ThermographyError
from thermography.inspection import check_series
from thermography.io.flir import FrameReference, index_frames
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import ZERO_CELSIUS_K, calibrate

#: Frames whose pixels are read, spread evenly over the series.
_FRAMES_READ = 8


def describe_series(paths: Sequence[Path], *, label: str) -> list[str]:
    """Return what a series of thermal files holds.

    Parameters
    ----------
    paths : sequence of Path
        Its files, at least one of which can be read.
    label : str
        What the series is called.

    Returns
    -------
    list of str
        Lines for the terminal; lines that begin with "  warning" ask for action.

    Raises
    ------
    ThermographyError
        Where no frame can be read.
    """
    frames, rejected = index_frames(paths)
    if not frames:
        raise ThermographyError(f"{label}: no frame can be read; {rejected[0].reason}")
    sizes = join(sorted({f"{frame.shape[1]} x {frame.shape[0]}" for frame in frames}))
    lines = [
        f"{label}: thermal frames, {counted(len(paths), 'file')}, {counted(len(frames), 'frame')} of {sizes}",
        f"  camera {_cameras(frames)}",
        *(f"  {line}" for line in _times(frames)),
        f"  settings {_settings(frames)}",
        f"  temperature {_temperatures(frames)}",
    ]
    if len({frame.shape for frame in frames}) > 1:
        lines.append("  warning: frames of several sizes; a run keeps those of the commonest")
    if rejected:
        reasons = listed(f"{one.path.name}: {one.reason.removeprefix(f'{one.path}').lstrip(': ')}" for one in rejected)
        lines.append(f"  warning: {counted(len(rejected), 'frame')} left out: {reasons}")
    return lines + [f"  warning: {each.message} {each.remedy}" for each in check_series(frames)]


def _cameras(frames: Sequence[FrameReference]) -> str:
    """Say which cameras, with serial number and lens, recorded the frames."""
    cameras = dict.fromkeys(
        f"{frame.camera.model or 'unknown'}"
        + (f", serial {frame.camera.serial}" if frame.camera.serial else "")
        + (f", lens {frame.camera.lens_model}" if frame.camera.lens_model else "")
        for frame in frames
    )
    return next(iter(cameras)) if len(cameras) == 1 else f"{len(cameras)}: {'; '.join(cameras)}"


def _times(frames: Sequence[FrameReference]) -> Iterator[str]:
    """Say when the frames were taken, how far apart, and where there are gaps."""
    times = np.array([frame.time for frame in frames], dtype="datetime64[ns]")
    timed = np.sort(times[~np.isnat(times)])
    if timed.size == 0:
        yield "no times: the frames cannot be matched with readings"
        return
    length_s = float((timed[-1] - timed[0]) / np.timedelta64(1, "s"))
    zones = sorted({frame.utc_offset_minutes or 0 for frame in frames})
    zone = join([f"{minutes / 60:+g} h" if minutes else "UTC" for minutes in zones])
    yield f"{moment(timed[0])} to {moment(timed[-1])}, {duration(length_s)} (camera set to {zone})"
    if timed.size < 2:
        return
    gaps = [
        f"{moment(end)}, {duration(float((start - end) / np.timedelta64(1, 's')))}"
        for (_, end), (start, _) in itertools.pairwise(Recording("frames", timed).stretches())
    ]
    step_s = float(np.median(np.diff(timed).astype(np.int64))) * 1e-9
    rate = f"{1 / step_s:.3g} frames per second" if step_s > 0 else "frames of one time"
    every = f"a frame every {duration(step_s)}" if step_s >= 1 else rate
    yield f"{every}, {counted(len(gaps), 'gap')}{': ' + listed(gaps) if gaps else ''}"


def _settings(frames: Sequence[FrameReference]) -> str:
    """Say which settings are stored, and which of them vary."""
    p = frames[0].parameters
    stored = (
        f"emissivity {p.emissivity:.3g}, distance {p.object_distance_m:.3g} m, reflected "
        f"{p.reflected_temperature_K - ZERO_CELSIUS_K:.2f} degC, air {p.atmospheric_temperature_K - ZERO_CELSIUS_K:.2f} degC, "
        f"relative humidity {p.relative_humidity:.0%}"
    )
    varying = [
        each.name
        for each in fields(CameraParameters)
        if len({getattr(frame.parameters, each.name) for frame in frames}) > 1
    ]
    return f"{stored}: {'the same in all frames' if not varying else f'of the first frame; not the same in all: {join(varying)}'}"


def _temperatures(frames: Sequence[FrameReference]) -> str:
    """Say which temperatures a few frames show with their own parameters."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, _FRAMES_READ).round().astype(int))
    lows, highs = [], []
    for frame in (frames[index] for index in chosen):
        try:
            values = calibrate(frame.read_counts(), frame.parameters)
        except ThermographyError:
            continue
        if np.isfinite(values).any():
            lows.append(float(np.nanmin(values)))
            highs.append(float(np.nanmax(values)))
    if not lows:
        return "cannot be told from the stored parameters"
    return f"{min(lows):.2f} to {max(highs):.2f} degC in {counted(len(lows), 'frame')} spread over the series"
