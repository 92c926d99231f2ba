"""The laser and its compensation: index of air, dead path, material coefficient, wavelength, sensors of the environment unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.effects.effect import Candidate, Effect, Parameters, unmeasured_expansion, values_near, warm_up
from fusion.analysis.effects.events import detect_jumps, detect_sensor_jumps, detect_stuck_sensors
from fusion.analysis.effects.thermal import needs_field
from fusion.common import Array
from interferometry.compensation import air_index

# Errors of the camera: the field is wrong and the machine did not move, so that the prediction errs by what the field
# claims.


def _needs_jump(readings: Readings) -> str | None:
    if needs_field(readings) or detect_jumps(readings.series["mean_rise"]):
        return needs_field(readings)
    return "no frame jumps against its neighbours"


def _needs_patch(readings: Readings) -> str | None:
    if "patch_mean_rise" not in readings.series:
        return "no patch of the field switches faster than heat can flow"
    return None


def _camera_offset(
    readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """Error of the model's prediction, in um per kelvin of false uniform rise, from a jump of the field on."""
    offset, expansion = coefficients.get("table_offset", 0.0), coefficients.get("axis_expansion", 0.0)
    weight = -(offset + expansion * readings.position_mm * 1e-3)
    for before, after, size in detect_jumps(readings.series["mean_rise"]):
        late = np.clip((readings.seconds - before) / (after - before), 0.0, 1.0)
        parameters: Parameters = {"time_s": after, "jump_of_the_field_K": size}
        yield Candidate((late * weight)[:, None], parameters, ("K",), event_s=after)


def _reflected_source(
    readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """Error of the model's prediction from a patch of the field that switches."""
    false_rise = readings.at(readings.series["patch_mean_rise"])
    false_integral = readings.at(readings.series["patch_axis_integral"]) * 1e-3
    wrong = (
        coefficients.get("table_offset", 0.0) * false_rise + coefficients.get("axis_expansion", 0.0) * false_integral
    )
    yield Candidate(-wrong[:, None], {}, ("1",))


CAMERA_OFFSET = Effect(
    name="camera_offset",
    physics=(
        "The camera's zero steps between two frames (flat-field correction): the field is wrong from then on, the machine did not "
        "move."
    ),
    source="uniform jump of the field without a jump of the readings",
    candidates=_camera_offset,
    needs=_needs_jump,
    repeats=True,
    errs_camera=True,
    label="jump of the camera's zero",
    phrase="a step of the camera's zero",
    remedy="Let the camera warm up and watch its flat-field corrections; the fields before and after the jump differ.",
)
REFLECTED_SOURCE = Effect(
    name="reflected_source",
    physics="A warm body mirrors in the table: a patch of the field changes faster than heat can flow, and the readings do not follow.",
    source="reflection of (1 - emissivity) of the surroundings",
    candidates=_reflected_source,
    needs=_needs_patch,
    errs_camera=True,
    label="reflection in the thermogram",
    phrase="a reflection in the thermograms",
    remedy="Shield the reflecting source, or paint the reflecting part.",
)


_AIR = ("air_temperature", "air_pressure", "relative_humidity")
#: Time constants of a laser's warm-up; what settles more slowly is a part of machine or set-up.
_WARM_UPS_MIN = (3.0, 6.0, 12.0, 24.0)


def _needs_air(readings: Readings) -> str | None:
    missing = [name for name in _AIR if name not in readings.series]
    return f"the environment log has no {', '.join(missing)}" if missing else None


def _needs_material(readings: Readings) -> str | None:
    return None if "material_temperature" in readings.series else "the environment log has no material_temperature"


def _needs_sensor_episode(readings: Readings) -> str | None:
    if detect_sensor_jumps(readings) or detect_stuck_sensors(readings):
        return None
    return "no logged sensor jumps or sticks"


def _refractivity_change_ppm(readings: Readings) -> Array:
    """Change of the index of air since the first reading, ppm (Ciddor 1996), (n,)."""
    index = air_index(*(readings.at(readings.series[name]) for name in _AIR))
    return np.asarray((index - index[0]) * 1e6, float)


def _dead_path(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, the same at all positions."""
    yield Candidate((_refractivity_change_ppm(readings) * 1e-3)[:, None], {}, ("mm",))


def _air_index(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, along the axis."""
    yield Candidate((_refractivity_change_ppm(readings) * 1e-3 * readings.position_mm)[:, None], {}, ("1",))


def _material_compensation(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The material probe, along the axis."""
    material = readings.at(readings.series["material_temperature"])
    yield Candidate(((material - material[0]) * readings.position_mm * 1e-3)[:, None], {}, ("ppm/K",))


def _laser_warm_up(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Exponentials along the axis, with or without dead path."""
    for minutes in values_near(near, "time_constant_min", _WARM_UPS_MIN, ratio=2.0):
        settling = 1.0 - warm_up(readings, minutes)
        linear = settling * readings.position_mm * 1e-3
        yield Candidate(linear[:, None], {"time_constant_min": minutes, "shape": "linear"}, ("ppm",))
        # A shift of all positions that dies away may come from any part of machine and set-up.
        both: Parameters = {"time_constant_min": minutes, "shape": "linear with dead path"}
        yield Candidate(np.column_stack([linear, settling]), both, ("ppm", "um"), beside=1)


def _sensor_fault(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps and ramps along the axis where a sensor jumps or sticks."""
    for name, before, after, size in detect_sensor_jumps(readings):
        late = (readings.seconds >= 0.5 * (before + after)).astype(float)
        jumped: Parameters = {"sensor": name, "time_s": after, "jump": size}
        yield Candidate((late * readings.position_mm * 1e-3)[:, None], jumped, ("ppm",), event_s=after)
    for name, start in detect_stuck_sensors(readings):
        since = np.clip(readings.seconds - start, 0.0, None) / 3600.0
        stuck: Parameters = {"sensor": name, "time_s": start, "jump": 0.0}
        yield Candidate((since * readings.position_mm * 1e-3)[:, None], stuck, ("ppm/h",), event_s=start)


DEAD_PATH = Effect(
    name="dead_path",
    physics="Air between the interferometer and its zero is not compensated: the reading shifts with the index of air.",
    source="Ciddor 1996; ISO 230-1",
    candidates=_dead_path,
    needs=_needs_air,
    declarable=True,
    label="dead path of the laser",
    phrase="the laser's dead path",
    remedy="Shorten the dead path or enter it, and zero the laser where the optics are closest.",
)
AIR_INDEX = Effect(
    name="air_index",
    physics="The index of air is not, or wrongly, compensated along the measured length.",
    source="Ciddor 1996: -0.955 ppm/K, +0.268 ppm/hPa",
    candidates=_air_index,
    needs=_needs_air,
    declarable=True,
    label="refractive index of the air",
    phrase="the refractive index of the air",
    remedy="Check that the weather station was on, and that its air sensor is in the beam's air.",
)
MATERIAL_COMPENSATION = Effect(
    name="material_compensation",
    physics="The expansion coefficient or the place of the material probe is wrong: a stretch that follows the probe.",
    source="ISO 230-2, 7.1; ISO/TR 16015",
    candidates=_material_compensation,
    needs=_needs_material,
    masked_by=unmeasured_expansion,
    declarable=True,
    label="material compensation",
    phrase="the laser's material compensation",
    remedy="Check the coefficient that was entered and where the material probe sat.",
)
LASER_WARM_UP = Effect(
    name="laser_warm_up",
    physics="The laser's wavelength settles during the first minutes: a stretch, and a shift by the dead path, that die away.",
    source="frequency stabilisation of a He-Ne laser",
    candidates=_laser_warm_up,
    masked_by=unmeasured_expansion,
    longest_min=_WARM_UPS_MIN[-1],
    label="warm-up of the laser",
    phrase="the laser's warm-up",
    remedy="Let the laser warm up longer before the first cycle.",
)
SENSOR_FAULT = Effect(
    name="sensor_fault",
    physics="A sensor of the environment unit jumps or sticks, and the instrument's own compensation believes it.",
    source="jump or frozen value in the environment log",
    candidates=_sensor_fault,
    needs=_needs_sensor_episode,
    repeats=True,
    label="faulty sensor",
    phrase="a faulty sensor",
    remedy="Check the sensor named, and its cable and time stamps.",
)
