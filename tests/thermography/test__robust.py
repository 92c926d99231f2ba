"""The scatter by the median is that of SciPy's statistics, which are not loaded for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from thermography._robust import scatter_by_median


@pytest.mark.parametrize("shape", [(5,), (24,), (3, 7)])
def test_scatter_is_that_of_the_library(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(4).normal(3.0, 0.5, shape)
    assert scatter_by_median(values) == stats.median_abs_deviation(values, axis=None, scale="normal")
    about_zero = stats.median_abs_deviation(values, axis=None, center=lambda x, axis: 0.0, scale="normal")
    assert scatter_by_median(values, centre=0.0) == about_zero > scatter_by_median(values)


def test_missing_values_are_left_out_and_a_few_strange_ones_change_little() -> None:
    values = np.array([1.0, np.nan, 2.0, 3.0, 4.0, 5.0])
    one = 1.4826022185056018
    assert scatter_by_median(values) == pytest.approx(one)
    assert scatter_by_median([1.0, 2.0, 3.0, 4.0, 1e9]) == pytest.approx(one)


@pytest.mark.parametrize("values", [[], [np.nan, np.nan]])
def test_without_values_there_is_no_scatter(values: list[float]) -> None:
    assert np.isnan(scatter_by_median(values))
