"""The closed loop on a record: sensors examined, candidates made, scored, confirmed and predicted, the result and what remains.

Every channel has a drift and coefficients of its own. Whether an effect is there is asked under a drift in every channel that may
explain the same thing (generalised least squares); it enters only if the parts of the training time that follow are also predicted
better with it. What the model predicts for hours ahead is asked of coefficients that are shrunk together, how strongly decided by forward
chaining: many alike sensors determine their coefficients badly, and such coefficients extrapolate badly. The procedure is that of
:mod:`fusion.analysis.drift_model.search`.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.alignment.sensor_health import (
    Kind,
    SensorFault,
    examine_displacements,
    examine_readings,
    examine_sensors,
    find_set_points,
)
from fusion.analysis.diagnosis.residual import PermutationTest, ResidualStructure, permutation_test
from fusion.analysis.drift_model.admissibility import NOISE_SHARE, free_warm_ups, is_shown_by_one_warm_up, refuse
from fusion.analysis.drift_model.evaluation import (
    Answer,
    Contribution,
    LoopResult,
    Surroundings,
    Unseen,
    answers,
    describe_steps,
    exceeds_noise,
    leading_pattern,
    left_out_of_forecast,
    named_in_forecast,
    unsupported_places,
)
from fusion.analysis.drift_model.gains import Gains, by_width, profile_gains
from fusion.analysis.drift_model.model import (
    SINGLE,
    Term,
    place_of,
    plausible_ratios,
    scaled_systems,
    wandering_um,
)
from fusion.analysis.drift_model.null_simulation import DRAWS, random_walk, rank_p_value
from fusion.analysis.drift_model.predictions import (
    Prediction,
    channel_rmse,
    folds,
    held_out_errors,
    last_values,
    parts_left_out,
    plain_predictions,
    predict,
    predict_parts,
    rmse,
    track_record,
)
from fusion.analysis.drift_model.record_data import EXPONENTS, Record, RecordError, independent, reduce_record
from fusion.analysis.drift_model.record_events import Event, find_events
from fusion.analysis.drift_model.recursion import FOLLOWED, Anchored, forecast
from fusion.analysis.drift_model.search import (
    BUILT_IN,
    HOLD_OUT_SHARE,
    MOST_EFFECTS,
    Confirmation,
    Confirmed,
    Decision,
    LoopState,
    Problem,
    Progress,
    Reason,
    Round,
    Score,
    no_progress,
    not_confirmed,
    open_hold_out,
    refine,
    score_effects,
    search,
    withdraw,
)
from fusion.analysis.effects.effect import LAGS_MIN, Candidate, Effect
from fusion.analysis.effects.events import periods_min, step_event
from fusion.analysis.effects.library import library
from fusion.analysis.effects.thermal import QUASI_STATIC, quasi_static
from fusion.analysis.levels import RECORD_ENTRY_LEVEL, REMAINDER_LEVEL
from fusion.common import Array
from fusion.results import loop as schema
from interferometry.common import one_thread
from interferometry.deviations import ROUNDING
from interferometry.drift.gls import DriftFit, estimate, fit_fixed_effects
from interferometry.drift.kalman import DriftModelError
from thermography.common import MAD_TO_SIGMA

# Digits of the readings: nothing is stated that rounding may look like.


def rounding_steps(record: Record, terms: Sequence[Term], coefficients: Array) -> Array:
    """Steps of every displacement, um: of its own digits, then of those of every temperature by its coefficient (1 + sensors, channels)."""
    per_kelvin = [coefficients[place_of(terms, term)] for term in terms if term.effect == QUASI_STATIC]
    through = np.sum([np.zeros((len(record.sensors), len(record.channels))), *np.abs(per_kelvin)], axis=0)
    return np.vstack([record.displacement_step, record.temperature_step[:, None] * through])


def together(steps: Array) -> Array:
    """Step of every displacement that rounds as much as its independent steps (number, channels) do."""
    return np.asarray(np.linalg.norm(steps, axis=0))


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
    return [Term(name, one) for name in declared for one in quasi_static.candidates(record.view(), {}, None)]


#: Readings per coefficient that a chained block needs before it, or its prediction says nothing.
_LEAST_PER_COEFFICIENT = 2
#: Blocks per column of one effect; what has more columns is reduced to its principal components for the test.
_PER_COLUMN = 8


@dataclass(frozen=True)
class RecordFit:
    """A model fitted to the `used` blocks of a record: its effects, declared ones first, with columns for all blocks, and for every
    channel, without the events, the fit under its own drift, of its own blocks (`rows`).
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


def events_of(record: Record, terms: Sequence[Term]) -> Array:
    """What the events among some terms are in every block and channel, um."""
    events = [term.candidate for term in terms if isinstance(term.candidate, Event)]
    return np.sum([np.zeros(record.displacement.shape), *(one.columns * one.size for one in events)], axis=0)


def without_events(record: Record, terms: Sequence[Term]) -> Record:
    """The record without the events among some terms."""
    return replace(record, displacement=record.displacement - events_of(record, terms))


def fit_record(record: Record, terms: Sequence[Term], used: NDArray[np.bool_]) -> RecordFit:
    """Fit every channel by itself, without the events: a constant for every run, the other terms, and a drift whose order and size come
    from restricted likelihood.
    """
    most, left = int(used.sum()) // _PER_COLUMN, without_events(record, terms).displacement
    fitted = [term for term in terms if not isinstance(term.candidate, Event)]
    parts = [_leading(np.asarray(term.candidate.columns), used, most) for term in fitted]
    columns = np.concatenate([columns_of(record, []), *parts], axis=1)
    columns = columns[:, independent(columns[used])]
    rng = np.random.default_rng(0)
    fits, rows = [], []
    for k, name in enumerate(record.channels):
        response = left[:, k]
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
    for robust in (True, False):
        try:
            return estimate(seconds, np.ones((seconds.size, 1)), response, design, robust=robust)
        except DriftModelError as error:
            fault = error
    raise RecordError(
        f'channel "{channel}" cannot be fitted ({fault}); leave it, or sensors that hardly move, out of [record]'
    )


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
    blocks, channels = model.record.displacement.shape
    pool, shocks = np.zeros((channels, blocks)), np.full((blocks, channels), np.nan)
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        noise, share = fit.noise()
        pool[k, rows] = noise / np.sqrt(np.maximum(share, 1e-12))
        shocks[rows, k] = fit.system.whiten(fit.residual()[:, None])[0][:, 0]
    root = np.linalg.cholesky(_correlation(shocks) + 1e-6 * np.eye(channels))
    correlated = rng.standard_normal((2, blocks, draws, channels)) @ root.T
    picked = rng.integers(0, blocks, (blocks, draws))
    simulated = []
    for k, (fit, rows) in enumerate(zip(model.channels, model.rows, strict=True)):
        drawn = pool[k, picked[rows]] * np.sqrt(fit.system.variance)[:, None]
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
    # Events are found before the search, in the raw readings.
    left = BUILT_IN - _CANDIDATES.keys() - {step_event.name}
    not_tried = {name: "a record has no positions" for name in offered if name in left}
    # A sensor that jumps is left out before.
    not_tried |= {name: "the sensors are examined before the search" for name in not_tried if name == "sensor_fault"}
    return {name: effect for name, effect in offered.items() if name not in {*not_tried, step_event.name}}, not_tried


# Grounds of a record: excitation by its drivers, noise of its sensors, and the course of a delayed sensor.

#: A driver of which a single step explains more than this share was switched only once.
_ONE_SWITCHING = 0.99


class RecordGrounds:
    """Grounds of a record: the record and a model of it without the candidate."""

    def __init__(self, model: RecordFit) -> None:
        self._model = model
        self._record = model.record

    def is_admissible(self, candidate: Candidate) -> bool:
        """Whether nothing speaks against a candidate before any fit: it is no event at a switching, and no lag of a noisy sensor."""
        if candidate.event_s is not None:
            return self.at_switching(candidate) is None
        if "sensor" not in candidate.parameters:
            return True
        _, noise, limit = self.noise_of_lag(candidate)
        return noise <= limit

    def at_switching(self, candidate: Candidate) -> float | None:
        """Hours since the start of the switching at which an event happened."""
        if (event_s := candidate.event_s) is None:
            return None
        switched = self._record.switched()[np.searchsorted(self._record.seconds, event_s)]
        return float(candidate.parameters.get("time_s", event_s)) / 3600.0 if switched else None

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


def sensors_at_once(record: Record) -> Candidate:
    """What every sensor would read with less noise, its mean over three blocks, and without delay, the rate of that beside it."""
    quiet = np.column_stack([_smoothed(record, one, 0.0) for one in record.rise.T])
    rate = np.diff(quiet, axis=0, prepend=quiet[:1])
    rate[list(record.first)] = 0.0
    return Candidate(np.hstack([quiet, rate]), {}, ("um/K",) * (2 * len(record.sensors)))


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
#: Share of its gain that an event keeps beside what late and noisy sensors miss: less is their delay, where an unlogged load was switched.
_BESIDE_SENSORS = 0.5
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
        self.finds_events = effects is None or step_event.name in effects

    def start(self, declared: Sequence[Term]) -> RecordState:
        """The state before the search: the declared model with the events of the raw readings, and the effects that this record cannot
        show.
        """
        missing = {name: needs_of(effect, self.record) for name, effect in self.effects.items()}
        state = RecordState(fit_record(self.record, declared, self.train)).without_effects(
            {**self._not_tried, **missing}
        )
        return self._with_events(state) if self.finds_events else state

    def _with_events(self, state: RecordState) -> RecordState:
        """The state with the events of the training part, those that explain most first."""
        found, decisions = find_events(self.record, self.train)
        error_um, scores = self.predict(state.model.terms).chained_rmse, []
        both = state.model, self.beside_sensors(state.model) if found else state.model
        for event in found:
            gain, beside = (float(channel_gains(one, [event]).gain[0, 0]) for one in both)
            if beside < _BESIDE_SENSORS * gain:
                evidence = {"gain": beside, "needed": _BESIDE_SENSORS * gain}
                decisions = [*decisions, Decision(step_event.name, Reason.SENSORS_MISS, evidence)]
                continue
            after_um = self.predict([*state.declared, Term(step_event.name, event)]).chained_rmse
            ranges = {"time_s": event.onset.ends(), "duration_min": event.duration.ends(60.0)}
            confirmed = Confirmation(True, Confirmed.RAW_READINGS, error_um=after_um)
            p = event.p_value
            scores.append(Score(step_event.name, event, gain, gain, p, p, confirmation=confirmed, ranges=ranges))
        if not scores:
            return state.decide(*decisions)
        state = state.scored(Round(tuple(scores), tuple(decisions), error_um))
        for score in scores:
            model = self.refit(state.model, [*state.model.terms, Term(score.name, score.best)])
            state = state.entered(model, score, Confirmed.RAW_READINGS)
        return state

    def beside_sensors(self, model: RecordFit) -> RecordFit:
        """A model with all that late and noisy sensors miss, where it follows sensors."""
        if all(term.effect != QUASI_STATIC for term in model.terms):
            return model
        return self.refit(model, [*model.terms, Term("", sensors_at_once(self.record))])

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
        # What follows the parts of late and noisy sensors at once is a fast state of whatever heats these.
        if excited_by == "driver":
            gain = float(channel_gains(self.beside_sensors(model), [score.best]).gain[0, 0])
            if gain < score.critical:
                return Decision(score.name, Reason.SENSORS_MISS, {"gain": gain, "needed": score.critical})
        return refuse(score.name, excited_by, score.best, RecordGrounds(model))

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

    def hold_out_errors(self, terms: Sequence[Term]) -> Array:
        """Errors of predicting the blocks that may not be used (n_held_out, channels), um."""
        return (self.record.displacement - self.predict(terms).predicted)[~self.train]

    def predict(self, terms: Sequence[Term]) -> Prediction:
        """Predict all blocks from the training part; events have their own size."""
        fitted = [term for term in terms if not isinstance(term.candidate, Event)]
        told = predict(without_events(self.record, terms), columns_of(self.record, fitted), self.train)
        coefficients = [
            term.candidate.size[None]
            if isinstance(term.candidate, Event)
            else told.coefficients[place_of(fitted, term)]
            for term in terms
        ]
        return replace(
            told,
            predicted=told.predicted + events_of(self.record, terms),
            coefficients=np.concatenate([told.coefficients[:0], *coefficients]),
        )

    def predict_left_out(self, terms: Sequence[Term]) -> Array:
        """Predict every part of the record from all others, by the penalty of the training part."""
        fitted = [term for term in terms if not isinstance(term.candidate, Event)]
        columns, left = columns_of(self.record, fitted), without_events(self.record, terms)
        asked = parts_left_out(left, np.ones_like(self.train))
        return predict_parts(left, columns, self.predict(terms).penalty, asked) + events_of(self.record, terms)

    def offer(self, name: str, model: RecordFit, near: Candidate | None) -> list[Candidate]:
        """Candidates of an effect that vary over the training part."""
        offered = candidates_of(self.effects[name], self.record, near)
        return [one for one in offered if (np.ptp(one.columns[self.train], axis=0) > 0.0).all()]


class ChainedResult(schema.ChainedPart):
    """One part of a record, predicted from all before it by a search that had not seen it."""

    channel_rmse_final_um: Array
    """(channels,) errors of the final model."""
    rmse_events_um: float
    """Error of the declared model with the events that were found, um: what the other effects are held against."""


@one_thread
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
        with_events = [*state.declared, *(term for term in state.added if isinstance(term.candidate, Event))]
        predicted = (
            last_values(record, before),
            *(problem.predict(terms).predicted for terms in (state.declared, with_events, state.model.terms)),
        )
        last_um, declared_um, events_um, final_um = (
            channel_rmse((record.displacement - one)[part]) for one in predicted
        )
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
                rmse_persistence_um=known_mean(last_um),
                rmse_declared_um=known_mean(declared_um),
                rmse_final_um=known_mean(final_um),
                channel_rmse_final_um=final_um,
                rmse_events_um=known_mean(events_um),
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
        scale = MAD_TO_SIGMA * np.median(np.abs(whitened)) or 1.0
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
        words.append(f"a slow drift without a name, largest in {_largest(record, hold_out_rmse)}")
    shape = " and ".join(words)
    return RecordRemainder(test.p_value, test.p_values, shape, 0.0, share)


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


@dataclass(frozen=True, repr=False)
class RecordResult(LoopResult):
    """Result of the closed loop on a record: what `LoopResult` holds, with errors as means over the channels, and

    Attributes
    ----------
    record : the record on its blocks
    is_held_out : (blocks,), true for the hold-out set
    predicted : um, predictions of all blocks from the training part, by the names of their errors
    contributions : um, what every term of the final model contributes, about its mean
    left_out : um, predictions of every part from all others: by the final model, then without each of its effects
    whole : the final model fitted to all blocks, for its residual
    chained : every part from the third on, predicted by the whole procedure on the time before it; runs from the other runs
    rounding : (1 + sensors, channels), um, steps of the displacements, as `rounding_steps` gives them
    anchored : the forecast from the last values before the hold-out, None for several runs
    """

    noise_share = RESIDUAL_SHARE
    level = RECORD_ENTRY_LEVEL

    state: RecordState
    steps: Sequence[schema.RecordStep]
    remainder: RecordRemainder
    record: Record
    is_held_out: NDArray[np.bool_]
    predicted: Mapping[str, Array]
    contributions: list[Array]
    left_out: list[Array]
    whole: RecordFit
    chained: list[ChainedResult]
    rounding: Array
    anchored: Anchored | None

    @property
    def noise(self) -> Array:
        """Noise of a block mean (channels,), um."""
        return noise_floor(self.whole.sigma, together(self.rounding))

    def _run(self, number: int) -> schema.RunPart:
        """One run, judged by its own errors where it is held out."""
        described, here = self.record.runs[number], self.record.run == number
        time = self.record.time[here]
        own = {name: rmse(errors[here[self.is_held_out]]) for name, errors in self.hold_out_errors.items()}
        last, declared, final = (own[name] for name in ("last_value", "declared", "final"))
        remains = exceeds_noise(final, self.noise_floor_um, self.noise_share)
        return schema.RunPart(
            file=described.name,
            held_out=described.held_out,
            duration_h=float((time[-1] - time[0]) / np.timedelta64(1, "s") + self.record.block_s) / 3600.0,
            blocks=int(here.sum()),
            rmse_persistence_um=last,
            rmse_declared_um=declared,
            rmse_final_um=final,
            verdict=self.judge(own, skill_um=final, remains=remains) if described.held_out else "",
        )

    def described(self, sensor_faults: Sequence[schema.SensorFaultPart]) -> schema.RecordLoop:
        """Return the part ``loop`` of results.json; errors are means over the channels."""
        last_um, declared_um, final_um = (
            channel_rmse(self.hold_out_errors[name]) for name in ("last_value", "declared", "final")
        )
        runs: dict[str, Any] = (
            {"runs": [self._run(number) for number in range(len(self.record.runs))]} if self.record.runs else {}
        )
        return schema.RecordLoop(
            **self._described(),
            channels={
                name: schema.ChannelErrors(
                    rmse_persistence_um=last_um[k],
                    rmse_declared_um=declared_um[k],
                    rmse_final_um=final_um[k],
                    noise_um=self.noise[k],
                    variance_share=self.remainder.variance_share[k],
                    **({} if self.anchored is None else self.anchored.of_channel(k)),
                )
                for k, name in enumerate(self.record.channels)
            },
            anchored=self.anchored
            and schema.Anchored(model=self.anchored.error, last_value=self.hold_out["last_value"]),
            chained=self.chained,
            **runs,
            search=[_round_scores(scored) for scored in self.state.rounds],
            sensor_faults=sensor_faults,
        )

    @property
    def _drift(self) -> list[Array]:
        moved = self.record.displacement - np.nanmean(self.record.displacement, axis=0)
        return [*self.contributions, moved - np.sum([np.zeros(moved.shape), *self.contributions], axis=0)]

    @property
    def unexplained(self) -> schema.RecordUnexplained:
        """What is left, and the effect of the last round that comes closest to it."""
        left, last = self._left(), self.state.rounds[-1].scores
        return schema.RecordUnexplained(
            **left,
            p_values=self.remainder.p_values,
            variance_share=known_mean(self.remainder.variance_share),
            closest_effect=last[0].name if left["shape"] and last else "",
        )


def report_steps(
    record: Record, state: RecordState, described: Sequence[Mapping[str, Any]], contributed: Sequence[Array]
) -> list[schema.RecordStep]:
    """Describe the steps of a loop by channel, beside what is said of the steps of every loop."""
    return [
        schema.RecordStep(
            **one,
            rms_by_channel_um=dict(zip(record.channels, np.sqrt(np.mean(series**2, axis=0)), strict=True)),
            chained_rmse_before_um=step.round.start_error_um,
            chained_rmse_after_um=step.score.error_um,
            rejected=_rejected(step.round),
            event_s=term.candidate.parameters.get("time_s", term.candidate.event_s),
            sizes_um=term.candidate.sizes(record.channels) if isinstance(term.candidate, Event) else {},
        )
        for step, term, one, series in zip(state.steps, state.added, described, contributed, strict=True)
    ]


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
    """Close the loop on a record, as `close_loop` does."""
    terms = declare(declared, record)
    train, description = hold_out(record)
    problem, state = search_record(record, train, terms, seed=seed, effects=effects, progress=progress)
    chained = chain_forward(record, terms, seed=seed, effects=effects, progress=progress)
    state = open_hold_out(problem, withdraw_unreplicated(problem, state, chained))
    progress(MOST_EFFECTS, MOST_EFFECTS, "examining the residual")
    whole = fit_record(record, state.model.terms, np.ones_like(train))
    model = problem.predict(state.model.terms)
    left_out = [
        problem.predict_left_out(kept)
        for kept in (state.model.terms, *(state.kept([place]) for place in range(len(state.steps))))
    ]
    series = series_of(state.model.terms, model)
    told = ask_unseen(record, ~train, state, series, left_out)
    contributions = [one - one.mean(axis=0) for one in series]
    contributed = contributions[len(state.declared) :]
    drift_um = float(np.mean([wandering_um(fit) for fit in whole.channels]))
    error_um, *without_um = (rmse(record.displacement - one) for one in left_out)
    described = describe_steps(
        state,
        told,
        [
            Contribution(float(np.sqrt(np.mean(one**2))), leading_pattern(one), problem.loss_without(whole, term))
            for one, term in zip(contributed, state.added, strict=True)
        ],
        Surroundings(
            drift_um=drift_um,
            is_smooth=any(fit.system.order == 2 for fit in whole.channels),
            total_um=float(np.sqrt(np.nanmean((record.displacement - np.nanmean(record.displacement, axis=0)) ** 2))),
            of_own_law={"unseen_heat_source"},
        ),
        sizes=[step.score.gain for step in state.steps],
        cross_um=[(without, error_um) for without in without_um],
    )
    steps = report_steps(record, state, described, contributed)
    away = left_out_of_forecast(problem, state, unsupported_places(steps))
    kept = state.kept(away)
    of_declared, of_final = problem.predict(state.declared), problem.predict(kept)
    events = [one for one, step in zip(contributed, state.steps, strict=True) if step.effect not in FOLLOWED]
    predicted = {
        "declared": of_declared.predicted,
        "final": of_final.predicted,
        **plain_predictions(record, train),
    }
    errors = {name: (record.displacement - values)[~train] for name, values in predicted.items()}
    rounding = rounding_steps(record, kept, of_final.coefficients)
    step = together(rounding)
    return RecordResult(
        state=state,
        held_out=description,
        noise_floor_um=float(np.mean(noise_floor(whole.sigma, step))),
        hold_out_errors=errors,
        hold_out=held_out_errors(errors)
        | {
            name: schema.ModelError(rmse_um=rmse(errors[name]), expected_um=one.chained_rmse)
            for name, one in (("declared", of_declared), ("final", of_final))
        },
        skill_um=rmse(errors["final"]),
        tracking=None if record.runs else track_record(record, train, of_final.predicted, predicted["ridge"]),
        steps=named_in_forecast(steps, away),
        away=frozenset(away),
        remainder=examine(whole, channel_rmse(errors["final"]), step, np.random.default_rng(seed)),
        wandering_um=drift_um,
        warm_up_only=shown_by_one_warm_up(whole, state.declared),
        record=record,
        is_held_out=~train,
        predicted=predicted,
        contributions=contributions,
        left_out=left_out,
        whole=whole,
        chained=chained,
        rounding=rounding,
        anchored=forecast(record, np.array(events).reshape(-1, *record.displacement.shape), train),
    )


def shown_by_one_warm_up(model: RecordFit, declared: Sequence[Term]) -> tuple[str, ...]:
    """Return the declared effects that a record of one run shows by one warm-up alone."""
    if model.record.runs:
        return ()
    curves, width = free_warm_ups(model.record.view()), columns_of(model.record, declared).shape[1]
    own = [np.arange(fit.design.shape[1]) - levels for fit, levels in zip(model.channels, model.levels, strict=True)]
    masks = [(place >= 0) & (place < width) for place in own]
    free = [curves[rows] for rows in model.rows]
    return tuple(term.effect for term in declared if is_shown_by_one_warm_up(model.channels, masks, free))


def series_of(terms: Sequence[Term], predicted: Prediction) -> list[Array]:
    """What every term contributes to a prediction, (blocks, channels) each, um."""
    return [term.candidate.columns @ predicted.coefficients[place_of(terms, term)] for term in terms]


def ask_unseen(
    record: Record, held_out: NDArray[np.bool_], state: RecordState, share: Sequence[Array], left_out: Sequence[Array]
) -> list[Answer]:
    """What blocks that the coefficients were not fitted to say of every added effect: the hold-out set; of an event parts left out.

    ``share`` is what every term of the final model contributes. An event before the hold-out set is a constant there: the raw readings
    around it were asked.
    """
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
        if isinstance(event := state.added[place].candidate, Event):
            told[place] = replace(event.answer, level=event.answer.level / len(added))
            continue
        without = left_out[1 + place]
        parts = _unseen(record, everywhere, record.displacement - without, [], [left_out[0] - without])
        (told[place],) = answers(parts, family=len(added))
        told[place] = replace(told[place], where="in parts that are left out")
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


def withdraw_unreplicated(problem: RecordProblem, state: RecordState, chained: Sequence[ChainedResult]) -> RecordState:
    """Withdraw effects that the same procedure also added on earlier time, and predicted no better with; events are in both."""
    for place, step in enumerate(state.steps):
        tried = [part for part in chained if part.in_training and step.effect in part.effects]
        if not tried or step.score.is_event:
            continue
        before = float(known_mean(np.array([part.rmse_events_um for part in tried])))
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
    table : the record without faulty sensors, displacements and readings, set points among the drivers; what is suspected stays
    findings : part ``loop.sensor_faults`` of results.json: displacements, then sensors
    names_causes : whether any displacement is left in which a cause can be named
    set_points : set point to the sensor at what it regulates
    """

    table: xr.Dataset
    findings: tuple[schema.SensorFaultPart, ...] = ()
    names_causes: bool = True
    set_points: Mapping[str, str] = field(default_factory=dict)

    @property
    def undoubted(self) -> xr.Dataset:
        """The record without what is suspected; all sensors where every one is."""
        doubted = {one.sensor for one in self.findings if one.state == "suspected"}
        sensors, channels = (
            [name for name in self.table[dimension].values.tolist() if name not in doubted]
            for dimension in ("sensor", "channel")
        )
        return self.table.sel(channel=channels, sensor=sensors or self.table["sensor"].values)


#: A fault, the name of its sensor or displacement, and of several runs the one that shows it.
_Found = tuple[SensorFault, str, str]
#: A displacement is computed with a faulty sensor where the readings of that sensor reduce its error by this factor, and it follows every
#: reading at once, by what it follows the course within this share: what heat moves is late.
_COMPUTED, _AS_MUCH = 2.0, 0.3
#: What a sensor does is no fault where the error of a displacement is this share of that without the sensor, and of that with the sensor as
#: it would read without it.
_FOLLOWED = 0.8
#: Share of a record that the model learns from after the onset of a fault, or its readings say nothing of the fault.
_LEARNT = 0.05


def examine_record(table: xr.Dataset, declared: Sequence[str]) -> SensorHealth:
    """Examine displacements and sensors of a record, and leave out what is faulty, but no sensor that the displacements speak for.

    Whether they do is asked of the training time alone.
    """
    table, set_points = without_set_points(table)
    names = [str(name) for name in table["sensor"].values]
    regulated = [names.index(one) for one in {*set_points.values()}]
    cleaned, readings = without_faulty_readings(table, regulated)
    sensors = _examine_runs(cleaned, regulated)
    dead = {name for fault, name, _ in sensors if fault.kind is Kind.NO_SIGNAL}
    if dead.issuperset(names):
        told = "; ".join(f"{name}: {fault.kind} from {fault.onset_s / 3600.0:.2f} h on" for fault, name, _ in sensors)
        raise RecordError(
            f"{table.attrs.get('source', 'record')}: no temperature sensor is sound ({told}); repeat the test"
        )
    if not readings and not sensors:
        return SensorHealth(table, set_points=set_points)
    learnt = {name for fault, name, run in sensors if _is_learnt(cleaned, fault, run)}
    asked = _Asked(table, cleaned, declared, tuple(name for name in names if name not in dead))
    computed = _computed(asked, [one for one in sensors if one[1] in learnt])
    channels = [str(name) for name in table["channel"].values if name not in computed]
    names_causes, proven = bool(channels), {one.computed_with for one in computed.values()}
    if not names_causes:
        # Every displacement needs the faulty sensor then: it stays, and nothing is named.
        stays = {"state": "suspected", "reason": "as every displacement is, so that both stay and no cause is named"}
        computed, channels = {name: one.model_copy(update=stays) for name, one in computed.items()}, [*computed]
    asked = replace(asked, read=table.sel(channel=channels), sound=cleaned.sel(channel=channels))
    sensors = [one for one in sensors if one[1] not in learnt - proven or not asked.follows(*one)]
    needed = set() if names_causes else proven
    out = {name for fault, name, _ in sensors if fault.is_clear and name not in needed}
    kept, compared = asked.put_back(
        [name for name in names if name not in out] or list(asked.alive), learnt - dead - proven
    )
    before, after = (asked.errors(of, kept)[0] for of in (asked.read, asked.sound)) if readings else ({}, {})
    found = [
        _part(fault, name, run, *(of.get(name, _mean(of)) for of in (before, after)))
        for fault, name, run in readings
        if name in channels or name in kept
    ]
    for fault, name, run in sensors:
        if fault.is_clear and name in kept:
            no_better = "the displacements are predicted no better without it"
            reason = "every displacement is computed with it" if name in needed else no_better
            fault = replace(fault, is_clear=False, reason=reason)
        found.append(_part(fault, name, run, *compared.get(name, ())))
    sound = asked.sound.sel(sensor=[name for name in names if name in kept])
    return SensorHealth(sound, (*computed.values(), *found), names_causes, set_points)


@dataclass(frozen=True)
class _Asked:
    """What the displacements of a record say of its sensors: the record as it was read and without faulty readings, and the sensors that
    give a signal.
    """

    read: xr.Dataset
    sound: xr.Dataset
    declared: Sequence[str]
    alive: tuple[str, ...]

    def errors(self, of: xr.Dataset, used: Collection[str]) -> tuple[dict[str, float], dict[str, float]]:
        """Errors with some sensors by channel, see `_declared_errors`."""
        return _declared_errors(of.sel(sensor=[name for name in of["sensor"].values if name in used]), self.declared)

    def as_read(self, sensor: str) -> xr.Dataset:
        """The record without faulty readings but those of a sensor."""
        temperature = self.read["temperature"].isel(time=slice(self.sound.sizes["time"]))
        return self.sound.assign(
            temperature=temperature.where(self.read["sensor"] == sensor, self.sound["temperature"])
        )

    def beside(self, fault: SensorFault, name: str, run: str) -> list[tuple[str, float, float]]:
        """Channels with their errors with a sensor as it was read, and as it would read without its fault."""
        read, repaired = (
            self.errors(one, {*self.alive, name})[0]
            for one in (self.as_read(name), _repaired(self.sound, fault, name, run))
        )
        return [(channel, error, repaired.get(channel, np.inf)) for channel, error in read.items()]

    def follows(self, fault: SensorFault, name: str, run: str) -> bool:
        """Whether a displacement follows what a sensor does."""
        if fault.kind not in {Kind.JUMP, Kind.RAMP}:
            return False
        others = {*self.alive} - {name}
        alone = self.errors(self.sound, others)[0] if others else {}
        return any(
            error < _FOLLOWED * min(repaired, alone.get(channel, np.inf))
            for channel, error, repaired in self.beside(fault, name, run)
        )

    def put_back(self, kept: list[str], learnt: Collection[str]) -> tuple[list[str], dict[str, tuple[float, float]]]:
        """The sensors that are kept once one after the other is put back with which the displacements are predicted better, in either way,
        and the errors with and without each of the others.
        """
        without = np.array([_mean(one) for one in self.errors(self.sound, kept)])
        tried = {
            name: np.array([_mean(one) for one in self.errors(self.sound, [*kept, name])])
            for name in self.read["sensor"].values.tolist()
            if name in learnt and name not in kept
        }
        better = {name: float(np.fmin(*(one / np.maximum(without, 1e-12)))) for name, one in tried.items()}
        best = min(better, key=lambda name: better[name], default="")
        if best and better[best] < 1.0:
            return self.put_back([*kept, best], learnt)
        return kept, {name: (float(one[0]), float(without[0])) for name, one in tried.items()}


def _computed(asked: _Asked, sensors: Sequence[_Found]) -> dict[str, schema.SensorFaultPart]:
    """Displacements that are computed with a faulty sensor."""
    computed: dict[str, schema.SensorFaultPart] = {}
    for fault, name, run in sensors:
        if not fault.is_clear or fault.kind not in {Kind.NO_SIGNAL, Kind.JUMP, Kind.RAMP}:
            continue
        for channel, error, beside in asked.beside(fault, name, run):
            if beside >= _COMPUTED * error and _contains(asked.as_read(name), channel, name):
                same = replace(fault, kind=Kind.COMPUTED, size=np.nan, computed_with=name, quantity="displacement")
                same = replace(same, ratio=beside / max(error, 1e-12), limit=_COMPUTED)
                computed.setdefault(channel, _part(same, channel, run, error, beside))
    return computed


def _mean(errors: Mapping[str, float]) -> float:
    return float(known_mean(np.array([*errors.values()])))


def without_set_points(table: xr.Dataset) -> tuple[xr.Dataset, dict[str, str]]:
    """The record with its set points among the drivers, and each with the sensor at what it regulates."""
    drivers = table["driver"].values[:, table["driver_units"].values == "degC"]
    named = [*table["sensor"].values.tolist(), *table["driver_name"].values[table["driver_units"].values == "degC"]]
    found = find_set_points(np.column_stack([table["temperature"].values, drivers]))
    pairs = {named[place]: named[regulated] for place, regulated in found.items() if regulated < table.sizes["sensor"]}
    sensors = table["sensor"].values.tolist()
    moved = [name for name in sensors if name in pairs]
    if not moved:
        return table, pairs
    names = [*table["driver_name"].values.tolist(), *moved]
    every = [*table["driver_units"].values.tolist(), *["degC"] * len(moved)]
    values = np.column_stack([table["driver"].values, table["temperature"].sel(sensor=moved).values])
    kept = table.drop_vars(["driver", "driver_units", "driver_name"]).drop_sel(sensor=moved)
    of, units = table["driver"], ("driver_name", np.array(every, object))
    return kept.assign(driver=(of.dims, values, of.attrs), driver_units=units).assign_coords(driver_name=names), pairs


def _is_learnt(table: xr.Dataset, fault: SensorFault, run: str) -> bool:
    """Whether the model learns from readings after the onset of a fault."""
    runs = [*_runs_of(table)]
    number = [name for name, _, _ in runs].index(run)
    if len(runs) > 1:
        return number not in json.loads(table.attrs["test"])
    return fault.onset_s < (1.0 - HOLD_OUT_SHARE - _LEARNT) * runs[0][2][-1]


def _contains(table: xr.Dataset, channel: str, sensor: str) -> bool:
    """Whether a displacement moves with every reading of a sensor, at once and as much as it follows the whole course."""
    place = table["sensor"].values.tolist().index(sensor)
    response, temperature = table["displacement"].sel(channel=channel).values, table["temperature"].values
    known = np.isfinite(response) & np.isfinite(temperature).all(axis=1)
    if known.sum() < temperature.shape[1] + 3:
        return False
    response, temperature = response[known], temperature[known]
    whole = np.linalg.lstsq(temperature - temperature.mean(axis=0), response - response.mean(), rcond=None)[0][place]
    quick, moved = np.diff(temperature[:, place], 2), np.diff(response, 2)
    weight = float(quick @ quick)
    if not weight > 0.0:
        return False
    slope = float(quick @ moved) / weight
    u = float(np.sqrt(np.mean((moved - slope * quick) ** 2) / weight))
    return abs(slope) > 5.0 * u and abs(slope - float(whole)) <= _AS_MUCH * abs(float(whole))


def _part(
    fault: SensorFault, name: str, run: str, with_um: float = np.nan, without_um: float = np.nan
) -> schema.SensorFaultPart:
    state = "readings_left_out" if fault.readings else "left_out" if fault.is_clear else "suspected"
    named = {"sensor": name, "kind": fault.kind.value, "run": run, "state": state}
    told: dict[str, Any] = {**vars(fault), **named, "rmse_with_um": with_um, "rmse_without_um": without_um}
    fields = schema.SensorFaultPart.model_fields
    return schema.SensorFaultPart(**{key: told[key] for key in fields if told[key] or fields[key].is_required()})


def _runs_of(table: xr.Dataset) -> Iterator[tuple[str, NDArray[np.bool_], Array]]:
    """Name of every run, empty where there is one, its samples, and their times since its start, s."""
    number = table["run"].values if "run" in table.coords else np.zeros(table.sizes["time"], int)
    for k, run in enumerate(json.loads(table.attrs.get("runs", '[""]'))):
        time = table["time"].values[number == k]
        yield run, number == k, np.asarray((time - time[0]) / np.timedelta64(1, "s"), np.float64)


def without_faulty_readings(table: xr.Dataset, regulated: Sequence[int] = ()) -> tuple[xr.Dataset, list[_Found]]:
    """The record without the displacements and temperatures that are no readings, and what was found, run by run."""
    kept, found = {name: table[name].copy() for name in ("displacement", "temperature")}, []
    values, read = kept["displacement"].values, np.isfinite(table["displacement"].values)
    for run, here, seconds in _runs_of(table):
        temperature, driver = (table[name].values[here] for name in ("temperature", "driver"))
        faults = [
            *examine_displacements(seconds, values[here], temperature, driver),
            *examine_readings(seconds, temperature, driver, quantity="temperature", regulated=regulated)[0],
        ]
        for fault in faults:
            names = table["channel" if fault.quantity == "displacement" else "sensor"].values
            found.append((fault, str(names[fault.sensor]), run))
            for first, last in fault.stretches_s:
                rows = np.flatnonzero(here)[(seconds >= first) & (seconds <= last)]
                kept[fault.quantity].values[rows, fault.sensor] = np.nan
    # Where no displacement is left at the end, the record ends before.
    last, ended = (np.flatnonzero(known.any(axis=1)).max(initial=0) for known in (np.isfinite(values), read))
    return table.assign(kept).isel(time=slice(last + 1 if last < ended else None)), found


def _examine_runs(table: xr.Dataset, regulated: Sequence[int]) -> list[_Found]:
    """Faults of the sensors as wholes, at most one per sensor; every run is examined by itself."""
    chosen: dict[int, _Found] = {}
    for run, here, seconds in _runs_of(table):
        readings = (table[name].values[here] for name in ("temperature", "driver"))
        for fault in examine_sensors(seconds, *readings, regulated=regulated):
            earlier = chosen.get(fault.sensor)
            if not fault.readings and (earlier is None or (fault.is_clear and not earlier[0].is_clear)):
                chosen[fault.sensor] = fault, str(table["sensor"].values[fault.sensor]), run
    return [chosen[sensor] for sensor in sorted(chosen)]


def _repaired(table: xr.Dataset, fault: SensorFault, name: str, run: str) -> xr.Dataset:
    """The record with a faulty sensor as it would read without its jump or its ramp."""
    temperature = table["temperature"].copy()
    values = temperature.values[:, table["sensor"].values.tolist().index(name)]
    if fault.kind in {Kind.JUMP, Kind.RAMP}:
        here, seconds = next((here, seconds) for each, here, seconds in _runs_of(table) if each == run)
        values[here] -= fault.size * np.interp(seconds, [fault.onset_s, fault.end_s], [0.0, 1.0])
    return table.assign(temperature=temperature)


def _declared_errors(table: xr.Dataset, declared: Sequence[str]) -> tuple[dict[str, float], dict[str, float]]:
    """Errors of the declared model by channel, um: later parts of the training time from those before, and every part from all others; of
    several training runs every one from the others.
    """
    try:
        record = reduce_record(table)
        train, _ = hold_out(record)
    except RecordError:
        return {}, {}
    columns = columns_of(record, declare(declared, record))
    penalty = predict(record, columns, train).penalty
    later, others = (
        channel_rmse(record.displacement - predict_parts(record, columns, penalty, asked)).tolist()
        for asked in (folds(record, train), parts_left_out(record, train))
    )
    return dict(zip(record.channels, later, strict=True)), dict(zip(record.channels, others, strict=True))
