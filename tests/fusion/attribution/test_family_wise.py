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
    # Of 39 the second largest has p = 2 / 40; nine cannot reach the level, and their largest is the limit.
    for draws, limit in ((39, 38.0), (9, 9.0)):
        _, threshold = module._family_wise([np.array([0.5])], np.arange(1.0, draws + 1.0)[None, :], np.zeros(1))
        assert threshold[0] == pytest.approx(limit)


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
    candidates = {"cells": walks(np.random.default_rng(0), 1), "modes": walks(np.random.default_rng(0), 1)}
    result = module._conclude(["common", "proportional", "reversal"], [cells, modes], candidates, {}, [], 19, 4)
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


def test_simulated_values_are_pooled_in_tenths_without_the_measured_one():
    tally = one_channel_of(2, 3)
    best = np.array([[9.0, 9.0], [0.05, 0.31], [0.35, 39.7], [0.05, 400.0]], np.float32)
    tally.add(0, slice(0, 2), module._Channel(best, np.array([1, 0]), np.ones((3, 2))))
    assert tally.pooled[0].sum() == 6
    assert {int(k): int(tally.pooled[0, k]) for k in np.flatnonzero(tally.pooled[0])} == {0: 2, 3: 2, 397: 1, 399: 1}
    assert tally.maxima[0].tolist() == [np.float32(0.31), np.float32(39.7), 400.0]
    assert tally.statistic.tolist() == [[9.0, 9.0]] and tally.lag_index.tolist() == [[1, 0]]


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
