"""Displacement of a still table in the frames against its registration (a knock to camera or table, a zoom, a turn), and registration
after it.

A displacement is a similarity of the image, given by four lengths in px: (column, row) by which the middle of the fiducials is shifted,
and by how much a fiducial at their root mean square distance from the middle moves outwards (growth: zoom) and sideways (turn). Its norm
is the root mean square displacement of the fiducials. It is measured in four ways, from fast to robust:

* `FiducialMonitor`: centroids of the fiducials from linear sums of raw counts, for every frame;
* `fiducial_displacement`: fiducials located near their registered places in the calibrated frame, for frames that the monitor suspects;
* `search_displacement`: the plan registered again anywhere in the frame;
* `image_displacement`: the image of the whole table, where the fiducials have no contrast; a shift only.

After a knock, `register_after_knock` registers the table again; without contrast of the fiducials, `shift_registration` moves the
old registration.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.registration import phase_cross_correlation

from thermography.common import Array
from thermography.registration.discs import LocatedDisc
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.projection import Projection, parameter_jacobian
from thermography.registration.register import (
    Registration,
    RegistrationError,
    fiducial_weights,
    locate_fiducials,
    picture_grid,
    register,
    register_picture,
)

#: A displacement by more than this is a knock, px.
KNOCK_PX = 0.5
#: Displacement on the monitor above which a frame is measured exactly, px: temperature gradients move its centroids by some tenths.
SUSPECT_PX = 0.3
#: A frame whose displacement is not known, px.
UNMEASURED = (np.nan, np.nan, np.nan, np.nan)
#: Largest distance of a fiducial from its registered position in `fiducial_displacement`, px.
_REACH_PX = 12.0
#: A displacement is known if its standard uncertainty is below this, px: a fifth of what counts as a knock.
_LARGEST_U_PX = KNOCK_PX / 5
#: Least share of the registered fiducials that must agree on a displacement: fewer may be taken in by other spots.
_LEAST_SHARE = 0.5
#: Largest change of scale between two registrations of one camera: beyond it, other spots were taken for the fiducials.
_LARGEST_ZOOM = 1.5
#: Largest residual of a registration after a search, px rms: fiducials assigned to their neighbours' spots miss them by more.
_LARGEST_RESIDUAL_PX = 0.5
#: Images are searched for a displaced table at this fraction of their resolution.
_SEARCH_STEP = 4
#: Least share of the image in which two images must overlap to be compared.
_LEAST_OVERLAP = 0.3
#: Standard uncertainty of a shift by the image of the table, px.
_IMAGE_SHIFT_U_PX = 0.1
#: A disc shows on the monitor if its sum exceeds this many standard deviations of its noise.
_LEAST_SIGNIFICANCE = 10
#: Least share of the table that two images must both show for a shift between them to be accepted: less of it may fit by chance,
#: as a row of discs on another row.
_LEAST_COMMON = 0.5
#: Least correlation of two images for a shift between them to be accepted.
_LEAST_CORRELATION = 0.8
#: Images are compared between these two widths of a Gaussian, px.
_FINE_PX, _COARSE_PX = 1.0, 10.0
#: Pixels around the table that take part in the comparison: the table's edge is its strongest feature.
_BORDER_PX = 12


@dataclass(frozen=True)
class RegistrationSpan:
    """A registration, the first frame for which it holds, and the displacement (column, row, growth, turn), px, that made it necessary."""

    first_frame: int
    registration: Registration
    displacement_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FiducialMonitor:
    """Displacement of the fiducials in many frames at the cost of three weighted sums over the pixels around every disc.

    The least-squares contrast of a blurred disc to the plane around it, and contrast times displacement, are linear in the pixels; their
    ratio is the displacement, as long as it is small against the disc's edge. Raw counts serve as well as temperatures.

    Attributes
    ----------
    discs : window of every disc among the pixels, and their weights (pixels, 3), row by row, for the contrast and its products with the
        displacement along columns and rows
    noise_gain : (discs,), standard deviation of a disc's contrast for pixels of unit noise
    arms : (discs, 2) ndarray
        Place (column, row) of every disc from the middle of all registered fiducials, over their root mean square distance.
    """

    discs: list[tuple[tuple[slice, slice], NDArray[np.float32]]]
    noise_gain: Array
    arms: Array

    def displacements(self, counts: NDArray[np.uint16], noise_counts: float) -> Array:
        """Displacement of the fiducials in every frame: the shift by medians over the discs, growth and turn by their mean."""
        sums = np.zeros((len(counts), len(self.discs), 3))
        for disc, ((rows, columns), weights) in enumerate(self.discs):
            pixels = counts[:, rows, columns].reshape(len(counts), -1).astype(np.float32)
            # Relative to one pixel, so that single precision suffices; a constant has no effect on the sums.
            sums[:, disc] = (pixels - pixels[:, :1]) @ weights
        return _displacements(sums, _LEAST_SIGNIFICANCE * noise_counts * self.noise_gain, self.arms)


def monitor_fiducials(registration: Registration, grid: PlanGrid, window: tuple[slice, slice]) -> FiducialMonitor:
    """Prepare the monitor for the fiducials of a registration that lie within a window of the sensor."""
    discs, arms = [], []
    middle, radius = (np.zeros(2), 1.0) if registration.is_picture else _middle(registration)
    for name, ((rows, columns), patch) in fiducial_weights(registration, grid).items():
        located, top, bottom = (
            registration.located[name],
            max(rows.start, window[0].start),
            min(rows.stop, window[0].stop),
        )
        weights = patch[1:4, top - rows.start : bottom - rows.start].reshape(3, -1).T.astype(np.float32)
        inside = (slice(top - window[0].start, bottom - window[0].start), columns)
        discs.append((inside, weights))
        arms.append((np.array([located.column_px, located.row_px]) - middle) / radius)
    gains = np.array([np.linalg.norm(weights[:, 0]) for _, weights in discs])
    return FiducialMonitor(discs, gains, np.array(arms).reshape(-1, 2))


def _displacements(sums: Array, least: Array, arms: Array) -> Array:
    """Displacement by the discs whose sum exceeds `least`, (frames, 4) px; NaN where those are fewer than three."""
    shows = np.abs(sums[..., 0]) > least
    shows &= (shows.sum(axis=1) >= 3)[:, None]
    measured = shows.any(axis=1)
    displacements = np.full((len(sums), 4), np.nan)
    sums, shows = sums[measured], shows[measured]
    # NaN where a disc does not show, so that it takes no part.
    moved = np.divide(sums[..., 1:], sums[..., :1], out=np.full((*shows.shape, 2), np.nan), where=shows[..., None])
    reach = np.where(shows[..., None], arms, np.nan)
    shift = np.nanmedian(moved, axis=1)
    across, down = np.moveaxis(reach - np.nanmean(reach, axis=1, keepdims=True), -1, 0)
    column, row = np.moveaxis(moved - shift[:, None], -1, 0)
    squares = np.nansum(across**2 + down**2, axis=1)
    displacements[measured, :2] = shift
    displacements[measured, 2] = np.nansum(across * column + down * row, axis=1) / squares
    displacements[measured, 3] = np.nansum(across * row - down * column, axis=1) / squares
    return displacements


def _middle(registration: Registration) -> tuple[Array, float]:
    """Middle of the located fiducials, (column, row) px, and their root mean square distance from it, px."""
    places = np.array([(disc.column_px, disc.row_px) for disc in registration.located.values()])
    middle = places.mean(axis=0)
    return middle, float(np.sqrt(((places - middle) ** 2).sum(axis=1).mean()))


def _fit_displacement(places: Array, moved: Array, registration: Registration) -> Array:
    """Displacement, (4,) px, that brings places to moved places, both (n, 2) px, by least squares."""
    middle, radius = _middle(registration)
    arms, shifts = ((points[:, 0] + 1j * points[:, 1]) for points in ((places - middle) / radius, moved - places))
    (shift, stretch), *_ = np.linalg.lstsq(np.column_stack([np.ones(len(arms)), arms]), shifts, rcond=None)
    return np.array([shift.real, shift.imag, stretch.real, stretch.imag])


def zoom_and_turn(displacement_px: Sequence[float] | Array, registration: Registration) -> tuple[float, float]:
    """Change of scale and rotation of a displacement."""
    stretch = 1 + complex(*displacement_px[2:]) / _middle(registration)[1]
    return float(abs(stretch)), float(np.angle(stretch, deg=True))


def fiducial_displacement(temperature: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Displacement of the fiducials of one frame, each located near its registered place."""
    listed = list(registration.fiducials.values())
    located, _ = locate_fiducials(
        temperature, listed, registration.projection, grid=grid, reach_px=_REACH_PX, optics=registration.optics
    )
    before = registration.located
    least = max(3, int(np.ceil(_LEAST_SHARE * len(before))))
    if len(located) < least:
        return np.array(UNMEASURED)
    places = np.array([(before[name].column_px, before[name].row_px) for name in located])
    moved = np.array([(disc.column_px, disc.row_px) for disc in located.values()])
    _, agree = cv2.estimateAffinePartial2D(places, moved, method=cv2.LMEDS)
    kept = np.zeros(len(places), bool) if agree is None else agree.ravel().astype(bool)
    if kept.sum() < least or _displacement_u(compress(located.values(), kept)) > _LARGEST_U_PX:
        return np.array(UNMEASURED)
    return _fit_displacement(places[kept], moved[kept], registration)


def _displacement_u(located: Iterable[LocatedDisc]) -> float:
    """Standard uncertainty of the norm of a displacement, px: four parameters of about the same uncertainty from n discs."""
    u_px = np.array([disc.u_px for disc in located])
    return float(2 * np.sqrt(np.mean(u_px**2) / len(u_px)))


def search_displacement(reference: Array, temperature: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Displacement of the table by any distance: the plan is registered again, near where the image as a whole has moved to."""
    start = np.array([*_coarse_shift(reference, temperature), 0.0, 0.0])
    try:
        found = register(temperature, _moved_hints(registration, start), grid=grid)
    except RegistrationError:
        return np.array(UNMEASURED)
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in registration.fiducials.values()])
    before, after = registration.to_sensor(centres), found.to_sensor(centres)
    displacement = _fit_displacement(before, after, registration)
    pixel_mm = 1 / np.sqrt(abs(np.linalg.det(found.projection.jacobian(centres[0]))))
    zoom, _ = zoom_and_turn(displacement, registration)
    trusted = (
        len(found.located) >= max(4, _LEAST_SHARE * len(registration.located))
        and found.rms_mm < max(_LARGEST_RESIDUAL_PX * pixel_mm, 2 * registration.rms_mm)
        and 1 / _LARGEST_ZOOM < zoom < _LARGEST_ZOOM
        and _displacement_u(found.located.values()) <= _LARGEST_U_PX
    )
    return displacement if trusted else np.array(UNMEASURED)


def _coarse_shift(reference: Array, temperature: Array) -> Array:
    """Shift (column, row) px of the image as a whole, to some px."""
    small = [
        cv2.resize(_band_pass(frame), None, fx=1 / _SEARCH_STEP, fy=1 / _SEARCH_STEP, interpolation=cv2.INTER_AREA)
        for frame in (reference, temperature)
    ]
    whole = np.ones(small[0].shape, bool)
    back, *_ = phase_cross_correlation(*small, reference_mask=whole, moving_mask=whole, overlap_ratio=_LEAST_OVERLAP)
    return -_SEARCH_STEP * np.asarray(back, float)[::-1]


def _band_pass(frame: Array) -> NDArray[np.float32]:
    """A frame without changes over tens of pixels: a table that has warmed at one end would be taken for one that has moved."""
    values = np.nan_to_num(np.asarray(frame, np.float32), nan=float(np.nanmean(frame)))
    return np.asarray(cv2.GaussianBlur(values, (0, 0), _FINE_PX) - cv2.GaussianBlur(values, (0, 0), _COARSE_PX))


def image_displacement(reference: Array, temperature: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Displacement of the image of the table between two frames, as a shift."""
    mask = _table_mask(registration, grid)
    displaced, fixed = (_band_pass(frame) for frame in (temperature, reference))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
    for start in (np.zeros(2), _coarse_shift(reference, temperature)):
        # From the displaced frame back to the reference, on whose pixels the mask is.
        back = np.column_stack([np.eye(2), -start]).astype(np.float32)
        try:
            correlation, warp = cv2.findTransformECC(displaced, fixed, back, cv2.MOTION_TRANSLATION, criteria, mask, 5)
        except cv2.error:
            # The iteration diverged: from here, the images have nothing in common.
            continue
        shift = -np.asarray(warp)[:, 2]
        if correlation >= _LEAST_CORRELATION and _common_share(mask, shift) >= _LEAST_COMMON:
            return np.array([*shift, 0.0, 0.0])
    return np.array(UNMEASURED)


def picture_displacements(pictures: Iterable[Array]) -> Array:
    """Shift (column, row) px of each picture against the first, (n, 2); NaN where it shows something else.

    A part that warms makes a picture unlike the first, and changes little from one picture to the next: what cannot be compared with the
    first is compared with the last picture that could.
    """
    known: list[tuple[Array, Array]] = []
    shifts: list[Array] = []
    for picture in pictures:
        registration, grid = register_picture(picture.shape), picture_grid(picture.shape)
        shift = np.zeros(2) if not known else np.full(2, np.nan)
        for earlier, place in known:
            moved = image_displacement(earlier, picture, registration, grid)[:2]
            if np.isfinite(moved).all():
                shift = place + moved
                break
        if np.isfinite(shift).all():
            known = [*known[:1], (picture, shift)]
        shifts.append(shift)
    return np.array(shifts).reshape(-1, 2)


def _common_share(mask: NDArray[np.uint8], shift_px: Array) -> float:
    """Share of the masked pixels that a shift (column, row) leaves inside the image."""
    row, column = np.nonzero(mask)
    rows, columns = mask.shape
    inside = (np.abs(column + shift_px[0] - (columns - 1) / 2) <= columns / 2) & (
        np.abs(row + shift_px[1] - (rows - 1) / 2) <= rows / 2
    )
    return float(np.mean(inside)) if inside.size else 0.0


def _table_mask(registration: Registration, grid: PlanGrid) -> NDArray[np.uint8]:
    """255 on the pixels of the table and its border, 0 elsewhere and on the discs, (row, column)."""
    mask = np.zeros(registration.shape, np.uint8)
    outline = registration.to_sensor(grid.outline_mm(40))
    cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 255)
    width = 2 * _BORDER_PX + 1
    mask = np.asarray(cv2.dilate(mask, np.ones((width, width), np.uint8)), np.uint8)
    for disc in registration.masked:
        place = np.array([disc.x_mm, disc.y_mm])
        radius = disc.diameter_mm / 2 * float(np.linalg.norm(registration.projection.jacobian(place), 2)) + 3
        column, row = np.round(registration.to_sensor(place)).astype(int).tolist()
        cv2.circle(mask, (column, row), int(radius), 0, -1)
    return mask


def register_after_knock(
    temperature: Array, old: Registration, displacement_px: Array, grid: PlanGrid, *, frame_name: str
) -> Registration:
    """Register the table again after a knock; the old positions, displaced, are the hints."""
    try:
        return register(temperature, _moved_hints(old, displacement_px), grid=grid, lens=old.lens)
    except RegistrationError as error:
        column, row = displacement_px[:2]
        raise RegistrationError(
            f"{frame_name}: the fiducials moved by ({column:.1f}, {row:.1f}) px and the plan is not located again: "
            f"{error}; leave out the frames from here on, or give them a fiducial file of their own"
        ) from error


def _moved_hints(old: Registration, displacement_px: Array) -> list[Fiducial]:
    """The fiducials on the table, with their displaced places as pixel hints."""
    places = old.to_sensor(np.array([(disc.x_mm, disc.y_mm) for disc in old.masked]))
    # Places (n, 2) px after a displacement.
    middle, radius = _middle(old)
    column, row, growth, turn = displacement_px
    arms = (places - middle) / radius
    moved: Array = places + (column, row) + arms @ np.array([[growth, turn], [-turn, growth]])
    return [replace(disc, column_px=float(c), row_px=float(r)) for disc, (c, r) in zip(old.masked, moved, strict=True)]


def shift_registration(registration: Registration, shift_px: Array) -> Registration:
    """Shift a registration on the sensor."""
    shift = (float(shift_px[0]), float(shift_px[1]))
    move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
    old = registration.projection
    centre = (old.principal_point_px[0] + shift[0], old.principal_point_px[1] + shift[1])
    projection = Projection(move @ old.plan_to_sensor, old.distortion, old.focal_length_px, centre)
    located = {
        name: replace(disc, column_px=disc.column_px + shift[0], row_px=disc.row_px + shift[1])
        for name, disc in registration.located.items()
    }
    # Covariance of the fitted parameters that moves all fiducials together by `_IMAGE_SHIFT_U_PX`, independently in both coordinates.
    centres = np.array([(disc.x_mm, disc.y_mm) for disc in registration.fiducials.values()])
    by_parameter = parameter_jacobian(registration.projection, centres, len(registration.covariance) - 8)(centres)
    both = np.tile(_IMAGE_SHIFT_U_PX * np.eye(2), (len(centres), 1))
    parameters, *_ = np.linalg.lstsq(by_parameter.reshape(2 * len(centres), -1), both, rcond=None)
    covariance: Array = parameters @ parameters.T
    return replace(
        registration,
        projection=projection,
        homography=np.linalg.inv(projection.plan_to_sensor),
        located=located,
        model=f"{registration.model}, shifted by the image of the table",
        covariance=registration.covariance + covariance,
    )
