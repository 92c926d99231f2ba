"""Grids of drift variances: the least of them by its definition, the factors, and draws in proportion to the likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.model.drift_variances import SHIFT_AND_STRETCH, SINGLE, least_ratio, plausible_ratios, scaled_systems
from interferometry.drift.gls import DriftFit, drift_system, fit_fixed_effects

SECONDS = np.linspace(0.0, 7200.0, 40)
LEVEL = np.ones((40, 1))


def fit_of(ratio: float, response: np.ndarray, *, order: int = 1) -> DriftFit:
    system = drift_system(SECONDS, LEVEL, order=order, ratios=np.array([ratio]))
    return fit_fixed_effects(system, response, LEVEL)


def test_the_least_drift_moves_by_a_quarter_of_the_noise_until_the_end():
    walk = drift_system(SECONDS + 500.0, LEVEL, order=1, ratios=np.ones(1))
    # Variance of a random walk after T: ratio * T; of an integrated one: ratio * T**3 / 3.
    assert np.sqrt(least_ratio(walk) * 7200.0) == pytest.approx(0.25)
    integrated = drift_system(SECONDS + 500.0, LEVEL, order=2, ratios=np.ones(1))
    assert np.sqrt(least_ratio(integrated) * 7200.0**3 / 3.0) == pytest.approx(0.25)


def test_variances_are_scaled_from_the_estimate_or_from_the_least_drift(rng):
    fit = fit_of(1e-3, rng.standard_normal(40))
    told = [float(system.ratios[0]) for system in scaled_systems(fit, SINGLE)]
    np.testing.assert_allclose(told, [1e-9, 10**-5.5, 1e-4, 1e-3, 10**-2.5, 1e-2], rtol=1e-12)
    none = fit_of(0.0, rng.standard_normal(40))
    (least,) = scaled_systems(none, ((1.0,),))
    assert least.ratios[0] == pytest.approx(10.0 * 0.0625 / 7200.0)


def test_every_component_has_its_own_factor_and_a_short_set_is_repeated(rng):
    loadings = np.column_stack([np.ones(40), np.tile([0.5, 1.0], 20)])
    system = drift_system(SECONDS, loadings, order=1, ratios=np.array([1e-2, 1e-3]))
    fit = fit_fixed_effects(system, rng.standard_normal(40), loadings)
    first, second = scaled_systems(fit, ((0.0, -1.0), (1.0,)))
    np.testing.assert_allclose(first.ratios, [1e-2, 1e-4])
    np.testing.assert_allclose(second.ratios, [1e-1, 1e-2])


def test_a_drift_can_be_laid_on_other_readings(rng):
    fit = fit_of(1e-3, rng.standard_normal(40))
    longer = drift_system(np.arange(5.0), np.ones((5, 1)), order=1, ratios=np.array([77.0]))
    (system,) = scaled_systems(fit, ((0.0,),), over=longer)
    assert system.seconds.size == 5
    assert system.ratios[0] == pytest.approx(1e-3)


def test_variances_are_drawn_in_proportion_to_their_restricted_likelihood(rng):
    walk = np.cumsum(rng.standard_normal(40)) * np.sqrt(7200.0 / 39.0 * 2e-3)
    response = walk + rng.standard_normal(40)
    fit = fit_of(2e-3, response)
    tried = 2e-3 * 10.0 ** np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0])
    likelihood = np.array([fit_of(ratio, response).log_likelihood for ratio in tried])
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    draws = plausible_ratios(fit, rng, draws=4000)
    assert draws.shape == (4000, 1)
    share = [float(np.isclose(draws[:, 0], ratio, rtol=1e-9).mean()) for ratio in tried]
    assert sum(share) == pytest.approx(1.0)
    # Four standard deviations of a share of 4,000 draws.
    np.testing.assert_allclose(share, weight, atol=4.0 * np.sqrt(0.25 / 4000))
    assert weight.max() > 10.0 * weight.min()


def test_a_drift_estimated_as_zero_is_still_drawn(rng):
    draws = plausible_ratios(fit_of(0.0, rng.standard_normal(40)), rng, draws=50)
    assert (draws > 0.0).all()


def test_the_grids_hold_the_estimate_less_more_and_hardly_any_drift():
    """The measured error rates hold for these grids."""
    assert sorted(SHIFT_AND_STRETCH) == sorted(
        [
            (0.0, 0.0),
            *((-1.0, 0.0), (0.0, -1.0), (-1.0, -1.0)),
            *((-2.5, 0.0), (0.0, -2.5), (-2.5, -2.5)),
            (-6.0, -6.0),
            (0.5, 0.5),
            *((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)),
        ]
    )
    # Among equal likelihoods the first counts.
    assert SHIFT_AND_STRETCH[0] == (0.0, 0.0)
