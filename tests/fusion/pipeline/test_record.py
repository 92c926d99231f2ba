"""The main job on a record: what is declared, what is noted, and the product on its blocks."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.analysis.drift_model.model import Term
from fusion.analysis.drift_model.record import SensorHealth
from fusion.analysis.drift_model.record_data import Record
from fusion.analysis.effects.effect import Candidate
from fusion.pipeline.record import declared_effects, digit_notices, record_notices, record_variables, sensor_notices
from fusion.results.loop import SensorFaultPart
from tests.fusion.record_tables import record_of


def campaign_with(*declared: str) -> SimpleNamespace:
    return SimpleNamespace(model_fields_set={"model"}, model=SimpleNamespace(declared=declared))


def test_a_record_is_declared_quasi_static_and_what_needs_positions_is_dropped():
    silent = SimpleNamespace(model_fields_set=set(), model=SimpleNamespace(declared=("axis_expansion",)))
    assert declared_effects(silent) == (["quasi_static"], [])
    assert declared_effects(campaign_with("quasi_static")) == (["quasi_static"], [])
    assert declared_effects(campaign_with()) == ([], [])
    declared, (notice,) = declared_effects(campaign_with("axis_expansion", "table_offset"))
    assert declared == ["quasi_static"]
    assert notice.code == "declared_without_axis"
    assert notice.message.startswith("axis_expansion; table_offset need positions along an axis")
    # What has no meaning for a record is left to be refused by name.
    declared, _ = declared_effects(campaign_with("table_offset", "quasi_static", "dead_path"))
    assert declared == ["quasi_static", "dead_path"]


def plain(**changes) -> Record:
    record = record_of(np.zeros((50, 2)), np.zeros((50, 1)), drivers={"speed": np.zeros(50)})
    return replace(record, **changes)


def notices_of(record: Record) -> dict[str, str]:
    return {notice.code: notice.message for notice in record_notices(record)}


def test_gaps_missing_displacements_sensors_and_drivers_are_noted():
    assert notices_of(plain()) == {}
    displacement = np.zeros((50, 2))
    displacement[3:6, 1] = np.nan
    told = notices_of(plain(gaps={"t1": 4, "speed": 1}, displacement=displacement))
    assert told["record_gaps"] == "Blocks of 300 s without a value were interpolated: t1 (4 blocks); speed (1 block)."
    assert told["record_displacements_missing"].startswith("3 block means of 100 of the displacements missing")
    assert set(told) == {"record_gaps", "record_displacements_missing"}
    told = notices_of(plain(unusable={"ch3": "never moves"}))
    assert told["record_channels_left_out"] == "Displacements that cannot be modelled are left out: ch3 never moves."
    told = notices_of(plain(duplicates=("t2", "t3"), drivers={}))
    assert told["record_sensors_dependent"] == "Left out because they duplicate other sensors: t2; t3."
    assert told["no_drivers"].startswith("The record has no driver that changes, so an unseen heat source")


@pytest.mark.parametrize(("longer_s", "pauses"), [(150.0, 0), (151.0, 1)])
def test_a_pause_is_longer_than_one_and_a_half_blocks(longer_s, pauses):
    seconds = plain().seconds.copy()
    seconds[20:] += longer_s
    told = notices_of(plain(seconds=seconds))
    assert len(told) == pauses
    if pauses:
        assert told["record_pauses"].startswith("Nothing was logged in 1 pause, the longest ")


def test_every_finding_is_noted_with_both_errors_or_its_reason():
    ramp, silent, glitch, computed, suspected = (
        SensorFaultPart(**{**one, "onset_u_s": 360.0, "limit": 10.0, "rmse_without_um": 2.345})
        for one in (
            {"sensor": "t1", "kind": "ramp", "state": "left_out", "onset_s": 7200.0, "size": 28.0, "ratio": 90.0, "reason": "",
             "rmse_with_um": 12.34},
            {"sensor": "t2", "kind": "no signal", "state": "left_out", "onset_s": 7200.0, "size": np.nan, "ratio": np.nan, "reason": "",
             "rmse_with_um": np.nan},
            {"sensor": "ch1", "kind": "glitch", "state": "readings_left_out", "onset_s": 3600.0, "size": 4302.5, "ratio": np.nan,
             "reason": "", "rmse_with_um": 611.0, "readings": 3, "stretches_s": [(3600.0, 3604.0), (9000.0, 9000.0)],
             "quantity": "displacement"},
            {"sensor": "ch2", "kind": "computed", "state": "left_out", "onset_s": 7200.0, "size": np.nan, "ratio": 3.0, "reason": "",
             "rmse_with_um": 0.7, "computed_with": "t1", "quantity": "displacement"},
            {"sensor": "t3", "kind": "jump", "state": "suspected", "onset_s": 3600.0, "size": -2.0, "ratio": 12.0,
             "reason": "other sensors respond", "rmse_with_um": np.nan},
        )
    )  # fmt: skip
    told = list(sensor_notices(SensorHealth(None, (ramp, silent, glitch, computed, suspected))))
    assert [one.code.removeprefix("record_") for one in told] == [
        "sensor_faulty", "sensor_faulty", "displacement_faulty", "displacement_computed", "sensor_suspected",
    ]  # fmt: skip
    ramp, silent, glitch, computed, suspected = (one.message for one in told)
    assert ramp.startswith("t1 ramps by 28 K from 2.00 h on (standard uncertainty 0.1 h); it is left out")
    assert ramp.endswith("12.3 µm with it, 2.35 µm without.")
    assert "no model with it" in silent
    assert glitch.startswith("ch1 leaves its course by up to 4302 µm and comes back (3 readings) from 1.00 h on")
    assert (
        "they are left out at 1 to 1.001 h; 2.5 h. Error of the declared model of ch1, later parts of the training time"
        in glitch
    )
    assert computed.startswith("ch2 is computed with the faulty sensor t1 from 2.00 h on")
    assert "t3 jumps by 2 K from 1.00 h on" in suspected
    assert "suspected only (other sensors respond), and stays in the model" in suspected


def result_of(record: Record, *, names: tuple[str, ...], chained: list[tuple[float, float]]) -> SimpleNamespace:
    """As much of a result as the product asks for."""
    candidate = Candidate(np.zeros((50, 1)), {}, ("um",))
    terms = tuple(Term(name, candidate) for name in names)
    return SimpleNamespace(
        state=SimpleNamespace(model=SimpleNamespace(terms=terms)),
        predicted={
            name: np.full((50, 2), value) for name, value in {"declared": 0.0, "final": 2.0, "last_value": 7.0}.items()
        },
        hold_out_errors={"final": np.array([[1.0, 2.0]])},
        chained=[SimpleNamespace(channel_rmse_final_um=errors) for errors in chained],
        contributions=[np.full((50, 2), 10.0 + k) for k in range(len(terms))],
        noise=np.array([0.1, 0.2]),
        is_held_out=np.arange(50) >= 40,
        left_out=[np.full((50, 2), 4.0), np.full((50, 2), 6.0)],
        anchored=None,
    )


def test_the_product_holds_the_record_on_its_blocks():
    speed = np.linspace(0.0, 1.0, 50)
    record = plain(drivers={"speed": {1: speed, 2: speed**2}})
    dataset = record_variables(record, result_of(record, names=("a", "b", "a"), chained=[]))
    assert dataset["effect"].values.tolist() == ["a 1", "b", "a 3"]
    np.testing.assert_array_equal(dataset["contribution"][:, 0, 0], [10.0, 11.0, 12.0])
    np.testing.assert_array_equal(dataset["driver"], speed[:, None])
    np.testing.assert_array_equal(dataset["predicted_declared"], 0.0)
    np.testing.assert_array_equal(dataset["predicted_final"], 2.0)
    np.testing.assert_array_equal(dataset["predicted_last_value"], 7.0)
    # Of the one step, without it and with it.
    np.testing.assert_array_equal(dataset["block_error_before"][0], record.displacement - 6.0)
    np.testing.assert_array_equal(dataset["block_error_after"][0], record.displacement - 4.0)
    np.testing.assert_array_equal(dataset["sealed"], np.arange(50) >= 40)
    # Parts are numbered from 1.
    assert (int(dataset["part"].min()), int(dataset["part"].max())) == (1, 8)
    assert dataset["time"].values[1] == np.datetime64("2026-01-05T06:07:30", "ns")
    np.testing.assert_array_equal(dataset["noise"], [0.1, 0.2])
    assert dataset.attrs == {"block_s": 300.0}


def test_the_uncertainty_of_a_prediction_is_what_unseen_parts_were_missed_by():
    record = plain()
    alone = record_variables(record, result_of(record, names=(), chained=[]))
    np.testing.assert_array_equal(alone["predicted_u"], [1.0, 2.0])
    assert alone["contribution"].shape == (0, 50, 2)
    # The root mean square over the parts, where it is larger than the error on the hold-out set.
    chained = record_variables(record, result_of(record, names=(), chained=[(3.0, 1.0), (4.0, np.nan)]))
    np.testing.assert_allclose(chained["predicted_u"], [np.sqrt(12.5), 2.0])


def test_a_record_without_drivers_has_a_product_all_the_same():
    record = plain(drivers={})
    assert record_variables(record, result_of(record, names=("a",), chained=[]))["driver"].shape == (50, 0)


def test_columns_whose_digits_hide_the_noise_are_named():
    record = replace(plain(), digits=dict.fromkeys((*plain().channels, *plain().sensors), 1.0))
    steps = np.array([[1.0, 0.1], *np.zeros((len(record.sensors), 2))])
    steps[1, 1] = 1.0
    fine, coarse = (
        list(
            digit_notices(
                SimpleNamespace(record=record, rounding=steps, whole=SimpleNamespace(sigma=np.full(2, sigma)))
            )
        )
        for sigma in (0.6, 0.4)
    )
    assert fine == [] and [one.code for one in coarse] == ["coarse_digits"]
    assert "ch1 in steps of 1 µm; t1 in steps of 1 K" in coarse[0].message
