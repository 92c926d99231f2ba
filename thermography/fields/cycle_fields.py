"""One field per cycle: cells, their uncertainty and flags, as a Dataset with CF attributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from thermography._typing import Array
from thermography.fields.resampling import PlanWeights
from thermography.radiometry.averaging import AVERAGING_LIMIT_K, MeanTemperature
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

#: Cycle index of a frame that lies in no cycle.
NOT_NUMBERED = -1
#: Bits of `quality_flag`.
FLAGS = {
    "partly_seen": 1,
    "calibrated_per_frame": 2,
    "several_registrations": 4,
    "not_seen": 8,
    "no_frame": 16,
}
PARTLY_SEEN_BELOW = 0.99
#: Of images larger than this, twice so many rows give the noise to a per cent.
LARGE_PX, NOISE_ROWS = 60_000, 32

DEGREES = {"units": "degC", "units_metadata": "temperature: on_scale"}
KELVIN = {"units": "K", "units_metadata": "temperature: difference"}
ATTRIBUTES: dict[str, dict[str, Any]] = {
    "temperature": {
        "standard_name": "surface_temperature",
        "long_name": "mean surface temperature over the frames of the cycle",
        "ancillary_variables": "temperature_u count quality_flag",
        **DEGREES,
    },
    "temperature_u": {
        "long_name": "standard uncertainty of the mean temperature from pixel noise and registration",
        "comment": "what all cells share (emissivity, reflections, the camera's scale) is not in it",
        **KELVIN,
    },
    "temperature_rise": {
        "long_name": "rise of the mean temperature since the first cycle",
        "ancillary_variables": "temperature_rise_u count quality_flag",
        **KELVIN,
    },
    "temperature_rise_u": {"long_name": "standard uncertainty of the rise from pixel noise and registration", **KELVIN},
    "temperature_rate": {
        "long_name": "rate of the mean temperature over neighbouring cycles",
        "units": "K h-1",
        "units_metadata": "temperature: difference",
    },
    "temperature_spread": {
        "long_name": "standard deviation of a pixel's temperature over the frames of the cycle, root mean square over the cell",
        **KELVIN,
    },
    "count": {"long_name": "frames averaged", "units": "1"},
    "quality_flag": {
        "standard_name": "quality_flag",
        "long_name": "what limits the temperature of the cell",
        "flag_masks": np.array(list(FLAGS.values()), np.uint8),
        "flag_meanings": " ".join(FLAGS),
    },
    "position_u": {
        "long_name": "standard uncertainty of the place of a cell on the sensor, as length on the plan",
        "units": "mm",
    },
    "coverage": {"long_name": "part of the cell's area that is seen unmasked", "units": "1"},
    "frame_temperature": {
        "standard_name": "surface_temperature",
        "long_name": "mean surface temperature over a frame or a short block of frames",
        **DEGREES,
    },
    "frame_cycle": {"long_name": "cycle that the frames belong to, 0 for none", "units": "1"},
    "frame_shift": {
        "long_name": "largest shift of the fiducials of a frame of the block against its registration",
        "units": "1",
        "comment": "pixels of the sensor",
    },
    "frame_count": {"long_name": "frames in the block", "units": "1"},
    "cycle_time": {"long_name": "mean time of the frames of the cycle", "units_metadata": "leap_seconds: utc"},
    "time": {
        "standard_name": "time",
        "long_name": "mean time of the frames of the block",
        "units_metadata": "leap_seconds: utc",
    },
    "cycle": {"long_name": "measurement cycle", "units": "1"},
    "x": {"standard_name": "projection_x_coordinate", "long_name": "table plan along x", "units": "mm", "axis": "X"},
    "y": {"standard_name": "projection_y_coordinate", "long_name": "table plan along y", "units": "mm", "axis": "Y"},
}


@dataclass
class CyclePart:
    """What the frames of one cycle under one registration add up to: pixels while it is open, cells once it is finished."""

    cycle: int
    span: int
    frames: int = 0
    first_time: np.datetime64 = field(default=np.datetime64("NaT"))
    seconds: float = 0.0
    pixels: MeanTemperature | None = None
    mean: Array = field(default_factory=lambda: np.empty(0))
    spread: Array = field(default_factory=lambda: np.empty(0))
    noise_variance: Array = field(default_factory=lambda: np.empty(0))
    fell_back: Array = field(default_factory=lambda: np.empty(0))
    count: Array = field(default_factory=lambda: np.empty(0))

    def add(self, reduced: MeanTemperature, times: Array) -> None:
        """Add a block of frames taken at `times`."""
        if self.pixels is None:
            self.first_time = times[0]
        self.pixels = reduced if self.pixels is None else self.pixels.merge(reduced)
        self.frames += reduced.frames
        self.seconds += float(((times - self.first_time) / np.timedelta64(1, "ns")).sum()) / 1e9

    def finish(self, weights: PlanWeights) -> None:
        """Turn pixels into cells."""
        assert self.pixels is not None
        pixels = self.pixels
        self.mean = weights.resample(pixels.mean)
        sample = pixels.frames / (pixels.frames - 1) if pixels.frames > 1 else np.nan
        self.spread = np.sqrt(weights.average(pixels.variance) * sample)
        self.noise_variance = weights.noise_factor * noise_of_differences(pixels.mean, weights.whole) ** 2
        wild = pixels.bound_K > AVERAGING_LIMIT_K
        self.fell_back = weights.average(wild.astype(float)) > 0 if wild.any() else np.zeros(self.mean.shape, bool)
        self.count = np.where(np.isfinite(self.mean), self.frames, 0)
        self.pixels = None


def pixel_noise(image: Array, used: NDArray[np.bool_]) -> float:
    """Standard deviation of white noise in an image, from second differences of the used pixels; blind to smooth fields."""
    whole = ndimage.binary_erosion(used, np.ones((3, 3)))
    return noise_of_differences(image, whole)


def noise_of_differences(image: Array, whole: NDArray[np.bool_]) -> float:
    """As `pixel_noise`, at pixels of which all eight neighbours are known to be used; of large images, from the middle rows."""
    if whole.sum() < 30:
        return float("nan")
    if image.size > LARGE_PX:
        inner = np.flatnonzero(whole.any(axis=1))
        middle = slice(max(int(inner.mean()) - NOISE_ROWS, 0), int(inner.mean()) + NOISE_ROWS)
        image, whole = image[middle], whole[middle]
    values = image.astype(float)
    # Differences along one side, then along the other: the kernel of Immerkaer (1996), 6 times the noise of one pixel.
    down = values[:-2] - 2 * values[1:-1] + values[2:]
    both = down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:]
    return 1.4826 * float(np.nanmedian(np.abs(both[whole[1:-1, 1:-1]]))) / 6


def position_covariance(registration: Registration, grid: PlanGrid) -> Array:
    """Covariance of every cell's place, shape (y, x, 2, 2), mm2."""
    return registration.position_covariance(np.stack(np.meshgrid(grid.x_mm, grid.y_mm), axis=-1))


def assemble(
    parts: Sequence[CyclePart],
    cycles: int,
    grid: PlanGrid,
    covariances: Sequence[Array],
    coverages: Sequence[Array],
    *,
    frames: Mapping[str, Any] | None = None,
    frame_coordinates: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """Put the cycles together: mean, rise, rate, spread, count, uncertainties and flags on the plan.

    Parameters
    ----------
    parts
        Finished, in the order of time.
    cycles
        How many cycles the campaign has, with frames or without.
    grid
        The plan.
    covariances, coverages
        Of every registration: `position_covariance`, and the part of every cell that is seen unmasked.
    frames, frame_coordinates
        What is known per frame or block of frames besides, as xarray takes it.
    """
    fields = {name: np.full((cycles, *grid.shape), np.nan) for name in ("mean", "spread", "noise")}
    span_of = np.zeros(cycles, int)
    count = np.zeros((cycles, *grid.shape), np.int32)
    flags = np.full((cycles, *grid.shape), FLAGS["no_frame"], np.uint8)
    time = np.full(cycles, np.datetime64("NaT"), "datetime64[ns]")
    for cycle in sorted({part.cycle for part in parts}):
        own = [part for part in parts if part.cycle == cycle]
        time[cycle] = own[0].first_time + np.timedelta64(_mean_nanoseconds(own), "ns")
        together = _together(own)
        for name, values in zip(fields, together, strict=True):
            fields[name][cycle] = values
        span_of[cycle] = own[-1].span
        count[cycle] = sum(part.count for part in own)
        flags[cycle] = _flags(own, together[0], np.max([coverages[part.span] for part in own], axis=0))
    plan = ("cycle", "y", "x")
    first = min(parts, key=lambda part: part.cycle)
    place = np.full(count.shape, np.nan)
    for span, covariance in enumerate(covariances):
        place[span_of == span] = _gradient_variance(fields["mean"][span_of == span], covariance, grid)
    rise_place = _gradient_variance(fields["mean"] - fields["mean"][first.cycle], covariances[first.span], grid)
    temperatures = _temperatures(**fields, place=place, rise_place=rise_place, time=time, reference=first.cycle)
    dataset = xr.Dataset(
        {name: (plan, array.astype(np.float32)) for name, array in temperatures.items()}
        | {
            "count": (plan, count),
            "quality_flag": (plan, flags),
            "cycle_time": ("cycle", time),
            "position_u": (("y", "x"), np.sqrt(np.trace(covariances[0], axis1=-2, axis2=-1)).astype(np.float32)),
            "coverage": (("y", "x"), coverages[0].astype(np.float32)),
        }
        | dict(frames or {}),
        coords={
            "cycle": np.arange(1, cycles + 1, dtype=np.int32), "y": grid.y_mm, "x": grid.x_mm, **(frame_coordinates or {})
        },
        attrs={
            "Conventions": "CF-1.11",
            "title": "Temperature fields on the table plan",
            "source": "FLIR radiometric frames",
            "history": "counts averaged per cycle, calibrated, and averaged by area over the cells of the plan",
        },
    )  # fmt: skip
    return annotate(dataset)


def _flags(own: Sequence[CyclePart], mean: Array, coverage: Array) -> NDArray[np.uint8]:
    """Quality flags of one cycle."""
    found = {
        "partly_seen": coverage < PARTLY_SEEN_BELOW,
        "calibrated_per_frame": np.any([part.fell_back for part in own], axis=0),
        "several_registrations": np.full(mean.shape, len(own) > 1),
        "not_seen": np.isnan(mean),
    }
    return np.sum([np.where(where, FLAGS[name], 0) for name, where in found.items()], axis=0, dtype=np.uint8)


def _temperatures(
    mean: Array, spread: Array, noise: Array, place: Array, *, rise_place: Array, time: Array, reference: int
) -> dict[str, Array]:
    """Temperature, rise since the reference cycle, rate, spread and uncertainties, (cycle, y, x)."""
    # The noise of the first cycle is in every rise but its own, which is zero by definition.
    rise_noise = np.where(np.arange(len(mean))[:, None, None] == reference, 0.0, noise + noise[reference])
    return {
        "temperature": mean,
        "temperature_u": np.sqrt(noise + place),
        "temperature_rise": mean - mean[reference],
        "temperature_rise_u": np.sqrt(rise_noise + rise_place),
        "temperature_rate": _rate(mean, time),
        "temperature_spread": spread,
    }


def annotate(dataset: xr.Dataset) -> xr.Dataset:
    """Give every variable that is known its CF attributes, and coordinates no fill value."""
    for name, variable in dataset.variables.items():
        variable.attrs.update(ATTRIBUTES.get(str(name), {}))
        if name in dataset.coords:
            variable.encoding["_FillValue"] = None
    return dataset


def _mean_nanoseconds(own: Sequence[CyclePart]) -> int:
    """Mean time of all frames since the first one of the first part, ns."""
    start = own[0].first_time
    total = sum(part.seconds + part.frames * float((part.first_time - start) / np.timedelta64(1, "s")) for part in own)
    return round(1e9 * total / sum(part.frames for part in own))


def _together(own: Sequence[CyclePart]) -> tuple[Array, Array, Array]:
    """Mean, spread and noise variance of a cycle whose frames have one or, after a knock, several registrations."""
    if len(own) == 1:
        return own[0].mean, own[0].spread, own[0].noise_variance
    frames = np.array([part.frames for part in own], float)
    means = np.stack([part.mean for part in own])
    weight = np.where(np.isfinite(means), frames[:, None, None], 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = weight / weight.sum(axis=0)
    mean = np.where(weight > 0, weight * np.nan_to_num(means), 0.0).sum(axis=0)
    noise = (weight**2 * np.nan_to_num([part.noise_variance for part in own])).sum(axis=0)
    spread = np.sqrt((weight * np.nan_to_num([part.spread**2 for part in own])).sum(axis=0))
    nowhere = np.isnan(means).all(axis=0)
    return tuple(np.where(nowhere, np.nan, field) for field in (mean, spread, noise))  # type: ignore[return-value]


def _gradient_variance(fields_K: Array, covariance: Array, grid: PlanGrid) -> Array:
    """Variance that the registration's uncertainty puts on fields, (cycle, y, x), through their gradients, K2."""
    known = np.isfinite(fields_K)
    filled = np.zeros(fields_K.shape)
    nearest: Any = ()
    for cycle, (field_K, seen) in enumerate(zip(fields_K, known, strict=True)):
        if seen.any():
            if cycle == 0 or not known[cycle - 1].any() or (seen != known[cycle - 1]).any():
                nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
            filled[cycle] = field_K[tuple(nearest)]
    # Over 3 cells, so that the noise of single cells does not pass for a gradient.
    smooth = ndimage.gaussian_filter(filled, (0, 1, 1), mode="nearest")
    down, across = np.gradient(smooth, grid.cell_size_mm, axis=(1, 2))
    xx, xy, yy = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.where(known, across * (across * xx + 2 * down * xy) + down * down * yy, np.nan)


def _rate(mean: Array, time: Array) -> Array:
    """Central difference over the cycles that have a time, K/h; NaN where there are fewer than two."""
    rate = np.full(mean.shape, np.nan)
    known = np.flatnonzero(~np.isnat(time))
    if known.size >= 2:
        hours = (time[known] - time[known[0]]) / np.timedelta64(1, "s") / 3600
        rate[known] = np.gradient(mean[known], hours, axis=0)
    return rate
