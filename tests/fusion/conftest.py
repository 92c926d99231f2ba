"""A small campaign of the twin and its results, simulated and run once for all tests that look at products."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import pytest
from filelock import FileLock

from tests.fusion.campaign_parts import change, simulated, without

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

#: What a user may add: a line in the picture, tolerances and the machine.
STATED = """
[[thermography.region]]
name = "edge"
line = [["100 px", "200 px"], ["500 px", "200 px"]]

[acceptance]
A = "20 um"
B = "1 um"

[report]
machine = "Mill 900"
machine_serial_number = "4711"
operator = "J. Doe"
"""

#: A record of a spindle with a heat source that no sensor sees.
RECORD = """
[campaign]
title = "A spindle"
seed = 44

[record]
hours = 18
sensors = 5
channels = 2

[[effect]]
name = "unseen_heat_source"
amplitude_um = 6
"""

#: What decides the products of a run: the program, what it knows, and how tests make their campaigns.
_SOURCES = ("thermofuse", "thermography", "interferometry", "fusion", "data", "tests/fusion")


@pytest.fixture(scope="session")
def kept(pytestconfig: pytest.Config) -> Callable[[str, Callable[[Path], object]], Path]:
    """Return a function that fills a folder once for all workers, and for later calls of a day while no source changes."""
    digest = sha256((sys.version + (pytestconfig.rootpath / "constraints.txt").read_text(encoding="utf-8")).encode())
    for path in sorted(each for source in _SOURCES for each in (pytestconfig.rootpath / source).rglob("*.*")):
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith("test_"):
            digest.update(str(path.relative_to(pytestconfig.rootpath)).encode() + path.read_bytes())
    base = pytestconfig.rootpath / "build" / "kept"
    root = base / digest.hexdigest()

    def fill_once(name: str, fill: Callable[[Path], object]) -> Path:
        root.mkdir(parents=True, exist_ok=True)
        folder, whole = root / name, root / f"{name}.whole"
        with FileLock(root / f"{name}.lock"):
            if not whole.exists():
                for earlier in base.iterdir():
                    if earlier != root and earlier.stat().st_mtime < time.time() - 86400.0:
                        shutil.rmtree(earlier, ignore_errors=True)
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                whole.touch()
        return folder

    return fill_once


@pytest.fixture(scope="session")
def campaign_folder(kept: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A campaign of 24 cycles and 6 targets with a reversal that drifts, undeclared; tests do not change it."""
    return kept("simulated", lambda folder: simulated(folder, RECIPE)) / "campaign"


@pytest.fixture(scope="session")
def results_folder(kept: Callable[[str, Callable[[Path], object]], Path], campaign_folder: Path) -> Path:
    """The products of that campaign, complete; tests do not change them."""
    from fusion.pipeline.run import run_campaign

    return kept("run", lambda folder: run_campaign(campaign_folder / "campaign.toml", folder / "results")) / "results"


@pytest.fixture(scope="session")
def part_results(kept: Callable[[str, Callable[[Path], object]], Path], campaign_folder: Path) -> Callable[..., Path]:
    """Return a function that runs the small campaign without some tables of its file, once for all workers; tests do not change them."""
    from fusion.pipeline.run import run_campaign

    def run_once(name: str, *tables: str, added: str = "", changes: dict[str, str] | None = None) -> Path:
        def fill(folder: Path) -> None:
            copy = shutil.copytree(campaign_folder, folder / "campaign")
            path = without(copy / "campaign.toml", *tables, added=added)
            for old, new in (changes or {}).items():
                change(path, old, new)
            run_campaign(path, folder / "results")

        return kept(name, fill) / "results"

    return run_once


@pytest.fixture(scope="session")
def spindle(kept: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """The folder of a record, `campaign`, and its `results`, by the command; tests do not change them."""
    from typer.testing import CliRunner

    from fusion.cli import app

    def fill(folder: Path) -> None:
        (folder / "recipe.toml").write_text(RECORD)
        for command in (
            ("simulate", folder / "recipe.toml", "--out", folder / "campaign"),
            ("run", folder / "campaign" / "campaign.toml", "--out", folder / "results"),
        ):
            ended = CliRunner().invoke(app, [str(word) for word in command])
            assert ended.exit_code == 0, ended.output

    return kept("spindle", fill)


@pytest.fixture(scope="session")
def laser_results(part_results: Callable[..., Path]) -> Path:
    """The products of the small campaign without camera and plan."""
    return part_results("laser", "thermography", "plan", "model")


@pytest.fixture(scope="session")
def camera_results(part_results: Callable[..., Path]) -> Path:
    """The products of the small campaign without laser, by windows of time."""
    windows = {'table = "still"': 'window = "6 min"\ntable = "still"'}
    return part_results("camera", "interferometry", "plan.axis", "model", changes=windows)


@pytest.fixture(scope="session")
def picture_results(part_results: Callable[..., Path]) -> Path:
    """The products of the pictures of the small campaign, whose fiducials nobody states."""
    pixels = '\n[plan]\nregistration = "pixels"\n'
    return part_results("pictures", "interferometry", "plan", "model", "drivers", added=pixels)


@pytest.fixture(scope="session")
def stated_results(part_results: Callable[..., Path]) -> Path:
    """The products of the small campaign with a line in the picture, tolerances and the machine."""
    return part_results("stated", added=STATED)


@pytest.fixture
def copied(campaign_folder: Path, tmp_path: Path) -> Path:
    """A copy of the campaign that a test may damage."""
    return shutil.copytree(campaign_folder, tmp_path / "campaign")


def draw_no_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs whose page nobody looks at draw no charts: they are half of the time of a small campaign."""
    from fusion.report.charts.embedded import Drawn

    for name in ("_draw", "_draw_attributed"):
        monkeypatch.setattr(f"fusion.pipeline.run.{name}", lambda *_: Drawn({}))


def search_few(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Runs in which nobody looks for causes search for some effects only."""
    from fusion.analysis.effects.library import library

    few = {name: library()[name] for name in names}
    for module in ("analysis.drift_model.record", "pipeline.drift_model"):
        monkeypatch.setattr(f"fusion.{module}.library", lambda: few)


@pytest.fixture
def no_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_no_charts(monkeypatch)


@pytest.fixture
def few_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    search_few(monkeypatch, "axis_expansion", "table_offset", "reversal_drift")
