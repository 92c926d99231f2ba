"""Files that are written whole or not at all, also where the machine loses power."""

from __future__ import annotations

import os
import re
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

#: Stands before the suffix of a file that is being written, followed by the writer: a number of this process and that of the thread.
PARTIAL = ".partial"
_PARTIAL_NAME = re.compile(rf"\.(?P<stem>.+){re.escape(PARTIAL)}(?:[0-9a-f]{{8}}-)?\d*(?P<suffix>(?:\.[^.]*)?)")
_PROCESS = secrets.token_hex(4)


def partial_path(path: Path) -> Path:
    """Return the temporary name under which this thread writes a file: hidden, so that no pattern takes it for the file.

    Parameters
    ----------
    path : Path
        The file; its suffix is kept, as some libraries choose the format by it.

    Notes
    -----
    The number of the thread keeps apart the writers of one system. Containers and machines that share a folder may have the same
    numbers: these are kept apart by a random number of the process.
    """
    return path.with_name(f".{path.stem}{PARTIAL}{_PROCESS}-{threading.get_native_id()}{path.suffix}")


def finished_path(partial: Path) -> Path | None:
    """Return the file that is, or was, written under a temporary name, by any thread; None for another name.

    Parameters
    ----------
    partial : Path
        Any file.
    """
    name = _PARTIAL_NAME.fullmatch(partial.name)
    return partial.with_name(f"{name['stem']}{name['suffix']}") if name else None


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Let `write` fill a temporary file beside `path`, bring it to the disk, then put it in place in one step.

    A run that is killed, and a machine that loses power, leave the old file or none, never half of the new one.

    Parameters
    ----------
    path : Path
        The file; its folder is created where it is absent.
    write : callable
        Writes the whole file to the path that it is given.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OSError
        If the folder cannot be written to or the disk is full; no temporary file is left, nor a folder that was created for it.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "results.txt"
    >>> write_atomically(path, lambda temporary: temporary.write_text("whole")).read_text()
    'whole'
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
