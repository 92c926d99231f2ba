"""Geometry that follows a thermal state: squares, signs, waves, and the leads that evenly spaced targets confuse."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate
from fusion.effects.geometry import ANGULAR_GROWTH, PITCH_ERROR, REVERSAL_DRIFT, hidden_leads_mm
from fusion.effects.states import thermal_states
from tests.fusion.small_campaign import campaign, logged

EVEN = tuple(np.arange(7) * 50.0 + 50.0)
UNEVEN = (50.0, 101.0, 150.0, 200.0, 250.0, 300.0, 350.0)


def warmed(positions: tuple[float, ...] = EVEN) -> Readings:
    series = {"mean_rise": logged(np.arange(90.0), "K"), "duty": logged(np.ones(90), "1")}
    return campaign(positions_mm=positions, series=series, drivers=("duty",))


def test_bending_grows_with_the_square_of_the_position_and_with_the_state():
    readings = warmed()
    candidates = list(ANGULAR_GROWTH.candidates(readings, {}, None))
    states = list(thermal_states(readings, None))
    assert len(candidates) == len(states) == 22
    for candidate, (state, parameters) in zip(candidates, states, strict=True):
        np.testing.assert_allclose(candidate.columns[:, 0], state * (readings.position_mm / 350.0) ** 2)
        assert candidate.parameters == parameters
    assert candidates[0].units == ("um/(K)",) and candidates[-1].units == ("um",)


def test_a_reversal_moves_both_directions_apart_by_the_state():
    readings = warmed()
    candidate = next(iter(REVERSAL_DRIFT.candidates(readings, {}, None)))
    np.testing.assert_allclose(
        candidate.columns[:, 0], np.where(readings.sign > 0, 0.5, -0.5) * readings.seconds / 30.0
    )
    assert REVERSAL_DRIFT.needs(readings) is None
    assert REVERSAL_DRIFT.needs(campaign(both_directions=False)) == "only one direction of approach was measured"


def test_a_pitch_error_is_a_wave_along_the_axis_times_a_state():
    readings = warmed()
    candidates = list(PITCH_ERROR.candidates(readings, {}, None))
    # Two periods over the travel of 300 mm up to one in two spacings, in steps of half a period.
    assert list(dict.fromkeys(c.parameters["period_mm"] for c in candidates)) == pytest.approx([150.0, 120.0, 100.0])
    followed = [
        (c.parameters["follows"], c.parameters.get("start"), c.parameters["time_constant_min"]) for c in candidates
    ]
    assert followed[:6] == [
        ("mean_rise", None, 0.0),
        ("mean_rise", None, 40.0),
        ("duty", "settled", 40.0),
        ("duty", "at rest", 40.0),
        ("warm_up", None, 60.0),
        ("mean_rise", None, 0.0),
    ]
    first = candidates[0]
    phase = 2.0 * np.pi * readings.position_mm / 150.0
    expected = np.column_stack([np.cos(phase), np.sin(phase)]) * (readings.seconds / 30.0)[:, None]
    np.testing.assert_allclose(first.columns, expected, atol=1e-9)
    assert first.units == ("um/(K)", "um/(K)")


def test_uneven_targets_tell_leads_apart_down_to_four_millimetres():
    readings = warmed(UNEVEN)
    candidates = list(PITCH_ERROR.candidates(readings, {}, None))
    periods = list(dict.fromkeys(c.parameters["period_mm"] for c in candidates))
    np.testing.assert_allclose(periods, 300.0 / np.arange(2.0, 75.001, 0.5))
    # Each follows one course of every kind only.
    assert [(c.parameters["follows"], c.parameters.get("start")) for c in candidates[:3]] == [
        ("mean_rise", None),
        ("duty", "settled"),
        ("warm_up", None),
    ]
    assert len(candidates) == 3 * len(periods)
    assert candidates[0].parameters["possible_leads"] == "150 mm (targets unevenly spaced: no alias)"


@pytest.mark.parametrize(("shift", "even"), [(0.20, True), (0.30, False)])
def test_spacings_within_a_hundredth_count_as_even(shift, even):
    """A target that is off by d makes one spacing longer and the next shorter: a range of 2 d."""
    positions = (50.0, 100.0, 150.0 + shift, 200.0, 250.0, 300.0, 350.0)
    first = next(iter(PITCH_ERROR.candidates(warmed(positions), {}, None)))
    assert ("no alias" in str(first.parameters["possible_leads"])) is not even


def test_leads_that_look_alike_on_even_targets_are_listed():
    """Targets every 50 mm see a wave of 150 mm where 1 / lead is a multiple of 1 / 50 plus or minus 1 / 150."""
    first = next(iter(PITCH_ERROR.candidates(warmed(), {}, None)))
    leads = [float(lead) for lead in str(first.parameters["possible_leads"]).removesuffix(" mm").split(", ")]
    expected = sorted(
        (1 / f for k in range(30) for f in (k / 50 - 1 / 150, k / 50 + 1 / 150) if 1 / 50 <= f <= 1 / 2),
        reverse=True,
    )
    assert leads == pytest.approx(expected, rel=5e-3)
    assert leads[:2] == pytest.approx([37.5, 30.0], abs=0.05) and leads[-1] >= 2.0


def test_a_closer_look_at_a_wave_stays_within_the_search():
    readings = warmed()
    chosen = Candidate(
        np.empty((0, 2)), {"period_mm": 120.0, "follows": "warm_up", "time_constant_min": 60.0}, ("um", "um")
    )
    near = {c.parameters["period_mm"] for c in PITCH_ERROR.candidates(readings, {}, chosen)}
    assert sorted(near) == pytest.approx(sorted(300.0 / (2.5 + np.linspace(-0.25, 0.25, 5))))
    widest = Candidate(
        np.empty((0, 2)), {"period_mm": 150.0, "follows": "warm_up", "time_constant_min": 60.0}, ("um", "um")
    )
    near = {c.parameters["period_mm"] for c in PITCH_ERROR.candidates(readings, {}, widest)}
    assert sorted(near) == pytest.approx(sorted(300.0 / (2.0 + np.linspace(0.0, 0.25, 3))))


def test_even_targets_hide_the_leads_that_divide_their_spacing():
    assert hidden_leads_mm(
        warmed()
    ) == "50, 25, 16.7, 12.5, 10, 8.33, 7.14, 6.25, 5.56, 5, 4.55, 4.17, 3.85, 3.57, " + (
        "3.33, 3.12, 2.94, 2.78, 2.63, 2.5, 2.38, 2.27, 2.17, 2.08, 2 mm"
    )
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 100.0))).startswith("50, 33.3, 25, ")
    # Leads longer than 50 mm are no screw's.
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 52.0))).startswith("26, 17.3, ")
    assert hidden_leads_mm(warmed(UNEVEN)) == ""
    # Targets closer than the shortest lead hide none.
    assert hidden_leads_mm(warmed(tuple(np.arange(1, 8) * 1.5))) == ""
