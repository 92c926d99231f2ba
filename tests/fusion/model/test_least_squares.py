"""Least squares of many candidates and many responses, against one `lstsq` each and against dense densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fusion.effects.effect import Candidate
from fusion.model.least_squares import (
    PriorRows,
    by_width,
    density_ahead,
    gain_across,
    moments_of,
    profile_likelihood,
    reductions,
    residual_squares,
    solve,
    without,
)


def squares_beside(y: np.ndarray, x: np.ndarray) -> float:
    """Residual sum of squares of one response by `lstsq`."""
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(left @ left)


def test_an_event_sized_on_one_half_is_tested_on_the_other():
    half = np.array([True, True, False, False])
    y = np.array([[1.0], [3.0], [1.0], [0.0]])
    column = np.ones((4, 1))
    # Size 2 from (1, 3) on (1, 0): 1 + 0 - (1 + 4) = -4; size 0.5 from (1, 0) on (1, 3): 10 - (0.25 + 6.25) = 3.5.
    np.testing.assert_allclose(gain_across(y, column, half), [-0.5], rtol=1e-12)


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
    np.testing.assert_allclose(gain_across(y, columns, half), expected, rtol=1e-10)


def test_residual_squares_count_dependent_columns_once():
    y = np.array([1.0, 2.0, 3.0])
    assert residual_squares(y, np.ones((3, 1))) == pytest.approx(2.0)
    assert residual_squares(y, np.array([[1.0, 2.0, 0.0]] * 3)) == pytest.approx(2.0)


@pytest.mark.parametrize(("tilt", "left"), [(1.9e-3, 1.0), (2.1e-3, 0.0)])
def test_a_direction_below_a_thousandth_counts_as_dependent(tilt, left):
    """Two unit columns at a small angle t have singular values in the ratio t / 2."""
    x = np.array([[1.0, 1.0], [0.0, tilt], [0.0, 0.0]]) * np.array([1.0, 1e6])
    assert residual_squares(np.array([0.0, 1.0, 0.0]), x) == pytest.approx(left, abs=1e-6)


def test_the_residual_of_several_responses_is_orthogonal_to_the_columns(rng):
    x, y = rng.standard_normal((30, 3)), rng.standard_normal((30, 4))
    left = without(x, y)
    np.testing.assert_allclose(left, y - x @ np.linalg.lstsq(x, y, rcond=None)[0], atol=1e-7)
    assert np.abs(x.T @ left).max() < 1e-6


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


def test_moments_hold_products_and_give_those_of_some_columns(rng):
    x, y, spread = rng.standard_normal((9, 3)), rng.standard_normal((9, 2)), rng.uniform(1.0, 2.0, 9)
    moments = moments_of(y, x, spread)
    part = moments.of(np.array([2, 0]))
    np.testing.assert_allclose(part.design, x[:, [2, 0]].T @ x[:, [2, 0]], rtol=1e-12)
    np.testing.assert_allclose(part.cross, x[:, [2, 0]].T @ y, rtol=1e-12)
    np.testing.assert_allclose(part.squares, (y**2).sum(axis=0), rtol=1e-12)
    assert part.readings == 9
    assert part.log_spread == pytest.approx(np.log(spread).sum())


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


def candidates_of_three_kinds(rng: np.random.Generator, n: int) -> list[Candidate]:
    """Width 1, 2, and 2 of which the last column is no evidence, mixed."""
    widths = [(1, 0), (2, 0), (2, 1), (1, 0), (3, 2)]
    return [Candidate(rng.standard_normal((n, width)), {}, ("um",) * width, beside=beside) for width, beside in widths]


def test_candidates_are_grouped_by_width_with_what_is_no_evidence_first(rng):
    candidates = candidates_of_three_kinds(rng, 6)
    used = np.array([True, False, True, True, True, False])
    groups = by_width(candidates, used)
    assert [(group.width, group.beside, group.places.tolist()) for group in groups] == [
        (1, 0, [0, 3]),
        (2, 0, [1]),
        (2, 1, [2]),
        (3, 2, [4]),
    ]
    np.testing.assert_array_equal(groups[0].columns, np.column_stack([candidates[k].columns[used, 0] for k in (0, 3)]))
    np.testing.assert_array_equal(groups[1].columns, candidates[1].columns[used])
    np.testing.assert_array_equal(groups[2].columns, candidates[2].columns[used][:, [1, 0]])
    np.testing.assert_array_equal(groups[3].columns, candidates[4].columns[used][:, [1, 2, 0]])


def test_reductions_equal_one_least_squares_fit_for_every_candidate_and_response(rng):
    n = 40
    candidates = candidates_of_three_kinds(rng, n)
    model, responses = rng.standard_normal((n, 3)), rng.standard_normal((n, 2))
    groups = by_width(candidates, np.ones(n, bool))
    q, _ = np.linalg.qr(model)
    y = responses - q @ (q.T @ responses)
    reduced, given, separable = reductions(np.concatenate([group.columns for group in groups], axis=1), y, q, groups)
    assert separable.all()
    for place, candidate in enumerate(candidates):
        evidence = candidate.columns.shape[1] - candidate.beside
        for k in range(2):
            alone = squares_beside(responses[:, k], model)
            whole = squares_beside(responses[:, k], np.column_stack([model, candidate.columns]))
            started = squares_beside(responses[:, k], np.column_stack([model, candidate.columns[:, evidence:]]))
            assert reduced[k, place] == pytest.approx(alone - whole, rel=1e-8)
            assert given[k, place] == pytest.approx(alone - started if candidate.beside else 0.0, rel=1e-8, abs=1e-12)


@pytest.mark.parametrize(("share", "separable"), [(0.9e-4, False), (1.1e-4, True)])
def test_a_candidate_of_which_the_model_holds_all_but_a_ten_thousandth_explains_nothing(rng, share, separable):
    q, _ = np.linalg.qr(rng.standard_normal((20, 3)))
    model, outside, y = q[:, :1], q[:, 1], q[:, 1:2]
    column = np.sqrt(1.0 - share) * model[:, 0] + np.sqrt(share) * outside
    groups = by_width([Candidate(5.0 * column[:, None], {}, ("um",))], np.ones(20, bool))
    reduced, _, told = reductions(groups[0].columns, y, model, groups)
    assert told.tolist() == [separable]
    # What is outside the model points along the response: all of it is explained, or nothing.
    assert reduced[0, 0] == pytest.approx(1.0 if separable else 0.0, abs=1e-6)


@pytest.mark.parametrize("width", [1, 2, 4])
def test_a_candidate_with_a_column_of_zeros_explains_nothing(rng, width):
    """A driver that is logged and never runs makes such columns; the other candidates are not touched by them."""
    columns = rng.standard_normal((20, width))
    columns[:, 0] = 0.0
    candidates = [Candidate(c, {}, ("um",) * width) for c in (columns, rng.standard_normal((20, width)))]
    groups = by_width(candidates, np.ones(20, bool))
    y = rng.standard_normal((20, 1))
    reduced, _, separable = reductions(groups[0].columns, y, np.zeros((20, 1)), groups)
    assert separable.tolist() == [False, True]
    assert reduced[0, 0] == 0.0
    assert reduced[0, 1] == pytest.approx(y[:, 0] @ y[:, 0] - squares_beside(y[:, 0], candidates[1].columns))
