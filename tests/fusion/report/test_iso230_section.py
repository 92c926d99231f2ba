"""The section on ISO 230-2: values, budget, what the uncertainty contains."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.pipeline.iso230.evaluation import evaluate_standard
from fusion.products.results_axis import Iso230Part
from fusion.products.store import plain
from fusion.report.iso230_section import contained_sentence, describe_iso230
from interferometry.drift.estimate import estimate_drift
from tests.fusion.pipeline.iso230.test_evaluation import ASSUMED
from tests.interferometry.simulated_campaigns import simulate


@pytest.fixture(scope="module")
def part() -> Iso230Part:
    deviations, _ = simulate(np.random.default_rng(2), kind="warmup", cycles=40)
    drift = estimate_drift(deviations)["drift"]
    return Iso230Part.model_validate(plain(evaluate_standard(deviations, ASSUMED, drift=drift, material_degC=None)[2]))


def test_the_settled_window_stands_beside_the_first_one(part: Iso230Part) -> None:
    told = describe_iso230(part)
    titles = [column.title for column in told["axis"].columns]
    assert titles[1].startswith(part.settled.window)  # type: ignore[union-attr]
    assert titles[2].startswith("First window, cycles 1 to 5")
    assert titles[3].startswith("Range over windows without overlap")
    ranges = [row.cells[3] for row in told["axis"].rows]
    assert " to " in ranges[0] and ranges[1] == ranges[2] == ranges[-1] == "\u2013"
    terms = [row.cells[0] for row in told["axis"].rows]
    assert terms[:3] == [
        "Bidirectional positioning accuracy A",
        "Unidirectional positioning accuracy A\u2191",
        "Unidirectional positioning accuracy A\u2193",
    ]
    assert terms[-1] == "Mean reversal error, with its sign"


def test_the_budget_ends_with_both_sums(part: Iso230Part) -> None:
    rows = describe_iso230(part)["budget"].rows
    assert [row.cells[0] for row in rows[-2:]] == ["U (k = 2) without the sampling of the cycles", "U (k = 2)"]
    assert float(rows[-1].cells[3]) == pytest.approx(2 * part.settled.A_um.u, rel=0.06)  # type: ignore[union-attr, operator]


def test_what_is_assumed_and_what_is_missing_is_said(part: Iso230Part) -> None:
    assert part.settled is not None
    sentence = contained_sentence(part.settled)
    assert "laser with its air compensation 0.25 ppm (assumed)" in sentence
    assert "can be stated under [interferometry.uncertainty]" in sentence
    assert "does not contain the environmental variation" not in sentence
    unknown = [
        entry.model_copy(update={"u": None}) if entry.contributor == "environmental_variation" else entry
        for entry in part.settled.contributions
    ]
    sentence = contained_sentence(part.settled.model_copy(update={"contributions": tuple(unknown)}))
    assert "It does not contain the environmental variation" in sentence


def test_results_of_an_older_run_show_their_only_window(part: Iso230Part) -> None:
    told = describe_iso230(part.model_copy(update={"settled": None}))
    assert told["budget"] is None and told["window"] == "cycles 1 to 5"
    assert len(told["axis"].rows) == 5
