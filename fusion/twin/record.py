"""The twin as a record: temperature sensors and displacement channels of a whole machine over hours, as in ISO 230-3.

Parts of the machine are lumps of heat joined by conductances; the spindle is one of them and carries no sensor. Every channel
moves with the parts that do, and with what the recipe switches on without declaring it. A ``cycle`` in an effect's parameters is
an hour here, and an effect's rms counts all channels together.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.linalg import expm

from fusion.twin.machine.effects import EFFECTS
from fusion.twin.machine.recipe import EffectRecipe, Recipe, RecipeError, Record
from fusion.twin.machine.session import Session
from fusion.twin.machine.streams import first_order, random_levels, stream
from fusion.twin.recipe_file import check_recipe

Floats = NDArray[np.floating[Any]]
#: Heat capacity (J/K) and exchange with the air (W/K) of every part; the spindle is heated and carries no sensor.
PARTS = {
    "spindle": (40e3, 3.0),
    "motor": (25e3, 9.0),
    "head": (60e3, 8.0),
    "column top": (150e3, 10.0),
    "column foot": (200e3, 10.0),
    "bed": (400e3, 20.0),
    "table": (120e3, 12.0),
    "screw": (15e3, 2.0),
}
#: Conductances between parts, W/K.
JOINTS = (
    ("spindle", "head", 30.0),
    ("motor", "screw", 8.0),
    ("head", "column top", 25.0),
    ("column top", "column foot", 30.0),
    ("column foot", "bed", 40.0),
    ("bed", "table", 15.0),
    ("table", "screw", 10.0),
)
SPINDLE_W = 320.0
MOTOR_W = 90.0
#: Effects of the library that mean something without positions.
IN_A_RECORD = ("thermal_lag", "unseen_heat_source", "step_event", "periodic_disturbance")
CHANNELS = ("X", "Y", "Z", "A", "B", "C")


@dataclass(frozen=True)
class RecordTruth:
    """A simulated record: `table` (time; sensor; channel) as logged and every part of the displacements, um; `parts` their names."""

    recipe: Recipe
    table: xr.Dataset
    parts: tuple[str, ...]


def simulate_record(recipe: Recipe) -> RecordTruth:
    """Simulate the record that the recipe's ``[record]`` asks for.

    Raises
    ------
    RecipeError
        There is no ``[record]``, or an effect or anomaly needs positions.
    """
    record = check_recipe(recipe).record
    if record is None:
        raise RecipeError(
            "there is no [record] in this recipe; add the table, or use simulate for a positioning campaign"
        )
    if recipe.anomaly:
        raise RecipeError("anomaly: a record has no targets; remove the [[anomaly]] tables or the [record]")
    seed = recipe.campaign.seed
    time_s = np.arange(0.0, 3600.0 * record.hours, record.step_s)
    duty = random_levels(time_s, 0.0, 1.0, record.mean_hold_min, stream(seed, "duty"))
    duty[duty < record.rest_share] = 0.0
    hours = time_s / 3600.0
    air = record.room_swing_K * np.sin(2 * np.pi * hours / 24.0 + stream(seed, "air").uniform(0.0, 2 * np.pi))
    air -= air[0]
    axes = random_levels(time_s, 0.0, 1.0, 0.7 * record.mean_hold_min, stream(seed, "load of the axes"))
    rises = solve_parts(duty, axes, air, record.step_s)
    seen = rises[:, 1:]
    names, channels = _sensors(record), CHANNELS[: record.channels]
    rng = stream(seed, "sensors")
    own = seen[:, np.arange(record.sensors) % seen.shape[1]] * rng.uniform(0.85, 1.1, record.sensors)
    for column, minutes in enumerate(rng.uniform(*record.sensor_lag_min, record.sensors)):
        own[:, column] = first_order(own[:, column], record.step_s, 60.0 * minutes)
    logged = 20.0 + own + record.noise_K * rng.standard_normal(own.shape)

    per_K = stream(seed, "sensitivities").normal(0.0, record.sensitivity_um_per_K, (seen.shape[1], record.channels))
    walks = stream(seed, "walks").standard_normal((time_s.size, record.channels)) * np.sqrt(record.step_s / 3600.0)
    series: dict[str, Floats] = {
        "quasi_static": seen @ per_K,
        "nuisance": record.walk_um_per_sqrt_h * np.cumsum(walks, axis=0),
        "noise": record.noise_um * stream(seed, "noise").standard_normal((time_s.size, record.channels)),
    }
    session = _session(recipe, record, time_s, duty, seen.mean(axis=1))
    for effect in recipe.effect:
        still = np.zeros((time_s.size, record.channels))
        series[effect.name] = series.get(effect.name, still) + _effect(effect, session, record, seed)
    dims = ("time", "channel")
    start = np.datetime64(recipe.campaign.start.removesuffix("Z"), "ns")
    table = xr.Dataset(
        {
            "temperature": (("time", "sensor"), np.round(logged, 3), {"units": "degC"}),
            "displacement": (dims, np.round(np.sum(list(series.values()), axis=0), 3), {"units": "um"}),
            "speed": ("time", np.round(duty * record.top_speed_rpm), {"units": "1/min"}),
            **{name: (dims, value, {"units": "um"}) for name, value in series.items()},
        },
        coords={
            "time": start + np.round(time_s * 1e9).astype("m8[ns]"),
            "sensor": list(names),
            "channel": list(channels),
        },
    )
    return RecordTruth(recipe, table, tuple(series))


def write_record(truth: RecordTruth, out: Path, beside: Path) -> Path:
    """Write the record as CSV with its campaign file to `out`, its truth to `beside`; both folders exist.

    Returns
    -------
    Path
        The campaign file.
    """
    table = truth.table
    seconds = (table["time"].values - table["time"].values[0]) / np.timedelta64(1, "s")
    headings = ["time [s]", *(f"{name} [degC]" for name in table["sensor"].values)]
    headings += [*(f"{name} [um]" for name in table["channel"].values), "spindle speed [1/min]"]
    columns = [
        seconds[:, None],
        table["temperature"].values,
        table["displacement"].values,
        table["speed"].values[:, None],
    ]
    np.savetxt(
        out / "record.csv", np.hstack(columns), fmt="%.10g", delimiter=",", header=",".join(headings), comments=""
    )
    wanted = ", ".join(json.dumps(f"{name} [um]") for name in table["channel"].values)
    (out / "campaign.toml").write_text(
        f"""[campaign]
title = {json.dumps(truth.recipe.campaign.title)}

[record]
file = "record.csv"
time = "time [s]"
start = "{truth.recipe.campaign.start.removesuffix("Z")}+00:00"
temperatures = ["T*"]
displacements = [{wanted}]
drivers = ["spindle speed*"]
""",
        encoding="utf-8",
    )
    table.to_netcdf(beside / "truth.nc", engine="h5netcdf")
    rms = {name: float(_centred_rms(table[name].values)) for name in truth.parts}
    content = {"recipe": asdict(truth.recipe), "parts_rms_um": rms, "undeclared": [e.name for e in truth.recipe.effect]}
    (beside / "truth.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return out / "campaign.toml"


def _sensors(record: Record) -> tuple[str, ...]:
    return tuple(f"T{number}" for number in range(1, record.sensors + 1))


def solve_parts(duty: Floats, axes: Floats, air: Floats, step_s: float) -> Floats:
    """Return the rise (time, part) of every part of `PARTS`, K.

    Loads of spindle and axes are 0..1, air is the room's rise in K, `step_s` their step; exact where they are constant over a step.
    """
    names = list(PARTS)
    capacity = np.array([PARTS[name][0] for name in names])
    exchange = np.array([PARTS[name][1] for name in names])
    flow = -np.diag(exchange)
    for one, other, conductance in JOINTS:
        i, k = names.index(one), names.index(other)
        flow[[i, k], [i, k]] -= conductance
        flow[[i, k], [k, i]] += conductance
    rate = flow / capacity[:, None]
    step = expm(rate * step_s)
    gain = np.linalg.solve(rate, step - np.eye(len(names))) / capacity
    heat = np.zeros((duty.size, len(names)))
    heat[:, names.index("spindle")] = SPINDLE_W * duty**1.5
    heat[:, names.index("motor")] = MOTOR_W * axes
    heat += exchange * air[:, None]
    rises = np.zeros_like(heat)
    for k in range(duty.size - 1):
        rises[k + 1] = step @ rises[k] + gain @ heat[k]
    return rises


def _session(recipe: Recipe, record: Record, time_s: Floats, duty: Floats, mean_rise: Floats) -> Session:
    """Return the record as a session of one target, read at every step, whose cycles are hours."""
    one, none = np.ones(time_s.size), np.zeros(time_s.size)
    return Session(
        seed=recipe.campaign.seed,
        time_s=time_s,
        cycle=(time_s // 3600.0).astype(int) + 1,
        sign=one.astype(int),
        target=one.astype(int),
        position_mm=one,
        travel_mm=1.0,
        cycles=int(np.ceil(record.hours)),
        period_s=3600.0,
        grid_s=time_s,
        duty=duty,
        table_rise_K=mean_rise,
        probe_degC=none,
        air_degC=none,
        air_hPa=none,
        air_percent=none,
        refractivity=none,
        frame_s=none[:0],
    )


def _effect(effect: EffectRecipe, session: Session, record: Record, seed: int) -> Floats:
    """Return an undeclared effect (time, channel): one series, another size in every channel."""
    if effect.name not in IN_A_RECORD:
        raise RecipeError(f"effect {effect.name}: a record has no positions; use one of {', '.join(IN_A_RECORD)}")
    share = stream(seed, f"share of {effect.name}").normal(0.0, 1.0, record.channels)
    value = np.multiply.outer(
        EFFECTS[effect.name].series(session, **effect.parameters), share / np.sqrt(np.mean(share**2))
    )
    if effect.amplitude_um is None:
        return np.asarray(value)
    found = _centred_rms(value)
    if found == 0.0:
        raise RecipeError(
            f"effect {effect.name}: nothing moves in this record, so it cannot be scaled; change its parameters"
        )
    return np.asarray(value * effect.amplitude_um / found)


def _centred_rms(value: Floats) -> float:
    """Return the rms over all channels about each channel's mean."""
    return float(np.sqrt(np.mean((value - value.mean(axis=0)) ** 2)))
