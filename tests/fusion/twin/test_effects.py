"""Every undeclared effect has the size that was asked for, its own signature, and changes nothing but its own series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.twin.effects import ANOMALIES, EFFECTS
from fusion.twin.recipe import AnomalyRecipe, EffectRecipe, Recipe
from fusion.twin.simulate import Truth, environment_log, simulate

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
    effect = truth.readings[name].values
    for part in plain.parts:
        np.testing.assert_array_equal(truth.readings[part].values, plain.readings[part].values)
    np.testing.assert_array_equal(truth.plate.amplitudes, plain.plate.amplitudes)
    np.testing.assert_allclose(truth.readings["deviation"] - plain.readings["deviation"], effect, atol=1e-12)
    affected = np.abs(moving(effect)).max(axis=0) > 1e-12
    assert np.sqrt(np.mean(moving(effect)[:, affected] ** 2)) == pytest.approx(0.4, rel=1e-9)


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - set(DRIFTING)))
def test_effects_of_the_camera_leave_the_machine_alone(plain, name):
    truth = simulate(BASE.vary(effect=(EffectRecipe(name, amplitude_K=2.0),)))
    np.testing.assert_array_equal(truth.readings["deviation"].values, plain.readings["deviation"].values)
    added = truth.frames["reflected_K" if name == "reflected_source" else "camera_offset_K"].values
    assert set(np.round(added, 12)) == {0.0, 2.0}


def test_camera_offset_in_um_counts_what_the_declared_model_would_predict_wrongly():
    truth = simulate(BASE.vary(effect=(EffectRecipe("camera_offset", 0.4, parameters={"at_cycle": 21}),)))
    step = truth.frames["camera_offset_K"].values.max()
    error = step * (11.7e-3 * truth.readings["position"].values + truth.recipe.drift.offset_um_per_K)
    # a step in the middle has an rms of half its height about its mean; between two frames it is a ramp
    assert 0.5 * np.sqrt(np.mean(error**2)) == pytest.approx(0.4, rel=0.02)


@pytest.mark.parametrize(
    "name", ["unseen_heat_source", "dead_path", "step_event", "periodic_disturbance", "thermal_lag"]
)
def test_flat_effects_do_not_depend_on_position_or_direction(plain, name):
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


def test_sensor_fault_acts_on_the_compensation_and_on_the_log():
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
    truth = simulate(BASE.vary(anomaly=(AnomalyRecipe(5, "stick_slip"),)))
    value = truth.readings["anomaly_5_stick_slip"].sel(target=5)
    assert float(value.sel(direction="positive").max()) == 0.0
    assert float(value.sel(direction="negative").min()) == 0.0
    assert float((value == 0).mean()) == pytest.approx(0.75, abs=0.15)
