"""Campaigns of one machine compared: profiles, scatters, drift per kelvin, and what cannot be compared."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError

from fusion.analysis.comparison import (
    Change,
    ComparisonError,
    Lack,
    ProfileChange,
    compare_profiles,
    compare_scatters,
    find_table_fault,
    predict_here,
    take_out,
)
from fusion.common import Array
from fusion.pipeline.compare import compare_campaigns
from fusion.results.parts import PREDICTION_ENDING, ByDirection, Quantity, TablePrediction
from fusion.results.results import ResultsError
from fusion.results.store import file_sha256, write_dataset
from interferometry.iso230 import evaluate_iso230
from tests.fusion.compared_tests import REPAIRED_MM, drift_of, readings_of, repaired, write_results
from tests.fusion.results_sample import PARTS, RECORD_LOOP
from tests.soak.simulator import deviations_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_results(tmp_path_factory.mktemp("compared") / "before", readings_of(31))


def changed(changes: tuple[Change, ...]) -> list[tuple[str, float | None]]:
    return [(change.quantity, change.position_mm) for change in changes if change.significant and change.machine]


def loop_with(**parts: Any) -> dict[str, Any]:
    return {**copy.deepcopy(PARTS["loop"]), **parts}


def test_values_by_the_standard_do_not_pay_for_the_tests_on_positions(before: Path, tmp_path: Path) -> None:
    """A falls by 3 standard uncertainties: p 0.0027, of five values 0.013, of all positions it would be 0.1."""
    later = copy.deepcopy(PARTS["iso230"])
    later["A_um"] = {"value": 1.0 - 3.0 * 0.1 * 2**0.5, "u": 0.1}
    (pair,) = compare_campaigns([before, write_results(tmp_path / "after", readings_of(32), iso230=later)])
    fallen = next(change for change in pair.changes if change.group == "ISO 230-2" and change.quantity == "A")
    assert fallen.family == 5 and fallen.significant
    assert fallen.p_value == pytest.approx(5 * 0.0027, rel=0.01)
    assert {change.family for change in pair.changes if change.group != "ISO 230-2"} == {pair.tests}


def test_of_two_sound_campaigns_nothing_changed(before: Path, tmp_path: Path) -> None:
    (pair,) = compare_campaigns([before, write_results(tmp_path / "after", readings_of(32))])
    assert changed(pair.changes) == []
    assert {change.group for change in pair.changes} == {"profile", "scatter", "drift per kelvin", "ISO 230-2"}
    assert pair.not_compared == ()


def test_a_repair_is_found_among_three_campaigns(before: Path, tmp_path: Path) -> None:
    sound = write_results(tmp_path / "sound", readings_of(32))
    after = write_results(tmp_path / "after", repaired(readings_of(34), -1.2))
    first, second = compare_campaigns([before, sound, after])
    assert changed(first.changes) == []
    assert changed(second.changes) == [("position", REPAIRED_MM)]
    assert second.tests == first.tests


def test_an_expansion_per_kelvin_is_compared_with_its_uncertainty(before: Path, tmp_path: Path) -> None:
    coefficient = {**PARTS["loop"]["declared_coefficients"][0], "value": 13.0}
    other = write_results(tmp_path / "after", readings_of(32), loop=loop_with(declared_coefficients=[coefficient]))
    (pair,) = compare_campaigns([before, other])
    change = next(change for change in pair.changes if change.quantity == "axis_expansion")
    assert change.significant
    assert change.change.value == pytest.approx(1.4)
    assert change.change.u == pytest.approx(0.2 * 2**0.5)


def test_models_with_other_effects_are_not_compared(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "after", readings_of(32), loop=loop_with(steps=[]))
    (pair,) = compare_campaigns([before, other])
    assert not [change for change in pair.changes if change.group == "drift per kelvin"]
    assert pair.not_compared[0] == Lack("effects", ("step event", "nothing of its own"))


def test_other_targets_leave_the_standard_out(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "after", readings_of(32).isel(target=slice(0, 12)))
    (pair,) = compare_campaigns([before, other])
    assert {Lack("targets"), Lack("left_out", ("4",))} <= set(pair.not_compared)
    assert not [change for change in pair.changes if change.group == "ISO 230-2"]


def test_another_axis_and_a_record_say_why_nothing_is_compared(before: Path, tmp_path: Path) -> None:
    other = write_results(tmp_path / "y", readings_of(32), axis="Y")
    record = write_results(tmp_path / "record", readings_of(32), loop=RECORD_LOOP, iso230=None)
    (record / "deviations.nc").unlink()
    blocks = {
        name: (("time", of), np.zeros((2, 1))) for name, of in (("displacement", "channel"), ("temperature", "sensor"))
    }
    contributed = ("effect", "time", "channel"), np.zeros((1 + len(RECORD_LOOP["steps"]), 2, 1))
    written = xr.Dataset({**blocks, "predicted_u": ("channel", np.zeros(1)), "contribution": contributed})
    write_dataset(record / "fusion.nc", written)
    along_y, recorded = compare_campaigns([before, other, record])
    assert along_y.changes == ()
    assert along_y.not_compared == (Lack("axes", ("X", "Y")),)
    assert [lack.code for lack in recorded.not_compared] == ["kinds"]


@pytest.mark.parametrize("axes", [("", "X"), ("X", "")])
def test_an_axis_that_one_test_does_not_state_is_no_difference_and_is_said(
    tmp_path: Path, axes: tuple[str, str]
) -> None:
    folders = [write_results(tmp_path / f"{k}", readings_of(31 + k), axis=axis) for k, axis in enumerate(axes)]
    (pair,) = compare_campaigns(folders)
    assert pair.profile is not None and {change.group for change in pair.changes} >= {"profile", "scatter", "ISO 230-2"}
    assert [lack.code for lack in pair.not_compared] == ["axis"]


def test_one_folder_or_no_results_are_refused(before: Path, tmp_path: Path) -> None:
    with pytest.raises(ComparisonError, match=r"2 results folders are named, 1 of them different"):
        compare_campaigns([before, before])
    with pytest.raises(ResultsError, match=r"there is no results.json in it"):
        compare_campaigns([before, tmp_path])


# Profiles of two tests.


def estimate(
    rng: np.random.Generator, *, extra: np.ndarray | float = 0.0, components: tuple[str, ...] = ()
) -> xr.Dataset:
    """A profile of eight positions with independent errors of 0.1 um about a bow that is another one in each test."""
    position = np.linspace(0.0, 350.0, 8)
    bow = (
        rng.normal(0.0, 5.0)
        + rng.normal(0.0, 5.0) * position / 350.0
        + rng.normal(0.0, 2.0) * position * (350.0 - position) / 350.0**2
    )
    named = ("shift", "stretch", *components)
    sides = np.array([[0.5], [-0.5]]) * np.ones(8)
    share = np.stack([np.ones((2, 8)), np.ones((2, 8)), *[sides] * len(components)])
    return xr.Dataset(
        {
            "profile": (("direction", "target"), bow + extra + rng.normal(0.0, 0.1, (2, 8))),
            "covariance": (("direction", "target", "other_direction", "other_target"), 0.01 * np.eye(16).reshape(2, 8, 2, 8)),
            "scatter_freedom": (("direction", "target"), np.full((2, 8), 50.0)),
            "drift_share": (("component", "direction", "target"), share),
            "drift_size": ("component", np.ones(len(named))),
            "position": ("target", position),
        },
        coords={"direction": ["positive", "negative"], "target": np.arange(1, 9), "component": list(named)},
    )  # fmt: skip


def moved_positions(found: ProfileChange) -> list[tuple[str, float | None]]:
    """Single positions, steps and blocks that count as changed, and the rest of the profile where it does."""
    return [
        (shape.quantity, shape.position_mm)
        for shape in found.shapes
        if shape.position_mm is not None and (shape is not found.shapes[-1] or shape.p_value * found.tests <= 0.05)
    ]


def test_positions_that_moved_are_told_from_their_neighbours(rng: np.random.Generator) -> None:
    moved = np.zeros((2, 8))
    moved[:, 2], moved[0, 5] = 3.0, 1.5
    found = compare_profiles(estimate(rng), estimate(rng, extra=moved), level=0.05)
    assert set(moved_positions(found)) >= {("position", 100.0)}
    assert {place for _, place in moved_positions(found)} == {100.0, 250.0}
    size = next(shape for shape in found.shapes if shape.position_mm == 100.0)
    assert abs(size.change.value - 3.0) < 4 * size.change.u
    assert all(shape.machine for shape in found.shapes if shape.position_mm is not None)


@pytest.mark.parametrize(
    ("cells", "named"),
    [
        (slice(3, None), [("step", 150.0, None)]),
        (slice(2, 5), [("block", 100.0, 200.0)]),
        (slice(2, 3), [("position", 100.0, None)]),
    ],
)
def test_a_step_and_a_block_are_told_from_a_single_position(
    rng: np.random.Generator, cells: slice, named: list[tuple[str, float, float | None]]
) -> None:
    moved = np.zeros((2, 8))
    moved[:, cells] = 2.0
    found = compare_profiles(estimate(rng), estimate(rng, extra=moved), level=0.05)
    *_, changed, rest = found.shapes
    assert [(changed.quantity, changed.position_mm, changed.until_mm)] == named
    assert abs(changed.change.value - 2.0) < 4 * changed.change.u
    assert rest.quantity == "rest of the profile" and rest.p_value > 0.001


def test_a_profile_that_no_shape_describes_is_said_to_have_changed_most_at_a_place(rng: np.random.Generator) -> None:
    """A wave over the travel: a remainder of known uncertainty, without the steps and blocks that would imitate it."""
    wave = 2.0 * np.sin(4.0 * np.pi * np.arange(8) / 7.0)
    found = compare_profiles(estimate(rng), estimate(rng, extra=wave), level=0.05)
    assert {shape.quantity for shape in found.shapes}.isdisjoint({"step", "block"})
    rest = found.shapes[-1]
    assert rest.p_value * found.tests < 1e-3 and rest.machine
    assert 0.05 < rest.change.u < 0.1


def test_slope_and_bow_are_told_and_are_no_change_of_the_machine(rng: np.random.Generator) -> None:
    bow = np.linspace(-1.0, 1.0, 8)
    found = compare_profiles(estimate(rng), estimate(rng, extra=10.0 * (1.0 - bow**2)), level=0.05)
    shapes = {shape.quantity: shape for shape in found.shapes}
    assert shapes["bow"].p_value < 1e-6
    assert not shapes["bow"].machine and not shapes["slope"].machine


@pytest.mark.parametrize(("components", "machine"), [((), True), (("reversal",), False)])
def test_a_reversal_that_drifts_in_a_test_is_no_change_between_tests(
    rng: np.random.Generator, components: tuple[str, ...], machine: bool
) -> None:
    more = np.array([[0.5], [-0.5]])
    found = compare_profiles(estimate(rng, components=components), estimate(rng, extra=more), level=0.05)
    reversal = next(shape for shape in found.shapes if shape.quantity == "mean reversal")
    assert reversal.machine is machine
    assert reversal.change.value == pytest.approx(1.0, abs=4 * reversal.change.u)


def shaped(rng: np.random.Generator, *, shape: np.ndarray, size_um: float, profile: np.ndarray) -> xr.Dataset:
    """A test whose drift moved in a shape of its own, by a root mean square of so many um; its profile has no noise."""
    test = estimate(rng, components=("shape_1",))
    test["drift_share"][-1], test["drift_size"][-1] = shape, size_um
    return test.assign(profile=(("direction", "target"), np.broadcast_to(profile, (2, 8)).copy()))


@pytest.mark.parametrize("size_um", [0.5, 2.0, 8.0])
def test_a_shape_is_as_uncertain_as_the_profile_over_the_drift_that_told_it(
    rng: np.random.Generator, size_um: float
) -> None:
    """Variance 1.8 C / size^2 of a shape, C that of a profile of both approaches: half of that of the difference, for each of 4^2 um2."""
    shape = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    before = shaped(rng, shape=shape, size_um=size_um, profile=np.zeros(8))
    after = estimate(rng).assign(profile=(("direction", "target"), np.tile(4.0 * shape, (2, 1))))
    found = compare_profiles(before, after, level=0.05)
    exact = compare_profiles(before, after.assign(profile=0.0 * after["profile"]), level=0.05)
    assert found.remaining_u_um / exact.remaining_u_um == pytest.approx(
        np.full(8, np.sqrt(1.0 + 0.5 * 1.8 * 4.0**2 / size_um**2))
    )


@pytest.mark.parametrize(("size_um", "changed"), [(0.5, False), (50.0, True)])
def test_what_a_badly_known_thermal_state_may_make_is_no_change_and_is_told(
    rng: np.random.Generator, size_um: float, changed: bool
) -> None:
    shape = np.array([0.0, 0.1, 0.2, 0.9, 1.0, 0.4, 0.2, 0.0])
    before = shaped(rng, shape=shape, size_um=size_um, profile=np.zeros(8))
    error = 0.6 * (np.arange(8) == 2)
    found = compare_profiles(before, shaped(rng, shape=shape, size_um=size_um, profile=4.0 * shape + error), level=0.05)
    assert bool(moved_positions(found)) is changed
    assert (found.untold is None) is changed
    if found.untold is not None:
        # Offset, slope, bow and shape take a part of the 0.6 um.
        assert found.untold[0] == 100.0 and 0.2 < found.untold[1] < 0.6


def test_positions_of_one_test_alone_are_counted(rng: np.random.Generator) -> None:
    other = estimate(rng)
    other["position"] = other["position"] + xr.where(other["target"] == 8, 3.0, 0.0)
    assert compare_profiles(estimate(rng), other, level=0.05).left_out == 2


def test_other_targets_and_other_approaches_cannot_be_compared(rng: np.random.Generator) -> None:
    shifted = estimate(rng)
    shifted["position"] = shifted["position"] + 1.0
    with pytest.raises(
        ComparisonError, match=r"0 positions are the same within 0.05 mm; 5 are needed .*measure at the same targets"
    ):
        compare_profiles(estimate(rng), shifted, level=0.05)
    forward, backward = estimate(rng), estimate(rng)
    forward["profile"] = forward["profile"].where(forward["direction"] == "positive")
    backward["profile"] = backward["profile"].where(backward["direction"] == "negative")
    with pytest.raises(ComparisonError, match="no direction of approach was measured in both tests"):
        compare_profiles(forward, backward, level=0.05)


# Scatters of two tests.


PLACE = np.linspace(0.0, 300.0, 16)


def sample(rng: np.random.Generator, freedom: int, sigma: np.ndarray | float = 1.0) -> np.ndarray:
    """Standard deviations of 16 positions."""
    return np.asarray(sigma * np.sqrt(rng.chisquare(freedom, 16) / freedom))


def test_a_position_that_repeats_worse_is_found(rng: np.random.Generator) -> None:
    worse = np.ones(16)
    worse[4] = 2.0
    one, other, freedom = sample(rng, 100), sample(rng, 100, worse), np.full(16, 100.0)
    found = compare_scatters(PLACE, one, other, freedom, freedom)
    assert [change.position_mm for change in found if 16 * change.p_value <= 0.05] == [80.0]
    assert found[4].after.value == other[4]


def test_too_few_positions_are_not_compared() -> None:
    few = np.ones(4)
    assert compare_scatters(PLACE[:4], few, few, few * 50, few * 50) == []


def test_a_position_without_scatter_is_left_out(rng: np.random.Generator) -> None:
    one, other = sample(rng, 50), sample(rng, 50)
    one[0], other[1] = 0.0, np.nan
    found = compare_scatters(PLACE, one, other, np.full(16, 50.0), np.full(16, 50.0))
    assert len(found) == 14


def test_an_error_that_both_tests_have_in_common_cancels_as_far_as_it_is_equal(tmp_path: Path) -> None:
    """u² = 3² + 5² - 2 · 2.4 · 4.5 with the coefficient alone in common, and 1 · 1 less twice for each input of one set-up."""

    def part(u: float, share: float, coefficient: str) -> dict[str, Any]:
        row = {
            "u": 1.0,
            "unit": "ppm",
            "origin": "assumed",
            **dict.fromkeys(("R_um", "E_um", "M_um", "B_um", "mean_reversal_um"), 0.0),
        }
        shares = {"expansion_coefficient": share, "device": 1.0, "alignment": 1.0, "material_temperature": 1.0}
        rows = [{**row, "contributor": name, "A_um": value} for name, value in shares.items()]
        stated = {
            **PARTS["iso230"],
            # A window without the numbers of its cycles: its thermal state is not known.
            "cycles": [],
            "conditions": [{"key": "expansion_coefficient", "name": "Reworded", "text": coefficient}],
        }
        return {**stated, "A_um": {"value": 2 * u, "u": u}, "contributions": rows}

    def u_of(folders: list[Path], *, same_setup: bool = False) -> float:
        (pair,) = compare_campaigns(folders, same_setup=same_setup)
        return next(one.change.u for one in pair.changes if one.group == "ISO 230-2" and one.quantity == "A")

    readings = readings_of(31)
    one, other, steel = (
        write_results(tmp_path / name, readings, iso230=part(u, share, text))
        for name, u, share, text in (
            ("a", 3.0, 2.4, "11.7 ppm/K"),
            ("b", 5.0, 4.5, "11.7 ppm/K"),
            ("c", 5.0, 4.5, "10 ppm/K"),
        )
    )
    assert u_of([one, other]) == pytest.approx((34.0 - 21.6) ** 0.5)
    assert u_of([one, other], same_setup=True) == pytest.approx((34.0 - 21.6 - 6.0) ** 0.5)
    assert u_of([one, steel]) == pytest.approx(34.0**0.5)


def table_of(size_um: float) -> TablePrediction:
    """A table of steps and of a reversal that grows along the axis, which no thermal state looks like."""
    at = np.arange(0.0, 301.0, 20.0)
    mean = size_um * np.where((at > 90.0) & (at < 210.0), 1.0, -1.0) * np.where(at < 160.0, 1.0, 0.3)
    sides = ByDirection(positive=tuple(mean + at / 300.0), negative=tuple(mean - at / 300.0))
    return TablePrediction(
        table="x.comp", campaign="", results_sha256="0" * 64, cycles=5, predicted_um={}, position_mm=tuple(at), correction_um=sides
    )  # fmt: skip


def test_a_table_of_metres_is_damaged():
    assert table_of(9e4).correction_um.positive[0] == pytest.approx(-9e4)
    with pytest.raises(ValidationError, match="is not below 100000"):
        table_of(1e308)


@pytest.mark.parametrize(
    ("act", "name"),
    [
        (lambda at, table: table(at), None),
        (lambda at, table: 0.0 * table(at), "not active"),
        (lambda at, table: -table(at), "wrong sign"),
        (lambda at, table: 0.5 * table(at), "half the gain"),
        (lambda at, table: 3.0 * table(at), "wrong scale"),
        (lambda at, table: table(at)[::-1], "approaches swapped"),
        (lambda at, table: table(300.0 - at), "mirrored"),
        (lambda at, table: table(at - 40.0), "shifted by +39 mm"),
    ],
)
def test_what_a_table_did_is_named_and_a_right_one_is_no_change(act, name) -> None:
    """Shifts are tried in hundredths of the range, 3 mm."""
    table, before, after = table_of(3.0), drift_of(readings_of(31)), drift_of(readings_of(32))
    at = after["position"].values.astype(float)
    taken = act(at, lambda place: np.array(table.correction_at(place)))
    after = after.assign(profile=after["profile"] - xr.DataArray(taken, dims=("direction", "target")))
    found = find_table_fault(before, after, table)
    assert found.told and found.names[:1] == (() if name is None else (name,))
    changed = compare_profiles(take_out(before, table), after, level=0.05)
    moved = any(shape.machine and shape.p_value * changed.tests <= 0.05 for shape in changed.shapes)
    assert moved == (name is not None)


def test_a_table_of_what_a_thermal_state_changes_is_not_told() -> None:
    """A table that corrects a slope alone: without it the axis looks as with it, in another thermal state."""
    at = (0.0, 300.0)
    sides = ByDirection(positive=(0.0, 4.0), negative=(0.0, 4.0))
    table = table_of(0.0).model_copy(update={"position_mm": at, "correction_um": sides})
    found = find_table_fault(drift_of(readings_of(31)), drift_of(readings_of(32)), table)
    assert not found.told and found.names == ()


def test_a_test_in_another_thermal_state_is_predicted_in_its_own() -> None:
    """A stretch of 4 um that is half there in the first test and whole in the second: E with a table that takes the first profile out."""
    rng, cycles = np.random.default_rng(12), 8
    position = np.linspace(0.0, 300.0, 9)
    seconds = 300.0 * np.arange(cycles)[:, None, None] + 8.0 * np.stack([np.arange(9.0), 17.0 - np.arange(9.0)])

    def measured(profile: Array, reached: Array) -> tuple[xr.Dataset, xr.Dataset]:
        noise = 0.1 * rng.standard_normal(seconds.shape)
        readings = deviations_of(seconds, position, profile + 4.0 * reached * position / 300.0 + noise)
        return readings, drift_of(readings)

    warming = 1.0 - np.exp(-seconds / 1500.0)
    _, before = measured(np.zeros((2, 9)), warming)
    table = before["profile"].values
    readings, after = measured(-table, np.ones(seconds.shape))
    stated = TablePrediction(
        table="x.comp", campaign="", results_sha256="0" * 64, cycles=5, position_mm=tuple(position), predicted_um={},
        correction_um=ByDirection(positive=tuple(table[0]), negative=tuple(table[1])),
    )  # fmt: skip
    e = predict_here(before, after, stated, range(1, 6))["E"]
    achieved = float(evaluate_iso230(readings, cycles=range(1, 6))["E"])
    # The first test lay 4 exp(-t/1500 s) below, in the mean over its time 1.9 um at the far end.
    assert achieved > 1.2 and abs(achieved - e.value) < 3.0 * e.u < 0.5
    assert (
        predict_here(before, after.isel(target=slice(1, None), other_target=slice(1, None)), stated, range(1, 6)) == {}
    )
    assert predict_here(before, after, stated, ()) == {}


def test_achieved_is_held_against_what_a_table_was_predicted_to_leave(tmp_path: Path) -> None:
    """The coefficient adds 4 um to u(A) = 5 um of either test: in common, it leaves 3 um of the second test and 1 um of the prediction."""

    def part(a_um: float, coefficient: str) -> dict[str, Any]:
        row = {"contributor": "expansion_coefficient", "u": 2.0, "unit": "ppm/K", "origin": "assumed", "A_um": 4.0}
        shares = dict.fromkeys(("R_um", "E_um", "M_um", "B_um", "mean_reversal_um"), 0.0)
        stated = {
            **PARTS["iso230"],
            # A window without the numbers of its cycles: its thermal state is not known.
            "cycles": [],
            "conditions": [{"key": "expansion_coefficient", "name": "Reworded", "text": coefficient}],
        }
        return {
            **stated,
            "A_um": {"value": a_um, "u": 5.0},
            "contributions": [{**row, **shares}],
        }

    readings = readings_of(31)
    before = write_results(tmp_path / "before", readings, iso230=part(20.0, "11.7 ppm/K"))
    table = tmp_path / "compensation_X.comp"

    def predict(folder: Path) -> None:
        prediction = TablePrediction(
            table=table.name, campaign="", results_sha256=file_sha256(folder / "results.json"), cycles=5,
            position_mm=(0.0, 400.0), correction_um=ByDirection(positive=(0.0, 0.0), negative=(0.0, 0.0)),
            predicted_um={"A": Quantity(value=2.0, u=1.0)},
        )  # fmt: skip
        table.with_name(table.name + PREDICTION_ENDING).write_text(prediction.model_dump_json())

    predict(before)
    as_predicted, missed, steel = (
        write_results(tmp_path / name, readings, iso230=part(a_um, text))
        for name, a_um, text in (("a", 8.0, "11.7 ppm/K"), ("b", 10.0, "11.7 ppm/K"), ("c", 10.0, "10 ppm/K"))
    )
    found = [compare_campaigns([before, one], applied=table)[0].achieved[0] for one in (as_predicted, missed, steel)]
    assert [one.difference.value for one in found] == pytest.approx([6.0, 8.0, 8.0])
    assert [one.difference.u for one in found] == pytest.approx([10.0**0.5, 10.0**0.5, 42.0**0.5])
    assert [one.as_predicted for one in found] == [True, False, True]
    with pytest.raises(ComparisonError, match="a table stands between two tests"):
        compare_campaigns([before, as_predicted, missed], applied=table)
    with pytest.raises(ComparisonError, match="was not made from the results in"):
        compare_campaigns([as_predicted, missed], applied=table)
