"""When the twin takes its readings, where its table is at any time, and how hard the machine works."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.twin.machine.recipe import Duty, RecipeError, Test
from fusion.twin.machine.streams import random_levels, stream, switched_levels

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Schedule:
    """Readings in the order they are taken; times are seconds since the start of the test.

    `way_s` and `way_mm` are the corners of the table's motion: position over time is linear between them.
    """

    positions_mm: Floats
    time_s: Floats
    cycle: NDArray[np.int64]
    sign: NDArray[np.int64]
    target: NDArray[np.int64]
    way_s: Floats
    way_mm: Floats
    period_s: float
    cycles: int

    @property
    def position_mm(self) -> Floats:
        """Target position of every reading, mm."""
        return self.positions_mm[self.target - 1]

    @property
    def duration_s(self) -> float:
        """Length of the test, s."""
        return self.period_s * self.cycles

    @property
    def last_reading_s(self) -> float:
        """Time of a cycle's last reading after the cycle's start, s."""
        return float(self.time_s[self.cycle == 1][-1])

    def table_position(self, time_s: Floats) -> Floats:
        """Return the axis position (mm) at the given times (s)."""
        return np.interp(time_s, self.way_s, self.way_mm)


def make_schedule(test: Test, seed: int) -> Schedule:
    """Lay out every reading of the test in time.

    One cycle: approach every target at the feed, read after the dwell; turn round, read on the way back, wait for the next
    period at axis position 0.

    Raises
    ------
    RecipeError
        The cycle does not fit into its period, or the positions do not grow.
    """
    positions = np.array(test.positions_mm or np.arange(test.targets) * test.spacing_mm, dtype=float)
    if not test.positions_mm and test.jitter_mm > 0:
        positions[1:-1] += (
            stream(seed, "target positions").uniform(-test.jitter_mm, test.jitter_mm, positions.size - 2).round(3)
        )
    if np.any(np.diff(positions) <= 0):
        raise RecipeError("test: the target positions do not grow; sort test.positions_mm or lower test.jitter_mm")
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
    m = positions.size
    start = np.arange(test.cycles) * test.period_s
    per_cycle = np.concatenate([forward, backward])
    numbers = np.arange(1, m + 1)
    return Schedule(
        positions_mm=positions,
        time_s=(start[:, None] + per_cycle).ravel(),
        cycle=np.repeat(np.arange(1, test.cycles + 1), 2 * m),
        sign=np.tile(np.repeat([1, -1], m), test.cycles),
        target=np.tile(np.concatenate([numbers, numbers[::-1]]), test.cycles),
        way_s=(start[:, None] + way_s).ravel(),
        way_mm=np.tile(way_mm, test.cycles),
        period_s=test.period_s,
        cycles=test.cycles,
    )


def duty_levels(duty: Duty, time_s: Floats, seed: int) -> Floats:
    """Return the machine's load (0..1) at the given times, as the recipe's duty asks for it."""
    if duty.kind == "constant":
        return np.full(time_s.size, duty.high)
    if duty.kind == "randomised":
        holds = (60.0 * duty.least_hold_min, 60.0 * (duty.mean_hold_min - duty.least_hold_min))
        return switched_levels(time_s, (duty.low, duty.high), holds, stream(seed, "duty"))
    return random_levels(
        time_s, duty.low, duty.high, duty.mean_hold_min, stream(seed, "duty"), two=duty.kind == "switched"
    )
