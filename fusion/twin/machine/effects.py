"""What can be wrong with the twin without anybody declaring it, one named effect per function.

Every effect returns its series per reading in its natural unit; the recipe scales it to an rms. Three also change what the
instruments write: `camera_offset` and `reflected_source` what the camera sees, `sensor_fault` what the environment log says.
The last four stand outside the analysis' library: a sound analysis must leave them without a name.

What can be wrong with a single target: extra scatter, its own heat, stick-slip, a step, a slow wander.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.machine.air import refractivity
from fusion.twin.machine.session import DRIVES, Session
from fusion.twin.machine.streams import first_order, random_levels, stream

Floats = NDArray[np.floating[Any]]
SHAPES = ("flat", "linear")


@dataclass(frozen=True)
class Effect:
    """A named effect: its function, natural unit (um, or K for what only the camera sees), parameters with their defaults."""

    name: str
    unit: str
    series: Callable[..., Floats]
    parameters: dict[str, Any]
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)


EFFECTS: dict[str, Effect] = {}


def _effect(unit: str = "um", **choices: tuple[str, ...]) -> Callable[[Callable[..., Floats]], Callable[..., Floats]]:
    """Enter a function of (session, *, parameters) into the library under its own name."""

    def enter(function: Callable[..., Floats]) -> Callable[..., Floats]:
        signature = inspect.signature(function).parameters
        defaults = {k: p.default for k, p in signature.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}
        EFFECTS[function.__name__] = Effect(function.__name__, unit, function, defaults, choices)
        return function

    return enter


def _shape(session: Session, shape: str) -> Floats:
    """Return 1 (flat) or the position over the travel (linear)."""
    return session.share if shape == "linear" else np.ones(session.time_s.size)


@_effect(shape=SHAPES)
def thermal_lag(
    session: Session, *, um_per_K: float = 1.5, time_constant_min: float = 45.0, shape: str = "flat"
) -> Floats:
    """A remote part follows the seen table late and goes on moving after it."""
    lagged = first_order(session.table_rise_K, session.grid_s[1] - session.grid_s[0], 60.0 * time_constant_min)
    return np.asarray(um_per_K * session.at_readings(lagged) * _shape(session, shape))


@_effect(shape=SHAPES, follows=DRIVES)
def unseen_heat_source(
    session: Session, *, um: float = 3.0, time_constant_min: float = 14.0, follows: str = "duty", shape: str = "flat"
) -> Floats:
    """Spindle or column warms by a load and moves the reading, out of the camera's sight."""
    return np.asarray(
        um
        * session.at_readings(session.state(follows, time_constant_min, "unseen_heat_source"))
        * _shape(session, shape)
    )


@_effect()
def dead_path(session: Session, *, mm: float = 300.0) -> Floats:
    """Air between the interferometer and its zero that nobody compensates."""
    return np.asarray(mm * 1e3 * _index_change(session))


@_effect()
def air_index(session: Session, *, gain: float = 1.0) -> Floats:
    """The index of air is not (1), or too little compensated along the measured length."""
    return np.asarray(gain * session.position_mm * 1e3 * _index_change(session))


@_effect()
def material_compensation(session: Session, *, ppm_per_K: float = 2.0) -> Floats:
    """The coefficient of the material compensation is wrong: the error follows the probe."""
    probe = session.at_readings(session.probe_degC) - np.interp(0.0, session.grid_s, session.probe_degC)
    return np.asarray(ppm_per_K * 1e-3 * session.position_mm * probe)


@_effect(follows=DRIVES)
def angular_growth(
    session: Session,
    *,
    arcsec: float = 2.0,
    abbe_mm: float = 150.0,
    time_constant_min: float = 60.0,
    follows: str = "constant",
) -> Floats:
    """The guide bends as it warms: pitch grows along the travel and the Abbe offset turns it into a quadratic error."""
    angle = np.deg2rad(arcsec / 3600.0) * session.state(follows, time_constant_min, "angular_growth")
    return np.asarray(abbe_mm * 1e3 * session.at_readings(angle) * session.share**2)


@_effect(follows=DRIVES)
def reversal_drift(
    session: Session, *, um: float = 1.5, time_constant_min: float = 35.0, follows: str = "duty"
) -> Floats:
    """The reversal error changes with the screw's temperature."""
    return np.asarray(
        0.5 * um * session.sign * session.at_readings(session.state(follows, time_constant_min, "reversal_drift"))
    )


@_effect()
def step_event(session: Session, *, um: float = 1.5, at_cycle: int = 30, at_part: float = 0.35) -> Floats:
    """A mount or clamp slips once, `at_part` of the way through a cycle."""
    return um * (session.time_s >= session.start_of(at_cycle) + at_part * session.period_s)


@_effect(shape=SHAPES)
def periodic_disturbance(session: Session, *, um: float = 0.6, period_min: float = 23.0, shape: str = "flat") -> Floats:
    """Cooling or air conditioning switches in a fixed rhythm."""
    phase = stream(session.seed, "periodic_disturbance").uniform(0.0, 2.0 * np.pi)
    return np.asarray(um * np.sin(2 * np.pi * session.time_s / (60.0 * period_min) + phase) * _shape(session, shape))


@_effect(follows=DRIVES)
def pitch_error(
    session: Session, *, um: float = 1.5, lead_mm: float = 7.0, time_constant_min: float = 30.0, follows: str = "duty"
) -> Floats:
    """The cyclic error of the screw grows with the screw's temperature."""
    phase = stream(session.seed, "pitch_error").uniform(0.0, 2.0 * np.pi)
    grown = session.at_readings(session.state(follows, time_constant_min, "pitch_error"))
    return np.asarray(um * grown * np.sin(2 * np.pi * session.position_mm / lead_mm + phase))


@_effect("K", kind=("step", "ramp"))
def camera_offset(session: Session, *, K: float = 0.5, at_cycle: int = 30, kind: str = "step") -> Floats:
    """The camera's zero steps or creeps: every pixel reads high from a cycle on; the machine does not move."""
    since = session.frame_s - session.start_of(at_cycle)
    return np.asarray(
        K
        * np.where(
            since < 0,
            0.0,
            1.0 if kind == "step" else since / max(session.frame_s[-1] - session.start_of(at_cycle), 1.0),
        )
    )


@_effect("K", follows=(*DRIVES, "switched"))
def reflected_source(
    session: Session,
    *,
    K: float = 25.0,
    x_mm: float = 480.0,
    y_mm: float = 60.0,
    spread_mm: float = 45.0,
    follows: str = "switched",
) -> Floats:
    """A lamp or a warm body mirrors in the paint over a part of the table: its radiance temperature over the surroundings, K."""
    if follows == "switched":
        rng = stream(session.seed, "reflected_source")
        return np.asarray(K * session.at_frames(random_levels(session.grid_s, 0.0, 1.0, 45.0, rng, two=True)))
    return np.asarray(K * session.at_frames(session.state(follows, 5.0, "reflected_source")))


@_effect()
def laser_warm_up(
    session: Session, *, ppm: float = 3.0, time_constant_min: float = 12.0, dead_path_mm: float = 60.0
) -> Floats:
    """The laser's wavelength settles during the first minutes; dead path and measured length both see it."""
    return np.asarray(
        -ppm * 1e-3 * (session.position_mm + dead_path_mm) * np.exp(-session.time_s / (60.0 * time_constant_min))
    )


@_effect(sensor=("air_temperature", "air_pressure"), kind=("stuck", "jump"))
def sensor_fault(
    session: Session, *, at_cycle: int = 20, sensor: str = "air_temperature", kind: str = "jump", size: float = 2.0
) -> Floats:
    """A sensor of the laser's environment unit sticks, or jumps by `size` (K or hPa); the compensation believes it."""
    told = told_air(session, at_cycle=at_cycle, sensor=sensor, kind=kind, size=size)
    n_told = refractivity_told(session, told)
    return np.asarray(session.position_mm * 1e3 * session.at_readings(session.refractivity - n_told))


@_effect()
def telegraph_switching(
    session: Session, *, um: float = 1.0, mean_hold_min: float = 40.0, first_target: int = 9, last_target: int = 12
) -> Floats:
    """Outside the library: a few targets jump to and fro between two states on the way back."""
    rng = stream(session.seed, "telegraph_switching")
    state = random_levels(session.grid_s, 0.0, 1.0, mean_hold_min, rng, two=True)
    there = (session.target >= first_target) & (session.target <= last_target) & (session.sign < 0)
    return np.asarray(um * there * (session.at_readings(state) > 0.5))


@_effect()
def travelling_chirp(
    session: Session, *, um: float = 1.0, start_period_min: float = 80.0, end_period_min: float = 20.0
) -> Floats:
    """Outside the library: a wave runs along the axis ever faster, seen on the way out only."""
    f0, f1 = 1.0 / (60.0 * start_period_min), 1.0 / (60.0 * end_period_min)
    turns = f0 * session.time_s + 0.5 * (f1 - f0) / (session.cycles * session.period_s) * session.time_s**2
    return np.asarray(um * (session.sign > 0) * np.sin(2 * np.pi * (turns - session.share)))


@_effect()
def local_creep(
    session: Session, *, um: float = 1.0, centre_mm: float = 110.0, width_mm: float = 45.0, start_min: float = 20.0
) -> Floats:
    """Outside the library: one stretch of the guide creeps with the logarithm of time."""
    bump = np.exp(-0.5 * ((session.position_mm - centre_mm) / width_mm) ** 2)
    return np.asarray(um * bump * np.log1p(session.time_s / (60.0 * start_min)))


@_effect(follows=DRIVES)
def direction_scale(
    session: Session, *, um: float = 2.0, time_constant_min: float = 90.0, follows: str = "constant"
) -> Floats:
    """Outside the library: the scale grows by another amount on the way out than on the way back."""
    return np.asarray(
        0.5
        * um
        * session.sign
        * session.share
        * session.at_readings(session.state(follows, time_constant_min, "direction_scale"))
    )


def told_air(session: Session, *, at_cycle: int, sensor: str, kind: str, size: float) -> tuple[Floats, Floats]:
    """Return air temperature (degC) and pressure (hPa) on the grid as a failing environment unit tells them."""
    late = session.grid_s >= session.start_of(at_cycle)
    true = {"air_temperature": session.air_degC, "air_pressure": session.air_hPa}
    first = int(np.argmax(late))
    told = np.where(late, true[sensor][first] if kind == "stuck" else true[sensor] + size, true[sensor])
    return (told, session.air_hPa) if sensor == "air_temperature" else (session.air_degC, told)


def refractivity_told(session: Session, told: tuple[Floats, Floats]) -> Floats:
    """Return the refractivity that the laser computes from what it is told."""
    return refractivity(told[0], told[1], session.air_percent)


def _index_change(session: Session) -> Floats:
    """Return the change of the index of air since the test's start at every reading."""
    return np.asarray(session.at_readings(session.refractivity) - np.interp(0.0, session.grid_s, session.refractivity))


Anomaly = Callable[[Session, Floats, np.random.Generator, int], Floats]


def structural(session: Session, local_rise_K: Floats, rng: np.random.Generator, at_cycle: int) -> Floats:
    """Loose or worn place: scatter without memory."""
    return rng.standard_normal(session.time_s.size)


def local_temperature(session: Session, local_rise_K: Floats, rng: np.random.Generator, at_cycle: int) -> Floats:
    """The place has a heat source of its own (which the camera sees) and moves with its temperature."""
    return session.at_readings(local_rise_K)


def stick_slip(session: Session, local_rise_K: Floats, rng: np.random.Generator, at_cycle: int) -> Floats:
    """Now and then the axis stops short: heavy tails whose sign is against the approach."""
    n = session.time_s.size
    return np.asarray(-session.sign * rng.exponential(1.0, n) * (rng.uniform(size=n) < 0.25))


def step(session: Session, local_rise_K: Floats, rng: np.random.Generator, at_cycle: int) -> Floats:
    """The place shifts once, at the start of a cycle (0 = half way through the test)."""
    return (session.cycle >= (at_cycle or session.cycles // 2 + 1)).astype(float)


def wander(session: Session, local_rise_K: Floats, rng: np.random.Generator, at_cycle: int) -> Floats:
    """The place moves slowly by itself, with a memory of 40 minutes; no cause that a campaign could show."""
    step_s = session.grid_s[1] - session.grid_s[0]
    return session.at_readings(first_order(rng.standard_normal(session.grid_s.size), step_s, 2400.0))


ANOMALIES: dict[str, Anomaly] = {
    "structural": structural,
    "local_temperature": local_temperature,
    "stick_slip": stick_slip,
    "step": step,
    "wander": wander,
}
