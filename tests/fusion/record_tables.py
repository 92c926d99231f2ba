"""Records for tests: tables as the reader returns them, from the twin or made by hand."""

from __future__ import annotations

import numpy as np
import xarray as xr

from fusion.twin.machine.recipe import EffectRecipe, Recipe
from fusion.twin.record import simulate_record


def table_of(
    displacement: np.ndarray, temperature: np.ndarray, driver: np.ndarray | None = None, *, step_s: float = 60.0
) -> xr.Dataset:
    """A record table from samples (time, channel), (time, sensor) and (time,)."""
    samples = displacement.shape[0]
    drivers = np.empty((samples, 0)) if driver is None else driver[:, None]
    return xr.Dataset(
        {
            "temperature": (("time", "sensor"), temperature),
            "displacement": (("time", "channel"), displacement),
            "driver": (("time", "driver_name"), drivers),
            "driver_units": (("driver_name",), np.full(drivers.shape[1], "1/min", dtype=object)),
        },
        coords={
            "time": np.datetime64("2026-01-05T06:00", "ns")
            + np.round(np.arange(samples) * step_s * 1e9).astype("m8[ns]"),
            "sensor": [f"t{k + 1}" for k in range(temperature.shape[1])],
            "channel": [f"ch{k + 1}" for k in range(displacement.shape[1])],
            "driver_name": ["speed"] * drivers.shape[1],
        },
        attrs={"source": "record.csv"},
    )


def twin_table(*effects: EffectRecipe, seed: int, hours: float = 24.0) -> xr.Dataset:
    """A record of the twin without files."""
    table = simulate_record(Recipe().vary(campaign={"seed": seed}, record={"hours": hours}, effect=effects)).table
    return table_of(table["displacement"].values, table["temperature"].values, table["speed"].values)
