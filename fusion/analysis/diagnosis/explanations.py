"""Competing explanations of one target's residual, each fitted with its own estimate of the random walk beside it.

The residual of a target is its deviation in both directions after subtraction of its own mean and of every pass's level and stretch, which
are estimated from the other targets. Explanations by a regressor (local temperature, step) are profile likelihood ratios against white
noise plus a random walk, with p-values from a parametric bootstrap. Explanations by scatter alone are in
:mod:`fusion.analysis.diagnosis.explanations`; the method is described in docs/method/diagnosis.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.attribution.drift_channels import MIN_CYCLES
from fusion.analysis.attribution.modes import level_and_trend, warm_up_columns
from fusion.analysis.attribution.significance import (
    Grid,
    estimate_effects,
    fit_null,
    likelihood_ratios,
    resample,
    whiten_series,
    whitening_grid,
)
from fusion.analysis.drift_model.null_simulation import rank_p_value
from fusion.common import Array, FusionError
from interferometry.deviations import ROUNDING, resolution_um
from thermography.common import MAD_TO_SIGMA

#: Candidate time constants of the response to the local temperature, s.
LAGS_S = (0.0, 600.0, 1800.0, 3600.0)
#: A step leaves at least this number of cycles on either side.
_STEP_MARGIN = 5
#: Draws of the parametric bootstrap, and permutations of the serial test.
_DRAWS = 499


class DiagnosisError(FusionError):
    """An anomaly cannot be diagnosed; the message names the target and what is missing."""


@dataclass(frozen=True)
class DirectionParts:
    """A residual as mean and difference of the two directions, orthonormal, over the cycles in which both were read.

    Where one direction was read in too few cycles, the mean is the other direction alone.

    Attributes
    ----------
    rows : (n,) indices of the cycles used
    mean : (n,) sum of the directions over the square root of 2, or the only direction, um times `unit`
    difference : (n,) difference of the directions over the square root of 2, um times `unit`; None of a single direction, as `sides`
    sides : (2, n) positive and negative direction, um
    unit : factor between `mean` and the average of the directions: square root of 2, or 1 for a single direction
    grid : whitenings under every random walk considered, for the times of these cycles
    """

    rows: NDArray[np.int64]
    mean: Array
    difference: Array | None
    sides: Array | None
    unit: float
    grid: Grid


@dataclass(frozen=True)
class Residual:
    """What a target shows beyond its mean and the drift of all, (2, cycles) um by positive and negative direction, NaN where missing, at
    the mean time of its readings, s; the robust standard deviation that it would have if it scattered like the others, rounding included;
    and times (s) and local rise (K) at the frames, None where the camera does not see it.
    """

    target: int
    seconds: Array
    values: Array
    cycle: NDArray[np.int64]
    typical_um: float
    temperature: tuple[Array, Array] | None

    @property
    def scatter_um(self) -> tuple[float, float]:
        """Standard deviation in the positive and in the negative direction, um, NaN for one that was not read."""
        finite = [row[np.isfinite(row)] for row in self.values]
        positive, negative = (float(row.std()) if row.size else float("nan") for row in finite)
        return positive, negative

    @cached_property
    def parts(self) -> DirectionParts:
        """Mean and difference of the directions, with the whitenings for their times."""
        read = np.isfinite(self.values)
        rows = np.flatnonzero(read.all(axis=0))
        if rows.size >= MIN_CYCLES:
            positive, negative = sides = self.values[:, rows]
            root = float(np.sqrt(2.0))
            return DirectionParts(
                rows, (positive + negative) / root, (positive - negative) / root, sides, root, self._grid(rows)
            )
        side = int(read.sum(axis=1).argmax())
        rows = np.flatnonzero(read[side])
        return DirectionParts(rows, self.values[side, rows], None, None, 1.0, self._grid(rows))

    def _grid(self, rows: NDArray[np.int64]) -> Grid:
        """Return the whitenings for the times of the given cycles, with the mean as the only nuisance column."""
        ones = np.ones(rows.size)
        return whitening_grid(self.seconds[rows], ones, ones[:, None], integrated=False)


@dataclass(frozen=True)
class ProfileFit:
    """The best of several candidate regressors, fitted to the mean of both directions by profile likelihood.

    Attributes
    ----------
    log_likelihood : of the mean and the difference of the directions together, nats
    p_value : parametric bootstrap over all candidates, against white noise plus random walk
    best : index of the best candidate (lag or step)
    coefficient, coefficient_u : its coefficient, with standard uncertainty, for the average of the directions, um/K or um
    by_direction : its coefficient in each direction alone, NaN where one was not read, um/K or um
    hold_out_gain : log-likelihood gained in each direction by the candidate and the coefficient fitted to the other, sum of both, nats;
        NaN where only one direction was read
    """

    log_likelihood: float
    p_value: float
    best: int
    coefficient: float
    coefficient_u: float
    by_direction: tuple[float, float]
    hold_out_gain: float


@dataclass(frozen=True)
class RandomWalkFit:
    """Log-likelihoods (nats) of white noise alone, with a random walk that both directions share, and with one in one direction only; minus
    infinity where one was not read.
    """

    white: float
    shared: float
    one_direction: float


def local_residuals(fused: xr.Dataset, target: int, flagged: set[int]) -> Residual:
    """Return the residual of one target, with every pass's level and stretch estimated from the targets that are not flagged."""
    ordered = fused.transpose("cycle", "direction", "target", ...)
    targets = ordered["target"].values.astype(int)
    if target not in targets:
        raise DiagnosisError(f"target {target} is not among the measured targets {targets.tolist()}")
    sound = np.array([t not in flagged and t != target for t in targets])
    if sound.sum() < 3:
        raise DiagnosisError(
            f"target {target}: only {int(sound.sum())} targets are free of anomalies; level and stretch of a pass need 3: an effect on "
            "most targets is drift, not an anomaly"
        )
    deviation = ordered["deviation"].values.astype(float)
    time = ordered["time"].values.astype("datetime64[ns]")
    deviation = np.where(np.isnat(time), np.nan, deviation)
    position = ordered["position"].values.astype(float)
    stretch = (position - position.mean()) / max(float(np.ptp(position)), 1e-9)
    design = np.column_stack([np.ones_like(stretch), stretch])
    residuals = _without_passes(deviation, design, sound)
    column = int(np.flatnonzero(targets == target)[0])
    values = np.full((2, deviation.shape[0]), np.nan)
    for k, name in enumerate(ordered["direction"].values):
        values[("positive", "negative").index(str(name))] = residuals[:, k, column]
    start = time[~np.isnat(time)].min()
    seconds = (time[:, :, column] - start) / np.timedelta64(1, "s")
    used = np.isfinite(values).any(axis=0)
    if used.sum() < MIN_CYCLES:
        raise DiagnosisError(
            f"target {target} has readings in {int(used.sum())} cycles; a diagnosis needs {MIN_CYCLES}"
        )
    return Residual(
        target,
        np.nanmean(seconds[used], axis=1),
        values[:, used],
        ordered["cycle"].values[used].astype(np.int64),
        max(_typical_scatter(residuals, design, sound, column), ROUNDING * resolution_um(fused)),
        _local_temperature(ordered, column, start),
    )


def _without_passes(deviation: Array, design: Array, sound: NDArray[np.bool_]) -> Array:
    """Return deviations (cycle, direction, target) less each target's mean and each pass's level and stretch, by backfitting."""
    present = np.isfinite(deviation)
    rest = deviation - np.nan_to_num(known_mean(deviation, axis=0))
    for _ in range(50):
        passes = np.zeros_like(deviation)
        for index in np.ndindex(deviation.shape[:2]):
            used = present[index] & sound
            if used.sum() >= 3:
                passes[index] = design @ np.linalg.lstsq(design[used], rest[index][used], rcond=None)[0]
            else:
                passes[index] = np.nan
        profile = np.nan_to_num(known_mean(rest - passes, axis=0))
        rest = rest - profile
        if np.abs(profile).max() < 1e-6:
            break
    return rest - passes


def _typical_scatter(residuals: Array, design: Array, sound: NDArray[np.bool_], column: int) -> float:
    """Return the standard deviation (um) of one target's residual if it scattered like the sound ones."""
    normal = np.linalg.inv(design[sound].T @ design[sound])
    kept = 1.0 - np.einsum("ij,jk,ik->i", design[sound], normal, design[sound])
    scaled = residuals[:, :, sound] / np.sqrt(kept)
    read = np.isfinite(scaled).any(axis=0)
    others = MAD_TO_SIGMA * np.nanmedian(np.abs(scaled[:, read]), axis=0)
    return float(np.median(others) * np.sqrt(1.0 + design[column] @ normal @ design[column]))


def _local_temperature(fused: xr.Dataset, column: int, start: np.datetime64) -> tuple[Array, Array] | None:
    """Return times (s) and temperature rise (K) at one target, or None where the camera sees it in too few frames."""
    if "local_rise_series" not in fused:
        return None
    values = fused["local_rise_series"].transpose("frame_time", "target").values[:, column].astype(float)
    seconds = (fused["frame_time"].values.astype("datetime64[ns]") - start) / np.timedelta64(1, "s")
    finite = np.isfinite(values)
    return (seconds[finite], values[finite]) if finite.sum() >= MIN_CYCLES else None


def lagged_temperature(residual: Residual) -> Array | None:
    """Return the local temperature at the times of a residual, through a first-order lag of every candidate time constant."""
    if residual.temperature is None:
        return None
    seconds, values = residual.temperature
    columns = [
        np.interp(residual.seconds, seconds, respond(values[:, None], seconds, time_constant_s=lag)[:, 0])
        for lag in LAGS_S
    ]
    return np.column_stack(columns)


def step_columns(cycles: int) -> Array:
    """Return unit steps at every cycle that leaves five cycles on either side."""
    instants = np.arange(_STEP_MARGIN, cycles - _STEP_MARGIN + 1)
    return (np.arange(cycles)[:, None] >= instants).astype(float)


def step_instant(column: int) -> int:
    """Return the cycle at which a column of :func:`step_columns` steps."""
    return column + _STEP_MARGIN


def fit_random_walk(residual: Residual) -> RandomWalkFit:
    """Fit white noise alone, with a random walk that both directions share, and with one in one direction."""
    parts = residual.parts
    mean = fit_null(parts.grid, parts.mean).log_likelihood
    if parts.difference is None or parts.sides is None:
        return RandomWalkFit(float(mean[0]), float(mean.max()), -np.inf)
    difference = fit_null(parts.grid, parts.difference).log_likelihood
    sides = [fit_null(parts.grid, row).log_likelihood for row in parts.sides]
    alone = [float(sides[side].max() + sides[1 - side][0]) for side in (0, 1)]
    return RandomWalkFit(
        white=float(mean[0] + difference[0]),
        shared=float(mean.max() + difference[0]),
        one_direction=max(alone),
    )


def fit_profile(residual: Residual, columns: Array, rng: np.random.Generator) -> ProfileFit:
    """Fit the best of several candidate regressors to both directions, the random walk estimated again under each."""
    parts = residual.parts
    bank = fit_null(parts.grid, parts.mean)
    regressors = np.ascontiguousarray(columns[parts.rows], np.float32)
    # Gaussian draws need no orders of the residuals, but their number.
    orders = np.empty((_DRAWS, parts.mean.size), np.int64)
    series = np.vstack([parts.mean, resample(bank, orders, rng=rng, gaussian=True)])
    ratios = likelihood_ratios(whiten_series(bank, series), regressors)
    largest = ratios.max(axis=1)
    best = int(ratios[0].argmax())
    estimate = estimate_effects(bank, regressors[:, [best]])
    difference = 0.0 if parts.difference is None else float(fit_null(parts.grid, parts.difference).log_likelihood[0])
    by_direction, hold_out_gain = _across_directions(parts, regressors, best)
    return ProfileFit(
        log_likelihood=float(bank.log_likelihood.max() + 0.5 * largest[0] + difference),
        p_value=rank_p_value(largest[0], largest[1:]),
        best=best,
        coefficient=float(estimate.coefficient[0]) / parts.unit,
        coefficient_u=float(estimate.coefficient_u[0]) / parts.unit,
        by_direction=by_direction,
        hold_out_gain=hold_out_gain,
    )


def _across_directions(
    parts: DirectionParts, regressors: NDArray[np.float32], best: int
) -> tuple[tuple[float, float], float]:
    """Return the coefficient of one candidate in each direction, and what each direction's own best gains in the other, nats."""
    if parts.sides is None:
        return (np.nan, np.nan), np.nan
    banks = [fit_null(parts.grid, row) for row in parts.sides]
    positive, negative = (float(estimate_effects(bank, regressors[:, [best]]).coefficient[0]) for bank in banks)
    gain = 0.0
    for train, test in (banks, banks[::-1]):
        ratios = likelihood_ratios(whiten_series(train, train.values[None, :]), regressors)
        chosen = regressors[:, [int(ratios[0].argmax())]]
        prediction = chosen[:, 0] * estimate_effects(train, chosen).coefficient[0]
        # The drift beside a candidate is that of the readings less its prediction: what it explains is no random walk.
        left = fit_null(parts.grid, test.values - prediction)
        gain += float(left.log_likelihood.max() - test.log_likelihood.max())
    return (positive, negative), gain


def serial_p_value(residual: Residual, rng: np.random.Generator) -> float:
    """Test by permutation whether successive values lie nearer to each other than in random order."""
    series = residual.parts.mean
    shuffled = rng.permuted(np.tile(series, (_DRAWS, 1)), axis=1)
    measured = (np.diff(series) ** 2).sum()
    null = (np.diff(shuffled, axis=1) ** 2).sum(axis=1)
    return rank_p_value(-measured, -null)


def warm_up_share(seconds: Array, temperature: Array) -> float:
    """Return the share of a temperature's variance that one warm-up explains: a trend and exponentials from the first value on."""
    design = np.column_stack([level_and_trend(seconds), warm_up_columns(seconds)])
    centred = temperature - temperature.mean()
    rest = centred - design @ np.linalg.lstsq(design, centred, rcond=None)[0]
    return 1.0 - float((rest @ rest) / max(float(centred @ centred), 1e-30))


# Explanations of one target's residual by scatter alone, without order in time: in both directions, in one, or along
# the motion.

#: Natural spread of the targets' scatter about its typical value (standard deviation of its logarithm).
_SIGMA_SPREAD = 0.1
#: Share of the readings that are disturbed where large values are rare.
_RARE_SHARE = 0.2


@dataclass(frozen=True)
class ScatterFit:
    """Maximum log-likelihoods (nats) of three kinds of excess scatter, given the typical scatter of the other targets: equal in both
    directions, Gaussian or with rare large values; in one direction only; one-sided along the direction of motion, short of the target (as
    of a carriage that sticks) or beyond it.
    """

    both: float
    one_direction: float
    along_approach: float


def fit_scatter(residual: Residual) -> ScatterFit:
    """Fit explanations by scatter, which treat the readings of a target as exchangeable."""
    rows = [row[np.isfinite(row)] for row in residual.values]
    rows = [row - row.mean() if row.size else row for row in rows]
    spread = np.linspace(-2.0, 2.0, 9)[:, None]
    prior = -0.5 * spread**2
    # The grid (ordinary scatter of this target, excess), both in um.
    sigma = residual.typical_um * np.exp(spread * _SIGMA_SPREAD)
    extra = residual.typical_um * np.geomspace(0.1, 4.0, 25)[None, :]
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
    return ScatterFit(both, max(sides), max(along))


def _normal(row: Array, sigma: Array) -> Array:
    """Return the log-density of every reading (n,) under every sigma (...,), (..., n)."""
    scaled = row / sigma[..., None]
    return -0.5 * (scaled**2 + np.log(2.0 * np.pi)) - np.log(sigma)[..., None]


def _gaussian(row: Array, sigma: Array) -> Array:
    """Return the log-likelihood of the readings under every sigma, (...,)."""
    return _normal(row, sigma).sum(axis=-1)


def _mixture(usual: Array, disturbed: Array) -> Array:
    """Return the log-likelihood (...,) where a small share of the readings is disturbed, from both log-densities (..., n)."""
    return np.logaddexp(np.log(1 - _RARE_SHARE) + usual, np.log(_RARE_SHARE) + disturbed).sum(axis=-1)


def _one_sided(amounts: Array, sigma: Array, mean: Array) -> Array:
    """Return the log-density of Gaussian noise plus an exponential amount of the given mean (Grushka 1972), (..., n)."""
    rate = sigma / mean
    scaled = amounts / sigma[..., None]
    return (
        -np.log(mean)[..., None]
        + 0.5 * rate[..., None] ** 2
        - scaled * rate[..., None]
        + special.log_ndtr(scaled - rate[..., None])
    )


def _sticking(along: Array, sigma: Array, extra: Array) -> Array:
    """Return the log-likelihood (...,) of centred readings with an exponential amount at every approach, or at a small share of them."""
    sigma, extra = np.broadcast_arrays(sigma, extra)
    always = _one_sided(along + extra[..., None], sigma, extra).sum(axis=-1)
    amount = extra / np.sqrt(2.0 * _RARE_SHARE)
    centred = along + _RARE_SHARE * amount[..., None]
    return np.maximum(always, _mixture(_normal(centred, sigma), _one_sided(centred, sigma, amount)))
