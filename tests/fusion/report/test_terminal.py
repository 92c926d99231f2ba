"""What the command prints: findings of a run, windows of cycles."""

from __future__ import annotations

from fusion.consistency.checks import Check, inputs_part
from fusion.products.results import Notice, assemble
from fusion.report.terminal import summary_rows
from tests.fusion.results_sample import PARTS


def test_the_findings_of_a_run_in_a_few_rows() -> None:
    rows = dict(summary_rows(assemble("A", PARTS, [Notice("clock", "The clocks disagree.", "Set clock_offset.")])))
    assert rows["registration"] == "0.10 mm rms"
    assert "A = 1.00 \u00b1 0.20 \u00b5m" in rows["how much"]
    assert rows["where"].startswith("Position 3 repeats worse than the others")
    assert (
        rows["added"]
        == "step_event (p = 0.001), held-out error 0.60 -> 0.40 \u00b5m, blocks predicted from the others 0.70 -> 0.50 \u00b5m"
    )
    assert rows["held-out error"] == "0.60 [0.50 to 0.70] -> 0.40 [0.35 to 0.46] \u00b5m"
    assert rows["plain predictions"].endswith("ridge regression with lagged copies 0.50 \u00b5m")
    assert rows["next"].splitlines()[-1] == "3. Set clock_offset."
    assert rows["warning"] == "The clocks disagree."


def test_a_doubt_stands_beside_every_finding_that_rests_on_it() -> None:
    checks = [Check("datum", 1.0, 0.5, False, "It is off.", "Check it.", "figures")]
    rows = dict(summary_rows(assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])))
    condition = "(only if the datum of the laser stayed the same)"
    touched = {name for name, text in rows.items() if condition[1:-1] in text.lower()}
    assert touched == {
        "verdict",
        "how much",
        "where",
        "how sure",
        "scatter per position",
        "added",
        "held-out error",
        "plain predictions",
        "noise floor",
    }


def test_an_exact_fit_is_not_printed_as_accuracy() -> None:
    part = {**PARTS["registration"], "rms_mm": None, "position_u_mm": 0.87, "leave_one_out_mm": dict.fromkeys("ABCD")}
    rows = dict(summary_rows(assemble("four discs", {**PARTS, "registration": part}, [])))
    assert rows["registration"] == ("standard uncertainty 0.87 mm, not checked: 4 fiducials determine the plan exactly")
