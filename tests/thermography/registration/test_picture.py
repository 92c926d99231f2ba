"""The picture as the plan: pixels in place of millimetres, exact by definition."""

from __future__ import annotations

import numpy as np
import pytest

from thermography.errors import ThermographyError
from thermography.fields.resampling import plan_weights
from thermography.registration.picture import picture_grid, register_picture, usual_cell_px


def test_every_pixel_belongs_to_the_cell_that_holds_it() -> None:
    rng = np.random.default_rng(3)
    frame = rng.normal(25.0, 1.0, (6, 8))
    weights = plan_weights(register_picture((6, 8)), picture_grid((6, 8), 2))
    # The means of blocks of 2 x 2 pixels, up to the edges of the picture.
    means = frame.reshape(3, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(weights.resample(frame), means, rtol=0, atol=1e-9)


def test_a_place_is_counted_from_the_upper_left_corner_without_uncertainty() -> None:
    registration = register_picture((6, 8))
    np.testing.assert_allclose(registration.to_plan(np.array([[0.0, 0.0], [7.0, 5.0]])), [[0.5, 0.5], [7.5, 5.5]])
    assert registration.is_picture and not registration.mirrored
    assert not registration.position_u(picture_grid((6, 8), 1).centres_mm).any()


def test_a_cell_divides_both_sides() -> None:
    assert usual_cell_px((512, 640)) == 4 and usual_cell_px((7, 11)) == 1
    assert picture_grid((480, 640)).shape == (120, 160)
    with pytest.raises(ThermographyError, match=r"7 px.* 640 x 480 pixels; choose one of 1, 2, 4, 5, 8"):
        picture_grid((480, 640), 7)
