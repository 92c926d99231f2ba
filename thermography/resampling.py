"""L3 - Sensor pixels to plan cells: area-weighted, fiducials and table edge masked, as one sparse matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from thermography.plan import PlanGrid, mask_discs
from thermography.registration import Registration

Array = NDArray[Any]

#: Every pixel is cut in this many parts squared, each of which goes to the cell that it lies in.
PARTS = 4
#: Cells of which less than this part is seen unmasked are NaN.
LEAST_COVERAGE = 0.3


@dataclass(frozen=True)
class PlanWeights:
    """How much of which pixel makes up every cell of the plan.

    Attributes
    ----------
    matrix
        (cells, pixels of the window), float64 CSR; rows sum to 1, and are empty where a cell is not seen.
    areas
        The same by area alone, without what moves partly seen cells to their centre.
    window
        Rows and columns of the sensor that hold every pixel with a weight.
    coverage
        (y, x), the unmasked part of every cell's area that is seen, 0..1.
    grid
        The plan.
    """

    matrix: sparse.csr_array
    areas: sparse.csr_array
    window: tuple[slice, slice]
    coverage: Array
    grid: PlanGrid

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which pixels of the window have a weight."""
        shape = tuple(side.stop - side.start for side in self.window)
        return np.asarray(np.asarray(self.areas.sum(axis=0)).reshape(shape) > 0)

    def resample(self, values: Array) -> Array:
        """Average window pixels, shape (row, column), over every cell; shape (y, x), NaN where a cell is not seen."""
        return self._on_plan(self.matrix @ values.ravel())

    def propagate(self, variance: Array | float) -> Array:
        """Variance of every cell from the variance of independent pixels, scalar or (row, column) of the window."""
        squares = self.matrix.power(2)
        pixels = np.broadcast_to(np.asarray(variance, float).ravel(), (self.matrix.shape[1],))
        return self._on_plan(squares @ pixels)

    def average(self, values: Array) -> Array:
        """As `resample`, but by area alone: for quantities that must not be extrapolated (variances)."""
        return self._on_plan(self.areas @ values.ravel())

    def _on_plan(self, cells: Array) -> Array:
        plane: Array = np.where(self.coverage >= LEAST_COVERAGE, cells.reshape(self.grid.shape), np.nan)
        return plane


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
    """
    pixels, places, areas = _unmasked_parts(registration, grid, margin_px)
    cells = np.floor(places / grid.cell_size_mm).astype(np.int64)
    ny, nx = grid.shape
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < nx) & (cells[:, 1] < ny)
    pixels, places, areas, cells = pixels[inside], places[inside], areas[inside], cells[inside]
    rows, columns = np.divmod(pixels, registration.shape[1])
    if rows.size == 0:
        raise ValueError("no pixel of the frame lies on the plan; check the fiducials and the plan's size")
    window = (slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1))
    shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
    index = (rows - window[0].start) * shape[1] + columns - window[1].start
    cell = cells[:, 1] * nx + cells[:, 0]
    area = np.bincount(cell, areas, ny * nx)
    coverage = (area / grid.cell_size_mm**2).reshape(ny, nx).clip(0, 1)
    by_area = sparse.csr_array((areas / area[cell], (cell, index)), shape=(ny * nx, shape[0] * shape[1]))
    by_area.sum_duplicates()
    offset = np.stack([np.bincount(cell, areas * places[:, axis], ny * nx) for axis in (0, 1)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = offset / area[:, None] - np.stack(np.meshgrid(grid.x_mm, grid.y_mm), axis=-1).reshape(-1, 2)
    matrix = sparse.csr_array(by_area + centring(offset, coverage, grid) @ by_area)
    return PlanWeights(matrix, by_area, window, coverage, grid)


def _unmasked_parts(registration: Registration, grid: PlanGrid, margin_px: float) -> tuple[Array, Array, Array]:
    """Parts of the pixels that count: index of their pixel, place on the plan (mm), and area on the plan (mm2)."""
    corners = registration.to_sensor(_outline(grid))
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int), np.array(registration.shape[::-1]) - 1)
    columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    centres = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    plan = registration.to_plan(centres)
    near = grid.contains(plan)
    centres, plan = centres[near], plan[near]
    to_mm = np.linalg.inv(registration.projection.jacobian(plan))
    pixel_mm = np.linalg.norm(to_mm, axis=1).max(axis=1)
    edge = np.minimum.reduce([plan[:, 0], grid.width_mm - plan[:, 0], plan[:, 1], grid.height_mm - plan[:, 1]])
    kept = (edge >= margin_px * pixel_mm) & ~mask_discs(plan, registration.masked, margin_mm=margin_px * pixel_mm)
    centres, plan, to_mm = centres[kept], plan[kept], to_mm[kept]
    steps = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    across, down = (side.ravel() for side in np.meshgrid(steps, steps))
    # Within one pixel the projection is as good as affine.
    x = plan[:, :1] + to_mm[:, 0, :1] * across + to_mm[:, 0, 1:] * down
    y = plan[:, 1:] + to_mm[:, 1, :1] * across + to_mm[:, 1, 1:] * down
    areas = np.abs(to_mm[:, 0, 0] * to_mm[:, 1, 1] - to_mm[:, 0, 1] * to_mm[:, 1, 0]) / PARTS**2
    index = (centres[:, 1] * registration.shape[1] + centres[:, 0]).astype(np.int64)
    return np.repeat(index, PARTS**2), np.stack([x.ravel(), y.ravel()], axis=-1), np.repeat(areas, PARTS**2)


def _outline(grid: PlanGrid) -> Array:
    t = np.linspace(0, 1, 25)
    zero, one = np.zeros_like(t), np.ones_like(t)
    sides = [(t, zero), (t, one), (zero, t), (one, t)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides]) * (grid.width_mm, grid.height_mm)


def centring(offset: Array, coverage: Array, grid: PlanGrid) -> sparse.csr_array:
    """What to add to the cells, (cells, cells), so that partly seen ones move from the centre of their seen area to their own.

    That is minus their offset, (cells, 2) mm, times the gradient of the cells around them; both are linear in the cells.
    """
    ny, nx = grid.shape
    rows, columns, weights = [], [], []
    seen = coverage.ravel() >= LEAST_COVERAGE
    for cell in np.flatnonzero((np.abs(offset) > 0.02 * grid.cell_size_mm).any(axis=1) & seen):
        y, x = divmod(int(cell), nx)
        around = [
            j * nx + i
            for j in range(max(y - 1, 0), min(y + 2, ny))
            for i in range(max(x - 1, 0), min(x + 2, nx))
            if seen[j * nx + i]
        ]
        i, j = np.array(around) % nx, np.array(around) // nx
        places = offset[around] + np.stack([grid.x_mm[i], grid.y_mm[j]], axis=-1)
        basis = np.column_stack([np.ones(len(around)), places - places.mean(axis=0)])
        if np.linalg.matrix_rank(basis, tol=0.1 * grid.cell_size_mm) < 3:
            continue
        weight = np.sqrt(coverage.ravel()[around])
        gradient = (np.linalg.pinv(basis * weight[:, None]) * weight)[1:]
        rows.extend([cell] * len(around))
        columns.extend(around)
        weights.extend(-(offset[cell] @ gradient))
    return sparse.csr_array((weights, (rows, columns)), shape=(ny * nx, ny * nx))
