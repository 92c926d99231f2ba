"""Contact sensors in place of the camera, on axes of known sources."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.analysis.attribution.sensors import Excess, choose_sensors
from tests.fusion import field_simulator as simulator


def two_sources(rng, um=3.0):
    """Sources 0 and 1 drive the axis with opposite signs: one sensor cannot stand for both."""
    responses = simulator.source_responses("duty", rng)[1]
    driver = um * (responses[:, 0] - responses[:, 1])
    walks = 0.02 * np.cumsum(rng.standard_normal((2, simulator.CYCLES)), axis=1)
    film = simulator.film("duty", rng, responses)
    return simulator.session(film, driver + walks[0], driver + walks[1], rng), driver


def thin(made):
    return made.field[:, ::2, ::2]


def test_one_source_needs_one_sensor_and_it_sits_there():
    made = simulator.driven_session(np.random.default_rng(12), source=0, nuisance_um=0.02)
    choice = choose_sensors(made.fused, thin(made), most=3)
    x_mm, y_mm = choice.sets[0].places_mm[0]
    assert simulator.distance_cells(y_mm / 10 - 0.5, x_mm / 10 - 0.5, 0) <= 5
    assert choice.without.decided
    # What is lost with one sensor is small beside what the camera is worth.
    assert choice.sets[0].loss.at_most_um < 0.3 * choice.without.um


def test_two_sources_need_two_sensors():
    made, _ = two_sources(np.random.default_rng(3))
    choice = choose_sensors(made.fused, thin(made), most=3)
    assert [len(one.places_mm) for one in choice.sets] == [1, 2, 3]
    first, second, _ = choice.sets
    assert first.loss.decided and first.loss.um > 0.2
    assert second.loss.at_most_um < 0.5 * first.loss.um
    near = [min(simulator.distance_cells(y / 10 - 0.5, x / 10 - 0.5, k) for x, y in second.places_mm) for k in (0, 1)]
    assert max(near) <= 5


def test_a_field_that_drives_nothing_leaves_it_undecided():
    made = simulator.driven_session(np.random.default_rng(5), source=0, um_per_unit=0.0)
    assert not choose_sensors(made.fused, thin(made), most=1).without.decided


def test_a_still_field_places_no_sensor(rng):
    made = simulator.driven_session(rng, source=0)
    still = thin(made).copy(data=20.0 + 0.03 * rng.standard_normal(thin(made).shape))
    assert choose_sensors(made.fused, still).sets == ()


def test_an_excess_within_its_uncertainty_is_no_loss():
    assert Excess(-0.1, 0.2).um == 0.0 and not Excess(-0.1, 0.2).decided
    assert Excess(0.25, 0.01).um == pytest.approx(0.5) and Excess(0.25, 0.01).decided
    assert Excess(0.0, 0.02).at_most_um == pytest.approx(0.2)
