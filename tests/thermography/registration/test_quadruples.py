"""Quadruples that spread, and homographies through four points against OpenCV's."""

import cv2
import numpy as np

from thermography.registration.quadruples import corner_triangles, exact_homographies, spread_quadruples

SQUARE = np.array([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)])


def test_the_widest_quadruple_comes_first_and_points_on_a_line_make_none():
    points = np.concatenate([[(50.0, 50.0), (55.0, 52.0)], SQUARE])
    assert set(spread_quadruples(points)[0].tolist()) == {2, 3, 4, 5}
    assert len(spread_quadruples(points, limit=3)) == 3
    line = np.column_stack([np.arange(6.0), np.zeros(6)])
    assert spread_quadruples(line).shape == (0, 4)


def test_of_many_points_a_part_is_compared_always_the_same(rng):
    points = rng.uniform(0, 500, (60, 2))
    first = spread_quadruples(points)
    assert first.shape == (500, 4)
    assert all(len(set(quad)) == 4 for quad in first.tolist())
    np.testing.assert_array_equal(first, spread_quadruples(points))


def test_the_sign_of_a_triangle_is_its_sense():
    assert (corner_triangles(SQUARE[None]) == 10_000).all()
    assert (corner_triangles(SQUARE[None, ::-1]) == -10_000).all()


def test_four_points_are_mapped_exactly_as_by_opencv(rng):
    plan = rng.uniform(0, 500, (20, 4, 2))
    image = plan[:, ::-1] * 0.8 + rng.uniform(-20, 20, (20, 4, 2))
    for matrix, one, other in zip(exact_homographies(plan, image), plan, image, strict=True):
        np.testing.assert_allclose(cv2.perspectiveTransform(one[None], matrix)[0], other, atol=1e-6)
    shared = exact_homographies(plan[:1], image)
    np.testing.assert_allclose(cv2.perspectiveTransform(plan[:1], shared[7])[0], image[7], atol=1e-6)
