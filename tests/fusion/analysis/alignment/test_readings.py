"""Readings of a campaign: order in time, sites, series at the readings, gaps and noise."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.first_order_lag import lag_operators, respond
from fusion.analysis.alignment.readings import ReadingsError, Series, read_fused, sample_noise

START = np.datetime64("2026-03-09T06:30:00", "ns")


def fused(cycles=4, targets=3):
    """Forward and back over the targets, 6 s apart, with a driver logged every minute."""
    order = np.stack([np.arange(targets), 2 * targets - 1 - np.arange(targets)])
    seconds = 100.0 * np.arange(cycles)[:, None, None] + 6.0 * order
    minutes = np.arange(12)
    return xr.Dataset(
        {
            "deviation": (("cycle", "direction", "target"), seconds / 100.0),
            "time": (("cycle", "direction", "target"), START + (seconds * 1e9).astype("timedelta64[ns]")),
            "position": ("target", 50.0 * np.arange(targets)),
            "duty_series": ("driver_time", 2.0 * minutes, {"units": "1"}),
        },
        coords={
            "cycle": np.arange(1, cycles + 1),
            "direction": ["positive", "negative"],
            "target": np.arange(1, targets + 1),
            "driver_time": START + (60e9 * minutes).astype("timedelta64[ns]"),
        },
    )


def test_readings_come_in_order_of_time_with_their_sites():
    readings = read_fused(fused())
    assert (np.diff(readings.seconds) > 0).all()
    assert readings.target[:6].tolist() == [1, 2, 3, 3, 2, 1]
    assert readings.sign[:6].tolist() == [1, 1, 1, -1, -1, -1]
    # Target 1 positive is site 0, target 1 negative is site 1, and so on.
    assert readings.site[:6].tolist() == [0, 2, 4, 5, 3, 1]
    np.testing.assert_array_equal(readings.loadings[:3], [[1, 0], [1, 0.5], [1, 1]])


def test_targets_may_be_stored_in_any_order():
    readings, turned = read_fused(fused()), read_fused(fused().isel(target=[2, 0, 1]))
    np.testing.assert_array_equal(turned.targets[turned.target_index], readings.target)
    np.testing.assert_array_equal(turned.positions_mm[turned.target_index], readings.position_mm)
    assert np.unique(turned.site).tolist() == [0, 1, 2, 3, 4, 5]


def test_of_two_samples_at_one_time_the_second_is_a_jump():
    """To which a lag has not responded yet; then it does as after any step."""
    values = np.array([[0.0], [0.0], [1.0], [1.0]])
    found = respond(values, np.array([0.0, 60.0, 60.0, 120.0]), time_constant_s=60.0)
    np.testing.assert_allclose(found[:, 0], [0.0, 0.0, 0.0, 1.0 - np.exp(-1.0)])


def test_the_profile_has_a_constant_per_target_and_a_reversal_where_both_directions_exist():
    one_sided = fused()
    one_sided["deviation"][:, 1, 2] = np.nan
    readings = read_fused(one_sided)
    assert readings.profile.shape == (20, 3 + 2)
    assert readings.left_out == {"missing": 4, "outside the frames' time": 0}


def test_a_series_is_interpolated_at_the_readings():
    readings = read_fused(fused())
    np.testing.assert_allclose(readings.at(readings.series["duty"]), readings.seconds / 30.0)
    assert readings.drivers == ("duty",)
    per_target = Series(np.array([0.0, 1000.0]), np.array([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]), "K")
    np.testing.assert_array_equal(readings.at(per_target), readings.target - 1.0)


def test_a_gap_of_a_driver_is_found_where_readings_were_taken():
    holed = fused(cycles=8)
    holed["duty_series"][2:8] = np.nan
    (gap,) = read_fused(holed).gaps()
    assert (gap.series, gap.start_s, gap.end_s) == ("duty", 60.0, 480.0)
    assert read_fused(fused()).gaps() == []


def test_a_subset_keeps_the_chosen_readings():
    readings = read_fused(fused())
    part = readings.subset(readings.cycle > 2)
    assert set(part.cycle.tolist()) == {3, 4}
    np.testing.assert_array_equal(part.response, readings.response[readings.cycle > 2])
    assert part.series is readings.series


def test_a_lagged_series_keeps_its_shape_and_starts_in_equilibrium_or_at_rest():
    step = Series(np.array([0.0, 600.0, 1200.0]), np.ones(3), "K")
    np.testing.assert_allclose(step.lagged(600.0).values, 1.0)
    np.testing.assert_allclose(step.lagged(600.0, at_rest=0.0).values, 1.0 - np.exp([0.0, -1.0, -2.0]), rtol=1e-12)
    assert step.lagged(0.0) is step


def test_the_noise_of_a_slow_series_is_found_in_spite_of_outliers(rng):
    samples = np.linspace(0.0, 30.0, 2000) + 0.1 * rng.standard_normal(2000)
    samples[::100] += 5.0
    # The scatter of 2000 values is known to about 3 %; every outlier spoils three second differences of a hundred.
    assert sample_noise(samples) == pytest.approx(0.1, rel=0.15)


def test_too_few_targets_are_refused():
    with pytest.raises(ReadingsError, match="4 cycles and 2 targets have readings"):
        read_fused(fused(targets=2))


# The first-order lag against its closed solutions.


def test_first_order_response_is_exact_for_a_step_and_a_ramp():
    seconds = np.arange(0.0, 7200.0, 60.0)
    ramp = seconds[:, None] / 1000.0
    tau = 900.0
    expected = (seconds - tau * (1 - np.exp(-seconds / tau))) / 1000.0
    np.testing.assert_allclose(respond(ramp, seconds, time_constant_s=tau)[:, 0], expected, atol=1e-12)
    operator = lag_operators(seconds, [0.0, tau])[1]
    np.testing.assert_allclose(operator @ ramp[:, 0], expected, atol=1e-12)


def test_a_lag_of_zero_returns_the_input():
    values = np.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(respond(values, np.array([0.0, 1.0, 3.0]), time_constant_s=0.0), values)


def test_a_system_off_equilibrium_relaxes_from_its_start():
    seconds = np.array([0.0, 100.0, 700.0, 1500.0])
    response = respond(np.zeros((4, 1)), seconds, time_constant_s=600.0, start=np.array([2.0]))[:, 0]
    np.testing.assert_allclose(response, 2.0 * np.exp(-seconds / 600.0), rtol=1e-12)
