"""The result of the loop: numbers by hand, and the keys of its part of results.json."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.diagnosis.remainder import Remainder
from fusion.effects.effect import Candidate, Prior
from fusion.loop.baselines import ErrorInterval
from fusion.loop.decisions import Decision, Reason
from fusion.loop.result import (
    LoopResult,
    coefficients_of,
    declared_coefficients,
    nuisance_size,
    report_steps,
    rmse,
)
from fusion.loop.state import Confirmation, Confirmed, DetectionLimit, HoldOutQuestion, LoopState, Round, Score, Step
from fusion.model.cross_prediction import cross_errors
from fusion.model.fit import ModelFit, fit_model, unexplained_drift
from fusion.model.jackknife import coefficient_spread
from tests.fusion.small_campaign import RATIOS, campaign, model_of, term

BARE = campaign(cycles=12)
WAVE = np.sin(BARE.seconds / 100.0)
LATE = (BARE.seconds >= 655.0).astype(float)


def measured() -> Readings:
    noise = 0.1 * np.random.default_rng(2).standard_normal(BARE.seconds.size)
    return replace(BARE, response=2.0 * WAVE + 0.5 * LATE + noise)


def fitted() -> ModelFit:
    declared = term(WAVE, "axis_expansion", units=("ppm/K",), prior=Prior(11.7, 2.0))
    event = term(LATE, "step_event", parameters={"time_s": 655.0}, event_s=655.0)
    return model_of(measured(), [declared, event])


def score(name: str, **changes) -> Score:
    return Score(name, Candidate(WAVE[:, None], {"minutes": 5.0}, ("um",)), **changes)


def state(model: ModelFit, *, confirmed: Confirmed = Confirmed.OTHER_TARGETS) -> LoopState[ModelFit]:
    confirmation = Confirmation(True, confirmed, 4.0, 0.02)
    chosen = score("step_event", excess=20.0, gain=21.0, p_value=1e-4, family_wise_p=1e-3, confirmation=confirmation)
    rival = score("dead_path", excess=18.5, p_value=0.01, family_wise_p=0.1, collinear=0.25)
    limit = DetectionLimit("dead_path", 0.1, 0.05, 0.2, 0.9, ["air_index"], "")
    first = Round((chosen, rival, Score("constant", None, collinear=1.0)), detection_limits=(limit,))
    return LoopState(
        model,
        steps=(Step(chosen, first, confirmed),),
        decisions=(
            Decision("reflected_source", Reason.NOT_AVAILABLE, {"because": "no patch"}),
            Decision("constant", Reason.COLLINEAR),
            Decision("step_event", Reason.ENTERED),
        ),
        rounds=(first,),
        errors_um=(0.8, 0.3),
        errors_without_um=(0.8,),
    )


def remainder(shape: str = "", series: np.ndarray | None = None) -> Remainder:
    return Remainder(
        p_value=0.5,
        p_values={},
        shape=shape,
        rms_um=0.2 if shape else 0.0,
        cycles=np.arange(12),
        along_time=np.zeros(12),
        sites=[],
        along_sites=np.zeros(0),
        series=np.zeros(BARE.seconds.size) if series is None else series,
        free=lambda columns: columns,
    )


HOLD_OUT = {
    name: ErrorInterval(error, 0.9 * error, 1.1 * error)
    for name, error in (("declared", 0.8), ("final", 0.3), ("last_value", 0.9), ("mean", 1.2), ("ridge", 0.5))
}


def result(looped: LoopState[ModelFit], left: Remainder) -> LoopResult:
    model = looped.model
    return LoopResult(
        declared=["axis_expansion"],
        declared_coefficients=declared_coefficients(model, 1),
        held_out="cycles 11 to 12 held out",
        noise_floor_um=0.1,
        rmse_declared_um=0.8,
        rmse_final_um=0.3,
        hold_out=HOLD_OUT,
        hold_out_errors={},
        skill=True,
        steps=report_steps(looped, {}),
        unnamed={},
        remainder=left,
        nuisance=nuisance_size(model),
        state=looped,
        before=model,
        after=model,
    )


def test_the_rmse_leaves_sites_without_a_prediction_out():
    assert rmse(np.array([3.0, np.nan, -4.0])) == pytest.approx(np.sqrt(12.5))


def test_coefficients_are_told_with_their_prior():
    model = fitted()
    place = model.place(model.terms[0]).start
    assert declared_coefficients(model, 1) == [
        {
            "effect": "axis_expansion",
            "value": model.fit.coefficients[place],
            "u": model.fit.coefficients_u[place],
            "unit": "ppm/K",
            "prior": 11.7,
            "prior_u": 2.0,
            "jackknife_u": coefficient_spread(model)[place],
        }
    ]
    two = term(np.column_stack([WAVE, WAVE**2]), "b", units=("um", "um/K"), prior=Prior(1.0, 0.1))
    told = coefficients_of(model_of(measured(), [two]), two)
    assert [sorted(entry) for entry in told] == [["prior", "prior_u", "u", "unit", "value"], ["u", "unit", "value"]]
    assert [entry["unit"] for entry in told] == ["um", "um/K"]
    assert [entry["effect"] for entry in declared_coefficients(fitted(), 2)] == ["axis_expansion", "step_event"]


def test_a_step_is_reported_with_its_errors_rivals_and_cycle():
    model = fitted()
    (step,) = report_steps(state(model), {})
    assert step.effect == "step_event" and step.parameters == {"time_s": 655.0}
    assert (step.rmse_before_um, step.rmse_after_um) == (0.8, 0.3)
    assert (step.p_value, step.held_out_p) == (1e-3, 0.02)
    assert step.tied == ["dead_path"]
    assert step.runner_up == {"effect": "dead_path", "behind_by": pytest.approx(1.5), "p_value": 0.1}
    assert step.confirmed_by == str(Confirmed.OTHER_TARGETS)
    # The drift has learnt an early step by the time of the hold-out set: the block around it tells.
    without = fit_model(model.readings, [model.terms[0]])
    np.testing.assert_array_equal(step.cross_errors_before_um, cross_errors(without, 655.0))
    np.testing.assert_array_equal(step.cross_errors_after_um, cross_errors(model, 655.0))
    told = step.as_json()
    assert told["cross_rmse_before_um"] == step.cross_rmse_before_um == rmse(step.cross_errors_before_um)
    assert told["cross_rmse_after_um"] == rmse(step.cross_errors_after_um) < step.cross_rmse_before_um
    assert not any(isinstance(value, np.ndarray) for value in told.values())
    assert step.confirmed and step.doubt == ""
    # 655 s lies between the third and the fourth reading of cycle 6.
    assert step.event_cycle == 6
    # A coefficient times a column of zeros and ones, about its mean at every site.
    shares = np.array([LATE[BARE.site == site].mean() for site in range(8)])[BARE.site]
    height = float(step.coefficients[0]["value"])
    assert height == pytest.approx(0.5, abs=0.2)
    assert step.rms_um == pytest.approx(abs(height) * np.sqrt(np.mean((LATE - shares) ** 2)))


@pytest.mark.parametrize(("event_s", "cycle"), [(650.0, 6), (650.1, 6), (720.1, 7), (5000.0, 12)])
def test_an_event_belongs_to_the_cycle_of_the_next_reading(event_s, cycle):
    """Cycle 6 is read from 650 to 720 s, cycle 7 from 780 s on; 12 is the last."""
    model = fitted()
    later = term(LATE, "step_event", event_s=event_s)
    changed = replace(model, terms=(model.terms[0], later))
    assert report_steps(state(changed), {})[0].event_cycle == cycle


def test_an_effect_that_lasts_belongs_to_no_cycle():
    model = model_of(measured(), [term(WAVE), term(LATE, "step_event")])
    assert report_steps(state(model), {})[0].event_cycle is None


@pytest.mark.parametrize(("after", "confirmed"), [(0.3, True), (0.799, False), (0.9, False)])
def test_what_lasts_is_confirmed_by_the_hold_out_set(after, confirmed):
    model = model_of(measured(), [term(WAVE), term(LATE, "a")])
    looped = replace(state(model), errors_um=(0.8, after))
    (step,) = report_steps(looped, {})
    assert (step.rmse_after_um, step.rmse_without_um, step.confirmed) == (after, 0.8, confirmed)
    assert step.doubt == (
        "" if confirmed else f"the error on the hold-out set is 0.8 µm without it and {after:.3g} µm with it"
    )
    found = replace(result(looped, remainder()), steps=[step])
    assert found.verdict == ("explained" if confirmed else "unexplained")


def test_a_pattern_that_all_cycles_contradict_is_not_confirmed():
    wrong = Decision("step_event", Reason.WRONG_PATTERN, {"p_value": 1e-5})
    (step,) = report_steps(state(fitted()), {0: wrong})
    assert not step.confirmed and step.doubt == wrong.sentence


def test_an_effect_that_entered_late_has_no_held_out_error():
    (step,) = report_steps(state(fitted(), confirmed=Confirmed.SECOND_LOOK), {})
    assert np.isnan([step.rmse_before_um, step.rmse_after_um, step.rmse_without_um]).all()
    assert step.confirmed and step.cross_rmse_after_um < step.cross_rmse_before_um


def test_significant_effects_without_a_name_keep_the_verdict_from_being_complete():
    found = replace(result(state(fitted()), remainder()), steps=[])
    assert found.verdict == "complete"
    assert replace(found, unnamed={"thermal_lag": 1e-34}).verdict == "unexplained"
    assert replace(found, skill=False).verdict == "no_skill"
    assert replace(found, skill=False, unnamed={"thermal_lag": 1e-34}).verdict == "unexplained"


@pytest.mark.parametrize("order", [1, 2])
def test_the_size_of_the_unexplained_drift(order):
    model = model_of(measured(), [term(WAVE)], order=order, ratios=RATIOS if order == 1 else RATIOS / 1e4)
    told = nuisance_size(model)
    drift, _ = unexplained_drift(model.fit)
    assert told["kind"] == ("random walk" if order == 1 else "integrated random walk")
    assert told["common_rms_um"] == pytest.approx(np.sqrt(np.mean(drift[:, 0] ** 2)))
    assert told["stretch_rms_um"] == pytest.approx(np.sqrt(np.mean(drift[:, 1] ** 2)))
    unit = "um_per_sqrt_h" if order == 1 else "um_in_1_h"
    # Standard deviation of a random walk after an hour, and of an integrated one.
    after_an_hour = 3600.0 if order == 1 else 3600.0**3 / 3.0
    for name, ratio in zip(("common", "stretch"), model.fit.system.ratios, strict=True):
        assert told[f"{name}_{unit}"] == pytest.approx(model.fit.sigma * np.sqrt(ratio * after_an_hour))
    assert len(told) == 5


def test_the_part_of_results_json_has_its_keys():
    written = json.loads(json.dumps(result(state(fitted()), remainder()).as_json()))
    assert set(written) == {
        "declared",
        "declared_coefficients",
        "held_out",
        "noise_floor_um",
        "rmse_persistence_um",
        "rmse_declared_um",
        "rmse_final_um",
        "errors",
        "baselines",
        "best_baseline",
        "unnamed",
        "steps",
        "verdict",
        "unexplained",
        "nuisance",
        "sealed_question",
        "search",
        "identifiability",
        "not_tried",
        "blocked",
    }
    assert set(written["steps"][0]) == {
        "effect",
        "parameters",
        "parameter_ranges",
        "coefficients",
        "p_value",
        "held_out_p",
        "rmse_before_um",
        "rmse_after_um",
        "rmse_without_um",
        "cross_rmse_before_um",
        "cross_rmse_after_um",
        "rms_um",
        "tied",
        "runner_up",
        "confirmed",
        "doubt",
        "confirmed_by",
        "event_cycle",
    }
    assert written["not_tried"] == {"reflected_source": "no patch"} and set(written["blocked"]) == {"constant"}
    assert written["sealed_question"] == {}
    assert set(written["identifiability"][0]) == {
        "effect",
        "detectable_um",
        "best_um",
        "worst_um",
        "visible_share",
        "looks_like",
        "note",
    }
    assert (written["rmse_declared_um"], written["rmse_final_um"], written["noise_floor_um"]) == (0.8, 0.3, 0.1)
    assert written["errors"]["final"] == {"rmse_um": 0.3, "low_um": pytest.approx(0.27), "high_um": pytest.approx(0.33)}
    assert set(written["baselines"]) == {"last_value", "mean", "ridge"} and written["best_baseline"] == "ridge"
    assert written["rmse_persistence_um"] == 0.9


def test_every_score_of_the_search_is_written():
    (scored,) = result(state(fitted()), remainder()).as_json()["search"]
    assert scored[0] == {
        "effect": "step_event",
        "parameters": {"minutes": 5.0},
        "gain": 21.0,
        "excess_gain": 20.0,
        "p_value": 1e-4,
        "family_wise_p": 1e-3,
        "held_out_gain": 4.0,
        "held_out_p": 0.02,
        "share_not_separable": 0.0,
    }
    # An effect that was not worth confirming has no evidence from unused readings.
    assert (scored[1]["held_out_gain"], scored[1]["held_out_p"], scored[1]["share_not_separable"]) == (0.0, 1.0, 0.25)
    assert scored[2]["parameters"] == {}


def test_the_question_to_the_hold_out_set_is_written():
    asked = replace(state(fitted()), question=HoldOutQuestion("dead_path", {"minutes": 5.0}, 0.4, 0.3, 0.004))
    assert result(asked, remainder()).as_json()["sealed_question"] == {
        "effect": "dead_path",
        "parameters": {"minutes": 5.0},
        "rmse_before_um": 0.4,
        "rmse_after_um": 0.3,
        "p_value": 0.004,
        "entered": False,
    }


def test_the_nearest_effect_to_what_is_left_is_one_that_was_not_added():
    looped = state(fitted())
    shaped = remainder("a shape", series=WAVE + 0.1)
    told = result(looped, shaped).as_json()["unexplained"]
    assert (told["shape"], told["rms_um"], told["p_value"]) == ("a shape", 0.2, 0.5)
    # The step fits as well (its score has the same column) but is in the model; the constant has no candidate.
    assert (told["nearest"], told["nearest_p"]) == ("dead_path", 0.1)
    series = WAVE + 0.1
    left = series - WAVE * (WAVE @ series) / (WAVE @ WAVE)
    assert told["nearest_share"] == pytest.approx(1.0 - left @ left / (series @ series))
    nothing = result(looped, remainder()).as_json()["unexplained"]
    assert (nothing["nearest"], nothing["nearest_p"], nothing["nearest_share"]) == ("", None, None)
