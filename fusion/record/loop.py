"""What the closed loop on a record has to tell: errors on the sealed part, steps, verdict, as results.json says it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.effects.library import Effect
from fusion.loop.result import rivals
from fusion.model.fit import Term, place_of
from fusion.record.blocks import Record
from fusion.record.model import RecordFit, columns_of, fit_record
from fusion.record.prediction import Prediction, channel_rmse, persistence_rmse, predict
from fusion.record.remainder import RecordRemainder, examine
from fusion.record.search import (
    EARNED,
    MOST_EFFECTS,
    Chained,
    Progress,
    Round,
    Search,
    candidate_of,
    chain_forward,
    declare,
    seal,
    search,
)


@dataclass(frozen=True)
class RecordResult:
    """Everything the loop found on a record.

    Attributes
    ----------
    found : the search on the time before the seal, effects that the seal withdrew left out
    sealed : (blocks,) True for the sealed part
    held_out : which part is sealed, in words
    predictions : of the declared model and after every added effect, from before the seal
    errors : (1 + effects, channels) their errors on the sealed part, um
    persistence_um : (channels,) error of repeating the last value before the seal
    whole : the final model fitted to all blocks, for what it leaves
    remainder : what is left
    chained : every part from the third on, predicted by the whole procedure on the time before it
    """

    found: Search
    sealed: NDArray[np.bool_]
    held_out: str
    predictions: list[Prediction]
    errors: Array
    persistence_um: Array
    whole: RecordFit
    remainder: RecordRemainder
    chained: list[Chained]

    @property
    def verdict(self) -> str:
        """complete, explained, partial or unexplained."""
        if self.found.entries:
            return "partial" if self.remainder.shape else "explained"
        return "unexplained" if self.remainder.shape else "complete"

    def as_json(self) -> dict[str, Any]:
        """The ``loop`` part of results.json; errors are means over the channels."""
        record = self.found.record
        mean = np.nanmean(self.errors, axis=1)
        last = self.found.rounds[-1].scores
        return {
            "declared": [term.effect for term in self.found.terms[: self.found.declared]],
            "held_out": self.held_out,
            "noise_floor_um": float(np.mean(self.whole.sigma)),
            "rmse_persistence_um": float(np.nanmean(self.persistence_um)),
            "rmse_declared_um": float(mean[0]),
            "rmse_final_um": float(mean[-1]),
            "steps": [self._step(k) for k in range(len(self.found.entries))],
            "verdict": self.verdict,
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                "p_values": self.remainder.p_values,
                "variance_share": float(np.nanmean(self.remainder.variance_share)),
                "nearest": last[0].name if self.remainder.shape and last else "",
            },
            "channels": {
                name: {
                    "rmse_persistence_um": float(self.persistence_um[k]),
                    "rmse_declared_um": float(self.errors[0, k]),
                    "rmse_final_um": float(self.errors[-1, k]),
                    "noise_um": float(self.whole.sigma[k]),
                    "variance_share": float(self.remainder.variance_share[k]),
                }
                for k, name in enumerate(record.channels)
            },
            "chained": [
                {
                    "first_h": one.first_h,
                    "last_h": one.last_h,
                    "effects": list(one.effects),
                    "rmse_persistence_um": float(np.nanmean(one.rmse_persistence_um)),
                    "rmse_declared_um": float(np.nanmean(one.rmse_declared_um)),
                    "rmse_final_um": float(np.nanmean(one.rmse_final_um)),
                }
                for one in self.chained
            ],
            "search": [_round_json(one) for one in self.found.rounds],
            "not_tried": dict(self.found.not_tried),
            "blocked": dict(self.found.blocked),
        }

    def _step(self, k: int) -> dict[str, Any]:
        score, turn = self.found.entries[k]
        term = self.found.terms[self.found.declared + k]
        tied, runner_up = rivals(score, turn.scores)
        squares = self.contribution(term) ** 2
        before, after = np.nanmean(self.errors[k]), np.nanmean(self.errors[k + 1])
        return {
            "effect": term.effect,
            "parameters": dict(term.candidate.parameters),
            "parameter_ranges": dict(score.ranges),
            "p_value": score.family_wise_p,
            "rmse_before_um": float(before),
            "rmse_after_um": float(after),
            "rms_um": float(np.sqrt(np.mean(squares))),
            "rms_by_channel_um": {
                name: float(np.sqrt(np.mean(squares[:, channel])))
                for channel, name in enumerate(self.found.record.channels)
            },
            "chained_rmse_before_um": turn.chained_rmse,
            "chained_rmse_after_um": score.chained_rmse,
            "tied": tied,
            "runner_up": runner_up,
            "rejected": dict(turn.rejected),
            "confirmed": "parts of the record before the seal, each predicted from those before it, are predicted better with it",
            "event_s": term.candidate.event_s,
        }

    def contribution(self, term: Term) -> Array:
        """What a term contributes to the prediction by the final model, about its mean, um (blocks, channels)."""
        place = place_of(self.found.terms, term)
        series = term.candidate.columns @ self.predictions[-1].coefficients[place]
        return np.asarray(series - series.mean(axis=0))


def _round_json(turn: Round) -> list[dict[str, Any]]:
    return [
        {
            "effect": one.name,
            "parameters": dict(one.candidate.parameters) if one.candidate else {},
            "gain": one.gain,
            "excess_gain": one.excess,
            "p_value": one.p_value,
            "family_wise_p": one.family_wise_p,
            "chained_rmse_before_um": turn.chained_rmse,
            "chained_rmse_after_um": one.chained_rmse,
            "chosen": one.name == turn.chosen,
            "rejected": turn.rejected.get(one.name, ""),
        }
        for one in turn.scores
    ]


def close_record(
    record: Record,
    declared: Sequence[str],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = lambda done, total, what: None,
) -> RecordResult:
    """Close the loop on a record.

    Parameters
    ----------
    record : the record on its blocks
    declared : names of the declared effects; ``quasi_static`` is the only one that a record can be declared with
    seed : of the simulated records behind the p-values, so that a run can be repeated
    effects : the library; the built-in one with the user's own by default

    Raises
    ------
    RecordError
        if a name has no meaning for a record, or a channel is too short for the model.
    """
    terms = declare(declared, record)
    before, held_out = seal(record)
    found = search(record, before, terms, seed=seed, effects=effects, progress=progress)
    found, predictions, errors = open_seal(found)
    chained = chain_forward(record, terms, seed=seed, effects=effects, progress=progress)
    kept = without_unrepeated(found, chained)
    if kept is not found:
        found, predictions, errors = open_seal(kept)
    progress(MOST_EFFECTS, MOST_EFFECTS, "examining what is left")
    whole = fit_record(record, found.terms, np.ones_like(before))
    remainder = examine(whole, errors[-1], np.random.default_rng(seed))
    persistence = persistence_rmse(record, before, ~before)
    return RecordResult(found, ~before, held_out, predictions, errors, persistence, whole, remainder, chained)


def open_seal(found: Search) -> tuple[Search, list[Prediction], Array]:
    """Errors on the sealed part of every model in turn; an effect beside which the others do as well without it is withdrawn.

    Nothing is re-zeroed at the seal, so an event before it has to prove itself there like any other effect.
    """
    predictions = found.predictions()
    errors = np.array([channel_rmse(found.record, one.predicted, ~found.train) for one in predictions])
    final = float(np.nanmean(errors[-1]))
    without = [_sealed_error_without(found, k) for k in range(len(found.entries))]
    if not without or final < min(without):
        return found, predictions, errors
    worst = int(np.argmin(without))
    reason = (
        f"withdrawn: it was found before the seal (p = {found.entries[worst][0].family_wise_p:.2g}), but the sealed part is predicted no "
        f"better with it ({without[worst]:.3g} to {final:.3g} um)"
    )
    return open_seal(_withdrawn(found, worst, reason))


def _sealed_error_without(found: Search, k: int) -> float:
    """Error on the sealed part, mean over channels, of the model without its k-th effect, um."""
    terms = [term for place, term in enumerate(found.terms) if place != found.declared + k]
    predicted = predict(found.record, columns_of(found.record, terms), found.train).predicted
    return float(np.nanmean(channel_rmse(found.record, predicted, ~found.train)))


def without_unrepeated(found: Search, chained: Sequence[Chained]) -> Search:
    """The search without effects that the same procedure also found on earlier time, and predicted no better with.

    A model may fall upon the sealed part by chance; where it has been tried on several parts, all of them count. An event is not asked: it
    happens once.
    """
    for k, (score, _) in enumerate(found.entries):
        tried = [one for one in chained if score.name in one.effects]
        if not tried or candidate_of(score).event_s is not None:
            continue
        before, after = (
            float(np.nanmean([np.nanmean(one) for one in errors]))
            for errors in zip(*((one.rmse_declared_um, one.rmse_final_um) for one in tried), strict=True)
        )
        if after >= EARNED * before:
            parts = "the part" if len(tried) == 1 else f"the {len(tried)} parts"
            reason = (
                f"withdrawn: it was found before the seal (p = {score.family_wise_p:.2g}), but {parts} of the record that it was tried on "
                f"with the time before alone came out no better ({before:.3g} to {after:.3g} um)"
            )
            return without_unrepeated(_withdrawn(found, k, reason), chained)
    return found


def _withdrawn(found: Search, k: int, reason: str) -> Search:
    """The search without its k-th effect, with the reason."""
    kept = [j for j in range(len(found.entries)) if j != k]
    terms = (*found.terms[: found.declared], *(found.terms[found.declared + j] for j in kept))
    blocked = {**found.blocked, found.entries[k][0].name: reason}
    return replace(found, terms=terms, entries=tuple(found.entries[j] for j in kept), blocked=blocked)
