"""The joint estimate: profile of both directions and drift in real time, from every reading at its own time.

Profile and drift are estimated together by generalised least squares; the drift's variances by restricted
maximum likelihood; a reading far from all others loses its weight. With complete readings the profile equals the plain
mean and the chain of neighbour differences; where readings are missing, passes unequal or outliers present it is better
than both, and it knows its own covariance.

The fit behind the joint estimate: which readings, which profile columns, which drift components.

Each reading is a profile value of its direction and target, plus a drift that wanders in time (a shift of all targets
and a stretch that grows with position; where the readings ask for it, also a drift of the reversal and a bend), plus
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from interferometry._typing import Array
from interferometry.deviations import DIMS, OUTLIER, set_flag, sort_readings
from interferometry.drift.gls import DriftFit, average_drift, estimate
from interferometry.drift.state_space import Order
from interferometry.errors import InterferometryError

__all__ = [
    "DriftDataError",
    "describe",
    "estimate_drift",
    "fit_joint",
    "flag_outliers",
    "state_weights",
    "track_reversal",
]

#: Deletion residual, in standard deviations, from which a reading is flagged as an outlier: among 10,000 normal
#: readings the chance of one is 0.07.
OUTLIER_LIMIT = 4.5
#: A cell's own scatter replaces the common one in its uncertainty where it exceeds that at this level.
EXCESS_LEVEL = 1e-3


def estimate_drift(
    deviations: xr.Dataset,
    *,
    state: str | float = "mean",
    robust: bool = True,
    order: Order | None = None,
    components: Sequence[str] | None = None,
) -> xr.Dataset:
    """Estimate profile and drift together.

    Parameters
    ----------
    deviations : xarray.Dataset
        Keeps ``contract.DEVIATIONS``; readings may be missing, directions unequal.
    state : {"mean", "start", "end"} or float
        Thermal state of the profile: the average over the measured cycles, the first or last reading, or seconds since
        the first reading.
    robust : bool
        Take weight from readings far from all others.
    order : {1, 2}, optional
        Random walk or integrated random walk; left out: chosen by restricted likelihood.
    components : sequence of str, optional
        Names out of COMPONENTS; left out: shift and stretch, and each other one that the readings ask for.

    Returns
    -------
    xarray.Dataset
        In um: profile (direction, target), its covariance (direction, target, other_direction, other_target; um2) and
        profile_u; profile_relative to the first target in the same direction, with its u; reversal (target), with its u;
        scatter (direction, target), the random standard deviation of each cell, with its u, and scatter_position
        (target), both directions together; drift from the stated thermal state at every reading (cycle, direction,
        target), with its u, and drift_<component> with its u: profile plus drift is the expected reading; noise, the estimated
        random part of each reading; standardised, each reading against its prediction from all others in standard
        deviations (infinite where it was too wild to enter the fit); sigma; drift_size (component), the standard
        deviation of each component over the test, and drift_rate (component), of its increments in an hour. ``attrs["state"]``, ``order``.

    Raises
    ------
    DriftDataError
        Fewer than two cycles or targets, or no times.
    """
    joint = fit_joint(deviations, robust=robust, order=order, components=components)
    return describe(deviations, joint, state=state)


def describe(deviations: xr.Dataset, joint: JointFit, *, state: str | float = "mean") -> xr.Dataset:
    """Return the joint estimate as a Dataset; see `estimate_drift`."""
    fit = joint.fit
    columns = np.column_stack([fit.response, fit.design])
    levels, level_covariance, u, d = fit.system.smooth(columns)
    total, through = _with_start_rates(levels, fit.system.seconds / 3600.0, joint)
    weights = state_weights(fit.system.seconds, joint.readings["cycle"].values, state)
    at_state = _drift_at_state(joint, columns, weights)
    drift = total - at_state.drift
    dependence = through - at_state.through
    joined = level_covariance + at_state.covariance - at_state.with_drift - at_state.with_drift.transpose(0, 2, 1)
    covariance = fit.sigma**2 * joined + dependence @ fit.covariance @ dependence.transpose(0, 2, 1)
    loadings = fit.system.loadings
    at_position = np.einsum("kc,kc->k", loadings, drift)
    at_position_u = np.sqrt(np.maximum(np.einsum("kc,kce,ke->k", loadings, covariance, loadings), 0.0))
    component_u = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    noise = fit.system.variance * (u[:, 0] - u[:, 1:] @ fit.coefficients)
    deletion = fit.deletion_residuals()
    scatter, freedom = _scatter(joint, u, d, deletion)
    result = _describe_profile(deviations, joint, at_state, _excess_variance(scatter, freedom, joint))
    grid = _Grid(deviations, joint)
    standardised = grid.per_reading(deletion)
    standardised[grid.is_left_out(deviations)] = np.inf
    target = joint.cells[:, 1]
    targets = deviations.sizes["target"]
    pooled_freedom = np.bincount(target, freedom, minlength=targets)
    pooled = np.sqrt(
        np.bincount(target, freedom * np.nan_to_num(scatter) ** 2, minlength=targets)
        / np.where(pooled_freedom, pooled_freedom, np.nan)
    )
    result = result.assign(
        {
            "scatter": (DIMS[1:], grid.per_cell(scatter), {"units": "um", "long_name": "random standard deviation"}),
            "scatter_u": (DIMS[1:], grid.per_cell(scatter / np.sqrt(2 * np.maximum(freedom, 1.0))), {"units": "um"}),
            "scatter_freedom": (DIMS[1:], grid.per_cell(freedom), {"units": "1"}),
            "scatter_position": (
                ("target",),
                pooled,
                {"units": "um", "long_name": "scatter, both directions together"},
            ),
            "drift": (DIMS, grid.per_reading(at_position), {"units": "um", "long_name": "drift from the stated state"}),
            "drift_u": (DIMS, grid.per_reading(at_position_u), {"units": "um"}),
            "noise": (DIMS, grid.per_reading(noise), {"units": "um", "long_name": "random part of the reading"}),
            "standardised": (DIMS, standardised, {"units": "1"}),
            "sigma": ((), fit.sigma, {"units": "um"}),
            "drift_size": (("component",), drift.std(axis=0), {"units": "um"}),
            "drift_rate": (
                ("component",),
                fit.drift_rate,
                {"units": "um", "long_name": "random change within an hour"},
            ),
            **{
                f"drift_{name}{suffix}": (DIMS, grid.per_reading(values[:, at]), {"units": "um"})
                for at, name in enumerate(joint.components)
                for suffix, values in (("", drift), ("_u", component_u))
            },
        }
    )
    result = result.assign_coords(component=list(joint.components))
    result.attrs.update(state=str(state), order=int(fit.system.order), log_likelihood=fit.log_likelihood)
    return result


def track_reversal(deviations: xr.Dataset, estimated: xr.Dataset) -> xr.Dataset:
    """Return the reversal B_i in every cycle: as read, and smoothed where the readings ask for a change.

    Parameters
    ----------
    deviations : xarray.Dataset
    estimated : xarray.Dataset
        What `estimate_drift` returns for them.

    Returns
    -------
    xarray.Dataset
        Per cycle and target, in um: as_read, the difference of the two directions' readings freed of the drift between
        them, with its u; reversal, the joint estimate, with its u (profile and its change taken as independent). It is
        constant where no drift of the reversal was found.
    """
    own = "drift_reversal" in estimated
    change = (
        estimated["drift_reversal"].mean("direction") if own else xr.zeros_like(estimated["drift"].mean("direction"))
    )
    change = change.mean("target") + xr.zeros_like(estimated["reversal"])
    change_u = estimated["drift_reversal_u"].mean(("direction", "target")) if own else 0.0
    common = estimated["drift"] - (_signs(estimated) * estimated["drift_reversal"] / 2 if own else 0.0)
    free = (deviations["deviation"] - common).transpose("cycle", "direction", "target")
    as_read = free.sel(direction="positive", drop=True) - free.sel(direction="negative", drop=True)
    scatter = estimated["scatter"]
    as_read_u = ((scatter**2).sum("direction", skipna=False) ** 0.5).broadcast_like(as_read)
    smoothed = (estimated["reversal"] + change).transpose("cycle", "target")
    smoothed_u = ((estimated["reversal_u"] ** 2 + change_u**2) ** 0.5).broadcast_like(smoothed)
    named = {"as_read": as_read, "as_read_u": as_read_u, "reversal": smoothed, "reversal_u": smoothed_u}
    return xr.Dataset({name: value.transpose("cycle", "target") for name, value in named.items()}).map(
        lambda value: value.assign_attrs(units="um")
    )


def _signs(estimated: xr.Dataset) -> xr.DataArray:
    return xr.where(estimated["direction"] == "positive", 1.0, -1.0)


def flag_outliers(deviations: xr.Dataset, estimated: xr.Dataset) -> xr.Dataset:
    """Return the deviations with the outlier flag set where a reading lies beyond OUTLIER_LIMIT of the joint estimate."""
    with np.errstate(invalid="ignore"):
        beyond = np.abs(estimated["standardised"].values) > OUTLIER_LIMIT
    return set_flag(deviations, OUTLIER, beyond)


def state_weights(seconds: Array, cycle: NDArray[np.int64], state: str | float) -> Array:
    """Return the weights of the readings (n,) in a thermal state: they sum to one.

    In the mean state every cycle counts alike, whatever it lacks: with complete readings it is their plain mean.

    Raises
    ------
    DriftDataError
        The state has an unknown name or lies outside the test.
    """
    if state == "mean":
        _, own, readings = np.unique(cycle, return_inverse=True, return_counts=True)
        return 1.0 / (readings.size * readings[own.ravel()])
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
    """The drift at a thermal state since the start of the test, and how uncertain it is.

    drift (components,); through (components, p), its dependence on the coefficients; covariance of what is left
    (components, components) and of that with the drift at every reading (n, components, components), in units of sigma^2.
    """

    drift: Array
    through: Array
    covariance: Array
    with_drift: Array


def _drift_at_state(joint: JointFit, columns: Array, weights: Array) -> _StateDrift:
    system = joint.fit.system
    average, covariance, with_drift = average_drift(system, weights, columns)
    hours = np.array([weights @ (system.seconds / 3600.0)])
    drift, through = _with_start_rates(average[None], hours, joint)
    return _StateDrift(drift[0], through[0], covariance, with_drift)


def _with_start_rates(levels: Array, hours: Array, joint: JointFit) -> tuple[Array, Array]:
    """Return the whole drift (n, components) and how it depends on the coefficients (n, components, p).

    An integrated walk starts with a rate that is a coefficient: it belongs to the drift, not to the profile.
    """
    through = -levels[:, :, 1:]
    first = len(joint.cells)
    for component in range(joint.fit.coefficients.size - first):
        through[:, component, first + component] += hours
    return levels[:, :, 0] + through @ joint.fit.coefficients, through


def _describe_profile(
    deviations: xr.Dataset, joint: JointFit, at_state: _StateDrift, excess_variance: Array
) -> xr.Dataset:
    fit = joint.fit
    sign = np.where(joint.cells[:, 0] == 0, 1.0, -1.0)
    position = deviations["position"].values[joint.cells[:, 1]]
    loadings = loadings_of(sign, position, joint.components, span_mm(joint.readings))
    cells = len(joint.cells)
    to_profile = np.eye(cells, fit.coefficients.size) + loadings @ at_state.through
    profile = fit.coefficients[:cells] + loadings @ at_state.drift
    covariance = to_profile @ fit.covariance @ to_profile.T
    covariance += fit.sigma**2 * loadings @ at_state.covariance @ loadings.T + np.diag(excess_variance)
    grid = _Grid(deviations, joint)
    first = {direction: at for at, (direction, target) in reversed(list(enumerate(joint.cells)))}
    reference = np.array([first[direction] for direction in joint.cells[:, 0]])
    contrast = np.eye(cells) - np.eye(cells)[reference]
    relative_u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", contrast, covariance, contrast), 0.0))
    both = _pairs(joint.cells)
    targets = deviations.sizes["target"]
    reversal, reversal_u = np.full(targets, np.nan), np.full(targets, np.nan)
    for target, (up, down) in both.items():
        reversal[target] = profile[up] - profile[down]
        variance = covariance[up, up] + covariance[down, down] - 2 * covariance[up, down]
        reversal_u[target] = np.sqrt(max(variance, 0.0))
    dims = DIMS[1:]
    return xr.Dataset(
        {
            "profile": (dims, grid.per_cell(profile), {"units": "um"}),
            "profile_u": (dims, grid.per_cell(np.sqrt(np.diag(covariance))), {"units": "um"}),
            "profile_relative": (dims, grid.per_cell(contrast @ profile), {"units": "um"}),
            "profile_relative_u": (dims, grid.per_cell(relative_u), {"units": "um"}),
            "covariance": ((*dims, "other_direction", "other_target"), grid.per_pair(covariance), {"units": "um2"}),
            "reversal": (("target",), reversal, {"units": "um", "long_name": "positive minus negative direction"}),
            "reversal_u": (("target",), reversal_u, {"units": "um"}),
        },
        coords={name: deviations[name].values for name in DIMS},
    )


def _pairs(cells: NDArray[np.int64]) -> dict[int, tuple[int, int]]:
    """Return the columns of the positive and negative direction for each target that has both."""
    at = {(int(direction), int(target)): k for k, (direction, target) in enumerate(cells)}
    return {target: (at[0, target], at[1, target]) for direction, target in at if direction == 0 and (1, target) in at}


def _scatter(joint: JointFit, u: Array, d: Array, standardised: Array) -> tuple[Array, Array]:
    """Return the random standard deviation of each cell and its degrees of freedom.

    A reading's deviation from its prediction by all others has the variance of the reading plus that of the prediction;
    the latter is taken off, and what the estimated coefficients took is put back. Readings beyond OUTLIER_LIMIT of their
    own cell do not count; wide scatter of a whole cell does.
    """
    fit = joint.fit
    cells = len(joint.cells)
    unit = fit.covariance / fit.sigma**2
    expected = d - np.einsum("kp,pq,kq->k", u[:, 1:], unit, u[:, 1:], optimize=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = expected / d
        from_others = (u[:, 0] - u[:, 1:] @ fit.coefficients) / d
        square = from_others**2 / left - fit.sigma**2 * (1.0 / d - fit.system.variance)
    usual = np.array([1.4826 * np.median(np.abs(standardised[joint.cell == cell])) for cell in range(cells)])
    kept = (np.abs(standardised) <= OUTLIER_LIMIT * np.maximum(usual, 1.0)[joint.cell]) & (left > 1e-6)
    count = np.bincount(joint.cell[kept], minlength=cells)
    squares = np.bincount(joint.cell[kept], square[kept], minlength=cells)
    freedom = np.bincount(
        joint.cell[kept], left[kept] * np.minimum(d * fit.system.variance, 1.0)[kept], minlength=cells
    )
    usable = freedom > 0.5
    variance = np.where(usable, np.maximum(squares, 0.0) / np.maximum(count, 1), np.nan)
    return np.sqrt(variance), np.where(usable, freedom, 0.0)


def _excess_variance(scatter: Array, freedom: Array, joint: JointFit) -> Array:
    """Return what cells that scatter clearly more than the common sigma add to the variance of their profile value."""
    ratio = np.nan_to_num(scatter / joint.fit.sigma) ** 2
    clear = stats.chi2.sf(ratio * freedom, np.maximum(freedom, 1.0)) < EXCESS_LEVEL
    readings = np.bincount(joint.cell, minlength=len(joint.cells))
    return np.where(clear, (ratio - 1.0) * joint.fit.sigma**2 / readings, 0.0)


class _Grid:
    """Places values per cell or per reading into arrays with the dims of the deviations."""

    def __init__(self, deviations: xr.Dataset, joint: JointFit) -> None:
        self._shape = deviations["deviation"].shape
        self._direction, self._target = joint.cells[:, 0], joint.cells[:, 1]
        self._cycle = index_of(deviations["cycle"].values, joint.readings["cycle"].values)
        self._cell = joint.cell

    def per_cell(self, values: Array) -> Array:
        filled = np.full(self._shape[1:], np.nan)
        filled[self._direction, self._target] = values
        return filled

    def per_reading(self, values: Array) -> Array:
        filled = np.full(self._shape, np.nan)
        filled[self._cycle, self._direction[self._cell], self._target[self._cell]] = values
        return filled

    def is_left_out(self, deviations: xr.Dataset) -> NDArray[np.bool_]:
        """Mark readings that were taken but did not enter the fit."""
        held = np.isfinite(deviations["deviation"].values) & ~np.isnat(deviations["time"].values)
        held[self._cycle, self._direction[self._cell], self._target[self._cell]] = False
        return held

    def per_pair(self, matrix: Array) -> Array:
        filled = np.full((*self._shape[1:], *self._shape[1:]), np.nan)
        d, t = self._direction, self._target
        filled[d[:, None], t[:, None], d[None, :], t[None, :]] = matrix
        return filled


#: Share of a drift component in a reading, by its sign of approach (+1, -1) and its position (0 first target, 1 last).
COMPONENTS = {
    "shift": lambda sign, place: np.ones(place.size),
    "stretch": lambda sign, place: place,
    "reversal": lambda sign, place: sign / 2.0,
    "bend": lambda sign, place: 4.0 * place * (1.0 - place),
}
BASE_COMPONENTS = ("shift", "stretch")
#: A further component is added where its contrast over the cycles is serially dependent at this level.
COMPONENT_LEVEL = 1e-3

#: Median absolute deviations from which a reading is left out before the fit.
GROSS_LIMIT = 50.0


class DriftDataError(InterferometryError):
    """The deviations cannot be fitted jointly; the message says what is missing."""


@dataclass(frozen=True)
class JointFit:
    """The joint estimate as numbers: readings in measuring order, and the fit.

    Attributes
    ----------
    readings : xarray.Dataset
        What `sort_readings` returns.
    cells : (cell, 2) ndarray of int
        Direction and target index of each profile column of the design.
    cell : (reading,) ndarray of int
        Profile column of each reading.
    components : tuple of str
        Names of the drift components, in the order of the loadings.
    fit : DriftFit
    """

    readings: xr.Dataset
    cells: NDArray[np.int64]
    cell: NDArray[np.int64]
    components: tuple[str, ...]
    fit: DriftFit


def fit_joint(
    deviations: xr.Dataset,
    *,
    robust: bool = True,
    order: Order | None = None,
    components: Sequence[str] | None = None,
) -> JointFit:
    """Fit profile and drift; see `drift.estimate_drift`, which also describes the result."""
    readings = sort_readings(deviations)
    _check_readings(deviations, readings)
    if robust:
        readings = readings.isel(reading=~is_gross(readings))
        _check_readings(deviations, readings)
    cells, cell = _cells(deviations, readings)
    if components is not None:
        unknown = sorted(set(components) - set(COMPONENTS))
        if unknown:
            raise DriftDataError(f"components {unknown} are not known; choose from {', '.join(COMPONENTS)}")
        return _fit(readings, cells, cell, tuple(components), robust, order)
    joint = _fit(readings, cells, cell, BASE_COMPONENTS, robust, order)
    wanted = _asked_for(joint)
    if not wanted:
        return joint
    # What was missing has bent the others' variances and order; they are searched anew.
    return _fit(readings, cells, cell, (*BASE_COMPONENTS, *wanted), robust, order)


def _check_readings(deviations: xr.Dataset, readings: xr.Dataset) -> None:
    held = int(np.isfinite(deviations["deviation"].values).sum())
    if held and not readings.sizes["reading"]:
        raise DriftDataError("no reading has a time; the joint estimate needs times, recorded or reconstructed")
    cycles, targets = np.unique(readings["cycle"].values).size, np.unique(readings["target"].values).size
    if cycles < 2 or targets < 2:
        raise DriftDataError(
            f"{cycles} cycles and {targets} targets hold readings; the joint estimate needs two of each"
        )
    if not _without_medians(readings).any():
        raise DriftDataError("readings repeat exactly: there is no random part to weigh them by; export more digits")


def is_gross(readings: xr.Dataset) -> NDArray[np.bool_]:
    """Mark readings so wild that they would mislead even a robust fit's start: sentinels, beam breaks, other targets.

    A reading is compared with the median of its position and direction, and then with the median of its pass; what is
    left, drift included, scatters by some median absolute deviation, and GROSS_LIMIT of them are beyond any drift.
    """
    left = _without_medians(readings)
    usual = float(np.median(np.abs(left))) or float(np.mean(np.abs(left)))
    return np.abs(left) > GROSS_LIMIT * usual


def _without_medians(readings: xr.Dataset) -> Array:
    """Return readings less the median of their position and direction, and then less that of their pass."""
    left = readings["deviation"].values.astype(float)
    passes = readings["cycle"].values * 2 + (readings["sign"].values > 0)
    cells = readings["target"].values * 2 + (readings["sign"].values > 0)
    for groups in (cells, passes):
        left = left - _group_medians(groups, left)
    return left


def _group_medians(groups: NDArray[np.int64], values: Array) -> Array:
    """Return for each value the median of its group, (n,)."""
    _, own, count = np.unique(groups, return_inverse=True, return_counts=True)
    ordered = values[np.lexsort((values, own))]
    first = np.cumsum(count) - count
    medians = 0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2])
    return np.asarray(medians[own])


def _cells(deviations: xr.Dataset, readings: xr.Dataset) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (direction, target) indices that hold readings, and each reading's place among them."""
    direction = np.where(readings["sign"].values > 0, 0, 1)
    target = index_of(deviations["target"].values, readings["target"].values)
    cells, cell = np.unique(np.column_stack([direction, target]), axis=0, return_inverse=True)
    return cells, np.asarray(cell).ravel()


def index_of(labels: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where each value stands among the labels, in whatever order these are."""
    order = np.argsort(labels, kind="stable")
    return np.asarray(order[np.searchsorted(labels, values, sorter=order)])


def loadings_of(sign: Array, position_mm: Array, components: Sequence[str], span_mm: tuple[float, float]) -> Array:
    """Return how each drift component enters readings of a sign at a position, (n, components)."""
    place = (np.asarray(position_mm, float) - span_mm[0]) / (span_mm[1] - span_mm[0])
    return np.column_stack([COMPONENTS[name](np.asarray(sign, float), place) for name in components])


def span_mm(readings: xr.Dataset) -> tuple[float, float]:
    """Return the smallest and largest position of the readings in mm."""
    return float(readings["position"].min()), float(readings["position"].max())


def _fit(
    readings: xr.Dataset,
    cells: NDArray[np.int64],
    cell: NDArray[np.int64],
    components: tuple[str, ...],
    robust: bool,
    order: Order | None,
) -> JointFit:
    sign = readings["sign"].values.astype(float)
    loadings = loadings_of(sign, readings["position"].values, components, span_mm(readings))
    design = np.zeros((cell.size, len(cells)))
    design[np.arange(cell.size), cell] = 1.0
    fit = estimate(
        readings["seconds"].values,
        loadings,
        readings["deviation"].values,
        design,
        order=order,
        robust=robust,
        settling=True,
    )
    return JointFit(readings, cells, cell, components, fit)


def _asked_for(joint: JointFit) -> tuple[str, ...]:
    """Return the further components that the noise holds: their contrast per cycle changes slowly by the von Neumann ratio."""
    readings = joint.readings
    sign, position = readings["sign"].values.astype(float), readings["position"].values
    noise = joint.fit.noise()[0] / joint.fit.system.variance
    by_cycle = np.argsort(readings["cycle"].values, kind="stable")
    starts = np.flatnonzero(np.diff(readings["cycle"].values[by_cycle])) + 1
    found = []
    for component, beside in (("reversal", BASE_COMPONENTS), ("bend", (*BASE_COMPONENTS, "reversal"))):
        if component == "reversal" and np.unique(sign).size < 2:
            continue
        basis = loadings_of(sign, position, (component, *beside), span_mm(readings))
        contrasts = []
        for own in np.split(by_cycle, starts):
            wanted, others = basis[own, 0], basis[own, 1:]
            wanted = wanted - others @ np.linalg.lstsq(others, wanted, rcond=None)[0]
            size = float(wanted @ wanted)
            if size > 1e-6 * own.size:
                contrasts.append(float(wanted @ noise[own]) / np.sqrt(size))
        if _serial_p_value(np.array(contrasts)) < COMPONENT_LEVEL:
            found.append(component)
    return tuple(found)


def _serial_p_value(series: Array) -> float:
    """Return the one-sided p-value of positive serial dependence by the von Neumann ratio (normal approximation)."""
    n = series.size
    if n < 8 or np.ptp(series) == 0:
        return 1.0
    centred = series - series.mean()
    ratio = float((np.diff(series) ** 2).sum() / (centred**2).sum())
    deviation = np.sqrt(4.0 * (n - 2.0) / (n**2 - 1.0))
    return float(stats.norm.cdf((ratio - 2.0) / deviation))
