"""A simulated campaign is there whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from fusion.twin.folders import check_free, truth_folder, whole_folders
from fusion.twin.machine.recipe import RecipeError


def fill(campaign: Path, truth: Path) -> None:
    (campaign / "thermal").mkdir()
    for file in (campaign / "campaign.toml", campaign / "thermal" / "IR_0001.jpg", truth / "truth.json"):
        file.write_text("whole")


@pytest.mark.parametrize("exists", [False, True])
def test_both_folders_appear_when_both_are_whole(tmp_path: Path, exists: bool) -> None:
    out = tmp_path / "campaign"
    if exists:
        out.mkdir()
    with whole_folders(out) as (campaign, truth):
        fill(campaign, truth)
        assert not truth_folder(out).exists() and out.exists() == exists
    assert {path.name for path in out.iterdir()} == {"campaign.toml", "thermal"}
    assert {path.name for path in tmp_path.iterdir()} == {"campaign", "campaign-truth"}


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_what_fails_or_is_stopped_leaves_nothing(tmp_path: Path, exists: bool, fault: BaseException) -> None:
    out = tmp_path / "campaign"
    if exists:
        out.mkdir()
    with pytest.raises((RecipeError, KeyboardInterrupt)) as told, whole_folders(out) as (campaign, truth):
        fill(campaign, truth)
        raise fault
    assert [path.name for path in tmp_path.rglob("*")] == (["campaign"] if exists else [])
    if isinstance(fault, OSError):
        assert str(told.value) == (
            f"{out}: cannot be written (No space left on device), and nothing is left there; make room, allow writing there, "
            "or name another folder with --out"
        )


@pytest.mark.parametrize("existing", ["campaign", "campaign-truth"])
def test_what_cannot_be_put_in_place_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: str
) -> None:
    """An empty folder that exists, and that nothing can be written to; the other one can."""
    (tmp_path / existing).mkdir()
    rename = Path.rename

    def refused(self: Path, target: Path) -> Path:
        if target.parent == tmp_path / existing and target.name in ("thermal", "truth.json"):
            raise PermissionError(errno.EACCES, "Permission denied")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(RecipeError, match="nothing is left there"), whole_folders(tmp_path / "campaign") as folders:
        fill(*folders)
    assert [path.name for path in tmp_path.rglob("*")] == [existing]
    check_free(tmp_path / "campaign")


def test_a_reader_of_the_progress_who_left_is_no_fault_of_the_disk(tmp_path: Path) -> None:
    with pytest.raises(BrokenPipeError), whole_folders(tmp_path / "campaign"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert not list(tmp_path.iterdir())


def test_two_simulations_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with whole_folders(tmp_path / "campaign") as folders:
        with (
            pytest.raises(RecipeError, match=r"another simulation is writing there, or was killed; wait for it"),
            whole_folders(tmp_path / "campaign"),
        ):
            pass
        fill(*folders)
    assert {path.name for path in tmp_path.iterdir()} == {"campaign", "campaign-truth"}


def test_what_somebody_else_put_there_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    with (
        pytest.raises(RecipeError, match="not an empty folder"),
        whole_folders(tmp_path / "campaign") as folders,
    ):
        fill(*folders)
        (tmp_path / "campaign").mkdir()
        (tmp_path / "campaign" / "campaign.toml").write_text("mine")
    assert [path.name for path in tmp_path.iterdir()] == ["campaign"]
    assert (tmp_path / "campaign" / "campaign.toml").read_text() == "mine"


def test_a_folder_that_holds_something_and_the_root_of_a_disk_are_refused(tmp_path: Path, monkeypatch) -> None:
    check_free(tmp_path / "new")
    with pytest.raises(RecipeError, match=r"root of a disk.*name a folder in it"):
        monkeypatch.setattr(Path, "is_mount", lambda path: True)
        check_free(tmp_path / "new")
    (tmp_path / "new-truth").mkdir()
    (tmp_path / "new-truth" / "truth.json").write_text("{}")
    with pytest.raises(RecipeError, match="new-truth exists and is not an empty folder"):
        check_free(tmp_path / "new")
