"""Conclusions: one sentence per verdict, errors with the plain repetition beside them, places as areas, and no contradiction."""

from __future__ import annotations

from typing import Any

import pytest

from fusion.products.results import (
    AnomalyPart,
    CorrelationPart,
    Loop,
    RecordLoop,
    Results,
    SourcePart,
    StepPart,
    Unexplained,
    assemble,
)
from fusion.products.results_loop import ChannelErrors
from fusion.products.results_part import AreaPart
from fusion.report.conclusions import answers
from tests.fusion.results_sample import PARTS


def step(effect: str, **changes: Any) -> StepPart:
    told = {
        "effect": effect, "parameters": {}, "parameter_ranges": {}, "confirmed": True, "doubt": "", "event_time": None, "p_value": 1e-6,
        "rmse_before_um": 1.94, "rmse_after_um": 0.66, "cross_rmse_before_um": 0.57, "cross_rmse_after_um": 0.45,
    }  # fmt: skip
    return StepPart.model_construct(**{**told, **changes})


def loop(verdict: str = "explained", *steps: StepPart, shape: str = "", **changes: Any) -> Loop:
    """The part of a loop that sentences are made of."""
    told = {
        "verdict": verdict, "declared": ("axis_expansion",), "steps": steps, "unnamed": {}, "rmse_persistence_um": 2.5,
        "unexplained": Unexplained.model_construct(shape=shape, rms_um=0.2), "rmse_declared_um": 1.94, "rmse_final_um": 0.66,
        "noise_floor_um": 0.42, "held_out": "cycles 49 to 60 held out; coefficients frozen",
    }  # fmt: skip
    return Loop.model_construct(**{**told, **changes})


def results(found: Loop | None, **parts: Any) -> Results:
    told = {
        "loop": found,
        "inputs": None,
        "time": None,
        "drift": None,
        "iso230": None,
        "anomalies": None,
        "correlation": None,
    }
    return Results.model_construct(**{**told, **parts})


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (
            loop("complete"),
            "The declared model explains the drift (the expansion of the axis); no missing effect can be shown.",
        ),
        (
            loop("explained", step("dead_path"), step("air_index")),
            "The declared model does not explain the drift alone: it lacks the laser's dead path and the refractive index of the air. "
            "With that, no further cause can be shown.",
        ),
        (
            loop("partial", step("dead_path"), step("air_index", confirmed=False)),
            "The declared model does not explain the drift alone: it lacks the laser's dead path. Even with that, a part is left that has "
            "no name.",
        ),
        (
            loop("unexplained", shape="a wave"),
            "A part of the drift (0.20 µm rms) has no explanation: no effect of the library deserves its name.",
        ),
        (loop("unexplained"), "A part of the drift has no explanation: no effect of the library deserves its name."),
        (
            loop("no_skill"),
            "The model predicts no better than repeating the last cycle or the mean: these data cannot tell what drives it.",
        ),
    ],
)
def test_every_verdict_has_its_sentence(found: Loop, sentence: str) -> None:
    assert answers.headline(results(found)) == sentence


def test_without_a_model_that_is_said() -> None:
    assert (
        answers.headline(results(loop("complete", declared=())))
        == "No effect is declared; no missing effect can be shown."
    )
    assert answers.headline(results(None)) == "Evaluated without a model of the drift."
    assert answers.conclude(results(None)) == []


def test_errors_stand_beside_the_plain_repetition() -> None:
    told = answers.prediction_sentence(loop("explained", step("dead_path")))
    assert told == (
        "With the added effect the error of predicting cycles 49 to 60 falls from 1.94 to 0.66 µm; repeating the last cycle gives 2.50 µm, "
        "the scatter of single readings is 0.42 µm; blocks of cycles predicted from the others: 0.57 -> 0.45 µm."
    )
    alone = answers.prediction_sentence(loop("complete"))
    assert alone.startswith(
        "Error of predicting cycles 49 to 60 from what was measured before: 1.94 µm; repeating the last cycle"
    )


def test_an_effect_that_does_not_lower_the_error_is_said_to_do_so() -> None:
    found = loop("explained", step("dead_path"), rmse_declared_um=0.733, rmse_final_um=0.737, rmse_persistence_um=0.41)
    told = answers.prediction_sentence(found)
    assert "does not fall (0.73 µm before, 0.74 µm after)" in told
    assert "gives 0.41 µm (less than the model, which explains here but does not predict better)" in told
    found = loop("explained", step("dead_path"), rmse_persistence_um=1.0)
    assert "gives 1.00 µm (less than the declared model alone)" in answers.prediction_sentence(found)


def test_a_record_repeats_values_and_predicts_blocks_of_time() -> None:
    record = RecordLoop.model_construct(
        **{**vars(loop("explained", step("thermal_lag"))), "held_out": "37.0 h to 46.3 h held out; x", "channels": {}}
    )
    told = answers.prediction_sentence(record)
    assert "predicting 37.0 h to 46.3 h falls" in told and "repeating the last value" in told
    channels = {
        name: ChannelErrors.model_construct(rmse_declared_um=3.01, rmse_final_um=after)
        for name, after in (("ch1", 2.0), ("ch2", 3.21))
    }
    assert answers.prediction_sentence(record.model_copy(update={"channels": channels})).endswith(
        "It does not fall in ch2 (3.0 -> 3.2 µm)."
    )
    assert "the noise of a block mean" in told and "blocks of time predicted from the others" in told


def test_a_name_in_a_record_is_less_certain_than_its_p_value() -> None:
    told = loop("explained", step("unseen_heat_source")).__dict__
    record = RecordLoop.model_construct(**{**told, "channels": {}})
    assert "3 were given a name" in " ".join(answers._how_sure(results(record)))
    assert "3 were given a name" not in " ".join(answers._how_sure(results(loop("explained", step("step_event")))))


def test_what_is_left_is_said_once() -> None:
    shape = "a slow, smooth drift that no effect of the library follows"
    found = results(loop("unexplained", shape=shape, unnamed={"dead_path": 9e-35}))
    told = dict(answers.conclude(found))["What remains"]
    assert told == f"A{shape[1:]}: 0.20 µm rms. Significant and not admitted: dead path of the laser (p < 0.001)."
    assert dict(answers.conclude(results(loop("complete"))))["What remains"].startswith(
        "Nothing that these data can show beyond"
    )


def correlation(verdict: str) -> CorrelationPart:
    source = SourcePart.model_construct(
        x_mm=355.0,
        y_mm=95.0,
        p_value=0.002,
        area=AreaPart(x_low_mm=280.0, x_high_mm=420.0, y_low_mm=40.0, y_high_mm=150.0),
    )
    return CorrelationPart.model_construct(verdict=verdict, source=source, least_p=0.002, randomised_duty=None)


@pytest.mark.parametrize(
    ("verdict", "part"),
    [
        ("attributable", "the area x 280 to 420 mm, y 40 to 150 mm (strongest at x 355 mm, y 95 mm) more closely than"),
        ("not attributable", "the closest is the area x 280 to 420 mm"),
        ("not separable", "These data cannot tell which place"),
    ],
)
def test_every_attribution_has_its_sentence(verdict: str, part: str) -> None:
    told = answers.place_sentence(correlation(verdict))
    assert part in told and "drives" not in told
    assert ("p ≤ 0.002, limit of the simulation" in told) == (verdict != "not separable")


def test_an_unseen_source_and_a_seen_place_are_reconciled() -> None:
    both = results(loop("explained", step("unseen_heat_source")), correlation=correlation("attributable"))
    assert answers.reconcile(both) == (
        "The unseen heat source is what is left beside the part that follows the seen temperatures (the expansion of the axis), so this "
        "place does not show where it is."
    )
    undeclared = both.model_copy(
        update={"loop": loop("explained", step("unseen_heat_source"), declared=("dead_path",))}
    )
    assert "what is left beside what was declared" in answers.reconcile(undeclared)
    for other in (
        results(loop("explained", step("dead_path")), correlation=correlation("attributable")),
        results(loop("explained", step("unseen_heat_source")), correlation=correlation("not attributable")),
    ):
        assert answers.reconcile(other) == ""


def test_a_position_that_stands_out_is_compared_with_the_others() -> None:
    (anomaly,) = assemble("A", PARTS, []).anomalies or ()
    placed = anomaly.model_copy(update={"position_mm": 40.0, "least_p": 0.01})
    assert answers.describe_anomaly(placed) == (
        "Position 3 (40 mm) repeats worse than the others: its standard deviation is 0.60 µm, that of the others 0.30 µm "
        "(p ≤ 0.01, limit of the simulation); probably mechanical (guideway, scale, screw or nut)."
    )
    # Of one approach its own scatter is told, not that of both.
    evidence = anomaly.evidence.model_copy(update={"scatter_negative_um": 0.9})
    one: AnomalyPart = anomaly.model_copy(update={"direction": "negative", "evidence": evidence})
    assert (
        "Position 3, negative approach, repeats worse than the others: its standard deviation is 0.90 µm"
        in answers.describe_anomaly(one)
    )


def test_how_much_names_the_position_with_the_largest_drift() -> None:
    drift = {**PARTS["drift"], "position_mm": [0.0, 150.0], "range_um": [3.1, 11.127], "range_u_um": [0.1, 0.17]}
    told = dict(answers.conclude(assemble("A", {**PARTS, "drift": drift}, [])))["How much"]
    assert told.startswith(
        "During the test the deviation drifted by 11.13 ± 0.34 µm at position 2 (150 mm), and least by 3.10 ± 0.20 µm at position 1 (0 mm) "
        "(± from scatter and estimate alone; laser, material temperature and expansion coefficient: see the ISO 230-2 budget)."
    )
    still = {**drift, "range_um": [0.0, 11.127]}
    told = dict(answers.conclude(assemble("A", {**PARTS, "drift": still}, [])))["How much"]
    assert "and not noticeably at position 1 (0 mm) (± from" in told
    # Too few readings for a scatter: the size is told as it is, and nothing warns.
    unknown = {**still, "scatter_um": {"positive": [None, None], "negative": [None, None]}}
    told = dict(answers.conclude(assemble("A", {**PARTS, "drift": unknown}, [])))["How much"]
    assert "and least by 0.00 ± 0.20 µm at position 1 (0 mm)" in told
    told = dict(answers.conclude(assemble("A", {**PARTS, "drift": drift, "iso230": None}, [])))["How much"]
    assert told.endswith(
        "(± from scatter and estimate alone, without laser, material temperature and expansion coefficient)."
    )
