"""The closed loop: search the training part for what a model lacks, then open the hold-out set once to report the error before and after.

One procedure for a campaign along an axis and for a record of channels. What differs between them, how candidates are made, fitted, scored
and predicted, is behind :class:`Problem`. An effect enters only if its gain exceeds what the whole search finds under the null hypothesis,
if it is admissible, and if it is confirmed on readings of the training part that its coefficients were not fitted to. The hold-out set
adds nothing: it bears an effect out, contradicts it, or cannot tell. Procedure and error rates: docs/method/closed-loop.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from fusion.analysis.drift_model.gains import Gains
from fusion.analysis.drift_model.model import Term
from fusion.analysis.drift_model.null_simulation import critical_gain, sidak, sidak_level, tail_probability
from fusion.analysis.drift_model.predictions import rmse
from fusion.analysis.effects.effect import Candidate, Effect, Separable, Wave
from fusion.analysis.effects.library import LIBRARY
from fusion.analysis.levels import RIVAL_LEVEL
from fusion.common import Array, FusionError
from fusion.results import loop as schema
from thermofuse.resources import sentence
from thermography.large_arrays import IN_MEMORY_BYTES, copy_to_disk, one_by_one

# Decisions of the search: which effect entered, was refused or was withdrawn, for which reason and on what evidence.


class Reason(StrEnum):
    """Why an effect is in the model, or why it is not."""

    ENTERED = "entered"
    #: Not tried at all.
    NOT_AVAILABLE = "not available"
    NOT_COMPUTABLE = "not computable"
    #: Tried, and not admissible or not confirmed.
    COLLINEAR = "collinear"
    SINGLE_WARM_UP = "single warm-up"
    SINGLE_SWITCHING = "single switching"
    AT_SWITCHING = "at a switching"
    WITH_A_LOAD = "with a load"
    HETEROSCEDASTIC_DRIFT = "heteroscedastic drift"
    TEMPERATURE_NOISE = "temperature noise"
    FOLLOWS_RATE = "follows the rate"
    SMOOTHING = "smoothing"
    UNLOGGED_HEAT = "unlogged heat"
    SENSORS_MISS = "what the sensors miss"
    WITHIN_DIGITS = "within the digits"
    NOT_CONFIRMED = "not confirmed"
    NOT_PREDICTED = "later parts not predicted better"
    WEAKER_THAN_UNCONFIRMED = "weaker than an unconfirmed effect"
    #: In the model for a while, and taken out again.
    SUPERFLUOUS = "superfluous"
    TOO_MANY_EVENTS = "too many events"
    UNLOGGED_LOAD = "unlogged load"
    OWN_COURSE = "a course of its own"
    INCONSISTENT_PATTERN = "inconsistent pattern"
    SHARED_PATTERN = "shared pattern"
    DEPENDS_ON_WITHDRAWN = "depends on a withdrawn effect"
    NOT_REPEATED = "not repeated"


NOT_TRIED = frozenset({Reason.NOT_AVAILABLE, Reason.NOT_COMPUTABLE})
#: Decisions that say nothing against an effect: it is in, the data did not decide, or a later effect does its work.
_NEUTRAL = frozenset({Reason.ENTERED, Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED, Reason.SUPERFLUOUS})
#: Reasons against the name of an effect.
BLOCKING = frozenset(Reason) - NOT_TRIED - _NEUTRAL
#: Reasons that keep an effect out for the rest of the search.
FINAL = frozenset(
    {Reason.INCONSISTENT_PATTERN, Reason.SHARED_PATTERN, Reason.DEPENDS_ON_WITHDRAWN, Reason.NOT_REPEATED}
)
#: Reasons for which an effect that had entered was taken out again without another doing its work.
WITHDRAWN = FINAL | {Reason.TOO_MANY_EVENTS, Reason.UNLOGGED_LOAD, Reason.OWN_COURSE}
#: Reasons for which a significant effect has no name: it shows that something is missing all the same.
WITHHELD = (BLOCKING - {Reason.COLLINEAR, Reason.WITHIN_DIGITS}) | {Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED}

#: Return a sentence of decisions, names withheld and answers, with the numbers and names behind it.
say = partial(sentence, "closed_loop")


@dataclass(frozen=True)
class Decision:
    """What was decided about one effect and why, with the numbers and names behind it, by the fields of the reason's sentence."""

    effect: str
    reason: Reason
    evidence: Mapping[str, float | str] = field(default_factory=dict)

    def on_evidence(self, **evidence: float | str) -> Decision:
        """The same decision with further evidence."""
        return replace(self, evidence={**self.evidence, **evidence})

    @property
    def sentence(self) -> str:
        """The decision in words."""
        return say("decision", self.reason, **self.evidence)


# Values of the nonlinear parameters of an effect that fit as well as the best: profile likelihood intervals.

#: Log-likelihood by which the best may beat a value that a 95 % interval still holds: half of chi-squared, 1 degree of freedom.
_WITHIN = 1.92
#: Values that differ by less than this share are one value, computed twice.
_SAME = 1e-6
#: Words that only spell out a number: what a wave may be mistaken for, its harmonics, and the time constants of a chain of parts.
DERIVED_WORDS = frozenset({"possible_leads", "course", "chain"})

#: Lowest and highest value, None where what was looked at ends before the likelihood has fallen; or the words that fit as well.
Range = list[float | None] | list[str]
Parameters = Mapping[str, float | str]
#: Parameters of a candidate, and what it gains.
Tried = tuple[Parameters, float]


def parameter_ranges(tried: Sequence[Tried], best: Parameters, best_gain: float) -> dict[str, Range]:
    """Values of the parameters that fit as well as the best, by profile likelihood (95 %)."""
    alike = [parameters for parameters, gain in tried if gain >= best_gain - _WITHIN]
    ranges: dict[str, Range] = {}
    # A sine and a course of harmonics have periods of their own.
    derived = DERIVED_WORDS - {"course"}
    words = _words(best, derived)
    for name, value in best.items():
        if name in DERIVED_WORDS:
            continue
        if isinstance(value, str):
            others = {str(parameters[name]) for parameters in alike if name in parameters} - {value}
            if others:
                ranges[name] = sorted(others)
            continue
        # A body that is not there has a time constant of zero.
        values, fitting = (
            np.array([float(one.get(name, 0.0)) for one in some if _words(one, derived) == words])
            for some in ([parameters for parameters, _ in tried], alike)
        )
        if np.unique(values).size > 1:
            # The values next to those that fit: the likelihood falls somewhere between, so the interval is rather too wide.
            low, high = min([value, *fitting]), max([value, *fitting])
            below, above = values[values < low - _SAME * abs(low)], values[values > high + _SAME * abs(high)]
            lowest = float(below.max()) if below.size else 0.0 if low == 0.0 else None
            ranges[name] = [lowest, float(above.min()) if above.size else None]
    return ranges


def _words(parameters: Parameters, left_out: Collection[str]) -> dict[str, str]:
    """Parameters of a candidate that are words."""
    return {name: value for name, value in parameters.items() if isinstance(value, str) and name not in left_out}


# State of the closed loop: an immutable value that every step takes and returns.

#: Effects whose log-likelihoods differ by less than this (odds of 20 to 1) are reported as a tie.
TIE_GAIN = 3.0
#: Share of an effect's rms by which its shape in the library may be wrong on a real machine: root mean square of what 200 bars that conduct
#: heat leave of the best response of one or two lumped bodies (docs/method/closed-loop.md). A difference of this size between two effects
#: is worth no more than a tie, however little noise there is.
DISCREPANCY = 0.066


class SearchError(FusionError):
    """An effect does not keep its contract; the message names it."""


class Confirmed(StrEnum):
    """How an added effect was confirmed."""

    LATER_CYCLES = "confirmed on later blocks of cycles, coefficients frozen"
    OTHER_TARGETS = "confirmed on the other half of the targets, coefficients frozen"
    BY_EVIDENCE = "confirmed by the evidence of all training cycles; their later blocks alone do not decide"
    SECOND_SEARCH = "found in all cycles after the hold-out set was opened: it has no held-out error"
    RAW_READINGS = "out of proportion to all other changes of the raw readings, and confirmed in every other reading"
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
    tried : all candidates of the search, by their parameters
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
    tried: Sequence[Tried] = field(default=(), repr=False)

    @property
    def best(self) -> Candidate:
        """The best candidate."""
        if self.candidate is None:
            raise SearchError(f"effect {self.name!r} has no candidate that is independent of the model")
        return self.candidate

    @property
    def is_confirmed(self) -> bool:
        """Whether it passed its confirmation."""
        return self.confirmation is not None and self.confirmation.passed

    @property
    def error_um(self) -> float:
        """Error of predicting later parts of the training time with it, um; NaN where this was not computed."""
        return self.confirmation.error_um if self.confirmation else np.nan

    @property
    def is_event(self) -> bool:
        """Whether the best candidate acts from one instant on."""
        return self.candidate is not None and self.candidate.event_s is not None

    def described(self) -> dict[str, Any]:
        """What results.json holds of every score, on a record and along an axis."""
        return {
            "effect": self.name,
            "parameters": self.candidate.parameters if self.candidate else {},
            "gain": self.gain,
            "excess_gain": self.excess,
            "p_value": self.p_value,
            "family_wise_p": self.family_wise_p,
        }


def blur(size: float) -> float:
    """How many times less a difference of log-likelihoods counts: every shape is wrong by its discrepancy, whose variance adds to that of
    the noise along the difference of two shapes. ``size`` is as in :func:`rivals`.
    """
    return 1.0 + size * DISCREPANCY**2 / TIE_GAIN


def rivals(
    score: Score, scores: Sequence[Score], size: float = 0.0
) -> tuple[list[str], schema.RunnerUp | schema.Nothing]:
    """Effects that these data cannot separate from the chosen one, and the runner-up; ``size`` is half the square of what the chosen one
    explains, in units of the noise.
    """
    others = [other for other in scores if other.name != score.name and other.candidate is not None]
    blurred = blur(size)

    def is_rival(other: Score) -> bool:
        ahead = score.gain - other.gain
        # What a search among more candidates gains by chance is not blurred.
        chance = (other.gain - other.excess) - (score.gain - score.excess)
        return other.p_value < RIVAL_LEVEL and (ahead / blurred if ahead > 0.0 else ahead) + chance < TIE_GAIN

    tied = [other.name for other in others if is_rival(other)]
    if not others:
        return tied, schema.Nothing()
    behind = score.excess - others[0].excess
    return tied, schema.RunnerUp(effect=others[0].name, gain_deficit=behind, p_value=others[0].family_wise_p)


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
    detection_limits: tuple[schema.DetectionLimit, ...] = ()


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
    def is_from_second_search(self) -> bool:
        """Whether it entered after the hold-out set had been opened."""
        return self.confirmed is Confirmed.SECOND_SEARCH


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
    held : the models that the search has held before this one
    """

    model: M
    steps: tuple[Step, ...] = ()
    decisions: tuple[Decision, ...] = ()
    rounds: tuple[Round, ...] = ()
    errors_um: tuple[float, ...] = ()
    errors_without_um: tuple[float, ...] = ()
    held: frozenset[tuple[str, ...]] = frozenset()

    @property
    def named_terms(self) -> tuple[str, ...]:
        """Effects and parameters of the model, in whatever order they entered."""
        return tuple(sorted(f"{one.effect} {sorted(one.candidate.parameters.items())}" for one in self.model.terms))

    @property
    def declared(self) -> tuple[Term, ...]:
        """The declared terms."""
        return self.model.terms[: len(self.model.terms) - len(self.steps)]

    @property
    def added(self) -> tuple[Term, ...]:
        """The terms of the steps."""
        return self.model.terms[len(self.model.terms) - len(self.steps) :]

    @property
    def chain(self) -> list[tuple[Term, ...]]:
        """The declared terms, then these with the first step, and so on."""
        return [self.model.terms[: len(self.declared) + count] for count in range(len(self.steps) + 1)]

    @property
    def events(self) -> int:
        """Number of events among the steps."""
        return sum(step.effect == "step_event" for step in self.steps)

    @property
    def latest(self) -> dict[str, Decision]:
        """The latest decision about every effect."""
        return {decision.effect: decision for decision in self.decisions}

    def not_tried(self) -> dict[str, str]:
        """Effects that could not be tried, with the reason in words."""
        return {one.effect: one.sentence for one in self.decisions if one.reason in NOT_TRIED}

    def blocked(self) -> dict[str, str]:
        """Effects against whose name the latest decision speaks, with the reason in words."""
        return {name: decision.sentence for name, decision in self.latest.items() if decision.reason in BLOCKING}

    def unnamed(self, level: float) -> dict[str, float]:
        """Effects that are significant and have no name, with their family-wise p-value."""
        last = self.rounds[-1].scores if self.rounds else ()
        significant = {one.name: one.family_wise_p for one in last if one.candidate and one.family_wise_p <= level}
        return {
            name: significant[name] if name in significant else float(decision.evidence["search_p"])
            for name, decision in self.latest.items()
            if decision.reason in WITHDRAWN or (decision.reason in WITHHELD and name in significant)
        }

    def is_withdrawn(self, effect: str) -> bool:
        """Whether an effect may not enter any more."""
        return effect in self.latest and self.latest[effect].reason in FINAL

    def decide(self, *decisions: Decision) -> LoopState[M]:
        """The same state with further decisions."""
        return replace(self, decisions=(*self.decisions, *decisions))

    def without_effects(self, reasons: Mapping[str, str | None]) -> LoopState[M]:
        """The same state without the effects for which there is a reason that they cannot be tried."""
        missing = {name: because for name, because in reasons.items() if because is not None}
        return self.decide(
            *(Decision(name, Reason.NOT_AVAILABLE, {"because": because}) for name, because in missing.items())
        )

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
        return replace(decided, model=model, steps=(*self.steps, step), held=self.held | {self.named_terms})

    def kept(self, places: Collection[int]) -> tuple[Term, ...]:
        """Declared terms and those of the steps that are not among ``places``."""
        return (*self.declared, *(term for place, term in enumerate(self.added) if place not in places))


HOLD_OUT_SHARE = 0.2
MOST_EFFECTS = 4
#: More events than this are a switching that the library has no name for.
MOST_EVENTS = 2
#: An effect whose absence costs less log-likelihood than this is superfluous.
SUPERFLUOUS_GAIN = 2.0

Progress = Callable[[int, int, str], None]


def no_progress(done: int, total: int, what: str) -> None:
    """Report nothing."""


class Problem(ABC, Generic[M]):
    """The data, as the procedure sees them, with the library by name and the family-wise p-value up to which an effect may enter."""

    effects: Mapping[str, Effect]
    entry_level: float

    @abstractmethod
    def refit(self, model: M, terms: Sequence[Term]) -> M:
        """Fit other terms to the readings that ``model`` was fitted to."""

    @abstractmethod
    def offer(self, name: str, model: M, near: Candidate | None) -> list[Candidate]:
        """Candidates of an effect beside a model, for a closer look those near one that was chosen."""

    @abstractmethod
    def score(self, state: LoopState[M]) -> Round:
        """Score the whole library against the model, best excess first."""

    @abstractmethod
    def refuse(self, score: Score, model: M) -> Decision | None:
        """The decision against an effect that is not admissible."""

    def confirm(self, score: Score, state: LoopState[M]) -> Score:
        """The score with its confirmation, unless it was confirmed when it was scored."""
        return score

    @abstractmethod
    def loss_without(self, model: M, term: Term) -> float:
        """Log-likelihood that is lost without one of the model's terms."""

    @abstractmethod
    def hold_out_errors(self, terms: Sequence[Term]) -> Array:
        """Errors of predicting the hold-out set from the training part, um, (n_held_out,) or (n_held_out, channels)."""

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Root mean square of these errors, mean over the channels, um."""
        return rmse(self.hold_out_errors(terms))

    def families(self, state: LoopState[M], rows: int) -> tuple[Families, list[Decision]]:
        """Candidates of every effect that can be tried beside the model, those without any left out."""
        repeating = {name for name, effect in self.effects.items() if effect.repeats}
        present = {term.effect for term in state.model.terms} - repeating
        tried = [name for name in self.effects if name not in present and name not in state.not_tried()]
        offers = {name: partial(self.offer, name, state.model, None) for name in tried}
        families, faults = collect_candidates(offers, rows, built_in=BUILT_IN)
        return {name: candidates for name, candidates in families.items() if candidates}, faults

    def near(self, name: str, model: M, chosen: Candidate) -> list[Candidate]:
        """Candidates of an effect that differ from one that was chosen in its numbers."""
        return [one for one in self.offer(name, model, chosen) if of_same_kind(one, chosen)]


def search(problem: Problem[M], state: LoopState[M], *, progress: Progress = no_progress) -> LoopState[M]:
    """Add effects one by one, without a look at the hold-out set; it ends where an effect would lead back to a model that it has held."""
    for number in range(1, MOST_EFFECTS + 1):
        progress(number, MOST_EFFECTS + 2, f"searching for effect {number}")
        state, score = choose(problem, state.scored(problem.score(state)))
        if score is None:
            return state
        before, state = state, settled(problem, state, enter(problem, state, score))
        if state is before:
            return state
        if score.name == "step_event" and state.events > MOST_EVENTS:
            events = [place for place, step in enumerate(state.steps) if step.effect == "step_event"]
            evidence = {"most": MOST_EVENTS, "search_p": state.steps[-1].score.family_wise_p}
            return withdraw(problem, state, events, [Decision("step_event", Reason.TOO_MANY_EVENTS, evidence)])
    return state


def choose(
    problem: Problem[M], state: LoopState[M], *, level: float | None = None
) -> tuple[LoopState[M], Score | None]:
    """Choose the best effect of the last round that is significant, admissible and confirmed."""
    unconfirmed: Score | None = None
    for score in state.rounds[-1].scores:
        limit = problem.entry_level if level is None else level
        if score.candidate is None or score.family_wise_p > limit or state.is_withdrawn(score.name):
            continue
        refusal = problem.refuse(score, state.model)
        if refusal is not None:
            state = state.decide(refusal.on_evidence(search_p=score.family_wise_p))
            continue
        # Where a stronger effect could not be confirmed, a much weaker one may only stand in for it.
        if unconfirmed is not None and score.excess < unconfirmed.excess - TIE_GAIN:
            beside = conditional_p_value(problem, state.model, score, unconfirmed)
            # A lasting effect may predict in place of another even where both are significant together; an event happens at its instant.
            if beside > limit or not score.is_event:
                evidence: dict[str, float | str] = {
                    "stronger": unconfirmed.name,
                    "beside_p": beside,
                    "p_value": score.family_wise_p,
                }
                state = state.decide(Decision(score.name, Reason.WEAKER_THAN_UNCONFIRMED, evidence))
                continue
        score = problem.confirm(score, state)
        state = state.rescored(score)
        if score.is_confirmed:
            return state, score
        state = state.decide(not_confirmed(score, state.rounds[-1]))
        if unconfirmed is None or score.excess > unconfirmed.excess:
            unconfirmed = score
    return state, None


def conditional_p_value(problem: Problem[M], model: M, score: Score, stronger: Score) -> float:
    """The family-wise p-value of an effect with a stronger one in the model; that of the search where it gains as much as by itself."""
    weaker = Term(score.name, score.best)
    joint = problem.refit(model, [*model.terms, Term(stronger.name, stronger.best), weaker])
    lost = max(score.gain - problem.loss_without(joint, weaker), 0.0)
    return min(1.0, score.family_wise_p * float(np.exp(lost)))


def not_confirmed(score: Score, scored: Round) -> Decision:
    """The decision about a significant effect that was not confirmed."""
    evidence = {"p_value": score.family_wise_p}
    if not np.isfinite(score.error_um):
        return Decision(score.name, Reason.NOT_CONFIRMED, evidence)
    errors = {"before_um": scored.start_error_um, "after_um": score.error_um}
    return Decision(score.name, Reason.NOT_PREDICTED, evidence | errors)


def enter(problem: Problem[M], state: LoopState[M], score: Score) -> LoopState[M]:
    """Add a confirmed effect to the model and fit it again."""
    assert score.confirmation is not None
    model = problem.refit(state.model, [*state.model.terms, Term(score.name, score.best)])
    return state.entered(model, score, score.confirmation.way)


def settled(problem: Problem[M], before: LoopState[M], entered: LoopState[M], *, first: int = 0) -> LoopState[M]:
    """The state without what the newest effect makes superfluous; that before it where this leads back to a model that was held."""
    after = drop_superfluous(problem, entered, first=first)
    return before if after.named_terms in after.held else after


def drop_superfluous(problem: Problem[M], state: LoopState[M], *, first: int = 0) -> LoopState[M]:
    """Take out effects that the newest one has made superfluous, one after the other."""
    for place, term in enumerate(state.added[:-1]):
        if place < first:
            continue
        loss = problem.loss_without(state.model, term)
        if loss < SUPERFLUOUS_GAIN:
            decision = Decision(term.effect, Reason.SUPERFLUOUS, {"loss": loss})
            return drop_superfluous(problem, withdraw(problem, state, [place], [decision]), first=first)
    return state


def withdraw(
    problem: Problem[M], state: LoopState[M], places: Collection[int], decisions: Sequence[Decision]
) -> LoopState[M]:
    """Take steps out of the model again and fit what is kept."""
    model = problem.refit(state.model, state.kept(places))
    steps = tuple(step for place, step in enumerate(state.steps) if place not in places)
    return replace(state.decide(*decisions), model=model, steps=steps)


def open_hold_out(problem: Problem[M], state: LoopState[M]) -> LoopState[M]:
    """Predict the hold-out set once: with the declared model, after each step, and with the last model without each of its effects."""
    return replace(
        state,
        errors_um=tuple(problem.hold_out_error(terms) for terms in state.chain),
        errors_without_um=tuple(problem.hold_out_error(state.kept([place])) for place in range(len(state.steps))),
    )


# Scores of effects: what the best candidate of each explains, and the p-value of that gain for the whole search.

#: Effects with a larger family-unaware p-value are not looked at more closely, because they will not enter anyway.
LEVEL_TO_CONFIRM = 0.1
#: Neighbourhoods that are looked at in turn: the search tries few states for every wave, and the best may be two neighbours away.
#: A gain in log-likelihood below the second number does not justify another one.
_MOST_REFINEMENTS = 3
_LEAST_PROGRESS = 0.1
#: Words that a closer look may change: those that follow from numbers, the state that scales a pattern, and how the load began.
_OPEN_WORDS = DERIVED_WORDS | {"follows", "start"}

Families = Mapping[str, Sequence[Candidate]]
BUILT_IN = frozenset(effect.name for effect in LIBRARY)


def collect_candidates(
    offers: Mapping[str, Callable[[], Sequence[Candidate]]], rows: int, *, built_in: frozenset[str]
) -> tuple[dict[str, list[Candidate]], list[Decision]]:
    """Collect the candidates of all effects and check their columns."""
    families: dict[str, list[Candidate]] = {}
    decisions = []
    for name, offer in offers.items():
        try:
            candidates = list(offer())
            _check_columns(candidates, rows)
        except Exception as fault:
            # A user's effect must not end the search for the others; a fault of the library itself must be seen.
            if name in built_in:
                raise
            because = f"{type(fault).__name__}: {fault}"
            decisions.append(Decision(name, Reason.NOT_COMPUTABLE, {"because": because}))
            continue
        families[name] = candidates
    return families, decisions


def kept_on_disk(candidates: Iterable[Candidate]) -> Iterator[Candidate]:
    """Yield the same candidates, their columns in temporary files where many are large: those of a long test fill the memory."""
    held: list[Candidate] = []
    size = 0
    for candidate in candidates:
        held.append(candidate)
        size += candidate.columns.nbytes if isinstance(candidate.columns, np.ndarray) else 0
        if size > IN_MEMORY_BYTES:
            dense = {k: one.columns for k, one in enumerate(held) if isinstance(one.columns, np.ndarray)}
            stored = dict(zip(dense, copy_to_disk(list(dense.values())), strict=True))
            yield from (replace(one, columns=stored[k]) if k in stored else one for k, one in enumerate(held))
            held, size = [], 0
    yield from held


def _check_columns(candidates: Sequence[Candidate], rows: int) -> None:
    """Refuse columns that are not one finite number per row."""
    for candidate in candidates:
        columns = candidate.columns if isinstance(candidate.columns, Separable) else np.asarray(candidate.columns)
        if len(columns.shape) != 2 or columns.shape[0] != rows:
            raise SearchError(f"columns have shape {columns.shape}; expected ({rows}, columns)")
        # Of columns that share courses these are looked at, and all columns only where one is not finite.
        parts = (*map(_made_of, columns.courses), columns.weights) if isinstance(columns, Separable) else (columns,)
        if not all(np.isfinite(part).all() for part in one_by_one(parts)):
            not_finite = int((~np.isfinite(np.asarray(columns))).sum())
            raise SearchError(f"{not_finite} values are not finite at {dict(candidate.parameters)}")
        if len(candidate.units) != columns.shape[1]:
            raise SearchError(
                f"{columns.shape[1]} columns but {len(candidate.units)} units at {dict(candidate.parameters)}"
            )


def _made_of(course: Array | Wave) -> Array:
    """The numbers that decide whether a course is finite."""
    return course.seconds if isinstance(course, Wave) else course


def score_effects(
    families: Families,
    gains: Gains,
    *,
    level: float,
    is_admissible: Callable[[Candidate], bool] = lambda candidate: True,
) -> tuple[list[Score], list[Decision]]:
    """Score every effect by its best candidate."""
    scores, decisions = [], []
    start = 0
    for name, candidates in families.items():
        rows = np.arange(start, start + len(candidates))
        start += len(candidates)
        usable = rows[gains.separable[rows]]
        collinear = 1.0 - usable.size / rows.size
        if usable.size == 0:
            scores.append(Score(name, None, collinear=collinear))
            decisions.append(Decision(name, Reason.COLLINEAR))
            continue
        admissible = [row for row in usable if is_admissible(candidates[row - int(rows[0])])]
        usable = np.array(admissible) if admissible else usable
        best = int(usable[np.argmax(gains.gain[usable, 0])])
        null = gains.gain[usable, 1:].max(axis=0)
        gain = float(gains.gain[best, 0])
        p_value = tail_probability(gain, null)
        scores.append(
            Score(
                name,
                candidates[best - int(rows[0])],
                gain,
                gain - float(null.mean()),
                p_value,
                sidak(p_value, len(families)),
                collinear,
                int(gains.drift_place[best]),
                critical_gain(sidak_level(level, len(families)), null),
                tried=[(candidates[row - int(rows[0])].parameters, float(gains.gain[row, 0])) for row in usable],
            )
        )
    return sorted(scores, key=lambda score: -score.excess), decisions


def refine(
    score: Score, near: Callable[[Candidate], Sequence[Candidate]], gains: Callable[[Sequence[Candidate]], Gains]
) -> Score:
    """Move to the best candidate of the neighbourhood, and of that one's, as long as the gain grows."""
    for _ in range(_MOST_REFINEMENTS):
        before = score.gain
        score = _best_near(score, near(score.best), gains)
        if score.gain < before + _LEAST_PROGRESS:
            break
    return score


def _best_near(score: Score, near: Sequence[Candidate], gains: Callable[[Sequence[Candidate]], Gains]) -> Score:
    """The same score with the best candidate of a neighbourhood, or with its own where none is better, or none near, as of an event
    between two readings that are far apart.
    """
    if not near:
        return replace(score, ranges=parameter_ranges(score.tried, score.best.parameters, score.gain))
    looked = gains(near)
    # More columns must be the better description by odds of 20 to 1.
    needed = TIE_GAIN * np.array([one.columns.shape[1] > score.best.columns.shape[1] for one in near])
    best = int(np.argmax(np.where(looked.separable, looked.gain[:, 0] - needed, -np.inf)))
    gain = float(looked.gain[best, 0])
    if looked.separable[best] and gain >= score.gain + needed[best]:
        score = replace(
            score,
            candidate=near[best],
            gain=gain,
            excess=score.excess + gain - score.gain,
            drift_place=int(looked.drift_place[best]),
        )
    closer = [(one.parameters, float(gain)) for one, gain in zip(near, looked.gain[:, 0], strict=True)]
    return replace(score, ranges=parameter_ranges([*closer, *score.tried], score.best.parameters, score.gain))


def of_same_kind(candidate: Candidate, chosen: Candidate) -> bool:
    """Whether two candidates differ in numbers only, or in words that a closer look may change."""
    return _words(chosen.parameters, _OPEN_WORDS).items() <= candidate.parameters.items()
