"""A small campaign of the twin and its results, simulated and run once for all tests that look at products."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.fusion.campaign_parts import simulated

RECIPE = """\
[campaign]
title = "Small campaign"
axis = "X"
seed = 5

[test]
cycles = 24
targets = 6
spacing_mm = 50
period_s = 180

[duty]
kind = "random"
mean_hold_min = 12

[laser]
noise_um = 0.3

[[effect]]
name = "reversal_drift"
amplitude_um = 1.5
"""


@pytest.fixture(scope="session")
def campaign_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of 24 cycles and 6 targets with a reversal that drifts, undeclared."""
    return simulated(tmp_path_factory.mktemp("twin"), RECIPE).parent


@pytest.fixture(scope="session")
def results_folder(campaign_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The products of that campaign, complete."""
    from fusion.pipeline.run import run_campaign

    out = tmp_path_factory.mktemp("run") / "results"
    run_campaign(campaign_folder / "campaign.toml", out)
    return out


@pytest.fixture
def copied(campaign_folder: Path, tmp_path: Path) -> Path:
    """A copy of the campaign that a test may damage."""
    return shutil.copytree(campaign_folder, tmp_path / "campaign")


@pytest.fixture
def no_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs whose page nobody looks at draw no charts: they are half of the time of a small campaign."""
    from fusion.report.charts.embedded import Drawn

    for name in ("_draw", "_draw_attributed"):
        monkeypatch.setattr(f"fusion.pipeline.run.{name}", lambda *_: Drawn({}))
