"""The guard: what speaks against a compensation table, and what only has to be known."""

from __future__ import annotations

from typing import Any

import pytest

from fusion.products.results import Results, assemble
from fusion.report.exports.guard import objections, remarks
from tests.fusion.results_sample import PARTS

SOUND = {"state": "sound", "accepted": [], "checks": []}
CHECK = {
    "code": "copied_cycles", "value": 3.0, "limit": 0.0, "passed": False, "evidence": "3 cycles are copies.", "remedy": "Look.",
    "endangers": "all", "premise": "no cycle is a copy", "conditional": ["positions"],
}  # fmt: skip


def results(**changes: Any) -> Results:
    return assemble("A", {**PARTS, "inputs": SOUND, **changes}, [])


def loop(**changes: Any) -> dict[str, Any]:
    return {**PARTS["loop"], **changes}


def anomaly(kind: str, cause: str) -> dict[str, Any]:
    (sample,) = PARTS["anomalies"]
    return {**sample, "cause": cause, "evidence": {**sample["evidence"], "kind": kind}}


@pytest.mark.parametrize("verdict", ["complete", "explained"])
def test_a_sound_run_has_no_objection(verdict: str) -> None:
    found = results(loop=loop(verdict=verdict))
    assert objections(found) == []
    assert remarks(found) == [
        "position 3, both approaches, stands out (scatter of the structure, scatter 0.70 um): a table does not correct that"
    ]


@pytest.mark.parametrize("verdict", ["partial", "unexplained", "no_skill"])
def test_other_verdicts_are_objections(verdict: str) -> None:
    (reason,) = objections(results(loop=loop(verdict=verdict)))
    assert reason.startswith(f"the verdict is {verdict}: ")


def test_doubted_and_unchecked_inputs_are_objections() -> None:
    doubted = {"state": "doubted", "accepted": [], "checks": [CHECK]}
    assert objections(results(inputs=doubted)) == ["an input is doubted (copied_cycles): 3 cycles are copies"]
    assert objections(results(inputs={**doubted, "accepted": ["copied_cycles"]})) == []
    unchecked = assemble("A", {name: part for name, part in PARTS.items() if name != "inputs"}, [])
    assert objections(unchecked) == ["the inputs were not checked against each other"]


def test_a_run_without_a_model_is_an_objection() -> None:
    parts = {name: part for name, part in PARTS.items() if name != "loop"}
    assert objections(assemble("A", {**parts, "inputs": SOUND}, [])) == [
        "the drift was not modelled, so that nothing says whether the profile is free of it"
    ]


@pytest.mark.parametrize(("kind", "cause"), [("step", "step"), ("slow", "undetermined"), ("periodic", "undetermined")])
def test_a_position_that_moves_by_itself_is_an_objection(kind: str, cause: str) -> None:
    (reason,) = objections(results(anomalies=[anomaly(kind, cause)]))
    assert reason.startswith(f"position 3, both approaches, moves by itself ({kind}, cause: ")


def test_a_position_that_follows_its_temperature_is_explained() -> None:
    found = results(anomalies=[anomaly("slow", "local_temperature")])
    assert objections(found) == [] and "local temperature" in remarks(found)[0]
