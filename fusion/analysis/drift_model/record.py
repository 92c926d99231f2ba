"""The closed loop on a record: sensors examined, candidates made, scored, confirmed and predicted, the result and what remains.

Every channel has a drift and coefficients of its own. Whether an effect is there is asked under a drift in every channel that may
explain the same thing (generalised least squares); it enters only if the parts of the training time that follow are also predicted
better with it. What the model predicts for hours ahead is asked of coefficients that are shrunk together, how strongly decided by forward
chaining: many alike sensors determine their coefficients badly, and such coefficients extrapolate badly. The procedure is that of
:mod:`fusion.analysis.drift_model.search`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.alignment.sensor_health import (
    Kind,
    SensorFault,
    examine_displacements,
    examine_sensors,
    is_implausible,
)
from fusion.analysis.diagnosis.residual import PermutationTest, ResidualStructure, permutation_test
from fusion.analysis.drift_model.admissibility import NOISE_SHARE, refuse
from fusion.analysis.drift_model.fit import SINGLE, Term, place_of, plausible_ratios, scaled_systems, unexplained_drift
from fusion.analysis.drift_model.gains import by_width, profile_gains
from fusion.analysis.drift_model.null_simulation import DRAWS, random_walk, rank_p_value
from fusion.analysis.drift_model.record_data import EXPONENTS, Record, RecordError, independent, reduce_record
from fusion.analysis.drift_model.search import (
    BASELINE_LAGS_MIN,
    BEYOND_PLAIN,
    BUILT_IN,
    HOLD_OUT_SHARE,
    MOST_EFFECTS,
    PENALTIES,
    Answer,
    Confirmation,
    Confirmed,
    Decision,
    Gains,
    LoopState,
    Problem,
    Progress,
    Reason,
    Round,
    Score,
    Unseen,
    answers,
    error_interval,
    errors_of_predictions,
    exceeds_noise,
    excess_um,
    has_skill,
    is_separable,
    left_out_of_forecast,
    no_progress,
    not_confirmed,
    open_hold_out,
    refine,
    score_effects,
    search,
    verdict,
    withdraw,
    withheld_for,
)
from fusion.analysis.effects.effect import LAGS_MIN, Candidate, Effect
from fusion.analysis.effects.events import periods_min
from fusion.analysis.effects.library import library
from fusion.analysis.effects.thermal import QUASI_STATIC, QUASI_STATIC_RESPONSE
from fusion.analysis.levels import RECORD_ENTRY_LEVEL, REMAINDER_LEVEL
from fusion.common import Array
from fusion.results import loop as schema
from interferometry.deviations import ROUNDING
from interferometry.drift.gls import DriftFit, estimate, fit_fixed_effects
from interferometry.drift.kalman import DriftModelError, drift_system

# Predicting hours ahead: coefficients shrunk together, how strongly decided by forward chaining inside the training
# part.

#: Times that runs are left out at most; of more runs several are left out together.
MOST_LEFT_OUT = 8
#: Share of the training blocks that must lie before a part for its prediction to be counted.
_LATER = 0.5


@dataclass(frozen=True)
class Prediction:
    """A prediction of all blocks of a record from some of them.

    Attributes
    ----------
    predicted : (blocks, channels) um
    coefficients : (p, channels) of the columns, um per unit of each
    penalty : the shrinkage that forward chaining chose
    chained_rmse : error of the forward-chained training blocks under it, mean over channels, um; NaN where there is none
    """

    predicted: Array
    coefficients: Array
    penalty: float
    chained_rmse: float


def predict(record: Record, columns: Array, train: NDArray[np.bool_]) -> Prediction:
    """Predict every block of a record from the training blocks alone."""
    asked = folds(record, train)
    errors = np.full((len(asked), PENALTIES.size), np.nan)
    for place, (before, part) in enumerate(asked):
        for k, (predicted, _) in enumerate(_paths(record, columns, before)):
            errors[place, k] = rmse(record, predicted, part)
    mean = known_mean(errors, axis=0)
    best = int(np.argmin(mean)) if np.isfinite(mean).all() else PENALTIES.size // 2
    return Prediction(*_paths(record, columns, train)[best], float(PENALTIES[best]), float(mean[best]))


def folds(record: Record, train: NDArray[np.bool_]) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Blocks that are predicted for the choice of the penalty, and those that they are predicted from."""
    runs = np.unique(record.run[train])
    if runs.size > 1:
        left_out = [np.isin(record.run, some) for some in np.array_split(runs, min(runs.size, MOST_LEFT_OUT))]
        return [(train & ~some, train & some) for some in left_out]
    return [(train & (record.chained < one), train & (record.chained == one)) for one in chained_parts(record, train)]


def last_values(record: Record, train: NDArray[np.bool_]) -> Array:
    """Last training value of every channel in every run; in a run without any, its zero."""
    last = np.zeros(record.displacement.shape)
    for run in range(len(record.first)):
        here = record.run == run
        for channel, column in enumerate(record.displacement.T):
            values = column[train & here & np.isfinite(column)]
            last[here, channel] = values[-1] if values.size else 0.0
    return last


def predict_left_out(record: Record, columns: Array, penalty: float) -> Array:
    """Predict every part of a record, or every run of several, from all others, earlier and later ones."""
    predicted = np.full(record.displacement.shape, np.nan)
    place = int(np.flatnonzero(penalty == PENALTIES)[0])
    numbers = record.run if record.runs else record.chained
    for number in np.unique(numbers):
        part = numbers == number
        predicted[part] = _paths(record, columns, ~part)[place][0][part]
    return predicted


def chained_parts(record: Record, train: NDArray[np.bool_]) -> list[int]:
    """Parts of the training blocks that are predicted from those before them: those of the later half."""
    numbers, counts = np.unique(record.chained[train], return_counts=True)
    before = np.cumsum(counts) - counts
    return [int(number) for number, rows in zip(numbers, before, strict=True) if rows >= _LATER * counts.sum()]


def rmse(record: Record, predicted: Array, where: NDArray[np.bool_]) -> float:
    """Root mean square error over some blocks, mean over the channels that were measured there."""
    return float(known_mean(channel_rmse(record, predicted, where)))


def channel_rmse(record: Record, predicted: Array, where: NDArray[np.bool_]) -> Array:
    """Root mean square error of every channel over some blocks."""
    return np.asarray(np.sqrt(known_mean((record.displacement - predicted)[where] ** 2, axis=0)))


def _paths(record: Record, columns: Array, train: NDArray[np.bool_]) -> list[tuple[Array, Array]]:
    """Predictions (blocks, channels) and coefficients (p, channels) under every penalty."""
    centre, scale = columns[train].mean(axis=0), columns[train].std(axis=0)
    scale = np.where(scale > 0.0, scale, np.inf)
    standard = (columns - centre) / scale
    coefficients = np.zeros((PENALTIES.size, columns.shape[1], len(record.channels)))
    levels = np.zeros((PENALTIES.size, len(record.channels)))
    for channel in range(len(record.channels)):
        here = train & np.isfinite(record.displacement[:, channel])
        if not here.any():
            levels[:, channel] = np.nan
            continue
        x, y = standard[here], record.displacement[here, channel]
        # A channel that misses blocks has its mean where the columns of the others have theirs.
        offset, middle = x.mean(axis=0), float(y.mean())
        values, vectors = np.linalg.eigh((x - offset).T @ (x - offset) / here.sum())
        projected = vectors.T @ ((x - offset).T @ (y - middle) / here.sum())
        coefficients[:, :, channel] = (projected / (np.maximum(values, 0.0) + PENALTIES[:, None])) @ vectors.T
        levels[:, channel] = middle - coefficients[:, :, channel] @ offset
    return [(standard @ one + levels[k], one / scale[:, None]) for k, one in enumerate(coefficients)]


# Digits of the readings: nothing is stated that rounding may look like.


def rounding_steps(record: Record, terms: Sequence[Term], coefficients: Array) -> Array:
    """Steps of every displacement, um: of its own digits, then of those of every temperature by its coefficient (1 + sensors, channels)."""
    per_kelvin = [coefficients[place_of(terms, term)] for term in terms if term.effect == QUASI_STATIC]
    through = np.sum([np.zeros((len(record.sensors), len(record.channels))), *np.abs(per_kelvin)], axis=0)
    return np.vstack([record.displacement_step, record.temperature_step[:, None] * through])


def together(steps: Array) -> Array:
    """Step of every displacement that rounds as much as its independent steps (number, channels) do."""
    return np.asarray(np.linalg.norm(steps, axis=0))


# Plain predictions of a record's hold-out set, which the model has to beat: last value, mean, and regressions on all
# that was logged.


def plain_predictions(record: Record, train: NDArray[np.bool_]) -> dict[str, Array]:
    """Predict every block of a record without a model of the machine."""
    now = np.column_stack([record.rise, *(values for powers in record.drivers.values() for values in powers.values())])
    late = [record.series(now, "1").lagged(60.0 * minutes).values for minutes in BASELINE_LAGS_MIN]
    design = np.column_stack([np.ones(train.size), now])
    least_squares = np.empty(record.displacement.shape)
    for channel, response in enumerate(record.displacement.T):
        here = train & np.isfinite(response)
        # The solution of smallest norm where columns depend on each other.
        least_squares[:, channel] = design @ np.linalg.lstsq(design[here], response[here], rcond=None)[0]
    of_runs = {"mean_run": mean_course(record, train)} if record.runs else {}
    return {
        **of_runs,
        "last_value": last_values(record, train),
        "mean": np.broadcast_to(known_mean(record.displacement[train], axis=0), record.displacement.shape),
        "least_squares": least_squares,
        "ridge": predict(record, now, train).predicted,
        "ridge_with_lags": predict(record, np.column_stack([now, *late]), train).predicted,
    }


#: Readings of the hold-out set that a prediction which tracks is given: often enough for an interval, seldom enough to need a model.
_READINGS = 10


def track(record: Record, train: NDArray[np.bool_], forecast: Array, ridge: Array) -> schema.Tracking:
    """Predict the hold-out set with a reading of all channels from time to time, weighed by the drift of what the forecast misses."""
    held = np.flatnonzero(~train)
    every = max(1, held.size // _READINGS)
    read = train.copy()
    read[held[every - 1 :: every]] = True
    # The last block that was read before each one.
    before = np.maximum.accumulate(np.where(read, np.arange(read.size), 0))[held - 1]
    carried = np.full(record.displacement.shape, np.nan)
    for k in range(len(record.channels)):
        rows = np.flatnonzero(np.isfinite(record.displacement[:, k]))
        seconds, one = record.seconds[rows], np.ones((rows.size, 1))
        off = (record.displacement - forecast)[rows, k]
        # A random walk is carried on at its level: a rate would be carried on as well, and hours ahead it leads astray.
        before_it = train[rows]
        fit = estimate(seconds[before_it], one[before_it], off[before_it], one[before_it], order=1, robust=True)
        told = drift_system(seconds, one, order=1, ratios=fit.system.ratios, observed=read[rows])
        missed, _ = told.innovations(np.column_stack([off, one]))
        carried[rows, k] = missed[:, 0] - missed[:, 1] * fit.coefficients[0]
    last = record.displacement[held] - record.displacement[before]
    errors = {"model": carried[held], "last_reading": last, "ridge": last - (ridge[held] - ridge[before])}
    intervals = {name: error_interval(one, held, np.random.default_rng(1)) for name, one in errors.items()}
    return schema.Tracking(every_min=every * record.block_s / 60.0, **intervals)


def mean_course(record: Record, train: NDArray[np.bool_]) -> Array:
    """Predict every block by the mean of the other training runs at the same time since their start, um (blocks, channels).

    Beyond the end of all others their last mean is kept.
    """
    place = np.arange(record.seconds.size) - np.asarray(record.first)[record.run]
    predicted = np.zeros(record.displacement.shape)
    for run in range(len(record.runs)):
        others = np.flatnonzero(train & (record.run != run))
        course: Array = np.full((int(place.max()) + 1, len(record.channels)), np.nan)
        for at in np.unique(place[others]):
            course[at] = known_mean(record.displacement[others[place[others] == at]], axis=0)
        for k in range(len(record.channels)):
            known = np.flatnonzero(np.isfinite(course[:, k]))
            course[:, k] = np.interp(np.arange(len(course)), known, course[known, k]) if known.size else 0.0
        predicted[record.run == run] = course[place[record.run == run]]
    return predicted


# Hold-out set and declared model of a record.

#: Runs that a sentence names.
_MOST_NAMED = 4


def hold_out(record: Record) -> tuple[NDArray[np.bool_], str]:
    """Divide a record into a training part and a hold-out set: the runs that are held out, or the last fifth of the
    time of a single run.
    """
    if record.runs:
        train = ~np.array([one.held_out for one in record.runs])[record.run]
        named, others = ([one.name for one in record.runs if one.held_out is out] for out in (True, False))
        description = f"{_named(named)} held out; coefficients from {_named(others)}, every run from its own zero"
    else:
        first = record.seconds[0] + (1.0 - HOLD_OUT_SHARE) * (record.seconds[-1] - record.seconds[0])
        train = record.seconds < first
        last_h = record.seconds[-1] / 3600.0
        description = (
            f"{first / 3600.0:.1f} h to {last_h:.1f} h held out; coefficients from the time before, nothing re-zeroed"
        )
    description += "; error is the mean over channels"
    if not np.isfinite(record.displacement[~train]).any():
        raise RecordError(
            f"no displacement was measured in what is held out ({description}); leave the end of the record out"
        )
    return train, description


def _named(runs: Sequence[str]) -> str:
    """Runs in words, the first of them by name."""
    shown = ", ".join(runs[:_MOST_NAMED]) + (f" and {len(runs) - _MOST_NAMED} more" if len(runs) > _MOST_NAMED else "")
    return f"run {shown}" if len(runs) == 1 else f"runs {shown}"


def declare(declared: Sequence[str], record: Record) -> list[Term]:
    """Make the terms of the declared model."""
    for name in declared:
        if name != QUASI_STATIC:
            raise RecordError(
                f'declared effect {name!r} cannot be computed from a record; declare "{QUASI_STATIC}" (every displacement linear '
                "in the temperatures), the search tries the rest of the library"
            )
    return [Term(name, one) for name in declared for one in QUASI_STATIC_RESPONSE.candidates(record.view(), {}, None)]


#: Readings per coefficient that a chained block needs before it, or its prediction says nothing.
_LEAST_PER_COEFFICIENT = 2
#: Blocks per column of one effect; what has more columns is reduced to its principal components for the test.
_PER_COLUMN = 8


@dataclass(frozen=True)
class RecordFit:
    """A model fitted to a part of a record.

    Attributes
    ----------
    record, used : the record, and the blocks (blocks,) that the fit was made from
    terms : the effects, declared ones first; each with columns for all blocks, shared by the channels
    channels : the generalised least-squares fit of every channel under its own drift
    rows : the blocks of each channel's fit, as indices
    """

    record: Record
    used: NDArray[np.bool_]
    terms: tuple[Term, ...]
    channels: tuple[DriftFit, ...]
    rows: tuple[NDArray[np.intp], ...]

    @property
    def levels(self) -> list[int]:
        """Number of each channel's constants, the first columns of its design: one for every run."""
        return [np.unique(self.record.run[rows]).size for rows in self.rows]

    @property
    def sigma(self) -> Array:
        """Noise of one block mean in every channel, um."""
        return np.array([fit.sigma for fit in self.channels])


def columns_of(record: Record, terms: Sequence[Term]) -> Array:
    """Columns of all terms side by side."""
    return np.concatenate([np.empty((record.seconds.size, 0)), *(term.candidate.columns for term in terms)], axis=1)


def fit_record(record: Record, terms: Sequence[Term], used: NDArray[np.bool_]) -> RecordFit:
    """Fit every channel by itself: a constant for every run, terms, and a drift whose order and size come from restricted likelihood."""
    most = int(used.sum()) // _PER_COLUMN
    parts = [_leading(np.asarray(term.candidate.columns), used, most) for term in terms]
    columns = np.concatenate([columns_of(record, []), *parts], axis=1)
    columns = columns[:, independent(columns[used])]
    rng = np.random.default_rng(0)
    fits, rows = [], []
    for k, name in enumerate(record.channels):
        response = record.displacement[:, k]
        here = np.flatnonzero(used & np.isfinite(response))
        design = _with_levels(record, columns, here)
        if here.size < _LEAST_PER_COEFFICIENT * design.shape[1]:
            raise RecordError(
                f'channel "{name}" has {here.size} blocks for a model of {design.shape[1]} coefficients; record for longer, or leave it '
                "out of [record]"
            )
        # A displacement that follows the columns exactly leaves no noise to weigh with: it is given a millionth of its range.
        shaken = response[here] + 1e-6 * np.ptp(response[here]) * rng.standard_normal(here.size)
        fits.append(_estimate(name, record.seconds[here], shaken, design))
        rows.append(here)
    return RecordFit(record, used, tuple(terms), tuple(fits), tuple(rows))


def _estimate(channel: str, seconds: Array, response: Array, design: Array) -> DriftFit:
    """Robust estimate of one channel; where a column differs from others only in outliers, all blocks count alike."""
    loadings = np.ones((seconds.size, 1))
    try:
        return estimate(seconds, loadings, response, design, robust=True)
    except DriftModelError:
        pass
    try:
        return estimate(seconds, loadings, response, design)
    except DriftModelError as error:
        raise RecordError(
            f'channel "{channel}" cannot be fitted ({error}); leave it, or sensors that hardly move, out of [record]'
        ) from None


def _with_levels(record: Record, columns: Array, here: NDArray[np.intp]) -> Array:
    """Design of one channel at its blocks: a constant for every run, then the columns."""
    run = record.run[here]
    later = np.unique(run)[1:]
    if not later.size:
        return np.column_stack([np.ones(here.size), columns[here]])
    levels = (run[:, None] == later).astype(float)
    both = np.column_stack([levels, columns[here]])
    return np.column_stack([np.ones(here.size), both[:, independent(both)]])


def _leading(columns: Array, used: NDArray[np.bool_], most: int) -> Array:
    """The columns, or where there are more than `most` their leading principal components over the used blocks (blocks, most)."""
    if columns.shape[1] <= most:
        return columns
    centre, scale = columns[used].mean(axis=0), columns[used].std(axis=0)
    standard = (columns - centre) / np.where(scale > 0.0, scale, np.inf)
    _, _, directions = np.linalg.svd(standard[used], full_matrices=False)
    return np.asarray(standard @ directions[:most].T)


def simulate_channels(model: RecordFit, rng: np.random.Generator, *, draws: int) -> list[Array]:
    """Simulate displacements in which only the model's drifts and noise act."""
    noises, shocks = [], []
    for fit in model.channels:
        noise, share = fit.noise()
        noises.append(noise / np.sqrt(np.maximum(share, 1e-12)))
        whitened, _ = fit.system.whiten(fit.residual()[:, None])
        shocks.append(whitened[:, 0])
    blocks = model.record.seconds.size
    laid = np.full((blocks, len(noises)), np.nan)
    for k, rows in enumerate(model.rows):
        laid[rows, k] = shocks[k]
    root = np.linalg.cholesky(_correlation(laid) + 1e-6 * np.eye(len(noises)))
    correlated = rng.standard_normal((2, blocks, draws, len(noises))) @ root.T
    picked = rng.integers(0, blocks, (blocks, draws))
    simulated = []
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        pool = np.zeros(blocks)
        pool[rows] = noises[k]
        drawn = pool[picked[rows]] * np.sqrt(fit.system.variance)[:, None]
        ratios = plausible_ratios(fit, rng, draws=draws)[:, 0]
        first, second = correlated[..., k][:, rows]
        (walk,) = random_walk(fit.system, [(first, second)])
        drawn += fit.sigma * np.sqrt(ratios) * walk
        simulated.append(drawn)
    return simulated


def _correlation(shocks: Array) -> Array:
    """Correlation of the channels' shocks (blocks, channels), NaN where one is missing; none where too few blocks hold all of them."""
    channels = shocks.shape[1]
    known = shocks[np.isfinite(shocks).all(axis=1)]
    if channels == 1 or known.shape[0] <= channels or not known.std(axis=0).all():
        return np.eye(channels)
    clipped = np.clip(known / known.std(axis=0), -3.0, 3.0)
    return np.corrcoef(clipped.T) if clipped.std(axis=0).all() else np.eye(channels)


def channel_gains(model: RecordFit, candidates: Sequence[Candidate], draws: Sequence[Array] = ()) -> Gains:
    """Gain in log-likelihood of every candidate, all channels together."""
    draws = draws or [np.empty((rows.size, 0)) for rows in model.rows]
    total = np.zeros((len(candidates), 1 + draws[0].shape[1]))
    separable = np.zeros(len(candidates), bool)
    for fit, rows, drawn in zip(model.channels, model.rows, draws, strict=True):
        here = np.zeros(model.record.seconds.size, bool)
        here[rows] = True
        gains = profile_gains(
            scaled_systems(fit, SINGLE),
            np.column_stack([fit.response, drawn]),
            fit.design,
            by_width(candidates, here),
        )
        total += np.where(gains.separable[:, None], gains.gain, 0.0)
        separable |= gains.separable
    widths = np.array([candidate.columns.shape[1] for candidate in candidates])
    penalty = len(model.channels) * (widths - 1.0)
    return Gains(total - penalty[:, None], np.zeros(len(candidates), int), separable)


# The library of effects for a record: the same physics as along an axis, every channel with coefficients of its own.

#: Name of the mean of all sensors among the sensors that may lag.
MEAN = "mean of all"
#: A load acts at once (bearings widen with the speed), warms the part beside it, then what that part is joined to: states a factor of
#: four apart in their time constants.
SOURCE_CHAIN = (0.0, 0.25, 1.0, 4.0)
#: Time constants of the middle part, min.
_SOURCE_MIN = (5.0, 10.0, 20.0, 40.0, 80.0)
#: An event needs this share of the record on either side to be told from a drift.
_EVENT_MARGIN = 0.05
#: Instants at which an event is tried.
_EVENT_INSTANTS = 200
#: Shares of a block that a closer look tries as the part of it that lies after an event; coarser, and one event needs two steps.
_SHARES = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
#: Fewer periods than this are no rhythm: any slow drift looks like them.
_LEAST_PERIODS = 6.0


def _thermal_lag(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """Lagged copies of one sensor, or of the mean of all."""
    block_min = record.block_s / 60.0
    named = {name: record.rise[:, k] for k, name in enumerate(record.sensors)}
    named[MEAN] = record.rise.mean(axis=1)
    for name, rise in named.items():
        if near is not None and near.parameters["sensor"] != name:
            continue
        for minutes in _around(near, LAGS_MIN):
            if minutes >= 2.0 * block_min:
                lagged = record.series(rise, "K").lagged(60.0 * minutes).values
                yield Candidate(lagged[:, None], {"sensor": name, "time_constant_min": minutes}, ("um/K",))


def _unseen_heat_source(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """States of a chain of parts that a driver heats, in proportion to the driver and to its square."""
    for name, powers in record.drivers.items():
        if near is not None and near.parameters["follows"] != name:
            continue
        for minutes in _around(near, _SOURCE_MIN):
            states = [
                record.series(powers[exponent], "1").lagged(60.0 * minutes * share).values
                for share in SOURCE_CHAIN
                for exponent in EXPONENTS
            ]
            parameters: dict[str, float | str] = {
                "follows": name,
                "time_constant_min": minutes,
                "chain": "at once, " + ", ".join(f"{minutes * share:.3g} min" for share in SOURCE_CHAIN[1:]),
            }
            yield Candidate(np.column_stack(states), parameters, ("um",) * len(states))


def _step_event(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """A level shift at one instant, in every channel by its own amount."""
    first, last = record.seconds[0], record.seconds[-1]
    margin = _EVENT_MARGIN * (last - first)
    if near is None or near.event_s is None:
        every = max(1, record.seconds.size // _EVENT_INSTANTS)
        instants = record.seconds[::every]
    else:
        instants = record.seconds[np.abs(record.seconds - near.event_s) <= 0.01 * (last - first)]
    for instant in instants:
        if not first + margin <= instant <= last - margin:
            continue
        for share in (0.0,) if near is None else _SHARES:
            late = (record.seconds >= instant).astype(float)
            place = int(np.argmax(late))
            # The first block of a run has none before it that the event could lie in.
            before = share if record.run[place - 1] == record.run[place] else 0.0
            late[place - 1] = before
            # The instant is the middle of the first block that lies after the event as a whole.
            time_s = float(instant - (0.5 + before) * record.block_s)
            yield Candidate(late[:, None], {"time_s": time_s}, ("um",), float(instant))


def _happened_s(candidate: Candidate) -> float | None:
    """When an event happened, s since the start; None for an effect that lasts."""
    return None if candidate.event_s is None else float(candidate.parameters.get("time_s", candidate.event_s))


def _periodic_disturbance(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """Waves in time; of several runs none, as nothing says at which phase the next run begins."""
    if record.runs:
        return
    shortest = 4.0 * record.block_s / 60.0
    if near is None:
        periods = periods_min(record.view())
    else:
        span = float(record.seconds[-1] - record.seconds[0]) / 60.0
        periods = 1.0 / (1.0 / float(near.parameters["period_min"]) + np.linspace(-0.5, 0.5, 21) / span)
    longest = float(record.seconds[-1] - record.seconds[0]) / 60.0 / _LEAST_PERIODS
    for period in periods[(periods >= shortest) & (periods <= longest)]:
        phase = 2 * np.pi * record.seconds / (60.0 * period)
        yield Candidate(np.column_stack([np.cos(phase), np.sin(phase)]), {"period_min": float(period)}, ("um", "um"))


def _around(near: Candidate | None, grid: tuple[float, ...]) -> tuple[float, ...]:
    if near is None:
        return grid
    chosen = float(near.parameters["time_constant_min"])
    return tuple(float(chosen * factor) for factor in np.geomspace(0.6, 1.6, 7))


_CANDIDATES = {
    "thermal_lag": _thermal_lag,
    "unseen_heat_source": _unseen_heat_source,
    "step_event": _step_event,
    "periodic_disturbance": _periodic_disturbance,
}


def candidates_of(effect: Effect, record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """Columns (blocks, q) that every channel follows with its own coefficients; a user's effect makes them of the record's readings."""
    if effect.name in _CANDIDATES:
        return _CANDIDATES[effect.name](record, near)
    return effect.candidates(record.view(), {}, near)


def needs_of(effect: Effect, record: Record) -> str | None:
    """Why an effect cannot be tried with this record, or None."""
    if effect.name not in _CANDIDATES:
        return effect.needs(record.view())
    if effect.name == "unseen_heat_source" and not record.drivers:
        return "nothing that drives a heat source was logged; name speed, load or duty as record.drivers"
    if effect.name == "periodic_disturbance" and record.runs:
        return (
            "of several runs, what restarts with each of them cannot be told from a rhythm; name one run as record.file"
        )
    return None


def record_library(effects: Mapping[str, Effect] | None = None) -> tuple[dict[str, Effect], dict[str, str]]:
    """Effects that can act in a record, and why the others of the library are not tried."""
    offered = library() if effects is None else effects
    not_tried = {name: "a record has no positions" for name in offered if name in BUILT_IN - _CANDIDATES.keys()}
    # A sensor that jumps is left out before.
    not_tried |= {name: "the sensors are examined before the search" for name in not_tried if name == "sensor_fault"}
    return {name: effect for name, effect in offered.items() if name not in not_tried}, not_tried


# Grounds of a record: excitation by its drivers, noise of its sensors, and the course of a delayed sensor.

#: A driver of which a single step explains more than this share was switched only once.
_ONE_SWITCHING = 0.99


class RecordGrounds:
    """Grounds of a record: the record and a model of it without the candidate.

    Parameters
    ----------
    model : RecordFit
        Without the candidate.
    least_gain : float
        Log-likelihood that an event has to gain beside a shift at a switching, or it only stands in for that one.
    """

    def __init__(self, model: RecordFit, *, least_gain: float = 0.0) -> None:
        self._model = model
        self._record = model.record
        self._least_gain = least_gain

    def is_admissible(self, candidate: Candidate) -> bool:
        """Whether nothing speaks against a candidate before any fit: it is no event at a switching, and no lag of a noisy sensor."""
        if candidate.event_s is not None:
            return not self._is_switched(candidate.event_s)
        if "sensor" not in candidate.parameters:
            return True
        _, noise, limit = self.noise_of_lag(candidate)
        return noise <= limit

    def _is_switched(self, event_s: float) -> bool:
        return bool(self._record.switched()[np.searchsorted(self._record.seconds, event_s)])

    def at_switching(self, candidate: Candidate) -> float | None:
        """Hours since the start of the switching at which an event happened, or whose response it stands in for."""
        if candidate.event_s is None:
            return None
        if self._is_switched(candidate.event_s):
            return float(_happened_s(candidate) or 0.0) / 3600.0
        if self._least_gain <= 0.0:
            return None
        record = self._record
        shifts = [
            Candidate(
                (record.seconds >= instant).astype(float)[:, None],
                {"time_s": float(instant - 0.5 * record.block_s)},
                ("um",),
                float(instant),
            )
            for instant in record.seconds[record.switched() & self._model.used]
        ]
        if not shifts:
            return None
        rival = shifts[int(np.argmax(channel_gains(self._model, shifts).gain[:, 0]))]
        both = replace(candidate, columns=np.column_stack([candidate.columns, rival.columns]), beside=1)
        gain = float(channel_gains(self._model, [both]).gain[0, 0])
        return None if gain >= self._least_gain else float(_happened_s(rival) or 0.0) / 3600.0

    def heat_is_logged(self) -> bool:
        """Whether a driver was logged."""
        return bool(self._record.drivers)

    def noise_of_lag(self, candidate: Candidate) -> tuple[str, float, float]:
        """Noise of a block mean of the delayed sensor over the range of its rise."""
        name = str(candidate.parameters["sensor"])
        record = self._record
        if name in record.sensors:
            noise = float(record.temperature_noise[record.sensors.index(name)])
        else:
            noise = float(np.sqrt(np.mean(record.temperature_noise**2) / len(record.sensors)))
        rise = _sensor_rise(record, name)[self._model.used]
        return name, noise / max(float(np.ptp(rise)), 1e-12), NOISE_SHARE

    def refuse_single_excitation(self, effect: str, excited_by: str, candidate: Candidate) -> Decision | None:
        """Refuse a source whose driver was switched only once: all single warm-ups are alike."""
        if excited_by != "driver":
            return None
        driver = str(candidate.parameters["follows"])
        share = one_switching_share(self._record.drivers[driver][1][self._model.used])
        if share <= _ONE_SWITCHING:
            return None
        return Decision(effect, Reason.SINGLE_SWITCHING, {"driver": driver, "share_percent": 100.0 * share})

    def follows_rate(self, candidate: Candidate) -> bool:
        """Whether most of what a delayed copy explains is the sensor's rate, or acts before the sensor."""
        model = self._model
        rise = _sensor_rise(self._record, str(candidate.parameters["sensor"]))
        weight = {True: 0.0, False: 0.0}
        for fit, rows, levels in zip(model.channels, model.rows, model.levels, strict=True):
            course = rise[rows] - rise[rows].mean()
            size = fit.design.shape[1]
            together = fit_fixed_effects(
                fit.system, fit.response, np.column_stack([fit.design, candidate.columns[rows]])
            )
            delayed = float(together.coefficients[-1])
            own = slice(levels, size)
            share = fit.design[:, own].T @ course / max(float(course @ course), 1e-300)
            alone, beside = (float(share @ each.coefficients[own]) for each in (fit, together))
            alone_u = float(np.sqrt(share @ fit.covariance[own, own] @ share))
            cancels = beside * delayed < 0.0 and abs(beside + delayed) < 0.5 * max(abs(beside), abs(delayed))
            leads = alone * delayed < 0.0 and abs(alone) > 2.0 * alone_u
            weight[cancels or leads] += abs(delayed) / max(fit.sigma, 1e-12)
        return weight[True] > weight[False]

    def advantage_over_smoothing(self, candidate: Candidate) -> float:
        """Gain over the sensor averaged over a window as wide as the lag's memory."""
        rise = _sensor_rise(self._record, str(candidate.parameters["sensor"]))
        smooth = _smoothed(self._record, rise, float(candidate.parameters["time_constant_min"]))
        gains = channel_gains(self._model, [candidate, Candidate(smooth[:, None], {}, ("um/K",))])
        return float(gains.gain[0, 0] - gains.gain[1, 0])


def _sensor_rise(record: Record, name: str) -> Array:
    """Rise of one sensor, or of the mean of all, K (blocks,)."""
    return record.rise[:, record.sensors.index(name)] if name in record.sensors else record.rise.mean(axis=1)


def _smoothed(record: Record, values: Array, minutes: float) -> Array:
    """Mean over a centred window as wide as the lag's memory, without delay, (blocks,)."""
    half = max(1, round(60.0 * minutes / record.block_s))
    place = np.arange(values.size)
    begin = np.asarray(record.first)[record.run]
    end = np.array([*record.first[1:], values.size])[record.run]
    first, last = np.maximum(place - half, begin), np.minimum(place + half + 1, end)
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((total[last] - total[first]) / (last - first))


def one_switching_share(driver: Array) -> float:
    """Share of a driver's variance that the best single step explains."""
    n = driver.size
    before = np.cumsum(driver)[:-1]
    count = np.arange(1, n)
    between = (before / count - (driver.sum() - before) / (n - count)) ** 2 * count * (n - count) / n
    return float(between.max() / max(float(((driver - driver.mean()) ** 2).sum()), 1e-300))


#: An effect must bring the error of predicting later parts down to this share of what it was, or it only follows chance.
MAX_ERROR_RATIO_TO_ENTER = 0.98
#: An event may make that error larger by this factor: chance, not harm.
MAX_ERROR_RATIO_OF_EVENT = 1.01
RecordState = LoopState[RecordFit]


class RecordProblem(Problem[RecordFit]):
    """A record, the blocks of it that may be used, and the library, for :mod:`fusion.analysis.drift_model.search`."""

    effects: Mapping[str, Effect]
    entry_level = RECORD_ENTRY_LEVEL

    def __init__(
        self,
        record: Record,
        train: NDArray[np.bool_],
        effects: Mapping[str, Effect] | None,
        rng: np.random.Generator,
    ) -> None:
        self.record, self.train, self.rng = record, train, rng
        self.effects, self._not_tried = record_library(effects)

    def start(self, declared: Sequence[Term]) -> RecordState:
        """The state before the search: the declared model, and the effects that this record cannot show."""
        missing = {name: needs_of(effect, self.record) for name, effect in self.effects.items()}
        return RecordState(fit_record(self.record, declared, self.train)).without_effects(
            {**self._not_tried, **missing}
        )

    def refit(self, model: RecordFit, terms: Sequence[Term]) -> RecordFit:
        """Fit other terms to the blocks that a model was fitted to."""
        return fit_record(self.record, terms, model.used)

    def score(self, state: RecordState) -> Round:
        """Score the library under drifts that wander by themselves in every channel."""
        model = state.model
        families, faults = self.families(state, self.record.seconds.size)
        start = self.predict(model.terms).chained_rmse
        if not families:
            return Round((), tuple(faults), start)
        draws = simulate_channels(model, self.rng, draws=DRAWS)
        gains = channel_gains(model, [candidate for candidates in families.values() for candidate in candidates], draws)
        scores, decisions = score_effects(
            families, gains, level=RECORD_ENTRY_LEVEL, is_admissible=RecordGrounds(model).is_admissible
        )
        return Round(tuple(scores), (*faults, *decisions), start)

    def refuse(self, score: Score, model: RecordFit) -> Decision | None:
        """Refuse an effect that this record does not identify; a user's own effect is only held against the switchings."""
        terms = [*model.terms, Term(score.name, score.best)]
        fitted = self.predict(terms).coefficients
        moved = np.ptp(score.best.columns @ fitted[place_of(terms, terms[-1])], axis=0)
        step = together(rounding_steps(self.record, terms, fitted))
        if (moved < step).all():
            largest = int(np.argmax(moved))
            return Decision(
                score.name, Reason.WITHIN_DIGITS, {"range_um": float(moved[largest]), "step_um": float(step[largest])}
            )
        excited_by = self.effects[score.name].excited_by if score.name in BUILT_IN else ""
        return refuse(score.name, excited_by, score.best, RecordGrounds(model, least_gain=score.critical))

    def confirm(self, score: Score, state: RecordState) -> Score:
        """Look at the effect more closely, and predict the later parts of the training time with it."""
        score = refine(score, partial(self.near, score.name, state.model), partial(channel_gains, state.model))
        before = state.rounds[-1].start_error_um
        after = self.predict([*state.model.terms, Term(score.name, score.best)]).chained_rmse
        # A level shift is learnt again by the coefficients of the next part, so an event must only not harm.
        passed = (
            after < MAX_ERROR_RATIO_TO_ENTER * before
            or (score.is_event and after <= MAX_ERROR_RATIO_OF_EVENT * before)
            or not np.isfinite(after)
        )
        return replace(score, confirmation=Confirmation(passed, Confirmed.LATER_PARTS, error_um=after))

    def loss_without(self, model: RecordFit, term: Term) -> float:
        """Log-likelihood lost without a term."""
        without = self.refit(model, [other for other in model.terms if other is not term])
        gains = channel_gains(without, [term.candidate])
        return float(gains.gain[0, 0]) if gains.separable[0] else 0.0

    def hold_out_error(self, terms: Sequence[Term]) -> float:
        """Error of predicting the blocks that may not be used, mean over the channels, um."""
        return float(known_mean(channel_rmse(self.record, self.predict(terms).predicted, ~self.train)))

    def predict(self, terms: Sequence[Term]) -> Prediction:
        """Predict all blocks from the training part."""
        return predict(self.record, columns_of(self.record, terms), self.train)

    def offer(self, name: str, model: RecordFit, near: Candidate | None) -> list[Candidate]:
        """Candidates of an effect that vary over the training part."""
        offered = candidates_of(self.effects[name], self.record, near)
        return [one for one in offered if (np.ptp(one.columns[self.train], axis=0) > 0.0).all()]


class ChainedResult(schema.ChainedPart):
    """One part of a record, predicted from all before it by a search that had not seen it."""

    channel_rmse_final_um: Array
    """(channels,) errors of the final model."""


@threadpool_limits.wrap(limits=1, user_api="blas")
def search_record(
    record: Record,
    train: NDArray[np.bool_],
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> tuple[RecordProblem, RecordState]:
    """Search the library for what the declared terms lack, on the training part alone."""
    problem = RecordProblem(record, train, effects, np.random.default_rng(seed))
    return problem, search(problem, problem.start(declared), progress=progress)


def chain_forward(
    record: Record,
    declared: Sequence[Term],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> list[ChainedResult]:
    """Predict every part of the record from the third on by the whole procedure applied to the time before it; runs from the other runs."""
    train, _ = hold_out(record)
    parts = []
    asked = chained_folds(record, train)
    for done, (before, part) in enumerate(asked):
        progress(done, len(asked), "predicting part after part")
        problem, state = search_record(record, before, declared, seed=seed, effects=effects)
        hours = record.seconds[part] / 3600.0
        final_um = channel_rmse(record, problem.predict(state.model.terms).predicted, part)
        runs: dict[str, Any] = (
            {"runs": tuple(record.runs[run].name for run in np.unique(record.run[part]))} if record.runs else {}
        )
        parts.append(
            ChainedResult(
                first_h=hours[0],
                last_h=hours[-1],
                in_training=bool(train[part].all()),
                effects=tuple(step.effect for step in state.steps),
                **runs,
                rmse_persistence_um=known_mean(channel_rmse(record, last_values(record, before), part)),
                rmse_declared_um=known_mean(channel_rmse(record, problem.predict(state.declared).predicted, part)),
                rmse_final_um=known_mean(final_um),
                channel_rmse_final_um=final_um,
            )
        )
    return parts


def chained_folds(record: Record, train: NDArray[np.bool_]) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Parts that the whole procedure predicts, and what it predicts them from."""
    if np.unique(record.run[train]).size > 1:
        return folds(record, train)
    within = train if record.runs else np.ones_like(train)
    return [
        (within & (record.chained < one), within & (record.chained == one))
        for one in np.unique(record.chained[within])[2:]
    ]


# Structure in the residual of a record: permutation tests, and a description in words.

#: What may be left beside the noise of a block mean, as a multiple of it: three standard deviations, beyond which a block is off by more
#: than noise.
RESIDUAL_SHARE = 3.0
_COURSE, _RHYTHM, _SWITCHING = "autocorrelation", "periodicity", "switching"
_WORDS = {
    _COURSE: "changes that come and go within a few blocks, too quick for the drift",
    _SWITCHING: "quick responses where a driver is switched",
}
#: What a run shows of a wave that may be called a rhythm, in periods.
_LEAST_WAVES = 2.0
#: Fewest runs whose courses are compared, and draws of the comparison.
_LEAST_ALIKE, _ALIKE_DRAWS = 3, 199
_REPEATED = "a course that repeats with every run"
_SLOW = "a slow change over the record"
#: A wave that holds this share of the course's variance is a rhythm, whatever else is left.
_RHYTHM_SHARE = 0.5
_LAGS = 12
_CLIP = 4.0


@dataclass(frozen=True)
class RecordRemainder(ResidualStructure):
    """What a model of a record leaves, with the share of each displacement's variance that it leaves in the hold-out set (channels,)."""

    variance_share: Array


def noise_floor(sigma: Array, step: Array) -> Array:
    """Noise of a block mean in every channel, um: no less than the standard deviation of rounding to its step."""
    return np.maximum(sigma, ROUNDING * step)


def examine(model: RecordFit, hold_out_rmse: Array, step: Array, rng: np.random.Generator) -> RecordRemainder:
    """Test what is left beyond rounding to steps (channels,), um."""
    record = model.record
    innovations = np.zeros(record.displacement.shape)
    # Rounding moves a reading by up to half a step, here in units of the innovations.
    half = 0.5 * step
    is_larger = False
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        whitened, _ = fit.system.whiten(fit.residual()[:, None])
        scale = 1.4826 * np.median(np.abs(whitened)) or 1.0
        innovations[rows, k] = np.clip(whitened[:, 0] / scale, -_CLIP, _CLIP)
        is_larger |= bool(np.sqrt(np.mean(whitened**2)) > half[k])
        half[k] /= scale
    innovations -= innovations.mean(axis=0)
    switched = record.switched()
    test = _test(innovations, switched, rng)
    share = hold_out_rmse**2 / np.nanvar(record.displacement, axis=0)
    words = _shapes(test, innovations, record, half, rng) if is_larger and test.p_value < REMAINDER_LEVEL else []
    noise = noise_floor(model.sigma, step)
    error_um, noise_um = float(np.sqrt(known_mean(hold_out_rmse**2))), float(np.sqrt(np.mean(noise**2)))
    if exceeds_noise(error_um, noise_um, RESIDUAL_SHARE):
        words.append(
            f"a slow drift that neither temperatures nor drivers follow, largest in {_largest(record, hold_out_rmse)}"
        )
    shape = " and ".join(words)
    return RecordRemainder(
        test.p_value, test.p_values, shape, float(known_mean(hold_out_rmse)) if words else 0.0, share
    )


def _test(innovations: Array, switched: NDArray[np.bool_], rng: np.random.Generator) -> PermutationTest:
    """Three statistics of the innovations (blocks, channels), blocks being exchangeable where only drift and noise act."""
    return permutation_test(
        innovations, lambda matrix: _statistics(matrix, switched), rng.permutation, names=(_COURSE, _RHYTHM, _SWITCHING)
    )


def _repeats(innovations: Array, record: Record, rng: np.random.Generator) -> bool:
    """Whether the leading course is alike in all runs at the same time since their start, more than shifted ones are."""
    if len(record.runs) < _LEAST_ALIKE:
        return False
    course = _leading_course(innovations)
    runs = [course[rows] for rows in np.split(np.arange(course.size), record.first[1:])]
    length = min(one.size for one in runs)

    def alike(shifts: NDArray[np.integer]) -> float:
        shifted = np.array([np.roll(one, shift)[:length] for one, shift in zip(runs, shifts, strict=True)])
        return float((shifted.sum(axis=0) ** 2).sum())

    drawn = [alike(rng.integers(0, length, len(runs))) for _ in range(_ALIKE_DRAWS)]
    return rank_p_value(alike(np.zeros(len(runs), int)), np.array(drawn)) < REMAINDER_LEVEL


def _shapes(
    test: PermutationTest, innovations: Array, record: Record, half: Array, rng: np.random.Generator
) -> list[str]:
    """What a significant test shows, in words; beside a rhythm what is larger than half a step (channels,)."""
    if _repeats(innovations, record, rng):
        return [_REPEATED]
    if test.p_values[_RHYTHM] >= REMAINDER_LEVEL:
        return [_WORDS[test.strongest]]
    frequency, left, share = _without_wave(innovations)
    longest = max(np.diff([*record.first, innovations.shape[0]]))
    if frequency * longest < _LEAST_WAVES:
        # No run shows it twice.
        return [_WORDS.get(test.strongest, _WORDS[_COURSE]) if test.p_values[_COURSE] < REMAINDER_LEVEL else _SLOW]
    rest = _test(left, record.switched(), rng)
    if share < _RHYTHM_SHARE and rest.p_values[_COURSE] < REMAINDER_LEVEL:
        return [_WORDS[_COURSE if test.strongest == _RHYTHM else test.strongest]]
    words = [f"a rhythm of about {record.block_s / 60.0 / frequency:.0f} min"]
    is_larger = (np.sqrt(np.mean(left**2, axis=0)) > half).any()
    is_told = is_larger and rest.p_value < REMAINDER_LEVEL and rest.strongest in _WORDS
    return [*words, _WORDS[rest.strongest]] if is_told else words


def _without_wave(innovations: Array) -> tuple[float, Array, float]:
    """Frequency per block of the strongest wave, the innovations without it, and its share of the leading course's variance."""
    blocks = np.arange(innovations.shape[0])
    course = _leading_course(innovations)
    line = _strongest_line(course)[0]

    def wave(frequency: float) -> Array:
        phase = 2.0 * np.pi * frequency * blocks
        return np.column_stack([np.cos(phase), np.sin(phase)])

    def left(frequency: float, values: Array) -> Array:
        return np.asarray(values - wave(frequency) @ np.linalg.lstsq(wave(frequency), values, rcond=None)[0])

    near = (line + np.linspace(-0.5, 0.5, 21)) / blocks.size
    best = float(min(near, key=lambda one: float((left(one, course) ** 2).sum())))
    share = 1.0 - float((left(best, course) ** 2).sum()) / float(course @ course)
    return best, left(best, innovations), share


def _leading_course(innovations: Array) -> Array:
    """The channels' leading common course (blocks,)."""
    u, s, _ = np.linalg.svd(innovations, full_matrices=False)
    return np.asarray(u[:, 0] * s[0])


def _strongest_line(course: Array) -> tuple[int, float]:
    """Number of the strongest line of a course's spectrum, and its power over the mean of all lines."""
    spectrum = np.abs(np.fft.rfft(course))[1 : course.size // 2] ** 2
    return int(np.argmax(spectrum)) + 1, float(spectrum.max() / spectrum.mean())


def _statistics(innovations: Array, switched: NDArray[np.bool_]) -> Array:
    """Three statistics of the channels' leading common course that grow with structure."""
    course = _leading_course(innovations)
    n = course.size
    power = float(course @ course) / n
    autocorrelation = np.array([float(course[k:] @ course[:-k]) / n / power for k in range(1, _LAGS + 1)])
    near = course[switched] ** 2
    excess = float(near.mean() / power) if near.size else 0.0
    return np.array([float((autocorrelation**2).sum()), _strongest_line(course)[1], excess])


def _largest(record: Record, rmse: Array) -> str:
    """Channels with the larger errors, in words."""
    strong = [name for name, error in zip(record.channels, rmse, strict=True) if error >= 0.7 * np.nanmax(rmse)]
    return "all channels alike" if 1 < len(strong) == len(record.channels) else ", ".join(strong)


@dataclass(frozen=True)
class RecordResult:
    """Result of the closed loop on a record.

    Attributes
    ----------
    state : what the search on the training part found, effects that were withdrawn left out
    record : the record on its blocks
    hold_out : (blocks,) True for the hold-out set
    held_out : which part that is, in words
    predictions : of the declared model and after every added effect, from the training part
    errors : (1 + effects, channels) their errors on the hold-out set, um
    plain : (blocks, channels) each, plain predictions from the training part, by name
    left_out : (blocks, channels) each, predictions of every part from all others, um: by the final model, then without each of its effects
    whole : the final model fitted to all blocks, for its residual
    remainder : structure that the final model leaves
    chained : every part from the third on, predicted by the whole procedure on the time before it; runs from the other runs
    answers : what blocks that the coefficients were not fitted to say of every added effect
    away : places of the effects that left the forecast
    forecast : prediction with the others, from the training part
    steps : (1 + sensors, channels) of its displacements, um, as `rounding_steps` gives them
    tracking : errors with a reading from time to time, None for several runs
    wandering_um : root mean square of the random drift beside the final model, mean over the channels, um
    """

    state: RecordState
    record: Record
    hold_out: NDArray[np.bool_]
    held_out: str
    predictions: list[Prediction]
    errors: Array
    plain: Mapping[str, Array]
    left_out: list[Array]
    whole: RecordFit
    remainder: RecordRemainder
    chained: list[ChainedResult]
    answers: list[Answer]
    away: set[int]
    forecast: Prediction
    steps: Array
    tracking: schema.Tracking | None
    wandering_um: float

    @property
    def noise(self) -> Array:
        """Noise of a block mean (channels,), um."""
        return noise_floor(self.whole.sigma, together(self.steps))

    @property
    def noise_um(self) -> float:
        """Noise of a block mean, mean over the channels, um."""
        return float(np.mean(self.noise))

    @property
    def cross_um(self) -> list[float]:
        """Error of predicting every part from all others, um: of the final model, then without each of its effects."""
        everywhere = np.ones(self.hold_out.size, bool)
        return [rmse(self.record, predicted, everywhere) for predicted in self.left_out]

    @property
    def hold_out_intervals(self) -> dict[str, schema.ErrorInterval]:
        """Errors on the hold-out set with their intervals: of the declared and the final model, and of plain predictions."""
        final = self.forecast.predicted
        predicted = {"declared": self.predictions[0].predicted, "final": final, **self.plain}
        rows = np.flatnonzero(self.hold_out)
        errors = {name: (self.record.displacement - values)[rows] for name, values in predicted.items()}
        return {name: error_interval(one, rows, np.random.default_rng(1)) for name, one in errors.items()}

    @property
    def final_um(self) -> Array:
        """Error of the forecast on the hold-out set (channels,), um."""
        return channel_rmse(self.record, self.forecast.predicted, self.hold_out)

    def _plain_errors(self, here: NDArray[np.bool_]) -> tuple[float, float]:
        """Errors of repeating the last value, and of the better mean: of all values, or of the other runs' courses, um."""
        errors = {name: rmse(self.record, predicted, here) for name, predicted in self.plain.items()}
        return errors["last_value"], min(errors["mean"], errors.get("mean_run", np.inf))

    @property
    def falls_short(self) -> bool:
        """Whether there is a name, and the final error exceeds the noise and that of the best plain prediction."""
        final = float(known_mean(self.final_um))
        exceeds = exceeds_noise(final, self.noise_um, RESIDUAL_SHARE)
        plain = min(rmse(self.record, one, self.hold_out) for one in self.plain.values())
        return any(self._kept) and exceeds and final > plain

    @property
    def _kept(self) -> list[bool]:
        """For every step whether its name stands."""
        steps = zip(self.answers, self.state.steps, strict=True)
        return [one.word != "no" and not withheld_for(step) for one, step in steps]

    @property
    def verdict(self) -> schema.Verdict:
        """Word for the outcome."""
        return self._verdict(self.hold_out, remains=bool(self.remainder.shape) or self.falls_short)

    def separable(self, here: NDArray[np.bool_]) -> bool:
        """Whether a cause can be named: ridge regression with lagged copies does not predict these blocks better by a quarter."""
        compared = (self.forecast.predicted, self.plain["ridge_with_lags"])
        return is_separable(*(rmse(self.record, one, here) for one in compared))

    def _verdict(self, here: NDArray[np.bool_], *, remains: bool) -> schema.Verdict:
        final, plain = rmse(self.record, self.forecast.predicted, here), self._plain_errors(here)
        return verdict(
            named=any(self._kept),
            left=remains or not all(self._kept),
            tested=bool(self.state.unnamed(RECORD_ENTRY_LEVEL)) or self.remainder.is_tested,
            skill=has_skill(final, *plain, self.noise_um, RESIDUAL_SHARE),
            separable=self.separable(here),
        )

    def _run(self, number: int) -> schema.RunPart:
        """One run, judged by its own errors where it is held out."""
        described, here = self.record.runs[number], self.record.run == number
        time = self.record.time[here]
        last = declared = final = np.nan
        word: schema.Verdict | Literal[""] = ""
        if described.held_out:
            last, _ = self._plain_errors(here)
            predicted = (self.predictions[0].predicted, self.forecast.predicted)
            declared, final = (rmse(self.record, one, here) for one in predicted)
            word = self._verdict(here, remains=exceeds_noise(final, self.noise_um, RESIDUAL_SHARE))
        return schema.RunPart(
            file=described.name,
            held_out=described.held_out,
            duration_h=float((time[-1] - time[0]) / np.timedelta64(1, "s") + self.record.block_s) / 3600.0,
            blocks=int(here.sum()),
            rmse_persistence_um=last,
            rmse_declared_um=declared,
            rmse_final_um=final,
            verdict=word,
        )

    def described(self, sensor_faults: Sequence[schema.SensorFaultPart]) -> schema.RecordLoop:
        """Return the part ``loop`` of results.json; errors are means over the channels."""
        mean, final_um = known_mean(self.errors, axis=1), self.final_um
        shape = self.remainder.shape or (BEYOND_PLAIN if self.falls_short else "")
        size = max(self.remainder.rms_um or excess_um(float(known_mean(final_um)), self.noise_um), self.wandering_um)
        persistence_um = channel_rmse(self.record, self.plain["last_value"], self.hold_out)
        last = self.state.rounds[-1].scores
        runs: dict[str, Any] = (
            {"runs": [self._run(number) for number in range(len(self.record.runs))]} if self.record.runs else {}
        )
        return schema.RecordLoop(
            declared=[term.effect for term in self.state.declared],
            held_out=self.held_out,
            noise_floor_um=self.noise_um,
            rmse_persistence_um=known_mean(persistence_um),
            rmse_declared_um=mean[0],
            rmse_final_um=known_mean(final_um),
            steps=[self._step(place) for place in range(len(self.state.steps))],
            **errors_of_predictions(self.hold_out_intervals),
            verdict=self.verdict,
            separable=self.separable(self.hold_out),
            wandering_um=self.wandering_um,
            left_out_of_forecast=tuple(self.state.steps[place].effect for place in sorted(self.away)),
            unconfirmed_effects=self.state.unnamed(RECORD_ENTRY_LEVEL),
            unexplained=schema.RecordUnexplained(
                shape=shape,
                rms_um=size if shape else 0.0,
                p_value=self.remainder.p_value,
                p_values=self.remainder.p_values,
                variance_share=known_mean(self.remainder.variance_share),
                closest_effect=last[0].name if shape and last else "",
            ),
            channels={
                name: schema.ChannelErrors(
                    rmse_persistence_um=persistence_um[k],
                    rmse_declared_um=self.errors[0, k],
                    rmse_final_um=final_um[k],
                    noise_um=self.noise[k],
                    variance_share=self.remainder.variance_share[k],
                )
                for k, name in enumerate(self.record.channels)
            },
            chained=self.chained,
            tracking=self.tracking,
            **runs,
            search=[_round_scores(scored) for scored in self.state.rounds],
            not_tried=self.state.not_tried(),
            not_admitted=self.state.blocked(),
            sensor_faults=sensor_faults,
        )

    def _step(self, place: int) -> schema.RecordStep:
        step, term = self.state.steps[place], self.state.added[place]
        squares = self.contribution(term) ** 2
        where = "on the hold-out set" if term.candidate.event_s is None else "in parts that are left out"
        return schema.RecordStep(
            **step.described(
                term.candidate, self.answers[place], where, size=step.score.gain, withheld=withheld_for(step)
            ),
            rmse_before_um=known_mean(self.errors[place]),
            rmse_after_um=known_mean(self.errors[place + 1]),
            rmse_without_um=self.state.errors_without_um[place],
            cross_rmse_before_um=self.cross_um[1 + place],
            cross_rmse_after_um=self.cross_um[0],
            rms_um=np.sqrt(np.mean(squares)),
            rms_by_channel_um={name: np.sqrt(np.mean(squares[:, k])) for k, name in enumerate(self.record.channels)},
            chained_rmse_before_um=step.round.start_error_um,
            chained_rmse_after_um=step.score.error_um,
            rejected=_rejected(step.round),
            event_s=_happened_s(term.candidate),
        )

    def contribution(self, term: Term) -> Array:
        """Contribution of a term to the prediction by the final model, about its mean."""
        place = place_of(self.state.model.terms, term)
        series = term.candidate.columns @ self.predictions[-1].coefficients[place]
        return np.asarray(series - series.mean(axis=0))


def _rejected(scored: Round) -> dict[str, str]:
    """Effects of a round that were significant and not confirmed, with the reason in words."""
    return {
        score.name: not_confirmed(score, scored).sentence
        for score in scored.scores
        if score.confirmation is not None and not score.is_confirmed
    }


def _round_scores(scored: Round) -> list[schema.RecordScorePart]:
    rejected = _rejected(scored)
    return [
        schema.RecordScorePart(
            **score.described(),
            chained_rmse_before_um=scored.start_error_um,
            chained_rmse_after_um=score.error_um,
            chosen=score.is_confirmed,
            rejected=rejected.get(score.name, ""),
        )
        for score in scored.scores
    ]


# The closed loop on a record: what the quasi-static model of the temperatures lacks, and the error before and after.


def close_record(
    record: Record,
    declared: Sequence[str],
    *,
    seed: int = 1,
    effects: Mapping[str, Effect] | None = None,
    progress: Progress = no_progress,
) -> RecordResult:
    """Close the loop on a record."""
    terms = declare(declared, record)
    train, description = hold_out(record)
    problem, state = search_record(record, train, terms, seed=seed, effects=effects, progress=progress)
    chained = chain_forward(record, terms, seed=seed, effects=effects, progress=progress)
    state = open_hold_out(problem, withdraw_unreplicated(problem, state, chained))
    progress(MOST_EFFECTS, MOST_EFFECTS, "examining the residual")
    whole = fit_record(record, state.model.terms, np.ones_like(train))
    predictions = [problem.predict(some) for some in state.chain]
    errors = np.array([channel_rmse(record, one.predicted, ~train) for one in predictions])
    left_out = [
        # The penalty is that from the training part.
        predict_left_out(record, columns_of(record, terms), problem.predict(terms).penalty)
        for terms in (state.model.terms, *(state.kept([place]) for place in range(len(state.steps))))
    ]
    told = ask_unseen(record, ~train, state, predictions[-1], left_out)
    away = left_out_of_forecast(problem, state, {place for place, one in enumerate(told) if one.word == "no"})
    kept = state.kept(away)
    forecast = problem.predict(kept)
    steps = rounding_steps(record, kept, forecast.coefficients)
    final_um = channel_rmse(record, forecast.predicted, ~train)
    plain, tracking = plain_predictions(record, train), None
    if not record.runs:
        tracking = track(record, train, forecast.predicted, plain["ridge"])
    return RecordResult(
        state=state,
        record=record,
        hold_out=~train,
        held_out=description,
        predictions=predictions,
        errors=errors,
        plain=plain,
        left_out=left_out,
        whole=whole,
        remainder=examine(whole, final_um, together(steps), np.random.default_rng(seed)),
        chained=chained,
        answers=told,
        away=away,
        forecast=forecast,
        steps=steps,
        tracking=tracking,
        wandering_um=float(np.mean([np.sqrt(np.mean(unexplained_drift(fit)[0] ** 2)) for fit in whole.channels])),
    )


def ask_unseen(
    record: Record, held_out: NDArray[np.bool_], state: RecordState, final: Prediction, left_out: Sequence[Array]
) -> list[Answer]:
    """What blocks that the coefficients were not fitted to say of every added effect: the hold-out set; of an event parts left out.

    An event before the hold-out set is a constant there.
    """
    share = [
        term.candidate.columns @ final.coefficients[place_of(state.model.terms, term)] for term in state.model.terms
    ]
    declared = np.sum([np.zeros(record.displacement.shape), *share[: len(state.declared)]], axis=0)
    added = share[len(state.declared) :]
    events = [place for place, term in enumerate(state.added) if term.candidate.event_s is not None]
    lasting = [place for place in range(len(added)) if place not in events]
    response = record.displacement - np.sum([np.zeros(declared.shape), *(added[place] for place in events)], axis=0)
    asked = answers(
        _unseen(record, held_out, response, [declared], [added[place] for place in lasting]), family=len(added)
    )
    told = dict(zip(lasting, asked, strict=True))
    everywhere = np.ones_like(held_out)
    for place in events:
        without = left_out[1 + place]
        parts = _unseen(record, everywhere, record.displacement - without, [], [left_out[0] - without])
        (told[place],) = answers(parts, family=len(added))
    return [told[place] for place in range(len(added))]


def _unseen(
    record: Record, here: NDArray[np.bool_], response: Array, beside: Sequence[Array], shares: Sequence[Array]
) -> list[Unseen]:
    """Blocks of every channel with the columns of free size and the shares of the effects, each (blocks, channels) um."""
    parts = []
    for k in range(len(record.channels)):
        rows = np.flatnonzero(here & np.isfinite(response[:, k]))
        later = (record.run[rows, None] == np.unique(record.run[rows])[1:]).astype(float)
        free = np.column_stack([later, *(one[rows, k] for one in beside)])
        predicted = np.array([one[rows, k] for one in shares]).reshape(len(shares), rows.size).T
        parts.append(Unseen(rows, record.seconds[rows], np.ones((rows.size, 1)), response[rows, k], free, predicted))
    return parts


def withdraw_unreplicated(
    problem: RecordProblem, state: RecordState, chained: Sequence[schema.ChainedPart]
) -> RecordState:
    """Withdraw effects that the same procedure also added on earlier time, and predicted no better with."""
    for place, step in enumerate(state.steps):
        tried = [part for part in chained if part.in_training and step.effect in part.effects]
        if not tried or step.score.is_event:
            continue
        before = float(known_mean(np.array([part.rmse_declared_um for part in tried])))
        after = float(known_mean(np.array([part.rmse_final_um for part in tried])))
        if after >= MAX_ERROR_RATIO_TO_ENTER * before:
            p = step.score.family_wise_p
            evidence = {"parts": len(tried), "without_um": before, "with_um": after, "p_value": p, "search_p": p}
            decision = Decision(step.effect, Reason.NOT_REPEATED, evidence)
            return withdraw_unreplicated(problem, withdraw(problem, state, [place], [decision]), chained)
    return state


@dataclass(frozen=True)
class SensorHealth:
    """Sensors and displacements that are faulty or suspected.

    Attributes
    ----------
    table : the record without faulty sensors, displacements and readings; what is suspected stays
    findings : part ``loop.sensor_faults`` of results.json: displacements, then sensors
    names_causes : whether any displacement is left in which a cause can be named
    """

    table: xr.Dataset
    findings: tuple[schema.SensorFaultPart, ...] = ()
    names_causes: bool = True


#: A fault, the name of its sensor or displacement, and of several runs the one that shows it.
_Found = tuple[SensorFault, str, str]
#: A displacement is computed with a faulty sensor where the readings of that sensor reduce its error by this factor.
_COMPUTED = 2.0


def examine_record(table: xr.Dataset, declared: Sequence[str]) -> SensorHealth:
    """Examine displacements and sensors of a record, and leave out what is faulty."""
    cleaned, readings = _without_faulty_readings(table)
    sensors = _examine_runs(cleaned)
    names = [str(name) for name in table["sensor"].values]
    faulty = [one for one in sensors if one[0].is_clear]
    kept = [name for name in names if name not in {name for _, name, _ in faulty}]
    if not kept:
        told = "; ".join(f"{name}: {fault.kind} from {fault.onset_s / 3600.0:.2f} h on" for fault, name, _ in sensors)
        raise RecordError(
            f"{table.attrs.get('source', 'record')}: no temperature sensor is sound ({told}); repeat the test"
        )
    if not readings and not faulty:
        return SensorHealth(table, tuple(_part(*one) for one in sensors))

    def errors(of: xr.Dataset, *beside: str, left_out: bool = False) -> dict[str, float]:
        used = of.sel(sensor=[name for name in names if name in kept or name in beside])
        return _declared_errors(used, declared, left_out=left_out)

    computed: dict[str, schema.SensorFaultPart] = {}
    for fault, name, run in faulty:
        alone, as_read = errors(cleaned, left_out=True), errors(cleaned, name, left_out=True)
        # A sound displacement follows what the part does, which the sensor shows better without its fault.
        repaired = errors(_repaired(cleaned, fault, name, run), name, left_out=True)
        for channel, error in as_read.items():
            ratio = min(alone[channel], repaired.get(channel, np.inf)) / max(error, 1e-12)
            if ratio >= _COMPUTED:
                same = replace(fault, kind=Kind.COMPUTED, size=np.nan, ratio=ratio, limit=_COMPUTED, computed_with=name)
                computed.setdefault(channel, _part(same, channel, run, error, alone[channel]))
    left = [str(name) for name in table["channel"].values if name not in computed]
    if not left:
        # Every displacement needs the faulty sensor then: it stays, and nothing is named.
        kept += [one.computed_with for one in computed.values()]
        stays = {"state": "suspected", "reason": "as every displacement is, so that both stay and no cause is named"}
        computed = {name: one.model_copy(update=stays) for name, one in computed.items()}
    channels = left or list(computed)
    raw, cleaned = table.sel(channel=channels), cleaned.sel(channel=channels)
    before, after = errors(raw), errors(cleaned)
    found = [
        _part(*one, before.get(one[1], np.nan), after.get(one[1], np.nan)) for one in readings if one[1] in channels
    ]
    for fault, name, run in sensors:
        is_out = name not in kept
        both = (errors(cleaned, name), after) if is_out else ({}, {})
        if fault.is_clear and not is_out:
            fault = replace(fault, is_clear=False, reason="every displacement is computed with it")
        found.append(_part(fault, name, run, *(float(known_mean(np.array([*each.values()]))) for each in both)))
    sound = cleaned.sel(sensor=[name for name in names if name in kept])
    return SensorHealth(sound, (*computed.values(), *found), bool(left))


def _part(
    fault: SensorFault, name: str, run: str, with_um: float = np.nan, without_um: float = np.nan
) -> schema.SensorFaultPart:
    state = "readings_left_out" if fault.readings else "left_out" if fault.is_clear else "suspected"
    errors = {"rmse_with_um": with_um, "rmse_without_um": without_um}
    told: dict[str, Any] = {
        **vars(fault),
        **errors,
        "sensor": name,
        "kind": fault.kind.value,
        "run": run,
        "state": state,
    }
    fields = schema.SensorFaultPart.model_fields
    return schema.SensorFaultPart(**{key: told[key] for key in fields if told[key] or fields[key].is_required()})


def _runs_of(table: xr.Dataset) -> Iterator[tuple[str, NDArray[np.bool_], Array]]:
    """Name of every run, empty where there is one, its samples, and their times since its start, s."""
    number = table["run"].values if "run" in table.coords else np.zeros(table.sizes["time"], int)
    for k, run in enumerate(json.loads(table.attrs.get("runs", '[""]'))):
        time = table["time"].values[number == k]
        yield run, number == k, np.asarray((time - time[0]) / np.timedelta64(1, "s"), np.float64)


def _without_faulty_readings(table: xr.Dataset) -> tuple[xr.Dataset, list[_Found]]:
    """The record without the displacements that are no readings, and what was found, run by run."""
    displacement, found = table["displacement"].copy(), []
    values, read = displacement.values, np.isfinite(table["displacement"].values)
    for run, here, seconds in _runs_of(table):
        rest = (table[name].values[here] for name in ("temperature", "driver"))
        for fault in examine_displacements(seconds, values[here], *rest):
            found.append((fault, str(table["channel"].values[fault.sensor]), run))
            for first, last in fault.stretches_s:
                values[np.flatnonzero(here)[(seconds >= first) & (seconds <= last)], fault.sensor] = np.nan
    # Where no displacement is left at the end, the record ends before.
    last, ended = (np.flatnonzero(known.any(axis=1)).max(initial=0) for known in (np.isfinite(values), read))
    return table.assign(displacement=displacement).isel(time=slice(last + 1 if last < ended else None)), found


def _examine_runs(table: xr.Dataset) -> list[_Found]:
    """Faults of the sensors, at most one per sensor; every run is examined by itself."""
    chosen: dict[int, _Found] = {}
    for run, here, seconds in _runs_of(table):
        for fault in examine_sensors(seconds, *(table[name].values[here] for name in ("temperature", "driver"))):
            earlier = chosen.get(fault.sensor)
            if earlier is None or (fault.is_clear and not earlier[0].is_clear):
                chosen[fault.sensor] = fault, str(table["sensor"].values[fault.sensor]), run
    return [chosen[sensor] for sensor in sorted(chosen)]


def _repaired(table: xr.Dataset, fault: SensorFault, name: str, run: str) -> xr.Dataset:
    """The record with a faulty sensor as it would read without its jump, its ramp or its implausible readings."""
    temperature = table["temperature"].copy()
    values = temperature.values[:, table["sensor"].values.tolist().index(name)]
    if fault.kind is Kind.NO_SIGNAL:
        values[is_implausible(values)] = np.nan
    if fault.kind in {Kind.JUMP, Kind.RAMP}:
        here, seconds = next((here, seconds) for each, here, seconds in _runs_of(table) if each == run)
        values[here] -= fault.size * np.interp(seconds, [fault.onset_s, fault.end_s], [0.0, 1.0])
    return table.assign(temperature=temperature)


def _declared_errors(table: xr.Dataset, declared: Sequence[str], *, left_out: bool = False) -> dict[str, float]:
    """Error of the declared model by channel, um, on the hold-out set, or of every part predicted from the others; none without a model."""
    try:
        record = reduce_record(table)
        train, _ = hold_out(record)
    except RecordError:
        return {}
    columns = columns_of(record, declare(declared, record))
    predicted, asked = predict(record, columns, train), ~train
    errors = channel_rmse(record, predicted.predicted, asked)
    if left_out:
        errors = channel_rmse(record, predict_left_out(record, columns, predicted.penalty), np.ones_like(train))
    return dict(zip(record.channels, errors.tolist(), strict=True))
