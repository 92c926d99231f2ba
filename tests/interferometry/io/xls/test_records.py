"""Old spreadsheets whose cells, sizes, sheets and texts would end the process are refused; sound ones are read as they stand."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from interferometry.io.faults import LaserFormatError
from interferometry.io.workbook import read_sheets
from interferometry.io.xls import records as module
from interferometry.io.xls.compound_file import write_stream
from interferometry.io.xls.records import guarded_workbook, is_compound
from tests.interferometry.io.xls.old_workbooks import (
    CONTINUED,
    END,
    SHEET,
    TABLE,
    TEXTS,
    file_of,
    number,
    record,
    shared,
    shared_texts,
    sheet,
    size,
    workbook,
)

PATH = Path("old.xls")


def refused(content: bytes) -> str:
    with pytest.raises(LaserFormatError) as error:
        read_sheets(PATH, content)
    return str(error.value)


def test_a_sound_workbook_is_read_with_its_texts() -> None:
    texts = shared_texts("plain", "weit µ 漢字", "x" * 700)
    content = file_of(sheet(size(5, 3), *TABLE, shared(5, 0, 1), shared(5, 1, 2)), texts=texts)
    assert is_compound(content)
    rows = read_sheets(PATH, content)["s0"]
    assert [row for _, row in rows][1:3] == [["1", "1.1", "1.2"], ["2", "2.1", "2.2"]]
    assert rows[5] == (6, ["weit µ 漢字", "x" * 700, ""])


@pytest.mark.parametrize(("rows", "columns"), [(0xFFFFFFF0, 0xFFFF), (4_000_000, 256), (0, 0)])
def test_the_size_that_a_sheet_states_is_not_believed(rows: int, columns: int) -> None:
    """A reader would make room for it before the first cell."""
    assert len(read_sheets(PATH, file_of(sheet(size(rows, columns), *TABLE)))["s0"]) == 5


@pytest.mark.parametrize(
    ("far", "told"),
    [
        ([number(65_535, 255)], "sheet 1: its cells reach row 65536 and column 256, and most up to there are empty"),
        ([number(65_535, 65_535)], "sheet 1: its cells reach at least row 65536 and column 65536, and most"),
        (
            [record(0x00BD, struct.pack("<HH6xHIHH", 65_535, 0, 0, 0, 0, 65_535))],
            "sheet 1: its cells reach at least row 65536 and column 65536, and most",
        ),
    ],
)
def test_a_cell_far_from_the_table_is_refused(far: list[bytes], told: str) -> None:
    assert told in refused(file_of(sheet(*TABLE, *far)))


def test_a_stray_cell_in_the_last_row_is_read_where_that_costs_little() -> None:
    assert len(read_sheets(PATH, file_of(sheet(*TABLE, number(65_535, 15))))["s0"]) == 6
    assert "its cells reach row 65536 and column 20, and most" in refused(file_of(sheet(*TABLE, number(65_535, 19))))


def test_far_cells_of_several_sheets_add_up() -> None:
    assert "its cells reach at least row 65536 and column 256" in refused(
        file_of(*[sheet(*TABLE, number(65_535, 255))] * 2)
    )


def test_sheets_that_lie_over_one_another_or_are_very_many() -> None:
    content = sheet(*TABLE)
    told = refused(file_of(*[content] * 30, one_place=True))
    assert told == "old.xls: its sheets lie over one another, as no program writes them; save it again as XLSX"
    assert "holds 2001 sheets, at most 2000 are read" in refused(file_of(*[content] * 2_001, one_place=True))


def test_a_text_counts_as_often_as_cells_share_it() -> None:
    """30,000 cells of 8,000 characters: 240 million characters from 500 kB."""
    cells = [shared(row, column, 1) for row in range(10_000) for column in range(3)]
    texts = shared_texts("short", "x" * 8_000)
    assert "sheet 1: the cells up to row 8333 take more than 200 million characters" in refused(
        file_of(sheet(*cells), texts=texts)
    )
    assert len(read_sheets(PATH, file_of(sheet(*cells), texts=shared_texts("short", "other")))["s0"]) == 10_000


def test_texts_at_the_end_of_a_stream_count_too() -> None:
    """A reader does not miss the record that should end the part of the shared texts."""
    cells = b"".join(shared(row, column, 0) for row in range(1_500) for column in range(3))
    page = record(0x0809, struct.pack("<HHHHII", 0x600, 0x10, 0, 0, 0, 0)) + cells + record(END)
    begun = record(0x0809, struct.pack("<HHHHII", 0x600, 5, 0, 0, 0, 0))
    count = 7
    place = len(begun) + count * 14 + 4
    heads = b"".join(
        record(SHEET, struct.pack("<IBBBB", place + k * (len(page) + 4), 0, 0, 2, 0) + b"s%d" % k) for k in range(count)
    )
    hidden = b"".join(struct.pack("<HH", 0x1234, len(page)) + page for _ in range(count))
    stream = begun + heads + hidden + shared_texts("x" * 8_000)
    told = "take more than 200 million characters"
    for end in (record(END), b""):
        with pytest.raises(LaserFormatError, match=told):
            module._count(PATH, module.Extent(PATH), bytearray(stream + end))


def test_a_workbook_that_is_locked_says_so() -> None:
    """Behind the record of the password the cells are noise, and so are their places."""
    stream = record(0x0809, bytes(16)) + record(0x002F, bytes(54)) + record(END)
    assert refused(write_stream("Workbook", stream)) == (
        "old.xls: is locked with a password; remove it and save the file as XLSX"
    )


@pytest.mark.parametrize("name", ["WORKBOOK", "workbook", "BOOK"])
def test_the_name_of_the_stream_may_be_written_in_any_case(name: str) -> None:
    assert len(read_sheets(PATH, write_stream(name, workbook([sheet(*TABLE)])))["s0"]) == 5


def test_lengths_of_texts_are_found_in_formats_readings_and_parts() -> None:
    """A text with two formats and a phonetic reading, one parted between records with another width, and one behind them."""
    first = struct.pack("<HBHI", 3, 0x0C, 2, 5) + b"abc" + bytes(8) + bytes(5)
    begun = struct.pack("<HB", 6, 0x00) + b"de"
    parts = record(TEXTS, struct.pack("<II", 3, 3) + first + begun)
    parts += record(CONTINUED, b"\x01" + "µ漢字x".encode("utf-16-le") + struct.pack("<HB", 4, 0) + b"last")
    found = read_sheets(PATH, file_of(sheet(*(shared(0, text, text) for text in range(3))), texts=parts))
    assert found["s0"] == [(1, ["abc", "deµ漢字x", "last"])]

    lengths = []

    class Extent:
        def share(self, part: str, length: int) -> None:
            lengths.append(length)

    stream = bytearray(parts)
    pieces = [(begin, length) for _, begin, length in module._records(stream, 0)]
    module._share(Extent(), stream, pieces)  # type: ignore[arg-type]
    assert lengths == [3, 6, 4]


def test_a_number_of_texts_that_are_not_there_costs_nothing() -> None:
    lied = record(TEXTS, struct.pack("<II", 2**31, 2**31) + struct.pack("<HB", 1, 0) + b"a")
    content = file_of(sheet(*TABLE), texts=lied)
    assert guarded_workbook(PATH, content)[:8] == content[:8]


@pytest.mark.parametrize(
    ("stream", "told"),
    [
        (
            record(0x0809, bytes(16)) + struct.pack("<HH", 0x0203, 60_000),
            "the record at byte 20 of the workbook reaches",
        ),
        (workbook([sheet(record(0x0203, b"\x01"))])[:-4], "cannot be read as a spreadsheet"),
    ],
)
def test_a_record_that_does_not_hold_what_it_states(stream: bytes, told: str) -> None:
    assert told in refused(write_stream("Workbook", stream))


def test_a_file_that_is_too_large_or_no_workbook(monkeypatch: pytest.MonkeyPatch) -> None:
    told = refused(write_stream("EncryptedPackage", b"x" * 5000))
    assert told == (
        "old.xls: cannot be read as a spreadsheet (it holds no Workbook or Book); open it, remove a password if it has one, and save it "
        "again as XLSX"
    )
    monkeypatch.setattr(module, "_MOST_BYTES", 10_000)
    assert "has 0 MB, of an old spreadsheet at most 0 MB are read" in refused(file_of(sheet(*TABLE)))
