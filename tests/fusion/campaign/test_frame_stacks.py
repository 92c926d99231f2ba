"""Temperatures of another camera in a campaign: the same fields as from the counts, and what must be stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError, load_campaign
from fusion.campaign.frame_stacks import stack_options
from fusion.campaign.inputs import read_source
from fusion.campaign.sources import Source
from thermography.io.flir import index_frames
from thermography.radiometry.planck import calibrate


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
        ('unit = "degC"', 'object_distance = "1 m"', "object_distance is corrected in temperatures already"),
    ],
)
def test_what_cannot_be_is_refused(stack_folder: Path, stack: str, camera: str, message: str) -> None:
    with pytest.raises(CampaignError, match=message):
        stack_options(load_campaign(stated(stack_folder, stack, camera=camera)))
