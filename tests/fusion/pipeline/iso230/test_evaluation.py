"""The part on ISO 230-2: settled and first window, budgets, range."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.campaign.iso_budget import StatedBudget
from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.products.results_axis import Iso230Part
from interferometry.drift.estimate import estimate_drift
from interferometry.iso230 import Iso230Budget
from tests.interferometry.simulated_campaigns import simulate

ASSUMED = StatedBudget(
    Iso230Budget(),
    dict.fromkeys(("device", "alignment", "material_temperature", "expansion_coefficient"), "assumed"),
)


def test_the_settled_window_of_a_warm_up_is_late_and_repeats_better() -> None:
    deviations, _ = simulate(np.random.default_rng(2), kind="warmup", cycles=40)
    drift = estimate_drift(deviations)["drift"]
    windows, settled, found = evaluate_standard(deviations, ASSUMED, drift=drift, material_degC=None)
    part = Iso230Part.model_validate(found)
    assert part.settled is not None and part.first is not None
    assert (part.window, part.first.window) == ("cycles 1 to 5", "cycles 1 to 5")
    assert part.A_um == part.first.A_um
    assert min(part.settled.cycles) > 20 and len(part.settled.cycles) == 5
    assert part.settled.R_um.value < part.first.R_um.value  # type: ignore[operator]
    assert part.range_um["R"].highest == float(windows["R"][:-1].max())
    assert "least drift" in part.settled_rule
    assert float(settled["A"]) == part.settled.A_um.value
    for window in (part.first, part.settled):
        for name in (*"AREMB", "mean_reversal"):
            squares = sum(getattr(entry, f"{name}_um") ** 2 for entry in window.contributions)
            total = window.mean_reversal_um if name == "mean_reversal" else getattr(window, f"{name}_um")
            assert np.sqrt(squares) == pytest.approx(total.u)
            assert window.u_without_sampling_um[name] < total.u  # type: ignore[operator]
    origins = {entry.contributor: entry.origin for entry in part.settled.contributions}
    assert origins["expansion_coefficient"] == "assumed; material at an assumed 3 K from 20 \u00b0C"


def test_without_times_no_environmental_variation_is_claimed() -> None:
    deviations, _ = simulate(np.random.default_rng(2), cycles=4)
    _, _, found = evaluate_standard(deviations, ASSUMED, drift=None, material_degC=None)
    part = Iso230Part.model_validate({**found, "settled": None, "first": None})
    assert part.settled_rule == "the only window of the test"
    entry = next(row for row in found["settled"]["contributions"] if row["contributor"] == "environmental_variation")
    assert np.isnan(entry["u"]) and entry["origin"] == "not known, not contained"
