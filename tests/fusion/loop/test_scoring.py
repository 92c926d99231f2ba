"""Scores: the best candidate of each effect against its null, the closer look, and candidates that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

import fusion.loop.scoring as scoring_module
import thermography.fields.tasks.spool as spool_module
from fusion.effects.effect import Candidate, Separable
from fusion.loop.decisions import Reason
from fusion.loop.scoring import Gains, collect_candidates, kept_on_disk, of_same_kind, refine, score_effects
from fusion.loop.state import Score, SearchError
from fusion.model.null_simulation import critical_gain, sidak, sidak_level, tail_probability


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


def test_an_effect_that_the_model_holds_does_not_end_the_scores_of_the_others(rng):
    families = {"a": [candidate(0)], "constant": [candidate(1)], "b": [candidate(2)]}
    gains = gains_of([3.0, 8.0, 5.0], rng.exponential(1.0, (3, 50)), separable=[True, False, True])
    scores, decisions = score_effects(families, gains, level=0.015)
    assert {score.name for score in scores} == {"a", "b", "constant"}
    assert [decision.effect for decision in decisions] == ["constant"]


def test_a_closer_look_raises_gain_and_excess_by_the_same_and_leaves_the_p_value():
    """A candidate of gain 4 and excess 2.5, whose neighbour gains 5.5: excess 4."""
    coarse = Score("a", candidate(0), 4.0, 2.5, 0.01, 0.02, 0.0, 10, 3.0)
    neighbours = [candidate(1), candidate(2)]
    score = refine(coarse, lambda _: neighbours, lambda looked: gains_of([3.0, 5.5], np.zeros((2, 0))))
    assert (score.candidate, score.gain, score.excess) == (neighbours[1], 5.5, 4.0)
    assert (score.p_value, score.family_wise_p, score.drift_place) == (0.01, 0.02, 11)
    # A neighbour that the model holds does not hide the next best, and one that is worse is not taken.
    held = refine(
        coarse, lambda _: neighbours, lambda looked: gains_of([9.0, 5.5], np.zeros((2, 0)), separable=[False, True])
    )
    assert (held.candidate, held.gain) == (neighbours[1], 5.5)
    worse = refine(coarse, lambda _: neighbours, lambda looked: gains_of([3.0, 3.5], np.zeros((2, 0))))
    assert (worse.candidate, worse.gain) == (coarse.candidate, 4.0)


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


def test_an_effect_without_neighbours_breaks_its_contract():
    score = Score("own", candidate(3.0), gain=5.0)
    with pytest.raises(SearchError, match=r"'own' offers no candidate near one it offered before: \{'place': 3.0\}"):
        refine(score, lambda chosen: [], Landscape({}).gains)


def test_candidates_are_of_one_kind_where_only_open_words_and_numbers_differ():
    chosen = candidate(1.0, shape="flat", follows="duty", start="settled", possible_leads="7 mm", chain="5 min")
    assert of_same_kind(candidate(2.0, shape="flat"), chosen)
    assert of_same_kind(candidate(1.0, shape="flat", follows="warm_up", start="at rest", chain="6 min"), chosen)
    assert not of_same_kind(candidate(1.0, shape="linear"), chosen)
    assert not of_same_kind(candidate(1.0), chosen)


def test_candidates_are_collected_in_order():
    families, decisions = collect_candidates(
        {"a": lambda: [candidate(0)], "b": lambda: iter([candidate(1), candidate(2)])}, 3, built_in=frozenset()
    )
    assert {name: len(candidates) for name, candidates in families.items()} == {"a": 1, "b": 2}
    assert decisions == []


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
    offers = {
        "own": lambda: [Candidate(columns, {"minutes": 5.0}, units)],
        "good": lambda: [candidate(0)],
    }
    families, (decision,) = collect_candidates(offers, 3, built_in=frozenset())
    assert list(families) == ["good"]
    assert (decision.effect, decision.reason) == ("own", Reason.NOT_COMPUTABLE)
    with pytest.raises(SearchError, match=words) as fault:
        collect_candidates(offers, 3, built_in=frozenset({"own"}))
    assert decision.evidence["because"] == f"SearchError: {fault.value}"


def test_any_fault_of_a_users_effect_is_recorded():
    def broken():
        raise KeyError("no such series")

    families, (decision,) = collect_candidates({"own": broken}, 3, built_in=frozenset())
    assert families == {} and decision.sentence.endswith("KeyError: 'no such series'")


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
