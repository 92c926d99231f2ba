"""L3 - Frames to temperature fields on the table plan: one per cycle, and one per frame or short block of frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography.blocks import Block, BlockResult, Camera, Override, cut_blocks, reduce_block
from thermography.cycles import NOT_NUMBERED, CyclePart, annotate, assemble, position_covariance
from thermography.flir import FrameReference
from thermography.knocks import KNOCK_PX, SUSPECT_PX, RegisteredFrom, fiducial_shift, register_anew, watch
from thermography.plan import PlanGrid
from thermography.radiometry import calibrate
from thermography.registration import Registration
from thermography.resampling import plan_weights
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
#: Frames whose mean the plan is registered on anew after a knock.
RENEWAL_FRAMES = 8


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
    progress
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        Keeps `thermography.contract.FIELDS`; further `temperature_rate`, `quality_flag`, the registration's `position_u`, and
        as JSON texts the attributes `frames_outside_cycles` (named; their fields are in the stack), `knocks` (frame and shift
        in px), `frames_shaken` (moved for one frame only) and `frames_unchecked` (too little contrast to see the fiducials).

    Raises
    ------
    FieldError
        No frame, frames of different sizes, frames out of order, cycles that overlap, or no frame within any cycle.
    """
    spans = [RegisteredFrom(0, registration)] if isinstance(registration, Registration) else list(registration)
    _check_spans(spans)
    bounds = check_bounds(cycle_bounds)
    times = check_frames(references, spans[0].registration.shape)
    correction = check_correction(correction_K, len(references))
    cycles = cycle_of(times, bounds)
    if (cycles == NOT_NUMBERED).all():
        raise FieldError(
            f"no frame lies within a cycle: frames {times[0]} to {times[-1]}, cycles {bounds[0, 0]} to {bounds[-1, 1]}; "
            "check the time zones and the clock offset"
        )
    run = _Reduction(references, times, correction, grid, spans, override)
    done = 0
    with open_pool(scheduler) as pool:
        while done < len(references):
            blocks = cut_blocks(
                references, times, cycles, run.spans, correction, override=override, block_s=block_s, first=done
            )
            cameras = [pool.share(camera) for camera in run.cameras]
            tasks = ((b, (reduce_block, references[b.first : b.stop], b.parameters, cameras[b.span])) for b in blocks)
            results = in_order(pool, tasks)
            for block, result in results:
                if run.renew(block, result):
                    results.close()
                    break
                run.gather(block, result)
                done = block.stop
                if progress is not None:
                    progress(block.stop - block.first)
    return run.dataset(bounds, cycles)


@dataclass
class _Reduction:
    """What has been gathered so far, in the order of time: the registrations, the open cycle, and the frame stack."""

    references: Sequence[FrameReference]
    times: Array
    correction_K: Array
    grid: PlanGrid
    spans: list[RegisteredFrom]
    override: Override
    cameras: list[Camera] = field(default_factory=list)
    parts: list[CyclePart] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    stack: list[NDArray[np.float32]] = field(default_factory=list)
    shift_px: Array = field(default_factory=lambda: np.empty(0))
    shaken: set[int] = field(default_factory=set)
    baseline_px: Array = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        self.shift_px = np.full(len(self.references), np.nan)
        self.cameras = [self._camera(span.registration) for span in self.spans]

    def _camera(self, registration: Registration) -> Camera:
        weights = plan_weights(registration, self.grid)
        return Camera(weights, watch(registration, self.grid, weights.window))

    def renew(self, block: Block, result: BlockResult) -> bool:
        """Look for a knock in a block; register anew from its first moved frame and return True, so that the block is cut again."""
        for i, seen in zip(range(block.first, block.stop), result.shift_px, strict=True):
            shift = seen - self.baseline_px
            if np.hypot(*shift) > SUSPECT_PX:
                exact = self._exact_shift(i, block.span)
                if np.hypot(*exact) > KNOCK_PX:
                    if i + 1 == len(self.references) or _alike(self._exact_shift(i + 1, block.span), exact):
                        self._renew_from(i, block.span, exact)
                        return True
                    self.shaken.add(i)
                elif np.isfinite(exact).all():
                    self.baseline_px = seen - exact
                shift = exact
            self.shift_px[i] = np.hypot(*shift)
        return False

    def _exact_shift(self, i: int, span: int) -> Array:
        return fiducial_shift(self._temperature(i), self.spans[span].registration, self.grid)

    def _temperature(self, i: int) -> Array:
        return calibrate(self.references[i].read().counts, self.override(self.references[i]))

    def _renew_from(self, i: int, span: int, shift: Array) -> None:
        later = [
            j
            for j in range(i + 1, min(i + RENEWAL_FRAMES, len(self.references)))
            if self._same_place(j, i, span, shift)
        ]
        frame = np.mean([self._temperature(j) for j in [i, *later]], axis=0, dtype=float)
        registration = register_anew(frame, self.spans[span].registration, shift, self.grid, where=self._name(i))
        self.spans.insert(span + 1, RegisteredFrom(i, registration, (float(shift[0]), float(shift[1]))))
        self.cameras.insert(span + 1, self._camera(registration))
        self.baseline_px = np.zeros(2)

    def _same_place(self, j: int, i: int, span: int, shift: Array) -> bool:
        following = self.spans[span + 1].first if span + 1 < len(self.spans) else len(self.references)
        return j < following and _alike(self._exact_shift(j, span), shift)

    def gather(self, block: Block, result: BlockResult) -> None:
        """Add a block to the stack and to the cycle that is open; a block of the next cycle or registration closes it."""
        offset = float(self.correction_K[block.first : block.stop].mean())
        self.blocks.append(block)
        self.stack.append((result.cells + offset).astype(np.float32))
        if block.cycle == NOT_NUMBERED:
            return
        last = self.parts[-1] if self.parts else None
        if last is None or (last.cycle, last.span) != (block.cycle, block.span):
            if last is not None:
                last.finish(self.cameras[last.span].weights)
            self.parts.append(CyclePart(block.cycle, block.span))
        temperature = replace(result.temperature, mean=result.temperature.mean + offset)
        self.parts[-1].add(temperature, self.times[block.first : block.stop])

    def dataset(self, bounds: Array, cycles: Array) -> xr.Dataset:
        """Put everything together."""
        if self.parts:
            self.parts[-1].finish(self.cameras[self.parts[-1].span].weights)
        covariances = [position_covariance(span.registration, self.grid) for span in self.spans]
        coverages = [camera.weights.coverage for camera in self.cameras]
        blocks = self.blocks
        fields = assemble(self.parts, len(bounds), self.grid, covariances, coverages).assign(
            frame_temperature=(("time", "y", "x"), np.stack(self.stack)),
            frame_cycle=("time", np.array([b.cycle + 1 for b in blocks], np.int32)),
            frame_count=("time", np.array([b.stop - b.first for b in blocks], np.int32)),
            frame_shift=("time", np.array([_largest(self.shift_px[b.first : b.stop]) for b in blocks], np.float32)),
        )
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
        fields = annotate(fields.assign_coords(time=np.array(middles)))
        return fields.assign_attrs({name: json.dumps(value) for name, value in texts.items()})

    def _name(self, i: int) -> str:
        return f"{self.references[i].path.name}#{self.references[i].index}"


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


def _check_spans(spans: Sequence[RegisteredFrom]) -> None:
    starts = [span.first for span in spans]
    if not starts or starts[0] != 0 or (np.diff(starts) <= 0).any():
        raise FieldError(f"registrations start at frames {starts}; they must start at 0 and rise")


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


def _alike(one: Array, other: Array) -> bool:
    return bool(np.hypot(*one) > KNOCK_PX and np.hypot(*(one - other)) < max(KNOCK_PX, 0.3 * np.hypot(*other)))


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else float("nan")
