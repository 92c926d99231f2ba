"""Campaigns for tests: simulated with few cells, or changed copies of one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

#: Directions of approach of a bidirectional test.
BOTH = ("positive", "negative")


def simulated(folder: Path, recipe: str) -> Path:
    """Simulate a campaign in a folder and return its file, with cells of 20 mm, which keep it quick."""
    from fusion.twin.instruments import simulate_campaign

    (folder / "recipe.toml").write_text(recipe)
    return change(
        simulate_campaign(folder / "recipe.toml", folder / "campaign"), 'cell_size = "5 mm"', 'cell_size = "20 mm"'
    )


def change(path: Path, old: str, new: str) -> Path:
    """Replace a text that a file holds, and return the file."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def keep_cycles(laser: Path, *cycles: int) -> None:
    """Leave some cycles in a table of readings: few take the least time."""
    heading, *lines = laser.read_text().splitlines()
    kept = [line for line in lines if int(line.split(",")[0]) in cycles]
    laser.write_text("\n".join([heading, *kept]) + "\n")


def write_laser(folder: Path, cycles: int, targets: int, directions: tuple[str, ...] = BOTH) -> Path:
    """A campaign of the laser alone, made by hand: a profile, a drift that grows along the axis, noise of 0.25 um."""
    rng = np.random.default_rng(1)
    profile, seconds, rows = rng.normal(0.0, 0.6, targets), 0.0, []
    for cycle in range(1, cycles + 1):
        for direction in directions:
            order = range(targets) if direction == "positive" else range(targets - 1, -1, -1)
            for k in order:
                seconds += 4.0
                share = k / (targets - 1)
                value = profile[k] + (2.0 + 6.0 * share) * (1.0 - np.exp(-seconds / 5400.0)) + rng.normal(0.0, 0.25)
                time = np.datetime64("2026-03-09T06:30:00.000") + np.timedelta64(round(1000 * seconds), "ms")
                rows.append(f"{cycle},{direction},{k + 1},{20.0 * k:.1f},{time}Z,{value:.3f}")
            seconds += 20.0
    folder.mkdir(parents=True)
    heading = "cycle,direction,target,position_mm,time,deviation_um"
    (folder / "laser.csv").write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    path = folder / "campaign.toml"
    path.write_text('[campaign]\ntitle = "Size"\n\n[interferometry]\ndeviations = "laser.csv"\n', encoding="utf-8")
    return path


def record_of_rows(folder: Path, *rows: str, name: str = "record") -> Path:
    """Write a record of time, a temperature and a displacement, and return its campaign file."""
    (folder / f"{name}.csv").write_text("\n".join(["time [s],t1 [degC],ch1 [um]", *rows]) + "\n")
    path = folder / f"{name}.toml"
    columns = 'time = "time [s]"\ntemperatures = ["t*"]\ndisplacements = ["ch*"]\n'
    path.write_text(f'[campaign]\ntitle = "{name}"\n\n[record]\nfile = "{name}.csv"\n{columns}')
    return path


def without(campaign: Path, *tables: str, name: str = "part.toml", added: str = "") -> Path:
    """Write a campaign file beside another one, without some of its tables, and return it; `added` is appended."""
    parts = re.split(r"(?m)^(?=\[)", campaign.read_text())
    kept = [part for part in parts if not any(part.startswith((f"[{table}]", f"[{table}.")) for table in tables)]
    path = campaign.parent / name
    path.write_text("".join(kept) + added)
    return path
