"""Plain predictions and the intervals of their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.alignment.readings import Series
from fusion.loop.baselines import error_interval, plain_errors
from tests.fusion.small_campaign import campaign


def test_the_interval_of_white_errors_is_that_of_theory():
    """Errors of 1 um in 400 units of 8: the rmse has a standard error of 1 / sqrt(2 * 3200) = 0.0125 um."""
    rng = np.random.default_rng(3)
    found = error_interval(rng.standard_normal(3200), np.arange(3200) // 8, rng)
    assert found.rmse_um == pytest.approx(1.0, abs=3 * 0.0125)
    # A thousand resamples know the quantiles to a tenth of the width.
    assert found.high_um - found.low_um == pytest.approx(2 * 1.96 * 0.0125, rel=0.25)
    assert found.low_um < found.rmse_um < found.high_um


def test_errors_that_follow_one_another_have_a_wider_interval():
    rng = np.random.default_rng(4)
    white = rng.standard_normal(400)
    alike = np.repeat(white[::10], 10)
    wide, narrow = (error_interval(errors, np.arange(400), np.random.default_rng(1)) for errors in (alike, white))
    assert wide.high_um - wide.low_um > 2.0 * (narrow.high_um - narrow.low_um)


def test_channels_are_averaged_and_gaps_left_out():
    errors = np.column_stack([np.ones(50), np.full(50, 3.0)])
    errors[3] = np.nan
    found = error_interval(errors, np.arange(50), np.random.default_rng(1))
    assert (found.rmse_um, found.low_um, found.high_um) == pytest.approx((2.0, 2.0, 2.0))


def with_series(course, response):
    """Thirty cycles beside one logged series; the last six are predicted."""
    bare = campaign(cycles=30)
    seconds = np.arange(0.0, bare.seconds[-1] + 60.0, 60.0)
    series = {"load": Series(seconds, course(seconds), "1")}
    readings = replace(bare, series=series, response=response(bare))
    return readings, readings.cycle <= 24


def test_every_plain_prediction_is_of_its_kind():
    def course(seconds):
        return np.sin(seconds / 900.0)

    readings, used = with_series(course, lambda bare: 2.0 * course(bare.seconds) + 5.0 * bare.target)
    errors = plain_errors(readings, used)
    assert list(errors) == ["last_value", "mean", "least_squares", "ridge", "ridge_with_lags"]
    site, response = readings.site, readings.response
    for number in np.unique(site):
        own, later = response[used & (site == number)], (site == number)[~used]
        np.testing.assert_allclose(errors["last_value"][later], response[~used][later] - own[-1])
        np.testing.assert_allclose(errors["mean"][later], response[~used][later] - own.mean())
    # The series is interpolated between its samples.
    assert np.abs(errors["least_squares"]).max() < 1e-2 < 0.5 < np.abs(errors["mean"]).max()
    assert np.sqrt(np.mean(errors["ridge"] ** 2)) < 0.05


def test_a_lagged_copy_predicts_what_follows_late():
    def course(seconds):
        return (seconds // 2400.0 % 2.0).astype(float)

    def late(bare):
        samples = np.arange(0.0, bare.seconds[-1] + 60.0, 60.0)
        return bare.at(Series(samples, course(samples), "1").lagged(1200.0))

    errors = plain_errors(*with_series(course, late))
    rms = {name: float(np.sqrt(np.mean(values**2))) for name, values in errors.items()}
    assert rms["ridge_with_lags"] < 0.5 * rms["ridge"]


def test_without_anything_logged_a_regression_is_the_mean():
    bare = campaign(cycles=30)
    readings = replace(bare, series={}, response=bare.seconds / 1e4)
    errors = plain_errors(readings, readings.cycle <= 24)
    for name in ("least_squares", "ridge", "ridge_with_lags"):
        np.testing.assert_allclose(errors[name], errors["mean"])


def test_a_site_that_was_not_read_before_has_no_prediction():
    readings, used = with_series(np.sin, lambda bare: bare.seconds / 1e4)
    used = used & (readings.site != 3)
    for values in plain_errors(readings, used).values():
        np.testing.assert_array_equal(np.isnan(values), (readings.site == 3)[~used])
