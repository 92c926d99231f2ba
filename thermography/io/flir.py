"""Reads radiometric FLIR files: radiometric JPEG, SEQ, CSQ and FFF to frames of counts.

`read_frame` reads the first frame of a file with its pixels; `index_frames` lists the frames of any number of files from their
headers only, and each `FlirFrameReference` reads its pixels on demand.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from thermography.common import ThermographyError
from thermography.io.fff_record import (
    CAMERA_RECORD,
    HEADER_SIZE,
    MAGIC,
    Directory,
    FffSource,
    find_camera_info,
    is_damaged,
    is_fff_header,
    locate_samples,
    read_directory,
    read_header,
)
from thermography.io.frame import FlirFormatError, Frame, FrameReference, RejectedFrame, Segments
from thermography.io.region import Region, RegionKind
from thermography.io.sequence import (
    OPENING_THREADS,
    FlirFrameReference,
    FrameList,
    FrameTable,
    call_by_threads,
    order_by_time,
)

if TYPE_CHECKING:
    from thermography.io.header_scan import FlirTable

#: Frames are read together where the file has room for this number of them: fewer are read one by one before the code is loaded.
FEWEST_FRAMES = 256
#: Bytes read at once: the start of a file, where those of a JPEG hold all its headers in most cases, and between its segments.
_FRONT, _WINDOW = 1 << 14, 1 << 10


class FlirReader:
    """Reader of radiometric JPEG, FFF, SEQ and CSQ files, see `thermography.io.other_cameras.FrameReader`."""

    name = "FLIR radiometric JPEG, FFF, SEQ or CSQ"

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file starts as a JPEG or an FFF record, or holds one behind its first bytes."""
        return start[:2] == b"\xff\xd8" or start[:4] == MAGIC or is_fff_header(start[start.find(MAGIC) :])

    def index(self, path: Path, options: object) -> Iterator[FrameReference | FrameTable | RejectedFrame]:
        """Yield the frames of a file in its order; damaged ones as `RejectedFrame`, those of a long sequence together."""
        with path.open("rb", buffering=0) as file:
            yield from _walk(file, path)


def read_frame(path: str | os.PathLike[str]) -> Frame:
    """Read the first frame of a radiometric FLIR file.

    Parameters
    ----------
    path : str or path-like
        Radiometric JPEG, SEQ, CSQ or FFF file; the content decides, not the suffix.

    Returns
    -------
    Frame
        Counts (row, column) uint16, camera parameters, time (UTC) and everything else in the header.

    Raises
    ------
    FlirFormatError
        Where the file is not radiometric or its first frame is damaged.
    OSError
        Where the file cannot be opened (FileNotFoundError where there is none); its ``filename`` names it.

    See Also
    --------
    index_frames : All frames of many files, from their headers only.
    thermography.radiometry.planck.calibrate : Counts to temperature.

    Notes
    -----
    The format is not published; see `thermography.io.fff_record` for the sources of its layout.

    Examples
    --------
    >>> from thermofuse.resources import resource
    >>> frame = read_frame(resource("samples/frame.jpg"))
    >>> frame.counts.shape, str(frame.counts.dtype), frame.parameters.planck_b
    ((120, 160), 'uint16', 1501.0)
    """
    path = Path(path)
    with path.open("rb", buffering=0) as file:
        first = next(_walk(file, path))
        if isinstance(first, RejectedFrame):
            raise FlirFormatError(first.reason)
        assert isinstance(first, FlirFrameReference)
        return first.read_from(file)


def index_frames(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> tuple[FrameList, list[RejectedFrame]]:
    """List all frames of many radiometric FLIR files by reading their headers only.

    Parameters
    ----------
    paths : str, path-like or iterable of them
        Radiometric JPEG, SEQ, CSQ or FFF files, in any order; or one such file.

    Returns
    -------
    frames : FrameList
        Sequence of `FrameReference`, sorted by time (UTC), frames without a time last; no time occurs twice.
    rejected : list of RejectedFrame
        Everything that is not in `frames`: unreadable files, damaged or truncated frames, a second frame with the same time. A header that
        differs from its checksum is damage where those of most frames do not; else a program changed them all, and they are kept.

    Notes
    -----
    A file or frame that cannot be used is returned in `rejected`, never raised, so that one damaged file does not stop a series.
    The frames of a sequence are found from the ends of their records, because the magic of a header also occurs among pixels. The
    headers of every frame are read and checked, those of a long sequence compiled (`thermography.io.sequence`); pixels
    and their checksums are checked when they are read. What was found of 20,000 frames or more is kept in the user's cache, or in the
    folder that ``THERMOFUSE_CACHE`` names, and taken from there while size, time of change, first and last bytes of the file are the same.

    Examples
    --------
    >>> frames, rejected = index_frames(["does_not_exist.seq"])
    >>> frames, rejected[0].reason
    ([], "[Errno 2] No such file or directory: 'does_not_exist.seq'")
    """
    files = [paths] if isinstance(paths, str | os.PathLike) else paths
    return index_files(files, lambda path: FlirReader().index(path, None))


def index_files(
    paths: Iterable[str | os.PathLike[str]],
    walk: Callable[[Path], Iterable[FrameReference | FrameTable | RejectedFrame]],
    *,
    fatal: tuple[type[Exception], ...] = (),
) -> tuple[FrameList, list[RejectedFrame]]:
    """List the frames that `walk` yields of every file, by threads; of a file that cannot be used, only a fatal error is raised."""

    def of_file(path: Path) -> list[FrameReference | FrameTable | RejectedFrame]:
        found: list[FrameReference | FrameTable | RejectedFrame] = []
        try:
            found.extend(walk(path))
        except fatal:
            raise
        except (OSError, ThermographyError) as error:
            found.append(RejectedFrame(path, 0, str(error)))
        return found

    files = list(map(Path, paths))
    results = [each for some in call_by_threads(of_file, files, OPENING_THREADS) for each in some]
    frames, repeated = order_by_time(each for each in results if not isinstance(each, RejectedFrame))
    return frames, [each for each in results if isinstance(each, RejectedFrame)] + repeated


def index_sequence(
    path: str | os.PathLike[str], *, start: int = 0, index: int = 0, growing: bool = False
) -> tuple[list[FrameReference], list[RejectedFrame], int]:
    """List the frames of a sequence from a byte on, so that one that is still being recorded is not read from its beginning again.

    Returned are the frames in the order of the file, damaged ones between them, and the byte at which the next call begins. `index` is
    that of the first frame from `start` on; of a `growing` file the last frame may lack its end and waits for the next call.
    """
    path = Path(path)
    with path.open("rb", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        first = _find_header(file, start, size)
        walked = _walk_sequence(file, path, first, size, index=index) if first < size else iter(())
        found = [one for some in walked for one in (some if isinstance(some, FrameTable) else [some])]
    whole = [at for at, one in enumerate(found) if isinstance(one, FlirFrameReference)]
    if not whole:
        return [], [] if growing else [one for one in found if isinstance(one, RejectedFrame)], start
    last = found[whole[-1]]
    assert isinstance(last, FlirFrameReference)
    offset, length = last.segments[0]
    kept = found[: whole[-1] if growing else len(found)]
    frames: list[FrameReference] = [one for one in kept if isinstance(one, FlirFrameReference)]
    return frames, [one for one in kept if isinstance(one, RejectedFrame)], offset if growing else offset + length


def _walk(file: BinaryIO, path: Path) -> Iterator[FlirFrameReference | FrameTable | RejectedFrame]:
    """Yield the frames of one file in file order; damaged ones as `RejectedFrame`, those of a long sequence together."""
    front = file.read(_FRONT)
    if front[:2] == b"\xff\xd8":
        segments = _jpeg_segments(file, path, front)
        begin, length = segments[0]
        source = FffSource(file, path, segments, front[begin : begin + length])
        yield _reference(source, read_directory(source), 0)
        return
    start, size = front[:4], file.seek(0, os.SEEK_END)
    # The first header of a sequence may be damaged; a file without any header is no sequence.
    first = 0 if start == MAGIC else _find_header(file, 1, size)
    actual = start.hex(" ") or "an empty file"
    wrong = f"{path}: at 0x0: expected a JPEG (FF D8) or an FFF record (46 46 46 00), found {actual}"
    if first == size:
        raise FlirFormatError(wrong)
    if first:
        yield RejectedFrame(path, 0, wrong)
    yield from _walk_sequence(file, path, first, size, index=1 if first else 0)


def _reference(source: FffSource, directory: Directory, index: int) -> FlirFrameReference:
    """Read the headers of one FFF record."""
    place = find_camera_info(source, directory)
    header = read_header(source, place)
    samples = locate_samples(source, directory)
    notes = header.notes
    missing = samples.offset + samples.length - source.size
    if missing > 0 and (samples.encoding == "raw" or missing >= 8):
        raise source.error(
            samples.offset, f"{samples.length} bytes of samples", f"{missing} bytes fewer: the frame is truncated"
        )
    if missing > 0:
        notes += (f"the last {missing} padding bytes of the samples are missing",)
    return FlirFrameReference(
        **{**vars(header), "notes": notes},
        path=source.path,
        index=index,
        altered=is_damaged(source, directory, CAMERA_RECORD),
        segments=source.segments,
        camera_info_place=place,
        samples=samples,
    )


def _walk_sequence(
    file: BinaryIO, path: Path, start: int, size: int, *, index: int
) -> Iterator[FlirFrameReference | FrameTable | RejectedFrame]:
    """Yield the frames of consecutive FFF records from `start` on; padding and damaged frames are skipped and reported."""
    notes: tuple[str, ...] = ()
    while start < size:
        source = FffSource(file, path, ((start, size - start),))
        run: FlirTable | None = None
        try:
            directory = read_directory(source)
            end, following = _next_frame(file, start, size, directory)
            source = FffSource(file, path, ((start, end - start),))
            reference = _reference(source, directory, index)
            yield replace(reference, notes=notes + reference.notes) if notes else reference
            # A file with few frames is read without the compiled scan.
            if end == following < size and size - end >= FEWEST_FRAMES * (end - start):
                from thermography.io.header_scan import scan_table  # compiled: few frames are read without it

                run = scan_table(file, reference, size)
        except FlirFormatError as error:
            yield RejectedFrame(path, index, str(error))
            end = following = _find_header(file, start + HEADER_SIZE, size)
        notes = ()
        if run is not None:
            yield run
            index, end, following = index + len(run), run.end, run.end
        elif end < following and _holds_data(file, end, following - end):
            index += 1
            text = f"{path}: at 0x{end:X}: expected a frame or padding, found {following - end} bytes that are neither"
            yield RejectedFrame(path, index, text)
        elif end < following:
            notes = (f"{following - end} bytes of padding before the frame were skipped",)
        start, index = following, index + 1


def _holds_data(file: BinaryIO, offset: int, length: int) -> bool:
    """Return whether a gap holds anything but zeros, by its first 64 kB."""
    file.seek(offset)
    return any(file.read(min(length, 1 << 16)))


def _next_frame(file: BinaryIO, start: int, size: int, directory: Directory) -> tuple[int, int]:
    """Return the end of the frame that starts at `start`, and the start of the next frame (offsets in the file)."""
    end = start + directory.end
    for candidate in (end, start + directory.declared_length):
        if candidate == size or (end <= candidate < size and _header_at(file, candidate)):
            return candidate, candidate
    following = _find_header(file, start + HEADER_SIZE, size)
    return min(end, following), following


def _header_at(file: BinaryIO, offset: int) -> bool:
    file.seek(offset)
    return is_fff_header(file.read(HEADER_SIZE))


def _find_header(file: BinaryIO, offset: int, size: int) -> int:
    """Return the offset of the next FFF header, or the size of the file."""
    block = 1 << 20
    while offset < size:
        file.seek(offset)
        data = file.read(block)
        magic = data.find(MAGIC)
        while magic >= 0:
            if _header_at(file, offset + magic):
                return offset + magic
            magic = data.find(MAGIC, magic + 1)
        # Blocks overlap by three bytes, so that a magic across the border of two blocks is found.
        offset += max(len(data) - len(MAGIC) + 1, 1)
    return size


def _jpeg_segments(file: BinaryIO, path: Path, front: bytes) -> Segments:
    """Return the segments of the FFF record in a radiometric JPEG, whose first bytes are read already, in their order."""
    pieces: dict[int, tuple[int, int]] = {}
    size = file.seek(0, os.SEEK_END)
    last, offset, window, begin = -1, 2, front, 0
    while True:
        head = window[offset - begin : offset - begin + 12]
        if len(head) < 12:
            # Short segments stand close together behind the long ones.
            file.seek(offset)
            window, begin = file.read(_WINDOW), offset
            head = window[:12]
        if len(head) < 4 or head[0] != 0xFF or head[1] in (0xD9, 0xDA):
            break
        if head[1] == 0xFF:
            offset += 1
            continue
        (length,) = struct.unpack_from(">H", head, 2)
        if head[1] == 0xE1 and head[4:10] == b"FLIR\0\1" and length >= 10 and len(head) == 12:
            if head[10] in pieces:
                raise FlirFormatError(f"{path}: at 0x{offset:X}: expected FLIR segment {head[10]} once, found it twice")
            pieces[head[10]] = (offset + 12, min(length - 10, size - offset - 12))
            last = head[11]
        offset += 2 + max(length, 2)
    missing = [index for index in range(last + 1) if index not in pieces]
    if not pieces:
        raise FlirFormatError(
            f"{path}: at 0x{offset:X}: expected FLIR APP1 segments, found none: the JPEG is not radiometric (export it from the camera)"
        )
    if missing:
        raise FlirFormatError(
            f"{path}: at 0x{offset:X}: expected FLIR segments 0 to {last}, found {last + 1 - len(missing)} of them; the first missing one "
            f"is {missing[0]}"
        )
    return tuple(pieces[index] for index in range(last + 1))


# What FLIR cameras store in addition to the pixels: the spots and areas that were set on the screen, and the visible-light
# picture.

_TOOLS_RECORD, _PICTURE_RECORD, _OVERLAY_RECORD = 0x21, 0x0E, 0x2A
#: Header of the measurement tools, and of each tool, bytes.
_TOOLS_HEADER, _TOOL_HEADER = 12, 0x24
#: Number of a tool -> kind of region and number of its coordinates (ExifTool, FLIR Tags); 5 to 8 are end points, alarms and differences.
_KINDS: dict[int, tuple[RegionKind, int]] = {1: ("spot", 2), 2: ("box", 4), 3: ("ellipse", 6), 4: ("line", 4)}
#: Largest records of these kinds; a damaged length must not cost memory.
_LARGEST_TOOLS, _LARGEST_PICTURE = 1 << 16, 1 << 26


@dataclass(frozen=True, eq=False)
class VisiblePicture:
    """The visible-light picture of a frame, (row, column, 3) uint8 red, green, blue; its field of view over that of the sensor, 0 where not
    stored, and the shift (column, row) of the sensor's middle in it, px.
    """

    pixels: NDArray[np.uint8]
    scale: float
    offset_px: tuple[int, int]


def read_measurement_regions(frame: FlirFrameReference) -> list[Region]:
    """Read the spots, boxes, ellipses and lines that a frame stores, each with a name of its own."""
    data = _record(frame, _TOOLS_RECORD, _LARGEST_TOOLS)
    regions: dict[str, Region] = {}
    if data is None or data[:2] != b"\1\0":
        return []
    at = _TOOLS_HEADER
    while at + _TOOL_HEADER <= len(data):
        length, coordinates, number = (struct.unpack_from("<H", data, at + place)[0] for place in (0, 4, 10))
        if not _TOOL_HEADER + coordinates <= length <= len(data) - at or coordinates % 2 or coordinates == 0:
            break
        values = struct.unpack_from(f"<{coordinates // 2}H", data, at + _TOOL_HEADER)
        label = (
            data[at + _TOOL_HEADER + coordinates : at + length].decode("utf-16-le", "replace").split("\0")[0].strip()
        )
        kind, expected = _KINDS.get(number, ("spot", 0))
        if len(values) == expected:
            # Older cameras number the tools of every kind from 1.
            name = label if label and not label.isdecimal() else f"{kind} {label}".strip()
            while name in regions:
                name += "'"
            regions[name] = Region(name, kind, _corners(kind, values))
        at += length
    return list(regions.values())


def _corners(kind: RegionKind, values: tuple[int, ...]) -> tuple[tuple[float, float], ...]:
    """Return the points of a region from the coordinates of a tool."""
    column, row, *others = values
    if kind == "box":
        return (column, row), (column + max(others[0], 1) - 1, row + max(others[1], 1) - 1)
    if kind == "ellipse":  # its centre and a point on each axis
        across, down = (max(abs(others[i] - values[i]), abs(others[i + 2] - values[i])) for i in (0, 1))
        return (column - across, row - down), (column + across, row + down)
    return tuple(zip(values[::2], values[1::2], strict=True))


def read_visible_picture(frame: FlirFrameReference) -> VisiblePicture | None:
    """Read the visible-light picture of a frame."""
    data = _record(frame, _PICTURE_RECORD, _LARGEST_PICTURE)
    if data is None:
        return None
    start = max(data.find(b"\xff\xd8\xff"), data.find(b"\x89PNG"))
    pixels = cv2.imdecode(np.frombuffer(data[max(start, 0) :], np.uint8), cv2.IMREAD_COLOR) if start >= 0 else None
    if pixels is None:
        raise FlirFormatError(f"{frame.path}: the visible-light picture of frame {frame.index} is damaged")
    overlay = _record(frame, _OVERLAY_RECORD, _LARGEST_TOOLS)
    scale, column, row = (0.0, 0, 0) if overlay is None or len(overlay) < 8 else struct.unpack_from("<fhh", overlay)
    return VisiblePicture(np.asarray(pixels[..., ::-1], np.uint8), float(scale), (int(column), int(row)))


def _record(frame: FlirFrameReference, kind: int, largest: int) -> bytes | None:
    """Return the bytes of the first record of a kind, None where there is none or its length is not credible."""
    with frame.path.open("rb", buffering=0) as file:
        source = FffSource(file, frame.path, frame.segments)
        place = read_directory(source).records.get(kind)
        if place is None or not 0 < place[1] <= largest:
            return None
        return bytes(source.take(*place, "annotations"))
