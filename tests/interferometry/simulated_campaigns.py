"""Positioning tests of known truth: 16 targets, 300 mm, 300 mm/min, 2 s dwell, 100 cycles in 7 h."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from interferometry.deviations import build_deviations

TARGETS = 16
CYCLE_S = 252.0
STEP_S = 6.0
TURN_S = 8.0
SIGMA_UM = 0.4
START = np.datetime64("2026-03-09T06:30:00", "ns")
#: Time constants of the three heat sources in minutes, and what each adds to shift and stretch in um.
SOURCES = ((20.0, 3.0, 4.0), (75.0, 4.0, 6.0), (240.0, 9.0, 9.0))


@dataclass(frozen=True)
class Truth:
    """What a simulated test was made from, all in um."""

    profile: np.ndarray
    shift: np.ndarray
    stretch: np.ndarray
    seconds: np.ndarray
    position: np.ndarray

    @property
    def drift(self) -> np.ndarray:
        """Drift at every reading (cycle, direction, target)."""
        return self.shift + self.stretch * self.position

    def mean_profile(self, present: np.ndarray) -> np.ndarray:
        """Profile (direction, target) at the mean thermal state of the measured cycles, each counted alike."""
        weights = present / np.maximum(present.sum(axis=(1, 2), keepdims=True), 1)
        weights = weights / weights.sum()
        return self.profile + (weights * self.shift).sum() + (weights * self.stretch).sum() * self.position


def schedule(cycles: int) -> np.ndarray:
    """Seconds of each reading (cycle, direction, target)."""
    along = np.arange(TARGETS) * STEP_S
    forward = 2.0 + along
    backward = forward[-1] + TURN_S + along[::-1]
    return np.arange(cycles)[:, None, None] * CYCLE_S + np.stack([forward, backward])


def with_memory(noise: np.ndarray, share: float) -> np.ndarray:
    """Return independent values (cycle, ...) with a correlation from cycle to cycle and the same scatter."""
    made = noise.copy()
    for k in range(1, len(made)):
        made[k] = share * made[k - 1] + np.sqrt(1 - share**2) * made[k]
    return made


def simulate(
    rng: np.random.Generator,
    *,
    kind: str = "warmup",
    cycles: int = 100,
    scale: float = 1.0,
    noise: np.ndarray | None = None,
    sigma: float = SIGMA_UM,
) -> tuple[xr.Dataset, Truth]:
    """Simulate a test; kind is one of none, warmup, duty, rw. ``noise`` replaces the normal noise (cycle, 2, target)."""
    seconds = schedule(cycles)
    position = np.linspace(0, 1, TARGETS)
    profile = rng.normal(0, 1.5, TARGETS) + 4 * position
    reversal = 1.5 + rng.normal(0, 0.3, TARGETS)
    both = np.stack([profile + reversal / 2, profile - reversal / 2])
    shift, stretch = (scale * one for one in _drift(rng, kind, seconds))
    if noise is None:
        noise = rng.normal(0, sigma, seconds.shape)
    deviation = both + shift + stretch * position + noise
    time = START + (seconds * 1e9).astype("timedelta64[ns]")
    dataset = build_deviations(range(1, cycles + 1), range(1, TARGETS + 1), position * 300.0, deviation, time)
    dataset["time"].attrs["origin"] = "recorded"
    return dataset, Truth(both, shift, stretch, seconds, position)


def recorded(deviations: xr.Dataset, digit_um: float) -> xr.Dataset:
    """Return a test as it is where its readings are written in whole digits."""
    rounded = digit_um * np.rint(deviations["deviation"] / digit_um)
    return deviations.assign(deviation=rounded, resolution=((), digit_um, {"units": "um"}))


def _drift(rng: np.random.Generator, kind: str, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    grid = np.arange(0.0, seconds.max() + 2.0, 2.0)
    if kind == "none":
        return np.zeros(seconds.shape), np.zeros(seconds.shape)
    if kind == "rw":
        walks = [rate * _walk(rng, grid) for rate in (0.4, 0.3)]
    else:
        walks = [0.04 * _walk(rng, grid), 0.03 * _walk(rng, grid)]
        for minutes, shift, stretch in SOURCES:
            heat = _heat(rng, kind, grid, minutes * 60)
            walks[0] = walks[0] + shift * heat
            walks[1] = walks[1] + stretch * heat
    return tuple(np.interp(seconds, grid, walk) for walk in walks)


def _walk(rng: np.random.Generator, grid: np.ndarray) -> np.ndarray:
    """A random walk with unit variance per cycle."""
    steps = rng.standard_normal(grid.size) * np.sqrt(np.gradient(grid) / CYCLE_S)
    return np.cumsum(steps)


def _heat(rng: np.random.Generator, kind: str, grid: np.ndarray, tau: float) -> np.ndarray:
    if kind == "warmup":
        return 1.0 - np.exp(-grid / tau)
    power = np.empty(grid.size)
    at, on = 0.0, True
    while at < grid[-1] + 1:
        length = rng.exponential(1800.0)
        power[(grid >= at) & (grid < at + length)] = float(on)
        at, on = at + length, not on
    level, heat = 0.0, np.empty(grid.size)
    decay = np.exp(-(grid[1] - grid[0]) / tau)
    for k, one in enumerate(power):
        level = decay * level + (1 - decay) * one
        heat[k] = level
    return heat
