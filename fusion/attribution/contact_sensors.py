"""Which few contact sensors, placed where, would do as well as the camera, and what each missing one costs in um.

Camera (its thermal modes) and sensors (single cells with a contact sensor's noise) predict the drift channels by the same model: one
lag, one prior for all sensitivities, and a drift of its own kind and size, all chosen by marginal likelihood. Everything, the places
included, is chosen on three quarters of the cycles and predicts the quarter left out, a run of successive cycles; never random ones,
which reward series that merely wander alike.

What the sensors lose beside the camera is not taken from two held-out errors: both contain the drift that neither explains, whose
chance fluctuation is larger than what is asked. It is taken from where the two predictions differ: with their difference delta and
what the camera leaves of the readings, e, both from their mean within each run, the sensors' mean square error exceeds the camera's by::

    mean(delta^2) + 2 mean(delta e)

exactly, and its uncertainty is what the drift and noise in e do to the second term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion._typing import Array
from fusion.alignment.first_order_lag import lag_operators
from fusion.attribution.attribute import read_film
from fusion.attribution.drift_channels import DriftSeries, read_clock, reduce_channels
from fusion.attribution.family_wise import LAGS_S
from fusion.attribution.likelihood_ratio import Grid, null_bank, whitening_grid
from fusion.attribution.warm_up import thermal_modes

#: The camera is represented by at most this many thermal modes.
CAMERA_MODES = 6
#: Runs of successive cycles that are left out in turn.
FOLDS = 4
#: Prior spread of what one member explains, in units of the noise of one value.
_PRIORS = 3.0 ** np.arange(-1.0, 6.0)
#: Log-likelihoods that differ by less than this cannot be told apart (chi-square, 1 degree of freedom, 0.95, halved).
_ALIKE_NATS = 1.92
#: An excess this many uncertainties above zero is decided.
_DECIDED = 2.0


@dataclass(frozen=True)
class Excess:
    """Mean square error of a prediction beyond the camera's, um^2, rms over all targets.

    Attributes
    ----------
    value, u : with its standard uncertainty; negative values occur where the difference is within u
    """

    value: float
    u: float

    @property
    def um(self) -> float:
        """The loss in um: root of the excess, 0 where it is not positive."""
        return float(np.sqrt(max(self.value, 0.0)))

    @property
    def at_most_um(self) -> float:
        """Upper end of the loss in um (two uncertainties)."""
        return float(np.sqrt(max(self.value, 0.0) + _DECIDED * self.u))

    @property
    def decided(self) -> bool:
        """Whether the data show a loss at all."""
        return self.value > _DECIDED * self.u


@dataclass(frozen=True)
class SensorSet:
    """The best sensors of one size, in the order of their worth, and what they miss beside the camera."""

    places_mm: tuple[tuple[float, float], ...]
    loss: Excess


@dataclass(frozen=True)
class SensorChoice:
    """Contact sensors beside the camera.

    Attributes
    ----------
    sets : for 1, 2, ... sensors; empty where the field stands still
    without : what is missed without any temperature: the worth of the camera itself
    run_s : length of a run of cycles within which the losses hold, s
    """

    sets: tuple[SensorSet, ...]
    without: Excess
    run_s: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_sensors(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    *,
    most: int = 6,
    contact_noise_K: float = 0.02,
    lags_s: Sequence[float] = LAGS_S,
    seed: int = 0,
) -> SensorChoice:
    """Choose 1..most contact sensors on the plan.

    Parameters
    ----------
    fused_readings, field : as for :func:`fusion.attribution.attribute.correlate`
    most : int
        Largest number of sensors.
    contact_noise_K : float
        Noise of a contact sensor's value per frame, added to the cells so that no set lives on differences that it could not see.
    lags_s : sequence of float
        Lags between temperature and drift, one for all members of a prediction.
    seed : int
        Seed of that noise.
    """
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    series = [one for one in reduce_channels(readings) if one.name != "reversal"]
    modes, _ = thermal_modes(film.values, limit=CAMERA_MODES)
    if modes.shape[1] == 0:
        return SensorChoice((), Excess(0.0, 0.0), 0.0)
    # The camera sees its modes free of the single cells' noise; a contact sensor sees its cell with its own.
    smooth = modes @ np.linalg.lstsq(modes, film.values, rcond=None)[0]
    contact = smooth + contact_noise_K * np.random.default_rng(seed).standard_normal(smooth.shape)
    operators = lag_operators(film.seconds, lags_s)
    # Mean square over the targets of a shift, and of a stretch that is 1 at the ends of travel.
    weight = {"common": 1.0, "proportional": float((readings.design[:, 1] ** 2).mean())}
    tasks = [_Task.build(one, operators) for one in series]
    most = min(most, contact.shape[1])
    everything = [_Part(task, np.ones(task.series.values.size, bool)) for task in tasks]
    chosen = _place(everything, [_fit(part, modes) for part in everything], contact, most)
    rows, columns = np.divmod(np.flatnonzero(seen)[chosen], field.sizes["x"])
    places = tuple((float(field["x"][c]), float(field["y"][r])) for r, c in zip(rows, columns, strict=True))
    predictions = _predict_left_out(tasks, modes, contact, most)
    excess = [
        _total(
            [
                (_exceed(task, one[0], one[1 + k]), weight[task.series.name])
                for task, one in zip(tasks, predictions, strict=True)
            ]
        )
        for k in range(most + 1)
    ]
    run_s = float(np.ptp(series[0].seconds)) / FOLDS
    return SensorChoice(tuple(SensorSet(places[:k], excess[k]) for k in range(1, most + 1)), excess[0], run_s)


@dataclass(frozen=True)
class _Task:
    """One channel, and how it sees the film under every lag, (lags, n, frames)."""

    series: DriftSeries
    responses: Array

    @staticmethod
    def build(series: DriftSeries, operators: Sequence[Array]) -> _Task:
        return _Task(series, np.stack([series.sampling @ operator for operator in operators]))


class _Part:
    """The values of one channel that a prediction may be fitted to, whitened under every drift of the grid."""

    def __init__(self, task: _Task, kept: NDArray[np.bool_]) -> None:
        series = task.series
        self.task, self.kept = task, kept
        self.values = series.values[kept]
        ones = np.ones((self.values.size, 1))
        self.grid: Grid = whitening_grid(series.seconds[kept], series.variance[kept], ones)
        self.projects = np.stack([point.project for point in self.grid.whitenings])
        self.penalty = np.array([point.log_penalty for point in self.grid.whitenings])
        self.white = self.projects @ self.values

    def columns(self, film: Array) -> Array:
        """Members (frames, members) as the kept values see them under every lag, (lags, n, members)."""
        return np.asarray(self.task.responses[:, self.kept] @ film, float)


@dataclass(frozen=True)
class _Fit:
    """The model of highest marginal likelihood: place in the drift grid, lag, prior variance of a sensitivity over noise variance.

    `score` is the negative logarithm of that likelihood per degree of freedom, doubled.
    """

    drift: int
    lag: int
    prior: float
    coefficients: Array
    score: float


def _fit(part: _Part, members: Array) -> _Fit:
    """Fit sensitivities of members (frames, p) that share one lag and one prior."""
    columns = part.columns(members)
    size = float(np.sqrt((columns[0] ** 2).mean())) + 1e-30
    freedom = part.grid.freedom
    found = _Fit(0, 0, 0.0, np.zeros(members.shape[1]), np.inf)
    for drift, (project, white) in enumerate(zip(part.projects, part.white, strict=True)):
        moved = project @ columns
        power, vectors = np.linalg.eigh(moved.transpose(0, 2, 1) @ moved)
        power = np.maximum(power, 0.0)
        along = np.einsum("lpk,lp->lk", vectors, np.einsum("lnp,n->lp", moved, white))
        whole = float(white @ white)
        for spread in _PRIORS:
            prior = (spread / size) ** 2
            shrunk = prior / (1.0 + prior * power)
            rss = np.maximum(whole - (along**2 * shrunk).sum(axis=1), 1e-30)
            score = np.log(rss) + (np.log1p(prior * power).sum(axis=1)) / freedom + part.penalty[drift]
            lag = int(np.argmin(score))
            if score[lag] < found.score:
                found = _Fit(drift, lag, prior, vectors[lag] @ (shrunk[lag] * along[lag]), float(score[lag]))
    return found


def _place(parts: Sequence[_Part], fits: Sequence[_Fit], contact: Array, most: int) -> list[int]:
    """Choose cells one by one: each raises the marginal likelihood of all channels most, under the drift and lag of the camera's fit."""
    chosen: list[int] = []
    swing = contact.std(axis=0)
    left = []
    for part, fit in zip(parts, fits, strict=True):
        project = part.projects[fit.drift]
        left.append((project.T @ project, part.columns(contact)[fit.lag]))
    for _ in range(most):
        gain = np.zeros(contact.shape[1])
        for part, fit, (inverse, columns) in zip(parts, fits, left, strict=True):
            moved = inverse @ columns
            informed = 1.0 + fit.prior * np.einsum("ij,ij->j", columns, moved)
            whole = float(part.values @ inverse @ part.values)
            share = fit.prior * (part.values @ moved) ** 2 / informed / whole
            gain -= part.grid.freedom * np.log1p(-np.minimum(share, 1.0 - 1e-9)) + np.log(informed)
        gain[chosen] = -np.inf
        # Among cells that these data cannot tell apart the one that warms most shows the most beside its noise.
        chosen.append(int(np.where(gain >= gain.max() - _ALIKE_NATS, swing, -1.0).argmax()))
        for k, (fit, (inverse, columns)) in enumerate(zip(fits, left, strict=True)):
            moved = inverse @ columns[:, chosen[-1]]
            informed = 1.0 + fit.prior * float(columns[:, chosen[-1]] @ moved)
            left[k] = (inverse - fit.prior * np.outer(moved, moved) / informed, columns)
    return chosen


def _predict_left_out(tasks: Sequence[_Task], modes: Array, contact: Array, most: int) -> list[Array]:
    """Predictions per channel, (2 + most, n): the camera, nothing, and 1..most sensors; each run by what the others teach."""
    predictions = [np.zeros((2 + most, task.series.values.size)) for task in tasks]
    # Channels share their cycles, so that runs are the same stretch of the session in all of them.
    for run in _runs(tasks[0].series.values.size):
        parts = [_Part(task, ~np.isin(np.arange(task.series.values.size), run)) for task in tasks]
        camera = [_fit(part, modes) for part in parts]
        chosen = _place(parts, camera, contact, most)
        for task, part, seen, out in zip(tasks, parts, camera, predictions, strict=True):
            out[0, run] = (task.responses[seen.lag][run] @ modes) @ seen.coefficients
            least = np.inf
            for k in range(1, most + 1):
                few = contact[:, chosen[:k]]
                fit = _fit(part, few)
                # A sensor that the other runs cannot make use of is there, but not used.
                out[1 + k, run] = out[k, run] if k > 1 else 0.0
                if fit.score < least:
                    least = fit.score
                    out[1 + k, run] = (task.responses[fit.lag][run] @ few) @ fit.coefficients
    return predictions


def _exceed(task: _Task, camera: Array, other: Array) -> Excess:
    """Mean square error of a prediction (n,) beyond the camera's within the runs, from where the two differ."""
    series = task.series
    left = series.values - camera
    delta = _within_runs(camera - other)
    rest = null_bank(left, series.seconds, series.variance, np.ones((left.size, 1)))
    white = rest.fitted.project @ left
    noise = float(np.sqrt(white @ white / rest.freedom))
    value = float((delta**2).mean() + 2.0 * (delta * _within_runs(left)).mean())
    return Excess(value, 2.0 * noise * float(np.sqrt(((delta @ rest.fitted.colour) ** 2).sum())) / delta.size)


def _runs(values: int) -> list[NDArray[np.int64]]:
    return np.array_split(np.arange(values), FOLDS)


def _within_runs(series: Array) -> Array:
    """A series (n,) from its mean within each run."""
    return np.concatenate([series[run] - series[run].mean() for run in _runs(series.size)])


def _total(parts: Sequence[tuple[Excess, float]]) -> Excess:
    """Sum over channels with their weights."""
    value = sum(weight * one.value for one, weight in parts)
    return Excess(float(value), float(np.sqrt(sum((weight * one.u) ** 2 for one, weight in parts))))
