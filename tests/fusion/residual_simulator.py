"""Campaigns with one anomalous target (number 3) of known cause, under a drift that is a random walk."""

from __future__ import annotations

import numpy as np
import xarray as xr

from tests.fusion import field_simulator as simulator

#: Simulated cause -> cause that the diagnosis must name.
CAUSES = {
    "structural": "structural",
    "local_temperature": "local_temperature",
    "step": "step",
    "stick_slip": "stick_slip",
    "one_direction": "stick_slip",
    "slow": "undetermined",
}
STICKING_SHARE = 0.15


def odd_position(cause: str, rng: np.random.Generator, *, rms_um: float = 0.3, noise_um: float = 0.4) -> xr.Dataset:
    """A fused Dataset whose target 3 carries an effect of the given rms (um); a step has twice that height."""
    cycles = simulator.CYCLES
    common = 0.4 * np.cumsum(rng.standard_normal(cycles))
    slope = 0.3 * np.cumsum(rng.standard_normal(cycles))
    fused = simulator.session(np.zeros((cycles, 1, 1)), common, slope, rng, noise_um=noise_um).fused
    rise = 3.0 * simulator.smooth_series(str(rng.choice(["duty", "rw"])), rng)
    measured = np.tile(rise[:, None], (1, 16)) + 0.02 * rng.standard_normal((cycles, 16))
    fused = fused.assign_coords(
        frame_time=simulator.START + (np.arange(cycles) * simulator.PERIOD_S * 1e9).astype("timedelta64[ns]")
    )
    fused["local_rise_series"] = (("frame_time", "target"), measured, {"units": "K"})
    deviation = fused["deviation"].values.copy()
    deviation[:, :, 2] += rms_um * _effect(cause, rise, rng)
    fused["deviation"] = (fused["deviation"].dims, deviation, {"units": "um"})
    return fused


def _effect(cause: str, rise: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Effect (cycle, direction) of unit size."""
    cycles = rise.size
    if cause == "structural":
        return rng.standard_normal((cycles, 2))
    if cause == "local_temperature":
        lag = float(rng.choice([0.0, 600.0, 1800.0]))
        response = rise if lag == 0 else simulator.first_order(rise - rise[0], lag)
        return np.repeat(((response - response.mean()) / response.std())[:, None], 2, axis=1)
    if cause == "step":
        return 2.0 * np.repeat((np.arange(cycles) >= rng.integers(15, 86))[:, None], 2, axis=1)
    if cause == "stick_slip":
        amounts = rng.exponential(1.0, (cycles, 2)) * (rng.random((cycles, 2)) < STICKING_SHARE)
        return amounts * np.array([-1.0, 1.0]) / np.sqrt(2 * STICKING_SHARE - STICKING_SHARE**2)
    if cause == "one_direction":
        effect = np.zeros((cycles, 2))
        effect[:, rng.integers(2)] = simulator.smooth_series(str(rng.choice(["rw", "ar"])), rng)
        return effect
    if cause == "slow":
        return np.repeat(simulator.smooth_series(str(rng.choice(["rw", "irw", "ar"])), rng)[:, None], 2, axis=1)
    raise ValueError(cause)
