"""One FFF record of a FLIR file: its bytes, its directory and its camera information.

The layout was measured on some 250 real files of 40 camera models; the offsets below are those of the records themselves.
`thermography.io.flir` finds the records in their containers (radiometric JPEG, SEQ, CSQ, FFF) and is what other modules import.

The raw record of an FFF: where its samples are, and the samples themselves (plain, PNG or JPEG-LS).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, cast

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from thermography.io.frame import (
    CalibratedRange,
    CameraIdentity,
    CameraParameters,
    CameraSettings,
    Encoding,
    FlirFormatError,
    FrameHeader,
    Samples,
    Segments,
)
from thermography.io.png16 import SIGNATURE, PngError, decode_png

MAGIC = b"FFF\0"
HEADER_SIZE = 0x40
ENTRY_SIZE = 32
CAMERA_RECORD = 0x20
#: The largest directory seen has 33 slots.
MAX_SLOTS = 1024


class FffSource:
    """The bytes of one FFF record, wherever its pieces lie in an open file.

    Parameters
    ----------
    file : binary file, opened unbuffered
    path : Path
        For messages.
    segments : tuple of (offset, length)
        The pieces in order, bytes in the file.
    """

    def __init__(self, file: BinaryIO, path: Path, segments: Segments) -> None:
        self.file, self.path, self.segments = file, path, segments
        self.size = segments[0][1] if len(segments) == 1 else sum(length for _, length in segments)

    def read(self, offset: int, length: int) -> bytes:
        """Return up to `length` bytes from `offset` of the record; fewer where it ends."""
        if len(self.segments) == 1:
            start, available = self.segments[0]
            self.file.seek(start + offset)
            return self.file.read(max(0, min(length, available - offset)))
        pieces = []
        for start, available in self.segments:
            if offset < available and length > 0:
                self.file.seek(start + offset)
                pieces.append(self.file.read(min(length, available - offset)))
                length -= len(pieces[-1])
            offset = max(0, offset - available)
        return b"".join(pieces)

    def take(self, offset: int, length: int, what: str) -> bytes:
        """Return exactly `length` bytes, or say what is missing."""
        data = self.read(offset, length)
        if len(data) < length:
            raise self.error(offset, f"{what} of {length} bytes", f"{len(data)} bytes before the end")
        return data

    def error(self, offset: int, expected: str, found: str) -> FlirFormatError:
        """Name file and place (the offset in the file itself) of a broken promise."""
        place = offset
        for start, available in self.segments:
            if place < available or (start, available) == self.segments[-1]:
                place += start
                break
            place -= available
        return FlirFormatError(f"{self.path}: at 0x{place:X}: expected {expected}, found {found}")


@dataclass(frozen=True)
class Directory:
    """The records of one FFF, type -> (offset, length), the directory as read, the end of the last, the declared length (0: none)."""

    records: Mapping[int, tuple[int, int]]
    order: str
    table: bytes
    end: int
    declared_length: int

    @property
    def checksums(self) -> dict[int, int]:
        """The checksum that the directory states for every type of record, 0 for none."""
        stated: dict[int, int] = {}
        for kind, _, _, _, _, length, _, _, checksum in struct.iter_unpack(self.order + "2H7I", self.table):
            if kind and length:
                stated.setdefault(kind, checksum)
        return stated


def plausible_header(data: bytes) -> bool:
    r"""Whether 64 bytes look like an FFF header; `FFF\0` alone also occurs in the middle of pixels."""
    if len(data) < HEADER_SIZE or not data.startswith(MAGIC):
        return False
    order = _byte_order(data)
    if order is None:
        return False
    offset, slots = struct.unpack_from(order + "2I", data, 0x18)
    return offset >= HEADER_SIZE and 0 < slots <= MAX_SLOTS


def read_directory(source: FffSource) -> Directory:
    """Read header and directory of one FFF record.

    Raises
    ------
    FlirFormatError
        Where the magic, the version or the directory is not what the format promises.
    """
    # One read covers the header and the directory of all but exotic files.
    head = source.read(0, HEADER_SIZE + 33 * ENTRY_SIZE)
    if head[:4] != MAGIC:
        raise source.error(0, "an FFF record (bytes 46 46 46 00)", head[:4].hex(" ") or "the end of the file")
    if len(head) < HEADER_SIZE:
        raise source.error(0, f"an FFF header of {HEADER_SIZE} bytes", f"{len(head)} bytes before the end")
    order = _byte_order(head)
    if order is None:
        raise source.error(0x14, "a version of 100 to 199 in either byte order", head[0x14:0x18].hex(" "))
    offset, slots = struct.unpack_from(order + "2I", head, 0x18)
    if not 0 < slots <= MAX_SLOTS:
        raise source.error(0x1C, f"1 to {MAX_SLOTS} directory slots", str(slots))
    if offset < HEADER_SIZE:
        raise source.error(0x18, f"a directory after the header (offset >= {HEADER_SIZE})", str(offset))
    end = offset + slots * ENTRY_SIZE
    table = head[offset:end] if end <= len(head) else source.take(offset, slots * ENTRY_SIZE, "a directory")
    # All frames of a sequence lie alike; only the checksums of their records differ.
    layout = int.from_bytes(table, "little") & _without_checksums(slots)
    records, last = _records(order, layout.to_bytes(len(table), "little"))
    (declared,) = struct.unpack_from(order + "I", head, 0x34)
    return Directory(records, order, table, max(end, last), declared)


@lru_cache(maxsize=64)
def _without_checksums(slots: int) -> int:
    """A mask of all bytes of a directory but the last four of every entry."""
    return int.from_bytes((b"\xff" * (ENTRY_SIZE - 4) + bytes(4)) * slots, "little")


@lru_cache(maxsize=64)
def _records(order: str, table: bytes) -> tuple[Mapping[int, tuple[int, int]], int]:
    """Return the records of a directory and the end of the last one; most sequences repeat one layout, hence the cache."""
    records: dict[int, tuple[int, int]] = {}
    last = 0
    for kind, _, _, _, offset, length, *_ in struct.iter_unpack(order + "2H7I", table):
        if kind and length:
            records.setdefault(kind, (offset, length))
            last = max(last, offset + length)
    return MappingProxyType(records), last


def _byte_order(head: bytes) -> str | None:
    """Return the struct prefix of header and directory: the one in which the version reads 100 to 199."""
    for order in "<>":
        if 100 <= struct.unpack_from(order + "I", head, 0x14)[0] < 200:
            return order
    return None


def find_record(source: FffSource, directory: Directory, kind: int, name: str) -> tuple[int, int]:
    """Return offset and length of a record that must be there."""
    if kind not in directory.records:
        found = ", ".join(f"0x{k:02X}" for k in directory.records) or "none"
        raise source.error(HEADER_SIZE, f"{name} (type 0x{kind:02X}) in the directory", f"types {found}")
    return directory.records[kind]


def damaged_records(source: FffSource, directory: Directory) -> list[int]:
    """Return the types of the records that do not have the CRC-32 which their directory entry states (0 states none)."""
    stated = directory.checksums
    return [
        kind
        for kind, place in directory.records.items()
        if stated[kind] and zlib.crc32(source.read(*place)) != stated[kind]
    ]


def find_camera_info(source: FffSource, directory: Directory) -> tuple[int, int]:
    """Return offset and length of the camera-info record."""
    offset, length = find_record(source, directory, CAMERA_RECORD, "camera information")
    if length < _MINIMUM_CAMERA_INFO:
        raise source.error(offset, f"camera information of at least {_MINIMUM_CAMERA_INFO} bytes", f"{length} bytes")
    # The longest record seen has 2476 bytes; a wild length must not cost memory.
    return offset, min(length, 0x4000)


def read_header(source: FffSource, place: tuple[int, int]) -> FrameHeader:
    """Read the camera-info record at a place (offset, length) from `find_camera_info`."""
    offset, length = place
    info = source.take(offset, length, "camera information")
    order = "<" if info[:2] == b"\x02\x00" else ">" if info[:2] == b"\x00\x02" else None
    if order is None:
        raise source.error(offset, "the byte-order mark 2 of the camera information", info[:2].hex(" "))
    parameters, notes = _parameters(order, info[0x20:0x40] + info[0x58:0x64] + info[0x70:0x84] + info[0x308:0x310])
    time, utc_offset = _time(order, info)
    limits = _limits(order, info[0x90:0x98] + info[0x310:0x314])
    whole = info.ljust(0x47C, b"\0")
    settings = _settings(order, whole[0x98:0xB0] + whole[0x338:0x340] + whole[0x45C:0x466])
    camera = _identity(order, info[0xD4:0x1B8])
    housekeeping = _housekeeping(order, info)
    return FrameHeader(
        parameters=parameters,
        time=time,
        utc_offset_minutes=utc_offset,
        camera=camera,
        limits=limits,
        settings=settings,
        housekeeping=housekeeping,
        notes=notes,
    )


#: Up to and including Planck R2 and the raw range; the oldest record seen has 1148 bytes.
_MINIMUM_CAMERA_INFO = 0x314


@lru_cache(maxsize=256)
def _parameters(order: str, data: bytes) -> tuple[CameraParameters, tuple[str, ...]]:
    """Return the parameters from their bytes; frames of one sequence share them, hence the cache."""
    *ambient, r1, b, f, alpha1, alpha2, beta1, beta2, x, o, r2 = struct.unpack(order + "16fif", data)
    notes: tuple[str, ...] = ()
    if ambient[7] > 2:
        notes = (f"relative humidity {ambient[7]:g} was stored in percent",)
        ambient[7] /= 100
    values = [*ambient, r1, b, f, float(o), r2, alpha1, alpha2, beta1, beta2, x]
    return CameraParameters(*values), notes


@lru_cache(maxsize=256)
def _limits(order: str, data: bytes) -> CalibratedRange:
    maximum, minimum, raw_minimum, raw_maximum = struct.unpack(order + "2f2H", data)
    return CalibratedRange(minimum, maximum, raw_minimum, raw_maximum)


@lru_cache(maxsize=256)
def _settings(order: str, data: bytes) -> CameraSettings:
    *temperatures, raw_median, raw_range, focus, frame_rate = struct.unpack(order + "6f2If4xH", data)
    return CameraSettings(*[focus, frame_rate, *temperatures, raw_median, raw_range])


@lru_cache(maxsize=256)
def _identity(order: str, data: bytes) -> CameraIdentity:
    """Return who made the frame from bytes 0xD4..0x1B8 of the camera information."""

    def text(offset: int, width: int) -> str:
        return data[offset - 0xD4 : offset - 0xD4 + width].split(b"\0")[0].decode("latin-1").strip()

    return CameraIdentity(
        model=text(0xD4, 32),
        part=text(0xF4, 16),
        serial=text(0x104, 16),
        software=text(0x114, 16),
        lens_model=text(0x170, 32),
        lens_part=text(0x190, 16),
        lens_serial=text(0x1A0, 16),
        field_of_view_deg=struct.unpack_from(order + "f", data, 0x1B4 - 0xD4)[0],
    )


def _time(order: str, info: bytes) -> tuple[np.datetime64, int]:
    """Return UTC with milliseconds, and local time minus UTC in minutes; the file stores minutes west."""
    if len(info) < 0x38E:
        return np.datetime64("NaT", "ms"), 0
    seconds, milliseconds, west = struct.unpack_from(order + "2Ih", info, 0x384)
    if seconds == 0:
        return np.datetime64("NaT", "ms"), -west
    return np.datetime64(seconds * 1000 + milliseconds % 1000, "ms"), -west


#: Between these a number in the housekeeping table is a temperature of a camera.
_LOWEST_K, _HIGHEST_K = 150.0, 450.0


def _housekeeping(order: str, info: bytes) -> dict[str, float]:
    """Return the camera's own temperatures, K; raw readings and times in the same table are not temperatures."""
    readings: dict[str, float] = {}
    for at in range(0x47C, len(info) - 27, 28):
        name = info[at + 4 : at + 20].split(b"\0")[0]
        if not name or not name.isascii():
            break
        (value,) = struct.unpack_from(order + "f", info, at)
        if _LOWEST_K < value < _HIGHEST_K and name != b"ITimeUs":
            readings[name.decode()] = value
    if not readings and len(info) >= 0x3A4:
        unnamed = struct.unpack_from(order + "4f", info, 0x394)
        readings = {f"sensor {i}": value for i, value in enumerate(unnamed, 1) if _LOWEST_K < value < _HIGHEST_K}
    return readings


RAW_RECORD = 0x01
RAW_HEADER_SIZE = 0x20
#: The largest FLIR detectors have 3 million pixels; a file that claims more is damaged or hostile.
MAX_PIXELS = 1 << 24


def read_sample_place(source: FffSource, directory: Directory) -> Samples:
    """Read the raw record's header: where the samples are, how they are packed, how many there should be."""
    offset, length = find_record(source, directory, RAW_RECORD, "a raw image")
    if length <= RAW_HEADER_SIZE:
        raise source.error(offset, "a raw image longer than its header", f"{length} bytes")
    head = source.read(offset, RAW_HEADER_SIZE + 8)
    if len(head) < RAW_HEADER_SIZE:
        raise source.error(
            offset, f"the {RAW_HEADER_SIZE} bytes of a raw image's header", f"{len(head)} before the end"
        )
    order = "<" if head[:2] == b"\x02\x00" else ">" if head[:2] == b"\x00\x02" else None
    if order is None:
        raise source.error(offset, "the byte-order mark 2 of a raw image", head[:2].hex(" "))
    columns, rows = struct.unpack_from(order + "2H", head, 2)
    if not 0 < rows * columns <= MAX_PIXELS:
        raise source.error(offset + 2, f"1 to {MAX_PIXELS} pixels", f"{columns} x {rows}")
    encoding: Encoding = "raw"
    if head[RAW_HEADER_SIZE:] == SIGNATURE:
        encoding = "png"
    elif head[RAW_HEADER_SIZE : RAW_HEADER_SIZE + 4] == b"\xff\xd8\xff\xf7":
        encoding = "jpegls"
    length -= RAW_HEADER_SIZE
    if encoding == "raw" and length < 2 * rows * columns:
        raise source.error(offset, f"{columns} x {rows} samples of 2 bytes", f"a record with {length} bytes of samples")
    if encoding == "raw":
        length = 2 * rows * columns
    return Samples(encoding, offset + RAW_HEADER_SIZE, length, order == "<", (rows, columns))


def read_counts(source: FffSource, samples: Samples) -> NDArray[np.uint16]:
    """Read the pixels.

    Returns
    -------
    ndarray of uint16, shape (row, column)
        Counts in native byte order; read-only, whatever the packing.
    """
    counts = _decode(source, samples)
    counts.flags.writeable = False
    return counts


def _decode(source: FffSource, samples: Samples) -> NDArray[np.uint16]:
    rows, columns = samples.shape
    if samples.encoding == "raw":
        data = source.take(samples.offset, samples.length, f"{columns} x {rows} samples")
        counts = np.frombuffer(data, "<u2" if samples.little_endian else ">u2").reshape(rows, columns)
        return counts if counts.dtype.isnative else counts.astype(np.uint16)
    # Rounded up to 8 bytes by the writers; the padding after the last frame's stream may be missing.
    data = source.read(samples.offset, min(samples.length, 2 * MAX_PIXELS))
    if samples.encoding == "jpegls":
        return _decode_jpegls(source, samples, data)
    try:
        counts = decode_png(data, samples.shape)
    except PngError as error:
        raise source.error(samples.offset, *error.args) from error
    return counts.byteswap() if samples.little_endian else counts


def _decode_jpegls(source: FffSource, samples: Samples, data: bytes) -> NDArray[np.uint16]:
    """Decode a JPEG-LS stream after comparing the size it claims with the record's, before the decoder allocates for it."""
    claim = struct.unpack_from(">B2HB", data, 6) if len(data) >= 12 else None
    expected = (16, *samples.shape, 1)
    if claim is None or claim[1:] != expected[1:] or not 8 < claim[0] <= 16:
        raise source.error(samples.offset, f"JPEG-LS of (bits, height, width, components) {expected}", str(claim))
    if b"\xff\xd9" not in data[-16:]:
        raise source.error(samples.offset, "a JPEG-LS stream that ends with FF D9", f"{len(data)} bytes without it")
    try:
        counts = imagecodecs.jpegls_decode(data)
    except imagecodecs.JpeglsError as error:
        raise source.error(samples.offset, "a JPEG-LS stream that decodes", str(error)) from error
    if counts.shape != samples.shape or counts.dtype != np.uint16:
        raise source.error(samples.offset, f"JPEG-LS samples {samples.shape}", f"{counts.shape} of {counts.dtype}")
    return cast("NDArray[np.uint16]", counts)
