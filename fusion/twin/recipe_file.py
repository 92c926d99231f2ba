"""Reads and checks a recipe: RECIPE.toml to `Recipe`, with errors that name file, line, key, value and remedy."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from fusion.common import suggest
from fusion.common.toml_files import Place, TomlError, describe, first_faults, place_in, read_toml
from fusion.twin.effects import EFFECTS, ONCE
from fusion.twin.recipe import EffectRecipe, Recipe, RecipeError
from thermofuse.resources import resource

_RECIPE = TypeAdapter(Recipe)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe from a TOML file."""
    try:
        content, text = read_toml(Path(path))
    except OSError as error:
        raise RecipeError(f"{path}: cannot be read ({error.strerror}); name an existing RECIPE.toml") from error
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: byte {error.start} is not UTF-8; save the recipe as UTF-8 text") from error
    except TomlError as error:
        raise RecipeError(f"{path}: is not TOML ({error}); correct the line that the message names") from error
    place = place_in(path, text)
    try:
        # As JSON, in which strict types take a list for a tuple and a table for a dataclass, but no text for a number.
        recipe = _RECIPE.validate_json(json.dumps(_with_parameters(content), default=str), strict=True)
    except ValidationError as error:
        raise RecipeError(first_faults((describe(one, Recipe, place) for one in error.errors()), path)) from error
    return check_recipe(recipe, place=place)


def check_recipe(recipe: Recipe, *, place: Place = ".".join) -> Recipe:
    """Check a recipe that was made in Python or read from a file; `place` says where a key stands."""
    try:
        _RECIPE.validate_python(recipe)
    except ValidationError as error:
        raise RecipeError(first_faults((describe(one, Recipe, place) for one in error.errors()), "recipe")) from error
    faults = [*_faults(recipe, place), *_faults_of_effects(recipe, place)]
    if faults:
        raise RecipeError("\n".join(faults))
    return recipe


def recipe_schema() -> dict[str, Any]:
    """Return the JSON Schema of RECIPE.toml; every effect of the library is one alternative with its own parameters."""
    schema = _RECIPE.json_schema()
    general = schema["$defs"]["EffectRecipe"]["properties"]
    sizes = {key: value for key, value in general.items() if key not in ("name", "parameters")}
    schema["$defs"]["EffectRecipe"] = {
        "title": "EffectRecipe",
        "description": "One undeclared effect; its own parameters follow its name.",
        "oneOf": [
            {
                "type": "object",
                "title": name,
                "properties": {"name": {"const": name}, **sizes, **effect.table.model_json_schema()["properties"]},
                "required": ["name"],
                "additionalProperties": False,
            }
            for name, effect in sorted(EFFECTS.items())
        ],
    }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "thermofuse recipe"}


def packaged_recipe(name: str) -> Path:
    """Return the path of a recipe that comes with the package."""
    folder = resource("recipes")
    path = folder / f"{name}.toml"
    if not path.is_file():
        raise RecipeError(
            f"no packaged recipe {name!r}; there are: {', '.join(sorted(p.stem for p in folder.glob('*.toml')))}"
        )
    return path


def find_recipe(recipe: str | Path) -> Path:
    """Return the path of a recipe: the file itself, or the one with this name that comes with the package."""
    path = Path(recipe)
    is_name = path.name == str(recipe) and not path.suffix
    return packaged_recipe(path.name) if is_name and not path.is_file() else path


def _with_parameters(content: dict[str, Any]) -> dict[str, Any]:
    """Return the TOML content with every effect's own keys gathered under `parameters`."""
    effects = content.get("effect")
    if not isinstance(effects, list):
        return content
    general = {entry.name for entry in fields(EffectRecipe)} - {"parameters"}
    gathered = [
        {key: value for key, value in effect.items() if key in general}
        | {"parameters": {key: value for key, value in effect.items() if key not in general}}
        if isinstance(effect, dict)
        else effect
        for effect in effects
    ]
    return content | {"effect": gathered}


def _faults(recipe: Recipe, place: Place) -> Iterator[str]:
    """Yield what contradicts itself in load, targets, anomalies, measured line and fiducials."""
    duty, plan = recipe.duty, recipe.plan
    if not 0.0 <= duty.least_hold_min < duty.mean_hold_min:
        where = place(("duty", "least_hold_min"))
        yield f"{where}: duty.least_hold_min = {duty.least_hold_min}: write a number from 0 to below duty.mean_hold_min"
    targets = len(recipe.test.positions_mm) or recipe.test.targets
    if targets < 2:
        yield f"{place(('test', 'targets'))}: test.targets = {targets}: a positioning test needs at least 2"
    for number, anomaly in enumerate(recipe.anomaly):
        if not 1 <= anomaly.target <= targets:
            where = place(("anomaly", str(number), "target"))
            yield f"{where}: anomaly.target = {anomaly.target}: the test has targets 1 to {targets}"
    if not math.isclose(math.hypot(*plan.direction), 1.0, rel_tol=1e-6):
        where = place(("plan", "direction"))
        yield f"{where}: plan.direction = {list(plan.direction)}: write a unit vector such as [-1, 0]"
    if len(plan.fiducials_x_mm) != len(plan.fiducials_y_mm):
        where = place(("plan", "fiducials_x_mm"))
        yield f"{where}: plan.fiducials_x_mm and plan.fiducials_y_mm differ in length; write one x and one y per disc"


def _faults_of_effects(recipe: Recipe, place: Place) -> Iterator[str]:
    """Yield the effects whose name, size or parameters the library does not know, and those that may occur once only."""
    for number, effect in enumerate(recipe.effect):
        where = place(("effect", str(number)))
        known = EFFECTS.get(effect.name)
        if known is None:
            names = ", ".join(sorted(EFFECTS))
            yield f'{where}: effect.name = "{effect.name}": {suggest(effect.name, EFFECTS)}known: {names}'
            continue
        where = f"{where}: effect {effect.name}"
        if effect.amplitude_um is not None and effect.amplitude_K is not None:
            yield f"{where}: amplitude_um and amplitude_K are both given; keep one"
        if effect.amplitude_K is not None and known.unit != "K":
            yield f"{where}: amplitude_K is for effects that only the camera sees; write amplitude_um"
        try:
            known.table.model_validate(effect.parameters)
        except ValidationError as error:
            for one in error.errors():
                yield describe(one, known.table, lambda key, where=where: where)  # type: ignore[misc]
    for name in ONCE:
        if sum(effect.name == name for effect in recipe.effect) > 1:
            yield f"{place(('effect',))}: effect {name} is there more than once; the twin has one of it, remove the others"
