"""The null hypothesis: simulated drifts have the covariance of theory, and p-values what their definition says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.drift_model.null_simulation import (
    critical_gain,
    family_wise,
    random_walk,
    sidak,
    sidak_level,
    simulate_null,
    tail_probability,
)
from interferometry.drift.gls import Autoregression, DriftFit, drift_system, fit_fixed_effects
from interferometry.drift.kalman import Memory

#: Uneven times from the first reading on, s.
SECONDS = np.array([0.0, 10.0, 25.0, 26.0, 90.0, 200.0])


def covariance_of_walk(order: int) -> np.ndarray:
    """Exact covariance: the walk is linear in its random numbers, so unit vectors give its matrix."""
    n = SECONDS.size
    system = drift_system(SECONDS, np.ones((n, 1)), order=order, ratios=np.ones(1))
    unit, nothing = np.eye(n), np.zeros((n, n))
    walks = []
    for first, second in ((unit, nothing), (nothing, unit)):
        # However many readings come together.
        pairs = zip(np.split(first, [1, 4]), np.split(second, [1, 4]), strict=True)
        walks.append(np.concatenate([*random_walk(system, pairs)]))
    matrix = np.column_stack(walks)
    return matrix @ matrix.T


def test_walks_have_the_covariance_of_theory():
    early, late = np.minimum.outer(SECONDS, SECONDS), np.maximum.outer(SECONDS, SECONDS)
    np.testing.assert_allclose(covariance_of_walk(1), early, atol=1e-9)
    np.testing.assert_allclose(covariance_of_walk(2), early**2 * (3.0 * late - early) / 6.0, rtol=1e-9, atol=1e-6)


def test_p_values_are_counted_up_to_the_upper_tenth():
    null = np.arange(1.0, 100.0)
    assert tail_probability(50.0, null) == pytest.approx((1 + 50) / 100)
    assert tail_probability(0.0, null) == 1.0
    # The draw itself counts as at least as large.
    assert tail_probability(50.5, null) == pytest.approx((1 + 49) / 100)


def test_p_values_beyond_the_upper_tenth_fall_exponentially():
    null = np.arange(1.0, 101.0)
    threshold = np.quantile(null, 0.9)  # 90.1, with a mean excess of 95.5 - 90.1 = 5.4
    assert tail_probability(threshold + 5.4, null) == pytest.approx(0.1 / np.e)
    assert tail_probability(threshold + 54.0, null) == pytest.approx(0.1 * np.exp(-10.0))


def test_the_tail_is_never_thinner_than_that_of_a_chi_squared_gain():
    quiet = np.linspace(0.0, 0.1, 200)
    assert tail_probability(float(np.quantile(quiet, 0.9)) + 3.0, quiet) == pytest.approx(0.1 * np.exp(-3.0))
    assert tail_probability(2.0, np.zeros(50)) == pytest.approx(0.1 * np.exp(-2.0))


@pytest.mark.parametrize("p_value", [0.1, 0.02, 1e-4, 1e-9])
def test_the_critical_gain_is_the_inverse_of_the_tail(p_value, rng):
    null = rng.exponential(2.0, 300)
    gain = critical_gain(p_value, null)
    if p_value == 0.1:
        assert gain == pytest.approx(np.quantile(null, 0.9))
    else:
        assert tail_probability(gain, null) == pytest.approx(p_value, rel=1e-9)
    assert critical_gain(0.5, null) == critical_gain(0.1, null)


def test_family_wise_p_values_of_independent_tests():
    assert sidak(0.01, 1) == pytest.approx(0.01)
    assert sidak(0.01, 3) == pytest.approx(1.0 - 0.99**3)
    assert sidak(1e-15, 10) == pytest.approx(1e-14)
    assert sidak(1.0, 5) == pytest.approx(1.0)
    for tried in (1, 4, 16):
        assert sidak(sidak_level(0.015, tried), tried) == pytest.approx(0.015, rel=1e-12)
    assert sidak_level(0.05, 2) == pytest.approx(1.0 - np.sqrt(0.95))


def test_the_most_unusual_statistic_is_named_whatever_its_scale():
    null = np.column_stack([np.tile([-1.0, 1.0], 50), 1000.0 + 100.0 * np.tile([1.0, -1.0], 50)])
    # 3 standard deviations of the first, 0.5 of the second.
    each, p_value, largest = family_wise(np.array([3.0, 1050.0]), null)
    assert largest == 0
    np.testing.assert_allclose(each, [1 / 101, 51 / 101])
    assert p_value == pytest.approx(1 / 101)
    _, p_value, largest = family_wise(np.array([-1.0, 1100.0]), null)
    # Every draw has one of its statistics at one standard deviation.
    assert (largest, p_value) == (1, 1.0)


def test_a_statistic_without_scatter_does_not_divide_by_zero():
    each, p_value, _ = family_wise(np.array([2.0]), np.full((9, 1), 2.0))
    assert (each.tolist(), p_value) == ([1.0], 1.0)


def test_family_wise_p_values_keep_their_level(rng):
    """Three statistics of different scale; 400 campaigns in which nothing is there."""
    scale = np.array([1.0, 10.0, 0.1])
    p_values = np.array([family_wise(rng.exponential(scale), rng.exponential(scale, (99, 3)))[1] for _ in range(400)])
    for level in (0.05, 0.2):
        # The measured statistics and the 99 draws are nearly exchangeable; three standard deviations of a share of 400.
        assert (p_values <= level).mean() == pytest.approx(level, abs=3.0 * np.sqrt(level * (1.0 - level) / 400) + 0.01)


def quiet_fit(noise: np.ndarray, variance: np.ndarray | None = None, *, order: int = 1) -> DriftFit:
    """Readings with given noise, beside a drift that is hardly there."""
    n = noise.size
    system = drift_system(
        10.0 * np.arange(n), np.ones((n, 1)), order=order, ratios=np.array([1e-12]), variance=variance
    )
    design = np.column_stack([np.ones(n), np.linspace(-1.0, 1.0, n)])
    return fit_fixed_effects(system, noise, design[:, :order])


def test_simulated_noise_is_resampled_from_the_residuals_and_weighted(rng):
    noise, variance = np.tile([1.0, -1.0], 50), np.ones(100)
    # Two readings were down-weighted: their residuals are ten standard deviations that are ten times as large.
    noise[10:12] *= 10.0
    variance[10:12] = 100.0
    draws = simulate_null(quiet_fit(noise, variance), rng, draws=400)
    # The drift starts at zero, so the first reading is noise alone: one residual or the other, equally often.
    np.testing.assert_allclose(np.abs(draws[0]), 1.0, rtol=1e-6)
    assert (draws[0] > 0.0).mean() == pytest.approx(0.5, abs=0.08)
    # A drift that could be there moves by far less than a reading's noise within ten readings.
    np.testing.assert_allclose(np.abs(draws[10]), 10.0, atol=2.0)


def test_a_simulated_drift_has_the_variances_that_the_likelihood_leaves(rng):
    n, ratio = 60, 25.0 / 60.0
    level, seconds = np.ones((n, 1)), 60.0 * np.arange(n)
    response = 5.0 * np.cumsum(rng.standard_normal(n)) + rng.standard_normal(n)
    tried = ratio * 10.0 ** np.array([0.0, -2.0, -1.0, -0.5, 0.5, 1.0])
    fits = [
        fit_fixed_effects(drift_system(seconds, level, order=1, ratios=np.array([value])), response, level)
        for value in tried
    ]
    likelihood = np.array([fit.log_likelihood for fit in fits])
    weight = np.exp(likelihood - likelihood.max())
    draws = simulate_null(fits[0], rng, draws=4000)
    noise, share = fits[0].noise()
    expected = fits[0].sigma ** 2 * float(weight @ tried / weight.sum()) * seconds[-1] + 2.0 * np.var(
        noise / np.sqrt(share)
    )
    # Mixed normal draws: a variance from 4,000 of them is known to about 3 %.
    assert (draws[-1] - draws[0]).var() == pytest.approx(expected, rel=0.1)


def test_however_many_readings_are_simulated_together_the_same_campaigns_come(monkeypatch):
    fit = quiet_fit(np.random.default_rng(5).standard_normal(50), order=2)
    whole = simulate_null(fit, np.random.default_rng(7), draws=4)
    monkeypatch.setattr("fusion.analysis.drift_model.null_simulation._READINGS_AT_ONCE", 7)
    np.testing.assert_array_equal(simulate_null(fit, np.random.default_rng(7), draws=4), whole)


def test_simulated_noise_has_the_memory_of_the_fit(rng):
    """Within a pass by time, and of every site from cycle to cycle: five sites in turn, 10 s apart."""
    fit = quiet_fit(rng.standard_normal(50))
    within = fit_fixed_effects(replace(fit.system, memory=Memory(0.8, 20.0)), fit.response, fit.design)
    draws = simulate_null(within, rng, draws=4000)
    assert draws[20].var() == pytest.approx(within.sigma**2, rel=0.1)
    assert np.corrcoef(draws[20], draws[21])[0, 1] == pytest.approx(0.8 * np.exp(-0.5), abs=0.05)
    memory = Autoregression(np.array([0.6]), 0.64)
    draws = simulate_null(fit, rng, draws=4000, memory=memory, site=np.arange(50) % 5)
    # 4,000 draws know a correlation to 0.016; drift that could be there adds less than a tenth.
    assert np.corrcoef(draws[30], draws[35])[0, 1] == pytest.approx(0.6, abs=0.1)
    assert np.corrcoef(draws[30], draws[34])[0, 1] == pytest.approx(0.0, abs=0.1)
