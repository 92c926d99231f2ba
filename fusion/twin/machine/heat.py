"""The twin's own heat solution: a plate with local sources and convection, by cosine modes, exact in time.

The plate (thickness d, no temperature difference over it, insulated edges) obeys rho c d dT/dt = k d lap(T) - h (T - T_air) + q(x, y, t).
cos(m pi x / W) cos(n pi y / H) are its eigenfunctions, so every mode is one first-order equation whose step is exact for a power
that is constant over the step (Carslaw and Jaeger, Conduction of Heat in Solids, 1959, section 5.6). Nothing here is shared with
the analysis, and the field has no grid: it can be asked for anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.machine.recipe import Plan, Source, Table

Floats = NDArray[np.floating[Any]]
MODES_X = 64
MODES_Y = 20


@dataclass(frozen=True)
class Plate:
    """Amplitudes of the plate's modes over time: temperature rise over its start, K.

    `amplitudes` is (time, MODES_X * MODES_Y); `grid_s` (time,) the evenly spaced times, s.
    """

    plan: Plan
    grid_s: Floats
    amplitudes: Floats

    def at(self, time_s: Floats) -> Floats:
        """Return the amplitudes (n, modes) at the given times, linear between steps."""
        step = self.grid_s[1] - self.grid_s[0]
        place = np.clip((np.asarray(time_s) - self.grid_s[0]) / step, 0, self.grid_s.size - 1)
        low = np.minimum(place.astype(int), self.grid_s.size - 2)
        part = (place - low)[:, None]
        return np.asarray((1.0 - part) * self.amplitudes[low] + part * self.amplitudes[low + 1])

    def field(self, time_s: Floats, x_mm: Floats, y_mm: Floats, *, cell_mm: float = 0.0) -> Floats:
        """Return the rise (time, y, x) in K at the given coordinates, mm, or its exact mean over square cells around them."""
        modes = self.at(time_s).reshape(-1, MODES_X, MODES_Y)
        along = cosines(x_mm, self.plan.width_mm, MODES_X) * np.sinc(
            np.arange(MODES_X) * cell_mm / (2 * self.plan.width_mm)
        )
        across = cosines(y_mm, self.plan.height_mm, MODES_Y) * np.sinc(
            np.arange(MODES_Y) * cell_mm / (2 * self.plan.height_mm)
        )
        return np.asarray(np.matmul(np.matmul(across, modes.transpose(0, 2, 1)), along.T))

    def mean(self) -> Floats:
        """Return the mean rise of the whole table at every grid time, K."""
        return self.amplitudes[:, 0]

    def points(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """Return the rise (grid time, point) in K at plan points."""
        along = cosines(x_mm, self.plan.width_mm, MODES_X)
        across = cosines(y_mm, self.plan.height_mm, MODES_Y)
        return np.asarray(self.amplitudes @ (along[:, :, None] * across[:, None, :]).reshape(len(along), -1).T)

    def line_integrals(self, length_mm: Floats) -> Floats:
        """Return the integral (grid time, length) in K mm of the rise along the measured line, from its origin to each length."""
        return np.asarray(self.amplitudes @ _line_weights(self.plan, np.asarray(length_mm, dtype=float)).T)


def solve_plate(
    plan: Plan, table: Table, sources: tuple[Source, ...], power: Floats, air_rise: Floats, grid_s: Floats
) -> Plate:
    """Solve the plate for the given powers.

    Parameters
    ----------
    plan, table : Plan, Table
        Size and material.
    sources : tuple of Source
        Footprints; each is normalised so that all of its power enters the plate.
    power : (time, source) array
        Heat of every source over the step that starts at each time, W.
    air_rise : (time,) array
        Air temperature over the plate's start temperature, K.
    grid_s : (time,) array
        Evenly spaced times, s; the rise is 0 at the first.

    Returns
    -------
    Plate
    """
    capacity = table.density_kg_per_m3 * table.heat_capacity_J_per_kgK * table.thickness_mm * 1e-3
    wave_x = np.arange(MODES_X) * np.pi / (plan.width_mm * 1e-3)
    wave_y = np.arange(MODES_Y) * np.pi / (plan.height_mm * 1e-3)
    conduction = table.conductivity_W_per_mK * table.thickness_mm * 1e-3
    rate = ((conduction * (wave_x[:, None] ** 2 + wave_y**2) + table.convection_W_per_m2K) / capacity).ravel()
    area = plan.width_mm * plan.height_mm * 1e-6
    heating = (
        power @ np.stack([_footprint(plan, s) for s in sources]) / (capacity * area)
        if sources
        else np.zeros((grid_s.size, rate.size))
    )
    heating[:, 0] += table.convection_W_per_m2K * air_rise / capacity
    step_s = grid_s[1] - grid_s[0]
    decay = np.exp(-rate * step_s)
    gain = -np.expm1(-rate * step_s) / rate
    amplitudes = np.zeros((grid_s.size, rate.size))
    for step in range(grid_s.size - 1):
        amplitudes[step + 1] = decay * amplitudes[step] + gain * heating[step]
    return Plate(plan, grid_s, amplitudes)


def cosines(at_mm: Floats, length_mm: float, count: int) -> Floats:
    """Return cos(m pi x / L), (points, modes)."""
    return np.asarray(np.cos(np.multiply.outer(np.asarray(at_mm, dtype=float), np.arange(count) * np.pi / length_mm)))


def _footprint(plan: Plan, source: Source) -> Floats:
    """Return the modes (flat) of a Gaussian footprint whose mean over the plate is 1."""
    modes = []
    for centre, spread, length, count in (
        (source.x_mm, source.spread_x_mm, plan.width_mm, MODES_X),
        (source.y_mm, source.spread_y_mm, plan.height_mm, MODES_Y),
    ):
        at = (np.arange(4 * int(length)) + 0.5) * length / (4 * int(length))
        weight = np.exp(-0.5 * ((at - centre) / spread) ** 2)
        modes.append((weight / weight.sum()) @ cosines(at, length, count) * np.where(np.arange(count) == 0, 1.0, 2.0))
    return np.multiply.outer(*modes).ravel()


def _line_weights(plan: Plan, length_mm: Floats) -> Floats:
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
