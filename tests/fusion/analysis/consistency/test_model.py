"""The declared line against its alternatives, on a table that is heated near one end: what was planted is what is named."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.alignment.align import AxisGeometry, align
from fusion.analysis.alignment.readings import read_fused
from fusion.analysis.consistency.checks import Inputs
from fusion.analysis.consistency.model import _interpolate, compare_lines, with_line, withhold_names
from fusion.analysis.drift_model.axis import declare
from fusion.analysis.drift_model.model import Term, fit_model
from fusion.analysis.effects.library import library
from fusion.pipeline.consistency import Check, run_checks
from fusion.results.loop import AxisLine, AxisLoop, AxisUnexplained
from tests.fusion.loops import added, coefficient, declared, declared_one, line, loop
from tests.fusion.small_campaign import term

START = np.datetime64("2026-03-09T08:00", "ns")
CYCLES, POSITIONS = 30, np.array([0.0, 60.0, 120.0, 180.0])
TRUE = AxisGeometry((100.0, 20.0), (1.0, 0.0))
PPM_PER_K = 11.7


def heated_table() -> xr.Dataset:
    """A plan of 400 mm whose end at x = 100 mm is warmed by a load that switches; one frame per cycle of 200 s."""
    load = np.random.default_rng(3).random(CYCLES + 1)
    rise = np.convolve(load, 0.7 ** np.arange(8))[: CYCLES + 1]
    x, y = 10.0 * np.arange(41), 10.0 * np.arange(5)
    spot = np.exp(-0.5 * ((x - 100.0) / 60.0) ** 2)
    frames = 20.0 + 4.0 * rise[:, None, None] * spot * np.ones((1, y.size, 1))
    time = START + (200 * np.arange(CYCLES + 1)).astype("timedelta64[s]")
    return xr.Dataset({"frame_temperature": (("time", "y", "x"), frames)}, {"time": time, "y": y, "x": x})


def readings_of(fields: xr.Dataset, declared: AxisGeometry) -> xr.Dataset:
    """Readings of a machine whose line is the true one, beside the declared one."""
    dims = ("cycle", "direction", "target")
    seconds = 200.0 * np.arange(CYCLES)[:, None, None] + 10.0 * np.arange(8.0).reshape(1, 2, 4)
    empty = xr.Dataset({name: (dims, np.zeros((CYCLES, 2, 4))) for name in ("deviation", "quality_flag")})
    empty["time"] = dims, START + (1e9 * seconds).astype("timedelta64[ns]")
    empty["position"] = "target", POSITIONS
    empty = empty.assign_coords(
        cycle=np.arange(1, CYCLES + 1), direction=["positive", "negative"], target=np.arange(1, 5)
    )
    moved = PPM_PER_K * 1e-3 * align(empty, fields, TRUE)["axis_integral"].values
    noise = 0.05 * np.random.default_rng(1).standard_normal(moved.shape)
    return align(empty.assign(deviation=(dims, moved + noise)), fields, declared)


def compared(fused: xr.Dataset, fields: xr.Dataset, declared: AxisGeometry, *added: Term) -> AxisLine:
    readings = read_fused(fused)
    model = fit_model(readings, [*declare(readings, ["axis_expansion"], library()), *added])
    comparison = compare_lines(model, 1, fields, declared)
    assert comparison is not None
    return comparison


def doubted(comparison: AxisLine) -> bool:
    (check,) = (
        check for check in run_checks("loop", Inputs(loop=loop(axis_line=comparison))) if check.code == "axis_line"
    )
    assert check.value == comparison.gain
    return not check.passed


@pytest.mark.long
def test_the_true_line_has_no_better_alternative() -> None:
    fields = heated_table()
    comparison = compared(readings_of(fields, TRUE), fields, TRUE)
    assert not doubted(comparison)
    # A likelihood ratio exceeds 500 in two of a thousand tests at most.
    assert comparison.gain_limit >= np.log(500.0)
    low, high = comparison.alternative_ppm_per_K
    assert low <= PPM_PER_K + 0.3 and high >= PPM_PER_K - 0.3


def test_on_a_table_that_warms_evenly_the_lines_that_explain_as_well_are_not_doubted() -> None:
    fields = heated_table()
    even = fields.assign(
        frame_temperature=0.0 * fields["frame_temperature"] + fields["frame_temperature"].mean(["y", "x"])
    )
    comparison = compared(readings_of(even, AxisGeometry((200.0, 20.0), (1.0, 0.0))), even, TRUE)
    assert not doubted(comparison)


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        (AxisGeometry((280.0, 20.0), (-1.0, 0.0)), "the other way round from x 100 mm, y 20 mm"),
        (AxisGeometry((200.0, 20.0), (1.0, 0.0)), "the same way from x 100 mm, y 20 mm"),
    ],
)
def test_a_line_drawn_wrong_is_doubted_and_the_true_one_named(declared: AxisGeometry, words: str) -> None:
    fields = heated_table()
    comparison = compared(readings_of(fields, declared), fields, declared)
    assert doubted(comparison)
    assert comparison.alternative.endswith(words)
    assert comparison.expansion_ppm_per_K == pytest.approx(PPM_PER_K, abs=3.0 * comparison.expansion_u_ppm_per_K)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda values: -values, "with deviations of the opposite sign"),
        (lambda values: values[..., ::-1], "with the targets numbered from the other end"),
    ],
)
def test_inverted_deviations_and_targets_from_the_other_end_are_named(change, words: str) -> None:
    fields = heated_table()
    fused = readings_of(fields, TRUE)
    changed = fused["deviation"].copy(data=change(fused["deviation"].values))
    comparison = compared(fused.assign(deviation=changed), fields, TRUE)
    assert doubted(comparison) and comparison.alternative == words


def test_an_effect_that_imitates_the_wrong_line_is_named_as_superfluous() -> None:
    fields, wrong = heated_table(), AxisGeometry((280.0, 20.0), (-1.0, 0.0))
    fused = readings_of(fields, wrong)
    readings = read_fused(fused)
    true_column = readings.at(read_fused(readings_of(fields, TRUE)).series["axis_integral"]) * 1e-3
    imitated = term(true_column + 0.002 * np.random.default_rng(5).standard_normal(true_column.size), "angular_growth")
    comparison = compared(fused, fields, wrong, imitated)
    assert comparison.superfluous == ("angular_growth",)


def test_without_an_expected_expansion_nothing_is_compared() -> None:
    fields = heated_table()
    readings = read_fused(readings_of(fields, TRUE))
    (expansion,) = declare(readings, ["axis_expansion"], library())
    free = Term(expansion.effect, replace(expansion.candidate, prior=None))
    assert compare_lines(fit_model(readings, [free]), 1, fields, TRUE) is None
    assert compare_lines(fit_model(readings, []), 0, fields, TRUE) is None


def test_rows_are_interpolated_between_their_places_and_at_both_ends() -> None:
    places, known = np.array([-1.0, 0.0, 4.0]), np.array([[2.0, 4.0, 0.0], [0.0, 1.0, 9.0]])
    found = _interpolate(np.array([-1.0, -0.5, 0.0, 1.0, 4.0]), places, known)
    np.testing.assert_allclose(found, [[2.0, 3.0, 4.0, 3.0, 0.0], [0.0, 0.5, 1.0, 3.0, 9.0]])


# The fitted coefficients against the stated one and against what expansion can do, with the statement's own part taken out of the fit.


def by_code(found: AxisLoop, travel_mm: float = 300.0) -> dict[str, Check]:
    return {check.code: check for check in run_checks("loop", Inputs(loop=found, travel_mm=travel_mm))}


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
    check = by_code(loop(*declared(alone, alone_u, moved=moved)))["expansion_coefficient"]
    # The statement's part is taken out exactly.
    assert check.value == pytest.approx((alone - 11.7) / np.sqrt(alone_u**2 + moved**2 + 4.0), rel=1e-6)
    assert check.passed is passed
    assert bool(check.remedy) is not passed


@pytest.mark.parametrize("moved", [None, math.inf])
def test_a_coefficient_that_rests_on_one_target_alone_contradicts_nothing(moved: float | None) -> None:
    check = by_code(loop(*declared(40.0, 0.1, moved=moved)))["expansion_coefficient"]
    assert check.passed and check.value == 0.0 and "do not determine" in check.evidence


@pytest.mark.parametrize(
    ("effect", "tied"), [("material_compensation", ()), ("thermal_lag", ("material_compensation",))]
)
def test_an_added_error_of_the_compensation_may_be_a_wrong_coefficient(effect: str, tied: tuple[str, ...]) -> None:
    stated = declared(11.5, 0.2)
    check = by_code(loop(*stated, steps=(added(effect, tied=tied),)))["expansion_coefficient"]
    assert not check.passed and check.evidence.endswith("which a wrong coefficient imitates.")
    assert by_code(loop(*stated, steps=(added("dead_path"),)))["expansion_coefficient"].passed


def test_readings_that_say_nothing_contradict_nothing() -> None:
    check = by_code(loop(declared_one("axis_expansion", 11.7, 2.0, prior=11.7, prior_u=2.0)))["expansion_coefficient"]
    assert check.passed and check.value == 0.0


def test_without_a_declared_expansion_there_is_no_statement_to_contradict() -> None:
    assert list(by_code(loop(declared_one("table_offset", 1.0, 0.1, "um/K")))) == ["sensitivity"]
    assert by_code(loop()) == {}


def test_no_frame_moves_further_than_it_expands() -> None:
    # A frame of 3 m of 26 ppm/K moves by 78 um/K; five travels of 2 m by 260.
    found = loop(declared_one("table_offset", -100.0, 5.0, "um/K"))
    doubted = by_code(found)["sensitivity"]
    assert not doubted.passed and doubted.value == pytest.approx((100.0 - 15.0) / 78.0)
    assert "table offset has -100 µm/K" in doubted.evidence and doubted.remedy
    assert by_code(found, travel_mm=2000.0)["sensitivity"].passed


def test_a_stage_of_polymer_may_expand_as_it_is_stated() -> None:
    assert by_code(loop(declared_one("axis_expansion", 92.0, 2.0, prior=90.0, prior_u=5.0)))["sensitivity"].passed


def test_the_coefficients_of_added_effects_are_held_against_physics_as_well() -> None:
    found = loop(*declared(11.5, 0.2), steps=(added("thermal_lag", coefficient(60.0, 2.0)),))
    check = by_code(found)["sensitivity"]
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
    other = line(
        alternative="along a line that runs the other way round from x 200 mm, y 90 mm",
        gain=gain,
        alternative_ppm_per_K=(11.2, 12.6),
        superfluous=superfluous,
    )
    check = by_code(loop(axis_line=other))["axis_line"]
    assert check.passed is passed
    assert by_code(loop(axis_line=other, unconfirmed_effects={"pitch_error": 1e-17}))["axis_line"].passed
    assert ("indicate 11.2 to 12.6 ppm/K" in check.evidence) is passed
    assert (f"(log-likelihood {gain:+.1f}" in check.evidence) is (gain > 0.0)
    assert ("without angular growth" in check.evidence) is (bool(superfluous) and not passed)
    # 11.2 to 12.6 ppm/K differ by more than a tenth.
    assert check.verified is not passed and ("Line not verified" in check.evidence) is passed


def test_lines_that_fit_as_well_are_part_of_the_uncertainty_of_the_expansion() -> None:
    entry = declared_one("axis_expansion", 16.0, 0.5, u_fit=0.4, prior=11.7, prior_u=2.0)
    offset = declared_one("table_offset", 16.0, 0.5, "um/K", u_fit=0.4)
    # The readings alone ask for 11 ppm/K along the other line, and with the one that was expected for a little more.
    u_line = (16.0 - (0.96 * 11.0 + 0.04 * 11.7)) / math.sqrt(3.0)
    far, beside = with_line(
        loop(entry, offset, axis_line=line(alternative_ppm_per_K=(11.0, 16.2)))
    ).declared_coefficients
    assert (far.u, far.u_line) == pytest.approx((math.hypot(0.5, u_line), u_line))
    assert far.model_copy(update={"u": 0.5, "u_line": None}) == entry and beside == offset
    for same in (loop(entry, axis_line=line(alternative_ppm_per_K=(15.0, 16.2))), loop(entry)):
        assert with_line(same) is same


def test_a_shape_along_the_axis_is_withheld_where_the_expansion_beside_it_is_not_told() -> None:
    steps = (added("unseen_heat_source"), added("pitch_error"))
    found = withhold_names(loop(*declared(11.5, math.inf), steps=steps), library())
    assert [bool(step.withheld) for step in found.steps] == [False, True]


@pytest.mark.parametrize(("value", "withheld"), [(11.5, False), (2.1, True)])
def test_names_of_courses_and_shapes_are_withheld_where_the_expansion_contradicts(value: float, withheld: bool) -> None:
    steps = (added("unseen_heat_source"), added("angular_growth"), added("dead_path"))
    found = withhold_names(loop(*declared(value, 0.2), steps=steps), library())
    assert [bool(step.withheld) for step in found.steps] == [withheld, withheld, False]
    assert found.verdict == "partial"


@pytest.mark.parametrize(
    ("p_value", "rms_um", "verdict"), [(0.001, 0.4, "unexplained"), (0.001, 0.2, "partial"), (0.5, 0.4, "partial")]
)
def test_a_name_is_withheld_beside_structure_that_is_larger(p_value: float, rms_um: float, verdict: str) -> None:
    left = AxisUnexplained.model_construct(shape="one step; targets 3, 5", rms_um=rms_um, p_value=p_value)
    found = withhold_names(loop(unexplained=left, steps=(added("dead_path"),)), library())
    assert found.verdict == verdict and bool(found.steps[0].withheld) == (verdict == "unexplained")
    event = added("dead_path", parameters={"time_s": 60.0})
    assert not withhold_names(loop(unexplained=left, steps=(event,)), library()).steps[0].withheld
