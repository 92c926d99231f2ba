"""Spreadsheets: sheets, merged cells, dates, and damaged files."""

from __future__ import annotations

import zipfile
from datetime import datetime, time
from pathlib import Path

import openpyxl
import pytest

from interferometry.io.faults import LaserFormatError
from interferometry.io.workbook import is_workbook, read_sheets

ODS = """<?xml version="1.0"?><office:document-content xmlns:office="urn:oasis:names:tc:opendocument:xmlns:office:1.0"
 xmlns:table="urn:oasis:names:tc:opendocument:xmlns:table:1.0" xmlns:text="urn:oasis:names:tc:opendocument:xmlns:text:1.0">
<office:body><office:spreadsheet><table:table table:name="X">{rows}</table:table></office:spreadsheet></office:body>
</office:document-content>"""

MANIFEST = """<?xml version="1.0"?><manifest:manifest xmlns:manifest="urn:oasis:names:tc:opendocument:xmlns:manifest:1.0">
<manifest:file-entry manifest:full-path="/" manifest:media-type="application/vnd.oasis.opendocument.spreadsheet"/>
</manifest:manifest>"""


def write_ods(path: Path, rows: list[list[str | float]]) -> Path:
    """A smallest ODS file, written by hand."""

    def cell(value: str | float) -> str:
        if isinstance(value, str):
            return f'<table:table-cell office:value-type="string"><text:p>{value}</text:p></table:table-cell>'
        return f'<table:table-cell office:value-type="float" office:value="{value}"/>'

    body = "".join(f"<table:table-row>{''.join(map(cell, row))}</table:table-row>" for row in rows)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        archive.writestr("META-INF/manifest.xml", MANIFEST)
        archive.writestr("content.xml", ODS.format(rows=body))
    return path


def test_merged_cells_dates_and_numbers_become_text(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Run 1", None, "Run 2"])
    sheet.merge_cells("A1:B1")
    sheet.append([1.0, 0.1, datetime(2026, 3, 9, 6, 30, 5)])
    sheet.append([time(6, 30, 5), "0,64", 123456789.125])
    path = tmp_path / "t.xlsx"
    book.save(path)
    assert read_sheets(path, path.read_bytes()) == {
        "Sheet": [
            (1, ["Run 1", "Run 1", "Run 2"]),
            (2, ["1", "0.1", "2026-03-09T06:30:05"]),
            (3, ["06:30:05", "0,64", "123456789.125"]),
        ]
    }


def test_hidden_and_empty_sheets_are_passed_over(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(["a"])
    book.create_sheet("hidden").append(["b"])
    book["hidden"].sheet_state = "hidden"
    book.create_sheet("empty")
    path = tmp_path / "t.xlsx"
    book.save(path)
    assert list(read_sheets(path, path.read_bytes())) == ["Sheet"]


def test_ods_is_read(tmp_path: Path) -> None:
    path = write_ods(tmp_path / "t.ods", [["Position [mm]", "1+ [um]"], [0, -0.5]])
    assert is_workbook(path.read_bytes())
    assert read_sheets(path, path.read_bytes()) == {"X": [(1, ["Position [mm]", "1+ [um]"]), (2, ["0", "-0.5"])]}


@pytest.mark.parametrize("content", [b"PK\x03\x04", b"PK\x03\x04" + bytes(200), b"\xd0\xcf\x11\xe0" + bytes(600)])
def test_damaged_spreadsheets_are_refused(content: bytes) -> None:
    with pytest.raises(LaserFormatError, match=r"cannot be read as a spreadsheet .* remove a password"):
        read_sheets(Path("t.xlsx"), content)


def test_a_workbook_without_a_value_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    openpyxl.Workbook().save(path)
    with pytest.raises(LaserFormatError, match="no visible sheet holds a value"):
        read_sheets(path, path.read_bytes())


def test_entities_of_xml_are_not_expanded(tmp_path: Path) -> None:
    """Ten levels of ten would be ten thousand million characters; a file outside must not be read either."""
    levels = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(10))
    kinds = (
        f'<!DOCTYPE x [<!ENTITY l0 "lol">{levels}]>',
        f'<!DOCTYPE x [<!ENTITY l10 SYSTEM "{Path(__file__).as_uri()}">]>',
    )
    for kind in kinds:
        path = write_ods(tmp_path / "laser.ods", [["value"]])
        with zipfile.ZipFile(path) as archive:
            parts = {name: archive.read(name).decode() for name in archive.namelist()}
        parts["content.xml"] = parts["content.xml"].replace("?><", f"?>{kind}<", 1).replace(">value<", ">&l10;<")
        with zipfile.ZipFile(path, "w") as archive:
            for name, text in parts.items():
                archive.writestr(name, text)
        try:
            sheets = read_sheets(path, path.read_bytes())
        except LaserFormatError:
            continue
        assert len(str(sheets)) < 200 and "Spreadsheets:" not in str(sheets)
