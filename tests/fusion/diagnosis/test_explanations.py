"""Fits of one target's residual: known steps, lags and walks are recovered, and noise alone gives uniform p-values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fusion.diagnosis.explanations import (
    LAGS_S,
    Residual,
    fit_profile,
    fit_random_walk,
    lagged_temperature,
    local_residuals,
    serial_p_value,
    step_columns,
    step_instant,
    warm_up_share,
)
from tests.fusion.residual_simulator import odd_position

CYCLES = 60
SECONDS = 252.0 * np.arange(CYCLES)


def residual_of(values: np.ndarray, temperature: tuple[np.ndarray, np.ndarray] | None = None) -> Residual:
    return Residual(3, SECONDS, values, np.arange(1, CYCLES + 1), 0.4, temperature)


def test_the_residual_is_free_of_drift_and_has_the_noise_of_a_reading(rng):
    fused = odd_position("structural", rng, rms_um=0.0)
    residual = local_residuals(fused, 3, {3})
    # 200 readings know their scatter to 5 %, the 15 other targets theirs to 1 %; levels and stretches of each pass cost 4 %.
    assert np.std(residual.values) == pytest.approx(0.4, rel=0.2)
    assert residual.typical_um == pytest.approx(0.4, rel=0.1)
    walk = fit_random_walk(residual)
    assert walk.shared - walk.white < 3.0


def test_steps_leave_five_cycles_on_either_side():
    columns = step_columns(CYCLES)
    assert columns.shape == (CYCLES, CYCLES - 9)
    for column in (0, 20, columns.shape[1] - 1):
        assert np.flatnonzero(columns[:, column])[0] == step_instant(column)
    assert step_instant(0) == 5
    assert columns[:, -1].sum() == 5


def test_step_is_recovered_with_its_uncertainty(rng):
    fits = []
    for _ in range(20):
        values = 0.4 * rng.standard_normal((2, CYCLES))
        values[:, 25:] += 1.0
        fits.append(fit_profile(residual_of(values), step_columns(CYCLES), rng))
    # a random walk can imitate a step of 3.5 standard deviations of the mean, but seldom
    assert sum(fit.p_value < 0.05 for fit in fits) >= 18
    assert np.median([step_instant(fit.best) for fit in fits]) == 25
    assert all(fit.hold_out_gain > 0 for fit in fits)
    pull = [(fit.coefficient - 1.0) / fit.coefficient_u for fit in fits]
    # the best of 51 steps is fitted a little too large; 20 fits know the spread of their pulls to 16 %
    assert np.std(pull) < 2.0
    assert abs(np.mean(pull)) < 1.5
    # the coefficients of the two directions average to that of their mean
    np.testing.assert_allclose([np.mean(fit.by_direction) for fit in fits], [fit.coefficient for fit in fits], atol=0.1)


def test_noise_alone_gives_uniform_p_values(rng):
    p_values = [
        fit_profile(residual_of(0.4 * rng.standard_normal((2, CYCLES))), step_columns(CYCLES), rng).p_value
        for _ in range(60)
    ]
    # Kolmogorov and Smirnov: one test in a thousand fails by chance
    assert stats.kstest(p_values, "uniform").pvalue > 0.001


def test_temperature_response_through_a_lag_is_recovered(rng):
    frames = np.arange(0.0, SECONDS[-1], 60.0)
    rise = np.cumsum(rng.standard_normal(frames.size)) * 0.2
    columns = lagged_temperature(residual_of(np.zeros((2, CYCLES)), (frames, rise)))
    assert columns is not None and columns.shape == (CYCLES, len(LAGS_S))
    np.testing.assert_allclose(columns[:, 0], np.interp(SECONDS, frames, rise))
    lagged = 2  # 1800 s
    values = 0.5 * columns[:, lagged] + 0.1 * rng.standard_normal((2, CYCLES))
    fit = fit_profile(residual_of(values), columns, rng)
    assert fit.best == lagged
    assert fit.coefficient == pytest.approx(0.5, abs=4 * fit.coefficient_u)


def test_without_a_camera_there_is_no_temperature():
    assert lagged_temperature(residual_of(np.zeros((2, CYCLES)))) is None


def test_walk_in_one_direction_is_told_from_a_shared_one(rng):
    noise = 0.2 * rng.standard_normal((2, CYCLES))
    walk = 0.3 * np.cumsum(rng.standard_normal(CYCLES))
    shared = fit_random_walk(residual_of(noise + walk))
    assert shared.shared > shared.one_direction + 5.0
    alone = fit_random_walk(residual_of(noise + np.array([walk, np.zeros(CYCLES)])))
    assert alone.one_direction > alone.shared + 5.0
    neither = fit_random_walk(residual_of(noise))
    # a likelihood ratio of one variance: 3.8 / 2 nats once in 40 samples
    assert max(neither.shared, neither.one_direction) - neither.white < 3.0


def test_one_direction_alone_has_no_walk_of_its_own(rng):
    values = 0.2 * rng.standard_normal((2, CYCLES))
    values[1] = np.nan
    residual = residual_of(values)
    assert residual.parts.difference is None
    assert fit_random_walk(residual).one_direction == -np.inf
    assert np.isnan(residual.scatter_um[1])
    assert residual.scatter_um[0] == pytest.approx(0.2, rel=0.35)


def test_serial_test_sees_a_walk_and_keeps_its_level_on_noise(rng):
    walk = np.tile(np.cumsum(rng.standard_normal(CYCLES)), (2, 1))
    assert serial_p_value(residual_of(walk), rng) == 1 / 500
    p_values = [serial_p_value(residual_of(rng.standard_normal((2, CYCLES))), rng) for _ in range(60)]
    assert stats.kstest(p_values, "uniform").pvalue > 0.001


def test_exponential_warm_up_is_all_warm_up_and_a_switched_load_is_not():
    assert warm_up_share(SECONDS, 3.0 * (1.0 - np.exp(-SECONDS / 2700.0))) > 0.995
    assert warm_up_share(SECONDS, np.sign(np.sin(2 * np.pi * SECONDS / 3600.0))) < 0.5
