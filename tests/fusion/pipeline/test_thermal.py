"""The thermal stage: notices about the camera, the clock offset of a moving table, and fields that keep the CF conventions."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from compliance_checker.runner import CheckSuite

from fusion.campaign.config import ThermographyTable, load_campaign
from fusion.campaign.inputs import SourceError, overridden_parameters, read_source
from fusion.pipeline.consistency import check_plan
from fusion.pipeline.thermal import (
    camera_corrected,
    clock_notices,
    complete_fields,
    pixel_notices,
    reduce_thermography,
    stated_uncertainty,
)
from fusion.results.progress import silent
from fusion.results.results import Outcome, assemble
from fusion.results.store import read_dataset
from fusion.twin import simulate
from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import Recipe
from fusion.twin.simulate import Truth
from tests.fusion.campaign_parts import change, simulated
from tests.thermography.flir_mutations import without_checksums
from thermography.common import ThermographyError
from thermography.io.flir import index_frames
from thermography.radiometry.camera import find_bad_pixels
from thermography.radiometry.planck import Overrides, counts_from_temperature, temperature_from_counts
from thermography.radiometry.uncertainty import InputUncertainty
from thermography.registration.clock_offset import ClockOffset
from thermography.registration.register import RegistrationError


def test_bad_pixels_are_counted_by_kind(rng):
    counts = np.round(16000 + 2.0 * np.arange(80) + rng.normal(0, 8, (24, 60, 80))).astype(np.uint16)
    assert list(pixel_notices(find_bad_pixels(counts), "are left out of the fields")) == []
    counts[:, 20, 30] = 16060
    counts[:, 40, 50] += 900
    counts[:, 10, 70] = 16140 + np.round(rng.normal(0, 400, 24)).astype(np.int64)
    (notice,) = pixel_notices(find_bad_pixels(counts), "are left out of the fields")
    assert notice.code == "bad_pixels"
    assert notice.message.startswith("Pixels that do not follow their neighbours: 3 (1 dead, ")
    assert "off its neighbours" in notice.message
    assert notice.message.endswith("1 noisy); they are left out of the fields.")


def test_the_offset_of_a_periodic_test_is_said_as_an_assumption():
    clock = ClockOffset(37.0, 0.1, 0.0, 0.0, 0.0, 300.0, 0.1, 60)
    assert list(clock_notices(clock)) == []
    (notice,) = clock_notices(replace(clock, rivals_s=(-215.0, 289.0)))
    assert notice.code == "clock_offset_periodic"
    assert "clock offsets of -215.0 s; 289.0 s fit about as well as 37.0 s" in notice.message


def test_fields_pass_the_cf_checker(results_folder):
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


@pytest.mark.chain
@pytest.mark.slow
def test_the_clock_of_a_camera_that_sees_the_table_move_is_found(tmp_path):
    """The clock is 37 s ahead and nobody says so; 13 s between frames do not divide the cycle.

    The twin reads just before the table leaves. Nobody says so either: the offset is that of the middle of the stand of 2 s.
    """
    recipe = (
        "[campaign]\nseed = 3\n[test]\ncycles = 4\ntargets = 7\nspacing_mm = 40\nperiod_s = 200\n"
        '[camera]\ntable = "moving"\nfile = "seq"\ncolumns = 320\nrows = 240\nfocal_px = 600.0\ndistance_mm = 1900.0\n'
        "frame_interval_s = 13.0\nclock_offset_s = 37.0\nstate_clock_offset = false\n"
    )
    outcome = _reduce(simulated(tmp_path, recipe))
    clock = outcome.parts.alignment.clock_offset_s
    assert clock.value == pytest.approx(37.0 - 2.0 / 2, abs=0.2) and abs(clock.value - 37.0) < 2 * clock.u
    assert clock.u == pytest.approx(2.0 / np.sqrt(12), rel=0.1)
    place = outcome.dataset["table_position"]
    assert float(place.max() - place.min()) == pytest.approx(240.0, abs=0.5)
    assert {"time", "frame_time"} <= set(outcome.dataset.coords)


@pytest.mark.chain
def test_points_picked_by_hand_and_a_calibrated_lens_serve_a_campaign(tmp_path):
    """A table without painted discs, and the lens that the recipe gave the camera; a wrong list is refused by its name."""
    recipe = (
        "[campaign]\nseed = 4\n[plan]\nhint_error_px = 0.7\n[test]\ncycles = 12\ntargets = 5\nperiod_s = 120\n"
        '[camera]\nfile = "seq"\ncolumns = 320\nrows = 240\nfocal_px = 600.0\ndistance_mm = 1500.0\nframes_per_cycle = 1\n'
    )
    campaign = change(simulated(tmp_path, recipe), "[thermography]", '[thermography]\nlens = "lens.json"')
    (campaign.parent / "lens.json").write_text(
        '{"K": [[600, 0, 159.5], [0, 600, 119.5], [0, 0, 1]], "D": [-0.3, 0, 0, 0], "image_width": 320, "image_height": 240}'
    )
    fiducials = pd.read_csv(campaign.parent / "fiducials.csv")

    def registered(table):
        table.to_csv(campaign.parent / "fiducials.csv", index=False)
        part = _reduce(campaign).parts.registration
        source = read_source(load_campaign(campaign))
        assert [check.code for check in check_plan(source, part) if not check.passed] == []
        return part

    by_discs = registered(fiducials)
    assert by_discs.model == "calibrated lens + homography"
    assert max(by_discs.rms_mm, by_discs.position_u_mm) < 0.1
    # Places as read off a screen: whole pixels with the twin's error of a hint, 5 mm each.
    by_points = registered(fiducials.assign(diameter_mm=np.nan))
    assert by_discs.position_u_mm < 0.1 * by_points.position_u_mm
    with pytest.raises(RegistrationError, match=r"^fiducials\.csv: the table cannot be located: places and diameters"):
        registered(fiducials.assign(diameter_mm=2 * fiducials["diameter_mm"]).iloc[[0, 4, 5, 9, 10]])


CYCLES = 24


def _campaign(folder: Path, *, room: dict[str, float] | None = None, **camera: float) -> tuple[Truth, Path]:
    small = {"columns": 320, "rows": 240, "focal_px": 765.0, "file": "seq", **camera}
    test = {"cycles": CYCLES, "targets": 5}
    truth = simulate(Recipe().vary(campaign={"seed": 8}, test=test, room=room or {}, camera=small))
    return truth, change(write_campaign(truth, folder), 'cell_size = "5 mm"', 'cell_size = "20 mm"')


def _reduce(campaign: Path) -> Outcome:
    source = read_source(load_campaign(campaign))
    return reduce_thermography(source, checkpoint=campaign.parent / "cycles", scheduler=None, report=silent)


def _error_of_rise(truth: Truth, outcome: Outcome) -> np.ndarray:
    fields = outcome.dataset
    true = truth.temperature(truth.session.frame_s, fields["x"].values, fields["y"].values, cell_mm=20.0)
    return fields["temperature_rise"].values - (true - true[0])


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return _campaign(tmp_path_factory.mktemp("sound") / "campaign")


@contextmanager
def _damaged(campaign: Path, frames: Iterable[int], data: bytes, *, checksums: bool = True) -> Iterator[None]:
    """Replace some bytes of frames, from the middle of their pixels on, for a while."""
    path = campaign.parent / "thermal" / "IR_0001.seq"
    whole = path.read_bytes()
    changed = bytearray(whole)
    for reference in (index_frames([path])[0][frame] for frame in frames):
        place = reference.segments[0][0] + reference.samples.offset + reference.samples.length // 2
        changed[place : place + len(data)] = data
    path.write_bytes(bytes(changed) if checksums else without_checksums(bytes(changed)))
    try:
        yield
    finally:
        path.write_bytes(whole)


@pytest.mark.chain
def test_steps_and_drift_are_taken_out_before_the_fields_are_made(tmp_path):
    truth, campaign = _campaign(tmp_path / "campaign", ffc_step_K=0.3, drift_K_per_K=0.1)
    outcome = _reduce(campaign)
    part, fields = outcome.parts.camera, outcome.dataset
    planted = truth.frames["camera_offset_K"].values
    assert part.steps and part.drift_K > 0.3 and camera_corrected(part)
    codes = {notice.code for notice in outcome.notices}
    assert {"camera_steps_corrected", "camera_drift_corrected"} <= codes
    error = np.nanmean(_error_of_rise(truth, outcome), axis=(1, 2))
    assert np.ptp(planted) > 0.5
    # The mean over the table has hardly any noise: what remains is the camera. Its errors add up, so that this is about one draw.
    assert np.sqrt(np.mean(error**2)) < 0.08
    assert np.sqrt(np.mean((error[1:] / fields["camera_correction_u"].values[1:]) ** 2)) < 3.0
    assert fields["camera_correction"].values == pytest.approx(-(planted - planted[0]) / 0.963, abs=0.12)
    assert fields["camera_correction_u"].values[0] == 0.0


@pytest.mark.chain
def test_a_reference_patch_carries_the_correction(tmp_path):
    """The wall of a room that keeps its temperature serves as the patch; no log of the air is needed."""
    truth, campaign = _campaign(tmp_path / "campaign", room={"swing_K": 0.0, "trend_K_per_h": 0.0}, ffc_step_K=0.3)
    change(campaign, 'environment = "environment.csv"\n', "")
    change(campaign, "[thermography]\n", "[thermography]\nreference_patch = [10, 10, 60, 20]\n")
    outcome = _reduce(campaign)
    planted = truth.frames["camera_offset_K"].values
    # The room still wanders by some hundredths of a kelvin.
    assert outcome.dataset["camera_correction"].values == pytest.approx(-(planted - planted[0]) / 0.963, abs=0.15)
    change(campaign, "[10, 10, 60, 20]", "[300, 10, 60, 20]")
    with pytest.raises(SourceError, match=r"reference_patch = \[300, 10, 60, 20\]: leaves the frames of 320 x 240"):
        _reduce(campaign)
    change(campaign, "[300, 10, 60, 20]", "[150, 110, 12, 12]")
    with pytest.raises(SourceError, match=r"reference_patch = \[150, 110, 12, 12\]: 100 % of its pixels show the plan"):
        _reduce(campaign)


@pytest.fixture(scope="module")
def sound_outcome(sound):
    return _reduce(sound[1])


def test_a_sound_camera_is_left_alone(sound_outcome):
    part = sound_outcome.parts.camera
    assert part.steps == () and part.drift_K == 0.0 and part.frames_damaged == ()
    assert not camera_corrected(part)
    assert (sound_outcome.dataset["camera_correction"] == 0).all()
    assert 0 < part.largest_u_K < 0.05
    assert not [notice for notice in sound_outcome.notices if notice.code.startswith(("camera", "frames"))]


@pytest.mark.parametrize(
    ("data", "checksums"),
    [(bytes(2000), True), (np.random.default_rng(3).bytes(2000), False)],
    ids=["2 kB zeros", "2 kB random without CRC"],
)
def test_a_damaged_frame_costs_only_itself(sound, sound_outcome, data, checksums):
    with _damaged(sound[1], [10], data, checksums=checksums):
        outcome = _reduce(sound[1])
    (frame,) = outcome.parts.camera.frames_damaged
    assert frame.file == "thermal/IR_0001.seq" and frame.index == 10 and "damaged" in frame.reason
    assert frame in outcome.parts.registration.frames_rejected
    (notice,) = [notice for notice in outcome.notices if notice.code == "frames_damaged"]
    assert notice.message.startswith("1 frame left out: thermal/IR_0001.seq (")
    before, after = (one.dataset["temperature"].values for one in (sound_outcome, outcome))
    others = np.arange(CYCLES) != 10
    np.testing.assert_array_equal(after[others], before[others])
    assert np.isnan(after[10]).all()


def test_a_campaign_whose_frames_are_all_damaged_says_so(sound):
    with (
        _damaged(sound[1], range(CYCLES), b"damage"),
        pytest.raises(ThermographyError, match=r"pixels of all 24 frames are damaged .*copy the files again"),
    ):
        _reduce(sound[1])


ADDED = ("temperature_u", "temperature_rise_u", "rise_scale_u", "rise_reflected_u")
REGION = '\n[[thermography.region]]\nname = "steel"\nrectangle = [["80 mm", "20 mm"], ["240 mm", "160 mm"]]\n'


def completed(campaign: Path, results_folder: Path, *changes: tuple[str, str], region: str = "") -> Outcome[xr.Dataset]:
    """The fields of the small campaign, completed once more after changes of its file."""
    changed = campaign.with_name("changed.toml")
    changed.write_text(campaign.read_text() + region)
    for old, new in changes:
        change(changed, old, new)
    source = read_source(load_campaign(changed))
    fields = read_dataset(results_folder / "fields.nc").drop_vars(ADDED)
    return complete_fields(source, fields, Overrides(overridden_parameters(source.thermography)))


@pytest.fixture
def campaign(copied):
    return copied / "campaign.toml"


def test_stated_uncertainties_replace_the_defaults():
    table = ThermographyTable(
        frames=("a.jpg",),
        emissivity="0.9 +- 0.02",
        reflected_temperature="22 +- 2 degC",
        camera_scale_u="1 %",
        window_transmission=0.9,
    )
    inputs = stated_uncertainty(table)
    assert (inputs.emissivity, inputs.reflected_temperature_K, inputs.camera_scale) == (0.02, 2.0, 0.01)
    assert inputs.camera_offset_K == InputUncertainty().camera_offset_K
    parameters = overridden_parameters(table)
    assert parameters == {"emissivity": 0.9, "reflected_temperature_K": 295.15, "window_transmission": 0.9}


@pytest.mark.parametrize(
    ("emissivity", "u"), [(0.97, 0.02), (0.87, 0.02), (0.35, 0.03), (None, 0.03), ("0.35 +- 0.05", 0.05)]
)
def test_an_emissivity_is_as_well_known_as_stated_or_as_its_paint(emissivity, u):
    assert stated_uncertainty(ThermographyTable(frames=("a.jpg",), emissivity=emissivity)).emissivity == u


def test_an_emissivity_is_assumed_where_the_place_of_the_material_sensor_is_not_stated(campaign, results_folder):
    text = campaign.read_text()
    place = next(line for line in text.splitlines() if line.startswith("material_sensor"))
    radiometry = completed(campaign, results_folder, (place + "\n", "")).parts.radiometry
    entry = radiometry.budget[0]
    assert (entry.input, entry.source, entry.u) == ("emissivity", "assumed", 0.02)
    # 0.02 / 0.97 and the scale of the camera, 1.15 %, make 2.36 %; that no emissivity exceeds 1 leaves nine tenths of it.
    assert radiometry.rise_scale_u == pytest.approx(0.0212, abs=0.001)


def test_results_give_both_parts_and_say_what_was_assumed(results_folder):
    part = json.loads((results_folder / "results.json").read_text())["radiometry"]
    temperature, rise = part["temperature_u"], part["rise_u"]
    # Absolute temperatures carry the camera's accuracy, rises the scale; the noise of a cell is some millikelvin.
    assert temperature["noise_K"] < 0.02 and 1.0 < temperature["common_K"] < 1.5
    assert rise["total_K"] == pytest.approx(np.hypot(rise["noise_K"], rise["common_K"]), rel=1e-6)
    # Contact of the material sensor, whose place is stated, 2 %; scale of the camera 1.2 %.
    assert part["rise_scale_u"] == pytest.approx(0.0242, abs=0.002)
    sources = {entry["input"]: entry["source"] for entry in part["budget"]}
    assert {sources.pop(name) for name in ("camera_drift_K", "reflected_change_K", "emissivity")} == {"measured"}
    assert set(sources.values()) == {"assumed"}
    total = np.sqrt(sum(entry["temperature_u_K"] ** 2 for entry in part["budget"]))
    assert total == pytest.approx(temperature["common_K"], rel=0.02)
    html = (results_folder / "report.html").read_text()
    assert "are common to all; rise" in html and "Uncertainty budget of temperature and rise" in html


def test_a_stated_emissivity_is_its_share_of_every_rise(campaign, results_folder):
    exact = '\nreflected_temperature_u = "0 K"\natmospheric_temperature_u = "0 K"\nrelative_humidity_u = 0.0\nobject_distance_u = "0 m"\n'
    camera = 'camera_offset_u = "0 K"\ncamera_scale_u = 0.0'
    stated = ("emissivity = 0.97", f'emissivity = "0.97 +- 0.0097"{exact}{camera}')
    outcome = completed(campaign, results_folder, stated)
    assert outcome.parts.radiometry.rise_scale_u == pytest.approx(0.01, rel=0.05)
    first = outcome.parts.radiometry.budget[0]
    assert (first.input, first.source) == ("emissivity", "stated")
    rise, u = (outcome.dataset[name].isel(cycle=-1) for name in ("temperature_rise", "temperature_rise_u"))
    common = np.sqrt(u**2 - outcome.dataset["temperature_rise_noise_u"].isel(cycle=-1) ** 2)
    zero = float(outcome.dataset["camera_correction_u"][-1])
    warm = (rise > 1.0).values
    np.testing.assert_allclose(common.values[warm], np.hypot(0.01 * rise, zero).values[warm], rtol=0.08)


@pytest.mark.parametrize(("stated_K", "taken"), [(2.0, "stated"), (0.001, "measured")])
def test_the_larger_of_stated_and_measured_drift_is_taken_and_said(campaign, results_folder, stated_K, taken):
    stated = ("emissivity = 0.97", f'emissivity = 0.97\ncamera_drift_u = "{stated_K} K"')
    outcome = completed(campaign, results_folder, stated)
    entry = next(item for item in outcome.parts.radiometry.budget if item.input == "camera_drift_K")
    left_K = float(outcome.dataset["camera_correction_u"].max())
    assert entry.source == taken and entry.u == pytest.approx(max(stated_K, left_K))
    u = float(outcome.dataset["temperature_rise_u"].isel(cycle=-1).mean())
    assert (u > stated_K) if taken == "stated" else (u < 1.0)
    notice = next(item for item in outcome.notices if item.code == "camera_drift_stated")
    assert "The larger was taken" in notice.message


def test_a_stated_change_of_what_is_reflected_replaces_what_log_and_discs_show(campaign, results_folder):
    shown = read_dataset(results_folder / "fields.nc")["rise_reflected_u"].values
    stated = ("emissivity = 0.97", 'emissivity = 0.97\nreflected_change_u = "2 K"')
    outcome = completed(campaign, results_folder, stated)
    entry = next(item for item in outcome.parts.radiometry.budget if item.input == "reflected_change_K")
    assert (entry.u, entry.source) == (2.0, "stated")
    found = outcome.dataset["rise_reflected_u"].values
    assert found[0] == 0.0 and found[1:] == pytest.approx(2.0 * 0.03 / 0.97, rel=0.05)
    assert (shown[1:] < found[1:]).all()


def test_a_region_is_calibrated_with_its_own_emissivity(campaign, results_folder):
    outcome = completed(campaign, results_folder, region=REGION + 'emissivity = "0.5 +- 0.02"\n')
    before, after = read_dataset(results_folder / "fields.nc"), outcome.dataset
    inside = {"x": slice(120, 200), "y": slice(60, 120)}
    source = read_source(load_campaign(campaign))
    camera = Overrides(overridden_parameters(source.thermography))(source.frames[0])
    for name in ("temperature", "frame_temperature"):
        counts = counts_from_temperature(before[name].sel(inside).values, camera)
        expected = temperature_from_counts(counts, camera, emissivity=0.5)
        np.testing.assert_allclose(after[name].sel(inside).values, expected, atol=1e-3)
    steel, rest = (after["rise_scale_u"].sel(x=x, y=90, method="nearest") for x in (160, 400))
    assert steel > 1.5 * rest
    (notice,) = outcome.notices
    assert notice.message.endswith("cells at the edges of region steel see two surfaces and were left empty.")
    part = outcome.parts.radiometry
    assert [surface.name for surface in part.surfaces] == ["", "steel"]
    assert part.edge_cells == int(notice.message.split()[0]) > 0
    assert assemble("x", outcome.parts, outcome.notices).radiometry is not None


def test_the_emissivity_of_a_region_comes_from_two_states(campaign, results_folder):
    """The table of the twin is painted: what the camera reads in two cycles, taken as contact temperatures, gives 0.97 again."""
    fields = read_dataset(results_folder / "fields.nc").sel(x=slice(100, 220), y=slice(40, 140))["temperature"]
    first, last = (float(fields.sel(cycle=cycle).mean()) for cycle in (1, 24))
    known = (f'{{cycle = {n}, temperature = "{celsius:.4f} +- 0.01 degC"}}' for n, celsius in ((1, first), (24, last)))
    states = f"states = [{', '.join(known)}]\n"
    outcome = completed(campaign, results_folder, region=REGION + states)
    steel = outcome.parts.radiometry.surfaces[1]
    assert steel.source == "two states"
    assert steel.emissivity.value == pytest.approx(0.97, abs=3 * steel.emissivity.u)
    assert steel.emissivity.u < 0.1


def test_an_emissivity_that_may_be_nothing_is_refused(campaign, results_folder):
    with pytest.raises(ThermographyError, match=r"emissivity 0\.1 with a standard uncertainty of 0\.06: .*paint the"):
        completed(campaign, results_folder, region=REGION + 'emissivity = "0.1 +- 0.06"\n')
