"""The camera before the fields are made: steps and drift are taken out, damaged frames left out, a sound camera left alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import SourceError, read_source
from fusion.pipeline.camera import camera_corrected
from fusion.pipeline.thermal import reduce_thermography
from fusion.products.progress import silent
from fusion.products.results import Outcome
from fusion.twin import simulate
from fusion.twin.instruments import write_campaign
from fusion.twin.machine.recipe import Recipe
from fusion.twin.simulate import Truth
from tests.thermography.flir_mutations import without_checksums
from thermography.errors import ThermographyError
from thermography.io.flir import index_frames

CYCLES = 24


def _campaign(folder: Path, *, room: dict[str, float] | None = None, **camera: float) -> tuple[Truth, Path]:
    small = {"columns": 320, "rows": 240, "focal_px": 765.0, "file": "seq", **camera}
    test = {"cycles": CYCLES, "targets": 5}
    truth = simulate(Recipe().vary(campaign={"seed": 8}, test=test, room=room or {}, camera=small))
    campaign = write_campaign(truth, folder)
    campaign.write_text(campaign.read_text().replace('cell_size = "5 mm"', 'cell_size = "20 mm"'))
    return truth, campaign


def _reduce(campaign: Path) -> Outcome:
    source = read_source(load_campaign(campaign))
    return reduce_thermography(source, checkpoint=campaign.parent / "cycles", scheduler=None, report=silent)


def _error_of_rise(truth: Truth, outcome: Outcome) -> np.ndarray:
    fields = outcome.dataset
    true = truth.temperature(truth.session.frame_s, fields["x"].values, fields["y"].values, cell_mm=20.0)
    return fields["temperature_rise"].values - (true - true[0])


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[Truth, Path]:
    return _campaign(tmp_path_factory.mktemp("sound") / "campaign")


def _damage(campaign: Path, frame: int, data: bytes, *, checksums: bool = True) -> None:
    """Replace some bytes of one frame, from the middle of its pixels on."""
    path = campaign.parent / "thermal" / "IR_0001.seq"
    original = path.read_bytes()
    reference = index_frames([path])[0][frame]
    place = reference.segments[0][0] + reference.samples.offset + reference.samples.length // 2
    damaged = original[:place] + data + original[place + len(data) :]
    path.write_bytes(damaged if checksums else without_checksums(damaged))


def test_steps_and_drift_are_taken_out_before_the_fields_are_made(tmp_path: Path) -> None:
    truth, campaign = _campaign(tmp_path / "campaign", ffc_step_K=0.3, drift_K_per_K=0.1)
    outcome = _reduce(campaign)
    part, fields = outcome.parts["camera"], outcome.dataset
    planted = truth.frames["camera_offset_K"].values
    assert part["steps"] and part["drift_K"] > 0.3 and camera_corrected(part)
    codes = {notice.code for notice in outcome.notices}
    assert {"camera_steps_corrected", "camera_drift_corrected"} <= codes
    error = np.nanmean(_error_of_rise(truth, outcome), axis=(1, 2))
    assert np.ptp(planted) > 0.5
    # The mean over the table has hardly any noise: what remains is the camera. Its errors add up, so that this is about one draw.
    assert np.sqrt(np.mean(error**2)) < 0.08
    assert np.sqrt(np.mean((error[1:] / fields["camera_correction_u"].values[1:]) ** 2)) < 3.0
    assert fields["camera_correction"].values == pytest.approx(-(planted - planted[0]) / 0.963, abs=0.12)
    assert fields["camera_correction_u"].values[0] == 0.0


def test_a_reference_patch_carries_the_correction(tmp_path: Path) -> None:
    """The wall of a room that keeps its temperature serves as the patch; no log of the air is needed."""
    truth, campaign = _campaign(tmp_path / "campaign", room={"swing_K": 0.0, "trend_K_per_h": 0.0}, ffc_step_K=0.3)
    text = campaign.read_text().replace('environment = "environment.csv"\n', "")
    campaign.write_text(text.replace("[thermography]\n", "[thermography]\nreference_patch = [10, 10, 60, 20]\n"))
    outcome = _reduce(campaign)
    planted = truth.frames["camera_offset_K"].values
    # The room still wanders by some hundredths of a kelvin.
    assert outcome.dataset["camera_correction"].values == pytest.approx(-(planted - planted[0]) / 0.963, abs=0.15)
    campaign.write_text(campaign.read_text().replace("[10, 10, 60, 20]", "[300, 10, 60, 20]"))
    with pytest.raises(
        SourceError, match=r"reference_patch = \[300, 10, 60, 20\]: leaves the frames of 320 x 240 pixels"
    ):
        _reduce(campaign)
    campaign.write_text(campaign.read_text().replace("[300, 10, 60, 20]", "[150, 110, 12, 12]"))
    with pytest.raises(SourceError, match=r"reference_patch = \[150, 110, 12, 12\]: 100 % of its pixels show the plan"):
        _reduce(campaign)


def test_a_sound_camera_is_left_alone(sound: tuple[Truth, Path]) -> None:
    _, campaign = sound
    outcome = _reduce(campaign)
    part = outcome.parts["camera"]
    assert part["steps"] == [] and part["drift_K"] == 0.0 and part["frames_damaged"] == []
    assert not camera_corrected(part)
    assert (outcome.dataset["camera_correction"] == 0).all()
    assert 0 < part["largest_u_K"] < 0.05
    assert not [notice for notice in outcome.notices if notice.code.startswith(("camera", "frames"))]


@pytest.mark.parametrize(
    ("data", "checksums"),
    [
        (bytes(2000), True),
        (np.random.default_rng(1).bytes(2000), True),
        (np.random.default_rng(2).bytes(40_000), True),
        (bytes(2000), False),
        (np.random.default_rng(3).bytes(2000), False),
    ],
    ids=["2 kB zeros", "2 kB random", "40 kB random", "2 kB zeros without CRC", "2 kB random without CRC"],
)
def test_a_damaged_frame_costs_only_itself(sound: tuple[Truth, Path], data: bytes, checksums: bool) -> None:
    _, campaign = sound
    path = campaign.parent / "thermal" / "IR_0001.seq"
    whole = path.read_bytes()
    before = _reduce(campaign).dataset["temperature"].values
    try:
        _damage(campaign, 10, data, checksums=checksums)
        outcome = _reduce(campaign)
    finally:
        path.write_bytes(whole)
    (frame,) = outcome.parts["camera"]["frames_damaged"]
    assert frame["file"] == "thermal/IR_0001.seq" and frame["index"] == 10 and "damaged" in frame["reason"]
    assert frame in outcome.parts["registration"]["frames_rejected"]
    (notice,) = [notice for notice in outcome.notices if notice.code == "frames_damaged"]
    assert notice.message.startswith("1 frame left out: thermal/IR_0001.seq (")
    after = outcome.dataset["temperature"].values
    others = np.arange(CYCLES) != 10
    np.testing.assert_array_equal(after[others], before[others])
    assert np.isnan(after[10]).all()


def test_a_campaign_whose_frames_are_all_damaged_says_so(sound: tuple[Truth, Path]) -> None:
    _, campaign = sound
    path = campaign.parent / "thermal" / "IR_0001.seq"
    whole = path.read_bytes()
    try:
        for frame in range(CYCLES):
            _damage(campaign, frame, b"damage")
        with pytest.raises(ThermographyError, match=r"pixels of all 24 frames are damaged .*copy the files again"):
            _reduce(campaign)
    finally:
        path.write_bytes(whole)
