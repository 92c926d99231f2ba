"""Averages counts over frames and converts the average to temperature, exact to second order and with a bound on the rest.

Calibrating every frame is slower than reading it. Frames that share their parameters are therefore reduced in counts: `Accumulator`
sums the counts of each pixel and their squares in whole numbers, `CountStatistics` holds the sums, and `mean_temperature` converts mean
and variance of the counts to those of the temperature. `MeanTemperature.bound_K` tells where that is not accurate enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermofuse.compiled import njit
from thermography.common import ZERO_CELSIUS_K, Array
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import count_line

#: Where averaging counts may err by more than this, the frames are calibrated one by one.
AVERAGING_LIMIT_K = 0.5e-3
#: Frames that are read and added at once, few enough to be still in the cache when they are added.
CHUNK_FRAMES = 8
#: Pixels per tile: its sums stay in the first-level cache while the frames of a chunk are added to them.
_TILE_PX = 2048
#: Deviations from the first frame below this are near: their squares are summed in 32 bits. A power of two.
_NEAR = 2048


@dataclass(frozen=True)
class CountStatistics:
    """Sums of counts over frames that share their parameters; whole numbers per pixel."""

    frames: int
    total: NDArray[np.uint64]
    squares: NDArray[np.uint64]
    lowest: NDArray[np.uint16]
    highest: NDArray[np.uint16]


class Accumulator:
    """Sums of counts that grow by chunks of frames, so that a block of up to 1000 frames needs the memory of one chunk.

    The deviations from the first frame are summed: they and nearly all their squares fit 32 bits, of which a processor adds twice as
    many at once as of 64. Where a pixel deviates further, the squares of its tile are summed in 64 bits. The largest sum of squares in 32
    bits, 1000 * 2047**2 = 4.19e9, is below 2**32 = 4.29e9, and the largest sum of deviations is 1000 * 65535 = 6.6e7.

    Parameters
    ----------
    shape : tuple of int
        Shape of one frame.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        pixels = int(np.prod(shape))
        self.frames = 0
        self.first, self.lowest, self.highest = (np.empty(pixels, np.uint16) for _ in range(3))
        self.deviations, self.squares, self.far_squares = (np.zeros(pixels, kind) for kind in ("i4", "u4", "u8"))

    def add(self, counts: NDArray[np.uint16]) -> None:
        """Add frames."""
        flat = np.ascontiguousarray(counts).reshape(len(counts), -1)
        if self.frames == 0:
            for reference in (self.first, self.lowest, self.highest):
                reference[:] = flat[0]
        _add(flat, self.first, self.deviations, self.squares, self.far_squares, self.lowest, self.highest)
        self.frames += len(flat)

    def statistics(self) -> CountStatistics:
        """Return the statistics of the frames added so far."""
        total, squares = _sums(self.frames, self.first, self.deviations, self.squares, self.far_squares)
        arrays: tuple[Array, ...] = (total, squares, self.lowest.copy(), self.highest.copy())
        return CountStatistics(self.frames, *(values.reshape(self.shape) for values in arrays))


@njit(nogil=True)
def _add(
    counts: Array, first: Array, deviations: Array, squares: Array, far_squares: Array, lowest: Array, highest: Array
) -> None:
    """Add frames (time, pixel) to the sums, tile by tile and four frames at once."""
    frames, pixels = counts.shape
    for start in range(0, pixels, _TILE_PX):
        tile = slice(start, min(start + _TILE_PX, pixels))
        origin = first[tile]
        for frame in range(0, frames, 4):
            # Four at once, so that the sums are loaded and stored once for all of them; a missing one is the first, a deviation of zero.
            a = counts[frame, tile]
            b = counts[frame + 1, tile] if frame + 1 < frames else origin
            c = counts[frame + 2, tile] if frame + 2 < frames else origin
            d = counts[frame + 3, tile] if frame + 3 < frames else origin
            if _add_limits(origin, a, b, c, d, lowest[tile], highest[tile]) < _NEAR:
                _add_near(origin, a, b, c, d, deviations[tile], squares[tile])
            else:
                _add_far(origin, a, b, c, d, deviations[tile], far_squares[tile])


@njit(nogil=True)
def _add_limits(first: Array, a: Array, b: Array, c: Array, d: Array, lowest: Array, highest: Array) -> np.uint16:
    """Update smallest and largest counts; return the bitwise or of all deviations from the first frame."""
    reach = np.uint16(0)
    for i in range(len(first)):
        low = min(lowest[i], min(min(a[i], b[i]), min(c[i], d[i])))
        high = max(highest[i], max(max(a[i], b[i]), max(c[i], d[i])))
        lowest[i], highest[i] = low, high
        reach = np.uint16(reach | np.uint16(high - first[i]) | np.uint16(first[i] - low))
    return reach


@njit(nogil=True)
def _add_near(first: Array, a: Array, b: Array, c: Array, d: Array, deviations: Array, squares: Array) -> None:
    """Add four frames whose deviations from the first are all below `_NEAR` in size."""
    # The difference of two unsigned counts wraps around where it is negative. Its lower 16 bits, read as int16, are the signed deviation
    # if that lies within -2**15 to 2**15 - 1: it does, being below _NEAR = 2**11 in size, and so does the sum of four, below 2**13.
    # In 16 bits a processor handles twice as many pixels at once as in 32. A square is below 2**22, so it needs 32 bits; for the sum of
    # all squares see `Accumulator`.
    for i in range(len(first)):
        w, x = np.int16(a[i] - first[i]), np.int16(b[i] - first[i])
        y, z = np.int16(c[i] - first[i]), np.int16(d[i] - first[i])
        deviations[i] += np.int32(np.int16(np.int16(w + x) + np.int16(y + z)))
        squares[i] += (
            np.uint32(np.int32(w) * np.int32(w))
            + np.uint32(np.int32(x) * np.int32(x))
            + np.uint32(np.int32(y) * np.int32(y))
            + np.uint32(np.int32(z) * np.int32(z))
        )


@njit(nogil=True)
def _add_far(first: Array, a: Array, b: Array, c: Array, d: Array, deviations: Array, squares: Array) -> None:
    """Add four frames with deviations of any size."""
    for i in range(len(first)):
        for value in (a[i], b[i], c[i], d[i]):
            deviation = np.int64(value) - np.int64(first[i])
            deviations[i] += np.int32(deviation)
            squares[i] += np.uint64(deviation * deviation)


@njit(nogil=True)
def _sums(frames: int, first: Array, deviations: Array, squares: Array, far_squares: Array) -> tuple[Array, Array]:
    """Return the sums of the counts and of their squares from those of the deviations."""
    total, all_squares = np.empty(len(first), np.uint64), np.empty(len(first), np.uint64)
    for i in range(len(first)):
        origin, deviation = np.int64(first[i]), np.int64(deviations[i])
        total[i] = np.uint64(frames * origin + deviation)
        near_squares = 2 * origin * deviation + frames * origin * origin + np.int64(squares[i])
        all_squares[i] = np.uint64(near_squares) + far_squares[i]
    return total, all_squares


@dataclass(frozen=True)
class MeanTemperature:
    """Mean of the temperature of each pixel over the frames in which it had one, degC (NaN: in none), mean squared deviation from it, K2,
    and bound on the error of the mean, K, beyond `AVERAGING_LIMIT_K` of which the frames are calibrated one by one; a pixel that is clipped
    in one of the frames has no mean, and an infinite deviation.
    """

    frames: int
    mean: Array
    variance: Array
    bound_K: Array

    @property
    def clipped(self) -> NDArray[np.bool_]:
        """Pixels that are clipped in one of the frames."""
        return np.isinf(self.variance)

    def merge(self, other: MeanTemperature) -> MeanTemperature:
        """Return mean and variance of both sets of frames together."""
        frames = self.frames + other.frames
        difference = other.mean - self.mean
        share = other.frames / frames
        mean = self.mean + difference * share
        variance = (1 - share) * self.variance + share * other.variance + share * (1 - share) * difference**2
        if np.isnan(mean.sum()):
            # A pixel without a temperature in one of both sets keeps that of the other.
            for lost, kept in ((self, other), (other, self)):
                replaced = np.isnan(lost.mean)
                mean[replaced], variance[replaced] = kept.mean[replaced], kept.variance[replaced]
            clipped = self.clipped | other.clipped
            mean[clipped], variance[clipped] = np.nan, np.inf
        return MeanTemperature(frames, mean, variance, np.maximum(self.bound_K, other.bound_K))


def mean_temperature(
    statistics: CountStatistics, parameters: CameraParameters, *, used: NDArray[np.bool_] | None = None
) -> MeanTemperature:
    """Return mean and variance of the temperature from sums of counts, without reading the frames again."""
    p = parameters
    gain, offset = count_line(p)
    curve = np.array([p.planck_r1 / p.planck_r2, p.planck_b, p.planck_f, gain, offset - gain * p.planck_o])
    total, squares, lowest, highest = (
        values.ravel() for values in (statistics.total, statistics.squares, statistics.lowest, statistics.highest)
    )
    shape = statistics.total.shape
    evaluated = np.ones(total.shape, bool) if used is None else used.ravel()
    mean, variance, bound = _mean_temperature(statistics.frames, total, squares, lowest, highest, curve, evaluated)
    return MeanTemperature(statistics.frames, mean.reshape(shape), variance.reshape(shape), bound.reshape(shape))


@njit(nogil=True)
def _mean_temperature(
    frames: int, total: Array, squares: Array, lowest: Array, highest: Array, curve: Array, evaluated: Array
) -> tuple[Array, Array, Array]:
    """Return mean (degC), variance (K^2) and error bound (K) of each pixel; for `curve` see `_derivatives`."""
    pixels = len(total)
    mean, variance, bound = np.zeros(pixels), np.zeros(pixels), np.zeros(pixels)
    n = np.uint64(frames)
    least, most = 65535, 0
    for i in range(pixels):
        if evaluated[i]:
            least, most = min(least, lowest[i]), max(most, highest[i])
    # Temperature and its derivatives at whole counts: from the nearest one, the third derivative adds less than a nanokelvin.
    table = np.empty((max(most - least, 0) + 1, 3))
    for k in range(len(table)):
        table[k, 0], table[k, 1], table[k, 2] = _derivatives(float(least + k), curve)
    steepest = abs(_third_derivative(float(least), curve))
    for i in range(pixels):
        if not evaluated[i]:
            continue
        low = np.uint64(lowest[i])
        first_moment = float(total[i] - n * low) / frames
        counts = float(low) + first_moment
        spread = max(float(squares[i] + n * low * low - np.uint64(2) * low * total[i]) / frames - first_moment**2, 0.0)
        nearest = int(counts - least + 0.5)
        step = counts - least - nearest
        second = table[nearest, 2]
        first = table[nearest, 1] + second * step
        temperature = table[nearest, 0] + (table[nearest, 1] + 0.5 * second * step) * step
        reach = max(highest[i] - counts, counts - float(low))
        limit = steepest / 6 * spread * reach
        if not limit <= AVERAGING_LIMIT_K:
            # The smallest count of the whole window gives a coarse bound; where it does not suffice, that of the pixel is evaluated.
            steepest_of_pixel = abs(_third_derivative(float(low), curve))
            limit = steepest_of_pixel / 6 * spread * reach
            if np.isnan(steepest_of_pixel):
                temperature = np.nan
        mean[i] = temperature + 0.5 * second * spread
        variance[i] = first**2 * spread
        bound[i] = limit
    return mean, variance, bound


@njit(nogil=True)
def _derivatives(counts: float, curve: Array) -> tuple[float, float, float]:
    """Return the temperature (degC) and its first two derivatives by the counts (K/count, K/count^2); NaN below any temperature."""
    a, b, f, gain, offset = curve
    s = (counts - offset) / gain
    if s <= 0 or a / s + f <= 1:
        return np.nan, np.nan, np.nan
    inverse_log = 1 / np.log(a / s + f)
    inverse_d = 1 / (s * (a + f * s))
    g = a * inverse_d
    g1 = -g * (a + 2 * f * s) * inverse_d
    first = b * g * inverse_log**2
    second = b * inverse_log**2 * (g1 + 2 * g * g * inverse_log)
    return b * inverse_log - ZERO_CELSIUS_K, first / gain, second / gain**2


@njit(nogil=True)
def _third_derivative(counts: float, curve: Array) -> float:
    """Return the third derivative of the temperature by the counts, K/count^3; its size falls as the counts rise."""
    a, b, f, gain, offset = curve
    s = (counts - offset) / gain
    if s <= 0 or a / s + f <= 1:
        return np.nan
    log = np.log(a / s + f)
    d, d1, d2 = s * (a + f * s), a + 2 * f * s, 2 * f
    g, g1, g2 = a / d, -a * d1 / d**2, -a * d2 / d**2 + 2 * a * d1**2 / d**3
    return b * (g2 / log**2 + 6 * g * g1 / log**3 + 6 * g**3 / log**4) / gain**3
