from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.comparison.profile_changes import ComparisonError, ProfileChange, compare_profiles
from tests.fusion.compared_tests import REPAIRED_MM, drift_of, readings_of, repaired


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
            "position": ("target", position),
        },
        coords={"direction": ["positive", "negative"], "target": np.arange(1, 9), "component": list(named)},
    )  # fmt: skip


def changed(found: ProfileChange) -> list[tuple[str, float | None]]:
    """Single positions that count as changed."""
    return [(shape.shape, shape.position_mm) for shape in found.shapes if shape.position_mm is not None]


def test_another_thermal_state_changes_no_position(rng: np.random.Generator) -> None:
    """Nominal 5 %: of 100 pairs at most 11 (a binomial count exceeds that once in a hundred such tests)."""
    alarms = sum(bool(changed(compare_profiles(estimate(rng), estimate(rng), level=0.05))) for _ in range(100))
    assert alarms <= 11


def test_positions_that_moved_are_told_from_their_neighbours(rng: np.random.Generator) -> None:
    moved = np.zeros((2, 8))
    moved[:, 2], moved[0, 5] = 3.0, 1.5
    found = compare_profiles(estimate(rng), estimate(rng, extra=moved), level=0.05)
    assert set(changed(found)) >= {("position", 100.0)}
    assert {place for _, place in changed(found)} == {100.0, 250.0}
    size = next(shape for shape in found.shapes if shape.position_mm == 100.0)
    assert abs(size.change_um - 3.0) < 4 * size.u_um
    assert all(shape.machine for shape in found.shapes if shape.position_mm is not None)


def test_slope_and_bow_are_told_and_are_no_change_of_the_machine(rng: np.random.Generator) -> None:
    bow = np.linspace(-1.0, 1.0, 8)
    found = compare_profiles(estimate(rng), estimate(rng, extra=10.0 * (1.0 - bow**2)), level=0.05)
    shapes = {shape.shape: shape for shape in found.shapes}
    assert shapes["bow"].p_value < 1e-6
    assert not shapes["bow"].machine and not shapes["slope"].machine


@pytest.mark.parametrize(("components", "machine"), [((), True), (("reversal",), False)])
def test_a_reversal_that_drifts_in_a_test_is_no_change_between_tests(
    rng: np.random.Generator, components: tuple[str, ...], machine: bool
) -> None:
    more = np.array([[0.5], [-0.5]])
    found = compare_profiles(estimate(rng, components=components), estimate(rng, extra=more), level=0.05)
    reversal = next(shape for shape in found.shapes if shape.shape == "mean reversal")
    assert reversal.machine is machine
    assert reversal.change_um == pytest.approx(1.0, abs=4 * reversal.u_um)


def test_what_remains_has_no_slope_and_its_uncertainty(rng: np.random.Generator) -> None:
    found = compare_profiles(estimate(rng), estimate(rng), level=0.05)
    assert np.polyfit(found.position_mm, found.remaining_um, 1) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert (found.remaining_u_um < 0.1).all()


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


def test_a_repair_is_found_between_two_tests_of_the_twin_and_nothing_else() -> None:
    before, after = readings_of(31), readings_of(32, duty="constant")
    assert changed(compare_profiles(drift_of(before), drift_of(after), level=0.05)) == []
    found = compare_profiles(drift_of(before), drift_of(repaired(after, 1.0)), level=0.05)
    assert changed(found) == [("position", REPAIRED_MM)]
    size = next(shape for shape in found.shapes if shape.position_mm == REPAIRED_MM)
    assert size.change_um == pytest.approx(1.0, abs=4 * size.u_um)
