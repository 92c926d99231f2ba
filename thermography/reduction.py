"""L3 - A reduction under way: registrations, the cycle that is open, the frame stack, and what a broken run had finished."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from thermography.blocks import Block, BlockResult, Camera, Override
from thermography.checkpoint import Checkpoint, Finished, Group
from thermography.cycles import NOT_NUMBERED, CyclePart, assemble, position_covariance
from thermography.flir import FrameReference
from thermography.knocks import KNOCK_PX, SUSPECT_PX, RegisteredFrom, fiducial_shift, register_anew, watch
from thermography.plan import PlanGrid
from thermography.radiometry import calibrate
from thermography.refinement import image_shift, shifted
from thermography.registration import Registration
from thermography.resampling import plan_weights, plan_window

Array = NDArray[Any]

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
