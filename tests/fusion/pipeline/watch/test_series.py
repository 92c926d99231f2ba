"""Readings of finished cycles: drift since the first, ISO 230-2 of the last five, whether the cycles are enough."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from fusion.pipeline.watch.series import CycleSeries
from interferometry.deviations import build_deviations
from interferometry.drift.estimate import estimate_drift
from interferometry.drift.planning import plan_cycles


def test_of(cycles: int, *, seed: int = 1) -> xr.Dataset:
    """Three targets, a minute a cycle, readings that scatter by 0.5 um about a slow rise."""
    seconds = 10.0 * np.arange(6.0 * cycles).reshape(cycles, 2, 3)
    seconds[:, 1] = seconds[:, 1, ::-1]
    noise = np.random.default_rng(seed).normal(0.0, 0.5, seconds.shape)
    time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    return build_deviations(
        range(1, cycles + 1), [1, 2, 3], np.array([0.0, 150.0, 300.0]), seconds / 3600 + noise, time
    )


test_of.__test__ = False  # type: ignore[attr-defined]


def filled(deviations: xr.Dataset, wanted_u_um: float = 0.1) -> CycleSeries:
    series = CycleSeries(wanted_u_um)
    for cycle in range(deviations.sizes["cycle"]):
        series.add(deviations.isel(cycle=cycle))
        series.enough()
    return series


def test_drift_is_relative_to_the_first_reading_of_each_kind() -> None:
    test = test_of(3)
    test["deviation"][:] = np.arange(18.0).reshape(3, 2, 3)
    test["deviation"][0, 0, 1] = np.nan
    series = CycleSeries(0.1)
    drifts = [series.add(test.isel(cycle=cycle)).tolist() for cycle in range(3)]
    # The second target has its first positive reading in the second cycle, from which it counts.
    assert drifts == [[0.0, 0.0, 0.0], [6.0, 3.0, 6.0], [12.0, 9.0, 12.0]]


def test_the_targets_are_those_of_the_first_cycle() -> None:
    test = test_of(2)
    series = CycleSeries(0.1)
    series.add(test.isel(cycle=0).isel(target=[0, 2]))
    assert series.add(test.isel(cycle=1)).shape == (2,)


def test_iso230_needs_two_cycles() -> None:
    series = filled(test_of(1))
    assert series.iso230() == ({}, "")
    values, window = filled(test_of(7)).iso230()
    assert set(values) == {"B", "R", "E", "M", "A"} and window.startswith("cycles 3 to 7")


def test_enough_is_what_the_planning_of_the_whole_test_says() -> None:
    test = test_of(40)
    enough = filled(test).enough()
    assert enough is not None
    used = test.isel(cycle=slice(0, enough.cycles))
    plan = plan_cycles(estimate_drift(used), used, wanted_u_um=0.1)
    assert enough.cycles_for_wanted == plan.cycles
    assert enough.u_um == pytest.approx(plan.u_um * np.sqrt(plan.cycles / enough.cycles))
    assert not enough.lacks and enough.is_enough == (enough.cycles >= plan.cycles)


def test_a_long_test_is_judged_by_its_latest_cycles() -> None:
    """Time and memory stay bounded, and the uncertainty falls on with the root of the number of cycles."""
    test = test_of(260)
    series = filled(test)
    assert len(series._latest) == 200 and series.count == 260
    enough = series.enough()
    assert enough is not None and enough.cycles > 200
    assert enough.u_um == pytest.approx(0.5 * np.sqrt(2.0 / 2.0 / enough.cycles), rel=0.4)


def test_readings_that_cannot_be_judged_say_why() -> None:
    test = test_of(4)
    test["deviation"][:] = np.nan
    enough = filled(test).enough()
    assert enough is not None and not enough.is_enough and np.isnan(enough.u_um)
