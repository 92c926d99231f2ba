"""The simulated readings: parts that add up, the stated intensity of every random part, and the figures of the paper."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.twin.machine.recipe import AnomalyRecipe, Drift, EffectRecipe, Laser, Profile, Recipe
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from fusion.twin.simulate import (
    Truth,
    driver_log,
    environment_log,
    laser_noise,
    moving_rms,
    nuisance,
    simulate,
    static_profile,
)

BASE = Recipe().vary(test={"cycles": 40, "jitter_mm": 3.0})


@pytest.fixture(scope="module")
def plain() -> Truth:
    return simulate(BASE)


@pytest.mark.parametrize("walk", ["random_walk", "integrated", "ou", "none"])
def test_nuisance_has_its_stated_intensity(plain, walk):
    drift = Drift(walk=walk, walk_common_um_per_sqrt_h=0.5)
    hour = np.searchsorted(plain.session.time_s, 3600.0) // 32 * 32
    assert plain.session.position_mm[hour] == 0.0
    after = [nuisance(drift, plain.session, seed)[hour] for seed in range(200)]
    expected = 0.0 if walk == "none" else 0.5
    # the standard deviation of 200 draws is known within 5 %; the reading is up to one cycle, 7 %, before the hour
    assert np.std(after) == pytest.approx(expected, abs=0.2 * expected)


def test_same_seed_same_campaign_and_another_seed_another():
    first, again, other = simulate(BASE), simulate(BASE), simulate(BASE.vary(campaign={"seed": 2}))
    assert first.readings.identical(again.readings)
    assert first.frames.identical(again.frames)
    assert not first.readings["deviation"].equals(other.readings["deviation"])


def test_every_part_of_a_reading_is_accounted_for():
    effects = (
        EffectRecipe("step_event"),
        EffectRecipe("step_event", parameters={"at_cycle": 12}),
        EffectRecipe("dead_path"),
    )
    truth = simulate(BASE.vary(effect=effects, anomaly=(AnomalyRecipe(3),)))
    assert {"step_event", "step_event_again2", "anomaly_3_structural"} <= set(truth.parts)
    np.testing.assert_allclose(
        sum(truth.readings[part] for part in truth.parts), truth.readings["deviation"], atol=1e-12
    )


def test_mean_profile_and_scatter_are_those_of_the_readings_without_and_of_their_random_part():
    truth = simulate(BASE.vary(drift={"walk": "none"}, anomaly=(AnomalyRecipe(3, amplitude_um=0.8),)))
    readings = truth.readings
    # 40 readings per target and direction: the mean of 0.4 um of noise is known within 0.063 um, at target 3 of 0.9 um within 0.14
    np.testing.assert_allclose(readings["mean_profile"], readings["deviation"].mean("cycle"), atol=0.45)
    usual = readings["scatter"].drop_sel(target=3)
    assert float(usual.mean()) == pytest.approx(0.4, rel=0.05)
    assert float(readings["scatter"].sel(target=3).min()) > float(usual.max())


def test_drift_moves_within_a_pass():
    truth = simulate(BASE.vary(drift={"walk": "none"}))
    offset = truth.readings["table_offset"].values
    assert np.all(np.ptp(offset[5:, 0], axis=1) > 0)
    assert truth.readings["time"].values[0, 1, -1] < truth.readings["time"].values[0, 1, 0]


def test_lost_readings_are_lost_at_the_stated_rate():
    truth = simulate(BASE.vary(test={"cycles": 60, "missing_fraction": 0.1}))
    # 1,920 readings: 0.10 +- 0.007
    assert float(truth.readings["deviation"].isnull().mean()) == pytest.approx(0.1, abs=0.025)


def test_conditions_of_the_paper_give_its_figures():
    deviation = simulate(read_recipe(packaged_recipe("paper"))).readings["deviation"].sel(direction="positive").values
    assert deviation.shape == (100, 16)
    conventional = deviation[:, 3].std(ddof=1)
    difference = (deviation[:, 3] - deviation[:, 4]).std(ddof=1)
    # 2 % of the printed 1.64 um and of 1.64 / 3.09
    assert conventional == pytest.approx(1.64, rel=0.02)
    assert difference == pytest.approx(1.64 / 3.09, rel=0.02)


def test_static_profile_has_its_slope_bow_and_reversal(plain):
    profile = Profile(slope_um=4.0, bow_um=1.5, rough_um=0.0, pitch_um=0.0, reversal_um=0.8)
    session = plain.session
    value = static_profile(profile, session, seed=2)
    forward, backward = session.sign > 0, session.sign < 0
    order = np.argsort(session.target[forward][:16])
    mean = 0.5 * (value[forward][:16][order] + value[backward][:16][np.argsort(session.target[backward][:16])])
    share = session.share[forward][:16][order]
    np.testing.assert_allclose(mean, 4.0 * share + 6.0 * share * (1.0 - share), atol=1e-12)
    # the reversal error varies by 15 % between 16 targets
    assert value[forward].mean() - value[backward].mean() == pytest.approx(0.8, abs=0.1)


@pytest.mark.parametrize("tails", ["normal", "t4"])
def test_laser_noise_has_its_standard_deviation_with_either_tail(plain, tails):
    noise = np.concatenate([laser_noise(Laser(noise_um=0.5, tails=tails), plain.session, seed) for seed in range(20)])
    # 25,600 readings; the fourth moment of t4 is infinite, so its sample standard deviation scatters by a few percent
    assert noise.std() == pytest.approx(0.5, rel=0.01 if tails == "normal" else 0.1)
    assert (np.abs(noise) > 2.0).mean() > 1e-3 if tails == "t4" else np.abs(noise).max() < 3.0


def test_moving_rms_counts_only_the_sites_that_move(plain):
    session = plain.session
    series = np.where((session.target == 4) & (session.sign > 0), np.sin(session.time_s / 1000.0), 5.0)
    here = series[(session.target == 4) & (session.sign > 0)]
    assert moving_rms(series, session) == pytest.approx(here.std())
    assert moving_rms(np.full(series.size, 5.0), session) == 0.0


def test_logs_are_taken_once_a_minute_and_cover_the_test(plain):
    environment, drivers = environment_log(plain), driver_log(plain)
    minutes = int(plain.schedule.duration_s // 60)
    assert environment.sizes["time"] == drivers.sizes["time"] == minutes
    assert float(drivers["duty"].min()) >= 0.0
    assert float(drivers["duty"].max()) <= 1.0
    true = np.interp(60.0 * np.arange(minutes), plain.session.grid_s, plain.session.air_degC)
    # 4 mK of noise and a resolution of 10 mK, uniform: 4.9 mK together
    assert float((environment["air_temperature"] - true).std()) == pytest.approx(0.0049, rel=0.15)
