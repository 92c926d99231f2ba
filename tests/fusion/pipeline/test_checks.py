"""The check finds what a run would refuse, all of it at once where it can, and leaves nothing behind."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

from fusion.analysis.alignment.align import AlignmentError
from fusion.analysis.consistency import RULES
from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inputs import read_source
from fusion.pipeline.check import check_campaign
from fusion.pipeline.consistency import ContradictionError
from fusion.pipeline.run import run_campaign
from fusion.report.findings import summary_rows
from fusion.results.results import read_results
from tests.fusion.campaign_parts import change, keep_cycles, record_of_rows, without


def with_readings(folder, values):
    """Write other deviations into the table of the laser."""
    table = pd.read_csv(folder / "laser.csv")
    table["deviation_um"] = values(table)
    table.to_csv(folder / "laser.csv", index=False)


def copied_cycle(table):
    """Cycle 13 holds the deviations of cycle 12."""
    deviation = table["deviation_um"].copy()
    deviation[table["cycle"] == 13] = deviation[table["cycle"] == 12].to_numpy()
    return deviation


def test_a_sound_campaign_is_ready(campaign_folder):
    before = sorted(campaign_folder.rglob("*"))
    checked = check_campaign(campaign_folder / "campaign.toml")
    lines = checked.lines()
    assert checked.faults == () and lines[-1].startswith("ready to run: ")
    assert "  readings: 24 cycles, 6 targets from 0 to 250 mm, 288 of 288" in lines
    assert {recording.name for recording in checked.recordings} == {"frames", "readings", "environment", "drivers"}
    assert any(line.startswith("  readings     █") for line in lines)
    assert sorted(campaign_folder.rglob("*")) == before
    told = json.loads(json.dumps(checked.as_json()))
    assert told["ready"] is True and told["recordings"][0]["stretches"][0][0].endswith("Z")


def test_an_axis_beyond_the_plan_is_found_before_the_frames_are_reduced(copied):
    file = change(copied / "campaign.toml", 'origin = ["', 'origin = ["1')
    (fault,) = check_campaign(file).faults
    assert fault.startswith(f"{file}: plan.axis: the measured line leaves the plan: axis position")
    with pytest.raises(AlignmentError, match=r"plan.axis: .*check origin and direction"):
        read_source(load_campaign(file))


def test_every_broken_file_is_named(copied):
    (copied / "fiducials.csv").write_text("name\nF1\n")
    (copied / "environment.csv").write_text("time\n")
    (copied / "laser.csv").write_text("cycle,direction\n1,positive\n")
    checked = check_campaign(copied / "campaign.toml")
    assert len(checked.faults) == 3
    for name in ("laser.csv", "environment.csv", "fiducials.csv"):
        assert sum(name in fault for fault in checked.faults) == 1
    assert checked.lines()[-1] == "not ready: 3 faults"


def test_quiet_leaves_faults_and_doubts(copied):
    assert check_campaign(copied / "campaign.toml").lines(quiet=True) == []
    absent = check_campaign(copied / "absent.toml")
    (line,) = absent.lines(quiet=True)
    assert line.startswith(f"fault: {copied / 'absent.toml'}: no such campaign file")


def shift_table(path, column, minutes):
    """Write the times of a table as those of a clock that is late."""
    table = pd.read_csv(path, dtype=str)
    late = pd.to_datetime(table[column], utc=True, format="ISO8601") + pd.Timedelta(minutes=minutes)
    table.assign(**{column: late.map(pd.Timestamp.isoformat)}).to_csv(path, index=False)


@pytest.mark.parametrize(
    ("file", "code", "heading", "key"),
    [
        ("laser.csv", "laser_clock", "interferometry", "clock_offset"),
        ("environment.csv", "environment_clock", "interferometry", "environment_clock_offset"),
        ("drivers.csv", "drivers_clock", "drivers", "clock_offset"),
    ],
)
def test_a_table_an_hour_off_is_named_and_put_right_by_its_key(copied, file, code, heading, key):
    path = copied / "campaign.toml"
    shift_table(copied / file, "time", 60.0)
    told = [*check_campaign(path).doubts, *check_campaign(path).faults]
    assert len(told) == 1 and f'{key} = "3600 s" under [{heading}]' in str(told[0])
    change(path, f"[{heading}]\n", f'[{heading}]\n{key} = "1 h"\n')
    assert check_campaign(path).doubts == [] and check_campaign(path).faults == ()


def test_a_camera_an_hour_off_is_named(copied):
    path = change(copied / "campaign.toml", 'clock_offset = "0 s"', 'clock_offset = "1 h"')
    (fault,) = check_campaign(path).faults
    assert "The clock of the frames is 1 h early" in fault and "frames_coverage" in fault
    assert 'clock_offset = "0 s" under [thermography]' in fault


def test_a_doubt_is_named_and_does_not_refuse(copied):
    with_readings(copied, copied_cycle)
    checked = check_campaign(copied / "campaign.toml")
    assert checked.faults == () and [one.code for one in checked.doubts] == ["copied_cycles"]
    assert checked.lines()[-1].endswith(", 1 doubt")
    accepted = change(copied / "campaign.toml", "[model]", '[accept]\ndoubts = ["copied_cycles"]\n\n[model]')
    assert check_campaign(accepted).doubts == []


def test_a_record_is_checked(tmp_path):
    seconds = np.arange(0, 36_000, 60)
    rng = np.random.default_rng(5)
    warm = 20 + 5 * (1 - np.exp(-seconds / 9000))
    rows = [f"{s},{t:.3f},{3 * (t - 20) + 0.1 * rng.standard_normal():.3f}" for s, t in zip(seconds, warm, strict=True)]
    file = record_of_rows(tmp_path, *rows)
    checked = check_campaign(file)
    assert checked.faults == () and checked.content == ("record: 1 run, 1 temperature, 1 displacement, 600 rows",)
    assert 'no column is named "z*"' in check_campaign(change(file, '["ch*"]', '["z*"]')).faults[0]


def test_a_campaign_of_one_instrument_is_checked_for_what_it_has(copied):
    campaign = copied / "campaign.toml"
    laser = check_campaign(without(campaign, "thermography", "plan", "model", name="checked_laser.toml"))
    camera = check_campaign(without(campaign, "interferometry", "model", name="checked_camera.toml"))
    assert laser.faults == () and camera.faults == ()
    assert [bar.name for bar in laser.recordings] == ["readings", "environment", "drivers"]
    assert [bar.name for bar in camera.recordings] == ["frames", "drivers"]
    assert laser.content[0].startswith("readings: 24 cycles") and camera.content[0].startswith("frames: ")


def test_a_sound_campaign_passes_every_check(results_folder):
    inputs = read_results(results_folder).inputs
    assert inputs.state == "sound"
    assert {check.code for check in inputs.checks} <= set(RULES)
    assert all(check.passed for check in inputs.checks)


def test_a_contradiction_is_refused_before_a_folder_is_made(copied, tmp_path):
    shift_table(copied / "drivers.csv", "time", -1440.0)
    checked = check_campaign(copied / "campaign.toml")
    assert len(checked.faults) == 1 and checked.doubts == []
    with pytest.raises(ContradictionError, match=r"drivers\.csv .* covers 0 % of the readings"):
        run_campaign(copied / "campaign.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.chain
@pytest.mark.usefixtures("no_charts", "few_effects")
def test_a_doubt_is_named_first_and_makes_the_verdict_conditional(copied, results_folder, tmp_path):
    with_readings(copied, lambda table: -table["deviation_um"])
    results = run_campaign(copied / "campaign.toml", shutil.copytree(results_folder, tmp_path / "out"), resume=True)
    assert results.inputs.state == "doubted"
    assert "axis_line" in [check.code for check in results.inputs.doubts]
    assert results.warnings[0].code.startswith("doubt_")
    name, text = summary_rows(results)[0]
    assert name == "inputs" and text.startswith("doubted: ")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Doubted input." in page and "Only if " in page
    conditional = {figure for check in results.inputs.doubts for figure in check.conditional}
    assert "causes" in conditional
    sizes = dict(summary_rows(results))["how much"]
    assert ("only if" in sizes.lower()) is ("positions" in conditional)


@pytest.mark.usefixtures("no_charts")
@pytest.mark.chain
def test_a_doubt_can_be_accepted_and_an_unknown_one_is_refused(copied, tmp_path):
    with_readings(copied, copied_cycle)
    # Nine cycles about the copy are too few for a model.
    keep_cycles(copied / "laser.csv", *range(6, 15))
    path = without(
        copied / "campaign.toml", "thermography", "plan", "model", added='[accept]\ndoubts = ["copied_cycles"]\n'
    )
    inputs = run_campaign(path, tmp_path / "out").inputs
    assert (inputs.state, inputs.accepted) == ("sound", ("copied_cycles",))
    with pytest.raises(CampaignError, match=r"accept\.doubts = 'weather': no such check; there are"):
        run_campaign(change(path, "copied_cycles", "weather"), tmp_path / "other")
