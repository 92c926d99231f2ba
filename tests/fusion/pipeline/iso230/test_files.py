"""A test from a file of readings, a campaign file and the results of a run."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import CampaignError
from fusion.pipeline.iso230.files import read_test, read_window
from fusion.products.results import ResultsError
from interferometry.deviations import build_deviations
from interferometry.io.readers import read_deviations
from interferometry.iso230 import evaluate_iso230

LASER = """cycle,direction,target,position_mm,time,deviation_um
{rows}
"""


def laser_file(path: Path, cycles: int) -> Path:
    """A table of readings at five targets."""
    rng = np.random.default_rng(4)
    rows, minute = [], 0
    for cycle in range(1, cycles + 1):
        for direction in ("positive", "negative"):
            for target in range(1, 6):
                minute += 1
                time = np.datetime64("2026-03-09T06:30:00") + np.timedelta64(minute, "m")
                rows.append(f"{cycle},{direction},{target},{37.0 * target},{time}+00:00,{rng.normal(target, 0.5):.4f}")
    path.write_text(LASER.format(rows="\n".join(rows)))
    return path


def test_a_file_of_readings(tmp_path: Path) -> None:
    file = laser_file(tmp_path / "laser.csv", 6)
    found = read_test(file, "2-6")
    assert found.part is not None and found.part.settled is not None
    assert found.part.settled.cycles == (2, 3, 4, 5, 6) and found.part.settled_rule == ""
    axis = evaluate_iso230(read_deviations(file), cycles=[2, 3, 4, 5, 6])
    for symbol in "AREMB":
        assert getattr(found.part.settled, f"{symbol}_um").value == pytest.approx(float(axis[symbol]))
    assert {entry.origin for entry in found.part.settled.contributions[:3]} == {"assumed"}


def test_a_single_run_keeps_its_deviations(tmp_path: Path) -> None:
    found = read_test(laser_file(tmp_path / "laser.csv", 1), None)
    assert found.part is None and found.dataset.sizes["cycle"] == 1


def test_a_campaign_of_the_laser_alone_brings_its_budget_and_tolerances(tmp_path: Path) -> None:
    laser_file(tmp_path / "laser.csv", 6)
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(
        '[campaign]\ntitle = "T"\n[interferometry]\ndeviations = "laser.csv"\n'
        '[interferometry.uncertainty]\ndevice = "2 ppm"\n[acceptance]\nA = "1 m"\n'
    )
    found = read_test(campaign, None)
    assert found.title == "T" and found.part is not None and found.part.settled is not None
    assert found.part.settled.contributions[0].origin == "stated"
    assert [row.decision for row in found.part.tolerances] == ["pass"]


def test_the_results_of_a_run_hold_their_own_window(results_folder: Path) -> None:
    found = read_test(results_folder, None)
    assert found.part is not None and found.part.settled is not None
    assert float(found.dataset["settled_A"]) == pytest.approx(found.part.settled.A_um.value)
    with pytest.raises(CampaignError, match="holds the windows of its run"):
        read_test(results_folder, "1-5")
    with pytest.raises(ResultsError, match=r"there is no results\.json"):
        read_test(results_folder / "maps", None)


def test_a_window_of_cycles_is_read() -> None:
    x, time = np.zeros((8, 2, 2)), np.full((8, 2, 2), np.datetime64("NaT", "ns"))
    deviations = build_deviations(range(1, 9), [1, 2], np.array([0.0, 1.0]), x, time)
    assert read_window(" 2 - 4 ", deviations) == [2, 3, 4]
    assert read_window("8", deviations) == [8]
    with pytest.raises(CampaignError, match="ends before it begins; write for example 2-4"):
        read_window("4-2", deviations)
    with pytest.raises(CampaignError, match="were not measured; there are 1 to 8"):
        read_window("7-9", deviations)
    with pytest.raises(CampaignError, match="asks for cycles that were not measured"):
        read_window(f"1-{10**30}", deviations)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "laser.csv"
    os.mkfifo(pipe)
    with pytest.raises(CampaignError, match=r"laser\.csv: is a pipe, a socket or a device; name a file"):
        read_test(pipe, None)
