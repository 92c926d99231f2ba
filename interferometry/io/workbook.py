"""Sheets of spreadsheet files (.xlsx, .xlsm, .xlsb, .xls, .ods) as rows of text."""

from __future__ import annotations

import datetime
import io
from pathlib import Path

import python_calamine

from interferometry.io.faults import LaserFormatError, unreadable_spreadsheet
from interferometry.io.workbook_limits import MOST_CELLS, refuse_bomb
from interferometry.io.xls.records import guarded_workbook, is_compound

#: Beginning of a ZIP archive, which .xlsx and .ods are.
_ZIP = b"PK\x03\x04"
Rows = list[tuple[int, list[str]]]


def is_workbook(start: bytes) -> bool:
    """Return whether a file is a spreadsheet.

    Parameters
    ----------
    start : bytes
        Its first four bytes or more.
    """
    return start.startswith(_ZIP) or is_compound(start)


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
    if is_compound(content):
        content = guarded_workbook(path, content)
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
        raise unreadable_spreadsheet(path, fault) from None
    filled = {name: rows for name, rows in sheets.items() if rows}
    if not filled:
        raise LaserFormatError(f"{path}: no visible sheet holds a value; export the measured values again")
    return filled


def _rows(path: Path, name: str, sheet: python_calamine.CalamineSheet) -> Rows:
    if sheet.total_height * sheet.total_width > MOST_CELLS:
        raise LaserFormatError(
            f"{path}, sheet {name!r}: {sheet.total_height} x {sheet.total_width} cells; delete what is not the table, and save it again"
        )
    cells = [[_text(value) for value in row] for row in sheet.to_python(skip_empty_area=False)]
    covered = 0
    for (top, left), (bottom, right) in sheet.merged_cell_ranges or ():
        covered += (bottom - top + 1) * (right - left + 1)
        if covered > MOST_CELLS:
            raise LaserFormatError(
                f"{path}, sheet {name!r}: its merged cells lie over one another; save it again without them"
            )
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
