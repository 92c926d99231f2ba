"""Least squares of many candidates and many responses, against one `lstsq` each and against dense densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fusion.model.least_squares import (
    PriorRows,
    density_ahead,
    gain_across,
    moments_of,
    profile_likelihood,
    residual_squares,
    solve,
)


def squares_beside(y: np.ndarray, x: np.ndarray) -> float:
    """Residual sum of squares of one response by `lstsq`."""
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(left @ left)


def halves_of(y: np.ndarray, columns: np.ndarray, half: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Products of columns and responses over each half, and squared lengths of the columns there."""
    return [(columns[part].T @ y[part], (columns[part] ** 2).sum(axis=0)) for part in (half, ~half)]


def test_an_event_sized_on_one_half_is_tested_on_the_other():
    half = np.array([True, True, False, False])
    y = np.array([[1.0], [3.0], [1.0], [0.0]])
    column = np.ones((4, 1))
    # Size 2 from (1, 3) on (1, 0): 1 + 0 - (1 + 4) = -4; size 0.5 from (1, 0) on (1, 3): 10 - (0.25 + 6.25) = 3.5.
    np.testing.assert_allclose(gain_across(halves_of(y, column, half)), [-0.5], rtol=1e-12)


def test_every_response_chooses_its_own_event_on_the_half_that_sizes_it(rng):
    y = rng.standard_normal((12, 5))
    # Columns of very different size: the largest product with the response is not the largest reduction.
    columns = rng.standard_normal((12, 7)) * np.array([0.01, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4])
    half = np.arange(12) % 3 == 0
    expected = np.zeros(5)
    chosen = set()
    for k in range(5):
        for train, test in ((half, ~half), (~half, half)):
            size = [float(c[train] @ y[train, k] / (c[train] @ c[train])) for c in columns.T]
            left = [((y[train, k] - s * c[train]) ** 2).sum() for s, c in zip(size, columns.T, strict=True)]
            best = int(np.argmin(left))
            chosen.add(best)
            expected[k] += (y[test, k] ** 2).sum() - ((y[test, k] - size[best] * columns[test, best]) ** 2).sum()
    assert len(chosen) > 2
    np.testing.assert_allclose(gain_across(halves_of(y, columns, half)), expected, rtol=1e-10)


def test_residual_squares_count_dependent_columns_once():
    y = np.array([1.0, 2.0, 3.0])
    assert residual_squares(y, np.ones((3, 1))) == pytest.approx(2.0)
    assert residual_squares(y, np.array([[1.0, 2.0, 0.0]] * 3)) == pytest.approx(2.0)


@pytest.mark.parametrize(("tilt", "left"), [(1.9e-3, 1.0), (2.1e-3, 0.0)])
def test_a_direction_below_a_thousandth_counts_as_dependent(tilt, left):
    """Two unit columns at a small angle t have singular values in the ratio t / 2."""
    x = np.array([[1.0, 1.0], [0.0, tilt], [0.0, 0.0]]) * np.array([1.0, 1e6])
    assert residual_squares(np.array([0.0, 1.0, 0.0]), x) == pytest.approx(left, abs=1e-6)


def test_normal_equations_are_solved_for_several_responses_in_any_units(rng):
    x, y = rng.standard_normal((30, 3)), rng.standard_normal((30, 2))
    unit = np.array([1e-6, 1.0, 1e5])
    expected = np.linalg.lstsq(x, y, rcond=None)[0] / unit[:, None]
    np.testing.assert_allclose(solve((x * unit).T @ (x * unit), (x * unit).T @ y), expected, rtol=1e-7)


def test_a_column_that_is_zero_here_gets_no_coefficient_and_equal_columns_share(rng):
    column, y = rng.standard_normal(20), rng.standard_normal((20, 1))
    size = float(column @ y[:, 0] / (column @ column))
    x = np.column_stack([column, np.zeros(20)])
    np.testing.assert_allclose(solve(x.T @ x, x.T @ y)[:, 0], [size, 0.0], rtol=1e-8)
    twice = np.column_stack([column, column])
    np.testing.assert_allclose(solve(twice.T @ twice, twice.T @ y)[:, 0], [size / 2, size / 2], rtol=1e-6)


def test_priors_are_further_rows_that_know_the_models_columns_only():
    rows = PriorRows(np.array([[0.0, 2.0]]), np.array([5.0]), np.array([[7.0, 8.0]]))
    y, x = rows.append(np.zeros((3, 3)), np.ones((3, 4)))
    np.testing.assert_array_equal(y[3], [5.0, 7.0, 8.0])
    np.testing.assert_array_equal(x[3], [0.0, 2.0, 0.0, 0.0])
    assert (y.shape, x.shape) == ((4, 3), (4, 4))
    measured_only, _ = rows.append(np.zeros((3, 1)), np.ones((3, 2)))
    np.testing.assert_array_equal(measured_only[:, 0], [0.0, 0.0, 0.0, 5.0])


def test_the_priors_of_the_measured_response_lose_what_coefficients_make_of_it():
    rows = PriorRows(np.array([[0.0, 2.0]]), np.array([5.0]), np.array([[7.0, 8.0]]))
    beside = rows.beside(np.array([9.0, 1.5]))
    np.testing.assert_array_equal(beside.responses(3), [[2.0, 7.0, 8.0]])
    assert beside.design is rows.design


def test_moments_hold_products_and_give_those_of_the_first_columns(rng):
    x, y, spread = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)), rng.uniform(1.0, 2.0, 9)
    part = moments_of(y, x, spread).first(2)
    np.testing.assert_allclose(part.design, x[:, :2].T @ x[:, :2], rtol=1e-12)
    np.testing.assert_allclose(part.cross, x[:, :2].T @ y, rtol=1e-12)
    np.testing.assert_allclose(part.squares, (y**2).sum(axis=0), rtol=1e-12)
    assert part.readings == 9
    assert part.log_spread == pytest.approx(np.log(spread).sum())


def test_moments_of_parts_and_of_priors_add_up(rng):
    x, y, spread = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)), rng.uniform(1.0, 2.0, 9)
    priors = PriorRows(np.array([[0.0, 2.0]]), np.array([5.0]), np.array([[7.0]]))
    told = priors.add_to(moments_of(y[:4], x[:4], spread[:4]).plus(moments_of(y[4:], x[4:], spread[4:])))
    whole = moments_of(*priors.append(y, x), spread)
    for name in ("design", "cross", "squares", "readings", "log_spread"):
        np.testing.assert_allclose(getattr(told, name), getattr(whole, name), rtol=1e-12)


def test_the_profile_likelihood_is_that_of_the_best_coefficients_and_noise(rng):
    n = 25
    x, y, spread = rng.standard_normal((n, 3)), rng.standard_normal((n, 2)), rng.uniform(1.0, 4.0, n)
    # The likelihood of the unwhitened readings at the maximum, without n/2 (1 + log 2 pi).
    for k, told in enumerate(profile_likelihood(moments_of(y, x, spread))):
        sigma = np.sqrt(squares_beside(y[:, k], x) / n)
        fitted = x @ np.linalg.lstsq(x, y[:, k], rcond=None)[0]
        density = stats.norm.logpdf(y[:, k], fitted, sigma).sum() - 0.5 * np.log(spread).sum()
        assert told == pytest.approx(density + 0.5 * n * (1.0 + np.log(2.0 * np.pi)), rel=1e-8)


@pytest.mark.parametrize("flat", [2, 4])
def test_the_density_of_later_readings_is_the_predictive_t_density(rng, flat):
    """Coefficients after the flat ones have a normal prior worth one of all readings; the noise has the prior 1 / sigma."""
    n, later = 30, 12
    x, spread = rng.standard_normal((n, 4)), rng.uniform(1.0, 3.0, n)
    y = x @ np.array([1.0, -2.0, 0.5, 0.3]) + rng.standard_normal(n)
    precision = np.zeros((4, 4))
    base, other = x[:, :flat], x[:, flat:]
    free = other - base @ np.linalg.lstsq(base, other, rcond=None)[0]
    precision[flat:, flat:] = free.T @ free / n
    early, late = slice(0, n - later), slice(n - later, n)
    normal = x[early].T @ x[early] + precision
    beta = np.linalg.solve(normal, x[early].T @ y[early])
    left = y[early] @ y[early] - beta @ normal @ beta
    freedom = n - later - flat
    shape = left / freedom * (np.eye(later) + x[late] @ np.linalg.solve(normal, x[late].T))
    expected = stats.multivariate_t.logpdf(y[late], x[late] @ beta, shape, df=freedom)
    told = density_ahead(moments_of(y[early, None], x[early], spread[early]), moments_of(y[:, None], x, spread), flat)
    assert told[0] == pytest.approx(expected - 0.5 * np.log(spread[late]).sum(), rel=1e-7)
