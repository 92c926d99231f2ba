"""Spots placed by an exact homography are given back to their fiducials."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, Scene
from thermography.registration.discs import Spot
from thermography.registration.matching import MatchError, match_by_arrangement, match_by_hints
from thermography.registration.plan import Fiducial

SCENE = Scene()


def spots_of(discs):
    """Spots where the scene shows the discs, as large as it shows them."""
    spots = {}
    for disc in discs:
        angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        rim = np.column_stack([disc.x_mm + 8 * np.cos(angle), disc.y_mm + 8 * np.sin(angle)])
        (column, row), outline = SCENE.to_pixels([(disc.x_mm, disc.y_mm)])[0], SCENE.to_pixels(rim)
        a, b = outline, np.roll(outline, -1, axis=0)
        area = 0.5 * abs((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        spots[disc.name] = Spot(float(column), float(row), float(area), -3.0)
    return spots


def shuffled(spots, rng):
    spots = list(spots)
    rng.shuffle(spots)
    return spots


def test_arrangement_alone_names_every_spot(rng):
    spots = spots_of(DISCS)
    strays = [Spot(50.0, 400.0, 120.0, 2.0), Spot(400.0, 200.0, 900.0, -2.0)]
    matched = match_by_arrangement(shuffled([*spots.values(), *strays], rng), DISCS, shape=SCENE.shape)
    assert matched.spots == spots
    assert matched.hypotheses > 0


def test_a_mirrored_view_is_recognised(rng):
    spots = {name: replace(spot, column_px=639 - spot.column_px) for name, spot in spots_of(DISCS).items()}
    assert match_by_arrangement(shuffled(spots.values(), rng), DISCS, shape=SCENE.shape).spots == spots


def test_hints_name_the_spots_though_one_is_far_off(rng):
    spots = spots_of(DISCS)
    hinted = [
        replace(disc, column_px=spots[disc.name].column_px + 8, row_px=spots[disc.name].row_px - 6) for disc in DISCS
    ]
    hinted[4] = replace(hinted[4], column_px=600.0, row_px=20.0)
    assert match_by_hints(shuffled(spots.values(), rng), hinted) == spots


def test_too_few_hints_match_nothing():
    assert match_by_hints(list(spots_of(DISCS).values()), DISCS) == {}


def test_symmetric_and_small_arrangements_are_refused():
    places = [(40, 20), (350, 20), (660, 20), (40, 160), (350, 160), (660, 160)]
    symmetric = [Fiducial(f"S{i}", x, y, 16.0) for i, (x, y) in enumerate(places)]
    with pytest.raises(MatchError, match="symmetric and fits in two ways; give column_px,row_px for at least 4"):
        match_by_arrangement(list(spots_of(symmetric).values()), symmetric, shape=SCENE.shape)
    with pytest.raises(MatchError, match="5 fiducials cannot be told apart by their arrangement, which takes 6"):
        match_by_arrangement(list(spots_of(DISCS[:5]).values()), DISCS[:5], shape=SCENE.shape)
