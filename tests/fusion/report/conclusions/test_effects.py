"""Added effects in words: what they follow, when they happened, and what to check."""

from __future__ import annotations

from typing import Any

from fusion.products.results_loop import AxisStep, Coefficient, RecordStep
from fusion.products.results_part import TimePart
from fusion.report.conclusions.effects import action, phrase, step_phrase, time_constant, when
from fusion.report.wording import effect_words

LOCAL = TimePart(first="2026-03-09T06:30:02Z", last="2026-03-09T10:41:02Z", zone="Europe/Vienna")


def step(effect: str, **changes: Any) -> AxisStep:
    told = {
        "effect": effect, "parameters": {}, "parameter_ranges": {}, "confirmed": True, "event_cycle": None, "event_time": None,
        "coefficients": (Coefficient(value=2.1, u=0.1, unit="um"),),
    }  # fmt: skip
    return AxisStep.model_construct(**{**told, **changes})


SOURCE = step(
    "unseen_heat_source",
    parameters={"follows": "duty", "time_constant_min": 12.94},
    parameter_ranges={"time_constant_min": (11.0, 15.2)},
)
JUMP = step("step_event", event_cycle=38, event_time="2026-03-09T09:08:00Z")


def test_what_an_effect_follows_is_told_with_its_time_constant() -> None:
    assert step_phrase(SOURCE, None, record=False) == (
        "a heat source that the camera does not see (follows the logged duty, time constant 13 min [11 to 15])"
    )
    assert "no sensor sees" in step_phrase(SOURCE, None, record=True)
    assert time_constant(step("step_event")) == ""
    assert time_constant(step("thermal_lag", parameters={"time_constant_min": 30.0})) == "time constant 30 min"
    assert phrase("bed_bending", record=False) == "bed bending"


def test_an_event_is_told_with_its_size_and_its_local_time() -> None:
    assert when(JUMP, LOCAL) == "2026-03-09 10:08 CET, cycle 38" and when(JUMP, None).startswith("2026-03-09 09:08 UTC")
    assert step_phrase(JUMP, LOCAL, record=False) == (
        "a sudden step (2.10 ± 0.20 µm, at 2026-03-09 10:08 CET, cycle 38)"
    )
    late = RecordStep.model_construct(
        effect="step_event", parameters={}, parameter_ranges={}, event_s=7200.0, event_time=None
    )
    assert when(late, None) == "2.0 h after the start"


def test_an_action_names_the_time_or_the_load() -> None:
    assert action(JUMP, LOCAL, record=False).startswith("Look up 2026-03-09 10:08 CET, cycle 38 in the logs")
    assert 'the logged load "duty"' in action(SOURCE, None, record=False)
    assert "where no sensor sits" in action(SOURCE, None, record=True)
    assert action(step("dead_path"), None, record=False) == effect_words("dead_path").remedy
    doubtful = action(step("dead_path", confirmed=False), None, record=False)
    assert doubtful.startswith("Not confirmed, so only where nothing else is found: shorten")
    assert action(step("bed_bending", confirmed=False), None, record=False) == ""
