"""PNG samples: equal to those of the general decoder for every filter, and every damage is detected."""

import gc
import re
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermography.io.fff_record import SIGNATURES, PngError, decode_png


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(shape: tuple[int, int], lines: bytes, *, kind: tuple[int, ...] = (16, 0, 0, 0, 0)) -> bytes:
    """A PNG with a sound structure around lines of any content."""
    header = struct.pack(">2I5B", shape[1], shape[0], *kind)
    return SIGNATURES["png"] + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(lines)) + _chunk(b"IEND", b"")


@settings(max_examples=200, deadline=None)
@given(rows=st.integers(1, 12), columns=st.integers(1, 12), seed=st.integers(0, 2**32 - 1))
def test_random_lines_with_all_filters_equal_libpng(rows, columns, seed):
    rng = np.random.default_rng(seed)
    lines = rng.integers(0, 256, (rows, 1 + 2 * columns)).astype(np.uint8)
    lines[:, 0] = rng.integers(0, 5, rows)
    data = _png((rows, columns), lines.tobytes())
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    decoded = decode_png(data, (rows, columns))
    np.testing.assert_array_equal(decoded, expected)
    assert decoded.dtype == np.uint16 and decoded.dtype.isnative and decoded.flags.writeable


@pytest.mark.parametrize("shape", [(97, 1), (1, 70), (10, 255), (60, 80)])
def test_either_order_of_bytes_is_that_of_libpng(rng, shape):
    lines = rng.integers(0, 256, (shape[0], 1 + 2 * shape[1])).astype(np.uint8)
    lines[:, 0] = rng.integers(0, 5, shape[0])
    data = _png(shape, lines.tobytes())
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decode_png(data, shape), expected)
    np.testing.assert_array_equal(decode_png(data, shape, little_endian=True), expected.byteswap())


def test_data_in_several_chunks_and_bytes_after_the_end_are_fine():
    counts = np.arange(12, dtype=">u2").reshape(3, 4)
    packed = zlib.compress(b"".join(b"\0" + line.tobytes() for line in counts))
    header = _chunk(b"IHDR", struct.pack(">2I5B", 4, 3, 16, 0, 0, 0, 0))
    parts = [_chunk(b"IDAT", packed[:5]), _chunk(b"tEXt", b"a\0b"), _chunk(b"IDAT", packed[5:]), _chunk(b"IEND", b"")]
    data = SIGNATURES["png"] + header + b"".join(parts) + b"padding"
    np.testing.assert_array_equal(decode_png(data, (3, 4)), counts)


@pytest.mark.parametrize(
    ("data", "expected", "actual"),
    [
        (_png((2, 3), bytes(14))[:50], "bytes in PNG chunk b'IDAT'", "5 before the end"),
        (_png((2, 3), bytes(14))[:-12], "a PNG that ends with IEND", "bytes without it"),
        (_png((60000, 60000), b""), r"a PNG header .* \(3, 2, 16, 0, 0, 0, 0\)", r"\(60000, 60000, 16, 0, 0, 0, 0\)"),
        (_png((2, 3), bytes(14), kind=(8, 2, 0, 0, 0)), "a PNG header", "\\(3, 2, 8, 2, 0, 0, 0\\)"),
        (SIGNATURES["png"] + _chunk(b"IDAT", b""), "a PNG header", "None"),
        (_png((2, 3), bytes(13)), "PNG data that inflate to 14 bytes", "13"),
        (_png((2, 3), bytes(10_000_000)), "PNG data that inflate to 14 bytes", ""),
        (_png((2, 3), bytes((9, *bytes(13)))), "PNG lines with filters 0 to 4", "another filter"),
    ],
    ids=["short chunk", "no end", "other size", "other kind", "no header", "short", "bomb", "filter"],
)
def test_what_is_no_sound_picture_is_refused(data, expected, actual):
    with pytest.raises(PngError) as caught:
        decode_png(data, (2, 3))
    assert len(caught.value.args) == 2
    assert re.search(expected, caught.value.args[0]) and re.search(actual, caught.value.args[1]), caught.value.args


def test_every_single_flipped_bit_is_noticed_or_harmless(rng):
    counts = (18000 + rng.normal(0, 8, (6, 8))).astype(np.uint16)
    data = cv2.imencode(".png", counts)[1].tobytes()
    gc.collect()
    before = sys.getrefcount(None)
    for place in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[place // 8] ^= 1 << place % 8
        try:
            decoded = decode_png(bytes(damaged), counts.shape)
        except PngError:
            continue
        np.testing.assert_array_equal(decoded, counts)
    # A decoder that loses references to None ends the interpreter after some ten thousand damaged frames.
    assert sys.getrefcount(None) > before - 100
