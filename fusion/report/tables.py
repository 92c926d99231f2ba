"""Tables as the report and the terminal show them: columns, rows, and which rows are marked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import rich.table

from fusion.terminal import cell


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    title : str
        Heading, with the unit of its values.
    numeric : bool
        Whether its cells are numbers, set to the right.
    """

    title: str
    numeric: bool = True


class Words(str):
    """Heading of a column of text; a plain str is the heading of a column of numbers."""


@dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes
    ----------
    cells : sequence of str
        One text per column.
    marked : bool
        Whether it is set off from the others.
    """

    cells: Sequence[str]
    marked: bool = False


@dataclass(frozen=True)
class Table:
    """A table of finished texts.

    Attributes
    ----------
    columns : tuple of Column
    rows : tuple of Row
        As many cells as columns in each.
    stacked : bool
        Whether cells stand below each other on a narrow screen, for columns of long sentences.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...] = field(default_factory=tuple)
    stacked: bool = False


def table(headings: Iterable[str], rows: Iterable[Row | Sequence[str]], *, stacked: bool = False) -> Table:
    """Return a table.

    Parameters
    ----------
    headings : iterable of str
        One per column with the unit of its values; `Words` for a column of text.
    rows : iterable of Row or sequence of str
        A bare sequence of cells stands for a row that is not marked.
    stacked : bool
        See `Table`.
    """
    columns = tuple(Column(heading, numeric=not isinstance(heading, Words)) for heading in headings)
    return Table(columns, tuple(row if isinstance(row, Row) else Row(row) for row in rows), stacked)


def print_table(shown: Table, title: str) -> rich.table.Table:
    """Return a table as the terminal shows it.

    Parameters
    ----------
    shown : Table
        Marks are not shown.
    title : str
        Line above the table.
    """
    printed = rich.table.Table(title=cell(title), title_justify="left")
    for column in shown.columns:
        printed.add_column(cell(column.title), justify="right" if column.numeric else "left")
    for row in shown.rows:
        printed.add_row(*map(cell, row.cells))
    return printed
