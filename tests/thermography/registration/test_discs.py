"""Discs in drawn frames whose centres are known exactly."""

import numpy as np
import pytest

from thermography.registration.discs import LocatedDisc, detect_discs, locate_disc
from thermography.registration.plan import Fiducial, PlanGrid

#: 2 px/mm, plan and sensor parallel.
JACOBIAN = 2.0 * np.eye(2)
GRID = PlanGrid(100, 60, 5)


def draw(centre_px, radius_px, *, disc_K=-3.0, slope=0.0, shape=(120, 200)):
    """A frame at 22 degC with a disc, every pixel the mean of 8 x 8 points; the table rises by `slope` K/px along the columns."""
    steps = (np.arange(8) + 0.5) / 8 - 0.5
    column = (np.arange(shape[1])[:, None] + steps).ravel()
    row = (np.arange(shape[0])[:, None] + steps).ravel()
    inside = np.hypot(column - centre_px[0], row[:, None] - centre_px[1]) < radius_px
    fine = np.where(inside, 22.0 + disc_K, 22.0 + slope * (column - centre_px[0]))
    return fine.reshape(shape[0], 8, shape[1], 8).mean(axis=(1, 3))


@pytest.mark.parametrize("disc_K", [-3.0, 3.0])
@pytest.mark.parametrize("slope", [0.0, 0.02])
def test_centroid_is_exact_at_both_contrasts_and_on_a_gradient(disc_K, slope):
    disc, centre = Fiducial("F1", 50.13, 30.32, 16.0), np.array([100.26, 60.64])
    located = locate_disc(
        draw(centre, 16.0, disc_K=disc_K, slope=slope), disc, GRID, centre + np.array([1.5, -1.0]), JACOBIAN
    )
    assert isinstance(located, LocatedDisc)
    assert np.hypot(located.column_px - centre[0], located.row_px - centre[1]) < 0.01
    assert located.contrast_K == pytest.approx(disc_K, abs=0.01)
    assert located.area_px == pytest.approx(np.pi * 16**2, rel=0.01)


def test_stated_uncertainty_is_the_scatter_of_the_centroid(rng):
    disc, centre = Fiducial("F1", 50.0, 30.0, 16.0), np.array([100.0, 60.0])
    image = draw(centre, 16.0)
    located = [locate_disc(image + rng.normal(0, 0.3, image.shape), disc, GRID, centre, JACOBIAN) for _ in range(100)]
    scatter = np.std([(place.column_px, place.row_px) for place in located], axis=0).mean()
    # 200 values give their standard deviation to 5 %; the planes under and around the disc share the noise.
    assert np.mean([place.u_px for place in located]) == pytest.approx(scatter, rel=0.3)


def test_reasons_why_a_disc_is_not_located(rng):
    disc, centre = Fiducial("F1", 50.0, 30.0, 16.0), np.array([100.0, 60.0])
    plain = 22.0 + rng.normal(0, 0.05, (120, 200))
    assert locate_disc(plain, disc, GRID, centre, JACOBIAN).startswith("has no contrast (")
    assert locate_disc(plain, disc, GRID, np.array([5.0, 60.0]), JACOBIAN) == "lies at the edge of the frame"
    off = locate_disc(draw(centre, 16.0), disc, GRID, centre + np.array([12.0, 0.0]), JACOBIAN)
    assert off == "no disc within 3.0 px of where it should be"
    tiny = Fiducial("F1", 50.0, 30.0, 1.0)
    assert locate_disc(plain, tiny, GRID, centre, JACOBIAN) == "is too small in the frame or too near the plan's edge"


def test_discs_are_detected_where_and_as_large_as_they_are_and_bars_are_not(rng):
    image = draw((60.0, 40.0), 8.0, disc_K=-3.0) + draw((140.0, 80.0), 12.0, disc_K=2.0) - 22.0
    image[10:16, 120:160] += 4.0
    spots = detect_discs(image + rng.normal(0, 0.05, image.shape))
    cold, warm = spots[:2]
    # 40 px x 6 px: too oblique for a disc.
    assert not any(abs(s.column_px - 140) < 20 and abs(s.row_px - 13) < 3 for s in spots)
    assert (cold.column_px, cold.row_px) == pytest.approx((60, 40), abs=0.3)
    assert (warm.column_px, warm.row_px) == pytest.approx((140, 80), abs=0.3)
    assert (cold.contrast_K, warm.contrast_K) == pytest.approx((-3.0, 2.0), abs=0.2)
    assert (cold.area_px, warm.area_px) == pytest.approx((np.pi * 8**2, np.pi * 12**2), rel=0.1)
