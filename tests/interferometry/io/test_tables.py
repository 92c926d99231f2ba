"""Delimited text: header, delimiter, comments, dates, encodings, headings, and rows over time."""

from pathlib import Path

import numpy as np
import pytest

from interferometry.io.faults import BadReading, LaserFormatError
from interferometry.io.tables import (
    DateOrder,
    decode_text,
    describe_time_zone,
    find_direction,
    parse_time,
    read_grids,
    read_heading,
    read_table,
    read_timed_rows,
)
from thermofuse.units import UNITS


def written(folder: Path, text: str) -> Path:
    path = folder / "t.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_is_found_below_a_title_and_between_any_delimiters(tmp_path):
    path = written(tmp_path, "Log of the machine\n\n# a comment\na|b\n0,64|2\n")
    table = read_table(path, ("a", "b"))
    assert list(table.records()) == [(5, {"a": "0,64", "b": "2"})]
    assert table.numerals.number("0,64") == 0.64


def test_a_missing_or_repeated_column_is_named_with_its_line(tmp_path):
    with pytest.raises(LaserFormatError, match=r"line 2: no column c; the header is 'a,b', expected 'a,c'"):
        read_table(written(tmp_path, "\na,b\n1,2\n"), ("a", "c"))
    with pytest.raises(LaserFormatError, match="line 1: column 'a' occurs more than once; keep one"):
        read_table(written(tmp_path, "a,a\n1,2\n"), ("a",))


def test_a_comment_of_any_length_is_passed_over_and_a_field_without_end_refused(tmp_path):
    table = read_table(written(tmp_path, "#" + "x" * 200_000 + "\na,b\n1,2\n"), ("a", "b"))
    assert table.rows == [(3, ["1", "2"])]
    with pytest.raises(LaserFormatError, match=r"line 2: field larger than field limit \(131072\)"):
        read_table(written(tmp_path, "a,b\n1," + "x" * 200_000 + "\n"), ("a", "b"))


def test_timed_rows_are_sorted_and_repeated_times_left_out(tmp_path):
    text = "time,value\n2026-03-09T06:31:00Z,2\n2026-03-09T06:30:00Z,1\n2026-03-09T06:30:00Z,9\n"
    table = read_table(written(tmp_path, text), ("time", "value"))
    series = read_timed_rows(table, {"value": {"units": "K"}}, lambda fields: [table.numerals.number(fields["value"])])
    assert series["value"].values.tolist() == [1.0, 2.0]
    assert series["value"].attrs["units"] == "K"
    assert '"line": 4' in series.attrs["left_out"]


def test_a_line_of_more_columns_than_a_table_has_is_refused(tmp_path):
    with pytest.raises(LaserFormatError, match=r"t\.csv, line 2: more than 2000 columns; .* export it again with"):
        read_grids(written(tmp_path, "time,x\n" + "1," * 100_000))
    (grid,) = read_grids(written(tmp_path, "x," * 1_999 + "x\n"))
    assert len(grid.rows[0][1]) == 2_000


@pytest.mark.parametrize("line", ["\n", ",\n", "1\r"])
def test_a_million_lines_too_short_for_a_reading_are_refused_before_they_are_split(tmp_path, line):
    path = tmp_path / "laser.csv"
    path.write_bytes(b"cycle,direction,target\n" + 1_048_577 * line.encode())
    with pytest.raises(LaserFormatError, match=r"laser\.csv: 10485\d\d lines with nothing or fewer than 4"):
        read_grids(path)


def test_any_line_ends_count_the_same_lines(tmp_path):
    path = tmp_path / "laser.csv"
    path.write_bytes(b"a,b\r\n\r\n1,2\r3,4\n\n5,6")
    assert read_grids(path)[0].rows == [(1, ["a", "b"]), (3, ["1", "2"]), (4, ["3", "4"]), (6, ["5", "6"])]


PATH = Path("t.csv")


def test_times_of_every_spelling_become_utc_and_zones_are_not_mixed():
    assert parse_time("2026-03-09T06:30:05+01:00") == (np.datetime64("2026-03-09T05:30:05"), "+0100")
    assert parse_time("2026-03-09T06:30:05") == (np.datetime64("2026-03-09T06:30:05"), "")
    assert parse_time("9.3.2026 12:30:05 AM")[0] == np.datetime64("2026-03-09T00:30:05")
    assert parse_time("6:30:05 PM, 3/13/2026")[0] == np.datetime64("2026-03-13T18:30:05")
    assert parse_time("9.3.2026 6:30 pm")[0] == np.datetime64("2026-03-09T18:30:00")
    assert parse_time("9.3.2026 6:30:05,25")[0] == np.datetime64("2026-03-09T06:30:05.25")
    assert parse_time("9.3.2026 6:30:05 +02:00") == (np.datetime64("2026-03-09T04:30:05"), "+0200")
    assert describe_time_zone(PATH, {"+0000": 2}) == "UTC in the file"
    assert describe_time_zone(PATH, {"": 2}) == "no zone in the file: taken as UTC"
    assert describe_time_zone(PATH, {"+0200": 2, "+0100": 5}) == "converted to UTC from +0100, +0200"
    with pytest.raises(LaserFormatError, match=r"the time on line 7 has no zone, that on line 2 has \+0100"):
        describe_time_zone(PATH, {"+0100": 2, "": 7})


@pytest.mark.parametrize(
    "text",
    [
        "9.3.2026 6:30:05",
        "09.03.2026 06:30:05",
        "2026/03/09 06:30:05",
        "2026.3.9 6:30:05",
        "9 Mar 2026 06:30:05",
        "9-Mar-2026 06:30:05",
        "9. März 2026, 06:30:05",
        "Mar 9, 2026 6:30:05 AM",
        "9 mars 2026 06:30:05",
        "9 marzo 2026 06:30:05",
        "2026年3月9日 6:30:05",
    ],
)
def test_dates_of_plain_order_are_read(text):
    assert parse_time(text) == (np.datetime64("2026-03-09T06:30:05"), "")


@pytest.mark.parametrize(("decider", "expected"), [("13/3/2026 6:00", "2026-03-09"), ("3/13/2026 6:00", "2026-09-03")])
def test_one_date_beyond_the_twelfth_decides_for_the_file(decider, expected):
    order = DateOrder.of(PATH, [(2, "9/3/2026 6:30"), (3, decider)])
    assert parse_time("9/3/2026 6:30", order)[0] == np.datetime64(f"{expected}T06:30")


def test_dates_that_no_line_settles_are_refused_with_their_line():
    with pytest.raises(LaserFormatError, match=r"line 2: '9/3/2026 6:30' may be 2026-03-09 .* or 2026-09-03"):
        DateOrder.of(PATH, [(2, "9/3/2026 6:30"), (3, "3/3/2026 6:30")])
    with pytest.raises(LaserFormatError, match=r"'13/3/2026 6:00' on line 2 has the day first, '3/13/2026 6:00' on"):
        DateOrder.of(PATH, [(2, "13/3/2026 6:00"), (3, "3/13/2026 6:00")])
    # The third of March is the same in both orders.
    assert parse_time("3/3/2026 6:30", DateOrder.of(PATH, [(2, "3/3/2026 6:30")]))[0] == np.datetime64(
        "2026-03-03T06:30"
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("half past six", "is not an ISO 8601 time"),
        ("31.2.2026 06:30", "is not an ISO 8601 time"),
        ("9.3.2026 25:30", "is not an ISO 8601 time"),
        ("9.3.2026 13:30 PM", "is not an ISO 8601 time"),
        ("9 Foo 2026 06:30", "is not an ISO 8601 time"),
        ("9.3.126 06:30", "is not an ISO 8601 time"),
        ("0001-01-01T00:00+14:00", r"'0001-01-01T00:00\+14:00': is outside the years 1900 to 2199"),
        ("9/3/2026 6:30", "may be 2026-03-09 .* or 2026-09-03"),
    ],
)
def test_what_is_no_time_is_named(text, reason):
    with pytest.raises(BadReading, match=reason):
        parse_time(text)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252", "latin-1"])
def test_western_text_is_read_in_every_usual_encoding(encoding):
    text = "Zyklus;Abweichung [µm];Größe\n1;0,64;2\n"
    assert decode_text(PATH, text.encode(encoding)) == text


def test_code_pages_are_recognised_and_what_is_no_text_is_refused():
    text = "循环,方向,位置(mm),偏差(μm)\n"
    assert decode_text(PATH, text.encode("gb18030")) == text
    assert decode_text(PATH, b"a\x81b") == "a\x81b"
    with pytest.raises(LaserFormatError, match="character 3 is a zero byte, so the file is not text; save the table"):
        decode_text(PATH, b"ab\0c")
    with pytest.raises(LaserFormatError, match="is a picture, no table"):
        decode_text(PATH, b"\x89PNG\r\n\x1a\n\0\0")
    with pytest.raises(LaserFormatError, match=r"byte \d+ is not text in UTF-16, as which the file begins; it is"):
        decode_text(PATH, "abc".encode("utf-16") + b"\xd8")


@pytest.mark.parametrize(
    ("text", "role", "unit"),
    [
        ("deviation_um", "deviation", "um"),
        ("Positional Deviation (nm)", "deviation", "nm"),
        ("Abweichung [µm]", "deviation", "um"),
        ("Écart / μm", "deviation", "um"),
        ("ecart de position, um", "deviation", "um"),
        ("Desviación (µm)", "deviation", "um"),
        ("偏差（μm）", "deviation", "um"),
        ("Error in arcsec", "deviation", "arcsec"),
        ('Error (")', "deviation", "arcsec"),
        ("Sollposition / mm", "position", "mm"),
        ("Target [mm]", "position", "mm"),
        ("Target No.", "target", None),
        ("Pos (inch)", "position", "in"),
        ("Posición nominal [mm]", "position", "mm"),
        ("Ist-Position [mm]", "measured", "mm"),
        ("Datum/Uhrzeit", "time", None),
        ("Datum", "date", None),
        ("Anfahrrichtung", "direction", None),
        ("Sens d’approche", "direction", None),
        ("Zyklus-Nr.", "cycle", None),
        ("air pressure (Pa)", "air_pressure", "Pa"),
        ("Lufttemperatur [°C]", "air_temperature", "degC"),
        ("humidity (%)", "relative_humidity", "%"),
        ("spindle speed (1/min)", None, None),
    ],
)
def test_a_heading_gives_what_it_names_and_its_unit(text, role, unit):
    heading = read_heading(text)
    assert (heading.role, heading.unit and heading.unit.name) == (role, unit)


def test_units_have_their_exact_factors():
    assert (UNITS["nm"].factor, UNITS["in"].factor, UNITS["mil"].factor) == (1e-6, 25.4, 25.4e-3)
    assert UNITS["arcsec"].factor * 3600 == 1.0
    assert 68.0 * UNITS["degF"].factor + UNITS["degF"].offset == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("+", "+1", "Positive", "positiv", "正"), ("positive", True)),
        (("-", "−", "-1", "NEG", "négatif", "负"), ("negative", True)),
        (("forward", "Fwd", "vorwärts", "aller", "ida", "正向"), ("positive", False)),
        (("reverse", "Rückwärts", "retour", "vuelta", "反向"), ("negative", False)),
        (("sideways", "", "1"), None),
    ],
)
def test_words_for_the_directions(words, expected):
    assert [find_direction(word) for word in words] == [expected] * len(words)
