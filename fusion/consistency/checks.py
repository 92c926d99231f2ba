"""What a consistency check says: value, limit, evidence, remedy, and the figures that it endangers.

A contradiction of facts ends the run before the long work; a doubt lets it go on and makes its conclusions conditional.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

from fusion.consistency.conditions import condition_of
from fusion.errors import FusionError
from fusion.products.results import Notice

#: Every check by its code.
CODES = (
    "deviation_magnitude",
    "deviation_unit",
    "travel",
    "copied_cycles",
    "approach_labels",
    "datum",
    "zeroed_cycles",
    "travel_order",
    "target_order",
    "mirrored_readings",
    "environment_coverage",
    "contact_sensors",
    "plan_sensors",
    "sensors_coverage",
    "sensors_rise",
    "drivers_coverage",
    "camera_settings",
    "camera_parameters",
    "camera_range",
    "camera_stamps",
    "camera_rate",
    "camera_phase",
    "camera_clock",
    "environment_clock",
    "drivers_clock",
    "drivers_scale",
    "material_course",
    "material_still",
    "environment_columns",
    "material_rise",
    "material_level",
    "fiducials_found",
    "fiducials_unchecked",
    "fiducial_hints",
    "fiducial_diameters",
    "fiducials_span",
    "plan_mirrored",
    "frozen_camera",
    "camera_place",
    "frames_left_out",
    "frames_gaps",
    "frames_repeated",
    "scene_change",
    "expansion_coefficient",
    "sensitivity",
    "axis_line",
)


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
    code : str
        Short name, for programs and for ``[accept] doubts``.
    value, limit : float
        What was found, and the limit that it is held against, in the unit that the evidence names.
    passed : bool
        Whether the inputs agree.
    evidence : str
        One sentence with the numbers.
    remedy : str
        What to correct; empty where the check is passed.
    endangers : str
        Figures that are wrong if the doubt is right.
    severity : Severity
        What follows where the check is not passed.
    """

    code: str
    value: float
    limit: float
    passed: bool
    evidence: str
    remedy: str
    endangers: str
    severity: Severity = Severity.DOUBT

    def as_json(self, *, recompensated: bool = False) -> dict[str, object]:
        """One entry of ``inputs.checks`` in results.json; `recompensated` as for `fusion.consistency.conditions.condition_of`."""
        condition = condition_of(self.code, recompensated=recompensated)
        entries = {name: value for name, value in vars(self).items() if name != "severity"}
        return {**entries, "premise": condition.premise, "conditional": condition.figures}


def refuse_contradictions(checks: Sequence[Check]) -> None:
    """Refuse inputs that cannot all be true.

    Parameters
    ----------
    checks : sequence of Check
        Those that need no long work.

    Raises
    ------
    ContradictionError
        With every contradiction, one per line.
    """
    faults = [check for check in checks if not check.passed and check.severity is Severity.CONTRADICTION]
    if faults:
        raise ContradictionError("\n".join(f"{check.evidence} {check.remedy}" for check in faults))


def open_doubts(checks: Sequence[Check], accepted: Collection[str]) -> list[Check]:
    """Checks that are not passed and that the campaign file does not accept.

    Parameters
    ----------
    checks : sequence of Check
        All of a run.
    accepted : collection of str
        Codes under ``[accept] doubts``.
    """
    return [check for check in checks if not check.passed and check.code not in accepted]


def inputs_part(
    checks: Sequence[Check], accepted: Collection[str], *, corrected: bool = False, recompensated: bool = False
) -> dict[str, object]:
    """The part ``inputs`` of results.json.

    Parameters
    ----------
    checks : sequence of Check
        All of a run, also those that are passed.
    accepted : collection of str
        Codes under ``[accept] doubts``.
    corrected : bool
        Whether inputs were corrected or left out before they were used.
    recompensated : bool
        Whether the readings were compensated with the environment log.
    """
    sound = "corrected" if corrected else "sound"
    return {
        "state": "doubted" if open_doubts(checks, accepted) else sound,
        "accepted": sorted(accepted),
        "checks": [check.as_json(recompensated=recompensated) for check in checks],
    }


def doubt_notices(checks: Sequence[Check], accepted: Collection[str]) -> list[Notice]:
    """One warning for every check that is not passed.

    Parameters
    ----------
    checks : sequence of Check
        All of a run.
    accepted : collection of str
        Codes under ``[accept] doubts``; they are named as accepted and ask for nothing.
    """
    notices = []
    for check in checks:
        if check.passed:
            continue
        known = check.code in accepted
        message = f"{check.evidence} {'Accepted in the campaign file.' if known else f'Endangered: {check.endangers}.'}"
        notices.append(Notice(f"doubt_{check.code}", message, "" if known else check.remedy))
    return notices
