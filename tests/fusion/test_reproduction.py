"""A run computed again: what differs is told, and equal is equal byte for byte."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fusion.campaign.config import load_campaign
from fusion.common import versions
from fusion.pipeline import reproduce as module
from fusion.pipeline.reproduce import reproduce
from fusion.pipeline.resume import hash_files
from fusion.results.results import ResultsError
from tests.fusion.campaign_parts import change


@pytest.fixture
def finished(copied: Path) -> Path:
    """The folder of a run that was never computed: its provenance is that of the campaign, its results three values."""
    campaign = load_campaign(copied / "campaign.toml")
    results = copied / "results"
    results.mkdir()
    inputs = hash_files(campaign.input_files())
    provenance = {"versions": versions(), "inputs": inputs, "campaign_file": "../campaign.toml"}
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


def test_files_elsewhere_that_an_earlier_version_named_without_folders_are_known(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    laser = finished.parent / "laser.csv"
    shutil.move(laser, finished.parent.parent)
    change(finished.parent / "campaign.toml", '"laser.csv"', '"../laser.csv"')
    provenance = json.loads((finished / "provenance.json").read_text())
    provenance["inputs"] |= hash_files({"campaign.toml": finished.parent / "campaign.toml"})
    (finished / "provenance.json").write_text(json.dumps(provenance))
    monkeypatch.setattr(module, "run_campaign", giving((finished / "results.json").read_text()))
    assert reproduce(finished).equal


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
    told = [line.split(":")[0] for line in found.lines[:-1]]
    assert told == ["laser.csv", f"thermal/{removed.name}", "thermal/added.jpg"]
    assert found.lines[-1] == "the inputs are not those of the run, so it was not computed again"


def test_a_folder_without_a_run_or_its_campaign_is_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"holds no finished run; name a folder with results\.json"):
        reproduce(tmp_path)
    elsewhere = shutil.copytree(finished, tmp_path / "elsewhere" / "results")
    with pytest.raises(ResultsError, match="name it with --campaign"):
        reproduce(elsewhere)
    shutil.copy(finished.parent / "campaign.toml", tmp_path)
    # Two folders up, by a link or by its parts, is none of what a run notes.
    (elsewhere / "link.toml").symlink_to(tmp_path / "campaign.toml")
    outside = ("../../campaign.toml", str(tmp_path / "campaign.toml"), "link.toml")
    for place in (*outside, "../" * 5000, "x" * 5000, "a\0b", 5, None):
        provenance = json.loads((finished / "provenance.json").read_text())
        (elsewhere / "provenance.json").write_text(json.dumps({**provenance, "campaign_file": place}))
        with pytest.raises(ResultsError, match="name it with --campaign"):
            reproduce(elsewhere)
    for text in ("{", "[" * 100_000, '{"inputs": ' + "1" * 5000 + "}", b"\xff\xfe{"):
        (elsewhere / "provenance.json").write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(ResultsError, match=r"provenance\.json: is not JSON"):
            reproduce(elsewhere)


@pytest.mark.parametrize(
    "content",
    [
        [],
        {"inputs": {}},
        {"inputs": {"laser.csv": 1}, "versions": {}},
        {"inputs": {"a": {"sha256": "x"}}, "versions": {}},
    ],
)
def test_a_provenance_that_lists_no_files_is_refused(finished: Path, content: object) -> None:
    (finished / "provenance.json").write_text(json.dumps(content))
    with pytest.raises(ResultsError, match=r"is not the provenance of a run; run the campaign again"):
        reproduce(finished)


@pytest.mark.parametrize("text", ["{", "[" * 100_000, '{"a": ' + "1" * 5000 + "}", b"\xff"])
def test_results_that_are_not_json_are_refused_before_the_run(
    finished: Path, monkeypatch: pytest.MonkeyPatch, text: str | bytes
) -> None:
    monkeypatch.setattr(module, "run_campaign", None)
    (finished / "results.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ResultsError, match=r"results\.json: is not JSON"):
        reproduce(finished)


def test_very_many_and_very_long_differences_are_told_in_short(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    provenance = json.loads((finished / "provenance.json").read_text())
    long = {f"{number}{'x' * 1000}": {"bytes": 1, "sha256": "0"} for number in range(100)}
    (finished / "provenance.json").write_text(json.dumps({**provenance, "inputs": {**provenance["inputs"], **long}}))
    told = reproduce(finished).lines
    assert len(told) == 14
    assert told[12:] == ("and 88 more", "the inputs are not those of the run, so it was not computed again")
    assert max(map(len, told)) < 120
    (finished / "provenance.json").write_text(json.dumps(provenance))
    nested = "[" * 900 + "]" * 900
    (finished / "results.json").write_text(f'{{"{"k" * 1000}": 1, "a": {nested}}}')
    monkeypatch.setattr(module, "run_campaign", giving('{"a": 1}'))
    assert reproduce(finished).lines[1] == f"{'k' * 57}...: null, was 1"
    assert reproduce(finished).lines[2].startswith("a: 1, was ")
