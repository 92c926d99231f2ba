"""Conditions that the standard asks of a test, and decisions within the uncertainty."""

import numpy as np
import pytest
import xarray as xr

from interferometry.deviations import build_deviations
from interferometry.drift.planning import Settling
from interferometry.iso230.conditions import ConditionCheck, check_conditions

CYCLES = [1, 2, 3, 4, 5]


def at_positions(position, cycles=5):
    """A test at these positions, one cycle in 10 min."""
    shape = (cycles, 2, len(position))
    seconds = 600.0 * np.arange(cycles)[:, None, None] + np.arange(2 * len(position)).reshape(1, 2, -1)
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    return build_deviations(
        range(1, cycles + 1), range(1, len(position) + 1), np.array(position), np.zeros(shape), time
    )


def found(deviations: xr.Dataset, **options: object) -> dict[str, ConditionCheck]:
    checks = check_conditions(deviations, cycles=CYCLES, **options)
    names = ("targets", "travel", "spacing", "cycles", "completeness", "settled")
    return dict(zip(names, checks, strict=True))


def test_a_test_as_the_standard_asks_for_it():
    checks = found(at_positions([0.0, 107.0, 195.0, 310.0, 402.0]), lead_mm=10.0, settling=[])
    assert all(check.met for check in checks.values())
    assert checks["spacing"].evidence == "Spacings of 88 to 115 mm."
    assert checks["travel"].evidence == "Measured travel 402 mm."


def test_too_few_targets_and_equal_spacings_are_told():
    checks = found(at_positions(list(np.linspace(0.0, 2500.0, 7) + 3.0 * np.arange(7) ** 2)))
    assert checks["targets"].met is False and "required: 14" in checks["targets"].evidence
    assert checks["travel"].met is False and "targets about 250 mm apart" in checks["travel"].evidence
    assert checks["settled"].met is None
    equal = at_positions([0.0, 25.0, 50.0, 75.0, 100.0, 125.0])
    assert "All spacings are 25 mm" in found(equal)["spacing"].evidence
    assert "whole number of leads (5 mm)" in found(equal, lead_mm=5.0)["spacing"].evidence
    assert "All spacings" in found(equal, lead_mm=10.0)["spacing"].evidence
    assert found(equal)["targets"].met and found(equal)["spacing"].met is False
    deviations = at_positions([0.0, 20.0, 45.0, 70.0, 100.0])
    deviations["deviation"][2, 1, 3] = np.nan
    assert found(deviations)["completeness"].evidence == "1 of 50 readings of the window are missing."
    assert check_conditions(deviations, cycles=[1, 2, 3])[3].met is False
    deviations["deviation"][:, 1] = np.nan
    one_side = found(deviations)["completeness"]
    assert not one_side.met and one_side.evidence == "The targets were approached from one side only."
    assert "too few" in found(deviations)["settled"].evidence
    deviations["time"][:] = np.datetime64("NaT", "ns")
    assert "Without times" in found(deviations)["settled"].evidence


@pytest.mark.parametrize(("travel_deg", "least"), [(90.0, 3), (90.5, 5), (180.0, 5), (180.5, 8)])
def test_targets_of_a_rotary_axis_go_by_its_travel(travel_deg, least):
    for targets in (least - 1, least, least + 1):
        deviations = at_positions(np.linspace(0.0, travel_deg, targets))
        deviations["position"].attrs["units"] = "deg"
        met = [check.met for check in check_conditions(deviations, cycles=CYCLES)]
        assert met == [targets >= least, True, True]


@pytest.mark.parametrize("start_mm", [0.0, 0.1, 0.3])
def test_five_targets_per_metre_are_enough_on_every_travel(start_mm):
    for targets in range(5, 11):
        checks = found(at_positions(np.linspace(start_mm, start_mm + 200.0 * targets, targets)))
        assert checks["targets"].met and checks["travel"].met


@pytest.mark.parametrize(("t95_s", "met"), [(1000.0, True), (1400.0, False)])
def test_the_window_must_begin_after_the_warm_up(t95_s, met):
    deviations = at_positions([0.0, 20.0, 45.0, 70.0, 100.0], cycles=7)
    settling = Settling("stretch", t95_s, 720.0, np.inf, 4.0)
    check = check_conditions(deviations, cycles=[3, 4, 5, 6, 7], settling=[settling])[-1]
    # Cycle 3 begins 1200 s after the first reading.
    assert check.met is met
    assert "(95 % confidence: 0.2 to longer than the test can show); the window begins after 0.3 h." in check.evidence


def test_an_axis_that_drifts_without_an_end_is_not_called_warmed_up():
    deviations = at_positions([0.0, 107.0, 195.0, 310.0, 402.0])
    # Scatter without a slope.
    deviations["deviation"] += xr.DataArray([7.3, 6.7, 7.0, 6.7, 7.3], dims="cycle")
    assert found(deviations, settling=[])["settled"].met
    # 2 um at the far end over the five cycles, as a warm-up that has hardly begun; its end position shows it best.
    deviations["deviation"] += xr.DataArray(np.arange(5) / 2.0, dims="cycle") * deviations["position"] / 402.0
    check = found(deviations, settling=[])["settled"]
    assert check.met is False and "by up to 2 µm" in check.evidence and "p < 0.01" in check.evidence


def test_scatter_alone_is_seldom_called_a_trend():
    rng = np.random.default_rng(6)
    deviations = at_positions([0.0, 107.0, 195.0, 310.0, 402.0])
    shape = deviations["deviation"].shape
    called = 0
    for _ in range(200):
        scattered = deviations.assign(deviation=deviations["deviation"] + rng.normal(0.0, 0.3, shape))
        called += not found(scattered, settling=[])["settled"].met
    # 1 % of 200 is 2; seven or more would have a probability of 0.5 %.
    assert called < 7
