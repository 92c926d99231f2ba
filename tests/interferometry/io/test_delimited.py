"""Delimited text: header, delimiter, comments, and rows over time."""

from __future__ import annotations

from pathlib import Path

import pytest

from interferometry.io.delimited import delimiter_of, find_header, read_grids, read_table, read_timed_rows
from interferometry.io.faults import LaserFormatError


def written(folder: Path, text: str) -> Path:
    path = folder / "t.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_header_is_the_first_line_with_content() -> None:
    assert find_header(["", "# a comment", "time,value", "1,2"]) == (2, "time,value")
    assert find_header(["", "# a comment"]) == (0, "")


@pytest.mark.parametrize(("header", "delimiter"), [("a,b", ","), ("a;b,c;d", ";"), ("a\tb", "\t"), ("a", ",")])
def test_the_delimiter_is_the_most_frequent_one(header: str, delimiter: str) -> None:
    assert delimiter_of(header) == delimiter


def test_a_table_is_found_below_a_title_and_between_any_delimiters(tmp_path: Path) -> None:
    path = written(tmp_path, "Log of the machine\n\n# a comment\na|b\n0,64|2\n")
    table = read_table(path, ("a", "b"))
    assert list(table.records()) == [(5, {"a": "0,64", "b": "2"})]
    assert table.number("0,64") == 0.64


def test_a_missing_or_repeated_column_is_named_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(LaserFormatError, match=r"line 2: no column c; the header is 'a,b', expected 'a,c'"):
        read_table(written(tmp_path, "\na,b\n1,2\n"), ("a", "c"))
    with pytest.raises(LaserFormatError, match="line 1: column 'a' occurs more than once; keep one"):
        read_table(written(tmp_path, "a,a\n1,2\n"), ("a",))


def test_a_comment_of_any_length_is_passed_over_and_a_field_without_end_refused(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "#" + "x" * 200_000 + "\na,b\n1,2\n"), ("a", "b"))
    assert table.rows == [(3, ["1", "2"])]
    with pytest.raises(LaserFormatError, match=r"line 2: field larger than field limit .* damaged or no table"):
        read_table(written(tmp_path, "a,b\n1," + "x" * 200_000 + "\n"), ("a", "b"))


def test_timed_rows_are_sorted_and_repeated_times_left_out(tmp_path: Path) -> None:
    text = "time,value\n2026-03-09T06:31:00Z,2\n2026-03-09T06:30:00Z,1\n2026-03-09T06:30:00Z,9\n"
    table = read_table(written(tmp_path, text), ("time", "value"))
    series = read_timed_rows(table, {"value": {"units": "K"}}, lambda fields: [table.number(fields["value"])])
    assert series["value"].values.tolist() == [1.0, 2.0]
    assert series["value"].attrs["units"] == "K"
    assert '"line": 4' in series.attrs["left_out"]


def test_a_line_of_more_columns_than_a_sheet_has_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        LaserFormatError, match=r"t\.csv, line 2: more than 16384 columns, .* export it again with a line for each"
    ):
        read_grids(written(tmp_path, "time,x\n" + "1," * 100_000))
    (grid,) = read_grids(written(tmp_path, "x," * 16_383 + "x\n"))
    assert len(grid.rows[0][1]) == 16_384


@pytest.mark.parametrize("line", ["\n", "\r\n", ",\n", "#\n", "1\r"])
def test_a_million_lines_too_short_for_a_reading_are_refused_before_they_are_split(tmp_path, line):
    path = tmp_path / "laser.csv"
    path.write_bytes(b"cycle,direction,target\n" + 1_048_577 * line.encode())
    with pytest.raises(
        LaserFormatError, match=r"laser\.csv: 10485\d\d lines with nothing or fewer than 4 characters.*export it again"
    ):
        read_grids(path)


def test_any_line_ends_count_the_same_lines(tmp_path):
    path = tmp_path / "laser.csv"
    path.write_bytes(b"a,b\r\n\r\n1,2\r3,4\n\n5,6")
    assert read_grids(path)[0].rows == [(1, ["a", "b"]), (3, ["1", "2"]), (4, ["3", "4"]), (6, ["5", "6"])]
