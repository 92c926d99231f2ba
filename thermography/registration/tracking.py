"""Position of a moving table in every frame: the discs of one registration, located displaced along the axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import Array
from thermography.registration.plan import PlanGrid
from thermography.registration.projection import locate_point, project_point
from thermography.registration.register import Registration

#: Step of the coarse search along the axis, as share of the smallest disc's diameter.
_COARSE_STEP = 0.25
#: Discs that differ from the median by more than this (and by five times the median deviation) are left out, mm.
_OUTLIER_MM = 0.5
#: A position near that of the previous frame is accepted without a search if its discs agree to below this, mm, ...
_RELIABLE_U_MM = 0.3
#: ... and this share of the discs in view is located.
_RELIABLE_SHARE = 0.7
#: Number of peaks of the coarse search that are refined.
_PEAKS = 5
#: A disc needs this many times the noise of one pixel as contrast.
_LEAST_CONTRAST = 3.0
#: Radii within which a disc's inside and the ring around it are sampled by the coarse search, as share of the disc's radius.
_COARSE_RADII = (0.5, 1.5)
_COARSE_POINTS = 8


@dataclass(frozen=True)
class TableTracker:
    """A registration prepared for locating the table displaced along one direction by up to `reach_mm`: discs (n, 3), mm, as x, y and
    radius, perspective shift of their centroids and least distance from the frame's edge (n, 2), px, and displacements (m,), mm, with
    the standard uncertainty that the registration adds there to all discs together.
    """

    registration: Registration
    discs: Array
    lens: Array
    direction: Array
    size_mm: tuple[float, float]
    reach_mm: float
    bias_px: Array
    margin_px: Array
    common_mm: Array
    common_u_mm: Array


@dataclass(frozen=True)
class TablePosition:
    """Displacement (x, y) of the table in one frame from its registered position, mm, with its standard uncertainty along either coordinate
    and the part of it from the scatter of the discs used.
    """

    shift_mm: Array
    u_mm: float
    discs: int
    scatter_u_mm: float


def make_tracker(registration: Registration, grid: PlanGrid, direction: Array, *, reach_mm: float) -> TableTracker:
    """Prepare the tracking of a table that moves along one direction."""
    discs = np.array([(d.x_mm, d.y_mm, d.diameter_mm / 2) for d in registration.fiducials.values()])
    centres, radii = discs[:, :2], discs[:, 2:]
    unit = np.asarray(direction, float) / np.hypot(*direction)
    along = np.linspace(-reach_mm, reach_mm, 31)
    displaced = centres + (along[:, None] * unit)[:, None, :]
    projection = registration.projection
    # Standard uncertainty that the discs of one displacement share, root mean square over those in view, (m,) mm, for (m, n, 2) places.
    places = registration.to_sensor(displaced)
    in_view = ((places >= 0) & (places <= np.array(registration.shape[::-1]) - 1.0)).all(axis=-1)
    # Without any disc in view the table is not located there, and any value serves.
    in_view |= ~np.any(in_view, axis=1)[:, None]
    common: Array = np.sqrt(np.mean(registration.position_u(displaced) ** 2, axis=1, where=in_view))
    return TableTracker(
        registration=registration,
        discs=discs,
        lens=projection.as_array,
        direction=unit,
        size_mm=(grid.width_mm, grid.height_mm),
        reach_mm=reach_mm,
        bias_px=projection.disc_centroids(centres, discs[:, 2]) - projection.to_sensor(centres),
        margin_px=3 * np.linalg.norm(projection.jacobian(centres), axis=-1) * radii,
        common_mm=along,
        common_u_mm=common,
    )


def locate_table(
    counts: NDArray[np.uint16], tracker: TableTracker, previous_mm: Array | None = None
) -> TablePosition | None:
    """Locate the table in one frame."""
    near = None if previous_mm is None else _refine(counts, tracker, previous_mm)
    if near is not None and _is_reliable(near, counts, tracker):
        return near
    step = _COARSE_STEP * 2 * float(tracker.discs[:, 2].min())
    along = np.arange(-tracker.reach_mm, tracker.reach_mm + step, step)
    scores = _coarse_scores(counts, tracker.discs, tracker.lens, tracker.direction, along)
    peaks = np.flatnonzero((scores >= np.r_[-1.0, scores[:-1]]) & (scores >= np.r_[scores[1:], -1.0]))
    strongest = peaks[np.argsort(-scores[peaks])][:_PEAKS]
    candidates = [near, *(_refine(counts, tracker, along[peak] * tracker.direction) for peak in strongest)]
    # Discs at equal distances can be confused with each other: the position on which most discs agree, and agree best, is the right one.
    positions = [candidate for candidate in candidates if candidate is not None]
    return max(positions, key=lambda p: (p.scatter_u_mm < _RELIABLE_U_MM, p.discs, -p.scatter_u_mm), default=None)


def _is_reliable(position: TablePosition, counts: NDArray[np.uint16], tracker: TableTracker) -> bool:
    """Whether most discs that should be in view are located, and agree."""
    in_view = _discs_in_view(tracker.discs, position.shift_mm, tracker.margin_px, tracker.lens, counts.shape)
    return position.scatter_u_mm < _RELIABLE_U_MM and position.discs >= _RELIABLE_SHARE * in_view


def _refine(counts: NDArray[np.uint16], tracker: TableTracker, predicted_mm: Array) -> TablePosition | None:
    """Mean displacement of the discs located near a predicted displacement; None where fewer than two agree."""
    shifts = _displacements(
        counts, tracker.discs, tracker.bias_px, tracker.lens, tracker.registration.projection.sensor_to_plan,
        tracker.size_mm, np.asarray(predicted_mm, float),
    )  # fmt: skip
    if len(shifts) < 2:
        return None
    mean, scatter, kept = _agreement(shifts)
    if kept < 2:
        return None
    common = np.interp(mean @ tracker.direction, tracker.common_mm, tracker.common_u_mm)
    own = scatter / math.sqrt(kept)
    return TablePosition(mean, math.hypot(own, common), kept, own)


@njit()
def _discs_in_view(discs: Array, shift: Array, margin_px: Array, lens: Array, shape: tuple[int, int]) -> int:
    """Number of discs that lie far enough within the frame when the table is displaced."""
    inside = 0
    for d in range(len(discs)):
        column, row = project_point(discs[d, 0] + shift[0], discs[d, 1] + shift[1], lens)
        across, down = margin_px[d, 0], margin_px[d, 1]
        inside += across < column < shape[1] - across and down < row < shape[0] - down
    return inside


@njit()
def _agreement(shifts: Array) -> tuple[Array, float, int]:
    """Mean of the displacements, (n, 2) mm, without outliers; their standard deviation along either coordinate, and their number."""
    middle_x, middle_y = np.median(shifts[:, 0]), np.median(shifts[:, 1])
    distance = np.sqrt((shifts[:, 0] - middle_x) ** 2 + (shifts[:, 1] - middle_y) ** 2)
    largest = max(_OUTLIER_MM, 5 * np.median(distance))
    mean, squares, kept = np.zeros(2), 0.0, 0
    for d in range(len(shifts)):
        if distance[d] <= largest:
            mean += shifts[d]
            kept += 1
    mean /= kept
    for d in range(len(shifts)):
        if distance[d] <= largest:
            squares += ((shifts[d] - mean) ** 2).sum()
    return mean, np.sqrt(squares / max(2 * kept - 2, 1)), kept


@njit(nogil=True)
def _coarse_scores(counts: Array, discs: Array, lens: Array, direction: Array, along: Array) -> Array:
    """Sum over the discs in view of their contrast, over the root of their number, for every displacement."""
    scores = np.zeros(len(along))
    for k in range(len(along)):
        total, in_view = 0.0, 0
        for d in range(len(discs)):
            x, y = discs[d, 0] + along[k] * direction[0], discs[d, 1] + along[k] * direction[1]
            contrast = _coarse_contrast(counts, x, y, discs[d, 2], lens)
            if not np.isnan(contrast):
                total += contrast
                in_view += 1
        if in_view > 0:
            scores[k] = abs(total) / np.sqrt(in_view)
    return scores


@njit(nogil=True)
def _coarse_contrast(counts: Array, x: float, y: float, radius: float, lens: Array) -> float:
    """Mean of eight pixels within a disc minus mean of eight around it, counts; NaN where not all of them are in view."""
    rows, columns = counts.shape
    inside, ring = 0.0, 0.0
    for a in range(_COARSE_POINTS):
        angle = a * 2 * np.pi / _COARSE_POINTS
        for zone in range(2):
            reach = _COARSE_RADII[zone] * radius
            c, r = project_point(x + reach * np.cos(angle), y + reach * np.sin(angle), lens)
            column, row = round(c), round(r)
            if not (0 <= column < columns and 0 <= row < rows):
                return np.nan
            if zone == 0:
                inside += counts[row, column]
            else:
                ring += counts[row, column]
    return (inside - ring) / _COARSE_POINTS


@njit(nogil=True)
def _displacements(
    counts: Array, discs: Array, bias_px: Array, lens: Array, sensor_to_plan: Array, size: tuple[float, float], shift: Array
) -> Array:  # fmt: skip
    """Displacements of the discs that are located near `shift`, (m, 2) mm: `discs.locate_disc` without robust fits."""
    displacements, located = np.zeros((len(discs), 2)), 0
    for d in range(len(discs)):
        column, row, found = _locate_disc(counts, discs[d], shift, lens, size)
        if found:
            x, y = locate_point(column - bias_px[d, 0], row - bias_px[d, 1], lens, sensor_to_plan)
            displacements[located, 0], displacements[located, 1] = x - discs[d, 0], y - discs[d, 1]
            located += 1
    return displacements[:located]


@njit(nogil=True, error_model="numpy")
def _locate_disc(
    counts: Array, disc: Array, shift: Array, lens: Array, size: tuple[float, float]
) -> tuple[float, float, bool]:
    """Centroid (column, row) px of one disc (x, y, radius) by repeated centroids of its coverage, and whether it is located."""
    height, width = counts.shape
    x, y, radius = disc[0] + shift[0], disc[1] + shift[1], disc[2]
    start_column, start_row = project_point(x, y, lens)
    cx, rx = project_point(x + 0.5, y, lens)
    cy, ry = project_point(x, y + 0.5, lens)
    column_by_x, row_by_x = 2 * (cx - start_column), 2 * (rx - start_row)
    column_by_y, row_by_y = 2 * (cy - start_column), 2 * (ry - start_row)
    determinant = column_by_x * row_by_y - column_by_y * row_by_x
    # mm/px: x by column, x by row, y by column, y by row.
    to_mm = (row_by_y / determinant, -column_by_y / determinant, -row_by_x / determinant, column_by_x / determinant)
    per_mm = (np.hypot(column_by_x, column_by_y), np.hypot(row_by_x, row_by_y))
    area_px = np.pi * radius * radius * abs(determinant)
    blur = 1.5 * max(np.hypot(row_by_y, row_by_x), np.hypot(column_by_y, column_by_x)) / abs(determinant)
    # Pixels within the core show the disc alone, those within the rim any part of it, those beyond the table around it, mm.
    core, rim, outer = max(radius - blur, 0.45 * radius), radius + blur, 2.2 * radius + blur
    half_columns, half_rows = outer * per_mm[0], outer * per_mm[1]
    column, row = start_column, start_row
    for _ in range(8):
        # Also where the lens shows no such place: what is not a number, or too large for an integer, gives no patch.
        if not (
            0 <= column - half_columns <= column + half_columns < width
            and 0 <= row - half_rows <= row + half_rows < height
        ):
            return column, row, False
        patch = _patch_around(column, row, outer, per_mm)
        if patch[0] < 0 or patch[1] < 0 or patch[2] >= width or patch[3] >= height:
            return column, row, False
        plane, contrast, noise = _contrast(counts, patch, (column, row), to_mm, (core, rim, outer, blur), disc, size)
        if not abs(contrast) > _LEAST_CONTRAST * noise:
            return column, row, False
        within_rim = _patch_around(column, row, rim, per_mm)
        total, moment_c, moment_r = _moments(counts, within_rim, (column, row), to_mm, rim, plane, contrast)
        if not 0.6 * area_px < total < 1.4 * area_px:
            return column, row, False
        column += moment_c / total
        row += moment_r / total
        # The next step would be less than a thousandth of a step as small as this.
        if abs(moment_c / total) + abs(moment_r / total) < 0.03:
            break
    near = abs(column - start_column) + abs(row - start_row) <= 2.5 * np.sqrt(area_px / np.pi)
    return column, row, near


@njit(nogil=True)
def _patch_around(column: float, row: float, reach_mm: float, per_mm: tuple[float, float]) -> tuple[int, int, int, int]:
    """First and last column and row (left, top, right, bottom) of the pixels within some distance on the plan."""
    half_columns, half_rows = int(reach_mm * per_mm[0]) + 2, int(reach_mm * per_mm[1]) + 2
    left, top = round(column) - half_columns, round(row) - half_rows
    return left, top, left + 2 * half_columns, top + 2 * half_rows


@njit(nogil=True)
def _contrast(
    counts: Array, patch: tuple[int, int, int, int], centre: tuple[float, float], to_mm: tuple[float, float, float, float],
    zones: tuple[float, float, float, float], disc: Array, size: tuple[float, float],
) -> tuple[Array, float, float]:  # fmt: skip
    """Plane through the ring around a disc, contrast of the disc to it, and noise of the ring; NaN where there are too few pixels."""
    core, rim, outer, blur = zones
    # Sums over the ring of the products of (1, column, row), and of these with the counts.
    su, sv, suu, suv, svv = 0.0, 0.0, 0.0, 0.0, 0.0
    ring_sum, ring_u, ring_v, squares, ring_n = 0.0, 0.0, 0.0, 0.0, 0
    core_sum, core_c, core_r, core_n = 0.0, 0.0, 0.0, 0
    # Unsigned: a signed index costs a comparison with zero for every pixel.
    for i in range(np.uint64(patch[1]), np.uint64(patch[3] + 1)):
        for j in range(np.uint64(patch[0]), np.uint64(patch[2] + 1)):
            u, v = np.int64(j) - centre[0], np.int64(i) - centre[1]
            x, y = to_mm[0] * u + to_mm[1] * v, to_mm[2] * u + to_mm[3] * v
            distance = x * x + y * y
            value = float(counts[i, j])
            if distance < core * core:
                core_sum, core_c, core_r, core_n = core_sum + value, core_c + u, core_r + v, core_n + 1
                continue
            in_ring = rim * rim < distance < outer * outer
            # By the listed place: the ring lies on the table wherever the table is.
            if in_ring and blur < disc[0] + x < size[0] - blur and blur < disc[1] + y < size[1] - blur:
                su, sv, suu, suv, svv = su + u, sv + v, suu + u * u, suv + u * v, svv + v * v
                ring_sum, ring_u, ring_v = ring_sum + value, ring_u + u * value, ring_v + v * value
                ring_n += 1
                squares += value * value
    normal = np.array([[ring_n, su, sv], [su, suu, suv], [sv, suv, svv]])
    right = np.array([ring_sum, ring_u, ring_v])
    if ring_n < 12 or core_n < 3:
        return right, np.nan, np.nan
    plane = np.linalg.solve(normal, right)
    noise = float(np.sqrt(max(squares - float(plane @ right), 0.0) / (ring_n - 3)))
    return plane, core_sum / core_n - (plane[0] + (plane[1] * core_c + plane[2] * core_r) / core_n), noise


@njit(nogil=True)
def _moments(
    counts: Array, patch: tuple[int, int, int, int], centre: tuple[float, float], to_mm: tuple[float, float, float, float],
    rim: float, plane: Array, contrast: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Sum and first moments (column, row) of the coverage of a disc, 1 within it and 0 around it."""
    total, moment_c, moment_r = 0.0, 0.0, 0.0
    for i in range(np.uint64(patch[1]), np.uint64(patch[3] + 1)):
        for j in range(np.uint64(patch[0]), np.uint64(patch[2] + 1)):
            u, v = np.int64(j) - centre[0], np.int64(i) - centre[1]
            x, y = to_mm[0] * u + to_mm[1] * v, to_mm[2] * u + to_mm[3] * v
            if x * x + y * y < rim * rim:
                coverage = (counts[i, j] - plane[0] - plane[1] * u - plane[2] * v) / contrast
                # The disc has a uniform temperature, the table around it a gradient: the contrast varies over the disc.
                coverage /= 1 - (plane[1] * u + plane[2] * v) / contrast
                total, moment_c, moment_r = total + coverage, moment_c + coverage * u, moment_r + coverage * v
    return total, moment_c, moment_r
