"""Campaigns for tests: simulated with few cells, or changed copies of one."""

from __future__ import annotations

import re
from pathlib import Path


def simulated(folder: Path, recipe: str) -> Path:
    """Simulate a campaign in a folder and return its file, with cells of 20 mm, which keep it quick."""
    from fusion.twin.instruments import simulate_campaign

    (folder / "recipe.toml").write_text(recipe)
    return change(
        simulate_campaign(folder / "recipe.toml", folder / "campaign"), 'cell_size = "5 mm"', 'cell_size = "20 mm"'
    )


def change(path: Path, old: str, new: str) -> Path:
    """Replace a text that a file holds, and return the file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def keep_cycles(laser: Path, *cycles: int) -> None:
    """Leave some cycles in a table of readings: few take the least time."""
    heading, *lines = laser.read_text().splitlines()
    kept = [line for line in lines if int(line.split(",")[0]) in cycles]
    laser.write_text("\n".join([heading, *kept]) + "\n")


def without(campaign: Path, *tables: str, name: str = "part.toml", added: str = "") -> Path:
    """Write a campaign file beside another one, without some of its tables, and return it; `added` is appended."""
    parts = re.split(r"(?m)^(?=\[)", campaign.read_text())
    kept = [part for part in parts if not any(part.startswith((f"[{table}]", f"[{table}.")) for table in tables)]
    path = campaign.parent / name
    path.write_text("".join(kept) + added)
    return path
