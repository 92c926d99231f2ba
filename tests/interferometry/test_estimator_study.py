"""The joint estimate and the anomaly tests against simulated truth: figures to reach, in um.

THERMOFUSE_RUNS sets the number of campaigns per case; bars hold for 400, and widen by the standard error below that.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
import xarray as xr

from interferometry.anomalies import detect_anomalies
from interferometry.drift import estimate_drift
from tests.interferometry.simulated_campaigns import SIGMA_UM, TARGETS, Truth, simulate

pytestmark = pytest.mark.slow
RUNS = int(os.environ.get("THERMOFUSE_RUNS", "400"))
CYCLES = 100


def remove(deviations: xr.Dataset, where: np.ndarray) -> xr.Dataset:
    kept = deviations.copy()
    kept["deviation"] = deviations["deviation"].where(~where)
    kept["time"] = deviations["time"].where(~where)
    return kept


def damage(rng: np.random.Generator, deviations: xr.Dataset, case: str) -> xr.Dataset:
    shape = deviations["deviation"].shape
    lost = np.zeros(shape, dtype=bool)
    if case == "10 % missing":
        lost = rng.random(shape) < 0.1
    elif case == "missing block":
        lost[40:70, :, 8:14] = True
    elif case == "backward passes only late":
        lost[: CYCLES // 2, 1, :] = True
    elif case == "two gross outliers":
        hit = deviations.copy()
        for target in rng.choice(TARGETS, 2, replace=False):
            size = rng.choice([-1, 1]) * rng.uniform(5, 50)
            hit["deviation"][rng.integers(CYCLES), rng.integers(2), target] += size
        return hit
    elif case == "2 % outliers":
        hit = deviations.copy()
        wild = rng.random(shape) < 0.02
        hit["deviation"] = deviations["deviation"] + wild * rng.choice([-1, 1], shape) * rng.uniform(2, 8, shape)
        return hit
    return remove(deviations, lost)


def map_error(estimated: xr.Dataset, truth: Truth, present: np.ndarray) -> np.ndarray:
    """Error of the profile against the first target, both directions together (target,)."""
    profile = truth.mean_profile(present)
    relative = (profile - profile[:, :1]).mean(axis=0)
    return estimated["profile_relative"].values.mean(axis=0) - relative


@pytest.mark.parametrize(
    ("case", "bar"),
    [
        ("complete", 0.041),
        ("10 % missing", 0.045),
        ("missing block", 0.046),
        ("backward passes only late", 0.055),
        ("two gross outliers", 0.045),
        ("2 % outliers", 0.046),
    ],
)
def test_profile_rmse(case: str, bar: float) -> None:
    errors, inside, drift_inside = [], [], []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        complete, truth = simulate(rng, kind=("warmup", "duty", "rw")[seed % 3])
        deviations = damage(rng, complete, case)
        estimated = estimate_drift(deviations)
        present = np.isfinite(deviations["deviation"].values)
        errors.append(map_error(estimated, truth, present))
        profile = truth.mean_profile(present)
        relative = profile - profile[:, :1]
        z = (estimated["profile_relative"].values - relative)[:, 1:] / estimated["profile_relative_u"].values[:, 1:]
        inside.append(np.abs(z) < 1.96)
        drift = truth.profile + truth.drift - profile
        z = (estimated["drift"].values - drift)[present] / estimated["drift_u"].values[present]
        drift_inside.append(np.mean(np.abs(z) < 1.96))
    by_run = np.array([np.mean(one[1:] ** 2) for one in errors])
    rmse = float(np.sqrt(np.mean(np.array(errors) ** 2)))
    error = float(by_run.std() / np.sqrt(RUNS) / (2 * rmse))
    coverage, drift_coverage = float(np.mean(inside)), float(np.mean(drift_inside))
    print(
        f"\n{case}: N={RUNS} rmse {rmse:.4f} +- {error:.4f} (bar {bar}), coverage {coverage:.3f}, {drift_coverage:.3f}"
    )
    assert rmse <= bar + 2 * error
    assert 0.92 <= coverage <= 0.98
    assert 0.92 <= drift_coverage <= 0.98


@pytest.mark.parametrize("kind", ["warmup", "duty", "rw"])
def test_scatter_rmse(kind: str) -> None:
    scatter = []
    for seed in range(RUNS):
        deviations, _ = simulate(np.random.default_rng(5000 + seed), kind=kind)
        scatter.append(estimate_drift(deviations)["scatter_position"].values)
    found = np.array(scatter) - SIGMA_UM
    rmse, bias = float(np.sqrt(np.mean(found**2))), float(found.mean())
    print(f"\nscatter {kind}: N={RUNS} rmse {rmse:.4f} bias {bias:+.4f}")
    assert rmse <= 0.022
    assert abs(bias) <= 0.015 * SIGMA_UM


def noise(
    rng: np.random.Generator, *, extra: float = 0.0, tails: float | None = None, spread: float = 0.0
) -> np.ndarray:
    shape = (CYCLES, 2, TARGETS)
    unit = rng.standard_normal(shape)
    if tails is not None:
        unit = rng.standard_t(tails, shape) / np.sqrt(tails / (tails - 2))
    made = SIGMA_UM * unit * np.exp(spread * rng.standard_normal(TARGETS))
    made[:, :, 2] += extra * rng.standard_normal((CYCLES, 2))
    return made


def rates(first_seed: int, **options: float) -> dict[str, float]:
    """Share of campaigns with any anomaly, with one at target 3, elsewhere, and with one that stands out."""
    count = dict.fromkeys(("any", "target 3", "elsewhere", "stands out", "target 3 stands out"), 0)
    for seed in range(RUNS):
        rng = np.random.default_rng(first_seed + seed)
        deviations, _ = simulate(rng, kind=("warmup", "duty", "rw")[seed % 3], noise=noise(rng, **options))
        found = detect_anomalies(estimate_drift(deviations), deviations, permutations=399)
        count["any"] += bool(found)
        count["target 3"] += any(one.target == 3 for one in found)
        count["elsewhere"] += any(one.target != 3 for one in found)
        count["stands out"] += any(one.stands_out for one in found)
        count["target 3 stands out"] += any(one.stands_out and one.target == 3 for one in found)
    shares = {name: value / RUNS for name, value in count.items()}
    print(f"\n{options}: N={RUNS} {shares}")
    return shares


def binomial_error(share: float) -> float:
    return 2 * float(np.sqrt(max(share * (1 - share), 0.25 / RUNS) / RUNS))


def test_false_alarms_under_normal_noise() -> None:
    share = rates(10_000)["any"]
    assert share <= 0.07 + binomial_error(0.05)


def test_false_alarms_under_heavy_tails() -> None:
    share = rates(20_000, tails=4.0)["any"]
    assert share <= 0.07 + binomial_error(0.05)


def test_power_at_extra_scatter_of_0_3_um() -> None:
    shares = rates(30_000, extra=0.3)
    assert shares["target 3"] >= 0.90 - binomial_error(0.9)
    assert shares["elsewhere"] <= 0.10
    assert shares["target 3 stands out"] >= 0.60


@pytest.mark.parametrize("spread", [0.1, 0.2])
def test_natural_spread_is_not_called_an_outlier(spread: float) -> None:
    assert rates(40_000, spread=spread)["stands out"] <= 0.05 + binomial_error(0.05)


def test_power_under_heavy_tails_and_natural_spread() -> None:
    assert rates(50_000, extra=0.5, tails=4.0)["target 3 stands out"] >= 0.80 - binomial_error(0.8)
    assert rates(60_000, extra=0.5, spread=0.1)["target 3 stands out"] >= 0.70 - binomial_error(0.7)
