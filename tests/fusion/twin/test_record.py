"""The simulated record: lumped capacities that conserve energy, a spindle without sensor, and a file that the analysis can read."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from fusion.campaign.config import load_campaign
from fusion.campaign.inputs import read_record
from fusion.twin import simulate
from fusion.twin.folders import truth_folder
from fusion.twin.instruments import simulate_campaign
from fusion.twin.recipe import AnomalyRecipe, EffectRecipe, Recipe, RecipeError
from fusion.twin.recipe_file import packaged_recipe, read_recipe
from fusion.twin.record import IN_A_RECORD, MOTOR_W, PARTS, SPINDLE_W, simulate_record, solve_parts

BASE = Recipe().vary(record={"hours": 12.0})


def test_steady_state_gives_off_what_it_takes_in():
    rises = solve_parts(np.full(4000, 0.7), np.full(4000, 0.4), np.zeros(4000), 600.0)
    given_off = sum(exchange * rise for (_, exchange), rise in zip(PARTS.values(), rises[-1], strict=True))
    assert given_off == pytest.approx(SPINDLE_W * 0.7**1.5 + MOTOR_W * 0.4, rel=1e-9)


def test_parts_settle_to_the_air_when_nothing_runs():
    rises = solve_parts(np.zeros(4000), np.zeros(4000), np.full(4000, 2.0), 600.0)
    np.testing.assert_allclose(rises[-1], 2.0, rtol=1e-9)


def test_steps_of_another_length_give_the_same_temperatures():
    fine = solve_parts(np.full(601, 1.0), np.zeros(601), np.zeros(601), 60.0)
    coarse = solve_parts(np.full(61, 1.0), np.zeros(61), np.zeros(61), 600.0)
    np.testing.assert_allclose(fine[::10], coarse, atol=1e-9)


@pytest.mark.parametrize("name", IN_A_RECORD)
def test_switched_effect_changes_only_its_own_series(name):
    plain, parameters = simulate_record(BASE), {"at_cycle": 6} if name == "step_event" else {}
    truth = simulate_record(BASE.vary(effect=(EffectRecipe(name, 0.7, parameters=parameters),)))
    for part in plain.parts:
        np.testing.assert_array_equal(truth.table[part].values, plain.table[part].values)
    np.testing.assert_array_equal(truth.table["temperature"].values, plain.table["temperature"].values)
    effect = truth.table[name]
    assert float(((effect - effect.mean("time")) ** 2).mean() ** 0.5) == pytest.approx(0.7, rel=1e-9)
    # logged with three decimals
    np.testing.assert_allclose(truth.table["displacement"] - plain.table["displacement"], effect, atol=1.1e-3)


def test_unseen_heat_follows_the_speed_and_no_sensor():
    effect = EffectRecipe("unseen_heat_source", 1.0, parameters={"time_constant_min": 5.0})
    table = simulate_record(BASE.vary(effect=(effect,))).table
    source = table["unseen_heat_source"].values[:, 0]
    correlation = np.corrcoef(table["speed"].values[:-6], source[6:])[0, 1]
    assert abs(correlation) > 0.9
    regressors = np.column_stack([table["temperature"].values, np.ones(source.size)])
    rest = source - regressors @ np.linalg.lstsq(regressors, source, rcond=None)[0]
    assert rest.std() > 0.3 * source.std()


def test_record_is_read_back(tmp_path):
    campaign = simulate_campaign(packaged_recipe("record"), tmp_path / "day")
    truth = simulate_record(read_recipe(packaged_recipe("record"))).table
    read = read_record(load_campaign(campaign))
    np.testing.assert_allclose(read["temperature"].values, truth["temperature"].values, atol=1e-9)
    np.testing.assert_allclose(read["displacement"].values, truth["displacement"].values, atol=1e-9)
    assert np.array_equal(read["time"].values, truth["time"].values)
    assert list(read["channel"].values) == ["X", "Y", "Z"]
    beside = truth_folder(tmp_path / "day")
    content = json.loads((beside / "truth.json").read_text(encoding="utf-8"))
    assert content["undeclared"] == ["unseen_heat_source"]
    assert content["parts_rms_um"]["unseen_heat_source"] == pytest.approx(1.5)
    with xr.open_dataset(beside / "truth.nc", engine="h5netcdf") as stored:
        assert set(content["parts_rms_um"]) <= set(stored.data_vars)
    assert "unseen" not in (tmp_path / "day" / "campaign.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"record": {"hours": 0.0}}, r"record\.hours = 0\.0: input should be greater than 0"),
        ({"record": {"channels": 7}}, r"record\.channels = 7: input should be less than or equal to 6"),
        ({"anomaly": (AnomalyRecipe(3),)}, r"anomaly: a record has no targets; remove the \[\[anomaly\]\] tables"),
        ({"effect": (EffectRecipe("dead_path"),)}, r"effect dead_path: .* use one of thermal_lag, "),
        ({"effect": (EffectRecipe("step_event", 1.0, parameters={"at_cycle": 30}),)}, "step_event: nothing moves"),
    ],
)
def test_record_that_cannot_be_is_refused(tables, message):
    with pytest.raises(RecipeError, match=message):
        simulate_record(BASE.vary(**tables))


def test_record_and_positioning_test_are_not_mixed_up():
    with pytest.raises(RecipeError, match=r"there is no \[record\] in this recipe; add the table, or use simulate"):
        simulate_record(Recipe())
    with pytest.raises(RecipeError, match=r"this recipe asks for a \[record\]; use simulate_record"):
        simulate(BASE)
