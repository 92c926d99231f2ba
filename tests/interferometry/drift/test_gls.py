"""The O(n) filter against dense Gaussian algebra, and the estimates against simulated truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from interferometry.drift import gls
from interferometry.drift.gls import (
    Autoregression,
    average_drift,
    estimate,
    fit_fixed_effects,
    memory_of_each,
    settling_noise_scale,
    typical_memory,
    von_neumann_p_value,
)
from interferometry.drift.kalman import DriftModelError, Memory, drift_system, start_columns
from tests.interferometry.simulated_campaigns import with_memory

POSITIONS = np.r_[np.arange(16), np.arange(15, -1, -1)]


def readings(rng, n=60):
    seconds = np.sort(rng.uniform(0, 1000, n))
    loadings = np.column_stack([np.ones(n), rng.integers(0, 5, n) / 5.0])
    return seconds, loadings, rng.normal(size=n)


def dense_covariance(seconds, loadings, order, ratios, variance, memory=None):
    start = seconds - seconds[0]
    early, late = np.minimum.outer(start, start), np.maximum.outer(start, start)
    walk = early if order == 1 else early**2 * (3 * late - early) / 6
    drift = sum(ratio * walk * np.outer(column, column) for ratio, column in zip(ratios, loadings.T, strict=True))
    if memory is None:
        return drift, drift + np.diag(variance)
    shared = np.exp(-np.abs(np.subtract.outer(seconds, seconds)) / memory.time_s)
    return drift, drift + memory.share * shared + (1.0 - memory.share) * np.diag(variance)


def drift_of(fit):
    """Levels of the drift at every reading, and their covariance with that of the coefficients."""
    covariance = fit.sigma**2 * fit.smoothed.level_covariance
    for _, share in fit.shares():
        covariance = covariance + np.einsum("nip,njp->nij", share.levels, share.levels)
    return fit.smoothed.levels[:, :, 0], covariance


@pytest.mark.parametrize("memory", [None, Memory(0.6, 30.0)])
@pytest.mark.parametrize(("order", "ratios"), [(1, [0.01, 0.02]), (2, [1e-6, 3e-6])])
def test_agrees_with_dense_generalised_least_squares(rng, order, ratios, memory):
    seconds, loadings, y = readings(rng)
    variance = rng.uniform(0.5, 3.0, y.size)
    design = start_columns(seconds, loadings, order)
    system = replace(drift_system(seconds, loadings, order=order, ratios=ratios, variance=variance), memory=memory)
    fit = fit_fixed_effects(system, y, design)

    drift, total = dense_covariance(seconds, loadings, order, ratios, variance, memory)
    inverse = np.linalg.inv(total)
    unscaled = np.linalg.inv(design.T @ inverse @ design)
    beta = unscaled @ design.T @ inverse @ y
    residual = y - design @ beta
    freedom = y.size - design.shape[1]
    sigma2 = residual @ inverse @ residual / freedom
    likelihood = -0.5 * (freedom * np.log(sigma2) + np.linalg.slogdet(total)[1] - np.linalg.slogdet(unscaled)[1])

    np.testing.assert_allclose(fit.coefficients, beta, atol=1e-9)
    np.testing.assert_allclose(fit.covariance, sigma2 * unscaled, rtol=1e-8)
    assert fit.log_likelihood == pytest.approx(likelihood, abs=1e-8)
    noise, share = fit.noise()
    alone = variance if memory is None else (1.0 - memory.share) * variance
    np.testing.assert_allclose(noise, alone * (inverse @ residual), atol=1e-10)
    np.testing.assert_allclose(share, alone**2 * np.diag(inverse), atol=1e-10)
    levels, covariance = drift_of(fit)
    np.testing.assert_allclose((levels * loadings).sum(1), drift @ inverse @ residual, atol=1e-9)
    projector = inverse - inverse @ design @ unscaled @ design.T @ inverse
    np.testing.assert_allclose(
        np.einsum("nc,nce,ne->n", loadings, covariance, loadings),
        sigma2
        * np.diag(drift - drift @ inverse @ drift + drift @ inverse @ design @ unscaled @ design.T @ inverse @ drift),
        atol=1e-8,
    )
    assert np.linalg.eigvalsh(projector).min() > -1e-9


def test_deletion_residual_is_the_error_of_predicting_a_reading_from_all_others(rng):
    seconds, loadings, y = readings(rng, 40)
    system = drift_system(seconds, loadings, order=1, ratios=[0.01, 0.02])
    # The fit is taken as known, so that only the drift has to be predicted from the others.
    fit = fit_fixed_effects(system, y, loadings)
    _, total = dense_covariance(seconds, loadings, 1, [0.01, 0.02], np.ones(40))
    residual = fit.residual()
    k = 17
    others = np.arange(40) != k
    weights = np.linalg.solve(total[np.ix_(others, others)], total[others, k])
    error = residual[k] - weights @ residual[others]
    variance = total[k, k] - weights @ total[others, k]
    assert fit.deletion_residuals()[k] == pytest.approx(error / np.sqrt(variance) / fit.sigma, rel=1e-9)


def test_held_out_readings_do_not_move_the_fit_and_are_predicted_in_open_loop(rng):
    seconds, loadings, y = readings(rng)
    observed = seconds < 700
    system = drift_system(seconds, loadings, order=1, ratios=[0.01, 0.02], observed=observed)
    fit = fit_fixed_effects(system, y, loadings)
    shifted = fit_fixed_effects(system, np.where(observed, y, y + 1e6), loadings)
    np.testing.assert_array_equal(shifted.coefficients, fit.coefficients)
    _, total = dense_covariance(seconds, loadings, 1, [0.01, 0.02], np.ones(y.size))
    errors, spread = system.innovations(y[:, None])
    known = total[np.ix_(observed, observed)]
    expected = y[~observed] - total[np.ix_(~observed, observed)] @ np.linalg.solve(known, y[observed])
    np.testing.assert_allclose(errors[~observed, 0], expected, atol=1e-10)
    open_loop = total[np.ix_(~observed, ~observed)] - total[np.ix_(~observed, observed)] @ np.linalg.solve(
        known, total[np.ix_(observed, ~observed)]
    )
    np.testing.assert_allclose(spread[~observed], np.diag(open_loop), atol=1e-9)


def simulated_test(rng, *, cycles=60, noise_um=0.4, integrated=False):
    position = np.tile(POSITIONS, cycles) / 15.0
    seconds = np.arange(position.size) * 7.9
    steps = rng.normal(size=(2, position.size)) * np.array([[0.4], [0.3]]) / np.sqrt(32)
    drift = np.cumsum(steps, axis=1)
    if integrated:
        drift = np.cumsum(drift, axis=1) / 200
    y = drift[0] + position * drift[1] + rng.normal(0, noise_um, position.size)
    design = (np.tile(POSITIONS, cycles)[:, None] == np.arange(16)).astype(float)
    return seconds, np.column_stack([np.ones(position.size), position]), y, design


@pytest.mark.parametrize("integrated", [False, True])
def test_finds_the_kind_of_drift_and_the_noise(rng, integrated):
    fit = estimate(*simulated_test(rng, integrated=integrated))
    assert fit.system.order == (2 if integrated else 1)
    # 1920 readings determine a standard deviation to 0.4 / sqrt(2 * 1900) = 0.0065 um; 4 of these are allowed.
    assert fit.sigma == pytest.approx(0.4, abs=0.026)
    if not integrated:
        # Steps of 0.4 and 0.3 um per cycle of 252.8 s; such estimates scatter by about 15 % (docs/method/drift-estimation.md).
        np.testing.assert_allclose(fit.drift_rate * np.sqrt(252.8 / 3600), [0.4, 0.3], rtol=0.45)


@pytest.mark.parametrize("memory", [None, Memory(0.6, 30.0)])
@pytest.mark.parametrize(("order", "ratios"), [(1, [0.01, 0.02]), (2, [1e-6, 3e-6])])
def test_the_average_of_the_drift_and_its_covariance_are_those_of_dense_algebra(rng, order, ratios, memory):
    """Two drifts at once, some readings held out, some without weight in the average."""
    seconds, loadings, y = readings(rng, 30)
    observed = rng.random(30) < 0.8
    weights = np.where(rng.random(30) < 0.5, rng.uniform(0.5, 1.0, 30), 0.0)
    weights /= weights.sum()
    system = replace(drift_system(seconds, loadings, order=order, ratios=ratios, observed=observed), memory=memory)
    average, covariance, with_drift = average_drift(system, weights, y[:, None])

    _, total = dense_covariance(seconds, loadings, order, ratios, np.ones(30), memory)
    gain = np.zeros((30, 30))
    gain[np.ix_(observed, observed)] = np.linalg.inv(total[np.ix_(observed, observed)])
    each = [dense_covariance(seconds, np.ones((30, 1)), order, [ratio], np.ones(30))[0] for ratio in ratios]
    seen = [walk * column for walk, column in zip(each, loadings.T, strict=True)]
    np.testing.assert_allclose(average[:, 0], [weights @ one @ gain @ y for one in seen], atol=1e-9)
    left = [[(each[c] if c == i else 0.0) - seen[c] @ gain @ seen[i].T for i in (0, 1)] for c in (0, 1)]
    np.testing.assert_allclose(covariance, [[weights @ one @ weights for one in row] for row in left], atol=1e-9)
    np.testing.assert_allclose(
        with_drift, np.transpose([[one @ weights for one in row] for row in left], (2, 0, 1)), atol=1e-9
    )


def test_the_von_neumann_ratio_tells_a_trend_from_alternation_and_needs_eight_values():
    """A trend of eight values has the ratio 7 / 42; its distance from 2, in standard deviations of sqrt(24 / 63), is 2.97."""
    assert von_neumann_p_value(np.arange(8.0)) == pytest.approx(0.00149, abs=5e-6)
    assert von_neumann_p_value(100.0 + 5.0 * np.arange(8.0)) == pytest.approx(0.00149, abs=5e-6)
    assert von_neumann_p_value(np.tile([1.0, -1.0], 4)) == pytest.approx(0.99246, abs=5e-6)
    assert von_neumann_p_value(np.arange(7.0)) == von_neumann_p_value(np.full(20, 3.0)) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, x, y, d: (s, x, np.where(s == s[3], np.nan, y), d), "must be finite"),
        (lambda s, x, y, d: (s, x, y, np.column_stack([d, d[:, :1]])), "column 2 of the design depends"),
        (lambda s, x, y, d: (s, x, y, np.column_stack([d, 0 * s])), "vanish"),
    ],
)
def test_bad_input_is_named(rng, change, message):
    seconds, loadings, y = readings(rng)
    seconds, loadings, y, design = change(seconds, loadings, y, loadings)
    with pytest.raises(DriftModelError, match=message):
        fit_fixed_effects(drift_system(seconds, loadings, order=1, ratios=[0.01, 0.02]), y, design)


def test_a_drift_that_leaves_rounding_alone_of_the_noise_is_no_model(rng):
    """A clock that is 26 years off: an integrated walk of 7e-4 / s^3 grows to 1e23 variances of a reading; their rounding is 1e7."""
    seconds = 60.0 * np.arange(400.0) + np.where(np.arange(400) < 150, 0.0, 8.26e8)
    one, y = np.ones((400, 1)), rng.normal(size=400)
    with pytest.raises(DriftModelError, match="lost in rounding"):
        fit_fixed_effects(drift_system(seconds, one, order=2, ratios=[7e-4]), y, one)
    fit = estimate(seconds, one, y, one, robust=True)
    # White noise of unit variance, to three times the uncertainty of 400 readings.
    assert fit.sigma == pytest.approx(1.0, abs=3.0 / np.sqrt(800))


def test_a_search_goes_on_where_its_drift_hides_a_column(rng):
    """A reading every two days: an integrated walk at the upper limit grows by 4e12 variances of a reading between two of them."""
    targets = np.tile(np.r_[np.arange(5), np.arange(4, -1, -1)], 12)
    sign = np.tile(np.r_[np.ones(5), -np.ones(5)], 12)
    seconds, loadings = 172800.0 * np.arange(120.0), np.column_stack([np.ones(120), targets / 4.0])
    design = np.column_stack([np.eye(5)[targets], np.eye(5)[targets] * sign[:, None]])
    largest = 1e8 / 3600.0**3
    with pytest.raises(DriftModelError, match="depends linearly"):
        fit_fixed_effects(
            drift_system(seconds, loadings, order=2, ratios=[largest, 1e-25]), rng.normal(size=120), design
        )
    fit = estimate(seconds, loadings, rng.normal(size=120), design)
    assert fit.sigma == pytest.approx(1.0, abs=3.0 / np.sqrt(2.0 * 110))
    assert np.isfinite(
        estimate(seconds, loadings, fit.response, design, order=2, start=[largest, 1e-25]).log_likelihood
    )


@pytest.mark.parametrize(("order", "ratio"), [(1, 0.01), (2, 1e-6)])
def test_a_process_noise_scale_multiplies_the_variance_of_its_own_steps(rng, order, ratio):
    seconds, _, y = readings(rng, 40)
    loadings, scale = np.ones((40, 1)), rng.uniform(0.2, 5.0, 40)
    system = drift_system(seconds, loadings, order=order, ratios=[ratio], process_noise_scale=scale)
    fit = fit_fixed_effects(system, y, start_columns(seconds, loadings, order))

    steps = np.diff(seconds, prepend=seconds[0]) * ratio * scale
    after = np.maximum(np.subtract.outer(seconds, seconds), 0.0)
    begun = np.subtract.outer(seconds, seconds) >= 0
    if order == 1:
        walk = (begun * steps) @ begun.T
    else:
        h = np.diff(seconds, prepend=seconds[0])
        walk = (begun * (steps * h**2 / 3)) @ begun.T + after * steps @ after.T
        cross = (begun * (steps * h / 2)) @ after.T
        walk += cross + cross.T
    inverse = np.linalg.inv(walk + np.eye(40))
    design = fit.design
    beta = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ y)
    np.testing.assert_allclose(fit.coefficients, beta, atol=1e-8)
    drift, _ = drift_of(fit)
    np.testing.assert_allclose(drift[:, 0], walk @ inverse @ (y - design @ beta), atol=1e-8)


def test_the_rate_of_a_drift_is_its_standard_deviation_after_an_hour():
    """A walk of variance r t, and an integrated one of variance r t^3 / 3, in units of sigma^2."""
    seconds, ones = np.arange(20.0) * 60.0, np.ones((20, 1))
    y = np.resize([0.5, -0.5, 0.2], 20)
    for order, ratio, variance in ((1, 0.01, 36.0), (2, 3e-9, 3e-9 * 3600.0**3 / 3.0)):
        system = drift_system(seconds, ones, order=order, ratios=[ratio])
        fit = fit_fixed_effects(system, y, start_columns(seconds, ones, order))
        assert fit.drift_rate == pytest.approx(fit.sigma * np.sqrt(variance))


def test_a_drift_that_settles_has_larger_process_noise_at_the_start_only(rng):
    seconds = np.arange(600) * 40.0
    loadings = np.ones((600, 1))
    warming = 12.0 * (1.0 - np.exp(-seconds / 1200.0)) + rng.normal(0, 0.4, 600)
    columns = np.ones((600, 1))
    fit = estimate(seconds, loadings, warming, columns, settling=True)
    assert fit.system.step_scales[0] > 10.0
    assert fit.system.step_scales[-1] == 1.0
    assert (np.diff(fit.system.step_scales) <= 0).all()
    assert settling_noise_scale(seconds, 600.0, 2.0)[15] == pytest.approx(0.25)
    wandering = np.cumsum(rng.normal(0, 0.1, 600)) + rng.normal(0, 0.4, 600)
    assert (estimate(seconds, loadings, wandering, columns, settling=True).system.step_scales == 1.0).all()


def test_readings_that_a_drift_follows_to_the_last_have_a_noise_all_the_same(rng):
    """Without noise of its own, a walk of 1 um from reading to reading: rounding of the sums is never taken for an exact fit."""
    seconds = np.sort(rng.uniform(0, 2000, 120))
    site = rng.integers(0, 30, 120)
    loadings = np.column_stack([np.ones(120), np.arange(30)[site] / 29.0])
    design = np.eye(30)[site]
    wild = np.cumsum(rng.normal(0, 1.0, 120)) * loadings[:, 0] + np.cumsum(rng.normal(0, 1.0, 120)) * loadings[:, 1]
    fit = estimate(seconds, loadings, wild - 500.0, design, order=1, settling=True)
    # The drift that hides everything else has 10^4 times the variance of a reading in an hour, in the mean over the test.
    assert (fit.system.ratios * fit.system.step_scales.mean() <= 2e4 / 3600.0).all()
    assert 1e-3 < fit.sigma < 1.0
    exact = fit_fixed_effects(
        drift_system(seconds, loadings, order=1, ratios=[0.1, 0.1]), 7.0 * design[:, 3] - 500.0, design
    )
    assert 0.0 < exact.sigma < 1e-4
    assert np.isfinite(exact.log_likelihood)


def test_a_search_that_loses_a_component_begins_again_where_the_walk_found_it(rng, monkeypatch):
    seconds = np.arange(300) * 40.0
    loadings = np.ones((300, 1))
    wave = 8.0 * np.sin(seconds / 1500.0) + rng.normal(0, 0.1, 300)
    expected = estimate(seconds, loadings, wave, np.ones((300, 1)))
    maximise, lost = gls._maximise, []

    def losing(system, response, design, start):
        if system.order == 2 and start is None:
            lost.append(system)
            return fit_fixed_effects(replace(system, ratios=system.ratios * 1e-40), response, design)
        return maximise(system, response, design, start)

    monkeypatch.setattr(gls, "_maximise", losing)
    again = estimate(seconds, loadings, wave, np.ones((300, 1)))
    assert len(lost) == 1
    assert again.system.order == expected.system.order == 2
    assert again.sigma == pytest.approx(expected.sigma, rel=1e-3)


def test_a_drift_that_is_restless_at_the_start_alone_is_described_so(rng):
    """A walk of 20 um a root hour that falls to 0.3 with the hour, beside 0.1 um of noise: more at first than a whole test may have."""
    seconds, site = np.arange(720) * 20.0, np.tile(np.arange(12), 60)
    rate = (0.3 + 20.0 * np.exp(-seconds / 3600.0)) * np.sqrt(20.0 / 3600.0)
    walk = np.cumsum(rng.normal(size=720) * rate)
    fit = estimate(seconds, np.ones((720, 1)), walk + rng.normal(0, 0.1, 720), np.eye(12)[site], order=1, settling=True)
    ratio = fit.system.ratios[0] * 3600.0 * fit.system.step_scales
    assert ratio[0] > 3.0 * ratio[-1]
    assert ratio[-1] < 1.001e4 < ratio[0]
    # Where the walk is a hundred times the noise of a reading, the two are hardly told apart.
    assert 0.4 < fit.sigma / 0.1 < 2.0


def test_an_even_choice_of_very_many_sites_knows_the_variances_of_the_drift(rng, monkeypatch):
    seconds, loadings, y, design = simulated_test(rng)[:4]
    every = estimate(seconds, loadings, y, design, order=1, settling=True)
    for name in ("_MOST_SITES", "_LEAST_SITES", "_ENOUGH_READINGS"):
        monkeypatch.setattr(f"interferometry.drift.gls.{name}", 12)
    some = estimate(seconds, loadings, y, design, order=1, settling=True)
    # 12 of the 16 sites: the variances differ by their own uncertainty, the profile by a small share of its own.
    assert not np.array_equal(some.system.ratios, every.system.ratios)
    np.testing.assert_allclose(np.sqrt(some.system.ratios / every.system.ratios), 1.0, atol=0.5)
    assert np.abs(some.coefficients - every.coefficients).max() < 0.2 * every.coefficients_u.min()
    assert some.sigma == pytest.approx(every.sigma, rel=0.03)


def test_many_columns_are_fitted_as_few_are(rng, monkeypatch):
    system, y, x = drift_and_columns(rng)
    few = fit_fixed_effects(system, y, x)
    monkeypatch.setattr("interferometry.drift.gls.MANY_COLUMNS", 2)
    many = fit_fixed_effects(system, y, x)
    for name in ("coefficients", "covariance", "sigma", "log_likelihood", "rss"):
        np.testing.assert_allclose(getattr(many, name), getattr(few, name), rtol=1e-9, atol=1e-12)
    with pytest.raises(DriftModelError, match="column 3 of the design depends linearly"):
        fit_fixed_effects(system, y, np.column_stack([x, x[:, 1]]))


def test_the_covariance_of_the_drift_holds_that_of_the_coefficients(rng):
    system, y, x = drift_and_columns(rng)
    fit = fit_fixed_effects(system, y, x)
    levels, covariance = drift_of(fit)
    smoothed = system.smooth(np.column_stack([y, x]))
    by_coefficient = smoothed.levels[:, :, 1:]
    np.testing.assert_allclose(levels, smoothed.levels[:, :, 0] - by_coefficient @ fit.coefficients, atol=1e-12)
    expected = fit.sigma**2 * smoothed.level_covariance
    expected += by_coefficient @ fit.covariance @ by_coefficient.transpose(0, 2, 1)
    np.testing.assert_allclose(covariance, expected, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("memory", [None, Memory(0.6, 9.0)])
@pytest.mark.parametrize(("order", "ratios"), [(1, [0.05, 0.02]), (2, [1e-4, 1e-5])])
def test_columns_that_few_readings_have_are_fitted_alike_by_their_own_recursion(
    rng, monkeypatch, order, ratios, memory
):
    n, sites = 600, 40
    seconds, site = np.sort(rng.uniform(0, 900, n)), rng.integers(0, sites, n)
    loadings = np.column_stack([np.ones(n), site / sites])
    # A constant of the target and half a reversal, as one that few readings have and that has two values.
    design = np.column_stack(
        [np.eye(sites)[site], (site < 20)[:, None] * np.eye(20)[site % 20] * rng.choice([-0.5, 0.5], (n, 1))]
    )
    design = np.column_stack([design, rng.standard_normal(n)])
    observed = rng.random(n) > 0.1
    system = replace(drift_system(seconds, loadings, order=order, ratios=ratios, observed=observed), memory=memory)
    system = replace(system, variance=rng.uniform(0.5, 2.0, n))
    y = rng.standard_normal(n)
    monkeypatch.setattr("interferometry.drift.gls._FEW_READINGS", 0.0)
    whole = fit_fixed_effects(system, y, design)
    monkeypatch.setattr("interferometry.drift.gls._FEW_READINGS", 0.1)
    monkeypatch.setattr("interferometry.drift.gls.MANY_COLUMNS", 30)
    for columns in (design, sparse.csr_array(design)):
        parts = fit_fixed_effects(system, y, columns)
        for name in ("coefficients", "covariance", "sigma", "log_likelihood", "rss"):
            np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-8, atol=1e-10)


def drift_and_columns(rng):
    n = 40
    loadings = np.ones((n, 1))
    system = drift_system(np.arange(40.0), loadings, order=1, ratios=np.array([0.05]))
    x = np.column_stack([loadings, rng.standard_normal((n, 2))])
    return system, x @ [1.0, 2.0, -3.0] + rng.standard_normal(n), x


def series(rng: np.random.Generator, correlation: float, *, rows: int = 32, cycles: int = 100) -> np.ndarray:
    values = with_memory(rng.standard_normal((rows, cycles)).T, correlation).T
    return values - values.mean(axis=1, keepdims=True)


def test_noise_without_memory_and_a_position_that_moves_by_itself_have_none(rng):
    values = series(rng, 0.0)
    memory = typical_memory(values)
    assert memory.weights.size == 0
    assert memory.long_run == 1.0
    assert memory.innovations(values) is values
    values[4:6] += 3.0 * np.sin(np.linspace(0, 6, 100))
    assert typical_memory(values).weights.size == 0


def test_memory_is_recognised_and_taken_out(rng):
    values = series(rng, 0.4)
    memory = typical_memory(values)
    # 3,200 values: the standard error of a correlation is 0.016, its bias after taking the means 0.02.
    assert memory.weights[0] == pytest.approx(0.4, abs=0.06)
    assert memory.long_run == pytest.approx(1.4 / 0.6, abs=0.4)
    innovations = memory.innovations(values)
    assert innovations.shape == values.shape
    lag_one = (innovations[:, 1:] * innovations[:, :-1]).sum() / (innovations**2).sum()
    assert abs(lag_one) < 0.06
    assert innovations[:, 0].std() == pytest.approx(innovations.std(), rel=0.5)


def test_series_without_values_or_too_few_cycles_have_no_memory():
    assert typical_memory(np.zeros((4, 50))).weights.size == 0
    assert typical_memory(np.ones((4, 3))).weights.size == 0


@pytest.mark.parametrize("weight", [0.3, 0.6])
def test_the_memory_of_each_site_is_estimated_beside_what_all_do_together(rng, weight):
    """32 sites over 50 cycles, and a motion of all that is no noise."""
    together = np.outer(rng.normal(size=32), np.sin(np.arange(50) / 5.0))
    found = memory_of_each(with_memory(rng.normal(size=(50, 32)), weight).T + together)
    # Of 40 such series the standard deviation is 0.05; three of them.
    assert found.weights[0] == pytest.approx(weight, abs=0.15)


def test_independent_sites_have_no_memory_and_few_sites_are_not_asked(rng):
    assert all(memory_of_each(rng.normal(size=(32, 50))).weights.size == 0 for _ in range(10))
    together = np.outer(rng.normal(size=32), np.sin(np.arange(50) / 5.0))
    assert memory_of_each(rng.normal(size=(32, 50)) + together).weights.size == 0
    # Series of which nothing is left beside what all do together have no memory of their own.
    assert memory_of_each(np.zeros((32, 50))).weights.size == 0
    assert memory_of_each(with_memory(rng.normal(size=(50, 6)), 0.6).T).weights.size == 0


def test_simulated_noise_has_the_memory_and_its_variance(rng):
    noise = Autoregression(np.array([0.6]), 0.64).with_memory(rng.normal(size=(4000, 5)))
    assert noise.std() == pytest.approx(1.0, abs=0.03)
    assert np.mean(noise[1:] * noise[:-1]) == pytest.approx(0.6, abs=0.04)
