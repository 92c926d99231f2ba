"""A run into a disk that is full from the start, or fills while it is written to, ends with a message and whole products."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

RECIPE = '[campaign]\ntitle = "A machining centre"\nseed = 44\n[record]\nhours = 10\n'


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "thermofuse", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.fixture(params=["300k", "1600k"])
def disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """A disk of its own: room for nothing, or for all but the report."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={request.param}", "tmpfs", place], check=False, capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no right to mount a disk of its own")
    yield place
    subprocess.run(["umount", place], check=True)


@pytest.mark.slow
def test_a_full_disk_ends_with_a_message_and_whole_products(disk: Path, tmp_path: Path) -> None:
    (tmp_path / "recipe.toml").write_text(RECIPE)
    assert command("simulate", tmp_path / "recipe.toml", "--out", tmp_path / "campaign").returncode == 0
    ended = command("run", tmp_path / "campaign" / "campaign.toml", "--out", disk / "results")
    assert ended.returncode == 2, ended.stderr
    assert "Traceback" not in ended.stderr and str(disk) in ended.stderr and "left" in ended.stderr
    assert not list(disk.rglob("*.partial*"))
    for path in disk.rglob("*.json"):
        json.loads(path.read_text())


@pytest.mark.slow
def test_a_simulation_into_a_full_disk_leaves_nothing(disk: Path, tmp_path: Path) -> None:
    (tmp_path / "recipe.toml").write_text('[campaign]\ntitle = "Three cycles"\n[test]\ncycles = 12\n')
    ended = command("simulate", tmp_path / "recipe.toml", "--out", disk / "campaign")
    assert ended.returncode == 2, ended.stderr
    assert "campaign: cannot be written (No space left on device), and nothing is left there" in ended.stderr
    assert not list(disk.iterdir())
