"""Files that are written whole or not at all, also where the machine loses power."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

#: Stands before the suffix of a file that is being written.
PARTIAL = ".partial"


def partial_path(path: Path) -> Path:
    """Return the temporary name under which a file is written: hidden, so that no pattern takes it for the file.

    Parameters
    ----------
    path : Path
        The file; its suffix is kept, as some libraries choose the format by it.
    """
    return path.with_name(f".{path.stem}{PARTIAL}{path.suffix}")


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
        If the folder cannot be written to or the disk is full; no temporary file is left.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "results.txt"
    >>> write_atomically(path, lambda temporary: temporary.write_text("whole")).read_text()
    'whole'
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = partial_path(path)
    try:
        write(temporary)
        _bring_to_disk(temporary, os.O_RDWR)
        temporary.replace(path)
        # The new name is on the disk once the folder is. Windows does not open folders; NTFS keeps a journal of names.
        if os.name == "posix":
            _bring_to_disk(path.parent, os.O_RDONLY)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _bring_to_disk(path: Path, mode: int) -> None:
    descriptor = os.open(path, mode)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
