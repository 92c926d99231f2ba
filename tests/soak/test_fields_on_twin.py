"""Registration, fields, knocks and clock on campaigns of the twin, against its truth.

Reproduces the figures of docs/method/registration.md and docs/method/fields.md: registration and field of one frame per cycle under two
distortions, the knock of 3 px, and the place of a moving table with its clock offset.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fusion.analysis.alignment.align import cycle_bounds
from fusion.twin import simulate
from fusion.twin.camera import make_view
from fusion.twin.instruments import deviations_of, write_campaign
from fusion.twin.recipe import Recipe
from thermography.fields.moving import reduce_moving_frames
from thermography.fields.still import reduce_frames
from thermography.io.flir import index_frames
from thermography.radiometry.planck import Overrides, calibrate
from thermography.registration.clock_offset import estimate_clock_offset
from thermography.registration.plan import PlanGrid, read_fiducials
from thermography.registration.register import register

pytestmark = pytest.mark.slow

GRID = PlanGrid(700, 180, 5)


class Filmed:
    """A campaign of the twin, its frames, its truth, and the plan registered on the first frame."""

    def __init__(self, folder: Path, **tables: dict) -> None:
        self.truth = simulate(Recipe().vary(**tables))
        write_campaign(self.truth, folder)
        self.frames, rejected = index_frames(sorted((folder / "thermal").iterdir()))
        assert rejected == []
        camera = self.truth.recipe.camera
        self.override = Overrides({"emissivity": camera.emissivity})
        fiducials = read_fiducials(folder / "fiducials.csv")
        first = self.frames[0].read()
        self.registration = register(calibrate(first.counts, self.override(first)), fiducials, grid=GRID)
        self.view = make_view(camera)
        offset = np.timedelta64(round(camera.clock_offset_s * 1e9), "ns")
        self.bounds = cycle_bounds(deviations_of(self.truth)) + offset

    def registration_rms_mm(self, shift_mm: float = 0.0) -> float:
        plan = np.stack(np.meshgrid(GRID.x_mm, GRID.y_mm), axis=-1).reshape(-1, 2)
        error = self.view.to_plan(self.registration.to_sensor(plan)) - plan - (shift_mm, 0.0)
        return float(np.sqrt((error**2).sum(axis=1).mean()))

    def cells_at(self, seconds: np.ndarray) -> np.ndarray:
        return self.truth.temperature(seconds, GRID.x_mm, GRID.y_mm, cell_mm=GRID.cell_size_mm)


@pytest.mark.parametrize("k1", [-0.3, -1.2])
def test_registration_and_field_of_one_frame_per_cycle(tmp_path: Path, k1: float) -> None:
    filmed = Filmed(tmp_path / "still", campaign={"seed": 3}, test={"cycles": 8}, camera={"k1": k1, "file": "seq"})
    fields = reduce_frames(filmed.frames, filmed.registration, GRID, filmed.bounds, override=filmed.override)
    error = fields["temperature"].values - filmed.cells_at(filmed.truth.session.frame_s)
    rms, bias = np.sqrt(np.nanmean(error**2)), np.nanmean(error)
    ratio = np.sqrt(np.nanmean((error / fields["temperature_noise_u"].values) ** 2))
    place = filmed.registration_rms_mm()
    print(
        f"\nk1 {k1}: {filmed.registration.model}, registration rms {place:.3f} mm; field rms {1e3 * rms:.1f} mK, bias {1e3 * bias:.2f} mK, "
        f"largest {1e3 * np.nanmax(np.abs(error)):.0f} mK, error / stated u {ratio:.2f}, cells seen {np.isfinite(error).mean():.3f}"
    )
    assert place < 0.15
    # 50 mK of noise and 17 pixels per cell of 5 mm.
    assert rms < 0.015
    assert abs(bias) < 0.002


def test_knock_of_3_px_is_found_at_its_frame(tmp_path: Path) -> None:
    camera = {"frames_per_cycle": 4, "knock_cycle": 11, "knock_px": (3.0, 0.0), "file": "seq"}
    filmed = Filmed(tmp_path / "knock", campaign={"seed": 4}, test={"cycles": 14}, camera=camera)
    fields = reduce_frames(filmed.frames, filmed.registration, GRID, filmed.bounds, override=filmed.override)
    (knock,) = json.loads(fields.attrs["knocks"])
    error = fields["temperature"].values - filmed.cells_at(filmed.truth.session.frame_s[::4])
    print(
        f"\nknock found at frame {knock['index']} of shift {knock['shift_px']}; field rms {1e3 * np.sqrt(np.nanmean(error**2)):.1f} mK"
    )
    assert knock["index"] == int(np.flatnonzero(filmed.truth.frames["knocked"].values)[0]) == 40
    assert knock["shift_px"] == pytest.approx([3.0, 0.0], abs=0.1)
    assert np.sqrt(np.nanmean(error**2)) < 0.012


def test_moving_table_and_its_clock(tmp_path: Path) -> None:
    camera = {
        "table": "moving", "file": "seq", "k1": -1.2, "distance_mm": 2300.0, "centre_mm": (498.0, 92.0),
        "frame_interval_s": 9.7, "clock_offset_s": 37.0, "state_clock_offset": False,
    }  # fmt: skip
    filmed = Filmed(tmp_path / "moving", campaign={"seed": 5}, test={"cycles": 5}, camera=camera)
    fields = reduce_moving_frames(
        filmed.frames, filmed.registration, GRID, filmed.bounds, direction=(-1, 0), override=filmed.override
    )
    true_mm = filmed.truth.schedule.table_position(filmed.truth.session.frame_s)
    error = fields["table_position"].values - (true_mm - true_mm[0])
    deviations = deviations_of(filmed.truth)
    clock = estimate_clock_offset(
        fields["frame_time"].values,
        fields["table_position"].values,
        fields["table_position_u"].values,
        deviations["time"].values,
        deviations["position"].broadcast_like(deviations["time"]).values.ravel(),
        reading_phase=1.0,
    )
    cycle = filmed.truth.session.frame_s // filmed.truth.schedule.period_s
    mean = np.stack([filmed.cells_at(filmed.truth.session.frame_s[cycle == n]).mean(axis=0) for n in range(5)])
    field = fields["temperature"].values - mean
    print(
        f"\nmoving: place of the table rms {np.sqrt(np.nanmean(error**2)):.3f} mm, largest {np.nanmax(np.abs(error)):.3f} mm in "
        f"{len(error)} frames; field rms {1e3 * np.sqrt(np.nanmean(field**2)):.1f} mK, bias {1e3 * np.nanmean(field):.2f} mK; "
        f"clock offset {clock.offset_s:.4f} +- {clock.offset_u_s:.4f} s, feed {clock.feed_mm_per_min:.2f} mm/min"
    )
    assert np.nanmax(np.abs(error)) < 0.3
    assert clock.offset_s == pytest.approx(37.0, abs=0.2)
    assert abs(clock.offset_s - 37.0) < 3 * clock.offset_u_s
    # Frames of a cycle are not spread evenly over it where the table was not found; the field warms by some 10 mK within a cycle.
    assert np.sqrt(np.nanmean(field**2)) < 0.015
