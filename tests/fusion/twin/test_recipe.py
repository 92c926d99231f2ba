"""The recipe's tables: complete choices, defaults that can be simulated, and copies with some values changed."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import get_args, get_type_hints

import jsonschema
import pytest

from fusion.twin.effects import ANOMALIES, EFFECTS
from fusion.twin.recipe import AnomalyRecipe, EffectRecipe, Recipe, RecipeError, Record
from fusion.twin.recipe_file import check_recipe, packaged_recipe, read_recipe, recipe_schema
from fusion.twin.simulate import simulate


def test_anomalies_of_the_recipe_are_those_of_the_machine():
    assert get_args(get_type_hints(AnomalyRecipe)["kind"]) == tuple(ANOMALIES)


def test_vary_changes_the_named_values_only():
    recipe = Recipe().vary(test={"cycles": 5}, effect=())
    assert recipe.test.cycles == 5
    assert recipe.test.feed_mm_per_min == Recipe().test.feed_mm_per_min
    assert recipe.plan == Recipe().plan
    assert Recipe().vary(record={"hours": 2.0}).record == Record(hours=2.0)


# A recipe is read as it is meant, or refused with file, key, value and remedy.


def write(folder: Path, text: str) -> Path:
    path = folder / "RECIPE.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_empty_recipe_is_the_default(tmp_path):
    assert read_recipe(write(tmp_path, "")) == Recipe() == check_recipe(Recipe())


def test_tables_and_lists_reach_the_recipe(tmp_path):
    text = """
    [test]
    positions_mm = [0, 11.5, 30]
    [[source]]
    name = "lamp"
    x_mm = 10
    y_mm = 20
    spread_x_mm = 30
    spread_y_mm = 30
    power_W = 4
    [[effect]]
    name = "dead_path"
    mm = 120
    [[anomaly]]
    target = 2
    """
    recipe = read_recipe(write(tmp_path, text))
    assert recipe.test.positions_mm == (0.0, 11.5, 30.0)
    assert recipe.source[0].power_W == 4.0
    assert recipe.effect == (EffectRecipe("dead_path", parameters={"mm": 120}),)
    assert recipe.anomaly == (AnomalyRecipe(2),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[test]\ncycels = 4", r"line 2: unknown key test\.cycels; did you mean cycles\? known here: cycles"),
        ("[tset]\n", r"line 1: unknown key tset; did you mean test\?"),
        ("[test]\ncycles = 4.5", r"test\.cycles = 4\.5: this is a whole number"),
        ("[test]\nfeed_mm_per_min = 'fast'", r'test\.feed_mm_per_min = "fast": this is a number'),
        ("[test]\nfeed_mm_per_min = nan", r"test\.feed_mm_per_min = NaN: input should be a finite number"),
        ("[test]\ncycles = 0", r"test\.cycles = 0: input should be greater than 0"),
        ("[test]\ntargets = 1", r"test\.targets = 1: a positioning test needs at least 2"),
        ("[test]\npositions_mm = 3", r"test\.positions_mm = 3: this is a list"),
        ("test = 3", r"line 1: test = 3: this is a table"),
        ("[duty]\nkind = 'wild'", r"duty\.kind = \"wild\": .*'random', 'constant', 'switched' or 'randomised'"),
        ("[duty]\nleast_hold_min = 40", r"line 2: duty\.least_hold_min = 40\.0: write a number from 0 to below"),
        ("[plan]\ndirection = [-1, 1]", r"line 2: plan\.direction = \[-1\.0, 1\.0\]: write a unit vector"),
        ("[plan]\norigin_mm = [1]", r"line 2: plan\.origin_mm needs 2 values"),
        ("[plan]\nfiducials_x_mm = [1]", r"fiducials_x_mm and plan\.fiducials_y_mm differ in length"),
        ("[[source]]\nname = 'a'", r"line 1: \[source\] lacks x_mm"),
        ("[[effect]]\nname = 'slip'", r'line 1: effect\.name = "slip": known: air_index, angular_growth'),
        ("[[effect]]\nname = 'step_evnt'", r"did you mean step_event\?"),
        ("[[effect]]\nname = 'step_event'\nat = 3", r"line 1: effect step_event: unknown key at; .*at_cycle, at_part"),
        ("[[effect]]\nname = 'step_event'\nat_cycle = 'two'", r'at_cycle = "two": this is a whole number'),
        ("[[effect]]\nname = 'thermal_lag'\nshape = 'cubic'", r"shape = \"cubic\": input should be 'flat' or 'linear'"),
        ("[[effect]]\nname = 'dead_path'\namplitude_K = 1", r"amplitude_K is for effects that only the camera sees"),
        ("[[effect]]\nname = 'camera_offset'\namplitude_K = 1\namplitude_um = 1", r"are both given; keep one"),
        ("[[anomaly]]\ntarget = 17", r"line 2: anomaly\.target = 17: the test has targets 1 to 16"),
        ("[[anomaly]]\ntarget = 3\nkind = 'odd'", r"line 3: anomaly\.kind = \"odd\": input should be 'structural'"),
        ("[test", r"RECIPE\.toml: is not TOML .*; correct the line"),
    ],
)
def test_wrong_recipe_is_refused(tmp_path, text, message):
    with pytest.raises(RecipeError, match=message):
        read_recipe(write(tmp_path, text))


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"test": {"period_s": 100.0}}, r"test\.period_s = 100\.0 is shorter than one cycle, 19\d\.\d s; raise it"),
        ({"test": {"positions_mm": (0.0, 5.0, 4.0)}}, r"the target positions do not increase"),
        ({"camera": {"frame_after_s": 90.0}}, r"the last frame .* 28\d\.\d s after its start, past its end at 252"),
        ({"effect": (EffectRecipe("step_event", 1.0, parameters={"at_cycle": 90}),)}, r"step_event: .* to 1\.0 um rms"),
        (
            {"effect": (EffectRecipe("sensor_fault", 1.0, parameters={"kind": "stuck"}),)},
            "sensor_fault: .*kind = 'jump'",
        ),
        ({"effect": 2 * (EffectRecipe("sensor_fault"),)}, "effect sensor_fault is there more than once"),
        ({"effect": (EffectRecipe("reflected_source", 1.0),)}, "reflected_source: amplitude_um .*; write amplitude_K"),
    ],
)
def test_test_that_cannot_be_is_refused(tables, message):
    with pytest.raises(RecipeError, match=message):
        simulate(Recipe().vary(**tables))


def test_library_holds_every_effect_that_the_analysis_names():
    named = """thermal_lag unseen_heat_source dead_path air_index material_compensation angular_growth reversal_drift step_event
    periodic_disturbance pitch_error camera_offset reflected_source laser_warm_up sensor_fault"""
    outside = {"telegraph_switching", "travelling_chirp", "local_creep", "direction_scale"}
    assert set(EFFECTS) == set(named.split()) | outside


def test_the_schema_accepts_every_recipe_of_the_project_and_refuses_what_the_reader_refuses() -> None:
    schema = recipe_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    for path in packaged_recipe("demo").parent.glob("*.toml"):
        validator.validate(tomllib.loads(path.read_text(encoding="utf-8")))
        read_recipe(path)
    for name, effect in EFFECTS.items():
        validator.validate({"effect": [{"name": name, "amplitude_um": 1.0, **effect.parameters}]})
        assert not validator.is_valid({"effect": [{"name": name, "colour": 1}]})
    assert not validator.is_valid({"test": {"cycles": -1}})
    assert not validator.is_valid({"effect": [{"name": "magnetism"}]})
