"""Air around the simulated machine: temperature, pressure, humidity and the refractive index at the laser's wavelength."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array
from fusion.twin.machine.recipe import Room
from fusion.twin.machine.streams import stream

#: Vacuum wavelength of the helium-neon laser, um.
WAVELENGTH_UM = 0.6329908


@dataclass(frozen=True)
class Air:
    """True state of the air on the simulation's time grid.

    Attributes
    ----------
    temperature_degC, pressure_hPa, humidity_percent : (m,) ndarray
        Temperature, pressure and relative humidity at each grid time.
    """

    temperature_degC: Array
    pressure_hPa: Array
    humidity_percent: Array

    @property
    def index(self) -> Array:
        """Refractive index minus 1 at the laser's wavelength, (m,)."""
        return refractivity(self.temperature_degC, self.pressure_hPa, self.humidity_percent)


def simulate_air(room: Room, grid_s: Array, seed: int) -> Air:
    """Simulate the air: a linear trend and a sinusoidal swing of the temperature, and random walks of temperature and pressure.

    Parameters
    ----------
    room : Room
        Mean state, trend, swing and intensity of the pressure's random walk.
    grid_s : (m,) ndarray, s
        Evenly spaced times; the test starts at 0.
    seed : int
        Seed of the campaign.

    Returns
    -------
    Air
        Relative humidity falls by 1.5 % per K of the air's warming and stays within 1..99 %.
    """
    hours = grid_s / 3600.0
    rng = stream(seed, "air")
    swing = room.swing_K * np.sin(2 * np.pi * (hours * 60.0 / room.swing_period_min + rng.uniform()))
    temperature_walk = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    pressure_walk = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    temperature = room.temperature_degC + room.trend_K_per_h * hours + swing + 0.05 * temperature_walk
    pressure = room.pressure_hPa + room.pressure_walk_hPa_per_sqrt_h * pressure_walk
    humidity = room.humidity_percent - 1.5 * (temperature - room.temperature_degC)
    return Air(temperature, pressure, np.clip(humidity, 1.0, 99.0))


def refractivity(temperature_degC: Array, pressure_hPa: Array, humidity_percent: Array) -> Array:
    """Return the refractivity n - 1 of moist air at the laser's wavelength by the modified Edlen equation.

    Parameters
    ----------
    temperature_degC : ndarray, degC
        Temperature of the air.
    pressure_hPa : ndarray of the same shape, hPa
        Total pressure.
    humidity_percent : ndarray of the same shape, %
        Relative humidity, 0..100.

    Returns
    -------
    ndarray of the same shape
        n - 1.

    Notes
    -----
    Birch and Downs, Metrologia 31 (1994) 315, with the saturation vapour pressure of Magnus in the constants of the WMO (Guide to
    Instruments and Methods of Observation, annex 4.B). This is deliberately not the equation of the analysis; the two agree to a few 1e-8.
    """
    wave = 1.0 / WAVELENGTH_UM**2
    standard = (8342.54 + 2406147.0 / (130.0 - wave) + 15998.0 / (38.9 - wave)) * 1e-8
    pascal = 100.0 * np.asarray(pressure_hPa, dtype=float)
    t = np.asarray(temperature_degC, dtype=float)
    dry = standard * pascal / 96095.43 * (1.0 + 1e-8 * (0.601 - 0.00972 * t) * pascal) / (1.0 + 0.0036610 * t)
    vapour = np.asarray(humidity_percent, dtype=float) / 100.0 * 611.2 * np.exp(17.62 * t / (243.12 + t))
    return np.asarray(dry - vapour * (3.7345 - 0.0401 * wave) * 1e-10)
