"""A run computed again: what differs is told, and equal is equal byte for byte."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fusion import reproduction as module
from fusion.campaign.config import load_campaign
from fusion.pipeline.provenance import hash_files, versions
from fusion.products.results import ResultsError
from fusion.reproduction import reproduce


@pytest.fixture
def finished(copied: Path) -> Path:
    """The folder of a run that was never computed: its provenance is that of the campaign, its results three values."""
    campaign = load_campaign(copied / "campaign.toml")
    results = copied / "results"
    results.mkdir()
    provenance = {
        "versions": versions(),
        "inputs": hash_files(campaign.input_files()),
        "campaign_file": "../campaign.toml",
    }
    (results / "provenance.json").write_text(json.dumps(provenance))
    (results / "results.json").write_text('{"a": 1, "b": [1.5, {"c": "x"}]}')
    return results


def giving(text: str) -> Callable[..., None]:
    """A run that writes these results."""

    def run(campaign: Path, out: Path, **options: object) -> None:
        out.mkdir(parents=True)
        (out / "results.json").write_text(text)

    return run


def test_equal_and_different_results_are_told(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (finished / "results.json").read_text()
    monkeypatch.setattr(module, "run_campaign", giving(text))
    found = reproduce(finished)
    assert (found.equal, found.lines) == (True, ("equal: 29 input files give the same results.json, all 32 bytes",))
    monkeypatch.setattr(module, "run_campaign", giving('{"a": 2, "b": [1.5, {"c": "y"}], "d": null}'))
    found = reproduce(finished)
    assert not found.equal
    assert found.lines == ("different: 2 values of results.json", "a: 2, was 1", 'b[1].c: "y", was "x"')


def test_other_versions_are_named_beside_the_outcome(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provenance = json.loads((finished / "provenance.json").read_text())
    provenance["versions"]["numpy"] = "1.26.0"
    (finished / "provenance.json").write_text(json.dumps(provenance))
    monkeypatch.setattr(module, "run_campaign", giving((finished / "results.json").read_text()))
    assert reproduce(finished).lines[0] == f"numpy {versions()['numpy']}, was 1.26.0"


def test_other_inputs_are_named_and_nothing_is_computed(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "run_campaign", None)
    with (finished.parent / "laser.csv").open("a") as file:
        file.write("\n")
    removed = sorted((finished.parent / "thermal").iterdir())[0]
    shutil.copy(removed, removed.with_name("added.jpg"))
    removed.unlink()
    found = reproduce(finished)
    assert not found.equal
    assert [line.split(":")[0] for line in found.lines[:-1]] == [
        "laser.csv",
        f"thermal/{removed.name}",
        "thermal/added.jpg",
    ]
    assert found.lines[-1] == "the inputs are not those of the run, so it was not computed again"


def test_a_folder_without_a_run_or_its_campaign_is_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ResultsError, match=r"holds no finished run; name a folder with results\.json and provenance\.json"
    ):
        reproduce(tmp_path)
    elsewhere = shutil.copytree(finished, tmp_path / "elsewhere" / "results")
    with pytest.raises(ResultsError, match="name it with --campaign"):
        reproduce(elsewhere)
    for text in ("{", "[" * 100_000):
        (elsewhere / "provenance.json").write_text(text)
        with pytest.raises(ResultsError, match=r"provenance\.json: is not JSON"):
            reproduce(elsewhere)
