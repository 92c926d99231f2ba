"""The library of effects: what a measured drift may contain, each with its physics, its columns and its parameters.

An effect offers *candidates*: columns per reading for given nonlinear parameters (a time constant, an instant, a period). Which candidate
fits, and whether the effect deserves to be named at all, is decided in :mod:`fusion.loop.closed_loop`. Signatures: effects.md of the facts
(shape along the axis, sign with the direction of approach, course in time); physics by the sources named with each effect.

A user's own effect is an :class:`Effect` under the entry-point group ``thermofuse.effects``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points

import numpy as np

from fusion.alignment.readings import Readings
from fusion.effects import candidates as of
from fusion.effects.candidates import Candidate, Prior
from fusion.effects.jumps import jumps, sensor_jumps, stuck_sensors


@dataclass(frozen=True)
class Effect:
    """A named effect.

    Attributes
    ----------
    name : as in results.json
    physics : one paragraph for the report
    source : where the signature comes from
    candidates : from the readings, the coefficients of the current model and, for a closer look, a candidate near which to search, to the
        candidates that can be tried
    needs : why it cannot be tried with these readings, or None
    prior : what is known of the first coefficient where the effect is declared
    excited_by : ``"field"`` or ``"driver"`` where the effect is only told apart by switching of that kind, else ``""``
    """

    name: str
    physics: str
    source: str
    candidates: Callable[[Readings, Mapping[str, float], Candidate | None], Iterator[Candidate]]
    needs: Callable[[Readings], str | None] = field(default=lambda readings: None)
    excited_by: str = ""
    prior: Prior | None = None


def _needs_field(readings: Readings) -> str | None:
    return None if "mean_rise" in readings.series else "the campaign holds no thermal frames"


def _needs_driver(readings: Readings) -> str | None:
    return (
        None
        if readings.drivers
        else "nothing that drives a heat source was logged; log duty, speed or load as [drivers]"
    )


def _needs_air(readings: Readings) -> str | None:
    missing = [name for name in ("air_temperature", "air_pressure", "relative_humidity") if name not in readings.series]
    return f"the environment log has no {', '.join(missing)}" if missing else None


def _needs_material(readings: Readings) -> str | None:
    return None if "material_temperature" in readings.series else "the environment log has no material_temperature"


def _needs_both_directions(readings: Readings) -> str | None:
    return None if np.unique(readings.sign).size == 2 else "only one direction of approach was measured"


def _needs_jump(readings: Readings) -> str | None:
    if "mean_rise" not in readings.series:
        return "the campaign holds no thermal frames"
    return None if jumps(readings.series["mean_rise"]) else "no frame jumps against its neighbours"


def _needs_patch(readings: Readings) -> str | None:
    if "patch_mean_rise" not in readings.series:
        return "no patch of the field switches faster than heat can flow"
    return None


def _needs_sensor_episode(readings: Readings) -> str | None:
    if sensor_jumps(readings) or stuck_sensors(readings):
        return None
    return "no logged sensor jumps or sticks"


#: Standard uncertainty of an expansion coefficient from a table: steels and cast irons lie between 9 and 14 ppm/K.
EXPANSION_U_PPM_PER_K = 2.0

LIBRARY: tuple[Effect, ...] = (
    Effect(
        "axis_expansion",
        "The table lengthens along the measured line as it warms: one coefficient times the integral of the seen rise.",
        "ISO/TR 16015; steel 11.7 ppm/K",
        of.declared_candidates("axis_expansion"),
        _needs_field,
        prior=Prior(11.7, EXPANSION_U_PPM_PER_K),
    ),
    Effect(
        "table_offset",
        "Everything between table and laser moves together with the table's mean temperature: the same shift at all positions.",
        "ISO 230-3, thermal distortion",
        of.declared_candidates("table_offset"),
        _needs_field,
    ),
    Effect(
        "thermal_lag",
        "A remote or massive part follows the seen table late, with a time constant of its own, and goes on moving after it.",
        "first-order response of a lumped heat capacity",
        of.thermal_lag_candidates,
        _needs_field,
        excited_by="field",
    ),
    Effect(
        "unseen_heat_source",
        "A source out of the camera's sight (spindle, motor, bearing) warms with the logged load and moves the reading with its "
        "own time constant.",
        "Mayr et al. 2012, CIRP Annals 61, 771",
        of.unseen_heat_source_candidates,
        _needs_driver,
        excited_by="driver",
    ),
    Effect(
        "dead_path",
        "Air between the interferometer and its zero is not compensated: the reading shifts with the index of air.",
        "Ciddor 1996; ISO 230-1",
        of.dead_path_candidates,
        _needs_air,
    ),
    Effect(
        "air_index",
        "The index of air is not, or wrongly, compensated along the measured length.",
        "Ciddor 1996: -0.955 ppm/K, +0.268 ppm/hPa",
        of.air_index_candidates,
        _needs_air,
    ),
    Effect(
        "material_compensation",
        "The expansion coefficient or the place of the material probe is wrong: a stretch that follows the probe.",
        "ISO 230-2, 7.1; ISO/TR 16015",
        of.material_compensation_candidates,
        _needs_material,
    ),
    Effect(
        "angular_growth",
        "Guide or table bends as it warms; the Abbe offset turns the growing angle into an error that is quadratic along the axis.",
        "Abbe principle, Bryan 1979: 1 arcsec x 100 mm = 0.48 um",
        of.angular_growth_candidates,
    ),
    Effect(
        "reversal_drift",
        "Backlash or wind-up changes with temperature: both directions move apart by the same amount at every position.",
        "ISO 230-2, reversal value B",
        of.reversal_drift_candidates,
        _needs_both_directions,
    ),
    Effect(
        "step_event",
        "A mount, clamp or optic slips once: all readings after that instant are shifted.",
        "level shift at one instant",
        of.step_event_candidates,
    ),
    Effect(
        "periodic_disturbance",
        "Cooling, coolant or air conditioning switches in a fixed rhythm.",
        "line in the spectrum of the readings' own times",
        of.periodic_disturbance_candidates,
    ),
    Effect(
        "pitch_error",
        "The cyclic error of the screw changes as it warms: a wave along the axis whose size follows a thermal state.",
        "periodic error of the lead; aliased where the spacing is a multiple of the lead",
        of.pitch_error_candidates,
    ),
    Effect(
        "camera_offset",
        "The camera's zero steps between two frames (flat-field correction): the field is wrong from then on, the machine did not move.",
        "uniform jump of the field without a jump of the readings",
        of.camera_offset_candidates,
        _needs_jump,
    ),
    Effect(
        "reflected_source",
        "A warm body mirrors in the table: a patch of the field changes faster than heat can flow, and the readings do not follow.",
        "reflection of (1 - emissivity) of the surroundings",
        of.reflected_source_candidates,
        _needs_patch,
    ),
    Effect(
        "laser_warm_up",
        "The laser's wavelength settles during the first minutes: a stretch, and a shift by the dead path, that die away.",
        "frequency stabilisation of a He-Ne laser",
        of.laser_warm_up_candidates,
    ),
    Effect(
        "sensor_fault",
        "A sensor of the environment unit jumps or sticks, and the instrument's own compensation believes it.",
        "jump or frozen value in the environment log",
        of.sensor_fault_candidates,
        _needs_sensor_episode,
    ),
)


def library() -> dict[str, Effect]:
    """All effects by name: the built-in ones, then those that users registered as ``thermofuse.effects``."""
    found = {effect.name: effect for effect in LIBRARY}
    for point in entry_points(group="thermofuse.effects"):
        effect = point.load()
        found[effect.name] = effect
    return found
