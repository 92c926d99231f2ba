"""The drift model of a record as a recursion that a control runs, with all sensors of the test or with the fewest that suffice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.drift_model.record import MEAN, SOURCE_CHAIN, channel_rmse, last_values, predict, rmse
from fusion.analysis.drift_model.record_data import EXPONENTS, Record
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.common import Array
from fusion.results.loop import RecordLoop, StepPart
from fusion.results.recursion import (
    Recursion,
    RecursionError,
    RecursionInput,
    RecursionOutput,
    RecursionState,
    SensorCurvePoint,
    first_order_weights,
)

#: A reduced model may predict worse than the best choice of sensors by this share.
_MAY_LOSE = 0.05
#: A reading beyond its range by more than this share of it, and by more than these kelvin, is that of a failed sensor: so much warmer or
#: colder than the test a day may be, and the correction is held at its limit; a wire that is off reads 0 degC or the end of its scale.
_BEYOND, _BEYOND_K = 0.25, 2.0
#: Time in which a correction may run through its whole range, s: quicker than any thermal state, slow enough not to mark a workpiece.
_FULL_RANGE_S = 60.0
#: A prediction that was made again may differ from that of the run by this share of the displacement's range: rounding of the file.
_SAME = 1e-6


@dataclass(frozen=True)
class Signal:
    """What one column of the model follows.

    Attributes
    ----------
    input : name of a sensor or driver
    exponent : power of a driver; 1 for a sensor
    time_constant_s : of the first-order state
    share : weight in the column
    """

    input: str
    exponent: int
    time_constant_s: float
    share: float = 1.0


#: A column of the model: the weighted sum of its signals.
Column = tuple[Signal, ...]


def record_of_product(product: xr.Dataset) -> Record:
    """Return the record on its blocks as ``fusion.nc`` holds it."""
    if "driver_square" not in product:
        raise RecursionError("these results were written by an earlier version; run the campaign again")
    drivers = {
        str(name): {
            exponent: product[variable].values[:, k]
            for exponent, variable in zip(EXPONENTS, ("driver", "driver_square"), strict=True)
        }
        for k, name in enumerate(product["driver_name"].values)
    }
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
        drivers=drivers,
        channels=tuple(str(name) for name in product["channel"].values),
        sensors=tuple(sensors),
        duplicates=(),
        chained=product["part"].values - 1,
        gaps={},
        first=tuple(np.flatnonzero(np.diff(run, prepend=run[0] - 1)).tolist()),
        driver_sizes={
            str(name): (float(size), str(unit))
            for name, size, unit in zip(
                product["driver_name"].values,
                product["driver_size"].values,
                product["driver_units"].values,
                strict=True,
            )
        },
    )


def columns_of_loop(loop: RecordLoop, record: Record, sensors: Sequence[str]) -> tuple[list[Column], Array, list[str]]:
    """Return the columns that some sensors and the drivers make, what a control cannot follow (blocks, columns), and its names."""
    columns: list[Column] = []
    events, names = [np.empty((record.seconds.size, 0))], []
    if QUASI_STATIC in loop.declared:
        columns += [(Signal(name, 1, 0.0),) for name in sensors]
    for step in _forecast(loop):
        minutes = float(step.parameters.get("time_constant_min", 0.0))
        if step.effect == "thermal_lag":
            named = sensors if step.parameters["sensor"] == MEAN else [str(step.parameters["sensor"])]
            if set(named) <= set(sensors):
                columns.append(tuple(Signal(name, 1, 60.0 * minutes, 1.0 / len(named)) for name in named))
        elif step.effect == "unseen_heat_source":
            follows = str(step.parameters["follows"])
            columns += [
                (Signal(follows, exponent, 60.0 * minutes * share),) for share in SOURCE_CHAIN for exponent in EXPONENTS
            ]
        else:
            events.append(_event_columns(step, record))
            names.append(step.effect)
    return columns, np.concatenate(events, axis=1), names


def _forecast(loop: RecordLoop) -> list[StepPart]:
    """Return the added effects that the forecast holds."""
    return [step for step in loop.steps if step.effect not in loop.left_out_of_forecast]


def _event_columns(step: StepPart, record: Record) -> Array:
    """Return the columns (blocks, q) of an effect that follows no reading."""
    if step.effect == "periodic_disturbance":
        phase = 2 * np.pi * record.seconds / (60.0 * float(step.parameters["period_min"]))
        return np.column_stack([np.cos(phase), np.sin(phase)])
    if step.effect not in {"step_event", "sensor_fault"}:
        raise RecursionError(
            f"the effect {step.effect} of the model is not a first-order response to a reading; no recursion can be made of it"
        )
    time_s = float(step.parameters["time_s"])
    place = int(np.searchsorted(record.seconds, time_s - 1e-6 * record.block_s))
    late = (np.arange(record.seconds.size) >= place).astype(float)
    if 0 < place < late.size and record.run[place - 1] == record.run[place]:
        late[place - 1] = (record.seconds[place] - time_s) / record.block_s
    return late[:, None]


def evaluate_columns(record: Record, columns: Iterable[Column]) -> Array:
    """Return columns at the blocks (blocks, columns)."""
    rises = dict(zip(record.sensors, record.rise.T, strict=True))
    made = [np.empty((record.seconds.size, 0))]
    for column in columns:
        made.append(
            np.sum(
                [
                    one.share
                    * record.series(
                        rises[one.input] if one.input in rises else record.drivers[one.input][one.exponent], "1"
                    )
                    .lagged(one.time_constant_s)
                    .values
                    for one in column
                ],
                axis=0,
            )[:, None]
        )
    return np.concatenate(made, axis=1)


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
    """Make the recursion of a record's model.

    Parameters
    ----------
    product : Dataset
        ``fusion.nc`` of the run.
    loop : RecordLoop
        What the closed loop found.
    campaign, results_sha256 : str
        Where it comes from.
    sampling_s : float
        Time from step to step, s.
    reduced : bool
        Keep the fewest sensors with which the parts of the training time are predicted, each from the others, at most 5 % worse than
        with the best choice of sensors; the hold-out set decides nothing.
    remarks : sequence of str
        What to add to its remarks.

    Returns
    -------
    Recursion
        Coefficients from the whole record, uncertainties from the hold-out set and forward chaining with those of the training part.

    Raises
    ------
    RecursionError
        If an effect of the model cannot be run in a control, or nothing is left that predicts.
    """
    record = record_of_product(product)
    train = ~product["sealed"].values.astype(bool)
    everything = np.ones_like(train)
    columns, events, not_followed = columns_of_loop(loop, record, record.sensors)
    made = predict(record, np.column_stack([evaluate_columns(record, columns), events]), train)
    known = product["predicted_final"].values
    if np.nanmax(np.abs(made.predicted - known)) > _SAME * max(1.0, float(np.nanmax(np.abs(known)))):
        raise RecursionError("the prediction of these results cannot be repeated from them; run the campaign again")
    curve: list[SensorCurvePoint] = []
    told = [*remarks]
    if reduced:
        curve = sensor_curve(record, loop, train)
        chosen = fewest(curve)
        columns, events, _ = columns_of_loop(loop, record, chosen.sensors)
        made = predict(record, np.column_stack([evaluate_columns(record, columns), events]), train)
        told.append(
            f"reduced to {len(chosen.sensors)} of {len(record.sensors)} sensors: {', '.join(chosen.sensors) or 'none'}; error on the "
            f"hold-out set {chosen.held_out_rmse:.3g} um, with all {curve[0].held_out_rmse:.3g} um"
        )
    told += [f"not contained, because no reading shows it: {name}" for name in not_followed]
    before = channel_rmse(record, last_values(record, train), ~train)
    held_out = channel_rmse(record, made.predicted, ~train)
    # What forward chaining showed the whole procedure to miss by is in it.
    u = np.fmax(product["predicted_u"].values, held_out)
    skilled = [k for k in range(len(record.channels)) if held_out[k] < before[k]]
    if not skilled or not columns:
        raise RecursionError("no displacement of the hold-out set is predicted better than by its last value")
    told += [
        f"no correction of {name}: its hold-out set is predicted no better than by its last value"
        for k, name in enumerate(record.channels)
        if k not in skilled
    ]
    values = evaluate_columns(record, columns)
    whole = predict(record, np.column_stack([values, events]), everything).coefficients[: len(columns)]
    follow = values @ whole
    inputs = _inputs(record, columns)
    states, place = _states(record, columns, [one.name for one in inputs], sampling_s)
    coefficients = np.zeros((len(states), len(record.channels)))
    for column, weights in zip(columns, whole, strict=True):
        for one in column:
            coefficients[place[one.input, one.exponent, one.time_constant_s]] += one.share * weights
    # Counted from any state of the test that is made the zero.
    limit = np.ptp(follow, axis=0)
    outputs = [
        RecursionOutput(
            name=record.channels[k],
            unit="um",
            coefficients=tuple(coefficients[:, k].tolist()),
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


def sensor_curve(record: Record, loop: RecordLoop, train: NDArray[np.bool_]) -> list[SensorCurvePoint]:
    """Return the error over the sensors, from all down to none: each time the sensor is taken away without which least is lost."""

    def point(sensors: Sequence[str]) -> SensorCurvePoint | None:
        columns, events, _ = columns_of_loop(loop, record, sensors)
        if not columns:
            return None
        matrix = np.column_stack([evaluate_columns(record, columns), events])
        made = predict(record, matrix, train)
        return SensorCurvePoint(
            sensors=tuple(sensors),
            cross_rmse=_cross_rmse(record, matrix, train),
            held_out_rmse=rmse(record, made.predicted, ~train),
        )

    first = point(record.sensors)
    curve = [] if first is None else [first]
    while curve and curve[-1].sensors:
        kept = curve[-1].sensors
        fewer = [point([name for name in kept if name != gone]) for gone in kept]
        tried = [one for one in fewer if one is not None]
        if not tried:
            break
        curve.append(min(tried, key=lambda one: one.cross_rmse))
    return curve


def _cross_rmse(record: Record, columns: Array, train: NDArray[np.bool_]) -> float:
    """Return the root mean square error of the parts of the training time, each predicted from the others; mean over the channels, um."""
    numbers = record.run if len(record.first) > 1 else record.chained
    missed = np.full(record.displacement.shape, np.nan)
    for number in np.unique(numbers[train]):
        part = train & (numbers == number)
        missed[part] = (record.displacement - predict(record, columns, train & ~part).predicted)[part]
    return float(known_mean(np.sqrt(known_mean(missed[train] ** 2, axis=0))))


def fewest(curve: Sequence[SensorCurvePoint]) -> SensorCurvePoint:
    """Return the point of the fewest sensors that predicts at most 5 % worse than the best of the curve, which may have fewer than all."""
    limit = (1.0 + _MAY_LOSE) * min(one.cross_rmse for one in curve)
    return min((one for one in curve if one.cross_rmse <= limit), key=lambda one: len(one.sensors), default=curve[0])


def _inputs(record: Record, columns: Sequence[Column]) -> list[RecursionInput]:
    """Return the readings that columns follow, with the range of the test."""
    used = {one.input for column in columns for one in column}
    inputs = []
    for k, name in enumerate(record.sensors):
        if name in used:
            values = record.temperature[:, k]
            reference = float(values[list(record.first)].mean())
            inputs.append(_input(name, "degC", reference, values, least=_BEYOND_K))
    for name, powers in record.drivers.items():
        if name in used:
            size, unit = record.driver_sizes[name]
            inputs.append(_input(name, unit, 0.0, size * powers[1], least=0.0))
    return inputs


def _input(name: str, unit: str, reference: float, values: Array, *, least: float) -> RecursionInput:
    low, high = float(values.min()), float(values.max())
    beyond = max(_BEYOND * (high - low), least)
    return RecursionInput(
        name=name,
        unit=unit,
        reference=reference,
        low=low,
        high=high,
        failed_below=low - beyond,
        failed_above=high + beyond,
    )


def _states(
    record: Record, columns: Sequence[Column], inputs: Sequence[str], sampling_s: float
) -> tuple[list[RecursionState], dict[tuple[str, int, float], int]]:
    """Return the states that columns need, each once, and their places."""
    place: dict[tuple[str, int, float], int] = {}
    states: list[RecursionState] = []
    for one in (one for column in columns for one in column):
        key = one.input, one.exponent, one.time_constant_s
        if key in place:
            continue
        place[key] = len(states)
        decay, now, before = first_order_weights(one.time_constant_s, sampling_s)
        states.append(
            RecursionState(
                input=inputs.index(one.input),
                size=record.driver_sizes[one.input][0] if one.input in record.driver_sizes else 1.0,
                exponent=2 if one.exponent == 2 else 1,
                time_constant_s=one.time_constant_s,
                decay=decay,
                now=now,
                before=before,
            )
        )
    return states, place
