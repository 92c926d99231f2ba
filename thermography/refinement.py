"""L2 - The shift of a frame from the whole picture of the table, for frames whose fiducials have no contrast.

By the enhanced correlation coefficient (Evangelidis and Psarakis 2008) on the masked, mean-subtracted temperature. Phase
correlation is not used: on smooth thermal fields it finds no shift whatever the shift.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography.lens import Projection
from thermography.plan import PlanGrid
from thermography.registration import Registration

Array = NDArray[Any]

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
