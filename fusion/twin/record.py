"""Simulation of a record: temperature sensors and displacement channels of a whole machine over hours, as in ISO 230-3.

Parts of the machine are lumped heat capacities joined by conductances; the spindle is one of them and has no sensor. Every channel
moves with the temperatures of the other parts, and with the undeclared effects of the recipe. A ``cycle`` in an effect's parameters is
an hour here, and an effect's rms is taken over all channels together.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.linalg import expm

from fusion.common import CAMPAIGN_FILE, Array
from fusion.twin.effects import EFFECTS, IN_A_RECORD
from fusion.twin.folders import write_truth_nc
from fusion.twin.machine import Session, first_order, random_levels, stream
from fusion.twin.recipe import EffectRecipe, Recipe, RecipeError, Record
from fusion.twin.recipe_file import check_recipe

#: Heat capacity (J/K) and heat transfer to the air (W/K) of every part.
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
#: Powers at full load.
SPINDLE_W = 320.0
MOTOR_W = 90.0
CHANNELS = ("X", "Y", "Z", "A", "B", "C")


@dataclass(frozen=True)
class RecordTruth:
    """A simulated record: what was logged, every part of the displacements (time, channel), um, and the names of these parts.

    `table` holds `temperature` (time, sensor), degC; `displacement` (time, channel), um; `speed` (time,), 1/min.
    """

    recipe: Recipe
    table: xr.Dataset
    parts: tuple[str, ...]


def simulate_record(recipe: Recipe) -> RecordTruth:
    """Simulate the record that the recipe's ``[record]`` asks for."""
    record = check_recipe(recipe).record
    if record is None:
        raise RecipeError(
            "there is no [record] in this recipe; add the table, or use simulate for a positioning campaign"
        )
    if recipe.anomaly:
        raise RecipeError("anomaly: a record has no targets; remove the [[anomaly]] tables or the [record]")
    seed = recipe.campaign.seed
    time_s = np.arange(0.0, 3600.0 * record.hours, record.step_s, dtype=float)
    # The same machine under another duty.
    duty_seed = record.duty_seed or seed
    duty = random_levels(time_s, 0.0, 1.0, record.mean_hold_min, stream(duty_seed, "duty"))
    duty[duty < record.rest_share] = 0.0
    axes = random_levels(time_s, 0.0, 1.0, 0.7 * record.mean_hold_min, stream(duty_seed, "load of the axes"))
    rises = solve_parts(duty, axes, _room_rise(record, time_s, duty_seed), record.step_s)
    with_sensor = rises[:, 1:]

    size = (time_s.size, record.channels)
    sensitivities = (with_sensor.shape[1], record.channels)
    per_K = stream(seed, "sensitivities").normal(0.0, record.sensitivity_um_per_K, sensitivities)
    walks = stream(duty_seed, "walks").standard_normal(size) * np.sqrt(record.step_s / 3600.0)
    series: dict[str, Array] = {
        "quasi_static": with_sensor @ per_K,
        "nuisance": record.walk_um_per_sqrt_h * np.cumsum(walks, axis=0),
        "noise": record.noise_um * stream(duty_seed, "noise").standard_normal(size),
    }
    session = _session(recipe, record, time_s, duty, with_sensor.mean(axis=1))
    for effect in recipe.effect:
        series[effect.name] = series.get(effect.name, np.zeros(size)) + _effect(effect, session, record, seed)
    dims, logged = ("time", "channel"), np.round(_logged_temperatures(record, with_sensor, seed), 3)
    if record.dead_sensor:
        logged[time_s >= 0.25 * time_s[-1], record.dead_sensor - 1] = 0.0
    if record.applied:
        speed = np.round(duty * record.top_speed_rpm)
        series["compensation"] = record.applied_gain * _correction(record, logged, speed)
    start = np.datetime64(recipe.campaign.start.removesuffix("Z"), "ns")
    table = xr.Dataset(
        {
            "temperature": (("time", "sensor"), logged, {"units": "degC"}),
            "displacement": (dims, np.round(np.sum(list(series.values()), axis=0), 3), {"units": "um"}),
            "speed": ("time", np.round(duty * record.top_speed_rpm), {"units": "1/min"}),
            **{name: (dims, part, {"units": "um"}) for name, part in series.items()},
        },
        coords={
            "time": start + np.round(time_s * 1e9).astype("m8[ns]"),
            "sensor": [f"T{number}" for number in range(1, record.sensors + 1)],
            "channel": list(CHANNELS[: record.channels]),
        },
    )
    return RecordTruth(recipe, table, tuple(series))


def _correction(record: Record, logged: Array, speed: Array) -> Array:
    """Return what a control with the model of ``applied`` adds (time, channel), um, zero at the start; nothing after a failed reading."""
    model = json.loads(Path(record.applied).read_text(encoding="utf-8"))
    readings = {f"T{number}": column for number, column in enumerate(logged.T, start=1)} | {"spindle speed": speed}
    states: list[Array] = []
    failed = np.zeros(speed.size, bool)
    for one in model["inputs"]:
        values = readings[one["name"]]
        failed |= (values < one["failed_below"]) | (values > one["failed_above"])
    for one in model["states"]:
        origin = model["inputs"][one["input"]]
        held = np.clip(readings[origin["name"]], origin["low"], origin["high"])
        signal = ((held - origin["reference"]) / one["size"]) ** one["exponent"]
        tau_s = one["time_constant_s"]
        origin = one["start"] * signal[0]
        states.append(signal if tau_s == 0.0 else first_order(signal - origin, record.step_s, tau_s) + origin)
    correction = np.zeros((speed.size, record.channels))
    for one in model["outputs"]:
        wanted = -np.asarray(one["coefficients"]) @ np.array(states)
        held = np.clip(wanted - wanted[0], -one["limit"], one["limit"])
        correction[:, CHANNELS.index(one["name"])] = np.where(np.maximum.accumulate(failed), 0.0, held)
    return correction


def _room_rise(record: Record, time_s: Array, seed: int) -> Array:
    """Return the daily swing of the room temperature, K since the start."""
    phase = stream(seed, "air").uniform(0.0, 2 * np.pi)
    swing = record.room_swing_K * np.sin(2 * np.pi * (time_s / 3600.0) / 24.0 + phase)
    return swing - swing[0]


def _logged_temperatures(record: Record, rises: Array, seed: int) -> Array:
    """Return what the sensors log (time, sensor), degC: their parts' rises (time, part), each with a gain, a lag and noise."""
    rng = stream(seed, "sensors")
    sensed = rises[:, np.arange(record.sensors) % rises.shape[1]] * rng.uniform(0.85, 1.1, record.sensors)
    for column, minutes in enumerate(rng.uniform(*record.sensor_lag_min, record.sensors)):
        sensed[:, column] = first_order(sensed[:, column], record.step_s, 60.0 * minutes)
    return 20.0 + sensed + record.noise_K * rng.standard_normal(sensed.shape)


def write_record(truth: RecordTruth, out: Path, truth_folder: Path) -> Path:
    """Write a simulated record as CSV with its campaign file, and its truth apart."""
    table = truth.table
    seconds = (table["time"].values - table["time"].values[0]) / np.timedelta64(1, "s")
    headings = ["time [s]", *(f"{name} [degC]" for name in table["sensor"].values)]
    headings += [*(f"{name} [um]" for name in table["channel"].values), "spindle speed [1/min]"]
    columns = [seconds, *table["temperature"].values.T, *table["displacement"].values.T, table["speed"].values]
    how: dict[str, Any] = {"fmt": "%.10g", "delimiter": ",", "header": ",".join(headings), "comments": ""}
    np.savetxt(out / "record.csv", np.transpose(columns), **how)
    wanted = ", ".join(json.dumps(f"{name} [um]") for name in table["channel"].values)
    (out / CAMPAIGN_FILE).write_text(
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
    write_truth_nc(truth_folder, table)
    rms = {name: float(_centred_rms(table[name].values)) for name in truth.parts}
    content = {"recipe": asdict(truth.recipe), "parts_rms_um": rms, "undeclared": [e.name for e in truth.recipe.effect]}
    (truth_folder / "truth.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return out / CAMPAIGN_FILE


def solve_parts(duty: Array, axes: Array, air: Array, step_s: float) -> Array:
    """Return the temperature rise of every part of the machine."""
    names = list(PARTS)
    capacity = np.array([PARTS[name][0] for name in names])
    exchange = np.array([PARTS[name][1] for name in names])
    flow = -np.diag(exchange)
    for first, second, conductance in JOINTS:
        i, k = names.index(first), names.index(second)
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


def _session(recipe: Recipe, record: Record, time_s: Array, duty: Array, mean_rise: Array) -> Session:
    """Return the record as a session of one target, read at every step, whose cycles are hours."""
    ones, zeros = np.ones(time_s.size), np.zeros(time_s.size)
    return Session(
        time_s=time_s,
        cycle=(time_s // 3600.0).astype(int) + 1,
        sign=ones.astype(int),
        target=ones.astype(int),
        position_mm=ones,
        cycles=int(np.ceil(record.hours)),
        period_s=3600.0,
        seed=recipe.campaign.seed,
        travel_mm=1.0,
        grid_s=time_s,
        duty=duty,
        table_rise_K=mean_rise,
        **dict.fromkeys(("probe_degC", "air_degC", "air_hPa", "air_percent", "refractivity"), zeros),
        frame_s=zeros[:0],
    )


def _effect(effect: EffectRecipe, session: Session, record: Record, seed: int) -> Array:
    """Return an undeclared effect (time, channel), um: one series with a random weight in every channel."""
    if effect.name not in IN_A_RECORD:
        raise RecipeError(f"effect {effect.name}: a record has no positions; use one of {', '.join(IN_A_RECORD)}")
    weight = stream(seed, f"share of {effect.name}").normal(0.0, 1.0, record.channels)
    weight /= np.sqrt(np.mean(weight**2))
    series = np.multiply.outer(EFFECTS[effect.name].series(session, **effect.parameters), weight)
    if effect.amplitude_um is None:
        return np.asarray(series)
    rms = _centred_rms(series)
    if rms == 0.0:
        raise RecipeError(
            f"effect {effect.name}: nothing moves in this record, so it cannot be scaled; change its parameters"
        )
    return np.asarray(series * effect.amplitude_um / rms)


def _centred_rms(series: Array) -> float:
    """Return the rms over all channels about each channel's mean."""
    return float(np.sqrt(np.mean((series - series.mean(axis=0)) ** 2)))
