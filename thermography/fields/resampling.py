"""Resampling of sensor pixels to plan cells: averages by area, fiducials and plan edge masked, as sparse matrices."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import Array, ThermographyError
from thermography.io.sequence import usable_threads
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

#: Pixels that lie in several cells are cut along and across into so many parts per length of a cell, and so many at least; each part
#: belongs to the cell of its centre.
_PARTS = 4
#: Entries provided per pixel at first: one for a pixel within a cell, four for one on a corner of cells.
_ENTRIES_PER_PIXEL = 4
#: Cells of which less than this share is seen unmasked are NaN.
LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class PlanWeights:
    """Weights of the pixels in every cell of the plan: shares of its seen area (cells, pixels of the window), whose rows sum to 1, the
    correction that moves partly seen cells to their centre (see `centring_matrix`), the window of the sensor, and the share of every
    cell (y, x) that is seen unmasked.
    """

    areas: scipy.sparse.csr_array
    centring: scipy.sparse.csr_array
    window: tuple[slice, slice]
    coverage: Array
    grid: PlanGrid

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Pixels of the window that have a weight, (row, column)."""
        shape = tuple(side.stop - side.start for side in self.window)
        used = np.zeros(shape[0] * shape[1], bool)
        used[self.areas.indices] = True
        return used.reshape(shape)

    @cached_property
    def interior(self) -> NDArray[np.bool_]:
        """Pixels of the window whose eight neighbours have a weight too, (row, column)."""
        used, interior = self.used, np.zeros_like(self.used)
        # A tenth of the time of scipy.ndimage.binary_erosion.
        across = used[:, :-2] & used[:, 1:-1] & used[:, 2:]
        interior[1:-1, 1:-1] = across[:-2] & across[1:-1] & across[2:]
        return interior

    @cached_property
    def noise_factor(self) -> Array:
        """Variance of every cell, (y, x), for independent pixels of unit variance."""
        return self._variance(self.areas)

    @cached_property
    def line_factors(self) -> tuple[Array, Array]:
        """Variance of every cell, (y, x), for noise of unit variance that the pixels of a row share, and of a column."""
        place, (rows, columns) = self.areas.indices, self.used.shape

        def factor(line: Array, count: int) -> Array:
            shares = (self.areas.data, line, self.areas.indptr)
            return self._variance(scipy.sparse.csr_array(shares, shape=(self.areas.shape[0], count), copy=True))

        return factor(place // columns, rows), factor(place % columns, columns)

    def _variance(self, shares: scipy.sparse.csr_array) -> Array:
        """Variance of every cell, (y, x), from the shares in it of independent parts of the picture of unit variance."""
        shares.sum_duplicates()
        variance = _row_squares(shares)
        moved = np.flatnonzero(np.diff(self.centring.indptr))
        if moved.size:
            variance[moved] = _row_squares(scipy.sparse.csr_array(shares[moved] + self.centring[moved] @ shares))
        return self._on_plan(variance)

    def resample(self, values: Array, clipped: NDArray[np.bool_] | None = None) -> Array:
        """Average window pixels, (row, column), over every cell and move partly seen cells to their centre; (y, x), NaN where unseen, and
        where a pixel is clipped, without which the rest would be no mean of the cell.
        """
        cells = self.areas @ values.ravel()
        if np.isnan(cells).any():
            # Average over every cell of the pixels that have a value; NaN where they cover less than half of it.
            pixels = values.ravel()
            present = np.isfinite(pixels)
            share = self.areas @ present.astype(float)
            with np.errstate(invalid="ignore", divide="ignore"):
                cells = np.where(share >= LEAST_COVERAGE, self.areas @ np.where(present, pixels, 0.0) / share, np.nan)
        if clipped is not None and clipped.any():
            cells = np.where(self.areas @ clipped.ravel().astype(float) > 0, np.nan, cells)
        return self._on_plan(cells + self.centring @ cells)

    def average(self, values: Array) -> Array:
        """As `resample`, by area alone: for quantities that must not be extrapolated (variances)."""
        return self._on_plan(self.areas @ values.ravel())

    def _on_plan(self, cells: Array) -> Array:
        return np.where(self.coverage >= LEAST_COVERAGE, cells.reshape(self.grid.shape), np.nan)


def _row_squares(matrix: scipy.sparse.csr_array) -> Array:
    """Sum of the squares of every row."""
    squares = scipy.sparse.csr_array((matrix.data**2, matrix.indices, matrix.indptr), shape=matrix.shape)
    return squares @ np.ones(matrix.shape[1])


def plan_window(registration: Registration, grid: PlanGrid) -> tuple[slice, slice]:
    """Window of the sensor that contains the plan: whole rows, because these are contiguous in the file."""
    outline = registration.to_sensor(grid.outline_mm(25))
    rows, columns = registration.shape
    top = max(int(np.floor(outline[:, 1].min())), 0)
    bottom = min(int(np.ceil(outline[:, 1].max())), rows - 1)
    if bottom < top:
        raise ThermographyError("no pixel of the frame is on the plan; check the fiducials and the plan's size")
    return slice(top, bottom + 1), slice(0, columns)


def plan_weights(registration: Registration, grid: PlanGrid, *, bad: NDArray[np.bool_] | None = None) -> PlanWeights:
    """Weights of the pixels of a registered camera in the cells of the plan, those of bad pixels (row, column) 0."""
    window = plan_window(registration, grid)
    cell, pixel, area, x, y = _pieces(registration, grid, window)
    if bad is not None and bad.any():
        sound = ~bad[window].ravel()[pixel]
        cell, pixel, area, x, y = (values[sound] for values in (cell, pixel, area, x, y))
    if len(cell) == 0:
        raise ThermographyError("no pixel of the frame is on the plan; check the fiducials and the plan's size")
    cells = grid.shape[0] * grid.shape[1]
    seen_area = np.bincount(cell, area, cells)
    coverage = (seen_area / grid.cell_size_mm**2).reshape(grid.shape).clip(0, 1)
    moments = np.stack([np.bincount(cell, area * along, cells) for along in (x, y)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = moments / seen_area[:, None] - grid.centres_mm.reshape(-1, 2)
    # The pieces are in the order of the pixels, so that a stable sort by cells leaves the columns of every row sorted.
    # Numbers of 16 bits are sorted by counting.
    order = np.argsort(cell.astype(np.uint16) if cells <= 1 << 16 else cell, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=cells))])
    shape = (cells, (window[0].stop - window[0].start) * window[1].stop)
    areas = scipy.sparse.csr_array(((area / seen_area[cell])[order], pixel[order], starts), shape=shape)
    return PlanWeights(areas, centring_matrix(offset, coverage, grid), window, coverage, grid)


def _pieces(registration: Registration, grid: PlanGrid, window: tuple[slice, slice]) -> tuple[Array, ...]:
    """Cut the unmasked pixels of a window at the cells, in two threads: cell, pixel, area (mm2), and mean x and y (mm) per piece."""
    rows, columns = window[0].stop - window[0].start, window[1].stop
    across, down = np.meshgrid(np.arange(columns + 1) - 0.5, np.arange(window[0].start, window[0].stop + 1) - 0.5)
    corners = registration.to_plan(np.stack([across, down], axis=-1))
    discs = np.array([(disc.x_mm, disc.y_mm, disc.diameter_mm / 2) for disc in registration.masked]).reshape(-1, 3)
    # A plan may be given in whole numbers, for which the cutting would be compiled again.
    size, cell_mm = (float(grid.width_mm), float(grid.height_mm)), float(grid.cell_size_mm)
    with ThreadPoolExecutor(usable_threads()) as executor:
        halves = executor.map(
            lambda part: _cut_pixels(corners, part, discs, size, cell_mm, registration.margin_px),
            [(0, rows // 2), (rows // 2, rows)],
        )
        return tuple(np.concatenate(both) for both in zip(*halves, strict=True))


class _Pixel(NamedTuple):
    """A pixel on the plan as a parallelogram: its centre and its sides along the row (across) and the column (down), mm."""

    x: float
    y: float
    across_x: float
    across_y: float
    down_x: float
    down_y: float


class _Pieces(NamedTuple):
    """Pieces of pixels, one entry per pixel and cell: area (mm2), and area times mean position (mm3)."""

    cell: Array
    pixel: Array
    area: Array
    x: Array
    y: Array


def _cut_pixels(
    corners: Array, rows: tuple[int, int], discs: Array, size: tuple[float, float], cell_mm: float, margin_px: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Cut every unmasked pixel of some rows at the cells: cell, pixel, area (mm2), mean x and y (mm) of every piece."""
    most, count = _ENTRIES_PER_PIXEL * (rows[1] - rows[0]) * (corners.shape[1] - 1), -1
    while count < 0:
        pieces = _Pieces(np.empty(most, np.int32), np.empty(most, np.int32), *np.empty((3, most)))
        count = _fill(pieces, corners, rows, discs, size, cell_mm, margin_px)
        most *= 2
    area = pieces.area[:count]
    return pieces.cell[:count], pieces.pixel[:count], area, pieces.x[:count] / area, pieces.y[:count] / area


@njit(nogil=True)
def _fill(
    pieces: _Pieces,
    corners: Array,
    rows: tuple[int, int],
    discs: Array,
    size: tuple[float, float],
    cell_mm: float,
    margin_px: float,
) -> int:
    """Add the pieces of every unmasked pixel of some rows: their number, -1 where there may be more than there is room for."""
    columns = corners.shape[1] - 1
    cells = (round(size[0] / cell_mm), round(size[1] / cell_mm))
    count = 0
    for row in range(rows[0], rows[1]):
        for column in range(columns):
            pixel = _pixel(corners, row, column)
            across2 = pixel.across_x * pixel.across_x + pixel.across_y * pixel.across_y
            down2 = pixel.down_x * pixel.down_x + pixel.down_y * pixel.down_y
            side = np.sqrt(max(across2, down2))
            margin = margin_px * side
            inside_x = margin <= pixel.x <= size[0] - margin
            inside_y = margin <= pixel.y <= size[1] - margin
            if inside_x and inside_y and not _on_disc(pixel.x, pixel.y, discs, margin):
                parts = max(_PARTS, int(np.ceil(_PARTS * side / cell_mm)))
                if count + parts * parts > len(pieces.cell):
                    return -1
                count = _add_pixel(pieces, count, row * columns + column, pixel, parts, cells, cell_mm)
    return count


@njit(nogil=True)
def _pixel(corners: Array, row: int, column: int) -> _Pixel:
    """The parallelogram through the middles of a pixel's sides, from the plan positions of all corners of pixels."""
    x, across_x, down_x = _sides(corners, row, column, 0)
    y, across_y, down_y = _sides(corners, row, column, 1)
    return _Pixel(x, y, across_x, across_y, down_x, down_y)


@njit(nogil=True)
def _sides(corners: Array, row: int, column: int, k: int) -> tuple[float, float, float]:
    """Middle of a pixel and its sides along the row and the column, in coordinate `k`."""
    a, b = corners[row, column, k], corners[row, column + 1, k]
    c, d = corners[row + 1, column, k], corners[row + 1, column + 1, k]
    return (a + b + c + d) / 4, (b - a + d - c) / 2, (c - a + d - b) / 2


@njit(nogil=True)
def _on_disc(x: float, y: float, discs: Array, margin: float) -> bool:
    """Whether a point lies on a disc (x, y, radius) or nearer to it than a margin."""
    on_disc = False
    for k in range(len(discs)):
        on_disc |= (x - discs[k, 0]) ** 2 + (y - discs[k, 1]) ** 2 < (discs[k, 2] + margin) ** 2
    return on_disc


@njit(nogil=True, inline="always")
def _add_pixel(
    pieces: _Pieces, count: int, number: int, pixel: _Pixel, parts: int, cells: tuple[int, int], cell_mm: float
) -> int:
    """Add the pieces of one pixel, cut into parts squared, after the first `count`; the new count."""
    part_area = abs(pixel.across_x * pixel.down_y - pixel.across_y * pixel.down_x) / parts**2
    reach_x = (abs(pixel.across_x) + abs(pixel.down_x)) / 2
    reach_y = (abs(pixel.across_y) + abs(pixel.down_y)) / 2
    left, top = int((pixel.x - reach_x) / cell_mm), int((pixel.y - reach_y) / cell_mm)
    right, bottom = int((pixel.x + reach_x) / cell_mm), int((pixel.y + reach_y) / cell_mm)
    if left == right and top == bottom and left < cells[0] and top < cells[1]:
        # Most pixels lie within one cell.
        return _add_piece(pieces, count, count, top * cells[0] + left, number, part_area * parts**2, pixel.x, pixel.y)
    first = count
    for i in range(parts):
        for j in range(parts):
            s, t = (j + 0.5) / parts - 0.5, (i + 0.5) / parts - 0.5
            x = pixel.x + s * pixel.across_x + t * pixel.down_x
            y = pixel.y + s * pixel.across_y + t * pixel.down_y
            column, row = int(x / cell_mm), int(y / cell_mm)
            if 0 <= column < cells[0] and 0 <= row < cells[1]:
                count = _add_piece(pieces, first, count, row * cells[0] + column, number, part_area, x, y)
    return count


@njit(nogil=True, inline="always")
def _add_piece(pieces: _Pieces, first: int, count: int, cell: int, number: int, area: float, x: float, y: float) -> int:
    """Add an area at (x, y) to the entry of its cell among those from `first` on, which are the pixel's, or to a new one; the count."""
    # The part before lies in the same cell or in one beside it.
    entry = count - 1
    while entry >= first and pieces.cell[entry] != cell:
        entry -= 1
    if entry < first:
        entry = count
        pieces.cell[entry], pieces.pixel[entry] = cell, number
        pieces.area[entry], pieces.x[entry], pieces.y[entry] = 0.0, 0.0, 0.0
        count += 1
    pieces.area[entry] += area
    pieces.x[entry] += area * x
    pieces.y[entry] += area * y
    return count


def centring_matrix(offset_mm: Array, coverage: Array, grid: PlanGrid) -> scipy.sparse.csr_array:
    """Correction that moves partly seen cells from the centre of their seen area to their own centre."""
    centres_mm = offset_mm + grid.centres_mm.reshape(-1, 2)
    seen = coverage.ravel() >= LEAST_COVERAGE
    off_centre = (np.abs(offset_mm) > 0.02 * grid.cell_size_mm).any(axis=1) & seen
    rows, columns, weights = _centring_entries(
        np.flatnonzero(off_centre), offset_mm, centres_mm, coverage.ravel(), grid.shape, float(grid.cell_size_mm)
    )
    return scipy.sparse.csr_array((weights, (rows, columns)), shape=(seen.size, seen.size))


@njit(nogil=True)
def _centring_entries(
    chosen: Array, offset: Array, centres: Array, coverage: Array, shape: tuple[int, int], cell_mm: float
) -> tuple[Array, Array, Array]:
    """Row, column and weight of the entries of `centring_matrix`: a plane fitted to 3 x 3 cells, weighted by their coverage."""
    rows, columns = np.empty(9 * len(chosen), np.int64), np.empty(9 * len(chosen), np.int64)
    weights = np.empty(9 * len(chosen))
    count = 0
    around = np.empty(9, np.int64)
    for cell in chosen:
        n = _seen_neighbours(cell, coverage, shape, around)
        total, mean_x, mean_y = 0.0, 0.0, 0.0
        for other in around[:n]:
            total += coverage[other]
            mean_x += coverage[other] * centres[other, 0]
            mean_y += coverage[other] * centres[other, 1]
        mean_x, mean_y = mean_x / total, mean_y / total
        sxx, sxy, syy = 0.0, 0.0, 0.0
        for other in around[:n]:
            w, dx, dy = coverage[other], centres[other, 0] - mean_x, centres[other, 1] - mean_y
            sxx, sxy, syy = sxx + w * dx * dx, sxy + w * dx * dy, syy + w * dy * dy
        determinant = sxx * syy - sxy * sxy
        # Cells in one line have no gradient across it; such a cell is not moved.
        if determinant < 0.05 * cell_mm**4:
            continue
        for other in around[:n]:
            w, dx, dy = coverage[other], centres[other, 0] - mean_x, centres[other, 1] - mean_y
            gx, gy = w * (syy * dx - sxy * dy) / determinant, w * (sxx * dy - sxy * dx) / determinant
            rows[count], columns[count] = cell, other
            weights[count] = -(offset[cell, 0] * gx + offset[cell, 1] * gy)
            count += 1
    return rows[:count], columns[:count], weights[:count]


@njit(nogil=True)
def _seen_neighbours(cell: int, coverage: Array, shape: tuple[int, int], around: Array) -> int:
    """Write the seen cells among the 3 x 3 around a cell, itself included, to `around`; their number."""
    y, x = cell // shape[1], cell % shape[1]
    n = 0
    for j in range(max(y - 1, 0), min(y + 2, shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, shape[1])):
            if coverage[j * shape[1] + i] >= LEAST_COVERAGE:
                around[n] = j * shape[1] + i
                n += 1
    return n
