"""Reads one FFF record of a FLIR file: its bytes, its directory, the camera information and the samples of the raw image.

An FFF record is a header, a directory of typed records, and the records. Two of them matter here: the camera information (type 0x20:
parameters, time, camera) and the raw image (type 0x01: plain, PNG or JPEG-LS samples). The module follows that order.
`thermography.io.flir` finds the FFF records in their containers (radiometric JPEG, SEQ, CSQ, FFF).

The format is not published; the offsets were established on about 250 files of 40 camera models, and the tests compare them with
ExifTool (P. Harvey, "FLIR Tags").
"""

from __future__ import annotations

import struct
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, cast

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import Array, ThermographyError
from thermography.io.frame import (
    CalibratedRange,
    CameraIdentity,
    CameraParameters,
    CameraSettings,
    Encoding,
    FlirFormatError,
    FrameHeader,
    SampleLocation,
    Segments,
)

MAGIC = b"FFF\0"
#: First bytes of packed samples.
SIGNATURES: dict[Encoding, bytes] = {"png": b"\x89PNG\r\n\x1a\n", "jpegls": b"\xff\xd8\xff\xf7"}
HEADER_SIZE = 0x40
ENTRY_SIZE = 32
CAMERA_RECORD = 0x20
RAW_RECORD = 0x01
RAW_HEADER_SIZE = 0x20
#: The largest directory in these files has 33 slots.
MAX_SLOTS = 1024
#: Up to and including Planck R2 and the raw range; the shortest record in these files has 1148 bytes.
_MINIMUM_CAMERA_INFO = 0x314
#: The longest record in these files has 2476 bytes; a wrong length must not cost memory.
MAXIMUM_CAMERA_INFO = 0x4000
#: Bytes of the camera information, from and to: those that `parse_parameters` and `parse_settings` take one after the other, those of
#: camera and lens, of the calibrated range, and of seconds, milliseconds and minutes west of Greenwich.
PARAMETER_BYTES = ((0x20, 0x40), (0x58, 0x64), (0x70, 0x84), (0x308, 0x310))
SETTING_BYTES = ((0x98, 0xB0), (0x338, 0x340), (0x45C, 0x466))
IDENTITY_BYTES = (0xD4, 0x1B8)
#: Texts of camera and lens: attribute of `CameraIdentity` -> offset and width, bytes; and the field of view of the lens.
IDENTITY_TEXTS = {
    "model": (0xD4, 32),
    "part": (0xF4, 16),
    "serial": (0x104, 16),
    "software": (0x114, 16),
    "lens_model": (0x170, 32),
    "lens_part": (0x190, 16),
    "lens_serial": (0x1A0, 16),
}
FIELD_OF_VIEW = 0x1B4
LIMIT_BYTES = ((0x90, 0x98), (0x310, 0x314))
TIME_BYTES = (0x384, 0x38E)
#: Temperatures without a name, and the table of those with one: its first entry, the length of an entry, and the name in it.
UNNAMED_BYTES = (0x394, 0x3A4)
FIRST_SENSOR, SENSOR_SIZE, SENSOR_NAME = 0x47C, 28, (4, 20)
#: Limits between which a number in the housekeeping table is a temperature inside a camera.
_LOWEST_K, _HIGHEST_K = 150.0, 450.0
#: The largest FLIR detectors have 3 million pixels; a file that claims more is damaged or hostile.
_MAX_PIXELS = 1 << 24
#: Memory for packed samples until they are decoded, one buffer per thread of up to so many bytes. Fresh memory for them would push what a
#: frame takes beyond what the C library keeps when it is freed; asking for all of it again costs a seventh of reading a PNG.
_MOST_ROOM = 1 << 22
_own = threading.local()
_NO_ROOM = np.empty(0, np.uint8)


def _room(size: int) -> NDArray[np.uint8]:
    """Memory of this thread, (size,)."""
    if getattr(_own, "room", _NO_ROOM).size < size:
        _own.room = np.empty(size, np.uint8)
    return _own.room[:size]


class FffSource:
    """Bytes of one FFF record, which may lie in several segments (offset, length) of an open, unbuffered file; `front` holds its first
    bytes where they were read already.
    """

    def __init__(self, file: BinaryIO, path: Path, segments: Segments, front: bytes = b"") -> None:
        self.file, self.path, self.segments, self.front = file, path, segments, front
        self.size = segments[0][1] if len(segments) == 1 else sum(length for _, length in segments)

    def read(self, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset` of the record, or fewer at its end."""
        if offset + length <= len(self.front):
            return self.front[offset : offset + length]
        if len(self.segments) == 1:
            start, available = self.segments[0]
            self.file.seek(start + offset)
            return self.file.read(max(0, min(length, available - offset)))
        return bytes(self.read_once(offset, length))

    def read_once(self, offset: int, length: int, *, kept: bool = True) -> memoryview:
        """Return `length` bytes from `offset` of the record, or fewer at its end, read to their place without a copy between."""
        size = max(0, min(length, self.size - offset))
        room = np.empty(size, np.uint8) if kept or size > _MOST_ROOM else _room(size)
        data, filled = memoryview(room), 0  # type: ignore[arg-type]
        for start, available in self.segments:
            if offset < available and filled < len(data):
                self.file.seek(start + offset)
                part = data[filled : filled + available - offset]
                read = self.file.readinto(part)  # type: ignore[attr-defined]
                filled += read
                if read < len(part):
                    break
            offset = max(0, offset - available)
        return data[:filled]

    def take(self, offset: int, length: int, what: str) -> bytes:
        """Return exactly `length` bytes from `offset` of the record; `what` names them in the FlirFormatError if some are missing."""
        data = self.read(offset, length)
        if len(data) < length:
            raise self.error(offset, f"{what} of {length} bytes", f"{len(data)} bytes before the end")
        return data

    def error(self, offset: int, expected: str, actual: str) -> FlirFormatError:
        """Return the error for a violation at `offset` of the record; the message gives the offset in the file itself."""
        place = offset
        for start, available in self.segments:
            if place < available or (start, available) == self.segments[-1]:
                place += start
                break
            place -= available
        return FlirFormatError(f"{self.path}: at 0x{place:X}: expected {expected}, found {actual}")


@dataclass(frozen=True)
class Directory:
    """Directory of one FFF record: place (offset, length) of the first record of each type, bytes, and the slot that lists it; byte order;
    the table as stored; end of the last record, and length of the whole as declared, 0 for none.
    """

    records: Mapping[int, tuple[int, int]]
    slots: Mapping[int, int]
    order: str
    table: bytes
    end: int
    declared_length: int

    def checksum(self, kind: int) -> int:
        """CRC-32 of the first record of a type as stated in the directory; 0 for none."""
        place = self.slots[kind] * ENTRY_SIZE + ENTRY_SIZE - 4
        return int.from_bytes(self.table[place : place + 4], "little" if self.order == "<" else "big")


def is_fff_header(data: bytes) -> bool:
    r"""Return whether bytes are a plausible FFF header; the magic `FFF\0` alone also occurs among pixels."""
    if len(data) < HEADER_SIZE or not data.startswith(MAGIC):
        return False
    order = _byte_order(data)
    if order is None:
        return False
    offset, slots = struct.unpack_from(order + "2I", data, 0x18)
    return offset >= HEADER_SIZE and 0 < slots <= MAX_SLOTS


def read_directory(source: FffSource) -> Directory:
    """Read header and directory of one FFF record."""
    # One read covers header and directory of nearly all files.
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
    # All frames of a sequence share one layout; only the checksums of their records differ, so they are blanked for the cache.
    layout = int.from_bytes(table, "little") & _without_checksums(slots)
    records, used_slots, last = _records(order, layout.to_bytes(len(table), "little"))
    (declared,) = struct.unpack_from(order + "I", head, 0x34)
    return Directory(records, used_slots, order, table, max(end, last), declared)


@lru_cache(maxsize=64)
def _without_checksums(slots: int) -> int:
    """Return a mask of all bytes of a directory except the checksum, the last four bytes of every entry."""
    return int.from_bytes((b"\xff" * (ENTRY_SIZE - 4) + bytes(4)) * slots, "little")


@lru_cache(maxsize=64)
def _records(order: str, table: bytes) -> tuple[Mapping[int, tuple[int, int]], Mapping[int, int], int]:
    """Return records, their slots and the end of the last one; cached because the frames of a sequence repeat one layout."""
    records: dict[int, tuple[int, int]] = {}
    slots: dict[int, int] = {}
    last = 0
    for slot, (kind, _, _, _, offset, length, *_) in enumerate(struct.iter_unpack(order + "2H7I", table)):
        if kind and length:
            records.setdefault(kind, (offset, length))
            slots.setdefault(kind, slot)
            last = max(last, offset + length)
    return MappingProxyType(records), MappingProxyType(slots), last


def _byte_order(head: bytes) -> str | None:
    """Return the struct prefix of header and directory: the byte order in which the version is 100 to 199."""
    for order in "<>":
        if 100 <= struct.unpack_from(order + "I", head, 0x14)[0] < 200:
            return order
    return None


def _find_record(source: FffSource, directory: Directory, kind: int, name: str) -> tuple[int, int]:
    """Return offset and length of a mandatory record, bytes."""
    if kind not in directory.records:
        present = ", ".join(f"0x{k:02X}" for k in directory.records) or "none"
        raise source.error(HEADER_SIZE, f"{name} (type 0x{kind:02X}) in the directory", f"types {present}")
    return directory.records[kind]


def is_damaged(source: FffSource, directory: Directory, kind: int) -> bool:
    """Return whether the record of a type differs from its checksum."""
    return differs(source.read(*directory.records[kind]), directory.checksum(kind))


def differs(data: bytes | memoryview, checksum: int) -> bool:
    """Return whether bytes differ from their CRC-32; never where none (0) is stored."""
    return checksum != 0 and int(imagecodecs.deflate_crc32(data)) != checksum  # type: ignore[arg-type]


def find_camera_info(source: FffSource, directory: Directory) -> tuple[int, int]:
    """Return the place of the camera-information record."""
    offset, length = _find_record(source, directory, CAMERA_RECORD, "camera information")
    if length < _MINIMUM_CAMERA_INFO:
        raise source.error(offset, f"camera information of at least {_MINIMUM_CAMERA_INFO} bytes", f"{length} bytes")
    return offset, min(length, MAXIMUM_CAMERA_INFO)


def read_header(source: FffSource, place: tuple[int, int]) -> FrameHeader:
    """Read the camera-information record."""
    offset, length = place
    info = source.take(offset, length, "camera information")
    order = _order_of_record(source, offset, info, "the camera information")
    parameters, notes = parse_parameters(order, _join(info, PARAMETER_BYTES))
    time, utc_offset = _time(order, info)
    # Temperatures inside the camera, K.
    names = sensor_names(info)
    values = [struct.unpack_from(order + "f", info, FIRST_SENSOR + SENSOR_SIZE * i)[0] for i in range(len(names))]
    unnamed = struct.unpack_from(order + "4f", info, UNNAMED_BYTES[0]) if len(info) >= UNNAMED_BYTES[1] else ()
    return FrameHeader(
        parameters=parameters,
        time=time,
        utc_offset_minutes=utc_offset,
        camera=_identity(order, info[slice(*IDENTITY_BYTES)]),
        limits=_limits(order, _join(info, LIMIT_BYTES)),
        settings=parse_settings(order, _join(info.ljust(FIRST_SENSOR, b"\0"), SETTING_BYTES)),
        housekeeping=select_temperatures(names, values, unnamed),
        notes=notes,
    )


def _order_of_record(source: FffSource, offset: int, data: bytes, name: str) -> str:
    """Return the struct prefix of a record, which begins with the number 2 in its byte order."""
    order = {b"\x02\x00": "<", b"\x00\x02": ">"}.get(data[:2])
    if order is None:
        raise source.error(offset, f"the byte-order mark 2 of {name}", data[:2].hex(" "))
    return order


def _join(info: bytes, places: tuple[tuple[int, int], ...]) -> bytes:
    return b"".join([info[start:stop] for start, stop in places])


@lru_cache(maxsize=256)
def parse_parameters(order: str, data: bytes) -> tuple[CameraParameters, tuple[str, ...]]:
    """Return the parameters, and notes on them; cached because the frames of a sequence share them."""
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
def parse_settings(order: str, data: bytes) -> CameraSettings:
    """Return the settings of the camera."""
    *temperatures, raw_median, raw_range, focus, frame_rate = struct.unpack(order + "6f2If4xH", data)
    return CameraSettings(*[focus, frame_rate, *temperatures, raw_median, raw_range])


@lru_cache(maxsize=256)
def _identity(order: str, data: bytes) -> CameraIdentity:
    """Return camera and lens from the bytes `IDENTITY_BYTES` of the camera information."""
    begin = IDENTITY_BYTES[0]
    texts = {
        name: data[offset - begin : offset - begin + width].split(b"\0")[0].decode("latin-1").strip()
        for name, (offset, width) in IDENTITY_TEXTS.items()
    }
    return CameraIdentity(**texts, field_of_view_deg=struct.unpack_from(order + "f", data, FIELD_OF_VIEW - begin)[0])


def _time(order: str, info: bytes) -> tuple[np.datetime64, int]:
    """Return UTC with milliseconds, and local time minus UTC in minutes; the file stores minutes west of Greenwich."""
    if len(info) < TIME_BYTES[1]:
        return np.datetime64("NaT", "ms"), 0
    seconds, milliseconds, west = struct.unpack_from(order + "2Ih", info, TIME_BYTES[0])
    if seconds == 0:
        return np.datetime64("NaT", "ms"), -west
    return np.datetime64(seconds * 1000 + milliseconds % 1000, "ms"), -west


def sensor_names(info: bytes) -> list[str]:
    """Return the names in the housekeeping table of the camera information, up to the first entry without one."""
    names = []
    for entry in range(FIRST_SENSOR, len(info) - SENSOR_SIZE + 1, SENSOR_SIZE):
        name = info[entry + SENSOR_NAME[0] : entry + SENSOR_NAME[1]].split(b"\0")[0]
        if not name or not name.isascii():
            break
        names.append(name.decode())
    return names


def select_temperatures(names: Sequence[str], values: Sequence[float], unnamed: Sequence[float]) -> dict[str, float]:
    """Return the temperatures among the housekeeping values; the table also holds raw readings and times, which are left out."""
    readings = {
        name: value
        for name, value in zip(names, values, strict=True)
        if _LOWEST_K < value < _HIGHEST_K and name != "ITimeUs"
    }
    return readings or {f"sensor {i}": value for i, value in enumerate(unnamed, 1) if _LOWEST_K < value < _HIGHEST_K}


def locate_samples(source: FffSource, directory: Directory) -> SampleLocation:
    """Read the header of the raw image: place, packing and number of its samples."""
    record = _find_record(source, directory, RAW_RECORD, "a raw image")
    offset, length = record
    if length <= RAW_HEADER_SIZE:
        raise source.error(offset, "a raw image longer than its header", f"{length} bytes")
    head = source.read(offset, RAW_HEADER_SIZE + 8)
    if len(head) < RAW_HEADER_SIZE:
        raise source.error(offset, f"{RAW_HEADER_SIZE} bytes of a raw image's header", f"{len(head)} before the end")
    order = _order_of_record(source, offset, head, "a raw image")
    columns, rows = struct.unpack_from(order + "2H", head, 2)
    if not 0 < rows * columns <= _MAX_PIXELS:
        raise source.error(offset + 2, f"1 to {_MAX_PIXELS} pixels", f"{columns} x {rows}")
    start = head[RAW_HEADER_SIZE:]
    encoding: Encoding = next((name for name, first in SIGNATURES.items() if start.startswith(first)), "raw")
    length -= RAW_HEADER_SIZE
    if encoding == "raw" and length < 2 * rows * columns:
        raise source.error(offset, f"{columns} x {rows} samples of 2 bytes", f"a record with {length} bytes of samples")
    if encoding == "raw":
        length = 2 * rows * columns
    return SampleLocation(
        encoding=encoding,
        offset=offset + RAW_HEADER_SIZE,
        length=length,
        little_endian=order == "<",
        shape=(rows, columns),
        record=record,
        checksum=directory.checksum(RAW_RECORD),
    )


def read_counts(source: FffSource, samples: SampleLocation) -> NDArray[np.uint16]:
    """Read the samples of the raw image."""
    counts = _decode(source, samples, _read_samples(source, samples))
    counts.flags.writeable = False
    return counts


def _read_samples(source: FffSource, samples: SampleLocation) -> memoryview:
    """Return the bytes of the samples, fewer at the end of the record, after comparing the record with its checksum."""
    (offset, length), kept = samples.record, samples.encoding == "raw"
    if not samples.checksum or length > 2 * _MAX_PIXELS:
        return source.read_once(samples.offset, min(samples.length, 2 * _MAX_PIXELS), kept=kept)
    record = source.read_once(offset, length, kept=kept)
    # A record without its last padding bytes cannot be compared.
    if len(record) == length and differs(record, samples.checksum):
        raise source.error(offset, f"a raw image with the CRC-32 {samples.checksum:08X}", "another: damaged samples")
    start = samples.offset - offset
    return record[start : start + samples.length]


def _decode(source: FffSource, samples: SampleLocation, data: memoryview) -> NDArray[np.uint16]:
    """Return the samples in native byte order; the array may be read-only."""
    rows, columns = samples.shape
    if samples.encoding == "raw":
        if len(data) < samples.length:
            raise source.error(samples.offset, f"{samples.length} bytes of samples", f"{len(data)} before the end")
        counts = np.frombuffer(data, "<u2" if samples.little_endian else ">u2").reshape(rows, columns)
        return counts if counts.dtype.isnative else counts.astype(np.uint16)
    # Writers pad the stream to a multiple of 8 bytes; after the last frame of a file the padding may be missing.
    if samples.encoding == "jpegls":
        return _decode_jpegls(source, samples, bytes(data))

    try:
        return decode_png(data, samples.shape, little_endian=samples.little_endian)
    except PngError as error:
        raise source.error(samples.offset, *error.args) from error


def _decode_jpegls(source: FffSource, samples: SampleLocation, data: bytes) -> NDArray[np.uint16]:
    """Decode a JPEG-LS stream (ISO/IEC 14495-1); its size is compared with the record's before the decoder allocates memory."""
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


# The 16-bit grey PNG in which FLIR cameras pack samples, decoded twice as fast as by libpng.

#: Length of the signature, by which the samples were recognised.
_SIGNATURE_BYTES = 8
_GREY_16_BIT = (16, 0, 0, 0, 0)
_BYTES_PER_PIXEL = 2
#: Inflated lines, one buffer per thread, because fresh memory for every image costs a fifth of its decoding.
_scratch = threading.local()
_NO_LINES = np.empty(0, np.uint8)


class PngError(ThermographyError):
    """A PNG is damaged or of another kind than expected; the two arguments are what was expected and what was found."""


def decode_png(data: bytes | memoryview, shape: tuple[int, int], *, little_endian: bool = False) -> NDArray[np.uint16]:
    """Decode a PNG of 16-bit grey samples."""
    rows, columns = shape
    pieces = _image_data(data, shape)
    packed = pieces[0] if len(pieces) == 1 else b"".join(pieces)
    size = rows * (1 + _BYTES_PER_PIXEL * columns)
    if getattr(_scratch, "lines", _NO_LINES).size < size:
        _scratch.lines = np.empty(size, np.uint8)
    lines = _scratch.lines[:size]
    try:
        inflated = len(imagecodecs.deflate_decode(packed, out=lines))  # type: ignore[arg-type]
    except imagecodecs.DeflateError as error:
        raise PngError(f"PNG data that inflate to {size} bytes", str(error)) from error
    if inflated != size:
        raise PngError(f"PNG data that inflate to {size} bytes", str(inflated))
    counts = np.empty(shape, np.uint16)
    if not _undo_filters(lines, counts.view(np.uint8)):
        raise PngError("PNG lines with filters 0 to 4", "another filter")
    return counts if little_endian == (sys.byteorder == "little") else counts.byteswap(inplace=True)


def _image_data(data: bytes | memoryview, shape: tuple[int, int]) -> list[memoryview]:
    """Return the contents of the IDAT chunks after checking every chunk's length and CRC."""
    data = memoryview(data)
    pieces, start = [], _SIGNATURE_BYTES
    while True:
        if start + 12 > len(data):
            raise PngError("a PNG that ends with IEND", f"{len(data)} bytes without it")
        length, kind = struct.unpack_from(">I4s", data, start)
        end = start + 12 + length
        if end > len(data):
            raise PngError(f"{length} bytes in PNG chunk {kind!r}", f"{max(len(data) - start - 12, 0)} before the end")
        computed = imagecodecs.deflate_crc32(data[start + 4 : end - 4])  # type: ignore[arg-type]
        if computed != struct.unpack_from(">I", data, end - 4)[0]:
            raise PngError(f"PNG chunk {kind!r} with its CRC", "another one: the samples are damaged")
        if start == _SIGNATURE_BYTES:
            header = struct.unpack_from(">2I5B", data, start + 8) if kind == b"IHDR" and length == 13 else None
            expected = (shape[1], shape[0], *_GREY_16_BIT)
            if header != expected:
                raise PngError(f"a PNG header (width, height, bits, grey, ...) {expected}", str(header))
        elif kind == b"IDAT":
            pieces.append(data[start + 8 : end - 4])
        elif kind == b"IEND":
            return pieces
        start = end


@njit(nogil=True)
def _undo_filters(filtered: Array, out: Array) -> bool:  # pragma: no cover - compiled
    """Undo the filters of all lines, each (filter type + bytes), into bytes (row, 2 columns); return False for an unknown filter."""
    rows, width = out.shape
    above = np.zeros(width, np.uint8)
    for row in range(rows):
        start = row * (1 + width)
        kind, line, here = filtered[start], filtered[start + 1 : start + 1 + width], out[row]
        if kind > 4:
            return False
        if kind == 4:
            _undo_paeth(line, above, here)
        elif kind == 2:
            for i in range(width):
                here[i] = np.uint8((np.int64(line[i]) + above[i]) & 255)
        else:
            for i in range(width):
                left = np.int64(here[i - _BYTES_PER_PIXEL]) if i >= _BYTES_PER_PIXEL and kind > 0 else np.int64(0)
                here[i] = np.uint8((line[i] + ((left + above[i]) >> 1 if kind == 3 else left)) & 255)
        above = here
    return True


@njit(nogil=True)
def _undo_paeth(line: Array, above: Array, out: Array) -> None:  # pragma: no cover - compiled
    """Undo filter 4; the two bytes of a pixel depend on different ones, and are computed at a time."""
    left = other_left = corner = other_corner = np.int64(0)
    for i in range(0, line.size, _BYTES_PER_PIXEL):
        up, other_up = np.int64(above[i]), np.int64(above[i + 1])
        left = (line[i] + _paeth(left, up, corner)) & 255
        other_left = (line[i + 1] + _paeth(other_left, other_up, other_corner)) & 255
        out[i], out[i + 1] = left, other_left
        corner, other_corner = up, other_up


@njit(nogil=True, inline="always")
def _paeth(left: np.int64, up: np.int64, corner: np.int64) -> np.int64:  # pragma: no cover - compiled
    """Of left, up and corner the nearest to left + up - corner; of equally near ones the left one, then the one above."""
    across, down = left - corner, up - corner
    from_left, from_up, from_corner = abs(down), abs(across), abs(across + down)
    nearest = up if from_up <= from_corner else corner
    return left if from_left <= min(from_up, from_corner) else nearest
