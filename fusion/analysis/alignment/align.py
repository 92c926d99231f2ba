"""Align both recordings on one clock: every reading gets the temperature field at its own time.

The camera sees the table with the axis at position 0; the point of the table under the spindle at axis position ``X`` is
``origin + X * direction``. Between two frames the field is interpolated linearly; a reading outside the frames' time gets none. Patches
of the field that switch as a reflection does are found beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import check_readings
from fusion.analysis.alignment.sensor_health import SensorFault
from fusion.common import Array, FusionError
from fusion.results.parts import ContactSensorPart
from interferometry.common import ENVIRONMENT_ATTRIBUTES
from interferometry.deviations import resolution_um
from thermofuse.resources import variables
from thermofuse.units import conform
from thermography.common import FIELD_ATTRIBUTES, FIELDS, scatter_by_median
from thermography.large_arrays import in_pieces, piece_slices

_DIMS = ("cycle", "direction", "target")
#: What is kept of the deviations.
_KEPT = ["deviation", "time", "position", "quality_flag"]
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

    Raises
    ------
    AlignmentError
        Either is no pair of finite numbers, or the direction is (0, 0).
    """

    origin_mm: tuple[float, float]
    direction: tuple[float, float]

    def __post_init__(self) -> None:
        try:
            pairs = np.array([self.origin_mm, self.direction], float)
        except (TypeError, ValueError):
            pairs = np.empty(0)
        if pairs.shape != (2, 2) or not np.isfinite(pairs).all() or not pairs[1].any():
            raise AlignmentError(
                f"origin_mm={self.origin_mm!r}, direction={self.direction!r}: give finite (x, y) of each, and a direction other than (0, 0)"
            )

    @property
    def step(self) -> Array:
        """Unit vector (x, y) on the plan along the measured line."""
        return np.asarray(self.direction, float) / np.hypot(*self.direction)

    def points(self, position_mm: Array) -> tuple[Array, Array]:
        """Return the plan coordinates x and y, mm, of axis positions, mm; both have the shape of `position_mm`."""
        step = self.step
        return self.origin_mm[0] + step[0] * position_mm, self.origin_mm[1] + step[1] * position_mm

    def across(self) -> tuple[float, float]:
        """Return the unit vector (x, y) on the plan at right angles to the measured line."""
        return float(-self.step[1]), float(self.step[0])


def cycle_bounds(deviations: xr.Dataset) -> NDArray[np.datetime64]:
    """Return start and end of every cycle on the laser's clock.

    Parameters
    ----------
    deviations : Dataset
        Readings as `read_deviations` returns them, with ``time`` over cycle, direction and target.

    Returns
    -------
    (cycles, 2) ndarray of datetime64[ns]
        A cycle ends where the next one starts; the last one, and one before a gap, is as long as the others.

    Raises
    ------
    AlignmentError
        If a cycle holds no reading with a time, or starts before the one before it has ended.

    Notes
    -----
    Which frames make the field of a cycle: docs/method/fields.md.

    Examples
    --------
    >>> time = np.datetime64("2026-03-09T08:00", "ns") + np.array([[[0, 60]], [[600, 660]]], "timedelta64[s]")
    >>> readings = xr.Dataset({"time": (("cycle", "direction", "target"), time)}, {"cycle": [1, 2]})
    >>> (np.diff(cycle_bounds(readings)) / np.timedelta64(1, "s")).ravel().tolist()
    [600.0, 600.0]
    """
    if not isinstance(deviations, xr.Dataset) or "time" not in deviations or "cycle" not in deviations:
        raise AlignmentError(
            "deviations has no 'time' over 'cycle'; give what read_deviations or build_deviations returns"
        )
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
    """Return frame times on the laser's clock."""
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
        Readings as promised by ``interferometry.common.DEVIATIONS``: ``deviation`` (um) and ``time`` over cycle, direction and target,
        ``position`` (mm) over target.
    fields : Dataset
        Fields as promised by ``thermography.common.FIELDS``: ``frame_temperature`` (degC) over time, y, x (mm), ``time`` on the
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
        If frames and readings do not overlap in time, if the measured line leaves the seen plan, or if a Dataset lacks a variable or holds
        it in a unit that cannot be converted.

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
    deviations = check_readings(deviations, "deviations", "read_deviations or build_deviations", AlignmentError)
    needs = {"frame_temperature": FIELDS["frame_temperature"][0]}
    fields = conform(fields, needs, FIELD_ATTRIBUTES, name="fields", source="reduce_frames", error=AlignmentError)
    if not isinstance(axis, AxisGeometry):
        raise AlignmentError(f"axis is of type {type(axis).__name__}; give an AxisGeometry")
    frame_time = fields["time"].values.astype("datetime64[ns]")
    reading_time = deviations["time"].values.astype("datetime64[ns]")
    _check_overlap(reading_time, frame_time)
    series = _reduce_fields(fields, axis, deviations["position"].values)
    inside = ~np.isnat(reading_time) & (reading_time >= frame_time[0]) & (reading_time <= frame_time[-1])

    fused = _kept(deviations).assign_coords(frame_time=frame_time)
    fused["inside_frames"] = (_DIMS, inside, _ATTRIBUTES["inside_frames"])
    for name, values in series.items():
        at_readings = np.where(inside, interpolate_series(deviations["time"].values, frame_time, values), np.nan)
        fused[name] = (_DIMS, at_readings, _ATTRIBUTES[name])
        dims = ("frame_time",) if values.ndim == 1 else ("frame_time", "target")
        fused[f"{name}_series"] = (dims, values, _ATTRIBUTES[name])
    return _add_logs(fused, environment, drivers)


def align_logs(
    deviations: xr.Dataset, *, environment: xr.Dataset | None = None, drivers: xr.Dataset | None = None
) -> xr.Dataset:
    """Give every reading what was logged at its own time, where no temperature of the table was measured."""
    return _add_logs(_kept(deviations), environment, drivers)


def _kept(deviations: xr.Dataset) -> xr.Dataset:
    return deviations[_KEPT].copy().assign(resolution=((), resolution_um(deviations), {"units": "um"}))


def _add_logs(fused: xr.Dataset, environment: xr.Dataset | None, drivers: xr.Dataset | None) -> xr.Dataset:
    """Add every numeric column of both logs: at the readings, and as a series on the log's own times with its NaN."""
    reading_time = fused["time"].values
    for table, dim in ((environment, "environment_time"), (drivers, "driver_time")):
        if table is None:
            continue
        log = dim.removesuffix("_time")
        table = conform(
            table, {"time": ("time",)}, ENVIRONMENT_ATTRIBUTES, name=log, source=f"read_{log}", error=AlignmentError
        )
        log_time = table["time"].values.astype("datetime64[ns]")
        added: dict[str, tuple[tuple[str, ...], NDArray[np.generic], dict[str, object]]] = {}
        for name, column in table.data_vars.items():
            if column.dims != ("time",) or column.dtype.kind not in "fiu":
                continue
            values = column.values.astype(float)
            finite = np.isfinite(values)
            if finite.sum() < 2:
                continue
            time = log_time[finite]
            at_readings = interpolate_series(reading_time, time, values[finite])
            outside = (reading_time < time[0]) | (reading_time > time[-1])
            added[str(name)] = (_DIMS, np.where(outside, np.nan, at_readings), dict(column.attrs))
            added[f"{name}_series"] = ((dim,), values, dict(column.attrs))
        fused = fused.assign(added).assign_coords({dim: log_time})
    return fused


_ATTRIBUTES = variables("aligned")[1]


def _reduce_fields(fields: xr.Dataset, axis: AxisGeometry, position_mm: Array) -> dict[str, Array]:
    """Reduce the frames on the plan to mean rise (time,), axis integral and local rise (time, target)."""
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
    """Yield the rise of frames since the first one, some at a time: in double precision all frames of a long test fill the memory."""
    first = np.asarray(frames[0]).astype(float)
    for _, some in in_pieces(frames):
        yield some.astype(float) - first


class MeasuredLine:
    """The measured line on an evenly spaced plan, sampled four times per cell, and averaged across its width; it must not leave the plan.

    Attributes
    ----------
    along_mm : (sample,) axis positions of the samples, mm; position 0 and every target are among them
    nearest : (target,) index of the sample at every target
    reach : number of samples on either side that a point average takes
    """

    def __init__(self, fields: xr.Dataset, axis: AxisGeometry, position_mm: Array) -> None:
        cell = float(np.median(np.diff(fields["x"].values)))
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
        outside_columns = (self._column < -0.5) | (self._column > x.size - 0.5)
        self._outside = outside_columns | (self._row < -0.5) | (self._row > y.size - 0.5)
        lost = np.flatnonzero(self._outside.all(axis=0))
        if lost.size:
            k = int(lost[0])
            raise AlignmentError(
                f"the measured line leaves the plan: axis position {self.along_mm[k]:.1f} mm lies at x = {x0[k]:.1f} mm, "
                f"y = {y0[k]:.1f} mm; check origin and direction of the axis, and the size of the plan"
            )

    def sample(self, frames: Array | xr.DataArray) -> Array:
        """Return frames (time, y, x) along the line, (time, sample), in their unit; gaps are interpolated along the line."""
        return np.concatenate([self._sample_some(some.astype(float)) for _, some in in_pieces(frames)])

    def sample_rise(self, frames: Array | xr.DataArray) -> Array:
        """Return the rise of frames (time, y, x), degC, since the first one along the line, (time, sample), K."""
        return np.concatenate([self._sample_some(rise) for rise in rise_since_first(frames)])

    def _sample_some(self, frames: Array) -> Array:
        place = [self._row, self._column]
        samples = np.stack([scipy.ndimage.map_coordinates(frame, place, order=1, mode="nearest") for frame in frames])
        samples[:, self._outside] = np.nan
        valid = np.isfinite(samples)
        number = valid.sum(axis=1)
        line = np.where(valid, samples, 0.0).sum(axis=1) / np.maximum(number, 1)
        for values, seen in zip(line, number > 0, strict=True):
            if not seen.any():
                raise AlignmentError(
                    "no part of the measured line is seen by the camera; check origin and direction of the axis, and the fiducials"
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
        return _integral_from_zero(samples, self.along_mm)[:, self.nearest]


def _integral_from_zero(line: Array, places_mm: Array) -> Array:
    """Integral of values along a line (time, place) from its place 0 to every place, (time, place)."""
    trapezia = np.diff(places_mm) * (line[:, 1:] + line[:, :-1]) / 2.0
    integral = np.pad(np.cumsum(trapezia, axis=1), ((0, 0), (1, 0)))
    return np.asarray(integral - integral[:, [int(np.argmin(np.abs(places_mm)))]])


def both_ends(series: NDArray[np.datetime64], readings: NDArray[np.datetime64]) -> list[str]:
    """First and last time of a series, then of the readings, in UTC."""
    return [f"{np.datetime_as_string(at, unit='s')}Z" for at in (*series[[0, -1]], readings.min(), readings.max())]


def _check_overlap(reading_time: NDArray[np.datetime64], frame_time: NDArray[np.datetime64]) -> None:
    timed = reading_time[~np.isnat(reading_time)]
    if timed.size == 0:
        raise AlignmentError("no reading has a time; readings and frames cannot be synchronised")
    if frame_time.size < 2 or frame_time[-1] < timed.min() or frame_time[0] > timed.max():
        start, end, first, last = both_ends(frame_time, timed)
        raise AlignmentError(
            f"frames ({start} .. {end}) and readings ({first} .. {last}) do not overlap in time; check the time zone of both clocks and "
            "the offset of the camera's clock (clock_offset, camera minus laser)"
        )


def interpolate_series(
    reading_time: NDArray[np.datetime64], series_time: NDArray[np.datetime64], values: Array
) -> Array:
    """Interpolate a series linearly at the times of the readings; its ends are held."""
    start = series_time[0]
    seconds = (reading_time - start) / np.timedelta64(1, "s")
    knots = (series_time - start) / np.timedelta64(1, "s")
    if values.ndim == 1:
        return np.interp(seconds, knots, values)
    return np.stack([np.interp(seconds[..., k], knots, values[:, k]) for k in range(values.shape[1])], axis=-1)


# Contact sensors as a product of their own: their rises, their places, and the camera's rise at these places.

_KELVIN = {"units": "K", "units_metadata": "temperature: difference"}
_MM = {"units": "mm"}


def join_sensors(
    logged: xr.DataArray, x_mm: Array, y_mm: Array, faults: Sequence[SensorFault], fields: xr.Dataset | None
) -> xr.Dataset:
    """Return the contact sensors as sensors.nc holds them."""
    names = [str(name) for name in logged["sensor"].values]
    wrong = {fault.sensor: fault for fault in faults}
    times = logged["time"].values
    onset = {k: times[0] + np.timedelta64(round(1e9 * fault.onset_s), "ns") for k, fault in wrong.items()}
    fault_time = np.array([onset.get(k, np.datetime64("NaT")) for k in range(len(names))], "datetime64[ns]")
    # Both rises start where both are recorded.
    start = times[0] if fields is None else max(times[0], fields["time"].values[0])
    joined = xr.Dataset(
        {
            "temperature": logged.assign_attrs(units="degC", units_metadata="temperature: on_scale"),
            "rise": (logged - _first_since(logged, "time", start)).assign_attrs(_KELVIN),
            "x": ("sensor", x_mm, _MM),
            "y": ("sensor", y_mm, _MM),
            "is_faulty": ("sensor", [k in wrong for k in range(len(names))]),
            "fault": ("sensor", [wrong[k].words if k in wrong else "" for k in range(len(names))]),
            "fault_time": ("sensor", fault_time),
        }
    )
    if fields is None:
        return joined
    places = {axis: xr.DataArray(at, dims="sensor") for axis, at in (("x", x_mm), ("y", y_mm))}
    frames = fields["frame_temperature"]
    parts = [frames[some].load().sel(places, method="nearest") for some in piece_slices(frames.shape)]
    seen = xr.concat(parts, "time").drop_vars(["x", "y"])
    seen = seen.rename(time="camera_time").transpose("camera_time", "sensor").astype(float)
    return joined.assign(camera_rise=(seen - _first_since(seen, "camera_time", start)).assign_attrs(_KELVIN))


def _first_since(temperature: xr.DataArray, dim: str, start: np.datetime64) -> xr.DataArray:
    """First temperature of every sensor from a time on, (sensor,) degC; NaN where there is none."""
    later = temperature.isel({dim: temperature[dim].values >= start})
    values = later.transpose(dim, "sensor").values
    first = np.full(values.shape[1], np.nan)
    for k in range(values.shape[1]):
        known = np.flatnonzero(np.isfinite(values[:, k]))
        if known.size:
            first[k] = values[known[0], k]
    return xr.DataArray(first, dims="sensor")


def describe_sensors(joined: xr.Dataset, *, file: str) -> tuple[ContactSensorPart, ...]:
    """Return how far every contact sensor rose, and the camera at its place."""
    return tuple(_describe_sensor(joined.sel(sensor=name), file) for name in joined["sensor"].values)


def _describe_sensor(one: xr.Dataset, file: str) -> ContactSensorPart:
    faulty = bool(one["is_faulty"])
    used = one["time"].values < one["fault_time"].values if faulty else np.ones(one.sizes["time"], bool)
    last = np.flatnonzero(used & np.isfinite(one["rise"].values))
    camera = one["camera_rise"].dropna("camera_time").values if "camera_rise" in one else np.empty(0)
    return ContactSensorPart(
        name=one["sensor"].item(),
        file=file,
        x_mm=one["x"],
        y_mm=one["y"],
        rise_K=one["rise"][last[-1]] if last.size else None,
        camera_rise_K=camera[-1] if camera.size else None,
        used=not faulty,
        fault=one["fault"].item(),
        fault_time=f"{np.datetime_as_string(one['fault_time'].values, unit='s')}Z" if faulty else None,
    )


# The rise of the table along the measured line from contact sensors, where no camera saw it.

#: Share of the travel that the sensors span at least.
_LEAST_SPAN = 0.5


def add_sensor_line(
    fused: xr.Dataset, temperature: xr.DataArray, x_mm: Array, y_mm: Array, axis: AxisGeometry, *, file: str
) -> xr.Dataset:
    """Give readings the mean rise of contact sensors and its integral along the measured line."""
    along = (x_mm - axis.origin_mm[0]) * axis.step[0] + (y_mm - axis.origin_mm[1]) * axis.step[1]
    rise = temperature.values - temperature.values[0]
    places, group = np.unique(np.round(along, 1), return_inverse=True)
    rise = np.stack([rise[:, group == k].mean(axis=1) for k in range(places.size)], axis=1)
    position = fused["position"].values.astype(float)
    low, high = min(0.0, float(position.min())), max(0.0, float(position.max()))
    spanned = max(min(high, places[-1]) - max(low, places[0]), 0.0) / (high - low)
    if places.size < 2 or spanned < _LEAST_SPAN:
        raise AlignmentError(
            f"{file}: {places.size} places along the axis span {spanned:.0%} of the travel; the expansion of the axis needs at least two "
            f"over {_LEAST_SPAN:.0%} of it: add sensors, or give their temperatures as [drivers]"
        )
    times = temperature["time"].values.astype("datetime64[ns]")
    readings = fused["time"].values
    if times.size < 2 or times[-1] < np.nanmin(readings) or times[0] > np.nanmax(readings):
        raise AlignmentError(
            f"{file}: the sensors were logged at another time than the readings; check its date and zone"
        )
    samples = np.unique(np.concatenate([np.linspace(low, high, 200), position, places, [0.0]]))
    line = np.stack([np.interp(samples, places, row) for row in rise])
    integral = _integral_from_zero(line, samples)
    # Root mean square by which every sensor is missed by the line through the others.
    errors = []
    for k in range(places.size):
        others = np.arange(places.size) != k
        errors.append(rise[:, k] - [np.interp(places[k], places[others], row[others]) for row in rise])
    missed_K = float(np.sqrt(np.mean(np.square(errors))))
    return fused.assign(
        mean_rise_series=("sensor_time", rise.mean(axis=1), _KELVIN),
        axis_integral_series=(
            ("sensor_time", "target"),
            integral[:, np.searchsorted(samples, position)],
            {"units": "K mm"},
        ),
        interpolation_u=((), missed_K, {"units": "K"}),
        axis_places=((), int(places.size), {"units": "1"}),
        axis_scale_u=((), missed_K / max(float(np.sqrt((rise**2).mean())), 1e-12), {"units": "1"}),
    ).assign_coords(sensor_time=times)


# Shifts by whole quarter hours under which a recording covers the readings: two time zones.

_QUARTER_HOUR_S = 900.0
_DAY_S = 86_400.0
#: Share of the readings that the right shift covers.
_COVERED_SHIFTED = 0.95


def covered_share(readings: NDArray[np.datetime64], recorded: NDArray[np.datetime64], *, late_s: float = 0.0) -> float:
    """Return the share of readings between the first and the last sample of a recording."""
    late = np.timedelta64(round(late_s * 1e9), "ns")
    return float(np.mean((readings >= recorded[0] - late) & (readings <= recorded[-1] - late)))


def likely_zone_shift(readings: NDArray[np.datetime64], recorded: NDArray[np.datetime64]) -> float | None:
    """Return the smallest shift by whole quarter hours within a day that brings a recording over the readings."""
    shifts = np.arange(-_DAY_S, _DAY_S + 1, _QUARTER_HOUR_S)
    shares = np.array([covered_share(readings, recorded, late_s=float(shift)) for shift in shifts])
    best = np.flatnonzero(shares == shares.max())
    nearest = best[np.argmin(np.abs(shifts[best]))]
    return float(shifts[nearest]) if shares[nearest] >= _COVERED_SHIFTED and shifts[nearest] != 0 else None


# Patches of the field that switch as a reflection does, faster than heat can flow. Heat needs minutes to cross a few centimetres of iron
# (diffusivity 1.6e-5 m2/s: 1 cm in 6 s, 5 cm in 160 s, 20 cm in 40 min), and a source under the table changes the slope of a temperature,
# not its value. A patch that jumps between two frames, and jumps back, is radiation from elsewhere.

#: A change counts as a jump where it exceeds the usual change of its patch this many times (robust sigma).
_JUMP_SIGMAS = 8.0
#: ... and next to another one this many times: a source that is switched while a frame is taken jumps twice.
_PART_SIGMAS = 3.0
#: A patch stands out where its jump is this much larger than the same jump averaged over the table; a camera offset has 1.
_LOCAL_RATIO = 3.0
_MIN_FRAMES = 9
#: Variance of the independent part of a source's levels, over that by which they wander from change to change: none to nothing else.
_LEVELS_OVER_WANDER = (0.0, *np.logspace(-2.0, 6.0, 33).tolist())
#: Changes of a long test among which the patch is looked for.
_MOST_CHANGES = 1000


@dataclass(frozen=True)
class SwitchingPatch:
    """A patch of the plan whose apparent temperature switches: `pattern` (y, x) of the jump, about 1 on the patch, 0 where the plan is not
    seen; `course` (time,), how much warmer than at first each frame shows it by its jumps, K.
    """

    pattern: Array
    course: Array


def seen_throughout(frames: Array | xr.DataArray) -> NDArray[np.bool_]:
    """Return which cells every frame shows."""
    seen = np.ones(frames.shape[1:], bool)
    for _, some in in_pieces(frames):
        seen &= np.isfinite(some).all(axis=0)
    return seen


def find_switching_patch(frames: Array | xr.DataArray) -> SwitchingPatch | None:
    """Find the patch whose switching explains most of the sudden changes of a field."""
    if frames.shape[0] < _MIN_FRAMES:
        return None
    seen = seen_throughout(frames)
    largest = _largest(_sudden_changes(frames, seen))
    if not largest.any():
        return None
    component = _leading_component(largest)
    if len(largest) == len(frames) - 1:
        score = largest @ component
    else:
        along_all = np.sum([sudden.T @ (sudden @ component) for sudden in _sudden_changes(frames, seen)], axis=0)
        component = np.asarray(along_all / np.linalg.norm(along_all))
        score = np.concatenate([sudden @ component for sudden in _sudden_changes(frames, seen)])
    score /= component @ component
    scatter = max(scatter_by_median(score), 1e-9)
    jumps = np.abs(score) > _JUMP_SIGMAS * scatter
    # The upper percent stands for the patch's own height, so that one noisy cell does not make a pattern local.
    height = float(np.quantile(component, 0.99))
    if not jumps.any() or height < _LOCAL_RATIO * abs(float(component.mean())):
        return None
    pattern = np.zeros(seen.shape)
    pattern[seen] = component / height
    return SwitchingPatch(pattern, _course(score, jumps, scatter) * height)


def _course(score: Array, jumps: NDArray[np.bool_], scatter: float) -> Array:
    """Levels of a switching source, (time,), from its changes (time - 1,), of which some are jumps; the first level is zero."""
    adjacent = np.convolve(jumps, [1, 1, 1], mode="same") > 0
    switched = jumps | (adjacent & (np.abs(score) > _PART_SIGMAS * scatter))
    changes = score[switched]
    likelihood, error = -np.inf, np.zeros_like(changes)
    for ratio in _LEVELS_OVER_WANDER:
        bands = np.full((2, changes.size), -ratio)
        bands[1] = 1.0 + 2.0 * ratio
        factor = scipy.linalg.cholesky_banded(bands)
        wander = scipy.linalg.cho_solve_banded((factor, False), changes)
        square = float(changes @ wander)
        variance = max(square / changes.size, scatter**2)
        found = -0.5 * (changes.size * np.log(variance) + square / variance) - float(np.log(factor[1]).sum())
        if found > likelihood:
            likelihood, error = found, scatter**2 / variance * wander
    levels = np.concatenate([[0.0], np.cumsum(changes - error)])
    return np.asarray(levels[np.concatenate([[0], np.cumsum(switched)])])


def _largest(changes: Iterable[Array]) -> Array:
    """The largest changes (at most a thousand, cell) of those that come some at a time, in the order of time."""
    kept, sizes = np.empty((0, 0)), np.empty(0)
    for some in changes:
        size = np.concatenate([sizes, np.einsum("tc,tc->t", some, some)])
        chosen = np.sort(np.argsort(size)[-_MOST_CHANGES:])
        before = chosen[chosen < len(kept)]
        new = some[chosen[len(before) :] - len(kept)]
        # Those before stay as they are where none of them is left out.
        old = kept if len(before) == len(kept) else kept[before]
        kept, sizes = np.concatenate([old, new]) if len(old) else new, size[chosen]
    return kept


def _leading_component(changes: Array) -> Array:
    """First principal component of changes (time, cell), of unit length and positive where it is largest, (cell,)."""
    by_cell = changes.shape[0] > changes.shape[1]
    products = changes.T @ changes if by_cell else changes @ changes.T
    last = products.shape[0] - 1
    _, vectors = scipy.linalg.eigh(products, subset_by_index=(last, last), overwrite_a=True)
    component = vectors[:, 0] if by_cell else changes.T @ vectors[:, 0]
    return np.asarray(component / np.linalg.norm(component) * np.sign(component[np.argmax(np.abs(component))]))


def _sudden_changes(frames: Array | xr.DataArray, seen: NDArray[np.bool_]) -> Iterator[Array]:
    """Change between neighbouring frames beyond the median of the changes around it, (some, cell), some at a time."""
    count = len(frames) - 1
    for some in piece_slices((count, *seen.shape)):
        start, stop = some.start, some.stop
        first = max(0, start - 3)
        changes = np.diff(np.asarray(frames[first : min(count, stop + 3) + 1]).astype(float)[:, seen], axis=0)
        sudden = np.empty((stop - start, changes.shape[1]))
        for k in range(start, stop):
            low, high = max(0, k - 3) - first, min(count, k + 4) - first
            around = np.delete(changes[low:high], k - first - low, axis=0)
            sudden[k - start] = changes[k - first] - np.median(around, axis=0)
        yield sudden
