"""How often the closed loop names what is not there in long tests, and finds what is: docs/method/closed-loop.md, table of long tests.

THERMOFUSE_RUNS sets the number of tests per case, THERMOFUSE_FIRST_SEED the first seed.
"""

from __future__ import annotations

from collections import Counter

import pytest

from fusion.loop.axis import close_loop
from fusion.loop.decisions import Reason
from fusion.loop.result import LoopResult
from tests.fusion.long_tests import long_test
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow
RUNS = campaigns(20)
FIRST_SEED = first_seed(31000)


def would_be_named(result: LoopResult) -> bool:
    """Whether an event was refused for restless drift alone: significant and confirmed."""
    refused = {one.effect for one in result.state.decisions if one.reason is Reason.RESTLESS_DRIFT}
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
