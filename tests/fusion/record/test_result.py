"""The result of the loop on a record: its part of results.json, number by number."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.loop.decisions import Decision, Reason
from fusion.loop.state import Confirmation, Confirmed, LoopState, Round, Score, Step
from fusion.model.fit import Term
from fusion.record.prediction import Prediction
from fusion.record.problem import ChainedPart
from fusion.record.remainder import RecordRemainder
from fusion.record.result import RecordResult
from tests.fusion.record_tables import record_of

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
    coefficients = np.array([[9.0, 9.0], [9.0, 9.0], [2.0, -4.0]])
    nothing = np.zeros((4, 2))
    return RecordResult(
        state=state,
        record=record_of(nothing, np.zeros((4, 1))),
        hold_out=np.array([False, False, True, True]),
        held_out="1.0 h to 2.0 h held out",
        predictions=[
            Prediction(nothing, coefficients[:2], np.zeros(2), 1.0, 0.8),
            Prediction(nothing, coefficients, np.zeros(3), 1.0, 0.4),
        ],
        errors=np.array([[1.0, 3.0], [0.5, np.nan]]),
        plain={name: np.full((4, 2), [4.0, 6.0]) for name in ("last_value", "mean", "ridge")},
        left_out=[np.full((4, 2), 0.6), np.full((4, 2), 1.8)],
        whole=SimpleNamespace(sigma=np.array([0.1, 0.3])),
        remainder=RecordRemainder(0.5, {"rhythm": 0.5}, shape, 0.2, np.array([0.1, 0.3])),
        chained=[
            ChainedPart(
                2.0,
                3.0,
                True,
                ("unseen_heat_source",),
                np.array([4.0, 6.0]),
                np.array([1.0, 2.0]),
                np.array([0.5, np.nan]),
            )
        ],
    )


def test_the_part_of_results_json_has_its_keys_and_means_over_channels():
    told = result().as_json()
    assert json.loads(json.dumps(told, allow_nan=True)).keys() == told.keys()
    assert set(told) == {
        "declared",
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
        "channels",
        "chained",
        "search",
        "not_tried",
        "blocked",
    }
    assert told["declared"] == ["quasi_static"]
    assert (told["noise_floor_um"], told["rmse_persistence_um"]) == (pytest.approx(0.2), 5.0)
    # A channel that was not measured in the hold-out set is left out.
    assert (told["rmse_declared_um"], told["rmse_final_um"]) == (2.0, 0.5)
    assert told["not_tried"] == {"dead_path": "no positions"} and set(told["blocked"]) == {"constant"}


def test_every_channel_has_its_errors():
    told = result().as_json()["channels"]
    assert list(told) == ["ch1", "ch2"]
    assert told["ch1"] == {
        "rmse_persistence_um": 4.0,
        "rmse_declared_um": 1.0,
        "rmse_final_um": 0.5,
        "noise_um": 0.1,
        "variance_share": 0.1,
    }
    assert told["ch2"]["rmse_declared_um"] == 3.0 and np.isnan(told["ch2"]["rmse_final_um"])


def test_an_added_effect_is_told_with_its_size_and_its_rivals():
    (step,) = result().as_json()["steps"]
    # About its mean of 1 the load's course is -1, 0, 0, 1: a mean square of one half, times coefficients of 2 and -4.
    assert step["rms_by_channel_um"] == {"ch1": pytest.approx(np.sqrt(2.0)), "ch2": pytest.approx(np.sqrt(8.0))}
    assert step["rms_um"] == pytest.approx(np.sqrt(5.0))
    assert (step["rmse_before_um"], step["rmse_after_um"]) == (2.0, 0.5)
    assert (step["chained_rmse_before_um"], step["chained_rmse_after_um"]) == (0.8, 0.4)
    assert step["p_value"] == 1e-4 and step["parameters"] == {"follows": "speed"}
    assert step["tied"] == ["thermal_lag"]
    assert step["runner_up"] == {"effect": "thermal_lag", "behind_by": pytest.approx(1.0), "p_value": 2e-3}
    assert step["rejected"] == {
        "thermal_lag": Decision(
            "thermal_lag", Reason.NOT_PREDICTED, {"p_value": 2e-3, "before_um": 0.8, "after_um": 0.9}
        ).sentence
    }
    assert step["confirmed_by"] == str(Confirmed.LATER_PARTS) and step["event_s"] is None
    assert (step["confirmed"], step["doubt"], step["rmse_without_um"]) == (True, "", 2.0)
    assert (step["cross_rmse_before_um"], step["cross_rmse_after_um"]) == (pytest.approx(1.8), pytest.approx(0.6))


def test_a_contribution_is_that_of_the_terms_own_columns():
    of = result()
    term = of.state.model.terms[1]
    expected = np.array([-1.0, 0.0, 0.0, 1.0])[:, None] * [2.0, -4.0]
    np.testing.assert_allclose(of.contribution(term), expected)
    np.testing.assert_array_equal(of.contribution(of.state.model.terms[0]), 0.0)


def test_parts_and_rounds_are_written():
    told = result().as_json()
    assert told["chained"] == [
        {
            "first_h": 2.0,
            "last_h": 3.0,
            "in_training": True,
            "effects": ["unseen_heat_source"],
            "rmse_persistence_um": 5.0,
            "rmse_declared_um": 1.5,
            "rmse_final_um": 0.5,
        }
    ]
    first, second = told["search"]
    assert [(one["effect"], one["chosen"]) for one in first] == [
        ("thermal_lag", False),
        ("unseen_heat_source", True),
        ("constant", False),
    ]
    assert first[0]["rejected"] and not first[1]["rejected"]
    assert first[1]["gain"] == 30.0 and first[1]["excess_gain"] == 28.0
    assert (first[1]["chained_rmse_before_um"], first[1]["chained_rmse_after_um"]) == (0.8, 0.4)
    assert first[2]["parameters"] == {}
    # An effect that was not looked at more closely has no error after it.
    assert np.isnan(second[0]["chained_rmse_after_um"]) and second[0]["chained_rmse_before_um"] == 0.4


@pytest.mark.parametrize(
    ("shape", "steps", "word"), [("", 1, "explained"), ("x", 1, "partial"), ("x", 0, "unexplained")]
)
def test_the_verdict_follows_from_steps_and_remainder(shape, steps, word):
    of = result(shape=shape)
    kept = {"steps": of.state.steps[:steps], "errors_without_um": of.state.errors_without_um[:steps]}
    of = replace(of, state=replace(of.state, **kept))
    assert of.verdict == word


def test_what_the_hold_out_set_does_not_bear_out_is_not_confirmed():
    of = result()
    of = replace(of, state=replace(of.state, errors_without_um=(0.505,)))
    assert of.doubts == ["the error on the hold-out set is 0.505 µm without it and 0.5 µm with it"]
    assert of.verdict == "unexplained" and not of.as_json()["steps"][0]["confirmed"]


def test_a_model_that_the_last_value_beats_has_no_skill():
    of = replace(result(), errors=np.array([[1.0, 3.0], [9.0, 9.0]]))
    assert (of.skill, of.verdict) == (False, "no_skill")


def test_a_significant_effect_without_a_name_keeps_the_verdict_from_being_complete():
    of = result()
    lag = score("thermal_lag", excess=9.0, family_wise_p=9e-35)
    state = replace(of.state, steps=(), errors_without_um=(), rounds=(Round((lag,)),)).decide(
        Decision("thermal_lag", Reason.UNLOGGED_HEAT)
    )
    of = replace(of, state=state)
    assert of.verdict == "unexplained" and of.as_json()["unnamed"] == {"thermal_lag": 9e-35}


def test_the_nearest_effect_is_the_strongest_of_the_last_round():
    assert result().as_json()["unexplained"] == {
        "shape": "",
        "rms_um": 0.2,
        "p_value": 0.5,
        "p_values": {"rhythm": 0.5},
        "variance_share": pytest.approx(0.2),
        "nearest": "",
    }
    assert result(shape="a rhythm").as_json()["unexplained"]["nearest"] == "thermal_lag"
