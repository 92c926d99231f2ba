"""Consistency checks of the frames of a series: changed settings, implausible parameters, another range."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from fusion.consistency.checks import Severity
from fusion.consistency.frames import check_frames
from thermography.io.flir import FrameReference, index_frames
from thermography.io.frame import CalibratedRange

STATED = {
    "emissivity",
    "reflected_temperature_K",
    "atmospheric_temperature_K",
    "relative_humidity",
    "object_distance_m",
}


@pytest.fixture
def frames(campaign_folder: Path) -> list[FrameReference]:
    references, _ = index_frames(sorted((campaign_folder / "thermal").iterdir()))
    return references[:6]


def failed(frames: list[FrameReference], overridden: set[str]) -> dict[str, str]:
    return {check.code: check.evidence for check in check_frames(frames, overridden=overridden) if not check.passed}


def test_a_sound_series_passes(frames: list[FrameReference]) -> None:
    assert failed(frames, STATED) == {} and failed(frames, set()) == {}
    assert check_frames([], overridden=set()) == []


def test_an_emissivity_that_changes_is_doubted_unless_it_is_stated(frames: list[FrameReference]) -> None:
    changed = [*frames[:3], *(replace(one, parameters=replace(one.parameters, emissivity=0.7)) for one in frames[3:])]
    assert failed(changed, set()) == {"camera_settings": "Parameters differ between the frames: emissivity."}
    assert failed(changed, STATED) == {}


def test_a_range_that_changes_is_doubted(frames: list[FrameReference]) -> None:
    other = CalibratedRange(573.15, 2273.15, frames[0].limits.raw_minimum, frames[0].limits.raw_maximum)
    named = failed([*frames[:3], *(replace(one, limits=other) for one in frames[3:])], STATED)
    assert named["camera_settings"] == "The camera's range changes (2 ranges)."


def test_another_lens_is_doubted(frames: list[FrameReference]) -> None:
    other = replace(frames[3], camera=replace(frames[3].camera, lens_model="FOL76"))
    named = failed([*frames[:3], other, *frames[4:]], STATED)
    assert named["camera_settings"] == "The frames were taken through 2 lenses."


def test_a_table_outside_the_range_is_doubted(frames: list[FrameReference]) -> None:
    hot = CalibratedRange(573.15, 2273.15, frames[0].limits.raw_minimum, frames[0].limits.raw_maximum)
    named = failed([replace(one, limits=hot) for one in frames], STATED)
    assert named == {
        "camera_range": "Up to 100 % of the pixels of a frame lie outside the range in which the camera is calibrated."
    }


def test_kelvin_stored_as_celsius_is_doubted_unless_it_is_stated(frames: list[FrameReference]) -> None:
    wrong = [replace(one, parameters=replace(one.parameters, reflected_temperature_K=571.15)) for one in frames]
    assert failed(wrong, set()) == {"camera_parameters": "Reflected temperature 298 degC: probably K stored as degC."}
    assert failed(wrong, STATED) == {}


def test_frames_of_two_cameras_are_doubted(frames: list[FrameReference]) -> None:
    other = [replace(one, camera=replace(one.camera, serial="other")) for one in frames[3:]]
    assert failed([*frames[:3], *other], STATED) == {"camera_settings": "The file holds frames of 2 cameras."}


def test_a_frozen_camera_contradicts_the_test(frames: list[FrameReference]) -> None:
    held = [replace(frames[0], time=one.time) for one in frames]
    (check,) = (check for check in check_frames(held, overridden=STATED) if not check.passed)
    assert (check.code, check.severity) == ("frozen_camera", Severity.CONTRADICTION)
    assert "hold the same image, count for count: the camera was frozen" in check.evidence
    # Two frames may be alike by a copied file.
    assert failed(held[:2], STATED) == {}
