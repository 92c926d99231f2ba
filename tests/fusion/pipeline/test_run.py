"""The main job end to end on a small campaign of the twin: products, truth, resumption, and everything left out being told."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import xarray as xr
from compliance_checker.runner import CheckSuite

from fusion.alignment.align import AlignmentError
from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import SourceError, read_source
from fusion.pipeline.interferometry import evaluate_interferometry
from fusion.pipeline.run import run_campaign
from fusion.pipeline.thermal import reduce_thermography
from fusion.products.contracts import check
from fusion.products.progress import silent
from fusion.products.results import results_schema
from fusion.products.store import OutputError, file_sha256, read_dataset
from fusion.twin.instruments import simulate_campaign
from thermography.contract import FIELDS
from thermography.io.openexr import read_maps


@pytest.fixture
def copied(campaign_folder: Path, tmp_path: Path) -> Path:
    """A copy of the campaign that a test may damage."""
    return shutil.copytree(campaign_folder, tmp_path / "campaign")


def shift_frames(folder: Path, hours: float) -> None:
    """Let the laser's clock run ahead of the camera's by rewriting the times of the readings."""
    path = folder / "laser.csv"
    lines = path.read_text().splitlines()
    shifted = [lines[0]]
    for line in lines[1:]:
        fields = line.split(",")
        time = np.datetime64(fields[4].split("+")[0]) + np.timedelta64(round(hours * 3600), "s")
        fields[4] = f"{time}+00:00"
        shifted.append(",".join(fields))
    path.write_text("\n".join(shifted) + "\n")


def test_all_products_are_written_and_keep_their_contracts(results_folder: Path) -> None:
    names = {path.name for path in results_folder.iterdir()}
    assert {
        "results.json",
        "report.html",
        "fields.nc",
        "deviations.nc",
        "fusion.nc",
        "maps",
        "provenance.json",
    } <= names
    results = json.loads((results_folder / "results.json").read_text())
    jsonschema.Draft202012Validator(results_schema()).validate(results)
    check(read_dataset(results_folder / "fields.nc"), FIELDS, name="fields.nc")
    assert len(list((results_folder / "maps").glob("cycle_*.exr"))) == 24
    assert not list(results_folder.rglob("*.partial*"))


def test_fields_pass_the_cf_checker(results_folder: Path) -> None:
    """CF-1.11 without an error or a warning; deviations and fusion carry the same global attributes."""
    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()
    dataset = suite.load_dataset(str(results_folder / "fields.nc"))
    groups, errors = suite.run_all(dataset, ["cf:1.11"])["cf:1.11"]
    assert errors == {}
    assert [message for group in groups if group.value[0] < group.value[1] for message in group.msgs] == []
    for name in ("fields", "deviations", "fusion"):
        product = read_dataset(results_folder / f"{name}.nc")
        assert product.attrs["Conventions"] == "CF-1.11" and product.attrs["title"] == "Small campaign"
        assert set(json.loads(product.attrs["provenance"])) == {"software", "versions", "inputs"}
        assert all({"long_name", "standard_name"} & set(variable.attrs) for variable in product.variables.values())


def test_maps_hold_the_fields_bit_by_bit(results_folder: Path) -> None:
    fields = read_dataset(results_folder / "fields.nc")
    maps = read_maps(results_folder / "maps" / "cycle_0024.exr")
    for name, variable in (
        ("temperature", "temperature"),
        ("rise", "temperature_rise"),
        ("uncertainty", "temperature_u"),
    ):
        expected = fields[variable].sel(cycle=24).values.astype("f4")
        seen = np.isfinite(expected)
        np.testing.assert_array_equal(maps[name][seen], expected[seen])
        np.testing.assert_array_equal(maps["mask"] > 0, np.isfinite(fields["temperature"].sel(cycle=24).values))


def test_the_undeclared_effect_of_the_twin_is_found(results_folder: Path) -> None:
    """The reversal drifts by 1.5 um at a noise of 0.3 um, which the signature (odd, in time) tells from everything else."""
    loop = json.loads((results_folder / "results.json").read_text())["loop"]
    assert [step["effect"] for step in loop["steps"]] == ["reversal_drift"]
    assert loop["rmse_final_um"] < loop["rmse_declared_um"]
    assert loop["noise_floor_um"] == pytest.approx(0.3, rel=0.2)


def test_readings_outside_the_frames_are_counted_and_not_extrapolated(results_folder: Path) -> None:
    fusion = read_dataset(results_folder / "fusion.nc")
    outside = fusion["deviation"].notnull() & (fusion["inside_frames"] == 0)
    warnings = {
        item["code"]: item["message"] for item in json.loads((results_folder / "results.json").read_text())["warnings"]
    }
    assert warnings["readings_outside_frames"].startswith(f"{int(outside.sum())} readings outside the frames' time")
    assert fusion["mean_rise"].where(outside).isnull().all()


def test_provenance_names_inputs_versions_and_no_machine(results_folder: Path, campaign_folder: Path) -> None:
    text = (results_folder / "provenance.json").read_text()
    provenance = json.loads(text)
    assert provenance["inputs"]["laser.csv"]["sha256"] == file_sha256(campaign_folder / "laser.csv")
    assert len([name for name in provenance["inputs"] if name.startswith("thermal/")]) == 24
    assert provenance["parameters"]["plan"]["cell_size_mm"] == 20.0
    assert str(campaign_folder.parent) not in text
    assert set(provenance["stage_seconds"]) == {"fields", "deviations", "correlation", "model"}


def test_a_resumed_run_redoes_only_what_changed(results_folder: Path, copied: Path, tmp_path: Path) -> None:
    out = shutil.copytree(results_folder, tmp_path / "results")
    done: list[str] = []
    run_campaign(copied / "campaign.toml", out, resume=True, report=lambda label, part, total: done.append(label))
    assert "frames" not in done and "correlation" not in done and "closed loop" not in done
    assert "thermal fields (kept)" in done

    text = (copied / "campaign.toml").read_text()
    (copied / "campaign.toml").write_text(text.replace('"axis_expansion", "table_offset"', '"axis_expansion"'))
    done.clear()
    results = run_campaign(
        copied / "campaign.toml", out, resume=True, report=lambda label, part, total: done.append(label)
    )
    assert "frames" not in done and "correlation" not in done and "closed loop" in done
    assert results["loop"]["declared"] == ["axis_expansion"]


def test_an_older_result_is_not_overwritten(results_folder: Path, campaign_folder: Path) -> None:
    before = (results_folder / "results.json").read_bytes()
    with pytest.raises(OutputError, match="is not empty; add --resume"):
        run_campaign(campaign_folder / "campaign.toml", results_folder)
    assert (results_folder / "results.json").read_bytes() == before


def test_damaged_frames_and_lines_are_left_out_by_name(copied: Path) -> None:
    frames = sorted((copied / "thermal").glob("*.jpg"))
    frames[3].write_bytes(frames[3].read_bytes()[:5000])
    frames[5].write_bytes(b"\xff\xd8\xff\xe0no radiometric data\xff\xd9")
    shutil.copy(frames[7], frames[7].with_name("copy_of_a_frame.jpg"))
    lines = (copied / "laser.csv").read_text().splitlines()
    lines[10] = lines[10].rsplit(",", 1)[0] + ",abc"
    lines[20] = lines[20].replace("positive", "upward").replace("negative", "upward")
    (copied / "laser.csv").write_text("\n".join(lines) + "\n")

    source = read_source(load_campaign(copied / "campaign.toml"))
    rejected = {item["file"]: item["reason"] for item in source.frames_rejected}
    assert set(rejected) == {
        f"thermal/{frames[3].name}", f"thermal/{frames[5].name}", f"thermal/{max(frames[7].name, 'copy_of_a_frame.jpg')}",
    }  # fmt: skip
    messages = {notice.code: notice.message for notice in source.notices}
    assert messages["frames_rejected"].startswith("3 frames left out: ")
    assert str(copied) not in messages["frames_rejected"]
    assert "2 lines of laser.csv left out: line 11 ('abc' is not a number)" in messages["readings_left_out"]
    assert "line 21 ('upward'" in messages["readings_left_out"]
    outcome = evaluate_interferometry(source)
    missing = {notice.code: notice for notice in outcome.notices}["readings_missing"]
    assert missing.message.startswith("2 readings of 288 missing, in ")
    # One reading of 24 at two cells: u grows by 1 - sqrt(23 / 24) = 2.1 %.
    assert missing.effect_um == pytest.approx(0.021 * float(outcome.dataset["drift_profile_u"].max()), rel=0.2)


def test_clocks_in_two_time_zones_are_refused_with_the_offset_to_write(copied: Path) -> None:
    shift_frames(copied, 1.0)
    with pytest.raises(
        AlignmentError, match=r'look 1 h apart, as in two time zones .* write thermography.clock_offset = "-3600 s"'
    ):
        read_source(load_campaign(copied / "campaign.toml"))
    text = (copied / "campaign.toml").read_text()
    (copied / "campaign.toml").write_text(text.replace('clock_offset = "0 s"', 'clock_offset = "-1 h"'))
    assert read_source(load_campaign(copied / "campaign.toml")).thermography.clock_offset_s == -3600


def test_recordings_of_two_days_are_refused(copied: Path) -> None:
    shift_frames(copied, 100.0)
    with pytest.raises(AlignmentError, match="frames and readings never meet"):
        read_source(load_campaign(copied / "campaign.toml"))


def test_a_single_frame_is_not_enough(copied: Path) -> None:
    for frame in sorted((copied / "thermal").glob("*.jpg"))[1:]:
        frame.unlink()
    message = r"1 usable frame, at least 12 are needed \(none rejected\); check thermography.frames"
    with pytest.raises(SourceError, match=message):
        read_source(load_campaign(copied / "campaign.toml"))


def test_a_short_test_is_refused_before_the_long_work(copied: Path) -> None:
    lines = (copied / "laser.csv").read_text().splitlines()
    short = [line for line in lines if line.split(",")[0] in {"cycle", "1", "2", "3", "4", "5"}]
    (copied / "laser.csv").write_text("\n".join(short) + "\n")
    message = (
        r"laser.csv: 5 cycles at 6 targets; a model of the drift needs at least 12 cycles \(better 50\) at 3 targets"
    )
    with pytest.raises(SourceError, match=message):
        read_source(load_campaign(copied / "campaign.toml"))


def test_residuals_lie_at_their_own_reading(results_folder: Path) -> None:
    """The residual of the declared model plus its profile and effects gives back the reading, so cells were not mixed up."""
    fusion = read_dataset(results_folder / "fusion.nc")
    for name in ("loop_residual_declared", "loop_residual_final"):
        assert fusion[name].dims == ("cycle", "direction", "target")
        both = fusion[name].notnull()
        xr.testing.assert_equal(both, fusion["inside_frames"].astype(bool) & fusion["deviation"].notnull())
    odd = fusion["loop_contribution"].sel(effect="reversal_drift")
    assert float(abs(odd.sel(direction="positive") + odd.sel(direction="negative")).max()) < 0.2 * float(abs(odd).max())


def test_the_clock_of_a_camera_that_sees_the_table_move_is_found(tmp_path: Path) -> None:
    """The clock is 37 s ahead and nobody says so; 13 s between frames do not divide the cycle, 0.2 s is a tenth of the dwell."""
    (tmp_path / "recipe.toml").write_text(
        "[campaign]\nseed = 3\n[test]\ncycles = 12\ntargets = 7\nspacing_mm = 40\nperiod_s = 200\n"
        '[camera]\ntable = "moving"\nfile = "seq"\ncolumns = 320\nrows = 240\nfocal_px = 600.0\ndistance_mm = 1900.0\n'
        "frame_interval_s = 13.0\nclock_offset_s = 37.0\nstate_clock_offset = false\n"
    )
    campaign = simulate_campaign(tmp_path / "recipe.toml", tmp_path / "campaign")
    campaign.write_text(campaign.read_text().replace('cell_size = "5 mm"', 'cell_size = "20 mm"'))
    outcome = reduce_thermography(
        read_source(load_campaign(campaign)), checkpoint=tmp_path / "cycles", scheduler=None, report=silent
    )
    assert outcome.parts["alignment"]["clock_offset_s"]["value"] == pytest.approx(37.0, abs=0.2)
    place = outcome.dataset["table_position"]
    assert float(place.max() - place.min()) == pytest.approx(240.0, abs=0.5)
    assert {"time", "frame_time"} <= set(outcome.dataset.coords)
