"""Readings reduced to drift channels per cycle, and the film sampled the way each channel samples time.

Every cycle's readings are explained by a common shift, a stretch proportional to position, and a reversal (half the difference of
the directions' levels, full value = forward minus backward). The reduction is least squares on the readings that exist, after each
target's and direction's own mean; what it does to the readings it also does to the temperature at each reading's own time, so a
channel and its regressor always share the same instants.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.errors import FusionError

CHANNELS = ("common", "proportional", "reversal")
#: Backfitting stops when no target's mean moves by more than this share of the spread of the readings.
_TOLERANCE = 1e-9
_MAX_ROUNDS = 500
#: Fewest cycles with all channels that a drift model can be fitted to.
MIN_CYCLES = 12


class ChannelError(FusionError):
    """The readings cannot be reduced to drift channels; the message names the cycles and what to do."""


@dataclass(frozen=True)
class DriftSeries:
    """One drift series and how it samples the film.

    Attributes
    ----------
    name : what the series is, e.g. ``"common"`` or ``"positive 3"``
    values : (n,) drift in um
    variance : (n,) relative variance of each value (noise of a single reading = 1)
    seconds : (n,) time since the film's first frame in s
    cycle : (n,) cycle numbers
    sampling : (n, frames) weights that turn the film (frames, cells) into the temperature that the series saw
    """

    name: str
    values: Array
    variance: Array
    seconds: Array
    cycle: NDArray[np.int64]
    sampling: Array


@dataclass(frozen=True)
class ClockedReadings:
    """Deviations flattened to (cycle, reading), with the times in s since the film's first frame.

    Attributes
    ----------
    deviation, seconds : (cycle, 2 * targets), NaN where missing or outside the film
    design : (2 * targets, 3) common, proportional (+-1 at the ends of travel), reversal (+-1/2)
    frame_seconds : (frames,)
    outside_film : readings left out because no frame surrounds them
    """

    deviation: Array
    seconds: Array
    design: Array
    cycle: NDArray[np.int64]
    directions: tuple[str, ...]
    targets: NDArray[np.int64]
    frame_seconds: Array
    outside_film: int


def read_clock(fused: xr.Dataset, frame_time: NDArray[np.datetime64]) -> ClockedReadings:
    """Put deviations (cycle, direction, target) on the film's clock; readings outside the film are left out and counted."""
    start = frame_time[0]
    frame_seconds = (frame_time - start) / np.timedelta64(1, "s")
    if frame_seconds.size < MIN_CYCLES or (np.diff(frame_seconds) <= 0).any():
        raise ChannelError(
            f"the film has {frame_seconds.size} frames in order of time; correlation needs at least {MIN_CYCLES}, each "
            "later than the one before: check the times in the frames"
        )
    ordered = fused.transpose("cycle", "direction", "target", ...)
    deviation = ordered["deviation"].values.astype(float)
    seconds = (ordered["time"].values - start) / np.timedelta64(1, "s")
    cycles, directions, targets = deviation.shape
    seen = np.isfinite(deviation) & np.isfinite(seconds)
    # A reading in the same frame interval beyond either end is held at that end's temperature; further out nothing is known.
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
        cycle=ordered["cycle"].values.astype(np.int64),
        directions=tuple(str(name) for name in ordered["direction"].values),
        targets=ordered["target"].values.astype(np.int64),
        frame_seconds=frame_seconds,
        outside_film=outside,
    )


def _usable_design(readings: ClockedReadings) -> tuple[Array, tuple[str, ...]]:
    """Columns that these readings can tell apart: one direction alone has no reversal, one target no proportional part."""
    observed = np.isfinite(readings.deviation).any(axis=0)
    kept: list[int] = []
    for column in range(len(CHANNELS)):
        trial = readings.design[observed][:, [*kept, column]]
        if observed.any() and np.linalg.matrix_rank(trial) == len(kept) + 1:
            kept.append(column)
    return readings.design[:, kept], tuple(CHANNELS[column] for column in kept)


def _backfit(deviation: Array, reducers: list[Array], design: Array) -> Array:
    """Each target's mean (readings,) after every cycle's channels are taken out; exact at once for complete data."""
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
    """Return the drift channels that the readings determine, one value per cycle.

    Cycles in which the channels cannot be told apart (too few readings) are left out of every channel.

    Raises
    ------
    ChannelError
        if fewer than 12 cycles remain.
    """
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
            f"only {int(complete.sum())} of {observed.shape[0]} cycles hold enough readings inside the film; correlation "
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
                cycle=readings.cycle[kept],
                sampling=_sample(readings.seconds[kept], weights, readings.frame_seconds),
            )
        )
    return series


def target_table(readings: ClockedReadings) -> tuple[list[str], Array, Array, Array]:
    """Every direction and target with at least 12 readings as a row over the cycles' mean instants.

    Returns
    -------
    names, values (series, cycle) in um with NaN where missing, seconds (cycle,), sampling (cycle, frames)
    """
    seen = np.isfinite(readings.deviation)
    kept = np.flatnonzero(seen.any(axis=1))
    columns = np.flatnonzero(seen.sum(axis=0) >= MIN_CYCLES)
    if not columns.size:
        raise ChannelError(
            f"no target has readings in {MIN_CYCLES} cycles inside the film; measure more cycles, or check the clock offset"
        )
    seconds = np.nanmean(readings.seconds[kept], axis=1)
    names = [
        f"{readings.directions[column // readings.targets.size]} {readings.targets[column % readings.targets.size]}"
        for column in columns
    ]
    sampling = _sample(seconds[:, None], np.ones((seconds.size, 1)), readings.frame_seconds)
    return names, readings.deviation[np.ix_(kept, columns)].T, seconds, sampling


def _sample(seconds: Array, weights: Array, frame_seconds: Array) -> Array:
    """Weights (n, frames) of linear interpolation at seconds (n, readings), summed over readings with their weights."""
    known = np.isfinite(seconds)
    clipped = np.clip(np.where(known, seconds, frame_seconds[0]), frame_seconds[0], frame_seconds[-1])
    before = np.clip(np.searchsorted(frame_seconds, clipped, side="right") - 1, 0, frame_seconds.size - 2)
    share = (clipped - frame_seconds[before]) / np.diff(frame_seconds)[before]
    weights = np.where(known, weights, 0.0)
    rows = np.broadcast_to(np.arange(seconds.shape[0])[:, None], seconds.shape)
    sampling = np.zeros((seconds.shape[0], frame_seconds.size))
    np.add.at(sampling, (rows, before), weights * (1.0 - share))
    np.add.at(sampling, (rows, before + 1), weights * share)
    return sampling
