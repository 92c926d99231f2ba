"""A positioning campaign of a few dozen readings, made by hand: every number can be followed on paper."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusion.alignment.readings import Readings, Series

#: Time between two readings, and between the last reading of a cycle and the first of the next, s.
STEP_S, PAUSE_S = 10.0, 60.0


def campaign(
    *,
    cycles: int = 12,
    positions_mm: tuple[float, ...] = (100.0, 200.0, 300.0, 400.0),
    both_directions: bool = True,
    response: np.ndarray | None = None,
    series: Mapping[str, Series] | None = None,
    drivers: tuple[str, ...] = (),
) -> Readings:
    """Cycles that go to every target in positive order, and back in negative order; a response of zero by default."""
    targets = np.arange(1, len(positions_mm) + 1)
    order = np.concatenate([targets, targets[::-1]]) if both_directions else targets
    sign = np.where(np.arange(order.size) < targets.size, 1.0, -1.0)
    period_s = STEP_S * (order.size - 1) + PAUSE_S
    seconds = (period_s * np.arange(cycles)[:, None] + STEP_S * np.arange(order.size)).ravel()
    target = np.tile(order, cycles)
    return Readings(
        seconds=seconds,
        response=np.zeros(seconds.size) if response is None else response,
        cycle=np.repeat(np.arange(1, cycles + 1), order.size),
        target=target,
        position_mm=np.array(positions_mm)[target - 1],
        sign=np.tile(sign, cycles),
        targets=targets,
        positions_mm=np.array(positions_mm),
        series={} if series is None else series,
        drivers=drivers,
        left_out={},
    )


def period_s(readings: Readings) -> float:
    """Time from the start of one cycle to that of the next, s."""
    return float(readings.seconds[readings.cycle == 2][0])


def logged(values: np.ndarray, units: str, *, step_s: float = 30.0) -> Series:
    """A series sampled evenly from the first reading on."""
    return Series(step_s * np.arange(len(values)), np.asarray(values, float), units)
