"""Renishaw files and logs of assignments: the traps of the genuine one, and broken promises of the header."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from interferometry.inspection import describe_test
from interferometry.io.faults import LaserFormatError
from interferometry.io.readings import read_deviations
from interferometry.io.renishaw import read_ecmc_log

GENUINE = "friedcucumber__RenishawWork/data/22.rtl"


@pytest.mark.real_data
def test_genuine_file_with_all_its_traps(real_file):
    test = read_deviations(real_file(GENUINE))
    assert test.sizes["cycle"] == 1
    assert test["position"].values.tolist() == list(np.arange(-280.0, 421.0, 50.0))
    forward = test["deviation"].sel(direction="positive").values[0]
    printed = [-0.7, -0.2, -1.4, -1.0, -1.4, -4.5, -6.4, -8.1, -9.4, -9.4, -10.5, -7.5, -7.7, -6.6, -7.9]
    assert forward.tolist() == printed
    assert np.isnan(test["deviation"].sel(direction="negative")).all()
    assert json.loads(test.attrs["runs_empty"]) == [2]
    assert test.attrs["missing"] == 15
    assert test["air_temperature"].values.tolist() == [26.234373, 26.281248]
    assert test["air_pressure"].values == pytest.approx([1011.4, 1011.6])
    assert test["material_temperature"].values[0].tolist() == [24.562498, 24.570311]
    assert np.isnan(test["material_temperature"].values[1:]).all()
    assert test["environment_factor"].values.tolist() == [0.31639452, 0.31639449]
    assert json.loads(test.attrs["user_text"])["date"] == "2014-10-08 10:53:29"


@pytest.mark.real_data
def test_genuine_file_gets_times_with_their_uncertainty(real_file):
    test = read_deviations(real_file(GENUINE))
    times = test["time"].sel(direction="positive").values[0]
    assert test["time"].attrs["origin"] == "reconstructed"
    # The start's last digit is a control byte (10:53:4?): the middle of its ten seconds, and 10/sqrt(12) s in the u.
    assert times[0] > np.datetime64("2014-10-08T10:53:45")
    assert times[-1] == np.datetime64("2014-10-08T10:56:49")
    assert (np.diff(times) > np.timedelta64(0)).all()
    assert float(test["time_u"]) >= 10 / np.sqrt(12)
    assert np.isnat(test["time"].sel(direction="negative").values).all()


TIMES = '"2014-10-08 10:00:00" "2014-10-08 10:02:00"'


def rtl(folder: Path, old: str = "", new: str = "", *, line_end: str = "\n") -> Path:
    lines = ["HEADER::", "File type  : rtl", "", "TARGET DATA::", "Filetype  : ISO", "Target-count: 3", "Targets :"]
    lines += ["-10.000000  0.000000 ", "10.000000 ", "Flags: 0 0 2 1", "", "RUNS::", "Run-count:4", ""]
    lines += ["DEVIATIONS::", "Run Target Data:"]
    lines += [f"{run} {target} {run + target / 10}" for run in (1, 3) for target in (1, 2, 3)]
    lines += [f"{run} {target} {-run - target / 10}" for run in (2, 4) for target in (3, 2, 1)]
    lines += ["", "ENVIRONMENT::", f"DateTime : {TIMES}", "", "EOF::", ""]
    text = "\n".join(lines)
    assert old in text
    path = folder / "test.rtl"
    path.write_bytes(text.replace(old, new, 1).replace("\n", line_end).encode("latin-1"))
    return path


def test_runs_become_cycles_and_directions(tmp_path):
    test = read_deviations(rtl(tmp_path))
    assert test["deviation"].sel(direction="positive").values.tolist() == [[1.1, 1.2, 1.3], [3.1, 3.2, 3.3]]
    assert test["deviation"].sel(direction="negative").values.tolist() == [[-2.1, -2.2, -2.3], [-4.1, -4.2, -4.3]]
    assert read_deviations(rtl(tmp_path, line_end="\r\n")).equals(test)


def test_a_test_measured_in_one_direction_has_one_direction(tmp_path):
    text = rtl(tmp_path).read_text("latin-1")
    reverse = "\n".join(f"2 {target} {-2 - target / 10}" for target in (3, 2, 1))
    forward = "\n".join(f"2 {target} {-2 - target / 10}" for target in (1, 2, 3))
    path = tmp_path / "one.rtl"
    text = text.replace(reverse, forward).replace("4 3 -4.3\n4 2 -4.2\n4 1 -4.1\n", "")
    text = text.replace("Run-count:4", "Run-count:3")
    path.write_text(text, encoding="latin-1")
    test = read_deviations(path)
    assert test.sizes["cycle"] == 3
    assert np.isnan(test["deviation"].sel(direction="negative")).all()


def test_feed_and_dwell_place_readings_within_their_run(tmp_path):
    test = read_deviations(rtl(tmp_path), feed_mm_per_min=300.0, dwell_s=2.0)
    steps = np.diff(test["time"].sel(direction="positive").values[0]) / np.timedelta64(1, "s")
    assert steps == pytest.approx([4.0, 4.0])
    assert test["time"].values.max() == np.datetime64("2014-10-08T10:02:00")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Target-count: 3", "Target-count: 4", "Target-count is 4, but 3 target positions follow"),
        ("10.000000 \nFlags", "ten\nFlags", r"line 9: 'ten' is not a row of target positions"),
        ("Run-count:4", "Run-count:2", r"Run-count is 2, but DEVIATIONS holds runs \[1, 2, 3, 4\]"),
        (": rtl", ": rta", "File type is rta, not rtl; only linear tests"),
        ("Run-count:4", "Run-count:ten", "line 13: Run-count is 'ten' and not a whole number; copy the file again"),
        ("Run-count:4", "Run+count:ten", "line 13: Run-count is 'ten' and not a whole number"),
        ("Target-count: 3", "Target-count: five", "line 6: Target-count is 'five' and not a whole number"),
        ("10.000000 \nFlags", "1_0.0\nFlags", r"line 9: '1_0.0' is not a row of target positions"),
        ("EOF::", "", "no section EOF::; the file is cut short"),
        ("DEVIATIONS::", "DEVIATIONS", "no section DEVIATIONS::"),
    ],
)
def test_broken_promises_of_the_header_are_refused(tmp_path, old, new, message):
    with pytest.raises(LaserFormatError, match=message):
        read_deviations(rtl(tmp_path, old, new))


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        ("1 2 abc", "is not 'run target deviation'"),
        ("1 2 1_2.5", "is not 'run target deviation'"),
        ("1 2 nan", "is not 'run target deviation'"),
        ("1 9 1.2", "names no run from 1 or no target of 1..3"),
        ("1 1 1.2", "repeats run 1 target 1, the first is kept"),
    ],
)
def test_bad_rows_are_left_out_with_their_line(tmp_path, new, reason):
    test = read_deviations(rtl(tmp_path, "1 2 1.2", new))
    (listed,) = json.loads(test.attrs["left_out"])
    assert (listed["line"], listed["reason"]) == (18, reason)
    assert np.isnan(test["deviation"].values[0, 0, 1])


def test_missing_readings_and_times_are_said_and_the_second_spelling_has_no_seconds(tmp_path):
    test = read_deviations(rtl(tmp_path, "1 2 1.2", "1 2 -100000000000000000000.000"))
    assert np.isnan(test["deviation"].values[0, 0, 1])
    assert test.attrs["missing"] == 1
    test = read_deviations(rtl(tmp_path, "DateTime", "Nothing"))
    assert test["time"].attrs["origin"] == "none"
    assert np.isnat(test["time"].values).all()
    test = read_deviations(rtl(tmp_path, TIMES, '"10:46 Dec 12 2016" "11:01 Dec 12 2016"'))
    assert test["time"].attrs["origin"] == "reconstructed"
    assert test["time"].values.max() == np.datetime64("2016-12-12T11:01:30")
    # Start and end are known to the minute: each adds 60 s / sqrt(12).
    assert float(test["time_u"]) >= 60 / np.sqrt(12)


@pytest.mark.parametrize(
    "times", ['"2014-13-08 10:00:00" "2014-10-08 10:02:00"', '"10:46 Foo 12 2016" "11:01 Dec 12 2016"']
)
def test_times_that_do_not_exist_are_no_times(tmp_path, times):
    test = read_deviations(rtl(tmp_path, TIMES, times))
    assert test["time"].attrs["origin"] == "none"


def zero_filled(folder: Path, flags: str) -> Path:
    """A test as a public writer of the format saves one direction: the reverse runs are filled with 0."""
    path = rtl(folder, "Flags: 0 0 2 1", f"Flags: {flags}")
    text = re.sub(r"^([24]) (\d) -.*$", r"\1 \2 0", path.read_text("latin-1"), flags=re.MULTILINE)
    path.write_text(text, encoding="latin-1")
    return path


def test_zero_filled_runs_are_readings_of_a_bidirectional_test_only(tmp_path):
    test = read_deviations(zero_filled(tmp_path, "0 1 2 0"))
    assert np.isnan(test["deviation"].sel(direction="negative")).all()
    assert test["deviation"].sel(direction="positive").values.tolist() == [[1.1, 1.2, 1.3], [3.1, 3.2, 3.3]]
    assert json.loads(test.attrs["notes"]) == [
        "run 2, 4 holds nothing but zeros and the flags say that one direction was measured: taken as not measured"
    ]
    test = read_deviations(zero_filled(tmp_path, "0 0 2 0"))
    assert (test["deviation"].sel(direction="negative") == 0.0).all()
    assert any("every reading of run 2, 4 is 0" in line for line in describe_test(test))


def test_damaged_numbers_of_the_environment_are_missing(tmp_path):
    test = read_deviations(
        rtl(tmp_path, "DateTime", "Air temp : -- --\nAir press : 101.1\nMat temp 1 : 1_2 20.5\nDateTime")
    )
    assert np.isnan(test["air_temperature"]).all()
    assert test["air_pressure"].values[0] == pytest.approx(1011.0)
    assert np.isnan(test["material_temperature"].values).tolist() == [[True, False]]


def test_a_dynamic_capture_is_refused(tmp_path):
    path = tmp_path / "t.rtx"
    path.write_bytes(b"HEADER::\r\nFile Type: rtx\r\nSample no: 5\r\nData:\r\n" + bytes(40) + b"EOF::\r\n")
    with pytest.raises(LaserFormatError, match=r"t\.rtx: a dynamic capture .* has no target positions"):
        read_deviations(path)


def log(folder: Path, old: str = "", new: str = "") -> Path:
    lines = ["UNIT=mm", "CYCLES=2", "POSITIONS=2"]
    lines += [f"TGT_DATA[{t}]={10 * t}" for t in (1, 2)]
    lines += [f"REF_DATA_{d}[{t},{c}]={10 * t + c / 1000}" for d in ("FWD", "BWD") for t in (1, 2) for c in (1, 2)]
    text = "\n".join(lines)
    assert old in text
    path = folder / "log.dat"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def test_logs_of_assignments_are_read(tmp_path):
    test = read_deviations(log(tmp_path))
    assert test["deviation"].values[:, 0, :] == pytest.approx(np.array([[1.0, 1.0], [2.0, 2.0]]))
    assert test["time"].attrs["origin"] == "none"


def test_of_an_assignment_that_is_repeated_the_first_is_kept_and_the_other_listed(tmp_path):
    again = "REF_DATA_FWD[1,1]=10.001\nREF_DATA_FWD[1,1]=99\nTGT_DATA[1]=0"
    test = read_deviations(log(tmp_path, "REF_DATA_FWD[1,1]=10.001", again))
    assert test["deviation"].values[0, 0, 0] == pytest.approx(1.0)
    assert [one["line"] for one in json.loads(test.attrs["left_out"])] == [7, 8]


def test_a_report_of_these_logs_is_read_with_its_directions_and_says_that_they_may_be_exchanged(tmp_path):
    head = "i |tgt_pos(i) [mm]|ref_pos(i,1) [mm]|ref_pos(i,2) [mm]|\n--- |--- |--- |--- |\n"
    blocks = [
        f"### Data {way}ward direction\n\ntgt_pos(i) = Target position [mm]\n\n{head}1|10.0|10.00{k}|10.00{k + 1}|\n2|20.0|20.01|20.02|\n"
        for way, k in (("for", 1), ("back", 3))
    ]
    means = "#### Positioning deviation forward direction\n\ni |x(i,1) [mm]|x(i,2) [mm]|\n--- |--- |--- |\n1|9|9|\n"
    path = tmp_path / "report.md"
    path.write_text("# ISO 230-2 motion test\n" + "\n".join([*blocks, means]))
    test = read_deviations(path)
    assert test["deviation"].values == pytest.approx(np.array([[[1, 10], [3, 10]], [[2, 20], [4, 20]]]))
    assert test["position"].values.tolist() == [10.0, 20.0]
    assert "public programs that write it exchange them" in test.attrs["notes"]
    path.write_text(path.read_text().replace("|ref_pos(i,2) [mm]", "|ref_pos(i,2) [um]"))
    with pytest.raises(LaserFormatError, match=r"line 8: .* is no line of a target and 3 positions in one unit"):
        read_deviations(path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le"])
def test_a_linear_test_in_other_case_and_encoding_is_the_same(tmp_path, encoding):
    path = rtl(tmp_path)
    test = read_deviations(path)
    path.write_bytes(path.read_bytes().decode("latin-1").upper().encode(encoding))
    assert read_deviations(path).equals(test)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("UNIT=mm", "UNIT=inch", "UNIT=inch is not known; use one of mm, um, m"),
        ("CYCLES=2", "CYCLES=5", "CYCLES=5, but 2 were found"),
        ("TGT_DATA[2]", "TGT_DATA[3]", r"TGT_DATA gives targets \[1, 3\]"),
    ],
)
def test_logs_that_break_their_promises_are_refused(tmp_path, old, new, message):
    with pytest.raises(LaserFormatError, match=message):
        read_ecmc_log(log(tmp_path, old, new))
