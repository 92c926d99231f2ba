"""Readings to drift channels: known drifts come back, whatever is missing."""

import numpy as np
import pytest

from fusion.analysis.attribution.drift_channels import ChannelError, clock_readings, reduce_channels, target_series
from tests.fusion import field_simulator as simulator


def driven_session(rng, noise_um=0.0):
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
    made, truth = driven_session(rng)
    series = reduce_channels(clock_readings(made.fused, made.field["time"].values))
    assert [channel.name for channel in series] == ["common", "proportional", "reversal"]
    # Rounding only.
    np.testing.assert_allclose(centred(np.stack([channel.values for channel in series])), centred(truth), atol=1e-9)


def test_missing_readings_do_not_leak_the_profile_into_the_channels(rng):
    made, truth = driven_session(rng)
    gone = rng.random(made.fused["deviation"].shape) < 0.2
    made.fused["deviation"] = made.fused["deviation"].where(~gone)
    series = reduce_channels(clock_readings(made.fused, made.field["time"].values))
    # Backfitting stops at 1e-9 of the spread per round; convergence leaves at most a few orders more.
    np.testing.assert_allclose(centred(np.stack([channel.values for channel in series])), centred(truth), atol=1e-5)


def test_noise_of_a_channel_is_what_its_relative_variance_says(rng):
    made, truth = driven_session(rng, noise_um=0.4)
    series = reduce_channels(clock_readings(made.fused, made.field["time"].values))
    for channel, drift in zip(series, truth, strict=True):
        residual = centred(channel.values) - centred(drift)
        # The standard deviation of 100 values is known to 7 %; 4 sigma.
        assert residual.std() == pytest.approx(0.4 * np.sqrt(channel.variance[0]), rel=0.3)


def test_one_direction_has_no_reversal(rng):
    made, _ = driven_session(rng)
    forward = made.fused.sel(direction=["positive"])
    series = reduce_channels(clock_readings(forward, made.field["time"].values))
    assert [channel.name for channel in series] == ["common", "proportional"]


def test_a_channel_samples_the_field_at_its_own_instants(rng):
    made, _ = driven_session(rng)
    readings = clock_readings(made.fused, made.field["time"].values)
    ramp = readings.frame_seconds / 3600.0
    sampled = [*reduce_channels(readings), target_series(readings)]
    for instants, weights in ((series.seconds, series.sampling) for series in sampled):
        # Between the frames a linear course is sampled exactly at the mean time of the readings.
        inner = slice(1, -1)
        np.testing.assert_allclose((weights @ ramp)[inner], instants[inner] / 3600.0, atol=1e-9)


def test_readings_far_from_every_frame_are_counted_not_used(rng):
    made, _ = driven_session(rng)
    readings = clock_readings(made.fused, made.field["time"].values[:50])
    assert readings.outside_frames > 1000
    last = max(channel.seconds.max() for channel in reduce_channels(readings))
    assert last <= readings.frame_seconds[-1] + simulator.PERIOD_S


def test_too_few_frames_cycles_or_readings_are_refused(rng):
    made, _ = driven_session(rng)
    fused, times = made.fused, made.field["time"].values
    with pytest.raises(ChannelError, match=r"5 frames; correlation needs at least 12 in order of time"):
        clock_readings(fused, times[:5])
    with pytest.raises(ChannelError, match=r"only 8 of 8 cycles hold enough readings inside the frames' time"):
        reduce_channels(clock_readings(fused.isel(cycle=slice(0, 8)), times))
    with pytest.raises(ChannelError, match="no target has readings in 12 cycles inside the frames' time"):
        target_series(clock_readings(fused.assign(deviation=fused["deviation"] * np.nan), times))


def test_every_target_and_direction_is_a_series_with_its_name(rng):
    made, _ = driven_session(rng)
    made.fused["deviation"][:, 1, 3] = np.nan
    targets = target_series(clock_readings(made.fused, made.field["time"].values))
    # Target 4 has no readings in the negative direction.
    assert targets.names[:2] == ("positive 1", "positive 2")
    assert "negative 4" not in targets.names and len(targets.names) == 31
    assert targets.directions[3] == "positive" and targets.targets[3] == 4
    np.testing.assert_array_equal(targets.values[3], made.fused["deviation"].values[:, 0, 3])
