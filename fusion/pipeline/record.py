"""The stage of a record: read, reduced to blocks, its loop closed, described for results.json and report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from fusion.campaign.config import Campaign
from fusion.campaign.inputs import pipe_notices
from fusion.campaign.record_runs import read_record
from fusion.effects.thermal import QUASI_STATIC
from fusion.products.notices import counted, left_out_notices, listed
from fusion.products.progress import Report
from fusion.products.results import Notice, Outcome
from fusion.record.blocks import Record, reduce_record
from fusion.record.hold_out import declare
from fusion.record.loop import close_record
from fusion.record.prediction import known_mean
from fusion.record.result import RecordResult
from fusion.record.sensor_health import SensorHealth, examine_record
from fusion.report.wording import duration, number


@dataclass(frozen=True)
class RecordSource:
    """A record as it was read, before anything is modelled: what is declared, what was left out, and the health of its sensors."""

    record: Record
    declared: list[str]
    notices: list[Notice]
    health: SensorHealth


def read_source(campaign: Campaign) -> RecordSource:
    """Read a record and refuse what cannot be modelled.

    Parameters
    ----------
    campaign : with a ``[record]``

    Raises
    ------
    TableError, RecordError
        If the table cannot be read or is too short, no sensor is sound, or a declared effect has no meaning for a record.
    """
    table = read_record(campaign)
    declared, notices = declared_effects(campaign)
    health = examine_record(table, declared)
    record = reduce_record(health.table)
    declare(declared, record)
    left_out = [*pipe_notices(campaign), *left_out_notices(table, "record_rows_left_out")]
    return RecordSource(
        record, declared, [*sensor_notices(health), *notices, *left_out, *record_notices(record)], health
    )


def model_record(source: RecordSource, *, report: Report) -> Outcome:
    """Close the loop on a record.

    Parameters
    ----------
    source : the record as read
    report : called with the stage, steps done and steps in total
    """
    result = close_record(
        source.record, source.declared, progress=lambda done, total, what: report("closed loop", done, total)
    )
    loop = {**result.as_json(), "sensor_faults": source.health.as_json()}
    return Outcome(record_variables(source.record, result), {"loop": loop}, tuple(source.notices))


def declared_effects(campaign: Campaign) -> tuple[list[str], list[Notice]]:
    """What a record is declared with: `quasi_static`, and a notice of what in the campaign's declaration needs positions along an axis.

    Parameters
    ----------
    campaign : with a ``[record]``
    """
    if "model" not in campaign.model_fields_set:
        return [QUASI_STATIC], []
    declared = campaign.model.declared
    dropped = [name for name in declared if name in {"axis_expansion", "table_offset"}]
    if not dropped:
        return list(declared), []
    message = (
        f"{listed(dropped)} need positions along an axis, which a record does not have; its declared model is {QUASI_STATIC}: "
        "every displacement linear in the temperatures."
    )
    remedy = f'Write declared = ["{QUASI_STATIC}"] under [model], or leave [model] out.'
    kept = [name for name in declared if name not in dropped]
    return [QUASI_STATIC, *(name for name in kept if name != QUASI_STATIC)], [
        Notice("declared_without_axis", message, remedy)
    ]


def sensor_notices(health: SensorHealth) -> list[Notice]:
    """Notices of sensors that were left out because they are faulty, and of those that are suspected.

    Parameters
    ----------
    health : of the sensors of a record
    """
    notices = []
    for fault in health.faults:
        name = health.names[fault.sensor]
        told = f"{name} {fault.words}" + (f" ({health.runs[fault.sensor]})" if health.runs else "")
        if fault.is_clear:
            error = health.errors_um[name]
            with_it = f"{number(error, 3)} µm with it" if np.isfinite(error) else "no model with it"
            notices.append(
                Notice(
                    "record_sensor_faulty",
                    f"{told}; it is left out of the whole record. Held-out error of the declared model: {with_it}, "
                    f"{number(health.sound_um, 3)} µm without.",
                    f"Look at contact, cable and input of {name}.",
                )
            )
        else:
            notices.append(
                Notice(
                    "record_sensor_suspected",
                    f"{told}. It is suspected only ({fault.reason}), and stays in the model.",
                    f"Look at contact, cable and input of {name}; take it out of record.temperatures if it is faulty.",
                )
            )
    return notices


def record_notices(record: Record) -> list[Notice]:
    """Notices of gaps and pauses, of sensors that depend on the others, and of drivers that were not logged.

    Parameters
    ----------
    record : on its blocks
    """
    notices = []
    if record.runs:
        notices.append(
            Notice(
                "record_runs",
                f"{counted(len(record.runs), 'run')} in the order {listed(one.name for one in record.runs)}: displacements and rises count "
                "from the first block of each run, and nothing is carried from one run to the next.",
                "",
            )
        )
    notices += _sample_notices(record)
    if record.duplicates:
        notices.append(
            Notice(
                "record_sensors_dependent",
                f"Left out because the other sensors tell the same: {listed(record.duplicates)}.",
                "Name each sensor once under record.temperatures.",
            )
        )
    if not record.drivers:
        notices.append(
            Notice(
                "no_drivers",
                "No driver was logged, so a heat source that no sensor sees cannot be told from a drift.",
                "Log spindle speed, load or duty in the same table, and name the column under record.drivers.",
            )
        )
    return notices


def _sample_notices(record: Record) -> list[Notice]:
    """Notices of samples that are missing or impossible, and of pauses."""
    notices = []
    if record.gaps:
        named = [f"{name} ({number} blocks)" for name, number in record.gaps.items()]
        notices.append(
            Notice(
                "record_gaps",
                f"Blocks of {record.block_s:g} s without a value were interpolated: {listed(named)}.",
                "Look at the logger; effects that act within the gaps cannot be seen.",
            )
        )
    if record.impossible:
        named = [f"{name} ({counted(number, 'sample')})" for name, number in record.impossible.items()]
        notices.append(
            Notice(
                "record_impossible_values",
                f"Samples beyond what can be measured count as missing: {listed(named)}.",
                "Look at the logger and at the units in the heading: it writes such a number where it has no value.",
            )
        )
    pauses = np.concatenate([np.diff(run.seconds) for run in record.series(record.seconds, "s").runs()])
    pauses = pauses[pauses > 1.5 * record.block_s]
    if pauses.size:
        notices.append(
            Notice(
                "record_pauses",
                f"Nothing was logged in {counted(pauses.size, 'pause')}, the longest {duration(float(pauses.max()))}; pauses are left out "
                "and drivers interpolated linearly across them.",
                "",
            )
        )
    missing = int(np.isnan(record.displacement).sum())
    if missing:
        notices.append(
            Notice(
                "record_displacements_missing",
                f"{counted(missing, 'block mean')} of {record.displacement.size} of the displacements missing; left out of every fit.",
                "",
            )
        )
    return notices


def record_variables(record: Record, result: RecordResult) -> xr.Dataset:
    """The record on its blocks with predictions, contributions and the hold-out set, for fusion.nc.

    Parameters
    ----------
    record : on its blocks
    result :  of the closed loop

    Returns
    -------
    Dataset
        Dims time, channel, sensor, driver_name, effect; displacements in um, temperatures in degC.
    """
    terms = result.state.model.terms
    names = [term.effect for term in terms]
    unique = [name if names.count(name) == 1 else f"{name} {at + 1}" for at, name in enumerate(names)]
    drivers = np.array([powers[1] for powers in record.drivers.values()]).reshape(-1, record.seconds.size).T
    um: dict[str, Any] = {"units": "um"}
    dims = ("time", "channel")
    # What forward chaining has shown the model to miss by, where it can be known: not smaller than on the hold-out set.
    chained = np.array([one.rmse_final_um for one in result.chained]).reshape(-1, len(record.channels))
    spread = np.fmax(result.errors[-1], np.sqrt(known_mean(chained**2, axis=0)) if len(chained) else 0.0)
    dataset = xr.Dataset(
        {
            "displacement": (dims, record.displacement, {**um, "long_name": "mean displacement over the block"}),
            "temperature": (
                ("time", "sensor"),
                record.temperature,
                {"units": "degC", "units_metadata": "temperature: on_scale"},
            ),
            "driver": (("time", "driver_name"), drivers, {"units": "1", "long_name": "driver over its largest size"}),
            "driver_size": (
                ("driver_name",),
                [record.driver_sizes[name][0] for name in record.drivers],
                {"long_name": "largest size of the driver, in driver_units"},
            ),
            "driver_units": (
                ("driver_name",),
                np.array([record.driver_sizes[name][1] for name in record.drivers], dtype=object),
            ),
            **_predictions(record, result),
            "predicted_u": (
                "channel",
                spread,
                {**um, "long_name": "standard uncertainty of a prediction, from parts that the model had not seen"},
            ),
            "contribution": (
                ("effect", *dims),
                np.array([result.contribution(term) for term in terms]).reshape(len(terms), *record.displacement.shape),
                um,
            ),
            "noise": ("channel", result.whole.sigma, {**um, "long_name": "noise of a block mean"}),
            "sealed": ("time", result.hold_out, {"long_name": "block that took no part in any choice"}),
            "part": ("time", record.chained + 1, {"long_name": "part of the record for forward chaining"}),
        },
        coords={
            "time": record.time,
            "channel": list(record.channels),
            "sensor": list(record.sensors),
            "driver_name": list(record.drivers),
            "effect": unique,
        },
        attrs={"block_s": record.block_s},
    )
    if not record.runs:
        return dataset
    return dataset.assign(
        run=(
            "time",
            record.run + 1,
            {"long_name": "number of the run", "runs": ", ".join(one.name for one in record.runs)},
        ),
        elapsed=(
            "time",
            record.seconds,
            {"units": "s", "long_name": "time since the start, time between runs left out"},
        ),
    )


def _predictions(record: Record, result: RecordResult) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]:
    """Predictions from the training part, and the errors of predicting every part from all others before and after each step, um."""
    dims = ("time", "channel")
    named = {
        "declared": result.predictions[0].predicted,
        "final": result.predictions[-1].predicted,
        "last_value": result.plain["last_value"],
    }
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = {
        f"predicted_{name}": (dims, values, {"units": "um"}) for name, values in named.items()
    }
    after, *before = (record.displacement - predicted for predicted in result.left_out)
    if before:
        told = "measured minus predicted from the other parts"
        stages = {"before": before, "after": [after] * len(before)}
        for stage, errors in stages.items():
            described = {"units": "um", "long_name": f"{told}, {stage} the step"}
            variables[f"block_error_{stage}"] = ("step", *dims), np.array(errors), described
    return variables
