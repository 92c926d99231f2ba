"""Position of a moving table in every frame: the discs of one registration, located displaced along the axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
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
    """A registration prepared for locating the table displaced along one direction.

    Attributes
    ----------
    registration : Registration
        Of the table in one position.
    discs : (n, 3) ndarray, mm
        x, y and radius of the fiducials on the plan.
    lens : (16,) ndarray
        The projection, as `thermography.registration.projection.Projection.as_array`.
    direction : (2,) ndarray
        Unit vector on the plan along which the table is displaced.
    size_mm : (width, height), mm
        Of the plan.
    reach_mm : float, mm
        Largest displacement either way.
    bias_px : (n, 2) ndarray, px
        Perspective shift of every disc's centroid from the image of its centre: nearly the same for every displacement.
    margin_px : (n, 2) ndarray, px
        Distance of a disc from the frame's edge below which it is not located.
    common_mm, common_u_mm : (m,) ndarray, mm
        Displacements along the direction, and the standard uncertainty that the registration adds there to all discs together.
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
    """Position of the table in one frame.

    Attributes
    ----------
    shift_mm : (2,) ndarray, mm
        Displacement (x, y) on the plan from the registered position.
    u_mm : float, mm
        Standard uncertainty of the displacement along either coordinate.
    discs : int
        Number of discs used.
    scatter_u_mm : float, mm
        The part of `u_mm` that the scatter of the discs shows, without what the registration contributes to all of them.
    """

    shift_mm: Array
    u_mm: float
    discs: int
    scatter_u_mm: float


def make_tracker(registration: Registration, grid: PlanGrid, direction: Array, *, reach_mm: float) -> TableTracker:
    """Prepare the tracking of a table that moves along one direction.

    Parameters
    ----------
    registration : Registration
        Of the table in one position.
    grid : PlanGrid
        The plan.
    direction : (2,) ndarray
        Direction (x, y) on the plan along which the table is displaced, of any length.
    reach_mm : float, mm
        Largest displacement either way from the registered position.

    Returns
    -------
    TableTracker
    """
    discs = np.array([(d.x_mm, d.y_mm, d.diameter_mm / 2) for d in registration.fiducials.values()])
    centres, radii = discs[:, :2], discs[:, 2:]
    unit = np.asarray(direction, float) / np.hypot(*direction)
    along = np.linspace(-reach_mm, reach_mm, 31)
    displaced = centres + (along[:, None] * unit)[:, None, :]
    projection = registration.projection
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
        common_u_mm=_common_u(registration, displaced),
    )


def _common_u(registration: Registration, places_mm: Array) -> Array:
    """Standard uncertainty that the discs of one displacement share, root mean square over those in view, (m,) mm, for (m, n, 2) places."""
    places = registration.to_sensor(places_mm)
    in_view = ((places >= 0) & (places <= np.array(registration.shape[::-1]) - 1.0)).all(axis=-1)
    # Without any disc in view the table is not located there, and any value serves.
    in_view |= ~np.any(in_view, axis=1)[:, None]
    common: Array = np.sqrt(np.mean(registration.position_u(places_mm) ** 2, axis=1, where=in_view))
    return common


def locate_table(
    counts: NDArray[np.uint16], tracker: TableTracker, previous_mm: Array | None = None
) -> TablePosition | None:
    """Locate the table in one frame.

    Parameters
    ----------
    counts : (row, column) ndarray of uint16
        Raw counts: the contrast and the position of the discs need no calibration.
    tracker : TableTracker
        From `make_tracker`.
    previous_mm : (2,) ndarray, mm, or None
        Displacement in the previous frame, tried first; None, or a displacement that does not hold any more, searches the whole
        reach.

    Returns
    -------
    TablePosition or None
        None where fewer than two discs are located.
    """
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
        tracker.size_mm, np.asarray(predicted_mm, float), _LEAST_CONTRAST,
    )  # fmt: skip
    if len(shifts) < 2:
        return None
    mean, scatter, kept = _agreement(shifts)
    if kept < 2:
        return None
    common = np.interp(mean @ tracker.direction, tracker.common_mm, tracker.common_u_mm)
    own = scatter / math.sqrt(kept)
    return TablePosition(mean, math.hypot(own, common), kept, own)


@numba.njit(cache=True)
def _discs_in_view(discs: Array, shift: Array, margin_px: Array, lens: Array, shape: tuple[int, int]) -> int:
    """Number of discs that lie far enough within the frame when the table is displaced."""
    inside = 0
    for d in range(len(discs)):
        column, row = project_point(discs[d, 0] + shift[0], discs[d, 1] + shift[1], lens)
        across, down = margin_px[d, 0], margin_px[d, 1]
        inside += across < column < shape[1] - across and down < row < shape[0] - down
    return inside


@numba.njit(cache=True)
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


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
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


class _DiscView(NamedTuple):
    """A disc on the sensor near its predicted position: its local affine map, and its zones on the plan around its centre.

    The inverse Jacobian is (x by column, x by row; y by column, y by row), mm/px. Pixels within `core_mm` show the disc alone, those
    within `rim_mm` any part of it, those between `rim_mm` and `outer_mm` the table around it. `x_mm`, `y_mm` is the disc's listed
    position: the ring lies on the table wherever the table is.
    """

    column: float
    row: float
    x_by_column: float
    x_by_row: float
    y_by_column: float
    y_by_row: float
    area_px: float
    radius_mm: float
    core_mm: float
    rim_mm: float
    outer_mm: float
    blur_mm: float
    columns_per_mm: float
    rows_per_mm: float
    x_mm: float
    y_mm: float


class _Patch(NamedTuple):
    """First and last pixel of a window of the sensor, and the centre to which offsets are taken."""

    left: int
    top: int
    right: int
    bottom: int
    column: float
    row: float


@numba.njit(cache=True, nogil=True)
def _displacements(
    counts: Array, discs: Array, bias_px: Array, lens: Array, sensor_to_plan: Array, size: tuple[float, float], shift: Array,
    least_contrast: float,
) -> Array:  # fmt: skip
    """Displacements of the discs that are located near `shift`, (m, 2) mm: `discs.locate_disc` without robust fits."""
    displacements, located = np.zeros((len(discs), 2)), 0
    for d in range(len(discs)):
        column, row, found = _locate_disc(counts, _disc_view(discs[d], shift, lens), size, least_contrast)
        if found:
            x, y = locate_point(column - bias_px[d, 0], row - bias_px[d, 1], lens, sensor_to_plan)
            displacements[located, 0], displacements[located, 1] = x - discs[d, 0], y - discs[d, 1]
            located += 1
    return displacements[:located]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _disc_view(disc: Array, shift: Array, lens: Array) -> _DiscView:
    """A disc (x, y, radius) of a table displaced by `shift`, mm, as the lens images it."""
    x, y, radius = disc[0] + shift[0], disc[1] + shift[1], disc[2]
    c0, r0 = project_point(x, y, lens)
    cx, rx = project_point(x + 0.5, y, lens)
    cy, ry = project_point(x, y + 0.5, lens)
    column_by_x, row_by_x, column_by_y, row_by_y = 2 * (cx - c0), 2 * (rx - r0), 2 * (cy - c0), 2 * (ry - r0)
    determinant = column_by_x * row_by_y - column_by_y * row_by_x
    blur = 1.5 * max(np.hypot(row_by_y, row_by_x), np.hypot(column_by_y, column_by_x)) / abs(determinant)
    outer = 2.2 * radius + blur
    return _DiscView(
        c0, r0, row_by_y / determinant, -column_by_y / determinant, -row_by_x / determinant, column_by_x / determinant,
        np.pi * radius * radius * abs(determinant), radius, max(radius - blur, 0.45 * radius), radius + blur, outer, blur,
        np.hypot(column_by_x, column_by_y), np.hypot(row_by_x, row_by_y), disc[0], disc[1],
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _locate_disc(
    counts: Array, view: _DiscView, size: tuple[float, float], least_contrast: float
) -> tuple[float, float, bool]:
    """Centroid (column, row) px of one disc by repeated centroids of its coverage, and whether it is located."""
    height, width = counts.shape
    column, row = view.column, view.row
    half_columns, half_rows = view.outer_mm * view.columns_per_mm, view.outer_mm * view.rows_per_mm
    for _ in range(8):
        # Also where the lens shows no such place: what is not a number, or too large for an integer, gives no patch.
        if not (
            0 <= column - half_columns <= column + half_columns < width
            and 0 <= row - half_rows <= row + half_rows < height
        ):
            return column, row, False
        patch = _patch_around(column, row, view.outer_mm, view)
        if patch.left < 0 or patch.top < 0 or patch.right >= width or patch.bottom >= height:
            return column, row, False
        plane, contrast, noise = _contrast(counts, patch, view, size)
        if not abs(contrast) > least_contrast * noise:
            return column, row, False
        within_rim = _patch_around(column, row, view.rim_mm, view)
        total, moment_c, moment_r = _moments(counts, within_rim, view, plane, contrast)
        if not 0.6 * view.area_px < total < 1.4 * view.area_px:
            return column, row, False
        column += moment_c / total
        row += moment_r / total
        # The next step would be less than a thousandth of a step as small as this.
        if abs(moment_c / total) + abs(moment_r / total) < 0.03:
            break
    near = abs(column - view.column) + abs(row - view.row) <= 2.5 * np.sqrt(view.area_px / np.pi)
    return column, row, near


@numba.njit(cache=True, nogil=True)
def _patch_around(column: float, row: float, reach_mm: float, view: _DiscView) -> _Patch:
    """The pixels around a centre that lie within some distance on the plan."""
    half_columns, half_rows = int(reach_mm * view.columns_per_mm) + 2, int(reach_mm * view.rows_per_mm) + 2
    left, top = round(column) - half_columns, round(row) - half_rows
    return _Patch(left, top, left + 2 * half_columns, top + 2 * half_rows, column, row)


@numba.njit(cache=True, nogil=True)
def _plan_offset(view: _DiscView, u: float, v: float) -> tuple[float, float]:
    """Offset (x, y) mm on the plan for an offset (column, row) px on the sensor."""
    return view.x_by_column * u + view.x_by_row * v, view.y_by_column * u + view.y_by_row * v


@numba.njit(cache=True, nogil=True)
def _contrast(counts: Array, patch: _Patch, view: _DiscView, size: tuple[float, float]) -> tuple[Array, float, float]:
    """Plane through the ring around a disc, contrast of the disc to it, and noise of the ring; NaN where there are too few pixels."""
    core, rim, outer, blur = view.core_mm, view.rim_mm, view.outer_mm, view.blur_mm
    # Sums over the ring of the products of (1, column, row), and of these with the counts.
    su, sv, suu, suv, svv = 0.0, 0.0, 0.0, 0.0, 0.0
    ring_sum, ring_u, ring_v, squares, ring_n = 0.0, 0.0, 0.0, 0.0, 0
    core_sum, core_c, core_r, core_n = 0.0, 0.0, 0.0, 0
    # Unsigned: a signed index costs a comparison with zero for every pixel.
    for i in range(np.uint64(patch.top), np.uint64(patch.bottom + 1)):
        for j in range(np.uint64(patch.left), np.uint64(patch.right + 1)):
            u, v = np.int64(j) - patch.column, np.int64(i) - patch.row
            x, y = _plan_offset(view, u, v)
            distance = x * x + y * y
            value = float(counts[i, j])
            if distance < core * core:
                core_sum, core_c, core_r, core_n = core_sum + value, core_c + u, core_r + v, core_n + 1
                continue
            in_ring = rim * rim < distance < outer * outer
            if in_ring and blur < view.x_mm + x < size[0] - blur and blur < view.y_mm + y < size[1] - blur:
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


@numba.njit(cache=True, nogil=True)
def _moments(
    counts: Array, patch: _Patch, view: _DiscView, plane: Array, contrast: float
) -> tuple[float, float, float]:
    """Sum and first moments (column, row) of the coverage of a disc, 1 within it and 0 around it."""
    total, moment_c, moment_r = 0.0, 0.0, 0.0
    for i in range(np.uint64(patch.top), np.uint64(patch.bottom + 1)):
        for j in range(np.uint64(patch.left), np.uint64(patch.right + 1)):
            u, v = np.int64(j) - patch.column, np.int64(i) - patch.row
            x, y = _plan_offset(view, u, v)
            if x * x + y * y < view.rim_mm * view.rim_mm:
                coverage = (counts[i, j] - plane[0] - plane[1] * u - plane[2] * v) / contrast
                # The disc has a uniform temperature, the table around it a gradient: the contrast varies over the disc.
                coverage /= 1 - (plane[1] * u + plane[2] * v) / contrast
                total, moment_c, moment_r = total + coverage, moment_c + coverage * u, moment_r + coverage * v
    return total, moment_c, moment_r
