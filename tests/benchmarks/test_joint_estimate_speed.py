"""Speed of the joint estimate, as ratios against peers that solve the same model, measured in the same run.

Reproduces figures of docs/measured.csv, on the joint estimate.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg
from statsmodels.tsa.statespace.initialization import Initialization
from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

from interferometry.anomalies import detect_anomalies
from interferometry.deviations import sort_readings
from interferometry.drift.estimate import estimate_drift, fit_joint
from interferometry.drift.gls import fit_fixed_effects
from tests.interferometry.simulated_campaigns import simulate

pytestmark = pytest.mark.slow


def cpu_seconds(work: object, repeat: int = 3) -> float:
    """Smallest processor time of a few calls in s."""
    best = np.inf
    for _ in range(repeat):
        start = time.process_time()
        work()  # type: ignore[operator]
        best = min(best, time.process_time() - start)
    return best


def test_one_likelihood_against_dense_cholesky(rng: np.random.Generator) -> None:
    deviations, _ = simulate(rng, cycles=60, kind="rw")
    joint = fit_joint(deviations, order=1, robust=False, components=["shift", "stretch"])
    system, fit = joint.fit.system, joint.fit
    t = system.seconds - system.seconds[0]
    walk = np.minimum.outer(t, t)

    def dense() -> float:
        total = np.diag(system.variance)
        for c, ratio in enumerate(system.ratios):
            total = total + ratio * walk * np.outer(system.loadings[:, c], system.loadings[:, c])
        factor = linalg.cholesky(total, lower=True)
        whitened = linalg.solve_triangular(factor, np.column_stack([fit.response, fit.design]), lower=True)
        _, rss, *_ = np.linalg.lstsq(whitened[:, 1:], whitened[:, 0], rcond=None)
        return float(rss[0])

    recursive = cpu_seconds(lambda: fit_fixed_effects(system, fit.response, fit.design))
    ratio = cpu_seconds(dense, 1) / recursive
    print(f"\n{t.size} readings: dense scipy Cholesky / recursive filter = {ratio:.0f}")
    assert dense() == pytest.approx(fit.rss, rel=1e-6)


def test_one_likelihood_against_statsmodels(rng: np.random.Generator) -> None:
    """Its exact diffuse likelihood with the fixed effects in the state is the restricted likelihood, but for a constant."""
    deviations, _ = simulate(rng, cycles=30, kind="rw")
    fit = fit_joint(deviations, order=1, robust=False, components=["shift", "stretch"]).fit
    system, (n, p), drifts = fit.system, fit.design.shape, fit.system.ratios.size
    sigma2, steps = fit.sigma**2, np.append(np.diff(system.seconds), 0.0)
    model = KalmanFilter(k_endog=1, k_states=drifts + p, k_posdef=drifts, filter_univariate=True)
    model.bind(fit.response[:, None].copy())
    model["design"] = np.vstack([system.loadings.T, fit.design.T])[None]
    model["transition"], model["selection"] = np.eye(drifts + p), np.eye(drifts + p, drifts)
    model["obs_cov"] = (sigma2 * system.variance)[None, None]
    start = Initialization(drifts + p)
    start.set((0, drifts), "known", constant=np.zeros(drifts), stationary_cov=np.zeros((drifts, drifts)))
    start.set((drifts, drifts + p), "diffuse")
    model.initialization = start

    def peer(ratios: np.ndarray) -> float:
        model["state_cov"] = sigma2 * ratios[:, None, None] * np.eye(drifts)[:, :, None] * steps
        return float(model.loglike())

    def ours(ratios: np.ndarray) -> float:
        fitted = fit_fixed_effects(replace(system, ratios=ratios), fit.response, fit.design)
        # At the same variance of the noise, which the fit has put at its likeliest.
        return fitted.log_likelihood + 0.5 * (n - p) * np.log(fitted.sigma**2 / sigma2) - 0.5 * fitted.rss / sigma2

    others = system.ratios * np.array([3.0, 0.4])
    assert peer(system.ratios) - peer(others) == pytest.approx(ours(system.ratios) - ours(others), rel=1e-8)
    ratio = cpu_seconds(lambda: peer(others), 9) / cpu_seconds(lambda: ours(others), 9)
    print(f"\n{n} readings, {p} fixed effects: statsmodels KalmanFilter.loglike / ours = {ratio:.1f}")


def test_cost_grows_with_the_number_of_readings(rng: np.random.Generator) -> None:
    seconds, one_fit = {}, {}
    for cycles in (100, 1000):
        deviations, _ = simulate(rng, cycles=cycles, kind="duty")
        estimated = estimate_drift(deviations)
        fit = fit_joint(deviations, order=2, robust=False, components=["shift", "stretch"]).fit
        one_fit[cycles] = cpu_seconds(lambda f=fit: fit_fixed_effects(f.system, f.response, f.design), 5)  # type: ignore[misc]
        seconds[cycles] = (
            sort_readings(deviations).sizes["reading"],
            cpu_seconds(lambda d=deviations: estimate_drift(d)),  # type: ignore[misc]
            cpu_seconds(lambda e=estimated, d=deviations: detect_anomalies(d, e), 1),  # type: ignore[misc]
        )
    for cycles, (readings, estimate_s, anomalies_s) in seconds.items():
        print(
            f"\n{cycles} cycles, {readings} readings: estimate {estimate_s:.2f} s, anomalies {anomalies_s:.2f} s of processor"
        )
    print(
        f"ten times the readings cost {seconds[1000][1] / seconds[100][1]:.1f} times the time "
        f"({one_fit[1000] / one_fit[100]:.1f} times for one likelihood; the length of the search depends on the data)"
    )
