"""Reads the headers of a long sequence by the hundred, compiled, and keeps what differs from frame to frame as columns.

The first frame of a run is read field by field (`thermography.io.flir`). As long as the following ones are laid out as it is, their headers
stand at predicted places. Every one of them is read and checked as the first one was before its frame is listed: magic, version,
directory, byte orders, lengths and places of the records, size and packing of the samples, that the frame is not truncated, and
that a header or the end of the file follows. Camera, lens, calibrated range, time zone and names of sensors are compared with those of
the first frame. The first frame that differs in any of these ends the run and is read field by field, which also finds what is wrong.
What was found of a long run is kept for the next time (`thermography.io.sequence`).
"""

from __future__ import annotations

import os
import sys
from abc import abstractmethod
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermography.common import Array, usable_processors
from thermography.io.fff_record import FffSource, read_counts
from thermography.io.frame import (
    CameraParameters,
    Frame,
    FrameHeader,
    FrameReference,
    PlainSamples,
    RejectedFrame,
    SampleLocation,
    Segments,
)

# Reads a window of the sensor from many frames.


class WindowReader:
    """Context manager that reads a window (rows, columns) of the sensor from many frames, of plain samples its rows alone."""

    def __init__(self, window: tuple[slice, slice]) -> None:
        self.window = window
        self._open: dict[Path, BinaryIO] = {}

    def __enter__(self) -> WindowReader:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._open.values():
            file.close()

    def read(self, frames: Sequence[FrameReference], counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Read the window of every frame into a buffer."""
        rows, columns = self.window
        counts = counts[: len(frames)]
        for target, frame in zip(counts, frames, strict=True):
            samples = frame.plain_samples
            if samples is None:
                target[...] = frame.read_counts()[self.window]
                continue
            width = frame.shape[1]
            whole = width == target.shape[1]
            rows_read = target.reshape(-1) if whole else np.empty(target.shape[0] * width, np.uint16)
            file = self._file(frame.path)
            file.seek(samples.offset + rows.start * width * 2)
            if file.readinto(rows_read.view(np.uint8)) < rows_read.nbytes:  # type: ignore[attr-defined]
                raise OSError(f"{frame.path}: frame {frame.index} ends early; the file was cut after it was indexed")
            if samples.little_endian != (sys.byteorder == "little"):
                rows_read.byteswap(inplace=True)
            if not whole:
                target[...] = rows_read.reshape(-1, width)[:, columns]
        return counts

    def read_in_chunks(self, frames: Sequence[FrameReference], size: int) -> Iterator[NDArray[np.uint16]]:
        """Read the window of every frame, some frames at a time into one buffer."""
        buffer = np.empty((min(size, len(frames)), *(side.stop - side.start for side in self.window)), np.uint16)
        for start in range(0, len(frames), size):
            yield self.read(frames[start : start + size], buffer)

    def _file(self, path: Path) -> BinaryIO:
        if path not in self._open:
            self.__exit__()
            self._open = {path: path.open("rb", buffering=0)}
            if hasattr(os, "posix_fadvise"):
                # The system reads ahead while the caller uses what is there.
                os.posix_fadvise(self._open[path].fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)
        return self._open[path]


# The same call for many files or frames by threads, results in order.

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Most threads that compute. Reading, decoding and sums release the interpreter lock; a thread costs up to 12 MB.
MOST_THREADS = 8
#: Threads that open files: they wait for the disk or the network, whatever the number of cores.
OPENING_THREADS = 8
#: Most calls that a thread takes at a time: handing over each alone costs half as much as reading the headers of a file.
_BATCH = 16


def usable_threads() -> int:
    """Return the number of threads that compute: the cores that this process may use, up to `MOST_THREADS`."""
    return min(usable_processors(), MOST_THREADS)


def call_by_threads(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Yield the results of a function for every item in order, by threads where there are many items; the first error ends the calls."""
    if threads == 1 or len(items) < 2:
        yield from map(function, items)
        return
    size = min(max(len(items) // (4 * threads), 1), _BATCH)
    with ThreadPoolExecutor(threads, "files") as executor:
        waiting: deque[Future[list[Result]]] = deque()
        try:
            for start in range(0, len(items), size):
                batch = items[start : start + size]
                waiting.append(executor.submit(lambda some: [function(each) for each in some], batch))
                if len(waiting) > 2 * threads:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


# A frame in a FLIR file, without its pixels.


@dataclass(frozen=True, kw_only=True)
class FlirFrameReference(FrameReference):
    """A frame in a FLIR file: segments of its FFF record in the file, and places of camera information and samples in the record, bytes."""

    segments: Segments
    camera_info_place: tuple[int, int]
    samples: SampleLocation

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.samples.shape

    @property
    def plain_samples(self) -> PlainSamples | None:
        """Place of the pixels; None where they are packed, or parted into the segments of a JPEG."""
        if self.samples.encoding != "raw" or len(self.segments) != 1:
            return None
        return PlainSamples(self.segments[0][0] + self.samples.offset, self.samples.little_endian)

    def read(self) -> Frame:
        """Read the frame with its pixels and camera information; raise FlirFormatError where they are damaged."""
        with self.path.open("rb", buffering=0) as file:
            return self.read_from(file)

    def read_from(self, file: BinaryIO) -> Frame:
        """As `read`, from the open file."""
        source = FffSource(file, self.path, self.segments)
        info = source.take(*self.camera_info_place, "camera information")
        counts = read_counts(source, self.samples)
        header = {each.name: getattr(self, each.name) for each in fields(FrameHeader)}
        return Frame(**header, counts=counts, source=str(self.path), index=self.index, camera_info=info)

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the pixels only, (row, column) uint16; raise FlirFormatError where they are damaged."""
        with self.path.open("rb", buffering=0) as file:
            return read_counts(FffSource(file, self.path, self.segments), self.samples)


# The frames of many files in the order of time, as one sequence whose references may be made on access.


class _Frames(Sequence[FrameReference]):
    """Sequence of frames whose references are made on access; a slice is a list."""

    @abstractmethod
    def reference(self, place: int) -> FrameReference:
        """Make the reference of a frame, 0 to n - 1."""

    def __getitem__(self, place: Any) -> Any:
        """Return a frame, or those of a slice as a list."""
        chosen = range(len(self))[place]
        return self.reference(chosen) if isinstance(chosen, int) else [self.reference(each) for each in chosen]

    def __iter__(self) -> Iterator[FrameReference]:
        """Make the references one after the other."""
        return map(self.reference, range(len(self)))


class FrameTable(_Frames):
    """Consecutive frames of one file that share size, camera and layout; a reference is made when its frame is asked for.

    Attributes
    ----------
    path : of the file
    first_index : index of the first frame in the file
    shape : number of rows and columns
    times : (n,), UTC; NaT where the file stores none
    parameter_sets : those that occur
    parameter_set : (n,), which of them every frame has
    """

    path: Path
    first_index: int
    shape: tuple[int, int]
    times: Array
    parameter_sets: list[CameraParameters]
    parameter_set: NDArray[np.integer[Any]]

    @abstractmethod
    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""

    @abstractmethod
    def noted(self) -> list[int]:
        """Places of the frames that carry notes."""


class FrameList(_Frames):
    """Frames in the order of time.

    A frame of a long sequence costs some hundred bytes instead of the two kilobytes of its reference.

    Parameters
    ----------
    parts : sequence of FrameTable and of lists of FrameReference
        In any order.
    order : (n,) ndarray of int, optional
        Places in the concatenated parts; their own order by default.
    """

    def __init__(
        self, parts: Sequence[FrameTable | list[FrameReference]], order: NDArray[np.integer[Any]] | None = None
    ) -> None:
        self._parts = [part for part in parts if len(part)]
        self._starts = [0, *accumulate(len(part) for part in self._parts)]
        self._order = order

    @classmethod
    def of(cls, frames: Sequence[FrameReference]) -> FrameList:
        """Return frames of any sequence in their order."""
        return frames if isinstance(frames, cls) else cls([list(frames)])

    def __len__(self) -> int:
        """Return the number of frames."""
        return self._starts[-1] if self._order is None else len(self._order)

    def reference(self, place: int) -> FrameReference:
        """Return a frame, 0 to n - 1."""
        stored = place if self._order is None else int(self._order[place])
        part = bisect_right(self._starts, stored) - 1
        return self._parts[part][stored - self._starts[part]]

    def __eq__(self, other: object) -> bool:
        """Compare with any sequence, frame by frame."""
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Return the representation of a list of the frames; of many, their number."""
        return repr(list(self)) if len(self) <= 3 else f"<{len(self)} frames, the first {self[0]!r}>"

    @cached_property
    def times(self) -> Array:
        """Times (UTC), (n,) datetime64[ms]."""
        return self.column(lambda table: table.times, lambda frame: frame.time, "datetime64[ms]")

    def column(
        self, of_table: Callable[[FrameTable], Array], of_frame: Callable[[FrameReference], Any], kind: str | type
    ) -> Array:
        """One value per frame."""
        values = np.empty(self._starts[-1], kind)
        for part, start in zip(self._parts, self._starts, strict=False):
            of_part = of_table(part) if isinstance(part, FrameTable) else list(map(of_frame, part))
            for_all = values[start : start + len(part)]
            for_all[...] = of_part if isinstance(of_part, np.ndarray) else np.array(of_part, kind)
        return values if self._order is None else values[self._order]

    def files(self) -> Array:
        """Names of the files, (n,) of str objects."""
        return self.column(
            lambda table: np.full(len(table), str(table.path), object), lambda frame: str(frame.path), "object"
        )

    def numbers(self) -> NDArray[np.int64]:
        """Indices of the frames in their files, (n,)."""
        return self.column(lambda table: table.first_index + np.arange(len(table)), lambda frame: frame.index, "int64")

    def shapes(self) -> NDArray[np.int64]:
        """Rows and columns of the frames, (n, 2)."""
        rows = self.column(lambda table: np.full(len(table), table.shape[0]), lambda frame: frame.shape[0], "int64")
        columns = self.column(lambda table: np.full(len(table), table.shape[1]), lambda frame: frame.shape[1], "int64")
        return np.stack([rows, columns], axis=-1)

    def parameter_sets(self) -> tuple[list[CameraParameters], NDArray[np.int64]]:
        """Return the camera parameters that occur, and which of them every frame has, (n,)."""
        known: dict[CameraParameters, int] = {}

        def number(parameters: CameraParameters) -> int:
            return known.setdefault(parameters, len(known))

        which = self.column(
            lambda table: np.array([number(each) for each in table.parameter_sets])[table.parameter_set],
            lambda frame: number(frame.parameters),
            "int64",
        )
        return list(known), which

    def temperatures(self) -> dict[str, Array]:
        """Temperatures inside the camera by sensor, (n,) K; NaN where a frame has none."""
        found: dict[str, Array] = {}
        for part, start in zip(self._parts, self._starts, strict=False):
            if isinstance(part, FrameTable):
                readings = part.temperatures()
            else:
                names = dict.fromkeys(name for frame in part for name in frame.housekeeping)
                readings = {name: np.array([f.housekeeping.get(name, np.nan) for f in part]) for name in names}
            for name, values in readings.items():
                every = found.setdefault(name, np.full(self._starts[-1], np.nan))
                every[start : start + len(part)] = values
        return found if self._order is None else {name: values[self._order] for name, values in found.items()}

    def altered(self) -> NDArray[np.bool_]:
        """Which headers differ from their checksums, (n,); of a table all or none do."""
        return self.column(lambda table: np.full(len(table), table[0].altered), lambda frame: frame.altered, "bool")

    def noted(self) -> list[FrameReference]:
        """Frames that carry notes, in order."""
        noted = self.column(
            lambda table: np.isin(np.arange(len(table)), table.noted()), lambda frame: bool(frame.notes), "bool"
        )
        return [self[int(i)] for i in np.flatnonzero(noted)]

    def choose(self, chosen: Array) -> FrameList:
        """Return the frames where `chosen`, (n,) of bool, is True."""
        return FrameList(self._parts, np.flatnonzero(chosen) if self._order is None else self._order[chosen])


def order_by_time(found: Iterable[FrameReference | FrameTable]) -> tuple[FrameList, list[RejectedFrame]]:
    """Sort frames by time, and take out those whose time occurs twice, and those that their checksum shows to be damaged."""
    parts: list[FrameTable | list[FrameReference]] = []
    for each in found:
        if isinstance(each, FrameTable):
            parts.append(each)
        elif parts and isinstance(parts[-1], list):
            parts[-1].append(each)
        else:
            parts.append([each])
    altered = FrameList(parts).altered()
    # Where most headers differ from their checksums, a program has changed them all.
    damaged = altered & (2 * altered.sum() < altered.size)
    intact = np.flatnonzero(~damaged)
    stored = FrameList(parts, intact) if damaged.any() else FrameList(parts)
    rejected = [
        RejectedFrame(
            one.path, one.index, f"{one.path}: frame {one.index}: its header differs from its checksum, it is damaged"
        )
        for one in FrameList(parts).choose(damaged)
    ]
    times = stored.times
    if not np.isnat(times).any() and (np.diff(times) > np.timedelta64(0)).all():
        return stored, rejected
    by_name = np.unique(stored.files().astype(str), return_inverse=True)[1]
    order = np.lexsort((stored.numbers(), by_name, times))
    second = np.concatenate([[False], times[order][1:] == times[order][:-1]])
    kept = FrameList(parts, intact[order[~second]])
    earlier = np.cumsum(~second) - 1
    return kept, rejected + [_repeated(stored[int(order[i])], kept[int(earlier[i])]) for i in np.flatnonzero(second)]


def _repeated(frame: FrameReference, kept: FrameReference) -> RejectedFrame:
    reason = f"{frame.path}: frame {frame.index} has the same time {frame.time} as frame {kept.index} of {kept.path}"
    return RejectedFrame(frame.path, frame.index, reason)


def frame_times(frames: Sequence[FrameReference]) -> Array:
    """Return the times (UTC) of frames, (n,) datetime64[ns]; NaT where a file stores none."""
    return FrameList.of(frames).times.astype("datetime64[ns]")


def camera_names(frames: Sequence[FrameReference]) -> NDArray[np.object_]:
    """Return which camera took each frame, by model and serial number, with the size of its picture, (n,) of str."""

    def name(frame: FrameReference) -> str:
        serial = f" {frame.camera.serial}" if frame.camera.serial else ""
        return f"{frame.camera.model or 'camera not stored'}{serial}, {frame.shape[1]} x {frame.shape[0]}"

    return FrameList.of(frames).column(
        lambda table: np.full(len(table), name(table.reference(0)), object), name, "object"
    )
