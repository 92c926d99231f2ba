"""The closed loop along an axis, every step of it on a small campaign by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.drift_model import axis
from fusion.analysis.drift_model.axis import (
    AxisProblem,
    FieldFault,
    LoopError,
    correct_fields,
    corrected_variables,
    find_field_errors,
    hold_out,
    reject_inconsistent_patterns,
    second_search,
    simplify_rhythms,
)
from fusion.analysis.drift_model.model import ModelFit, Term, fit_model
from fusion.analysis.drift_model.search import (
    Confirmation,
    Confirmed,
    Decision,
    LoopState,
    Reason,
    Round,
    Score,
    Step,
    blur,
)
from fusion.analysis.effects.effect import Candidate, Effect
from fusion.analysis.effects.library import library
from tests.fusion.small_campaign import campaign, model_of, term


@pytest.mark.parametrize(("course", "order"), [("straight", 2), ("rhythm", 1)])
def test_a_drift_is_carried_on_at_its_rate_only_where_that_predicts_better_before(rng, course, order):
    """Both are smooth; only the straight one goes on as it did."""
    readings = campaign(cycles=40)
    hours = readings.seconds / 3600.0
    drift = 20.0 * hours if course == "straight" else 2.0 * np.sin(2.0 * np.pi * hours / 0.45)
    readings = replace(readings, response=drift + 0.1 * rng.standard_normal(hours.size))
    used, _ = axis.hold_out(readings)
    problem = AxisProblem(readings, used, {}, rng)
    smooth = fit_model(readings, [], used=used, order=2)
    problem._fits.append(smooth)
    assert problem.fitted([]) is smooth
    assert problem.forecast([]).fit.system.order == order


@pytest.mark.parametrize(("cycles", "first"), [(10, 9), (12, 11), (13, 11), (50, 41)])
def test_the_last_fifth_of_the_cycles_is_held_out_but_two_at_least(cycles, first):
    readings = campaign(cycles=cycles)
    used, description = hold_out(readings)
    np.testing.assert_array_equal(used, readings.cycle < first)
    assert description.startswith(f"cycles {first} to {cycles} held out; coefficients frozen at cycle {first - 1}")


def test_cycles_that_are_missing_do_not_count():
    readings = campaign(cycles=14)
    gapped = readings.subset(~np.isin(readings.cycle, [3, 4]))
    np.testing.assert_array_equal(hold_out(gapped)[0], gapped.cycle < 13)
    with pytest.raises(LoopError, match="9 cycles are too few to hold some out"):
        hold_out(readings.subset(readings.cycle <= 9))


BARE = campaign(cycles=12)
USED = BARE.cycle <= 10
WAVE, LATE = np.sin(BARE.seconds / 100.0), (BARE.seconds >= 650.0).astype(float)


def problem_of(*named: np.ndarray, effects: dict[str, Effect] | None = None) -> AxisProblem:
    """A small campaign with noise of 0.1 um and what is named, of which two cycles are held out."""
    noise = 0.1 * np.random.default_rng(6).standard_normal(BARE.seconds.size)
    readings = replace(BARE, response=noise + sum(named, np.zeros(BARE.seconds.size)))
    return AxisProblem(readings, USED, {} if effects is None else effects, np.random.default_rng(1))


def test_a_change_of_the_reversal_while_cycles_are_missing_is_found_within_the_gap():
    whole = campaign(cycles=24)
    gapped = whole.subset((whole.cycle < 9) | (whole.cycle > 14))
    noise = 0.1 * np.random.default_rng(6).standard_normal(gapped.seconds.size)
    readings = replace(gapped, response=noise + (gapped.cycle > 14) * gapped.sign)
    problem = AxisProblem(
        readings, readings.cycle <= 20, {"step_event": library()["step_event"]}, np.random.default_rng(1)
    )
    (found,) = problem.score(problem.start([])).scores
    before, after = (readings.seconds[readings.cycle == cycle] for cycle in (8, 15))
    assert found.best.parameters["shape"] == "reversal" and before[-1] < found.best.parameters["time_s"] <= after[0]


def score(name: str, candidate: Candidate, **changes) -> Score:
    confirmation = Confirmation(True, Confirmed.LATER_CYCLES)
    return Score(name, candidate, **{"family_wise_p": 1e-3, "confirmation": confirmation, **changes})


@pytest.mark.parametrize(("event_s", "late"), [(1169.0, False), (1170.0, True), (1400.0, True), (None, False)])
def test_an_event_is_late_from_one_cycle_before_the_hold_out_set_on(event_s, late):
    """Cycle 11 starts at 1300 s, and a cycle takes 130 s."""
    assert bool(problem_of().is_late(term(LATE, event_s=event_s))) is late


def test_effects_that_cannot_be_tried_are_decided_at_the_start():
    problem = problem_of(effects=library())
    state = problem.start([])
    told = state.not_tried()
    assert told["thermal_lag"] == "the campaign holds no temperature of the table"
    assert "its own expansion looks the same" in told["laser_warm_up"]
    assert set(library()) - set(told) == {"reversal_drift", "step_event", "periodic_disturbance", "pitch_error"}


def test_a_declared_effect_is_not_asked_whether_something_imitates_it():
    problem = problem_of(effects=library())
    assert "angular_growth" in problem.start([]).not_tried()
    assert "angular_growth" not in problem.start([replace(term(WAVE), effect="angular_growth")]).not_tried()


def test_the_loss_without_a_term_is_that_of_the_likelihood_with_the_drift_kept():
    problem = problem_of(0.5 * WAVE)
    kept, asked = term(LATE), term(WAVE)
    model = model_of(problem.readings, [kept, asked], USED)
    without = model_of(problem.readings, [kept], USED)
    expected = 0.5 * USED.sum() * np.log(without.fit.rss / model.fit.rss)
    assert problem.loss_without(model, asked) == pytest.approx(expected)
    assert problem.loss_without(model, asked) > 2.0 > problem.loss_without(model, kept)


def test_an_event_among_the_hold_out_cycles_is_sized_on_the_other_half_of_the_targets():
    """A step of 1 um in cycle 11: the training part cannot size it, the other targets can."""
    late = (BARE.seconds >= 1300.0).astype(float)
    problem = problem_of(late)
    event = term(late, "step_event", event_s=1300.0)
    assert problem.hold_out_error([]) > 0.7
    assert problem.hold_out_error([event]) < 0.2


def state_of(problem: AxisProblem, *names: str) -> LoopState[ModelFit]:
    """A state before the hold-out set is opened, with a step for every name."""
    terms = [term(np.roll(WAVE, 5 * k) * BARE.sign, name) for k, name in enumerate(names)]
    scored = Round(tuple(score(name, one.candidate) for name, one in zip(names, terms, strict=True)))
    steps = tuple(Step(one, scored, Confirmed.LATER_CYCLES) for one in scored.scores)
    model = axis.fit_model(problem.readings, terms)
    return LoopState(model, steps=steps, rounds=(scored,))


def test_what_was_found_after_a_wrong_pattern_goes_with_it(monkeypatch):
    problem = problem_of()
    state = state_of(problem, "a", "b", "c")
    asked = []

    def second_is_wrong(model, terms, effects):
        asked.append([one.effect for one in terms])
        return {1: Decision("b", Reason.INCONSISTENT_PATTERN, {"p_value": 1e-5})} if len(terms) == 3 else {}

    monkeypatch.setattr(axis, "inconsistent_patterns", second_is_wrong)
    kept = reject_inconsistent_patterns(problem, state)
    assert [step.effect for step in kept.steps] == ["a"]
    assert asked == [["a", "b", "c"], ["a"]]
    assert [(one.effect, one.reason) for one in kept.decisions] == [
        ("b", Reason.INCONSISTENT_PATTERN),
        ("c", Reason.DEPENDS_ON_WITHDRAWN),
    ]
    assert kept.decisions[1].evidence == {"beside": "b", "search_p": 1e-3}


def test_what_was_decided_before_the_hold_out_set_was_opened_stays(monkeypatch):
    """All cycles speak against the patterns of both; only the one that was found in them is withdrawn."""
    problem = problem_of()
    state = state_of(problem, "a", "b")
    late = replace(state.steps[1], confirmed=Confirmed.SECOND_SEARCH)
    state = replace(state, steps=(state.steps[0], late), errors_um=(1.0, 1.0))
    wrong = {place: Decision(name, Reason.INCONSISTENT_PATTERN, {"p_value": 1e-5}) for place, name in enumerate("ab")}
    monkeypatch.setattr(
        axis, "inconsistent_patterns", lambda model, terms, effects: {k: wrong[k] for k in range(len(terms))}
    )
    kept = reject_inconsistent_patterns(problem, state)
    assert [step.effect for step in kept.steps] == ["a"] and kept.errors_um == (1.0, 1.0)


def test_an_effect_that_is_contradicted_moves_no_declared_coefficient_and_no_forecast(monkeypatch):
    def offered(name: str, column: np.ndarray, **options) -> Effect:
        candidate = Candidate(column[:, None], {}, ("um",))
        return Effect(name, "", "", lambda readings, coefficients, near: iter([candidate]), **options)

    other = BARE.sign * np.sin(BARE.seconds / 40.0)
    effects = {"own": offered("own", WAVE, declarable=True), "other": offered("other", other)}
    report = axis.report_steps

    def doubted(state, wrong, held_out):
        return [step.model_copy(update={"borne_out": "no"}) for step in report(state, wrong, held_out)]

    monkeypatch.setattr(axis, "report_steps", doubted)
    readings = problem_of(WAVE, other).readings
    found = axis.close_axis(readings, ["own"], effects=effects)
    assert [step.effect for step in found.steps] == ["other"]
    alone = axis.fit_model(readings, axis.declare(readings, ["own"], effects))
    told = axis.average_over_drifts(alone).coefficients()["own"]
    assert found.declared_coefficients[0].value == pytest.approx(told, rel=1e-9)
    assert found.after.coefficients()["own"] != pytest.approx(alone.coefficients()["own"], rel=1e-6)
    assert found.away == {0} and found.rmse_final_um == found.rmse_declared_um


@pytest.mark.parametrize("told", [{"withheld": "it has no name"}, {"borne_out": "no"}, {"tied": ("rival",)}])
def test_on_fields_of_which_nothing_is_corrected_the_same_is_found_again(monkeypatch, told):
    """Of two added effects of one name the one that was left out of the forecast is left out again, and the other is not."""
    waves = {float(turns): BARE.sign * np.sin(BARE.seconds / 40.0 / turns) for turns in (1, 3)}
    offered = {turns: Candidate(wave[:, None], {"turns": turns}, ("um",)) for turns, wave in waves.items()}
    own, rival = (Candidate(column[:, None], {}, ("um",)) for column in (WAVE, waves[1.0] + 0.1 * np.cos(BARE.seconds)))
    effects = {
        "own": Effect("own", "", "", lambda readings, coefficients, near: iter([own]), declarable=True),
        "other": Effect("other", "", "", lambda readings, coefficients, near: iter(offered.values())),
        "rival": Effect("rival", "", "", lambda readings, coefficients, near: iter([rival])),
    }
    report = axis.report_steps
    monkeypatch.setattr(axis, "report_steps", lambda *found: [one.model_copy(update=told) for one in report(*found)])
    problem = problem_of(WAVE, *waves.values())
    found = axis.close_axis(problem.readings, ["own"], effects=effects)
    again = axis.on_corrected_fields(found, problem.readings, (), effects=effects)
    assert again.declared_coefficients == found.declared_coefficients
    assert again.rmse_final_um == pytest.approx(found.rmse_final_um, rel=1e-9)

    (step,) = found.state.steps
    second = offered[4.0 - float(step.score.best.parameters["turns"])]
    both = (step, replace(step, score=replace(step.score, candidate=second)))
    model = fit_model(problem.readings, [*found.after.terms, Term("other", second)])
    state = replace(found.state, model=model, steps=both)
    twice = replace(found, state=state, after=model, steps=2 * found.steps, away=frozenset({0}))
    forecast, neither = (problem.hold_out_error(state.kept(places)) for places in ([0], [0, 1]))
    again = axis.on_corrected_fields(twice, problem.readings, (), effects=effects)
    assert again.rmse_final_um == pytest.approx(forecast, rel=1e-6) != pytest.approx(neither, rel=1e-3)

    # An error of the camera that was taken out of the fields is a step without a term: shares keep the names of their own terms.
    own, other = found.after.terms
    with_camera = fit_model(problem.readings, [own, Term("camera", second), other])
    camera = found.steps[0].model_copy(update={"effect": "camera"})
    corrected = replace(
        found, state=replace(found.state, model=with_camera, steps=both), steps=[camera, *found.steps], away=frozenset()
    )
    kept = ["other"] if found.steps[0].keeps_name else []
    assert [share.effect for share in corrected._followed[0]] == ["own", *kept]


@pytest.mark.parametrize("withheld", ["", "its time constant is not determined"])
def test_coefficients_move_with_what_else_an_added_effect_may_be(withheld):
    """As far as another candidate moves them that costs half a unit of log-likelihood, and as far as without it where it has no name."""
    other, alternative = np.sin(BARE.seconds / 90.0), np.sin(BARE.seconds / 88.5)
    columns = [Candidate(column[:, None], {}, ("um",)) for column in (other, alternative)]
    effects = {"other": Effect("other", "", "", lambda readings, coefficients, near: iter(columns))}
    problem = problem_of(WAVE, other, effects=effects)
    own, added = term(WAVE, "own"), Term("other", columns[0])
    model = model_of(problem.readings, [own, added])
    scored = score("other", columns[0])
    state = LoopState(model, steps=(Step(scored, Round((scored,)), Confirmed.LATER_CYCLES),))
    told = SimpleNamespace(tied=[], withheld=withheld)
    variances = axis.moved_by_rivals(problem, state, [told], model)

    instead, without = (model_of(problem.readings, [own, *terms]) for terms in ([Term("other", columns[1])], []))
    cost = 0.5 * BARE.seconds.size * np.log(instead.fit.rss / model.fit.rss) / blur(model.size(added))
    assert cost > 0.5
    changes = [one.coefficients()["own"] - model.coefficients()["own"] for one in (instead, without)]
    expected = changes[1] ** 2 if withheld else changes[0] ** 2 / (2.0 * cost)
    assert variances[model.place(own)] == pytest.approx(expected)
    assert not variances[model.place(added)].any()


def second_look(problem: AxisProblem, monkeypatch, *rounds: Round) -> LoopState[ModelFit]:
    scripted = iter(rounds)
    monkeypatch.setattr(problem, "score", lambda state: next(scripted, Round(())))
    monkeypatch.setattr(problem, "refuse", lambda score, model: None)
    start = LoopState(axis.fit_model(problem.readings, []), errors_um=(problem.hold_out_error([]),))
    return second_search(problem, start)


def test_the_second_look_adds_what_the_training_part_could_not_show(monkeypatch):
    late = (BARE.seconds >= 1300.0).astype(float)
    problem = problem_of(late, effects={})
    event = score("step_event", term(late, event_s=1300.0).candidate)
    state = second_look(problem, monkeypatch, Round((event,)))
    assert [(step.effect, step.confirmed) for step in state.steps] == [("step_event", Confirmed.SECOND_SEARCH)]
    # It has no held-out error, and the one that was reported stays.
    assert len(state.errors_um) == 1
    assert state.model.used.all()


@pytest.mark.parametrize(("p_value", "entered"), [(0.005, True), (0.0051, False)])
def test_the_second_look_has_a_level_of_its_own(p_value, entered, monkeypatch):
    problem = problem_of(WAVE)
    wave = score("periodic_disturbance", term(WAVE).candidate, family_wise_p=p_value)
    state = second_look(problem, monkeypatch, Round((wave,)))
    assert [step.confirmed for step in state.steps] == [Confirmed.SECOND_SEARCH] * entered


def test_the_second_look_ends_where_two_effects_replace_each_other(monkeypatch):
    other = np.cos(BARE.seconds / 40.0)
    problem = problem_of(WAVE, other, effects={})
    a, b = score("periodic_disturbance", term(WAVE).candidate), score("pitch_error", term(other).candidate)
    monkeypatch.setattr(problem, "loss_without", lambda model, term: 0.0)
    state = second_look(problem, monkeypatch, *(Round((one,)) for one in (a, b) * 10))
    assert [step.effect for step in state.steps] == ["pitch_error"] and len(state.rounds) == 3


def test_nothing_is_searched_for_where_a_pattern_was_wrong(monkeypatch):
    """What would be found in all cycles stands in for a pattern that the library does not hold."""
    problem = problem_of(WAVE)
    monkeypatch.setattr(problem, "score", lambda state: pytest.fail("it was searched"))
    state = problem.start([]).decide(Decision("a", Reason.INCONSISTENT_PATTERN, {"p_value": 1e-5}))
    assert second_search(problem, state) is state


def test_the_second_look_adds_no_third_event(monkeypatch):
    instants = (400.0, 700.0, 1000.0)
    steps = [(BARE.seconds >= instant).astype(float) for instant in instants]
    problem = problem_of(*steps)
    monkeypatch.setattr(problem, "hold_out_error", lambda terms: 1.0)
    monkeypatch.setattr(problem, "loss_without", lambda model, term: 100.0)
    rounds = [
        Round((score("step_event", term(step, event_s=instant).candidate),))
        for step, instant in zip(steps, instants, strict=True)
    ]
    state = second_look(problem, monkeypatch, *rounds)
    assert [step.effect for step in state.steps] == ["step_event", "step_event"]


def test_an_event_has_two_cycles_before_it_and_one_after():
    """Of ten used cycles of 130 s: from the start of the third to that of the ninth."""
    instants = (259.0, 260.0, 1040.0, 1041.0)
    offered = [term(LATE, event_s=instant).candidate for instant in instants]
    lasting = term(WAVE).candidate
    problem = problem_of(effects={"all": Effect("all", "", "", lambda *_: iter([*offered, lasting]))})
    found = problem.offer("all", problem.start([]).model, None)
    assert [one.event_s for one in found] == [260.0, 1040.0, None]


# Errors of the camera that the loop finds are taken out of the fields, and the model is fitted again.


START = np.datetime64("2026-01-05T06:00", "ns")


def small_fused() -> xr.Dataset:
    """Three cycles of two readings, 100 s apart; the very first reading is missing."""
    time = START + np.array([[[0, 10]], [[100, 110]], [[200, 210]]]) * np.timedelta64(1, "s")
    deviation = np.zeros((3, 1, 2))
    deviation[0, 0, 0] = np.nan
    dims = ("cycle", "direction", "target")
    return xr.Dataset({"time": (dims, time), "deviation": (dims, deviation)}, coords={"cycle": [4, 5, 6]})


def small_fields(frames: int = 6) -> xr.Dataset:
    """A frame every 50 s from the first reading on, two cells, and the mean field of each cycle."""
    return xr.Dataset(
        {
            "frame_temperature": (("time", "y", "x"), np.full((frames, 1, 2), 20.0)),
            "temperature": (("cycle", "y", "x"), np.full((3, 1, 2), 20.0)),
            "temperature_rise": (("cycle", "y", "x"), np.zeros((3, 1, 2))),
        },
        coords={"time": START + 50 * np.arange(frames) * np.timedelta64(1, "s"), "cycle": [4, 5, 6]},
    )


def camera_step(value: float, u: float, *, jump: float, time_s: float) -> SimpleNamespace:
    """What the loop reports of a step of the camera's zero, as far as the correction reads it."""
    step = SimpleNamespace(
        effect="camera_offset",
        coefficients=[SimpleNamespace(value=value, u=u)],
        parameters={"time_s": time_s, "jump_of_the_field_K": jump},
    )
    return SimpleNamespace(steps=[SimpleNamespace(effect="dead_path"), step])


def test_a_step_of_the_zero_is_taken_out_from_its_frame_on() -> None:
    """Seconds count from the first reading that is there, at 10 s: the jump at 90 s is that of the frame at 100 s."""
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=0.6, time_s=90.0), small_fields(), small_fused())
    np.testing.assert_array_equal(error.course_K * error.pattern[0, 0], [0.0, 0.0, -0.6, -0.6, -0.6, -0.6])
    assert (error.effect, error.size_K, error.size_u_K, error.first_cycle) == ("camera_offset", 0.6, 0.1, 5)
    assert error.text == "the camera read +0.600 ± 0.200 K (k = 2) too high from cycle 5 on"


@pytest.mark.parametrize(("time_s", "frame", "cycle"), [(90.0, 2, 5), (91.0, 3, 5), (141.0, 4, 6)])
def test_the_first_frame_that_is_touched_is_the_one_at_the_instant_or_after_it(
    time_s: float, frame: int, cycle: int
) -> None:
    """Frames are 50 s apart and two belong to each cycle; the first reading that is there is 10 s late."""
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=0.1, time_s=time_s), small_fields(), small_fused())
    np.testing.assert_array_equal(error.course_K * error.pattern[0, 0], np.where(np.arange(6) < frame, 0.0, -0.5))
    assert error.first_cycle == cycle
    # However small the error is, it is taken out.
    (faint,) = find_field_errors(camera_step(0.05, 0.01, jump=0.05, time_s=time_s), small_fields(), small_fused())
    assert faint.first_cycle == cycle


@pytest.mark.parametrize(("jump", "size"), [(0.79, 0.79), (0.81, 0.5), (0.21, 0.21), (0.19, 0.5)])
def test_the_size_is_that_of_the_field_where_both_agree_within_three_uncertainties(jump: float, size: float) -> None:
    (error,) = find_field_errors(camera_step(0.5, 0.1, jump=jump, time_s=90.0), small_fields(), small_fused())
    assert error.size_K == size


def test_a_reflection_is_its_pattern_times_what_it_adds_to_its_lowest_state() -> None:
    """A patch of four cells in twenty-four that is brighter by 2 K in every other stretch of five frames, from the first on."""
    frames = 20
    lit = np.arange(frames) // 5 % 2 == 0
    temperature = np.full((frames, 4, 6), 20.0)
    temperature[lit, 1:3, 1:3] += 2.0
    fields = xr.Dataset(
        {"frame_temperature": (("time", "y", "x"), temperature)},
        coords={"time": START + 10 * np.arange(frames) * np.timedelta64(1, "s")},
    )
    step = SimpleNamespace(effect="reflected_source", coefficients=[SimpleNamespace(value=1.1, u=0.05)], parameters={})
    (error,) = find_field_errors(SimpleNamespace(steps=[step]), fields, small_fused())
    # 1.1 +- 0.05 agrees with 1, the size that the field shows.
    assert error.size_K == pytest.approx(2.0, rel=0.02) and error.size_u_K == pytest.approx(0.1, rel=0.02)
    right = temperature + error.course_K[:, None, None] * error.pattern
    np.testing.assert_allclose(right, 20.0, atol=0.05)
    assert error.text.startswith("a reflected source added up to 2.00 ± 0.20 K (k = 2) over a patch from cycle 4 on")


def field_error(*corrections: float) -> FieldFault:
    return FieldFault(
        effect="camera_offset",
        text="it erred",
        size_K=0.5,
        size_u_K=0.1,
        first_cycle=5,
        course_K=np.array(corrections),
        pattern=np.ones((1, 2)),
    )


def test_all_errors_are_taken_out_of_the_frames_and_the_input_stays() -> None:
    fields = small_fields()
    errors = [field_error(0.0, 0.0, -0.5, -0.5, -0.5, -0.5), field_error(0.0, 0.0, 0.0, 0.0, -0.25, -0.25)]
    right = correct_fields(fields, errors)
    np.testing.assert_array_equal(right["frame_temperature"][:, 0, 0], [20.0, 20.0, 19.5, 19.5, 19.25, 19.25])
    np.testing.assert_array_equal(fields["frame_temperature"], 20.0)


def test_a_cycle_is_corrected_by_the_mean_of_its_frames() -> None:
    """Two frames belong to each cycle; the first of the second cycle has not jumped yet."""
    errors = [field_error(-0.1, -0.1, 0.0, -0.5, -0.5, -0.5)]
    variables = corrected_variables(small_fields(), small_fused(), errors)
    correction = variables["field_correction"]
    np.testing.assert_allclose(correction.values[:, 0, 1], [-0.1, -0.1, 0.0, -0.5, -0.5, -0.5])
    np.testing.assert_allclose(variables["temperature_corrected"].values[:, 0, 0], [19.9, 19.75, 19.5])
    # The rise counts from the first cycle, corrected as well.
    np.testing.assert_allclose(variables["temperature_rise_corrected"].values[:, 0, 0], [0.0, -0.15, -0.4], atol=1e-6)
    assert correction.attrs["comment"] == "it erred" and correction.dims == ("frame_time", "plan_y", "plan_x")
    assert variables["temperature_corrected"].dims == ("cycle", "plan_y", "plan_x")


def test_a_cycle_without_a_frame_is_corrected_like_the_frame_before_it() -> None:
    fields = small_fields(4)
    variables = corrected_variables(fields, small_fused(), [field_error(0.0, 0.0, -0.5, -0.7)])
    np.testing.assert_allclose(variables["temperature_corrected"].values[:, 0, 0], [20.0, 19.4, 19.3])


def test_a_long_test_is_corrected_some_frames_at_a_time_with_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [field_error(-0.1, -0.1, 0.0, -0.5, -0.5, -0.5), field_error(0.0, 0.0, 0.3, 0.3, 0.3, 0.0)]
    at_once = corrected_variables(small_fields(), small_fused(), errors)
    frames = correct_fields(small_fields(), errors)["frame_temperature"].values
    monkeypatch.setattr("thermography.large_arrays.PIECE_BYTES", 40)
    monkeypatch.setattr("thermography.large_arrays.IN_MEMORY_BYTES", 8)
    for name, variable in corrected_variables(small_fields(), small_fused(), errors).items():
        assert variable.values.tobytes() == at_once[name].values.tobytes(), name
    assert correct_fields(small_fields(), errors)["frame_temperature"].values.tobytes() == frames.tobytes()


def test_a_rhythm_found_before_a_step_is_one_wave_beside_it():
    """The harmonics of a slower rhythm imitate the step that was not in the model yet."""
    bare, rng = campaign(cycles=80), np.random.default_rng(5)
    sine = np.sin(2.0 * np.pi * bare.seconds / 1200.0)
    late = (bare.seconds >= 5000.0).astype(float)
    readings = replace(bare, response=0.7 * sine + 1.4 * late + 0.3 * rng.standard_normal(bare.seconds.size))
    problem = AxisProblem(readings, np.ones(bare.seconds.size, bool), library(), rng)
    near = Candidate(np.empty((0, 2)), {"period_min": 40.0, "shape": "flat"}, ("um", "um"))
    offered = library()["periodic_disturbance"].candidates(readings, {}, near)
    harmonics = next(one for one in offered if len(one.units) == 14 and one.parameters["shape"] == "flat")
    step = term(late, "step_event", parameters={"time_s": 5000.0}, event_s=5000.0)
    model = fit_model(readings, [Term("periodic_disturbance", harmonics), step], used=problem.used)
    steps = tuple(
        Step(Score(one.effect, one.candidate, gain=9.0), Round(()), Confirmed.LATER_CYCLES) for one in model.terms
    )
    state = simplify_rhythms(problem, LoopState(model, steps=steps))
    wave = state.model.terms[0].candidate
    # The record resolves a period to its square over twice the length, 20 min x 20 min / 275 min.
    assert "course" not in wave.parameters and wave.parameters["period_min"] == pytest.approx(20.0, abs=1.5)
    assert state.steps[0].score.best is wave and state.model.terms[1].effect == "step_event"
    low, high = state.steps[0].score.ranges["period_min"]
    assert low < 20.0 < high < 22.0
    # A rhythm whose harmonics are there keeps them.
    square = replace(readings, response=readings.response - 0.7 * sine + harmonics.columns[:].sum(axis=1))
    problem = AxisProblem(square, problem.used, library(), rng)
    whole = LoopState(fit_model(square, model.terms, used=problem.used), steps=steps)
    assert simplify_rhythms(problem, whole).model is whole.model
