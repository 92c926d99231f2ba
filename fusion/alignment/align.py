"""Align both recordings on one clock: every reading gets the temperature field at its own time.

The camera sees the table with the axis at position 0; the point of the table under the spindle at axis position ``X`` is
``origin + X * direction``. Between two frames the field is interpolated linearly; a reading outside the frames' time gets none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from fusion._typing import Array
from fusion.alignment.reflection_patch import find_switching_patch, seen_throughout
from fusion.errors import FusionError
from thermography.fields.tasks.pieces import in_pieces, piece_slices

_DIMS = ("cycle", "direction", "target")
#: Half the width of line and point averages, in plan cells: enough to halve the noise of a single cell.
_HALF_WIDTH_CELLS = 1.5


class AlignmentError(FusionError):
    """Recordings that cannot be aligned; the message names the times or places and what to do."""


@dataclass(frozen=True)
class AxisGeometry:
    """Where the measured line lies on the table plan.

    Attributes
    ----------
    origin_mm : (float, float), mm
        Plan point (x, y) under the spindle at axis position 0.
    direction : (float, float)
        Direction (x, y) in which that point moves over the plan as the axis position grows, of any length.
    """

    origin_mm: tuple[float, float]
    direction: tuple[float, float]

    def points(self, position_mm: Array) -> tuple[Array, Array]:
        """Return the plan coordinates x and y, mm, of axis positions, mm; both have the shape of `position_mm`."""
        step = np.asarray(self.direction, float) / np.hypot(*self.direction)
        return self.origin_mm[0] + step[0] * position_mm, self.origin_mm[1] + step[1] * position_mm

    def across(self) -> tuple[float, float]:
        """Return the unit vector (x, y) on the plan at right angles to the measured line."""
        step = np.asarray(self.direction, float) / np.hypot(*self.direction)
        return float(-step[1]), float(step[0])


def cycle_bounds(deviations: xr.Dataset) -> NDArray[np.datetime64]:
    """Return start and end of every cycle on the laser's clock.

    A cycle lasts from its first reading to the first reading of the next one, so that a frame taken on the way back to the start
    belongs to the cycle that has just been measured. The last cycle, and a cycle after which numbers are missing, is as long as the
    median of the others: frames of the gap belong to no cycle.

    Parameters
    ----------
    deviations : Dataset
        ``time`` over cycle and any further dims, NaT where a reading has no time, and the numbers of the cycles.

    Returns
    -------
    (cycle, 2) ndarray of datetime64[ns]
        First instant of each cycle, and of the time after it.

    Raises
    ------
    AlignmentError
        If no reading of a cycle has a time, or if cycles overlap.
    """
    times = deviations["time"].values.reshape(deviations.sizes["cycle"], -1)
    empty = np.isnat(times).all(axis=1)
    if empty.any():
        named = deviations["cycle"].values[empty].tolist()
        raise AlignmentError(f"cycles {named} hold no reading with a time; give the times or leave the cycles out")
    stamps = times.astype("datetime64[ns]").astype(np.int64)
    missing = np.isnat(times)
    first = np.where(missing, np.iinfo(np.int64).max, stamps).min(axis=1)
    last = np.where(missing, np.iinfo(np.int64).min, stamps).max(axis=1)
    overlap = np.flatnonzero(first[1:] <= last[:-1])
    if overlap.size:
        before, after = deviations["cycle"].values[overlap[0] : overlap[0] + 2]
        raise AlignmentError(
            f"cycle {after} starts before cycle {before} has ended; check the cycle numbers and times of the laser file"
        )
    steps = np.diff(deviations["cycle"].values)
    followed = steps == steps.min(initial=np.iinfo(np.int64).max)
    length = int(np.median(np.diff(first)[followed])) if first.size > 1 else int(last[0] - first[0])
    alone = np.maximum(first + length, last + 1)
    end = np.append(np.where(followed, first[1:], np.minimum(first[1:], alone[:-1])), alone[-1])
    return np.stack([first, end], axis=1).astype("datetime64[ns]")


def camera_on_laser_clock(time: NDArray[np.datetime64], clock_offset_s: float) -> NDArray[np.datetime64]:
    """Return frame times on the laser's clock.

    Parameters
    ----------
    time : (frames,) ndarray of datetime64
        Times by the camera's clock.
    clock_offset_s : float, s
        Camera clock minus laser clock.

    Returns
    -------
    (frames,) ndarray of datetime64[ns]
    """
    return np.asarray(time.astype("datetime64[ns]") - np.timedelta64(round(clock_offset_s * 1e9), "ns"))


def align(
    deviations: xr.Dataset,
    fields: xr.Dataset,
    axis: AxisGeometry,
    *,
    environment: xr.Dataset | None = None,
    drivers: xr.Dataset | None = None,
) -> xr.Dataset:
    """Align readings, fields, environment and drivers on the laser's clock.

    Parameters
    ----------
    deviations : Dataset
        Readings as promised by ``interferometry.contract.DEVIATIONS``: ``deviation`` (um) and ``time`` over cycle, direction and target,
        ``position`` (mm) over target.
    fields : Dataset
        Fields as promised by ``thermography.contract.FIELDS``: ``frame_temperature`` (degC) over time, y, x (mm), ``time`` on the
        laser's clock (see `camera_on_laser_clock`).
    axis : AxisGeometry
        Where the measured line lies on the plan.
    environment, drivers : Dataset, optional
        Logged columns along ``time``; those that are not numeric, or have fewer than two values, are left out.

    Returns
    -------
    Dataset
        The deviations with, per reading, ``mean_rise`` (K, of the seen table), ``axis_integral`` (K mm, of the rise from axis
        position 0 to the target), ``local_rise`` (K, at the target), ``inside_frames``, every environment quantity and driver;
        and the same quantities as ``<name>_series`` on their own times (``frame_time``, ``environment_time``, ``driver_time``).

    Raises
    ------
    AlignmentError
        If frames and readings do not overlap in time, or if the measured line leaves the seen plan.

    Notes
    -----
    An axis that expands freely from its position 0 with coefficient alpha moves the reading at X by ``alpha`` times ``axis_integral``
    (docs/method/fields.md).

    Examples
    --------
    >>> dims = ("cycle", "direction", "target")
    >>> start = np.datetime64("2026-03-09T08:00", "ns")
    >>> frames = np.stack([np.full((5, 15), 20.0), np.full((5, 15), 22.0)])  # the table warms by 2 K
    >>> time = start + np.array([0, 660], "timedelta64[s]")
    >>> plan = {"time": time, "y": 10.0 * np.arange(5), "x": 10.0 * np.arange(15)}
    >>> fields = xr.Dataset({"frame_temperature": (("time", "y", "x"), frames)}, plan)
    >>> deviations = xr.Dataset({name: (dims, np.zeros((2, 1, 2))) for name in ("deviation", "quality_flag")})
    >>> deviations["time"] = dims, start + np.array([[[0, 60]], [[600, 660]]], "timedelta64[s]")
    >>> deviations["position"] = "target", [0.0, 100.0]
    >>> align(deviations, fields, AxisGeometry((20.0, 20.0), (1.0, 0.0)))["axis_integral"].values[-1, 0].round(6).tolist()
    [0.0, 200.0]
    """
    frame_time = fields["time"].values.astype("datetime64[ns]")
    reading_time = deviations["time"].values.astype("datetime64[ns]")
    _check_overlap(reading_time, frame_time)
    series = _reduce_fields(fields, axis, deviations["position"].values)
    inside = ~np.isnat(reading_time) & (reading_time >= frame_time[0]) & (reading_time <= frame_time[-1])

    fused = deviations[["deviation", "time", "position", "quality_flag"]].copy()
    fused["inside_frames"] = (_DIMS, inside, {"long_name": "the reading lies between the first and the last frame"})
    fused = _add_series(fused.assign_coords(frame_time=frame_time), series)
    return _add_logs(fused, environment, drivers)


def align_logs(
    deviations: xr.Dataset, *, environment: xr.Dataset | None = None, drivers: xr.Dataset | None = None
) -> xr.Dataset:
    """Give every reading what was logged at its own time, where no temperature of the table was measured.

    Parameters
    ----------
    deviations : Dataset
        As for `align`.
    environment, drivers : Dataset, optional
        As for `align`.

    Returns
    -------
    Dataset
        As from `align`, without the quantities of the field and without ``inside_frames``.
    """
    return _add_logs(deviations[["deviation", "time", "position", "quality_flag"]].copy(), environment, drivers)


def _add_logs(fused: xr.Dataset, environment: xr.Dataset | None, drivers: xr.Dataset | None) -> xr.Dataset:
    """Add every column of both logs: at the readings, and as a series on the log's own times."""
    for table, dim in ((environment, "environment_time"), (drivers, "driver_time")):
        if table is not None:
            fused = _add_table(fused, table, dim)
    return fused


_DIFFERENCE = {"units_metadata": "temperature: difference"}
_ATTRIBUTES: dict[str, dict[str, str]] = {
    "mean_rise": {"units": "K", "long_name": "mean temperature rise of the seen table", **_DIFFERENCE},
    "axis_integral": {"units": "K mm", "long_name": "integral of the seen rise from axis position 0 to the target"},
    "local_rise": {"units": "K", "long_name": "temperature rise of the table at the target", **_DIFFERENCE},
    "patch_mean_rise": {"units": "K", "long_name": "share of a switching patch in the mean rise", **_DIFFERENCE},
    "patch_axis_integral": {"units": "K mm", "long_name": "share of a switching patch in the axis integral"},
}


def _add_series(fused: xr.Dataset, series: dict[str, Array]) -> xr.Dataset:
    """Add every reduced field: at the readings inside the frames' time, and as a series on the times of the frames."""
    for name, values in series.items():
        at_readings = interpolate_series(fused["time"].values, fused["frame_time"].values, values)
        inside = fused["inside_frames"].values
        dims = ("frame_time",) if values.ndim == 1 else ("frame_time", "target")
        fused = fused.assign(
            {
                name: (_DIMS, np.where(inside, at_readings, np.nan), _ATTRIBUTES[name]),
                f"{name}_series": (dims, values, _ATTRIBUTES[name]),
            }
        )
    return fused


def _reduce_fields(fields: xr.Dataset, axis: AxisGeometry, position_mm: Array) -> dict[str, Array]:
    """Reduce the frames on the plan to mean rise (time,), axis integral and local rise (time, target).

    Where a patch of the field switches like a reflection, its shares in the mean rise and in the integral are given beside them. The
    rise counts from the first frame; cells that are not seen in every frame are left out of the mean.
    """
    frames = fields["frame_temperature"]
    seen = seen_throughout(frames)
    if not seen.any():
        raise AlignmentError("no plan cell is seen by every frame; check the registration and the plan's size")
    mean_rise = np.concatenate([rise[:, seen].mean(axis=1) for rise in rise_since_first(frames)])
    line = MeasuredLine(fields, axis, position_mm)
    samples = line.sample_rise(frames)
    reach = line.reach
    local = np.stack([samples[:, max(0, k - reach) : k + reach + 1].mean(axis=1) for k in line.nearest], axis=1)
    series = {"mean_rise": mean_rise, "axis_integral": line.integrate(samples), "local_rise": local}
    patch = find_switching_patch(frames)
    if patch is not None:
        pattern = line.integrate(line.sample(patch.pattern[None]))[0]
        series["patch_mean_rise"] = patch.course * patch.pattern[seen].mean()
        series["patch_axis_integral"] = patch.course[:, None] * pattern
    return series


def rise_since_first(frames: Array | xr.DataArray) -> Iterator[Array]:
    """Yield the rise of frames since the first one, some at a time: in double precision all frames of a long test fill the memory.

    Parameters
    ----------
    frames : (time, y, x) ndarray or DataArray, degC
        Of any precision.

    Yields
    ------
    (some, y, x) ndarray, K
    """
    first = np.asarray(frames[0]).astype(float)
    for _, some in in_pieces(frames):
        yield some.astype(float) - first


def _cell_size(fields: xr.Dataset) -> float:
    return float(np.median(np.diff(fields["x"].values)))


class MeasuredLine:
    """The measured line on the plan, sampled four times per cell, and averaged across its width.

    Parameters
    ----------
    fields : Dataset
        Plan coordinates ``x`` and ``y``, mm, evenly spaced.
    axis : AxisGeometry
        Where the line lies.
    position_mm : (target,) ndarray, mm
        Axis positions of the targets.

    Attributes
    ----------
    along_mm : (sample,) ndarray, mm
        Axis positions of the samples; position 0 and every target are among them.
    nearest : (target,) ndarray of int
        Index of the sample at every target.
    reach : int
        Number of samples on either side that a point average takes.

    Raises
    ------
    AlignmentError
        If the line leaves the plan.
    """

    def __init__(self, fields: xr.Dataset, axis: AxisGeometry, position_mm: Array) -> None:
        cell = _cell_size(fields)
        low, high = min(0.0, float(position_mm.min())), max(0.0, float(position_mm.max()))
        count = max(2, int(np.ceil((high - low) / (cell / 4.0))) + 1)
        # Position 0 and every target are samples themselves, so that no interval has to be cut.
        self.along_mm = np.unique(np.round(np.concatenate([np.linspace(low, high, count), position_mm, [0.0]]), 9))
        self.nearest = np.abs(self.along_mm[None, :] - position_mm[:, None]).argmin(axis=1)
        self.reach = max(1, round(_HALF_WIDTH_CELLS * cell / float(np.median(np.diff(self.along_mm)))))
        x0, y0 = axis.points(self.along_mm)
        sideways = np.linspace(-_HALF_WIDTH_CELLS, _HALF_WIDTH_CELLS, 5) * cell
        across = axis.across()
        x, y = fields["x"].values, fields["y"].values
        self._column = (x0[None, :] + sideways[:, None] * across[0] - x[0]) / cell
        self._row = (y0[None, :] + sideways[:, None] * across[1] - y[0]) / cell
        beside = (self._column < -0.5) | (self._column > x.size - 0.5)
        self._outside = beside | (self._row < -0.5) | (self._row > y.size - 0.5)
        lost = np.flatnonzero(self._outside.all(axis=0))
        if lost.size:
            k = int(lost[0])
            raise AlignmentError(
                f"the measured line leaves the plan: axis position {self.along_mm[k]:.1f} mm lies at x = {x0[k]:.1f} mm, "
                f"y = {y0[k]:.1f} mm; check [plan.axis] origin and direction, and [plan] size"
            )

    def sample(self, frames: Array | xr.DataArray) -> Array:
        """Return frames (time, y, x) along the line, (time, sample), in their unit; gaps are interpolated along the line."""
        return np.concatenate([self._sample_some(some.astype(float)) for _, some in in_pieces(frames)])

    def sample_rise(self, frames: Array | xr.DataArray) -> Array:
        """Return the rise of frames (time, y, x), degC, since the first one along the line, (time, sample), K."""
        return np.concatenate([self._sample_some(rise) for rise in rise_since_first(frames)])

    def _sample_some(self, frames: Array) -> Array:
        place = [self._row, self._column]
        samples = np.stack([ndimage.map_coordinates(frame, place, order=1, mode="nearest") for frame in frames])
        samples[:, self._outside] = np.nan
        valid = np.isfinite(samples)
        number = valid.sum(axis=1)
        line = np.where(valid, samples, 0.0).sum(axis=1) / np.maximum(number, 1)
        for values, seen in zip(line, number > 0, strict=True):
            if not seen.any():
                raise AlignmentError(
                    "no part of the measured line is seen by the camera; check [plan.axis] and the fiducials"
                )
            values[~seen] = np.interp(self.along_mm[~seen], self.along_mm[seen], values[seen])
        return line

    def integrate(self, samples: Array) -> Array:
        """Return the integral of samples (time, sample), K, from axis position 0 to every target, (time, target), K mm."""
        return np.concatenate([self._integrate_some(samples[some]) for some in piece_slices(samples.shape)])

    def integrate_rise(self, frames: Array | xr.DataArray) -> Array:
        """Return the same of the rise of frames (time, y, x), degC, since the first one; the samples are not held."""
        return np.concatenate([self._integrate_some(self._sample_some(rise)) for rise in rise_since_first(frames)])

    def _integrate_some(self, samples: Array) -> Array:
        steps = 0.5 * (samples[:, 1:] + samples[:, :-1]) * np.diff(self.along_mm)
        integral = np.concatenate([np.zeros((samples.shape[0], 1)), np.cumsum(steps, axis=1)], axis=1)
        zero = int(np.argmin(np.abs(self.along_mm)))
        return (integral - integral[:, [zero]])[:, self.nearest]


def _check_overlap(reading_time: NDArray[np.datetime64], frame_time: NDArray[np.datetime64]) -> None:
    timed = reading_time[~np.isnat(reading_time)]
    if timed.size == 0:
        raise AlignmentError("no reading has a time; readings and frames cannot be brought together")
    first, last = timed.min(), timed.max()
    if frame_time.size < 2 or frame_time[-1] < first or frame_time[0] > last:
        raise AlignmentError(
            f"frames ({_time_text(frame_time[0])} .. {_time_text(frame_time[-1])}) and readings ({_time_text(first)} .. "
            f"{_time_text(last)}) never meet; check the time zone of both clocks and [thermography] clock_offset (camera clock minus "
            "laser clock)"
        )


def _time_text(time: np.datetime64) -> str:
    return f"{np.datetime_as_string(time, unit='s')}Z"


def interpolate_series(
    reading_time: NDArray[np.datetime64], series_time: NDArray[np.datetime64], values: Array
) -> Array:
    """Interpolate a series linearly at the times of the readings; its ends are held.

    Parameters
    ----------
    reading_time : (cycle, direction, target) ndarray of datetime64
        Times of the readings, NaT where there is none.
    series_time : (time,) ndarray of datetime64
        Times of the series, increasing.
    values : (time,) or (time, target) ndarray
        The series, for all targets together or one column per target, in any unit.

    Returns
    -------
    (cycle, direction, target) ndarray
        In the unit of `values`.
    """
    start = series_time[0]
    seconds = (reading_time - start) / np.timedelta64(1, "s")
    knots = (series_time - start) / np.timedelta64(1, "s")
    if values.ndim == 1:
        return np.interp(seconds, knots, values)
    return np.stack([np.interp(seconds[..., k], knots, values[:, k]) for k in range(values.shape[1])], axis=-1)


def _add_table(fused: xr.Dataset, table: xr.Dataset, dim: str) -> xr.Dataset:
    """Add every numeric column of a table along time: at the readings, and as a series on its own times with its NaN."""
    added: dict[str, tuple[tuple[str, ...], NDArray[np.generic], dict[str, object]]] = {}
    for name, column in table.data_vars.items():
        if column.dims != ("time",) or column.dtype.kind not in "fiu":
            continue
        finite = np.isfinite(column.values)
        if finite.sum() < 2:
            continue
        time = table["time"].values.astype("datetime64[ns]")[finite]
        at_readings = interpolate_series(fused["time"].values, time, column.values[finite].astype(float))
        outside = (fused["time"].values < time[0]) | (fused["time"].values > time[-1])
        added[str(name)] = (_DIMS, np.where(outside, np.nan, at_readings), dict(column.attrs))
        added[f"{name}_series"] = ((dim,), column.values.astype(float), dict(column.attrs))
    return fused.assign(added).assign_coords({dim: table["time"].values.astype("datetime64[ns]")})
