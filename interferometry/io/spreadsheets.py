"""Sheets of spreadsheet files (.xlsx, .xlsm, .xlsb, .xls, .ods) as rows of cells.

A few kilobytes can stand for more cells than memory holds, and where memory ends, the compiled reader ends its process. It therefore runs
in one of its own, with limits on memory and time.
"""

from __future__ import annotations

import marshal
import subprocess
import sys
from pathlib import Path

from interferometry.io import spreadsheet_process
from interferometry.io.faults import LaserFormatError
from interferometry.io.spreadsheet_process import MOST_CHARACTERS, MOST_COLUMNS, MOST_ROWS, MOST_SHEETS, Cell

#: Beginning of a ZIP archive, which .xlsx and .ods are, and of a compound file, which .xls is.
_MAGIC = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
#: Memory of the process that reads, and its processor time; a sheet of ten million numbers takes about half of either.
MOST_BYTES, MOST_SECONDS = 2_000_000_000, 60
Rows = list[tuple[int, list[str]]]


def is_workbook(start: bytes) -> bool:
    """Return whether a file is a spreadsheet."""
    return start.startswith(_MAGIC)


def read_cells(path: Path, *, as_stored: bool = False) -> dict[str, list[tuple[int, list[Cell]]]]:
    """Read every visible sheet with its merged cells filled; as stored, hidden sheets too and merged cells as they are.

    Rows without a value are left out; those of a sheet are equally long.
    """
    arguments = map(str, (path, as_stored, MOST_BYTES, MOST_SECONDS))
    try:
        # Waiting is limited too: not every platform limits memory and processor time.
        process = subprocess.run(
            [sys.executable, "-P", spreadsheet_process.__file__, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            timeout=2 * MOST_SECONDS,
        )
    except subprocess.TimeoutExpired:
        process = None
    if process is None or process.returncode:
        raise LaserFormatError(
            f"{path}: cannot be read as a spreadsheet within {MOST_BYTES / 1e9:g} GB and {MOST_SECONDS} s, {MOST_SHEETS:,} sheets, "
            f"{MOST_ROWS:,} rows, {MOST_COLUMNS:,} columns and {MOST_CHARACTERS:,} characters in a cell; delete rows and columns beyond "
            "the table, not only what is in them, and save the sheet with the measured values alone as XLSX"
        )
    answer = marshal.loads(process.stdout)
    if isinstance(answer, str):
        raise LaserFormatError(
            f"{path}: cannot be read as a spreadsheet ({answer}); open it, remove a password if it has one, and save it again as XLSX"
        )
    if not answer:
        raise LaserFormatError(f"{path}: no visible sheet holds a value; export the measured values again")
    return answer


def read_sheets(path: Path) -> dict[str, Rows]:
    """Read every visible sheet of a spreadsheet as text."""
    return {
        name: [(line, [cell_text(cell) for cell in row]) for line, row in rows]
        for name, rows in read_cells(path).items()
    }


def cell_text(cell: Cell) -> str:
    """Return a cell as text that the readers of text understand: 17 digits and a decimal point."""
    if isinstance(cell, float):
        return repr(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    return str(cell)
