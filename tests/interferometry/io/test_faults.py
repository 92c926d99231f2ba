"""Numbers and marks for no reading, and when a whole file is refused because too many of its lines cannot be used."""

from pathlib import Path

import pytest

from interferometry.io.faults import (
    BadReading,
    LaserFormatError,
    Numerals,
    RejectedLine,
    parse_number,
    raise_if_mostly_invalid,
)

PATH = Path("t.csv")


def test_a_file_is_refused_when_fewer_than_half_of_its_lines_can_be_used():
    line = RejectedLine("t.csv", 3, "x", "is not a number")
    raise_if_mostly_invalid(PATH, 2, [line, line])
    with pytest.raises(LaserFormatError, match="2 of 3 lines cannot be used, the first is line 3: 'x' is not a number"):
        raise_if_mostly_invalid(PATH, 1, [line, line])
    with pytest.raises(LaserFormatError, match="no reading below the header"):
        raise_if_mostly_invalid(PATH, 0, [])


@pytest.mark.parametrize(
    ("others", "text", "value"),
    [
        ([], "0,64", 0.64),
        ([], "1.25e-3", 1.25e-3),
        ([], "−1.25", -1.25),
        ([], "1.234,5", 1234.5),
        ([], "1,234.5", 1234.5),
        ([], "1 234,5", 1234.5),
        ([], "1'234.5", 1234.5),
        (["0,64"], "1.000", 1000.0),
        (["0.64"], "1,000", 1000.0),
        (["0,64", "0.64"], "0.64", 0.64),
        (["0,64", "0.64"], "0,64", 0.64),
        (["09.03.2026"], "1.000", 1.0),
        (["0,64", "13.03.2026"], "1.200", 1200.0),
        (["0,64", "2.1.3", "192.168.0.1", "192.168.100"], "1.200", 1200.0),
        (["1.234,5", "13.03.2026"], "1.200", 1200.0),
        (["0.64", "13,03,2026"], "1,200", 1200.0),
        ([], "+.5", 0.5),
    ],
)
def test_the_whole_file_settles_the_decimal_separator(others, text, value):
    assert Numerals.of([*others, text]).number(text) == value


@pytest.mark.parametrize("text", ["1.200", "-12,345", "1.200.000"])
def test_what_parts_thousands_or_decimals_is_refused_where_the_file_has_both(text):
    """A day such as 12.03 beside decimal commas: 1.200 mm is one millimetre or a metre."""
    numerals = Numerals.of(["0,64", "12.03", text])
    with pytest.raises(BadReading, match=r"'0,64' and '12\.03'"):
        numerals.number(text)
    assert [numerals.number(sure) for sure in ("0,125", "12.03", "1.200,5", "1200")] == [0.125, 12.03, 1200.5, 1200.0]


@pytest.mark.parametrize("text", ["1_2.5", "", "-", "n/a", "1.2.3", "12..5", "0x10", "1,2,3"])
def test_what_is_no_number_is_not_read_as_one(text):
    with pytest.raises(BadReading, match="is not a number"):
        Numerals.of([text]).number(text)


@pytest.mark.parametrize("text", ["nan", "inf", "-1e20", "-100000000000000000000.000"])
def test_marks_for_no_reading_are_not_finite(text):
    with pytest.raises(BadReading, match="is not a finite number"):
        parse_number(text)


@pytest.mark.parametrize("text", ["9999", "-9999", "99999.999", "9999,0"])
def test_nothing_but_nines_is_no_reading(text):
    with pytest.raises(BadReading, match=r"consists of nines only, a mark for no reading"):
        Numerals().reading(text)


@pytest.mark.parametrize(("text", "value"), [("999", 999.0), ("9999.5", 9999.5), ("99.99", 99.99)])
def test_other_numbers_with_nines_are_readings(text, value):
    assert Numerals().reading(text) == value
