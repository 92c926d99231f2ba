"""Tables: columns of numbers and of text, marked rows, the same table on the terminal."""

from __future__ import annotations

from rich.console import Console

from fusion.report.tables import Row, Words, print_table, table

SHOWN = table([Words("Effect"), "Error / \u00b5m"], [["step", "0.4"], Row(["dead path", "0.3"], marked=True)])


def test_bare_headings_are_columns_of_numbers() -> None:
    assert [column.numeric for column in SHOWN.columns] == [False, True]
    assert [column.title for column in SHOWN.columns] == ["Effect", "Error / \u00b5m"]
    assert [row.marked for row in SHOWN.rows] == [False, True]


def test_the_terminal_shows_every_cell() -> None:
    console = Console(width=60)
    with console.capture() as capture:
        console.print(print_table(SHOWN, "steps"))
    text = capture.get()
    assert all(cell in text for cell in ("steps", "Effect", "dead path", "0.4", "0.3"))
