"""Fields of a table that moves through the view: every frame sampled on the plan at the position of the table in that frame."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from thermofuse.compiled import njit
from thermofuse.resources import variables
from thermography.common import Array
from thermography.fields.blocks import (
    NO_CYCLE,
    Block,
    FrameSeries,
    Override,
    ReductionError,
    cut_blocks,
    make_frame_series,
)
from thermography.fields.cycle_fields import CyclePart, assemble_fields, pixel_noise
from thermography.fields.resampling import LEAST_COVERAGE, centring_matrix
from thermography.fields.scheduling import in_order, open_pool
from thermography.fields.still import BLOCK_S, BlockFrames, Checkpoint, cut_stretches, describe_reduction, gather_frames
from thermography.io.frame import FrameReference
from thermography.io.sequence import WindowReader
from thermography.radiometry.averaging import CHUNK_FRAMES
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import temperature_from_counts
from thermography.registration.displacement import RegistrationSpan
from thermography.registration.plan import PlanGrid, mask_discs
from thermography.registration.projection import project_point
from thermography.registration.register import Registration
from thermography.registration.tracking import TableTracker, locate_table, make_tracker

# Sampling of a plan that moves through the view: points of every cell, and the addition of one frame to all cells
# that it shows.

#: Points per cell and side, each interpolated between four pixels.
_POINTS_PER_SIDE = 4
#: Range of the counts within a cell up to which they are averaged before they are calibrated: the temperature of the mean count
#: differs from the mean temperature by a few hundredths of a millikelvin.
_NARROW_COUNTS = 600


@dataclass(frozen=True)
class Samples:
    """Points of every cell at which the frames are sampled, (cells, points, 2) mm; which are valid, away from fiducials and the plan's
    edge, their share of every cell (y, x), and what moves cells with masked points to their centre.
    """

    points_mm: Array
    valid: NDArray[np.bool_]
    coverage: Array
    centring: scipy.sparse.csr_array
    grid: PlanGrid


class CellSums(NamedTuple):
    """Number of frames, mean, degC, and squared deviation from it, K2, of every cell over the frames that show it, (cells,) each, changed
    in place.
    """

    frames: Array
    mean: Array
    squares: Array


def sample_points(registration: Registration, grid: PlanGrid) -> Samples:
    """Lay out the sample points of every cell."""
    steps = ((np.arange(_POINTS_PER_SIDE) + 0.5) / _POINTS_PER_SIDE - 0.5) * grid.cell_size_mm
    across, down = (side.ravel() for side in np.meshgrid(steps, steps))
    centres = grid.centres_mm.reshape(-1, 2)
    points = np.stack([centres[:, :1] + across, centres[:, 1:] + down], axis=-1)
    # The longer side of a pixel on the plan, by the inverse in closed form: a solver called for every point takes twenty times as long.
    (a, b), (c, d) = np.moveaxis(registration.projection.jacobian(points.reshape(-1, 2)), 0, -1)
    pixel_mm = (np.sqrt(np.maximum(a * a + b * b, c * c + d * d)) / np.abs(a * d - b * c)).reshape(points.shape[:2])
    edge = np.minimum.reduce(
        [points[..., 0], grid.width_mm - points[..., 0], points[..., 1], grid.height_mm - points[..., 1]]
    )
    # Interpolation between pixels reaches half a pixel farther than the lens's blur.
    margin = (registration.margin_px + 0.5) * pixel_mm
    valid = (edge >= margin) & ~mask_discs(points, registration.masked, margin_mm=margin)
    with np.errstate(invalid="ignore"):
        offset = np.where(valid[..., None], points, 0.0).sum(axis=1) / valid.sum(axis=1)[:, None]
    offset -= centres
    coverage = valid.mean(axis=1).reshape(grid.shape)
    return Samples(points, valid, coverage, centring_matrix(offset, coverage, grid), grid)


class CellWeights(NamedTuple):
    """Weights of the pixels in the mean of every cell, for one place of the table, cell by cell and row by row; `windows` (cells, 5) are
    first column and row, columns and rows of a cell's pixels, no columns where a point is out of view, and the place of its first
    weight.
    """

    windows: Array
    weights: Array


@njit(nogil=True)
def weigh_pixels(points: Array, valid: Array, shift: Array, lens: Array, shape: tuple[int, int]) -> CellWeights:
    """Weigh the pixels around the points of every cell, each of which is interpolated between four pixels (bilinear)."""
    places, windows, pixels = _place_points(points, valid, shift, lens, shape)
    weights = np.zeros(pixels)
    one = np.uint64(1)
    for cell in range(len(points)):
        left, top, columns, first = windows[cell, 0], windows[cell, 1], windows[cell, 2], windows[cell, 4]
        if columns == 0:
            continue
        used = 0
        for k in range(valid.shape[1]):
            used += valid[cell, k]
        for k in range(valid.shape[1]):
            if valid[cell, k]:
                column, row = places[cell, k, 0], places[cell, k, 1]
                j, i = np.uint64(int(column)), np.uint64(int(row))
                u, v = column - j, row - i
                upper = first + (i - top) * columns + (j - left)
                lower = upper + columns
                below = v / used
                above = 1 / used - below
                weights[upper] += above - u * above
                weights[upper + one] += u * above
                weights[lower] += below - u * below
                weights[lower + one] += u * below
    return CellWeights(windows, weights)


@njit(nogil=True)
def _place_points(
    points: Array, valid: Array, shift: Array, lens: Array, shape: tuple[int, int]
) -> tuple[Array, Array, int]:
    """Columns and rows of all points, (cells, points, 2) px; the windows of the cells, as `CellWeights`; the pixels of all windows."""
    places = np.empty(points.shape)
    # Unsigned: negative indices would be counted from the end, and looking for them costs as much as the sums themselves.
    windows = np.zeros((len(points), 5), np.uint64)
    pixels = 0
    for cell in range(len(points)):
        # An affine map about the middle one of the cell's points is exact to a thousandth of a pixel for cells of 5 mm.
        x_mm, y_mm = points[cell, points.shape[1] // 2]
        column_0, row_0 = project_point(x_mm + shift[0], y_mm + shift[1], lens)
        column_x, row_x = project_point(x_mm + shift[0] + 1.0, y_mm + shift[1], lens)
        column_y, row_y = project_point(x_mm + shift[0], y_mm + shift[1] + 1.0, lens)
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for k in range(points.shape[1]):
            x, y = points[cell, k, 0] - x_mm, points[cell, k, 1] - y_mm
            column = column_0 + x * (column_x - column_0) + y * (column_y - column_0)
            row = row_0 + x * (row_x - row_0) + y * (row_y - row_0)
            places[cell, k, 0], places[cell, k, 1] = column, row
            if valid[cell, k]:
                left, right, top, bottom = min(left, column), max(right, column), min(top, row), max(bottom, row)
        if 0 <= left <= right < shape[1] - 1 and 0 <= top <= bottom < shape[0] - 1:
            columns, rows = int(right) - int(left) + 2, int(bottom) - int(top) + 2
            windows[cell, 0], windows[cell, 1], windows[cell, 2] = int(left), int(top), columns
            windows[cell, 3], windows[cell, 4] = rows, pixels
            pixels += columns * rows
    return places, windows, pixels


@njit(nogil=True)
def add_frame(counts: Array, calibration: Array, sampling: CellWeights, correction: float, sums: CellSums) -> None:
    """Average one frame over every cell that it shows, and add it to the sums."""
    frames, mean, squares = sums
    windows, weights = sampling
    temperatures = np.empty(len(windows))
    for cell in range(len(windows)):
        if windows[cell, 2] > 0:
            temperatures[cell] = _temperature_of_mean(counts, windows[cell], weights, calibration)
    for cell in range(len(windows)):
        if windows[cell, 2] == 0:
            continue
        temperature = temperatures[cell]
        if np.isnan(temperature):
            temperature = _mean_temperature(counts, windows[cell], weights, calibration)
        temperature += correction
        frames[cell] += 1
        step = temperature - mean[cell]
        mean[cell] += step / frames[cell]
        squares[cell] += step * (temperature - mean[cell])


@njit(nogil=True)
def _temperature_of_mean(counts: Array, window: Array, weights: Array, calibration: Array) -> float:
    """Temperature of the mean count of a cell, degC; NaN where the counts of its pixels differ too much for that, or one has none."""
    left, top, columns, rows, place = window[0], window[1], window[2], window[3], window[4]
    total, low, high = 0.0, np.uint16(65535), np.uint16(0)
    for i in range(top, top + rows):
        for j in range(left, left + columns):
            value = counts[i, j]
            total += weights[place] * value
            place += np.uint64(1)
            low, high = min(low, value), max(high, value)
    narrow = high - low <= _NARROW_COUNTS and not np.isnan(calibration[low] + calibration[high])
    return _calibrate(calibration, total) if narrow else np.nan


@njit(nogil=True)
def _mean_temperature(counts: Array, window: Array, weights: Array, calibration: Array) -> float:
    """Mean of the temperatures of the pixels of a cell, degC."""
    left, top, columns, rows, place = window[0], window[1], window[2], window[3], window[4]
    total = 0.0
    for i in range(top, top + rows):
        for j in range(left, left + columns):
            # A pixel without a temperature counts only where it has a weight.
            if weights[place] > 0:
                total += weights[place] * calibration[counts[i, j]]
            place += np.uint64(1)
    return total


@njit(nogil=True)
def _calibrate(calibration: Array, counts: float) -> float:
    """Temperature of counts that need not be whole numbers, degC."""
    low = min(int(counts), 65534)
    part = counts - low
    return (1 - part) * calibration[low] + part * calibration[low + 1]


def on_plan(count: Array, mean: Array, samples: Samples) -> Array:
    """Arrange cells on the plan, those with masked points moved to their centre."""
    shape = samples.grid.shape
    seen = (count > 0).reshape(shape) & (samples.coverage >= LEAST_COVERAGE)
    centred = mean + samples.centring @ mean
    # Next to cells that were never in view the gradient is unknown.
    complete = np.asarray((abs(samples.centring) @ (count == 0).astype(float)) == 0)
    return np.where(seen, np.where(complete, centred, mean).reshape(shape), np.nan)


#: Frames in which the position of the table is less certain than this are left out of the fields, mm.
_LARGEST_U_MM = 1.0
#: A table whose place differs by no more than this stands, and its frames are sampled alike, mm: the place of one frame is known no better.
_STANDING_MM = 0.02


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
    detector: Detector | None = None,
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
    detector : Detector or None
        Bad pixels, whose weight goes to their sound neighbours, and clipped counts, of which a cell is empty.
    block_s : float, s
        Frames of one cycle within this time share one field of `frame_temperature`; 0 gives every frame its own.
    scheduler : str or None
        Address of a dask scheduler whose workers see the same files; None for threads on the cores of this machine.
    checkpoint : str, Path or None
        Folder to which stretches of frames are written as they are done; a run that finds it resumes at the first that is missing.
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
        references,
        cycle_bounds,
        shape=registration.shape,
        override=override,
        correction_K=correction_K,
        detector=detector,
    )
    spans = [RegistrationSpan(0, registration)]
    blocks = cut_blocks(frames, spans, block_s=block_s)
    kept = None
    if checkpoint is not None:
        description = describe_reduction(frames, grid, spans, block_s=block_s)
        kept = Checkpoint(checkpoint, {**description, "axis": axis.tolist(), "reach_mm": reach_mm})
    tracker = make_tracker(registration, grid, -axis, reach_mm=reach_mm)
    samples = sample_points(registration, grid)
    results = _reduce_blocks(
        blocks, frames, (tracker, samples, frames.detector), kept, scheduler=scheduler, progress=progress
    )
    return _assemble(frames, results, samples, registration, axis)


@dataclass(frozen=True)
class _BlockResult:
    """The reduction of one block: the cells as of `CellSums`; per frame the displacement (x, y) of the table with its standard uncertainty,
    mm, NaN where it is not located, and the discs used.
    """

    block: Block
    count: Array
    mean: Array
    squares: Array
    shift_mm: Array
    u_mm: Array
    discs: Array


_PER_CELL = ("count", "mean", "squares")
_PER_FRAME = ("shift_mm", "u_mm", "discs")


def _load(checkpoint: Checkpoint, blocks: Sequence[Block]) -> list[_BlockResult]:
    """Results of an earlier run, from the first block on."""
    results: list[_BlockResult] = []
    for arrays in checkpoint.load("blocks_*"):
        stored = blocks[len(results) : len(results) + len(arrays["count"])]
        ends = np.cumsum([block.stop - block.first for block in stored])
        per_frame = [np.split(arrays[name], ends[:-1]) for name in _PER_FRAME]
        per_cell = [arrays[name] for name in _PER_CELL]
        results += [_BlockResult(*values) for values in zip(stored, *per_cell, *per_frame, strict=True)]
    return results


def _reduce_blocks(
    blocks: Sequence[Block],
    frames: FrameSeries,
    prepared: tuple[TableTracker, Samples, Detector],
    checkpoint: Checkpoint | None,
    *,
    scheduler: str | None,
    progress: Callable[[int], None] | None,
) -> list[_BlockResult]:
    """Results of all blocks, those that are not stored computed by the pool."""
    results = [] if checkpoint is None else _load(checkpoint, blocks)
    if progress is not None and results:
        progress(results[-1].block.stop)
    with open_pool(scheduler) as pool:
        shared = pool.share(prepared)
        stretches = (
            [block for portion in stretch for block in portion.blocks]
            for stretch in cut_stretches(blocks[len(results) :], total=len(frames))
        )
        tasks = ((stretch, (_reduce_stretch, gather_frames(frames, stretch), shared)) for stretch in stretches)
        for stretch, reduced in in_order(pool, tasks):
            if checkpoint is not None:
                arrays = {name: np.stack([getattr(result, name) for result in reduced]) for name in _PER_CELL}
                arrays |= {name: np.concatenate([getattr(result, name) for result in reduced]) for name in _PER_FRAME}
                checkpoint.save(f"blocks_{len(results):08d}", **arrays)
            results += reduced
            if progress is not None:
                progress(stretch[-1].stop - stretch[0].first)
    return results


def _reduce_stretch(
    blocks: Sequence[BlockFrames], prepared: tuple[TableTracker, Samples, Detector]
) -> list[_BlockResult]:
    """Locate the table in every frame of some blocks and add the frame to their cells: the task of a thread or of a worker."""
    tracker, samples, detector = prepared
    shape, cells = tracker.registration.shape, len(samples.valid)
    results = []
    with WindowReader((slice(0, shape[0]), slice(0, shape[1]))) as reader:
        for block, frames, _, correction_K in blocks:
            calibration = temperature_from_counts(np.arange(65536.0), block.parameters)
            # A cell with a clipped pixel in one of the frames has no mean.
            calibration[detector.clipped(np.arange(65536))] = np.nan
            sums = CellSums(np.zeros(cells, np.int64), np.zeros(cells), np.zeros(cells))
            shift_mm, u_mm = np.full((len(frames), 2), np.nan), np.full(len(frames), np.nan)
            discs = np.zeros(len(frames), np.int64)
            previous, sampled_mm = None, np.full(2, np.nan)
            chunks = reader.read_in_chunks(frames, CHUNK_FRAMES)
            for i, counts in enumerate(counts for chunk in chunks for counts in chunk):
                detector.repair(counts[None])
                position = locate_table(counts, tracker, previous)
                previous = None if position is None else position.shift_mm
                if position is None:
                    continue
                shift_mm[i], u_mm[i], discs[i] = position.shift_mm, position.u_mm, position.discs
                if not position.u_mm <= _LARGEST_U_MM:
                    continue
                if not np.hypot(*(position.shift_mm - sampled_mm)) <= _STANDING_MM:
                    sampled_mm = position.shift_mm
                    weights = weigh_pixels(samples.points_mm, samples.valid, sampled_mm, tracker.lens, shape)
                add_frame(counts, calibration, weights, float(correction_K[i]), sums)
            results.append(_BlockResult(block, *sums, shift_mm, u_mm, discs))
    return results


def _assemble(
    frames: FrameSeries, results: Sequence[_BlockResult], samples: Samples, registration: Registration, axis: Array
) -> xr.Dataset:
    """Fields per cycle, the frame stack, and the positions of the table, as one Dataset."""
    discs = np.concatenate([result.discs for result in results])
    if not discs.any():
        raise ReductionError("the table is found in no frame; check the fiducials and [plan.axis] direction")
    parts = _cycle_parts(frames, results, samples)
    if not parts:
        raise frames.outside_cycles("no frame in which the table is found")
    block_times = np.array([frames.mean_time(slice(one.block.first, one.block.stop)) for one in results])
    fields = assemble_fields(
        parts,
        len(frames.bounds),
        samples.grid,
        [registration.position_covariance(samples.grid.centres_mm)],
        [samples.coverage],
        frames=_frame_variables(results, axis, samples),
        frame_coordinates={"time": block_times, "frame_time": frames.times},
    )
    for name, attributes in variables("moving")[1].items():
        fields[name].attrs.update(attributes)
    return fields.assign_attrs(
        frames_outside_cycles=json.dumps(frames.names(frames.cycles == NO_CYCLE)),
        frames_unplaced=json.dumps(frames.names(discs == 0)),
    )


def _cycle_parts(frames: FrameSeries, results: Sequence[_BlockResult], samples: Samples) -> list[CyclePart]:
    """Every cycle in which the table is located, finished."""
    parts, shape = [], samples.grid.shape
    for cycle in sorted({result.block.cycle for result in results} - {NO_CYCLE}):
        of_cycle = [result for result in results if result.block.cycle == cycle]
        located = np.concatenate([np.arange(one.block.first, one.block.stop)[one.discs > 0] for one in of_cycle])
        if not located.size:
            continue
        times = frames.times[located]
        count, mean, squares = _merge(of_cycle)
        plan_mean = on_plan(count, mean, samples)
        seen = np.isfinite(plan_mean)
        block_times = [frames.mean_time(slice(one.block.first, one.block.stop)) for one in of_cycle]
        block_s = (np.array(block_times) - times[0]) / np.timedelta64(1, "s")
        shown_s = np.dot(block_s, [one.count for one in of_cycle]) / np.maximum(count, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt(np.where(count > 1, squares / (count - 1), np.nan))
        parts.append(
            CyclePart(
                cycle,
                0,
                frames=int(located.size),
                first_time=times[0],
                seconds=float(((times - times[0]) / np.timedelta64(1, "ns")).sum()) / 1e9,
                mean=plan_mean,
                spread=np.where(seen, spread.reshape(shape), np.nan),
                noise_variance=np.where(seen, pixel_noise(plan_mean, seen) ** 2, np.nan),
                fell_back=np.zeros(shape, bool),
                count=np.where(seen, count.reshape(shape), 0).astype(np.int32),
                seen_s=shown_s.reshape(shape),
            )
        )
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


def _frame_variables(results: Sequence[_BlockResult], axis: Array, samples: Samples) -> dict[str, Any]:
    """The frame stack and the positions of the table, as xarray takes them."""
    shift = np.concatenate([result.shift_mm for result in results])
    stack = np.stack([on_plan(result.count, result.mean, samples) for result in results]).astype(np.float32)
    return {
        "frame_temperature": (("time", "y", "x"), stack),
        "frame_cycle": ("time", np.array([result.block.cycle + 1 for result in results], np.int32)),
        "frame_count": ("time", np.array([len(result.discs) for result in results], np.int32)),
        # The table moves opposite to the point under the spindle.
        "table_position": ("frame_time", -(shift @ axis)),
        "table_position_u": ("frame_time", np.concatenate([result.u_mm for result in results])),
        "table_across": ("frame_time", shift @ np.array([-axis[1], axis[0]])),
        "table_discs": ("frame_time", np.concatenate([result.discs for result in results]).astype(np.int32)),
    }
