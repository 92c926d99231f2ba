"""L4 - Which few contact sensors, placed where, would do as well as the camera, and what each missing one costs in um.

Sensors are chosen one by one among the plan cells: each new one lowers most what is left of the drift channels under the session's
drift model (orthogonal least squares). What a set is worth is judged on later cycles than it was chosen and fitted on, against the
camera's thermal modes fitted the same way; never by random folds, which reward series that merely wander alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fusion.attribution import LAGS_S
from fusion.attribution_kernel import NullBank, null_bank
from fusion.channels import Array, DriftSeries, lag_operators, read_clock, reduce_channels
from fusion.correlation import read_film
from fusion.excitation import thermal_modes

#: The camera is represented by at most this many thermal modes.
CAMERA_MODES = 6
#: Share of the cycles that chooses and fits; the rest judges.
TRAIN_SHARE = 0.7


@dataclass(frozen=True)
class SensorSet:
    """The best sensors of one size.

    Attributes
    ----------
    places_mm : x, y of every sensor, in the order of their worth
    rms_um : held-out drift left at the worst target (common plus stretch)
    camera_rms_um : the same with the camera
    loss_um : what the sensors miss beside the camera, as a root of the difference of squares (0 where they do as well)
    """

    places_mm: tuple[tuple[float, float], ...]
    rms_um: float
    camera_rms_um: float
    loss_um: float


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_sensors(
    fused_readings: xr.Dataset,
    field: xr.DataArray,
    *,
    most: int = 6,
    contact_noise_K: float = 0.02,
    lags_s: Sequence[float] = LAGS_S,
    seed: int = 0,
) -> list[SensorSet]:
    """Choose 1..most contact sensors on the plan.

    Parameters
    ----------
    fused_readings, field : as for :func:`fusion.correlation.correlate`
    most : int
        Largest number of sensors.
    contact_noise_K : float
        Noise of a contact sensor's value per cycle, added to the cells so that no set lives on differences that it could not see.
    lags_s : sequence of float
        Lags that each sensor and mode may take.
    seed : int
        Seed of that noise.

    Returns
    -------
    list of SensorSet
        For 1, 2, ... sensors.
    """
    readings = read_clock(fused_readings, field["time"].values.astype("datetime64[ns]"))
    film, seen = read_film(field, readings.frame_seconds)
    series = [one for one in reduce_channels(readings) if one.name != "reversal"]
    operators = lag_operators(film.seconds, lags_s)
    courses, _ = thermal_modes(film.values, limit=CAMERA_MODES)
    # The camera sees its modes free of the single cells' noise; a contact sensor sees its cell with its own.
    smooth = courses @ np.linalg.lstsq(courses, film.values, rcond=None)[0]
    contact = smooth + contact_noise_K * np.random.default_rng(seed).standard_normal(smooth.shape)
    tasks = [_Task.build(one, operators) for one in series]
    camera = _held_out(tasks, courses, list(range(courses.shape[1])))
    places = np.flatnonzero(seen)
    chosen: list[int] = []
    sets = []
    for _ in range(min(most, contact.shape[1])):
        chosen.append(_next_sensor(tasks, contact, chosen))
        rms = _held_out(tasks, contact, chosen)
        rows, columns = np.divmod(places[chosen], field.sizes["x"])
        sets.append(
            SensorSet(
                tuple((float(field["x"][c]), float(field["y"][r])) for r, c in zip(rows, columns, strict=True)),
                rms,
                camera,
                float(np.sqrt(max(rms**2 - camera**2, 0.0))),
            )
        )
    return sets


@dataclass(frozen=True)
class _Task:
    """One channel: training rows, the whitening fitted on them, and how the channel sees the film under every lag."""

    series: DriftSeries
    train: NDArray[np.bool_]
    bank: NullBank
    responses: Array

    @staticmethod
    def build(series: DriftSeries, operators: Sequence[Array]) -> _Task:
        train = np.arange(series.values.size) < round(TRAIN_SHARE * series.values.size)
        ones = np.ones((int(train.sum()), 1))
        bank = null_bank(series.values[train], series.seconds[train], series.variance[train], ones)
        return _Task(series, train, bank, np.stack([series.sampling @ operator for operator in operators]))

    def white(self, columns: Array) -> tuple[Array, Array]:
        """Whitened training response (n,) and columns (n, p)."""
        project = self.bank.fitted.project
        return project @ self.series.values[self.train], project @ columns[self.train]

    def lagged(self, film: Array) -> Array:
        """Film columns as the channel sees them, (n, columns, lags)."""
        return np.asarray(np.tensordot(self.responses, film, axes=(2, 0)).transpose(1, 2, 0), float)


def _columns(task: _Task, film: Array, members: Sequence[int]) -> Array:
    """Each member at the lag that explains the training part best beside those before it, (n, members)."""
    kept: list[Array] = []
    for member in members:
        candidates = task.lagged(film[:, [member]])[:, 0, :]
        gains = []
        for lag in range(candidates.shape[1]):
            response, white = task.white(np.column_stack([*kept, candidates[:, lag]]))
            rest = response - white @ np.linalg.lstsq(white, response, rcond=None)[0]
            gains.append(float(rest @ rest))
        kept.append(candidates[:, int(np.argmin(gains))])
    return np.column_stack(kept)


def _next_sensor(tasks: Sequence[_Task], film: Array, chosen: Sequence[int]) -> int:
    """The cell that lowers the sum of the channels' whitened residuals most beside the chosen ones."""
    total = np.zeros(film.shape[1])
    for task in tasks:
        response, _ = task.white(task.series.values[:, None])
        basis = np.zeros((response.size, 0))
        if chosen:
            basis, _ = np.linalg.qr(task.white(_columns(task, film, chosen))[1])
        rest = response - basis @ (basis.T @ response)
        project = task.bank.fitted.project
        gain = np.zeros(film.shape[1])
        for operator in task.responses:
            white = project @ (operator[task.train] @ film)
            free = white - basis @ (basis.T @ white)
            size = np.sqrt((free**2).sum(axis=0))
            useful = size > 1e-6 * np.sqrt((white**2).sum(axis=0)) + 1e-12
            gain = np.maximum(gain, np.where(useful, (rest @ free / np.where(useful, size, 1.0)) ** 2, 0.0))
        total += gain / max(float(rest @ rest), 1e-30)
    total[list(chosen)] = -1.0
    return int(total.argmax())


def _held_out(tasks: Sequence[_Task], film: Array, members: Sequence[int]) -> float:
    """Root mean square of common plus stretch that is left in the later cycles, each from its level at their start (um)."""
    left = []
    for task in tasks:
        columns = _columns(task, film, members)
        response, white = task.white(columns)
        rest = task.series.values - columns @ _shrunk(task, response, white, columns)
        # The level is known when the prediction starts; after that nothing is measured any more.
        start = rest[task.train][-3:].mean()
        left.append(rest[~task.train] - start)
    return float(np.sqrt((sum(left) ** 2).mean()))


def _shrunk(task: _Task, response: Array, white: Array, columns: Array) -> Array:
    """Coefficients with a prior under which each member alone may explain the whole drift, but no more (ridge).

    Without it, members that warm alike get large coefficients of opposite sign, which multiply the sensors' noise later on.
    """
    prior = task.series.values.std() / np.maximum(columns[task.train].std(axis=0), 1e-12)
    noise = float(np.sqrt((response @ response) / task.bank.freedom))
    augmented = np.vstack([white, np.diag(noise / prior)])
    target = np.concatenate([response, np.zeros(prior.size)])
    return np.asarray(np.linalg.lstsq(augmented, target, rcond=None)[0], float)
