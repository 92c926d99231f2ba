"""What follows from a check that is not passed: refused, doubted, or accepted by the user."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fusion.analysis.consistency.checks import (
    CODES,
    Check,
    ContradictionError,
    Severity,
    condition_of,
    doubt_notices,
    inputs_part,
    judge,
    open_doubts,
    refuse_contradictions,
)

SOUND = Check("travel", 0.4, 0.03, True, "The targets span 300 mm.", "", "lengths")
DOUBT = Check("copied_cycles", 1.0, 0.8, False, "Cycles 1 and 2 agree.", "Leave one out.", "scatter")


def test_a_contradiction_is_refused_with_its_remedy_and_a_doubt_is_not() -> None:
    refuse_contradictions([SOUND, DOUBT])
    with pytest.raises(ContradictionError, match=r"^Cycles 1 and 2 agree\. Leave one out\.$"):
        refuse_contradictions([SOUND, replace(DOUBT, severity=Severity.CONTRADICTION)])


def test_a_doubt_is_open_until_the_campaign_file_accepts_it() -> None:
    assert open_doubts([SOUND, DOUBT], ()) == [DOUBT]
    assert inputs_part([SOUND, DOUBT], ())["state"] == "doubted"
    assert inputs_part([SOUND], ())["state"] == "sound"
    accepted = inputs_part([SOUND, DOUBT], ("copied_cycles",))
    assert (accepted["state"], accepted["accepted"]) == ("sound", ["copied_cycles"])
    assert len(accepted["checks"]) == 2


def test_a_doubt_is_a_warning_that_names_what_it_endangers() -> None:
    (notice,) = doubt_notices([SOUND, DOUBT], ())
    assert (notice.code, notice.remedy) == ("doubt_copied_cycles", "Leave one out.")
    assert notice.message == "Cycles 1 and 2 agree. Endangered: scatter."
    (known,) = doubt_notices([DOUBT], ("copied_cycles",))
    assert known.remedy == "" and known.message.endswith("Accepted in the campaign file.")


@pytest.mark.parametrize(("value", "passed"), [(0.5, True), (0.6, False), (float("nan"), False)])
def test_remedy_and_evidence_of_a_fault_fall_away_where_a_check_passes(value: float, passed: bool) -> None:
    check = judge("camera_place", value, 0.5, "It moved.", "Fasten it.", sound="It stayed.")
    assert check.passed is passed
    assert (check.evidence, check.remedy) == (("It stayed.", "") if passed else ("It moved.", "Fasten it."))
    assert check.endangers.startswith("temperature fields")
    assert judge("travel", value, 0.5, "It is short.", passed=not passed).passed is not passed


@pytest.mark.parametrize("code", CODES)
def test_every_check_says_what_has_to_be_right_and_a_cause_needs_all_of_it(code: str) -> None:
    condition = condition_of(code)
    assert condition.assumption != condition_of("no such check").assumption
    assert "causes" in condition.figures


@pytest.mark.parametrize(
    ("code", "assumption", "held"),
    [
        ("material_rise", "the emissivity is right", {"positions"}),
        ("datum", "the datum of the laser stayed the same", {"field"}),
        ("drivers_clock", "the clock of the drivers' log is right", {"positions", "field", "attribution"}),
    ],
)
def test_what_the_other_instrument_shows_alone_is_not_conditional(code: str, assumption: str, held: set[str]) -> None:
    condition = condition_of(code)
    assert condition.assumption == assumption
    assert {"positions", "field", "attribution", "causes"} - set(condition.figures) == held


def test_a_doubted_environment_touches_the_readings_that_it_has_compensated() -> None:
    assert "positions" not in condition_of("environment_coverage").figures
    assert "positions" in condition_of("environment_coverage", recompensated=True).figures
    assert "positions" not in condition_of("drivers_coverage", recompensated=True).figures
