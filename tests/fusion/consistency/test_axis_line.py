"""The declared line against its alternatives, on a table that is heated near one end: what was planted is what is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from fusion.alignment.align import AxisGeometry, align
from fusion.alignment.readings import read_fused
from fusion.consistency.axis_line import LineComparison, _interpolate, compare_lines
from fusion.consistency.coefficients import check_coefficients
from fusion.effects.library import library
from fusion.loop.axis import declare
from fusion.model.fit import Term, fit_model
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


def compared(fused: xr.Dataset, fields: xr.Dataset, declared: AxisGeometry, *added: Term) -> LineComparison:
    readings = read_fused(fused)
    model = fit_model(readings, [*declare(readings, ["axis_expansion"], library()), *added])
    comparison = compare_lines(model, 1, fields, declared)
    assert comparison is not None
    return comparison


def doubted(comparison: LineComparison) -> bool:
    (check,) = (
        check
        for check in check_coefficients({"axis_line": comparison.as_json()}, travel_mm=180.0)
        if check.code == "axis_line"
    )
    assert check.value == comparison.gain
    return not check.passed


def test_the_true_line_has_no_better_alternative() -> None:
    fields = heated_table()
    comparison = compared(readings_of(fields, TRUE), fields, TRUE)
    assert not doubted(comparison)
    # A likelihood ratio exceeds 500 in two of a thousand tests at most.
    assert comparison.gain_limit >= np.log(500.0)
    low, high = comparison.as_well_ppm_per_K
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


def test_inverted_deviations_are_named() -> None:
    fields = heated_table()
    fused = readings_of(fields, TRUE)
    comparison = compared(fused.assign(deviation=-fused["deviation"]), fields, TRUE)
    assert doubted(comparison) and comparison.alternative == "with deviations of the opposite sign"


def test_targets_from_the_other_end_are_named() -> None:
    fields = heated_table()
    fused = readings_of(fields, TRUE)
    comparison = compared(
        fused.assign(deviation=fused["deviation"].copy(data=fused["deviation"].values[..., ::-1])), fields, TRUE
    )
    assert doubted(comparison) and comparison.alternative == "with the targets numbered from the other end"


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
