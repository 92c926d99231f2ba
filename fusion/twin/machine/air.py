"""The air around the twin: temperature, pressure, humidity, and the refractive index that the laser lives in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.machine.recipe import Room
from fusion.twin.machine.streams import stream

Floats = NDArray[np.floating[Any]]
WAVELENGTH_UM = 0.6329908


@dataclass(frozen=True)
class Air:
    """True air over time (grid,): degC, hPa, percent."""

    temperature_degC: Floats
    pressure_hPa: Floats
    humidity_percent: Floats

    @property
    def index(self) -> Floats:
        """Refractive index minus 1 at the laser's wavelength."""
        return refractivity(self.temperature_degC, self.pressure_hPa, self.humidity_percent)


def simulate_air(room: Room, grid_s: Floats, seed: int) -> Air:
    """Return the air over the grid times: trend, slow swing, and a random walk of the pressure that a slow barometer would show."""
    hours = grid_s / 3600.0
    rng = stream(seed, "air")
    swing = room.swing_K * np.sin(2 * np.pi * (hours * 60.0 / room.swing_period_min + rng.uniform()))
    walk = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    slow = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    temperature = room.temperature_degC + room.trend_K_per_h * hours + swing + 0.05 * walk
    pressure = room.pressure_hPa + room.pressure_walk_hPa_per_sqrt_h * slow
    humidity = room.humidity_percent - 1.5 * (temperature - room.temperature_degC)
    return Air(temperature, pressure, np.clip(humidity, 1.0, 99.0))


def refractivity(temperature_degC: Floats, pressure_hPa: Floats, humidity_percent: Floats) -> Floats:
    """Return n - 1 of moist air at the laser's wavelength by the modified Edlen equation.

    Source: Birch and Downs, Metrologia 31 (1994) 315, with the vapour pressure of Magnus. Deliberately another equation than
    the analysis uses; both agree within some 1e-8.
    """
    wave = 1.0 / WAVELENGTH_UM**2
    standard = (8342.54 + 2406147.0 / (130.0 - wave) + 15998.0 / (38.9 - wave)) * 1e-8
    pascal = 100.0 * np.asarray(pressure_hPa, dtype=float)
    t = np.asarray(temperature_degC, dtype=float)
    dry = standard * pascal / 96095.43 * (1.0 + 1e-8 * (0.601 - 0.00972 * t) * pascal) / (1.0 + 0.0036610 * t)
    vapour = np.asarray(humidity_percent, dtype=float) / 100.0 * 611.2 * np.exp(17.62 * t / (243.12 + t))
    return np.asarray(dry - vapour * (3.7345 - 0.0401 * wave) * 1e-10)
