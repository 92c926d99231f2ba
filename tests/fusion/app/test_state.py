"""A page opens with what lies in its folder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from fusion.app.run.process import RUNS
from fusion.app.state import state_of


def test_an_empty_folder_has_neither_campaign_nor_results(tmp_path: Path) -> None:
    state = state_of(tmp_path)
    assert (state.root, state.folder, state.campaign, state.results) == (
        tmp_path.resolve(),
        tmp_path.resolve(),
        None,
        None,
    )


def test_a_finished_campaign_is_found(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").touch()
    (tmp_path / "results").mkdir()
    assert state_of(tmp_path).results is None, "a folder without results.json holds no finished run"
    (tmp_path / "results" / "results.json").touch()
    state = state_of(tmp_path)
    assert (state.campaign, state.results) == (tmp_path / "campaign.toml", tmp_path / "results")


def test_a_page_opens_with_the_run_that_was_started_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign, results = tmp_path / "below" / "campaign.toml", tmp_path / "elsewhere"
    campaign.parent.mkdir()
    campaign.touch()
    monkeypatch.setattr(RUNS, "_runs", {results: SimpleNamespace(campaign=campaign, results=results)})
    state = state_of(tmp_path)
    assert (state.folder, state.campaign, state.results) == (campaign.parent, campaign, None)
    results.mkdir()
    (results / "results.json").touch()
    assert state_of(tmp_path).results == results


def test_the_folder_of_the_application_cannot_be_changed(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"[Cc]onstant"):
        state_of(tmp_path).root = Path("/")
