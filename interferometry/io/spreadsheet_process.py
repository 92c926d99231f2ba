"""Reads one spreadsheet within limits of memory and processor time; `interferometry.io.spreadsheets` runs it as a process."""

from __future__ import annotations

import datetime
import marshal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import python_calamine

Cell = bool | int | float | str
#: More than any workbook of readings has; what has more takes long to be found none.
MOST_SHEETS, MOST_COLUMNS = 1_000, 2_000
#: As many as spreadsheet programs write.
MOST_ROWS, MOST_CHARACTERS = 1_048_576, 32_767


def limit_resources(memory: int, seconds: int) -> None:
    """Limit memory (bytes) and processor time of this process where the platform can; a reader that is ended leaves no core dump."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def read_cells(path: str, as_stored: bool) -> dict[str, list[tuple[int, list[Cell]]]]:
    """Return the rows of each sheet that hold a value, with their numbers from 1; dates as ISO 8601."""
    sheets = {}
    with Path(path).open("rb") as file:
        workbook = python_calamine.CalamineWorkbook.from_filelike(file)
    if len(workbook.sheets_metadata) > MOST_SHEETS:
        raise MemoryError("more sheets than readings need")
    for each in workbook.sheets_metadata:
        if each.typ != python_calamine.SheetTypeEnum.WorkSheet:
            continue
        if as_stored or each.visible == python_calamine.SheetVisibleEnum.Visible:
            sheet = workbook.get_sheet_by_name(each.name)
            bottom, right = sheet.end or (0, 0)
            if bottom >= MOST_ROWS or right >= MOST_COLUMNS:
                raise MemoryError("more rows or columns than readings need")
            rows = [
                (number, [_marshallable(value) for value in row])
                for number, row in enumerate(sheet.to_python(skip_empty_area=False), start=1)
                if row.count("") < len(row)
            ]
            if rows:
                sheets[each.name] = rows if as_stored else _filled(rows, sheet)
    return sheets


def _filled(rows: list[tuple[int, list[Cell]]], sheet: python_calamine.CalamineSheet) -> list[tuple[int, list[Cell]]]:
    """Return rows in which every merged cell holds the value of its first one."""
    cells, width = dict(rows), len(rows[0][1])
    for (top, left), (bottom, right) in sheet.merged_cell_ranges or ():
        if bottom < rows[-1][0] and right < width and top + 1 in cells and cells[top + 1][left] != "":
            for number in range(top + 1, bottom + 2):
                cells.setdefault(number, [""] * width)[left : right + 1] = [cells[top + 1][left]] * (right + 1 - left)
    return sorted(cells.items())


def _marshallable(value: object) -> Cell:
    if isinstance(value, float | int):
        return value
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, datetime.timedelta):
        # An elapsed time counts its hours beyond a day.
        clock = str(datetime.datetime(1900, 1, 1) + value % datetime.timedelta(days=1))[11:]
        return f"{24 * value.days + int(clock[:2]):02d}{clock[2:]}"
    text = str(value).strip()
    if len(text) > MOST_CHARACTERS:
        raise MemoryError("more letters in a cell than spreadsheet programs write")
    return text


if __name__ == "__main__":
    limit_resources(int(sys.argv[3]), int(sys.argv[4]))
    try:
        answer: Any = read_cells(sys.argv[1], sys.argv[2] == "True")
    except MemoryError:
        sys.exit(1)
    # The reader is compiled: on damaged files it raises errors of several kinds, a panic among them, which is no Exception.
    except BaseException as fault:
        answer = str(fault)
    marshal.dump(answer, sys.stdout.buffer)
