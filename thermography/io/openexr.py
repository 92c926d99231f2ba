"""Maps as OpenEXR, one part per quantity, read back and compared bit by bit before they count as written."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from thermography.errors import ThermographyError

Map = NDArray[np.float32]

#: Part that tells viewers which cells hold a value (1) and which are NaN (0).
MASK = "mask"
_RECORD = "thermofuse"


class ExrError(ThermographyError):
    """A map cannot be written or read as it should; the message names the file and the quantity."""


def write_maps(
    path: str | os.PathLike[str], maps: Mapping[str, NDArray[np.floating]], *, record: Mapping[str, Any] | None = None
) -> None:
    """Write maps of one shape as one OpenEXR file, ZIP-compressed, and read them back.

    Parameters
    ----------
    path
        File to write; it appears whole or not at all.
    maps
        By quantity, each (y, x); values are stored as float32. A part `mask` (1 where every quantity has a value) is added
        unless there is one, because several viewers stumble over NaN.
    record
        Numbers and texts to go with the maps (units, cell size, cycle): one JSON text, because OpenEXR keeps floats as float32.

    Raises
    ------
    ExrError
        There is no map, shapes differ, a value does not fit float32, or the file does not read back bit for bit.
    """
    path = Path(path)
    parts = {name: _as_float32(path, name, values) for name, values in maps.items()}
    if not parts:
        raise ExrError(f"{path}: there is no map to write")
    shapes = {name: values.shape for name, values in parts.items()}
    if len(set(shapes.values())) > 1:
        raise ExrError(f"{path}: the maps differ in shape: {shapes}; write one file per grid")
    parts.setdefault(MASK, np.asarray(np.isfinite(np.stack(list(parts.values()))).all(axis=0), np.float32))
    text = json.dumps(dict(record or {}), sort_keys=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        # The library takes no Path, and writes arrays that are not contiguous wrongly without a word (openexr issue 1929).
        OpenEXR.File([_part(name, values, text) for name, values in parts.items()]).write(str(temporary))
        back, _ = _read(temporary)
        for name, values in parts.items():
            if name not in back or back[name].tobytes() != values.tobytes():
                raise ExrError(
                    f"{path}: {name} does not read back as it was written; the disk or the OpenEXR library is at fault"
                )
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_maps(path: str | os.PathLike[str]) -> dict[str, Map]:
    """Read the maps of an OpenEXR file written by `write_maps`, by quantity, each (y, x) float32, the mask included.

    Raises
    ------
    ExrError
        The file is not OpenEXR or holds no single-channel part.
    """
    return _read(Path(path))[0]


def read_record(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the numbers and texts that `write_maps` put beside the maps."""
    return _read(Path(path))[1]


def _part(name: str, values: Map, text: str) -> Any:
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, "name": name, _RECORD: text}
    return OpenEXR.Part(header, {"Y": values}, name)


def _as_float32(path: Path, name: str, values: NDArray[np.floating]) -> Map:
    values = np.asarray(values)
    if values.ndim != 2 or 0 in values.shape:
        raise ExrError(f"{path}: {name} has shape {values.shape}; a map is (y, x)")
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, np.float32)
    if (np.isinf(single) & ~np.isinf(values)).any():
        raise ExrError(
            f"{path}: {name} holds {np.nanmax(np.abs(values)):g}, which float32 cannot; give it in another unit"
        )
    return single


def _read(path: Path) -> tuple[dict[str, Map], dict[str, Any]]:
    if not path.is_file():
        raise ExrError(f"{path}: there is no such file")
    try:
        file = OpenEXR.File(str(path))
    except Exception as error:
        raise ExrError(f"{path}: is not an OpenEXR file ({error})") from error
    maps = {part.name(): np.array(part.channels["Y"].pixels, np.float32) for part in file.parts if "Y" in part.channels}
    if not maps:
        raise ExrError(f"{path}: holds no single-channel part; it was not written as maps")
    return maps, json.loads(file.parts[0].header.get(_RECORD, "{}"))
