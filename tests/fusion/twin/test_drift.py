"""Every undeclared effect has the size that was asked for, its own signature, and touches nothing but its own series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.twin.machine.air import refractivity
from fusion.twin.machine.effects import ANOMALIES, EFFECTS
from fusion.twin.machine.recipe import AnomalyRecipe, Drift, EffectRecipe, Recipe
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from fusion.twin.simulate import Truth, environment_log, nuisance, simulate

BASE = Recipe().vary(test={"cycles": 40, "jitter_mm": 3.0})
DRIFTING = sorted(name for name, effect in EFFECTS.items() if effect.unit == "um")


def with_effect(name: str, amplitude_um: float | None = 0.4, **parameters: object) -> Truth:
    return simulate(BASE.vary(effect=(EffectRecipe(name, amplitude_um, parameters=parameters),)))


def moving(values: np.ndarray) -> np.ndarray:
    return values - values.mean(axis=0)


@pytest.fixture(scope="module")
def plain() -> Truth:
    return simulate(BASE)


@pytest.mark.parametrize("name", DRIFTING)
def test_switched_effect_changes_only_its_own_series(plain, name):
    truth = with_effect(name)
    own = truth.readings[name].values
    for part in plain.parts:
        np.testing.assert_array_equal(truth.readings[part].values, plain.readings[part].values)
    np.testing.assert_array_equal(truth.plate.amplitudes, plain.plate.amplitudes)
    np.testing.assert_allclose(truth.readings["deviation"] - plain.readings["deviation"], own, atol=1e-12)
    affected = np.abs(moving(own)).max(axis=0) > 1e-12
    assert np.sqrt(np.mean(moving(own)[:, affected] ** 2)) == pytest.approx(0.4, rel=1e-9)


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - set(DRIFTING)))
def test_effects_of_the_camera_leave_the_machine_alone(plain, name):
    truth = simulate(BASE.vary(effect=(EffectRecipe(name, amplitude_K=2.0),)))
    np.testing.assert_array_equal(truth.readings["deviation"].values, plain.readings["deviation"].values)
    seen = truth.frames["reflected_K" if name == "reflected_source" else "camera_offset_K"].values
    assert set(np.round(seen, 12)) == {0.0, 2.0}


def test_camera_offset_in_um_counts_what_the_declared_model_would_predict_wrongly():
    truth = simulate(BASE.vary(effect=(EffectRecipe("camera_offset", 0.4, parameters={"at_cycle": 21}),)))
    step = truth.frames["camera_offset_K"].values.max()
    error = step * (11.7e-3 * truth.readings["position"].values + truth.recipe.drift.offset_um_per_K)
    # a step in the middle has an rms of half its height about its mean; between two frames it is a ramp
    assert 0.5 * np.sqrt(np.mean(error**2)) == pytest.approx(0.4, rel=0.02)


@pytest.mark.parametrize(
    "name", ["unseen_heat_source", "dead_path", "step_event", "periodic_disturbance", "thermal_lag"]
)
def test_flat_effects_do_not_know_position_or_direction(plain, name):
    session = plain.session
    elsewhere = replace(session, position_mm=session.position_mm[::-1], sign=-session.sign, target=session.target[::-1])
    np.testing.assert_array_equal(EFFECTS[name].series(elsewhere), EFFECTS[name].series(session))


@pytest.mark.parametrize("name", ["air_index", "material_compensation"])
def test_linear_effects_grow_from_the_lasers_zero(name):
    value = moving(with_effect(name).readings[name].values)
    position = BASE.test.spacing_mm * np.arange(16)
    assert np.abs(value[:, :, 0]).max() == 0.0
    slope = value[:, 0, -1] / position[-1]
    # targets are up to 3 mm off their nominal place and read up to 92 s earlier
    assert np.corrcoef(value[:, 0, 7], slope)[0, 1] > 0.98


@pytest.mark.parametrize("name", ["reversal_drift", "direction_scale"])
def test_odd_effects_change_sign_with_the_direction(name):
    value = with_effect(name).readings[name].values
    assert np.all(value[1:, 0, 1:] * value[1:, 1, 1:] < 0)


def test_angular_growth_is_quadratic_in_position():
    value = with_effect("angular_growth", None, follows="constant").readings
    share = (value["position"] / value["position"][-1]).values
    last = value["angular_growth"].values[-1].mean(axis=0)
    # the state has come to rest within 2 % of its motion during the last cycle
    np.testing.assert_allclose(last / last[-1], share**2, atol=0.02)
    # 2 arcsec over 150 mm is 1.454 um; after 166 min a chain of 9 and 60 min has reached all but 60 / 51 exp(-166 / 60)
    assert last[-1] == pytest.approx(1.454 * (1 - 60 / 51 * np.exp(-166 / 60)), rel=0.01)


def test_dead_path_follows_the_index_of_air():
    truth = with_effect("dead_path", None, mm=100.0)
    change = truth.session.at_readings(truth.session.refractivity) - truth.session.refractivity[0]
    np.testing.assert_allclose(truth.in_order("dead_path"), 100e3 * change, atol=1e-9)


def test_sensor_fault_is_believed_and_logged():
    truth = with_effect("sensor_fault", None, at_cycle=20, sensor="air_temperature", kind="jump", size=2.0)
    logged = environment_log(truth)["air_temperature"].values
    jump = round((20 - 1) * 252 / 60)
    assert logged[jump + 2 :].mean() - logged[: jump - 1].mean() == pytest.approx(2.0, abs=0.4)
    error = truth.readings["sensor_fault"].values
    assert np.abs(error[:19]).max() < 1e-9
    # 2 K too warm lowers the index it computes by 1.9 ppm, so 300 mm read 0.57 um long
    assert error[-1, :, -1].mean() == pytest.approx(0.57, abs=0.02)


@pytest.mark.parametrize("sensor", ["air_temperature", "air_pressure"])
def test_sensor_fault_of_a_given_rms_logs_the_jump_that_causes_it(plain, sensor):
    truth = with_effect("sensor_fault", 0.4, at_cycle=20, sensor=sensor)
    jump = float((environment_log(truth)[sensor] - environment_log(plain)[sensor])[-1])
    per_unit = {"air_temperature": 0.955e-3, "air_pressure": -0.268e-3}[sensor]
    # a step after 19 of 40 cycles has the rms 0.4994 of its height; the sensitivities are those of 20 degC and 1013.25 hPa, and
    # n - 1 is proportional to p / T: 3 % less air and a temperature sensitivity that is 5 % smaller here
    height = per_unit * jump * plain.readings["position"].values[1:]
    assert 0.4994 * np.sqrt(np.mean(height**2)) == pytest.approx(0.4, rel=0.06)


def test_refractivity_has_the_published_sensitivities():
    def at(t: float = 20.0, p: float = 1013.25, h: float = 50.0) -> float:
        return float(refractivity(np.array(t), np.array(p), np.array(h))) * 1e6

    # Ciddor at 633 nm, 20 degC, 101.325 kPa, dry: n - 1 = 271.800e-6; two published equations agree within 0.03 ppm
    assert at(h=0.0) == pytest.approx(271.800, abs=0.03)
    assert at(t=20.5) - at(t=19.5) == pytest.approx(-0.955, abs=0.005)
    assert at(p=1013.75) - at(p=1012.75) == pytest.approx(0.268, abs=0.001)
    assert at(h=55.0) - at(h=45.0) == pytest.approx(-0.085, abs=0.003)


@pytest.mark.parametrize("kind", sorted(ANOMALIES))
@pytest.mark.parametrize("direction", ["both", "positive", "negative"])
def test_anomaly_stays_at_its_target_and_has_its_size(kind, direction):
    truth = simulate(BASE.vary(anomaly=(AnomalyRecipe(5, kind, direction, 0.5),)))
    value = truth.readings[f"anomaly_5_{kind}"]
    elsewhere = value.drop_sel(target=5)
    assert float(abs(elsewhere).max()) == 0.0
    sides = {"both": ["positive", "negative"], "positive": ["positive"], "negative": ["negative"]}[direction]
    here = value.sel(target=5, direction=sides)
    assert float(((here - here.mean("cycle")) ** 2).mean() ** 0.5) == pytest.approx(0.5, rel=1e-9)
    assert float(abs(value.sel(target=5).drop_sel(direction=sides)).sum()) == 0.0


def test_local_temperature_is_seen_on_the_plan_under_its_target(plain):
    truth = simulate(BASE.vary(anomaly=(AnomalyRecipe(5, "local_temperature", "both", 0.5),)))
    x, y = np.arange(5.0, 700.0, 10.0), np.arange(5.0, 180.0, 10.0)
    extra = truth.temperature(truth.session.frame_s, x, y) - plain.temperature(plain.session.frame_s, x, y)
    row, column = np.unravel_index(extra.max(axis=0).argmax(), extra.shape[1:])
    place = 500.0 - float(truth.readings["position"][4])
    assert abs(x[column] - place) <= 10.0
    assert abs(y[row] - 90.0) <= 10.0
    assert 0.5 < extra.max() < 5.0


def test_stick_slip_stops_short_of_the_target():
    value = (
        simulate(BASE.vary(anomaly=(AnomalyRecipe(5, "stick_slip"),))).readings["anomaly_5_stick_slip"].sel(target=5)
    )
    assert float(value.sel(direction="positive").max()) == 0.0
    assert float(value.sel(direction="negative").min()) == 0.0
    assert float((value == 0).mean()) == pytest.approx(0.75, abs=0.15)


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
    one, two, other = simulate(BASE), simulate(BASE), simulate(BASE.vary(campaign={"seed": 2}))
    assert one.readings.identical(two.readings)
    assert one.frames.identical(two.frames)
    assert not one.readings["deviation"].equals(other.readings["deviation"])


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


def test_paper_lasts_seven_hours():
    truth = simulate(read_recipe(packaged_recipe("paper")))
    assert truth.schedule.duration_s == pytest.approx(7 * 3600.0)
    step = np.diff(truth.session.time_s[:16])
    np.testing.assert_allclose(step, 20.0 / 5.0 + 2.0)
