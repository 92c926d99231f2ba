"""The plan of a randomised duty: its power, its schedule, and what it refuses."""

import itertools
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fusion.attribution.duty_plan import DutyPlanError, Machine, plan_duty, switchings


def test_the_plan_grows_with_time_and_falls_with_drift():
    quiet = Machine(("spindle", "pump"), (1200.0, 3600.0), 5.0, drift_um_per_sqrt_h=0.2)
    restless = Machine(("spindle", "pump"), (1200.0, 3600.0), 5.0, drift_um_per_sqrt_h=2.0)
    short = {"hours": (3.0, 7.0), "dwells_s": (1800.0, 3600.0)}
    plan = plan_duty(quiet, **short)
    power = plan["power"].values
    assert (power[1] >= power[0]).all()
    assert (plan_duty(restless, **short)["power"].values.max(axis=1) < power.max(axis=1)).all()
    assert 0.0 < float(plan["separation"].min()) <= 1.0


def test_the_plan_can_be_worked_through_and_repeated():
    machine = Machine(("spindle", "pump"), (1200.0, 3600.0), 8.0, drift_um_per_sqrt_h=0.2)
    short = {"hours": (3.0, 7.0), "dwells_s": (1800.0,), "least_dwell_s": 600.0}
    plan = plan_duty(machine, **short)
    events = switchings(plan)
    assert [event for event in events if event[0] == 0.0] != []
    for name in machine.sources:
        minutes = [when for when, which, _ in events if which == name]
        states = [state for _, which, state in events if which == name]
        assert (np.diff(minutes) >= 10.0 - 1.0).all()
        assert all(a != b for a, b in itertools.pairwise(states))
    xr.testing.assert_identical(plan, plan_duty(machine, **short))
    assert not plan_duty(machine, **short, seed=1)["duty"].equals(plan["duty"])


def test_a_plan_without_sources_is_refused():
    with pytest.raises(DutyPlanError, match="2 sources and 1 time constants: name every source once"):
        Machine(("a", "b"), (1200.0,), 3.0)


def test_a_plan_without_usable_dwells_is_refused():
    with pytest.raises(DutyPlanError, match="is longer than the least dwell of 7200 s"):
        plan_duty(Machine(("a",), (1200.0,), 3.0), least_dwell_s=7200.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"sources": ("x", "x")}, "source 'x' is named more than once"),
        ({"time_constants_s": (60.0, -5.0)}, "time constant of b: -5 is not greater than 0"),
        ({"cycle_s": 0.0}, "cycle: 0 is not greater than 0"),
    ],
)
def test_what_cannot_be_planned_is_named(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(DutyPlanError, match=message):
        Machine(**{"sources": ("a", "b"), "time_constants_s": (60.0, 90.0), "effect_um": 1.0, **changed})
