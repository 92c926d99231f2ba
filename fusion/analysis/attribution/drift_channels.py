"""Reduce the readings of every cycle to drift channels, and sample the temperature field as each channel samples time.

The readings of a cycle are explained by a common shift, a stretch proportional to position, and a reversal (positive minus negative
direction). The reduction is least squares on the readings that exist, after the mean of each target and direction has been subtracted.
The same weights are applied to the temperature at the time of each reading, so that a channel and its regressor share their instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.common import Array, FusionError

_CHANNELS = ("common", "proportional", "reversal")
#: Backfitting stops when no mean of a target changes by more than this share of the standard deviation of the readings.
_TOLERANCE = 1e-9
_MAX_ROUNDS = 500
#: Fewest cycles with all channels that a drift model can be fitted to.
MIN_CYCLES = 12


class ChannelError(FusionError):
    """Readings that cannot be reduced to drift channels; the message names the cycles and what to do."""


@dataclass(frozen=True)
class DriftSeries:
    """One drift channel (``"common"``, ``"proportional"`` or ``"reversal"``) with one value per cycle, and how it samples the field.

    Values are in um, their variance over that of a single reading, mean instants since the first frame; ``sampling`` (n, frames) turns
    temperatures (frames, columns) into the regressors of this channel.
    """

    name: str
    values: Array
    variance: Array
    seconds: Array
    sampling: Array

    def lagged_sampling(self, operators: Sequence[Array]) -> Array:
        """How it samples the field under every lag, (lags, n, frames)."""
        return np.stack([self.sampling @ operator for operator in operators])


@dataclass(frozen=True)
class ClockedReadings:
    """Deviations flattened to (cycle, reading), with their times since the first frame; readings are directions times targets.

    Both are NaN where missing, or outside the frames' time, which ``outside_frames`` counts. ``design`` (readings, 3) is common (1),
    proportional (-1 to +1 over the travel) and reversal (+1/2 and -1/2).
    """

    deviation: Array
    seconds: Array
    design: Array
    directions: tuple[str, ...]
    targets: NDArray[np.int64]
    frame_seconds: Array
    outside_frames: int


@dataclass(frozen=True)
class TargetSeries:
    """The readings of every target and direction as series of their own (series, cycle), um, NaN where missing.

    ``sampling`` (cycle, frames) turns temperatures into those at the mean instants of the cycles, which are since the first frame.
    """

    directions: tuple[str, ...]
    targets: NDArray[np.int64]
    values: Array
    seconds: Array
    sampling: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Direction and number of the target, e.g. ``"positive 3"``."""
        return tuple(f"{direction} {target}" for direction, target in zip(self.directions, self.targets, strict=True))


def clock_readings(fused: xr.Dataset, frame_time: NDArray[np.datetime64]) -> ClockedReadings:
    """Place deviations on the clock of the frames; readings outside the frames' time are left out and counted."""
    start = frame_time[0]
    frame_seconds = (frame_time - start) / np.timedelta64(1, "s")
    if frame_seconds.size < MIN_CYCLES or (np.diff(frame_seconds) <= 0).any():
        raise ChannelError(
            f"{frame_seconds.size} frames; correlation needs at least {MIN_CYCLES} in order of time, each later than the one before: "
            "check the times in the frames"
        )
    ordered = fused.transpose("cycle", "direction", "target", ...)
    deviation = ordered["deviation"].values.astype(float)
    seconds = (ordered["time"].values - start) / np.timedelta64(1, "s")
    cycles, directions, targets = deviation.shape
    seen = np.isfinite(deviation) & np.isfinite(seconds)
    # A reading up to one frame interval beyond either end gets the temperature of that end; further out nothing is known.
    slack = float(np.median(np.diff(frame_seconds)))
    inside = (seconds >= -slack) & (seconds <= frame_seconds[-1] + slack)
    outside = int((seen & ~inside).sum())
    deviation = np.where(seen & inside, deviation, np.nan)
    position = ordered["position"].values.astype(float)
    half = max((position.max() - position.min()) / 2, 1e-9)
    scaled = (position - (position.max() + position.min()) / 2) / half
    sign = np.where(ordered["direction"].values == "positive", 0.5, -0.5)
    design = np.column_stack([np.ones(directions * targets), np.tile(scaled, directions), np.repeat(sign, targets)])
    return ClockedReadings(
        deviation=deviation.reshape(cycles, -1),
        seconds=np.where(seen & inside, seconds, np.nan).reshape(cycles, -1),
        design=design,
        directions=tuple(str(name) for name in ordered["direction"].values),
        targets=ordered["target"].values.astype(np.int64),
        frame_seconds=frame_seconds,
        outside_frames=outside,
    )


def _usable_design(readings: ClockedReadings) -> tuple[Array, tuple[str, ...]]:
    """Channels that these readings determine: one direction alone has no reversal, one target no proportional part."""
    observed = np.isfinite(readings.deviation).any(axis=0)
    kept: list[int] = []
    for column in range(len(_CHANNELS)):
        trial = readings.design[observed][:, [*kept, column]]
        if observed.any() and np.linalg.matrix_rank(trial) == len(kept) + 1:
            kept.append(column)
    return readings.design[:, kept], tuple(_CHANNELS[column] for column in kept)


def _backfit(deviation: Array, reducers: list[Array], design: Array) -> Array:
    """Mean of each target and direction (readings,) without the channels of the cycles; one round is exact for complete data."""
    observed = np.isfinite(deviation)
    counts = np.maximum(observed.sum(axis=0), 1)
    filled = np.where(observed, deviation, 0.0)
    profile = filled.sum(axis=0) / counts
    scale = max(float(filled.std()), 1e-12)
    for _ in range(_MAX_ROUNDS):
        rest = np.where(observed, deviation - profile, 0.0)
        parts = np.array([reducer @ row for reducer, row in zip(reducers, rest, strict=True)])
        update = np.where(observed, rest - parts @ design.T, 0.0).sum(axis=0) / counts
        profile = profile + update
        if np.abs(update).max() < _TOLERANCE * scale:
            break
    return profile


def reduce_channels(readings: ClockedReadings) -> list[DriftSeries]:
    """Return the drift channels that the readings determine, one value per cycle."""
    design, names = _usable_design(readings)
    observed = np.isfinite(readings.deviation)
    reducers = []
    complete = np.zeros(observed.shape[0], bool)
    for j, row in enumerate(observed):
        part = np.where(row[:, None], design, 0.0)
        complete[j] = bool(names) and np.linalg.matrix_rank(part) == len(names)
        reducers.append(np.linalg.pinv(part))
    if complete.sum() < MIN_CYCLES:
        raise ChannelError(
            f"only {int(complete.sum())} of {observed.shape[0]} cycles hold enough readings inside the frames' time; correlation "
            f"needs {MIN_CYCLES}: measure more cycles, or check the clock offset between camera and laser"
        )
    kept = np.flatnonzero(complete)
    deviation = readings.deviation[kept]
    reducers = [reducers[j] for j in kept]
    rest = np.nan_to_num(deviation - _backfit(deviation, reducers, design))
    values = np.array([reducer @ row for reducer, row in zip(reducers, rest, strict=True)])
    seconds = np.nanmean(readings.seconds[kept], axis=1)
    series = []
    for c, name in enumerate(names):
        weights = np.array([reducer[c] * design[:, c] for reducer in reducers])
        series.append(
            DriftSeries(
                name=name,
                values=values[:, c],
                variance=np.array([(reducer[c] ** 2).sum() for reducer in reducers]),
                seconds=seconds,
                sampling=_sample(readings.seconds[kept], weights, readings.frame_seconds),
            )
        )
    return series


def target_series(readings: ClockedReadings) -> TargetSeries:
    """Return every direction and target with at least 12 readings as a series over the cycles."""
    seen = np.isfinite(readings.deviation)
    kept = np.flatnonzero(seen.any(axis=1))
    columns = np.flatnonzero(seen.sum(axis=0) >= MIN_CYCLES)
    if not columns.size:
        raise ChannelError(
            f"no target has readings in {MIN_CYCLES} cycles inside the frames' time; measure more cycles, or check the clock offset"
        )
    seconds = np.nanmean(readings.seconds[kept], axis=1)
    direction, target = np.divmod(columns, readings.targets.size)
    return TargetSeries(
        directions=tuple(readings.directions[k] for k in direction),
        targets=readings.targets[target],
        values=readings.deviation[np.ix_(kept, columns)].T,
        seconds=seconds,
        sampling=_sample(seconds[:, None], np.ones((seconds.size, 1)), readings.frame_seconds),
    )


def _sample(seconds: Array, weights: Array, frame_seconds: Array) -> Array:
    """Weights (n, frames) of linear interpolation at seconds (n, readings), summed over the readings with their weights."""
    present = np.isfinite(seconds)
    clipped = np.clip(np.where(present, seconds, frame_seconds[0]), frame_seconds[0], frame_seconds[-1])
    before = np.clip(np.searchsorted(frame_seconds, clipped, side="right") - 1, 0, frame_seconds.size - 2)
    share = (clipped - frame_seconds[before]) / np.diff(frame_seconds)[before]
    weights = np.where(present, weights, 0.0)
    rows = np.broadcast_to(np.arange(seconds.shape[0])[:, None], seconds.shape)
    sampling = np.zeros((seconds.shape[0], frame_seconds.size))
    np.add.at(sampling, (rows, before), weights * (1.0 - share))
    np.add.at(sampling, (rows, before + 1), weights * share)
    return sampling
