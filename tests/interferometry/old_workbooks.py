"""Workbooks of Excel 97 to 2003 ([MS-CFB], [MS-XLS]), written record by record, sound ones and others."""

import struct
from collections.abc import Sequence

import numpy as np

CONTINUED, END, NUMBER, SHARED, SHEET, SIZE, TEXTS = 0x003C, 0x000A, 0x0203, 0x00FD, 0x0085, 0x0200, 0x00FC
_LONGEST = 8224
#: Bytes of a sector of the container; the first is its header.
SECTOR = 4096
_LAST, _OF_TABLE, _FREE = 0xFFFFFFFE, 0xFFFFFFFD, 0xFFFFFFFF


def record(kind: int, payload: bytes = b"") -> bytes:
    """A record, continued in others where it is long."""
    written = struct.pack("<HH", kind, min(len(payload), _LONGEST)) + payload[:_LONGEST]
    for begin in range(_LONGEST, len(payload), _LONGEST):
        part = payload[begin : begin + _LONGEST]
        written += struct.pack("<HH", CONTINUED, len(part)) + part
    return written


def number(row: int, column: int, value: float = 1.0) -> bytes:
    return record(NUMBER, struct.pack("<HHHd", row, column, 0, value))


def shared(row: int, column: int, text: int) -> bytes:
    return record(SHARED, struct.pack("<HHHI", row, column, 0, text))


def size(rows: int, columns: int) -> bytes:
    return record(SIZE, struct.pack("<IIHHH", 0, rows, 0, columns, 0))


def sheet(*records: bytes) -> bytes:
    return _begin(0x10) + b"".join(records) + record(END)


def _begin(kind: int) -> bytes:
    return record(0x0809, struct.pack("<HHHHII", 0x600, kind, 0, 0, 0, 0))


def workbook(sheets: Sequence[bytes], *, texts: bytes = b"", one_place: bool = False) -> bytes:
    """The stream of a workbook; with `one_place` all sheets stand at the place of the first."""
    names = [f"s{count}".encode() for count in range(len(sheets))]
    place = len(_begin(5)) + sum(12 + len(name) for name in names) + len(texts) + 4
    heads = b""
    for name, content in zip(names, sheets, strict=True):
        heads += record(SHEET, struct.pack("<IBBBB", place, 0, 0, len(name), 0) + name)
        place += 0 if one_place else len(content)
    return _begin(5) + heads + texts + record(END) + (sheets[0] if one_place else b"".join(sheets))


def shared_texts(*texts: str) -> bytes:
    """A record of texts that cells share, in one byte a character where that is enough."""
    written = struct.pack("<II", len(texts), len(texts))
    for text in texts:
        wide = not text.isascii()
        written += struct.pack("<HB", len(text), wide) + text.encode("utf-16-le" if wide else "ascii")
    return record(TEXTS, written)


def compound_file(name: str, stream: bytes) -> bytes:
    """A container with one stream: header, stream, an empty sector for short streams, directory, table of sectors."""
    body = stream.ljust(max(-(-len(stream) // SECTOR), 1) * SECTOR, b"\0")
    sectors = len(body) // SECTOR
    tables = -(-(sectors + 2) // (SECTOR // 4 - 1))
    table = np.full(tables * (SECTOR // 4), _FREE, "<u4")
    table[: sectors - 1] = np.arange(1, sectors)
    table[sectors - 1 : sectors + 2] = _LAST
    table[sectors + 2 : sectors + 2 + tables] = _OF_TABLE
    directory = _entry("Root Entry", 5, 1, sectors, SECTOR) + _entry(name, 2, _FREE, 0, len(body))
    places = [sectors + 2 + at for at in range(tables)] + [_FREE] * (109 - tables)
    header = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + struct.pack(
        "<16x5H6x9I109I", 0x3E, 4, 0xFFFE, 12, 6, 1, tables, sectors + 1, 0, SECTOR, _LAST, 0, _LAST, 0, *places
    )
    return b"".join([header.ljust(SECTOR, b"\0"), body, bytes(SECTOR), directory.ljust(SECTOR, b"\0"), table.tobytes()])


def _entry(name: str, kind: int, child: int, first: int, length: int) -> bytes:
    coded = name.encode("utf-16-le")
    places = struct.pack("<HBBIII36xIQ", len(coded) + 2, kind, 1, _FREE, _FREE, child, first, length)
    return coded.ljust(64, b"\0") + places


def file_of(*sheets: bytes, **options: bytes | bool) -> bytes:
    return compound_file("Workbook", workbook(sheets, **options))


#: A table of five rows and three columns.
TABLE = tuple(number(row, column, row + column / 10) for row in range(5) for column in range(3))
