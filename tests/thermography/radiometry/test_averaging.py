"""Sums and averages of counts: exact in whole numbers, and temperatures within their bound of those calibrated frame by frame."""

import numpy as np
import pytest

from tests.thermography.flir_mutations import PARAMETERS
from thermography.radiometry.averaging import Accumulator, CountStatistics, MeanTemperature, mean_temperature
from thermography.radiometry.planck import calibrate, counts_from_temperature, temperature_from_counts


def _accumulate(counts: np.ndarray) -> CountStatistics:
    sums = Accumulator(counts.shape[1:])
    sums.add(counts)
    return sums.statistics()


@pytest.mark.parametrize("reach", [3, 900, 2047, 2048, 30_000])
def test_sums_are_exact_however_far_the_counts_move(rng, reach):
    """Deviations of a few counts, at the limit of the 32-bit sums, and beyond it in one tile only; any number of frames."""
    counts = rng.integers(31_000, 31_000 + 3, (11, 3, 4000)).astype(np.uint16)
    counts[:, 1] = rng.integers(31_000 - reach, 31_000 + reach, (11, 4000))
    for frames in (1, 2, 3, 4, 9, 11):
        sums = Accumulator((3, 4000))
        sums.add(counts[: frames // 2 + 1])
        if frames > frames // 2 + 1:
            sums.add(counts[frames // 2 + 1 : frames])
        statistics, wide = sums.statistics(), counts[: sums.frames].astype(np.uint64)
        assert statistics.frames == sums.frames == max(frames, 1)
        assert (statistics.total == wide.sum(axis=0)).all()
        assert (statistics.squares == (wide**2).sum(axis=0)).all()
        assert (statistics.lowest == wide.min(axis=0)).all()
        assert (statistics.highest == wide.max(axis=0)).all()


@pytest.mark.parametrize(("first", "others"), [(0, 2047), (0, 65535), (65535, 0)])
def test_sums_hold_1000_frames_of_the_largest_deviation(first, others):
    """The largest near deviation in 999 of 1000 frames, so that the sum of the squares nearly fills 32 bits, and the largest of all."""
    counts = np.full((1000, 2), others, np.uint16)
    counts[0] = first
    statistics = _accumulate(counts)
    assert statistics.total.tolist() == [first + 999 * others] * 2
    assert statistics.squares.tolist() == [first**2 + 999 * others**2] * 2


def test_second_order_average_is_the_average_of_temperatures():
    """Scenes within 5 K: both ways agree below 1 mK, and the bound holds."""
    rng = np.random.default_rng(5)
    temperature = 22 + 5 * rng.random((200, 40, 50)) ** 3
    counts = np.round(counts_from_temperature(temperature, PARAMETERS)).astype(np.uint16)
    reduced = mean_temperature(_accumulate(counts), PARAMETERS)
    error = np.abs(reduced.mean - calibrate(counts, PARAMETERS).mean(axis=0, dtype=float))
    assert error.max() < 1e-3
    # calibrate works in single precision, which alone is 1 microkelvin.
    assert (error <= reduced.bound_K + 2e-6).all()
    # The slope of the curve changes by 1 % per kelvin, and the distribution is skewed.
    np.testing.assert_allclose(reduced.variance, calibrate(counts, PARAMETERS).var(axis=0, dtype=float), rtol=0.03)


def test_mean_of_two_counts_is_that_of_the_expansion():
    """Two frames 2 d apart: mean and variance of the counts are n and d^2, so the expansion is T(n) + T''(n) d^2 / 2."""
    n, d = 19_000, 200
    counts = np.array([n - d, n + d], np.uint16).reshape(2, 1)
    below, middle, above = temperature_from_counts([n - 1, n, n + 1], PARAMETERS)
    reduced = mean_temperature(_accumulate(counts), PARAMETERS)
    # Second differences over 1 count of temperatures with 1e-12 K rounding.
    assert reduced.mean[0] == pytest.approx(middle + (below - 2 * middle + above) * d**2 / 2, abs=1e-6)
    assert reduced.variance[0] == pytest.approx(((above - below) / 2 * d) ** 2, rel=1e-6)
    exact = temperature_from_counts(counts, PARAMETERS).mean()
    assert 0 < abs(reduced.mean[0] - exact) <= reduced.bound_K[0]


def test_merged_temperatures_are_those_of_all_frames(rng):
    values = rng.normal(25, 2, (12, 5))
    parts = [MeanTemperature(len(one), one.mean(0), one.var(0), np.full(5, 1e-4)) for one in np.split(values, [3, 4])]
    merged = parts[0].merge(parts[1]).merge(parts[2])
    assert merged.frames == 12
    np.testing.assert_allclose(merged.mean, values.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(merged.variance, values.var(axis=0), rtol=1e-12)


def test_unused_pixels_are_zero_and_counts_below_any_temperature_are_nan():
    counts = np.array([[18_000, 18_000, 100], [18_010, 18_010, 200]], np.uint16)
    reduced = mean_temperature(_accumulate(counts), PARAMETERS, used=np.array([True, False, True]))
    assert reduced.mean[0] > 20 and reduced.mean[1] == 0 and np.isnan(reduced.mean[2])
