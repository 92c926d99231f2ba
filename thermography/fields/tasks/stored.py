"""Arrays that stay in their NetCDF file and are read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import h5netcdf
import xarray as xr
from xarray.backends import BackendArray, H5NetCDFStore
from xarray.backends.file_manager import PickleableFileManager
from xarray.core import indexing

from thermography._typing import Array


def open_stored(path: Path, reading: Callable[[], AbstractContextManager[None]], part_bytes: int) -> xr.Dataset:
    """Open a NetCDF 4 file whose arrays are read when they are asked for, and not kept.

    Parameters
    ----------
    path : Path
        The file.
    reading : callable
        Gives the context of every reading, for example to name the file where one fails. It can be pickled if the Dataset is to be.
    part_bytes : int
        What is kept of every array for the next reading, bytes.

    Returns
    -------
    Dataset
        Coordinates with an index are in memory. The file is open until the Dataset is closed or no longer used: a file that takes its
        place meanwhile is not read, so that arrays and coordinates are of one file. A Dataset that is pickled opens the file again.
    """
    # Files that xarray opens by their path may be closed for the next ones, and opened again.
    kept = {"decode_vlen_strings": True, "rdcc_nbytes": part_bytes}
    manager = PickleableFileManager(h5netcdf.File, str(path), mode="r", kwargs=kept)
    try:
        with reading():
            dataset = xr.open_dataset(H5NetCDFStore(manager), decode_timedelta=False, cache=False)
        lazy = {name: each for name, each in dataset.variables.items() if name not in dataset.indexes}
        dataset.update({name: _in_context(each, reading) for name, each in lazy.items()})
    except BaseException:
        manager.close()
        raise
    return dataset


def _in_context(variable: xr.Variable, reading: Callable[[], AbstractContextManager[None]]) -> xr.Variable:
    """Return a variable that is read within a context."""
    stored = indexing.LazilyIndexedArray(_StoredArray(variable, reading))
    return xr.Variable(variable.dims, stored, variable.attrs, variable.encoding)


class _StoredArray(BackendArray):
    """A variable in a file, read within a context."""

    def __init__(self, variable: xr.Variable, reading: Callable[[], AbstractContextManager[None]]) -> None:
        self.variable, self.reading = variable, reading
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> Array:
        with self.reading():
            return self.variable[key].values
