from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fusion.app.live.session import Course, LiveSession
from fusion.campaign.config import CampaignError
from fusion.pipeline.watch import Enough, FinishedCycle, LiveState

NAT = np.datetime64("NaT", "ns")


def state_of(number: int, *, low: float = 20.0, warnings: tuple[str, ...] = ()) -> LiveState:
    """A state after a cycle of two targets."""
    field = xr.DataArray(np.full((2, 3), low), dims=("y", "x"), coords={"y": [5.0, 15.0], "x": [5.0, 15.0, 25.0]})
    cycle = FinishedCycle(number, NAT, NAT, 3, field, (low, low + 2.0), 0.5 * number, np.array([1.0, 2.0]) * number)
    enough = Enough(number, 1.0 / number, 40, "") if number > 1 else None
    return LiveState(
        3 * number, 4 * number, number, cycle, {"A": 4.0} if number > 1 else {}, "cycles 1 to 2", enough, warnings
    )


def test_a_course_keeps_numbers_of_every_cycle_and_one_field() -> None:
    course = Course()
    for number, low in ((1, 20.0), (2, 18.0), (3, 21.0)):
        course.take(state_of(number, low=low))
    course.take(LiveState(99, 98, 3, None, {}, "", None, ("late",)))
    assert (
        course.cycle == [1, 2, 3] and course.mean_drift_um == [1.5, 3.0, 4.5] and course.far_drift_um == [2.0, 4.0, 6.0]
    )
    assert course.field_cycle == 3 and course.field_range_degC == (18.0, 23.0)
    assert (
        course.iso230_cycle == [2, 3]
        and course.values("A").tolist() == [4.0, 4.0]
        and np.isnan(course.values("R")).all()
    )
    assert (course.frames, course.readings, course.warnings) == (99, 98, ["late"])
    assert course.enough is not None and course.enough.cycles == 3


def test_only_the_latest_warnings_are_kept() -> None:
    course = Course()
    for number in range(1, 50):
        course.take(state_of(number, warnings=(f"warning {number}",)))
    assert course.warnings[0] == "warning 20" and len(course.warnings) == 30


def test_a_running_test_is_followed_until_it_is_ended(copied: Path, tmp_path: Path) -> None:
    """Six cycles of the laser alone; the last one is finished when following ends."""
    text = (copied / "campaign.toml").read_text(encoding="utf-8")
    laser = text[: text.index("[thermography]")] + text[text.index("[interferometry]") : text.index("[drivers]")]
    rows = (copied / "laser.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "campaign.toml").write_text(laser.replace("material_sensor", "# material_sensor"), encoding="utf-8")
    for name in ("laser.csv", "environment.csv"):
        shutil.copy(copied / name, tmp_path / name)
    (tmp_path / "laser.csv").write_text("\n".join(rows[: 1 + 6 * 12]) + "\n", encoding="utf-8")
    session = LiveSession(tmp_path / "campaign.toml", wanted_u_um=0.5, poll_s=0.01)
    assert session.runs
    session.end(60.0)
    assert not session.runs and session.fault == ""
    assert session.course.cycle == [1, 2, 3, 4, 5, 6]
    assert session.course.readings == 72 and session.course.latest_field is None and session.version > 0


def test_a_campaign_file_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="no such campaign file"):
        LiveSession(tmp_path / "campaign.toml", wanted_u_um=0.1)
