"""Events of a record: dated and sized in the raw readings of the channels that they happen in, and none where a record only wanders."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.drift_model.record import declare, events_of, fit_record, hold_out, search_record
from fusion.analysis.drift_model.record_data import reduce_record
from fusion.analysis.drift_model.record_events import Course, Event
from fusion.analysis.drift_model.search import Reason
from tests.fusion.record_tables import table_of

pytestmark = pytest.mark.long

SAMPLES, STEP_S = 1500, 60.0
SECONDS = STEP_S * np.arange(SAMPLES)


def found(
    event: np.ndarray, driver: np.ndarray | None = None, warmed: np.ndarray | float = 0.0
) -> tuple[list[Event], list[Reason]]:
    """Events of three channels that wander and follow two temperatures, with an event (samples, channels), and why others are none; one
    temperature is warmed besides.
    """
    rng = np.random.default_rng(3)
    temperature = 20.0 + np.cumsum(rng.normal(0.0, 0.02, (SAMPLES, 2)), axis=0)
    walk = np.cumsum(rng.normal(0.0, 0.02, (SAMPLES, 3)), axis=0)
    displacement = temperature @ rng.normal(0.0, 2.0, (2, 3)) + walk + rng.normal(0.0, 0.3, (SAMPLES, 3)) + event
    temperature[:, 0] += warmed
    record = reduce_record(table_of(displacement, temperature, driver, step_s=STEP_S))
    train, _ = hold_out(record)
    _, state = search_record(record, train, declare(["quasi_static"], record), effects={"step_event": None})  # type: ignore[dict-item]
    reasons = [one.reason for one in state.decisions if one.effect == "step_event"]
    return [term.candidate for term in state.added if isinstance(term.candidate, Event)], reasons


@pytest.mark.parametrize(("course", "channels"), [
    (Course(36_000.0, 0.0), [0, 1, 2]), (Course(36_000.0, 5400.0), [1]), (Course(36_000.0, 5400.0, True, 0.6), [1, 2]),
    (Course(20_000.0, 21_600.0), [1]),
])  # fmt: skip
def test_an_event_is_dated_and_sized_in_the_channels_that_it_happens_in(course, channels):
    size = np.zeros(3)
    size[channels] = -8.0
    (one,), _ = found(course.at(SECONDS)[:, None] * size)
    assert (
        one.onset.low <= course.onset_s <= one.onset.high and one.duration.low <= course.duration_s <= one.duration.high
    )
    np.testing.assert_array_equal(np.flatnonzero(one.size), channels)
    assert (np.abs(one.size - size) <= 3.0 * one.size_u)[channels].all()
    assert one.p_value < 0.005 and one.answer.word == "yes"
    assert one.parameters["time_s"] == one.event_s == one.onset.value


def test_events_of_several_channels_are_several_those_that_explain_most_first():
    late = [Course(at, 0.0).at(SECONDS) for at in (20_000.0, 50_000.0)]
    first, second = found(np.column_stack([6.0 * late[0], 0.0 * SECONDS, -12.0 * late[1]]))[0]
    assert first.sizes(("a", "b", "c")).keys() == {"c"} and second.sizes(("a", "b", "c")).keys() == {"a"}


def test_changes_with_a_temperature_that_turns_are_responses_to_a_load_that_no_log_holds():
    load = (SECONDS // 20_000.0 % 2.0)[:, None] * [6.0, 0.0, -4.0]
    assert len(found(load)[0]) == 3
    warmed = respond(load[:, :1], SECONDS, time_constant_s=600.0)[:, 0]
    events, reasons = found(load, warmed=0.4 * warmed)
    assert not events and Reason.UNLOGGED_LOAD in reasons


def test_a_record_that_wanders_or_warms_up_has_no_event_and_a_shift_at_a_switching_is_none():
    assert found(np.zeros((SAMPLES, 3)))[0] == []
    assert found(20.0 * Course(0.0, 9000.0, True).at(SECONDS)[:, None] * np.ones(3))[0] == []
    driver = np.where(SECONDS < 36_000.0, 0.0, 1.0)
    events, reasons = found(8.0 * driver[:, None] * np.ones(3), driver)
    assert not events and set(reasons) & {Reason.AT_SWITCHING, Reason.WITH_A_LOAD}


def test_an_event_is_taken_from_the_displacements_of_its_channels_alone():
    rng = np.random.default_rng(1)
    displacement, temperature = rng.normal(0.0, 0.1, (400, 2)), 20.0 + np.cumsum(rng.normal(0.0, 0.1, (400, 1)), axis=0)
    displacement[200:, 1] += 9.0
    record = reduce_record(table_of(displacement, temperature))
    train, _ = hold_out(record)
    problem, state = search_record(record, train, declare(["quasi_static"], record))
    (event,) = (term.candidate for term in state.added)
    expected = np.column_stack([np.zeros(400), np.where(np.arange(400) < 200, 0.0, event.size[1])])
    np.testing.assert_allclose(events_of(record, state.model.terms), expected, atol=0.05 * 9.0)
    assert problem.hold_out_error(state.model.terms) < 0.2 < problem.hold_out_error(state.declared)
    without = fit_record(record, state.declared, train)
    assert state.model.channels[0].sigma == pytest.approx(without.channels[0].sigma)
    assert problem.loss_without(state.model, state.added[0]) > 100.0
