"""The result of the loop on a record: its part of results.json, number by number."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.analysis.drift_model import record as module
from fusion.analysis.drift_model.evaluation import Answer, Contribution, Surroundings, describe_steps
from fusion.analysis.drift_model.model import Term
from fusion.analysis.drift_model.predictions import held_out_errors, track_record
from fusion.analysis.drift_model.record import (
    ChainedResult,
    RecordFit,
    RecordRemainder,
    RecordResult,
    close_record,
    examine,
    hold_out,
    report_steps,
    withdraw_unreplicated,
)
from fusion.analysis.drift_model.record_data import Record, RecordedRun, reduce_record
from fusion.analysis.drift_model.search import Confirmation, Confirmed, Decision, LoopState, Reason, Round, Score, Step
from fusion.analysis.effects.effect import Candidate
from fusion.analysis.effects.library import library
from fusion.results.loop import Baselines, ModelError
from fusion.twin.recipe import EffectRecipe
from interferometry.drift.gls import drift_system, fit_fixed_effects
from tests.fusion.record_tables import record_of, runs_table, twin_table

pytestmark = pytest.mark.long

DECLARED = Candidate(np.zeros((4, 2)), {}, ("um/K", "um/K"))
LOAD = Candidate(np.array([[0.0], [1.0], [1.0], [2.0]]), {"follows": "speed"}, ("um",), event_s=None)


def score(name: str, **changes) -> Score:
    return Score(name, LOAD, **changes)


def result(*, shape: str = "") -> RecordResult:
    """Two channels; one effect beside two declared columns."""
    passed = Confirmation(True, Confirmed.LATER_PARTS, error_um=0.4)
    failed = Confirmation(False, Confirmed.LATER_PARTS, error_um=0.9)
    chosen = score("unseen_heat_source", gain=30.0, excess=28.0, family_wise_p=1e-4, p_value=1e-5, confirmation=passed)
    rejected = score("thermal_lag", excess=27.0, family_wise_p=2e-3, p_value=1e-3, confirmation=failed)
    first = Round((rejected, chosen, Score("constant", None)), start_error_um=0.8)
    second = Round((score("thermal_lag", excess=1.0, family_wise_p=0.9),), start_error_um=0.4)
    terms = (Term("quasi_static", DECLARED), Term("unseen_heat_source", LOAD))
    state = LoopState(
        SimpleNamespace(terms=terms),
        steps=(Step(chosen, first, Confirmed.LATER_PARTS),),
        decisions=(
            Decision("dead_path", Reason.NOT_AVAILABLE, {"because": "no positions"}),
            Decision("constant", Reason.COLLINEAR),
        ),
        rounds=(first, second),
        errors_um=(2.0, 0.5),
        errors_without_um=(2.0,),
    )
    record = record_of(np.zeros((4, 2)), np.zeros((4, 1)))
    predicted = {
        "declared": np.full((4, 2), [1.0, 3.0]),
        "final": np.full((4, 2), 0.5),
        **{name: np.full((4, 2), [4.0, 6.0]) for name in Baselines.model_fields},
    }
    left_out = [np.full((4, 2), 0.6), np.full((4, 2), 1.8)]
    # About its mean of 1 the load's course is -1, 0, 0, 1; coefficients of 2 and -4.
    contributed = np.array([-1.0, 0.0, 0.0, 1.0])[:, None] * [2.0, -4.0]
    described = describe_steps(
        state,
        [Answer(1.0, 0.1, 50)],
        [Contribution(float(np.sqrt(np.mean(contributed**2))), np.array([1.0, 0.0]), 10.0)],
        Surroundings(0.0, False, 10.0),
        sizes=[chosen.gain],
        cross_um=[(1.8, 0.6)],
    )
    return predicting(
        RecordResult(
            state=state,
            held_out="1.0 h to 2.0 h held out",
            noise_floor_um=0.2,
            hold_out_errors={},
            hold_out={},
            skill_um=0.5,
            tracking=None,
            steps=report_steps(record, state, described, [contributed]),
            away=frozenset(),
            remainder=RecordRemainder(0.5, {"periodicity": 0.5}, shape, 0.0, np.array([0.1, 0.3])),
            wandering_um=0.15,
            warm_up_only=(),
            record=record,
            is_held_out=np.array([False, False, True, True]),
            predicted={},
            contributions=[np.zeros((4, 2)), contributed],
            left_out=left_out,
            whole=SimpleNamespace(sigma=np.array([0.1, 0.3])),
            chained=[
                ChainedResult(
                    first_h=2.0,
                    last_h=3.0,
                    in_training=True,
                    effects=("unseen_heat_source",),
                    rmse_persistence_um=5.0,
                    rmse_declared_um=1.5,
                    rmse_final_um=0.5,
                    channel_rmse_final_um=np.array([0.5, np.nan]),
                    rmse_events_um=1.5,
                )
            ],
            rounding=np.zeros((2, 2)),
            anchored=None,
        ),
        **predicted,
    )


def predicting(of: RecordResult, **um: np.ndarray | float) -> RecordResult:
    """The same result with other predictions of a record of zeros."""
    predicted = {**of.predicted, **{name: np.broadcast_to(values, (4, 2)) for name, values in um.items()}}
    errors = {name: -values[of.is_held_out] for name, values in predicted.items()}
    told = {name: ModelError(rmse_um=one.rmse_um) for name, one in held_out_errors(errors).items()}
    return replace(of, predicted=predicted, hold_out_errors=errors, hold_out=told, skill_um=told["final"].rmse_um)


def test_the_part_of_results_json_holds_means_over_channels():
    told = result().described([])
    assert told.declared == ("quasi_static",)
    assert (told.noise_floor_um, told.rmse_persistence_um) == (pytest.approx(0.2), 5.0)
    assert (told.rmse_declared_um, told.rmse_final_um) == (2.0, 0.5)
    assert told.not_tried == {"dead_path": "no positions"} and set(told.not_admitted) == {"constant"}
    # Nothing is said of runs in a record of one run.
    assert "runs" not in told.model_fields_set | told.chained[0].model_fields_set


def test_every_channel_has_its_errors():
    told = result().described([]).channels
    assert list(told) == ["ch1", "ch2"]
    assert told["ch1"].model_dump() == {
        "rmse_persistence_um": 4.0,
        "rmse_declared_um": 1.0,
        "rmse_final_um": 0.5,
        "noise_um": 0.1,
        "variance_share": 0.1,
        "rmse_anchored_um": None,
        "expected_anchored_um": None,
    }
    assert (told["ch2"].rmse_declared_um, told["ch2"].rmse_final_um) == (3.0, 0.5)


def test_an_added_effect_is_told_with_its_size_and_its_rivals():
    (step,) = result().described([]).steps
    # A mean square of one half, times coefficients of 2 and -4.
    assert step.rms_by_channel_um == {"ch1": pytest.approx(np.sqrt(2.0)), "ch2": pytest.approx(np.sqrt(8.0))}
    assert step.rms_um == pytest.approx(np.sqrt(5.0))
    assert (step.rmse_before_um, step.rmse_after_um) == (2.0, 0.5)
    assert (step.chained_rmse_before_um, step.chained_rmse_after_um) == (0.8, 0.4)
    assert step.p_value == 1e-3 and step.parameters == {"follows": "speed"}
    assert step.tied == ("thermal_lag",)
    assert step.runner_up.model_dump() == {"effect": "thermal_lag", "gain_deficit": pytest.approx(1.0), "p_value": 2e-3}
    assert step.rejected == {
        "thermal_lag": Decision(
            "thermal_lag", Reason.NOT_PREDICTED, {"p_value": 2e-3, "before_um": 0.8, "after_um": 0.9}
        ).sentence
    }
    assert step.confirmed_by == str(Confirmed.LATER_PARTS) and step.event_s is None
    assert (step.confirmed, step.doubt, step.rmse_without_um) == (True, "", 2.0)
    assert (step.cross_rmse_before_um, step.cross_rmse_after_um) == (pytest.approx(1.8), pytest.approx(0.6))


def test_every_round_is_written():
    first, second = result().described([]).search
    assert [(one.effect, one.chosen) for one in first] == [
        ("thermal_lag", False),
        ("unseen_heat_source", True),
        ("constant", False),
    ]
    assert first[0].rejected and not first[1].rejected
    assert first[1].gain == 30.0 and first[1].excess_gain == 28.0
    assert (first[1].chained_rmse_before_um, first[1].chained_rmse_after_um) == (0.8, 0.4)
    assert first[2].parameters == {}
    # An effect that was not looked at more closely has no error after it.
    assert np.isnan(second[0].chained_rmse_after_um) and second[0].chained_rmse_before_um == 0.4


@pytest.mark.parametrize(
    ("shape", "steps", "word"), [("", 1, "explained"), ("x", 1, "partial"), ("x", 0, "unexplained")]
)
def test_the_verdict_follows_from_steps_and_remainder(shape, steps, word):
    of = result(shape=shape)
    of = replace(of, steps=of.steps[:steps])
    assert of.verdict == word


def test_a_reading_from_time_to_time_starts_the_prediction_again():
    """What the forecast misses is a level that changes with the hold-out set: known from the first reading on."""
    rng = np.random.default_rng(4)
    train = np.arange(200) < 150
    course = np.cumsum(rng.normal(0.0, 2.0, 200))
    walk = np.cumsum(rng.normal(0.0, 0.3, 200)) + 0.05 * rng.standard_normal(200)
    of = record_of((course + walk)[:, None], np.zeros((200, 1)))
    told = track_record(of, train, course[:, None], np.zeros((200, 1)))
    assert told.every_min == 5 * 5.0
    # A random walk of 0.3 um from block to block, 1 to 5 blocks after the last reading; the course wanders 2 um beside it.
    assert told.model.rmse_um == pytest.approx(0.3 * np.sqrt(3.0), rel=0.3)
    assert told.last_reading.rmse_um == told.ridge.rmse_um > 2.0 * told.model.rmse_um


def test_the_nearest_effect_is_the_strongest_of_the_last_round():
    assert result().described([]).unexplained.model_dump() == {
        "shape": "",
        "rms_um": 0.0,
        "share": 1.0,
        "p_value": 0.5,
        "p_values": {"periodicity": 0.5},
        "variance_share": pytest.approx(0.2),
        "closest_effect": "",
    }
    left = result(shape="a rhythm").described([]).unexplained
    # The error of 0.5 um beside the noise of 0.2 um.
    assert left.closest_effect == "thermal_lag" and left.rms_um == pytest.approx(np.sqrt(0.5**2 - 0.2**2))


def test_a_result_prints_a_summary_and_draws_its_errors():
    of = result()
    assert str(of).splitlines()[:2] == ["verdict: explained", "declared: quasi_static"]
    assert of._repr_html_().startswith("<table>") and "unseen_heat_source (follows speed)" in str(of)
    assert len(of.plot().patches) == len(of.hold_out)


# The closed loop on a record as a whole: complete models stay, and effects that did not help are withdrawn.


def test_an_effect_that_fails_on_the_hold_out_set_is_contradicted_and_leaves_the_forecast():
    """The wave turns against itself in the hold-out set: the error after the step is larger, and the forecast is made without it."""
    record = reduce_record(
        twin_table(EffectRecipe("periodic_disturbance", 0.6, parameters={"period_min": 37.0}), seed=44, hours=12.0)
    )
    train, _ = hold_out(record)
    displacement = record.displacement.copy()
    displacement[~train] -= 4.0 * np.cos(2 * np.pi * record.seconds[~train] / 2220.0)[:, None]
    searched = {name: library()[name] for name in ("periodic_disturbance", "step_event")}
    result = close_record(replace(record, displacement=displacement), ["quasi_static"], effects=searched)
    told = result.described([])
    (step,) = told.steps
    assert step.effect == "periodic_disturbance" and not step.confirmed
    assert step.rmse_after_um > step.rmse_before_um and told.rmse_final_um == told.rmse_declared_um
    assert step.borne_out == "no" and step.doubt.startswith("contradicted: on the hold-out set its size is ")
    assert told.left_out_of_forecast == ("periodic_disturbance",)
    assert told.verdict not in {"complete", "explained"}


COLUMN = Candidate(np.zeros((2, 1)), {}, ("um",))


@dataclass(frozen=True)
class Model:
    """A model is its terms."""

    terms: tuple[Term, ...]


class Refitting:
    """As much of a record as a withdrawal asks for: a model of what is kept."""

    def refit(self, model: Model, terms: list[Term]) -> Model:
        return Model(tuple(terms))


def added(*names: str, event_s: float | None = None) -> LoopState[Model]:
    scores = tuple(Score(name, replace(COLUMN, event_s=event_s), family_wise_p=0.004) for name in names)
    scored = Round(scores)
    return LoopState(
        Model(tuple(Term(name, COLUMN) for name in ("quasi_static", *names))),
        steps=tuple(Step(score, scored, Confirmed.LATER_PARTS) for score in scores),
        rounds=(scored,),
    )


def part(effects: tuple[str, ...], declared: float, final: float) -> ChainedResult:
    return ChainedResult.model_construct(
        in_training=True, effects=effects, rmse_events_um=declared, rmse_final_um=final
    )


@pytest.mark.parametrize(
    ("parts", "evidence"),
    [
        ([part(("a",), 1.0, 0.979), part((), 9.0, 9.0)], None),
        ([part(("a",), 1.0, 0.98), part((), 9.0, 9.0)], {"parts": 1, "without_um": 1.0, "with_um": 0.98}),
        # Parts count alike.
        ([part(("a",), 2.0, 1.0), part(("a",), 3.0, 3.5)], None),
        (
            [part(("a",), 2.0, 1.0), part(("a",), 3.0, 4.1)],
            {"parts": 2, "without_um": pytest.approx(2.5), "with_um": pytest.approx(2.55)},
        ),
    ],
)
def test_an_effect_must_have_earned_its_place_where_it_was_tried(parts, evidence):
    state = withdraw_unreplicated(Refitting(), added("a"), parts)
    assert [step.effect for step in state.steps] == (["a"] if evidence is None else [])
    if evidence is not None:
        assert state.decisions[-1].evidence == {"p_value": 0.004, "search_p": 0.004, **evidence}
        assert [term.effect for term in state.model.terms] == ["quasi_static"]


def test_effects_are_withdrawn_one_after_the_other_and_the_others_stay():
    parts = [part(("a", "c"), 1.0, 2.0), part(("b",), 1.0, 0.5)]
    state = withdraw_unreplicated(Refitting(), added("a", "b", "c"), parts)
    assert [step.effect for step in state.steps] == ["b"]
    assert [(one.effect, one.reason) for one in state.decisions] == [
        ("a", Reason.NOT_REPEATED),
        ("c", Reason.NOT_REPEATED),
    ]


def test_an_event_is_not_judged_by_other_parts():
    state = added("step_event", event_s=5.0)
    assert withdraw_unreplicated(Refitting(), state, [part(("step_event",), 1.0, 2.0)]) is state


def test_runs_are_predicted_from_the_other_runs_and_judged_by_themselves():
    """Three runs that start elsewhere: one model serves all of them, because each counts from its own zero."""
    result = close_record(reduce_record(runs_table(5.0, -300.0, 40.0)), ["quasi_static"])
    told = result.described([])
    assert [one.runs for one in told.chained] == [("r1.csv",), ("r2.csv",)]
    assert [(one.file, one.held_out, one.verdict) for one in told.runs] == [
        ("r1.csv", False, ""),
        ("r2.csv", False, ""),
        ("r3.csv", True, told.verdict),
    ]
    held_out = told.runs[2]
    assert held_out.rmse_final_um == pytest.approx(told.rmse_final_um, rel=1e-9)
    # The displacement follows the sensor exactly, but for the shrinkage that forward chaining chose.
    assert held_out.rmse_final_um < 0.01 * held_out.rmse_persistence_um
    assert held_out.duration_h == pytest.approx(1.0)
    assert [
        fit.design[:, :levels].sum() for fit, levels in zip(result.whole.channels, result.whole.levels, strict=True)
    ] == [180 + 60 + 60]


# What a model of a record leaves: rhythms, courses and switchings in its innovations, and slow drifts in the hold-out set.


BLOCKS = 240
BLOCK = np.arange(BLOCKS)


def record_with(*shapes: np.ndarray, channels: int = 2, load: np.ndarray | None = None) -> Record:
    noise = np.random.default_rng(11).standard_normal((BLOCKS, channels))
    displacement = noise + sum(shapes, np.zeros(BLOCKS))[:, None]
    return record_of(displacement, np.zeros((BLOCKS, 1)), drivers=None if load is None else {"speed": load})


def quiet_fit(record: Record) -> RecordFit:
    """A constant in every channel under a drift that is hardly there, so that innovations are what was put in."""
    fits, rows = [], []
    for response in record.displacement.T:
        here = np.flatnonzero(np.isfinite(response))
        system = drift_system(record.seconds[here], np.ones((here.size, 1)), order=1, ratios=np.array([1e-12]))
        fits.append(fit_fixed_effects(system, response[here], np.ones((here.size, 1))))
        rows.append(here)
    return RecordFit(record, np.ones(BLOCKS, bool), (), tuple(fits), tuple(rows))


def examined(record: Record, *, hold_out_rmse: float = 0.0, step: float = 0.0) -> RecordRemainder:
    errors = np.full(len(record.channels), hold_out_rmse)
    return examine(quiet_fit(record), errors, np.full_like(errors, step), np.random.default_rng(1))


def test_noise_leaves_nothing():
    left = examined(record_with())
    assert left.shape == "" and left.p_value > 0.02
    assert set(left.p_values) == {"autocorrelation", "periodicity", "switching"}


def test_what_comes_and_goes_within_blocks_is_a_course_in_time():
    noise = np.random.default_rng(2).standard_normal(BLOCKS + 8)
    left = examined(record_with(1.0 * np.convolve(noise, np.ones(9), "valid") / 2.0))
    assert left.shape == "changes that come and go within a few blocks, too quick for the drift"


@pytest.mark.parametrize(("digits", "words"), [(0.4, ""), (4.0, "a rhythm of about 100 min")])
def test_a_rhythm_is_told_where_it_is_larger_than_the_digits(digits, words):
    # A wave in whole um, without noise: what is left of one of 0.4 um is the rounding itself.
    wave = np.round(digits * np.sin(2.0 * np.pi * 12.0 * BLOCK / BLOCKS) + 0.3)
    left = examined(replace(record_with(), displacement=np.column_stack([wave, wave])), step=1.0)
    assert left.p_value < 0.01 and left.shape == words


def test_a_drift_within_the_digits_is_none():
    assert "slow drift" in examined(record_with(), hold_out_rmse=4.0).shape
    assert examined(record_with(), hold_out_rmse=4.0, step=6.0).shape == ""


def test_no_rhythm_is_longer_than_half_a_run():
    # 1.5 waves over the record, 3 over each half of it.
    slow = 3.0 * np.sin(2.0 * np.pi * 1.5 * BLOCK / BLOCKS)
    assert "rhythm" not in examined(record_with(slow)).shape
    quick = 3.0 * np.sin(2.0 * np.pi * 12.0 * BLOCK / BLOCKS)
    assert examined(record_with(quick)).shape == "a rhythm of about 100 min"


def test_what_restarts_with_every_run_repeats_and_is_no_rhythm():
    of_run = 3.0 * np.sin(2.0 * np.pi * 3.0 * np.arange(60) / 60.0)
    one, first = record_with(np.tile(of_run, 4)), (0, 60, 120, 180)
    runs = tuple(RecordedRun(f"r{k}", one.start, float(one.seconds[at]), k == 3) for k, at in enumerate(first))
    left = examined(replace(one, runs=runs, first=first))
    assert left.shape == "a course that repeats with every run"


def kicked() -> tuple[np.ndarray, np.ndarray]:
    """A load that is switched every 24 blocks, and kicks of 6 um of either sign where it is."""
    load = (BLOCK // 24 % 2).astype(float)
    change = np.flatnonzero(np.diff(load)) + 1
    kick = np.zeros(BLOCKS)
    kick[change] = np.random.default_rng(4).choice([-6.0, 6.0], change.size)
    return load, kick


def test_quick_responses_at_switchings_are_told():
    load, kick = kicked()
    left = examined(record_with(kick, load=load))
    assert left.shape == "quick responses where a driver is switched"
    # Where no driver was logged there is no switching to respond to.
    assert examined(record_with(kick)).p_values["switching"] == 1.0


def test_a_drift_that_nothing_follows_counts_from_three_times_the_noise():
    """Beside the noise of a block, so that the error is the square root of ten times it."""
    record = record_with()
    noise = float(np.sqrt(np.mean(quiet_fit(record).sigma ** 2)))
    below, above = (examined(record, hold_out_rmse=factor * np.sqrt(10.0) * noise) for factor in (0.99, 1.01))
    assert below.shape == ""
    assert above.shape == "a slow drift without a name, largest in all channels alike"
    np.testing.assert_allclose(above.variance_share, 1.01**2 * 10.0 * noise**2 / record.displacement.var(axis=0))
    assert not above.is_tested


@pytest.mark.parametrize(("height", "period"), [(0.5, 6.0), (0.8, 7.2), (10.0, 6.0), (10.0, 7.2)])
def test_a_rhythm_is_told_with_its_period_and_is_no_course_in_time(height, period):
    """A period in blocks of five minutes."""
    left = examined(record_with(height * np.cos(2.0 * np.pi * BLOCK / period)), hold_out_rmse=0.1)
    assert left.shape == f"a rhythm of about {5.0 * period:.0f} min" and left.is_tested
    assert left.p_value < 0.02


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ((1.0, 0.71, 0.1), "ch1, ch2"),
        ((1.0, 0.69, 0.1), "ch1"),
        ((1.0, 0.9, 0.8), "all channels alike"),
        ((1.0, np.nan, 0.8), "ch1, ch3"),
    ],
)
def test_the_channels_with_the_larger_errors_are_named(errors, words):
    left = examine(quiet_fit(record_with(channels=3)), 5.0 * np.array(errors), np.zeros(3), np.random.default_rng(1))
    assert left.shape.endswith(f"largest in {words}")


def test_one_wild_block_makes_no_shape():
    wild = np.zeros(BLOCKS)
    wild[100] = 500.0
    assert examined(record_with(wild)).shape == ""


def test_statistics_of_a_wave_that_is_known():
    """Three turns of amplitude 2 in 24 blocks, in two channels: all power in one line of eleven, twice the mean at its top."""
    blocks = np.arange(24)
    wave = 2.0 * np.cos(2.0 * np.pi * 3.0 * blocks / 24.0)
    switched = np.isin(blocks, [0, 8])
    memory, line, excess = module._statistics(np.column_stack([0.6 * wave, 0.8 * wave]), switched)
    correlation = [wave[k:] @ wave[:-k] / (wave @ wave) for k in range(1, 13)]
    assert memory == pytest.approx(np.sum(np.square(correlation)))
    assert line == pytest.approx(11.0) and module._strongest_line(wave)[0] == 3
    assert excess == pytest.approx(2.0)
    assert module._statistics(wave[:, None], np.zeros(24, bool))[2] == 0.0


def test_a_wave_is_taken_out_at_its_own_frequency_between_the_lines():
    """10.3 turns of amplitude 3 beside a small ramp, which stays."""
    turns = 10.3 / BLOCKS
    ramp = np.linspace(-0.1, 0.1, BLOCKS)
    wave = 3.0 * np.cos(2.0 * np.pi * turns * BLOCK + 0.4)
    frequency, left, share = module._without_wave(np.column_stack([wave + ramp, -wave]))
    assert frequency == pytest.approx(turns, rel=1e-6)
    assert share > 0.999
    assert np.abs(left[:, 1]).max() < 1e-6
    assert np.corrcoef(left[:, 0], ramp)[0, 1] > 0.99
