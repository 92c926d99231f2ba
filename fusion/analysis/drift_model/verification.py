"""The test after a compensation: what was predicted, what was achieved, and where it was not, why.

What a machine with a compensation shows is its own displacement plus the gain with which the correction acts, 1 where all is well. The
correction itself is known from the readings that were logged. So what is left follows the correction where the gain is wrong, and follows
the states of the model in other proportions where the control runs other coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.drift_model.record import predict, predict_left_out
from fusion.analysis.drift_model.record_data import Record
from fusion.analysis.drift_model.recursion import columns_of_loop, evaluate_columns, record_of_product
from fusion.common import Array
from fusion.results.loop import RecordLoop
from fusion.results.recursion import FAILED, Recursion, RecursionError, run_recursion

#: Pieces of which a course is put together for the predicted range, and of which a gain is estimated without each.
_PIECES = 8
_DRAWS = 1000
#: Probability within the predicted interval.
_COVERAGE = 0.95
#: Share of what is left that an explanation must take away, in pieces that it was not fitted to.
_EXPLAINS = 0.5
#: Gains that have a name, half a unit apart at least; what is nearer to one than half of that is it, another one is a scale.
_SAME_GAIN = 0.25
_NAMED_GAINS = {"wrong sign": -1.0, "half the gain": 0.5, "not active": 0.0}
_OF_GAIN = (*_NAMED_GAINS, "wrong scale")


@dataclass(frozen=True)
class ChannelVerdict:
    """One displacement before and after, um.

    Attributes
    ----------
    name : displacement
    before_um : range that the test would have shown without the correction, taken with the gain that was found where that is the fault
    predicted_um, predicted_low_um, predicted_high_um : range that the compensation was predicted to leave, median and 95 % interval
    achieved_um : range that was measured
    gain, gain_u : with which the correction acted, by regression; 1 where all is well
    is_kept : whether what was achieved is not above the interval
    fault : name of what is wrong; empty where nothing is, and "not explained" where nothing here explains it
    reason : the evidence, one sentence
    """

    name: str
    before_um: float
    predicted_um: float
    predicted_low_um: float
    predicted_high_um: float
    achieved_um: float
    gain: float
    gain_u: float
    is_kept: bool
    fault: str
    reason: str


def predicted_ranges(product: xr.Dataset, loop: RecordLoop, after: Record, *, seed: int = 1) -> dict[str, Array]:
    """Return draws of the range (draws,), um, that a compensation by the model of a run leaves in another test, by channel.

    Two things are left. What the model misses: every part of the record is predicted from all others, and the errors are put together
    again at random in pieces. And what its coefficients are wrong by, at the readings of the other test, which may go where the record
    did not: they are drawn from their distribution given the record, in which shrinkage is the prior of ridge regression.
    """
    record = record_of_product(product)
    columns, events, _ = columns_of_loop(loop, record, record.sensors)
    matrix = np.column_stack([evaluate_columns(record, columns), events])
    there = evaluate_columns(_with_sensors(after, record.sensors), columns)
    every = np.ones(record.seconds.size, bool)
    fit = predict(record, matrix, every)
    missed = record.displacement - predict_left_out(record, matrix, fit.penalty)
    scale = np.where(matrix.std(axis=0) > 0.0, matrix.std(axis=0), np.inf)
    standard = (matrix - matrix.mean(axis=0)) / scale
    spread = standard.T @ standard / record.seconds.size + fit.penalty * np.eye(scale.size)
    # Blocks follow each other closely: so many pieces are independent, not so many blocks.
    root = np.linalg.cholesky(np.linalg.inv(spread) / _PIECES)
    apart = ((there - there[0]) / scale[: len(columns)]) @ root[: len(columns)]
    size = np.sqrt(np.nanmean(missed**2, axis=0))
    length = max(1, record.seconds.size // _PIECES)
    pieces = -(-after.seconds.size // length)
    rng = np.random.default_rng(seed)
    ranges = np.empty((_DRAWS, len(record.channels)))
    for draw in range(_DRAWS):
        starts = rng.integers(0, record.seconds.size - length + 1, pieces)
        rows = (starts[:, None] + np.arange(length)).ravel()[: after.seconds.size]
        left = missed[rows] + apart @ rng.standard_normal((scale.size, size.size)) * size
        ranges[draw] = np.nanmax(left, axis=0) - np.nanmin(left, axis=0)
    return dict(zip(record.channels, ranges.T, strict=True))


def _with_sensors(after: Record, sensors: tuple[str, ...]) -> Record:
    """Return a record with the sensors of another one in its order; one that does not measure stays at its first value."""
    rows = [
        after.temperature[:, after.sensors.index(name)] if name in after.sensors else np.zeros(after.seconds.size)
        for name in sensors
    ]
    return replace(after, temperature=np.column_stack(rows), sensors=sensors)


def verify(
    after: Record, applied: Recursion, ranges: Mapping[str, Array], *, faulty_sensors: Mapping[str, str]
) -> list[ChannelVerdict]:
    """Compare a test with an active compensation with what was predicted.

    Parameters
    ----------
    after : Record
        The test with the compensation, on its blocks.
    applied : Recursion
        The model that is said to run in the control.
    ranges : mapping of str to (draws,) ndarray
        What `predicted_ranges` returns.
    faulty_sensors : mapping of str to str
        Sensors that do not measure in this test, with what they do.

    Returns
    -------
    list of ChannelVerdict
        One per displacement that the model corrects.
    """
    missing = [one.name for one in applied.inputs if one.name not in (*after.sensors, *after.drivers, *faulty_sensors)]
    if missing:
        raise RecursionError(f"the test after it does not hold {', '.join(missing)}, which the applied model reads")
    model = applied.at_sampling(after.block_s)
    readings = _readings(after, model, faulty_sensors)
    zero = np.arange(after.seconds.size) == 0
    replayed = run_recursion(model, readings, zero=zero)
    dead = {one.name for one in model.inputs} & set(faulty_sensors)
    failed = bool((replayed.status == FAILED).any())
    verdicts = []
    for k, output in enumerate(model.outputs):
        if output.name not in after.channels or output.name not in ranges:
            continue
        measured = after.displacement[:, after.channels.index(output.name)]
        known = np.isfinite(measured)
        course, correction = measured[known], replayed.correction[known, k]
        draws = ranges[output.name]
        low, high = np.quantile(draws, [(1.0 - _COVERAGE) / 2.0, (1.0 + _COVERAGE) / 2.0])
        gain, gain_u, explained = _gain(course, correction)
        achieved = float(np.ptp(course))
        is_kept = achieved <= high
        fault, reason = "", ""
        if dead or failed:
            names = ", ".join(f"{name} ({faulty_sensors[name]})" for name in sorted(dead))
            fault, reason = "dead sensor", f"{names} does not measure in this test, and the model reads it"
            if not dead:
                fault, reason = (
                    "outside its range",
                    "a reading was so far outside that the control took its sensor for failed",
                )
        elif not is_kept:
            rest = float(np.ptp(course - (gain - 1.0) * correction))
            found = gain, gain_u, explained
            fault, reason = _explain(after, model, readings, course, known, found, is_gain=rest <= high)
        verdicts.append(
            ChannelVerdict(
                output.name,
                before_um=float(np.ptp(course - (gain if fault in _OF_GAIN else 1.0) * correction)),
                predicted_um=float(np.median(draws)),
                predicted_low_um=float(low),
                predicted_high_um=float(high),
                achieved_um=achieved,
                gain=gain,
                gain_u=gain_u,
                is_kept=is_kept and not fault,
                fault=fault,
                reason=reason,
            )
        )
    return verdicts


def _readings(after: Record, model: Recursion, faulty: Mapping[str, str]) -> Array:
    """Return the readings of a model on the blocks of a record (blocks, inputs); those of a faulty sensor at its reference."""
    columns = []
    for one in model.inputs:
        if one.name in after.sensors:
            columns.append(after.temperature[:, after.sensors.index(one.name)])
        elif one.name in after.drivers and one.name not in faulty:
            columns.append(after.drivers[one.name][1] * after.driver_sizes[one.name][0])
        else:
            columns.append(np.full(after.seconds.size, one.reference))
    return np.column_stack(columns)


def _gain(course: Array, correction: Array) -> tuple[float, float, float]:
    """Return the gain with which a correction acted, its standard uncertainty, and the share of what is left that it takes away.

    Without each piece of the test once: the uncertainty is that of the jackknife, the share is that in the pieces left out.
    """
    pieces = np.array_split(np.arange(course.size), _PIECES)
    whole = _slope(course, correction)
    slopes, left = [], np.empty(course.size)
    for piece in pieces:
        others = np.setdiff1d(np.arange(course.size), piece)
        slope = _slope(course[others], correction[others])
        slopes.append(slope)
        middle = course[others].mean() - slope * correction[others].mean()
        left[piece] = course[piece] - middle - slope * correction[piece]
    u = float(np.sqrt((_PIECES - 1) / _PIECES * np.sum((np.array(slopes) - np.mean(slopes)) ** 2)))
    return 1.0 + whole, u, 1.0 - float(np.mean(left**2)) / max(float(np.var(course)), 1e-12)


def _slope(course: Array, correction: Array) -> float:
    centred = correction - correction.mean()
    return float(centred @ (course - course.mean()) / max(float(centred @ centred), 1e-12))


def _explain(
    after: Record,
    model: Recursion,
    readings: Array,
    course: Array,
    known: NDArray[np.bool_],
    gain: tuple[float, float, float],
    *,
    is_gain: bool,
) -> tuple[str, str]:
    """Return what explains that more is left than was predicted, and the evidence; `is_gain`: but for the gain all is as predicted."""
    value, u, explained = gain
    by_states = _explained_by_states(after, model, readings, course, known)
    told = f"the correction acted with a gain of {value:.2f} ± {2.0 * u:.2f} (k = 2) and explains {100 * max(explained, 0.0):.0f} %"
    limit = float(special.stdtrit(_PIECES - 1, 0.5 + _COVERAGE / 2.0))
    # What the gain leaves may not be explained better by other coefficients: half of what is left beside it, again.
    if is_gain or (explained >= _EXPLAINS and 1.0 - by_states > (1.0 - explained) * (1.0 - _EXPLAINS)):
        nearest = min(_NAMED_GAINS, key=lambda name: abs(_NAMED_GAINS[name] - value))
        if abs(_NAMED_GAINS[nearest] - value) <= max(limit * u, _SAME_GAIN):
            return nearest, told
        return "wrong scale", told
    if by_states >= _EXPLAINS:
        return "stale table", (
            f"the states of the model explain {100 * by_states:.0f} % of what is left, in other proportions than its coefficients "
            f"({told}): the control runs other coefficients than the stated ones, or the machine has changed since"
        )
    return "not explained", f"{told}; the states of the model explain {100 * max(by_states, 0.0):.0f} %"


def _explained_by_states(
    after: Record, model: Recursion, readings: Array, course: Array, known: NDArray[np.bool_]
) -> float:
    """Return the share of what is left that free coefficients of the model's states take away, in pieces that they were not fitted to."""
    states = np.column_stack([_state(model, k, readings) for k in range(len(model.states))])
    record_like = np.full(after.seconds.size, np.nan)
    record_like[known] = course
    alone = replace(after, displacement=record_like[:, None], channels=("left",))
    penalty = predict(alone, states, np.ones(after.seconds.size, bool)).penalty
    left = record_like - predict_left_out(alone, states, penalty)[:, 0]
    return 1.0 - float(np.nanmean(left**2)) / max(float(np.nanvar(record_like)), 1e-12)


def _state(model: Recursion, place: int, readings: Array) -> Array:
    """Return one state of a model over readings, by an output that holds nothing else."""
    weights = tuple(-1.0 if k == place else 0.0 for k in range(len(model.states)))
    free = model.outputs[0].model_copy(update={"coefficients": weights, "limit": np.inf, "max_step": np.inf})
    return run_recursion(model.model_copy(update={"outputs": (free,)}), readings).correction[:, 0]
