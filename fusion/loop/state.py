"""State of the closed loop: an immutable value that every step takes and returns.

A campaign along an axis and a record of channels have models of their own; everything else of the state is the same.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

import numpy as np

from fusion.effects.effect import Candidate
from fusion.errors import FusionError
from fusion.loop.decisions import BLOCKING, FINAL, NOT_TRIED, WITHDRAWN, WITHHELD, Decision, Reason
from fusion.loop.parameter_ranges import Range
from fusion.model.fit import Term

#: Effects whose log-likelihoods differ by less than this (odds of 20 to 1) are reported as a tie.
TIE_GAIN = 3.0
#: An effect that is not significant by itself is no rival.
_RIVAL_LEVEL = 0.05


class SearchError(FusionError):
    """An effect does not keep its contract; the message names it."""


class Confirmed(StrEnum):
    """How an added effect was confirmed."""

    LATER_CYCLES = "confirmed on later blocks of cycles, coefficients frozen"
    OTHER_TARGETS = "confirmed on the other half of the targets, coefficients frozen"
    BY_EVIDENCE = "confirmed by the evidence of all training cycles; their later blocks alone do not decide"
    SECOND_LOOK = "found in all cycles after the hold-out set was opened: it has no held-out error"
    LATER_PARTS = "confirmed on later parts of the training time, each predicted from those before it"


@dataclass(frozen=True)
class Confirmation:
    """How an effect did on readings that its coefficients were not fitted to.

    Attributes
    ----------
    passed : whether it may enter
    way : how it was asked
    gain, p_value : gain in predictive log-density, and the probability of such a gain under the null hypothesis
    error_um : error of predicting later parts of the training time with it, um; NaN where this was not computed
    """

    passed: bool
    way: Confirmed
    gain: float = 0.0
    p_value: float = 1.0
    error_um: float = np.nan


@dataclass(frozen=True)
class Score:
    """What the best candidate of an effect explains.

    Attributes
    ----------
    name : the effect
    candidate : its best candidate, None where no candidate is independent of the model
    gain : gain in profile log-likelihood of the best candidate
    excess : gain minus the mean gain that the same search finds under the null hypothesis
    p_value : probability of such a gain under the null hypothesis, for this effect alone
    family_wise_p : the same for the best of all effects that were tried
    collinear : share of the candidates that the model contains already
    drift_place : which drift variance of the grid suits the candidate best
    critical : gain at which the effect becomes significant
    confirmation : on readings that were not used for the coefficients, None where it was not worth asking
    ranges : values of the parameters that fit as well (profile likelihood, 95 %), where they were looked at closely
    """

    name: str
    candidate: Candidate | None
    gain: float = 0.0
    excess: float = 0.0
    p_value: float = 1.0
    family_wise_p: float = 1.0
    collinear: float = 0.0
    drift_place: int = 0
    critical: float = np.inf
    confirmation: Confirmation | None = None
    ranges: Mapping[str, Range] = field(default_factory=dict)

    @property
    def best(self) -> Candidate:
        """The best candidate.

        Raises
        ------
        SearchError
            if the effect has none that is independent of the model.
        """
        if self.candidate is None:
            raise SearchError(f"effect {self.name!r} has no candidate that is independent of the model")
        return self.candidate

    @property
    def is_event(self) -> bool:
        """Whether the best candidate acts from one instant on."""
        return self.candidate is not None and self.candidate.event_s is not None


def rivals(score: Score, scores: Sequence[Score]) -> tuple[list[str], dict[str, float | str]]:
    """Effects that these data cannot separate from the chosen one, and the runner-up.

    Parameters
    ----------
    score : the chosen effect
    scores : all scores of its round, best excess first

    Returns
    -------
    tied : names of the effects within :data:`TIE_GAIN` that are significant by themselves
    runner_up : name of the next best effect, by how much log-likelihood it is behind, and its family-wise p-value; empty without any
    """
    others = [other for other in scores if other.name != score.name and other.candidate is not None]
    tied = [other.name for other in others if other.p_value < _RIVAL_LEVEL and score.excess - other.excess < TIE_GAIN]
    if not others:
        return tied, {}
    behind = score.excess - others[0].excess
    return tied, {"effect": others[0].name, "behind_by": behind, "p_value": others[0].family_wise_p}


@dataclass(frozen=True)
class DetectionLimit:
    """How large an effect must be to be found in these data.

    Attributes
    ----------
    effect : its name
    detectable_um : rms that is found with 80 % power, um: median over the effect's candidates; None where none is independent of the model
    best_um, worst_um : the same for the candidates with the lowest and the highest limit
    visible_share : share of the effect's rms that is left beside static profile and declared effects (median)
    looks_like : other effects of which a candidate explains at least 90 % of its visible variance
    note : what limits the test, empty where nothing does
    """

    effect: str
    detectable_um: float | None
    best_um: float | None
    worst_um: float | None
    visible_share: float
    looks_like: list[str]
    note: str


@dataclass(frozen=True)
class Round:
    """One round of the search.

    Attributes
    ----------
    scores : of all effects that were tried, best excess first
    decisions : about effects that could not be scored
    start_error_um : error of predicting later parts of the training time without a further effect, um; NaN where it is not used
    detection_limits : how large each effect must be to be found; from the first round only
    """

    scores: tuple[Score, ...]
    decisions: tuple[Decision, ...] = ()
    start_error_um: float = np.nan
    detection_limits: tuple[DetectionLimit, ...] = ()


@dataclass(frozen=True)
class Step:
    """An effect that was added: its score, the round in which it was chosen, and how it was confirmed."""

    score: Score
    round: Round
    confirmed: Confirmed

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.score.name

    @property
    def is_late_entry(self) -> bool:
        """Whether it entered after the hold-out set had been opened."""
        return self.confirmed is Confirmed.SECOND_LOOK


@dataclass(frozen=True)
class HoldOutQuestion:
    """What the hold-out set says of the strongest candidate that the search could not decide on; it does not enter, whatever the answer.

    Attributes
    ----------
    effect, parameters : the candidate
    rmse_before_um, rmse_after_um : hold-out error without and with it, um
    p_value : probability of so small an error after it under the null hypothesis
    """

    effect: str
    parameters: Mapping[str, float | str]
    rmse_before_um: float
    rmse_after_um: float
    p_value: float


class Model(Protocol):
    """What the loop asks of a fitted model."""

    @property
    def terms(self) -> tuple[Term, ...]:
        """The effects, declared ones first."""


M = TypeVar("M", bound=Model)


@dataclass(frozen=True)
class LoopState(Generic[M]):
    """Everything the loop has found so far.

    Attributes
    ----------
    model : the fitted model; its terms are the declared effects, then one for each step
    steps : the added effects in turn
    decisions : every decision in turn
    rounds : every round of the search in turn
    errors_um : hold-out error of the declared model and after each step that was decided on the training part, um; empty until the
        hold-out set is opened
    errors_without_um : hold-out error of the last of these models without each of these steps, um
    question : what the hold-out set says of an undecided candidate
    """

    model: M
    steps: tuple[Step, ...] = ()
    decisions: tuple[Decision, ...] = ()
    rounds: tuple[Round, ...] = ()
    errors_um: tuple[float, ...] = ()
    errors_without_um: tuple[float, ...] = ()
    question: HoldOutQuestion | None = None

    @property
    def declared(self) -> tuple[Term, ...]:
        """The declared terms."""
        return self.model.terms[: len(self.model.terms) - len(self.steps)]

    @property
    def added(self) -> tuple[Term, ...]:
        """The terms of the steps."""
        return self.model.terms[len(self.model.terms) - len(self.steps) :]

    @property
    def events(self) -> int:
        """Number of events among the steps."""
        return sum(step.effect == "step_event" for step in self.steps)

    def last(self, effect: str) -> Decision | None:
        """The latest decision about an effect."""
        return next((decision for decision in reversed(self.decisions) if decision.effect == effect), None)

    def not_tried(self) -> dict[str, str]:
        """Effects that could not be tried, with the reason in words."""
        return {one.effect: one.sentence for one in self.decisions if one.reason in NOT_TRIED}

    def blocked(self) -> dict[str, str]:
        """Effects against whose name the latest decision speaks, with the reason in words."""
        latest = {decision.effect: decision for decision in self.decisions}
        return {name: decision.sentence for name, decision in latest.items() if decision.reason in BLOCKING}

    def unnamed(self, level: float) -> dict[str, float]:
        """Effects that are significant and have no name, with their family-wise p-value.

        Significant in the last round at ``level``, or withdrawn for good after they had entered.
        """
        last = self.rounds[-1].scores if self.rounds else ()
        significant = {one.name: one.family_wise_p for one in last if one.candidate and one.family_wise_p <= level}
        latest = {decision.effect: decision for decision in self.decisions}
        return {
            name: significant[name] if name in significant else float(decision.evidence["search_p"])
            for name, decision in latest.items()
            if decision.reason in WITHDRAWN or (decision.reason in WITHHELD and name in significant)
        }

    def is_withdrawn(self, effect: str) -> bool:
        """Whether an effect may not enter any more."""
        latest = self.last(effect)
        return latest is not None and latest.reason in FINAL

    def decide(self, *decisions: Decision) -> LoopState[M]:
        """The same state with further decisions."""
        return replace(self, decisions=(*self.decisions, *decisions))

    def scored(self, scored: Round) -> LoopState[M]:
        """The same state with a further round and its decisions."""
        return replace(self.decide(*scored.decisions), rounds=(*self.rounds, scored))

    def rescored(self, score: Score) -> LoopState[M]:
        """The same state with one score of the last round replaced by a closer look at the same effect."""
        last = self.rounds[-1]
        scores = tuple(score if other.name == score.name else other for other in last.scores)
        return replace(self, rounds=(*self.rounds[:-1], replace(last, scores=scores)))

    def entered(self, model: M, score: Score, confirmed: Confirmed) -> LoopState[M]:
        """The state after an effect was added to the model."""
        step = Step(score, self.rounds[-1], confirmed)
        decided = self.decide(Decision(score.name, Reason.ENTERED))
        return replace(decided, model=model, steps=(*self.steps, step))

    def without(self, places: Collection[int], model: M, decisions: Sequence[Decision]) -> LoopState[M]:
        """The state after some steps were taken out again; ``model`` is fitted without them."""
        steps = tuple(step for place, step in enumerate(self.steps) if place not in places)
        return replace(self.decide(*decisions), model=model, steps=steps)

    def kept(self, places: Collection[int]) -> tuple[Term, ...]:
        """Declared terms and those of the steps that are not among ``places``."""
        return (*self.declared, *(term for place, term in enumerate(self.added) if place not in places))
