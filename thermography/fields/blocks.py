"""Blocks of consecutive frames: cut, and reduced to the mean and variance of every pixel's temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.fields.cycle_fields import noise_of_differences
from thermography.fields.inputs import FrameSeries
from thermography.fields.resampling import PlanWeights
from thermography.io.frame import CameraParameters, StoredPixels
from thermography.io.window_reader import WindowReader
from thermography.radiometry.averaging import (
    AVERAGING_LIMIT_K,
    CHUNK_FRAMES,
    Accumulator,
    CountStatistics,
    MeanTemperature,
    mean_temperature,
)
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import FiducialMonitor, RegistrationSpan

#: Largest number of frames of one block.
BLOCK_FRAMES = 512
#: About this number of pixels, evenly spread over the table, is compared from frame to frame.
_SAMPLED_PIXELS = 250
#: Largest difference of the corrections within a block, K.
_CORRECTION_STEP_K = 2e-3


@dataclass(frozen=True)
class Block:
    """Consecutive frames that are reduced together: same cycle, registration and camera parameters, close in time.

    Attributes
    ----------
    first, stop : int
        Frames `first` to ``stop - 1``.
    cycle : int
        Index of their cycle, `thermography.fields.inputs.NO_CYCLE` for none.
    span : int
        Index of their registration span.
    parameters : CameraParameters
        To calibrate them with.
    """

    first: int
    stop: int
    cycle: int
    span: int
    parameters: CameraParameters


@dataclass(frozen=True)
class RegisteredSensor:
    """What block reduction needs of a registration.

    Attributes
    ----------
    weights : PlanWeights
        From pixels to the cells of the plan.
    monitor : FiducialMonitor
        Of the fiducials within the window of `weights`.
    """

    weights: PlanWeights
    monitor: FiducialMonitor

    @cached_property
    def sampled(self) -> NDArray[np.int64]:
        """Some hundreds of pixels, as indices into the flattened window, evenly spread over the table beside fiducials and edges."""
        interior = self.weights.interior
        step = max(int(np.sqrt(interior.sum() / _SAMPLED_PIXELS)), 1)
        grid = np.zeros_like(interior)
        grid[::step, ::step] = True
        return np.flatnonzero(grid & interior)


@dataclass(frozen=True)
class BlockResult:
    """The reduction of one block.

    Attributes
    ----------
    temperature : MeanTemperature
        Mean and variance over the frames for the pixels of the window, degC.
    cells : (y, x) ndarray, degC
        Mean temperature on the plan.
    displacement_px : (frames, 4) ndarray, px
        Displacement of the fiducials in every frame, see `thermography.registration.displacement`; NaN where they have no contrast.
    samples : (frames, points) ndarray, degC
        Temperature of the sampled pixels in every frame.
    noise_K : float, K
        Standard deviation of the noise of a pixel.
    statistics : CountStatistics or None
        Sums of the counts, if they are kept.
    """

    temperature: MeanTemperature
    cells: Array
    displacement_px: Array
    samples: Array
    noise_K: float
    statistics: CountStatistics | None = None

    @property
    def view(self) -> BlockView:
        """The result without what is kept per pixel."""
        return BlockView(self.cells, self.displacement_px, self.samples, self.noise_K)


@dataclass(frozen=True)
class BlockView:
    """What a block shows of the table, small beside its sums; the attributes are those of `BlockResult`.

    Attributes
    ----------
    cells : (y, x) ndarray, degC
    displacement_px : (frames, 4) ndarray, px
    samples : (frames, points) ndarray, degC
    noise_K : float, K
    """

    cells: Array
    displacement_px: Array
    samples: Array
    noise_K: float


def cut_blocks(
    frames: FrameSeries, spans: Sequence[RegistrationSpan], *, block_s: float, first: int = 0
) -> list[Block]:
    """Cut frames into blocks: the unit of memory and of `frame_temperature`.

    Parameters
    ----------
    frames : FrameSeries
    spans : sequence of RegistrationSpan
        In order, the first one from frame 0 on.
    block_s : float, s
        Length of time of a block; 0 gives every frame a block of its own.
    first : int
        Frame to start at.

    Returns
    -------
    list of Block
        In order, without gaps, up to the last frame.
    """
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
    frames: Sequence[StoredPixels],
    parameters: CameraParameters,
    sensor: RegisteredSensor,
    keep_statistics: bool = False,
) -> BlockResult:
    """Read the frames of a block and reduce them.

    Counts are averaged before they are calibrated; pixels whose counts vary too much for that are calibrated frame by frame.

    Parameters
    ----------
    frames : sequence of StoredPixels
        Of one block.
    parameters : CameraParameters
        To calibrate them with.
    sensor : RegisteredSensor
        Of their registration.
    keep_statistics : bool
        Whether the result contains the sums of the counts.

    Returns
    -------
    BlockResult
    """
    weights = sensor.weights
    sums = Accumulator(weights.used.shape)
    displacements, samples, noise = [], [], np.nan
    with WindowReader(weights.window) as reader:
        for counts in reader.read_in_chunks(frames, CHUNK_FRAMES):
            sums.add(counts)
            noise = noise_of_differences(counts[0], weights.interior) if np.isnan(noise) else noise
            displacements.append(sensor.monitor.displacements(counts, noise))
            samples.append(counts.reshape(len(counts), -1)[:, sensor.sampled])
    statistics = sums.statistics()
    if len(frames) == 1:
        temperature = calibrate(counts[0], parameters).astype(float)
        mean = MeanTemperature(1, temperature, np.zeros_like(temperature), np.zeros_like(temperature))
    else:
        mean = mean_temperature(statistics, parameters, used=weights.used)
        # Also where there is no bound: a pixel without a temperature in one of the frames.
        varying = ~(mean.bound_K <= AVERAGING_LIMIT_K) & weights.used
        if varying.any():
            _calibrate_per_frame(mean, varying, frames, parameters, weights.window)
    cells = weights.resample(mean.mean)
    sampled = np.concatenate(samples)
    return BlockResult(
        mean,
        cells,
        np.concatenate(displacements),
        calibrate(sampled, parameters),
        noise * _kelvin_per_count(sampled[0], parameters),
        statistics if keep_statistics else None,
    )


def _kelvin_per_count(counts: Array, parameters: CameraParameters) -> float:
    """Slope of the calibration at the middle of some counts, K."""
    middle = np.uint16(np.median(counts)) if counts.size else np.uint16(0)
    low, high = calibrate(np.array([middle, middle + np.uint16(1)]), parameters)
    return float(high - low)


def _calibrate_per_frame(
    mean: MeanTemperature,
    varying: Array,
    frames: Sequence[StoredPixels],
    parameters: CameraParameters,
    window: tuple[slice, slice],
) -> None:
    """Replace mean and variance of the varying pixels by those of their calibrated frames, which are read a second time.

    A frame in which a pixel has no temperature takes no part in that pixel.
    """
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
