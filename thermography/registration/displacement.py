"""Every frame checked against the registration: a knocked camera or table is found and registered anew from that frame.

The shift of a frame from the whole picture of the table, for frames whose fiducials have no contrast.

By the enhanced correlation coefficient (Evangelidis and Psarakis 2008) on the masked, mean-subtracted temperature. Phase
correlation is not used: on smooth thermal fields it finds no shift whatever the shift.
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

#: A shift of the fiducials together by more than this is a knock.
KNOCK_PX = 0.5
#: The quick check hands over to the exact one at this shift: gradients on the table move its centroids by some tenths.
SUSPECT_PX = 0.3
#: How far from their place the fiducials of a frame are looked for.
REACH_PX = 12.0


@dataclass(frozen=True)
class RegisteredFrom:
    """A registration, the first frame (index into the references) that it holds for, and the shift that made it necessary."""

    first: int
    registration: Registration
    shift_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Watch:
    """Quick look at the fiducials of many frames: three sums over the pixels around every disc.

    Between the table around a disc (a plane through its ring) and the disc itself, the coverage's sum and its first moments are
    linear in the pixels; their ratio is the centroid. No frame needs to be calibrated for it.

    Attributes
    ----------
    places
        Top, left, height and width of every disc's patch in the window, and where its weights start, (discs, 5).
    weights
        For the sum and the first moments along columns and rows, (3, entries), patch after patch, row by row.
    noise_gain
        Standard deviation of a disc's sum for pixels of unit noise, (discs,).
    """

    places: NDArray[np.int64]
    weights: NDArray[np.float32]
    noise_gain: Array

    def shifts(self, counts: NDArray[np.uint16], noise_counts: float) -> Array:
        """Median shift (column, row) px per frame of window counts (time, row, column); NaN where fewer than three discs show."""
        return _shifts(_disc_sums(counts, self.places, self.weights), 10 * noise_counts * self.noise_gain)


def watch(registration: Registration, grid: PlanGrid, window: tuple[slice, slice]) -> Watch:
    """Prepare the quick look for the fiducials of a registration that lie within a window of the sensor."""
    places, weights, gains, start = [], [np.empty((3, 0), np.float32)], [], 0
    origin = np.array([window[1].start, window[0].start])
    shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
    for name, disc in registration.fiducials.items():
        located = registration.located[name]
        centre = np.array([located.column_px, located.row_px]) - origin
        found = _disc_weights(disc, centre, registration, grid, shape)
        if found is None:
            continue
        top, left, patch = found
        places.append((top, left, *patch.shape[1:], start))
        weights.append(patch.reshape(3, -1).astype(np.float32))
        gains.append(float(np.linalg.norm(patch[0])))
        start += patch[0].size
    return Watch(np.array(places, np.int64).reshape(-1, 5), np.concatenate(weights, axis=1), np.array(gains))


def _disc_weights(
    disc: Fiducial, centre: Array, registration: Registration, grid: PlanGrid, shape: tuple[int, int]
) -> tuple[int, int, Array] | None:
    """Top, left and weights (3, height, width) of the patch around one disc; None where the window does not hold it."""
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
    # Every other pixel of the ring is enough for its plane, and halves the cost of the look.
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
    sums = np.zeros((len(counts), len(places), 3))
    longest = 0
    for disc in range(len(places)):
        longest = max(longest, places[disc, 2] * places[disc, 3])
    patch = np.empty(longest, np.float32)
    for disc in range(len(places)):
        top, left, height, width, start = places[disc]
        size = height * width
        for frame in range(len(counts)):
            # About the patch's own level, so that single precision is enough; the weights of all sums are blind to it.
            level = np.float32(counts[frame, top, left])
            for i in range(height):
                row = counts[frame, top + i, left : left + width]
                for j in range(width):
                    patch[i * width + j] = np.float32(row[j]) - level
            for k in range(3):
                sums[frame, disc, k] = _dot(patch[:size], weights[k, start : start + size])
    return sums


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _dot(one: Array, other: Array) -> np.float32:
    total = np.float32(0)
    for i in range(len(one)):
        total += one[i] * other[i]
    return total


@numba.njit(cache=True, nogil=True)
def _shifts(sums: Array, least: Array) -> Array:
    """Median over the discs of which the sum exceeds `least`, (frames, 2); NaN where those are fewer than three."""
    shifts = np.full((len(sums), 2), np.nan)
    for frame in range(len(sums)):
        shows = np.abs(sums[frame, :, 0]) > least
        if shows.sum() >= 3:
            for k in range(2):
                shifts[frame, k] = np.median(sums[frame, shows, k + 1] / sums[frame, shows, 0])
    return shifts


def fiducial_shift(frame: Array, registration: Registration, grid: PlanGrid) -> Array:
    """Median shift (column, row) px of the fiducials of a calibrated frame, exactly; NaN where fewer than three show."""
    listed = list(registration.fiducials.values())
    located, _ = locate_fiducials(frame, listed, registration.projection, grid=grid, reach_px=REACH_PX)
    if len(located) < 3:
        return np.full(2, np.nan)
    before = registration.located
    shifts = [(d.column_px - before[name].column_px, d.row_px - before[name].row_px) for name, d in located.items()]
    return np.asarray(np.median(shifts, axis=0))


def register_anew(frame: Array, old: Registration, shift_px: Array, grid: PlanGrid, *, where: str) -> Registration:
    """Register a frame after a knock: the old places, moved by the shift, are the hints.

    Raises
    ------
    RegistrationError
        The plan is not found any more; the message names the frame by `where`.
    """
    places = old.to_sensor(np.array([(disc.x_mm, disc.y_mm) for disc in old.masked])) + shift_px
    hinted = [
        replace(disc, column_px=float(c), row_px=float(r)) for disc, (c, r) in zip(old.masked, places, strict=True)
    ]
    try:
        return register(frame, hinted, grid=grid)
    except RegistrationError as error:
        raise RegistrationError(
            f"{where}: the fiducials moved by ({shift_px[0]:.1f}, {shift_px[1]:.1f}) px and the plan is not found again: {error}; "
            "leave out the frames from here on, or give them a fiducial file of their own"
        ) from error


#: Least correlation between the two pictures for a shift to be believed.
LEAST_CORRELATION = 0.8
#: What is looked at lies between these two widths.
FINE_PX, COARSE_PX = 1.0, 10.0
#: The table's edge is its strongest feature: so many pixels around it are looked at too.
BORDER_PX = 12


def image_shift(reference: Array, frame: Array, registration: Registration, grid: PlanGrid) -> Array:
    """How far the table in `frame` lies from where it lies in `reference`, (column, row) px; NaN where the pictures do not agree.

    Parameters
    ----------
    reference, frame
        Temperatures (row, column), degC.
    registration, grid
        Of the reference: where table and discs are. Discs do not count: what they mirror may change.
    """
    mask = _table_mask(registration, grid)
    pictures = []
    for image in (reference, frame):
        values = np.nan_to_num(np.asarray(image, np.float32), nan=float(np.nanmean(image)))
        values -= values[mask > 0].mean()
        # Without what changes over tens of pixels: a table that has warmed at one end would pass for one that has moved.
        pictures.append(cv2.GaussianBlur(values, (0, 0), FINE_PX) - cv2.GaussianBlur(values, (0, 0), COARSE_PX))
    start = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
    try:
        correlation, warp = cv2.findTransformECC(
            pictures[0], pictures[1], start, cv2.MOTION_TRANSLATION, criteria, mask, 5
        )
    except cv2.error:
        # The iteration diverged: the pictures have nothing in common.
        return np.full(2, np.nan)
    return np.asarray(warp[:, 2], float) if correlation >= LEAST_CORRELATION else np.full(2, np.nan)


def shifted(registration: Registration, shift_px: Array) -> Registration:
    """The registration of a camera whose picture has moved by (column, row) px; its uncertainty stays that of the old one."""
    move = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]], [0.0, 0.0, 1.0]])
    old = registration.projection
    centre = (old.principal_point_px[0] + float(shift_px[0]), old.principal_point_px[1] + float(shift_px[1]))
    projection = Projection(move @ old.plan_to_sensor, old.distortion, old.focal_length_px, centre)
    located = {
        name: replace(disc, column_px=disc.column_px + float(shift_px[0]), row_px=disc.row_px + float(shift_px[1]))
        for name, disc in registration.located.items()
    }
    return replace(
        registration,
        projection=projection,
        homography=np.linalg.inv(projection.plan_to_sensor),
        located=located,
        model=f"{registration.model}, shifted by the picture",
    )


def _table_mask(registration: Registration, grid: PlanGrid) -> NDArray[np.uint8]:
    t = np.linspace(0, 1, 40)
    zero, one = np.zeros_like(t), np.ones_like(t)
    outline = np.concatenate([np.stack(side, axis=-1) for side in ((t, zero), (one, t), (1 - t, one), (zero, 1 - t))])
    mask = np.zeros(registration.shape, np.uint8)
    corners = registration.to_sensor(outline * (grid.width_mm, grid.height_mm))
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 255)
    mask = np.asarray(cv2.dilate(mask, np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)), np.uint8)
    for disc in registration.masked:
        place = np.array([disc.x_mm, disc.y_mm])
        radius = disc.diameter_mm / 2 * float(np.linalg.norm(registration.projection.jacobian(place), 2)) + 3
        column, row = np.round(registration.to_sensor(place)).astype(int).tolist()
        cv2.circle(mask, (column, row), int(radius), 0, -1)
    return mask
