"""Delimited text and sheets as rows of fields, and tables whose columns are found by their names."""

from __future__ import annotations

import codecs
import csv
import json
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime
from functools import cached_property, lru_cache
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from interferometry.io.faults import (
    BadReading,
    LaserFormatError,
    LeftOut,
    Numerals,
    RejectedLine,
    raise_if_mostly_invalid,
)
from interferometry.io.spreadsheet_process import MOST_COLUMNS, MOST_ROWS
from interferometry.io.spreadsheets import is_workbook, read_sheets
from thermofuse.resources import vocabulary
from thermofuse.units import SHARE, Unit, find_unit

#: Words of tables: headings, directions, units, months.
_VOCABULARY = vocabulary("headings")

# Dates and times of a whole file: ISO 8601 and the usual other orders, refused where the file does not settle the
# order; times of day and elapsed times.

#: Earlier times are no dates, but count from a start that is not stated.
DATED = np.datetime64("1980-01-01", "ns")
#: Attribute ``reference`` of times from a file that gives no zone.
NO_ZONE = "no zone in the file: taken as UTC"
#: How PNG, JPEG, GIF and TIFF begin.
_PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\0", b"MM\0*")
#: Years of measurements, and from which programs count; others are damage, and the first and last years of the calendar have no UTC.
_YEARS = (1900, 2199)

_MONTHS = {name: month for month, names in enumerate(_VOCABULARY["months"], start=1) for name in names}
#: Zones by their short names, as +hhmm, and such a name in a heading, of UTC with hours and minutes.
_ZONES: Mapping[str, str] = vocabulary("logs")["zones"]
_NAMES_OF_ZONES = "|".join(_ZONES)
_IN_ZONE = re.compile(rf"(?<![^\W_])({_NAMES_OF_ZONES})(?:\s*([+-]\d\d?)(?::?(\d\d))?)?(?![^\W_])")
_ZONE = rf"(?P<zone>Z|(?:{_NAMES_OF_ZONES})?[+-]\d\d(?::?\d\d)?|{_NAMES_OF_ZONES})?"
#: Behind the seconds; three digits behind a colon are milliseconds.
_FRACTION = r"(?:(?:[.,]|:(?=\d{3}(?!\d)))(?P<fraction>\d{1,9}))?"
_HALF = r"\s*(?P<half>[AaPp]\.?\s?[Mm]\.?)?"
_CLOCK = rf"(?P<hour>\d{{1,2}}):(?P<minute>\d{{2}})(?::(?P<second>\d{{2}}){_FRACTION})?{_HALF}\s*{_ZONE}"
_NUMERIC = re.compile(
    rf"(?P<a>\d{{4}}|\d{{1,2}})\s*(?P<mark>[./-])\s*(?P<b>\d{{1,2}})\s*[./-]\s*(?P<c>\d{{4}}|\d{{1,2}})\.?[,T\s-]+{_CLOCK}"
)
_NAMED = re.compile(
    rf"(?P<a>\d{{1,2}}|[^\W\d]+)[.\s-]+(?P<b>\d{{1,2}}|[^\W\d]+)[.,\s-]+(?P<c>\d{{4}}|\d{{2}})[,T\s-]+{_CLOCK}"
)
_CHINESE = re.compile(rf"(?P<a>\d{{4}})年(?P<b>\d{{1,2}})月(?P<c>\d{{1,2}})日\s*{_CLOCK}")
#: A time of day before its date.
_CLOCK_FIRST = re.compile(r"(\d{1,2}:\d\d(?::\d\d(?:[.,]\d+)?)?(?:\s*[AaPp]\.?[Mm]\.?)?),?\s+(\d{1,4}\s*[./-].*\d)")
#: A time of day or an elapsed one, with days before it.
_OF_DAY = (
    r"^(?:(?P<days>\d{1,4})(?:[.:](?=\d\d:\d\d:\d\d)|\s*d(?:ays?)?,?\s*))?(?P<hour>\d{1,5}):(?P<minute>[0-5]\d)(?::(?P<second>[0-5]\d))?"
    rf"{_FRACTION}{_HALF}$"
)
#: Places of year, month and day in a date of numbers.
_ORDERS = {"day first": (2, 1, 0), "month first": (2, 0, 1), "year first": (0, 1, 2)}


@dataclass(frozen=True)
class DateOrder:
    """What stands first in the dates of a file, see `_ORDERS`; empty where no date settles it."""

    first: str = ""

    @classmethod
    def of(cls, path: Path, lines: Iterable[tuple[int, str]]) -> DateOrder:
        """Find the order from all dates of a file: one number beyond 12 decides."""
        orders = dict.fromkeys(_ORDERS, (0, ""))
        open_question: tuple[int, str] | None = None
        for line, text in lines:
            possible = possible_dates(text)
            if len({*possible.values()}) > 1:
                open_question = open_question or (line, text)
            left = [order for order in orders if order in possible or not possible]
            if not left:
                (before, (first_line, first)), now = next(iter(orders.items())), next(iter(possible))
                raise LaserFormatError(
                    f"{path}: the date {first!r} on line {first_line} has the {before.split()[0]} first, {text!r} on line {line} the "
                    f"{now.split()[0]}; write all dates as 2026-03-09"
                )
            orders = orders if len(left) == len(orders) else dict.fromkeys(left, (line, text))
        if open_question is not None and len(orders) > 1:
            line, text = open_question
            raise LaserFormatError(
                f"{path}, line {line}: {text!r} may be {_either(possible_dates(text))}, and no date of the file resolves it; write the "
                "dates as 2026-03-09"
            )
        return cls(next(iter(orders)) if len(orders) == 1 else "")


def possible_dates(text: str) -> dict[str, date]:
    """Return the dates that a text may mean, by the order of its numbers; none where a year of four digits is first.

    With dots the day is first, or the year where that is the later date: 26.03.09.
    """
    if text[:4].isdecimal():
        return {}
    match = _NUMERIC.fullmatch(_date_first(text))
    if match is None or len(match["a"]) == 4:
        return {}
    numbers, found = (match["a"], match["b"], match["c"]), dict[str, date]()
    for order, (year, month, day) in _ORDERS.items():
        with suppress(ValueError):
            found[order] = date(_year(numbers[year]), int(numbers[month]), int(numbers[day]))
    if match["mark"] == ".":
        found.pop("month first", None)
        if len(found) > 1 and found["year first"] < found["day first"]:
            del found["year first"]
    return found


def _date_first(text: str) -> str:
    """Return a time with its date before its time of day, without spaces around it."""
    stripped = text.strip()
    match = _CLOCK_FIRST.fullmatch(stripped)
    return f"{match[2]} {match[1]}" if match else stripped


def _either(possible: Mapping[str, date]) -> str:
    """Return the dates that a text may mean, in words."""
    return " or ".join(f"{day} ({order})" for order, day in possible.items())


def closest_orders(texts: Iterable[str]) -> list[str]:
    """Return the orders in which the dates of a file are closest together; one alone where the test goes over a midnight."""
    dates = list(filter(None, map(possible_dates, texts)))
    possible = [order for order in _ORDERS if dates and all(order in each for each in dates)]
    spans = {order: max(each[order] for each in dates) - min(each[order] for each in dates) for order in possible}
    return [order for order, span in spans.items() if span == min(spans.values())]


def _year(text: str) -> int:
    """Return a year; one of two digits is one of 1969 to 2068, as POSIX has it."""
    if len(text) not in (2, 4):
        raise ValueError
    return int(text) + (0 if len(text) == 4 else 1900 if int(text) > 68 else 2000)


def parse_time(text: str, order: DateOrder | None = None) -> tuple[np.datetime64, str]:
    """Return a time in UTC (without a zone it is taken as UTC) and its zone as +hhmm, "" where the text has none; raises `BadReading`."""
    stripped = _date_first(text)
    try:
        stamp = datetime.fromisoformat(stripped)
    except ValueError:
        stamp = _other_order(text, stripped, order or DateOrder())
    if not _YEARS[0] <= stamp.year <= _YEARS[1]:
        raise BadReading(text, f"is outside the years {_YEARS[0]} to {_YEARS[1]}")
    if stamp.tzinfo is None:
        return np.datetime64(stamp, "ns"), ""
    zone = "+0000" if stamp.tzinfo is UTC else stamp.strftime("%z")
    return np.datetime64(stamp.astimezone(UTC).replace(tzinfo=None), "ns"), zone


def _other_order(text: str, stripped: str, order: DateOrder) -> datetime:
    match = _NUMERIC.fullmatch(stripped) or _CHINESE.fullmatch(stripped) or _NAMED.fullmatch(stripped)
    wrong = BadReading(text, "is not an ISO 8601 time such as 2026-03-09T06:30:05+00:00")
    if match is None:
        raise wrong
    day, hour = _date(match, order, wrong, text), int(match["hour"])
    if match["half"]:
        if not 1 <= hour <= 12:
            raise wrong
        hour = hour % 12 + (12 if match["half"][0] in "Pp" else 0)
    fraction = (match["fraction"] or "").ljust(6, "0")[:6]
    zone = zone_of(match["zone"] or "") or (match["zone"] or "")
    try:
        return datetime.fromisoformat(f"{day}T{hour:02d}:{match['minute']}:{match['second'] or '00'}.{fraction}{zone}")
    except ValueError:
        raise wrong from None


def _date(match: re.Match[str], order: DateOrder, wrong: BadReading, text: str) -> date:
    """Return the date of a time."""
    a, b, c = match["a"], match["b"], match["c"]
    possible = possible_dates(text) if match.re is _NUMERIC else {}
    if len({*possible.values()}) > 1 and not order.first:
        raise BadReading(text, f"may be {_either(possible)}; write the date as 2026-03-09")
    try:
        if match.re is _NAMED:
            name, day = (b, a) if a.isdecimal() else (a, b)
            return date(_year(c), _MONTHS[name.casefold()], int(day))
        if len(a) == 4:
            return date(int(a), int(b), int(c))
        return possible[order.first or next(iter(possible), "")]
    except (KeyError, ValueError):
        raise wrong from None


def zone_of(text: str) -> str:
    """Return the zone that a text such as "Date Time, GMT+02:00" or "Time (CEST)" names, as +hhmm; empty where it names none.

    >>> zone_of("Date Time, GMT+2"), zone_of("Timestamp [UTC]"), zone_of("Time (CEST)"), zone_of("Time (s)")
    ('+0200', '+0000', '+0200', '')
    """
    if (match := _IN_ZONE.search(text)) is None:
        return ""
    return f"{match[2][0]}{match[2][1:]:>02}{match[3] or '00'}" if match[2] else _ZONES[match[1]]


def elapsed_s(texts: Iterable[str], *, of_minutes: bool = False) -> NDArray[np.floating]:
    """Return times of day since the first midnight, or elapsed times, s, NaN for other texts; two numbers begin with hours, or minutes.

    >>> elapsed_s(["49:15:00", "2.01:15:00"]), elapsed_s(["11:58 p. m.", "0:03", "-"]), elapsed_s(["59:30", "00:00.5"], of_minutes=True)
    (array([177300., 177300.]), array([86280., 86580.,    nan]), array([3570. , 3600.5]))
    """
    parts = pd.Series(list(texts), dtype=object).str.strip().str.extract(_OF_DAY)
    half, fraction = parts["half"].str[0].str.lower(), ("0." + parts["fraction"]).astype(float)
    days, hour, minute, second = (parts[name].astype(float) for name in ("days", "hour", "minute", "second"))
    hour = hour.where(half.isna(), hour % 12 + 12 * (half == "p"))
    # Of hours nobody writes tenths.
    if second.isna().all() and (of_minutes or fraction.notna().any()):
        return counted_on((60 * hour + minute + fraction.fillna(0)).to_numpy(), 3600.0)
    seconds = 86400 * days.fillna(0) + 3600 * hour + 60 * minute + second.fillna(0) + fraction.fillna(0)
    return counted_on(seconds.to_numpy(), 86400.0)


def counted_on(counts: NDArray[np.floating], period: float) -> NDArray[np.floating]:
    """Return counts that begin again after a period, as a time of day at midnight does, as if they counted on; NaN stays."""
    on, finite = counts.copy(), np.isfinite(counts)
    if finite.any() and counts[finite].max() < period:
        on[finite] += period * np.cumsum(np.diff(counts[finite], prepend=-np.inf) < -period / 2)
    return on


def describe_time_zone(path: Path, zones: dict[str, int]) -> str:
    """Return how the times of a file were converted to UTC, in words."""
    if "" in zones and len(zones) > 1:
        other = next(zone for zone in zones if zone)
        raise LaserFormatError(
            f"{path}: the time on line {zones['']} has no zone, that on line {zones[other]} has {other}; write all of them with a zone"
        )
    if "" in zones:
        return NO_ZONE
    if set(zones) == {"+0000"}:
        return "UTC in the file"
    return "converted to UTC from " + ", ".join(sorted(zones))


# Headings of columns: what they name, in five languages, and the unit that they carry.


#: What a cell says of the row or column of units.
UNIT_WORDS = frozenset(_VOCABULARY["unit_words"])
_BRACKETS = re.compile(r"\s*[(\[（【{]\s*([^()\[\]（）【】{}]*?)\s*[)\]）】}]\s*")
_MARK = r"(.*\S)\s*(?:/|,|;|\sin\s|_|\s)\s*"
_AFTER_MARK = (re.compile(rf"{_MARK}({re.sub('[?]P<[a-z]+>', '?:', SHARE.pattern)}\S+)"), re.compile(rf"{_MARK}(\S+)"))
#: Kinds of units that a test and its conditions have.
_OF_TESTS = ("length", "angle", "temperature", "pressure")
#: End of a name that makes a share of the unit behind it, as in "1/8 um".
_SHARE = re.compile(r"\d[/.,^]-?\d+$")


@dataclass(frozen=True)
class Heading:
    """A heading as it was understood: its role, None where the words are not known, its unit."""

    text: str
    role: str | None
    unit: Unit | None


def fold(text: str) -> str:
    """Return a text for comparison: lower case, without accents, dots, underscores and surplus spaces."""
    plain = "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))
    return re.sub(r"[\s_.:;,/\\#’'–-]+", " ", plain.replace("º", "o").replace("№", "no")).strip()


#: A number, or a time by ISO 8601, which is no heading: a file has a million of them.
PLAIN_VALUE = re.compile(r"[+-]?\d[\d\s.,:+TZeE-]*")


@lru_cache(1 << 16)
def read_heading(text: str) -> Heading:
    """Return what a heading such as "Abweichung [µm]" or "Écart / µm" names, and the unit that it carries."""
    if PLAIN_VALUE.fullmatch(text):
        return Heading(text, None, None)
    name, unit = split_unit(text)
    role = _ROLES.get(fold(name).replace(" ", ""))
    if role == "target" and unit is not None:
        # "Target [mm]" is the position of a target and not its number.
        role = "position"
    return Heading(text, role, unit)


def unit_of_test(text: str) -> Unit | None:
    """Return the unit of a length, an angle or a condition that a text names; of one letter in any case."""
    plain = text.strip("[]() ")
    unit = find_unit(plain) or (find_unit(plain.upper()) if len(plain) == 1 else None)
    return unit if unit is not None and (unit.kind in _OF_TESTS or unit.name == "%") else None


def split_unit(text: str) -> tuple[str, Unit | None]:
    """Split a heading into name and unit."""
    for match in _BRACKETS.finditer(text):
        if (unit := unit_of_test(match[1])) is not None:
            return f"{text[: match.start()]} {text[match.end() :]}".strip(), unit
    for pattern in _AFTER_MARK:
        found = pattern.fullmatch(text.strip())
        if found is not None and (unit := unit_of_test(found[2])) is not None:
            name = re.sub(r"(\s+in|\s*[/,;])$", "", found[1])
            if _SHARE.search(name) or unit_of_test(name.split()[-1]) is not None:
                break
            return name, unit
    return text.strip(), None


@lru_cache(1 << 10)
def find_direction(text: str) -> tuple[str, bool] | None:
    """Return the direction of approach that a word names."""
    signs = text.strip().replace("−", "-").replace("–", "-").replace("＋", "+").replace("－", "-")
    return _DIRECTIONS.get(_key(signs))


def is_direction_letter(word: str) -> bool:
    """Return whether a word is a letter that names a direction where the other one of its pair does."""
    return word.casefold() in _LETTERS


def by_direction_letter(letters: Collection[str]) -> dict[str, str]:
    """Return the word for the direction of each letter, where two letters are a pair; nothing else."""
    pairs = [pair for pair in _VOCABULARY["direction_letters"] if {*map(str.casefold, letters)} == {*pair}]
    return {letter: ("forward", "reverse")[pairs[0].index(letter.casefold())] for letter in letters if pairs}


def _key(word: str) -> str:
    return word if word in _SIGNS else fold(word)


_SIGNS = ("+", "-", "+1", "-1", "↑", "↓", "→", "←")
_LETTERS = frozenset("".join(_VOCABULARY["direction_letters"]))
_ROLES = {fold(word).replace(" ", ""): role for role, words in _VOCABULARY["headings"].items() for word in words}
_DIRECTIONS = {_key(word): (one["name"], one["signed"]) for one in _VOCABULARY["direction"] for word in one["words"]}
#: By these, text in the Chinese code page is recognised.
CHINESE_WORDS = tuple(
    word for words in _VOCABULARY["headings"].values() for word in words if len(word) > 1 and word > "\u4e00"
)


# Bytes of a text file to text: UTF-8, UTF-16, the code page of Western Windows, and those of Chinese and Japanese Windows.

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


def encoding_of(content: bytes) -> str | None:
    """Return the encoding that the beginning of a text shows: its mark, or zeros in every other byte; None where nothing does."""
    return next((name for mark, name in _MARKS if content.startswith(mark)), None) or _unmarked_utf16(content)


def decode_text(path: Path, content: bytes) -> str:
    """Return the text of a file without byte-order mark, whatever a spreadsheet program of the last thirty years saved it as.

    >>> decode_text(Path("a.csv"), "Abweichung [µm]".encode("cp1252"))
    'Abweichung [µm]'
    """
    encoding = encoding_of(content)
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as fault:
        if encoding is not None:
            raise LaserFormatError(
                f"{path}: byte {fault.start} is not text in {encoding.upper()}, as which the file begins; it is damaged, copy it again"
            ) from None
        text = _in_a_code_page(content)
    if content.startswith(_PICTURES):
        raise LaserFormatError(
            f"{path}: is a picture, no table; export its values as CSV, or remove it from the folder"
        )
    place = text.find("\0")
    if place >= 0:
        raise LaserFormatError(
            f"{path}: character {place + 1} is a zero byte, so the file is not text; save the table as CSV in UTF-8 or as XLSX"
        )
    return text


def _unmarked_utf16(content: bytes) -> str | None:
    """Return the byte order of UTF-16 without a mark: every other byte of Western text is zero there."""
    start = content[:400]
    if len(start) < 16:
        return None
    even, odd = start[0::2].count(0), start[1::2].count(0)
    if odd > 0.4 * len(start) / 2 and even == 0:
        return "utf-16-le"
    return "utf-16-be" if even > 0.4 * len(start) / 2 and odd == 0 else None


def _in_a_code_page(content: bytes) -> str:
    try:
        chinese = content.decode("gb18030")
    except UnicodeDecodeError:
        chinese = ""
    # Every Western text can be read as Chinese too: headings of tables tell them apart.
    if any(word in chinese for word in CHINESE_WORDS):
        return chinese
    with suppress(UnicodeDecodeError):
        japanese = content.decode("cp932")
        if any(word in japanese for word in _VOCABULARY["japanese"]):
            return japanese
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError:
        # Five bytes have no meaning in the code page; Latin-1 gives every byte one.
        return content.decode("latin-1")


#: Marks that may stand between fields.
DELIMITERS = ";\t,|"
#: A line with a reading has more characters; a text with more shorter lines than a spreadsheet has rows is damaged, and takes long to
#: be found so.
_SHORT_LINE = 4
#: Longest part of a line of the file that a message repeats, characters.
_SHOWN = 160


@dataclass(frozen=True)
class Grid:
    """Rows of fields with their numbers from 1, without empty ones and comments; ``sheet`` is "" for a text file.

    ``title`` stands above the rows, of a sheet it is its name.
    """

    path: Path
    sheet: str
    rows: list[tuple[int, list[str]]]
    title: str = ""

    @property
    def place(self) -> str:
        """File and sheet, as messages name them."""
        return f"{self.path}, sheet {self.sheet!r}" if self.sheet else str(self.path)

    @cached_property
    def numerals(self) -> Numerals:
        """How the numbers of the grid are written."""
        return Numerals.of_columns(zip_longest(*(fields for _, fields in self.rows), fillvalue=""))


@dataclass(frozen=True)
class DelimitedTable:
    """A table: its column names, and its rows with the numbers of their lines."""

    path: Path
    columns: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    numerals: Numerals = field(default_factory=Numerals)

    def records(self) -> Iterator[tuple[int, dict[str, str] | None]]:
        """Yield line number and fields by column name; None where the number of fields is wrong."""
        for line, fields in self.rows:
            yield line, dict(zip(self.columns, fields, strict=True)) if len(fields) == len(self.columns) else None


def read_grids(path: Path, *, sheet: str | None = None) -> list[Grid]:
    """Read a file of text or a spreadsheet as rows of fields."""
    content = path.read_bytes()
    if is_workbook(content):
        sheets = read_sheets(path)
        if sheet is not None and sheet not in sheets:
            raise LaserFormatError(
                f"{path}: there is no sheet {sheet!r}; the sheets are {', '.join(map(repr, sheets))}"
            )
        return [Grid(path, name, rows, name) for name, rows in sheets.items() if sheet in (None, name)]
    text = decode_text(path, content)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    short = sum(len(line) < _SHORT_LINE for line in lines) if len(lines) > MOST_ROWS else 0
    if short > MOST_ROWS:
        raise LaserFormatError(
            f"{path}: {short} lines with nothing or fewer than {_SHORT_LINE} characters, too short for a reading; the file is damaged or "
            "no table, export it again"
        )
    lines = ["" if line.startswith("#") else line for line in lines]
    present = sorted((mark for mark in DELIMITERS if any(mark in line for line in lines)), key=text.count, reverse=True)
    grids = [Grid(path, "", split_lines(path, lines, mark)) for mark in present or [","]]
    if not grids[0].rows:
        raise LaserFormatError(f"{path}: the file is empty; expected a header line and the measured values below it")
    return grids


def split_lines(path: Path, lines: Sequence[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """Split lines of text into fields."""
    raise_if_too_wide(path, lines, delimiter)
    reader = csv.reader((f"{line}\n" for line in lines), delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [text.strip() for text in fields]) for fields in reader]
    except csv.Error as fault:
        raise LaserFormatError(
            f"{path}, line {reader.line_num}: {fault}; the file is damaged or not a table, export it again"
        ) from None
    return [(line, fields) for line, fields in rows if any(fields)]


def raise_if_too_wide(path: Path, lines: Sequence[str], delimiter: str | None) -> None:
    """Raise where a line has more fields than a table has columns; without a delimiter, spaces part them."""
    for number, line in enumerate(lines, start=1):
        # A field takes a character at least, and its mark another.
        if len(line) < 2 * MOST_COLUMNS:
            continue
        if (line.count(delimiter) + 1 if delimiter else len(line.split())) > MOST_COLUMNS:
            raise LaserFormatError(
                f"{path}, line {number}: more than {MOST_COLUMNS} columns; the file is damaged or no table: export it again with a line "
                "for each time or reading"
            )


def shown(fields: Iterable[str]) -> str:
    """Return a row for a message, shortened."""
    text = ",".join(fields)
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def read_table(path: Path, required: tuple[str, ...]) -> DelimitedTable:
    """Read a table from a text file or a spreadsheet and check that it has the required columns."""
    grids = read_grids(path)
    for grid in grids:
        for at, (_, fields) in enumerate(grid.rows):
            if all(name in fields for name in required):
                return table_below(grid, at)
    line, fields = grids[0].rows[0]
    missing = [name for name in required if name not in fields]
    raise LaserFormatError(
        f"{grids[0].place}, line {line}: no column {', '.join(missing)}; the header is {shown(fields)}, "
        f"expected {','.join(required)!r} (names carry the unit: convert the values and rename the column)"
    )


def table_below(grid: Grid, at: int) -> DelimitedTable:
    """Return the table whose header is a row of a grid."""
    line, fields = grid.rows[at]
    names = tuple(fields[: max(i for i, name in enumerate(fields) if name) + 1])
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise LaserFormatError(
            f"{grid.place}, line {line}: column {', '.join(map(repr, repeated))} occurs more than once; keep one"
        )
    # Spreadsheets give every row the width of the widest one.
    rows = [(number, row[: len(names)] if not any(row[len(names) :]) else row) for number, row in grid.rows[at + 1 :]]
    return DelimitedTable(grid.path, names, rows, grid.numerals)


def find_header(lines: Iterable[str]) -> tuple[int, str]:
    """Find the header: the first line that is neither empty nor starts with ``#``."""
    return next(((i, line) for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), (0, ""))


def delimiter_of(header: str) -> str:
    """Return the delimiter of a header line: comma, semicolon or tab, whichever it contains most often; "" for spaces."""
    return max(",;\t", key=header.count) if any(mark in header for mark in ",;\t") else ""


def delimiter_of_values(line: str) -> str:
    """Return the delimiter of a line of numbers, in which commas may be decimal: tab, semicolon or comma; "" for spaces."""
    return next((mark for mark in "\t;," if mark in line), "")


def fields_of(line: str, delimiter: str) -> list[str]:
    """Return the fields of one line of text."""
    if not delimiter:
        return line.split()
    try:
        return next(csv.reader([line.strip("\r\n")], delimiter=delimiter), [])
    except csv.Error as fault:
        raise LaserFormatError(f"{fault}; the file is damaged or not a table, export it again") from None


#: Rows that are out of place, as two loggers that write one table leave them, and not the start of another stretch.
_OUT_OF_PLACE = 2
#: Steps back that are looked at.
_MOST_STEPS_BACK = 1000


def where_clock_goes_back(path: Path, lines: Sequence[int], times: NDArray[np.datetime64]) -> list[RejectedLine]:
    """Return the lines whose time is before that of the line above, in a table with its newest line first after it.

    Raise a LaserFormatError where the clock goes back over several rows: sorted by their times, two stretches would be mixed.
    """
    later = np.sign(np.diff(times).astype(np.int64))
    forwards = later.sum() >= 0
    against = np.flatnonzero(later * (1 if forwards else -1) < 0)
    for at in (against if forwards else against[::-1])[:_MOST_STEPS_BACK]:
        parts = times[: at + 1], times[at + 1 :]
        (before, after), (last, first) = (parts, (at, at + 1)) if forwards else (parts[::-1], (at + 1, at))
        overlap = min(int((before > times[first]).sum()), int((after < times[last]).sum()))
        if overlap > _OUT_OF_PLACE:
            raise LaserFormatError(
                f"{path}, line {lines[first]}: the clock goes back from {_written(times[last])} to {_written(times[first])}, over "
                f"{overlap} rows; sorted by their times, two stretches would be mixed. Give the rows before and after as files of their "
                "own, or correct their times; at the end of daylight saving write them with their offset from UTC, as 02:00:00+01:00"
            )
    word = "before" if forwards else "after"
    return [
        RejectedLine(
            path.name,
            int(lines[at + 1]),
            _written(times[at + 1]),
            f"is {word} {_written(times[at])} of line {lines[at]}",
        )
        for at in against
    ]


def _written(time: np.datetime64) -> str:
    """Return a time as a message writes it, in seconds where it counts from no date."""
    if time < DATED:
        return f"{(time - np.datetime64('1970')) / np.timedelta64(1, 's'):.10g} s"
    return str(time).removesuffix(".000000000").replace("T", " ")


def read_timed_rows(
    table: DelimitedTable,
    variables: Mapping[str, Mapping[str, str]],
    parse: Callable[[dict[str, str]], list[float]],
    *,
    time: str = "time",
) -> xr.Dataset:
    """Read the rows of a table that has a column of times into a Dataset."""
    rows: dict[np.datetime64, list[float]] = {}
    kept: dict[np.datetime64, int] = {}
    left_out = LeftOut(table.path)
    zones: dict[str, int] = {}
    order = DateOrder.of(table.path, [(line, fields[time]) for line, fields in table.records() if fields is not None])
    for line, fields in table.records():
        with left_out.collect(line):
            if fields is None:
                raise BadReading("", f"does not have {len(table.columns)} fields")
            instant, zone = parse_time(fields[time], order)
            if instant in rows:
                raise BadReading(fields[time], "occurs on an earlier line too, which is kept")
            rows[instant] = parse(fields)
            kept[instant] = line
            zones.setdefault(zone, line)
    raise_if_mostly_invalid(table.path, len(rows), left_out.lines, last=max(kept.values(), default=None))
    instants = np.array(list(rows), dtype="datetime64[ns]")
    goes_back = where_clock_goes_back(table.path, [kept[instant] for instant in rows], instants)
    times = sorted(rows)
    values = np.array([rows[instant] for instant in times])
    dataset = xr.Dataset(
        {name: (("time",), values[:, column], dict(attrs)) for column, (name, attrs) in enumerate(variables.items())},
        coords={"time": np.array(times, dtype="datetime64[ns]")},
        attrs={
            "source": table.path.name,
            "left_out": left_out.as_json(),
            "clock": json.dumps([asdict(line) for line in goes_back]),
        },
    )
    dataset["time"].attrs["reference"] = describe_time_zone(table.path, zones)
    return dataset
