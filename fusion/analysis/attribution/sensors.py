"""Choose contact sensors in place of the camera: which few places predict the drift as well, and what fewer sensors lose.

Camera (its thermal modes) and sensors (single cells with the noise of a contact sensor) predict the drift channels by the same model: one
lag, one prior for all sensitivities, and a drift of its own order and variance, all chosen by marginal likelihood. Everything, the places
included, is chosen on three quarters of the cycles and predicts the held-out quarter, a run of successive cycles; never random ones, which
favour series that are correlated by their slow drift alone.

The loss of the sensors is not the difference of two hold-out errors: both contain the drift that neither explains, whose chance
fluctuation is larger than the loss. It follows from the difference of the two predictions. With this difference delta and the residual e of
the camera, both minus their mean within each run, the mean square error of the sensors exceeds that of the camera by exactly::

    mean(delta^2) + 2 mean(delta e)

and the drift and noise in e give the uncertainty of the second term.

Source: docs/method/attribution.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.analysis.alignment.first_order_lag import lag_operators
from fusion.analysis.attribution.correlate import flatten_field
from fusion.analysis.attribution.drift_channels import DriftSeries, clock_readings, reduce_channels
from fusion.analysis.attribution.modes import thermal_modes
from fusion.analysis.attribution.significance import LAGS_S, null_bank, whitening_grid
from fusion.common import Array
from thermography.large_arrays import empty_array, one_by_one

#: The camera is represented by at most this many thermal modes.
_CAMERA_MODES = 6
#: Number of runs of successive cycles that are held out in turn.
FOLDS = 4
#: Prior standard deviations of the contribution of one temperature, in units of the noise of one value.
_PRIORS = 3.0 ** np.arange(-1.0, 6.0)
#: Log-likelihoods that differ by less than this cannot be distinguished (chi-square, 1 degree of freedom, 0.95, halved).
_EQUAL_NATS = 1.92
#: A loss this many standard uncertainties above zero is significant.
_DECIDED = 2.0


@dataclass(frozen=True)
class Excess:
    """Mean square error of a prediction minus that of the camera, mean over all targets, and its standard uncertainty, um^2.

    Negative values occur where the difference is within u.
    """

    value: float
    u: float

    @property
    def um(self) -> float:
        """Loss: root of the excess, 0 where it is not positive, um."""
        return float(np.sqrt(max(self.value, 0.0)))

    @property
    def at_most_um(self) -> float:
        """Upper limit of the loss (two standard uncertainties), um."""
        return float(np.sqrt(max(self.value, 0.0) + _DECIDED * self.u))

    @property
    def decided(self) -> bool:
        """Whether the loss is significant."""
        return self.value > _DECIDED * self.u


@dataclass(frozen=True)
class SensorSet:
    """The best set of sensors of one size: places (x, y) in the order of their gain, and what they lose against the camera."""

    places_mm: tuple[tuple[float, float], ...]
    loss: Excess


@dataclass(frozen=True)
class SensorChoice:
    """Sets of 1, 2, ... contact sensors in place of the camera, none where the field does not change.

    ``without`` is what is lost without any temperature: the gain by the camera; ``run_s`` the length of a held-out run of cycles, within
    which the losses hold.
    """

    sets: tuple[SensorSet, ...]
    without: Excess
    run_s: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_sensors(
    fused_readings: xr.Dataset, field: xr.DataArray, *, most: int = 6, contact_noise_K: float = 0.02, seed: int = 0
) -> SensorChoice:
    """Choose 1 to `most` places of contact sensors on the plan."""
    readings = clock_readings(fused_readings, field["time"].values.astype("datetime64[ns]"))
    cells, seen = flatten_field(field, readings.frame_seconds)
    series = [channel for channel in reduce_channels(readings) if channel.name != "reversal"]
    modes, _ = thermal_modes(cells.values, limit=_CAMERA_MODES)
    if modes.shape[1] == 0:
        return SensorChoice((), Excess(0.0, 0.0), 0.0)
    # The modes of the camera are free of the noise of single cells; a contact sensor adds its own noise to its cell.
    smooth = modes @ np.linalg.lstsq(modes, cells.values, rcond=None)[0]
    contact = smooth + contact_noise_K * np.random.default_rng(seed).standard_normal(smooth.shape)
    operators = lag_operators(cells.seconds, LAGS_S)
    # Mean square over the targets of a shift, and of a stretch that is 1 at the ends of travel.
    weight = {"common": 1.0, "proportional": float((readings.design[:, 1] ** 2).mean())}
    tasks = [_Task(one, one.lagged_sampling(operators)) for one in series]
    most = min(most, contact.shape[1])
    # Choose cells by all values; what is whitened for that, which is large, ends here.
    parts = [_Part(task, np.ones(task.series.values.size, bool)) for task in tasks]
    chosen = _place(parts, [_fit(part, modes) for part in parts], contact, most)
    rows, columns = np.divmod(np.flatnonzero(seen)[chosen], field.sizes["x"])
    places = tuple((float(field["x"][c]), float(field["y"][r])) for r, c in zip(rows, columns, strict=True))
    predictions = _predict_held_out(tasks, modes, contact, most)
    compared = list(zip(tasks, predictions, strict=True))
    excess = [
        _total([(_exceed(task, found[0], found[1 + k]), weight[task.series.name]) for task, found in compared])
        for k in range(most + 1)
    ]
    run_s = float(np.ptp(series[0].seconds)) / FOLDS
    return SensorChoice(tuple(SensorSet(places[:k], excess[k]) for k in range(1, most + 1)), excess[0], run_s)


@dataclass(frozen=True)
class _Task:
    """One drift channel, and how it samples the field under every lag, (lags, n, frames)."""

    series: DriftSeries
    responses: Array


class _Part:
    """The values of one channel that a prediction may be fitted to, whitened at every grid point."""

    def __init__(self, task: _Task, kept: NDArray[np.bool_]) -> None:
        series = task.series
        self.task, self.kept = task, kept
        self.values = series.values[kept]
        ones = np.ones((self.values.size, 1))
        grid = whitening_grid(series.seconds[kept], series.variance[kept], ones)
        self.freedom = grid.freedom
        # Of a long test all grid points together fill the memory: they are in a temporary file.
        self.projects = empty_array((len(grid.whitenings), self.values.size, self.values.size), float)
        self.white = np.empty(self.projects.shape[:2])
        for g, (point, project) in enumerate(zip(grid.whitenings, one_by_one(self.projects), strict=True)):
            exact = point.project
            project[:], self.white[g] = exact, exact @ self.values
        self.penalty = np.array([point.log_penalty for point in grid.whitenings])

    def columns(self, temperatures: Array, lag: int) -> Array:
        """Regressors of the kept values under one lag, (n, p), from temperatures (frames, p)."""
        return np.asarray(self.task.responses[lag][self.kept] @ temperatures, float)


@dataclass(frozen=True)
class _Fit:
    """The model of highest marginal likelihood: indices of drift and lag, prior variance of a sensitivity over that of the noise (1/K^2),
    sensitivities (um/K), and minus twice the logarithm of the likelihood over the degrees of freedom.
    """

    drift: int
    lag: int
    prior: float
    coefficients: Array
    score: float


def _fit(part: _Part, temperatures: Array) -> _Fit:
    """Fit the sensitivities to temperatures (frames, p) that share one lag and one prior."""
    columns = np.stack([part.columns(temperatures, lag) for lag in range(len(part.task.responses))])
    size = float(np.sqrt((columns[0] ** 2).mean())) + 1e-30
    freedom = part.freedom
    best = _Fit(0, 0, 0.0, np.zeros(temperatures.shape[1]), np.inf)
    for drift, (project, white) in enumerate(zip(one_by_one(part.projects), part.white, strict=True)):
        whitened = project @ columns
        power, vectors = np.linalg.eigh(whitened.transpose(0, 2, 1) @ whitened)
        power = np.maximum(power, 0.0)
        along = np.einsum("lpk,lp->lk", vectors, np.einsum("lnp,n->lp", whitened, white))
        whole = float(white @ white)
        for spread in _PRIORS:
            prior = (spread / size) ** 2
            shrunk = prior / (1.0 + prior * power)
            rss = np.maximum(whole - (along**2 * shrunk).sum(axis=1), 1e-30)
            score = np.log(rss) + (np.log1p(prior * power).sum(axis=1)) / freedom + part.penalty[drift]
            lag = int(np.argmin(score))
            if score[lag] < best.score:
                best = _Fit(drift, lag, prior, vectors[lag] @ (shrunk[lag] * along[lag]), float(score[lag]))
    return best


def _place(parts: Sequence[_Part], fits: Sequence[_Fit], contact: Array, most: int) -> list[int]:
    """Choose cells one by one: each raises the marginal likelihood of all channels most, under drift and lag of the camera fit."""
    chosen: list[int] = []
    swing = contact.std(axis=0)
    states = []
    for part, fit in zip(parts, fits, strict=True):
        for project in one_by_one([part.projects[fit.drift]]):
            states.append((project.T @ project, part.columns(contact, fit.lag)))
    for _ in range(most):
        gain = np.zeros(contact.shape[1])
        for part, fit, (inverse, columns) in zip(parts, fits, states, strict=True):
            moved = inverse @ columns
            informed = 1.0 + fit.prior * np.einsum("ij,ij->j", columns, moved)
            whole = float(part.values @ inverse @ part.values)
            share = fit.prior * (part.values @ moved) ** 2 / informed / whole
            gain -= part.freedom * np.log1p(-np.minimum(share, 1.0 - 1e-9)) + np.log(informed)
        gain[chosen] = -np.inf
        # Among cells that these data cannot tell apart, the one that warms most has the highest signal over its noise.
        chosen.append(int(np.where(gain >= gain.max() - _EQUAL_NATS, swing, -1.0).argmax()))
        for k, (fit, (inverse, columns)) in enumerate(zip(fits, states, strict=True)):
            moved = inverse @ columns[:, chosen[-1]]
            informed = 1.0 + fit.prior * float(columns[:, chosen[-1]] @ moved)
            states[k] = (inverse - fit.prior * np.outer(moved, moved) / informed, columns)
    return chosen


def _predict_held_out(tasks: Sequence[_Task], modes: Array, contact: Array, most: int) -> list[Array]:
    """Predictions per channel, (2 + most, n): the camera, nothing, and 1 to `most` sensors; each run from a fit to the others."""
    predictions = [np.zeros((2 + most, task.series.values.size)) for task in tasks]
    # Channels share their cycles, so that runs are the same stretch of the session in all of them.
    for run in _runs(tasks[0].series.values.size):
        parts = [_Part(task, ~np.isin(np.arange(task.series.values.size), run)) for task in tasks]
        camera = [_fit(part, modes) for part in parts]
        chosen = _place(parts, camera, contact, most)
        for task, part, by_camera, out in zip(tasks, parts, camera, predictions, strict=True):
            out[0, run] = (task.responses[by_camera.lag][run] @ modes) @ by_camera.coefficients
            least = np.inf
            for k in range(1, most + 1):
                sensors = contact[:, chosen[:k]]
                fit = _fit(part, sensors)
                # A sensor that does not improve the fit to the other runs is not used.
                out[1 + k, run] = out[k, run] if k > 1 else 0.0
                if fit.score < least:
                    least = fit.score
                    out[1 + k, run] = (task.responses[fit.lag][run] @ sensors) @ fit.coefficients
    return predictions


def _exceed(task: _Task, camera: Array, other: Array) -> Excess:
    """Mean square error of a prediction (n,) minus that of the camera within the runs, from the difference of the two."""
    series = task.series
    residual = series.values - camera
    delta = _within_runs(camera - other)
    rest = null_bank(residual, series.seconds, series.variance, np.ones((residual.size, 1)))
    white = rest.fitted.project @ residual
    noise = float(np.sqrt(white @ white / rest.freedom))
    value = float((delta**2).mean() + 2.0 * (delta * _within_runs(residual)).mean())
    return Excess(value, 2.0 * noise * float(np.sqrt(((delta @ rest.fitted.colour) ** 2).sum())) / delta.size)


def _runs(values: int) -> list[NDArray[np.int64]]:
    return np.array_split(np.arange(values), FOLDS)


def _within_runs(series: Array) -> Array:
    """A series (n,) minus its mean within each run."""
    return np.concatenate([series[run] - series[run].mean() for run in _runs(series.size)])


def _total(parts: Sequence[tuple[Excess, float]]) -> Excess:
    """Sum over channels with their weights."""
    value = sum(weight * excess.value for excess, weight in parts)
    return Excess(float(value), float(np.sqrt(sum((weight * excess.u) ** 2 for excess, weight in parts))))
