"""Refuses spreadsheets that a reader would expand to more than memory holds: a few kilobytes can stand for very many cells."""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, BinaryIO

from interferometry.io.faults import LaserFormatError

#: Cells of a spreadsheet, empty ones between the others among them; no laser test has that many.
MOST_CELLS = 20_000_000
#: So many of them may be empty, and so many more for each that is filled.
_EMPTY_CELLS, _EMPTY_PER_FILLED = 1_000_000, 50
#: Characters in all cells, a text as often as cells hold it.
_MOST_TEXT = 200_000_000
#: Bytes that the parts of a spreadsheet may unpack to: 20 million cells take about 50 to 100 bytes of XML each.
_MOST_BYTES = 2_000_000_000
#: Above so many bytes, the most that a sheet of values is packed by: cells that repeat are packed by some tens, one byte alone by 1,000.
_LARGE_BYTES, _MOST_PACKED = 100_000_000, 200
#: Parts of the archive: sheets, charts, pictures.
_MOST_PARTS = 2_000
#: Last row and column of a sheet (XFD1048576).
_LAST_ROW, _LAST_COLUMN = 1_048_576, 16_384
#: Bytes of XML that are searched at a time, and those in which the value of a cell follows its tag.
_PIECE, _NEAR = 1 << 20, 4096
#: A row or a cell in the XML of a sheet, with its attributes, the place among these, as in <c r="B7" s="1" t="s">, and the text's number.
_TAG = re.compile(rb"<(?:\w+:)?(row|c)(\s[^<>]*)?>")
_PLACE = re.compile(rb"\sr\s*=\s*[\"']([A-Za-z]*)(\d+)[\"']")
_SHARED = re.compile(rb"\st\s*=\s*[\"']s[\"']")
_NUMBER = re.compile(rb"<(?:\w+:)?v(?:\s[^<>]*)?>\s*(\d{1,9})")
_TEXTS, _TEXT_END = re.compile(rb"<(?:\w+:)?sst[\s>]"), re.compile(rb"</(?:\w+:)?si>")
#: The same in OpenDocument, where a row or a cell may stand for many alike.
_ODS_TAG = re.compile(rb"<table:(table|table-row|table-cell|covered-table-cell)(\s[^<>]*)?>")
_ODS_REPEATED = re.compile(rb"table:number-(?:rows|columns)-repeated\s*=\s*[\"'](\d{1,18})")
#: Records of binary sheets ([MS-XLSB] 2.3.2): a sheet, a table of texts and one of them, a row, cells, those whose text is in the table.
_XLSB_SHEET, _XLSB_TEXTS, _XLSB_TEXT, _XLSB_ROW, _XLSB_CELLS, _XLSB_SHARED = 129, 159, 19, 0, range(2, 12), 7


@dataclass
class _Extent:
    """What the cells of a spreadsheet take in memory, counted while they are found.

    Attributes
    ----------
    path : Path
        The spreadsheet.
    texts : list of int
        Lengths of the texts that cells share, with the XML around them.
    """

    path: Path
    texts: list[int] = field(default_factory=list)
    _longest: int = field(default=0, init=False)
    _filled: int = field(default=0, init=False)
    _text: int = field(default=0, init=False)
    _before: int = field(default=0, init=False)
    _rows: int = field(default=0, init=False)
    _columns: int = field(default=0, init=False)
    _part: str = field(default="", init=False)

    def begin(self, part: str) -> None:
        """Begin a sheet."""
        self._before += self._rows * self._columns
        self._rows = self._columns = 0
        self._part = part

    def fill(self, row: int, column: int, text: int = 0) -> None:
        """Count a cell, or the last of a block of alike ones, of which `text` is the length of all texts."""
        self._filled += 1
        self._rows, self._columns = max(self._rows, row), max(self._columns, column)
        cells = self._before + self._rows * self._columns
        outside = self._rows > _LAST_ROW or self._columns > _LAST_COLUMN
        if outside or cells > min(MOST_CELLS, _EMPTY_CELLS + _EMPTY_PER_FILLED * self._filled):
            raise LaserFormatError(
                f"{self.path}, {self._part}: a cell in row {row} and column {column} lies far from the others; delete the cells that do "
                "not belong to the table, and save the file again"
            )
        self._add_text(text, f"the cells up to row {row}")

    def share(self, part: str, length: int) -> None:
        """Count a text that cells may share."""
        self._part = part
        self.texts.append(length)
        self._longest = max(self._longest, length)
        self._add_text(length, f"{len(self.texts)} texts of cells")

    def shared(self, number: int | None) -> int:
        """Return the length of a shared text, of the longest where its number is not known."""
        return self._longest if number is None or number >= len(self.texts) else self.texts[number]

    def _add_text(self, length: int, of: str) -> None:
        self._text += length
        if self._text > _MOST_TEXT:
            raise LaserFormatError(
                f"{self.path}, {self._part}: {of} take more than {_MOST_TEXT / 1e6:.0f} million characters; delete what does not belong "
                "to the table, and save the file again"
            )


def refuse_bomb(path: Path, archive: BinaryIO) -> None:
    """Refuse a spreadsheet that would take more than memory holds: by what the archive states, and by places and texts of its cells.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    archive : file
        The spreadsheet, open for reading; its position is left at the beginning. What is no ZIP archive passes.

    Raises
    ------
    LaserFormatError
        The parts are more than 2,000 or lie over one another, or state more than 2 GB in all, or more than 100 MB and 200 times what
        they are packed in; a cell lies so far from the others that the sheets would have more than 20 million cells, or more empty than
        filled ones by far: a reader makes them all; or the texts in the cells have more than 200 million characters.
    """
    size = archive.seek(0, 2)
    try:
        parts = zipfile.ZipFile(archive)
    # What is no archive, or is damaged in its table of contents, is told by the reader itself.
    except (zipfile.BadZipFile, RuntimeError, ValueError, OverflowError, OSError, EOFError, struct.error):
        archive.seek(0)
        return
    with parts:
        _refuse_by_contents(path, parts.infolist(), size)
        extent = _Extent(path)
        # The texts first: a cell names one by its number.
        for look in (_count_texts, _count_cells):
            for each in parts.infolist():
                try:
                    with parts.open(each) as part:
                        look(extent, each.filename, part)
                except LaserFormatError:
                    raise
                # A reader may take no offence at this, and unpack what could not be looked at here.
                except (
                    zipfile.BadZipFile,
                    zlib.error,
                    RuntimeError,
                    ValueError,
                    OSError,
                    EOFError,
                    struct.error,
                ) as fault:
                    raise LaserFormatError(
                        f"{path}: cannot be read as a spreadsheet ({each.filename}: {fault}); open it, remove a password if it has one, "
                        "and save it again as XLSX"
                    ) from None
    archive.seek(0)


def _refuse_by_contents(path: Path, parts: list[zipfile.ZipInfo], size: int) -> None:
    """Refuse an archive of `size` bytes by its table of contents, before anything is unpacked."""
    total, packed = sum(part.file_size for part in parts), sum(part.compress_size for part in parts)
    remedy = "save the sheet with the measured values alone"
    if total > _MOST_BYTES:
        raise LaserFormatError(
            f"{path}: unpacks to {total / 1e9:.1f} GB, at most {_MOST_BYTES / 1e9:g} GB are read; {remedy}"
        )
    if total > max(_LARGE_BYTES, _MOST_PACKED * packed):
        raise LaserFormatError(
            f"{path}: unpacks from {packed / 1e6:.1f} to {total / 1e6:.0f} MB, as no sheet of values does; {remedy}"
        )
    if len(parts) > _MOST_PARTS:
        raise LaserFormatError(f"{path}: holds {len(parts)} sheets and other parts, at most {_MOST_PARTS}; {remedy}")
    if packed > size:
        raise LaserFormatError(f"{path}: its parts lie over one another, as no program writes them; {remedy}")


def _count_texts(extent: _Extent, name: str, part: IO[bytes]) -> None:
    """Count the texts of a part that holds those which cells share."""
    start = part.read(_PIECE)
    if _is_binary(start, _XLSB_TEXTS):
        for kind, payload in _records(start, part):
            if kind == _XLSB_TEXT:
                extent.share(name, len(payload))
    elif _TEXTS.search(start):
        length = 0
        for text, end in _pieces(start, part):
            begin = 0
            for found in _TEXT_END.finditer(text, 0, end):
                extent.share(name, length + found.end() - begin)
                length, begin = 0, found.end()
            length += end - begin
        extent.share(name, length)


def _count_cells(extent: _Extent, name: str, part: IO[bytes]) -> None:
    """Count the cells of a part that is a sheet, by what it begins with. Cells that only have a format cost a reader nothing."""
    start = part.read(_PIECE)
    if _is_binary(start, _XLSB_SHEET):
        extent.begin(name)
        _count_binary(extent, start, part)
    elif b"sheetData" in start:
        extent.begin(name)
        _count_xml(extent, start, part)
    elif b"<table:table" in start:
        extent.begin(name)
        _count_ods(extent, name, start, part)


def _count_xml(extent: _Extent, start: bytes, part: IO[bytes]) -> None:
    """Count the cells of a sheet of Office Open XML."""
    row = column = 0
    for text, end in _pieces(start, part):
        for found in _TAG.finditer(text, 0, end):
            attributes = found[2] or b""
            place = _PLACE.search(attributes)
            if found[1] == b"row":
                row, column = (row + 1 if place is None else int(place[2][:30])), 0
                continue
            # A cell without a place stands beside the one before it.
            column = column + 1 if place is None else _column_number(place[1][:10])
            row = row if place is None else int(place[2][:30])
            if attributes.endswith(b"/") or text.startswith(b"</", found.end()):
                continue
            length = 0
            if _SHARED.search(attributes):
                number = _NUMBER.search(text, found.end(), found.end() + _NEAR)
                length = extent.shared(None if number is None else int(number[1]))
            extent.fill(row, column, length)


def _count_ods(extent: _Extent, name: str, start: bytes, part: IO[bytes]) -> None:
    """Count the cells of OpenDocument sheets, of which a row or a cell may stand for many."""
    row = column = rows = 0
    for text, end in _pieces(start, part):
        for found in _ODS_TAG.finditer(text, 0, end):
            attributes = found[2] or b""
            repeated = _ODS_REPEATED.search(attributes)
            times = 1 if repeated is None else int(repeated[1])
            if found[1] == b"table":
                extent.begin(name)
                row = column = 0
            elif found[1] == b"table-row":
                row, column, rows = row + times, 0, times
            else:
                column += times
                if b"office:value" in attributes or not attributes.endswith(b"/"):
                    following = text.find(b"<table:", found.end())
                    length = (following if following >= 0 else len(text)) - found.end()
                    extent.fill(row, column, length * times * rows)


def _count_binary(extent: _Extent, start: bytes, part: IO[bytes]) -> None:
    """Count the cells of a binary sheet."""
    row = 0
    for kind, payload in _records(start, part):
        if kind == _XLSB_ROW:
            row = 1 + struct.unpack_from("<I", payload)[0]
        elif kind in _XLSB_CELLS:
            shared = kind == _XLSB_SHARED
            length = extent.shared(struct.unpack_from("<I", payload, 8)[0]) if shared else len(payload)
            extent.fill(row, 1 + struct.unpack_from("<I", payload)[0], length)


def _pieces(text: bytes, xml: IO[bytes]) -> Iterator[tuple[bytes, int]]:
    """Yield pieces of XML, each with the place up to which its tags are whole: what follows the last bracket comes again."""
    while text:
        following = xml.read(_PIECE)
        end = max(text.rfind(b"<"), 0) if following else len(text)
        yield text, end
        text = text[end:][-2 * _PIECE :] + following if following else b""


def _is_binary(start: bytes, kind: int) -> bool:
    """Whether a part begins with a record of this kind, written in two bytes."""
    return start[:2] == bytes([kind & 0x7F | 0x80, kind >> 7])


def _records(start: bytes, part: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the records of a binary part; a length that is not true ends them.

    References
    ----------
    [MS-XLSB], 2.1.4: kind in one or two bytes, length in one to four, seven bits each.
    """
    content, place = start + part.read(), 0
    while place < len(content):
        kind, place = _number(content, place, 2)
        length, place = _number(content, place, 4)
        yield kind, content[place : place + length]
        place += length


def _number(content: bytes, place: int, most: int) -> tuple[int, int]:
    """Return a number of up to `most` bytes, and the place after it."""
    value = 0
    for k, byte in enumerate(content[place : place + most]):
        value |= (byte & 0x7F) << (7 * k)
        place += 1
        if not byte & 0x80:
            break
    return value, place


def _column_number(letters: bytes) -> int:
    """Return the number of a column: A is 1, Z 26, AA 27."""
    number = 0
    for letter in letters.upper():
        number = 26 * number + letter - ord("A") + 1
    return number
