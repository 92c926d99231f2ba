"""L0 - The raw record of an FFF: where its samples are, and the samples themselves (plain, PNG or JPEG-LS)."""

from __future__ import annotations

import struct
from typing import cast

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from thermography.flir_frame import Encoding, Samples
from thermography.flir_png import SIGNATURE, PngError, decode_png
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
