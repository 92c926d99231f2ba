"""Arrays that grow with a recording: on disk instead of in memory, and gone through piece by piece."""

from __future__ import annotations

import math
import mmap
import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.common import Array

if TYPE_CHECKING:
    import xarray as xr

Item = TypeVar("Item")

#: Arrays up to this size stay in memory, bytes.
IN_MEMORY_BYTES = 1 << 23


def empty_array(shape: tuple[int, ...], kind: Any, folder: Path | None = None) -> Array:
    """Return an array to be filled: in memory, or a large one in a temporary file that ends with it."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    if size <= IN_MEMORY_BYTES:
        return np.empty(shape, kind)
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            _take_room(file.fileno(), size)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(folder or tempfile.gettempdir())) from error
        # An array of its own and not a memmap, which NumPy would pass on as the type of every result.
        return np.asarray(np.memmap(file, kind, "r+", shape=shape))


def empty_arrays(shapes: Sequence[tuple[int, ...]], kind: Any) -> list[Array]:
    """Return arrays to be filled, all in memory, or, where they are large together, in one temporary file, see `empty_array`."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = np.split(empty_array((int(ends[-1]),), kind), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _take_room(file: int, size: int) -> None:
    """Give a file its size: where the disk cannot hold it, now and not when a page of it is written, which would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def give_back(*arrays: object) -> None:
    """Give the memory of arrays in mapped files back to the system; their values stay in the files and are read again when needed."""
    for array in arrays:
        mapped: Any = array
        while isinstance(mapped, np.ndarray) and not isinstance(mapped.base, mmap.mmap):
            mapped = mapped.base
        # A copy-on-write mapping would lose what was changed in it; Windows has no such call.
        if isinstance(mapped, np.memmap) and mapped.mode != "c" and hasattr(mmap, "MADV_DONTNEED"):
            pages: Any = mapped.base
            pages.madvise(mmap.MADV_DONTNEED)


class Spool(Sequence[Item]):
    """A list in a temporary file of a folder (None: that of the system), which ends with it; of a short recording, in memory."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES, dir=None if folder is None else str(folder))  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._places: list[int] = []
        self._end = 0

    def __len__(self) -> int:
        return len(self._places)

    def append(self, item: Item) -> None:
        """Add an item; raise an OSError that names the folder where its disk is full."""
        try:
            self._file.seek(self._end)
            pickle.dump(item, self._file, pickle.HIGHEST_PROTOCOL)
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._folder or tempfile.gettempdir())) from error
        self._places.append(self._end)
        self._end = self._file.tell()

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        self._file.seek(self._places[place])
        return pickle.load(self._file)


# Arrays that grow with a recording, gone through piece by piece: no more than a piece of them is in memory.

#: Size of a piece in double precision, bytes: what is computed from one takes ten times as much.
PIECE_BYTES = 1 << 22
#: Leading bits of a positive number that sort it into a bin: 11 of the exponent and 5 of the digits, so that bins are 3 % wide.
_BIN_BITS = 16


def piece_slices(shape: Sequence[int]) -> Iterator[slice]:
    """Yield the pieces of an array along its first dimension, each of at most 4 MB in double precision."""
    step = max(PIECE_BYTES // (8 * max(math.prod(shape[1:]), 1)), 1)
    return (slice(first, min(first + step, shape[0])) for first in range(0, shape[0], step))


def in_pieces(array: Array | xr.DataArray) -> Iterator[tuple[slice, Array]]:
    """Go through an array piece by piece along its first dimension, to read or to fill it."""
    pieces = piece_slices(array.shape)
    return zip(pieces, one_by_one(np.asarray(array[some]) for some in piece_slices(array.shape)), strict=True)


def one_by_one(arrays: Iterable[Item]) -> Iterator[Item]:
    """Go through arrays, or along the first dimension of one, to read or to fill them; each is given back (`give_back`) before the next."""
    for array in arrays:
        yield array
        give_back(array)


def fill_array(
    shape: tuple[int, ...], kind: Any, values: Callable[[slice], ArrayLike], folder: Path | None = None
) -> Array:
    """Return an array as of `empty_array`, filled piece by piece with the values of some places along its first dimension."""
    array = empty_array(shape, kind, folder)
    for some in piece_slices(shape):
        array[some] = values(some)
        give_back(array)
    return array


def copy_to_disk(arrays: Sequence[Array]) -> list[Array]:
    """Return copies of arrays in double precision, all in memory, or, where they are large together, in one temporary file."""
    copies = empty_arrays([array.shape for array in arrays], float)
    for copy, array in zip(copies, arrays, strict=True):
        for some, values in in_pieces(array):
            copy[some] = values
        give_back(copy)
    return copies


def median_of_pieces(pieces: Callable[[], Iterable[Array]]) -> float:
    """Return the median of values that are never in memory together, the same as of all at once."""
    counts = np.zeros(1 << _BIN_BITS, np.int64)
    for piece in pieces():
        counts += np.bincount(_bins(piece[~np.isnan(piece)]), minlength=counts.size)
    total = int(counts.sum())
    if not total:
        return float("nan")
    below = np.concatenate([[0], np.cumsum(counts)])
    middle = np.array([(total - 1) // 2, total // 2])
    low, high = np.searchsorted(below, middle, side="right") - 1
    near = [piece[(low <= (at := _bins(piece))) & (at <= high) & ~np.isnan(piece)] for piece in pieces()]
    return float(np.mean(np.sort(np.concatenate(near))[middle - below[low]]))


def _bins(values: Array) -> NDArray[np.int64]:
    """Bin of every value, in the order of the values: the leading bits of a positive number in double precision, without its sign."""
    return np.ascontiguousarray(values, float).view(np.int64) >> (63 - _BIN_BITS)
