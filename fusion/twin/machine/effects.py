"""Everything that can be wrong with the simulated machine without being declared: effects on all readings, anomalies of one target.

An effect is a function of the session; its keyword arguments are its parameters in RECIPE.toml. It returns one value per reading (um) or,
where only the camera sees it, per frame (K), and the recipe scales it to an rms. Three effects also change what the instruments write:
`camera_offset` and `reflected_source` the frames, `sensor_fault` the environment log. The last four are outside the library of the
analysis: a sound analysis reports them without a name. Formulas and sources: docs/method/effects.md.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fusion._typing import Array
from fusion.twin.machine.air import refractivity
from fusion.twin.machine.session import DRIVES, Session
from fusion.twin.machine.streams import first_order, random_levels, stream

SHAPES = ("flat", "linear")


@dataclass(frozen=True)
class Effect:
    """One effect of the twin's library.

    Attributes
    ----------
    name : str
        Name in RECIPE.toml.
    unit : str
        "um" for an effect on the readings, "K" for one that only the camera sees.
    series : callable
        ``series(session, **parameters)``: (n,) values at the readings, um, or (frames,) values, K.
    parameters : dict
        Default of every parameter.
    choices : dict
        Allowed values of the parameters that are texts.
    """

    name: str
    unit: str
    series: Callable[..., Array]
    parameters: dict[str, Any]
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)


EFFECTS: dict[str, Effect] = {}


def _effect(unit: str = "um", **choices: tuple[str, ...]) -> Callable[[Callable[..., Array]], Callable[..., Array]]:
    """Enter a function of (session, *, parameters) into the library under its own name."""

    def enter(function: Callable[..., Array]) -> Callable[..., Array]:
        signature = inspect.signature(function).parameters
        defaults = {k: p.default for k, p in signature.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}
        EFFECTS[function.__name__] = Effect(function.__name__, unit, function, defaults, choices)
        return function

    return enter


def _pattern(session: Session, shape: str) -> Array:
    """Return the pattern along the axis at every reading: 1 (flat), or position over travel (linear)."""
    return session.share if shape == "linear" else np.ones(session.time_s.size)


def _index_change(session: Session) -> Array:
    """Return the change of the refractive index of air since the start of the test at every reading."""
    return session.at_readings(session.refractivity) - session.at_start(session.refractivity)


@_effect(shape=SHAPES)
def thermal_lag(
    session: Session, *, um_per_K: float = 1.5, time_constant_min: float = 45.0, shape: str = "flat"
) -> Array:
    """Return the error of a remote part that follows the table's mean rise through a first-order lag.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um_per_K : float, um/K
        Sensitivity to the lagged rise.
    time_constant_min : float, min
        Time constant of the part.
    shape : str
        "flat": equal at all positions; "linear": proportional to position.

    Returns
    -------
    (n,) ndarray, um
    """
    lagged = first_order(session.table_rise_K, session.grid_step_s, 60.0 * time_constant_min)
    return um_per_K * session.at_readings(lagged) * _pattern(session, shape)


@_effect(shape=SHAPES, follows=DRIVES)
def unseen_heat_source(
    session: Session, *, um: float = 3.0, time_constant_min: float = 14.0, follows: str = "duty", shape: str = "flat"
) -> Array:
    """Return the error of a part outside the camera's view (spindle, column) that warms with a load.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Error at full load in the steady state.
    time_constant_min : float, min
        Time constant of the part.
    follows : str
        Drive of the part, one of :data:`fusion.twin.machine.session.DRIVES`.
    shape : str
        "flat" or "linear" along the axis.

    Returns
    -------
    (n,) ndarray, um
    """
    state = session.state(follows, time_constant_min, "unseen_heat_source")
    return um * session.at_readings(state) * _pattern(session, shape)


@_effect()
def dead_path(session: Session, *, mm: float = 300.0) -> Array:
    """Return the error of an uncompensated dead path, L dn.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    mm : float, mm
        Length L of the air path between the interferometer and its zero.

    Returns
    -------
    (n,) ndarray, um
    """
    return mm * 1e3 * _index_change(session)


@_effect()
def air_index(session: Session, *, gain: float = 1.0) -> Array:
    """Return the error where the refractive index of air is not compensated along the measured length.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    gain : float
        Uncompensated share of the index's change: 1 for all of it.

    Returns
    -------
    (n,) ndarray, um
    """
    return gain * session.position_mm * 1e3 * _index_change(session)


@_effect()
def material_compensation(session: Session, *, ppm_per_K: float = 2.0) -> Array:
    """Return the error of a material compensation with a wrong expansion coefficient.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    ppm_per_K : float, ppm/K
        Error of the coefficient; it acts on the change of the material sensor's reading since the start of the test.

    Returns
    -------
    (n,) ndarray, um
    """
    probe = session.at_readings(session.probe_degC) - session.at_start(session.probe_degC)
    return ppm_per_K * 1e-3 * session.position_mm * probe


@_effect(follows=DRIVES)
def angular_growth(
    session: Session,
    *,
    arcsec: float = 2.0,
    abbe_mm: float = 150.0,
    time_constant_min: float = 60.0,
    follows: str = "constant",
) -> Array:
    """Return the Abbe error of a guide that bends as it warms, quadratic in position.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    arcsec : float, arcsec
        Pitch at the far end of the travel at full load in the steady state.
    abbe_mm : float, mm
        Abbe offset between the guide and the measured line.
    time_constant_min : float, min
        Time constant of the guide.
    follows : str
        Drive of the guide, one of :data:`fusion.twin.machine.session.DRIVES`.

    Returns
    -------
    (n,) ndarray, um
    """
    angle = np.deg2rad(arcsec / 3600.0) * session.state(follows, time_constant_min, "angular_growth")
    return abbe_mm * 1e3 * session.at_readings(angle) * session.share**2


@_effect(follows=DRIVES)
def reversal_drift(
    session: Session, *, um: float = 1.5, time_constant_min: float = 35.0, follows: str = "duty"
) -> Array:
    """Return the error of a reversal error that changes with the temperature of the screw.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Change of the reversal error at full load in the steady state; half of it acts in each direction.
    time_constant_min : float, min
        Time constant of the screw.
    follows : str
        Drive of the screw, one of :data:`fusion.twin.machine.session.DRIVES`.

    Returns
    -------
    (n,) ndarray, um
    """
    state = session.state(follows, time_constant_min, "reversal_drift")
    return 0.5 * um * session.sign * session.at_readings(state)


@_effect()
def step_event(session: Session, *, um: float = 1.5, at_cycle: int = 30, at_part: float = 0.35) -> Array:
    """Return the error of a mount or clamp that slips once.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Height of the step.
    at_cycle : int
        Cycle in which it happens, from 1.
    at_part : float
        Fraction of that cycle which has passed, 0..1.

    Returns
    -------
    (n,) ndarray, um
    """
    instant = session.start_of(at_cycle) + at_part * session.period_s
    return um * (session.time_s >= instant).astype(float)


@_effect(shape=SHAPES)
def periodic_disturbance(session: Session, *, um: float = 0.6, period_min: float = 23.0, shape: str = "flat") -> Array:
    """Return the error of a cooling or air conditioning that switches periodically, a sine of random phase.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Amplitude.
    period_min : float, min
        Period.
    shape : str
        "flat" or "linear" along the axis.

    Returns
    -------
    (n,) ndarray, um
    """
    phase = stream(session.seed, "periodic_disturbance").uniform(0.0, 2.0 * np.pi)
    return um * np.sin(2 * np.pi * session.time_s / (60.0 * period_min) + phase) * _pattern(session, shape)


@_effect(follows=DRIVES)
def pitch_error(
    session: Session, *, um: float = 1.5, lead_mm: float = 7.0, time_constant_min: float = 30.0, follows: str = "duty"
) -> Array:
    """Return the error of a screw whose cyclic error grows with its temperature.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Growth of the amplitude at full load in the steady state.
    lead_mm : float, mm
        Lead of the screw, the period along the axis; the phase is random.
    time_constant_min : float, min
        Time constant of the screw.
    follows : str
        Drive of the screw, one of :data:`fusion.twin.machine.session.DRIVES`.

    Returns
    -------
    (n,) ndarray, um
    """
    phase = stream(session.seed, "pitch_error").uniform(0.0, 2.0 * np.pi)
    amplitude = um * session.at_readings(session.state(follows, time_constant_min, "pitch_error"))
    return amplitude * np.sin(2 * np.pi * session.position_mm / lead_mm + phase)


@_effect("K", kind=("step", "ramp"))
def camera_offset(session: Session, *, K: float = 0.5, at_cycle: int = 30, kind: str = "step") -> Array:
    """Return the offset of all pixels of a camera whose zero changes while the machine does not move.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    K : float, K
        Offset after the step, or at the end of the ramp.
    at_cycle : int
        Cycle at whose start the offset appears or begins to grow, from 1.
    kind : str
        "step" or "ramp".

    Returns
    -------
    (frames,) ndarray, K
    """
    start = session.start_of(at_cycle)
    since = session.frame_s - start
    course = 1.0 if kind == "step" else since / max(session.frame_s[-1] - start, 1.0)
    return K * np.where(since < 0, 0.0, course)


@_effect("K", follows=(*DRIVES, "switched"))
def reflected_source(
    session: Session,
    *,
    K: float = 25.0,
    x_mm: float = 480.0,
    y_mm: float = 60.0,
    spread_mm: float = 45.0,
    follows: str = "switched",
) -> Array:
    """Return how much warmer than the surroundings a body is that the paint of the table reflects.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    K : float, K
        Radiance temperature of the body over the reflected apparent temperature, when it is on.
    x_mm, y_mm, spread_mm : float, mm
        Centre and standard deviation of the spot on the plan, used by the camera (:mod:`fusion.twin.camera`).
    follows : str
        "switched": on and off at random; else a drive of :data:`fusion.twin.machine.session.DRIVES`.

    Returns
    -------
    (frames,) ndarray, K
    """
    if follows == "switched":
        rng = stream(session.seed, "reflected_source")
        return K * session.at_frames(random_levels(session.grid_s, 0.0, 1.0, 45.0, rng, alternate=True))
    return K * session.at_frames(session.state(follows, 5.0, "reflected_source"))


@_effect()
def laser_warm_up(
    session: Session, *, ppm: float = 3.0, time_constant_min: float = 12.0, dead_path_mm: float = 60.0
) -> Array:
    """Return the error of a laser whose wavelength settles exponentially after it is switched on.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    ppm : float, ppm
        Relative error of the wavelength at the start of the test.
    time_constant_min : float, min
        Time constant of the laser.
    dead_path_mm : float, mm
        Path that the error acts on in addition to the measured length.

    Returns
    -------
    (n,) ndarray, um
    """
    remaining = np.exp(-session.time_s / (60.0 * time_constant_min))
    return -ppm * 1e-3 * (session.position_mm + dead_path_mm) * remaining


@_effect(sensor=("air_temperature", "air_pressure"), kind=("stuck", "jump"))
def sensor_fault(
    session: Session, *, at_cycle: int = 20, sensor: str = "air_temperature", kind: str = "jump", size: float = 2.0
) -> Array:
    """Return the error of an index compensation that uses a faulty sensor of the environment unit.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    at_cycle, sensor, kind, size
        As in :func:`logged_air`.

    Returns
    -------
    (n,) ndarray, um
    """
    temperature, pressure = logged_air(session, at_cycle=at_cycle, sensor=sensor, kind=kind, size=size)
    compensated = refractivity(temperature, pressure, session.air_percent)
    return session.position_mm * 1e3 * session.at_readings(session.refractivity - compensated)


def logged_air(session: Session, *, at_cycle: int, sensor: str, kind: str, size: float) -> tuple[Array, Array]:
    """Return the state of the air as an environment unit with a faulty sensor reports it.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    at_cycle : int
        Cycle at whose start the fault begins, from 1.
    sensor : str
        "air_temperature" or "air_pressure".
    kind : str
        "stuck": the sensor keeps its value; "jump": it reads `size` too high.
    size : float, K or hPa
        Height of the jump.

    Returns
    -------
    tuple of two (m,) ndarray
        Air temperature, degC, and air pressure, hPa, on the grid.
    """
    true = {"air_temperature": session.air_degC, "air_pressure": session.air_hPa}[sensor]
    after = session.grid_s >= session.start_of(at_cycle)
    reported = np.where(after, true[int(np.argmax(after))] if kind == "stuck" else true + size, true)
    return (reported, session.air_hPa) if sensor == "air_temperature" else (session.air_degC, reported)


@_effect()
def telegraph_switching(
    session: Session, *, um: float = 1.0, mean_hold_min: float = 40.0, first_target: int = 9, last_target: int = 12
) -> Array:
    """Return the error of a few targets that alternate between two states in the negative direction.

    Outside the library of the analysis.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Difference of the two states.
    mean_hold_min : float, min
        Mean time in one state.
    first_target, last_target : int
        First and last affected target, from 1.

    Returns
    -------
    (n,) ndarray, um
    """
    rng = stream(session.seed, "telegraph_switching")
    state = random_levels(session.grid_s, 0.0, 1.0, mean_hold_min, rng, alternate=True)
    affected = (session.target >= first_target) & (session.target <= last_target) & (session.sign < 0)
    return um * (affected & (session.at_readings(state) > 0.5)).astype(float)


@_effect()
def travelling_chirp(
    session: Session, *, um: float = 1.0, start_period_min: float = 80.0, end_period_min: float = 20.0
) -> Array:
    """Return the error of a wave along the axis whose frequency rises linearly, in the positive direction only.

    Outside the library of the analysis.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Amplitude.
    start_period_min, end_period_min : float, min
        Period at the start and at the end of the test.

    Returns
    -------
    (n,) ndarray, um
    """
    f0, f1 = 1.0 / (60.0 * start_period_min), 1.0 / (60.0 * end_period_min)
    turns = f0 * session.time_s + 0.5 * (f1 - f0) / (session.cycles * session.period_s) * session.time_s**2
    return um * (session.sign > 0) * np.sin(2 * np.pi * (turns - session.share))


@_effect()
def local_creep(
    session: Session, *, um: float = 1.0, centre_mm: float = 110.0, width_mm: float = 45.0, start_min: float = 20.0
) -> Array:
    """Return the error of one stretch of the guide that creeps with the logarithm of time.

    Outside the library of the analysis.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Creep per natural logarithm of ``1 + t / start_min`` at the centre.
    centre_mm, width_mm : float, mm
        Centre and standard deviation of the stretch along the axis.
    start_min : float, min
        Time scale of the logarithm.

    Returns
    -------
    (n,) ndarray, um
    """
    bump = np.exp(-0.5 * ((session.position_mm - centre_mm) / width_mm) ** 2)
    return um * bump * np.log1p(session.time_s / (60.0 * start_min))


@_effect(follows=DRIVES)
def direction_scale(
    session: Session, *, um: float = 2.0, time_constant_min: float = 90.0, follows: str = "constant"
) -> Array:
    """Return the error of a scale that grows differently in the two directions of approach.

    Outside the library of the analysis.

    Parameters
    ----------
    session : Session
        Readings and states of the test.
    um : float, um
        Difference between the directions at the far end of the travel, at full load in the steady state.
    time_constant_min : float, min
        Time constant of the growth.
    follows : str
        Drive, one of :data:`fusion.twin.machine.session.DRIVES`.

    Returns
    -------
    (n,) ndarray, um
    """
    state = session.state(follows, time_constant_min, "direction_scale")
    return 0.5 * um * session.sign * session.share * session.at_readings(state)


#: Series of an anomaly at all readings (n,), of any size, from the session, the rise (m,) in K of the target by a heat source of its own,
#: a random generator, and the first cycle after a step (0: half-way through the test). The recipe selects target and direction, and scales.
Anomaly = Callable[[Session, Array, np.random.Generator, int], Array]


def _structural(session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return the excess scatter of a loose or worn place: white noise."""
    return rng.standard_normal(session.time_s.size)


def _local_temperature(session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return the motion of a place that follows its own temperature, which the camera sees."""
    return session.at_readings(local_rise_K)


def _stick_slip(session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return the motion of an axis that stops short of the target in a quarter of the approaches, by an exponential amount."""
    n = session.time_s.size
    return -session.sign * rng.exponential(1.0, n) * (rng.uniform(size=n) < 0.25)


def _step(session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return one shift of the place at the start of a cycle."""
    return (session.cycle >= (at_cycle or session.cycles // 2 + 1)).astype(float)


def _wander(session: Session, local_rise_K: Array, rng: np.random.Generator, at_cycle: int) -> Array:
    """Return a slow random motion of the place, white noise through a lag of 40 min, which no measured quantity explains."""
    return session.at_readings(first_order(rng.standard_normal(session.grid_s.size), session.grid_step_s, 2400.0))


ANOMALIES: dict[str, Anomaly] = {
    "structural": _structural,
    "local_temperature": _local_temperature,
    "stick_slip": _stick_slip,
    "step": _step,
    "wander": _wander,
}
