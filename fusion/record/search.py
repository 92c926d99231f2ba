"""The closed loop on a record: what the quasi-static model of the temperatures lacks, and the error before and after.

The same procedure as along an axis (:mod:`fusion.loop.closed_loop`), with what a record asks for: every channel has a drift and
coefficients of its own, an effect enters only if it also predicts better the load cycles that follow, and the prediction is that of
coefficients shrunk together. The last fifth of the time is sealed and touched once, at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.effects.candidates import Candidate
from fusion.effects.library import Effect
from fusion.loop.scoring import Range, parameter_ranges
from fusion.model.fit import Term
from fusion.model.null_simulation import DRAWS, sidak, tail_probability
from fusion.record.blocks import Record, RecordError
from fusion.record.effects import QUASI_STATIC, RecordEffect, quasi_static_columns, record_library
from fusion.record.gates import blocked_reason
from fusion.record.model import RecordFit, columns_of, fit_record, gains, simulate_channels
from fusion.record.prediction import Prediction, channel_rmse, persistence_rmse, predict

SEALED_SHARE = 0.2
#: Chance of adding an effect where only drift and noise act. A drift that wanders at random is a stand-in for what a real machine
#: does, so less chance is left to it than along an axis; an event, which no later part can confirm, is left less still.
ENTRY_LEVEL, EVENT_LEVEL = 0.01, 0.001
MOST_EFFECTS = 4
_SUPERFLUOUS_GAIN = 2.0
#: An effect must bring the forward-chained error down to this share of what it was, or it only follows chance.
EARNED = 0.98
#: An event may make the forward-chained error larger by this factor: chance, not harm.
_HARMLESS = 1.01
_MAY_REPEAT = frozenset({"step_event", "periodic_disturbance", "sensor_fault"})

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class RecordScore:
    """What the best candidate of an effect explains in a record.

    Attributes
    ----------
    name, candidate : the effect and its best candidate, None where none can be told from the model
    gain, excess : gain in log-likelihood over all channels, and that minus the mean gain where nothing is missing
    p_value, family_wise_p : chance of such a gain where nothing is missing, for this effect alone and for the best of all tried
    chained_rmse : error of the forward-chained training blocks with it, um; NaN where it was not worth trying
    ranges : values of the parameters that fit as well, where they were looked at closely
    """

    name: str
    candidate: Candidate | None
    gain: float
    excess: float
    p_value: float
    family_wise_p: float
    chained_rmse: float = np.nan
    ranges: Mapping[str, Range] = field(default_factory=dict)


@dataclass(frozen=True)
class Round:
    """One round of the search: the error it started from, all scores, what was chosen, and why others were not."""

    chained_rmse: float
    scores: tuple[RecordScore, ...]
    chosen: str
    rejected: Mapping[str, str]


@dataclass(frozen=True)
class Search:
    """What the search on a training part found.

    Attributes
    ----------
    record, train : the record, and the blocks (blocks,) that were used
    terms : declared terms and those that were added, in turn
    entries : the score and the whole round behind every added term
    rounds : every round in turn
    not_tried, blocked : effects that were not tried or not named, with the reason
    """

    record: Record
    train: NDArray[np.bool_]
    terms: tuple[Term, ...]
    entries: tuple[tuple[RecordScore, Round], ...]
    rounds: tuple[Round, ...]
    not_tried: Mapping[str, str]
    blocked: Mapping[str, str]

    @property
    def declared(self) -> int:
        """Number of declared terms."""
        return len(self.terms) - len(self.entries)

    def predictions(self) -> list[Prediction]:
        """Predictions of the declared model and after every added effect, from the training part."""
        return [
            predict(self.record, columns_of(self.record, self.terms[: self.declared + k]), self.train)
            for k in range(len(self.entries) + 1)
        ]


def seal(record: Record) -> tuple[NDArray[np.bool_], str]:
    """Blocks that the search may use, and a sentence that says which time is sealed."""
    first = record.seconds[0] + (1.0 - SEALED_SHARE) * (record.seconds[-1] - record.seconds[0])
    hours = first / 3600.0, record.seconds[-1] / 3600.0
    return (
        record.seconds < first,
        f"{hours[0]:.1f} h to {hours[1]:.1f} h sealed; coefficients from before, nothing re-zeroed; error is the mean over channels",
    )


def declare(declared: Sequence[str], record: Record) -> list[Term]:
    """Terms of the declared model.

    Raises
    ------
    RecordError
        if a name has no meaning for a record.
    """
    terms = []
    for name in declared:
        if name != QUASI_STATIC:
            raise RecordError(
                f'declared effect {name!r} cannot be computed from a record; declare "{QUASI_STATIC}" (every displacement linear '
                "in the temperatures), the search tries the rest of the library"
            )
        terms.append(Term(QUASI_STATIC, quasi_static_columns(record)))
    return terms


@threadpool_limits.wrap(limits=1, user_api="blas")
def search(
    record: Record,
    train: NDArray[np.bool_],
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = lambda done, total, what: None,
) -> Search:
    """Search the library for what the declared terms lack, on the training part alone."""
    library, not_tried = record_library(effects)
    not_tried |= {name: reason for name, effect in library.items() if (reason := effect.needs(record)) is not None}
    open_effects = {name: effect for name, effect in library.items() if name not in not_tried}
    rng = np.random.default_rng(seed)
    blocked: dict[str, str] = {}
    terms = list(declared)
    entries: list[tuple[RecordScore, Round]] = []
    rounds: list[Round] = []
    for number in range(1, MOST_EFFECTS + 1):
        progress(number, MOST_EFFECTS, f"searching for effect {number}")
        present = {term.effect for term in terms} - _MAY_REPEAT
        tried = {name: effect for name, effect in open_effects.items() if name not in present}
        found, chosen = _one_round(record, train, terms, tried, rng, not_tried, blocked)
        rounds.append(found)
        if chosen is None:
            break
        entries.append((chosen, found))
        terms.append(Term(chosen.name, candidate_of(chosen)))
        terms, entries = _re_examine(record, train, terms, entries)
    return Search(record, train, tuple(terms), tuple(entries), tuple(rounds), not_tried, blocked)


def _one_round(
    record: Record,
    train: NDArray[np.bool_],
    terms: Sequence[Term],
    tried: Mapping[str, RecordEffect],
    rng: np.random.Generator,
    not_tried: dict[str, str],
    blocked: dict[str, str],
) -> tuple[Round, RecordScore | None]:
    """Score every effect against the model and choose the strongest that also predicts better."""
    model = fit_record(record, terms, train)
    draws = simulate_channels(model, rng, draws=DRAWS)
    start = predict(record, columns_of(record, terms), train).chained_rmse
    scores = []
    for name, effect in tried.items():
        try:
            candidates = [candidate for candidate in effect.candidates(record, None) if _varies(candidate, train)]
        except Exception as fault:
            # A user's effect must not end the search for the others.
            not_tried[name] = f"its columns cannot be computed: {type(fault).__name__}: {fault}"
            continue
        if candidates:
            scores.append(_score(name, candidates, model, draws))
    scores = [replace(one, family_wise_p=sidak(one.p_value, len(scores))) for one in scores]
    scores.sort(key=lambda one: -one.excess)
    rejected: dict[str, str] = {}
    for place, one in enumerate(scores):
        if one.candidate is None:
            continue
        if one.family_wise_p > (ENTRY_LEVEL if one.candidate.event_s is None else EVENT_LEVEL):
            continue
        reason = blocked_reason(tried[one.name], one.candidate, model)
        if reason is not None:
            blocked[one.name] = reason
            continue
        refined = _refined(one, tried[one.name], model)
        after = predict(
            record, np.column_stack([columns_of(record, terms), candidate_of(refined).columns]), train
        ).chained_rmse
        refined = scores[place] = replace(refined, chained_rmse=after)
        # A level shift is re-learnt by the coefficients of the next part, so an event must only not harm.
        event = candidate_of(refined).event_s is not None
        if after < EARNED * start or (event and after <= _HARMLESS * start) or not np.isfinite(after):
            return Round(start, tuple(scores), one.name, rejected), refined
        rejected[one.name] = (
            f"significant (p = {one.family_wise_p:.2g}), but the parts of the record that follow are predicted no better with it "
            f"({start:.3g} to {after:.3g} um)"
        )
    return Round(start, tuple(scores), "", rejected), None


def _score(name: str, candidates: Sequence[Candidate], model: RecordFit, draws: Sequence[Array]) -> RecordScore:
    gain, separable = gains(model, candidates, draws)
    if not separable.any():
        return RecordScore(name, None, 0.0, 0.0, 1.0, 1.0)
    gain = gain[separable]
    best = int(np.argmax(gain[:, 0]))
    null = gain[:, 1:].max(axis=0)
    candidate = candidates[int(np.flatnonzero(separable)[best])]
    value = float(gain[best, 0])
    return RecordScore(name, candidate, value, value - float(null.mean()), tail_probability(value, null), np.nan)


def _refined(score: RecordScore, effect: RecordEffect, model: RecordFit) -> RecordScore:
    """The best candidate in the neighbourhood of the one that was found."""
    near = [
        candidate for candidate in effect.candidates(model.record, score.candidate) if _varies(candidate, model.used)
    ]
    if not near:
        return score
    gain, _ = gains(model, near)
    best = int(np.argmax(gain[:, 0]))
    return replace(
        score, candidate=near[best], ranges=parameter_ranges(near, gain[:, 0], near[best], float(gain[best, 0]))
    )


def _varies(candidate: Candidate, train: NDArray[np.bool_]) -> bool:
    return bool((np.ptp(candidate.columns[train], axis=0) > 0.0).all())


def candidate_of(score: RecordScore) -> Candidate:
    """Best candidate of a scored effect."""
    assert score.candidate is not None
    return score.candidate


def _re_examine(
    record: Record, train: NDArray[np.bool_], terms: list[Term], entries: list[tuple[RecordScore, Round]]
) -> tuple[list[Term], list[tuple[RecordScore, Round]]]:
    """Drop an effect that a later one has made superfluous: its log-likelihood gain beside the others is below 2."""
    first = len(terms) - len(entries)
    for k in range(len(entries) - 1):
        others = [term for j, term in enumerate(terms) if j != first + k]
        without = fit_record(record, others, train)
        gain, separable = gains(without, [terms[first + k].candidate])
        if not separable[0] or gain[0, 0] < _SUPERFLUOUS_GAIN:
            return _re_examine(record, train, others, [pair for j, pair in enumerate(entries) if j != k])
    return terms, entries


@dataclass(frozen=True)
class Chained:
    """One part of the record, predicted from all before it by a search that knew nothing of it.

    Attributes
    ----------
    first_h, last_h : the part, hours since the start
    effects : what the search on the time before added
    rmse_persistence_um, rmse_declared_um, rmse_final_um : (channels,) errors of repeating the last value, of the declared model, and
        of the model with what was added
    """

    first_h: float
    last_h: float
    effects: tuple[str, ...]
    rmse_persistence_um: Array
    rmse_declared_um: Array
    rmse_final_um: Array


def chain_forward(
    record: Record,
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = lambda done, total, what: None,
) -> list[Chained]:
    """Predict every part of the record from the third on by the whole procedure applied to the time before it.

    Nothing of the predicted part is used: no level, no parameter, no choice of an effect.
    """
    found = []
    numbers = np.unique(record.chained)[2:]
    for done, number in enumerate(numbers):
        progress(done, numbers.size, "predicting part after part")
        before, part = record.chained < number, record.chained == number
        result = search(record, before, declared, seed=seed, effects=effects)
        predictions = result.predictions()
        hours = record.seconds[part] / 3600.0
        found.append(
            Chained(
                float(hours[0]),
                float(hours[-1]),
                tuple(score.name for score, _ in result.entries),
                persistence_rmse(record, before, part),
                channel_rmse(record, predictions[0].predicted, part),
                channel_rmse(record, predictions[-1].predicted, part),
            )
        )
    return found
