"""Radiometric FLIR files as written: R-JPEG and SEQ that exiftool, flyr, flirpy and this package read back."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography.errors import ThermographyError
from thermography.io.fff_record import CAMERA_RECORD, ENTRY_SIZE, HEADER_SIZE, MAGIC, RAW_HEADER_SIZE, RAW_RECORD
from thermography.io.frame import CalibratedRange, CameraIdentity, CameraParameters, Encoding, Frame

_CAMERA_INFO_SIZE = 2476
#: Other readers expect 14 slots, and at least two more than are used.
_SLOTS = 14
_SEGMENT_PAYLOAD = 65524
_SUBTYPES: Mapping[Encoding, int] = {"raw": 2, "png": 3, "jpegls": 4}
#: Other readers decide by this word of the Exif model whether a JPEG is theirs.
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
    """Write a radiometric JPEG.

    Parameters
    ----------
    path : path
    counts : array of uint16, shape (row, column)
    parameters : CameraParameters
    time : datetime64 or ISO string
        UTC; milliseconds are kept.
    camera : CameraIdentity, optional
    limits : CalibratedRange, optional
    housekeeping : mapping of str to float, optional
        Camera temperatures by name (up to 15 ASCII letters), K.
    utc_offset_minutes : int
        Local time minus UTC.
    encoding : {"raw", "png", "jpegls"}
        How the samples are packed.

    Raises
    ------
    ThermographyError
        Where counts, time or housekeeping do not fit the format.
    """
    frame = _frame(counts, parameters, time, camera, limits, housekeeping, utc_offset_minutes)
    record = encode_record(frame, encoding=encoding)
    pieces = [record[at : at + _SEGMENT_PAYLOAD] for at in range(0, len(record), _SEGMENT_PAYLOAD)]
    if len(pieces) > 256:
        raise ThermographyError(
            f"{path}: a frame of {len(record)} bytes does not fit the 256 segments of a JPEG; use write_sequence, or encoding='png'"
        )
    segments = [_segment(_exif(frame))]
    segments += [_segment(b"FLIR\0\1" + bytes((index, len(pieces) - 1)) + piece) for index, piece in enumerate(pieces)]
    Path(path).write_bytes(b"\xff\xd8" + b"".join(segments) + _preview(frame.counts)[2:])


def write_sequence(
    path: str | os.PathLike[str], frames: Iterable[Frame], *, encoding: Encoding = "raw", padding: int = 0
) -> int:
    """Write a SEQ file (a CSQ file with `encoding="jpegls"`), frame by frame.

    Parameters
    ----------
    path : path
    frames : iterable of Frame
        Pixels and everything that is known about them; a generator is consumed one frame at a time.
    encoding : {"raw", "png", "jpegls"}
    padding : int
        Zero bytes after each frame that no header declares, as some writers leave them.

    Returns
    -------
    int
        Number of frames written.
    """
    count = 0
    with Path(path).open("wb") as file:
        for frame in frames:
            file.write(encode_record(frame, encoding=encoding) + bytes(padding))
            count += 1
    return count


def _frame(
    counts: ArrayLike,
    parameters: CameraParameters,
    time: np.datetime64 | str,
    camera: CameraIdentity | None,
    limits: CalibratedRange | None,
    housekeeping: Mapping[str, float] | None,
    utc_offset_minutes: int,
) -> Frame:
    return Frame(
        counts=np.asarray(counts),
        parameters=parameters,
        time=np.asarray(time, "datetime64[ms]").reshape(1)[0],
        camera=camera or CameraIdentity(),
        limits=limits or CalibratedRange(),
        housekeeping=dict(housekeeping or {}),
        utc_offset_minutes=utc_offset_minutes,
    )


def encode_record(frame: Frame, *, encoding: Encoding = "raw") -> bytes:
    """Return one FFF record: directory big-endian at 0x40, records little-endian, the raw image last."""
    _check_counts(frame.counts)
    info = _camera_info(frame)
    raw = _raw_record(frame.counts, encoding)
    at_info = HEADER_SIZE + _SLOTS * ENTRY_SIZE
    at_raw = at_info + len(info)
    head = bytearray(at_info)
    total = at_raw + len(raw)
    struct.pack_into(">4s16s3I", head, 0, MAGIC, b"", 100, HEADER_SIZE, _SLOTS)
    struct.pack_into(">I", head, 0x20, 3)
    struct.pack_into(">I", head, 0x34, total)
    entries = ((CAMERA_RECORD, 1, 1, at_info, info), (RAW_RECORD, _SUBTYPES[encoding], 2, at_raw, raw))
    for slot, (kind, subtype, identifier, at, data) in enumerate(entries):
        place = HEADER_SIZE + slot * ENTRY_SIZE
        struct.pack_into(">2H7I", head, place, kind, subtype, 100, identifier, at, len(data), 0, 0, zlib.crc32(data))
    return bytes(head) + info + raw


def _check_counts(counts: NDArray[np.uint16]) -> None:
    """Refuse what is no picture of 16-bit counts."""
    if counts.ndim != 2 or counts.dtype.kind != "u" or counts.dtype.itemsize != 2:
        raise ThermographyError(
            f"counts: expected uint16 with dims (row, column), got {counts.dtype} of shape {counts.shape}"
        )
    if not all(0 < length < 65536 for length in counts.shape):
        raise ThermographyError(f"counts: expected 1 to 65535 rows and columns, got shape {counts.shape}")


def _camera_info(frame: Frame) -> bytes:
    """Return the camera-info record; what the frame does not know stays 0."""
    info = bytearray(_CAMERA_INFO_SIZE)
    rows, columns = frame.counts.shape
    p, limits, camera = frame.parameters, frame.limits, frame.camera
    struct.pack_into("<3H", info, 0, 2, columns, rows)
    struct.pack_into(
        "<8f",
        info,
        0x20,
        p.emissivity,
        p.object_distance_m,
        p.reflected_temperature_K,
        p.atmospheric_temperature_K,
        p.window_temperature_K,
        p.window_transmission,
        p.stored_transmission,
        p.relative_humidity,
    )
    struct.pack_into("<3f", info, 0x58, p.planck_r1, p.planck_b, p.planck_f)
    struct.pack_into(
        "<5f",
        info,
        0x70,
        p.atmosphere_alpha1,
        p.atmosphere_alpha2,
        p.atmosphere_beta1,
        p.atmosphere_beta2,
        p.atmosphere_x,
    )
    settings = frame.settings
    struct.pack_into(
        "<8f",
        info,
        0x90,
        limits.maximum_K,
        limits.minimum_K,
        settings.clip_maximum_K,
        settings.clip_minimum_K,
        settings.warn_maximum_K,
        settings.warn_minimum_K,
        settings.saturated_maximum_K,
        settings.saturated_minimum_K,
    )
    texts = (
        (0xD4, 32, camera.model),
        (0xF4, 16, camera.part),
        (0x104, 16, camera.serial),
        (0x114, 16, camera.software),
        (0x170, 32, camera.lens_model),
        (0x190, 16, camera.lens_part),
        (0x1A0, 16, camera.lens_serial),
    )
    for at, width, text in texts:
        # One byte less than the field: readers expect the closing zero.
        struct.pack_into(f"{width - 1}s", info, at, text.encode("latin-1", "replace"))
    struct.pack_into("<f", info, 0x1B4, camera.field_of_view_deg)
    struct.pack_into("<if2H", info, 0x308, round(p.planck_o), p.planck_r2, limits.raw_minimum, limits.raw_maximum)
    low, high = int(frame.counts.min()), int(frame.counts.max())
    shown = (settings.raw_median, settings.raw_range) if settings.raw_range else ((low + high) // 2, high - low)
    struct.pack_into("<2I", info, 0x338, *shown)
    struct.pack_into("<f4xH", info, 0x45C, settings.focus_distance_m, round(settings.frame_rate_Hz))
    _pack_time(info, frame)
    _pack_housekeeping(info, frame)
    return bytes(info)


def _pack_time(info: bytearray, frame: Frame) -> None:
    """Write UTC seconds, milliseconds and minutes west; nothing for NaT."""
    if np.isnat(frame.time):
        return
    milliseconds = int(frame.time.astype("datetime64[ms]").astype(np.int64))
    if not 1000 <= milliseconds < 2**32 * 1000:
        raise ThermographyError(f"time {frame.time}: a FLIR file holds times from 1970 to 2106 only")
    struct.pack_into("<2Ih", info, 0x384, milliseconds // 1000, milliseconds % 1000, -frame.utc_offset_minutes)


def _pack_housekeeping(info: bytearray, frame: Frame) -> None:
    """Write the camera temperatures with the frame's time."""
    seconds, milliseconds = struct.unpack_from("<2I", info, 0x384)
    room = (_CAMERA_INFO_SIZE - 0x47C) // 28
    if len(frame.housekeeping) > room:
        raise ThermographyError(f"housekeeping: a FLIR file holds {room} readings, not {len(frame.housekeeping)}")
    for slot, (name, value) in enumerate(frame.housekeeping.items()):
        if not (name.isascii() and 0 < len(name) < 16 and 150 < value < 450):
            raise ThermographyError(
                f"housekeeping {name!r} = {value}: expected an ASCII name of 1 to 15 letters and 150 to 450 K"
            )
        struct.pack_into("<f16s2I", info, 0x47C + 28 * slot, value, name.encode(), seconds, milliseconds)


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
        # The cameras store the samples in the byte order of the record, which a PNG decoder then takes for big-endian.
        samples = cv2.imencode(".png", native.byteswap(), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    elif encoding == "jpegls":
        samples = _without_spiff(bytes(imagecodecs.jpegls_encode(native)))
        samples += bytes(-len(samples) % 8)
    else:
        raise ThermographyError(f"encoding {encoding!r}: expected 'raw', 'png' or 'jpegls'")
    return bytes(head) + samples


def _without_spiff(stream: bytes) -> bytes:
    """Return a JPEG-LS stream that starts with its frame header, as the cameras write it, without the encoder's SPIFF segments."""
    at = 2
    while stream[at : at + 2] == b"\xff\xe8":
        at += 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
    return stream[:2] + stream[at:]


def _segment(payload: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def _exif(frame: Frame) -> bytes:
    """Return a minimal Exif block: make, model, local date and time."""
    model = frame.camera.model if _EXIF_MODEL in frame.camera.model else f"{_EXIF_MODEL} {frame.camera.model}".strip()
    texts = {0x010F: "FLIR Systems AB", 0x0110: model}
    if not np.isnat(frame.time):
        local = (frame.time + np.timedelta64(frame.utc_offset_minutes, "m")).astype("datetime64[s]")
        texts[0x0132] = str(local).replace("-", ":").replace("T", " ")
    data_at = 8 + 2 + 12 * len(texts) + 4
    entries, data = b"", b""
    for tag, text in texts.items():
        value = text.encode("ascii", "replace") + b"\0"
        # Values of up to four bytes stand in the entry itself.
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", data_at + len(data))
        entries += struct.pack("<HHI", tag, 2, len(value)) + place
        data += value if len(value) > 4 else b""
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, len(texts)) + entries + bytes(4) + data


def _preview(counts: NDArray[np.uint16]) -> bytes:
    """Return an ordinary grey JPEG of the frame, stretched from its lowest to its highest count."""
    low, high = int(counts.min()), int(counts.max())
    grey = ((counts.astype(np.float32) - low) * (255 / max(high - low, 1))).astype(np.uint8)
    encoded: bytes = cv2.imencode(".jpg", grey)[1].tobytes()
    return encoded
