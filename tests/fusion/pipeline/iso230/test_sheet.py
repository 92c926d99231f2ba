"""Tolerances, conditions and other standards of a test sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign
from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.pipeline.iso230.sheet import complete_sheet
from fusion.products.grouped import joined
from fusion.products.results_axis import Iso230Part
from fusion.products.store import plain
from fusion.report.wording import moment
from tests.fusion.pipeline.iso230.test_evaluation import ASSUMED
from tests.interferometry.simulated_campaigns import simulate

STATED = {
    "campaign": {"title": "A", "axis": "X"},
    "interferometry": {"deviations": "laser.csv", "feed": "2 m/min"},
    "acceptance": {"A": "1000 um", "R": "1 nm", "E_unidirectional": "1000 um"},
    "report": {"machine": "Mill", "instrument": [{"name": "laser"}], "air_temperature_before": "21.5 degC"},
}


def sheet(campaign: Campaign | None, environment: xr.Dataset | None = None) -> Iso230Part:
    deviations, _ = simulate(np.random.default_rng(3), cycles=12)
    _, settled, part = evaluate_standard(deviations, ASSUMED, drift=None, material_degC=None)
    dataset = joined(deviations, settled=settled)
    return Iso230Part.model_validate(plain(complete_sheet(part, dataset, campaign=campaign, environment=environment)))


def test_what_is_stated_is_judged_and_shown() -> None:
    part = sheet(Campaign.model_validate({**STATED, "path": Path("campaign.toml")}))
    judged = {row.quantity: row.decision for row in part.tolerances}
    assert judged == {"A": "pass", "R": "fail", "E\u2191": "pass", "E\u2193": "pass"}
    conditions = {row.name: row.text for row in part.conditions}
    assert conditions["Machine"] == "Mill" and conditions["Axis"] == "X" and conditions["Feed"] == "2000 mm/min"
    assert conditions["Instrument 1"] == "laser, serial number not stated, calibration not stated"
    assert conditions["Air temperature before, after"] == "21.5 \u00b0C, not stated"
    assert conditions["Operator"] == "" and conditions["Dead path"] == ""
    assert conditions["Expansion coefficient"] == "11.7 ppm/K (assumed)"


def test_logged_temperatures_stand_where_none_is_stated() -> None:
    deviations, _ = simulate(np.random.default_rng(3), cycles=12)
    time = deviations["time"].values
    log = xr.Dataset(
        {"air_temperature": ("time", [20.0, 24.0]), "material_temperature": ("time", [21.0, np.nan])},
        coords={"time": [time.min(), time.max()]},
    )
    conditions = {row.name: row.text for row in sheet(None, log).conditions}
    assert conditions["Air temperature before, after"] == "20.0 \u00b0C, 24.0 \u00b0C (logged)"
    assert conditions["Material temperature before, after"] == "21.0 \u00b0C, 21.0 \u00b0C (logged)"


def test_a_bare_file_has_conditions_checked_and_nothing_judged() -> None:
    part = sheet(None)
    assert part.tolerances == () and len(part.checks) == 6 and len(part.other_standards) == 9
    assert all(row.text == "" for row in part.conditions if row.name not in ("Date of the test", "Measured travel"))


def test_the_date_of_the_test_is_that_of_its_readings() -> None:
    stated = {**STATED, "campaign": {**STATED["campaign"], "time_zone": "Asia/Tokyo"}}
    time = simulate(np.random.default_rng(3), cycles=12)[0]["time"].values
    for campaign, zone in ((None, None), (Campaign.model_validate({**stated, "path": Path("a.toml")}), "Asia/Tokyo")):
        (date,) = (row.text for row in sheet(campaign).conditions if row.name == "Date of the test")
        assert date == f"{moment(time.min(), zone)} to {moment(time.max(), zone)}"
        assert date.endswith("UTC" if zone is None else "JST")
