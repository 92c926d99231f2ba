"""The fast likelihood ratio against dense algebra."""

import numpy as np
import pytest
from scipy import linalg

from fusion.attribution.likelihood_ratio import (
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    tiles,
    whiten_series,
)


def dense_log_likelihood(values, design, covariance):
    """Restricted for the first two columns, maximised over sigma, by Cholesky; the regressor (third) by maximum likelihood."""
    root = np.linalg.cholesky(covariance)
    white = linalg.solve_triangular(root, np.column_stack([values, design]), lower=True)
    response, columns = white[:, 0], white[:, 1:]
    rest = response - columns @ np.linalg.lstsq(columns, response, rcond=None)[0]
    freedom = values.size - 2
    fixed = columns[:, :2].T @ columns[:, :2]
    return -0.5 * (freedom * np.log(rest @ rest) + 2 * np.log(np.diag(root)).sum() + np.linalg.slogdet(fixed)[1])


def covariances(seconds, bank):
    hours = seconds / 3600.0
    early = np.minimum.outer(hours, hours)
    late = np.maximum.outer(hours, hours)
    for point in bank.whitenings:
        if point.order == 2:
            yield np.eye(seconds.size) + point.per_hour**2 * (early**2 * (3 * late - early) / 2.0)
        else:
            yield np.eye(seconds.size) + point.per_hour**2 * early


@pytest.fixture
def problem(rng):
    seconds = np.sort(rng.uniform(0, 7 * 3600, 40))
    seconds -= seconds[0]
    values = np.cumsum(rng.standard_normal(40)) + rng.standard_normal(40)
    nuisance = np.column_stack([np.ones(40), seconds / 3600.0])
    regressors = np.cumsum(rng.standard_normal((40, 7)), axis=0).astype(np.float32)
    return seconds, values, nuisance, regressors


def test_likelihood_ratio_is_that_of_dense_gaussian_algebra(problem):
    seconds, values, nuisance, regressors = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    found = likelihood_ratios(bank, whiten_series(bank, values[None, :]), regressors)[0]
    matrices = list(covariances(seconds, bank))
    null = max(dense_log_likelihood(values, nuisance, c) for c in matrices)
    expected = [
        2 * (max(dense_log_likelihood(values, np.column_stack([nuisance, x]), c) for c in matrices) - null)
        for x in regressors.T.astype(float)
    ]
    # Single precision of the products, times 38 degrees of freedom.
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_coefficient_and_uncertainty_are_those_of_generalised_least_squares(problem):
    seconds, values, nuisance, regressors = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    found = estimate_effects(bank, regressors)
    matrices = list(covariances(seconds, bank))
    for k, x in enumerate(regressors.T.astype(float)):
        design = np.column_stack([nuisance, x])
        best = max(matrices, key=lambda c: dense_log_likelihood(values, design, c))
        inverse = np.linalg.inv(best)
        normal = np.linalg.inv(design.T @ inverse @ design)
        beta = normal @ design.T @ inverse @ values
        rest = values - design @ beta
        sigma2 = rest @ inverse @ rest / (40 - 3)
        assert found.coefficient[k] == pytest.approx(beta[2], rel=1e-3, abs=1e-4)
        assert found.coefficient_u[k] == pytest.approx(np.sqrt(sigma2 * normal[2, 2]), rel=1e-3)


def test_redrawn_series_have_the_fitted_drift(rng):
    seconds = np.arange(100) * 252.0
    values = np.cumsum(rng.standard_normal(100)) * 0.5 + 0.1 * rng.standard_normal(100)
    bank = null_bank(values, seconds, np.ones(100), np.ones((100, 1)))
    orders = np.argsort(rng.random((400, 100)), axis=1)
    drawn = resample(bank, orders, rng=rng)
    # Increments carry the drift: 99 measured ones know their size to 7 %, the draws add the spread of the grid (factor 3 in size).
    assert np.diff(drawn, axis=1).std() == pytest.approx(np.diff(values).std(), rel=0.35)


def test_a_regressor_without_information_gives_nothing(problem):
    seconds, values, nuisance, _ = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    dead = np.column_stack([np.zeros(40), np.ones(40), seconds / 3600.0]).astype(np.float32)
    assert likelihood_ratios(bank, whiten_series(bank, values[None, :]), dead) == pytest.approx(0.0, abs=1e-6)
    assert np.isinf(estimate_effects(bank, dead).coefficient_u).all()


def test_tiles_cover_all_columns_once_in_whole_groups():
    covered = np.zeros(6006, int)
    for tile in tiles(6006, 6):
        covered[tile] += 1
        assert tile.start % 6 == 0
    assert (covered == 1).all()
