"""Where frames are cut into blocks, one block against its frames calibrated one by one, and frames on their way to workers."""

from dataclasses import replace

import numpy as np
import pytest

from tests.thermography.plan_scene import GRID, SC660, START, Scene, edges, record, registered
from thermography.fields import blocks as blocks_module
from thermography.fields.blocks import (
    NO_CYCLE,
    RegisteredSensor,
    cut_blocks,
    make_frame_series,
    reduce_block,
)
from thermography.fields.resampling import plan_weights
from thermography.radiometry.camera import Detector
from thermography.radiometry.planck import calibrate, override
from thermography.registration.displacement import RegistrationSpan, monitor_fiducials


@pytest.fixture(scope="module")
def registration():
    return registered()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Ten small frames, one per second."""
    return record(tmp_path_factory.mktemp("blocks") / "a.seq", [np.full((8, 8), 20.0)] * 10)


def series(references, bounds, parameters=lambda frame: frame.parameters, **options):
    return make_frame_series(references, edges(*bounds), shape=(8, 8), override=parameters, **options)


def cuts(blocks):
    return [(block.first, block.stop) for block in blocks]


def test_blocks_end_with_time_cycle_registration_parameters_and_correction(small, registration):
    whole = [RegistrationSpan(0, registration)]
    assert cuts(cut_blocks(series(small, [0, 10]), whole, block_s=4)) == [(0, 4), (4, 8), (8, 10)]
    assert cuts(cut_blocks(series(small, [0, 10]), whole, block_s=0)) == [(i, i + 1) for i in range(10)]
    in_cycles = cut_blocks(series(small, [1, 6]), whole, block_s=60)
    assert [(block.first, block.stop, block.cycle) for block in in_cycles] == [(0, 1, -1), (1, 6, 0), (6, 10, -1)]
    spans = [*whole, RegistrationSpan(7, registration)]
    assert [block.span for block in cut_blocks(series(small, [0, 10]), spans, block_s=60)] == [0, 1]
    dimmed = series(small, [0, 10], lambda f: override(f.parameters, emissivity=0.97 if f.index < 3 else 0.9))
    assert cuts(cut_blocks(dimmed, whole, block_s=60)) == [(0, 3), (3, 10)]
    corrected = series(small, [0, 10], correction_K=0.0008 * np.arange(10))
    # Corrections within a block differ by no more than 2 mK.
    assert cuts(cut_blocks(corrected, whole, block_s=60)) == [(0, 3), (3, 6), (6, 9), (9, 10)]
    assert cuts(cut_blocks(series(small, [0, 10]), whole, block_s=60, first=8)) == [(8, 10)]


def test_blocks_hold_a_limited_number_of_frames(small, registration, monkeypatch):
    monkeypatch.setattr(blocks_module, "BLOCK_FRAMES", 3)
    blocks = cut_blocks(series(small, [0, 10]), [RegistrationSpan(0, registration)], block_s=60)
    assert cuts(blocks) == [(0, 3), (3, 6), (6, 9), (9, 10)]


@pytest.mark.long
def test_a_block_is_the_mean_of_its_calibrated_frames(registration, rng, tmp_path):
    scene = Scene(disc_K=-4.0)
    images = [replace(scene, shift_px=(0.4, 0.0)).render(rng), *(scene.render(rng) for _ in range(9))]
    # One pixel varies too much for an average of counts.
    images[4][220, 300] += 40.0
    frames = record(tmp_path / "a.seq", images)
    weights = plan_weights(registration, GRID)
    sensor = RegisteredSensor(
        weights, monitor_fiducials(registration, GRID, weights.window), Detector.sound(registration.shape)
    )
    result = reduce_block(frames, SC660, sensor)
    each = np.stack([calibrate(frame.read().counts, SC660)[weights.window] for frame in frames]).astype(float)
    used = weights.used
    np.testing.assert_allclose(result.temperature.mean[used], each.mean(axis=0)[used], atol=5e-4)
    hot = (220 - weights.window[0].start, 300)
    assert result.temperature.mean[hot] == pytest.approx(each.mean(axis=0)[hot], abs=2e-6)
    assert result.temperature.variance[hot] == pytest.approx(each.var(axis=0)[hot], rel=1e-6)
    np.testing.assert_allclose(result.cells, weights.resample(result.temperature.mean))
    np.testing.assert_allclose(result.displacement_px[:, :2], [(0.4, 0.0)] + [(0.0, 0.0)] * 9, atol=0.08)
    single = reduce_block(frames[:1], SC660, sensor)
    np.testing.assert_array_equal(single.temperature.mean, each[0])


def test_cycles_names_times_and_temperatures_of_frames(tmp_path):
    stored = record(tmp_path / "a.seq", [np.full((8, 8), 20.0 + i) for i in range(6)])
    assert series(stored, [[0, 2], [3, 5]]).cycles.tolist() == [0, 0, NO_CYCLE, 1, 1, NO_CYCLE]
    assert series(stored, [1, 3, 4]).cycles.tolist() == [-1, 0, 0, 1, -1, -1]
    frames = series(stored, [0, 6])
    assert len(frames) == 6
    assert frames.names(np.array([False, True, False, False, False, True])) == ["a.seq#1", "a.seq#5"]
    assert frames.mean_time(slice(1, 5)) == START + 2.5 * np.timedelta64(1000, "ms")
    np.testing.assert_array_equal(frames.temperature(3), calibrate(stored[3].read_counts(), stored[3].parameters))
    assert frames.correction_K.tolist() == [0.0] * 6
