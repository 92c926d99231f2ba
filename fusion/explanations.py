"""L4 - Competing explanations of one position's residual, each with the size of the slow nuisance estimated anew.

A residual is what one target shows in both directions after its own mean and every pass's level and stretch (from the other targets)
are taken out. Explanations that last (local temperature, step) are profile likelihood ratios against white noise plus a random walk,
with parametric-bootstrap p values; explanations without memory (scatter, stick-slip) are permutation tests on its values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.attribution_kernel import (
    NullBank,
    estimate_effects,
    likelihood_ratios,
    null_bank,
    resample,
    whiten_series,
)
from fusion.channels import MIN_CYCLES, Array, respond
from fusion.excitation import warm_up_columns

#: Lags of the local temperature, s.
LAGS_S = (0.0, 600.0, 1800.0, 3600.0)
#: Steps are tried after every cycle but the first and last of this number.
_STEP_MARGIN = 5
_LEVELS = 499
#: Natural spread of the targets' scatter around their typical value (standard deviation of its logarithm).
_SIGMA_SPREAD = 0.1
#: Share of readings that a scatter with rare large values disturbs.
_RARE_SHARE = 0.1


class DiagnosisError(ValueError):
    """An anomaly cannot be diagnosed; the message names the target and what is missing."""


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


@dataclass(frozen=True)
class _Parts:
    """Orthonormal mean and difference of the directions over complete cycles; the mean alone where one direction was read."""

    rows: NDArray[np.int64]
    mean: Array
    difference: Array | None
    unit: float


def _parts(residual: Residual) -> _Parts:
    read = np.isfinite(residual.values)
    if read.all(axis=0).sum() >= MIN_CYCLES:
        rows = np.flatnonzero(read.all(axis=0))
        first, second = residual.values[:, rows]
        root = float(np.sqrt(2.0))
        return _Parts(rows, (first + second) / root, (first - second) / root, root)
    side = int(read.sum(axis=1).argmax())
    rows = np.flatnonzero(read[side])
    return _Parts(rows, residual.values[side, rows], None, 1.0)


def _bank(series: Array, seconds: Array) -> NullBank:
    ones = np.ones(series.size)
    return null_bank(series, seconds, ones, ones[:, None], integrated=False)


def fit_slow(residual: Residual) -> Slow:
    """Fit white noise alone, a walk that both directions share, and a walk in one direction."""
    parts = _parts(residual)
    seconds = residual.seconds[parts.rows]
    mean = _bank(parts.mean, seconds).log_likelihood
    if parts.difference is None:
        return Slow(float(mean[0]), float(mean.max()), -np.inf, 0)
    difference = _bank(parts.difference, seconds).log_likelihood
    sides = [_bank(row, seconds).log_likelihood for row in residual.values[:, parts.rows]]
    alone = [float(sides[side].max() + sides[1 - side][0]) for side in (0, 1)]
    return Slow(float(mean[0] + difference[0]), float(mean.max() + difference[0]), max(alone), int(np.argmax(alone)))


def fit_lasting(residual: Residual, columns: Array, rng: np.random.Generator) -> Lasting:
    """Fit the best of several columns (cycle, members), each with its own nuisance, to both directions."""
    parts = _parts(residual)
    seconds = residual.seconds[parts.rows]
    bank = _bank(parts.mean, seconds)
    regressors = np.ascontiguousarray(columns[parts.rows], np.float32)
    orders = np.empty((_LEVELS, parts.mean.size), np.int64)
    stack = np.vstack([parts.mean, resample(bank, orders, rng, gaussian=True)])
    ratios = likelihood_ratios(bank, whiten_series(bank, stack), regressors)
    best = ratios.max(axis=1)
    place = int(ratios[0].argmax())
    found = estimate_effects(bank, regressors[:, [place]])
    shared = 0.0 if parts.difference is None else float(_bank(parts.difference, seconds).log_likelihood[0])
    by_direction, held_out = _cross_directions(residual, parts, columns, place)
    return Lasting(
        float(bank.log_likelihood.max() + 0.5 * best[0] + shared),
        float((np.sum(best[1:] >= best[0]) + 1) / (_LEVELS + 1)),
        place,
        float(found.coefficient[0]) / parts.unit,
        float(found.coefficient_u[0]) / parts.unit,
        by_direction,
        held_out,
    )


def _cross_directions(
    residual: Residual, parts: _Parts, columns: Array, place: int
) -> tuple[tuple[float, float], float]:
    """Coefficient of one member in each direction, and what each direction's own best member gains in the other (nats)."""
    if parts.difference is None:
        return (np.nan, np.nan), np.nan
    regressors = np.ascontiguousarray(columns[parts.rows], np.float32)
    banks = [_bank(row, residual.seconds[parts.rows]) for row in residual.values[:, parts.rows]]
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
    series = _parts(residual).mean
    shuffled = rng.permuted(np.tile(series, (_LEVELS, 1)), axis=1)
    measured = (np.diff(series) ** 2).sum()
    null = (np.diff(shuffled, axis=1) ** 2).sum(axis=1)
    return float((np.sum(null <= measured) + 1) / (_LEVELS + 1))


@dataclass(frozen=True)
class Memoryless:
    """Log-likelihoods (nats, highest over their one parameter) of scatter without memory, the other targets' scatter given.

    Attributes
    ----------
    both : more scatter, equal in both directions (Gaussian, or with rare large values)
    one_direction : more scatter in one direction only
    along_approach : one-sided amounts that follow the sense of motion (exponential), as a carriage that sticks short of its target
    side : direction with the larger scatter, 0 positive, 1 negative
    short : whether the amounts fall short of the target
    """

    both: float
    one_direction: float
    along_approach: float
    side: int
    short: bool


def memoryless_likelihoods(residual: Residual) -> Memoryless:
    """Compare explanations that treat every reading alike, without order in time."""
    rows = [row[np.isfinite(row)] for row in residual.values]
    rows = [row - row.mean() if row.size else row for row in rows]
    usual = residual.typical_um
    spread = np.exp(np.linspace(-2.0, 2.0, 9) * _SIGMA_SPREAD)
    prior = -0.5 * np.linspace(-2.0, 2.0, 9)[:, None] ** 2
    sigma = usual * spread[:, None]
    # Explanations live on the grid (usual scatter of this target, extra scatter), both in um.
    extra = usual * np.geomspace(0.1, 4.0, 25)[None, :]
    wide = np.hypot(sigma, extra)
    rare = np.hypot(sigma, extra / np.sqrt(_RARE_SHARE))
    steady = sum((_gaussian(row, wide) for row in rows), np.zeros_like(wide))
    bursts = sum((_mixture(_normal(row, sigma), _normal(row, rare)) for row in rows), np.zeros_like(wide))
    both = float((prior + np.maximum(steady, bursts)).max())
    sides = [float((prior + _gaussian(rows[k], wide) + _gaussian(rows[1 - k], sigma)).max()) for k in (0, 1)]
    along = [
        float((prior + _sticking(np.concatenate([sign * rows[0], -sign * rows[1]]), sigma, extra)).max())
        for sign in (-1.0, 1.0)
    ]
    return Memoryless(both, max(sides), max(along), int(np.argmax(sides)), along[0] > along[1])


def _normal(row: Array, sigma: Array) -> Array:
    """Log-density of every reading under every sigma, (..., n)."""
    scaled = row / sigma[..., None]
    return -0.5 * (scaled**2 + np.log(2.0 * np.pi)) - np.log(sigma)[..., None]


def _gaussian(row: Array, sigma: Array) -> Array:
    return _normal(row, sigma).sum(axis=-1)


def _mixture(usual: Array, disturbed: Array) -> Array:
    """Log-likelihood where a small share of the readings is disturbed."""
    return np.logaddexp(np.log(1 - _RARE_SHARE) + usual, np.log(_RARE_SHARE) + disturbed).sum(axis=-1)


def _one_sided(amounts: Array, sigma: Array, mean: Array) -> Array:
    """Log-density of normal noise plus an exponential amount (Grushka 1972, Anal. Chem. 44, 1733)."""
    rate = sigma / mean
    scaled = amounts / sigma[..., None]
    return (
        -np.log(mean)[..., None]
        + 0.5 * rate[..., None] ** 2
        - scaled * rate[..., None]
        + special.log_ndtr(scaled - rate[..., None])
    )


def _sticking(along: Array, sigma: Array, extra: Array) -> Array:
    """Readings along the motion, centred: an exponential amount at every approach, or at a small share of them."""
    sigma, extra = np.broadcast_arrays(sigma, extra)
    always = _one_sided(along + extra[..., None], sigma, extra).sum(axis=-1)
    amount = extra / np.sqrt(2.0 * _RARE_SHARE)
    centred = along + _RARE_SHARE * amount[..., None]
    return np.maximum(always, _mixture(_normal(centred, sigma), _one_sided(centred, sigma, amount)))


def warm_up_like(seconds: Array, temperature: Array) -> float:
    """Share of a temperature's variation that exponentials of one warm-up explain."""
    trend = (seconds - seconds.mean()) / np.ptp(seconds)
    design = np.column_stack([np.ones_like(seconds), trend, warm_up_columns(seconds)])
    centred = temperature - temperature.mean()
    rest = centred - design @ np.linalg.lstsq(design, centred, rcond=None)[0]
    return 1.0 - float((rest @ rest) / max(float(centred @ centred), 1e-30))
