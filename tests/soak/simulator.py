"""A machine of known truth and its measured campaign, by numpy: nothing of the twin, and of the analysis only the names of its variables.

A table of two heat capacities (a hot zone and the whole) is heated by a load; an axis of 16 targets expands with it, shifts with its mean,
and drifts in ways that nobody declares. The camera's fields and the logs are as ideal instruments would hand them over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Array = NDArray[np.float64]
START = np.datetime64("2026-03-09T06:30", "ns")
#: Where the axis lies on the plan of the table (mm), and the size of that plan and of its cells.
ORIGIN_MM, DIRECTION, PLAN_MM, CELL_MM = (40.0, 90.0), (1.0, 0.0), (400.0, 180.0), 20.0
#: Time constants of the hot zone and of the whole table, min, and how far they warm at full load, K.
ZONE_MIN, TABLE_MIN, ZONE_K, TABLE_K = 15.0, 60.0, 3.0, 4.0


def first_order(seconds: Array, source: Array, minutes: float) -> Array:
    """Response (n,) of a heat capacity with a time constant to a source (n,) that is constant between two times."""
    state = np.zeros(source.shape)
    kept = np.exp(-np.diff(seconds) / (60.0 * minutes))
    for number, share in enumerate(kept):
        state[number + 1] = share * state[number] + (1.0 - share) * source[number]
    return state


def constant_load(rng: np.random.Generator, seconds: Array) -> Array:
    return np.ones(seconds.size)


def switched_load(rng: np.random.Generator, seconds: Array) -> Array:
    """Levels between 0 and 1, each held for 25 min on average."""
    changes = rng.random(seconds.size) < np.gradient(seconds) / 1500.0
    return rng.random(int(changes.sum()) + 1)[np.cumsum(changes)]


def staircase_load(rng: np.random.Generator, seconds: Array) -> Array:
    """Four levels up and down again."""
    return np.array([0.25, 0.5, 0.75, 1.0, 0.6, 0.2])[(seconds / seconds[-1] * 5.999).astype(int)]


LOADS = {"constant": constant_load, "staircase": staircase_load, "switched": switched_load}


def walk(rng: np.random.Generator, seconds: Array, um_per_root_hour: float) -> Array:
    steps = (
        rng.standard_normal(seconds.size) * um_per_root_hour * np.sqrt(np.diff(seconds, prepend=seconds[0]) / 3600.0)
    )
    return np.cumsum(steps)


def room(rng: np.random.Generator, seconds: Array, minutes: float = 36.0) -> Array:
    """A room whose temperature forgets itself in some minutes (Ornstein and Uhlenbeck), standard deviation 1."""
    kept = np.exp(-np.diff(seconds) / (60.0 * minutes))
    state = np.empty(seconds.size)
    state[0] = rng.standard_normal()
    for number, share in enumerate(kept):
        state[number + 1] = share * state[number] + np.sqrt(1.0 - share**2) * rng.standard_normal()
    return state


#: Undeclared drift (um) at times (n,) and shares of the travel (n,): what a test of hours may hold.
DRIFTS: dict[str, Callable[[np.random.Generator, Array, Array], Array]] = {
    "none": lambda rng, seconds, share: np.zeros(seconds.size),
    "warm-up": lambda rng, seconds, share: (5.0 + 8.0 * share) * (1.0 - np.exp(-seconds / 4500.0)),
    "random walk": lambda rng, seconds, share: walk(rng, seconds, 1.2) + share * walk(rng, seconds, 0.8),
    "room": lambda rng, seconds, share: 1.0 * room(rng, seconds) + share * room(rng, seconds),
    "switched": lambda rng, seconds, share: (
        3.0 * (1.0 + share) * first_order(seconds, switched_load(rng, seconds), 30.0)
    ),
    "hot zone": lambda rng, seconds, share: (
        (2.0 + 6.0 / (1.0 + np.exp(-(share - 0.5) * 300.0 / 24.0))) * (1.0 - np.exp(-seconds / 4500.0))
    ),
}


def autoregressive(rng: np.random.Generator, shape: tuple[int, ...], memory: float) -> Array:
    """Noise of standard deviation 1 that keeps a share of itself from one value along the first axis to the next."""
    noise = rng.standard_normal(shape)
    for place in range(1, noise.shape[0]):
        noise[place] = memory * noise[place - 1] + np.sqrt(1.0 - memory**2) * noise[place]
    return noise


#: Reading noise (cycle, approach, order within the pass) of standard deviation 1.
NOISES: dict[str, Callable[[np.random.Generator, tuple[int, int, int]], Array]] = {
    "white": lambda rng, shape: rng.standard_normal(shape),
    "Laplace": lambda rng, shape: rng.laplace(0.0, np.sqrt(0.5), shape),
    # In the order of the readings, which are as far apart in time at a turn as within a pass.
    "memory .3": lambda rng, shape: autoregressive(rng, (math.prod(shape),), 0.3).reshape(shape),
    "memory .6": lambda rng, shape: autoregressive(rng, (math.prod(shape),), 0.6).reshape(shape),
    "memory over cycles": lambda rng, shape: autoregressive(rng, shape, 0.5),
}


@dataclass(frozen=True)
class Machine:
    """An axis, what it stands on, and how it is measured.

    Attributes
    ----------
    noise, drift, load : names out of `NOISES`, `DRIFTS` and `LOADS`
    noise_um : standard deviation of a reading
    unequal : how much the noise differs between sites, as the standard deviation of its logarithm
    growing : by what share of itself the noise grows from the first cycle to the last
    expansion_ppm_per_K, shift_um_per_K : what the axis does as its table warms
    zone_height_mm : extent of the hot zone across the axis; infinite where the camera's cells need not resolve it
    walk_um_per_root_h : further undeclared walk of all targets, two thirds of it as a stretch besides
    """

    cycles: int = 40
    targets: int = 16
    spacing_mm: float = 20.0
    cycle_s: float = 252.0
    noise: str = "white"
    noise_um: float = 0.4
    unequal: float = 0.0
    growing: float = 0.0
    drift: str = "none"
    load: str = "switched"
    expansion_ppm_per_K: float = 11.7
    shift_um_per_K: float = 2.5
    profile_um: float = 4.0
    reversal_um: float = 1.5
    zone_height_mm: float = 60.0
    walk_um_per_root_h: float = 0.0


@dataclass(frozen=True)
class Campaign:
    """A measured campaign beside its truth; arrays (cycle, approach, target) unless said otherwise.

    Attributes
    ----------
    profile_um : (approach, target), without any drift
    drift_um, noise_um : drift (declared effects included) and noise of every reading
    scatter_um : (approach, target), standard deviation of the noise over the test
    undeclared_um : the part of the drift that no declared effect holds
    table_K : (frame,), mean rise of the table, K
    """

    deviations: xr.Dataset
    fields: xr.Dataset
    environment: xr.Dataset
    drivers: xr.Dataset
    seconds: Array
    profile_um: Array
    drift_um: Array
    undeclared_um: Array
    noise_um: Array
    scatter_um: Array
    table_K: Array


def times_s(machine: Machine) -> Array:
    """Times of readings (cycle, approach, target), s: a cycle goes forth and back at an even pace."""
    pace = machine.cycle_s / (2.0 * machine.targets)
    forth = pace * np.arange(machine.targets)
    back = pace * (2 * machine.targets - 1 - np.arange(machine.targets))
    return machine.cycle_s * np.arange(machine.cycles)[:, None, None] + np.stack([forth, back])


def readings_noise(machine: Machine, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the noise of every reading (um) and its standard deviation over the test at every site (um)."""
    noise = NOISES[machine.noise](rng, (machine.cycles, 2, machine.targets))
    # The second approach meets the targets in the opposite order.
    noise[:, 1] = noise[:, 1, ::-1]
    sigma = machine.noise_um * np.exp(machine.unequal * rng.standard_normal((2, machine.targets)))
    growth = 1.0 + machine.growing * np.linspace(0.0, 1.0, machine.cycles)
    return noise * sigma * growth[:, None, None], sigma * np.sqrt(np.mean(growth**2))


def measure(machine: Machine, rng: np.random.Generator) -> Campaign:
    """Measure a machine: random profile, load, drift and noise."""
    seconds = times_s(machine)
    position = machine.spacing_mm * np.arange(machine.targets)
    share = position / position[-1]
    profile = machine.profile_um * (share + 0.3 * np.sin(2.0 * np.pi * (share + rng.random())))
    profile = np.stack([profile + machine.reversal_um / 2.0, profile - machine.reversal_um / 2.0])

    frame_s = np.arange(0.0, seconds.max() + machine.cycle_s, machine.cycle_s / 2.0)
    load = LOADS[machine.load](rng, frame_s)
    zone, table = (first_order(frame_s, load, minutes) for minutes in (ZONE_MIN, TABLE_MIN))
    y, x = (np.arange(CELL_MM / 2.0, size, CELL_MM) for size in PLAN_MM[::-1])
    near = np.exp(-(((x - 260.0) / 80.0) ** 2) - ((y[:, None] - 90.0) / machine.zone_height_mm) ** 2)
    rise = TABLE_K * table[:, None, None] + ZONE_K * zone[:, None, None] * near
    temperature = 21.0 + rise + 0.02 * rng.standard_normal(rise.shape)

    order = np.argsort(seconds, axis=None)
    at, where = seconds.ravel()[order], np.broadcast_to(share, seconds.shape).ravel()[order]
    undeclared = np.empty(seconds.size)
    undeclared[order] = DRIFTS[machine.drift](rng, at, where)
    if rate := machine.walk_um_per_root_h:
        undeclared[order] += walk(rng, at, rate) + where * walk(rng, at, 2.0 * rate / 3.0)
    undeclared = undeclared.reshape(seconds.shape)
    mean_K, integral = rise.mean(axis=(1, 2)), _integral(rise, x, y, position)
    shift = machine.shift_um_per_K * np.interp(seconds, frame_s, mean_K)
    expansion = np.empty(seconds.shape)
    for target in range(machine.targets):
        expansion[..., target] = np.interp(seconds[..., target], frame_s, integral[:, target])
    declared = shift + 1e-3 * machine.expansion_ppm_per_K * expansion
    noise, sigma = readings_noise(machine, rng)
    deviation = profile + declared + undeclared + noise
    return Campaign(
        deviations_of(seconds, position, deviation),
        fields_of(frame_s, x, y, temperature),
        xr.Dataset(
            {
                "air_temperature": ("time", np.full(frame_s.size, 21.0), {"units": "degC"}),
                "material_temperature": ("time", 21.0 + mean_K, {"units": "degC"}),
            },
            {"time": clock(frame_s)},
        ),
        xr.Dataset({"duty": ("time", load, {"units": "1"})}, {"time": clock(frame_s)}),
        seconds,
        profile,
        declared + undeclared,
        undeclared,
        noise,
        sigma,
        mean_K,
    )


def _integral(rise: Array, x: Array, y: Array, position: Array) -> Array:
    """Integral (frame, target), K mm, of the rise along the axis from its position 0, trapezoids of 2 mm between centres of cells."""
    row = int(np.argmin(abs(y - ORIGIN_MM[1])))
    fine = np.arange(0.0, position[-1] + 1.0, 2.0)
    line = np.array([np.interp(ORIGIN_MM[0] + fine, x, one) for one in rise[:, row]])
    total = np.concatenate([np.zeros((len(rise), 1)), np.cumsum((line[:, 1:] + line[:, :-1]), axis=1)], axis=1)
    return np.array([np.interp(position, fine, one) for one in total])


def clock(seconds: Array) -> NDArray[np.datetime64]:
    return START + np.round(1e9 * seconds).astype("timedelta64[ns]")


def deviations_of(seconds: Array, position_mm: Array, deviation_um: Array) -> xr.Dataset:
    """Readings (cycle, approach, target) as the laser's reader hands them over; NaN where one is missing."""
    dims, cycles, _, targets = ("cycle", "direction", "target"), *deviation_um.shape
    missing = np.isnan(deviation_um)
    time = np.where(missing, np.datetime64("NaT"), clock(seconds))
    return xr.Dataset(
        {
            "deviation": (dims, deviation_um, {"units": "um"}),
            "time": (dims, time, {"origin": "recorded"}),
            "position": ("target", position_mm, {"units": "mm"}),
            "quality_flag": (dims, missing.astype(np.uint8), {"units": "1"}),
            "resolution": ((), 0.0, {"units": "um"}),
        },
        {
            "cycle": np.arange(1, cycles + 1),
            "direction": ["positive", "negative"],
            "target": np.arange(1, targets + 1),
        },
    )


def fields_of(frame_s: Array, x: Array, y: Array, temperature: Array) -> xr.Dataset:
    """Temperature fields (time, y, x), degC, one frame for every time."""
    return xr.Dataset(
        {"frame_temperature": (("time", "y", "x"), temperature, {"units": "degC"})},
        {"time": clock(frame_s), "y": ("y", y, {"units": "mm"}), "x": ("x", x, {"units": "mm"})},
    )


# Records of a machine: sensors on its parts, in the ground and at heaters, displacements that follow them, and what goes wrong with either.


@dataclass
class Sensors:
    """A record of known truth: samples (time,), temperatures (time, sensor), displacements (time, channel), a load or none, set points.

    ``regulated`` are the sensors at heaters; the set point of the k-th is the k-th of ``set_points`` where they are logged.
    """

    seconds: Array
    temperature: Array
    displacement: Array
    load: Array | None
    regulated: list[int]
    set_points: Array | None


def heater(rng: np.random.Generator, seconds: Array) -> tuple[Array, Array]:
    """Temperature (n,) of a part that is regulated, with overshoot and ripple, and its set point (n,): degC, 0 is off."""
    high, start = rng.choice([50.0, 70.0, 110.0, 180.0, 220.0, 260.0, 350.0]), rng.uniform(18.0, 30.0)
    changes = np.sort(rng.uniform(0.05, 0.95, int(rng.integers(1, 4)))) * seconds[-1]
    levels = np.array([0.0, high, 0.0 if rng.random() < 0.5 else round(0.8 * high), high])
    target = levels[np.searchsorted(changes, seconds, side="right")]
    rise_K_per_s, fall_s = rng.uniform(0.2, 8.0), rng.uniform(200.0, 1800.0)
    measured, previous, since, overshoot = np.empty(seconds.size), 0.0, 0.0, rng.uniform(0.0, 0.03)
    value = start
    for n, now in enumerate(seconds):
        step = now - seconds[n - 1] if n else 0.0
        wanted = max(target[n], start)
        if target[n] != previous:
            previous, since = target[n], now
        cooled = wanted + (value - wanted) * np.exp(-step / fall_s)
        value = min(wanted, value + rise_K_per_s * step) if value < wanted else cooled
        ring = overshoot * (wanted - start) * np.exp(-(now - since) / 120.0) * np.sin((now - since) / 40.0)
        measured[n] = value + (ring if target[n] > 0.0 else 0.0)
    return measured, target


def simulated_sensors(rng: np.random.Generator) -> Sensors:
    """3 to 12 sensors and 1 to 3 displacements, sampled every 2 s to 20 min for 300 to 3000 samples, rounded as loggers do."""
    size, step = int(rng.integers(300, 3000)), float(rng.choice([2.0, 10.0, 60.0, 300.0, 1200.0]))
    seconds, sensors = step * np.arange(size), int(rng.integers(3, 13))
    hours = seconds[-1] / 3600.0
    minutes = 60.0 * hours * rng.uniform(0.01, 0.1)
    dwells = np.repeat(
        np.where(rng.random(40) < 0.6, rng.random(40), 0.0), int(rng.integers(size // 40, size // 6) + 1)
    )
    load = dwells[:size] if rng.random() < 0.8 else np.zeros(size)
    day = 2.0 * np.sin(2.0 * np.pi * (seconds / 86400.0 + rng.random())) + rng.uniform(0.2, 1.5) * room(
        rng, seconds, 3.0 * minutes
    )
    columns, rises, regulated, targets = [], [], [], []
    for k in range(sensors):
        kind = rng.choice(["part", "air", "ground", "heater"], p=[0.55, 0.2, 0.1, 0.15])
        if kind == "heater" and len(regulated) < 2:
            true, target = heater(rng, seconds)
            regulated.append(k)
            targets.append(target)
        elif kind == "ground":
            true = (
                12.0
                + 0.05 * first_order(seconds, day, 20.0 * minutes)
                + 0.2 * hours / 100.0 * np.sin(seconds / seconds[-1] * 2.0)
            )
        elif kind == "air":
            true = 20.0 + day + 0.05 * room(rng, seconds, minutes)
        else:
            warmed = first_order(seconds, load, minutes * rng.uniform(0.3, 4.0))
            true = 20.0 + rng.choice([3.0, 10.0, 40.0]) * rng.random() * warmed + first_order(seconds, day, minutes)
        rises.append(true - true[0])
        held = int(rng.choice([1, 1, 1, 5]))
        noisy = true + rng.choice([0.0, 0.01, 0.05, 0.2]) * rng.standard_normal(size)
        digits = rng.choice([0.001, 0.01, 0.1, 0.5])
        columns.append(np.round(np.repeat(noisy[::held], held)[:size] / digits) * digits)
    shares = rng.normal(0.0, 1.0, (sensors, int(rng.integers(1, 4)))) * (rng.random((sensors, 1)) < 0.5)
    scale = np.array([max(float(np.ptp(one)), 0.1) for one in rises])
    late = np.column_stack([first_order(seconds, one, minutes * rng.uniform(0.05, 0.5)) for one in rises])
    displacement = (late / scale) @ (20.0 * shares)
    displacement += 0.3 * rng.standard_normal(displacement.shape) + np.cumsum(
        0.02 * rng.standard_normal(displacement.shape), axis=0
    )
    logged = rng.random() < 0.5
    return Sensors(
        seconds,
        np.column_stack(columns),
        np.round(displacement, 2),
        load if rng.random() < 0.5 else None,
        regulated,
        np.column_stack(targets) if targets and logged else None,
    )


def spoil_sensor(rng: np.random.Generator, kind: str, seconds: Array, values: Array) -> NDArray[np.bool_]:
    """Spoil the readings (n,) of a sensor in place; returns which are none of its own."""
    size = values.size
    first, bad = int(rng.uniform(0.2, 0.75) * size), np.zeros(size, bool)
    if kind == "stuck":
        bad[first + 1 :] = True
        values[bad] = values[first]
    elif kind == "railed":
        bad[first:] = True
        values[bad] = rng.choice([850.0, -200.0, -242.0, 1372.0, 3276.7, -127.0, 0.0])
    elif kind == "open":
        bad[first:] = True
        values[bad] = np.round(300.0 + 200.0 * rng.standard_normal(int(bad.sum())), 1)
    elif kind == "erratic":
        bad[first : first + max(20, int(rng.uniform(0.03, 0.15) * size))] = True
        values[bad] += np.round(rng.choice([20.0, 60.0]) * rng.standard_normal(int(bad.sum())), 2)
    elif kind == "bursts":
        for place in rng.choice(size // 20 - 2, 3, replace=False):
            bad[20 * place + 20 : 20 * place + 20 + int(rng.integers(1, 5))] = True
        values[bad] = rng.choice([-127.0, 850.0, 0.0, 85.0])
    elif kind == "drifting":
        bad[first:] = True
        values[first:] += 15.0 * (seconds[first:] - seconds[first]) / (seconds[-1] - seconds[first])
    else:
        bad[first:] = True
        values[bad] += rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 20.0)
    return bad


def spoil_displacement(rng: np.random.Generator, kind: str, values: Array) -> NDArray[np.bool_]:
    """Spoil the readings (n,) of a displacement in place; returns which are none of its own."""
    size, bad, span = values.size, np.zeros(values.size, bool), max(float(np.ptp(values)), 20.0)
    if kind == "bursts":
        for place in rng.choice(size // 20 - 2, 3, replace=False):
            bad[20 * place + 20 : 20 * place + 20 + int(rng.integers(1, 5))] = True
        values[bad] += rng.choice([-1.0, 1.0]) * span * rng.uniform(1.5, 4.0, int(bad.sum()))
    else:
        first = int(rng.uniform(0.1, 0.8) * size)
        bad[first : first + max(20, int(rng.uniform(0.01, 0.08) * size))] = True
        moved = rng.uniform(0.3, 1.0, int(bad.sum())) * (rng.random(int(bad.sum())) < 0.8)
        values[bad] -= 2.0 * span * moved
        # What is put back is no reading of an erratic time, first and last are.
        values[np.flatnonzero(bad)[[0, -1]]] -= span
    return bad
