"""Delimited text: header, delimiter, numbers, times, and when a whole file is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from interferometry.io.delimited import (
    BadReading,
    LaserFormatError,
    RejectedLine,
    delimiter_of,
    describe_time_zone,
    find_header,
    parse_time,
    raise_if_mostly_invalid,
    read_table,
    read_timed_rows,
)

PATH = Path("t.csv")


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


def test_decimal_commas_belong_to_semicolons(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "a;b\n0,64;2\n"), ("a", "b"))
    assert table.number("0,64") == 0.64
    assert list(table.records()) == [(2, {"a": "0,64", "b": "2"})]
    commas = read_table(written(tmp_path, "a,b\n1,2\n"), ("a", "b"))
    with pytest.raises(BadReading, match="is not a number"):
        commas.number("0,64")


def test_numbers_are_finite_and_counts_are_whole(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "a,b\n1,2\n"), ("a",))
    assert (table.number(" 1e3 "), table.count("3")) == (1000.0, 3)
    for text in ("nan", "inf", "-1e20"):
        with pytest.raises(BadReading, match="is not a finite number"):
            table.number(text)
    for text in ("0", "1.5"):
        with pytest.raises(BadReading, match="is not a whole number from 1"):
            table.count(text)


def test_times_become_utc_and_keep_their_zone() -> None:
    assert parse_time("2026-03-09T06:30:05+01:00") == (np.datetime64("2026-03-09T05:30:05"), "+0100")
    assert parse_time("2026-03-09T06:30:05") == (np.datetime64("2026-03-09T06:30:05"), "")
    with pytest.raises(BadReading, match="is not an ISO 8601 time"):
        parse_time("9.3.2026 06:30")


def test_zones_are_described_and_must_not_be_mixed_with_none() -> None:
    assert describe_time_zone(PATH, {"+0000": 2}) == "UTC in the file"
    assert describe_time_zone(PATH, {"": 2}) == "no zone in the file: taken as UTC"
    assert describe_time_zone(PATH, {"+0200": 2, "+0100": 5}) == "converted to UTC from +0100, +0200"
    with pytest.raises(LaserFormatError, match=r"the time on line 7 has no zone, that on line 2 has \+0100"):
        describe_time_zone(PATH, {"+0100": 2, "": 7})


def test_a_file_is_refused_when_fewer_than_half_of_its_lines_can_be_used() -> None:
    line = RejectedLine("t.csv", 3, "x", "is not a number")
    raise_if_mostly_invalid(PATH, 2, [line, line])
    with pytest.raises(LaserFormatError, match="2 of 3 lines cannot be used, the first is line 3: 'x' is not a number"):
        raise_if_mostly_invalid(PATH, 1, [line, line])
    with pytest.raises(LaserFormatError, match="no reading below the header"):
        raise_if_mostly_invalid(PATH, 0, [])


def test_timed_rows_are_sorted_and_repeated_times_left_out(tmp_path: Path) -> None:
    text = "time,value\n2026-03-09T06:31:00Z,2\n2026-03-09T06:30:00Z,1\n2026-03-09T06:30:00Z,9\n"
    table = read_table(written(tmp_path, text), ("time", "value"))
    series = read_timed_rows(table, {"value": {"units": "K"}}, lambda fields: [table.number(fields["value"])])
    assert series["value"].values.tolist() == [1.0, 2.0]
    assert series["value"].attrs["units"] == "K"
    assert '"line": 4' in series.attrs["left_out"]
