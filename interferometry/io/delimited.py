"""Delimited text and sheets as rows of fields, and tables whose columns are found by their names."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr

from interferometry.io.dates import DateOrder, describe_time_zone, parse_time
from interferometry.io.encodings import decode_text
from interferometry.io.faults import BadReading, LaserFormatError, RejectedLine, raise_if_mostly_invalid
from interferometry.io.headings import CHINESE_WORDS
from interferometry.io.numerals import Numerals
from interferometry.io.workbook import is_workbook, read_sheets

#: Marks that may stand between fields.
DELIMITERS = ";\t,|"
#: Columns of the widest sheet of a spreadsheet; a text with more is no table of readings, and takes long to be found none.
_MOST_COLUMNS = 16_384
#: A line with a reading has more characters; a text with more shorter lines than a spreadsheet has rows is damaged, and takes long to
#: be found so.
_SHORT_LINE, _MOST_SHORT_LINES = 4, 1_048_576
#: Longest part of a line of the file that a message repeats, characters.
_SHOWN = 160


@dataclass(frozen=True)
class Grid:
    """Rows of fields, before anything in them is understood.

    Attributes
    ----------
    path : pathlib.Path
    sheet : str
        Name of the sheet of a spreadsheet; "" for a text file.
    rows : list of (int, list of str)
        Number of each row or line in the file, from 1, and its fields; rows without any text and lines that start with ``#`` are left out.
    """

    path: Path
    sheet: str
    rows: list[tuple[int, list[str]]]

    @property
    def place(self) -> str:
        """File and sheet, as messages name them."""
        return f"{self.path}, sheet {self.sheet!r}" if self.sheet else str(self.path)

    @property
    def numerals(self) -> Numerals:
        """How the numbers of the grid are written."""
        return Numerals.of(text for _, fields in self.rows for text in fields)


@dataclass(frozen=True)
class DelimitedTable:
    """A table: its column names and its rows with their line numbers.

    Attributes
    ----------
    path : pathlib.Path
    columns : tuple of str
        Names of the header line, stripped.
    rows : list of (int, list of str)
        Number of each line in the file, from 1, and its fields.
    numerals : Numerals
        How the numbers of the file are written.
    """

    path: Path
    columns: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    numerals: Numerals = field(default_factory=Numerals)

    def records(self) -> Iterator[tuple[int, dict[str, str] | None]]:
        """Yield line number and fields by column name; None where the number of fields is wrong."""
        for line, fields in self.rows:
            yield line, dict(zip(self.columns, fields, strict=True)) if len(fields) == len(self.columns) else None

    def number(self, text: str) -> float:
        """Return a finite number; raises `BadReading` where the text is none."""
        return self.numerals.number(text)


def read_grids(path: Path, *, sheet: str | None = None) -> list[Grid]:
    """Read a file of text or a spreadsheet as rows of fields.

    Parameters
    ----------
    path : pathlib.Path
        Delimited text in UTF-8, UTF-16 or a code page, or a spreadsheet (.xlsx, .xls, .ods); the content decides.
    sheet : str, optional
        Name of the only sheet of a spreadsheet to read; None reads all visible ones.

    Returns
    -------
    list of Grid
        Of a spreadsheet one per visible sheet; of a text one per delimiter that occurs in it, the most frequent one first.

    Raises
    ------
    LaserFormatError
        The file is empty, no text and no spreadsheet, has no such sheet, or more than 1,048,576 lines of fewer than four characters.
    OSError
        The file cannot be opened.
    """
    content = path.read_bytes()
    if is_workbook(content):
        sheets = read_sheets(path, content)
        if sheet is not None and sheet not in sheets:
            raise LaserFormatError(
                f"{path}: there is no sheet {sheet!r}; the sheets are {', '.join(map(repr, sheets))}"
            )
        return [Grid(path, name, rows) for name, rows in sheets.items() if sheet in (None, name)]
    text = decode_text(path, content, chinese_words=CHINESE_WORDS)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    short = sum(len(line) < _SHORT_LINE for line in lines) if len(lines) > _MOST_SHORT_LINES else 0
    if short > _MOST_SHORT_LINES:
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
    """Split lines of text into fields.

    Parameters
    ----------
    path : pathlib.Path
        For the message.
    lines : sequence of str
        Without their ends.
    delimiter : str
        One character.

    Returns
    -------
    list of (int, list of str)
        Number of each line, from 1, and its fields; lines without any text are left out.

    Raises
    ------
    LaserFormatError
        A field is longer than one may be, a line has more than 16,384 of them, or it holds what no table does.
    """
    wide = next((number for number, line in enumerate(lines, start=1) if line.count(delimiter) >= _MOST_COLUMNS), None)
    if wide is not None:
        raise LaserFormatError(
            f"{path}, line {wide}: more than {_MOST_COLUMNS} columns, which no spreadsheet has; the file is damaged or no table, export it "
            "again with a line for each reading"
        )
    reader = csv.reader((f"{line}\n" for line in lines), delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [text.strip() for text in fields]) for fields in reader]
    except csv.Error as fault:
        raise LaserFormatError(
            f"{path}, line {reader.line_num}: {fault}; the file is damaged or no table, export it again"
        ) from None
    return [(line, fields) for line, fields in rows if any(fields)]


def shown(fields: Iterable[str]) -> str:
    """Return a row for a message, shortened.

    Parameters
    ----------
    fields : iterable of str
    """
    text = ",".join(fields)
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def read_table(path: Path, required: tuple[str, ...]) -> DelimitedTable:
    """Read a table from a text file or a spreadsheet and check that it has the required columns.

    Lines above the header, byte-order marks, any line ends, empty lines, lines that start with ``#``, and commas, semicolons, tabs or
    bars between the fields are all accepted.

    Parameters
    ----------
    path : pathlib.Path
    required : tuple of str
        Names of the columns that must exist; others are allowed.

    Returns
    -------
    DelimitedTable

    Raises
    ------
    LaserFormatError
        The file is empty or neither text nor a spreadsheet, or a column is missing or repeated.
    """
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
    """Return the table whose header is a row of a grid.

    Parameters
    ----------
    grid : Grid
    at : int
        Index of the row.

    Raises
    ------
    LaserFormatError
        Two columns have one name.
    """
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
    """Find the header: the first line that is neither empty nor starts with ``#``.

    Parameters
    ----------
    lines : iterable of str
        Of the file, from the first.

    Returns
    -------
    before : int
        Number of lines before the header.
    header : str
        The line; "" where there is none.
    """
    return next(((i, line) for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), (0, ""))


def delimiter_of(header: str) -> str:
    """Return the delimiter of a header line: comma, semicolon or tab, whichever it contains most often.

    Parameters
    ----------
    header : str

    Returns
    -------
    str
        One character.
    """
    return max(",;\t", key=header.count)


def read_timed_rows(
    table: DelimitedTable,
    variables: Mapping[str, Mapping[str, str]],
    parse: Callable[[dict[str, str]], list[float]],
    *,
    time: str = "time",
) -> xr.Dataset:
    """Read the rows of a table that has a column of times into a Dataset.

    Parameters
    ----------
    table : DelimitedTable
    variables : mapping of str to mapping
        Attributes (units and others) of the variables by name, in the order in which `parse` returns their values.
    parse : callable
        Takes the fields of a line by column, returns its values; raises `BadReading` where one cannot be used.
    time : str, optional
        Name of the column of times.

    Returns
    -------
    xarray.Dataset
        The variables along ``time`` (UTC, increasing); ``attrs["left_out"]`` is a JSON list of the lines left out.

    Raises
    ------
    LaserFormatError
        Fewer than half of the lines can be used, only some times have a zone, or the order of day and month is not settled.
    """
    rows: dict[np.datetime64, list[float]] = {}
    left_out: list[RejectedLine] = []
    zones: dict[str, int] = {}
    order = DateOrder.of(table.path, [(line, fields[time]) for line, fields in table.records() if fields is not None])
    for line, fields in table.records():
        try:
            if fields is None:
                raise BadReading("", f"does not have {len(table.columns)} fields")
            instant, zone = parse_time(fields[time], order)
            if instant in rows:
                raise BadReading(fields[time], "occurs on an earlier line too, which is kept")
            rows[instant] = parse(fields)
        except BadReading as fault:
            left_out.append(RejectedLine(table.path.name, line, fault.value, fault.reason))
            continue
        zones.setdefault(zone, line)
    raise_if_mostly_invalid(table.path, len(rows), left_out)
    times = sorted(rows)
    values = np.array([rows[instant] for instant in times])
    dataset = xr.Dataset(
        {name: (("time",), values[:, column], dict(attrs)) for column, (name, attrs) in enumerate(variables.items())},
        coords={"time": np.array(times, dtype="datetime64[ns]")},
        attrs={"source": table.path.name, "left_out": json.dumps([asdict(line) for line in left_out])},
    )
    dataset["time"].attrs["reference"] = describe_time_zone(table.path, zones)
    return dataset
