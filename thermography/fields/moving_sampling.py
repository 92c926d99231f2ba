"""Sampling of a plan that moves through the view: points of every cell, and the addition of one frame to all cells that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from thermography._typing import Array
from thermography.fields.resampling import LEAST_COVERAGE, centring_matrix
from thermography.registration.plan import PlanGrid, mask_discs
from thermography.registration.projection import project_point
from thermography.registration.register import Registration

#: Points per cell and side, each interpolated between four pixels.
_POINTS_PER_SIDE = 4
#: Range of the counts within a cell up to which they are averaged before they are calibrated: the temperature of the mean count
#: differs from the mean temperature by a few hundredths of a millikelvin.
_NARROW_COUNTS = 600.0


@dataclass(frozen=True)
class Samples:
    """Points of every cell at which the frames are sampled.

    Attributes
    ----------
    points_mm : (cells, points, 2) ndarray, mm
        Plan points (x, y).
    valid : (cells, points) ndarray of bool
        False near fiducials and the plan's edge.
    coverage : (y, x) ndarray
        Share of the points of every cell that are valid.
    centring : (cells, cells) CSR array
        Moves cells with masked points to their centre, see `thermography.fields.resampling.centring_matrix`.
    """

    points_mm: Array
    valid: NDArray[np.bool_]
    coverage: Array
    centring: sparse.csr_array


class CellSums(NamedTuple):
    """Running mean and squared deviation of every cell over the frames that show it, changed in place.

    Attributes
    ----------
    frames : (cells,) ndarray of int
        Number of frames.
    mean : (cells,) ndarray, degC
    squares : (cells,) ndarray, K2
        Sum of the squared deviations from the mean.
    """

    frames: Array
    mean: Array
    squares: Array


def sample_points(registration: Registration, grid: PlanGrid, *, margin_px: float = 2.0) -> Samples:
    """Lay out the sample points of every cell.

    Parameters
    ----------
    registration : Registration
        Gives the fiducials to mask and the size of a pixel on the plan.
    grid : PlanGrid
        The plan.
    margin_px : float, px
        Width of the lens's blur: points nearer to a fiducial or to the plan's edge are masked.

    Returns
    -------
    Samples
    """
    steps = ((np.arange(_POINTS_PER_SIDE) + 0.5) / _POINTS_PER_SIDE - 0.5) * grid.cell_size_mm
    across, down = (side.ravel() for side in np.meshgrid(steps, steps))
    centres = grid.centres_mm.reshape(-1, 2)
    points = np.stack([centres[:, :1] + across, centres[:, 1:] + down], axis=-1)
    to_mm = np.linalg.inv(registration.projection.jacobian(points.reshape(-1, 2)))
    pixel_mm = np.linalg.norm(to_mm, axis=1).max(axis=1).reshape(points.shape[:2])
    edge = np.minimum.reduce(
        [points[..., 0], grid.width_mm - points[..., 0], points[..., 1], grid.height_mm - points[..., 1]]
    )
    # Interpolation between pixels reaches half a pixel farther than the lens's blur.
    margin = (margin_px + 0.5) * pixel_mm
    valid = (edge >= margin) & ~mask_discs(points, registration.masked, margin_mm=margin)
    with np.errstate(invalid="ignore"):
        offset = np.where(valid[..., None], points, 0.0).sum(axis=1) / valid.sum(axis=1)[:, None]
    offset -= centres
    coverage = valid.mean(axis=1).reshape(grid.shape)
    return Samples(points, valid, coverage, centring_matrix(offset, coverage, grid))


class _CellView(NamedTuple):
    """A cell on the sensor, as affine map about one of its points: to a thousandth of a pixel for cells of 5 mm."""

    x_mm: float
    y_mm: float
    column: float
    row: float
    column_by_x: float
    column_by_y: float
    row_by_x: float
    row_by_y: float


@numba.njit(cache=True, nogil=True)
def add_frame(
    counts: Array,
    calibration: Array,
    points: Array,
    valid: Array,
    shift: Array,
    lens: Array,
    correction: float,
    sums: CellSums,
) -> None:
    """Sample one frame and add it to every cell whose unmasked points are all in view.

    Parameters
    ----------
    counts : (row, column) ndarray of uint16
        Raw counts.
    calibration : (65536,) ndarray, degC
        Temperature of every count.
    points, valid : (cells, points, 2) ndarray, mm, and (cells, points) ndarray of bool
        Of `Samples`.
    shift : (2,) ndarray, mm
        Displacement (x, y) of the table in this frame.
    lens : (16,) ndarray
        `thermography.registration.projection.Projection.as_array`.
    correction : float, K
        Added to the temperature.
    sums : CellSums
        Changed in place.

    Notes
    -----
    Updating of mean and squared deviation after B. P. Welford, Technometrics 4 (1962) 419-420.
    """
    frames, mean, squares = sums
    for cell in range(len(points)):
        seen, temperature = _cell_temperature(counts, calibration, points, valid, cell, shift, lens)
        if not seen:
            continue
        temperature += correction
        frames[cell] += 1
        step = temperature - mean[cell]
        mean[cell] += step / frames[cell]
        squares[cell] += step * (temperature - mean[cell])


@numba.njit(cache=True, nogil=True, inline="always")
def _cell_temperature(
    counts: Array, calibration: Array, points: Array, valid: Array, cell: int, shift: Array, lens: Array
) -> tuple[bool, float]:
    """Whether all unmasked points of one cell are in view, and the mean temperature over them, degC."""
    rows, columns = counts.shape
    middle = points.shape[1] // 2
    view = _cell_view(points[cell, middle, 0], points[cell, middle, 1], shift, lens)
    total, used, low, high = 0.0, 0, 1e9, -1e9
    for k in range(points.shape[1]):
        if valid[cell, k]:
            column, row = _on_sensor(view, points[cell, k, 0], points[cell, k, 1])
            if column < 0 or row < 0 or column >= columns - 1 or row >= rows - 1:
                return False, np.nan
            value = _interpolate(counts, column, row)
            total += value
            low, high = min(low, value), max(high, value)
            used += 1
    if used == 0:
        return False, np.nan
    if high - low <= _NARROW_COUNTS:
        return True, _calibrate(calibration, total / used)
    total = 0.0
    for k in range(points.shape[1]):
        if valid[cell, k]:
            column, row = _on_sensor(view, points[cell, k, 0], points[cell, k, 1])
            total += _calibrate(calibration, _interpolate(counts, column, row))
    return True, total / used


@numba.njit(cache=True, nogil=True, inline="always")
def _cell_view(x_mm: float, y_mm: float, shift: Array, lens: Array) -> _CellView:
    """The affine map about a plan point of a table displaced by `shift`."""
    x, y = x_mm + shift[0], y_mm + shift[1]
    c0, r0 = project_point(x, y, lens)
    c1, r1 = project_point(x + 1.0, y, lens)
    c2, r2 = project_point(x, y + 1.0, lens)
    return _CellView(x_mm, y_mm, c0, r0, c1 - c0, c2 - c0, r1 - r0, r2 - r0)


@numba.njit(cache=True, nogil=True, inline="always")
def _on_sensor(view: _CellView, x_mm: float, y_mm: float) -> tuple[float, float]:
    """Column and row of a plan point of the cell, px."""
    x, y = x_mm - view.x_mm, y_mm - view.y_mm
    column = view.column + x * view.column_by_x + y * view.column_by_y
    return column, view.row + x * view.row_by_x + y * view.row_by_y


@numba.njit(cache=True, nogil=True)
def _interpolate(counts: Array, column: float, row: float) -> float:
    """Counts between four pixels, bilinear."""
    j, i = int(column), int(row)
    u, v = column - j, row - i
    upper = (1 - u) * counts[i, j] + u * counts[i, j + 1]
    lower = (1 - u) * counts[i + 1, j] + u * counts[i + 1, j + 1]
    return (1 - v) * upper + v * lower


@numba.njit(cache=True, nogil=True)
def _calibrate(calibration: Array, counts: float) -> float:
    """Temperature of counts that need not be whole numbers, degC."""
    low = min(int(counts), 65534)
    part = counts - low
    return (1 - part) * calibration[low] + part * calibration[low + 1]


def on_plan(count: Array, mean: Array, samples: Samples, grid: PlanGrid) -> Array:
    """Arrange cells on the plan, those with masked points moved to their centre.

    Parameters
    ----------
    count, mean : (cells,) ndarray
        Number of frames, and mean over them, of `CellSums`.
    samples : Samples
    grid : PlanGrid

    Returns
    -------
    (y, x) ndarray, degC
        NaN where a cell was in view in no frame or less than half of it is unmasked.
    """
    seen = (count > 0).reshape(grid.shape) & (samples.coverage >= LEAST_COVERAGE)
    centred = mean + samples.centring @ mean
    # Next to cells that were never in view the gradient is unknown.
    complete = np.asarray((abs(samples.centring) @ (count == 0).astype(float)) == 0)
    return np.where(seen, np.where(complete, centred, mean).reshape(grid.shape), np.nan)
