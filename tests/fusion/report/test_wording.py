"""Numbers, places, tables and findings: digits follow the uncertainty, conditions stand where a doubt touches a figure."""

import io
import re
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from fusion.pipeline.consistency import inputs_part
from fusion.report import findings as answers
from fusion.report import wording
from fusion.report.campaign import describe_model
from fusion.report.findings import action, next_steps
from fusion.report.wording import effect_words, say
from fusion.results import numbers
from fusion.results.axis import (
    AnomalyPart,
    CorrelationPart,
    DriftPart,
    DutyPart,
    Evidence,
    Iso230Part,
    Iso230WithTable,
    SourcePart,
)
from fusion.results.loop import (
    AxisStep,
    AxisUnexplained,
    Baselines,
    ChannelErrors,
    Coefficient,
    DriftShare,
    HeldOutError,
    Loop,
    ModelError,
    ModelErrors,
    RecordStep,
    StepPart,
    Unexplained,
)
from fusion.results.parts import AreaPart, InputsPart, Iso230Tolerance, Quantity, TimePart
from fusion.results.results import Notice, RecordLoop, Results, assemble
from tests.fusion.results_sample import PARTS, told


@pytest.mark.parametrize(
    ("value", "u", "text"),
    [
        (9.9017, 1.378, "9.9 ± 2.8 µm"),
        (0.05512, 0.0023, "0.0551 ± 0.0046 µm"),
        (-123.4, 20.0, "−123 ± 40 µm"),
        (1.5, None, "1.50 µm"),
        (1.5, 0.0, "1.50 µm"),
        (float("nan"), 1.0, "–"),
        (None, None, "–"),
    ],
)
def test_a_value_has_the_digits_of_its_uncertainty(value, u, text):
    assert numbers.measured(value, u, "µm") == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234.5678, "1234.5678"),
        (1001.2345, "1001.2345"),
        (1234567.0, "1234567"),
        (12345678.9, "12345678.9"),
        (-0.0, "0"),
        (0.1 + 0.2, "0.3"),
        (-12.3456, "−12.3456"),
        (1e-7, "0.0000001"),
    ],
)
def test_a_stated_number_keeps_its_digits(value, text):
    assert numbers.exact(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(119.4, "119 s"), (119.7, "2 min"), (7169, "119 min"), (7199, "2.0 h"), (-5, "−5 s"), (0.0, "0 s")],
)
def test_a_duration_has_the_unit_of_its_rounded_value(seconds, text):
    assert numbers.duration(seconds) == text


def test_no_number_is_smaller_than_the_arithmetic_or_its_table_can_hold():
    assert numbers.number(2.2e-15) == numbers.number(-8e-10) == "0"
    assert numbers.measured(0.0, 2.2e-15, "µm") == "0 µm" and numbers.measured(8e-10, 0.085) == "0.00 ± 0.17"
    # A nanometre-scale test keeps its digits, and a budget states its smallest terms as a bound.
    assert numbers.number(3.14e-4, 2) == "0.00031"
    assert numbers.number(3.14e-4, 2, least=1e-3) == "< 0.001" and numbers.number(0.02, 2, least=1e-3) == "0.020"
    assert numbers.fixed(-0.0001, 2) == "0.00" and numbers.alike([1e-9, 5.0]) == ["0.0000", "5.0000"]


def test_numbers_probabilities_and_times_are_printed_as_a_reader_expects_them():
    assert (numbers.exact(-20.0), numbers.exact(12.5), numbers.place(-3.0, None)) == ("−20", "12.5", "x −3 mm, y – mm")
    # A damaged file of results may lack a position, or hold the largest number that there is.
    assert (numbers.exact(None), numbers.measured(2.0, 1e308), numbers.decimals_of(1e308)) == ("–", "2.00", 2)
    assert numbers.p_cell(0.0004) == "< 0.001" and numbers.p_cell(0.0123) == "0.012" and numbers.p_cell(None) == "–"
    assert numbers.duration(90) == "90 s" and numbers.duration(1800) == "30 min" and numbers.duration(25200) == "7.0 h"
    assert numbers.join(["a", "b", "c"]) == "a, b and c" and numbers.join(["a"]) == "a" and numbers.join([]) == ""
    assert numbers.moment(np.datetime64("2026-03-09T06:30:05")) == "2026-03-09 06:30 UTC"
    assert numbers.p_cell(1 / 280, 1 / 280) == "≤ 0.004" and numbers.p_cell(0.002, 0.002) == "≤ 0.002"
    assert numbers.p_cell(0.025, 0.025) == "≤ 0.03" and numbers.p_cell(0.004, 0.002) == "0.004"
    assert numbers.p_words(0.002, 0.002) == "p ≤ 0.002, resolution of the Monte Carlo test"
    assert numbers.p_words(0.004, 0.002) == "p = 0.004" and numbers.p_words(1e-9, 0.0) == "p < 0.001"
    assert numbers.alike([1.938, 0.4643, None]) == ["1.94", "0.46", "–"]
    assert numbers.alike([0.7331, 0.7372]) == ["0.73", "0.74"]
    # Two that differ do not read alike; two that are equal do.
    assert numbers.alike([0.7331, 0.7332]) == ["0.7331", "0.7332"]
    assert numbers.alike([0.5, 0.5]) == ["0.50", "0.50"]
    assert numbers.alike([-0.5, float("nan")]) == ["−0.50", "–"]
    assert numbers.moment("2026-03-09T06:30:05Z", "Europe/Vienna") == "2026-03-09 07:30 CET"
    assert numbers.moment("2026-07-09T06:30:05Z", "Europe/Vienna") == "2026-07-09 08:30 CEST"
    assert numbers.moment(np.datetime64("NaT")) == "–"
    assert numbers.gain(-0.04) == "0.0" and numbers.gain(-0.06) == "−0.1" and numbers.gain(None) == "–"


def doubted(*codes: str) -> InputsPart:
    """The part on the inputs with some checks that are not passed."""
    return inputs_part([told(code, passed=False) for code in codes], ())


def test_what_a_doubt_touches_is_conditional_and_several_are_named_or_counted():
    inputs = doubted("material_rise")
    said = "The drift goes with the table."
    told = wording.conditional(said, inputs, "causes")
    assert told == "Only if the emissivity is right: the drift goes with the table."
    assert wording.conditional(said, inputs, "positions") == said == wording.conditional(said, None, "causes")
    assert wording.condition(inputs, "field") == "(only if the emissivity is right)"
    assert wording.condition(inputs, "positions") == ""
    assert wording.untouched(inputs).startswith("Not affected: what the laser shows alone")
    two, three = doubted("material_rise", "datum"), doubted("material_rise", "datum", "camera_clock")
    both = "the emissivity is right and the datum of the laser stayed the same"
    assert wording.condition(two, "causes") == f"(only if {both})"
    assert wording.condition(two, "positions") == "(only if the datum of the laser stayed the same)"
    assert wording.condition(three, "causes") == "(only if 3 doubted inputs are right)"
    assert wording.untouched(two) == "" == wording.untouched(None)


def test_every_number_of_a_diagnosis_has_its_words():
    assert set(wording.EVIDENCE) == set(Evidence.model_fields) - {"kind", "support", "against", "check"}
    assert not [words for words in wording.EVIDENCE.values() if "_" in words]


def test_parameters_are_words_with_units_and_the_range_that_fits_as_well():
    told = wording.parameters({"follows": "warm_up", "time_constant_min": 30.0})
    assert told == "follows warm up, time constant 30.0 min"
    told = wording.parameters({"time_constant_min": 39.6}, {"time_constant_min": (29.0, None)})
    assert told == "time constant 39.6 min (at least 29.0)"
    told = wording.parameters(
        {"sensor": "head_1_K", "start": "not_free"}, {"sensor": ("b_mm", "c"), "start": ("is_free",)}
    )
    assert told == "sensor head_1_K (or b_mm and c), start not free (or is free)"
    told = wording.parameters(
        {"time_s": 90, "wave_um": 1.0, "tau_min": 2.0}, {"time_s": (60.0, 120.0), "tau_min": (None, 3.0)}
    )
    assert told == "90 s after the start (60 s to 2 min), wave 1.00 µm, tau 2.00 min (at most 3.00)"
    assert (
        wording.parameters({"time_s": "late", "b_s": 1}, {"b_s": (None, None)}) == "time late s, b 1 s (not determined)"
    )
    assert wording.in_words([1.0, True, None, "warm_up"]) == "1.00, yes, – and warm up"
    assert wording.limited(5.0, (4.97, 5.03), "µm") == "5.000 [4.970 to 5.030] µm"
    assert wording.limited(5.0, (None, 5.1), "µm") == "5.00 µm" and wording.limited(None, (1.0, 2.0)) == "–"
    assert [wording.whole_percent(share) for share in (0.005, 0.5, 0.995)] == [
        "less than 1 %",
        "50 %",
        "more than 99 %",
    ]


def test_the_largest_and_the_smallest_range_of_the_drift_are_found_among_those_that_are_known():
    drift = DriftPart.model_construct(
        range_um=(None, 3.1, 11.13, 0.1), range_u_um=(None, 0.1, None, 0.17), position_mm=(0.0, 1.0, 150.0, 300.0)
    )
    largest, smallest = wording.drift_extremes(drift)
    assert largest == (Quantity(value=11.13, u=None), 3, 150.0, False)
    assert smallest == (Quantity(value=0.1, u=0.17), 4, 300.0, True)
    assert [wording.drift_size(one) for one in (largest, smallest)] == ["11.1 µm", "below 0.34 µm"]


@pytest.mark.parametrize(
    ("direction", "positive", "negative", "place", "scatter"),
    [
        ("both", 0.6, 0.8, "position 3, both approaches", 0.5**0.5),
        ("both", None, 0.8, "position 3, both approaches", 0.8),
        ("both", None, None, "position 3, both approaches", None),
        ("positive", 0.6, 0.8, "position 3, positive approach", 0.6),
        ("negative", 0.6, None, "position 3, negative approach", None),
    ],
)
def test_an_anomaly_stands_at_an_approach_with_its_scatter(direction, positive, negative, place, scatter):
    evidence = Evidence.model_construct(scatter_positive_um=positive, scatter_negative_um=negative)
    found = AnomalyPart.model_construct(target=3, direction=direction, evidence=evidence, cause="undetermined")
    assert wording.anomaly_place(found) == place and wording.scatter_of(found) == pytest.approx(scatter)
    assert wording.figures_of_anomalies([found]) == ["positions"]
    warm = found.model_copy(update={"cause": "local_temperature"})
    assert wording.figures_of_anomalies([found, warm]) == ["field", "positions"]


def test_a_table_is_printed_without_its_columns_of_dashes():
    whole = wording.table(
        [wording.Words("place"), "size", "none"], [["a", "1", "–"], wording.Row(["b–", "–", "–"], marked=True)]
    )
    shown = wording.with_values(whole)
    assert shown.titles == ("place", "size") and [row.marked for row in shown.rows] == [False, True]
    console = Console(width=40, file=io.StringIO(), color_system=None)
    console.print(wording.print_table(shown, "T"))
    cells = [re.split(r"[│┃]", line)[1:3] for line in console.file.getvalue().splitlines() if line[0] in "│┃"]
    assert cells == [[" place ", " size "], [" a     ", "    1 "], [" b–    ", "    – "]]


def test_several_steps_have_one_share_together():
    steps = (("step", 0.5), ("lag", 0.25), ("step", 0.25), ("step", None))
    parts = [DriftShare.model_construct(effect=effect, share=share) for effect, share in steps]
    assert [(one.effect, one.share) for one in wording.by_effect(parts)] == [("step", 0.75), ("lag", 0.25)]


def step(effect: str, **changes: Any) -> StepPart:
    told = {
        "effect": effect, "parameters": {}, "parameter_ranges": {}, "confirmed": True, "doubt": "", "event_time": None, "p_value": 1e-6,
        "tied": (), "rmse_before_um": 1.94, "rmse_after_um": 0.66, "cross_rmse_before_um": 0.57, "cross_rmse_after_um": 0.45,
    }  # fmt: skip
    return StepPart.model_construct(**{**told, **changes})


def baselines(mean_um: float = 2.2, last_um: float = 2.5) -> Baselines:
    """Errors of plain predictions."""
    told = {"last_value": last_um, "mean": mean_um, "ridge_with_lags": 0.31}
    return Baselines.model_construct(
        **{name: HeldOutError.model_construct(rmse_um=error) for name, error in told.items()}
    )


def loop(verdict: str = "explained", *steps: StepPart, shape: str = "", **changes: Any) -> Loop:
    """The part of a loop that sentences are made of."""
    told = {
        "verdict": verdict, "declared": ("axis_expansion",), "steps": steps, "unconfirmed_effects": {}, "rmse_persistence_um": 2.5,
        "unexplained": Unexplained.model_construct(shape=shape, rms_um=0.2), "rmse_declared_um": 1.94, "rmse_final_um": 0.66,
        "noise_floor_um": 0.42, "held_out": "cycles 49 to 60 held out; coefficients frozen", "baselines": baselines(),
        "errors": ModelErrors(declared=ModelError(rmse_um=1.94), final=ModelError(rmse_um=0.66)),
    }  # fmt: skip
    return Loop.model_construct(**{**told, **changes})


def results(found: Loop | None, **parts: Any) -> Results:
    return Results.model_construct(**{"loop": found, "warnings": (), **parts})


@pytest.mark.parametrize(
    ("found", "stated"),
    [
        (loop("complete"), ["the expansion of the axis", "Nothing else is detected."]),
        (loop("complete", declared=()), ["No effect is declared"]),
        (
            loop("explained", step("dead_path"), step("air_index")),
            ["lacks the laser's dead path and the refractive index of the air.", "Nothing else is detected."],
        ),
        (
            loop("partial", step("dead_path"), step("air_index", confirmed=False, borne_out="no")),
            [
                "lacks the laser's dead path.",
                "The rest, 0.20 µm rms, what was added without a name included, is unexplained",
            ],
        ),
        (
            loop("explained", step("dead_path", confirmed=False, borne_out="cannot tell"), wandering_um=0.16),
            ["lacks the laser's dead path (not yet borne out).", "A random drift of 0.16 µm rms was allowed for."],
        ),
        (
            loop("unexplained", shape="a wave"),
            ["predicted to 0.66 µm (last", "The rest, 0.20 µm rms, is unexplained."],
        ),
        (
            loop("unexplained", step("dead_path"), separable=False),
            ["with lags predict it to 0.31 µm; a cause is not separable."],
        ),
        (loop("unexplained"), ["is unexplained"]),
        (loop("no_skill"), ["repeating the last cycle or the mean"]),
        (None, ["without a model"]),
    ],
)
def test_every_verdict_has_its_statement(found, stated):
    told = answers.headline(results(found))
    assert all(part in told for part in stated), told


@pytest.mark.parametrize(
    ("shares", "changes", "stated"),
    [
        ((0.83, 0.12), {}, "83 % of the drift (3.0 µm rms) follows the expansion of the axis and 12 % a shift with"),
        ((0.997,), {}, "More than 99 % of the drift (3.0 µm rms) follows the expansion of the axis."),
        # Where one effect cancels a part of another there is no share of each.
        ((1.4, -0.43), {}, "97 % of the drift (3.0 µm rms) follows the expansion of the axis and a shift with the"),
        ((0.9, 0.1), {"drift_um": 0.2}, "The drift, 0.20 µm rms, is less than half of the scatter of single readings"),
    ],
)
def test_the_first_sentence_names_what_the_drift_follows_and_its_share(shares, changes, stated):
    names = ("axis_expansion", "table_offset")[: len(shares)]
    followed = tuple(map(share_of, names, shares))
    for verdict in ("complete", "unexplained"):
        told = loop(verdict, declared=names, followed=followed, **{"drift_um": 3.0, **changes})
        assert answers.headline(results(told)).startswith(stated)


def share_of(effect: str, share: float) -> DriftShare:
    return DriftShare(effect=effect, share=share)


def test_what_is_left_is_told_with_what_it_resembles():
    left = AxisUnexplained(
        shape="a slow drift", rms_um=0.3, p_value=0.4, closest_effect="unseen_heat_source", closest_effect_p=0.06,
        closest_effect_share=0.99, closest_effect_parameters={"follows": "duty"},
    )  # fmt: skip
    told = answers.headline(results(loop("unexplained", unexplained=left)))
    assert "resembles an unseen heat source (follows duty, 99 % of its variance), without" in told
    assert "p = 0.06" in say("what_remains", results(loop("unexplained", unexplained=left)))
    far = left.model_copy(update={"closest_effect_share": 0.4})
    assert "resembles" not in answers.headline(results(loop("unexplained", unexplained=far)))


def test_a_single_warm_up_is_said_with_the_verdict_and_the_coefficients():
    conditional = loop("complete", warm_up_only=("axis_expansion",))
    assert say("verdict_word", conditional) == "complete (not refutable: one warm-up)"
    assert "whatever else warms alike counts with the expansion of the axis" in answers.headline(results(conditional))
    assert any("switched at random" in step for step in next_steps(results(conditional)))
    whole = assemble("A", PARTS, []).loop
    assert "nothing else warmed alike" not in describe_model(whole)[0][1]
    conditional = whole.model_copy(update={"warm_up_only": ("axis_expansion",)})
    assert describe_model(conditional)[0][1].endswith("if nothing else warmed alike (one warm-up)")


def test_what_predicts_no_better_than_the_mean_explains_nothing():
    noise = answers.headline(results(loop("complete", baselines=baselines(mean_um=0.661))))
    assert "as well (0.66 µm) as the model (0.66 µm)" in noise
    assert "predicts" not in answers.headline(results(loop("complete", baselines=baselines(mean_um=0.70))))
    worse = loop("unexplained", shape="a wave", rmse_final_um=140.0, baselines=baselines(mean_um=81.0, last_um=67.0))
    told = answers.headline(results(worse))
    assert "the last cycle simply repeated predicts better (67 µm) than the model (140 µm)" in told
    # What a mean leaves less of is no share, and what the noise hides is no random drift.
    assert [wording.variance_left(share) for share in (0.12, 1.146, None)] == ["12 %", "all", "–"]
    assert "random drift" not in answers.headline(results(loop("complete", wandering_um=1e-4)))
    assert "random drift of 0.00016" in answers.headline(
        results(loop("complete", wandering_um=1.6e-4, noise_floor_um=5e-4))
    )


@pytest.mark.parametrize(
    ("changes", "stated"),
    [
        (
            {},
            [
                "cycles 49 to 60 falls from 1.94 to 0.66 µm",
                "gives 2.50 µm,",
                "is 0.42 µm",
                "others: from 0.57 to 0.45 µm.",
            ],
        ),
        (
            {"rmse_declared_um": 0.733, "rmse_final_um": 0.737, "rmse_persistence_um": 0.41},
            ["does not fall (0.73 µm before, 0.74 µm after)", "gives 0.41 µm (less than the model"],
        ),
        ({"rmse_declared_um": 1.0, "rmse_persistence_um": 1.0}, ["gives 1.00 µm, the"]),
        ({"rmse_persistence_um": 1.0}, ["gives 1.00 µm (less than the declared model alone)"]),
        (
            {"rmse_persistence_um": 0.9},
            [
                "cycles 49 to 60 is 0.66 µm;",
                "is no reference",
                "misses by 1.94 µm",
                "the last cycle repeated, 0.90 µm.",
            ],
        ),
        ({"steps": ()}, ["measured before: 1.94 µm; repeating the last cycle gives 2.50 µm,"]),
    ],
)
def test_errors_are_compared_with_plain_repetition(changes, stated):
    told = say("prediction", loop("explained", step("dead_path"), **{"steps": (step("dead_path"),), **changes}))
    assert all(part in told for part in stated), told


def test_a_record_repeats_values_and_predicts_blocks_of_time():
    channels = {
        name: ChannelErrors.model_construct(rmse_declared_um=3.01, rmse_final_um=after)
        for name, after in (("ch1", 2.0), ("ch2", 3.21), ("ch3", 3.01))
    }
    lagging = loop("explained", step("thermal_lag", rms_um=0.4), held_out="37.0 h to 46.3 h held out; x")
    told = {**vars(lagging), "channels": channels}
    stated = say("how_sure", results(RecordLoop.model_construct(**told)))
    parts = (
        "37.0 h to 46.3 h falls",
        "the last value",
        "noise of a block mean",
        "blocks of time",
        "ch2 (from 3.0 to 3.2 µm).",
    )
    assert all(part in stated for part in parts), stated
    # The error rate of a name in a record is larger than its p-value.
    assert "Of 40 simulated records" in stated
    assert "Of 40" not in say("how_sure", results(loop("explained", step("step_event"))))


def test_nothing_is_not_said_to_remain_beside_an_effect_that_is_contradicted():
    struck = step("air_index", confirmed=False, borne_out="no", doubt="contradicted: its size is 0.1", rms_um=0.4)
    told = say("what_remains", results(loop("unexplained", struck)))
    assert "0.40 µm rms, has no name: contradicted" in told and "Nothing" not in told
    assert "refractive index" not in answers.headline(results(loop("unexplained", struck)))


def test_the_headline_names_the_positions_that_stand_out_in_place_of_nothing_else():
    (anomaly,) = assemble("A", PARTS, []).anomalies or ()
    model = loop("explained", step("dead_path"))
    one = anomaly.model_copy(update={"position_mm": -40.0})
    others = [one.model_copy(update={"target": target, "position_mm": 0.0}) for target in (9, 7, 5)]
    assert say("why", results(model, anomalies=())).endswith("Nothing else is detected.")
    told = say("why", results(model, anomalies=(one,)))
    assert "Nothing" not in told and told.endswith(" dead path.")
    brief = "position_in_brief"
    (said,) = {say(brief, results(model_of, anomalies=(one,))) for model_of in (model, loop("no_skill"))}
    assert said == "Position 3 (−40 mm) repeats worse than the others: probably mechanical."
    assert say(brief, results(model, anomalies=())) == "No position stands out from the others."
    several = say(brief, results(model, anomalies=(*others[:2], one, one)))
    assert several == "Positions 3, 7 and 9 stand out from the others."
    assert say(brief, results(model, anomalies=(one, *others))) == "4 positions stand out from the others."


def axis_of(a_um: float, m_um: float, decision: str) -> Iso230Part:
    """A test of five cycles by its values alone, R 55 µm with U 13 µm."""
    values = {"A": a_um, "R": 55.0, "B": 33.0, "M": m_um, "E": 100.0}
    told = {f"{name}_um": Quantity(value=value, u=6.5) for name, value in values.items()}
    judged = Iso230Tolerance.model_construct(quantity="A", decision=decision)
    return Iso230Part.model_construct(
        **told, unit="um", window="cycles 1 to 5", tolerances=(judged,), checks=(), contributions=()
    )


def test_an_axis_that_fails_by_its_mean_deviation_is_to_be_compensated_first():
    late = (Notice("times", "No times.", "Export the times."),)
    first, second = next_steps(results(None, iso230=axis_of(135.0, 94.0, "fail"), warnings=late))
    assert first.startswith("Load a compensation table from thermofuse export (--format csv)") and second.startswith(
        "Exp"
    )
    # Its own readings say nothing of a table that they made.
    assert "would" not in first
    told = Iso230WithTable(quoted_um=5.4, lowest_um=4.1, highest_um=10.1)
    known = axis_of(135.0, 94.0, "fail").model_copy(update={"with_table": told, "cycles": (26, 27, 28, 29, 30)})
    (known_step,) = next_steps(results(None, iso230=known))
    assert "(5.4 µm in the quoted cycles, 26 to 30)" in known_step
    assert answers.in_brief(known_step).endswith(": A would become 4.1 to 10 µm.")
    assert next_steps(results(None, iso230=axis_of(135.0, 94.0, "fail"))) == [first]
    # What repeats badly is not compensated, what passes need not be, what is not judged may be.
    for axis in (axis_of(135.0, 40.0, "fail"), axis_of(135.0, 94.0, "pass")):
        assert next_steps(results(None, iso230=axis, warnings=late)) == [second]
    assert next_steps(results(None, iso230=axis_of(135.0, 94.0, "not decided"), warnings=late)) == [second, first]
    # Nor is a profile that holds drift without a cause.
    for verdict, advised in (("explained", True), ("partial", False)):
        steps = next_steps(results(loop(verdict), iso230=axis_of(135.0, 94.0, "fail")))
        assert any(one.startswith("Load a compensation table") for one in steps) == advised


def test_a_position_has_one_sentence_with_the_cause_of_its_most_significant_finding():
    (anomaly,) = assemble("A", PARTS, []).anomalies or ()
    weaker = anomaly.model_copy(update={"p_value": 0.5, "cause": "stick_slip", "direction": "negative"})
    told = say("where", results(None, anomalies=(weaker, anomaly), inputs=None))
    assert told.count("Position 3") == 1 and "stick-slip" not in told and "It also repeats worse" in told


def correlation(verdict: str) -> CorrelationPart:
    area = AreaPart(x_low_mm=280.0, x_high_mm=420.0, y_low_mm=40.0, y_high_mm=150.0)
    source = SourcePart.model_construct(x_mm=355.0, y_mm=95.0, p_value=0.002, area=area)
    return CorrelationPart.model_construct(verdict=verdict, source=source, p_resolution=0.002, randomised_duty=None)


@pytest.mark.parametrize(
    ("verdict", "part"),
    [
        ("attributable", "the area x 280 to 420 mm, y 40 to 150 mm (strongest at x 355 mm, y 95 mm) more closely than"),
        ("not attributable", "the closest is the area x 280 to 420 mm"),
        ("not separable", "These data cannot tell which place"),
    ],
)
def test_every_attribution_has_its_sentence(verdict, part):
    told = say("which_place", results(None, correlation=correlation(verdict)))
    assert part in told and "drives" not in told
    assert ("p ≤ 0.002, resolution of the Monte Carlo test" in told) == (verdict != "not separable")


@pytest.mark.parametrize(
    ("found", "verdict", "stated"),
    [
        (loop("explained", step("unseen_heat_source")), "attributable", "(the expansion of the axis), so this place"),
        (
            loop("explained", step("unseen_heat_source"), declared=("dead_path",)),
            "attributable",
            "after what was declared",
        ),
        (loop("explained", step("dead_path")), "attributable", ""),
        (loop("explained", step("unseen_heat_source")), "not attributable", ""),
    ],
)
def test_an_unseen_source_and_a_seen_place_are_reconciled(found, verdict, stated):
    told = say("reconcile", results(found, correlation=correlation(verdict)))
    assert stated in told and bool(stated) == bool(told)


LOCAL = TimePart(first="2026-03-09T06:30:02Z", last="2026-03-09T10:41:02Z", zone="Europe/Vienna")


def axis_step(effect: str, **changes: Any) -> AxisStep:
    told = {"event_cycle": None, "coefficients": (Coefficient(value=2.1, u=0.1, unit="um"),), **changes}
    return AxisStep.model_construct(**{**vars(step(effect)), **told})


SOURCE = axis_step(
    "unseen_heat_source",
    parameters={"follows": "duty", "time_constant_min": 12.94},
    parameter_ranges={"time_constant_min": (11.0, 15.2)},
)
JUMP = axis_step("step_event", event_cycle=38, event_time="2026-03-09T09:08:00Z")


def test_what_an_effect_follows_is_told_with_its_time_constant():
    assert say("step_phrase", SOURCE, None, False) == (
        "an unseen heat source (follows the logged duty, time constant 13 min [11 to 15])"
    )
    lagging = axis_step("thermal_lag", parameters={"time_constant_min": 30.0})
    assert say("step_phrase", lagging, None, False).endswith("(time constant 30 min)")
    assert say("step_phrase", axis_step("bed_bending"), None, False) == "bed bending"


def test_effects_that_are_not_separated_are_told_as_one_of_these():
    tied = axis_step("unseen_heat_source", tied=("thermal_lag",), parameters={"follows": "duty"})
    told = say("verdict", loop("explained", tied), None, False)
    assert "lacks one of these, which these data do not separate: an unseen heat source (follows" in told
    assert "or a part of the machine that follows the measured temperatures with a lag" in told
    asked = action(tied, None, record=False)
    assert effect_words("thermal_lag").remedy in asked and effect_words("unseen_heat_source").remedy in asked
    open_end = axis_step("thermal_lag", withheld="its time constant is not determined (130 min and more fits)")
    words = say("step_phrase", open_end, None, False)
    assert words.startswith("something that moves like a part") and words.endswith("130 min and more fits)")
    told = say("verdict", loop("unexplained", open_end), None, False)
    assert f"It holds {words}." in told
    assert action(open_end, None, record=False).startswith("Not confirmed, check this only where nothing else is found")


def test_an_event_is_told_with_its_size_and_its_local_time():
    assert say("when", JUMP, LOCAL) == "2026-03-09 10:08 CET, cycle 38"
    assert say("when", JUMP, None).startswith("2026-03-09 09:08 UTC")
    assert say("step_phrase", JUMP, LOCAL, False).endswith("(2.10 ± 0.20 µm, at 2026-03-09 10:08 CET, cycle 38)")
    late = RecordStep.model_construct(
        effect="step_event", parameters={}, parameter_ranges={}, event_s=7200.0, event_time=None
    )
    assert say("when", late, None) == "2.0 h after the start"
    slip = late.model_copy(
        update={
            "parameters": {"course": "even", "duration_min": 900.0}, "parameter_ranges": {"time_s": (3600.0, 10800.0)},
            "sizes_um": {"crack 2": Quantity(value=4.0, u=1.0), "crack 3": Quantity(value=-333.0, u=2.0)}, "confirmed": True,
            "tied": (), "borne_out": "yes",
        }
    )  # fmt: skip
    told = "a slip (−333.0 ± 4.0 µm in crack 3, 4.0 ± 2.0 µm in crack 2, at 2.0 h after the start (60 min to 3.0 h), within 15.0 h)"
    assert say("step_phrase", slip, None, True).replace("-", "−") == told
    assert told in say("verdict", loop("no_skill", slip), None, True).replace("-", "−")
    scale = axis_step("step_event", event_cycle=38, parameters={"shape": "linear"})
    assert say("step_phrase", scale, None, False).startswith("a sudden change in proportion to the position (2.10")
    assert "was a mirror realigned" in action(scale, None, record=False)


def test_an_action_names_the_time_or_the_load():
    assert action(JUMP, LOCAL, record=False).startswith("Look up 2026-03-09 10:08 CET, cycle 38 in the logs")
    assert 'the logged load "duty"' in action(SOURCE, None, record=False)
    assert "where no sensor sits" in action(SOURCE, None, record=True)
    assert action(axis_step("dead_path"), None, record=False) == effect_words("dead_path").remedy
    doubtful = action(axis_step("dead_path", confirmed=False), None, record=False)
    assert doubtful.startswith("Not confirmed") and ": shorten" in doubtful
    assert action(axis_step("bed_bending", confirmed=False), None, record=False) == ""


def test_the_model_comes_first_and_what_asks_for_nothing_is_left_out():
    evidence = Evidence.model_construct(check="Inspect the guide at this position.")
    found = results(
        loop("partial", step("dead_path"), shape="a wave of 37 min"),
        anomalies=(AnomalyPart.model_construct(target=3, position_mm=40.0, evidence=evidence),),
        warnings=(Notice("gaps", "Gaps are allowed for.", ""), Notice("camera", "Late.", "Start the camera earlier.")),
    )
    first, second, third, last = next_steps(found)
    assert first == effect_words("dead_path").remedy
    assert second == "Inspect the guide at position 3 (40 mm)."
    assert "(a wave of 37 min)" in third and last == "Start the camera earlier."
    (nothing,) = next_steps(results(loop("complete")))
    assert nothing.startswith("Nothing has to be done")


def test_what_to_do_about_a_cause_is_conditional_where_a_doubted_input_endangers_it():
    steps = next_steps(results(loop("explained", step("dead_path")), inputs=doubted("mirrored_readings")))
    (about,) = [one for one in steps if one.endswith(effect_words("dead_path").remedy[1:])]
    assert about.startswith("Only if ")


@pytest.mark.parametrize(
    ("code", "asked"), [("datum", True), ("camera_place", True), ("clocks", False), ("camera_clock", False)]
)
def test_more_is_to_be_logged_unless_a_clock_is_doubted(code, asked):
    steps = next_steps(results(loop("unexplained", shape="a wave"), inputs=doubted(code)))
    assert (say("log_more", "a wave") in steps) is asked


def test_no_cause_is_to_be_looked_for_where_none_is_separable():
    (nothing,) = next_steps(results(loop("unexplained", step("dead_path")).model_copy(update={"separable": False})))
    assert effect_words("dead_path").remedy not in nothing


def test_a_place_is_to_be_tested_by_itself_whatever_load_moves_the_axis():
    source = SourcePart.model_construct(x_mm=355.0, y_mm=95.0, area=None)
    seen = CorrelationPart.model_construct(verdict="attributable", source=source, randomised_duty=None)
    (step,) = next_steps(results(loop("complete"), correlation=seen))
    assert "alone in the next test: the place around x 355 mm, y 95 mm, switched at random" in step
    shown = seen.model_copy(update={"randomised_duty": (DutyPart.model_construct(name="spindle", cause=True),)})
    assert next_steps(results(loop("complete"), correlation=shown)) == [step]


@pytest.mark.parametrize(
    ("verdict", "places", "told"),
    [
        ("not separable", (), "Switch the heat sources at random times"),
        ("not attributable", (), "From 0.12 µm/K on, a source at the best place"),
        ("attributable", ((1.0, 2.0),), "Other places explain the drift equally well (x 1 mm, y 2 mm): switch"),
        ("attributable", (), "To tell this place from the load that warms it, heat or cool it alone"),
    ],
)
def test_the_next_test_is_recommended_with_its_noise_and_drift(verdict, places, told):
    source = SourcePart.model_construct(detectable_um_per_K=0.123, equivalent_places_mm=places)
    text = say("recommended_test", verdict, source, 0.2, 0.01)
    assert text.startswith(told) and text.endswith('--noise "0.2 um" --drift "0.01 um".')
