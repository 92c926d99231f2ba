"""Laser and environment CSV files: every fault is named with its line, nothing is dropped in silence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from interferometry.deviations import DUPLICATE, MISSING, OUT_OF_ORDER, UNREADABLE, sort_readings
from interferometry.io.faults import LaserFormatError
from interferometry.io.readers import is_environment_log, read_deviations, read_environment
from tests.interferometry.laser_mutations import fuzz

HEADER = "cycle,direction,target,position_mm,time,deviation_um"


def rows(cycles: int = 3, targets: int = 3) -> list[str]:
    """Lines of a complete test; line 2 of the file is cycle 1, positive, target 1."""
    lines, second = [], 0
    for cycle in range(1, cycles + 1):
        for direction, order in (("positive", range(1, targets + 1)), ("negative", range(targets, 0, -1))):
            for target in order:
                time = f"2026-03-09T06:{30 + second // 60:02d}:{second % 60:02d}+00:00"
                lines.append(f"{cycle},{direction},{target},{20 * (target - 1)},{time},{cycle + 0.1 * target:.1f}")
                second += 6
    return lines


def write(folder: Path, lines: list[str], header: str = HEADER) -> Path:
    path = folder / "laser.csv"
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def left_out(dataset: object) -> list[dict[str, object]]:
    return json.loads(dataset.attrs["left_out"])  # type: ignore[attr-defined]


def test_a_complete_file_comes_back_cell_by_cell(tmp_path: Path) -> None:
    deviations = read_deviations(write(tmp_path, rows()))
    assert deviations.sizes == {"cycle": 3, "direction": 2, "target": 3}
    assert deviations["deviation"].sel(cycle=2, direction="negative", target=3) == pytest.approx(2.3)
    assert deviations["time"].values[0, 1, 2] == np.datetime64("2026-03-09T06:30:18")
    assert deviations["position"].values.tolist() == [0.0, 20.0, 40.0]
    assert deviations["time"].attrs["origin"] == "recorded"
    assert left_out(deviations) == []
    assert not deviations["quality_flag"].any()


@pytest.mark.parametrize(
    ("line", "column", "value", "reason"),
    [
        (4, 1, "sideways", "is neither 'positive' nor 'negative'"),
        (5, 5, "nan", "is not a finite number"),
        (5, 5, "", "is not a number"),
        (6, 5, "-1e20", "is not a finite number"),
        (7, 4, "half past six", "is not an ISO 8601 time"),
        (8, 0, "1.5", "is not a whole number from 1"),
        (9, 2, "0", "is not a whole number from 1"),
        (10, 3, "abc", "is not a number"),
        (11, 4, "2026-03-10T06:30:54+00:00", "is not a time within cycle 2"),
        (12, 3, "21", "target 2 stands at 20.0 mm elsewhere"),
    ],
)
def test_one_bad_reading_is_left_out_with_its_line(
    tmp_path: Path, line: int, column: int, value: str, reason: str
) -> None:
    lines = rows()
    fields = lines[line - 2].split(",")
    fields[column] = value
    lines[line - 2] = ",".join(fields)
    deviations = read_deviations(write(tmp_path, lines))
    listed = left_out(deviations)
    assert len(listed) == 1
    assert listed[0]["line"] == line
    assert reason in str(listed[0]["reason"])
    assert listed[0]["path"] == "laser.csv"
    assert int(np.isnan(deviations["deviation"]).sum()) == deviations.attrs["missing"] == 1


def test_an_unreadable_reading_is_flagged_in_its_cell(tmp_path: Path) -> None:
    lines = rows()
    lines[0] = lines[0].rsplit(",", 1)[0] + ",---"
    flagged = read_deviations(write(tmp_path, lines))["quality_flag"].values
    assert flagged[0, 0, 0] == MISSING.mask | UNREADABLE.mask
    assert flagged.astype(bool).sum() == 1


def test_the_first_of_two_equal_readings_is_kept(tmp_path: Path) -> None:
    lines = rows()
    lines.insert(1, lines[0].rsplit(",", 1)[0] + ",99.0")
    deviations = read_deviations(write(tmp_path, lines))
    assert deviations["deviation"].values[0, 0, 0] == pytest.approx(1.1)
    assert left_out(deviations)[0]["reason"] == ("cycle 1 positive target 1 already stands on line 2, which is kept")
    assert deviations["quality_flag"].values[0, 0, 0] == DUPLICATE.mask


def test_absent_readings_are_counted(tmp_path: Path) -> None:
    lines = rows()
    del lines[7]
    deviations = read_deviations(write(tmp_path, lines))
    assert deviations.attrs["missing"] == 1
    assert sort_readings(deviations).sizes["reading"] == 17


def test_byte_order_mark_crlf_and_semicolons_with_decimal_commas(tmp_path: Path) -> None:
    lines = [line.replace(",", ";").replace(".", ",") for line in rows()]
    path = tmp_path / "laser.csv"
    text = "\r\n".join([HEADER.replace(",", ";"), "", *lines]) + "\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_deviations(path).equals(read_deviations(write(tmp_path, rows())))


def test_other_zones_become_utc_and_a_missing_zone_is_stated(tmp_path: Path) -> None:
    utc = read_deviations(write(tmp_path, rows()))
    shifted = [line.replace("T06:", "T08:").replace("+00:00", "+02:00") for line in rows()]
    converted = read_deviations(write(tmp_path, shifted))
    assert (converted["time"].values == utc["time"].values).all()
    assert converted["time"].attrs["reference"] == "converted to UTC from +0200"
    bare = read_deviations(write(tmp_path, [line.replace("+00:00", "") for line in rows()]))
    assert bare["time"].attrs["reference"] == "no zone in the file: taken as UTC"


def test_zones_on_some_lines_only_are_refused(tmp_path: Path) -> None:
    lines = rows()
    lines[3] = lines[3].replace("+00:00", "")
    with pytest.raises(LaserFormatError, match=r"line 5 has no zone, that on line 2 has \+0000; write all of them"):
        read_deviations(write(tmp_path, lines))


def test_lines_in_any_order_give_the_same_test(tmp_path: Path, rng: np.random.Generator) -> None:
    shuffled = list(rng.permutation(rows()))
    assert read_deviations(write(tmp_path, shuffled)).equals(read_deviations(write(tmp_path, rows())))


def test_overlapping_cycles_are_refused(tmp_path: Path) -> None:
    lines = rows()
    lines[5] = lines[5].replace("06:30:30", "06:30:36")
    with pytest.raises(LaserFormatError, match=r"cycle 2 begins at .* \(line 8\) before cycle 1 ends at .* \(line 7\)"):
        read_deviations(write(tmp_path, lines))


def test_a_reading_out_of_the_order_of_its_pass_is_flagged(tmp_path: Path) -> None:
    lines = rows(targets=5)
    lines[1] = lines[1].replace("06:30:06", "06:30:19")
    flagged = read_deviations(write(tmp_path, lines))["quality_flag"].values
    assert flagged[0, 0, 1] == OUT_OF_ORDER.mask
    assert np.count_nonzero(flagged) == 1


def test_targets_that_change_their_position_are_refused(tmp_path: Path) -> None:
    lines = [line.replace(",2,20,", ",2,25,") if line.startswith(("2", "3")) else line for line in rows()]
    with pytest.raises(LaserFormatError, match=r"target 2 stands at 20.0 mm on line 3 but at 25.0 mm elsewhere"):
        read_deviations(write(tmp_path, lines))


def test_two_targets_at_one_position_are_refused(tmp_path: Path) -> None:
    lines = [line.replace(",3,40,", ",3,20,") for line in rows()]
    with pytest.raises(LaserFormatError, match=r"targets 2 and 3 both stand at 20.0 mm"):
        read_deviations(write(tmp_path, lines))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER.replace("deviation_um", "deviation"), r"'deviation' has no unit; write it in the heading, .*\[um\]"),
        (HEADER.replace("deviation_um", "deviation_deg"), "position in mm, deviation in deg; give both as lengths"),
        (HEADER.replace("time,", ""), "18 of 18 lines cannot be used, the first is line 2: '' does not have 5 fields"),
        (HEADER.replace("direction", "way"), "has columns of cycle, .* but no column of a direction"),
        (HEADER + ",time", "column time occurs more than once"),
    ],
)
def test_a_wrong_column_is_refused(tmp_path: Path, header: str, message: str) -> None:
    with pytest.raises(LaserFormatError, match=message):
        read_deviations(write(tmp_path, rows(), header))


def test_a_bad_column_is_an_error_and_not_a_list_of_readings(tmp_path: Path) -> None:
    lines = [line.rsplit(",", 1)[0] + ",n/a" for line in rows()]
    with pytest.raises(
        LaserFormatError, match=r"18 of 18 lines cannot be used, the first is line 2: 'n/a' is not a number"
    ):
        read_deviations(write(tmp_path, lines))


def test_files_without_readings_or_without_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LaserFormatError, match="no reading below the header"):
        read_deviations(write(tmp_path, []))
    empty = tmp_path / "empty.csv"
    empty.write_bytes(b"")
    with pytest.raises(LaserFormatError, match="the file is empty"):
        read_deviations(empty)
    empty.write_bytes(b"cycle\x00\xff\xfe")
    with pytest.raises(LaserFormatError, match="character 6 is a zero byte, so the file is not text"):
        read_deviations(empty)


def test_readings_are_sorted_in_measuring_order(tmp_path: Path) -> None:
    readings = sort_readings(read_deviations(write(tmp_path, rows())))
    assert readings["sign"].values[:6].tolist() == [1, 1, 1, -1, -1, -1]
    assert readings["target"].values[:6].tolist() == [1, 2, 3, 3, 2, 1]
    assert readings["seconds"].values[:3].tolist() == [0.0, 6.0, 12.0]
    assert readings["position"].values[2] == 40.0


ENVIRONMENT = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent,material_temperature_degC"


def test_environment_is_sorted_and_its_faults_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "environment.csv"
    lines = [
        "2026-03-09T06:32:00Z,23.7,1000.0,42,23.8",
        "2026-03-09T06:30:00Z,23.5,1000.2,42,23.9",
        "2026-03-09T06:31:00Z,23.6,101.3,42,23.9",
        "2026-03-09T06:30:00Z,23.6,1000.2,42,23.9",
        "2026-03-09T06:33:00Z,23.6,1000.2,42,-10",
        "2026-03-09T06:34:00Z,23.6,1000.2,42,24.0",
        "2026-03-09T06:35:00Z,23.6,1000.2,42,24.0",
    ]
    path.write_text("\n".join([ENVIRONMENT, *lines]), encoding="utf-8")
    environment = read_environment(path)
    assert environment["air_temperature"].values.tolist() == [23.5, 23.7, 23.6, 23.6]
    reasons = {one["line"]: one["reason"] for one in left_out(environment)}
    assert "lies outside 500 .. 1200, the range of air_pressure_hPa in its unit" in str(reasons[4])
    assert "occurs on an earlier line too" in str(reasons[5])
    assert "lies outside -9 .. 80" in str(reasons[6])


def test_environment_in_another_unit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "environment.csv"
    path.write_text(ENVIRONMENT + "\n2026-03-09T06:32:00Z,23.7,101.3,42,23.8\n", encoding="utf-8")
    with pytest.raises(LaserFormatError, match=r"1 of 1 lines cannot be used.*lies outside 500 .. 1200"):
        read_environment(path)


@pytest.mark.parametrize("read", [read_deviations, read_environment])
def test_a_missing_file_is_named_by_the_error(read: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        read(tmp_path / "laser.csv")
    assert Path(caught.value.filename) == tmp_path / "laser.csv"


def test_five_hundred_damaged_files_raise_no_foreign_error(tmp_path: Path) -> None:
    counts = fuzz(tmp_path, 500, seed=28)
    assert sum(taken for taken, _ in counts.values()) > 50
    assert sum(refused for _, refused in counts.values()) > 50


HEADINGS = {
    "english": "time,air temperature (°C),air pressure (hPa),humidity (%),material temperature (°C)",
    "german": "Zeit,Lufttemperatur [°C],Luftdruck [hPa],Luftfeuchte [%],Materialtemperatur [°C]",
    "french": "Heure,Température de l'air (°C),Pression (hPa),Humidité (%),Température matière (°C)",
    "spanish": "Hora,Temperatura del aire (°C),Presión (hPa),Humedad (%),Temperatura del material (°C)",
    "chinese": "时间,空气温度(°C),气压(hPa),湿度(%),材料温度(°C)",
}


@pytest.mark.parametrize("language", HEADINGS)
def test_environment_headings_in_five_languages(tmp_path: Path, language: str) -> None:
    path = tmp_path / "environment.csv"
    path.write_text(HEADINGS[language] + "\n2026-03-09T06:30:00Z,23.5,1000.2,42,23.9\n", encoding="utf-8")
    assert is_environment_log(path)
    assert read_environment(path)["air_pressure"].values.tolist() == [1000.2]


def test_environment_in_other_units_is_converted(tmp_path: Path) -> None:
    path = tmp_path / "environment.csv"
    head = "time,air_temperature_degF,pressure (kPa),humidity (%),sample temperature [K]"
    path.write_text(head + "\n2026-03-09T06:32:00Z,68,101.3,42,293.15\n", encoding="utf-8")
    environment = read_environment(path)
    values = [float(environment[name][0]) for name in ("air_temperature", "air_pressure", "material_temperature")]
    assert values == pytest.approx([20.0, 1013.0, 20.0], abs=1e-9)
    path.write_text(head.replace("kPa", "mm") + "\n2026-03-09T06:32:00Z,68,101.3,42,293.15\n", encoding="utf-8")
    with pytest.raises(LaserFormatError, match=r"line 1: the unit of 'pressure .mm.' is none of a pressure"):
        read_environment(path)
    path.write_text("time,air_temperature_degC\n2026-03-09T06:32:00Z,20\n", encoding="utf-8")
    with pytest.raises(LaserFormatError, match="line 1 lacks air_pressure_hPa, relative_humidity_percent, material"):
        read_environment(path)


def test_humidity_as_a_fraction_is_not_read_as_percent(tmp_path: Path) -> None:
    path = tmp_path / "environment.csv"
    path.write_text(ENVIRONMENT + "\n2026-03-09T06:32:00Z,23.7,1000.1,0.45,23.8\n", encoding="utf-8")
    with pytest.raises(LaserFormatError, match=r"'0.45' lies outside 1 .. 100, the range of relative_humidity_percent"):
        read_environment(path)


def test_a_report_of_averages_is_no_test(tmp_path: Path) -> None:
    path = tmp_path / "x.pos"
    path.write_text("Position   \tBidirectional Avg Error\n0\t0.001\n10\t0.002\n")
    with pytest.raises(
        LaserFormatError, match="a report of averages over runs holds no single reading; export the readings"
    ):
        read_deviations(path)
