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
_NARROW_COUNTS = 600


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
    # The longer side of a pixel on the plan, by the inverse in closed form: a solver called for every point takes twenty times as long.
    (a, b), (c, d) = np.moveaxis(registration.projection.jacobian(points.reshape(-1, 2)), 0, -1)
    pixel_mm = (np.sqrt(np.maximum(a * a + b * b, c * c + d * d)) / np.abs(a * d - b * c)).reshape(points.shape[:2])
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


class CellWeights(NamedTuple):
    """Weights of the pixels in the mean of every cell, for one place of the table.

    Attributes
    ----------
    windows : (cells, 5) ndarray of unsigned int
        First column, first row, number of columns and of rows of the pixels around a cell's points, and the place of the first one's
        weight; no columns where an unmasked point is out of view.
    weights : (pixels of all windows,) ndarray
        Cell by cell, row by row; those of a cell sum to 1.
    """

    windows: Array
    weights: Array


@numba.njit(cache=True, nogil=True)
def weigh_pixels(points: Array, valid: Array, shift: Array, lens: Array, shape: tuple[int, int]) -> CellWeights:
    """Weigh the pixels around the points of every cell, each of which is interpolated between four pixels (bilinear).

    Parameters
    ----------
    points, valid : (cells, points, 2) ndarray, mm, and (cells, points) ndarray of bool
        Of `Samples`.
    shift : (2,) ndarray, mm
        Displacement (x, y) of the table.
    lens : (16,) ndarray
        `thermography.registration.projection.Projection.as_array`.
    shape : (int, int)
        Rows and columns of the frames.

    Returns
    -------
    CellWeights
    """
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


@numba.njit(cache=True, nogil=True)
def _place_points(
    points: Array, valid: Array, shift: Array, lens: Array, shape: tuple[int, int]
) -> tuple[Array, Array, int]:
    """Columns and rows of all points, (cells, points, 2) px; the windows of the cells, as `CellWeights`; the pixels of all windows."""
    places = np.empty(points.shape)
    # Unsigned: negative indices would be counted from the end, and looking for them costs as much as the sums themselves.
    windows = np.zeros((len(points), 5), np.uint64)
    pixels = 0
    for cell in range(len(points)):
        view = _cell_view(points, cell, shift, lens)
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for k in range(points.shape[1]):
            x, y = points[cell, k, 0] - view.x_mm, points[cell, k, 1] - view.y_mm
            column = view.column + x * view.column_by_x + y * view.column_by_y
            row = view.row + x * view.row_by_x + y * view.row_by_y
            places[cell, k, 0], places[cell, k, 1] = column, row
            if valid[cell, k]:
                left, right, top, bottom = min(left, column), max(right, column), min(top, row), max(bottom, row)
        if 0 <= left <= right < shape[1] - 1 and 0 <= top <= bottom < shape[0] - 1:
            columns, rows = int(right) - int(left) + 2, int(bottom) - int(top) + 2
            windows[cell, 0], windows[cell, 1], windows[cell, 2] = int(left), int(top), columns
            windows[cell, 3], windows[cell, 4] = rows, pixels
            pixels += columns * rows
    return places, windows, pixels


@numba.njit(cache=True, nogil=True, inline="always")
def _cell_view(points: Array, cell: int, shift: Array, lens: Array) -> _CellView:
    """The affine map about the middle one of a cell's points, of a table displaced by `shift`."""
    middle = points.shape[1] // 2
    x_mm, y_mm = points[cell, middle, 0], points[cell, middle, 1]
    x, y = x_mm + shift[0], y_mm + shift[1]
    c0, r0 = project_point(x, y, lens)
    c1, r1 = project_point(x + 1.0, y, lens)
    c2, r2 = project_point(x, y + 1.0, lens)
    return _CellView(x_mm, y_mm, c0, r0, c1 - c0, c2 - c0, r1 - r0, r2 - r0)


@numba.njit(cache=True, nogil=True)
def add_frame(counts: Array, calibration: Array, sampling: CellWeights, correction: float, sums: CellSums) -> None:
    """Average one frame over every cell that it shows, and add it to the sums.

    Parameters
    ----------
    counts : (row, column) ndarray of uint16
        Raw counts.
    calibration : (65536,) ndarray, degC
        Temperature of every count.
    sampling : CellWeights
        Of the place of the table in this frame.
    correction : float, K
        Added to the temperature.
    sums : CellSums
        Changed in place.

    Notes
    -----
    Updating of mean and squared deviation after B. P. Welford, Technometrics 4 (1962) 419-420.
    """
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


@numba.njit(cache=True, nogil=True)
def _temperature_of_mean(counts: Array, window: Array, weights: Array, calibration: Array) -> float:
    """Temperature of the mean count of a cell, degC; NaN where the counts of its pixels differ too much for that."""
    left, top, columns, rows, place = window[0], window[1], window[2], window[3], window[4]
    total, low, high = 0.0, np.uint16(65535), np.uint16(0)
    for i in range(top, top + rows):
        for j in range(left, left + columns):
            value = counts[i, j]
            total += weights[place] * value
            place += np.uint64(1)
            low, high = min(low, value), max(high, value)
    return _calibrate(calibration, total) if high - low <= _NARROW_COUNTS else np.nan


@numba.njit(cache=True, nogil=True)
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
