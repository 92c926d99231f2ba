"""The procedure on a problem whose scores, confirmations and hold-out errors are written down beforehand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.loop.closed_loop import (
    choose,
    drop_superfluous,
    enter,
    no_progress,
    not_confirmed,
    open_hold_out,
    p_value_beside,
    search,
    withdraw,
)
from fusion.loop.decisions import Decision, Reason
from fusion.loop.state import Confirmation, Confirmed, LoopState, Round, Score
from fusion.model.fit import Term

CANDIDATE = Candidate(np.zeros((2, 1)), {}, ("um",))
EVENT = Candidate(np.zeros((2, 1)), {}, ("um",), 1.0)
LEVEL = 0.02


@dataclass(frozen=True)
class Model:
    """A model is its terms; ``origin`` says from which it was fitted again."""

    terms: tuple[Term, ...]
    origin: Model | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(term.effect for term in self.terms)


@dataclass
class Script:
    """A problem that answers from what is written down, and notes what it was asked."""

    rounds: list[Round] = field(default_factory=list)
    refused: frozenset[str] = frozenset()
    not_confirmed: frozenset[str] = frozenset()
    losses: dict[str, float] = field(default_factory=dict)
    error: Callable[[tuple[str, ...]], float] = lambda names: 1.0
    asked: list[str] = field(default_factory=list)
    hold_out_asked: list[tuple[str, ...]] = field(default_factory=list)

    def refit(self, model: Model, terms: Sequence[Term]) -> Model:
        return Model(tuple(terms), model)

    def score(self, state: LoopState[Model]) -> Round:
        self.asked.append("score")
        return self.rounds.pop(0) if self.rounds else Round(())

    def entry_level(self, score: Score) -> float:
        return LEVEL

    def refuse(self, score: Score, model: Model) -> Decision | None:
        self.asked.append(f"refuse {score.name}")
        return Decision(score.name, Reason.AT_SWITCHING, {"hours": 1.0}) if score.name in self.refused else None

    def confirm(self, score: Score, state: LoopState[Model]) -> Score:
        self.asked.append(f"confirm {score.name}")
        passed = score.name not in self.not_confirmed
        return replace(score, gain=77.0, confirmation=Confirmation(passed, Confirmed.LATER_PARTS))

    def loss_without(self, model: Model, term: Term) -> float:
        return self.losses.get(term.effect, 100.0)

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        names = tuple(term.effect for term in terms)
        self.hold_out_asked.append(names)
        return self.error(names)


def score(name: str, excess: float = 20.0, p_value: float = 0.001) -> Score:
    return Score(name, CANDIDATE, excess=excess, p_value=p_value, family_wise_p=p_value)


def start(*scores: Score) -> LoopState[Model]:
    """The declared model, with one round scored where there are scores."""
    state = LoopState(Model((Term("declared", CANDIDATE),)))
    return state.scored(Round(scores)) if scores else state


def with_steps(problem: Script, *names: str) -> LoopState[Model]:
    state = start(*(score(name) for name in names))
    for name in names:
        state = enter(problem, state, problem.confirm(score(name), state))
    problem.asked.clear()
    return state


def test_the_best_effect_that_is_significant_is_chosen():
    problem = Script()
    state, chosen = choose(problem, start(score("a", 20.0), score("b", 10.0)))
    assert chosen.name == "a"
    assert problem.asked == ["refuse a", "confirm a"]
    # The round keeps the closer look that came with the confirmation.
    assert [one.gain for one in state.rounds[-1].scores] == [77.0, 0.0]


@pytest.mark.parametrize(("p_value", "name"), [(LEVEL, "a"), (LEVEL * 1.001, "b")])
def test_an_effect_enters_up_to_the_level(p_value, name):
    _, chosen = choose(Script(), start(score("a", 20.0, p_value), score("b", 19.0)))
    assert chosen.name == name


def test_another_level_can_be_asked_for():
    assert choose(Script(), start(score("a", p_value=0.01)), level=0.005)[1] is None
    assert choose(Script(), start(score("a", p_value=0.04)), level=0.05)[1].name == "a"


def test_an_effect_without_a_candidate_or_withdrawn_for_good_is_passed_over():
    scores = (replace(score("none"), candidate=None), score("wrong"), score("good"))
    state = start(*scores).decide(Decision("wrong", Reason.WRONG_PATTERN, {"p_value": 0.1}))
    problem = Script()
    _, chosen = choose(problem, state)
    assert chosen.name == "good" and problem.asked == ["refuse good", "confirm good"]


def test_a_refusal_is_recorded_and_does_not_stand_in_the_way_of_a_weaker_effect():
    problem = Script(refused=frozenset({"a"}))
    state, chosen = choose(problem, start(score("a", 50.0), score("b", 5.0)))
    assert chosen.name == "b"
    # The evidence holds how significant it was: a name that is withheld shows that something is missing all the same.
    assert state.decisions == (Decision("a", Reason.AT_SWITCHING, {"hours": 1.0, "search_p": 0.001}),)


@pytest.mark.parametrize(
    ("excess", "loss", "name"),
    [
        (17.0, 0.0, "b"),
        # 0.001 grows by a factor of e with every nat that is lost beside the stronger effect; the level is 0.02.
        (16.9, 30.0 - math.log(19.9), "b"),
        (16.9, 30.0 - math.log(20.1), None),
        (16.9, 40.0, "b"),
    ],
)
def test_a_much_weaker_event_is_held_against_a_stronger_one_that_was_not_confirmed(excess, loss, name):
    problem = Script(not_confirmed=frozenset({"a"}), losses={"b": loss})
    weaker = replace(score("b", excess), gain=30.0, candidate=EVENT)
    state, chosen = choose(problem, start(score("a", 20.0, 0.003), weaker))
    assert (chosen.name if chosen else None) == name
    decision, *others = state.decisions
    assert decision == Decision("a", Reason.NOT_CONFIRMED, {"p_value": 0.003})
    # What is passed over is never left without a reason.
    assert [other.reason for other in others] == ([] if name else [Reason.STANDS_IN])


def test_a_much_weaker_lasting_effect_may_stand_in_for_one_that_was_not_confirmed():
    _, chosen = choose(Script(not_confirmed=frozenset({"a"})), start(score("a", 20.0), score("b", 16.9)))
    assert chosen is None


def test_what_a_weaker_effect_gains_is_measured_with_both_in_the_model():
    asked = []
    problem = Script()
    problem.loss_without = lambda model, term: asked.append((model.names, term.effect)) or 28.0
    model = Model((Term("declared", CANDIDATE),))
    p_value = p_value_beside(problem, model, replace(score("b"), gain=30.0), score("a"))
    assert p_value == pytest.approx(0.001 * math.exp(2.0))
    assert asked == [(("declared", "a", "b"), "b")]


def test_the_strongest_of_those_not_confirmed_sets_the_limit():
    problem = Script(not_confirmed=frozenset({"a", "b"}), losses={"c": 0.0})
    scores = (score("a", 20.0), score("b", 18.0), replace(score("c", 16.0), gain=30.0, candidate=EVENT))
    _, chosen = choose(problem, start(*scores))
    assert chosen is None


def test_nothing_is_chosen_where_nothing_is_significant():
    state = start(score("a", p_value=0.5))
    after, chosen = choose(Script(), state)
    assert chosen is None and after.decisions == ()


def test_an_effect_enters_with_its_way_of_confirmation():
    problem = Script()
    confirmed = problem.confirm(score("a"), start())
    state = enter(problem, start(score("a")), confirmed)
    assert state.model.names == ("declared", "a")
    assert state.steps[0].confirmed is Confirmed.LATER_PARTS
    assert state.decisions[-1] == Decision("a", Reason.ENTERED)


def test_the_search_adds_effects_until_none_is_left_without_a_look_at_the_hold_out_set():
    problem = Script([Round((score("a"), score("b"))), Round((score("b"),)), Round((score("c", p_value=0.5),))])
    told = []
    state = search(problem, start(), progress=lambda done, total, what: told.append((done, total, what)))
    assert [step.effect for step in state.steps] == ["a", "b"]
    assert state.model.names == ("declared", "a", "b")
    assert problem.hold_out_asked == []
    assert len(state.rounds) == 3
    assert told == [(number, 6, f"searching for effect {number}") for number in (1, 2, 3)]
    # An effect keeps the round in which it was chosen.
    assert [len(step.round.scores) for step in state.steps] == [2, 1]


def test_the_search_ends_after_four_effects():
    problem = Script([Round((score(name),)) for name in "abcde"])
    state = search(problem, start())
    assert [step.effect for step in state.steps] == ["a", "b", "c", "d"]
    assert len(problem.rounds) == 1


@pytest.mark.parametrize(("loss", "left"), [(1.99, ["b"]), (2.0, ["a", "b"])])
def test_an_effect_that_a_later_one_makes_superfluous_is_dropped(loss, left):
    problem = Script(losses={"a": loss, "b": 0.0})
    state = drop_superfluous(problem, with_steps(problem, "a", "b"))
    # The newest effect is not held against itself.
    assert [step.effect for step in state.steps] == left
    if left == ["b"]:
        assert state.decisions[-1] == Decision("a", Reason.SUPERFLUOUS, {"loss": loss})
        assert state.model.names == ("declared", "b")


def test_superfluous_effects_are_dropped_one_after_the_other():
    """Without the first the second is needed again."""
    problem = Script(losses={"a": 1.0, "b": 1.0})
    problem.loss_without = lambda model, term: 1.0 if {"a", "b"} <= set(model.names) else 50.0
    state = drop_superfluous(problem, with_steps(problem, "a", "b", "c"))
    assert [step.effect for step in state.steps] == ["b", "c"]


def test_steps_before_the_first_that_may_be_dropped_stay():
    problem = Script(losses={"a": 1.0, "b": 1.0})
    state = drop_superfluous(problem, with_steps(problem, "a", "b", "c"), first=1)
    assert [step.effect for step in state.steps] == ["a", "c"]


def test_three_events_are_a_switching_without_a_name():
    rounds = [Round((score("step_event"),)), Round((score("a"),)), *[Round((score("step_event"),))] * 2]
    state = search(Script(rounds), start())
    assert [step.effect for step in state.steps] == ["a"]
    assert state.decisions[-1] == Decision("step_event", Reason.TOO_MANY_EVENTS, {"most": 2, "search_p": 0.001})
    assert state.model.names == ("declared", "a")


def test_two_events_may_happen():
    state = search(Script([Round((score("step_event"),))] * 2), start())
    assert [step.effect for step in state.steps] == ["step_event", "step_event"]


def test_the_hold_out_set_is_opened_once_and_decides_nothing():
    """Every effect makes the error larger: that is what is reported, and every one stays."""
    problem = Script(error=lambda names: 2.0 ** len(names))
    before = with_steps(problem, "a", "b")
    state = open_hold_out(problem, before)
    assert state.errors_um == (2.0, 4.0, 8.0)
    assert state.errors_without_um == (4.0, 4.0)
    assert problem.hold_out_asked == [
        ("declared",),
        ("declared", "a"),
        ("declared", "a", "b"),
        ("declared", "b"),
        ("declared", "a"),
    ]
    assert (state.steps, state.decisions, state.model) == (before.steps, before.decisions, before.model)


def test_withdrawing_asks_the_hold_out_set_nothing():
    problem = Script()
    state = withdraw(problem, with_steps(problem, "a", "b"), [0], [])
    assert [step.effect for step in state.steps] == ["b"] and problem.hold_out_asked == []


def test_progress_need_not_be_watched(capsys):
    no_progress(1, 2, "searching")
    assert capsys.readouterr().out == ""


def test_an_effect_that_does_not_predict_later_parts_is_told_with_both_errors():
    failed = replace(score("a", p_value=0.003), confirmation=Confirmation(False, Confirmed.LATER_PARTS, error_um=0.9))
    evidence = {"p_value": 0.003, "before_um": 0.8, "after_um": 0.9}
    assert not_confirmed(failed, Round((failed,), start_error_um=0.8)) == Decision("a", Reason.NOT_PREDICTED, evidence)
    for confirmation in (None, Confirmation(False, Confirmed.LATER_CYCLES)):
        unpredicted = replace(failed, confirmation=confirmation)
        assert not_confirmed(unpredicted, Round((unpredicted,))) == Decision(
            "a", Reason.NOT_CONFIRMED, {"p_value": 0.003}
        )
