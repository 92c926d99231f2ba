"""Detects artefacts of the camera in a series of frames: flat-field steps, repeated frames, slow drift and bad pixels.

A bolometer camera closes its shutter from time to time to re-zero its pixels (flat-field correction, an NUC/FFC event); afterwards the
whole thermogram is a few tenths of a kelvin higher or lower. `read_levels` reduces each frame to the level of a reference in one pass.
`find_steps`, `find_repeats` and `regress_drift` work on these levels and do not read the frames again; `anchor` returns the correction
of the steps. See ``docs/method/radiometry.md``.
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
#: More repeats in a row than this mean that the camera output was frozen, not that a frame was written twice.
_MAX_REPEATS = 2
#: Share of the reference that must shift with a step: a change of the scene shifts a part of it, an FFC event all of it.
_SHIFTED_SHARE = 0.75
#: Frames on each side of a step that are compared.
_NEIGHBOUR_FRAMES = 8

#: Flags of `find_bad_pixels`.
DEAD, OFFSET, NOISY = 1, 2, 4


@dataclass(frozen=True, eq=False)
class Levels:
    """Level of the reference in each of n frames.

    Attributes
    ----------
    time : (n,) ndarray of datetime64[ms]
        UTC.
    change : (n,) ndarray of float64
        Median change of the reference since the previous frame, K; 0 for the first.
    share : (n,) ndarray of float64
        Share of the pixels of the reference that changed by at least half of `change`, in the same direction.
    repeated : (n,) ndarray of bool
        True where all counts equal those of the previous frame.
    """

    time: NDArray[np.datetime64]
    change: NDArray[np.float64]
    share: NDArray[np.float64]
    repeated: NDArray[np.bool_]

    @property
    def level(self) -> NDArray[np.float64]:
        """Level of the reference relative to the first frame, (n,), K."""
        return np.cumsum(self.change)


@dataclass(frozen=True)
class CameraFlag:
    """A camera artefact.

    Attributes
    ----------
    cause : {"flat_field_step", "transient", "repeated_frame", "frozen_frames", "camera_drift"}
        Kind of artefact.
    index : int
        Index of the first frame that shows it.
    time : datetime64[ms]
        Time of this frame, UTC.
    value_K, value_u_K : float
        Size of a step or drift and its standard uncertainty, K; 0 for repeated frames.
    message : str
        Description in one sentence, without a full stop.
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
        n frames in order of time.
    parameters : callable, optional
        Maps a frame to the parameters to calibrate it with; those of the file by default.
    reference : (row, column) ndarray of bool, optional
        Pixels of a surface of constant temperature. By default the whole frame: its median change is that of the unchanged parts of
        the scene as long as less than half of the pixels change between two frames.

    Returns
    -------
    Levels
        Change of the reference from frame to frame, (n,), K.

    Raises
    ------
    RadiometryError
        Where the reference has another shape than the frames, or no pixels.
    FlirFormatError
        Where the pixels of a frame are damaged.
    """
    if reference is not None and (reference.shape != frames[0].shape or not reference.any()):
        raise RadiometryError(
            f"reference: expected pixels in a mask of shape {frames[0].shape}, got {int(reference.sum())} in {reference.shape}"
        )
    change, share = np.zeros(len(frames)), np.ones(len(frames))
    repeated = np.zeros(len(frames), bool)
    previous_counts, previous = None, None
    for index, frame in enumerate(frames):
        counts = frame.read_counts()
        temperature = calibrate(counts, parameters(frame) if parameters else frame.parameters)
        current = temperature.ravel() if reference is None else temperature[reference]
        if previous is not None and previous_counts is not None:
            repeated[index] = np.array_equal(counts, previous_counts)
            difference = current - previous
            valid = difference[np.isfinite(difference)]
            if valid.size:
                change[index] = np.median(valid)
                share[index] = np.mean(valid * np.sign(change[index]) >= abs(change[index]) / 2)
        previous_counts, previous = counts, current
    return Levels(np.array([frame.time for frame in frames], "datetime64[ms]"), change, share, repeated)


def find_repeats(levels: Levels) -> list[CameraFlag]:
    """Find frames that were written twice and intervals in which the camera output was frozen.

    Parameters
    ----------
    levels : Levels
        Levels of all frames, without gaps. Noise never repeats a whole frame, so equal counts are the same frame.

    Returns
    -------
    list of CameraFlag
        Cause "repeated_frame" for up to two repeats in a row, "frozen_frames" for more.
    """
    flags = []
    labels, count = ndimage.label(levels.repeated)
    for (run,) in ndimage.find_objects(labels)[:count]:
        length = run.stop - run.start
        frozen = length > _MAX_REPEATS
        text = f"{length} {'frame repeats' if length == 1 else 'frames repeat'} the counts of frame {run.start - 1}"
        text += ": the camera output was frozen" if frozen else ""
        cause: Cause = "frozen_frames" if frozen else "repeated_frame"
        flags.append(CameraFlag(cause, run.start, levels.time[run.start], 0.0, 0.0, text))
    return flags


def find_steps(levels: Levels, *, smallest_step_K: float = 0.1, threshold: float = 8.0) -> list[CameraFlag]:
    """Find the steps that a flat-field correction of the camera causes in the level of the reference.

    A step is a change between two frames that exceeds the local rate of change by `threshold` robust standard deviations, shifts the
    whole reference, and remains.

    Parameters
    ----------
    levels : Levels
        Levels of at least 5 frames that are not repeated; with fewer, no step is reported.
    smallest_step_K : float
        Smaller changes are not reported, K.
    threshold : float
        Multiple of the robust standard deviation (1.4826 MAD) of the changes beyond the local rate.

    Returns
    -------
    list of CameraFlag
        Cause "flat_field_step" with the fitted size of the step and its standard uncertainty, K (NaN with too few neighbours for a
        fit); or "transient" for a change that returns or shifts only a part of the reference, which `anchor` does not correct.
    """
    distinct = np.flatnonzero(~levels.repeated)
    if distinct.size < 5:
        return []
    excess, rate, sigma = _excess_change(levels, distinct)
    candidates = np.flatnonzero(np.abs(excess) > max(smallest_step_K, threshold * sigma))
    level = levels.level[distinct]
    flags = []
    for place in candidates:
        step, u = _fit_step(levels.time[distinct], level, int(place), candidates)
        index = int(distinct[place])
        remains = _lasting_shift(levels.time[distinct], level, int(place), float(rate[place])) / excess[place] > 0.5
        whole = levels.share[index] >= _SHIFTED_SHARE
        if remains and whole:
            text = f"the level of the thermogram shifted by {step:+.3f} K between two frames and remained (flat-field correction)"
            flags.append(CameraFlag("flat_field_step", index, levels.time[index], step, u, text))
        else:
            why = "returned" if whole else f"in only {levels.share[index]:.0%} of the reference"
            shift = f"the level of the thermogram shifted by {excess[place]:+.3f} K"
            text = f"{shift} {'and ' if whole else ''}{why}: not attributed to a flat-field correction"
            flags.append(CameraFlag("transient", index, levels.time[index], float(excess[place]), sigma, text))
    return flags


def anchor(levels: Levels, steps: Sequence[CameraFlag]) -> NDArray[np.float64]:
    """Return the correction that removes flat-field steps from a series of frames.

    Parameters
    ----------
    levels : Levels
        Levels of the n frames.
    steps : sequence of CameraFlag
        From `find_steps`; only those with the cause "flat_field_step" are corrected.

    Returns
    -------
    (n,) ndarray of float64
        Correction to add to the temperature of each frame, K; 0 for the frames before the first step.
    """
    correction = np.zeros(len(levels.time))
    for step in steps:
        if step.cause == "flat_field_step":
            correction[step.index :] -= step.value_K
    return correction


def _excess_change(
    levels: Levels, distinct: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the change of each frame beyond the local rate (K), this rate (K/s), and the robust standard deviation of the excess (K)."""
    level = levels.level[distinct]
    seconds = (levels.time[distinct] - levels.time[distinct[0]]).astype(np.int64) / 1000
    interval, change = np.diff(seconds), np.diff(level)
    rate = change / np.where(interval > 0, interval, 1)
    local_rate = ndimage.median_filter(rate, size=2 * _NEIGHBOUR_FRAMES + 1, mode="nearest")
    excess = np.concatenate(([0.0], change - local_rate * interval))
    sigma = float(stats.median_abs_deviation(excess[1:], scale="normal"))
    return excess, np.concatenate(([0.0], local_rate)), sigma


def _lasting_shift(time: NDArray[np.datetime64], level: NDArray[np.float64], place: int, rate: float) -> float:
    """Return the difference between the median levels after and before `place`, less the local rate of change, K."""
    before, after = slice(max(place - _NEIGHBOUR_FRAMES, 0), place), slice(place, place + _NEIGHBOUR_FRAMES)
    seconds = (time - time[place]).astype(np.int64) / 1000
    interval = np.median(seconds[after]) - np.median(seconds[before])
    return float(np.median(level[after]) - np.median(level[before]) - rate * interval)


def _fit_step(
    time: NDArray[np.datetime64], level: NDArray[np.float64], place: int, others: NDArray[np.intp]
) -> tuple[float, float]:
    """Fit a straight line with a step at `place` by least squares, up to the neighbouring steps; return the step and its u, K."""
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
    """Slow drift of the camera, as far as its internal temperatures explain it.

    Attributes
    ----------
    correction : (n,) ndarray of float64
        Correction to add to the temperature of each of n frames, K; 0 for the first frame, and for all where the regression is not
        significant.
    coefficients : dict of str to float
        Drift per change of each internal temperature, K/K; empty where the regression is not significant.
    explained : float
        Share of the variance of the level that the internal temperatures explain, 0 to 1.
    p_value : float
        p-value of this share under the null hypothesis of no relation, for autocorrelated series.
    flag : CameraFlag or None
        The correction as a camera artefact; None where nothing was corrected.
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
    """Regress the level of a reference on the temperatures inside the camera.

    Parameters
    ----------
    levels : Levels
        Levels of a surface of constant temperature in n frames, so that every change is due to the camera.
    steps : sequence of CameraFlag
        Flat-field steps from `find_steps`; they are corrected before the regression.
    camera_temperature : (n, k) ndarray
        Temperatures inside the camera, K; sensors with gaps or without change are not used.
    sensors : sequence of str
        Names of the k sensors.
    significance : float
        Nothing is corrected where the p-value exceeds this.

    Returns
    -------
    CameraDrift
        Correction of each frame (K), coefficients (K/K) and p-value.

    Notes
    -----
    Least squares on the principal components of the temperatures, without those that hold less than 1 % of the amplitude of the first.
    The p-value is that of an F test whose degrees of freedom use the effective number of independent frames of two autocorrelated
    series, n (1 - r s) / (1 + r s) with their lag-one autocorrelations r and s (M. S. Bartlett, J. R. Stat. Soc. 98 (1935) 536-543).
    """
    level = levels.level + anchor(levels, steps)
    usable = np.isfinite(camera_temperature).all(axis=0) & (np.ptp(camera_temperature, axis=0) > 0)
    names = [name for name, use in zip(sensors, usable, strict=True) if use]
    nothing = CameraDrift(np.zeros(len(level)), {}, 0.0, 1.0)
    if not names or len(level) < len(names) + 3 or np.ptp(level) == 0:
        return nothing
    centred = camera_temperature[:, usable] - camera_temperature[:, usable].mean(axis=0)
    # The sensors of a camera are nearly collinear: components with less than 1 % of the amplitude would only fit noise.
    scores, singular, loadings = np.linalg.svd(centred, full_matrices=False)
    kept = singular > 0.01 * singular[0]
    target = level - level.mean()
    projection = scores[:, kept].T @ target
    fitted = scores[:, kept] @ projection
    explained = float(fitted @ fitted / (target @ target))
    p_value = _p_value(explained, int(kept.sum()), target - fitted, target)
    coefficients = loadings[kept].T @ (projection / singular[kept])
    if p_value > significance:
        return CameraDrift(nothing.correction, {}, explained, p_value)
    by_name = dict(zip(names, coefficients.tolist(), strict=True))
    size, u = float(np.ptp(fitted)), float(np.std(target - fitted))
    text = f"the temperatures inside the camera explain {explained:.0%} of a drift; up to {size:.3f} K were corrected"
    flag = CameraFlag("camera_drift", 0, levels.time[0], size, u, text)
    return CameraDrift(fitted[0] - fitted, by_name, explained, p_value, flag)


def _p_value(explained: float, regressors: int, residual: NDArray[np.float64], target: NDArray[np.float64]) -> float:
    """Return the p-value of an explained share of variance, for autocorrelated series."""

    def lag_one(series: NDArray[np.float64]) -> float:
        return float(np.clip(series[1:] @ series[:-1] / (series @ series), 0, 0.999)) if series.any() else 0.0

    # Bartlett (1935): two autocorrelated series have fewer independent pairs than points.
    product = lag_one(residual) * lag_one(target)
    independent = len(target) * (1 - product) / (1 + product)
    freedom = independent - regressors - 1
    if freedom <= 0:
        return 1.0
    ratio = explained / regressors / max((1 - explained) / freedom, np.finfo(float).tiny)
    return float(stats.f.sf(ratio, regressors, freedom))


def find_bad_pixels(counts: NDArray[np.uint16], *, threshold: float = 8.0) -> NDArray[np.uint8]:
    """Find pixels whose mean or noise differs from that of their neighbours.

    Parameters
    ----------
    counts : (time, row, column) ndarray of uint16
        A few dozen frames of a nearly constant scene; with fewer than 8, only offsets are found.
    threshold : float
        Minimum deviation from the neighbours, as a multiple of the 90th percentile of this deviation in the surroundings.

    Returns
    -------
    (row, column) ndarray of uint8
        Sum of flags: `DEAD` = 1 (never changes), `OFFSET` = 2 (mean differs), `NOISY` = 4 (noise differs); 0 for a good pixel.
    """
    stack = counts.astype(np.float32)
    mean, noise = stack.mean(axis=0), stack.std(axis=0)
    flags = np.where(_outliers(mean, threshold), OFFSET, 0).astype(np.uint8)
    if len(stack) >= 8:
        flags |= np.where((noise == 0) & (np.median(noise) > 0), DEAD, 0).astype(np.uint8)
        flags |= np.where(_outliers(noise, threshold) & (noise > np.median(noise)), NOISY, 0).astype(np.uint8)
    return flags


def _outliers(image: NDArray[np.float32], threshold: float) -> NDArray[np.bool_]:
    """Return which pixels deviate from their neighbours much further than the pixels of their surroundings do.

    The deviation of a pixel is its third smallest absolute difference from the eight neighbours. On an edge or corner of the scene at
    least three neighbours belong to the same surface, and clusters of up to three bad pixels are still detected.
    """
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="reflect")
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    differences = [np.abs(image - padded[row : row + rows, column : column + columns]) for row, column in shifts]
    deviation = np.partition(differences, 2, axis=0)[2]
    ring = np.ones((5, 5), bool)
    ring[2, 2] = False
    surroundings = ndimage.percentile_filter(deviation, 90, footprint=ring)
    typical = max(float(np.median(deviation)), 1.0)
    result: NDArray[np.bool_] = deviation > threshold * np.maximum(surroundings, typical)
    return result
