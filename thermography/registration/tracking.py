"""Where a moving table is in every frame: its discs found by the one registration, displaced."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.registration.plan import PlanGrid
from thermography.registration.projection import projected
from thermography.registration.register import Registration

#: Step of the coarse search along the axis, as part of the smallest disc's diameter.
COARSE_STEP = 0.25
#: Discs that disagree with the median by more than this (and by five times the median deviation) are left out, mm.
ODD_MM = 0.5
#: A place near that of the frame before is taken without a search if its discs agree to this, and so many of those in view are found.
SURE_MM, SURE_SHARE = 0.3, 0.7
#: Places of the coarse search that are looked at closely.
CANDIDATES = 5
#: A disc needs this many times the noise of one pixel as contrast.
LEAST_CONTRAST = 3.0


@dataclass(frozen=True)
class Tracker:
    """What the kernels need to know of plan, discs and lens, as plain arrays.

    Attributes
    ----------
    discs
        (n, 3): x, y, radius, mm.
    lens
        The projection as `thermography.registration.projection.Projection.as_array` gives it.
    direction
        Unit vector on the plan along which the table is displaced.
    size_mm
        Width and height of the plan.
    reach_mm
        How far the table may be displaced either way.
    registration
        Of the table where it stood when it was registered.
    bias_px
        By how much perspective shifts the centroid of every disc's image from the image of its centre, (n, 2): nearly the same
        wherever the table is.
    margin_px
        How far from the frame's edge a disc must lie to be found, (n, 2).
    common_mm, common_u_mm
        Displacements along the direction, and what the registration's own uncertainty adds there for all discs together.
    """

    discs: Array
    lens: Array
    direction: Array
    size_mm: tuple[float, float]
    reach_mm: float
    registration: Registration
    bias_px: Array
    margin_px: Array
    common_mm: Array
    common_u_mm: Array


@dataclass(frozen=True)
class TablePlace:
    """Displacement of the table in one frame, (x, y) mm on the plan, its standard uncertainty along both, and the discs used."""

    shift_mm: Array
    u_mm: float
    discs: int


def make_tracker(registration: Registration, grid: PlanGrid, direction: Array, *, reach_mm: float) -> Tracker:
    """Prepare the tracking of a table that is displaced along `direction` (plan) by up to `reach_mm` from where it was registered."""
    discs = np.array([(d.x_mm, d.y_mm, d.diameter_mm / 2) for d in registration.fiducials.values()])
    unit = np.asarray(direction, float) / np.hypot(*direction)
    along = np.linspace(-reach_mm, reach_mm, 31)
    places = discs[:, :2] + (along[:, None] * unit)[:, None, :]
    common = np.sqrt(np.mean(registration.position_u(places) ** 2, axis=1))
    size = (grid.width_mm, grid.height_mm)
    projection = registration.projection
    bias = projection.disc_centroids(discs[:, :2], discs[:, 2]) - projection.to_sensor(discs[:, :2])
    margin = 3 * np.linalg.norm(projection.jacobian(discs[:, :2]), axis=-1) * discs[:, 2:]
    return Tracker(
        discs, registration.projection.as_array, unit, size, reach_mm, registration, bias, margin, along, common
    )


def locate_table(counts: NDArray[np.uint16], tracker: Tracker, near_mm: Array | None = None) -> TablePlace | None:
    """Locate the table in one frame of counts (row, column).

    Parameters
    ----------
    counts
        Uncalibrated: contrast and place of the discs need no temperature.
    tracker
        From `make_tracker`.
    near_mm
        Displacement of the frame before; without it, or where it does not hold any more, the whole reach is searched.

    Returns
    -------
    TablePlace or None
        None where fewer than two discs show.
    """
    near = None if near_mm is None else _refined(counts, tracker, near_mm)
    if near is not None and near.u_mm < SURE_MM and near.discs >= SURE_SHARE * _in_view(counts, tracker, near.shift_mm):
        return near
    step = COARSE_STEP * 2 * float(tracker.discs[:, 2].min())
    along = np.arange(-tracker.reach_mm, tracker.reach_mm + step, step)
    scores = _coarse(counts, tracker.discs, tracker.lens, tracker.direction, along)
    peaks = np.flatnonzero((scores >= np.r_[-1.0, scores[:-1]]) & (scores >= np.r_[scores[1:], -1.0]))
    places = [near]
    for best in peaks[np.argsort(-scores[peaks])][:CANDIDATES]:
        places.append(_refined(counts, tracker, along[best] * tracker.direction))
    # Discs at equal distances pass for each other: the place at which the most agree, and agree best, is the right one.
    found = [place for place in places if place is not None]
    return max(found, key=lambda place: (place.u_mm < SURE_MM, place.discs, -place.u_mm), default=None)


def _in_view(counts: NDArray[np.uint16], tracker: Tracker, shift_mm: Array) -> int:
    """How many discs lie within the frame with the table displaced, a disc's width from its edge."""
    centres = tracker.discs[:, :2] + shift_mm
    places = tracker.registration.to_sensor(centres)
    inside = (places > tracker.margin_px) & (places < np.array(counts.shape[::-1]) - tracker.margin_px)
    return int(inside.all(axis=1).sum())


def _refined(counts: NDArray[np.uint16], tracker: Tracker, near_mm: Array) -> TablePlace | None:
    found = _locate(counts, tracker.discs, tracker.lens, tracker.size_mm, np.asarray(near_mm, float), LEAST_CONTRAST)
    seen = np.flatnonzero(found[:, 2] > 0)
    if len(seen) < 2:
        return None
    shifts = tracker.registration.to_plan(found[seen, :2] - tracker.bias_px[seen]) - tracker.discs[seen, :2]
    median = np.median(shifts, axis=0)
    distance = np.linalg.norm(shifts - median, axis=1)
    kept = distance <= max(ODD_MM, 5 * float(np.median(distance)))
    if kept.sum() < 2:
        return None
    mean = shifts[kept].mean(axis=0)
    scatter = np.sqrt(((shifts[kept] - mean) ** 2).sum() / (2 * kept.sum() - 2))
    common = np.interp(mean @ tracker.direction, tracker.common_mm, tracker.common_u_mm)
    return TablePlace(mean, float(np.hypot(scatter / np.sqrt(kept.sum()), common)), int(kept.sum()))


@numba.njit(cache=True, nogil=True)
def _coarse(counts: Array, discs: Array, lens: Array, direction: Array, along: Array) -> Array:
    """Contrast of the discs' insides to their rings, added with its sign over the discs in view, for every displacement."""
    scores = np.zeros(len(along))
    rows, columns = counts.shape
    for k in range(len(along)):
        total, seen = 0.0, 0
        for d in range(len(discs)):
            x, y, radius = discs[d, 0] + along[k] * direction[0], discs[d, 1] + along[k] * direction[1], discs[d, 2]
            inside, ring, points = 0.0, 0.0, 0
            for a in range(8):
                angle = a * np.pi / 4
                for share, sign in ((0.5, 1), (1.5, -1)):
                    c, r = projected(x + share * radius * np.cos(angle), y + share * radius * np.sin(angle), lens)
                    column, row = round(c), round(r)
                    if 0 <= column < columns and 0 <= row < rows:
                        points += 1
                        if sign > 0:
                            inside += counts[row, column]
                        else:
                            ring += counts[row, column]
            if points == 16:
                total += (inside - ring) / 8
                seen += 1
        if seen > 0:
            scores[k] = abs(total) / np.sqrt(seen)
    return scores


@numba.njit(cache=True, nogil=True)
def _locate(counts: Array, discs: Array, lens: Array, size: tuple[float, float], shift: Array, least: float) -> Array:
    """Centroid (column, row) of every disc and whether it was found, (discs, 3); as `discs.locate_disc`, without its robust fits."""
    found = np.zeros((len(discs), 3))
    height, width = counts.shape
    for d in range(len(discs)):
        x, y, radius = discs[d, 0] + shift[0], discs[d, 1] + shift[1], discs[d, 2]
        c0, r0 = projected(x, y, lens)
        cx, rx = projected(x + 0.5, y, lens)
        cy, ry = projected(x, y + 0.5, lens)
        j00, j10, j01, j11 = 2 * (cx - c0), 2 * (rx - r0), 2 * (cy - c0), 2 * (ry - r0)
        det = j00 * j11 - j01 * j10
        blur = 1.5 * max(np.hypot(j11, j10), np.hypot(j01, j00)) / abs(det)
        rim, outer = radius + blur, 2.2 * radius + blur
        half_c, half_r = int(outer * np.hypot(j00, j01)) + 2, int(outer * np.hypot(j10, j11)) + 2
        column, row = c0, r0
        for _ in range(8):
            left, top = round(column) - half_c, round(row) - half_r
            if left < 0 or top < 0 or left + 2 * half_c >= width or top + 2 * half_r >= height:
                found[d, 2] = 0
                break
            patch = (left, top, left + 2 * half_c, top + 2 * half_r)
            radii = (max(radius - blur, 0.45 * radius), rim, outer)
            table = (discs[d, 0], discs[d, 1], size[0], size[1], blur)
            plane, contrast, noise = _contrast(counts, patch, (column, row), (j00, j01, j10, j11), radii, table)
            if not abs(contrast) > least * noise:
                found[d, 2] = 0
                break
            total, moment_c, moment_r = _moments(
                counts, patch, (column, row), (j00, j01, j10, j11), rim, plane, contrast
            )
            area = np.pi * radius * radius * abs(det)
            if not 0.6 * area < total < 1.4 * area:
                found[d, 2] = 0
                break
            column += moment_c / total
            row += moment_r / total
            found[d, 0], found[d, 1], found[d, 2] = column, row, 1
            # What is left of a step this small is less than a thousandth of it.
            if abs(moment_c / total) + abs(moment_r / total) < 0.03:
                break
        if abs(column - c0) + abs(row - r0) > 2.5 * radius * np.sqrt(abs(det)):
            found[d, 2] = 0
    return found


@numba.njit(cache=True, nogil=True)
def _contrast(
    counts: Array,
    patch: tuple[int, int, int, int],
    centre: tuple[float, float],
    jacobian: tuple[float, float, float, float],
    radii: tuple[float, float, float],
    table: tuple[float, float, float, float, float],
) -> tuple[Array, float, float]:
    """Plane through the ring around a disc, contrast of the disc to it, and noise of the ring; NaN where there are too few pixels."""
    j00, j01, j10, j11 = jacobian
    det = j00 * j11 - j01 * j10
    cut, rim, outer = radii
    x0, y0, width, height, blur = table
    normal, right = np.zeros((3, 3)), np.zeros(3)
    inner_sum, inner_c, inner_r, inner_n, ring_n, squares = 0.0, 0.0, 0.0, 0, 0, 0.0
    for i in range(patch[1], patch[3] + 1):
        for j in range(patch[0], patch[2] + 1):
            u, v = j - centre[0], i - centre[1]
            px, py = (j11 * u - j01 * v) / det, (j00 * v - j10 * u) / det
            distance = px * px + py * py
            value = float(counts[i, j])
            if distance < cut * cut:
                inner_sum, inner_c, inner_r, inner_n = inner_sum + value, inner_c + u, inner_r + v, inner_n + 1
                continue
            in_ring = rim * rim < distance < outer * outer
            if in_ring and blur < x0 + px < width - blur and blur < y0 + py < height - blur:
                basis = (1.0, u, v)
                for a in range(3):
                    right[a] += basis[a] * value
                    for b in range(3):
                        normal[a, b] += basis[a] * basis[b]
                ring_n += 1
                squares += value * value
    if ring_n < 12 or inner_n < 3:
        return right, np.nan, np.nan
    plane = np.linalg.solve(normal, right)
    noise = float(np.sqrt(max(squares - float(plane @ right), 0.0) / (ring_n - 3)))
    return plane, inner_sum / inner_n - (plane[0] + (plane[1] * inner_c + plane[2] * inner_r) / inner_n), noise


@numba.njit(cache=True, nogil=True)
def _moments(
    counts: Array,
    patch: tuple[int, int, int, int],
    centre: tuple[float, float],
    jacobian: tuple[float, float, float, float],
    rim: float,
    plane: Array,
    contrast: float,
) -> tuple[float, float, float]:
    """Sum and first moments of the coverage of a disc, 1 within it and 0 around it."""
    j00, j01, j10, j11 = jacobian
    det = j00 * j11 - j01 * j10
    total, moment_c, moment_r = 0.0, 0.0, 0.0
    for i in range(patch[1], patch[3] + 1):
        for j in range(patch[0], patch[2] + 1):
            u, v = j - centre[0], i - centre[1]
            px, py = (j11 * u - j01 * v) / det, (j00 * v - j10 * u) / det
            if px * px + py * py < rim * rim:
                part = (counts[i, j] - plane[0] - plane[1] * u - plane[2] * v) / contrast
                # The disc has one temperature; the table around it a slope. Coverage is taken against their difference.
                part /= 1 - (plane[1] * u + plane[2] * v) / contrast
                total, moment_c, moment_r = total + part, moment_c + part * u, moment_r + part * v
    return total, moment_c, moment_r
