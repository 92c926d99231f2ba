"""Campaigns in which nothing is missing, by a simulator of its own: what the closed loop and the search for positions state of them.

Five kinds of noise, equal, or unequal between sites and growing over the test, under a constant, a staircase and a switched load in turn:
docs/method/closed-loop.md, table of nulls.
"""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import read_fused
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.pipeline.positioning import diagnose_positions
from tests.soak.rates import campaigns, first_seed, rate, wilson
from tests.soak.simulator import DIRECTION, LOADS, NOISES, ORIGIN_MM, Machine, measure

pytestmark = pytest.mark.slow
RUNS = campaigns(60)
FIRST_SEED = first_seed(4700)
QUALITIES = {"equal": {}, "unequal and growing": {"unequal": 0.25, "growing": 1.0}}


def statements(machine: Machine, seed: list[int]) -> list[str]:
    """What is stated of a campaign in which nothing is missing."""
    campaign = measure(machine, np.random.default_rng(seed))
    logs = {"environment": campaign.environment, "drivers": campaign.drivers}
    fused = align(campaign.deviations, campaign.fields, AxisGeometry(ORIGIN_MM, DIRECTION), **logs)
    found = close_loop(read_fused(fused), ["axis_expansion", "table_offset"])
    said = [f"effect {step.effect} (p {step.p_value:.2g})" for step in found.steps]
    said += [f"remainder: {found.remainder.shape}"] if found.remainder.shape else []
    declared = fused["deviation"].copy(data=np.broadcast_to(campaign.drift_um, fused["deviation"].shape))
    anomalies = diagnose_positions(fused, campaign.deviations, declared)
    return [*said, *(f"position {one.target}: {one.evidence.kind}, {one.cause}" for one in anomalies)]


@pytest.mark.parametrize("quality", list(QUALITIES))
@pytest.mark.parametrize("noise", list(NOISES))
def test_nothing_false_is_stated(noise: str, quality: str, capsys: pytest.CaptureFixture[str]) -> None:
    number = 2 * list(NOISES).index(noise) + list(QUALITIES).index(quality)
    loads = list(LOADS)
    said = {
        run: found
        for run in range(RUNS)
        if (
            found := statements(
                Machine(noise=noise, load=loads[run % 3], **QUALITIES[quality]), [FIRST_SEED, number, run]
            )
        )
    }
    with capsys.disabled():
        print(f"\n{noise}, {quality}: {rate(len(said), RUNS)}")
        for run, found in said.items():
            print(f"  {run} ({loads[run % 3]}): {'; '.join(found)}")
    assert wilson(len(said), RUNS)[0] <= 0.05
