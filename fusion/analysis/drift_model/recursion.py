"""What a record says of its displacements as first-order responses to its readings, and the recursion of it that a control runs.

A control does not ask for names: every displacement is a sum of responses to every sensor and driver, at once and with time constants a
factor of four apart, whatever the closed loop named or withheld. Its coefficients are those with which later parts of a single run are
predicted best from the last value before them (`follow`), and so is the hold-out (`forecast`); those of several runs are the most probable.
What a second test says is judged by the distribution of such responses: coefficients are normal about zero, their standard deviation, the
noise and the wandering those under which the record is most probable (evidence: MacKay 1992, Neural Computation 4, 415).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.drift_model.predictions import (
    BASELINE_LAGS_MIN,
    PENALTIES,
    channel_rmse,
    last_values,
    rmse,
)
from fusion.analysis.drift_model.record_data import EXPONENTS, Record
from fusion.analysis.drift_model.search import say
from fusion.common import Array
from fusion.results import loop as schema
from fusion.results.loop import RecordLoop
from fusion.results.recursion import (
    Recursion,
    RecursionError,
    RecursionInput,
    RecursionOutput,
    RecursionState,
    SensorCurvePoint,
    first_order_weights,
)
from interferometry.drift.kalman import drift_system

#: A reduced model may predict worse than that of all sensors by this share.
_MAY_LOSE = 0.05
#: A displacement is proportional to temperatures: a reading may go beyond its range in the test by this share of it, and a correction
#: beyond its own, before it is held.
_BEYOND = 0.5
#: A reading that is not followed any more, and by more than these kelvin beyond the test, is that of a failed sensor: no day is so much
#: warmer or colder; a wire that is off reads 0 degC or the end of its scale.
_FAILED_K = 10.0
#: Time in which a correction may run through its whole range, s: quicker than any thermal state, slow enough not to mark a workpiece.
_FULL_RANGE_S = 60.0
#: A driver that comes this near to zero, as a share of its largest size, rests there: a control that starts with the machine starts cold.
_AT_REST = 0.02
#: Variance that the wandering gains in a second, over that of a block mean.
_RATIOS = 10.0 ** np.arange(-6.0, 0.1, 0.5)
#: Effects that are responses to readings.
FOLLOWED = ("thermal_lag", "unseen_heat_source")
#: Least variance of noise and of a standardised coefficient, um^2: a millionth of a micrometre is nothing.
_LEAST_UM2 = 1e-12
#: Size of a column below which it is rounding, and penalties of a forecast, the last of which follows nothing.
_LEAST_SIZE, _PENALTIES = 1e-12, np.append(PENALTIES, np.inf)
#: Equal parts of a single run, of which those of the later half are predicted for the choice of a forecast.
_PARTS = 8
#: Share of hold-outs whose mean square error lies below, and above, the range of a forecast: it is distributed as chi-squared with two
#: degrees of freedom, as that of a random walk is within a few per cent.
_OUTSIDE = 0.025
#: Turns and change (in the logarithm of a variance) in which the sizes settle.
_TURNS, _SETTLED = 60, 1e-3


@dataclass(frozen=True)
class Signal:
    """What one column follows: a sensor, or a power of a driver, through a first-order state that starts at zero, as that of a load that
    rests, or at the first reading.
    """

    input: str
    exponent: int
    time_constant_s: float
    starts_cold: bool = False


def record_of_product(product: xr.Dataset) -> Record:
    """Return the record on its blocks as ``fusion.nc`` holds it."""
    if "driver_square" not in product:
        raise RecursionError("these results were written by an earlier version; run the campaign again")
    drivers, sizes = {}, {}
    for k, name in enumerate(product["driver_name"].values.tolist()):
        powers = (product[variable].values[:, k] for variable in ("driver", "driver_square"))
        drivers[name] = dict(zip(EXPONENTS, powers, strict=True))
        sizes[name] = float(product["driver_size"][k]), str(product["driver_units"].values[k])
    time = product["time"].values
    run = product["run"].values if "run" in product else np.ones(time.size, int)
    sensors = [str(name) for name in product["sensor"].values]
    return Record(
        start=time[0],
        seconds=product["elapsed"].values,
        block_s=float(product.attrs["block_s"]),
        displacement=product["displacement"].values,
        temperature=product["temperature"].values,
        temperature_noise=np.zeros(len(sensors)),
        displacement_step=np.zeros(product.sizes["channel"]),
        temperature_step=np.zeros(len(sensors)),
        drivers=drivers,
        channels=tuple(str(name) for name in product["channel"].values),
        sensors=tuple(sensors),
        chained=product["part"].values - 1,
        first=tuple(np.flatnonzero(np.diff(run, prepend=run[0] - 1)).tolist()),
        driver_sizes=sizes,
    )


def columns_of(record: Record, sensors: Sequence[str]) -> list[Signal]:
    """Return the columns that some sensors and the drivers make."""
    lags_s = [0.0, *(60.0 * minutes for minutes in BASELINE_LAGS_MIN)]
    cold = {name: bool(np.abs(powers[1]).min() <= _AT_REST) for name, powers in record.drivers.items()}
    return [Signal(name, 1, tau_s) for tau_s in lags_s for name in sensors] + [
        Signal(name, power, tau_s, cold[name]) for tau_s in lags_s for name in record.drivers for power in EXPONENTS
    ]


def events_of(product: xr.Dataset, loop: RecordLoop) -> Array:
    """Return the course of every added effect that follows no reading (effects, blocks, channels), um: a control cannot know it."""
    # The added effects stand behind the declared ones.
    first = product.sizes["effect"] - len(loop.steps)
    places = [first + k for k, step in enumerate(loop.steps) if step.effect not in FOLLOWED]
    return np.asarray(product["contribution"].values[places])


def evaluate_columns(record: Record, columns: Iterable[Signal]) -> Array:
    """Return columns at the blocks (blocks, columns), zero at the start of every run."""
    rises = dict(zip(record.sensors, record.rise.T, strict=True))

    def values(one: Signal) -> Array:
        read = rises[one.input] if one.input in rises else record.drivers[one.input][one.exponent]
        return record.series(read, "1").lagged(one.time_constant_s, at_rest=0.0 if one.starts_cold else None).values

    matrix = np.array([values(one) for one in columns]).reshape(-1, record.seconds.size).T
    return matrix - matrix[np.asarray(record.first)[record.run]]


@dataclass(frozen=True)
class Marginal:
    """A whitened course with what nobody asks for swept out: its square, its products with columns (p,), theirs (p, p), the part of minus
    twice the log-likelihood that depends on the wandering alone, and the readings less the constants.
    """

    square: float
    moment: Array
    gram: Array
    constant: float
    free: int

    @classmethod
    def of(cls, seconds: Array, course: Array, constants: Array, columns: Array, *, ratio: float) -> Marginal:
        """Sweep constants (n, q) out of a course (n,) and columns (n, p); `ratio`: variance of wandering per second over that of noise."""
        system = drift_system(seconds, np.ones((course.size, 1)), order=1, ratios=np.array([ratio]))
        q = constants.shape[1]
        gram, log_determinant = system.normal_equations(np.column_stack([constants, course, columns]))
        kept = gram[q:, q:] - gram[q:, :q] @ np.linalg.solve(gram[:q, :q], gram[:q, q:])
        constant = log_determinant + float(np.linalg.slogdet(gram[:q, :q])[1])
        return cls(float(kept[0, 0]), kept[1:, 0], kept[1:, 1:], constant, course.size - q)

    def log_likelihood(self, variance: float) -> float:
        """Log-likelihood, up to a constant, where the columns have independent coefficients of unit variance, and the noise this one."""
        precision = np.eye(self.moment.size) + self.gram / variance
        explained = float(self.moment @ np.linalg.solve(precision, self.moment)) / variance
        misfit = (self.square - explained) / variance
        spread = float(np.linalg.slogdet(precision)[1])
        return -0.5 * (self.free * np.log(variance) + self.constant + spread + misfit)


@dataclass(frozen=True)
class Response:
    """One displacement as a response to columns.

    Attributes
    ----------
    coefficients, covariance : (p,) um per unit of each column, and (p, p)
    prior_u : (p,) standard deviation of a coefficient before the record
    noise_um : standard deviation of a block mean
    ratio : variance that the wandering gains in a second, over that of a block mean
    """

    coefficients: Array
    covariance: Array
    prior_u: Array
    noise_um: float
    ratio: float

    def left_open(self, columns: Array) -> Array:
        """What is not known of the response to columns (n, p): as many, with independent coefficients of unit variance, um."""
        sizes, directions = np.linalg.eigh(self.covariance)
        return np.asarray(columns @ (directions * np.sqrt(np.maximum(sizes, 0.0))))

    def draw(self, seconds: Array, columns: Array, rng: np.random.Generator, *, draws: int) -> Array:
        """Courses (n, draws), um, that respond to columns (n, p), wander and are noisy as this response leaves possible."""
        steps, shape = np.diff(seconds, prepend=seconds[0]), (seconds.size, draws)
        walk = np.cumsum(np.sqrt(self.ratio * steps)[:, None] * rng.standard_normal(shape), axis=0)
        course = self.left_open(columns) @ rng.standard_normal((self.coefficients.size, draws))
        course += self.noise_um * (walk + rng.standard_normal(shape))
        return np.asarray(course + (columns @ self.coefficients)[:, None])


def respond(record: Record, columns: Array, events: Array, used: NDArray[np.bool_]) -> list[Response]:
    """Return the response of every displacement to columns (blocks, p) over some blocks, beside a constant of every run and events
    (events, blocks, channels).
    """
    spread = columns[used].std(axis=0)
    scale = np.where(spread > 0.0, spread, np.inf)
    found = []
    for k, course in enumerate(record.displacement.T):
        here = used & np.isfinite(course)
        constants = _constants(record, events[..., k], here)
        swept = (
            (Marginal.of(record.seconds[here], course[here], constants, columns[here] / scale, ratio=ratio), ratio)
            for ratio in _RATIOS
        )
        found.append(max((_most_probable(*one, scale) for one in swept), key=lambda fit: fit[0])[1])
    return found


def _constants(record: Record, events: Array, here: NDArray[np.bool_]) -> Array:
    """Return a constant for every run of some blocks, and of the events (events, blocks) those within them (blocks here, q)."""
    runs = (record.run[here, None] == np.unique(record.run[here])).astype(float)
    happened = [one for one in events[:, here] if np.ptp(one) > 0.0]
    return np.column_stack([runs, *happened])


def _most_probable(marginal: Marginal, ratio: float, scale: Array) -> tuple[float, Response]:
    """Return the log-likelihood and the response under the sizes of noise and coefficients for which it is largest; `scale` (p,) is that
    by which the columns were divided.
    """
    values, vectors = np.linalg.eigh(marginal.gram)
    values, moment = np.maximum(values, 0.0), vectors.T @ marginal.moment
    # Readings that their constants use up, or that do not move, leave both at their least: the response is none.
    free = max(marginal.free, 1)
    size, variance = max(marginal.square / free, _LEAST_UM2), max(0.1 * marginal.square / free, _LEAST_UM2)
    for _ in range(_TURNS):
        shrunk = moment / (values + variance / size)
        known = values / (values + variance / size)
        before = np.log([size, variance])
        size = max(float(shrunk @ shrunk) / max(float(known.sum()), 1e-9), _LEAST_UM2)
        missed = marginal.square - 2.0 * float(shrunk @ moment) + float(values @ shrunk**2)
        left = free - float(known.sum())
        variance = max(missed / left, _LEAST_UM2) if left > 0.0 else _LEAST_UM2
        if np.abs(np.log([size, variance]) - before).max() < _SETTLED:
            break
    scaled = replace(marginal, moment=marginal.moment * np.sqrt(size), gram=marginal.gram * size)
    covariance = (vectors / (values / variance + 1.0 / size)) @ vectors.T
    mean, u = covariance @ marginal.moment / variance, np.full(values.size, np.sqrt(size))
    known = Response(mean / scale, covariance / np.outer(scale, scale), u / scale, float(np.sqrt(variance)), ratio)
    return scaled.log_likelihood(variance), known


#: Blocks that are predicted, behind those that they are predicted from.
_Ahead = tuple[NDArray[np.bool_], NDArray[np.bool_]]


@dataclass(frozen=True)
class Following:
    """How one displacement follows the `kept` (p,) columns from its last value on: the shrinkage of standardised coefficients, infinite
    where no reading predicts better than that it stays; um per unit of each; and the rms that it missed of later parts, infinite where
    there are none.
    """

    kept: NDArray[np.bool_]
    penalty: float
    coefficients: Array
    missed_um: float


def follow(
    record: Record, columns: Sequence[Signal], values: Array, events: Array, used: NDArray[np.bool_]
) -> list[Following]:
    """Return how every displacement follows columns (blocks, p) over some blocks, beside events (events, blocks, channels).

    Of a single run with the longest lag and the penalty that predict later parts best from the last value before them; of several by the
    most probable response, whose error is the expected one.
    """
    if np.unique(record.run[used]).size > 1:
        every, whole = np.ones(len(columns), bool), respond(record, values, events, used)
        missed_um = expected_um(whole, record, values, part_s(record))
        return [Following(every, 0.0, one.coefficients, um) for one, um in zip(whole, missed_um.tolist(), strict=True)]
    found = []
    for k, course in enumerate(record.displacement.T):
        known = used & np.isfinite(course)
        parts = _later_parts(known)
        choices = _choices(columns)
        # The last penalty is that under which nothing is followed.
        kept, penalty, least = choices[0], _PENALTIES.size - 1, np.inf
        for some in choices if parts else ():
            squares = _missed_um2(record, course, values[:, some], events[..., k], parts)
            if squares.min() < least:
                kept, penalty, least = some, int(np.argmin(squares)), float(squares.min())
        coefficients = np.zeros(len(columns))
        coefficients[kept] = _regress(record, course[:, None], values[:, kept], events[..., k], known)[penalty, :, 0]
        found.append(Following(kept, float(_PENALTIES[penalty]), coefficients, float(np.sqrt(least))))
    return found


def _choices(columns: Sequence[Signal]) -> list[NDArray[np.bool_]]:
    """Columns (p,) that a displacement may follow: those of time constants up to each of them."""
    lags_s = np.array([one.time_constant_s for one in columns])
    return [lags_s <= longest for longest in np.unique(lags_s)]


def _missed_um2(record: Record, course: Array, values: Array, events: Array, parts: Sequence[_Ahead]) -> Array:
    """Mean square (penalties,), um^2, of what parts are missed by from the last value before each."""
    squares = np.zeros(_PENALTIES.size)
    for before, part in parts:
        fitted = _regress(record, course[:, None], values, events, before)[..., 0]
        missed = _from_last_values(record, course[:, None] - values @ fitted.T, before)
        squares += np.mean(missed[part] ** 2, axis=0) / len(parts)
    return squares


def _later_parts(used: NDArray[np.bool_], number: int = _PARTS) -> list[_Ahead]:
    """The later half of so many equal parts of one run, each behind the blocks before it."""
    parts = [np.isin(np.arange(used.size), rows) for rows in np.array_split(np.flatnonzero(used), number) if rows.size]
    return [(np.logical_or.reduce(parts[:k]), parts[k]) for k in range(number // 2, len(parts))]


def _regress(record: Record, courses: Array, values: Array, events: Array, used: NDArray[np.bool_]) -> Array:
    """Coefficients (penalties, p, q) of courses (blocks, q) on columns (blocks, p) over some blocks, beside constants and events."""
    constants = _constants(record, events, used)
    laid = np.column_stack([courses[used], values[used]])
    laid -= constants @ np.linalg.lstsq(constants, laid, rcond=None)[0]
    y, x = laid[:, : courses.shape[1]], laid[:, courses.shape[1] :]
    spread = np.sqrt(np.mean(x**2, axis=0))
    scale = np.where(spread > _LEAST_SIZE, spread, np.inf)
    eigenvalues, vectors = np.linalg.eigh((x / scale).T @ (x / scale) / len(x))
    projected = vectors.T @ ((x / scale).T @ y / len(x))
    shrunk = projected / (np.maximum(eigenvalues, 0.0) + _PENALTIES[:, None])[..., None]
    return np.asarray((vectors @ shrunk) / scale[:, None])


def _from_last_values(record: Record, missed: Array, used: NDArray[np.bool_]) -> Array:
    """What is missed (blocks, q) less what was missed at the last used block before it in its run, or else at the first known one."""
    rows, known = np.arange(used.size), np.isfinite(missed[:, 0])
    first = np.array([np.argmax(known & (record.run == run)) for run in range(len(record.first))])
    last = np.maximum.accumulate(np.where(used & known, rows, -1))
    return np.asarray(missed - missed[np.maximum(np.where(used, rows, last), first[record.run])])


def errors_of(record: Record, values: Array, following: Sequence[Following], used: NDArray[np.bool_]) -> Array:
    """Return measured minus predicted displacement (blocks, channels), um, from the last values that are used."""
    missed = record.displacement - values @ np.column_stack([one.coefficients for one in following])
    return np.column_stack([_from_last_values(record, one[:, None], used) for one in missed.T])


def _ahead_um2(
    record: Record,
    columns: Sequence[Signal],
    values: Array,
    events: Array,
    one: Following,
    channel: int,
    train: NDArray[np.bool_],
) -> Array:
    """Variance (blocks,), um^2, of the forecast of one displacement of a single run.

    What it missed of later training parts as long as the hold-out, half of it from the start and half as a random walk, and how far from
    it all other choices lead, each with the likelihood of what it missed.
    """
    course = record.displacement[:, channel]
    used = train & np.isfinite(course)
    parts = _later_parts(used, int(np.clip(used.sum() // (~train).sum(), 2, _PARTS)))
    squares, apart = [], []
    for some in _choices(columns):
        squares.append(_missed_um2(record, course, values[:, some], events, parts))
        fitted = _regress(record, course[:, None], values[:, some], events, used)[..., 0]
        other = values[:, some] @ fitted.T - (values @ one.coefficients)[:, None]
        apart.append(_from_last_values(record, other, used))
        if np.array_equal(some, one.kept):
            own = float(squares[-1][one.penalty == _PENALTIES][0])
    missed = np.maximum(np.array(squares), _LEAST_UM2)
    weights = (missed.min() / missed) ** (len(parts) / 2.0)
    lead = record.seconds - record.seconds[used][-1]
    open_um2 = np.einsum("cp,cbp->b", weights, np.array(apart) ** 2) / weights.sum()
    return np.asarray(own * (0.5 + lead / lead[-1]) + open_um2)


@dataclass(frozen=True)
class Anchored:
    """A forecast of the hold-out of one run from the last values before it, with the readings since.

    Attributes
    ----------
    predicted, u : (blocks, channels) prediction and its standard uncertainty, um; NaN before the hold-out
    error : its error, mean over the channels, and what the forecast itself expects of it
    channels_um, expected_um : (channels,) error of every channel, and what is expected of it
    """

    predicted: Array
    u: Array
    error: schema.ModelError
    channels_um: Array
    expected_um: Array

    def of_channel(self, number: int) -> dict[str, float]:
        """What results.json holds of one channel."""
        return {"rmse_anchored_um": self.channels_um[number], "expected_anchored_um": self.expected_um[number]}


def forecast(record: Record, events: Array, train: NDArray[np.bool_]) -> Anchored | None:
    """Predict the hold-out from the last values before it; None for several runs, each of which is predicted from its own zero anyway."""
    if len(record.first) > 1:
        return None
    columns = columns_of(record, record.sensors)
    values = evaluate_columns(record, columns)
    following = follow(record, columns, values, events, train)
    errors = np.where(train[:, None], np.nan, errors_of(record, values, following, train))
    variance = np.column_stack(
        [_ahead_um2(record, columns, values, events[..., k], one, k, train) for k, one in enumerate(following)]
    )
    expected = np.sqrt(known_mean(np.where(np.isfinite(errors), variance, np.nan), axis=0))
    achieved, expected_um = rmse(errors), float(known_mean(expected))
    low, high = expected_um * np.sqrt(-np.log1p([-_OUTSIDE, _OUTSIDE - 1.0]))
    error = schema.ModelError(
        rmse_um=achieved,
        expected_um=expected_um,
        expected_low_um=low,
        expected_high_um=high,
        expected_p=float(np.exp(-((achieved / max(expected_um, _LEAST_SIZE)) ** 2))),
    )
    u = np.sqrt(np.where(train[:, None], np.nan, variance))
    return Anchored(record.displacement - errors, u, error, channel_rmse(errors), expected)


def make_recursion(
    product: xr.Dataset,
    loop: RecordLoop,
    *,
    campaign: str,
    results_sha256: str,
    sampling_s: float,
    reduced: bool = False,
    remarks: Sequence[str] = (),
) -> Recursion:
    """Make the recursion of a record from ``fusion.nc`` and what the closed loop found, with steps of `sampling_s`.

    Coefficients are from the whole record; uncertainties of a single run from parts of it that those of the other parts had not seen, of
    several what is expected over the length of a part. `reduced` keeps the
    fewest sensors that lose at most 5 % beside all (`sensor_curve`); the hold-out set decides nothing. Raises a RecursionError if nothing
    is left that predicts.
    """
    record = record_of_product(product)
    train = ~product["sealed"].values.astype(bool)
    everything = np.ones_like(train)
    sensors: Sequence[str] = record.sensors
    curve: list[SensorCurvePoint] = []
    told = [*remarks]
    if constant := product.attrs.get("constant_drivers"):
        told.append(say("handed_over", "constant", drivers=constant))
    if reduced:
        curve, chosen = sensor_curve(record, events_of(product, loop), train)
        sensors = chosen.sensors
        named = {"kept": len(sensors), "of": len(record.sensors), "named": ", ".join(sensors) or "none"}
        errors = {"error_um": chosen.held_out_rmse, "with_all_um": curve[0].held_out_rmse}
        told.append(say("handed_over", "reduced", **named, **errors))
    columns, events = columns_of(record, sensors), events_of(product, loop)
    unseen = [step.effect for step in loop.steps if step.effect not in FOLLOWED]
    told += [say("handed_over", "not_contained", effect=effect) for effect in unseen]
    values = evaluate_columns(record, columns)

    def missed(used: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Array:
        errors = errors_of(record, values, follow(record, columns, values, events, used), used)
        return np.where(asked[:, None], errors, np.nan)

    before = channel_rmse((record.displacement - last_values(record, train))[~train])
    held_out = np.sqrt(known_mean(missed(train, ~train) ** 2, axis=0))
    followed = follow(record, columns, values, events, everything)
    if len(record.first) > 1:
        u = np.array([one.missed_um for one in followed])
    else:
        parts = [missed(everything & ~part, part) for part in _parts(record, everything)]
        u = np.fmax(held_out, np.sqrt(known_mean(np.concatenate(parts) ** 2, axis=0)))
    skilled = [k for k in range(len(record.channels)) if held_out[k] < before[k]]
    if not skilled or not columns:
        raise RecursionError("no displacement of the hold-out set is predicted better than by its last value")
    numbers = {"error_um": float(known_mean(held_out)), "longest_min": BASELINE_LAGS_MIN[-1]}
    told.append(say("handed_over", "responds", headline_um=loop.rmse_final_um, **numbers))
    told.append(say("handed_over", "holds", hours=part_s(record) / 3600.0))
    idle = [name for k, name in enumerate(record.channels) if k not in skilled]
    told += [say("handed_over", "no_correction", name=name) for name in idle]
    whole = np.column_stack([one.coefficients for one in followed])
    inputs = _inputs(record, columns)
    told += [
        say("handed_over", "never_negative", name=one.name)
        for one in inputs
        if one.name in record.drivers and one.low == one.failed_below
    ]
    names = [one.name for one in inputs]
    states = [_state(one, names.index(one.input), record.driver_sizes, sampling_s) for one in columns]
    # Counted from any state of the test that is made the zero.
    limit = (1.0 + _BEYOND) * np.ptp(values @ whole, axis=0)
    outputs = [
        RecursionOutput(
            name=record.channels[k],
            unit="um",
            coefficients=tuple(whole[:, k].tolist()),
            limit=float(limit[k]),
            max_step=float(limit[k] * sampling_s / _FULL_RANGE_S),
            before=float(before[k]),
            u=float(u[k]),
        )
        for k in skilled
    ]
    return Recursion(
        campaign=campaign,
        results_sha256=results_sha256,
        held_out=loop.held_out,
        sampling_s=sampling_s,
        inputs=tuple(inputs),
        states=tuple(states),
        outputs=tuple(outputs),
        sensor_curve=tuple(curve),
        remarks=tuple(told),
    )


def expected_um(responses: Sequence[Response], record: Record, values: Array, over_s: float) -> Array:
    """Return the error that is expected (channels,) of predicting columns (blocks, p) for some time from a zero, um.

    What is not known of the response, wandering and noise.
    """
    blocks = max(round(over_s / record.block_s), 1)
    asked = values - values[np.arange(len(values)) // blocks * blocks]
    opened = np.array([np.mean(np.sum((asked @ one.covariance) * asked, axis=1)) for one in responses])
    rest = np.array([one.noise_um**2 * (2.0 + one.ratio * over_s / 2.0) for one in responses])
    return np.sqrt(opened + rest)


def part_s(record: Record) -> float:
    """Return the median length of the parts that an uncertainty was judged on, s."""
    return record.block_s * float(np.median(np.unique(record.chained, return_counts=True)[1]))


def _parts(record: Record, used: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return the runs of some blocks, or the parts of a single run, or where a pause leaves one of them alone, as many of equal size."""
    numbers = record.run if np.unique(record.run[used]).size > 1 else record.chained
    parts = [np.array(used & (numbers == number), bool) for number in np.unique(numbers[used])]
    measured = np.isfinite(record.displacement).any(axis=1)
    # A single block is its own zero.
    if sum(int((part & measured).sum()) > 1 for part in parts) > 1:
        return parts
    split = np.array_split(np.flatnonzero(used), np.unique(record.chained).max() + 1)
    return [np.isin(np.arange(used.size), rows) for rows in split if rows.size]


def sensor_curve(
    record: Record, events: Array, train: NDArray[np.bool_]
) -> tuple[list[SensorCurvePoint], SensorCurvePoint]:
    """Return the error over the number of sensors, from all down, and the point of the fewest that suffice.

    Each time the sensor is taken away without which the record stays most probable. What a number of sensors is worth is asked where they
    were not chosen: parts of the training time are left out one by one, sensors chosen and coefficients fitted in the others. The fewest
    are kept whose error, with the standard uncertainty of its ratio (jackknife over the parts), is at most 5 % above that with all.
    """
    columns = columns_of(record, record.sensors)
    values = evaluate_columns(record, columns)
    responses = respond(record, values, events, train)
    reads = np.array([[one.input == name for one in columns] for name in record.sensors])
    parts = [
        [_marginals(record, values, events, part, k, one) for k, one in enumerate(responses)]
        for part in _parts(record, train)
    ]
    asked, numbers = [], range(len(parts))
    for out in numbers:
        others = [parts[k] for k in numbers if k != out]
        asked.append([_misfits(others, parts[out], _used(kept, reads)) for kept in _path(others, reads)])
    # (parts, sizes, channels), and as many readings (parts, 1, channels).
    squares, free = np.array(asked), np.array([[[plain.free for _, plain in part]] for part in parts])

    def ratios(some: Sequence[int]) -> tuple[Array, Array]:
        # A displacement that these parts do not hold says nothing.
        with np.errstate(invalid="ignore"):
            by_channel = np.sqrt(np.maximum(squares[some].sum(axis=0), 0.0) / free[some].sum(axis=0))
        rms = known_mean(by_channel, axis=1)
        # Displacements that do not move are predicted exactly with any sensors.
        return rms, rms / max(float(rms[0]), np.finfo(float).tiny)

    cross, ratio = ratios([*numbers])
    without = np.array([ratios([k for k in numbers if k != out])[1] for out in numbers])
    ratio_u = np.sqrt((len(parts) - 1) * without.var(axis=0))
    curve, later_um = [], []
    for cross_um, kept in zip(cross, _path(parts, reads), strict=True):
        sensors = np.array(record.sensors)[kept].tolist()
        fewer = columns_of(record, sensors)
        laid = evaluate_columns(record, fewer)
        following = follow(record, fewer, laid, events, train)
        errors = errors_of(record, laid, following, train)
        held_out = float(known_mean(np.sqrt(known_mean(errors[~train] ** 2, axis=0))))
        curve.append(SensorCurvePoint(sensors=tuple(sensors), cross_rmse=float(cross_um), held_out_rmse=held_out))
        later_um.append(np.mean([one.missed_um for one in following]))
    # What a control gets is the model that predicts later parts, and has to keep what it achieves there as well.
    suffices = (ratio + ratio_u <= 1.0 + _MAY_LOSE) & (np.array(later_um) <= (1.0 + _MAY_LOSE) * later_um[0])
    return curve, curve[int(np.flatnonzero(suffices).max(initial=0))]


def _marginals(
    record: Record, values: Array, events: Array, part: NDArray[np.bool_], channel: int, one: Response
) -> tuple[Marginal, Marginal]:
    """Return one displacement in a part, from its own level, under noise and wandering with columns of unit prior, and as measured."""
    course = record.displacement[:, channel]
    here = part & np.isfinite(course)
    if not here.any():
        nothing = Marginal(0.0, np.zeros(values.shape[1]), np.zeros((values.shape[1],) * 2), 0.0, 0)
        return nothing, nothing
    constants = _constants(record, events[..., channel], here)
    scaled = values[here] * one.prior_u
    weighted, plain = (
        Marginal.of(record.seconds[here], course[here], constants, scaled, ratio=ratio) for ratio in (one.ratio, 0.0)
    )
    variance = one.noise_um**2
    return replace(weighted, moment=weighted.moment / variance, gram=weighted.gram / variance), plain


#: A part of a record: every displacement under noise and wandering in units of the noise, and as measured.
_Part = Sequence[tuple[Marginal, Marginal]]


def _path(parts: Sequence[_Part], reads: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return the sensors that are kept, all first, then one less each time; `reads` (sensors, columns) says what reads which."""
    grams = [np.sum([part[k][0].gram for part in parts], axis=0) for k in range(len(parts[0]))]
    moments = [np.sum([part[k][0].moment for part in parts], axis=0) for k in range(len(parts[0]))]

    def evidence(used: NDArray[np.bool_]) -> float:
        total = 0.0
        for gram, moment in zip(grams, moments, strict=True):
            precision = np.eye(int(used.sum())) + gram[np.ix_(used, used)]
            total += float(moment[used] @ np.linalg.solve(precision, moment[used]) - np.linalg.slogdet(precision)[1])
        return total

    path = [np.ones(len(reads), bool)]
    while True:
        fewer = [path[-1] & (np.arange(len(reads)) != k) for k in np.flatnonzero(path[-1])]
        tried = [kept for kept in fewer if _used(kept, reads).any()]
        if not tried:
            return path
        path.append(max(tried, key=lambda kept: evidence(_used(kept, reads))))


def _used(kept: NDArray[np.bool_], reads: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the columns that need none of the sensors that are not kept."""
    return np.asarray(~reads[~kept].any(axis=0), bool)


def _misfits(others: Sequence[_Part], asked: _Part, used: NDArray[np.bool_]) -> list[float]:
    """Return the sums of squares of every displacement in a part, um^2, with coefficients from other parts."""
    found = []
    for k, (_, plain) in enumerate(asked):
        gram = np.sum([part[k][0].gram for part in others], axis=0)[np.ix_(used, used)]
        moment = np.sum([part[k][0].moment for part in others], axis=0)[used]
        size = np.linalg.solve(np.eye(moment.size) + gram, moment)
        product = plain.gram[np.ix_(used, used)] @ size
        found.append(plain.square + float(size @ (product - 2.0 * plain.moment[used])))
    return found


def _inputs(record: Record, columns: Sequence[Signal]) -> list[RecursionInput]:
    """Return the readings that columns follow, with the range of the test."""
    used = {one.input for one in columns}
    inputs = []
    for k, name in enumerate(record.sensors):
        if name in used:
            values = record.temperature[:, k]
            reference = float(values[list(record.first)].mean())
            inputs.append(
                _input(name, "degC", reference, values, failed=max(_BEYOND * float(np.ptp(values)), _FAILED_K))
            )
    for name, powers in record.drivers.items():
        if name in used:
            size, unit = record.driver_sizes[name]
            values = size * powers[1]
            # A load may be larger than in the test without being wrong. One that never was negative is a magnitude, but for noise at rest.
            one = _input(name, unit, 0.0, values, failed=float(np.ptp(values)))
            least = -_AT_REST * size
            bounded = {"low": max(one.low, least), "failed_below": max(one.failed_below, least)}
            inputs.append(one if values.min() < least else one.model_copy(update=bounded))
    return inputs


def _input(name: str, unit: str, reference: float, values: Array, *, failed: float) -> RecursionInput:
    low, high = float(values.min()), float(values.max())
    held = _BEYOND * (high - low)
    return RecursionInput(
        name=name,
        unit=unit,
        reference=reference,
        low=low - held,
        high=high + held,
        failed_below=low - failed,
        failed_above=high + failed,
    )


def _state(one: Signal, place: int, sizes: Mapping[str, tuple[float, str]], sampling_s: float) -> RecursionState:
    decay, now, before = first_order_weights(one.time_constant_s, sampling_s)
    return RecursionState(
        input=place,
        size=sizes[one.input][0] if one.input in sizes else 1.0,
        exponent=2 if one.exponent == 2 else 1,
        time_constant_s=one.time_constant_s,
        decay=decay,
        now=now,
        before=before,
        start=0.0 if one.starts_cold and one.time_constant_s > 0.0 else 1.0,
    )
