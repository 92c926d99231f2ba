"""The twin's plate keeps energy, reaches its steady state, and expands as a uniformly heated table must."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine import duty_levels, make_schedule, refractivity, simulate_air, solve_plate
from fusion.twin.recipe import Duty, Plan, Recipe, Room, Source, Table
from fusion.twin.recipe import Test as PositioningTest
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
    mass = table.density_kg_per_m3 * table.thickness_mm * PLAN.width_mm * PLAN.height_mm * 1e-9
    capacity = mass * table.heat_capacity_J_per_kgK
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


# The air of the twin: published refractivity, and a room that moves as its recipe says.


def test_refractivity_has_the_published_sensitivities():
    def at(t: float = 20.0, p: float = 1013.25, h: float = 50.0) -> float:
        return float(refractivity(np.array(t), np.array(p), np.array(h))) * 1e6

    # Ciddor at 633 nm, 20 degC, 101.325 kPa, dry: n - 1 = 271.800e-6; two published equations agree within 0.03 ppm
    assert at(h=0.0) == pytest.approx(271.800, abs=0.03)
    assert at(t=20.5) - at(t=19.5) == pytest.approx(-0.955, abs=0.005)
    assert at(p=1013.75) - at(p=1012.75) == pytest.approx(0.268, abs=0.001)
    assert at(h=55.0) - at(h=45.0) == pytest.approx(-0.085, abs=0.003)


GRID_S = np.arange(0.0, 4 * 3600.0, 10.0)


def test_temperature_follows_trend_and_swing():
    room = Room(trend_K_per_h=0.5, swing_K=0.2, swing_period_min=60.0)
    turns = 2 * np.pi * GRID_S / 3600.0
    design = np.column_stack([np.ones(GRID_S.size), GRID_S / 3600.0, np.cos(turns), np.sin(turns)])
    fits = [
        np.linalg.lstsq(design, simulate_air(room, GRID_S, seed).temperature_degC, rcond=None)[0] for seed in range(30)
    ]
    trend = np.mean([fit[1] for fit in fits])
    swing = np.mean([np.hypot(*fit[2:]) for fit in fits])
    # the random walk of 0.05 K after an hour moves the mean of 30 slopes by 0.005 K/h and that of 30 amplitudes by a few mK
    assert trend == pytest.approx(0.5, abs=0.02)
    assert swing == pytest.approx(0.2, abs=0.01)


def test_pressure_walks_at_its_stated_rate():
    room = Room(pressure_walk_hPa_per_sqrt_h=0.8)
    after = [simulate_air(room, GRID_S, seed).pressure_hPa[360] - room.pressure_hPa for seed in range(400)]
    # 400 draws know their standard deviation to 3.5 %
    assert np.std(after) == pytest.approx(0.8, rel=0.12)


def test_humidity_falls_as_the_air_warms_and_stays_possible():
    air = simulate_air(Room(trend_K_per_h=20.0), GRID_S, seed=1)
    assert np.corrcoef(air.temperature_degC[:360], air.humidity_percent[:360])[0, 1] < -0.99
    assert air.humidity_percent.min() == 1.0


# The schedule of the test: one reading per target and direction in each cycle, at the feed and dwell of the recipe.


def test_table_stands_at_the_target_through_the_dwell_and_moves_at_the_feed():
    test = PositioningTest(cycles=2, positions_mm=(5.0, 25.0, 60.0), feed_mm_per_min=600.0, dwell_s=3.0, period_s=60.0)
    schedule = make_schedule(test, seed=1)
    for before_s in (0.0, 1.5, 3.0):
        np.testing.assert_allclose(schedule.table_position(schedule.time_s - before_s), schedule.position_mm, atol=1e-9)
    # one second before the dwell it is 10 mm short of the target at 600 mm/min, on the side it comes from
    forward = schedule.sign > 0
    short = schedule.position_mm - schedule.table_position(schedule.time_s - 4.0)
    np.testing.assert_allclose(short[forward & (schedule.target > 1)], 10.0, atol=1e-9)
    np.testing.assert_allclose(short[~forward & (schedule.target < 3)], -10.0, atol=1e-9)
    assert schedule.table_position(np.array([59.9]))[0] == 0.0


def test_jitter_spares_the_first_and_the_last_target():
    positions = make_schedule(PositioningTest(jitter_mm=3.0), seed=1).positions_mm
    offset = positions - 20.0 * np.arange(16)
    assert offset[0] == offset[-1] == 0.0
    assert 1.0 < np.abs(offset).max() <= 3.0


@pytest.mark.parametrize(
    ("kind", "levels"), [("constant", {0.8}), ("switched", {0.2, 0.8}), ("randomised", {0.2, 0.8}), ("random", None)]
)
def test_duty_keeps_to_its_levels(kind, levels):
    duty = duty_levels(Duty(kind=kind, low=0.2, high=0.8, mean_hold_min=5.0), np.arange(0.0, 36000.0, 10.0), seed=2)
    assert duty.min() >= 0.2
    assert duty.max() <= 0.8
    assert levels is None or set(duty.tolist()) == levels
