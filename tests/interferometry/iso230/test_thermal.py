"""ISO 230-3: courses of which every range is known."""

import numpy as np
import pytest

from interferometry.deviations import build_deviations
from interferometry.iso230.thermal import (
    average,
    axis_courses,
    evaluate_distortion,
    scatter,
    tilt,
    with_ends,
)

MINUTES = 60.0 * np.arange(6 * 60 + 1)


def test_a_first_order_warm_up_has_the_ranges_of_its_exponential():
    tau_s = 3600.0
    found = evaluate_distortion(MINUTES, 20.0 * (1.0 - np.exp(-MINUTES / tau_s)))
    assert found.first_hour == pytest.approx(20.0 * (1.0 - np.exp(-1.0)))
    assert found.whole == found.change == pytest.approx(20.0 * (1.0 - np.exp(-6.0)))
    assert found.last_hour == pytest.approx(20.0 * (np.exp(-5.0) - np.exp(-6.0)))
    # Within a tenth of its range after ln 10 time constants, a little earlier because its end is not its limit; a minute is a step.
    assert found.settling_s / tau_s == pytest.approx(np.log(10.0), abs=0.1)


def test_a_range_is_not_the_difference_of_the_ends():
    found = evaluate_distortion(MINUTES, 5.0 * np.sin(2 * np.pi * MINUTES / MINUTES[-1]))
    assert found.whole == pytest.approx(10.0, rel=1e-3)
    assert found.change == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(found.settling_s), "it never stays"


def test_what_a_short_test_does_not_show_is_not_a_number():
    found = evaluate_distortion(MINUTES[:50], MINUTES[:50] / 60.0)
    assert found.whole == 49.0
    assert np.isnan([found.first_hour, found.last_hour, found.settling_s]).all()
    assert np.isnan(evaluate_distortion(MINUTES[:1], MINUTES[:1]).whole)
    gaps = np.where(np.arange(MINUTES.size) % 3 == 0, MINUTES, np.nan)
    assert evaluate_distortion(MINUTES, gaps).whole == 6 * 3600.0


def test_the_mean_of_a_minute_lowers_the_noise_and_its_size_is_found():
    rng = np.random.default_rng(1)
    seconds = np.arange(0.0, 6 * 3600.0, 2.0)
    values = np.round(seconds / 3600.0 + 0.3 * rng.standard_normal(seconds.size), 2)[:, None]
    # A standard deviation from 10 800 readings: 1 %.
    assert scatter(values[:, 0]) == pytest.approx(0.3, rel=0.03)
    time, mean = average(seconds, values)
    assert time.size == 360
    assert scatter(mean[:, 0]) == pytest.approx(0.3 / np.sqrt(30), rel=0.15)
    assert evaluate_distortion(time, mean[:, 0]).whole == pytest.approx(6.0, abs=0.4)


def test_a_quick_start_within_the_first_minute_is_not_lost():
    """20 um with a time constant of 5 min: the mean of the first minute alone is 1.9 um late.

    A line through 30 and 90 s misses half their product times the curvature at the start, 0.3 um.
    """
    seconds = np.arange(0.0, 3601.0, 1.0)
    rise = 20.0 * (1.0 - np.exp(-seconds / 300.0))
    time, mean = with_ends(*average(seconds, rise[:, None]), seconds[-1])
    assert time[0] == 0.0 and mean[0, 0] == pytest.approx(0.0, abs=0.3)
    found = evaluate_distortion(time, mean[:, 0])
    # A test of exactly 60 min has a first hour, which is the whole of it.
    assert found.first_hour == found.whole == pytest.approx(20.0, abs=0.3)


@pytest.mark.parametrize("sampling_s", [1.0, 10.0, 30.0, 60.0, 300.0])
@pytest.mark.parametrize("hours", [1.0, 3.0])
def test_the_hours_have_their_whole_length_whatever_the_sampling(sampling_s, hours):
    """40 um with a time constant of 1 h: 40 (1 - 1/e) in the first hour, 40 (e^(1-h) - e^-h) in the last of h hours.

    The line to either end misses half the product of 30 and 90 s times the curvature, 0.004 um.
    """
    seconds = np.arange(0.0, 3600.0 * hours + 1.0, sampling_s)
    rise = 40.0 * (1.0 - np.exp(-seconds / 3600.0))
    time, mean = with_ends(*average(seconds, rise[:, None]), seconds[-1])
    found = evaluate_distortion(time, mean[:, 0])
    assert found.first_hour == pytest.approx(40.0 * (1.0 - np.exp(-1.0)), abs=0.006)
    assert found.last_hour == pytest.approx(40.0 * (np.exp(1.0 - hours) - np.exp(-hours)), abs=0.006)
    assert found.whole == pytest.approx(40.0 * (1.0 - np.exp(-hours)), abs=0.006)


def test_the_last_hour_is_that_of_the_test_and_not_of_the_channel():
    values = MINUTES / 60.0
    ended = np.where(MINUTES <= 5.5 * 3600.0, values, np.nan)
    assert evaluate_distortion(MINUTES, values).last_hour == 60.0
    assert evaluate_distortion(MINUTES, ended).last_hour == 30.0
    assert np.isnan(evaluate_distortion(MINUTES, np.where(MINUTES < 4 * 3600.0, values, np.nan)).last_hour)


def test_two_displacements_tilt_by_their_difference_over_their_distance():
    # 15 um over 150 mm are 0.1 mm per metre: 100 microradian.
    np.testing.assert_allclose(tilt(np.array([0.0, 5.0]), np.array([0.0, 20.0]), distance_mm=150.0), [0.0, 100.0])


def test_scale_and_zero_of_an_axis_are_those_it_drifts_by():
    rng = np.random.default_rng(2)
    position = np.array([0.0, 110.0, 190.0, 310.0, 400.0])
    hours = np.arange(12) / 2.0
    zero, scale = 3.0 * hours, 10.0 * (1.0 - np.exp(-hours))
    profile = rng.normal(0.0, 5.0, (2, 5))
    drift = zero[:, None, None] + scale[:, None, None] * (position - position[0]) * 1e-3
    noise_um = 0.05
    readings = profile + drift + noise_um * rng.standard_normal((12, 2, 5))
    readings[3, 0, 2] = np.nan
    time = np.datetime64("2026-01-05T06:00", "ns") + np.round(hours * 3.6e12).astype("m8[ns]")
    times = np.broadcast_to(time[:, None, None], readings.shape)
    deviations = build_deviations(np.arange(1, 13), np.arange(1, 6), position, readings, times)
    seconds, courses, u = axis_courses(deviations)
    np.testing.assert_allclose(seconds, 3600.0 * hours)
    for name, known in {"zero": zero, "scale": scale, "end": zero + 0.4 * scale}.items():
        missed = (courses[name] - courses[name].mean()) - (known - known.mean())
        # Twelve values: their spread is known to a fifth; three times that.
        assert np.std(missed) == pytest.approx(u[name].mean(), rel=0.6)
    assert u["zero"].mean() < noise_um


@pytest.mark.filterwarnings("error")
def test_courses_of_readings_without_times_or_of_one_target_are_not_known():
    readings = np.random.default_rng(2).normal(size=(4, 2, 3))
    no_time = np.full(readings.shape, np.datetime64("NaT", "ns"))
    position = np.array([0.0, 50.0, 100.0])
    test = build_deviations(range(1, 5), range(1, 4), position, readings, no_time)
    seconds, courses, _ = axis_courses(test)
    assert np.isnan(seconds).all() and np.isfinite(courses["scale"]).all()
    assert all(np.isnan(course).all() for course in axis_courses(test.isel(target=[1]))[1].values())
