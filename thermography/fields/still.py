"""Fields of a still table: one per cycle, and one per frame or short block of frames, on the table plan.

Stretches of frames are reduced in parallel and gathered in order. Every frame is compared with its registration; after a lasting
displacement of camera or table (a knock) the plan is registered again, and the frames from there on are cut into blocks again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from thermography._typing import Array
from thermography.fields.blocks import Block, cut_blocks
from thermography.fields.checkpoint import Checkpoint, ParameterGroup, StoredCycle, describe_reduction
from thermography.fields.cycle_fields import CyclePart, FinishedParts, assemble_fields
from thermography.fields.following import Displacements, Knock, Obstructions, Registrations
from thermography.fields.inputs import NO_CYCLE, FrameSeries, Override, ReductionError, make_frame_series
from thermography.fields.scheduling import Pool, in_order, open_pool
from thermography.fields.tasks.spool import Spool
from thermography.fields.tasks.stretches import (
    Portion,
    PortionResult,
    add_sums,
    choose_frames,
    cut_stretches,
    gather_frames,
    reduce_portion,
    reduce_stretch,
)
from thermography.io.frame import FrameReference
from thermography.registration.displacement import RegistrationSpan, zoom_and_turn
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

#: Consecutive frames of one cycle within this time share one field of the frame stack, s.
BLOCK_S = 10.0
#: The open cycle is stored whenever it has grown by this number of frames: the most that an interrupted run has to repeat.
STORED_FRAMES = 4096


def reduce_frames(
    references: Sequence[FrameReference],
    registration: Registration | Sequence[RegistrationSpan],
    grid: PlanGrid,
    cycle_bounds: ArrayLike,
    *,
    override: Override = lambda frame: frame.parameters,
    correction_K: ArrayLike | None = None,
    block_s: float = BLOCK_S,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a still table to one temperature field per cycle on the table plan.

    Counts are averaged, not temperatures, which is exact to the second order of the calibration curve; where the counts of a pixel
    vary too much for that, its frames are calibrated one by one. The fiducials of every frame are compared with the registration;
    where they have moved and remain so, the plan is registered again from that frame on.

    Parameters
    ----------
    references : sequence of FrameReference
        Frames sorted by time, from `thermography.io.flir.index_frames`.
    registration : Registration, or sequence of RegistrationSpan
        For all frames, or spans of frames in order, the first starting at frame 0.
    grid : PlanGrid
        The plan.
    cycle_bounds : (cycles, 2) or (cycles + 1,) array of datetime64
        Start and end of every cycle, or the edges between cycles, on the frames' clock; the end is excluded.
    override : callable
        From a frame reference to the camera parameters to calibrate the frame with; by default the frame's own.
    correction_K : (frames,) array, K, or None
        Added to the temperature of every frame, to correct artefacts of the camera (NUC/FFC events, drift).
    block_s : float, s
        Frames of one cycle within this time share one field of `frame_temperature`; 0 gives every frame its own.
    scheduler : str or None
        Address of a dask scheduler whose workers see the same files; None for threads on the cores of this machine.
    checkpoint : str, Path or None
        Folder for finished cycles with their sums of counts. A run that finds it resumes there, also within a long cycle;
        `thermography.fields.checkpoint.recalibrate` calibrates the cycles again without the frames.
    progress : callable or None
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        Variables of `thermography.contract.FIELDS` with dimensions (cycle, y, x) in degC and K, coordinates in mm, but for the total
        uncertainties, which `thermography.fields.total_uncertainty.evaluate_uncertainty` adds; further `temperature_rate`,
        `quality_flag`, `position_u`, and as JSON texts the attributes `frames_outside_cycles` (their fields are in the stack),
        `knocks` (frame, shift in px, zoom, turn), `frames_shaken` (displaced alone, left out), `frames_obstructed` (something before
        the table, left out), `frames_unchecked` (too little contrast to locate the fiducials) and `unchecked_stretches` (of such
        frames, after which no frame shows that the registration held).

    Raises
    ------
    ReductionError
        There is no frame, frames differ in size or are out of order, cycles overlap, or no frame lies within any cycle.
    RegistrationError
        The plan is not located any more after a knock.
    CheckpointError
        The checkpoint belongs to another reduction.

    Notes
    -----
    See ``docs/method/fields.md``; the average of counts is derived in `thermography.radiometry.averaging`.
    """
    spans = _check_spans(
        [RegistrationSpan(0, registration)] if isinstance(registration, Registration) else registration
    )
    frames = make_frame_series(
        references, cycle_bounds, shape=spans[0].registration.shape, override=override, correction_K=correction_K
    )
    _check_overlap(frames)
    store = None
    if checkpoint is not None:
        store = Checkpoint(checkpoint, describe_reduction(frames, grid, spans, block_s=block_s))
    reduction = StillReduction(frames, grid, spans, store)
    done = reduction.resume()
    if progress is not None and done:
        progress(done)
    with open_pool(scheduler) as pool:
        while done < len(frames):
            done = _reduce_until_knock(reduction, pool, done, block_s=block_s, progress=progress)
    return reduction.dataset()


def _check_spans(spans: Sequence[RegistrationSpan]) -> list[RegistrationSpan]:
    starts = [span.first_frame for span in spans]
    if not starts or starts[0] != 0 or (np.diff(starts) <= 0).any():
        raise ReductionError(f"registrations start at frames {starts}; they must start at 0 and rise")
    return list(spans)


def _check_overlap(frames: FrameSeries) -> None:
    if (frames.cycles == NO_CYCLE).all():
        raise ReductionError(
            f"no frame lies within a cycle: frames {frames.times[0]} to {frames.times[-1]}, "
            f"cycles {frames.bounds[0, 0]} to {frames.bounds[-1, 1]}; check the time zones and the clock offset"
        )


def _reduce_until_knock(
    reduction: StillReduction, pool: Pool, first: int, *, block_s: float, progress: Callable[[int], None] | None
) -> int:
    """Reduce the frames from `first` on, stretch by stretch, up to the block in which a knock is found; the first frame not reduced."""
    frames, registrations = reduction.frames, reduction.registrations
    blocks = cut_blocks(frames, registrations.spans, block_s=block_s, first=first)
    sensors = [pool.share(sensor) for sensor in registrations.sensors]
    keep_statistics = reduction.checkpoint is not None
    tasks = (
        (stretch, (reduce_stretch, [(gather_frames(frames, p.blocks), p.whole) for p in stretch], sensors[span], keep_statistics))
        for stretch in cut_stretches(blocks, total=len(frames), begun=reduction.cycles.begun)
        for span in [stretch[0].first.span]
    )  # fmt: skip
    with closing(in_order(pool, tasks)) as results:
        for stretch, reduced in results:
            for portion, result in zip(stretch, reduced, strict=True):
                knocked = reduction.gather(portion, result)
                stop = portion.blocks[-1].stop if knocked is None else knocked.first
                if progress is not None and stop > portion.first.first:
                    progress(stop - portion.first.first)
                if knocked is not None:
                    return stop
    return len(frames)


class _FrameStack:
    """Blocks in the order of time, and the field of each, (y, x) degC."""

    def __init__(self, folder: Path | None) -> None:
        self.blocks: list[Block] = []
        self.fields = Spool(folder)

    def variables(self, size_px: Array, kept: Callable[[Block], Array]) -> dict[str, Any]:
        """Variables along ``time``, from the displacement of every frame, (frames,) px, and the frames of each block that are used."""
        shifts = np.array([_largest(size_px[kept(b)]) for b in self.blocks], np.float32)
        return {
            "frame_temperature": (("time", "y", "x"), self.fields.array()),
            "frame_cycle": ("time", np.array([b.cycle + 1 for b in self.blocks], np.int32)),
            "frame_count": ("time", np.array([len(kept(b)) for b in self.blocks], np.int32)),
            "frame_shift": ("time", shifts),
        }


def _largest(values: Array) -> float:
    measured = values[np.isfinite(values)]
    return float(measured.max()) if measured.size else float("nan")


class _Cycles:
    """Finished cycles, and the open one with its sums of counts.

    Attributes
    ----------
    finished : FinishedParts
        In the order of time.
    open : CyclePart or None
        The last one, as long as it has pixels.
    sums : list of ParameterGroup
        Of the open cycle, or of the one that was finished last.
    """

    def __init__(self, folder: Path | None) -> None:
        self.finished = FinishedParts(folder)
        self.open: CyclePart | None = None
        self.sums: list[ParameterGroup] = []

    @property
    def begun(self) -> tuple[int, int] | None:
        """Cycle and registration of the open cycle, if there is one."""
        return None if self.open is None else (self.open.cycle, self.open.span)

    def add(self, part: CyclePart, sums: Sequence[ParameterGroup]) -> None:
        """Add a portion to the open cycle, or begin its cycle; one that is finished already has no other portion."""
        if part.pixels is None:
            self.finished.append(part)
        elif self.open is None:
            self.open = part
        else:
            self.open.join(part)
        for group in sums:
            add_sums(self.sums, group)


class StillReduction:
    """State of a reduction under way: what has been gathered, in the order of time.

    Parameters
    ----------
    frames : FrameSeries
        All frames.
    grid : PlanGrid
        The plan.
    spans : sequence of RegistrationSpan
        As given, before knocks.
    checkpoint : Checkpoint or None
        Where finished cycles are stored.

    Attributes
    ----------
    registrations, displacement, obstructions, stack, cycles
        Registrations including those after knocks; displacement of every frame; frames that do not show the table; blocks with their
        fields; cycles with their sums.
    stored_blocks, stored_frames, finished_frames : int
        Blocks of finished cycles, frames, and frames up to the end of the last finished cycle that the checkpoint holds.
    """

    def __init__(
        self, frames: FrameSeries, grid: PlanGrid, spans: Sequence[RegistrationSpan], checkpoint: Checkpoint | None
    ) -> None:
        self.frames, self.grid, self.checkpoint = frames, grid, checkpoint
        self.registrations = Registrations(spans, grid)
        self.displacement = Displacements(frames, self.registrations)
        self.obstructions = Obstructions(frames, self.registrations)
        folder = None if checkpoint is None else checkpoint.folder
        self.stack = _FrameStack(folder)
        self.cycles = _Cycles(folder)
        self.stored_blocks = 0
        self.stored_frames = 0
        self.finished_frames = 0

    def resume(self) -> int:
        """Load what an earlier run has stored; the first frame that is not done."""
        done = 0
        if self.checkpoint is None:
            return done
        for index, span, displacement_px, by_image in self.checkpoint.knocks():
            self.register_again(Knock(index, span, np.array(displacement_px), by_image))
        for cycle in self.checkpoint.load():
            if cycle.first_frame != done:
                break
            done = self._restore(cycle)
        self.stored_blocks, self.finished_frames = len(self.stack.blocks), done
        unfinished = self.checkpoint.load_open()
        if unfinished is not None and unfinished.first_frame == done:
            done = self._restore(unfinished)
            self.cycles.sums = list(unfinished.groups)
        self.stored_frames = done
        return done

    def _restore(self, cycle: StoredCycle) -> int:
        """Take over a stored cycle; the first frame after it."""
        for first, stop, number, span in cycle.blocks.tolist():
            parameters = self.frames.override(self.frames.references[first])
            self.stack.blocks.append(Block(first, stop, number, span, parameters))
        for field in cycle.stack:
            self.stack.fields.append(field)
        self.cycles.add(cycle.part, ())
        self.displacement.size_px[cycle.first_frame : cycle.stop_frame] = cycle.shift_px
        self.displacement.shaken.update(cycle.shaken)
        self.obstructions.found.update(cycle.obstructed)
        self.displacement.baseline_px = np.array(cycle.baseline_px)
        return cycle.stop_frame

    def register_again(self, knock: Knock) -> None:
        """Register the plan again from the frame of a knock on."""
        span = self.displacement.span_after(knock)
        if self.checkpoint is not None:
            self.checkpoint.save_knock(knock.frame, knock.span, knock.displacement_px.tolist(), knock.by_image)
        self.registrations.insert(knock.span + 1, span)

    def kept(self, block: Block) -> Array:
        """Indices of the frames of a block that show the table where it is registered."""
        left_out = self.left_out
        return np.array([i for i in range(block.first, block.stop) if i not in left_out], int)

    @property
    def left_out(self) -> set[int]:
        """Frames so far that are shaken or obstructed."""
        return self.displacement.shaken | self.obstructions.found

    def gather(self, portion: Portion, result: PortionResult) -> Block | None:
        """Add a portion to the stack and to its cycle, up to the block of a knock, which is returned; the plan is then registered again.

        The first portion of another cycle or registration closes the open cycle. Where frames are left out, the others are read again.
        """
        kept: list[tuple[Block, Array]] = []
        complete, knocked = True, None
        for block, view in zip(portion.blocks, result.views, strict=True):
            knock = self.displacement.find_knock(block, view.displacement_px)
            if knock is not None:
                knocked = block
                break
            self.obstructions.examine(block, view)
            chosen = self.kept(block)
            complete = complete and len(chosen) == block.stop - block.first
            if len(chosen):
                kept.append((block, chosen))
        if kept:
            if knocked is not None or not complete:
                members = [choose_frames(self.frames, block, chosen) for block, chosen in kept]
                sensor, statistics = self.registrations.sensors[portion.first.span], self.checkpoint is not None
                whole = portion.whole and knocked is None
                result = reduce_portion(members, sensor, statistics, whole=whole)
            self._add([block for block, _ in kept], result)
        if knock is not None:
            self.register_again(knock)
        return knocked

    def _add(self, blocks: Sequence[Block], result: PortionResult) -> None:
        """Add blocks and their sums."""
        first = blocks[0]
        if self.cycles.begun not in (None, (first.cycle, first.span)):
            self.close()
        self.stack.blocks.extend(blocks)
        for view in result.views:
            self.stack.fields.append(view.cells)
        if result.part is None:
            return
        self.cycles.add(result.part, result.sums)
        if result.part.pixels is None:
            self._store_finished(result.part)
        elif self.checkpoint is not None and blocks[-1].stop - self.stored_frames >= STORED_FRAMES:
            self._store(self.checkpoint, self.cycles.open or result.part)

    def close(self) -> None:
        """Finish the open cycle, if there is one, and store it."""
        part = self.cycles.open
        if part is not None:
            part.finish(self.registrations.sensors[part.span].weights)
            self.cycles.open = None
            self.cycles.add(part, ())
            self._store_finished(part)

    def _store_finished(self, part: CyclePart) -> None:
        """Store the last cycle, which is finished."""
        if self.checkpoint is not None:
            self._store(self.checkpoint, part)
            self.stored_blocks, self.finished_frames = len(self.stack.blocks), self.stored_frames
        self.cycles.sums = []

    def _store(self, checkpoint: Checkpoint, part: CyclePart) -> None:
        """Store the last cycle, finished or open, with all blocks since the previous one."""
        blocks = self.stack.blocks[self.stored_blocks :]
        first, stop = self.finished_frames, blocks[-1].stop
        column, row, growth, turn = self.displacement.baseline_px.tolist()
        checkpoint.save(
            StoredCycle(
                part=part,
                first_frame=first,
                stop_frame=stop,
                blocks=np.array([(b.first, b.stop, b.cycle, b.span) for b in blocks]),
                stack=np.stack(self.stack.fields[self.stored_blocks :]),
                shift_px=self.displacement.size_px[first:stop],
                groups=tuple(self.cycles.sums),
                shaken=tuple(sorted(i for i in self.displacement.shaken if first <= i < stop)),
                obstructed=tuple(sorted(i for i in self.obstructions.found if first <= i < stop)),
                baseline_px=(column, row, growth, turn),
            )
        )
        self.stored_frames = stop

    def dataset(self) -> xr.Dataset:
        """Finish the open cycle and assemble the fields, the frame stack and the lists of frames with remarks."""
        self.close()
        frames, displacement = self.frames, self.displacement
        left_out = np.isin(np.arange(len(frames)), [*self.left_out])
        if not self.cycles.finished:
            raise ReductionError(
                "no frame within a cycle shows the table where it is registered; check that nothing stands before the table"
            )
        times = np.array([frames.mean_time(self.kept(block)) for block in self.stack.blocks])
        fields = assemble_fields(
            self.cycles.finished,
            len(frames.bounds),
            self.grid,
            self.registrations.covariances,
            [sensor.weights.coverage for sensor in self.registrations.sensors],
            frames=self.stack.variables(displacement.size_px, self.kept),
            frame_coordinates={"time": times},
            folder=None if self.checkpoint is None else self.checkpoint.folder,
        )
        remarks = {
            "frames_outside_cycles": frames.names(frames.cycles == NO_CYCLE),
            "knocks": [self._knock(span, before) for before, span in pairwise(self.registrations.spans)],
            "frames_shaken": [frames.name(i) for i in sorted(displacement.shaken)],
            "frames_obstructed": [frames.name(i) for i in sorted(self.obstructions.found)],
            "frames_unchecked": frames.names(np.isnan(displacement.size_px) & ~left_out),
            "unchecked_stretches": [
                {"first": frames.name(s.first), "last": frames.name(s.stop - 1), "frames": s.stop - s.first}
                for s in displacement.unchecked_stretches(left_out)
            ],
        }
        return fields.assign_attrs({name: json.dumps(value) for name, value in remarks.items()})

    def _knock(self, span: RegistrationSpan, before: RegistrationSpan) -> dict[str, Any]:
        """What is reported of the knock before a registration span."""
        zoom, turn_deg = zoom_and_turn(span.displacement_px, before.registration)
        return {
            "frame": self.frames.name(span.first_frame),
            "index": span.first_frame,
            "shift_px": list(span.displacement_px[:2]),
            "zoom": zoom,
            "turn_deg": turn_deg,
        }
