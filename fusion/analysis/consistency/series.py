"""What checks compare: the table's temperature as series of coarse cells, beside the environment log, and the motion of the axis.

Series of coarse cells are quick to compare at many lags: logs and drift are held against them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.first_order_lag import respond
from fusion.common import Array
from thermography.large_arrays import in_pieces, piece_slices

#: Side of a coarse cell, mm: finer than heat spreads in the minutes between two frames.
_COARSE_MM = 20.0
#: Frames nearer to each other than this say the same, s.
_LEAST_STEP_S = 60.0
#: Fewest frames from which a course can be distinguished from another one.
LEAST_FRAMES = 12
#: Smallest change of the logged temperature that can tell a slope, K.
LEAST_CHANGE_K = 1.0


@dataclass(frozen=True)
class FieldSeries:
    """Temperature (n, cells) of the cells that every frame shows whole, degC, with their centres, mm, at times at least a minute apart, s
    since `start`.
    """

    start: np.datetime64
    seconds: Array
    temperature: Array
    x_mm: Array
    y_mm: Array

    def since_start(self, times: NDArray[np.datetime64]) -> Array:
        """Return times, (m,) datetime64, as seconds since `start`."""
        return np.asarray((times.astype("datetime64[ns]") - self.start) / np.timedelta64(1, "s"), float)

    def interpolated(self, series: xr.DataArray) -> Array:
        """Return a series along time at the frames, (n,)."""
        return np.interp(self.seconds, self.since_start(series["time"].values), series.values)

    def lagged(self, time_constant_s: float) -> Array:
        """Return what a sensor of a time constant, s, would show on every cell, (n, cells), degC."""
        return respond(self.temperature, self.seconds, time_constant_s=time_constant_s)


def thin_fields(fields: xr.Dataset) -> FieldSeries | None:
    """Reduce the fields to coarse cells and to frames at least a minute apart."""
    frames = _thinned(fields)
    cell_mm = abs(float(np.median(np.diff(fields["x"].values))))
    count = max(1, round(_COARSE_MM / cell_mm))
    parts = [
        frames[some].coarsen(x=count, y=count, boundary="trim").reduce(np.mean) for some in piece_slices(frames.shape)
    ]
    return _series(xr.concat(parts, "time") if len(parts) > 1 else parts[0])


def field_at(fields: xr.Dataset, place_mm: tuple[float, float]) -> FieldSeries | None:
    """Reduce the fields to the temperature at one place of the plan: a plane through the cells about it, or the nearest of one or two, in
    the frames that show them; None where these are too few.
    """
    frames = _thinned(fields)
    y_mm, x_mm = (at.ravel() for at in np.meshgrid(frames["y"].values, frames["x"].values, indexing="ij"))
    away = np.column_stack([x_mm - place_mm[0], y_mm - place_mm[1]])
    distance = np.hypot(*away.T)
    about = np.flatnonzero(distance <= _COARSE_MM)
    values = np.concatenate([some.reshape(len(some), -1)[:, about].astype(float) for _, some in in_pieces(frames)])
    shown = np.isfinite(values).sum(axis=0)
    # A moving table shows the place in some frames: the cells that most of these show.
    cells = 2 * shown > shown.max(initial=0)
    whole = np.isfinite(values[:, cells]).all(axis=1)
    if not cells.any() or whole.sum() < LEAST_FRAMES:
        return None
    if cells.sum() < 3:
        weight = np.eye(cells.sum())[distance[about[cells]].argmin()]
    else:
        weight = np.linalg.pinv(np.column_stack([np.ones(cells.sum()), away[about[cells]]]))[0]
    place = np.array([[place_mm[0]], [place_mm[1]]])
    return FieldSeries(*_clock(frames[whole]), values[whole][:, cells] @ weight[:, None], *place)


def _thinned(fields: xr.Dataset) -> xr.DataArray:
    """Frames at least a minute apart."""
    time = fields["time"].values.astype("datetime64[ns]")
    seconds = (time - time[0]) / np.timedelta64(1, "s")
    kept = [0]
    for k in range(1, seconds.size):
        if seconds[k] - seconds[kept[-1]] >= _LEAST_STEP_S:
            kept.append(k)
    return fields["frame_temperature"].isel(time=kept)


def _series(frames: xr.DataArray) -> FieldSeries | None:
    """Cells that all frames show, as series; None where there are too few frames or no such cell."""
    values = frames.values.reshape(len(frames), -1).astype(float)
    seen = np.isfinite(values).all(axis=0)
    if len(frames) < LEAST_FRAMES or not seen.any():
        return None
    y, x = np.meshgrid(frames["y"].values, frames["x"].values, indexing="ij")
    return FieldSeries(*_clock(frames), values[:, seen], x.ravel()[seen], y.ravel()[seen])


def _clock(frames: xr.DataArray) -> tuple[np.datetime64, Array]:
    """Time of the first frame, and seconds of all since then."""
    time = frames["time"].values.astype("datetime64[ns]")
    return time[0], (time - time[0]) / np.timedelta64(1, "s")


@dataclass(frozen=True)
class Logged:
    """What the environment log holds of the table where it covers a frame (`inside` of them), material and air in degC, with what the
    camera shows near its material sensor, or everywhere where its place is not known.
    """

    near: FieldSeries
    inside: Array
    material: Array
    air: Array | None = None

    @property
    def change_K(self) -> float:
        """Range of the material temperature."""
        return float(np.ptp(self.material))

    @property
    def tells(self) -> bool:
        """Whether it changes enough, over enough frames, to be compared."""
        return self.change_K >= LEAST_CHANGE_K and bool(self.inside.sum() >= LEAST_FRAMES)


def log_with_camera(near: FieldSeries | None, log: xr.Dataset | None) -> Logged | None:
    """Bring the environment log to the frames; None where they have nothing in common."""
    if near is None or log is None or "material_temperature" not in log:
        return None
    at = near.since_start(log["time"].values)
    inside = (near.seconds >= at[0]) & (near.seconds <= at[-1])
    if inside.sum() < 2:
        return None
    names = [name for name in ("material_temperature", "air_temperature") if name in log]
    return Logged(near, inside, *(np.interp(near.seconds[inside], at, log[name].values) for name in names))


# Stamps of the frames of a still table, held against the motion of the axis.

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
