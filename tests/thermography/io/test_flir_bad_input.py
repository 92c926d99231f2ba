"""Broken promises of FLIR files: each refused with file, place, what was expected and what was found."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import pytest

from tests.thermography.flir_mutations import jpeg, sequence
from thermography.io.flir import index_frames, read_frame
from thermography.io.frame import FlirFormatError


def _segments(data: bytes) -> list[tuple[int, int]]:
    """Return (offset, length) of every marker segment before the image."""
    found, at = [], 2
    while data[at + 1] == 0xE1:
        (length,) = struct.unpack_from(">H", data, at + 2)
        found.append((at, 2 + length))
        at += 2 + length
    return found


def test_truncation_at_every_byte_of_the_headers_is_refused_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=1)
    data = path.read_bytes()
    boundaries = [*range(0x60), 0x200, 0x201, 0x200 + 2475, 0x200 + 2476, 0x200 + 2476 + 0x20, len(data) - 1]
    for length in boundaries:
        path.write_bytes(data[:length])
        with pytest.raises(FlirFormatError, match=r"a\.seq: at 0x[0-9A-F]+: expected .*, found"):
            read_frame(path)


def _patched(path: Path, at: int, value: bytes) -> Path:
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (
            0x14,
            b"\xff\xff\xff\xff",
            r"at 0x14: expected a version of 100 to 199 in either byte order, found ff ff ff ff",
        ),
        (0x18, b"\0\0\0\x10", r"at 0x18: expected a directory after the header \(offset >= 64\), found 16"),
        (0x18, b"\x7f\xff\xff\xff", r"at 0x7FFFFFFF: expected a directory of 448 bytes, found 0 bytes before the end"),
        (0x1C, b"\0\0\0\0", r"at 0x1C: expected 1 to 1024 directory slots, found 0"),
        (0x1C, b"\xff\xff\xff\xff", r"expected 1 to 1024 directory slots, found 4294967295"),
        (0x40, b"\0\x99", r"expected camera information \(type 0x20\) in the directory, found types 0x99, 0x01"),
        (0x60, b"\0\x99", r"expected a raw image \(type 0x01\) in the directory, found types 0x20, 0x99"),
        (
            0x4C,
            b"\x7f\0\0\0",
            r"at 0x7F000000: expected camera information of 2476 bytes, found 0 bytes before the end",
        ),
        (0x50, b"\0\0\0\x20", r"at 0x200: expected camera information of at least 788 bytes, found 32 bytes"),
        (0x70, b"\0\0\0\x10", r"expected a raw image longer than its header, found 16 bytes"),
        (0x70, b"\0\0\0\x30", r"expected 16 x 12 samples of 2 bytes, found a record with 16 bytes of samples"),
        (0x200, b"XX", r"at 0x200: expected the byte-order mark 2 of the camera information, found 58 58"),
        (0xBAC, b"XX", r"at 0xBAC: expected the byte-order mark 2 of a raw image, found 58 58"),
        (0xBAE, b"\0\0", r"at 0xBAE: expected 1 to 16777216 pixels, found 0 x 12"),
        (0xBAE, b"\xff\xff\xff\xff", r"expected 1 to 16777216 pixels, found 65535 x 65535"),
    ],
)
def test_a_broken_promise_is_named_with_file_and_place(tmp_path: Path, at: int, value: bytes, message: str) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=1)
    with pytest.raises(FlirFormatError, match=message):
        read_frame(_patched(path, at, value))


def test_a_directory_that_points_to_itself_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, frames=1)
    with pytest.raises(FlirFormatError, match="byte-order mark"):
        read_frame(_patched(path, 0x4C, struct.pack(">I", 0x40)))


@pytest.mark.parametrize(
    ("encoding", "old", "new", "message"),
    [
        ("png", struct.pack(">2I", 16, 12), struct.pack(">2I", 60000, 60000), "PNG chunk b'IHDR' with its CRC"),
        (
            "png",
            b"IEND",
            b"XXXX",
            "expected PNG chunk b'XXXX' with its CRC, found another one: the samples are damaged",
        ),
        ("png", b"IDAT", b"IDAX", "expected PNG chunk b'IDAX' with its CRC"),
        ("jpegls", struct.pack(">2H", 12, 16), b"\xff\xff\xff\xff", r"found \(16, 65535, 65535, 1\)"),
        ("jpegls", b"\xff\xda", b"\xff\xfe", "expected a JPEG-LS stream that decodes"),
        ("jpegls", b"\xff\xd9", b"\0\0", "expected a JPEG-LS stream that ends with FF D9"),
    ],
    ids=["png size", "png end", "png data", "jpegls size", "jpegls scan", "jpegls end"],
)
def test_bombs_and_garbage_streams_are_refused(
    tmp_path: Path, encoding: str, old: bytes, new: bytes, message: str
) -> None:
    path = tmp_path / "a.seq"
    sequence(path, encoding, frames=1)
    data = path.read_bytes()
    start = data.index(b"\x89PNG" if encoding == "png" else b"\xff\xd8\xff\xf7")
    path.write_bytes(data[:start] + data[start:].replace(old, new))
    with pytest.raises(FlirFormatError, match=message):
        read_frame(path)


def test_thousands_of_damaged_pictures_leave_the_interpreter_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.seq"
    sequence(path, "png", frames=1)
    data = bytearray(path.read_bytes())
    at = data.index(b"IDAT") + 10
    data[at : at + 4] = b"abcd"
    path.write_bytes(data)
    (frame,), _ = index_frames([path])
    before = sys.getrefcount(None)
    for _ in range(2000):
        with pytest.raises(FlirFormatError, match="expected PNG chunk b'IDAT' with its CRC"):
            frame.read_counts()
    # A decoder that loses references to None ends Python 3.11 after some ten thousand damaged frames. It would lose one per picture,
    # 2,000 here; pytest itself lets a few hundred come and go.
    assert sys.getrefcount(None) > before - 1000


def test_segments_must_be_complete_and_single(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    jpeg(path, rows=200, columns=400)
    data = path.read_bytes()
    segments = _segments(data)
    at, length = segments[2]
    path.write_bytes(data[:at] + data[at + length :])
    with pytest.raises(FlirFormatError, match=r"expected FLIR segments 0 to 2, found no \[1\]"):
        read_frame(path)
    path.write_bytes(data[: at + length] + data[at:])
    with pytest.raises(FlirFormatError, match="expected FLIR segment 1 once, found it twice"):
        read_frame(path)


def test_reading_a_small_file_that_claims_much_costs_little(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "a.seq"
    sequence(path, frames=1)
    claim = struct.pack(">I", 0xFFFFFFF0)
    _patched(_patched(path, 0x50, claim), 0x70, claim)
    _patched(path, 0xBAE, struct.pack("<2H", 4096, 4096))
    tracemalloc.start()
    with pytest.raises(FlirFormatError, match=r"bytes fewer: the frame is truncated|before the end"):
        read_frame(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e6
