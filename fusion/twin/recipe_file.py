"""RECIPE.toml to `Recipe`, refused with file, key, value and remedy where it says what no twin can do."""

from __future__ import annotations

import difflib
import math
import tomllib
import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from fusion.twin.machine.effects import ANOMALIES, EFFECTS
from fusion.twin.machine.recipe import EffectRecipe, Recipe, RecipeError, Record

#: Directions and angles that a record can hold.
CHANNELS = 6
CHOICES = {
    "duty.kind": ("random", "constant", "switched", "randomised"),
    "drift.walk": ("none", "random_walk", "integrated", "ou"),
    "laser.tails": ("normal", "t4"),
    "laser.file": ("csv", "rtl"),
    "camera.table": ("still", "moving"),
    "camera.file": ("jpg", "seq"),
    "anomaly.kind": tuple(ANOMALIES),
    "anomaly.direction": ("both", "positive", "negative"),
    "source.follows": ("duty", "constant", "own"),
}
POSITIVE = (
    ("test", ("cycles", "feed_mm_per_min", "period_s")),
    ("plan", ("width_mm", "height_mm", "fiducial_diameter_mm")),
    (
        "table",
        (
            "thickness_mm",
            "conductivity_W_per_mK",
            "density_kg_per_m3",
            "heat_capacity_J_per_kgK",
            "convection_W_per_m2K",
        ),
    ),
    ("duty", ("mean_hold_min",)),
    ("profile", ("lead_mm",)),
    (
        "camera",
        (
            "focal_px",
            "distance_mm",
            "columns",
            "rows",
            "frame_interval_s",
            "frames_per_cycle",
            "burst_interval_s",
            "ffc_interval_min",
        ),
    ),
)


def read_recipe(path: Path) -> Recipe:
    """Read RECIPE.toml.

    Parameters
    ----------
    path : Path
        A TOML file with the tables of `Recipe`; what it leaves out keeps its default.

    Returns
    -------
    Recipe

    Raises
    ------
    RecipeError
        The file is missing, is not TOML, or holds an unknown key or a value of the wrong kind.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise RecipeError(f"{path}: cannot be read ({error.strerror}); name an existing RECIPE.toml") from error
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{path}: is not TOML ({error}); mend the line that the message names") from error
    try:
        return check_recipe(_build(Recipe, content, ""))
    except RecipeError as error:
        raise RecipeError(f"{path}: {error}") from error


def check_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe unchanged, or raise `RecipeError` naming the key whose value no machine can have."""
    for key, allowed in CHOICES.items():
        table, name = key.split(".")
        values = getattr(recipe, table)
        for entry in values if isinstance(values, tuple) else (values,):
            if getattr(entry, name) not in allowed:
                raise RecipeError(f"{key} = {getattr(entry, name)!r}; write one of {', '.join(allowed)}")
    for table, names in POSITIVE:
        for name in names:
            if not getattr(getattr(recipe, table), name) > 0:
                raise RecipeError(f"{table}.{name} = {getattr(getattr(recipe, table), name)}; write a number above 0")
    if not 0.0 <= recipe.duty.least_hold_min < recipe.duty.mean_hold_min:
        raise RecipeError(
            f"duty.least_hold_min = {recipe.duty.least_hold_min}; write a number from 0 to below duty.mean_hold_min"
        )
    for key in ("plan.origin_mm", "plan.direction", "camera.centre_mm", "camera.knock_px"):
        table, name = key.split(".")
        if len(getattr(getattr(recipe, table), name)) != 2:
            raise RecipeError(f"{key} has {len(getattr(getattr(recipe, table), name))} numbers; write two, [x, y]")
    if not math.isclose(math.hypot(*recipe.plan.direction), 1.0, rel_tol=1e-6):
        raise RecipeError(f"plan.direction = {list(recipe.plan.direction)}; write a unit vector such as [-1, 0]")
    if len(recipe.plan.fiducials_x_mm) != len(recipe.plan.fiducials_y_mm):
        raise RecipeError(
            "plan.fiducials_x_mm and plan.fiducials_y_mm differ in length; write one x and one y per disc"
        )
    targets = len(recipe.test.positions_mm) or recipe.test.targets
    if targets < 2:
        raise RecipeError(f"test.targets = {targets}; a positioning test needs at least 2")
    _check_record(recipe.record)
    for number, anomaly in enumerate(recipe.anomaly, 1):
        if not 1 <= anomaly.target <= targets:
            raise RecipeError(f"anomaly {number}: target = {anomaly.target}; the test has targets 1 to {targets}")
    for number, effect in enumerate(recipe.effect, 1):
        _check_effect(effect, number)
    for name in ("reflected_source", "sensor_fault"):
        if sum(effect.name == name for effect in recipe.effect) > 1:
            raise RecipeError(f"effect {name} is there more than once; the twin has one of it, remove the others")
    return recipe


def _check_record(record: Record | None) -> None:
    """Refuse a record that no machine can leave."""
    if record is None:
        return
    for name in ("hours", "step_s", "sensors", "channels", "mean_hold_min", "top_speed_rpm"):
        if not getattr(record, name) > 0:
            raise RecipeError(f"record.{name} = {getattr(record, name)}; write a number above 0")
    if record.channels > CHANNELS:
        raise RecipeError(f"record.channels = {record.channels}; there are at most {CHANNELS}")


def _check_effect(effect: EffectRecipe, number: int) -> None:
    """Refuse an effect whose name, size or parameters the library does not know."""
    place = f"effect {number}"
    if effect.name not in EFFECTS:
        raise RecipeError(
            f"{place}: name = {effect.name!r}{_suggest(effect.name, EFFECTS)}; known: {', '.join(sorted(EFFECTS))}"
        )
    known = EFFECTS[effect.name].parameters
    for key, value in effect.parameters.items():
        if key not in known:
            raise RecipeError(
                f"{place} ({effect.name}): unknown key {key!r}{_suggest(key, known)}; known: {', '.join(known)}"
            )
        wanted = type(known[key])
        if not isinstance(value, wanted) and not (wanted is float and isinstance(value, int)):
            raise RecipeError(
                f"{place} ({effect.name}): {key} = {value!r}; write a {wanted.__name__} such as {known[key]!r}"
            )
        choices = EFFECTS[effect.name].choices.get(key)
        if choices is not None and value not in choices:
            raise RecipeError(f"{place} ({effect.name}): {key} = {value!r}; write one of {', '.join(choices)}")
    if effect.amplitude_um is not None and effect.amplitude_K is not None:
        raise RecipeError(f"{place} ({effect.name}): amplitude_um and amplitude_K are both given; keep one")
    if effect.amplitude_K is not None and EFFECTS[effect.name].unit != "K":
        raise RecipeError(
            f"{place} ({effect.name}): amplitude_K is for effects that only the camera sees; write amplitude_um"
        )


def _build(cls: type, table: dict[str, Any], place: str) -> Any:
    """Build a dataclass of the recipe from a TOML table, refusing what it does not know."""
    if cls is EffectRecipe:
        own = {f.name for f in fields(EffectRecipe)} - {"parameters"}
        table = {k: v for k, v in table.items() if k in own} | {
            "parameters": {k: v for k, v in table.items() if k not in own}
        }
    known = {f.name: f for f in fields(cls)}
    kinds = typing.get_type_hints(cls)
    for key in table:
        if key not in known:
            raise RecipeError(f"unknown key {place + key!r}{_suggest(key, known)}; known here: {', '.join(known)}")
    for name, entry in known.items():
        if name not in table and entry.default is MISSING and entry.default_factory is MISSING:
            raise RecipeError(f"{place}{name} is missing; every entry of this table needs it")
    return cls(**{key: _convert(value, kinds[key], place + key) for key, value in table.items()})


def _convert(value: Any, kind: Any, place: str) -> Any:
    """Return a TOML value as the kind that the recipe's annotation asks for."""
    if isinstance(kind, types.UnionType):
        kind = next(one for one in typing.get_args(kind) if one is not types.NoneType)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise RecipeError(f"{place} = {value!r}; write a list")
        item = typing.get_args(kind)[0]
        return tuple(
            _convert(entry, item, f"{place}[{i}]" + ("." if is_dataclass(item) else ""))
            for i, entry in enumerate(value)
        )
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise RecipeError(f"{place.rstrip('.')} = {value!r}; write a table, [{place.rstrip('.')}]")
        return _build(typing.cast(type, kind), value, place if place.endswith(".") else place + ".")
    if typing.get_origin(kind) is dict:
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and number and math.isfinite(value):
        return float(value)
    if type(value) is kind and kind is not float:
        return value
    raise RecipeError(f"{place} = {value!r}; write a {'finite number' if kind is float else kind.__name__}")


def _suggest(key: str, known: typing.Iterable[str]) -> str:
    """Return ``", did you mean ...?"`` where a known key is close to what was written."""
    close = difflib.get_close_matches(key, list(known), 1)
    return f", did you mean {close[0]!r}?" if close else ""


def packaged_recipe(name: str) -> Path:
    """Return the path of a recipe that comes with the package, such as "paper".

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
