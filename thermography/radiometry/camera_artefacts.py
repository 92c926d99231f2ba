"""Detects artefacts of the camera in a series of frames: repeated frames, frozen output and bad pixels.

Steps and drift of its zero are estimated in `thermography.radiometry.camera_correction`. See ``docs/method/radiometry.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Cause = Literal["repeated_frame", "frozen_frames"]
#: More repeats in a row than this mean that the camera output was frozen, not that a frame was written twice.
_MAX_REPEATS = 2

#: Flags of `find_bad_pixels`.
DEAD, OFFSET, NOISY = 1, 2, 4
#: Place of the 90th percentile among the 24 pixels that surround a pixel.
_RING_RANK = 21


@dataclass(frozen=True)
class CameraFlag:
    """A camera artefact.

    Attributes
    ----------
    cause : {"repeated_frame", "frozen_frames"}
        Kind of artefact.
    index : int
        Index of the first frame that shows it.
    time : datetime64[ms]
        Time of this frame, UTC.
    message : str
        Description in one sentence, without a full stop.
    """

    cause: Cause
    index: int
    time: np.datetime64
    message: str


def find_repeats(repeated: NDArray[np.bool_], time: NDArray[np.datetime64]) -> list[CameraFlag]:
    """Find frames that were written twice and intervals in which the camera output was frozen.

    Parameters
    ----------
    repeated : (n,) ndarray of bool
        True where all counts of a frame equal those of the previous one; noise never repeats a whole frame.
    time : (n,) ndarray of datetime64
        Times of the frames, UTC.

    Returns
    -------
    list of CameraFlag
        Cause "repeated_frame" for up to two repeats in a row, "frozen_frames" for more.
    """
    flags = []
    labels, count = ndimage.label(repeated)
    for (run,) in ndimage.find_objects(labels)[:count]:
        length = run.stop - run.start
        frozen = length > _MAX_REPEATS
        text = f"{length} {'frame repeats' if length == 1 else 'frames repeat'} the counts of frame {run.start - 1}"
        text += ": the camera output was frozen" if frozen else ""
        cause: Cause = "frozen_frames" if frozen else "repeated_frame"
        flags.append(CameraFlag(cause, run.start, time[run.start], text))
    return flags


def find_bad_pixels(counts: NDArray[np.uint16], *, threshold: float = 8.0) -> NDArray[np.uint8]:
    """Find pixels whose mean or noise differs from that of their neighbours.

    Parameters
    ----------
    counts : (time, row, column) ndarray of uint16
        A few dozen frames of a nearly constant scene; with fewer than 8, only offsets are found.
    threshold : float
        Minimum deviation from the neighbours, as a multiple of the 90th percentile of this deviation in the surroundings.

    Returns
    -------
    (row, column) ndarray of uint8
        Sum of flags: `DEAD` = 1 (never changes), `OFFSET` = 2 (mean differs), `NOISY` = 4 (noise differs); 0 for a good pixel.
    """
    stack = counts.astype(np.float32)
    mean, noise = stack.mean(axis=0), stack.std(axis=0)
    flags = np.where(_outliers(mean, threshold), OFFSET, 0).astype(np.uint8)
    if len(stack) >= 8:
        flags |= np.where((noise == 0) & (np.median(noise) > 0), DEAD, 0).astype(np.uint8)
        flags |= np.where(_outliers(noise, threshold) & (noise > np.median(noise)), NOISY, 0).astype(np.uint8)
    return flags


def _outliers(image: NDArray[np.float32], threshold: float) -> NDArray[np.bool_]:
    """Return which pixels deviate from their neighbours much further than the pixels of their surroundings do.

    The deviation of a pixel is its third smallest absolute difference from the eight neighbours. On an edge or corner of the scene at
    least three neighbours belong to the same surface, and clusters of up to three bad pixels are still detected.
    """
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="reflect")
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    differences = [np.abs(image - padded[row : row + rows, column : column + columns]) for row, column in shifts]
    deviation = np.partition(differences, 2, axis=0)[2]
    typical = max(np.median(deviation), np.float32(1.0))
    # Few pixels deviate further than those of the whole picture do: of these alone the surroundings are looked at.
    outlying = deviation > threshold * typical
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(deviation, 2, mode="symmetric"), (5, 5))[outlying]
    rings = np.delete(windows.reshape(-1, 25), 12, axis=1)
    outlying[outlying] = deviation[outlying] > threshold * np.partition(rings, _RING_RANK, axis=1)[:, _RING_RANK]
    return outlying
