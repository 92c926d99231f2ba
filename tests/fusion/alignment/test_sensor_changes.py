"""Changes of a sensor beyond its prediction: grids, residuals, excursions and the time of a ramp."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.sensor_changes import fit_ramp, largest_excursion, lay_grid, predicted_changes


def wandering(n: int = 600, sensors: int = 4, seed: int = 1) -> np.ndarray:
    """Sensors that follow two sources with gains of their own, and noise."""
    rng = np.random.default_rng(seed)
    sources = np.cumsum(rng.normal(0.0, 0.05, (n, 2)), axis=0)
    return 20.0 + sources @ rng.uniform(0.5, 1.5, (2, sensors)) + rng.normal(0.0, 0.01, (n, sensors))


def test_grids_are_fine_only_where_there_are_more_samples_than_blocks():
    assert [grid.is_fine for grid in lay_grid(np.arange(500.0), wandering(500), None)] == [False]
    fine, coarse = lay_grid(np.arange(5000.0), wandering(5000), None)
    assert (fine.seconds.size, fine.step_s) == (5000, 1.0)
    assert coarse.seconds.size <= 600
    assert fine.durations() == (1, 2)
    assert coarse.durations() == (1, 2, 4, 8, 16)


def test_a_missing_reading_is_interpolated_and_a_pause_left_out():
    temperature = wandering(600)
    temperature[100:103, 0] = np.nan
    seconds = np.r_[np.arange(300.0), 9000.0 + np.arange(300.0)]
    (grid,) = lay_grid(seconds, temperature, None)
    assert grid.seconds.size == 600
    assert np.isfinite(grid.temperature).all()
    assert not grid.known[100:103, 0].any()
    assert grid.known[:, 1].all()


def test_the_others_predict_what_they_share():
    (grid,) = lay_grid(np.arange(600.0), wandering(), None)
    changes = predicted_changes(grid, 0, [1, 2, 3], 16)
    alone = predicted_changes(grid, 0, [], 16)
    assert np.std(changes.residual) < 0.5 * np.std(alone.residual)


@pytest.mark.parametrize("sensor", [0, 2])
def test_a_jump_is_an_excursion_of_its_own_sensor_alone(sensor):
    temperature = wandering()
    temperature[350:, sensor] += 2.0
    (grid,) = lay_grid(np.arange(600.0), temperature, None)
    ratios = []
    for k in range(4):
        found = largest_excursion(predicted_changes(grid, k, [j for j in range(4) if j != k], 1))
        assert found is not None
        ratios.append(found.ratio)
        if k == sensor:
            assert found.first < 350 <= found.last
    # Noise of a median of three is 0.007 K: a jump of 2 K is far beyond any other change.
    assert ratios[sensor] > 10.0
    assert np.argmax(ratios) == sensor


@pytest.mark.parametrize(("begin", "end"), [(200, 201), (150, 260)])
def test_a_ramp_is_timed_within_twice_its_uncertainty(begin, end):
    seconds = 10.0 * np.arange(400)
    ramp = 3.0 * np.clip((np.arange(400) - begin) / (end - begin), 0.0, 1.0)
    fitted = fit_ramp(seconds, ramp + np.random.default_rng(2).normal(0.0, 0.05, 400))
    assert abs(fitted.begin_s - 10.0 * begin) <= 2.0 * fitted.begin_u_s + 10.0
    assert fitted.size_K == pytest.approx(3.0, abs=0.1)
    assert fitted.begin_u_s < 100.0


def test_switchings_inside_and_outside_a_time_are_told_apart():
    load = (np.arange(600) // 100 % 2).astype(float)
    (grid,) = lay_grid(np.arange(600.0), wandering(), load[:, None])
    assert grid.switchings(195.0, 205.0) == (True, 4)
    assert grid.switchings(220.0, 240.0) == (False, 5)
    (unlogged,) = lay_grid(np.arange(600.0), wandering(), None)
    assert unlogged.switchings(0.0, 600.0) == (False, 0)
