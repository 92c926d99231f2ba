"""Inspection goes through everything, whatever is in it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from fusion.products.store import OutputError
from fusion.starting.folder import scan_folder
from fusion.starting.inspection import inspect_paths, write_thumbnails
from fusion.starting.kinds import Kind


def test_a_folder_is_looked_into_and_its_series_summed_up(campaign_folder: Path) -> None:
    found = list(inspect_paths([campaign_folder]))
    assert [one.kind for one in found].count(Kind.FRAMES) == 1 and len(found) == 6
    assert not any(one.fails for one in found)
    assert sum(len(one.shown()) for one in found) < 40


def test_a_bad_file_stops_nothing(copied: Path) -> None:
    (copied / "laser.csv").write_text("cycle,direction,target,position_mm,time,deviation_um\nx,y,z,a,b,c\n")
    (copied / "notes.md").write_text("# Notes\n")
    absent = copied / "absent.csv"
    found = {Path(one.label).name: one for one in inspect_paths([absent, copied])}
    assert found["absent.csv"].fails and found["absent.csv"].fault == "No such file or directory"
    assert found["laser.csv"].fails
    # What nobody asked for and nothing reads is named, but is no failure.
    assert found["notes.md"].fault and not found["notes.md"].fails
    assert found["fiducials.csv"].lines and found["*.jpg"].lines
    assert json.loads(json.dumps([one.as_json() for one in found.values()]))[0]["fault"] == "No such file or directory"


def test_quiet_leaves_what_asks_for_action(copied: Path) -> None:
    assert [line for one in inspect_paths([copied]) for line in one.shown(quiet=True)] == []
    text = (copied / "laser.csv").read_text().replace("1,positive,1,", "1,sideways,1,", 1)
    (copied / "laser.csv").write_text(text)
    lines = [line for one in inspect_paths([copied]) for line in one.shown(quiet=True)]
    assert lines and all(line.startswith(f"{copied / 'laser.csv'}: warning: ") for line in lines)


def test_a_few_frames_are_described_one_by_one(campaign_folder: Path) -> None:
    frames = sorted((campaign_folder / "thermal").iterdir())[:2]
    assert [one.label for one in inspect_paths(frames)] == [str(frame) for frame in frames]


def test_thumbnails_of_the_same_name_are_kept_apart(campaign_folder: Path, tmp_path: Path) -> None:
    frame = sorted((campaign_folder / "thermal").iterdir())[0]
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.jpg").write_bytes(frame.read_bytes())
    (tmp_path / "a" / "damaged.jpg").write_bytes(frame.read_bytes()[:300])
    written = list(write_thumbnails([tmp_path / "a", tmp_path / "b"], tmp_path / "out"))
    assert [path.name for path in written] == ["x.jpg.png", "b_x.jpg.png"]
    with pytest.raises(OutputError, match=r"x\.jpg\.png exists already; name another folder with --thumbnails"):
        list(write_thumbnails([tmp_path / "a"], tmp_path / "out"))


def test_a_link_in_a_folder_whose_file_is_gone_is_named(copied: Path) -> None:
    (copied / "spindle.csv").symlink_to("moved/spindle.csv")
    found = {Path(one.label).name: one for one in inspect_paths([copied])}
    assert found["spindle.csv"].fails and len(found) == 7
    assert found["spindle.csv"].shown(quiet=True) == [
        f"{copied / 'spindle.csv'}: cannot be opened: a link to moved/spindle.csv, where there is no file"
    ]


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "x.jpg"
    os.mkfifo(pipe)
    (found,) = inspect_paths([pipe])
    assert found.kind is Kind.UNREADABLE and found.fails and "name a file" in found.fault
    (in_folder,) = inspect_paths([tmp_path])
    assert in_folder.fails and in_folder.fault == found.fault, "what stands in a folder is named as well"
    assert [one.path for one in scan_folder(tmp_path).unknown] == [pipe]


def test_a_folder_without_files_is_told(tmp_path: Path) -> None:
    (tmp_path / ".hidden").touch()
    (found,) = inspect_paths([tmp_path])
    assert found.fails and found.fault.startswith("holds no file to look into")
