"""How many modes a film holds, and whether it is more than one warm-up."""

import numpy as np
import pytest

from fusion.attribution.warm_up import Excitation, describe_excitation, nuisance_columns, thermal_modes, warm_up_columns
from tests.fusion import field_simulator as simulator

SECONDS = np.arange(simulator.CYCLES) * simulator.PERIOD_S


def flat(film):
    values = film.reshape(film.shape[0], -1)
    return values - values.mean(axis=0)


def test_modes_above_the_noise_are_counted_and_rebuild_the_film(rng):
    clean = np.cumsum(rng.standard_normal((100, 3)), axis=0) @ rng.standard_normal((3, 400))
    values = clean - clean.mean(axis=0)
    courses, patterns = thermal_modes(values + 0.05 * rng.standard_normal(values.shape))
    assert courses.shape == (100, 3)
    # What is left out is noise in the three modes' own span.
    assert (courses @ patterns - values).std() < 0.02
    assert np.sqrt((courses**2).sum() / 100) == pytest.approx(values.std(), rel=0.01)


def test_noise_alone_has_no_modes(rng):
    noise = 0.03 * rng.standard_normal((100, 500))
    assert thermal_modes(noise - noise.mean(axis=0))[0].shape[1] == 0
    excitation = describe_excitation(noise, SECONDS)
    assert not excitation.warm_up_only
    assert excitation.name == "varied"


@pytest.mark.parametrize(("kind", "only"), [("warm", True), ("duty", False), ("rw", False)])
def test_one_warm_up_is_told_from_switched_and_wandering_films(kind, only):
    for seed in range(5):
        film = simulator.film(kind, np.random.default_rng([seed, 6]))
        assert describe_excitation(flat(film), SECONDS).warm_up_only is only


def test_exponentials_of_other_constants_are_within_reach_of_the_columns():
    columns = np.column_stack([np.ones(100), SECONDS, warm_up_columns(SECONDS)])
    for tau in (700.0, 2000.0, 5000.0, 9000.0):
        course = np.exp(-SECONDS / tau)
        rest = course - columns @ np.linalg.lstsq(columns, course, rcond=None)[0]
        # Far less than the hundredth of the variance that decides between a warm-up and more.
        assert rest.var() < 1e-3 * course.var()


def test_a_warm_up_that_dominates_becomes_part_of_every_hypothesis():
    assert nuisance_columns(SECONDS, Excitation(0.94, False, 3)).shape == (100, 2)
    protected = nuisance_columns(SECONDS, Excitation(0.96, False, 3))
    np.testing.assert_array_equal(protected[:, 2:], warm_up_columns(SECONDS))
