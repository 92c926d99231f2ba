"""HDF5 files that are not read: a stranger's file must neither show other files of this machine nor fill its memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

#: A dataset of more bytes than that, and than so many times those of its file, was not written: deflate packs by 1032 at most.
_LARGE_BYTES, _MOST_PACKED = 1_000_000_000, 1_100
#: Datasets and groups of a file: the products of a run have up to 150, and each costs a reader a millisecond whenever it opens the file.
MOST_OBJECTS = 1_000
#: Groups within one another; deeper ones take a reader minutes.
_MOST_NESTED = 20


def hdf5_fault(path: Path) -> str:
    """Return why an HDF5 file is not read although its library would do so; empty where nothing speaks against it."""
    # Loaded with the first such file: a finished run is recognised without it.
    import h5py

    most_bytes, objects = max(_LARGE_BYTES, _MOST_PACKED * path.stat().st_size), []

    def of_link(name: str, found: Any) -> str | None:
        if name.count("/") > _MOST_NESTED:
            return f"it nests groups more than {_MOST_NESTED} deep"
        return f"{name} is in another file" if isinstance(found, h5py.ExternalLink) else None

    def of_object(name: str, found: Any) -> str | None:
        objects.append(name)
        if len(objects) > MOST_OBJECTS:
            return f"it holds more than {MOST_OBJECTS} datasets and groups"
        if not isinstance(found, h5py.Dataset):
            return None
        if found.external or found.is_virtual:
            return f"the values of {name} are in another file"
        return (
            f"{name} states {found.nbytes / 1e9:.3g} GB, more than the file holds"
            if found.nbytes > most_bytes
            else None
        )

    with h5py.File(path) as file:
        return file.visititems_links(of_link) or file.visititems(of_object) or ""
