"""Records for tests: tables as the reader returns them, from the twin or made by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.analysis.drift_model.record import RecordProblem, RecordState, declare, hold_out, search_record
from fusion.analysis.drift_model.record_data import Record, reduce_record
from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_record
from fusion.twin.recipe import EffectRecipe, Recipe
from fusion.twin.record import simulate_record

#: The public spindle test of a machining centre: 46.3 h, 16 temperatures, 5 displacements, speed (CAIVIAC, MIT).
SPINDLE = "CAIVIAC__FL_THERMAL/data/data.xlsx"
_SPINDLE_CAMPAIGN = """\
[campaign]
title = "Spindle"

[record]
file = "{file}"
time = "時間(s)"
temperatures = ["t*"]
displacements = ["ch*"]
drivers = ["spindle*"]
"""


def spindle_table(folder: Path, path: Path) -> xr.Dataset:
    """The spindle test as the reader returns it; its campaign file is written into a folder."""
    (folder / "campaign.toml").write_text(_SPINDLE_CAMPAIGN.format(file=path.as_posix()), encoding="utf-8")
    return read_record(load_campaign(folder / "campaign.toml"))


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


def runs_table(*levels: float, samples: int = 60) -> xr.Dataset:
    """Runs a day apart, each with a channel that starts at its own level and follows one sensor by 2 um/K."""
    rng = np.random.default_rng(3)
    tables = []
    for run, level in enumerate(levels):
        temperature = 20.0 + run + np.cumsum(rng.normal(0.0, 0.1, (samples, 1)), axis=0)
        displacement = level + 2.0 * (temperature - temperature[0])
        load = ((np.arange(samples) // 20 + run) % 2).astype(float)
        table = table_of(displacement, temperature, load)
        table = table.assign_coords(time=table["time"].values + np.timedelta64(run, "D"))
        tables.append(table.assign_coords(run=("time", np.full(samples, run))))
    joined = xr.concat(tables, "time", data_vars="minimal", coords="minimal", compat="override")
    names = [f"r{run + 1}.csv" for run in range(len(levels))]
    return joined.assign_attrs(runs=json.dumps(names), test=json.dumps([len(levels) - 1]), own_zero=0)


def twin_table(*effects: EffectRecipe, seed: int, hours: float = 24.0) -> xr.Dataset:
    """A record of the twin without files."""
    table = simulate_record(Recipe().vary(campaign={"seed": seed}, record={"hours": hours}, effect=effects)).table
    return table_of(table["displacement"].values, table["temperature"].values, table["speed"].values)


def linear_samples(
    rng: np.random.Generator, samples: int = 2000, sensors: int = 4, channels: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacements that follow wandering temperatures exactly, the temperatures, and a driver that switches every 200 samples."""
    temperature = np.cumsum(rng.normal(0.0, 0.05, (samples, sensors)), axis=0) + 20.0
    displacement = (temperature - 20.0) @ rng.normal(0.0, 2.0, (sensors, channels))
    return displacement, temperature, (np.arange(samples) // 200 % 2) * 3000.0


def searched(*effects: EffectRecipe, seed: int) -> tuple[RecordProblem, RecordState]:
    """The search on the training part of a record of the twin that is declared quasi-static."""
    record = reduce_record(twin_table(*effects, seed=seed))
    train, _ = hold_out(record)
    return search_record(record, train, declare(["quasi_static"], record))


def record_of(
    displacement: np.ndarray,
    temperature: np.ndarray,
    *,
    drivers: Mapping[str, np.ndarray] | None = None,
    block_s: float = 300.0,
    parts: int = 8,
    temperature_noise: float = 0.0,
) -> Record:
    """A record by hand: (blocks, channels) um, (blocks, sensors) degC, drivers as shares of their largest size."""
    blocks = displacement.shape[0]
    return Record(
        start=np.datetime64("2026-01-05T06:00", "ns"),
        seconds=block_s * (np.arange(blocks) + 0.5),
        block_s=block_s,
        displacement=displacement,
        temperature=temperature,
        temperature_noise=np.full(temperature.shape[1], temperature_noise),
        digits={},
        displacement_step=np.zeros(displacement.shape[1]),
        temperature_step=np.zeros(temperature.shape[1]),
        drivers={name: {1: values, 2: values**2} for name, values in (drivers or {}).items()},
        channels=tuple(f"ch{k + 1}" for k in range(displacement.shape[1])),
        sensors=tuple(f"t{k + 1}" for k in range(temperature.shape[1])),
        duplicates=(),
        chained=np.arange(blocks) * parts // blocks,
        gaps={},
        driver_sizes=dict.fromkeys(drivers or {}, (1.0, "1")),
    )
