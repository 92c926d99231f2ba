"""What the command prints: findings of a run, windows of cycles."""

from __future__ import annotations

from fusion.consistency.checks import Check, inputs_part
from fusion.products.results import Notice, assemble
from fusion.report.terminal import summary_rows
from tests.fusion.results_sample import PARTS


def test_the_findings_of_a_run_in_a_few_rows() -> None:
    rows = dict(summary_rows(assemble("A", PARTS, [Notice("clock", "The clocks disagree.", "Set clock_offset.")])))
    assert rows["registration"] == "0.10 mm rms"
    assert rows["A (cycles 1 to 5)"] == "1.00 \u00b1 0.20 \u00b5m"
    assert rows["anomalies"] == "position 3, both approaches: scatter of the structure (p 0.01)"
    assert (
        rows["added"]
        == "step_event (p 0.001), held-out error 0.600 -> 0.400 \u00b5m, blocks left out 0.700 -> 0.500 \u00b5m"
    )
    assert rows["held-out error"] == "0.600 [0.50, 0.70] -> 0.400 [0.35, 0.46] \u00b5m"
    assert rows["plain predictions"].endswith("ridge regression with lagged copies 0.500 \u00b5m")
    assert rows["warning"] == "The clocks disagree."


def test_a_doubt_stands_beside_every_finding_that_rests_on_it() -> None:
    checks = [Check("datum", 1.0, 0.5, False, "It is off.", "Check it.", "figures")]
    rows = dict(summary_rows(assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])))
    condition = "(only if the datum of the laser stayed the same)"
    touched = {name for name, text in rows.items() if text.endswith(condition)}
    iso = {f"{symbol} (cycles 1 to 5)" for symbol in "ARB"}
    assert touched == iso | {
        "scatter per position",
        "anomalies",
        "added",
        "held-out error",
        "plain predictions",
        "noise floor",
    }
    assert condition[1:-1] in rows["verdict"].lower()


def test_an_exact_fit_is_not_printed_as_accuracy() -> None:
    part = {**PARTS["registration"], "rms_mm": None, "position_u_mm": 0.87, "leave_one_out_mm": dict.fromkeys("ABCD")}
    rows = dict(summary_rows(assemble("four discs", {**PARTS, "registration": part}, [])))
    assert rows["registration"] == ("standard uncertainty 0.87 mm, not checked: 4 fiducials determine the plan exactly")
