"""A test that is watched: every cycle once, half-written ends wait, and what is shown agrees with the full run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import CampaignError, load_campaign
from fusion.pipeline.watch import LiveState, follow
from interferometry.io.readers import read_deviations
from interferometry.iso230 import evaluate_iso230
from tests.fusion.laboratory import Laboratory, append, begin, copy_frames


def watched(folder: Path, laboratory: Laboratory, **options: Any) -> list[LiveState]:
    return list(follow(load_campaign(folder / "campaign.toml"), stop=laboratory, clock=laboratory.clock, **options))


@pytest.fixture(scope="module")
def states(campaign_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> list[LiveState]:
    """Everything that a watch of the small campaign yields, whose frames and readings come in halves."""
    folder = begin(campaign_folder, tmp_path_factory.mktemp("watch") / "campaign")
    pieces = append(campaign_folder / "laser.csv", folder / "laser.csv", pieces=48)
    return watched(folder, Laboratory(copy_frames(campaign_folder, folder), pieces))


def test_every_cycle_is_finished_once_in_order(states: list[LiveState]) -> None:
    assert [state.cycle.number for state in states if state.cycle] == list(range(1, 25))
    assert (states[-1].frames, states[-1].readings, states[-1].cycles) == (24, 288, 24)
    assert not [warning for state in states for warning in state.warnings]


def test_counts_never_fall(states: list[LiveState]) -> None:
    for name in ("frames", "readings", "cycles"):
        assert np.all(np.diff([getattr(state, name) for state in states]) >= 0), name


def test_drift_is_that_of_the_readings(states: list[LiveState], campaign_folder: Path) -> None:
    deviation = read_deviations(campaign_folder / "laser.csv")["deviation"]
    drift = (deviation - deviation.isel(cycle=0)).mean("direction")
    shown = [state.cycle.drift_um for state in states if state.cycle]
    np.testing.assert_allclose(shown, drift.values, atol=1e-9)


def test_iso230_is_that_of_the_last_five_cycles(states: list[LiveState], campaign_folder: Path) -> None:
    deviations = read_deviations(campaign_folder / "laser.csv")
    for state in (state for state in states if state.iso230_um and state.cycles >= 5):
        assert state.cycle is not None
        last = state.cycle.number
        expected = evaluate_iso230(deviations, cycles=range(last - 4, last + 1))
        assert state.iso230_um["A"] == pytest.approx(float(expected["A"]))


def test_fields_are_those_of_the_full_run(states: list[LiveState], results_folder: Path) -> None:
    # The full run corrects the camera and registers all first frames together: a tenth of a kelvin, and no more, apart.
    with xr.open_dataset(results_folder / "fields.nc") as fields:
        for state in states:
            if state.cycle is not None and state.cycle.field is not None:
                full = fields["temperature"].sel(cycle=state.cycle.number)
                assert float(abs(full - state.cycle.field.values).mean()) < 0.1


def test_tells_whether_the_cycles_are_enough(states: list[LiveState]) -> None:
    early = [state.enough for state in states if state.enough and state.enough.cycles < 12]
    assert early and all("at least 12 cycles" in enough.lacks and not enough.is_enough for enough in early)
    last = states[-1].enough
    assert last is not None and not last.lacks and 0.01 < last.u_um < 1.0


def test_a_wish_that_is_met_is_enough(campaign_folder: Path) -> None:
    final = watched(campaign_folder, Laboratory(idle=0), wanted_u_um=5.0)[-1]
    assert final.enough is not None and final.enough.is_enough


def test_ends_when_nothing_has_come_for_so_long(campaign_folder: Path) -> None:
    laboratory = Laboratory(idle=10_000)
    assert watched(campaign_folder, laboratory, until_idle_s=60.0)[-1].cycles == 24
    assert 60.0 <= laboratory.seconds < 70.0


def test_the_clock_of_the_machine_may_be_set_back(
    campaign_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = begin(campaign_folder, tmp_path / "campaign")
    hours = iter(np.linspace(0.0, -1e6, 1_000_000))
    monkeypatch.setattr(time, "time", lambda: 1.8e9 + next(hours))
    pieces = append(campaign_folder / "laser.csv", folder / "laser.csv", pieces=5)
    laboratory = Laboratory(copy_frames(campaign_folder, folder), pieces)
    assert watched(folder, laboratory)[-1].cycles == 24


def test_a_camera_that_has_stopped_holds_nothing_up(campaign_folder: Path, tmp_path: Path) -> None:
    folder = begin(campaign_folder, tmp_path / "campaign")
    pieces = append(campaign_folder / "laser.csv", folder / "laser.csv", pieces=100)
    found = watched(folder, Laboratory(pieces))
    cycles = [state.cycle for state in found if state.cycle]
    assert [cycle.number for cycle in cycles] == list(range(1, 25))
    assert [cycle.frames for cycle in cycles] == [1] + 23 * [0]
    assert "cycle 2: no frame in this cycle" in [warning for state in found for warning in state.warnings]


def test_a_line_that_cannot_be_used_is_told_once(campaign_folder: Path, copied: Path) -> None:
    laser = copied / "laser.csv"
    lines = laser.read_text().splitlines()
    lines[7] = lines[7].replace("positive", "sideways").replace("negative", "sideways")
    laser.write_text("\n".join(lines) + "\n")
    found = watched(copied, Laboratory(idle=2))
    told = [warning for state in found for warning in state.warnings if "sideways" in warning]
    assert told == ["laser.csv, line 8: 'sideways' is neither 'positive' nor 'negative'"]


def test_windows_stand_for_cycles_without_a_laser(campaign_folder: Path, copied: Path) -> None:
    campaign = copied / "campaign.toml"
    head = campaign.read_text().split("[interferometry]")[0]
    campaign.write_text(head.replace('table = "still"', 'table = "still"\nwindow = "6 min"'))
    found = watched(copied, Laboratory(idle=1))
    assert [state.cycle.number for state in found if state.cycle] == list(range(1, 13))
    assert sum(state.cycle.frames for state in found if state.cycle) == 24
    assert found[-1].readings == 0 and not found[-1].iso230_um


def test_the_laser_alone_is_followed(campaign_folder: Path, copied: Path) -> None:
    campaign = copied / "campaign.toml"
    text = campaign.read_text()
    start, end = text.index("[thermography]"), text.index("[interferometry]")
    campaign.write_text(
        (text[:start] + text[end:]).replace('declared = ["axis_expansion", "table_offset"]', "declared = []")
    )
    found = watched(copied, Laboratory(idle=1))
    assert found[-1].cycles == 24 and found[-1].frames == 0
    assert all(state.cycle.field is None for state in found if state.cycle)


def test_a_record_cannot_be_followed(tmp_path: Path) -> None:
    (tmp_path / "record.csv").write_text("time [s],a [degC],x [um]\n0,20,0\n")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\ntitle = "R"\naxis = "X"\n[record]\nfile = "record.csv"\ntime = "time [s]"\n'
        'temperatures = ["a [degC]"]\ndisplacements = ["x [um]"]\n[model]\ndeclared = []\n'
    )
    with pytest.raises(CampaignError, match="cannot be followed; run it when it is finished"):
        next(follow(load_campaign(tmp_path / "campaign.toml")))
