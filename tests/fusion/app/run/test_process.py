"""A run in a process of its own: its messages, its cancellation, and one run per results folder."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fusion.app.run.process import RunError, Runs, is_begun
from fusion.endings import ExitCode


@pytest.fixture
def runs() -> Iterator[Runs]:
    made = Runs()
    yield made
    made.end()


def test_a_run_is_cancelled_cleanly_and_holds_its_folder_until_then(
    campaign_folder: Path, tmp_path: Path, runs: Runs
) -> None:
    results = tmp_path / "results"
    run = runs.start(campaign_folder / "campaign.toml", results)
    assert run.runs and runs.of(results) is run and not run.resumed
    with pytest.raises(RunError, match="is in use by a run of another page"):
        runs.start(campaign_folder / "campaign.toml", results)
    end = time.monotonic() + 30
    while not run.progress.stages and time.monotonic() < end:
        time.sleep(0.05)
    run.cancel()
    assert run.wait(30) == ExitCode.TERMINATED
    assert any("stopped by SIGTERM" in message for message in run.messages)


def test_bad_input_is_told_in_the_words_of_the_command(tmp_path: Path, runs: Runs) -> None:
    (tmp_path / "campaign.toml").write_text("[campaign]\naxis = 'X'\n")
    run = runs.start(tmp_path / "campaign.toml", tmp_path / "results")
    assert run.wait(30) == ExitCode.BAD_INPUT
    assert "campaign.toml" in run.messages[0] and not run.messages[0].startswith("thermofuse")


def test_a_folder_with_anything_in_it_is_begun(tmp_path: Path) -> None:
    assert not is_begun(tmp_path / "absent") and not is_begun(tmp_path)
    (tmp_path / "x").touch()
    assert is_begun(tmp_path)
