"""Everything that can be wrong with the simulated machine without being declared: effects on all readings, anomalies of one target.

An effect is a function of the session; its keyword arguments are its parameters in RECIPE.toml. It returns one value per reading (um) or,
where only the camera sees it, per frame (K), and the recipe scales it to an rms. Three effects also change what the instruments write:
`camera_offset` and `reflected_source` the frames, `sensor_fault` the environment log. The last four are outside the library of the
analysis: a sound analysis reports them without a name. Formulas and sources: docs/method/effects.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, create_model

from fusion.twin.machine import Drive, Session, first_order, random_levels, refractivity, stream
from thermofuse.resources import vocabulary

Array = NDArray[np.float64]
Shape = Literal["flat", "linear"]
Sensor = Literal["air_temperature", "air_pressure"]
Fault = Literal["stuck", "jump"]


#: What the parameters of the effects mean; one name means the same in all of them.
_MEANING = vocabulary("twin")["parameters"]


@dataclass(frozen=True)
class Effect:
    """One effect of the twin's library.

    ``unit`` is "um" for an effect on the readings (n,), "K" for one on the frames that only the camera sees; ``parameters`` are the
    defaults of the keyword arguments of ``series(session, **parameters)``, which ``table`` checks by their annotations.
    """

    name: str
    unit: str
    series: Callable[..., Array]
    parameters: dict[str, Any]
    table: type[BaseModel]


def _library(unit: str, *functions: Callable[..., Array]) -> dict[str, Effect]:
    """Return effects by name; the keyword arguments of their functions are their parameters."""
    strict = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    effects = {}
    for function in functions:
        name, defaults, kinds = function.__name__, function.__kwdefaults__ or {}, get_type_hints(function)
        parameters: dict[str, Any] = {
            key: (kinds[key], Field(default, description=_MEANING[key])) for key, default in defaults.items()
        }
        table = create_model(name, __config__=strict, **parameters)
        effects[name] = Effect(name, unit, function, defaults, table)
    return effects


def _pattern(session: Session, shape: Shape) -> Array:
    """Return the pattern along the axis at every reading: 1 (flat), or position over travel (linear)."""
    return session.share if shape == "linear" else np.ones(session.time_s.size)


def _index_change(session: Session) -> Array:
    """Return the change of the refractive index of air since the start of the test at every reading."""
    return session.at_readings(session.refractivity) - session.at_start(session.refractivity)


def thermal_lag(
    session: Session, *, um_per_K: float = 1.5, time_constant_min: float = 45.0, shape: Shape = "flat"
) -> Array:
    """Return the error of a remote part that follows the table's mean rise through a first-order lag."""
    lagged = first_order(session.table_rise_K, session.grid_step_s, 60.0 * time_constant_min)
    return um_per_K * session.at_readings(lagged) * _pattern(session, shape)


def unseen_heat_source(
    session: Session,
    *,
    um: float = 3.0,
    time_constant_min: float = 14.0,
    follows: Drive = "duty",
    shape: Shape = "flat",
) -> Array:
    """Return the error of a part outside the camera's view (spindle, column) that warms with a load."""
    state = session.state(follows, time_constant_min, "unseen_heat_source")
    return um * session.at_readings(state) * _pattern(session, shape)


def dead_path(session: Session, *, mm: float = 300.0) -> Array:
    """Return the error of an uncompensated dead path, L dn."""
    return mm * 1e3 * _index_change(session)


def air_index(session: Session, *, gain: float = 1.0) -> Array:
    """Return the error where the refractive index of air is not compensated along the measured length."""
    return gain * session.position_mm * 1e3 * _index_change(session)


def material_compensation(session: Session, *, ppm_per_K: float = 2.0) -> Array:
    """Return the error of a material compensation with a wrong expansion coefficient."""
    probe = session.at_readings(session.probe_degC) - session.at_start(session.probe_degC)
    return ppm_per_K * 1e-3 * session.position_mm * probe


def angular_growth(
    session: Session,
    *,
    arcsec: float = 2.0,
    abbe_mm: float = 150.0,
    time_constant_min: float = 60.0,
    follows: Drive = "constant",
) -> Array:
    """Return the Abbe error of a guide that bends as it warms, quadratic in position."""
    angle = np.deg2rad(arcsec / 3600.0) * session.state(follows, time_constant_min, "angular_growth")
    return abbe_mm * 1e3 * session.at_readings(angle) * session.share**2


def reversal_drift(
    session: Session, *, um: float = 1.5, time_constant_min: float = 35.0, follows: Drive = "duty"
) -> Array:
    """Return the error of a reversal error that changes with the temperature of the screw."""
    state = session.state(follows, time_constant_min, "reversal_drift")
    return 0.5 * um * session.sign * session.at_readings(state)


def step_event(session: Session, *, um: float = 1.5, at_cycle: int = 30, at_part: float = 0.35) -> Array:
    """Return the error of a mount or clamp that slips once."""
    instant = session.start_of(at_cycle) + at_part * session.period_s
    return um * (session.time_s >= instant).astype(float)


def periodic_disturbance(
    session: Session, *, um: float = 0.6, period_min: float = 23.0, shape: Shape = "flat"
) -> Array:
    """Return the error of a cooling or air conditioning that switches periodically, a sine of random phase."""
    phase = stream(session.seed, "periodic_disturbance").uniform(0.0, 2.0 * np.pi)
    return um * np.sin(2 * np.pi * session.time_s / (60.0 * period_min) + phase) * _pattern(session, shape)


def pitch_error(
    session: Session, *, um: float = 1.5, lead_mm: float = 7.0, time_constant_min: float = 30.0, follows: Drive = "duty"
) -> Array:
    """Return the error of a screw whose cyclic error grows with its temperature."""
    phase = stream(session.seed, "pitch_error").uniform(0.0, 2.0 * np.pi)
    amplitude = um * session.at_readings(session.state(follows, time_constant_min, "pitch_error"))
    return amplitude * np.sin(2 * np.pi * session.position_mm / lead_mm + phase)


def camera_offset(
    session: Session, *, K: float = 0.5, at_cycle: int = 30, kind: Literal["step", "ramp"] = "step"
) -> Array:
    """Return the offset of all pixels of a camera whose zero changes while the machine does not move."""
    start = session.start_of(at_cycle)
    since = session.frame_s - start
    course = 1.0 if kind == "step" else since / max(session.frame_s[-1] - start, 1.0)
    return K * np.where(since < 0, 0.0, course)


def reflected_source(
    session: Session,
    *,
    K: float = 25.0,
    x_mm: float = 480.0,
    y_mm: float = 60.0,
    spread_mm: float = 45.0,
    follows: Literal["duty", "own", "constant", "table", "switched"] = "switched",
) -> Array:
    """Return how much warmer than the surroundings a body is that the paint of the table reflects."""
    if follows == "switched":
        rng = stream(session.seed, "reflected_source")
        return K * session.at_frames(random_levels(session.grid_s, 0.0, 1.0, 45.0, rng, alternate=True))
    return K * session.at_frames(session.state(follows, 5.0, "reflected_source"))


def laser_warm_up(
    session: Session, *, ppm: float = 3.0, time_constant_min: float = 12.0, dead_path_mm: float = 60.0
) -> Array:
    """Return the error of a laser whose wavelength settles exponentially after it is switched on."""
    remaining = np.exp(-session.time_s / (60.0 * time_constant_min))
    return -ppm * 1e-3 * (session.position_mm + dead_path_mm) * remaining


def sensor_fault(
    session: Session, *, at_cycle: int = 20, sensor: Sensor = "air_temperature", kind: Fault = "jump", size: float = 2.0
) -> Array:
    """Return the error of an index compensation that uses a faulty sensor of the environment unit."""
    temperature, pressure = logged_air(session, at_cycle=at_cycle, sensor=sensor, kind=kind, size=size)
    compensated = refractivity(temperature, pressure, session.air_percent)
    return session.position_mm * 1e3 * session.at_readings(session.refractivity - compensated)


def logged_air(session: Session, *, at_cycle: int, sensor: Sensor, kind: Fault, size: float) -> tuple[Array, Array]:
    """Return the state of the air as an environment unit with a faulty sensor reports it."""
    true = {"air_temperature": session.air_degC, "air_pressure": session.air_hPa}[sensor]
    after = session.grid_s >= session.start_of(at_cycle)
    reported = np.where(after, true[int(np.argmax(after))] if kind == "stuck" else true + size, true)
    return (reported, session.air_hPa) if sensor == "air_temperature" else (session.air_degC, reported)


def telegraph_switching(
    session: Session, *, um: float = 1.0, mean_hold_min: float = 40.0, first_target: int = 9, last_target: int = 12
) -> Array:
    """Return the error of a few targets that alternate between two states in the negative direction."""
    rng = stream(session.seed, "telegraph_switching")
    state = random_levels(session.grid_s, 0.0, 1.0, mean_hold_min, rng, alternate=True)
    affected = (session.target >= first_target) & (session.target <= last_target) & (session.sign < 0)
    return um * (affected & (session.at_readings(state) > 0.5)).astype(float)


def travelling_chirp(
    session: Session, *, um: float = 1.0, start_period_min: float = 80.0, end_period_min: float = 20.0
) -> Array:
    """Return the error of a wave along the axis whose frequency rises linearly, in the positive direction only."""
    f0, f1 = 1.0 / (60.0 * start_period_min), 1.0 / (60.0 * end_period_min)
    turns = f0 * session.time_s + 0.5 * (f1 - f0) / (session.cycles * session.period_s) * session.time_s**2
    return um * (session.sign > 0) * np.sin(2 * np.pi * (turns - session.share))


def local_creep(
    session: Session, *, um: float = 1.0, centre_mm: float = 110.0, width_mm: float = 45.0, start_min: float = 20.0
) -> Array:
    """Return the error of one stretch of the guide that creeps with the logarithm of time."""
    bump = np.exp(-0.5 * ((session.position_mm - centre_mm) / width_mm) ** 2)
    return um * bump * np.log1p(session.time_s / (60.0 * start_min))


def direction_scale(
    session: Session, *, um: float = 2.0, time_constant_min: float = 90.0, follows: Drive = "constant"
) -> Array:
    """Return the error of a scale that grows differently in the two directions of approach."""
    state = session.state(follows, time_constant_min, "direction_scale")
    return 0.5 * um * session.sign * session.share * session.at_readings(state)


_ON_READINGS = (
    thermal_lag, unseen_heat_source, dead_path, air_index, material_compensation, angular_growth, reversal_drift, step_event,
    periodic_disturbance, pitch_error, laser_warm_up, sensor_fault, telegraph_switching, travelling_chirp, local_creep, direction_scale,
)  # fmt: skip
#: Every effect by name.
EFFECTS = _library("um", *_ON_READINGS) | _library("K", camera_offset, reflected_source)

#: Effects that act on one instrument only and cannot be superposed.
ONCE = ("reflected_source", "sensor_fault")
#: Effects that do not need positions, as a record has none.
IN_A_RECORD = ("thermal_lag", "unseen_heat_source", "step_event", "periodic_disturbance")
#: Kinds of an anomalous place.
ANOMALIES = ("structural", "local_temperature", "stick_slip", "step", "wander")


def anomaly_series(kind: str, session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return an anomaly at all readings (n,), of any size; the recipe selects target and direction, and scales.

    ``local_rise_K`` (m,) is the rise of the target by a heat source of its own, ``at_cycle`` the first cycle after a step (0: half-way
    through the test).
    """
    n = session.time_s.size
    if kind == "structural":
        # A loose or worn place scatters: white noise.
        return rng.standard_normal(n)
    if kind == "local_temperature":
        return session.at_readings(local_rise_K)
    if kind == "stick_slip":
        # The axis stops short of the target in a quarter of the approaches, by an exponential amount.
        return -session.sign * rng.exponential(1.0, n) * (rng.uniform(size=n) < 0.25)
    if kind == "step":
        return (session.cycle >= (at_cycle or session.cycles // 2 + 1)).astype(float)
    # A slow random motion, white noise through a lag of 40 min, which no measured quantity explains.
    return session.at_readings(first_order(rng.standard_normal(session.grid_s.size), session.grid_step_s, 2400.0))
