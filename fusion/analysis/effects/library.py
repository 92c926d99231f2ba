"""The library of effects: what a measured drift may contain.

Which candidate of an effect fits, and whether the effect deserves to be named, is decided in :mod:`fusion.analysis.drift_model.search`.
Physics, columns and sources of every effect: docs/method/effects.md. A user's own effect is a
:class:`fusion.analysis.effects.effect.Effect` under the entry-point group ``thermofuse.effects``.
"""

from __future__ import annotations

from fusion.analysis.effects.effect import Effect
from fusion.analysis.effects.events import PERIODIC_DISTURBANCE, STEP_EVENT
from fusion.analysis.effects.laser_and_camera import (
    AIR_INDEX,
    CAMERA_OFFSET,
    DEAD_PATH,
    LASER_WARM_UP,
    MATERIAL_COMPENSATION,
    REFLECTED_SOURCE,
    SENSOR_FAULT,
)
from fusion.analysis.effects.plugins import load_plugin, plugins
from fusion.analysis.effects.thermal import (
    ANGULAR_GROWTH,
    AXIS_EXPANSION,
    LOGGED_INFLUENCE,
    PITCH_ERROR,
    QUASI_STATIC_RESPONSE,
    REVERSAL_DRIFT,
    TABLE_OFFSET,
    THERMAL_LAG,
    UNSEEN_HEAT_SOURCE,
)

LIBRARY: tuple[Effect, ...] = (
    AXIS_EXPANSION,
    TABLE_OFFSET,
    THERMAL_LAG,
    UNSEEN_HEAT_SOURCE,
    LOGGED_INFLUENCE,
    DEAD_PATH,
    AIR_INDEX,
    MATERIAL_COMPENSATION,
    ANGULAR_GROWTH,
    REVERSAL_DRIFT,
    STEP_EVENT,
    PERIODIC_DISTURBANCE,
    PITCH_ERROR,
    CAMERA_OFFSET,
    REFLECTED_SOURCE,
    LASER_WARM_UP,
    SENSOR_FAULT,
)


def library() -> dict[str, Effect]:
    """All effects of a campaign by name: the built-in ones, then those that users registered as ``thermofuse.effects``."""
    effects = {effect.name: effect for effect in LIBRARY}
    for plugin, point in plugins().items():
        effect = load_plugin(plugin, point)
        effects[effect.name] = effect
    return effects


def describe_effect(name: str) -> Effect | None:
    """Find an effect by its name, the declared model of a record included."""
    return {QUASI_STATIC_RESPONSE.name: QUASI_STATIC_RESPONSE, **library()}.get(name)
