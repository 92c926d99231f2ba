"""How often a long test is said to show what is not there, and shows what is: docs/method/closed-loop.md, table of long tests.

Names of the closed loop; correlation by means of cycles; patches of the field. THERMOFUSE_RUNS sets the number of tests per case (of the
correlation four times as many), THERMOFUSE_FIRST_SEED the first seed of the closed loop.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from fusion.analysis.alignment.align import find_switching_patch
from fusion.analysis.attribution.correlate import correlate
from fusion.analysis.drift_model.closed_loop import close_loop
from fusion.analysis.drift_model.evaluation import LoopResult
from fusion.analysis.drift_model.search import Reason
from fusion.pipeline.positioning import average_cycles
from fusion.twin import simulate
from fusion.twin.instruments import fields_of
from fusion.twin.recipe import EffectRecipe, Recipe
from tests.fusion import field_simulator
from tests.fusion.long_tests import long_test
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(20)
CORRELATIONS = 4 * RUNS
FIRST_SEED = first_seed(31000)


def would_be_named(result: LoopResult) -> bool:
    """Whether an event was refused for restless drift alone: significant and confirmed."""
    refused = {one.effect for one in result.state.decisions if one.reason is Reason.HETEROSCEDASTIC_DRIFT}
    scores = [score for scored in result.state.rounds for score in scored.scores if score.name in refused]
    return any(score.confirmation is not None and score.confirmation.passed for score in scores)


@pytest.mark.parametrize(
    ("drift", "cycles"),
    [
        ("walk", 300),
        ("walk", 1000),
        ("warm-up", 300),
        ("warm-up", 1000),
        ("warm-up", 3000),
        ("warm-up and walk", 1000),
        ("shifts", 1000),
    ],
)
def test_nothing_is_named_where_nothing_is_missing(drift: str, cycles: int) -> None:
    results = [close_loop(long_test(drift, cycles, seed), ()) for seed in range(FIRST_SEED, FIRST_SEED + RUNS)]
    wrong = sum(bool(result.steps) for result in results)
    names = Counter(step.effect for result in results for step in result.steps)
    held = sum(map(would_be_named, results))
    verdicts = dict(Counter(result.verdict for result in results))
    print(
        f"\n{drift}, {cycles} cycles: a name in {rate(wrong, RUNS)} {dict(names)}, refused for restless drift {held}; {verdicts}"
    )
    # The level of the search and of the second look together are 0.025.
    assert wilson(wrong, RUNS)[0] <= 0.025


@pytest.mark.parametrize(
    ("drift", "cycles", "period_s", "step_um"),
    [("walk", 300, 64.0, 0.6), ("warm-up", 300, 256.0, 0.6), ("warm-up", 1000, 256.0, 0.6)],
)
def test_a_true_step_is_named(drift: str, cycles: int, period_s: float, step_um: float) -> None:
    seeds = range(FIRST_SEED + 500, FIRST_SEED + 500 + RUNS)
    results = [close_loop(long_test(drift, cycles, seed, period_s=period_s, step_um=step_um), ()) for seed in seeds]
    right = sum("step_event" in [step.effect for step in result.steps] for result in results)
    held = sum(map(would_be_named, results))
    print(
        f"\n{drift}, {cycles} cycles, step of {step_um} um: named {rate(right, RUNS)}, refused for restless drift {held}"
    )
    assert wilson(right, RUNS)[1] >= 0.5


@pytest.mark.parametrize("kind", ["rw", "ar"])
@pytest.mark.parametrize(("cycles", "averaged"), [(600, True), (600, False), (1500, True)])
def test_means_of_cycles_keep_the_level_of_the_correlation(
    kind: str, cycles: int, averaged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Field and drift of the same kind, independent of each other: how often a cell or mode is significant at 5 %."""
    monkeypatch.setattr(field_simulator, "CYCLES", cycles)
    found = 0
    for seed in range(CORRELATIONS):
        made = field_simulator.null_session(kind, np.random.default_rng([seed, 91]))
        fused, field = made.fused.isel(target=[0, 7, 15]), made.field[:, 2::6, 2::8]
        if averaged:
            fused, field, _ = average_cycles(fused, field)
        maps = correlate(fused, field, checks=1, seed=seed, draws=199)
        least = [float(maps[name].min()) for name in ("p_value", "modes/p_value") if name in maps]
        found += min(least) <= 0.05
    means = "means of cycles" if averaged else "every cycle"
    print(f"\n{kind}, {cycles} cycles, {means}: any cell or mode {rate(found, CORRELATIONS)}")
    assert wilson(found, CORRELATIONS)[0] <= 0.07


@pytest.mark.parametrize("cycles", [800, 1500])
@pytest.mark.parametrize("source_K", [0.0, 25.0])
def test_a_patch_of_a_long_test_is_found_where_there_is_one(cycles: int, source_K: float) -> None:
    """Fields of the twin with 0.05 K of noise; a body of 25 K makes a patch of 0.72 K, which is switched at random."""
    effects = (EffectRecipe("reflected_source", amplitude_K=source_K),) if source_K else ()
    ranges_K = []
    for seed in range(1000, 1000 + (10 if effects else 40)):
        truth = simulate(Recipe().vary(campaign={"seed": seed}, test={"cycles": cycles}, effect=effects))
        fields = fields_of(truth, cell_size_mm=20.0, noise_K=0.05)
        patch = find_switching_patch(fields["frame_temperature"].values)
        ranges_K += [] if patch is None else [float(np.ptp(patch.course))]
    print(f"\n{cycles} frames, body of {source_K:g} K: found {len(ranges_K)}, ranges {np.round(ranges_K, 2)} K")
    assert len(ranges_K) == (10 if effects else 0)
    assert not effects or np.median(ranges_K) < 1.2
