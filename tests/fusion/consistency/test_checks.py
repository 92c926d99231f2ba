"""What follows from a check that is not passed: refused, doubted, or accepted by the user."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fusion.consistency.checks import (
    CODES,
    Check,
    ContradictionError,
    Severity,
    doubt_notices,
    inputs_part,
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


def test_codes_are_unique() -> None:
    assert len(set(CODES)) == len(CODES)
