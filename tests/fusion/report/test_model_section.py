"""The section on the model: steps, refused effects, coefficients, detection limits, evidence."""

from __future__ import annotations

from fusion.products.results import AxisLoop, Coefficient, assemble
from fusion.report import model_section
from tests.fusion.results_sample import PARTS

RESULTS = assemble("A", PARTS, [])
LOOP = RESULTS.loop
assert isinstance(LOOP, AxisLoop)


def test_steps_start_with_the_declared_model() -> None:
    declared, added = model_section.steps_table(LOOP).rows
    assert declared.cells == [
        "0",
        "declared: expansion of the axis",
        "\u2013",
        "0.60",
        "\u2013",
        "",
        "",
    ]
    assert added.marked
    told = "sudden step or new zero: 30 min after the start (at least 28 min), shape flat (or linear)"
    assert added.cells[1:3] == [told, "0.001"]
    assert added.cells[3:6] == ["0.60 -> 0.40", "0.70 -> 0.50", "yes"]
    assert added.cells[-1] == "dead path of the laser (log-likelihood lower by 4.0)"


def test_a_name_that_is_not_confirmed_is_told_with_both_errors() -> None:
    doubted = LOOP.steps[0].model_copy(
        update={"confirmed": False, "doubt": "the error is 0.4 µm without it and 0.5 µm with it"}
    )
    _, added = model_section.steps_table(LOOP.model_copy(update={"steps": (doubted,)})).rows
    assert added.cells[5] == "not confirmed: the error is 0.4 µm without it and 0.5 µm with it"


def test_errors_stand_beside_those_of_plain_predictions() -> None:
    rows = [row.cells for row in model_section.errors_table(LOOP).rows]
    assert rows[:3] == [
        ["declared model", "0.60", "0.50 to 0.70"],
        ["with the added effects", "0.40", "0.35 to 0.46"],
        ["last cycle simply repeated", "0.90", "0.80 to 1.00"],
    ]
    assert len(rows) == 7


def test_a_refused_effect_that_is_significant_has_its_p_value() -> None:
    refused = LOOP.model_copy(update={"blocked": {"thermal_lag": "noise"}, "unnamed": {"thermal_lag": 9e-35}})
    (reason,) = (text for name, text in model_section.refused_effects(refused) if name.startswith("not admitted"))
    assert reason == "p < 0.001; noise"


def test_the_model_is_told_in_numbers() -> None:
    rows = dict(model_section.describe_model(LOOP))
    assert rows["expansion of the axis"] == "11.60 \u00b1 0.40 ppm/K (expected beforehand 11.7 \u00b1 4.0 ppm/K)"
    assert rows["sudden step or new zero"] == "1.00 \u00b1 0.20 \u00b5m"
    assert rows["drift without explanation"].startswith(
        "random walk: 0.10 \u00b5m rms common to all positions, below 0.001 \u00b5m"
    )
    assert rows["not tried: dead path of the laser"] == "no air"
    assert "extra test on the held-out cycles" not in rows


def test_an_effect_that_cannot_be_detected_has_no_limit() -> None:
    (row,) = model_section.describe_identifiability(LOOP).rows
    assert list(row.cells[:5]) == [
        "dead path of the laser",
        "never",
        "\u2013",
        "10 %",
        "refractive index of the air",
    ]


def test_candidates_are_listed_by_round() -> None:
    (row,) = model_section.describe_candidates(LOOP).rows
    assert row.cells == ["1", "sudden step or new zero", "", "9.0", "8.0", "0.01", "4.0", "0.01"]


def test_evidence_is_told_with_all_its_numbers() -> None:
    assert RESULTS.anomalies is not None
    told = model_section.describe_evidence(RESULTS.anomalies[0].evidence)
    assert told["stands_out"] == "extra scatter of 0.30 \u00b5m"
    assert ("step held out / in log-likelihood", "0") in told["numbers"] and ("step cycle", "12") in told["numbers"]
    assert (told["support"], told["against"], told["check"]) == (("a",), ("b",), "c")


def test_values_and_names_are_words() -> None:
    assert model_section.spaced("jump_um_per_K") == "jump / (\u00b5m/K)"
    assert model_section.in_words([1.0, True, None, "warm_up"]) == "1.00, yes, \u2013 and warm up"
    assert Coefficient(value=1.0, u=0.1, unit="um").prior is None


def test_every_coefficient_has_a_name_of_its_own() -> None:
    (step,) = LOOP.steps
    coefficient = step.coefficients[0]

    def named(effect: str, shape: str, count: int) -> list[str]:
        changed = {"effect": effect, "parameters": {"shape": shape}, "coefficients": (coefficient,) * count}
        return model_section.coefficient_names(step.model_copy(update=changed))

    start = "what was left of the time before the start, shift"
    assert named("unseen_heat_source", "flat", 2) == ["shift at full load", start]
    four = named("unseen_heat_source", "flat and linear", 4)
    assert len(set(four)) == 4 and four[1] == "stretch at the far end at full load"
    assert named("thermal_lag", "flat and linear", 2) == ["shift", "stretch at the far end"]
    assert named("periodic_disturbance", "flat", 2) == ["sine part", "cosine part"]
    assert named("step_event", "flat", 1) == [""] and named("bed_bending", "", 2) == ["coefficient 1", "coefficient 2"]


def test_errors_of_all_steps_have_the_same_decimals() -> None:
    step = LOOP.steps[0].model_copy(update={"rmse_before_um": 1.938, "rmse_after_um": 0.4643})
    rows = model_section.steps_table(LOOP.model_copy(update={"rmse_declared_um": 1.938, "steps": (step,)})).rows
    assert [row.cells[3] for row in rows] == ["1.94", "1.94 -> 0.46"]


def test_a_gain_that_rounds_to_zero_has_no_sign() -> None:
    score = LOOP.search[0][0].model_copy(update={"gain": -0.04, "excess_gain": -0.06})
    (row,) = model_section.describe_candidates(LOOP.model_copy(update={"search": ((score,),)})).rows
    assert row.cells[3:5] == ["0.0", "\u22120.1"]
