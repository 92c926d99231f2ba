"""How often the loop on a record is right, on records of the twin: docs/method/records.md, table of error rates.

THERMOFUSE_RUNS sets the number of records per case (30 by default), THERMOFUSE_FIRST_SEED the first seed. This test runs the search and
the opening of the hold-out; the whole loop also withdraws an effect that did not help on earlier parts of the record.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.drift_model.record import ask_unseen, declare, hold_out, search_record, series_of
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.search import open_hold_out
from fusion.analysis.levels import RECORD_ENTRY_LEVEL
from fusion.twin.recipe import EffectRecipe
from tests.fusion.record_tables import twin_table
from tests.soak.rates import campaigns, first_seed, rate, wilson

pytestmark = pytest.mark.slow

RUNS = campaigns(30)
FIRST_SEED = first_seed(7000)
#: One missing effect at a time; a record of 24 h, 10 sensors, 3 channels, 0.3 um noise.
KINDS = {
    "none": None,
    "unseen_heat_source": EffectRecipe("unseen_heat_source", 1.5),
    "step_event": EffectRecipe("step_event", 1.0, parameters={"at_cycle": 11}),
    "periodic_disturbance": EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}),
    "thermal_lag": EffectRecipe("thermal_lag", 1.0),
}


def test_rates_of_names_on_records(capsys: pytest.CaptureFixture[str]) -> None:
    wrong, rows = {}, []
    for kind, effect in KINDS.items():
        names: Counter[tuple[str, ...]] = Counter()
        before, after, unnamed = [], [], 0
        for seed in range(FIRST_SEED, FIRST_SEED + RUNS):
            record = reduce_record(twin_table(*([effect] if effect else []), seed=seed))
            train, _ = hold_out(record)
            state = open_hold_out(*search_record(record, train, declare(["quasi_static"], record)))
            names[tuple(step.effect for step in state.steps)] += 1
            before.append(state.errors_um[0])
            after.append(state.errors_um[-1])
            unnamed += bool(state.unnamed(RECORD_ENTRY_LEVEL))
        right = sum(count for found_names, count in names.items() if found_names == ((kind,) if effect else ()))
        wrong[kind] = sum(count for found_names, count in names.items() if set(found_names) - {kind})
        rows.append(
            f"{kind:22s} right alone {right}/{RUNS}, a wrong name {wrong[kind]}/{RUNS}, "
            f"significant without a name {unnamed}/{RUNS}, hold-out error {np.median(before):.2f} -> {np.median(after):.2f} um, larger in "
            f"{np.greater(after, before).sum()}/{RUNS}   {dict(names)}"
        )
    with capsys.disabled():
        print("\n" + "\n".join(rows))
    # Twice the error that the level of the search allows, plus three standard deviations of a count of RUNS.
    assert wrong["none"] <= 0.1 * RUNS + 3.0 * np.sqrt(0.1 * 0.9 * RUNS)


#: Size of a random walk over the hold-out, in standard deviations of the displacement before.
WALKS = (0.03, 0.1, 0.3, 1.0)


@pytest.mark.parametrize("kind", ["unseen_heat_source", "periodic_disturbance"])
def test_a_hold_out_that_wanders_at_random_bears_no_effect_out(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The displacements of the hold-out are replaced by random walks, in part alike in all channels, which follow nothing."""
    rng, told = np.random.default_rng(FIRST_SEED), Counter[str]()
    for seed in range(FIRST_SEED, FIRST_SEED + RUNS):
        record = reduce_record(twin_table(KINDS[kind], seed=seed))
        train, _ = hold_out(record)
        problem, state = search_record(record, train, declare(["quasi_static"], record))
        share = series_of(state.model.terms, problem.predict(state.model.terms))
        scale = record.displacement[train].std(axis=0)
        for size in WALKS:
            steps = rng.standard_normal(((~train).sum(), scale.size)) + rng.standard_normal(((~train).sum(), 1))
            displacement = record.displacement.copy()
            walk = np.cumsum(steps, axis=0) / np.sqrt(2.0 * len(steps)) + 0.02 * rng.standard_normal(steps.shape)
            displacement[~train] = displacement[train][-1] + size * scale * walk
            wandering = replace(record, displacement=displacement)
            lasting = [term.candidate.event_s is None for term in state.added]
            left_out = [displacement] * (1 + len(lasting))
            asked = ask_unseen(wandering, ~train, state, share, left_out)
            told.update(one.word for one, lasts in zip(asked, lasting, strict=True) if lasts)
    with capsys.disabled():
        print(f"\n{kind}: borne out by a random walk {rate(told['yes'], told.total())}, {dict(told)}")
    assert wilson(told["yes"], told.total())[0] <= 0.05
