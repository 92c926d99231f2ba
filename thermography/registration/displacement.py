"""Displacement of a still table in the frames against its registration (a knock to camera or table), and registration after it.

The displacement is measured in three ways, from fast to robust:

* `FiducialMonitor`: centroids of the fiducials from linear sums of raw counts, for every frame;
* `fiducial_shift`: fiducials located in the calibrated frame as in a registration, for frames that the monitor suspects;
* `image_shift`: the image of the whole table, where the fiducials have no contrast.

After a knock, `register_after_knock` registers the table again; without contrast of the fiducials, `shift_registration` moves the
old registration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.registration.plan import Fiducial, PlanGrid
from thermography.registration.projection import Projection
from thermography.registration.register import Registration, RegistrationError, locate_fiducials, register

#: A common shift of the fiducials by more than this is a knock, px.
KNOCK_PX = 0.5
#: Shift on the monitor above which a frame is measured exactly, px: temperature gradients move the monitor's centroids by some tenths.
SUSPECT_PX = 0.3
#: Largest distance of a fiducial from its registered position in `fiducial_shift`, px.
_REACH_PX = 12.0
#: A disc shows on the monitor if its sum exceeds this many standard deviations of its noise.
_LEAST_SIGNIFICANCE = 10
#: Least correlation of two images for a shift between them to be accepted.
_LEAST_CORRELATION = 0.8
#: Images are compared between these two widths of a Gaussian, px.
_FINE_PX, _COARSE_PX = 1.0, 10.0
#: Pixels around the table that take part in the comparison: the table's edge is its strongest feature.
_BORDER_PX = 12


@dataclass(frozen=True)
class RegistrationSpan:
    """A registration and the frames for which it holds: from one frame to the first frame of the next span.

    Attributes
    ----------
    first_frame : int
        Index of the first frame.
    registration : Registration
        Of the still table in these frames.
    shift_px : (column, row), px
        Shift of the fiducials that made the registration necessary; zeros for the first one.
    """

    first_frame: int
    registration: Registration
    shift_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class FiducialMonitor:
    """Shift of the fiducials in many frames at the cost of three weighted sums over the pixels around every disc.

    Between the table around a disc (a plane through its ring) and the disc itself, the sum of the coverage and its first moments
    are linear in the pixels; their ratio is the centroid. Raw counts serve as well as temperatures.

    Attributes
    ----------
    places : (discs, 5) ndarray of int
        Top, left, height and width of every disc's patch in the window, and the index of its first weight.
    weights : (3, entries) ndarray of float32
        For the sum and the first moments along columns and rows, patch after patch, row by row.
    noise_gain : (discs,) ndarray
        Standard deviation of a disc's sum for pixels of unit noise.
    """

    places: NDArray[np.int64]
    weights: NDArray[np.float32]
    noise_gain: Array

    def shifts(self, counts: NDArray[np.uint16], noise_counts: float) -> Array:
        """Median shift of the fiducials in every frame.

        Parameters
        ----------
        counts : (time, row, column) ndarray of uint16
            Raw counts of the window for which the monitor was prepared.
        noise_counts : float
            Standard deviation of the noise of a pixel, counts.

        Returns
        -------
        (time, 2) ndarray, px
            (column, row); NaN where fewer than three discs show.
        """
        return _shifts(
            _disc_sums(counts, self.places, self.weights), _LEAST_SIGNIFICANCE * noise_counts * self.noise_gain
        )


def monitor_fiducials(registration: Registration, grid: PlanGrid, window: tuple[slice, slice]) -> FiducialMonitor:
    """Prepare the monitor for the fiducials of a registration that lie within a window of the sensor.

    Parameters
    ----------
    registration : Registration
    grid : PlanGrid
        The plan, whose edge bounds the table around the discs.
    window : (slice, slice)
        Rows and columns of the sensor, px.

    Returns
    -------
    FiducialMonitor
    """
    places, weights, gains, start = [], [np.empty((3, 0), np.float32)], [], 0
    origin = np.array([window[1].start, window[0].start])
    shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
    for name, disc in registration.fiducials.items():
        if disc.is_point:
            continue
        located = registration.located[name]
        centre = np.array([located.column_px, located.row_px]) - origin
        placed = _disc_weights(disc, centre, registration, grid, shape)
        if placed is None:
            continue
        top, left, patch = placed
        places.append((top, left, *patch.shape[1:], start))
        weights.append(patch.reshape(3, -1).astype(np.float32))
        gains.append(float(np.linalg.norm(patch[0])))
        start += patch[0].size
    return FiducialMonitor(np.array(places, np.int64).reshape(-1, 5), np.concatenate(weights, axis=1), np.array(gains))


def _disc_weights(
    disc: Fiducial, centre: Array, registration: Registration, grid: PlanGrid, shape: tuple[int, int]
) -> tuple[int, int, Array] | None:
    """Top, left and weights (3, height, width) of the patch around one disc; None where the window does not contain it."""
    place = np.array([disc.x_mm, disc.y_mm])
    jacobian = registration.projection.jacobian(place)
    to_mm = np.linalg.inv(jacobian)
    radius = disc.diameter_mm / 2
    pixel_mm = float(np.linalg.norm(to_mm, 2))
    half = np.ceil((1.5 * radius + 5.5 * pixel_mm) * np.linalg.norm(jacobian, axis=1)).astype(int)
    low = np.maximum(np.round(centre).astype(int) - half, 0)
    high = np.minimum(np.round(centre).astype(int) + half + 1, np.array(shape[::-1]))
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1).reshape(-1, 2)
    plan = offsets @ to_mm.T + place
    distance = np.linalg.norm(plan - place, axis=1)
    counted = distance < radius + 3.5 * pixel_mm
    ring = ~counted & (distance < 1.5 * radius + 5.5 * pixel_mm) & grid.contains(plan, margin_mm=1.5 * pixel_mm)
    # Every other pixel of the ring determines its plane well enough, at half the cost.
    ring &= ((columns + rows).ravel() & 1) == 0
    if ring.sum() < 12 or counted.sum() < 12:
        return None
    basis = np.column_stack([offsets, np.ones(len(offsets))])
    plane = np.linalg.solve(basis[ring].T @ basis[ring], basis[ring].T)
    moments = np.column_stack([np.ones(len(offsets)), offsets])
    weights = np.where(counted[:, None], moments, 0.0)
    weights[ring] -= (moments[counted].T @ basis[counted] @ plane).T
    return int(low[1]), int(low[0]), weights.T.reshape(3, *columns.shape)


@numba.njit(cache=True, nogil=True)
def _disc_sums(counts: Array, places: Array, weights: Array) -> Array:
    """Sum and first moments of the coverage of every disc, (frames, discs, 3)."""
    sums = np.zeros((len(counts), len(places), 3))
    longest = 0
    for disc in range(len(places)):
        longest = max(longest, places[disc, 2] * places[disc, 3])
    patch = np.empty(longest, np.float32)
    for disc in range(len(places)):
        top, left, height, width, start = places[disc]
        size = height * width
        for frame in range(len(counts)):
            # Relative to one pixel of the patch, so that single precision suffices; a constant has no effect on the sums.
            level = np.float32(counts[frame, top, left])
            for i in range(height):
                row = counts[frame, top + i, left : left + width]
                for j in range(width):
                    patch[i * width + j] = np.float32(row[j]) - level
            for k in range(3):
                sums[frame, disc, k] = _dot(patch[:size], weights[k, start : start + size])
    return sums


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _dot(a: Array, b: Array) -> np.float32:
    total = np.float32(0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@numba.njit(cache=True, nogil=True)
def _shifts(sums: Array, least: Array) -> Array:
    """Median over the discs whose sum exceeds `least`, (frames, 2) px; NaN where those are fewer than three."""
    shifts = np.full((len(sums), 2), np.nan)
    for frame in range(len(sums)):
        shows = np.abs(sums[frame, :, 0]) > least
        if shows.sum() >= 3:
            for k in range(2):
                shifts[frame, k] = np.median(sums[frame, shows, k + 1] / sums[frame, shows, 0])
    return shifts


def fiducial_shift(temperature: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Median shift of the fiducials of one frame, each located as in a registration.

    Parameters
    ----------
    temperature : (row, column) ndarray, degC
        One frame.
    registration : Registration
        Against which the shift is measured.
    grid : PlanGrid
        The plan.

    Returns
    -------
    (2,) ndarray, px
        (column, row); NaN where fewer than three fiducials are located within 12 px.
    """
    listed = list(registration.fiducials.values())
    located, _ = locate_fiducials(temperature, listed, registration.projection, grid=grid, reach_px=_REACH_PX)
    if len(located) < 3:
        return np.full(2, np.nan)
    before = registration.located
    shifts = [(d.column_px - before[name].column_px, d.row_px - before[name].row_px) for name, d in located.items()]
    return np.asarray(np.median(shifts, axis=0))


def image_shift(reference: Array, temperature: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Shift of the image of the table between two frames.

    Parameters
    ----------
    reference, temperature : (row, column) ndarray, degC
        The registered frame, and the frame whose shift is wanted.
    registration : Registration
        Of the reference. Its discs are masked, because the reflections on them may change.
    grid : PlanGrid
        The plan.

    Returns
    -------
    (2,) ndarray, px
        (column, row); NaN where the images correlate by less than 0.8.

    Notes
    -----
    Maximum of the enhanced correlation coefficient (G. D. Evangelidis, E. Z. Psarakis, IEEE Trans. PAMI 30 (2008) 1858-1865) of the
    masked images. Phase correlation fails on smooth thermal fields: it returns no shift whatever the shift is.
    """
    mask = _table_mask(registration, grid)
    images = []
    for frame in (reference, temperature):
        values = np.nan_to_num(np.asarray(frame, np.float32), nan=float(np.nanmean(frame)))
        values -= values[mask > 0].mean()
        # Without changes over tens of pixels: a table that has warmed at one end would be taken for one that has moved.
        images.append(cv2.GaussianBlur(values, (0, 0), _FINE_PX) - cv2.GaussianBlur(values, (0, 0), _COARSE_PX))
    start = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
    try:
        correlation, warp = cv2.findTransformECC(images[0], images[1], start, cv2.MOTION_TRANSLATION, criteria, mask, 5)
    except cv2.error:
        # The iteration diverged: the images have nothing in common.
        return np.full(2, np.nan)
    return np.asarray(warp[:, 2], float) if correlation >= _LEAST_CORRELATION else np.full(2, np.nan)


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
    temperature: Array, old: Registration, shift_px: Array, grid: PlanGrid, *, frame_name: str
) -> Registration:
    """Register the table again after a knock; the old positions, moved by the shift, are the hints.

    Parameters
    ----------
    temperature : (row, column) ndarray, degC
        First frame after the knock, or the mean of several.
    old : Registration
        Before the knock.
    shift_px : (2,) ndarray, px
        Shift (column, row) of the fiducials against `old`.
    grid : PlanGrid
        The plan.
    frame_name : str
        Names the frame in messages.

    Returns
    -------
    Registration

    Raises
    ------
    RegistrationError
        The plan is not located any more.
    """
    places = old.to_sensor(np.array([(disc.x_mm, disc.y_mm) for disc in old.masked])) + shift_px
    hinted = [
        replace(disc, column_px=float(c), row_px=float(r)) for disc, (c, r) in zip(old.masked, places, strict=True)
    ]
    try:
        return register(temperature, hinted, grid=grid, lens=old.lens)
    except RegistrationError as error:
        raise RegistrationError(
            f"{frame_name}: the fiducials moved by ({shift_px[0]:.1f}, {shift_px[1]:.1f}) px and the plan is not located again: "
            f"{error}; leave out the frames from here on, or give them a fiducial file of their own"
        ) from error


def shift_registration(registration: Registration, shift_px: Array) -> Registration:
    """Shift a registration on the sensor.

    Parameters
    ----------
    registration : Registration
    shift_px : (2,) ndarray, px
        Shift (column, row) of the image of the table.

    Returns
    -------
    Registration
        Its uncertainty remains that of the old one.
    """
    shift = (float(shift_px[0]), float(shift_px[1]))
    move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
    old = registration.projection
    centre = (old.principal_point_px[0] + shift[0], old.principal_point_px[1] + shift[1])
    projection = Projection(move @ old.plan_to_sensor, old.distortion, old.focal_length_px, centre)
    located = {
        name: replace(disc, column_px=disc.column_px + shift[0], row_px=disc.row_px + shift[1])
        for name, disc in registration.located.items()
    }
    return replace(
        registration,
        projection=projection,
        homography=np.linalg.inv(projection.plan_to_sensor),
        located=located,
        model=f"{registration.model}, shifted by the image of the table",
    )
