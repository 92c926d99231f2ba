"""The next test of a record's machine: a random duty, and how much less the response leaves open after it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from fusion.analysis.attribution.duty import DutyLaw, DutyPlanError
from fusion.analysis.drift_model.record_data import EXPONENTS, Record
from fusion.analysis.drift_model.recursion import (
    Marginal,
    Response,
    columns_of,
    evaluate_columns,
    events_of,
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


@dataclass(frozen=True)
class NextTest:
    """A test that is proposed.

    Attributes
    ----------
    hours, hold_min : length, and mean time at one level
    width_now_um, width_um : standard uncertainty of a prediction under another duty, mean over displacements, before and after it
    open_um : the same now by what is read, the largest first
    minutes, levels : time and level (n, drivers) of every change, from the first on, in the unit of each driver
    """

    hours: float
    hold_min: float
    width_now_um: float
    width_um: float
    open_um: dict[str, float]
    minutes: Array
    levels: Array


def propose_tests(product: xr.Dataset, loop: RecordLoop, *, seed: int = 0) -> Iterator[NextTest]:
    """Yield the best of the duties tried for every length of a test.

    What the sensors will read is the response of each to the drivers in the record; the room is left out.
    """
    record = record_of_product(product)
    if not record.drivers:
        raise DutyPlanError(
            "the record holds no driver that changes; log speed, load or duty, which a next test can set"
        )
    columns = columns_of(record, record.sensors)
    every = np.ones(record.seconds.size, bool)
    responses = respond(record, evaluate_columns(record, columns), events_of(product, loop), every)
    loads = [one for one in columns if one.input in record.drivers]
    none = np.empty((0, *record.rise.shape))
    warmth = respond(replace(record, displacement=record.rise), evaluate_columns(record, loads), none, every)
    per_load = np.column_stack([one.coefficients for one in warmth])
    rng = np.random.default_rng(seed)

    def under(hours: float, hold_min: float) -> tuple[Record, Array]:
        step_s = min(max(record.block_s, 3600.0 * hours / _MOST_ROWS), _LONGEST_STEP_S)
        seconds = np.asarray(step_s * np.arange(round(3600.0 * hours / step_s)), float)
        law = DutyLaw(60.0 * hold_min, 15.0 * hold_min)
        # Rest, half and full: linear and quadratic heat differ.
        shares = {name: np.mean([law.course(seconds, rng) for _ in range(2)], axis=0) for name in record.drivers}
        drivers = {name: {power: share**power for power in EXPONENTS} for name, share in shares.items()}
        still = np.zeros((seconds.size, len(record.sensors)))
        test = replace(record, seconds=seconds, block_s=step_s, drivers=drivers, temperature=still, first=(0,), runs=())
        test = replace(test, temperature=evaluate_columns(test, loads) @ per_load)
        return test, evaluate_columns(test, columns)

    _, judged = under(_JUDGED_H, _JUDGED_HOLD_MIN)
    judged = judged - judged.mean(axis=0)
    now = [one.covariance for one in responses]
    read = {name: [one.input == name for one in columns] for name in (*record.drivers, *record.sensors)}
    open_um = {name: _width(now, judged * np.array(used)) for name, used in read.items()}
    largest = dict(sorted(open_um.items(), key=lambda item: -item[1]))
    for hours in _HOURS:
        tried = []
        for hold_min in _HOLDS_MIN:
            test, values = under(hours, hold_min)
            steps = record.block_s / test.block_s
            after = [covariance_after(one, test.seconds, values, steps=steps) for one in responses]
            tried.append((_width(after, judged), hold_min, test))
        width, hold_min, test = min(tried, key=lambda one: one[0])
        sizes = np.array([record.driver_sizes[name][0] for name in test.drivers])
        levels = np.column_stack([powers[1] for powers in test.drivers.values()]) * sizes
        changed = np.flatnonzero(np.r_[True, (np.diff(levels, axis=0) != 0.0).any(axis=1)])
        minutes = test.seconds[changed] / 60.0
        yield NextTest(hours, hold_min, _width(now, judged), width, largest, minutes, levels[changed])


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


def _width(covariances: list[Array], judged: Array) -> float:
    """Return the standard uncertainty of what columns (n, p) predict, root mean square over time, mean over the displacements, um."""
    return float(np.mean([np.sqrt(np.mean(np.sum((judged @ one) * judged, axis=1))) for one in covariances]))
