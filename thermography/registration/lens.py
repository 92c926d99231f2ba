"""Intrinsic parameters of a lens from a calibration, and the file in which OpenCV writes them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from thermography._typing import Array
from thermography.errors import ThermographyError

#: Names that a file may give to the camera matrix and to the coefficients: those of OpenCV's calibration samples, and short ones.
_MATRIX_NAMES = ("camera_matrix", "cameraMatrix", "K")
_COEFFICIENT_NAMES = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "D")
#: Largest relative difference of the focal lengths along columns and rows: the pixels of a sensor are square.
_SQUARE = 0.01
#: A calibration is a page of text, with the views that it was made from a hundred.
_MOST_BYTES = 200_000
#: Most numbers of an entry, and lists within lists: far more than a calibration has.
_MOST_NUMBERS, _MOST_DEPTH = 1_000, 5


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
    entries = _read_entries(path)
    matrix = _entry(entries, path, _MATRIX_NAMES, 9).reshape(3, 3)
    coefficients = _entry(entries, path, _COEFFICIENT_NAMES, None)
    size = _size(entries, path)
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


class _MatrixLoader(yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader):  # type: ignore[misc]
    """Builds plain values only; a matrix of OpenCV is a mapping."""


_MatrixLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def _read_entries(path: Path) -> dict[str, Any]:
    """Names and values of a file. OpenCV's own parser ends the process on some damaged files."""
    content = path.read_bytes() if path.stat().st_size <= _MOST_BYTES else b""
    if not content or b"\0" in content or b"<!DOCTYPE" in content:
        raise LensError(
            f"{path}: no calibration: plain text of at most {_MOST_BYTES} bytes is expected; write it as OpenCV's YAML, XML or JSON"
        )
    try:
        text = content.decode().lstrip()
        if text.startswith("<"):
            entries = {child.tag: _plain(child) for child in ElementTree.fromstring(text)}
        elif text.startswith("{"):
            entries = json.loads(text)
        else:
            # OpenCV writes the version of YAML as no other does.
            entries = yaml.load(text.removeprefix("%YAML:1.0"), _MatrixLoader)
    except (ValueError, TypeError, RecursionError, yaml.YAMLError, ElementTree.ParseError) as error:
        raise LensError(
            f"{path}: cannot be parsed ({error}); write the calibration as OpenCV's YAML, XML or JSON"
        ) from None
    if not isinstance(entries, dict):
        raise LensError(f"{path}: holds no named entries; write the calibration as OpenCV's YAML, XML or JSON")
    return entries


def _plain(element: ElementTree.Element) -> Any:
    """Value of an XML element: a mapping of its children, or the words of its text."""
    if len(element):
        return {child.tag: _plain(child) for child in element}
    return (element.text or "").split()


def _size(entries: dict[str, Any], path: Path) -> tuple[int, int] | None:
    """Width and height of the frames of the calibration, px; None where they are not given."""
    if not {"image_width", "image_height"} <= entries.keys():
        return None
    width, height = (_entry(entries, path, (name,), 1)[0] for name in ("image_width", "image_height"))
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
        raise LensError(
            f"{path}: image_width {width:g} and image_height {height:g} px are no size of a frame; correct them"
        )
    return int(width), int(height)


def _entry(entries: dict[str, Any], path: Path, names: tuple[str, ...], count: int | None) -> Array:
    """The first entry of these names that the file holds, as numbers (n,)."""
    name = next((name for name in names if name in entries), None)
    if name is None:
        raise LensError(f"{path}: no entry {names[0]}; write the calibration as OpenCV's samples do")
    try:
        values = np.array(_numbers(entries[name]), float)
    except (TypeError, ValueError, OverflowError) as error:
        raise LensError(f"{path}: {name} is damaged ({error}); write the calibration again") from None
    if count is not None and values.size != count:
        raise LensError(f"{path}: {name} holds {values.size} numbers instead of {count}; write the calibration again")
    return values


def _numbers(value: Any, depth: int = 0) -> list[float]:
    """All numbers of a value: a matrix of OpenCV, lists of lists, or one number."""
    if isinstance(value, dict):
        rows, columns, numbers = (_numbers(value.get(key, []), depth + 1) for key in ("rows", "cols", "data"))
        if len(rows) != 1 or len(columns) != 1 or rows[0] * columns[0] != len(numbers):
            raise ValueError(f"{len(numbers)} numbers do not fill its rows and columns")
        return numbers
    if not isinstance(value, list):
        return [float(value)]
    numbers = []
    for one in value if depth < _MOST_DEPTH else ():
        numbers += _numbers(one, depth + 1)
        if len(numbers) > _MOST_NUMBERS:
            raise ValueError(f"more than {_MOST_NUMBERS} numbers")
    return numbers
