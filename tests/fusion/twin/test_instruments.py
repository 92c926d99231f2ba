"""The twin writes the files of a laboratory, and nothing of the truth is in the folder that the analysis reads."""

from __future__ import annotations

import errno
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.twin import simulate
from fusion.twin.folders import check_free, truth_folder, whole_folders
from fusion.twin.instruments import simulate_campaign, write_campaign
from fusion.twin.recipe import Recipe, RecipeError
from fusion.twin.recipe_file import read_recipe
from interferometry.io.readings import read_deviations, read_environment
from thermography.io.flir import index_frames, read_frame

pytestmark = pytest.mark.long

RECIPE = """
[campaign]
title = "Three cycles"
seed = 4
[test]
cycles = 3
missing_fraction = 0.05
[camera]
clock_offset_s = 37.0
state_clock_offset = false
[[effect]]
name = "unseen_heat_source"
amplitude_um = 0.8
[[anomaly]]
target = 3
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("twin")
    (folder / "RECIPE.toml").write_text(RECIPE, encoding="utf-8")
    return simulate_campaign(folder / "RECIPE.toml", folder / "out")


@pytest.fixture(scope="module")
def truth(campaign) -> xr.Dataset:
    with xr.open_dataset(truth_folder(campaign.parent) / "truth.nc", engine="h5netcdf") as dataset:
        return dataset.load()


def test_campaign_file_names_what_is_there(campaign):
    content = tomllib.loads(campaign.read_text(encoding="utf-8"))
    folder = campaign.parent
    assert content["campaign"]["title"] == "Three cycles"
    assert len(list(folder.glob(content["thermography"]["frames"][0]))) == 3
    laser = content["interferometry"]
    for name in (content["plan"]["fiducials"], laser["deviations"], laser["environment"], content["drivers"]["file"]):
        assert (folder / name).is_file()
    assert "clock_offset" not in content["thermography"]


def test_truth_stands_beside_the_campaign_and_is_not_stated_in_it(campaign):
    beside = truth_folder(campaign.parent)
    assert {path.name for path in beside.iterdir()} == {"truth.nc", "truth.json"}
    for path in campaign.parent.rglob("*"):
        assert "truth" not in path.name
        if path.suffix in (".toml", ".csv"):
            text = path.read_text(encoding="utf-8")
            assert "unseen_heat_source" not in text
            assert "structural" not in text


def test_truth_json_says_what_was_done(campaign, truth):
    content = json.loads((truth_folder(campaign.parent) / "truth.json").read_text(encoding="utf-8"))
    assert content["undeclared"] == ["unseen_heat_source"]
    assert content["anomalies"][0]["target"] == 3
    assert content["clock_offset_s"] == 37.0
    assert content["parts_rms_um"]["unseen_heat_source"] == pytest.approx(0.8)
    assert set(content["parts_rms_um"]) <= set(truth.data_vars)


def test_laser_file_holds_the_readings_that_were_not_lost(campaign, truth):
    read = read_deviations(campaign.parent / "laser.csv")
    lost = truth["deviation"].isnull().values
    assert 0 < lost.sum() < lost.size / 4
    assert np.array_equal(np.isnan(read["deviation"].values), lost)
    # written with four decimals
    np.testing.assert_allclose(read["deviation"].values[~lost], truth["deviation"].values[~lost], atol=0.6e-4)
    assert np.array_equal(read["time"].values[~lost], truth["time"].values[~lost])
    np.testing.assert_allclose(read["position"].values, np.arange(16) * 20.0)


def test_frames_carry_the_cameras_clock_and_settings(campaign):
    references, rejected = index_frames(sorted((campaign.parent / "thermal").glob("*.jpg")))
    assert rejected == []
    # 194 s to the last reading, 30 s later the frame, 37 s of a camera clock that is ahead
    assert [str(r.time) for r in references][:2] == ["2026-03-09T06:34:21.000", "2026-03-09T06:38:33.000"]
    frame = read_frame(campaign.parent / "thermal" / "IR_0001.jpg")
    assert frame.counts.shape == (480, 640)
    assert frame.parameters.emissivity == pytest.approx(0.97)
    assert frame.parameters.object_distance_m == pytest.approx(1.76)
    assert frame.parameters.planck_r1 == pytest.approx(21106.77, abs=0.01)
    assert frame.camera.model == "FLIR SC660"
    assert 296.0 < frame.housekeeping["TSShutter"] < 300.0


def test_environment_and_drivers_cover_the_test(campaign):
    environment = read_environment(campaign.parent / "environment.csv")
    assert environment.sizes["time"] == 13
    assert float(abs(environment["air_pressure"] - 1000.0).max()) < 3.0
    rows = (campaign.parent / "drivers.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0] == "time,duty [1]"
    assert rows[1].startswith("2026-03-09T06:30:00.000+00:00,")


def test_empty_folder_is_used_and_progress_is_reported(tmp_path):
    (tmp_path / "out").mkdir()
    steps: list[tuple] = []
    write_campaign(
        simulate(Recipe().vary(test={"cycles": 2})), tmp_path / "out", progress=lambda *step: steps.append(step)
    )
    assert steps == [(1, 2, "render frames"), (2, 2, "render frames")]


def test_moving_table_is_written_as_a_sequence(tmp_path):
    recipe = Recipe().vary(test={"cycles": 1}, camera={"table": "moving", "file": "seq", "frame_interval_s": 40.0})
    path = write_campaign(simulate(recipe), tmp_path / "out")
    assert 'table = "moving"' in path.read_text(encoding="utf-8")
    references, rejected = index_frames([tmp_path / "out" / "thermal" / "IR_0001.seq"])
    assert (len(references), rejected) == (6, [])
    with xr.open_dataset(tmp_path / "out-truth" / "truth.nc", engine="h5netcdf") as truth:
        assert truth.sizes["frame"] == 6
        assert float(truth["table_position"].max()) > 100.0


def test_rtl_holds_the_same_deviations(tmp_path):
    truth = simulate(Recipe().vary(test={"cycles": 2}, laser={"file": "rtl"}))
    write_campaign(truth, tmp_path / "out")
    read = read_deviations(tmp_path / "out" / "laser.rtl")
    np.testing.assert_allclose(read["deviation"].values, truth.readings["deviation"].values, atol=0.6e-4)


def test_truth_holds_the_cell_means_of_the_true_field(campaign, truth):
    again = simulate(read_recipe(campaign.parent.parent / "RECIPE.toml"))
    expected = again.temperature(again.session.frame_s, truth["x"].values, truth["y"].values, cell_mm=2.5)
    # stored as float32
    np.testing.assert_allclose(truth["temperature"].values, expected, atol=5e-6)
    assert np.array_equal(truth["field_time"].values, again.clock(again.session.frame_s).astype("datetime64[ns]"))


# A simulated campaign is there whole or not at all.


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
        assert f"{out}: cannot be written (No space left on device), and nothing is left there" in str(told.value)


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
    with pytest.raises(RecipeError, match="not an empty folder"), whole_folders(tmp_path / "campaign") as folders:
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
