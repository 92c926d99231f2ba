"""Spreadsheets that would take more than memory holds are refused while they are still small."""

from __future__ import annotations

import copy
import io
import struct
import zipfile
from pathlib import Path

import openpyxl
import pytest

from interferometry.io.faults import LaserFormatError
from interferometry.io.workbook import read_sheets
from interferometry.io.workbook_limits import refuse_bomb
from tests.interferometry.io.test_workbook import ODS, write_ods


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
    with pytest.raises(LaserFormatError) as error:
        read_sheets(path, sheet_of(path, rows, part=part))
    assert str(error.value) == (
        f"{path}, {part}: its cells reach at least {told}, and most up to there are empty or repeated; delete the rows and columns "
        "beyond the table, not only what is in them, and save the file again"
    )


def test_a_stray_cell_far_below_the_table_is_read_where_that_costs_little(tmp_path: Path) -> None:
    rows = "".join(f'<row r="{row}">{f"<c><v>{row}</v></c>" * 7}</row>' for row in range(1, 5001))
    stray = '<row r="{0}"><c r="G{0}" t="inlineStr"><is><t> </t></is></c></row>'
    path = tmp_path / "laser.xlsx"
    refuse_bomb(path, io.BytesIO(sheet_of(path, rows + stray.format(700_000))))
    # The far cell is named wherever it stands, not the one that was counted last.
    for order in (rows + stray.format(1_000_000), stray.format(1_000_000) + rows):
        assert refused(path, sheet_of(path, order)).startswith(
            ", xl/worksheets/sheet1.xml: its cells reach row 1000000 and column 7, and most up to there are empty or repeated; delete"
        )


@pytest.mark.parametrize("before", [" " * 3_000_000, "<i/>" * 800_000, f"<i k='{'>' * 500_000}'/>", "x"])
@pytest.mark.parametrize("prefix", ["", "a-b:"])
def test_a_sheet_is_found_wherever_it_begins_in_its_part(tmp_path: Path, before: str, prefix: str) -> None:
    path = tmp_path / "laser.xlsx"
    far = f"<{prefix}c k='>' r='XFD1048576'><v>1</v></{prefix}c>"
    content = archive_of(path, sheet1=f"{before}<worksheet>{before}<{prefix}sheetData>{before}{far}")
    assert ", xl/sheet1.xml: its cells reach at least row 1048576 and column 16384, and most" in refused(path, content)
    text = f"<{prefix}si><t>{'A' * 1_000_000}</t></{prefix}si >"
    shared = '<c t="s"><v>0</v></c>'
    cells = f"<sheetData>{shared * 300}</sheetData>"
    content = archive_of(path, sheet1=cells, texts=f"{before}<{prefix}sst>{text}")
    assert "take more than 200 million characters" in refused(path, content)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_xml_in_utf_16_is_counted_like_other_xml(tmp_path: Path, encoding: str) -> None:
    """The reader of records takes it: a far cell in five kilobytes would fill 4 GB."""
    path = tmp_path / "laser.xlsx"

    def written(rows: str) -> io.BytesIO:
        text = f'<?xml version="1.0" encoding="UTF-16"?><worksheet><sheetData>{rows}</sheetData></worksheet>'
        return io.BytesIO(archive_of(path, **{"xl/worksheets/sheet1.xml": text.encode(encoding)}))

    near = '<row r="1"><c r="A1" t="str"><v>Größe 漢字</v></c></row>'
    refuse_bomb(path, written(near))
    with pytest.raises(LaserFormatError, match="its cells reach at least row 1048576 and column 16384"):
        refuse_bomb(path, written(near + '<row r="1048576"><c r="XFD1048576"><v>1</v></c></row>'))


def test_a_tag_that_does_not_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "laser.xlsx"
    content = archive_of(path, sheet1=f"<sheetData><c {' ' * 5_000_000}r='XFD1048576'><v>1</v></c></sheetData>")
    assert "(xl/sheet1.xml: a tag of more than 2 million characters)" in refused(path, content)


@pytest.mark.parametrize("kind", ['t="inlineStr"><is><t>{}</t></is>', 't="str"><v>{}</v>', "><is><t>{}</t></is>"])
@pytest.mark.parametrize("length", [300, 3_000_000])
def test_texts_in_the_cells_themselves_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, length: int
) -> None:
    path = tmp_path / "laser.xlsx"
    rows = "".join(f'<row r="{row}"><c {kind.format("A" * length)}</c></row>' for row in range(1, 11))
    monkeypatch.setattr("interferometry.io.workbook_limits._MOST_TEXT", 10 * (length + 100))
    refuse_bomb(path, io.BytesIO(sheet_of(path, rows)))
    monkeypatch.setattr("interferometry.io.workbook_limits._MOST_TEXT", 9 * length)
    assert refused(path, sheet_of(path, rows)).startswith(", xl/worksheets/sheet1.xml: the cells up to row 9 take more")
    numbers = "".join(f'<row r="{row}"><c><v>1.2345678901234567</v></c></row>' for row in range(1, length // 10))
    monkeypatch.setattr("interferometry.io.workbook_limits._MOST_TEXT", 100)
    if length == 300:
        refuse_bomb(path, io.BytesIO(sheet_of(path, numbers)))


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
    monkeypatch.setattr("interferometry.io.workbook_limits._PIECE", 64)
    path = tmp_path / "laser.xlsx"
    near = "".join(f'<row r="{row}"><c r="A{row}" s="12"><v>{row}</v></c></row>' for row in range(1, 60))
    refuse_bomb(path, io.BytesIO(sheet_of(path, near)))
    for shift in range(40):
        far = f'{near}<row r="60">{" " * shift}<c r="XFD1048576" s="12"><v>1</v></c></row>'
        with pytest.raises(LaserFormatError, match="its cells reach at least row 1048576 and column 16384"):
            refuse_bomb(path, io.BytesIO(sheet_of(path, far)))


def archive_of(path: Path, **parts: str | bytes) -> bytes:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(f"xl/{name}.xml", content)
    return path.read_bytes()


def refused(path: Path, content: bytes) -> str:
    with pytest.raises(LaserFormatError) as error:
        read_sheets(path, content)
    return str(error.value).removeprefix(f"{path}")


def test_two_cells_in_opposite_corners_do_not_make_millions(tmp_path: Path) -> None:
    far = '<row r="1"><c r="A1"><v>1</v></c></row><row r="1048576"><c r="S1048576"><v>1</v></c></row>'
    told = refused(tmp_path / "a.xlsx", sheet_of(tmp_path / "a.xlsx", far))
    assert "its cells reach row 1048576 and column 19, and most up to there are empty" in told
    # A million empty cells are nothing, in one sheet; in many sheets they are.
    near = far.replace("S1048576", "A1000000").replace("1048576", "1000000")
    sheet = f"<worksheet><sheetData>{near}</sheetData></worksheet>"
    one = archive_of(tmp_path / "b.xlsx", sheet1=sheet)
    refuse_bomb(tmp_path / "b.xlsx", io.BytesIO(one))
    many = archive_of(tmp_path / "b.xlsx", **{f"sheet{k}": sheet for k in range(1, 7)})
    assert ": its cells reach row 1000000 and column 1, and most" in refused(tmp_path / "b.xlsx", many)


@pytest.mark.parametrize("close", ["</si>", "</x:si>"])
def test_a_text_counts_as_often_as_cells_share_it(tmp_path: Path, close: str) -> None:
    path = tmp_path / "laser.xlsx"
    opening = close.replace("/", "")
    strings = f"<sst>{opening}<t>short</t>{close}{opening}<t>{'A' * 1_000_000}</t>{close}</sst>"

    def cells(number: int | str, rows: int) -> str:
        each = "".join(f'<row><c r="A{k}" t="s"><v>{number}</v></c></row>' for k in range(1, rows + 1))
        return f"<worksheet><sheetData>{each}</sheetData></worksheet>"

    refuse_bomb(path, io.BytesIO(archive_of(path, sheet1=cells(0, 300), sharedStrings=strings)))
    for number in (1, 7, "?"):
        content = archive_of(path, sheet1=cells(number, 300), sharedStrings=strings)
        assert refused(path, content).startswith(
            ", xl/sheet1.xml: the cells up to row 199 take more than 200 million characters"
        )


def test_texts_alone_that_no_sheet_of_values_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("interferometry.io.workbook_limits._MOST_TEXT", 1000)
    path = tmp_path / "laser.xlsx"
    content = archive_of(path, sharedStrings=f"<sst>{'<si><t>0123456789</t></si>' * 60}</sst>")
    assert refused(path, content).startswith(", xl/sharedStrings.xml: 39 texts of cells take more than 0 million")
    content = archive_of(path, sharedStrings=f"<sst><si><t>{'0' * 1000}")
    assert refused(path, content).startswith(", xl/sharedStrings.xml: 1 texts of cells take")


def test_merged_cells_over_one_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, book = tmp_path / "t.xlsx", openpyxl.Workbook()
    book.active.append(["a", "b", "c"])
    book.active.merge_cells("A1:B1")
    book.save(path)
    read_sheets(path, path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    merged = b'<mergeCell ref="A1:B1"/>'
    name = next(name for name in parts if merged in parts[name])
    parts[name] = parts[name].replace(merged, 60 * merged)
    with zipfile.ZipFile(path, "w") as archive:
        for part, content in parts.items():
            archive.writestr(part, content)
    monkeypatch.setattr("interferometry.io.workbook.MOST_CELLS", 100)
    assert refused(path, path.read_bytes()) == (
        ", sheet 'Sheet': its merged cells lie over one another; save it again without them"
    )


def test_rows_and_cells_of_open_document_count_as_often_as_they_repeat(tmp_path: Path) -> None:
    path = write_ods(tmp_path / "laser.ods", [["value"]])
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}

    def written(rows: str) -> bytes:
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in parts.items():
                archive.writestr(name, ODS.format(rows=rows) if name == "content.xml" else content)
        return path.read_bytes()

    cell = '<table:table-cell office:value="1" office:value-type="float"{}><text:p>1</text:p></table:table-cell>'
    row = "<table:table-row{}>{}</table:table-row>"
    columns, rows = (f' table:number-{name}-repeated="{{}}"' for name in ("columns", "rows"))
    empty = f"<table:table-cell{columns.format(16_000)}/>"
    # Programs end a sheet with empty rows and cells up to the last.
    tail = row.format(rows.format(1_000_000), empty)
    sheets = read_sheets(path, written(row.format(rows.format(2), cell.format(columns.format(3)) + empty) + tail))
    assert sheets == {"X": [(1, ["1"] * 3), (2, ["1"] * 3)]}
    bare = f'<table:table-cell office:value="1"{columns.format(1_000)}/>'
    for bomb, place in [
        (row.format("", cell.format(columns.format(20_000))), "at least row 1 and column 20000"),
        (row.format(rows.format(6_000), bare), "row 6000 and column 1000"),
        (tail + row.format("", empty + cell.format("")), "at least row 1000001 and column 16001"),
        (row.format("", f"{'<table:table-cell/>' * 16_384}{cell.format('')}"), "at least row 1 and column 16385"),
    ]:
        assert refused(path, written(bomb)).startswith(f", content.xml: its cells reach {place}")
    # Formats that a program lists before the tables.
    styles = f"<office:automatic-styles>{'<style:style/>' * 100_000}</office:automatic-styles>"
    parts["content.xml"] = ODS.format(rows=row.format("", cell.format(columns.format(20_000)))).replace(
        "<office:body>", f"{styles}<office:body>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    assert "its cells reach at least row 1 and column 20000" in refused(path, path.read_bytes())
    long = cell.format(columns.format(1_000)).replace(">1<", f">{'1' * 3_000}<")
    attribute = f'<table:table-cell office:string-value="{3_000 * str(1)}"{columns.format(1_000)}/>'
    for text in (long, attribute):
        assert "take more than 200 million characters" in refused(path, written(row.format(rows.format(100), text)))


def binary_sheet(path: Path, *cells: tuple[int, int], before: bytes = b"") -> bytes:
    """A sheet of [MS-XLSB] with a number in every cell."""

    def record(kind: int, payload: bytes = b"") -> bytes:
        return (bytes([kind]) if kind < 128 else bytes([kind & 127 | 128, kind >> 7])) + bytes([len(payload)]) + payload

    content = before + record(129) + record(145)
    for row, column in cells:
        content += record(0, struct.pack("<I", row) + bytes(21)) + record(5, struct.pack("<IId", column, 0, 1.0))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/_rels/workbook.bin.rels", "<Relationships/>")
        archive.writestr("xl/worksheets/sheet1.bin", content + record(146) + record(130))
    return path.read_bytes()


def test_cells_of_a_binary_sheet_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "laser.xlsb"
    refuse_bomb(path, io.BytesIO(binary_sheet(path, (0, 0), (9, 200))))
    # A sheet may begin with any record, one that looks like XML among them.
    for before in (b"", b"\x3c\x00", b"\x25\x01x" * 500_000):
        told = refused(path, binary_sheet(path, (0, 0), (1_048_575, 0), (1_048_575, 16_383), before=before))
        assert told.startswith(", xl/worksheets/sheet1.bin: its cells reach at least row 1048576 and column 16384, and")


def test_an_archive_is_refused_by_its_table_of_contents(tmp_path: Path) -> None:
    path = tmp_path / "laser.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        for k in range(2_001):
            archive.writestr(f"xl/sheet{k}.xml", b"")
    assert refused(path, path.read_bytes()).startswith(": holds 2001 sheets and other parts, at most 2000; save")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/sheet1.xml", bytes(range(250)) * 4)
        one = archive.getinfo("xl/sheet1.xml")
        for k in range(2, 9):
            archive.filelist.append(copy.copy(one))
            archive.filelist[-1].filename = f"xl/sheet{k}.xml"
    assert refused(path, path.read_bytes()).startswith(": its parts lie over one another, as no program writes them")


def test_a_part_that_cannot_be_looked_at_is_not_given_to_the_reader(tmp_path: Path) -> None:
    """A name in the directory that differs from that at the part stops one program and not another."""
    path = tmp_path / "t.xlsx"
    book = openpyxl.Workbook()
    book.active.append(["a"])
    book.save(path)
    content = path.read_bytes()
    first = content.index(b"xl/worksheets/sheet1.xml")
    changed = content[:first] + b"xl/worksheets/sheet9.xml" + content[first + 24 :]
    assert refused(path, changed).startswith(
        ": cannot be read as a spreadsheet (xl/worksheets/sheet1.xml: File name in"
    )
