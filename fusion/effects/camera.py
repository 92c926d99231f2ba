"""Errors of the camera: the field is wrong and the machine did not move, so that the prediction errs by what the field claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Parameters
from fusion.effects.jumps import jumps
from fusion.effects.thermal import needs_field


def _needs_jump(readings: Readings) -> str | None:
    missing = needs_field(readings)
    if missing is not None:
        return missing
    return None if jumps(readings.series["mean_rise"]) else "no frame jumps against its neighbours"


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
    for before, after, size in jumps(readings.series["mean_rise"]):
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
    remedy="Shield the reflecting source, or paint the reflecting part.",
)
