"""How often U (k = 2) of ISO 230-2 and ISO 230-3 values covers the truth, and errors over u: docs/method/iso230.md, iso230-3.md.

True values of ISO 230-2 are those of the axis without drift, which an endless test would find; of ISO 230-3 those of the drift itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from fusion.campaign.config import ThermalTestTable
from fusion.pipeline.iso230_3 import evaluate_axis_test, evaluate_record_test
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.iso230 import Iso230Budget, evaluate_iso230
from interferometry.iso230.quantities import axis_quantities
from tests.fusion.record_tables import table_of
from tests.soak.rates import campaigns, coverage_line, within_and_ratio
from tests.soak.simulator import DRIFTS, Machine, deviations_of, times_s, walk

pytestmark = pytest.mark.slow
CYCLES, TARGETS, SCATTER_UM = 5, 11, 0.5
RUNS = campaigns(100)
NOTHING = {
    "device_ppm": 0.0,
    "alignment_ppm": 0.0,
    "material_temperature_K": 0.0,
    "expansion_coefficient_ppm_per_K": 0.0,
}
QUANTITIES = ("A", "R", "E", "M", "B", "mean_reversal")


@dataclass(frozen=True)
class Case:
    """An axis, and what spoils its test."""

    profile_um: float
    reversal_um: float
    drift_um: float
    length_mm: float
    stated: dict[str, float]
    true_K: float = 0.0
    limits_ppm_per_K: float = 0.0


AT_24_DEGC = {"difference_from_20_degC_K": 4.0}
CASES = {
    "workshop as assumed": Case(15, 2, 2, 1000, AT_24_DEGC, 0.3, 2.0),
    "workshop as stated": Case(
        15, 2, 2, 1000, {**AT_24_DEGC, "material_temperature_K": 0.5, "expansion_coefficient_ppm_per_K": 0.6}, 0.5, 1.0
    ),
    "no drift": Case(15, 2, 0, 300, NOTHING),
    "drift 1 um": Case(15, 2, 1, 300, NOTHING),
    "drift 3 um": Case(15, 2, 3, 300, NOTHING),
    "drift 6 um": Case(15, 2, 6, 300, NOTHING),
    "no drift, profile 3 um": Case(3, 1, 0, 300, NOTHING),
    "no drift, profile 1 um, no reversal error": Case(1, 0, 0, 300, NOTHING),
}


@pytest.mark.parametrize("name", CASES)
def test_the_stated_uncertainty_covers_the_values_of_the_axis(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    case, rng = CASES[name], np.random.default_rng(230)
    seconds = times_s(Machine(cycles=CYCLES, targets=TARGETS, cycle_s=300.0))
    position = np.linspace(0.0, case.length_mm, TARGETS)
    along = position / case.length_mm
    profile = case.profile_um * (along - 0.3 * np.sin(2 * np.pi * along))
    mean = np.stack([profile + case.reversal_um / 2, profile - case.reversal_um / 2])
    true = axis_quantities(mean, np.full(mean.shape, SCATTER_UM)) | {"mean_reversal": case.reversal_um}
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    progress = seconds / seconds.max()
    made: dict[str, list[tuple[float, float]]] = {symbol: [] for symbol in QUANTITIES}
    for _ in range(RUNS):
        shape = progress if rng.integers(2) else 1.0 - np.exp(-3.0 * progress)
        x = mean + rng.normal(0.0, SCATTER_UM, seconds.shape) + rng.choice([-1, 1]) * case.drift_um * shape
        if case.true_K:
            ppm = rng.normal(0, 0.25) + rng.normal(0, 0.3) + 11.7 * rng.normal(0, case.true_K)
            x = x + 1e-3 * (ppm + 4.0 * rng.uniform(-1, 1) * case.limits_ppm_per_K) * position
        test = build_deviations(range(1, CYCLES + 1), range(1, TARGETS + 1), position, x, time)
        result = evaluate_iso230(test, budget=Iso230Budget(**case.stated), drift=estimate_drift(test)["drift"])
        for symbol, pairs in made.items():
            pairs.append((float(result[symbol]) - float(true[symbol]), float(result[f"{symbol}_u"])))
    found = {symbol: within_and_ratio(*np.transpose(pairs)) for symbol, pairs in made.items()}
    with capsys.disabled():
        print(coverage_line(name, found))
    # A share of 100 is known to 0.02. Where a known excess that the standard leaves in the value decides, nearly all are within.
    assert all(share >= 0.90 and 0.6 <= ratio <= 1.3 for share, ratio in found.values())


def ranges_of(hours: np.ndarray, course: np.ndarray) -> dict[str, float]:
    """Largest less smallest value of a course (n,) over the first hour, all of it and the last hour, each to its very end."""
    ends = {
        "first_hour": hours[0] + np.array([0.0, 1.0]),
        "whole": hours[[0, -1]],
        "last_hour": hours[-1] - np.array([1.0, 0.0]),
    }
    return {
        name: float(np.ptp([*course[(hours >= first) & (hours <= last)], *np.interp([first, last], hours, course)]))
        for name, (first, last) in ends.items()
    }


@pytest.mark.parametrize("cycles", [20, 30, 60])
@pytest.mark.parametrize("drift", ["none", "warm-up", "random walk", "room"])
def test_ranges_of_an_axis(drift: str, cycles: int, capsys: pytest.CaptureFixture[str]) -> None:
    machine, runs = Machine(cycles=cycles), campaigns(60)
    seconds, position = times_s(machine), machine.spacing_mm * np.arange(machine.targets)
    share = np.broadcast_to(position / position[-1], seconds.shape)
    order = np.argsort(seconds, axis=None)
    hours = seconds.mean(axis=(1, 2)) / 3600.0
    made: dict[str, list[tuple[float, float]]] = {}
    for run in range(runs):
        rng = np.random.default_rng([2303, cycles, run])
        drifted = np.empty(seconds.size)
        drifted[order] = DRIFTS[drift](rng, seconds.ravel()[order], share.ravel()[order])
        drifted = drifted.reshape(seconds.shape)
        noise = machine.noise_um * rng.standard_normal(seconds.shape)
        deviations = deviations_of(seconds, position, 5.0 * share + drifted + noise)
        (test,) = evaluate_axis_test(deviations, estimate_drift(deviations), ThermalTestTable())
        of_target = drifted.mean(axis=1)
        for one, course in zip(test.distortions[:2], (of_target[:, 0], of_target[:, -1]), strict=True):
            for period, true in ranges_of(hours, course).items():
                found = getattr(one, period)
                name = f"{one.name.split(',')[0]} {period}"
                made.setdefault(name, []).append((found.value - true, found.u))
    rows = {name: within_and_ratio(*np.transpose(pairs)) for name, pairs in made.items()}
    with capsys.disabled():
        print(coverage_line(f"{drift}, {cycles} cycles", rows))
    # A range that is nothing is never below it: an estimate of nothing is exact, and U is that of the readings.
    least = 0.0 if drift == "none" else 0.5
    assert all(share >= 0.88 and least <= ratio <= 1.3 for share, ratio in rows.values())


@pytest.mark.parametrize("kind", ["still", "warm-up", "random walk"])
def test_ranges_of_a_displacement(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    minutes, runs = np.arange(360.0), campaigns(60)
    made: dict[str, list[tuple[float, float]]] = {}
    for run in range(runs):
        rng = np.random.default_rng([2304, run])
        true = {
            "still": np.zeros(minutes.size),
            "warm-up": 5.0 * (1.0 - np.exp(-minutes / 60.0)),
            "random walk": walk(rng, 60.0 * minutes, 1.2),
        }[kind]
        readings = true + 0.2 * rng.standard_normal(minutes.size)
        stated = ThermalTestTable.model_validate({"sensor_calibration": "0 %"})
        (test,) = evaluate_record_test(table_of(readings[:, None], np.full((minutes.size, 1), 20.0)), stated)
        for period, value in ranges_of(minutes / 60.0, true).items():
            found = getattr(test.distortions[0], period)
            made.setdefault(period, []).append((found.value - value, found.u))
    rows = {name: within_and_ratio(*np.transpose(pairs)) for name, pairs in made.items()}
    with capsys.disabled():
        print(coverage_line(f"record, {kind}", rows))
    # The excess of a range of noisy values is contained and not corrected: nearly all are within.
    assert all(share >= 0.92 and 0.55 <= ratio <= 1.3 for share, ratio in rows.values())
