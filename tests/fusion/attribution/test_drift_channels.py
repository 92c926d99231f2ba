"""Readings to drift channels: known drifts come back, whatever is missing."""

import numpy as np
import pytest

from fusion.alignment.first_order_lag import lag_operators, respond
from fusion.attribution.drift_channels import ChannelError, read_clock, reduce_channels, target_table
from tests.fusion import film_simulator as simulator


def known_session(rng, noise_um=0.0):
    common = np.cumsum(rng.standard_normal(simulator.CYCLES))
    slope = np.cumsum(rng.standard_normal(simulator.CYCLES))
    reversal = np.cumsum(rng.standard_normal(simulator.CYCLES))
    # Drifts that stand still within a cycle: the reduction must then return them exactly.
    made = simulator.session(
        np.zeros((simulator.CYCLES, 2, 2)), common * 0, slope * 0, rng, reversal=reversal * 0, noise_um=noise_um
    )
    scaled = np.linspace(-1, 1, 16)
    sign = np.array([0.5, -0.5])[:, None]
    drift = common[:, None, None] + slope[:, None, None] * scaled + reversal[:, None, None] * sign
    made.fused["deviation"] = made.fused["deviation"] + drift
    return made, np.stack([common, slope, reversal])


def centred(values):
    return values - values.mean(axis=-1, keepdims=True)


def test_channels_return_the_drifts_that_were_put_in(rng):
    made, truth = known_session(rng)
    series = reduce_channels(read_clock(made.fused, made.field["time"].values))
    assert [one.name for one in series] == ["common", "proportional", "reversal"]
    # Rounding only.
    np.testing.assert_allclose(centred(np.stack([one.values for one in series])), centred(truth), atol=1e-9)


def test_missing_readings_do_not_leak_the_profile_into_the_channels(rng):
    made, truth = known_session(rng)
    gone = rng.random(made.fused["deviation"].shape) < 0.2
    made.fused["deviation"] = made.fused["deviation"].where(~gone)
    series = reduce_channels(read_clock(made.fused, made.field["time"].values))
    # Backfitting stops at 1e-9 of the spread per round; convergence leaves at most a few orders more.
    np.testing.assert_allclose(centred(np.stack([one.values for one in series])), centred(truth), atol=1e-5)


def test_noise_of_a_channel_is_what_its_relative_variance_says(rng):
    made, truth = known_session(rng, noise_um=0.4)
    series = reduce_channels(read_clock(made.fused, made.field["time"].values))
    for one, drift in zip(series, truth, strict=True):
        left = centred(one.values) - centred(drift)
        # The standard deviation of 100 values is known to 7 %; 4 sigma.
        assert left.std() == pytest.approx(0.4 * np.sqrt(one.variance[0]), rel=0.3)


def test_one_direction_has_no_reversal(rng):
    made, _ = known_session(rng)
    forward = made.fused.sel(direction=["positive"])
    assert [one.name for one in reduce_channels(read_clock(forward, made.field["time"].values))] == [
        "common",
        "proportional",
    ]


def test_a_channel_sees_the_film_at_its_own_instants(rng):
    made, _ = known_session(rng)
    readings = read_clock(made.fused, made.field["time"].values)
    ramp = readings.frame_seconds / 3600.0
    _, _, seconds, sampling = target_table(readings)
    for instants, weights in [*((one.seconds, one.sampling) for one in reduce_channels(readings)), (seconds, sampling)]:
        # Inside the film a linear course is sampled exactly at the readings' mean time.
        inner = slice(1, -1)
        np.testing.assert_allclose((weights @ ramp)[inner], instants[inner] / 3600.0, atol=1e-9)


def test_readings_far_from_every_frame_are_counted_not_used(rng):
    made, _ = known_session(rng)
    film = made.field["time"].values[:50]
    readings = read_clock(made.fused, film)
    assert readings.outside_film > 1000
    last = max(one.seconds.max() for one in reduce_channels(readings))
    assert last <= readings.frame_seconds[-1] + simulator.PERIOD_S


def test_first_order_response_is_exact_for_a_step_and_a_ramp():
    seconds = np.arange(0.0, 7200.0, 60.0)
    ramp = seconds[:, None] / 1000.0
    tau = 900.0
    expected = (seconds - tau * (1 - np.exp(-seconds / tau))) / 1000.0
    np.testing.assert_allclose(respond(ramp, seconds, time_constant_s=tau)[:, 0], expected, atol=1e-12)
    operator = lag_operators(seconds, [0.0, tau])[1]
    np.testing.assert_allclose(operator @ ramp[:, 0], expected, atol=1e-12)


def test_too_short_a_film_is_refused(rng):
    made, _ = known_session(rng)
    with pytest.raises(ChannelError, match=r"the film has 5 frames in order of time; correlation needs at least 12"):
        read_clock(made.fused, made.field["time"].values[:5])


def test_too_few_cycles_are_refused(rng):
    made, _ = known_session(rng)
    with pytest.raises(ChannelError, match=r"only 8 of 8 cycles hold enough readings inside the film"):
        reduce_channels(read_clock(made.fused.isel(cycle=slice(0, 8)), made.field["time"].values))


def test_targets_without_readings_are_refused(rng):
    made, _ = known_session(rng)
    empty = made.fused.assign(deviation=made.fused["deviation"] * np.nan)
    with pytest.raises(ChannelError, match="no target has readings in 12 cycles inside the film"):
        target_table(read_clock(empty, made.field["time"].values))
