"""Stores stacks of fields over time as zarr, readable frame by frame or cell by cell without loading the whole stack."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import xarray as xr
from zarr.codecs import BloscCodec

from thermography.errors import ThermographyError

#: Fields per chunk: one field costs one chunk, the series of one cell one chunk per 64 fields.
_CHUNK_TIMES = 64


class StackError(ThermographyError):
    """A stack cannot be written or read; the message names the folder and the remedy."""


def write_stack(path: str | Path, stack: xr.DataArray) -> None:
    """Write a stack of fields as a zarr folder.

    Parameters
    ----------
    path : str or Path
        Folder to write; it must not exist, and it is written as a whole or not at all.
    stack : (time, y, x) DataArray
        For example ``frame_temperature``, degC; name, coordinates and attributes are stored with it.

    Raises
    ------
    StackError
        Where the folder exists, or the dims are not (time, y, x).
    """
    path = Path(path)
    if stack.dims != ("time", "y", "x"):
        raise StackError(f"{path}: the array has dims {stack.dims}; a stack is (time, y, x)")
    if path.exists():
        raise StackError(f"{path}: already exists; choose another name or remove it")
    name = str(stack.name or "temperature")
    chunks = (min(_CHUNK_TIMES, stack.sizes["time"]), stack.sizes["y"], stack.sizes["x"])
    encoding = {name: {"chunks": chunks, "compressors": (BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),)}}
    temporary = path.with_name(f".{path.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        stack.rename(name).to_dataset().to_zarr(temporary, encoding=encoding, consolidated=False, zarr_format=3)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def open_stack(path: str | Path) -> xr.DataArray:
    """Open a stack that `write_stack` wrote.

    Parameters
    ----------
    path : str or Path
        The zarr folder.

    Returns
    -------
    (time, y, x) DataArray
        The stack with its coordinates and attributes; values are read on access.

    Raises
    ------
    StackError
        Where the folder is not a zarr store or does not hold exactly one stack over time.
    """
    path = Path(path)
    try:
        dataset = xr.open_zarr(path, consolidated=False, chunks=None)
    except (FileNotFoundError, ValueError, KeyError) as error:
        raise StackError(f"{path}: is not a stack of fields ({error}); write it with write_stack") from error
    names = [name for name in dataset.data_vars if dataset[name].dims == ("time", "y", "x")]
    if len(names) != 1:
        raise StackError(f"{path}: holds {len(names)} stacks over time; expected one")
    stack = dataset[names[0]]
    stack["time"] = stack["time"].astype(np.dtype("datetime64[ns]"))
    return stack
