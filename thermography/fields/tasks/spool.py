"""Arrays that grow with a recording, on disk instead of in memory."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from thermography._typing import Array

#: Arrays up to this size stay in memory, bytes.
IN_MEMORY_BYTES = 1 << 23


def empty_array(shape: tuple[int, ...], kind: Any, folder: Path | None = None) -> Array:
    """Return an array to be filled: in memory, or a large one in a temporary file that ends with it.

    Parameters
    ----------
    shape : tuple of int
    kind : dtype
    folder : Path or None
        For the file; None for that of the system.

    Raises
    ------
    OSError
        The disk of the folder, which is named, is too small.
    """
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
    """Return arrays to be filled, all in memory, or, where they are large together, in one temporary file, see `empty_array`.

    Parameters
    ----------
    shapes : sequence of tuple of int
    kind : dtype
    """
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = np.split(empty_array((int(ends[-1]),), kind), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _take_room(file: int, size: int) -> None:
    """Give a file its size: where the disk cannot hold it, now and not when a page of it is written, which would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def give_back(*arrays: Array) -> None:
    """Give the memory of arrays in mapped files back to the system; their values stay in the files and are read again when needed.

    Parameters
    ----------
    *arrays : ndarray
        Or parts of them. Those in memory are left alone.
    """
    for array in arrays:
        mapped: Any = array
        while isinstance(mapped, np.ndarray) and not isinstance(mapped.base, mmap.mmap):
            mapped = mapped.base
        # A copy-on-write mapping would lose what was changed in it; Windows has no such call.
        if isinstance(mapped, np.memmap) and mapped.mode != "c" and hasattr(mmap, "MADV_DONTNEED"):
            pages: Any = mapped.base
            pages.madvise(mmap.MADV_DONTNEED)


class Spool(Sequence[Array]):
    """Arrays of one shape and type, one after the other; many of them in a temporary file that the system removes.

    Parameters
    ----------
    folder : Path or None
        For the file; None for that of the system.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._held: list[Array] = []
        self._file: Any = None
        self._length = 0
        self._shape: tuple[int, ...] = ()
        self._kind = np.dtype(float)

    def __len__(self) -> int:
        return self._length

    def append(self, array: Array) -> None:
        """Add an array; raise an OSError that names the folder where its disk is full."""
        if not self._length:
            self._shape, self._kind = array.shape, array.dtype
        self._length += 1
        self._held.append(array)
        if len(self._held) * array.nbytes > IN_MEMORY_BYTES:
            self._write()

    def _write(self) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        try:
            for array in self._held:
                self._file.write(np.ascontiguousarray(array))
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._folder or tempfile.gettempdir())) from error
        self._held.clear()

    @overload
    def __getitem__(self, place: int) -> Array: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[Array]: ...

    def __getitem__(self, place: int | slice) -> Array | Sequence[Array]:
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(self._length))]
        written = self._length - len(self._held)
        if not 0 <= place < self._length:
            raise IndexError(place)
        if place >= written:
            return self._held[place - written]
        size = int(np.prod(self._shape)) * self._kind.itemsize
        self._file.seek(place * size)
        read: Array = np.frombuffer(self._file.read(size), self._kind).reshape(self._shape)
        self._file.seek(0, 2)
        return read

    def array(self) -> Array:
        """Return all as one array, (n, ...), of which what is on disk stays there."""
        if self._file is None:
            return np.stack(self._held)
        self._write()
        return np.asarray(np.memmap(self._file, self._kind, "r", shape=(self._length, *self._shape)))
