"""Jumps, stuck sensors and the instants of events, each at its limit and just beyond it."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Series
from fusion.effects.jumps import cycle_starts, event_instants, instants_near, jumps, sensor_jumps, stuck_sensors
from tests.fusion.small_campaign import campaign, logged


def restless(jump: float, *, at: int = 20, samples: int = 41) -> np.ndarray:
    """Values that alternate by 0.2: every change exceeds the median of its six neighbours by 0.4."""
    values = 0.1 * (-1.0) ** np.arange(samples)
    values[at + 1 :] += jump
    return values


def test_a_jump_is_told_with_its_samples_and_its_size():
    # The change of 0.2 to sample 20 is upwards there, against a median of -0.2.
    ((before, after, size),) = jumps(logged(restless(-20.0), "K", step_s=60.0))
    assert (before, after) == (1200.0, 1260.0)
    assert size == pytest.approx(-20.0 - 0.4)
    # A steady slope is in every change and in the median of its neighbours.
    sloping = restless(-20.0) + 3.0 * np.arange(41) + 1e-4 * np.arange(41) ** 2
    assert jumps(logged(sloping, "K"))[0][2] == pytest.approx(-20.4, abs=1e-3)


@pytest.mark.parametrize(("size", "number"), [(0.98, 0), (1.02, 1)])
def test_a_jump_exceeds_eight_robust_standard_deviations_of_the_changes(size, number):
    limit = 8.0 * 1.4826 * 0.4
    assert len(jumps(logged(restless(-(size * limit - 0.4)), "K"))) == number


def test_steps_of_the_resolution_are_no_jumps():
    """A log that moves by its last digit now and then is constant in between: its robust scatter is zero."""
    values = np.repeat(np.arange(10.0) * 0.1, 8)
    assert jumps(logged(values, "degC")) == []
    values[40:] += 0.6
    assert jumps(logged(values, "degC")) == []
    values[40:] += 0.3
    ((before, after, size),) = jumps(logged(values, "degC"))
    assert (before, after, size) == (39 * 30.0, 40 * 30.0, pytest.approx(1.0))


def test_a_short_series_has_no_jumps_and_columns_are_averaged():
    assert jumps(logged(restless(-50.0, at=4, samples=9), "K")) == []
    assert len(jumps(logged(restless(-50.0, at=4, samples=10), "K"))) == 1
    columns = np.column_stack([restless(-20.0), restless(0.0)])
    ((_, _, size),) = jumps(Series(30.0 * np.arange(41), columns, "K"))
    assert size == pytest.approx(-10.4)


def test_jumps_are_looked_for_in_what_the_environment_unit_logs():
    series = {"air_pressure": logged(restless(-20.0), "hPa"), "duty": logged(restless(-20.0), "1")}
    assert [name for name, *_ in sensor_jumps(campaign(series=series))] == ["air_pressure"]
    assert sensor_jumps(campaign()) == []


@pytest.mark.parametrize(("samples", "stuck"), [(39, []), (40, [("air_temperature", 870.0)])])
def test_a_sensor_is_stuck_after_ten_times_its_usual_run(samples, stuck):
    """It changes at every sample up to number 29, at 870 s, and holds that value to the end."""
    values = np.minimum(np.arange(float(samples)), 29.0)
    assert stuck_sensors(campaign(series={"air_temperature": logged(values, "degC")})) == stuck


def test_a_slow_sensor_is_not_stuck_and_one_that_hardly_moves_is_not_judged():
    slow = np.repeat(np.arange(12.0), 5)
    assert stuck_sensors(campaign(series={"air_temperature": logged(np.r_[slow, np.full(40, 11.0)], "degC")})) == []
    few = np.r_[np.arange(10.0), np.full(200, 9.0)]
    assert stuck_sensors(campaign(series={"air_pressure": logged(few, "hPa")})) == []
    # Humidity may stay as it is; the others are read in their order.
    held = np.minimum(np.arange(90.0), 20.0)
    names = ("relative_humidity", "material_temperature", "air_pressure")
    told = stuck_sensors(campaign(series={name: logged(held, "1") for name in names}))
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
    # A closer look reaches to the next instants on either side, and stops at readings.
    np.testing.assert_array_equal(
        instants_near(long, 1300.0), [1240.0, 1300.0, 1310.0, 1320.0, 1330.0, 1340.0, 1350.0, 1360.0]
    )


def test_a_closer_look_dates_an_event_to_a_reading():
    np.testing.assert_array_equal(instants_near(campaign(cycles=12), 325.0), [300.0, 310.0, 320.0, 330.0])
