"""The paper's equations: to the letter, with the telescoping chain, the ratio's meaning and Student's t."""

import numpy as np
import pytest
from scipy import stats

from interferometry.drift.estimate import estimate_drift
from interferometry.neighbours import (
    build_chart,
    compare,
    coverage_factor,
    evaluate_conventional,
    evaluate_neighbours,
)
from tests.interferometry.simulated_campaigns import SIGMA_UM, simulate

pytestmark = pytest.mark.long


def test_equations_4_and_6_to_the_letter(rng):
    deviations, _ = simulate(rng, cycles=12)
    result = evaluate_neighbours(deviations)
    x = deviations["deviation"].values[:, 0, :]
    n = len(x)
    for i in range(15):
        d = x[:, i] - x[:, i + 1]
        mean = d.sum() / n
        assert float(result["mean_difference"][0, i]) == pytest.approx(mean)
        assert float(result["mean_difference_u"][0, i]) == pytest.approx(
            np.sqrt(((mean - d) ** 2).sum() / (n * (n - 1)))
        )
        assert float(result["standard_deviation"][0, i]) == pytest.approx(d.std(ddof=1))
    assert result["link"].values.tolist() == list(range(2, 17))


def test_equations_2_3_and_5_to_the_letter(rng):
    deviations, _ = simulate(rng, cycles=40)
    result = evaluate_conventional(deviations)
    x = deviations["deviation"].values
    assert result["standard_deviation"].values == pytest.approx(x.std(axis=0, ddof=1))
    assert result["mean_u"].values == pytest.approx(x.std(axis=0, ddof=1) / np.sqrt(40))
    assert result["upper"].values == pytest.approx(x.mean(axis=0) + 2 * x.std(axis=0, ddof=1))
    assert result["lower"].values == pytest.approx(x.mean(axis=0) - 2 * x.std(axis=0, ddof=1))


def test_chain_of_mean_differences_is_the_mean_profile(rng):
    deviations, _ = simulate(rng)
    chain = np.cumsum(evaluate_neighbours(deviations)["mean_difference"].values, axis=-1)
    mean = deviations["deviation"].values.mean(axis=0)
    assert np.abs(chain - (mean[:, :1] - mean[:, 1:])).max() < 1e-9


def test_student_below_thirty_repetitions():
    assert coverage_factor(np.array([30, 100])).tolist() == [2.0, 2.0]
    assert float(coverage_factor(np.array(5))) == pytest.approx(2.869, abs=0.001)
    assert np.isnan(coverage_factor(np.array(1)))
    assert float(coverage_factor(np.array(29))) == pytest.approx(stats.t.ppf(0.97725, 28), abs=1e-3)


def test_conventional_s_is_drift_and_differenced_s_is_not(rng):
    deviations, _ = simulate(rng)
    assert float(evaluate_conventional(deviations)["standard_deviation"].mean()) > 2.0
    single = evaluate_neighbours(deviations)["position_standard_deviation"]
    # Random part 0.4 um, plus the stretch between neighbours, which differencing does not remove.
    assert 0.38 < float(single.mean()) < 0.47


def test_three_standard_deviations_side_by_side(rng):
    deviations, _ = simulate(rng)
    table = compare(deviations, estimate_drift(deviations)).sel(direction="positive")
    assert float(table["joint"].mean()) == pytest.approx(SIGMA_UM, abs=0.02)
    assert (table["conventional"] > table["differenced"]).all()
    assert table["ratio"].values == pytest.approx((table["conventional"] / table["differenced"]).values)


def test_links_of_white_noise_are_correlated_by_minus_one_half(rng):
    deviations, _ = simulate(rng, kind="none", cycles=2000)
    covariance = evaluate_neighbours(deviations)["covariance"].values[0]
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    # 2,000 cycles: a correlation is known to 1 / sqrt(2000) = 0.022.
    assert np.diag(correlation, 1) == pytest.approx(-0.5, abs=0.08)
    assert np.diag(correlation, 2) == pytest.approx(0.0, abs=0.09)


def test_chart_uncertainty_knows_that_links_share_positions(rng):
    deviations, _ = simulate(rng, kind="none", cycles=400)
    end = float(build_chart(deviations)["chart_u"][0, -1])
    x = deviations["deviation"].values[:, 0, :]
    assert end == pytest.approx((x[:, 0] - x[:, -1]).std(ddof=1) / np.sqrt(400))
    independent = np.sqrt((evaluate_neighbours(deviations)["mean_difference_u"].values[0] ** 2).sum())
    # 15 links taken as independent: sqrt(15) = 3.9 times too wide.
    assert independent / end == pytest.approx(3.9, rel=0.15)


def test_chart_starts_where_it_is_told(rng):
    deviations, _ = simulate(rng)
    x = deviations["deviation"].values
    late = build_chart(deviations)
    first = build_chart(deviations, reference="first_cycle")
    # Two hours are 7200 / 252 = 28.6 cycles: position 1 is passed early in a forward run, late in a backward one.
    assert late["reference_cycle"].values.tolist() == [30, 29]
    assert float(late["chart"][0, 0]) == x[29, 0, 0]
    assert float(first["chart"][0, 0]) == x[0, 0, 0]
    mean = x.mean(axis=0)
    assert late["chart"].values - late["chart"].values[:, :1] == pytest.approx(mean - mean[:, :1])
    assert late["border_u"].values[:, 0] == pytest.approx(late["border_u"].values[:, 1])
    assert late["border_s"].values == pytest.approx(10 * late["border_u"].values)


def test_a_short_test_takes_its_last_cycle_as_reference(rng):
    deviations, _ = simulate(rng, cycles=10)
    assert build_chart(deviations)["reference_cycle"].values.tolist() == [10, 10]


def test_without_its_reference_there_is_no_chart(rng):
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(ValueError, match="reference='middle' is neither"):
        build_chart(deviations, reference="middle")
    deviations["deviation"].values[:, 1, 0] = np.nan
    chart = build_chart(deviations)
    assert chart["reference_cycle"].values.tolist() == [5, 0]
    assert np.isnan(chart["chart"].sel(direction="negative")).all()


def test_one_target_has_no_neighbour(rng):
    deviations, _ = simulate(rng, cycles=5)
    with pytest.raises(ValueError, match="1 target has no neighbour"):
        evaluate_neighbours(deviations.isel(target=[0]))


def test_neighbours_are_neighbours_along_the_axis(rng):
    deviations, _ = simulate(rng, cycles=5)
    shuffled = deviations.isel(target=rng.permutation(16))
    assert evaluate_neighbours(shuffled).equals(evaluate_neighbours(deviations))
