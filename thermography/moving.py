"""L3 - Fields of a table that moves through the view: every frame laid on the plan where its own discs put it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from thermography.averaging import CHUNK_FRAMES
from thermography.blocks import Block, Override, cut_blocks
from thermography.cycles import NOT_NUMBERED, CyclePart, assemble, pixel_noise, position_covariance
from thermography.fields import BLOCK_S, FieldError, check_bounds, check_correction, check_frames, cycle_of
from thermography.flir import CameraParameters, FrameReference
from thermography.knocks import RegisteredFrom
from thermography.lens_kernel import projected
from thermography.plan import PlanGrid, mask_discs
from thermography.radiometry import temperature_from_counts
from thermography.reading import WindowReader
from thermography.registration import Registration
from thermography.resampling import LEAST_COVERAGE, centring
from thermography.scheduling import in_order, open_pool
from thermography.tracking import Tracker, locate_table, make_tracker

Array = NDArray[Any]

#: Samples per cell and side, each interpolated between four pixels.
SAMPLES = 4
#: Frames whose table is known no better than this take no part in the fields, mm.
LARGEST_U_MM = 1.0

#: Counts within a cell up to which they are averaged before they are calibrated.
NARROW = 600.0

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
class Samples:
    """Points of every cell at which a frame is sampled: (cells, samples, 2) mm, which of them are masked, and the seen coverage."""

    points_mm: Array
    valid: NDArray[np.bool_]
    coverage: Array
    centring: Any


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
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Reduce frames of a moving table to one field per cycle on the plan, which stays attached to the table.

    Parameters
    ----------
    references, grid, cycle_bounds, override, correction_K, block_s, scheduler, progress
        As for `thermography.fields.reduce_frames`.
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
    """
    axis = np.asarray(direction, float) / np.hypot(*np.asarray(direction, float))
    bounds = check_bounds(np.asarray(cycle_bounds))
    times = check_frames(references, registration.shape)
    correction = check_correction(correction_K, len(references))
    cycles = cycle_of(times, bounds)
    spans = [RegisteredFrom(0, registration)]
    blocks = cut_blocks(references, times, cycles, spans, correction, override=override, block_s=block_s)
    tracker = make_tracker(registration, grid, -axis, reach_mm=reach_mm)
    samples = sample_points(registration, grid)
    results: list[MovingResult] = []
    with open_pool(scheduler) as pool:
        shared = pool.share((tracker, samples))
        tasks = (
            (b, (_reduce_shared, references[b.first : b.stop], b.parameters, shared, correction[b.first : b.stop]))
            for b in blocks
        )
        for block, result in in_order(pool, tasks):
            results.append(result)
            if progress is not None:
                progress(block.stop - block.first)
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


def sample_points(registration: Registration, grid: PlanGrid, *, margin_px: float = 2.0) -> Samples:
    """Lay the sample points of every cell, without those nearer than `margin_px` to a disc or to the plan's edge."""
    steps = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * grid.cell_size_mm
    across, down = (side.ravel() for side in np.meshgrid(steps, steps))
    x, y = (side.reshape(-1, 1) for side in np.meshgrid(grid.x_mm, grid.y_mm))
    points = np.stack([x + across, y + down], axis=-1)
    to_mm = np.linalg.inv(registration.projection.jacobian(points.reshape(-1, 2)))
    pixel_mm = np.linalg.norm(to_mm, axis=1).max(axis=1).reshape(points.shape[:2])
    edge = np.minimum.reduce(
        [points[..., 0], grid.width_mm - points[..., 0], points[..., 1], grid.height_mm - points[..., 1]]
    )
    # Interpolation between pixels reaches one pixel farther than the lens's blur.
    margin = (margin_px + 0.5) * pixel_mm
    valid = (edge >= margin) & ~mask_discs(points, registration.masked, margin_mm=margin)
    coverage = valid.mean(axis=1)
    with np.errstate(invalid="ignore"):
        offset = np.where(valid[..., None], points, 0.0).sum(axis=1) / valid.sum(axis=1)[:, None]
    offset -= np.concatenate([x, y], axis=1)
    plane = coverage.reshape(grid.shape)
    return Samples(points, valid, plane, centring(offset, plane, grid))


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
                    _add_frame(
                        frame, table, samples.points_mm, samples.valid, place.shift_mm, tracker.lens, float(correction_K[i]),
                        result.count, result.mean, result.squares,
                    )  # fmt: skip
    return result


@numba.njit(cache=True, nogil=True)
def _between(counts: Array, column: float, row: float) -> float:
    """Counts between four pixels, bilinear."""
    j, i = int(column), int(row)
    u, v = column - j, row - i
    upper = (1 - u) * counts[i, j] + u * counts[i, j + 1]
    lower = (1 - u) * counts[i + 1, j] + u * counts[i + 1, j + 1]
    return (1 - v) * upper + v * lower


@numba.njit(cache=True, nogil=True)
def _temperature(table: Array, counts: float) -> float:
    """Temperature of counts that need not be whole numbers."""
    low = min(int(counts), 65534)
    part = counts - low
    return (1 - part) * table[low] + part * table[low + 1]


@numba.njit(cache=True, nogil=True)
def _add_frame(
    counts: Array, table: Array, points: Array, valid: Array, shift: Array, lens: Array, offset: float,
    count: Array, mean: Array, squares: Array,
) -> None:  # fmt: skip
    """Sample one frame and add it to every cell whose unmasked samples are all in view (Welford's update)."""
    rows, columns = counts.shape
    middle = points.shape[1] // 2
    for cell in range(len(points)):
        total, used, lost, low, high = 0.0, 0, False, 1e9, -1e9
        # Within a cell the projection is as good as affine: to a thousandth of a pixel for cells of 5 mm.
        x0, y0 = points[cell, middle, 0], points[cell, middle, 1]
        c0, r0 = projected(x0 + shift[0], y0 + shift[1], lens)
        c1, r1 = projected(x0 + shift[0] + 1.0, y0 + shift[1], lens)
        c2, r2 = projected(x0 + shift[0], y0 + shift[1] + 1.0, lens)
        for k in range(points.shape[1]):
            if not valid[cell, k]:
                continue
            x, y = points[cell, k, 0] - x0, points[cell, k, 1] - y0
            c, r = c0 + x * (c1 - c0) + y * (c2 - c0), r0 + x * (r1 - r0) + y * (r2 - r0)
            if c < 0 or r < 0 or c >= columns - 1 or r >= rows - 1:
                lost = True
                break
            value = _between(counts, c, r)
            total += value
            low, high = min(low, value), max(high, value)
            used += 1
        if lost or used == 0:
            continue
        # A few hundred counts apart, the temperature of the mean count is the mean temperature to a few hundredths of a millikelvin.
        value = _temperature(table, total / used)
        if high - low > NARROW:
            total = 0.0
            for k in range(points.shape[1]):
                if valid[cell, k]:
                    x, y = points[cell, k, 0] - x0, points[cell, k, 1] - y0
                    c, r = c0 + x * (c1 - c0) + y * (c2 - c0), r0 + x * (r1 - r0) + y * (r2 - r0)
                    total += _temperature(table, _between(counts, c, r))
            value = total / used
        value += offset
        count[cell] += 1
        step = value - mean[cell]
        mean[cell] += step / count[cell]
        squares[cell] += step * (value - mean[cell])


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


def _field(count: Array, mean: Array, samples: Samples, grid: PlanGrid) -> Array:
    """Cells moved to their own centre, (y, x); NaN where a cell was in view in no frame or is masked."""
    known = (count > 0).reshape(grid.shape) & (samples.coverage >= LEAST_COVERAGE)
    centred = mean + samples.centring @ mean
    # Next to cells that were never in view there is no gradient to move along.
    complete = np.asarray((abs(samples.centring) @ (count == 0).astype(float)) == 0)
    return np.where(known, np.where(complete, centred, mean).reshape(grid.shape), np.nan)


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
        part.mean = _field(count, mean, samples, grid)
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
    stack = np.stack([_field(result.count, result.mean, samples, grid) for result in results]).astype(np.float32)
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
