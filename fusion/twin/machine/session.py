"""What the effects of the twin act on: the readings of a test, and the states of machine and room behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array
from fusion.twin.machine.schedule import ReadingSequence
from fusion.twin.machine.streams import first_order, random_levels, stream

#: What a body can follow: the logged load, a load that is not logged, a warm-up from the start, or the table's mean rise.
DRIVES = ("duty", "own", "constant", "table")
#: Time constant of the part through which heat reaches a body, as a fraction of the body's own.
INNER_PART = 0.15


@dataclass(frozen=True)
class Session(ReadingSequence):
    """Readings of a test with the states behind them, on an evenly spaced time grid (m,) that begins before the test with a pre-heat.

    Attributes
    ----------
    seed : int
        Seed of the campaign.
    travel_mm : float, mm
        Position of the last target.
    grid_s : (m,) ndarray, s
        Times of the grid; the test starts at 0.
    duty : (m,) ndarray
        Load of the machine, 0..1.
    table_rise_K : (m,) ndarray, K
        Mean temperature rise of the table since the start of the test.
    probe_degC : (m,) ndarray, degC
        Reading of the material temperature sensor.
    air_degC, air_hPa, air_percent : (m,) ndarray
        True temperature, pressure and relative humidity of the air.
    refractivity : (m,) ndarray
        Refractive index of the air minus 1.
    frame_s : (frames,) ndarray, s
        Times of the camera's frames.
    """

    seed: int
    travel_mm: float
    grid_s: Array
    duty: Array
    table_rise_K: Array
    probe_degC: Array
    air_degC: Array
    air_hPa: Array
    air_percent: Array
    refractivity: Array
    frame_s: Array

    @property
    def share(self) -> Array:
        """Position of every reading as a fraction of the travel, (n,), 0..1."""
        return self.position_mm / self.travel_mm

    @property
    def grid_step_s(self) -> float:
        """Step of the time grid, s."""
        return float(self.grid_s[1] - self.grid_s[0])

    def at_readings(self, series: Array) -> Array:
        """Return a series on the grid (m,) at the times of the readings (n,), by linear interpolation."""
        return np.interp(self.time_s, self.grid_s, series)

    def at_frames(self, series: Array) -> Array:
        """Return a series on the grid (m,) at the times of the frames, by linear interpolation."""
        return np.interp(self.frame_s, self.grid_s, series)

    def at_start(self, series: Array) -> float:
        """Return the value of a series on the grid (m,) at the start of the test."""
        return float(np.interp(0.0, self.grid_s, series))

    def state(self, follows: str, time_constant_min: float, name: str) -> Array:
        """Return the state of a body that follows a drive with its own time constant.

        Heat reaches the body through a thinner part with `INNER_PART` of that time constant, so that no response of the twin is
        the plain first-order lag that an analysis is likely to try.

        Parameters
        ----------
        follows : str
            One of `DRIVES`.
        time_constant_min : float, min
            Time constant of the body.
        name : str
            Name of the effect; it selects the random load of the drive "own".

        Returns
        -------
        (m,) ndarray, unit of the drive (1, or K for "table")
            State on the grid less its value at the start of the test.
        """
        rng = stream(self.seed, f"own drive of {name}")
        drive = {
            "duty": lambda: self.duty,
            "own": lambda: random_levels(self.grid_s, 0.0, 1.0, 30.0, rng),
            "constant": lambda: (self.grid_s >= 0).astype(float),
            "table": lambda: self.table_rise_K,
        }[follows]()
        inner = first_order(drive, self.grid_step_s, 60.0 * INNER_PART * time_constant_min)
        body = first_order(inner, self.grid_step_s, 60.0 * time_constant_min)
        return body - self.at_start(body)
