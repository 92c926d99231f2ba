"""A table that travels through the view: its place in every frame, the field attached to it, and how cells are sampled."""

import json
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import (
    GRID,
    Scene,
    assert_equal_bits,
    cell_truth,
    edges,
    overhead,
    record,
    registered,
)
from thermography.fields import moving
from thermography.fields.blocks import ReductionError
from thermography.fields.moving import CellSums, add_frame, on_plan, reduce_moving_frames, sample_points, weigh_pixels
from thermography.fields.still import CheckpointError
from thermography.registration.plan import Fiducial, PlanGrid

pytestmark = pytest.mark.long

DIRECTION = (-1, 0)
PLACES_MM = np.array([0.0, 121.3, 200.5, 299.7, 160.2, 5.5])


@pytest.fixture(scope="module")
def travel(tmp_path_factory):
    """Six frames of a table that moves 300 mm, seen by a lens of k1 = -1.2; registered where it stood first."""
    rng = np.random.default_rng(7)
    home = Scene(disc_K=-4.0, k1=-1.2, rays=3, corners_px=((80, 150), (480, 140), (495, 285), (75, 300)))
    registration = registered(home)
    # The plan point under the spindle moves along -x as the axis position grows, so the table moves along +x.
    images = (replace(home, shift_mm=(float(p), 0.0)).render(rng) for p in PLACES_MM)
    frames = record(tmp_path_factory.mktemp("travel") / "a.seq", images)
    fields = reduce_moving_frames(frames, registration, GRID, edges(0, 3, 6), direction=DIRECTION)
    return home, registration, frames, fields


def test_place_of_the_table_is_known_in_every_frame(travel):
    _, _, _, fields = travel
    error = fields["table_position"].values - PLACES_MM
    # The aim is 0.3 mm per frame; a pixel is 1.7 mm. From 160.2 to 5.5 mm most discs land near the place of their neighbour.
    assert np.abs(error).max() < 0.1
    assert np.abs(fields["table_across"].values).max() < 0.1
    assert (np.abs(error) < 4 * fields["table_position_u"].values).all()
    assert (fields["table_discs"] >= 6).all()


def test_fields_of_frames_at_different_places_overlay_within_their_uncertainty(travel):
    _, _, _, fields = travel
    error = fields["temperature"].values - cell_truth()
    # Three frames, 3 x 4 px of 50 mK per cell: 8 mK; a misplacement of 0.1 mm in the largest gradient is 2 mK.
    assert np.sqrt(np.nanmean(error**2)) < 0.012
    assert abs(np.nanmean(error)) < 0.002
    inside = np.isfinite(fields["temperature"].values[0])
    # The outermost row of cells lies within the lens blur of the edge.
    assert inside.mean() > 0.85
    assert fields["count"].values[0].max() == 3
    # At 300 mm the far end of the table has left the view.
    assert fields["count"].values[1][30:34, -3].min() < 3
    ratio = np.sqrt(np.nanmean((error / fields["temperature_noise_u"].values) ** 2))
    # Neighbouring cells share pixels and misplacement, so that a few hundred values are independent.
    assert 0.7 < ratio < 1.4


def test_frames_of_a_standing_table_are_sampled_alike(tmp_path, monkeypatch):
    home = Scene(disc_K=-4.0, corners_px=((80, 150), (480, 140), (495, 285), (75, 300)))
    rng = np.random.default_rng(3)
    frames = record(tmp_path / "a.seq", (home.render(rng) for _ in range(6)))
    registration = registered(home)
    computed = []
    weigh = moving.weigh_pixels
    monkeypatch.setattr(moving, "weigh_pixels", lambda *given: computed.append(given) or weigh(*given))
    alike = reduce_moving_frames(frames, registration, GRID, edges(0, 6), direction=DIRECTION)
    assert len(computed) == 1
    monkeypatch.setattr(moving, "_STANDING_MM", 0.0)
    apart = reduce_moving_frames(frames, registration, GRID, edges(0, 6), direction=DIRECTION)
    assert len(computed) == 7
    # Sampled 0.02 mm beside its place, a cell is wrong by that times the gradient, here at most 0.017 K/mm; the noise of single pixels,
    # 50 mK from one to the next of 1.7 mm, has a gradient too, of which a cell's 12 pixels and 6 frames leave 0.2 mK.
    difference = alike["temperature"].values - apart["temperature"].values
    assert np.nanmax(np.abs(difference)) < 1e-3
    assert abs(np.nanmean(difference)) < 2e-5
    np.testing.assert_array_equal(alike["table_position"], apart["table_position"])


def test_frames_without_the_table_are_named(travel, tmp_path):
    home, registration, _, _ = travel
    images = [home.render(), Scene(discs=(), field=lambda x, y: np.full_like(x, 22.5)).render()]
    frames = record(tmp_path / "a.seq", images)
    fields = reduce_moving_frames(frames, registration, GRID, edges(0, 2), direction=DIRECTION)
    assert json.loads(fields.attrs["frames_unplaced"]) == ["a.seq#1"]
    assert fields["table_discs"].values.tolist()[1] == 0
    assert np.isnan(fields["table_position"].values[1])
    with pytest.raises(ReductionError, match="the table is found in no frame; check the fiducials"):
        reduce_moving_frames(frames[1:], registration, GRID, edges(0, 2), direction=DIRECTION)
    with pytest.raises(ReductionError, match="no frame in which the table is found is within a cycle"):
        reduce_moving_frames(frames[:1], registration, GRID, edges(5, 7), direction=DIRECTION)


RUN = """
import sys
from pathlib import Path
from tests.thermography.plan_scene import GRID, edges
from tests.thermography.fields.test_moving import DIRECTION, load
from thermography.fields import moving
from thermography.io.flir import index_frames

frames, _ = index_frames([sys.argv[1]])
registration = load(Path(sys.argv[2]))


def progress(count):
    print(count, flush=True)
    # Whoever started this run kills it here.
    sys.stdin.readline()


moving.reduce_moving_frames(
    frames, registration, GRID, edges(0, 3, 6), direction=DIRECTION, block_s=1, checkpoint=sys.argv[3], progress=progress
)
"""


def load(path):
    return pickle.loads(path.read_bytes())


def test_a_killed_run_goes_on_at_the_first_stretch_that_is_not_done(travel, tmp_path):
    _, registration, frames, _ = travel
    (tmp_path / "registration").write_bytes(pickle.dumps(registration))
    command = [sys.executable, "-c", RUN, frames[0].path, tmp_path / "registration", tmp_path / "cp"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout.readline() == "3\n"
        run.kill()
    assert run.returncode != 0
    seen, given, how = [], (frames, registration, GRID, edges(0, 3, 6)), {"direction": DIRECTION, "block_s": 1}
    again = reduce_moving_frames(*given, checkpoint=tmp_path / "cp", progress=seen.append, **how)
    # The first of two cycles was done.
    assert seen == [3, 3]
    assert_equal_bits(reduce_moving_frames(*given, **how), again)
    with pytest.raises(CheckpointError, match=r"holds cycles of another reduction \(other reach_mm\); remove the"):
        reduce_moving_frames(*given, checkpoint=tmp_path / "cp", reach_mm=400.0, **how)


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
    field = on_plan(sums.frames, sums.mean, samples)
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
    assert np.isnan(on_plan(sums.frames, sums.mean, samples)[:, 7:]).all()


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
