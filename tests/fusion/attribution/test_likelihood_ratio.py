"""The fast likelihood ratio against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

import thermography.fields.tasks.spool as spool_module
from fusion.attribution.likelihood_ratio import (
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    tiles,
    whiten_series,
    whitening_grid,
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
    # 0.5 um a cycle of 252 s are 1.9 um in an hour; the grid has steps of three.
    assert 0.6 < bank.drift_per_hour < 6.0
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
        assert tile.start % 6 == 0 and tile.stop - tile.start <= 512
    assert (covered == 1).all()


def null_of_a_walk(rng):
    """Null models of a random walk of 40 values beside a mean and a trend, and the identical permutation 400 times."""
    seconds = np.arange(40) * 300.0
    nuisance = np.column_stack([np.ones(40), seconds / seconds[-1]])
    bank = null_bank(np.cumsum(rng.standard_normal(40)), seconds, np.ones(40), nuisance)
    return bank, np.tile(np.arange(40), (400, 1))


def with_odds(bank, odds):
    """The same null models, some grid points with the given odds and the others impossible."""
    log_likelihood = np.full(len(bank.whitenings), -np.inf)
    log_likelihood[list(odds)] = np.log(list(odds.values()))
    return replace(bank, log_likelihood=log_likelihood)


def test_simulated_series_are_coloured_by_drift_variances_drawn_by_their_likelihood(rng):
    """Without regressors and permuted by the identity, a series is one of two that are known exactly."""
    bank, orders = null_of_a_walk(rng)
    bare = replace(bank, whitenings=tuple(replace(one, basis=np.empty((40, 0))) for one in bank.whitenings))
    series = resample(with_odds(bare, {2: 3.0, 6: 1.0}), orders, rng=rng)
    expected = [one.colour @ one.project @ bank.values for one in (bank.whitenings[2], bank.whitenings[6])]
    is_first = np.isclose(series, expected[0]).all(axis=1)
    assert (is_first | np.isclose(series, expected[1]).all(axis=1)).all()
    # 300 of 400 in the mean; 4 standard deviations are 35.
    assert is_first.sum() == pytest.approx(300, abs=35)


def test_what_the_nuisance_regressors_took_out_is_put_back_at_random(rng):
    """The part of a whitened simulated series along the regressors has the variance of its other parts."""
    bank, orders = null_of_a_walk(rng)
    point = bank.whitenings[4]
    series = resample(with_odds(bank, {4: 1.0}), orders, rng=rng)
    along = np.linalg.solve(point.colour, series.T).T @ point.basis
    residual = point.project @ bank.values
    # The mean square of 800 normal numbers is known to 5 %; 4 sigma.
    assert np.mean(along**2) == pytest.approx(residual @ residual / bank.freedom, rel=0.2)


def test_the_grid_reaches_from_no_drift_to_drifts_that_hide_every_source():
    """Walks of 0.1 to 219 and integrated walks of 0.1 to 1968 standard deviations of the noise an hour, in steps of three."""
    seconds = np.arange(20) * 300.0
    grid = whitening_grid(seconds, np.ones(20), np.ones((20, 1)))
    steps = [(one.order, one.per_hour) for one in grid.whitenings]
    assert steps[0] == (0, 0.0)
    assert steps[1:9] == [(1, pytest.approx(0.1 * 3**k)) for k in range(8)]
    assert steps[9:] == [(2, pytest.approx(0.1 * 3**k)) for k in range(10)]
    assert len(whitening_grid(seconds, np.ones(20), np.ones((20, 1)), integrated=False).whitenings) == 9


def test_the_noise_of_a_white_series_is_its_root_mean_square_in_any_unit(rng):
    """Without drift and regressors sigma is the rms, whatever relative variance the values share; simulated noise has that size."""
    values = rng.standard_normal(400)
    seconds = np.arange(400) * 10.0
    for variance in (1.0, 9.0):
        bank = null_bank(values, seconds, np.full(400, variance), np.empty((400, 0)), integrated=False)
        assert bank.fitted.order == 0 and bank.freedom == 400
        assert bank.sigma == pytest.approx(np.sqrt(np.mean(values**2)))
    # A regressor of given length is known to sigma over that length.
    regressor = rng.standard_normal((400, 1)).astype(np.float32)
    null_u = estimate_effects(bank, regressor).null_u
    assert null_u[0] == pytest.approx(bank.sigma / np.linalg.norm(regressor), rel=1e-5)
    drawn = resample(with_odds(bank, {0: 1.0}), np.zeros((50, 400), int), rng=rng, gaussian=True)
    # 20,000 normal values: 4 standard deviations of their root mean square are 2 %; none beyond 6 sigma, as a ratio of normals has.
    assert np.sqrt(np.mean(drawn**2)) == pytest.approx(bank.sigma, rel=0.02)
    assert np.abs(drawn).max() < 6 * bank.sigma


def test_the_unit_of_the_readings_changes_no_likelihood_ratio(problem):
    seconds, values, nuisance, regressors = problem

    def ratios(unit):
        bank = null_bank(values * unit, seconds, np.full(40, unit**2), nuisance)
        return likelihood_ratios(bank, whiten_series(bank, unit * values[None, :]), regressors)

    np.testing.assert_allclose(ratios(1e4), ratios(1.0), atol=1e-3)
    np.testing.assert_allclose(ratios(1e-4), ratios(1.0), atol=1e-3)


def test_whitenings_in_a_temporary_file_give_the_same_bits(problem, monkeypatch):
    seconds, values, nuisance, regressors = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    draws = np.vstack([values, values[::-1]])
    at_hand = whiten_series(bank, draws)
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", 100)
    in_file = whiten_series(bank, draws)
    assert isinstance(in_file.projects.base, np.memmap) and isinstance(in_file.series.base, np.memmap)
    found = likelihood_ratios(bank, in_file, regressors)
    assert (found == likelihood_ratios(bank, at_hand, regressors)).all()
    alone, beside = estimate_effects(bank, regressors), estimate_effects(bank, regressors, whitened=in_file)
    assert (alone.coefficient == beside.coefficient).all() and (alone.coefficient_u == beside.coefficient_u).all()
    assert (alone.null_u == beside.null_u).all()
