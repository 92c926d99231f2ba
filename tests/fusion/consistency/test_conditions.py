"""Every check says what has to be right, and leaves alone what the other instrument shows."""

from __future__ import annotations

import pytest

from fusion.consistency.checks import CODES
from fusion.consistency.conditions import condition_of


@pytest.mark.parametrize("code", CODES)
def test_every_check_says_what_has_to_be_right_and_a_cause_needs_all_of_it(code: str) -> None:
    condition = condition_of(code)
    assert condition.premise != condition_of("no such check").premise
    assert "causes" in condition.figures


@pytest.mark.parametrize(
    ("code", "premise", "held"),
    [
        ("material_rise", "the emissivity is right", {"positions"}),
        ("datum", "the datum of the laser stayed the same", {"field"}),
        ("drivers_clock", "the clock of the drivers' log is right", {"positions", "field", "attribution"}),
    ],
)
def test_what_the_other_instrument_shows_alone_is_not_conditional(code: str, premise: str, held: set[str]) -> None:
    condition = condition_of(code)
    assert condition.premise == premise
    assert {"positions", "field", "attribution", "causes"} - set(condition.figures) == held


def test_a_doubted_environment_touches_the_readings_that_it_has_compensated() -> None:
    assert "positions" not in condition_of("environment_coverage").figures
    assert "positions" in condition_of("environment_coverage", recompensated=True).figures
    assert "positions" not in condition_of("drivers_coverage", recompensated=True).figures


def test_an_unknown_check_makes_everything_conditional() -> None:
    assert set(condition_of("weather").figures) == {"positions", "field", "attribution", "causes"}
