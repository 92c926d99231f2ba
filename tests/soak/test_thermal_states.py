"""How often an untouched machine seems to have changed between two thermal states, and changes that are found: docs/method/comparison.md.

A screw that is hot in a part of the travel drifts in a shape of its own. THERMOFUSE_RUNS sets the number of pairs of each state.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.comparison import compare_profiles
from fusion.analysis.levels import CHANGE_LEVEL
from interferometry.drift.estimate import estimate_drift
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.soak.simulator import Array, Machine, deviations_of, readings_noise, times_s

pytestmark = pytest.mark.slow
RUNS = campaigns(60)
MACHINE = Machine(cycles=30, spacing_mm=30.0)
SECONDS, POSITION = times_s(MACHINE), MACHINE.spacing_mm * np.arange(MACHINE.targets)
#: Warmth (share of the settled one) at the start of both tests and where it tends to, and how far the hot zone lies from the middle, mm.
STATES = {
    "both cold": ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0)),
    "both warm": ((0.95, 1.0, 0.0), (0.9, 1.0, 0.0)),
    "cold, then 60 % warmed up": ((0.0, 1.0, 0.0), (0.6, 1.0, 0.0)),
    "hot zone elsewhere": ((0.0, 1.0, -60.0), (0.0, 1.0, 60.0)),
    "cold, then cooling down": ((0.0, 1.0, 0.0), (0.9, 0.2, 0.0)),
}
#: Changes of the machine, um, at the positions where they act: (direction, target) factors.
CHANGES = {
    "step of 3 um": 3.0 * (np.arange(16) >= 8) * np.ones((2, 1)),
    "block of 1.5 um": 1.5 * ((np.arange(16) >= 5) & (np.arange(16) <= 8)) * np.ones((2, 1)),
    "position by 0.4 um": 0.4 * (np.arange(16) == 4) * np.ones((2, 1)),
    "reversal by 2 um": np.array([[1.0], [-1.0]]) * np.ones(16),
}


def drift(start: float, end: float, away_mm: float) -> Array:
    """Drift of all readings, um: 5 um of the whole axis, and 6 um from before to behind the hot zone, by one warmth of 75 min."""
    hot = 6.0 / (1.0 + np.exp(-(POSITION - POSITION.mean() - away_mm) / 24.0))
    return (end + (start - end) * np.exp(-SECONDS / 4500.0)) * (5.0 + hot)


def measured(rng: np.random.Generator, profile: Array, state: tuple[float, float, float]) -> xr.Dataset:
    readings = deviations_of(SECONDS, POSITION, profile + drift(*state) + readings_noise(MACHINE, rng)[0])
    return estimate_drift(readings).assign(position=readings["position"])


def changed(before: xr.Dataset, after: xr.Dataset) -> bool:
    found = compare_profiles(before, after, level=CHANGE_LEVEL)
    return any(one.machine and one.p_value * found.tests <= CHANGE_LEVEL for one in found.shapes)


@pytest.mark.parametrize("state", list(STATES))
def test_an_untouched_machine_in_two_thermal_states(state: str, capsys: pytest.CaptureFixture[str]) -> None:
    counts = dict.fromkeys(("untouched", *CHANGES), 0)
    for seed in range(first_seed(5000), first_seed(5000) + RUNS):
        rng = np.random.default_rng([seed, list(STATES).index(state)])
        profile = 4.0 * np.sin(2.0 * np.pi * (POSITION / POSITION[-1] + rng.random())) + np.array([[0.75], [-0.75]])
        before, after = (measured(rng, profile, one) for one in STATES[state])
        counts["untouched"] += changed(before, after)
        for name, size in CHANGES.items():
            counts[name] += changed(before, after.assign(profile=after["profile"] + size))
    with capsys.disabled():
        print(f"\n{state}: " + "; ".join(f"{name}: {rate(count, RUNS)}" for name, count in counts.items()))
    assert wilson(counts["untouched"], RUNS)[0] <= CHANGE_LEVEL
    # What two badly known shapes of nearly the same place may hold is not found at any size: the block in one pair of eight.
    assert all(wilson(counts[name], RUNS)[1] >= 0.95 for name in ("step of 3 um", "reversal by 2 um"))
    assert wilson(counts["block of 1.5 um"], RUNS)[1] >= 0.85
