"""Provenance: versions, hashes and parameters of a run, without names of machine or user."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fusion.campaign.config import load_campaign
from fusion.pipeline.provenance import (
    FileState,
    dependencies,
    describe_run,
    hash_files,
    input_states,
    kept_results,
    note_changes,
    refuse_other_campaign,
    versions,
)
from fusion.products.store import OutputError, write_json


def test_inputs_are_hashed_by_name(tmp_path: Path) -> None:
    (tmp_path / "laser.csv").write_bytes(b"readings")
    told: list[tuple[str, int, int]] = []
    hashed = hash_files({"laser.csv": tmp_path / "laser.csv"}, report=lambda *step: told.append(step))
    assert hashed == {"laser.csv": {"bytes": 8, "sha256": hashlib.sha256(b"readings").hexdigest()}}
    assert told == [("input files", 0, 1), ("input files", 1, 1)]


def test_a_run_is_described_without_a_folder(campaign_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = load_campaign(campaign_folder / "campaign.toml")
    monkeypatch.setattr(sys, "argv", ["/opt/bin/thermofuse", "run", str(campaign.path), "--resume"])
    folder = campaign.folder / "results"
    run = describe_run(campaign, {}, folder, started=datetime(2026, 3, 9, 6, 30, tzinfo=UTC), seconds={"fields": 1.234})
    assert run["command"] == ["thermofuse", "run", "campaign.toml", "--resume"]
    assert run["started"] == "2026-03-09T06:30:00+00:00" and run["stage_seconds"] == {"fields": 1.23}
    assert run["parameters"]["plan"]["cell_size_mm"] == 20.0 and "path" not in run["parameters"]
    assert run["products"] == {}


def test_the_results_of_another_campaign_are_not_replaced(copied: Path) -> None:
    folder, own = copied / "results", load_campaign(copied / "campaign.toml")
    hashed = hash_files(own.input_files())
    refuse_other_campaign(folder, own, hashed)
    written = describe_run(own, hashed, folder, started=datetime(2026, 3, 9, 6, 30, tzinfo=UTC), seconds={})
    write_json(folder / "provenance.json", written)
    other = load_campaign(shutil.copy(own.path, copied / "other.toml"))
    # A copy of the campaign file is for the same recordings; the same campaign file is for recordings that have grown.
    refuse_other_campaign(folder, other, hash_files(other.input_files()))
    for path in (own.resolve("laser.csv"), own.resolve("environment.csv"), *own.frame_paths()):
        path.write_bytes(path.read_bytes() + b"\n")
    refuse_other_campaign(folder, own, hash_files(own.input_files()))
    with pytest.raises(OutputError) as error:
        refuse_other_campaign(folder, other, hash_files(other.input_files()))
    assert str(error.value) == (
        f'{folder} holds the results of another campaign ("{own.campaign.title}", ../campaign.toml), which --resume would replace by those '
        f'of {other.path} ("{own.campaign.title}"); name another folder with --out, or remove this one first'
    )
    for damaged in ([], {"inputs": []}, {**written, "campaign_file": None}):
        write_json(folder / "provenance.json", damaged)
        refuse_other_campaign(folder, other, hash_files(other.input_files()))
    write_json(folder / "provenance.json", {**written, "parameters": ["x"]})
    with pytest.raises(OutputError, match=r"another campaign \(\.\./campaign\.toml\)"):
        refuse_other_campaign(folder, other, hash_files(other.input_files()))


def test_products_are_listed_with_their_hash(campaign_folder: Path, tmp_path: Path) -> None:
    campaign, folder = load_campaign(campaign_folder / "campaign.toml"), tmp_path / "results"
    (folder / "maps").mkdir(parents=True)
    (folder / "maps" / "cycle_0001.exr").write_bytes(b"map")
    run = describe_run(
        campaign,
        {},
        folder,
        started=datetime(2026, 3, 9, tzinfo=UTC),
        seconds={},
        products=[folder / "maps" / "cycle_0001.exr"],
    )
    assert run["products"] == {"maps/cycle_0001.exr": {"bytes": 3, "sha256": hashlib.sha256(b"map").hexdigest()}}


@pytest.mark.parametrize(
    ("folder", "place"),
    [
        ("results", "../campaign.toml"),
        ("", "campaign.toml"),
        ("../results", "../{}/campaign.toml"),
        ("../../x/results", None),
    ],
)
def test_the_campaign_file_is_found_from_the_results_without_naming_folders_of_the_user(
    campaign_folder: Path, folder: str, place: str | None
) -> None:
    campaign = load_campaign(campaign_folder / "campaign.toml")
    run = describe_run(campaign, {}, campaign.folder / folder, started=datetime(2026, 3, 9, tzinfo=UTC), seconds={})
    assert run["campaign_file"] == (None if place is None else place.format(campaign.folder.name))


def test_every_version_is_known() -> None:
    known = versions()
    assert known["python"].startswith("3.") and "not installed" not in {known["numpy"], known["xarray"]}


def test_inputs_that_change_during_a_run_are_told() -> None:
    before = {name: FileState(100, 1) for name in ("laser.csv", "a.jpg", "b.jpg", "c.jpg", "d.jpg")}
    after = {"laser.csv": FileState(140, 2), "e.jpg": FileState(100, 1)}
    assert note_changes(before, before) == []
    (notice,) = note_changes(before, after)
    assert (notice.code, notice.message) == (
        "inputs_changed",
        "Input files were altered while the run read them: 1 changed (laser.csv); 4 removed (a.jpg, b.jpg, c.jpg, ...); 1 added (e.jpg). "
        "Its products may mix two states of them.",
    )


def test_the_state_of_inputs_is_seen_without_reading_them(copied: Path) -> None:
    campaign = load_campaign(copied / "campaign.toml")
    before = input_states(campaign)
    assert set(before) == set(campaign.input_files())
    with (copied / "laser.csv").open("a") as laser:
        laser.write("\n")
    removed = sorted((copied / "thermal").iterdir())[0]
    removed.unlink()
    (notice,) = note_changes(before, input_states(campaign))
    assert f"1 changed (laser.csv); 1 removed (thermal/{removed.name})" in notice.message


def _other_input(campaign: Path, out: Path) -> None:
    """One digit of a reading: the size of the file stays."""
    text = (campaign / "laser.csv").read_text()
    (campaign / "laser.csv").write_text(text[:-3] + ("1" if text[-3] != "1" else "2") + text[-2:])


def _another_frame(campaign: Path, out: Path) -> None:
    frame = sorted((campaign / "thermal").iterdir())[0]
    shutil.copy(frame, frame.with_name("IR_9999.jpg"))


def _a_frame_less(campaign: Path, out: Path) -> None:
    sorted((campaign / "thermal").iterdir())[0].unlink()


def _other_title(campaign: Path, out: Path) -> None:
    path = campaign / "campaign.toml"
    path.write_text(path.read_text().replace("Small campaign", "Another title"))


def _missing_page(campaign: Path, out: Path) -> None:
    (out / "report.html").unlink()


def _damaged_map(campaign: Path, out: Path) -> None:
    path = out / "maps" / "cycle_0003.exr"
    path.write_bytes(path.read_bytes()[:-1] + b"x")


def _missing_stage(campaign: Path, out: Path) -> None:
    (out / ".stages" / "model.nc").unlink()


def _damaged_stamps(campaign: Path, out: Path) -> None:
    (out / ".stages" / "stamps.json").write_text('{"report": ')


@pytest.mark.parametrize(
    "change",
    [
        _other_input,
        _another_frame,
        _a_frame_less,
        _other_title,
        _missing_page,
        _damaged_map,
        _missing_stage,
        _damaged_stamps,
    ],
)
def test_a_run_is_whole_only_as_long_as_nothing_changed(
    change: Callable[[Path, Path], None], results_folder: Path, copied: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(results_folder, tmp_path / "results")
    assert kept_results(load_campaign(copied / "campaign.toml"), out) is not None
    change(copied, out)
    assert kept_results(load_campaign(copied / "campaign.toml"), out) is None


def test_a_run_of_another_version_is_not_whole(
    results_folder: Path, campaign_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = load_campaign(campaign_folder / "campaign.toml")
    assert kept_results(campaign, results_folder) is not None
    monkeypatch.setattr("fusion.pipeline.provenance.versions", lambda: {"thermofuse": "0.0.1"})
    assert kept_results(campaign, results_folder) is None


@pytest.mark.parametrize("group", ["thermofuse.effects", "thermofuse.frame_readers"])
def test_a_plug_in_whose_code_changes_under_one_version_ends_what_is_kept(
    group: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "kept_plates-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kept-plates\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\nplates = kept_plates:plates\n")
    code = tmp_path / "kept_plates.py"
    code.write_text("plates = 1\n")
    alone = dependencies()
    monkeypatch.syspath_prepend(str(tmp_path))
    before = dependencies()
    assert alone != before == dependencies()
    code.write_text("plates = 2\n")
    assert dependencies() != before


def test_a_folder_without_a_run_keeps_nothing(campaign_folder: Path, tmp_path: Path) -> None:
    assert kept_results(load_campaign(campaign_folder / "campaign.toml"), tmp_path / "absent") is None
