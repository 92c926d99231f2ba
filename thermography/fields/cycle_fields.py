"""Fields per cycle on the plan: mean, rise, rate, spread, uncertainty and quality flags, as a Dataset with CF attributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from thermography.common import FIELD_ATTRIBUTES, MAD_TO_SIGMA, Array
from thermography.fields.resampling import LEAST_COVERAGE, PlanWeights
from thermography.large_arrays import empty_array, fill_array, give_back, in_pieces, piece_slices
from thermography.radiometry.averaging import AVERAGING_LIMIT_K, MeanTemperature
from thermography.registration.plan import PlanGrid

#: Bits of `quality_flag`.
_FLAGS = {
    "partly_seen": 1,
    "calibrated_per_frame": 2,
    "several_registrations": 4,
    "not_seen": 8,
    "no_frame": 16,
    "surface_edge": 32,
    "object": 64,
    "clipped": 128,
}
#: Flag of cells that see two surfaces of different emissivity.
SURFACE_EDGE = _FLAGS["surface_edge"]
#: Flag of cells in view that are empty because pixels are clipped, or show less than any temperature.
CLIPPED = _FLAGS["clipped"]
#: Flag of cells that show an object on the table.
OBJECT = _FLAGS["object"]
#: Coverage below which a cell is flagged as partly seen.
PARTLY_SEEN_BELOW = 0.99
#: In images of more pixels than this, ...
_LARGE_PX = 60_000
#: ... this number of rows on either side of the middle determines the noise to a per cent.
_NOISE_ROWS = 32
#: Fewest pixels of a column, and fewest columns, that show whether these share a noise.
_LEAST_ROWS, _LEAST_COLUMNS = 8, 40


@dataclass
class CyclePart:
    """The frames of one cycle under one registration: means over pixels while it is open, cells (y, x) once it is finished, with mean,
    degC, spread of a pixel over the frames, K, variance of the mean from noise, K2, whether pixels were calibrated frame by frame, and
    frames averaged; `seconds` sums the times since the first frame, `seen_s` are the mean times since then at which a cell was seen,
    where not all frames show it.
    """

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
    seen_s: Array = field(default_factory=lambda: np.empty(0))

    def add(self, reduced: MeanTemperature, times: Array) -> None:
        """Add a block of frames: means over its pixels, and the times of its frames, (frames,) datetime64."""
        if self.pixels is None:
            self.first_time = times[0]
        self.pixels = reduced if self.pixels is None else self.pixels.merge(reduced)
        self.frames += reduced.frames
        self.seconds += float(((times - self.first_time) / np.timedelta64(1, "ns")).sum()) / 1e9

    def join(self, later: CyclePart) -> None:
        """Add frames after these of the same cycle and registration, whose pixels are there too."""
        assert self.pixels is not None
        assert later.pixels is not None
        apart_s = float((later.first_time - self.first_time) / np.timedelta64(1, "ns")) / 1e9
        self.pixels = self.pixels.merge(later.pixels)
        self.frames += later.frames
        self.seconds += later.seconds + later.frames * apart_s

    def finish(self, weights: PlanWeights) -> None:
        """Average pixels over the cells of the plan and release them."""
        assert self.pixels is not None
        pixels = self.pixels
        self.mean = weights.resample(pixels.mean, pixels.clipped)
        sample = pixels.frames / (pixels.frames - 1) if pixels.frames > 1 else np.nan
        self.spread = np.where(np.isnan(self.mean), np.nan, np.sqrt(weights.average(pixels.variance) * sample))
        self.noise_variance = weights.noise_factor * noise_of_differences(pixels.mean, weights.interior) ** 2
        by_lines = ((pixels.mean.T, weights.interior.T), (pixels.mean, weights.interior))
        for lines, (image, interior) in enumerate(by_lines):
            if variance := variance_of_columns(image, interior):
                self.noise_variance = self.noise_variance + variance * weights.line_factors[lines]
        varying = ~(pixels.bound_K <= AVERAGING_LIMIT_K)
        self.fell_back = (
            weights.average(varying.astype(float)) > 0 if varying.any() else np.zeros(self.mean.shape, bool)
        )
        self.count = np.where(np.isfinite(self.mean), self.frames, 0)
        self.pixels = None


def pixel_noise(image: Array, used: NDArray[np.bool_]) -> float:
    """Standard deviation of white noise in an image, insensitive to smooth fields."""
    return noise_of_differences(image, scipy.ndimage.binary_erosion(used, np.ones((3, 3))))


def noise_of_differences(image: Array, interior: NDArray[np.bool_]) -> float:
    """As `pixel_noise`, for pixels whose neighbours are known to be in use."""
    if interior.sum() < 30:
        return float("nan")
    if image.size > _LARGE_PX:
        rows = np.flatnonzero(interior.any(axis=1))
        middle = slice(max(int(rows.mean()) - _NOISE_ROWS, 0), int(rows.mean()) + _NOISE_ROWS)
        image, interior = image[middle], interior[middle]
    values = image.astype(float)
    # Second differences down, then across: the sum of squared weights is 36, so that the noise is 6 times that of one pixel.
    down = values[:-2] - 2 * values[1:-1] + values[2:]
    both = down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:]
    return MAD_TO_SIGMA * float(np.nanmedian(np.abs(both[interior[1:-1, 1:-1]]))) / 6


def variance_of_columns(image: Array, interior: NDArray[np.bool_]) -> float:
    """Variance of the noise that the pixels of every column share, of an image in any unit: what the scatter of the columns' means has
    beyond that of their pixels; 0 where this hides it.
    """
    if image.size > _LARGE_PX:
        middle = image.shape[0] // 2
        image, interior = (one[max(middle - _NOISE_ROWS, 0) : middle + _NOISE_ROWS] for one in (image, interior))
    # Fourth differences, of a sum of squared weights of 70, leave nothing of a smooth field.
    used = interior[:, 1:-3] & interior[:, 3:-1]
    across = np.where(used, np.diff(image.astype(float), 4, axis=1), np.nan)
    count = np.isfinite(across).sum(axis=0)
    across, count = across[:, count >= _LEAST_ROWS], count[count >= _LEAST_ROWS]
    if count.size < _LEAST_COLUMNS:
        return 0.0
    means = np.nanmean(across, axis=0)
    single = (MAD_TO_SIGMA * float(np.nanmedian(np.abs(across - means)))) ** 2 * float(np.mean(1.0 / count))
    shared = (MAD_TO_SIGMA * float(np.median(np.abs(means)))) ** 2 - single
    return shared / 70.0 if shared > single else 0.0


def assemble_fields(
    parts: Sequence[CyclePart],
    cycles: int,
    grid: PlanGrid,
    covariances: Sequence[Array],
    coverages: Sequence[Array],
    *,
    frames: Mapping[str, Any] | None = None,
    frame_coordinates: Mapping[str, Any] | None = None,
    folder: Path | None = None,
) -> xr.Dataset:
    """Assemble the cycles to one Dataset: mean, rise, rate, spread, count, uncertainties and flags on the plan."""
    shape = (cycles, *grid.shape)
    mean, spread, noise = (fill_array(shape, float, lambda _: np.nan, folder) for _ in range(3))
    late_s = fill_array(shape, np.float32, lambda _: 0.0, folder)
    span_of = np.zeros(cycles, int)
    count = fill_array(shape, np.int32, lambda _: 0, folder)
    flags = fill_array(shape, np.uint8, lambda _: _FLAGS["no_frame"], folder)
    time = np.full(cycles, np.datetime64("NaT"), "datetime64[ns]")
    step = next(piece_slices(shape)).stop
    for number, (cycle, group) in enumerate(groupby(parts, lambda part: part.cycle), start=1):
        of_cycle = list(group)
        # Mean time of all frames since the first one of the first part, s, and of those that show a cell.
        start = of_cycle[0].first_time
        begun = [float((part.first_time - start) / np.timedelta64(1, "s")) for part in of_cycle]
        total = sum(part.seconds + part.frames * since for part, since in zip(of_cycle, begun, strict=True))
        mean_s = total / sum(part.frames for part in of_cycle)
        time[cycle] = start + np.timedelta64(round(1e9 * mean_s), "ns")
        shown = [
            part.count * (since + (part.seen_s if part.seen_s.size else part.seconds / part.frames) - mean_s)
            for part, since in zip(of_cycle, begun, strict=True)
        ]
        late_s[cycle] = sum(shown) / np.maximum(sum(part.count for part in of_cycle), 1)
        mean[cycle], spread[cycle], noise[cycle] = merged = _merge(of_cycle)
        span_of[cycle] = of_cycle[-1].span
        count[cycle] = sum(part.count for part in of_cycle)
        flags[cycle] = _flags(of_cycle, merged[0], np.max([coverages[part.span] for part in of_cycle], axis=0))
        if number % step == 0:
            give_back(mean, spread, noise, late_s, count, flags)
    plan = ("cycle", "y", "x")
    temperatures = {name: empty_array(shape, np.float32, folder) for name in _TEMPERATURES}
    first, first_span = parts[0].cycle, parts[0].span

    def late_K(some: slice) -> Array:
        """What a cell shows too much of its cycle as it was seen later than the others."""
        return np.asarray(np.nan_to_num(_rate_of(mean, time, some)) / 3600.0 * late_s[some])

    late_first_K = late_K(slice(first, first + 1))
    for some in piece_slices(shape):
        means, noises, spans = mean[some], noise[some], span_of[some]
        position = np.full(means.shape, np.nan)
        for span, covariance in enumerate(covariances):
            chosen = spans == span
            if chosen.any():
                position[chosen] = _gradient_variance(means[chosen], covariance, grid)
        rise = means - mean[first]
        rise_position = _gradient_variance(rise, covariances[first_span], grid)
        # The noise of the reference cycle enters every rise but its own, which is zero by definition.
        is_first = np.arange(some.start, some.stop)[:, None, None] == first
        rise_noise = np.where(is_first, 0.0, noises + noise[first])
        late = late_K(some)
        noise_u = np.sqrt(noises + position + late**2)
        rise_noise_u = np.sqrt(rise_noise + rise_position + (late - late_first_K) ** 2)
        values = (means, noise_u, rise, rise_noise_u, _rate_of(mean, time, some), spread[some])
        for array, value in zip(temperatures.values(), values, strict=True):
            array[some] = value
        give_back(mean, spread, noise, *temperatures.values())
    dataset = xr.Dataset(
        {name: (plan, array) for name, array in temperatures.items()}
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


def _flags(parts: Sequence[CyclePart], mean: Array, coverage: Array) -> NDArray[np.uint8]:
    """Quality flags of one cycle."""
    limits = {
        "partly_seen": coverage < PARTLY_SEEN_BELOW,
        "calibrated_per_frame": np.any([part.fell_back for part in parts], axis=0),
        "several_registrations": np.full(mean.shape, len(parts) > 1),
        "not_seen": np.isnan(mean),
        "clipped": np.isnan(mean) & (coverage >= LEAST_COVERAGE),
    }
    return np.sum([np.where(where, _FLAGS[name], 0) for name, where in limits.items()], axis=0, dtype=np.uint8)


_TEMPERATURES = (
    "temperature", "temperature_noise_u", "temperature_rise", "temperature_rise_noise_u", "temperature_rate", "temperature_spread"
)  # fmt: skip


def _rate_of(mean: Array, time: Array, some: slice) -> Array:
    """`rate` of some cycles of all, from them and the nearest ones on either side that have a time."""
    timed = np.flatnonzero(~np.isnat(time))
    first, stop = np.searchsorted(timed, (some.start, some.stop)).tolist()
    near = timed[max(first - 1, 0) : stop + 1]
    start, end = min([some.start, *near]), max([some.stop - 1, *near]) + 1
    return rate(mean[start:end], time[start:end], since=time[timed[0]])[some.start - start : some.stop - start]


def annotate(dataset: xr.Dataset) -> xr.Dataset:
    """Set the CF attributes of every listed variable, and no fill value for coordinates."""
    flags = {"flag_masks": np.array(list(_FLAGS.values()), np.uint8), "flag_meanings": " ".join(_FLAGS)}
    for name, variable in dataset.variables.items():
        variable.attrs.update(FIELD_ATTRIBUTES.get(str(name), {}) | (flags if name == "quality_flag" else {}))
        if "ancillary_variables" in variable.attrs:
            listed = variable.attrs["ancillary_variables"].split()
            variable.attrs["ancillary_variables"] = " ".join(each for each in listed if each in dataset.variables)
        if name in dataset.coords:
            variable.encoding["_FillValue"] = None
    return dataset


def _merge(parts: Sequence[CyclePart]) -> tuple[Array, Array, Array]:
    """Mean, spread and noise variance of a cycle, weighted by frames where a knock divides it between several registrations."""
    if len(parts) == 1:
        return parts[0].mean, parts[0].spread, parts[0].noise_variance
    frames = np.array([part.frames for part in parts], float)
    means = np.stack([part.mean for part in parts])
    weight = np.where(np.isfinite(means), frames[:, None, None], 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = weight / weight.sum(axis=0)
    mean = np.where(weight > 0, weight * np.nan_to_num(means), 0.0).sum(axis=0)
    noise = (weight**2 * np.nan_to_num([part.noise_variance for part in parts])).sum(axis=0)
    spread = np.sqrt((weight * np.nan_to_num([part.spread**2 for part in parts])).sum(axis=0))
    unseen = np.isnan(means).all(axis=0)
    mean, spread, noise = (np.where(unseen, np.nan, field) for field in (mean, spread, noise))
    return mean, spread, noise


def _gradient_variance(fields_K: Array, covariance: Array, grid: PlanGrid) -> Array:
    """Variance of fields, (cycle, y, x), from the position uncertainty of the registration through their gradients, K2."""
    seen = np.isfinite(fields_K)
    filled = np.zeros(fields_K.shape)
    nearest: Any = ()
    for cycle, (field_K, cells) in enumerate(zip(fields_K, seen, strict=True)):
        if cells.any():
            if cycle == 0 or not seen[cycle - 1].any() or (cells != seen[cycle - 1]).any():
                nearest = scipy.ndimage.distance_transform_edt(~cells, return_distances=False, return_indices=True)
            filled[cycle] = field_K[tuple(nearest)]
    # Smoothed over neighbouring cells, so that their noise is not taken for a gradient.
    smooth = scipy.ndimage.gaussian_filter(filled, (0, 1, 1), mode="nearest")
    down, across = np.gradient(smooth, grid.cell_size_mm, axis=(1, 2))
    xx, xy, yy = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.where(seen, across * (across * xx + 2 * down * xy) + down * down * yy, np.nan)


def cycles_with_field(temperature: Array | xr.DataArray) -> NDArray[np.bool_]:
    """Return which cycles have a field."""
    return np.concatenate([np.isfinite(some).any(axis=(1, 2)) for _, some in in_pieces(temperature)])


def reference_cycle(temperature: Array | xr.DataArray) -> int:
    """Index of the cycle from which rises are counted: the first one with a field."""
    return int(np.flatnonzero(cycles_with_field(temperature))[0])


def rate(mean: Array, time: Array, *, since: np.datetime64 | None = None) -> Array:
    """Rate of the temperature as central difference over the cycles that have a time."""
    rates = np.full(mean.shape, np.nan)
    timed = np.flatnonzero(~np.isnat(time))
    if timed.size >= 2:
        hours = (time[timed] - (time[timed[0]] if since is None else since)) / np.timedelta64(1, "s") / 3600
        rates[timed] = np.gradient(mean[timed], hours, axis=0)
    return rates
