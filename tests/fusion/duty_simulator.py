"""Axes whose heat sources were switched by a known law of chance."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.attribution.duty import DutyLaw
from tests.fusion import field_simulator as simulator

MIDDLE = np.arange(simulator.CYCLES) * simulator.PERIOD_S
FINE = np.arange(0.0, simulator.CYCLES * simulator.PERIOD_S, 60.0)
NAMES = ["spindle", "pump", "drive"]


def run_schedule(law: DutyLaw, rng: np.random.Generator) -> xr.DataArray:
    """Schedules of the three sources drawn from a law, 0 or 1 every minute."""
    courses = np.column_stack([law.course(FINE, rng) for _ in NAMES])
    time = simulator.START + (FINE * 1e9).astype("timedelta64[ns]")
    return xr.DataArray(courses, dims=("time", "source"), coords={"time": time, "source": NAMES})


def driven(
    duty: xr.DataArray, source: int, rng: np.random.Generator, um: float = 3.0, nuisance_um: float = 0.1
) -> xr.Dataset:
    """Readings of an axis that one source moves by `um` at full duty, behind its own body and a lag of 30 min, beside random walks."""
    heated = respond(duty.values[:, [source]], FINE, time_constant_s=simulator.TAU_S[source])
    moved = np.interp(MIDDLE, FINE, respond(heated, FINE, time_constant_s=1800.0)[:, 0])
    walks = nuisance_um * np.cumsum(rng.standard_normal((2, simulator.CYCLES)), axis=1)
    still = np.zeros((simulator.CYCLES, 1, 1))
    return simulator.session(still, um * moved + walks[0], um * moved + walks[1], rng).fused
