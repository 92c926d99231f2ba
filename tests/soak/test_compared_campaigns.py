"""How often campaigns of a machine that nobody touched seem to differ, and a repair is found: docs/method/comparison.md.

THERMOFUSE_RUNS sets the number of pairs.
"""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.comparison import ProfileChange, compare_profiles, compare_scatters
from tests.fusion.compared_tests import REPAIRED, REPAIRED_MM, drift_of, readings_of
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(200)
LEVEL, CYCLES = 0.05, 30
#: Repair of one position, um; a reading scatters by 0.4 um.
REPAIR_UM = 0.4
#: Step of the profile from the middle of the travel on, and block in it, um; first and last target number of the block.
STEP_UM, STEP_FROM, BLOCK_UM, BLOCK = 0.6, 9, 0.6, (6, 11)


def moved(found: ProfileChange) -> list[tuple[str, float | None]]:
    """What counts as a change of the machine, with its place."""
    return [
        (shape.quantity, shape.position_mm)
        for shape in found.shapes
        if shape.machine and shape.p_value * found.tests <= LEVEL
    ]


def test_an_untouched_machine_and_a_repair() -> None:
    counts = dict.fromkeys(("alarms", "scattered", "found", "alone", "step", "step named", "block", "block named"), 0)
    for pair in range(RUNS):
        seed = first_seed(1010) + 2 * pair
        after = readings_of(seed + 1, cycles=CYCLES, duty="constant" if pair % 2 else "random")
        one, other = drift_of(readings_of(seed, cycles=CYCLES)), drift_of(after)
        counts["alarms"] += bool(moved(compare_profiles(one, other, level=LEVEL)))
        freedom = [test["scatter_freedom"].sum("direction").values for test in (one, other)]
        place, scatter = one["position"].values, [test["scatter_position"].values for test in (one, other)]
        p = [change.p_value for change in compare_scatters(place, *scatter, *freedom)]
        counts["scattered"] += bool(np.min(p) * place.size <= LEVEL)

        def changed(size_um: float, first: int, last: int, before=one, later=other) -> list[tuple[str, float | None]]:
            at = (later["target"] >= first) & (later["target"] <= last)
            repaired = later.assign(profile=later["profile"] + xr.where(at, size_um, 0.0))
            return moved(compare_profiles(before, repaired, level=LEVEL))

        single = changed(REPAIR_UM, REPAIRED, REPAIRED)
        counts["found"] += ("position", REPAIRED_MM) in single
        counts["alone"] += single == [("position", REPAIRED_MM)]
        step, block = changed(STEP_UM, STEP_FROM, place.size), changed(BLOCK_UM, *BLOCK)
        counts["step"] += bool(step)
        counts["step named"] += step == [("step", place[STEP_FROM - 1])]
        counts["block"] += bool(block)
        counts["block named"] += block == [("block", place[BLOCK[0] - 1])]
    shown = {name: rate(count, RUNS) for name, count in counts.items()}
    print(f"\nuntouched: the profile or the reversal changed in {shown['alarms']}, the scatter in {shown['scattered']}")
    print(
        f"one position moved by {REPAIR_UM} um: found in {shown['found']}, alone and at its place in {shown['alone']}"
    )
    print(f"step of {STEP_UM} um: a change in {shown['step']}, named at its place in {shown['step named']}")
    print(f"block of {BLOCK_UM} um: a change in {shown['block']}, named at its place in {shown['block named']}")
    assert wilson(counts["alarms"], RUNS)[0] <= LEVEL and wilson(counts["scattered"], RUNS)[0] <= LEVEL
    assert wilson(counts["found"], RUNS)[1] >= 0.8
    assert wilson(counts["step"], RUNS)[1] >= 0.8
