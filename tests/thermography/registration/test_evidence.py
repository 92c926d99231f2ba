"""The chance of an agreement against counting, and what is refused."""

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, Scene
from thermography.registration.discs import LocatedDisc, Spot
from thermography.registration.evidence import (
    RegistrationError,
    area_ratio,
    chance_of_arrangement,
    chance_of_hints,
    contradicted_hints,
    refuse_chance,
    refuse_picks,
    refuse_scatter,
    refuse_sizes,
    size_contradiction,
)
from thermography.registration.plan import Fiducial
from thermography.registration.projection import Projection

PROJECTION = Projection(Scene().plan_to_pixel, np.zeros(4), 640.0, (319.5, 239.5))
PLAN = np.array([(disc.x_mm, disc.y_mm) for disc in DISCS], float)
AREA_PX = 480.0 * 640


def located(discs=DISCS, ratio=1.0):
    """The discs where they are, with `ratio` times their area."""
    places = PROJECTION.to_sensor(np.array([(disc.x_mm, disc.y_mm) for disc in discs], float))
    areas = np.abs(np.linalg.det(PROJECTION.jacobian(PLAN[: len(discs)]))) * np.pi * 64 * ratio
    return {
        disc.name: LocatedDisc(float(c), float(r), 0.02, float(a), -3.0)
        for disc, (c, r), a in zip(discs, places, areas, strict=True)
    }


def as_spots(discs, shift=0.0):
    return [Spot(d.column_px + shift, d.row_px, d.area_px, -3.0) for d in discs.values()]


def test_chance_of_hints_is_the_rate_at_which_scattered_spots_do_as_well(rng):
    hints, spots, reach, runs = rng.uniform(100, 380, (8, 2)), 12, 40.0, 4000
    hits = 0
    for _ in range(runs):
        scattered = rng.uniform(0, (640, 480), (spots, 2))
        nearest = np.linalg.norm(hints[:, None] - scattered, axis=-1).min(axis=1)
        hits += int((nearest < reach).sum() >= 4)
    expected = chance_of_hints(np.full(4, reach), 8, spots, area_px=AREA_PX)
    # An expectation over choices bounds the rate, and by no more than the choices overlap.
    assert hits / runs <= 1.1 * expected
    assert expected < 20 * hits / runs


def test_chance_of_an_arrangement_falls_with_discs_and_rises_with_misses_and_trials():
    chance = lambda missed, hypotheses=1000, k=0: chance_of_arrangement(  # noqa: E731
        12, 15, np.array(missed), hypotheses=hypotheses, coefficients=k, area_px=AREA_PX
    )
    assert chance([0.05] * 12) < 1e-30
    assert chance([0.05] * 6) < chance([2.0] * 6) < chance([2.0] * 6, 10_000)
    assert chance([0.05] * 5, k=1) == chance([0.05] * 4) == np.inf
    assert chance([0.5] * 7, k=1) > chance([0.5] * 7)


def test_an_agreement_that_chance_explains_is_refused():
    few = located(DISCS[:6])
    with pytest.raises(
        RegistrationError, match=r"6 of 12 fiducials fit the spots in view, and chance alone would do so 10\^"
    ):
        refuse_chance(few, DISCS, as_spots(few), np.full(6, 6.0), hypotheses=5000, coefficients=1, shape=(480, 640))
    every = located()
    refuse_chance(every, DISCS, as_spots(every), np.full(12, 0.05), hypotheses=5000, coefficients=1, shape=(480, 640))


def test_hints_prove_four_discs_if_they_are_near():
    four = located(DISCS[:4])

    def hinted(error):
        return [
            Fiducial(d.name, d.x_mm, d.y_mm, 16.0, p.column_px + error, p.row_px)
            for d, p in zip(DISCS, four.values(), strict=False)
        ]

    arguments = {"hypotheses": 1, "coefficients": 1, "shape": (480, 640)}
    refuse_chance(four, hinted(8.0), as_spots(four), np.full(4, np.nan), **arguments)
    with pytest.raises(RegistrationError, match=r"4 of 4 fiducials fit .*; 4 of their 4 hints contradict them"):
        refuse_chance(four, hinted(90.0), as_spots(four) * 6, np.full(4, np.nan), **arguments)


def test_places_that_contradict_one_another_are_refused():
    missed = {disc.name: 0.1 for disc in DISCS} | {"F7": 9.0}
    refuse_scatter(1.5, missed, DISCS)
    with pytest.raises(
        RegistrationError,
        match=r"by 1\.7 mm \(standard deviation; up to 1\.6 mm.*F7 is missed by the others by 9\.0 mm",
    ):
        refuse_scatter(1.7, missed, DISCS)
    refuse_picks(2.0, missed)
    with pytest.raises(RegistrationError, match=r"picked points contradict one another by 4\.0 px.*F7"):
        refuse_picks(4.0, missed)


def test_diameters_and_scale_must_agree():
    assert area_ratio(located(ratio=1.2), DISCS, PROJECTION) == pytest.approx(1.2, rel=0.01)
    assert np.isnan(area_ratio({}, [Fiducial("P1", 1.0, 2.0, 0.0, 3.0, 4.0)], PROJECTION))
    refuse_sizes(1.2, DISCS)
    with pytest.raises(RegistrationError, match=r"the discs in view measure 11\.3 mm, diameter_mm says 16 mm"):
        refuse_sizes(0.5, DISCS)


def test_spots_of_another_size_at_the_hints_are_named():
    places = located(ratio=0.25)
    hinted = [Fiducial(d.name, d.x_mm, d.y_mm, 16.0, places[d.name].column_px, places[d.name].row_px) for d in DISCS]
    assert "measure 8.0 mm, diameter_mm says 16 mm" in size_contradiction(as_spots(places), hinted)
    assert size_contradiction(as_spots(located()), hinted) == ""
    assert size_contradiction(as_spots(places), DISCS) == ""


def test_hints_far_from_their_disc_are_named():
    places = located(DISCS[:2])
    near, far = (
        Fiducial(d.name, d.x_mm, d.y_mm, 16.0, places[d.name].column_px + error, places[d.name].row_px)
        for d, error in zip(DISCS[:2], (10.0, 70.0), strict=True)
    )
    wrong = contradicted_hints(places, [near, far])
    assert list(wrong) == ["F2 (hint)"]
    assert "is 70 px from the disc; it was not used" in wrong["F2 (hint)"]
