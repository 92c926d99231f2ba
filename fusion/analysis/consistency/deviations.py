"""Checks of the deviations alone: magnitude and unit, travel, copies, clipping, missed triggers, exchanged directions of approach."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.consistency.checks import LASER, Found, check, judge
from fusion.common import Array
from thermography.common import MAD_TO_SIGMA, scatter_by_median

#: Deviations that spread over more than this share of the travel, and over more than a millimetre or the distance of two targets, look like
#: another unit: short stages scatter over 6 % of their travel, printers over tenths of a millimetre, and only an axis whose scale was never
#: set errs by more than 1 % of a long travel.
_LARGEST_SHARE, _LARGEST_MM = 0.01, 1.0
#: Smallest random part of a reading, um, over a travel of this length, mm: refraction in still air makes more. Less over a shorter one.
_LEAST_NOISE_UM, _NOISE_TRAVEL_MM = 0.002, 200.0
#: Cycles on either side of a change of unit, the least factor, and from how many standard errors on their mean profile has a shape: no
#: laser scatters five times as much from one cycle to the next while the profile grows with it.
_UNIT_SIDE, _UNIT_FACTOR, _SHAPE_CLEAR = 5, 5.0, 2.0
#: Smallest travel as a share of the plan's extent along the axis.
_LEAST_TRAVEL_SHARE = 0.03
#: Share of equal readings from which two cycles or targets are copies, and the share of one value that ordinary sites may have.
_COPIED_SHARE, _ORDINARY_SHARE = 0.8, 0.3
#: Probability that sound readings show it by chance, from which a coincidence over targets or cycles is doubted.
_COINCIDENCE = 1e-6
#: The same for a change of the profile that looks like a shift by one target, of the one largest change; it is an upper bound, which
#: sound readings reach in far fewer tests.
_SHIFT_BY_CHANCE = 1e-2
#: Correlation of steps two targets apart: noise with a memory of any length shows -0.125 and more, twice as much is a share of the reading
#: before; steps are clipped at so many standard deviations.
_MEMORY_AT_LEAST, _LEAST_MIXED, _CLIPPED_AT = -0.125, -0.25, 4.0
#: Cycles between which stretches of a test are compared with the rest; of a longer test so many, evenly.
_MOST_BOUNDS = 60
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
#: Standard errors by which the reversal error must differ before and after, the p-value for equal size and opposite sign, and the share of
#: it within which the sizes are equal beside a drift.
_EXCHANGE_SIGMAS, _OPPOSITE_P, _SAME_SIZE = 8.0, 1e-3, 0.25


def random_part_um(values: Array) -> float:
    """Random part of a reading from the second differences of each site over the cycles, in which a slow drift cancels."""
    if values.shape[0] < 3:
        return float("nan")
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    second = second[np.isfinite(second)]
    # The second difference of independent readings has six times their variance.
    return float(scatter_by_median(second) / np.sqrt(6.0)) if second.size else float("nan")


def _rounding_um(values: Array) -> float:
    """Standard uncertainty of the rounding to the smallest step between two readings, um; 0 where all are alike."""
    # To the picometre, as differences of positions in mm carry the rounding of the arithmetic.
    steps = np.diff(np.unique(np.round(values[np.isfinite(values)], 6)))
    return float(steps.min()) / np.sqrt(12.0) if steps.size else 0.0


def find_gross_readings(standardised: xr.DataArray) -> xr.DataArray:
    """Find readings that are errors of reading: they are left out where drift and field are compared and modelled."""
    size = abs(standardised)
    # The median absolute deviation about zero, in standard deviations of a normal distribution.
    scatter = (MAD_TO_SIGMA * size.median("cycle")).fillna(1.0).clip(min=1.0)
    return size > _GROSS_SIGMAS * scatter


@check("source", LASER)
def deviation_magnitude(linear: xr.Dataset) -> Found:
    """Range of the central 95 % of the deviations: at most the larger of `_LARGEST_SHARE` of the travel, and the smaller of `_LARGEST_MM`
    mm and the least distance of two targets; measured stages of 8 mm spread over up to 6 % of it.
    """
    position = np.sort(linear["position"].values)
    low, high = np.nanquantile(linear["deviation"].values, [0.025, 0.975])
    travel_mm = float(np.ptp(position))
    least_mm = min([_LARGEST_MM, *np.diff(position)])
    limit_um = 1e3 * max(_LARGEST_SHARE * travel_mm, least_mm)
    return judge(high - low, limit_um, travel_mm=travel_mm, targets=position.size)


@check("source", LASER)
def deviation_unit(linear: xr.Dataset) -> Found:
    """Random part of a reading, from second differences of each site over the cycles, or the rounding where it is coarser: at least
    `_LEAST_NOISE_UM` µm, over a shorter travel than `_NOISE_TRAVEL_MM` mm in proportion less; and random part and profile that both
    change by one factor of at least `_UNIT_FACTOR` from one cycle on.
    """
    values, travel_mm = linear["deviation"].values, float(np.ptp(linear["position"].values))
    noise_um = max(random_part_um(values), _rounding_um(values))
    limit_um = _LEAST_NOISE_UM * min(travel_mm / _NOISE_TRAVEL_MM, 1.0)
    complete = np.isfinite(values).all(axis=(1, 2))
    first, factor = _unit_change(values[complete])
    cycle = linear["cycle"].values[complete][first] if first else None
    passed = not (noise_um < limit_um or first)
    return judge(noise_um, limit_um, passed=passed, travel_mm=travel_mm, cycle=cycle, factor=factor)


def _unit_change(values: Array) -> tuple[int, float]:
    """First of the cycles (cycle, direction, target) from which on readings are on another scale, and its factor; (0, 1) where none is."""
    if len(values) < 2 * _UNIT_SIDE or values.shape[2] < _LEAST_TARGETS:
        return 0, 1.0
    window = np.lib.stride_tricks.sliding_window_view(values, _UNIT_SIDE, axis=0)
    noise = MAD_TO_SIGMA * np.median(np.abs(np.diff(window, 2, axis=-1)), axis=(1, 2, 3)) / np.sqrt(6.0)
    shape = np.sqrt((_bent(window.mean(axis=-1), np.arange(window.shape[-2], dtype=float)) ** 2).mean(axis=(1, 2)))
    # A mean over the window shows a shape where that is large against its noise.
    clear = shape > _SHAPE_CLEAR * noise / np.sqrt(_UNIT_SIDE)
    before, after = slice(None, -_UNIT_SIDE), slice(_UNIT_SIDE, None)
    with np.errstate(divide="ignore", invalid="ignore"):
        of_noise, of_shape = (np.log(size[after] / size[before]) for size in (noise, shape))
    alike = (np.abs(of_noise - of_shape) < np.log(2.0)) & (np.abs(of_noise) > np.log(_UNIT_FACTOR))
    size = np.where(alike & clear[before] & clear[after], np.abs(of_shape), 0.0)
    place = int(np.argmax(size))
    return (place + _UNIT_SIDE, float(np.exp(of_shape[place]))) if size[place] > np.log(_UNIT_FACTOR) else (0, 1.0)


@check("source", LASER)
def travel(linear: xr.Dataset, plan_extent_mm: float) -> Found:
    """Span of the targets over the extent of the plan along the axis: at least `_LEAST_TRAVEL_SHARE`."""
    travel_mm = float(np.ptp(linear["position"].values))
    share = travel_mm / plan_extent_mm
    passed = share >= _LEAST_TRAVEL_SHARE
    return judge(share, _LEAST_TRAVEL_SHARE, passed=passed, travel_mm=travel_mm, extent_mm=plan_extent_mm)


@check("source", LASER)
def copied_cycles(linear: xr.Dataset) -> Found:
    """Cycles that agree digit for digit in `_COPIED_SHARE` of their readings: the probability that as many different values agree, from
    the most frequent difference of neighbours, times the number of pairs, is below `_COINCIDENCE` ([below](#operator-and-recorder)).
    """
    number, values = linear["cycle"].values, linear["deviation"].values
    rows = values.reshape(len(values), -1)
    pairs = [f"{number[a]} and {number[b]}" for a, b in _copies(rows, rows[:0])]
    return judge(len(pairs), 0.0, pairs=_first_few(pairs))


@check("source", LASER)
def copied_targets(linear: xr.Dataset) -> Found:
    """The same of targets, or both approaches of one, over the cycles; also from the most frequent difference between the approaches,
    whose median counts.
    """
    number, values = linear["target"].values, linear["deviation"].values
    between = np.diff(values, axis=1)
    copies = _copies(values.reshape(len(values), -1).T, between.reshape(len(values), -1).T)
    pairs = dict.fromkeys(f"{number[a % number.size]} and {number[b % number.size]}" for a, b in copies)
    return judge(len(pairs), 0.0, pairs=_first_few([*pairs]))


def _first_few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _copies(rows: Array, between: Array) -> list[tuple[int, int]]:
    """Rows that agree digit for digit where rows that follow each other, and most of the differences between approaches, do not."""
    equal = [
        np.argwhere(np.triu(shares, start + 1) >= _COPIED_SHARE) + np.array([start, 0])
        for start, shares in _equal_shares(rows)
    ]
    following = _largest_shares(np.diff(rows, axis=0))
    usual = max([one for one, zeros in following if zeros < _COPIED_SHARE], default=1.0)
    # Both approaches agree where the resolution is coarse, also when a compensation was added to what was read.
    usual = max(usual, float(np.median([one for one, _ in _largest_shares(between)] or [0.0])))
    tried = 0.5 * len(rows) ** 2
    # Every value counts once: readings that stay at one value, as where the laser is zeroed, are equal and no copies.
    return [
        (int(a), int(b))
        for a, b in np.concatenate(equal)
        if tried * usual ** np.unique(rows[a][rows[a] == rows[b]]).size < _COINCIDENCE
    ]


@check("source", LASER)
def repeated_value(linear: xr.Dataset) -> Found:
    """Readings that hold one value at targets that scatter by more than their resolution, or at several targets in every cycle the
    largest or smallest of all, or that hold what the target before or after them read, against the number that scatter and resolution
    make: p of the excess, times the number of values, is below `_COINCIDENCE`.
    """
    values = linear["deviation"].values.reshape(linear.sizes["cycle"], -1)
    sound = judge(0.0, 0.0)
    with np.errstate(invalid="ignore"):
        steps = np.abs(np.diff(np.round(values, 6), axis=0))
    least = np.where(steps > 0.0, steps, np.inf).min(axis=0, initial=np.inf)
    if not np.isfinite(least).any():
        return sound
    # Single values that were typed with more digits do not make the resolution of the others.
    step_um = float(np.median(least[np.isfinite(least)]))
    random_um = np.array([random_part_um(values[:, [site]]) for site in range(values.shape[1])])
    # Where rounding makes the scatter, readings repeat; so does the reading at which the laser is zeroed, but not those of several targets.
    scatters = np.nan_to_num(random_um) > step_um
    if scatters.any():
        limited = _at_a_limit(values, *_held_values(values), linear.sizes["target"])
        random_um[limited] = np.median(random_um[scatters])
        scatters |= limited
    some = np.round(values[:, scatters], 6)
    found, counts = np.unique(some[np.isfinite(some)], return_counts=True)
    if not counts.size:
        return sound
    value = float(found[np.argmax(counts)])
    at = (some == value).any(axis=0)
    # The largest probability of one value, that at the centre of a normal distribution.
    chance = step_um / (np.sqrt(2.0 * np.pi) * random_um[scatters][at])
    expected = float((chance * np.isfinite(some[:, at]).sum(axis=0)).sum())
    # Any of the values might have been the most frequent one, and its first reading is no repetition.
    p = found.size * float(scipy.special.gammainc(counts.max() - 1, expected)) if counts.max() > 1 else 1.0
    if p >= _COINCIDENCE:
        return _held_readings(linear) or sound
    end = {np.nanmax(some): "largest", np.nanmin(some): "smallest"}.get(value, "")
    return judge(counts.max(), expected, passed=False, um=value, end=end)


def _held_readings(deviations: xr.Dataset) -> Found | None:
    """Readings that hold what the target before in the order of travel read, digit for digit, far more often than the resolution lets
    them; None where none do.
    """
    values = np.round(deviations["deviation"].values[:, :, np.argsort(deviations["position"].values)], 6)
    equal, random_um = np.diff(values, axis=2) == 0.0, random_part_um(values)
    # A target that is a copy of another is named by itself.
    equal &= equal.mean(axis=0) < _COPIED_SHARE
    expected = 0.0
    for here in values:
        # The least distance of two readings of a cycle is its resolution: a compensation afterwards is another one in every cycle.
        apart = np.diff(np.unique(here[np.isfinite(here)]))
        if not apart.size or apart.min() >= random_um:
            return None
        # The largest probability of one value of a difference of two readings, that at the centre of a normal distribution.
        expected += np.isfinite(np.diff(here, axis=1)).sum() * apart.min() / (2.0 * np.sqrt(np.pi) * random_um)
    count = int(equal.sum())
    if count < 2 or float(scipy.special.gammainc(count, expected)) >= _COINCIDENCE:
        return None
    return judge(count, expected, passed=False, um=None)


@check("source", LASER)
def mixed_readings(linear: xr.Dataset) -> Found:
    """Correlation of the steps from target to target with those two targets on, in the changes from cycle to cycle: at least
    `_LEAST_MIXED`, or no three standard errors below `_MEMORY_AT_LEAST`; readings that hold half of the one before show -0.5.
    """
    values = linear["deviation"].values[:, :, np.argsort(linear["position"].values)]
    steps = np.diff(np.diff(values, axis=0), axis=2)
    known = steps[np.isfinite(steps)]
    scatter_um = scatter_by_median(known) if known.size else 0.0
    if not scatter_um > 0.0:
        return judge(0.0, _LEAST_MIXED, passed=True)
    # A reading far off says nothing of the others.
    steps = np.clip(steps / scatter_um, -_CLIPPED_AT, _CLIPPED_AT)
    variance = np.nanmean(steps**2)
    products = [steps[..., :-lag] * steps[..., lag:] for lag in (2, 3, 4)]
    pairs = [np.count_nonzero(np.isfinite(one)) for one in products]
    two, *further = (
        float(np.nanmean(one) / variance) if count else 0.0 for one, count in zip(products, pairs, strict=True)
    )
    # Bartlett 1946 for steps of independent readings; changes over the cycles share readings, which counts as much again.
    u = 1.5 / np.sqrt(max(float(pairs[0]), 1.0))
    # What swings from reading to reading correlates further on as well.
    passed = two >= min(_LEAST_MIXED, _MEMORY_AT_LEAST - 3.0 * u) or two >= -1.5 * max(map(abs, further))
    return judge(two, _LEAST_MIXED, passed=passed)


@check("source", LASER)
def missed_trigger(linear: xr.Dataset) -> Found:
    """Profile of the stretch of successive cycles that differs most from the others, in one approach, in both or over the whole way there
    and back, against theirs: as read and shifted by one target in the order of travel, apart from a line; the probability that a change
    as large lies as near to a shift is below `_SHIFT_BY_CHANCE`.
    """
    complete = np.isfinite(linear["deviation"].values).all(axis=(1, 2))
    values, cycles = linear["deviation"].values[complete], linear["cycle"].values[complete]
    noise_um = max(random_part_um(values), _rounding_um(values))
    if len(values) < 2 * _LEAST_SIDE or values.shape[2] < _LEAST_TARGETS or not noise_um > 0.0:
        return judge(0.0, 0.0)
    # In the order of travel, so that a missed trigger shifts both approaches alike.
    order = np.argsort(linear["position"].values)
    names = linear["direction"].values
    passes = values[:, :, order]
    passes[:, names == "negative"] = passes[:, names == "negative", ::-1]
    totals = np.concatenate([np.zeros((1, *passes.shape[1:])), np.cumsum(passes, axis=0)])
    first, end = _stretches(len(passes))
    inside = (totals[end] - totals[first]) / (end - first)[:, None, None]
    others = (totals[-1] - totals[end] + totals[first]) / (len(passes) - end + first)[:, None, None]
    # Squares of the differences as read, late, and early, (3, stretches): of each approach between its ends, of both, and of the whole way
    # there and back, where the first reading of a pass becomes the last one of the pass before.
    along = np.arange(passes.shape[2], dtype=float)
    profiles = (others[..., 1:-1], others[..., :-2], others[..., 2:])
    squares = np.stack([(_bent(inside[..., 1:-1] - one, along[1:-1]) ** 2).sum(axis=-1) for one in profiles])
    within = passes.shape[2] - 4
    tried = [(squares[..., k], within, name if names.size > 1 else "") for k, name in enumerate(names)]
    if names.size > 1:
        tried.append((squares.sum(axis=-1), names.size * within, ""))
        way, there_and_back = np.concatenate([along, along[::-1]]), others.reshape(len(others), -1)
        shifted = (np.roll(there_and_back, late, axis=1) for late in (0, 1, -1))
        left = [_bent(inside.reshape(len(inside), -1) - one, way) for one in shifted]
        tried.append((np.sum(np.square(left), axis=-1), way.size - 2, ""))
    error_um = noise_um * np.sqrt(1.0 / (end - first) + 1.0 / (len(passes) - end + first))
    found = []
    for differences, freedom, where in tried:
        as_read, late, early = np.maximum(np.sqrt(differences / freedom), error_um)
        place = int(np.argmax(as_read / error_um))
        left_um = min(late[place], early[place])
        # Share of the volume of all changes as large that lies as near to a shift by one target; a line is fitted.
        p = 2.0 * len(tried) * min(left_um / as_read[place], 1.0) ** freedom
        found.append((p, as_read[place], left_um, place, late[place] < early[place], where))
    p, as_read_um, left_um, place, is_late, approach = min(found, key=lambda one: one[0])
    last = cycles[end[place] - 1] if end[place] < len(passes) else None
    passed = p >= _SHIFT_BY_CHANCE
    return judge(
        as_read_um, left_um, passed=passed, first=cycles[first[place]], last=last, is_late=is_late, approach=approach
    )


def _stretches(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First cycle of every stretch of successive cycles, and the first one after it: to the end from any cycle on; and between some."""
    last = count - _LEAST_SIDE
    onward = np.arange(_LEAST_SIDE, last + 1)
    bounds = onward[:: max(1, -(-onward.size // _MOST_BOUNDS))]
    first, end = np.meshgrid(bounds, bounds, indexing="ij")
    within = end - first >= _LEAST_SIDE
    return np.concatenate([onward, first[within]]), np.concatenate([np.full(onward.size, count), end[within]])


def _bent(profiles: Array, along: Array) -> Array:
    """What a straight line along the targets leaves of each profile (..., reading), um."""
    base, _ = np.linalg.qr(np.vander(along, 2))
    return np.asarray(profiles - (profiles @ base) @ base.T)


def _largest_shares(differences: Array) -> list[tuple[float, float]]:
    """Share of the most frequent value of each row, and of zero, digit for digit."""
    rows = [row[np.isfinite(row)] for row in np.round(differences, 6)]
    return [
        (float(np.unique(row, return_counts=True)[1].max()) / row.size, float(np.mean(row == 0.0)))
        for row in rows
        if row.size
    ]


def _equal_shares(values: Array) -> Iterator[tuple[int, Array]]:
    """Yield the share of readings that cycles have equal digit for digit: first cycle of a few, and theirs with every
    cycle (few, cycle).
    """
    present = np.isfinite(values)
    cycle, site = np.nonzero(present)
    _, number = np.unique(np.column_stack([site, values[present]]), axis=0, return_inverse=True)
    holds = scipy.sparse.csr_array((np.ones(cycle.size), (cycle, number.ravel())), shape=(values.shape[0], cycle.size))
    for start in range(0, values.shape[0], _CYCLES_AT_ONCE):
        rows = slice(start, start + _CYCLES_AT_ONCE)
        both = present[rows].astype(float) @ present.T.astype(float)
        yield start, (holds[rows] @ holds.T).toarray() / np.maximum(both, 1.0)


@check("source", LASER)
def approach_labels(linear: xr.Dataset) -> Found:
    """Change of the reversal error at one cycle, equal in size and opposite in sign at every target: at most `_EXCHANGE_SIGMAS` standard
    errors, or p of the equality below `_OPPOSITE_P` and unequal by more than `_SAME_SIZE` of it.
    """
    values, sound = linear["deviation"].values, judge(0.0, _EXCHANGE_SIGMAS)
    noise_um = random_part_um(values)
    if linear.sizes["direction"] < 2 or not noise_um > 0.0:
        return sound
    reversal = values[:, 0] - values[:, 1]
    known = np.isfinite(reversal).any(axis=1)
    reversal, cycles = reversal[known], linear["cycle"].values[known]

    def sigmas(k: int) -> float:
        """Change of the reversal error at a cycle in standard errors."""
        change = known_mean(reversal[k:], axis=0) - known_mean(reversal[:k], axis=0)
        u = noise_um * np.sqrt(2.0 / k + 2.0 / (len(reversal) - k))
        return float(np.nanmean(change) * np.sqrt(change.size) / u) if np.isfinite(change).any() else 0.0

    changes = {k: sigmas(k) for k in range(_LEAST_SIDE, len(reversal) - _LEAST_SIDE + 1)}
    place = max(changes, key=lambda k: abs(changes[k]), default=0)
    best = changes.get(place, 0.0)
    if abs(best) <= _EXCHANGE_SIGMAS:
        return sound
    before, after = reversal[:place], reversal[place:]
    # Standard error of the sum of both means at every target; drift between the two readings of a target adds to the noise.
    both = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    early, late = before[:, both], after[:, both]
    spread = np.sqrt(np.nanvar(early, axis=0) / early.shape[0] + np.nanvar(late, axis=0) / late.shape[0])
    total = np.nanmean(early, axis=0) + np.nanmean(late, axis=0)
    size = float(np.ptp([np.nanmean(early), np.nanmean(late)]))
    standardised = total / np.maximum(spread, 1e-12)
    opposite = scipy.special.chdtrc(total.size, standardised @ standardised) >= _OPPOSITE_P
    # That drift fades over a test; no other change of the reversal error comes so near to its own opposite.
    opposite |= np.sqrt(np.mean(total**2)) <= _SAME_SIZE * 0.5 * size
    # An exchange happens from one cycle to the next, a reversal that drifts does not.
    near = np.nanmean(reversal[max(0, place - _LEAST_SIDE) : place]), np.nanmean(reversal[place : place + _LEAST_SIDE])
    if not opposite or near[0] * near[1] >= 0.0 or abs(near[1] - near[0]) <= 0.7 * size:
        return sound
    return judge(abs(best), _EXCHANGE_SIGMAS, cycle=cycles[place], before=near[0], after=near[1])


@check("source", LASER)
def datum(linear: xr.Dataset) -> Found:
    """Jump of all targets and both approaches at one cycle, over the range of the drift on either side: at most `_DATUM_RANGES`, or
    `_LEAST_DATUM_UM` µm.
    """
    values, noise_um = linear["deviation"].values, random_part_um(linear["deviation"].values)
    values = values.reshape(linear.sizes["cycle"], -1)
    level, cycles = _levels(values), linear["cycle"].values
    sound = judge(0.0, _DATUM_RANGES)
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
    drift = max(float(np.ptp(level[:place])), float(np.ptp(level[place + 1 :])), noise_um)
    if not scatter_by_median(jump) <= _COMMON_SHARE * abs(size) + 2.0 * noise_um:
        return sound
    multiple = abs(size) / drift
    if multiple <= _DATUM_RANGES or abs(size) <= _LEAST_DATUM_UM:
        return judge(multiple, _DATUM_RANGES, passed=True)
    # The cycle between belongs to the level that it is nearer to.
    first = cycles[place] if 2.0 * abs(level[place] - level[place - 1]) > abs(size) else cycles[place + 1]
    return judge(multiple, _DATUM_RANGES, size_um=size, cycle=first)


def _levels(values: Array) -> Array:
    """Level of every cycle (cycles,), um: sum of the median changes of the sites (cycle, site) from cycle to cycle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        changes = np.nanmedian(np.diff(values, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.nan_to_num(changes))])


def _held_values(values: Array) -> tuple[Array, Array]:
    """The most frequent reading of every site (cycle, site), and the share of the cycles that hold it; zero where too few are read."""
    held, shares = np.full(values.shape[1], np.nan), np.zeros(values.shape[1])
    for site, column in enumerate(values.T):
        present = column[np.isfinite(column)]
        if present.size >= _LEAST_SIDE:
            found, counts = np.unique(present, return_counts=True)
            held[site], shares[site] = found[np.argmax(counts)], counts.max() / present.size
    return held, shares


def _at_a_limit(values: Array, held: Array, shares: Array, targets: int) -> NDArray[np.bool_]:
    """Sites (cycle, site) that hold the largest or smallest reading of all in nearly every cycle, as those of another target do."""
    marked = np.zeros(held.size, bool)
    for limit in (np.nanmin(values), np.nanmax(values)):
        there = (shares >= _ZEROED_SHARE) & (held == limit)
        if np.unique(np.flatnonzero(there) % targets).size > 1:
            marked |= there
    return marked


@check("source", LASER)
def zeroed_cycles(linear: xr.Dataset) -> Found:
    """Largest share of the cycles in which a reading is one and the same, where those of most sites are not: less than `_ZEROED_SHARE`."""
    values = linear["deviation"].values.reshape(linear.sizes["cycle"], -1)
    held, shares = _held_values(values)
    shares[_at_a_limit(values, held, shares, linear.sizes["target"])] = 0.0
    site = int(np.argmax(shares))
    direction, target = np.unravel_index(site, linear["deviation"].shape[1:])
    passed = shares[site] < _ZEROED_SHARE or float(np.median(shares)) > _ORDINARY_SHARE
    names = {"target": linear["target"].values[target], "direction": linear["direction"].values[direction]}
    return judge(shares[site], _ZEROED_SHARE, passed=passed, **names)


# Checks of order and sign: passes against their label, targets numbered from the other end, readings mirrored against
# the others.

#: Fewest targets in which a shape can be compared.
_LEAST_TARGETS = 5
#: Fewest complete cycles from which the scatter between the approaches is taken.
_LEAST_CYCLES = 5
#: What a mirrored part leaves at most when its sign is inverted, in units of what is usual: the median step of a pass from cycle to cycle,
#: the median distance of a target from the line through the others, or the scatter of the difference between both approaches. Normal noise
#: exceeds five times its median once in a thousand.
_INVERTED_AT_MOST = 3.0
#: What it leaves at least as it was read: a drift that passes quickly through zero makes larger steps than noise does.
_PASS_AT_LEAST, _TARGET_AT_LEAST = 8.0, 5.0
#: Correlation of the drift of both approaches from which they run against each other.
_OPPOSITE = -0.5


@check("source", LASER)
def travel_order(deviations: xr.Dataset) -> Found | None:
    """Cycles in which the pass labelled positive runs down and the one labelled negative runs up, by the times of the readings: none (a
    step cycle runs up in both).
    """
    if np.isnat(deviations["time"].values).all():
        return None
    # Steps from reading to reading against the label less those along it, (cycle, direction).
    order = np.argsort(deviations["position"].values)
    time = deviations["time"].values[..., order].astype("datetime64[ns]")
    with np.errstate(invalid="ignore"):
        seconds = np.where(np.isnat(time), np.nan, time.astype(np.int64) / 1e9)
    label = np.where(deviations["direction"].values == "positive", 1.0, -1.0)
    steps = np.asarray(-label * np.nansum(np.sign(np.diff(seconds, axis=-1)), axis=-1))
    contrary = (steps > 0).all(axis=1) if steps.shape[1] == 2 else np.zeros(len(steps), bool)
    first = deviations["cycle"].values[np.argmax(contrary)]
    return judge(contrary.mean(), 0.0, contrary=contrary.sum(), cycles=contrary.size, first=first)


@check("source", LASER)
def target_order(deviations: xr.Dataset) -> Found:
    """Distance of the profiles of both approaches, apart from their level, over its scatter from cycle to cycle: as read less than
    `_TARGET_AT_LEAST`, or with the targets of one approach from the other end more than `_INVERTED_AT_MOST`.
    """
    as_read, turned = _distances_of_approaches(deviations)
    passed = not (as_read >= _TARGET_AT_LEAST and turned <= _INVERTED_AT_MOST)
    return judge(as_read, _TARGET_AT_LEAST, passed=passed, turned=turned)


def _distances_of_approaches(deviations: xr.Dataset) -> tuple[float, float]:
    """Distance of the passes in both approaches, apart from their level, as read and with the targets of one turned round."""
    values = deviations["deviation"].values
    values = values[np.isfinite(values).all(axis=(1, 2))]
    if len(values) < _LEAST_CYCLES or values.shape[1] < 2 or values.shape[2] < _LEAST_TARGETS:
        return 0.0, 0.0
    levels = values.mean(axis=2)
    if np.cov(levels.T)[0, 1] <= _OPPOSITE * np.prod(levels.std(axis=0, ddof=1)):
        return 0.0, 0.0
    shapes = values - levels[..., None]
    apart, turned = shapes[:, 0] - shapes[:, 1], shapes[:, 0] - shapes[:, 1, ::-1]
    usual = max(float(np.sqrt(np.mean(np.diff(apart, axis=0) ** 2) / 2.0)), float(np.finfo(float).tiny))
    return float(np.sqrt(np.mean(apart**2))) / usual, float(np.sqrt(np.mean(turned**2))) / usual


@check("source", LASER)
def mirrored_readings(deviations: xr.Dataset) -> Found:
    """Shape over the targets, in the passes after a cycle or in one approach, or deviation of one target, that agrees with the others
    only with the opposite sign: inverted, at most `_INVERTED_AT_MOST` times what is usual from cycle to cycle or from target to target,
    at least what rounding makes; as read, more than `_PASS_AT_LEAST` (passes) or `_TARGET_AT_LEAST` times (targets); of an approach the
    drift as well, correlation at most `_OPPOSITE`.
    """
    mirrored = [*_mirrored_passes(deviations), *_mirrored_targets(deviations)]
    return judge(len(mirrored), 0.0, mirrored=mirrored)


def _mirrored_passes(deviations: xr.Dataset) -> list[tuple[str, Any]]:
    """Passes that show the shape of the others mirrored: from one cycle on, or in one direction of approach."""
    values = deviations["deviation"].values
    values = values[np.isfinite(values).all(axis=(1, 2))]
    if len(values) < 2 or values.shape[2] < _LEAST_TARGETS:
        return []
    cycles = deviations["cycle"].values[np.isfinite(deviations["deviation"].values).all(axis=(1, 2))]
    size, levels = _shape_size(values), values.mean(axis=2)
    steps = np.diff(size, axis=0)
    usual = max(float(np.median(np.abs(steps))), _rounding_um(values))
    sums, jumps = np.abs(size[1:] + size[:-1]).mean(axis=1), np.abs(steps).min(axis=1)
    changes = (sums <= _INVERTED_AT_MOST * usual) & (jumps > _PASS_AT_LEAST * usual)
    found: list[tuple[str, Any]] = [("cycle", cycle) for cycle in cycles[1:][changes]]
    if size.shape[1] == 2:
        mirrored = np.median(np.abs(size.sum(axis=1))) <= _INVERTED_AT_MOST * usual
        apart = np.median(np.abs(np.diff(size, axis=1))) > _PASS_AT_LEAST * usual
        if mirrored and apart and np.corrcoef(levels.T)[0, 1] <= _OPPOSITE:
            found.append(("approach", deviations["direction"].values))
    return found


def _shape_size(values: Array) -> Array:
    """Size, with its sign, of the shape over the targets that most of the passes share, um, (cycle, direction)."""
    shapes = values - values.mean(axis=2, keepdims=True)
    passes = shapes.reshape(-1, shapes.shape[2])
    _, _, axes = np.linalg.svd(passes, full_matrices=False)
    return np.asarray((passes @ axes[0]).reshape(shapes.shape[:2]))


def _mirrored_targets(deviations: xr.Dataset) -> list[tuple[str, Any]]:
    """Targets that lie near the straight line through the others only when their sign is inverted."""
    values, position = deviations["deviation"].values, deviations["position"].values
    passes = values.reshape(-1, values.shape[2])
    passes = passes[np.isfinite(passes).all(axis=1)]
    if values.shape[2] < _LEAST_TARGETS or not len(passes):
        return []
    targets = range(values.shape[2])
    expected = np.stack([_line_through_others(passes, position, target) for target in targets], axis=1)
    as_read = np.sqrt(np.mean((passes - expected) ** 2, axis=0))
    inverted = np.sqrt(np.mean((passes + expected) ** 2, axis=0))
    usual = max(float(np.median(as_read)), _rounding_um(values))
    found = (as_read > _TARGET_AT_LEAST * usual) & (inverted <= _INVERTED_AT_MOST * usual)
    return [("target", number) for number in deviations["target"].values[found]]


def _line_through_others(passes: Array, position: Array, target: int) -> Array:
    """Value at a target of the straight line through the other targets of every pass, um; by the median of the slopes between pairs."""
    others = np.delete(np.arange(position.size), target)
    early, late = others[: others.size // 2], others[-(others.size // 2) :]
    slope = np.median((passes[:, late] - passes[:, early]) / (position[late] - position[early]), axis=1)
    level = np.median(passes[:, others] - slope[:, None] * position[others], axis=1)
    return np.asarray(level + slope * position[target])
