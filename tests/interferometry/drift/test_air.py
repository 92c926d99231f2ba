"""Correlated noise within a pass: estimated from the passes, and what it adds to the drift's uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.drift.air import AirNoise, drift_covariance, estimate_air_noise
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.state_space import drift_system
from tests.interferometry.simulated_campaigns import SIGMA_UM, schedule, simulate

TARGETS = 16


def correlated(rng: np.random.Generator, seconds: np.ndarray, correlation_time_s: float) -> np.ndarray:
    """Noise of unit variance at times in any shape."""
    order = np.argsort(seconds.ravel())
    noise = rng.standard_normal(seconds.size)
    for k, share in enumerate(np.exp(-np.diff(seconds.ravel()[order]) / correlation_time_s), start=1):
        noise[k] = share * noise[k - 1] + np.sqrt(1 - share**2) * noise[k]
    placed = np.empty(seconds.size)
    placed[order] = noise
    return placed.reshape(seconds.shape)


def estimate(noise: np.ndarray, seconds: np.ndarray) -> AirNoise | None:
    cycles = noise.shape[0]
    order = np.argsort(seconds.ravel())
    place = np.broadcast_to(np.linspace(0, 1, TARGETS), noise.shape).ravel()[order]
    number = np.repeat(np.arange(2 * cycles), TARGETS)[order]
    loadings = np.column_stack([np.ones(place.size), place])
    return estimate_air_noise(
        noise.ravel()[order], seconds.ravel()[order], loadings, number=number, position=300.0 * place
    )


def test_correlated_noise_is_estimated(rng: np.random.Generator) -> None:
    seconds = schedule(100)
    air = estimate(0.4 * correlated(rng, seconds, 20.0), seconds)
    assert air is not None
    # 200 passes of 16 readings with four correlation times each; shift and stretch of every pass are lost.
    assert air.correlation_time_s in (10.0, 20.0, 40.0)
    assert air.variance_um2 == pytest.approx(0.16, rel=0.5)


def test_independent_noise_is_not_called_correlated(rng: np.random.Generator) -> None:
    seconds = schedule(100)
    assert all(estimate(rng.normal(0, 0.4, seconds.shape), seconds) is None for _ in range(10))


def test_too_few_passes_give_none(rng: np.random.Generator) -> None:
    seconds = schedule(5)
    assert estimate(correlated(rng, seconds, 20.0), seconds) is None


def test_what_is_added_is_the_smoothed_noise(rng: np.random.Generator) -> None:
    seconds = schedule(20).ravel()
    seconds = np.sort(seconds)
    loadings = np.ones((seconds.size, 1))
    system = drift_system(seconds, loadings, order=1, ratios=np.array([1e-4]))
    air = estimate_of(0.16, 20.0, 0.0)
    added = drift_covariance(system, air, 0.4)[0, 0]
    levels = system.smooth(np.column_stack([0.4 * correlated(rng, seconds, 20.0) for _ in range(200)])).levels
    plain = system.smooth(0.4 * rng.standard_normal((seconds.size, 200))).levels
    # 32 and 200 realisations of some tens of independent stretches each.
    assert added == pytest.approx((levels**2).mean() - (plain**2).mean(), rel=0.25)
    assert drift_covariance(system, estimate_of(0.0, 20.0, 0.16), 0.4)[0, 0] == pytest.approx(0.0, abs=1e-12)


def estimate_of(variance: float, correlation_time_s: float, independent: float) -> AirNoise:

    return AirNoise(variance, correlation_time_s, independent)


def test_the_drift_keeps_its_coverage_in_turbulent_air(rng: np.random.Generator) -> None:
    noise = SIGMA_UM * correlated(rng, schedule(100), 20.0)
    deviations, truth = simulate(rng, kind="warmup", noise=noise)
    estimated = estimate_drift(deviations)
    profile = truth.mean_profile(np.ones(noise.shape, dtype=bool))
    error = estimated["drift"].values - (truth.profile + truth.drift - profile)
    # Nominal 0.95; neighbouring readings share their error, so that one test has some hundred independent ones.
    assert 0.88 <= float(np.mean(np.abs(error) < 1.96 * estimated["drift_u"].values)) <= 1.0
