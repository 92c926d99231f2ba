"""Tables of a campaign file on the positioning test as a test by ISO 230-2."""

from __future__ import annotations

from datetime import date

import pytest
from pydantic import ValidationError

from fusion.campaign.standard_test import AcceptanceTable, ReportTable, UncertaintyTable


def test_uncertainties_carry_their_unit() -> None:
    table = UncertaintyTable.model_validate(
        {"device": "0.5 um/m", "alignment": "300 ppb", "material_temperature": "200 mK"}
    )
    assert (table.device_ppm, table.alignment_ppm, table.material_temperature_K) == (0.5, pytest.approx(0.3), 0.2)
    with pytest.raises(ValidationError, match="needs its unit"):
        UncertaintyTable.model_validate({"device": 0.5})
    with pytest.raises(ValidationError, match="greater than or equal to 0"):
        UncertaintyTable.model_validate({"environmental_variation": "-1 um"})


def test_only_tolerances_that_are_stated_are_judged() -> None:
    assert AcceptanceTable().limits() == {}
    assert AcceptanceTable.model_validate({"A": "10 um", "R_unidirectional": "4000 nm"}).limits() == {
        "A": 10.0,
        "R_unidirectional": 4.0,
    }


def test_every_condition_may_be_left_out() -> None:
    assert ReportTable().model_fields_set == set()
    found = ReportTable.model_validate(
        {"screw_lead": "1 cm", "feed": "2 m/min", "instrument": [{"name": "laser", "calibrated": date(2026, 1, 5)}]}
    )
    assert (found.screw_lead_mm, found.feed_mm_per_min) == (10.0, 2000.0)
    assert found.instrument[0].calibrated == date(2026, 1, 5)
    with pytest.raises(ValidationError, match="Extra inputs"):
        ReportTable.model_validate({"machine_serial": "7"})
