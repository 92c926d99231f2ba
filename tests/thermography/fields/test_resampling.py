"""Weights of a camera that looks straight down at 2 px/mm, where every area is known."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from tests.thermography.plan_scene import DISCS, GRID, overhead, registered
from thermography.common import ThermographyError
from thermography.fields.resampling import LEAST_COVERAGE, centring_matrix, plan_weights, plan_window
from thermography.registration.plan import Fiducial, PlanGrid, mask_discs
from thermography.registration.register import Registration, register_points

#: Cells of 10 x 10 px. Pixel centres lie at multiples of 0.5 mm less a quarter: pixel borders are cell borders.
PLAN = PlanGrid(60, 40, 5)
SHAPE = (90, 140)
ORIGIN = (9.5, 4.5)
DISC = Fiducial("D", 31.0, 21.0, 8.0)


def places_mm():
    column, row = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    return np.stack([(column - ORIGIN[0]) / 2, (row - ORIGIN[1]) / 2], axis=-1)


@pytest.fixture(scope="module")
def registration():
    return overhead(PLAN, [DISC], shape=SHAPE, px_per_mm=2.0, origin_px=ORIGIN)


def test_coverage_counts_the_unmasked_pixels(registration):
    weights = plan_weights(registration, PLAN)
    points = places_mm()
    # The margin is 2 px of 0.5 mm, from disc and edge.
    unmasked = PLAN.contains(points, margin_mm=1.0) & ~mask_discs(points, [DISC], margin_mm=1.0)
    rows, columns = weights.window
    assert (weights.used == unmasked[rows, columns]).all()
    assert not unmasked[: rows.start].any()
    assert not unmasked[rows.stop :].any()
    cell = (points[unmasked] // 5).astype(int)
    expected = np.zeros(PLAN.shape)
    np.add.at(expected, (cell[:, 1], cell[:, 0]), 0.25 / 25)
    np.testing.assert_allclose(weights.coverage, expected, atol=1e-9)
    sums = np.asarray(weights.areas.sum(axis=1)).ravel()
    np.testing.assert_allclose(sums[weights.coverage.ravel() > 0], 1.0)


def test_inner_pixels_have_all_eight_neighbours(registration):
    weights = plan_weights(registration, PLAN)
    assert (weights.interior == ndimage.binary_erosion(weights.used, np.ones((3, 3)))).all()
    assert 0 < weights.interior.sum() < weights.used.sum()
    for shape in ((1, 9), (9, 2), (3, 3)):
        narrow = replace(weights)
        vars(narrow)["used"] = np.ones(shape, bool)
        assert narrow.interior.sum() == (shape == (3, 3))


def test_noise_that_a_row_or_a_column_shares_falls_with_their_number_in_a_cell(registration):
    weights = plan_weights(registration, PLAN)
    before = weights.areas.data.copy()
    # An inner cell of 10 x 10 pixels.
    assert weights.noise_factor[2, 2] == pytest.approx(0.01)
    assert [factor[2, 2] for factor in weights.line_factors] == pytest.approx([0.1, 0.1])
    assert (weights.areas.data == before).all()


def test_a_linear_field_is_exact_in_partly_seen_cells_too(registration):
    weights = plan_weights(registration, PLAN)
    x, y = np.moveaxis(places_mm(), -1, 0)
    values = (20 + 0.1 * x - 0.2 * y)[weights.window]
    cells = weights.resample(values)
    seen = np.isfinite(cells)
    assert (seen == (weights.coverage >= 0.5)).all()
    assert (weights.coverage[seen] < 0.99).sum() > 20
    centres = PLAN.centres_mm
    error = cells - (20 + 0.1 * centres[..., 0] - 0.2 * centres[..., 1])
    # Cells whose seen area is centred to 0.1 mm, 2 % of a cell, are not moved.
    moved = np.diff(weights.centring.indptr).reshape(PLAN.shape) > 0
    exact = seen & (moved | (weights.coverage == 1))
    np.testing.assert_allclose(error[exact], 0.0, atol=1e-9)
    assert np.abs(error[seen & ~exact]).max() < 0.1 * 0.1 + 0.1 * 0.2
    # By area alone, cells at the edge show the centre of what is seen of them: 0.5 mm inside, in both directions.
    assert weights.average(values)[0, 5] - cells[0, 5] == pytest.approx(-0.2 * 0.5)


def test_noise_factor_is_that_of_independent_pixels(registration, rng):
    weights = plan_weights(registration, PLAN)
    shape = weights.used.shape
    scatter = np.var([weights.resample(rng.normal(0, 1, shape)) for _ in range(400)], axis=0)
    seen = np.isfinite(scatter)
    # A cell of 100 pixels; 400 fields give a variance to 7 %.
    assert weights.noise_factor[3, 1] == pytest.approx(0.01)
    np.testing.assert_allclose(scatter[seen], weights.noise_factor[seen], rtol=0.35)


def test_pixels_on_borders_of_cells_are_divided():
    """A scene in perspective: cells far from discs and edge are seen as a whole."""
    registration = registered()
    weights = plan_weights(registration, GRID)
    constant = weights.resample(np.full(weights.used.shape, 23.0))
    np.testing.assert_allclose(constant[np.isfinite(constant)], 23.0, rtol=1e-12)
    far = ~mask_discs(GRID.centres_mm, DISCS, margin_mm=8.0)[2:-2, 2:-2]
    # A pixel is 1.2 mm: sixteen parts of it put 0.02 of a cell of 5 mm to its neighbour at most.
    assert abs(weights.coverage[2:-2, 2:-2][far] - 1).max() < 0.05


@pytest.mark.parametrize("cell_mm", [8.0, 3.0, 2.0, 1.5, 1.0, 0.5, 0.2])
def test_cells_of_every_size_are_seen_by_the_pixels_above_them(cell_mm, monkeypatch):
    """Pixels of 3 mm, turned by a degree: all cells inside the margin are seen, and a linear field is true within half a pixel."""
    grid = PlanGrid(72, 48, cell_mm)
    corners = [
        Fiducial(name, *place, 1.0) for name, place in zip("ABCD", itertools.product((0, 72), (0, 48)), strict=True)
    ]
    along = np.exp(1j * np.deg2rad(1.0)) / 3.0
    on_sensor = {one.name: 4.0 + 3.0j + along * complex(one.x_mm, one.y_mm) for one in corners}
    picked = {name: (place.real, place.imag) for name, place in on_sensor.items()}
    registration = replace(register_points(picked, corners, (24, 32)), masked=())
    monkeypatch.setattr(Registration, "margin_px", 0.0)
    weights = plan_weights(registration, grid)
    inner = grid.contains(grid.centres_mm, margin_mm=3.0 + cell_mm)
    assert inner.any() and (weights.coverage[inner] >= LEAST_COVERAGE).all()
    rows, columns = weights.window
    column, row = np.meshgrid(np.arange(columns.stop), np.arange(rows.start, rows.stop))
    x = registration.to_plan(np.stack([column, row], axis=-1).astype(float))[..., 0]
    error = weights.resample(x) - grid.centres_mm[..., 0]
    assert np.abs(error[inner]).max() < 1.5 * 1.1


def test_centring_moves_a_cell_along_the_gradient_of_its_neighbours():
    offset, coverage = np.zeros((PLAN.shape[0] * PLAN.shape[1], 2)), np.ones(PLAN.shape)
    cell = 3 * PLAN.shape[1] + 4
    offset[cell] = (1.0, -0.5)
    matrix = centring_matrix(offset, coverage, PLAN)
    assert np.flatnonzero(np.diff(matrix.indptr)).tolist() == [cell]
    seen_centres = PLAN.centres_mm.reshape(-1, 2) + offset
    linear = 20 + seen_centres @ (0.3, 0.7)
    assert (matrix @ linear)[cell] == pytest.approx(-(0.3 * 1.0 - 0.7 * 0.5))


def test_a_plan_out_of_view_is_refused():
    below = overhead(PLAN, [DISC], shape=SHAPE, px_per_mm=2.0, origin_px=(9.5, 104.5))
    with pytest.raises(ThermographyError, match="no pixel of the frame is on the plan; check the fiducials"):
        plan_window(below, PLAN)
    aside = overhead(PLAN, [DISC], shape=SHAPE, px_per_mm=2.0, origin_px=(209.5, 4.5))
    with pytest.raises(ThermographyError, match="no pixel of the frame is on the plan; check the fiducials"):
        plan_weights(aside, PLAN)
