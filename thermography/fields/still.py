"""Frames to temperature fields on the table plan: one per cycle, and one per frame or short block of frames.

A reduction under way: registrations, the cycle that is open, the frame stack, and what a broken run had finished.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.blocks import Block, BlockResult, Camera, Override, cut_blocks, reduce_block
from thermography.fields.checkpoint import Checkpoint, Finished, Group, describe
from thermography.fields.cycle_fields import NOT_NUMBERED, CyclePart, assemble, position_covariance
from thermography.fields.resampling import plan_weights, plan_window
from thermography.fields.scheduling import in_order, open_pool
from thermography.io.flir import FrameReference
from thermography.radiometry.planck import calibrate
from thermography.registration.displacement import (
    KNOCK_PX,
    SUSPECT_PX,
    RegisteredFrom,
    fiducial_shift,
    image_shift,
    register_anew,
    shifted,
    watch,
)
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

__all__ = [
    "FieldError",
    "RegisteredFrom",
    "check_bounds",
    "check_correction",
    "check_frames",
    "cycle_of",
    "reduce_frames",
]

#: Frames of one cycle that follow each other within this time share one field of the frame stack.
BLOCK_S = 10.0


class FieldError(ThermographyError):
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
        `thermography.fields.checkpoint.recalibrate` calibrates the cycles anew without the frames.
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


#: A cycle that is open is kept on disk whenever it has grown by so many frames: what a broken run has to do again at most.
KEPT_FRAMES = 4096
#: Frames whose mean the plan is registered on anew after a knock.
RENEWAL_FRAMES = 8


@dataclass
class Reduction:
    """What has been gathered so far, in the order of time: the registrations, the open cycle, and the frame stack."""

    references: Sequence[FrameReference]
    times: Array
    correction_K: Array
    grid: PlanGrid
    spans: list[RegisteredFrom]
    override: Override
    checkpoint: Checkpoint | None = None
    cameras: list[Camera] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    parts: list[CyclePart] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    stack: list[NDArray[np.float32]] = field(default_factory=list)
    shift_px: Array = field(default_factory=lambda: np.empty(0))
    shaken: set[int] = field(default_factory=set)
    baseline_px: Array = field(default_factory=lambda: np.zeros(2))
    groups: list[Group] = field(default_factory=list)
    saved_blocks: int = 0
    kept_frames: int = 0

    def __post_init__(self) -> None:
        self.shift_px = np.full(len(self.references), np.nan)
        prepared = [self._prepare(span.registration) for span in self.spans]
        self.cameras, self.covariances = [one for one, _ in prepared], [other for _, other in prepared]

    @property
    def keep_statistics(self) -> bool:
        """Sums of counts are kept where there is a place for them."""
        return self.checkpoint is not None

    def resume(self) -> int:
        """Take over what an earlier run has finished; return the first frame that is not done."""
        done = 0
        if self.checkpoint is None:
            return done
        for index, span, shift in self.checkpoint.knocks():
            self._renew_from(index, span, np.array(shift))
        for finished in self.checkpoint.load():
            if finished.first_frame != done:
                break
            done = self._take_over(finished)
        self.saved_blocks = len(self.blocks)
        unfinished = self.checkpoint.load_open()
        if unfinished is not None and unfinished.first_frame == done:
            done = self._take_over(unfinished)
            self.groups = list(unfinished.groups)
        self.kept_frames = done
        return done

    def _take_over(self, found: Finished) -> int:
        for first, stop, cycle, span in found.blocks.tolist():
            self.blocks.append(Block(first, stop, cycle, span, self.override(self.references[first])))
        self.stack.extend(found.stack)
        self.parts.append(found.part)
        self.shift_px[found.first_frame : found.stop_frame] = found.shift_px
        self.baseline_px = np.array(found.baseline_px)
        self.shaken.update(found.shaken)
        return found.stop_frame

    def _prepare(self, registration: Registration) -> tuple[Camera, Array]:
        """What the workers need of a registration, and the covariance of the place of every cell."""
        # Side by side: the weights are loops over pixels, the others many small steps.
        with ThreadPoolExecutor(1) as executor:
            looks = executor.submit(watch, registration, self.grid, plan_window(registration, self.grid))
            covariance = executor.submit(position_covariance, registration, self.grid)
            camera = Camera(plan_weights(registration, self.grid), looks.result())
        return camera, covariance.result()

    def renew(self, block: Block, result: BlockResult) -> bool:
        """Look for a knock in a block; register anew from its first moved frame and return True, so that the block is cut again."""
        for i, seen in zip(range(block.first, block.stop), result.shift_px, strict=True):
            shift = seen - self.baseline_px
            if np.isnan(seen).any() or np.hypot(*shift) > SUSPECT_PX:
                exact = self._exact_shift(i, block.span)
                if np.hypot(*exact) > KNOCK_PX:
                    if i + 1 == len(self.references) or _alike(self._exact_shift(i + 1, block.span), exact):
                        self._renew_from(i, block.span, exact)
                        return True
                    self.shaken.add(i)
                elif np.isfinite(exact + seen).all():
                    self.baseline_px = seen - exact
                shift = exact
            self.shift_px[i] = np.hypot(*shift)
        return False

    def _exact_shift(self, i: int, span: int) -> Array:
        """Shift by the fiducials, or where they have no contrast by the picture of the table."""
        own = self.spans[span]
        frame = self._temperature(i)
        shift = fiducial_shift(frame, own.registration, self.grid)
        if np.isnan(shift).any() and i != own.first:
            shift = image_shift(self._temperature(own.first), frame, own.registration, self.grid)
        return shift

    def _temperature(self, i: int) -> Array:
        return calibrate(self.references[i].read().counts, self.override(self.references[i]))

    def _renew_from(self, i: int, span: int, shift: Array) -> None:
        later = [
            j
            for j in range(i + 1, min(i + RENEWAL_FRAMES, len(self.references)))
            if self._same_place(j, i, span, shift)
        ]
        frame = np.mean([self._temperature(j) for j in [i, *later]], axis=0, dtype=float)
        old = self.spans[span].registration
        if np.isfinite(fiducial_shift(frame, old, self.grid)).all():
            registration = register_anew(frame, old, shift, self.grid, where=self._name(i))
        else:
            registration = shifted(old, shift)
        if self.checkpoint is not None:
            self.checkpoint.note_knock(i, span, shift.tolist())
        self.spans.insert(span + 1, RegisteredFrom(i, registration, (float(shift[0]), float(shift[1]))))
        camera, covariance = self._prepare(registration)
        self.cameras.insert(span + 1, camera)
        self.covariances.insert(span + 1, covariance)
        self.baseline_px = np.zeros(2)

    def _same_place(self, j: int, i: int, span: int, shift: Array) -> bool:
        following = self.spans[span + 1].first if span + 1 < len(self.spans) else len(self.references)
        return j < following and _alike(self._exact_shift(j, span), shift)

    def gather(self, block: Block, result: BlockResult) -> None:
        """Add a block to the stack and to the cycle that is open; a block of the next cycle or registration closes it."""
        last = self.parts[-1] if self.parts else None
        if last is not None and (last.cycle, last.span) != (block.cycle, block.span):
            self.close()
        offset = float(self.correction_K[block.first : block.stop].mean())
        self.blocks.append(block)
        self.stack.append((result.cells + offset).astype(np.float32))
        if block.cycle == NOT_NUMBERED:
            return
        if last is None or (last.cycle, last.span) != (block.cycle, block.span):
            self.parts.append(CyclePart(block.cycle, block.span))
        temperature = replace(result.temperature, mean=result.temperature.mean + offset)
        self.parts[-1].add(temperature, self.times[block.first : block.stop])
        if result.statistics is not None:
            self._add_sums(Group(block.parameters, result.statistics, offset))
        if self.checkpoint is not None and block.stop - self.kept_frames >= KEPT_FRAMES:
            self._save(self.checkpoint)

    def _add_sums(self, new: Group) -> None:
        for number, group in enumerate(self.groups):
            if group.parameters == new.parameters and group.correction_K == new.correction_K:
                self.groups[number] = replace(group, statistics=group.statistics.merge(new.statistics))
                return
        self.groups.append(new)

    def close(self) -> None:
        """Finish the cycle that is open, if there is one, and write it to the checkpoint."""
        part = self.parts[-1] if self.parts else None
        if part is None or part.pixels is None:
            return
        part.finish(self.cameras[part.span].weights)
        if self.checkpoint is not None:
            self._save(self.checkpoint)
            self.saved_blocks = len(self.blocks)
        self.groups = []

    def _save(self, checkpoint: Checkpoint) -> None:
        blocks = self.blocks[self.saved_blocks :]
        first, stop = blocks[0].first, blocks[-1].stop
        places = np.array([(b.first, b.stop, b.cycle, b.span) for b in blocks])
        stack = np.stack(self.stack[self.saved_blocks :])
        shaken = tuple(sorted(i for i in self.shaken if first <= i < stop))
        shift, baseline = self.shift_px[first:stop], (float(self.baseline_px[0]), float(self.baseline_px[1]))
        groups = tuple(self.groups)
        checkpoint.save(Finished(self.parts[-1], first, stop, places, stack, shift, groups, shaken, baseline))
        self.kept_frames = stop

    def dataset(self, bounds: Array, cycles: Array) -> xr.Dataset:
        """Put everything together."""
        self.close()
        coverages = [camera.weights.coverage for camera in self.cameras]
        blocks = self.blocks
        middles = [self.times[b.first] + (self.times[b.first : b.stop] - self.times[b.first]).mean() for b in blocks]
        knocks = [
            {"frame": self._name(s.first), "index": s.first, "shift_px": list(s.shift_px)} for s in self.spans[1:]
        ]
        texts = {
            "frames_outside_cycles": [self._name(i) for i in np.flatnonzero(cycles == NOT_NUMBERED)],
            "knocks": knocks,
            "frames_shaken": [self._name(i) for i in sorted(self.shaken)],
            "frames_unchecked": [self._name(i) for i in np.flatnonzero(np.isnan(self.shift_px))],
        }
        frames = {
            "frame_temperature": (("time", "y", "x"), np.stack(self.stack)),
            "frame_cycle": ("time", np.array([b.cycle + 1 for b in blocks], np.int32)),
            "frame_count": ("time", np.array([b.stop - b.first for b in blocks], np.int32)),
            "frame_shift": ("time", np.array([_largest(self.shift_px[b.first : b.stop]) for b in blocks], np.float32)),
        }
        fields = assemble(
            self.parts,
            len(bounds),
            self.grid,
            self.covariances,
            coverages,
            frames=frames,
            frame_coordinates={"time": np.array(middles)},
        )
        return fields.assign_attrs({name: json.dumps(value) for name, value in texts.items()})

    def _name(self, i: int) -> str:
        return f"{self.references[i].path.name}#{self.references[i].index}"


def _alike(one: Array, other: Array) -> bool:
    return bool(np.hypot(*one) > KNOCK_PX and np.hypot(*(one - other)) < max(KNOCK_PX, 0.3 * np.hypot(*other)))


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else float("nan")
