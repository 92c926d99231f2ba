"""Faulty sensors of a record are left out before any model; suspected ones stay."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.record.blocks import RecordError
from fusion.record.sensor_health import examine_record
from tests.fusion.record_tables import twin_table


def test_a_sound_record_passes_as_it_is():
    table = twin_table(seed=31)
    health = examine_record(table, ["quasi_static"])
    assert health.table is table
    assert health.as_json() == []


def test_a_sensor_that_breaks_is_left_out_and_the_error_with_it_is_stated():
    table = twin_table(seed=31)
    table["temperature"][900:, 2] += 28.0
    health = examine_record(table, ["quasi_static"])
    (part,) = health.as_json()
    assert "t3" not in health.table["sensor"].values
    assert (part["sensor"], part["kind"], part["state"]) == ("t3", "jump", "left_out")
    # The break lies in the training part, so that a model with it learns not to trust the sensor; without it nothing has to be learnt.
    assert part["rmse_without_um"] == health.sound_um < part["rmse_with_um"]


def test_a_break_within_the_hold_out_spoils_a_model_that_trusts_the_sensor():
    table = twin_table(seed=31)
    table["temperature"][1250:, 2] += 28.0
    (part,) = examine_record(table, ["quasi_static"]).as_json()
    assert part["rmse_with_um"] > 3.0 * part["rmse_without_um"]


def test_a_sensor_without_enough_readings_has_no_error():
    table = twin_table(seed=31)
    table["temperature"][500:, 2] = np.nan
    health = examine_record(table, ["quasi_static"])
    assert np.isnan(health.errors_um["t3"])
    assert np.isfinite(health.sound_um)


def test_a_record_without_any_sound_sensor_is_refused():
    table = twin_table(seed=31).isel(sensor=[0, 1])
    table["temperature"][700:] = 850.0
    with pytest.raises(
        RecordError, match=r"record\.csv: no temperature sensor is sound \(t1: no signal from 11\.67 h on; t2: "
    ):
        examine_record(table, ["quasi_static"])
