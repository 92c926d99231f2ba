"""Numbers and verdicts in words: digits follow the uncertainty, every verdict has its sentence, remedies come in order."""
# ruff: noqa: E501 - sentences are quoted whole

from __future__ import annotations

import numpy as np
import pytest

from fusion.consistency.checks import Check, inputs_part
from fusion.products.results import AnomalyPart, Loop, Notice, RecordLoop, Results, StepPart, Unexplained, Verdict
from fusion.products.results_axis import Evidence
from fusion.products.results_inputs import InputsPart
from fusion.report import wording


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
def test_a_value_has_the_digits_of_its_uncertainty(value: float | None, u: float | None, text: str) -> None:
    assert wording.measured(value, u, "µm") == text


def test_small_things_read_well() -> None:
    assert wording.p_value(0.0004) == "< 0.001" and wording.p_value(0.0123) == "0.012" and wording.p_value(None) == "–"
    assert wording.duration(90) == "90 s" and wording.duration(1800) == "30 min" and wording.duration(25200) == "7.0 h"
    assert wording.join(["a", "b", "c"]) == "a, b and c" and wording.join(["a"]) == "a" and wording.join([]) == ""
    assert wording.moment(np.datetime64("2026-03-09T06:30:05")) == "2026-03-09 06:30 UTC"


def loop(verdict: Verdict, *effects: str, shape: str = "") -> Loop:
    """The part of a loop that sentences are made of."""
    return Loop.model_construct(
        verdict=verdict,
        steps=tuple(StepPart.model_construct(effect=name, confirmed=True) for name in effects),
        unnamed={},
        rmse_persistence_um=2.5,
        unexplained=Unexplained.model_construct(shape=shape, rms_um=0.2),
        rmse_declared_um=1.94,
        rmse_final_um=0.66,
        noise_floor_um=0.42,
    )


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (loop("complete"), "The declared model explains the drift; nothing in these data shows that an effect is missing."),
        (loop("explained", "step_event"), "The declared model lacked an effect: sudden step or new zero. With it, nothing is left that these data can show."),
        (
            loop("explained", "step_event", "dead_path"),
            "The declared model lacked 2 effects: sudden step or new zero and dead path of the laser. With them, nothing is left that these data can show.",
        ),
        (
            loop("partial", "step_event", shape="a wave of 37 min"),
            "The declared model lacked an effect: sudden step or new zero. With it, something without a name is left (a wave of 37 min).",
        ),
        (loop("unexplained"), "Something is left that no effect of the library explains."),
        (
            loop("unexplained").model_copy(update={"unnamed": {"dead_path": 9e-35}}),
            "Something is left that no effect of the library explains (dead path of the laser is significant, p < 0.001, and was not admitted).",
        ),
        (
            loop("unexplained").model_copy(update={"steps": (StepPart.model_construct(effect="step_event", confirmed=False),)}),
            "Something is left that no effect of the library explains (sudden step or new zero is not confirmed).",
        ),
        (
            loop("no_skill", shape="a slow drift"),
            "The model predicts no better than repeating the last value or the mean: these data cannot tell whether an effect is missing (a slow drift).",
        ),
    ],
)  # fmt: skip
def test_every_verdict_has_its_sentence(found: Loop, sentence: str) -> None:
    assert wording.verdict_headline(found) == sentence


def test_next_steps_start_with_the_model_and_leave_out_what_asks_for_nothing() -> None:
    results = Results.model_construct(
        loop=loop("partial", "dead_path"),
        anomalies=(
            AnomalyPart.model_construct(target=3, evidence=Evidence.model_construct(check="Inspect the guide.")),
        ),
        warnings=(Notice("gaps", "Gaps are allowed for.", ""), Notice("camera", "Late.", "Start the camera earlier.")),
    )
    first, second, third, last = wording.next_steps(results)
    assert first == wording.effect_words("dead_path").remedy
    assert second.startswith("Log more of what happens at the machine")
    assert third == "Position 3: Inspect the guide." and last == "Start the camera earlier."
    quiet = Results.model_construct(loop=loop("complete"), anomalies=(), warnings=())
    assert wording.next_steps(quiet) == ["Nothing has to be done: use the profile and its uncertainty as they are."]


def test_an_effect_of_a_users_own_has_a_name_and_no_remedy() -> None:
    assert wording.effect_words("bed_bending") == ("bed bending", "")


def test_places_and_units_are_printed() -> None:
    assert wording.place(355.4, None) == "x 355 mm, y – mm"
    assert wording.print_unit("um/K") == "µm/K"


def test_errors_are_those_of_what_was_held_out() -> None:
    assert wording.verdict_numbers(loop("explained", "step_event")) == (
        "Error on held-out cycles: 1.9 µm with the declared model, 0.66 µm after, 2.5 µm for repeating the last value; the noise of single readings is 0.42 µm."
    )
    record = RecordLoop.model_construct(
        steps=(), rmse_declared_um=1.94, rmse_final_um=1.94, noise_floor_um=0.42, rmse_persistence_um=2.5
    )
    assert (
        wording.verdict_numbers(record)
        == "Error on the held-out part: 1.9 µm, 2.5 µm for repeating the last value; the noise of a block mean is 0.42 µm."
    )


def doubted(*codes: str) -> InputsPart:
    """The part on the inputs with some checks that are not passed."""
    checks = [Check(code, 1.0, 0.5, False, "It is off.", "Check it.", "figures") for code in codes]
    return InputsPart.model_validate(inputs_part(checks, ()))


def test_what_a_doubt_touches_is_conditional_and_nothing_else() -> None:
    inputs = doubted("material_rise")
    said = "The drift goes with the table."
    assert (
        wording.conditional(said, inputs, "causes") == "Only if the emissivity is right: the drift goes with the table."
    )
    assert wording.conditional(said, inputs, "positions") == said == wording.conditional(said, None, "causes")
    assert wording.condition(inputs, "field") == "(only if the emissivity is right)"
    assert wording.condition(inputs, "positions") == ""
    assert wording.untouched(inputs).startswith(
        "Not touched by that: what the laser shows alone (deviations, drift, ISO 230-2 values"
    )


def test_several_doubts_are_named_or_counted() -> None:
    two, three = doubted("material_rise", "datum"), doubted("material_rise", "datum", "camera_clock")
    both = "the emissivity is right and the datum of the laser stayed the same"
    assert wording.condition(two, "causes") == f"(only if {both})"
    assert wording.condition(two, "positions") == "(only if the datum of the laser stayed the same)"
    assert wording.condition(three, "causes") == "(only if 3 doubted inputs are right)"
    assert wording.untouched(two) == "" == wording.untouched(None)
