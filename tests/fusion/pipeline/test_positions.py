"""Positions that stand out: when a cause is named, and which sites the loop sets aside."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.diagnosis.causes import CAUSES
from fusion.diagnosis.diagnose import Diagnosis
from fusion.pipeline import positions as module
from fusion.pipeline.positions import JudgedPosition, judge_positions, sites_of, temper
from interferometry.anomalies import Anomaly


def anomaly(target: int = 3, direction: str = "positive", *, p_value: float = 0.01, stands_out: bool = True) -> Anomaly:
    return Anomaly(
        target=target,
        direction=direction,
        kind="scatter",
        p_value=p_value,
        scatter_um=0.8,
        extra_um=0.6,
        stands_out=stands_out,
    )


def diagnosis(cause: str = "structural") -> Diagnosis:
    return Diagnosis(
        target=3,
        direction="positive",
        cause=cause,
        probability=0.9,
        evidence={"probability_structural": 0.9, "gain_nats": 4.0},
        for_it=("it scatters",),
        against_it=("it is alone",),
        check="Look at the guide.",
    )


def test_a_cause_is_named_up_to_a_p_value_of_two_percent():
    at_the_limit = diagnosis()
    assert temper(anomaly(p_value=0.02), at_the_limit) is at_the_limit
    doubted = temper(anomaly(p_value=0.0201), at_the_limit)
    assert doubted.cause == "undetermined"
    assert doubted.against_it == (
        "the position itself is flagged only near the limit (p = 0.02); before a cause, it needs more cycles",
        "it is alone",
    )
    # What to check of the withdrawn cause is said as a condition; the evidence stays.
    generic, condition = doubted.check.split(" If the cause is ")
    assert generic == CAUSES["undetermined"].check
    assert condition.startswith("scatter of the structure: inspect guideway, scale, screw and nut")
    assert (doubted.probability, doubted.evidence, doubted.for_it) == (0.9, at_the_limit.evidence, ("it scatters",))


def test_without_a_cause_there_is_nothing_to_doubt():
    undetermined = diagnosis("undetermined")
    assert temper(anomaly(p_value=0.04), undetermined) is undetermined


@pytest.mark.parametrize(("targets", "set_aside"), [(8, True), (7, False)])
def test_more_than_a_quarter_of_the_targets_is_no_matter_of_single_positions(targets, set_aside):
    judged = [JudgedPosition(anomaly(target), diagnosis()) for target in (2, 5)]
    assert sites_of(judged, targets) == ([(2, "positive"), (5, "positive")] if set_aside else [])


def test_a_target_counts_once_and_both_directions_are_two_sites():
    judged = [
        JudgedPosition(anomaly(2, "both"), diagnosis()),
        JudgedPosition(anomaly(2, "negative"), diagnosis("undetermined")),
    ]
    assert sites_of(judged, 4) == [(2, "positive"), (2, "negative"), (2, "negative")]
    assert sites_of([], 4) == []


def test_a_position_is_written_with_its_evidence():
    assert JudgedPosition(anomaly(), diagnosis()).as_json() == {
        "target": 3,
        "direction": "positive",
        "p_value": 0.01,
        "least_p": 0.0,
        "scatter_um": 0.8,
        "cause": "structural",
        "evidence": {
            "kind": "scatter",
            "extra_um": 0.6,
            "probability": 0.9,
            "for": ["it scatters"],
            "against": ["it is alone"],
            "check": "Look at the guide.",
            "probability_structural": 0.9,
            "gain_nats": 4.0,
        },
    }


def test_what_the_model_explains_is_taken_out_before_positions_are_judged(monkeypatch):
    dims = ("cycle", "direction", "target")
    deviation = xr.DataArray(np.arange(12.0).reshape(3, 2, 2), dims=dims, attrs={"units": "um"})
    explained = xr.full_like(deviation, 2.0)
    explained[0, 0, 0] = np.nan
    fused, deviations = xr.Dataset({"deviation": deviation}), xr.Dataset({"deviation": deviation})
    expected = deviation.values - explained.values
    judged = []

    def detect(drift, cleaned):
        judged.append(cleaned["deviation"])
        assert drift == "drift of what is left"
        return [anomaly(1, p_value=0.04), anomaly(2, stands_out=False), anomaly(3)]

    def diagnose(anomalies, cleaned):
        judged.append(cleaned["deviation"])
        return [diagnosis() for _ in anomalies]

    monkeypatch.setattr(module, "estimate_drift", lambda cleaned: "drift of what is left")
    monkeypatch.setattr(module, "detect_anomalies", detect)
    monkeypatch.setattr(module, "diagnose", diagnose)
    told = judge_positions(fused, deviations, explained)
    for values in judged:
        np.testing.assert_array_equal(values, expected)
        assert values.attrs == {"units": "um"}
    # Scatter that is naturally unequal is no anomaly; a position near the limit gets no cause.
    assert [(one.anomaly.target, one.diagnosis.cause) for one in told] == [(1, "undetermined"), (3, "structural")]
    np.testing.assert_array_equal(fused["deviation"], np.arange(12.0).reshape(3, 2, 2))
