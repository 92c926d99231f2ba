"""L3 - Frames to temperature fields on the table plan: one per cycle, and one per frame or short block of frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography.averaging import AVERAGING_LIMIT_K, MeanTemperature, accumulate, mean_temperature
from thermography.cycles import NOT_NUMBERED, CyclePart, annotate, assemble, position_covariance
from thermography.flir import CameraParameters, FrameReference
from thermography.plan import PlanGrid
from thermography.radiometry import calibrate
from thermography.registration import Registration
from thermography.resampling import PlanWeights, plan_weights

Array = NDArray[Any]
Override = Callable[[FrameReference], CameraParameters]

#: Frames of one cycle that follow each other within this time share one field of the frame stack.
BLOCK_S = 10.0
#: Most frames that are held in memory at once.
BLOCK_FRAMES = 128
#: Corrections within a block differ by no more than this.
CORRECTION_STEP_K = 2e-3


class FieldError(ValueError):
    """The frames cannot be reduced to fields; the message names the frame or cycle and what to do."""


@dataclass(frozen=True)
class RegisteredFrom:
    """A registration and the first frame (index into the references) that it holds for."""

    first: int
    registration: Registration


@dataclass(frozen=True)
class Block:
    """Consecutive frames that are reduced together: same cycle, registration and parameters, close in time."""

    first: int
    stop: int
    cycle: int
    span: int
    parameters: CameraParameters


def reduce_frames(
    references: Sequence[FrameReference],
    registration: Registration | Sequence[RegisteredFrom],
    grid: PlanGrid,
    cycle_bounds: Array,
    *,
    override: Override = lambda frame: frame.parameters,
    correction_K: Array | None = None,
    block_s: float = BLOCK_S,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a still table to one temperature field per cycle on the table plan.

    Counts are averaged, not temperatures, which is exact to the second order of the calibration curve; where the counts of a
    pixel vary too much for that, its frames are calibrated one by one.

    Parameters
    ----------
    references
        Frames sorted by time.
    registration
        For all frames, or spans of them in order (`RegisteredFrom`), the first starting at frame 0.
    grid
        The plan.
    cycle_bounds
        Start and end per cycle, (cycle, 2), or edges (cycle + 1,), datetime64, on the frames' clock; the end is not included.
    override
        Parameters to calibrate a frame with; the frame's own by default.
    correction_K
        Added to the temperature of every frame, shape (time,), for what the camera itself did (shutter steps, drift).
    block_s
        Frames of one cycle within this time share one field of `frame_temperature`; 0 gives every frame its own.
    progress
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        Keeps `thermography.contract.FIELDS`; further `temperature_rate`, `quality_flag`, the registration's `position_u`, and
        the attribute `frames_outside_cycles`, which names the frames that belong to no cycle (their fields are in the stack).

    Raises
    ------
    FieldError
        No frame, frames of different sizes, frames out of order, cycles that overlap, or no frame within any cycle.
    """
    spans = [RegisteredFrom(0, registration)] if isinstance(registration, Registration) else list(registration)
    bounds = check_bounds(cycle_bounds)
    times = check_frames(references, spans[0].registration.shape)
    correction = _check_correction(correction_K, len(references))
    cycles = cycle_of(times, bounds)
    if (cycles == NOT_NUMBERED).all():
        raise FieldError(
            f"no frame lies within a cycle: frames {times[0]} to {times[-1]}, cycles {bounds[0, 0]} to {bounds[-1, 1]}; "
            "check the time zones and the clock offset"
        )
    blocks = plan_blocks(references, times, cycles, spans, correction, override=override, block_s=block_s)
    weights = [plan_weights(span.registration, grid) for span in spans]
    stack = np.full((len(blocks), *grid.shape), np.nan, np.float32)
    parts: list[CyclePart] = []
    for place, block in enumerate(blocks):
        frames = slice(block.first, block.stop)
        reduced = reduce_block(references[frames], block.parameters, weights[block.span])
        reduced = replace(reduced, mean=reduced.mean + float(correction[frames].mean()))
        stack[place] = weights[block.span].resample(reduced.mean)
        if block.cycle != NOT_NUMBERED:
            _gather(parts, block, reduced, times[frames], weights)
        if progress is not None:
            progress(block.stop - block.first)
    if parts:
        parts[-1].finish(weights[parts[-1].span])
    covariances = [position_covariance(span.registration, grid) for span in spans]
    dataset = assemble(parts, len(bounds), grid, covariances, weights).assign(
        frame_temperature=(("time", "y", "x"), stack),
        frame_cycle=("time", np.array([block.cycle + 1 for block in blocks], np.int32)),
        frame_count=("time", np.array([block.stop - block.first for block in blocks], np.int32)),
    )
    dataset = dataset.assign_coords(time=np.array([_middle(times[block.first : block.stop]) for block in blocks]))
    outside = [f"{references[i].path.name}#{references[i].index}" for i in np.flatnonzero(cycles == NOT_NUMBERED)]
    return annotate(dataset).assign_attrs(frames_outside_cycles=json.dumps(outside))


def reduce_block(
    frames: Sequence[FrameReference], parameters: CameraParameters, weights: PlanWeights
) -> MeanTemperature:
    """Read a block of frames and return mean and variance of the temperature of the window's pixels."""
    counts = np.stack([frame.read().counts[weights.window] for frame in frames])
    if len(frames) == 1:
        mean = calibrate(counts[0], parameters).astype(float)
        return MeanTemperature(1, mean, np.zeros_like(mean), np.zeros_like(mean))
    reduced = mean_temperature(accumulate(counts), parameters)
    wild = reduced.bound_K > AVERAGING_LIMIT_K
    if wild.any():
        temperature = calibrate(counts[:, wild], parameters).astype(float)
        reduced.mean[wild], reduced.variance[wild] = temperature.mean(axis=0), temperature.var(axis=0)
    return reduced


def plan_blocks(
    references: Sequence[FrameReference],
    times: Array,
    cycles: Array,
    spans: Sequence[RegisteredFrom],
    correction_K: Array,
    *,
    override: Override,
    block_s: float,
) -> list[Block]:
    """Cut the frames into blocks: the unit of memory, of `frame_temperature`, and of what a cluster computes."""
    starts = np.array([span.first for span in spans])
    if starts[0] != 0 or (np.diff(starts) <= 0).any():
        raise FieldError(f"registrations start at frames {starts.tolist()}; they must start at 0 and rise")
    blocks: list[Block] = []
    begin = 0
    for i, frame in enumerate(references):
        span = int(np.searchsorted(starts, i, side="right")) - 1
        own = Block(i, i + 1, int(cycles[i]), span, override(frame))
        last = blocks[-1] if blocks else None
        if (
            last is not None
            and replace(last, first=i, stop=i + 1) == own
            and i - begin < BLOCK_FRAMES
            and times[i] - times[begin] < np.timedelta64(round(block_s * 1e9), "ns")
            and abs(correction_K[i] - correction_K[begin]) <= CORRECTION_STEP_K
        ):
            blocks[-1] = replace(last, stop=i + 1)
        else:
            blocks.append(own)
            begin = i
    return blocks


def check_bounds(cycle_bounds: Array) -> Array:
    """Cycle bounds as (cycle, 2) datetime64[ns], in order and apart."""
    bounds = np.asarray(cycle_bounds, "datetime64[ns]")
    bounds = np.stack([bounds[:-1], bounds[1:]], axis=-1) if bounds.ndim == 1 else bounds
    if len(bounds) == 0:
        raise FieldError("cycle_bounds is empty; give the start and end of at least one cycle")
    wrong = np.flatnonzero(~(bounds[:, 0] < bounds[:, 1]))
    if wrong.size:
        raise FieldError(
            f"cycle {wrong[0] + 1} ends at {bounds[wrong[0], 1]}, before it starts at {bounds[wrong[0], 0]}"
        )
    overlap = np.flatnonzero(bounds[1:, 0] < bounds[:-1, 1])
    if overlap.size:
        n = int(overlap[0])
        raise FieldError(f"cycle {n + 2} starts at {bounds[n + 1, 0]}, before cycle {n + 1} ends at {bounds[n, 1]}")
    return bounds


def check_frames(references: Sequence[FrameReference], shape: tuple[int, int]) -> Array:
    """Times of the frames, datetime64[ns], after a check that they rise and that all frames have the registered size."""
    if not references:
        raise FieldError("there is no frame to reduce")
    times = np.array([frame.time for frame in references], "datetime64[ns]")
    for i, frame in enumerate(references):
        where = f"{frame.path}: frame {frame.index}"
        if tuple(frame.shape) != tuple(shape):
            raise FieldError(
                f"{where} has {frame.shape} pixels, the registered frames {shape}; reduce one size at a time"
            )
        if np.isnat(times[i]):
            raise FieldError(f"{where} has no time; leave it out")
        if i and times[i] <= times[i - 1]:
            raise FieldError(f"{where} has the time {frame.time}, not after {references[i - 1].time}; sort the frames")
    return times


def cycle_of(times: Array, bounds: Array) -> NDArray[np.int64]:
    """Index of the cycle that every time lies in, `NOT_NUMBERED` where it lies in none."""
    index = np.searchsorted(bounds[:, 0], times, side="right") - 1
    inside = (index >= 0) & (times < bounds[np.maximum(index, 0), 1])
    return np.where(inside, index, NOT_NUMBERED)


def _gather(
    parts: list[CyclePart], block: Block, reduced: MeanTemperature, times: Array, weights: Sequence[PlanWeights]
) -> None:
    """Add a block to the cycle that is open; a block of the next cycle or registration closes it."""
    if not parts or (parts[-1].cycle, parts[-1].span) != (block.cycle, block.span):
        if parts:
            parts[-1].finish(weights[parts[-1].span])
        parts.append(CyclePart(block.cycle, block.span))
    parts[-1].add(reduced, times)


def _check_correction(correction_K: Array | None, frames: int) -> Array:
    if correction_K is None:
        return np.zeros(frames)
    correction = np.asarray(correction_K, float)
    if correction.shape != (frames,) or not np.isfinite(correction).all():
        raise FieldError(
            f"correction_K has shape {correction.shape}; it needs one finite value for each of {frames} frames"
        )
    return correction


def _middle(times: Array) -> np.datetime64:
    return times[0] + (times - times[0]).mean()
