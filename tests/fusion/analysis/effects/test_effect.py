"""What an effect is: its name in words, its defaults, and a candidate at some of the readings."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from fusion.analysis.alignment.readings import Series
from fusion.analysis.effects.effect import (
    LAGS_MIN,
    Candidate,
    Effect,
    Prior,
    Separable,
    first_order_responses,
    thermal_states,
    um_per,
    unit_of_state,
    unmeasured_expansion,
    values_near,
    warm_up,
)
from tests.fusion.small_campaign import campaign, logged


def test_an_effect_is_called_by_its_label_or_by_its_name_with_spaces():
    def none(readings, coefficients, near):
        return iter(())

    assert Effect("bed_bending", "", "", none).words == "bed bending"
    assert Effect("bed_bending", "", "", none, label="the bed bends").words == "the bed bends"


def test_a_candidate_keeps_all_but_its_rows_at_some_of_the_readings():
    candidate = Candidate(
        np.arange(6.0).reshape(3, 2), {"minutes": 5.0}, ("um", "um"), event_s=7.0, prior=Prior(1.0, 0.1), beside=1
    )
    part = candidate.on(np.array([True, False, True]))
    np.testing.assert_array_equal(part.columns, [[0.0, 1.0], [4.0, 5.0]])
    assert (part.parameters, part.units, part.event_s, part.prior, part.beside) == (
        {"minutes": 5.0},
        ("um", "um"),
        7.0,
        Prior(1.0, 0.1),
        1,
    )
    assert candidate.columns.shape == (3, 2)
    with pytest.raises(FrozenInstanceError):
        candidate.beside = 0


def test_separable_columns_are_courses_weighed_by_place():
    courses = (np.array([1.0, 2.0, 3.0]), np.array([False, True, True]))
    columns = Separable(courses, np.array([0, 1, 0]), np.array([[2.0, 3.0], [10.0, 20.0]]))
    whole = [[2.0, 0.0], [20.0, 20.0], [6.0, 3.0]]
    assert columns.shape == (3, 2)
    np.testing.assert_array_equal(np.asarray(columns), whole)
    np.testing.assert_array_equal(columns[np.array([2, 1])], [whole[2], whole[1]])
    np.testing.assert_array_equal(columns[np.array([True, False, True])], [whole[0], whole[2]])
    np.testing.assert_array_equal(columns[1:, 1], [20.0, 3.0])
    np.testing.assert_array_equal(np.column_stack([columns, columns]), np.hstack([whole, whole]))
    on_some = Candidate(columns, {}, ("um", "um")).on(np.array([False, True, False]))
    np.testing.assert_array_equal(on_some.columns, [whole[1]])


# Thermal states: first-order responses by their equation, grids and their neighbourhoods, units.


MINUTES = np.arange(0.0, 200.0)
#: A load that is switched on at the start and stays on.
STEP = Series(60.0 * MINUTES, np.ones(200), "1")


def near(minutes: float, **words: str) -> Candidate:
    return Candidate(np.empty((0, 1)), {"time_constant_min": minutes, **words}, ("um",))


def test_a_warm_up_approaches_one_with_its_time_constant():
    readings = campaign()
    np.testing.assert_allclose(warm_up(readings, 5.0), 1.0 - np.exp(-readings.seconds / 300.0), rtol=1e-12)
    np.testing.assert_array_equal(warm_up(readings, 0.0), 1.0)


def test_the_response_to_a_step_approaches_it_exponentially():
    (response, parameters), (slower, _) = first_order_responses(STEP, None, (20.0, 50.0), ratio=2.0, at_rest=0.0)
    np.testing.assert_allclose(response.values, 1.0 - np.exp(-MINUTES / 20.0), atol=1e-12)
    np.testing.assert_allclose(slower.values, 1.0 - np.exp(-MINUTES / 50.0), atol=1e-12)
    assert parameters == {"time_constant_min": 20.0}
    # A body that was settled before stays where it is.
    ((settled, _),) = first_order_responses(STEP, None, (20.0,), ratio=2.0)
    np.testing.assert_allclose(settled.values, 1.0, rtol=1e-12)


def test_a_body_behind_another_follows_it_with_a_share_of_its_time_constant():
    (_, one), (response, two) = first_order_responses(STEP, None, (40.0,), ratio=2.0, at_rest=0.0, second=(0.25,))
    assert one == {"time_constant_min": 40.0}
    assert two == {"time_constant_min": 40.0, "second_time_constant_min": 10.0}
    # Step response of two first-order bodies in series; the first one's course is taken as linear within a minute.
    expected = 1.0 - (40.0 * np.exp(-MINUTES / 40.0) - 10.0 * np.exp(-MINUTES / 10.0)) / 30.0
    np.testing.assert_allclose(response.values, expected, atol=1e-4)


def test_a_closer_look_tries_three_second_bodies_for_every_time_constant():
    told = [parameters for _, parameters in first_order_responses(STEP, near(20.0), LAGS_MIN, ratio=1.5)]
    assert len(told) == 4 * 11
    shares = [two["second_time_constant_min"] / two["time_constant_min"] for two in told[1:4]]
    assert shares == pytest.approx([0.25, 0.5, 1.0])
    # No time, no body behind it.
    assert len(list(first_order_responses(STEP, None, (0.0,), ratio=2.0, second=(0.25,)))) == 1


def test_the_search_tries_the_grid_and_a_closer_look_eleven_values_about_the_chosen_one():
    grid = (0.0, 10.0, 20.0, 40.0)
    assert values_near(None, "time_constant_min", grid, ratio=2.0) == grid
    finer = values_near(near(20.0), "time_constant_min", grid, ratio=2.0)
    np.testing.assert_allclose(finer, 20.0 * 2.0 ** np.linspace(-1.0, 1.0, 11), rtol=1e-12)
    # Zero has no factor.
    assert values_near(near(0.0), "time_constant_min", grid, ratio=2.0) == grid


def test_a_closer_look_at_a_state_reaches_to_twice_its_time_constant():
    readings = campaign(series={"mean_rise": logged(np.arange(60.0), "K"), "duty": STEP}, drivers=("duty",))
    told: dict[str, list[float]] = {}
    for _, parameters in thermal_states(readings, near(40.0)):
        told.setdefault(str(parameters["follows"]), []).append(float(parameters["time_constant_min"]))
    for values in told.values():
        assert (min(values), max(values)) == (pytest.approx(20.0), pytest.approx(80.0))
    assert list(told) == ["mean_rise", "duty", "warm_up"]


def test_a_closer_look_ends_one_ratio_beyond_the_grid():
    grid = (0.0, 10.0, 40.0)
    low = values_near(near(5.0), "time_constant_min", grid, ratio=2.0)
    assert (len(low), low[0]) == (6, pytest.approx(5.0))
    high = values_near(near(80.0), "time_constant_min", grid, ratio=2.0)
    assert (len(high), high[-1]) == (6, pytest.approx(80.0))


def test_every_state_is_told_by_what_it_follows():
    readings = campaign(series={"mean_rise": logged(np.arange(60.0), "K"), "duty": STEP}, drivers=("duty",))
    states = list(thermal_states(readings, None))
    names = [(p["follows"], p.get("start"), p["time_constant_min"]) for _, p in states]
    coarse = (10.0, 20.0, 40.0, 80.0, 160.0)
    assert names == [
        *(("mean_rise", None, minutes) for minutes in (0.0, *coarse)),
        *(("duty", "settled", minutes) for minutes in (5.0, *coarse)),
        *(("duty", "at rest", minutes) for minutes in (5.0, *coarse)),
        *(("warm_up", None, minutes) for minutes in (15.0, 30.0, 60.0, 120.0)),
    ]
    by_name = dict(zip(names, (state for state, _ in states), strict=True))
    # The rise is a kelvin every 30 s, followed without delay.
    np.testing.assert_allclose(by_name["mean_rise", None, 0.0], readings.seconds / 30.0)
    np.testing.assert_allclose(by_name["duty", "settled", 10.0], 1.0)
    minute = readings.seconds % 60.0 == 0.0
    from_rest = 1.0 - np.exp(-readings.seconds / 600.0)
    np.testing.assert_allclose(by_name["duty", "at rest", 10.0][minute], from_rest[minute], atol=1e-12)
    np.testing.assert_allclose(by_name["warm_up", None, 60.0], 1.0 - np.exp(-readings.seconds / 3600.0))


def test_without_field_and_load_only_warm_ups_are_left():
    assert {parameters["follows"] for _, parameters in thermal_states(campaign(), None)} == {"warm_up"}


def test_the_expansion_of_the_axis_is_unmeasured_without_a_temperature_that_shows_how_it_bends():
    seen = campaign(series={"mean_rise": logged(np.arange(60.0), "K")})
    assert unmeasured_expansion(seen) is None and unmeasured_expansion(replace(seen, places=3)) is None
    assert "its own expansion looks the same" in str(unmeasured_expansion(campaign()))
    assert "what 2 contact sensors along the axis miss" in str(unmeasured_expansion(replace(seen, places=2)))


def test_the_unit_of_a_coefficient_follows_from_what_drives_it():
    readings = campaign(series={"speed": logged(np.ones(60), "1/min")}, drivers=("speed",))
    assert unit_of_state(readings, {"follows": "speed"}) == "um/(1/min)"
    assert unit_of_state(readings, {"follows": "warm_up"}) == "um"
    assert (um_per("1"), um_per("K")) == ("um", "um/(K)")
