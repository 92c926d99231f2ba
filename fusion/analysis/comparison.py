"""Campaigns of one machine compared: profile, scatter, drift per kelvin, ISO 230-2 values, places that the drift follows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, TypeVar

import numpy as np
import xarray as xr
from scipy import special

from fusion.analysis.attribution.places import ComparisonError, PlaceComparison, compare_places
from fusion.analysis.drift_model.recursion import columns_of, record_of_product
from fusion.analysis.drift_model.verification import (
    EXPLAINS,
    LESS_PROBABLE,
    NAMED_GAINS,
    NAMED_U,
    SCALE_U,
    name_faults,
    response_gains,
    whole_response,
)
from fusion.analysis.levels import CHANGE_LEVEL
from fusion.analysis.predicted_test import APPROACHES, in_order, predict_values, scatter_and_drift
from fusion.common import Array
from fusion.results.axis import Iso230Part
from fusion.results.loop import AxisLoop, Coefficient
from fusion.results.parts import Quantity, TablePrediction
from fusion.results.results import Results
from interferometry.drift.estimate import COMPONENTS
from interferometry.iso230.quantities import LENGTHS
from thermography.common import scatter_by_median

# What changed in the profile of an axis between two tests, whatever thermal state each of them was in.

#: Targets of two tests are the same position within this distance, mm.
SAME_POSITION_MM = 0.05
#: Positions that both tests must have: the shapes of a thermal state take three of them.
LEAST_POSITIONS = 5
#: Share of its squared length that a shape must keep given the others to be distinguished from them.
_LEAST_SHARE = 1e-6
#: Most shapes by which a changed profile is described where steps and blocks are among them: with more they imitate any profile.
_MOST_WITH_RUNS = 2
#: Variance of a shape that the drift of a test tells, over that of least squares on a known course: successive cycles, whose first mode it
#: is, give 1.2 to 1.8 times that in a warm-up of 30 cycles, the more the longer the memory that was taken out (none to 0.6).
_SHAPE_VARIANCE = 1.8
#: Rounds in which the sizes of shapes and the covariance that these give settle.
_SIZINGS = 4
#: Shapes that the thermal state of a test may take, by drift component.
_STATE = {"shift": "offset", "stretch": "slope", "bend": "bow"}


@dataclass(frozen=True)
class ProfileChange:
    """How the profile differs between two tests.

    Attributes
    ----------
    position_mm : (n,) positions that both tests have, mm
    left_out : positions that one test has alone
    remaining_um, remaining_u_um : (n,) difference of the profiles (mean of the approaches) beyond the shapes of a thermal state, um, and
        its standard uncertainty
    shapes : slope (over the whole travel), bow (height of a parabola over the travel) and mean reversal, then what changed beyond the
        family-wise level, the strongest first: single positions (of both approaches together, or their reversal), steps and blocks; last
        the rest of the profile, with its largest value and the p-value of all of it
    tests : how many tests were made
    untold : position (mm) and size (um) of the largest difference beyond the shapes of a thermal state, where it exceeds the noise but not
        the uncertainty of these shapes: a changed machine is not told from another thermal state; None elsewhere
    """

    position_mm: Array
    left_out: int
    remaining_um: Array
    remaining_u_um: Array
    shapes: tuple[Change, ...]
    tests: int
    untold: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class _Shape:
    """A shape over the cells (direction, target) of both tests; `until_mm` and `machine` as in `Change`.

    `variance` is the covariance of a column (1) that the drift of a test tells; None where it is exact.
    """

    name: str
    position_mm: float | None
    column: Array
    machine: bool
    until_mm: float | None = None
    variance: Array | None = None


@dataclass(frozen=True)
class _Difference:
    """Differences of the cells that both tests hold: their places, values (um), covariances that add up (um2), those of the tests first,
    and degrees of freedom.
    """

    position_mm: Array
    sign: Array
    value: Array
    covariances: tuple[Array, ...]
    freedom: float

    @cached_property
    def root(self) -> Array:
        """A root of their covariance."""
        return np.asarray(np.linalg.cholesky(np.sum(self.covariances, axis=0)), float)

    def beside(self, shapes: Sequence[_Shape]) -> _Difference:
        """Return the same with what the uncertainty of the shapes adds at the sizes that suit the values best."""
        wider = self
        for _ in range(_SIZINGS if any(shape.variance is not None for shape in shapes) else 0):
            sizes, _ = wider.fit(shapes)
            pairs = zip(sizes, shapes, strict=True)
            own = [size**2 * shape.variance for size, shape in pairs if shape.variance is not None]
            wider = replace(self, covariances=(*self.covariances, *own))
        return wider

    def fit(self, shapes: Sequence[_Shape]) -> tuple[Array, Array]:
        """Return the sizes of shapes and their covariance (um2), by generalised least squares, widened by Birge's ratio."""
        design, value = self._whitened(shapes), np.linalg.solve(self.root, self.value)
        covariance = np.asarray(np.linalg.pinv(design.T @ design), float)
        sizes = covariance @ design.T @ value
        left = value - design @ sizes
        return sizes, covariance * max(1.0, float(left @ left) / max(value.size - len(shapes), 1))

    def separate(self, shape: _Shape, others: Sequence[_Shape]) -> bool:
        """Tell whether a shape can be distinguished from others."""
        return bool(np.isfinite(self.ratios([shape], others)[0]))

    def ratios(self, shapes: Sequence[_Shape], others: Sequence[_Shape]) -> Array:
        """Return the size of each shape beside others over its standard uncertainty, see `fit`; NaN where it cannot be told from them."""
        columns, (left, known) = self._whitened(shapes), self.left(others)
        own = columns - known @ (known.T @ columns)
        length = (own**2).sum(axis=0)
        apart = length > _LEAST_SHARE * (columns**2).sum(axis=0)
        gained = np.full(length.size, np.nan)
        gained[apart] = (left @ own[:, apart]) ** 2 / length[apart]
        return np.sqrt(gained / np.maximum(1.0, (left @ left - gained) / max(left.size - len(others) - 1, 1)))

    def remainder_p(self, shapes: Sequence[_Shape]) -> float:
        """Return the p-value of everything that shapes leave, by the uncertainties of both tests alone."""
        left, _ = self.left(shapes)
        freedom = left.size - len(shapes)
        return float(special.fdtrc(freedom, self.freedom, left @ left / freedom)) if freedom > 0 else 1.0

    def left(self, shapes: Sequence[_Shape]) -> tuple[Array, Array]:
        """Return what shapes leave, in cells of unit variance, and an orthonormal basis of the shapes there."""
        known, _ = np.linalg.qr(self._whitened(shapes))
        value = np.linalg.solve(self.root, self.value)
        return value - known @ (known.T @ value), known

    def _whitened(self, shapes: Sequence[_Shape]) -> Array:
        """Return the columns of shapes in cells of unit variance."""
        return np.asarray(np.linalg.solve(self.root, np.column_stack([shape.column for shape in shapes])), float)

    def p_value(self, ratio: float) -> float:
        """Return the two-sided p-value of a change over its standard uncertainty."""
        return float(2.0 * special.stdtr(self.freedom, -abs(ratio)))


def compare_profiles(before: xr.Dataset, after: xr.Dataset, *, level: float, tests: int = 0) -> ProfileChange:
    """Compare the profiles of two tests of one axis."""
    difference, left_out = _profile_difference(before, after)
    positions = np.unique(difference.position_mm)
    state = _state_shapes(difference, (before, after))
    reversal = _Shape("mean reversal", None, difference.sign / 2.0, machine=True)
    judged = np.unique(difference.sign).size == 2 and difference.separate(reversal, state)
    candidates = [reversal] if judged else []
    candidates += _single_positions(difference, positions)
    steps, blocks = _steps(difference, positions), _blocks(difference, positions)
    made = len(candidates) + len(steps) + 1
    search = partial(_search, difference, most=positions.size // 2, level=level, tests=tests + made)
    found = search(state, [*candidates, *steps], blocks)
    exact = [replace(shape, variance=None) for shape in state]
    untold = None
    if not found and search(exact, [*candidates, *steps], blocks):
        beyond, _ = _remaining(difference, exact, positions)
        place = int(np.argmax(np.abs(beyond)))
        untold = float(positions[place]), float(abs(beyond[place]))
    several = any(shape in [*steps, *blocks] for shape in found)
    left_p = difference.beside([*state, *found]).remainder_p([*state, *found])
    if several and (len(found) > _MOST_WITH_RUNS or left_p * (tests + made) <= level):
        found = search(state, candidates, ())
    reported = [*state, *([reversal] if judged and reversal not in found else []), *found]
    difference = difference.beside(reported)
    size, covariance = difference.fit(reported)
    u = np.sqrt(np.diag(covariance))
    shapes = [
        Change(
            shape.name, "profile", shape.position_mm, "um", None, None, Quantity(value=float(size[k]), u=float(u[k])),
            difference.p_value(size[k] / u[k]), shape.machine, until_mm=shape.until_mm,
        )
        for k, shape in enumerate(reported)
        if shape.name not in ("offset", "drift")
    ]  # fmt: skip
    rest, rest_u = _remaining(difference, reported, positions)
    most = int(np.argmax(np.abs(rest)))
    largest = Quantity(value=float(rest[most]), u=float(rest_u[most]))
    p_rest, at = difference.remainder_p(reported), float(positions[most])
    shapes.append(
        Change("rest of the profile" if found else "profile", "profile", at, "um", None, None, largest, p_rest, True)
    )
    remaining, remaining_u = _remaining(difference, state, positions)
    return ProfileChange(positions, left_out, remaining, remaining_u, tuple(shapes), made, untold)


# What a table that was loaded between two tests did to the profile, and how that differs from what it states.

#: Standard deviation of a shape of the thermal state, um, as good as unknown beside what a table corrects.
_STATE_U_UM = 1000.0
#: Shifts of a table that are tried, over the range of its points, and how many.
_SHIFTS = np.linspace(-0.5, 0.5, 101)


@dataclass(frozen=True)
class TableFault:
    """How a table acted by the profiles of two tests: faults under which the difference is most probable, the likeliest first, none where
    none is shown; the gain with which it acted, 1 where all is well; `told` where the tests tell that from a table that is not active.
    """

    names: tuple[str, ...]
    gain: float
    gain_u: float
    told: bool


def take_out(drift: xr.Dataset, table: TablePrediction) -> xr.Dataset:
    """Return a test as its axis would have shown it with a table."""
    sides = {"positive": 0, "negative": 1}
    position = drift["position"].values.astype(float)
    taken = xr.DataArray(
        [table.correction_at(position)[sides[str(side)]] for side in drift["direction"].values],
        dims=("direction", "target"),
    )
    return drift.assign(profile=drift["profile"] - taken)


def find_table_fault(before: xr.Dataset, after: xr.Dataset, table: TablePrediction) -> TableFault:
    """Find how a table that was loaded between two tests acted: as it states, or with a fault."""
    difference, _ = _profile_difference(before, after)
    shapes = _state_shapes(difference, (before, after))
    covariance = np.sum(difference.beside(shapes).covariances, axis=0)
    covariance = covariance + sum(_STATE_U_UM**2 * np.outer(shape.column, shape.column) for shape in shapes)
    low, high = min(table.position_mm), max(table.position_mm)

    def taken(position_mm: Array, *, swapped: bool = False) -> Array:
        forward, reverse = table.correction_at(position_mm)
        return np.where((difference.sign > 0.0) != swapped, forward, reverse)

    def judge(change: Array, spread: Array | None = None) -> tuple[float, float]:
        """Return the log-likelihood of a change of the profile, and how much is left of it beside the shapes."""
        wider = covariance if spread is None else covariance + np.outer(spread, spread)
        root = np.linalg.cholesky(wider)
        left = np.linalg.solve(root, difference.value - change)
        return float(-0.5 * left @ left - np.log(np.diag(root)).sum()), float(left @ left)

    stated = taken(difference.position_mm)
    well, misfit = judge(-stated)
    faults = {name: judge(-gain * stated, NAMED_U * stated) for name, gain in NAMED_GAINS.items()}
    faults["wrong scale"] = judge(0.0 * stated, SCALE_U * stated)
    faults["approaches swapped"] = judge(-taken(difference.position_mm, swapped=True))
    faults["mirrored"] = judge(-taken(low + high - difference.position_mm))
    shifted = [judge(-taken(difference.position_mm - share * (high - low))) for share in _SHIFTS]
    logs = np.array([one for one, _ in shifted])
    faults["shifted"] = float(special.logsumexp(logs)) - math.log(logs.size), shifted[int(np.argmax(logs))][1]
    judged = {name: (likelihood, 1.0 - left / max(misfit, 1e-12)) for name, (likelihood, left) in faults.items()}
    names = name_faults(judged, well, EXPLAINS)
    if "shifted" in names:
        by = float(_SHIFTS[int(np.argmax(logs))]) * (high - low)
        names[names.index("shifted")] = f"shifted by {by:+.3g} mm"
    precision = max(float(stated @ np.linalg.solve(covariance, stated)), 1e-12)
    gain = -stated @ np.linalg.solve(covariance, difference.value) / precision
    told = bool(names) or well - judged["not active"][0] > math.log(LESS_PROBABLE)
    return TableFault(tuple(names), float(gain), 1.0 / math.sqrt(precision), told)


def _profile_difference(before: xr.Dataset, after: xr.Dataset) -> tuple[_Difference, int]:
    """Return the differences at common positions and approaches, and how many positions one test has alone."""
    one, other = _at_common_positions(before, after)
    common = one.sizes["target"]
    if common < LEAST_POSITIONS:
        raise ComparisonError(
            f"{common} positions are the same within {SAME_POSITION_MM:g} mm; {LEAST_POSITIONS} are needed to tell a changed position "
            "from a changed thermal state: measure at the same targets"
        )
    sides = [side for side in one["direction"].values if side in other["direction"].values]
    one, other = (_by_direction(test, sides) for test in (one, other))
    present = np.isfinite(one["profile"].values) & np.isfinite(other["profile"].values)
    if present.sum() < LEAST_POSITIONS:
        raise ComparisonError("no direction of approach was measured in both tests: measure both approaches")
    covariances = tuple(test["covariance"].values[present][:, present] for test in (one, other))
    sign = np.where(np.array(sides) == "positive", 1.0, -1.0)
    place = np.broadcast_to(one["position"].values, present.shape)[present].astype(float)
    values = (other["profile"].values - one["profile"].values)[present]
    freedom = min(float(np.nansum(test["scatter_freedom"].values)) for test in (one, other))
    signs = np.broadcast_to(sign[:, None], present.shape)[present]
    left_out = before.sizes["target"] + after.sizes["target"] - 2 * common
    return _Difference(place, signs, values, covariances, max(freedom, 1.0)), left_out


def _at_common_positions(before: xr.Dataset, after: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two tests at the positions that both have, in the order of the first."""
    gaps = np.abs(before["position"].values[:, None] - after["position"].values)
    first, second = np.nonzero(gaps <= SAME_POSITION_MM)
    return before.isel(target=first, other_target=first), after.isel(target=second, other_target=second)


def _by_direction(test: xr.Dataset, sides: Sequence[str]) -> xr.Dataset:
    """Return a test with these directions only, also in its covariance."""
    at = [list(test["direction"].values).index(side) for side in sides]
    return test.isel(direction=at, other_direction=at).transpose(
        ..., "direction", "target", "other_direction", "other_target"
    )


def _state_shapes(difference: _Difference, tests: Sequence[xr.Dataset]) -> list[_Shape]:
    """Return the shapes that a thermal state may take: offset, slope and bow, and those in which the drift of either test moved."""
    low, high = float(difference.position_mm.min()), float(difference.position_mm.max())
    place = (difference.position_mm - low) / (high - low)
    shapes = [
        _Shape(name, None, COMPONENTS[component](difference.sign, place), machine=False)
        for component, name in _STATE.items()
    ]
    alike = difference.position_mm[:, None] == difference.position_mm
    mean = alike / alike.sum(axis=1)
    for test, covariance in zip(tests, difference.covariances, strict=True):
        for component in test["component"].values:
            size = float(test["drift_size"].sel(component=component))
            if component in _STATE or size == 0.0:
                continue
            share = test["drift_share"].sel(component=component)
            column = _at_cells(share, test["position"].values, difference)
            name = "mean reversal" if component == "reversal" else "drift"
            variance = None if component == "reversal" else _SHAPE_VARIANCE * mean @ covariance @ mean.T / size**2
            shape = _Shape(name, None, column, machine=False, variance=variance)
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


def _steps(difference: _Difference, positions: Array) -> list[_Shape]:
    """Return the steps of the profile: two positions or more, up to the last, that moved together."""
    return [
        _Shape("step", float(start), (difference.position_mm >= start).astype(float), machine=True)
        for start in positions[2:-1]
    ]


def _blocks(difference: _Difference, positions: Array) -> list[_Shape]:
    """Return the blocks of the profile: from two to half of the positions, between two that did not move, that moved together."""
    place = difference.position_mm
    return [
        _Shape(
            "block", float(low), ((place >= low) & (place <= high)).astype(float), machine=True, until_mm=float(high)
        )
        for i, low in enumerate(positions[1:-2], start=1)
        for high in positions[i + 1 : min(i + positions.size // 2, positions.size - 1)]
    ]


def _search(
    plain: _Difference,
    state: Sequence[_Shape],
    candidates: Sequence[_Shape],
    blocks: Sequence[_Shape],
    *,
    most: int,
    level: float,
    tests: int,
) -> list[_Shape]:
    """Return the shapes beyond the family-wise level, the strongest first; of the many blocks only where all that is left is."""
    found: list[_Shape] = []
    while len(found) < most:
        beside = [*state, *found]
        difference = plain.beside(beside)
        open_ones = [*candidates, *(blocks if difference.remainder_p(beside) * tests <= level else ())]
        ratios = np.nan_to_num(difference.ratios(open_ones, beside))
        if difference.p_value(float(ratios.max())) * tests > level:
            break
        found.append(open_ones[int(np.argmax(ratios))])
    return found


def _remaining(difference: _Difference, shapes: Sequence[_Shape], positions: Array) -> tuple[Array, Array]:
    """Return what shapes leave at every position, mean of the approaches, with its standard uncertainty by those of both tests."""
    at = difference.position_mm == positions[:, None]
    mean = at / at.sum(axis=1, keepdims=True) @ difference.root
    left, known = difference.left(shapes)
    return mean @ left, np.sqrt(np.maximum((mean**2).sum(axis=1) - ((mean @ known) ** 2).sum(axis=1), 0.0))


# Positions whose readings scatter more, or less, than before: each against the change of all others.


#: Degrees of freedom that a position must have in both tests to be compared.
_LEAST_FREEDOM = 2.0


def compare_scatters(
    position_mm: Array, before_um: Array, after_um: Array, before_freedom: Array, after_freedom: Array
) -> list[Change]:
    """Compare the scatter at every position of two tests: standard deviation of a reading after profile and drift were subtracted, um."""
    used = (before_um > 0) & (after_um > 0) & (before_freedom >= _LEAST_FREEDOM) & (after_freedom >= _LEAST_FREEDOM)
    if used.sum() < 5:
        return []
    place, one, other = position_mm[used], before_um[used], after_um[used]
    freedoms = np.stack([before_freedom[used], after_freedom[used]]) * (1.0 - 1.0 / used.sum())
    ratio = 2.0 * np.log(other / one)
    beyond = ratio - np.median(ratio)
    expected = special.polygamma(1, freedoms / 2.0).sum(axis=0)
    spread = scatter_by_median(beyond / np.sqrt(expected), centre=0.0)
    earlier, later = np.maximum(freedoms / max(spread, 1.0) ** 2, 1.0)
    f_ratio = np.exp(beyond) * special.fdtri(later, earlier, 0.5)
    p = 2.0 * np.minimum(special.fdtrc(later, earlier, f_ratio), special.fdtr(later, earlier, f_ratio))
    return [
        Change(
            "scatter", "scatter", float(at), "um", Quantity(value=float(was), u=None), Quantity(value=float(now), u=None),
            Quantity(value=float(now) / float(was), u=None), float(min(chance, 1.0)), True,
        )
        for at, was, now, chance in zip(place, one, other, p, strict=True)
    ]  # fmt: skip


#: Expanded uncertainty of one of four values beyond which it is not as predicted, over the standard uncertainty: Bonferroni.
_JUDGED_K = float(special.ndtri(1.0 - CHANGE_LEVEL / 8.0))
#: A table whose reversal error differs less along the axis is one table and a backlash, um.
_SAME_REVERSAL_UM = 1e-6
#: Values by ISO 230-2 that are compared.
_ISO230 = ("A", "R", "E", "M", "B")


@dataclass(frozen=True)
class ComparedCampaign:
    """One campaign as it is compared.

    Attributes
    ----------
    sha256 : SHA-256 of its results.json
    axis : name of the measured axis; empty where the run does not tell
    drift : joint estimate with ``position`` (target; mm); None where there are no readings with times
    maps : which part of the field the drift follows, as `tf.correlate` returns it; None where that was not tested
    record : the record as ``fusion.nc`` holds it, without its events; None of a test along an axis
    """

    results: Results
    sha256: str
    axis: str
    drift: xr.Dataset | None
    maps: xr.DataTree | None = None
    record: xr.Dataset | None = None

    @property
    def name(self) -> str:
        """Title of the campaign, with the day of its first reading."""
        time = self.results.time
        return self.results.campaign + (f", {time.day}" if time else "")


class Lack(NamedTuple):
    """What cannot be compared, or was taken for granted, by the code of its sentence, and what that names."""

    code: str
    named: tuple[str, ...] = ()


@dataclass(frozen=True)
class Change:
    """One quantity in two campaigns.

    Attributes
    ----------
    group : {"profile", "scatter", "drift per kelvin", "ISO 230-2", "response", "level", "noise"}; what it belongs to, the last three of a
        displacement of a record
    before, after : in both campaigns; None for a change of shape, which has no value of its own
    change : after minus before; of a scatter the ratio, without unit
    p_value : two-sided, family-wise over the tests of `family`
    machine : whether no thermal state of the test gives it, so that the machine or the set-up must have changed
    until_mm : last position of a block
    family : tests that share its level
    """

    quantity: str
    group: str
    position_mm: float | None
    unit: str
    before: Quantity | None
    after: Quantity | None
    change: Quantity
    p_value: float
    machine: bool
    until_mm: float | None = None
    family: int = 1

    @property
    def significant(self) -> bool:
        """Whether it differs by more than the uncertainties allow."""
        return self.p_value <= CHANGE_LEVEL

    @property
    def shown_from(self) -> float | None:
        """Size from which on a change is significant in 95 of 100 such comparisons; None without an uncertainty."""
        limit = special.ndtri(0.95) - special.ndtri(0.5 * CHANGE_LEVEL / self.family)
        return None if self.change.u is None else float(limit) * self.change.u


@dataclass(frozen=True)
class Achieved:
    """A value by ISO 230-2 with an active table.

    Attributes
    ----------
    before, achieved : without the table in the first test, with it in the second one
    stated : as stated with the table, for a test in the thermal state of the first
    predicted : in the thermal state of the second test, where its profile can be told; else as stated
    difference : achieved minus predicted
    """

    quantity: str
    before: Quantity
    stated: Quantity
    predicted: Quantity
    achieved: Quantity
    difference: Quantity

    @property
    def as_predicted(self) -> bool:
        """Whether it differs from what was predicted by no more than chance allows in one of the four values."""
        return abs(self.difference.value or 0.0) <= _JUDGED_K * (self.difference.u or 0.0)

    @property
    def told(self) -> bool:
        """Whether the value before the table would differ from what was predicted by more than that."""
        return abs((self.before.value or 0.0) - (self.predicted.value or 0.0)) > _JUDGED_K * (self.difference.u or 0.0)


@dataclass(frozen=True, eq=False)
class PairComparison:
    """One campaign against the reference.

    Attributes
    ----------
    profile : difference of the profiles; None where they cannot be compared
    not_compared : what cannot be compared, and why
    tests : tests of profile, scatter and drift per kelvin, over all campaigns, which share one level; the values by ISO 230-2 share another
    places : what both say of the places that the drift follows; None where that was not tested in both
    common : inputs of both budgets of ISO 230-2 whose error is the same in both tests
    achieved : values with a table that was loaded between the tests, beside what was predicted of it
    table : how a table that was loaded between the tests acted; the profile, and with it every change of the machine, is held against the
        first test less that table
    """

    before: ComparedCampaign
    after: ComparedCampaign
    changes: tuple[Change, ...]
    profile: ProfileChange | None
    not_compared: tuple[Lack, ...]
    tests: int
    places: PlaceComparison | None = None
    common: tuple[str, ...] = ()
    achieved: tuple[Achieved, ...] = ()
    table: TableFault | None = None

    @property
    def is_kept(self) -> bool:
        """Whether a table that was loaded between the tests acted as it states and nothing but a thermal state changed; where the profiles
        cannot tell, whether the values are as predicted.
        """
        if self.table is None:
            return all(one.as_predicted for one in self.achieved)
        return not self.table.names and not any(one.machine and one.significant for one in self.changes)


def compare_tests(
    reference: ComparedCampaign, others: Sequence[ComparedCampaign], *, same_setup: bool = False
) -> list[PairComparison]:
    """Compare tests with one of the same machine; `same_setup` where laser and sensors stood untouched between them."""
    return [_compare(reference, other, pairs=len(others), same_setup=same_setup) for other in others]


def compare_with_table(
    before: ComparedCampaign, after: ComparedCampaign, table: TablePrediction, *, same_setup: bool = False
) -> PairComparison:
    """Compare two tests of a machine between which a table was loaded: only what differs from its effect is a change of the machine."""
    expected = before if before.drift is None else replace(before, drift=take_out(before.drift, table))
    pair = replace(_compare(expected, after, pairs=1, same_setup=same_setup), before=before)
    if pair.profile is not None and before.drift is not None and after.drift is not None:
        pair = replace(pair, table=find_table_fault(before.drift, after.drift, table))
    achieved = hold_against(pair, table)
    lack = [] if achieved else [Lack("prediction", (table.not_predicted or "a value or its uncertainty is missing",))]
    return replace(pair, achieved=achieved, not_compared=(*pair.not_compared, *lack))


def hold_against(pair: PairComparison, prediction: TablePrediction) -> tuple[Achieved, ...]:
    """Hold the values with an active table against what is predicted of it.

    The table holds the errors of the instruments in the test that it was made from; those that both tests have in common cancel.
    """
    one, other = pair.before.results.iso230, pair.after.results.iso230
    if one is None or other is None:
        raise ComparisonError("there are no values by ISO 230-2 in both tests to hold against its prediction")
    here = {}
    if pair.before.drift is not None and pair.after.drift is not None:
        here = predict_here(pair.before.drift, pair.after.drift, prediction, other.cycles)
    found = []
    for symbol, stated in prediction.predicted_um.items():
        predicted = here.get(symbol, stated)
        first, second = (getattr(part, f"{symbol}_um") for part in (one, other))
        if second.value is None or second.u is None or predicted.value is None or predicted.u is None:
            continue
        shares = {name: contributions((one, other), name, symbol) for name in LENGTHS}
        systematic = sum(
            was**2 - (2.0 * was * now if name in pair.common else 0.0) for name, (was, now) in shares.items()
        )
        # What is predicted of the second test itself holds the scatter of its readings.
        measured = sum(now**2 for _, now in shares.values()) if symbol in here else second.u**2
        u = math.sqrt(max(measured + systematic, 0.0) + predicted.u**2)
        difference = Quantity(value=second.value - predicted.value, u=u)
        found.append(Achieved(symbol, first, stated, predicted, second, difference))
    return tuple(found)


def predict_here(
    before: xr.Dataset, after: xr.Dataset, table: TablePrediction, cycles: Sequence[int]
) -> dict[str, Quantity]:
    """Predict the values of some cycles of a test with a table, in its own thermal state; nothing where a profile has gaps.

    What the table leaves of the first profile, with the shapes of the thermal state that fit the second one best, and the drift of these
    cycles. With H the projection on these shapes the errors are (I - H) of the first test and H of the second one.
    """
    before, after = (in_order(test) for test in (take_out(before, table), after))
    if len(cycles) < 2 or any(test.sizes["direction"] < len(APPROACHES) for test in (before, after)):
        return {}
    difference, left_out = _profile_difference(before, after)
    if left_out or difference.value.size < after["profile"].size:
        return {}
    shapes = _state_shapes(difference, (before, after))
    wide = difference.beside(shapes)
    design = np.column_stack([shape.column for shape in shapes])
    fitted = design @ np.linalg.pinv(np.linalg.solve(wide.root, design)) @ np.linalg.inv(wide.root)
    kept, (of_first, of_second, *of_shapes) = np.eye(len(fitted)) - fitted, wide.covariances
    covariance = kept @ np.sum([of_first, *of_shapes], axis=0) @ kept.T + fitted @ of_second @ fitted.T
    left = before["profile"].values + (fitted @ difference.value).reshape(before["profile"].shape)
    scatter, _, freedom = scatter_and_drift(before)
    _, drift, _ = scatter_and_drift(after)
    course = drift[np.isin(after["cycle"].values, cycles)]
    one_table = bool(np.ptp(np.subtract(*table.correction_at(np.array(table.position_mm)))) < _SAME_REVERSAL_UM)
    return predict_values(left, covariance, scatter, [course], freedom, cycles=len(cycles), one_table=one_table)


def _compare(before: ComparedCampaign, after: ComparedCampaign, *, pairs: int, same_setup: bool) -> PairComparison:
    """Compare one campaign with the reference; `pairs` campaigns share the family."""
    stated, silent = sorted((before, after), key=lambda one: not one.axis)
    differ = [Lack("axis", (stated.name, stated.axis, silent.name))] if before.axis != after.axis else []
    if differ and silent.axis:
        return PairComparison(before, after, (), None, (Lack("axes", (before.axis, after.axis)),), 0)
    if before.record is not None or after.record is not None:
        found = [*_records(before, after)]
        compared = _of_type(Change, found)
        tests = pairs * sum(one.change.u is not None for one in compared)
        return PairComparison(
            before, after, tuple(_in_family(compared, tests)), None, tuple(_of_type(Lack, found)), tests
        )
    common = common_inputs(before, after, same_setup=same_setup)
    others = [*_scatters(before, after), *_coefficients(before, after)]
    standard = [*_standard(before, after, common)]
    judged, values = _of_type(Change, others), _of_type(Change, standard)
    profiles = [*_profile(before, after, level=CHANGE_LEVEL / pairs, tests=len(judged) + 2)]
    profile = next(iter(_of_type(ProfileChange, profiles)), None)
    tests = pairs * (len(judged) + (0 if profile is None else 2 + profile.tests))
    shapes = () if profile is None else profile.shapes
    changes = (*_in_family([*shapes, *judged], tests), *_in_family(values, pairs * len(values)))
    places = [*_places(before, after)]
    lacks = _of_type(Lack, [*differ, *others, *standard, *profiles, *places])
    agreement = next(iter(_of_type(PlaceComparison, places)), None)
    return PairComparison(before, after, changes, profile, tuple(lacks), tests, agreement, common)


_Found = TypeVar("_Found")


def _of_type(kind: type[_Found], found: Sequence[object]) -> list[_Found]:
    """Return what is of one type."""
    return [one for one in found if isinstance(one, kind)]


def _in_family(changes: Sequence[Change], tests: int) -> Iterator[Change]:
    """Yield changes with the p-value that each has among so many tests (Bonferroni)."""
    for change in changes:
        yield replace(change, p_value=min(1.0, change.p_value * tests), family=tests)


def _without(code: str, tests: Sequence[ComparedCampaign], parts: Sequence[object]) -> Lack:
    """Return that one test or both lack a part."""
    names = [test.name for test, part in zip(tests, parts, strict=True) if part is None]
    return Lack(code, (names[0] if len(names) == 1 else "either test",))


def _profile(
    before: ComparedCampaign, after: ComparedCampaign, *, level: float, tests: int
) -> Iterator[ProfileChange | Lack]:
    """Compare the profiles, or say why not."""
    if before.drift is None or after.drift is None:
        yield _without("drift", (before, after), (before.drift, after.drift))
        return
    try:
        found = compare_profiles(before.drift, after.drift, level=level, tests=tests)
    except ComparisonError as reason:
        yield Lack("profile", (str(reason),))
        return
    yield found
    if found.untold is not None:
        yield Lack(
            "thermal_state", tuple(f"{value:.2g}" if k else f"{value:g}" for k, value in enumerate(found.untold))
        )
    if found.left_out:
        yield Lack("left_out", (str(found.left_out),))


def _places(before: ComparedCampaign, after: ComparedCampaign) -> Iterator[PlaceComparison | Lack]:
    """Compare the places that the drift follows, or say why not; nothing where neither test has a field."""
    if before.maps is not None and after.maps is not None:
        try:
            yield compare_places(before.maps, after.maps)
        except ComparisonError as reason:
            yield Lack("places", (str(reason),))
    elif before.maps is not None or after.maps is not None:
        yield _without("field", (before, after), (before.maps, after.maps))


def _scatters(before: ComparedCampaign, after: ComparedCampaign) -> list[Change]:
    """The scatter at positions that both campaigns have."""
    if before.drift is None or after.drift is None:
        return []
    one, other = _at_common_positions(before.drift.sortby("position"), after.drift)
    freedom = [test["scatter_freedom"].sum("direction").values for test in (one, other)]
    return compare_scatters(
        one["position"].values, one["scatter_position"].values, other["scatter_position"].values, *freedom
    )


def _coefficients(before: ComparedCampaign, after: ComparedCampaign) -> Iterator[Change | Lack]:
    """The coefficients per kelvin of both models, where both hold the same effects."""
    loops = [one.results.loop if isinstance(one.results.loop, AxisLoop) else None for one in (before, after)]
    models = [loop for loop in loops if loop is not None]
    if len(models) < 2:
        yield _without("model", (before, after), loops)
        return
    first, second = ({*loop.declared, *(step.effect for step in loop.steps)} for loop in models)
    if first != second:
        more = (", ".join(sorted(effects)).replace("_", " ") for effects in (first - second, second - first))
        yield Lack("effects", tuple(effects or "nothing of its own" for effects in more))
        return
    found = [_per_kelvin(loop) for loop in models]
    for name in found[0]:
        if name in found[1] and found[0][name].unit == found[1][name].unit:
            before_and_after = (Quantity(value=model[name].value, u=model[name].u) for model in found)
            yield _difference(name, "drift per kelvin", found[0][name].unit, *before_and_after, machine=True)


#: A response that is known no better than to this share of it is not compared.
_LEAST_KNOWN = 0.5


def _records(before: ComparedCampaign, after: ComparedCampaign) -> Iterator[Change | Lack]:
    """Response, level and noise of every displacement that two records have, or what cannot be compared.

    How much a displacement answers its readings is learnt from either record and asked of the other: what is wrong in either makes the gain
    smaller, and cancels in the mean of the logarithms. Levels are compared at equal temperatures, beyond what wanders in between.
    """
    products = [one.record for one in (before, after) if one.record is not None]
    if len(products) < 2 or any("run" in one for one in products):
        yield Lack("kinds")
        return
    units = [{name: "" for kind in ("channel", "sensor") for name in one[kind].values} for one in products]
    for one, of in zip(units, products, strict=True):
        one.update(zip(of["driver_name"].values, of["driver_units"].values, strict=True))
    common = {
        kind: [name for name in products[0][kind].values if units[0][name] == units[1].get(name)]
        for kind in ("channel", "sensor", "driver_name")
    }
    if alone := sorted((units[0].keys() | units[1].keys()) - {name for names in common.values() for name in names}):
        yield Lack("columns", (", ".join(alone),))
    if not common["channel"] or not common["sensor"]:
        yield Lack("nothing_common")
        return
    first, second = (record_of_product(one.sel(common)) for one in products)
    learnt, again = whole_response(first), whole_response(second)
    forth, back = response_gains(first, learnt, second, again), response_gains(second, again, first, learnt)
    warmer = dict(zip(first.sensors, second.temperature[0] - first.temperature[0], strict=True))
    moved = np.array([warmer.get(one.input, 0.0) for one in columns_of(first, first.sensors)])
    between_s = abs(float((second.start - first.start) / np.timedelta64(1, "s")))
    for k, (name, *both) in enumerate(zip(first.channels, learnt, again, strict=True)):
        if any(u > _LEAST_KNOWN * gain for gain, u, _ in (forth[k], back[k])):
            yield Lack("response", (name,))
            continue
        (gain, gain_u, freedom), (inverse, inverse_u, fewest) = forth[k], back[k]
        freedom = min(freedom, fewest)
        share, u = math.sqrt(gain / inverse), math.hypot(gain_u / gain, inverse_u / inverse)
        p = float(2.0 * special.stdtr(freedom, -abs(math.log(share)) / u))
        # As wide as so few parts make its interval.
        percent_u = 100.0 * share * u * float(special.stdtrit(freedom, 0.975) / special.ndtri(0.975))
        whole, change = Quantity(value=100.0, u=None), Quantity(value=100.0 * (share - 1.0), u=percent_u)
        yield Change(
            name, "response", None, "%", whole, Quantity(value=100.0 * share, u=percent_u), change, p, machine=True
        )
        was, now = (each.displacement[np.isfinite(each.displacement[:, k]), k][0] for each in (first, second))
        expected = [float(was + moved @ one.coefficients) for one in both]
        open_um2 = sum(one.noise_um**2 * (1.0 + one.ratio * between_s) + moved @ one.covariance @ moved for one in both)
        u = math.sqrt(open_um2 + (expected[1] - expected[0]) ** 2 / 4.0)
        due = sum(expected) / 2.0
        off = float(now) - due
        level = Quantity(value=due, u=u), Quantity(value=float(now), u=None), Quantity(value=off, u=u)
        yield Change(name, "level", None, "um", *level, float(2.0 * special.ndtr(-abs(off) / u)), machine=True)
        noises = (Quantity(value=one.noise_um, u=None) for one in both)
        yield _difference(name, "noise", "um", *noises, machine=False)


def _per_kelvin(loop: AxisLoop) -> dict[str, Coefficient]:
    """The coefficients of a model that are per kelvin, by effect."""
    found: list[tuple[str, Coefficient]] = [(one.effect, one) for one in loop.declared_coefficients]
    found += [(step.effect, one) for step in loop.steps for one in step.coefficients[:1]]
    return {effect: one for effect, one in found if one.unit.endswith("/K")}


def _standard(before: ComparedCampaign, after: ComparedCampaign, common: Sequence[str]) -> Iterator[Change | Lack]:
    """The values by ISO 230-2 of the window that each campaign quotes."""
    one, other = before.results.iso230, after.results.iso230
    if one is None or other is None:
        yield _without("readings", (before, after), (one, other))
        return
    if one.unit != other.unit:
        yield Lack("rotary")
        return
    drifts = [test.results.drift for test in (before, after)]
    travels = [np.sort(np.array(drift.position_mm, float)) for drift in drifts if drift]
    if len(travels) == 2 and not (
        travels[0].size == travels[1].size and np.allclose(travels[0], travels[1], rtol=0.0, atol=SAME_POSITION_MM)
    ):
        yield Lack("targets")
        return
    for symbol in _ISO230:
        first, second = (getattr(part, f"{symbol}_um") for part in (one, other))
        if None in (first.value, second.value, first.u, second.u):
            yield Lack("value", (symbol,))
            continue
        shared = sum(math.prod(contributions((one, other), name, symbol)) for name in common)
        yield _difference(symbol, "ISO 230-2", one.unit, first, second, machine=False, covariance=shared)


def contributions(parts: Sequence[Iso230Part], name: str, symbol: str) -> list[float]:
    """Return what an input of the budget contributes to the uncertainty of a quantity in every test, um."""
    budgets = [{row.contributor: row for row in part.contributions} for part in parts]
    return [float(getattr(budget.get(name), f"{symbol}_um", None) or 0.0) for budget in budgets]


def common_inputs(before: ComparedCampaign, after: ComparedCampaign, *, same_setup: bool) -> tuple[str, ...]:
    """Return the inputs of both budgets whose error is the same in both tests, so that it cancels as far as it contributes equally.

    The coefficient of one machine where both state the same; the laser where both name the same instruments; and what was not touched
    between the tests where the user says so.
    """
    parts = [one.results.iso230 for one in (before, after)]
    stated = [() if part is None else part.conditions for part in parts]

    def same(key: str) -> bool:
        texts = [{row.text for row in rows if row.key == key and row.text} for rows in stated]
        return bool(texts[0]) and texts[0] == texts[1]

    common = ["expansion_coefficient"] if same("expansion_coefficient") else []
    common += ["device"] if same_setup or same("instrument") else []
    return (*common, *(("alignment", "material_temperature") if same_setup else ()))


def common_to_all(pairs: Sequence[PairComparison]) -> tuple[str, ...]:
    """Return the inputs whose error is the same in all tests that are compared with the reference."""
    stated = [pair.common for pair in pairs if pair.changes]
    return tuple(name for name in stated[0] if all(name in one for one in stated)) if stated else ()


def _difference(
    quantity: str, kind: str, unit: str, before: Quantity, after: Quantity, *, machine: bool, covariance: float = 0.0
) -> Change:
    """The difference of two quantities, whose errors may have a covariance; without an uncertainty it is shown and never significant."""
    change = float(after.value or 0.0) - float(before.value or 0.0)
    u = math.sqrt(before.u**2 + after.u**2 - 2.0 * covariance) if before.u and after.u else None
    p = 1.0 if u is None else float(2.0 * special.ndtr(-abs(change) / u))
    return Change(quantity, kind, None, unit, before, after, Quantity(value=change, u=u), p, machine)
