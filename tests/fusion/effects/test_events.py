"""Events and rhythms: steps, waves and the periods that are tried."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.effects.events import PERIODIC_DISTURBANCE, STEP_EVENT, off_the_cycle, periods_min
from tests.fusion.small_campaign import campaign, period_s


def span_min(readings) -> float:
    return float(readings.seconds[-1]) / 60.0


def test_a_step_is_zero_before_its_instant_and_one_from_it_on():
    readings = campaign(cycles=12)
    candidates = list(STEP_EVENT.candidates(readings, {}, None))
    assert len(candidates) == 32
    for candidate in candidates:
        instant = candidate.event_s
        assert candidate.parameters == {"time_s": instant} and candidate.units == ("um",)
        np.testing.assert_array_equal(candidate.columns[:, 0], np.where(readings.seconds < instant, 0.0, 1.0))
    # 390 s is the first reading of the fourth cycle: it is shifted.
    at_reading = next(candidate for candidate in candidates if candidate.event_s == 390.0)
    assert at_reading.columns[readings.seconds == 390.0, 0] == 1.0


def test_a_step_is_looked_at_more_closely_at_the_readings():
    readings = campaign(cycles=12)
    chosen = Candidate(np.empty((0, 1)), {"time_s": 325.0}, ("um",), event_s=325.0)
    near = list(STEP_EVENT.candidates(readings, {}, chosen))
    assert [candidate.event_s for candidate in near] == [300.0, 310.0, 320.0, 330.0]


def test_a_wave_has_its_period_in_minutes_flat_or_along_the_axis():
    readings = campaign(cycles=40)
    flat, linear = list(PERIODIC_DISTURBANCE.candidates(readings, {}, None))[:2]
    period = flat.parameters["period_min"]
    phase = 2.0 * np.pi * readings.seconds / 60.0 / period
    np.testing.assert_allclose(flat.columns, np.column_stack([np.cos(phase), np.sin(phase)]), atol=1e-9)
    np.testing.assert_allclose(linear.columns, flat.columns[:] * readings.position_mm[:, None] / 400.0, atol=1e-12)
    assert (flat.parameters["shape"], linear.parameters["shape"]) == ("flat", "linear")
    assert flat.units == linear.units == ("um", "um")
    assert linear.parameters["period_min"] == period


def test_waves_of_a_long_test_are_not_held_at_all_readings(monkeypatch):
    """Three hundred periods of them would take 0.3 GB at 10,000 cycles of six readings."""
    monkeypatch.setattr("fusion.effects.events._HELD_READINGS", 100)
    readings = campaign(cycles=400)
    candidates = list(PERIODIC_DISTURBANCE.candidates(readings, {}, None))
    waves = {id(course): course for candidate in candidates for course in candidate.columns.courses}
    assert len(waves) == len(candidates) > 100
    assert all(wave.seconds is readings.seconds for wave in waves.values())
    some = np.array([3, 500, 7])
    np.testing.assert_array_equal(candidates[5].columns[some], np.asarray(candidates[5].columns)[some])


def test_periods_reach_from_a_third_of_the_campaign_to_three_minutes():
    readings = campaign(cycles=40)
    span, cycle = span_min(readings), 60.0 / period_s(readings)
    frequencies = 1.0 / periods_min(readings)
    assert frequencies[0] == pytest.approx(3.0 / span)
    assert np.diff(frequencies)[0] == pytest.approx(0.5 / span)
    # One cycle in 130 s is above one in three minutes: only lines within four of it are missing at the upper end.
    expected = np.arange(3.0 / span, 1.0 / 3.0, 0.5 / span)
    expected = expected[np.abs(expected - cycle) > 4.0 / span]
    np.testing.assert_allclose(frequencies, expected)


def test_frequencies_within_four_lines_of_a_multiple_of_the_cycle_are_left_out():
    readings = campaign(cycles=40)
    line, cycle = 1.0 / span_min(readings), 60.0 / period_s(readings)
    tried = np.array([cycle - 3.9 * line, cycle - 4.1 * line, 2.0 * cycle + 3.9 * line, 2.0 * cycle + 4.1 * line])
    np.testing.assert_allclose(off_the_cycle(readings, tried), tried[[1, 3]])
    # A slow wave is no zeroth multiple of the cycle.
    assert off_the_cycle(readings, np.array([0.5 * line])).size == 1


def test_at_most_three_hundred_periods_are_tried_the_longest_first():
    readings = campaign(cycles=300)
    assert periods_min(readings).size > 300
    candidates = list(PERIODIC_DISTURBANCE.candidates(readings, {}, None))
    assert len(candidates) == 600
    assert candidates[0].parameters["period_min"] == pytest.approx(span_min(readings) / 3.0)


def test_a_closer_look_stays_within_half_a_line_and_within_the_search():
    readings = campaign(cycles=40)
    span = span_min(readings)

    def frequencies_about(period: float) -> np.ndarray:
        chosen = Candidate(np.empty((0, 2)), {"period_min": period}, ("um", "um"))
        near = PERIODIC_DISTURBANCE.candidates(readings, {}, chosen)
        return np.array([1.0 / candidate.parameters["period_min"] for candidate in near])[::2]

    # No period is shorter than three minutes.
    np.testing.assert_allclose(frequencies_about(3.0), 1.0 / 3.0 + np.linspace(-0.5, 0.0, 11) / span)
    near = frequencies_about(10.0)
    np.testing.assert_allclose(near, 0.1 + np.linspace(-0.5, 0.5, 21) / span)
    np.testing.assert_allclose(frequencies_about(span / 3.0), 3.0 / span + np.linspace(0.0, 0.5, 11) / span)
