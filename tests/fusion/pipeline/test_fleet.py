"""A fleet: campaigns found and named apart, and one that fails stops no other."""

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
from typer.testing import CliRunner

from fusion import cli
from fusion.pipeline.fleet import FleetError, find_members, has_room, run_fleet
from fusion.results.store import OutputError
from tests.fusion.campaign_parts import write_laser


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")


def test_campaigns_are_named_after_their_folders_or_their_own_names(tmp_path):
    touch(tmp_path, "hall/m2/X/campaign.toml", "hall/m1/X/campaign.toml", "hall/m1/Y/campaign.toml", "hall/notes.toml")
    assert [member.name for member in find_members([tmp_path / "hall"])] == ["m1/X", "m1/Y", "m2/X"]
    # A file that is named twice is one campaign; one alone has the name of its folder.
    twice = [tmp_path / "hall/m1/X", tmp_path / "hall/m1/X/campaign.toml"]
    assert [member.name for member in find_members(twice)] == ["X"]
    touch(tmp_path, "a/x.toml", "a/y.toml", "b/campaign.toml")
    paths = [tmp_path / "a/x.toml", tmp_path / "a/y.toml", tmp_path / "b"]
    assert [member.name for member in find_members(paths)] == ["a/x", "a/y", "b"]


def test_what_is_no_fleet_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FleetError, match=r"empty: holds no campaign.toml; thermofuse init"):
        find_members([tmp_path / "empty"])
    with pytest.raises(FleetError, match=r"gone: is not there"):
        find_members([tmp_path / "gone"])
    touch(tmp_path, "n/m1/campaign.toml", "n/m1/old/campaign.toml", "n/m2/campaign.toml")
    with pytest.raises(FleetError, match=r"old/campaign.toml: is in the folder of .*m1/campaign.toml"):
        find_members([tmp_path / "n"])


@pytest.mark.parametrize("name", ["logs", "Logs", "fleet.html"])
def test_a_campaign_does_not_take_a_name_of_the_fleet(tmp_path, name):
    for folder in (name, "x"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "campaign.toml").write_text("")
    held = rf"{name}.campaign\.toml: its results would be written to the folder {name}, .*; rename the folder"
    with pytest.raises(FleetError, match=held):
        find_members([tmp_path])


@pytest.mark.parametrize("name", ["logs", "logs/a.log", "a"])
def test_a_fleet_writes_through_no_link_that_leads_out(tmp_path, name):
    touch(tmp_path, "hall/a/campaign.toml", "hall/b/campaign.toml", "others/a.log", "out/fleet.json")
    out, link = tmp_path / "out", tmp_path / "out" / name
    (out / "manifest.json").write_text('{"software": "thermofuse", "written": {"fleet.json": "1"}}')
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "others" / ("a.log" if name.endswith(".log") else ""))
    with pytest.raises(OutputError, match=rf"'{name}(/a\.log)?' leads out of the results folder; nothing was changed"):
        run_fleet(find_members([tmp_path / "hall"]), out, resume=True)
    assert [path.name for path in (tmp_path / "others").iterdir()] == ["a.log"]
    assert not (out / "fleet.json").read_text() and not (tmp_path / "others/a.log").read_text()


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """Two machines measured by the laser alone, in as few cycles as can be evaluated, and one whose readings are not there."""
    folder = tmp_path_factory.mktemp("fleet") / "hall"
    for name in ("a", "b", "c"):
        write_laser(folder / name, 5, 6)
    (folder / "b" / "laser.csv").unlink()
    return folder


@pytest.mark.chain
@pytest.mark.slow
def test_one_that_fails_stops_no_other_and_the_next_fleet_keeps_what_is_finished(hall, tmp_path):
    out, ended, told = tmp_path / "out", [], []
    members = find_members([hall])
    how = {"report": lambda label, done, total: told.append((done, total))}
    rows = run_fleet(members, out, jobs=2, say=lambda row: ended.append(row.name), **how)
    ends = [("a", "finished", 0), ("b", "failed", 2), ("c", "finished", 0)]
    assert [(row.name, row.state, row.exit_code) for row in rows] == ends
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


@pytest.mark.chain
@pytest.mark.slow
def test_campaigns_whose_names_differ_by_a_slash_have_logs_of_their_own(hall, tmp_path):
    nested = tmp_path / "halls"
    shutil.copytree(hall / "b", nested / "m" / "X")
    shutil.copytree(hall / "b", nested / "m_X")
    (nested / "m_X" / "campaign.toml").write_text("")
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        rows = run_fleet(find_members([nested]), tmp_path / "out", jobs=2)
        assert other.poll() is None  # A process of the caller's own is left alone.
        other.communicate(b"\n", timeout=60)
    assert [row.name for row in rows] == ["m/X", "m_X"]
    assert len({row.log for row in rows}) == 2 and all((tmp_path / "out" / row.log).is_file() for row in rows)
    assert "[campaign] is missing" in rows[1].message and "[campaign] is missing" not in rows[0].message


@pytest.mark.chain
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT that is sent to one process")
def test_a_fleet_that_is_stopped_ends_cleanly_with_what_was_kept(hall, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "thermofuse", "fleet", str(hall), "--out", str(out), "--jobs", "1"]
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


def test_runs_wait_for_memory_and_processors(monkeypatch):
    assert has_room([], 1, 1e9)
    running = [SimpleNamespace(measure=lambda: 0.4e9)]
    # The run that is going on may still take 0.6 GB, another one 1 GB.
    for free, room in ((1.5e9, False), (1.7e9, True)):
        memory = SimpleNamespace(available=free)
        monkeypatch.setattr(psutil, "virtual_memory", lambda memory=memory: memory)
        assert has_room(running, 4, 1e9) is room
    assert not has_room(running, 1, 1e9)


def test_the_help_names_every_file_of_the_summary():
    said = CliRunner().invoke(cli.app, ["fleet", "--help"], env={"COLUMNS": "160"}).output
    assert all(f"fleet.{ending}" in said for ending in ("html", "xlsx", "csv", "json"))
