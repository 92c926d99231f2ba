"""Shifts found from the picture of the table alone."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, GRID, START, Scene, cell_truth, record
from thermography.fields.still import reduce_frames
from thermography.registration.displacement import image_shift, shift_registration
from thermography.registration.register import register

BARE = Scene(discs=())


@pytest.fixture(scope="module")
def registration():
    return register(Scene(disc_K=-4.0).render(), DISCS, grid=GRID)


@pytest.mark.parametrize("shift", [(3.0, -2.0), (0.4, 0.3), (0.0, 0.0), (-6.0, 5.0)])
def test_shift_of_a_table_without_contrast_of_its_discs(rng, registration, shift):
    reference, frame = BARE.render(rng), replace(BARE, shift_px=shift).render(rng)
    # It has warmed by 1 K since, at one end by 3 K.
    frame = frame + 1.0 + 2.0 * np.linspace(0, 1, 640)
    assert image_shift(reference, frame, registration, GRID) == pytest.approx(shift, abs=0.1)


def test_pictures_that_do_not_agree_give_no_shift(rng, registration):
    other = rng.normal(22, 1.0, (480, 640))
    assert np.isnan(image_shift(BARE.render(rng), other, registration, GRID)).all()


def test_shifted_registration_puts_the_plan_where_the_picture_went(registration):
    moved = replace(Scene(disc_K=-4.0), shift_px=(3.0, -2.0))
    assert moved.registration_rms_mm(shift_registration(registration, np.array([3.0, -2.0]))) < 0.03


def test_knock_while_the_discs_have_no_contrast_is_found_and_mended(rng, registration, tmp_path):
    moved = replace(BARE, shift_px=(3.0, -2.0))
    images = [(BARE if i < 3 else moved).render(rng) for i in range(6)]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_frames(frames, registration, GRID, START + np.array([0, 3, 6]) * np.timedelta64(1, "s"))
    (knock,) = json.loads(fields.attrs["knocks"])
    assert knock["index"] == 3
    assert knock["shift_px"] == pytest.approx([3.0, -2.0], abs=0.1)
    error = fields["temperature"].values[1] - cell_truth()
    assert np.sqrt(np.nanmean(error**2)) < 0.01
