"""The result of the loop: numbers by hand, and the keys of its part of results.json."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Readings, Series
from fusion.analysis.diagnosis.residual import Remainder
from fusion.analysis.drift_model.axis import (
    AxisResult,
    _contribution,
    average_over_drifts,
    coefficients_of,
    cross_errors,
    declared_coefficients,
    report_steps,
    residual_drift_size,
)
from fusion.analysis.drift_model.evaluation import (
    Answer,
    Contribution,
    Surroundings,
    Unseen,
    answers,
    exceeds_noise,
    has_skill,
    is_separable,
    reasons_against,
    shares_of_drift,
    unsupported_places,
    verdict,
)
from fusion.analysis.drift_model.model import ModelFit, coefficient_spread, fit_model, unexplained_drift
from fusion.analysis.drift_model.predictions import expect_errors, held_out_errors, plain_errors, rmse, track_cycles
from fusion.analysis.drift_model.search import (
    Confirmation,
    Confirmed,
    Decision,
    LoopState,
    Reason,
    Round,
    Score,
    Step,
)
from fusion.analysis.effects.effect import Candidate, Prior
from fusion.analysis.effects.events import cycle_starts
from fusion.results.loop import (
    AxisLoop,
    AxisStep,
    Baselines,
    DetectionLimit,
    HeldOutError,
    ModelError,
    ModelErrors,
    ResidualTestsPart,
    Tracking,
)
from fusion.results.store import plain
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
    limit = DetectionLimit(
        effect="dead_path",
        detectable_um=0.1,
        best_um=0.05,
        worst_um=0.2,
        visible_share=0.9,
        confounded_with=["air_index"],
        note="",
    )
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
    name: ModelError(rmse_um=error) if name in ModelErrors.model_fields else HeldOutError(rmse_um=error)
    for name, error in {
        **dict.fromkeys(Baselines.model_fields, 1.2),
        "declared": 0.8,
        "final": 0.3,
        "last_value": 0.9,
        "ridge": 0.5,
    }.items()
}
UNTESTED = ResidualTestsPart.model_construct()


def result(looped: LoopState[ModelFit], left: Remainder) -> AxisResult:
    model = looped.model
    tracked = HeldOutError(rmse_um=0.2)
    return AxisResult(
        state=looped,
        held_out="cycles 11 to 12 held out",
        noise_floor_um=0.1,
        hold_out_errors={"final": np.array([0.3, -0.3])},
        hold_out=HOLD_OUT,
        skill_um=0.3,
        tracking=Tracking(every_min=20.0, model=tracked, last_reading=tracked, ridge=tracked),
        steps=report_steps(looped, {}, [None]),
        away=frozenset(),
        remainder=left,
        wandering_um=0.05,
        warm_up_only=(),
        declared_coefficients=declared_coefficients(model, 1),
        before=model,
        after=model,
    )


def why_nameless(step: Step, *, before=(), **changes) -> str:
    """The first reason against the name of a step, in surroundings that give none."""
    own = {"rms_um": np.inf, "pattern": np.ones(1), "loss": np.inf}
    beside = {"drift_um": 0.0, "is_smooth": False, "total_um": np.inf}
    contribution = Contribution(**{name: changes.get(name, value) for name, value in own.items()})
    surroundings = Surroundings(**{name: changes.get(name, value) for name, value in beside.items()})
    return next(reasons_against(step, changes.get("answer", Answer()), contribution, before, surroundings), "")


def test_the_rmse_leaves_sites_without_a_prediction_out():
    assert rmse(np.array([3.0, np.nan, -4.0])) == pytest.approx(np.sqrt(12.5))


def test_coefficients_are_told_with_their_prior():
    model = fitted()
    place, averaged = model.place(model.terms[0]).start, average_over_drifts(model).fit
    assert [one.model_dump(exclude_unset=True) for one in declared_coefficients(model, 1)] == [
        {
            "effect": "axis_expansion",
            "value": averaged.coefficients[place],
            "u": averaged.coefficients_u[place],
            "unit": "ppm/K",
            "prior": 11.7,
            "prior_u": 2.0,
            "jackknife_u": coefficient_spread(model)[place],
        }
    ]
    two = term(np.column_stack([WAVE, WAVE**2]), "b", units=("um", "um/K"), prior=Prior(1.0, 0.1))
    told = coefficients_of(model_of(measured(), [two]), two)
    assert [entry.model_fields_set - {"value", "u", "unit"} for entry in told] == [{"prior", "prior_u"}, set()]
    assert [entry.unit for entry in told] == ["um", "um/K"]
    assert [entry.effect for entry in declared_coefficients(fitted(), 2)] == ["axis_expansion", "step_event"]


def test_a_step_is_reported_with_its_errors_rivals_and_cycle():
    model = fitted()
    (step,) = report_steps(state(model), {}, [None])
    assert step.effect == "step_event" and step.parameters == {"time_s": 655.0}
    assert (step.rmse_before_um, step.rmse_after_um) == (0.8, 0.3)
    assert (step.p_value, step.held_out_p) == (1e-3, 0.02)
    assert step.tied == ("dead_path",)
    assert step.runner_up.model_dump() == {"effect": "dead_path", "gain_deficit": pytest.approx(1.5), "p_value": 0.1}
    assert step.confirmed_by == str(Confirmed.OTHER_TARGETS)
    # The drift has learnt an early step by the time of the hold-out set: the block around it tells.
    without = fit_model(model.readings, [model.terms[0]])
    np.testing.assert_array_equal(step.cross_errors_before_um, cross_errors(without, 655.0))
    np.testing.assert_array_equal(step.cross_errors_after_um, cross_errors(model, 655.0))
    assert step.cross_rmse_before_um == rmse(step.cross_errors_before_um)
    assert step.cross_rmse_after_um == rmse(step.cross_errors_after_um) < step.cross_rmse_before_um
    assert step.confirmed and step.doubt == ""
    # 655 s lies between the third and the fourth reading of cycle 6.
    assert step.event_cycle == 6
    # A coefficient times a column of zeros and ones, about its mean at every site.
    shares = np.array([LATE[BARE.site == site].mean() for site in range(8)])[BARE.site]
    assert step.coefficients[0].value == pytest.approx(0.5, abs=0.2)
    height = model.fit.coefficients[-1]
    assert step.rms_um == pytest.approx(abs(height) * np.sqrt(np.mean((LATE - shares) ** 2)))


@pytest.mark.parametrize(("event_s", "cycle"), [(650.0, 6), (650.1, 6), (720.1, 7), (5000.0, 12), (None, None)])
def test_an_event_belongs_to_the_cycle_of_the_next_reading_and_what_lasts_to_none(event_s, cycle):
    """Cycle 6 is read from 650 to 720 s, cycle 7 from 780 s on; 12 is the last."""
    model = fitted()
    later = term(LATE, "step_event", event_s=event_s)
    changed = replace(model, terms=(model.terms[0], later))
    assert report_steps(state(changed), {}, [None])[0].event_cycle == cycle


@pytest.mark.parametrize(
    ("slope", "word", "verdict"),
    [(0.9, "yes", "explained"), (0.1, "no", "unexplained"), (np.nan, "cannot tell", "explained")],
)
def test_what_lasts_is_borne_out_by_the_hold_out_set(slope, word, verdict):
    looped = state(model_of(measured(), [term(WAVE), term(LATE, "a")]))
    (step,) = report_steps(looped, {}, [Answer(slope, np.inf if np.isnan(slope) else 0.2, 100)])
    assert (step.borne_out, step.confirmed, step.keeps_name) == (word, word == "yes", word != "no")
    assert (
        step.doubt
        == {
            "yes": "",
            "no": "contradicted: on the hold-out set its size is 0.10 ± 0.40 (k = 2) of that predicted",
            "cannot tell": "not yet borne out: it hardly changes on the hold-out set",
        }[word]
    )
    assert replace(result(looped, remainder()), steps=[step]).verdict == verdict


@pytest.mark.parametrize("falls", [False, True])
def test_a_name_that_is_not_borne_out_stands_only_where_unseen_readings_are_predicted_better(falls):
    looped = state(model_of(measured(), [term(WAVE, "axis_expansion"), term(LATE, "step_event")]))
    looped = replace(looped, errors_um=(0.8, 0.78 if falls else 0.8), errors_without_um=(0.8,))
    (step,) = report_steps(looped, {}, [Answer()])
    assert (step.borne_out, step.lowers_error, step.keeps_name) == ("cannot tell", falls, falls)
    assert unsupported_places([step]) == ([] if falls else [0])
    told = replace(result(looped, remainder()), steps=[step])
    assert told.verdict == ("explained" if falls else "unexplained")
    # What no unseen reading supports is followed by nothing.
    assert [one.effect for one in told._described()["followed"]] == ["axis_expansion", "step_event"][: 1 + falls]


def test_shares_of_a_drift_are_those_of_its_variance():
    first, second = np.array([[1.0], [-1.0], [0.0], [0.0]]), np.array([[0.0], [0.0], [2.0], [-2.0]])
    left = np.array([[1.0], [1.0], [-1.0], [np.nan]])
    shares, rest = shares_of_drift([first, second], left)
    # Of 5/3 over the three known places 1 is left; one and four parts of the rest follow the effects.
    assert rest == pytest.approx(0.6) and shares == pytest.approx([0.08, 0.32])
    assert shares_of_drift([first, -first], left) == ([0.0, 0.0], 1.0)
    shares, rest = shares_of_drift([2.0 * first, -first], 0.0 * first)
    assert shares == pytest.approx([2.0, -1.0]) and rest == 0.0


def test_nothing_is_explained_where_the_final_error_is_beyond_the_noise_and_a_plain_prediction_is_better():
    found = result(state(fitted()), remainder())
    beaten = {
        name: one.model_copy(update={"rmse_um": 0.28}) if name == "ridge" else one for name, one in HOLD_OUT.items()
    }
    left = replace(found, hold_out=beaten).described(UNTESTED)
    # What the error of 0.3 um holds beside the noise of 0.1 um.
    assert (found.verdict, left.verdict) == ("explained", "partial")
    assert left.unexplained.rms_um == pytest.approx(np.sqrt(0.3**2 - 0.1**2)) and left.unexplained.shape
    beaten |= {"ridge_with_lags": HOLD_OUT["final"].model_copy(update={"rmse_um": 0.2})}
    nameless = replace(found, hold_out=beaten).described(UNTESTED)
    assert (nameless.verdict, nameless.separable, nameless.named) == ("unexplained", False, ())


def test_what_all_cycles_describe_as_well_without_it_has_no_name():
    without = replace(measured(), response=measured().response - 0.5 * LATE)
    (step,) = report_steps(state(model_of(without, [term(WAVE), term(LATE, "a")])), {}, [Answer(0.9, 0.2, 100)])
    assert step.withheld.startswith("all readings together are described as well without it")
    (step,) = report_steps(state(model_of(measured(), [term(WAVE), term(LATE, "a")])), {}, [Answer(0.9, 0.2, 100)])
    assert not step.withheld


@pytest.mark.parametrize(
    ("effect", "minutes", "withheld"), [("laser_warm_up", 25.0, True), ("laser_warm_up", 24.0, False)]
)
def test_no_laser_settles_for_longer_than_minutes(effect, minutes, withheld):
    parameters = {"time_constant_min": minutes}
    tried = replace(
        score(effect, ranges={"time_constant_min": [20.0, 30.0]}),
        candidate=Candidate(WAVE[:, None], parameters, ("ppm",)),
    )
    said = why_nameless(Step(tried, Round(()), Confirmed.LATER_CYCLES))
    assert bool(said) == withheld and ("than its physics allows (24 min)" in said) == withheld


def test_what_is_larger_than_the_drift_itself_counterbalances_another_effect():
    # Two courses that are nearly one, against each other.
    other = WAVE + 0.05 * LATE
    model = model_of(replace(measured(), response=40.0 * WAVE - 40.0 * other), [term(WAVE), term(other, "a")])
    (step,) = report_steps(state(model), {}, [Answer(0.9, 0.2, 100)])
    assert step.withheld.endswith("it counterbalances another effect") and "exceed the whole drift of" in step.withheld


def test_an_effect_that_entered_late_has_no_held_out_error():
    (step,) = report_steps(state(fitted(), confirmed=Confirmed.SECOND_SEARCH), {}, [None])
    assert np.isnan([step.rmse_before_um, step.rmse_after_um, step.rmse_without_um]).all()
    assert step.confirmed and step.cross_rmse_after_um < step.cross_rmse_before_um


def test_significant_effects_without_a_name_keep_the_verdict_from_being_complete():
    found = replace(result(state(fitted()), remainder()), steps=[])
    assert found.verdict == "complete" and str(found).startswith(
        "axis_expansion: 2.010 ± 0.036 ppm/K\nverdict: complete\n"
    )
    assert repr(found) == "LoopResult: complete; declared axis_expansion; added nothing; held-out error 0.8 -> 0.3 um"
    lag = Decision("thermal_lag", Reason.INCONSISTENT_PATTERN, {"search_p": 1e-34})
    nameless = replace(found, state=found.state.decide(lag.on_evidence(p_value=1e-5)))
    assert nameless.verdict == "unexplained"
    assert replace(found, skill_um=0.95).verdict == "no_skill"
    assert replace(nameless, skill_um=0.95).verdict == "unexplained"


@pytest.mark.parametrize("order", [1, 2])
def test_the_size_of_the_unexplained_drift(order):
    model = model_of(measured(), [term(WAVE)], order=order, ratios=RATIOS if order == 1 else RATIOS / 1e4)
    told = residual_drift_size(model).model_dump(exclude_unset=True)
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


def test_the_part_of_results_json_is_written():
    part = result(state(fitted()), remainder()).described(UNTESTED)
    written = plain(part)
    # Earlier versions put an undecided candidate to the hold-out set.
    assert written.keys() == AxisLoop.model_fields.keys() - {"held_out_test"}
    # The errors of single readings stay in the loop, and the time of day is not known to it.
    assert written["steps"][0].keys() == AxisStep.model_fields.keys() - {"event_time"}
    assert part.not_tried == {"reflected_source": "no patch"} and set(part.not_admitted) == {"constant"}
    assert (part.rmse_declared_um, part.rmse_final_um, part.noise_floor_um) == (0.8, 0.3, 0.1)
    assert written["errors"]["final"] == {"rmse_um": 0.3}
    assert (part.best_baseline, part.rmse_persistence_um) == ("ridge", 0.9)


def test_every_score_of_the_search_is_written():
    (scored,) = result(state(fitted()), remainder()).described(UNTESTED).search
    assert scored[0].model_dump() == {
        "effect": "step_event",
        "parameters": {"minutes": 5.0},
        "gain": 21.0,
        "excess_gain": 20.0,
        # What is stated has a floor; the search compares 1e-4.
        "p_value": 1e-3,
        "family_wise_p": 1e-3,
        "held_out_gain": 4.0,
        "held_out_p": 0.02,
        "collinear_share": 0.0,
    }
    # An effect that was not worth confirming has no evidence from unused readings.
    assert (scored[1].held_out_gain, scored[1].held_out_p, scored[1].collinear_share) == (0.0, 1.0, 0.25)
    assert scored[2].parameters == {}


def test_the_nearest_effect_to_what_is_left_is_one_that_was_not_added():
    looped = state(fitted())
    shaped = remainder("a shape", series=WAVE + 0.1)
    told = result(looped, shaped).described(UNTESTED).unexplained
    assert (told.shape, told.rms_um, told.p_value) == ("a shape", 0.2, 0.5)
    wandering = replace(result(looped, shaped), wandering_um=0.6)
    assert wandering.described(UNTESTED).unexplained.rms_um == 0.6
    # No more is left than the whole drift.
    every = replace(wandering, wandering_um=60.0).described(UNTESTED)
    assert every.unexplained.rms_um == every.drift_um < 60.0
    # So is what a step describes that has no name.
    (step,) = wandering.steps
    nameless = replace(wandering, steps=[step.model_copy(update={"withheld": "its period is open"})])
    assert nameless.described(UNTESTED).unexplained.rms_um == pytest.approx(np.hypot(0.6, step.rms_um))
    # The step fits as well (its score has the same column) but is in the model; the constant has no candidate.
    assert (told.closest_effect, told.closest_effect_p) == ("dead_path", 0.1)
    series = WAVE + 0.1
    left = series - WAVE * (WAVE @ series) / (WAVE @ WAVE)
    assert told.closest_effect_share == pytest.approx(1.0 - left @ left / (series @ series))
    nothing = result(looped, remainder()).described(UNTESTED).unexplained
    assert (nothing.closest_effect, nothing.closest_effect_p, nothing.closest_effect_share) == ("", None, None)


# Errors of predictions, and what a model expects of its own.


def test_a_model_of_noise_alone_expects_errors_by_the_law_of_chi_squared():
    """Noise of 0.4 um and no drift, 8 of 40 cycles held out: the rms of m errors has a standard deviation of 0.4 um / (2 m)**0.5."""
    readings = campaign(cycles=40)
    noise = 0.4 * np.random.default_rng(5).standard_normal(readings.seconds.size)
    model = fit_model(replace(readings, response=noise), [], used=readings.cycle <= 32)
    errors, spread = model.open_loop_errors()
    found = expect_errors(model, errors)
    assert found.rmse_um == rmse(errors) and not found.exceeds
    # A drift that the readings leave possible, though they show none, widens it by some per cent.
    assert found.expected_um == pytest.approx(np.sqrt(np.mean(spread**2)), rel=0.1)
    half = (found.expected_high_um - found.expected_low_um) / 2
    assert half == pytest.approx(1.96 * found.expected_um / np.sqrt(2 * errors.size), rel=0.5)
    more = expect_errors(model, 3.0 * errors)
    assert more.exceeds and more.expected_p == 1 / 401 and 0.02 < found.expected_p < 0.98


def test_channels_are_averaged_and_gaps_left_out():
    errors = np.column_stack([np.ones(50), np.full(50, 3.0)])
    errors[3] = np.nan
    assert held_out_errors({"final": errors})["final"].rmse_um == pytest.approx(2.0)


def with_series(course, response):
    """Thirty cycles beside one logged series; the last six are predicted."""
    bare = campaign(cycles=30)
    seconds = np.arange(0.0, bare.seconds[-1] + 60.0, 60.0)
    series = {"load": Series(seconds, course(seconds), "1")}
    readings = replace(bare, series=series, response=response(bare))
    return readings, readings.cycle <= 24


def test_every_plain_prediction_is_of_its_kind():
    def course(seconds):
        return np.sin(seconds / 900.0)

    readings, used = with_series(course, lambda bare: 2.0 * course(bare.seconds) + 5.0 * bare.target)
    errors = {name: missed[~used] for name, missed in plain_errors(readings, used).items()}
    assert list(errors) == ["last_value", "mean", "least_squares", "ridge", "ridge_with_lags"]
    site, response = readings.site, readings.response
    for number in np.unique(site):
        own, later = response[used & (site == number)], (site == number)[~used]
        np.testing.assert_allclose(errors["last_value"][later], response[~used][later] - own[-1])
        np.testing.assert_allclose(errors["mean"][later], response[~used][later] - own.mean())
    # The series is interpolated between its samples.
    assert np.abs(errors["least_squares"]).max() < 1e-2 < 0.5 < np.abs(errors["mean"]).max()
    assert np.sqrt(np.mean(errors["ridge"] ** 2)) < 0.05


def test_a_site_that_was_not_read_before_has_no_prediction():
    readings, used = with_series(np.sin, lambda bare: bare.seconds / 1e4)
    used = used & (readings.site != 3)
    for values in plain_errors(readings, used).values():
        np.testing.assert_array_equal(np.isnan(values), readings.site == 3)


def test_a_cycle_measured_from_time_to_time_corrects_the_prediction():
    bare, rng = campaign(cycles=60), np.random.default_rng(7)
    wander = 0.5 * rng.standard_normal(61).cumsum()
    moved = replace(bare, series={}, response=wander[bare.cycle] + 0.4 * rng.standard_normal(bare.seconds.size))
    used = moved.cycle <= 48
    told = track_cycles(fit_model(moved, [], used=used), plain_errors(moved, used)["ridge"])
    assert told.every_min == pytest.approx(np.median(np.diff(np.unique(cycle_starts(moved)))) / 60.0)
    # Repeating a reading repeats its noise: a step of the walk and two noises, here by the very readings.
    cycle, response = moved.cycle, moved.response
    steps = [response[cycle == number] - response[cycle == number - 1] for number in range(49, 61)]
    assert told.last_reading.rmse_um == pytest.approx(rmse(np.concatenate(steps)))
    # Nothing is logged, so that ridge regression is a constant.
    assert told.ridge.rmse_um == pytest.approx(told.last_reading.rmse_um)
    open_loop = rmse(fit_model(moved, [], used=used).open_loop_errors()[0])
    assert told.model.rmse_um < told.last_reading.rmse_um < open_loop


# Blocks of cycles predicted from the others: the same by dense algebra, and what it says of a step.


LONG = campaign(cycles=20)


def predicted(response: np.ndarray, *columns: np.ndarray, prior: Prior | None = None) -> ModelFit:
    noise = 0.1 * np.random.default_rng(5).standard_normal(LONG.seconds.size)
    terms = [term(column, f"effect {k}") for k, column in enumerate(columns)]
    if prior is not None:
        terms[0] = replace(terms[0], candidate=replace(terms[0].candidate, prior=prior))
    return model_of(replace(LONG, response=response + noise), terms, ratios=RATIOS)


def cross_rmse(model: ModelFit, event_s: float | None = None) -> float:
    return float(np.sqrt(np.nanmean(cross_errors(model, event_s) ** 2)))


def dense_errors(model: ModelFit, block: np.ndarray) -> np.ndarray:
    """Best linear unbiased prediction from the covariance of drift and noise, with priors as further observations."""
    readings, fit = model.readings, model.fit
    since = readings.seconds - readings.seconds[0]
    walk = np.minimum(since[:, None], since[None, :])
    drift = sum(
        ratio * walk * np.outer(one, one) for ratio, one in zip(fit.system.ratios, readings.loadings.T, strict=True)
    )
    noise = np.diag(fit.system.variance)
    x, y, known = fit.design, fit.response, ~block
    whitening = np.linalg.inv(np.linalg.cholesky((drift + noise)[np.ix_(known, known)]))
    a, b = whitening @ x[known], whitening @ y[known]
    for combination, prior in model.priors():
        a = np.vstack([a, combination * fit.sigma / prior.u])
        b = np.append(b, fit.sigma * prior.mean / prior.u)
    beta = np.linalg.lstsq(a, b, rcond=None)[0]
    gain = drift[np.ix_(block, known)] @ np.linalg.inv((drift + noise)[np.ix_(known, known)])
    return y[block] - x[block] @ beta - gain @ (y[known] - x[known] @ beta)


@pytest.mark.parametrize("prior", [None, Prior(0.5, 0.05)])
def test_blocks_are_predicted_by_the_best_linear_prediction(prior):
    wave = np.sin(LONG.seconds / 500.0)
    model = predicted(wave, wave, prior=prior)
    block = (LONG.cycle - 1) // 4
    errors = cross_errors(model)
    assert np.isnan(errors[block == 0]).all()
    for number in range(1, 5):
        np.testing.assert_allclose(errors[block == number], dense_errors(model, block == number), rtol=1e-4, atol=1e-6)


def test_of_an_event_only_the_block_around_it_counts():
    at = float(LONG.seconds[LONG.cycle == 11].min())
    step = (LONG.seconds >= at).astype(float)
    model = predicted(2.0 * step, step)
    block = (LONG.cycle >= 9) & (LONG.cycle < 13)
    errors = cross_errors(model, at)
    assert np.isnan(errors[~block]).all()
    np.testing.assert_allclose(errors[block], dense_errors(model, block), rtol=1e-4, atol=1e-6)


def test_a_site_that_only_one_block_holds_is_left_out():
    odd = (LONG.site == 3) & (LONG.cycle > 4)
    readings = replace(LONG.subset(~odd), response=np.zeros((~odd).sum()))
    noise = 0.1 * np.random.default_rng(5).standard_normal(readings.seconds.size)
    model = model_of(replace(readings, response=noise), [], ratios=RATIOS)
    assert 0.09 < cross_rmse(model) < 0.2


# What may be said: what readings that an effect was not fitted to say of it, and the one word of the outcome.


@pytest.mark.parametrize(
    ("slope", "u", "word"),
    [
        (1.0, 0.2, "yes"),
        (1.0, 0.7, "cannot tell"),
        (0.1, 0.2, "no"),
        (0.1, 0.7, "cannot tell"),
        (-3.0, 1.0, "no"),
        (0.6, 0.1, "yes"),  # there, and nearer to its size than to none
        (0.4, 0.1, "no"),  # there, but a forecast is better without it
        (3.0, 0.2, "cannot tell"),  # there, and of another size
        (3.0, 1.5, "yes"),
        (np.nan, np.inf, "cannot tell"),
    ],
)
def test_the_size_on_unseen_readings_has_three_answers(slope, u, word):
    """The one-sided 95 % point of Student's t with 100 degrees of freedom is 1.66."""
    answer = Answer(slope, u, 100)
    assert answer.word == word
    told = answer.described()
    assert told["confirmed"] is (word == "yes") and (told["doubt"] == "") is (word == "yes")


def test_many_effects_share_the_probability_of_a_false_answer():
    """One of four is borne out beyond the 98.75 % point of Student's t with 100 degrees of freedom, 2.28."""
    assert Answer(0.8, 0.4, 100).word == "yes" and Answer(0.8, 0.4, 100, level=0.05 / 4).word == "cannot tell"
    assert Answer(0.8, 0.4, 100, level=0.05 / 4).power < Answer(0.8, 0.4, 100).power


@pytest.mark.parametrize(
    ("slope", "u", "other"),
    [(0.65, 0.05, True), (1.35, 0.05, True), (0.65, 0.2, False), (0.9, 0.001, False), (np.nan, np.inf, False)],
)
def test_a_name_is_withheld_where_unseen_readings_follow_by_another_size(slope, u, other):
    """3.39 standard uncertainties at the level 0.001, of which the discrepancy of a shape is a part."""
    assert Answer(slope, u, 100).is_of_other_size is other


def test_the_power_is_the_chance_that_a_right_effect_is_borne_out():
    assert Answer(0.0, 1e-3, 100).power == pytest.approx(1.0)
    assert Answer(0.0, np.inf, 100).power == pytest.approx(0.05)
    assert Answer(0.0, 1.0 / (1.66 + 0.84), 100).power == pytest.approx(0.8, abs=0.01)


def unseen(rng: np.random.Generator, size: float, *, channels: int = 3, alike: float = 0.0) -> list[Unseen]:
    """Channels of 100 blocks that follow a load by a size over that predicted, beside a random walk that they share in part."""
    seconds, load = 300.0 * np.arange(100.0), np.repeat(rng.integers(0, 2, 20), 5).astype(float)
    walks = np.cumsum(rng.normal(0.0, 0.2, (100, channels)), axis=0)
    walks = (1.0 - alike) * walks + alike * walks[:, :1]
    return [
        Unseen(
            np.arange(100), seconds, np.ones((100, 1)), size * load + walk, rng.standard_normal((100, 1)), load[:, None],
        )
        for walk in walks.T
    ]  # fmt: skip


@pytest.mark.parametrize(("size", "word"), [(1.0, "yes"), (0.0, "no")])
def test_an_effect_is_borne_out_or_contradicted_whatever_drift_acts_there(size, word, rng):
    (answer,) = answers(unseen(rng, size))
    assert answer.word == word and abs(answer.slope - size) < 4.0 * answer.u
    assert answer.power > 0.95


def test_a_channel_that_ended_before_says_nothing(rng):
    one, other = unseen(rng, 1.0, channels=2)
    parts = ("rows", "seconds", "loadings", "response", "beside", "shares")
    ended = replace(other, **{name: getattr(other, name)[:0] for name in parts})
    assert answers([one, ended]) == answers([one])


def test_channels_that_drift_alike_count_as_one(rng):
    (alone,) = answers(unseen(rng, 1.0, channels=1))
    (four,) = answers(unseen(rng, 1.0, channels=4, alike=1.0))
    # The same drift read at other instants is the same drift.
    turns = [
        replace(
            one,
            **{
                name: getattr(one, name)[k::2]
                for name in ("rows", "seconds", "loadings", "response", "beside", "shares")
            },
        )
        for k, one in enumerate(unseen(rng, 1.0, channels=2, alike=1.0))
    ]
    (first,), (both,) = answers(turns[:1]), answers(turns)
    assert both.u > 0.85 * first.u
    (apart,) = answers(unseen(rng, 1.0, channels=4))
    # The spread of an estimated uncertainty of some 100 readings is a tenth.
    assert four.u == pytest.approx(alone.u, rel=0.4) and apart.u < 0.7 * alone.u


def test_what_does_not_change_on_unseen_readings_is_not_told(rng):
    (one,) = unseen(rng, 1.0, channels=1)
    (answer,) = answers([replace(one, shares=np.full((100, 1), 2.0))])
    assert answer.word == "cannot tell" and answer.described()["borne_out_size"] is None


def test_what_was_taken_off_beforehand_adds_its_uncertainty(rng):
    (one,) = unseen(rng, 1.0, channels=1)
    (sure,), (unsure,) = answers([one]), answers([replace(one, uncertain=0.5 * one.shares)])
    assert unsure.u == pytest.approx(np.hypot(sure.u, 0.5), rel=1e-6)


@pytest.mark.parametrize(("error_um", "exceeds"), [(0.44, False), (0.45, True)])
def test_an_error_exceeds_the_noise_by_what_is_left_beside_it(error_um, exceeds):
    """With half the noise beside it 0.4 um become 0.447 um."""
    assert exceeds_noise(error_um, 0.4, 0.5) is exceeds


@pytest.mark.parametrize(
    ("error_um", "last_um", "mean_um", "skill"),
    [(1.0, 2.0, 3.0, True), (1.0, 0.9, 3.0, False), (1.0, 3.0, 0.9, False), (0.42, 0.41, 0.41, True)],
)
def test_skill_is_more_than_the_last_value_or_the_mean_or_an_error_of_noise_alone(error_um, last_um, mean_um, skill):
    assert has_skill(error_um, last_um, mean_um, 0.4, 0.5) is skill


SOUND = {"named": False, "left": False, "tested": False, "skill": True, "separable": True}


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({}, "complete"),
        ({"named": True}, "explained"),
        ({"left": True}, "unexplained"),
        ({"tested": True}, "unexplained"),
        ({"named": True, "left": True}, "partial"),
        ({"named": True, "tested": True}, "partial"),
        ({"separable": False}, "unexplained"),
        ({"separable": False, "named": True}, "unexplained"),
        ({"separable": False, "skill": False}, "unexplained"),
        ({"skill": False}, "no_skill"),
        ({"skill": False, "named": True}, "no_skill"),
        ({"skill": False, "left": True}, "no_skill"),
        ({"skill": False, "tested": True}, "unexplained"),
        ({"skill": False, "tested": True, "named": True}, "partial"),
    ],
)
def test_the_outcome_has_one_word(changed, word):
    assert verdict(**{**SOUND, **changed}) == word


def test_no_cause_is_separable_where_a_plain_regression_is_better_by_a_quarter():
    assert is_separable(2.06, 1.93) and is_separable(1.0, 0.76) and not is_separable(1.0, 0.75)


@pytest.mark.parametrize(
    ("effect", "parameter", "interval", "fits"),
    [
        ("unseen_heat_source", "time_constant_min", [17.0, 38.0], ""),
        ("unseen_heat_source", "time_constant_min", [130.0, None], "130 min and more fits"),
        ("thermal_lag", "time_constant_min", [None, 7.5], "7.5 min and less fits"),
        ("periodic_disturbance", "period_min", [None, None], "any fits"),
        # A trend since the first reading.
        ("laser_warm_up", "time_constant_min", [16.0, None], "16 min and more fits"),
        # Told by its pattern along the axis.
        ("reversal_drift", "time_constant_min", [None, 20.0], ""),
    ],
)
def test_what_is_told_by_its_course_alone_needs_a_time_that_is_determined(effect, parameter, interval, fits):
    follows = {} if effect == "laser_warm_up" else {"follows": "duty"}
    tried = replace(score(effect, ranges={parameter: interval}), candidate=Candidate(WAVE[:, None], follows, ("um",)))
    why = why_nameless(Step(tried, Round(()), Confirmed.LATER_CYCLES))
    assert bool(why) == bool(fits) and fits in why


@pytest.mark.parametrize(
    ("effect", "parameters", "range_min", "because"),
    [
        ("unseen_heat_source", {"time_constant_min": 17.0}, None, "any fits"),
        ("air_index", {}, None, ""),
        # A trend in a pattern: any slow drift is one.
        ("angular_growth", {"time_constant_min": 240.0, "follows": "warm_up"}, [60.0, None], "60 min and more fits"),
        (
            "angular_growth",
            {"time_constant_min": 20.0, "follows": "duty"},
            [10.0, 40.0],
            "0.2 µm is left beside its 0.4",
        ),
        ("step_event", {"time_s": 20.0}, None, ""),
    ],
)
def test_a_trend_or_a_part_of_a_smooth_drift_has_no_name(effect, parameters, range_min, because):
    ranges = {"time_constant_min": range_min} if range_min else {}
    chosen = replace(score(effect, ranges=ranges), candidate=Candidate(WAVE[:, None], parameters, ("um",)))
    step = Step(chosen, Round(()), Confirmed.LATER_CYCLES)
    why = why_nameless(step, rms_um=0.4, drift_um=0.2, is_smooth=True)
    assert bool(why) == bool(because) and because in why


def test_a_trend_may_be_a_part_of_a_walk_and_what_follows_a_load_may_not():
    def step(parameters: dict[str, float | str]) -> Step:
        chosen = replace(
            score("laser_warm_up", ranges={"time_constant_min": [5.0, 12.0]}),
            candidate=Candidate(WAVE[:, None], parameters, ("ppm",)),
        )
        return Step(chosen, Round(()), Confirmed.LATER_CYCLES)

    trend, following = step({"time_constant_min": 8.0}), step({"time_constant_min": 8.0, "follows": "duty"})
    assert why_nameless(trend, rms_um=0.4, drift_um=0.2) == (
        "a drift of 0.2 µm is left beside its 0.4 µm, of which it may be a part"
    )
    assert why_nameless(trend, rms_um=0.4, drift_um=0.19) == why_nameless(following, rms_um=0.4, drift_um=0.2) == ""


@pytest.mark.parametrize(
    ("weight", "size", "of_larger", "withheld"),
    [(1.0, 0.25, "", True), (1.0, 0.6, "", False), (-1.0, 0.25, "", False), (1.0, 0.6, "why", True), (1.0, 1.3, "why", False)],
)  # fmt: skip
def test_what_the_course_of_a_larger_effect_of_the_same_pattern_may_miss_has_no_name(weight, size, of_larger, withheld):
    slow = 1.0 - np.exp(-BARE.seconds / 200.0)
    other = np.sin(BARE.seconds / 60.0) * np.where(BARE.sign > 0, 1.0, weight)
    lag = term(slow / slow.std(), "a", parameters={"time_constant_min": 3.0})
    noise = 0.01 * np.random.default_rng(4).standard_normal(BARE.seconds.size)
    response = 2.0 * slow / slow.std() + 2.0 * size * other / other.std() + noise
    model = model_of(replace(BARE, response=response), [lag, term(other / other.std(), "b")])
    larger, own = (_contribution(model, one) for one in model.terms)
    # An instant, so that no reason but the course is left.
    event = Step(
        replace(score("b"), candidate=Candidate(WAVE[:, None], {}, ("um",), 9.0)), Round(()), Confirmed.LATER_CYCLES
    )
    said = why_nameless(event, before=[(model.terms[0], larger, of_larger)], rms_um=own.rms_um, pattern=own.pattern)
    assert bool(said) == withheld and ("the course of a" in said) == withheld


def test_what_was_found_beside_an_effect_without_a_name_has_none_unless_it_has_an_instant_or_a_period():
    def step(parameters: dict[str, float], event_s: float | None = None) -> Step:
        candidate = Candidate(WAVE[:, None], parameters, ("um",), event_s)
        return Step(replace(score("a"), candidate=candidate), Round(()), Confirmed.LATER_CYCLES)

    nameless = term(WAVE, "angular_growth")
    before = [(nameless, Contribution(0.1, np.ones(1), 9.0), "its time constant is not determined")]
    assert why_nameless(step({}), before=before) == "it was found beside angular growth, which has no name itself"
    assert why_nameless(step({}, event_s=9.0), before=before) == ""


def test_unseen_readings_that_follow_by_another_size_leave_no_name_unless_the_law_of_the_load_is_open():
    step, other = Step(score("a"), Round(()), Confirmed.LATER_CYCLES), Answer(0.65, 0.05, 100)
    own, beside = Contribution(1.0, np.ones(1), 9.0), Surroundings(0.0, False, 2.0)
    (said,) = reasons_against(step, other, own, [], beside)
    assert said == "on the hold-out set its size is 0.65 ± 0.10 (k = 2) of that predicted: what acts has another course"
    assert not list(reasons_against(step, other, own, [], replace(beside, of_own_law={"a"})))
