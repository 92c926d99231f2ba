"""Quantities of the standard from means and standard deviations, one test or many at once."""

from __future__ import annotations

import numpy as np
import pytest

from interferometry.iso230.quantities import axis_quantities, target_quantities


def test_a_test_worked_by_hand() -> None:
    mean, s = np.array([[0.0, 4.0, 6.0], [1.0, 2.0, 3.0]]), np.array([[0.5, 0.25, 0.5], [0.25, 0.25, 1.0]])
    both, reversal, repeatability = target_quantities(mean, s)
    assert both.tolist() == [0.5, 3.0, 4.5]
    assert reversal.tolist() == [-1.0, 2.0, 3.0]
    # 2 (0.5 + 0.25) + 1, 2 (0.25 + 0.25) + 2, 2 (0.5 + 1) + 3; four times either s is less.
    assert repeatability.tolist() == [2.5, 3.0, 6.0]
    found = axis_quantities(mean, s)
    axis = {name: float(found[name]) for name in "BREMA"}
    assert axis == {"B": 3.0, "R": 6.0, "E": 6.0, "M": 4.0, "A": 8.0}
    assert found["R_unidirectional"].tolist() == [2.0, 4.0]
    assert found["E_unidirectional"].tolist() == [6.0, 2.0]
    # (6 + 1) - (0 - 1), (3 + 2) - (1 - 0.5) against 3 - 2 = 1 at the last position.
    assert found["A_unidirectional"].tolist() == [8.0, 4.5]


def test_many_tests_at_once_are_each_by_itself() -> None:
    rng = np.random.default_rng(2)
    mean, s = rng.normal(0, 5, (7, 2, 6)), rng.uniform(0.1, 1, (7, 2, 6))
    together = axis_quantities(mean, s)
    for k in range(7):
        for name, value in axis_quantities(mean[k], s[k]).items():
            assert together[name][k] == pytest.approx(value)


def test_what_one_direction_cannot_tell_is_nan() -> None:
    mean = np.array([[0.0, 3.0], [np.nan, np.nan]])
    found = axis_quantities(mean, np.where(np.isnan(mean), np.nan, 0.5))
    assert all(np.isnan(found[name]) for name in "BREMA")
    assert found["A_unidirectional"][0] == 5.0
