"""ArUco markers: they identify the table plan and hint where its discs are; the discs alone determine the registration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography._constants import MAD_TO_SIGMA
from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.registration.plan import Fiducial

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
    """Detect ArUco markers in a thermogram, dark on bright or bright on dark.

    Parameters
    ----------
    temperature : (row, column) ndarray, degC
        One frame.

    Returns
    -------
    dict of int to (2,) ndarray, px
        Centre (column, row) by marker number, to about a pixel.

    Notes
    -----
    S. Garrido-Jurado et al., Automatic generation and detection of highly reliable fiducial markers under occlusion, Pattern
    Recognition 47 (2014) 2280-2292, as implemented in OpenCV.
    """
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
    """Compare the markers in a frame with those of the plan, and derive hints for the discs from them.

    Parameters
    ----------
    temperature : (row, column) ndarray, degC
        One frame.
    fiducials : sequence of Fiducial
        Discs and markers of the plan.

    Returns
    -------
    list of Fiducial
        The discs. Where at least three markers of the plan are detected, discs without a hint of their own have one.

    Raises
    ------
    MarkerError
        Markers are detected, and none of them is listed in the plan.
    """
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
