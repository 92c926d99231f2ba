"""The simulated readings: parts that add up, the stated intensity of every random part, and the figures of the paper."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from fusion.twin.instruments import deviations_of, fields_of
from fusion.twin.machine import INNER_PART, Drive, Session, first_order, random_levels, switched_levels
from fusion.twin.recipe import AnomalyRecipe, Drift, EffectRecipe, Laser, Profile, Recipe
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
from interferometry.common import DEVIATIONS
from thermography.common import FIELDS

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


def test_same_seed_same_campaign_and_another_seed_another(plain):
    again, other = simulate(BASE), simulate(BASE.vary(campaign={"seed": 2}))
    assert plain.readings.identical(again.readings) and plain.frames.identical(again.frames)
    assert not plain.readings["deviation"].equals(other.readings["deviation"])


def test_every_part_of_a_reading_is_accounted_for():
    steps = (EffectRecipe("step_event"), EffectRecipe("step_event", parameters={"at_cycle": 12}))
    truth = simulate(BASE.vary(effect=(*steps, EffectRecipe("dead_path")), anomaly=(AnomalyRecipe(3),)))
    assert {"step_event", "step_event_again2", "anomaly_3_structural"} <= set(truth.parts)
    total = sum(truth.readings[part] for part in truth.parts)
    np.testing.assert_allclose(total, truth.readings["deviation"], atol=1e-12)


def test_mean_profile_and_scatter_are_those_of_the_readings_without_and_of_their_random_part():
    truth = simulate(BASE.vary(drift={"walk": "none"}, anomaly=(AnomalyRecipe(3, amplitude_um=0.8),)))
    readings = truth.readings
    # 40 readings per target and direction: the mean of 0.4 um of noise is known within 0.063 um, at target 3 of 0.9 um within 0.14
    np.testing.assert_allclose(readings["mean_profile"], readings["deviation"].mean("cycle"), atol=0.45)
    usual = readings["scatter"].drop_sel(target=3)
    assert float(usual.mean()) == pytest.approx(0.4, rel=0.05)
    assert float(readings["scatter"].sel(target=3).min()) > float(usual.max())


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


# The states behind the readings: bodies that respond as two lags in series must, and series at the right times.


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(Recipe().vary(test={"cycles": 20}, table={"preheat_min": 30.0})).session


def test_warm_up_is_that_of_two_lags_in_series(session):
    tau, inner = 1800.0, INNER_PART * 1800.0
    state = session.state("constant", 30.0, "any")
    t = session.grid_s[session.grid_s >= 0]
    expected = 1.0 - (tau * np.exp(-t / tau) - inner * np.exp(-t / inner)) / (tau - inner)
    # the grid's step of 10 s delays each of the two lags by up to one step: 20 s of at most 1 / 1800 s
    np.testing.assert_allclose(state[session.grid_s >= 0], expected, atol=0.012)
    assert np.all(state[session.grid_s < 0] == 0.0)


@pytest.mark.parametrize("follows", get_args(Drive))
def test_every_state_starts_from_zero_with_the_test(session, follows):
    state = session.state(follows, 20.0, "any")
    assert np.interp(0.0, session.grid_s, state) == pytest.approx(0.0, abs=1e-12)
    assert np.ptp(state) > 0.0


def test_own_drive_differs_between_effects_and_is_not_the_logged_load(session):
    first, second = session.state("own", 10.0, "first"), session.state("own", 10.0, "second")
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, session.state("duty", 10.0, "first"))
    np.testing.assert_array_equal(first, session.state("own", 10.0, "first"))


# Named random streams, loads with their stated holds, and a lag that is exact for a stepwise constant drive.


TIME_S = np.arange(0.0, 400 * 3600.0, 10.0)


def holds_min(level: np.ndarray) -> np.ndarray:
    """Times for which a level was held, the first and the last left out, min."""
    changes = np.flatnonzero(np.diff(level))
    return np.diff(TIME_S[changes]) / 60.0


def test_random_levels_are_held_between_0_4_and_1_6_of_the_mean(rng):
    level = random_levels(TIME_S, 0.2, 0.9, 30.0, rng)
    hold = holds_min(level)
    step = 10.0 / 60.0
    assert hold.min() >= 12.0 - step
    assert hold.max() <= 48.0 + step
    # some 800 holds with a standard deviation of 10.4 min know their mean to 0.4 min
    assert hold.mean() == pytest.approx(30.0, abs=1.5)
    # uniform levels between 0.2 and 0.9
    assert level.mean() == pytest.approx(0.55, abs=0.03)


def test_switched_levels_have_a_minimum_hold_and_an_exponential_rest(rng):
    hold = holds_min(switched_levels(TIME_S, (0.0, 1.0), (600.0, 1200.0), rng))
    assert hold.min() >= 10.0 - 10.0 / 60.0
    # some 800 holds of 10 min + Exp(20 min): mean and standard deviation of the rest are equal, known to 4 % and 5 %
    assert hold.mean() == pytest.approx(30.0, abs=3.0)
    assert hold.std() == pytest.approx(20.0, rel=0.2)


@pytest.mark.parametrize("step_s", [10.0, 60.0, 300.0])
def test_first_order_is_exact_for_a_constant_drive_at_any_step(step_s):
    t = np.arange(0.0, 3600.0, step_s)
    np.testing.assert_allclose(
        first_order(np.full(t.size, 2.0), step_s, 900.0), 2.0 * (1.0 - np.exp(-t / 900.0)), atol=1e-12
    )


def test_first_order_attenuates_and_delays_a_sine_as_a_low_pass_does():
    period_s, tau_s = 3600.0, 900.0
    t = np.arange(0.0, 20 * period_s, 1.0)
    omega = 2 * np.pi / period_s
    settled = first_order(np.sin(omega * t), 1.0, tau_s)[10 * int(period_s) :]
    transfer = 1.0 / (1.0 + 1j * omega * tau_s)
    expected = np.abs(transfer) * np.sin(omega * t + np.angle(transfer))[10 * int(period_s) :]
    # a drive held over steps of 1 s lags half a second more: omega / 2
    np.testing.assert_allclose(settled, expected, atol=1e-3)


# The truth as Datasets without files keeps the instruments' contracts, with the camera's noise and errors.


def test_datasets_without_files_keep_the_contracts():
    truth = simulate(Recipe().vary(test={"cycles": 5, "missing_fraction": 0.1}))
    for dataset, contract in ((deviations_of(truth), DEVIATIONS), (fields_of(truth), FIELDS)):
        for name, (dims, units, kind) in contract.items():
            assert dataset[name].dims == dims, name
            assert dataset[name].dtype.kind == kind, name
            assert dataset[name].attrs.get("units", "") == units, name
    deviations = deviations_of(truth)
    assert np.array_equal(np.isnat(deviations["time"].values), np.isnan(deviations["deviation"].values))


def test_fields_without_files_are_cell_means_with_the_frames_noise():
    truth = simulate(Recipe().vary(test={"cycles": 6}))
    quiet, noisy = fields_of(truth, noise_K=0.0), fields_of(truth)
    fine_x, fine_y = np.arange(0.25, 700, 0.5)[600:610], np.arange(0.25, 180, 0.5)[150:160]
    cell = truth.temperature(truth.session.frame_s, fine_x, fine_y).mean(axis=(1, 2))
    np.testing.assert_allclose(quiet["temperature"].sel(x=302.5, y=77.5), cell, atol=1e-4)
    noise = (noisy["temperature"] - quiet["temperature"]).std()
    # 50 mK over 18.9 pixels of 5 mm
    assert float(noise) == pytest.approx(0.0115, abs=0.0005)


def test_burst_lowers_the_noise_of_a_cycle_and_shows_its_spread():
    single, burst = (simulate(Recipe().vary(test={"cycles": 4}, camera={"frames_per_cycle": n})) for n in (1, 16))
    quiet = fields_of(burst, noise_K=0.0)["temperature"]
    noise = [float((fields_of(truth)["temperature"] - quiet).std()) for truth in (single, burst)]
    # 22,680 values of noise; within three seconds the table itself moves by well under 1 mK
    assert noise[0] / noise[1] == pytest.approx(4.0, rel=0.05)
    assert float(fields_of(burst)["temperature_spread"].mean()) == pytest.approx(0.0115 * np.sqrt(15 / 16), rel=0.05)


def test_fields_without_files_show_what_the_camera_adds():
    effects = (EffectRecipe("camera_offset", amplitude_K=0.5, parameters={"at_cycle": 3}),)
    spot = (EffectRecipe("reflected_source", amplitude_K=40.0, parameters={"follows": "constant"}),)
    plain = fields_of(simulate(Recipe().vary(test={"cycles": 6})), noise_K=0.0)["temperature"]
    lifted = fields_of(simulate(Recipe().vary(test={"cycles": 6}, effect=effects)), noise_K=0.0)["temperature"] - plain
    np.testing.assert_allclose(lifted.mean(["y", "x"]), [0, 0, 0.5, 0.5, 0.5, 0.5], atol=1e-12)
    mirrored = fields_of(simulate(Recipe().vary(test={"cycles": 6}, effect=spot)), noise_K=0.0)["temperature"] - plain
    peak = mirrored[-1].argmax(["y", "x"])
    # the spot's centre lies on the border of two cells in x and of two in y
    assert abs(float(mirrored["x"][peak["x"]]) - 480.0) == 2.5
    assert abs(float(mirrored["y"][peak["y"]]) - 60.0) == 2.5
    # 3 % of 40 K over 97 %, warmed up to 99 %
    assert float(mirrored[-1].max()) == pytest.approx(1.23, abs=0.05)


def test_fields_of_a_moving_table_need_frames():
    with pytest.raises(ValueError, match=r"fields_of needs camera\.table = 'still'; write the campaign"):
        fields_of(simulate(Recipe().vary(test={"cycles": 2}, camera={"table": "moving"})))
