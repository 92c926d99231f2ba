"""Blocks of frames: cut, and reduced to the mean and variance of every pixel's temperature."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermography._typing import Array
from thermography.fields.cycle_fields import noise_of_differences
from thermography.fields.resampling import PlanWeights
from thermography.io.flir import FrameReference
from thermography.io.frame import CameraParameters
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
from thermography.registration.displacement import RegisteredFrom, Watch

Override = Callable[[FrameReference], CameraParameters]

#: Most frames of one block: what a cluster computes at once, and what is lost when a run is broken off.
BLOCK_FRAMES = 512
#: Corrections within a block differ by no more than this.
CORRECTION_STEP_K = 2e-3


@dataclass(frozen=True)
class Block:
    """Consecutive frames that are reduced together: same cycle, registration and parameters, close in time.

    Attributes
    ----------
    first, stop
        Frames `first` to `stop` - 1, indices into the references.
    cycle
        Index of their cycle, `thermography.fields.cycle_fields.NOT_NUMBERED` for none.
    span
        Index of their registration.
    parameters
        To calibrate them with.
    """

    first: int
    stop: int
    cycle: int
    span: int
    parameters: CameraParameters


@dataclass(frozen=True)
class Camera:
    """What a registration makes of the sensor: the weights of the plan's cells and the watch on the fiducials."""

    weights: PlanWeights
    watch: Watch


@dataclass(frozen=True)
class BlockResult:
    """Temperature of the window's pixels over a block, the field on the plan, the shift of every frame, and the sums of the counts."""

    temperature: MeanTemperature
    cells: Array
    shift_px: Array
    statistics: CountStatistics | None = None


def cut_blocks(
    references: Sequence[FrameReference],
    times: Array,
    cycles: Array,
    spans: Sequence[RegisteredFrom],
    correction_K: Array,
    *,
    override: Override,
    block_s: float,
    first: int = 0,
) -> list[Block]:
    """Cut the frames from `first` on into blocks: the unit of memory, of `frame_temperature`, and of what a cluster computes."""
    starts = np.array([span.first for span in spans])
    span_of = np.searchsorted(starts, np.arange(len(references)), side="right") - 1
    longest = np.timedelta64(round(block_s * 1e9), "ns")
    blocks: list[Block] = []
    for i in range(first, len(references)):
        own = Block(i, i + 1, int(cycles[i]), int(span_of[i]), override(references[i]))
        last = blocks[-1] if blocks else None
        if (
            last is not None
            and (last.cycle, last.span, last.parameters) == (own.cycle, own.span, own.parameters)
            and i - last.first < BLOCK_FRAMES
            and times[i] - times[last.first] < longest
            and abs(correction_K[i] - correction_K[last.first]) <= CORRECTION_STEP_K
        ):
            blocks[-1] = replace(last, stop=i + 1)
        else:
            blocks.append(own)
    return blocks


def reduce_block(
    frames: Sequence[FrameReference], parameters: CameraParameters, camera: Camera, keep_statistics: bool = False
) -> BlockResult:
    """Read the frames of a block and reduce them; counts are averaged, and calibrated one by one only where they vary too much."""
    sums = Accumulator(camera.weights.used.shape)
    shifts, noise = [], np.nan
    # One buffer for all chunks: fresh memory for each costs more than reading into it.
    buffer = np.empty((min(CHUNK_FRAMES, len(frames)), *camera.weights.used.shape), np.uint16)
    with WindowReader(camera.weights.window) as reader:
        for start in range(0, len(frames), CHUNK_FRAMES):
            counts = reader.read(frames[start : start + CHUNK_FRAMES], buffer)
            sums.add(counts)
            noise = noise_of_differences(counts[0], camera.weights.whole) if start == 0 else noise
            shifts.append(camera.watch.shifts(counts, noise))
    statistics = sums.statistics()
    if len(frames) == 1:
        mean = calibrate(buffer[0], parameters).astype(float)
        reduced = MeanTemperature(1, mean, np.zeros_like(mean), np.zeros_like(mean))
    else:
        reduced = mean_temperature(statistics, parameters, used=camera.weights.used)
        _calibrate_one_by_one(
            reduced,
            (reduced.bound_K > AVERAGING_LIMIT_K) & camera.weights.used,
            frames,
            parameters,
            camera.weights.window,
        )
    cells = camera.weights.resample(reduced.mean)
    return BlockResult(reduced, cells, np.concatenate(shifts), statistics if keep_statistics else None)


def _calibrate_one_by_one(
    reduced: MeanTemperature,
    wild: Array,
    frames: Sequence[FrameReference],
    parameters: CameraParameters,
    window: tuple[slice, slice],
) -> None:
    """Replace mean and variance of the pixels that vary too much for averaged counts, from a second reading of the block."""
    if not wild.any():
        return
    total, squares = np.zeros(int(wild.sum())), np.zeros(int(wild.sum()))
    reference = reduced.mean[wild]
    buffer = np.empty((min(CHUNK_FRAMES, len(frames)), *wild.shape), np.uint16)
    with WindowReader(window) as reader:
        for start in range(0, len(frames), CHUNK_FRAMES):
            counts = reader.read(frames[start : start + CHUNK_FRAMES], buffer)
            step = calibrate(counts[:, wild], parameters).astype(float) - reference
            total += step.sum(axis=0)
            squares += (step**2).sum(axis=0)
    reduced.mean[wild] = reference + total / len(frames)
    reduced.variance[wild] = np.maximum(squares / len(frames) - (total / len(frames)) ** 2, 0.0)
