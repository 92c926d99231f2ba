"""HDF5 files that are not what they seem: a file of a stranger must neither show other files of this machine nor fill its memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import h5py

#: A dataset of more bytes than that, and than so many times those of its file, was not written: deflate packs by 1032 at most.
_LARGE_BYTES, _MOST_PACKED = 1_000_000_000, 1_100
#: Datasets and groups of a file: the products of a run have up to 150, and each costs a reader a millisecond whenever it opens the file.
MOST_OBJECTS = 1_000


def hdf5_fault(path: Path) -> str:
    """Return why an HDF5 file is not read although its library would do so; empty where nothing speaks against it.

    Parameters
    ----------
    path : Path
        HDF5 file.

    Returns
    -------
    str
        That the values of a dataset stand in another file (external storage, a virtual dataset, a link), or were never written and
        would be made up by the library in any number, or that there are very many datasets.

    Raises
    ------
    OSError
        The file cannot be read.

    References
    ----------
    HDF5 File Format Specification 3.0, IV.A.2.g (links), IV.A.2.h (external data files), III.J (virtual datasets).
    """
    # Loaded with the first such file: a finished run is recognised without it.
    import h5py

    size, objects = path.stat().st_size, 0

    def of_link(name: str, found: Any) -> str | None:
        return f"{name} stands in another file" if isinstance(found, h5py.ExternalLink) else None

    def of_object(name: str, found: Any) -> str | None:
        nonlocal objects
        objects += 1
        if objects > MOST_OBJECTS:
            return f"it holds more than {MOST_OBJECTS} datasets and groups"
        return _dataset_fault(name, found, size) if isinstance(found, h5py.Dataset) else None

    with h5py.File(path) as file:
        return file.visititems_links(of_link) or file.visititems(of_object) or ""


def _dataset_fault(name: str, dataset: h5py.Dataset, file_bytes: int) -> str | None:
    """Return what is wrong with a dataset of a file of this size."""
    if dataset.external or dataset.is_virtual:
        return f"the values of {name} stand in another file"
    if dataset.nbytes > max(_LARGE_BYTES, _MOST_PACKED * file_bytes):
        return f"{name} states {dataset.nbytes / 1e9:.3g} GB, which a file of {file_bytes / 1e6:.3g} MB does not hold"
    return None
