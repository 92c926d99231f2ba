"""ArUco markers tell which plan is in view and where to look for its discs; the discs alone say where it lies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.plan import Fiducial

#: The markers' dictionary: 50 patterns of 4 x 4 squares, the coarsest there is, for thermal pictures are small.
DICTIONARY = cv2.aruco.DICT_4X4_50
#: Their centres are good to a pixel and an affine map bends with perspective, so they are hints and nothing more; it takes three.
LEAST_MARKERS = 3


class MarkerError(ThermographyError):
    """The markers in the picture belong to another plan; the message names both and what to do."""


def find_markers(frame: Array) -> dict[int, Array]:
    """Centres (column, row) px of the markers in a frame (row, column) degC, by their number; dark or bright on their ground."""
    low, high = np.nanpercentile(frame, (1, 99))
    picture = np.round(255 * np.clip((frame - low) / max(high - low, 1e-6), 0, 1)).astype(np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    # Paint of low emissivity swaps dark and bright; a pattern with a wrong square is taken for none rather than for its neighbour.
    parameters.detectInvertedMarker = True
    parameters.errorCorrectionRate = 0.0
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
    corners, numbers, _ = detector.detectMarkers(picture)
    if numbers is None:
        return {}
    return {int(number): four.reshape(4, 2).mean(axis=0) for number, four in zip(numbers.ravel(), corners, strict=True)}


def identify(frame: Array, fiducials: Sequence[Fiducial]) -> list[Fiducial]:
    """Compare the markers that a frame shows with those of the plan, and hint the discs by them.

    Parameters
    ----------
    frame
        (row, column), degC.
    fiducials
        Discs and markers.

    Returns
    -------
    list of Fiducial
        The discs; those without a hint of their own have one where at least three markers of the plan are seen.

    Raises
    ------
    MarkerError
        Markers are seen, and none of them is one of the plan's.
    """
    discs = [one for one in fiducials if one.marker is None]
    markers = {one.marker: one for one in fiducials if one.marker is not None}
    if not markers:
        return discs
    found = find_markers(frame)
    known = sorted(markers.keys() & found.keys())
    if found and not known:
        raise MarkerError(
            f"the frames show the markers {', '.join(map(str, sorted(found)))}, the plan lists {', '.join(map(str, sorted(markers)))}: "
            "this is another table; name its fiducial file"
        )
    if len(known) < LEAST_MARKERS:
        return discs
    plan = np.array([(markers[number].x_mm, markers[number].y_mm, 1.0) for number in known])
    affine, _, rank, _ = np.linalg.lstsq(plan, np.array([found[number] for number in known]))
    if rank < 3:
        return discs
    places = np.array([(disc.x_mm, disc.y_mm, 1.0) for disc in discs]) @ affine
    return [
        replace(disc, column_px=float(column), row_px=float(row)) if disc.hint_px is None else disc
        for disc, (column, row) in zip(discs, places, strict=True)
    ]
