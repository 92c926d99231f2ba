"""The twin's plate keeps energy, reaches its steady state, and expands as a uniformly heated table must."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.heat import solve_plate
from fusion.twin.machine.recipe import Plan, Recipe, Source, Table
from fusion.twin.simulate import simulate

PLAN = Plan()
SPOT = Source("spot", 210.0, 60.0, 25.0, 20.0, 12.0)


def solve(hours: float, *, convection: float, source: Source = SPOT, step_s: float = 10.0):
    time_s = np.arange(0.0, 3600.0 * hours + step_s, step_s)
    power = np.full((time_s.size, 1), source.power_W)
    table = Table(convection_W_per_m2K=convection)
    return table, solve_plate(PLAN, table, (source,), power, np.zeros(time_s.size), time_s)


def test_all_heat_stays_in_a_plate_without_convection():
    table, plate = solve(2.0, convection=1e-9)
    capacity = (
        table.density_kg_per_m3
        * table.heat_capacity_J_per_kgK
        * table.thickness_mm
        * PLAN.width_mm
        * PLAN.height_mm
        * 1e-9
    )
    # exact but for the vanishing convection and float64
    assert plate.mean()[-1] * capacity == pytest.approx(SPOT.power_W * plate.grid_s[-1], rel=1e-9)


def test_steady_state_gives_off_what_it_takes_in():
    _, plate = solve(40.0, convection=30.0, step_s=60.0)
    area = PLAN.width_mm * PLAN.height_mm * 1e-6
    # after 40 h, 30 time constants of the slowest mode
    assert 30.0 * area * plate.mean()[-1] == pytest.approx(SPOT.power_W, rel=1e-9)


def test_modes_agree_with_an_explicit_finite_difference_solution():
    step_mm, step_s = 5.0, 0.25
    table, plate = solve(0.5, convection=20.0)
    x, y = (np.arange(0.5 * step_mm, size, step_mm) for size in (PLAN.width_mm, PLAN.height_mm))
    footprint = np.exp(
        -0.5 * (((x - SPOT.x_mm) / SPOT.spread_x_mm) ** 2 + ((y[:, None] - SPOT.y_mm) / SPOT.spread_y_mm) ** 2)
    )
    capacity = table.density_kg_per_m3 * table.heat_capacity_J_per_kgK * table.thickness_mm * 1e-3
    heating = SPOT.power_W * footprint / footprint.sum() / (step_mm * 1e-3) ** 2 / capacity
    diffusivity = (
        table.conductivity_W_per_mK / (table.density_kg_per_m3 * table.heat_capacity_J_per_kgK) / (step_mm * 1e-3) ** 2
    )
    rise = np.zeros_like(heating)
    for _ in range(round(1800.0 / step_s)):
        padded = np.pad(rise, 1, mode="edge")
        flow = padded[1:-1, :-2] + padded[1:-1, 2:] + padded[:-2, 1:-1] + padded[2:, 1:-1] - 4.0 * rise
        rise = rise + step_s * (diffusivity * flow - 20.0 / capacity * rise + heating)
    modes = plate.field(np.array([1800.0]), x, y)[0]
    # the difference of second order in a 5 mm step against a 20 mm footprint stays below one percent of the peak
    assert np.abs(modes - rise).max() < 0.01 * rise.max()


def test_sharp_source_is_resolved_below_the_cells_of_the_analysis():
    sharp = Source("sharp", 350.0, 90.0, 14.0, 14.0, 6.0)
    _, plate = solve(0.2, convection=20.0, source=sharp)
    x = np.arange(300.0, 400.0, 0.5)
    line = plate.field(np.array([720.0]), x, np.array([90.0]))[0, 0]
    assert abs(x[line.argmax()] - 350.0) <= 0.5
    assert np.all(np.diff(line[:100]) > 0), "modes that end too early would ring"


def test_uniformly_heated_table_expands_by_alpha_l_dt():
    recipe = Recipe().vary(
        source=(),
        table={"convection_W_per_m2K": 1e6, "initial_temperature_degC": 20.0},
        room={"temperature_degC": 20.0, "trend_K_per_h": 1.0, "swing_K": 0.0},
    )
    truth = simulate(recipe)
    rise = truth.session.at_readings(truth.session.table_rise_K).reshape(recipe.test.cycles, 2, -1)
    rise[:, 1] = rise[:, 1, ::-1]
    expected = 11.7e-6 * truth.readings["position"].values * 1e3 * rise
    assert rise[-1].mean() > 3.0
    np.testing.assert_allclose(truth.readings["axis_expansion"], expected, atol=1e-9)


def test_line_integral_agrees_with_summing_the_field_along_the_line():
    truth = simulate(
        Recipe().vary(plan={"origin_mm": (480.0, 60.0), "direction": (-0.8, 0.6)}, test={"spacing_mm": 12.0})
    )
    at = (np.arange(3600) + 0.5) * 180.0 / 3600
    points = np.array([480.0, 60.0]) + at[:, None] * np.array([-0.8, 0.6])
    time_s = np.array([7200.0])
    along = [truth.plate.field(time_s, x[None], y[None])[0, 0, 0] for x, y in points[10::20]]
    grid_at = np.searchsorted(truth.plate.grid_s, 7200.0)
    integral = truth.plate.line_integrals(np.array([180.0]))[grid_at, 0]
    # 180 midpoints of a smooth field
    assert integral == pytest.approx(np.mean(along) * 180.0, rel=2e-3)
