"""Reads and checks a recipe: RECIPE.toml to `Recipe`, with errors that name file, key, value and remedy."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from fusion.toml_file import TomlError, read_toml
from fusion.twin.machine.effects import EFFECTS
from fusion.twin.machine.recipe import EffectRecipe, Recipe, RecipeError

_RECIPE = TypeAdapter(Recipe)
#: Faults of one file that are told one by one; the others are counted.
_MOST_FAULTS = 30
#: What to write instead, where pydantic's own words name a Python type.
_REMEDIES = {
    "bool_type": "write true or false",
    "dict_type": "write a table",
    "finite_number": "write a finite number",
    "float_type": "write a finite number",
    "int_type": "write a whole number",
    "string_type": "write text in quotes",
    "tuple_type": "write a list",
}
_KINDS = {float: "a number", int: "a whole number", str: "text"}
#: Effects that act on one instrument only and cannot be superposed.
_ONCE = ("reflected_source", "sensor_fault")


def read_recipe(path: Path) -> Recipe:
    """Read a recipe from a TOML file.

    Parameters
    ----------
    path : Path
        RECIPE.toml, with the tables of `Recipe`; what it leaves out keeps its default.

    Returns
    -------
    Recipe

    Raises
    ------
    RecipeError
        The file is missing, is not TOML, or holds an unknown key or a value that no machine can have.
    """
    try:
        content, _ = read_toml(Path(path))
    except OSError as error:
        raise RecipeError(f"{path}: cannot be read ({error.strerror}); name an existing RECIPE.toml") from error
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: byte {error.start} is not UTF-8; save the recipe as UTF-8 text") from error
    except TomlError as error:
        raise RecipeError(f"{path}: is not TOML ({error}); correct the line that the message names") from error
    try:
        # As JSON, in which strict types take a list for a tuple and a table for a dataclass, but no text for a number.
        recipe = _RECIPE.validate_json(json.dumps(_with_parameters(content), default=str), strict=True)
    except ValidationError as error:
        raise RecipeError(f"{path}: {_sentences(error)}") from error
    try:
        return check_recipe(recipe)
    except RecipeError as error:
        raise RecipeError(f"{path}: {error}") from error


def check_recipe(recipe: Recipe) -> Recipe:
    """Check a recipe that was made in Python or read from a file.

    Parameters
    ----------
    recipe : Recipe

    Returns
    -------
    Recipe
        The same recipe, unchanged.

    Raises
    ------
    RecipeError
        A value lies outside the limits that the recipe's annotations state, or values contradict each other; the message names all.
    """
    try:
        _RECIPE.validate_python(recipe)
    except ValidationError as error:
        raise RecipeError(_sentences(error)) from error
    faults = [*_faults_of_test(recipe), *_faults_of_plan(recipe), *_faults_of_effects(recipe)]
    if faults:
        raise RecipeError("; also ".join(faults))
    return recipe


def recipe_schema() -> dict[str, Any]:
    """Return the JSON Schema of RECIPE.toml; every effect of the library is one alternative with its own parameters.

    Returns
    -------
    dict
        Draft 2020-12; descriptions are those of the classes, with every key and its unit.
    """
    schema = _RECIPE.json_schema()
    general = schema["$defs"]["EffectRecipe"]
    beside = {key: value for key, value in general["properties"].items() if key not in ("name", "parameters")}
    schema["$defs"]["EffectRecipe"] = {
        "title": "EffectRecipe",
        "description": "One undeclared effect; its own parameters stand beside its name.",
        "oneOf": [
            {
                "type": "object",
                "title": name,
                "properties": {"name": {"const": name}, **beside, **_schema_of_parameters(name)},
                "required": ["name"],
                "additionalProperties": False,
            }
            for name in sorted(EFFECTS)
        ],
    }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "thermofuse recipe"}


def _schema_of_parameters(name: str) -> dict[str, dict[str, Any]]:
    """Return the schema of every parameter of an effect: type, default and choices."""
    types = {float: "number", int: "integer", str: "string"}
    entry = EFFECTS[name]
    return {
        key: {"type": types[type(default)], "default": default}
        | ({"enum": list(entry.choices[key])} if key in entry.choices else {})
        for key, default in entry.parameters.items()
    }


def packaged_recipe(name: str) -> Path:
    """Return the path of a recipe that comes with the package.

    Parameters
    ----------
    name : str
        Name without suffix, such as "paper".

    Returns
    -------
    Path

    Raises
    ------
    RecipeError
        There is none of that name.
    """
    folder = Path(__file__).parent / "recipes"
    path = folder / f"{name}.toml"
    if not path.is_file():
        raise RecipeError(
            f"no packaged recipe {name!r}; there are: {', '.join(sorted(p.stem for p in folder.glob('*.toml')))}"
        )
    return path


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


def _faults_of_test(recipe: Recipe) -> Iterator[str]:
    """Yield what contradicts itself in load, targets and anomalies."""
    duty = recipe.duty
    if not 0.0 <= duty.least_hold_min < duty.mean_hold_min:
        yield f"duty.least_hold_min = {duty.least_hold_min}; write a number from 0 to below duty.mean_hold_min"
    targets = len(recipe.test.positions_mm) or recipe.test.targets
    if targets < 2:
        yield f"test.targets = {targets}; a positioning test needs at least 2"
    for number, anomaly in enumerate(recipe.anomaly, 1):
        if not 1 <= anomaly.target <= targets:
            yield f"anomaly {number}: target = {anomaly.target}; the test has targets 1 to {targets}"


def _faults_of_plan(recipe: Recipe) -> Iterator[str]:
    """Yield what contradicts itself in the measured line and the fiducials."""
    plan = recipe.plan
    if not math.isclose(math.hypot(*plan.direction), 1.0, rel_tol=1e-6):
        yield f"plan.direction = {list(plan.direction)}; write a unit vector such as [-1, 0]"
    if len(plan.fiducials_x_mm) != len(plan.fiducials_y_mm):
        yield "plan.fiducials_x_mm and plan.fiducials_y_mm differ in length; write one x and one y per disc"


def _faults_of_effects(recipe: Recipe) -> Iterator[str]:
    """Yield the effects whose name, size or parameters the library does not know, and those that may occur once only."""
    for number, effect in enumerate(recipe.effect, 1):
        if effect.name in EFFECTS:
            place = f"effect {number} ({effect.name})"
            yield from (f"{place}: {fault}" for fault in (*_faults_of_size(effect), *_faults_of_parameters(effect)))
        else:
            suggestion = _suggest(effect.name, EFFECTS)
            yield f"effect {number}: name = {effect.name!r}{suggestion}; known: {', '.join(sorted(EFFECTS))}"
    for name in _ONCE:
        if sum(effect.name == name for effect in recipe.effect) > 1:
            yield f"effect {name} is there more than once; the twin has one of it, remove the others"


def _faults_of_size(effect: EffectRecipe) -> Iterator[str]:
    """Yield what is wrong with the amplitude of one effect of the library."""
    if effect.amplitude_um is not None and effect.amplitude_K is not None:
        yield "amplitude_um and amplitude_K are both given; keep one"
    if effect.amplitude_K is not None and EFFECTS[effect.name].unit != "K":
        yield "amplitude_K is for effects that only the camera sees; write amplitude_um"


def _faults_of_parameters(effect: EffectRecipe) -> Iterator[str]:
    """Yield the parameters of one effect that the library does not know, or whose value is of another kind."""
    entry = EFFECTS[effect.name]
    for key, value in effect.parameters.items():
        if key not in entry.parameters:
            yield f"unknown key {key!r}{_suggest(key, entry.parameters)}; known: {', '.join(entry.parameters)}"
            continue
        default, choices = entry.parameters[key], entry.choices.get(key)
        kind = type(default)
        if not isinstance(value, kind) and not (kind is float and isinstance(value, int)):
            yield f"{key} = {value!r}; write {_KINDS[kind]} such as {default!r}"
        elif choices is not None and value not in choices:
            yield f"{key} = {value!r}; write one of {', '.join(choices)}"


def _sentences(error: ValidationError) -> str:
    """Return what pydantic found, each with key, value and remedy."""
    faults = error.errors()
    more = [f"{len(faults) - _MOST_FAULTS} more faults"] if len(faults) > _MOST_FAULTS else []
    return "; also ".join([*map(_sentence, faults[:_MOST_FAULTS]), *more])


def _sentence(fault: ErrorDetails) -> str:
    """Return one fault with key, value and remedy."""
    place = _place(fault["loc"])
    if fault["type"] == "unexpected_keyword_argument":
        table = _keys_beside(fault["loc"])
        return f"unknown key {place!r}{_suggest(str(fault['loc'][-1]), table)}; known here: {', '.join(table)}"
    if fault["type"] == "missing":
        if isinstance(fault["loc"][-1], int):
            return f"{_place(fault['loc'][:-1])} has {len(fault['input'])} numbers; write two, [x, y]"
        return f"{place} is missing; every entry of this table needs it"
    if fault["type"] == "too_long":
        return f"{place} has {len(fault['input'])} numbers; write two, [x, y]"
    if fault["type"] == "literal_error":
        remedy = f"write one of {fault['ctx']['expected'].replace(' or ', ', ')}".replace("'", "")
    elif fault["type"] == "dataclass_type":
        remedy = f"write a table, [{place}]"
    elif fault["type"] == "greater_than":
        remedy = f"write a number above {fault['ctx']['gt']:g}"
    elif fault["type"] == "less_than_equal":
        remedy = f"write a number up to {fault['ctx']['le']:g}"
    else:
        remedy = _REMEDIES.get(fault["type"], fault["msg"])
    return f"{place} = {fault['input']!r}; {remedy}"


def _place(location: tuple[int | str, ...]) -> str:
    """Return a key as it is written in the file: table.key, table 1: key, or table.key[0]."""
    place = ""
    for depth, part in enumerate(location):
        if isinstance(part, str):
            place += part if not place or place.endswith(" ") else f".{part}"
        else:
            place += f"[{part}]" if depth == len(location) - 1 else f" {part + 1}: "
    return place


def _keys_beside(location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the table around a key knows."""
    table: Any = Recipe
    if len(location) > 1:
        annotation = get_type_hints(Recipe)[str(location[0])]
        table = next(kind for kind in (annotation, *get_args(annotation)) if is_dataclass(kind))
    return [entry.name for entry in fields(table)]


def _suggest(key: str, known: Iterable[str]) -> str:
    """Return ``", did you mean ...?"`` where a known key resembles what was written."""
    close = difflib.get_close_matches(key, list(known), 1)
    return f", did you mean {close[0]!r}?" if close else ""
