"""A fleet of three small campaigns, one of them broken: in processes of their own, resumed, stopped, and within the memory."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import psutil
import pytest

from fusion.fleet import run as fleet_run
from fusion.fleet.members import find_members
from fusion.fleet.run import run_fleet
from fusion.products.store import OutputError
from tests.fusion.campaign_parts import without


@pytest.fixture(scope="module")
def hall(campaign_folder, tmp_path_factory):
    """Two machines measured by the laser alone, and one whose readings are not there."""
    folder = tmp_path_factory.mktemp("fleet") / "hall"
    part = without(
        campaign_folder / "campaign.toml", "thermography", "plan", "plan.axis", "model", name="laser_only.toml"
    )
    text = part.read_text()
    part.unlink()
    for name in ("a", "b", "c"):
        shutil.copytree(campaign_folder, folder / name, ignore=shutil.ignore_patterns("thermal"))
        (folder / name / "campaign.toml").write_text(text + "\n[model]\ndeclared = []\n")
    # Five cycles are enough to evaluate, and take the least time.
    for name in ("a", "c"):
        lines = (folder / name / "laser.csv").read_text().splitlines()
        kept = [line for line in lines if not line[0].isdigit() or int(line.split(",")[0]) <= 5]
        (folder / name / "laser.csv").write_text("\n".join(kept) + "\n")
    (folder / "b" / "laser.csv").unlink()
    return folder


def test_one_that_fails_stops_no_other_and_the_next_fleet_keeps_what_is_finished(hall, tmp_path):
    out, ended, told = tmp_path / "out", [], []
    members = find_members([hall])
    how = {"report": lambda label, done, total: told.append((done, total))}
    rows = run_fleet(members, out, jobs=2, say=lambda row: ended.append(row.name), **how)
    assert [(row.name, row.state, row.exit_code) for row in rows] == [
        ("a", "finished", 0),
        ("b", "failed", 2),
        ("c", "finished", 0),
    ]
    assert sorted(ended) == ["a", "b", "c"]
    assert told[0] == (0, 3) and told[-1] == (3, 3)
    assert "laser.csv" in rows[1].message
    assert rows[0].peak_MB > 50 and rows[0].seconds > 0
    for row in rows:
        assert (out / row.log).is_file()
    assert (out / rows[0].report).is_file() and not rows[1].report
    assert {"fleet.json", "fleet.csv", "fleet.html", "manifest.json"} <= {path.name for path in out.iterdir()}
    with pytest.raises(OutputError, match="is not empty; add --resume"):
        run_fleet(members, out)
    # Only what failed is run again.
    shutil.copy(hall / "a" / "laser.csv", hall / "b" / "laser.csv")
    ended.clear()
    again = run_fleet(members, out, resume=True, say=lambda row: ended.append(row.name))
    assert ended == ["b"]
    assert [row.state for row in again] == ["kept", "finished", "kept"]
    assert again[0].drift_um == rows[0].drift_um
    # A reading that differs in one digit, under the size and time of before, and a report that is gone are both seen.
    readings = hall / "a" / "laser.csv"
    before, content = readings.stat(), readings.read_text()
    readings.write_text(f"{content[:-2]}{(int(content[-2]) + 1) % 10}\n")
    os.utime(readings, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert readings.stat().st_size == before.st_size
    (out / again[2].report).unlink()
    third = run_fleet(members, out, resume=True)
    assert [row.state for row in third] == ["finished", "kept", "finished"]
    assert (out / third[2].report).is_file()


def test_campaigns_whose_names_differ_by_a_slash_have_logs_of_their_own(hall, tmp_path):
    nested = tmp_path / "halls"
    shutil.copytree(hall / "b", nested / "m" / "X")
    shutil.copytree(hall / "b", nested / "m_X")
    (nested / "m_X" / "campaign.toml").write_text("")
    rows = run_fleet(find_members([nested]), tmp_path / "out", jobs=2)
    assert [row.name for row in rows] == ["m/X", "m_X"]
    assert len({row.log for row in rows}) == 2 and all((tmp_path / "out" / row.log).is_file() for row in rows)
    assert "there is no instrument" in rows[1].message and "there is no instrument" not in rows[0].message


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT that is sent to one process")
def test_a_fleet_that_is_stopped_ends_cleanly_with_what_was_kept(hall, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "fusion.cli", "fleet", str(hall), "--out", str(out), "--jobs", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as fleet:
        deadline = time.monotonic() + 60
        while not (runs := psutil.Process(fleet.pid).children()) and time.monotonic() < deadline:
            time.sleep(0.002)
        [run] = runs
        os.kill(fleet.pid, signal.SIGINT)
        _, said = fleet.communicate(timeout=30)
    assert fleet.returncode == 130
    assert "stopped by SIGINT; " in said
    assert "3 campaigns: 1 stopped, 2 not started; start the same command with --resume to go on" in said
    rows = json.loads((out / "fleet.json").read_text())["campaigns"]
    assert [row["state"] for row in rows] == ["stopped", "waiting", "waiting"]
    assert (out / "fleet.html").is_file()
    assert not psutil.pid_exists(run.pid) or run.wait(10) is not None


def test_runs_wait_for_memory(monkeypatch):
    fleet = fleet_run._Fleet([], None, 4, False, None, None)
    assert fleet._has_room()
    fleet.running["a"] = SimpleNamespace(measure=lambda: 0.4e9)
    # The run that is going on may still take 0.6 GB, another one 1 GB.
    for free, room in ((1.5e9, False), (1.7e9, True)):
        memory = SimpleNamespace(available=free)
        monkeypatch.setattr(psutil, "virtual_memory", lambda memory=memory: memory)
        assert fleet._has_room() is room
    fleet.jobs = 1
    assert not fleet._has_room()


def test_nothing_is_started_after_a_fleet_was_stopped(tmp_path, monkeypatch):
    """A signal may end the wait for the thread that starts runs, which then comes to it later: its run would be left alone."""
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "campaign.toml").write_text("")
    begun = []
    monkeypatch.setattr(fleet_run.subprocess, "Popen", lambda *command, **options: begun.append(command))
    fleet = fleet_run._Fleet(find_members([tmp_path / "x"]), tmp_path / "out", 1, False, None, None)
    fleet._stop()
    fleet._start("x")
    assert not begun and not fleet.running
