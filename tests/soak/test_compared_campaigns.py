"""How often campaigns of a machine that nobody touched seem to differ, and a repair is found: docs/method/comparison.md.

THERMOFUSE_RUNS sets the number of pairs.
"""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.comparison import ProfileChange, compare_profiles, compare_scatters
from tests.fusion.compared_tests import REPAIRED_MM, drift_of, readings_of, repaired
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(200)
LEVEL, CYCLES = 0.05, 30
#: Repair of one position, um; a reading scatters by 0.4 um.
REPAIR_UM = 0.4


def moved(found: ProfileChange) -> list[float]:
    """Positions that count as changed, and the mean reversal as a position of its own (-1)."""
    tests = found.tests
    return [
        -1.0 if shape.position_mm is None else shape.position_mm
        for shape in found.shapes
        if shape.machine and (shape.position_mm is not None or shape.p_value * tests <= LEVEL)
    ]


def test_an_untouched_machine_and_a_repair() -> None:
    alarms = scattered = found = alone = 0
    for pair in range(RUNS):
        seed = first_seed(1010) + 2 * pair
        after = readings_of(seed + 1, cycles=CYCLES, duty="constant" if pair % 2 else "random")
        one, other = drift_of(readings_of(seed, cycles=CYCLES)), drift_of(after)
        alarms += bool(moved(compare_profiles(one, other, level=LEVEL)))
        freedom = [test["scatter_freedom"].sum("direction").values for test in (one, other)]
        place, scatter = one["position"].values, [test["scatter_position"].values for test in (one, other)]
        p = [change.p_value for change in compare_scatters(place, *scatter, *freedom)]
        scattered += bool(np.min(p) * place.size <= LEVEL)
        changed = moved(compare_profiles(one, drift_of(repaired(after, REPAIR_UM)), level=LEVEL))
        found, alone = found + (REPAIRED_MM in changed), alone + (changed == [REPAIRED_MM])
    print(
        f"\nuntouched: a position or the reversal changed in {rate(alarms, RUNS)}, the scatter in {rate(scattered, RUNS)}"
    )
    print(
        f"one position moved by {REPAIR_UM} um: found in {rate(found, RUNS)}, alone and at its place in {rate(alone, RUNS)}"
    )
    assert wilson(alarms, RUNS)[0] <= LEVEL and wilson(scattered, RUNS)[0] <= LEVEL
    assert wilson(found, RUNS)[1] >= 0.8
