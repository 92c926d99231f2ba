"""Exports of a folder: guarded, never overwriting in silence, with a header that the dialect can hold."""

import errno
import hashlib
import resource
import shutil
from datetime import UTC, datetime
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest
import xarray as xr

from fusion import cli
from fusion.report.exports import tables
from fusion.report.exports.controls import ExportError, header_lines, read_origin, read_thermal_state
from fusion.report.exports.export import FORMATS, export_results, objections, remarks
from fusion.report.exports.tables import profile_table, readings_table, write_workbook
from fusion.results.parts import TablePredictionError, read_table_prediction
from fusion.results.results import Results, ResultsError, assemble, read_results
from fusion.results.store import read_dataset, read_grouped, write_dataset, write_json
from tests.fusion.report.exports.small_run import measured, write_fields, write_run
from tests.fusion.results_sample import PARTS, RECORD_LOOP
from thermography.common import write_csv

pytestmark = pytest.mark.long


def test_the_command_offers_every_format():
    assert set(cli._FORMATS.split(", ")) == set(FORMATS)


def test_csv_writes_tables_and_leaves_the_large_one_out(small_run, tmp_path):
    written = export_results(small_run, "csv", tmp_path / "a")
    assert [path.name for path in written.files] == ["drift.csv", "profile.csv", "iso230.csv", "iso230_positions.csv"]
    with pytest.raises(ExportError, match=r"there is no fields.nc in it, so that no fields.csv can be written"):
        export_results(small_run, "csv", tmp_path / "b", fields=True)
    thermal = shutil.copytree(small_run, tmp_path / "thermal")
    write_fields(thermal)
    whole = export_results(thermal, "csv", tmp_path / "c")
    assert "fields.csv" not in [path.name for path in whole.files] and "--fields" in whole.remarks[0]
    with_fields = export_results(thermal, "csv", tmp_path / "d", fields=True)
    assert with_fields.files[-1].name == "fields.csv" and with_fields.remarks == ()


def test_csv_holds_every_number_as_it_was_computed(small_run, tmp_path):
    written = export_results(small_run, "csv", tmp_path).files
    deviations = read_grouped(small_run / "deviations.nc")
    # A position beyond a metre, a displacement that counts from far away, and what is far below one.
    moved = deviations.assign_coords(position=deviations["position"] + 1234.5678)
    moved = moved.assign(deviation=moved["deviation"] + 1_234_567.0, estimate_drift=moved["estimate_drift"] * 1e-9)
    for folder, dataset in ((written[0].parent, deviations), (tmp_path / "far", moved)):
        folder.mkdir(exist_ok=True)
        for name, made in (("drift", readings_table(dataset)), ("profile", profile_table(dataset))):
            write_csv(made, folder / f"{name}.csv")
            back = pd.read_csv(folder / f"{name}.csv", dtype=str)
            for column in made.select_dtypes(float):
                assert back[column].map(float).tolist() == made[column].tolist()


@pytest.mark.parametrize(
    ("format", "names"),
    [
        ("xlsx", ["results.xlsx"]),
        ("linuxcnc", ["compensation_X.comp.README.txt", "compensation_X.comp", "compensation_X.comp.prediction.json"]),
        ("siemens840d", ["compensation_X.MPF", "compensation_X.MPF.prediction.json"]),
        ("siemens840d-temperature", ["temperature_X.MPF"]),
        ("heidenhain", ["AXIS_X.COM.README.txt", "AXIS_X.COM", "AXIS_X.COM.prediction.json"]),
    ],
)
def test_nothing_is_overwritten_in_silence(small_run, tmp_path, format, names):
    options = {"spacing_mm": 20.0} if format == "siemens840d" else {}
    written = export_results(small_run, format, tmp_path, **options)
    assert sorted(path.name for path in written.files) == sorted(names)
    if format != "xlsx":
        header = (tmp_path / names[0]).read_text(encoding="ascii")
        assert "thermal state: mean of cycles 1 to 12: material 22.04 degC" in header and "machine: Mill 5" in header
    before = {path: path.read_bytes() for path in written.files}
    with pytest.raises(ExportError, match=r"exists already; add --overwrite"):
        export_results(small_run, format, tmp_path, **options)
    with pytest.raises(ExportError, match=r"is a file; name a folder with --out"):
        export_results(small_run, format, written.files[0], **options)
    assert before == {path: path.read_bytes() for path in written.files}
    export_results(small_run, format, tmp_path, overwrite=True, **options)


def test_unequal_targets_need_a_spacing(small_run, tmp_path):
    with pytest.raises(ExportError, match=r"needs equally spaced points; these are 22 to 29 mm apart, as ISO 230-2"):
        export_results(small_run, "siemens840d", tmp_path)
    assert not list(tmp_path.iterdir())
    table = export_results(small_run, "siemens840d", tmp_path, spacing_mm=20.0, axis="X1").files[0]
    text = table.read_text(encoding="ascii")
    # 20 mm do not divide 175 mm: nine equal parts.
    assert "[0,X1]=19.444444" in text and "resampled every 19.4444 mm" in text and "; axis: X1" in text
    with pytest.raises(ExportError, match="701 points; LinuxCNC, COMP_FILE_TYPE 0 reads at most 256, choose a wider"):
        export_results(small_run, "linuxcnc", tmp_path / "fine", spacing_mm=0.25)


@pytest.fixture(scope="module")
def unexplained(tmp_path_factory):
    loop = {**PARTS["loop"], "verdict": "unexplained"}
    even = measured(np.linspace(0.0, 140.0, 8))
    return write_run(tmp_path_factory.mktemp("unexplained"), even, axis="X axis; M30", loop=loop)


@pytest.mark.parametrize("format", ["linuxcnc", "siemens840d", "siemens840d-temperature", "heidenhain"])
def test_the_guard_refuses_and_a_forced_table_says_why(unexplained, tmp_path, format):
    with pytest.raises(ExportError, match=r"no compensation is written: the verdict is unexplained: .* add"):
        export_results(unexplained, format, tmp_path, axis="X")
    assert not list(tmp_path.iterdir())
    forced = export_results(unexplained, format, tmp_path, axis="X", force=True)
    assert forced.remarks[0].startswith("forced, although the verdict is unexplained")
    (header,) = (
        text for path in forced.files if "compensation that was active" in (text := path.read_text(encoding="ascii"))
    )
    assert "FORCED, although the verdict is unexplained" in header


def test_the_axis_is_a_name(unexplained, tmp_path):
    """The campaign's axis comes from a file: what is no name is never written into a table."""
    with pytest.raises(ExportError, match=r'"X axis; M30" is no name of an axis; write a letter'):
        export_results(unexplained, "heidenhain", tmp_path, force=True)
    with pytest.raises(ExportError, match="is no name of an axis"):
        export_results(unexplained, "linuxcnc", tmp_path, force=True, axis="X\nM30")
    files = export_results(unexplained, "linuxcnc", tmp_path, force=True).files
    assert files[0].name == "compensation.comp" and "axis: not stated" in files[-1].read_text()


def test_what_a_table_is_predicted_to_leave_is_stored_beside_it(small_run, tmp_path):
    """The table leaves the drift with the material, which stretches the axis by up to 3 um."""
    table = export_results(small_run, "linuxcnc", tmp_path).files[0]
    prediction = read_table_prediction(table)
    assert prediction == read_table_prediction(tmp_path / f"{table.name}.prediction.json")
    assert prediction.table == table.name
    assert prediction.results_sha256 == hashlib.sha256((small_run / "results.json").read_bytes()).hexdigest()
    values = {symbol: found.value for symbol, found in prediction.predicted_um.items()}
    assert set(values) == set("AEMB")
    assert 0.3 < values["E"] < 3.0 and values["M"] < values["E"] and values["B"] < 0.2
    assert values["A"] > values["E"] + 4 * 0.05
    assert 0.2 < prediction.predicted_um["E"].u < 2.0


def test_what_was_measured_is_added_to_the_table_that_was_active(small_run, tmp_path):
    """The table of the test, loaded before another one with the same readings: the second is twice the first, and adds once."""
    first = export_results(small_run, "linuxcnc", tmp_path / "a").files[0]
    second = export_results(small_run, "linuxcnc", tmp_path / "b", active=str(first)).files[0]
    one, two = (np.loadtxt(path) for path in (first, second))
    np.testing.assert_allclose(two[:, 1:] - two[:, :1], 2.0 * (one[:, 1:] - one[:, :1]), atol=2e-6)
    readme = second.with_name(f"{second.name}.README.txt").read_text()
    assert "predicted of a test of 5 cycles with this table, in a thermal state of this test, k = 2: A " in readme
    assert "sum of compensation_X.comp, which was active" in readme and "No table was active" not in readme
    assert "No table was active during the test" in first.with_name(f"{first.name}.README.txt").read_text()
    added, alone = (read_table_prediction(path) for path in (second, first))
    np.testing.assert_allclose(added.correction_um.positive, alone.correction_um.positive, atol=2e-3)
    assert added.predicted_um["E"].value == pytest.approx(alone.predicted_um["E"].value, abs=5e-3)
    with pytest.raises(ExportError, match=r"--active: there is no file other.comp"):
        export_results(small_run, "linuxcnc", tmp_path / "c", active="other.comp")


def test_a_table_is_refused_where_one_may_have_been_active(small_run, tmp_path):
    run = shutil.copytree(small_run, tmp_path / "run")
    (run / "provenance.json").write_text('{"parameters": {"campaign": {"axis": "X"}, "report": {}}}')
    with pytest.raises(ExportError, match=r"not known whether a table was active during the test .* add --active none"):
        export_results(run, "linuxcnc", tmp_path / "a")
    forced = export_results(run, "linuxcnc", tmp_path / "a", force=True)
    assert "load this one alone only if none was" in forced.files[-1].read_text() + forced.files[1].read_text()
    assert len(export_results(run, "linuxcnc", tmp_path / "b", active="none").files) == 3


def test_a_prediction_that_is_missing_or_damaged_says_what_to_do(tmp_path):
    with pytest.raises(TablePredictionError, match=r"x.comp.prediction.json is missing; name the table"):
        read_table_prediction(tmp_path / "x.comp")
    (tmp_path / "x.comp.prediction.json").write_text("[1]")
    with pytest.raises(TablePredictionError, match=r"no prediction of a table .* export the table again"):
        read_table_prediction(tmp_path / "x.comp")


def test_a_model_of_a_test_at_one_speed_is_refused(tmp_path):
    write_record(tmp_path)
    record = read_dataset(tmp_path / "fusion.nc").isel(driver_name=[]).drop_encoding()
    write_dataset(tmp_path / "fusion.nc", record.assign_attrs(constant_drivers="spindle (6000 rpm)"))
    with pytest.raises(ExportError, match=r"what never changed in the test: spindle \(6000 rpm\)"):
        export_results(tmp_path, "model-json", tmp_path / "out")


def test_a_run_of_the_camera_alone_has_its_fields(tmp_path):
    write_fields(tmp_path)
    write_json(tmp_path / "results.json", assemble("C", {}, []).as_json())
    assert [path.name for path in export_results(tmp_path, "csv", tmp_path / "out").files] == ["fields.csv"]
    [book] = export_results(tmp_path, "xlsx", tmp_path / "out").files
    sheet = openpyxl.load_workbook(book)["Fields"]
    assert [cell.value for cell in sheet[1]][:3] == ["window", "time (UTC)", "maximum / °C"] and sheet.max_row == 3
    for format in ("linuxcnc", "model-json"):
        with pytest.raises(ExportError, match=r"this campaign has no laser, so there is neither drift nor profile to"):
            export_results(tmp_path, format, tmp_path / "out")


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(ResultsError, match=r"there is no results.json in it; name the results folder of a finished"):
        export_results(tmp_path, "csv", tmp_path)
    with pytest.raises(ExportError, match=r'there is no format "mazak"; write one of csv, xlsx, png'):
        export_results(tmp_path, "mazak", tmp_path)


def write_record(folder):
    """Write the results of a record of two displacements, three sensors and a driver, in 40 blocks of an hour."""
    rng, count = np.random.default_rng(3), 40
    time = np.datetime64("2026-01-05T06:00", "ns") + np.arange(count) * np.timedelta64(1, "h")
    moved = np.cumsum(rng.standard_normal((count, 2)), axis=0)
    dims = ("time", "channel")
    record = xr.Dataset(
        {
            "displacement": (dims, moved),
            "predicted_final": (dims, moved + 0.1),
            "predicted_u": ("channel", [0.1, 0.2]),
            "contribution": (("effect", *dims), moved[None]),
            "temperature": (("time", "sensor"), np.full((count, 3), 20.0)),
            "driver": (("time", "driver_name"), np.linspace(0.0, 1.0, count)[:, None]),
            "driver_size": ("driver_name", [5000.0]),
            "driver_units": ("driver_name", np.array(["rpm"], object)),
            "sealed": ("time", np.arange(count) >= 30),
        },
        coords={
            "time": time, "channel": ["X", "Z"], "sensor": ["t1", "t2", "t3"], "driver_name": ["spindle"], "effect": ["quasi_static"],
        },
    )  # fmt: skip
    write_dataset(folder / "fusion.nc", record)
    periods = {name: {"value": 3.0, "u": 0.25} for name in ("first_hour", "whole", "last_hour", "change")}
    test = {
        "kind": "spindle", "duration_h": 40.0, "temperatures": [], "contributions": [], "courses": [], "remarks": [],
        "distortions": [{"name": "X", "unit": "um", "settling_min": 90.0, **periods}],
        "conditions": [
            {"key": "machine", "name": "Machine", "text": "Mill 9"},
            {"key": "operator", "name": "Operator", "text": ""},
        ],
    }  # fmt: skip
    parts = {"loop": RECORD_LOOP, "iso230_3": [test]}
    write_json(folder / "results.json", assemble("R", parts, []).as_json())
    return record


def test_a_record_has_a_workbook_of_its_own(tmp_path):
    record = write_record(tmp_path)
    [path] = export_results(tmp_path, "xlsx", tmp_path / "out").files
    book = openpyxl.load_workbook(path)
    assert book.sheetnames == [
        "Summary", "Distortions", "Conditions", "Model", "Contributions", "Hold-out errors", "Predictions", "Readings",
    ]  # fmt: skip
    names, values = (list(line) for line in book["Distortions"].iter_rows(max_row=2, values_only=True))
    told = dict(zip(names, values, strict=True))
    assert (told["unit"], told["whole test"], told["U(whole test) (k = 2)"]) == ("µm", 3.0, 0.5)
    assert told["settled after / min"] == 90.0
    assert [row[1] for row in book["Conditions"].iter_rows(min_row=2, values_only=True)] == ["Mill 9", "not stated"]
    contributed = [row[2] for row in book["Contributions"].iter_rows(min_row=2, values_only=True)]
    assert contributed == pytest.approx(np.ptp(record["displacement"].values, axis=0))
    errors = list(book["Hold-out errors"].iter_rows(min_row=2, values_only=True))
    assert [row[:4] for row in errors] == [("X", 0.9, 0.6, 0.4), ("mean", 0.9, 0.6, 0.4)]
    readings = book["Readings"]
    first = dict(zip(*readings.iter_rows(max_row=2, values_only=True), strict=True))
    assert first["X / µm"] == pytest.approx(float(record["displacement"][0, 0])) and first["t1 / °C"] == 20.0
    assert readings.max_row == 41 and readings.cell(41, readings.max_column).value == "yes"
    assert readings.cell(41, 10).value == 5000.0
    assert len(readings._charts[0].series) == 4, "measured and predicted displacement of both channels"
    written = export_results(tmp_path, "csv", tmp_path / "csv").files
    assert {path.name for path in written} >= {"distortions.csv", "readings.csv", "hold-out_errors.csv"}


def test_pictures_have_a_workbook_with_bounds_beyond_the_calibrated_range(tmp_path):
    dims, count = ("time", "region"), 3
    highest = np.array([[90.0], [250.0], [311.67]])
    value = dict.fromkeys(("maximum_u", "minimum", "minimum_u", "mean", "mean_u", "emissivity"), np.ones((count, 1)))
    beyond = np.array([[0], [0], [9]])
    pictures = xr.Dataset(
        {
            "maximum": (dims, highest),
            **{name: (dims, values) for name, values in value.items()},
            "overrange": (dims, beyond),
            "underrange": (dims, 0 * beyond),
            "thermogram": (("row", "column"), np.zeros((2, 2))),
        },
        coords={
            "time": np.datetime64("2024-11-19T19:19", "ns") + np.arange(count) * np.timedelta64(30, "s"),
            "region": ["whole picture"],
            "source": ("time", np.array(["a.jpg", "b.jpg", "c.jpg"], object)),
        },
    )
    write_dataset(tmp_path / "thermograms.nc", pictures)
    at = {"file": "c.jpg", "frame": 0, "time": None, "column_px": 1, "row_px": 2}
    region = {
        "name": "whole picture", "kind": "box", "camera": "C", "pictures": 3, "emissivity": 0.95,
        "maximum_degC": {"value": 311.67, "u": None}, "maximum_at": at, "minimum_degC": {"value": 16.4, "u": 1.2}, "minimum_at": at,
        "mean_degC": {"value": 31.7, "u": 1.3}, "overrange_pictures": 1, "overrange_pixels": 9, "underrange_pictures": 0,
        "underrange_pixels": 0,
    }  # fmt: skip
    found = {
        "pictures": 3, "cameras": [{"name": "C", "pictures": 3, "first": None, "last": None}], "series": "C", "scene": "still",
        "largest_shift_px": 0.1, "emissivity": 0.95, "indicated_degC": 391.0,
    }  # fmt: skip
    write_json(tmp_path / "results.json", assemble("P", {"thermograms": found, "regions": [region]}, []).as_json())
    [path] = export_results(tmp_path, "xlsx", tmp_path / "out").files
    book = openpyxl.load_workbook(path)
    assert book.sheetnames == ["Summary", "Regions", "Pictures"]
    names = [cell.value for cell in book["Pictures"][1]]
    column = 1 + names.index("maximum / °C")
    cells = [book["Pictures"].cell(row, column) for row in (2, 3, 4)]
    assert [cell.value for cell in cells] == highest.ravel().tolist()
    assert [cell.number_format for cell in cells] == ["0.00", "0.00", '"> "0']
    elapsed = 1 + names.index("time / min")
    assert [book["Pictures"].cell(row, elapsed).value for row in (2, 3, 4)] == [0.0, 0.5, 1.0]
    told = dict(zip(*book["Regions"].iter_rows(max_row=2, values_only=True), strict=True))
    assert told["region"] == "whole picture" and told["U(minimum) (k = 2) / K"] == pytest.approx(2.4)
    with pytest.raises(
        ExportError, match=r"this campaign has no laser, .* --format csv and xlsx write its temperatures"
    ):
        export_results(tmp_path, "linuxcnc", tmp_path / "out")


@pytest.mark.parametrize(
    ("column", "heading"),
    [
        ("drift_um", "drift / µm"),
        ("drift_u_um", "U(drift) (k = 2) / µm"),
        ("u_arcsec", "U (k = 2) / arcsec"),
        ("whole_test_u", "U(whole test) (k = 2)"),
        ("time_utc", "time (UTC)"),
        ("position_deg", "position / °"),
        ("ch_1(um) [um]", "ch_1(um) / µm"),
        ("A / µm", "A / µm"),
    ],
)
def test_headings_are_words_with_units(column, heading):
    [(found, values)] = tables.in_words(pd.DataFrame({column: [1.5]})).items()
    assert found == heading
    assert values[0] == (3.0 if heading.startswith("U") else 1.5)


SOUND = {"state": "sound", "accepted": [], "checks": []}
CHECK = {
    "code": "copied_cycles", "value": 3.0, "limit": 0.0, "passed": False, "evidence": "3 cycles are copies.", "remedy": "Look.",
    "endangers": "all", "assumption": "no cycle is a copy", "conditional": ["positions"],
}  # fmt: skip


def results(**changes: Any) -> Results:
    return assemble("A", {**PARTS, "inputs": SOUND, **changes}, [])


def loop(**changes: Any) -> dict[str, Any]:
    return {**PARTS["loop"], **changes}


def anomaly(kind: str, cause: str) -> dict[str, Any]:
    (sample,) = PARTS["anomalies"]
    return {**sample, "cause": cause, "evidence": {**sample["evidence"], "kind": kind}}


@pytest.mark.parametrize("verdict", ["complete", "explained"])
def test_a_sound_run_has_no_objection(verdict):
    found = results(loop=loop(verdict=verdict))
    assert objections(found) == []
    (remark,) = remarks(found)
    assert remark.startswith("position 3, both approaches, stands out (mechanical scatter, scatter 0.70 um)")


@pytest.mark.parametrize("verdict", ["partial", "unexplained", "no_skill"])
def test_other_verdicts_are_objections(verdict):
    (reason,) = objections(results(loop=loop(verdict=verdict)))
    assert reason.startswith(f"the verdict is {verdict}: ")


def test_doubts_and_unlike_positions_are_objections():
    doubted = {"state": "doubted", "accepted": [], "checks": [CHECK]}
    assert objections(results(inputs=doubted)) == ["an input is doubted (copied_cycles): 3 cycles are copies"]
    assert objections(results(inputs={**doubted, "accepted": ["copied_cycles"]})) == []
    unchecked = assemble("A", {name: part for name, part in PARTS.items() if name != "inputs"}, [])
    assert objections(unchecked) == ["the inputs were not checked against each other"]
    parts = {name: part for name, part in PARTS.items() if name != "loop"}
    assert objections(assemble("A", {**parts, "inputs": SOUND}, [])) == []  # a campaign of the laser alone
    found = results(anomalies=[anomaly("slow", "local_temperature")])
    assert objections(found) == [] and "local temperature" in remarks(found)[0]


@pytest.mark.parametrize(("kind", "cause"), [("step", "step"), ("slow", "undetermined"), ("periodic", "undetermined")])
def test_a_position_that_moves_unlike_the_others_is_an_objection(kind, cause):
    (reason,) = objections(results(anomalies=[anomaly(kind, cause)]))
    assert reason.startswith(f"position 3, both approaches, drifts or steps unlike the others ({kind}, cause: ")


def lines_of(folder, **changes) -> list[str]:
    state = read_thermal_state(folder, read_grouped(folder / "deviations.nc"))
    origin = read_origin(folder, read_results(folder), state)
    stated = {"words": "A control", "axis": "X", "sign": "plus", "objections": [], "remarks": []}
    return header_lines(origin, **{**stated, **changes}, exported=datetime(2026, 11, 22, 9, 30, tzinfo=UTC))


def test_the_header_names_source_state_and_trial_line_by_line(small_run):
    lines = lines_of(small_run)
    assert lines[0] == "Compensation table for A control, by thermofuse"
    digest = hashlib.sha256((small_run / "results.json").read_bytes()).hexdigest()
    assert lines[-1] == f"source: results.json, SHA-256 {digest}"
    stated = {"machine: Mill 5, serial number 77", "axis: X", "verdict on the drift: explained", "sign: plus"}
    assert stated | {"exported: 2026-11-22 09:30 UTC"} <= set(lines)
    assert any(line.startswith("How to try it: ") and "one value of 0.010 mm" in line for line in lines)
    assert not any(line.startswith("FORCED") for line in lines)
    # The title holds a line break and a command; a control would run what stands on a line of its own.
    lines = lines_of(small_run, objections=["the verdict is\npartial"])
    assert "campaign: =1+1  ; M30 axis u" in lines
    assert lines[1] == "FORCED, although the verdict is partial"
    assert all(line.isascii() and line.isprintable() for line in lines)
    lines = lines_of(small_run)
    state = "mean of cycles 1 to 12: material 22.04 degC (20.04 to 23.99), air 21.04 degC (19.04 to 22.99)"
    assert f"thermal state: {state}" in lines
    assert "measured: 2026-03-09 06:30 UTC to 2026-03-09 07:26 UTC" in lines


def test_what_is_not_stated_is_said(small_run, tmp_path):
    for name in ("deviations.nc", "results.json"):
        (tmp_path / name).write_bytes((small_run / name).read_bytes())
    lines = lines_of(tmp_path, axis="")
    assert {
        "machine: not stated",
        "axis: not stated",
        "compensation that was active during the test: not stated",
        "thermal state: mean of cycles 1 to 12: material not recorded, air not recorded",
    } <= set(lines)


def test_what_is_not_recorded_is_said(small_run, tmp_path):
    deviations = read_grouped(small_run / "deviations.nc")
    untimed = deviations.assign(
        time=deviations["time"].copy(data=np.full(deviations["time"].shape, np.datetime64("NaT", "ns")))
    )
    state = read_thermal_state(tmp_path, untimed)
    assert state.temperatures_degC == {"material": None, "air": None} and state.first is state.last is None


def test_readings_and_profile_are_complete(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    readings = tables.readings_table(deviations)
    assert len(readings) == 12 * 2 * 8 and readings["deviation_um"].notna().all()
    gap = deviations.assign(deviation=deviations["deviation"].where(deviations["cycle"] != 4))
    assert len(tables.readings_table(gap)) == 11 * 2 * 8
    profile = tables.profile_table(deviations)
    assert len(profile) == 16 and set(profile["direction"]) == {"positive", "negative"}


def test_iso230_values_are_those_of_the_standard(small_run):
    deviations = read_grouped(small_run / "deviations.nc")
    x = deviations["deviation"].values[:5]
    mean, s = x.mean(axis=0), x.std(axis=0, ddof=1)
    axis = tables.iso230_axis_table(deviations).set_index(["window", "quantity", "direction"])
    first = axis.index[0][0]
    assert axis.loc[(first, "B", "both"), "value_um"] == pytest.approx(np.abs(mean[0] - mean[1]).max())
    assert axis.loc[(first, "E", "positive"), "value_um"] == pytest.approx(np.ptp(mean[0]))
    assert axis.loc[(first, "A", "both"), "value_um"] == pytest.approx((mean + 2 * s).max() - (mean - 2 * s).min())
    assert (axis["u_um"] > 0).all()


def test_positions_are_of_the_window_that_the_results_state(small_run):
    deviations, results = read_grouped(small_run / "deviations.nc"), read_results(small_run)
    assert results.iso230.window == "cycles 6 to 10"
    positions = tables.iso230_position_table(deviations, results)
    assert (positions["count_positive"] == 5).all()
    np.testing.assert_allclose(positions["mean_positive_um"], deviations["deviation"].values[5:10, 0].mean(axis=0))
    assert set(positions["window"]) == {"cycles 6 to 10"}


def test_fields_are_tabulated_on_request(tmp_path):
    write_fields(tmp_path)
    frame = tables.fields_table(tmp_path)
    assert list(frame) == ["cycle", "y_mm", "x_mm", "temperature_degC", "rise_K", "rise_u_K"]
    assert len(frame) == 10
    assert tables.fields_megabytes(tmp_path) == pytest.approx(12 * 43e-6)


def test_a_workbook_without_room_for_its_temporary_files_is_refused_as_a_full_disk(tmp_path):
    """lxml, which writes them, names neither the file nor the fault as Python does."""
    room = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, room[1]))
    try:
        with pytest.raises(OSError, match="temporary files") as refused:
            write_workbook(tmp_path / "results.xlsx", {"A": pd.DataFrame({"x": range(5000)})})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, room)
    assert refused.value.errno == errno.EFBIG and not list(tmp_path.iterdir())


def test_the_workbook_reads_back(small_run, tmp_path):
    deviations = read_grouped(small_run / "deviations.nc")
    results = read_results(small_run)
    write_workbook(tmp_path / "results.xlsx", tables.axis_tables(results, deviations))
    book = openpyxl.load_workbook(tmp_path / "results.xlsx")
    first = ["Summary", "A R E M B", "Conditions"]
    assert book.sheetnames == [*first, "ISO 230-2 axis", "ISO 230-2 positions", "Profile", "Readings"]
    # The campaign is called =1+1.
    cell = book["Summary"]["B2"]
    assert (cell.data_type, cell.value.startswith("=1+1")) == ("s", True)
    assert not any(cell.data_type == "f" for sheet in book for row in sheet.iter_rows() for cell in row)
    names = [cell.value for cell in book["Readings"][1]]
    first = dict(zip(names, [cell.value for cell in book["Readings"][2]], strict=True))
    assert first["time (UTC)"].isoformat() == "2026-03-09T06:30:00"
    assert first["deviation / µm"] == pytest.approx(float(deviations["deviation"][0, 0, 0]))
    assert book["Readings"].max_row == 1 + 192
    values = list(book["A R E M B"].iter_rows(min_row=2, values_only=True))
    assert "".join(row[0] for row in values) == "AREMB"
    headings = [cell.value for cell in book["A R E M B"][1]]
    judged = ["decision", "decided otherwise", "acceptance by ISO 230-2"]
    assert headings == ["quantity", "value / µm", "U (k = 2) / µm", "limit / µm", *judged]
    quantity = next(row for row in book["A R E M B"].iter_rows(min_row=2) if row[0].value == "A")
    window = results.iso230
    assert [cell.value for cell in quantity[1:3]] == pytest.approx([window.A_um.value, 2 * window.A_um.u])
    assert quantity[1].number_format == "0.000" and quantity[4].value == results.iso230.tolerances[0].decision
    assert book["Conditions"].max_row == 1 + len(results.iso230.conditions)
    lines = book["Profile"]._charts[0].series
    assert [len(line.xVal.numRef.f) > 0 for line in lines] == [True, True], "one line for each approach"
