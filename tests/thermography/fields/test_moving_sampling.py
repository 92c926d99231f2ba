"""Frames of a camera that looks straight down, sampled where every value is known."""

import numpy as np
import pytest

from tests.thermography.plan_scene import overhead
from thermography.fields.moving_sampling import CellSums, add_frame, on_plan, sample_points, weigh_pixels
from thermography.registration.plan import Fiducial, PlanGrid

PLAN = PlanGrid(60, 40, 5)
SHAPE = (120, 200)
DISC = Fiducial("D", 31.0, 21.0, 8.0)
#: A linear calibration, 0.01 K per count.
CALIBRATION = 0.01 * np.arange(65536.0)


@pytest.fixture(scope="module")
def registration():
    return overhead(PLAN, [DISC], shape=SHAPE, px_per_mm=2.0, origin_px=(10.0, 10.0))


@pytest.fixture(scope="module")
def samples(registration):
    return sample_points(registration, PLAN)


def empty_sums(samples):
    cells = len(samples.valid)
    return CellSums(np.zeros(cells, np.int64), np.zeros(cells), np.zeros(cells))


def add(counts, samples, registration, shift, sums, *, correction=0.0, calibration=CALIBRATION):
    lens = registration.projection.as_array
    weights = weigh_pixels(samples.points_mm, samples.valid, np.array(shift), lens, SHAPE)
    add_frame(counts, calibration, weights, correction, sums)


def test_points_lie_in_their_cells_and_off_disc_and_edge(samples):
    assert samples.points_mm.shape == (8 * 12, 16, 2)
    np.testing.assert_allclose(samples.points_mm.mean(axis=1), PLAN.centres_mm.reshape(-1, 2))
    assert np.ptp(samples.points_mm[0], axis=0) == pytest.approx([3.75, 3.75])
    # Margins are 2.5 px of 0.5 mm: of points 0.625, 1.875, ... mm from the edge the first is masked, on the disc all within 5.25 mm.
    assert samples.coverage[0, 0] == pytest.approx(9 / 16)
    assert samples.coverage[0, 5] == pytest.approx(12 / 16)
    distance = np.hypot(*np.moveaxis(samples.points_mm - (31.0, 21.0), -1, 0))
    assert not samples.valid[distance < 5.25].any()
    assert samples.coverage[2, 2] == 1


@pytest.mark.parametrize("shift", [(0.0, 0.0), (7.3, 2.2)])
def test_a_linear_field_is_exact_wherever_the_table_is(registration, samples, shift):
    column, row = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    counts = (2000 + 4 * column + 6 * row).astype(np.uint16)
    sums = empty_sums(samples)
    add(counts, samples, registration, shift, sums, correction=0.5)
    field = on_plan(sums.frames, sums.mean, samples, PLAN)
    centres = PLAN.centres_mm + shift
    expected = 0.01 * (2000 + 4 * (10 + 2 * centres[..., 0]) + 6 * (10 + 2 * centres[..., 1])) + 0.5
    seen = np.isfinite(field)
    assert (seen == (samples.coverage >= 0.5)).all()
    np.testing.assert_allclose(field[seen], expected[seen], atol=1e-6)


def test_cells_partly_out_of_view_are_left_out(registration, samples):
    counts = np.full(SHAPE, 2000, np.uint16)
    sums = empty_sums(samples)
    # Column 199, the last one, shows plan x = 94.5 mm: displaced by 60 mm, the cells beyond 35 mm are out of view.
    add(counts, samples, registration, (60.0, 0.0), sums)
    frames = sums.frames.reshape(PLAN.shape)
    assert frames[2].tolist() == [1] * 7 + [0] * 5
    assert np.isnan(on_plan(sums.frames, sums.mean, samples, PLAN)[:, 7:]).all()


def test_mean_and_deviation_over_frames_and_calibration_point_by_point(registration, samples, rng):
    sums = empty_sums(samples)
    levels = rng.integers(1000, 3000, 7)
    for level in levels:
        add(np.full(SHAPE, level, np.uint16), samples, registration, (0.0, 0.0), sums)
    shown = samples.valid.any(axis=1)
    np.testing.assert_allclose(sums.mean[shown], 0.01 * levels.mean())
    np.testing.assert_allclose(sums.squares[shown], 7 * np.var(0.01 * levels))
    # A curved calibration and counts more than 600 apart: the mean of the pixels' temperatures, not the temperature of the mean.
    curved, steep = (1e-3 * np.arange(65536.0)) ** 2, np.zeros(SHAPE, np.uint16)
    steep[:] = 200 * np.arange(SHAPE[1])
    sums = empty_sums(samples)
    add(steep, samples, registration, (0.0, 0.0), sums, calibration=curved)
    cell = 2 * PLAN.shape[1] + 2
    columns = 10 + 2 * samples.points_mm[cell, :, 0]
    temperatures = (1e-3 * steep[0].astype(float)) ** 2
    assert sums.mean[cell] == pytest.approx(np.interp(columns, np.arange(SHAPE[1]), temperatures).mean(), abs=1e-6)


def test_a_pixel_without_temperature_counts_only_where_it_has_a_weight(registration, samples):
    counts = np.full(SHAPE, 2000, np.uint16)
    below = np.where(np.arange(65536) < 1000, np.nan, CALIBRATION)
    # Cell (3, 5) has points at columns 61.25 to 68.75 and rows 41.25 to 48.75, but those of its lower right corner lie on the disc.
    counts[49, 69] = 10
    counts[36, 46] = 10
    sums = empty_sums(samples)
    add(counts, samples, registration, (0.0, 0.0), sums, calibration=below)
    means = sums.mean.reshape(PLAN.shape)
    assert means[3, 5] == pytest.approx(20.0)
    assert np.isnan(means[2, 3])
