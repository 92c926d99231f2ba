"""Heat conduction in the table: a plate with local sources and convection, solved by cosine modes, exact in time.

The plate (thickness d, no temperature difference over it, insulated edges) obeys rho c d dT/dt = k d lap(T) - h (T - T_air) + q(x, y, t).
cos(m pi x / W) cos(n pi y / H) are its eigenfunctions, so every mode is one first-order equation whose step is exact for a power
that is constant over the step (Carslaw and Jaeger, Conduction of Heat in Solids, 1959, section 5.6). The
field has no grid: it can be evaluated anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion._typing import Array
from fusion.twin.machine.recipe import Plan, Source, Table

#: Numbers of modes along and across the table; the shortest wave of the default table is 22 mm along it.
MODES_X = 64
MODES_Y = 20


@dataclass(frozen=True)
class Plate:
    """Temperature rise of the plate over its start, as amplitudes of its modes over time.

    Attributes
    ----------
    plan : Plan
        Size of the plate and measured line.
    grid_s : (m,) ndarray, s
        Evenly spaced times.
    amplitudes : (m, MODES_X * MODES_Y) ndarray, K
        Amplitude of every mode at each grid time; the first is the mean rise.
    """

    plan: Plan
    grid_s: Array
    amplitudes: Array

    def field(self, time_s: Array, x_mm: Array, y_mm: Array, *, cell_mm: float = 0.0) -> Array:
        """Return the temperature rise on a rectangular grid of plan points.

        Parameters
        ----------
        time_s : (t,) ndarray, s
            Times; the amplitudes are interpolated linearly between grid times.
        x_mm, y_mm : (x,) and (y,) ndarray, mm
            Plan coordinates.
        cell_mm : float, mm
            Side of a square cell around each point over which the rise is averaged exactly; 0 gives the rise at the point.

        Returns
        -------
        (t, y, x) ndarray, K
        """
        modes = self._amplitudes_at(time_s).reshape(-1, MODES_X, MODES_Y)
        along = _cosines(x_mm, self.plan.width_mm, MODES_X) * np.sinc(
            np.arange(MODES_X) * cell_mm / (2 * self.plan.width_mm)
        )
        across = _cosines(y_mm, self.plan.height_mm, MODES_Y) * np.sinc(
            np.arange(MODES_Y) * cell_mm / (2 * self.plan.height_mm)
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
    """Solve the heat equation of the plate for the given powers.

    Parameters
    ----------
    plan : Plan
        Size of the plate.
    table : Table
        Thickness, material and convection.
    sources : tuple of Source
        Footprints; each is normalised so that all of its power enters the plate.
    power : (m, sources) ndarray, W
        Heat of every source over the step that begins at each grid time.
    air_rise : (m,) ndarray, K
        Air temperature over the plate's start temperature.
    grid_s : (m,) ndarray, s
        Evenly spaced times; the rise is 0 at the first.

    Returns
    -------
    Plate
        Exact for powers and air temperatures that are constant over each step.

    Notes
    -----
    Carslaw and Jaeger, Conduction of Heat in Solids, 2nd ed. (1959), section 5.6; docs/method/effects.md.
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
