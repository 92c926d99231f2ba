"""Pictures without fiducials: how far each is shifted against the first."""

import numpy as np
import pytest
from scipy import ndimage

from thermography.registration.displacement import picture_displacements


@pytest.fixture(scope="module")
def scene():
    return 20.0 + 5.0 * ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(96, 128)), 3.0)


def test_a_shift_is_measured_and_another_scene_has_none(rng, scene):
    noise = [rng.normal(scale=0.02, size=scene.shape) for _ in range(3)]
    other = rng.normal(20.0, 1.0, scene.shape)
    shifts = picture_displacements([scene + noise[0], scene + noise[1], np.roll(scene, (3, 4), axis=(0, 1)), other])
    assert np.abs(shifts[1]).max() < 0.1
    # The content that comes in at the edge costs a tenth of the shift.
    assert shifts[2] == pytest.approx([4.0, 3.0], abs=0.5)
    assert np.isnan(shifts[3]).all()


def test_a_part_that_warms_beyond_recognition_is_followed_from_picture_to_picture(rng, scene):
    row, column = np.mgrid[:96, :128]
    spot = 60.0 * np.exp(-((column - 60) ** 2 + (row - 50) ** 2) / 200.0)
    warming = [scene + share**2 * spot + rng.normal(scale=0.02, size=scene.shape) for share in np.linspace(0, 1, 16)]
    assert np.isnan(picture_displacements([warming[0], warming[-1]])[1]).all()
    assert np.abs(picture_displacements(warming)).max() < 1.0


def test_discs_in_rows_are_not_taken_for_a_shift_by_a_row(rng):
    row, column = np.mgrid[:120, :160]
    scene = np.full((120, 160), 22.0)
    for y in (15, 100):
        for x in (20, 140):
            scene[(row - y) ** 2 + (column - x) ** 2 < 16] -= 3.0
    # What warms between the discs is unlike the first picture; a shift by 85 px would leave a third of it, with one row on the other.
    warm = 4.0 * np.exp(-((column - 80) ** 2 + (row - 60) ** 2) / 800.0)
    pictures = [scene + share * warm + rng.normal(scale=0.05, size=scene.shape) for share in np.linspace(0, 1, 8)]
    assert np.abs(picture_displacements(pictures)).max() < 1.0
