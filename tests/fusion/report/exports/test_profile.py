"""The profile at the points of a table: straight lines between targets, zero at the reference, an uncertainty that holds."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.products.store import read_dataset
from fusion.report.exports.errors import ExportError
from fusion.report.exports.profile import Profile, path_variance, read_profile, tabulate
from tests.fusion.report.exports.small_run import UNEVEN_MM, true_profile_um


def profile_of(position_mm: np.ndarray, values_um: np.ndarray, u_um: float = 0.0) -> Profile:
    size = position_mm.size
    covariance = u_um**2 * np.eye(2 * size).reshape(2, size, 2, size)
    return Profile(position_mm, np.stack([values_um, values_um - 1.0]), covariance)


def test_the_profile_of_a_run_is_that_of_the_axis(small_run) -> None:
    profile = read_profile(read_dataset(small_run / "deviations.nc"))
    np.testing.assert_array_equal(profile.position_mm, UNEVEN_MM)
    expected = true_profile_um(UNEVEN_MM) - true_profile_um(UNEVEN_MM)[0]
    table = tabulate(profile)
    # Noise 0.05 um over 12 cycles, less the reference: 0.02 um; four times that.
    np.testing.assert_allclose(table.deviation_um[0], expected, atol=0.08)
    np.testing.assert_allclose(table.deviation_um[1], expected - 1.0, atol=0.08)
    assert (table.u_um < 0.1).all() and table.u_um[0, 0] == 0.0


def test_targets_in_any_order_are_sorted(small_run) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    turned = deviations.isel(target=slice(None, None, -1), other_target=slice(None, None, -1))
    expected, found = read_profile(deviations), read_profile(turned)
    np.testing.assert_array_equal(found.position_mm, expected.position_mm)
    np.testing.assert_array_equal(found.deviation_um, expected.deviation_um)
    np.testing.assert_array_equal(found.covariance_um2, expected.covariance_um2)


def test_resampling_is_linear_and_covers_the_last_target() -> None:
    position = np.array([0.0, 26.0, 48.0, 77.0])
    profile = profile_of(position, np.array([0.0, 2.0, 5.0, 4.0]))
    table = tabulate(profile, spacing_mm=20.0, reference_mm=40.0)
    at_zero = np.interp(40.0, position, [0, 2, 5, 4])
    np.testing.assert_allclose(table.position_mm, [0, 20, 40, 60, 80])
    assert table.spacing_mm() == pytest.approx(20.0) and table.resampled
    np.testing.assert_allclose(table.deviation_um[0, :4], np.interp([0, 20, 40, 60], position, [0, 2, 5, 4]) - at_zero)
    # Behind the last target the last straight line goes on, so that the table meets the profile there.
    assert np.interp(77.0, table.position_mm, table.deviation_um[0]) == pytest.approx(4.0 - at_zero)
    np.testing.assert_allclose(table.deviation_um[0] - table.deviation_um[1], 1.0)
    # Where the axis is referenced nothing jumps, also between two points of the table.
    between = tabulate(profile, spacing_mm=20.0, reference_mm=48.0)
    assert np.interp(48.0, between.position_mm, between.deviation_um[0]) == pytest.approx(0.0, abs=1e-12)


def test_the_uncertainty_between_targets_covers_a_wandering_profile() -> None:
    """A random walk sampled every millimetre, measured at every 25th: the errors of interpolation have the stated size."""
    rng = np.random.default_rng(20260309)
    fine = np.arange(0.0, 401.0)
    ratios = []
    for _ in range(60):
        path = np.cumsum(0.1 * rng.standard_normal(fine.size))
        coarse = np.arange(0.0, 401.0, 25.0)
        profile = profile_of(coarse, np.interp(coarse, fine, path))
        table = tabulate(profile, spacing_mm=10.0)
        between = table.u_um[0] > 0
        errors = table.deviation_um[0] - (np.interp(table.position_mm, fine, path) - path[0])
        ratios.append(np.mean((errors[between] / table.u_um[0, between]) ** 2))
    # 60 paths of some 20 independent errors each, and an estimated size: the mean is 1 within a few per cent.
    assert 0.8 < np.mean(ratios) < 1.25


def test_a_straight_profile_has_no_uncertainty_between_targets() -> None:
    position = np.array([0.0, 20.0, 45.0, 80.0])
    assert path_variance(profile_of(position, position / 10.0)) == pytest.approx(0.0, abs=1e-12)
    assert path_variance(profile_of(position[:2], position[:2])) == 0.0


def test_what_does_not_suit_is_refused(small_run) -> None:
    deviations = read_dataset(small_run / "deviations.nc")
    one_sided = deviations.assign(drift_profile=deviations["drift_profile"].where(deviations["target"] != 3))
    with pytest.raises(ExportError, match=r"no profile at 48 mm in one approach; a compensation table needs both"):
        read_profile(one_sided)
    single: xr.Dataset = deviations.isel(target=[0], other_target=[0])
    with pytest.raises(ExportError, match="one position only"):
        read_profile(single)
    profile = read_profile(deviations)
    with pytest.raises(
        ExportError, match=r"the reference 200 mm lies outside the measured 0 to 175 mm; .* --reference"
    ):
        tabulate(profile, reference_mm=200.0)
    for spacing in (0.0, 500.0):
        with pytest.raises(ExportError, match="write a spacing above 0 and up to 175 mm"):
            tabulate(profile, spacing_mm=spacing)
