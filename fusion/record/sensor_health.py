"""Sensors of a record that are not sound: left out before any model sees them, with the error that the declared model makes with them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from fusion.alignment.sensor_health import SensorFault, examine_sensors
from fusion.record.blocks import RecordError, reduce_record
from fusion.record.hold_out import declare, hold_out
from fusion.record.model import columns_of
from fusion.record.prediction import predict, rmse


@dataclass(frozen=True)
class SensorHealth:
    """Sensors that are faulty or suspected.

    Attributes
    ----------
    table : Dataset
        The record without the faulty sensors; suspected ones stay.
    names : tuple of str
        Sensors of the record as it was read.
    faults : tuple of SensorFault
        In the order of the sensors.
    errors_um : mapping of str to float
        Error of the declared model on the hold-out set with a faulty sensor, um, by sensor; nan where it has too few readings for a model.
    sound_um : float
        The same without all faulty sensors, um.
    runs : mapping of int to str
        Of a record of several runs, the one that shows the fault, by place of the sensor; onsets count from its start.
    """

    table: xr.Dataset
    names: tuple[str, ...]
    faults: tuple[SensorFault, ...]
    errors_um: dict[str, float]
    sound_um: float
    runs: dict[int, str] = field(default_factory=dict)

    def as_json(self) -> list[dict[str, Any]]:
        """The part ``loop.sensor_faults`` of results.json."""
        return [
            {
                "sensor": self.names[fault.sensor],
                "kind": fault.kind.value,
                "state": "left_out" if fault.is_clear else "suspected",
                **({"run": self.runs[fault.sensor]} if self.runs else {}),
                "onset_s": fault.onset_s,
                "onset_u_s": fault.onset_u_s,
                "size": fault.size,
                "ratio": fault.ratio,
                "limit": fault.limit,
                "reason": fault.reason,
                "rmse_with_um": self.errors_um[self.names[fault.sensor]] if fault.is_clear else np.nan,
                "rmse_without_um": self.sound_um if fault.is_clear else np.nan,
            }
            for fault in self.faults
        ]


def examine_record(table: xr.Dataset, declared: Sequence[str]) -> SensorHealth:
    """Examine the sensors of a record, and leave out those that are faulty.

    A faulty sensor is left out of the whole record, so that one model serves all of it: it was trained on nothing that breaks, and predicts
    what follows the fault as it predicts what came before.

    Parameters
    ----------
    table : Dataset
        As :func:`fusion.campaign.record_runs.read_record` returns it.
    declared : sequence of str
        Names of the declared effects.

    Raises
    ------
    RecordError
        If no sensor is left.

    Notes
    -----
    Only temperatures and drivers are looked at, also of the time that is held out: they are known when it is predicted.
    """
    names = tuple(str(name) for name in table["sensor"].values)
    faults, where = _examine_runs(table)
    faulty = [fault.sensor for fault in faults if fault.is_clear]
    if not faulty:
        return SensorHealth(table, names, faults, {}, np.nan, where)
    kept = [k for k in range(len(names)) if k not in faulty]
    if not kept:
        told = "; ".join(
            f"{names[fault.sensor]}: {fault.kind} from {fault.onset_s / 3600.0:.2f} h on" for fault in faults
        )
        raise RecordError(
            f"{table.attrs.get('source', 'record')}: no temperature sensor is sound ({told}); repeat the test"
        )
    errors = {names[k]: _declared_error(table.isel(sensor=sorted([*kept, k])), declared) for k in faulty}
    sound = table.isel(sensor=kept)
    return SensorHealth(sound, names, faults, errors, _declared_error(sound, declared), where)


def _examine_runs(table: xr.Dataset) -> tuple[tuple[SensorFault, ...], dict[int, str]]:
    """Faults, at most one per sensor, and of several runs the one that shows it, by sensor; every run is examined by itself."""
    runs = json.loads(table.attrs.get("runs", '[""]'))
    number = table["run"].values if "run" in table.coords else np.zeros(table.sizes["time"], int)
    chosen: dict[int, tuple[SensorFault, str]] = {}
    for k, run in enumerate(runs):
        here = table.isel(time=number == k)
        seconds = np.asarray((here["time"].values - here["time"].values[0]) / np.timedelta64(1, "s"), np.float64)
        for fault in examine_sensors(seconds, here["temperature"].values, here["driver"].values):
            earlier = chosen.get(fault.sensor)
            if earlier is None or (fault.is_clear and not earlier[0].is_clear):
                chosen[fault.sensor] = (fault, run)
    faults = tuple(chosen[sensor][0] for sensor in sorted(chosen))
    return faults, {sensor: run for sensor, (_, run) in chosen.items() if run}


def _declared_error(table: xr.Dataset, declared: Sequence[str]) -> float:
    """Error of the declared model on the hold-out set, um; nan where a sensor has too few readings."""
    try:
        record = reduce_record(table)
        train, _ = hold_out(record)
    except RecordError:
        return np.nan
    return rmse(record, predict(record, columns_of(record, declare(declared, record)), train).predicted, ~train)
