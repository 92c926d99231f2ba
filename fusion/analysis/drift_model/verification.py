"""The test after a compensation: what was predicted, what was achieved, and where it was not, why.

The first test says how a machine responds to its readings, with what it left open. What a second test shows is that response at its own
readings plus what the control added, which the applied model replays. Every fault says what the control added instead: the same with
another gain, or the same states in other proportions. The fault under which the second test is most probable is named; faults under which
it is about as probable are named with it. The test that would decide most of what is open is proposed from the same responses.
"""

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
from fusion.analysis.drift_model.search import say
from fusion.common import Array
from fusion.results.loop import RecordLoop
from fusion.results.recursion import FAILED, UNKNOWN, Recursion, RecursionError, run_recursion

_DRAWS = 1000
#: Probability within the predicted interval.
_COVERAGE = 0.95
#: Difference of the gain from one that is a fault even where no more is left than predicted, beyond three standard uncertainties: between
#: all and half of it.
_OTHER_GAIN = 0.25
#: Share of the variance of what is left that an explanation must take away.
EXPLAINS = 0.5
#: Faults under which the test is less probable by more than this factor are told from the most probable one.
LESS_PROBABLE = 20.0
#: Gains that have a name, with the standard deviation within which they have it; another one is a scale, of any size up to inches.
NAMED_GAINS = {"wrong sign": -1.0, "half the gain": 0.5, "not active": 0.0}
NAMED_U, SCALE_U = 0.1, 30.0
_STALE, _UNKNOWN = "stale table", "not explained"


def name_faults(judged: Mapping[str, tuple[float, float]], well: float, least_share: float) -> list[str]:
    """Return the faults under which a test is most probable, the most probable first.

    `judged` holds the log-likelihood of each and the share of what is left that it explains; `well` is the log-likelihood without one.
    """
    best = max(judged, key=lambda name: judged[name][0])
    likelihood, share = judged[best]
    alike = np.log(LESS_PROBABLE)
    if share < least_share or likelihood < well + alike:
        return []
    return sorted((name for name in judged if judged[name][0] > likelihood - alike), key=lambda name: -judged[name][0])


@dataclass(frozen=True)
class ChannelVerdict:
    """One displacement before and after, um.

    Attributes
    ----------
    name : displacement
    before_um : range that the test would have shown without the correction, taken with the gain that was found where that is the fault;
        None where a sensor does not measure, because what the control made of it is not known
    predicted_um, predicted_low_um, predicted_high_um : range that the compensation was predicted to leave, median and 95 % interval
    achieved_um : range that was measured
    gain, gain_u : with which the correction acted; 1 where all is well
    is_kept : whether what was achieved is not above the interval
    fault : what is wrong, several names with "or" where they cannot be told apart; empty where nothing is, "not explained" where
        nothing here explains it
    reason : the evidence, one sentence
    """

    name: str
    before_um: float | None
    predicted_um: float
    predicted_low_um: float
    predicted_high_um: float
    achieved_um: float
    gain: float
    gain_u: float
    is_kept: bool
    fault: str
    reason: str


def verify(
    product: xr.Dataset, loop: RecordLoop, after: Record, applied: Recursion, *, faulty_sensors: Mapping[str, str]
) -> list[ChannelVerdict]:
    """Compare a test with an active compensation with what the test before it predicts, displacement by displacement.

    `product` and `loop` are of the test before it, `after` is the test with the compensation, `applied` the model that is said to run in
    the control; `faulty_sensors` do not measure in this test, with what they do.
    """
    missing = [one.name for one in applied.inputs if one.name not in (*after.sensors, *after.drivers, *faulty_sensors)]
    if missing:
        raise RecursionError(f"the test after it does not hold {', '.join(missing)}, which the applied model reads")
    for one in applied.inputs:
        unit = after.driver_sizes[one.name][1] if one.name in after.driver_sizes else one.unit
        if unit != one.unit:
            raise RecursionError(
                f"{one.name} is logged in {unit} in the test after it, and the applied model reads {one.unit}: write it in {one.unit}"
            )
    before = record_of_product(product)
    columns, every = columns_of(before, before.sensors), np.ones(before.seconds.size, bool)
    responses = respond(before, evaluate_columns(before, columns), events_of(product, loop), every)
    there = evaluate_columns(_with_readings(after, before), columns)
    model = applied.at_sampling(after.block_s)
    zero = np.arange(after.seconds.size) == 0
    replayed = run_recursion(model, _readings(after, model, faulty_sensors), zero=zero)
    dead = sorted({one.name for one in model.inputs} & set(faulty_sensors))
    failed = bool(np.isin(replayed.status, (FAILED, UNKNOWN)).any())
    verdicts = []
    for k, output in enumerate(model.outputs):
        if output.name not in after.channels or output.name not in before.channels:
            continue
        measured = after.displacement[:, after.channels.index(output.name)]
        known = np.isfinite(measured)
        second = _Second(
            after.seconds[known],
            measured[known],
            replayed.correction[known, k],
            there[known],
            responses[before.channels.index(output.name)],
            {one.name: replayed.correction[known, j] for j, one in enumerate(model.outputs) if j != k},
        )
        draws = second.draw_ranges()
        low, high = np.quantile(draws, [(1.0 - _COVERAGE) / 2.0, (1.0 + _COVERAGE) / 2.0]).tolist()
        gain, gain_u = second.gain()
        achieved = float(np.ptp(second.course))
        is_kept = achieved <= high
        fault, reason = "", ""
        if dead:
            names = ", ".join(f"{name} ({faulty_sensors[name]})" for name in dead)
            fault, reason = "dead sensor", say("verified", "dead_sensor", names=names)
        elif failed:
            fault, reason = "outside its range", say("verified", "outside_its_range")
        elif not is_kept or abs(gain - 1.0) > max(_OTHER_GAIN, 3.0 * gain_u):
            fault, reason = second.explain(0.0 if is_kept else EXPLAINS)
            fault, reason = ("", "") if is_kept and fault == _UNKNOWN else (fault, reason)
        acted = 1.0 if fault in {"", "outside its range", _UNKNOWN, _STALE} else gain
        verdicts.append(
            ChannelVerdict(
                output.name,
                before_um=None if dead else float(np.ptp(second.course - acted * second.correction)),
                predicted_um=float(np.median(draws)),
                predicted_low_um=low,
                predicted_high_um=high,
                achieved_um=achieved,
                gain=gain,
                gain_u=gain_u,
                is_kept=is_kept and not fault,
                fault=fault,
                reason=reason,
            )
        )
    return verdicts


def _with_readings(after: Record, before: Record) -> Record:
    """Return a test with sensors and drivers of the one before it, in its order and sizes; what does not measure stays where it was."""
    still = np.zeros(after.seconds.size)
    rows = [
        after.temperature[:, after.sensors.index(name)] if name in after.sensors else still for name in before.sensors
    ]
    drivers = {
        name: {
            power: after.drivers[name][power] * (after.driver_sizes[name][0] / size) ** power
            if name in after.drivers
            else still
            for power in before.drivers[name]
        }
        for name, (size, _) in before.driver_sizes.items()
    }
    return replace(after, temperature=np.column_stack(rows), sensors=before.sensors, drivers=drivers)


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


def whole_response(record: Record) -> list[Response]:
    """Return the response of every displacement of a record to all its readings."""
    values = evaluate_columns(record, columns_of(record, record.sensors))
    blocks = record.displacement.shape
    return respond(record, values, np.zeros((0, *blocks)), np.ones(blocks[0], bool))


def response_gains(
    learnt: Record, responses: Sequence[Response], asked: Record, own: Sequence[Response]
) -> list[tuple[float, float, int]]:
    """Gain with which every displacement of a record answers its readings, its standard uncertainty and degrees of freedom.

    1 is the answer learnt from another record with the same columns; uncertain by what that leaves open and, by jackknife, as parts differ.
    """
    there = evaluate_columns(_with_readings(asked, learnt), columns_of(learnt, learnt.sensors))
    parts, found = np.unique(asked.chained), []
    for course, one, other in zip(asked.displacement.T, responses, own, strict=True):
        # Noise and wandering are those of the record that is asked.
        response, predicted = replace(one, noise_um=other.noise_um, ratio=other.ratio), there @ one.coefficients
        known = np.isfinite(course)
        gains = [
            _Second(asked.seconds[rows], course[rows], predicted[rows], there[rows], response, {}).gain()
            for rows in (known, *(known & (asked.chained != part) for part in parts))
        ]
        u = float(np.hypot(gains[0][1], np.sqrt(parts.size - 1) * np.std([gain for gain, _ in gains[1:]])))
        found.append((1.0 + gains[0][0], u, parts.size - 1))
    return found


@dataclass(frozen=True)
class _Second:
    """One displacement in the second test: its blocks (n,), what was measured and corrected, um, the columns (n, p), their response, and
    the corrections of the others.
    """

    seconds: Array
    course: Array
    correction: Array
    columns: Array
    response: Response
    others: Mapping[str, Array]

    @property
    def _left_open(self) -> Array:
        """What the first test left open of the response."""
        return self.response.left_open(self.columns)

    @property
    def _bare(self) -> Array:
        """What was measured less the predicted response: what the control added, beside what is not known, um."""
        return self.course - self.columns @ self.response.coefficients

    def draw_ranges(self, *, seed: int = 1) -> Array:
        """Draw the range that the correction leaves (draws,), um: response, wandering and noise as the first test knows them."""
        left = self.response.draw(self.seconds, self.columns, np.random.default_rng(seed), draws=_DRAWS)
        return np.asarray(np.ptp(left + self.correction[:, None], axis=0))

    def gain(self) -> tuple[float, float]:
        """Return the gain with which the correction acted and its standard uncertainty."""
        _, coefficients, covariance = self._judge(
            self._bare, np.column_stack([self._left_open, SCALE_U * self.correction])
        )
        return float(SCALE_U * coefficients[-1]), float(SCALE_U * np.sqrt(covariance[-1, -1]))

    def _judge(self, left: Array, columns: Array) -> tuple[float, Array, Array]:
        """Return the log-likelihood of a course that follows columns, and their coefficients with covariance."""
        variance = self.response.noise_um**2
        marginal = Marginal.of(self.seconds, left, np.ones((left.size, 1)), columns, ratio=self.response.ratio)
        covariance = np.asarray(np.linalg.inv(np.eye(columns.shape[1]) + marginal.gram / variance), float)
        return marginal.log_likelihood(variance), covariance @ marginal.moment / variance, covariance

    def _faults(self) -> Iterator[tuple[str, Array, Array]]:
        """Yield every fault with what is left beside what the control added then, and the columns of what is not known."""
        for name, gain in NAMED_GAINS.items():
            columns = np.column_stack([self._left_open, NAMED_U * self.correction])
            yield name, self._bare - gain * self.correction, columns
        yield "wrong scale", self._bare, np.column_stack([self._left_open, SCALE_U * self.correction])
        for name, correction in self.others.items():
            yield f"axis exchanged with {name}", self._bare - correction, self._left_open
        # Any table of such states, which need not know the machine.
        yield _STALE, self._bare, np.column_stack([self._left_open, self.columns * self.response.prior_u])

    def explain(self, least_share: float) -> tuple[str, str]:
        """Return the fault that explains this share of what is left, and the evidence."""
        well, _, _ = self._judge(self._bare - self.correction, self._left_open)
        judged: dict[str, tuple[float, float]] = {}
        for name, left, columns in self._faults():
            likelihood, coefficients, _ = self._judge(left, columns)
            share = 1.0 - float(np.var(left - columns @ coefficients)) / max(float(np.var(self.course)), 1e-12)
            judged[name] = likelihood, share
        gain, gain_u = self.gain()
        told = say("verified", "gain", gain=gain, expanded_u=2.0 * gain_u)
        named = name_faults(judged, well, least_share)
        if not named:
            return _UNKNOWN, told + say("verified", "unknown")
        told += say("verified", "explained", fault=named[0], percent=100 * judged[named[0]][1])
        return " or ".join(named), told + (say("verified", "stale") if _STALE in named else "")


# The next test: a random duty, and the uncertainty of a correction that is expected after it.

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
