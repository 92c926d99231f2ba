"""The results folder: one run at a time, and nothing touched that no run wrote."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import filelock
import pytest

from fusion.products.folder import MANIFEST, claim, claim_file, open_folder, read_manifest
from fusion.products.store import OutputError, write_text


def test_a_folder_with_content_is_refused_unless_a_run_in_it_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with open_folder(folder, resume=False):
        claim(folder, "results.json", "maps/cycle_0001.exr")
        write_text(folder / "results.json", "{}")
    (folder / "maps").mkdir()
    for number in ("", "4711"):
        (folder / "maps" / f".cycle_0001.partial{number}.exr").touch()
    (folder / "maps" / ".cycle_0002.partial4711.exr").touch()
    (folder / "my.partial.notes").touch()
    with pytest.raises(OutputError) as error, open_folder(folder, resume=False):
        pass
    assert str(error.value) == (
        f"{folder} is not empty; add --resume to continue the run that is in it, name another folder with --out, or remove it first"
    )
    with open_folder(folder, resume=True):
        pass
    left = [path.name for path in (folder / "maps").iterdir()]
    assert left == [".cycle_0002.partial4711.exr"], "what an interrupted write left of this run, and nothing else"
    assert (folder / "my.partial.notes").exists(), "the user's own"
    with (
        pytest.raises(OutputError, match=r"is a file; name a folder for the results with --out"),
        open_folder(folder / "results.json", resume=False),
    ):
        pass


def test_files_that_no_run_wrote_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with (
        pytest.raises(OutputError, match=r"holds report\.html but no manifest\.json"),
        open_folder(tmp_path, resume=True),
    ):
        pass
    with pytest.raises(OutputError, match=r"report\.html was not written by thermofuse and is not replaced"):
        claim(tmp_path, "results.json", "report.html")
    assert (read_manifest(tmp_path), (tmp_path / MANIFEST).exists()) == ({}, False)
    (tmp_path / MANIFEST).write_text('{"software": "another"}')
    with pytest.raises(OutputError, match="is not the manifest of a results folder"):
        claim(tmp_path, "results.json")
    assert (tmp_path / "report.html").read_text() == "mine"


def test_a_folder_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """NetCDF takes names in UTF-8."""
    with pytest.raises(OutputError, match="is no text in UTF-8"), open_folder(tmp_path / "th\udcff", resume=False):
        pass


def test_a_second_run_is_told_who_holds_the_folder(tmp_path: Path) -> None:
    with open_folder(tmp_path / "out", resume=False) as folder:
        holder = json.loads((folder / ".stages" / "holder.json").read_text())
        assert (holder["host"], holder["pid"]) == (platform.node(), os.getpid())
        for resume in (False, True):
            with pytest.raises(OutputError) as error, open_folder(folder, resume=resume):
                pass
            assert str(error.value) == (
                f"{folder} is in use by another run (host {platform.node()}, process {os.getpid()}, since {holder['since']}); "
                "wait until it ends, or name another folder with --out"
            )
    assert not (folder / ".stages" / "holder.json").exists()


def test_the_lock_of_a_killed_run_is_taken_over_but_not_that_of_another_machine(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, signal, sys; from fusion.products.folder import open_folder\n"
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
    with pytest.raises(OutputError) as error, open_folder(tmp_path / "out", resume=True):
        pass
    assert str(error.value) == (
        f"{tmp_path / 'out'} is held by a run on another machine (host measuring-room, process 12, since 2026-03-09T06:30:00+00:00), and "
        f"whether it is still alive cannot be seen from here; if it has ended, remove {holder}"
    )


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    with pytest.raises(OutputError) as error, open_folder(tmp_path / "out", resume=False):
        pass
    assert (
        str(error.value)
        == f"{tmp_path / 'out'}: cannot be written to (Permission denied); name another folder with --out"
    )


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
    with pytest.raises(OutputError, match=r"mine\.html exists already; name another file with --out"):
        claim_file(results, "report.html", mine)


def test_results_within_results_are_refused(tmp_path: Path) -> None:
    for name in ("results.json", "manifest.json"):
        (tmp_path / name).write_text("{}")
    with (
        pytest.raises(
            OutputError, match=f"lies in {tmp_path}, which holds the results of a run; name a folder beside it"
        ),
        open_folder(tmp_path / "a" / "b", resume=False),
    ):
        pass
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("text", ["[1, 2]", "no JSON", '{"name": "a page"}'])
def test_the_manifest_of_somebody_else_is_not_replaced(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_text(text)
    with (
        pytest.raises(OutputError, match=r"manifest\.json is not the manifest of a results folder"),
        open_folder(tmp_path, resume=True) as folder,
    ):
        claim(folder, "report.html")
    assert (tmp_path / MANIFEST).read_text() == text
