"""Cells of a plan that moves through the view: where each is sampled, and one frame added to all that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.fields.resampling import LEAST_COVERAGE, centring
from thermography.registration.plan import PlanGrid, mask_discs
from thermography.registration.projection import projected
from thermography.registration.register import Registration

#: Samples per cell and side, each interpolated between four pixels.
SAMPLES = 4
#: Counts within a cell up to which they are averaged before they are calibrated.
NARROW = 600.0


@dataclass(frozen=True)
class Samples:
    """Points of every cell at which a frame is sampled: (cells, samples, 2) mm, which of them are masked, and the seen coverage."""

    points_mm: Array
    valid: NDArray[np.bool_]
    coverage: Array
    centring: Any


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
def add_frame(
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


def on_plan(count: Array, mean: Array, samples: Samples, grid: PlanGrid) -> Array:
    """Cells moved to their own centre, (y, x); NaN where a cell was in view in no frame or is masked."""
    known = (count > 0).reshape(grid.shape) & (samples.coverage >= LEAST_COVERAGE)
    centred = mean + samples.centring @ mean
    # Next to cells that were never in view there is no gradient to move along.
    complete = np.asarray((abs(samples.centring) @ (count == 0).astype(float)) == 0)
    return np.where(known, np.where(complete, centred, mean).reshape(grid.shape), np.nan)
