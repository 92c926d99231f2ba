"""The library of effects: what a measured drift may contain.

Which candidate of an effect fits, and whether the effect deserves to be named, is decided in :mod:`fusion.analysis.drift_model.search`.
Physics, columns and sources of every effect: docs/method/effects.md. A user's own effect is a
:class:`fusion.analysis.effects.effect.Effect` under the entry-point group ``thermofuse.effects``.
"""

from __future__ import annotations

from fusion.analysis.effects import events, laser_and_camera, thermal
from fusion.analysis.effects.effect import Effect
from fusion.analysis.effects.plugins import load_plugin, plugins
from thermofuse.resources import vocabulary

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
