"""All lies by the group that they belong to, the undisturbed campaign first."""

from __future__ import annotations

from tests.soak.lies import clocks, frames, logs, place, readings, settings, units
from tests.soak.lies.lie import Lie

UNDISTURBED = Lie("undisturbed", family="$^")
GROUPS: dict[str, tuple[Lie, ...]] = {
    "none": (UNDISTURBED,),
    "clocks": clocks.LIES,
    "frames": frames.LIES,
    "place": place.LIES,
    "readings": readings.LIES,
    "logs": logs.LIES,
    "units": units.LIES,
    "settings": settings.LIES,
    "sound": (*frames.SOUND, *place.SOUND, *readings.SOUND),
}
LIES = {lie.name: lie for lies in GROUPS.values() for lie in lies}
