"""Competing explanations of one position's residual, each with the size of the slow nuisance estimated anew.

A residual is what one target shows in both directions after its own mean and every pass's level and stretch (from the other targets)
are taken out. Explanations that last (local temperature, step) are profile likelihood ratios against white noise plus a random walk,
with parametric-bootstrap p values. Explanations without memory are in :mod:`fusion.diagnosis.scatter`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.first_order_lag import respond
from fusion.attribution.drift_channels import MIN_CYCLES
from fusion.attribution.likelihood_ratio import (
    Grid,
    estimate_effects,
    fit_null,
    likelihood_ratios,
    resample,
    whiten_series,
    whitening_grid,
)
from fusion.attribution.warm_up import warm_up_columns
from fusion.errors import FusionError

#: Lags of the local temperature, s.
LAGS_S = (0.0, 600.0, 1800.0, 3600.0)
#: Steps are tried after every cycle but the first and last of this number.
_STEP_MARGIN = 5
_LEVELS = 499


class DiagnosisError(FusionError):
    """An anomaly cannot be diagnosed; the message names the target and what is missing."""


@dataclass(frozen=True)
class Parts:
    """Orthonormal mean and difference of the directions over complete cycles; the mean alone where one direction was read.

    Attributes
    ----------
    rows : cycles used
    mean, difference : (n,) um times `unit`, or None
    sides : (2, n) both directions, or None
    grid : whitenings that all of them share
    """

    rows: NDArray[np.int64]
    mean: Array
    difference: Array | None
    sides: Array | None
    unit: float
    grid: Grid


@dataclass(frozen=True)
class Residual:
    """What one target does by itself.

    Attributes
    ----------
    seconds : (cycle,) mean time of the target's readings, s since the first reading
    values : (direction, cycle) um, NaN where missing; first row positive approach
    typical_um : robust scatter of the other targets' residuals
    temperature : (frames,), (frames,) s and K, or None
    """

    target: int
    seconds: Array
    values: Array
    cycle: NDArray[np.int64]
    typical_um: float
    temperature: tuple[Array, Array] | None

    @property
    def scatter_um(self) -> tuple[float, float]:
        """Standard deviation from the positive and from the negative side, NaN where that was not read."""
        known = [row[np.isfinite(row)] for row in self.values]
        first, second = (float(row.std()) if row.size else float("nan") for row in known)
        return first, second

    @cached_property
    def parts(self) -> Parts:
        """Its mean and difference, with the whitenings for their instants."""
        read = np.isfinite(self.values)
        rows = np.flatnonzero(read.all(axis=0))
        if rows.size >= MIN_CYCLES:
            first, second = self.values[:, rows]
            root = float(np.sqrt(2.0))
            return Parts(
                rows, (first + second) / root, (first - second) / root, self.values[:, rows], root, self._grid(rows)
            )
        side = int(read.sum(axis=1).argmax())
        rows = np.flatnonzero(read[side])
        return Parts(rows, self.values[side, rows], None, None, 1.0, self._grid(rows))

    def _grid(self, rows: NDArray[np.int64]) -> Grid:
        ones = np.ones(rows.size)
        return whitening_grid(self.seconds[rows], ones, ones[:, None], integrated=False)


@dataclass(frozen=True)
class Lasting:
    """One explanation with memory, fitted to the mean of both directions.

    Attributes
    ----------
    log_likelihood : nats, of the mean and the difference of the directions together
    p_value : parametric bootstrap over all its lags or instants, against white noise plus random walk
    place : index of the best lag or instant
    coefficient, coefficient_u : um/K or um
    by_direction : coefficient of the best member in each direction alone, NaN where that was not read
    held_out : log-likelihood gained in one direction by member and coefficient from the other (nats, both ways), NaN if one direction
    """

    log_likelihood: float
    p_value: float
    place: int
    coefficient: float
    coefficient_u: float
    by_direction: tuple[float, float]
    held_out: float


@dataclass(frozen=True)
class Slow:
    """Log-likelihoods (nats) of explanations by white noise and a slow walk.

    Attributes
    ----------
    white : no memory
    shared : a walk in both directions alike
    one_direction : a walk in one direction only
    side : the direction of that walk, 0 positive, 1 negative
    """

    white: float
    shared: float
    one_direction: float
    side: int


def local_residuals(fused: xr.Dataset, target: int, flagged: set[int]) -> Residual:
    """Residual of one target with every pass's level and stretch taken from the targets that are not flagged.

    Parameters
    ----------
    fused : Dataset
        ``deviation`` (um), ``time`` with dims cycle, direction, target; ``position``; and, where known, ``local_rise_series``
        (frame_time, target) in K.
    """
    ordered = fused.transpose("cycle", "direction", "target", ...)
    targets = ordered["target"].values.astype(int)
    if target not in targets:
        raise DiagnosisError(f"target {target} is not among the measured targets {targets.tolist()}")
    sound = np.array([t not in flagged and t != target for t in targets])
    if sound.sum() < 3:
        raise DiagnosisError(
            f"target {target}: only {int(sound.sum())} targets are free of anomalies; a residual needs 3 to tell its level and "
            "stretch: an effect on most targets is drift, not an anomaly"
        )
    deviation = ordered["deviation"].values.astype(float)
    time = ordered["time"].values.astype("datetime64[ns]")
    deviation = np.where(np.isnat(time), np.nan, deviation)
    position = ordered["position"].values.astype(float)
    stretch = (position - position.mean()) / max(float(np.ptp(position)), 1e-9)
    design = np.column_stack([np.ones_like(stretch), stretch])
    passes = _take_out_passes(deviation, design, sound)
    place = int(np.flatnonzero(targets == target)[0])
    names = [str(name) for name in ordered["direction"].values]
    rows = [passes[:, names.index(name), place] for name in ("positive", "negative") if name in names]
    values = np.full((2, deviation.shape[0]), np.nan)
    for k, name in enumerate(name for name in ("positive", "negative") if name in names):
        values[("positive", "negative").index(name)] = rows[k]
    start = time[~np.isnat(time)].min()
    stamps = (time[:, :, place] - start) / np.timedelta64(1, "s")
    used = np.isfinite(values).any(axis=0)
    if used.sum() < MIN_CYCLES:
        raise DiagnosisError(
            f"target {target} has readings in {int(used.sum())} cycles; a diagnosis needs {MIN_CYCLES}"
        )
    typical = _typical_scatter(passes, design, sound, place)
    return Residual(
        target,
        np.nanmean(stamps[used], axis=1),
        values[:, used],
        ordered["cycle"].values[used].astype(np.int64),
        typical,
        _local_temperature(ordered, place, start),
    )


def _take_out_passes(deviation: Array, design: Array, sound: NDArray[np.bool_]) -> Array:
    """Deviations (cycle, direction, target) less each target's mean and each pass's level and stretch, by backfitting."""
    seen = np.isfinite(deviation)
    rest = deviation - _known_mean(deviation)
    for _ in range(50):
        passes = np.zeros_like(deviation)
        for index in np.ndindex(deviation.shape[:2]):
            used = seen[index] & sound
            if used.sum() >= 3:
                passes[index] = design @ np.linalg.lstsq(design[used], rest[index][used], rcond=None)[0]
            else:
                passes[index] = np.nan
        profile = _known_mean(rest - passes)
        rest = rest - profile
        if np.abs(profile).max() < 1e-6:
            break
    return rest - passes


def _known_mean(values: Array) -> Array:
    """Mean over the first dim of what is known, 0 where nothing is."""
    known = np.isfinite(values)
    return np.asarray(np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), float)


def _typical_scatter(passes: Array, design: Array, sound: NDArray[np.bool_], place: int) -> float:
    """Scatter (um) that this target would show if it were like the others; what the passes' own fit takes away is given back."""
    normal = np.linalg.inv(design[sound].T @ design[sound])
    kept = 1.0 - np.einsum("ij,jk,ik->i", design[sound], normal, design[sound])
    columns = passes[:, :, sound] / np.sqrt(kept)
    read = np.isfinite(columns).any(axis=0)
    others = 1.4826 * np.nanmedian(np.abs(columns[:, read]), axis=0)
    return float(np.median(others) * np.sqrt(1.0 + design[place] @ normal @ design[place]))


def _local_temperature(fused: xr.Dataset, place: int, start: np.datetime64) -> tuple[Array, Array] | None:
    if "local_rise_series" not in fused:
        return None
    values = fused["local_rise_series"].transpose("frame_time", "target").values[:, place].astype(float)
    seconds = (fused["frame_time"].values.astype("datetime64[ns]") - start) / np.timedelta64(1, "s")
    known = np.isfinite(values)
    return (seconds[known], values[known]) if known.sum() >= MIN_CYCLES else None


def lagged_temperature(residual: Residual) -> Array | None:
    """Local temperature at the residual's times under every lag, (cycle, lags), or None where the camera does not see it."""
    if residual.temperature is None:
        return None
    seconds, values = residual.temperature
    columns = [np.interp(residual.seconds, seconds, respond(seconds, lag, values[:, None])[:, 0]) for lag in LAGS_S]
    return np.column_stack(columns)


def step_columns(cycles: int) -> Array:
    """Unit steps after every cycle but the first and last five, (cycle, instants)."""
    instants = np.arange(_STEP_MARGIN, cycles - _STEP_MARGIN + 1)
    return (np.arange(cycles)[:, None] >= instants).astype(float)


def step_instant(place: int) -> int:
    """Index of the first cycle after the step of a column of :func:`step_columns`."""
    return place + _STEP_MARGIN


def fit_slow(residual: Residual) -> Slow:
    """Fit white noise alone, a walk that both directions share, and a walk in one direction."""
    parts = residual.parts
    mean = fit_null(parts.grid, parts.mean).log_likelihood
    if parts.difference is None or parts.sides is None:
        return Slow(float(mean[0]), float(mean.max()), -np.inf, 0)
    difference = fit_null(parts.grid, parts.difference).log_likelihood
    sides = [fit_null(parts.grid, row).log_likelihood for row in parts.sides]
    alone = [float(sides[side].max() + sides[1 - side][0]) for side in (0, 1)]
    return Slow(float(mean[0] + difference[0]), float(mean.max() + difference[0]), max(alone), int(np.argmax(alone)))


def fit_lasting(residual: Residual, columns: Array, rng: np.random.Generator) -> Lasting:
    """Fit the best of several columns (cycle, members), each with its own nuisance, to both directions."""
    parts = residual.parts
    bank = fit_null(parts.grid, parts.mean)
    regressors = np.ascontiguousarray(columns[parts.rows], np.float32)
    orders = np.empty((_LEVELS, parts.mean.size), np.int64)
    stack = np.vstack([parts.mean, resample(bank, orders, rng, gaussian=True)])
    ratios = likelihood_ratios(bank, whiten_series(bank, stack), regressors)
    best = ratios.max(axis=1)
    place = int(ratios[0].argmax())
    found = estimate_effects(bank, regressors[:, [place]])
    shared = 0.0 if parts.difference is None else float(fit_null(parts.grid, parts.difference).log_likelihood[0])
    by_direction, held_out = _cross_directions(parts, columns, place)
    return Lasting(
        float(bank.log_likelihood.max() + 0.5 * best[0] + shared),
        float((np.sum(best[1:] >= best[0]) + 1) / (_LEVELS + 1)),
        place,
        float(found.coefficient[0]) / parts.unit,
        float(found.coefficient_u[0]) / parts.unit,
        by_direction,
        held_out,
    )


def _cross_directions(parts: Parts, columns: Array, place: int) -> tuple[tuple[float, float], float]:
    """Coefficient of one member in each direction, and what each direction's own best member gains in the other (nats)."""
    if parts.sides is None:
        return (np.nan, np.nan), np.nan
    regressors = np.ascontiguousarray(columns[parts.rows], np.float32)
    banks = [fit_null(parts.grid, row) for row in parts.sides]
    own = [float(estimate_effects(bank, regressors[:, [place]]).coefficient[0]) for bank in banks]
    gained = 0.0
    for train, test in (banks, banks[::-1]):
        ratios = likelihood_ratios(train, whiten_series(train, train.values[None, :]), regressors)
        chosen = regressors[:, [int(ratios[0].argmax())]]
        prediction = chosen[:, 0] * estimate_effects(train, chosen).coefficient[0]
        project = test.fitted.project
        before = project @ test.values
        after = project @ (test.values - prediction)
        gained += 0.5 * test.freedom * float(np.log((before @ before) / (after @ after)))
    return (own[0], own[1]), gained


def serial_p(residual: Residual, rng: np.random.Generator) -> float:
    """Permutation p that successive values are nearer to each other than chance (von Neumann 1941, Ann. Math. Stat. 12, 367)."""
    series = residual.parts.mean
    shuffled = rng.permuted(np.tile(series, (_LEVELS, 1)), axis=1)
    measured = (np.diff(series) ** 2).sum()
    null = (np.diff(shuffled, axis=1) ** 2).sum(axis=1)
    return float((np.sum(null <= measured) + 1) / (_LEVELS + 1))


def warm_up_like(seconds: Array, temperature: Array) -> float:
    """Share of a temperature's variation that exponentials of one warm-up explain."""
    trend = (seconds - seconds.mean()) / np.ptp(seconds)
    design = np.column_stack([np.ones_like(seconds), trend, warm_up_columns(seconds)])
    centred = temperature - temperature.mean()
    rest = centred - design @ np.linalg.lstsq(design, centred, rcond=None)[0]
    return 1.0 - float((rest @ rest) / max(float(centred @ centred), 1e-30))
