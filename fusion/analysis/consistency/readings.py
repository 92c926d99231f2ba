"""Checks of the readings alone: magnitude and unit, travel, copies, clipping, missed triggers, exchanged directions of approach."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import sparse, special

from fusion.analysis.alignment.readings import known_mean
from fusion.analysis.consistency.checks import Check, judge
from fusion.common import Array
from thermography.common import scatter_by_median

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


def check_readings(deviations: xr.Dataset, *, plan_extent_mm: float | None) -> list[Check]:
    """Check what readings can say of themselves."""
    values = deviations["deviation"].values
    if not np.isfinite(values).any():
        return []
    noise_um = random_part_um(values)
    return [
        _largest_deviation(deviations),
        _unit(deviations, max(noise_um, _rounding_um(values))),
        *([] if plan_extent_mm is None else [_travel(deviations, plan_extent_mm)]),
        _copied_cycles(deviations),
        _copied_targets(deviations),
        _repeated_value(deviations),
        _missed_trigger(deviations),
        _exchanged_approaches(deviations, noise_um),
        _datum(deviations, noise_um),
        _zeroed_cycles(deviations),
    ]


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
    scatter = (size.median("cycle") / special.ndtri(0.75)).fillna(1.0).clip(min=1.0)
    return size > _GROSS_SIGMAS * scatter


def _largest_deviation(deviations: xr.Dataset) -> Check:
    """Unit check: deviations that spread over a large share of the travel and over the distance of two targets suggest another unit."""
    position = np.sort(deviations["position"].values)
    low, high = np.nanquantile(deviations["deviation"].values, [0.025, 0.975])
    spread_um, travel_mm = float(high - low), float(np.ptp(position))
    least_mm = min([_LARGEST_MM, *np.diff(position)])
    limit_um = 1e3 * max(_LARGEST_SHARE * travel_mm, least_mm)
    return judge(
        "deviation_magnitude",
        spread_um,
        limit_um,
        f"The deviations spread over {spread_um:.3g} µm, on a travel of {travel_mm:.4g} mm with {position.size} targets (limit "
        f"{limit_um:.3g} µm).",
        "Check the units: deviations are read as µm and positions as mm.",
    )


def _unit(deviations: xr.Dataset, noise_um: float) -> Check:
    """Unit check: repeatability below that of air, not from rounding, or scatter and profile that change by one factor."""
    travel_mm = float(np.ptp(deviations["position"].values))
    limit_um = _LEAST_NOISE_UM * min(travel_mm / _NOISE_TRAVEL_MM, 1.0)
    complete = np.isfinite(deviations["deviation"].values).all(axis=(1, 2))
    first, factor = _unit_change(deviations["deviation"].values[complete])
    evidence = f"A reading repeats from cycle to cycle within {noise_um:.3g} µm (air makes {limit_um:.2g} µm over {travel_mm:.4g} mm)."
    if first:
        cycle = deviations["cycle"].values[complete][first]
        evidence = (
            f"From cycle {cycle} on scatter and profile are both some {factor:.2g} times those of the cycles before."
        )
    return judge(
        "deviation_unit",
        noise_um,
        limit_um,
        evidence,
        f"Check the unit of the deviations{' from there on' if first else ': they look like mm and are read as µm'}.",
        passed=not (noise_um < limit_um or first),
    )


def _unit_change(values: Array) -> tuple[int, float]:
    """First of the cycles (cycle, direction, target) from which on readings are on another scale, and its factor; (0, 1) where none is."""
    if len(values) < 2 * _UNIT_SIDE or values.shape[2] < _LEAST_TARGETS:
        return 0, 1.0
    window = np.lib.stride_tricks.sliding_window_view(values, _UNIT_SIDE, axis=0)
    noise = np.median(np.abs(np.diff(window, 2, axis=-1)), axis=(1, 2, 3)) / (special.ndtri(0.75) * np.sqrt(6.0))
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


def _travel(deviations: xr.Dataset, plan_extent_mm: float) -> Check:
    """Unit check: a travel that hardly shows on the plan suggests metres or inches."""
    travel_mm = float(np.ptp(deviations["position"].values))
    share = travel_mm / plan_extent_mm
    return judge(
        "travel",
        share,
        _LEAST_TRAVEL_SHARE,
        f"The targets span {travel_mm:.4g} mm, {100.0 * share:.2g} % of the plan along the axis ({plan_extent_mm:.4g} mm).",
        "Check the unit of the positions: they are read as mm and look like m or inch; if the travel is that short, accept travel.",
        passed=share >= _LEAST_TRAVEL_SHARE,
    )


def _copied_cycles(deviations: xr.Dataset) -> Check:
    """Two cycles that agree digit for digit are one cycle, entered twice."""
    number, values = deviations["cycle"].values, deviations["deviation"].values
    rows = values.reshape(len(values), -1)
    pairs = [f"{number[a]} and {number[b]}" for a, b in _copies(rows, rows[:0])]
    return judge(
        "copied_cycles",
        len(pairs),
        0.0,
        f"Cycles {_first_few(pairs)} agree digit for digit.",
        "Leave one of the two cycles out of the file.",
        sound="No two cycles agree digit for digit.",
    )


def _copied_targets(deviations: xr.Dataset) -> Check:
    """Two targets, or both approaches of one, that agree digit for digit over the cycles are one column, entered twice."""
    number, values = deviations["target"].values, deviations["deviation"].values
    between = np.diff(values, axis=1)
    copies = _copies(values.reshape(len(values), -1).T, between.reshape(len(values), -1).T)
    pairs = dict.fromkeys(f"{number[a % number.size]} and {number[b % number.size]}" for a, b in copies)
    return judge(
        "copied_targets",
        len(pairs),
        0.0,
        f"Targets {_first_few([*pairs])} agree digit for digit over the cycles (one target with itself: in both approaches).",
        "Enter the readings of every target and approach from its own column, or leave the copy out of the file.",
        sound="No two targets or approaches agree digit for digit.",
    )


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


def _repeated_value(deviations: xr.Dataset) -> Check:
    """One value that far more readings hold than scatter and resolution let them is a limit of the recorder or a filler."""
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    sound = judge("repeated_value", 0.0, 0.0, "No value is repeated beyond what the resolution makes.")
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
        limited = _at_a_limit(values, *_held_values(values), deviations.sizes["target"])
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
    p = found.size * float(special.gammainc(counts.max() - 1, expected)) if counts.max() > 1 else 1.0
    if p >= _COINCIDENCE:
        return _held_readings(deviations) or sound
    end = {np.nanmax(some): ", the largest of these", np.nanmin(some): ", the smallest of these"}.get(value, "")
    return judge(
        "repeated_value",
        float(counts.max()),
        expected,
        f"{counts.max()} readings at targets that scatter hold one value, {value:g} µm{end}; scatter and resolution make {expected:.2g}.",
        "Check the range of the recorder (clipped readings) and what it writes where it has no reading; leave these out of the file.",
        passed=False,
    )


def _held_readings(deviations: xr.Dataset) -> Check | None:
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
    if count < 2 or float(special.gammainc(count, expected)) >= _COINCIDENCE:
        return None
    return judge(
        "repeated_value",
        float(count),
        expected,
        f"{count} readings hold what the target before or after them read, digit for digit; scatter and resolution make {expected:.2g}.",
        "Check what the recorder writes where it has no reading, and the time that a reading needs; leave these readings out of the file.",
        passed=False,
    )


def _missed_trigger(deviations: xr.Dataset) -> Check:
    """In some successive cycles the profile is that of the others, by one target late or early in the order of travel."""
    sound = judge("missed_trigger", 0.0, 0.0, "The profile does not shift by a target in any cycles.")
    complete = np.isfinite(deviations["deviation"].values).all(axis=(1, 2))
    values, cycles = deviations["deviation"].values[complete], deviations["cycle"].values[complete]
    noise_um = max(random_part_um(values), _rounding_um(values))
    if len(values) < 2 * _LEAST_SIDE or values.shape[2] < _LEAST_TARGETS or not noise_um > 0.0:
        return sound
    # In the order of travel, so that a missed trigger shifts both approaches alike.
    order = np.argsort(deviations["position"].values)
    names = deviations["direction"].values
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
    tried = [
        (squares[..., k], within, f" in {name} approach" if names.size > 1 else "") for k, name in enumerate(names)
    ]
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
    p, as_read_um, left_um, place, is_late, one_way = min(found, key=lambda one: one[0])
    since = f"From cycle {cycles[first[place]]} on"
    if end[place] < len(passes):
        since = f"In cycles {cycles[first[place]]} to {cycles[end[place] - 1]}, against all others,"
    return judge(
        "missed_trigger",
        as_read_um,
        left_um,
        f"{since} every target reads what the one {'before' if is_late else 'after'} it in the order of travel read "
        f"otherwise{one_way}: the profiles differ by {as_read_um:.2g} µm as read, by {left_um:.2g} µm shifted by one target.",
        "A trigger was missed or counted twice: give these readings to the targets at which they were taken, or leave these cycles out.",
        passed=p >= _SHIFT_BY_CHANCE,
        sound=sound.evidence,
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
    holds = sparse.csr_array((np.ones(cycle.size), (cycle, number.ravel())), shape=(values.shape[0], cycle.size))
    for start in range(0, values.shape[0], _CYCLES_AT_ONCE):
        rows = slice(start, start + _CYCLES_AT_ONCE)
        both = present[rows].astype(float) @ present.T.astype(float)
        yield start, (holds[rows] @ holds.T).toarray() / np.maximum(both, 1.0)


def _exchanged_approaches(deviations: xr.Dataset, noise_um: float) -> Check:
    """A reversal error that changes its sign and keeps its size at one cycle shows exchanged labels of approach."""
    sound = judge("approach_labels", 0.0, _EXCHANGE_SIGMAS, "The reversal error keeps its sign over the test.")
    if deviations.sizes["direction"] < 2 or not noise_um > 0.0:
        return sound
    values = deviations["deviation"].values
    reversal = values[:, 0] - values[:, 1]
    known = np.isfinite(reversal).any(axis=1)
    reversal, cycles = reversal[known], deviations["cycle"].values[known]

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
    opposite = special.chdtrc(total.size, standardised @ standardised) >= _OPPOSITE_P
    # That drift fades over a test; no other change of the reversal error comes so near to its own opposite.
    opposite |= np.sqrt(np.mean(total**2)) <= _SAME_SIZE * 0.5 * size
    # An exchange happens from one cycle to the next, a reversal that drifts does not.
    near = np.nanmean(reversal[max(0, place - _LEAST_SIDE) : place]), np.nanmean(reversal[place : place + _LEAST_SIDE])
    if not opposite or near[0] * near[1] >= 0.0 or abs(near[1] - near[0]) <= 0.7 * size:
        return sound
    return judge(
        "approach_labels",
        abs(best),
        _EXCHANGE_SIGMAS,
        f"From cycle {cycles[place]} on the reversal error has the opposite sign and the same size at every target "
        f"({near[0]:+.2f} to {near[1]:+.2f} µm).",
        f"Check the labels of the direction of approach from cycle {cycles[place]} on.",
    )


def _datum(deviations: xr.Dataset, noise_um: float) -> Check:
    """A sudden shift of all targets and approaches alike, far larger than the drift about it, is a new datum or a slip."""
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    level, cycles = _levels(values), deviations["cycle"].values
    sound = judge("datum", 0.0, _DATUM_RANGES, "The readings do not jump together at any cycle.")
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
        return replace(sound, value=multiple)
    # The cycle between belongs to the level that it is nearer to.
    first = cycles[place] if 2.0 * abs(level[place] - level[place - 1]) > abs(size) else cycles[place + 1]
    return judge(
        "datum",
        multiple,
        _DATUM_RANGES,
        f"From cycle {first} on all targets read {size:+.3g} µm in both approaches, {multiple:.2g} times the drift on either side: the "
        "datum of the laser changed (beam broken, zeroed or set up again), or a mount slipped.",
        f"If the laser was zeroed or set up again before cycle {first}, evaluate the two parts as two campaigns; if not, check the "
        "clamping of optics and laser head.",
    )


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


def _zeroed_cycles(deviations: xr.Dataset) -> Check:
    """A reading that is the same in every cycle, where all others scatter, was set to that value."""
    values = deviations["deviation"].values.reshape(deviations.sizes["cycle"], -1)
    held, shares = _held_values(values)
    shares[_at_a_limit(values, held, shares, deviations.sizes["target"])] = 0.0
    site = int(np.argmax(shares))
    direction, target = np.unravel_index(site, deviations["deviation"].shape[1:])
    return judge(
        "zeroed_cycles",
        shares[site],
        _ZEROED_SHARE,
        f"Target {deviations['target'].values[target]} in {deviations['direction'].values[direction]} approach reads the same in "
        f"{100.0 * shares[site]:.0f} % of the cycles: the laser was set to zero there each time, so that a shift of all targets is lost.",
        "Zero the laser once, at the start of the test; from this one only changes along the axis can be evaluated.",
        passed=shares[site] < _ZEROED_SHARE or float(np.median(shares)) > _ORDINARY_SHARE,
        sound="No reading is the same in every cycle.",
    )


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


def check_signs(deviations: xr.Dataset) -> list[Check]:
    """Check the labels of the approaches against the travel, and the signs of the readings against one another."""
    timed = not np.isnat(deviations["time"].values).all()
    travel = [_travel_order(deviations)] if timed else []
    return [*travel, _target_order(deviations), _mirrored_readings(deviations)]


def _travel_order(deviations: xr.Dataset) -> Check:
    """A cycle whose positive pass goes down and whose negative pass goes up has its labels exchanged."""
    # Steps from reading to reading against the label less those along it, (cycle, direction).
    order = np.argsort(deviations["position"].values)
    time = deviations["time"].values[..., order].astype("datetime64[ns]")
    with np.errstate(invalid="ignore"):
        seconds = np.where(np.isnat(time), np.nan, time.astype(np.int64) / 1e9)
    label = np.where(deviations["direction"].values == "positive", 1.0, -1.0)
    steps = np.asarray(-label * np.nansum(np.sign(np.diff(seconds, axis=-1)), axis=-1))
    contrary = (steps > 0).all(axis=1) if steps.shape[1] == 2 else np.zeros(len(steps), bool)
    first = deviations["cycle"].values[np.argmax(contrary)]
    return judge(
        "travel_order",
        contrary.mean(),
        0.0,
        f"In {contrary.sum()} of {contrary.size} cycles, first in cycle {first}, the readings labelled positive were taken at falling "
        "positions and those labelled negative at growing positions.",
        "Exchange the labels of the direction of approach, or correct the times of the readings.",
        sound="The passes run in the direction of their labels.",
    )


def _target_order(deviations: xr.Dataset) -> Check:
    """Approaches that show one profile only when the targets of one of them are read from the other end are numbered differently."""
    as_read, turned = _distances_of_approaches(deviations)
    return judge(
        "target_order",
        as_read,
        _TARGET_AT_LEAST,
        f"The profiles of the two approaches differ by {as_read:.1f} times their scatter from cycle to cycle, and by {turned:.1f} "
        "times with the targets of one approach read from the other end.",
        "Number the targets by their position in both approaches: in one of them the readings are in the order of travel.",
        passed=not (as_read >= _TARGET_AT_LEAST and turned <= _INVERTED_AT_MOST),
        sound="Both approaches number the targets alike, as far as their profiles show.",
    )


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


def _mirrored_readings(deviations: xr.Dataset) -> Check:
    """Readings that are those of the others with the opposite sign."""
    mirrored = [*_mirrored_passes(deviations), *_mirrored_targets(deviations)]
    return judge(
        "mirrored_readings",
        len(mirrored),
        0.0,
        f"Deviations have the sign opposite to that of the others: {'; '.join(mirrored)}.",
        "Check the sign of the deviations there.",
        sound="The signs agree.",
    )


def _mirrored_passes(deviations: xr.Dataset) -> list[str]:
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
    found = [f"from cycle {cycle} on" for cycle in cycles[1:][changes]]
    if size.shape[1] == 2:
        mirrored = np.median(np.abs(size.sum(axis=1))) <= _INVERTED_AT_MOST * usual
        apart = np.median(np.abs(np.diff(size, axis=1))) > _PASS_AT_LEAST * usual
        if mirrored and apart and np.corrcoef(levels.T)[0, 1] <= _OPPOSITE:
            names = deviations["direction"].values
            found.append(f"approach in {names[1]} direction against approach in {names[0]} direction")
    return found


def _shape_size(values: Array) -> Array:
    """Size, with its sign, of the shape over the targets that most of the passes share, um, (cycle, direction)."""
    shapes = values - values.mean(axis=2, keepdims=True)
    passes = shapes.reshape(-1, shapes.shape[2])
    _, _, axes = np.linalg.svd(passes, full_matrices=False)
    return np.asarray((passes @ axes[0]).reshape(shapes.shape[:2]))


def _mirrored_targets(deviations: xr.Dataset) -> list[str]:
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
    return [f"target {number}" for number in deviations["target"].values[found]]


def _line_through_others(passes: Array, position: Array, target: int) -> Array:
    """Value at a target of the straight line through the other targets of every pass, um; by the median of the slopes between pairs."""
    others = np.delete(np.arange(position.size), target)
    early, late = others[: others.size // 2], others[-(others.size // 2) :]
    slope = np.median((passes[:, late] - passes[:, early]) / (position[late] - position[early]), axis=1)
    level = np.median(passes[:, others] - slope[:, None] * position[others], axis=1)
    return np.asarray(level + slope * position[target])
