"""L3 - The fit behind the joint estimate: which readings, which profile columns, which drift components.

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

from interferometry.deviations import sort_readings
from interferometry.statespace import DriftFit, Order, estimate

Array = NDArray[np.float64]

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


class DriftDataError(ValueError):
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
