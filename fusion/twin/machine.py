"""Heat conduction in the table: a plate with local sources and convection, solved by cosine modes, exact in time.

The plate (thickness d, no temperature difference over it, insulated edges) obeys rho c d dT/dt = k d lap(T) - h (T - T_air) + q(x, y, t).
cos(m pi x / W) cos(n pi y / H) are its eigenfunctions, so every mode is one first-order equation whose step is exact for a power
that is constant over the step (Carslaw and Jaeger, Conduction of Heat in Solids, 1959, section 5.6). The
field has no grid: it can be evaluated anywhere.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from fusion.common import Array
from fusion.twin.recipe import Duty, Plan, RecipeError, Room, Source, Table, Test

# Random streams by name, piecewise constant loads, and the exact response of a first-order lag.


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random generator that belongs to a name, so that adding one random series changes no other series."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def random_levels(
    time_s: Array, low: float, high: float, mean_hold_min: float, rng: np.random.Generator, *, alternate: bool = False
) -> Array:
    """Return a piecewise constant load whose level changes at random times."""
    level = np.empty(time_s.size)
    now, high_next = time_s[0], bool(rng.integers(2))
    while now <= time_s[-1]:
        until = now + 60.0 * mean_hold_min * rng.uniform(0.4, 1.6)
        value = (high if high_next else low) if alternate else rng.uniform(low, high)
        level[(time_s >= now) & (time_s < until)] = value
        now, high_next = until, not high_next
    return level


def switched_levels(
    time_s: Array, levels: tuple[float, float], holds_s: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Return a load that alternates between two levels with a minimum hold plus an exponentially distributed one."""
    level = np.empty(time_s.size)
    now, state = time_s[0], int(rng.integers(2))
    while now <= time_s[-1]:
        until = now + holds_s[0] + rng.exponential(holds_s[1])
        level[(time_s >= now) & (time_s < until)] = levels[state]
        now, state = until, 1 - state
    return level


def first_order(drive: Array, step_s: float, time_constant_s: float) -> Array:
    """Return the response of a body with one time constant, tau dx/dt = drive - x, to a sampled drive."""
    decay = np.exp(-step_s / time_constant_s)
    return np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], drive))


# Air around the simulated machine: temperature, pressure, humidity and the refractive index at the laser's
# wavelength.

#: Vacuum wavelength of the helium-neon laser, um.
WAVELENGTH_UM = 0.6329908


@dataclass(frozen=True)
class Air:
    """True state of the air on the simulation's time grid, (m,) each."""

    temperature_degC: Array
    pressure_hPa: Array
    humidity_percent: Array

    @property
    def index(self) -> Array:
        """Refractive index minus 1 at the laser's wavelength, (m,)."""
        return refractivity(self.temperature_degC, self.pressure_hPa, self.humidity_percent)


def simulate_air(room: Room, grid_s: Array, seed: int) -> Air:
    """Simulate the air: a linear trend and a sinusoidal swing of the temperature, and random walks of temperature and pressure."""
    hours = grid_s / 3600.0
    rng = stream(seed, "air")
    swing = room.swing_K * np.sin(2 * np.pi * (hours * 60.0 / room.swing_period_min + rng.uniform()))
    temperature_walk = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    pressure_walk = np.cumsum(rng.standard_normal(grid_s.size)) * np.sqrt(hours[1] - hours[0])
    temperature = room.temperature_degC + room.trend_K_per_h * hours + swing + 0.05 * temperature_walk
    pressure = room.pressure_hPa + room.pressure_walk_hPa_per_sqrt_h * pressure_walk
    humidity = room.humidity_percent - 1.5 * (temperature - room.temperature_degC)
    return Air(temperature, pressure, np.clip(humidity, 1.0, 99.0))


def refractivity(temperature_degC: Array, pressure_hPa: Array, humidity_percent: Array) -> Array:
    """Return the refractivity n - 1 of moist air at the laser's wavelength by the modified Edlen equation."""
    wave = 1.0 / WAVELENGTH_UM**2
    standard = (8342.54 + 2406147.0 / (130.0 - wave) + 15998.0 / (38.9 - wave)) * 1e-8
    pascal = 100.0 * np.asarray(pressure_hPa, dtype=float)
    t = np.asarray(temperature_degC, dtype=float)
    dry = standard * pascal / 96095.43 * (1.0 + 1e-8 * (0.601 - 0.00972 * t) * pascal) / (1.0 + 0.0036610 * t)
    vapour = np.asarray(humidity_percent, dtype=float) / 100.0 * 611.2 * np.exp(17.62 * t / (243.12 + t))
    return np.asarray(dry - vapour * (3.7345 - 0.0401 * wave) * 1e-10)


#: Numbers of modes along and across the table; the shortest wave of the default table is 22 mm along it.
MODES_X = 64
MODES_Y = 20


@dataclass(frozen=True)
class Plate:
    """Temperature rise of the plate, K: amplitudes (m, MODES_X * MODES_Y) of its modes at evenly spaced times; the first is the mean."""

    plan: Plan
    grid_s: Array
    amplitudes: Array

    def field(self, time_s: Array, x_mm: Array, y_mm: Array, *, cell_mm: float = 0.0) -> Array:
        """Return the temperature rise on a rectangular grid of plan points."""
        modes = self._amplitudes_at(time_s).reshape(-1, MODES_X, MODES_Y)
        along, across = (
            _cosines(points, length, count) * np.sinc(np.arange(count) * cell_mm / (2 * length))
            for points, length, count in ((x_mm, self.plan.width_mm, MODES_X), (y_mm, self.plan.height_mm, MODES_Y))
        )
        return np.asarray(np.matmul(np.matmul(across, modes.transpose(0, 2, 1)), along.T))

    def mean(self) -> Array:
        """Return the mean rise of the whole table at every grid time, (m,), K."""
        return self.amplitudes[:, 0]

    def points(self, x_mm: Array, y_mm: Array) -> Array:
        """Return the rise (m, n) in K at n plan points of coordinates (n,), mm, at every grid time."""
        along = _cosines(x_mm, self.plan.width_mm, MODES_X)
        across = _cosines(y_mm, self.plan.height_mm, MODES_Y)
        return np.asarray(self.amplitudes @ (along[:, :, None] * across[:, None, :]).reshape(len(along), -1).T)

    def line_integrals(self, length_mm: Array) -> Array:
        """Return the integrals (m, n) in K mm of the rise along the measured line, from its origin to each length (n,), mm."""
        return np.asarray(self.amplitudes @ _line_weights(self.plan, np.asarray(length_mm, dtype=float)).T)

    def _amplitudes_at(self, time_s: Array) -> Array:
        """Return the amplitudes (t, modes) at the given times, linear between grid times."""
        step = self.grid_s[1] - self.grid_s[0]
        place = np.clip((np.asarray(time_s) - self.grid_s[0]) / step, 0, self.grid_s.size - 1)
        low = np.minimum(place.astype(int), self.grid_s.size - 2)
        part = (place - low)[:, None]
        return np.asarray((1.0 - part) * self.amplitudes[low] + part * self.amplitudes[low + 1])


def solve_plate(
    plan: Plan, table: Table, sources: tuple[Source, ...], power: Array, air_rise: Array, grid_s: Array
) -> Plate:
    """Solve the heat equation of the plate for the given powers."""
    capacity = table.density_kg_per_m3 * table.heat_capacity_J_per_kgK * table.thickness_mm * 1e-3
    wave_x = np.arange(MODES_X) * np.pi / (plan.width_mm * 1e-3)
    wave_y = np.arange(MODES_Y) * np.pi / (plan.height_mm * 1e-3)
    conduction = table.conductivity_W_per_mK * table.thickness_mm * 1e-3
    rate = ((conduction * (wave_x[:, None] ** 2 + wave_y**2) + table.convection_W_per_m2K) / capacity).ravel()
    area = plan.width_mm * plan.height_mm * 1e-6
    heating = np.zeros((grid_s.size, rate.size))
    if sources:
        heating = power @ np.stack([_footprint(plan, s) for s in sources]) / (capacity * area)
    heating[:, 0] += table.convection_W_per_m2K * air_rise / capacity
    step_s = grid_s[1] - grid_s[0]
    decay = np.exp(-rate * step_s)
    gain = -np.expm1(-rate * step_s) / rate
    amplitudes = np.zeros((grid_s.size, rate.size))
    for step in range(grid_s.size - 1):
        amplitudes[step + 1] = decay * amplitudes[step] + gain * heating[step]
    return Plate(plan, grid_s, amplitudes)


def _cosines(points_mm: Array, length_mm: float, count: int) -> Array:
    """Return cos(m pi x / L), (points, modes)."""
    points = np.asarray(points_mm, dtype=float)
    return np.asarray(np.cos(np.multiply.outer(points, np.arange(count) * np.pi / length_mm)))


def _footprint(plan: Plan, source: Source) -> Array:
    """Return the modes (flat) of a Gaussian footprint whose mean over the plate is 1."""
    modes = []
    for centre, spread, length, count in (
        (source.x_mm, source.spread_x_mm, plan.width_mm, MODES_X),
        (source.y_mm, source.spread_y_mm, plan.height_mm, MODES_Y),
    ):
        points = (np.arange(4 * int(length)) + 0.5) * length / (4 * int(length))
        weight = np.exp(-0.5 * ((points - centre) / spread) ** 2)
        weight /= weight.sum()
        modes.append(weight @ _cosines(points, length, count) * np.where(np.arange(count) == 0, 1.0, 2.0))
    return np.multiply.outer(*modes).ravel()


def _line_weights(plan: Plan, length_mm: Array) -> Array:
    """Return the integrals (length, modes) of every mode along the measured line, by the product-to-sum rule."""
    wave_x = np.arange(MODES_X)[:, None] * np.pi / plan.width_mm
    wave_y = np.arange(MODES_Y)[None, :] * np.pi / plan.height_mm
    total = np.zeros((length_mm.size, MODES_X, MODES_Y))
    for side in (1.0, -1.0):
        phase = wave_x * plan.origin_mm[0] + side * wave_y * plan.origin_mm[1]
        slope = wave_x * plan.direction[0] + side * wave_y * plan.direction[1]
        half = 0.5 * slope * length_mm[:, None, None]
        total += 0.5 * length_mm[:, None, None] * np.cos(phase + half) * np.sinc(half / np.pi)
    return total.reshape(length_mm.size, -1)


# Timing of the test: when every reading is taken, where the table is at any time, and how hard the machine works.


@dataclass(frozen=True)
class ReadingSequence:
    """The readings (n,) of a test in the order in which they are taken.

    Times count from the start of the test, cycles and targets from 1; ``sign`` is 1 for a positive approach, -1 for a negative one.
    """

    time_s: Array
    cycle: NDArray[np.int64]
    sign: NDArray[np.int64]
    target: NDArray[np.int64]
    position_mm: Array
    cycles: int
    period_s: float

    @property
    def duration_s(self) -> float:
        """Duration of the test, s."""
        return self.period_s * self.cycles

    def start_of(self, cycle: int) -> float:
        """Return the time (s) at which a cycle, counted from 1, starts."""
        return (cycle - 1) * self.period_s


@dataclass(frozen=True)
class Schedule(ReadingSequence):
    """The readings of a positioning test and the motion of its table, linear between the corners ``way_s``, ``way_mm``."""

    positions_mm: Array
    way_s: Array
    way_mm: Array

    @property
    def last_reading_s(self) -> float:
        """Time of a cycle's last reading after the start of that cycle, s."""
        return float(self.time_s[self.cycle == 1][-1])

    def table_position(self, time_s: Array) -> Array:
        """Return the axis position (mm) at the given times (s)."""
        return np.interp(time_s, self.way_s, self.way_mm)


def make_schedule(test: Test, seed: int) -> Schedule:
    """Lay out the readings of a bidirectional test in time."""
    positions = _target_positions(test, seed)
    feed = test.feed_mm_per_min / 60.0
    arrive = positions[0] / feed + np.concatenate([[0.0], np.cumsum(np.diff(positions) / feed + test.dwell_s)])
    forward = arrive + test.dwell_s
    turn = forward[-1] + test.reversal_s - test.dwell_s
    back_arrive = turn + np.concatenate([[0.0], np.cumsum(np.diff(positions)[::-1] / feed + test.dwell_s)])
    backward = back_arrive + test.dwell_s
    home = backward[-1] + positions[0] / feed
    if home >= test.period_s:
        raise RecipeError(
            f"test.period_s = {test.period_s} is shorter than one cycle, {home:.1f} s; raise it or the feed"
        )
    way_s = np.concatenate(
        [[0.0], np.stack([arrive, forward], 1).ravel(), np.stack([back_arrive, backward], 1).ravel(), [home]]
    )
    way_mm = np.concatenate([[0.0], np.repeat(positions, 2), np.repeat(positions[::-1], 2), [0.0]])
    start = np.arange(test.cycles) * test.period_s
    per_cycle = np.concatenate([forward, backward])
    there_and_back = np.concatenate([np.arange(positions.size), np.arange(positions.size)[::-1]])
    return Schedule(
        time_s=(start[:, None] + per_cycle).ravel(),
        cycle=np.repeat(np.arange(1, test.cycles + 1), per_cycle.size),
        sign=np.tile(np.repeat([1, -1], positions.size), test.cycles),
        target=np.tile(there_and_back + 1, test.cycles),
        position_mm=np.tile(positions[there_and_back], test.cycles),
        cycles=test.cycles,
        period_s=test.period_s,
        positions_mm=positions,
        way_s=(start[:, None] + way_s).ravel(),
        way_mm=np.tile(way_mm, test.cycles),
    )


def _target_positions(test: Test, seed: int) -> Array:
    """Return the target positions, mm: as listed, or evenly spaced with random offsets of all but the first and the last."""
    positions = np.array(test.positions_mm or np.arange(test.targets) * test.spacing_mm, dtype=float)
    if not test.positions_mm and test.jitter_mm > 0:
        rng, jitter_mm = stream(seed, "target positions"), test.jitter_mm
        positions[1:-1] += rng.uniform(-jitter_mm, jitter_mm, positions.size - 2).round(3)
    if np.any(np.diff(positions) <= 0):
        raise RecipeError("test: the target positions do not increase; sort test.positions_mm or lower test.jitter_mm")
    return positions


def duty_levels(duty: Duty, time_s: Array, seed: int) -> Array:
    """Return the machine's load over time."""
    if duty.kind == "constant":
        return np.full(time_s.size, duty.high)
    if duty.kind == "randomised":
        holds = (60.0 * duty.least_hold_min, 60.0 * (duty.mean_hold_min - duty.least_hold_min))
        return switched_levels(time_s, (duty.low, duty.high), holds, stream(seed, "duty"))
    law = (duty.low, duty.high, duty.mean_hold_min, stream(seed, "duty"))
    return random_levels(time_s, *law, alternate=duty.kind == "switched")


# What the effects of the twin act on: the readings of a test, and the states of machine and room behind them.

#: What a body can follow: the logged load, a load that is not logged, a warm-up from the start, or the table's mean rise.
Drive = Literal["duty", "own", "constant", "table"]
#: Time constant of the part through which heat reaches a body, as a fraction of the body's own.
INNER_PART = 0.15


@dataclass(frozen=True)
class Session(ReadingSequence):
    """Readings of a test with the states behind them, on an evenly spaced time grid (m,) that begins before the test with a pre-heat.

    The test starts at 0 s; ``duty`` is 0..1; ``table_rise_K`` counts from the start of the test; ``probe_degC`` is what the material
    temperature sensor shows; ``refractivity`` is the refractive index of the air minus 1.
    """

    seed: int
    travel_mm: float
    grid_s: Array
    duty: Array
    table_rise_K: Array
    probe_degC: Array
    air_degC: Array
    air_hPa: Array
    air_percent: Array
    refractivity: Array
    frame_s: Array

    @property
    def share(self) -> Array:
        """Position of every reading as a fraction of the travel, (n,), 0..1."""
        return self.position_mm / self.travel_mm

    @property
    def grid_step_s(self) -> float:
        """Step of the time grid, s."""
        return float(self.grid_s[1] - self.grid_s[0])

    def at_readings(self, series: Array) -> Array:
        """Return a series on the grid (m,) at the times of the readings (n,), by linear interpolation."""
        return np.interp(self.time_s, self.grid_s, series)

    def at_frames(self, series: Array) -> Array:
        """Return a series on the grid (m,) at the times of the frames, by linear interpolation."""
        return np.interp(self.frame_s, self.grid_s, series)

    def at_start(self, series: Array) -> float:
        """Return the value of a series on the grid (m,) at the start of the test."""
        return float(np.interp(0.0, self.grid_s, series))

    def state(self, follows: Drive, time_constant_min: float, name: str) -> Array:
        """Return the state of a body that follows a drive with its own time constant."""
        rng = stream(self.seed, f"own drive of {name}")
        drive = {
            "duty": lambda: self.duty,
            "own": lambda: random_levels(self.grid_s, 0.0, 1.0, 30.0, rng),
            "constant": lambda: (self.grid_s >= 0).astype(float),
            "table": lambda: self.table_rise_K,
        }[follows]()
        inner = first_order(drive, self.grid_step_s, 60.0 * INNER_PART * time_constant_min)
        body = first_order(inner, self.grid_step_s, 60.0 * time_constant_min)
        return body - self.at_start(body)
