"""Keeps what a scan of a long recording found, so that opening it again reads a file of some megabytes and not every header.

The headers of a day of video stand 600 kB apart; from a disk each of them costs a read of its own. What was found is kept in the user's
cache, never beside the recording, and used again only for the same file: path, size, time of change, first and last bytes.
"""

from __future__ import annotations

import json
import logging
import os
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import platformdirs

from thermography._typing import Array
from thermography.io.atomic import write_atomically

#: Names a folder that keeps what can be made again; left out, that of the user's cache.
CACHE_VARIABLE = "THERMOFUSE_CACHE"
#: Runs of fewer frames are scanned anew: from a disk, that takes three seconds.
FEWEST_KEPT = 20_000
#: Kept files beyond this size together are removed, those first that were written first, bytes.
_MOST_KEPT = 1 << 30
#: So many of the first and of the last bytes of a recording are compared.
_EDGE = 1 << 16
#: To be raised with every change of what is kept.
_VERSION = 1
_ABOUT = "about"

_log = logging.getLogger(__name__)


def recall(file: BinaryIO, path: Path, start: int, empty: Mapping[str, Array]) -> dict[str, Array] | None:
    """Return what was kept of a run of frames; None where nothing was, or not of the file as it is now.

    Parameters
    ----------
    file : binary file
        The recording.
    path : Path
        Its path.
    start : int
        Where the run begins, bytes.
    empty : mapping of str to ndarray
        Arrays of the types and of the shapes, but for the first dimension, that must be found.

    Returns
    -------
    dict of str to ndarray, or None
    """
    kept = _place(path, start)
    try:
        with kept.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            about = json.loads(str(stored[_ABOUT]))
            if about["version"] != _VERSION:
                return None
            if about != _about(file):
                _log.warning("%s has changed since its headers were read; they are read again", path)
                _remove(kept)
                return None
            columns = {name: stored[name] for name in empty}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        _log.warning("%s, which keeps the headers of %s, is damaged (%s); they are read again", kept, path, error)
        _remove(kept)
        return None
    alike = all(
        (columns[name].dtype, columns[name].shape[1:]) == (array.dtype, array.shape[1:])
        for name, array in empty.items()
    )
    return columns if alike else None


def keep(file: BinaryIO, path: Path, start: int, columns: Mapping[str, Array]) -> None:
    """Keep what was found of a run of frames; nothing where the cache cannot be written to.

    Parameters
    ----------
    file : binary file
        The recording.
    path : Path
        Its path.
    start : int
        Where the run begins, bytes.
    columns : mapping of str to ndarray
    """
    about = np.array(json.dumps(_about(file)))
    place = _place(path, start)

    def write(temporary: Path) -> None:
        np.savez(temporary, **{_ABOUT: about, **columns})  # type: ignore[arg-type]

    try:
        write_atomically(place, write)
        _remove_first_written(place.parent)
    except OSError as error:
        _log.info("the headers of %s are not kept: %s", path, error)


def _place(path: Path, start: int) -> Path:
    """Where a run of frames of a file is kept."""
    cache = Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("thermofuse"))
    return cache / "frame_index" / f"{sha256(f'{start} {path.resolve()}'.encode()).hexdigest()[:32]}.npz"


def _about(file: BinaryIO) -> dict[str, Any]:
    """What tells whether a file is the one that was scanned."""
    status = os.fstat(file.fileno())
    edges = sha256()
    for place in (0, max(status.st_size - _EDGE, 0)):
        file.seek(place)
        edges.update(file.read(_EDGE))
    return {"version": _VERSION, "bytes": status.st_size, "changed_ns": status.st_mtime_ns, "edges": edges.hexdigest()}


def _remove(kept: Path) -> None:
    """Remove a file that is of no use, so that it is told once; Windows keeps one that is open."""
    with suppress(OSError):
        kept.unlink()


def _remove_first_written(folder: Path) -> None:
    """Remove the files that were written first where all together are too large."""
    kept = sorted(folder.glob("*.npz"), key=lambda each: each.stat().st_mtime_ns, reverse=True)
    total = 0
    for each in kept:
        total += each.stat().st_size
        if total > _MOST_KEPT:
            each.unlink(missing_ok=True)
