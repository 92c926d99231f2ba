"""Predictions of what was held out: by ridge regression, by plain regressions, means and last values, and with a reading from time to time.

Coefficients of many alike series are badly determined and extrapolate badly: they are shrunk together, how strongly decided by forward
chaining inside the training part. A model has to beat what knows nothing of the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import Readings, known_mean
from fusion.analysis.drift_model.model import ModelFit, noise_growth
from fusion.analysis.drift_model.null_simulation import rank_p_value, simulate_null
from fusion.analysis.drift_model.record_data import Record
from fusion.analysis.effects.events import cycle_starts
from fusion.common import Array
from fusion.results import loop as schema
from interferometry.drift.gls import estimate
from interferometry.drift.kalman import drift_system

#: Penalties of a ridge regression, as shares of a standardised column's variance.
PENALTIES = 10.0 ** np.arange(-5.0, 1.6, 0.5)
#: Time constants of the lagged copies of a series, min: a factor of four apart.
BASELINE_LAGS_MIN = (5.0, 20.0, 80.0)
#: Times that a prediction which tracks is given a reading of the hold-out set: often enough for an interval, seldom enough to need a model.
READINGS_AGAIN = 10


# Errors of predictions, and what a model expects of its own.

#: Share of hold-out sets whose error lies in the range that a model states, and how often such a set is simulated.
_EXPECTED_PERCENT, _DRAWS = (2.5, 97.5), 400
#: How many times beyond the limit of outliers (3 standard deviations) a reading may be and still is noise that comes again.
_MOST_OUTLYING = 2.0
#: A growth of the noise is looked for over more cycles than these.
_FEWEST_FOR_GROWTH = 4


def held_out_errors(errors: Mapping[str, Array]) -> dict[str, schema.HeldOutError]:
    """Root mean square errors of several predictions of the hold-out set."""
    return {name: schema.HeldOutError(rmse_um=rmse(missed)) for name, missed in errors.items()}


def expect_errors(model: ModelFit, errors_um: Array, *, seed: int = 1) -> schema.ModelError:
    """What a model expects of its own errors (n_held_out,) on the hold-out set, beside what they are.

    Such tests are simulated with the drift and noise that the training part leaves possible, and predicted with coefficients of their own.
    """
    drawn = simulated_errors(model, np.random.default_rng(seed))[np.isfinite(errors_um)]
    achieved, each = rmse(errors_um), np.sqrt(np.mean(drawn**2, axis=0))
    low, high = np.percentile(each, _EXPECTED_PERCENT)
    return schema.ModelError(
        rmse_um=achieved,
        expected_um=np.sqrt(np.mean(each**2)),
        expected_low_um=low,
        expected_high_um=high,
        expected_p=rank_p_value(achieved, each),
    )


def simulated_errors(model: ModelFit, rng: np.random.Generator) -> Array:
    """Errors (n_held_out, draws), um, of predicting simulated readings in which only what the model holds acts, in open loop."""
    whole, used, site, sigma = model.whole_system(), model.used, model.readings.site, model.fit.sigma
    # Outliers of the training part come again, but none that is no noise.
    outlying = np.minimum(model.outlying, _MOST_OUTLYING**2) / model.outlying
    noise = model.fit.white_noise() * np.sqrt(outlying * model.fit.system.variance)
    # Every site scatters as it did; the fit draws it to the others.
    count, squares = (np.bincount(site[used], one, site.max() + 1) for one in (None, noise**2))
    variance = (squares / np.maximum(count, 1))[site]
    growth, level = _growth_ahead(model.readings.cycle, used, noise / np.sqrt(variance[used]), rng)
    variance *= growth
    noise /= np.sqrt(variance[used])
    whole = replace(whole, variance=np.where(used, whole.variance, variance))
    drawn = simulate_null(model.fit, rng, draws=_DRAWS, memory=model.memory, site=site, over=whole, noise=noise)
    missed, spread = whole.innovations(np.column_stack([model.whole_design(), drawn]))
    laid = missed[used] / np.sqrt(spread[used, None])
    known = np.reshape(
        [combination * (sigma / prior.u) for combination, prior in model.priors()], (-1, missed.shape[1] - _DRAWS)
    )
    laid = np.vstack([laid, np.column_stack([known, sigma * rng.standard_normal((len(known), _DRAWS))])])
    columns = missed.shape[1] - _DRAWS
    coefficients = np.linalg.lstsq(laid[:, :columns], laid[:, columns:], rcond=None)[0]
    return np.asarray((missed[:, columns:] - missed[:, :columns] @ coefficients)[~used] * level)


def _growth_ahead(
    cycle: NDArray[np.int64], used: NDArray[np.bool_], noise: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Relative variance (n,) to which noise (n_used,) grows from the mean of the training part, as far as that stands out, and factors
    (draws,) on what comes then, for what so many readings leave unknown of it.
    """
    relative, spread = np.ones(cycle.size), 0.0
    if np.unique(cycle[used]).size > _FEWEST_FOR_GROWTH:
        slope, variance, middle = noise_growth(cycle[used], noise**2, np.ones(noise.size))
        # James and Stein's estimate, its positive part, and what it leaves of the uncertainty.
        kept = max(0.0, 1.0 - variance / slope**2) if slope else 0.0
        relative = np.exp(kept * slope * (cycle - middle))
        relative /= relative[used].mean()
        spread = np.sqrt(kept * variance) * (cycle[~used].mean() - middle) / 2.0
    again = np.mean(rng.choice(noise, (noise.size, _DRAWS)) ** 2, axis=0) / np.mean(noise**2)
    return relative, np.sqrt(again) * np.exp(spread * rng.standard_normal(_DRAWS))


def rmse(errors: Array) -> float:
    """Root mean square of errors (n,) or (n, channels), mean over the channels; what was not predicted or measured is left out."""
    return float(known_mean(channel_rmse(errors)))


def channel_rmse(errors: Array) -> Array:
    """Root mean square of every channel's errors."""
    return np.asarray(np.sqrt(known_mean(errors**2, axis=0)))


# Records: every channel by itself, the penalty of all together.

#: Times that runs are left out at most; of more runs several are left out together.
MOST_LEFT_OUT = 8
#: Share of the training blocks that must lie before a part for its prediction to be counted.
_LATER = 0.5


@dataclass(frozen=True)
class Prediction:
    """A prediction of all blocks of a record from some of them, (blocks, channels) um, with the coefficients (p, channels) of the columns,
    the shrinkage that forward chaining chose, and the error under it, um, NaN where there is none.
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
            errors[place, k] = rmse((record.displacement - predicted)[part])
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


def parts_left_out(record: Record, used: NDArray[np.bool_]) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Every part of a record, or every run of several, behind all others that are used, earlier and later ones; none where it is alone."""
    numbers = record.run if np.unique(record.run[used]).size > 1 else record.chained
    parts = [numbers == number for number in np.unique(numbers[used])]
    return [(used & ~part, part) for part in parts if (used & ~part).any()]


def predict_parts(
    record: Record, columns: Array, penalty: float, asked: Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]]
) -> Array:
    """Predict parts, each from the blocks that stand before it; NaN elsewhere."""
    predicted = np.full(record.displacement.shape, np.nan)
    place = int(np.flatnonzero(penalty == PENALTIES)[0])
    for used, part in asked:
        predicted[part] = _paths(record, columns, used)[place][0][part]
    return predicted


def chained_parts(record: Record, train: NDArray[np.bool_]) -> list[int]:
    """Parts of the training blocks that are predicted from those before them: those of the later half."""
    numbers, counts = np.unique(record.chained[train], return_counts=True)
    before = np.cumsum(counts) - counts
    return [int(number) for number, rows in zip(numbers, before, strict=True) if rows >= _LATER * counts.sum()]


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
    of_runs = {"mean_run": mean_course(record, record.displacement, train)} if record.runs else {}
    if np.unique(record.run[train]).size > 1:
        apart = replace(record, displacement=record.displacement - of_runs["mean_run"])
        differences = predict(apart, now - mean_course(record, now, train), train)
        of_runs["run_differences"] = of_runs["mean_run"] + differences.predicted
    return {
        **of_runs,
        "last_value": last_values(record, train),
        "mean": np.broadcast_to(known_mean(record.displacement[train], axis=0), record.displacement.shape),
        "least_squares": least_squares,
        "ridge": predict(record, now, train).predicted,
        "ridge_with_lags": predict(record, np.column_stack([now, *late]), train).predicted,
    }


def track_record(record: Record, train: NDArray[np.bool_], forecast: Array, ridge: Array) -> schema.Tracking:
    """Predict the hold-out set with a reading of all channels from time to time, weighed by the drift of what the forecast misses."""
    held = np.flatnonzero(~train)
    every = max(1, held.size // READINGS_AGAIN)
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
    return schema.Tracking(every_min=every * record.block_s / 60.0, **held_out_errors(errors))


def mean_course(record: Record, values: Array, train: NDArray[np.bool_]) -> Array:
    """Mean of the other training runs at the same time since their start, of values (blocks, q) at every block.

    Beyond the end of all others their last mean is kept.
    """
    place = np.arange(record.seconds.size) - np.asarray(record.first)[record.run]
    predicted = np.zeros(values.shape)
    for run in range(len(record.runs)):
        others = train & (record.run != run)
        known = pd.DataFrame(values[others]).groupby(place[others]).mean().reindex(range(int(place.max()) + 1))
        course = known.interpolate(limit_direction="both").fillna(0.0).to_numpy()
        predicted[record.run == run] = course[place[record.run == run]]
    return predicted


# Positioning campaigns: every site about its own mean.

#: Parts of the training cycles; those of the later half choose the penalty, each predicted from the parts before it.
_PARTS = 4


def plain_errors(readings: Readings, used: NDArray[np.bool_]) -> dict[str, Array]:
    """Errors of plain predictions of all readings from those that were used, um, (n,) each."""
    static = _by_site(readings.site, readings.response, used)
    now, late = _standardised(readings, used, ()), _standardised(readings, used, BASELINE_LAGS_MIN)
    predicted: Mapping[str, Array] = {
        "last_value": static["last"],
        "mean": static["mean"],
        "least_squares": _regressed(readings, used, static["mean"], now, [0.0]),
        "ridge": _regressed(readings, used, static["mean"], now, PENALTIES.tolist()),
        "ridge_with_lags": _regressed(readings, used, static["mean"], late, PENALTIES.tolist()),
    }
    return {name: readings.response - values for name, values in predicted.items()}


def track_cycles(model: ModelFit, ridge: Array) -> schema.Tracking:
    """Predict the hold-out cycles with one of them measured from time to time, from which the drift is carried on; ``ridge`` are the errors
    (n,) of ridge regression.
    """
    readings, used = model.readings, model.used
    held = np.unique(readings.cycle[~used])
    every = max(1, held.size // READINGS_AGAIN)
    columns = np.column_stack([readings.response, model.whole_design()])
    known = np.isin(readings.site, readings.site[used])
    missed = {name: np.full(used.size, np.nan) for name in ("model", "last_reading", "ridge")}
    for start in range(0, held.size, every):
        # Every cycle is predicted from those measured before it, none from its own readings.
        here = np.isin(readings.cycle, held[start : start + every])
        measured = used | np.isin(readings.cycle, held[every - 1 : start : every])
        errors, _ = replace(model.whole_system(), observed=measured).innovations(columns)
        own = np.where(known, errors[:, 0] - errors[:, 1:] @ model.fit.coefficients, np.nan)
        last = readings.response - _by_site(readings.site, readings.response, measured)["last"]
        started = ridge - _by_site(readings.site, ridge, measured)["last"]
        for name, values in zip(missed, (own, last, started), strict=True):
            missed[name][here] = values[here]
    cycle_s = float(np.median(np.diff(cycle_starts(readings))))
    return schema.Tracking(
        every_min=every * cycle_s / 60.0, **held_out_errors({name: values[~used] for name, values in missed.items()})
    )


def _by_site(site: NDArray[np.int64], values: Array, used: NDArray[np.bool_]) -> dict[str, Array]:
    """Last and mean of every site's used values, at every reading (n,); NaN at a site without any."""
    last, mean = (np.full(site.max() + 1, np.nan) for _ in range(2))
    for number in np.unique(site[used]):
        own = values[used & (site == number)]
        last[number], mean[number] = own[-1], own.mean()
    return {"last": last[site], "mean": mean[site]}


def _standardised(readings: Readings, used: NDArray[np.bool_], lags_min: tuple[float, ...]) -> Array:
    """Every series and its lagged copies, common and along the axis, freed of each site's mean, of unit variance in training (n, k)."""
    columns = []
    for series in readings.series.values():
        for minutes in (0.0, *lags_min):
            column = readings.at(series.lagged(60.0 * minutes))
            columns += [column] if series.values.ndim == 2 else [column, column * readings.share]
    if not columns:
        return np.empty((readings.seconds.size, 0))
    site = readings.site
    laid = np.column_stack(columns)
    for number in np.unique(site):
        here = site == number
        laid[here] -= laid[here & used].mean(axis=0) if (here & used).any() else np.nan
    scale = laid[used].std(axis=0)
    moves = scale > 1e-12
    return laid[:, moves] / scale[moves]


def _regressed(
    readings: Readings, used: NDArray[np.bool_], mean: Array, columns: Array, penalties: Sequence[float]
) -> Array:
    """Prediction by a regression beside every site's mean, (n,), under the penalty that chained best."""
    y = readings.response - mean
    if len(penalties) == 1:
        return np.asarray(mean + columns @ _ridge(columns[used], y[used], penalties[0]))
    cycles = np.unique(readings.cycle[used])
    part = np.searchsorted(cycles, readings.cycle) * _PARTS // cycles.size
    errors = np.zeros(len(penalties))
    for number in range(_PARTS // 2, _PARTS):
        before, asked = used & (part < number), used & (part == number)
        for k, penalty in enumerate(penalties):
            predicted = columns[asked] @ _ridge(columns[before], y[before], penalty)
            errors[k] += float(((y[asked] - predicted) ** 2).mean())
    return np.asarray(mean + columns @ _ridge(columns[used], y[used], penalties[int(np.argmin(errors))]))


def _ridge(x: Array, y: Array, penalty: float) -> Array:
    """Coefficients of a ridge regression; without a penalty those of smallest norm."""
    normal = x.T @ x / max(1, y.size) + penalty * np.eye(x.shape[1])
    return np.asarray(np.linalg.lstsq(normal, x.T @ y / max(1, y.size), rcond=None)[0])
