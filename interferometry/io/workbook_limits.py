"""Refuses spreadsheets that a reader would expand to more than memory holds: a few kilobytes can stand for very many cells."""

from __future__ import annotations

import codecs
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, BinaryIO, cast

from interferometry.io.faults import LaserFormatError, unreadable_spreadsheet

#: Cells of a spreadsheet, empty ones between the others among them; no laser test has that many.
MOST_CELLS = 20_000_000
#: So many of them may be empty, and so many more for each that is filled.
_EMPTY_CELLS, _EMPTY_PER_FILLED = 5_000_000, 50
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
#: Bytes of XML that are searched at a time, those in which the value of a cell follows its tag, and the most that a number takes.
_PIECE, _NEAR, _LONGEST_NUMBER = 1 << 20, 4096, 100
#: A sheet, a row or a cell, with its attributes: in Office Open XML, as in <c r="B7" s="1" t="s">, and in OpenDocument.
_TAG = re.compile(
    rb"<(?:(?!/)[^\s<>:]*:)?(sheetData|row|c|table|table-row|table-cell|covered-table-cell)"
    rb"(?=[\s/>])((?:[^<>\"']++|\"[^\"]*+\"|'[^']*+')*+)>"
)
#: The beginning of a tag with attributes.
_OPEN = re.compile(rb"<[^\s<>!?/][^\s<>]*\s[^>]*+\Z")
#: In Office Open XML: the place of a row or a cell, cells with a shared text and with one of their own, and the number of the shared one.
_PLACE = re.compile(rb"\sr\s*=\s*[\"']([A-Za-z]*)(\d+)[\"']")
_SHARED, _OWN = (re.compile(rb"\st\s*=\s*[\"']" + kind + rb"[\"']") for kind in (rb"s", rb"(?:inlineStr|str)"))
_NUMBER = re.compile(rb"<(?:\w+:)?v(?:\s[^<>]*)?>\s*(\d{1,9})")
_TEXTS, _TEXT_END = re.compile(rb"<(?:(?!/)[^\s<>:]*:)?sst[\s>]"), re.compile(rb"</(?:[^\s<>:]*:)?si\s*>")
#: In OpenDocument, where a row or a cell may stand for many alike.
_ODS_REPEATED = re.compile(rb"table:number-(?:rows|columns)-repeated\s*=\s*[\"'](\d{1,18})")
#: Last letters of the name of a part that only archives with binary sheets have.
_XLSB_CONTENTS = "workbook.bin.rels"
#: Records of binary sheets ([MS-XLSB] 2.3.2): before the cells, before shared texts, one of these, a row, cells, those with a shared text.
_XLSB_SHEET, _XLSB_TEXTS, _XLSB_TEXT, _XLSB_ROW, _XLSB_CELLS, _XLSB_SHARED = 145, 159, 19, 0, range(2, 12), 7


@dataclass
class Extent:
    """What the cells of a spreadsheet take in memory, counted while they are found.

    Attributes
    ----------
    path : Path
        The spreadsheet.
    texts : list of int
        Lengths of the texts that cells share, with the XML around them.
    empty_cells : int
        So many cells may be empty, and 50 more for each that is filled.
    """

    path: Path
    texts: list[int] = field(default_factory=list)
    empty_cells: int = _EMPTY_CELLS
    _longest: int = field(default=0, init=False)
    _filled: int = field(default=0, init=False)
    _text: int = field(default=0, init=False)
    _before: int = field(default=0, init=False)
    _rows: int = field(default=0, init=False)
    _columns: int = field(default=0, init=False)
    _part: str = field(default="", init=False)
    _largest: tuple[int, str, int, int] = field(default=(0, "", 0, 0), init=False)

    def begin(self, part: str) -> None:
        """Begin a sheet."""
        self._end_sheet()
        self._part = part

    def fill(self, row: int, column: int, text: int = 0) -> None:
        """Count a cell, or the last of a block of alike ones, of which `text` is the length of all texts."""
        self._filled += 1
        self._rows, self._columns = max(self._rows, row), max(self._columns, column)
        outside = self._rows > _LAST_ROW or self._columns > _LAST_COLUMN
        if outside or self._before + self._rows * self._columns > MOST_CELLS:
            self._end_sheet()
            self._refuse("at least ")
        self._add_text(text, f"the cells up to row {row}")

    def end(self) -> None:
        """Refuse sheets in which a reader would make very many empty cells, once all are counted."""
        self._end_sheet()
        if self._before > self.empty_cells + _EMPTY_PER_FILLED * self._filled:
            self._refuse()

    def _end_sheet(self) -> None:
        cells = self._rows * self._columns
        self._before += cells
        self._largest = max(self._largest, (cells, self._part, self._rows, self._columns))
        self._rows = self._columns = 0

    def _refuse(self, least: str = "") -> None:
        _, part, rows, columns = self._largest
        cells = f"{self.path}, {part}: its cells reach {least}row {rows} and column {columns}"
        if self._before > 2 * self._filled:
            raise LaserFormatError(
                f"{cells}, and most up to there are empty or repeated; delete the rows and columns beyond the table, not only what is "
                "in them, and save the file again"
            )
        raise LaserFormatError(
            f"{cells}, at most {MOST_CELLS / 1e6:.0f} million cells are read; save the sheet with the measured values alone"
        )

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
        they are packed in; the cells reach so far that the sheets would have more than 20 million, or far more empty than filled ones, as a
        reader makes them all; or the texts in the cells have more than 200 million characters.
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
        extent = Extent(path)
        looks = [_count_texts, _count_cells]
        if any(part.filename.lower().endswith(_XLSB_CONTENTS) for part in parts.infolist()):
            looks = [_count_texts, _count_binary_texts, _count_cells, _count_binary_cells]
        # The texts first: a cell names one by its number. Every part is looked at to its end: its name and its beginning tell nothing.
        for look in looks:
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
                    raise unreadable_spreadsheet(path, f"{each.filename}: {fault}") from None
        extent.end()
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


def _count_texts(extent: Extent, name: str, part: IO[bytes]) -> None:
    """Count the texts of a part of XML that holds those which cells share."""
    length, inside = 0, False
    for text, end in _pieces(part):
        begin = 0
        if not inside:
            opening = _TEXTS.search(text, 0, end) if b"sst" in text else None
            if opening is None:
                continue
            inside, begin = True, opening.end()
        for found in _TEXT_END.finditer(text, begin, end):
            extent.share(name, length + found.end() - begin)
            length, begin = 0, found.end()
        length += end - begin
    if inside:
        extent.share(name, length)


def _count_cells(extent: Extent, name: str, part: IO[bytes]) -> None:
    """Count the cells of the sheets in a part of XML. Cells that only have a format cost a reader nothing."""
    row = column = rows = 0
    inside = False
    for tag, attributes, content, length in _tags(part):
        if tag in (b"sheetData", b"table"):
            extent.begin(name)
            row, column, inside = 0, 0, True
        elif not inside:
            continue
        elif tag == b"row":
            place = _PLACE.search(attributes)
            row, column = (row + 1 if place is None else int(place[2][:30])), 0
        elif tag == b"c":
            place = _PLACE.search(attributes)
            # A cell without a place stands beside the one before it.
            column = column + 1 if place is None else _column_number(place[1][:10])
            row = row if place is None else int(place[2][:30])
            if not (attributes.endswith(b"/") or content.startswith(b"</")):
                extent.fill(row, column, _text_length(extent, attributes, content, length))
        elif tag == b"table-row":
            rows = _times(attributes)
            row, column = row + rows, 0
        else:
            times = _times(attributes)
            column += times
            alone = attributes.endswith(b"/")
            if b"office:" in attributes or not alone:
                text = len(attributes) * (b"office:string-value" in attributes) + length * (not alone)
                extent.fill(row, column, text * times * rows)


def _text_length(extent: Extent, attributes: bytes, content: bytes, length: int) -> int:
    """Return the length of the text in a cell of Office Open XML, with the XML around it; that of a number is 0."""
    if _SHARED.search(attributes):
        number = _NUMBER.search(content)
        return extent.shared(None if number is None else int(number[1]))
    return length if _OWN.search(attributes) or length > _LONGEST_NUMBER else 0


def _times(attributes: bytes) -> int:
    """Return how many rows or cells of OpenDocument one stands for."""
    repeated = _ODS_REPEATED.search(attributes)
    return 1 if repeated is None else int(repeated[1])


def _tags(part: IO[bytes]) -> Iterator[tuple[bytes, bytes, bytes, int]]:
    """Yield the tags of sheets, rows and cells: name, attributes, the beginning of what follows up to the next, and its length."""
    tag, attributes, content, length = b"", b"", b"", 0
    for text, end in _pieces(part):
        begin = 0
        for found in _TAG.finditer(text, 0, end):
            if tag:
                content += text[begin : min(found.start(), begin + _NEAR)]
                yield tag, attributes, content, length + found.start() - begin
            tag, attributes, content, length, begin = found[1], found[2], b"", 0, found.end()
        content = (content + text[begin : min(end, begin + _NEAR)])[:_NEAR]
        length += end - begin
    if tag:
        yield tag, attributes, content, length


def _pieces(xml: IO[bytes]) -> Iterator[tuple[bytes, int]]:
    """Yield pieces of XML, each with the place up to which its tags are whole: what follows the last bracket comes again."""
    xml = _in_utf8(xml)
    text = xml.read(_PIECE)
    while text:
        following = xml.read(_PIECE)
        end = text.rfind(b"<") if following else len(text)
        if end < 0 or len(text) - end > 2 * _PIECE:
            if _OPEN.match(text, max(end, 0)):
                raise ValueError(f"a tag of more than {2 * _PIECE / 1e6:.0f} million characters")
            end = len(text)
        yield text, end
        text = text[end:] + following


def _in_utf8(xml: IO[bytes]) -> IO[bytes]:
    """Return XML in UTF-8: that in UTF-16, with a mark or told by the zero in its first character, is decoded on its way."""
    start = xml.read(2)
    xml.seek(0)
    marked = start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    if not marked and (len(start) < 2 or 0 not in start):
        return xml
    name = "utf-16" if marked else "utf-16-le" if start[1] == 0 else "utf-16-be"
    return cast("IO[bytes]", codecs.EncodedFile(xml, "utf-8", name, "replace"))


def _count_binary_texts(extent: Extent, name: str, part: IO[bytes]) -> None:
    """Count the texts of a binary part that holds those which cells share."""
    inside = False
    for kind, payload in _records(part):
        inside = inside or kind == _XLSB_TEXTS
        if inside and kind == _XLSB_TEXT:
            extent.share(name, len(payload))


def _count_binary_cells(extent: Extent, name: str, part: IO[bytes]) -> None:
    """Count the cells of a binary sheet."""
    row, inside = 0, False
    for kind, payload in _records(part):
        if kind == _XLSB_SHEET:
            extent.begin(name)
            inside = True
        elif inside and kind == _XLSB_ROW:
            row = 1 + struct.unpack_from("<I", payload)[0]
        elif inside and kind in _XLSB_CELLS:
            shared = kind == _XLSB_SHARED
            length = extent.shared(struct.unpack_from("<I", payload, 8)[0]) if shared else len(payload)
            extent.fill(row, 1 + struct.unpack_from("<I", payload)[0], length)


def _records(part: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the records of a binary part; a length that is not true ends them.

    References
    ----------
    [MS-XLSB], 2.1.4: kind in one or two bytes, length in one to four, seven bits each.
    """
    content, place = part.read(), 0
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
