"""The main job end to end on a small campaign of the twin: products, truth, resumption, and everything left out being told."""

import json
import re
import shutil
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import xarray as xr

from fusion.campaign.time_zones import utc
from fusion.pipeline.run import run_campaign
from fusion.pipeline.workers import Worker, second_process
from fusion.results.folder import MANIFEST, read_manifest
from fusion.results.loop import AxisLoop
from fusion.results.progress import Report
from fusion.results.results import read_results
from fusion.results.store import check, file_sha256, read_dataset
from tests.fusion.campaign_parts import simulated
from thermography.common import FIELDS
from thermography.io.files import read_maps

pytestmark = pytest.mark.chain


def test_all_products_are_written_and_keep_their_contracts(results_folder):
    names = {"results.json", "report.html", "fields.nc", "deviations.nc", "fusion.nc", "maps", "provenance.json"}
    assert names <= {path.name for path in results_folder.iterdir()}
    check(read_dataset(results_folder / "fields.nc"), FIELDS, name="fields.nc")
    assert len(list((results_folder / "maps").glob("cycle_*.exr"))) == 24
    assert not list(results_folder.rglob("*.partial*"))
    written = set(read_manifest(results_folder))
    visible = [path for path in results_folder.rglob("*") if path.is_file() and ".stages" not in path.parts]
    assert written == {str(path.relative_to(results_folder)) for path in visible} - {MANIFEST}


def test_maps_hold_the_fields_bit_by_bit(results_folder):
    fields = read_dataset(results_folder / "fields.nc")
    maps = read_maps(results_folder / "maps" / "cycle_0024.exr")
    variables = {"temperature": "temperature", "rise": "temperature_rise", "uncertainty": "temperature_u"}
    for name, variable in variables.items():
        expected = fields[variable].sel(cycle=24).values.astype("f4")
        seen = np.isfinite(expected)
        np.testing.assert_array_equal(maps[name][seen], expected[seen])
    np.testing.assert_array_equal(maps["mask"] > 0, np.isfinite(fields["temperature"].sel(cycle=24).values))


def test_a_product_alone_places_the_plan(results_folder, campaign_folder):
    """Against the twin's view, and by the products' numbers in the lens model of OpenCV, which they name."""
    homography = read_dataset(results_folder / "fields.nc")["homography"]
    part = json.loads((results_folder / "results.json").read_text())["registration"]
    truth = json.loads(next(campaign_folder.parent.rglob("truth.json")).read_text())
    corners = np.array([[0.0, 0.0], [700.0, 0.0], [700.0, 180.0], [0.0, 180.0]])
    view, lens = np.array(truth["plan_to_sensor"]), truth["distortion"]
    ideal = cv2.perspectiveTransform(corners[None], view)[0]
    u = (ideal - lens["centre_px"]) / lens["focal_px"]
    seen = ideal + lens["focal_px"] * lens["k1"] * (u**2).sum(axis=1, keepdims=True) * u
    of_fields = [homography.attrs[name] for name in ("focal_length_px", "principal_point_px", "distortion_k1_k2_p1_p2")]
    of_results = [part[name] for name in ("focal_length_px", "principal_point_px", "distortion")]
    for matrix, (focal, centre, distortion) in ((homography.values, of_fields), (part["homography"], of_results)):
        camera = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
        often = (cv2.TERM_CRITERIA_COUNT, 40, 0.0)
        flat = cv2.undistortImagePoints(seen[None], camera, np.array(distortion, float), arg1=often)
        placed = cv2.perspectiveTransform(flat.reshape(1, -1, 2), np.array(matrix))[0]
        np.testing.assert_allclose(placed, corners, atol=0.05)
    header = OpenEXR.File(str(results_folder / "maps" / "cycle_0024.exr")).parts[0].header
    fields = read_dataset(results_folder / "fields.nc").sel(cycle=24)
    expected = {"unit": "degC", "cell_size_mm": 20.0, "first_column_x_mm": 10.0, "first_row_y_mm": 10.0, "cycle": 24}
    assert {name: header[name] for name in expected} == expected
    assert header["time"] == utc(fields["cycle_time"].values)


def test_the_undeclared_effect_of_the_twin_is_found(results_folder):
    """The reversal drifts by 1.5 um at a noise of 0.3 um, which the signature (odd, in time) tells from everything else."""
    loop = json.loads((results_folder / "results.json").read_text())["loop"]
    assert [step["effect"] for step in loop["steps"]] == ["reversal_drift"]
    assert loop["rmse_final_um"] < loop["rmse_declared_um"]
    assert loop["noise_floor_um"] == pytest.approx(0.3, rel=0.2)


def test_readings_outside_the_frames_are_counted_and_not_extrapolated(results_folder):
    fusion = read_dataset(results_folder / "fusion.nc")
    outside = fusion["deviation"].notnull() & (fusion["inside_frames"] == 0)
    assert "readings_outside_frames" in [warning.code for warning in read_results(results_folder).warnings]
    assert fusion["mean_rise"].where(outside).isnull().all()


def test_provenance_names_inputs_versions_and_no_machine(results_folder, campaign_folder):
    text = (results_folder / "provenance.json").read_text()
    provenance = json.loads(text)
    assert provenance["inputs"]["laser.csv"]["sha256"] == file_sha256(campaign_folder / "laser.csv")
    assert len([name for name in provenance["inputs"] if name.startswith("thermal/")]) == 24
    assert provenance["parameters"]["plan"]["cell_size_mm"] == 20.0
    assert str(campaign_folder.parent) not in text
    assert set(provenance["stage_seconds"]) == {"fields", "deviations", "correlation", "model"}


def test_a_whole_run_is_read_and_nothing_written(results_folder, copied, tmp_path):
    out = shutil.copytree(results_folder, tmp_path / "results")
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    campaign, told = copied / "campaign.toml", []
    results = run_campaign(campaign, out, resume=True, report=lambda label, part, total: told.append(label))
    assert told == ["run (kept)"]
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    assert results.as_json() == json.loads((out / "results.json").read_text())


class Noting(Worker):
    """A second process that notes what it is given, and does not take the last."""

    def __init__(self, second: Worker) -> None:
        super().__init__(second.faults)
        self.second, self.names = second, []

    def submit(self, work: Callable[..., Any], report: Report | None = None) -> Callable[[], Any]:
        # A stage is timed where it is computed; what is no function of a module cannot be sent.
        first = work.args[0]
        self.names.append(first if isinstance(first, str) else getattr(first, "func", work.func).__name__)
        return self.second.submit((lambda: work()) if first == "placed" else work, report)

    def end(self) -> None:
        self.second.end()


def test_a_second_process_takes_its_part_and_changes_nothing(results_folder, campaign_folder, tmp_path, monkeypatch):
    monkeypatch.setattr("fusion.pipeline.workers.usable_processors", lambda: 2)
    with second_process() as second:
        worker = Noting(second)
        run_campaign(campaign_folder / "campaign.toml", tmp_path / "results", worker=worker)
    assert worker.names == [
        "evaluate_interferometry", "correlate_field", "measured", "check_fields", "write_exr", "modelled", "placed",
    ]  # fmt: skip
    provenance = json.loads((tmp_path / "results" / "provenance.json").read_text())
    (fault,) = provenance["second_process_faults"]
    assert "pickle" in fault, "told, although nothing is lost"
    assert "second_process_faults" not in json.loads((results_folder / "provenance.json").read_text())
    for name in ("results.json", "maps/cycle_0001.exr"):
        assert (tmp_path / "results" / name).read_bytes() == (results_folder / name).read_bytes()
    for name in ("deviations.nc", ".stages/correlation.nc", ".stages/model.nc"):
        with xr.open_datatree(tmp_path / "results" / name) as one, xr.open_datatree(results_folder / name) as other:
            xr.testing.assert_equal(one, other)
    charts, same = (
        re.findall(r'id="figure-(\w+)"', (folder / "report.html").read_text())
        for folder in (tmp_path / "results", results_folder)
    )
    assert charts == same and len(charts) > 20


def test_the_errors_of_the_results_are_those_of_the_stored_readings(results_folder):
    """Root mean squares over the hold-out cycles, and over the blocks that were left out for every step."""
    fusion, loop = read_dataset(results_folder / "fusion.nc"), read_results(results_folder).loop
    assert isinstance(loop, AxisLoop) and loop.steps

    def rms(errors):
        return float(np.sqrt((errors**2).mean()))

    held_out = {name: fusion[f"loop_held_out_error_{name}"] for name in ("declared", "final", "last_value")}
    printed = {
        "declared": (loop.rmse_declared_um, loop.errors.declared.rmse_um),
        "final": (loop.rmse_final_um, loop.errors.final.rmse_um),
        "last_value": (loop.rmse_persistence_um, loop.baselines.last_value.rmse_um),
    }
    for name, figures in printed.items():
        assert figures == pytest.approx((rms(held_out[name]),) * 2, rel=1e-12)
        held = held_out[name]["cycle"].values[held_out[name].notnull().any(["direction", "target"]).values]
        assert f"cycles {held[0]} to {held[-1]} held out" in loop.held_out
    for k, step in enumerate(loop.steps):
        for stage, figure in (("before", step.cross_rmse_before_um), ("after", step.cross_rmse_after_um)):
            assert figure == pytest.approx(rms(fusion[f"loop_block_error_{stage}"].isel(step=k)), rel=1e-12)


def test_residuals_lie_at_their_own_reading(results_folder):
    """The residual of the declared model plus its profile and effects gives back the reading, so cells were not mixed up."""
    fusion = read_dataset(results_folder / "fusion.nc")
    for name in ("loop_residual_declared", "loop_residual_final"):
        assert fusion[name].dims == ("cycle", "direction", "target")
        both = fusion[name].notnull()
        xr.testing.assert_equal(both, fusion["inside_frames"].astype(bool) & fusion["deviation"].notnull())
    odd = fusion["loop_contribution"].sel(effect="reversal_drift")
    assert float(abs(odd.sel(direction="positive") + odd.sel(direction="negative")).max()) < 0.2 * float(abs(odd).max())


#: 30 cycles and 6 targets, small frames and cells of 20 mm: a run takes a few seconds.
RECIPE = """\
[campaign]
seed = 12
[test]
cycles = 30
targets = 6
spacing_mm = 50
period_s = 180
[duty]
kind = "random"
mean_hold_min = 12
[laser]
noise_um = 0.3
[camera]
columns = 320
rows = 240
focal_px = 700.0
"""


@pytest.mark.slow
@pytest.mark.usefixtures("no_charts")
def test_a_camera_step_is_taken_out_of_the_fields(tmp_path):
    offset = '[[effect]]\nname = "camera_offset"\namplitude_K = 0.6\nat_cycle = 14\n'
    folder = tmp_path / "results"
    results = run_campaign(simulated(tmp_path, RECIPE + offset), folder).as_json()
    # It shows beside the table, before any drift is looked at: the loop has nothing left to find.
    (step,) = results["camera"]["steps"]
    assert step["step_K"]["value"] == pytest.approx(0.6, abs=0.05)
    assert results["loop"]["steps"] == []
    fields = read_dataset(folder / "fields.nc")
    np.testing.assert_allclose(fields["camera_correction"][:13], 0.0, atol=1e-9)
    np.testing.assert_allclose(fields["camera_correction"][13:], -step["step_K"]["value"], atol=0.05)
    # The field no longer jumps: its largest change between two cycles is that of a warming table.
    assert float(np.abs(fields["temperature_rise"].mean(["y", "x"]).diff("cycle")).max()) < 0.3


def test_what_is_declared_and_what_could_be_found_are_told(results_folder):
    loop = json.loads((results_folder / "results.json").read_text())["loop"]
    assert loop["field_corrections"] == []
    expansion = loop["declared_coefficients"][0]
    assert (expansion["prior"], expansion["prior_u"]) == (11.7, 2.0)
    assert 0.0 < expansion["u"] < 2.0
    found = {one["effect"]: one for one in loop["identifiability"]}
    assert 0.0 < found["reversal_drift"]["detectable_um"] < found["thermal_lag"]["detectable_um"]
    assert "What this campaign can detect" in (results_folder / "report.html").read_text()
