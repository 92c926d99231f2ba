"""The family-wise test: one error probability for sets of candidates of very different size."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg

import thermography.large_arrays as spool_module
from fusion.analysis.alignment.first_order_lag import lag_operators
from fusion.analysis.attribution import significance as module
from fusion.analysis.attribution.drift_channels import DriftSeries, TargetSeries
from fusion.analysis.attribution.modes import Excitation
from fusion.analysis.attribution.significance import (
    LAGS_S,
    FieldSeries,
    estimate_effects,
    evaluate_candidates,
    fit_regressors,
    likelihood_ratios,
    null_bank,
    resample,
    screen,
    whiten_series,
    whitening_grid,
)

VARIED = Excitation(0.5, False)
SECONDS = np.arange(60) * 252.0


def walks(rng, columns):
    values = np.cumsum(rng.standard_normal((60, columns)), axis=0)
    return FieldSeries(SECONDS, values - values.mean(axis=0))


def drift(name, values):
    return DriftSeries(name, values, np.ones(60), SECONDS, np.eye(60))


def evaluate(rng, values, candidates, **changes):
    settings = {"lags_s": (0.0, 1200.0), "draws": 99, "checks": 19, "rng": rng, **changes}
    return evaluate_candidates([drift("common", values)], candidates, VARIED, **settings)


def test_the_column_that_drives_the_series_leads_its_set(rng):
    cells, modes = walks(rng, 40), walks(rng, 3)
    values = 0.8 * cells.values[:, 17] + 0.2 * rng.standard_normal(60)
    result = evaluate(rng, values, {"cells": cells, "modes": modes})
    assert list(result.sets) == ["cells", "modes"]
    test = result.sets["cells"]
    assert int(test.statistic[0].argmax()) == 17 and int(test.lag_index[0, 17]) == 0
    # The smallest p-value that 99 draws allow.
    assert test.p_value[0, 17] == pytest.approx(0.01)
    assert test.coefficient[0, 17] == pytest.approx(0.8, abs=4 * test.coefficient_u[0, 17])
    assert (test.p_value <= 0.05).tolist() == (test.statistic > test.threshold[:, None]).tolist()
    # A table of sensitivities cannot contradict its own p-values.
    assert (test.p_value <= 0.05).tolist() == ((test.low > 0.0) | (test.high < 0.0)).tolist()
    assert ((test.low <= test.coefficient) & (test.coefficient <= test.high)).all()


def test_common_and_proportional_are_also_tested_together(rng):
    cells = walks(rng, 10)
    both = [drift(name, cells.values[:, 4] + rng.standard_normal(60)) for name in ("common", "proportional")]
    result = evaluate_candidates(both, {"cells": cells}, VARIED, lags_s=(0.0,), draws=39, checks=0, rng=rng)
    test = result.sets["cells"]
    assert test.names == ("common", "proportional", "joint")
    np.testing.assert_allclose(test.statistic[2], test.statistic[0] + test.statistic[1], rtol=1e-5)
    # The effect at the far end of travel is the sum of both, and its uncertainty their quadratic sum, but for what the most likely drift of
    # each differs from the mean one (some per cent): these add up with their signs.
    np.testing.assert_allclose(test.coefficient[2], test.coefficient[0] + test.coefficient[1], rtol=1e-5)
    np.testing.assert_allclose(test.coefficient_u[2], np.hypot(test.coefficient_u[0], test.coefficient_u[1]), rtol=0.05)
    # Where neither part is shown, their sum may be nothing.
    quiet = test.p_value[2] > 0.05
    assert quiet.any() and (test.low[2, quiet] <= 0.0).all() and (test.high[2, quiet] >= 0.0).all()
    assert np.isnan(result.false_alarm_rate)


def test_a_source_taken_as_given_leaves_nothing_to_its_copy(rng):
    cells = walks(rng, 5)
    values = cells.values[:, 2] + 0.2 * rng.standard_normal(60)
    beside = evaluate(rng, values, {"cells": cells}, conditional_on=[cells.values[:, [2]]], lags_s=(0.0,)).sets["cells"]
    assert beside.statistic[0, 2] == pytest.approx(0.0, abs=1e-3)
    assert (beside.p_value > 0.05).all()


def test_favour_lowers_the_threshold_of_a_set_at_the_cost_of_the_others(rng):
    candidates = {"cells": walks(rng, 60), "modes": walks(rng, 3)}
    values = np.cumsum(rng.standard_normal(60))
    plain = evaluate(np.random.default_rng(5), values, candidates).sets
    favoured = evaluate(np.random.default_rng(5), values, candidates, favour={"modes": 0.5}).sets
    assert favoured["modes"].threshold[0] < plain["modes"].threshold[0]
    assert favoured["cells"].threshold[0] >= plain["cells"].threshold[0]


def test_a_body_of_forty_minutes_is_found_with_its_lag_among_the_usual_ones(rng):
    """Lags reach from none to an hour and a half; a grid of seconds would not tell a slow body from its surface."""
    cells = walks(rng, 4)
    (slow,) = lag_operators(SECONDS, [2400.0])
    values = (slow @ cells.values)[:, 1] + 0.02 * rng.standard_normal(60)
    result = evaluate_candidates([drift("common", values)], {"cells": cells}, VARIED, draws=19, checks=0, rng=rng)
    assert LAGS_S[int(result.sets["cells"].lag_index[0, 1])] == 2400.0


def test_a_family_wise_p_value_is_the_rank_among_the_simulated_maxima():
    """One row: its unit and centre cancel, and the p-value is (1 + number of maxima at least as large) / (draws + 1)."""
    maxima = np.arange(1.0, 20.0)[None, :]
    (p,), threshold = module._family_wise([np.array([0.5, 10.0, 18.5, 25.0])], maxima, np.zeros(1))
    np.testing.assert_allclose(p, [20 / 20, 11 / 20, 2 / 20, 1 / 20])
    assert threshold[0] == pytest.approx(19.0)
    # Of 39 the second largest has p = 2 / 40; nine cannot reach the level, and their largest is the limit.
    for draws, limit in ((39, 38.0), (9, 9.0)):
        _, threshold = module._family_wise([np.array([0.5])], np.arange(1.0, draws + 1.0)[None, :], np.zeros(1))
        assert threshold[0] == pytest.approx(limit)


def test_every_row_is_ranked_among_the_largest_maxima_of_all_rows():
    """Two rows whose maxima run against each other: in every draw one of them is at least 10, so that 9.5 is nothing special."""
    maxima = np.stack([np.arange(1.0, 20.0), np.arange(19.0, 0.0, -1.0)])
    p_values, _ = module._family_wise([np.array([9.5]), np.array([9.5])], maxima, np.zeros(2))
    assert [float(p[0]) for p in p_values] == [1.0, 1.0]


def test_permuted_residuals_stay_in_blocks_of_a_share_of_the_series(rng):
    """About ten cuts in a series of any length; a reading keeps its neighbour everywhere else."""
    for length in (60, 200):
        orders = [module._shuffle_blocks(length, 0.1, rng) for _ in range(300)]
        assert all(sorted(order) == list(range(length)) for order in orders[:5])
        broken = np.mean([np.count_nonzero(np.diff(order) % length != 1) for order in orders])
        # Poisson with mean 10, less the cut at the start and blocks that meet again: 9 to 10; the mean of 300 is known within 0.2.
        assert 8.0 < broken < 10.6


@pytest.mark.parametrize(("cycle_s", "share"), [(252.0, 0.2), (504.0, 0.1), (60.0, 0.25)])
def test_runs_last_as_long_as_heat_spreads_however_short_the_session_is(cycle_s, share, rng, monkeypatch):
    """51 values over 3.5 h, 7 h and 50 min: 42 min are a fifth, a tenth and more than a quarter of them."""
    asked = []
    monkeypatch.setattr(module, "_shuffle_blocks", lambda length, share, rng: asked.append(share) or np.arange(length))
    seconds = cycle_s * np.arange(51)
    bank = null_bank(rng.standard_normal(51), seconds, np.ones(51), np.ones((51, 1)), integrated=False)
    module._draw([SimpleNamespace(values=bank.values, seconds=seconds)], [bank], 1, 1, rng)
    assert asked == [pytest.approx(share)]


def one_channel_of(cells, banks=1):
    """Tallies by hand of one set: one channel, `cells` columns, `banks` simulated series."""
    return module._Tally(1, cells, banks)


def test_false_alarms_are_the_share_of_fresh_series_that_pass_in_any_row():
    """Nineteen simulated maxima 1..19 give the threshold 19; of four fresh series one passes it in the first set, another in the second."""
    cells, modes = module._Tally(3, 1, 23), module._Tally(3, 1, 23)
    for tally in (cells, modes):
        tally.maxima[:, :19] = np.arange(1.0, 20.0)
        tally.statistic[:] = 10.0
    # A value equal to the threshold does not pass.
    cells.maxima[:2, 19:] = [[18.0, 25.0, 19.0, 2.0], [1.0, 2.0, 3.0, 19.5]]
    modes.maxima[:2, 19:] = [[30.0, 25.0, 3.0, 2.0], [1.0, 2.0, 3.0, 2.0]]
    result = module._conclude(["common", "proportional", "reversal"], {"cells": cells, "modes": modes}, {}, [], 19)
    assert result.sets["cells"].threshold == pytest.approx([19.0] * 3)
    assert [result.sets[name].false_alarm_rate for name in ("cells", "modes")] == [0.5, 0.5]
    assert result.false_alarm_rate == 0.75
    assert result.sets["modes"].p_value.tolist() == [[11 / 20]] * 3


def test_the_detection_limit_is_the_threshold_and_the_quantile_of_80_percent_power():
    """Threshold 9, standard uncertainty 0.5 um/K: (3 + 0.84) 0.5 um/K is found four times of five."""
    tally = one_channel_of(2)
    tally.effects[2] = [0.5, 2.0]
    test = tally.finish(["common"], np.ones((1, 2)), np.array([9.0]), 0.0)
    np.testing.assert_allclose(test.detectable, [[0.5 * 3.8416, 2.0 * 3.8416]])


def test_false_discovery_rates_follow_benjamini_and_hochberg():
    """Of 99 pooled values 49 reach the statistic 1, 4 the statistic 2, and none 3: p = 0.5, 0.05, 0.01."""
    counts = np.zeros(module._BINS.size - 1)
    counts[[0, 9, 12, 21]] = [30, 20, 45, 4]
    q = module._false_discovery(np.array([1.0, 3.0, 2.0]), counts)
    np.testing.assert_allclose(q, [0.5, 3 * 0.01, 1.5 * 0.05])
    # A smaller p-value never has the larger q-value: 3 of 4 columns at p = 0.05 pull the fourth down with them.
    np.testing.assert_allclose(module._false_discovery(np.array([2.0, 2.0, 2.0, 2.1]), counts), 0.05)


def test_the_width_of_a_tile_changes_nothing_and_progress_reaches_the_end(rng, monkeypatch):
    candidates = {"cells": walks(rng, 7), "modes": walks(rng, 2)}
    values = np.cumsum(rng.standard_normal(60))
    whole = evaluate(np.random.default_rng(3), values, candidates).sets
    done: list[float] = []
    monkeypatch.setattr(
        module, "tiles", lambda columns, group: [slice(k, min(k + 4, columns)) for k in range(0, columns, 4)]
    )
    parts = evaluate(np.random.default_rng(3), values, candidates, progress=done.append).sets
    np.testing.assert_allclose(done, np.array([2, 4, 6, 7, 9]) / 9)
    for name, test in whole.items():
        # Single precision of the products.
        np.testing.assert_allclose(parts[name].statistic, test.statistic, atol=1e-4)
        np.testing.assert_allclose(parts[name].coefficient, test.coefficient, rtol=1e-4)
        assert parts[name].p_value.tolist() == test.p_value.tolist()
        np.testing.assert_allclose(parts[name].q_value, test.q_value, rtol=1e-2)


def test_a_series_with_a_missing_reading_is_permuted_as_the_others(rng, monkeypatch):
    """What two series share stays shared: the shorter one takes the same order, without the place that it lacks."""
    asked = []

    def resampled(bank, orders, *, rng, gaussian=False):
        asked.append((gaussian, np.array(orders)))
        return np.zeros(orders.shape)

    monkeypatch.setattr(module, "resample", resampled)
    series = [drift("common", np.zeros(60)), drift("reversal", np.zeros(59))]
    stacks = module._draw(series, [None, None], 5, 2, rng)
    assert [stack.shape for stack in stacks] == [(8, 60), (8, 59)]
    (long, short) = (orders for gaussian, orders in asked if not gaussian)
    assert long.shape == (5, 60) and short.shape == (5, 59)
    for one, other in zip(long, short, strict=True):
        assert one[one != 59].tolist() == other.tolist()
    assert [orders.shape for gaussian, orders in asked if gaussian] == [(2, 60), (2, 59)]


# The fast likelihood ratio against dense algebra.


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
    found = likelihood_ratios(whiten_series(bank, values[None, :]), regressors)[0]
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
    found, fits = estimate_effects(bank, regressors), fit_regressors(bank, regressors)
    for k, x in enumerate(regressors.T.astype(float)):
        design = np.column_stack([nuisance, x])
        betas, us = [], []
        for covariance in covariances(seconds, bank):
            inverse = np.linalg.inv(covariance)
            normal = np.linalg.inv(design.T @ inverse @ design)
            beta = normal @ design.T @ inverse @ values
            rest = values - design @ beta
            betas.append(beta[2])
            us.append(np.sqrt(rest @ inverse @ rest / (40 - 3) * normal[2, 2]))
        np.testing.assert_allclose(fits.coefficient[:, k], betas, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(fits.coefficient_u[:, k], us, rtol=1e-3)
        assert found.coefficient[k] == fits.coefficient[fits.score[:, k].argmin(), k]
        # Over the drifts by their likelihood, about the coefficient that is reported.
        weight = np.exp(-0.5 * bank.freedom * (fits.score[:, k] - fits.score[:, k].min()))
        square = np.square(us) + np.square(np.array(betas) - found.coefficient[k])
        assert found.coefficient_u[k] == pytest.approx(np.sqrt((weight * square).sum() / weight.sum()), rel=1e-3)


def test_limits_of_a_coefficient_are_where_its_likelihood_ratio_is_reached(problem):
    """The coefficient at a limit, taken out of the series, leaves a null that is worse than the best fit by the ratio."""
    seconds, values, nuisance, regressors = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    fits = fit_regressors(bank, regressors)
    low, high = fits.limits(6.0)
    for k, x in enumerate(regressors.T.astype(float)):
        for limit in (low[k], high[k]):
            left = null_bank(values - limit * x, seconds, np.ones(40), nuisance)
            ratio = -2.0 * left.log_likelihood.max() - bank.freedom * fits.score[:, k].min()
            assert ratio == pytest.approx(6.0, abs=1e-2)
    # Of two effects together they are those of their sum: for two alike, as far apart as one at twice the spread in square.
    both_low, both_high = module.joint_limits([fits, fits], 6.0)
    assert ((both_high - both_low) > (high - low)).all() and ((both_high - both_low) < 2.0 * (high - low)).all()


def test_the_uncertainty_of_an_effect_holds_the_lags_that_the_data_allow(rng):
    """Two alternatives that fit alike, of which one has twice the length and so half the coefficient: 1 and 2 um/K, 1 from each other."""
    values = rng.standard_normal(60)
    bank = null_bank(values, SECONDS, np.ones(60), np.empty((60, 0)), integrated=False)
    column = (values + 0.1 * rng.standard_normal(60))[:, None]
    fits = fit_regressors(bank, np.hstack([column, column / 2.0]).astype(np.float32))
    effect = module.combine_fits([fits], np.array([0]))
    assert effect.coefficient[0] == pytest.approx(1.0, abs=0.05)
    assert effect.coefficient_u[0] == pytest.approx(np.sqrt(0.5), rel=0.05)


def test_a_regressor_without_information_gives_nothing(problem):
    seconds, values, nuisance, _ = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    dead = np.column_stack([np.zeros(40), np.ones(40), seconds / 3600.0]).astype(np.float32)
    assert likelihood_ratios(whiten_series(bank, values[None, :]), dead) == pytest.approx(0.0, abs=1e-6)
    assert np.isinf(estimate_effects(bank, dead).coefficient_u).all()


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


def test_whitenings_in_a_temporary_file_give_the_same_bits(problem, monkeypatch):
    seconds, values, nuisance, regressors = problem
    bank = null_bank(values, seconds, np.ones(40), nuisance)
    draws = np.vstack([values, values[::-1]])
    at_hand = whiten_series(bank, draws)
    monkeypatch.setattr(spool_module, "IN_MEMORY_BYTES", 100)
    in_file = whiten_series(bank, draws)
    assert isinstance(in_file.projects.base, np.memmap) and isinstance(in_file.series.base, np.memmap)
    found = likelihood_ratios(in_file, regressors)
    assert (found == likelihood_ratios(at_hand, regressors)).all()


# The fast screen against the plain algebra it stands for, and its level.


def series_of(values):
    """Series (series, 60) of one direction, at the instants of the frames."""
    directions = ("positive",) * len(values)
    return TargetSeries(directions, np.arange(1, len(values) + 1), values, SECONDS, np.eye(60))


@pytest.fixture
def problem_per_target(rng):
    values = np.cumsum(rng.standard_normal((5, 60)), axis=1) + 0.5 * rng.standard_normal((5, 60))
    film = np.cumsum(rng.standard_normal((60, 700)), axis=0)
    return values, FieldSeries(SECONDS, film - film.mean(axis=0))


def test_the_screen_is_whitened_least_squares_per_series_cell_and_lag(problem_per_target):
    values, film = problem_per_target
    screening = screen(series_of(values), film, VARIED, permutations=0, rng=np.random.default_rng(0))
    nuisance = np.column_stack([np.ones(60), SECONDS / SECONDS[-1]])
    for k, row in enumerate(values):
        project = null_bank(row, SECONDS, np.ones(60), nuisance).fitted.project
        y = project @ row
        ratios, coefficients, uncertainties = [], [], []
        for operator in lag_operators(SECONDS, LAGS_S):
            x = project @ operator @ film.values
            ratios.append(-58 * np.log1p(-((y @ x) ** 2) / ((x**2).sum(axis=0) * (y @ y))))
            coefficients.append((y @ x) / (x**2).sum(axis=0))
            rest = y @ y - (y @ x) ** 2 / (x**2).sum(axis=0)
            uncertainties.append(np.sqrt(rest / 57 / (x**2).sum(axis=0)))
        best = np.argmax(ratios, axis=0)
        np.testing.assert_allclose(screening.statistic[k], np.max(ratios, axis=0), rtol=1e-3, atol=1e-3)
        agree = best == screening.lag_index[k]
        # Lags whose ratios agree within single precision may swap.
        assert agree.mean() > 0.99
        picked = np.array(coefficients)[best, np.arange(best.size)]
        np.testing.assert_allclose(screening.sensitivity[k][agree], picked[agree], rtol=1e-3, atol=1e-5)
        u = np.array(uncertainties)[best, np.arange(best.size)]
        np.testing.assert_allclose(screening.sensitivity_u[k][agree], u[agree], rtol=1e-3)


def test_maxima_belong_to_whole_permutations(problem_per_target):
    values, film = problem_per_target
    screening = screen(series_of(values), film, VARIED, permutations=50, rng=np.random.default_rng(0))
    assert screening.maxima.shape == (50, 5)
    assert (screening.maxima > 0).all()
    # Family-wise over targets, cells and lags: rank of a statistic among the largest values of the permutations.
    reached = (screening.maxima.max(axis=1) >= screening.statistic[..., None]).sum(axis=-1)
    np.testing.assert_allclose(screening.p_value, (1 + reached) / 51, rtol=1e-6)


def test_a_permuted_series_is_coloured_and_fitted_as_the_measured_one(problem_per_target):
    values, film = problem_per_target
    film = FieldSeries(SECONDS, film.values[:, :9])
    screening = screen(series_of(values), film, VARIED, permutations=4, rng=np.random.default_rng(7))
    orders = np.argsort(np.random.default_rng(7).random((4, 60)), axis=1)
    nuisance = np.column_stack([np.ones(60), SECONDS / SECONDS[-1]])
    for k, row in enumerate(values):
        null = null_bank(row, SECONDS, np.ones(60), nuisance).fitted
        cells = np.hstack([null.project @ operator @ film.values for operator in lag_operators(SECONDS, LAGS_S)])
        cells /= np.linalg.norm(cells, axis=0)
        for order, largest in zip(orders, screening.maxima[:, k], strict=True):
            y = null.project @ null.colour @ (null.project @ row)[order]
            share = np.max((y @ cells) ** 2 / (y @ y))
            assert largest == pytest.approx(-58 * np.log1p(-share), rel=1e-3)


def test_a_dead_cell_explains_nothing_and_a_copy_of_the_drift_all_but_rounding(problem_per_target):
    values, film = problem_per_target
    cells = film.values[:, :3].copy()
    cells[:, 1] = 0.0
    cells[:, 2] = values[3] - values[3].mean()
    run = {"permutations": 0, "rng": np.random.default_rng(0)}
    screening = screen(series_of(values), FieldSeries(SECONDS, cells), VARIED, **run)
    assert (screening.statistic[:, 1] == 0.0).all() and (screening.sensitivity[:, 1] == 0.0).all()
    assert np.isfinite(screening.statistic).all()
    # Single precision leaves a millionth of the squares unexplained.
    assert screening.statistic[3, 2] == pytest.approx(58 * np.log(1e6), rel=0.05)
    assert screening.sensitivity[3, 2] == pytest.approx(1.0, rel=1e-4)


def test_a_missing_value_has_no_weight(problem_per_target):
    values, film = problem_per_target
    holes = values.copy()
    holes[2, 20] = np.nan
    far = values.copy()
    far[2, 20] += 50.0
    run = {"permutations": 0, "rng": np.random.default_rng(0)}
    clean = screen(series_of(values), film, VARIED, **run)
    holed = screen(series_of(holes), film, VARIED, **run)
    spoilt = screen(series_of(far), film, VARIED, **run)
    np.testing.assert_allclose(holed.statistic[[0, 1, 3, 4]], clean.statistic[[0, 1, 3, 4]], rtol=1e-4, atol=1e-4)
    change = np.abs(holed.statistic[2] - clean.statistic[2]).mean()
    assert change < 0.3 * np.abs(spoilt.statistic[2] - clean.statistic[2]).mean()
