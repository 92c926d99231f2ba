"""A test by ISO 230-3 from a record and from a campaign: ranges, tilts, budget, refusals, and the sheet to sign."""

import re

import docx
import numpy as np
import pytest

from fusion.campaign.config import CampaignError, ThermalTestTable
from fusion.pipeline.iso230_3 import evaluate_record_test, read_thermal_tests
from fusion.report.campaign import describe_thermal_tests
from fusion.report.sheet import describe_thermal_sheet, write_thermal_tests
from fusion.results.store import file_sha256
from tests.fusion.record_tables import runs_table, table_of

SAMPLES = 6 * 60


def table():
    """Six hours, a sample per minute: a displacement that warms by 20 um, another one by 35 um, and a sensor by 8 K."""
    rng = np.random.default_rng(5)
    state = 1.0 - np.exp(-np.arange(SAMPLES) / 60.0)
    noise = 0.05 * rng.standard_normal((SAMPLES, 2))
    displacement = np.round(state[:, None] * [20.0, 35.0] + noise, 2)
    return table_of(displacement, 20.0 + 8.0 * state[:, None] + 0.01 * rng.standard_normal((SAMPLES, 1)))


def test_ranges_tilt_and_temperature_of_a_record():
    stated = ThermalTestTable.model_validate(
        {
            "kind": "spindle",
            "tilts": {"B": {"channels": ["ch1", "ch2"], "distance": "150 mm"}},
            "sensor_calibration": "0.2 %",
        }
    )
    (test,) = evaluate_record_test(table(), stated)
    assert (test.kind, test.run) == ("spindle", "")
    first, second, tilted = test.distortions
    (told,) = describe_thermal_tests([test])
    units = {row.cells[0]: row.cells[2].split()[1:] for row in told["budget"].rows if row.cells[2] != "\u2013"}
    assert units == {"ch1": ["µm"], "ch2": ["µm"], "B (ch1, ch2)": ["µm/m"]}
    assert (first.name, second.name, tilted.name) == ("ch1", "ch2", "B (ch1, ch2)")
    warm = 1.0 - np.exp(-1.0)
    for one, whole in ((first, 20.0), (second, 35.0), (tilted, 100.0)):
        # Noise widens the range of hundreds of values by some of its standard deviations.
        within = 10.0 * one.whole.u
        assert one.whole.value == pytest.approx(whole, abs=within)
        assert one.first_hour.value == pytest.approx(whole * warm, abs=within)
        # A tenth below the mean of the last hour, at which the state is still a little below 1; noise moves it by a minute or two.
        assert one.settling_min == pytest.approx(-60.0 * np.log(0.1 + np.exp(-5.0) - np.exp(-6.0)), abs=3.0)
    assert tilted.unit == "um/m"
    assert test.temperatures[0].whole.value == pytest.approx(8.0, abs=0.1)
    sources = {(one.name, one.source): one for one in test.contributions}
    # Two values with noise of 0.05 um; the digit of 0.01 um, rectangular; 0.2 % of 20 um.
    assert sources["ch1", "noise"].u == pytest.approx(0.05 * np.sqrt(2.0), rel=0.15)
    assert sources["ch1", "resolution"].u == pytest.approx(0.01 / np.sqrt(6.0))
    assert sources["ch1", "calibration"].u == pytest.approx(0.04, rel=0.02)
    assert sources["ch1", "mounting"].u is None
    assert "not contained" in sources["ch1", "mounting"].origin
    known = [one.u for (name, _), one in sources.items() if name == "ch1" and one.u is not None]
    assert first.whole.u == pytest.approx(np.sqrt(np.sum(np.square(known))))


def test_what_holds_the_sensors_widens_every_displacement():
    stated = ThermalTestTable.model_validate({"mounting_length": "200 mm"})
    (test,) = evaluate_record_test(table(), stated)
    (u,) = (one.u for one in test.contributions if (one.name, one.source) == ("ch1", "mounting"))
    # 11.7 ppm/K over 200 mm and 8 K, rectangular, at both ends of the range.
    assert u == pytest.approx(11.7e-3 * 200.0 * 8.0 / np.sqrt(6.0), rel=0.02)
    assert test.kind == "not stated"
    assert any(line.startswith("The kind of test is not stated") for line in test.remarks)


def test_every_run_of_a_record_is_a_test():
    tests = evaluate_record_test(runs_table(0.0, 40.0), ThermalTestTable())
    assert [one.run for one in tests] == ["r1.csv", "r2.csv"]
    assert tests[0].distortions[0].last_hour.value is None, "the run is shorter than an hour"


def test_a_clock_that_restarts_leaves_the_noise_of_readings_a_minute_apart():
    """Two readings of every time: the mean of a minute has the noise that it has without the restart."""
    once, twice = table(), table()
    time = once["time"].values
    twice = twice.assign_coords(time=np.repeat(time[: SAMPLES // 2], 2))
    noise = [
        next(one.u for one in evaluate_record_test(each, ThermalTestTable())[0].contributions if one.source == "noise")
        for each in (once, twice)
    ]
    assert noise[0] == noise[1]


def test_a_tilt_of_a_displacement_that_is_not_there_is_refused():
    stated = ThermalTestTable.model_validate({"tilts": {"A": {"channels": ["ch1", "Y2"], "distance": "100 mm"}}})
    with pytest.raises(CampaignError, match=r"names Y2; the displacements of the record are ch1, ch2"):
        evaluate_record_test(table(), stated)


def test_another_file_is_refused_with_what_to_name(tmp_path):
    with pytest.raises(CampaignError, match="name a campaign file or a results folder; thermofuse init writes"):
        read_thermal_tests(tmp_path / "record.csv")


def test_a_burst_of_readings_is_not_the_largest_drift_of_the_sheet(tmp_path):
    """A logger writes three readings that climb to 1.3 mm, beside a drift of 20 um."""
    shown = 20.0 * (1.0 - np.exp(-np.arange(SAMPLES) / 60.0)) + np.random.default_rng(3).normal(0.0, 0.1, SAMPLES)
    shown[200:203] += [450.0, 900.0, 1335.0]
    rows = [f"{60 * k},{20.0 + 0.01 * (k % 7):.3f},{value:.2f}" for k, value in enumerate(shown)]
    (tmp_path / "record.csv").write_text("\n".join(["time_s,bearing [degC],X [um]", *rows]) + "\n")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\ntitle = "Spindle"\n[record]\nfile = "record.csv"\ntime = "time_s"\ntime_unit = "s"\n'
        'temperatures = ["bearing*"]\ndisplacements = ["X*"]\n'
    )
    (test,) = read_thermal_tests(tmp_path / "campaign.toml").tests
    assert test.distortions[0].whole.value == pytest.approx(20.0, abs=1.0)
    assert test.remarks[0].startswith("X leaves its course by up to 1335 µm and comes back (3 readings)")


def test_the_sheet_says_whose_test_it_was_and_who_signs_on_the_page_and_in_word(tmp_path):
    minutes = np.arange(SAMPLES)
    rows = [f"{60 * k},{20.0 + 8.0 * (1.0 - np.exp(-k / 60.0)):.3f},{k / 10:.2f}" for k in minutes]
    (tmp_path / "record.csv").write_text("\n".join(["time_s,bearing [degC],X [um]", *rows]) + "\n")
    (tmp_path / "campaign.toml").write_text(
        """[campaign]
title = "Spindle"
[record]
file = "record.csv"
time = "time_s"
time_unit = "s"
temperatures = ["bearing*"]
displacements = ["X*"]
[report]
machine = "Mill 7"
operator = "A. Smith"
approved_by = "B. Jones"
"""
    )
    title, tests, files, _ = read_thermal_tests(tmp_path / "campaign.toml")
    assert files == {name: file_sha256(tmp_path / name) for name in ("campaign.toml", "record.csv")}
    sheet = describe_thermal_sheet(title, tests[0], files=files)
    assert dict(sheet.stated.identity) | {"Machine": "Mill 7", "Date of the test": "not stated"} == dict(
        sheet.stated.identity
    )
    assert sheet.stated.signatures == [("Measured by", "A. Smith"), ("Approved by", "B. Jones")]
    for form in ("html", "docx"):
        write_thermal_tests(tmp_path / f"sheet.{form}", title, tests, files=files)
    page = re.sub(r"<script.*?</script>", "", (tmp_path / "sheet.html").read_text(), flags=re.DOTALL)
    written = docx.Document(str(tmp_path / "sheet.docx"))
    cells = [cell.text for table in written.tables for row in table.rows for cell in row.cells]
    for text in ("Mill 7", *(cell for row in sheet.values.rows for cell in row.cells)):
        assert text in page and text in cells
    assert "Measured by: A. Smith" in page and "Measured by: A. Smith\n" in cells
    assert page.count("<caption>Largest less smallest value, with") == 1, "the table is on the sheet alone"
    for sha256 in files.values():
        assert sha256 in page and sha256 in written.paragraphs[-1].text
