"""Timing of the test: when every reading is taken, where the table is at any time, and how hard the machine works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.twin.machine.recipe import Duty, RecipeError, Test
from fusion.twin.machine.streams import random_levels, stream, switched_levels


@dataclass(frozen=True)
class ReadingSequence:
    """The readings of a test in the order in which they are taken; times count from the start of the test.

    Attributes
    ----------
    time_s : (n,) ndarray, s
        Time of each reading.
    cycle, target : (n,) integer ndarray
        Cycle and target number of each reading, from 1.
    sign : (n,) integer ndarray
        Approach: 1 positive, -1 negative.
    position_mm : (n,) ndarray, mm
        Target position of each reading.
    cycles : int
        Number of cycles.
    period_s : float, s
        Duration of a cycle.
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
    """The readings of a positioning test and the motion of its table.

    Attributes
    ----------
    positions_mm : (targets,) ndarray, mm
        Target positions, increasing.
    way_s, way_mm : (k,) ndarray, s and mm
        Corners of the table's motion: the axis position is linear between them.
    """

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
    """Lay out the readings of a bidirectional test in time.

    In each cycle the table approaches every target at the feed and is read after the dwell; it reverses, is read at every target on
    the way back, and waits for the next cycle at axis position 0.

    Parameters
    ----------
    test : Test
        Targets, feed, dwell, reversal time and period.
    seed : int
        Seed of the campaign, for the random offsets (`jitter_mm`) of the target positions.

    Returns
    -------
    Schedule

    Raises
    ------
    RecipeError
        A cycle does not fit into its period, or the target positions do not increase.
    """
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
        positions[1:-1] += (
            stream(seed, "target positions").uniform(-test.jitter_mm, test.jitter_mm, positions.size - 2).round(3)
        )
    if np.any(np.diff(positions) <= 0):
        raise RecipeError("test: the target positions do not increase; sort test.positions_mm or lower test.jitter_mm")
    return positions


def duty_levels(duty: Duty, time_s: Array, seed: int) -> Array:
    """Return the machine's load over time.

    Parameters
    ----------
    duty : Duty
        Kind of the load, its levels and holds.
    time_s : (m,) ndarray, s
        Increasing times.
    seed : int
        Seed of the campaign.

    Returns
    -------
    (m,) ndarray
        Load at each time, as a fraction of full load.
    """
    if duty.kind == "constant":
        return np.full(time_s.size, duty.high)
    if duty.kind == "randomised":
        holds = (60.0 * duty.least_hold_min, 60.0 * (duty.mean_hold_min - duty.least_hold_min))
        return switched_levels(time_s, (duty.low, duty.high), holds, stream(seed, "duty"))
    return random_levels(
        time_s, duty.low, duty.high, duty.mean_hold_min, stream(seed, "duty"), alternate=duty.kind == "switched"
    )
