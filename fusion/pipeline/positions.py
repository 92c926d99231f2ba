"""Positions that stand out from what the model explains, and their cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import xarray as xr

from fusion.diagnosis.causes import undetermined_check
from fusion.diagnosis.diagnose import Diagnosis, diagnose
from interferometry.anomalies import Anomaly, detect_anomalies
from interferometry.drift.estimate import estimate_drift

#: Largest family-wise p-value of an anomaly for which a cause is named.
_CAUSE_LEVEL = 0.02


@dataclass(frozen=True)
class JudgedPosition:
    """A position that stands out, and its diagnosis."""

    anomaly: Anomaly
    diagnosis: Diagnosis

    def as_json(self) -> dict[str, Any]:
        """One entry of ``anomalies`` in results.json: what was flagged, its cause, and the evidence for and against it."""
        anomaly, diagnosis = self.anomaly, self.diagnosis
        return {
            "target": anomaly.target,
            "direction": anomaly.direction,
            "p_value": anomaly.p_value,
            "least_p": anomaly.least_p_value,
            "scatter_um": anomaly.scatter_um,
            "cause": diagnosis.cause,
            "evidence": {
                "kind": anomaly.kind,
                "extra_um": anomaly.extra_um,
                "probability": diagnosis.probability,
                "for": list(diagnosis.for_it),
                "against": list(diagnosis.against_it),
                "check": diagnosis.check,
                **diagnosis.evidence,
            },
        }


def judge_positions(fused: xr.Dataset, deviations: xr.Dataset, explained: xr.DataArray) -> list[JudgedPosition]:
    """Detect positions that stand out beside the named effects, and diagnose them.

    An effect that moves whole stretches of the axis makes their positions stand out too, so it is taken out first.

    Parameters
    ----------
    fused : both recordings on one clock
    deviations : keeps ``interferometry.contract.DEVIATIONS``
    explained : (cycle, direction, target) contribution of the model's effects, um; NaN where no reading is modelled
    """
    left = (fused["deviation"] - explained).values
    cleaned = deviations.assign(deviation=deviations["deviation"].copy(data=left))
    # Scatter that is only unequal, as it naturally is, makes no position an anomaly; one that stands out does.
    anomalies = [anomaly for anomaly in detect_anomalies(estimate_drift(cleaned), cleaned) if anomaly.stands_out]
    diagnoses = diagnose(anomalies, fused.assign(deviation=fused["deviation"].copy(data=left)))
    return [
        JudgedPosition(anomaly, temper(anomaly, diagnosis))
        for anomaly, diagnosis in zip(anomalies, diagnoses, strict=True)
    ]


def temper(anomaly: Anomaly, diagnosis: Diagnosis) -> Diagnosis:
    """Name no cause for a position that is itself flagged only near the limit.

    Parameters
    ----------
    anomaly : the position
    diagnosis : its cause as diagnosed

    Returns
    -------
    Diagnosis
        With the cause ``undetermined``, the reason, and the check of the withdrawn cause as a condition,
        where the anomaly's p-value is above 0.02.
    """
    if diagnosis.cause == "undetermined" or anomaly.p_value <= _CAUSE_LEVEL:
        return diagnosis
    doubt = f"the position itself is flagged only near the limit (p = {anomaly.p_value:.2g}); before a cause, it needs more cycles"
    check = undetermined_check(diagnosis.cause)
    return replace(diagnosis, cause="undetermined", check=check, against_it=(doubt, *diagnosis.against_it))


def sites_of(positions: Sequence[JudgedPosition], targets: int) -> list[tuple[int, str]]:
    """Sites that are reported as anomalies, so that the loop does not report them again as a remainder.

    Parameters
    ----------
    positions : those that stand out, with a cause or without one
    targets : number of target positions of the test

    Returns
    -------
    list of (target, direction)
        Empty where more than a quarter of the targets stands out: that is no matter of single positions.
    """
    anomalies = [position.anomaly for position in positions]
    if 4 * len({anomaly.target for anomaly in anomalies}) > targets:
        return []
    return [(anomaly.target, name) for anomaly in anomalies for name in _directions_of(anomaly.direction)]


def _directions_of(direction: str) -> tuple[str, ...]:
    """The approaches that an anomaly concerns."""
    return ("positive", "negative") if direction == "both" else (direction,)
