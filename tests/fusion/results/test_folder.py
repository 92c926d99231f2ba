"""The results folder: one run at a time, and nothing touched that no run wrote."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import filelock
import pytest
import xarray as xr

from fusion.pipeline.run import run_campaign
from fusion.results.folder import MANIFEST, claim, claim_file, discard, open_folder, own_place, read_manifest
from fusion.results.store import (
    OutputError,
    StageStamps,
    file_sha256,
    read_json_object,
    read_product,
    write_json,
    write_text,
)


def refusal(folder: Path, *, resume: bool = False) -> str:
    """Return why a folder is not opened."""
    with pytest.raises(OutputError) as error, open_folder(folder, resume=resume):
        pass
    return str(error.value)


def test_a_folder_with_content_is_refused_unless_a_run_in_it_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with open_folder(folder, resume=False):
        claim(folder, "results.json", "maps/cycle_0001.exr")
        write_text(folder / "results.json", "{}")
    (folder / "maps").mkdir()
    for name in ("maps/.cycle_0001.partial.exr", "maps/.cycle_0001.partial4711.exr"):
        (folder / name).touch()
    own = [folder / "maps" / ".cycle_0002.partial4711.exr", folder / "my.partial.notes"]
    for path in own:
        path.touch()
    told = refusal(folder)
    assert told.startswith(f"{folder} is not empty") and "--resume" in told and "--out" in told
    with open_folder(folder, resume=True):
        pass
    assert list((folder / "maps").iterdir()) == own[:1], "what an interrupted write left of this run, and nothing else"
    assert own[1].exists()
    assert "results.json is a file" in refusal(folder / "results.json")


def test_files_that_no_run_wrote_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    assert f"holds report.html but no {MANIFEST}" in refusal(tmp_path, resume=True)
    with pytest.raises(OutputError, match=r"report\.html was not written by thermofuse"):
        claim(tmp_path, "results.json", "report.html")
    assert (read_manifest(tmp_path), (tmp_path / MANIFEST).exists()) == ({}, False)
    assert (tmp_path / "report.html").read_text() == "mine"


@pytest.mark.parametrize("text", ["[1, 2]", "no JSON", '{"name": "a page"}', '{"software": "another"}'])
def test_the_manifest_of_somebody_else_is_not_replaced(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_text(text)
    assert f"{MANIFEST} is not the manifest of a results folder" in refusal(tmp_path, resume=True)
    with pytest.raises(OutputError, match=f"{MANIFEST} is not the manifest"):
        claim(tmp_path, "results.json")
    assert (tmp_path / MANIFEST).read_text() == text


LEADING_OUT = (
    "maps/../../victim/file.txt", "{above}/victim/file.txt", "away/file.txt", "file", "loop/file.txt", "..", ".", "",
    "../results-2/file.txt", "C:/file.txt", "C:file.txt", "//host/share/file.txt", "maps\\..\\..\\victim\\file.txt", "maps/a\0b",
)  # fmt: skip


@pytest.mark.parametrize("name", LEADING_OUT)
def test_a_name_that_leads_out_of_a_results_folder_is_refused_by_name(tmp_path: Path, name: str) -> None:
    """In the manifest, in the stamps and where a product is to be written; by its parts, by a link in the folder, on Windows."""
    folder, victim = tmp_path / "results", tmp_path / "victim"
    victim.mkdir()
    (victim / "file.txt").write_text("precious")
    folder.mkdir()
    (folder / "away").symlink_to(victim)
    (folder / "file").symlink_to(victim / "file.txt")
    (folder / "loop").symlink_to(folder / "loop")
    name = name.format(above=tmp_path)
    with pytest.raises(OutputError) as claimed:
        claim(folder, "results.json", name)
    write_json(folder / MANIFEST, {"software": "thermofuse", "written": {name: "1", "results.json": "1"}})
    with pytest.raises(OutputError) as discarded:
        discard(folder, name)
    (folder / ".stages").mkdir()
    told = refusal(folder, resume=True)
    with pytest.raises(OutputError):
        own_place(folder, name)
    stamp = {"key": "x", "files": {name: file_sha256(victim / "file.txt")}, "note": {}}
    stamps = write_json(folder / ".stages" / "stamps.json", {"report": stamp})
    with pytest.raises(OutputError) as stamped:
        StageStamps(folder).done("report", "x")
    assert all(repr(name) in one for one in (told, *(str(error.value) for error in (claimed, discarded, stamped))))
    assert (victim / "file.txt").read_text() == "precious" and [*(folder / ".stages").iterdir()] == [stamps]


@pytest.mark.parametrize("link", [".stages", ".stages/lock", ".stages/cycles_0123", "maps"])
def test_a_run_writes_through_no_link_that_leads_out(tmp_path: Path, link: str) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / ".report.partial.html").touch()
    folder = tmp_path / "results"
    (folder / link).parent.mkdir(parents=True)
    write_json(folder / MANIFEST, {"software": "thermofuse", "written": {}})
    (folder / link).symlink_to(victim)
    with pytest.raises(OutputError) as error, open_folder(folder, resume=True):
        claim(folder, "maps/cycle_0001.exr")
    assert link in str(error.value) and [*victim.iterdir()] == [victim / ".report.partial.html"]


def test_a_results_folder_may_itself_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "results").symlink_to(tmp_path / "disk")
    with open_folder(tmp_path / "results", resume=False) as folder:
        claim(folder, "maps/cycle_0001.exr")
    assert set(read_manifest(tmp_path / "disk")) == {"maps/cycle_0001.exr"}


def test_a_folder_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """NetCDF takes names in UTF-8."""
    assert "is not valid UTF-8" in refusal(tmp_path / "th\udcff")


def test_a_second_run_is_told_who_holds_the_folder(tmp_path: Path) -> None:
    holder = tmp_path / "out" / ".stages" / "holder.json"
    with open_folder(tmp_path / "out", resume=False) as folder:
        since = json.loads(holder.read_text())["since"]
        for resume in (False, True):
            told = refusal(folder, resume=resume)
            assert f"{folder} is in use" in told
            assert f"host {platform.node()}, process {os.getpid()}, since {since}" in told
    assert not holder.exists()


def test_the_lock_of_a_killed_run_is_taken_over_but_not_that_of_another_machine(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, signal, sys; from fusion.results.folder import open_folder\n"
        "with open_folder(pathlib.Path(sys.argv[1]), resume=False): os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], check=False)
    assert killed.returncode < 0
    holder = tmp_path / "out" / ".stages" / "holder.json"
    assert holder.exists()
    with open_folder(tmp_path / "out", resume=True):
        pass
    assert not holder.exists()
    holder.write_text(json.dumps({"host": "measuring-room", "pid": 12, "since": "2026-03-09T06:30:00+00:00"}))
    told = refusal(tmp_path / "out", resume=True)
    assert "on another machine (host measuring-room, process 12, since 2026-03-09T06:30:00+00:00)" in told
    assert told.endswith(f"remove {holder}")


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    assert refusal(tmp_path / "out").startswith(f"{tmp_path / 'out'}: cannot be written to (Permission denied)")


def test_a_file_that_is_made_later_replaces_nothing_of_others(tmp_path: Path) -> None:
    results, mine = tmp_path / "results", tmp_path / "mine.html"
    results.mkdir()
    assert claim_file(results, "report.html", None) == results / "report.html"
    (results / "report.html").write_text("of thermofuse")
    assert claim_file(results, "report.html", None) == results / "report.html"
    (results / "report.pdf").write_text("of somebody")
    with pytest.raises(OutputError, match=r"report\.pdf was not written by thermofuse"):
        claim_file(results, "report.pdf", None)
    assert claim_file(results, "report.html", mine) == mine
    mine.write_text("of somebody")
    with pytest.raises(OutputError, match=r"mine\.html exists already"):
        claim_file(results, "report.html", mine)


def test_results_within_results_are_refused(tmp_path: Path) -> None:
    for name in ("results.json", MANIFEST):
        (tmp_path / name).write_text("{}")
    assert f"is in {tmp_path}" in refusal(tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()


@pytest.mark.usefixtures("no_charts", "few_effects")
def test_a_changed_campaign_computes_only_what_changed(
    campaign_folder: Path, results_folder: Path, tmp_path: Path
) -> None:
    """Without the expansion the model is another one; fields, deviations and correlation do not depend on what is declared."""
    campaign = shutil.copytree(campaign_folder, tmp_path / "campaign") / "campaign.toml"
    text = campaign.read_text(encoding="utf-8")
    changed = campaign.with_name("changed.toml")
    changed.write_text(text.replace('["axis_expansion", "table_offset"]', '["axis_expansion"]'), encoding="utf-8")
    assert changed.read_text(encoding="utf-8") != text
    branch = shutil.copytree(results_folder, tmp_path / "branch")
    told: list[str] = []
    results = run_campaign(changed, branch, resume=True, report=lambda label, done, total: told.append(label))
    kept = {label.removesuffix(" (kept)") for label in told if "(kept)" in label}
    assert kept == {"thermal fields", "deviations", "correlation"}
    assert results.loop is not None and results.loop.declared == ("axis_expansion",)


@pytest.mark.chain
def test_a_run_that_goes_on_after_other_readings_and_another_title_equals_a_fresh_one(
    copied: Path, results_folder: Path, tmp_path: Path, no_charts: None
) -> None:
    """There and back: what compensates the readings reduces no frame again, and every product carries the title and inputs of its run."""
    campaign, branch = copied / "campaign.toml", shutil.copytree(results_folder, tmp_path / "branch")
    own = campaign.read_text(encoding="utf-8")
    other = re.sub("dead_path = .*", 'dead_path = "300 mm"', own.replace("Small campaign", "Other title"))
    for text, title in ((other, "Other title"), (own, "Small campaign")):
        campaign.write_text(text, encoding="utf-8")
        report = Mock()
        run_campaign(campaign, branch, resume=True, report=report)
        assert {call.args[0] for call in report.mock_calls if "(kept)" in call.args[0]} == {"thermal fields (kept)"}
        inputs = read_json_object(branch / "provenance.json")["inputs"]
        for name in ("fields", "deviations", "fusion"):
            attributes = read_product(branch, name).attrs
            assert attributes["title"] == title and json.loads(attributes["provenance"])["inputs"] == inputs
    assert (branch / "results.json").read_bytes() == (results_folder / "results.json").read_bytes()
    for name in ("fields", "deviations", "fusion"):
        xr.testing.assert_equal(read_product(branch, name), read_product(results_folder, name))
