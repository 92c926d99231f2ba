"""Predicted errors: what a table leaves of its own profile, and what a repeated test would show."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.products.store import read_dataset
from fusion.report.exports.prediction import predict, remainder_um
from fusion.report.exports.profile import Profile, read_profile, tabulate


def test_a_table_at_the_targets_leaves_only_the_errors_of_measurement(small_run) -> None:
    profile = read_profile(read_dataset(small_run / "deviations.nc"))
    prediction = predict(profile, tabulate(profile), one_table=False)
    assert prediction.own_um < 1e-9 and prediction.resampling_um < 1e-9
    # Range of 16 differences of two means of 12 readings of 0.05 um: some 3.5 times 0.02 um.
    assert 0.04 < prediction.after_um < 0.15
    assert prediction.before_um == pytest.approx(np.ptp(profile.deviation_um))


def test_the_repeated_test_has_the_range_of_independent_errors() -> None:
    """Twelve values of 1 um standard uncertainty in either test: the median range of 12 normal values is 3.2 standard deviations."""
    position = np.arange(6.0)
    profile = Profile(position, np.zeros((2, 6)), np.eye(12).reshape(2, 6, 2, 6))
    # Monte Carlo with 400 draws: the median is known within some 3 %.
    assert predict(profile, tabulate(profile), one_table=False).after_um == pytest.approx(3.2 * 2**0.5, rel=0.06)


def test_one_table_leaves_the_part_of_the_reversal_that_is_not_constant(small_run) -> None:
    profile = read_profile(read_dataset(small_run / "deviations.nc"))
    reversal = profile.deviation_um[0] - profile.deviation_um[1]
    left = remainder_um(profile, tabulate(profile), one_table=True)
    constant = left - (reversal - reversal.mean()) / 2 * np.array([[1.0], [-1.0]])
    np.testing.assert_allclose(constant, constant[0, 0], atol=1e-12)


def test_a_coarse_table_leaves_more_and_says_so(small_run) -> None:
    profile = read_profile(read_dataset(small_run / "deviations.nc"))
    coarse = predict(profile, tabulate(profile, spacing_mm=60.0), one_table=False)
    assert coarse.resampling_um > 0.5 and coarse.own_um > 0.5
    assert coarse.after_um > 0.9 * coarse.own_um
