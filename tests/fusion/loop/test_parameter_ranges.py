"""How well nonlinear parameters are known, by profile likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.effects.effect import Candidate
from fusion.effects.geometry import PITCH_ERROR
from fusion.loop.parameter_ranges import parameter_ranges
from fusion.report.model_section import parameters_with_ranges
from tests.fusion.loop_bench import readings_of

NOTHING = np.empty((0, 1))


def state(minutes: float, follows: str = "duty") -> Candidate:
    return Candidate(NOTHING, {"follows": follows, "time_constant_min": minutes}, ("um",))


def test_a_range_ends_where_the_likelihood_has_fallen_by_two():
    near = [state(minutes) for minutes in (10.0, 20.0, 30.0, 40.0, 50.0)]
    found = parameter_ranges(near, np.array([1.0, 8.5, 10.0, 9.0, 7.0]), near[2], 10.0)
    assert found == {"time_constant_min": [10.0, 50.0]}


def test_a_range_is_open_where_the_neighbourhood_ends_first():
    near = [state(minutes) for minutes in (10.0, 20.0, 30.0)]
    assert parameter_ranges(near, np.array([9.0, 10.0, 9.5]), near[1], 10.0) == {"time_constant_min": [None, None]}
    assert parameter_ranges(near, np.array([5.0, 9.9, 10.0]), near[2], 10.0) == {"time_constant_min": [10.0, None]}


@pytest.mark.parametrize(("behind", "minutes"), [(1.91, [10.0, None]), (1.93, [20.0, None])])
def test_a_value_fits_as_well_within_half_a_chi_squared_of_one_degree(behind, minutes):
    near = [state(minutes) for minutes in (10.0, 20.0, 30.0)]
    gains = np.array([0.0, 10.0 - behind, 10.0])
    assert parameter_ranges(near, gains, near[2], 10.0) == {"time_constant_min": minutes}


def test_a_size_may_be_negative():
    near = [Candidate(NOTHING, {"jump": size}, ("ppm",)) for size in (-20.0, -5.0, 5.0)]
    gains = np.array([10.0, 0.0, 0.0])
    assert parameter_ranges(near, gains, near[0], 10.0) == {"jump": [None, -5.0]}
    assert parameter_ranges(near, gains[[1, 0, 2]], near[1], 10.0) == {"jump": [-20.0, 5.0]}


def test_a_time_of_zero_is_the_lowest_and_an_absent_body_has_it():
    near = [Candidate(NOTHING, {}, ("um",)), Candidate(NOTHING, {"second_time_constant_min": 5.0}, ("um",))]
    found = parameter_ranges(near, np.array([9.0, 10.0]), near[1], 10.0)
    assert found == {"second_time_constant_min": [0.0, None]}


def test_values_that_were_computed_twice_are_one_and_derived_words_have_no_range():
    near = [
        Candidate(NOTHING, {"period_mm": period, "possible_leads": leads}, ("um",))
        for period, leads in ((100.0 * (1.0 - 1e-7), "a"), (100.0, "b"), (120.0, "c"))
    ]
    assert parameter_ranges(near, np.array([2.0, 10.0, 2.0]), near[1], 10.0) == {"period_mm": [None, 120.0]}
    assert parameter_ranges(near[1:2], np.array([10.0]), near[1], 10.0) == {}


def test_a_state_that_fits_as_well_is_told_and_does_not_widen_the_numbers():
    near = [state(10.0), state(20.0), state(30.0), state(80.0, "warm_up"), state(90.0, "mean_rise")]
    found = parameter_ranges(near, np.array([5.0, 10.0, 5.0, 9.0, 7.9]), near[1], 10.0)
    assert found == {"follows": ["warm_up"], "time_constant_min": [10.0, 30.0]}


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({}, "follows duty, time constant 20.0 min"),
        (
            {"follows": ["warm_up"], "time_constant_min": [10.0, 30.0]},
            "follows duty (or warm up), time constant 20.0 min (10.0 to 30.0)",
        ),
        ({"time_constant_min": [None, 30.0]}, "follows duty, time constant 20.0 min (at most 30.0)"),
        ({"time_constant_min": [10.0, None]}, "follows duty, time constant 20.0 min (at least 10.0)"),
        ({"time_constant_min": [None, None]}, "follows duty, time constant 20.0 min (not determined)"),
    ],
)
def test_ranges_are_printed_beside_the_values(ranges, words):
    assert parameters_with_ranges({"follows": "duty", "time_constant_min": 20.0}, ranges) == words


def test_a_closer_look_stays_among_waves_that_a_screw_can_make():
    """Half a travel is the longest wave that is tried; the states that scale it are all offered again."""
    readings = readings_of(seed=3)
    travel = float(np.ptp(readings.positions_mm))
    longest = next(candidate for candidate in PITCH_ERROR.candidates(readings, {}, None))
    assert longest.parameters["period_mm"] == pytest.approx(travel / 2)
    near = list(PITCH_ERROR.candidates(readings, {}, longest))
    assert max(candidate.parameters["period_mm"] for candidate in near) <= travel / 2 * 1.001
    assert {candidate.parameters["follows"] for candidate in near} == {"mean_rise", "duty", "warm_up"}
