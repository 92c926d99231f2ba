"""Surfaces with an emissivity of their own: cells, temperatures, and an emissivity from two states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from tests.thermography.fields.test_cycle_fields import part
from tests.thermography.flir_mutations import PARAMETERS
from thermography.errors import ThermographyError
from thermography.fields.cycle_fields import SURFACE_EDGE, assemble_fields
from thermography.fields.surfaces import EmissivityRegion, calibrate_surfaces, find_surfaces, measure_emissivity
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import counts_from_temperature, override, temperature_from_counts
from thermography.registration.plan import PlanGrid
from thermography.registration.polygon import Polygon

CAMERA = override(PARAMETERS, emissivity=0.97, object_distance_m=1.2, reflected_temperature_K=295.15)
PLAN = PlanGrid(100, 60, 5)
SURE, WHOLE = np.zeros((*PLAN.shape, 2, 2)), np.ones(PLAN.shape)
STEEL = Polygon("steel", np.array([(0, 0), (40, 0), (40, 60), (0, 60)]))
BARE = EmissivityRegion(STEEL, 0.35, 0.05)
TRUE = (25.0, 30.0, 35.0)


def steel_beside_paint(coverage: np.ndarray = WHOLE) -> xr.Dataset:
    """Fields of a table of one temperature, its left part bare steel, all calibrated as paint."""
    parts = []
    for cycle, celsius in enumerate(TRUE):
        counts = counts_from_temperature(celsius, CAMERA, emissivity=np.where(PLAN.x_mm < 40, 0.35, 0.97))
        field = np.broadcast_to(temperature_from_counts(counts, CAMERA), PLAN.shape).copy()
        one = part(cycle, 0.0, start_s=600.0 * cycle)
        shaped = {name: np.full(PLAN.shape, value) for name, value in (("spread", 0.1), ("noise_variance", 1e-4))}
        parts.append(replace(one, mean=field, fell_back=field < 0, count=np.full(PLAN.shape, 4), **shaped))
    stack = np.stack([one.mean for one in parts]).astype(np.float32)
    return assemble_fields(
        parts, 3, PLAN, [SURE], [coverage], frames={"frame_temperature": (("time", "y", "x"), stack)}
    )  # fmt: skip


def calibrated(fields: xr.Dataset, regions: list[EmissivityRegion]) -> xr.Dataset:
    surfaces, edge = find_surfaces(fields, regions, emissivity=0.97, emissivity_u=0.01)
    cameras: dict[str, list[CameraParameters]] = {"cycle": [CAMERA] * 3, "time": [CAMERA] * 3}
    return calibrate_surfaces(fields, surfaces, edge, cameras)


def test_bare_steel_beside_paint_has_the_temperature_of_the_table() -> None:
    raw = steel_beside_paint()
    assert float(raw["temperature"][2, 0, 0]) < 28.0
    done = calibrated(raw, [BARE])
    for name in ("temperature", "frame_temperature"):
        for cycle, celsius in enumerate(TRUE):
            np.testing.assert_allclose(
                done[name][cycle].values[np.isfinite(done[name][cycle].values)], celsius, atol=1e-4
            )
    np.testing.assert_allclose(done["temperature_rise"][2, 0, [0, 15]], 10.0, atol=1e-4)
    np.testing.assert_allclose(done["temperature_rate"][1, 0, [0, 15]], 30.0, rtol=1e-4)
    # A camera sees steel through 0.35 of its radiation, so that its noise is 0.97 / 0.35 times that of paint, less the curvature.
    assert float(done["temperature_noise_u"][0, 0, 0] / done["temperature_noise_u"][0, 0, 15]) == pytest.approx(
        2.7, rel=0.05
    )


def test_cells_at_the_edge_are_empty_and_flagged() -> None:
    done = calibrated(steel_beside_paint(), [BARE])
    empty = np.isnan(done["temperature"][0].values)
    assert np.flatnonzero(empty[0]).tolist() == [7, 8]
    assert ((done["quality_flag"][0].values & SURFACE_EDGE > 0) == empty).all()
    crossing = EmissivityRegion(Polygon("steel", np.array([(0, 0), (42, 0), (42, 60), (0, 60)])), 0.35, 0.05)
    assert np.flatnonzero(np.isnan(calibrated(steel_beside_paint(), [crossing])["temperature"][0, 0])).tolist() == [
        7,
        8,
    ]


def test_partly_seen_cells_beside_the_edge_are_left_out_too() -> None:
    coverage = WHOLE.copy()
    coverage[3, 9] = 0.8
    assert np.isnan(calibrated(steel_beside_paint(coverage), [BARE])["temperature"][0, 3, 9])


def test_a_later_region_covers_an_earlier_one() -> None:
    tape = EmissivityRegion(Polygon("tape", np.array([(10, 10), (30, 10), (30, 50), (10, 50)])), 0.95, 0.01)
    surfaces, _ = find_surfaces(steel_beside_paint(), [BARE, tape], emissivity=0.97, emissivity_u=0.01)
    assert [surface.name for surface in surfaces] == ["", "steel", "tape"]
    assert surfaces[2].cells[5, 4] and not surfaces[1].cells[5, 4]
    assert not (surfaces[0].cells & surfaces[1].cells).any()


def test_a_region_without_a_cell_of_its_own_is_refused() -> None:
    strip = EmissivityRegion(Polygon("strip", np.array([(20, 0), (28, 0), (28, 60), (20, 60)])), 0.35, 0.05)
    with pytest.raises(ThermographyError, match="region strip: no cell lies inside and away from its edge"):
        find_surfaces(steel_beside_paint(), [strip], emissivity=0.97, emissivity_u=0.01)


def test_emissivity_from_two_cycles_of_known_temperature() -> None:
    states = [(1, 25.0, 0.1), (3, 35.0, 0.1)]
    found = measure_emissivity(steel_beside_paint(), STEEL, states, CAMERA, camera_scale=0.0)
    assert found.emissivity == pytest.approx(0.35, abs=1e-4)
    # Two temperatures of 0.1 K over 10 K are 1.4 %.
    assert found.emissivity_u == pytest.approx(0.014 * 0.35, rel=0.1)
    scaled = measure_emissivity(steel_beside_paint(), STEEL, states, CAMERA, camera_scale=0.02)
    assert scaled.emissivity_u == pytest.approx(np.hypot(found.emissivity_u, 0.007), rel=1e-3)


def test_states_that_say_nothing_are_refused() -> None:
    raw = steel_beside_paint()
    with pytest.raises(ThermographyError, match="there is no cycle 9; name a measured one"):
        measure_emissivity(raw, STEEL, [(1, 25.0, 0.1), (9, 35.0, 0.1)], CAMERA, camera_scale=0.0)
    with pytest.raises(ThermographyError, match="determines none; check their temperatures"):
        measure_emissivity(raw, STEEL, [(1, 25.0, 2.0), (2, 30.0, 2.0)], CAMERA, camera_scale=0.0)
    empty = raw.assign(temperature=raw["temperature"].where(raw["x"] > 40))
    with pytest.raises(ThermographyError, match="cycle 1 shows no cell of it"):
        measure_emissivity(empty, STEEL, [(1, 25.0, 0.1), (3, 35.0, 0.1)], CAMERA, camera_scale=0.0)
