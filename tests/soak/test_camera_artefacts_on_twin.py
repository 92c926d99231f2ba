"""Flat-field steps on frames of the twin, whose table moves and warms under the camera: docs/method/radiometry.md, "The camera itself"."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.twin import simulate
from fusion.twin.instruments import write_campaign
from fusion.twin.machine.recipe import Recipe
from thermography.io.flir import index_frames
from thermography.radiometry.camera_artefacts import find_repeats, find_steps, read_levels

pytestmark = pytest.mark.slow


def _record(folder: Path, *, ffc_step_K: float, table: str, cycles: int) -> tuple:
    """Write a campaign of the twin with a small detector; return its frames and the planted offset of each, K."""
    small = {"columns": 160, "rows": 120, "focal_px": 382.0, "file": "seq"}
    camera = {**small, "table": table, "frame_interval_s": 10.0, "ffc_step_K": ffc_step_K}
    truth = simulate(Recipe().vary(campaign={"seed": 5}, test={"cycles": cycles}, camera=camera))
    write_campaign(truth, folder)
    frames, rejected = index_frames(sorted((folder / "thermal").iterdir()))
    assert rejected == []
    return frames, truth.frames["camera_offset_K"].values


def test_no_step_in_a_thousand_frames_without_one(tmp_path: Path) -> None:
    frames, _ = _record(tmp_path / "still", ffc_step_K=0.0, table="moving", cycles=41)
    assert len(frames) >= 1000
    levels = read_levels(frames[:1000])
    steps = [flag for flag in find_steps(levels) if flag.cause == "flat_field_step"]
    print(f"{len(frames)} frames, {len(steps)} steps, {len(find_steps(levels)) - len(steps)} transients")
    assert steps == [] and find_repeats(levels) == []


def test_planted_steps_on_a_moving_table(tmp_path: Path) -> None:
    frames, offset = _record(tmp_path / "moving", ffc_step_K=0.3, table="moving", cycles=12)
    # The offset acts at the detector; through emissivity 0.97 and the air it reads that much larger on the surface.
    seen = np.diff(offset) / (0.97 * 0.993)
    planted = {int(index): float(size) for index, size in enumerate(seen, start=1) if abs(size) > 0.15}
    found = {flag.index: flag.value_K for flag in find_steps(read_levels(frames)) if flag.cause == "flat_field_step"}
    print(f"planted {planted}, found {found}")
    for index, size in planted.items():
        near = [value for place, value in found.items() if abs(place - index) <= 1]
        assert near, f"the step of {size:.3f} K at frame {index} was not found"
        assert near[0] == pytest.approx(size, abs=0.03)
    assert len(found) <= np.count_nonzero(np.diff(offset))
