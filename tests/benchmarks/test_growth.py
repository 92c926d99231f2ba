"""How processor time and memory of each stage grow with cycles, targets, frames, pixels, cells or logs, one at a time.

The exponent is the logarithm of the ratio over that of the factor: 1 grows with the size, 0 does not grow. Stages below 0.2 s are left
out, their time being that of the calls.
"""

from __future__ import annotations

import csv
import math
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.simulate import simulate
from tests.benchmarks.test_memory_long_campaigns import run_measured

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peak memory is read from /proc"),
]

_LEAST_S = 0.2
#: A stage whose time grows faster than this has its reason in docs/measured.csv.
_STEEP = 1.2
_BASE = Recipe(
    effect=(EffectRecipe("unseen_heat_source", amplitude_um=0.8, parameters={"time_constant_min": 14.0}),)
).vary(
    test={"cycles": 60, "period_s": 300.0},
    camera={"columns": 320, "rows": 240, "focal_px": 765.0, "file": "seq", "frames_per_cycle": 4},
)


def _finer_cells(campaign: Path) -> None:
    """Four times the cells."""
    text = campaign.read_text(encoding="utf-8")
    campaign.write_text(text.replace('cell_size = "5 mm"', 'cell_size = "2.5 mm"'), encoding="utf-8")


def _second_log(campaign: Path) -> None:
    """A second load beside the first one, switched at random, by which nothing is driven."""
    chance, load = random.Random(5), 0.0
    path = campaign.with_name("drivers.csv")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    rows[0].append("coolant [1]")
    for row in rows[1:]:
        load = chance.random() if chance.random() < 0.04 else load
        row.append(f"{load:.3f}")
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)


def _as_written(campaign: Path) -> None:
    """Nothing to change."""


#: What is enlarged -> by which factor, the recipe, and what is changed in the campaign that it writes.
ENLARGED: dict[str, tuple[float, Recipe, Callable[[Path], None]]] = {
    "nothing": (1.0, _BASE, _as_written),
    "cycles": (2.0, _BASE.vary(test={"cycles": 120}), _as_written),
    "targets": (2.0, _BASE.vary(test={"targets": 32, "spacing_mm": 300 / 31}), _as_written),
    "frames": (2.0, _BASE.vary(camera={"frames_per_cycle": 8}), _as_written),
    "pixels": (4.0, _BASE.vary(camera={"columns": 640, "rows": 480, "focal_px": 1530.0}), _as_written),
    "cells": (4.0, _BASE, _finer_cells),
    "logs": (2.0, _BASE, _second_log),
}


def test_growth_of_every_stage(tmp_path: Path) -> None:
    seconds: dict[str, dict[str, float]] = {}
    peaks: dict[str, dict[str, float]] = {}
    for what, (_, recipe, change) in ENLARGED.items():
        campaign = write_campaign(simulate(recipe), tmp_path / what)
        change(campaign)
        found = run_measured(campaign, tmp_path / f"{what}_results")
        seconds[what] = {**found["seconds"], "whole run": found["processor_s"]}
        peaks[what] = {stage: private for stage, (_, private) in found["peaks"].items()}
    base, memory = seconds.pop("nothing"), peaks.pop("nothing")

    def exponent(what: str, ratio: float) -> float:
        return math.log(ratio) / math.log(ENLARGED[what][0])

    steep, greedy = list[str](), list[str]()
    print(f"\n{'grows with':<28}{'':>8}" + "".join(f"{what:>9}" for what in seconds))
    for stage, spent in base.items():
        if spent >= _LEAST_S:
            exponents = {what: exponent(what, other[stage] / spent) for what, other in seconds.items()}
            print(f"{stage:<28}{spent:6.2f} s" + "".join(f"{value:9.2f}" for value in exponents.values()))
            steep += [f"{stage} by {what} {value:.2f}" for what, value in exponents.items() if value > _STEEP]
    print("peak memory of each stage")
    for stage, peak in memory.items():
        exponents = {what: exponent(what, other[stage] / peak) for what, other in peaks.items()}
        print(f"{stage:<28}{peak:5.0f} MB" + "".join(f"{value:9.2f}" for value in exponents.values()))
        greedy += [f"{stage} by {what} {value:.2f}" for what, value in exponents.items() if value > _STEEP]
    print(f"steeper than {_STEEP}: {'; '.join(steep) or 'none'}")
    assert all(other.keys() == base.keys() for other in seconds.values())
    # Time is that of a machine with other work; memory is that of the run alone.
    assert not greedy
