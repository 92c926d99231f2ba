"""Blocks of consecutive frames: cut, and reduced to the mean and variance of every pixel's temperature."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.common import Array, ThermographyError
from thermography.fields.cycle_fields import noise_of_differences
from thermography.fields.resampling import PlanWeights, plan_weights, plan_window
from thermography.io.frame import CameraParameters, FrameReference
from thermography.io.sequence import FrameList, WindowReader
from thermography.radiometry.averaging import (
    AVERAGING_LIMIT_K,
    CHUNK_FRAMES,
    Accumulator,
    MeanTemperature,
    mean_temperature,
)
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import FiducialMonitor, RegistrationSpan, monitor_fiducials
from thermography.registration.plan import PlanGrid

# Inputs of a reduction: frames with their times, cycles and corrections, checked before any frame is read.

Override = Callable[[FrameReference], CameraParameters]

#: Cycle index of a frame that lies in no cycle.
NO_CYCLE = -1


class ReductionError(ThermographyError):
    """The frames cannot be reduced to fields; the message names the frame or cycle and the remedy."""


@dataclass(frozen=True)
class FrameSeries:
    """Frames of one size in the order of time: their times (UTC), start and end of every cycle (cycles, 2) on their clock, the end
    excluded, the cycle of every frame (`NO_CYCLE` for none), what is added to its temperature, K, its camera parameters by
    `override`, and what is wrong with the pixels.
    """

    references: Sequence[FrameReference]
    times: Array
    bounds: Array
    cycles: NDArray[np.int64]
    correction_K: Array
    override: Override
    detector: Detector

    def __len__(self) -> int:
        return len(self.references)

    def name(self, index: int) -> str:
        """File name and number of a frame, for messages."""
        return f"{self.references[index].path.name}#{self.references[index].index}"

    def names(self, chosen: Array) -> list[str]:
        """Names of the frames where `chosen`, (frames,), is True."""
        return [self.name(index) for index in np.flatnonzero(chosen)]

    def temperature(self, index: int) -> Array:
        """Read and calibrate a frame: (row, column) degC, without its correction."""
        reference = self.references[index]
        return calibrate(self.detector.read(reference), self.override(reference))

    def outside_cycles(self, what: str) -> ReductionError:
        """Return the error where `what` ("no frame", ...) lies within a cycle."""
        return ReductionError(
            f"{what} is within a cycle: frames {self.times[0]} to {self.times[-1]}, cycles {self.bounds[0, 0]} to "
            f"{self.bounds[-1, 1]}; check the time zones and the clock offset"
        )

    def mean_time(self, chosen: slice | Array) -> np.datetime64:
        """Mean time of the frames with the indices `chosen`."""
        times = self.times[chosen]
        return times[0] + (times - times[0]).mean()


def make_frame_series(
    references: Sequence[FrameReference],
    cycle_bounds: ArrayLike,
    *,
    shape: tuple[int, int],
    override: Override,
    correction_K: ArrayLike | None = None,
    detector: Detector | None = None,
) -> FrameSeries:
    """Check frames, cycles and corrections, and assign the frames to the cycles."""
    # Cycle bounds as (cycles, 2) datetime64[ns], in order and without overlap.
    bounds = np.asarray(cycle_bounds, "datetime64[ns]")
    bounds = np.stack([bounds[:-1], bounds[1:]], axis=-1) if bounds.ndim == 1 else bounds
    if len(bounds) == 0:
        raise ReductionError("cycle_bounds is empty; give the start and end of at least one cycle")
    for n in np.flatnonzero(~(bounds[:, 0] < bounds[:, 1])):
        raise ReductionError(f"cycle {n + 1} ends at {bounds[n, 1]}, before it starts at {bounds[n, 0]}")
    for n in np.flatnonzero(bounds[1:, 0] < bounds[:-1, 1]):
        raise ReductionError(f"cycle {n + 2} starts at {bounds[n + 1, 0]}, before cycle {n + 1} ends at {bounds[n, 1]}")
    times = _check_frames(references, shape)
    correction = np.zeros(len(times)) if correction_K is None else np.asarray(correction_K, float)
    if correction.shape != times.shape or not np.isfinite(correction).all():
        raise ReductionError(f"correction_K has shape {correction.shape}; give a finite value per frame, {len(times)}")
    index = np.searchsorted(bounds[:, 0], times, side="right") - 1
    inside = (index >= 0) & (times < bounds[np.maximum(index, 0), 1])
    detector = detector or Detector.sound(shape)
    return FrameSeries(references, times, bounds, np.where(inside, index, NO_CYCLE), correction, override, detector)


def _check_frames(references: Sequence[FrameReference], shape: tuple[int, int]) -> Array:
    """Times of the frames, (frames,) datetime64[ns]."""
    if not references:
        raise ReductionError("there is no frame to reduce")
    listed = FrameList.of(references)
    times = listed.times.astype("datetime64[ns]")
    wrong = (listed.shapes() != shape).any(axis=1) | np.isnat(times)
    wrong[1:] |= times[1:] <= times[:-1]
    if not wrong.any():
        return times
    i = int(np.argmax(wrong))
    frame = references[i]
    where = f"{frame.path}: frame {frame.index}"
    if tuple(frame.shape) != tuple(shape):
        raise ReductionError(f"{where} has {frame.shape} pixels, the registered frames {shape}; reduce each size alone")
    if np.isnat(times[i]):
        raise ReductionError(f"{where} has no time; leave it out")
    raise ReductionError(f"{where} has the time {frame.time}, not after {references[i - 1].time}; sort the frames")


#: Largest number of frames of one block.
BLOCK_FRAMES = 512
#: About this number of pixels, evenly spread over the table, is compared from frame to frame.
_SAMPLED_PIXELS = 250
#: Largest difference of the corrections within a block, K.
_CORRECTION_STEP_K = 2e-3


@dataclass(frozen=True)
class Block:
    """Frames `first` to ``stop - 1``, which are reduced together: same cycle (`NO_CYCLE` for none), registration span and camera
    parameters, close in time.
    """

    first: int
    stop: int
    cycle: int
    span: int
    parameters: CameraParameters


@dataclass(frozen=True)
class RegisteredSensor:
    """What block reduction needs of a registration: weights from pixels to the cells of the plan, and the monitor of the fiducials in their
    window, and what is wrong with the pixels.
    """

    weights: PlanWeights
    monitor: FiducialMonitor
    detector: Detector

    @cached_property
    def sampled(self) -> NDArray[np.int64]:
        """Some hundreds of pixels, as indices into the flattened window, evenly spread over the table away from fiducials and edges."""
        interior = self.weights.interior
        step = max(int(np.sqrt(interior.sum() / _SAMPLED_PIXELS)), 1)
        grid = np.zeros_like(interior)
        grid[::step, ::step] = True
        return np.flatnonzero(grid & interior)


@dataclass(frozen=True)
class BlockResult:
    """The reduction of one block: mean of the cells (y, x), degC; displacement of the fiducials in every frame (frames, 4), px, NaN without
    contrast; sampled pixels (frames, points), degC; noise of a pixel, K; and the pixels of the window until they are added to those of
    the cycle.
    """

    cells: Array
    displacement_px: Array
    samples: Array
    noise_K: float
    temperature: MeanTemperature | None


def cut_blocks(
    frames: FrameSeries, spans: Sequence[RegistrationSpan], *, block_s: float, first: int = 0
) -> list[Block]:
    """Cut frames into blocks: the unit of memory and of `frame_temperature`."""
    starts = np.array([span.first_frame for span in spans])
    span_of = np.searchsorted(starts, np.arange(len(frames)), side="right") - 1
    longest = round(block_s * 1e9)
    # Plain numbers: a day of video is a million frames, and each is compared once.
    nanoseconds, corrections = frames.times.astype(np.int64).tolist(), np.asarray(frames.correction_K, float).tolist()
    cycles, span_numbers = frames.cycles.tolist(), span_of.tolist()
    blocks: list[Block] = []
    start, of_block = first, None
    for i in range(first, len(frames)):
        parameters = frames.override(frames.references[i])
        if (
            of_block is None
            or cycles[i] != cycles[start]
            or span_numbers[i] != span_numbers[start]
            or i - start >= BLOCK_FRAMES
            or nanoseconds[i] - nanoseconds[start] >= longest
            or abs(corrections[i] - corrections[start]) > _CORRECTION_STEP_K
            or (parameters is not of_block and parameters != of_block)
        ):
            if of_block is not None:
                blocks.append(Block(start, i, cycles[start], span_numbers[start], of_block))
            start, of_block = i, parameters
    if of_block is not None:
        blocks.append(Block(start, len(frames), cycles[start], span_numbers[start], of_block))
    return blocks


def reduce_block(
    frames: Sequence[FrameReference], parameters: CameraParameters, sensor: RegisteredSensor
) -> BlockResult:
    """Read the frames of a block and reduce them."""
    weights = sensor.weights
    sums = Accumulator(weights.used.shape)
    displacements, samples, noise, detector = [], [], np.nan, sensor.detector
    with WindowReader(weights.window) as reader:
        for counts in reader.read_in_chunks(frames, CHUNK_FRAMES):
            detector.repair(counts, weights.window)
            sums.add(counts)
            noise = noise_of_differences(counts[0], weights.interior) if np.isnan(noise) else noise
            displacements.append(sensor.monitor.displacements(counts, noise))
            samples.append(counts.reshape(len(counts), -1)[:, sensor.sampled])
    if len(frames) == 1:
        temperature = calibrate(counts[0], parameters).astype(float)
        mean = MeanTemperature(1, temperature, np.zeros_like(temperature), np.zeros_like(temperature))
    else:
        mean = mean_temperature(sums.statistics(), parameters, used=weights.used)
        # Also where there is no bound: a pixel without a temperature in one of the frames.
        varying = ~(mean.bound_K <= AVERAGING_LIMIT_K) & weights.used
        if varying.any():
            _calibrate_per_frame(mean, varying, frames, parameters, weights.window)
    if detector.clips:
        clipped = (sums.lowest <= detector.lowest) | (sums.highest >= detector.highest)
        mean.mean[clipped.reshape(mean.mean.shape) & weights.used] = np.nan
        mean.variance[clipped.reshape(mean.mean.shape) & weights.used] = np.inf
    sampled = np.concatenate(samples)
    # Slope of the calibration at the middle of the samples.
    middle = np.uint16(np.median(sampled[0])) if sampled[0].size else np.uint16(0)
    low, high = calibrate(np.array([middle, middle + np.uint16(1)]), parameters)
    cells, noise_K = weights.resample(mean.mean, mean.clipped), noise * float(high - low)
    return BlockResult(cells, np.concatenate(displacements), calibrate(sampled, parameters), noise_K, mean)


def _calibrate_per_frame(
    mean: MeanTemperature,
    varying: Array,
    frames: Sequence[FrameReference],
    parameters: CameraParameters,
    window: tuple[slice, slice],
) -> None:
    """Replace mean and variance of the varying pixels by those of their calibrated frames, which are read a second time."""
    pixels = int(varying.sum())
    total, squares, count = np.zeros(pixels), np.zeros(pixels), np.zeros(pixels)
    reference = np.nan_to_num(mean.mean[varying])
    with WindowReader(window) as reader:
        for counts in reader.read_in_chunks(frames, CHUNK_FRAMES):
            deviation = calibrate(counts[:, varying], parameters).astype(float) - reference
            total += np.nansum(deviation, axis=0)
            squares += np.nansum(deviation**2, axis=0)
            count += np.isfinite(deviation).sum(axis=0)
    with np.errstate(invalid="ignore"):
        offset = total / count
        mean.variance[varying] = np.maximum(squares / count - offset**2, 0.0)
    mean.mean[varying] = reference + offset


class Registrations:
    """Registration spans in the order of time, and of each the weights and the monitor for the reduction of blocks, and the covariance of
    the position of every cell (y, x, 2, 2), mm2.
    """

    def __init__(self, spans: Sequence[RegistrationSpan], grid: PlanGrid, detector: Detector) -> None:
        self.grid, self.detector = grid, detector
        self.spans: list[RegistrationSpan] = []
        self.sensors: list[RegisteredSensor] = []
        self.covariances: list[Array] = []
        for index, span in enumerate(spans):
            self.insert(index, span)

    def insert(self, index: int, span: RegistrationSpan) -> None:
        """Insert a span before the one at `index`."""
        registration, grid = span.registration, self.grid
        # In parallel: the weights are compiled loops over pixels, the others many small steps of the interpreter.
        with ThreadPoolExecutor(1) as executor:
            monitor = executor.submit(monitor_fiducials, registration, grid, plan_window(registration, grid))
            covariance = executor.submit(registration.position_covariance, grid.centres_mm)
            weights = plan_weights(registration, grid, bad=self.detector.bad)
            sensor = RegisteredSensor(weights, monitor.result(), self.detector)
        self.spans.insert(index, span)
        self.sensors.insert(index, sensor)
        self.covariances.insert(index, covariance.result())

    def stop_frame(self, index: int) -> int | None:
        """First frame of the span after the one at `index`; None for the last."""
        return self.spans[index + 1].first_frame if index + 1 < len(self.spans) else None
