"""The drift-free profile of an axis as a compensation needs it: relative to a reference, at the points of a table, with its uncertainty.

Between two targets the profile is interpolated linearly, as a control does it. What it does there was not measured: its departure from
the straight line is taken as a random walk that is tied down at both targets, whose size the targets themselves tell, each one predicted
from its two neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from fusion.products.grouped import group
from fusion.report.exports.errors import ExportError

Array = NDArray[np.float64]

#: Order of the approaches along the first axis of every array.
APPROACHES = ("positive", "negative")
_SPACING_TOLERANCE_MM = 1e-3


@dataclass(frozen=True)
class Profile:
    """Positioning deviations without drift at the targets, in the order of the positions.

    Attributes
    ----------
    position_mm : (n,) ndarray
        Targets, increasing.
    deviation_um : (2, n) ndarray
        Approach in positive and in negative direction.
    covariance_um2 : (2, n, 2, n) ndarray
        Of the deviations.
    """

    position_mm: Array
    deviation_um: Array
    covariance_um2: Array


@dataclass(frozen=True)
class ErrorTable:
    """What a compensation table corrects: deviations at its points, relative to the reference position.

    Attributes
    ----------
    position_mm : (m,) ndarray
        Points of the table, increasing.
    deviation_um : (2, m) ndarray
        Approach in positive and in negative direction; zero at the reference position approached in positive direction.
    u_um : (2, m) ndarray
        Standard uncertainty, that of the interpolation included.
    reference_mm : float
        Position at which the correction is zero.
    widest_gap_mm : float
        Largest distance of two neighbouring targets.
    resampled : bool
        Whether the points are others than the targets.
    """

    position_mm: Array
    deviation_um: Array
    u_um: Array
    reference_mm: float
    widest_gap_mm: float
    resampled: bool = False

    def spacing_mm(self) -> float | None:
        """Return the distance of the points; None where they are not equally spaced."""
        steps = np.diff(self.position_mm)
        return float(steps.mean()) if np.ptp(steps) <= _SPACING_TOLERANCE_MM else None

    def mean_um(self) -> Array:
        """Return the mean of both approaches (m,), relative to the reference, for a control that knows one table."""
        mean = self.deviation_um.mean(axis=0)
        return mean - np.interp(self.reference_mm, self.position_mm, mean)

    def reversal_um(self) -> float:
        """Return the mean reversal error (positive minus negative approach)."""
        return float((self.deviation_um[0] - self.deviation_um[1]).mean())


def read_profile(deviations: xr.Dataset) -> Profile:
    """Return the profile of a run.

    Parameters
    ----------
    deviations : Dataset
        Product ``deviations.nc``.

    Raises
    ------
    ExportError
        If an approach was not measured at a position, or there are fewer than two positions.
    """
    drift = group(deviations, "drift")
    order = np.argsort(deviations["position"].values)
    position = deviations["position"].values[order].astype(float)
    chosen = drift.sel(direction=list(APPROACHES)).isel(target=order, other_target=order)
    deviation = chosen["profile"].transpose("direction", "target").values
    gaps = ~np.isfinite(deviation).all(axis=0)
    if gaps.any():
        raise ExportError(
            f"no profile at {position[gaps][0]:g} mm in one approach; a compensation table needs both: measure it in both directions"
        )
    if position.size < 2:
        raise ExportError("one position only; a compensation table needs at least two")
    swap = [list(deviations["direction"].values).index(name) for name in APPROACHES]
    covariance = chosen["covariance"].isel(other_direction=swap)
    return Profile(
        position, deviation, covariance.transpose("direction", "target", "other_direction", "other_target").values
    )


def tabulate(profile: Profile, *, spacing_mm: float | None = None, reference_mm: float | None = None) -> ErrorTable:
    """Return the deviations at the points of a table, relative to the reference.

    Parameters
    ----------
    profile : Profile
        Of the run.
    spacing_mm : float, optional
        Distance of the points, from the first target on; the last point lies at the last target or up to one spacing behind it, on the
        straight line through the last two targets. None: the targets themselves.
    reference_mm : float, optional
        Position at which the correction is zero, within the targets. None: the first target.

    Returns
    -------
    ErrorTable

    Raises
    ------
    ExportError
        If the reference lies outside the targets, or the spacing does not suit them.

    Notes
    -----
    With the weights w of linear interpolation, less those of the reference, u^2 = w' C w + q b. C is the covariance of the profile, b the
    variance of a Brownian bridge between the two targets, a c / (a + c) at the distances a and c from them, and q its variance per mm,
    from `path_variance`. Linear interpolation is the best prediction of such a path (kriging with a linear variogram; Matheron 1963,
    Economic Geology 58, 1246).
    """
    targets = profile.position_mm
    reference = targets[0] if reference_mm is None else reference_mm
    if not targets[0] <= reference <= targets[-1]:
        raise ExportError(
            f"the reference {reference:g} mm lies outside the measured {targets[0]:g} to {targets[-1]:g} mm; "
            "name a position between them with --reference"
        )
    points = targets if spacing_mm is None else _grid(targets, spacing_mm)
    weights = _weights(targets, points)
    # Of the table itself, not of the profile: where the axis is referenced, nothing may jump.
    at_reference = (_weights(points, np.array([reference])) @ weights)[0]
    deviation = profile.deviation_um @ weights.T - profile.deviation_um[0] @ at_reference
    bridge = path_variance(profile) * _bridge(targets, points)
    return ErrorTable(
        points,
        deviation,
        np.sqrt(_relative_variance(profile, weights, at_reference) + bridge),
        float(reference),
        float(np.diff(targets).max()),
        resampled=spacing_mm is not None,
    )


def path_variance(profile: Profile) -> float:
    """Return the variance per mm of the profile between its targets, from the errors of predicting each target by its two neighbours.

    Parameters
    ----------
    profile : Profile
        Of the run.

    Returns
    -------
    float
        In um2/mm; 0 where two targets only were measured, or where the predictions err by no more than the profile's own uncertainty.
    """
    targets = profile.position_mm
    estimates = []
    for i in range(1, targets.size - 1):
        before, after = targets[i] - targets[i - 1], targets[i + 1] - targets[i]
        contrast = np.zeros(targets.size)
        contrast[i - 1 : i + 2] = -after / (before + after), 1.0, -before / (before + after)
        for approach in range(len(APPROACHES)):
            noise = contrast @ profile.covariance_um2[approach, :, approach] @ contrast
            error = profile.deviation_um[approach] @ contrast
            estimates.append((error**2 - noise) * (before + after) / (before * after))
    return max(0.0, float(np.mean(estimates))) if estimates else 0.0


def _grid(targets: Array, spacing_mm: float) -> Array:
    """Return equally spaced points from the first target to the last or just behind it."""
    length = float(targets[-1] - targets[0])
    if not 0.0 < spacing_mm <= length:
        raise ExportError(
            f"--spacing {spacing_mm:g} mm does not suit targets from {targets[0]:g} to {targets[-1]:g} mm; "
            f"write a spacing above 0 and up to {length:g} mm"
        )
    steps = math.ceil(length / spacing_mm - 1e-9)
    return targets[0] + spacing_mm * np.arange(steps + 1)


def _segments(targets: Array, points: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the target before each point, the distance from it, and the distance to the target behind; the last segment has no end."""
    before = np.clip(np.searchsorted(targets, points, side="right") - 1, 0, targets.size - 2)
    return before, points - targets[before], targets[before + 1] - points


def _weights(targets: Array, points: Array) -> Array:
    """Return the weights (m, n) by which deviations at the targets are interpolated at the points."""
    before, since, until = _segments(targets, points)
    rows = np.arange(points.size)
    weights = np.zeros((points.size, targets.size))
    weights[rows, before] = until / (since + until)
    weights[rows, before + 1] = since / (since + until)
    return weights


def _bridge(targets: Array, points: Array) -> Array:
    """Return the variance (m,) between the targets in units of the variance per mm, mm."""
    _, since, until = _segments(targets, points)
    return np.abs(since * until) / (since + until)


def _relative_variance(profile: Profile, weights: Array, at_reference: Array) -> Array:
    """Return the variance (2, m) of the interpolated deviations less the one at the reference, um2."""
    variances = []
    for approach in range(len(APPROACHES)):
        contrast = np.zeros((weights.shape[0], *profile.deviation_um.shape))
        contrast[:, approach] += weights
        contrast[:, 0] -= at_reference
        flat = contrast.reshape(weights.shape[0], -1)
        covariance = profile.covariance_um2.reshape(flat.shape[1], flat.shape[1])
        variances.append(np.einsum("mi,ij,mj->m", flat, covariance, flat))
    return np.maximum(np.array(variances), 0.0)
