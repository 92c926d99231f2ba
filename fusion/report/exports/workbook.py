"""A workbook of a run: summary, ISO 230-2, profile and readings on one sheet each."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from openpyxl import Workbook
from openpyxl.cell import WriteOnlyCell
from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE
from openpyxl.styles import Font

from fusion.products.grouped import has
from fusion.products.results import Results
from fusion.report.exports.tables import iso230_axis_table, iso230_position_table, profile_table, readings_table
from fusion.report.terminal import summary_rows


def write_workbook(path: Path, results: Results, deviations: xr.Dataset) -> None:
    """Write the workbook.

    Parameters
    ----------
    path : Path
        The .xlsx file.
    results : Results
        Results of the run.
    deviations : Dataset
        Product ``deviations.nc``.

    Notes
    -----
    Texts are stored as texts whatever they begin with, so that a title from a file is never taken for a formula.
    """
    book = Workbook(write_only=True)
    findings = [("campaign", results.campaign), *summary_rows(results)]
    _add_sheet(book, "Summary", ("finding", "value"), findings, widths=(24, 110))
    for title, frame in (
        ("ISO 230-2 axis", iso230_axis_table(deviations)),
        ("ISO 230-2 positions", iso230_position_table(deviations, results)),
        *((("Profile", profile_table(deviations)),) if has(deviations, "drift") else ()),
        ("Readings", readings_table(deviations)),
    ):
        columns = [str(name) for name in frame.columns]
        _add_sheet(
            book, title, columns, frame.itertuples(index=False), widths=[max(12, len(name) + 2) for name in columns]
        )
    # On a full disk the library's own file would be closed with a traceback for every sheet.
    content = io.BytesIO()
    book.save(content)
    path.write_bytes(content.getvalue())


def _add_sheet(
    book: Workbook, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, widths: Sequence[int]
) -> None:
    """Add a sheet with a bold heading that stays in sight."""
    sheet = book.create_sheet(title)
    sheet.freeze_panes = "A2"
    for number, width in enumerate(widths):
        sheet.column_dimensions[chr(ord("A") + number)].width = width
    sheet.append([_cell(sheet, name, bold=True) for name in columns])
    for row in rows:
        sheet.append([_cell(sheet, value) for value in row])


def _cell(sheet: object, value: object, *, bold: bool = False) -> WriteOnlyCell:
    """Return a cell: a text as a text, a number as a number, a time without its zone (UTC), nothing where there is no number."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        value = None
    if isinstance(value, pd.Timestamp):
        value = None if pd.isna(value) else value.to_pydatetime(warn=False)
    cell = WriteOnlyCell(sheet)
    if isinstance(value, str):
        cell.value = ILLEGAL_CHARACTERS_RE.sub(" ", value)
        cell.data_type = "s"
    else:
        cell.value = value
    if bold:
        cell.font = Font(bold=True)
    return cell
