"""What an effect of the twin may look at: the readings and the states of machine and room behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.machine.streams import first_order, random_levels, stream

Floats = NDArray[np.floating[Any]]
DRIVES = ("duty", "own", "constant", "table")
INNER_PART = 0.15


@dataclass(frozen=True)
class Session:
    """Readings (n,) in the order taken, and states over the evenly spaced grid times (m,), s since the start of the test."""

    seed: int
    time_s: Floats
    cycle: NDArray[np.int64]
    sign: NDArray[np.int64]
    target: NDArray[np.int64]
    position_mm: Floats
    travel_mm: float
    cycles: int
    period_s: float
    grid_s: Floats
    duty: Floats
    table_rise_K: Floats
    probe_degC: Floats
    air_degC: Floats
    air_hPa: Floats
    air_percent: Floats
    refractivity: Floats
    frame_s: Floats

    @property
    def share(self) -> Floats:
        """Position over the travel, 0..1, of every reading."""
        return self.position_mm / self.travel_mm

    def at_readings(self, series: Floats) -> Floats:
        """Return a grid series at the readings' own times."""
        return np.interp(self.time_s, self.grid_s, series)

    def at_frames(self, series: Floats) -> Floats:
        """Return a grid series at the frames' times."""
        return np.interp(self.frame_s, self.grid_s, series)

    def state(self, follows: str, time_constant_min: float, name: str) -> Floats:
        """Return the state (grid) of a body that follows a drive with its own time constant, 0 when the test starts.

        Heat reaches the body through a thinner part with `INNER_PART` of that time constant, so that no response of the twin is
        the plain first-order lag that an analysis is likely to try.

        `follows` is "duty" (the logged load), "own" (a load that nobody logs), "constant" (a warm-up from the start) or
        "table" (the mean rise of the table).
        """
        rng = stream(self.seed, f"own drive of {name}")
        drive = {
            "duty": lambda: self.duty,
            "own": lambda: random_levels(self.grid_s, 0.0, 1.0, 30.0, rng),
            "constant": lambda: (self.grid_s >= 0).astype(float),
            "table": lambda: self.table_rise_K,
        }[follows]()
        step_s = self.grid_s[1] - self.grid_s[0]
        inner = first_order(drive, step_s, 60.0 * INNER_PART * time_constant_min)
        body = first_order(inner, step_s, 60.0 * time_constant_min)
        return np.asarray(body - np.interp(0.0, self.grid_s, body))

    def start_of(self, cycle: int) -> float:
        """Return the time at which a cycle starts, s."""
        return (cycle - 1) * self.period_s
