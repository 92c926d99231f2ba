"""Decisions of the search: which effect entered, was refused or was withdrawn, for which reason and on what evidence.

The procedure acts on the enum and the numbers; the sentence is made from both when a result is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


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
    RESTLESS_DRIFT = "restless drift"
    TEMPERATURE_NOISE = "temperature noise"
    FOLLOWS_RATE = "follows the rate"
    SMOOTHING = "smoothing"
    UNLOGGED_HEAT = "unlogged heat"
    NOT_CONFIRMED = "not confirmed"
    NOT_PREDICTED = "later parts not predicted better"
    STANDS_IN = "weaker than an unconfirmed effect"
    #: In the model for a while, and taken out again.
    SUPERFLUOUS = "superfluous"
    TOO_MANY_EVENTS = "too many events"
    WRONG_PATTERN = "wrong pattern"
    SHARED_PATTERN = "shared pattern"
    BESIDE_WRONG_PATTERN = "beside a wrong pattern"
    NOT_REPEATED = "not repeated"


NOT_TRIED = frozenset({Reason.NOT_AVAILABLE, Reason.NOT_COMPUTABLE})
#: Decisions that say nothing against an effect: it is in, the data did not decide, or a later effect does its work.
_NEUTRAL = frozenset({Reason.ENTERED, Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED, Reason.SUPERFLUOUS})
#: Reasons against the name of an effect.
BLOCKING = frozenset(Reason) - NOT_TRIED - _NEUTRAL
#: Reasons that keep an effect out for the rest of the search.
FINAL = frozenset({Reason.WRONG_PATTERN, Reason.SHARED_PATTERN, Reason.BESIDE_WRONG_PATTERN, Reason.NOT_REPEATED})
#: Reasons for which an effect that had entered was taken out again without another doing its work.
WITHDRAWN = FINAL | {Reason.TOO_MANY_EVENTS}
#: Reasons for which a significant effect has no name: it shows that something is missing all the same.
WITHHELD = (BLOCKING - {Reason.COLLINEAR}) | {Reason.NOT_CONFIRMED, Reason.NOT_PREDICTED}

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
    Reason.RESTLESS_DRIFT: (
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
    Reason.NOT_CONFIRMED: "significant (p = {p_value:.2g}), but not confirmed on readings that its coefficients were not fitted to",
    Reason.NOT_PREDICTED: (
        "significant (p = {p_value:.2g}), but the later parts of the training time are predicted no better with it ({before_um:.3g} to "
        "{after_um:.3g} µm)"
    ),
    Reason.STANDS_IN: (
        "significant (p = {p_value:.2g}; with {stronger} in the model {beside_p:.2g}), but much weaker than {stronger}, which is not "
        "confirmed: it may explain a part of the same"
    ),
    Reason.SUPERFLUOUS: "removed: an effect added later explains the same (log-likelihood lost without it: {loss:.1f})",
    Reason.TOO_MANY_EVENTS: "more than {most} events would be needed: that is a switching, for which the library has no name",
    Reason.WRONG_PATTERN: (
        "its course in time is present, but the pattern along the axis and by direction is not that of this effect "
        "(p = {p_value:.1g})"
    ),
    Reason.SHARED_PATTERN: (
        "{first} and {second} fit no better than one course in time with a free pattern: together they are one pattern that "
        "the library does not hold"
    ),
    Reason.BESIDE_WRONG_PATTERN: "withdrawn: it was found beside {beside}, whose name was withdrawn afterwards",
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

    @property
    def sentence(self) -> str:
        """The decision in words."""
        return _SENTENCES[self.reason].format_map(dict(self.evidence))
