"""Checks of the readings alone: magnitude and unit, travel, copied cycles, exchanged directions of approach."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import xarray as xr
from scipy import sparse, special

from fusion._typing import Array
from fusion.consistency.checks import Check, Severity
from thermography._robust import scatter_by_median

#: Largest positioning deviation that a machine can have, um per metre of travel: 1 % is no deviation but another unit.
_LARGEST_UM_PER_M = 10_000.0
#: Smallest random part of a reading in a machine, um: refraction in still air alone makes more over 0.1 m.
_LEAST_NOISE_UM = 0.002
#: Smallest travel as a share of the plan's extent along the axis.
_LEAST_TRAVEL_SHARE = 0.03
#: Share of equal readings from which two cycles are copies, and the share that ordinary cycles may have.
_COPIED_SHARE, _ORDINARY_SHARE = 0.8, 0.3
#: Cycles that are compared with all others at once.
_CYCLES_AT_ONCE = 256
#: Standard deviations of its own position and approach beyond which a reading is an error of reading: no process of a machine that repeats
#: scatters as far, and Student's t with 4 degrees of freedom, heavier than any laser's noise, does so once in some 2,000 readings.
_GROSS_SIGMAS = 10.0
#: A jump of all readings is doubted from this multiple of the drift's range on either side of it, and from this size, um: a clamped mount
#: slips by no more without being noticed, and such a slip is a cause (step_event); a new datum is anywhere.
_DATUM_RANGES, _LEAST_DATUM_UM = 3.0, 5.0
#: The jump is the same everywhere where targets and approaches differ by less than this share of it.
_COMMON_SHARE = 0.1
#: Share of the cycles with one and the same reading from which on a reading is the zero of its cycle.
_ZEROED_SHARE = 0.9
#: Fewest cycles on either side of an exchange of the approaches.
_LEAST_SIDE = 3
#: Standard errors by which the reversal error must differ before and after, and the p-value for equal size and opposite sign.
_EXCHANGE_SIGMAS, _OPPOSITE_P = 8.0, 1e-3


def check_readings(deviations: xr.Dataset, *, plan_extent_mm: float | None) -> list[Check]:
    """Check what readings can say of themselves.

    Parameters
    ----------
    deviations : Dataset
        Keeps ``interferometry.contract.DEVIATIONS``.
    plan_extent_mm : float or None
        Extent of the plan along the axis, mm; None where there is no plan, and the travel is held against nothing.

    Returns
    -------
    list of Check
        Empty where there is no reading, of which nothing can be said.
    """
    values = deviations["deviation"].values
    if not np.isfinite(values).any():
        return []
    noise_um = random_part_um(values)
    return [
        _largest_deviation(deviations),
        _least_noise(max(noise_um, _resolution_um(values) / np.sqrt(12.0))),
        *([] if plan_extent_mm is None else [_travel(deviations, plan_extent_mm)]),
        _copied_cycles(deviations),
        _exchanged_approaches(deviations, noise_um),
        _datum(deviations, noise_um),
        _zeroed_cycles(deviations),
    ]


def random_part_um(values: Array) -> float:
    """Random part of a reading from the second differences of each site over the cycles, in which a slow drift cancels.

    Parameters
    ----------
    values : (cycle, direction, target) ndarray, um
        NaN where there is no reading.

    Returns
    -------
    float
        Standard deviation, um, robust against outliers; NaN where no site has three readings in a row.
    """
    if values.shape[0] < 3:
        return float("nan")
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    second = second[np.isfinite(second)]
    # The second difference of independent readings has six times their variance.
    return float(scatter_by_median(second) / np.sqrt(6.0))


def find_gross_readings(standardised: xr.DataArray) -> xr.DataArray:
    """Find readings that are errors of reading: they are left out where drift and field are compared and modelled.

    Parameters
    ----------
    standardised : DataArray, (cycle, direction, target)
        Deletion residuals of `interferometry.drift.estimate.estimate_drift`, in standard deviations of an ordinary reading; infinite for
        readings that it left out, NaN where there is none.

    Returns
    -------
    DataArray of bool
        True beyond ten standard deviations of its position and approach, and of an ordinary reading.
    """
    size = abs(standardised)
    # The median absolute deviation about zero, in standard deviations of a normal distribution.
    scatter = (size.median("cycle") / special.ndtri(0.75)).fillna(1.0).clip(min=1.0)
    return size > _GROSS_SIGMAS * scatter


def _resolution_um(values: Array) -> float:
    """Smallest step between two different readings, um; 0 where all are alike."""
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    return float(steps.min()) if steps.size else 0.0


def _largest_deviation(deviations: xr.Dataset) -> Check:
    """Deviations beyond 1 % of the travel are in another unit."""
    position = deviations["position"].values
    span_m = max(float(np.ptp(position)), 1e-9) * 1e-3
    largest = float(np.nanquantile(np.abs(deviations["deviation"].values), 0.95)) / span_m
    passed = largest <= _LARGEST_UM_PER_M
    return Check(
        "deviation_magnitude",
        largest,
        _LARGEST_UM_PER_M,
        passed,
        f"The deviations reach {largest:.3g} µm per metre of travel (limit {_LARGEST_UM_PER_M:g}).",
        "" if passed else "Check the units: deviations are read as µm and positions as mm.",
        "every value of the axis",
        Severity.CONTRADICTION,
    )


def _least_noise(noise_um: float) -> Check:
    """Readings that repeat to a nanometre, and are not just rounded, are in millimetres."""
    passed = not noise_um < _LEAST_NOISE_UM
    return Check(
        "deviation_unit",
        noise_um,
        _LEAST_NOISE_UM,
        passed,
        f"A reading repeats from cycle to cycle within {noise_um:.3g} µm (no machine repeats within {_LEAST_NOISE_UM:g} µm).",
        "" if passed else "Check the unit of the deviations: they look like mm and are read as µm.",
        "every value of the axis",
    )


def _travel(deviations: xr.Dataset, plan_extent_mm: float) -> Check:
    """A travel that hardly shows on the plan is in metres or inches."""
    travel_mm = float(np.ptp(deviations["position"].values))
    share = travel_mm / plan_extent_mm
    passed = share >= _LEAST_TRAVEL_SHARE
    return Check(
        "travel",
        share,
        _LEAST_TRAVEL_SHARE,
        passed,
        f"The targets span {travel_mm:.4g} mm, {100.0 * share:.2g} % of the plan along the axis ({plan_extent_mm:.4g} mm).",
        "" if passed else "Check the unit of the positions: they are read as mm and look like m or inch.",
        "every value per length: expansion, pitch, index of air",
    )


def _copied_cycles(deviations: xr.Dataset) -> Check:
    """Two cycles that agree digit for digit are one cycle, entered twice."""
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    largest, following, copies = 0.0, [], []
    for start, shares in _equal_shares(values):
        later = np.triu(shares, start + 1)
        largest = max(largest, float(later.max(initial=0.0)))
        following.append(np.diagonal(shares, start + 1).copy())
        copies.append(np.argwhere(later >= _COPIED_SHARE) + np.array([start, 0]))
    pairs = []
    # Coarsely rounded readings agree from cycle to cycle; then agreement says nothing.
    if values.shape[0] > 1 and np.median(np.concatenate(following)) <= _ORDINARY_SHARE:
        number = deviations["cycle"].values
        pairs = [f"{number[a]} and {number[b]}" for a, b in np.concatenate(copies)]
    named = ", ".join(pairs[:5]) + (f" and {len(pairs) - 5} more" if len(pairs) > 5 else "")
    return Check(
        "copied_cycles",
        largest,
        _COPIED_SHARE,
        not pairs,
        f"Cycles {named} agree digit for digit." if pairs else "No two cycles agree digit for digit.",
        "Leave one of the two cycles out of the file." if pairs else "",
        "scatter, repeatability, p-values",
    )


def _equal_shares(values: Array) -> Iterator[tuple[int, Array]]:
    """Yield the share of readings that cycles have equal digit for digit: first cycle of a few, and theirs with every cycle (few, cycle).

    Of values (cycle, site), NaN where there is no reading. Equal readings are found by sorting them, so that cycles without any in common
    are never compared.
    """
    present = np.isfinite(values)
    cycle, site = np.nonzero(present)
    _, number = np.unique(np.column_stack([site, values[present]]), axis=0, return_inverse=True)
    holds = sparse.csr_array((np.ones(cycle.size), (cycle, number.ravel())), shape=(values.shape[0], cycle.size))
    for start in range(0, values.shape[0], _CYCLES_AT_ONCE):
        rows = slice(start, start + _CYCLES_AT_ONCE)
        both = present[rows].astype(float) @ present.T.astype(float)
        yield start, (holds[rows] @ holds.T).toarray() / np.maximum(both, 1.0)


def _means(values: Array) -> Array:
    """Return the mean of every column, NaN where it holds no value."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0))


def _exchanged_approaches(deviations: xr.Dataset, noise_um: float) -> Check:
    """A reversal error that changes its sign and keeps its size at one cycle shows exchanged labels of approach."""
    code, endangered = (
        "approach_labels",
        "ISO 230-2 values, reversal error, and every effect that depends on the direction of approach",
    )
    sound = Check(code, 0.0, _EXCHANGE_SIGMAS, True, "The reversal error keeps its sign over the test.", "", endangered)
    if deviations.sizes["direction"] < 2 or not noise_um > 0.0:
        return sound
    values = deviations["deviation"].values
    reversal = values[:, 0] - values[:, 1]
    known = np.isfinite(reversal).any(axis=1)
    reversal, cycles = reversal[known], deviations["cycle"].values[known]
    best, place = 0.0, 0
    for k in range(_LEAST_SIDE, reversal.shape[0] - _LEAST_SIDE + 1):
        before, after = _means(reversal[:k]), _means(reversal[k:])
        sigma = noise_um * np.sqrt(2.0) * np.sqrt(1.0 / k + 1.0 / (reversal.shape[0] - k))
        if not np.isfinite(after - before).any():
            continue
        shift = float(np.nanmean(after - before) / (sigma / np.sqrt(before.size)))
        if abs(shift) > abs(best):
            best, place = shift, k
    if abs(best) <= _EXCHANGE_SIGMAS:
        return sound
    before, after = reversal[:place], reversal[place:]
    # Standard error of the sum of both means at every target; drift between the two readings of a target adds to the noise.
    both = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    early, late = before[:, both], after[:, both]
    spread = np.sqrt(np.nanvar(early, axis=0) / early.shape[0] + np.nanvar(late, axis=0) / late.shape[0])
    total = (np.nanmean(early, axis=0) + np.nanmean(late, axis=0)) / np.maximum(spread, 1e-12)
    opposite = float(special.chdtrc(total.size, float(total @ total)))
    # An exchange happens from one cycle to the next, a reversal that drifts does not.
    near = np.nanmean(reversal[max(0, place - _LEAST_SIDE) : place]), np.nanmean(reversal[place : place + _LEAST_SIDE])
    sudden = abs(near[1] - near[0]) > 0.7 * abs(np.nanmean(after) - np.nanmean(before))
    if opposite < _OPPOSITE_P or near[0] * near[1] >= 0.0 or not sudden:
        return sound
    return Check(
        code,
        abs(best),
        _EXCHANGE_SIGMAS,
        False,
        f"From cycle {cycles[place]} on the reversal error has the opposite sign and the same size at every target "
        f"({near[0]:+.2f} to {near[1]:+.2f} µm).",
        f"Check the labels of the direction of approach from cycle {cycles[place]} on.",
        endangered,
    )


def _datum(deviations: xr.Dataset, noise_um: float) -> Check:
    """A sudden shift of all targets and approaches alike, far larger than the drift beside it, is a new datum or a slip."""
    endangered = "drift, ISO 230-2 values over the whole test, and every cause that acts from that cycle on"
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    level, cycles = _levels(values), deviations["cycle"].values
    sound = Check("datum", 0.0, _DATUM_RANGES, True, "The readings do not jump together at any cycle.", "", endangered)
    if level.size < 2 * _LEAST_SIDE or not noise_um > 0.0:
        return sound
    # Over two cycles, so that a jump within a cycle counts whole; the cycle between belongs to neither side.
    places = np.arange(_LEAST_SIDE - 1, level.size - _LEAST_SIDE + 1)
    # Only sites that were read on both sides tell a jump from others being read.
    places = places[np.isfinite(values[places + 1] - values[places - 1]).any(axis=1)]
    if not places.size:
        return sound
    jumps = level[places + 1] - level[places - 1]
    place = int(places[np.argmax(np.abs(jumps))])
    jump = values[place + 1] - values[place - 1]
    size = float(np.nanmedian(jump))
    beside = max(float(np.ptp(level[:place])), float(np.ptp(level[place + 1 :])), noise_um)
    spread = scatter_by_median(jump)
    common = spread <= _COMMON_SHARE * abs(size) + 2.0 * noise_um
    multiple = abs(size) / beside
    if multiple <= _DATUM_RANGES or abs(size) <= _LEAST_DATUM_UM or not common:
        return replace(sound, value=multiple if common else 0.0)
    # The cycle between belongs to the level that it is nearer to.
    first = cycles[place] if 2.0 * abs(level[place] - level[place - 1]) > abs(size) else cycles[place + 1]
    return Check(
        "datum",
        multiple,
        _DATUM_RANGES,
        False,
        f"From cycle {first} on all targets read {size:+.3g} µm in both approaches, {multiple:.2g} times the drift on either side: the "
        "datum of the laser changed (beam broken, zeroed or set up anew), or a mount slipped.",
        f"If the laser was zeroed or set up anew before cycle {first}, evaluate the two parts as two campaigns; if not, look at the "
        "clamping of optics and laser head.",
        endangered,
    )


def _levels(values: Array) -> Array:
    """Level of every cycle (cycles,), um: sum of the median changes of the sites (cycle, site) from cycle to cycle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        changes = np.nanmedian(np.diff(values, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.nan_to_num(changes))])


def _zeroed_cycles(deviations: xr.Dataset) -> Check:
    """A reading that is the same in every cycle, where all others scatter, was set to that value."""
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    shares = np.zeros(values.shape[1])
    for site, column in enumerate(values.T):
        present = column[np.isfinite(column)]
        if present.size >= _LEAST_SIDE:
            shares[site] = np.unique(present, return_counts=True)[1].max() / present.size
    site = int(np.argmax(shares))
    passed = shares[site] < _ZEROED_SHARE or float(np.median(shares)) > _ORDINARY_SHARE
    direction, target = np.unravel_index(site, deviations["deviation"].shape[1:])
    return Check(
        "zeroed_cycles",
        float(shares[site]),
        _ZEROED_SHARE,
        passed,
        "No reading is the same in every cycle."
        if passed
        else f"Target {deviations['target'].values[target]} in {deviations['direction'].values[direction]} approach reads the same in "
        f"{100.0 * shares[site]:.0f} % of the cycles: the laser was set to zero there each time, so that a shift of all targets is lost.",
        ""
        if passed
        else "Zero the laser once, at the start of the test; from this one only what happens along the axis can be concluded.",
        "the common drift, table_offset, and every cause that shifts all targets alike",
    )
