"""Files that are dropped on the page go into the folder of the measurement."""

from __future__ import annotations

from pathlib import Path

from fusion.app.places import PlaceError, folder_within, name_of_file, place_within
from fusion.errors import FusionError
from fusion.products.store import write_atomically

#: Largest file that is taken, MB: it passes through the memory of the browser and of the application.
LARGEST_MB = 100


class UploadError(FusionError):
    """A file that is not taken; the message says why and what to do."""


def store_upload(root: Path, folder: Path, name: str, content: bytes | str) -> Path:
    """Write a file that was dropped on the page.

    Parameters
    ----------
    root : Path
        Folder for which the application was started.
    folder : Path
        Folder of the measurement, absolute or from `root` on.
    name : str
        Name as the browser sent it.
    content : bytes or str
        Whole content; text where the browser took it for text in UTF-8.

    Returns
    -------
    Path
        The new file.

    Raises
    ------
    UploadError
        If the file is too large, or one of that name is there already.
    PlaceError
        If the name is none, or leads out of the folder.
    """
    inside = folder_within(root, folder)
    data = content.encode("utf-8") if isinstance(content, str) else content
    if len(data) > LARGEST_MB * 1_000_000:
        raise UploadError(f"{name} is larger than {LARGEST_MB} MB; copy it into {inside} with the file manager")
    path = place_within(root, inside / name_of_file(name))
    if path.parent != inside:
        raise PlaceError(f"{name} leads out of {inside}; give the file a name without folders")
    if path.exists():
        raise UploadError(f"{path} exists already and is not replaced; give the file another name")
    return write_atomically(path, lambda part: part.write_bytes(data))
