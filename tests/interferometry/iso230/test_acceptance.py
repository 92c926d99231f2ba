"""Decisions about tolerances at and beside their borders."""

from __future__ import annotations

import pytest

from interferometry.iso230.acceptance import decide


@pytest.mark.parametrize(
    ("value", "u", "decision"),
    [
        (8.0, 2.0, "pass"),
        (8.01, 2.0, "not decided within the uncertainty"),
        (12.0, 2.0, "not decided within the uncertainty"),
        (12.01, 2.0, "fail"),
        (10.0, 0.0, "pass"),
    ],
)
def test_the_uncertainty_counts_against_whoever_claims_the_result(value: float, u: float, decision: str) -> None:
    assert decide(value, u, 10.0) == decision
