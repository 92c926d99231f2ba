"""Stacks of fields over time as zarr: written piece by piece, read in any direction without loading the whole."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import xarray as xr
from zarr.codecs import BloscCodec

from thermography.errors import ThermographyError

#: Fields per chunk: one field costs one chunk, and the series of one cell reads time / 64 of them.
CHUNK_TIMES = 64


class StackError(ThermographyError):
    """A stack cannot be written or read; the message names the folder and what to do."""


def write_stack(path: str | Path, stack: xr.DataArray) -> None:
    """Write a stack (time, y, x) as a zarr folder that appears whole or not at all.

    Parameters
    ----------
    path
        Folder to write; it must not exist.
    stack
        For example `frame_temperature`; its name, coordinates and attributes are kept.

    Raises
    ------
    StackError
        The folder exists, or the array is not a stack over time.
    """
    path = Path(path)
    if stack.dims != ("time", "y", "x"):
        raise StackError(f"{path}: the array has dims {stack.dims}; a stack is (time, y, x)")
    if path.exists():
        raise StackError(f"{path}: exists already; choose another name or remove it")
    name = str(stack.name or "temperature")
    chunks = (min(CHUNK_TIMES, stack.sizes["time"]), stack.sizes["y"], stack.sizes["x"])
    encoding = {name: {"chunks": chunks, "compressors": (BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),)}}
    temporary = path.with_name(f".{path.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        stack.rename(name).to_dataset().to_zarr(temporary, encoding=encoding, consolidated=False, zarr_format=3)
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def open_stack(path: str | Path) -> xr.DataArray:
    """Open a stack written by `write_stack`; its values are read when they are used.

    Raises
    ------
    StackError
        The folder is no such stack.
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
