"""A test that is watched for 10,000 cycles, time-lapsed: memory, open files and time per cycle stay flat.

A sequence fills at 30 frames/s, the laser's file line by line, and the clock of the machine is set back by a day half-way.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fusion.campaign.config import load_campaign
from fusion.pipeline.watch import follow
from fusion.twin.instruments import write_campaign
from fusion.twin.recipe import Recipe
from fusion.twin.simulate import simulate
from tests.fusion.laboratory import Laboratory
from thermography.io.flir import index_frames
from thermography.io.flir_writer import write_sequence

pytestmark = pytest.mark.long

#: Frames of a cycle, and its length.
FRAMES, CYCLE_S = 6, 8
TARGETS = 3
DAY_S = 86_400


def small_campaign(folder: Path) -> Path:
    """Frames of 96 x 72 pixels with discs that are large enough for them, two cycles, three targets."""
    recipe = Recipe().vary(
        test={"cycles": 2, "targets": TARGETS, "spacing_mm": 100, "period_s": 180},
        camera={"columns": 96, "rows": 72, "focal_px": 1530.0 * 96 / 640, "blur_px": 0.4, "file": "seq"},
        plan={
            "fiducial_diameter_mm": 50,
            "fiducials_x_mm": (60, 350, 640, 60, 350, 640),
            "fiducials_y_mm": (30, 32, 35, 145, 150, 148),
        },
    )
    return write_campaign(simulate(recipe), folder)


def measured(folder: Path, cycles: int) -> Iterator[None]:
    """Append the frames and the readings of a cycle at every step; the last line of each step lacks its end."""
    sequence = next((folder / "thermal").glob("*.seq"))
    (frame, *_), _ = index_frames([sequence])
    first = frame.read()
    sequence.unlink()
    laser, rest = folder / "laser.csv", ""
    laser.write_text("cycle,direction,target,position_mm,time,deviation_um\n")
    rng = np.random.default_rng(1)
    for cycle in range(cycles):
        start = first.time + np.timedelta64(1000 * CYCLE_S * cycle, "ms")
        rise = np.uint16(20.0 * np.sin(cycle / 500.0) ** 2)
        frames = [
            type(first)(**{**vars(first), "counts": first.counts + rise, "time": start + 2000 + 33 * at})
            for at in range(FRAMES)
        ]
        write_sequence(folder / "piece", frames)
        with sequence.open("ab") as file:
            file.write((folder / "piece").read_bytes())
        text = rest
        order = [("positive", t) for t in range(TARGETS)] + [("negative", t) for t in reversed(range(TARGETS))]
        for at, (direction, target) in enumerate(order):
            value = np.sin(cycle / 500.0) + rng.normal(0.0, 0.3)
            text += f"{cycle + 1},{direction},{target + 1},{100 * target},{start + 1000 * at}Z,{value:.4f}\n"
        with laser.open("a") as file:
            file.write(text[:-9])
        rest = text[-9:]
        os.utime(laser, (DAY_S * (cycles - cycle), DAY_S * (cycles - cycle)))
        yield
    with laser.open("a") as file:
        file.write(rest)
    yield


@dataclass
class Usage:
    """What the process uses at one instant: memory (MB), open files, time of the processor (s)."""

    memory_MB: float
    files: int
    seconds: float

    @classmethod
    def now(cls) -> Usage:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return cls(
            pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(list(Path("/proc/self/fd").iterdir())), time.process_time()
        )


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory and open files are read from /proc")
@pytest.mark.slow
@pytest.mark.parametrize("cycles", [240, 10_000])
def test_memory_files_and_time_per_cycle_stay_flat(
    cycles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = small_campaign(tmp_path / "campaign")
    calls, real = itertools.count(), time.time
    monkeypatch.setattr(time, "time", lambda: real() - (DAY_S if next(calls) % 2 else 0))
    pieces = measured(campaign.parent, cycles)
    next(pieces)
    laboratory = Laboratory(pieces)
    loaded = load_campaign(campaign)
    used: list[Usage] = []
    numbers, frames = [], 0
    for state in follow(loaded, stop=laboratory, clock=laboratory.clock):
        assert not state.warnings
        if state.cycle is not None:
            numbers.append(state.cycle.number)
            frames += state.cycle.frames
            if len(numbers) % (cycles // 10) == 0:
                used.append(Usage.now())
    assert numbers == list(range(1, cycles + 1))
    assert frames == FRAMES * cycles and state.readings == 2 * TARGETS * cycles
    # After the first three tenths everything is loaded and the 200 cycles of the estimate are filled.
    grown_MB = used[-1].memory_MB - used[2].memory_MB
    steps = np.diff([each.seconds for each in used])
    print(
        f"\n{cycles} cycles, {frames} frames: {1e3 * steps[2:].mean() / (cycles // 10):.1f} ms of processor per cycle and its writing"
    )
    print(f"last tenth over third {steps[-1] / steps[2]:.2f}; open files {used[2].files} and {used[-1].files}")
    print(f"memory {used[-1].memory_MB:.0f} MB, grown by {grown_MB:.1f} MB over the last seven tenths")
    assert grown_MB < 25.0
    assert used[-1].files == used[2].files
    # The joint estimate falls into one tenth or another.
    assert steps[-1] < 3.0 * steps[2:5].max()
