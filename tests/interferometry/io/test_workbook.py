"""Spreadsheets: sheets, merged cells and dates; damaged and hostile files end the process that reads them, not this one."""

import resource
import struct
import zipfile
from collections.abc import Callable
from datetime import datetime, time, timedelta
from pathlib import Path

import openpyxl
import pytest

from interferometry.io import spreadsheet_process
from interferometry.io.faults import LaserFormatError
from interferometry.io.spreadsheets import is_workbook, read_cells, read_sheets
from tests.interferometry import old_workbooks as xls

pytestmark = pytest.mark.long

ODS = """<?xml version="1.0"?><office:document-content xmlns:office="urn:oasis:names:tc:opendocument:xmlns:office:1.0"
 xmlns:table="urn:oasis:names:tc:opendocument:xmlns:table:1.0" xmlns:text="urn:oasis:names:tc:opendocument:xmlns:text:1.0">
<office:body><office:spreadsheet><table:table table:name="X">{rows}</table:table></office:spreadsheet></office:body>
</office:document-content>"""
MANIFEST = """<?xml version="1.0"?><manifest:manifest xmlns:manifest="urn:oasis:names:tc:opendocument:xmlns:manifest:1.0">
<manifest:file-entry manifest:full-path="/" manifest:media-type="application/vnd.oasis.opendocument.spreadsheet"/>
</manifest:manifest>"""
SHEET = "xl/worksheets/sheet1.xml"
#: Sector of a small compound file that holds its directory.
DIRECTORY = 2
REPEATED = (
    '<table:table-row table:number-rows-repeated="{}"><table:table-cell table:number-columns-repeated="{}" office:value="1" '
    'office:value-type="float"><text:p>{}</text:p></table:table-cell></table:table-row>'
)


def write_ods(path: Path, rows: list[list[str | float]] | str) -> Path:
    """A smallest ODS file, written by hand."""

    def cell(value: str | float) -> str:
        if isinstance(value, str):
            return f'<table:table-cell office:value-type="string"><text:p>{value}</text:p></table:table-cell>'
        return f'<table:table-cell office:value-type="float" office:value="{value}"/>'

    if not isinstance(rows, str):
        rows = "".join(f"<table:table-row>{''.join(map(cell, row))}</table:table-row>" for row in rows)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        archive.writestr("META-INF/manifest.xml", MANIFEST)
        archive.writestr("content.xml", ODS.format(rows=rows))
    return path


def replace_part(path: Path, part: str, change: Callable[[str], str]) -> Path:
    """Write one part of an archive anew."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts[part] = change(parts[part].decode()).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


def write_xlsx(path: Path, *, rows: str = "", text: str = "x") -> Path:
    """A workbook with one text and further rows of XML."""
    book = openpyxl.Workbook()
    book.active.append([text])
    book.save(path)
    return replace_part(path, SHEET, lambda xml: xml.replace("</sheetData>", f"{rows}</sheetData>"))


def refused(path: Path) -> str:
    with pytest.raises(LaserFormatError) as error:
        read_sheets(path)
    assert str(error.value).startswith(f"{path}: cannot be read as a spreadsheet")
    return str(error.value)


def test_merged_cells_dates_and_numbers_become_text(tmp_path):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Run 1", None, "Run 2"])
    sheet.merge_cells("A1:B1")
    sheet.append([1.0, 0.1, datetime(2026, 3, 9, 6, 30, 5)])
    sheet.append([])
    sheet.append([time(6, 30, 5), "0,64", 123456789.125])
    sheet.append([timedelta(minutes=30), timedelta(hours=24, minutes=30), timedelta(hours=73, seconds=5)])
    path = tmp_path / "t.xlsx"
    book.save(path)
    assert read_sheets(path) == {
        "Sheet": [
            (1, ["Run 1", "Run 1", "Run 2"]),
            (2, ["1", "0.1", "2026-03-09T06:30:05"]),
            (4, ["06:30:05", "0,64", "123456789.125"]),
            (5, ["00:30:00", "24:30:00", "73:00:05"]),
        ]
    }
    assert read_cells(path, as_stored=True)["Sheet"][0] == (1, ["Run 1", "", "Run 2"])


def test_hidden_and_empty_sheets_are_passed_over(tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["a"])
    book.create_sheet("hidden").append(["b"])
    book["hidden"].sheet_state = "hidden"
    book.create_sheet("empty")
    path = tmp_path / "t.xlsx"
    book.save(path)
    assert list(read_sheets(path)) == ["Sheet"]
    assert list(read_cells(path, as_stored=True)) == ["Sheet", "hidden"]


def test_ods_is_read(tmp_path):
    path = write_ods(tmp_path / "t.ods", [["Position [mm]", "1+ [um]"], [0, -0.5]])
    assert is_workbook(path.read_bytes())
    assert read_sheets(path) == {"X": [(1, ["Position [mm]", "1+ [um]"]), (2, ["0", "-0.5"])]}


def test_an_old_workbook_is_read_with_its_texts(tmp_path):
    path = tmp_path / "old.xls"
    texts = xls.shared_texts("plain", "weit µ 漢字", "x" * 700)
    path.write_bytes(xls.file_of(xls.sheet(*xls.TABLE, xls.shared(5, 0, 1), xls.shared(5, 1, 2)), texts=texts))
    assert is_workbook(path.read_bytes())
    rows = read_sheets(path)["s0"]
    assert [row for _, row in rows][1:3] == [["1", "1.1", "1.2"], ["2", "2.1", "2.2"]]
    assert rows[5] == (6, ["weit µ 漢字", "x" * 700, ""])


def test_stray_cells_far_from_the_table_cost_no_memory_here(tmp_path):
    path = write_xlsx(tmp_path / "t.xlsx", rows='<row r="100000"><c r="C100000"><v>7</v></c></row>')
    assert read_sheets(path) == {"Sheet": [(1, ["x", "", ""]), (100_000, ["", "", "7"])]}


@pytest.mark.parametrize("content", [b"PK\x03\x04", b"PK\x03\x04" + bytes(200), b"\xd0\xcf\x11\xe0" + bytes(600)])
def test_damaged_spreadsheets_are_refused(tmp_path, content):
    path = tmp_path / "t.xlsx"
    path.write_bytes(content)
    assert "remove a password" in refused(path)


def test_a_workbook_without_a_value_is_refused(tmp_path):
    path = tmp_path / "t.xlsx"
    openpyxl.Workbook().save(path)
    with pytest.raises(LaserFormatError, match="no visible sheet holds a value"):
        read_sheets(path)


def far_xlsx(path: Path) -> None:
    write_xlsx(path, rows='<row r="1048576"><c r="XFD1048576"><v>1</v></c></row>')


def number_beyond_any_row(path: Path) -> None:
    write_xlsx(path, rows='<row><c r="A1999999999999999999"><v>1</v></c></row>')


def packed_zeros(path: Path) -> None:
    replace_part(write_xlsx(path), SHEET, lambda xml: xml + "<!--" + "1" * 100_000_000)


def repeated_cells(path: Path) -> None:
    write_ods(path, REPEATED.format(1_000_000, 16_000, 1))


def repeated_text(path: Path) -> None:
    text = REPEATED.replace("float", "string").replace('office:value="1"', "")
    write_ods(path, text.format(1_000, 1_000, "x" * 3_000))


def far_old_cell(path: Path) -> None:
    path.write_bytes(xls.file_of(xls.sheet(*xls.TABLE, xls.number(65_535, 65_535))))


def stated_size(path: Path) -> None:
    path.write_bytes(xls.file_of(xls.sheet(xls.size(0xFFFFFFF0, 0xFFFF), *xls.TABLE)))


def chain_without_an_end(path: Path) -> None:
    content = bytearray(xls.file_of(xls.sheet(*xls.TABLE)))
    struct.pack_into("<I", content, len(content) - xls.SECTOR + 4 * DIRECTORY, DIRECTORY)
    path.write_bytes(content)


def many_cells_in_a_row(path: Path) -> None:
    write_ods(path, REPEATED.format(1, 2_001, 1))


def many_rows(path: Path) -> None:
    write_xlsx(path, rows="<row><c><v>1</v></c></row>" * 1_048_576)


def long_text(path: Path) -> None:
    write_ods(path, [["x" * 32_768]])


def many_sheets(path: Path) -> None:
    more = "".join(f'<table:table table:name="{number}"></table:table>' for number in range(1_000))
    replace_part(
        write_ods(path, []),
        "content.xml",
        lambda xml: xml.replace("</office:spreadsheet>", f"{more}</office:spreadsheet>"),
    )


@pytest.mark.parametrize(
    "hostile",
    [
        many_cells_in_a_row,
        many_rows,
        long_text,
        many_sheets,
        far_xlsx,
        number_beyond_any_row,
        packed_zeros,
        repeated_cells,
        repeated_text,
        far_old_cell,
        stated_size,
        chain_without_an_end,
    ],
)
def test_hostile_files_are_refused_within_limits(tmp_path, hostile, monkeypatch):
    """Each would take gigabytes of memory or hours."""
    path = tmp_path / "hostile.xlsx"
    hostile(path)
    monkeypatch.setattr("interferometry.io.spreadsheets.MOST_BYTES", 400_000_000)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    refused(path)
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 15.0


def test_entities_of_xml_are_not_expanded(tmp_path):
    """Ten levels of ten would be ten thousand million characters; a file outside must not be read either."""
    levels = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(10))
    for entities in (f'<!ENTITY l0 "lol">{levels}', f'<!ENTITY l10 SYSTEM "{Path(__file__).as_uri()}">'):
        path = write_ods(tmp_path / "laser.ods", [])
        with_entities = ODS.format(rows=REPEATED.format(1, 1, "&l10;")).replace(
            "?><", f"?><!DOCTYPE x [{entities}]><", 1
        )
        replace_part(path, "content.xml", lambda _, xml=with_entities: xml)
        try:
            sheets = read_sheets(path)
        except LaserFormatError:
            continue
        assert len(str(sheets)) < 200 and "Spreadsheets:" not in str(sheets)


def test_a_reader_that_does_not_end_is_ended(tmp_path, monkeypatch):
    """Platforms without limits of memory and processor time have this one."""
    endless = tmp_path / "endless.py"
    endless.write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setattr(spreadsheet_process, "__file__", str(endless))
    monkeypatch.setattr("interferometry.io.spreadsheets.MOST_SECONDS", 0.1)
    assert "within 2 GB and 0.1 s" in refused(write_xlsx(tmp_path / "t.xlsx"))
