"""Randomised duty: the stated law, and a test that keeps its level in a warm-up."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fusion.analysis.attribution import duty as module
from fusion.analysis.attribution.duty import (
    DutyLaw,
    DutyPlanError,
    Machine,
    RandomisationError,
    duty_responses,
    plan_duty,
    randomisation_test,
    read_duty,
    switchings,
)
from tests.fusion import field_simulator as simulator
from tests.fusion.duty_simulator import FINE, driven, run_schedule


def test_the_law_keeps_its_mean_and_least_dwell(rng):
    law = DutyLaw(1800.0, 300.0)
    seconds = 10.0 * np.arange(400_000)
    dwell = 10.0 * np.diff(np.flatnonzero(np.diff(law.course(seconds, rng))))
    assert dwell.min() >= 290.0
    # About 2,200 dwells of spread 1,500 s: standard error 32 s; 4 sigma.
    assert dwell.mean() == pytest.approx(1800.0, abs=130.0)
    assert set(np.unique(law.course(FINE, rng))) <= {0.0, 1.0}


def test_the_switched_source_is_named(rng):
    law = DutyLaw(1800.0)
    duty = run_schedule(law, rng)
    found = randomisation_test(driven(duty, 1, rng, um=6.0), duty, law, draws=199)
    assert found.attrs["source"] == "pump"
    assert float(found["p_value"].sel(source="pump")) <= 0.05
    assert float(found["sensitivity"].sel(source="pump")) > 0


def test_a_source_that_was_never_switched_is_refused(rng):
    duty = run_schedule(DutyLaw(1800.0), rng)
    duty[:, 2] = 1.0
    with pytest.raises(RandomisationError, match="drive: never switched in this session"):
        randomisation_test(driven(duty, 0, rng), duty, DutyLaw(1800.0))


def test_an_impossible_law_is_refused():
    with pytest.raises(RandomisationError, match="mean dwell of 300 s must be longer than the least dwell of 600 s"):
        DutyLaw(300.0, 600.0)


def logged(rng, full=3000.0):
    """A driver log of one load that was switched by the law, once a minute, at 0 and `full`."""
    time = simulator.START + (FINE * 1e9).astype("timedelta64[ns]")
    values = full * DutyLaw(1800.0, 300.0).course(FINE, rng) + rng.normal(0.0, 2.0, FINE.size)
    return xr.Dataset({"speed": ("time", values), "load": ("time", rng.random(FINE.size))}, coords={"time": time})


def test_a_logged_load_becomes_a_schedule_of_two_states(rng):
    duty = read_duty(logged(rng), ["speed"], DutyLaw(1800.0, 300.0))
    assert duty.dims == ("time", "source") and list(duty["source"].values) == ["speed"]
    assert set(np.unique(duty.values)) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("names", "law", "message"),
    [
        (["spindle"], DutyLaw(1800.0), "no column spindle for drivers.randomised; it has: speed, load, still"),
        (["still"], DutyLaw(1800.0), "still was never switched"),
        (["load"], DutyLaw(1800.0), r"load takes levels between 0\S* and 0\S*; the randomisation test"),
        (["speed"], DutyLaw(9000.0, 5000.0), r"speed was switched again after \d+ s, before the least dwell of 5000 s"),
        (["speed"], DutyLaw(60.0), r"speed was switched \d+ times in 7.0 h, .* mean dwell of 60 s makes about 419"),
    ],
)
def test_a_log_that_the_law_cannot_have_made_is_refused(rng, names, law, message):
    with pytest.raises(RandomisationError, match=rf"drivers\.csv: {message}"):
        read_duty(logged(rng).assign(still=("time", np.zeros(FINE.size))), names, law, source="drivers.csv")


def test_a_schedule_starts_on_as_often_as_off(rng):
    """200 schedules: 100 in the mean, 4 standard deviations are 28."""
    law = DutyLaw(1800.0, 300.0)
    starts = [law.course(FINE, rng)[0] for _ in range(200)]
    assert sum(starts) == pytest.approx(100, abs=28)


def test_every_source_is_ranked_among_the_largest_statistics_of_all_sources(rng, monkeypatch):
    """Redrawn schedules reach 4 for the first source and 1 for the others: a statistic of 3 is nothing special for any of them."""
    law = DutyLaw(1800.0)
    duty = run_schedule(law, rng)
    sources = duty.sizes["source"]
    redrawn = np.ones((19, sources, 8))
    redrawn[:, 0] = 4.0
    measured = np.full((sources, 8), 3.0)
    measured[0] = 5.0
    answers = iter([measured, redrawn.reshape(-1, 8)])
    monkeypatch.setattr(module, "_statistics", lambda series, banks, responses: next(answers))
    found = randomisation_test(driven(duty, 1, rng, um=6.0), duty, law, draws=19)
    assert found["p_value"].values.tolist() == [1 / 20, *[1.0] * (sources - 1)]


def test_the_logged_state_is_held_on_an_even_grid_to_the_end_of_the_log():
    time = np.datetime64("2026-03-09T06:30", "ns") + np.array([0, 7, 13, 15]) * np.timedelta64(int(module.GRID_S), "s")
    duty = xr.DataArray(
        [[0.0], [1.0], [0.0], [0.0]], dims=("time", "source"), coords={"time": time, "source": ["pump"]}
    )
    seconds, grid, courses = module._hold(duty)
    np.testing.assert_allclose(seconds, module.GRID_S * np.arange(16))
    assert grid[0] == time[0] and grid[-1] == time[-1]
    assert courses[:, 0].tolist() == [0.0] * 7 + [1.0] * 6 + [0.0] * 3


def test_effects_of_common_and_stretch_add_up_at_the_far_end_and_their_uncertainties_in_square(rng):
    seconds, columns = 300.0 * np.arange(40), rng.standard_normal((40, 2, 1))
    series, banks = [], []
    for size in (2.0, -0.5):
        values = size * columns[:, 0, 0] + 0.1 * rng.standard_normal(40)
        banks.append(module.null_bank(values, seconds, np.ones(40), module.level_and_trend(seconds), integrated=False))
        series.append(SimpleNamespace(sampling=np.eye(40)))
    alone = [module._effect([one], [bank], columns, np.zeros(2, int)) for one, bank in zip(series, banks, strict=True)]
    both = module._effect(series, banks, columns, np.zeros(2, int))
    assert both.coefficient[0] == pytest.approx(1.5, abs=0.2)
    np.testing.assert_allclose(both.coefficient, alone[0].coefficient + alone[1].coefficient)
    np.testing.assert_allclose(both.coefficient_u, np.hypot(alone[0].coefficient_u, alone[1].coefficient_u), rtol=0.05)


def test_a_dwell_is_counted_from_change_to_change_within_two_steps_of_the_log():
    """Logged every minute: a dwell of 480 s may have been 600 s, one of 420 s may not; so may one before a longer one."""
    law = DutyLaw(1800.0, 600.0)
    seconds = 60.0 * np.arange(120)
    module._check_law("speed", seconds, ((seconds >= 1800.0) & (seconds < 2280.0)).astype(float), law)
    with pytest.raises(
        RandomisationError, match="speed was switched again after 420 s, before the least dwell of 600 s"
    ):
        module._check_law("speed", seconds, ((seconds >= 1800.0) & (seconds < 2220.0)).astype(float), law)
    # A change in the last step of the log is one.
    module._check_law("speed", seconds, (seconds == seconds[-1]).astype(float), law)


def test_responses_are_those_of_bodies_of_the_stated_time_constants():
    """After a switch a body follows 1 - exp(-t / a); one of b behind it 1 - (a exp(-t / a) - b exp(-t / b)) / (a - b)."""
    seconds = np.arange(0.0, 20_000.0, 1.0)
    switched = duty_responses(seconds, np.where(seconds > 0, 1.0, 0.0)[:, None])[:, 0]
    # The duty rises within the first second: as if it were switched in its middle, but for 1 / (24 a^2).
    after = np.maximum(seconds - 0.5, 0.0)[:, None]
    first = np.array([600.0, 1800.0, 3600.0, 7200.0])
    np.testing.assert_allclose(switched[1:, :4], (1.0 - np.exp(-after / first))[1:], atol=1e-6)
    behind = first[[0, 2, 3]]
    expected = 1.0 - (behind * np.exp(-after / behind) - 1800.0 * np.exp(-after / 1800.0)) / (behind - 1800.0)
    np.testing.assert_allclose(switched[1:, [4, 6, 7]], expected[1:], atol=1e-6)
    np.testing.assert_allclose(
        switched[1:, 5], (1.0 - (1.0 + after / 1800.0) * np.exp(-after / 1800.0))[1:, 0], atol=1e-6
    )


def test_every_column_is_held_to_the_law(rng):
    """The first keeps it, the second is switched every minute."""
    both = logged(rng)
    both["load"] = ("time", 1.0 * (np.arange(FINE.size) % 2))
    assert read_duty(both, ["speed"], DutyLaw(1800.0, 300.0)).sizes["source"] == 1
    with pytest.raises(RandomisationError, match="load was switched again after"):
        read_duty(both, ["speed", "load"], DutyLaw(1800.0, 300.0))


# The plan of a randomised duty: its power, its schedule, and what it refuses.


def test_the_plan_grows_with_time_and_falls_with_drift():
    quiet = Machine(("spindle", "pump"), (1200.0, 3600.0), 5.0, drift_um_per_sqrt_h=0.2)
    restless = Machine(("spindle", "pump"), (1200.0, 3600.0), 5.0, drift_um_per_sqrt_h=2.0)
    short = {"hours": (3.0, 7.0), "dwells_s": (1800.0, 3600.0)}
    plan = plan_duty(quiet, **short)
    power = plan["power"].values
    assert (power[1] >= power[0]).all()
    assert (plan_duty(restless, **short)["power"].values.max(axis=1) < power.max(axis=1)).all()


def test_the_plan_can_be_worked_through_and_repeated():
    machine = Machine(("spindle", "pump"), (1200.0, 3600.0), 8.0, drift_um_per_sqrt_h=0.2)
    short = {"hours": (3.0, 7.0), "dwells_s": (1800.0,)}
    plan = plan_duty(machine, **short)
    events = switchings(plan)
    assert [event for event in events if event[0] == 0.0] != []
    for name in machine.sources:
        minutes = [when for when, which, _ in events if which == name]
        states = [state for _, which, state in events if which == name]
        assert (np.diff(minutes) >= 5.0 - 1.0).all()
        assert all(a != b for a, b in itertools.pairwise(states))
    xr.testing.assert_identical(plan, plan_duty(machine, **short))
    assert not plan_duty(machine, **short, seed=1)["duty"].equals(plan["duty"])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"sources": ("x", "x")}, "source 'x' is named more than once"),
        ({"time_constants_s": (60.0, -5.0)}, "time constant of b: -5 lies outside 1 to 1e\\+06"),
        ({"sources": ("a", "b", "c")}, "3 sources and 2 time constants: name every source once"),
        # A day of shorter cycles would fill the memory.
        ({"cycle_s": 1e-9}, "cycle: 1e-09 lies outside 30 to 100000"),
    ],
)
def test_what_cannot_be_planned_is_named(changed, message):
    with pytest.raises(DutyPlanError, match=message):
        Machine(**{"sources": ("a", "b"), "time_constants_s": (60.0, 90.0), "effect_um": 1.0, **changed})
