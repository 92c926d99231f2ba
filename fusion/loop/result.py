"""Result of the closed loop on a positioning campaign, and its form in results.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.diagnosis.remainder import Remainder
from fusion.loop.parameter_ranges import Range
from fusion.loop.state import Confirmation, Confirmed, LoopState, Score, Step, rivals
from fusion.model.fit import ModelFit, Term, unexplained_drift
from fusion.model.jackknife import coefficient_spread


@dataclass(frozen=True)
class AddedEffect:
    """An effect that was added, as it is reported.

    Attributes
    ----------
    effect, parameters, coefficients : what was added; coefficients with unit and standard uncertainty, from all cycles
    parameter_ranges : values of the parameters that fit as well (profile likelihood, 95 %)
    p_value : probability that the search adds any effect under the null hypothesis
    held_out_p : probability of its gain on unused readings under the null hypothesis
    rmse_before_um, rmse_after_um : open-loop error on the hold-out set without and with it
    rms_um : size of its contribution, root mean square after the static profile is removed
    tied : effects that these data cannot separate from it
    runner_up : the next best effect, its p-value and how far behind it is in log-likelihood
    confirmed : how it was confirmed
    event_cycle : the cycle in which an event happened, None for an effect that lasts
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

    def as_json(self) -> dict[str, object]:
        """One entry of ``loop.steps``."""
        return {**vars(self), "parameters": dict(self.parameters), "parameter_ranges": dict(self.parameter_ranges)}


@dataclass(frozen=True)
class LoopResult:
    """Result of the closed loop.

    Attributes
    ----------
    declared : names of the declared effects
    declared_coefficients : their coefficients with unit and standard uncertainty, in the final model
    held_out : which cycles were held out, in words
    noise_floor_um : standard deviation of one reading beside the final model
    rmse_persistence_um : hold-out error of repeating every site's last reading of the training part
    rmse_declared_um, rmse_final_um : hold-out error of the declared and the final model
    steps : effects that were added
    verdict : ``complete``, ``explained``, ``partial`` or ``unexplained``
    remainder : structure that the final model leaves
    nuisance : size of the unexplained drift
    state : the last state of the loop: every round and every decision
    before : the declared model on the training part
    after : the final model on all cycles
    """

    declared: list[str]
    declared_coefficients: list[dict[str, float | str]]
    held_out: str
    noise_floor_um: float
    rmse_persistence_um: float
    rmse_declared_um: float
    rmse_final_um: float
    steps: list[AddedEffect]
    verdict: str
    remainder: Remainder
    nuisance: dict[str, float | str]
    state: LoopState[ModelFit]
    before: ModelFit
    after: ModelFit

    def as_json(self) -> dict[str, object]:
        """The ``loop`` part of results.json."""
        question = self.state.question
        return {
            "declared": self.declared,
            "declared_coefficients": self.declared_coefficients,
            "held_out": self.held_out,
            "noise_floor_um": self.noise_floor_um,
            "rmse_persistence_um": self.rmse_persistence_um,
            "rmse_declared_um": self.rmse_declared_um,
            "rmse_final_um": self.rmse_final_um,
            "steps": [step.as_json() for step in self.steps],
            "verdict": self.verdict,
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                **self._nearest(),
            },
            "nuisance": self.nuisance,
            "sealed_question": vars(question) | {"parameters": dict(question.parameters)} if question else {},
            "search": [[_score_json(score) for score in scored.scores] for scored in self.state.rounds],
            "identifiability": [vars(limit) for scored in self.state.rounds for limit in scored.detection_limits],
            "not_tried": self.state.not_tried(),
            "blocked": self.state.blocked(),
        }

    def _nearest(self) -> dict[str, object]:
        """The effect that explains the largest share of what is left, its p-value in the search, and that share."""
        added = {step.effect for step in self.steps}
        scores = [score for scored in self.state.rounds for score in scored.scores]
        others = [score for score in scores if score.candidate and score.name not in added]
        if not self.remainder.shape or not others:
            return {"nearest": "", "nearest_p": None, "nearest_share": None}
        shares = [self.remainder.share_of(score.best.columns) for score in others]
        best = int(np.argmax(shares))
        return {
            "nearest": others[best].name,
            "nearest_p": others[best].family_wise_p,
            "nearest_share": shares[best],
        }


def _score_json(score: Score) -> dict[str, object]:
    confirmation = score.confirmation or Confirmation(False, Confirmed.LATER_CYCLES)
    return {
        "effect": score.name,
        "parameters": dict(score.candidate.parameters) if score.candidate else {},
        "gain": score.gain,
        "excess_gain": score.excess,
        "p_value": score.p_value,
        "family_wise_p": score.family_wise_p,
        "held_out_gain": confirmation.gain,
        "held_out_p": confirmation.p_value,
        "share_not_separable": score.collinear,
    }


def report_steps(state: LoopState[ModelFit]) -> list[AddedEffect]:
    """Describe the steps of a loop whose hold-out set has been opened.

    Parameters
    ----------
    state : with a model fitted to all readings, and the hold-out errors of its steps
    """
    return [
        _added_effect(state.model, term, step, state.errors_um[place], state.errors_um[place + 1])
        for place, (term, step) in enumerate(zip(state.added, state.steps, strict=True))
    ]


def _added_effect(model: ModelFit, term: Term, step: Step, before_um: float, after_um: float) -> AddedEffect:
    tied, runner_up = rivals(step.score, step.round.scores)
    held_out_p = step.score.confirmation.p_value if step.score.confirmation else 1.0
    asked = step.confirmed is Confirmed.HOLD_OUT_QUESTION
    return AddedEffect(
        effect=term.effect,
        parameters=term.candidate.parameters,
        parameter_ranges=step.score.ranges,
        coefficients=coefficients_of(model, term),
        p_value=held_out_p if asked else step.score.family_wise_p,
        held_out_p=held_out_p,
        rmse_before_um=before_um,
        rmse_after_um=after_um,
        rms_um=_size(model, term),
        tied=tied,
        runner_up=runner_up,
        confirmed=str(step.confirmed),
        event_cycle=_event_cycle(model.readings, term),
    )


def declared_coefficients(model: ModelFit, declared: int) -> list[dict[str, float | str]]:
    """Coefficients of the declared effects with unit, standard uncertainty, and how far they move when parts of the readings are left out.

    Parameters
    ----------
    model : whose first terms are the declared ones
    declared : their number
    """
    spread = coefficient_spread(model)
    return [
        {"effect": term.effect, **entry, "jackknife_u": float(moved)}
        for term in model.terms[:declared]
        for entry, moved in zip(coefficients_of(model, term), spread[model.place(term)], strict=True)
    ]


def coefficients_of(model: ModelFit, term: Term) -> list[dict[str, float | str]]:
    """Coefficients of a term with standard uncertainty and unit, and with the prior that went into the first one.

    Parameters
    ----------
    model : the fitted model
    term : one of its terms
    """
    place = model.place(term)
    values, u = model.fit.coefficients[place], model.fit.coefficients_u[place]
    entries: list[dict[str, float | str]] = [
        {"value": float(value), "u": float(spread), "unit": unit}
        for value, spread, unit in zip(values, u, term.candidate.units, strict=True)
    ]
    if term.candidate.prior is not None:
        entries[0] |= {"prior": term.candidate.prior.mean, "prior_u": term.candidate.prior.u}
    return entries


def _size(model: ModelFit, term: Term) -> float:
    """Root mean square of a term's contribution after its mean at every site is removed, um."""
    series = model.series(term)[0]
    site = model.readings.site
    total = np.bincount(site, series, minlength=site.max() + 1)
    number = np.maximum(np.bincount(site, minlength=site.max() + 1), 1)
    return float(np.sqrt(np.mean((series - (total / number)[site]) ** 2)))


def _event_cycle(readings: Readings, term: Term) -> int | None:
    """The cycle of the first reading at or after an event."""
    if term.candidate.event_s is None:
        return None
    later = np.flatnonzero(readings.seconds >= term.candidate.event_s)
    return int(readings.cycle[later[0] if later.size else -1])


def rmse(errors: Array) -> float:
    """Root mean square of errors, those of sites without a prediction left out.

    Parameters
    ----------
    errors : (n,) um; NaN where a site was not in the training part

    Returns
    -------
    float
        um
    """
    return float(np.sqrt(np.nanmean(errors**2)))


def persistence(readings: Readings, used: NDArray[np.bool_]) -> float:
    """Hold-out error of repeating every site's last reading of the training part.

    Parameters
    ----------
    readings : n readings
    used : (n,) True for the training part

    Returns
    -------
    float
        Root mean square, um.
    """
    site = readings.site
    errors = []
    for number in np.unique(site):
        before = np.flatnonzero((site == number) & used)
        after = np.flatnonzero((site == number) & ~used)
        if before.size and after.size:
            errors.append(readings.response[after] - readings.response[before[-1]])
    return rmse(np.concatenate(errors))


def nuisance_size(model: ModelFit) -> dict[str, float | str]:
    """Size of the unexplained drift beside profile and effects: of its common part and of its stretch.

    Parameters
    ----------
    model : fitted to all readings

    Returns
    -------
    dict
        Kind of the drift, root mean square over the readings in um, and rate in um.
    """
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
