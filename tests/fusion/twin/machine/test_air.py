"""The air of the twin: published refractivity, and a room that moves as its recipe says."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.air import refractivity, simulate_air
from fusion.twin.machine.recipe import Room


def test_refractivity_has_the_published_sensitivities():
    def at(t: float = 20.0, p: float = 1013.25, h: float = 50.0) -> float:
        return float(refractivity(np.array(t), np.array(p), np.array(h))) * 1e6

    # Ciddor at 633 nm, 20 degC, 101.325 kPa, dry: n - 1 = 271.800e-6; two published equations agree within 0.03 ppm
    assert at(h=0.0) == pytest.approx(271.800, abs=0.03)
    assert at(t=20.5) - at(t=19.5) == pytest.approx(-0.955, abs=0.005)
    assert at(p=1013.75) - at(p=1012.75) == pytest.approx(0.268, abs=0.001)
    assert at(h=55.0) - at(h=45.0) == pytest.approx(-0.085, abs=0.003)


GRID_S = np.arange(0.0, 4 * 3600.0, 10.0)


def test_index_is_the_refractivity_of_the_airs_own_state():
    air = simulate_air(Room(), GRID_S, seed=3)
    expected = refractivity(air.temperature_degC, air.pressure_hPa, air.humidity_percent)
    np.testing.assert_array_equal(air.index, expected)
    # n - 1 is proportional to p / T: 1 hPa in 1000 or 0.3 K in 300 change 270e-6 by 0.27e-6
    assert np.ptp(air.index) < 3e-6


def test_temperature_follows_trend_and_swing():
    room = Room(trend_K_per_h=0.5, swing_K=0.2, swing_period_min=60.0)
    design = np.column_stack(
        [
            np.ones(GRID_S.size),
            GRID_S / 3600.0,
            np.cos(2 * np.pi * GRID_S / 3600.0),
            np.sin(2 * np.pi * GRID_S / 3600.0),
        ]
    )
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
