"""What the command prints: findings of a run, windows of cycles."""

import pytest

from fusion.analysis.consistency.checks import Check, inputs_part, judge
from fusion.report.findings import summary_rows
from fusion.results.results import Notice, assemble
from tests.fusion.results_sample import PARTS


def test_the_findings_of_a_run_in_a_few_rows():
    rows = dict(summary_rows(assemble("A", PARTS, [Notice("clock", "The clocks disagree.", "Set clock_offset.")])))
    assert rows["registration"] == "0.10 mm rms"
    assert "A = 1.00 \u00b1 0.20 \u00b5m" in rows["how much"]
    assert rows["where"].startswith("Position 3 repeats worse than the others")
    assert all(
        part in rows["added"]
        for part in ("step_event (p = 0.001)", "from 0.60 to 0.40 \u00b5m", "from 0.70 to 0.50 \u00b5m")
    )
    assert rows["held-out error"] == "0.60 [0.50 to 0.70] -> 0.40 [0.35 to 0.46] \u00b5m"
    assert rows["plain predictions"].endswith("ridge regression with lagged copies 0.50 \u00b5m")
    assert rows["next"].splitlines()[-1] == "3. Set clock_offset."
    assert rows["warning"] == "The clocks disagree."


def test_a_doubt_stands_beside_every_finding_that_rests_on_it():
    checks = [Check("datum", 1.0, 0.5, False, "It is off.", "Check it.", "figures")]
    rows = dict(summary_rows(assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])))
    condition = "(only if the datum of the laser stayed the same)"
    touched = {name for name, text in rows.items() if condition[1:-1] in text.lower()}
    of_laser = "verdict, how much, where, how sure, scatter per position, added, held-out error, plain predictions, noise floor, next"
    assert touched == set(of_laser.split(", "))


def test_what_is_not_verified_is_said_with_what_would_confirm_it():
    checks = [
        judge("material_rise", 0.0, 0.07, "Scale not verified.", unverified="State where the material sensor sits.")
    ]
    results = assemble("A", {**PARTS, "inputs": inputs_part(checks, ())}, [])
    rows = dict(summary_rows(results))
    assert (
        rows["inputs"] == "sound in 1 checks\nnot verified: Scale not verified. State where the material sensor sits."
    )
    assert rows["next"].startswith("1. State where the material sensor sits.")
    assert results.inputs.state == "sound" and results.inputs.assumptions("field") == ("the emissivity is right",)
    # A scale that all share makes no cause right or wrong.
    assert results.inputs.assumptions("positions", "attribution", "causes") == ()
    accepted = assemble("A", {**PARTS, "inputs": inputs_part(checks, ("material_rise",))}, [])
    assert accepted.inputs.unverified == ()


def test_an_exact_fit_is_not_printed_as_accuracy():
    part = {**PARTS["registration"], "rms_mm": None, "position_u_mm": 0.87, "leave_one_out_mm": dict.fromkeys("ABCD")}
    rows = dict(summary_rows(assemble("four discs", {**PARTS, "registration": part}, [])))
    assert rows["registration"] == ("standard uncertainty 0.87 mm, not checked: 4 fiducials determine the plan exactly")


@pytest.mark.parametrize(
    ("positive", "negative", "stated"),
    [
        ((0.4, None), (0.2, 0.3), "0.20 to 0.40 µm, median 0.30 µm"),
        ((0.4, 0.0), (0.2, 0.3), "up to 0.40 µm, median 0.25 µm"),
        ((None,), (None,), "not known: no position has enough readings"),
    ],
)
def test_scatter_leaves_out_what_is_not_determined(positive, negative, stated):
    drift = {**PARTS["drift"], "scatter_um": {"positive": positive, "negative": negative}}
    assert dict(summary_rows(assemble("A", {**PARTS, "drift": drift}, [])))["scatter per position"] == stated


def test_plain_predictions_are_last_value_mean_and_the_best_regression():
    results = assemble("A", PARTS, [])
    best = results.loop.model_copy(update={"best_baseline": "mean", "steps": ()})
    rows = dict(summary_rows(results.model_copy(update={"loop": best})))
    assert rows["plain predictions"].count(", ") == 1 and "->" not in rows["held-out error"]
