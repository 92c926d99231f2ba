"""What a consistency check says: value, limit, evidence, remedy, and the figures that it endangers.

A contradiction of facts ends the run before the long work; a doubt lets it go on and makes its conclusions conditional.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

from fusion.common import FusionError
from fusion.results.parts import Figures
from fusion.results.results import Notice

# The assumption behind every check, and the results that hold only if it is true; what the other instrument shows
# holds anyway.

_POSITIONS: Figures = "positions"
_FIELD: Figures = "field"
_ATTRIBUTION: Figures = "attribution"
_CAUSES: Figures = "causes"


@dataclass(frozen=True)
class Condition:
    """What a doubt makes conditional.

    Attributes
    ----------
    assumption : what has to be right, as it follows "only if"
    figures : what holds only then
    endangers : the same in words
    """

    assumption: str
    figures: tuple[Figures, ...]
    endangers: str = "every figure"


_LASER = (_POSITIONS, _ATTRIBUTION, _CAUSES)
_CAMERA = (_FIELD, _ATTRIBUTION, _CAUSES)
_CLOCK = (_ATTRIBUTION, _CAUSES)
_LOG = (_CAUSES,)
_ANY = Condition("the doubted input is right", (_POSITIONS, _FIELD, _ATTRIBUTION, _CAUSES))

_AXIS_VALUES = "every value of the axis"
_PROFILE = "ISO 230-2 values, profile, reversal error, anomalies and every effect"
_COMPENSATION = "index of air, dead path and material compensation"
_LOADS = "every effect that follows a load, and the verdict that none is missing"
_RISES = "temperatures, and all that follows from them"
_FIELDS = "temperature fields, hotspots, and every cause that follows the field"
_SCALE = "temperatures, rises, the declared coefficients, and every cause that follows the field"
_SENSORS = "temperatures, rises, the declared coefficients, and every cause that follows them"
_PLACES = (
    "the place of every temperature on the plan, rises along the measured line, and every cause that follows the field"
)
_FIELDS_AT_READINGS = "all fields at the readings, the declared coefficients, and every cause"

#: Every check by its code.
CONDITIONS = {
    "deviation_magnitude": Condition("the deviations are in µm", _LASER, _AXIS_VALUES),
    "deviation_unit": Condition("the deviations are in µm", _LASER, _AXIS_VALUES),
    "travel": Condition("the positions are in mm", _LASER, "every value per length: expansion, pitch, index of air"),
    "copied_cycles": Condition("every cycle was measured", _LASER, "scatter, repeatability, p-values"),
    "copied_targets": Condition("every target was measured", _LASER, _PROFILE),
    "repeated_value": Condition("the readings are whole", _LASER, _PROFILE),
    "missed_trigger": Condition("every reading belongs to its target", _LASER, _PROFILE),
    "approach_labels": Condition(
        "the labels of the approaches are right",
        _LASER,
        "ISO 230-2 values, reversal error, and every effect that depends on the direction of approach",
    ),
    "datum": Condition(
        "the datum of the laser stayed the same",
        _LASER,
        "drift, ISO 230-2 values over the whole test, and every cause that acts from that cycle on",
    ),
    "zeroed_cycles": Condition(
        "the laser was not set to zero in every cycle",
        _LASER,
        "the common drift, table_offset, and every cause that shifts all targets alike",
    ),
    "travel_order": Condition(
        "the labels of the approaches are right",
        _LASER,
        "ISO 230-2 values, reversal error, profile by direction, and every effect that depends on the direction of approach",
    ),
    "target_order": Condition("the targets are numbered alike in both approaches", _LASER, _PROFILE),
    "mirrored_readings": Condition("the signs of the deviations are right", _LASER, _PROFILE),
    "environment_coverage": Condition("the environment log belongs to this test", _LOG, _COMPENSATION),
    "contact_sensors": Condition(
        "the contact sensors of the logs are sound", _LOG, "compensation by the log, and every cause that follows it"
    ),
    "sensors_coverage": Condition(
        "the sensors' log belongs to this test", _CLOCK, "every effect that follows the temperature of the table"
    ),
    "sensors_rise": Condition("camera and contact sensors show the same rise", _CAMERA, _SENSORS),
    "drivers_coverage": Condition("the drivers' log belongs to this test", _LOG, _LOADS),
    "camera_settings": Condition("the camera's settings stayed the same", _CAMERA, _RISES),
    "camera_parameters": Condition("the stored camera parameters are right", _CAMERA, _RISES),
    "camera_range": Condition("what lies beyond the calibrated range of the camera is right", _CAMERA, _RISES),
    "camera_stamps": Condition("the times of the frames are right", _CAMERA, _FIELDS_AT_READINGS),
    "camera_rate": Condition("the camera's clock keeps its rate", _CLOCK, _FIELDS_AT_READINGS),
    "camera_phase": Condition("the table was in place when the frames were taken", _CAMERA, _FIELDS_AT_READINGS),
    "frames_coverage": Condition("frames and readings belong together", _CLOCK, _FIELDS_AT_READINGS),
    "camera_clock": Condition("the clock of the camera is right", _CLOCK, _FIELDS_AT_READINGS),
    "laser_clock": Condition("the clock of the laser is right", _CLOCK, _FIELDS_AT_READINGS),
    "environment_clock": Condition("the clock of the environment log is right", _LOG, _COMPENSATION),
    "drivers_clock": Condition("the clock of the drivers' log is right", _LOG, "every effect that follows a load"),
    "sensors_clock": Condition("the clock of the contact sensors' log is right", _CLOCK, _SENSORS),
    "clocks": Condition(
        "all clocks agree as stated", _CLOCK, "whatever is brought to one time: " + _FIELDS_AT_READINGS
    ),
    "drivers_scale": Condition("the loads are logged in one unit throughout", _LOG, _LOADS),
    "drivers_kind": Condition("the drivers' log holds loads", _LOG, _LOADS),
    "drivers_course": Condition("the drivers' log is that of what heats the table", _LOG, _LOADS),
    "material_course": Condition("frames and environment log are of one test and in order", _CAMERA, _SCALE),
    "material_still": Condition(
        "the material sensor measured the table",
        _LOG,
        "material compensation, and every cause that follows the material temperature",
    ),
    "environment_columns": Condition("the columns of the environment log are named right", _LOG, _COMPENSATION),
    "material_rise": Condition("the emissivity is right", _CAMERA, _SCALE),
    "material_gain": Condition("the gain of the camera stayed the same", _CAMERA, _SCALE),
    "material_level": Condition("the level of the camera's temperature is right", _CAMERA, _SCALE),
    "fiducials_found": Condition("the plan is registered right", _CAMERA, _PLACES),
    "fiducials_unchecked": Condition("the plan is registered right", _CAMERA, _PLACES),
    "fiducial_hints": Condition("the plan is registered right", _CAMERA, _PLACES),
    "fiducial_diameters": Condition("the places of the fiducials are right", _CAMERA, _PLACES),
    "fiducials_span": Condition("the plan has the size of the table", _CAMERA, _PLACES),
    "plan_mirrored": Condition(
        "the plan is not mirrored",
        _CAMERA,
        "place and direction of the measured line on the plan, and every cause that follows the field",
    ),
    "camera_picture": Condition("no pattern of the camera or of a reflection grew in the picture", _CAMERA, _FIELDS),
    "camera_zero": Condition("the zero of the camera stayed the same", _CAMERA, _RISES),
    "camera_place": Condition("the camera stayed in its place", _CAMERA, _FIELDS),
    "frames_left_out": Condition("the frames that are left show the whole test", _CAMERA, _FIELDS),
    "frames_gaps": Condition(
        "the table changed steadily while no frame was taken",
        _CLOCK,
        "fields and rises at these readings, which are interpolated across the gap, and every cause that follows the field",
    ),
    "frames_repeated": Condition("every frame was taken at its time", _CAMERA, _FIELDS),
    "scene_change": Condition("the frames show one table throughout", _CAMERA, _FIELDS),
    "expansion_coefficient": Condition(
        "the scale of the temperatures, the expansion coefficient and the axis on the plan are right",
        _LOG,
        "the declared coefficients, and every added cause",
    ),
    "sensitivity": Condition(
        "the scales of temperature and deviation are right",
        _LOG,
        "the coefficients, and every cause that follows the temperature",
    ),
    "axis_line": Condition(
        "the axis on the plan, the order of the targets and the signs are right",
        _CLOCK,
        "the declared coefficients, the place of every heat source along the axis, and every added cause",
    ),
}


def condition_of(code: str, *, recompensated: bool = False) -> Condition:
    """Return what a doubt makes conditional."""
    condition = CONDITIONS.get(code, _ANY)
    if recompensated and code.startswith("environment"):
        return Condition(condition.assumption, (_POSITIONS, *condition.figures), condition.endangers)
    return condition


#: Every check.
CODES = tuple(CONDITIONS)


class ContradictionError(FusionError):
    """Inputs that cannot all be true; the message names the file, the value and the remedy."""


class Severity(StrEnum):
    """What follows from a check that is not passed."""

    DOUBT = "doubt"
    CONTRADICTION = "contradiction"


@dataclass(frozen=True)
class Check:
    """Outcome of one check.

    Attributes
    ----------
    code : for programs and for ``[accept] doubts``
    value, limit : in the unit that the evidence names
    evidence : one sentence with the numbers
    remedy : empty where the check is passed and verified
    verified : whether a passed check confirms the input; else its figures hold only under the assumption
    """

    code: str
    value: float
    limit: float
    passed: bool
    evidence: str
    remedy: str
    endangers: str
    severity: Severity = Severity.DOUBT
    verified: bool = True

    def as_json(self, *, recompensated: bool = False) -> dict[str, object]:
        """One entry of ``inputs.checks`` in results.json; `recompensated` as for `fusion.analysis.consistency.checks.condition_of`."""
        condition = condition_of(self.code, recompensated=recompensated)
        entries = {name: value for name, value in vars(self).items() if name != "severity"}
        # What nothing contradicts and nothing confirms: sizes depend on it, no name does.
        figures = condition.figures if self.verified else tuple(name for name in condition.figures if name == _FIELD)
        return {**entries, "assumption": condition.assumption, "conditional": figures}


def judge(
    code: str,
    value: float,
    limit: float,
    evidence: str,
    remedy: str = "",
    *,
    passed: bool | None = None,
    sound: str = "",
    severity: Severity = Severity.DOUBT,
    endangers: str = "",
    unverified: str = "",
) -> Check:
    """Compare a value with its limit; `sound` is the evidence of a passed check, `unverified` the remedy where it confirms nothing."""
    passed = bool(value <= limit if passed is None else passed)
    return Check(
        code,
        float(value),
        float(limit),
        passed,
        sound if passed and sound else evidence,
        unverified if passed else remedy,
        endangers or condition_of(code).endangers,
        severity,
        verified=not (passed and unverified),
    )


def refuse_contradictions(checks: Sequence[Check]) -> None:
    """Refuse inputs that cannot all be true."""
    faults = [check for check in checks if not check.passed and check.severity is Severity.CONTRADICTION]
    if faults:
        raise ContradictionError("\n".join(f"{check.evidence} {check.remedy}" for check in faults))


def open_doubts(checks: Sequence[Check], accepted: Collection[str]) -> list[Check]:
    """Checks that are not passed and that the campaign file does not accept."""
    return [check for check in checks if not check.passed and check.code not in accepted]


def inputs_part(
    checks: Sequence[Check], accepted: Collection[str], *, corrected: bool = False, recompensated: bool = False
) -> dict[str, object]:
    """The part ``inputs`` of results.json."""
    sound = "corrected" if corrected else "sound"
    return {
        "state": "doubted" if open_doubts(checks, accepted) else sound,
        "accepted": sorted(accepted),
        "checks": [check.as_json(recompensated=recompensated) for check in checks],
    }


def doubt_notices(checks: Sequence[Check], accepted: Collection[str]) -> list[Notice]:
    """One warning for every check that is not passed."""
    notices = []
    for check in checks:
        if check.passed:
            continue
        known = check.code in accepted
        message = f"{check.evidence} {'Accepted in the campaign file.' if known else f'Endangered: {check.endangers}.'}"
        notices.append(Notice(f"doubt_{check.code}", message, "" if known else check.remedy))
    return notices
