"""Planning: cycles for an uncertainty, target spacing, settling."""

import math

import numpy as np
import pytest

from interferometry.drift.estimate import estimate_drift
from interferometry.drift.planning import _fit_exponential, estimate_settling, plan_cycles, spacing_warnings
from tests.interferometry.simulated_campaigns import CYCLE_S, simulate

pytestmark = pytest.mark.long


def test_planned_cycles_reach_the_wanted_uncertainty(rng):
    trial, _ = simulate(rng, cycles=25)
    plan = plan_cycles(trial, estimate_drift(trial), wanted_u_um=0.05)
    # Against the first position, both directions: 0.4 um * sqrt(2 / 2n) = 0.05 um gives n = 64. The trial
    # knows sigma to 2.5 %, hence n to 5 %, and the drift may add to it.
    assert 54 <= plan.cycles <= 90
    assert plan.duration_s == pytest.approx(plan.cycles * CYCLE_S)
    longer, _ = simulate(rng, cycles=plan.cycles)
    reached = plan_cycles(longer, estimate_drift(longer), wanted_u_um=0.05)
    assert reached.cycles == pytest.approx(plan.cycles, rel=0.2)


def test_impossible_wishes_are_refused(rng):
    trial, _ = simulate(rng, cycles=10)
    estimated = estimate_drift(trial)
    with pytest.raises(ValueError, match="wanted_u_um=0 is not above 0"):
        plan_cycles(trial, estimated, wanted_u_um=0)
    with pytest.raises(ValueError, match=r"would need \d+ cycles with this scatter"):
        plan_cycles(trial, estimated, wanted_u_um=1e-4)
    with pytest.raises(ValueError, match="deviations has no variable 'deviation'"):
        plan_cycles(estimated, trial, wanted_u_um=0.05)


def test_spacing_of_whole_leads_is_warned_of():
    assert spacing_warnings(np.arange(16) * 20.0, lead_mm=10.0)
    assert spacing_warnings(np.arange(16) * 20.0, lead_mm=20.0)
    assert not spacing_warnings(np.arange(16) * 20.0, lead_mm=8.0)
    assert not spacing_warnings(np.arange(16) * 5.0, lead_mm=10.0)
    with pytest.raises(ValueError, match="lead_mm=0 is not above 0"):
        spacing_warnings(np.arange(3), lead_mm=0)


def test_settling_of_one_known_time_constant(rng):
    deviations, truth = simulate(rng, kind="none")
    tau = 4000.0
    deviations["deviation"].values[:] += 8.0 * (1 - np.exp(-truth.seconds / tau))
    (shift,) = estimate_settling(deviations, estimate_drift(deviations))
    assert shift.component == "shift"
    # Half a 95 % band is about two standard deviations; four of them are allowed.
    assert abs(shift.t95_s + tau * math.log(0.05)) < shift.t95_high_s - shift.t95_low_s
    assert shift.t95_s == pytest.approx(-tau * math.log(0.05), rel=0.1)
    assert shift.amplitude_um == pytest.approx(8.0, rel=0.05)


def test_a_stable_machine_has_nothing_to_settle(rng):
    deviations, _ = simulate(rng, kind="none")
    assert estimate_settling(deviations, estimate_drift(deviations)) == []


def test_what_is_constant_to_rounding_does_not_settle(rng):
    """An exponential explains rounding by any share, and by less than none."""
    seconds = np.linspace(0.0, 7200.0, 24)
    for level in (0.0, 0.1, -3.7, 12.3):
        assert _fit_exponential("shift", seconds, np.full(24, level)) is None
        assert _fit_exponential("shift", seconds, level * (1.0 + 2e-16 * rng.normal(size=24))) is None
    settles = _fit_exponential("shift", seconds, 1e-9 * (1.0 - np.exp(-seconds / 1800.0)))
    assert settles is not None and settles.t95_s == pytest.approx(-1800.0 * math.log(0.05), rel=1e-3), "however small"


def test_a_test_too_short_to_see_the_end_says_so(rng):
    deviations, truth = simulate(rng, kind="none", cycles=25)
    deviations["deviation"].values[:] += 60.0 * (1 - np.exp(-truth.seconds / 50_000.0))
    (shift,) = estimate_settling(deviations, estimate_drift(deviations))
    assert shift.t95_high_s == math.inf


def test_a_reading_without_a_time_takes_no_part_in_the_settling(rng):
    test, _ = simulate(rng, cycles=40)
    nameless = test.copy(deep=True)
    nameless["time"].values[3, 0, 2] = np.datetime64("NaT")
    missing = nameless.copy(deep=True)
    missing["deviation"].values[3, 0, 2] = np.nan
    assert estimate_settling(nameless, estimate_drift(nameless)) == estimate_settling(missing, estimate_drift(missing))
