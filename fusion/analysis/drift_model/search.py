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
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.drift_model.fit import Term
from fusion.analysis.drift_model.gains import Gains
from fusion.analysis.drift_model.null_simulation import critical_gain, sidak, sidak_level, tail_probability
from fusion.analysis.drift_model.record_data import independent
from fusion.analysis.effects.effect import Candidate, Effect, Separable, Wave
from fusion.analysis.effects.library import LIBRARY, describe_effect
from fusion.common import Array, FusionError
from fusion.results import loop as schema
from interferometry.drift.gls import estimate
from interferometry.drift.kalman import DriftModelError
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
    HETEROSCEDASTIC_DRIFT = "heteroscedastic drift"
    TEMPERATURE_NOISE = "temperature noise"
    FOLLOWS_RATE = "follows the rate"
    SMOOTHING = "smoothing"
    UNLOGGED_HEAT = "unlogged heat"
    WITHIN_DIGITS = "within the digits"
    NOT_CONFIRMED = "not confirmed"
    NOT_PREDICTED = "later parts not predicted better"
    WEAKER_THAN_UNCONFIRMED = "weaker than an unconfirmed effect"
    #: In the model for a while, and taken out again.
    SUPERFLUOUS = "superfluous"
    TOO_MANY_EVENTS = "too many events"
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
WITHDRAWN = FINAL | {Reason.TOO_MANY_EVENTS}
#: Reasons for which a significant effect has no name: it shows that something is missing all the same.
WITHHELD = (BLOCKING - {Reason.COLLINEAR, Reason.WITHIN_DIGITS}) | {Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED}

_SENTENCES: Mapping[Reason, str] = {
    Reason.ENTERED: "added to the model",
    Reason.NOT_AVAILABLE: "{because}",
    Reason.NOT_COMPUTABLE: "its columns cannot be computed: {because}",
    Reason.COLLINEAR: (
        "no part of it is independent of the model: its columns are constant, or collinear with the static profile, the declared effects "
        "and the effects added before"
    ),
    Reason.SINGLE_WARM_UP: (
        "the machine was excited by a single warm-up ({share_percent:.1f} % of the candidate is a plain warm-up), and beside free "
        "warm-ups it gains only {gain:.1f} in log-likelihood; switch the load on purpose to separate it"
    ),
    Reason.SINGLE_SWITCHING: (
        "{driver} was switched only once (a single step explains {share_percent:.1f} % of its course), and all single warm-ups are alike; "
        "switch the load on purpose to separate it"
    ),
    Reason.AT_SWITCHING: "a driver was switched at {hours:.2f} h: a shift there is a response to the load, not an event of its own",
    Reason.HETEROSCEDASTIC_DRIFT: (
        "drift that moved {times:.2g} times as much between {start_h:.2f} h and {end_h:.2f} h as in the rest of the test, as in a warm-up "
        "or after a change of the load, would gain {drift_gain:.1f} in log-likelihood; the event gains {event_gain:.1f}, and its name "
        "needs {needed:.0f} more than such drift"
    ),
    Reason.TEMPERATURE_NOISE: (
        "the noise of {series} is {noise_percent:.2g} % of its range; above {limit_percent:.1g} % a lagged copy, which is smoother, fits "
        "better by its smoothness alone"
    ),
    Reason.FOLLOWS_RATE: (
        "beside the delayed copy the direct coefficient of {series} takes the opposite sign or nearly cancels it: the readings follow the "
        "rate of change, which is the power of a source nearby or a late sensor, not a lag"
    ),
    Reason.SMOOTHING: (
        "a copy of {series} that is smoothed but not delayed fits as well (log-likelihood {advantage:+.1f}): the gain comes from "
        "denoising, not from a lag"
    ),
    Reason.UNLOGGED_HEAT: (
        "nothing that makes heat was logged: the delayed response to a source that is not logged cannot be told from a lag, nor from a "
        "drift; log duty, speed or load"
    ),
    Reason.WITHIN_DIGITS: (
        "it moves no displacement by more than the digits of the readings, so that rounding may look like it (largest: {range_um:.3g} µm, "
        "digits: {step_um:.3g} µm)"
    ),
    Reason.NOT_CONFIRMED: "significant (p = {p_value:.2g}), but not confirmed on readings that its coefficients were not fitted to",
    Reason.NOT_PREDICTED: (
        "significant (p = {p_value:.2g}), but the later parts of the training time are predicted no better with it ({before_um:.3g} to "
        "{after_um:.3g} µm)"
    ),
    Reason.WEAKER_THAN_UNCONFIRMED: (
        "significant (p = {p_value:.2g}; with {stronger} in the model {beside_p:.2g}), but much weaker than {stronger}, which is not "
        "confirmed: it may explain a part of the same"
    ),
    Reason.SUPERFLUOUS: "removed: an effect added later explains the same (log-likelihood lost without it: {loss:.1f})",
    Reason.TOO_MANY_EVENTS: "more than {most} events would be needed: that is a switching, for which the library has no name",
    Reason.INCONSISTENT_PATTERN: (
        "its course in time is present, but the pattern along the axis and by direction is not that of this effect "
        "(p = {p_value:.1g})"
    ),
    Reason.SHARED_PATTERN: (
        "{first} and {second} fit no better than one course in time with a free pattern: together they are one pattern that "
        "the library does not hold"
    ),
    Reason.DEPENDS_ON_WITHDRAWN: "withdrawn: it was found beside {beside}, whose name was withdrawn afterwards",
    Reason.NOT_REPEATED: (
        "withdrawn: it was found in the training part (p = {p_value:.2g}), but the {parts} earlier part(s) of the record on which the same "
        "procedure added it were predicted no better ({without_um:.3g} to {with_um:.3g} µm)"
    ),
}


@dataclass(frozen=True)
class Decision:
    """What was decided about one effect.

    Attributes
    ----------
    effect : name of the effect
    reason : why
    evidence : the numbers and names behind it, by the fields of the reason's sentence
    """

    effect: str
    reason: Reason
    evidence: Mapping[str, float | str] = field(default_factory=dict)

    def on_evidence(self, **evidence: float | str) -> Decision:
        """The same decision with further evidence."""
        return replace(self, evidence={**self.evidence, **evidence})

    @property
    def sentence(self) -> str:
        """The decision in words."""
        return _SENTENCES[self.reason].format_map(dict(self.evidence))


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
#: An effect that is not significant by itself is no rival.
_RIVAL_LEVEL = 0.05


class SearchError(FusionError):
    """An effect does not keep its contract; the message names it."""


class Confirmed(StrEnum):
    """How an added effect was confirmed."""

    LATER_CYCLES = "confirmed on later blocks of cycles, coefficients frozen"
    OTHER_TARGETS = "confirmed on the other half of the targets, coefficients frozen"
    BY_EVIDENCE = "confirmed by the evidence of all training cycles; their later blocks alone do not decide"
    SECOND_SEARCH = "found in all cycles after the hold-out set was opened: it has no held-out error"
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
        return other.p_value < _RIVAL_LEVEL and (ahead / blurred if ahead > 0.0 else ahead) + chance < TIE_GAIN

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

    def described(
        self, candidate: Candidate, answer: Answer, where: str, *, size: float, withheld: str
    ) -> dict[str, Any]:
        """What results.json holds of every step, on a record and along an axis.

        `where` says which readings gave the answer, ``size`` is as in :func:`rivals`.
        """
        tied, runner_up = rivals(self.score, self.round.scores, size)
        return {
            "effect": self.effect,
            "parameters": candidate.parameters,
            "parameter_ranges": self.score.ranges,
            "p_value": self.score.family_wise_p,
            "tied": tied,
            "withheld": withheld,
            "runner_up": runner_up,
            **answer.described(where),
            "confirmed_by": str(self.confirmed),
        }


#: A slow effect may be a part of a smooth drift without a name that is left beside it and has this share of its size.
_SMOOTH_SHARE = 0.5


def withheld_for(
    step: Step, *, size_um: float = np.inf, drift_um: float = 0.0, is_smooth: bool = False, beside: str = ""
) -> str:
    """Why a step that is told by its course in time alone has no name: a time constant or period that these data leave open on a side, one
    that is longer than physics allows, a drift of which it may be a part, or an effect without a name ``beside`` which it was found.
    """
    effect, parameters = describe_effect(step.effect), step.score.best.parameters
    # What follows nothing that was logged is a trend since the first reading.
    is_trend = parameters.get("follows", "warm_up") == "warm_up"
    for name, words in (("time_constant_min", "time constant"), ("period_min", "period")):
        # A value of which no other was tried is as open as one of which all fit.
        low, high = step.score.ranges.get(name, [None, None] if name in parameters else [0.0, 0.0])
        by_course = name == "period_min" or is_trend or (effect is not None and effect.excited_by)
        if by_course and (low is None or high is None):
            known = f"{low:.3g} min and more" if low else f"{high:.3g} min and less" if high else "any"
            return f"its {words} is not determined ({known} fits)"
    longest_min, minutes = effect.longest_min if effect else np.inf, float(parameters.get("time_constant_min", 0.0))
    if minutes > longest_min:
        return f"its time constant of {minutes:.3g} min is longer than its physics allows ({longest_min:g} min)"
    # A walk may be mistaken for a trend as well, and only a smooth drift for what follows a load.
    if "time_constant_min" in parameters and (is_smooth or is_trend) and drift_um >= _SMOOTH_SHARE * size_um:
        kind = "smooth drift" if is_smooth else "drift"
        return f"a {kind} of {drift_um:.2g} µm is left beside its {size_um:.2g} µm, of which it may be a part"
    if beside and step.score.best.event_s is None and "period_min" not in parameters:
        return f"it was found beside {beside.replace('_', ' ')}, which has no name itself"
    return ""


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
    """The data, as the procedure sees them.

    Attributes
    ----------
    effects : the library by name
    entry_level : family-wise p-value up to which an effect may enter
    """

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
    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Error of predicting the hold-out set from the training part, root mean square, um."""

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
        if state.events > MOST_EVENTS:
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


# What the evidence allows to say: intervals of errors, whether a name is confirmed, whether the model has skill, and the verdict.

#: Penalties of a ridge regression, as shares of a standardised column's variance.
PENALTIES = 10.0 ** np.arange(-5.0, 1.6, 0.5)
#: Time constants of the lagged copies of a series, min: a factor of four apart.
BASELINE_LAGS_MIN = (5.0, 20.0, 80.0)
_RESAMPLES = 1000
_PERCENT = (2.5, 97.5)


def error_interval(errors: Array, unit: NDArray[np.int64], rng: np.random.Generator) -> schema.ErrorInterval:
    """Root mean square error, mean over channels, and its interval from a circular block bootstrap."""
    errors = errors[:, None] if errors.ndim == 1 else errors
    place = np.unique(unit, return_inverse=True)[1]
    known = np.isfinite(errors)
    squares, number = (
        np.column_stack([np.bincount(place, column) for column in values.T])
        for values in (np.where(known, errors, 0.0) ** 2, known.astype(float))
    )
    units = squares.shape[0]
    length = max(1, round(units**0.5))
    starts = rng.integers(0, units, (_RESAMPLES, -(-units // length)))
    rows = (starts[:, :, None] + np.arange(length)).reshape(_RESAMPLES, -1)[:, :units] % units
    resampled = _rmse(squares[rows].sum(axis=1), number[rows].sum(axis=1))
    low, high = np.nanpercentile(resampled, _PERCENT)
    return schema.ErrorInterval(rmse_um=_rmse(squares.sum(axis=0), number.sum(axis=0)), low_um=low, high_um=high)


def _rmse(squares: Array, number: Array) -> Array:
    """Root mean square over the last axis' channels, mean over those with a value."""
    known = number > 0.0
    each = np.sqrt(np.where(known, squares / np.maximum(number, 1.0), 0.0))
    channels = known.sum(axis=-1)
    return np.asarray(np.where(channels > 0, each.sum(axis=-1) / np.maximum(channels, 1), np.nan))


# What readings that an effect was not fitted to say of it: regression of these readings on its predicted share.

#: Probability of bearing out any effect that is not there, and of contradicting any that is, over all effects of a model.
ANSWER_LEVEL = 0.05
#: Chance at which a right effect is denied its name because unseen readings follow it by another size than that predicted.
_SIZE_LEVEL = 1e-3
#: Sizes, over that predicted, between which an effect predicts better than none and than twice as much of it.
_HALF, _TWICE = 0.5, 2.0
#: Readings per column below which an interval says nothing.
_READINGS_PER_COLUMN = 2
#: Share of its length that a column keeps by rounding where the others contain it.
_ROUNDING = 1e-6
#: A size is not told where a right effect would hardly be borne out more often than one that is not there.
_LEAST_POWER = 2.0 * ANSWER_LEVEL


@dataclass(frozen=True)
class Unseen:
    """Readings of one channel that effects were not fitted to, and what is predicted of them, um.

    Attributes
    ----------
    rows : (n,) number of each reading, by which channels share an instant
    seconds, loadings : (n,) and (n, components) of the drift that acts there
    response : (n,) the readings
    beside : (n, q) what may be of any size there beside a level, such as the share of the declared effects
    shares : (n, effects) the predicted share of every effect
    uncertain : (n, r) errors of what was taken from the response beforehand, one column for each of unit variance; None for none
    """

    rows: NDArray[np.intp]
    seconds: Array
    loadings: Array
    response: Array
    beside: Array
    shares: Array
    uncertain: Array | None = None

    def whitened(self) -> tuple[Array, Array, Array, int] | None:
        """Response, shares and uncertain columns freed of `beside` and whitened by the drift and noise of these very readings, and the
        degrees of freedom; None where they cannot be estimated.
        """
        if not self.rows.size:  # A displacement that ended before.
            return None
        level, number = np.ones((self.rows.size, 1)), self.shares.shape[1]
        varying = np.column_stack([self.beside, self.shares])
        design = np.column_stack([level, varying[:, independent(varying)]])
        freedom = self.rows.size - design.shape[1]
        if freedom < _READINGS_PER_COLUMN * design.shape[1]:
            return None
        try:
            fit = estimate(self.seconds, self.loadings, self.response, design, memory=True)
        except DriftModelError:
            return None
        if fit.sigma <= 0.0:
            return None
        rates = fit.design[:, design.shape[1] :]
        asked = np.column_stack(
            [self.response, self.shares, level[:, :0] if self.uncertain is None else self.uncertain]
        )
        laid = fit.system.whiten(np.column_stack([asked, level, self.beside, rates]))[0] / fit.sigma
        asked, beside = laid[:, : asked.shape[1]], laid[:, asked.shape[1] :]
        left = asked - beside @ np.linalg.lstsq(beside, asked, rcond=None)[0]
        # What is of no size beside the others is rounding.
        left[:, np.linalg.norm(left, axis=0) < _ROUNDING * np.linalg.norm(asked, axis=0)] = 0.0
        return left[:, 0], left[:, 1 : 1 + number], left[:, 1 + number :], freedom


@dataclass(frozen=True)
class Answer:
    """Whether readings that an effect was not fitted to bear it out.

    Attributes
    ----------
    slope, u : size with which it acts there over that predicted, 1 where it is right and 0 where it is not there, and its standard
        uncertainty; infinite where these readings do not determine it
    freedom : degrees of freedom of the uncertainty
    level : probability of each false statement
    against : what contradicts the effect without regard to its size, in words
    """

    slope: float = np.nan
    u: float = np.inf
    freedom: int = 1
    level: float = ANSWER_LEVEL
    against: str = ""

    @property
    def word(self) -> schema.BorneOut:
        """Borne out where its size is more than zero and may be that predicted, contradicted where it is less and may be zero."""
        reach = special.stdtrit(self.freedom, 1.0 - self.level) * self.u
        if self.against:
            return "no"
        if not np.isfinite(reach):
            return "cannot tell"
        there, less, more = self.slope > reach, self.slope + reach < 1.0, self.slope - reach > 1.0
        if there and (self.slope >= _HALF if less else self.slope <= _TWICE or not more):
            return "yes"
        return "no" if less and (not there or self.slope < _HALF) else "cannot tell"

    @property
    def p_value(self) -> float:
        """Probability of a size as large where the effect is not there."""
        return float(special.stdtr(self.freedom, -self.slope / self.u)) if np.isfinite(self.u) else 1.0

    @property
    def power(self) -> float:
        """Probability that such readings bear a right effect out."""
        return float(special.stdtr(self.freedom, 1.0 / self.u - special.stdtrit(self.freedom, 1.0 - self.level)))

    @property
    def is_of_other_size(self) -> bool:
        """Whether its size differs from that predicted by more than chance and the discrepancy of a library's shape explain."""
        wide = np.hypot(self.u, DISCREPANCY)
        return bool(abs(self.slope - 1.0) > special.stdtrit(self.freedom, 1.0 - 0.5 * _SIZE_LEVEL) * wide)

    def other_size(self, where: str) -> str:
        """Why an effect whose size is another than that predicted has no name."""
        return f"{self._size(where)}: what acts has another course"

    def _size(self, where: str) -> str:
        return f"{where} its size is {self.slope:.2f} ± {2.0 * self.u:.2f} (k = 2) of that predicted"

    def described(self, where: str) -> dict[str, Any]:
        """What results.json holds of it; `where` says which readings were asked."""
        known, size = self.power >= _LEAST_POWER, self._size(where)
        doubts = {
            "yes": "",
            "no": self.against or f"contradicted: {size}",
            "cannot tell": f"not yet borne out: {size}" if known else f"not yet borne out: it hardly changes {where}",
        }
        return {
            "confirmed": self.word == "yes",
            "doubt": doubts[self.word],
            "borne_out": self.word,
            "borne_out_p": self.p_value,
            "borne_out_size": self.slope if known else None,
            "borne_out_size_u": self.u if known else None,
            "borne_out_power": self.power,
        }


def answers(channels: Sequence[Unseen], *, family: int = 1) -> list[Answer]:
    """Ask readings for the size of every effect, all effects together, over that predicted; channels share the sizes.

    ``family`` is the number of effects of the model: with Bonferroni's level none of them is told falsely with the stated probability.
    """
    effects = channels[0].shares.shape[1]
    asked = [(one.rows, *found) for one in channels if (found := one.whitened()) is not None]
    if not asked or not effects:
        return [Answer()] * effects
    known = independent(np.vstack([shares for _, _, shares, _, _ in asked]))
    parts = [(rows, response, shares[:, known], uncertain) for rows, response, shares, uncertain, _ in asked]
    inverse = np.linalg.inv(np.sum([x.T @ x for _, _, x, _ in parts], axis=0))
    slopes = inverse @ np.sum([x.T @ y for _, y, x, _ in parts], axis=0)
    # The drifts of the channels of one machine are alike, so that many channels say little more than one, whenever each was read.
    instants = np.unique(np.concatenate([rows for rows, *_ in parts]))
    left = np.array([_at_nearest(y - x @ slopes, rows, instants) for rows, y, x, _ in parts])
    laid = np.array([_at_nearest(x, rows, instants) for rows, _, x, _ in parts])
    alike = left @ left.T
    # A channel that is predicted exactly has no drift to share.
    size = np.sqrt(np.maximum(np.diag(alike), np.finfo(float).tiny))
    products = np.einsum("kni,lnj->klij", laid, laid)
    covariance = inverse @ np.einsum("kl,klij->ij", alike / np.outer(size, size), products) @ inverse
    for _, _, x, uncertain in parts:
        through = inverse @ x.T @ uncertain
        covariance = covariance + through @ through.T
    freedom = min(found[-1] for found in asked)
    told = {
        k: Answer(float(a), float(u), freedom, ANSWER_LEVEL / family)
        for k, a, u in zip(known, slopes, np.sqrt(np.diag(covariance)), strict=True)
    }
    return [told.get(k, Answer()) for k in range(effects)]


def _at_nearest(values: Array, rows: NDArray[np.intp], instants: NDArray[np.intp]) -> Array:
    """Values (n,) or (n, q) at all instants, each that of the nearest reading; their sum of squares, column by column, is kept."""
    after = np.clip(np.searchsorted(rows, instants), 1, rows.size - 1)
    nearest = after - (instants - rows[after - 1] <= rows[after] - instants)
    laid = values[nearest]
    length = np.linalg.norm(laid, axis=0)
    return np.asarray(
        laid * np.divide(np.linalg.norm(values, axis=0), length, out=np.ones_like(length), where=length > 0.0)
    )


def left_out_of_forecast(problem: Problem[M], state: LoopState[M], contradicted: Collection[int]) -> set[int]:
    """Places of the steps that leave the forecast: contradicted ones, and those with which the hold-out set is predicted worse."""
    steps = range(len(state.errors_without_um))
    left = set(contradicted) & set(steps)
    while left != set(steps) and problem.hold_out_error(state.kept(left)) > schema.ERROR_BY_CHANCE * state.errors_um[0]:
        left.add(min(set(steps) - left, key=lambda place: problem.hold_out_error(state.kept(left | {place}))))
    return left


def exceeds_noise(error_um: float, noise_um: float, share: float) -> bool:
    """Whether an error holds more than noise."""
    return error_um**2 > (1.0 + share**2) * noise_um**2


def excess_um(error_um: float, noise_um: float) -> float:
    """What an error holds beside the noise, um."""
    return float(np.sqrt(max(0.0, error_um**2 - noise_um**2)))


def has_skill(error_um: float, last_value_um: float, mean_um: float, noise_um: float, share: float) -> bool:
    """Whether a model predicts the hold-out set better than the last value and the mean of the training part do."""
    return error_um < min(last_value_um, mean_um) or not exceeds_noise(error_um, noise_um, share)


#: What is left where a model with a name predicts neither to within the noise nor as well as the best plain prediction.
BEYOND_PLAIN = "an error of predicting the hold-out beyond the noise, larger than that of the best plain prediction"
#: A plain regression whose error is this share of the model's or less knows something that the model lacks.
_BETTER = 0.75


def is_separable(error_um: float, ridge_with_lags_um: float) -> bool:
    """Whether a cause can be named: a plain regression with lagged copies does not predict better by a quarter."""
    return not ridge_with_lags_um <= _BETTER * error_um


def verdict(*, named: bool, left: bool, skill: bool, separable: bool, tested: bool) -> schema.Verdict:
    """Word for the outcome."""
    if not skill and not tested and separable:
        return "no_skill"
    left = left or tested or not separable
    if named and separable:
        return "partial" if left else "explained"
    return "unexplained" if left else "complete"


def errors_of_predictions(hold_out: Mapping[str, schema.ErrorInterval]) -> dict[str, Any]:
    """Errors on the hold-out set with their intervals, as ``errors``, ``baselines`` and ``best_baseline`` of a `Loop`."""
    plain = {name: one for name, one in hold_out.items() if name not in schema.ModelErrors.model_fields}
    return {
        "errors": schema.ModelErrors(declared=hold_out["declared"], final=hold_out["final"]),
        "baselines": schema.RunBaselines(**plain) if "mean_run" in plain else schema.Baselines(**plain),
        "best_baseline": min(plain, key=lambda name: plain[name].rmse_um),  # type: ignore[arg-type, return-value]
    }
