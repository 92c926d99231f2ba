"""L0 - The raw record of an FFF: where its samples are, and the samples themselves (plain, PNG or JPEG-LS)."""

from __future__ import annotations

import struct
from typing import cast

import cv2
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from thermography.flir_frame import Encoding, Samples
from thermography.flir_record import Directory, FffSource, find_record

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
    decoded = _decode_png(data) if samples.encoding == "png" else _decode_jpegls(data)
    if decoded is None:
        raise source.error(samples.offset, f"a {samples.encoding} stream that decodes", "damaged data")
    if decoded.shape != samples.shape or decoded.dtype != np.uint16:
        raise source.error(
            samples.offset, f"{columns} x {rows} samples of 16 bit", f"shape {decoded.shape} of {decoded.dtype}"
        )
    if samples.encoding == "png" and samples.little_endian:
        return decoded.byteswap()
    return decoded


def _decode_png(data: bytes) -> NDArray[np.uint16] | None:
    # imagecodecs (2026.3) loses a reference to None with every damaged PNG, and some ten thousand of them end the interpreter.
    return cast("NDArray[np.uint16] | None", cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def _decode_jpegls(data: bytes) -> NDArray[np.uint16] | None:
    try:
        return cast("NDArray[np.uint16]", imagecodecs.jpegls_decode(data))
    except imagecodecs.JpeglsError:
        return None


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
