"""The check finds what a run would refuse, all of it at once where it can, and leaves nothing behind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fusion.alignment.align import AlignmentError
from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_source
from fusion.starting.check import check_campaign
from tests.fusion.campaign_parts import without


def change(campaign: Path, old: str, new: str) -> Path:
    file = campaign / "campaign.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return file


def test_a_sound_campaign_is_ready(campaign_folder: Path) -> None:
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


def test_an_axis_beyond_the_plan_is_found_before_the_frames_are_reduced(copied: Path) -> None:
    file = change(copied, 'origin = ["', 'origin = ["1')
    (fault,) = check_campaign(file).faults
    assert fault.startswith(f"{file}: plan.axis: the measured line leaves the plan: axis position")
    with pytest.raises(AlignmentError, match=r"check \[plan.axis\] origin and direction"):
        read_source(load_campaign(file))


def test_every_broken_file_is_named(copied: Path) -> None:
    (copied / "fiducials.csv").write_text("name\nF1\n")
    (copied / "environment.csv").write_text("time\n")
    (copied / "laser.csv").write_text("cycle,direction\n1,positive\n")
    checked = check_campaign(copied / "campaign.toml")
    assert len(checked.faults) == 3
    for name in ("laser.csv", "environment.csv", "fiducials.csv"):
        assert sum(name in fault for fault in checked.faults) == 1
    assert checked.lines()[-1] == "not ready: 3 faults"


def test_every_fault_of_the_campaign_file_is_named(copied: Path) -> None:
    file = change(copied, 'cell_size = "20 mm"', "cell_size = 20\ncolour = 3")
    faults = check_campaign(file).faults
    assert len(faults) == 2 and all(f"{file}, line" in fault for fault in faults)


def test_quiet_leaves_faults_and_doubts(copied: Path) -> None:
    assert check_campaign(copied / "campaign.toml").lines(quiet=True) == []
    absent = check_campaign(copied / "absent.toml")
    assert absent.lines(quiet=True) == [
        f"fault: {copied / 'absent.toml'}: no such campaign file; check the name or give its full path"
    ]


def test_a_doubt_is_named_and_does_not_refuse(copied: Path) -> None:
    """Readings of the last three cycles copied from the cycles before."""
    lines = (copied / "laser.csv").read_text().splitlines()
    fields = [line.split(",") for line in lines]
    name = fields[0].index("deviation_um")
    last = {tuple(row[:3]): row for row in fields[1:]}
    for (cycle, direction, target), row in last.items():
        if int(cycle) > 21:
            row[name] = last[(str(int(cycle) - 3), direction, target)][name]
    (copied / "laser.csv").write_text("\n".join(",".join(row) for row in fields) + "\n")
    checked = check_campaign(copied / "campaign.toml")
    assert checked.faults == () and [one.code for one in checked.doubts] == ["copied_cycles"]
    assert checked.lines()[-1].endswith(", 1 doubt")
    accepted = change(copied, "[model]", '[accept]\ndoubts = ["copied_cycles"]\n\n[model]')
    assert check_campaign(accepted).doubts == []


def test_a_record_is_checked(tmp_path: Path) -> None:
    seconds = np.arange(0, 36_000, 60)
    rng = np.random.default_rng(5)
    warm = 20 + 5 * (1 - np.exp(-seconds / 9000))
    rows = [f"{s},{t:.3f},{3 * (t - 20) + 0.1 * rng.standard_normal():.3f}" for s, t in zip(seconds, warm, strict=True)]
    (tmp_path / "a.csv").write_text("time [s],t1 [degC],ch1 [um]\n" + "\n".join(rows) + "\n")
    file = tmp_path / "campaign.toml"
    file.write_text(
        '[campaign]\ntitle = "R"\n[record]\nfile = "a.csv"\ntime = "time [s]"\ntemperatures = ["t*"]\ndisplacements = ["ch*"]\n'
    )
    checked = check_campaign(file)
    assert checked.faults == () and checked.content == ("record: 1 run, 1 temperature, 1 displacement, 600 rows",)
    file.write_text(file.read_text().replace('["ch*"]', '["z*"]'))
    assert 'no column is named "z*"' in check_campaign(file).faults[0]


def test_a_campaign_of_one_instrument_is_checked_for_what_it_has(copied: Path) -> None:
    campaign = copied / "campaign.toml"
    laser = check_campaign(without(campaign, "thermography", "plan", "model", name="checked_laser.toml"))
    camera = check_campaign(without(campaign, "interferometry", "model", name="checked_camera.toml"))
    assert laser.faults == () and camera.faults == ()
    assert [bar.name for bar in laser.recordings] == ["readings", "environment", "drivers"]
    assert [bar.name for bar in camera.recordings] == ["frames", "drivers"]
    assert laser.content[0].startswith("readings: 24 cycles") and camera.content[0].startswith("frames: ")
