"""ISO 230-2 in the pipeline: quoted and first window, budgets, the sheet with tolerances and conditions, and a test from a file alone."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import Campaign, CampaignError
from fusion.campaign.recompensation import StatedBudget
from fusion.common import FusionError
from fusion.pipeline.iso230 import complete_sheet, evaluate_standard, read_test
from fusion.report.wording import say
from fusion.results.axis import Iso230Part
from fusion.results.numbers import moment
from fusion.results.parts import decide
from fusion.results.results import ResultsError, assemble
from fusion.results.store import joined, plain, write_json
from interferometry.drift.estimate import estimate_drift
from interferometry.io.readings import read_deviations
from interferometry.iso230 import Iso230Budget, evaluate_iso230
from tests.fusion.campaign_parts import without, write_laser
from tests.interferometry.simulated_campaigns import simulate

pytestmark = pytest.mark.long

ASSUMED = StatedBudget(
    Iso230Budget(), dict.fromkeys(("device", "alignment", "material_temperature", "expansion_coefficient"), "assumed")
)


def test_the_window_that_is_quoted_is_the_last_one_with_the_first_beside_it():
    deviations, _ = simulate(np.random.default_rng(2), kind="warmup", cycles=40)
    drift = estimate_drift(deviations)
    windows, quoted, part = evaluate_standard(deviations, ASSUMED, drift=drift)
    assert part.first.window == "cycles 1 to 5" and part.first.cycles == (1, 2, 3, 4, 5)
    assert part.cycles == (36, 37, 38, 39, 40) and part.window_rule == "the last 5 whole cycles of the test"
    assert part.R_um.value < part.first.R_um.value
    assert part.range_um["R"].highest == float(windows["R"][:-1].max())
    assert float(quoted["A"]) == part.A_um.value
    for window in (part.first, part):
        for name in (*"AREMB", "mean_reversal"):
            squares = sum(getattr(entry, f"{name}_um") ** 2 for entry in window.contributions)
            total = window.mean_reversal_um if name == "mean_reversal" else getattr(window, f"{name}_um")
            assert np.sqrt(squares) == pytest.approx(total.u)
            assert window.u_without_sampling_um[name] < total.u
    origins = {entry.contributor: entry.origin for entry in part.contributions}
    assert origins["expansion_coefficient"] == "assumed; material at an assumed 10 K from 20 \u00b0C"


def test_without_times_no_environmental_variation_is_claimed():
    deviations, _ = simulate(np.random.default_rng(2), cycles=4)
    _, _, part = evaluate_standard(deviations, ASSUMED, drift=None)
    assert part.window_rule == "the only window of the test"
    entry = next(row for row in part.contributions if row.contributor == "environmental_variation")
    assert np.isnan(entry.u) and entry.origin == "not known, not contained"


STATED = {
    "campaign": {"title": "A", "axis": "X"},
    "interferometry": {"deviations": "laser.csv", "feed": "2 m/min"},
    "acceptance": {"A": "1000 um", "R": "1 nm", "E_unidirectional": "1000 um"},
    "report": {"machine": "Mill", "instrument": [{"name": "laser"}], "air_temperature_before": "21.5 degC"},
}


def sheet(campaign: Campaign | None, environment: xr.Dataset | None = None, *, moved_mm: float = 0.0) -> Iso230Part:
    deviations, _ = simulate(np.random.default_rng(3), cycles=12)
    deviations = deviations.assign_coords(position=deviations["position"] + moved_mm)
    windows, quoted, part = evaluate_standard(deviations, ASSUMED, drift=None)
    dataset = joined(deviations, iso=windows, quoted=quoted)
    return Iso230Part.model_validate(plain(complete_sheet(part, dataset, campaign=campaign, environment=environment)))


def test_what_is_stated_is_judged_and_shown():
    part = sheet(Campaign.model_validate({**STATED, "path": Path("campaign.toml")}))
    judged = {row.quantity: row.decision for row in part.tolerances}
    assert judged == {"A": "pass", "R": "fail", "E\u2191": "pass", "E\u2193": "pass"}
    conditions = {row.name: row.text for row in part.conditions}
    assert (
        conditions["Machine"] == "Mill"
        and conditions["Axis"] == "X"
        and conditions["Feed between the targets"] == "2000 mm/min"
    )
    assert conditions["Instrument 1"] == "laser, serial number not stated, calibration not stated"
    assert conditions["Air temperature before, after"] == "21.5 \u00b0C, not stated"
    assert conditions["Operator"] == "" and conditions["Dead path"] == ""
    assert conditions["Expansion coefficient"] == "11.7 ppm/K (assumed)"


def test_logged_temperatures_stand_where_none_is_stated():
    deviations, _ = simulate(np.random.default_rng(3), cycles=12)
    time = deviations["time"].values
    log = xr.Dataset(
        {"air_temperature": ("time", [20.0, 24.0]), "material_temperature": ("time", [21.0, np.nan])},
        coords={"time": [time.min(), time.max()]},
    )
    conditions = {row.name: row.text for row in sheet(None, log).conditions}
    assert conditions["Air temperature before, after"] == "20.0 \u00b0C, 24.0 \u00b0C (logged)"
    assert conditions["Material temperature before, after"] == "21.0 \u00b0C, 21.0 \u00b0C (logged)"


def test_a_bare_file_has_conditions_checked_and_nothing_judged():
    part = sheet(None)
    assert part.tolerances == () and len(part.checks) == 6 and len(part.other_standards) == 9
    assert all(row.text == "" for row in part.conditions if row.name not in ("Date of the test", "Measured travel"))


def test_positions_below_zero_have_the_sign_of_the_other_numbers():
    position = simulate(np.random.default_rng(3), cycles=12)[0]["position"].values - 500.0
    conditions = {row.name: row.text for row in sheet(None, moved_mm=-500.0).conditions}
    ends = f"{position.min():g} to {position.max():g} mm".replace("-", "\u2212")
    assert position.min() < 0 and conditions["Measured travel"] == f"{np.ptp(position):g} mm, {ends}"


def test_the_date_of_the_test_is_that_of_its_readings():
    stated = {**STATED, "campaign": {**STATED["campaign"], "time_zone": "Asia/Tokyo"}}
    time = simulate(np.random.default_rng(3), cycles=12)[0]["time"].values
    for campaign, zone in ((None, None), (Campaign.model_validate({**stated, "path": Path("a.toml")}), "Asia/Tokyo")):
        (date,) = (row.text for row in sheet(campaign).conditions if row.name == "Date of the test")
        assert date == f"{moment(time.min(), zone)} to {moment(time.max(), zone)}"
        assert date.endswith("UTC" if zone is None else "JST")


def test_a_file_of_readings(tmp_path):
    file = write_laser(tmp_path / "test", 6, 5).with_name("laser.csv")
    found = read_test(file, "2-6")
    assert found.part.cycles == (2, 3, 4, 5, 6) and found.part.window_rule == "as chosen"
    axis = evaluate_iso230(read_deviations(file), cycles=[2, 3, 4, 5, 6])
    for symbol in "AREMB":
        assert getattr(found.part, f"{symbol}_um").value == pytest.approx(float(axis[symbol]))
    assert {entry.origin for entry in found.part.contributions[:3]} == {"assumed"}


def test_a_campaign_of_the_laser_alone_brings_its_budget_and_tolerances(tmp_path):
    stated = '[interferometry.uncertainty]\ndevice = "2 ppm"\n[acceptance]\nA = "1 m"\n'
    found = read_test(without(write_laser(tmp_path / "test", 6, 5), added=stated), None)
    assert found.title == "Size"
    assert found.part.contributions[0].origin == "stated"
    assert [row.decision for row in found.part.tolerances] == ["pass"]


def test_results_without_readings_of_an_axis_say_what_is_lacking(tmp_path):
    write_json(tmp_path / "results.json", assemble("A", {}, []).as_json())
    with pytest.raises(CampaignError, match=r"a campaign with \[interferometry\]"):
        read_test(tmp_path, None)


def test_the_results_of_a_run_hold_their_own_window(results_folder):
    found = read_test(results_folder, None)
    assert float(found.dataset["quoted_A"]) == pytest.approx(found.part.A_um.value)
    with pytest.raises(CampaignError, match=r"write \[acceptance\] cycles into the campaign file"):
        read_test(results_folder, "1-5")
    with pytest.raises(ResultsError, match=r"there is no results\.json"):
        read_test(results_folder / "maps", None)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a", 'this is not a window of cycles; write for example "1-5"'),
        ("4-2", 'this window ends before it begins; write for example "2-4"'),
        ("5-7", r"cycles outside the test; laser\.csv has readings of cycles 1 to 6"),
        (f"1-{10**30}", "cycles outside the test"),
    ],
)
def test_a_window_that_is_none_is_refused_by_the_option_and_by_the_key(tmp_path, text, fault):
    path = without(write_laser(tmp_path / "test", 6, 5), added=f'[acceptance]\ncycles = "{text}"\n')
    with pytest.raises(FusionError, match=f'^--cycles "{text}": {fault}'):
        read_test(path.with_name("laser.csv"), text)
    with pytest.raises(FusionError, match=rf"{path.name}.*{fault}") as refused:
        read_test(path, None)
    assert "acceptance" in str(refused.value) and "cycles" in str(refused.value) and text in str(refused.value)


def test_one_cycle_may_be_looked_at_and_not_be_judged(tmp_path):
    path = without(write_laser(tmp_path / "test", 6, 5), added='[acceptance]\ncycles = "3"\n')
    assert read_test(path.with_name("laser.csv"), " 3 ").part.cycles == (3,)
    with pytest.raises(FusionError, match=r'acceptance\.cycles.*"3".*write the first and the last of several'):
        read_test(path, None)


def test_a_cycle_without_a_reading_is_in_no_window_that_is_chosen(tmp_path):
    path = without(write_laser(tmp_path / "test", 6, 5), added='[acceptance]\ncycles = "2-4"\n')
    laser = path.with_name("laser.csv")
    head, *rows = laser.read_text().splitlines()
    laser.write_text("\n".join([head, *(row for row in rows if not row.startswith("3,"))]) + "\n")
    with pytest.raises(
        FusionError, match=r'\[acceptance\] cycles = "2-4": laser\.csv has no reading of cycle 3; choose'
    ):
        read_test(path, None)


def test_the_cycles_of_the_campaign_file_are_judged_and_those_of_the_option_before_them(tmp_path):
    stated = '[acceptance]\nA = "1 m"\ncycles = "1-5"\n'
    path = without(write_laser(tmp_path / "test", 12, 5), added=stated)
    found = read_test(path, None).part
    assert found.cycles == (1, 2, 3, 4, 5) and found.window_rule == "as chosen"
    assert found.A_um == found.first.A_um
    assert read_test(path, "2-6").part.cycles == (2, 3, 4, 5, 6)


def test_windows_that_decide_otherwise_are_counted():
    """Cycles 1 to 5 scatter by 10 um, the others by 0.1 um: one of three windows fails R of 5 um."""
    deviations, _ = simulate(np.random.default_rng(3), kind="none", cycles=15)
    scatter = np.where(np.arange(15) < 5, 10.0, 0.1)[:, None, None]
    deviations["deviation"].values[:] = scatter * np.random.default_rng(4).standard_normal(
        deviations["deviation"].shape
    )
    windows, quoted, part = evaluate_standard(deviations, ASSUMED, drift=None)
    stated = {**STATED, "acceptance": {"R": "5 um", "A": "1 m", "R_unidirectional": "5 um"}}
    campaign = Campaign.model_validate({**stated, "path": Path("campaign.toml")})
    part = complete_sheet(part, joined(deviations, iso=windows, quoted=quoted), campaign=campaign, environment=None)
    assert (part.windows, part.windows_otherwise) == (3, 1)
    assert {row.quantity: (row.decision, row.windows_otherwise) for row in part.tolerances} == {
        "A": ("pass", 0), "R": ("pass", 1), "R\u2191": ("pass", 1), "R\u2193": ("pass", 1),
    }  # fmt: skip
    # Equal spacings.
    assert part.is_acceptance_test is False
    told = say("decision", part)
    assert (
        "µm. 1 of 3 windows differ." in told
        and say("judged", part.tolerances[1], part) == "pass, 1 of 3 windows otherwise"
    )


@pytest.mark.parametrize(
    ("value", "u", "decision"),
    [
        (8.0, 2.0, "pass"),
        (8.01, 2.0, "not decided within the uncertainty"),
        (12.0, 2.0, "not decided within the uncertainty"),
        (12.01, 2.0, "fail"),
        (10.0, 0.0, "pass"),
    ],
)
def test_the_uncertainty_counts_against_whoever_claims_the_result(value, u, decision):
    assert decide(value, u, 10.0) == decision
