"""The plan: its grid, fiducials and polygons, the picture as the plan, and faults of files that name their line."""

from pathlib import Path

import numpy as np
import pytest

from thermography.fields.resampling import plan_weights
from thermography.registration.plan import (
    Fiducial,
    FiducialError,
    PlanGrid,
    Polygon,
    PolygonError,
    mask_discs,
    read_fiducials,
)
from thermography.registration.register import picture_grid, register_picture


def test_cells_fill_the_plan_from_its_corner_to_its_outline():
    grid = PlanGrid(30, 20, 5)
    assert grid.shape == (4, 6)
    assert grid.x_mm.tolist() == [2.5, 7.5, 12.5, 17.5, 22.5, 27.5]
    assert grid.centres_mm[1, 2].tolist() == [12.5, 7.5]
    outline = PlanGrid(30, 20, 5).outline_mm(3)
    corners = outline[[0, 2, 3, 5, 6, 8, 9, 11]].tolist()
    assert corners == [[0, 0], [30, 0], [30, 0], [30, 20], [30, 20], [0, 20], [0, 20], [0, 0]]
    assert outline[[1, 4, 7, 10]].tolist() == [[15, 0], [30, 10], [15, 20], [0, 10]]
    with pytest.raises(ValueError, match=r"width_mm = 702 mm is not a whole number of cells of 5 mm"):
        PlanGrid(702, 180, 5)
    with pytest.raises(ValueError, match=r"cell_size_mm = -5 mm; the plan needs a positive length"):
        PlanGrid(700, 180, -5)


def test_margins_of_plan_and_discs():
    grid, disc = PlanGrid(30, 20, 5), Fiducial("F1", 10, 10, 8)
    points = np.array([(0.0, 0.0), (2.0, 10.0), (29.0, 10.0), (31.0, 10.0)])
    assert grid.contains(points).tolist() == [True, True, True, False]
    assert grid.contains(points, margin_mm=2.0).tolist() == [False, True, False, False]
    around = np.array([(13.9, 10.0), (14.1, 10.0), (16.1, 10.0)])
    assert mask_discs(around, [disc], margin_mm=0.0).tolist() == [True, False, False]
    assert mask_discs(around, [disc], margin_mm=np.array([0.0, 2.0, 2.0])).tolist() == [True, True, False]


def test_points_near_discs_are_those_nearer_than_the_margin(rng):
    """By the distance of every point, also of points exactly on the rim, without a place or with an endless margin."""
    discs = [Fiducial("F1", 10, 10, 8), Fiducial("F2", 17, 12.5, 6)]
    points = np.round(rng.uniform(0, 30, (40, 50, 2)) * 4) / 4
    margin = rng.uniform(0, 3, (40, 50))
    points[0, 0], margin[1, 1], margin[2, 2] = np.nan, np.inf, np.nan
    for reach in (0.0, 1.0, margin):
        near = [np.hypot(points[..., 0] - d.x_mm, points[..., 1] - d.y_mm) < d.diameter_mm / 2 + reach for d in discs]
        assert 100 < np.sum(near) < 2000
        np.testing.assert_array_equal(mask_discs(points, discs, margin_mm=reach), near[0] | near[1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,x_mm,y_mm\nF1,1,2\n", r":1: no column diameter_mm; the first line must read"),
        ("name,x_mm,y_mm,diameter_mm\nF1,one,2,16\n", r":2: x_mm = 'one' is not a number"),
        ("name,x_mm,y_mm,diameter_mm\n,1,2,16\n", r":2: name is empty"),
        ("name,x_mm,y_mm,diameter_mm\nF1,1,2,-16\n", r":2: diameter_mm = -16; a disc has a positive diameter"),
        ("name,x_mm,y_mm,diameter_mm,column_px,row_px\nF1,1,2,16,5,\n", r":2: F1 has one of column_px, row_px"),
        ("name,x_mm,y_mm,diameter_mm\nF1,1,2,\n", r":2: F1 has neither diameter_mm .* nor column_px, row_px"),
        ("name,x_mm,y_mm,diameter_mm\nF1,1,2,16\n", r"lists 1 fiducials; a plan is located by at least 4"),
    ],
)
def test_faults_of_the_fiducial_file_name_their_line(tmp_path, text, message):
    path = tmp_path / "fiducials.csv"
    path.write_text(text)
    with pytest.raises(FiducialError, match=message):
        read_fiducials(path)


def test_marker_column_of_the_fiducial_file(tmp_path):
    path = tmp_path / "fiducials.csv"
    rows = [f"F{i},{100 * i},20,16," for i in range(1, 5)]
    path.write_text("\n".join(["name,x_mm,y_mm,diameter_mm,marker", *rows, "M7,120,40,52,7"]))
    assert [one.marker for one in read_fiducials(path)] == [None] * 4 + [7]
    path.write_text("\n".join(["name,x_mm,y_mm,diameter_mm,marker", *rows, "M7,120,40,52,50"]))
    with pytest.raises(FiducialError, match=r"fiducials\.csv:6: marker = '50'; give an ArUco number"):
        read_fiducials(path)
    path.write_text("\n".join(["name,x_mm,y_mm,diameter_mm,marker", *rows[1:], "M7,120,40,52,7"]))
    with pytest.raises(FiducialError, match="lists 3 fiducials; a plan is located by at least 4"):
        read_fiducials(path)


def test_points_have_places_instead_of_diameters(tmp_path):
    path = tmp_path / "fiducials.csv"
    rows = [f"P{i},{100 * i},{20 * i * i},,{90 * i},{50 + i}" for i in range(1, 5)]
    path.write_text("\n".join(["name,x_mm,y_mm,diameter_mm,column_px,row_px", *rows]))
    points = read_fiducials(path)
    assert all(point.is_point for point in points)
    assert points[1].hint_px == (180.0, 52.0)
    path.write_text("\n".join(["name,x_mm,y_mm,diameter_mm,column_px,row_px", *rows, "F5,30,40,16,,"]))
    with pytest.raises(FiducialError, match=r"lists 1 discs and 4 points without diameter_mm; .* by discs or by"):
        read_fiducials(path)


def test_a_missing_file_is_named_by_the_error(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        read_fiducials(tmp_path / "fiducials.csv")
    assert Path(caught.value.filename) == tmp_path / "fiducials.csv"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name,x_mm,y_mm,diameter_mm\nF\xff1,1,2,16\n", "byte 28 is not UTF-8; save the file as CSV in UTF-8"),
        (
            b'name,x_mm,y_mm,diameter_mm\n"' + b"x" * 140_000 + b'",1,2,16\n',
            "is not CSV (field larger than field limit",
        ),
    ],
)
def test_a_damaged_fiducial_file_is_named(tmp_path, content, message):
    path = tmp_path / "fiducials.csv"
    path.write_bytes(content)
    with pytest.raises(FiducialError) as error:
        read_fiducials(path)
    assert str(error.value).startswith(f"{path}: {message}")


def test_the_picture_as_the_plan():
    rng = np.random.default_rng(3)
    frame = rng.normal(25.0, 1.0, (6, 8))
    weights = plan_weights(register_picture((6, 8)), PlanGrid(8, 6, 2))
    # The means of blocks of 2 x 2 pixels, up to the edges of the picture.
    means = frame.reshape(3, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(weights.resample(frame), means, rtol=0, atol=1e-9)
    registration = register_picture((6, 8))
    np.testing.assert_allclose(registration.to_plan(np.array([[0.0, 0.0], [7.0, 5.0]])), [[0.5, 0.5], [7.5, 5.5]])
    assert registration.is_picture and not registration.mirrored
    assert not registration.position_u(picture_grid((6, 8)).centres_mm).any()
    assert picture_grid((512, 640)).cell_size_mm == 4 and picture_grid((7, 11)).cell_size_mm == 1
    assert picture_grid((480, 640)).shape == (120, 160)
    for shape in ((481, 641), (767, 1023), (1080, 1920), (97, 1601)):
        grid = picture_grid(shape)
        assert max(grid.shape) <= 160
        # What lies beyond the last cells, or what these reach beyond the picture, is half a cell at most.
        assert np.abs(np.subtract((grid.height_mm, grid.width_mm), shape)).max() <= grid.cell_size_mm / 2


X, Y = np.arange(20) * 5.0 + 2.5, np.arange(10) * 5.0 + 2.5


def test_shares_of_cells_in_a_polygon_are_areas():
    arrow = Polygon("arrow", [(0, 0), (40, 0), (20, 10), (40, 20), (0, 20)])
    assert arrow.contains([(10, 10), (30, 10), (39, 0.2), (-1, 5)]).tolist() == [True, False, True, False]
    assert arrow.contains(np.full((3, 4, 2), 10.0)).shape == (3, 4)
    # Tenths of a cell: 3.5 mm and 2 mm of 5 mm along x, all of it along y.
    shares = Polygon("strip", [(1.5, 5), (7, 5), (7, 10), (1.5, 10)]).cell_shares(X, Y)
    assert shares[1, :3].tolist() == pytest.approx([0.7, 0.4, 0.0])
    assert shares.sum() == pytest.approx(1.1)
    triangle = Polygon("triangle", [(0, 0), (90, 0), (0, 40)]).cell_shares(X, Y)
    assert triangle.sum() * 25 == pytest.approx(90 * 40 / 2, rel=0.01)
    with pytest.raises(PolygonError, match=r"far: \(x 800..900, y 0..50 mm\) holds no part of the plan"):
        Polygon("far", [(800, 0), (900, 0), (900, 50)]).cell_shares(X, Y)


@pytest.mark.parametrize("corners", [[(0, 0), (1, 1)], [(0, 0, 0), (1, 1, 1), (2, 0, 0)], []])
def test_what_is_no_polygon_is_refused(corners):
    with pytest.raises(PolygonError, match=r"r: corners have shape .*; give at least three \(x, y\) in mm"):
        Polygon("r", corners)
