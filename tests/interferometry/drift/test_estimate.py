"""The joint estimate: against the plain mean, simulated truth, turbulent air and shapes that the readings add."""

import numpy as np
import pytest
import xarray as xr
from threadpoolctl import threadpool_limits

from interferometry.deviations import OUTLIER, build_deviations
from interferometry.drift.estimate import (
    COMPONENTS,
    DriftDataError,
    common_shape,
    component_loadings,
    estimate_drift,
    flag_outliers,
    scatter_limits,
    state_weights,
)
from interferometry.drift.gls import DriftFit, estimate
from tests.interferometry.simulated_campaigns import SIGMA_UM, schedule, simulate, with_memory

pytestmark = pytest.mark.long


def test_with_complete_readings_the_profile_is_the_plain_mean(rng):
    deviations, _ = simulate(rng)
    estimated = estimate_drift(deviations, robust=False)
    plain = deviations["deviation"].mean("cycle")
    relative = (plain - plain.isel(target=0)).mean("direction")
    # Both directions of a cycle pass every position at the same mean time, so that only the smoother's weights differ.
    np.testing.assert_allclose(estimated["profile_relative"].mean("direction"), relative, atol=0.002)


def test_profile_drift_and_scatter_come_back(rng):
    deviations, truth = simulate(rng)
    estimated = estimate_drift(deviations)
    present = np.ones(truth.seconds.shape, dtype=bool)
    profile = truth.mean_profile(present)
    relative = profile - profile[:, :1]
    error = (estimated["profile_relative"].values - relative).mean(axis=0)
    # Both directions, 100 cycles: 0.4 * sqrt(2 / 200) = 0.040 um; 16 values scatter around it by less than half.
    assert np.sqrt(np.mean(error**2)) < 0.06
    assert np.sqrt(np.mean((estimated["scatter_position"].values - SIGMA_UM) ** 2)) < 0.033
    drift = truth.profile + truth.drift - profile
    inside = np.abs(estimated["drift"].values - drift) < 1.96 * estimated["drift_u"].values
    assert inside.mean() > 0.85
    assert float(estimated["sigma"]) == pytest.approx(SIGMA_UM, rel=0.04)
    assert estimated["component"].values.tolist() == ["shift", "stretch"]


STATES = ("mean", "start", "end", 3000.0)


@pytest.fixture(scope="module")
def of_states():
    """Thirty cycles, and their estimate for every state at which the profile can be stated."""
    deviations, _ = simulate(np.random.default_rng(20260309), cycles=30)
    return deviations, {state: estimate_drift(deviations, state=state) for state in STATES}


def test_profile_and_drift_and_noise_make_up_the_reading(of_states):
    deviations, estimates = of_states
    for estimated in estimates.values():
        sum_of_parts = estimated["profile"] + estimated["drift"] + estimated["noise"]
        np.testing.assert_allclose(
            sum_of_parts.transpose(*deviations["deviation"].dims), deviations["deviation"], atol=1e-6
        )


def test_the_stated_state_is_where_drift_is_zero(of_states):
    middle, start, end, _ = of_states[1].values()
    for one, place in ((start, (0, 0, 0)), (end, (-1, 1, 0))):
        assert float(one["drift"].values[place]) == pytest.approx(0.0, abs=1e-9)
        assert float(one["drift_u"].values[place]) == pytest.approx(0.0, abs=1e-6)
    assert float(middle["profile_u"].mean()) < float(start["profile_u"].mean())


@pytest.mark.slow
def test_the_drift_since_the_first_cycle_is_zero_there_and_moves_as_the_drift_does(rng):
    deviations, _ = simulate(rng, cycles=12)
    estimated = estimate_drift(deviations)
    since, drift = (estimated[name].values for name in ("drift_since_first", "drift"))
    assert np.diff(since, axis=0) == pytest.approx(np.diff(drift, axis=0))
    # Both approaches of a position lie about the middle of the cycle, where a slow drift is its mean.
    assert np.abs(since[0].mean(axis=0)).max() < 0.05 * np.ptp(since, axis=0).min()
    u = estimated["drift_since_first_u"].values
    assert u[0].max() < u[1:].min()


def test_a_reversal_that_drifts_gets_a_component_of_its_own(rng):
    deviations, truth = simulate(rng)
    growth = 1.0 - np.exp(-truth.seconds / 5000.0)
    deviations["deviation"].values[:] += growth * np.array([0.5, -0.5])[None, :, None]
    estimated = estimate_drift(deviations)
    assert "reversal" in estimated["component"].values
    tracked = estimated["drift_reversal"].mean(("direction", "target")).values
    centred = growth.mean(axis=(1, 2)) - growth.mean()
    # 32 readings a cycle: one cycle alone would know its reversal to 0.14 um; smoothing does better.
    assert np.sqrt(np.mean((tracked - tracked.mean() - centred) ** 2)) < 0.07
    assert float(estimated["sigma"]) == pytest.approx(SIGMA_UM, rel=0.04)
    true = truth.profile[0] - truth.profile[1] + growth.mean()
    assert np.sqrt(np.mean((estimated["reversal"].values - true) ** 2)) < 0.09


def test_a_strong_drift_of_the_reversal_leaves_the_noise_what_it_is(rng):
    deviations, truth = simulate(rng, cycles=24, kind="none")
    growth = 1.0 - np.exp(-truth.seconds / 2500.0)
    deviations["deviation"].values[:] += 10.0 * growth * np.array([1.0, -1.0])[None, :, None]
    estimated = estimate_drift(deviations)
    # Without its own component the others wander from reading to reading after it; they have to settle again once it has one.
    assert float(estimated["sigma"]) == pytest.approx(SIGMA_UM, rel=0.06)
    assert estimated.attrs["order"] == 2


def test_a_position_that_scatters_more_is_known_less_well(rng):
    made = rng.normal(0, SIGMA_UM, (100, 2, 16))
    made[:, :, 2] *= 3.0
    estimated = estimate_drift(simulate(rng, noise=made)[0])
    u = estimated["profile_u"].values
    # Its own 100 readings of 1.2 um in each direction, less the weight that wild readings lost.
    assert u[:, 2] == pytest.approx(0.12, rel=0.2)
    assert np.delete(u, 2, axis=1).max() < 0.06


def test_gross_outliers_are_flagged_and_lose_their_weight(rng):
    deviations, truth = simulate(rng)
    deviations["deviation"].values[20, 0, 4] += 40.0
    deviations["deviation"].values[70, 1, 9] -= 25.0
    estimated = estimate_drift(deviations)
    flagged = flag_outliers(deviations, estimated)["quality_flag"].values & OUTLIER.mask
    assert np.argwhere(flagged).tolist() == [[20, 0, 4], [70, 1, 9]]
    profile = truth.mean_profile(np.ones(truth.seconds.shape, dtype=bool))
    error = estimated["profile_relative"].values - (profile - profile[:, :1])
    assert abs(error[0, 4]) < 4 * float(estimated["profile_relative_u"][0, 4])
    # The ordinary mean would be wrong by 0.4 um there.
    assert abs(error[0, 4]) < 0.2


def test_what_was_never_measured_stays_unknown(rng):
    deviations, _ = simulate(rng, cycles=20)
    deviations["deviation"].values[:, 1, :] = np.nan
    deviations["deviation"].values[:, 0, 5] = np.nan
    estimated = estimate_drift(deviations)
    assert np.isnan(estimated["profile"].values[1]).all()
    assert np.isnan(estimated["profile"].values[0, 5])
    assert np.isfinite(estimated["profile"].values[0, [0, 1, 15]]).all()
    assert np.isnan(estimated["reversal"].values).all()


def test_covariance_is_that_of_the_uncertainties(rng):
    estimated = estimate_drift(simulate(rng, cycles=20)[0])
    covariance = estimated["covariance"].values.reshape(32, 32)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), estimated["profile_u"].values.ravel())
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_inputs_are_left_as_they_were(rng):
    deviations, _ = simulate(rng, cycles=10)
    before = deviations.copy(deep=True)
    flag_outliers(deviations, estimate_drift(deviations))
    assert deviations.identical(before)


def test_a_state_is_an_average_of_times():
    seconds, cycle = np.array([0.0, 1.0, 3.0, 7.0]), np.array([1, 1, 1, 2])
    assert state_weights(seconds, cycle, "mean") == pytest.approx([1 / 6, 1 / 6, 1 / 6, 1 / 2])
    assert state_weights(seconds, cycle, 2.0).tolist() == [0.0, 0.5, 0.5, 0.0]
    assert state_weights(seconds, cycle, "start").tolist() == [1.0, 0.0, 0.0, 0.0]
    for wrong in ("warm", 8.0):
        with pytest.raises(DriftDataError, match=r"is neither 'mean', 'start', 'end' nor seconds within 0 .. 7"):
            state_weights(seconds, cycle, wrong)


def test_readings_that_cannot_be_fitted_are_refused(rng):
    deviations, _ = simulate(rng, cycles=3)
    with pytest.raises(DriftDataError, match="1 cycles and 16 targets hold readings"):
        estimate_drift(deviations.isel(cycle=[0]))
    with pytest.raises(DriftDataError, match=r"components \['twist'\] are not known"):
        estimate_drift(deviations, components=["shift", "twist"])
    timeless = deviations.copy(deep=True)
    timeless["time"].values[:] = np.datetime64("NaT")
    with pytest.raises(DriftDataError, match="no reading has a time"):
        estimate_drift(timeless)
    at_once = deviations.copy(deep=True)
    at_once["time"].values[:] = np.datetime64("2026-03-09T06:30")
    with pytest.raises(DriftDataError, match="deviations: every reading has the time 2026-03-09T06:30:00;"):
        estimate_drift(at_once)
    with pytest.raises(DriftDataError, match="readings repeat exactly"):
        estimate_drift(deviations.assign(deviation=xr.ones_like(deviations["deviation"])))
    for order in (0, 3, "2"):
        with pytest.raises(DriftDataError, match=f"order={order!r} is neither 1 "):
            estimate_drift(deviations, order=order)


def test_many_targets_give_the_same_on_any_number_of_threads(rng):
    """From 64 columns on the normal equations are products of matrices, which threads sum in another order, and a minute longer."""
    seconds = 5.0 * np.arange(6 * 2 * 36).reshape(6, 2, 36)
    seconds[:, 1] = seconds[:, 1, ::-1]
    deviation = rng.normal(0.0, 0.4, seconds.shape) + 5.0 * (1.0 - np.exp(-seconds / 1800.0))
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    test = build_deviations(range(1, 7), range(1, 37), 5.0 * np.arange(36), deviation, time)
    estimated = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            estimated.append(estimate_drift(test))
    xr.testing.assert_identical(*estimated)


def with_walk(rng: np.random.Generator, *, cycles: int, sigma: float, between_um: float) -> xr.Dataset:
    """A test whose drift is a walk of so many um from reading to reading, beside noise of sigma."""
    deviations, _ = simulate(rng, kind="none", cycles=cycles, sigma=sigma)
    order = np.argsort(deviations["time"].values, axis=None)
    walk = np.empty(order.size)
    walk[order] = np.cumsum(rng.normal(0, between_um, order.size))
    return deviations.assign(deviation=deviations["deviation"] + walk.reshape(deviations["deviation"].shape))


def test_a_scatter_that_a_restless_drift_leaves_nothing_of_has_an_uncertainty(rng):
    """A walk of 1 um from reading to reading beside 0.03 um of noise: of some positions nothing is seen but the walk."""
    estimated = estimate_drift(with_walk(rng, cycles=6, sigma=0.03, between_um=1.0))
    scatter, scatter_u = estimated["scatter"].values, estimated["scatter_u"].values
    assert (scatter == 0.0).any()
    assert (scatter_u[np.isfinite(scatter)] > 0.0).all()
    assert np.isnan(scatter_u[np.isnan(scatter)]).all()


def test_noise_that_vanishes_beside_the_drift_between_readings_is_not_determined(rng):
    """1 um from reading to reading beside 0.0001 um of noise; with 0.4 um of noise, or none of the drift, the noise is found."""
    hidden = estimate_drift(with_walk(rng, cycles=12, sigma=1e-4, between_um=1.0))
    assert hidden.attrs["scatter_undetermined"] == 1
    # What is stated is the limit of the search: a hundredth of what the walk grows by in an hour, some 20 um.
    assert float(hidden["sigma"]) > 100 * 1e-4
    for sigma, between_um in ((0.4, 1.0), (0.1, 0.1), (0.4, 0.0)):
        found = estimate_drift(with_walk(rng, cycles=12, sigma=sigma, between_um=between_um))
        assert found.attrs["scatter_undetermined"] == 0
        assert float(found["sigma"]) == pytest.approx(sigma, rel=0.25)


TARGETS = 16


def correlated(rng: np.random.Generator, seconds: np.ndarray, correlation_time_s: float) -> np.ndarray:
    """Noise of unit variance at times in any shape."""
    order = np.argsort(seconds.ravel())
    noise = rng.standard_normal(seconds.size)
    for k, share in enumerate(np.exp(-np.diff(seconds.ravel()[order]) / correlation_time_s), start=1):
        noise[k] = share * noise[k - 1] + np.sqrt(1 - share**2) * noise[k]
    placed = np.empty(seconds.size)
    placed[order] = noise
    return placed.reshape(seconds.shape)


def joint(noise: np.ndarray, seconds: np.ndarray) -> DriftFit:
    """Noise of some cycles (cycle, direction, target) alone, under a shift and a stretch that wander."""
    order = np.argsort(seconds.ravel())
    place = np.broadcast_to(np.linspace(0, 1, TARGETS), noise.shape).ravel()[order]
    loadings = np.column_stack([np.ones(place.size), place])
    return estimate(seconds.ravel()[order], loadings, noise.ravel()[order], loadings, memory=True)


@pytest.mark.parametrize(("share", "time_s"), [(1.0, 8.0), (0.5, 20.0)])
def test_noise_with_a_memory_within_a_pass_is_estimated_and_is_no_drift(rng, share, time_s):
    seconds = schedule(40)
    white = rng.normal(0, 0.35, seconds.shape)
    noise = np.sqrt(share) * 0.35 * correlated(rng, seconds, time_s) + np.sqrt(1.0 - share) * white
    fit = joint(noise, seconds)
    # 1280 readings of some hundred correlation times: the share is known to about a tenth, the time to about a fifth.
    assert fit.system.memory.share == pytest.approx(share, abs=0.3)
    assert fit.system.memory.time_s == pytest.approx(time_s, rel=0.5)
    assert fit.sigma == pytest.approx(0.35, rel=0.1)
    # um in an hour: as large as the noise of a mean over the readings of one, where a walk in its place is ten times as fast.
    assert fit.drift_rate[0] < 0.1


def test_independent_noise_has_no_memory(rng):
    seconds = schedule(40)
    assert all(joint(rng.normal(0, 0.35, seconds.shape), seconds).system.memory is None for _ in range(5))


def test_shares_by_direction_and_place():
    shares = component_loadings(
        np.array([1.0, -1.0, 1.0]), np.array([10.0, 20.0, 30.0]), components=list(COMPONENTS), span_mm=(10.0, 30.0)
    )
    np.testing.assert_allclose(shares, [[1, 0, 0.5, 0], [1, 0.5, -0.5, 1], [1, 1, 0.5, 0]])


PLACE = np.linspace(0, 1, 16)
KNOWN = np.column_stack([np.ones(16), PLACE])
WARM_UP = 1.0 - np.exp(-np.arange(80) / 25.0)


def test_a_hot_zone_is_found_with_its_shape(rng):
    zone = np.minimum(PLACE, 0.55)
    residual = 15.0 * WARM_UP[:, None] * zone + rng.normal(0, 0.3, (80, 16))
    residual[10, 3] = np.nan
    shape = common_shape(residual, KNOWN)
    assert shape is not None
    expected = zone - KNOWN @ np.linalg.lstsq(KNOWN, zone, rcond=None)[0]
    # A motion of some 0.3 um rms in this shape over 80 cycles of 0.3 um: the shape is known to some per cent.
    assert abs(np.corrcoef(shape, expected)[0, 1]) > 0.98
    assert np.abs(shape).max() == 1.0
    assert np.abs(KNOWN.T @ shape).max() < 1e-9


def test_noise_has_no_shape(rng):
    # The levels are 1 and 2 %: more than three of twenty by chance has a probability of 0.003.
    shapes = [common_shape(rng.normal(0, 0.3, (60, 16)), KNOWN) for _ in range(20)]
    assert sum(shape is not None for shape in shapes) <= 3


def test_a_single_position_memory_of_all_and_too_few_cycles_or_targets_give_no_shape(rng):
    residual = rng.normal(0, 0.3, (80, 16))
    residual[40:, 6] += 2.0
    assert common_shape(residual, KNOWN) is None
    assert common_shape(with_memory(rng.normal(0, 0.3, (100, 16)), 0.5), KNOWN) is None
    assert common_shape(rng.normal(size=(7, 16)), KNOWN) is None
    assert common_shape(rng.normal(size=(80, 3)), KNOWN[:3]) is None


def test_a_stretch_that_warms_is_found_in_a_short_test_and_random_jumps_of_it_are_none(rng):
    zone = 1.0 / (1.0 + np.exp(-(PLACE - 0.5) * 12.5))
    noise = rng.normal(0, 0.28, (15, 16))
    assert common_shape(3.0 * WARM_UP[:15, None] * zone + noise, KNOWN) is not None
    assert common_shape(rng.normal(0, 1.0, (60, 1)) * (PLACE > 0.1) + rng.normal(0, 0.28, (60, 16)), KNOWN) is None


def test_the_approaches_may_be_stored_in_any_order_and_one_may_lack(rng):
    test, _ = simulate(rng, cycles=8)
    plain = estimate_drift(test)
    turned = estimate_drift(test.isel(direction=[1, 0]))
    assert turned["direction"].values.tolist() == ["negative", "positive"]
    xr.testing.assert_identical(turned.isel(direction=[1, 0], other_direction=[1, 0]), plain)
    for name in ("positive", "negative"):
        alone = estimate_drift(test.sel(direction=[name]))
        empty = estimate_drift(test.where(test["direction"] == name).assign(position=test["position"]))
        np.testing.assert_array_equal(alone["profile"].sel(direction=name), empty["profile"].sel(direction=name))
        assert (alone.sizes["direction"], alone["reversal"].isnull().all()) == (1, True)


def test_the_limits_of_a_scatter_are_those_of_chi_square():
    """10 degrees of freedom: 20.48 and 3.247 are the 2.5 % points of the table; a scatter of nothing is below that of the others."""
    low, high = scatter_limits(np.array([1.0, 0.0, np.nan, 1.0]), np.array([10.0, 10.0, 10.0, 0.0]), 2.0)
    np.testing.assert_allclose(low, [np.sqrt(10 / 20.483), 0.0, np.nan, np.nan], rtol=1e-4)
    np.testing.assert_allclose(high, [np.sqrt(10 / 3.247), 2.0 * np.sqrt(10 / 3.247), np.nan, np.nan], rtol=1e-4)
