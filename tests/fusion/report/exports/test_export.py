"""Exports of a folder: guarded, never overwriting in silence, with a header that the dialect can hold."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion import cli
from fusion.report.exports.errors import ExportError
from fusion.report.exports.export import FORMATS, export_results
from tests.fusion.report.exports.small_run import measured, write_fields, write_run
from tests.fusion.results_sample import PARTS


def test_the_command_offers_every_format() -> None:
    assert {item.value for item in cli.ExportFormat} == set(FORMATS)


def test_csv_writes_tables_and_leaves_the_large_one_out(small_run, tmp_path) -> None:
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


@pytest.mark.parametrize(
    ("format", "names"),
    [
        ("xlsx", ["results.xlsx"]),
        ("linuxcnc", ["compensation_X.comp", "compensation_X.comp.README.txt"]),
        ("siemens840d", ["compensation_X.MPF"]),
        ("siemens840d-temperature", ["temperature_X.MPF"]),
        ("heidenhain", ["AXIS_X.COM", "AXIS_X.COM.README.txt"]),
        ("renishaw", ["compensation_X.ren", "compensation_X.ren.README.txt"]),
    ],
)
def test_nothing_is_overwritten_in_silence(small_run, tmp_path, format: str, names: list[str]) -> None:
    options = {"spacing_mm": 20.0} if format in ("siemens840d", "renishaw") else {}
    written = export_results(small_run, format, tmp_path, **options)
    assert [path.name for path in written.files] == names
    if format != "xlsx":
        header = written.files[-1].read_text(encoding="ascii")
        assert "thermal state: mean of cycles 1 to 12: material 22.04 degC" in header and "machine: Mill 5" in header
    before = {path: path.read_bytes() for path in written.files}
    with pytest.raises(ExportError, match=rf"{names[0]}.* exists already; add --overwrite"):
        export_results(small_run, format, tmp_path, **options)
    assert before == {path: path.read_bytes() for path in written.files}
    export_results(small_run, format, tmp_path, overwrite=True, **options)


def test_unequal_targets_need_a_spacing(small_run, tmp_path) -> None:
    with pytest.raises(
        ExportError,
        match=r"needs equally spaced points; these are 22 to 29 mm apart, as ISO 230-2 asks for: .* --spacing",
    ):
        export_results(small_run, "siemens840d", tmp_path)
    assert not list(tmp_path.iterdir())
    table = export_results(small_run, "siemens840d", tmp_path, spacing_mm=20.0, axis="X1").files[0]
    text = table.read_text(encoding="ascii")
    assert "[0,X1]=20.0000" in text and "resampled every 20 mm" in text and "; axis: X1" in text


@pytest.fixture(scope="module")
def unexplained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    loop = {**PARTS["loop"], "verdict": "unexplained"}
    even = measured(np.linspace(0.0, 140.0, 8))
    return write_run(tmp_path_factory.mktemp("unexplained"), even, axis="X axis; M30", loop=loop)


@pytest.mark.parametrize("format", ["linuxcnc", "siemens840d", "siemens840d-temperature", "heidenhain", "renishaw"])
def test_the_guard_refuses_and_a_forced_table_says_why(unexplained, tmp_path, format: str) -> None:
    with pytest.raises(
        ExportError, match=r"no compensation table is written: the verdict is unexplained: .* add --force"
    ):
        export_results(unexplained, format, tmp_path, axis="X")
    assert not list(tmp_path.iterdir())
    forced = export_results(unexplained, format, tmp_path, axis="X", force=True)
    assert forced.remarks[0].startswith("forced, although the verdict is unexplained")
    assert "FORCED, although the verdict is unexplained" in forced.files[-1].read_text(encoding="ascii")


def test_the_axis_is_a_name(unexplained, tmp_path) -> None:
    """The campaign's axis comes from a file: what is no name is never written into a table."""
    with pytest.raises(ExportError, match=r'"X axis; M30" is no name of an axis; write a letter'):
        export_results(unexplained, "heidenhain", tmp_path, force=True)
    with pytest.raises(ExportError, match="is no name of an axis"):
        export_results(unexplained, "linuxcnc", tmp_path, force=True, axis="X\nM30")
    files = export_results(unexplained, "linuxcnc", tmp_path, force=True).files
    assert files[0].name == "compensation.comp" and "axis: not stated" in files[1].read_text()


def test_a_run_of_the_camera_alone_has_its_fields(tmp_path) -> None:
    write_fields(tmp_path)
    assert [path.name for path in export_results(tmp_path, "csv", tmp_path / "out").files] == ["fields.csv"]
    with pytest.raises(
        ExportError, match=r"this campaign has no laser, so there is neither drift nor profile to write"
    ):
        export_results(tmp_path, "linuxcnc", tmp_path / "out")


def test_a_folder_without_results_is_refused(tmp_path) -> None:
    with pytest.raises(
        ExportError, match=r"there is no deviations.nc in it; name the results folder of a finished run"
    ):
        export_results(tmp_path, "csv", tmp_path)
    with pytest.raises(ExportError, match=r'there is no format "mazak"; write one of csv, xlsx, linuxcnc'):
        export_results(tmp_path, "mazak", tmp_path)
