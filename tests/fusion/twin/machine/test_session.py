"""The states behind the readings: bodies that respond as two lags in series must, and series at the right times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.twin.machine.recipe import Recipe
from fusion.twin.machine.session import DRIVES, INNER_PART, Session
from fusion.twin.simulate import simulate


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(Recipe().vary(test={"cycles": 20}, table={"preheat_min": 30.0})).session


def test_warm_up_is_that_of_two_lags_in_series(session):
    tau, inner = 1800.0, INNER_PART * 1800.0
    state = session.state("constant", 30.0, "any")
    t = session.grid_s[session.grid_s >= 0]
    expected = 1.0 - (tau * np.exp(-t / tau) - inner * np.exp(-t / inner)) / (tau - inner)
    # the grid's step of 10 s delays each of the two lags by up to one step: 20 s of at most 1 / 1800 s
    np.testing.assert_allclose(state[session.grid_s >= 0], expected, atol=0.012)
    assert np.all(state[session.grid_s < 0] == 0.0)


@pytest.mark.parametrize("follows", DRIVES)
def test_every_state_starts_from_zero_with_the_test(session, follows):
    state = session.state(follows, 20.0, "any")
    assert np.interp(0.0, session.grid_s, state) == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(state) > 0.0


def test_slow_body_follows_its_drive_later_and_less(session):
    fast, slow = (session.state("duty", minutes, "any") for minutes in (5.0, 60.0))
    assert np.ptp(slow) < np.ptp(fast)
    lag = np.argmax(np.correlate(slow - slow.mean(), fast - fast.mean(), "full")) - (fast.size - 1)
    assert lag > 0


def test_own_drive_differs_between_effects_and_is_not_the_logged_load(session):
    first, second = session.state("own", 10.0, "first"), session.state("own", 10.0, "second")
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, session.state("duty", 10.0, "first"))
    np.testing.assert_array_equal(first, session.state("own", 10.0, "first"))


def test_series_are_taken_at_the_times_of_readings_and_frames(session):
    np.testing.assert_allclose(session.at_readings(session.grid_s), session.time_s)
    np.testing.assert_allclose(session.at_frames(session.grid_s), session.frame_s)
    assert session.at_start(session.grid_s) == 0.0


def test_share_is_position_over_travel(session):
    assert (session.share.min(), session.share.max()) == (0.0, 1.0)
    assert replace(session, travel_mm=600.0).share.max() == 0.5
