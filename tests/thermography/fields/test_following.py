"""A table followed over a series: knocks, zooms, frames displaced alone, stretches that cannot be checked, objects before it."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, START, Scene, cell_truth, record
from thermography.fields.following import pixels_off
from thermography.fields.still import reduce_frames
from thermography.registration.register import register

SCENE = Scene(disc_K=-4.0)
ZOOM = 1.05


def zoomed() -> np.ndarray:
    """The scene through a lens that was zoomed about a corner, so that the table stays within the image."""
    warp = np.array([[ZOOM, 0.0, -20.0], [0.0, ZOOM, -10.0]])
    return cv2.warpAffine(SCENE.render(), warp, (640, 480), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def reduced(tmp_path, rng, images, *, interval_s=60.0, cycles=None):
    registration = register(SCENE.render(), DISCS, grid=GRID)
    noisy = [image + rng.normal(0.0, 0.05, image.shape) for image in images]
    frames = record(tmp_path / "a.seq", noisy, interval_s=interval_s)
    edges = np.linspace(0.0, interval_s * len(images), (cycles or len(images)) + 1)
    return reduce_frames(frames, registration, GRID, START + np.round(1e3 * edges).astype("m8[ms]"))


def rms_K(fields) -> float:
    return float(np.sqrt(np.nanmean((fields["temperature"].values - cell_truth()) ** 2)))


@pytest.mark.parametrize("shift_px", [(40.0, -25.0), (0.7, 0.0)])
def test_a_knock_of_any_size_is_followed(tmp_path, rng, shift_px):
    still, knocked = SCENE.render(), replace(SCENE, shift_px=shift_px).render()
    fields = reduced(tmp_path, rng, [still] * 3 + [knocked] * 3)
    (knock,) = json.loads(fields.attrs["knocks"])
    assert knock["index"] == 3
    assert knock["shift_px"] == pytest.approx(shift_px, abs=0.05)
    assert knock["zoom"] == pytest.approx(1.0, abs=3e-4)
    # 50 mK of noise and 17 pixels per cell.
    assert rms_K(fields) < 0.02
    assert json.loads(fields.attrs["unchecked_stretches"]) == []


def test_a_zoom_is_followed(tmp_path, rng):
    fields = reduced(tmp_path, rng, [SCENE.render()] * 3 + [zoomed()] * 3)
    (knock,) = json.loads(fields.attrs["knocks"])
    assert (knock["index"], knock["zoom"]) == (3, pytest.approx(ZOOM, abs=1e-3))
    assert rms_K(fields) < 0.02


def test_a_frame_displaced_alone_is_left_out(tmp_path, rng):
    still, shaken = SCENE.render(), replace(SCENE, shift_px=(8.0, 3.0)).render()
    fields = reduced(tmp_path, rng, [still, still, shaken, still, still])
    assert json.loads(fields.attrs["frames_shaken"]) == ["a.seq#2"]
    assert np.isnan(fields["temperature"].values[2]).all()
    assert fields["frame_count"].values.tolist() == [1, 1, 1, 1]


def test_low_contrast_is_no_open_stretch_if_a_later_frame_shows_the_registration(tmp_path, rng):
    uniform = Scene(disc_K=-4.0, field=lambda x, y: 23.0 + 0.0 * x, outside=23.0)
    # Discs as warm as the table, and the table as warm as what surrounds it.
    shown, hidden = uniform.render(), replace(uniform, discs=()).render()
    closed = reduced(tmp_path, rng, [shown, hidden, hidden, shown])
    assert json.loads(closed.attrs["frames_unchecked"]) == ["a.seq#1", "a.seq#2"]
    assert json.loads(closed.attrs["unchecked_stretches"]) == []
    opened = reduced(tmp_path, rng, [shown, shown, hidden, hidden])
    assert json.loads(opened.attrs["unchecked_stretches"]) == [{"first": "a.seq#2", "last": "a.seq#3", "frames": 2}]


def covered(above_K: float) -> np.ndarray:
    """An object of uniform temperature over a seventh of the table."""
    image = SCENE.render().copy()
    image[130:300, 250:330] = 24.0 + above_K
    return image


@pytest.mark.parametrize("above_K", [7.0, -3.0])
def test_frames_with_an_object_are_left_out_and_named(tmp_path, rng, above_K):
    images = [covered(above_K) if i in (2, 5) else SCENE.render() for i in range(8)]
    fields = reduced(tmp_path, rng, images)
    assert json.loads(fields.attrs["frames_obstructed"]) == ["a.seq#2", "a.seq#5"]
    assert np.isnan(fields["temperature"].values[[2, 5]]).all()
    assert rms_K(fields) < 0.02


def test_the_other_frames_of_a_block_are_kept(tmp_path, rng):
    images = [covered(7.0) if i in (0, 6, 7) else SCENE.render() for i in range(10)]
    fields = reduced(tmp_path, rng, images, interval_s=0.5, cycles=2)
    assert json.loads(fields.attrs["frames_obstructed"]) == ["a.seq#0", "a.seq#6", "a.seq#7"]
    assert fields["frame_count"].values.tolist() == [4, 3]
    assert rms_K(fields) < 0.015


def test_an_object_that_stays_is_no_passing_one(tmp_path, rng):
    fields = reduced(tmp_path, rng, [SCENE.render()] * 3 + [covered(7.0)] * 7, interval_s=200.0)
    assert json.loads(fields.attrs["frames_obstructed"]) == []


def test_a_common_change_is_no_object_and_limits_grow_with_the_noise():
    base = np.linspace(20.0, 24.0, 200)
    part = np.where(np.arange(200) < 20, 1.0, 0.0)
    values = np.stack([base + 2.0, base + part])
    np.testing.assert_allclose(pixels_off(values, base, base, 0.05), [0.0, 0.1])
    gap = values.copy()
    gap[:, 150] = np.nan
    np.testing.assert_allclose(pixels_off(gap, base, base, 0.05), [0.0, 0.1])
    # Eight standard deviations of 0.2 K are more than 1 K.
    np.testing.assert_allclose(pixels_off(values, base, base, 0.2), [0.0, 0.0])
