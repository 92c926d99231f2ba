"""L3 - Blocks of frames: cut, read without detours, and reduced to the mean and variance of every pixel's temperature."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermography.averaging import AVERAGING_LIMIT_K, CountStatistics, MeanTemperature, accumulate, mean_temperature
from thermography.cycles import pixel_noise
from thermography.flir import CameraParameters, FrameReference
from thermography.knocks import RegisteredFrom, Watch
from thermography.radiometry import calibrate
from thermography.resampling import PlanWeights

Array = NDArray[Any]
Override = Callable[[FrameReference], CameraParameters]

#: Most frames that one block holds in memory.
BLOCK_FRAMES = 128
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
        Index of their cycle, `thermography.cycles.NOT_NUMBERED` for none.
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
    frames: Sequence[FrameReference], parameters: CameraParameters, camera: Camera, *, keep_statistics: bool = False
) -> BlockResult:
    """Read the frames of a block and reduce them; counts are averaged, and calibrated one by one only where they vary too much."""
    counts = read_window(frames, camera.weights.window)
    statistics = None
    if len(frames) == 1 and not keep_statistics:
        mean = calibrate(counts[0], parameters).astype(float)
        reduced = MeanTemperature(1, mean, np.zeros_like(mean), np.zeros_like(mean))
    else:
        statistics = accumulate(counts)
        reduced = mean_temperature(statistics, parameters)
        wild = reduced.bound_K > AVERAGING_LIMIT_K
        if wild.any():
            temperature = calibrate(counts[:, wild], parameters).astype(float)
            reduced.mean[wild], reduced.variance[wild] = temperature.mean(axis=0), temperature.var(axis=0)
    noise = pixel_noise(counts[0].astype(float), camera.weights.used)
    shift = camera.watch.shifts(counts, noise)
    return BlockResult(reduced, camera.weights.resample(reduced.mean), shift, statistics if keep_statistics else None)


def read_window(frames: Sequence[FrameReference], window: tuple[slice, slice]) -> NDArray[np.uint16]:
    """Counts of a window of the sensor, (time, row, column) uint16; raw samples are read row-wise where they lie."""
    rows, columns = window
    counts = np.empty((len(frames), rows.stop - rows.start, columns.stop - columns.start), np.uint16)
    path, file = None, -1
    try:
        for i, frame in enumerate(frames):
            samples = frame.samples
            if samples.encoding != "raw" or len(frame.segments) != 1:
                counts[i] = frame.read().counts[window]
                continue
            if frame.path != path:
                if file >= 0:
                    os.close(file)
                path, file = frame.path, os.open(frame.path, os.O_RDONLY)
            width = samples.shape[1] * 2
            start = frame.segments[0][0] + samples.offset + rows.start * width
            data = os.pread(file, counts.shape[1] * width, start)
            if len(data) < counts.shape[1] * width:
                raise OSError(
                    f"{frame.path}: frame {frame.index} ends early; the file has become shorter since it was indexed"
                )
            values = np.frombuffer(data, "<u2" if samples.little_endian else ">u2").reshape(-1, samples.shape[1])
            counts[i] = values[:, columns]
    finally:
        if file >= 0:
            os.close(file)
    return counts
