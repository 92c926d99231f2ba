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
        ratios, coefficients = [], []
        for operator in lag_operators(SECONDS, LAGS_S):
            x = project @ operator @ film.values
            ratios.append(-58 * np.log1p(-((y @ x) ** 2) / ((x**2).sum(axis=0) * (y @ y))))
            coefficients.append((y @ x) / (x**2).sum(axis=0))
        best = np.argmax(ratios, axis=0)
        np.testing.assert_allclose(screening.statistic[k], np.max(ratios, axis=0), rtol=1e-3, atol=1e-3)
        agree = best == screening.lag_index[k]
        # Lags whose ratios agree within single precision may swap.
        assert agree.mean() > 0.99
        picked = np.array(coefficients)[best, np.arange(best.size)]
        np.testing.assert_allclose(screening.sensitivity[k][agree], picked[agree], rtol=1e-3, atol=1e-5)


def test_maxima_belong_to_whole_permutations(problem):
    values, film = problem
    screening = screen(series_of(values), film, VARIED, permutations=50, rng=np.random.default_rng(0))
    assert screening.maxima.shape == (50, 5)
    assert (screening.maxima > 0).all()
    order = np.argsort(-screening.statistic.ravel())
    assert (np.diff(screening.p_value.ravel()[order]) >= 0).all()


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
