"""What a check takes, and what follows where it is not passed: refused, doubted, or accepted by the user."""

from __future__ import annotations

import pytest
import xarray as xr

from fusion.analysis.consistency import RULES
from fusion.analysis.consistency.checks import LASER, Found, Inputs, check, judge
from fusion.pipeline.consistency import (
    ContradictionError,
    doubt_notices,
    inputs_part,
    open_doubts,
    refuse_contradictions,
    run_checks,
)
from tests.fusion.analysis.consistency.test_deviations import sound as sound_readings
from tests.fusion.results_sample import told

SOUND, DOUBT = told("travel", passed=True), told("copied_cycles", passed=False)


def test_a_contradiction_is_refused_with_its_remedy_and_a_doubt_is_not() -> None:
    refuse_contradictions([SOUND, DOUBT])
    with pytest.raises(ContradictionError, match=r"^It is off\. Check it\.$"):
        refuse_contradictions([SOUND, DOUBT.model_copy(update={"contradicts": True})])


def test_a_doubt_is_open_until_the_campaign_file_accepts_it() -> None:
    assert open_doubts([SOUND, DOUBT], ()) == [DOUBT]
    assert inputs_part([SOUND, DOUBT], ()).state == "doubted"
    assert inputs_part([SOUND], ()).state == "sound"
    accepted = inputs_part([SOUND, DOUBT], ("copied_cycles",))
    assert (accepted.state, accepted.accepted) == ("sound", ("copied_cycles",))
    assert len(accepted.checks) == 2


def test_a_doubt_is_a_warning_that_names_what_it_endangers() -> None:
    (notice,) = doubt_notices([SOUND, DOUBT], ())
    assert (notice.code, notice.remedy) == ("doubt_copied_cycles", "Check it.")
    assert notice.message == "It is off. Endangered: figures."
    (known,) = doubt_notices([DOUBT], ("copied_cycles",))
    assert known.remedy == "" and known.message.endswith("Accepted in the campaign file.")


@pytest.mark.parametrize(("value", "passed"), [(0.5, True), (0.6, False), (float("nan"), False)])
def test_a_check_is_passed_up_to_its_limit_and_only_a_passed_one_is_unverified(value: float, passed: bool) -> None:
    assert judge(value, 0.5).passed is passed
    assert judge(value, 0.5, passed=not passed).passed is not passed
    assert judge(value, 0.5, verified=False).verified is not passed


def test_a_check_takes_what_there_is_by_name_and_an_unknown_name_is_an_error() -> None:
    @check("source", LASER)
    def kept(travel_mm: float, linear: xr.Dataset | None = None) -> Found:
        return judge(travel_mm, 1.0, alone=linear is None)

    assert kept.make(Inputs()) is None
    found = kept.make(Inputs(travel_mm=2.0))
    assert found is not None and not found.passed and found.facts == {"alone": True}
    with pytest.raises(TypeError, match="the check misspelt takes deviation: no such input"):

        @check("source", LASER)
        def misspelt(deviation: xr.Dataset) -> Found:
            return judge(0.0, 0.0)


@pytest.mark.parametrize(
    ("code", "held"),
    [("material_rise", {"positions"}), ("datum", {"field"}), ("drivers_clock", {"positions", "field", "attribution"})],
)
def test_what_the_other_instrument_shows_alone_is_not_conditional(code: str, held: set[str]) -> None:
    assert {"positions", "field", "attribution", "causes"} - set(RULES[code].figures) == held


def test_a_doubted_environment_touches_the_readings_that_it_has_compensated() -> None:
    times = sound_readings()["time"].values[:2, 0, 0]
    log = xr.Dataset({"air_temperature": ("time", [20.0, 20.1])}, coords={"time": times})
    for recompensated in (False, True):
        inputs = Inputs(
            environment=log, drivers=log, reading_time=sound_readings()["time"], recompensated=recompensated
        )
        touched = {check.code: "positions" in check.conditional for check in run_checks("source", inputs)}
        assert touched["environment_coverage"] is recompensated and not touched["drivers_coverage"]
