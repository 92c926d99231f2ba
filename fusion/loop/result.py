"""Result of the closed loop on a positioning campaign, and its form in results.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.diagnosis.remainder import Remainder
from fusion.loop.baselines import ErrorInterval
from fusion.loop.decisions import Decision
from fusion.loop.parameter_ranges import Range
from fusion.loop.state import Confirmation, Confirmed, HoldOutQuestion, LoopState, Score, Step, rivals
from fusion.loop.verdict import doubt_of, verdict
from fusion.model.cross_prediction import cross_errors
from fusion.model.fit import ModelFit, Term, fit_model, unexplained_drift
from fusion.model.jackknife import coefficient_spread
from fusion.products.results_loop import Verdict


@dataclass(frozen=True)
class AddedEffect:
    """An effect that was added, as it is reported.

    Attributes
    ----------
    effect, parameters, coefficients : what was added; coefficients with unit and standard uncertainty, from all cycles
    parameter_ranges : values of the parameters that fit as well (profile likelihood, 95 %)
    p_value : probability that the search adds any effect under the null hypothesis
    held_out_p : probability of its gain on unused readings under the null hypothesis
    rmse_before_um, rmse_after_um : open-loop error on the hold-out set before and after it entered; NaN for an effect that entered when
        the hold-out set had been opened
    rmse_without_um : open-loop error on the hold-out set of all other effects without it; NaN likewise
    cross_errors_before_um, cross_errors_after_um : (n,) errors of predicting blocks of all cycles from the others, without it and with
        it, NaN where there is none; of an event only the block around it
    rms_um : size of its contribution, root mean square after the static profile is removed
    tied : effects that these data cannot separate from it
    runner_up : the next best effect, its p-value and how far behind it is in log-likelihood
    confirmed : whether the hold-out set bears it out, or where that says nothing of it, the blocks of cycles that are left out in turn
    doubt : why it is not confirmed, with both errors; empty where it is
    confirmed_by : how it was confirmed before it entered
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
    rmse_without_um: float
    cross_errors_before_um: Array
    cross_errors_after_um: Array
    rms_um: float
    tied: list[str]
    runner_up: dict[str, float | str]
    confirmed: bool
    doubt: str
    confirmed_by: str
    event_cycle: int | None

    @property
    def cross_rmse_before_um(self) -> float:
        """Root mean square error of the blocks that are left out without it, um."""
        return rmse(self.cross_errors_before_um)

    @property
    def cross_rmse_after_um(self) -> float:
        """Root mean square error of the blocks that are left out with it, um."""
        return rmse(self.cross_errors_after_um)

    def as_json(self) -> dict[str, object]:
        """One entry of ``loop.steps``."""
        told = {name: value for name, value in vars(self).items() if not name.startswith("cross_errors")}
        return {
            **told,
            "parameters": dict(self.parameters),
            "parameter_ranges": dict(self.parameter_ranges),
            "cross_rmse_before_um": self.cross_rmse_before_um,
            "cross_rmse_after_um": self.cross_rmse_after_um,
        }


@dataclass(frozen=True)
class LoopResult:
    """Result of the closed loop.

    Attributes
    ----------
    declared : names of the declared effects
    declared_coefficients : their coefficients with unit and standard uncertainty, beside the effects that are confirmed
    held_out : which cycles were held out, in words
    noise_floor_um : standard deviation of one reading beside the final model
    rmse_declared_um, rmse_final_um : hold-out error of the declared model, and with the effects that were decided on the training part
    hold_out : the same errors with their intervals, as ``declared`` and ``final``, and those of plain predictions
    hold_out_errors : (n_held_out,) each, the errors of single readings behind them, um, by the same names
    skill : whether the model predicts the hold-out cycles better than their last values and means
    steps : effects that were added
    unnamed : effects that are significant and have no name, with their p-value
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
    rmse_declared_um: float
    rmse_final_um: float
    hold_out: Mapping[str, ErrorInterval]
    hold_out_errors: Mapping[str, Array]
    skill: bool
    steps: list[AddedEffect]
    unnamed: Mapping[str, float]
    remainder: Remainder
    nuisance: dict[str, float | str]
    state: LoopState[ModelFit]
    before: ModelFit
    after: ModelFit

    @property
    def rmse_persistence_um(self) -> float:
        """Hold-out error of repeating every site's last reading of the training part, um."""
        return self.hold_out["last_value"].rmse_um

    @property
    def verdict(self) -> Verdict:
        """Word for the outcome."""
        return verdict(
            confirmed=any(step.confirmed for step in self.steps),
            doubtful=not all(step.confirmed for step in self.steps),
            tested=bool(self.unnamed) or self.remainder.is_tested,
            remains=bool(self.remainder.shape),
            skill=self.skill,
        )

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
            **errors_json(self.hold_out),
            "steps": [step.as_json() for step in self.steps],
            "verdict": self.verdict,
            "unnamed": dict(self.unnamed),
            "unexplained": {
                "shape": self.remainder.shape,
                "rms_um": self.remainder.rms_um,
                "p_value": self.remainder.p_value,
                **self._nearest(),
            },
            "nuisance": self.nuisance,
            "sealed_question": _question_json(question) if question else {},
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
        shares = [self.remainder.share_of(np.asarray(score.best.columns)) for score in others]
        best = int(np.argmax(shares))
        return {
            "nearest": others[best].name,
            "nearest_p": others[best].family_wise_p,
            "nearest_share": shares[best],
        }


def errors_json(hold_out: Mapping[str, ErrorInterval]) -> dict[str, object]:
    """Errors on the hold-out set with their intervals, for ``loop.errors``, ``loop.baselines`` and ``loop.best_baseline``.

    Parameters
    ----------
    hold_out : of the ``declared`` and the ``final`` model, and of plain predictions
    """
    models = {name: vars(hold_out[name]) for name in ("declared", "final")}
    plain = {name: vars(one) for name, one in hold_out.items() if name not in models}
    best = min(plain, key=lambda name: hold_out[name].rmse_um)
    return {"errors": models, "baselines": plain, "best_baseline": best}


def _question_json(question: HoldOutQuestion) -> dict[str, object]:
    return {**vars(question), "parameters": dict(question.parameters), "entered": False}


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


def report_steps(state: LoopState[ModelFit], wrong: Mapping[int, Decision]) -> list[AddedEffect]:
    """Describe the steps of a loop whose hold-out set has been opened.

    Parameters
    ----------
    state : with a model fitted to all readings, and the hold-out errors of the steps that were decided before
    wrong : decisions of all cycles against the pattern of a step, by its place
    """
    return [
        _added_effect(state, place, term, step, wrong.get(place))
        for place, (term, step) in enumerate(zip(state.added, state.steps, strict=True))
    ]


def _added_effect(
    state: LoopState[ModelFit], place: int, term: Term, step: Step, wrong: Decision | None
) -> AddedEffect:
    model, event_s = state.model, term.candidate.event_s
    tied, runner_up = rivals(step.score, step.round.scores)
    before_um, after_um, without_um = (np.nan,) * 3
    if not step.is_late_entry:
        before_um, after_um, without_um = *state.errors_um[place : place + 2], state.errors_without_um[place]
    without = fit_model(model.readings, state.kept([place]), used=model.used)
    cross_before_um, cross_after_um = (cross_errors(one, event_s) for one in (without, model))
    # The drift that is carried into the hold-out set has learnt an early step by then, and what happened only in the hold-out set makes
    # every error there larger.
    held_out_tells = event_s is None and not any(one.is_late_entry for one in state.steps)
    judged = (state.errors_um[-1], without_um) if held_out_tells else (rmse(cross_after_um), rmse(cross_before_um))
    doubt = doubt_of(
        *judged, model.fit.sigma, "on the hold-out set" if held_out_tells else "of blocks that are left out"
    )
    if wrong is not None:
        doubt = wrong.sentence
    return AddedEffect(
        effect=term.effect,
        parameters=term.candidate.parameters,
        parameter_ranges=step.score.ranges,
        coefficients=coefficients_of(model, term),
        p_value=step.score.family_wise_p,
        held_out_p=step.score.confirmation.p_value if step.score.confirmation else 1.0,
        rmse_before_um=before_um,
        rmse_after_um=after_um,
        rmse_without_um=without_um,
        cross_errors_before_um=cross_before_um,
        cross_errors_after_um=cross_after_um,
        rms_um=_size(model, term),
        tied=tied,
        runner_up=runner_up,
        confirmed=not doubt,
        doubt=doubt,
        confirmed_by=str(step.confirmed),
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
