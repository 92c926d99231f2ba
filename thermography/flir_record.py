"""L0 - One FFF record of a FLIR file: header, directory, camera parameters, samples.

The layout was measured on some 250 real files of 40 camera models; the offsets below are those of the records themselves.
`thermography.flir` finds the records in their containers (radiometric JPEG, SEQ, CSQ, FFF) and is what other modules import.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, Literal

import imagecodecs
import numpy as np
from numpy.typing import NDArray

MAGIC = b"FFF\0"
HEADER_SIZE = 0x40
ENTRY_SIZE = 32
RAW_HEADER_SIZE = 0x20
RAW_RECORD, CAMERA_RECORD = 0x01, 0x20
#: The largest FLIR detectors have 3 million pixels; a file that claims more is damaged or hostile.
MAX_PIXELS = 1 << 24
#: The largest directory seen has 33 slots.
MAX_SLOTS = 1024

Encoding = Literal["raw", "png", "jpegls"]
Segments = tuple[tuple[int, int], ...]


class FlirFormatError(ValueError):
    """A FLIR file breaks a promise of its format; the message names file, offset, what was expected and what was found."""


@dataclass(frozen=True)
class CameraParameters:
    """What the vendor's formula needs, as the file stores it.

    Temperatures are kelvin, the distance is metres, humidity, emissivity and transmissions are fractions (0..1).
    `stored_transmission` is the atmospheric transmission that a camera or program wrote; 0 means none.
    """

    emissivity: float
    object_distance_m: float
    reflected_temperature_K: float
    atmospheric_temperature_K: float
    window_temperature_K: float
    window_transmission: float
    stored_transmission: float
    relative_humidity: float
    planck_r1: float
    planck_b: float
    planck_f: float
    planck_o: float
    planck_r2: float
    atmosphere_alpha1: float
    atmosphere_alpha2: float
    atmosphere_beta1: float
    atmosphere_beta2: float
    atmosphere_x: float


@dataclass(frozen=True)
class CameraIdentity:
    """Which camera and lens made a frame."""

    model: str = ""
    part: str = ""
    serial: str = ""
    software: str = ""
    lens_model: str = ""
    lens_part: str = ""
    lens_serial: str = ""
    field_of_view_deg: float = 0.0


@dataclass(frozen=True)
class CalibratedRange:
    """The temperatures (K) and counts between which the camera is calibrated; counts 0 and 65535 where it does not say."""

    minimum_K: float = 0.0
    maximum_K: float = 0.0
    raw_minimum: int = 0
    raw_maximum: int = 65535


@dataclass(frozen=True)
class Samples:
    """Where the pixels of one record are: `offset` and `length` in bytes from the start of the FFF record."""

    encoding: Encoding
    offset: int
    length: int
    little_endian: bool
    shape: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class FrameHeader:
    """Everything about a frame but its pixels.

    Attributes
    ----------
    parameters : CameraParameters
    time : datetime64[ms]
        UTC; NaT where the file stores none.
    utc_offset_minutes : int
        Local time minus UTC as set in the camera, minutes.
    camera : CameraIdentity
    limits : CalibratedRange
    housekeeping : dict of str to float
        The camera's own temperatures by name, K (lens, shutter, aperture, capsule, detector).
    notes : tuple of str
        What the reader had to mend or assume.
    """

    parameters: CameraParameters
    time: np.datetime64
    utc_offset_minutes: int = 0
    camera: CameraIdentity = CameraIdentity()
    limits: CalibratedRange = CalibratedRange()
    housekeeping: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame(FrameHeader):
    """One frame with its pixels.

    Attributes
    ----------
    counts : ndarray of uint16, shape (row, column)
    source : str
        Path of the file.
    index : int
        Place of the frame in the file, from 0.
    camera_info : bytes
        The camera-info record as it stands in the file.
    """

    counts: NDArray[np.uint16]
    source: str = ""
    index: int = 0
    camera_info: bytes = b""


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
        self.size = sum(length for _, length in segments)

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
    """The records of one FFF: type -> (subtype, offset, length), the end of the last one, and the declared length (0: none)."""

    records: dict[int, tuple[int, int, int]]
    end: int
    declared_length: int


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
    records: dict[int, tuple[int, int, int]] = {}
    for kind, subtype, _, _, at, length, *_ in struct.iter_unpack(order + "2H7I", table):
        if kind and length:
            records.setdefault(kind, (subtype, at, length))
            end = max(end, at + length)
    (declared,) = struct.unpack_from(order + "I", head, 0x34)
    return Directory(records, end, declared)


def _byte_order(head: bytes) -> str | None:
    """Return the struct prefix of header and directory: the one in which the version reads 100 to 199."""
    for order in "<>":
        if 100 <= struct.unpack_from(order + "I", head, 0x14)[0] < 200:
            return order
    return None


def _record(source: FffSource, directory: Directory, kind: int, name: str) -> tuple[int, int]:
    """Return offset and length of a record that must be there."""
    if kind not in directory.records:
        found = ", ".join(f"0x{k:02X}" for k in directory.records) or "none"
        raise source.error(HEADER_SIZE, f"{name} (type 0x{kind:02X}) in the directory", f"types {found}")
    _, offset, length = directory.records[kind]
    return offset, length


def read_header(source: FffSource, directory: Directory) -> tuple[FrameHeader, bytes]:
    """Read the camera-info record.

    Returns
    -------
    FrameHeader
    bytes
        The record untouched.
    """
    offset, length = _record(source, directory, CAMERA_RECORD, "camera information")
    if length < _MINIMUM_CAMERA_INFO:
        raise source.error(offset, f"camera information of at least {_MINIMUM_CAMERA_INFO} bytes", f"{length} bytes")
    # The longest record seen has 2476 bytes; a wild length must not cost memory.
    info = source.take(offset, min(length, 0x4000), "camera information")
    order = "<" if info[:2] == b"\x02\x00" else ">" if info[:2] == b"\x00\x02" else None
    if order is None:
        raise source.error(offset, "the byte-order mark 2 of the camera information", info[:2].hex(" "))
    parameters, notes = _parameters(order, info[0x20:0x40] + info[0x58:0x64] + info[0x70:0x84] + info[0x308:0x310])
    time, utc_offset = _time(order, info)
    limits = _limits(order, info[0x90:0x98] + info[0x310:0x314])
    camera = _identity(order, info[0xD4:0x1B8])
    housekeeping = _housekeeping(order, info)
    header = FrameHeader(
        parameters=parameters,
        time=time,
        utc_offset_minutes=utc_offset,
        camera=camera,
        limits=limits,
        housekeeping=housekeeping,
        notes=notes,
    )
    return header, info


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
    return CameraParameters(*ambient, r1, b, f, float(o), r2, alpha1, alpha2, beta1, beta2, x), notes


@lru_cache(maxsize=256)
def _limits(order: str, data: bytes) -> CalibratedRange:
    maximum, minimum, raw_minimum, raw_maximum = struct.unpack(order + "2f2H", data)
    return CalibratedRange(minimum, maximum, raw_minimum, raw_maximum)


@lru_cache(maxsize=256)
def _identity(order: str, data: bytes) -> CameraIdentity:
    """Return who made the frame from bytes 0xD4..0x1B8 of the camera information."""

    def text(offset: int, width: int) -> str:
        return data[offset - 0xD4 : offset - 0xD4 + width].split(b"\0")[0].decode("latin-1").strip()

    widths = ((0xD4, 32), (0xF4, 16), (0x104, 16), (0x114, 16), (0x170, 32), (0x190, 16), (0x1A0, 16))
    (field_of_view,) = struct.unpack_from(order + "f", data, 0x1B4 - 0xD4)
    return CameraIdentity(*(text(*place) for place in widths), field_of_view_deg=field_of_view)


def _time(order: str, info: bytes) -> tuple[np.datetime64, int]:
    """Return UTC with milliseconds, and local time minus UTC in minutes; the file stores minutes west."""
    if len(info) < 0x38E:
        return np.datetime64("NaT", "ms"), 0
    seconds, milliseconds, west = struct.unpack_from(order + "2Ih", info, 0x384)
    if seconds == 0:
        return np.datetime64("NaT", "ms"), -west
    return np.datetime64(seconds * 1000 + milliseconds % 1000, "ms"), -west


def _housekeeping(order: str, info: bytes) -> dict[str, float]:
    """Return the named camera temperatures, K; raw readings and times in the same table are not temperatures."""
    readings: dict[str, float] = {}
    for at in range(0x47C, len(info) - 27, 28):
        name = info[at + 4 : at + 20].split(b"\0")[0]
        if not name or not name.isascii():
            break
        (value,) = struct.unpack_from(order + "f", info, at)
        if 150 < value < 450 and name != b"ITimeUs":
            readings[name.decode()] = value
    return readings


def read_sample_place(source: FffSource, directory: Directory) -> Samples:
    """Read the raw record's header: where the samples are, how they are packed, how many there should be."""
    offset, length = _record(source, directory, RAW_RECORD, "a raw image")
    if length <= RAW_HEADER_SIZE:
        raise source.error(offset, "a raw image longer than its header", f"{length} bytes")
    head = source.take(offset, RAW_HEADER_SIZE + 8, "the header of a raw image")
    order = "<" if head[:2] == b"\x02\x00" else ">" if head[:2] == b"\x00\x02" else None
    if order is None:
        raise source.error(offset, "the byte-order mark 2 of a raw image", head[:2].hex(" "))
    columns, rows = struct.unpack_from(order + "2H", head, 2)
    if not 0 < rows * columns <= MAX_PIXELS:
        raise source.error(offset + 2, f"1 to {MAX_PIXELS} pixels", f"{columns} x {rows}")
    encoding: Encoding = "raw"
    if head[RAW_HEADER_SIZE:] == b"\x89PNG\r\n\x1a\n":
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
        Counts in native byte order.
    """
    rows, columns = samples.shape
    if samples.encoding == "raw":
        data = source.take(samples.offset, samples.length, f"{columns} x {rows} samples")
        counts = np.frombuffer(data, "<u2" if samples.little_endian else ">u2").reshape(rows, columns)
        return counts if counts.dtype.isnative else counts.astype(np.uint16)
    # Rounded up to 8 bytes by the writers; the padding after the last frame's stream may be missing.
    data = source.read(samples.offset, min(samples.length, 2 * MAX_PIXELS))
    _check_stream(source, samples, data)
    try:
        decode = imagecodecs.png_decode if samples.encoding == "png" else imagecodecs.jpegls_decode
        counts = decode(data)
    except Exception as error:
        raise source.error(
            samples.offset, f"a {samples.encoding} stream that decodes", str(error) or "garbage"
        ) from error
    if counts.shape != samples.shape or counts.dtype != np.uint16:
        raise source.error(
            samples.offset, f"{columns} x {rows} samples of 16 bit", f"shape {counts.shape} of {counts.dtype}"
        )
    if samples.encoding == "png" and samples.little_endian:
        return counts.byteswap()
    return counts


def _check_stream(source: FffSource, samples: Samples, data: bytes) -> None:
    """Compare the size a compressed stream claims with the record's, before a decoder allocates for it."""
    if samples.encoding == "png":
        claim = struct.unpack_from(">2I2B", data, 16) if len(data) >= 33 and data[12:16] == b"IHDR" else None
        expected = (samples.shape[1], samples.shape[0], 16, 0)
        if claim != expected:
            raise source.error(samples.offset, f"a PNG of (width, height, bits, grey) {expected}", str(claim))
        if b"IEND" not in data[-64:]:
            raise source.error(samples.offset, "a PNG that ends with IEND", f"{len(data)} bytes without it")
        return
    claim = struct.unpack_from(">B2HB", data, 6) if len(data) >= 12 else None
    expected = (16, samples.shape[0], samples.shape[1], 1)
    if claim is None or claim[1:] != expected[1:] or not 8 < claim[0] <= 16:
        raise source.error(
            samples.offset, f"a JPEG-LS stream of (bits, height, width, components) {expected}", str(claim)
        )
    if b"\xff\xd9" not in data[-16:]:
        raise source.error(samples.offset, "a JPEG-LS stream that ends with FF D9", f"{len(data)} bytes without it")
