"""The stage of a record: read, reduced to blocks, its loop closed, described for results.json and report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.alignment.sensor_health import describe_fault
from fusion.analysis.drift_model.predictions import channel_rmse
from fusion.analysis.drift_model.record import (
    RecordResult,
    SensorHealth,
    close_record,
    declare,
    examine_record,
    together,
)
from fusion.analysis.drift_model.record_data import EXPONENTS, Record, reduce_record
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.config import Campaign
from fusion.campaign.inputs import pipe_notices, read_record
from fusion.campaign.time_zones import zone_notices
from fusion.results.numbers import duration, number
from fusion.results.progress import Report, clock_notices, counted, left_out_notices, listed
from fusion.results.results import Notice, Outcome, Parts


@dataclass(frozen=True)
class RecordSource:
    """A record as it was read, before anything is modelled: what is declared, what was left out, and the health of its sensors."""

    record: Record
    declared: list[str]
    notices: list[Notice]
    health: SensorHealth


def read_record_source(campaign: Campaign) -> RecordSource:
    """Read a record and refuse what cannot be modelled."""
    table = read_record(campaign)
    declared, notices = declared_effects(campaign)
    health = examine_record(table, declared)
    record = reduce_record(health.table)
    declare(declared, record)
    left_out = [
        *pipe_notices(campaign),
        *zone_notices(table, code="record_no_zone", of="the record"),
        *_held_notices(table),
        *left_out_notices(table, "record_rows_left_out"),
        *clock_notices(table),
        *_unread_notices(table),
        *guess_notices(campaign),
        *_rise_notices(table),
        *_set_point_notices(health),
    ]
    return RecordSource(
        record, declared, [*sensor_notices(health), *notices, *left_out, *record_notices(record)], health
    )


def _held_notices(table: xr.Dataset) -> Iterator[Notice]:
    """Notices of logs with a line per change: how values were held between lines, and channels that were not connected."""
    for one in json.loads(table.attrs.get("held", "[]")):
        if "step_s" in one:
            yield Notice.of(
                "record_values_held",
                file=one["file"],
                step=duration(one["step_s"]),
                fastest=one["fastest"],
                wait=duration(one["wait_s"]),
                slowest=one["slowest"],
                longest=duration(one["longest_s"]),
            )
        if one["lost"]:
            yield Notice.of("record_channels_lost", file=one["file"], lost=listed(one["lost"]))


def _unread_notices(table: xr.Dataset) -> Iterator[Notice]:
    """Notice of the samples that hold no reading: empty fields, texts, and marks of ``record.missing``."""
    counts = {
        str(name): int(np.isnan(values).sum())
        for kind, names in (("temperature", "sensor"), ("displacement", "channel"), ("driver", "driver_name"))
        for name, values in zip(table[names].values, table[kind].values.T, strict=True)
    }
    named = [f"{name} ({count} of {table.sizes['time']})" for name, count in counts.items() if count]
    if named:
        yield Notice.of("record_readings_missing", named=listed(named))


def _rise_notices(table: xr.Dataset) -> Iterator[Notice]:
    """Notice of the temperatures that are rises."""
    if rises := json.loads(table.attrs.get("rises", "[]")):
        yield Notice.of("record_rises", rises=listed(rises))


def _set_point_notices(health: SensorHealth) -> Iterator[Notice]:
    """Notice of the set points, and of what each regulates."""
    if health.set_points:
        named = listed(f"{name} (of {sensor})" for name, sensor in health.set_points.items())
        yield Notice.of("record_set_points", named=named)


def guess_notices(campaign: Campaign) -> Iterator[Notice]:
    """Notice of the units that nobody stated and the values alone suggested."""
    if (record := campaign.record) is not None and record.guessed:
        units = {key: getattr(record, key) for key in ("time_unit", "time_format", "date_order", "start")}
        units |= {name: column.unit for name, column in record.columns.items()}
        named = listed(f"{name} = {units.get(name) or 'not stated'}" for name in record.guessed)
        yield Notice.of("units_guessed", named=named)


def model_record(source: RecordSource, *, report: Report) -> Outcome:
    """Close the loop on a record."""
    result = close_record(
        source.record,
        source.declared,
        effects=None if source.health.names_causes else {},
        progress=lambda done, total, what: report("closed loop", done, total),
    )
    parts = Parts(loop=result.described(source.health.findings))
    return Outcome(record_variables(source.record, result), parts, (*source.notices, *digit_notices(result)))


def digit_notices(result: RecordResult) -> Iterator[Notice]:
    """Notice of the columns whose digits hide the noise: half a step of what they leave in a displacement exceeds it."""
    record, step = result.record, together(result.rounding)
    hidden = np.greater(0.5 * step, result.whole.sigma)
    # Of several columns those with no less than an equal share.
    large = hidden & (len(result.rounding) * result.rounding**2 >= step**2)
    named = [
        f"{name} in steps of {record.digits[name]:.3g} µm"
        for name, one in zip(record.channels, large[0], strict=True)
        if one
    ]
    named += [
        f"{name} in steps of {record.digits[name]:.3g} K"
        for name, of_channels in zip(record.sensors, large[1:], strict=True)
        if of_channels.any()
    ]
    if named:
        told = [f"{name} {um:.3g} µm" for name, um, one in zip(record.channels, step, hidden, strict=True) if one]
        yield Notice.of("record_coarse_digits", code="coarse_digits", named=listed(named), told=listed(told))


def declared_effects(campaign: Campaign) -> tuple[list[str], list[Notice]]:
    """What a record is declared with: `quasi_static`, and a notice of what in the campaign's declaration needs positions along an axis."""
    if "model" not in campaign.model_fields_set:
        return [QUASI_STATIC], []
    declared = campaign.model.declared
    dropped = [name for name in declared if name in {"axis_expansion", "table_offset"}]
    if not dropped:
        return list(declared), []
    kept = [name for name in declared if name not in dropped]
    return [QUASI_STATIC, *(name for name in kept if name != QUASI_STATIC)], [
        Notice.of("declared_without_axis", dropped=listed(dropped), model=QUASI_STATIC)
    ]


def sensor_notices(health: SensorHealth) -> Iterator[Notice]:
    """Notices of sensors and displacements that were left out because they are faulty, and of those that are suspected."""
    for one in health.findings:
        finding = f"{one.sensor} {describe_fault(one)}" + (f" ({one.run})" if one.run else "")
        with_it, without = (
            f"{number(um, 3)} µm" if um is not None and np.isfinite(um) else "no model"
            for um in (one.rmse_with_um, one.rmse_without_um)
        )
        compared = not (with_it == without == "no model")
        look = f"Look at contact, cable and input of {one.sensor}"
        asked = "Error of the declared model{of}, later parts of the training time predicted from those before: " + (
            f"{with_it} with it, {without} without."
        )
        if one.computed_with:
            yield Notice.of(
                "record_displacement_computed",
                finding=finding,
                reason=one.reason or "it is left out",
                asked=asked.format(of=f" with {one.computed_with}"),
                sensor=one.sensor,
                computed_with=one.computed_with,
            )
        elif one.state != "suspected":
            times = listed(
                f"{first / 3600.0:.4g} h" if first == last else f"{first / 3600.0:.4g} to {last / 3600.0:.4g} h"
                for first, last in one.stretches_s
                if first is not None and last is not None
            )
            where = f"they are left out at {times}" if times else "it is left out of the whole record"
            of = f" of {one.sensor}" if one.quantity == "displacement" else ""
            yield Notice(
                f"record_{'sensor' if one.quantity == 'temperature' else 'displacement'}_faulty",
                f"{finding}; {where}." + (f" {asked.format(of=of)}" if compared else ""),
                f"{look}.",
            )
        else:
            yield Notice.of("record_sensor_suspected", finding=finding, reason=one.reason, look=look)


def record_notices(record: Record) -> Iterator[Notice]:
    """Notices of gaps and pauses, of sensors that depend on the others, and of drivers that were not logged."""
    if record.runs:
        yield Notice.of(
            "record_runs", runs=counted(len(record.runs), "run"), named=listed(one.name for one in record.runs)
        )
    yield from _sample_notices(record)
    if record.unusable:
        named = [f"{name} {fault}" for name, fault in record.unusable.items()]
        yield Notice.of("record_channels_left_out", named=listed(named))
    if record.duplicates:
        yield Notice.of("record_sensors_dependent", duplicates=listed(record.duplicates))
    if record.constant_drivers:
        yield Notice.of("constant_drivers", constant_drivers=listed(record.constant_drivers))
    elif not record.drivers:
        yield Notice.of("no_drivers")


def _sample_notices(record: Record) -> Iterator[Notice]:
    """Notices of samples that are missing or impossible, and of pauses."""
    if record.gaps:
        named = [f"{name} ({counted(number, 'block')})" for name, number in record.gaps.items()]
        yield Notice.of("record_gaps", block_s=record.block_s, named=listed(named))
    if record.impossible:
        named = [f"{name} ({counted(number, 'sample')})" for name, number in record.impossible.items()]
        yield Notice.of("record_impossible_values", named=listed(named))
    pauses = np.concatenate([np.diff(run.seconds) for run in record.series(record.seconds, "s").runs()])
    pauses = pauses[pauses > 1.5 * record.block_s]
    if pauses.size:
        yield Notice.of("record_pauses", pauses=counted(pauses.size, "pause"), longest=duration(float(pauses.max())))
    missing = int(np.isnan(record.displacement).sum())
    if missing:
        yield Notice.of(
            "record_displacements_missing", block_means=counted(missing, "block mean"), size=record.displacement.size
        )


def record_variables(record: Record, result: RecordResult) -> xr.Dataset:
    """The record on its blocks with predictions, contributions and the hold-out set, for fusion.nc."""
    terms = result.state.model.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    drivers, squares = (
        np.array([powers[exponent] for powers in record.drivers.values()]).reshape(-1, record.seconds.size).T
        for exponent in EXPONENTS
    )
    sizes, units = ([record.driver_sizes[name][k] for name in record.drivers] for k in (0, 1))
    constant, um = record.constant_drivers, {"units": "um"}
    celsius = {"units": "degC", "units_metadata": "temperature: on_scale"}
    elapsed = "time since the first sample" + (", time between runs left out" if record.runs else "")
    unseen = "from parts that the model had not seen"
    dims = ("time", "channel")
    # What forward chaining has shown the model to miss by, where it can be known: not smaller than on the hold-out set.
    chained = np.array([one.channel_rmse_final_um for one in result.chained]).reshape(-1, len(record.channels))
    spread = np.fmax(
        channel_rmse(result.hold_out_errors["final"]), np.sqrt(known_mean(chained**2, axis=0)) if len(chained) else 0.0
    )
    dataset = xr.Dataset(
        {
            "displacement": (dims, record.displacement, {**um, "long_name": "mean displacement over the block"}),
            "temperature": (("time", "sensor"), record.temperature, celsius),
            "driver": (("time", "driver_name"), drivers, {"units": "1", "long_name": "driver over its largest size"}),
            "driver_square": (("time", "driver_name"), squares, {"units": "1", "long_name": "mean square of that"}),
            "driver_size": ("driver_name", sizes, {"long_name": "largest size of the driver, in driver_units"}),
            "driver_units": ("driver_name", np.array(units, dtype=object)),
            **_predictions(record, result),
            "predicted_u": ("channel", spread, {**um, "long_name": f"standard uncertainty of a prediction, {unseen}"}),
            "contribution": (
                ("effect", *dims),
                np.array(result.contributions).reshape(len(terms), *record.displacement.shape),
                um,
            ),
            "noise": ("channel", result.noise, {**um, "long_name": "noise of a block mean"}),
            "sealed": ("time", result.is_held_out, {"long_name": "held-out block"}),
            "elapsed": ("time", record.seconds, {"units": "s", "long_name": elapsed}),
            "part": ("time", record.chained + 1, {"long_name": "part of the record for forward chaining"}),
        },
        coords={
            "time": record.time,
            "channel": list(record.channels),
            "sensor": list(record.sensors),
            "driver_name": list(record.drivers),
            "effect": unique,
        },
        attrs={"block_s": record.block_s, **({"constant_drivers": ", ".join(constant)} if constant else {})},
    )
    if not record.runs:
        return dataset
    number_of = {"long_name": "number of the run", "runs": ", ".join(one.name for one in record.runs)}
    return dataset.assign(run=("time", record.run + 1, number_of))


def _predictions(record: Record, result: RecordResult) -> dict[str, Any]:
    """Predictions from the training part, and the errors of predicting every part from all others before and after each step, um."""
    dims = ("time", "channel")
    variables: dict[str, Any] = {
        f"predicted_{name}": (dims, result.predicted[name], {"units": "um"})
        for name in ("declared", "final", "last_value")
    }
    if (anchored := result.anchored) is not None:
        told = "prediction from the last value before the hold-out, with the readings since"
        variables["predicted_anchored"] = dims, anchored.predicted, {"units": "um", "long_name": told}
        variables["predicted_anchored_u"] = (
            dims,
            anchored.u,
            {"units": "um", "long_name": f"standard uncertainty of a {told}"},
        )
    after, *before = (record.displacement - predicted for predicted in result.left_out)
    if before:
        for stage, errors in {"before": before, "after": [after] * len(before)}.items():
            told = f"measured minus predicted from the other parts, {stage} the step"
            described = {"units": "um", "long_name": told}
            variables[f"block_error_{stage}"] = ("step", *dims), np.array(errors), described
    return variables
