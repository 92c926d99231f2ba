"""Keeps what a scan of a long recording found, so that opening it again reads a file of some megabytes and not every header.

The headers of a day of video stand 600 kB apart; from a disk each of them costs a read of its own. What was found is kept in the user's
cache, never beside the recording, and used again only for the same file: path, size, time of change, first and last bytes.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

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

Run = TypeVar("Run")


def recall(file: BinaryIO, path: Path, start: int, take: Callable[[Mapping[str, Array]], Run]) -> Run | None:
    """Return what was kept of a run of frames; None where nothing was, or not of the file as it is now.

    Parameters
    ----------
    file : binary file
        The recording.
    path : Path
        Its path.
    start : int
        Where the run begins, bytes.
    take : callable
        Makes the run of the arrays that were kept; raises a ValueError or LookupError where they are not those of a run.

    Returns
    -------
    Run or None
        What `take` has made.

    Raises
    ------
    OSError
        If the recording cannot be read; no fault of the cache is raised.
    """
    kept = _place(path, start)
    try:
        opened = kept.open("rb")
    except OSError:
        # Nothing was kept, or the cache cannot be used: where that costs time, `keep` says it.
        return None
    with opened:
        about = _about(file)
        try:
            with np.load(opened, allow_pickle=False) as stored:
                about_then = json.loads(str(stored[_ABOUT]))
                if about_then == about:
                    return take(stored)
                same_version = about_then["version"] == _VERSION
            fault = f"{path} has changed since its headers were read" if same_version else ""
        # What is kept can be made again, so no fault of it may end a run. Damaged bytes raise nearly everything: NotImplementedError and
        # RuntimeError from the directory of the zip file, SyntaxError and TokenError from the headers of its arrays.
        except Exception as error:
            fault = f"{kept}, which keeps the headers of {path}, is damaged ({error})"
    if fault:
        _log.warning("%s; they are read again", fault)
    _remove(kept)
    return None


def keep(file: BinaryIO, path: Path, start: int, columns: Mapping[str, Array]) -> None:
    """Keep what was found of a run of frames; where the cache cannot be written to, that is said.

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
    except OSError as error:
        # Another process that keeps the same has made room, and this file with it; its own is as good.
        if isinstance(error, FileNotFoundError) and place.exists():
            return
        remedy = f"let {CACHE_VARIABLE} name a folder that can be written to"
        _log.warning("the headers of %s cannot be kept, every opening reads them (%s); %s", path, error, remedy)
        return
    _remove_first_written(place.parent)


def _place(path: Path, start: int) -> Path:
    """Where a run of frames of a file is kept."""
    cache = Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("thermofuse"))
    # The bytes of the path, which need not be text.
    key = f"{start} ".encode() + os.fsencode(path.resolve())
    return cache / "frame_index" / f"{sha256(key).hexdigest()[:32]}.npz"


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
    kept = []
    for each in folder.glob("*.npz"):
        # Another process may have removed it meanwhile.
        with suppress(OSError):
            status = each.stat()
            kept.append((status.st_mtime_ns, status.st_size, each))
    total = 0
    for _, size, each in sorted(kept, reverse=True):
        total += size
        if total > _MOST_KEPT:
            _remove(each)
