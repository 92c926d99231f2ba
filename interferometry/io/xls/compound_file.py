"""Compound files, the container of old Office documents: one stream taken out, and put into a new container of its own.

Notes
-----
[MS-CFB]: a header, then sectors of 512 or 4096 bytes. A table of sectors (FAT) says which sector follows which, a directory names the
streams; short streams lie in a stream of their own, in sectors of 64 bytes with a table of theirs.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from interferometry.errors import InterferometryError

MAGIC = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
#: Entries of the table of sectors: end of a chain, sector of the table itself, free sector.
_END, _OF_TABLE, _FREE = 0xFFFFFFFE, 0xFFFFFFFD, 0xFFFFFFFF
#: Bytes of the header, places of sectors of the table in it, bytes of an entry of the directory.
_HEADER, _PLACES, _ENTRY = 512, 109, 128
_ROOT, _STREAM = 5, 2
#: Bytes below which a stream lies among the short ones.
_SHORT = 4096
_Table = NDArray[np.uint32]


class CompoundFileError(InterferometryError):
    """A container that is not what it states; the message says what is wrong."""


@dataclass(frozen=True)
class _Sectors:
    """Sectors of one size, and which follows which."""

    content: bytes
    size: int
    table: _Table

    def chain(self, first: int) -> bytes:
        """Return the sectors of a chain; one that comes back to itself, or leaves the file, is refused."""
        number, most = first, len(self.content) // self.size + 1
        parts: list[bytes] = []
        while number != _END:
            if number >= self.table.size or number * self.size >= len(self.content):
                raise CompoundFileError(f"sector {number} is not in the file")
            if len(parts) >= most:
                raise CompoundFileError("a chain of sectors has no end")
            parts.append(self.content[number * self.size : (number + 1) * self.size])
            number = int(self.table[number])
        return b"".join(parts)


def read_stream(content: bytes, names: Collection[str]) -> bytes:
    """Return a stream of a compound file.

    Parameters
    ----------
    content : bytes
        The whole file.
    names : collection of str
        Names of the stream, the first that is there counts.

    Returns
    -------
    bytes

    Raises
    ------
    CompoundFileError
        There is no such stream, or sectors, tables or sizes are not what the file states.
    """
    if len(content) < _HEADER or not content.startswith(MAGIC):
        raise CompoundFileError("it has no header of a compound file")
    shift, short_shift = struct.unpack_from("<HH", content, 30)
    (count, first_entry) = struct.unpack_from("<I4xI", content, 44)[0], struct.unpack_from("<I", content, 48)[0]
    first_short, next_places = struct.unpack_from("<I", content, 60)[0], struct.unpack_from("<I", content, 68)[0]
    if shift not in (9, 12) or short_shift != 6:
        raise CompoundFileError(f"it states sectors of 2^{shift} and 2^{short_shift} bytes")
    size = 1 << shift
    sectors = _Sectors(content[size:], size, _table(content, size, count, next_places))
    entries = sectors.chain(first_entry)
    root = _entry(entries, _ROOT, ("Root Entry", "R"))
    found = next((one for name in names if (one := _entry(entries, _STREAM, (name,))) is not None), None)
    if found is None:
        raise CompoundFileError(f"it holds no {' or '.join(names)}")
    first, length = found
    if length >= _SHORT:
        stream = sectors.chain(first)
    else:
        if root is None:
            raise CompoundFileError("it has no directory")
        short = np.frombuffer(sectors.chain(first_short), "<u4")
        stream = _Sectors(sectors.chain(root[0]), 1 << short_shift, short).chain(first)
    if length > len(stream):
        raise CompoundFileError(f"a stream states {length} bytes and has {len(stream)}")
    return stream[:length]


def _table(content: bytes, size: int, count: int, following: int) -> _Table:
    """Return the table of sectors: the header names the first 109 sectors of it, and a chain of sectors the others."""
    places = list(struct.unpack_from(f"<{_PLACES}I", content, 76))
    lists = 0
    while following not in (_END, _FREE):
        begin = (following + 1) * size
        if begin + size > len(content) or (lists := lists + 1) > len(content) // size:
            raise CompoundFileError("the list of its tables has no end")
        *more, following = struct.unpack_from(f"<{size // 4}I", content, begin)
        places += more
    chosen = [place for place in places if place < _OF_TABLE][:count]
    parts = [content[(place + 1) * size : (place + 2) * size] for place in chosen]
    if any(len(part) != size for part in parts) or len(parts) > len(content) // size:
        raise CompoundFileError("a table of sectors is not in the file")
    return np.frombuffer(b"".join(parts), "<u4")


def _entry(entries: bytes, kind: int, names: Collection[str]) -> tuple[int, int] | None:
    """Return first sector and length of an entry of the directory, by its name; None where there is none."""
    for begin in range(0, len(entries) - _ENTRY + 1, _ENTRY):
        length, stated = struct.unpack_from("<HB", entries, begin + 64)
        name = entries[begin : begin + min(max(length - 2, 0), 64)].decode("utf-16-le", "replace")
        # Names differ by more than the case of letters, [MS-CFB] 2.6.4.
        if stated == kind and (kind == _ROOT or name.casefold() in {one.casefold() for one in names}):
            first, size = struct.unpack_from("<II", entries, begin + 116)
            return first, size
    return None


def write_stream(name: str, stream: bytes) -> bytes:
    """Return a compound file that holds one stream and nothing else.

    Parameters
    ----------
    name : str
        Of the stream, at most 31 characters.
    stream : bytes
        Its content; zeros are added up to a whole sector, so that it never lies among the short ones.

    Raises
    ------
    CompoundFileError
        The stream has more than 400 MB.
    """
    size = 4096
    body = stream.ljust(max(-(-len(stream) // size), 1) * size, b"\0")
    sectors = len(body) // size
    # Behind the stream: an empty sector for short streams, as readers want one in a file with large sectors; directory; tables.
    tables = -(-(sectors + 2) // (size // 4 - 1))
    if tables > _PLACES:
        raise CompoundFileError(f"a stream of {len(stream) / 1e6:.0f} MB is too long")
    table = np.full(tables * (size // 4), _FREE, "<u4")
    table[: sectors - 1] = np.arange(1, sectors)
    table[sectors - 1 : sectors + 2] = _END
    table[sectors + 2 : sectors + 2 + tables] = _OF_TABLE
    directory = _entry_of("Root Entry", _ROOT, 1, sectors, size) + _entry_of(name, _STREAM, _FREE, 0, len(body))
    places = [sectors + 2 + number for number in range(tables)] + [_FREE] * (_PLACES - tables)
    header = MAGIC + struct.pack(
        f"<16x5H6x9I{_PLACES}I", 0x3E, 4, 0xFFFE, 12, 6, 1, tables, sectors + 1, 0, _SHORT, _END, 0, _END, 0, *places
    )
    return b"".join([header.ljust(size, b"\0"), body, bytes(size), directory.ljust(size, b"\0"), table.tobytes()])


def _entry_of(name: str, kind: int, child: int, first: int, length: int) -> bytes:
    coded = name.encode("utf-16-le")
    return coded.ljust(64, b"\0") + struct.pack(
        "<HBBIII36xIQ", len(coded) + 2, kind, 1, _FREE, _FREE, child, first, length
    )
