"""Campaigns of a fleet: found, and named apart."""

import pytest

from fusion.fleet.members import FleetError, find_members


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")


def test_campaigns_are_named_after_their_folders(tmp_path):
    touch(tmp_path, "hall/m2/X/campaign.toml", "hall/m1/X/campaign.toml", "hall/m1/Y/campaign.toml", "hall/notes.toml")
    assert [member.name for member in find_members([tmp_path / "hall"])] == ["m1/X", "m1/Y", "m2/X"]
    # A file that is named twice is one campaign; one alone has the name of its folder.
    twice = [tmp_path / "hall/m1/X", tmp_path / "hall/m1/X/campaign.toml"]
    assert [member.name for member in find_members(twice)] == ["X"]


def test_files_of_one_folder_are_told_apart_by_their_own_names(tmp_path):
    touch(tmp_path, "a/x.toml", "a/y.toml", "b/campaign.toml")
    paths = [tmp_path / "a/x.toml", tmp_path / "a/y.toml", tmp_path / "b"]
    assert [member.name for member in find_members(paths)] == ["a/x", "a/y", "b"]


def test_what_is_no_fleet_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FleetError, match=r"empty: holds no campaign.toml; name the campaign files"):
        find_members([tmp_path / "empty"])
    with pytest.raises(FleetError, match=r"gone: is not there"):
        find_members([tmp_path / "gone"])
    touch(tmp_path, "n/m1/campaign.toml", "n/m1/old/campaign.toml", "n/m2/campaign.toml")
    with pytest.raises(
        FleetError, match=r"old/campaign.toml: lies in the folder of .*m1/campaign.toml, so their results"
    ):
        find_members([tmp_path / "n"])


@pytest.mark.parametrize("name", ["logs", "Logs", "fleet.html"])
def test_a_campaign_does_not_take_a_name_of_the_fleet(tmp_path, name):
    for folder in (name, "x"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "campaign.toml").write_text("")
    with pytest.raises(
        FleetError, match=rf"{name}.campaign\.toml: its results would stand in the folder {name}, .*; rename the folder"
    ):
        find_members([tmp_path])
