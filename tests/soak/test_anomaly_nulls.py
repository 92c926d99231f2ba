"""Campaigns without an anomaly, whose noise or drift is not what the joint estimate assumes: docs/method/anomalies.md.

Seven kinds of noise and drift shape, each under five drifts in time (100 campaigns per cell; THERMOFUSE_RUNS sets another number). Printed
are the shares of campaigns in which an anomaly stands out, which is what the report shows, the error of the profile beside that of the
plain mean of the cycles, and the coverage of the 95 % intervals.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from scipy import special

from interferometry.anomalies import detect_anomalies
from interferometry.drift.estimate import estimate_drift
from tests.interferometry.simulated_campaigns import SIGMA_UM, TARGETS, recorded, schedule, simulate
from tests.soak.rates import campaigns, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(100)
CYCLES = 100
SECONDS = schedule(CYCLES)
PLACE = np.linspace(0, 1, TARGETS)
DRIFTS = ("none", "warmup", "rw", "periodic", "two time constants")
NOISES = ("normal", "t, 4 degrees of freedom", "unequal scatter", "memory of 20 s", "memory over cycles")


def noise_of(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Noise (cycle, direction, target), um."""
    unit = rng.standard_normal(SECONDS.shape)
    if kind.startswith("t"):
        unit = rng.standard_t(4, SECONDS.shape) / np.sqrt(2)
    elif kind == "unequal scatter":
        unit = unit * np.exp(0.25 * rng.standard_normal((2, TARGETS)))
    elif kind == "memory of 20 s":
        order = np.argsort(SECONDS.ravel())
        series = unit.ravel().copy()
        for k, share in enumerate(np.exp(-np.diff(SECONDS.ravel()[order]) / 20.0), start=1):
            series[k] = share * series[k - 1] + np.sqrt(1 - share**2) * series[k]
        placed = np.empty(series.size)
        placed[order] = series
        unit = placed.reshape(SECONDS.shape)
    elif kind == "memory over cycles":
        for k in range(1, CYCLES):
            unit[k] = 0.3 * unit[k - 1] + np.sqrt(0.91) * unit[k]
    return SIGMA_UM * unit


def drift_of(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Drift (cycle, direction, target) of the kinds that the simulator does not make, um."""
    if kind == "periodic":
        shift, stretch = (np.sin(2 * np.pi * SECONDS / rng.uniform(1800, 2880) + rng.uniform(0, 6)) for _ in range(2))
        return 3.0 * shift + 2.0 * stretch * PLACE
    shift = 6.0 * (1 - np.exp(-SECONDS / 1200)) + 8.0 * (1 - np.exp(-SECONDS / 9000))
    stretch = 5.0 * (1 - np.exp(-SECONDS / 2400)) + 9.0 * (1 - np.exp(-SECONDS / 12000))
    return np.asarray(shift + stretch * PLACE)


def campaign(seed: int, noise: str, drift: str, hot_zone_um: float) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """Deviations, true profile in the mean state (direction, target) and true drift from it (cycle, direction, target)."""
    rng = np.random.default_rng(seed)
    simulated = drift in ("none", "warmup", "rw")
    deviations, truth = simulate(rng, kind=drift if simulated else "none", noise=noise_of(rng, noise))
    extra = np.zeros(SECONDS.shape) if simulated else drift_of(rng, drift)
    # The nut warms the screw where it works: a ramp to 55 % of the travel, flat beyond.
    extra = extra + hot_zone_um * (1 - np.exp(-SECONDS / 5400)) * np.minimum(PLACE, 0.55) / 0.55
    deviations["deviation"] = deviations["deviation"] + extra
    drift_um = truth.drift + extra
    mean_state = drift_um.mean(axis=(0, 1))
    return deviations, truth.profile + mean_state, drift_um - mean_state


@pytest.mark.parametrize(
    ("noise", "hot_zone_um"), [*((noise, 0.0) for noise in NOISES), ("normal", 4.0), ("normal", 10.0)]
)
def test_no_anomaly_is_reported(noise: str, hot_zone_um: float) -> None:
    flagged, profile, plain, coverage, drift_coverage = [], [], [], [], []
    for number, drift in enumerate(DRIFTS):
        count = 0
        for run in range(RUNS):
            deviations, truth, drift_um = campaign(700_000 + 1000 * number + run, noise, drift, hot_zone_um)
            estimated = estimate_drift(deviations)
            count += any(anomaly.stands_out for anomaly in detect_anomalies(deviations, estimated))
            relative = truth - truth[:, :1]
            error = (estimated["profile_relative"].values - relative)[:, 1:]
            mean = deviations["deviation"].values.mean(axis=0)
            profile.append(np.mean(error**2))
            plain.append(np.mean((mean - mean[:, :1] - relative)[:, 1:] ** 2))
            coverage.append(np.mean(np.abs(error) < 1.96 * estimated["profile_relative_u"].values[:, 1:]))
            off = estimated["drift"].values - drift_um
            drift_coverage.append(np.mean(np.abs(off) < 1.96 * estimated["drift_u"].values))
        flagged.append(count)
    low, high = wilson(sum(flagged), RUNS * len(DRIFTS))
    rms, rms_plain = float(np.sqrt(np.mean(profile))), float(np.sqrt(np.mean(plain)))
    cells = ", ".join(f"{drift} {count}" for drift, count in zip(DRIFTS, flagged, strict=True))
    print(
        f"\n{noise}, hot zone {hot_zone_um:g} um: of {RUNS} each: {cells}; together {sum(flagged) / RUNS / len(DRIFTS):.3f} "
        f"[{low:.3f}, {high:.3f}]; profile {rms:.4f} um (plain mean {rms_plain:.4f}); coverage of the profile {np.mean(coverage):.3f}, "
        f"of the drift {np.mean(drift_coverage):.3f}"
    )
    assert low <= 0.05
    assert rms <= 1.1 * rms_plain
    assert np.mean(coverage) >= 0.93
    assert np.mean(drift_coverage) >= 0.90


@pytest.mark.parametrize("noise_digits", [0.1, 0.2, 0.25, 0.3, 0.4])
def test_no_position_stands_out_by_the_digits_of_the_readings(noise_digits: float) -> None:
    """25 cycles of a settled machine in whole micrometres; what exceeds the digit stands out as it does in finer digits."""
    found = {
        name: dict.fromkeys((0.001, 1.0), 0) for name in ("nothing", "scatter of 2.5 digits", "step of 2.5 digits")
    }
    for (name, by_digit), seed in itertools.product(found.items(), range(RUNS)):
        rng = np.random.default_rng([seed, 25])
        test, _ = simulate(rng, kind="none", cycles=25, sigma=noise_digits)
        if name.startswith("scatter"):
            test["deviation"][:, :, 4] += rng.normal(0.0, 2.5, (25, 2))
        elif name.startswith("step"):
            test["deviation"][13:, :, 4] += 2.5
        for digit in by_digit:
            written = recorded(test, digit)
            named = [
                one
                for one in detect_anomalies(written, estimate_drift(written), level=0.015, permutations=999)
                if one.stands_out
            ]
            by_digit[digit] += any(one.target == 5 or name == "nothing" for one in named)
    for name, by_digit in found.items():
        print(
            f"noise of {noise_digits} digits, {name}: "
            + ", ".join(f"{n} of {RUNS} in {d} um" for d, n in by_digit.items())
        )
    # At most 0.015 of sound tests: the upper limit of its binomial count at 99 %.
    assert found["nothing"][1.0] <= special.bdtrik(0.99, RUNS, 0.015)
    assert found["scatter of 2.5 digits"][1.0] >= 0.9 * found["scatter of 2.5 digits"][0.001]
