"""The fitted coefficients against the stated one and against what expansion can do, with the statement's own part taken out of the fit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusion.consistency.checks import Check
from fusion.consistency.coefficients import check_coefficients


def declared(alone: float, alone_u: float, *, moved: float | None = 0.0, stated_u: float = 2.0) -> dict[str, object]:
    """The part of a loop in which readings that ask for `alone` met the statement of 11.7 ppm/K."""
    weight = 1.0 / alone_u**2 + 1.0 / stated_u**2
    value = (alone / alone_u**2 + 11.7 / stated_u**2) / weight
    offset = {"effect": "table_offset", "value": 1.0, "u": 0.1, "unit": "um/K", "jackknife_u": 0.2}
    axis = {"effect": "axis_expansion", "value": value, "u": weight**-0.5, "unit": "ppm/K", "jackknife_u": moved}
    return {"declared_coefficients": [offset, {**axis, "prior": 11.7, "prior_u": stated_u}], "steps": []}


def by_code(loop: dict[str, object], travel_mm: float = 300.0) -> dict[str, Check]:
    return {check.code: check for check in check_coefficients(loop, travel_mm=travel_mm)}


@pytest.mark.parametrize(
    ("alone", "alone_u", "moved", "passed"),
    [
        (11.3, 0.2, 0.0, True),
        (11.3, 3.0, 0.0, True),
        (6.0, 0.14, 0.1, False),
        (-7.7, 0.9, 0.9, False),
        (16.6, 0.3, 0.0, True),
        (17.2, 0.3, 0.0, False),
        # An undeclared effect moves the coefficient from target to target.
        (118.0, 5.0, 61.0, True),
    ],
)
def test_readings_that_contradict_the_statement_are_doubted(
    alone: float, alone_u: float, moved: float, passed: bool
) -> None:
    check = by_code(declared(alone, alone_u, moved=moved))["expansion_coefficient"]
    # The statement's part is taken out exactly.
    assert check.value == pytest.approx((alone - 11.7) / np.sqrt(alone_u**2 + moved**2 + 4.0), rel=1e-6)
    assert check.passed is passed
    assert bool(check.remedy) is not passed


@pytest.mark.parametrize("moved", [None, math.inf])
def test_a_coefficient_that_rests_on_one_target_alone_contradicts_nothing(moved: float | None) -> None:
    check = by_code(declared(40.0, 0.1, moved=moved))["expansion_coefficient"]
    assert check.passed and check.value == 0.0 and "do not determine" in check.evidence


@pytest.mark.parametrize(
    ("effect", "tied"), [("material_compensation", ()), ("thermal_lag", ("material_compensation",))]
)
def test_an_added_error_of_the_compensation_may_be_a_wrong_coefficient(effect: str, tied: tuple[str, ...]) -> None:
    step = {"effect": effect, "tied": tied, "coefficients": []}
    check = check_coefficients({**declared(11.5, 0.2), "steps": [step]}, travel_mm=300.0)[0]
    assert not check.passed and check.evidence.endswith("which a wrong coefficient imitates.")
    assert check_coefficients(
        {**declared(11.5, 0.2), "steps": [{**step, "tied": (), "effect": "dead_path"}]}, travel_mm=300.0
    )[0].passed


def test_readings_that_say_nothing_contradict_nothing() -> None:
    entry = {"effect": "axis_expansion", "value": 11.7, "u": 2.0, "prior": 11.7, "prior_u": 2.0, "unit": "ppm/K"}
    check = by_code({"declared_coefficients": [entry]})["expansion_coefficient"]
    assert check.passed and check.value == 0.0


def test_without_a_declared_expansion_there_is_no_statement_to_contradict() -> None:
    loop = {"declared_coefficients": [{"effect": "table_offset", "value": 1.0, "u": 0.1, "unit": "um/K"}]}
    assert list(by_code(loop)) == ["sensitivity"]
    assert by_code({"declared_coefficients": []}) == {}


def test_no_frame_moves_further_than_it_expands() -> None:
    # A frame of 3 m of 26 ppm/K moves by 78 um/K; five travels of 2 m by 260.
    loop = {"declared_coefficients": [{"effect": "table_offset", "value": -100.0, "u": 5.0, "unit": "um/K"}]}
    doubted = by_code(loop)["sensitivity"]
    assert not doubted.passed and doubted.value == pytest.approx((100.0 - 15.0) / 78.0)
    assert "table offset has -100 µm/K" in doubted.evidence and doubted.remedy
    assert by_code(loop, travel_mm=2000.0)["sensitivity"].passed


def test_the_coefficients_of_added_effects_are_held_against_physics_as_well() -> None:
    lag = {"value": 60.0, "u": 2.0, "unit": "ppm/K"}
    loop = {**declared(11.5, 0.2), "steps": [{"effect": "thermal_lag", "coefficients": [lag]}]}
    check = by_code(loop)["sensitivity"]
    assert not check.passed and check.evidence.startswith("thermal lag has 60 ppm/K")


@pytest.mark.parametrize(
    ("gain", "superfluous", "passed"),
    [
        (-3.0, (), True),
        (7.5, (), True),
        (8.5, (), False),
        (5.0, ("angular_growth",), True),
        (7.0, ("angular_growth",), False),
    ],
)
def test_a_line_that_does_away_with_a_named_cause_needs_less(
    gain: float, superfluous: tuple[str, ...], passed: bool
) -> None:
    line = {
        "alternative": "along a line that runs the other way round from x 200 mm, y 90 mm",
        "gain": gain,
        "gain_limit": 8.0,
        "as_well_ppm_per_K": (11.2, 12.6),
        "expansion_ppm_per_K": 11.5,
        "expansion_u_ppm_per_K": 0.2,
        "superfluous": superfluous,
    }
    check = by_code({"axis_line": line})["axis_line"]
    assert check.passed is passed
    assert by_code({"axis_line": line, "unnamed": {"pitch_error": 1e-17}})["axis_line"].passed
    assert ("ask for 11.2 to 12.6 ppm/K" in check.evidence) is passed
    assert (f"(log-likelihood {gain:+.1f}" in check.evidence) is (gain > 0.0)
    assert ("without angular growth" in check.evidence) is (bool(superfluous) and not passed)
