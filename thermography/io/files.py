"""Files that are written whole or not at all, also where the machine loses power; HDF5 files that are not read."""

from __future__ import annotations

import itertools
import os
import re
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from thermography.common import ThermographyError

#: Stands before the suffix of a file that is being written, followed by the writer: a number of this process and that of the thread.
PARTIAL = ".partial"
_PARTIAL_NAME = re.compile(rf"\.(?P<stem>.+){re.escape(PARTIAL)}(?:[0-9a-f]{{8}}-)?\d*(?P<suffix>(?:\.[^.]*)?)")
_PROCESS = secrets.token_hex(4)


def partial_path(path: Path) -> Path:
    """Return the temporary name under which this thread writes a file: hidden, so that no pattern takes it for the file."""
    return path.with_name(f".{path.stem}{PARTIAL}{_PROCESS}-{threading.get_native_id()}{path.suffix}")


def finished_path(partial: Path) -> Path | None:
    """Return the file that is, or was, written under a temporary name, by any thread; None for another name."""
    name = _PARTIAL_NAME.fullmatch(partial.name)
    return partial.with_name(f"{name['stem']}{name['suffix']}") if name else None


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Let `write` fill a temporary file in the folder of `path`, bring it to the disk, then put it in place in one step.

    A run that is killed, and a machine that loses power, leave the old file or none, never half of the new one. After an OSError no
    temporary file is left, nor a folder that was created for it.
    """
    absent = [folder for folder in path.parents if not folder.exists()]
    temporary = partial_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        _bring_to_disk(temporary, os.O_RDWR)
        temporary.replace(path)
        # The new name is on the disk once the folder is. Windows does not open folders; NTFS keeps a journal of names.
        if os.name == "posix":
            _bring_to_disk(path.parent, os.O_RDONLY)
    except BaseException:
        for remove in (temporary.unlink, *(folder.rmdir for folder in absent)):
            with suppress(OSError):
                remove()
        raise
    return path


def _bring_to_disk(path: Path, mode: int) -> None:
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# Writes maps as OpenEXR, one part per quantity, and verifies bit by bit that they read back.

#: Part that tells viewers which cells hold a value (1) and which are NaN (0).
_MASK = "mask"


class ExrError(ThermographyError):
    """A map cannot be written or read; the message names the file and the quantity."""


def write_maps(
    path: str | os.PathLike[str],
    maps: Mapping[str, NDArray[np.floating]],
    *,
    units: Mapping[str, str] = MappingProxyType({}),
    attributes: Mapping[str, str | int | float] = MappingProxyType({}),
) -> None:
    """Write maps of one shape, with their units and attributes, as one ZIP-compressed OpenEXR file and verify that they read back."""
    path = Path(path)
    parts = {name: _as_float32(path, name, values) for name, values in maps.items()}
    if not parts:
        raise ExrError(f"{path}: there are no maps to write")
    shapes = {name: values.shape for name, values in parts.items()}
    if len(set(shapes.values())) > 1:
        raise ExrError(f"{path}: the maps differ in shape: {shapes}; write one file per grid")
    parts.setdefault(_MASK, np.asarray(np.isfinite(np.stack(list(parts.values()))).all(axis=0), np.float32))

    def write_parts(temporary: Path) -> None:
        # The library takes no Path, and silently writes wrong values for arrays that are not contiguous (openexr issue 1929).
        try:
            header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **attributes}
            each = [
                OpenEXR.Part({**header, "name": name, "unit": units.get(name, "1")}, {"Y": values}, name)
                for name, values in parts.items()
            ]
            OpenEXR.File(each).write(str(temporary))
        except RuntimeError as error:
            raise ExrError(f"{path}: cannot be written ({error}); make room, or name another folder") from error
        stored = read_maps(temporary)
        for name, values in parts.items():
            if name not in stored or stored[name].tobytes() != values.tobytes():
                raise ExrError(f"{path}: {name} does not read back as written; the disk or OpenEXR is at fault")

    write_atomically(path, write_parts)


def read_maps(path: str | os.PathLike[str]) -> dict[str, NDArray[np.float32]]:
    """Read the maps of an OpenEXR file that `write_maps` wrote."""
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


def read_header(path: str | os.PathLike[str]) -> dict[str, object]:
    """Return the attributes of an OpenEXR file, and the unit of every part by its name."""
    parts = OpenEXR.File(str(path), header_only=True).parts
    return {**parts[0].header, **{part.name(): part.header.get("unit", "") for part in parts}}


def _as_float32(path: Path, name: str, values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return a map as contiguous float32; raise an ExrError where it is no map or a value overflows."""
    values = np.asarray(values)
    if values.ndim != 2 or 0 in values.shape:
        raise ExrError(f"{path}: {name} has shape {values.shape}; a map is (y, x)")
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, np.float32)
    if (np.isinf(single) & ~np.isinf(values)).any():
        raise ExrError(f"{path}: {name} holds {np.nanmax(np.abs(values)):g}, beyond float32; give it in another unit")
    return single


# HDF5 files that are not read: a stranger's file must neither show other files of this machine nor fill its memory.

#: A dataset of more bytes than that, and than so many times those of its file, was not written: deflate packs by 1032 at most.
_LARGE_BYTES, _MOST_PACKED = 1_000_000_000, 1_100
#: Datasets and groups of a file: the products of a run have up to 150, and each costs a reader a millisecond whenever it opens the file.
MOST_OBJECTS = 1_000
#: Groups within one another; deeper ones take a reader minutes, and a group that is linked within itself for ever.
_MOST_NESTED = 20


def hdf5_fault(path: Path) -> str:
    """Return why an HDF5 file is not read although its library would do so; empty where nothing speaks against it."""
    # Loaded with the first such file: a finished run is recognised without it.
    import h5py

    most_bytes, paths = max(_LARGE_BYTES, _MOST_PACKED * path.stat().st_size), itertools.count(1)

    def of_link(name: str, found: Any) -> str | None:
        if name.count("/") > _MOST_NESTED:
            return f"it nests groups more than {_MOST_NESTED} deep"
        return f"{name} is in another file" if isinstance(found, h5py.ExternalLink) else None

    # As a reader walks it, which comes to an object by every path: a link may lead back to a group around it.
    def of_group(group: Any, name: str) -> str:
        if name.count("/") > _MOST_NESTED:
            return f"it nests groups more than {_MOST_NESTED} deep"
        return next(filter(None, (of_object(found, f"{name}{key}") for key, found in group.items())), "")

    def of_object(found: Any, name: str) -> str:
        if next(paths) > MOST_OBJECTS:
            return f"it holds more than {MOST_OBJECTS} datasets and groups"
        if isinstance(found, h5py.Group):
            return of_group(found, f"{name}/")
        if not isinstance(found, h5py.Dataset):
            return ""
        if found.external or found.is_virtual:
            return f"the values of {name} are in another file"
        return (
            f"{name} states {found.nbytes / 1e9:.3g} GB, more than the file holds" if found.nbytes > most_bytes else ""
        )

    with h5py.File(path) as file:
        return file.visititems_links(of_link) or of_group(file, "")
