"""Simulation of a campaign: from a recipe to every reading of the test and every part that it is the sum of.

No frame is rendered here; a campaign of 100 cycles takes well under a second, so that studies can run hundreds. The steps, in order:
heat and air behind the readings, the readings' parts (static profile, declared effects, random drift, noise, undeclared effects,
anomalies), what the camera adds of its own, and what the environment unit and the machine log.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array
from fusion.twin.effects import EFFECTS, anomaly_series, logged_air
from fusion.twin.machine import (
    Air,
    Plate,
    ReadingSequence,
    Schedule,
    Session,
    duty_levels,
    first_order,
    make_schedule,
    random_levels,
    simulate_air,
    solve_plate,
    stream,
)
from fusion.twin.recipe import Drift, EffectRecipe, Laser, Profile, Recipe, RecipeError, Source
from fusion.twin.recipe_file import check_recipe

#: Step of the time grid on which heat and air are solved.
GRID_STEP_S = 10.0
#: Warming of the camera's housing after it is switched on at the start of the test, and its time constant.
CAMERA_WARM_UP_K = 6.0
CAMERA_WARM_UP_S = 1500.0
#: Plan point of the material temperature sensor.
PROBE_MM = (640.0, 30.0)
#: Correlation time of the Ornstein-Uhlenbeck drift.
OU_HOURS = 1.0
_SIGNS = {"both": (1, -1), "positive": (1,), "negative": (-1,)}


@dataclass(frozen=True)
class Truth:
    """A simulated campaign: what the instruments recorded, and why.

    Attributes
    ----------
    recipe : the recipe asked for, with the size of a sensor fault that gives its rms
    schedule : when and where each reading is taken
    session : the states behind the readings
    plate : the true temperature field, at any point and time
    readings
        (cycle, direction, target): `deviation` as measured, um (NaN where lost), `time`, one variable in um for every part of the
        deviation, `mean_profile` and `scatter`
    frames : xarray.Dataset
        (frame,): true time `time_s`, offset `camera_offset_K`, `reflected_K`, `housing` temperature, `table_position` and `knocked`.
    parts : names of the parts that the deviation is the sum of
    """

    recipe: Recipe
    schedule: Schedule
    session: Session
    plate: Plate
    readings: xr.Dataset
    frames: xr.Dataset
    parts: tuple[str, ...]

    def clock(self, time_s: Array) -> NDArray[np.datetime64]:
        """Return times in s since the start of the test as UTC times of the laser's clock, rounded to ms."""
        return _clock(self.recipe, time_s)

    def in_order(self, name: str) -> Array:
        """Return a variable of `readings` in the order in which the readings were taken, (n,)."""
        ordered = self.readings[name].values.copy()
        ordered[:, 1] = ordered[:, 1, ::-1]
        return np.asarray(ordered.ravel())

    def temperature(self, time_s: Array, x_mm: Array, y_mm: Array, *, cell_mm: float = 0.0) -> Array:
        """Return the true table temperature (time, y, x), degC, at plan points or averaged over square cells around them."""
        return self.plate.field(time_s, x_mm, y_mm, cell_mm=cell_mm) + self.recipe.table.initial_temperature_degC


def simulate(recipe: Recipe) -> Truth:
    """Simulate a positioning campaign without rendering a frame; the same recipe gives the same numbers.

    Raises a RecipeError where the recipe asks for a record, a value is impossible, the cycle does not fit into its period, or an effect
    moves no reading.

    >>> truth = simulate(Recipe().vary(test={"cycles": 3}))
    >>> dict(truth.readings["deviation"].sizes)
    {'cycle': 3, 'direction': 2, 'target': 16}
    >>> truth.parts
    ('static_profile', 'axis_expansion', 'table_offset', 'nuisance', 'noise')
    """
    seed = check_recipe(recipe).campaign.seed
    if recipe.record is not None:
        raise RecipeError("this recipe asks for a [record]; use simulate_record, or remove the table")
    schedule = make_schedule(recipe.test, seed)
    grid_s = np.arange(
        -60.0 * recipe.table.preheat_min, schedule.duration_s + 10 * GRID_STEP_S, GRID_STEP_S, dtype=float
    )
    duty = duty_levels(recipe.duty, grid_s, seed)
    air = simulate_air(recipe.room, grid_s, seed)
    plate, local_rises = _heat(recipe, schedule, grid_s, duty, air)
    session = _session(recipe, schedule, grid_s, duty, air, plate)
    recipe = replace(recipe, effect=tuple(_with_fault_sized(effect, session) for effect in recipe.effect))

    series = {
        "static_profile": static_profile(recipe.profile, session, seed),
        "axis_expansion": _axis_expansion(recipe.drift, schedule, session, plate),
        "table_offset": recipe.drift.offset_um_per_K * session.at_readings(session.table_rise_K),
        "nuisance": nuisance(recipe.drift, session, seed),
        "noise": laser_noise(recipe.laser, session, seed),
    }
    for effect in recipe.effect:
        series[_unused_name(effect.name, series)] = _scaled(effect, session)
    for anomaly, local_rise in zip(recipe.anomaly, local_rises, strict=True):
        name, what = f"anomaly_{anomaly.target}_{anomaly.kind}", f"anomaly at target {anomaly.target}"
        rng = stream(seed, f"anomaly {anomaly.target} {anomaly.kind}")
        affected = (session.target == anomaly.target) & np.isin(session.sign, _SIGNS[anomaly.direction])
        motion = np.where(affected, anomaly_series(anomaly.kind, session, local_rise, rng, anomaly.at_cycle), 0.0)
        series[_unused_name(name, series)] = motion * _gain(anomaly.amplitude_um, moving_rms(motion, session), what)
    readings = _dataset(recipe, schedule, series)
    return Truth(recipe, schedule, session, plate, readings, _frames(recipe, schedule, session), tuple(series))


def _clock(recipe: Recipe, time_s: Array) -> NDArray[np.datetime64]:
    """Return times in s since the start of the test as UTC times, rounded to ms."""
    start = np.datetime64(recipe.campaign.start.removesuffix("Z"), "ms")
    return np.asarray(start + np.round(np.asarray(time_s) * 1e3).astype("timedelta64[ms]"))


# Heat and air behind the readings.


def _heat(recipe: Recipe, schedule: Schedule, grid_s: Array, duty: Array, air: Air) -> tuple[Plate, list[Array]]:
    """Solve the plate with all sources; also the rise (m,) at each anomalous target due to a heat source of its own."""
    local_sources = {}
    for number, anomaly in enumerate(recipe.anomaly):
        if anomaly.kind == "local_temperature":
            position = schedule.positions_mm[anomaly.target - 1]
            x_mm, y_mm = np.array(recipe.plan.origin_mm) + np.array(recipe.plan.direction) * position
            name = f"target {anomaly.target}"
            local_sources[number] = Source(name, float(x_mm), float(y_mm), 14.0, 14.0, 6.0, 4.0, "own")
    sources = (*recipe.source, *local_sources.values())
    power = np.zeros((grid_s.size, len(sources)))
    for column, source in enumerate(sources):
        if source.follows == "duty":
            drive = duty
        elif source.follows == "constant":
            drive = np.ones(grid_s.size)
        else:
            rng = stream(recipe.campaign.seed, f"own drive of {source.name}")
            drive = random_levels(grid_s, 0.0, 1.0, 35.0, rng, alternate=True)
        power[:, column] = source.power_W * first_order(drive, GRID_STEP_S, 60.0 * source.time_constant_min)
    start = recipe.table.initial_temperature_degC
    plate = solve_plate(recipe.plan, recipe.table, sources, power, air.temperature_degC - start, grid_s)
    local_rises = [np.zeros(grid_s.size) for _ in recipe.anomaly]
    for column, (number, source) in enumerate(local_sources.items(), len(recipe.source)):
        alone = solve_plate(recipe.plan, recipe.table, (source,), power[:, [column]], np.zeros(grid_s.size), grid_s)
        local_rises[number] = alone.points(np.array([source.x_mm]), np.array([source.y_mm]))[:, 0]
    return plate, local_rises


def _session(recipe: Recipe, schedule: Schedule, grid_s: Array, duty: Array, air: Air, plate: Plate) -> Session:
    """Collect the states that effects act through."""
    probe = plate.points(np.array([PROBE_MM[0]]), np.array([PROBE_MM[1]]))[:, 0]
    probe = first_order(probe, GRID_STEP_S, 60.0 * recipe.room.probe_lag_min)
    return Session(
        **{one.name: getattr(schedule, one.name) for one in fields(ReadingSequence)},
        seed=recipe.campaign.seed,
        travel_mm=float(schedule.positions_mm[-1]),
        grid_s=grid_s,
        duty=duty,
        table_rise_K=plate.mean() - np.interp(0.0, grid_s, plate.mean()),
        probe_degC=recipe.table.initial_temperature_degC + probe,
        air_degC=air.temperature_degC,
        air_hPa=air.pressure_hPa,
        air_percent=air.humidity_percent,
        refractivity=air.index,
        frame_s=_frame_times(recipe, schedule),
    )


def _frame_times(recipe: Recipe, schedule: Schedule) -> Array:
    """Return the true times of the frames, s."""
    camera = recipe.camera
    if camera.table == "moving":
        return np.arange(0.5 * camera.frame_interval_s, schedule.duration_s, camera.frame_interval_s, dtype=float)
    burst_s = np.arange(camera.frames_per_cycle) * camera.burst_interval_s
    burst = schedule.last_reading_s + camera.frame_after_s + burst_s
    if burst[-1] >= schedule.period_s:
        raise RecipeError(
            f"camera: the last frame of a cycle is due {burst[-1]:.1f} s after its start, past its end at {schedule.period_s:.1f} s; "
            "lower frame_after_s or frames_per_cycle, or raise test.period_s"
        )
    return (np.arange(schedule.cycles)[:, None] * schedule.period_s + burst).ravel()


# The parts of every reading.


def static_profile(profile: Profile, session: Session, seed: int) -> Array:
    """Return the static positioning error: slope, bow, roughness, cyclic error and reversal error."""
    rng = stream(seed, "profile")
    targets = int(session.target.max())
    rough = profile.rough_um * rng.standard_normal(targets)
    half_reversal = 0.5 * profile.reversal_um * (1.0 + 0.15 * rng.standard_normal(targets))
    cyclic = profile.pitch_um * np.sin(2 * np.pi * session.position_mm / profile.lead_mm + rng.uniform(0.0, 2 * np.pi))
    smooth = profile.slope_um * session.share + 4.0 * profile.bow_um * session.share * (1.0 - session.share)
    target = session.target - 1
    return np.asarray(smooth + cyclic + rough[target] + session.sign * half_reversal[target])


def _axis_expansion(drift: Drift, schedule: Schedule, session: Session, plate: Plate) -> Array:
    """Return the expansion of the table between the laser's zero and each target, um: coefficient times integral of the rise."""
    integrals = plate.line_integrals(schedule.positions_mm)
    integrals -= [session.at_start(column) for column in integrals.T]
    at_readings = np.stack([session.at_readings(column) for column in integrals.T])
    return drift.expansion_ppm_per_K * 1e-3 * at_readings[schedule.target - 1, np.arange(schedule.time_s.size)]


def nuisance(drift: Drift, session: Session, seed: int) -> Array:
    """Return the drift that no physical quantity explains: a common part, and one proportional to position."""
    hours = np.diff(session.time_s, prepend=0.0) / 3600.0
    common = drift.walk_common_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "common walk"))
    slope = drift.walk_slope_um_per_sqrt_h * _walk(drift.walk, hours, stream(seed, "slope walk"))
    return np.asarray(common + session.share * slope)


def _walk(kind: str, hours: Array, rng: np.random.Generator) -> Array:
    """Return a random drift of unit intensity at the ends of the given steps, h."""
    increments = rng.standard_normal(hours.size) * np.sqrt(hours)
    if kind == "random_walk":
        return np.cumsum(increments)
    if kind == "integrated":
        return np.asarray(np.sqrt(3.0) * np.cumsum(np.cumsum(increments) * hours))
    state = np.zeros(hours.size)
    if kind == "ou":
        decay = np.exp(-hours / OU_HOURS)
        innovations = np.sqrt(1.0 - decay**2) * rng.standard_normal(hours.size)
        state[0] = rng.standard_normal()
        for k in range(1, hours.size):
            state[k] = decay[k] * state[k - 1] + innovations[k]
    return state


def laser_noise(laser: Laser, session: Session, seed: int) -> Array:
    """Return the random error of every reading."""
    rng = stream(seed, "noise")
    n = session.time_s.size
    unit = rng.standard_normal(n) if laser.tails == "normal" else rng.standard_t(4, n) / np.sqrt(2.0)
    sizes = np.exp(laser.noise_spread * stream(seed, "noise spread").standard_normal(int(session.target.max())))
    return np.asarray(laser.noise_um * sizes[session.target - 1] * unit)


def _scaled(effect: EffectRecipe, session: Session) -> Array:
    """Return an effect's series in um, scaled to the rms that the recipe asks for; 0 for an effect that only the camera sees."""
    if EFFECTS[effect.name].unit == "K":
        return np.zeros(session.time_s.size)
    series = EFFECTS[effect.name].series(session, **effect.parameters)
    # The size of a sensor fault has been found before, because the environment log shows it too.
    if effect.amplitude_um is None or effect.name == "sensor_fault":
        return series
    return series * _gain(effect.amplitude_um, moving_rms(series, session), f"effect {effect.name}")


def _with_fault_sized(effect: EffectRecipe, session: Session) -> EffectRecipe:
    """Return a sensor fault with the jump that gives the wanted rms, so that the log shows the jump that the laser errs by."""
    if effect.name != "sensor_fault" or effect.amplitude_um is None:
        return effect
    parameters = EFFECTS[effect.name].parameters | effect.parameters
    if parameters["kind"] == "stuck":
        raise RecipeError(
            "effect sensor_fault: the error of a stuck sensor follows from the air; remove amplitude_um, or use kind = 'jump'"
        )
    # The refractivity is not linear in temperature and pressure.
    for _ in range(8):
        rms = moving_rms(EFFECTS[effect.name].series(session, **parameters), session)
        parameters["size"] *= _gain(effect.amplitude_um, rms, "effect sensor_fault")
    return replace(effect, parameters=parameters)


def moving_rms(series: Array, session: Session) -> float:
    """Return the rms about the mean per target and direction, over the targets and directions that move at all."""
    moving = _by_site(series, session.cycles)
    moving = moving - moving.mean(axis=0)
    affected = np.abs(moving).max(axis=0) > 1e-12
    return float(np.sqrt(np.mean(moving[:, affected] ** 2))) if affected.any() else 0.0


def _by_site(series: Array, cycles: int) -> Array:
    """Return readings in the order taken as (cycle, direction, target), direction positive then negative."""
    laid = np.array(series).reshape(cycles, 2, -1)
    laid[:, 1] = laid[:, 1, ::-1]
    return laid


def _gain(wanted_um: float, rms_um: float, what: str) -> float:
    """Return the factor that brings a series to the wanted rms."""
    if rms_um == 0.0:
        raise RecipeError(
            f"{what}: nothing moves in this test, so it cannot be scaled to {wanted_um} um rms; change its parameters"
        )
    return wanted_um / rms_um


def _unused_name(name: str, taken: dict[str, Array]) -> str:
    """Return the name, numbered where the recipe uses it again."""
    count = 1 + sum(t == name or t.startswith(f"{name}_again") for t in taken)
    return name if count == 1 else f"{name}_again{count}"


def _at_one_state(values: Array, time_s: Array) -> Array:
    """Return the mean over the cycles at the same instants for all sites: between two approaches of one cycle the machine drifts."""
    middle_s = time_s.mean(axis=(1, 2))
    sites = [np.interp(middle_s, time_s[:, i, j], values[:, i, j]) for i, j in np.ndindex(values.shape[1:])]
    return np.asarray(np.mean(sites, axis=1).reshape(values.shape[1:]))


def _dataset(recipe: Recipe, schedule: Schedule, series: dict[str, Array]) -> xr.Dataset:
    """Return the readings as (cycle, direction, target): measured deviation, time, every part, and what statistics should find."""
    dims = ("cycle", "direction", "target")
    parts = {name: (dims, _by_site(part, schedule.cycles), {"units": "um"}) for name, part in series.items()}
    deviation = np.sum([part for _, part, _ in parts.values()], axis=0)
    random_parts = [part for name, (_, part, _) in parts.items() if name == "noise" or name.endswith("structural")]
    random = np.sum(random_parts, axis=0)
    profile_of = {"units": "um", "long_name": "profile at the test's mean state"}
    scatter_of = {"units": "um", "long_name": "sample standard deviation of what is random"}
    scatter = random.std(axis=0, ddof=min(1, schedule.cycles - 1))
    drawn = stream(recipe.campaign.seed, "lost readings").uniform(size=np.shape(deviation))
    lost = drawn < recipe.test.missing_fraction
    time = _clock(recipe, _by_site(schedule.time_s, schedule.cycles)).astype("datetime64[ns]")
    return xr.Dataset(
        {
            "deviation": (dims, np.where(lost, np.nan, deviation), {"units": "um"}),
            "time": (dims, time),
            **parts,
            "mean_profile": (
                dims[1:],
                _at_one_state(deviation - random, _by_site(schedule.time_s, schedule.cycles)),
                profile_of,
            ),
            "scatter": (dims[1:], scatter, scatter_of),
        },
        coords={
            "cycle": np.arange(1, schedule.cycles + 1),
            "direction": ["positive", "negative"],
            "target": np.arange(1, schedule.positions_mm.size + 1),
            "position": ("target", schedule.positions_mm, {"units": "mm"}),
        },
    )


# What the camera adds of its own.


def _frames(recipe: Recipe, schedule: Schedule, session: Session) -> xr.Dataset:
    """Return time, offset, reflection, housing temperature, table position and displacement of every frame."""
    camera = recipe.camera
    warm_up = CAMERA_WARM_UP_K * (1.0 - np.exp(-session.frame_s / CAMERA_WARM_UP_S))
    housing = session.at_frames(session.air_degC) + warm_up
    housing_drift = camera.drift_K_per_K * (housing - session.at_start(session.air_degC))
    # A new random offset after every flat-field correction.
    number = (session.frame_s // (60.0 * camera.ffc_interval_min)).astype(int)
    corrected = camera.ffc_step_K * stream(recipe.campaign.seed, "ffc").standard_normal(number.max() + 1)[number]
    offset, reflected = corrected + housing_drift, np.zeros(session.frame_s.size)
    for effect in recipe.effect:
        if effect.name == "reflected_source":
            reflected = reflected + _scaled_for_camera(effect, recipe, session)
        elif EFFECTS[effect.name].unit == "K":
            offset = offset + _scaled_for_camera(effect, recipe, session)
    knocked = (session.frame_s >= session.start_of(camera.knock_cycle)) & (camera.knock_cycle > 0)
    return xr.Dataset(
        {
            "camera_offset_K": ("frame", offset, {"units": "K"}),
            "reflected_K": ("frame", reflected, {"units": "K"}),
            "time_s": ("frame", session.frame_s, {"units": "s", "long_name": "true time since the start of the test"}),
            "housing": ("frame", housing, {"units": "degC", "long_name": "temperature of the camera's housing"}),
            "table_position": ("frame", schedule.table_position(session.frame_s), {"units": "mm"}),
            "knocked": ("frame", knocked.astype(np.int8)),
        }
    )


def _scaled_for_camera(effect: EffectRecipe, recipe: Recipe, session: Session) -> Array:
    """Return what an effect adds to the camera's view, K; an rms in um is that of the declared model's error of prediction."""
    parameters = effect.parameters | ({} if effect.amplitude_K is None else {"K": effect.amplitude_K})
    series = EFFECTS[effect.name].series(session, **parameters)
    if effect.amplitude_um is None:
        return series
    if effect.name == "reflected_source":
        raise RecipeError("effect reflected_source: amplitude_um has no meaning for a spot; write amplitude_K")
    error = np.interp(session.time_s, session.frame_s, series)
    predicted = error * (recipe.drift.expansion_ppm_per_K * 1e-3 * session.position_mm + recipe.drift.offset_um_per_K)
    return series * _gain(effect.amplitude_um, moving_rms(predicted, session), "effect camera_offset")


# What is logged with the readings.


def environment_log(truth: Truth) -> xr.Dataset:
    """Return what the laser's environment unit logs once a minute, with sensor noise, faults and resolution."""
    session, recipe = truth.session, truth.recipe
    minute = np.arange(0.0, truth.schedule.duration_s, 60.0, dtype=float)
    temperature, pressure = session.air_degC, session.air_hPa
    for effect in recipe.effect:
        if effect.name == "sensor_fault":
            temperature, pressure = logged_air(session, **(EFFECTS[effect.name].parameters | effect.parameters))
    rng = stream(recipe.campaign.seed, "environment unit")
    columns = {
        "air_temperature": (temperature, 0.004, 2, "degC"),
        "air_pressure": (pressure, 0.02, 2, "hPa"),
        "relative_humidity": (session.air_percent, 0.05, 1, "percent"),
        "material_temperature": (session.probe_degC, 0.004, 2, "degC"),
    }
    logged = {}
    for name, (true, noise, digits, unit) in columns.items():
        noisy = np.interp(minute, session.grid_s, true) + noise * rng.standard_normal(minute.size)
        logged[name] = ("time", np.round(noisy, digits), {"units": unit})
    return xr.Dataset(logged, coords={"time": truth.clock(minute).astype("datetime64[ns]")})


def driver_log(truth: Truth) -> xr.Dataset:
    """Return the load of the machine as logged once a minute."""
    minute = np.arange(0.0, truth.schedule.duration_s, 60.0, dtype=float)
    level = truth.session.duty[np.searchsorted(truth.session.grid_s, minute)]
    logged = {"duty": ("time", level.round(3), {"units": "1"})}
    return xr.Dataset(logged, coords={"time": truth.clock(minute).astype("datetime64[ns]")})
