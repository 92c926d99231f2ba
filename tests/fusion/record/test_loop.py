"""The closed loop on a record as a whole: complete models stay, and effects that did not help are withdrawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.loop.decisions import Reason
from fusion.loop.state import Confirmed, LoopState, Round, Score, Step
from fusion.model.fit import Term
from fusion.record.blocks import reduce_record
from fusion.record.hold_out import hold_out
from fusion.record.loop import close_record, without_unrepeated
from fusion.record.problem import ChainedPart
from fusion.twin.machine.recipe import EffectRecipe
from tests.fusion.record_tables import runs_table, searched, twin_table


def test_a_complete_model_stays_as_it_is():
    result = close_record(reduce_record(twin_table(seed=44)), ["quasi_static"])
    assert (result.state.steps, result.verdict) == ((), "complete")
    told = result.as_json()
    assert told["rmse_final_um"] == told["rmse_declared_um"]
    assert {one["effects"] == [] for one in told["chained"]} == {True}


def test_an_effect_that_fails_on_the_hold_out_set_stays_and_is_not_confirmed():
    """The wave turns against itself in the hold-out set: the error after is larger, and that is what is told."""
    record = reduce_record(
        twin_table(EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}), seed=44)
    )
    train, _ = hold_out(record)
    displacement = record.displacement.copy()
    displacement[~train] -= 4.0 * np.cos(2 * np.pi * record.seconds[~train] / 2220.0)[:, None]
    result = close_record(replace(record, displacement=displacement), ["quasi_static"])
    told = result.as_json()
    (step,) = told["steps"]
    assert step["effect"] == "periodic_disturbance" and not step["confirmed"]
    assert step["rmse_after_um"] > step["rmse_before_um"] and told["rmse_final_um"] > told["rmse_declared_um"]
    assert step["doubt"].startswith("the error on the hold-out set is ")
    assert told["verdict"] not in {"complete", "explained"}


def test_an_effect_that_earlier_parts_did_not_bear_out_is_withdrawn():
    problem, state = searched(EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}), seed=44)

    def part(effects: tuple[str, ...], declared: float, final: float) -> ChainedPart:
        return ChainedPart(0.0, 1.0, True, effects, np.array([9.0]), np.array([declared]), np.array([final]))

    name = "periodic_disturbance"
    helped, hurt, without = part((name,), 2.0, 1.0), part((name,), 1.0, 2.1), part((), 1.0, 1.0)
    assert without_unrepeated(problem, state, [without]) is state
    assert without_unrepeated(problem, state, [helped, without]) is state
    kept = without_unrepeated(problem, state, [helped, hurt, without])
    assert kept.steps == ()
    assert "the 2 earlier part(s) of the record" in kept.blocked()[name]
    # A part that reaches into the hold-out set has no vote.
    assert without_unrepeated(problem, state, [replace(hurt, in_training=False)]) is state


COLUMN = Candidate(np.zeros((2, 1)), {}, ("um",))


@dataclass(frozen=True)
class Model:
    """A model is its terms."""

    terms: tuple[Term, ...]


class Refitting:
    """As much of a record as a withdrawal asks for: a model of what is kept."""

    def refit(self, model: Model, terms: list[Term]) -> Model:
        return Model(tuple(terms))


def added(*names: str, event_s: float | None = None) -> LoopState[Model]:
    scores = tuple(Score(name, replace(COLUMN, event_s=event_s), family_wise_p=0.004) for name in names)
    scored = Round(scores)
    return LoopState(
        Model(tuple(Term(name, COLUMN) for name in ("quasi_static", *names))),
        steps=tuple(Step(score, scored, Confirmed.LATER_PARTS) for score in scores),
        rounds=(scored,),
    )


def part(effects: tuple[str, ...], declared: tuple[float, ...], final: tuple[float, ...]) -> ChainedPart:
    return ChainedPart(0.0, 1.0, True, effects, np.ones(len(declared)), np.array(declared), np.array(final))


@pytest.mark.parametrize(("final", "kept"), [(0.979, ["a"]), (0.98, [])])
def test_an_effect_must_have_earned_its_place_where_it_was_tried(final, kept):
    state = without_unrepeated(Refitting(), added("a"), [part(("a",), (1.0,), (final,)), part((), (9.0,), (9.0,))])
    assert [step.effect for step in state.steps] == kept
    if not kept:
        assert state.decisions[-1].evidence == {
            "p_value": 0.004,
            "parts": 1,
            "without_um": 1.0,
            "with_um": final,
            "search_p": 0.004,
        }
        assert [term.effect for term in state.model.terms] == ["quasi_static"]


def test_parts_and_channels_count_alike():
    """Means over channels of 2 and 3 um before, and of 1 and 3.5 um after; a channel that was not measured is left out."""
    parts = [part(("a",), (1.0, 3.0), (0.5, 1.5)), part(("a",), (3.0, np.nan), (3.5, np.nan))]
    assert without_unrepeated(Refitting(), added("a"), parts).steps != ()
    harmed = [parts[0], part(("a",), (3.0, np.nan), (4.1, np.nan))]
    state = without_unrepeated(Refitting(), added("a"), harmed)
    assert state.steps == ()
    assert state.decisions[-1].evidence == {
        "p_value": 0.004,
        "parts": 2,
        "without_um": pytest.approx(2.5),
        "with_um": pytest.approx(2.55),
        "search_p": 0.004,
    }


def test_effects_are_withdrawn_one_after_the_other_and_the_others_stay():
    parts = [part(("a", "c"), (1.0,), (2.0,)), part(("b",), (1.0,), (0.5,))]
    state = without_unrepeated(Refitting(), added("a", "b", "c"), parts)
    assert [step.effect for step in state.steps] == ["b"]
    assert [(one.effect, one.reason) for one in state.decisions] == [
        ("a", Reason.NOT_REPEATED),
        ("c", Reason.NOT_REPEATED),
    ]


def test_an_event_is_not_judged_by_other_parts():
    state = added("step_event", event_s=5.0)
    assert without_unrepeated(Refitting(), state, [part(("step_event",), (1.0,), (2.0,))]) is state


def test_runs_are_predicted_from_the_other_runs_and_judged_by_themselves():
    """Three runs that start elsewhere: one model serves all of them, because each counts from its own zero."""
    result = close_record(reduce_record(runs_table(5.0, -300.0, 40.0)), ["quasi_static"])
    told = result.as_json()
    assert [one["runs"] for one in told["chained"]] == [["r1.csv"], ["r2.csv"]]
    assert [(one["file"], one["held_out"], one["verdict"]) for one in told["runs"]] == [
        ("r1.csv", False, ""),
        ("r2.csv", False, ""),
        ("r3.csv", True, told["verdict"]),
    ]
    held_out = told["runs"][2]
    assert held_out["rmse_final_um"] == pytest.approx(told["rmse_final_um"], rel=1e-9)
    # The displacement follows the sensor exactly, but for the shrinkage that forward chaining chose.
    assert held_out["rmse_final_um"] < 0.01 * held_out["rmse_persistence_um"]
    assert held_out["duration_h"] == pytest.approx(1.0)
    assert [
        fit.design[:, :levels].sum() for fit, levels in zip(result.whole.channels, result.whole.levels, strict=True)
    ] == [180 + 60 + 60]
