"""L3 - Frames to temperature fields on the table plan: one per cycle, and one per frame or short block of frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography.blocks import Override, cut_blocks, reduce_block
from thermography.checkpoint import Checkpoint, describe
from thermography.cycles import NOT_NUMBERED
from thermography.flir import FrameReference
from thermography.knocks import RegisteredFrom
from thermography.plan import PlanGrid
from thermography.reduction import Reduction
from thermography.registration import Registration
from thermography.scheduling import in_order, open_pool

__all__ = [
    "FieldError",
    "RegisteredFrom",
    "check_bounds",
    "check_correction",
    "check_frames",
    "cycle_of",
    "reduce_frames",
]

Array = NDArray[Any]

#: Frames of one cycle that follow each other within this time share one field of the frame stack.
BLOCK_S = 10.0


class FieldError(ValueError):
    """The frames cannot be reduced to fields; the message names the frame or cycle and what to do."""


def reduce_frames(
    references: Sequence[FrameReference],
    registration: Registration | Sequence[RegisteredFrom],
    grid: PlanGrid,
    cycle_bounds: Array,
    *,
    override: Override = lambda frame: frame.parameters,
    correction_K: Array | None = None,
    block_s: float = BLOCK_S,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a still table to one temperature field per cycle on the table plan.

    Counts are averaged, not temperatures, which is exact to the second order of the calibration curve; where the counts of a
    pixel vary too much for that, its frames are calibrated one by one. The fiducials of every frame are compared with the
    registration; where they have moved and stay so, the plan is registered anew from that frame on.

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
    scheduler
        Address of a dask scheduler whose workers see the same files; without it two threads do the work.
    checkpoint
        Folder for what is finished, with its sums of counts. A run that finds it goes on from there, within a long cycle too;
        `thermography.checkpoint.recalibrate` calibrates the cycles anew without the frames.
    progress
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        Keeps `thermography.contract.FIELDS`; further `temperature_rate`, `quality_flag`, `position_u`, and as JSON texts the attributes
        `frames_outside_cycles` (their fields are in the stack), `knocks` (frame and shift in px), `frames_shaken` (moved for one
        frame only) and `frames_unchecked` (too little contrast to see the fiducials).

    Raises
    ------
    FieldError
        No frame, frames of different sizes, frames out of order, cycles that overlap, or no frame within any cycle.
    CheckpointError
        The checkpoint belongs to another reduction.
    """
    spans = _check_spans([RegisteredFrom(0, registration)] if isinstance(registration, Registration) else registration)
    bounds = check_bounds(cycle_bounds)
    times = check_frames(references, spans[0].registration.shape)
    correction = check_correction(correction_K, len(references))
    cycles = cycle_of(times, bounds)
    _check_meeting(times, bounds, cycles)
    kept = None
    if checkpoint is not None:
        parameters = [override(frame) for frame in references]
        kept = Checkpoint(checkpoint, describe(references, parameters, correction, bounds, grid, spans, block_s))
    run = Reduction(references, times, correction, grid, spans, override, kept)
    _reduce(run, cycles, block_s=block_s, scheduler=scheduler, progress=progress)
    return run.dataset(bounds, cycles)


def _reduce(
    run: Reduction,
    cycles: Array,
    *,
    block_s: float,
    scheduler: str | None,
    progress: Callable[[int], None] | None,
) -> None:
    """Send the frames that are not done through the pool, block by block; after a knock, cut the rest anew."""
    done = run.resume()
    if progress is not None and done:
        progress(done)
    with open_pool(scheduler) as pool:
        while done < len(run.references):
            blocks = cut_blocks(
                run.references,
                run.times,
                cycles,
                run.spans,
                run.correction_K,
                override=run.override,
                block_s=block_s,
                first=done,
            )
            cameras = [pool.share(camera) for camera in run.cameras]
            tasks = (
                (
                    b,
                    (
                        reduce_block,
                        run.references[b.first : b.stop],
                        b.parameters,
                        cameras[b.span],
                        run.keep_statistics,
                    ),
                )
                for b in blocks
            )
            results = in_order(pool, tasks)
            for block, result in results:
                if run.renew(block, result):
                    results.close()
                    break
                run.gather(block, result)
                done = block.stop
                if progress is not None:
                    progress(block.stop - block.first)


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


def _check_meeting(times: Array, bounds: Array, cycles: Array) -> None:
    if (cycles == NOT_NUMBERED).all():
        raise FieldError(
            f"no frame lies within a cycle: frames {times[0]} to {times[-1]}, cycles {bounds[0, 0]} to {bounds[-1, 1]}; "
            "check the time zones and the clock offset"
        )


def _check_spans(spans: Sequence[RegisteredFrom]) -> list[RegisteredFrom]:
    starts = [span.first for span in spans]
    if not starts or starts[0] != 0 or (np.diff(starts) <= 0).any():
        raise FieldError(f"registrations start at frames {starts}; they must start at 0 and rise")
    return list(spans)


def check_correction(correction_K: Array | None, frames: int) -> Array:
    """Correction of every frame, K; zeros where none is given."""
    if correction_K is None:
        return np.zeros(frames)
    correction = np.asarray(correction_K, float)
    if correction.shape != (frames,) or not np.isfinite(correction).all():
        raise FieldError(
            f"correction_K has shape {correction.shape}; it needs one finite value for each of {frames} frames"
        )
    return correction
