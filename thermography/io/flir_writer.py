"""Writes radiometric FLIR files: radiometric JPEG, SEQ and CSQ that this package, ExifTool, flyr and flirpy read."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import astuple
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.common import ThermographyError
from thermography.io.fff_record import (
    CAMERA_RECORD,
    ENTRY_SIZE,
    FIELD_OF_VIEW,
    FIRST_SENSOR,
    HEADER_SIZE,
    IDENTITY_TEXTS,
    LIMIT_BYTES,
    MAGIC,
    PARAMETER_BYTES,
    RAW_HEADER_SIZE,
    RAW_RECORD,
    SENSOR_SIZE,
    SETTING_BYTES,
    TIME_BYTES,
)
from thermography.io.frame import CalibratedRange, CameraIdentity, CameraParameters, Encoding, Frame

_CAMERA_INFO_SIZE = 2476
#: Slots of the directory: other readers expect 14, and at least two more than are used.
_SLOTS = 14
_SEGMENT_PAYLOAD = 65524
_SUBTYPES: Mapping[Encoding, int] = {"raw": 2, "png": 3, "jpegls": 4}
#: Other readers recognise a FLIR JPEG by this word in the Exif model.
_EXIF_MODEL = "FLIR"


def write_jpeg(
    path: str | os.PathLike[str],
    counts: ArrayLike,
    parameters: CameraParameters,
    time: np.datetime64 | str,
    *,
    camera: CameraIdentity | None = None,
    limits: CalibratedRange | None = None,
    housekeeping: Mapping[str, float] | None = None,
    utc_offset_minutes: int = 0,
    encoding: Encoding = "raw",
) -> None:
    """Write one frame as a radiometric JPEG.

    Parameters
    ----------
    path : str or path-like
        File to write; an existing file is replaced.
    counts : (row, column) array of uint16
        Signal of the detector, counts.
    parameters : CameraParameters
        Parameters of the measurement formula; stored as float32, `planck_o` as a whole number.
    time : datetime64 or str
        UTC, 1970 to 2106, as datetime64 or ISO 8601 text; stored to the millisecond. NaT stores none.
    camera : CameraIdentity, optional
        Camera and lens; empty by default.
    limits : CalibratedRange, optional
        Range in which the camera is calibrated; none by default.
    housekeeping : mapping of str to float, optional
        Temperatures inside the camera, 150 to 450 K, by sensor name (1 to 15 ASCII letters).
    utc_offset_minutes : int
        Local time minus UTC, minutes.
    encoding : {"raw", "png", "jpegls"}
        Packing of the samples; all three are lossless.

    Raises
    ------
    ThermographyError
        Where counts, time, housekeeping or encoding do not fit the format, or the frame is too large for a JPEG.

    See Also
    --------
    write_sequence : Many frames in one file.

    Notes
    -----
    The visible picture of the JPEG is a grey preview of the counts; the samples are in APP1 segments, as FLIR cameras store them.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from thermofuse.resources import resource
    >>> from thermography.io.flir import read_frame
    >>> sc660 = read_frame(resource("samples/frame.jpg")).parameters
    >>> counts = np.full((48, 64), 18000, np.uint16)
    >>> with TemporaryDirectory() as folder:
    ...     write_jpeg(Path(folder, "a.jpg"), counts, sc660, "2026-03-09T06:33:47.125", encoding="png")
    ...     frame = read_frame(Path(folder, "a.jpg"))
    >>> str(frame.time), bool((frame.counts == counts).all())
    ('2026-03-09T06:33:47.125', True)
    """
    frame = Frame(
        counts=np.asarray(counts),
        parameters=parameters,
        time=np.asarray(time, "datetime64[ms]").reshape(1)[0],
        camera=camera or CameraIdentity(),
        limits=limits or CalibratedRange(),
        housekeeping=dict(housekeeping or {}),
        utc_offset_minutes=utc_offset_minutes,
    )
    record = _encode_record(frame, encoding=encoding)
    pieces = [record[start : start + _SEGMENT_PAYLOAD] for start in range(0, len(record), _SEGMENT_PAYLOAD)]
    if len(pieces) > 256:
        raise ThermographyError(
            f"{path}: a frame of {len(record)} bytes does not fit the 256 segments of a JPEG; use write_sequence, or encoding='png'"
        )
    segments = [_segment(_exif(frame))]
    segments += [_segment(b"FLIR\0\1" + bytes((index, len(pieces) - 1)) + piece) for index, piece in enumerate(pieces)]
    # The visible picture: grey, scaled from the lowest to the highest count.
    low, high = int(frame.counts.min()), int(frame.counts.max())
    grey = ((frame.counts.astype(np.float32) - low) * (255 / max(high - low, 1))).astype(np.uint8)
    encoded: bytes = cv2.imencode(".jpg", grey)[1].tobytes()
    Path(path).write_bytes(b"\xff\xd8" + b"".join(segments) + encoded[2:])


def write_sequence(
    path: str | os.PathLike[str], frames: Iterable[Frame], *, encoding: Encoding = "raw", padding: int = 0
) -> int:
    """Write frames as one SEQ file, or as a CSQ file with `encoding="jpegls"`.

    Parameters
    ----------
    path : str or path-like
        File to write; an existing file is replaced.
    frames : iterable of Frame
        Counts (row, column) uint16 with their headers; a generator is consumed one frame at a time.
    encoding : {"raw", "png", "jpegls"}
        Packing of the samples; all three are lossless.
    padding : int
        Zero bytes after each frame that no header declares, as some cameras leave them.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    ThermographyError
        Where counts, time, housekeeping or encoding of a frame do not fit the format.

    Notes
    -----
    FFF records follow one another in a sequence; the tests read the file back with exiftool, flirpy and this package.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from thermofuse.resources import resource
    >>> from thermography.io.flir import index_frames, read_frame
    >>> sc660 = read_frame(resource("samples/frame.jpg")).parameters
    >>> counts = np.full((48, 64), 18000, np.uint16)
    >>> start = np.datetime64("2026-03-09T06:33:47", "ms")
    >>> recording = (Frame(counts=counts, parameters=sc660, time=start + 1000 * second) for second in range(3))
    >>> with TemporaryDirectory() as folder:
    ...     write_sequence(Path(folder, "a.seq"), recording)
    ...     frames, rejected = index_frames([Path(folder, "a.seq")])
    3
    >>> [str(frame.time) for frame in frames], rejected
    (['2026-03-09T06:33:47.000', '2026-03-09T06:33:48.000', '2026-03-09T06:33:49.000'], [])
    """
    count = 0
    with Path(path).open("wb") as file:
        for frame in frames:
            file.write(_encode_record(frame, encoding=encoding) + bytes(padding))
            count += 1
    return count


def _encode_record(frame: Frame, *, encoding: Encoding = "raw") -> bytes:
    """Return one FFF record: directory at 0x40 big-endian, records little-endian, the raw image last."""
    counts = frame.counts
    if counts.ndim != 2 or counts.dtype.kind != "u" or counts.dtype.itemsize != 2:
        raise ThermographyError(f"counts: expected uint16 (row, column), got {counts.dtype} of shape {counts.shape}")
    if not all(0 < length < 65536 for length in counts.shape):
        raise ThermographyError(f"counts: expected 1 to 65535 rows and columns, got shape {counts.shape}")
    info = _camera_info(frame)
    raw = _raw_record(frame.counts, encoding)
    info_offset = HEADER_SIZE + _SLOTS * ENTRY_SIZE
    raw_offset = info_offset + len(info)
    head = bytearray(info_offset)
    total = raw_offset + len(raw)
    struct.pack_into(">4s16s3I", head, 0, MAGIC, b"", 100, HEADER_SIZE, _SLOTS)
    struct.pack_into(">I", head, 0x20, 3)
    struct.pack_into(">I", head, 0x34, total)
    entries = ((CAMERA_RECORD, 1, 1, info_offset, info), (RAW_RECORD, _SUBTYPES[encoding], 2, raw_offset, raw))
    for slot, (kind, subtype, number, offset, data) in enumerate(entries):
        entry = HEADER_SIZE + slot * ENTRY_SIZE
        struct.pack_into(">2H7I", head, entry, kind, subtype, 100, number, offset, len(data), 0, 0, zlib.crc32(data))
    return bytes(head) + info + raw


def _camera_info(frame: Frame) -> bytes:
    """Return the camera-information record; values that the frame does not hold are 0."""
    info = bytearray(_CAMERA_INFO_SIZE)
    rows, columns = frame.counts.shape
    p = frame.parameters
    struct.pack_into("<3H", info, 0, 2, columns, rows)
    values = astuple(p)
    stored = struct.pack("<16fif", *values[:11], *values[13:], round(p.planck_o), p.planck_r2)
    _put(info, PARAMETER_BYTES, stored)
    minimum, maximum, *raw_limits = astuple(frame.limits)
    _put(info, LIMIT_BYTES, struct.pack("<2f2H", maximum, minimum, *raw_limits))
    focus, frame_rate, *temperatures, median, width = astuple(frame.settings)
    if not width:
        low, high = int(frame.counts.min()), int(frame.counts.max())
        median, width = (low + high) // 2, high - low
    _put(info, SETTING_BYTES, struct.pack("<6f2If4xH", *temperatures, median, width, focus, round(frame_rate)))
    for name, (offset, room) in IDENTITY_TEXTS.items():
        # One byte less than the field: readers expect the terminating zero.
        struct.pack_into(f"{room - 1}s", info, offset, getattr(frame.camera, name).encode("latin-1", "replace"))
    struct.pack_into("<f", info, FIELD_OF_VIEW, frame.camera.field_of_view_deg)
    seconds = milliseconds = 0
    if not np.isnat(frame.time):
        seconds, milliseconds = divmod(int(frame.time.astype("datetime64[ms]").astype(np.int64)), 1000)
        if not 1 <= seconds < 2**32:
            raise ThermographyError(f"time {frame.time}: a FLIR file stores times from 1970 to 2106 only")
        struct.pack_into("<2Ih", info, TIME_BYTES[0], seconds, milliseconds, -frame.utc_offset_minutes)
    # The temperatures inside the camera carry the frame's time.
    room = (_CAMERA_INFO_SIZE - FIRST_SENSOR) // SENSOR_SIZE
    if len(frame.housekeeping) > room:
        raise ThermographyError(f"housekeeping: a FLIR file stores {room} readings, not {len(frame.housekeeping)}")
    for i, (name, value) in enumerate(frame.housekeeping.items()):
        if not (name.isascii() and 0 < len(name) < 16 and 150 < value < 450):
            raise ThermographyError(f"housekeeping {name!r} = {value}: expected 1 to 15 ASCII letters and 150 to 450 K")
        struct.pack_into("<f16s2I", info, FIRST_SENSOR + SENSOR_SIZE * i, value, name.encode(), seconds, milliseconds)
    return bytes(info)


def _put(info: bytearray, places: tuple[tuple[int, int], ...], data: bytes) -> None:
    """Write bytes to several places of the camera information, one after the other."""
    for start, stop in places:
        info[start:stop], data = data[: stop - start], data[stop - start :]


def _raw_record(counts: NDArray[np.uint16], encoding: Encoding) -> bytes:
    """Return the raw record: header and packed samples."""
    rows, columns = counts.shape
    head = bytearray(RAW_HEADER_SIZE)
    struct.pack_into("<3H", head, 0, 2, columns, rows)
    struct.pack_into("<H", head, 0x0C, columns - 1)
    struct.pack_into("<H", head, 0x10, rows - 1)
    native = np.ascontiguousarray(counts, np.uint16)
    if encoding == "raw":
        samples = native.astype("<u2", copy=False).tobytes()
    elif encoding == "png":
        # Cameras store the samples in the byte order of the record although PNG samples are big-endian, hence the swap.
        samples = cv2.imencode(".png", native.byteswap(), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    elif encoding == "jpegls":
        # Without the encoder's SPIFF segments: the cameras write the frame header first.
        stream = bytes(imagecodecs.jpegls_encode(native))
        offset = 2
        while stream[offset : offset + 2] == b"\xff\xe8":
            offset += 2 + int.from_bytes(stream[offset + 2 : offset + 4], "big")
        samples = stream[:2] + stream[offset:]
        samples += bytes(-len(samples) % 8)
    else:
        raise ThermographyError(f"encoding {encoding!r}: expected 'raw', 'png' or 'jpegls'")
    return bytes(head) + samples


def _segment(payload: bytes) -> bytes:
    """Return an APP1 segment."""
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def _exif(frame: Frame) -> bytes:
    """Return a minimal Exif block: make, model, local date and time."""
    model = frame.camera.model if _EXIF_MODEL in frame.camera.model else f"{_EXIF_MODEL} {frame.camera.model}".strip()
    texts = {0x010F: "FLIR Systems AB", 0x0110: model}
    if not np.isnat(frame.time):
        local = (frame.time + np.timedelta64(frame.utc_offset_minutes, "m")).astype("datetime64[s]")
        texts[0x0132] = str(local).replace("-", ":").replace("T", " ")
    data_offset = 8 + 2 + 12 * len(texts) + 4
    entries, data = b"", b""
    for tag, text in texts.items():
        value = text.encode("ascii", "replace") + b"\0"
        # Values of up to four bytes are stored in the entry itself.
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", data_offset + len(data))
        entries += struct.pack("<HHI", tag, 2, len(value)) + place
        data += value if len(value) > 4 else b""
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, len(texts)) + entries + bytes(4) + data
