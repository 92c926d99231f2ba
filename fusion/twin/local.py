"""around - What can be wrong with a single target: extra scatter, its own heat, stick-slip, a step, a slow wander."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.session import Session
from fusion.twin.streams import first_order

Floats = NDArray[np.floating[Any]]
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
