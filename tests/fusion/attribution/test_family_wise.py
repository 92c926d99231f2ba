"""The family-wise test: one error probability for sets of candidates of very different size."""

import numpy as np
import pytest

from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution import family_wise as module
from fusion.attribution.drift_channels import DriftSeries
from fusion.attribution.family_wise import LAGS_S, FieldSeries, evaluate_candidates
from fusion.attribution.warm_up import Excitation

VARIED = Excitation(0.5, False, 3)
SECONDS = np.arange(60) * 252.0


def walks(rng, columns):
    values = np.cumsum(rng.standard_normal((60, columns)), axis=0)
    return FieldSeries(SECONDS, values - values.mean(axis=0))


def drift(name, values):
    return DriftSeries(name, values, np.ones(60), SECONDS, np.arange(1, 61), np.eye(60))


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


def test_common_and_proportional_are_also_tested_together(rng):
    cells = walks(rng, 10)
    both = [drift(name, cells.values[:, 4] + rng.standard_normal(60)) for name in ("common", "proportional")]
    result = evaluate_candidates(both, {"cells": cells}, VARIED, lags_s=(0.0,), draws=39, checks=0, rng=rng)
    test = result.sets["cells"]
    assert test.names == ("common", "proportional", "joint")
    np.testing.assert_allclose(test.statistic[2], test.statistic[0] + test.statistic[1], rtol=1e-5)
    # The effect at the far end of travel is the sum of both, and its uncertainty their quadratic sum.
    np.testing.assert_allclose(test.coefficient[2], test.coefficient[0] + test.coefficient[1], rtol=1e-5)
    np.testing.assert_allclose(test.coefficient_u[2], np.hypot(test.coefficient_u[0], test.coefficient_u[1]), rtol=1e-5)
    assert np.isnan(result.false_alarm_rate)


def test_a_source_taken_as_given_leaves_nothing_to_its_copy(rng):
    cells = walks(rng, 5)
    values = cells.values[:, 2] + 0.2 * rng.standard_normal(60)
    beside = evaluate(rng, values, {"cells": cells}, beside=[cells.values[:, [2]]], lags_s=(0.0,)).sets["cells"]
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


def test_every_row_is_ranked_among_the_largest_maxima_of_all_rows():
    """Two rows whose maxima run against each other: in every draw one of them is at least 10, so that 9.5 is nothing special."""
    maxima = np.stack([np.arange(1.0, 20.0), np.arange(19.0, 0.0, -1.0)])
    p_values, _ = module._family_wise([np.array([9.5]), np.array([9.5])], maxima, np.zeros(2))
    assert [float(p[0]) for p in p_values] == [1.0, 1.0]


def test_permuted_residuals_stay_in_blocks_of_a_tenth_of_the_series(rng):
    """About ten cuts in a series of any length; a reading keeps its neighbour everywhere else."""
    for length in (60, 200):
        orders = [module._shuffle_blocks(length, rng) for _ in range(300)]
        assert all(sorted(order) == list(range(length)) for order in orders[:5])
        broken = np.mean([np.count_nonzero(np.diff(order) % length != 1) for order in orders])
        # Poisson with mean 10, less the cut at the start and blocks that meet again: 9 to 10; the mean of 300 is known within 0.2.
        assert 8.0 < broken < 10.6
