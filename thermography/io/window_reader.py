"""Reads a window of the sensor from many frames: from the page cache of the system if the file is there, else directly from disk."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermography.io.frame import StoredPixels

#: Offsets, lengths and buffers of direct disk reads must be multiples of this, bytes.
_PAGE = mmap.PAGESIZE
#: Windows of consecutive frames are read from a disk in one piece if no more than this stands between them, bytes.
_GAP = 1 << 16
#: Bit of the result of mincore(2) that is set for a page in memory.
_IN_MEMORY = 1


class WindowReader:
    """Context manager that reads a window of the sensor from many frames.

    Of plain samples only the rows of the window are read; packed samples are decoded as whole frames. A file in the page cache of the
    system is copied from there. Any other file is read directly from disk (O_DIRECT), which is half as fast again as through the cache
    and does not evict the data of other programs, neighbouring windows in one piece; where the system has no direct reads, the cache is
    used.

    Parameters
    ----------
    window : tuple of slice
        Rows and columns of the sensor, both with start and stop.
    """

    def __init__(self, window: tuple[slice, slice]) -> None:
        self.window = window
        self._file: _File | None = None
        self._ahead: ThreadPoolExecutor | None = None

    def __enter__(self) -> WindowReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ahead is not None:
            self._ahead.shutdown()
        if self._file is not None:
            self._file.close()

    def read(self, frames: Sequence[StoredPixels], counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Read the window of every frame into a buffer.

        Parameters
        ----------
        frames : sequence of StoredPixels
            n frames; consecutive frames of one file cost one open file.
        counts : (n or more, row, column) ndarray of uint16
            Buffer of the shape of the window; its first n elements are overwritten.

        Returns
        -------
        (n, row, column) ndarray of uint16
            The part of `counts` that was filled, in native byte order.

        Raises
        ------
        OSError
            Where a file has become shorter since it was indexed.
        ThermographyError
            Where packed samples are damaged.
        """
        rows, columns = self.window
        counts = counts[: len(frames)]
        checked = None
        for number, (target, frame) in enumerate(zip(counts, frames, strict=True)):
            samples = frame.plain_samples
            if samples is None:
                target[...] = frame.read_counts()[self.window]
                continue
            width = frame.shape[1]
            place = samples.offset + rows.start * width * 2
            whole = width == target.shape[1]
            rows_read = target.reshape(-1) if whole else np.empty(target.shape[0] * width, np.uint16)
            file = self._open(frame.path)
            if file is not checked:
                # Once per call: the few frames of a call are neighbours in the file and are cached or evicted together.
                file.check(place, rows_read.nbytes)
                if not file.in_memory:
                    file.read_together(place, self._end_of_neighbours(frames[number:], rows_read.nbytes))
                checked = file
            if file.read(place, rows_read.view(np.uint8)) < rows_read.nbytes:
                raise OSError(
                    f"{frame.path}: frame {frame.index} ends early; the file has become shorter since it was indexed"
                )
            if samples.little_endian != (sys.byteorder == "little"):
                rows_read.byteswap(inplace=True)
            if not whole:
                target[...] = rows_read.reshape(-1, width)[:, columns]
        return counts

    def read_in_chunks(self, frames: Sequence[StoredPixels], size: int) -> Iterator[NDArray[np.uint16]]:
        """Read the window of every frame, some frames at a time; from a disk, the next ones while the caller uses these.

        Parameters
        ----------
        frames : sequence of StoredPixels
        size : int
            Largest number of frames at a time.

        Yields
        ------
        (n, row, column) ndarray of uint16
            In native byte order; overwritten two chunks later.

        Raises
        ------
        OSError, ThermographyError
            As `read`.
        """
        shape = (min(size, len(frames)), *(side.stop - side.start for side in self.window))
        # Two buffers for all chunks: allocating memory for each costs more than reading into it.
        buffers = [np.empty(shape, np.uint16)]
        ahead: Future[NDArray[np.uint16]] | None = None
        for start in range(0, len(frames), size):
            counts = self.read(frames[start : start + size], buffers[0]) if ahead is None else ahead.result()
            ahead, following = None, frames[start + size : start + 2 * size]
            if len(following) and self._file is not None and not self._file.in_memory:
                if self._ahead is None:
                    self._ahead = ThreadPoolExecutor(1, "read ahead")
                if len(buffers) == 1:
                    buffers.append(np.empty(shape, np.uint16))
                buffers.reverse()
                ahead = self._ahead.submit(self.read, following, buffers[0])
            yield counts

    def _end_of_neighbours(self, frames: Sequence[StoredPixels], length: int) -> int:
        """Where the windows of the first frames end that follow one another closely in one file, bytes."""
        end = 0
        for frame in frames:
            samples = frame.plain_samples
            if samples is None or frame.path != frames[0].path:
                break
            place = samples.offset + self.window[0].start * frame.shape[1] * 2
            if end and not 0 <= place - end <= _GAP:
                break
            end = place + length
        return end

    def _open(self, path: Path) -> _File:
        if self._file is None or self._file.path != path:
            if self._file is not None:
                self._file.close()
            self._file = _File(path)
        return self._file


class _File:
    """An open file that is read through the page cache or directly."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cached: BinaryIO = path.open("rb", buffering=0)
        self.direct: BinaryIO | None = None
        self.buffer = mmap.mmap(-1, _PAGE)
        # First and last byte of the file that the buffer holds.
        self.held = (0, 0)
        self.pages: mmap.mmap | None
        # Never accessed: the mapping only serves to ask which pages are in memory. Empty files cannot be mapped,
        # nor those of some network shares.
        try:
            self.pages = mmap.mmap(self.cached.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):
            self.pages = None
        self.in_memory = True

    def check(self, place: int, length: int) -> None:
        """Determine whether these bytes are in the page cache, and open the file for direct reads if they are not."""
        self.in_memory = self.pages is None or _resident(self.pages, place, length)
        self.held = (0, 0)
        if self.in_memory or self.direct is not None or not hasattr(os, "O_DIRECT"):
            return
        try:
            self.direct = os.fdopen(os.open(self.path, os.O_RDONLY | os.O_DIRECT), "rb", buffering=0)
        except OSError:
            # Some file systems have no direct reads; `read` uses the cache then.
            self.direct = None

    def read_together(self, place: int, end: int) -> None:
        """Read bytes directly in one piece, from which `read` takes them; nothing where there are no direct reads."""
        if self.direct is None:
            return
        first = place // _PAGE * _PAGE
        length = -(-(end - first) // _PAGE) * _PAGE
        if len(self.buffer) < length:
            self.buffer.close()
            self.buffer = mmap.mmap(-1, length)
        self.direct.seek(first)
        with memoryview(self.buffer) as pages:
            self.held = (first, first + self.direct.readinto(pages[:length]))  # type: ignore[attr-defined]

    def read(self, place: int, target: NDArray[np.uint8]) -> int:
        """Read bytes from `place` on into `target`; return their number, which is smaller at the end of the file."""
        if self.in_memory or self.direct is None:
            self.cached.seek(place)
            return self.cached.readinto(target)  # type: ignore[attr-defined]
        first, end = self.held
        if not first <= place <= place + target.size <= end:
            self.read_together(place, place + target.size)
            first, end = self.held
        available = max(min(end - place, target.size), 0)
        with memoryview(self.buffer) as pages:
            target[:available] = np.frombuffer(pages, np.uint8, available, place - first)
        return int(available)

    def close(self) -> None:
        """Close the file and release its buffers."""
        for resource in (self.cached, self.direct, self.buffer, self.pages):
            if resource is not None:
                resource.close()


def in_memory(path: Path) -> bool:
    """Return whether the start of a file is in the page cache of the system; True where the system cannot tell, or there is none.

    Parameters
    ----------
    path : Path
    """
    try:
        file = _File(path)
    except OSError:
        return True
    resident = file.pages is None or _resident(file.pages, 0, 1)
    file.close()
    return resident


def _resident(pages: mmap.mmap, place: int, length: int) -> bool:
    """Return whether all of these bytes of a mapped file are in memory; True where the system cannot tell."""
    try:
        mincore = ctypes.CDLL(None).mincore
    except (AttributeError, OSError, TypeError):
        return True
    first = place // _PAGE
    count = -(-(place + length) // _PAGE) - first
    state = (ctypes.c_ubyte * count)()
    address = np.frombuffer(pages, np.uint8).ctypes.data + first * _PAGE
    failed = mincore(ctypes.c_void_p(address), ctypes.c_size_t(count * _PAGE), state)
    return bool(failed) or all(page & _IN_MEMORY for page in state)
