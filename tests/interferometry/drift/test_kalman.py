"""The recursions against numbers by hand; test_gls holds their sum to dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.drift import kalman

ONE = np.ones((1, 1))


def test_the_prediction_step_of_an_integrated_random_walk_adds_its_process_noise() -> None:
    covariance = np.zeros((2, 2))
    kalman.predict_covariance(covariance, 2, np.array([1.5]), 2.0, 2.0)
    # q [[h^3 / 3, h^2 / 2], [h^2 / 2, h]] with q = 3, h = 2.
    np.testing.assert_allclose(covariance, [[8.0, 6.0], [6.0, 6.0]])
    kalman.predict_covariance(covariance, 2, np.array([0.0]), 1.0, 1.0)
    # T P T' with T = [[1, 1], [0, 1]].
    np.testing.assert_allclose(covariance, [[26.0, 12.0], [12.0, 6.0]])


def test_the_prediction_step_of_the_state_moves_levels_by_their_rates() -> None:
    state = np.array([[1.0, 0.0], [0.5, 2.0]])
    kalman.predict_state(state, 2, 4.0)
    np.testing.assert_allclose(state, [[3.0, 8.0], [0.5, 2.0]])


def test_a_measurement_update_weighs_state_and_reading_by_their_variances() -> None:
    covariance, state = np.array([[3.0]]), np.array([[2.0]])
    cross_covariance, innovation = np.zeros(1), np.zeros(1)
    total = kalman.innovation_variance(covariance, 1, ONE, 0, 1.0, cross_covariance)
    kalman.update_covariance(covariance, cross_covariance, total)
    kalman.update_state(state, 1, ONE, 0, np.array([6.0]), cross_covariance, total, innovation)
    # Variances 3 and 1: gain 3/4, remaining variance 3/4.
    assert (total, covariance[0, 0], state[0, 0], innovation[0]) == (4.0, 0.75, 5.0, 4.0)


def test_innovation_variances_of_a_unit_random_walk_are_ratios_of_fibonacci_numbers() -> None:
    n = 40
    gains, innovation_variances, _ = kalman.filter_covariance(
        np.arange(float(n)), np.ones((n, 1)), 1, np.ones(1), np.ones(n), np.ones(n), np.ones(n, bool), False
    )
    np.testing.assert_allclose(innovation_variances[:5], [1.0, 2 / 1, 5 / 2, 13 / 5, 34 / 13])
    golden = (1 + np.sqrt(5)) / 2
    assert innovation_variances[-1] == pytest.approx(golden**2, abs=1e-12)
    assert gains[-1, 0] == pytest.approx(1 / golden, abs=1e-12)


def test_the_smoother_of_two_readings_of_a_random_walk() -> None:
    seconds, loadings, columns = np.array([0.0, 1.0]), np.ones((2, 1)), np.array([[0.5], [2.0]])
    observed = np.ones(2, bool)
    gains, innovation_variances, covariances = kalman.filter_covariance(
        seconds, loadings, 1, np.ones(1), np.ones(2), np.ones(2), observed, True
    )
    innovations, states = kalman.filter_columns(seconds, loadings, 1, gains, columns, True)
    levels, covariance, u, D = kalman.smooth(
        seconds, loadings, 1, gains, innovation_variances, observed, innovations, states, covariances
    )
    # The level starts at 0 without uncertainty; at the second reading prior and noise have variance 1 each.
    np.testing.assert_allclose(levels.ravel(), [0.0, 1.0])
    np.testing.assert_allclose(covariance.ravel(), [0.0, 0.5])
    np.testing.assert_allclose(u.ravel(), [0.5, 1.0])
    np.testing.assert_allclose(D, [1.0, 0.5])


@pytest.mark.parametrize(("order", "components"), [(1, 1), (1, 2), (2, 1), (2, 2), (2, 3)])
def test_readings_are_whitened_in_parts_as_their_innovations_over_their_deviations(
    rng: np.random.Generator, order: int, components: int
) -> None:
    n = 9
    seconds, loadings, columns = (
        np.sort(rng.uniform(0, 9, n)),
        rng.normal(size=(n, components)),
        rng.normal(size=(n, 3)),
    )
    gains, innovation_variances, _ = kalman.filter_covariance(
        seconds, loadings, order, rng.uniform(0.1, 0.3, components), np.ones(n), np.ones(n), np.ones(n, bool), False
    )
    innovations, _ = kalman.filter_columns(seconds, loadings, order, gains, columns, False)
    rows, state = columns.copy(), np.zeros((components * order, 3))
    for first, last in ((0, 4), (4, n)):
        kalman.whiten_rows(
            seconds, loadings, order, gains, np.sqrt(innovation_variances), first, state, rows[first:last]
        )
    np.testing.assert_allclose(rows, innovations / np.sqrt(innovation_variances)[:, None], rtol=1e-12)


def test_normal_equations_are_those_of_the_innovations(rng: np.random.Generator) -> None:
    n = 11
    seconds, loadings = np.sort(rng.uniform(0, 9, n)), rng.normal(size=(n, 2))
    columns, variance, observed = rng.normal(size=(n, 3)), rng.uniform(0.5, 2, n), rng.random(n) < 0.8
    ratios, scale = np.array([0.2, 0.1]), rng.uniform(0.5, 2, n)
    gains, innovation_variances, _ = kalman.filter_covariance(
        seconds, loadings, 2, ratios, scale, variance, observed, False
    )
    innovations, _ = kalman.filter_columns(seconds, loadings, 2, gains, columns, False)
    gram, log_determinant = kalman.normal_equations(seconds, loadings, 2, ratios, scale, variance, observed, columns)
    whitened = innovations[observed] / np.sqrt(innovation_variances[observed])[:, None]
    np.testing.assert_allclose(gram, whitened.T @ whitened, rtol=1e-12)
    assert log_determinant == pytest.approx(np.log(innovation_variances[observed]).sum(), rel=1e-12)


def test_sweeping_solves_least_squares_and_names_a_dependent_column() -> None:
    columns = np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 1.0], [6.0, 1.0, 2.0]])
    swept, log_determinant, dependent = kalman.sweep(columns.T @ columns, 1e-10)
    # Through 1, 2, 6 at 0, 1, 2: intercept 1/2, slope 5/2, residuals 1/2, -1, 1/2.
    np.testing.assert_allclose(swept[:, 0], [1.5, 0.5, 2.5])
    np.testing.assert_allclose(swept[1:, 1:], np.array([[5.0, -3.0], [-3.0, 3.0]]) / 6)
    assert (np.exp(log_determinant), dependent) == (pytest.approx(6.0), -1)
    twice = np.column_stack([columns, columns[:, 1]])
    assert kalman.sweep(twice.T @ twice, 1e-10)[2] == 2
