"""The laser and its compensation: index of air, dead path, material coefficient, wavelength, sensors of the environment unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.effects.effect import (
    Candidate,
    Parameters,
    effect,
    lacks,
    unmeasured_expansion,
    values_near,
    warm_up,
)
from fusion.analysis.effects.events import detect_jumps, detect_sensor_jumps, detect_stuck_sensors
from fusion.analysis.effects.thermal import needs_field
from fusion.common import Array
from interferometry import compensation

# Errors of the camera: the field is wrong and the machine did not move, so that the prediction errs by what the field
# claims.


def _needs_jump(readings: Readings) -> str | None:
    if needs_field(readings) or detect_jumps(readings.series["mean_rise"]):
        return needs_field(readings)
    return lacks("jump")


def _needs_patch(readings: Readings) -> str | None:
    return None if "patch_mean_rise" in readings.series else lacks("patch")


@effect(needs=_needs_jump, repeats=True, errs_camera=True)
def camera_offset(readings: Readings, coefficients: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Error of the model's prediction, in um per kelvin of false uniform rise, from a jump of the field on."""
    offset, expansion = coefficients.get("table_offset", 0.0), coefficients.get("axis_expansion", 0.0)
    weight = -(offset + expansion * readings.position_mm * 1e-3)
    for before, after, size in detect_jumps(readings.series["mean_rise"]):
        late = np.clip((readings.seconds - before) / (after - before), 0.0, 1.0)
        parameters: Parameters = {"time_s": after, "jump_of_the_field_K": size}
        yield Candidate((late * weight)[:, None], parameters, ("K",), event_s=after)


@effect(needs=_needs_patch, errs_camera=True)
def reflected_source(
    readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """Error of the model's prediction from a patch of the field that switches."""
    false_rise = readings.at(readings.series["patch_mean_rise"])
    false_integral = readings.at(readings.series["patch_axis_integral"]) * 1e-3
    wrong = (
        coefficients.get("table_offset", 0.0) * false_rise + coefficients.get("axis_expansion", 0.0) * false_integral
    )
    yield Candidate(-wrong[:, None], {}, ("1",))


_AIR = ("air_temperature", "air_pressure", "relative_humidity")
#: Time constants of a laser's warm-up; what settles more slowly is a part of machine or set-up.
_WARM_UPS_MIN = (3.0, 6.0, 12.0, 24.0)


def _needs_air(readings: Readings) -> str | None:
    missing = [name for name in _AIR if name not in readings.series]
    return lacks("environment", missing=", ".join(missing)) if missing else None


def _needs_material(readings: Readings) -> str | None:
    return None if "material_temperature" in readings.series else lacks("environment", missing="material_temperature")


def _needs_sensor_episode(readings: Readings) -> str | None:
    return None if detect_sensor_jumps(readings) or detect_stuck_sensors(readings) else lacks("episode")


def _refractivity_change_ppm(readings: Readings) -> Array:
    """Change of the index of air since the first reading, ppm (Ciddor 1996), (n,)."""
    index = compensation.air_index(*(readings.at(readings.series[name]) for name in _AIR))
    return np.asarray((index - index[0]) * 1e6, float)


@effect(needs=_needs_air, declarable=True)
def dead_path(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, the same at all positions."""
    yield Candidate((_refractivity_change_ppm(readings) * 1e-3)[:, None], {}, ("mm",))


@effect(needs=_needs_air, declarable=True)
def air_index(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, along the axis."""
    yield Candidate((_refractivity_change_ppm(readings) * 1e-3 * readings.position_mm)[:, None], {}, ("1",))


@effect(needs=_needs_material, masked_by=unmeasured_expansion, declarable=True)
def material_compensation(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The material probe, along the axis."""
    material = readings.at(readings.series["material_temperature"])
    yield Candidate(((material - material[0]) * readings.position_mm * 1e-3)[:, None], {}, ("ppm/K",))


@effect(masked_by=unmeasured_expansion, longest_min=_WARM_UPS_MIN[-1])
def laser_warm_up(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Exponentials along the axis, with or without dead path."""
    for minutes in values_near(near, "time_constant_min", _WARM_UPS_MIN, ratio=2.0):
        settling = 1.0 - warm_up(readings, minutes)
        linear = settling * readings.position_mm * 1e-3
        yield Candidate(linear[:, None], {"time_constant_min": minutes, "shape": "linear"}, ("ppm",))
        # A shift of all positions that dies away may come from any part of machine and set-up.
        both: Parameters = {"time_constant_min": minutes, "shape": "linear with dead path"}
        yield Candidate(np.column_stack([linear, settling]), both, ("ppm", "um"), beside=1)


@effect(needs=_needs_sensor_episode, repeats=True)
def sensor_fault(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps and ramps along the axis where a sensor jumps or sticks."""
    for name, before, after, size in detect_sensor_jumps(readings):
        late = (readings.seconds >= 0.5 * (before + after)).astype(float)
        jumped: Parameters = {"sensor": name, "time_s": after, "jump": size}
        yield Candidate((late * readings.position_mm * 1e-3)[:, None], jumped, ("ppm",), event_s=after)
    for name, start in detect_stuck_sensors(readings):
        since = np.clip(readings.seconds - start, 0.0, None) / 3600.0
        stuck: Parameters = {"sensor": name, "time_s": start, "jump": 0.0}
        yield Candidate((since * readings.position_mm * 1e-3)[:, None], stuck, ("ppm/h",), event_s=start)
