"""A window of many frames, read where it lies in its file: from memory if it is there, else past the cache from the disk."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermography.io.flir import FrameReference

#: What a disk that is read directly wants offsets, lengths and memory to be multiples of, bytes.
_PAGE = mmap.PAGESIZE
_IN_MEMORY = 1


class WindowReader:
    """Reads a window of the sensor from many frames; raw samples row by row where they lie, packed ones as whole frames.

    A file that the system keeps in memory is copied from there. One that it does not keep is read directly from the disk, which is
    faster than through the cache by a half and leaves the cache to others; where the system cannot do that, through the cache.

    Parameters
    ----------
    window
        Rows and columns.
    """

    def __init__(self, window: tuple[slice, slice]) -> None:
        self.window = window
        self._file: _File | None = None

    def __enter__(self) -> WindowReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def read(self, frames: Sequence[FrameReference], counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Fill `counts`, (frames or more, row, column) uint16, with the window of every frame; return the part that was filled.

        Raises
        ------
        OSError
            A file has become shorter since it was indexed.
        """
        rows, columns = self.window
        counts = counts[: len(frames)]
        checked = None
        for own, frame in zip(counts, frames, strict=True):
            samples = frame.samples
            if samples.encoding != "raw" or len(frame.segments) != 1:
                own[...] = frame.read().counts[self.window]
                continue
            width = samples.shape[1]
            place = frame.segments[0][0] + samples.offset + rows.start * width * 2
            whole = width == own.shape[1]
            wanted = own.reshape(-1) if whole else np.empty(own.shape[0] * width, np.uint16)
            file = self._open(frame.path)
            if file is not checked:
                # Once for the few frames of a call: what lies together is kept or forgotten together.
                file.check(place, wanted.nbytes)
                checked = file
            if file.read(place, wanted.view(np.uint8)) < wanted.nbytes:
                raise OSError(
                    f"{frame.path}: frame {frame.index} ends early; the file has become shorter since it was indexed"
                )
            if samples.little_endian != (sys.byteorder == "little"):
                wanted.byteswap(inplace=True)
            if not whole:
                own[...] = wanted.reshape(-1, width)[:, columns]
        return counts

    def _open(self, path: Path) -> _File:
        if self._file is None or self._file.path != path:
            if self._file is not None:
                self._file.close()
            self._file = _File(path)
        return self._file


class _File:
    """One open file: through the cache, or past it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cached: BinaryIO = path.open("rb", buffering=0)
        self.direct: BinaryIO | None = None
        self.buffer = mmap.mmap(-1, _PAGE)
        # Never read through: it only tells what is in memory. A file of nothing cannot be mapped.
        size = os.fstat(self.cached.fileno()).st_size
        self.pages = mmap.mmap(self.cached.fileno(), 0, access=mmap.ACCESS_READ) if size else None
        self.in_memory = True

    def check(self, place: int, length: int) -> None:
        """Find out whether the system keeps these bytes, and open the file directly if it does not."""
        self.in_memory = self.pages is None or _resident(self.pages, place, length)
        if self.in_memory or self.direct is not None or not hasattr(os, "O_DIRECT"):
            return
        try:
            self.direct = os.fdopen(os.open(self.path, os.O_RDONLY | os.O_DIRECT), "rb", buffering=0)
        except OSError:
            # Some file systems have no direct reading; `read` goes through the cache then.
            self.direct = None

    def read(self, place: int, target: NDArray[np.uint8]) -> int:
        """Read bytes from `place` into `target`; return how many there were."""
        if self.in_memory or self.direct is None:
            self.cached.seek(place)
            return self.cached.readinto(target)  # type: ignore[attr-defined]
        first = place // _PAGE * _PAGE
        length = -(-(place + target.size - first) // _PAGE) * _PAGE
        if len(self.buffer) < length:
            self.buffer.close()
            self.buffer = mmap.mmap(-1, length)
        self.direct.seek(first)
        with memoryview(self.buffer) as pages:
            got = self.direct.readinto(pages[:length])  # type: ignore[attr-defined]
            found = max(min(got - (place - first), target.size), 0)
            target[:found] = np.frombuffer(pages, np.uint8, found, place - first)
        return int(found)

    def close(self) -> None:
        """Give everything back."""
        for one in (self.cached, self.direct, self.buffer, self.pages):
            if one is not None:
                one.close()


def _resident(pages: mmap.mmap, place: int, length: int) -> bool:
    """Whether the system keeps all of these bytes of a mapped file in memory; also where it does not say."""
    try:
        ask = ctypes.CDLL(None).mincore
    except (AttributeError, OSError, TypeError):
        return True
    first = place // _PAGE
    count = -(-(place + length) // _PAGE) - first
    state = (ctypes.c_ubyte * count)()
    address = np.frombuffer(pages, np.uint8).ctypes.data + first * _PAGE
    refused = ask(ctypes.c_void_p(address), ctypes.c_size_t(count * _PAGE), state)
    return bool(refused) or all(one & _IN_MEMORY for one in state)
