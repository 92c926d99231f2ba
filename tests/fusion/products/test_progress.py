"""Progress: plain lines where there is no terminal, bars where there is one, silence in a library."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from fusion.products import progress
from fusion.products.progress import Reporter, silent


def shown(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_plain_lines_tell_start_and_end_once() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with Reporter(console) as report:
        for done in range(4):
            report("frames", done, 3)
        report("thermal fields (kept)", 1, 1)
    lines = shown(console).splitlines()
    assert lines[0] == "frames ..."
    assert lines[1].startswith("frames: done in ")
    assert lines[2].startswith("thermal fields (kept): done in ")
    assert len(lines) == 3


def test_a_step_that_is_done_again_starts_again_and_ends_once() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with Reporter(console) as report:
        for done in (0, 3, 3, 0, 3):
            report("frames", done, 3)
    assert [line.split(" in ")[0] for line in shown(console).splitlines()] == ["frames ...", "frames: done"] * 2


def test_plain_lines_speak_up_during_a_long_step(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 4.0, 11.0, 12.0, 30.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    console = Console(file=io.StringIO(), force_terminal=False)
    with Reporter(console) as report:
        for done in (0, 1, 2, 3, 10):
            report("frames", done, 10)
    assert shown(console).splitlines() == ["frames ...", "frames: 2 of 10, about 44 s left", "frames: done in 30.0 s"]


def test_a_terminal_gets_a_bar_per_step() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with Reporter(console) as report:
        report("frames", 0, 60)
        report("frames", 60, 60)
        report("report", 0, 1)
        report("report", 1, 1)
    text = shown(console)
    assert "frames" in text and "60/60" in text and "report" in text and "1/1" in text


def test_a_library_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    silent("frames", 1, 2)
    assert capsys.readouterr() == ("", "")
