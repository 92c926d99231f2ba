"""Frames of temperatures as arrays: TIFF, NumPy, NetCDF and Zarr."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr
from numpy.typing import NDArray

from thermography._hdf5 import MOST_OBJECTS, hdf5_fault
from thermography.errors import ThermographyError
from thermography.io.temperature_frames import StackContents, StackError, StackOptions, TemperatureReader

#: Units of temperature as CF and common programs write them.
_UNITS = {
    **dict.fromkeys(("degC", "deg_C", "celsius", "Celsius", "degree_Celsius", "degrees_Celsius", "degrees_C", "°C", "C"), "degC"),
    **dict.fromkeys(("K", "kelvin", "Kelvin", "degK"), "K"),
}  # fmt: skip
#: Kinds of NumPy's types that can be temperatures: floating point and whole numbers.
_NUMBERS = "fiu"
#: Variables that a message names.
_NAMED = 5
#: Characters of what a library says.
_LONGEST_WORDS = 500
#: Files that a Zarr store of version 3 or 2 begins with; each stands for the whole store.
_ZARR_METADATA = ("zarr.json", ".zgroup")


class TiffReader(TemperatureReader):
    """Reader of TIFF with one grey value per pixel and one page per frame: float temperatures, or 16 bits with a stated scale."""

    name = "TIFF of temperatures"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is a TIFF, or a BigTIFF.

        Parameters
        ----------
        path : Path
        start : bytes
            Its first bytes.
        """
        return start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        StackError
            The values are whole numbers and no scale is stated.
        ThermographyError
            The file is damaged, its pixels are colours, or its values are no real numbers.
        """
        try:
            with tifffile.TiffFile(path) as file:
                first: Any = file.pages[0]
                shape, kind = first.shape, first.dtype
                count = len(file.pages)
                stamp = str(first.tags["DateTime"].value) if "DateTime" in first.tags else ""
        except Exception as error:
            raise ThermographyError(f"{path}: damaged TIFF ({error}); export it again") from None
        if len(shape) != 2 or not all(isinstance(side, int) for side in shape):
            raise ThermographyError(
                f"{path}: pixels of shape {shape}: a picture in colours holds no temperatures; export the radiometric TIFF"
            )
        if kind is None or kind.kind not in _NUMBERS:
            stored = "an unknown type" if kind is None else f"type {kind}"
            raise ThermographyError(
                f"{path}: values of {stored} are no temperatures; export floating-point or whole numbers"
            )
        _require_scale(path, kind, options)
        return StackContents(count, (shape[0], shape[1]), times=_stamp(stamp) if count == 1 else None)

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a page, (row, column).

        Parameters
        ----------
        path : Path
        index : int
            Of the page, from 0.
        options : StackOptions

        Raises
        ------
        ThermographyError
            The page is damaged.
        """
        try:
            with tifffile.TiffFile(path) as file:
                page: Any = file.pages[index]
                # Read as they are, a million strips that the file does not hold take the memory of a million strips.
                if page.dtype is None or page.dtype.kind not in _NUMBERS or prod(page.chunked) != len(page.dataoffsets):
                    raise ValueError("its size, its kind of values and its list of strips contradict one another")
                return np.asarray(page.asarray())
        except Exception as error:
            raise ThermographyError(f"{path}: page {index} is damaged ({error}); export it again") from None


class NumpyReader(TemperatureReader):
    """Reader of .npy: one frame (row, column), or frames (frame, row, column)."""

    name = "NumPy array"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is a NumPy array.

        Parameters
        ----------
        path : Path
        start : bytes
            Its first bytes.
        """
        return start[:6] == b"\x93NUMPY"

    def _open(self, path: Path) -> NDArray[np.floating]:
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        # The header is text that NumPy parses as Python: a damaged one raises errors of many kinds.
        except Exception as error:
            raise ThermographyError(f"{path}: damaged NumPy file ({error}); save it again with numpy.save") from None
        if array.ndim not in (2, 3) or array.dtype.kind not in _NUMBERS:
            raise ThermographyError(
                f"{path}: an array of shape {array.shape} and type {array.dtype}; save numbers as (row, column) or (frame, row, column)"
            )
        return array if array.ndim == 3 else array[np.newaxis]

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a file holds.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        StackError
            The values are whole numbers and no scale is stated.
        ThermographyError
            The file is damaged, or no array of frames.
        """
        array = self._open(path)
        _require_scale(path, array.dtype, options)
        return StackContents(array.shape[0], (array.shape[1], array.shape[2]))

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a frame, (row, column).

        Parameters
        ----------
        path : Path
        index : int
            From 0.
        options : StackOptions

        Raises
        ------
        ThermographyError
            The file is damaged.
        """
        return np.array(self._open(path)[index])


class NetcdfReader(TemperatureReader):
    """Reader of a variable (time, row, column) of a NetCDF 4 or Zarr store; its units and times are those of the CF conventions."""

    name = "NetCDF or Zarr"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file is HDF5, or a folder of Zarr or its metadata.

        Parameters
        ----------
        path : Path
        start : bytes
            Its first bytes.
        """
        zarr = path.name in _ZARR_METADATA or (path.is_dir() and any((path / name).exists() for name in _ZARR_METADATA))
        return zarr or start[:4] == b"\x89HDF"

    @contextmanager
    def _variable(self, path: Path, options: StackOptions) -> Iterator[xr.DataArray]:
        """Open the store for as long as its variable is read."""
        try:
            store = path.parent if path.name in _ZARR_METADATA else path
            zarr = store.is_dir()
            fault = _zarr_fault(store) if zarr else hdf5_fault(store)
            if fault:
                raise ValueError(fault)
            dataset = (
                xr.open_zarr(store, consolidated=False, chunks=None)
                if zarr
                else xr.open_dataset(store, engine="h5netcdf", phony_dims="access")
            )
        except Exception as error:
            raise ThermographyError(f"{path}: cannot be opened ({_words(error)}); write it again") from None
        with dataset:
            stacks = [name for name, values in dataset.data_vars.items() if values.ndim == 3]
            name = options.variable if options.variable is not None else stacks[0] if len(stacks) == 1 else None
            if name not in dataset.data_vars or dataset[name].ndim != 3:
                raise StackError(
                    f'{path}: holds the variables {_first(stacks)} over three dimensions; write variable = "..." '
                    "for the one with the temperatures (time, row, column)"
                )
            kind = dataset[name].dtype
            if kind.kind not in _NUMBERS:
                raise ThermographyError(
                    f"{path}: values of type {kind} are no temperatures; write floating-point or whole numbers"
                )
            yield dataset[name]

    def contents(self, path: Path, options: StackOptions) -> StackContents:
        """Return what a store holds.

        Parameters
        ----------
        path : Path
        options : StackOptions

        Raises
        ------
        StackError
            The variable is not known.
        ThermographyError
            The store is damaged.
        """
        with self._variable(path, options) as values:
            first = values.dims[0]
            stamps = values[first].values if first in values.coords else np.empty(0)
            times = tuple(stamps.astype("datetime64[ns]")) if stamps.dtype.kind == "M" else None
            unit = _UNITS.get(str(values.attrs.get("units", "")), "")
            return StackContents(values.shape[0], (values.shape[1], values.shape[2]), unit, times, zoned=True)

    def read_values(self, path: Path, index: int, options: StackOptions) -> NDArray[np.floating]:
        """Return the values of a time, (row, column).

        Parameters
        ----------
        path : Path
        index : int
            From 0.
        options : StackOptions

        Raises
        ------
        ThermographyError
            The store is damaged.
        """
        with self._variable(path, options) as values:
            try:
                return np.asarray(values[index].values)
            except Exception as error:
                raise ThermographyError(f"{path}: frame {index} is damaged ({_words(error)}); write it again") from None


def _zarr_fault(store: Path) -> str:
    """Return why a Zarr store is not opened: each of its arrays costs the library milliseconds whenever that is done."""
    with os.scandir(store) as entries:
        count = sum(1 for entry in entries if entry.is_dir())
    return f"it holds more than {MOST_OBJECTS} arrays and groups" if count > MOST_OBJECTS else ""


def _words(error: Exception) -> str:
    """Return what a library says of a store: it may repeat an attribute that is as long as the store."""
    text = str(error)
    return text if len(text) <= _LONGEST_WORDS else f"{text[:_LONGEST_WORDS]}..."


def _first(names: list[Any]) -> str:
    """Return the first of some names for a message."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return (", ".join(map(str, names[:_NAMED])) or "none") + more


def _require_scale(path: Path, kind: np.dtype[Any], options: StackOptions) -> None:
    if kind.kind in "iu" and options.scale == 1.0 and options.offset == 0.0:
        raise StackError(
            f"{path}: its values are whole numbers of {kind.itemsize * 8} bits; write the scale of a count and the offset, for example "
            'scale = 0.04 and unit = "K" (scale = 0.1, offset = -273.15, unit = "degC")'
        )


def _stamp(text: str) -> tuple[np.datetime64, ...] | None:
    """Return the time of the tag DateTime of a TIFF, None where it holds none."""
    try:
        return (np.datetime64(datetime.strptime(text, "%Y:%m:%d %H:%M:%S"), "ns"),)
    except ValueError:
        return None
