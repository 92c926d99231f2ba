"""The library of effects: what a measured drift may contain, with the effects that other installed distributions add.

Which candidate of an effect fits, and whether the effect deserves to be named, is decided in :mod:`fusion.analysis.drift_model.search`.
Physics, columns and sources of every effect: docs/method/effects.md. A user's own effect is a
:class:`fusion.analysis.effects.effect.Effect` under the entry-point group ``thermofuse.effects``.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fusion.analysis.effects import events, laser_and_camera, thermal
from fusion.analysis.effects.effect import Effect
from fusion.common import NO_PLUGINS, FusionError
from fusion.results.parts import PluginPart
from thermofuse.resources import vocabulary

#: Entry-point group of effects.
GROUP = "thermofuse.effects"


class PluginError(FusionError):
    """An effect of another distribution that cannot be used; the message names the distribution and how to leave it out."""


def plugins() -> dict[PluginPart, EntryPoint]:
    """Return the effects that other distributions add, none of them loaded yet; none where they are left out."""
    if os.environ.get(NO_PLUGINS):
        return {}
    return {_describe(point): point for point in _points(tuple((place, _changed(place)) for place in sys.path))}


@cache
def _points(places: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    """The entry points of effects at the places where distributions are looked for, which takes some 40 ms."""
    return tuple(entry_points(group=GROUP))


def _changed(place: str) -> int:
    """Return when something was last added to a folder of distributions or removed, ns; 0 where there is none."""
    try:
        return Path(place).stat().st_mtime_ns
    except OSError:
        return 0


def load_plugin(plugin: PluginPart, point: EntryPoint) -> Effect:
    """Load an effect of another distribution."""
    try:
        effect = point.load()
    # Code of others may raise anything.
    except Exception as error:
        raise _unusable(plugin, f"cannot be loaded ({type(error).__name__}: {error})") from error
    if not isinstance(effect, Effect):
        raise _unusable(plugin, f"is a {type(effect).__name__}, not a fusion.Effect")
    return effect


def describe_code(group: str) -> list[dict[str, Any]]:
    """Return the plug-ins of an entry-point group with the files of their code, none of them imported."""
    return [_describe(point).model_dump() | {"code": _code_files(point)} for point in entry_points(group=group)]


def _code_files(point: EntryPoint) -> list[Path]:
    """Return the files of the package or module that brings an effect; none where it is not found."""
    spec = find_spec(point.module.partition(".")[0])
    if spec is None:
        return []
    if spec.submodule_search_locations:
        inside = [path for folder in spec.submodule_search_locations for path in Path(folder).rglob("*")]
        return sorted(path for path in inside if path.is_file() and "__pycache__" not in path.parts)
    return [Path(spec.origin)] if spec.has_location and spec.origin else []


def _unusable(plugin: PluginPart, why: str) -> PluginError:
    return PluginError(
        f"the effect {plugin.name} ({plugin.origin}) of {plugin.distribution} {plugin.version} {why}; "
        "correct or uninstall that distribution, or add --no-plugins"
    )


def _describe(point: EntryPoint) -> PluginPart:
    distribution = point.dist
    known = ("unknown", "unknown") if distribution is None else (distribution.name, distribution.version)
    return PluginPart(name=point.name, origin=point.value, distribution=known[0], version=known[1])


_KNOWN = {
    effect.name: effect
    for module in (thermal, laser_and_camera, events)
    for effect in vars(module).values()
    if isinstance(effect, Effect)
}
LIBRARY = tuple(_KNOWN[name] for name in vocabulary("effects") if name != thermal.QUASI_STATIC)


def library() -> dict[str, Effect]:
    """All effects of a campaign by name: the built-in ones, then those that users registered as ``thermofuse.effects``."""
    effects = {effect.name: effect for effect in LIBRARY}
    for plugin, point in plugins().items():
        effect = load_plugin(plugin, point)
        effects[effect.name] = effect
    return effects


def describe_effect(name: str) -> Effect | None:
    """Find an effect by its name, the declared model of a record included."""
    return {**_KNOWN, **library()}.get(name)
