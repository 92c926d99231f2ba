"""Polygons against areas and points that are known by hand."""

import numpy as np
import pytest

from thermography.registration.polygon import Polygon, PolygonError

X, Y = np.arange(20) * 5.0 + 2.5, np.arange(10) * 5.0 + 2.5


def test_points_inside_and_outside_of_a_concave_polygon():
    arrow = Polygon("arrow", [(0, 0), (40, 0), (20, 10), (40, 20), (0, 20)])
    assert arrow.contains([(10, 10), (30, 10), (39, 0.2), (-1, 5)]).tolist() == [True, False, True, False]
    assert arrow.contains(np.full((3, 4, 2), 10.0)).shape == (3, 4)


def test_shares_are_areas():
    # Tenths of a cell: 3.5 mm and 2 mm of 5 mm along x, all of it along y.
    shares = Polygon("strip", [(1.5, 5), (7, 5), (7, 10), (1.5, 10)]).cell_shares(X, Y)
    assert shares[1, :3].tolist() == pytest.approx([0.7, 0.4, 0.0])
    assert shares.sum() == pytest.approx(1.1)
    triangle = Polygon("triangle", [(0, 0), (90, 0), (0, 40)]).cell_shares(X, Y)
    assert triangle.sum() * 25 == pytest.approx(90 * 40 / 2, rel=0.01)


@pytest.mark.parametrize("corners", [[(0, 0), (1, 1)], [(0, 0, 0), (1, 1, 1), (2, 0, 0)], []])
def test_what_is_no_polygon_is_refused(corners):
    with pytest.raises(PolygonError, match=r"r: corners have shape .*; a polygon needs at least three \(x, y\) in mm"):
        Polygon("r", corners)


def test_a_polygon_off_the_cells_is_refused():
    with pytest.raises(PolygonError, match=r"far: \(x 800..900, y 0..50 mm\) holds no part of the plan"):
        Polygon("far", [(800, 0), (900, 0), (900, 50)]).cell_shares(X, Y)
