"""Sheets of spreadsheet files (.xlsx, .xlsm, .xlsb, .xls, .ods) as rows of text."""

from __future__ import annotations

import datetime
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, BinaryIO

import python_calamine

from interferometry.io.faults import LaserFormatError

#: Beginnings of spreadsheet files: a ZIP archive (.xlsx, .ods) and a compound file (.xls).
_MAGIC = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
#: A damaged file may claim millions of cells; no laser test has that many.
_MOST_CELLS = 20_000_000
#: Bytes that the parts of a spreadsheet may unpack to: that many cells take about 50 to 100 bytes of XML each.
_MOST_BYTES = 2_000_000_000
#: Above so many bytes, the most that a sheet of values is packed by: cells that repeat are packed by some tens, one byte alone by 1,000.
_LARGE_BYTES, _MOST_PACKED = 100_000_000, 200
#: Last row and column of a sheet (XFD1048576).
_LAST_ROW, _LAST_COLUMN = 1_048_576, 16_384
#: A row or a cell in the XML of a sheet, with its attributes, and the place among these, as in <c r="B7" s="1">.
_TAG = re.compile(rb"<(?:\w+:)?(row|c)(\s[^<>]*)?>")
_PLACE = re.compile(rb"\sr\s*=\s*[\"']([A-Za-z]*)(\d+)[\"']")
#: Bytes of XML that are searched at a time.
_PIECE = 1 << 20

Rows = list[tuple[int, list[str]]]


def is_workbook(start: bytes) -> bool:
    """Return whether a file is a spreadsheet.

    Parameters
    ----------
    start : bytes
        Its first four bytes or more.
    """
    return start.startswith(_MAGIC)


def read_sheets(path: Path, content: bytes) -> dict[str, Rows]:
    """Read every visible sheet of a spreadsheet.

    A merged cell fills all cells that it covers; dates are written in ISO 8601.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    content : bytes
        The whole file.

    Returns
    -------
    dict of str to list of (int, list of str)
        By name of the sheet: number of each row, from 1, and its cells.

    Raises
    ------
    LaserFormatError
        The file is damaged, locked with a password, or holds no sheet with a table.
    """
    refuse_bomb(path, io.BytesIO(content))
    try:
        workbook = python_calamine.CalamineWorkbook.from_filelike(io.BytesIO(content))
        visible = [
            sheet.name
            for sheet in workbook.sheets_metadata
            if sheet.visible == python_calamine.SheetVisibleEnum.Visible
            and sheet.typ == python_calamine.SheetTypeEnum.WorkSheet
        ]
        sheets = {name: _rows(path, name, workbook.get_sheet_by_name(name)) for name in visible}
    except LaserFormatError:
        raise
    # The reader is compiled: on damaged files it raises errors of several kinds, a panic among them, which is no Exception.
    except BaseException as fault:
        if isinstance(fault, KeyboardInterrupt | SystemExit):
            raise
        raise LaserFormatError(
            f"{path}: cannot be read as a spreadsheet ({fault}); open it, remove a password if it has one, and save it again as XLSX"
        ) from None
    filled = {name: rows for name, rows in sheets.items() if rows}
    if not filled:
        raise LaserFormatError(f"{path}: no visible sheet holds a value; export the measured values again")
    return filled


def refuse_bomb(path: Path, archive: BinaryIO) -> None:
    """Refuse a spreadsheet that would take more than memory holds: by the sizes that the archive states, and by the places of its cells.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    archive : file
        The spreadsheet, open for reading; its position is left at the beginning. What is no ZIP archive passes.

    Raises
    ------
    LaserFormatError
        The parts state more than 2 GB in all, or more than 100 MB and 200 times what they are packed in; or a cell lies so far
        from the others that the sheet between them would have more than 20 million cells: a reader makes them all.
    """
    try:
        with zipfile.ZipFile(archive) as parts:
            total = sum(part.file_size for part in parts.infolist())
            if total > _MOST_BYTES:
                raise LaserFormatError(
                    f"{path}: unpacks to {total / 1e9:.1f} GB, at most {_MOST_BYTES / 1e9:g} GB are read; "
                    "save the sheet with the measured values alone"
                )
            packed = sum(part.compress_size for part in parts.infolist())
            if total > max(_LARGE_BYTES, _MOST_PACKED * packed):
                raise LaserFormatError(
                    f"{path}: unpacks from {packed / 1e6:.1f} to {total / 1e6:.0f} MB, as no sheet of values does; "
                    "save the sheet with the measured values alone"
                )
            for part in parts.infolist():
                if part.filename.startswith("xl/") and part.filename.endswith(".xml"):
                    with parts.open(part) as sheet:
                        _refuse_far_cells(path, part.filename, sheet)
    except LaserFormatError:
        raise
    # What is damaged in the archive is told by the reader itself, which takes it apart more carefully.
    except (zipfile.BadZipFile, zlib.error, RuntimeError, ValueError, OverflowError, OSError, EOFError, struct.error):
        pass
    finally:
        archive.seek(0)


def _refuse_far_cells(path: Path, part: str, xml: IO[bytes]) -> None:
    """Refuse a sheet whose filled cells span more than may be read. Cells that only have a format cost a reader nothing."""
    row = column = rows = columns = 0
    for tag, attributes, is_empty in _tags(xml):
        place = _PLACE.search(attributes)
        if tag == b"row":
            row, column = (row + 1 if place is None else int(place[2][:30])), 0
            continue
        # A cell without a place stands beside the one before it.
        column = column + 1 if place is None else _column_number(place[1][:10])
        row = row if place is None else int(place[2][:30])
        if is_empty:
            continue
        rows, columns = max(rows, row), max(columns, column)
        if rows > _LAST_ROW or columns > _LAST_COLUMN or rows * columns > _MOST_CELLS:
            raise LaserFormatError(
                f"{path}, {part}: a cell in row {row} and column {column} lies far from the others; delete the cells that do not belong to "
                "the table, and save the file again"
            )


def _tags(xml: IO[bytes]) -> Iterator[tuple[bytes, bytes, bool]]:
    """Yield rows and cells of a sheet, their attributes, and whether nothing stands in them; of what is no sheet, nothing."""
    text = xml.read(_PIECE)
    if b"sheetData" not in text:
        return
    while text:
        following = xml.read(_PIECE)
        # What follows the last bracket is searched with the next piece.
        end = text.rfind(b"<") if following else len(text)
        for found in _TAG.finditer(text, 0, max(end, 0)):
            attributes = found[2] or b""
            yield found[1], attributes, attributes.endswith(b"/") or text.startswith(b"</", found.end())
        text = text[max(end, 0) :][-2 * _PIECE :] + following if following else b""


def _column_number(letters: bytes) -> int:
    """Return the number of a column: A is 1, Z 26, AA 27."""
    number = 0
    for letter in letters.upper():
        number = 26 * number + letter - ord("A") + 1
    return number


def _rows(path: Path, name: str, sheet: python_calamine.CalamineSheet) -> Rows:
    if sheet.total_height * sheet.total_width > _MOST_CELLS:
        raise LaserFormatError(
            f"{path}, sheet {name!r}: {sheet.total_height} x {sheet.total_width} cells; delete what is not the table, and save it again"
        )
    cells = [[_text(value) for value in row] for row in sheet.to_python(skip_empty_area=False)]
    for (top, left), (bottom, right) in sheet.merged_cell_ranges or ():
        if bottom >= len(cells) or right >= len(cells[top]):
            continue
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                cells[row][column] = cells[top][left]
    return [(number, row) for number, row in enumerate(cells, start=1) if any(row)]


def _text(value: object) -> str:
    """Return a cell as text that the readers of text understand: 17 digits, a decimal point, ISO 8601."""
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, datetime.timedelta):
        return str(datetime.datetime(1900, 1, 1) + value)[11:]
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return str(value).strip()
