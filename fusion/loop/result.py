"""What the closed loop has to tell: the steps it took, their errors and uncertainties, and the verdict, as results.json says it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.diagnosis.remainder import Remainder
from fusion.effects.candidates import Candidate
from fusion.loop.detectability import Identifiable
from fusion.loop.scoring import FamilyScore, Range
from fusion.loop.search import CONFIRMATION_LEVEL, SEARCH_LEVEL, TIE_GAIN, SealedQuestion
from fusion.model.fit import ModelFit, Term, unexplained_drift

#: An effect that is not even significant alone is no rival.
_RIVAL_LEVEL = 0.05


@dataclass(frozen=True)
class Step:
    """An effect that was added.

    Attributes
    ----------
    effect, parameters, coefficients : what was added; coefficients by unit as (value, standard uncertainty), from all cycles
    parameter_ranges : values of the parameters that fit as well (profile likelihood, 95 %)
    p_value : chance that the search adds any effect where nothing is missing
    held_out_p : chance of its gain on unused readings where it is not there
    rmse_before_um, rmse_after_um : open-loop error on the sealed cycles without and with it
    rms_um : size of its contribution, root mean square after the static profile is removed
    tied : effects that these data cannot tell from it
    runner_up : the next best effect, its gain and how far behind it is in log-likelihood
    confirmed : how it was confirmed
    event_cycle : the cycle in which an event happened, None for an effect that is no event
    """

    effect: str
    parameters: Mapping[str, float | str]
    parameter_ranges: Mapping[str, Range]
    coefficients: list[dict[str, float | str]]
    p_value: float
    held_out_p: float
    rmse_before_um: float
    rmse_after_um: float
    rms_um: float
    tied: list[str]
    runner_up: dict[str, float | str]
    confirmed: str
    event_cycle: int | None


@dataclass(frozen=True)
class LoopResult:
    """Everything the loop found; see DESIGN of results.json for the meaning of the verdicts."""

    declared: list[str]
    declared_coefficients: list[dict[str, float | str]]
    held_out: str
    noise_floor_um: float
    rmse_persistence_um: float
    rmse_declared_um: float
    rmse_final_um: float
    steps: list[Step]
    verdict: str
    remainder: Remainder
    rounds: list[list[FamilyScore]]
    not_tried: dict[str, str]
    blocked: dict[str, str]
    question: SealedQuestion | None
    identifiable: list[Identifiable]
    nuisance: dict[str, float | str]
    before: ModelFit
    after: ModelFit

    def as_json(self) -> dict[str, object]:
        """The ``loop`` part of results.json."""
        return {
            "declared": self.declared,
            "declared_coefficients": self.declared_coefficients,
            "held_out": self.held_out,
            "noise_floor_um": self.noise_floor_um,
            "rmse_persistence_um": self.rmse_persistence_um,
            "rmse_declared_um": self.rmse_declared_um,
            "rmse_final_um": self.rmse_final_um,
            "steps": [_step_json(step) for step in self.steps],
            "verdict": self.verdict,
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                **self._nearest(),
            },
            "nuisance": self.nuisance,
            "sealed_question": vars(self.question) | {"parameters": dict(self.question.parameters)}
            if self.question
            else {},
            "search": [[_score_json(score) for score in scores] for scores in self.rounds],
            "identifiability": [vars(one) for one in self.identifiable],
            "not_tried": self.not_tried,
            "blocked": self.blocked,
        }

    def _nearest(self) -> dict[str, object]:
        """The effect that explains the largest share of what is left, its p-value in the search, and that share."""
        added = {step.effect for step in self.steps}
        rivals = [score for scores in self.rounds for score in scores if score.candidate and score.name not in added]
        if not self.remainder.shape or not rivals:
            return {"nearest": "", "nearest_p": None, "nearest_share": None}
        shares = [self.remainder.share_of(score.candidate.columns) for score in rivals if score.candidate]
        best = int(np.argmax(shares))
        return {
            "nearest": rivals[best].name,
            "nearest_p": rivals[best].family_wise_p,
            "nearest_share": shares[best],
        }


def _step_json(step: Step) -> dict[str, object]:
    return {**vars(step), "parameters": dict(step.parameters), "parameter_ranges": dict(step.parameter_ranges)}


def _score_json(score: FamilyScore) -> dict[str, object]:
    return {
        "effect": score.name,
        "parameters": dict(score.candidate.parameters) if score.candidate else {},
        "gain": score.gain,
        "excess_gain": score.excess,
        "p_value": score.p_value,
        "family_wise_p": score.family_wise_p,
        "held_out_gain": score.held_out_gain,
        "held_out_p": score.held_out_p,
        "share_not_separable": score.collinear,
    }


def coefficients_of(model: ModelFit, term: Term) -> list[dict[str, float | str]]:
    """Coefficients of a term with their standard uncertainty and unit, and with the prior that went into the first one."""
    place = model.place(term)
    values, u = model.fit.coefficients[place], model.fit.coefficients_u[place]
    found: list[dict[str, float | str]] = [
        {"value": float(value), "u": float(spread), "unit": unit}
        for value, spread, unit in zip(values, u, term.candidate.units, strict=True)
    ]
    if term.candidate.prior is not None:
        found[0] |= {"prior": term.candidate.prior.mean, "prior_u": term.candidate.prior.u}
    return found


def _size(model: ModelFit, term: Term) -> float:
    """Root mean square of a term's contribution after its mean at every site is removed, um."""
    series = model.series(term)[0]
    site = model.readings.target_index * 2 + (model.readings.sign < 0)
    total = np.bincount(site, series, minlength=site.max() + 1)
    number = np.maximum(np.bincount(site, minlength=site.max() + 1), 1)
    return float(np.sqrt(np.mean((series - (total / number)[site]) ** 2)))


class Scored(Protocol):
    """What a score of any search tells of its effect."""

    @property
    def name(self) -> str:
        """Effect."""

    @property
    def candidate(self) -> Candidate | None:
        """Its best candidate, None where none can be told from the model."""

    @property
    def excess(self) -> float:
        """Gain beyond what chance finds."""

    @property
    def p_value(self) -> float:
        """Chance of the gain for this effect alone."""

    @property
    def family_wise_p(self) -> float:
        """The same for the best of all that were tried."""


def rivals(score: Scored, scores: Sequence[Scored]) -> tuple[list[str], dict[str, float | str]]:
    """Effects of a round (best excess first) that these data cannot tell from the chosen one; the next best, how far behind."""
    others = [other for other in scores if other.name != score.name and other.candidate is not None]
    tied = [other.name for other in others if other.p_value < _RIVAL_LEVEL and score.excess - other.excess < TIE_GAIN]
    if not others:
        return tied, {}
    behind = score.excess - others[0].excess
    return tied, {"effect": others[0].name, "behind_by": behind, "p_value": others[0].family_wise_p}


def make_step(
    model: ModelFit, term: Term, score: FamilyScore, scores: list[FamilyScore], before: float, after: float
) -> Step:
    """Describe an added effect: the score that let it in, all scores of its round, the error on the sealed cycles before and after."""
    tied, runner_up = rivals(score, scores)
    return Step(
        effect=term.effect,
        parameters=term.candidate.parameters,
        parameter_ranges=score.ranges,
        coefficients=coefficients_of(model, term),
        p_value=_entry_p(score),
        held_out_p=score.held_out_p,
        rmse_before_um=before,
        rmse_after_um=after,
        rms_um=_size(model, term),
        tied=tied,
        runner_up=runner_up,
        confirmed=_confirmation(term, score),
        event_cycle=_event_cycle(model.readings, term),
    )


def _entry_p(score: FamilyScore) -> float:
    """The p-value that let an effect in: of the search, or of the one question that was put to the sealed cycles."""
    return score.family_wise_p if score.family_wise_p <= SEARCH_LEVEL else score.held_out_p


def _confirmation(term: Term, score: FamilyScore) -> str:
    """How an effect was confirmed, in words."""
    if score.family_wise_p > SEARCH_LEVEL:
        return (
            "the strongest candidate of a search that could not decide; the sealed cycles, asked once about it, agree"
        )
    if score.held_out_p > CONFIRMATION_LEVEL:
        undecided = f"later blocks of cycles do not decide (p = {score.held_out_p:.2g})"
        return f"{undecided}; its evidence in all of them does, and the sealed cycles agree"
    way = "on the other half of the targets" if term.candidate.event_s is not None else "on later blocks of cycles"
    return f"confirmed {way}, coefficients frozen"


def _event_cycle(readings: Readings, term: Term) -> int | None:
    """The cycle of the first reading at or after an event."""
    if term.candidate.event_s is None:
        return None
    later = np.flatnonzero(readings.seconds >= term.candidate.event_s)
    return int(readings.cycle[later[0] if later.size else -1])


def rmse(errors: Array) -> float:
    """Root mean square of errors, those of sites that a fit has never seen left out, um."""
    return float(np.sqrt(np.nanmean(errors**2)))


def persistence(readings: Readings, used: NDArray[np.bool_]) -> float:
    """Error of predicting every sealed reading by its site's last reading before the seal, um."""
    site = readings.target_index * 2 + (readings.sign < 0)
    errors = []
    for number in np.unique(site):
        before = np.flatnonzero((site == number) & used)
        after = np.flatnonzero((site == number) & ~used)
        if before.size and after.size:
            errors.append(readings.response[after] - readings.response[before[-1]])
    return rmse(np.concatenate(errors))


def nuisance_size(model: ModelFit) -> dict[str, float | str]:
    """Size of the drift that nobody explains beside profile and effects: of its common part and of its stretch, um over the readings."""
    drift, _ = unexplained_drift(model.fit)
    kind = "random walk" if model.fit.system.order == 1 else "integrated random walk"
    rate = model.fit.drift_rate
    return {
        "kind": kind,
        "common_rms_um": float(np.sqrt(np.mean(drift[:, 0] ** 2))),
        "stretch_rms_um": float(np.sqrt(np.mean(drift[:, 1] ** 2))),
        "common_um_per_sqrt_h" if model.fit.system.order == 1 else "common_um_in_1_h": float(rate[0]),
        "stretch_um_per_sqrt_h" if model.fit.system.order == 1 else "stretch_um_in_1_h": float(rate[1]),
    }
