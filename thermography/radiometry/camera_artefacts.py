"""What the camera itself adds to a series of frames: flat-field steps, repeated frames, bad pixels, slow drift.

A bolometer camera closes its shutter now and then to re-zero its pixels (flat-field correction, FFC); afterwards the whole picture
sits a few tenths of a kelvin higher or lower. `read_levels` reduces each frame to the level of a reference in one pass; the finders
work on these levels, so they cost nothing and never touch the frames again. Every finding is a `CameraFlag`; `anchor` says what to
add to each frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from thermography.io.flir import FrameReference
from thermography.io.frame import CameraParameters
from thermography.radiometry.planck import RadiometryError, calibrate

Cause = Literal["flat_field_step", "transient", "repeated_frame", "frozen_frames", "camera_drift"]
#: More equal frames in a row than this are a stopped camera, not a frame written twice.
_REPEATS_OF_A_FROZEN_CAMERA = 2
#: Share of the reference that must move with a step: a scene change moves a part, the shutter moves everything.
_SHARE_THAT_MOVES = 0.75
_NEIGHBOUR_FRAMES = 8

DEAD, OFFSET, NOISY = 1, 2, 4


@dataclass(frozen=True, eq=False)
class Levels:
    """The reference of each frame, dims (time,).

    Attributes
    ----------
    time : ndarray of datetime64[ms]
    change : ndarray of float64
        Median change of the reference since the frame before, K; 0 for the first.
    share : ndarray of float64
        Share of the reference's pixels that moved at least half as far, in the same direction.
    repeated : ndarray of bool
        Frames whose counts all equal those of the frame before.
    """

    time: NDArray[np.datetime64]
    change: NDArray[np.float64]
    share: NDArray[np.float64]
    repeated: NDArray[np.bool_]

    @property
    def level(self) -> NDArray[np.float64]:
        """Level of the reference against the first frame, K."""
        return np.cumsum(self.change)


@dataclass(frozen=True)
class CameraFlag:
    """A camera artefact.

    Attributes
    ----------
    cause : Cause
    index : int
        First frame that shows it.
    time : datetime64
    value_K, value_u_K : float
        Size of a step or drift and its standard uncertainty; 0 where there is none.
    message : str
        What was seen and what was done.
    """

    cause: Cause
    index: int
    time: np.datetime64
    value_K: float
    value_u_K: float
    message: str


def read_levels(
    frames: Sequence[FrameReference],
    parameters: Callable[[FrameReference], CameraParameters] | None = None,
    *,
    reference: NDArray[np.bool_] | None = None,
) -> Levels:
    """Read every frame once and reduce it to the level of a reference.

    Parameters
    ----------
    frames : sequence of FrameReference
        In time order.
    parameters : callable, optional
        From a frame to the parameters to calibrate it with; those of the file by default.
    reference : ndarray of bool, shape (row, column), optional
        Pixels of a patch that keeps its temperature. Left out, the median over the scene stands for its unmoved parts, which
        holds as long as less than half of the picture moves between two frames.

    Returns
    -------
    Levels

    Raises
    ------
    RadiometryError
        Where the reference has another shape than the frames, or no pixels.
    """
    if reference is not None and (reference.shape != frames[0].shape or not reference.any()):
        raise RadiometryError(
            f"reference: expected pixels in a mask of shape {frames[0].shape}, got {int(reference.sum())} in {reference.shape}"
        )
    change, share = np.zeros(len(frames)), np.ones(len(frames))
    repeated = np.zeros(len(frames), bool)
    before_counts, before = None, None
    for index, frame in enumerate(frames):
        counts = frame.read_counts()
        temperature = calibrate(counts, parameters(frame) if parameters else frame.parameters)
        seen = temperature.ravel() if reference is None else temperature[reference]
        if before is not None and before_counts is not None:
            repeated[index] = np.array_equal(counts, before_counts)
            difference = seen - before
            valid = difference[np.isfinite(difference)]
            if valid.size:
                change[index] = np.median(valid)
                share[index] = np.mean(valid * np.sign(change[index]) >= abs(change[index]) / 2)
        before_counts, before = counts, seen
    return Levels(np.array([frame.time for frame in frames], "datetime64[ms]"), change, share, repeated)


def find_repeats(levels: Levels) -> list[CameraFlag]:
    """Find frames written twice and stretches in which the camera stood still: noise never repeats a whole picture."""
    flags = []
    labels, count = ndimage.label(levels.repeated)
    for (run,) in ndimage.find_objects(labels)[:count]:
        length = run.stop - run.start
        frozen = length > _REPEATS_OF_A_FROZEN_CAMERA
        text = f"{length} frames repeat the counts of frame {run.start - 1}" + (
            ": the camera stood still" if frozen else ""
        )
        cause: Cause = "frozen_frames" if frozen else "repeated_frame"
        flags.append(CameraFlag(cause, run.start, levels.time[run.start], 0.0, 0.0, text))
    return flags


def find_steps(levels: Levels, *, smallest_step_K: float = 0.1, threshold: float = 8.0) -> list[CameraFlag]:
    """Find the jumps of the reference that the shutter makes.

    A step is a change between two frames that stands out of the local rate of change by `threshold` robust standard deviations, moves
    the whole reference, and stays.

    Parameters
    ----------
    levels : Levels
    smallest_step_K : float
        Smaller jumps are left to the drift.
    threshold : float

    Returns
    -------
    list of CameraFlag
        Cause "flat_field_step"; or "transient" for a jump that comes back or moves only a part of the reference, which is
        reported and not corrected.
    """
    fresh = np.flatnonzero(~levels.repeated)
    if fresh.size < 5:
        return []
    excess, rate, sigma = _excess_change(levels, fresh)
    candidates = np.flatnonzero(np.abs(excess) > max(smallest_step_K, threshold * sigma))
    level = levels.level[fresh]
    flags = []
    for place in candidates:
        step, u = _fit_step(levels.time[fresh], level, int(place), candidates)
        index = int(fresh[place])
        stays = _remainder(levels.time[fresh], level, int(place), float(rate[place])) / excess[place] > 0.5
        together = levels.share[index] >= _SHARE_THAT_MOVES
        if stays and together:
            text = f"the picture jumped by {step:+.3f} K between two frames and stayed (flat-field correction)"
            flags.append(CameraFlag("flat_field_step", index, levels.time[index], step, u, text))
        else:
            why = "came back" if together else f"moved {levels.share[index]:.0%} of the reference only"
            text = f"the picture jumped by {excess[place]:+.3f} K and {why}: not taken for a flat-field correction"
            flags.append(CameraFlag("transient", index, levels.time[index], float(excess[place]), sigma, text))
    return flags


def anchor(levels: Levels, steps: Sequence[CameraFlag]) -> NDArray[np.float64]:
    """Return what to add to the temperature of each frame (time,), K, so that steps vanish; the first frame stays."""
    correction = np.zeros(len(levels.time))
    for step in steps:
        if step.cause == "flat_field_step":
            correction[step.index :] -= step.value_K
    return correction


def _excess_change(levels: Levels, fresh: NDArray[np.intp]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return each change beyond what the local rate explains (K), that rate (K/s), and the robust standard deviation of the excess."""
    level = levels.level[fresh]
    seconds = (levels.time[fresh] - levels.time[fresh[0]]).astype(np.int64) / 1000
    interval, change = np.diff(seconds), np.diff(level)
    rate = change / np.where(interval > 0, interval, 1)
    local_rate = ndimage.median_filter(rate, size=2 * _NEIGHBOUR_FRAMES + 1, mode="nearest")
    excess = np.concatenate(([0.0], change - local_rate * interval))
    sigma = float(stats.median_abs_deviation(excess[1:], scale="normal"))
    return excess, np.concatenate(([0.0], local_rate)), sigma


def _remainder(time: NDArray[np.datetime64], level: NDArray[np.float64], place: int, rate: float) -> float:
    """Return how much higher the frames after `place` lie than those before it, beyond the local rate, K."""
    before, after = slice(max(place - _NEIGHBOUR_FRAMES, 0), place), slice(place, place + _NEIGHBOUR_FRAMES)
    seconds = (time - time[place]).astype(np.int64) / 1000
    between = np.median(seconds[after]) - np.median(seconds[before])
    return float(np.median(level[after]) - np.median(level[before]) - rate * between)


def _fit_step(
    time: NDArray[np.datetime64], level: NDArray[np.float64], place: int, others: NDArray[np.intp]
) -> tuple[float, float]:
    """Fit a straight line with a step to the frames around `place`, up to the neighbouring jumps; return step and its u, K."""
    first = max([place - _NEIGHBOUR_FRAMES, 0, *(others[others < place])])
    last = min([place + _NEIGHBOUR_FRAMES, len(level), *(others[others > place])])
    seconds = (time[first:last] - time[place]).astype(np.int64) / 1000
    design = np.column_stack((np.ones(last - first), seconds, np.arange(first, last) >= place))
    solution, _, rank, _ = np.linalg.lstsq(design, level[first:last], rcond=None)
    if rank < 3 or last - first <= 3:
        return float(level[place] - level[place - 1]), float("nan")
    residual = level[first:last] - design @ solution
    variance = residual @ residual / (last - first - 3)
    return float(solution[2]), float(np.sqrt(variance * np.linalg.inv(design.T @ design)[2, 2]))


@dataclass(frozen=True, eq=False)
class CameraDrift:
    """Slow drift of the camera as its own temperatures explain it.

    Attributes
    ----------
    correction : ndarray (time,)
        What to add to each frame, K; 0 at the first frame, and 0 everywhere where the housekeeping explains nothing.
    coefficients : dict of str to float
        K per K of each sensor.
    explained : float
        Share of the variance of the level that the housekeeping explains.
    p_value : float
        Of that share, with the number of independent frames reduced by their autocorrelation.
    flag : CameraFlag or None
        What was corrected; None where nothing was.
    """

    correction: NDArray[np.float64]
    coefficients: dict[str, float]
    explained: float
    p_value: float
    flag: CameraFlag | None = None


def regress_drift(
    levels: Levels,
    steps: Sequence[CameraFlag],
    camera_temperature: NDArray[np.float64],
    sensors: Sequence[str],
    *,
    significance: float = 0.01,
) -> CameraDrift:
    """Regress the level of a reference patch on the camera's own temperatures.

    Parameters
    ----------
    levels : Levels
        Of a patch that keeps its temperature: what it does is the camera's doing.
    steps : sequence of CameraFlag
        From `find_steps`; taken out first.
    camera_temperature : ndarray (time, sensor)
        K; sensors with gaps or without change are left out.
    sensors : sequence of str
    significance : float
        Above this p-value nothing is corrected.

    Returns
    -------
    CameraDrift
    """
    level = levels.level + anchor(levels, steps)
    moving = np.isfinite(camera_temperature).all(axis=0) & (np.ptp(camera_temperature, axis=0) > 0)
    names = [name for name, use in zip(sensors, moving, strict=True) if use]
    nothing = CameraDrift(np.zeros(len(level)), {}, 0.0, 1.0)
    if not names or len(level) < len(names) + 3 or np.ptp(level) == 0:
        return nothing
    centred = camera_temperature[:, moving] - camera_temperature[:, moving].mean(axis=0)
    # Sensors of one camera move together: directions with less than 1 % of the movement would only fit noise.
    left, singular, right = np.linalg.svd(centred, full_matrices=False)
    kept = singular > 0.01 * singular[0]
    target = level - level.mean()
    projection = left[:, kept].T @ target
    fitted = left[:, kept] @ projection
    explained = float(fitted @ fitted / (target @ target))
    p_value = _p_value(explained, int(kept.sum()), target - fitted, target)
    coefficients = right[kept].T @ (projection / singular[kept])
    if p_value > significance:
        return CameraDrift(nothing.correction, {}, explained, p_value)
    by_name = dict(zip(names, coefficients.tolist(), strict=True))
    size, u = float(np.ptp(fitted)), float(np.std(target - fitted))
    text = f"the camera's own temperatures explain {explained:.0%} of a drift; up to {size:.3f} K were taken out"
    flag = CameraFlag("camera_drift", 0, levels.time[0], size, u, text)
    return CameraDrift(fitted[0] - fitted, by_name, explained, p_value, flag)


def _p_value(explained: float, regressors: int, residual: NDArray[np.float64], target: NDArray[np.float64]) -> float:
    """Return the p-value of a share of variance, for series whose neighbours are alike."""

    def lag_one(series: NDArray[np.float64]) -> float:
        return float(np.clip(series[1:] @ series[:-1] / (series @ series), 0, 0.999)) if series.any() else 0.0

    # Bartlett: two autocorrelated series have fewer independent pairs than points.
    product = lag_one(residual) * lag_one(target)
    independent = len(target) * (1 - product) / (1 + product)
    freedom = independent - regressors - 1
    if freedom <= 0:
        return 1.0
    ratio = explained / regressors / max((1 - explained) / freedom, np.finfo(float).tiny)
    return float(stats.f.sf(ratio, regressors, freedom))


def find_bad_pixels(counts: NDArray[np.uint16], *, threshold: float = 8.0) -> NDArray[np.uint8]:
    """Find pixels that do not follow their neighbours.

    Parameters
    ----------
    counts : ndarray (time, row, column)
        A few dozen frames of a scene that hardly changes.
    threshold : float
        How many times further than its neighbours a pixel must be off.

    Returns
    -------
    ndarray of uint8, shape (row, column)
        Sum of flags: 1 dead (never changes), 2 offset (off its neighbours), 4 noisy; 0 for a good pixel.
    """
    stack = counts.astype(np.float32)
    mean, noise = stack.mean(axis=0), stack.std(axis=0)
    flags = np.where(_stands_out(mean, threshold), OFFSET, 0).astype(np.uint8)
    if len(stack) >= 8:
        flags |= np.where((noise == 0) & (np.median(noise) > 0), DEAD, 0).astype(np.uint8)
        flags |= np.where(_stands_out(noise, threshold) & (noise > np.median(noise)), NOISY, 0).astype(np.uint8)
    return flags


def _stands_out(picture: NDArray[np.float32], threshold: float) -> NDArray[np.bool_]:
    """Whether a pixel is off its neighbours much further than the pixels around it are off theirs.

    Off means: further from all but two of the eight neighbours. On an edge or corner of the scene at least three neighbours
    belong to the same surface, while clusters of up to three bad pixels still stand out.
    """
    rows, columns = picture.shape
    padded = np.pad(picture, 1, mode="reflect")
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    distances = [np.abs(picture - padded[row : row + rows, column : column + columns]) for row, column in shifts]
    off = np.partition(distances, 2, axis=0)[2]
    ring = np.ones((5, 5), bool)
    ring[2, 2] = False
    around = ndimage.percentile_filter(off, 90, footprint=ring)
    typical = max(float(np.median(off)), 1.0)
    result: NDArray[np.bool_] = off > threshold * np.maximum(around, typical)
    return result
