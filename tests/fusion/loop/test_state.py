"""The state of the loop: every method returns a new value and leaves the old one as it was."""

from __future__ import annotations

import copy
from dataclasses import FrozenInstanceError, dataclass, replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.loop.decisions import Decision, Reason
from fusion.loop.state import (
    Confirmation,
    Confirmed,
    LoopState,
    Round,
    Score,
    SearchError,
    Step,
    rivals,
)
from fusion.model.fit import Term

COLUMN = Candidate(np.zeros((2, 1)), {}, ("um",))


@dataclass(frozen=True)
class Model:
    """A model is its terms."""

    terms: tuple[Term, ...]


def terms(*names: str) -> tuple[Term, ...]:
    return tuple(Term(name, COLUMN) for name in names)


def score(name: str, excess: float = 10.0, **changes) -> Score:
    return Score(name, COLUMN, excess=excess, **changes)


def searched() -> LoopState[Model]:
    """Two declared effects and two that were added, of which one is an event."""
    first, second = score("dead_path"), score("step_event", p_value=0.5)
    scored = Round((first, second))
    return LoopState(
        Model(terms("axis_expansion", "table_offset", "dead_path", "step_event")),
        steps=(Step(first, scored, Confirmed.LATER_CYCLES), Step(second, scored, Confirmed.OTHER_TARGETS)),
        rounds=(scored,),
        decisions=(Decision("dead_path", Reason.ENTERED), Decision("step_event", Reason.ENTERED)),
    )


def test_terms_are_declared_first_then_one_for_every_step():
    state = searched()
    assert [term.effect for term in state.declared] == ["axis_expansion", "table_offset"]
    assert [term.effect for term in state.added] == ["dead_path", "step_event"]
    assert state.events == 1
    assert replace(state, steps=state.steps[:1]).events == 0
    bare = LoopState(Model(terms("axis_expansion")))
    assert [term.effect for term in bare.declared] == ["axis_expansion"] and bare.added == ()
    assert [step.effect for step in state.steps] == ["dead_path", "step_event"]


def test_terms_that_are_kept_when_steps_go():
    state = searched()
    assert [term.effect for term in state.kept([0])] == ["axis_expansion", "table_offset", "step_event"]
    assert [term.effect for term in state.kept([1])] == ["axis_expansion", "table_offset", "dead_path"]
    assert [term.effect for term in state.kept([0, 1])] == ["axis_expansion", "table_offset"]
    assert state.kept([]) == state.model.terms


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.decide(Decision("air_index", Reason.COLLINEAR)),
        lambda state: state.scored(Round((score("air_index"),), (Decision("own", Reason.COLLINEAR),))),
        lambda state: state.rescored(score("dead_path", gain=3.0)),
        lambda state: state.entered(Model(terms("a", "b", "c", "d", "e")), score("e"), Confirmed.SECOND_LOOK),
        lambda state: state.without([0], Model(terms("a", "b", "d")), [Decision("dead_path", Reason.SUPERFLUOUS)]),
    ],
    ids=["decide", "scored", "rescored", "entered", "without"],
)
def test_every_method_leaves_the_old_state(change):
    state = searched()
    before = copy.copy(state)
    changed = change(state)
    assert changed is not state and changed != state
    assert vars(state) == vars(before)


def test_a_state_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        searched().steps = ()  # type: ignore[misc]


def test_a_round_is_added_with_its_decisions():
    state = searched()
    scored = Round((score("air_index"),), (Decision("own", Reason.COLLINEAR),))
    after = state.scored(scored)
    assert after.rounds == (*state.rounds, scored)
    assert after.decisions == (*state.decisions, Decision("own", Reason.COLLINEAR))
    assert after.model is state.model and after.steps == state.steps


def test_a_score_is_replaced_in_the_last_round_only():
    state = searched().scored(Round((score("air_index"), score("dead_path")), start_error_um=2.0))
    closer = score("dead_path", gain=3.0)
    after = state.rescored(closer)
    assert after.rounds[0] is state.rounds[0]
    assert after.rounds[1].scores == (state.rounds[1].scores[0], closer)
    assert after.rounds[1].start_error_um == 2.0


def test_an_effect_enters_with_the_round_in_which_it_was_chosen():
    state = searched().scored(Round((score("a"),))).scored(Round((score("air_index"),)))
    chosen, model = score("air_index"), Model(terms("a", "b", "c", "d", "air_index"))
    after = state.entered(model, chosen, Confirmed.SECOND_LOOK)
    assert after.steps[:2] == state.steps
    assert after.steps[2] == Step(chosen, state.rounds[-1], Confirmed.SECOND_LOOK)
    assert after.steps[2].is_late_entry and not after.steps[0].is_late_entry
    assert after.model is model
    assert after.decisions[-1] == Decision("air_index", Reason.ENTERED)


def test_steps_are_taken_out_by_place():
    state, model = searched(), Model(terms("axis_expansion", "table_offset", "step_event"))
    reason = Decision("dead_path", Reason.SUPERFLUOUS, {"loss": 1.0})
    after = state.without([0], model, [reason])
    assert after.steps == state.steps[1:] and after.model is model
    assert after.decisions[-1] is reason
    assert state.without(range(2), model, []).steps == ()


def test_the_latest_decision_counts():
    state = LoopState(Model(())).decide(
        Decision("a", Reason.AT_SWITCHING, {"hours": 1.0}),
        Decision("b", Reason.COLLINEAR),
        Decision("c", Reason.NOT_AVAILABLE, {"because": "no log"}),
        Decision("d", Reason.NOT_CONFIRMED, {"p_value": 0.1}),
    )
    assert set(state.blocked()) == {"a", "b"}
    assert state.blocked()["b"] == Decision("b", Reason.COLLINEAR).sentence
    assert state.not_tried() == {"c": "no log"}
    assert state.last("a").reason is Reason.AT_SWITCHING and state.last("nothing") is None
    entered = state.decide(Decision("a", Reason.ENTERED))
    assert set(entered.blocked()) == {"b"} and entered.last("a").reason is Reason.ENTERED


def test_only_a_final_decision_keeps_an_effect_out():
    state = LoopState(Model(()))
    assert not state.is_withdrawn("a")
    blocked = state.decide(Decision("a", Reason.AT_SWITCHING))
    assert not blocked.is_withdrawn("a")
    final = blocked.decide(Decision("a", Reason.WRONG_PATTERN))
    assert final.is_withdrawn("a") and not final.is_withdrawn("b")
    assert not final.decide(Decision("a", Reason.COLLINEAR)).is_withdrawn("a")


def test_the_best_candidate_of_a_score_and_whether_it_is_an_event():
    assert score("a").best is COLUMN and not score("a").is_event
    event = replace(score("a"), candidate=replace(COLUMN, event_s=0.0))
    assert event.is_event
    none = Score("constant", None)
    assert not none.is_event
    with pytest.raises(SearchError, match="'constant' has no candidate that is independent of the model"):
        _ = none.best


def test_effects_within_three_units_that_are_significant_by_themselves_are_tied():
    chosen = score("chosen", 10.0)
    others = (
        score("close", 7.1, p_value=0.049, family_wise_p=0.3),
        score("at the limit", 7.0, p_value=0.001),
        score("by chance", 9.0, p_value=0.05),
        Score("collinear", None, excess=9.9, p_value=0.0),
        score("better", 11.0, p_value=0.01),
    )
    tied, runner_up = rivals(chosen, (chosen, *others))
    assert tied == ["close", "better"]
    assert runner_up == {"effect": "close", "behind_by": pytest.approx(2.9), "p_value": 0.3}


def test_an_effect_without_rivals_has_no_runner_up():
    chosen = score("chosen")
    assert rivals(chosen, (chosen, Score("collinear", None))) == ([], {})


def test_a_confirmation_starts_without_evidence():
    bare = Confirmation(False, Confirmed.BY_EVIDENCE)
    assert (bare.gain, bare.p_value) == (0.0, 1.0) and np.isnan(bare.error_um)


def test_a_score_starts_without_evidence():
    bare = Score("constant", None)
    assert (bare.gain, bare.excess, bare.p_value, bare.family_wise_p) == (0.0, 0.0, 1.0, 1.0)
    assert (bare.collinear, bare.critical, bare.drift_place, bare.confirmation) == (0.0, np.inf, 0, None)


def test_significant_effects_that_are_withheld_have_no_name():
    def scored(name: str, p_value: float) -> Score:
        return Score(name, Candidate(np.zeros((2, 1)), {}, ("um",)), family_wise_p=p_value)

    first = Round((scored("a", 1e-9), scored("b", 1e-4)))
    last = Round((scored("b", 1e-3), scored("c", 0.002), scored("d", 1e-9), scored("step_event", 1e-5)))
    state = LoopState(Model(())).scored(first)
    state = state.decide(
        Decision("a", Reason.AT_SWITCHING, {"hours": 1.0, "search_p": 1e-9}),
        Decision("b", Reason.NOT_CONFIRMED, {"p_value": 1e-4}),
        Decision("c", Reason.NOT_CONFIRMED, {"p_value": 0.002}),
        Decision("e", Reason.WRONG_PATTERN, {"p_value": 1e-5, "search_p": 1e-12}),
        Decision("step_event", Reason.ENTERED),
    )
    # What was significant before an effect entered counts only where it still is; a withdrawn name counts whatever came later.
    assert state.scored(last).unnamed(1e-3) == {"b": 1e-3, "e": 1e-12}
    assert LoopState(Model(())).unnamed(1e-3) == {}
