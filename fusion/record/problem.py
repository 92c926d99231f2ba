"""A record for the closed loop: how its candidates are made, scored, confirmed and predicted.

Every channel has a drift and coefficients of its own; an effect enters only if the parts of the training time that follow are also
predicted better with it, from coefficients shrunk together. The procedure is that of :mod:`fusion.loop.closed_loop`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.effects.effect import Candidate, Effect
from fusion.effects.library import LIBRARY
from fusion.loop.admissibility import refuse
from fusion.loop.closed_loop import Progress, no_progress, search
from fusion.loop.decisions import Decision, Reason
from fusion.loop.scoring import Families, collect_candidates, of_same_kind, refine, score_effects
from fusion.loop.state import Confirmation, Confirmed, LoopState, Round, Score
from fusion.model.fit import Term
from fusion.model.null_simulation import DRAWS
from fusion.record.blocks import Record
from fusion.record.effects import record_library
from fusion.record.grounds import RecordGrounds
from fusion.record.hold_out import hold_out
from fusion.record.model import RecordFit, channel_gains, columns_of, fit_record, simulate_channels
from fusion.record.prediction import Prediction, channel_rmse, folds, known_mean, persistence_rmse, predict

#: Probability of adding an effect where only drift and noise act. A drift that wanders at random is a stand-in for what a real machine
#: does, and its sensors are late, so the probability is smaller than along an axis: that of an error of three standard deviations.
ENTRY_LEVEL = 0.001
#: An effect must bring the error of predicting later parts down to this share of what it was, or it only follows chance.
EARNED = 0.98
#: An event may make that error larger by this factor: chance, not harm.
_HARMLESS = 1.01
_BUILT_IN = frozenset(effect.name for effect in LIBRARY)

RecordState = LoopState[RecordFit]


class RecordProblem:
    """A record, the blocks of it that may be used, and the library, for :mod:`fusion.loop.closed_loop`."""

    def __init__(
        self,
        record: Record,
        train: NDArray[np.bool_],
        effects: Mapping[str, Effect] | None,
        rng: np.random.Generator,
    ) -> None:
        self.record, self.train, self.rng = record, train, rng
        self.effects, self._not_tried = record_library(effects)

    def start(self, declared: Sequence[Term]) -> RecordState:
        """The state before the search: the declared model, and the effects that this record cannot show."""
        missing = {name: effect.needs(self.record) for name, effect in self.effects.items()}
        reasons = {**self._not_tried, **{name: because for name, because in missing.items() if because is not None}}
        return RecordState(fit_record(self.record, declared, self.train)).decide(
            *(Decision(name, Reason.NOT_AVAILABLE, {"because": because}) for name, because in reasons.items())
        )

    def refit(self, model: RecordFit, terms: Sequence[Term]) -> RecordFit:
        """Fit other terms to the blocks that a model was fitted to."""
        return fit_record(self.record, terms, model.used)

    def score(self, state: RecordState) -> Round:
        """Score the library under drifts that wander by themselves in every channel."""
        model = state.model
        families, faults = self._families(state)
        start = self.predict(model.terms).chained_rmse
        if not families:
            return Round((), tuple(faults), start)
        draws = simulate_channels(model, self.rng, draws=DRAWS)
        gains = channel_gains(model, [candidate for candidates in families.values() for candidate in candidates], draws)
        scores, decisions = score_effects(
            families, gains, level=ENTRY_LEVEL, is_admissible=RecordGrounds(model).is_admissible
        )
        return Round(tuple(scores), (*faults, *decisions), start)

    def entry_level(self, score: Score) -> float:
        """Level of entry."""
        return ENTRY_LEVEL

    def refuse(self, score: Score, model: RecordFit) -> Decision | None:
        """Refuse an effect that this record does not identify; a user's own effect is only held against the switchings."""
        excited_by = self.effects[score.name].excited_by if score.name in _BUILT_IN else ""
        return refuse(score.name, excited_by, score.best, RecordGrounds(model, least_gain=score.critical))

    def confirm(self, score: Score, state: RecordState) -> Score:
        """Look at the effect more closely, and predict the later parts of the training time with it."""
        near = partial(self._near, score.name)
        score = refine(score, near, partial(channel_gains, state.model))
        before = state.rounds[-1].start_error_um
        after = self.predict([*state.model.terms, Term(score.name, score.best)]).chained_rmse
        # A level shift is learnt again by the coefficients of the next part, so an event must only not harm.
        passed = after < EARNED * before or (score.is_event and after <= _HARMLESS * before) or not np.isfinite(after)
        return replace(score, confirmation=Confirmation(passed, Confirmed.LATER_PARTS, error_um=after))

    def loss_without(self, model: RecordFit, term: Term) -> float:
        """Log-likelihood lost without a term."""
        without = self.refit(model, [other for other in model.terms if other is not term])
        gains = channel_gains(without, [term.candidate])
        return float(gains.gain[0, 0]) if gains.separable[0] else 0.0

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Error of predicting the blocks that may not be used, mean over the channels, um."""
        return float(known_mean(channel_rmse(self.record, self.predict(terms).predicted, ~self.train)))

    def predict(self, terms: Sequence[Term]) -> Prediction:
        """Predict all blocks from the training part."""
        return predict(self.record, columns_of(self.record, terms), self.train)

    def _families(self, state: RecordState) -> tuple[Families, list[Decision]]:
        """Candidates of every effect that can be tried beside the model and that vary over the training part."""
        not_tried = state.not_tried()
        repeating = {name for name, effect in self.effects.items() if effect.repeats}
        present = {term.effect for term in state.model.terms} - repeating
        offers = {
            name: partial(self._offer, name, None)
            for name in self.effects
            if name not in not_tried and name not in present
        }
        families, faults = collect_candidates(offers, self.record.seconds.size, built_in=_BUILT_IN)
        return {name: candidates for name, candidates in families.items() if candidates}, faults

    def _offer(self, name: str, near: Candidate | None) -> list[Candidate]:
        offered = self.effects[name].candidates(self.record, near)
        return [one for one in offered if (np.ptp(one.columns[self.train], axis=0) > 0.0).all()]

    def _near(self, name: str, chosen: Candidate) -> list[Candidate]:
        """Candidates of an effect about one that was chosen, the chosen one where there is no other."""
        return [one for one in self._offer(name, chosen) if of_same_kind(one, chosen)] or [chosen]


@dataclass(frozen=True)
class ChainedPart:
    """One part of a record, predicted from all before it by a search that had not seen it.

    Attributes
    ----------
    first_h, last_h : the part, hours since the start
    in_training : whether it lies before the hold-out set
    effects : what the search on the time before added
    rmse_persistence_um, rmse_declared_um, rmse_final_um : (channels,) errors of repeating the last value, of the declared model, and
        of the model with what was added
    runs : names of the runs that it consists of; empty in a record of one run
    """

    first_h: float
    last_h: float
    in_training: bool
    effects: tuple[str, ...]
    rmse_persistence_um: Array
    rmse_declared_um: Array
    rmse_final_um: Array
    runs: tuple[str, ...] = ()


@threadpool_limits.wrap(limits=1, user_api="blas")
def search_record(
    record: Record,
    train: NDArray[np.bool_],
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> tuple[RecordProblem, RecordState]:
    """Search the library for what the declared terms lack, on the training part alone.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for those that may be used
    declared : terms of the declared model
    seed : of the simulated records behind the p-values
    effects : the library by name; the built-in one with the user's own by default
    progress : called with steps done, steps in total, and what is done
    """
    problem = RecordProblem(record, train, effects, np.random.default_rng(seed))
    return problem, search(problem, problem.start(declared), progress=progress)


def chain_forward(
    record: Record,
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> list[ChainedPart]:
    """Predict every part of the record from the third on by the whole procedure applied to the time before it; runs from the other runs.

    Nothing of the predicted part is used: no level, no parameter, no choice of an effect.

    Parameters
    ----------
    record : on its blocks
    declared : terms of the declared model
    seed, effects, progress : as for :func:`search_record`
    """
    train, _ = hold_out(record)
    parts = []
    asked = chained_folds(record, train)
    for done, (before, part) in enumerate(asked):
        progress(done, len(asked), "predicting part after part")
        problem, state = search_record(record, before, declared, seed=seed, effects=effects)
        hours = record.seconds[part] / 3600.0
        parts.append(
            ChainedPart(
                float(hours[0]),
                float(hours[-1]),
                bool(train[part].all()),
                tuple(step.effect for step in state.steps),
                persistence_rmse(record, before, part),
                channel_rmse(record, problem.predict(state.declared).predicted, part),
                channel_rmse(record, problem.predict(state.model.terms).predicted, part),
                tuple(record.runs[run].name for run in np.unique(record.run[part])) if record.runs else (),
            )
        )
    return parts


def chained_folds(record: Record, train: NDArray[np.bool_]) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Parts that the whole procedure predicts, and what it predicts them from.

    Parameters
    ----------
    record : on its blocks
    train : (blocks,) True for the training part

    Returns
    -------
    list of (used, predicted)
        (blocks,) each. Of two or more training runs, every one from the others; else every part from the third on from all before it, in
        the training part alone where other runs are held out.
    """
    if np.unique(record.run[train]).size > 1:
        return folds(record, train)
    within = train if record.runs else np.ones_like(train)
    return [
        (within & (record.chained < one), within & (record.chained == one))
        for one in np.unique(record.chained[within])[2:]
    ]
