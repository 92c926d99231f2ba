"""The procedure on a problem whose scores, confirmations and hold-out errors are written down beforehand."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from string import Formatter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fusion
import fusion.analysis.drift_model.search as scoring_module
import thermography.large_arrays as spool_module
from fusion.analysis.drift_model.gains import Gains
from fusion.analysis.drift_model.model import Term
from fusion.analysis.drift_model.null_simulation import critical_gain, sidak, sidak_level, tail_probability
from fusion.analysis.drift_model.search import (
    Confirmation,
    Confirmed,
    Decision,
    LoopState,
    Reason,
    Round,
    Score,
    SearchError,
    Step,
    choose,
    collect_candidates,
    conditional_p_value,
    drop_superfluous,
    enter,
    kept_on_disk,
    not_confirmed,
    of_same_kind,
    open_hold_out,
    parameter_ranges,
    refine,
    rivals,
    score_effects,
    search,
)
from fusion.analysis.effects.effect import Candidate, Separable
from fusion.report.wording import parameters
from fusion.results.loop import Nothing
from thermofuse.resources import vocabulary

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

    entry_level = LEVEL

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


@pytest.mark.parametrize(
    ("p_value", "level", "name"),
    [(LEVEL, None, "a"), (LEVEL * 1.001, None, "b"), (0.01, 0.005, "b"), (0.04, 0.05, "a")],
)
def test_an_effect_enters_up_to_the_level_or_another_that_is_asked_for(p_value, level, name):
    _, chosen = choose(Script(), start(score("a", 20.0, p_value), score("b", 19.0)), level=level)
    assert chosen.name == name


def test_an_effect_without_a_candidate_or_withdrawn_for_good_is_passed_over():
    scores = (replace(score("none"), candidate=None), score("wrong"), score("good"))
    state = start(*scores).decide(Decision("wrong", Reason.INCONSISTENT_PATTERN, {"p_value": 0.1}))
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
    assert [other.reason for other in others] == ([] if name else [Reason.WEAKER_THAN_UNCONFIRMED])


def test_a_much_weaker_lasting_effect_may_stand_in_for_one_that_was_not_confirmed():
    _, chosen = choose(Script(not_confirmed=frozenset({"a"})), start(score("a", 20.0), score("b", 16.9)))
    assert chosen is None


def test_what_a_weaker_effect_gains_is_measured_with_both_in_the_model():
    asked = []
    problem = Script()
    problem.loss_without = lambda model, term: asked.append((model.names, term.effect)) or 28.0
    model = Model((Term("declared", CANDIDATE),))
    p_value = conditional_p_value(problem, model, replace(score("b"), gain=30.0), score("a"))
    assert p_value == pytest.approx(0.001 * math.exp(2.0))
    assert asked == [(("declared", "a", "b"), "b")]


def test_the_strongest_of_those_not_confirmed_sets_the_limit():
    problem = Script(not_confirmed=frozenset({"a", "b"}), losses={"c": 0.0})
    scores = (score("a", 20.0), score("b", 18.0), replace(score("c", 16.0), gain=30.0, candidate=EVENT))
    _, chosen = choose(problem, start(*scores))
    assert chosen is None


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


@given(
    offered=st.lists(st.sampled_from("abc"), min_size=4, max_size=4),
    replaces=st.sets(st.tuples(st.sampled_from("abc"), st.sampled_from("abc"))),
)
def test_whatever_replaces_what_no_model_is_held_twice(offered, replaces):
    """The model after each round, for any scores and any losses; an effect that leads back ends the search."""
    held = []
    for rounds in range(len(offered) + 1):
        problem = Script([Round((score(name),)) for name in offered[:rounds]])
        problem.loss_without = lambda model, term: 0.0 if (model.names[-1], term.effect) in replaces else 50.0
        held.append(tuple(sorted(search(problem, start()).model.names)))
        assert problem.asked.count("score") <= 4
    distinct = [one for place, one in enumerate(held) if place == 0 or one != held[place - 1]]
    assert len(distinct) == len(set(distinct))


def test_of_two_effects_that_replace_each_other_the_later_stays():
    problem = Script([Round((score(name),)) for name in "abab"])
    problem.loss_without = lambda model, term: 0.0
    state = search(problem, start())
    assert [step.effect for step in state.steps] == ["b"] and len(state.rounds) == 3


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


def test_an_effect_that_does_not_predict_later_parts_is_told_with_both_errors():
    failed = replace(score("a", p_value=0.003), confirmation=Confirmation(False, Confirmed.LATER_PARTS, error_um=0.9))
    evidence = {"p_value": 0.003, "before_um": 0.8, "after_um": 0.9}
    assert not_confirmed(failed, Round((failed,), start_error_um=0.8)) == Decision("a", Reason.NOT_PREDICTED, evidence)
    for confirmation in (None, Confirmation(False, Confirmed.LATER_CYCLES)):
        unpredicted = replace(failed, confirmation=confirmation)
        assert not_confirmed(unpredicted, Round((unpredicted,))) == Decision(
            "a", Reason.NOT_CONFIRMED, {"p_value": 0.003}
        )


# Decisions: every reason has a sentence whose fields are given wherever it is decided, and a place in the procedure.


def decided(tree: ast.Module) -> Iterator[tuple[Reason, set[str]]]:
    """Reasons of every ``Decision(effect, Reason.X, evidence)`` in a module, with the names given anywhere in its function."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        nodes = list(ast.walk(function))
        names = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        names |= {node.arg for node in nodes if isinstance(node, ast.keyword) and node.arg}
        for node in nodes:
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Decision":
                yield Reason[node.args[1].attr], names


def test_every_reason_is_decided_with_the_fields_of_its_sentence():
    raised: dict[Reason, int] = dict.fromkeys(Reason, 0)
    for path in Path(fusion.__file__).parent.rglob("*.py"):
        for reason, names in decided(ast.parse(path.read_text(encoding="utf-8"))):
            raised[reason] += 1
            asked = {name for _, name, _, _ in Formatter().parse(vocabulary("closed_loop")["decision"][reason]) if name}
            assert names >= asked, f"{path.name}: {reason}"
    assert all(raised.values()), raised


# Scores: the best candidate of each effect against its null, the closer look, and candidates that cannot be used.


def candidate(place: float = 0.0, **words: str) -> Candidate:
    return Candidate(np.zeros((3, 1)), {"place": place, **words}, ("um",))


def gains_of(measured: list[float], null: np.ndarray, *, separable: list[bool] | None = None) -> Gains:
    """Gains of some candidates for the measured response and (candidates, draws) simulated ones."""
    count = len(measured)
    return Gains(
        np.column_stack([measured, null]),
        np.arange(count) + 10,
        np.ones(count, bool) if separable is None else np.array(separable),
    )


def test_an_effect_is_scored_by_its_best_candidate_against_the_best_of_every_draw(rng):
    null = rng.exponential(1.0, (5, 100))
    families = {"a": [candidate(0), candidate(1)], "b": [candidate(2), candidate(3), candidate(4)]}
    gains = gains_of([4.0, 3.0, 1.0, 6.0, 2.0], null)
    scores, decisions = score_effects(families, gains, level=0.015)
    assert decisions == []
    by_name = {score.name: score for score in scores}
    for name, rows, best, gain in (("a", [0, 1], 0, 4.0), ("b", [2, 3, 4], 3, 6.0)):
        of_chance = null[rows].max(axis=0)
        score = by_name[name]
        assert score.candidate is families[name][best - rows[0]]
        assert score.gain == gain
        assert score.excess == pytest.approx(gain - of_chance.mean())
        assert score.p_value == tail_probability(gain, of_chance)
        # Two effects were tried.
        assert score.family_wise_p == sidak(score.p_value, 2)
        assert score.critical == critical_gain(sidak_level(0.015, 2), of_chance)
        assert score.drift_place == 10 + best
        assert score.collinear == 0.0 and score.confirmation is None
    assert [score.excess for score in scores] == sorted((score.excess for score in scores), reverse=True)


def test_a_candidate_that_the_model_holds_is_not_chosen_and_a_collinear_effect_is_said_to_be(rng):
    null = rng.exponential(1.0, (4, 50))
    families = {"a": [candidate(0), candidate(1)], "constant": [candidate(2), candidate(3)]}
    gains = gains_of([9.0, 3.0, 8.0, 8.0], null, separable=[False, True, False, False])
    scores, (decision,) = score_effects(families, gains, level=0.015)
    first, constant = scores
    assert first.candidate is families["a"][1] and first.gain == 3.0 and first.collinear == 0.5
    assert first.excess == pytest.approx(3.0 - null[1].mean())
    # It counts among the effects that were tried.
    assert first.family_wise_p == sidak(first.p_value, 2)
    assert (constant.name, constant.candidate, constant.collinear) == ("constant", None, 1.0)
    assert (constant.gain, constant.p_value, constant.critical) == (0.0, 1.0, np.inf)
    assert (decision.effect, decision.reason) == ("constant", Reason.COLLINEAR)


class Landscape:
    """Candidates on a line whose gain is given; every look offers the neighbours one step away."""

    def __init__(self, gain: dict[float, float], *, separable: frozenset[float] | None = None) -> None:
        self.gain, self.separable = gain, frozenset(gain) if separable is None else separable
        self.looked_at: list[float] = []

    def near(self, chosen: Candidate) -> list[Candidate]:
        place = float(chosen.parameters["place"])
        self.looked_at.append(place)
        return [candidate(place + step) for step in (-1.0, 0.0, 1.0) if place + step in self.gain]

    def gains(self, candidates: list[Candidate]) -> Gains:
        places = [float(one.parameters["place"]) for one in candidates]
        return Gains(
            np.array([[self.gain[place]] for place in places]),
            np.array(places, int),
            np.array([place in self.separable for place in places]),
        )


def refined(landscape: Landscape, start: float = 0.0) -> Score:
    score = Score("a", candidate(start), gain=landscape.gain[start], excess=1.0, p_value=0.01)
    return refine(score, landscape.near, landscape.gains)


def test_a_closer_look_moves_while_the_gain_grows_but_three_times_at_most():
    landscape = Landscape({0.0: 5.0, 1.0: 6.0, 2.0: 7.0, 3.0: 8.0, 4.0: 9.0})
    score = refined(landscape)
    assert landscape.looked_at == [0.0, 1.0, 2.0]
    assert score.candidate.parameters["place"] == 3.0 and score.gain == 8.0
    # The p-value stays that of the coarse search; the excess grows with the gain.
    assert score.excess == pytest.approx(4.0) and score.p_value == 0.01
    assert score.drift_place == 3
    # At the last look, about 2: 1 fits worse than the best by 2, 2 by 1; what lies beyond 3 was not looked at.
    assert score.ranges == {"place": [1.0, None]}


@pytest.mark.parametrize(("more", "looks"), [(0.09, [0.0]), (0.11, [0.0, 1.0])])
def test_a_closer_look_stops_where_a_step_brings_less_than_a_tenth(more, looks):
    landscape = Landscape({-1.0: 0.0, 0.0: 5.0, 1.0: 5.0 + more, 2.0: 0.0})
    score = refined(landscape)
    assert landscape.looked_at == looks
    # The better neighbour is taken all the same.
    assert score.candidate.parameters["place"] == 1.0


def test_a_closer_look_does_not_move_to_what_the_model_holds_or_to_what_is_worse():
    held = Landscape({0.0: 5.0, 1.0: 9.0}, separable=frozenset({0.0}))
    assert refined(held).candidate.parameters["place"] == 0.0
    nothing = Landscape({0.0: 5.0, 1.0: 9.0}, separable=frozenset())
    assert refined(nothing).gain == 5.0
    worse = Landscape({4.0: 4.0, 5.0: 5.0, 6.0: 3.0})
    score = refined(worse, 5.0)
    assert (score.gain, worse.looked_at) == (5.0, [5.0])
    assert score.ranges == {"place": [None, 6.0]}


def test_a_candidate_without_neighbours_keeps_its_place():
    chosen = candidate(3.0)
    tried = [({"place": place}, gain) for place, gain in ((1.0, 1.0), (2.0, 4.9), (3.0, 5.0), (4.0, 1.0))]
    score = refine(Score("own", chosen, gain=5.0, tried=tried), lambda chosen: [], Landscape({}).gains)
    assert score.candidate is chosen and score.gain == 5.0 and score.ranges == {"place": [1.0, 4.0]}


def test_candidates_are_of_one_kind_where_only_open_words_and_numbers_differ():
    chosen = candidate(1.0, shape="flat", follows="duty", start="settled", possible_leads="7 mm", chain="5 min")
    assert of_same_kind(candidate(2.0, shape="flat"), chosen)
    assert of_same_kind(candidate(1.0, shape="flat", follows="warm_up", start="at rest", chain="6 min"), chosen)
    assert not of_same_kind(candidate(1.0, shape="linear"), chosen)
    assert not of_same_kind(candidate(1.0), chosen)


@pytest.mark.parametrize(
    ("columns", "units", "words"),
    [
        (np.zeros(3), ("um",), r"columns have shape \(3,\); expected \(3, columns\)"),
        (np.zeros((4, 1)), ("um",), r"columns have shape \(4, 1\); expected \(3, columns\)"),
        (np.array([[0.0], [np.nan], [np.inf]]), ("um",), r"2 values are not finite at \{'minutes': 5.0\}"),
        (np.zeros((3, 2)), ("um",), r"2 columns but 1 units at \{'minutes': 5.0\}"),
    ],
)
def test_unusable_columns_of_a_user_are_recorded_and_those_of_the_library_raised(columns, units, words):
    offers = {"own": lambda: [Candidate(columns, {"minutes": 5.0}, units)], "good": lambda: [candidate(0)]}
    families, (decision,) = collect_candidates(offers, 3, built_in=frozenset())
    assert list(families) == ["good"]
    assert (decision.effect, decision.reason) == ("own", Reason.NOT_COMPUTABLE)
    with pytest.raises(SearchError, match=words) as fault:
        collect_candidates(offers, 3, built_in=frozenset({"own"}))
    assert decision.evidence["because"] == f"SearchError: {fault.value}"


def test_columns_of_many_candidates_are_kept_on_disk_with_the_same_values(monkeypatch, rng):
    for module in (scoring_module, spool_module):
        monkeypatch.setattr(module, "IN_MEMORY_BYTES", 200)
    steps = Separable((np.arange(8.0),), np.zeros(8, int), np.ones((1, 1)))
    made = [Candidate(rng.normal(size=(8, 2)), {"place": float(k)}, ("um", "um")) for k in range(5)]
    made[1:1] = [Candidate(steps, {"place": 9.0}, ("um",))]
    kept = list(kept_on_disk(iter(made)))
    assert [one.parameters for one in kept] == [one.parameters for one in made]
    assert kept[1].columns is steps
    assert all((np.asarray(one.columns) == np.asarray(own.columns)).all() for one, own in zip(kept, made, strict=True))
    # Two of 128 bytes at a time; the last is alone.
    on_disk = [isinstance(getattr(one.columns, "base", None), np.ndarray) for one in kept]
    assert on_disk == [True, False, True, True, True, False]


# The state of the loop: every method returns a new value and leaves the old one as it was.


def terms(*names: str) -> tuple[Term, ...]:
    return tuple(Term(name, CANDIDATE) for name in names)


def scored_as(name: str, excess: float = 10.0, **changes) -> Score:
    return Score(name, CANDIDATE, excess=excess, **changes)


def searched() -> LoopState[Model]:
    """Two declared effects and two that were added, of which one is an event."""
    first, second = scored_as("dead_path"), scored_as("step_event", p_value=0.5)
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


def test_an_effect_enters_with_the_round_in_which_it_was_chosen():
    state = searched().scored(Round((scored_as("a"),))).scored(Round((scored_as("air_index"),)))
    chosen, model = scored_as("air_index"), Model(terms("a", "b", "c", "d", "air_index"))
    after = state.entered(model, chosen, Confirmed.SECOND_SEARCH)
    assert after.steps[:2] == state.steps
    assert after.steps[2] == Step(chosen, state.rounds[-1], Confirmed.SECOND_SEARCH)
    assert after.steps[2].is_from_second_search and not after.steps[0].is_from_second_search
    assert after.model is model
    assert after.decisions[-1] == Decision("air_index", Reason.ENTERED)


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
    assert state.latest["a"].reason is Reason.AT_SWITCHING and "nothing" not in state.latest
    entered = state.decide(Decision("a", Reason.ENTERED))
    assert set(entered.blocked()) == {"b"} and entered.latest["a"].reason is Reason.ENTERED


def test_only_a_final_decision_keeps_an_effect_out():
    state = LoopState(Model(()))
    assert not state.is_withdrawn("a")
    blocked = state.decide(Decision("a", Reason.AT_SWITCHING))
    assert not blocked.is_withdrawn("a")
    final = blocked.decide(Decision("a", Reason.INCONSISTENT_PATTERN))
    assert final.is_withdrawn("a") and not final.is_withdrawn("b")
    assert not final.decide(Decision("a", Reason.COLLINEAR)).is_withdrawn("a")


def test_the_best_candidate_of_a_score_and_whether_it_is_an_event():
    assert scored_as("a").best is CANDIDATE and not scored_as("a").is_event
    event = replace(scored_as("a"), candidate=replace(CANDIDATE, event_s=0.0))
    assert event.is_event
    none = Score("constant", None)
    assert not none.is_event
    with pytest.raises(SearchError, match="'constant' has no candidate that is independent of the model"):
        _ = none.best


def test_effects_within_three_units_that_are_significant_by_themselves_are_tied():
    chosen = scored_as("chosen", 10.0)
    others = (
        scored_as("close", 7.1, p_value=0.049, family_wise_p=0.3),
        scored_as("at the limit", 7.0, p_value=0.001),
        scored_as("by chance", 9.0, p_value=0.05),
        Score("collinear", None, excess=9.9, p_value=0.0),
        scored_as("better", 11.0, p_value=0.01),
    )
    tied, runner_up = rivals(chosen, (chosen, *others))
    assert tied == ["close", "better"]
    assert runner_up.model_dump() == {"effect": "close", "gain_deficit": pytest.approx(2.9), "p_value": 0.3}


def test_effects_tie_that_differ_by_less_than_a_shape_of_the_library_differs_from_a_machine():
    """Twelve units behind is nothing where the effect is ten thousand units large, unless the rival had more chances to fit as well."""
    chosen = replace(scored_as("chosen", 900.0), gain=901.0)
    rival = replace(scored_as("rival", 888.0, p_value=0.001), gain=889.0)
    assert rivals(chosen, (chosen, rival))[0] == []
    assert rivals(chosen, (chosen, rival), 1e4)[0] == ["rival"]
    searched = replace(rival, excess=885.0)
    assert rivals(chosen, (chosen, searched), 1e4)[0] == []
    better = replace(rival, gain=920.0, excess=919.0)
    assert rivals(chosen, (chosen, better), 1e4)[0] == ["rival"]


def test_an_effect_without_rivals_has_no_runner_up():
    chosen = scored_as("chosen")
    assert rivals(chosen, (chosen, Score("collinear", None))) == ([], Nothing())


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
        Decision("e", Reason.INCONSISTENT_PATTERN, {"p_value": 1e-5, "search_p": 1e-12}),
        Decision("step_event", Reason.ENTERED),
    )
    # What was significant before an effect entered counts only where it still is; a withdrawn name counts whatever came later.
    assert state.scored(last).unnamed(1e-3) == {"b": 1e-3, "e": 1e-12}
    assert LoopState(Model(())).unnamed(1e-3) == {}


# How well nonlinear parameters are known, by profile likelihood.


def varied(name: str, *values: float, **words: str) -> list[Candidate]:
    """Candidates that differ in one number."""
    return [Candidate(np.empty((0, 1)), {**words, name: value}, ("um",)) for value in values]


def states(*minutes: float, follows: str = "duty") -> list[Candidate]:
    return varied("time_constant_min", *minutes, follows=follows)


@pytest.mark.parametrize(
    ("near", "gains", "best", "expected"),
    [
        # A range ends where the likelihood has fallen by two, and is open where the neighbourhood ends first.
        (states(10, 20, 30, 40, 50), [1.0, 8.5, 10.0, 9.0, 7.0], 2, {"time_constant_min": [10.0, 50.0]}),
        (states(10, 20, 30), [9.0, 10.0, 9.5], 1, {"time_constant_min": [None, None]}),
        (states(10, 20, 30), [5.0, 9.9, 10.0], 2, {"time_constant_min": [10.0, None]}),
        # A value fits as well within half a chi-squared of one degree, 1.92.
        (states(10, 20, 30), [0.0, 10.0 - 1.91, 10.0], 2, {"time_constant_min": [10.0, None]}),
        (states(10, 20, 30), [0.0, 10.0 - 1.93, 10.0], 2, {"time_constant_min": [20.0, None]}),
        # Rounding of a very large likelihood may leave the best alone below itself.
        (states(10, 20, 30), [0.0, 7.0, 0.0], 1, {"time_constant_min": [10.0, 30.0]}),
        # A size may be negative.
        (varied("jump", -20.0, -5.0, 5.0), [10.0, 0.0, 0.0], 0, {"jump": [None, -5.0]}),
        (varied("jump", -20.0, -5.0, 5.0), [0.0, 10.0, 0.0], 1, {"jump": [-20.0, 5.0]}),
        # A time of zero is the lowest, and an absent body has it.
        (
            [Candidate(np.empty((0, 1)), {}, ("um",)), *varied("second_time_constant_min", 5.0)],
            [9.0, 10.0],
            1,
            {"second_time_constant_min": [0.0, None]},
        ),
        # Values that were computed twice are one, and derived words have no range.
        (
            [
                *varied("period_mm", 100.0 * (1.0 - 1e-7), possible_leads="a"),
                *varied("period_mm", 100.0, 120.0, possible_leads="b"),
            ],
            [2.0, 10.0, 2.0],
            1,
            {"period_mm": [None, 120.0]},
        ),
        (varied("period_mm", 100.0, possible_leads="b"), [10.0], 0, {}),
        # A state that fits as well is told and does not widen the numbers.
        (
            [*states(10, 20, 30), *states(80, follows="warm_up"), *states(90, follows="mean_rise")],
            [5.0, 10.0, 5.0, 9.0, 7.9],
            1,
            {"follows": ["warm_up"], "time_constant_min": [10.0, 30.0]},
        ),
    ],
)
def test_a_range_holds_the_values_that_fit_as_well(near, gains, best, expected):
    tried = [(one.parameters, gain) for one, gain in zip(near, gains, strict=True)]
    assert parameter_ranges(tried, near[best].parameters, 10.0) == expected


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({}, "follows duty, time constant 20.0 min"),
        (
            {"follows": ["warm_up"], "time_constant_min": [10.0, 30.0]},
            "follows duty (or warm up), time constant 20.0 min (10.0 to 30.0)",
        ),
        ({"time_constant_min": [None, 30.0]}, "follows duty, time constant 20.0 min (at most 30.0)"),
        ({"time_constant_min": [10.0, None]}, "follows duty, time constant 20.0 min (at least 10.0)"),
        ({"time_constant_min": [None, None]}, "follows duty, time constant 20.0 min (not determined)"),
    ],
)
def test_ranges_are_printed_beside_the_values(ranges, words):
    assert parameters({"follows": "duty", "time_constant_min": 20.0}, ranges) == words
