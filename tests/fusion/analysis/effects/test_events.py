"""Events and rhythms: steps, waves and the periods that are tried."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Series
from fusion.analysis.effects.effect import Candidate
from fusion.analysis.effects.events import (
    cycle_starts,
    detect_jumps,
    detect_sensor_jumps,
    detect_stuck_sensors,
    event_instants,
    instants_near,
    off_the_cycle,
    periodic_disturbance,
    periods_min,
    step_event,
)
from tests.fusion.small_campaign import campaign, logged, period_s


def span_min(readings) -> float:
    return float(readings.seconds[-1]) / 60.0


def test_a_step_is_zero_before_its_instant_and_one_from_it_on():
    readings = campaign(cycles=12)
    candidates = list(step_event.candidates(readings, {}, None))
    assert len(candidates) == 3 * 32
    heights = {"flat": 1.0, "linear": 1e-3 * readings.position_mm, "reversal": 0.5 * readings.sign}
    for candidate in candidates:
        instant, shape = candidate.event_s, candidate.parameters["shape"]
        assert candidate.parameters["time_s"] == instant and candidate.units == ("um/m" if shape == "linear" else "um",)
        np.testing.assert_array_equal(
            candidate.columns[:, 0], np.where(readings.seconds < instant, 0.0, heights[shape])
        )
    # 390 s is the first reading of the fourth cycle: it is shifted.
    at_reading = next(candidate for candidate in candidates if candidate.event_s == 390.0)
    assert at_reading.columns[readings.seconds == 390.0, 0] == 1.0


def test_a_step_is_looked_at_more_closely_at_the_readings():
    readings = campaign(cycles=12)
    chosen = Candidate(np.empty((0, 1)), {"time_s": 325.0}, ("um",), event_s=325.0)
    near = [one for one in step_event.candidates(readings, {}, chosen) if one.parameters["shape"] == "flat"]
    assert [candidate.event_s for candidate in near] == [300.0, 310.0, 320.0, 330.0]
    one_way = campaign(cycles=12, both_directions=False)
    assert {one.parameters["shape"] for one in step_event.candidates(one_way, {}, None)} == {"flat", "linear"}


def test_a_wave_has_its_period_in_minutes_flat_or_along_the_axis():
    readings = campaign(cycles=40)
    flat, linear = list(periodic_disturbance.candidates(readings, {}, None))[:2]
    period = flat.parameters["period_min"]
    phase = 2.0 * np.pi * readings.seconds / 60.0 / period
    np.testing.assert_allclose(flat.columns, np.column_stack([np.cos(phase), np.sin(phase)]), atol=1e-9)
    np.testing.assert_allclose(linear.columns, flat.columns[:] * readings.position_mm[:, None] / 400.0, atol=1e-12)
    assert (flat.parameters["shape"], linear.parameters["shape"]) == ("flat", "linear")
    assert flat.units == linear.units == ("um", "um")
    assert linear.parameters["period_min"] == period


def test_waves_of_a_long_test_are_not_held_at_all_readings(monkeypatch):
    """Three hundred periods of them would take 0.3 GB at 10,000 cycles of six readings."""
    monkeypatch.setattr("fusion.analysis.effects.events._HELD_READINGS", 100)
    readings = campaign(cycles=400)
    candidates = list(periodic_disturbance.candidates(readings, {}, None))
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
    candidates = list(periodic_disturbance.candidates(readings, {}, None))
    assert len(candidates) == 600
    assert candidates[0].parameters["period_min"] == pytest.approx(span_min(readings) / 3.0)


def test_no_more_periods_are_tried_than_there_are_readings():
    """A clock that falls back to the year 2000 leaves a pause of decades, in which nothing was read."""
    readings = campaign(cycles=10)
    late = readings.seconds >= np.median(readings.seconds)
    apart = replace(readings, seconds=readings.seconds + 7.8e8 * late)
    periods = periods_min(apart)
    assert 0 < periods.size <= readings.seconds.size
    assert periods[0] == pytest.approx(span_min(apart) / 3.0)


def test_a_closer_look_stays_within_half_a_line_and_within_the_search():
    readings = campaign(cycles=40)
    span = span_min(readings)

    def frequencies_about(period: float) -> np.ndarray:
        chosen = Candidate(np.empty((0, 2)), {"period_min": period}, ("um", "um"))
        near = periodic_disturbance.candidates(readings, {}, chosen)
        sines = [one for one in near if len(one.units) == 2 and one.parameters["period_min"] < 1.5 * period]
        return np.unique([1.0 / one.parameters["period_min"] for one in sines])

    # No period is shorter than three minutes.
    np.testing.assert_allclose(frequencies_about(3.0), 1.0 / 3.0 + np.linspace(-0.5, 0.0, 11) / span)
    near = frequencies_about(10.0)
    np.testing.assert_allclose(near, 0.1 + np.linspace(-0.5, 0.5, 21) / span)
    np.testing.assert_allclose(frequencies_about(span / 3.0), 3.0 / span + np.linspace(0.0, 0.5, 11) / span)


def test_a_closer_look_at_a_wave_holds_the_rhythm_of_which_it_is_a_harmonic():
    """The drift hides the slow wave of a rhythm that switches, so that the search meets its third harmonic first."""
    readings = campaign(cycles=80)
    chosen = Candidate(np.empty((0, 2)), {"period_min": 10.0}, ("um", "um"))
    near = periodic_disturbance.candidates(readings, {}, chosen)
    rhythm = [one for one in near if one.parameters["period_min"] == pytest.approx(30.0) and len(one.units) > 2]
    assert rhythm and all(str(one.parameters["course"]).startswith("no sine") for one in rhythm)
    third = np.cos(2.0 * np.pi * readings.seconds / 600.0)
    left = third - rhythm[0].columns[:] @ np.linalg.lstsq(rhythm[0].columns[:], third, rcond=None)[0]
    assert np.abs(left).max() < 1e-9


# Jumps, stuck sensors and the instants of events, each at its limit and just beyond it.


def restless(jump: float, *, at: int = 20, samples: int = 41) -> np.ndarray:
    """Values that alternate by 0.2: every change exceeds the median of its six neighbours by 0.4."""
    values = 0.1 * (-1.0) ** np.arange(samples)
    values[at + 1 :] += jump
    return values


def test_a_jump_is_told_with_its_samples_and_its_size():
    # The change of 0.2 to sample 20 is upwards there, against a median of -0.2.
    ((before, after, size),) = detect_jumps(logged(restless(-20.0), "K", step_s=60.0))
    assert (before, after) == (1200.0, 1260.0)
    assert size == pytest.approx(-20.0 - 0.4)
    # A steady slope is in every change and in the median of its neighbours.
    sloping = restless(-20.0) + 3.0 * np.arange(41) + 1e-4 * np.arange(41) ** 2
    assert detect_jumps(logged(sloping, "K"))[0][2] == pytest.approx(-20.4, abs=1e-3)


@pytest.mark.parametrize(("size", "number"), [(0.98, 0), (1.02, 1)])
def test_a_jump_exceeds_eight_robust_standard_deviations_of_the_changes(size, number):
    limit = 8.0 * 1.4826 * 0.4
    assert len(detect_jumps(logged(restless(-(size * limit - 0.4)), "K"))) == number


def test_steps_of_the_resolution_are_no_jumps():
    """A log that moves by its last digit now and then is constant in between: its robust scatter is zero."""
    values = np.repeat(np.arange(10.0) * 0.1, 8)
    assert detect_jumps(logged(values, "degC")) == []
    values[40:] += 0.6
    assert detect_jumps(logged(values, "degC")) == []
    values[40:] += 0.3
    ((before, after, size),) = detect_jumps(logged(values, "degC"))
    assert (before, after, size) == (39 * 30.0, 40 * 30.0, pytest.approx(1.0))


def test_a_short_series_has_no_jumps_and_columns_are_averaged():
    assert detect_jumps(logged(restless(-50.0, at=4, samples=9), "K")) == []
    assert len(detect_jumps(logged(restless(-50.0, at=4, samples=10), "K"))) == 1
    columns = np.column_stack([restless(-20.0), restless(0.0)])
    ((_, _, size),) = detect_jumps(Series(30.0 * np.arange(41), columns, "K"))
    assert size == pytest.approx(-10.4)


def test_jumps_are_looked_for_in_what_the_environment_unit_logs():
    series = {"air_pressure": logged(restless(-20.0), "hPa"), "duty": logged(restless(-20.0), "1")}
    assert [name for name, *_ in detect_sensor_jumps(campaign(series=series))] == ["air_pressure"]
    assert detect_sensor_jumps(campaign()) == []


@pytest.mark.parametrize(("samples", "stuck"), [(39, []), (40, [("air_temperature", 870.0)])])
def test_a_sensor_is_stuck_after_ten_times_its_usual_run(samples, stuck):
    """It changes at every sample up to number 29, at 870 s, and holds that value to the end."""
    values = np.minimum(np.arange(float(samples)), 29.0)
    assert detect_stuck_sensors(campaign(series={"air_temperature": logged(values, "degC")})) == stuck


def test_a_slow_sensor_is_not_stuck_and_one_that_hardly_moves_is_not_judged():
    slow = np.repeat(np.arange(12.0), 5)
    assert (
        detect_stuck_sensors(campaign(series={"air_temperature": logged(np.r_[slow, np.full(40, 11.0)], "degC")})) == []
    )
    few = np.r_[np.arange(10.0), np.full(200, 9.0)]
    assert detect_stuck_sensors(campaign(series={"air_pressure": logged(few, "hPa")})) == []
    # Humidity may stay as it is; the others are read in their order.
    held = np.minimum(np.arange(90.0), 20.0)
    names = ("relative_humidity", "material_temperature", "air_pressure")
    told = detect_stuck_sensors(campaign(series={name: logged(held, "1") for name in names}))
    assert [name for name, _ in told] == ["air_pressure", "material_temperature"]


def test_cycles_start_at_their_first_reading():
    readings = campaign(cycles=3)
    np.testing.assert_array_equal(cycle_starts(readings), [0.0, 130.0, 260.0])
    np.testing.assert_array_equal(cycle_starts(readings.subset(readings.target == 2)), [10.0, 140.0, 270.0])


def test_events_are_tried_at_quarters_of_the_cycles_with_two_on_either_side():
    instants = event_instants(campaign(cycles=12))
    np.testing.assert_allclose(instants, 260.0 + 32.5 * np.arange(32))
    assert event_instants(campaign(cycles=5)).size == 0
    np.testing.assert_allclose(event_instants(campaign(cycles=6)), 260.0 + 32.5 * np.arange(8))


def test_a_long_campaign_tries_every_second_quarter():
    assert np.diff(event_instants(campaign(cycles=60)))[0] == pytest.approx(32.5)
    long = campaign(cycles=61)
    np.testing.assert_allclose(np.diff(event_instants(long)), 65.0)
    assert 120 < event_instants(campaign(cycles=150)).size <= 240
    # A closer look reaches to the next instants on either side, and stops at readings.
    np.testing.assert_array_equal(
        instants_near(long, 1300.0), [1240.0, 1300.0, 1310.0, 1320.0, 1330.0, 1340.0, 1350.0, 1360.0]
    )
