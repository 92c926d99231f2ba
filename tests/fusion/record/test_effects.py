"""The library for a record: columns of every effect, margins of events, faults of single sensors."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Series
from fusion.effects.effect import Candidate, Effect
from fusion.effects.library import LIBRARY, library
from fusion.effects.states import LAGS_MIN
from fusion.record.blocks import Record, reduce_record
from fusion.record.effects import MEAN, record_library, sensor_faults
from tests.fusion.record_tables import record_of, table_of

BLOCKS = 200


def record(*, block_s: float = 300.0, drivers: bool = True) -> Record:
    rng = np.random.default_rng(9)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.1, (BLOCKS, 2)), axis=0)
    load = np.repeat(rng.integers(0, 2, BLOCKS // 10), 10).astype(float) * 0.8
    return record_of(np.zeros((BLOCKS, 1)), temperature, drivers={"speed": load} if drivers else None, block_s=block_s)


def candidates(name: str, of: Record, near: Candidate | None = None) -> list[Candidate]:
    return list(record_library()[0][name].candidates(of, near))


def near(event_s: float | None = None, **parameters: float | str) -> Candidate:
    return Candidate(np.empty((0, 1)), parameters, ("um",), event_s=event_s)


def test_a_quick_sensor_is_not_a_faulty_one(rng):
    """A sensor at a source answers every switching of a load that nobody logged; one jump of a slow sensor is a fault."""
    slow = 20.0 + np.cumsum(rng.normal(0.0, 0.004, (1200, 3)), axis=0)
    jumped = slow.copy()
    jumped[600:, 1] += 1.0
    quick = slow.copy()
    for first in range(100, 1100, 200):
        quick[first : first + 100, 1] += 1.0
    displacement = slow[:, :1] - 20.0 + rng.normal(0.0, 0.01, (1200, 1))
    assert [place for place, _, _ in sensor_faults(reduce_record(table_of(displacement, jumped)))] == [1]
    assert sensor_faults(reduce_record(table_of(displacement, quick))) == []


def test_the_library_of_a_record_holds_what_needs_no_positions():
    effects, not_tried = record_library()
    assert set(effects) == {
        "thermal_lag",
        "unseen_heat_source",
        "step_event",
        "periodic_disturbance",
        "sensor_fault",
    }
    assert set(not_tried) == {effect.name for effect in LIBRARY} - set(effects)
    assert set(not_tried.values()) == {"a record has no positions"}
    assert (effects["thermal_lag"].excited_by, effects["unseen_heat_source"].excited_by) == ("field", "driver")


def test_a_lag_delays_one_sensor_or_the_mean_of_all():
    of = record()
    lags = candidates("thermal_lag", of)
    # Ten lags of at least two blocks of 5 min: 11 min and more.
    lasting = [minutes for minutes in LAGS_MIN if minutes >= 10.0]
    assert [(c.parameters["sensor"], c.parameters["time_constant_min"]) for c in lags] == [
        (name, minutes) for name in ("t1", "t2", MEAN) for minutes in lasting
    ]
    rise = of.temperature - of.temperature[0]
    for candidate, values in ((lags[0], rise[:, 0]), (lags[-1], rise.mean(axis=1))):
        lag_s = 60.0 * candidate.parameters["time_constant_min"]
        np.testing.assert_array_equal(candidate.columns[:, 0], Series(of.seconds, values, "K").lagged(lag_s).values)
        assert candidate.units == ("um/K",)
    closer = candidates("thermal_lag", of, near(sensor="t2", time_constant_min=20.0))
    assert {c.parameters["sensor"] for c in closer} == {"t2"}
    np.testing.assert_allclose([c.parameters["time_constant_min"] for c in closer], 20.0 * np.geomspace(0.6, 1.6, 7))


@pytest.mark.parametrize(("block_s", "shortest"), [(150.0, 5.0), (151.0, 7.5)])
def test_a_lag_shorter_than_two_blocks_is_not_in_the_data(block_s, shortest):
    assert (
        min(c.parameters["time_constant_min"] for c in candidates("thermal_lag", record(block_s=block_s))) == shortest
    )


def test_a_source_heats_a_chain_of_parts_in_proportion_to_load_and_its_square():
    of = record()
    sources = candidates("unseen_heat_source", of)
    assert [c.parameters["time_constant_min"] for c in sources] == [5.0, 10.0, 20.0, 40.0, 80.0]
    load = of.drivers["speed"][1]
    columns = [
        Series(of.seconds, values, "1").lagged(60.0 * minutes).values
        for minutes in (0.0, 5.0, 20.0, 80.0)
        for values in (load, load**2)
    ]
    np.testing.assert_allclose(sources[2].columns, np.column_stack(columns), rtol=1e-12)
    assert sources[2].parameters["chain"] == "at once, 5 min, 20 min, 80 min"
    assert sources[2].units == ("um",) * 8
    closer = candidates("unseen_heat_source", of, near(follows="speed", time_constant_min=20.0))
    assert len(closer) == 7 and candidates("unseen_heat_source", of, near(follows="load", time_constant_min=20.0)) == []


def test_an_event_needs_a_twentieth_of_the_record_on_either_side():
    of = record()
    events = candidates("step_event", of)
    span = of.seconds[-1] - of.seconds[0]
    inner = of.seconds[(of.seconds - of.seconds[0] >= 0.05 * span) & (of.seconds[-1] - of.seconds >= 0.05 * span)]
    np.testing.assert_array_equal([c.event_s for c in events], inner)
    for candidate in events[::40]:
        np.testing.assert_array_equal(candidate.columns[:, 0], np.where(of.seconds < candidate.event_s, 0.0, 1.0))
        assert candidate.parameters == {"time_s": candidate.event_s}


def test_a_long_record_tries_every_second_block_and_a_closer_look_all():
    of = record_of(np.zeros((400, 1)), np.zeros((400, 1)))
    events = candidates("step_event", of)
    np.testing.assert_allclose(np.diff([c.event_s for c in events]), 600.0)
    instant = float(of.seconds[200])
    closer = candidates("step_event", of, near(instant, time_s=instant))
    # A hundredth of 399 blocks on either side, and eight instants within each.
    np.testing.assert_array_equal([c.event_s for c in closer], np.repeat(of.seconds[197:204], 8))
    within = closer[26]
    assert within.parameters == {"time_s": of.seconds[200] - 0.25 * of.block_s}
    np.testing.assert_array_equal(within.columns[198:202, 0], [0.0, 0.25, 1.0, 1.0])


def test_a_rhythm_has_six_periods_and_four_blocks_in_each():
    of = record()
    waves = candidates("periodic_disturbance", of)
    periods = np.array([c.parameters["period_min"] for c in waves])
    span_min = (of.seconds[-1] - of.seconds[0]) / 60.0
    assert periods.max() <= span_min / 6.0 and periods.min() >= 20.0
    assert periods.max() > span_min / 7.0 and periods.min() < 21.0
    phase = 2.0 * np.pi * of.seconds / 60.0 / periods[3]
    np.testing.assert_allclose(waves[3].columns, np.column_stack([np.cos(phase), np.sin(phase)]), atol=1e-9)
    closer = candidates("periodic_disturbance", of, near(period_min=50.0))
    frequencies = np.array([1.0 / c.parameters["period_min"] for c in closer])
    np.testing.assert_allclose(frequencies, 1.0 / 50.0 + np.linspace(-0.5, 0.5, 21) / span_min)


def jumping(*, others: float = 0.0, load: bool = False, jumps: int = 1) -> Record:
    """A quiet sensor t1 that jumps by 5 K; t2 jumps with it by a share of that, and the load may be switched there."""
    quiet = 20.0 + 0.01 * (-1.0) ** np.arange(BLOCKS)[:, None] * [1.0, 1.0]
    for k in range(jumps):
        first = 60 + 30 * k
        quiet[first:] += [5.0 * (-1.0) ** k, 5.0 * others]
    level = np.where(np.arange(BLOCKS) < 60, 0.0, 1.0)
    return record_of(np.zeros((BLOCKS, 1)), quiet, drivers={"speed": level} if load else None)


def test_a_sensor_that_jumps_alone_is_faulty():
    of = jumping()
    ((place, instant, size),) = sensor_faults(of)
    assert (place, instant) == (0, of.seconds[60]) and size == pytest.approx(5.0, abs=0.05)
    (candidate,) = candidates("sensor_fault", of)
    np.testing.assert_array_equal(candidate.columns[:, 0], np.where(np.arange(BLOCKS) < 60, 0.0, 1.0))
    assert candidate.parameters == {"sensor": "t1", "time_s": instant, "jump_K": size}
    assert candidate.event_s == instant
    assert len(candidates("sensor_fault", of, near(instant))) == 1 and candidates("sensor_fault", of, near(0.0)) == []


def test_a_jump_that_the_others_share_or_a_switching_explains_is_no_fault():
    # More than five times the jump of the others is its own; t2 does not jump alone either.
    assert [place for place, _, _ in sensor_faults(jumping(others=0.19))] == [0]
    assert sensor_faults(jumping(others=0.22)) == []
    assert sensor_faults(jumping(load=True)) == []


@pytest.mark.parametrize(("jumps", "faults"), [(2, 2), (3, 0)])
def test_a_sensor_that_jumps_three_times_is_a_quick_one(jumps, faults):
    assert len(sensor_faults(jumping(jumps=jumps))) == faults


def test_a_single_sensor_has_no_others():
    of = jumping()
    alone = record_of(np.zeros((BLOCKS, 1)), of.temperature[:, :1])
    assert len(sensor_faults(alone)) == 1


def test_what_is_missing_is_said():
    effects, _ = record_library()
    bare, whole = record(drivers=False), record()
    assert effects["unseen_heat_source"].needs(bare) == (
        "nothing that drives a heat source was logged; name speed, load or duty as record.drivers"
    )
    assert effects["unseen_heat_source"].needs(whole) is None
    assert effects["sensor_fault"].needs(whole) == "no sensor jumps alone"
    assert effects["sensor_fault"].needs(jumping()) is None
    assert effects["thermal_lag"].needs(bare) is None


def test_a_users_effect_sees_the_record_as_readings_of_one_place():
    asked = []

    def offer(readings, coefficients, chosen):
        asked.append((readings.seconds.size, dict(coefficients), chosen))
        yield Candidate(readings.seconds[:, None], {}, ("um",))

    own = Effect("own", "", "", offer, needs=lambda readings: f"{len(readings.drivers)} drivers", excited_by="driver")
    effects, _ = record_library({**library(), "own": own})
    (candidate,) = effects["own"].candidates(record(), None)
    assert asked == [(BLOCKS, {}, None)] and candidate.columns.shape == (BLOCKS, 1)
    assert (effects["own"].needs(record()), effects["own"].excited_by) == ("1 drivers", "driver")
