"""L1 - Temperature of averaged counts: exact to the second order, with a bound on what is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from thermography.flir import CameraParameters
from thermography.radiometry import count_line, temperature_from_counts

Array = NDArray[Any]

#: Where averaging counts may err by more than this, frames are calibrated one by one.
AVERAGING_LIMIT_K = 0.5e-3
#: Pixels per tile: sums of one tile stay in the cache while many frames pass over it.
TILE_PX = 32768


@dataclass(frozen=True)
class CountStatistics:
    """Sums over frames that share their parameters; whole numbers, so that merging them is exact in any order.

    Attributes
    ----------
    frames
        How many frames.
    total, squares
        Sum of the counts and of their squares per pixel, uint64.
    lowest, highest
        Smallest and largest count per pixel, uint16.
    """

    frames: int
    total: NDArray[np.uint64]
    squares: NDArray[np.uint64]
    lowest: NDArray[np.uint16]
    highest: NDArray[np.uint16]

    def merge(self, other: CountStatistics) -> CountStatistics:
        """Statistics of both sets of frames."""
        return CountStatistics(
            self.frames + other.frames,
            self.total + other.total,
            self.squares + other.squares,
            np.minimum(self.lowest, other.lowest),
            np.maximum(self.highest, other.highest),
        )

    @property
    def mean(self) -> Array:
        """Mean count per pixel, float64."""
        return self.total / self.frames

    @property
    def variance(self) -> Array:
        """Mean squared deviation per pixel from its mean (divided by the number of frames), counts squared."""
        # About the smallest count, in whole numbers: the squares of the counts themselves would cancel in floating point.
        lowest = self.lowest.astype(np.uint64)
        total = self.total - np.uint64(self.frames) * lowest
        squares = self.squares + np.uint64(self.frames) * lowest * lowest - np.uint64(2) * lowest * self.total
        return np.maximum(squares / self.frames - (total / self.frames) ** 2, 0.0)


@dataclass(frozen=True)
class MeanTemperature:
    """Temperature over frames: mean and mean squared deviation per pixel, and how wrong the mean may be at most.

    Attributes
    ----------
    frames
        How many frames.
    mean
        degC, float64; NaN where any of the counts was below what any temperature gives.
    variance
        Mean squared deviation (divided by the number of frames), K2.
    bound_K
        Bound on the error of averaging counts to the second order. Where it exceeds `AVERAGING_LIMIT_K`, the frames were
        calibrated one by one instead.
    """

    frames: int
    mean: Array
    variance: Array
    bound_K: Array

    def merge(self, other: MeanTemperature) -> MeanTemperature:
        """Both sets of frames together (Chan, Golub and LeVeque 1983)."""
        frames = self.frames + other.frames
        step = other.mean - self.mean
        part = other.frames / frames
        return MeanTemperature(
            frames,
            self.mean + step * part,
            (1 - part) * self.variance + part * other.variance + part * (1 - part) * step**2,
            np.maximum(self.bound_K, other.bound_K),
        )


def accumulate(counts: NDArray[np.uint16]) -> CountStatistics:
    """Sum counts, shape (time, ...), over time.

    Parameters
    ----------
    counts
        uint16, at most 65,536 frames.

    Raises
    ------
    ValueError
        Not uint16, no frame, or more frames than a 32-bit sum holds.
    """
    if counts.dtype != np.uint16 or not 0 < len(counts) <= 65536:
        raise ValueError(
            f"counts: expected 1..65536 frames of uint16, got {counts.dtype} of shape {counts.shape}; add smaller blocks"
        )
    shape = counts.shape[1:]
    flat = np.ascontiguousarray(counts).reshape(len(counts), -1)
    total, squares, lowest, highest = _accumulate(flat)
    return CountStatistics(
        len(flat), total.reshape(shape), squares.reshape(shape), lowest.reshape(shape), highest.reshape(shape)
    )


@numba.njit(cache=True, nogil=True)
def _accumulate(counts: Array) -> tuple[Array, Array, Array, Array]:
    frames, pixels = counts.shape
    total = np.zeros(pixels, np.uint64)
    squares = np.zeros(pixels, np.uint64)
    lowest = np.full(pixels, np.uint16(65535), np.uint16)
    highest = np.zeros(pixels, np.uint16)
    tile_total = np.empty(min(TILE_PX, pixels), np.uint32)
    for start in range(0, pixels, TILE_PX):
        stop = min(start + TILE_PX, pixels)
        tile_total[:] = 0
        q, low, high = squares[start:stop], lowest[start:stop], highest[start:stop]
        for frame in range(frames):
            row = counts[frame, start:stop]
            for i in range(stop - start):
                value = np.uint32(row[i])
                tile_total[i] += value
                q[i] += np.uint64(value) * np.uint64(value)
                low[i] = min(low[i], row[i])
                high[i] = max(high[i], row[i])
        for i in range(stop - start):
            total[start + i] = tile_total[i]
    return total, squares, lowest, highest


def mean_temperature(statistics: CountStatistics, parameters: CameraParameters) -> MeanTemperature:
    """Return mean and variance of the temperature from sums of counts, without going through the frames again.

    The mean of a curved function is the function of the mean plus half its curvature times the variance; the rest is bounded by
    the largest third derivative between the smallest and the largest count (it falls with the count, so it is the one at the
    smallest) times a sixth of the mean absolute third moment, itself at most the variance times the largest deviation.

    Parameters
    ----------
    statistics
        Sums over frames that share `parameters`.
    parameters
        Of these frames.

    Returns
    -------
    MeanTemperature
        Same pixel shape.
    """
    mean, variance = statistics.mean, statistics.variance
    first, second, _ = _derivatives(mean, parameters)
    _, _, third = _derivatives(statistics.lowest.astype(float), parameters)
    reach = np.maximum(statistics.highest - mean, mean - statistics.lowest)
    lowest = temperature_from_counts(statistics.lowest, parameters)
    return MeanTemperature(
        statistics.frames,
        np.where(np.isfinite(lowest), temperature_from_counts(mean, parameters) + 0.5 * second * variance, np.nan),
        first**2 * variance,
        np.abs(third) / 6 * variance * reach,
    )


def _derivatives(counts: Array, parameters: CameraParameters) -> tuple[Array, Array, Array]:
    """First, second and third derivative of the temperature by the counts, K per count to the first, second and third power."""
    p = parameters
    gain, offset = count_line(p)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = (counts - offset) / gain + p.planck_o
        a = p.planck_r1 / p.planck_r2
        log = np.log(a / s + p.planck_f)
        d, d1, d2 = s * (a + p.planck_f * s), a + 2 * p.planck_f * s, 2 * p.planck_f
        g, g1, g2 = a / d, -a * d1 / d**2, -a * d2 / d**2 + 2 * a * d1**2 / d**3
        first = p.planck_b * g / log**2
        second = p.planck_b * (g1 / log**2 + 2 * g**2 / log**3)
        third = p.planck_b * (g2 / log**2 + 6 * g * g1 / log**3 + 6 * g**3 / log**4)
    return first / gain, second / gain**2, third / gain**3
