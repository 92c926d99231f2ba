"""Gains in profile log-likelihood, against dense algebra: one covariance matrix for every system, one fit for every candidate."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.model.least_squares import PriorRows
from fusion.model.products import by_width
from fusion.model.profile_gain import profile_gains
from interferometry.drift.gls import DriftSystem, drift_system

N = 24
SECONDS = np.cumsum(np.r_[0.0, np.tile([10.0, 25.0, 40.0], 8)])[:N]
LOADINGS = np.column_stack([np.ones(N), np.tile([0.25, 0.5, 0.75, 1.0], 6)])
ALL = np.ones(N, bool)


def systems() -> list[DriftSystem]:
    """A drift that is hardly there, a common one, and a stretch."""
    ratios = ([1e-9, 1e-9], [2e-2, 1e-9], [1e-9, 5e-1])
    return [drift_system(SECONDS, LOADINGS, order=1, ratios=np.array(pair)) for pair in ratios]


def dense_covariance(system: DriftSystem) -> np.ndarray:
    """Covariance of the readings over sigma squared: noise, and random walks that start at zero."""
    walk = np.minimum.outer(system.seconds, system.seconds)
    parts = zip(system.ratios, system.loadings.T, strict=True)
    return np.eye(N) + sum(ratio * np.outer(loading, loading) * walk for ratio, loading in parts)


def dense_likelihood(system: DriftSystem, y: np.ndarray, x: np.ndarray, rows: tuple = ()) -> float:
    """Profile log-likelihood up to a constant; ``rows`` are priors (row of the design, response) in units of the noise."""
    root = np.linalg.cholesky(dense_covariance(system))
    y, x = np.linalg.solve(root, y), np.linalg.solve(root, x)
    for row, value in rows:
        x, y = np.vstack([x, row]), np.r_[y, value]
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(-0.5 * N * np.log(left @ left) - np.log(np.diag(root)).sum())


def drifting(rng: np.random.Generator, system: DriftSystem, count: int) -> np.ndarray:
    return np.linalg.cholesky(dense_covariance(system)) @ rng.standard_normal((N, count))


def test_every_gain_is_that_of_the_drift_that_suits_the_candidate_best(rng):
    tried = systems()
    design = np.column_stack([LOADINGS, rng.standard_normal(N)])
    columns = [rng.standard_normal((N, width)) for width in (1, 2, 1)]
    candidates = [Candidate(column, {}, ("um",) * column.shape[1]) for column in columns]
    responses = np.column_stack([drifting(rng, system, 2) for system in tried])
    # With its candidate each first response is best explained by another drift than without it.
    responses[:, 0] += 3.0 * columns[2][:, 0]
    gains = profile_gains(tried, responses, design, by_width(candidates, ALL))
    likelihoods = np.empty((3, len(candidates), responses.shape[1]))
    without = np.empty((3, responses.shape[1]))
    for s, system in enumerate(tried):
        for r, y in enumerate(responses.T):
            without[s, r] = dense_likelihood(system, y, design)
            for k, column in enumerate(columns):
                likelihoods[s, k, r] = dense_likelihood(system, y, np.column_stack([design, column]))
    np.testing.assert_allclose(gains.gain, likelihoods.max(axis=0) - without.max(axis=0), rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(gains.drift_place, likelihoods[:, :, 0].argmax(axis=0))
    # More than one drift is chosen, or the test would not see which.
    assert len(set(likelihoods.argmax(axis=0).ravel().tolist())) > 1
    assert gains.separable.all()


def test_what_may_be_present_without_the_effect_is_no_evidence_for_it(rng):
    tried = systems()
    candidate = Candidate(rng.standard_normal((N, 2)), {}, ("um", "um"), beside=1)
    memory = candidate.columns[:, 1:]
    weak, strong = drifting(rng, tried[0], 1)[:, 0], drifting(rng, tried[0], 1)[:, 0] + 4.0 * memory[:, 0]
    gains = profile_gains(tried, np.column_stack([weak, strong]), LOADINGS, by_width([candidate], ALL))
    for r, y in enumerate((weak, strong)):
        with_all, started, bare = (
            max(dense_likelihood(system, y, np.column_stack([LOADINGS, columns])) for system in tried)
            for columns in (candidate.columns, memory, memory[:, :0])
        )
        # One unit of log-likelihood is the price of the memory; a model without it is held against where that is better.
        assert (started - 1.0 > bare) is (r == 1)
        assert gains.gain[0, r] == pytest.approx(with_all - max(bare, started - 1.0), rel=1e-6)


def test_a_prior_holds_its_coefficient(rng):
    tried = systems()
    design = np.column_stack([LOADINGS, np.linspace(0.0, 1.0, N)])
    candidate = Candidate(np.linspace(0.0, 1.0, N)[:, None] ** 2, {}, ("um",))
    response = drifting(rng, tried[0], 1) + 2.0 * design[:, 2:]
    row = np.array([0.0, 0.0, 5.0])
    priors = PriorRows(row[None, :], np.array([1.5]), np.empty((1, 0)))
    gains = profile_gains(tried, response, design, by_width([candidate], ALL), priors=priors)
    with_it = max(
        dense_likelihood(s, response[:, 0], np.column_stack([design, candidate.columns]), ((np.r_[row, 0.0], 1.5),))
        for s in tried
    )
    without = max(dense_likelihood(s, response[:, 0], design, ((row, 1.5),)) for s in tried)
    assert gains.gain[0, 0] == pytest.approx(with_it - without, rel=1e-6)
    free = profile_gains(tried, response, design, by_width([candidate], ALL))
    assert free.gain[0, 0] != pytest.approx(gains.gain[0, 0], rel=1e-3)


def test_a_column_of_the_model_gains_nothing(rng):
    tried = systems()
    candidates = [Candidate(3.0 * LOADINGS[:, 1:], {}, ("um",)), Candidate(rng.standard_normal((N, 1)), {}, ("um",))]
    gains = profile_gains(tried, rng.standard_normal((N, 1)), LOADINGS, by_width(candidates, ALL))
    assert gains.separable.tolist() == [False, True]
    assert gains.gain[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_a_response_that_is_the_candidate_itself_has_a_finite_gain(rng):
    candidate = Candidate(rng.standard_normal((N, 1)), {}, ("um",))
    gains = profile_gains(systems()[:1], candidate.columns, LOADINGS, by_width([candidate], ALL))
    # A share of 1e-12 of the squares is left: half of 24 readings times log(1e12).
    assert gains.gain[0, 0] == pytest.approx(12.0 * np.log(1e12), rel=1e-6)
