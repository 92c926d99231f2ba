"""What FLIR cameras store beside the pixels: the spots and areas that were set on the screen, and the visible-light picture.

The layout of these records was established on the files of data/registry.csv that hold them: five with spots and areas, 25 with pictures
(ExifTool, P. Harvey, "FLIR Tags", names the fields).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography.io.fff_record import FffSource, read_directory
from thermography.io.flir import FlirFrameReference
from thermography.io.frame import FlirFormatError

_TOOLS_RECORD, _PICTURE_RECORD, _OVERLAY_RECORD = 0x21, 0x0E, 0x2A
#: Header of the measurement tools, and of each tool, bytes.
_TOOLS_HEADER, _TOOL_HEADER = 12, 0x24
#: Number of a tool -> its name and the meaning of its coordinates, as far as files show it.
_KINDS = {1: ("spot", ("column", "row")), 2: ("area", ("column", "row", "width", "height"))}
#: Largest records of these kinds; a damaged length must not cost memory.
_LARGEST_TOOLS, _LARGEST_PICTURE = 1 << 16, 1 << 26


@dataclass(frozen=True)
class MeasurementRegion:
    """A measurement tool that was set in the camera or in its program.

    Attributes
    ----------
    label : str
        As shown on the screen, such as "Sp1".
    kind : str
        "spot", "area", or "tool 3" and so on for tools whose coordinates are not known.
    place : dict of str to int
        Coordinates by name, pixels of the sensor from 0; "value 1" and so on where their meaning is not known.
    """

    label: str
    kind: str
    place: dict[str, int]


@dataclass(frozen=True, eq=False)
class VisiblePicture:
    """The visible-light picture that a camera took with a frame.

    Attributes
    ----------
    pixels : (row, column, 3) ndarray of uint8
        Red, green, blue.
    scale : float
        Field of view of the picture over that of the sensor; 0 where the file does not say it.
    offset_px : (int, int)
        Shift (column, row) of the sensor's middle in the picture, as stored.
    """

    pixels: NDArray[np.uint8]
    scale: float
    offset_px: tuple[int, int]


def read_measurement_regions(frame: FlirFrameReference) -> list[MeasurementRegion]:
    """Read the spots and areas that a frame stores.

    Parameters
    ----------
    frame : FlirFrameReference

    Returns
    -------
    list of MeasurementRegion
        Empty where the file stores none, or in a layout that is not known.

    Raises
    ------
    FlirFormatError, OSError
        The record lies outside the file, or the file cannot be opened.
    """
    data = _record(frame, _TOOLS_RECORD, _LARGEST_TOOLS)
    regions: list[MeasurementRegion] = []
    if data is None or data[:2] != b"\1\0":
        return regions
    at = _TOOLS_HEADER
    while at + _TOOL_HEADER <= len(data):
        length, coordinates, kind = (struct.unpack_from("<H", data, at + place)[0] for place in (0, 4, 10))
        if not _TOOL_HEADER + coordinates <= length <= len(data) - at or coordinates % 2 or coordinates == 0:
            break
        values = struct.unpack_from(f"<{coordinates // 2}H", data, at + _TOOL_HEADER)
        label = data[at + _TOOL_HEADER + coordinates : at + length].decode("utf-16-le", "replace").split("\0")[0]
        name, meanings = _KINDS.get(kind, (f"tool {kind}", ()))
        if len(meanings) != len(values):
            meanings = tuple(f"value {i + 1}" for i in range(len(values)))
        regions.append(MeasurementRegion(label, name, dict(zip(meanings, values, strict=True))))
        at += length
    return regions


def read_visible_picture(frame: FlirFrameReference) -> VisiblePicture | None:
    """Read the visible-light picture of a frame.

    Parameters
    ----------
    frame : FlirFrameReference

    Returns
    -------
    VisiblePicture or None
        None where the file holds none.

    Raises
    ------
    FlirFormatError, OSError
        The picture is damaged, or the file cannot be opened.
    """
    data = _record(frame, _PICTURE_RECORD, _LARGEST_PICTURE)
    if data is None:
        return None
    start = max(data.find(b"\xff\xd8\xff"), data.find(b"\x89PNG"))
    pixels = cv2.imdecode(np.frombuffer(data[max(start, 0) :], np.uint8), cv2.IMREAD_COLOR) if start >= 0 else None
    if pixels is None:
        raise FlirFormatError(f"{frame.path}: the visible-light picture of frame {frame.index} is damaged")
    overlay = _record(frame, _OVERLAY_RECORD, _LARGEST_TOOLS)
    scale, column, row = (0.0, 0, 0) if overlay is None or len(overlay) < 8 else struct.unpack_from("<fhh", overlay)
    return VisiblePicture(np.asarray(pixels[..., ::-1], np.uint8), float(scale), (int(column), int(row)))


def _record(frame: FlirFrameReference, kind: int, largest: int) -> bytes | None:
    """Return the bytes of the first record of a kind, None where there is none or its length is not credible."""
    with frame.path.open("rb", buffering=0) as file:
        source = FffSource(file, frame.path, frame.segments)
        place = read_directory(source).records.get(kind)
        if place is None or not 0 < place[1] <= largest:
            return None
        return bytes(source.take(*place, "annotations"))
