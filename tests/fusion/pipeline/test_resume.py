"""A stage is computed once for what it depends on, is kept after that, and is timed where it is computed."""

import hashlib
import re
import shutil
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import xarray as xr

from fusion.campaign.config import load_campaign
from fusion.pipeline.iso230 import files_of_run
from fusion.pipeline.resume import (
    FileState,
    Run,
    dependencies,
    describe_run,
    hash_files,
    input_states,
    kept_results,
    note_changes,
    refuse_other_campaign,
    stamp_run,
)
from fusion.pipeline.run import RUN, run_stages
from fusion.pipeline.workers import Worker
from fusion.report.charts.embedded import Drawn
from fusion.results.axis import AlignmentPart
from fusion.results.parts import Quantity
from fusion.results.progress import Report, silent
from fusion.results.results import Notice, Outcome, Parts, assemble
from fusion.results.store import OutputError, StageStamps, file_sha256, write_json
from tests.fusion.campaign_parts import change as change_text
from tests.fusion.campaign_parts import write_laser

PARTS = Parts(alignment=AlignmentPart(clock_offset_s=Quantity(value=1.0, u=None)))


class Counting:
    """A stage's work that counts how often it is done, each time in so many seconds."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.times, self.seconds = 0, seconds

    def __call__(self, *, report: Report) -> Outcome[xr.Dataset]:
        self.times += 1
        time.sleep(self.seconds)
        return Outcome(xr.Dataset({"drift": ("cycle", [0.5, 1.0])}), PARTS, (Notice("code", "said", "remedy"),))


class Elsewhere(Worker):
    """Does the work at once, as a second process would before it is asked for."""

    def submit(self, work: Callable[..., Any], report: Report | None = None) -> Callable[[], Any]:
        answer = super().submit(work, report)()
        return lambda: answer


@pytest.fixture
def new_run(copied, tmp_path):
    """Start another run of the campaign into the same folder, as with --resume."""

    def start():
        campaign, folder = load_campaign(copied / "campaign.toml"), tmp_path / "results"
        inputs = hash_files(campaign.input_files())
        return Run(campaign, folder, silent, StageStamps(folder), inputs, {}, datetime.now(UTC), worker=Elsewhere())

    return start


def test_a_stage_is_kept_until_its_table_or_a_file_of_it_or_the_one_before_changes(copied, new_run):
    work, later = Counting(), Counting()
    for change, times in (("", 1), ("", 1), ("\n", 2)):
        with (copied / "laser.csv").open("a") as readings:
            readings.write(change)
        run = new_run()
        assert run.stage("deviations", work)["drift"].values.tolist() == [0.5, 1.0]
        assert run.begin("model", later)()["drift"].values.tolist() == [0.5, 1.0]
        assert (work.times, later.times) == (times, times)
        assert run.parts == PARTS and run.notices == [Notice("code", "said", "remedy")] * 2
        assert [path.name for path in run.products] == ["deviations.nc", "model.nc"]
    text = (copied / "campaign.toml").read_text()
    other = re.sub("dead_path = .*", 'dead_path = "300 mm"', text)
    for changed, times in (
        (text.replace("title = ", "title = 'b' # "), 2),
        (other, 3),
        (other.replace("title = ", "time_zone = 'Europe/Vienna'\ntitle = "), 4),
    ):
        assert changed != text
        (copied / "campaign.toml").write_text(changed)
        new_run().stage("deviations", work)
        assert work.times == times


def test_what_a_stage_takes_of_another_table_makes_it_anew_and_keeps_those_after_it(new_run):
    """Other cycles are quoted by ISO 230-2: the readings are evaluated again, and the drift is not modelled again."""
    work, later = Counting(), Counting()
    for cycles, times in (((1, 5), 1), ((1, 5), 1), ((2, 6), 2), (None, 3)):
        run = new_run()
        run.taken["deviations"] = cycles
        run.stage("deviations", work)
        run.stage("model", later)
        assert (work.times, later.times) == (times, 1)


def test_what_a_stage_found_is_drawn_where_it_was_computed_or_from_what_is_kept(new_run):
    work, seen = Counting(), []

    def draw(outcome):
        seen.append((outcome.parts, outcome.dataset["drift"].values.tolist()))
        return Drawn({})

    for _ in range(2):
        run = new_run()
        begun = run.begin("deviations", work, draw)
        (drawn,) = run.drawn
        assert drawn() == Drawn({})
        assert begun()["drift"].values.tolist() == [0.5, 1.0] and drawn() == Drawn({})
    assert work.times == 1, "computed once, then kept"
    assert seen == [(PARTS, [0.5, 1.0])] * 2, "drawn once by each run"


def test_a_chart_that_cannot_be_drawn_costs_no_result(new_run):
    def draw(outcome):
        raise MemoryError("no room for a chart")

    work, run = Counting(), new_run()
    assert run.begin("deviations", work, draw)()["drift"].values.tolist() == [0.5, 1.0]
    with pytest.raises(MemoryError, match="no room for a chart"):
        run.drawn[0]()
    assert new_run().stage("deviations", work)["drift"].size == 2 and work.times == 1


def test_a_stage_of_the_second_process_counts_the_time_of_its_work_and_not_of_the_wait(new_run):
    run = new_run()
    begun = run.begin("deviations", Counting(0.3))
    time.sleep(1.0)
    asked = time.perf_counter()
    begun()
    # The pause between beginning and asking is no part of the stage, what follows is; half a second is for a busy machine.
    assert 0.3 <= run.seconds["deviations"] < 0.8 + time.perf_counter() - asked


def test_a_long_recording_keeps_the_cycles_of_its_own_input_alone(new_run):
    run = new_run()
    old = run.folder / ".stages" / "cycles_0123456789abcdef"
    old.mkdir(parents=True)
    chosen = run.checkpoint("deviations")
    assert chosen.parent == old.parent and chosen != old and not old.exists()
    assert run.checkpoint("deviations") == chosen


def test_a_stage_is_left_out_where_what_it_needs_is_lacking(new_run):
    stages = {
        "fields": lambda run, camera: "of the camera",
        "deviations": lambda run, laser: f"of {laser}",
        "fused": lambda run, deviations, fields=None: None,
        "model": lambda run, deviations, fields=None: (deviations, fields),
        "more": lambda run, fused: 1,
    }
    made = {"laser": "the laser"}
    run_stages(new_run(), stages, made)
    told = "of the laser"
    assert made == {"laser": "the laser", "deviations": told, "fused": None, "model": (told, None)}


@pytest.mark.parametrize(
    ("stage", "name"),
    [(lambda run, laser, devations=None: 1, "devations"), (lambda run, laser, model: 1, "model")],
    ids=["misspelt", "made later"],
)
def test_a_stage_that_takes_what_nothing_before_it_makes_is_a_fault_of_the_program(new_run, stage, name):
    """And not one that a campaign does without."""
    run_stages(new_run(), RUN, {})
    made = {"laser": 1}
    with pytest.raises(TypeError, match=f"the stage deviations takes {name}, which"):
        run_stages(new_run(), {"fields": lambda run, laser: 1, "deviations": stage, "model": lambda run: 1}, made)
    assert made == {"laser": 1}, "found before any stage is run"


STARTED = datetime(2026, 3, 9, 6, 30, tzinfo=UTC)


def test_files_are_hashed_by_name(tmp_path):
    (tmp_path / "laser.csv").write_bytes(b"readings")
    told = []
    hashed = hash_files({"laser.csv": tmp_path / "laser.csv"}, report=lambda *step: told.append(step))
    assert hashed == {"laser.csv": {"bytes": 8, "sha256": hashlib.sha256(b"readings").hexdigest()}}
    assert told == [("input files", 0, 1), ("input files", 1, 1)]


def test_a_run_is_described_without_a_folder(campaign_folder, monkeypatch):
    campaign = load_campaign(campaign_folder / "campaign.toml")
    monkeypatch.setattr(sys, "argv", ["/opt/bin/thermofuse", "run", str(campaign.path), "--resume"])
    products = [campaign_folder / "laser.csv"]
    run = describe_run(campaign, {}, campaign.folder, started=STARTED, seconds={"fields": 1.234}, products=products)
    assert run["command"] == ["thermofuse", "run", "campaign.toml", "--resume"]
    assert run["started"] == "2026-03-09T06:30:00+00:00" and run["stage_seconds"] == {"fields": 1.23}
    assert run["parameters"]["plan"]["cell_size_mm"] == 20.0 and "path" not in run["parameters"]
    assert run["products"] == hash_files({"laser.csv": products[0]})


def test_the_results_of_another_campaign_are_not_replaced(copied, caplog):
    folder, own = copied / "results", load_campaign(copied / "campaign.toml")
    hashed = hash_files(own.input_files())
    refuse_other_campaign(folder, own, hashed)
    written = describe_run(own, hashed, folder, started=STARTED, seconds={})
    write_json(folder / "provenance.json", written)
    other = load_campaign(shutil.copy(own.path, copied / "other.toml"))
    # A copy of the campaign file is for the same recordings; the same campaign file is for recordings that have grown.
    refuse_other_campaign(folder, other, hash_files(other.input_files()))
    (warned,) = caplog.messages
    assert all(told in warned for told in (str(folder), f'"{own.campaign.title}", ../campaign.toml', str(other.path)))
    for path in (own.resolve("laser.csv"), own.resolve("environment.csv"), *own.frame_paths()):
        path.write_bytes(path.read_bytes() + b"\n")
    refuse_other_campaign(folder, own, hash_files(own.input_files()))
    with pytest.raises(OutputError) as error:
        refuse_other_campaign(folder, other, hash_files(other.input_files()))
    for told in (str(folder), f'("{own.campaign.title}", ../campaign.toml)', str(other.path), "--out"):
        assert told in str(error.value)
    for damaged in ([], {"inputs": []}, {**written, "campaign_file": None}):
        write_json(folder / "provenance.json", damaged)
        refuse_other_campaign(folder, other, hash_files(other.input_files()))
    write_json(folder / "provenance.json", {**written, "parameters": ["x"]})
    with pytest.raises(OutputError, match=r"another campaign \(\.\./campaign\.toml\)"):
        refuse_other_campaign(folder, other, hash_files(other.input_files()))


@pytest.mark.parametrize(
    ("folder", "place"),
    [
        ("results", "../campaign.toml"),
        ("", "campaign.toml"),
        ("../results", "../{}/campaign.toml"),
        ("../../x/results", None),
    ],
)
def test_the_campaign_file_is_found_from_the_results_without_naming_folders_of_the_user(campaign_folder, folder, place):
    campaign = load_campaign(campaign_folder / "campaign.toml")
    run = describe_run(campaign, {}, campaign.folder / folder, started=STARTED, seconds={})
    assert run["campaign_file"] == (None if place is None else place.format(campaign.folder.name))
    fetched = describe_run(campaign, {}, campaign.folder / folder, started=STARTED, seconds={}, address="s3://mill")
    assert fetched["campaign_file"] is None and fetched["campaign_address"] == "s3://mill"
    assert "campaign_address" not in run


def test_inputs_that_change_during_a_run_are_told():
    before = {name: FileState(100, 1) for name in ("laser.csv", "a.jpg", "b.jpg", "c.jpg", "d.jpg")}
    after = {"laser.csv": FileState(140, 2)} | dict.fromkeys(("e.jpg", "f.jpg", "g.jpg"), FileState(100, 1))
    assert list(note_changes(before, before)) == []
    (notice,) = note_changes(before, after)
    assert notice.code == "inputs_changed"
    assert (
        "1 changed (laser.csv); 4 removed (a.jpg, b.jpg, c.jpg, ...); 3 added (e.jpg, f.jpg, g.jpg)" in notice.message
    )


def test_the_state_of_inputs_is_seen_without_reading_them(copied):
    campaign = load_campaign(copied / "campaign.toml")
    before = input_states(campaign)
    assert set(before) == set(campaign.input_files())
    with (copied / "laser.csv").open("a") as laser:
        laser.write("\n")
    removed = first_frame(copied)
    removed.unlink()
    (notice,) = note_changes(before, input_states(campaign))
    assert f"1 changed (laser.csv); 1 removed (thermal/{removed.name})" in notice.message


def first_frame(campaign: Path) -> Path:
    return min((campaign / "thermal").iterdir())


def other_digit(readings: Path) -> None:
    """One digit of a reading: the size of the file stays."""
    text = readings.read_text()
    readings.write_text(text[:-3] + ("1" if text[-3] != "1" else "2") + text[-2:])


CHANGES: dict[str, Callable[[Path, Path], object]] = {
    "reading": lambda campaign, out: other_digit(campaign / "laser.csv"),
    "another frame": lambda campaign, out: shutil.copy(first_frame(campaign), campaign / "thermal" / "IR_9999.jpg"),
    "a frame less": lambda campaign, out: first_frame(campaign).unlink(),
    "title": lambda campaign, out: change_text(campaign / "campaign.toml", "Small campaign", "Another title"),
    "missing page": lambda campaign, out: (out / "report.html").unlink(),
    "damaged map": lambda campaign, out: (out / "maps" / "cycle_0003.exr").write_bytes(b"x"),
    "missing stage": lambda campaign, out: (out / ".stages" / "model.nc").unlink(),
    "damaged stamps": lambda campaign, out: (out / ".stages" / "stamps.json").write_text('{"report": '),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_run_is_whole_only_as_long_as_nothing_changed(change, results_folder, copied, tmp_path):
    out = shutil.copytree(results_folder, tmp_path / "results")
    assert kept_results(load_campaign(copied / "campaign.toml"), out) is not None
    CHANGES[change](copied, out)
    assert kept_results(load_campaign(copied / "campaign.toml"), out) is None


@pytest.mark.parametrize("linked", [False, True])
def test_inputs_of_one_name_in_two_folders_are_two_inputs(linked, tmp_path):
    """As data on a share: stamps, provenance and sheet hold every one of them, and a change of either ends what was kept."""
    job, named = write_laser(tmp_path / "job", 2, 2).parent, {"laser": "../laser/1.csv", "env": "../env/1.csv"}
    for name in named:
        (tmp_path / name).mkdir()
    shutil.move(job / "laser.csv", tmp_path / "laser" / "1.csv")
    logged = "time,air_temperature_degC,air_pressure_hPa,relative_humidity_percent\n2026-03-09T06:30:00Z,20,1013,50\n"
    (tmp_path / "env" / "1.csv").write_text(logged)
    if linked:
        for name, path in named.items():
            (job / f"{name}.csv").symlink_to(path)
    written = [f"{name}.csv" for name in named] if linked else [*named.values()]
    path = change_text(job / "campaign.toml", '"laser.csv"', '"{}"\nenvironment = "{}"'.format(*written))
    campaign, out = load_campaign(path), job / "results"
    assert list(campaign.input_files()) == ["campaign.toml", *named.values()]
    inputs = hash_files(campaign.input_files())
    assert all(inputs[name]["sha256"] == file_sha256(job / name) for name in named.values())
    write_json(out / "provenance.json", describe_run(campaign, inputs, out, started=STARTED, seconds={}))
    assert files_of_run(out) == {name: inputs[name]["sha256"] for name in named.values()}
    stamp_run(StageStamps(out), campaign, inputs, [])
    write_json(out / "results.json", assemble("Size", {}, []).as_json())
    assert kept_results(campaign, out) is not None
    other_digit(tmp_path / "laser" / "1.csv")
    assert kept_results(campaign, out) is None


def test_a_run_of_another_version_or_none_is_not_whole(results_folder, campaign_folder, tmp_path, monkeypatch):
    campaign = load_campaign(campaign_folder / "campaign.toml")
    assert kept_results(campaign, results_folder) is not None
    assert kept_results(campaign, tmp_path / "absent") is None
    monkeypatch.setattr("fusion.pipeline.resume.versions", lambda: {"thermofuse": "0.0.1"})
    assert kept_results(campaign, results_folder) is None


@pytest.mark.parametrize("group", ["thermofuse.effects", "thermofuse.frame_readers"])
def test_a_plug_in_whose_code_changes_under_one_version_ends_what_is_kept(group, tmp_path, monkeypatch):
    info = tmp_path / "kept_plates-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kept-plates\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\nplates = kept_plates:plates\n")
    code = tmp_path / "kept_plates.py"
    code.write_text("plates = 1\n")
    alone = dependencies()
    monkeypatch.syspath_prepend(str(tmp_path))
    before = dependencies()
    assert alone != before == dependencies()
    code.write_text("plates = 2\n")
    assert dependencies() != before
