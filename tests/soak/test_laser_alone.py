"""How often the closed loop names an effect where nothing but the laser and the logs were recorded: docs/method/effects.md.

The table warms as ever, and nothing measures it: its expansion along the axis must not be given another name. THERMOFUSE_RUNS sets the
number of campaigns per case.
"""

from __future__ import annotations

import pytest

from fusion.analysis.alignment.align import align_logs
from fusion.analysis.alignment.readings import Readings, read_fused
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.twin import simulate
from fusion.twin.instruments import deviations_of
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import driver_log, environment_log
from tests.fusion.loop_bench import CYCLES, effect_of
from tests.soak.rates import campaigns, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(40)


def readings_of(seed: int, *effects: EffectRecipe) -> Readings:
    """Readings with the logs of air, material and load, without a temperature of the table."""
    truth = simulate(Recipe().vary(campaign={"seed": seed}, test={"cycles": CYCLES}, effect=tuple(effects)))
    return read_fused(align_logs(deviations_of(truth), environment=environment_log(truth), drivers=driver_log(truth)))


def test_the_warming_of_the_table_is_given_no_other_name() -> None:
    named = [[step.effect for step in close_loop(readings_of(seed), ()).steps] for seed in range(RUNS)]
    wrong = sum(bool(steps) for steps in named)
    print(f"\nnothing missing, laser alone: a name is given in {rate(wrong, RUNS)}: {[one for one in named if one]}")
    assert wilson(wrong, RUNS)[0] <= 0.05


@pytest.mark.parametrize("name", ["reversal_drift", "step_event"])
def test_what_the_warming_of_the_table_cannot_imitate_is_named(name: str) -> None:
    right = wrong = 0
    for seed in range(100, 100 + RUNS):
        steps = [step.effect for step in close_loop(readings_of(seed, effect_of(name, 0.4, seed)), ()).steps]
        right += name in steps
        wrong += any(step != name for step in steps)
    print(
        f"\n{name}, 0.4 um, laser alone: named {rate(right, RUNS)}, a wrong name beside it or instead {rate(wrong, RUNS)}"
    )
    assert wilson(right, RUNS)[1] >= 0.6
    assert wilson(wrong, RUNS)[0] <= 0.05
