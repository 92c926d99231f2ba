"""What has to be right where a check is not passed, and which figures hold only then; what the other instrument shows holds anyway."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.products.results_inputs import Figures

_POSITIONS: Figures = "positions"
_FIELD: Figures = "field"
_ATTRIBUTION: Figures = "attribution"
_CAUSES: Figures = "causes"


@dataclass(frozen=True)
class Condition:
    """What a doubt makes conditional.

    Attributes
    ----------
    premise : str
        What has to be right, as it follows "only if".
    figures : tuple of Figures
        What holds only then.
    """

    premise: str
    figures: tuple[Figures, ...]


_LASER = (_POSITIONS, _ATTRIBUTION, _CAUSES)
_CAMERA = (_FIELD, _ATTRIBUTION, _CAUSES)
_CLOCK = (_ATTRIBUTION, _CAUSES)
_ANY = Condition("the doubted input is right", (_POSITIONS, _FIELD, _ATTRIBUTION, _CAUSES))
_CONDITIONS = {
    "deviation_magnitude": Condition("the deviations are in µm", _LASER),
    "deviation_unit": Condition("the deviations are in µm", _LASER),
    "travel": Condition("the positions are in mm", _LASER),
    "copied_cycles": Condition("every cycle was measured", _LASER),
    "approach_labels": Condition("the labels of the approaches are right", _LASER),
    "travel_order": Condition("the labels of the approaches are right", _LASER),
    "target_order": Condition("the targets are numbered alike in both approaches", _LASER),
    "mirrored_readings": Condition("the signs of the deviations are right", _LASER),
    "datum": Condition("the datum of the laser stayed the same", _LASER),
    "zeroed_cycles": Condition("the laser was not set to zero in every cycle", _LASER),
    "environment_coverage": Condition("the environment log belongs to this test", (_CAUSES,)),
    "contact_sensors": Condition("the contact sensors of the logs are sound", (_CAUSES,)),
    "plan_sensors": Condition("the contact sensors on the table are sound", _CLOCK),
    "sensors_coverage": Condition("the sensors' log belongs to this test", _CLOCK),
    "sensors_rise": Condition("camera and contact sensors show the same rise", _CAMERA),
    "drivers_coverage": Condition("the drivers' log belongs to this test", (_CAUSES,)),
    "camera_settings": Condition("the camera's settings stayed the same", _CAMERA),
    "camera_parameters": Condition("the stored camera parameters are right", _CAMERA),
    "camera_range": Condition("the camera is right outside its range", _CAMERA),
    "frozen_camera": Condition("every frame was taken at its time", _CAMERA),
    "frames_gaps": Condition("the table changed steadily while no frame was taken", (_ATTRIBUTION, _CAUSES)),
    "frames_repeated": Condition("every frame was taken at its time", _CAMERA),
    "frames_left_out": Condition("the frames that are left show the whole test", _CAMERA),
    "scene_change": Condition("the frames show one table throughout", _CAMERA),
    "camera_place": Condition("the camera stayed in its place", _CAMERA),
    "fiducials_found": Condition("the plan is registered right", _CAMERA),
    "fiducial_diameters": Condition("the places of the fiducials are right", _CAMERA),
    "fiducials_span": Condition("the plan has the size of the table", _CAMERA),
    "fiducials_unchecked": Condition("the plan is registered right", _CAMERA),
    "fiducial_hints": Condition("the plan is registered right", _CAMERA),
    "plan_mirrored": Condition("the plan is not mirrored", _CAMERA),
    "camera_stamps": Condition("the times of the frames are right", _CAMERA),
    "camera_rate": Condition("the camera's clock keeps its rate", _CLOCK),
    "camera_phase": Condition("the table was in place when the frames were taken", _CAMERA),
    "camera_clock": Condition("the clocks of camera and laser agree as stated", _CLOCK),
    "environment_clock": Condition("the clock of the environment log is right", (_CAUSES,)),
    "drivers_scale": Condition("the loads are logged in one unit throughout", (_CAUSES,)),
    "drivers_clock": Condition("the clock of the drivers' log is right", (_CAUSES,)),
    "material_course": Condition("frames and environment log are of one test and in order", _CAMERA),
    "material_still": Condition("the material sensor measured the table", (_CAUSES,)),
    "environment_columns": Condition("the columns of the environment log are named right", (_CAUSES,)),
    "material_rise": Condition("the emissivity is right", _CAMERA),
    "material_level": Condition("the level of the camera's temperature is right", _CAMERA),
    "expansion_coefficient": Condition(
        "the scale of the temperatures, the expansion coefficient and the axis on the plan are right", (_CAUSES,)
    ),
    "sensitivity": Condition("the scales of temperature and deviation are right", (_CAUSES,)),
    "axis_line": Condition("the axis on the plan, the order of the targets and the signs are right", _CLOCK),
}


def condition_of(code: str, *, recompensated: bool = False) -> Condition:
    """Return what a doubt makes conditional.

    Parameters
    ----------
    code : str
        Code of the check; one without an entry makes everything conditional.
    recompensated : bool
        Whether the readings were compensated with the environment log, so that it touches them as well.
    """
    condition = _CONDITIONS.get(code, _ANY)
    if recompensated and code.startswith("environment"):
        return Condition(condition.premise, (_POSITIONS, *condition.figures))
    return condition
