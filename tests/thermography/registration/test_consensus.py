"""Wrong places do not bend the fit of the others, and right places are not called wrong."""

import numpy as np
import pytest

from tests.thermography.plan_scene import DISCS, Scene
from thermography.errors import ThermographyError
from thermography.registration.consensus import fit_agreeing
from thermography.registration.projection import DiscObservations, Projection

IDEAL = Projection(np.eye(3), np.zeros(4), 640.0, (319.5, 239.5))
PLAN = np.array([(disc.x_mm, disc.y_mm) for disc in DISCS], float)


def observed(rng, *, k1=-1.2, places_u_mm=0.0, plan=PLAN):
    """Centroids of the listed discs with 0.02 px of noise; their true places differ from the list by `places_u_mm`."""
    true = plan + rng.normal(0, 1, plan.shape) * places_u_mm
    pixels = Scene(k1=k1).to_pixels(true) + rng.normal(0, 0.02, plan.shape)
    return DiscObservations(pixels, plan, np.full(len(plan), 8.0), np.full(len(plan), 0.02))


@pytest.mark.parametrize(("count", "error_mm"), [(1, 0.9), (2, 3.0), (3, 5.0), (3, 60.0)])
def test_wrong_places_are_told_from_right_ones(rng, count, error_mm):
    for _ in range(4):
        observations = observed(rng)
        wrong = rng.permutation(12)[:count]
        angle = rng.uniform(0, 2 * np.pi, count)
        observations.centres_mm[:] = PLAN
        observations.centres_mm[wrong] += error_mm * np.column_stack([np.cos(angle), np.sin(angle)])
        projection, _, agreeing = fit_agreeing(observations, IDEAL, calibrated=False)
        assert set(np.flatnonzero(~agreeing)) == set(wrong)
        np.testing.assert_allclose(projection.to_sensor(PLAN[agreeing]), observations.points_px[agreeing], atol=0.3)


@pytest.mark.parametrize("places_u_mm", [0.0, 0.2])
def test_right_places_are_not_called_wrong(rng, places_u_mm):
    # The test is meant to lose a disc in one list of a thousand; of 30 more than one would be a wrong scale.
    lost = sum(
        not fit_agreeing(observed(rng, places_u_mm=places_u_mm), IDEAL, calibrated=False)[2].all() for _ in range(30)
    )
    assert lost <= 1


def test_six_right_places_are_all_kept(rng):
    # As six discs of a coarse camera lie, three of them nearly on a line: every five of them leave hardly a degree of freedom.
    plan = np.array([(60, 30), (350, 32), (640, 35), (60, 145), (350, 150), (640, 148)], float)
    lost = sum(not fit_agreeing(observed(rng, plan=plan), IDEAL, calibrated=False)[2].all() for _ in range(50))
    assert lost <= 1


def test_five_discs_cannot_be_told_apart(rng):
    observations = observed(rng, plan=PLAN[[0, 4, 5, 9, 10]])
    observations.centres_mm[0] += (20.0, 0.0)
    assert fit_agreeing(observations, IDEAL, calibrated=False)[2].all()


def test_a_given_lens_is_kept(rng):
    lens = Projection(np.eye(3), np.array([-1.2, 0, 0, 0]), 1530.0, (319.5, 239.5))
    projection, coefficients, agreeing = fit_agreeing(observed(rng), lens, calibrated=True)
    assert (projection.distortion[0], coefficients, agreeing.all()) == (-1.2, 0, True)


def test_discs_on_a_line_are_refused(rng):
    line = np.column_stack([np.arange(7) * 90.0, np.full(7, 90.0)])
    with pytest.raises(ThermographyError, match="lie on a line or on one spot; spread at least four"):
        fit_agreeing(observed(rng, k1=0.0, plan=line), IDEAL, calibrated=False)
