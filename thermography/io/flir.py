"""Radiometric FLIR files as read: R-JPEG, SEQ, CSQ and FFF to frames of counts, and back.

`read_frame` reads one frame, `index_frames` walks any number of files by their headers only, `write_jpeg` and `write_sequence`
write files that other readers understand.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermography.io.fff_record import (
    HEADER_SIZE,
    MAGIC,
    Directory,
    FffSource,
    damaged_records,
    find_camera_info,
    plausible_header,
    read_counts,
    read_directory,
    read_header,
    read_sample_place,
)
from thermography.io.flir_writer import write_jpeg, write_sequence
from thermography.io.frame import (
    CalibratedRange,
    CameraIdentity,
    CameraParameters,
    CameraSettings,
    FlirFormatError,
    Frame,
    FrameHeader,
    Samples,
    Segments,
)

__all__ = [
    "CalibratedRange",
    "CameraIdentity",
    "CameraParameters",
    "CameraSettings",
    "FlirFormatError",
    "Frame",
    "FrameHeader",
    "FrameReference",
    "Rejected",
    "Samples",
    "index_frames",
    "read_frame",
    "write_jpeg",
    "write_sequence",
]


@dataclass(frozen=True, kw_only=True)
class FrameReference(FrameHeader):
    """A frame in a file, without its pixels.

    Attributes
    ----------
    path : Path
    index : int
        Place of the frame in the file, from 0.
    segments : tuple of (offset, length)
        Where the pieces of the FFF record lie in the file, bytes.
    camera_info_place : tuple of (offset, length)
        Where the camera information lies in the record, bytes.
    samples : Samples
        Where the pixels lie in the record.
    """

    path: Path
    index: int
    segments: Segments
    camera_info_place: tuple[int, int]
    samples: Samples

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.samples.shape

    def read(self) -> Frame:
        """Read the frame with its pixels."""
        with self.path.open("rb", buffering=0) as file:
            return self._read_from(file)

    def _read_from(self, file: BinaryIO) -> Frame:
        source = FffSource(file, self.path, self.segments)
        info = source.take(*self.camera_info_place, "camera information")
        counts = read_counts(source, self.samples)
        header = {each.name: getattr(self, each.name) for each in fields(FrameHeader)}
        return Frame(**header, counts=counts, source=str(self.path), index=self.index, camera_info=info)

    def damaged_records(self) -> list[int]:
        """Compare the records with their checksums, which reading does not do for its cost; return the types that differ."""
        with self.path.open("rb", buffering=0) as file:
            source = FffSource(file, self.path, self.segments)
            return damaged_records(source, read_directory(source))

    def read_counts(self) -> NDArray[np.uint16]:
        """Read the pixels only, shape (row, column)."""
        with self.path.open("rb", buffering=0) as file:
            return read_counts(FffSource(file, self.path, self.segments), self.samples)


@dataclass(frozen=True)
class Rejected:
    """A frame or a file that was left out, and why; `index` is the frame's place in its file, from 0."""

    path: Path
    index: int
    reason: str


def read_frame(path: str | os.PathLike[str]) -> Frame:
    """Read the first frame of a radiometric JPEG, SEQ, CSQ or FFF file.

    Parameters
    ----------
    path : path

    Returns
    -------
    Frame

    Raises
    ------
    FlirFormatError
        Where the file is not radiometric or its first frame is damaged.
    """
    path = Path(path)
    with path.open("rb", buffering=0) as file:
        first = next(_walk(file, path))
        if isinstance(first, Rejected):
            raise FlirFormatError(first.reason)
        return first._read_from(file)


def index_frames(paths: Iterable[str | os.PathLike[str]]) -> tuple[list[FrameReference], list[Rejected]]:
    """Find all frames of all files by reading their headers only.

    Parameters
    ----------
    paths : paths of R-JPEG, SEQ, CSQ or FFF files

    Returns
    -------
    frames : list of FrameReference
        Sorted by time (frames without a time last), each time once.
    rejected : list of Rejected
        Everything that was left out: unreadable files, damaged or truncated frames, a second frame with the same time.
    """
    frames: list[FrameReference] = []
    rejected: list[Rejected] = []
    for path in map(Path, paths):
        try:
            with path.open("rb", buffering=0) as file:
                for found in _walk(file, path):
                    (rejected if isinstance(found, Rejected) else frames).append(found)  # type: ignore[arg-type]
        except (OSError, FlirFormatError) as error:
            rejected.append(Rejected(path, 0, str(error)))
    frames.sort(key=lambda frame: (np.isnat(frame.time), frame.time, str(frame.path), frame.index))
    kept: list[FrameReference] = []
    for frame in frames:
        if kept and frame.time == kept[-1].time:
            reason = f"{frame.path}: frame {frame.index} has the same time {frame.time} as frame {kept[-1].index} of {kept[-1].path}"
            rejected.append(Rejected(frame.path, frame.index, reason))
        else:
            kept.append(frame)
    return kept, rejected


def _walk(file: BinaryIO, path: Path) -> Iterator[FrameReference | Rejected]:
    """Yield the frames of one file in their order; damaged ones as `Rejected`."""
    start = file.read(4)
    if start[:2] == b"\xff\xd8":
        source = FffSource(file, path, _jpeg_segments(file, path))
        yield _reference(source, read_directory(source), 0)
    elif start == MAGIC:
        yield from _walk_sequence(file, path)
    else:
        found = start.hex(" ") or "an empty file"
        raise FlirFormatError(f"{path}: at 0x0: expected a JPEG (FF D8) or an FFF record (46 46 46 00), found {found}")


def _reference(source: FffSource, directory: Directory, index: int) -> FrameReference:
    """Read the headers of one FFF record."""
    place = find_camera_info(source, directory)
    header = read_header(source, place)
    samples = read_sample_place(source, directory)
    notes = header.notes
    missing = samples.offset + samples.length - source.size
    if missing > 0 and (samples.encoding == "raw" or missing >= 8):
        raise source.error(
            samples.offset, f"{samples.length} bytes of samples", f"{missing} bytes fewer: the frame is cut short"
        )
    if missing > 0:
        notes += (f"the last {missing} padding bytes of the samples are missing",)
    return FrameReference(
        **{**vars(header), "notes": notes},
        path=source.path,
        index=index,
        segments=source.segments,
        camera_info_place=place,
        samples=samples,
    )


def _walk_sequence(file: BinaryIO, path: Path) -> Iterator[FrameReference | Rejected]:
    """Yield the frames of FFF records laid back to back, stepping over padding and damage."""
    size = file.seek(0, os.SEEK_END)
    start, index = 0, 0
    notes: tuple[str, ...] = ()
    while start < size:
        source = FffSource(file, path, ((start, size - start),))
        try:
            directory = read_directory(source)
            end, following = _next_frame(file, start, size, directory)
            source = FffSource(file, path, ((start, end - start),))
            reference = _reference(source, directory, index)
            yield replace(reference, notes=notes + reference.notes) if notes else reference
        except FlirFormatError as error:
            yield Rejected(path, index, str(error))
            end = following = _find_header(file, start + HEADER_SIZE, size)
        notes = (f"{following - end} bytes of padding before the frame were stepped over",) if following > end else ()
        if end < following == size and _holds_data(file, end):
            text = f"{path}: at 0x{end:X}: expected a frame or padding, found {size - end} bytes that are neither"
            yield Rejected(path, index + 1, text)
        start, index = following, index + 1


def _holds_data(file: BinaryIO, offset: int) -> bool:
    file.seek(offset)
    return any(file.read(1 << 16))


def _next_frame(file: BinaryIO, start: int, size: int, directory: Directory) -> tuple[int, int]:
    """Return where the frame that starts at `start` ends, and where the next one starts (offsets in the file).

    A frame ends after its last record, or at its declared length. Where no frame follows there, the next header decides: after
    the end it means padding, before the end it means that this frame is cut short.
    """
    end = start + directory.end
    for candidate in (end, start + directory.declared_length):
        if candidate == size or (end <= candidate < size and _header_at(file, candidate)):
            return candidate, candidate
    following = _find_header(file, start + HEADER_SIZE, size)
    return min(end, following), following


def _header_at(file: BinaryIO, offset: int) -> bool:
    file.seek(offset)
    return plausible_header(file.read(HEADER_SIZE))


def _find_header(file: BinaryIO, offset: int, size: int) -> int:
    """Return the offset of the next FFF header, or the size of the file."""
    block = 1 << 20
    while offset < size:
        file.seek(offset)
        data = file.read(block)
        at = data.find(MAGIC)
        while at >= 0:
            if _header_at(file, offset + at):
                return offset + at
            at = data.find(MAGIC, at + 1)
        # The overlap finds a magic that lies across two blocks.
        offset += max(len(data) - len(MAGIC) + 1, 1)
    return size


def _jpeg_segments(file: BinaryIO, path: Path) -> Segments:
    r"""Return where the pieces of the FFF record lie in a radiometric JPEG, in their order.

    Each APP1 segment holds `FLIR\0 01 index last` and up to 65524 bytes; the segments may come in any order.
    """
    pieces: dict[int, tuple[int, int]] = {}
    size = file.seek(0, os.SEEK_END)
    last, offset = -1, 2
    while True:
        file.seek(offset)
        head = file.read(12)
        if len(head) < 4 or head[0] != 0xFF or head[1] in (0xD9, 0xDA):
            break
        if head[1] == 0xFF:
            offset += 1
            continue
        (length,) = struct.unpack_from(">H", head, 2)
        if head[1] == 0xE1 and head[4:10] == b"FLIR\0\1" and length >= 10 and len(head) == 12:
            if head[10] in pieces:
                raise FlirFormatError(f"{path}: at 0x{offset:X}: expected FLIR segment {head[10]} once, found it again")
            pieces[head[10]] = (offset + 12, min(length - 10, size - offset - 12))
            last = head[11]
        offset += 2 + max(length, 2)
    missing = [index for index in range(last + 1) if index not in pieces]
    if not pieces:
        raise FlirFormatError(
            f"{path}: at 0x{offset:X}: expected FLIR APP1 segments, found none: the JPEG is not radiometric "
            "(export it from the camera, not from an image program)"
        )
    if missing:
        raise FlirFormatError(f"{path}: at 0x{offset:X}: expected FLIR segments 0 to {last}, found no {missing}")
    return tuple(pieces[index] for index in range(last + 1))
