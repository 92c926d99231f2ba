"""The search for an effect that a model lacks, on the readings that it may use."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.alignment.readings import Readings
from fusion.effects.candidates import Candidate
from fusion.effects.jumps import cycle_starts
from fusion.effects.library import LIBRARY, Effect
from fusion.errors import FusionError
from fusion.loop.admissibility import blocked_reason
from fusion.loop.detectability import Identifiable, identify
from fusion.loop.scoring import CandidateScorer, FamilyScore, ask_sealed, prior_rows
from fusion.model.fit import ModelFit, Term, fit_model
from fusion.model.null_simulation import simulate_null

#: Chance of adding an effect where nothing is missing, over everything that is tried. The search before the seal has the largest part
#: of it; the rest is for the one question to the sealed cycles and for the look at all cycles after that. Every effect that is found
#: opens the search again with the same chance, and a campaign may lack two: half of the 5 % that a wrong name may have.
ENTRY_LEVEL = 0.025
SEARCH_LEVEL, ASKED_LEVEL, SECOND_LEVEL = 0.015, 0.005, 0.005
#: Chance that an effect which is not there passes its confirmation on unused readings; the search has been paid for already.
CONFIRMATION_LEVEL = 0.1
#: Evidence so strong that an inconclusive confirmation does not stop it: few switchings of a load leave early blocks without a say.
#: The sealed cycles then decide, because an effect that makes their error larger is withdrawn.
STRONG_LEVEL = 0.001
#: An effect with a larger p-value, uncorrected, is not worth the one question to the sealed readings.
_WORTH_ASKING = 0.1
#: Effects whose log-likelihoods differ by less than this (odds of 20 to 1) are reported as a tie.
TIE_GAIN = 3.0
#: Effects with a larger p-value are not looked at more closely, because they will not enter anyway.
_WORTH_CONFIRMING = 0.1
#: Share of the cycles from which the later ones are predicted to confirm an effect.
_EARLY_SHARE = 0.5
#: Neighbourhoods that are looked at in turn: the search tries few states for every wave, and the best is a neighbour's neighbour.
#: A gain in log-likelihood below this is not worth another one.
_CLOSER_LOOKS = 3
_WORTH_MOVING = 0.1
_MAY_REPEAT = frozenset({"step_event", "camera_offset", "sensor_fault", "periodic_disturbance"})


_BUILT_IN = frozenset(effect.name for effect in LIBRARY)


@dataclass(frozen=True)
class SealedQuestion:
    """The one question to the sealed readings: is this effect there? Errors without and with it, their p-value, and the answer."""

    effect: str
    parameters: Mapping[str, float | str]
    rmse_before_um: float
    rmse_after_um: float
    p_value: float
    entered: bool


class SearchError(FusionError):
    """An effect does not keep its promises; the message names it."""


class Search:
    """The search on the readings that are not sealed."""

    def __init__(
        self,
        readings: Readings,
        used: NDArray[np.bool_],
        effects: Mapping[str, Effect],
        rng: np.random.Generator,
    ) -> None:
        self.readings, self.used, self.effects, self.rng = readings, used, effects, rng
        self.not_tried = {
            name: reason for name, effect in effects.items() if (reason := effect.needs(readings)) is not None
        }
        self.blocked: dict[str, str] = {}
        self.question: SealedQuestion | None = None
        self.identifiable: list[Identifiable] = []

    def fit(self, terms: Sequence[Term]) -> ModelFit:
        """Fit terms to the readings that are not sealed."""
        return fit_model(self.readings, terms, used=self.used)

    def _families(self, model: ModelFit) -> dict[str, list[Candidate]]:
        present = {term.effect for term in model.terms}
        # One event happens once, however its column was weighed when it was found.
        happened = {(term.effect, term.candidate.event_s) for term in model.terms if term.candidate.event_s is not None}
        families = {}
        for name, effect in self.effects.items():
            if name in self.not_tried:
                continue
            if name in present and name not in _MAY_REPEAT:
                continue
            try:
                offered = effect.candidates(self.readings, model.coefficients(), None)
                families[name] = [candidate for candidate in offered if (name, candidate.event_s) not in happened]
                _check_columns(families[name], self.readings)
            except Exception as fault:
                # A user's effect must not end the search for the others; a fault of our own must be seen.
                if name in _BUILT_IN:
                    raise
                families.pop(name, None)
                self.not_tried[name] = f"its columns cannot be computed: {type(fault).__name__}: {fault}"
        return families

    def scores(self, model: ModelFit) -> list[FamilyScore]:
        """Score the whole library against the model, on the readings the model was fitted to, best excess first.

        Effects that are worth it are looked at more closely before they are compared, each at its best, and are confirmed.
        """
        judge = self._judge(model)
        families = {name: self._inside(candidates, model) for name, candidates in self._families(model).items()}
        families = {name: candidates for name, candidates in families.items() if candidates}
        if not families:
            return []
        scores = judge.score(families, level=SEARCH_LEVEL)
        if not self.identifiable:
            self.identifiable = identify(judge, model, families, scores, self.effects)
        for score in scores:
            if score.candidate is None:
                self.blocked[score.name] = (
                    "nothing of it is left beside the model: its columns are constant or collinear with the static profile, the declared "
                    "effects and what was added"
                )
        worth = [
            k for k, score in enumerate(scores) if score.candidate is not None and score.p_value < _WORTH_CONFIRMING
        ]
        closer = judge.confirm([self._refined(scores[k], judge, model) for k in worth], families)
        for k, score in zip(worth, closer, strict=True):
            scores[k] = score
        return sorted(scores, key=lambda score: -score.excess)

    def _inside(self, candidates: Iterable[Candidate], model: ModelFit) -> list[Candidate]:
        """Candidates whose event, if they have one, has enough cycles on both sides."""
        starts = cycle_starts(self.readings.subset(model.used))
        return [
            candidate
            for candidate in candidates
            if candidate.event_s is None or starts[2] <= candidate.event_s <= starts[-2]
        ]

    def _judge(self, model: ModelFit) -> CandidateScorer:
        part = self.readings.subset(model.used)
        numbers = np.unique(part.cycle)
        early = np.searchsorted(numbers, part.cycle) < _EARLY_SHARE * numbers.size
        return CandidateScorer(
            model.fit,
            simulate_null(model.fit, self.rng),
            early,
            part.target_index % 2 == 0,
            model.used,
            prior_rows(model, self.rng),
        )

    def choose(
        self, scores: Sequence[FamilyScore], model: ModelFit, *, level: float = SEARCH_LEVEL
    ) -> FamilyScore | None:
        """Best effect that is significant, confirmed and not blocked."""
        strongest = -np.inf
        for score in scores:
            if score.candidate is None or score.family_wise_p > level or self._withdrawn(score):
                continue
            # Where a stronger effect could not be confirmed, a much weaker one only stands in for it.
            if score.excess < strongest - TIE_GAIN:
                return None
            reason = self._blocked(score, model)
            if reason is not None:
                self.blocked[score.name] = reason
                continue
            if score.held_out_p <= CONFIRMATION_LEVEL or score.family_wise_p <= STRONG_LEVEL:
                return score
            strongest = max(strongest, score.excess)
        return None

    def _withdrawn(self, score: FamilyScore) -> bool:
        return self.blocked.get(score.name, "").startswith("withdrawn:")

    def _blocked(self, score: FamilyScore, model: ModelFit) -> str | None:
        part = self.readings.subset(model.used)
        return blocked_reason(self.effects[score.name], _on(candidate_of(score), model.used), part, model)

    def ask_sealed(self, scores: Sequence[FamilyScore], model: ModelFit) -> FamilyScore | None:
        """Put the strongest candidate that the search could not decide on to the sealed readings, as a single question.

        One question, chosen before the seal is opened, needs no correction for the search.
        """
        for score in scores:
            if score.candidate is None or score.p_value > _WORTH_ASKING or score.name in self.blocked:
                continue
            reason = self._blocked(score, model)
            if reason is not None:
                self.blocked[score.name] = reason
                continue
            before, after, p_value = ask_sealed(model, candidate_of(score), self.rng)
            entered = after < before and p_value <= ASKED_LEVEL
            self.question = SealedQuestion(score.name, candidate_of(score).parameters, before, after, p_value, entered)
            return replace(score, held_out_p=p_value) if entered else None
        return None

    def _refined(self, score: FamilyScore, judge: CandidateScorer, model: ModelFit) -> FamilyScore:
        """The best candidate in the neighbourhood of the one that was found, and in that one's, as long as it moves."""
        for _ in range(_CLOSER_LOOKS):
            before = score.gain
            score = self._best_near(score, judge, model)
            if score.gain < before + _WORTH_MOVING:
                break
        return score

    def _best_near(self, score: FamilyScore, judge: CandidateScorer, model: ModelFit) -> FamilyScore:
        """The best candidate next to the one that was found, or the same score where none is better."""
        found = candidate_of(score)
        offered = self.effects[score.name].candidates(self.readings, model.coefficients(), found)
        near = self._inside((candidate for candidate in offered if _same_kind(candidate, found)), model)
        if not near:
            raise SearchError(
                f"effect {score.name!r} offers no candidate near one it offered before: {dict(found.parameters)}"
            )
        return judge.refine(score, near)


def _check_columns(candidates: Sequence[Candidate], readings: Readings) -> None:
    """Refuse columns that are not one finite number per reading, which a user's effect may offer."""
    for candidate in candidates:
        columns = np.asarray(candidate.columns)
        if columns.ndim != 2 or columns.shape[0] != readings.seconds.size:
            raise SearchError(f"columns have shape {columns.shape}; expected ({readings.seconds.size}, columns)")
        if not np.isfinite(columns).all():
            raise SearchError(
                f"{int((~np.isfinite(columns)).sum())} values are not finite at {dict(candidate.parameters)}"
            )
        if len(candidate.units) != columns.shape[1]:
            raise SearchError(
                f"{columns.shape[1]} columns but {len(candidate.units)} units at {dict(candidate.parameters)}"
            )


#: Words that a closer look may change: what a lead may be mistaken for, the state that scales a pattern, and what the machine did
#: before the log began.
_OPEN_WORDS = frozenset({"possible_leads", "follows", "start"})


def _same_kind(candidate: Candidate, found: Candidate) -> bool:
    """Alike in what is a word (shape, sensor); numbers may differ."""
    words = {
        name: value for name, value in found.parameters.items() if isinstance(value, str) and name not in _OPEN_WORDS
    }
    return all(candidate.parameters.get(name) == value for name, value in words.items())


def _on(candidate: Candidate, used: NDArray[np.bool_]) -> Candidate:
    return Candidate(candidate.columns[used], candidate.parameters, candidate.units, candidate.event_s)


def candidate_of(score: FamilyScore) -> Candidate:
    """Best candidate of a scored effect."""
    if score.candidate is None:
        raise SearchError(f"effect {score.name!r} has no candidate that can be told from the model")
    return score.candidate
