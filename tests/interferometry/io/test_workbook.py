"""Spreadsheets: sheets, merged cells, dates, and damaged files."""

from __future__ import annotations

import io
import struct
import zipfile
from datetime import datetime, time
from pathlib import Path

import openpyxl
import pytest

from interferometry.io.faults import LaserFormatError
from interferometry.io.workbook import is_workbook, read_sheets, refuse_bomb

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


def test_a_bomb_is_refused_by_the_size_that_it_states(tmp_path: Path) -> None:
    """The size is read from the table of contents of the archive; nothing is unpacked."""
    path = tmp_path / "laser.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/sharedStrings.xml", b"0" * 1000)
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\x01\x02")
    struct.pack_into("<I", content, entry + 24, 3_000_000_000)
    with pytest.raises(LaserFormatError) as error:
        read_sheets(path, bytes(content))
    assert (
        str(error.value)
        == f"{path}: unpacks to 3.0 GB, at most 2 GB are read; save the sheet with the measured values alone"
    )


def test_a_small_bomb_is_refused_by_how_much_it_is_packed(tmp_path: Path) -> None:
    path = tmp_path / "laser.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b"1" * 150_000_000)
    with pytest.raises(
        LaserFormatError, match=r"laser\.xlsx: unpacks from 0\.1 to 150 MB, as no sheet of values does; save the sheet"
    ):
        read_sheets(path, path.read_bytes())


def sheet_of(path: Path, rows: str, *, part: str = "xl/worksheets/sheet1.xml") -> bytes:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(part, f"<worksheet><sheetData>{rows}</sheetData></worksheet>")
    return path.read_bytes()


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ('<row r="1"><c r="A1"/><c s="1" r="XFD1048576"><v>1</v></c></row>', "row 1048576 and column 16384"),
        ('<row r="1"><c r="nanA1"><v>1</v></c></row>', "row 1 and column 247105"),
        ('<row r="1"><c r="A1999999999999999999"><v>1</v></c></row>', "row 1999999999999999999 and column 1"),
        (f'<row r="1000000">{"<c><v>1</v></c>" * 300}</row>', "row 1000000 and column 21"),
    ],
)
@pytest.mark.parametrize("part", ["xl/worksheets/sheet1.xml", "xl/sheets/s1.xml"])
def test_a_cell_far_from_the_table_is_refused_before_memory_is_taken(
    tmp_path: Path, rows: str, told: str, part: str
) -> None:
    path = tmp_path / "laser.xlsx"
    with pytest.raises(LaserFormatError, match=rf"{part}: a cell in {told} lies far from the others; delete the cells"):
        read_sheets(path, sheet_of(path, rows, part=part))


def test_cells_that_only_have_a_format_are_no_table(tmp_path: Path) -> None:
    """Spreadsheet programs keep the format of cells that were emptied, up to the last row and column."""
    rows = (
        '<row r="2"><c r="B2"><v>1.5</v></c><c r="XFD2" s="1"/></row><row r="1048576"><c r="A1048576" s="1"></c></row>'
    )
    path = tmp_path / "laser.xlsx"
    refuse_bomb(path, io.BytesIO(sheet_of(path, rows)))


def test_cells_are_found_across_the_pieces_in_which_a_sheet_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("interferometry.io.workbook._PIECE", 64)
    path = tmp_path / "laser.xlsx"
    near = "".join(f'<row r="{row}"><c r="A{row}" s="12"><v>{row}</v></c></row>' for row in range(1, 60))
    refuse_bomb(path, io.BytesIO(sheet_of(path, near)))
    for shift in range(40):
        far = f'{near}<row r="60">{" " * shift}<c r="XFD1048576" s="12"><v>1</v></c></row>'
        with pytest.raises(LaserFormatError, match="row 1048576 and column 16384"):
            refuse_bomb(path, io.BytesIO(sheet_of(path, far)))


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
