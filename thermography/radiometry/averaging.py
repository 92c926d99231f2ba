"""Temperature of averaged counts: exact to the second order, with a bound on what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import ZERO_CELSIUS_K, count_line

#: Where averaging counts may err by more than this, frames are calibrated one by one.
AVERAGING_LIMIT_K = 0.5e-3
#: Frames read and added at once, so that they are still in the cache when they are added and looked at.
CHUNK_FRAMES = 8
#: Pixels per tile, whose sums stay in the first cache while the frames of a chunk are added to them.
TILE_PX = 2048
#: Steps below this from the first frame are squared and added in 32 bits, ...
NEAR = 2048
#: ... which hold them, and the sums of all steps, for as many frames as this.
MOST_FRAMES = 1000


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

    Raises
    ------
    ThermographyError
        Not uint16, no frame, or more than `MOST_FRAMES`.
    """
    sums = Accumulator(counts.shape[1:])
    sums.add(counts)
    return sums.statistics()


class Accumulator:
    """Sums that grow by chunks of frames, so that a block of any length takes the memory of one chunk.

    What is added up are the steps from the first frame: they and nearly all their squares fit 32 bits, of which a processor
    adds twice as many at once as of 64. Where a pixel goes further, the squares of its tile are added in 64 bits.

    Parameters
    ----------
    shape
        Of one frame.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        pixels = int(np.prod(shape))
        self.frames = 0
        self.first, self.lowest, self.highest = (np.empty(pixels, np.uint16) for _ in range(3))
        self.steps, self.squares, self.far_squares = (
            np.zeros(pixels, kind) for kind in (np.int32, np.uint32, np.uint64)
        )

    def add(self, counts: NDArray[np.uint16]) -> None:
        """Add frames of counts, shape (time, ...)."""
        if counts.dtype != np.uint16 or len(counts) == 0 or counts.shape[1:] != self.shape:
            raise ThermographyError(
                f"counts: expected frames of {self.shape} uint16, got {counts.shape} {counts.dtype}"
            )
        if self.frames + len(counts) > MOST_FRAMES:
            raise ThermographyError(
                f"counts: {self.frames + len(counts)} frames, but the sums hold {MOST_FRAMES}; merge the statistics of several"
            )
        flat = np.ascontiguousarray(counts).reshape(len(counts), -1)
        if self.frames == 0:
            for start in (self.first, self.lowest, self.highest):
                start[:] = flat[0]
        _add(flat, self.first, self.steps, self.squares, self.far_squares, self.lowest, self.highest)
        self.frames += len(flat)

    def statistics(self) -> CountStatistics:
        """What has been added so far."""
        if self.frames == 0:
            raise ThermographyError("no frame has been added")
        total, squares = _sums(self.frames, self.first, self.steps, self.squares, self.far_squares)
        shape = self.shape
        return CountStatistics(
            self.frames,
            total.reshape(shape),
            squares.reshape(shape),
            self.lowest.reshape(shape).copy(),
            self.highest.reshape(shape).copy(),
        )


@numba.njit(cache=True, nogil=True)
def _add(
    counts: Array, first: Array, steps: Array, squares: Array, far_squares: Array, lowest: Array, highest: Array
) -> None:
    frames, pixels = counts.shape
    for start in range(0, pixels, TILE_PX):
        tile = slice(start, min(start + TILE_PX, pixels))
        origin = first[tile]
        for frame in range(0, frames, 4):
            # Four at once, so that the sums are loaded and stored once for all of them; missing ones are the first, a step of zero.
            a = counts[frame, tile]
            b = counts[frame + 1, tile] if frame + 1 < frames else origin
            c = counts[frame + 2, tile] if frame + 2 < frames else origin
            d = counts[frame + 3, tile] if frame + 3 < frames else origin
            if _add_limits(origin, a, b, c, d, lowest[tile], highest[tile]) < NEAR:
                _add_near(origin, a, b, c, d, steps[tile], squares[tile])
            else:
                _add_far(origin, a, b, c, d, steps[tile], far_squares[tile])


@numba.njit(cache=True, nogil=True)
def _add_limits(first: Array, a: Array, b: Array, c: Array, d: Array, lowest: Array, highest: Array) -> np.uint16:
    """Update the limits; return a number that is below `NEAR`, a power of two, if all steps so far are."""
    reach = np.uint16(0)
    for i in range(len(first)):
        low = min(lowest[i], min(min(a[i], b[i]), min(c[i], d[i])))
        high = max(highest[i], max(max(a[i], b[i]), max(c[i], d[i])))
        lowest[i], highest[i] = low, high
        reach = np.uint16(reach | np.uint16(high - first[i]) | np.uint16(first[i] - low))
    return reach


@numba.njit(cache=True, nogil=True)
def _add_near(first: Array, a: Array, b: Array, c: Array, d: Array, steps: Array, squares: Array) -> None:
    for i in range(len(first)):
        w, x = np.int16(a[i] - first[i]), np.int16(b[i] - first[i])
        y, z = np.int16(c[i] - first[i]), np.int16(d[i] - first[i])
        steps[i] += np.int32(np.int16(np.int16(w + x) + np.int16(y + z)))
        squares[i] += (
            np.uint32(np.int32(w) * np.int32(w))
            + np.uint32(np.int32(x) * np.int32(x))
            + np.uint32(np.int32(y) * np.int32(y))
            + np.uint32(np.int32(z) * np.int32(z))
        )


@numba.njit(cache=True, nogil=True)
def _add_far(first: Array, a: Array, b: Array, c: Array, d: Array, steps: Array, squares: Array) -> None:
    for i in range(len(first)):
        for value in (a[i], b[i], c[i], d[i]):
            step = np.int64(value) - np.int64(first[i])
            steps[i] += np.int32(step)
            squares[i] += np.uint64(step * step)


@numba.njit(cache=True, nogil=True)
def _sums(frames: int, first: Array, steps: Array, squares: Array, far_squares: Array) -> tuple[Array, Array]:
    """Sums of the counts and of their squares, from those of the steps."""
    total, all_squares = np.empty(len(first), np.uint64), np.empty(len(first), np.uint64)
    for i in range(len(first)):
        origin, step = np.int64(first[i]), np.int64(steps[i])
        total[i] = np.uint64(frames * origin + step)
        own = 2 * origin * step + frames * origin * origin + np.int64(squares[i])
        all_squares[i] = np.uint64(own) + far_squares[i]
    return total, all_squares


def mean_temperature(
    statistics: CountStatistics, parameters: CameraParameters, *, used: NDArray[np.bool_] | None = None
) -> MeanTemperature:
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
    used
        Pixels to work out, of the same shape; the others come back as zero.

    Returns
    -------
    MeanTemperature
        Same pixel shape.
    """
    p = parameters
    gain, offset = count_line(p)
    curve = np.array([p.planck_r1 / p.planck_r2, p.planck_b, p.planck_f, gain, offset - gain * p.planck_o])
    total, squares, lowest, highest = (
        values.ravel() for values in (statistics.total, statistics.squares, statistics.lowest, statistics.highest)
    )
    shape = statistics.total.shape
    wanted = np.ones(total.shape, bool) if used is None else used.ravel()
    mean, variance, bound = _mean_temperature(statistics.frames, total, squares, lowest, highest, curve, wanted)
    return MeanTemperature(statistics.frames, mean.reshape(shape), variance.reshape(shape), bound.reshape(shape))


@numba.njit(cache=True, nogil=True)
def _mean_temperature(
    frames: int, total: Array, squares: Array, lowest: Array, highest: Array, curve: Array, wanted: Array
) -> tuple[Array, Array, Array]:
    pixels = len(total)
    mean, variance, bound = np.zeros(pixels), np.zeros(pixels), np.zeros(pixels)
    n = np.uint64(frames)
    least, most = 65535, 0
    for i in range(pixels):
        if wanted[i]:
            least, most = min(least, lowest[i]), max(most, highest[i])
    # Temperature and its derivatives at whole counts: from the nearest one on, the third derivative adds less than a nanokelvin.
    table = np.empty((max(most - least, 0) + 1, 3))
    for k in range(len(table)):
        table[k, 0], table[k, 1], table[k, 2] = _derivatives(float(least + k), curve)
    steepest = abs(_third_derivative(float(least), curve))
    for i in range(pixels):
        if not wanted[i]:
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
            # The smallest count of the whole window is a coarse bound; only where it does not do, the pixel's own is worked out.
            own = abs(_third_derivative(float(low), curve))
            limit = own / 6 * spread * reach
            if np.isnan(own):
                temperature = np.nan
        mean[i] = temperature + 0.5 * second * spread
        variance[i] = first**2 * spread
        bound[i] = limit
    return mean, variance, bound


@numba.njit(cache=True, nogil=True)
def _derivatives(counts: float, curve: Array) -> tuple[float, float, float]:
    """Temperature (degC) and its first two derivatives by the counts, K per count to their power; NaN below any temperature."""
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


@numba.njit(cache=True, nogil=True)
def _third_derivative(counts: float, curve: Array) -> float:
    """Third derivative of the temperature by the counts, K per count cubed; it falls as the counts rise."""
    a, b, f, gain, offset = curve
    s = (counts - offset) / gain
    if s <= 0 or a / s + f <= 1:
        return np.nan
    log = np.log(a / s + f)
    d, d1, d2 = s * (a + f * s), a + 2 * f * s, 2 * f
    g, g1, g2 = a / d, -a * d1 / d**2, -a * d2 / d**2 + 2 * a * d1**2 / d**3
    return b * (g2 / log**2 + 6 * g * g1 / log**3 + 6 * g**3 / log**4) / gain**3
