"""The recipe's tables: complete choices, defaults that can be simulated, and copies with some values changed."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import get_args, get_type_hints

import pytest

from fusion.errors import FusionError
from fusion.twin.machine.effects import ANOMALIES
from fusion.twin.machine.recipe import AnomalyRecipe, Recipe, RecipeError, Record
from fusion.twin.recipe_file import check_recipe


def test_anomalies_of_the_recipe_are_those_of_the_machine():
    assert get_args(get_type_hints(AnomalyRecipe)["kind"]) == tuple(ANOMALIES)


def test_defaults_are_a_valid_recipe_and_are_returned_unchanged():
    recipe = Recipe()
    assert check_recipe(recipe) is recipe


def test_vary_changes_the_named_values_only():
    recipe = Recipe().vary(test={"cycles": 5}, effect=())
    assert recipe.test.cycles == 5
    assert recipe.test.feed_mm_per_min == Recipe().test.feed_mm_per_min
    assert recipe.plan == Recipe().plan
    assert Recipe().vary(record={"hours": 2.0}).record == Record(hours=2.0)


def test_recipe_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        Recipe().test.cycles = 3


def test_a_recipe_error_is_one_of_the_packages_errors():
    assert issubclass(RecipeError, FusionError)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"test": {"feed_mm_per_min": 0.0}}, r"test\.feed_mm_per_min = 0\.0; write a number above 0"),
        ({"plan": {"origin_mm": (1.0, 2.0, 3.0)}}, r"plan\.origin_mm has 3 numbers; write two, \[x, y\]"),
        ({"camera": {"file": "png"}}, r"camera\.file = 'png'; write one of jpg, seq"),
        ({"anomaly": (AnomalyRecipe(1), AnomalyRecipe(2, "odd"))}, r"anomaly 2: kind = 'odd'; write one of structural"),
    ],
)
def test_recipe_made_in_python_is_checked_like_a_file(tables, message):
    with pytest.raises(RecipeError, match=message):
        check_recipe(Recipe().vary(**tables))
