"""The process of a run ends as the command does, and tells its progress in lines that a program reads."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fusion.app.run.child import main, write_progress


def test_progress_is_one_object_per_line(capsys: pytest.CaptureFixture[str]) -> None:
    write_progress('a "step"', 1, 3)
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [
        {"label": 'a "step"', "done": 1, "total": 3}
    ]


def test_bad_input_ends_with_the_message_and_code_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "campaign.toml").write_text("[campaign]\n")
    assert main(str(tmp_path / "campaign.toml"), str(tmp_path / "results")) == 2
    assert "thermofuse: " in capsys.readouterr().err
    assert not (tmp_path / "results").exists()
