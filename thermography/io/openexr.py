"""Writes maps as OpenEXR, one part per quantity, and verifies bit by bit that they read back."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from thermography.errors import ThermographyError
from thermography.io.atomic import write_atomically

_Map = NDArray[np.float32]

#: Part that tells viewers which cells hold a value (1) and which are NaN (0).
_MASK = "mask"


class ExrError(ThermographyError):
    """A map cannot be written or read; the message names the file and the quantity."""


def write_maps(path: str | os.PathLike[str], maps: Mapping[str, NDArray[np.floating]]) -> None:
    """Write maps of one shape as one ZIP-compressed OpenEXR file and verify that they read back.

    Parameters
    ----------
    path : str or path-like
        File to write; it is replaced as a whole or left as it was.
    maps : mapping of str to (y, x) ndarray
        Maps by name of the quantity, in any unit; stored as float32, NaN where there is no value. A part ``mask``, 1 where every
        quantity is finite and 0 elsewhere, is added unless it is given, because several viewers do not handle NaN.

    Raises
    ------
    ExrError
        Where there is no map, the shapes differ, a value exceeds float32, the file cannot be written, or does not read back bit for bit.
    """
    path = Path(path)
    parts = {name: _as_float32(path, name, values) for name, values in maps.items()}
    if not parts:
        raise ExrError(f"{path}: there is no map to write")
    shapes = {name: values.shape for name, values in parts.items()}
    if len(set(shapes.values())) > 1:
        raise ExrError(f"{path}: the maps differ in shape: {shapes}; write one file per grid")
    parts.setdefault(_MASK, np.asarray(np.isfinite(np.stack(list(parts.values()))).all(axis=0), np.float32))

    def write_parts(temporary: Path) -> None:
        # The library takes no Path, and silently writes wrong values for arrays that are not contiguous (openexr issue 1929).
        try:
            OpenEXR.File([_part(name, values) for name, values in parts.items()]).write(str(temporary))
        except RuntimeError as error:
            raise ExrError(f"{path}: cannot be written ({error}); make room, or name another folder") from error
        stored = read_maps(temporary)
        for name, values in parts.items():
            if name not in stored or stored[name].tobytes() != values.tobytes():
                raise ExrError(
                    f"{path}: {name} does not read back as it was written; the disk or the OpenEXR library is at fault"
                )

    write_atomically(path, write_parts)


def read_maps(path: str | os.PathLike[str]) -> dict[str, NDArray[np.float32]]:
    """Read the maps of an OpenEXR file that `write_maps` wrote.

    Parameters
    ----------
    path : str or path-like
        OpenEXR file.

    Returns
    -------
    dict of str to (y, x) ndarray of float32
        Maps by name of the quantity, in the units in which they were written, and the part ``mask``.

    Raises
    ------
    ExrError
        Where the file does not exist, is not OpenEXR, or holds no single-channel part.
    """
    path = Path(path)
    if not path.is_file():
        raise ExrError(f"{path}: there is no such file")
    try:
        file = OpenEXR.File(str(path))
    except Exception as error:
        raise ExrError(f"{path}: is not an OpenEXR file ({error})") from error
    maps = {part.name(): np.array(part.channels["Y"].pixels, np.float32) for part in file.parts if "Y" in part.channels}
    if not maps:
        raise ExrError(f"{path}: holds no single-channel part; it was not written as maps")
    return maps


def _part(name: str, values: _Map) -> OpenEXR.Part:
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "name": name}
    return OpenEXR.Part(header, {"Y": values}, name)


def _as_float32(path: Path, name: str, values: NDArray[np.floating]) -> _Map:
    """Return a map as contiguous float32; raise an ExrError where it is no map or a value overflows."""
    values = np.asarray(values)
    if values.ndim != 2 or 0 in values.shape:
        raise ExrError(f"{path}: {name} has shape {values.shape}; a map is (y, x)")
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, np.float32)
    if (np.isinf(single) & ~np.isinf(values)).any():
        raise ExrError(
            f"{path}: {name} holds {np.nanmax(np.abs(values)):g}, which float32 cannot represent; give it in another unit"
        )
    return single
