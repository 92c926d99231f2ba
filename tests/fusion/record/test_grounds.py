"""Grounds of a record: excitation by its drivers, noise of its sensors, the course of a delayed sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Series
from fusion.effects.effect import Candidate
from fusion.loop.admissibility import refuse
from fusion.loop.decisions import Decision, Reason
from fusion.record.blocks import Record, reduce_record
from fusion.record.effects import MEAN, record_library
from fusion.record.grounds import RecordGrounds, _smoothed, one_switching_share
from fusion.record.hold_out import declare
from fusion.record.model import RecordFit, fit_record
from tests.fusion.record_tables import record_of, table_of


def test_a_load_that_was_switched_once_names_no_source(rng):
    hours = np.arange(1440) / 60.0
    speed = (hours > 2.0) * 3000.0
    source = 1.0 - np.exp(-np.maximum(hours - 2.0, 0.0) / 0.7)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.02, (1440, 3)), axis=0)
    displacement = source[:, None] * [4.0, -3.0] + rng.normal(0.0, 0.1, (1440, 2))
    record = reduce_record(table_of(displacement, temperature, speed))
    used = np.ones(record.seconds.size, bool)
    candidate = next(
        m
        for m in record_library()[0]["unseen_heat_source"].candidates(record, None)
        if m.parameters["time_constant_min"] == 40.0
    )
    assert one_switching_share(record.drivers["speed"][1]) > 0.99
    assert one_switching_share(np.tile([0.0, 0.0, 1.0, 1.0], 50)) < 0.1
    model = fit_record(record, declare(["quasi_static"], record), used)
    refusal = refuse("unseen_heat_source", "driver", candidate, RecordGrounds(model))
    assert refusal is not None and refusal.reason is Reason.SINGLE_SWITCHING
    assert refusal.sentence.startswith("speed was switched only once")


def test_a_noisy_sensor_names_no_lag(rng):
    hours = np.arange(1440) / 60.0
    truth = 3.0 * np.sin(hours / 2.0) + np.sin(hours * 1.7)
    temperature = np.column_stack([20.0 + truth + rng.normal(0.0, 0.5, 1440), 20.0 + rng.normal(0.0, 0.5, 1440)])
    displacement = truth[:, None] * [1.0, -2.0] + rng.normal(0.0, 0.1, (1440, 2))
    record = reduce_record(table_of(displacement, temperature))
    model = fit_record(record, declare(["quasi_static"], record), np.ones(record.seconds.size, bool))
    candidate = next(
        m for m in record_library()[0]["thermal_lag"].candidates(record, None) if m.parameters["sensor"] == "t1"
    )
    refusal = refuse("thermal_lag", "field", candidate, RecordGrounds(model))
    assert refusal is not None and refusal.reason is Reason.TEMPERATURE_NOISE
    assert "fits better by its smoothness alone" in refusal.sentence


BLOCKS = 240


def quiet(record: Record, used: np.ndarray | None = None) -> RecordFit:
    """A record and which of its blocks are used: what most grounds are asked of needs no fit."""
    return RecordFit(record, np.ones(BLOCKS, bool) if used is None else used, (), (), (), ())


def switching() -> np.ndarray:
    """A load that is switched at random, every quarter of an hour at most."""
    return np.repeat(np.random.default_rng(5).integers(0, 2, BLOCKS // 6), 6).astype(float)


def test_an_event_within_two_blocks_of_a_switching_belongs_to_it():
    level = np.where(np.arange(BLOCKS) < 100, 0.0, 1.0)
    record = record_of(np.zeros((BLOCKS, 1)), np.zeros((BLOCKS, 1)), drivers={"speed": level})
    grounds = RecordGrounds(quiet(record))
    for block, at in ((97, False), (98, True), (102, True), (103, False)):
        instant = float(record.seconds[block])
        event = Candidate(np.zeros((BLOCKS, 1)), {}, ("um",), event_s=instant)
        assert grounds.at_switching(event) == (instant / 3600.0 if at else None)
    assert grounds.at_switching(Candidate(np.zeros((BLOCKS, 1)), {}, ("um",))) is None


def stepped(at: int, *, beside: int | None = None) -> tuple[RecordFit, Candidate]:
    """A record whose load is switched once in the middle, with a step at one block and perhaps at another, and the first as an event."""
    rng = np.random.default_rng(8)
    level = np.where(np.arange(BLOCKS) < 120, 0.0, 1.0)
    steps = sum((3.0 * (np.arange(BLOCKS) >= block) for block in (at, beside) if block is not None), np.zeros(BLOCKS))
    displacement = steps[:, None] + 0.1 * rng.standard_normal((BLOCKS, 2))
    record = record_of(displacement, 20.0 + rng.normal(0.0, 0.01, (BLOCKS, 1)), drivers={"speed": level})
    event = Candidate((np.arange(BLOCKS) >= at).astype(float)[:, None], {}, ("um",), float(record.seconds[at]))
    return fit_record(record, [], np.ones(BLOCKS, bool)), event


def test_an_event_beside_a_switching_must_not_stand_in_for_its_response():
    """Three blocks after the switching an instant is admissible; a shift at the switching explains most of what it would."""
    model, _ = stepped(120)
    late = Candidate((np.arange(BLOCKS) >= 123).astype(float)[:, None], {}, ("um",), float(model.record.seconds[123]))
    grounds = RecordGrounds(model, least_gain=10.0)
    assert grounds.is_admissible(late)
    assert grounds.at_switching(late) == pytest.approx(float(model.record.seconds[120]) / 3600.0)
    for at, beside in ((60, None), (60, 120)):
        model, event = stepped(at, beside=beside)
        assert RecordGrounds(model, least_gain=10.0).at_switching(event) is None


def test_candidates_that_no_fit_could_save_are_not_admissible():
    model, event = stepped(119)
    noisy = replace(model.record, temperature_noise=np.array([0.5]))
    grounds = RecordGrounds(replace(model, record=noisy))
    assert not grounds.is_admissible(event)
    assert not grounds.is_admissible(Candidate(np.zeros((BLOCKS, 1)), {"sensor": "t1"}, ("um/K",)))
    assert grounds.is_admissible(Candidate(np.zeros((BLOCKS, 1)), {"period_min": 30.0}, ("um", "um")))


@pytest.mark.parametrize("minutes", [30.0, 600.0, 6000.0])
def test_a_smoothed_copy_has_the_length_of_the_record(minutes):
    """A window longer than the record is the mean of all; at the ends it holds what there is."""
    record = record_of(np.zeros((BLOCKS, 1)), np.zeros((BLOCKS, 1)))
    values = np.random.default_rng(3).standard_normal(BLOCKS)
    half = round(minutes / 5.0)
    expected = [values[max(0, k - half) : k + half + 1].mean() for k in range(BLOCKS)]
    np.testing.assert_allclose(_smoothed(record, values, minutes), expected, atol=1e-12)


def test_the_noise_of_a_sensor_counts_over_the_range_of_the_used_blocks():
    temperature = np.column_stack([np.linspace(20.0, 24.0, BLOCKS), np.linspace(20.0, 22.0, BLOCKS)])
    record = record_of(np.zeros((BLOCKS, 1)), temperature, temperature_noise=0.03)
    half = np.arange(BLOCKS) < BLOCKS // 2
    grounds = RecordGrounds(quiet(record, half))

    def lag_of(sensor: str) -> Candidate:
        return Candidate(np.zeros((BLOCKS, 1)), {"sensor": sensor}, ("um/K",))

    name, noise, limit = grounds.noise_of_lag(lag_of("t2"))
    assert (name, limit) == ("t2", 0.01)
    assert noise == pytest.approx(0.03 / np.ptp(temperature[half, 1]))
    # The mean of two sensors has the noise of one over the square root of two, and a range of its own.
    name, noise, _ = grounds.noise_of_lag(lag_of(MEAN))
    assert name == MEAN
    assert noise == pytest.approx(0.03 / np.sqrt(2.0) / np.ptp(temperature[half].mean(axis=1)))


@pytest.mark.parametrize(
    ("driver", "share"),
    [
        ([0.0, 0.0, 1.0, 1.0], 1.0),
        ([1.0, 0.0, 0.0, 0.0], 1.0),
        # Between-variance of the best cut, after one or three of four: 1/3 of the whole.
        ([0.0, 1.0, 0.0, 1.0], 1.0 / 3.0),
        # A ramp: halves of means 0.5 and 2.5 explain 4 of 5.
        ([0.0, 1.0, 2.0, 3.0], 0.8),
    ],
)
def test_the_share_of_one_switching_is_that_of_the_best_step(driver, share):
    assert one_switching_share(np.array(driver)) == pytest.approx(share)


def test_only_a_source_needs_a_load_that_is_switched_more_than_once():
    once, often = np.where(np.arange(BLOCKS) < 100, 0.0, 1.0), switching()
    record = record_of(np.zeros((BLOCKS, 1)), np.zeros((BLOCKS, 1)), drivers={"once": once, "often": often})
    grounds = RecordGrounds(quiet(record))

    def source(driver: str) -> Candidate:
        return Candidate(np.zeros((BLOCKS, 1)), {"follows": driver}, ("um",))

    assert grounds.refuse_single_excitation("source", "driver", source("once")) == Decision(
        "source", Reason.SINGLE_SWITCHING, {"driver": "once", "share_percent": pytest.approx(100.0)}
    )
    assert grounds.refuse_single_excitation("source", "driver", source("often")) is None
    assert grounds.refuse_single_excitation("thermal_lag", "field", source("once")) is None
    # Only the used blocks count: before the second switching there was one.
    early = np.arange(BLOCKS) < np.flatnonzero(np.diff(often))[1]
    assert RecordGrounds(quiet(record, early)).refuse_single_excitation("source", "driver", source("often")) is not None


def sensed(displacement: np.ndarray, rise: np.ndarray, rng: np.random.Generator) -> RecordFit:
    """One sensor and one channel, fitted with the sensor declared."""
    noise = 0.02 * rng.standard_normal(BLOCKS)
    record = record_of((displacement + noise)[:, None], 20.0 + rise[:, None])
    return fit_record(record, declare(["quasi_static"], record), np.ones(BLOCKS, bool))


def course() -> tuple[np.ndarray, np.ndarray]:
    """A temperature that follows the load with 20 min, and the same 30 min later."""
    seconds = 300.0 * (np.arange(BLOCKS) + 0.5)
    rise = 5.0 * Series(seconds, switching(), "1").lagged(1200.0, at_rest=0.0).values
    rise -= rise[0]
    return rise, Series(seconds, rise, "K").lagged(1800.0).values


def lag_candidate(delayed: np.ndarray) -> Candidate:
    return Candidate(delayed[:, None], {"sensor": "t1", "time_constant_min": 30.0}, ("um/K",))


@pytest.mark.parametrize(
    ("direct", "late", "rate"),
    [
        (0.0, 1.0, False),  # a lag
        (1.0, 1.0, False),  # both
        (1.0, -0.9, True),  # the rate of the sensor
        (1.0, -0.3, True),  # a lead: the delayed copy acts against the sensor
    ],
)
def test_readings_that_follow_the_rate_of_a_sensor_are_told(direct, late, rate, rng):
    rise, delayed = course()
    model = sensed(direct * rise + late * delayed, rise, rng)
    assert RecordGrounds(model).follows_rate(lag_candidate(delayed)) is rate


def test_a_delayed_sensor_gains_over_one_that_is_only_smoothed_where_there_is_a_lag(rng):
    rise, delayed = course()
    candidate = lag_candidate(delayed)
    assert RecordGrounds(sensed(delayed, rise, rng)).advantage_over_smoothing(candidate) > 20.0
    # A centred mean over six blocks on either side, fewer at the ends.
    smooth = np.array([rise[max(0, k - 6) : k + 7].mean() for k in range(BLOCKS)])
    assert RecordGrounds(sensed(smooth, rise, rng)).advantage_over_smoothing(candidate) < -20.0
