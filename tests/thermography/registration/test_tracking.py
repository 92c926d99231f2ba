"""A displaced table is located to the displacement that its scene was rendered with."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import GRID, SC660, Scene, registered
from thermography.radiometry.planck import counts_from_temperature
from thermography.registration.tracking import locate_table, make_tracker

HOME = Scene(disc_K=-4.0, k1=-1.2, rays=3, corners_px=((80, 150), (480, 140), (495, 285), (75, 300)))


@pytest.fixture(scope="module")
def tracker():
    registration = registered(HOME)
    return make_tracker(registration, GRID, np.array([2.0, 0.0]), reach_mm=350.0)


def counts_of(scene, rng):
    return np.round(counts_from_temperature(scene.render(rng), SC660)).astype(np.uint16)


@pytest.mark.parametrize("shift", [0.0, 137.4, 251.9])
def test_displacement_is_found_without_and_despite_a_previous_one(rng, tracker, shift):
    counts = counts_of(replace(HOME, shift_mm=(shift, 0.3)), rng)
    for previous in (None, np.array([shift + 3.0, 0.0]), np.array([-200.0, 0.0])):
        position = locate_table(counts, tracker, previous)
        # A pixel is 1.7 mm.
        assert position.shift_mm == pytest.approx([shift, 0.3], abs=0.1)
        assert np.hypot(*(position.shift_mm - (shift, 0.3))) < 4 * position.u_mm
        assert position.discs >= 6


@pytest.mark.parametrize("previous", [np.nan, np.inf, 1e9, 1e19, 1e30, 1e300])
def test_a_previous_place_that_no_lens_shows_is_not_used(rng, tracker, previous):
    counts = counts_of(HOME, rng)
    position = locate_table(counts, tracker, np.array([previous, 0.0]))
    assert position.shift_mm.tolist() == locate_table(counts, tracker).shift_mm.tolist()


def test_direction_is_a_unit_vector_and_uncertainty_grows_along_it(tracker):
    assert tracker.direction.tolist() == [1.0, 0.0]
    middle = len(tracker.common_mm) // 2
    assert tracker.common_mm[[0, middle, -1]].tolist() == [-350.0, 0.0, 350.0]
    assert tracker.common_u_mm[0] > tracker.common_u_mm[middle] < tracker.common_u_mm[-1]


def test_a_frame_without_discs_shows_no_table(rng, tracker):
    empty = Scene(discs=(), field=lambda x, y: np.full_like(x, 22.5))
    assert locate_table(counts_of(empty, rng), tracker) is None
