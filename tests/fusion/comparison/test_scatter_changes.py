from __future__ import annotations

import numpy as np

from fusion.comparison.scatter_changes import compare_scatters

PLACE = np.linspace(0.0, 300.0, 16)


def sample(rng: np.random.Generator, freedom: int, sigma: np.ndarray | float = 1.0) -> np.ndarray:
    """Standard deviations of 16 positions."""
    return np.asarray(sigma * np.sqrt(rng.chisquare(freedom, 16) / freedom))


def least_p(rng: np.random.Generator, freedoms: tuple[int, int], after: np.ndarray | float = 1.0) -> float:
    one, other = sample(rng, freedoms[0]), sample(rng, freedoms[1], after)
    found = compare_scatters(PLACE, one, other, *(np.full(16, float(freedom)) for freedom in freedoms))
    return 16 * min(change.p_value for change in found)


def test_equal_scatter_and_a_noisier_day_raise_no_alarm(rng: np.random.Generator) -> None:
    """Nominal 5 %: of 300 pairs at most 25 (a binomial count exceeds that once in two hundred such tests)."""
    for freedoms, day in (((60, 60), 1.0), ((30, 120), 2.5), ((8, 8), 1.0)):
        assert sum(least_p(rng, freedoms, day) <= 0.05 for _ in range(300)) <= 25


def test_a_position_that_repeats_worse_is_found(rng: np.random.Generator) -> None:
    worse = np.ones(16)
    worse[4] = 2.0
    one, other, freedom = sample(rng, 100), sample(rng, 100, worse), np.full(16, 100.0)
    found = compare_scatters(PLACE, one, other, freedom, freedom)
    assert [change.position_mm for change in found if 16 * change.p_value <= 0.05] == [80.0]
    assert found[4].after_um == other[4]


def test_too_few_positions_are_not_compared() -> None:
    few = np.ones(4)
    assert compare_scatters(PLACE[:4], few, few, few * 50, few * 50) == []


def test_a_position_without_scatter_is_left_out(rng: np.random.Generator) -> None:
    one, other = sample(rng, 50), sample(rng, 50)
    one[0], other[1] = 0.0, np.nan
    found = compare_scatters(PLACE, one, other, np.full(16, 50.0), np.full(16, 50.0))
    assert len(found) == 14
