"""The workbook: numbers are numbers, times are times, and no text becomes a formula."""

from __future__ import annotations

import openpyxl
import pytest

from fusion.products.results import read_results
from fusion.products.store import read_dataset
from fusion.report.exports.workbook import write_workbook


def test_the_workbook_reads_back(small_run, tmp_path) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    results = read_results(small_run)
    write_workbook(tmp_path / "results.xlsx", results, deviations)
    book = openpyxl.load_workbook(tmp_path / "results.xlsx")
    assert book.sheetnames == ["Summary", "ISO 230-2 axis", "ISO 230-2 positions", "Profile", "Readings"]
    # The campaign is called =1+1.
    cell = book["Summary"]["B2"]
    assert (cell.data_type, cell.value.startswith("=1+1")) == ("s", True)
    assert not any(cell.data_type == "f" for sheet in book for row in sheet.iter_rows() for cell in row)
    names = [cell.value for cell in book["Readings"][1]]
    first = dict(zip(names, [cell.value for cell in book["Readings"][2]], strict=True))
    assert first["time_utc"].isoformat() == "2026-03-09T06:30:00"
    assert first["deviation_um"] == pytest.approx(float(deviations["deviation"][0, 0, 0]))
    assert book["Readings"].max_row == 1 + 192
