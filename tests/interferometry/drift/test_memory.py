"""Memory of the noise over the cycles: recognised, taken out, and not invented."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.drift.memory import typical_memory


def series(rng: np.random.Generator, correlation: float, *, rows: int = 32, cycles: int = 100) -> np.ndarray:
    values = rng.standard_normal((rows, cycles))
    for k in range(1, cycles):
        values[:, k] = correlation * values[:, k - 1] + np.sqrt(1 - correlation**2) * values[:, k]
    return values - values.mean(axis=1, keepdims=True)


def test_independent_noise_has_no_memory_and_stays_as_it_is(rng: np.random.Generator) -> None:
    values = series(rng, 0.0)
    memory = typical_memory(values)
    assert memory.weights.size == 0
    assert memory.long_run == 1.0
    assert memory.innovations(values) is values


def test_memory_is_recognised_and_taken_out(rng: np.random.Generator) -> None:
    values = series(rng, 0.4)
    memory = typical_memory(values)
    # 3,200 values: the standard error of a correlation is 0.016, its bias after taking the means 0.02.
    assert memory.weights[0] == pytest.approx(0.4, abs=0.06)
    assert memory.long_run == pytest.approx(1.4 / 0.6, abs=0.4)
    innovations = memory.innovations(values)
    assert innovations.shape == values.shape
    lag_one = (innovations[:, 1:] * innovations[:, :-1]).sum() / (innovations**2).sum()
    assert abs(lag_one) < 0.06
    assert innovations[:, 0].std() == pytest.approx(innovations.std(), rel=0.5)


def test_a_position_that_moves_by_itself_is_no_memory_of_all(rng: np.random.Generator) -> None:
    values = series(rng, 0.0)
    values[4:6] += 3.0 * np.sin(np.linspace(0, 6, 100))
    assert typical_memory(values).weights.size == 0


def test_series_without_values_or_too_few_cycles_have_no_memory() -> None:
    assert typical_memory(np.zeros((4, 50))).weights.size == 0
    assert typical_memory(np.ones((4, 3))).weights.size == 0
