"""Fields of a table that moves through the view: every frame sampled on the plan at the position of the table in that frame."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from thermography._typing import Array
from thermography.fields.blocks import BLOCK_FRAMES, Block, cut_blocks
from thermography.fields.checkpoint import Checkpoint, describe_reduction
from thermography.fields.cycle_fields import CyclePart, assemble_fields, pixel_noise, position_covariance
from thermography.fields.inputs import NO_CYCLE, FrameSeries, Override, ReductionError, make_frame_series
from thermography.fields.moving_sampling import (
    CellSums,
    CellWeights,
    Samples,
    add_frame,
    on_plan,
    sample_points,
    weigh_pixels,
)
from thermography.fields.scheduling import in_order, open_pool
from thermography.fields.still import BLOCK_S
from thermography.fields.tasks.frame_run import FrameRun
from thermography.fields.tasks.stretches import cut_stretches
from thermography.io.frame import CameraParameters, FrameReference
from thermography.io.window_reader import WindowReader
from thermography.radiometry.averaging import CHUNK_FRAMES
from thermography.radiometry.planck import temperature_from_counts
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration
from thermography.registration.tracking import TableTracker, locate_table, make_tracker

#: Frames in which the position of the table is less certain than this are left out of the fields, mm.
_LARGEST_U_MM = 1.0
#: A table whose place differs by no more than this stands, and its frames are sampled alike, mm: the place of one frame is known no better.
_STANDING_MM = 0.02

_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "temperature_spread": {"long_name": "standard deviation of the cell's temperature over the frames of the cycle"},
    "table_position": {
        "long_name": "displacement of the table along the axis since the registered frame, counted like the axis position",
        "units": "mm",
        "ancillary_variables": "table_position_u",
    },
    "table_position_u": {
        "long_name": "standard uncertainty of table_position from the scatter of the fiducials",
        "units": "mm",
    },
    "table_across": {
        "long_name": "displacement of the table across the axis since the registered frame",
        "units": "mm",
    },
    "table_discs": {
        "long_name": "fiducials that locate the table in the frame, 0 where it is not located",
        "units": "1",
    },
    "frame_time": {"standard_name": "time", "long_name": "time of the frame", "units_metadata": "leap_seconds: utc"},
}


def reduce_moving_frames(
    references: Sequence[FrameReference],
    registration: Registration,
    grid: PlanGrid,
    cycle_bounds: ArrayLike,
    *,
    direction: ArrayLike,
    reach_mm: float = 500.0,
    override: Override = lambda frame: frame.parameters,
    correction_K: Array | None = None,
    block_s: float = BLOCK_S,
    scheduler: str | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a moving table to one field per cycle on the plan, which moves with the table.

    The discs of the registration locate the table in every frame; the cells are sampled there, and averaged over the frames of a
    cycle that show them.

    Parameters
    ----------
    references : sequence of FrameReference
        Frames sorted by time.
    registration : Registration
        Of one frame; in all others the plan is displaced in its own plane.
    grid : PlanGrid
        The plan.
    cycle_bounds : (cycles, 2) or (cycles + 1,) array of datetime64
        Start and end of every cycle, or the edges between cycles, on the frames' clock; the end is excluded.
    direction : (2,) array
        Direction (x, y) in which the plan point under a fixed spindle moves over the plan as the axis position grows, as
        ``[plan.axis] direction`` of a campaign: the table itself moves the opposite way.
    reach_mm : float, mm
        Largest displacement of the table either way from the registered frame.
    override : callable
        From a frame reference to the camera parameters to calibrate the frame with; by default the frame's own.
    correction_K : (frames,) ndarray, K, or None
        Added to the temperature of every frame.
    block_s : float, s
        Frames of one cycle within this time share one field of `frame_temperature`; 0 gives every frame its own.
    scheduler : str or None
        Address of a dask scheduler whose workers see the same files; None for threads on the cores of this machine.
    checkpoint : str, Path or None
        Folder to which blocks are written as they are done; a run that finds it resumes at the first block that is missing.
    progress : callable or None
        Called with the number of frames done since the last call.

    Returns
    -------
    xr.Dataset
        As `thermography.fields.still.reduce_frames`, `temperature_spread` being that of the cell over its frames. Further, per frame
        along ``frame_time``: ``table_position`` (mm, along the axis since the registered frame), ``table_position_u``,
        ``table_across``, ``table_discs``; and the attribute ``frames_unplaced`` with the frames in which the table was not located.

    Raises
    ------
    ReductionError
        As `reduce_frames`, and where the table is located in no frame or in no frame of a cycle.
    CheckpointError
        The checkpoint belongs to another reduction.

    Notes
    -----
    See ``docs/method/fields.md``.
    """
    axis = np.asarray(direction, float) / np.hypot(*np.asarray(direction, float))
    frames = make_frame_series(
        references, cycle_bounds, shape=registration.shape, override=override, correction_K=correction_K
    )
    spans = [RegistrationSpan(0, registration)]
    blocks = cut_blocks(frames, spans, block_s=block_s)
    store = None
    if checkpoint is not None:
        description = describe_reduction(frames, grid, spans, block_s=block_s)
        store = _BlockStore(Checkpoint(checkpoint, {**description, "axis": axis.tolist(), "reach_mm": reach_mm}))
    tracker = make_tracker(registration, grid, -axis, reach_mm=reach_mm)
    samples = sample_points(registration, grid)
    results = _reduce_blocks(blocks, frames, (tracker, samples), store, scheduler=scheduler, progress=progress)
    return _assemble(frames, blocks, results, samples, registration, grid, axis)


@dataclass(frozen=True)
class _BlockResult:
    """The reduction of one block: mean and squared deviation of every cell, and the position of the table in every frame.

    Attributes
    ----------
    count, mean, squares : (cells,) ndarray
        As `thermography.fields.moving_sampling.CellSums`.
    shift_mm : (frames, 2) ndarray, mm
        Displacement (x, y) of the table; NaN where it is not located.
    u_mm : (frames,) ndarray, mm
        Its standard uncertainty.
    discs : (frames,) ndarray of int
        Discs used, 0 where the table is not located.
    """

    count: Array
    mean: Array
    squares: Array
    shift_mm: Array
    u_mm: Array
    discs: Array


_PER_CELL = ("count", "mean", "squares")
_PER_FRAME = ("shift_mm", "u_mm", "discs")


class _BlockStore:
    """Results of finished blocks on disk, some hundreds of frames per file."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self.saved = 0

    def load(self, blocks: Sequence[Block]) -> list[_BlockResult]:
        """Return the results of an earlier run, from the first block on."""
        results: list[_BlockResult] = []
        for header, arrays in self.checkpoint.load_arrays():
            if header["first_block"] != len(results):
                break
            stored = blocks[len(results) : len(results) + header["blocks"]]
            ends = np.cumsum([block.stop - block.first for block in stored])
            per_frame = [np.split(arrays[name], ends[:-1]) for name in _PER_FRAME]
            per_cell = [arrays[name] for name in _PER_CELL]
            results += [_BlockResult(*values) for values in zip(*per_cell, *per_frame, strict=True)]
        self.saved = len(results)
        return results

    def save(self, blocks: Sequence[Block], results: Sequence[_BlockResult]) -> None:
        """Write the results that are not stored yet, if they are enough for a file or the last ones."""
        first, stop = blocks[self.saved].first, blocks[len(results) - 1].stop
        if stop - first < BLOCK_FRAMES and len(results) < len(blocks):
            return
        new = results[self.saved :]
        arrays = {name: np.stack([getattr(result, name) for result in new]) for name in _PER_CELL}
        arrays |= {name: np.concatenate([getattr(result, name) for result in new]) for name in _PER_FRAME}
        self.checkpoint.save_arrays(self.saved, {"first_block": self.saved, "blocks": len(new)}, arrays)
        self.saved = len(results)


def _reduce_blocks(
    blocks: Sequence[Block],
    frames: FrameSeries,
    prepared: tuple[TableTracker, Samples],
    store: _BlockStore | None,
    *,
    scheduler: str | None,
    progress: Callable[[int], None] | None,
) -> list[_BlockResult]:
    """Results of all blocks, those that are not stored computed by the pool."""
    results = store.load(blocks) if store is not None else []
    if progress is not None and results:
        progress(blocks[len(results) - 1].stop)
    left = blocks[len(results) :]
    with open_pool(scheduler) as pool:
        shared = pool.share(prepared)
        stretches = (
            [block for portion in stretch for block in portion.blocks]
            for stretch in cut_stretches(left, total=len(frames))
        )
        tasks = ((stretch, (_reduce_stretch, _with_corrections(frames, stretch), shared)) for stretch in stretches)
        for stretch, reduced in in_order(pool, tasks):
            for block, result in zip(stretch, reduced, strict=True):
                results.append(result)
                if store is not None:
                    store.save(blocks, results)
                if progress is not None:
                    progress(block.stop - block.first)
    return results


def _with_corrections(frames: FrameSeries, stretch: Sequence[Block]) -> list[tuple[FrameRun, CameraParameters, Array]]:
    """Frames of every block with its camera parameters and corrections."""
    return [
        (FrameRun(frames.references[b.first : b.stop]), b.parameters, frames.correction_K[b.first : b.stop])
        for b in stretch
    ]


def _reduce_stretch(
    members: Sequence[tuple[FrameRun, CameraParameters, Array]], prepared: tuple[TableTracker, Samples]
) -> list[_BlockResult]:
    """Reduce the blocks of a stretch: the task of a thread or of a worker."""
    return [_reduce_block(run, parameters, prepared, correction_K) for run, parameters, correction_K in members]


def _reduce_block(
    frames: FrameRun,
    parameters: CameraParameters,
    prepared: tuple[TableTracker, Samples],
    correction_K: Array,
) -> _BlockResult:
    """Locate the table in every frame of a block and add the frame to the cells."""
    tracker, samples = prepared
    rows, columns = tracker.registration.shape
    calibration = temperature_from_counts(np.arange(65536.0), parameters)
    cells = len(samples.valid)
    sums = CellSums(np.zeros(cells, np.int64), np.zeros(cells), np.zeros(cells))
    shift_mm, u_mm = np.full((len(frames), 2), np.nan), np.full(len(frames), np.nan)
    discs = np.zeros(len(frames), np.int64)
    previous = None
    sampling = _Sampling(tracker, samples)
    with WindowReader((slice(0, rows), slice(0, columns))) as reader:
        for start, chunk in zip(
            range(0, len(frames), CHUNK_FRAMES), reader.read_in_chunks(frames, CHUNK_FRAMES), strict=True
        ):
            for i, counts in enumerate(chunk, start):
                position = locate_table(counts, tracker, previous)
                previous = None if position is None else position.shift_mm
                if position is None:
                    continue
                shift_mm[i], u_mm[i], discs[i] = position.shift_mm, position.u_mm, position.discs
                if position.u_mm <= _LARGEST_U_MM:
                    add_frame(counts, calibration, sampling.at(position.shift_mm), float(correction_K[i]), sums)
    return _BlockResult(*sums, shift_mm, u_mm, discs)


class _Sampling:
    """Weights of the pixels where the table stands, computed again when it has moved."""

    def __init__(self, tracker: TableTracker, samples: Samples) -> None:
        self.tracker, self.samples = tracker, samples
        self.shift_mm = np.full(2, np.nan)

    def at(self, shift_mm: Array) -> CellWeights:
        """Weights for a displacement (x, y) of the table, mm."""
        if not np.hypot(*(shift_mm - self.shift_mm)) <= _STANDING_MM:
            points, valid, shape = self.samples.points_mm, self.samples.valid, self.tracker.registration.shape
            self.shift_mm, self.weights = shift_mm, weigh_pixels(points, valid, shift_mm, self.tracker.lens, shape)
        return self.weights


def _assemble(
    frames: FrameSeries,
    blocks: Sequence[Block],
    results: Sequence[_BlockResult],
    samples: Samples,
    registration: Registration,
    grid: PlanGrid,
    axis: Array,
) -> xr.Dataset:
    """Fields per cycle, the frame stack, and the positions of the table, as one Dataset."""
    discs = np.concatenate([result.discs for result in results])
    if not discs.any():
        raise ReductionError(
            "the table is found in no frame; check the fiducials, and [plan.axis] direction, along which it is looked for"
        )
    parts = _cycle_parts(frames, blocks, results, samples, grid)
    if not parts:
        times, bounds = frames.times, frames.bounds
        raise ReductionError(
            f"no frame in which the table is found lies within a cycle: frames {times[0]} to {times[-1]}, "
            f"cycles {bounds[0, 0]} to {bounds[-1, 1]}; check the time zones and the clock offset"
        )
    block_times = np.array([frames.mean_time(slice(block.first, block.stop)) for block in blocks])
    fields = assemble_fields(
        parts,
        len(frames.bounds),
        grid,
        [position_covariance(registration, grid)],
        [samples.coverage],
        frames=_frame_variables(blocks, results, axis, samples, grid),
        frame_coordinates={"time": block_times, "frame_time": frames.times},
    )
    for name, attributes in _ATTRIBUTES.items():
        fields[name].attrs.update(attributes)
    return fields.assign_attrs(
        frames_outside_cycles=json.dumps(frames.names(frames.cycles == NO_CYCLE)),
        frames_unplaced=json.dumps(frames.names(discs == 0)),
    )


def _cycle_parts(
    frames: FrameSeries, blocks: Sequence[Block], results: Sequence[_BlockResult], samples: Samples, grid: PlanGrid
) -> list[CyclePart]:
    """Every cycle in which the table is located, finished."""
    parts = []
    for cycle in sorted({block.cycle for block in blocks} - {NO_CYCLE}):
        of_cycle = [(block, result) for block, result in zip(blocks, results, strict=True) if block.cycle == cycle]
        located = np.concatenate([np.arange(b.first, b.stop)[result.discs > 0] for b, result in of_cycle])
        if not located.size:
            continue
        times = frames.times[located]
        part = CyclePart(cycle, 0, frames=int(located.size), first_time=times[0])
        part.seconds = float(((times - times[0]) / np.timedelta64(1, "ns")).sum()) / 1e9
        count, mean, squares = _merge([result for _, result in of_cycle])
        part.mean = on_plan(count, mean, samples, grid)
        seen = np.isfinite(part.mean)
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt(np.where(count > 1, squares / (count - 1), np.nan))
        part.spread = np.where(seen, spread.reshape(grid.shape), np.nan)
        part.noise_variance = np.where(seen, pixel_noise(part.mean, seen) ** 2, np.nan)
        part.fell_back = np.zeros(grid.shape, bool)
        part.count = np.where(seen, count.reshape(grid.shape), 0).astype(np.int32)
        parts.append(part)
    return parts


def _merge(results: Sequence[_BlockResult]) -> tuple[Array, Array, Array]:
    """Count, mean and squared deviation over several blocks (T. F. Chan et al., The American Statistician 37 (1983) 242-247)."""
    first = results[0]
    count, mean, squares = (np.array(values, float) for values in (first.count, first.mean, first.squares))
    for other in results[1:]:
        total = count + other.count
        share = np.divide(other.count, total, out=np.zeros_like(mean), where=total > 0)
        step = other.mean - mean
        squares += other.squares + step**2 * share * count
        mean += step * share
        count = total
    return count, mean, squares


def _frame_variables(
    blocks: Sequence[Block], results: Sequence[_BlockResult], axis: Array, samples: Samples, grid: PlanGrid
) -> dict[str, Any]:
    """The frame stack and the positions of the table, as xarray takes them."""
    shift = np.concatenate([result.shift_mm for result in results])
    stack = np.stack([on_plan(result.count, result.mean, samples, grid) for result in results]).astype(np.float32)
    return {
        "frame_temperature": (("time", "y", "x"), stack),
        "frame_cycle": ("time", np.array([block.cycle + 1 for block in blocks], np.int32)),
        "frame_count": ("time", np.array([block.stop - block.first for block in blocks], np.int32)),
        # The table moves opposite to the point under the spindle.
        "table_position": ("frame_time", -(shift @ axis)),
        "table_position_u": ("frame_time", np.concatenate([result.u_mm for result in results])),
        "table_across": ("frame_time", shift @ np.array([-axis[1], axis[0]])),
        "table_discs": ("frame_time", np.concatenate([result.discs for result in results]).astype(np.int32)),
    }
