"""Joint estimate of an axis: profile of both directions and thermal drift in real time, from every reading at its own time.

Each reading is a profile value of its direction and target, plus a drift that wanders in time (a shift of all targets and a stretch
that grows with position; where the readings ask for it, also a drift of the reversal error and a bend), plus noise. Profile and drift
are estimated together by generalised least squares, the variances of the drift by restricted maximum likelihood
(:mod:`interferometry.drift.gls`); readings far from the others are down-weighted. With complete readings and a drift of these shapes
the profile agrees with the plain mean of the cycles; with missing readings, unequal passes or outliers it is better, and its
covariance is known.

In this order: the public steps; the fit (which readings, profile columns and drift components); the thermal state that the profile
belongs to; the result as a Dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy
import xarray as xr
from numpy.typing import NDArray

from interferometry.common import DIRECTIONS, Array, InterferometryError, check_dataset, one_thread
from interferometry.deviations import DIMS, OUTLIER, ROUNDING, set_flag, sort_readings
from interferometry.drift.gls import (
    DriftFit,
    average_drift,
    estimate,
    memory_of_each,
    typical_memory,
    von_neumann_p_value,
)
from interferometry.drift.kalman import Order

# Shapes along the axis that a drift may have by name, and the share of each in a reading.

#: Share of a drift component in a reading, by its sign of approach (+1, -1) and its place (0 first position, 1 last).
COMPONENTS = {
    "shift": lambda sign, place: np.ones(place.size),
    "stretch": lambda sign, place: place,
    "reversal": lambda sign, place: sign / 2.0,
    "bend": lambda sign, place: 4.0 * place * (1.0 - place),
}
BASE_COMPONENTS = ("shift", "stretch")


def component_loadings(
    sign: Array, position_mm: Array, *, components: Sequence[str], span_mm: tuple[float, float]
) -> Array:
    """Return the share of each drift component in readings of a direction at a position."""
    place = (np.asarray(position_mm, float) - span_mm[0]) / (span_mm[1] - span_mm[0])
    return np.column_stack([COMPONENTS[name](np.asarray(sign, float), place) for name in components])


# Shape along the axis of a drift that shift, stretch and bend do not describe, from the readings themselves.

#: Level at which a common motion of the targets is a shape: along any course, and along the one course of what goes on in one direction.
SHAPE_LEVEL, TREND_LEVEL = 0.01, 0.02
#: Least number of targets that take part in a shape (inverse participation ratio): fewer are positions that move by themselves.
LEAST_TARGETS = 3.5
#: Fewest cycles in which a shape is looked for along any course, and along a trend.
SHORTEST_TEST_CYCLES, SHORTEST_TREND_CYCLES = 15, 8
_PERMUTATIONS = 199
_SEED = 0
#: Shares that a cycle keeps from the one before it in the courses that are looked for: a rhythm of few cycles, and a warm-up.
_KEPT = (0.1, 0.85)


def common_shape(residual: Array, known: Array) -> Array | None:
    """Return the shape along the axis of a motion over the cycles that the known shapes leave, if any."""
    cycles, targets = residual.shape
    if cycles < SHORTEST_TREND_CYCLES or targets < known.shape[1] + 2:
        return None
    remainder = _without(residual, known)
    whitened = _without_memory(remainder, _memory(remainder))
    trend = np.arange(cycles) - 0.5 * (cycles - 1)
    tried = [(np.outer(trend, trend), TREND_LEVEL)]
    if cycles >= SHORTEST_TEST_CYCLES:
        tried += [(_succession(cycles, kept), SHAPE_LEVEL / len(_KEPT)) for kept in _KEPT]
    for weights, level in tried:
        values, vectors = np.linalg.eigh(whitened.T @ weights @ whitened)
        shape, rng = vectors[:, -1], np.random.default_rng(_SEED)
        permuted = [
            np.linalg.eigvalsh(rows.T @ weights @ rows)[-1]
            for rows in (rng.permutation(whitened) for _ in range(_PERMUTATIONS))
        ]
        by_chance = (1 + np.count_nonzero(np.array(permuted) >= values[-1])) / (_PERMUTATIONS + 1)
        if 1.0 / float((shape**4).sum()) >= LEAST_TARGETS and by_chance <= level:
            # Cycles near each other show that there is a shape; all of them together tell it best.
            shape = remainder.T @ (remainder @ shape)
            return np.asarray(shape / shape[np.argmax(np.abs(shape))])
    return None


def _without(residual: Array, known: Array) -> Array:
    """Take the known shapes from every cycle; a missing target is 0 after that."""
    remainder = np.zeros_like(residual)
    for row, values in zip(remainder, residual, strict=True):
        present = np.isfinite(values)
        if np.count_nonzero(present) > known.shape[1]:
            basis = known[present]
            row[present] = values[present] - basis @ np.linalg.lstsq(basis, values[present], rcond=None)[0]
    return remainder - remainder.mean(axis=0)


def _memory(remainder: Array) -> float:
    """Median over the targets of the lag-one correlation over the cycles, at least 0."""
    product = (remainder[1:] * remainder[:-1]).sum(axis=0)
    square = (remainder**2).sum(axis=0)
    return max(0.0, float(np.median(product[square > 0] / square[square > 0]))) if (square > 0).any() else 0.0


def _without_memory(values: Array, memory: float) -> Array:
    """Innovations of an autoregression over the cycles (cycles, ...), the first value with their variance."""
    return np.concatenate([np.sqrt(1.0 - memory**2) * values[:1], values[1:] - memory * values[:-1]])


def _succession(count: int, kept: float) -> Array:
    """Weights of the products of different rows (count, count), which fall by a factor from one row to the next."""
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(kept**apart - np.eye(count))


#: Deletion residual, in standard deviations, from which a reading is flagged as an outlier: among 10,000 normal
#: readings the chance of one is 0.07.
OUTLIER_LIMIT = 4.5
#: A further component is added where its contrast over the cycles is serially dependent at this level.
COMPONENT_LEVEL = 1e-3
#: Most shapes that the readings may add.
MOST_SHAPES = 3
#: Median absolute deviations from which a reading is left out before the fit.
GROSS_LIMIT = 50.0
#: A cell's own scatter replaces the common one in its uncertainty where it exceeds that at this level.
EXCESS_LEVEL = 1e-3

Variable = tuple[tuple[str, ...], object, dict[str, str]]
Variables = dict[str, Variable]


def _um(dims: tuple[str, ...], values: object, long_name: str = "") -> Variable:
    """Return a variable in um."""
    return dims, values, {"units": "um", **({"long_name": long_name} if long_name else {})}


class DriftDataError(InterferometryError):
    """The deviations cannot be fitted jointly; the message says what is missing."""


class NoScatterError(DriftDataError):
    """Readings repeat exactly: coarser digits than their scatter and drift."""


@one_thread
def estimate_drift(
    deviations: xr.Dataset,
    *,
    state: str | float = "mean",
    robust: bool = True,
    order: Order | None = None,
    components: Sequence[str] | None = None,
) -> xr.Dataset:
    """Estimate profile and drift of an axis together.

    Parameters
    ----------
    deviations : xarray.Dataset
        Positioning deviations (cycle, direction, target) in um with their times, as `build_deviations` returns them; readings
        may be missing, directions unequal.
    state : {"mean", "start", "end"} or float
        Thermal state that the profile belongs to: the average over the measured cycles, that of the first or the last reading,
        or that of an instant in s since the first reading.
    robust : bool
        Leave gross outliers out and down-weight readings far from the others.
    order : {1, 2}, optional
        1 random walk, 2 integrated random walk; None: chosen by the restricted likelihood.
    components : sequence of str, optional
        Names out of COMPONENTS; None: shift and stretch, and reversal and bend where the readings ask for them.

    Returns
    -------
    xarray.Dataset
        All in um unless said otherwise; ``<name>_u`` is the standard uncertainty of ``<name>``.

        - ``profile`` (direction, target) in the stated thermal state, with u, and ``covariance`` (direction, target,
          other_direction, other_target; um2) of all its values; ``profile_relative`` to the first target of the same
          direction, with u.
        - ``reversal`` (target): reversal error B_i, positive minus negative direction, with u.
        - ``scatter`` (direction, target): random standard deviation, with u and ``scatter_freedom`` (1), its degrees of
          freedom; ``scatter_position`` (target): both directions together; ``sigma``: of an ordinary reading.
        - ``drift`` (cycle, direction, target) from the stated thermal state at every reading, with u, and every component as
          ``drift_<component>``, with u: profile plus drift is the expected reading. ``drift_since_first``, with u: the same from the
          mean state of the first cycle, where it is zero. ``drift_size`` (component): standard
          deviation over the test; ``drift_rate`` (component): standard deviation of the increments of one hour;
          ``drift_share`` (component, direction, target; 1): its share in a reading.
        - ``noise`` (cycle, direction, target): estimated random part of each reading. ``standardised`` (1): its deletion
          residual in standard deviations, of at least that of the rounding to the ``resolution`` (um) of the readings, infinite for a gross
          outlier.
        - ``attrs``: ``state``, ``order``, ``log_likelihood`` (restricted); ``scatter_undetermined``: 1 where the noise is small against the
          drift between readings, so that ``sigma`` and ``scatter`` could as well be far smaller, 0 elsewhere.

    Raises
    ------
    DriftDataError
        Fewer than two cycles or targets hold readings, no reading has a time, readings repeat exactly (`NoScatterError`), or an argument
        is unknown.
    InterferometryError
        ``deviations`` lack a variable of ``contract.DEVIATIONS``.

    Notes
    -----
    Model and derivation: docs/method/drift-estimation.md. Sources: Harvey (1989), *Forecasting, structural time series models and
    the Kalman filter*; Durbin and Koopman (2012), *Time series analysis by state space methods*, 2nd ed.

    Examples
    --------
    Ten cycles over three targets, 10 s from reading to reading, with a drift of 1 um per hour:

    >>> import numpy as np
    >>> from interferometry.deviations import build_deviations
    >>> seconds = 10.0 * np.arange(60.0).reshape(10, 2, 3)
    >>> seconds[:, 1] = seconds[:, 1, ::-1]
    >>> noise = np.random.default_rng(0).normal(0, 0.02, (10, 2, 3))
    >>> deviation = np.array([[0.0, 1.0, 4.0], [2.0, 3.0, 6.0]]) + seconds / 3600 + noise
    >>> time = np.datetime64("2026-03-09T06:30") + (1e9 * seconds).astype("timedelta64[ns]")
    >>> test = build_deviations(range(1, 11), [1, 2, 3], np.array([0.0, 150.0, 300.0]), deviation, time)
    >>> estimated = estimate_drift(test)
    >>> estimated["profile_relative"].sel(direction="positive").values.round(1).tolist()
    [0.0, 1.0, 4.0]
    >>> estimated["reversal"].values.round(1).tolist()
    [-2.0, -2.0, -2.0]
    """
    deviations = check_dataset(deviations, "deviations")
    # Profiles and covariances are laid out by the index of the approach.
    sides = [str(name) for name in deviations["direction"].values]
    ordered = deviations if sides == [*DIRECTIONS] else deviations.reindex(direction=list(DIRECTIONS))
    joint = fit_joint(ordered, robust=robust, order=order, components=components)
    found = _describe(ordered, joint, state)
    if ordered is deviations:
        return found
    place = [DIRECTIONS.index(name) for name in sides]
    return found.isel(direction=place, other_direction=place)


def flag_outliers(deviations: xr.Dataset, estimated: xr.Dataset) -> xr.Dataset:
    """Set the outlier flag of every reading whose deletion residual exceeds 4.5 standard deviations."""
    with np.errstate(invalid="ignore"):
        beyond = np.abs(estimated["standardised"].values) > OUTLIER_LIMIT
    return set_flag(deviations, OUTLIER, beyond)


def scatter_limits(scatter: Array, freedom: Array, sigma: float) -> Array:
    """Return the 95 % limits (2, ...), um, of standard deviations (...) by the chi-square distribution of their degrees of freedom; of one
    that is nothing beside the uncertainty of the drift, the upper limit is that of the common one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.sqrt(freedom / scipy.special.chdtri(freedom, tail)) for tail in (0.025, 0.975))
    return np.stack([scatter * low, np.where(scatter == 0.0, sigma, scatter) * high])


@dataclass(frozen=True)
class JointFit:
    """The joint estimate as numbers: readings in measuring order without gross outliers, direction and target index of every profile column
    and the column of each reading, names of the drift components, the last of them shapes from the readings over the positions, and the
    fit in um, whose first coefficients are the profile at the start of the drift.
    """

    readings: xr.Dataset
    cells: NDArray[np.int64]
    cell: NDArray[np.int64]
    components: tuple[str, ...]
    shapes: Array
    fit: DriftFit

    def loadings(self, sign: Array, position_mm: Array) -> Array:
        """Share of every drift component in readings (n,) at positions of the test, (n, components)."""
        named = self.components[: len(self.components) - self.shapes.shape[1]]
        return _loadings(self.readings, named, self.shapes, sign, position_mm)


@one_thread
def fit_joint(
    deviations: xr.Dataset, *, robust: bool = True, order: Order | None = None, components: Sequence[str] | None = None
) -> JointFit:
    """Fit profile and drift; `estimate_drift` also describes the result."""
    deviations = check_dataset(deviations, "deviations")
    if order not in (None, 1, 2):
        raise DriftDataError(f"order={order!r} is neither 1 (random walk), 2 (integrated random walk) nor None")
    readings = sort_readings(deviations)
    _check_readings(deviations, readings)
    if robust:
        readings = readings.isel(reading=~_is_gross(readings))
        _check_readings(deviations, readings)
    cells, cell = _cells(deviations, readings)
    if components is not None:
        unknown = sorted(set(components) - set(COMPONENTS))
        if unknown:
            raise DriftDataError(f"components {unknown} are not known; choose from {', '.join(COMPONENTS)}")
        return _fit(readings, cells, cell, tuple(components), robust, order)
    joint = _fit(readings, cells, cell, BASE_COMPONENTS, robust, order)
    # Missing components bias the variances and the order of the others: all are estimated again.
    if missing := _missing_components(joint):
        joint = _fit(readings, cells, cell, (*BASE_COMPONENTS, *missing), robust, order)
    while joint.shapes.shape[1] < MOST_SHAPES and (shape := _missing_shape(joint)) is not None:
        shapes = np.column_stack([joint.shapes, shape])
        joint = _fit(readings, cells, cell, joint.components[: -joint.shapes.shape[1] or None], robust, order, shapes)
    return joint


def _check_readings(deviations: xr.Dataset, readings: xr.Dataset) -> None:
    values = int(np.isfinite(deviations["deviation"].values).sum())
    if values and not readings.sizes["reading"]:
        raise DriftDataError("no reading has a time; the joint estimate needs times, recorded or reconstructed")
    cycles, targets = np.unique(readings["cycle"].values).size, np.unique(readings["target"].values).size
    if cycles < 2 or targets < 2:
        raise DriftDataError(
            f"{cycles} cycles and {targets} targets hold readings; the joint estimate needs two of each"
        )
    if not np.ptp(readings["seconds"].values):
        raise DriftDataError(
            f"deviations: every reading has the time {np.datetime_as_string(readings['time'].values[0], 's')}; the joint estimate "
            "needs the time at which each was measured"
        )
    if not _without_medians(readings).any():
        raise NoScatterError("readings repeat exactly: there is no scatter to weight them by; export more digits")


def _is_gross(readings: xr.Dataset) -> NDArray[np.bool_]:
    """Mark gross outliers, which would mislead even the start of a robust fit: sentinels, beam breaks, readings of other targets."""
    remainder = _without_medians(readings)
    typical = float(np.median(np.abs(remainder))) or float(np.mean(np.abs(remainder)))
    # The median distance of a value from what it is rounded to is a quarter of a digit.
    return np.abs(remainder) > GROSS_LIMIT * max(typical, float(readings["resolution"]) / 4.0)


def _without_medians(readings: xr.Dataset) -> Array:
    """Return readings minus the median of their position and direction, and then minus that of their pass."""
    remainder = readings["deviation"].values.astype(float)
    passes = readings["cycle"].values * 2 + (readings["sign"].values > 0)
    cells = readings["target"].values * 2 + (readings["sign"].values > 0)
    for groups in (cells, passes):
        remainder = remainder - pd.Series(remainder).groupby(groups).transform("median").to_numpy()
    return remainder


def _cells(deviations: xr.Dataset, readings: xr.Dataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (direction, target) indices that hold readings, and the index of each reading's cell among them."""
    direction = np.where(readings["sign"].values > 0, 0, 1)
    target = _index_of(deviations["target"].values, readings["target"].values)
    cells, cell = np.unique(np.column_stack([direction, target]), axis=0, return_inverse=True)
    return cells, np.asarray(cell).ravel()


def _index_of(labels: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of each value among the labels, which may stand in any order."""
    order = np.argsort(labels, kind="stable")
    return np.asarray(order[np.searchsorted(labels, values, sorter=order)])


def _span_mm(readings: xr.Dataset) -> tuple[float, float]:
    return float(readings["position"].min()), float(readings["position"].max())


def _loadings(readings: xr.Dataset, named: Sequence[str], shapes: Array, sign: Array, position_mm: Array) -> Array:
    """Return the share of the named components and of the shapes at positions of the test, (n, components)."""
    own = shapes[np.searchsorted(np.unique(readings["position"].values), position_mm)]
    return np.hstack([component_loadings(sign, position_mm, components=named, span_mm=_span_mm(readings)), own])


def _fit(
    readings: xr.Dataset,
    cells: NDArray[np.int64],
    cell: NDArray[np.int64],
    components: tuple[str, ...],
    robust: bool,
    order: Order | None,
    shapes: Array | None = None,
) -> JointFit:
    position = readings["position"].values
    if shapes is None:
        shapes = np.empty((np.unique(position).size, 0))
    loadings = _loadings(readings, components, shapes, readings["sign"].values.astype(float), position)
    design = scipy.sparse.csr_array((np.ones(cell.size), (np.arange(cell.size), cell)), shape=(cell.size, len(cells)))
    seconds, deviation = readings["seconds"].values, readings["deviation"].values
    fit = estimate(
        seconds,
        loadings,
        deviation,
        design,
        order=order,
        robust=robust,
        settling=True,
        memory=True,
        least_sigma=ROUNDING * float(readings["resolution"]),
    )
    named = (*components, *(f"shape_{k + 1}" for k in range(shapes.shape[1])))
    return JointFit(readings, cells, cell, named, shapes, fit)


def _missing_shape(joint: JointFit) -> Array | None:
    """Return the shape over the positions of a common motion that the components leave, or None."""
    readings = joint.readings
    positions, place = np.unique(readings["position"].values, return_inverse=True)
    cycles, cycle = np.unique(readings["cycle"].values, return_inverse=True)
    cell = cycle.ravel() * positions.size + place.ravel()
    weight = 1.0 / joint.fit.system.variance
    total = np.bincount(cell, weight, minlength=cycles.size * positions.size)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(cell, weight * joint.fit.residual(), minlength=total.size) / total
    known = joint.loadings(np.zeros(positions.size), positions)
    return common_shape(mean.reshape(cycles.size, -1), known[:, (known != 0).any(axis=0)])


def _missing_components(joint: JointFit) -> tuple[str, ...]:
    """Return the further components whose contrast in the noise of each cycle is serially dependent over the cycles."""
    readings = joint.readings
    sign, position = readings["sign"].values.astype(float), readings["position"].values
    weighted_noise = joint.fit.noise()[0] / joint.fit.system.independent
    by_cycle = np.argsort(readings["cycle"].values, kind="stable")
    starts = np.flatnonzero(np.diff(readings["cycle"].values[by_cycle])) + 1
    missing = []
    for component, earlier in (("reversal", BASE_COMPONENTS), ("bend", (*BASE_COMPONENTS, "reversal"))):
        if component == "reversal" and np.unique(sign).size < 2:
            continue
        basis = component_loadings(sign, position, components=(component, *earlier), span_mm=_span_mm(readings))
        contrasts = []
        for rows in np.split(by_cycle, starts):
            contrast, others = basis[rows, 0], basis[rows, 1:]
            contrast = contrast - others @ np.linalg.lstsq(others, contrast, rcond=None)[0]
            square = float(contrast @ contrast)
            if square > 1e-6 * rows.size:
                contrasts.append(float(contrast @ weighted_noise[rows]) / np.sqrt(square))
        if von_neumann_p_value(np.array(contrasts)) < COMPONENT_LEVEL:
            missing.append(component)
    return tuple(missing)


def state_weights(seconds: Array, cycle: NDArray[np.int64], state: str | float) -> Array:
    """Return the weight of each reading in a thermal state."""
    if state == "mean":
        _, index, readings = np.unique(cycle, return_inverse=True, return_counts=True)
        return 1.0 / (readings.size * readings[index.ravel()])
    instant = {"start": seconds[0], "end": seconds[-1]}.get(str(state), state)
    if isinstance(instant, str) or not seconds[0] <= instant <= seconds[-1]:
        raise DriftDataError(
            f"state={state!r} is neither 'mean', 'start', 'end' nor seconds within {seconds[0]:g} .. {seconds[-1]:g}"
        )
    weights = np.zeros(seconds.size)
    after = int(np.searchsorted(seconds, instant))
    before = max(after - 1, 0)
    share = (instant - seconds[before]) / (seconds[after] - seconds[before]) if after > before else 0.0
    weights[after] += share
    weights[before] += 1.0 - share
    return weights


@dataclass(frozen=True)
class _StateDrift:
    """The drift at a thermal state since the start of the test, and its uncertainty; covariances in units of sigma^2.

    drift (components,); per_coefficient (components, p), its derivative by the coefficients; covariance (components, components)
    of its error, the coefficients being known, and with_drift (n, components, components) of that error with the drift's at
    every reading.
    """

    drift: Array
    per_coefficient: Array
    covariance: Array
    with_drift: Array


def _drift_at_state(joint: JointFit, weights: Array) -> _StateDrift:
    fit = joint.fit
    columns = scipy.sparse.hstack([fit.residual()[:, None], fit.design], format="csr")
    average, covariance, with_drift = average_drift(fit.system, weights, columns)
    hours = float(weights @ (fit.system.seconds / 3600.0))
    per_coefficient = hours * _rates(joint, np.eye(fit.coefficients.size)) - average[:, 1:]
    return _StateDrift(average[:, 0] + hours * _rates(joint, fit.coefficients), per_coefficient, covariance, with_drift)


def _rates(joint: JointFit, coefficients: Array) -> Array:
    """Return the rates among coefficients (p, ...) at which the drift starts, um per hour (components, ...); zero of a random walk."""
    rates = np.zeros((len(joint.components), *coefficients.shape[1:]))
    of_drift = coefficients[len(joint.cells) :]
    rates[: len(of_drift)] = of_drift
    return rates


def _drift_from_state(joint: JointFit, at_state: _StateDrift) -> tuple[Array, Array, Array]:
    """Return the drift from the thermal state (n, components) and its covariance (n, components, components) in um and um2, and the
    variance of the smoothing errors (n,) by the coefficients.
    """
    fit, smoothed = joint.fit, joint.fit.smoothed
    hours = fit.system.seconds[:, None] / 3600.0
    drift = smoothed.levels[:, :, 0] + hours * _rates(joint, fit.coefficients) - at_state.drift
    joined = (
        smoothed.level_covariance + at_state.covariance - at_state.with_drift - at_state.with_drift.transpose(0, 2, 1)
    )
    covariance, by_coefficients = fit.sigma**2 * joined, np.zeros(hours.size)
    for part, share in fit.shares():
        moved = hours[:, :, None] * _rates(joint, part) - share.levels - at_state.per_coefficient @ part
        covariance += np.einsum("nip,njp->nij", moved, moved)
        by_coefficients += (share.u**2).sum(axis=1)
    return drift, covariance, by_coefficients


def _describe(deviations: xr.Dataset, joint: JointFit, state: str | float) -> xr.Dataset:
    """Return the joint estimate as a Dataset; see `estimate_drift`."""
    fit, grid = joint.fit, _Grid(deviations, joint)
    cycle = joint.readings["cycle"].values
    at_state = _drift_at_state(joint, state_weights(fit.system.seconds, cycle, state))
    drift, covariance, by_coefficients = _drift_from_state(joint, at_state)
    in_first = cycle == cycle[0]
    since_first = _drift_from_state(joint, _drift_at_state(joint, in_first / np.count_nonzero(in_first)))
    resolution_um = float(joint.readings["resolution"])
    if fit.system.memory is None:
        of_noise = fit.deletion_residuals(ROUNDING * resolution_um)
        square, worth = _deletion_variance(joint, by_coefficients)
    else:
        of_noise, square, worth = _whole_noise(joint, ROUNDING * resolution_um)
    scatter, freedom = _scatter(joint, of_noise, square, worth)
    standardised = grid.per_reading(of_noise)
    standardised[grid.is_left_out(deviations)] = np.inf
    noise, _ = fit.noise()
    excess = _excess_variance(scatter, freedom, joint) + _memory_variance(grid.per_reading(noise), joint)
    # A shape comes from the readings of its target, and is as uncertain as they are.
    target, shapes = joint.cells[joint.cell, 1], drift[:, drift.shape[1] - joint.shapes.shape[1] :]
    shape_variance = [fit.sigma**2 / np.bincount(target, square)[target] for square in shapes.T**2]
    result = xr.Dataset(
        {
            **_profile_variables(grid, joint, deviations, at_state, excess),
            **_scatter_variables(grid, joint, scatter, freedom),
            **_drift_variables(
                grid, joint, drift, covariance, shape_variance, ("drift", "drift from the stated state")
            ),
            **_drift_variables(
                grid, joint, *since_first[:2], shape_variance, ("drift_since_first", "drift since the first cycle")
            ),
            "noise": _um(DIMS, grid.per_reading(noise), "random part of the reading"),
            "standardised": (DIMS, standardised, {"units": "1"}),
            "sigma": _um((), fit.sigma),
            "resolution": _um((), resolution_um, "step of the readings as recorded"),
            **_component_variables(grid, joint, drift, covariance),
        },
        coords={**{name: deviations[name].values for name in DIMS}, "component": list(joint.components)},
    )
    result.attrs.update(
        state=str(state),
        order=int(fit.system.order),
        log_likelihood=fit.log_likelihood,
        scatter_undetermined=int(fit.noise_hidden),
    )
    return result


def _drift_variables(
    grid: _Grid,
    joint: JointFit,
    drift: Array,
    covariance: Array,
    shape_variance: Sequence[Array],
    names: tuple[str, str],
) -> Variables:
    """Return the drift of every reading from one thermal state, by its name and in words, with its uncertainty."""
    loadings, (name, words) = joint.fit.system.loadings, names
    variance = np.einsum("kc,kce,ke->k", loadings, covariance, loadings)
    for size, of_shape in zip(drift.T[drift.shape[1] - len(shape_variance) :], shape_variance, strict=True):
        variance += size**2 * of_shape
    return {
        name: _um(DIMS, grid.per_reading(np.einsum("kc,kc->k", loadings, drift)), words),
        f"{name}_u": _um(DIMS, grid.per_reading(np.sqrt(np.maximum(variance, 0.0)))),
    }


def _profile_variables(
    grid: _Grid, joint: JointFit, deviations: xr.Dataset, at_state: _StateDrift, excess_variance: Array
) -> Variables:
    fit, cells = joint.fit, len(joint.cells)
    sign = np.where(joint.cells[:, 0] == 0, 1.0, -1.0)
    position = deviations["position"].values[joint.cells[:, 1]]
    loadings = joint.loadings(sign, position)
    to_profile = np.eye(cells, fit.coefficients.size) + loadings @ at_state.per_coefficient
    profile = fit.coefficients[:cells] + loadings @ at_state.drift
    covariance = to_profile @ fit.covariance @ to_profile.T
    covariance += fit.sigma**2 * loadings @ at_state.covariance @ loadings.T + np.diag(excess_variance)
    first_cell = {direction: cell for cell, (direction, _) in reversed(list(enumerate(joint.cells)))}
    contrast = np.eye(cells) - np.eye(cells)[[first_cell[direction] for direction in joint.cells[:, 0]]]
    relative_u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", contrast, covariance, contrast), 0.0))
    dims = DIMS[1:]
    reversal, reversal_u = _reversal(joint.cells, profile, covariance, grid.targets)
    return {
        "profile": _um(dims, grid.per_cell(profile)),
        "profile_u": _um(dims, grid.per_cell(np.sqrt(np.diag(covariance)))),
        "profile_relative": _um(dims, grid.per_cell(contrast @ profile)),
        "profile_relative_u": _um(dims, grid.per_cell(relative_u)),
        "covariance": ((*dims, "other_direction", "other_target"), grid.per_pair(covariance), {"units": "um2"}),
        "reversal": _um(("target",), reversal, "positive minus negative direction"),
        "reversal_u": _um(("target",), reversal_u),
    }


def _reversal(cells: NDArray[np.int64], profile: Array, covariance: Array, targets: int) -> tuple[Array, Array]:
    """Return the reversal error B_i of each target and its standard uncertainty, NaN where a direction is missing."""
    index = {(int(direction), int(target)): cell for cell, (direction, target) in enumerate(cells)}
    both = [target for target in range(targets) if (0, target) in index and (1, target) in index]
    up, down = ([index[direction, target] for target in both] for direction in (0, 1))
    reversal, variance = np.full((2, targets), np.nan)
    reversal[both] = profile[up] - profile[down]
    variance[both] = covariance[up, up] + covariance[down, down] - 2 * covariance[up, down]
    return reversal, np.sqrt(np.maximum(variance, 0.0))


def _deletion_variance(joint: JointFit, by_coefficients: Array) -> tuple[Array, Array]:
    """Return squares of the noise of every reading, um2, from what all others predict, and their degrees of freedom."""
    fit, smoothed = joint.fit, joint.fit.smoothed
    D = smoothed.D
    expected = D - by_coefficients / fit.sigma**2
    with np.errstate(divide="ignore", invalid="ignore"):
        remaining = expected / D
        square = (smoothed.u[:, 0] / D) ** 2 / remaining - fit.sigma**2 * (1.0 / D - fit.system.independent)
    return square, np.where(remaining > 1e-6, remaining * np.minimum(D * fit.system.variance, 1.0), 0.0)


def _whole_noise(joint: JointFit, least_sigma: float) -> tuple[Array, Array, Array]:
    """Return the noise of every reading in standard deviations of an ordinary one, and its squares, um2, with their degrees of freedom: all
    that the drift leaves. What neighbours predict where the noise has a memory depends on their scatter as well.
    """
    fit = joint.fit
    noise, unknown = fit.whole_noise()
    # The profile takes the worth of one reading from every cell.
    left = 1.0 - 1.0 / np.bincount(joint.cell)[joint.cell]
    known = np.clip(1.0 - unknown, 1e-6, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        standardised = noise / (max(fit.sigma, least_sigma) * np.sqrt(known * left))
        square = noise**2 / left + fit.sigma**2 * unknown
    return standardised, square, left * known


def _scatter(joint: JointFit, standardised: Array, square: Array, worth: Array) -> tuple[Array, Array]:
    """Return the random standard deviation of each cell (um) and its degrees of freedom from the squares of its readings' noise."""
    cells = len(joint.cells)
    # Median absolute deviation from zero, the expectation of a residual, as a normal standard deviation.
    medians = [np.median(np.abs(standardised[joint.cell == cell])) for cell in range(cells)]
    typical = np.array(medians) / scipy.special.ndtri(0.75)
    kept = (np.abs(standardised) <= OUTLIER_LIMIT * np.maximum(typical, 1.0)[joint.cell]) & (worth > 0.0)
    count = np.bincount(joint.cell[kept], minlength=cells)
    squares = np.bincount(joint.cell[kept], square[kept], minlength=cells)
    freedom = np.bincount(joint.cell[kept], worth[kept], minlength=cells)
    usable = freedom > 0.5
    variance = np.where(usable, np.maximum(squares, 0.0) / np.maximum(count, 1), np.nan)
    return np.sqrt(variance), np.where(usable, freedom, 0.0)


def _excess_variance(scatter: Array, freedom: Array, joint: JointFit) -> Array:
    """Return what cells that scatter clearly more than the common sigma add to the variance of their profile value, um2."""
    ratio = np.nan_to_num(scatter / joint.fit.sigma) ** 2
    clear = scipy.special.chdtrc(np.maximum(freedom, 1.0), ratio * freedom) < EXCESS_LEVEL
    readings = np.bincount(joint.cell, minlength=len(joint.cells))
    return np.where(clear, (ratio - 1.0) * joint.fit.sigma**2 / readings, 0.0)


def _memory_variance(noise: Array, joint: JointFit) -> Array:
    """Return what noise with memory over the cycles adds to the variance of each profile value, um2; noise (cycle, direction, target)."""
    series = noise.reshape(noise.shape[0], -1).T
    series = series[np.isfinite(series).any(axis=1)]
    centred = np.nan_to_num(series - np.nanmean(series, axis=1, keepdims=True))
    readings = np.bincount(joint.cell, minlength=len(joint.cells))
    # Over many cycles the memory of each series is known without the bias that its own mean gives; over few it is not known at all.
    long_run = max(1.0, memory_of_each(centred).long_run, typical_memory(centred).long_run)
    return np.asarray((long_run - 1.0) * joint.fit.sigma**2 / readings)


def _scatter_variables(grid: _Grid, joint: JointFit, scatter: Array, freedom: Array) -> Variables:
    target, targets = joint.cells[:, 1], grid.targets
    pooled_freedom = np.bincount(target, freedom, minlength=targets)
    pooled = np.sqrt(
        np.bincount(target, freedom * np.nan_to_num(scatter) ** 2, minlength=targets)
        / np.where(pooled_freedom, pooled_freedom, np.nan)
    )
    # Where the drift's own uncertainty is all that a cell shows, its scatter is not known to be nothing: the common one replaces it.
    typical = np.where(scatter == 0.0, joint.fit.sigma, scatter)
    scatter_u = typical / np.sqrt(2 * np.maximum(freedom, 1.0))
    dims = DIMS[1:]
    return {
        "scatter": _um(dims, grid.per_cell(scatter), "random standard deviation"),
        "scatter_u": _um(dims, grid.per_cell(scatter_u)),
        "scatter_freedom": (dims, grid.per_cell(freedom), {"units": "1"}),
        "scatter_position": _um(("target",), pooled, "scatter, both directions together"),
    }


def _component_variables(grid: _Grid, joint: JointFit, drift: Array, covariance: Array) -> Variables:
    component_u = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    variables: Variables = {
        "drift_size": _um(("component",), drift.std(axis=0)),
        "drift_rate": _um(("component",), joint.fit.drift_rate, "random change within an hour"),
    }
    sign = np.where(joint.cells[:, 0] == 0, 1.0, -1.0)
    position = np.full(len(joint.cells), np.nan)
    position[joint.cell] = joint.readings["position"].values
    shares = [grid.per_cell(share) for share in joint.loadings(sign, position).T]
    variables["drift_share"] = (("component", *DIMS[1:]), np.array(shares), {"units": "1"})
    for column, name in enumerate(joint.components):
        variables[f"drift_{name}"] = _um(DIMS, grid.per_reading(drift[:, column]))
        variables[f"drift_{name}_u"] = _um(DIMS, grid.per_reading(component_u[:, column]))
    return variables


class _Grid:
    """Places values per cell or per reading into arrays with the dims of the deviations."""

    def __init__(self, deviations: xr.Dataset, joint: JointFit) -> None:
        self._shape = deviations["deviation"].shape
        self._direction, self._target = joint.cells[:, 0], joint.cells[:, 1]
        self._cycle = _index_of(deviations["cycle"].values, joint.readings["cycle"].values)
        self._cell = joint.cell

    @property
    def targets(self) -> int:
        return int(self._shape[2])

    def per_cell(self, values: Array) -> Array:
        filled = np.full(self._shape[1:], np.nan)
        filled[self._direction, self._target] = values
        return filled

    def per_reading(self, values: Array) -> Array:
        filled = np.full(self._shape, np.nan)
        filled[self._cycle, self._direction[self._cell], self._target[self._cell]] = values
        return filled

    def per_pair(self, matrix: Array) -> Array:
        filled = np.full((*self._shape[1:], *self._shape[1:]), np.nan)
        d, t = self._direction, self._target
        filled[d[:, None], t[:, None], d[None, :], t[None, :]] = matrix
        return filled

    def is_left_out(self, deviations: xr.Dataset) -> NDArray[np.bool_]:
        """Mark readings that were taken but did not enter the fit."""
        taken = np.isfinite(deviations["deviation"].values) & ~np.isnat(deviations["time"].values)
        taken[self._cycle, self._direction[self._cell], self._target[self._cell]] = False
        return taken
