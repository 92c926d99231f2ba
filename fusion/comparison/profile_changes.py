"""What changed in the profile of an axis between two tests, whatever thermal state each of them was in.

The profile of a test belongs to its own zero of the laser and to its own mean thermal state. An offset, a slope, a bow, and every further
shape in which the drift of either test moved may therefore differ without any change of the machine: they are estimated and not counted as
one. What is left is searched for single positions and for the reversal error, the strongest first, as the points that moved are found in a
geodetic network.

Source: Baarda (1968), *A testing procedure for use in geodetic networks* (data snooping); docs/method/comparison.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from fusion.errors import FusionError
from interferometry.drift.components import COMPONENTS

Array = NDArray[np.float64]

#: Targets of two tests are the same position within this distance, mm.
SAME_POSITION_MM = 0.05
#: Positions that both tests must have: the shapes of a thermal state take three of them.
LEAST_POSITIONS = 5
#: Share of its squared length that a shape must keep beside the others to be told from them.
_LEAST_SHARE = 1e-6
#: Shapes that the thermal state of a test may take, by drift component.
_STATE = {"shift": "offset", "stretch": "slope", "bend": "bow"}


class ComparisonError(FusionError):
    """Campaigns that cannot be compared; the message says in what they differ."""


@dataclass(frozen=True)
class ShapeChange:
    """One shape by which the profile differs between two tests.

    Attributes
    ----------
    shape : {"slope", "bow", "mean reversal", "position", "reversal at a position"}
        Slope: over the whole travel. Bow: height of a parabola over the travel. Position: both approaches together.
    position_mm : float or None
        Of a single position, mm.
    change_um, u_um : float
        After minus before, um, and its standard uncertainty.
    p_value : float
        Of this change by itself, two-sided.
    machine : bool
        Whether no thermal state gives it, so that the machine or the set-up must have changed.
    """

    shape: str
    position_mm: float | None
    change_um: float
    u_um: float
    p_value: float
    machine: bool


@dataclass(frozen=True)
class ProfileChange:
    """How the profile differs between two tests.

    Attributes
    ----------
    position_mm : (n,) ndarray
        Positions that both tests have, mm.
    left_out : int
        Positions that one test has alone.
    remaining_um, remaining_u_um : (n,) ndarray
        Difference of the profiles (mean of the approaches) beyond the shapes of a thermal state, um, and its standard uncertainty.
    shapes : tuple of ShapeChange
        Slope, bow and mean reversal, then the single positions beyond the family-wise level, the strongest first.
    tests : int
        How many shapes were tried.
    """

    position_mm: Array
    left_out: int
    remaining_um: Array
    remaining_u_um: Array
    shapes: tuple[ShapeChange, ...]
    tests: int


@dataclass(frozen=True)
class _Shape:
    """A shape over the cells (direction, target) of both tests; `machine` as in `ShapeChange`."""

    name: str
    position_mm: float | None
    column: Array
    machine: bool


@dataclass(frozen=True)
class _Difference:
    """Differences of the cells that both tests hold: their places, values (um), a root of their covariance, and degrees of freedom."""

    position_mm: Array
    sign: Array
    value: Array
    root: Array
    freedom: float

    def fit(self, shapes: Sequence[_Shape]) -> tuple[Array, Array]:
        """Return the sizes of shapes and their covariance (um2), by generalised least squares, widened by Birge's ratio."""
        design = np.linalg.solve(self.root, np.column_stack([shape.column for shape in shapes]))
        value = np.linalg.solve(self.root, self.value)
        covariance = np.linalg.pinv(design.T @ design)
        sizes = covariance @ design.T @ value
        left = value - design @ sizes
        return sizes, covariance * max(1.0, float(left @ left) / max(value.size - len(shapes), 1))

    def separate(self, shape: _Shape, others: Sequence[_Shape]) -> bool:
        """Tell whether a shape can be told from others."""
        known, _ = np.linalg.qr(np.linalg.solve(self.root, np.column_stack([other.column for other in others])))
        column = np.linalg.solve(self.root, shape.column)
        beside = column - known @ (known.T @ column)
        return bool(beside @ beside > _LEAST_SHARE * (column @ column))

    def p_value(self, ratio: float) -> float:
        """Return the two-sided p-value of a change over its standard uncertainty."""
        return float(2.0 * special.stdtr(self.freedom, -abs(ratio)))


def compare_profiles(before: xr.Dataset, after: xr.Dataset, *, level: float, tests: int = 0) -> ProfileChange:
    """Compare the profiles of two tests of one axis.

    Parameters
    ----------
    before, after : Dataset
        Group ``drift`` of deviations.nc with ``position`` (target; mm): profile and its covariance, shares of the drift components, and
        degrees of freedom of the scatter.
    level : float
        Family-wise level at which a single position counts as changed.
    tests : int
        Tests of the same family that are made elsewhere; those made here are added.

    Returns
    -------
    ProfileChange

    Raises
    ------
    ComparisonError
        If the tests have fewer than five positions, or no direction of approach, in common.

    Notes
    -----
    With d the difference of the profiles, C the sum of their covariances and L the shapes that are not judged, a further shape e has the
    size and the uncertainty of generalised least squares on [L, e]. The largest ratio of both is tested with Student's t and Bonferroni's
    bound for the family; a shape beyond the level joins L, and the search goes on. At most half of the positions can stand out. Where
    [L, e] leaves more than the covariances allow, as the shapes of a thermal state are not exact, all uncertainties are widened by the
    root of chi-squared over its degrees of freedom (Birge 1932, Phys. Rev. 40, 207).
    """
    difference, left_out = _difference(before, after)
    positions = np.unique(difference.position_mm)
    state = _state_shapes(difference, (before, after))
    reversal = _Shape("mean reversal", None, difference.sign / 2.0, machine=True)
    judged = np.unique(difference.sign).size == 2 and difference.separate(reversal, state)
    candidates = [reversal] if judged else []
    candidates += _single_positions(difference, positions)
    found = _search(difference, state, candidates, level=level, tests=tests + len(candidates))
    reported = [*state, *([reversal] if judged and reversal not in found else []), *found]
    size, covariance = difference.fit(reported)
    u = np.sqrt(np.diag(covariance))
    shapes = tuple(
        ShapeChange(shape.name, shape.position_mm, float(size[k]), float(u[k]), difference.p_value(size[k] / u[k]), shape.machine)
        for k, shape in enumerate(reported)
        if shape.name not in ("offset", "drift")
    )  # fmt: skip
    remaining, remaining_u = _remaining(difference, state, positions)
    return ProfileChange(positions, left_out, remaining, remaining_u, shapes, len(candidates))


def _difference(before: xr.Dataset, after: xr.Dataset) -> tuple[_Difference, int]:
    """Return the differences at common positions and approaches, and how many positions one test has alone."""
    pairs = [
        (i, j)
        for i, place in enumerate(before["position"].values)
        for j in np.flatnonzero(np.abs(after["position"].values - place) <= SAME_POSITION_MM)[:1]
    ]
    if len(pairs) < LEAST_POSITIONS:
        raise ComparisonError(
            f"{len(pairs)} positions are the same within {SAME_POSITION_MM:g} mm; {LEAST_POSITIONS} are needed to tell a changed position "
            "from a changed thermal state: measure at the same targets"
        )
    first, second = (list(places) for places in zip(*pairs, strict=True))
    one = before.isel(target=first, other_target=first)
    other = after.isel(target=second, other_target=second)
    sides = [side for side in one["direction"].values if side in other["direction"].values]
    one, other = (_by_direction(test, sides) for test in (one, other))
    present = np.isfinite(one["profile"].values) & np.isfinite(other["profile"].values)
    if present.sum() < LEAST_POSITIONS:
        raise ComparisonError("no direction of approach was measured in both tests: measure both approaches")
    covariance = sum(_matrix(test, present) for test in (one, other))
    sign = np.where(np.array(sides) == "positive", 1.0, -1.0)
    place = np.broadcast_to(one["position"].values, present.shape)[present].astype(float)
    values = (other["profile"].values - one["profile"].values)[present]
    freedom = min(float(np.nansum(test["scatter_freedom"].values)) for test in (one, other))
    signs = np.broadcast_to(sign[:, None], present.shape)[present]
    left_out = before.sizes["target"] + after.sizes["target"] - 2 * len(pairs)
    return _Difference(
        place, signs, values, np.asarray(np.linalg.cholesky(covariance), float), max(freedom, 1.0)
    ), left_out


def _by_direction(test: xr.Dataset, sides: Sequence[str]) -> xr.Dataset:
    """Return a test with these directions only, also in its covariance."""
    at = [list(test["direction"].values).index(side) for side in sides]
    return test.isel(direction=at, other_direction=at).transpose(
        ..., "direction", "target", "other_direction", "other_target"
    )


def _matrix(test: xr.Dataset, present: NDArray[np.bool_]) -> Array:
    """Return the covariance of the cells that are present, um2."""
    return np.asarray(test["covariance"].values[present][:, present])


def _state_shapes(difference: _Difference, tests: Sequence[xr.Dataset]) -> list[_Shape]:
    """Return the shapes that a thermal state may take: offset, slope and bow, and those in which the drift of either test moved."""
    low, high = float(difference.position_mm.min()), float(difference.position_mm.max())
    place = (difference.position_mm - low) / (high - low)
    shapes = [
        _Shape(name, None, COMPONENTS[component](difference.sign, place), machine=False)
        for component, name in _STATE.items()
    ]
    for test in tests:
        for component in test["component"].values:
            if component in _STATE:
                continue
            share = test["drift_share"].sel(component=component)
            column = _at_cells(share, test["position"].values, difference)
            name = "mean reversal" if component == "reversal" else "drift"
            shape = _Shape(name, None, column, machine=False)
            if difference.separate(shape, shapes):
                shapes.append(shape)
    return shapes


def _at_cells(share: xr.DataArray, position_mm: Array, difference: _Difference) -> Array:
    """Return the share of a drift component in the cells of a difference."""
    rows = {"positive": 1.0, "negative": -1.0}
    values = np.zeros(difference.value.size)
    for side in share["direction"].values:
        chosen = difference.sign == rows[str(side)]
        order = np.argsort(position_mm, kind="stable")
        values[chosen] = np.interp(
            difference.position_mm[chosen], position_mm[order], share.sel(direction=side).values[order]
        )
    return np.nan_to_num(values)


def _single_positions(difference: _Difference, positions: Array) -> list[_Shape]:
    """Return one shape for each position, and where both approaches were measured one for its reversal error."""
    at = [difference.position_mm == place for place in positions]
    shapes = [
        _Shape("position", float(place), here.astype(float), machine=True)
        for place, here in zip(positions, at, strict=True)
    ]
    shapes += [
        _Shape("reversal at a position", float(place), here * difference.sign / 2.0, machine=True)
        for place, here in zip(positions, at, strict=True)
        if np.unique(difference.sign[here]).size == 2
    ]
    return shapes


def _search(
    difference: _Difference, state: Sequence[_Shape], candidates: Sequence[_Shape], *, level: float, tests: int
) -> list[_Shape]:
    """Return the shapes beyond the family-wise level, the strongest first."""
    found: list[_Shape] = []
    most = np.unique(difference.position_mm).size // 2
    while len(found) < most:
        beside = [*state, *found]
        open_ones = [shape for shape in candidates if shape not in found and difference.separate(shape, beside)]
        ratios = [_ratio(difference, beside, shape) for shape in open_ones]
        if not ratios or difference.p_value(max(ratios)) * tests > level:
            break
        found.append(open_ones[int(np.argmax(ratios))])
    return found


def _ratio(difference: _Difference, beside: Sequence[_Shape], shape: _Shape) -> float:
    """Return the size of a shape beside others over its standard uncertainty, without sign."""
    size, covariance = difference.fit([*beside, shape])
    return float(abs(size[-1]) / np.sqrt(covariance[-1, -1]))


def _remaining(difference: _Difference, state: Sequence[_Shape], positions: Array) -> tuple[Array, Array]:
    """Return what the shapes of a thermal state leave at every position, mean of the approaches, with its standard uncertainty."""
    design = np.column_stack([shape.column for shape in state])
    size, covariance = difference.fit(state)
    left = difference.value - design @ size
    spread = difference.root @ difference.root.T - design @ covariance @ design.T
    mean = np.stack(
        [(difference.position_mm == place) / (difference.position_mm == place).sum() for place in positions]
    )
    return mean @ left, np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", mean, spread, mean), 0.0))
