"""Inputs of a reduction: frames with their times, cycles and corrections, checked before any frame is read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermography._typing import Array
from thermography.errors import ThermographyError
from thermography.io.frame import CameraParameters, FrameReference
from thermography.io.frame_index.frame_list import frame_shapes, frame_times
from thermography.radiometry.planck import calibrate

Override = Callable[[FrameReference], CameraParameters]

#: Cycle index of a frame that lies in no cycle.
NO_CYCLE = -1


class ReductionError(ThermographyError):
    """The frames cannot be reduced to fields; the message names the frame or cycle and the remedy."""


@dataclass(frozen=True)
class FrameSeries:
    """Frames of one size in the order of time, and the cycles that they belong to.

    Attributes
    ----------
    references : sequence of FrameReference
        Where the frames are stored.
    times : (frames,) ndarray of datetime64[ns]
        Rising.
    bounds : (cycles, 2) ndarray of datetime64[ns]
        Start and end of every cycle on the frames' clock; the end is excluded.
    cycles : (frames,) ndarray of int
        Index of the cycle of every frame, `NO_CYCLE` for none.
    correction_K : (frames,) ndarray, K
        Added to the temperature of every frame.
    override : callable
        From a frame reference to the camera parameters to calibrate it with.
    """

    references: Sequence[FrameReference]
    times: Array
    bounds: Array
    cycles: NDArray[np.int64]
    correction_K: Array
    override: Override

    def __len__(self) -> int:
        return len(self.references)

    def name(self, index: int) -> str:
        """File name and number of a frame, for messages."""
        return f"{self.references[index].path.name}#{self.references[index].index}"

    def names(self, chosen: Array) -> list[str]:
        """Names of the frames where `chosen`, (frames,), is True."""
        return [self.name(index) for index in np.flatnonzero(chosen)]

    def temperature(self, index: int) -> Array:
        """Read and calibrate a frame: (row, column) degC, without its correction."""
        reference = self.references[index]
        return calibrate(reference.read().counts, self.override(reference))

    def mean_time(self, chosen: slice | Array) -> np.datetime64:
        """Mean time of the frames with the indices `chosen`."""
        times = self.times[chosen]
        mean: np.datetime64 = times[0] + (times - times[0]).mean()
        return mean


def make_frame_series(
    references: Sequence[FrameReference],
    cycle_bounds: ArrayLike,
    *,
    shape: tuple[int, int],
    override: Override,
    correction_K: ArrayLike | None = None,
) -> FrameSeries:
    """Check frames, cycles and corrections, and assign the frames to the cycles.

    Parameters
    ----------
    references : sequence of FrameReference
        Sorted by time.
    cycle_bounds : (cycles, 2) or (cycles + 1,) array of datetime64
        Start and end of every cycle, or the edges between cycles, on the frames' clock; the end is excluded.
    shape : (int, int)
        (rows, columns) of the registered frames.
    override : callable
        From a frame reference to the camera parameters to calibrate it with.
    correction_K : (frames,) array, K, or None
        Added to the temperature of every frame; None for zeros.

    Returns
    -------
    FrameSeries

    Raises
    ------
    ReductionError
        There is no frame or no cycle, frames have another size or no time or are out of order, cycles overlap or end before they
        start, or the corrections are not one finite value per frame.
    """
    bounds = _check_bounds(cycle_bounds)
    times = _check_frames(references, shape)
    correction = _check_correction(correction_K, len(references))
    index = np.searchsorted(bounds[:, 0], times, side="right") - 1
    inside = (index >= 0) & (times < bounds[np.maximum(index, 0), 1])
    return FrameSeries(references, times, bounds, np.where(inside, index, NO_CYCLE), correction, override)


def _check_bounds(cycle_bounds: ArrayLike) -> Array:
    """Cycle bounds as (cycles, 2) datetime64[ns], in order and without overlap."""
    bounds = np.asarray(cycle_bounds, "datetime64[ns]")
    bounds = np.stack([bounds[:-1], bounds[1:]], axis=-1) if bounds.ndim == 1 else bounds
    if len(bounds) == 0:
        raise ReductionError("cycle_bounds is empty; give the start and end of at least one cycle")
    reversed_cycles = np.flatnonzero(~(bounds[:, 0] < bounds[:, 1]))
    if reversed_cycles.size:
        n = int(reversed_cycles[0])
        raise ReductionError(f"cycle {n + 1} ends at {bounds[n, 1]}, before it starts at {bounds[n, 0]}")
    overlaps = np.flatnonzero(bounds[1:, 0] < bounds[:-1, 1])
    if overlaps.size:
        n = int(overlaps[0])
        raise ReductionError(f"cycle {n + 2} starts at {bounds[n + 1, 0]}, before cycle {n + 1} ends at {bounds[n, 1]}")
    return bounds


def _check_frames(references: Sequence[FrameReference], shape: tuple[int, int]) -> Array:
    """Times of the frames, (frames,) datetime64[ns]."""
    if not references:
        raise ReductionError("there is no frame to reduce")
    times = frame_times(references)
    shapes = frame_shapes(references)
    wrong = (shapes != shape).any(axis=1) | np.isnat(times)
    wrong[1:] |= times[1:] <= times[:-1]
    if not wrong.any():
        return times
    i = int(np.argmax(wrong))
    frame = references[i]
    where = f"{frame.path}: frame {frame.index}"
    if tuple(frame.shape) != tuple(shape):
        raise ReductionError(
            f"{where} has {frame.shape} pixels, the registered frames {shape}; reduce one size at a time"
        )
    if np.isnat(times[i]):
        raise ReductionError(f"{where} has no time; leave it out")
    raise ReductionError(f"{where} has the time {frame.time}, not after {references[i - 1].time}; sort the frames")


def _check_correction(correction_K: ArrayLike | None, frames: int) -> Array:
    """Correction of every frame, (frames,) K."""
    if correction_K is None:
        return np.zeros(frames)
    correction = np.asarray(correction_K, float)
    if correction.shape != (frames,) or not np.isfinite(correction).all():
        raise ReductionError(
            f"correction_K has shape {correction.shape}; it needs one finite value for each of {frames} frames"
        )
    return correction
