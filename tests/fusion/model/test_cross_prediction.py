"""Blocks of cycles predicted from the others: the same by dense algebra, and what it says of a step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.effects.effect import Prior
from fusion.model.cross_prediction import cross_errors
from fusion.model.fit import ModelFit
from tests.fusion.small_campaign import campaign, model_of, term

BARE = campaign(cycles=20)
RATIOS = np.array([2e-4, 1e-4])


def fitted(response: np.ndarray, *columns: np.ndarray, prior: Prior | None = None) -> ModelFit:
    noise = 0.1 * np.random.default_rng(5).standard_normal(BARE.seconds.size)
    terms = [term(column, f"effect {k}") for k, column in enumerate(columns)]
    if prior is not None:
        terms[0] = replace(terms[0], candidate=replace(terms[0].candidate, prior=prior))
    return model_of(replace(BARE, response=response + noise), terms, ratios=RATIOS)


def cross_rmse(model: ModelFit, event_s: float | None = None) -> float:
    return float(np.sqrt(np.nanmean(cross_errors(model, event_s) ** 2)))


def dense_errors(model: ModelFit, block: np.ndarray) -> np.ndarray:
    """Best linear unbiased prediction from the covariance of drift and noise, with priors as further observations."""
    readings, fit = model.readings, model.fit
    since = readings.seconds - readings.seconds[0]
    walk = np.minimum(since[:, None], since[None, :])
    drift = sum(
        ratio * walk * np.outer(one, one) for ratio, one in zip(fit.system.ratios, readings.loadings.T, strict=True)
    )
    noise = np.diag(fit.system.variance)
    x, y, known = fit.design, fit.response, ~block
    whitening = np.linalg.inv(np.linalg.cholesky((drift + noise)[np.ix_(known, known)]))
    a, b = whitening @ x[known], whitening @ y[known]
    for place, prior in model.priors():
        a = np.vstack([a, np.eye(x.shape[1])[place] * fit.sigma / prior.u])
        b = np.append(b, fit.sigma * prior.mean / prior.u)
    beta = np.linalg.lstsq(a, b, rcond=None)[0]
    gain = drift[np.ix_(block, known)] @ np.linalg.inv((drift + noise)[np.ix_(known, known)])
    return y[block] - x[block] @ beta - gain @ (y[known] - x[known] @ beta)


@pytest.mark.parametrize("prior", [None, Prior(0.5, 0.05)])
def test_blocks_are_predicted_by_the_best_linear_prediction(prior):
    wave = np.sin(BARE.seconds / 500.0)
    model = fitted(wave, wave, prior=prior)
    block = (BARE.cycle - 1) // 4
    errors = cross_errors(model)
    assert np.isnan(errors[block == 0]).all()
    for number in range(1, 5):
        np.testing.assert_allclose(errors[block == number], dense_errors(model, block == number), rtol=1e-4, atol=1e-6)


def test_of_an_event_only_the_block_around_it_counts():
    at = float(BARE.seconds[BARE.cycle == 11].min())
    step = (BARE.seconds >= at).astype(float)
    model = fitted(2.0 * step, step)
    block = (BARE.cycle >= 9) & (BARE.cycle < 13)
    errors = cross_errors(model, at)
    assert np.isnan(errors[~block]).all()
    np.testing.assert_allclose(errors[block], dense_errors(model, block), rtol=1e-4, atol=1e-6)


def test_the_first_block_is_not_asked_for_what_it_alone_knows():
    """What the machine still remembers of the time before the log dies away within the first cycles."""
    start = np.exp(-BARE.seconds / 60.0)
    model = fitted(5.0 * start, start)
    assert cross_rmse(model) < 0.2


@pytest.mark.parametrize("cycle", [3, 11, 19])
def test_a_step_is_not_interpolated(cycle):
    """Between the readings before and after it a drift makes a ramp: the error without the step exceeds that with it by far."""
    at = float(BARE.seconds[BARE.cycle == cycle].min())
    step = (BARE.seconds >= at).astype(float)
    with_it, without = fitted(2.0 * step, step), fitted(2.0 * step)
    assert cross_rmse(with_it, at) < 0.2 < 0.5 < cross_rmse(without, at)


def test_a_site_that_only_one_block_holds_is_left_out():
    odd = (BARE.site == 3) & (BARE.cycle > 4)
    readings = replace(BARE.subset(~odd), response=np.zeros((~odd).sum()))
    noise = 0.1 * np.random.default_rng(5).standard_normal(readings.seconds.size)
    model = model_of(replace(readings, response=noise), [], ratios=RATIOS)
    assert 0.09 < cross_rmse(model) < 0.2
