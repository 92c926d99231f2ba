"""The fast screen against the plain algebra it stands for, and its level."""

import numpy as np
import pytest

from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution.drift_channels import TargetSeries
from fusion.attribution.family_wise import LAGS_S, FieldSeries
from fusion.attribution.likelihood_ratio import null_bank
from fusion.attribution.per_target import screen
from fusion.attribution.warm_up import Excitation

VARIED = Excitation(0.5, False, 3)
SECONDS = np.arange(60) * 252.0


def series_of(values):
    """Series (series, 60) of one direction, at the instants of the frames."""
    directions = ("positive",) * len(values)
    return TargetSeries(directions, np.arange(1, len(values) + 1), values, SECONDS, np.eye(60))


@pytest.fixture
def problem(rng):
    values = np.cumsum(rng.standard_normal((5, 60)), axis=1) + 0.5 * rng.standard_normal((5, 60))
    film = np.cumsum(rng.standard_normal((60, 700)), axis=0)
    return values, FieldSeries(SECONDS, film - film.mean(axis=0))


def test_the_screen_is_whitened_least_squares_per_series_cell_and_lag(problem):
    values, film = problem
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


def test_maxima_belong_to_whole_permutations(problem):
    values, film = problem
    screening = screen(series_of(values), film, VARIED, permutations=50, rng=np.random.default_rng(0))
    assert screening.maxima.shape == (50, 5)
    assert (screening.maxima > 0).all()
    # Family-wise over targets, cells and lags: rank of a statistic among the largest values of the permutations.
    reached = (screening.maxima.max(axis=1) >= screening.statistic[..., None]).sum(axis=-1)
    np.testing.assert_allclose(screening.p_value, (1 + reached) / 51, rtol=1e-6)


def test_a_permuted_series_is_coloured_and_fitted_as_the_measured_one(problem):
    values, film = problem
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


def test_a_dead_cell_explains_nothing_and_a_copy_of_the_drift_all_but_rounding(problem):
    values, film = problem
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


def test_the_screen_keeps_its_level_on_independent_walks():
    flagged = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 3])
        film = np.cumsum(rng.standard_normal((60, 40)), axis=0)
        values = np.cumsum(rng.standard_normal((4, 60)), axis=1) + 0.3 * rng.standard_normal((4, 60))
        screening = screen(
            series_of(values),
            FieldSeries(SECONDS, film - film.mean(axis=0)),
            VARIED,
            permutations=99,
            rng=rng,
        )
        flagged += bool((screening.p_value <= 0.05).any())
    # 7 or more of 40 at a rate of 0.05 has probability 0.003.
    assert flagged <= 6


def test_an_effect_is_found_by_the_screen(rng):
    film = np.cumsum(rng.standard_normal((60, 50)), axis=0)
    values = 0.2 * np.cumsum(rng.standard_normal((3, 60)), axis=1) + 0.3 * rng.standard_normal((3, 60))
    values[1] += 0.8 * film[:, 17]
    seen: list[float] = []
    screening = screen(
        series_of(values),
        FieldSeries(SECONDS, film - film.mean(axis=0)),
        VARIED,
        permutations=99,
        rng=rng,
        progress=seen.append,
    )
    assert np.unravel_index(int(screening.p_value.argmin()), screening.p_value.shape)[0] == 1
    assert int(screening.statistic[1].argmax()) == 17
    assert float(screening.sensitivity[1, 17]) == pytest.approx(0.8, abs=4 * float(screening.sensitivity_u[1, 17]))
    assert seen[-1] == 1.0


def test_a_missing_value_has_no_weight(problem):
    values, film = problem
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
