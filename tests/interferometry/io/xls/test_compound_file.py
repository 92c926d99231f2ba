"""Compound files: what is written comes back, and chains without an end are refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from interferometry.io.xls import compound_file as module
from interferometry.io.xls.compound_file import CompoundFileError, read_stream, write_stream

#: Header, one sector for the stream, one for short streams, directory, table.
SECTOR = 4096
STREAM, SHORT, DIRECTORY, TABLE = range(4)


def changed(content: bytes, sector: int, place: int, value: int) -> bytes:
    at = (1 + sector) * SECTOR + place
    return content[:at] + struct.pack("<I", value) + content[at + 4 :]


@pytest.mark.parametrize("length", [1, 4096, 4097, 5_000_000])
def test_a_stream_comes_back(length: int) -> None:
    stream = np.random.default_rng(1).bytes(length)
    found = read_stream(write_stream("Workbook", stream), ["Book", "Workbook"])
    assert found[:length] == stream
    assert not any(found[length:]) and len(found) < length + SECTOR


def small_file(stream: bytes) -> bytes:
    """A file with sectors of 512 bytes whose stream lies among the short ones, in sectors of 64 bytes from the third on, backwards."""
    count = -(-len(stream) // 64)
    room = bytearray(64 * (2 + count))
    table = [module._FREE] * 128
    for part in range(count):
        at = 1 + count - part
        room[64 * at : 64 * (at + 1)] = stream[64 * part : 64 * (part + 1)].ljust(64, b"\0")
        table[at] = at - 1 if part + 1 < count else module._END
    shorts = -(-len(room) // 512)
    end, free = module._END, module._FREE
    fat = [end, end, end, *range(4, 3 + shorts), end]
    directory = module._entry_of("Root Entry", 5, 1, 3, len(room)) + module._entry_of(
        "Book", 2, free, 1 + count, len(stream)
    )
    header = module.MAGIC + struct.pack("<16x5H6x9I", 0x3E, 3, 0xFFFE, 9, 6, 0, 1, 1, 0, 4096, 2, 1, end, 0)
    header += struct.pack("<109I", 0, *[free] * 108)
    sectors = [
        struct.pack("<128I", *fat, *[free] * (128 - len(fat))),
        directory.ljust(512, b"\0"),
        struct.pack("<128I", *table),
        bytes(room).ljust(512 * shorts, b"\0"),
    ]
    return header + b"".join(sectors)


def test_a_short_stream_lies_among_the_short_ones() -> None:
    stream = bytes(range(250)) * 3
    assert read_stream(small_file(stream), ["Workbook", "Book"]) == stream


def test_tables_beyond_those_of_the_header_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The header names no table; a sector behind the others does."""
    content = bytearray(write_stream("Workbook", b"abc" * 2000))
    table = struct.unpack_from("<I", content, 76)[0]
    struct.pack_into("<I", content, 76, module._FREE)
    struct.pack_into("<II", content, 68, table + 1, 1)
    content += struct.pack(f"<{SECTOR // 4}I", table, *[module._FREE] * (SECTOR // 4 - 2), module._END)
    assert read_stream(bytes(content), ["Workbook"]).startswith(b"abc" * 2000)
    struct.pack_into("<I", content, len(content) - 4, table + 1)
    with pytest.raises(CompoundFileError, match="the list of its tables has no end"):
        read_stream(bytes(content), ["Workbook"])


def test_chains_and_sizes_that_are_not_true_are_refused() -> None:
    content = write_stream("Workbook", b"x" * 100)
    for broken, told in (
        (changed(content, TABLE, 4 * STREAM, STREAM), "a chain of sectors has no end"),
        (changed(content, TABLE, 4 * DIRECTORY, DIRECTORY), "a chain of sectors has no end"),
        (changed(content, TABLE, 4 * STREAM, 500), "sector 500 is not in the file"),
        (changed(content, DIRECTORY, 128 + 120, 5_000_000), "a stream states 5000000 bytes and has 4096"),
        (changed(content, DIRECTORY, 128, 0), "it holds no Workbook"),
        (content[:3000], "a table of sectors is not in the file"),
        (content[:100], "it has no header of a compound file"),
        (content[:30] + b"\x0a\x00" + content[32:], r"it states sectors of 2\^10 and 2\^6 bytes"),
    ):
        with pytest.raises(CompoundFileError, match=told):
            read_stream(broken, ["Workbook"])
