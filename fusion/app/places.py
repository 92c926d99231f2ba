"""Folders that the application may read and write: the one that it was started for, and what lies in it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from fusion.errors import FusionError

#: Characters of a path that a message repeats.
_LONGEST = 400


class PlaceError(FusionError):
    """A path that the application does not open; the message says why and what to do."""


def place_within(root: Path, written: str | Path) -> Path:
    """Return a path inside the folder of the application.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    written : str or Path
        Path as somebody typed it, absolute or from `root` on; ``~`` is the home folder. It need not exist.

    Returns
    -------
    Path
        Absolute, without symbolic links.

    Raises
    ------
    PlaceError
        If it lies outside `root`, also by ``..`` or by a symbolic link.

    Examples
    --------
    >>> place_within(Path("/"), "data/../campaign").as_posix()
    '/campaign'
    """
    top = root.resolve()
    text = str(written).strip()
    if "\0" in text:
        raise PlaceError("a path holds no zero byte; type it again")
    try:
        place = (top / Path(text).expanduser()).resolve()
        with suppress(FileNotFoundError, NotADirectoryError):
            place.lstat()
    # A link to itself, a name that is too long, a home of nobody.
    except (OSError, RuntimeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise PlaceError(f"{text[:_LONGEST]}: {reason}; type another path") from None
    if not place.is_relative_to(top):
        raise PlaceError(
            f"{text} lies outside {top}, the folder for which this application was started; "
            f"start it for that folder: thermofuse app {place if place.is_dir() else place.parent}"
        )
    return place


def folder_within(root: Path, written: str | Path) -> Path:
    """Return an existing folder inside the folder of the application.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    written : str or Path
        Path as somebody typed it.

    Returns
    -------
    Path
        Absolute, without symbolic links.

    Raises
    ------
    PlaceError
        If it lies outside `root`, or is no folder.
    """
    place = place_within(root, written)
    if not place.is_dir():
        raise PlaceError(f"{place}: no such folder; type the folder that holds the files of the measurement")
    return place


def name_of_file(written: str) -> str:
    """Return the name of an uploaded file, if it is one and nothing else.

    Parameters
    ----------
    written : str
        Name as the browser sent it.

    Returns
    -------
    str

    Raises
    ------
    PlaceError
        If it names a folder too, is hidden, or cannot be printed.
    """
    if (
        not written
        or written.startswith(".")
        or any(letter in written for letter in "/\\:")
        or not written.isprintable()
    ):
        raise PlaceError(f"{written!r} is not taken as the name of a file; give it letters, digits, - and _")
    return written
