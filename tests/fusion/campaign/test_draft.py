"""Campaign files for folders: what the files tell, what is asked, and a check that says what is missing."""

import os
import shutil
from collections import Counter

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.campaign.draft import Asker, DraftError, draft_lines, unused_files, write_campaign, write_campaigns
from fusion.campaign.inspect import scan_folder
from fusion.campaign.schema import known_keys
from fusion.campaign.values import QuantityError
from fusion.pipeline.check import check_campaign
from fusion.pipeline.fleet import find_members
from tests.fusion.campaign_parts import write_laser
from thermography.io.flir import index_frames
from thermography.radiometry.planck import calibrate

pytestmark = pytest.mark.long

ANSWERS = {
    "Title of the report": 'The "small" one',
    "Spindle at axis position 0, x": "500 mm",
    "Spindle at axis position 0, y": "90 mm",
    "How that point moves as the position grows": "left",
    "Material sensor, x": "640 mm",
    "Material sensor, y": "30 mm",
    "Size of a cell of the field": "20 mm",
}


def answering(question: str, default: str) -> str:
    return next((answer for begin, answer in ANSWERS.items() if question.startswith(begin)), default)


def test_answers_make_a_campaign_that_is_ready(copied):
    original = load_campaign(copied / "campaign.toml")
    (copied / "campaign.toml").unlink()
    path, missing = write_campaign(copied, Asker(answering))
    assert missing == [] and check_campaign(path).faults == ()
    written = load_campaign(path)
    assert written.campaign.title == 'The "small" one'
    assert written.plan == original.plan
    assert written.interferometry.material_sensor_mm == (640.0, 30.0)
    assert written.input_files() == original.input_files()


def test_without_answers_the_missing_lines_are_marked_and_the_check_names_them(copied):
    (copied / "campaign.toml").unlink()
    path, missing = write_campaign(copied, Asker(None))
    assert [line.split(": ")[1].split(" = ")[0] for line in missing] == ["origin", "direction"]
    faults = check_campaign(path).faults
    numbers = {line.split(":")[0].removeprefix("line ") for line in missing}
    assert {fault.split(", line ")[1].split(":")[0] for fault in faults} == numbers


def test_a_folder_of_frames_alone_is_ready_with_the_picture_as_its_plan(copied):
    path, missing = write_campaign(copied / "thermal", Asker(None))
    campaign = load_campaign(path)
    assert missing == [] and campaign.plan.in_pixels and campaign.campaign.axis == ""
    checked = check_campaign(path)
    assert checked.faults == () and any("plan: the picture itself" in line for line in checked.content)
    path.unlink()
    in_mm = Asker(lambda question, default: "fiducials" if question.startswith("No table of fiducials") else default)
    _, missing = write_campaign(copied / "thermal", in_mm)
    assert [line.split(" = ")[0].split(": ")[1] for line in missing] == ["size", "fiducials"]


def test_times_without_a_zone_are_asked_for(copied):
    (copied / "campaign.toml").unlink()
    laser = copied / "laser.csv"
    text = laser.read_text()
    laser.write_text(text.replace("+00:00", ""))
    asked = []

    def vienna(question, default):
        asked.append(question)
        return (
            "Europe/Vienna"
            if question.startswith("Time zone of the times of the deviations")
            else answering(question, default)
        )

    path, _ = write_campaign(copied, Asker(vienna))
    assert load_campaign(path).campaign.time_zone == "Europe/Vienna"
    path.unlink()
    write_campaign(copied, Asker(None))
    assert 'time_zone = "UTC"   # taken, as the file gives none: check it' in path.read_text()
    path.unlink()
    laser.write_text(text)
    asked.clear()
    write_campaign(copied, Asker(vienna))
    assert not any("zone" in question for question in asked)


def test_a_file_of_readings_with_a_fault_is_written_down_and_left_to_the_check(copied):
    (copied / "campaign.toml").unlink()
    (copied / "laser.csv").write_text("cycle,direction,target,position_mm,time,deviation_um\nx,y,z,a,b,c\n")
    path, _ = write_campaign(copied, Asker(answering))
    assert any("laser.csv" in fault for fault in check_campaign(path).faults)


def test_a_folder_without_measurements_is_refused(tmp_path):
    with pytest.raises(DraftError, match="neither thermal frames nor deviations nor a record"):
        write_campaign(tmp_path, Asker(None))
    (tmp_path / "notes.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DraftError, match=r"in it \(notes.csv: "):
        write_campaign(tmp_path, Asker(None))
    assert not (tmp_path / "campaign.toml").exists()
    (tmp_path / "notes.csv").write_text("\ufeff0.1,20.1,21.5\n1,20.2,21.6\n2,20.4,21.8\n", encoding="utf-8")
    with pytest.raises(
        DraftError, match=r"notes.csv: a table of 3 columns and 3 rows without a displacement, which a record needs"
    ):
        write_campaign(tmp_path, Asker(None))
    with pytest.raises(DraftError, match="no such folder"):
        write_campaign(tmp_path / "absent", Asker(None))


def test_runs_of_a_record_are_one_campaign(tmp_path):
    seconds = np.arange(0, 36_000, 60)
    warm = 20 + 5 * (1 - np.exp(-seconds / 9000))
    rows = "".join(f"{s},{t:.3f},{3 * (t - 20):.3f},{s % 7}\n" for s, t in zip(seconds, warm, strict=True))
    (tmp_path / "run_1.csv").write_text(f"time [s],t1 [degC],ch1 [um],speed [1/min]\n{rows}")
    backwards = "".join(",".join(reversed(row.split(","))) + "\n" for row in rows.splitlines())
    (tmp_path / "run_2.csv").write_text(f"speed [1/min],ch1 [um],t1 [degC],time [s]\n{backwards}")
    (tmp_path / "other.csv").write_text(f"time [s],t1 [degC],ch9 [um],speed [1/min]\n{rows}")
    path, missing = write_campaign(tmp_path, Asker(None))
    record = load_campaign(path).record
    assert missing == []
    # The first file decides, and the one with other columns is named beside it.
    assert record.file == "other.csv" and '# file = "run_1.csv"   # also found' in path.read_text()
    assert len(unused_files(path)) == 2 and all("the same columns" in line for line in unused_files(path))
    (tmp_path / "other.csv").unlink()
    path.unlink()
    write_campaign(tmp_path, Asker(None))
    record = load_campaign(path).record
    assert record.files == ("run_1.csv", "run_2.csv")
    assert {name: column.role for name, column in record.columns.items()} == {
        "t1 [degC]": "temperature", "ch1 [um]": "displacement", "speed [1/min]": "driver",
    }  # fmt: skip
    assert check_campaign(path).faults == ()


def test_names_from_files_stay_text(tmp_path):
    """A file name with a quote and a line break, in a folder of the same kind, makes no key of its own."""
    folder = tmp_path / 'a"\n[accept]'
    folder.mkdir()
    (folder / "x.csv").write_text("time [s],t1 [degC],ch1 [um]\n0,20,0\n")
    (folder / "y\nz.txt").write_text("nothing\n")
    lines = "\n".join(draft_lines(scan_folder(folder), Asker(None)))
    assert "\n[accept]" not in lines and "#   y z.txt: " in lines


@pytest.mark.real_data
def test_the_public_spindle_record_is_ready_at_once(real_file, tmp_path):
    (tmp_path / "data.xlsx").write_bytes(real_file("CAIVIAC__FL_THERMAL/data/data.xlsx").read_bytes())
    path, missing = write_campaign(tmp_path, Asker(None))
    record = load_campaign(path).record
    assert missing == []
    assert Counter(column.role for column in record.columns.values()) == {
        "temperature": 16,
        "displacement": 5,
        "driver": 1,
    }
    assert check_campaign(path).faults == ()


def test_frames_of_another_camera_are_ready_with_their_times_from_the_names(copied):
    frames, _ = index_frames(sorted((copied / "thermal").iterdir()))
    for frame in frames:
        stamp = str(frame.time.astype("datetime64[s]")).replace("-", "").replace(":", "").replace("T", "_")
        np.save(copied / "thermal" / f"IR_{stamp}.npy", calibrate(frame.read_counts(), frame.parameters))
        frame.path.unlink()
    (copied / "campaign.toml").unlink()
    path, missing = write_campaign(copied, Asker(answering))
    checked = check_campaign(path)
    assert missing == [] and checked.faults == ()
    # The emissivity that nobody stated is a notice, not an implausible stored value of 1.
    assert "stack_emissivity_unknown" in {notice.code for notice in checked.notices}
    assert "camera_parameters" not in {doubt.code for doubt in checked.doubts}
    written = load_campaign(path).thermography
    assert (written.frames, written.stack.unit) == (("thermal/*.npy",), "degC")
    assert written.stack.time_in_name == "%Y%m%d_%H%M%S"


def test_what_frames_of_another_camera_do_not_tell_is_marked(tmp_path):
    np.save(tmp_path / "a.npy", np.full((2, 8, 9), 7329, np.uint16))
    text = "\n".join(draft_lines(scan_folder(tmp_path), Asker(None)))
    for line in (
        'frames = ["*.npy"]',
        'scale = "FILL IN"',
        'unit = "FILL IN"',
        'start = "FILL IN"',
        'interval = "FILL IN"',
    ):
        assert f"\n{line}" in text


@pytest.mark.parametrize(
    ("shape", "level", "expected"),
    [
        ((30, 40, 50), 22.3, ('axes = "FILL IN"', 'unit = "degC"')),  # 40 x 50 and 30 x 40 are pictures
        ((5, 24, 32), 71.6, ('unit = "FILL IN"', 'start = "FILL IN"')),  # 22 degC in degF
        ((5, 24, 32), 219.0, ('unit = "FILL IN"',)),  # 21.9 degC in tenths
        ((24, 33, 200), 295.2, ('unit = "K"', 'interval = "FILL IN"')),  # 33 x 200 is no picture
    ],
)
def test_axes_and_units_that_frames_do_not_tell_are_asked(tmp_path, shape, level, expected):
    np.save(tmp_path / "a.npy", np.full(shape, level))
    text = "\n".join(draft_lines(scan_folder(tmp_path), Asker(None)))
    assert all(f"\n{line}" in text for line in expected)


def test_laser_tests_of_one_folder_become_a_campaign_each_and_questions_are_asked_once(tmp_path):
    laser = write_laser(tmp_path.with_name("written"), 5, 4).with_name("laser.csv")
    for axis in ("x", "y", "other"):
        shutil.copy(laser, tmp_path / f"report_{axis}.csv")
    shutil.copy(tmp_path / "report_x.csv", tmp_path / "report_x.txt")
    (tmp_path / "ecmc.dat").write_text(
        "TGT_SET_PV=TARGET_DU:Z-PosCmd\nUNIT=mm\nCYCLES=2\nPOSITIONS=2\nTGT_DATA[1]=0\nTGT_DATA[2]=4\n"
        + "".join(
            f"REF_DATA_{way}[{i},{j}]={4 * (i - 1) + 0.01 * i * j}\n"
            for way in ("FWD", "BWD")
            for i in (1, 2)
            for j in (1, 2)
        )
    )
    asked = []

    def answer(question, default):
        asked.append(question)
        if question.startswith("Dead path") and asked.count(question) == 1:
            return "5 kg"
        return "U" if question.startswith("Axis that report_other.csv is of") else default

    written = write_campaigns(tmp_path, Asker(answer))
    names = ["ecmc", "report_other", "report_x_csv_campaign", "report_x_txt_campaign", "report_y"]
    assert [path.parent.name for path, _ in written] == names
    # A refused answer is asked for again, and nothing else twice.
    assert [question for question, count in Counter(asked).items() if count > 1] == ["Dead path of the laser"]
    campaigns = [load_campaign(path) for path, _ in written]
    assert [one.campaign.axis for one in campaigns] == ["Z", "U", "X", "X", "Y"]
    assert all(check_campaign(path).faults == () for path, _ in written)
    assert [member.campaign for member in find_members([tmp_path])] == [path for path, _ in written]
    with pytest.raises(DraftError, match="exists already"):
        write_campaigns(tmp_path, Asker(answer))


def test_a_rotary_axis_is_asked_nothing_about_lengths(tmp_path):
    rows = [f"{angle};0,5;-0,5;0,7;-0,4" for angle in range(0, 361, 45)]
    (tmp_path / "C_axis.csv").write_text("\n".join(["Angle [deg];1 + [arcsec];1 -;2 +;2 -", *rows]))
    asked = []
    path, missing = write_campaign(tmp_path, Asker(lambda question, default: asked.append(question) or default))
    assert len(asked) == 2 and not missing and load_campaign(path).campaign.axis == "C"
    assert check_campaign(path).faults == ()
    path.write_text(f'{path.read_text()}\n[acceptance]\nA = "5 um"\n')
    assert "limits of a length" in check_campaign(path).faults[0]


def test_measured_files_that_the_campaign_does_not_take_are_told(tmp_path):
    heading = "cycle,direction,target,position_mm,time,deviation_um\n"
    for name in ("run_1.csv", "run_2.csv"):
        (tmp_path / name).write_text(f"{heading}1,+,1,0,2026-03-09T06:30:00Z,0.1\n1,+,2,50,2026-03-09T06:31:00Z,0.2\n")
    (tmp_path / "places.csv").write_text("name,x_mm,y_mm\nT1,50,50\nT2,150,50\n")
    (tmp_path / "notes.md").write_text("# Notes\n")
    path, _ = write_campaign(tmp_path, Asker(None))
    told = unused_files(path)
    assert sorted(line.split(":")[0] for line in told) == ["notes.md", "places.csv", "run_2.csv"]
    assert "run_2.csv: deviations; one campaign takes one file of deviations: join the tables of one test" in told
    assert load_campaign(path).interferometry is not None


def test_loggers_in_files_of_their_own_are_told_to_be_one_table(tmp_path):
    for name, heading in (("temperatures", "T1 [degC]"), ("probe", "Z [um]")):
        rows = [f"2026-03-09T06:{k:02}:00Z,{20 + k / 9:.2f}" for k in range(60)]
        (tmp_path / f"{name}.csv").write_text("\n".join([f"time,{heading}", *rows]))
    with pytest.raises(DraftError, match="write the rows of all loggers into one table with the columns of all"):
        write_campaign(tmp_path, Asker(None))


#: HOBO's export, with channels that only their places tell apart, and a sensor of the air: neither has the material of an environment.
LOGS = {
    "hobo": (
        '"Plot Title: shop"\n"#","Date Time, GMT+00:00","Temp, °C (LGR S/N: 20750528, LBL: air)","Temp, °C (LGR S/N: 20750528, LBL: bed)"',
        "{n},03/09/26 {h:02}:{m:02}:26 AM,{air:.3f},{bed:.3f}",
        ("LBL: air", "LBL: bed"),
    ),
    "bme280": (
        "Timestamp,Temperature (°C),Humidity (%),Pressure (hPa)",
        "2026-03-09T{h:02}:{m:02}:26+00:00,{air:.2f},{bed:.1f},100{n}.5",
        ("Temperature",),
    ),
}


@pytest.mark.parametrize("log", LOGS)
def test_a_log_of_temperatures_beside_a_laser_is_offered_as_drivers(tmp_path, log):
    folder = write_laser(tmp_path / "test", 5, 4).parent
    (folder / "campaign.toml").unlink()
    head, row, columns = LOGS[log]
    rows = [row.format(n=k % 9, h=6 + k // 60, m=k % 60, air=21 + k / 99, bed=20 + k / 99) for k in range(300)]
    (folder / f"{log}.csv").write_text("\n".join([head, *rows]))
    path, _ = write_campaign(folder, Asker(None))
    assert f"{log}.csv: temperatures without a displacement; [drivers] above names it in comments" in unused_files(path)
    assert check_campaign(path).faults == ()
    above, below = path.read_text().split("# [drivers]")
    path.write_text(f"{above}[drivers]{below.replace(chr(10) + '# ', chr(10))}".split("Files in this folder")[0])
    read = check_campaign(path)
    assert read.faults == () and any(all(name in line for name in columns) for line in read.lines())


@pytest.mark.skipif(os.name != "posix", reason="names of files are bytes on POSIX systems only")
def test_a_name_that_is_no_text_is_refused(tmp_path):
    name = os.fsdecode(b"\xff.csv")
    (tmp_path / name).write_text(
        "cycle,direction,target,position_mm,deviation_um\n1,positive,1,0,1\n1,positive,2,9,1\n"
    )
    with pytest.raises(DraftError, match=r"is not UTF-8 .*\\udcff.*another name"):
        write_campaign(tmp_path, Asker(None, print))
    assert not (tmp_path / "campaign.toml").exists()


def test_a_folder_of_results_gets_no_campaign_file(tmp_path):
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(DraftError, match="holds the results of a run; name the folder that holds the files"):
        write_campaign(tmp_path, Asker(None, print))
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_nothing_is_asked_without_a_terminal_and_a_useless_answer_is_asked_again():
    silent = Asker(None)
    assert silent.text("Title", "A") == "A"
    width = known_keys()["plan.size.0"]
    assert silent.value(width, "5 mm") == "5 mm" and silent.value(width) == ""
    assert silent.choice("Which", ("a", "b")) == "a"
    with pytest.raises(QuantityError):
        silent.value(width, "5")
    answers, told = iter(["5", "5 K", "5 mm", "c", "b"]), []
    asker = Asker(lambda question, default: next(answers), told.append)
    assert asker.value(width) == "5 mm"
    assert asker.choice("Which", ("a", "b")) == "b"
    assert len(told) == 3 and "needs its unit" in told[0] and told[2] == '"c" is not one of the choices'


def test_the_sheet_to_sign_is_asked_for_in_few_questions_and_enter_skips(tmp_path):
    write_laser(tmp_path / "test", 6, 5)
    folder = tmp_path / "test"
    (folder / "campaign.toml").unlink()
    given = {
        "Machine": "Mill 900",
        "Tolerance": ["20 um", "A 20 um, Q 3 um", "A 20 um, R 8", "A 20 um, R = 8 um"],
        "Travel": "travel 900 mm, lead 10 mm, feed 6 m/min, dwell 3 s",
        "Operator": "J. Doe",
        "Report number": "17",
        "Instrument": "laser",
        "Day of its": ["15.1.2026", "2026-01-15"],
        "Certificate": "C-17",
    }
    said = []

    def ask(question: str, default: str) -> str:
        found = next((key for key in given if question.startswith(key)), None)
        answer = default if found is None else given[found]
        return answer.pop(0) if isinstance(answer, list) else answer

    path, missing = write_campaign(folder, Asker(ask, said.append))
    campaign = load_campaign(path)
    report, (instrument,) = campaign.report, campaign.report.instrument
    assert missing == [] and campaign.acceptance.limits() == {"A": 20.0, "R": 8.0}
    assert (report.axis_travel_mm, report.screw_lead_mm, report.feed_mm_per_min, report.dwell_s) == (900, 10, 6000, 3)
    assert (report.machine, report.operator, report.report_number, report.customer) == ("Mill 900", "J. Doe", "17", "")
    assert (instrument.name, instrument.certificate, instrument.calibrated.isoformat()) == (
        "laser",
        "C-17",
        "2026-01-15",
    )
    assert len(said) == 4  # no symbol, no quantity of the standard, no unit, a day in another order


def test_tolerances_and_conditions_need_no_name_of_the_machine(tmp_path):
    write_laser(tmp_path / "test", 6, 5)
    (tmp_path / "test" / "campaign.toml").unlink()
    given, asked = {"Tolerance": "B 5 um", "Travel": "lead 10 mm"}, []

    def ask(question: str, default: str) -> str:
        asked.append(question)
        return next((answer for key, answer in given.items() if question.startswith(key)), default)

    path, _ = write_campaign(tmp_path / "test", Asker(ask))
    campaign = load_campaign(path)
    assert campaign.acceptance.limits() == {"B": 5.0} and campaign.report.screw_lead_mm == 10.0
    assert campaign.report.machine == "" and not [one for one in asked if one.startswith(("Operator", "Instrument"))]


def test_the_kind_of_a_test_of_a_record_is_asked_for(tmp_path):
    rows = [f"{60 * k},{20 + k / 9:.2f},{k / 3:.2f},{k / 5:.2f}" for k in range(300)]
    (tmp_path / "log.csv").write_text("\n".join(["time [s],T1 [degC],Y1 [um],Y2 [um]", *rows]) + "\n")
    path, _ = write_campaign(tmp_path, Asker(None))
    assert load_campaign(path).thermal_test.kind is None
    path.unlink()
    path, _ = write_campaign(tmp_path, Asker(lambda question, default: "spindle" if "230-3" in question else default))
    assert load_campaign(path).thermal_test.kind == "spindle"
