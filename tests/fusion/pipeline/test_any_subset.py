"""Runs of campaigns that have one instrument only, or few cycles: what the data carry is there, the rest is named and shown nowhere."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fusion.analysis.alignment.align import AlignmentError
from fusion.pipeline.check import check_campaign
from fusion.pipeline.iso230 import read_test
from fusion.pipeline.run import run_campaign
from fusion.report.exports.controls import ExportError
from fusion.report.exports.export import export_results
from fusion.report.findings import summary_rows
from fusion.report.fleet import Row, with_findings
from fusion.report.page import report_of
from fusion.report.sheet import describe_sheet, render_iso230
from fusion.results.folder import claim, read_manifest
from fusion.results.results import Results, read_results
from fusion.results.store import read_dataset, read_tree
from tests.fusion.campaign_parts import BOTH, change, keep_cycles, record_of_rows, without, write_laser

pytestmark = pytest.mark.chain

ROTARY = [("position_mm", "angle_deg"), ("deviation_um", "error_arcsec")]
CAMERA_CHECKS = ("camera", "fiducial", "plan", "frames", "frozen", "scene", "material", "axis_line")


def sections(folder: Path) -> set[str]:
    return set(re.findall(r'<section id="([a-z0-9]+)"', (folder / "report.html").read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def folder(campaign_folder, tmp_path_factory):
    """A copy of the small campaign for campaign files with some of its tables."""
    return shutil.copytree(campaign_folder, tmp_path_factory.mktemp("parts") / "campaign")


def test_the_laser_alone_gives_all_that_needs_no_field(laser_results, results_folder):
    results, both = read_results(laser_results), read_results(results_folder)
    assert (results.iso230, results.drift, results.neighbours) == (both.iso230, both.drift, both.neighbours)
    assert results.loop.declared == () and results.anomalies is not None
    assert "reversal_drift" in [step.effect for step in results.loop.steps]
    for part in ("registration", "camera", "radiometry", "alignment", "hotspots", "correlation"):
        assert getattr(results, part) is None, part
    products = {"deviations.nc", "fusion.nc", "manifest.json", "provenance.json", "report.html", "results.json"}
    assert {path.name for path in laser_results.glob("[!.]*")} == products
    # A check that needs the camera is not counted as passed.
    codes = [check.code for check in results.inputs.checks]
    assert codes and not [code for code in codes if code.startswith(CAMERA_CHECKS)]
    assert "the campaign holds no temperature of the table" in results.loop.not_tried["axis_expansion"]
    for name in ("unseen_heat_source", "laser_warm_up", "angular_growth", "material_compensation"):
        assert "its own expansion looks the same" in results.loop.not_tried[name]
    found = sections(laser_results)
    assert {"drift", "iso230", "anomalies", "loop"} <= found and not {"registration", "fields", "correlation"} & found
    assert "the camera does not" not in (laser_results / "report.html").read_text(encoding="utf-8")
    assert not {"registration", "drift and field"} & {name for name, _ in summary_rows(results)}


def test_the_products_of_the_laser_are_exported(laser_results, tmp_path):
    names = [path.name for path in export_results(laser_results, "csv", tmp_path).files]
    assert "drift.csv" in names and "fields.csv" not in names


def test_the_camera_alone_gives_fields_by_windows_of_time(camera_results, results_folder, tmp_path):
    results = read_results(camera_results)
    fields, both = read_dataset(camera_results / "fields.nc"), read_dataset(results_folder / "fields.nc")
    # 24 cycles of 3 min, of which two make a window; the same frames in the same places.
    assert fields.sizes["cycle"] == len(list((camera_results / "maps").glob("*.exr"))) == 12
    np.testing.assert_allclose(fields["frame_temperature"], both["frame_temperature"], atol=1e-4)
    assert results.hotspots and all(spot.targets == () and spot.p_value is None for spot in results.hotspots)
    (notice,) = [warning for warning in results.warnings if warning.code == "cycles_from_windows"]
    assert "12 windows of 6 min, as thermography.window states" in notice.message
    for part in ("iso230", "drift", "neighbours", "anomalies", "loop", "correlation", "alignment"):
        assert getattr(results, part) is None, part
    field, rows, found = results.field, dict(summary_rows(results)), sections(camera_results)
    assert field.fields == 12
    assert field.mean_rise_K.value == pytest.approx(float(fields["temperature_rise"].isel(cycle=-1).mean()), rel=1e-6)
    assert field.largest_rise_K.value == pytest.approx(float(fields["temperature_rise"].max()), rel=1e-6)
    assert rows["whole picture"].startswith("highest ") and "°C" in rows["whole picture"]
    assert {"registration", "fields"} <= found
    assert not {"drift", "paper", "iso230", "anomalies", "correlation", "loop"} & found
    page = (camera_results / "report.html").read_text(encoding="utf-8")
    assert "Highest temperature" in page
    for absent in ("laser's clock", "Positions whose drift is associated with it", "without a model"):
        assert absent not in page
    assert [path.name for path in export_results(camera_results, "csv", tmp_path).files] == ["fields.csv"]
    with pytest.raises(ExportError, match="this campaign has no laser"):
        export_results(camera_results, "linuxcnc", tmp_path)


def test_frames_without_fiducials_give_pictures_and_nothing_in_mm(picture_results):
    results, out = read_results(picture_results), picture_results
    assert results.thermograms.scene == "still" and results.regions
    for part in ("registration", "camera", "radiometry", "field", "hotspots"):
        assert getattr(results, part) is None, part
    assert not (out / "fields.nc").exists() and not (out / "maps").exists()
    assert "pictures" in sections(out) and not {"fields", "registration"} & sections(out)
    text = " ".join(text for _, text in summary_rows(results))
    page = (out / "report.html").read_text(encoding="utf-8")
    shown = re.sub(r"(?s)<style.*?</style>|<script>.*?</script>", "", page)
    assert "column " in text and not re.search(r"\d mm\b|/ mm\b", text + shown)


@pytest.mark.usefixtures("no_charts")
def test_five_cycles_give_all_but_causes_and_say_what_those_need(folder, tmp_path):
    keep_cycles(Path(shutil.copy(folder / "laser.csv", folder / "five.csv")), *range(1, 6))
    path, out = without(folder / "campaign.toml", name="five.toml"), tmp_path / "results"
    change(path, '"laser.csv"', '"five.csv"')
    results = run_campaign(path, out)
    assert results.iso230.window == "cycles 1 to 5"
    assert results.drift is not None and results.neighbours is not None and results.hotspots is not None
    assert results.loop is None and results.anomalies is None and results.correlation is None
    (notice,) = [warning for warning in results.warnings if warning.code == "too_small_for_model"]
    assert notice.message.startswith("5 cycles at 6 targets: ISO 230-2, profile, scatter and drift are evaluated")
    assert {"fields", "drift", "iso230"} <= sections(out)
    assert not {"anomalies", "correlation", "loop"} & sections(out)
    assert "mean_rise" in read_tree(out / "fusion.nc").to_dataset()


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize(
    ("cycles", "targets", "directions"),
    [(3, 2, BOTH), (5, 11, ("negative",)), (12, 3, ("positive",))],
)
def test_a_test_of_any_size_ends_with_what_it_can_carry(tmp_path, cycles, targets, directions):
    out = tmp_path / "results"
    results = run_campaign(write_laser(tmp_path / "campaign", cycles, targets, directions), out)
    assert results.drift is not None and results.neighbours is not None
    assert (results.iso230.A_um.value is not None) == (directions == BOTH)
    assert (results.loop is not None) == (results.anomalies is not None) == (cycles >= 12)
    codes = [warning.code for warning in results.warnings]
    assert ("one_approach" in codes) == (directions != BOTH)
    assert ("too_small_for_model" in codes) == (cycles < 12)
    assert "standard_alone" not in codes
    assert "readings_missing" not in codes
    assert "iso230" in sections(out) and ("loop" in sections(out)) == (cycles >= 12)


#: A tolerance of every quantity that may have one, wide but for R.
TOLERANCES = {"A": 99, "R": 0.01, "E": 99, "M": 99, "B": 99, **{f"{one}_unidirectional": 99 for one in "ARE"}}


def published(path: Path, out: Path) -> Results:
    """Run a campaign whose file states every tolerance; make its report again, its sheet, its tables and its row of a fleet."""
    stated = "".join(f'{name} = "{limit} um"\n' for name, limit in TOLERANCES.items())
    results = run_campaign(without(path, name="judged.toml", added=f"[acceptance]\n{stated}"), out)
    assert 'id="iso230"' in report_of(out)
    test = read_test(out, None)
    sheet = describe_sheet(test.title, test.part, files=test.files)
    assert render_iso230(sheet, test.part, test.dataset, remarks=test.remarks)
    for form in ("csv", "xlsx"):
        assert export_results(out, form, out.with_name(form)).files
    assert with_findings(Row("judged", "finished"), out).decision
    return results


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize(("cycles", "targets", "directions"), [(1, 5, BOTH), (3, 5, ("positive",))])
def test_what_a_test_does_not_measure_is_judged_as_not_measured(tmp_path, cycles, targets, directions):
    results = published(write_laser(tmp_path / "campaign", cycles, targets, directions), tmp_path / "results")
    judged = {row.quantity: row.decision for row in results.iso230.tolerances}
    both, several = directions == BOTH, cycles > 1
    decided = "pass" if several else "not decided within the uncertainty"
    assert judged["B"] == judged["M"] == judged["E"] == (decided if both else "not measured")
    assert judged["A"] == ("pass" if both and several else "not measured")
    for side, arrow in (("positive", "↑"), ("negative", "↓")):
        assert judged[f"E{arrow}"] == (decided if side in directions else "not measured")
        assert judged[f"A{arrow}"] == ("pass" if side in directions and several else "not measured")


@pytest.mark.usefixtures("no_charts")
def test_readings_without_scatter_end_with_the_values_of_the_standard_and_their_notice(tmp_path):
    """All positions move alike from cycle to cycle."""
    path = write_laser(tmp_path / "campaign", 8, 5, BOTH)
    table = pd.read_csv(path.with_name("laser.csv"))
    table.assign(deviation_um=10 * table["target"] + table["cycle"]).to_csv(path.with_name("laser.csv"), index=False)
    results = published(path, tmp_path / "results")
    assert [warning.code for warning in results.warnings].count("no_scatter") == 1
    assert results.drift is None
    assert "missed_trigger" not in [check.code for check in results.inputs.doubts]
    page = (tmp_path / "results" / "report.html").read_text(encoding="utf-8")
    assert "repeat exactly from cycle to cycle" in page and "times that of the differences" not in page


def of_laser(folder: Path) -> Path:
    """Readings that begin ten minutes after midnight of a clock without a zone."""
    path = write_laser(folder, 6, 2)
    text = path.with_name("laser.csv").read_text().replace("Z,", ",")
    stamps = sorted({line.split(",")[4] for line in text.splitlines()[1:]})
    late = np.datetime64("2026-03-10T00:10:00.000") - np.datetime64(stamps[0])
    for stamp in reversed(stamps):
        text = text.replace(stamp, str(np.datetime64(stamp) + late))
    path.with_name("laser.csv").write_text(text)
    return path


def of_record(folder: Path) -> Path:
    """A record of the same clock: a channel that follows a sensor, and white noise."""
    folder.mkdir()
    rng, rows = np.random.default_rng(2), []
    for k in range(480):
        time, warm = np.datetime64("2026-03-10T00:10:00") + np.timedelta64(60 * k, "s"), 5.0 * np.sin(k / 80.0)
        rows.append(f"{time},{20.0 + warm + rng.normal(0, 0.02):.3f},{3.0 * warm + rng.normal(0, 0.2):.3f}")
    path = record_of_rows(folder, *rows)
    change(folder / "record.csv", "time [s]", "time")
    return change(path, "time [s]", "time")


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize(("write", "zone"), [(of_laser, ""), (of_record, "Europe/Vienna")])
def test_every_page_gives_the_date_of_the_test_in_its_own_zone(tmp_path, write, zone):
    path, out = write(tmp_path / "test"), tmp_path / "results"
    if zone:
        change(path, "[campaign]\n", f'[campaign]\ntime_zone = "{zone}"\n')
    results = run_campaign(path, out)
    assert (results.time.zone, results.time.day) == (zone, "2026-03-10")
    begun = "2026-03-10 00:10 CET" if zone else "2026-03-10 00:10 (no zone)"
    sheets = [one.conditions for one in (results.iso230, *results.iso230_3) if one is not None]
    dates = [row.text for rows in sheets for row in rows if row.name == "Date of the test"]
    assert dates and all(date.startswith(begun) for date in dates)
    assert begun in report_of(out)
    assert with_findings(Row("test", "finished"), out).date == "2026-03-10"
    codes = [warning.code for warning in results.warnings]
    noted = "laser_no_zone" if results.iso230 else "record_no_zone"
    assert (noted in codes) == (not zone)
    assert noted in [notice.code for notice in check_campaign(path).notices] or zone


@pytest.mark.slow
@pytest.mark.parametrize(("cycles", "targets"), [(12, 400), (2000, 5)])
def test_a_very_large_test_ends(tmp_path, cycles, targets):
    results = run_campaign(write_laser(tmp_path / "campaign", cycles, targets, BOTH), tmp_path / "results")
    assert results.loop is not None
    assert len(results.drift.profile_um["positive"]) == targets


def write_sensors(campaign: Path, fields: Path, *, gain: float = 1.0) -> None:
    """Five sensors under the measured line, as the fields of the same test show their places."""
    frames = read_dataset(fields)["frame_temperature"].interpolate_na("x", fill_value="extrapolate")
    x = [480.0, 430.0, 380.0, 310.0, 250.0]
    at = frames.interp(x=("sensor", x), y=("sensor", [90.0] * 5)).values
    at = at[0] + gain * (at - at[0])
    stamps = [f"{np.datetime_as_string(time, unit='ms')}Z" for time in frames["time"].values]
    rows = [",".join([stamp, *(f"{value:.3f}" for value in row)]) for stamp, row in zip(stamps, at, strict=True)]
    heading = ",".join(["time", *(f"t{k + 1} [degC]" for k in range(5))])
    (campaign / "sensors.csv").write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    places = [f"t{k + 1},{value:g},90" for k, value in enumerate(x)]
    (campaign / "places.csv").write_text("\n".join(["name,x_mm,y_mm", *places]) + "\n", encoding="utf-8")


SENSORS = '\n[sensors]\nfile = "sensors.csv"\nplaces = "places.csv"\ntemperature_u = "0.05 K"\n'


@pytest.mark.usefixtures("no_charts")
def test_contact_sensors_stand_for_the_camera(folder, results_folder, tmp_path):
    write_sensors(folder, results_folder / "fields.nc")
    path = without(folder / "campaign.toml", "thermography", name="sensors.toml", added=SENSORS)
    results, both = run_campaign(path, tmp_path / "results"), read_results(results_folder)
    assert both.loop is not None
    assert results.loop.declared == ("axis_expansion", "table_offset")
    (here,), (there,) = (
        [one for one in loop.declared_coefficients if one.effect == "axis_expansion"]
        for loop in (results.loop, both.loop)
    )
    # The same rise, from five places instead of all cells: the coefficients agree within their uncertainties.
    assert abs(here.value - there.value) < 2.0 * np.hypot(here.u, there.u)
    assert "the campaign has no camera" in results.loop.not_tried["camera_offset"]
    assert [sensor.used for sensor in results.sensors] == [True] * 5
    assert results.sensors[0].camera_rise_K is None and results.sensors[0].rise_K is not None
    assert "sensors" in sections(tmp_path / "results")
    (notice,) = [warning for warning in results.warnings if warning.code == "sensors_for_the_camera"]
    assert "which enters the uncertainty of every coefficient per kelvin" in notice.message
    codes = {check.code: check.passed for check in results.inputs.checks}
    assert codes["sensors_coverage"] and "sensors_rise" not in codes


@pytest.mark.usefixtures("no_charts")
def test_contact_sensors_beside_the_camera_tell_a_wrong_rise(camera_results, results_folder, tmp_path):
    folder = shutil.copytree(camera_results.parent, tmp_path, dirs_exist_ok=True)
    write_sensors(folder / "campaign", results_folder / "fields.nc", gain=1.5)
    path = without(folder / "campaign" / "part.toml", name="part.toml", added=SENSORS)
    results = run_campaign(path, folder / "results", resume=True)
    assert results.sensors is not None
    for sensor in results.sensors:
        assert sensor.rise_K == pytest.approx(1.5 * sensor.camera_rise_K, rel=0.1), sensor.name
    assert read_dataset(tmp_path / "results" / "sensors.nc")["camera_rise"].notnull().any()
    assert {"sensors", "fields"} <= sections(tmp_path / "results")
    assert results.inputs.state == "doubted"
    (doubt,) = [check for check in results.inputs.doubts if check.code == "sensors_rise"]
    assert "the camera shows a rise of" in doubt.evidence


WIDE = (
    "Deviations in µm\nPosition [mm];1 +;1 -;2 +;2 -;3 +;3 -\n0;1.0;2.5;1.5;2.0;0.5;3.0\n100;2.0;4.0;2.5;3.5;3.0;4.5\n"
)


@pytest.fixture(scope="module")
def untimed(tmp_path_factory):
    """The products of a table of position by run, which holds no times."""
    folder = tmp_path_factory.mktemp("untimed")
    (folder / "laser.csv").write_text(WIDE, encoding="utf-8")
    (folder / "campaign.toml").write_text(
        '[campaign]\ntitle = "wide"\naxis = "X"\n[interferometry]\ndeviations = "laser.csv"\n', encoding="utf-8"
    )
    assert check_campaign(folder / "campaign.toml").as_json()["ready"]
    run_campaign(folder / "campaign.toml", folder / "results")
    return folder / "results"


def test_readings_without_times_are_evaluated_by_the_standard(untimed):
    results = read_results(untimed)
    assert results.drift is None and results.loop is None and results.time is None
    # Means of the approaches: 1.0, 2.5 and 2.5, 4.0 µm.
    assert results.iso230.B_um.value == pytest.approx(1.5)
    assert results.iso230.E_um.value == pytest.approx(3.0)
    assert [warning.code for warning in results.warnings] == ["no_times"]
    assert "iso230" in sections(untimed)
    # What only times can tell is not counted as passed.
    assert "travel_order" not in [check.code for check in results.inputs.checks]
    assert not {"drift", "anomalies", "loop"} & sections(untimed)


@pytest.mark.usefixtures("no_charts")
def test_products_of_an_instrument_that_is_gone_do_not_stay(untimed, tmp_path):
    shutil.copytree(untimed.parent, tmp_path, dirs_exist_ok=True)
    folder, campaign = tmp_path / "results", change(tmp_path / "campaign.toml", '"wide"', '"the laser alone"')
    (folder / "maps").mkdir()
    claim(folder, "fields.nc", "maps/cycle_0001.exr")
    for name in ("fields.nc", "maps/cycle_0001.exr", "notes.txt"):
        (folder / name).write_text("of an earlier run, or of a person")
    run_campaign(campaign, folder, resume=True)
    assert not (folder / "fields.nc").exists() and not (folder / "maps").exists()
    assert (folder / "notes.txt").exists() and (folder / "deviations.nc").exists()
    assert "fields.nc" not in read_manifest(folder)


def test_readings_without_times_are_exported_without_drift(untimed, tmp_path):
    names = [path.name for path in export_results(untimed, "csv", tmp_path).files]
    assert names == ["readings.csv", "iso230.csv", "iso230_positions.csv"]
    assert export_results(untimed, "xlsx", tmp_path).files
    with pytest.raises(
        ExportError, match="the readings have no times, or are too few, so there is neither drift nor profile"
    ):
        export_results(untimed, "linuxcnc", tmp_path, force=True)


def test_readings_without_times_beside_a_camera_are_refused(folder):
    (folder / "wide.csv").write_text(WIDE, encoding="utf-8")
    path = change(without(folder / "campaign.toml", name="untimed.toml"), '"laser.csv"', '"wide.csv"')
    with pytest.raises(AlignmentError, match=r"wide.csv: no reading has a time.*leave \[thermography\] out"):
        run_campaign(path, folder / "never")
    assert not (folder / "never").exists()


@pytest.mark.parametrize(("cycles", "renamed"), [(1, []), (5, ROTARY)])
def test_a_test_without_a_course_has_the_values_of_the_command_and_no_drift(tmp_path, cycles, renamed):
    path = write_laser(tmp_path / "test", cycles, 9)
    for name, other in renamed:
        change(path.with_name("laser.csv"), name, other)
    results = run_campaign(path, tmp_path / "results")
    alone = read_test(path.with_name("laser.csv"), None)
    left_out = {"conditions", "contributions", "first"}
    assert results.iso230.model_dump(exclude=left_out) == alone.part.model_dump(exclude=left_out)
    assert results.iso230.unit == ("arcsec" if renamed else "um")
    assert results.drift is results.neighbours is results.loop is results.anomalies is None
    assert results.warnings[0].code == "standard_alone"
    assert sections(tmp_path / "results") == {
        "next",
        "iso230",
        "data",
        "appendix",
        "uncertainty",
        "glossary",
        "provenance",
    }
    text = re.sub("<script.*?</script>", "", (tmp_path / "results/report.html").read_text(encoding="utf-8"), flags=re.S)
    assert ("µm" in text) is not bool(renamed)
    told = dict(summary_rows(results))["how much"]
    assert ("E = " in told and "±" not in told) if cycles == 1 else ("A = " in told and "(k = 2)" in told)
