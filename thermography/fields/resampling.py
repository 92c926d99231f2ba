"""Sensor pixels to plan cells: area-weighted, fiducials and table edge masked, as sparse matrices."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.fields.scheduling import THREADS
from thermography.registration.plan import PlanGrid
from thermography.registration.register import Registration

#: Every pixel is cut in this many parts squared, each of which goes to the cell that it lies in.
PARTS = 4
#: Cells of which less than this part is seen unmasked are NaN.
LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class PlanWeights:
    """How much of which pixel makes up every cell of the plan.

    Attributes
    ----------
    areas
        (cells, pixels of the window), float64 CSR: the part of every cell's seen area that lies in a pixel; rows sum to 1, and are
        empty where a cell is not seen.
    centring
        (cells, cells), what to add to partly seen cells to move them to their own centre, see `centring`.
    window
        Rows and columns of the sensor that hold every pixel with a weight.
    coverage
        (y, x), the unmasked part of every cell's area that is seen, 0..1.
    grid
        The plan.
    """

    areas: sparse.csr_array
    centring: sparse.csr_array
    window: tuple[slice, slice]
    coverage: Array
    grid: PlanGrid

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Which pixels of the window have a weight."""
        shape = tuple(side.stop - side.start for side in self.window)
        used = np.zeros(shape[0] * shape[1], bool)
        used[self.areas.indices] = True
        return used.reshape(shape)

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Which of them have eight neighbours with a weight."""
        return np.asarray(ndimage.binary_erosion(self.used, np.ones((3, 3))))

    @cached_property
    def noise_factor(self) -> Array:
        """Variance of every cell, (y, x), for independent pixels of unit variance."""
        variance = _row_squares(self.areas)
        moved = np.flatnonzero(np.diff(self.centring.indptr))
        if moved.size:
            variance[moved] = _row_squares(sparse.csr_array(self.areas[moved] + self.centring[moved] @ self.areas))
        return self._on_plan(variance)

    def resample(self, values: Array) -> Array:
        """Average window pixels, shape (row, column), over every cell; shape (y, x), NaN where a cell is not seen."""
        cells = self.areas @ values.ravel()
        return self._on_plan(cells + self.centring @ cells)

    def average(self, values: Array) -> Array:
        """As `resample`, but by area alone: for quantities that must not be extrapolated (variances)."""
        return self._on_plan(self.areas @ values.ravel())

    def _on_plan(self, cells: Array) -> Array:
        plane: Array = np.where(self.coverage >= LEAST_COVERAGE, cells.reshape(self.grid.shape), np.nan)
        return plane


def _row_squares(matrix: sparse.csr_array) -> Array:
    squares: Array = sparse.csr_array((matrix.data**2, matrix.indices, matrix.indptr), shape=matrix.shape) @ np.ones(
        matrix.shape[1]
    )
    return squares


def plan_window(registration: Registration, grid: PlanGrid) -> tuple[slice, slice]:
    """Rows and columns of the sensor that hold the plan: whole rows, for they lie together in the file.

    Raises
    ------
    ThermographyError
        No pixel lies on the plan.
    """
    outline = registration.to_sensor(_outline(grid))
    rows, columns = registration.shape
    top = max(int(np.floor(outline[:, 1].min())), 0)
    bottom = min(int(np.ceil(outline[:, 1].max())), rows - 1)
    if bottom < top:
        raise ThermographyError("no pixel of the frame lies on the plan; check the fiducials and the plan's size")
    return slice(top, bottom + 1), slice(0, columns)


def plan_weights(registration: Registration, grid: PlanGrid, *, margin_px: float = 2.0) -> PlanWeights:
    """Work out the weights of a registered camera.

    A pixel whose centre is nearer than `margin_px` to a disc or to the plan's edge has no weight, because the lens blurs what lies
    beyond into it. A cell that is only partly seen is moved from the centre of its seen area to its own centre along the gradient
    of the cells around it; otherwise a gradient of 10 K along the table would put 15 mK on cells of which a millimetre is masked.

    Parameters
    ----------
    registration
        Where the pixels lie.
    grid
        The plan.
    margin_px
        Width of the lens's blur; 2 px hold all but 1 % of an edge for common cameras.

    Raises
    ------
    ThermographyError
        No pixel lies on the plan.
    """
    window = plan_window(registration, grid)
    top, bottom, columns = window[0].start, window[0].stop - 1, window[1].stop
    across, down = np.meshgrid(np.arange(columns + 1) - 0.5, np.arange(top, bottom + 2) - 0.5)
    corners = registration.to_plan(np.stack([across, down], axis=-1))
    discs = np.array([(disc.x_mm, disc.y_mm, disc.diameter_mm / 2) for disc in registration.masked])
    size, middle = (grid.width_mm, grid.height_mm), (bottom + 1 - top) // 2
    with ThreadPoolExecutor(THREADS) as executor:
        halves = executor.map(
            lambda rows: _parts(corners, rows, discs, size, grid.cell_size_mm, margin_px),
            [(0, middle), (middle, bottom + 1 - top)],
        )
        cell, pixel, area, x, y = (np.concatenate(both) for both in zip(*halves, strict=True))
    if len(cell) == 0:
        raise ThermographyError("no pixel of the frame lies on the plan; check the fiducials and the plan's size")
    cells = grid.shape[0] * grid.shape[1]
    seen = np.bincount(cell, area, cells)
    coverage = (seen / grid.cell_size_mm**2).reshape(grid.shape).clip(0, 1)
    centre = np.stack([np.bincount(cell, area * along, cells) for along in (x, y)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = centre / seen[:, None] - np.stack(np.meshgrid(grid.x_mm, grid.y_mm), axis=-1).reshape(-1, 2)
    # The pixels come in their order, so that sorting by cells alone gives sorted rows.
    order = np.argsort(cell, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=cells))])
    shape = (cells, (bottom + 1 - top) * columns)
    areas = sparse.csr_array(((area / seen[cell])[order], pixel[order], starts), shape=shape)
    return PlanWeights(areas, centring(offset, coverage, grid), window, coverage, grid)


@numba.njit(cache=True, nogil=True)
def _parts(
    corners: Array, own_rows: tuple[int, int], discs: Array, size: tuple[float, float], cell_mm: float, margin_px: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Cut every unmasked pixel of some rows in parts and add them up by cell: cell, pixel, area (mm2) and mean place (mm) of every pair."""
    columns = corners.shape[1] - 1
    nx, ny = round(size[0] / cell_mm), round(size[1] / cell_mm)
    most = 4 * (own_rows[1] - own_rows[0]) * columns
    cell, pixel = np.empty(most, np.int32), np.empty(most, np.int32)
    area, x_mean, y_mean = np.empty(most), np.empty(most), np.empty(most)
    count = 0
    for row in range(own_rows[0], own_rows[1]):
        for column in range(columns):
            ux, vx, px = _sides(
                corners[row, column, 0],
                corners[row, column + 1, 0],
                corners[row + 1, column, 0],
                corners[row + 1, column + 1, 0],
            )
            uy, vy, py = _sides(
                corners[row, column, 1],
                corners[row, column + 1, 1],
                corners[row + 1, column, 1],
                corners[row + 1, column + 1, 1],
            )
            margin = margin_px * np.sqrt(max(ux * ux + uy * uy, vx * vx + vy * vy))
            if not (margin <= px <= size[0] - margin and margin <= py <= size[1] - margin):
                continue
            if _hidden(px, py, discs, margin):
                continue
            part = abs(ux * vy - uy * vx) / PARTS**2
            first = count
            reach_x, reach_y = (abs(ux) + abs(vx)) / 2, (abs(uy) + abs(vy)) / 2
            left, top = int((px - reach_x) / cell_mm), int((py - reach_y) / cell_mm)
            if (
                left == int((px + reach_x) / cell_mm)
                and top == int((py + reach_y) / cell_mm)
                and left < nx
                and top < ny
            ):
                # Most pixels lie in one cell as a whole.
                cell[count], pixel[count] = top * nx + left, row * columns + column
                area[count], x_mean[count], y_mean[count] = part * PARTS**2, part * PARTS**2 * px, part * PARTS**2 * py
                count += 1
                continue
            for i in range(PARTS):
                for j in range(PARTS):
                    s, t = (j + 0.5) / PARTS - 0.5, (i + 0.5) / PARTS - 0.5
                    x, y = px + s * ux + t * vx, py + s * uy + t * vy
                    cx, cy = int(x / cell_mm), int(y / cell_mm)
                    if not (0 <= cx < nx and 0 <= cy < ny):
                        continue
                    own = cy * nx + cx
                    place = first
                    while place < count and cell[place] != own:
                        place += 1
                    if place == most:
                        # Pixels of the size of cells spread over many: such a plan is too coarse to be seen anyway.
                        continue
                    if place == count:
                        cell[place], pixel[place] = own, row * columns + column
                        area[place], x_mean[place], y_mean[place] = 0.0, 0.0, 0.0
                        count += 1
                    area[place] += part
                    x_mean[place] += part * x
                    y_mean[place] += part * y
    return cell[:count], pixel[:count], area[:count], x_mean[:count] / area[:count], y_mean[:count] / area[:count]


@numba.njit(cache=True, nogil=True)
def _sides(a: float, b: float, c: float, d: float) -> tuple[float, float, float]:
    """Steps along and across, and the middle, of a pixel with corners a, b above and c, d below (one coordinate)."""
    return (b - a + d - c) / 2, (c - a + d - b) / 2, (a + b + c + d) / 4


@numba.njit(cache=True, nogil=True)
def _hidden(x: float, y: float, discs: Array, margin: float) -> bool:
    """Whether a point lies on a disc (x, y, radius) or nearer to it than a margin."""
    hidden = False
    for k in range(len(discs)):
        hidden |= (x - discs[k, 0]) ** 2 + (y - discs[k, 1]) ** 2 < (discs[k, 2] + margin) ** 2
    return hidden


def _outline(grid: PlanGrid) -> Array:
    t = np.linspace(0, 1, 25)
    zero, one = np.zeros_like(t), np.ones_like(t)
    sides = [(t, zero), (t, one), (zero, t), (one, t)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides]) * (grid.width_mm, grid.height_mm)


def centring(offset: Array, coverage: Array, grid: PlanGrid) -> sparse.csr_array:
    """What to add to the cells, (cells, cells), so that partly seen ones move from the centre of their seen area to their own.

    That is minus their offset, (cells, 2) mm, times the gradient of the cells around them; both are linear in the cells.
    """
    places = offset + np.stack(np.meshgrid(grid.x_mm, grid.y_mm), axis=-1).reshape(-1, 2)
    seen = coverage.ravel() >= LEAST_COVERAGE
    off = (np.abs(offset) > 0.02 * grid.cell_size_mm).any(axis=1) & seen
    rows, columns, weights = _gradients(
        np.flatnonzero(off), offset, places, coverage.ravel(), grid.shape, grid.cell_size_mm
    )
    return sparse.csr_array((weights, (rows, columns)), shape=(seen.size, seen.size))


@numba.njit(cache=True, nogil=True)
def _gradients(
    chosen: Array, offset: Array, places: Array, coverage: Array, shape: tuple[int, int], cell_mm: float
) -> tuple[Array, Array, Array]:
    """Entries of `centring`: a plane fitted to the 3 x 3 cells around each, weighted by how much of them is seen."""
    rows, columns = np.empty(9 * len(chosen), np.int64), np.empty(9 * len(chosen), np.int64)
    weights = np.empty(9 * len(chosen))
    count = 0
    around = np.empty(9, np.int64)
    for cell in chosen:
        y, x = cell // shape[1], cell % shape[1]
        n, total, mx, my = 0, 0.0, 0.0, 0.0
        for j in range(max(y - 1, 0), min(y + 2, shape[0])):
            for i in range(max(x - 1, 0), min(x + 2, shape[1])):
                other = j * shape[1] + i
                if coverage[other] >= LEAST_COVERAGE:
                    around[n] = other
                    n += 1
                    total += coverage[other]
                    mx += coverage[other] * places[other, 0]
                    my += coverage[other] * places[other, 1]
        mx, my = mx / total, my / total
        sxx, sxy, syy = 0.0, 0.0, 0.0
        for k in range(n):
            w, dx, dy = coverage[around[k]], places[around[k], 0] - mx, places[around[k], 1] - my
            sxx, sxy, syy = sxx + w * dx * dx, sxy + w * dx * dy, syy + w * dy * dy
        det = sxx * syy - sxy * sxy
        # Cells in a line have no gradient across it; such a cell stays where it is seen.
        if det < 0.05 * cell_mm**4:
            continue
        for k in range(n):
            w, dx, dy = coverage[around[k]], places[around[k], 0] - mx, places[around[k], 1] - my
            gx, gy = w * (syy * dx - sxy * dy) / det, w * (sxx * dy - sxy * dx) / det
            rows[count], columns[count] = cell, around[k]
            weights[count] = -(offset[cell, 0] * gx + offset[cell, 1] * gy)
            count += 1
    return rows[:count], columns[:count], weights[:count]
