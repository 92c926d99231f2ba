"""Result of the closed loop on a record, and its form in results.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.loop.baselines import ErrorInterval, error_interval
from fusion.loop.closed_loop import not_confirmed
from fusion.loop.result import errors_json
from fusion.loop.state import Round, Step, rivals
from fusion.loop.verdict import doubt_of, exceeds_noise, has_skill, verdict
from fusion.model.fit import Term, place_of
from fusion.products.results_loop import Verdict
from fusion.record.blocks import Record
from fusion.record.model import RecordFit
from fusion.record.prediction import Prediction, channel_rmse, known_mean, rmse
from fusion.record.problem import ENTRY_LEVEL, ChainedPart, RecordState
from fusion.record.remainder import NOISE_SHARE, RecordRemainder


@dataclass(frozen=True)
class RunResult:
    """One run of a record of several.

    Attributes
    ----------
    number : of the run, from 0
    blocks : (blocks,) True for its blocks
    last_value_um, declared_um, final_um : errors of repeating its zero, of the declared and of the final model, mean over the channels, um;
        NaN where it is not held out
    verdict : word for the outcome in this run; empty where it is not held out
    """

    number: int
    blocks: NDArray[np.bool_]
    last_value_um: float = np.nan
    declared_um: float = np.nan
    final_um: float = np.nan
    verdict: Verdict | Literal[""] = ""


@dataclass(frozen=True)
class RecordResult:
    """Result of the closed loop on a record.

    Attributes
    ----------
    state : what the search on the training part found, effects that were withdrawn left out
    record : the record on its blocks
    hold_out : (blocks,) True for the hold-out set
    held_out : which part that is, in words
    predictions : of the declared model and after every added effect, from the training part
    errors : (1 + effects, channels) their errors on the hold-out set, um
    plain : (blocks, channels) each, plain predictions from the training part, by name
    left_out : (blocks, channels) each, predictions of every part from all others, um: by the final model, then without each of its effects
    whole : the final model fitted to all blocks, for its residual
    remainder : structure that the final model leaves
    chained : every part from the third on, predicted by the whole procedure on the time before it; runs from the other runs
    without : predictions of the final model without each of its effects in turn; of a record of several runs
    """

    state: RecordState
    record: Record
    hold_out: NDArray[np.bool_]
    held_out: str
    predictions: list[Prediction]
    errors: Array
    plain: Mapping[str, Array]
    left_out: list[Array]
    whole: RecordFit
    remainder: RecordRemainder
    chained: list[ChainedPart]
    without: list[Prediction] = field(default_factory=list)

    @property
    def persistence_um(self) -> Array:
        """Error of repeating the last value of the training part, (channels,) um."""
        return channel_rmse(self.record, self.plain["last_value"], self.hold_out)

    @property
    def noise_um(self) -> float:
        """Noise of a block mean, mean over the channels, um."""
        return float(np.mean(self.whole.sigma))

    @property
    def cross_um(self) -> list[float]:
        """Error of predicting every part from all others, um: of the final model, then without each of its effects."""
        everywhere = np.ones(self.hold_out.size, bool)
        return [rmse(self.record, predicted, everywhere) for predicted in self.left_out]

    @property
    def hold_out_intervals(self) -> dict[str, ErrorInterval]:
        """Errors on the hold-out set with their intervals: of the declared and the final model, and of plain predictions."""
        predicted = {
            "declared": self.predictions[0].predicted,
            "final": self.predictions[-1].predicted,
            **self.plain,
        }
        rows = np.flatnonzero(self.hold_out)
        errors = {name: (self.record.displacement - values)[rows] for name, values in predicted.items()}
        return {name: error_interval(one, rows, np.random.default_rng(1)) for name, one in errors.items()}

    @property
    def skill(self) -> bool:
        """Whether the final model predicts the hold-out set better than last value and mean of the training part."""
        last, mean = (rmse(self.record, self.plain[name], self.hold_out) for name in ("last_value", "mean"))
        return has_skill(float(known_mean(self.errors[-1])), last, mean, self.noise_um, NOISE_SHARE)

    @property
    def doubts(self) -> list[str]:
        """For every step why the hold-out set does not confirm it; empty where it does."""
        after = float(known_mean(self.errors[-1]))
        return [
            doubt_of(after, without, self.noise_um, "on the hold-out set") for without in self.state.errors_without_um
        ]

    @property
    def verdict(self) -> Verdict:
        """Word for the outcome."""
        doubts = self.doubts
        return verdict(
            confirmed=not all(doubts),
            doubtful=any(doubts),
            tested=bool(self.state.unnamed(ENTRY_LEVEL)) or self.remainder.is_tested,
            remains=bool(self.remainder.shape),
            skill=self.skill,
        )

    @property
    def runs(self) -> list[RunResult]:
        """Every run of a record of several: errors and verdict of those that are held out."""
        return [self._run(number) for number in range(len(self.record.runs))]

    def _run(self, number: int) -> RunResult:
        """One run, judged by its own errors."""
        here = self.record.run == number
        if not self.record.runs[number].held_out:
            return RunResult(number, here)
        last, mean, declared, final = (
            rmse(self.record, values, here)
            for values in (
                self.plain["last_value"],
                self.plain["mean"],
                self.predictions[0].predicted,
                self.predictions[-1].predicted,
            )
        )
        doubts = [
            doubt_of(final, rmse(self.record, one.predicted, here), self.noise_um, "in this run")
            for one in self.without
        ]
        word = verdict(
            confirmed=not all(doubts),
            doubtful=any(doubts),
            tested=bool(self.state.unnamed(ENTRY_LEVEL)) or self.remainder.is_tested,
            remains=exceeds_noise(final, self.noise_um, NOISE_SHARE),
            skill=has_skill(final, last, mean, self.noise_um, NOISE_SHARE),
        )
        return RunResult(number, here, last, declared, final, word)

    def as_json(self) -> dict[str, Any]:
        """The ``loop`` part of results.json; errors are means over the channels."""
        mean = known_mean(self.errors, axis=1)
        last = self.state.rounds[-1].scores
        return {
            "declared": [term.effect for term in self.state.declared],
            "held_out": self.held_out,
            "noise_floor_um": self.noise_um,
            "rmse_persistence_um": float(known_mean(self.persistence_um)),
            "rmse_declared_um": float(mean[0]),
            "rmse_final_um": float(mean[-1]),
            "steps": [self._step(place) for place in range(len(self.state.steps))],
            **errors_json(self.hold_out_intervals),
            "verdict": self.verdict,
            "unnamed": self.state.unnamed(ENTRY_LEVEL),
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                "p_values": self.remainder.p_values,
                "variance_share": float(known_mean(self.remainder.variance_share)),
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
                for k, name in enumerate(self.record.channels)
            },
            "chained": [
                {
                    "first_h": part.first_h,
                    "last_h": part.last_h,
                    "in_training": part.in_training,
                    "effects": list(part.effects),
                    "rmse_persistence_um": float(known_mean(part.rmse_persistence_um)),
                    "rmse_declared_um": float(known_mean(part.rmse_declared_um)),
                    "rmse_final_um": float(known_mean(part.rmse_final_um)),
                    **({"runs": list(part.runs)} if part.runs else {}),
                }
                for part in self.chained
            ],
            **({"runs": [self._run_json(run) for run in self.runs]} if self.record.runs else {}),
            "search": [_round_json(scored) for scored in self.state.rounds],
            "not_tried": self.state.not_tried(),
            "blocked": self.state.blocked(),
        }

    def _run_json(self, run: RunResult) -> dict[str, Any]:
        described = self.record.runs[run.number]
        time = self.record.time[run.blocks]
        return {
            "file": described.name,
            "held_out": described.held_out,
            "duration_h": float((time[-1] - time[0]) / np.timedelta64(1, "s") + self.record.block_s) / 3600.0,
            "blocks": int(run.blocks.sum()),
            "rmse_persistence_um": run.last_value_um,
            "rmse_declared_um": run.declared_um,
            "rmse_final_um": run.final_um,
            "verdict": run.verdict,
        }

    def _step(self, place: int) -> dict[str, Any]:
        step, term = self.state.steps[place], self.state.added[place]
        tied, runner_up = rivals(step.score, step.round.scores)
        squares = self.contribution(term) ** 2
        before, after = known_mean(self.errors[place]), known_mean(self.errors[place + 1])
        return {
            "effect": term.effect,
            "parameters": dict(term.candidate.parameters),
            "parameter_ranges": dict(step.score.ranges),
            "p_value": step.score.family_wise_p,
            "rmse_before_um": float(before),
            "rmse_after_um": float(after),
            "rmse_without_um": self.state.errors_without_um[place],
            "cross_rmse_before_um": self.cross_um[1 + place],
            "cross_rmse_after_um": self.cross_um[0],
            "rms_um": float(np.sqrt(np.mean(squares))),
            "rms_by_channel_um": {
                name: float(np.sqrt(np.mean(squares[:, channel]))) for channel, name in enumerate(self.record.channels)
            },
            "chained_rmse_before_um": step.round.start_error_um,
            "chained_rmse_after_um": _error_after(step),
            "tied": tied,
            "runner_up": runner_up,
            "rejected": _rejected(step.round),
            "confirmed": not self.doubts[place],
            "doubt": self.doubts[place],
            "confirmed_by": str(step.confirmed),
            "event_s": term.candidate.event_s,
        }

    def contribution(self, term: Term) -> Array:
        """Contribution of a term to the prediction by the final model, about its mean.

        Parameters
        ----------
        term : of the final model

        Returns
        -------
        (blocks, channels) ndarray, um
        """
        place = place_of(self.state.model.terms, term)
        series = term.candidate.columns @ self.predictions[-1].coefficients[place]
        return np.asarray(series - series.mean(axis=0))


def _error_after(step: Step) -> float:
    return step.score.confirmation.error_um if step.score.confirmation else np.nan


def _rejected(scored: Round) -> dict[str, str]:
    """Effects of a round that were significant and not confirmed, with the reason in words."""
    return {
        score.name: not_confirmed(score, scored).sentence
        for score in scored.scores
        if score.confirmation is not None and not score.confirmation.passed
    }


def _round_json(scored: Round) -> list[dict[str, Any]]:
    rejected = _rejected(scored)
    return [
        {
            "effect": score.name,
            "parameters": dict(score.candidate.parameters) if score.candidate else {},
            "gain": score.gain,
            "excess_gain": score.excess,
            "p_value": score.p_value,
            "family_wise_p": score.family_wise_p,
            "chained_rmse_before_um": scored.start_error_um,
            "chained_rmse_after_um": score.confirmation.error_um if score.confirmation else np.nan,
            "chosen": score.confirmation is not None and score.confirmation.passed,
            "rejected": rejected.get(score.name, ""),
        }
        for score in scored.scores
    ]
