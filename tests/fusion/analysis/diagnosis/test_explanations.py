"""Fits of one target's residual: known steps, lags and walks are recovered, and noise alone gives uniform p-values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fusion.analysis.diagnosis import explanations as module
from fusion.analysis.diagnosis.explanations import (
    LAGS_S,
    Residual,
    fit_profile,
    fit_random_walk,
    fit_scatter,
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


def test_temperature_response_through_a_lag_is_recovered(rng):
    frames = np.arange(0.0, SECONDS[-1], 60.0)
    rise = np.cumsum(rng.standard_normal(frames.size)) * 0.2
    columns = lagged_temperature(residual_of(np.zeros((2, CYCLES)), (frames, rise)))
    assert columns is not None and columns.shape == (CYCLES, len(LAGS_S))
    # Without a camera there is no temperature.
    assert lagged_temperature(residual_of(np.zeros((2, CYCLES)))) is None
    np.testing.assert_allclose(columns[:, 0], np.interp(SECONDS, frames, rise))
    lagged = 2  # 1800 s
    values = 0.5 * columns[:, lagged] + 0.1 * rng.standard_normal((2, CYCLES))
    fit = fit_profile(residual_of(values), columns, rng)
    assert fit.best == lagged
    assert fit.coefficient == pytest.approx(0.5, abs=4 * fit.coefficient_u)


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


def test_the_serial_test_sees_a_walk_and_not_noise(rng):
    walk = np.tile(np.cumsum(rng.standard_normal(CYCLES)), (2, 1))
    assert serial_p_value(residual_of(walk), rng) == 1 / 500
    assert serial_p_value(residual_of(rng.standard_normal((2, CYCLES))), rng) > 0.01


def test_exponential_warm_up_is_all_warm_up_and_a_switched_load_is_not():
    assert warm_up_share(SECONDS, 3.0 * (1.0 - np.exp(-SECONDS / 2700.0))) > 0.995
    assert warm_up_share(SECONDS, np.sign(np.sin(2 * np.pi * SECONDS / 3600.0))) < 0.5
    # The temperature of the table before the test says nothing, and a steady rise is a warm-up altogether.
    assert warm_up_share(SECONDS, 20.0 + np.sign(np.sin(2 * np.pi * SECONDS / 3600.0))) < 0.5
    assert warm_up_share(SECONDS, 20.0 + 1e-4 * SECONDS) == pytest.approx(1.0, abs=1e-9)
    assert warm_up_share(SECONDS, np.full(CYCLES, 20.0)) == 1.0


def test_level_and_stretch_of_every_pass_come_from_the_sound_targets_that_were_read(rng):
    """Without noise nothing is left but the motion of the flagged target, whatever readings are missing."""
    position = np.linspace(0.0, 300.0, 7)
    profile = rng.normal(0.0, 3.0, (2, 7))
    passes = rng.normal(0.0, 2.0, (12, 2, 1)) + rng.normal(0.0, 0.01, (12, 2, 1)) * position
    own = np.sin(np.arange(12.0))[:, None] * [1.0, -2.0]
    deviation = profile + passes
    deviation[:, :, 4] += own
    deviation[3, 0, [0, 6]] = np.nan
    deviation[5, 1, 4] = np.nan
    deviation[8, 1, :5] = np.nan
    sound = np.arange(7) != 4
    design = np.column_stack([np.ones(7), position / 300.0 - 0.5])
    left = module._without_passes(deviation, design, sound)
    # The pass with two sound readings has no line.
    assert np.isnan(left[8, 1]).all()
    kept = np.isfinite(left[:, :, 4])
    expected = np.where(kept, own, np.nan)
    assert np.abs(np.where(np.isfinite(left), left, 0.0)[:, :, sound]).max() < 1e-4
    centred = left[:, :, 4] - np.nanmean(left[:, :, 4], axis=0)
    np.testing.assert_allclose(centred, expected - np.nanmean(expected, axis=0), atol=1e-4)


def test_an_explanation_gains_half_its_likelihood_ratio_over_the_walk_that_it_stands_beside(rng):
    residual = residual_of(0.3 * rng.standard_normal((2, CYCLES)) + np.where(np.arange(CYCLES) < 30, 0.0, 0.5))
    walk = fit_random_walk(residual)
    # A constant is the mean again: nothing gained.
    nothing = fit_profile(residual, np.ones((CYCLES, 1)), rng)
    assert nothing.log_likelihood == pytest.approx(walk.shared, abs=1e-4) and nothing.p_value == 1.0
    column = step_columns(CYCLES)[:, [25]]
    parts = residual.parts
    bank = module.fit_null(parts.grid, parts.mean)
    ratio = module.likelihood_ratios(module.whiten_series(bank, parts.mean[None]), column.astype(np.float32))
    fit = fit_profile(residual, column, rng)
    assert fit.log_likelihood == pytest.approx(walk.shared + 0.5 * float(ratio[0, 0]), abs=1e-3)
    assert fit.log_likelihood > walk.shared + 5.0
    # The mean of both directions is sqrt(2) times their average; the coefficient is that of the average.
    assert fit.coefficient == pytest.approx(0.5, abs=4 * fit.coefficient_u)
    assert fit.coefficient_u < 0.15


def test_what_one_direction_gains_in_the_other_is_known_without_a_walk(rng):
    """Alternating series leave no walk: sizes are plain projections, and each gains half its freedom times the logarithm of its squares."""
    alternating, other = np.tile([1.0, -1.0], CYCLES // 2), np.tile([1.0, 1.0, -1.0, -1.0], CYCLES // 4)
    sides = np.array([1.0 * alternating + 0.2 * other, 0.5 * alternating - 0.4 * other])
    fit = fit_profile(residual_of(sides), alternating[:, None], rng)
    assert fit.by_direction == pytest.approx((1.0, 0.5), rel=1e-3)
    positive = np.log((1.0 + 0.2**2) / (0.5**2 + 0.2**2))
    negative = np.log((0.5**2 + 0.4**2) / (0.5**2 + 0.4**2))
    assert fit.hold_out_gain == pytest.approx(0.5 * (CYCLES - 1) * (positive + negative), rel=1e-3)


def test_a_target_that_the_camera_saw_in_too_few_frames_has_no_temperature(rng):
    fused = odd_position("structural", rng, rms_um=0.0)
    seen = np.full((40, fused.sizes["target"]), np.nan)
    seen[: module.MIN_CYCLES - 1, 2] = 1.0
    seen[: module.MIN_CYCLES, 3] = 2.0
    times = fused["time"].values.min() + np.arange(40) * np.timedelta64(60, "s")
    fused = fused.drop_vars("local_rise_series", errors="ignore").drop_dims("frame_time", errors="ignore")
    fused = fused.assign(local_rise_series=(("frame_time", "target"), seen)).assign_coords(frame_time=times)
    assert local_residuals(fused, 3, {3, 4}).temperature is None
    seconds, rise = local_residuals(fused, 4, {3, 4}).temperature
    np.testing.assert_allclose(seconds, 60.0 * np.arange(module.MIN_CYCLES))
    assert rise.tolist() == [2.0] * module.MIN_CYCLES


# Likelihoods of scatter: the densities are those of scipy, and each kind of scatter is recognised.


TYPICAL_UM = 0.4


def test_likelihoods_are_the_largest_over_the_grid_of_the_method():
    """Plain loops, densities of scipy: ordinary scatter within 20 % of the typical one, excess of 0.1 to 4 times it, one in five rare."""
    values = np.array([[0.1, -0.9, 0.4, 1.7, np.nan], [-0.2, 0.3, -2.0, 0.1, 0.6]])
    rows = [row[np.isfinite(row)] - np.nanmean(row) for row in values]
    along = np.concatenate([rows[0], -rows[1]])
    best = dict.fromkeys(("both", "one_direction", "along_approach"), -np.inf)
    for spread in np.linspace(-2.0, 2.0, 9):
        prior, sigma = -0.5 * spread**2, TYPICAL_UM * np.exp(0.1 * spread)
        usual = stats.norm(scale=sigma)
        for extra in TYPICAL_UM * np.geomspace(0.1, 4.0, 25):
            wide, rare = (stats.norm(scale=np.hypot(sigma, one)) for one in (extra, extra / np.sqrt(0.2)))
            steady = sum(wide.logpdf(row).sum() for row in rows)
            bursts = sum(np.log(0.8 * usual.pdf(row) + 0.2 * rare.pdf(row)).sum() for row in rows)
            sides = [wide.logpdf(one).sum() + usual.logpdf(other).sum() for one, other in (rows, rows[::-1])]
            amount = extra / np.sqrt(0.4)
            sticking = []
            for sign in (-1.0, 1.0):
                always = stats.exponnorm(K=extra / sigma, scale=sigma).logpdf(sign * along + extra).sum()
                centred = sign * along + 0.2 * amount
                sometimes = 0.8 * usual.pdf(centred) + 0.2 * stats.exponnorm(K=amount / sigma, scale=sigma).pdf(centred)
                sticking += [always, np.log(sometimes).sum()]
            for name, found in (("both", (steady, bursts)), ("one_direction", sides), ("along_approach", sticking)):
                best[name] = max(best[name], prior + max(found))
    fit = fit_scatter(Residual(3, np.arange(5.0), values, np.arange(1, 6), TYPICAL_UM, None))
    assert {name: getattr(fit, name) for name in best} == pytest.approx(best, rel=1e-6)
