"""Intrinsic parameters of a lens from a calibration, and the file in which OpenCV writes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from thermography._typing import Array
from thermography.errors import ThermographyError

#: Names that a file may give to the camera matrix and to the coefficients: those of OpenCV's calibration samples, and short ones.
_MATRIX_NAMES = ("camera_matrix", "cameraMatrix", "K")
_COEFFICIENT_NAMES = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D")
#: Largest relative difference of the focal lengths along columns and rows: the pixels of a sensor are square.
_SQUARE = 0.01
#: A calibration is a few pages of text: OpenCV's parser overruns its memory on longer lines.
_MOST_BYTES, _MOST_COLUMNS = 1_000_000, 20_000


class LensError(ThermographyError):
    """A lens file does not hold a calibration that can be used; the message names file, entry and remedy."""


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters from a lens calibration, in OpenCV's convention.

    Attributes
    ----------
    focal_length_px : float, px
        Unit of the normalised image coordinates.
    principal_point_px : (column, row), px
        Centre of the distortion.
    distortion : (k1, k2, p1, p2)
        Of the normalised image coordinates.
    size_px : (int, int) or None
        (columns, rows) of the frames that the calibration was made with; None where it is not stated.
    """

    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: tuple[float, float, float, float]
    size_px: tuple[int, int] | None = None


def read_lens(path: str | Path) -> Lens:
    """Read a lens calibration as OpenCV writes it.

    Parameters
    ----------
    path : str or Path
        YAML, XML or JSON file of ``cv2.FileStorage`` with ``camera_matrix`` (3 x 3) and ``distortion_coefficients`` (k1, k2, p1, p2
        and zeros); ``image_width`` and ``image_height`` are held against the frames where they are given. Plain lists in JSON serve
        as well.

    Returns
    -------
    Lens

    Raises
    ------
    LensError
        The file cannot be parsed, an entry is missing or has another shape, the pixels are not square, or the calibration has
        coefficients beyond p2.

    Notes
    -----
    OpenCV documentation, "Camera calibration with OpenCV" (the entries), "Camera Calibration and 3D Reconstruction" (the model).
    """
    path = Path(path)
    _refuse_what_is_no_text(path)
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise LensError(
            f"{path}: not a file of cv2.FileStorage; write the calibration as OpenCV's YAML, XML or JSON"
        ) from error
    if not storage.isOpened():
        raise LensError(
            f"{path}: cannot be opened as a file of cv2.FileStorage; write it as OpenCV's YAML, XML or JSON"
        )
    try:
        matrix = _entry(storage, path, _MATRIX_NAMES, 9).reshape(3, 3)
        coefficients = _entry(storage, path, _COEFFICIENT_NAMES, None).ravel()
        size = _size(storage)
    except (cv2.error, OverflowError, ValueError, RecursionError) as error:
        raise LensError(f"{path}: an entry is damaged ({error}); write the calibration again") from None
    finally:
        storage.release()
    along, across = float(matrix[0, 0]), float(matrix[1, 1])
    if not (np.isfinite(matrix).all() and min(along, across) > 0 and abs(along / across - 1) < _SQUARE):
        raise LensError(
            f"{path}: camera_matrix has focal lengths {along:g} and {across:g} px; the pixels of a sensor are square: both are positive "
            f"and agree to {_SQUARE:.0%} in a calibration that succeeded"
        )
    if len(coefficients) < 4 or not np.isfinite(coefficients).all() or coefficients[4:].any():
        raise LensError(
            f"{path}: distortion_coefficients = {coefficients.tolist()}; give k1, k2, p1, p2, and calibrate without more "
            "(flag CALIB_FIX_K3)"
        )
    k1, k2, p1, p2 = coefficients[:4].tolist()
    return Lens(float(np.sqrt(along * across)), (float(matrix[0, 2]), float(matrix[1, 2])), (k1, k2, p1, p2), size)


def _refuse_what_is_no_text(path: Path) -> None:
    """Refuse what no calibration looks like: OpenCV's parser does not survive every file."""
    content = path.read_bytes() if path.stat().st_size <= _MOST_BYTES else b""
    if not content or max(map(len, content.splitlines())) > _MOST_COLUMNS or b"\0" in content:
        raise LensError(
            f"{path}: no calibration: plain text is expected, at most {_MOST_BYTES} bytes in lines of {_MOST_COLUMNS} characters; "
            "write it as OpenCV's YAML, XML or JSON"
        )


def _size(storage: cv2.FileStorage) -> tuple[int, int] | None:
    """Width and height of the frames of the calibration, px; None where they are not given."""
    width, height = (storage.getNode(name) for name in ("image_width", "image_height"))
    return None if width.empty() or height.empty() else (int(width.real()), int(height.real()))


def _entry(storage: cv2.FileStorage, path: Path, names: tuple[str, ...], count: int | None) -> Array:
    """The first entry of these names that the file holds, as numbers."""
    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        values = _numbers(node)
        if count is None or values.size == count:
            return values
        raise LensError(f"{path}: {name} holds {values.size} numbers instead of {count}")
    raise LensError(f"{path}: no entry {names[0]}; write the calibration as OpenCV's samples do")


def _numbers(node: cv2.FileNode) -> Array:
    """All numbers of a node: a matrix, or lists of lists."""
    if node.isMap():
        matrix = node.mat()
        return np.asarray([] if matrix is None else matrix, float)
    if node.isSeq():
        return np.concatenate([_numbers(node.at(i)) for i in range(node.size())] or [np.empty(0)])
    return np.array([node.real()])
