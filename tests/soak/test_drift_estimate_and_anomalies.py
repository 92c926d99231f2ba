"""The joint estimate and the anomaly tests against simulated truth, in um: docs/method/drift-estimation.md and docs/method/anomalies.md.

Reproduces the tables of error rates of both pages (400 campaigns per case; THERMOFUSE_RUNS sets another number). A bar is missed where the
whole interval of the figure lies beyond it.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.levels import POSITION_LEVEL
from interferometry.anomalies import detect_anomalies
from interferometry.drift.estimate import estimate_drift
from tests.interferometry.simulated_campaigns import SIGMA_UM, TARGETS, Truth, simulate
from tests.soak.rates import campaigns, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(400)
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


#: Chart of the axis: mean of both directions, against the line through its end points (target, direction * target).
PLACE = np.linspace(0, 1, TARGETS)
CHART = np.eye(TARGETS)
CHART[:, 0] -= 1 - PLACE
CHART[:, -1] -= PLACE
CHART = np.hstack([CHART, CHART])[1:-1] / 2


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
    errors, inside, drift_inside, chart_inside, half_width = [], [], [], [], []
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
        inside.append(np.mean(np.abs(z) < 1.96))
        drift = truth.profile + truth.drift - profile
        z = (estimated["drift"].values - drift)[present] / estimated["drift_u"].values[present]
        drift_inside.append(np.mean(np.abs(z) < 1.96))
        covariance = estimated["covariance"].values.reshape(2 * TARGETS, -1)
        chart_u = np.sqrt(np.einsum("ij,jk,ik->i", CHART, covariance, CHART))
        chart_error = CHART @ (estimated["profile"].values - profile).ravel()
        chart_inside.append(np.mean(np.abs(chart_error) < 1.96 * chart_u))
        half_width.append(1.96 * chart_u.mean())
    by_run = np.array([np.mean(one[1:] ** 2) for one in errors])
    rmse = float(np.sqrt(np.mean(np.array(errors) ** 2)))
    error = float(by_run.std() / np.sqrt(RUNS) / (2 * rmse))
    print(
        f"\n{case}: N={RUNS} rmse {rmse:.4f} +- {error:.4f} (bar {bar}); coverage of the profile {with_error(inside)}, "
        f"drift {with_error(drift_inside)}, chart {with_error(chart_inside)} with half-width {np.mean(half_width):.4f}"
    )
    assert rmse <= bar + 2 * error
    assert reaches(inside, 0.92, 0.98)
    assert reaches(drift_inside, 0.92, 0.98)
    if case == "complete":
        assert reaches(chart_inside, 0.93, 0.97)
        assert np.mean(half_width) <= 0.078


@pytest.mark.parametrize("kind", ["warmup", "duty", "rw"])
@pytest.mark.parametrize("state", ["start", "end"])
def test_coverage_at_either_end_of_the_test(kind: str, state: str) -> None:
    inside, relative_inside = [], []
    for seed in range(RUNS):
        deviations, truth = simulate(np.random.default_rng(80_000 + seed), kind=kind)
        estimated = estimate_drift(deviations, state=state)
        at = (0, 0, 0) if state == "start" else (-1, 1, 0)
        profile = truth.profile + truth.shift[at] + truth.stretch[at] * truth.position
        error = np.abs(estimated["profile"].values - profile)
        inside.append(np.mean(error < 1.96 * estimated["profile_u"].values))
        relative = estimated["profile_relative"].values - (profile - profile[:, :1])
        relative_inside.append(np.mean((np.abs(relative) < 1.96 * estimated["profile_relative_u"].values)[:, 1:]))
    print(f"\n{state} of {kind}: N={RUNS} profile {with_error(inside)}, relative {with_error(relative_inside)}")
    assert reaches(inside, 0.92, 0.98)
    assert reaches(relative_inside, 0.92, 0.98)


def with_error(by_run: list[float]) -> str:
    """Mean over campaigns with its standard error: the values of one campaign are not independent."""
    return f"{np.mean(by_run):.3f} +- {np.std(by_run) / np.sqrt(len(by_run)):.3f}"


def reaches(by_run: list[float], low: float, high: float) -> bool:
    error = 2 * np.std(by_run) / np.sqrt(len(by_run))
    return bool(low - error <= np.mean(by_run) <= high + error)


def noise(
    rng: np.random.Generator,
    *,
    extra: float = 0.0,
    tails: float | None = None,
    spread: float = 0.0,
    approaches: int = 2,
) -> np.ndarray:
    shape = (CYCLES, 2, TARGETS)
    unit = rng.standard_normal(shape)
    if tails is not None:
        unit = rng.standard_t(tails, shape) / np.sqrt(tails / (tails - 2))
    made = SIGMA_UM * unit * np.exp(spread * rng.standard_normal(TARGETS))
    made[:, :approaches, 2] += extra * rng.standard_normal((CYCLES, approaches))
    return made


def rates(first_seed: int, **options: float) -> dict[str, tuple[float, float]]:
    """Wilson intervals of the shares of campaigns with any anomaly, with one at target 3, elsewhere, and that stands out."""
    count = dict.fromkeys(("any", "target 3", "elsewhere", "stands out", "target 3 stands out"), 0)
    for seed in range(RUNS):
        rng = np.random.default_rng(first_seed + seed)
        deviations, _ = simulate(rng, kind=("warmup", "duty", "rw")[seed % 3], noise=noise(rng, **options))
        # As a run asks.
        found = detect_anomalies(deviations, estimate_drift(deviations), level=POSITION_LEVEL, permutations=999)
        count["any"] += bool(found)
        count["target 3"] += any(one.target == 3 for one in found)
        count["elsewhere"] += any(one.target != 3 for one in found)
        count["stands out"] += any(one.stands_out for one in found)
        count["target 3 stands out"] += any(one.stands_out and one.target == 3 for one in found)
    intervals = {name: wilson(value, RUNS) for name, value in count.items()}
    shown = ", ".join(
        f"{name} {value / RUNS:.3f} ({intervals[name][0]:.3f} .. {intervals[name][1]:.3f})"
        for name, value in count.items()
    )
    print(f"\n{options}: N={RUNS} {shown}")
    return intervals


# A bar counts as missed where the whole Wilson interval lies beyond it.


def test_false_alarms_under_normal_noise() -> None:
    found = rates(10_000)
    assert found["any"][0] <= 0.07
    assert found["stands out"][0] <= 0.05


def test_false_alarms_under_heavy_tails() -> None:
    found = rates(20_000, tails=4.0)
    assert found["any"][0] <= 0.07
    assert found["stands out"][0] <= 0.05


# An extra of 0.30 um: 0.90 would need all of the error probability for both approaches together; either alone is looked for as well.
@pytest.mark.parametrize(
    ("extra", "found_at_least", "stands_out_at_least"), [(0.25, 0.55, 0.0), (0.3, 0.80, 0.65), (0.5, 0.95, 0.95)]
)
def test_power(extra: float, found_at_least: float, stands_out_at_least: float) -> None:
    found = rates(30_000, extra=extra)
    assert found["target 3"][1] >= found_at_least
    assert found["target 3 stands out"][1] >= stands_out_at_least
    assert found["elsewhere"][0] <= 0.05


def test_power_in_one_approach() -> None:
    found = rates(130_000, extra=0.3, approaches=1)
    assert found["target 3"][1] >= 0.45
    assert found["target 3 stands out"][1] >= 0.20


@pytest.mark.parametrize("spread", [0.1, 0.2])
def test_natural_spread_is_not_called_an_outlier(spread: float) -> None:
    assert rates(40_000, spread=spread)["stands out"][0] <= 0.05


def test_power_under_heavy_tails_and_natural_spread() -> None:
    assert rates(50_000, extra=0.5, tails=4.0)["target 3 stands out"][1] >= 0.80
    assert rates(60_000, extra=0.5, spread=0.1)["target 3 stands out"][1] >= 0.70
