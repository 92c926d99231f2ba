"""The twin at work: from a recipe to every reading of the test and everything that made it what it is.

Nothing is rendered here; a campaign of 100 cycles takes well under a second, so that studies can run hundreds.

What moves the twin's readings besides temperature: static profile, wandering nuisance, the laser's noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.twin.machine.air import Air, simulate_air
from fusion.twin.machine.effects import ANOMALIES, EFFECTS, told_air
from fusion.twin.machine.heat import Plate, solve_plate
from fusion.twin.machine.recipe import AnomalyRecipe, Drift, EffectRecipe, Laser, Profile, Recipe, RecipeError, Source
from fusion.twin.machine.schedule import Schedule, duty_levels, make_schedule
from fusion.twin.machine.session import Session
from fusion.twin.machine.streams import first_order, random_levels, stream
from fusion.twin.recipe_file import check_recipe

Floats = NDArray[np.floating[Any]]
GRID_STEP_S = 10.0
CAMERA_WARM_UP_K = 6.0
CAMERA_WARM_UP_S = 1500.0
PROBE_AT_MM = (640.0, 30.0)


@dataclass(frozen=True)
class Truth:
    """What the instruments recorded and why.

    `recipe` is the one that was asked for, with the size of a sensor's fault found.
    `readings` (cycle, direction, target): `deviation` as measured (NaN where lost), `time`, and one variable per part of it, um;
    their names are `parts`. `frames` (time): what the camera adds of its own. `plate` gives the true field anywhere, any time.
    """

    recipe: Recipe
    schedule: Schedule
    session: Session
    plate: Plate
    readings: xr.Dataset
    frames: xr.Dataset
    parts: tuple[str, ...]

    def clock(self, time_s: Floats) -> NDArray[np.datetime64]:
        """Return seconds since the start of the test as UTC times of the laser's clock, ms."""
        start = np.datetime64(self.recipe.campaign.start.removesuffix("Z"), "ms")
        return np.asarray(start + np.round(np.asarray(time_s) * 1e3).astype("timedelta64[ms]"))

    def in_order(self, name: str) -> Floats:
        """Return a variable of `readings` in the order the readings were taken."""
        ordered = self.readings[name].values.copy()
        ordered[:, 1] = ordered[:, 1, ::-1]
        return np.asarray(ordered.ravel())

    def temperature(self, time_s: Floats, x_mm: Floats, y_mm: Floats, *, cell_mm: float = 0.0) -> Floats:
        """Return the true table temperature (time, y, x), degC, at points or averaged over square cells around them."""
        return np.asarray(
            self.plate.field(time_s, x_mm, y_mm, cell_mm=cell_mm) + self.recipe.table.initial_temperature_degC
        )


def simulate(recipe: Recipe) -> Truth:
    """Simulate a campaign without rendering a frame.

    Parameters
    ----------
    recipe : Recipe

    Returns
    -------
    Truth

    Raises
    ------
    RecipeError
        The recipe asks for something that no test can be, such as an effect that moves no reading.
    """
    seed = check_recipe(recipe).campaign.seed
    if recipe.record is not None:
        raise RecipeError("this recipe asks for a [record]; use simulate_record, or remove the table")
    schedule = make_schedule(recipe.test, seed)
    grid_s = np.arange(-60.0 * recipe.table.preheat_min, schedule.duration_s + 10 * GRID_STEP_S, GRID_STEP_S)
    duty = duty_levels(recipe.duty, grid_s, seed)
    air = simulate_air(recipe.room, grid_s, seed)
    plate, local_rise = _heat(recipe, schedule, grid_s, duty, air)
    session = _session(recipe, schedule, grid_s, duty, air, plate)
    recipe = replace(recipe, effect=tuple(_size_fault(effect, session) for effect in recipe.effect))

    line = plate.line_integrals(schedule.positions_mm)
    line -= [np.interp(0.0, grid_s, column) for column in line.T]
    at_target = np.stack([session.at_readings(column) for column in line.T])
    series = {
        "static_profile": static_profile(recipe.profile, session, seed),
        "axis_expansion": recipe.drift.expansion_ppm_per_K
        * 1e-3
        * at_target[schedule.target - 1, np.arange(schedule.time_s.size)],
        "table_offset": recipe.drift.offset_um_per_K * session.at_readings(session.table_rise_K),
        "nuisance": nuisance(recipe.drift, session, seed),
        "noise": laser_noise(recipe.laser, session, seed),
    }
    housing = session.at_frames(session.air_degC) + CAMERA_WARM_UP_K * (
        1.0 - np.exp(-session.frame_s / CAMERA_WARM_UP_S)
    )
    own_drift = recipe.camera.drift_K_per_K * (housing - np.interp(0.0, grid_s, session.air_degC))
    camera = {"camera_offset_K": _ffc_steps(recipe, session) + own_drift, "reflected_K": np.zeros(session.frame_s.size)}
    for effect in recipe.effect:
        seen = EFFECTS[effect.name].unit == "K"
        value = _scale_camera(effect, recipe, session) if seen else _scale(effect, recipe, session)
        if seen:
            camera["reflected_K" if effect.name == "reflected_source" else "camera_offset_K"] += value
            value = np.zeros(schedule.time_s.size)
        series[_free_name(effect.name, series)] = value
    for number, anomaly in enumerate(recipe.anomaly):
        name = _free_name(f"anomaly_{anomaly.target}_{anomaly.kind}", series)
        series[name] = _anomaly(anomaly, session, local_rise[number], seed)
    readings = _dataset(recipe, schedule, series)
    frames = xr.Dataset(
        {name: ("frame", value, {"units": "K"}) for name, value in camera.items()}
        | {
            "time_s": ("frame", session.frame_s, {"units": "s", "long_name": "true time since the start of the test"}),
            "housing": ("frame", housing, {"units": "degC", "long_name": "temperature of the camera's housing"}),
            "table_position": ("frame", schedule.table_position(session.frame_s), {"units": "mm"}),
            "knocked": ("frame", _knocked(recipe, session).astype(np.int8)),
        }
    )
    return Truth(recipe, schedule, session, plate, readings, frames, tuple(series))


def environment_log(truth: Truth) -> xr.Dataset:
    """Return what the laser's environment unit logs once a minute, sensor noise, faults and resolution included."""
    session, recipe = truth.session, truth.recipe
    minute = np.arange(0.0, truth.schedule.duration_s, 60.0)
    told = (session.air_degC, session.air_hPa)
    for effect in recipe.effect:
        if effect.name == "sensor_fault":
            told = told_air(session, **(EFFECTS[effect.name].parameters | effect.parameters))
    rng = stream(recipe.campaign.seed, "environment unit")
    columns = {
        "air_temperature": (told[0], 0.004, 2, "degC"),
        "air_pressure": (told[1], 0.02, 2, "hPa"),
        "relative_humidity": (session.air_percent, 0.05, 1, "percent"),
        "material_temperature": (session.probe_degC, 0.004, 2, "degC"),
    }
    noisy = {
        name: (
            "time",
            np.round(np.interp(minute, session.grid_s, value) + noise * rng.standard_normal(minute.size), digits),
            {"units": unit},
        )
        for name, (value, noise, digits, unit) in columns.items()
    }
    return xr.Dataset(noisy, coords={"time": truth.clock(minute).astype("datetime64[ns]")})


def driver_log(truth: Truth) -> xr.Dataset:
    """Return the load of the machine as logged once a minute."""
    minute = np.arange(0.0, truth.schedule.duration_s, 60.0)
    level = truth.session.duty[np.searchsorted(truth.session.grid_s, minute)]
    return xr.Dataset(
        {"duty": ("time", level.round(3), {"units": "1"})},
        coords={"time": truth.clock(minute).astype("datetime64[ns]")},
    )


def _heat(
    recipe: Recipe, schedule: Schedule, grid_s: Floats, duty: Floats, air: Air
) -> tuple[Plate, dict[int, Floats]]:
    """Solve the plate with all sources; also the rise that each locally warm target owes to its own source."""
    seed = recipe.campaign.seed
    own = {n: _local_source(recipe, schedule, a) for n, a in enumerate(recipe.anomaly) if a.kind == "local_temperature"}
    sources = (*recipe.source, *own.values())
    power = np.zeros((grid_s.size, len(sources)))
    for column, source in enumerate(sources):
        if source.follows == "duty":
            drive = duty
        elif source.follows == "constant":
            drive = np.ones(grid_s.size)
        else:
            drive = random_levels(grid_s, 0.0, 1.0, 35.0, stream(seed, f"own drive of {source.name}"), two=True)
        power[:, column] = source.power_W * first_order(drive, GRID_STEP_S, 60.0 * source.time_constant_min)
    start = recipe.table.initial_temperature_degC
    plate = solve_plate(recipe.plan, recipe.table, sources, power, air.temperature_degC - start, grid_s)
    local_rise: dict[int, Floats] = {n: np.zeros(grid_s.size) for n in range(len(recipe.anomaly))}
    for column, (number, source) in enumerate(own.items(), len(recipe.source)):
        alone = solve_plate(recipe.plan, recipe.table, (source,), power[:, [column]], np.zeros(grid_s.size), grid_s)
        local_rise[number] = alone.points(np.array([source.x_mm]), np.array([source.y_mm]))[:, 0]
    return plate, local_rise


def _local_source(recipe: Recipe, schedule: Schedule, anomaly: AnomalyRecipe) -> Source:
    """Return the small source under a locally warm target."""
    at = np.array(recipe.plan.origin_mm) + np.array(recipe.plan.direction) * schedule.positions_mm[anomaly.target - 1]
    return Source(f"target {anomaly.target}", float(at[0]), float(at[1]), 14.0, 14.0, 6.0, 4.0, "own")


def _session(recipe: Recipe, schedule: Schedule, grid_s: Floats, duty: Floats, air: Air, plate: Plate) -> Session:
    """Collect what effects may look at."""
    camera = recipe.camera
    if camera.table == "still":
        burst = (
            schedule.last_reading_s
            + camera.frame_after_s
            + np.arange(camera.frames_per_cycle) * camera.burst_interval_s
        )
        if burst[-1] >= schedule.period_s:
            raise RecipeError(
                f"camera: the last frame of a cycle is due {burst[-1]:.1f} s after its start, past its end at {schedule.period_s:.1f} s; "
                "lower frame_after_s or frames_per_cycle, or raise test.period_s"
            )
        frame_s = (np.arange(schedule.cycles)[:, None] * schedule.period_s + burst).ravel()
    else:
        frame_s = np.arange(0.5 * camera.frame_interval_s, schedule.duration_s, camera.frame_interval_s)
    probe = plate.points(np.array([PROBE_AT_MM[0]]), np.array([PROBE_AT_MM[1]]))[:, 0]
    return Session(
        seed=recipe.campaign.seed,
        time_s=schedule.time_s,
        cycle=schedule.cycle,
        sign=schedule.sign,
        target=schedule.target,
        position_mm=schedule.position_mm,
        travel_mm=float(schedule.positions_mm[-1]),
        cycles=schedule.cycles,
        period_s=schedule.period_s,
        grid_s=grid_s,
        duty=duty,
        table_rise_K=plate.mean() - np.interp(0.0, grid_s, plate.mean()),
        probe_degC=recipe.table.initial_temperature_degC
        + first_order(probe, GRID_STEP_S, 60.0 * recipe.room.probe_lag_min),
        air_degC=air.temperature_degC,
        air_hPa=air.pressure_hPa,
        air_percent=air.humidity_percent,
        refractivity=air.index,
        frame_s=frame_s,
    )


def _scale(effect: EffectRecipe, recipe: Recipe, session: Session) -> Floats:
    """Return an effect's series in um, scaled to the rms that the recipe asks for (a sensor's fault is scaled before)."""
    value = EFFECTS[effect.name].series(session, **effect.parameters)
    if effect.amplitude_um is None or effect.name == "sensor_fault":
        return value
    return np.asarray(value * _gain(effect.amplitude_um, spread(value, session), f"effect {effect.name}"))


def _size_fault(effect: EffectRecipe, session: Session) -> EffectRecipe:
    """Return a sensor's fault with the jump that gives the wanted rms: what is logged and what the laser errs by stay one."""
    if effect.name != "sensor_fault" or effect.amplitude_um is None:
        return effect
    parameters = EFFECTS[effect.name].parameters | effect.parameters
    if parameters["kind"] == "stuck":
        raise RecipeError(
            "effect sensor_fault: a stuck sensor errs by what it misses; remove amplitude_um, or use kind = 'jump'"
        )
    for _ in range(8):
        found = spread(EFFECTS[effect.name].series(session, **parameters), session)
        parameters["size"] *= _gain(effect.amplitude_um, found, "effect sensor_fault")
    return replace(effect, parameters=parameters)


def _scale_camera(effect: EffectRecipe, recipe: Recipe, session: Session) -> Floats:
    """Return what an effect adds to the camera's view in K; an rms in um counts what it does to the declared model's prediction."""
    parameters = effect.parameters | ({} if effect.amplitude_K is None else {"K": effect.amplitude_K})
    value = EFFECTS[effect.name].series(session, **parameters)
    if effect.amplitude_um is None:
        return value
    if effect.name == "reflected_source":
        raise RecipeError("effect reflected_source: amplitude_um has no meaning for a spot; write amplitude_K")
    error = np.interp(session.time_s, session.frame_s, value)
    predicted = error * (recipe.drift.expansion_ppm_per_K * 1e-3 * session.position_mm + recipe.drift.offset_um_per_K)
    return np.asarray(value * _gain(effect.amplitude_um, spread(predicted, session), "effect camera_offset"))


def _anomaly(anomaly: AnomalyRecipe, session: Session, local_rise: Floats, seed: int) -> Floats:
    """Return an anomalous target's own series, um."""
    rng = stream(seed, f"anomaly {anomaly.target} {anomaly.kind}")
    there = (session.target == anomaly.target) & np.isin(
        session.sign, {"both": (1, -1), "positive": (1,), "negative": (-1,)}[anomaly.direction]
    )
    value = np.where(there, ANOMALIES[anomaly.kind](session, local_rise, rng, anomaly.at_cycle), 0.0)
    return np.asarray(
        value * _gain(anomaly.amplitude_um, spread(value, session), f"anomaly at target {anomaly.target}")
    )


def spread(series: Floats, session: Session) -> float:
    """Return the rms (um) about the mean per target and direction, over the targets and directions that move at all."""
    moving = grid(series, session.cycles)
    moving = moving - moving.mean(axis=0)
    affected = np.abs(moving).max(axis=0) > 1e-12
    return float(np.sqrt(np.mean(moving[:, affected] ** 2))) if affected.any() else 0.0


def grid(series: Floats, cycles: int) -> Floats:
    """Return readings in the order taken as (cycle, direction, target), direction positive then negative."""
    out = np.array(series).reshape(cycles, 2, -1)
    out[:, 1] = out[:, 1, ::-1]
    return out


def _gain(wanted_um: float, found_um: float, what: str) -> float:
    if found_um == 0.0:
        raise RecipeError(
            f"{what}: nothing moves in this test, so it cannot be scaled to {wanted_um} um rms; change its parameters"
        )
    return wanted_um / found_um


def _free_name(name: str, taken: dict[str, Floats]) -> str:
    """Return the name, numbered where the recipe uses it again."""
    count = 1 + sum(t == name or t.startswith(f"{name}_again") for t in taken)
    return name if count == 1 else f"{name}_again{count}"


def _ffc_steps(recipe: Recipe, session: Session) -> Floats:
    """Return the camera's zero per frame: a new random offset after every flat-field correction, K."""
    number = (session.frame_s // (60.0 * recipe.camera.ffc_interval_min)).astype(int)
    offsets = stream(recipe.campaign.seed, "ffc").standard_normal(number.max() + 1)
    return np.asarray(recipe.camera.ffc_step_K * offsets[number])


def _knocked(recipe: Recipe, session: Session) -> NDArray[np.bool_]:
    """Return which frames come after somebody knocked the camera."""
    cycle = recipe.camera.knock_cycle
    return np.asarray((session.frame_s >= session.start_of(cycle)) & (cycle > 0))


def _dataset(recipe: Recipe, schedule: Schedule, series: dict[str, Floats]) -> xr.Dataset:
    """Return the readings as (cycle, direction, target), measured deviation and every part of it."""
    dims = ("cycle", "direction", "target")
    parts = {name: (dims, grid(value, schedule.cycles), {"units": "um"}) for name, value in series.items()}
    deviation = np.sum([value for _, value, _ in parts.values()], axis=0)
    random = np.sum(
        [value for name, (_, value, _) in parts.items() if name == "noise" or name.endswith("structural")], axis=0
    )
    known = {
        "mean_profile": (
            dims[1:],
            (deviation - random).mean(axis=0),
            {"units": "um", "long_name": "profile at the test's mean state"},
        ),
        "scatter": (
            dims[1:],
            random.std(axis=0, ddof=min(1, schedule.cycles - 1)),
            {"units": "um", "long_name": "sample standard deviation of what is random"},
        ),
    }
    lost = (
        stream(recipe.campaign.seed, "lost readings").uniform(size=np.shape(deviation)) < recipe.test.missing_fraction
    )
    start = np.datetime64(recipe.campaign.start.removesuffix("Z"), "ns")
    time = start + np.round(grid(schedule.time_s, schedule.cycles) * 1e3).astype("timedelta64[ms]")
    return xr.Dataset(
        {
            "deviation": (dims, np.where(lost, np.nan, deviation), {"units": "um"}),
            "time": (dims, time),
            **parts,
            **known,
        },
        coords={
            "cycle": np.arange(1, schedule.cycles + 1),
            "direction": ["positive", "negative"],
            "target": np.arange(1, schedule.positions_mm.size + 1),
            "position": ("target", schedule.positions_mm, {"units": "mm"}),
        },
    )


OU_HOURS = 1.0


def static_profile(profile: Profile, session: Session, seed: int) -> Floats:
    """Return the static positioning error of every reading, um: scale, bow, roughness, cyclic error, reversal."""
    rng = stream(seed, "profile")
    targets = int(session.target.max())
    rough = profile.rough_um * rng.standard_normal(targets)
    reversal = 0.5 * profile.reversal_um * (1.0 + 0.15 * rng.standard_normal(targets))
    cyclic = profile.pitch_um * np.sin(2 * np.pi * session.position_mm / profile.lead_mm + rng.uniform(0.0, 2 * np.pi))
    smooth = profile.slope_um * session.share + 4.0 * profile.bow_um * session.share * (1.0 - session.share)
    return np.asarray(smooth + cyclic + rough[session.target - 1] + session.sign * reversal[session.target - 1])


def nuisance(drift: Drift, session: Session, seed: int) -> Floats:
    """Return the drift that no physics of the recipe explains, um: a common part and one that grows along the travel.

    Both move in real time, between the readings of a pass as well. The intensity is the standard deviation after one hour
    (random_walk, integrated) or the stationary one with a correlation time of one hour (ou).
    """
    hours = np.diff(session.time_s, prepend=0.0) / 3600.0
    common = drift.walk_common_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "common walk"))
    slope = drift.walk_slope_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "slope walk"))
    return np.asarray(common + session.share * slope)


def laser_noise(laser: Laser, session: Session, seed: int) -> Floats:
    """Return the random error of every reading, um; `noise_spread` is the relative natural spread of its size over the targets."""
    rng = stream(seed, "noise")
    n = session.time_s.size
    unit = rng.standard_normal(n) if laser.tails == "normal" else rng.standard_t(4, n) / np.sqrt(2.0)
    sizes = np.exp(laser.noise_spread * stream(seed, "noise spread").standard_normal(int(session.target.max())))
    return np.asarray(laser.noise_um * sizes[session.target - 1] * unit)


def _walk(kind: str, hours: Floats, rng: np.random.Generator) -> Floats:
    """Return a wandering series of unit intensity over the given steps."""
    kicks = rng.standard_normal(hours.size) * np.sqrt(hours)
    if kind == "random_walk":
        return np.cumsum(kicks)
    if kind == "integrated":
        return np.asarray(np.sqrt(3.0) * np.cumsum(np.cumsum(kicks) * hours))
    state = np.zeros(hours.size)
    if kind == "ou":
        decay = np.exp(-hours / OU_HOURS)
        fresh = np.sqrt(1.0 - decay**2) * rng.standard_normal(hours.size)
        state[0] = rng.standard_normal()
        for k in range(1, hours.size):
            state[k] = decay[k] * state[k - 1] + fresh[k]
    return state
