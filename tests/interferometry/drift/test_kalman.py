"""The recursions against known numbers; test_gls holds filter, smoother and normal equations to dense algebra."""

import numpy as np
import pytest

from interferometry.drift import kalman
from interferometry.drift.kalman import DriftModelError, DriftSystem, drift_system, start_columns


def test_innovation_variances_of_a_unit_random_walk_are_ratios_of_fibonacci_numbers():
    n = 40
    gains, innovation_variances, _ = kalman.filter_covariance(
        np.arange(float(n)),
        np.ones((n, 1)),
        1,
        np.ones(1),
        np.empty(0),
        np.ones(n),
        np.ones(n),
        np.ones(n, bool),
        False,
    )
    np.testing.assert_allclose(innovation_variances[:5], [1.0, 2 / 1, 5 / 2, 13 / 5, 34 / 13])
    golden = (1 + np.sqrt(5)) / 2
    assert innovation_variances[-1] == pytest.approx(golden**2, abs=1e-12)
    assert gains[-1, 0] == pytest.approx(1 / golden, abs=1e-12)


def test_sweeping_solves_least_squares_and_names_a_dependent_column():
    columns = np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 1.0], [6.0, 1.0, 2.0]])
    swept, log_determinant, dependent = kalman.sweep(columns.T @ columns, 1e-10)
    # Through 1, 2, 6 at 0, 1, 2: intercept 1/2, slope 5/2, residuals 1/2, -1, 1/2.
    np.testing.assert_allclose(swept[:, 0], [1.5, 0.5, 2.5])
    np.testing.assert_allclose(swept[1:, 1:], np.array([[5.0, -3.0], [-3.0, 3.0]]) / 6)
    assert (np.exp(log_determinant), dependent) == (pytest.approx(6.0), -1)
    twice = np.column_stack([columns, columns[:, 1]])
    assert kalman.sweep(twice.T @ twice, 1e-10)[2] == 2


def test_start_columns_are_levels_and_rates_per_hour():
    seconds, loadings = np.array([0.0, 1800.0, 3600.0]), np.array([[1.0], [1.0], [2.0]])
    assert start_columns(seconds, loadings, 1).tolist() == [[1.0], [1.0], [2.0]]
    assert start_columns(seconds, loadings, 2).tolist() == [[1.0, 0.0], [1.0, 0.5], [2.0, 2.0]]


def test_whitening_a_random_walk_is_its_cholesky_factor(rng):
    seconds = np.sort(rng.uniform(0, 20, 12))
    system = drift_system(seconds, np.ones((12, 1)), order=1, ratios=np.array([0.3]))
    white, log_determinant = system.whiten(np.eye(12))
    covariance = 0.3 * np.minimum.outer(seconds - seconds[0], seconds - seconds[0]) + np.eye(12)
    np.testing.assert_allclose(white @ np.linalg.cholesky(covariance), np.eye(12), atol=1e-12)
    assert log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-12)


@pytest.mark.parametrize(
    ("seconds", "loadings", "message"),
    [
        ([0.0, 2.0, 1.0], np.ones((3, 1)), "must not decrease"),
        ([0.0, np.nan, 1.0], np.ones((3, 1)), "must be finite"),
        ([0.0, 1.0, 2.0], np.ones((3, 1, 1)), r"loadings has shape \(3, 1, 1\)"),
        ([0.0, 1.0, 2.0], np.ones(3), r"loadings has shape \(3,\); expected \(3, number of drift components\)"),
    ],
)
def test_bad_input_is_named(seconds, loadings, message):
    with pytest.raises(DriftModelError, match=message):
        drift_system(np.array(seconds), loadings, order=1, ratios=np.ones(1))


def uneven(rng: np.random.Generator, n: int) -> DriftSystem:
    """A smooth drift with a stretch, every fifth reading held out."""
    return drift_system(
        np.sort(rng.uniform(0, 900, n)),
        np.column_stack([np.ones(n), rng.random(n)]),
        order=2,
        ratios=np.array([1e-4, 1e-3]),
        variance=rng.uniform(0.5, 2.0, n),
        observed=np.arange(n) % 5 != 0,
    )


def test_readings_that_are_whitened_some_after_others_are_those_whitened_at_once(rng):
    n = 23
    system, columns = uneven(rng, n), rng.normal(size=(n, 3))
    whitening = system.whitening(3)
    parts = [whitening.whiten(columns[rows].copy()) for rows in (slice(0, 7), slice(7, 8), slice(8, n))]
    innovations, variances = system.innovations(columns)
    np.testing.assert_allclose(np.vstack(parts), innovations / np.sqrt(variances)[:, None], atol=1e-13)
    assert whitening.done == n


def test_normal_equations_are_the_products_of_what_is_whitened_at_once(rng, monkeypatch):
    n = 700
    system, columns = uneven(rng, n), rng.normal(size=(n, 5))
    whitened, log_determinant = system.whiten(columns)
    for at_once in (10**6, 1000):
        monkeypatch.setattr("interferometry.drift.kalman._VALUES_AT_ONCE", at_once)
        gram, determinant = system.normal_equations(columns)
        np.testing.assert_allclose(gram, whitened.T @ whitened, rtol=1e-11, atol=1e-11)
        assert determinant == pytest.approx(log_determinant, rel=1e-12)


def test_many_columns_are_smoothed_as_few_are(rng, monkeypatch):
    n = 30
    system, columns = uneven(rng, n), rng.normal(size=(n, 5))
    at_once = system.smooth(columns)
    monkeypatch.setattr("interferometry.drift.kalman.MANY_COLUMNS", 2)
    for told, expected in zip(system.smooth(columns), at_once, strict=True):
        np.testing.assert_array_equal(told, expected)


def test_readings_at_one_instant_share_their_drift():
    """Two readings at once of a drift that starts at zero: the second innovation lacks what the first told."""
    system = drift_system(np.array([0.0, 100.0, 100.0]), np.ones((3, 1)), order=1, ratios=[0.01])
    innovations, variances = system.innovations(np.array([[0.0], [2.0], [2.0]]))
    np.testing.assert_allclose(innovations[:, 0], [0.0, 2.0, 1.0])
    np.testing.assert_allclose(variances, [1.0, 2.0, 1.5])
