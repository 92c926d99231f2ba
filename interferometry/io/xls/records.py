"""Records of a workbook of Excel 97 to 2003: what its cells and texts would take, counted before a reader makes them.

A reader makes every cell between the first and the last one of a sheet, and makes room for as many as a sheet states. Five kilobytes could
so end a process. Here places and texts are counted as in `workbook_limits`, and the reader gets a container that holds the counted stream
alone, without macros, pictures and other streams, and without the stated sizes.

References
----------
[MS-XLS] 2.1.4 (records), 2.4 (their kinds), 2.5.293 (texts).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from interferometry.io.faults import LaserFormatError, unreadable_spreadsheet
from interferometry.io.workbook_limits import Extent
from interferometry.io.xls.compound_file import MAGIC, CompoundFileError, read_stream, write_stream

#: Bytes of a file; the cells that are read take less.
_MOST_BYTES = 100_000_000
#: So many cells may be empty: a stray one in the last row, 65,536, of a table of 18 columns. Beyond that a small file takes seconds.
_EMPTY_CELLS = 1_200_000
#: Sheets, charts and macros.
_MOST_SHEETS = 2_000
_STREAMS = ("Workbook", "Book")
#: Kinds of records: end of a part, a sheet of the workbook, texts that cells share, what follows of a long record, stated size of a sheet,
#: and the one behind which a password hides the contents of all others.
_END, _SHEET, _TEXTS, _CONTINUED, _SIZE, _LOCKED = 0x000A, 0x0085, 0x00FC, 0x003C, 0x0200, 0x002F
#: Cells: with a shared text; several numbers in one record; these and the others, but for empty ones, which a reader leaves out.
_SHARED, _SEVERAL = 0x00FD, 0x00BD
_CELLS = {2, 3, 4, 5, 6, 0x00D6, 0x0203, 0x0204, 0x0205, 0x0206, 0x027E, 0x0406, _SHARED, _SEVERAL}
#: Of a text: its characters take two bytes; phonetic readings follow; formats within it follow.
_WIDE, _PHONETIC, _FORMATTED = 0x01, 0x04, 0x08


def is_compound(content: bytes) -> bool:
    """Return whether a file is a compound file.

    Parameters
    ----------
    content : bytes
        Its first four bytes or more.
    """
    return content.startswith(MAGIC[:4])


def guarded_workbook(path: Path, content: bytes) -> bytes:
    """Return a workbook as a compound file that a reader can be given, after its cells and texts were counted.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    content : bytes
        The whole file.

    Returns
    -------
    bytes
        A container with the stream of the workbook alone, in which no sheet states its size.

    Raises
    ------
    LaserFormatError
        The file has more than 100 MB, is no workbook, is locked with a password, its sheets are more than 2,000 or lie over one another, or
        its cells reach too far or hold too much text, see `workbook_limits.refuse_bomb`.
    """
    if len(content) > _MOST_BYTES:
        raise LaserFormatError(
            f"{path}: has {len(content) / 1e6:.0f} MB, of an old spreadsheet at most {_MOST_BYTES / 1e6:.0f} MB are read; save the sheet "
            "with the measured values alone, as XLSX"
        )
    try:
        stream = bytearray(read_stream(content, _STREAMS))
        extent = Extent(path, empty_cells=_EMPTY_CELLS)
        _count(path, extent, stream)
        extent.end()
        return write_stream(_STREAMS[0], bytes(stream))
    except (CompoundFileError, struct.error) as fault:
        raise unreadable_spreadsheet(path, fault) from None


def _count(path: Path, extent: Extent, stream: bytearray) -> None:
    """Count texts and cells of all sheets, and take the stated sizes out of them."""
    sheets: list[int] = []
    texts: list[tuple[int, int]] = []
    for kind, begin, length in _records(stream, 0):
        if kind == _SHEET:
            sheets.append(struct.unpack_from("<I", stream, begin)[0])
        elif kind == _TEXTS or (kind == _CONTINUED and texts):
            texts.append((begin, length))
        elif kind == _LOCKED:
            raise LaserFormatError(f"{path}: is locked with a password; remove it and save the file as XLSX")
        elif texts:
            _share(extent, stream, texts)
            texts = []
    # Nothing may follow them: a reader does not miss the end.
    if texts:
        _share(extent, stream, texts)
    if len(sheets) > _MOST_SHEETS:
        raise LaserFormatError(
            f"{path}: holds {len(sheets)} sheets, at most {_MOST_SHEETS} are read; save the sheet with the measured values alone"
        )
    looked_at = 0
    for number, place in enumerate(sheets, start=1):
        extent.begin(f"sheet {number}")
        for kind, begin, length in _records(stream, place):
            looked_at += 4 + length
            if looked_at > len(stream):
                raise LaserFormatError(
                    f"{path}: its sheets lie over one another, as no program writes them; save it again as XLSX"
                )
            if kind == _SIZE:
                stream[begin : begin + length] = bytes(length)
            elif kind in _CELLS:
                _fill(extent, stream, kind, begin, length)


def _fill(extent: Extent, stream: bytearray, kind: int, begin: int, length: int) -> None:
    """Count a record of one cell or several."""
    row, column = struct.unpack_from("<HH", stream, begin)
    if kind == _SEVERAL:
        column = max(column, struct.unpack_from("<H", stream, begin + length - 2)[0])
        extent.fill(1 + row, 1 + column)
    else:
        shared = kind == _SHARED and length >= 10
        text = extent.shared(struct.unpack_from("<I", stream, begin + 6)[0]) if shared else length
        extent.fill(1 + row, 1 + column, text)


def _records(stream: bytearray, place: int) -> Iterator[tuple[int, int, int]]:
    """Yield kind, place of the content and its length of the records of a part, up to its end."""
    while place + 4 <= len(stream):
        kind, length = struct.unpack_from("<HH", stream, place)
        if place + 4 + length > len(stream):
            raise CompoundFileError(f"the record at byte {place} of the workbook reaches beyond its end")
        yield kind, place + 4, length
        if kind == _END:
            return
        place += 4 + length


def _share(extent: Extent, stream: bytearray, parts: list[tuple[int, int]]) -> None:
    """Count the texts that cells share: a record and what follows of it."""
    reader = _Texts(stream, parts)
    reader.skip(4)
    for _ in range(struct.unpack("<I", reader.take(4))[0]):
        if reader.at_end:
            return
        extent.share("shared texts", reader.next_length())


class _Texts:
    """Texts in a record that is continued in others: where the characters of one are parted, their width is stated anew."""

    def __init__(self, stream: bytearray, parts: list[tuple[int, int]]) -> None:
        self._stream, self._parts = stream, parts
        self._part, self._place = 0, parts[0][0]

    @property
    def _left(self) -> int:
        begin, length = self._parts[self._part]
        return begin + length - self._place

    @property
    def at_end(self) -> bool:
        """Whether nothing follows."""
        return not self._left and not self._turn()

    def _turn(self) -> bool:
        """Go to the next part that holds something."""
        while self._part + 1 < len(self._parts):
            self._part += 1
            self._place = self._parts[self._part][0]
            if self._left:
                return True
        return False

    def take(self, count: int) -> bytes:
        """Return the next bytes of a head, which is in one part; fewer where the texts end."""
        if not self._left:
            self._turn()
        taken = bytes(self._stream[self._place : self._place + min(count, self._left)])
        self._place += len(taken)
        return taken.ljust(count, b"\0")

    def skip(self, count: int) -> None:
        """Go over bytes, from part to part."""
        while count > 0 and (self._left or self._turn()):
            step = min(count, self._left)
            self._place += step
            count -= step

    def next_length(self) -> int:
        """Go over a text and return the number of its characters."""
        characters, flags = struct.unpack("<HB", self.take(3))
        formats = struct.unpack("<H", self.take(2))[0] if flags & _FORMATTED else 0
        phonetic = struct.unpack("<I", self.take(4))[0] if flags & _PHONETIC else 0
        left = characters
        while left > 0:
            if not self._left:
                if not self._turn():
                    break
                flags = self.take(1)[0]
            width = 2 if flags & _WIDE else 1
            step = min(left, max(self._left // width, 1))
            self.skip(step * width)
            left -= step
        self.skip(4 * formats + phonetic)
        return int(characters)
