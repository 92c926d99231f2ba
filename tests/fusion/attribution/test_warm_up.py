"""How many modes a film holds, and whether it is more than one warm-up."""

import numpy as np
import pytest

from fusion.attribution.warm_up import describe_excitation, thermal_modes, warm_up_columns
from tests.fusion import film_simulator as simulator

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
    found = describe_excitation(SECONDS, noise)
    assert not found.warm_up_only
    assert found.name == "varied"


@pytest.mark.parametrize(("kind", "only"), [("warm", True), ("duty", False), ("rw", False)])
def test_one_warm_up_is_told_from_switched_and_wandering_films(kind, only):
    for seed in range(5):
        film = simulator.film(kind, np.random.default_rng([seed, 6]))
        assert describe_excitation(SECONDS, flat(film)).warm_up_only is only


def test_exponentials_of_other_constants_are_within_reach_of_the_columns():
    columns = np.column_stack([np.ones(100), SECONDS, warm_up_columns(SECONDS)])
    for tau in (700.0, 2000.0, 5000.0, 9000.0):
        course = np.exp(-SECONDS / tau)
        rest = course - columns @ np.linalg.lstsq(columns, course, rcond=None)[0]
        # Far less than the hundredth of the variance that decides between a warm-up and more.
        assert rest.var() < 1e-3 * course.var()
