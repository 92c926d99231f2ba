"""Progress: plain lines where there is no terminal, bars where there is one, silence in a library."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import pytest
import xarray as xr
from rich.console import Console

from fusion.results import progress
from fusion.results.progress import Reporter, counted, left_out_notices, listed, silent


def shown(*calls: tuple[str, int, int], terminal: bool = False) -> str:
    """Return what a console shows of some reports."""
    written = io.StringIO()
    with Reporter(Console(file=written, force_terminal=terminal, width=100)) as report:
        for call in calls:
            report(*call)
    return written.getvalue()


@pytest.mark.parametrize(
    ("done", "lines"),
    [((0, 1, 2, 3), ["frames ...", "frames: done"]), ((0, 3, 3, 0, 3), ["frames ...", "frames: done"] * 2)],
)
def test_plain_lines_tell_start_and_end_once(done: Sequence[int], lines: list[str]) -> None:
    """A step that is done again starts again."""
    told = shown(*(("frames", number, 3) for number in done), ("thermal fields (kept)", 1, 1)).splitlines()
    assert [line.split(" in ")[0] for line in told] == [*lines, "thermal fields (kept): done"]


def test_plain_lines_speak_up_during_a_long_step(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 0.0, 4.0, 11.0, 12.0, 30.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    told = shown(*(("frames", done, 10) for done in (0, 1, 2, 3, 10)))
    assert told.splitlines() == ["frames ...", "frames: 2 of 10, about 56 s left", "frames: done in 30.0 s"]


def test_a_step_that_takes_ten_times_its_forecast_says_so_once_and_how_to_stop_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = iter([0.0, 0.0, 4.0, 9.0, 9.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    written = io.StringIO()
    with Reporter(Console(file=written, width=300)) as report:
        for label, done in (("closed loop", 0), ("closed loop", 2), ("correlation", 0), ("closed loop", 3)):
            report(label, done, 10)
        # 4 s for two of ten parts: 20 s; of the correlation no part is done, and the run took 9 s before it.
        for now in (98.0, 100.0, 199.0, 201.0, 300.0):
            report._say_overdue(now)
    _, _, *said = written.getvalue().splitlines()
    assert [one.split(";")[0] for one in said] == [
        "correlation: 91 s so far, the whole run before it took 9 s",
        "closed loop: 201 s so far, 20 s were expected from its first parts",
    ]
    assert all("Ctrl-C stops the run" in one for one in said)


def test_a_terminal_gets_a_bar_per_step() -> None:
    text = shown(("frames", 0, 60), ("frames", 60, 60), ("report", 0, 1), ("report", 1, 1), terminal=True)
    assert all(words in text for words in ("frames", "60/60", "report", "1/1"))


def test_a_library_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    silent("frames", 1, 2)
    assert capsys.readouterr() == ("", "")


# What was left out is counted, and the first of it named.


def test_numbers_and_lists_are_words() -> None:
    assert (counted(1, "frame"), counted(0, "frame")) == ("1 frame", "0 frames")
    assert listed("abc") == "a; b; c"
    assert listed(str(k) for k in range(7)) == "0; 1; 2; 3; 4 and 2 more"


def test_each_file_has_one_notice_of_its_rejected_lines() -> None:
    lines = [
        {"path": path, "line": line, "value": "x", "reason": "is no number"}
        for path, line in (("a.csv", 3), ("a.csv", 4), ("b.csv", 2))
    ]
    first, second = left_out_notices(xr.Dataset(attrs={"left_out": json.dumps(lines)}), "lines_left_out")
    assert first.message == "2 lines of a.csv left out: line 3 ('x' is no number); line 4 ('x' is no number)."
    assert second.message == "1 line of b.csv left out: line 2 ('x' is no number)."
    assert (first.code, second.remedy[:28]) == ("lines_left_out", "Correct these lines in b.csv")
    assert left_out_notices(xr.Dataset(), "lines_left_out") == []
