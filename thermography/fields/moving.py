"""Fields of a table that moves through the view: every frame laid on the plan where its own discs put it."""

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
from thermography.fields.blocks import BLOCK_FRAMES, Block, Override, cut_blocks
from thermography.fields.checkpoint import Checkpoint, describe
from thermography.fields.cycle_fields import NOT_NUMBERED, CyclePart, assemble, pixel_noise, position_covariance
from thermography.fields.moving_sampling import Samples, add_frame, on_plan, sample_points
from thermography.fields.scheduling import in_order, open_pool
from thermography.fields.still import BLOCK_S, FieldError, check_bounds, check_correction, check_frames, cycle_of
from thermography.io.flir import FrameReference
from thermography.io.frame import CameraParameters
from thermography.io.window_reader import WindowReader
from thermography.radiometry.averaging import CHUNK_FRAMES
from thermography.radiometry.planck import temperature_from_counts
from thermography.registration.displacement import RegisteredFrom
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration
from thermography.registration.tracking import Tracker, locate_table, make_tracker

#: Frames whose table is known no better than this take no part in the fields, mm.
LARGEST_U_MM = 1.0

MOVING_ATTRIBUTES: dict[str, dict[str, Any]] = {
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
    "table_discs": {"long_name": "fiducials that place the table in the frame, 0 where it is not found", "units": "1"},
    "frame_time": {"standard_name": "time", "long_name": "time of the frame", "units_metadata": "leap_seconds: utc"},
}


@dataclass(frozen=True)
class MovingResult:
    """What a block of frames adds to every cell: frames, mean and squared deviation; and where the table was in each frame."""

    count: Array
    mean: Array
    squares: Array
    shift_mm: Array
    u_mm: Array
    discs: Array


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
    """Reduce frames of a moving table to one field per cycle on the plan, which stays attached to the table.

    Parameters
    ----------
    references, grid, cycle_bounds, override, correction_K, block_s, scheduler, progress
        As for `thermography.fields.still.reduce_frames`.
    checkpoint
        Folder to which the blocks are written as they are done. A run that finds the folder goes on at the first block that is not.
    registration
        Of one frame; the plan lies in that frame as registered, in all others displaced in its own plane.
    direction
        How the plan point under a fixed spindle moves over the plan as the axis position grows, as in ``[plan.axis]``: the table
        itself moves the other way.
    reach_mm
        Longest displacement either way from the registered frame.

    Returns
    -------
    xr.Dataset
        As `reduce_frames`; `temperature_spread` is that of the cell over its frames. Further, per frame along ``frame_time``:
        ``table_position`` (mm, along the axis since the registered frame), ``table_position_u``, ``table_across``,
        ``table_discs``; and the attribute ``frames_unplaced``, which names the frames in which the table was not found.

    Raises
    ------
    FieldError
        As `reduce_frames`, and where the table is found in no frame.
    CheckpointError
        The checkpoint belongs to another reduction.
    """
    axis = np.asarray(direction, float) / np.hypot(*np.asarray(direction, float))
    bounds = check_bounds(np.asarray(cycle_bounds))
    times = check_frames(references, registration.shape)
    correction = check_correction(correction_K, len(references))
    cycles = cycle_of(times, bounds)
    spans = [RegisteredFrom(0, registration)]
    blocks = cut_blocks(references, times, cycles, spans, correction, override=override, block_s=block_s)
    kept = None
    if checkpoint is not None:
        parameters = [override(frame) for frame in references]
        described = describe(references, parameters, correction, bounds, grid, spans, block_s)
        kept = _Kept(Checkpoint(checkpoint, {**described, "axis": axis.tolist(), "reach_mm": reach_mm}))
    tracker = make_tracker(registration, grid, -axis, reach_mm=reach_mm)
    samples = sample_points(registration, grid)
    results = _reduce(blocks, references, correction, (tracker, samples), kept, scheduler=scheduler, progress=progress)
    return _together(blocks, results, references, times, cycles, bounds, axis, samples, registration, grid)


def _together(
    blocks: Sequence[Block], results: Sequence[MovingResult], references: Sequence[FrameReference], times: Array, cycles: Array,
    bounds: Array, axis: Array, samples: Samples, registration: Registration, grid: PlanGrid,
) -> xr.Dataset:  # fmt: skip
    """Put the blocks together to one field per cycle and the places of the table."""
    discs = np.concatenate([result.discs for result in results])
    if not discs.any():
        raise FieldError(
            "the table is found in no frame; check the fiducials, and [plan.axis] direction, along which it is looked for"
        )
    parts = _cycle_parts(blocks, results, times, samples, grid)
    if not parts:
        raise FieldError(
            f"no frame in which the table is found lies within a cycle: frames {times[0]} to {times[-1]}, "
            f"cycles {bounds[0, 0]} to {bounds[-1, 1]}; check the time zones and the clock offset"
        )
    frames = _frame_variables(blocks, results, axis, samples, grid)
    middles = [times[b.first] + (times[b.first : b.stop] - times[b.first]).mean() for b in blocks]
    fields = assemble(
        parts,
        len(bounds),
        grid,
        [position_covariance(registration, grid)],
        [samples.coverage],
        frames=frames,
        frame_coordinates={"time": np.array(middles), "frame_time": times},
    )
    for name, attributes in MOVING_ATTRIBUTES.items():
        fields[name].attrs.update(attributes)

    def named(chosen: Array) -> str:
        return json.dumps([f"{references[i].path.name}#{references[i].index}" for i in np.flatnonzero(chosen)])

    return fields.assign_attrs(frames_outside_cycles=named(cycles == NOT_NUMBERED), frames_unplaced=named(discs == 0))


def _reduce(
    blocks: Sequence[Block],
    references: Sequence[FrameReference],
    correction: Array,
    shared: tuple[Tracker, Samples],
    kept: _Kept | None,
    *,
    scheduler: str | None,
    progress: Callable[[int], None] | None,
) -> list[MovingResult]:
    """Send the blocks that are not done through the pool."""
    results = kept.load(blocks) if kept is not None else []
    if progress is not None and results:
        progress(blocks[len(results) - 1].stop)
    with open_pool(scheduler) as pool:
        known = pool.share(shared)
        tasks = (
            (b, (_reduce_shared, references[b.first : b.stop], b.parameters, known, correction[b.first : b.stop]))
            for b in blocks[len(results) :]
        )
        for block, result in in_order(pool, tasks):
            results.append(result)
            if kept is not None:
                kept.save(blocks, results)
            if progress is not None:
                progress(block.stop - block.first)
    return results


_PER_CELL = ("count", "mean", "squares")
_PER_FRAME = ("shift_mm", "u_mm", "discs")


class _Kept:
    """Blocks that are done, on disk: some hundreds of frames per file."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self.saved = 0

    def load(self, blocks: Sequence[Block]) -> list[MovingResult]:
        """Return what an earlier run has done, from the first block on."""
        results: list[MovingResult] = []
        for header, arrays in self.checkpoint.load_arrays():
            if header["first_block"] != len(results):
                break
            ends = np.cumsum(
                [blocks[len(results) + i].stop - blocks[len(results) + i].first for i in range(header["blocks"])]
            )
            frames = [np.split(arrays[name], ends[:-1]) for name in _PER_FRAME]
            results += [
                MovingResult(*values) for values in zip(*(arrays[name] for name in _PER_CELL), *frames, strict=True)
            ]
        self.saved = len(results)
        return results

    def save(self, blocks: Sequence[Block], results: Sequence[MovingResult]) -> None:
        """Write the blocks that are done and not written yet, if they are enough for a file or the last."""
        first, stop = blocks[self.saved].first, blocks[len(results) - 1].stop
        if stop - first < BLOCK_FRAMES and len(results) < len(blocks):
            return
        new = results[self.saved :]
        arrays = {name: np.stack([getattr(one, name) for one in new]) for name in _PER_CELL}
        arrays |= {name: np.concatenate([getattr(one, name) for one in new]) for name in _PER_FRAME}
        self.checkpoint.save_arrays(self.saved, {"first_block": self.saved, "blocks": len(new)}, arrays)
        self.saved = len(results)


def _reduce_shared(
    frames: Sequence[FrameReference], parameters: CameraParameters, shared: Any, correction_K: Array
) -> MovingResult:
    tracker, samples = shared
    return reduce_moving_block(frames, parameters, tracker, samples, correction_K)


def reduce_moving_block(
    frames: Sequence[FrameReference],
    parameters: CameraParameters,
    tracker: Tracker,
    samples: Samples,
    correction_K: Array,
) -> MovingResult:
    """Place the table in every frame of a block and add its temperature to the cells."""
    rows, columns = tracker.registration.shape
    window = (slice(0, rows), slice(0, columns))
    buffer = np.empty((min(CHUNK_FRAMES, len(frames)), rows, columns), np.uint16)
    table = temperature_from_counts(np.arange(65536.0), parameters)
    cells = len(samples.valid)
    result = MovingResult(
        np.zeros(cells, np.int64), np.zeros(cells), np.zeros(cells), np.full((len(frames), 2), np.nan), np.full(len(frames), np.nan),
        np.zeros(len(frames), np.int64),
    )  # fmt: skip
    near = None
    with WindowReader(window) as reader:
        for start in range(0, len(frames), CHUNK_FRAMES):
            for i, frame in enumerate(reader.read(frames[start : start + CHUNK_FRAMES], buffer), start):
                place = locate_table(frame, tracker, near)
                near = None if place is None else place.shift_mm
                if place is None:
                    continue
                result.shift_mm[i], result.u_mm[i], result.discs[i] = place.shift_mm, place.u_mm, place.discs
                if place.u_mm <= LARGEST_U_MM:
                    add_frame(
                        frame, table, samples.points_mm, samples.valid, place.shift_mm, tracker.lens, float(correction_K[i]),
                        result.count, result.mean, result.squares,
                    )  # fmt: skip
    return result


def _merge(results: Sequence[MovingResult]) -> tuple[Array, Array, Array]:
    """Count, mean and squared deviation of several blocks together."""
    count, mean, squares = (
        np.array(values, float) for values in (results[0].count, results[0].mean, results[0].squares)
    )
    for other in results[1:]:
        total = count + other.count
        part = np.divide(other.count, total, out=np.zeros_like(mean), where=total > 0)
        step = other.mean - mean
        squares += other.squares + step**2 * part * count
        mean += step * part
        count = total
    return count, mean, squares


def _cycle_parts(
    blocks: Sequence[Block], results: Sequence[MovingResult], times: Array, samples: Samples, grid: PlanGrid
) -> list[CyclePart]:
    parts = []
    for cycle in sorted({block.cycle for block in blocks} - {NOT_NUMBERED}):
        own = [(block, result) for block, result in zip(blocks, results, strict=True) if block.cycle == cycle]
        placed = np.concatenate([np.arange(b.first, b.stop)[r.discs > 0] for b, r in own])
        if not placed.size:
            continue
        count, mean, squares = _merge([result for _, result in own])
        part = CyclePart(cycle, 0, frames=int(placed.size), first_time=times[placed[0]])
        part.seconds = float(((times[placed] - times[placed[0]]) / np.timedelta64(1, "ns")).sum()) / 1e9
        part.mean = on_plan(count, mean, samples, grid)
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt(np.where(count > 1, squares / (count - 1), np.nan))
        part.spread = np.where(np.isfinite(part.mean), spread.reshape(grid.shape), np.nan)
        noise = pixel_noise(part.mean, np.isfinite(part.mean))
        part.noise_variance = np.where(np.isfinite(part.mean), noise**2, np.nan)
        part.fell_back = np.zeros(grid.shape, bool)
        part.count = np.where(np.isfinite(part.mean), count.reshape(grid.shape), 0).astype(np.int32)
        parts.append(part)
    return parts


def _frame_variables(
    blocks: Sequence[Block], results: Sequence[MovingResult], axis: Array, samples: Samples, grid: PlanGrid
) -> dict[str, Any]:
    """Return the frame stack and the places of the table."""
    shift = np.concatenate([result.shift_mm for result in results])
    stack = np.stack([on_plan(result.count, result.mean, samples, grid) for result in results]).astype(np.float32)
    return {
        "frame_temperature": (("time", "y", "x"), stack),
        "frame_cycle": ("time", np.array([b.cycle + 1 for b in blocks], np.int32)),
        "frame_count": ("time", np.array([b.stop - b.first for b in blocks], np.int32)),
        # The table goes one way as the point under the spindle goes the other.
        "table_position": ("frame_time", -(shift @ axis)),
        "table_position_u": ("frame_time", np.concatenate([result.u_mm for result in results])),
        "table_across": ("frame_time", shift @ np.array([-axis[1], axis[0]])),
        "table_discs": ("frame_time", np.concatenate([result.discs for result in results]).astype(np.int32)),
    }
