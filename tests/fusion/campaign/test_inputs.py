"""Inputs of a campaign: omissions are noted by name, recordings that do not belong together are refused."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.inputs import (
    CameraInputs,
    LaserInputs,
    Source,
    SourceError,
    cycles_of_frames,
    read_source,
    stack_options,
    usual_window_s,
)
from fusion.pipeline.positioning import evaluate_interferometry
from interferometry.io.readings import read_deviations
from interferometry.io.writers import write_rtl
from tests.fusion.campaign_parts import change, keep_cycles, without
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_jpeg
from thermography.io.frame import CameraIdentity
from thermography.radiometry.planck import calibrate


@pytest.mark.long
def test_damaged_frames_and_lines_are_left_out_by_name(copied: Path) -> None:
    frames = sorted((copied / "thermal").glob("*.jpg"))
    frames[3].write_bytes(frames[3].read_bytes()[:5000])
    frames[5].write_bytes(b"\xff\xd8\xff\xe0no radiometric data\xff\xd9")
    shutil.copy(frames[7], frames[7].with_name("copy_of_a_frame.jpg"))
    os.mkfifo(frames[0].with_name("live.jpg"))
    lines = (copied / "laser.csv").read_text().splitlines()
    lines[10] = lines[10].rsplit(",", 1)[0] + ",abc"
    lines[20] = lines[20].replace("positive", "upward").replace("negative", "upward")
    (copied / "laser.csv").write_text("\n".join(lines) + "\n")

    source = read_source(load_campaign(copied / "campaign.toml"))
    rejected = {item.file: item.reason for item in source.frames_rejected}
    assert set(rejected) == {
        f"thermal/{frames[3].name}", f"thermal/{frames[5].name}", f"thermal/{max(frames[7].name, 'copy_of_a_frame.jpg')}",
    }  # fmt: skip
    messages = {notice.code: notice.message for notice in source.notices}
    assert messages["frames_rejected"].startswith("3 frames left out: ")
    assert str(copied) not in messages["frames_rejected"]
    assert messages["pipes_left_out"].startswith("thermography.frames also matches 1 pipe, socket or device")
    assert "thermal/live.jpg" in messages["pipes_left_out"]
    assert "2 lines of laser.csv left out: line 11 ('abc' is not a number)" in messages["readings_left_out"]
    assert "line 21 ('upward'" in messages["readings_left_out"]
    outcome = evaluate_interferometry(source)
    missing = {notice.code: notice for notice in outcome.notices}["readings_missing"]
    assert missing.message.startswith("2 readings of 288 missing, in ")
    # One reading of 24 at two cells: u grows by 1 - sqrt(23 / 24) = 2.1 %.
    assert missing.effect_um == pytest.approx(0.021 * float(outcome.dataset["estimate_profile_u"].max()), rel=0.2)


def test_a_link_whose_frame_is_gone_is_named(copied: Path) -> None:
    (copied / "thermal" / "IR_gone.jpg").symlink_to(copied / "nowhere.jpg")
    with pytest.raises(CampaignError, match=r"thermal/IR_gone.jpg is a link .*; restore the file"):
        load_campaign(copied / "campaign.toml")


def test_a_single_frame_is_enough_for_a_camera_alone(copied: Path) -> None:
    for frame in sorted((copied / "thermal").glob("*.jpg"))[1:]:
        frame.unlink()
    alone = without(copied / "campaign.toml", "interferometry", "plan", "model", "drivers", name="camera.toml")
    assert len(read_source(load_campaign(alone)).frames) == 1
    with pytest.raises(
        SourceError, match=r"1 usable frame, at least 2 .* \(none rejected\); check thermography.frames"
    ):
        read_source(load_campaign(copied / "campaign.toml"))


def test_a_short_test_is_refused_before_the_long_work(copied: Path) -> None:
    keep_cycles(copied / "laser.csv", 1)
    with pytest.raises(
        SourceError, match=r"laser.csv: 1 cycle at 6 targets; .* at least 2 cycles at 2 targets; measure"
    ):
        read_source(load_campaign(copied / "campaign.toml"))


STATES = 'states = [{ cycle = 1, temperature = "22 degC" }, { cycle = 900, temperature = "24 degC" }]'


@pytest.mark.parametrize(
    ("corners", "known", "message"),
    [
        (
            '["2000 mm", "50 mm"], ["2100 mm", "100 mm"]',
            "emissivity = 0.3",
            r"chuck: \(x 2000..2100, y 50..100 mm\) .*the plan is 700 x",
        ),
        ('["100 mm", "50 mm"], ["110 mm", "100 mm"]', "emissivity = 0.3", "region chuck: no cell lies inside"),
        ('["100 mm", "40 mm"], ["200 mm", "140 mm"]', STATES, "region chuck name cycle 900, .* the cycles 1 to "),
    ],
)
def test_a_region_that_cannot_be_used_is_refused(copied: Path, corners: str, known: str, message: str) -> None:
    path = copied / "campaign.toml"
    path.write_text(path.read_text() + f'\n[[thermography.region]]\nname = "chuck"\nrectangle = [{corners}]\n{known}\n')
    with pytest.raises(SourceError, match=message):
        read_source(load_campaign(path))


def test_frames_of_another_camera_are_the_odd_ones_out(copied: Path) -> None:
    path, frames = copied / "campaign.toml", sorted((copied / "thermal").glob("*.jpg"))
    sound = read_source(load_campaign(path))
    (first, _), _ = index_frames(frames[:2])
    for k in range(2):
        time = f"2012-11-21T10:00:0{k}"
        other = CameraIdentity(model="FLIR A645sc", serial="55")
        write_jpeg(copied / "thermal" / f"IR_other{k}.jpg", first.read().counts, first.parameters, time, camera=other)
    source = read_source(load_campaign(path))
    assert isinstance(source, Source) and isinstance(sound, Source)
    assert source.frames == sound.frames
    assert [one.file for one in source.frames_rejected] == ["thermal/IR_other0.jpg", "thermal/IR_other1.jpg"]
    assert "FLIR A645sc 55, 640 x 480, taken 2012-11-21T10:00:00Z, among" in source.frames_rejected[0].reason
    for frame in frames[2:]:
        frame.unlink()
    with pytest.raises(SourceError, match=r"4 frames of 2 cameras, none of which .* 2 of FLIR A645sc 55, 640 x 480"):
        read_source(load_campaign(path))


def test_cycles_without_a_time_are_left_out_by_number(copied: Path) -> None:
    """A .rtl file of which some runs hold no reading: the other cycles are evaluated under their own numbers."""
    read = read_deviations(copied / "laser.csv")
    lost = read["deviation"].where(~read["cycle"].isin([2, 5]))
    write_rtl(copied / "laser.rtl", read.assign(deviation=lost))
    alone = without(copied / "campaign.toml", "thermography", "plan", "model")
    reconstructed = '"laser.rtl"\ntime_zone = "UTC"\nfeed = "1000 mm/min"\ndwell = "3 s"'
    source = read_source(load_campaign(change(alone, '"laser.csv"', reconstructed)))
    assert isinstance(source, LaserInputs)
    numbers = source.deviations["cycle"].values.tolist()
    assert numbers == [n for n in range(1, numbers[-1] + 1) if n not in (2, 5)]
    told = {notice.code: notice.message for notice in source.notices}["cycles_left_out"]
    assert told == f"2 cycles of {numbers[-1]} in laser.rtl left out, as none of their readings has a time: 2; 5."
    lost = read["deviation"].where(read["cycle"] == 1)
    write_rtl(copied / "laser.rtl", read.assign(deviation=lost))
    told = {notice.code: notice.message for notice in read_source(load_campaign(alone)).notices}
    assert {"cycles_left_out", "standard_alone"} <= set(told)


def test_a_driver_of_the_name_of_a_logged_condition_is_refused(copied: Path) -> None:
    change(copied / "drivers.csv", "duty [1]", "air_temperature [degC]")
    with pytest.raises(SourceError, match=r"drivers\.csv: the driver 'air_temperature' .* environment\.csv too"):
        read_source(load_campaign(copied / "campaign.toml"))


# Temperatures of another camera in a campaign: the same fields as from the counts, and what must be stated.


@pytest.fixture(scope="module")
def stack_folder(campaign_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small campaign with the temperatures of its frames as one array and a table of times."""
    folder = tmp_path_factory.mktemp("stack")
    for name in ("campaign.toml", "fiducials.csv", "laser.csv", "environment.csv", "drivers.csv"):
        (folder / name).write_bytes((campaign_folder / name).read_bytes())
    frames, _ = index_frames(sorted((campaign_folder / "thermal").iterdir()))
    campaign = load_campaign(campaign_folder / "campaign.toml").thermography
    assert campaign is not None
    np.save(folder / "stack.npy", np.stack([calibrate(frame.read_counts(), frame.parameters) for frame in frames]))
    rows = [f"stack.npy,{i},{frame.time}+00:00" for i, frame in enumerate(frames)]
    (folder / "times.csv").write_text("file,frame,time\n" + "\n".join(rows) + "\n")
    return folder


def stated(folder: Path, stack: str, *, camera: str = "") -> Path:
    lines = (folder / "campaign.toml").read_text().splitlines()
    dropped = ("frames", "emissivity", "reflected", "atmospheric", "relative_humidity", "object_distance")
    start = lines.index("[thermography]")
    end = next(i for i in range(start + 1, len(lines)) if lines[i].startswith("["))
    kept = [line for line in lines[start:end] if not line.startswith(dropped)]
    table = [*kept, 'frames = ["stack.npy"]', camera, "[thermography.stack]", stack, ""]
    path = folder / "stack.toml"
    path.write_text("\n".join([*lines[:start], *table, *lines[end:]]))
    return path


@pytest.mark.long
def test_the_frames_are_those_of_the_camera(campaign_folder: Path, stack_folder: Path) -> None:
    path = stated(stack_folder, 'unit = "degC"\ntimes = "times.csv"')
    source = read_source(load_campaign(path))
    assert isinstance(source, Source)
    frames, _ = index_frames(sorted((campaign_folder / "thermal").iterdir()))
    assert [frame.time for frame in source.frames] == [frame.time for frame in frames]
    for i in (0, len(frames) - 1):
        ours = calibrate(source.frames[i].read_counts(), source.frames[i].parameters)
        # Half a step of the scale at room temperature is 2.4 mK.
        assert ours == pytest.approx(calibrate(frames[i].read_counts(), frames[i].parameters), abs=2.6e-3)
    codes = {notice.code for notice in source.notices}
    assert {"camera_accuracy_assumed", "stack_emissivity_unknown"} <= codes


def test_times_of_files_of_one_name_are_those_of_their_folders(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "IR_1.npy", np.full((48, 64), 20.0) + np.arange(64))
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\ntitle = "T"\n[thermography]\nframes = ["*/*.npy"]\n[thermography.stack]\nunit = "degC"\ntimes = "times.csv"\n'
    )

    def times(*rows: str) -> list[str]:
        (tmp_path / "times.csv").write_text("\n".join(["file,time", *rows]) + "\n")
        source = read_source(load_campaign(tmp_path / "campaign.toml"))
        assert isinstance(source, CameraInputs)
        return [f"{frame.path.parent.name} {str(frame.time)[11:16]}" for frame in source.frames]

    for first in ("a/IR_1.npy", r"..\a\IR_1.npy", str(tmp_path / "a" / "IR_1.npy")):
        assert times(f"{first},2026-03-09T07:00Z", "b/IR_1.npy,2026-03-09T06:30Z") == ["b 06:30", "a 07:00"]
    with pytest.raises(CampaignError, match=r"times\.csv, line 2: 'IR_1\.npy' may be any of 2 files .* as a/IR_1\.npy"):
        times("IR_1.npy,2026-03-09T07:00Z")
    with pytest.raises(CampaignError, match=r"times\.csv, line 3: a second time for frame 0 of a/IR_1\.npy"):
        times("a/IR_1.npy,2026-03-09T07:00Z", "a/IR_1.npy,2026-03-09T07:00Z")


def test_a_stated_camera_needs_no_notice(stack_folder: Path) -> None:
    stack = 'unit = "degC"\ntimes = "times.csv"\nemissivity = 0.95\nreflected_temperature = "22 degC"'
    source = read_source(load_campaign(stated(stack_folder, stack, camera='camera_offset_u = "1 K"\nemissivity = 0.9')))
    assert not {"camera_accuracy_assumed", "stack_emissivity_unknown"} & {notice.code for notice in source.notices}
    assert source.frames[0].parameters.emissivity == 0.95  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("stack", "camera", "message"),
    [
        ('unit = "degC"\nstart = "now"', "", "the time 'now' of a frame is not an ISO 8601 time"),
        ('unit = "degC"\nstart = "2026-03-09T06:30Z"\ntimes = "times.csv"', "", "times and start each say when"),
        ('unit = "degF"', "", "degC"),
        ('unit = "degC"', "emissivity = 0.9", "write that as emissivity under .thermography.stack."),
        ('unit = "degC"', 'object_distance = "1 m"', r"\[thermography\]: object_distance is already corrected for"),
    ],
)
def test_what_cannot_be_is_refused(stack_folder: Path, stack: str, camera: str, message: str) -> None:
    with pytest.raises(CampaignError, match=message):
        stack_options(load_campaign(stated(stack_folder, stack, camera=camera)))


# Tests of the windows that stand for cycles where no laser gives them.


START = np.datetime64("2026-03-09T08:00", "ns")


def frames(*minutes: float) -> np.ndarray:
    return START + np.round(np.array(minutes) * 60e9).astype("timedelta64[ns]")


def test_windows_follow_each_other_and_hold_every_frame() -> None:
    times = frames(*range(13))
    cycles = cycles_of_frames(times, 300.0)
    assert cycles.number.tolist() == [1, 2, 3]
    assert (cycles.bounds[1:, 0] == cycles.bounds[:-1, 1]).all()
    inside = (times[:, None] >= cycles.bounds[:, 0]) & (times[:, None] < cycles.bounds[:, 1])
    assert inside.sum(axis=1).tolist() == [1] * 13


def test_a_window_without_a_frame_is_left_out_and_the_number_says_so() -> None:
    assert cycles_of_frames(frames(0, 1, 17), 300.0).number.tolist() == [1, 4]


@pytest.mark.parametrize(
    ("times", "window_s"),
    [
        (frames(*np.arange(0, 240)), 300.0),  # four hours: 48 windows of 5 min
        (frames(*np.arange(0, 10, 1 / 60)), 10.0),  # ten minutes at 1 Hz: 60 windows of 10 s
        (frames(0, 18), 900.0),  # two frames 18 min apart: each has a window of its own
        (frames(0, 1), 60.0),
        (frames(*np.arange(0, 0.004, 0.0005)), 0.02),  # 0.2 s at 33 Hz
        (frames(0, 0.0661), 2.0),  # two frames 4 s apart: two windows
        (frames(0, 1e-8), 6e-7),
    ],
)
def test_the_usual_window_is_a_round_time_and_makes_at_most_sixty(times: np.ndarray, window_s: float) -> None:
    assert usual_window_s(times) == window_s
    assert cycles_of_frames(times, window_s).number.size <= 61
