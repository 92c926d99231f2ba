"""The terminal: text from files is shown as it is, short enough to be read, and acts on nothing."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import rich.table
from typer.testing import CliRunner

from fusion.cli import app
from fusion.common.messages import Terminal, ascii_json, cell, printable, printable_json, short
from fusion.report.wording import print_table, table

#: Clears the screen, renames the window, rings, goes back over the line, sets by C1, turns the direction of what follows.
ACTING = "\x1b[2J \x1b]0;x\x07 \r \x08 \x9b2J \u202e"
SHOWN = r"\x1b[2J \x1b]0;x\x07 \r \x08 \x9b2J \u202e"


def printed(*objects: object, **options: object) -> str:
    file = io.StringIO()
    Terminal(file=file, width=200, soft_wrap=True).print(*objects, **options)
    return file.getvalue()


def test_characters_that_act_on_a_terminal_are_shown() -> None:
    assert printable(ACTING) == SHOWN
    assert printable("Größe 測定 \t\n 😀 ± µm") == "Größe 測定 \t\n 😀 ± µm"
    assert printable("\udcff.jpg") == r"\udcff.jpg"
    assert printed(f"file {ACTING}") == f"file {SHOWN}\n"


def test_text_is_neither_markup_nor_a_name_of_a_picture() -> None:
    assert printed("[bold]a[/x] :smile:", style="bold") == "[bold]a[/x] :smile:\n"


def test_cells_and_titles_of_tables_act_on_nothing_either() -> None:
    shown = rich.table.Table(title=cell("[/x]\x1b[2J"))
    shown.add_column("a")
    shown.add_row(cell("\x1b]0;x[/b]"))
    shown.add_row("\x1b[2J")  # a table that did not care
    text = printed(shown)
    assert "\x1b" not in text and r"\x1b[2J" in text and r"\x1b]0;x[/b]" in text
    text = printed(print_table(table(["[/a]"], [["[/b]"]]), "[/c]"))
    assert "[/a]" in text and "[/b]" in text and "[/c]" in text


def test_json_keeps_its_values() -> None:
    text = json.dumps({"name": ACTING + "µ"}, indent=1, ensure_ascii=False)
    shown = printable_json(text)
    assert json.loads(shown) == {"name": ACTING + "µ"} and "µ" in shown
    assert not any(character in shown for character in "\x1b\x9b\u202e\x07\r")


def test_json_of_ascii_keeps_its_values() -> None:
    shown = ascii_json(json.dumps({"name": "µ \U0001d6b9 \\ \x7f"}, indent=1, ensure_ascii=False))
    assert json.loads(shown) == {"name": "µ \U0001d6b9 \\ \x7f"} and shown.isascii() and "\n" in shown


def test_long_text_is_cut_and_what_is_left_out_is_counted() -> None:
    cut = short("a" * 500_000 + "z")
    assert len(cut) < 5_000 and "496001 characters left out" in cut and cut.endswith("z")
    assert short("x\n" * 10_000).endswith("... and 8001 more lines")
    assert short("a\nb") == "a\nb"


@pytest.mark.parametrize("more", [[], ["--json"]], ids=["lines", "json"])
def test_names_of_files_reach_the_terminal_escaped(tmp_path: Path, more: list[str]) -> None:
    try:
        (tmp_path / "a\x1b[2J.csv").write_text("x\x1b]0;t\x07,y\n1,2\n")
    except OSError:
        pytest.skip("this file system has no such names")
    for command in (["inspect", str(tmp_path), *more], ["check", str(tmp_path / "a\x1b[2J.csv"), *more]):
        result = CliRunner().invoke(app, command)
        assert result.exit_code in (0, 2) and "\x1b" not in result.output and "\x07" not in result.output
        assert "x1b[2J" in result.output or "u001b[2J" in result.output
