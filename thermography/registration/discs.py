"""Disc fiducials in a thermogram: detected anywhere in the frame, then located to hundredths of a pixel."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import scipy
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
#: Standard deviation of the logarithm of the size of discs about the listed one; least standard deviations of the logarithm of the edge
#: spread and of the share of the slope among the discs of one picture, whose distance and reflections differ.
_SIZE_U, _LEAST_SPREAD_U, _LEAST_SHARE_U = 0.3, 0.05, 0.1
#: Extent of the table around a disc that takes part in its fit, in radii, beyond which the blur adds three edge spreads in quadrature.
_RING = 2.2
#: Share of the contrast by which table and disc may miss their planes without being outliers: pixels are squares, the field is curved.
_MODEL_ERROR = 0.02
#: Largest number of steps of the fit of a disc.
_MOST_STEPS = 15
#: Largest relative difference of the area of a disc from the listed one.
_LARGEST_AREA_ERROR = 0.35
#: Smallest area of a spot, px.
_LEAST_AREA_PX = 12


@dataclass(frozen=True)
class LocatedDisc:
    """An elliptic spot detected in a frame, or a disc fiducial located there: centroid and its standard uncertainty, px; number of pixels,
    temperature against the surroundings, K, and edge spread (standard deviation of the blur, the pixel's own included) with its
    standard uncertainty, px; NaN where not measured. `slope_share` is that of `DiscOptics`.
    """

    column_px: float
    row_px: float
    u_px: float
    area_px: float
    contrast_K: float
    spread_px: float = np.nan
    spread_u_px: float = np.nan
    slope_share: float = np.nan
    slope_share_u: float = np.nan


#: A disc of less than two pixels is a spot of the lens, px.
_LEAST_RADIUS_PX = 1.0


@dataclass(frozen=True)
class DiscOptics:
    """How discs are imaged: edge spread of lens and pixel (standard deviation), px, and by how much the slope of the temperature on a disc
    exceeds that of the table around it, as a share of the latter (-1: the disc is uniform); with their standard uncertainties.
    """

    spread_px: float
    spread_u_px: float
    slope_share: float
    slope_share_u: float


#: Before any disc is measured: a focused lens, and a slope between that of the table and none.
UNKNOWN_OPTICS = DiscOptics(2 / 3, 0.5, -0.5, 1.0)


def pooled_optics(discs: Collection[LocatedDisc]) -> DiscOptics:
    """Weighted means over the discs of one picture, with u not below what their scatter says."""
    values = np.array([(disc.spread_px, disc.slope_share) for disc in discs])
    weights = np.array([(disc.spread_u_px, disc.slope_share_u) for disc in discs]) ** -2.0
    means = (weights * values).sum(axis=0) / weights.sum(axis=0)
    scatter = (weights * (values - means) ** 2).sum(axis=0) / max(len(values) - 1, 1)
    spread_u, share_u = np.sqrt(np.maximum(scatter, 1.0) / weights.sum(axis=0)).tolist()
    return DiscOptics(float(means[0]), spread_u, float(means[1]), share_u)


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
    optics: DiscOptics = UNKNOWN_OPTICS,
) -> LocatedDisc | str:
    """Locate a disc near its predicted position: the blurred ellipse on a plane that fits best, given what is known of the optics."""
    shape = (fiducial.diameter_mm / 2) ** 2 * jacobian @ jacobian.T
    if not (np.isfinite(shape).all() and np.linalg.det(shape) > 0):
        return "lies at the edge of the frame"
    to_mm = np.linalg.inv(jacobian)
    place = np.array([fiducial.x_mm, fiducial.y_mm])
    # Centre (column, row), logarithms of the factor on the diameter and of the edge spread.
    state = np.array([*predicted_px, 0.0, np.log(optics.spread_px)], float)
    for step in range(_MOST_STEPS):
        centre, spread = state[:2], float(np.exp(state[3]))
        own = np.sqrt(np.diag(shape)) + 1.0
        # A place that is projected to infinity is no whole number.
        if not ((centre - own >= 0).all() and (centre + own <= np.array(temperature.shape[::-1]) - 1).all()):
            return "lies at the edge of the frame"
        window, columns, rows, seen = _surroundings(temperature.shape, centre, shape, spread, grid, (place, to_mm))
        values = temperature[window]
        seen &= np.isfinite(values)
        found = _fit_disc(values, columns, rows, seen, shape, state, optics)
        if isinstance(found, str):
            return found
        fit = found
        move = fit.step.copy()
        move[:2] *= min(1.0, float(np.sqrt(np.linalg.eigvalsh(shape)[0])) / max(np.hypot(*move[:2]), 1e-9))
        state = state + np.clip(move, (-np.inf, -np.inf, -0.3, -0.5), (np.inf, np.inf, 0.3, 0.5))
        off = np.hypot(*(state[:2] - predicted_px)) > reach_px
        if off or (step and np.abs(move).max() < 1e-3):
            break
    if abs(fit.contrast_K) < max(_LEAST_CONTRAST * fit.noise_K, 1e-3):
        return f"has no contrast ({fit.contrast_K:.3f} K with {fit.noise_K:.3f} K of noise)"
    if off:
        return f"no disc within {reach_px:.1f} px of where it should be"
    factor = float(np.exp(2 * state[2]))
    if abs(factor - 1) > _LARGEST_AREA_ERROR:
        return f"its image has {factor:.2f} times the area of a disc of {fiducial.diameter_mm:g} mm"
    return LocatedDisc(
        float(state[0]),
        float(state[1]),
        float(np.sqrt(np.mean(fit.u[:2] ** 2))),
        float(np.pi * np.sqrt(np.linalg.det(shape)) * factor),
        fit.contrast_K,
        float(np.exp(state[3])),
        float(np.exp(state[3]) * fit.u[3]),
        *fit.slope_share,
    )


def _surroundings(
    frame: tuple[int, ...], centre: Array, shape: Array, spread: float, grid: PlanGrid, on_plan: tuple[Array, Array]
) -> tuple[tuple[slice, slice], Array, Array, NDArray[np.bool_]]:
    """Window of the frame around a disc at a place on the plan, mm, with the matrix from px to mm there: columns and rows from its centre,
    and the pixels that show disc and table alone.
    """
    place, to_mm = on_plan
    half = np.ceil(np.hypot(_RING * np.sqrt(np.diag(shape)), 3 * spread + 1))
    left, top = np.maximum(np.round(centre) - half, 0).astype(int)
    right, bottom = np.minimum(np.round(centre) + half + 1, frame[::-1]).astype(int)
    columns, rows = np.arange(left, right) - centre[0], np.arange(top, bottom) - centre[1]
    offsets = np.stack(np.meshgrid(columns, rows), axis=-1)
    dilated = np.linalg.inv(_RING**2 * shape + (3 * spread + 1) ** 2 * np.eye(2))
    seen = np.einsum("...i,ij,...j", offsets, dilated, offsets) < 1
    # Beyond the table's edge, and as near to it as the blur reaches, a pixel shows more than table and disc.
    plan_mm, row_mm = offsets @ to_mm.T + place, np.linalg.norm(to_mm, axis=1)
    limits = 3 * spread * row_mm, (grid.width_mm, grid.height_mm) - 3 * spread * row_mm
    seen &= ((plan_mm >= limits[0]) & (plan_mm <= limits[1])).all(axis=-1)
    return (slice(top, bottom), slice(left, right)), columns, rows, seen


def disc_weights(
    frame: tuple[int, ...], fiducial: Fiducial, grid: PlanGrid, located: LocatedDisc, jacobian: Array, spread_px: float
) -> tuple[tuple[slice, slice], Array] | None:
    """Window of a frame around a located disc, and the weights (5, rows, columns) of its pixels in the level of the table at the centre, in
    the contrast of the disc to it, both free of the blur, and in the products of the contrast with a displacement along columns and rows
    and with a change of the logarithm of the edge spread; None where too few pixels show the table around it.
    """
    shape = (fiducial.diameter_mm / 2) ** 2 * jacobian @ jacobian.T
    shape = shape * located.area_px / (np.pi * np.sqrt(np.linalg.det(shape)))
    centre, on_plan = (
        np.array([located.column_px, located.row_px]),
        (np.array([fiducial.x_mm, fiducial.y_mm]), np.linalg.inv(jacobian)),
    )
    window, columns, rows, seen = _surroundings(frame, centre, shape, spread_px, grid, on_plan)
    coverage, aside, along, _, by_spread = _blurred_ellipse(columns, rows, shape, spread_px)
    if (seen & (coverage < 0.01)).sum() < 12:
        return None
    across, down = np.meshgrid(columns, rows)
    basis = np.stack([np.ones_like(across), coverage, aside, along, by_spread, across, down], axis=-1)
    weights = np.zeros((5, *seen.shape))
    weights[:, seen] = np.linalg.pinv(basis[seen])[:5]
    return window, weights


class _DiscFit(NamedTuple):
    """One step of the fit of a disc: steps (4,) of centre and logarithms of size and edge spread with their u, share of the slope
    with its u, contrast and noise, K.
    """

    step: Array
    u: Array
    slope_share: tuple[float, float]
    contrast_K: float
    noise_K: float


def _fit_disc(
    values: NDArray[np.floating],
    columns: Array,
    rows: Array,
    seen: NDArray[np.bool_],
    shape: Array,
    state: Array,
    optics: DiscOptics,
) -> _DiscFit | str:
    """Step of Gauss and Newton for the parameters of a blurred disc, with contrast and plane solved for at once (variable projection)."""
    size, spread = np.exp(state[2:])
    coverage, *derivatives = _blurred_ellipse(columns, rows, size**2 * shape, spread)
    across, down = np.meshgrid(columns, rows)
    ring = seen & (coverage < 0.01)
    if (
        ring.sum() < 12
        or (seen & (coverage > 0.1)).sum() < 6
        or np.linalg.eigvalsh(size**2 * shape)[0] < _LEAST_RADIUS_PX**2
    ):
        return "is too small in the frame or too near the plan's edge"
    plane = np.stack([np.ones_like(across), across, down], axis=-1)
    # Outliers are looked for where there is only table or only disc: near the rim the residuals are those of the parameters.
    sure = ring | (seen & (coverage > 0.99))
    basis = np.concatenate([plane, coverage[..., None] * plane], axis=-1)
    for _ in range(3):
        kept = basis[seen]
        first = np.linalg.pinv(kept.T @ kept, hermitian=True) @ (kept.T @ values[seen])
        residual = values - basis @ first
        noise = MAD_TO_SIGMA * float(np.median(np.abs(residual[ring & seen])))
        out = seen & sure & (np.abs(residual) > max(4 * noise, _MODEL_ERROR * abs(float(first[3]))))
        if not out.any() or (seen & ~out & ring).sum() < 12:
            break
        seen = seen & ~out
    contrast, slopes = float(first[3]), first[1:3]
    slope = float(np.hypot(*slopes))
    if contrast == 0.0:
        return "has no contrast (0 K)"
    design = np.concatenate([basis, contrast * np.stack(derivatives, axis=-1)], axis=-1)[seen]
    prior = np.array([0.0, 0.0, 0.0, np.log(optics.spread_px)])
    spread_u = max(optics.spread_u_px / optics.spread_px, _LEAST_SPREAD_U)
    slope_u = max(max(optics.slope_share_u, _LEAST_SHARE_U) * slope, 1e-4 * abs(contrast))
    prior_u = np.array([np.inf] * 4 + [slope_u] * 2 + [np.inf, np.inf, _SIZE_U, spread_u])
    off = np.concatenate([np.zeros(4), optics.slope_share * slopes, prior - state])
    information = design.T @ design
    weight = max(noise, 1e-6) ** 2 / prior_u**2
    covariance = np.linalg.pinv(information + np.diag(weight), hermitian=True)
    found = covariance @ (design.T @ values[seen] + weight * off)
    noise = float(np.sqrt(np.sum((values[seen] - design @ found) ** 2) / max(len(design) - len(found), 1)))
    u = noise * np.sqrt(np.diag(covariance))
    share = float(found[4:6] @ slopes) / max(slope**2, 1e-24)
    return _DiscFit(found[6:], u[6:], (share, float(np.hypot(*u[4:6])) / max(slope, 1e-12)), float(found[3]), noise)


def _blurred_ellipse(columns: Array, rows: Array, shape: Array, spread_px: float) -> tuple[Array, ...]:
    """Coverage of pixels by an ellipse that a Gaussian blurs, (rows, columns), and its derivatives by the centre (column, row) and by the
    logarithms of its size and of the spread; the ellipse x' shape^-1 x = 1 is summed over its chords, as a product of two matrices.
    """
    height = float(np.sqrt(shape[1, 1]))
    angles = np.pi * ((np.arange(count := int(4 * height / spread_px) + 12) + 0.5) / count - 0.5)
    chord = np.sqrt(np.linalg.det(shape)) / height * np.cos(angles)
    middle = shape[0, 1] / height * np.sin(angles)
    below = (rows[:, None] - height * np.sin(angles)) / spread_px
    by_row = np.exp(-(below**2) / 2) * (height * np.cos(angles) * np.sqrt(np.pi / 2) / count / spread_px)
    ends = [((middle + sign * chord)[:, None] - columns) / spread_px for sign in (1.0, -1.0)]
    (right, left), densities = ends, [np.exp(-(end**2) / 2) / np.sqrt(2 * np.pi) for end in ends]
    by_column = scipy.special.ndtr(right) - scipy.special.ndtr(left)
    aside = by_row @ ((densities[0] - densities[1]) / spread_px)
    along = (by_row * below / spread_px) @ by_column
    wider = (by_row * (below**2 - 1)) @ by_column - by_row @ (right * densities[0] - left * densities[1])
    return by_row @ by_column, aside, along, columns * aside + rows[:, None] * along - wider, wider


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
