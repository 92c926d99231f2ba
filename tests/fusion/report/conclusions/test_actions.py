"""What to do next: in order, each with its place, and nothing where nothing has to be done."""

from __future__ import annotations

from fusion.products.results import AnomalyPart, Loop, Notice, Results, StepPart, Unexplained
from fusion.products.results_attribution import CorrelationPart, DutyPart, SourcePart
from fusion.products.results_axis import Evidence
from fusion.report.conclusions.actions import next_steps
from fusion.report.wording import effect_words


def loop(verdict: str, *effects: str) -> Loop:
    steps = tuple(
        StepPart.model_construct(effect=name, confirmed=True, parameters={}, parameter_ranges={}, event_time=None)
        for name in effects
    )
    left = Unexplained.model_construct(shape="a wave of 37 min" if verdict == "partial" else "", rms_um=0.2)
    return Loop.model_construct(verdict=verdict, steps=steps, unexplained=left)


def results(**parts: object) -> Results:
    quiet = {
        "loop": loop("complete"),
        "anomalies": (),
        "warnings": (),
        "inputs": None,
        "correlation": None,
        "time": None,
    }
    return Results.model_construct(**{**quiet, **parts})


def test_the_model_comes_first_and_what_asks_for_nothing_is_left_out() -> None:
    found = results(
        loop=loop("partial", "dead_path"),
        anomalies=(
            AnomalyPart.model_construct(
                target=3, position_mm=40.0, evidence=Evidence.model_construct(check="Inspect the guide.")
            ),
        ),
        warnings=(Notice("gaps", "Gaps are allowed for.", ""), Notice("camera", "Late.", "Start the camera earlier.")),
    )
    first, second, third, last = next_steps(found)
    assert first == effect_words("dead_path").remedy
    assert second.endswith("what is left (a wave of 37 min) has no name.")
    assert third == "Position 3 (40 mm): Inspect the guide." and last == "Start the camera earlier."
    assert next_steps(results()) == ["Nothing has to be done: use the profile and its uncertainty as they are."]


def test_a_place_is_to_be_tested_unless_a_load_is_shown_to_be_the_cause() -> None:
    source = SourcePart.model_construct(x_mm=355.0, y_mm=95.0, area=None)
    seen = CorrelationPart.model_construct(verdict="attributable", source=source, randomised_duty=None)
    (step,) = next_steps(results(correlation=seen))
    assert step.startswith("To find out whether the place around x 355 mm, y 95 mm is a cause: repeat the test")
    shown = seen.model_copy(update={"randomised_duty": (DutyPart.model_construct(name="spindle", cause=True),)})
    assert "Nothing has to be done" in next_steps(results(correlation=shown))[0]
