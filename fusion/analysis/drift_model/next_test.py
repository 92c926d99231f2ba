"""The next test of a record's machine: a random duty, and the uncertainty of a correction that is expected after it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from fusion.analysis.attribution.duty import DutyPlanError
from fusion.analysis.drift_model.record_data import EXPONENTS, Record
from fusion.analysis.drift_model.recursion import (
    Marginal,
    Response,
    columns_of,
    evaluate_columns,
    events_of,
    expected_um,
    part_s,
    record_of_product,
    respond,
)
from fusion.common import Array
from fusion.results.loop import RecordLoop

#: Lengths and mean times at one level that are tried.
_HOURS = (4.0, 8.0, 12.0, 24.0)
_HOLDS_MIN = (15.0, 30.0, 60.0, 120.0)
#: Most rows of a proposed test, also after a record of milliseconds, and its longest step: a third of the shortest mean time at one level.
_MOST_ROWS = 10_000
_LONGEST_STEP_S = 20.0 * min(_HOLDS_MIN)
#: The duty under which a prediction is judged: hours of it, and its mean time at one level.
_JUDGED_H, _JUDGED_HOLD_MIN = 24.0, 60.0
#: Levels as shares of the largest: linear and quadratic heat differ.
_SHARES = (0.0, 0.5, 1.0)


@dataclass(frozen=True)
class NextTest:
    """A test that is proposed.

    Attributes
    ----------
    hours, hold_min : length, and mean time at one level
    over_h : hours after a zero for which an uncertainty holds
    now_um, after_um : standard uncertainty of a prediction of every displacement before and after it
    open_um : what is not known of the response to each reading by itself, the largest first
    minutes, levels : time of every change, from the first on, and the levels of every driver then
    units : unit of every driver
    """

    hours: float
    hold_min: float
    over_h: float
    now_um: dict[str, float]
    after_um: dict[str, float]
    open_um: dict[str, float]
    minutes: list[float]
    levels: dict[str, list[float]]
    units: dict[str, str]

    @property
    def left(self) -> float:
        """Mean over the displacements of the uncertainty after it over that before it."""
        return float(np.mean([self.after_um[name] / um for name, um in self.now_um.items()]))


def choose_test(tests: Sequence[NextTest]) -> NextTest:
    """Return the shortest test that gains at least half of what the best of them gains."""
    best = min(one.left for one in tests)
    return next(one for one in tests if 1.0 - one.left >= (1.0 - best) / 2.0)


def propose_tests(
    product: xr.Dataset, loop: RecordLoop, *, largest: Mapping[str, float] | None = None, seed: int = 0
) -> Iterator[NextTest]:
    """Yield the best of the duties tried for every length of a test; `largest` is the highest level of a driver, if not that of the record.

    What the sensors will read is the response of each to the drivers in the record, and beside it what they read beyond that: the room.
    """
    record = record_of_product(product)
    if not record.drivers:
        raise DutyPlanError(
            "the record holds no driver that changes; log speed, load or duty, which a next test can set"
        )
    columns, every = columns_of(record, record.sensors), np.ones(record.seconds.size, bool)
    events = events_of(product, loop)
    responses = respond(record, evaluate_columns(record, columns), events, every)
    loads = [one for one in columns if one.input in record.drivers]
    warmed, none = evaluate_columns(record, loads), np.empty((0, *record.rise.shape))
    warmth = respond(replace(record, displacement=record.rise), warmed, none, every)
    per_load = np.column_stack([one.coefficients for one in warmth])
    longest = record.run == np.bincount(record.run).argmax()
    room, at = (record.rise - warmed @ per_load)[longest], record.seconds[longest] - record.seconds[longest][0]
    highest = {name: (largest or {}).get(name, size) / size for name, (size, _) in record.driver_sizes.items()}
    units = {name: unit for name, (_, unit) in record.driver_sizes.items()}
    rng = np.random.default_rng(seed)

    def under(hours: float, hold_min: float) -> tuple[Record, Array]:
        step_s = min(max(record.block_s, 3600.0 * hours / _MOST_ROWS), _LONGEST_STEP_S)
        seconds = np.asarray(step_s * np.arange(round(3600.0 * hours / step_s)), float)
        shares = {name: highest[name] * _course(seconds, hold_min, rng) for name in record.drivers}
        drivers = {name: {power: share**power for power in EXPONENTS} for name, share in shares.items()}
        still = np.zeros((seconds.size, len(record.sensors)))
        test = replace(record, seconds=seconds, block_s=step_s, drivers=drivers, temperature=still, first=(0,), runs=())
        # The room of the record, forth and back where it is shorter.
        there = at[-1] - abs(seconds % max(2.0 * at[-1], step_s) - at[-1])
        beside = np.column_stack([np.interp(there, at, one) for one in room.T])
        test = replace(test, temperature=evaluate_columns(test, loads) @ per_load + beside)
        return test, evaluate_columns(test, columns)

    test, judged = under(_JUDGED_H, _JUDGED_HOLD_MIN)
    over_s = min(part_s(record), 3600.0 * _JUDGED_H)
    now_um = expected_um(responses, test, judged, over_s)
    silent = [replace(one, noise_um=0.0) for one in responses]
    read = {name: judged * [one.input == name for one in columns] for name in (*record.drivers, *record.sensors)}
    each = {name: float(expected_um(silent, test, used, over_s).mean()) for name, used in read.items()}
    open_um = dict(sorted(each.items(), key=lambda item: -item[1]))
    for hours in _HOURS:
        tried = []
        for hold_min in _HOLDS_MIN:
            duty, values = under(hours, hold_min)
            steps = record.block_s / duty.block_s
            left = [covariance_after(one, duty.seconds, values, steps=steps) for one in responses]
            after = [replace(one, covariance=open_) for one, open_ in zip(responses, left, strict=True)]
            tried.append((expected_um(after, test, judged, over_s), hold_min, duty))
        after_um, hold_min, best = min(tried, key=lambda one: float(np.mean(one[0] / now_um)))
        courses = {name: record.driver_sizes[name][0] * powers[1] for name, powers in best.drivers.items()}
        changed = np.flatnonzero(np.r_[True, np.any([np.diff(one) != 0.0 for one in courses.values()], axis=0)])
        now, later = (dict(zip(record.channels, one.tolist(), strict=True)) for one in (now_um, after_um))
        minutes, levels = best.seconds[changed] / 60.0, {name: one[changed].tolist() for name, one in courses.items()}
        yield NextTest(hours, hold_min, over_s / 3600.0, now, later, open_um, minutes.tolist(), levels, units)


def _course(seconds: Array, hold_min: float, rng: np.random.Generator) -> Array:
    """Draw the share of its largest level that a driver has at some times: another one after every hold, a quarter of the mean at least."""
    # In whole minutes.
    holds = 60.0 * np.maximum(np.rint(0.25 * hold_min + rng.exponential(0.75 * hold_min, seconds.size)), 1.0)
    # Of three levels the next or the one after it.
    places = np.cumsum(rng.integers(1, len(_SHARES), seconds.size)) % len(_SHARES)
    return np.array(_SHARES)[places[np.searchsorted(np.cumsum(holds), seconds, side="right")]]


def covariance_after(one: Response, seconds: Array, values: Array, *, steps: float) -> Array:
    """Return the covariance of a response after a test (n, p), too, so many steps of which are as long as a block of the record."""
    # The noise of a block mean is that of so many steps.
    noise_um, ratio = one.noise_um * np.sqrt(steps), one.ratio / steps
    marginal = Marginal.of(seconds, np.zeros(seconds.size), np.ones((seconds.size, 1)), values, ratio=ratio)
    scale = np.sqrt(np.diag(one.covariance))
    # Of standardised coefficients: their variances differ by many powers of ten.
    before = np.linalg.inv(one.covariance / np.outer(scale, scale))
    return np.asarray(
        np.linalg.inv(before + marginal.gram * np.outer(scale, scale) / noise_um**2) * np.outer(scale, scale)
    )
