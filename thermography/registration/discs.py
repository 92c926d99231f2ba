"""Disc fiducials in a thermogram: detected anywhere in the frame, then located to hundredths of a pixel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography.common import MAD_TO_SIGMA, Array, ThermographyError, scatter_by_median
from thermography.registration.plan import Fiducial, PlanGrid

#: Widths of the structuring element, px; each width detects discs with diameters of 0.2 to 0.8 of it.
_KERNEL_WIDTHS_PX = (15, 29, 57, 113)
#: A spot is accepted as a disc if its area differs by less than this share from that of the ellipse with its second moments.
_ELLIPSE_TOLERANCE = 0.12
#: A disc whose contrast is less than this many times the noise of a pixel is not located: its centroid would err by tenths of a pixel.
_LEAST_CONTRAST = 2.0
#: Spots with a larger ratio of axes are not accepted as discs.
_LARGEST_ASPECT = 4.0
#: Standard uncertainty of the centroid of a detected spot, before the disc is located, px.
SPOT_U_PX = 0.2
#: Smallest area of a spot, px.
_LEAST_AREA_PX = 12


@dataclass(frozen=True)
class LocatedDisc:
    """An elliptic spot detected in a frame, or a disc fiducial located there: centroid and its standard uncertainty, px; number of pixels,
    and temperature against the surroundings, K, NaN where not measured.
    """

    column_px: float
    row_px: float
    u_px: float
    area_px: float
    contrast_K: float


def detect_discs(temperature: NDArray[np.floating], *, limit: int = 40) -> list[LocatedDisc]:
    """Detect elliptic spots of unknown position and size that are colder or warmer than their surroundings."""
    smooth = cv2.GaussianBlur(np.nan_to_num(temperature).astype(np.float32), (0, 0), 0.8)
    found: list[tuple[bool, LocatedDisc]] = []
    for width in _KERNEL_WIDTHS_PX:
        kernel = np.ones((width, width), np.uint8)
        black_hat = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel) - smooth
        white_hat = smooth - cv2.morphologyEx(smooth, cv2.MORPH_OPEN, kernel)
        for top_hat, sign in ((black_hat, -1.0), (white_hat, 1.0)):
            found.extend(_spots_in(top_hat, sign, width))
    # Of one spot at several widths that with the strongest contrast is kept, and one that is cut only where no other is whole.
    found.sort(key=lambda item: (item[0], -abs(item[1].contrast_K)))
    distinct: list[LocatedDisc] = []
    for _, spot in found:
        reach = 0.6 * np.sqrt(spot.area_px / np.pi)
        if all(np.hypot(spot.column_px - s.column_px, spot.row_px - s.row_px) > reach for s in distinct):
            distinct.append(spot)
    return sorted(distinct, key=lambda spot: -abs(spot.contrast_K))[:limit]


def _spots_in(top_hat: NDArray[np.float32], sign: float, width: int) -> list[tuple[bool, LocatedDisc]]:
    """Elliptic spots of a top-hat transform with a structuring element of `width` px, and whether the noise cuts them above half height."""
    noise = scatter_by_median(top_hat)
    least = float(np.median(top_hat)) + 6 * max(noise, 1e-3)
    marked = (top_hat > least).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(marked, connectivity=4)
    spots = []
    for label in range(1, count):
        left, top, w, h, area = boxes[label]
        if area < _LEAST_AREA_PX or max(w, h) > width:
            continue
        window = (slice(top, top + h), slice(left, left + w))
        values = np.where(labels[window] == label, top_hat[window], 0.0)
        peak = float(np.percentile(values[values > 0], 80))
        core = values > peak / 2
        spot = None if _is_cut(core, left, top, top_hat.shape) else _ellipse(core, sign * peak)
        if spot is not None:
            placed = replace(spot, column_px=spot.column_px + left, row_px=spot.row_px + top)
            spots.append((least > peak / 2, placed))
    return spots


def _is_cut(core: NDArray[np.bool_], left: int, top: int, shape: tuple[int, ...]) -> bool:
    """Whether the frame's edge cuts a spot above half its height; below, the blur of a whole disc may reach it."""
    rows, columns = np.nonzero(core)
    return bool(
        rows.min() + top == 0
        or columns.min() + left == 0
        or rows.max() + top == shape[0] - 1
        or columns.max() + left == shape[1] - 1
    )


def _ellipse(mask: NDArray[np.bool_], contrast_K: float) -> LocatedDisc | None:
    """The mask as a spot, if its area is that of the ellipse with the same second moments."""
    rows, columns = np.nonzero(mask)
    area = len(rows)
    if area < _LEAST_AREA_PX:
        return None
    # A square pixel has a variance of 1/12 px2 of its own, which matters for small discs.
    axes = np.linalg.eigvalsh(np.cov(np.stack([columns, rows]), bias=True) + np.eye(2) / 12)
    expected = 4 * np.pi * np.sqrt(axes[0] * axes[1])
    if abs(expected / area - 1) > _ELLIPSE_TOLERANCE or np.sqrt(axes[1] / axes[0]) > _LARGEST_ASPECT:
        return None
    return LocatedDisc(float(columns.mean()), float(rows.mean()), SPOT_U_PX, float(area), contrast_K)


def locate_disc(
    temperature: NDArray[np.floating],
    fiducial: Fiducial,
    grid: PlanGrid,
    predicted_px: Array,
    jacobian: Array,
    *,
    reach_px: float = 3.0,
) -> LocatedDisc | str:
    """Locate a disc near its predicted position by the centroid of its coverage, from 0 (table) to 1 (disc) in every pixel."""
    radius_mm = fiducial.diameter_mm / 2
    to_mm = np.linalg.inv(jacobian)
    half = np.ceil(2.3 * radius_mm * np.linalg.norm(jacobian, axis=1)).astype(int) + 1
    blur_mm = 1.5 * float(np.linalg.norm(to_mm, 2))
    centre = np.asarray(predicted_px, float)
    for _ in range(12):
        # A place that is projected to infinity is no whole number.
        first, last = np.round(centre) - half, np.round(centre) + half
        if not ((first >= 0).all() and (last < temperature.shape[::-1]).all()):
            return "lies at the edge of the frame"
        (left, top), (right, bottom) = first.astype(int), last.astype(int) + 1
        columns, rows = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1)
        plan_mm = offsets @ to_mm.T + (fiducial.x_mm, fiducial.y_mm)
        distance = np.hypot(plan_mm[..., 0] - fiducial.x_mm, plan_mm[..., 1] - fiducial.y_mm)
        result = _coverage_centroid(
            temperature[top:bottom, left:right],
            offsets,
            distance,
            radius_mm,
            blur_mm,
            grid.contains(plan_mm, margin_mm=blur_mm),
        )
        if isinstance(result, str):
            return result
        shift, located = result
        centre = centre + shift
        if np.hypot(*(centre - predicted_px)) > reach_px:
            return f"no disc within {reach_px:.1f} px of where it should be"
        if np.hypot(*shift) < 1e-3:
            break
    area = np.pi * radius_mm**2 * abs(np.linalg.det(jacobian))
    if abs(located.area_px / area - 1) > 0.35:
        return f"its image has {located.area_px / area:.2f} times the area of a disc of {fiducial.diameter_mm:g} mm"
    return LocatedDisc(float(centre[0]), float(centre[1]), located.u_px, located.area_px, located.contrast_K)


def _coverage_centroid(
    values: NDArray[np.floating],
    offsets: Array,
    distance: Array,
    radius_mm: float,
    blur_mm: float,
    on_table: NDArray[np.bool_],
) -> tuple[Array, LocatedDisc] | str:
    """Shift (column, row) px of the coverage's centroid against the patch's centre, and its uncertainty, area and contrast."""
    around = (distance > radius_mm + blur_mm) & (distance < 2.2 * radius_mm + blur_mm) & on_table
    inside = distance < max(radius_mm - blur_mm, 0.45 * radius_mm)
    counted = distance < radius_mm + blur_mm
    if around.sum() < 12 or inside.sum() < 3:
        return "is too small in the frame or too near the plan's edge"
    basis = np.concatenate([offsets, np.ones((*distance.shape, 1))], axis=-1)
    table, noise = _robust_plane(basis, values, around)
    if inside.sum() >= 20:
        disc, _ = _robust_plane(basis, values, inside)
    else:
        disc = np.full(values.shape, np.median(values[inside]))
    contrast = float((disc - table)[inside].mean())
    if abs(contrast) < max(_LEAST_CONTRAST * noise, 1e-3):
        return f"has no contrast ({contrast:.3f} K with {noise:.3f} K of noise)"
    step = disc - table
    # Extrapolated to the rim, the two planes may meet: the denominator keeps its sign and 30 % of the contrast.
    least = 0.3 * abs(contrast)
    safe = np.where(np.sign(step) == np.sign(contrast), np.maximum(np.abs(step), least), least) * np.sign(contrast)
    coverage = np.where(counted, (values - table) / safe, 0.0)
    area = float(coverage.sum())
    if area <= 0:
        return "has no contrast"
    shift = (coverage[..., None] * offsets).sum(axis=(0, 1)) / area
    moments = (offsets[counted] ** 2).sum(axis=0)
    u_px = noise / abs(contrast) * float(np.sqrt(moments.mean())) / area
    return shift, LocatedDisc(np.nan, np.nan, u_px, area, contrast)


def _robust_plane(basis: Array, values: NDArray[np.floating], mask: NDArray[np.bool_]) -> tuple[Array, float]:
    """Fit a plane to the masked pixels without residuals above four standard deviations; the plane everywhere, and the noise."""
    kept = mask.copy()
    for _ in range(3):
        coefficients = np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0]
        plane = basis @ coefficients
        residual = values - plane
        # Residuals of a fit with a constant term: their deviation is taken about zero.
        noise = MAD_TO_SIGMA * float(np.median(np.abs(residual[kept])))
        keep = mask & (np.abs(residual) <= max(4 * noise, 1e-9))
        if keep.sum() < 6 or (keep == kept).all():
            break
        kept = keep
    return plane, noise


# ArUco markers: they identify the table plan and hint where its discs are; the discs alone determine the
# registration.

#: 50 patterns of 4 x 4 squares, the coarsest dictionary of OpenCV: thermograms have few pixels.
DICTIONARY = cv2.aruco.DICT_4X4_50
#: Hints come from an affine map of the plan, which three markers determine. It neglects perspective and serves as a hint only.
_LEAST_MARKERS = 3
#: Widths of the surroundings against which the contrast is stretched, px: a third and two thirds of a marker of 30 px.
_SURROUNDINGS_PX = (10.0, 20.0)
#: Grey levels per standard deviation of the surroundings, of 256, and the blur before, px.
_GREY_PER_DEVIATION, _BLUR_PX = 60.0, 0.7
#: Contrast below this many standard deviations of the noise is not stretched any further.
_LEAST_DEVIATION = 2.0


class MarkerError(ThermographyError):
    """The markers in the frame belong to another plan; the message names both and the remedy."""


def detect_markers(temperature: Array) -> dict[int, Array]:
    """Detect ArUco markers in a thermogram, dark on bright or bright on dark."""
    parameters = cv2.aruco.DetectorParameters()
    # Paint of low emissivity swaps dark and bright. A pattern with a wrong square is rejected rather than corrected to a similar marker.
    parameters.detectInvertedMarker = True
    parameters.errorCorrectionRate = 0.0
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
    detected: dict[int, Array] = {}
    for picture in _pictures(np.nan_to_num(temperature, nan=float(np.nanmean(temperature)))):
        quadrilaterals, numbers, _ = detector.detectMarkers(picture)
        if numbers is not None:
            for number, corners in zip(numbers.ravel(), quadrilaterals, strict=True):
                detected.setdefault(int(number), corners.reshape(4, 2).mean(axis=0))
    return detected


def _pictures(temperature: Array) -> Iterator[NDArray[np.uint8]]:
    """The thermogram in 256 grey levels: stretched as a whole, then against its surroundings, where a tenth of a kelvin shows."""
    low, high = np.percentile(temperature, (1, 99))
    yield np.round(255 * np.clip((temperature - low) / max(high - low, 1e-6), 0, 1)).astype(np.uint8)
    smooth = cv2.GaussianBlur(temperature.astype(np.float32), (0, 0), _BLUR_PX)
    # Neighbouring pixels differ by noise, but for the few at edges.
    noise = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(smooth, axis=1)))) / np.sqrt(2)
    for width in _SURROUNDINGS_PX:
        lifted = smooth - cv2.GaussianBlur(smooth, (0, 0), width)
        deviation = np.sqrt(cv2.GaussianBlur(lifted**2, (0, 0), width))
        grey = 128 + _GREY_PER_DEVIATION * lifted / np.maximum(deviation, max(_LEAST_DEVIATION * noise, 1e-6))
        yield np.clip(grey, 0, 255).astype(np.uint8)


def identify_plan(temperature: Array, fiducials: Sequence[Fiducial]) -> list[Fiducial]:
    """Compare the markers in a frame with those of the plan, and derive hints for the discs from them."""
    discs = [fiducial for fiducial in fiducials if fiducial.marker is None]
    listed = {fiducial.marker: fiducial for fiducial in fiducials if fiducial.marker is not None}
    if not listed:
        return discs
    detected = detect_markers(temperature)
    common = sorted(listed.keys() & detected.keys())
    if detected and not common:
        raise MarkerError(
            f"the frames show the markers {', '.join(map(str, sorted(detected)))}, "
            f"the plan lists {', '.join(map(str, sorted(listed)))}: this is another table; name its fiducial file"
        )
    if len(common) < _LEAST_MARKERS:
        return discs
    plan = np.array([(listed[number].x_mm, listed[number].y_mm, 1.0) for number in common])
    affine, _, rank, _ = np.linalg.lstsq(plan, np.array([detected[number] for number in common]))
    if rank < 3:
        return discs
    hints = np.array([(disc.x_mm, disc.y_mm, 1.0) for disc in discs]) @ affine
    return [
        replace(disc, column_px=float(column), row_px=float(row)) if disc.hint_px is None else disc
        for disc, (column, row) in zip(discs, hints, strict=True)
    ]
