"""Events of a record: slips, creeps and settlings, dated and sized in the raw readings of every channel before any mean is taken.

The readings after an instant are compared with those before it, over short windows of all lengths, beside what temperatures and loads do
over the same windows: an event is a change that is out of proportion to all others of its channel. What takes longer is looked for over the
whole record by the likelihood under noise and drifts of all sizes: docs/method/records.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import linalg, optimize, special

from fusion.analysis.alignment.first_order_lag import respond
from fusion.analysis.drift_model.evaluation import Answer
from fusion.analysis.drift_model.null_simulation import DRAWS, tail_probability
from fusion.analysis.drift_model.record_data import Record, Samples
from fusion.analysis.drift_model.search import Decision, Reason
from fusion.analysis.effects.effect import Candidate
from fusion.analysis.levels import RECORD_ENTRY_LEVEL
from fusion.common import Array
from fusion.results.parts import Quantity
from thermography.common import MAD_TO_SIGMA

#: Cells of equal length that readings are laid into at most: a longer log has means of neighbours.
_MOST_CELLS = 20_000
#: Shortest window in cells, and the longest as a share of the record, which must hold many of them.
_SHORTEST, _LONGEST_SHARE = 4, 1.0 / 24.0
#: Time constants of the lagged copies of temperatures and loads, as shares of the record.
_LAG_SHARES = (1.0 / 1000.0, 1.0 / 250.0, 1.0 / 60.0, 1.0 / 15.0)
#: Windows per column of the regression on these, rows that it is made from at most, and the excursion that counts in full (Huber).
_PER_COLUMN, _ROWS, _HUBER = 8, 1500, 1.345
#: The largest excursions say nothing of the others, as they may be events: their share and least number.
_CENSORED_SHARE, _CENSORED = 0.1, 4
#: A change belongs to a temperature or load that changes over the same window by so many robust standard deviations, and in no more than
#: this share of all windows by as much.
_UNUSUAL, _SELDOM = 4.0, 0.02
#: Window in which a temperature turns as a load is switched, as a share of the record.
_TURN_SHARE = 1.0 / 400.0
#: Points of a closer look, and how long a change may take, as shares of it.
_POINTS = 160
_DURATIONS = (0.0, 0.02, 0.035, 0.06, 0.1, 0.15, 0.2, 0.27, 0.35, 0.45)
#: Points of a whole run, fewest that are looked at, durations of slow changes as shares of it, and time between onsets as a share of these.
_SLOW_POINTS, _SLOW_LEAST, _SLOW_ONSETS = 96, 48, 1.0 / 6.0
_SLOW_DURATIONS = tuple(np.geomspace(1.0 / 24.0, 0.36, 7).tolist())
#: Variances of the steps of a random walk, and of the steps of the rate of a smooth drift, from point to point, beside the noise of one.
_WALKS, _SMOOTH = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0), (0.0, 1e-5, 1e-3, 1e-2)
#: Of a closer look at a slow change: how far its onset and by what factor its duration may be another, and how many are tried.
_AROUND, _FACTORS, _ONSETS = 1.2, np.geomspace(0.4, 2.5, 13), 48
#: A slow change belongs to a temperature or load that gains so many times as much by a change then as by any other.
_MORE = 2.0
#: Log-likelihood by which the best may beat what a 95 % interval still holds, half of 7.35 as it has a corner at an instant (Hansen 2000,
#: Econometrica 68, 575), and that a course of two parts must gain.
_WITHIN, _SECOND_PART = 3.68, 3.0
#: Standard uncertainties from which on a channel takes part in an event that another shows.
_TAKES_PART = 4.0
#: Standard uncertainties within which two looks give a change one size.
_SAME_SIZE = 1.5
#: An exponential approach has 95 % of its size after so many time constants.
_TIME_CONSTANTS = 3.0
#: Power of an excursion that is exponential far out: 2 of a normal distribution; less, as what machines do has longer tails.
_TAIL = 1.5
#: Fewest readings, and fewest points and degrees of freedom that tell anything, and iterations of a robust regression.
_LEAST_READINGS, _LEAST_POINTS, _LEAST_FREEDOM, _ITERATIONS = 40, 8, 3, 5
_EVERY_OTHER = "in every other reading around it"
#: Share of the square of an event that one which takes it back leaves at most.
_TAKEN_BACK = 0.25
#: More events than this in one channel are a switching that nobody logged.
MOST_OF_A_CHANNEL = 3


class Interval(NamedTuple):
    """A value and the 95 % interval that holds it."""

    value: float
    low: float
    high: float

    def ends(self, unit: float = 1.0) -> list[float | None]:
        """The ends of the interval in a unit; None where the readings set none."""
        return [end / unit if np.isfinite(end) else None for end in self[1:]]


class Course(NamedTuple):
    """Share of a change that has happened: a part at once, the rest evenly or settling until `duration_s` after the onset, s."""

    onset_s: float
    duration_s: float
    settles: bool = False
    at_once: float = 0.0

    def at(self, seconds: Array) -> Array:
        """Shares (n,) at times, s; NaN where no time is known."""
        if not self.duration_s:
            return np.asarray(np.where(np.isnan(seconds), np.nan, seconds >= self.onset_s))
        later = (seconds - self.onset_s) / self.duration_s
        if not self.settles:
            return np.clip(later, 0.0, 1.0)
        rest = (1.0 - self.at_once) * np.exp(-_TIME_CONSTANTS * np.maximum(later, 0.0))
        return np.asarray(np.where(later < 0.0, 0.0, 1.0 - rest))

    @property
    def words(self) -> str:
        """The course in words."""
        if not self.duration_s:
            return "at once"
        return "at once, then settling" if self.at_once else "settling" if self.settles else "even"


@dataclass(frozen=True)
class Event(Candidate):
    """A lasting change of some channels: a candidate with the size that the raw readings give it.

    Attributes
    ----------
    course : its share of the change over time
    onset, duration : s since the first reading, and s until 95 % of the change had happened
    size, size_u : (channels,) um, zero in channels that take no part
    p_value : probability of a change as large in any window of a record in which none happened
    answer : what every other reading says of the size that the rest show
    """

    course: Course = field(kw_only=True)
    onset: Interval = field(kw_only=True)
    duration: Interval = field(kw_only=True)
    size: Array = field(kw_only=True)
    size_u: Array = field(kw_only=True)
    p_value: float = field(kw_only=True)
    answer: Answer = field(kw_only=True)

    def sizes(self, channels: tuple[str, ...]) -> dict[str, Quantity]:
        """Size in every channel that takes part, um."""
        told = zip(channels, self.size.tolist(), self.size_u.tolist(), strict=True)
        return {name: Quantity(value=value, u=u) for name, value, u in told if value}


class _Seen(NamedTuple):
    """The change that is most out of proportion: its window begins at cell `at`, lasts `gap` cells between means of `mean` cells; of a slow
    one its course, and the whole run on points.
    """

    log_p: float
    at: int
    gap: int
    mean: int
    channel: int
    course: Course | None = None
    run: _Run | None = None


def find_events(record: Record, used: NDArray[np.bool_]) -> tuple[list[Event], list[Decision]]:
    """Find the events in the raw readings of the used blocks, those that explain most of a channel first, and what belongs to a load
    instead. Each has its course on all blocks.
    """
    samples, digits = record.readings, record.displacement_step
    inside, switched = (each[samples.block] for each in (used, record.switched()))
    cells, found, decisions, every = _Cells.of(samples, inside), list[Event](), list[Decision](), list[Event]()
    if cells is None:
        return [], []
    left_out = np.zeros(len(record.channels), bool)
    while (seen := cells.most_striking() or cells.most_likely()) is not None:
        if load := cells.load_that_changes(seen):
            evidence: dict[str, float | str] = {"name": load, "hours": float(cells.seconds[seen.at]) / 3600.0}
            decisions.append(Decision("step_event", Reason.WITH_A_LOAD, evidence))
            cells.ignore(seen, slice(None))
            continue
        if (event := cells.closer(seen, digits)) is None:
            cells.ignore(seen, seen.channel)
            continue
        if switched[(samples.seconds >= event.onset.low) & (samples.seconds <= event.onset.high)].any():
            decisions.append(Decision("step_event", Reason.AT_SWITCHING, {"hours": event.onset.value / 3600.0}))
            cells.ignore(seen, slice(None))
            continue
        found.append(event)
        every.append(event)
        cells.take_out(event)
        many, course = np.sum([one.size != 0.0 for one in found], axis=0) > MOST_OF_A_CHANNEL, _is_a_course(found)
        evidence = {"most": MOST_OF_A_CHANNEL, "search_p": event.p_value}
        if many.any():
            decisions.append(Decision("step_event", Reason.TOO_MANY_EVENTS, evidence))
        if course.any():
            decisions.append(Decision("step_event", Reason.OWN_COURSE, evidence))
        if (nameless := many | course).any():
            cells.leave_out(nameless)
            left_out |= nameless
            found = [replace(one, size=np.where(left_out, 0.0, one.size)) for one in found]
            found = [one for one in found if one.size.any()]
    found, times = _lasting(found), [one.onset.value for one in _lasting(every)]
    p, name = cells.load_behind(times) if len(times) > 1 else (1.0, "")
    if found and p < RECORD_ENTRY_LEVEL:
        evidence = {"events": len(times), "name": name, "p_value": p, "search_p": min(one.p_value for one in found)}
        return [], [*decisions, Decision("step_event", Reason.UNLOGGED_LOAD, evidence)]
    if not found:
        return [], decisions
    left = cells.response - cells.moved @ cells.slopes[cells.windows()[-1]]
    spread = np.nanvar(left[:, ~left_out], axis=0) + np.finfo(float).tiny
    number = np.maximum(np.bincount(samples.block, minlength=used.size), 1)
    # On a block an event is the mean of its course over the readings there.
    laid = [np.bincount(samples.block, one.course.at(samples.seconds), used.size) / number for one in found]
    found = [replace(one, columns=course[:, None]) for one, course in zip(found, laid, strict=True)]
    return sorted(found, key=lambda one: -float(np.max(one.size[~left_out] ** 2 / spread))), decisions


@dataclass
class _Cells:
    """Readings on cells of equal length, NaN where there is none; runs lie apart.

    Attributes
    ----------
    seconds : (cells,) time of each on the record's axis; between runs NaN
    response : (cells, channels) um
    moved : (cells, columns) temperatures and loads, K or share, then lagged copies of them
    names : of the temperatures and loads
    excursions, slopes : by gap and length of the means, in robust standard deviations of each channel, and of the columns in um per unit
    changed : channels for which these have to be computed again
    runs : those that are long enough for slow changes, and what was found in each channel of them
    """

    seconds: Array
    step_s: float
    response: Array
    moved: Array
    names: tuple[str, ...]
    excursions: dict[tuple[int, int], Array] = field(default_factory=dict)
    slopes: dict[tuple[int, int], Array] = field(default_factory=dict)
    changed: dict[tuple[int, int], set[int]] = field(default_factory=dict)
    runs: list[_Run] = field(default_factory=list)

    @classmethod
    def of(cls, samples: Samples, used: NDArray[np.bool_]) -> _Cells | None:
        """The used samples of a record; None where they are too few."""
        runs = [
            rows
            for run in np.unique(samples.run[used])
            if (rows := np.flatnonzero(used & (samples.run == run))).size > 2
        ]
        gaps = [np.diff(samples.seconds[rows]) for rows in runs]
        if sum(one.size for one in gaps) < _LEAST_READINGS:
            return None
        span = sum(float(one.sum()) for one in gaps)
        step = max(float(np.median(np.concatenate(gaps))), span / _MOST_CELLS)
        apart = 2 + 3 * max(_SHORTEST, int(span / step * _LONGEST_SHARE))
        parts = []
        for rows in runs:
            place = np.round((samples.seconds[rows] - samples.seconds[rows[0]]) / step).astype(int)
            number = int(place[-1]) + 1
            seconds = samples.seconds[rows[0]] + step * np.arange(number)
            response, moved = (
                np.array(pd.DataFrame(values[rows]).groupby(place).mean().reindex(range(number)), order="C")
                for values in (samples.displacement, samples.moved)
            )
            for column in moved.T:
                known = np.isfinite(column)
                column[:] = np.interp(seconds, seconds[known], column[known]) if known.any() else 0.0
            late = [respond(moved, seconds, time_constant_s=share * span) for share in _LAG_SHARES]
            laid = np.column_stack([seconds, response, moved, *late])
            parts.append(np.pad(laid, ((0, apart), (0, 0)), constant_values=np.nan))
        ends = np.cumsum([len(one) for one in parts]) - apart
        laid, channels = np.concatenate(parts), 1 + samples.displacement.shape[1]
        cells = cls(laid[:, 0], step, laid[:, 1:channels], laid[:, channels:], samples.names)
        first = ends - [len(one) - apart for one in parts]
        cells.runs += [_Run(cells, *ends) for ends in zip(first, ends, strict=True) if ends[1] - ends[0] >= _SLOW_LEAST]
        return cells

    def windows(self) -> list[tuple[int, int]]:
        """Gaps and lengths of the means on either side, in cells: changes at once and changes that take as long as the window."""
        longest = int(np.isfinite(self.seconds).sum() * _LONGEST_SHARE)
        lengths = [_SHORTEST * 2**k for k in range(16) if _SHORTEST * 2**k <= max(longest, _SHORTEST)]
        return [window for length in lengths for window in ((0, length), (length, max(3, length // 2)))]

    def most_striking(self) -> _Seen | None:
        """The change whose probability among all windows, lengths and channels is least, where it is small enough for an event."""
        windows, channels = self.windows(), self.response.shape[1]
        best: _Seen | None = None
        for gap, mean in windows:
            scaled = self.scaled(gap, mean)
            together = [np.sqrt(np.mean(np.nan_to_num(scaled) ** 2, axis=1))] if channels > 1 else []
            for number, values in enumerate([*scaled.T, *together]):
                at, log_p = _log_p(np.abs(values), gap + mean)
                log_p += np.log(len(windows) * (channels + len(together)))
                if log_p < (np.log(RECORD_ENTRY_LEVEL) if best is None else best.log_p):
                    one = int(np.nanargmax(np.abs(scaled[at]))) if number == channels else number
                    best = _Seen(log_p, at + mean, gap, mean, one)
        return best

    def most_likely(self) -> _Seen | None:
        """The slow change whose probability among all courses, runs and channels is least, where it is small enough for an event."""
        seen = [one for run in self.runs for one in run.slow_changes()]
        least = min(seen, key=lambda one: one.log_p, default=None)
        return None if least is None or least.log_p >= np.log(RECORD_ENTRY_LEVEL / len(seen)) else least

    def scaled(self, gap: int, mean: int) -> Array:
        """Changes over a window beside those of temperatures and loads, in robust standard deviations of their channel."""
        channels = self.response.shape[1]
        if (gap, mean) not in self.excursions:
            number = max(0, self.seconds.size - gap - 2 * mean + 1)
            self.excursions[gap, mean] = np.full((number, channels), np.nan)
            self.slopes[gap, mean] = np.zeros((self.moved.shape[1], channels))
            self.changed[gap, mean] = set(range(channels))
        scaled, slopes, outdated = self.excursions[gap, mean], self.slopes[gap, mean], sorted(self.changed[gap, mean])
        if not outdated:
            return scaled
        self.changed[gap, mean] = set()
        response, moved = (_changes(values, gap, mean) for values in (self.response[:, outdated], self.moved))
        known = np.isfinite(moved[:, 0])
        if known.sum() < _PER_COLUMN:
            return scaled
        basis = _leading(moved[known], known.sum() / (gap + 2 * mean))
        courses = moved @ basis
        for k, changes in zip(outdated, response.T, strict=True):
            rows = np.flatnonzero(np.isfinite(changes) & known)
            scaled[:, k] = np.nan
            if rows.size < _PER_COLUMN:
                continue
            own = _robust_slopes(changes[rows], courses[rows])
            slopes[:, k], left = basis @ own, changes - courses @ own
            left -= np.median(left[rows])
            scaled[:, k] = left / (MAD_TO_SIGMA * np.median(np.abs(left[rows])) or np.inf)
        return scaled

    def load_that_changes(self, seen: _Seen) -> str:
        """A temperature or load that changes over the window of an event as at hardly any other time; empty where none does."""
        if seen.run is not None:
            return seen.run.load_that_changes(seen)
        moved = np.abs(_changes(self.moved[:, : len(self.names)], seen.gap, seen.mean))
        here = moved[seen.at - seen.mean]
        for name, all_of_it, own in zip(self.names, moved[np.isfinite(moved[:, 0])].T, here, strict=True):
            scale = MAD_TO_SIGMA * float(np.median(all_of_it))
            if own > _UNUSUAL * scale and own > 0.0 and (all_of_it >= own).mean() < _SELDOM:
                return name
        return ""

    def load_behind(self, times: list[float]) -> tuple[float, str]:
        """The temperature that turns most at the times of all events, s, as where a load is switched that nobody logged, and the chance of
        that: ranks of its turns, by Fisher's method (1932) and over all temperatures.
        """
        mean = max(_SHORTEST, int(np.isfinite(self.seconds).sum() * _TURN_SHARE))
        changes = _changes(self.moved[:, : len(self.names)], 0, mean)
        turns = np.abs(changes[mean:] - changes[:-mean])
        at = [int(np.nanargmin(np.abs(self.seconds - one))) - 2 * mean for one in times]
        here = turns[np.clip(at, 0, len(turns) - 1)]
        # Where nothing is known, nothing turns.
        rank = [np.where(np.isnan(one), 1.0, np.nanmean(turns >= one, axis=0)) for one in here]
        p = special.chdtrc(2 * len(times), -2.0 * np.log(rank).sum(axis=0)) * len(self.names)
        return float(p.min()), self.names[int(p.argmin())]

    def ignore(self, seen: _Seen, channels: slice | int) -> None:
        """Leave the window of a change out of later looks at its channel, or at all; after a slow one the channel out of slow looks."""
        if seen.run is not None:
            seen.run.ignored.add(seen.channel)
            seen.run.found.pop(seen.channel, None)
            return
        first, last = seen.at - seen.mean, seen.at + seen.gap + seen.mean
        for (gap, mean), scaled in self.excursions.items():
            scaled[max(0, first - gap - mean) : max(0, last + 1), channels] = np.nan

    def closer(self, seen: _Seen, digits: Array) -> Event | None:
        """Onset, duration and size of a change by the likelihood of the readings around it; None where these show none."""
        if seen.run is not None:
            whole, shown = seen.run.look(seen)
            return whole.event(seen, digits, shown)
        left = self.response - self.moved @ self.slopes[seen.gap, seen.mean]
        half, longest = 3 * max(seen.gap, seen.mean, 2 * _SHORTEST), left.shape[0] // 8
        looks = list[tuple[_Look, Course, Array, Array]]()
        # A longer look shows whether more of the change follows; where it does not, the shorter one dates it better.
        while True:
            if (looked := _Look.at(self, left, seen, half)) is None:
                return None
            best = looked.best([seen.channel])
            looks.append((looked, best, *looked.sizes(best)))
            half *= 2
            if len(looks) > 1 and _is_settled(looks[-2], looks[-1], seen.channel):
                looks.pop()
                break
            if half > longest and len(looks) > 1:
                break
        return looks[-1][0].event(seen, digits)

    def take_out(self, event: Event) -> None:
        """Go on without an event."""
        self.response -= event.course.at(self.seconds)[:, None] * event.size
        self._compute_again(event.size != 0.0)

    def leave_out(self, channels: NDArray[np.bool_]) -> None:
        """Go on without some channels."""
        self.response[:, channels] = np.nan
        self._compute_again(channels)

    def _compute_again(self, channels: NDArray[np.bool_]) -> None:
        for window in self.changed:
            self.changed[window] |= set(np.flatnonzero(channels).tolist())
        for run in self.runs:
            run.forget(channels)


class _Drift(NamedTuple):
    """Noise and drift on some points: covariance, its root, what is beside the courses, how far both spread (logarithm), and the courses
    without it, of unit length.
    """

    covariance: Array
    root: Array
    basis: Array
    log_spread: float
    courses: Array


class _Likely(NamedTuple):
    """Gain in profile log-likelihood by the best course of every response (n,), places of that and of the drifts with and without it."""

    gain: Array
    course: NDArray[np.intp]
    drift: NDArray[np.intp]
    without: NDArray[np.intp]


@dataclass(frozen=True)
class _Trial:
    """Courses that a response may have on some points beside columns (points, p), under noise and drifts of many sizes."""

    courses: list[Course]
    drifts: list[_Drift]
    freedom: int

    @classmethod
    def of(cls, instants: Array, rows: NDArray[np.intp], beside: Array, courses: list[Course]) -> _Trial:
        """Courses on those rows of points whose cells have instants (points, cells), s."""
        laid = _laid(courses, instants[rows])
        # Places from 1 on: a drift that begins with the first point is level there.
        least, most = (one(rows[:, None], rows) + 1.0 for one in (np.minimum, np.maximum))
        smooth, drifts = least**2 * (3.0 * most - least) / 6.0, []
        for walk, rate in product(_WALKS, _SMOOTH):
            covariance = np.eye(rows.size) + walk * least + rate * smooth
            root = np.asarray(linalg.cholesky(covariance, lower=True))
            basis, triangle = np.linalg.qr(linalg.solve_triangular(root, beside[rows], lower=True))
            spread = 2.0 * float(np.log(np.abs(np.r_[np.diag(root), np.diag(triangle)])).sum())
            freed = _freed(root, basis, laid)
            freed /= np.linalg.norm(freed, axis=0) + 1e-9
            drifts.append(_Drift(covariance, root, basis, spread, freed))
        return cls(courses, drifts, rows.size - beside.shape[1])

    @cached_property
    def times(self) -> Array:
        """Begin and end of every course (2, courses), s."""
        return np.array([(one.onset_s, one.onset_s + one.duration_s) for one in self.courses]).T

    def likely(self, responses: Array, tried: NDArray[np.bool_] | slice = slice(None)) -> _Likely:
        """What the best of the tried courses gains in each of the responses (points, n), the size of all noise and drift free."""
        number = responses.shape[1]
        with_one, without = np.full((2, number), -np.inf)
        course, drift, drift_without = np.zeros((3, number), np.intp)
        places = np.arange(len(self.courses))[tried]
        for place, one in enumerate(self.drifts):
            left = _freed(one.root, one.basis, responses)
            square = np.einsum("ij,ij->j", left, left)
            explained = (one.courses[:, places].T @ left) ** 2
            best = explained.argmax(axis=0)
            rest = np.maximum(square - explained[best, np.arange(number)], 1e-12 * square) + np.finfo(float).tiny
            both = [
                -0.5 * (one.log_spread + self.freedom * np.log(each)) for each in (rest, square + np.finfo(float).tiny)
            ]
            better, better_without = both[0] > with_one, both[1] > without
            with_one[better], course[better], drift[better] = both[0][better], places[best[better]], place
            without[better_without], drift_without[better_without] = both[1][better_without], place
        return _Likely(with_one - without, course, drift, drift_without)

    @cached_property
    def _nulls(self) -> dict[int, Array]:
        return {}

    def p_value(self, gain: float, drift: int) -> float:
        """Probability of such a gain in a record of noise and this drift alone."""
        if drift not in self._nulls:
            root = self.drifts[drift].root
            drawn = np.random.default_rng(0).standard_normal((root.shape[0], DRAWS))
            self._nulls[drift] = self.likely(root @ drawn).gain
        return tail_probability(gain, self._nulls[drift])


class _Run:
    """A run of a record on points, on which changes are looked for that take longer than any window."""

    def __init__(self, cells: _Cells, first: int, end: int) -> None:
        self.cells = cells
        group = max(1, -(-(end - first) // _SLOW_POINTS))
        self.here, self.number = slice(first, first + (end - first) // group * group), (end - first) // group
        self.instants = cells.seconds[self.here].reshape(self.number, group)
        self.moved = cells.moved[self.here].reshape(self.number, group, -1).mean(axis=1)
        centred = self.moved - self.moved.mean(axis=0)
        self.beside = np.column_stack([np.ones(self.number), centred @ _leading(centred, self.number)])
        # Channels whose slow change is none of an event: what else is slow in them is not told from that.
        self.ignored = set[int]()
        self.found: dict[int, _Seen] = {}
        self.trials: dict[bytes, _Trial] = {}

    @property
    def span_s(self) -> float:
        """Time from the first to the last point."""
        return float(np.ptp(self.instants))

    def response(self) -> Array:
        """Displacements of every channel (points, channels), um."""
        values = self.cells.response[self.here].reshape(*self.instants.shape, -1)
        known = np.isfinite(values)
        count = known.sum(axis=1)
        return np.where(2 * count >= self.instants.shape[1], np.nansum(values, axis=1) / np.maximum(count, 1), np.nan)

    def slow_changes(self) -> list[_Seen]:
        """The most likely slow change of every channel."""
        for channel, response in enumerate(self.response().T):
            rows = np.flatnonzero(np.isfinite(response))
            if channel in self.found or channel in self.ignored or rows.size < _SLOW_LEAST:
                continue
            trial = self._trial(rows, self.beside)
            found = _Likely(*(one[0] for one in trial.likely(response[rows, None])))
            course = trial.courses[found.course]
            log_p = float(np.log(trial.p_value(float(found.gain), int(found.without))))
            at = self.here.start + int((course.onset_s - self.instants[0, 0]) / self.cells.step_s)
            self.found[channel] = _Seen(log_p, at, 0, 0, channel, course, self)
        return list(self.found.values())

    def _trial(self, rows: NDArray[np.intp], beside: Array) -> _Trial:
        if (key := rows.tobytes() + beside.tobytes()) not in self.trials:
            middle, courses = self.instants.mean(axis=1), []
            for duration in (share * self.span_s for share in _SLOW_DURATIONS):
                onsets = np.arange(
                    middle[2], middle[-3] - duration, max(_SLOW_ONSETS * duration, self.span_s / self.number)
                )
                courses += [Course(float(onset), duration, settles) for onset in onsets for settles in (False, True)]
            self.trials[key] = _Trial.of(self.instants, rows, beside, courses)
        return self.trials[key]

    def near(self, course: Course) -> list[Course]:
        """Courses like one, and changes at once."""
        middle, duration = self.instants.mean(axis=1), course.duration_s
        first, last = course.onset_s - _AROUND * duration, course.onset_s + _AROUND * duration
        onsets = np.linspace(max(first, middle[1]), min(last, middle[-3]), _ONSETS)
        shapes = ((False, 0.0), (True, 0.0), (True, 0.5))
        return [
            one
            for onset in onsets.tolist()
            for one in (
                Course(onset, 0.0),
                *(Course(onset, duration * factor, *shape) for shape in shapes for factor in _FACTORS.tolist()),
            )
        ]

    def look(self, seen: _Seen) -> tuple[_Look, NDArray[np.bool_]]:
        """The points of the run, with courses near that of a slow change, each channel under the drift that suits it best then, and the
        channels (channels,) that show it by themselves.
        """
        assert seen.course is not None
        response, covariances = self.response(), list[Array]()
        shown = np.zeros(response.shape[1], bool)
        for values in response.T:
            rows = np.flatnonzero(np.isfinite(values))
            covariance = np.eye(self.number)
            if rows.size >= _SLOW_LEAST:
                trial = self._trial(rows, self.beside)
                found = trial.likely(values[rows, None], np.array([one == seen.course for one in trial.courses]))
                shown[len(covariances)] = (
                    trial.p_value(float(found.gain[0]), int(found.without[0])) < RECORD_ENTRY_LEVEL
                )
                drift = trial.drifts[int(found.drift[0])]
                left = _freed(drift.root, drift.basis, values[rows, None])[:, 0]
                left -= drift.courses[:, found.course[0]] * float(drift.courses[:, found.course[0]] @ left)
                covariance[np.ix_(rows, rows)] = drift.covariance * float(left @ left) / (trial.freedom - 1)
            covariances.append(covariance)
        return _Look.of(self.instants, response, covariances, self.near(seen.course), self.beside), shown

    def load_that_changes(self, seen: _Seen) -> str:
        """A temperature or load that changes during a slow change as at no other time; empty where none does."""
        assert seen.course is not None
        names, every = self.cells.names, np.arange(self.number)
        trial = self._trial(every, np.ones((self.number, 1)))
        begin, end = trial.times
        apart = (end <= seen.course.onset_s) | (begin >= seen.course.onset_s + seen.course.duration_s)
        responses = self.moved[:, : len(names)]
        here, elsewhere = (trial.likely(responses, tried) for tried in (~apart, apart))
        for name, gain, other, drift in zip(names, here.gain, elsewhere.gain, here.without, strict=True):
            if gain > _MORE * other and trial.p_value(float(gain), int(drift)) * len(names) < RECORD_ENTRY_LEVEL:
                return name
        return ""

    def forget(self, channels: NDArray[np.bool_]) -> None:
        """Look again at some channels, which have changed."""
        for channel in np.flatnonzero(channels):
            self.found.pop(int(channel), None)


@dataclass(frozen=True)
class _Look:
    """Readings around a change, with the courses that it may have.

    Attributes
    ----------
    seconds, instants : middle of every point (points,), and of its cells (points, cells), s
    courses : tried ones; those with a part at once stand for any share of it
    gain : (courses, channels) in log-likelihood beside a level, under noise and a random walk of the channel's own size
    size : (courses, channels) um, of the whole change
    parts : (courses, channels) share of it that happened at once
    whitened : of every channel the points that it has, their covariance, um², the readings, um, and the columns beside the change
    """

    seconds: Array
    instants: Array
    spacing_s: float
    courses: list[Course]
    gain: Array
    size: Array
    parts: Array
    whitened: list[tuple[NDArray[np.intp], Array, Array, Array]]

    @classmethod
    def at(cls, cells: _Cells, left: Array, seen: _Seen, half: int) -> _Look | None:
        """Look at the readings within `half` cells of the window of a change, of its own run; None where they are too few."""
        known = np.isfinite(cells.seconds)
        first, last = seen.at, seen.at + seen.gap
        while first > max(0, seen.at - half) and known[first - 1]:
            first -= 1
        while last < min(known.size - 1, seen.at + seen.gap + half) and known[last + 1]:
            last += 1
        group = max(1, -(-(last + 1 - first) // _POINTS))
        number = (last + 1 - first) // group
        if number < _LEAST_POINTS:
            return None
        here = slice(first, first + number * group)
        seconds = cells.seconds[here].reshape(number, group)
        values = left[here].reshape(number, group, -1)
        with np.errstate(invalid="ignore"):
            values = values.sum(axis=1) / group
        spacing = group * cells.step_s
        width = number * spacing
        onsets = seconds.mean(axis=1)[2:-2] - 0.5 * cells.step_s
        if group > 1:
            onsets = np.sort(np.concatenate([onsets, onsets + 0.5 * spacing]))
        courses = [
            Course(float(onset), share * width, settles, at_once)
            for onset in onsets
            for settles, at_once in ((False, 0.0), (True, 0.0), (True, 0.5))
            for share in _DURATIONS
            if share * width >= 2.0 * spacing or not (share or settles)
        ]
        places, covariances = np.arange(number), []
        for channel in left.T:
            noise, walk = _noise_and_walk(channel, 2 * half)
            covariances.append(walk * group * np.minimum(places[:, None], places) + noise / group * np.eye(number))
        return cls.of(seconds, values, covariances, courses, np.ones((number, 1)))

    @classmethod
    def of(cls, seconds: Array, values: Array, covariances: list[Array], courses: list[Course], beside: Array) -> _Look:
        """Look at values (points, channels), whose cells have times (points, cells), beside columns (points, p)."""
        columns = _laid(courses, seconds)
        # Every onset stands for a change at once as well.
        is_step = np.array([not one.duration_s for one in courses])
        steps, onsets = columns[:, is_step], np.array([one.onset_s for one in courses])
        place = np.searchsorted(onsets[is_step], onsets)
        two = np.array([one.at_once > 0.0 for one in courses])
        gain, size, parts = (np.zeros((len(courses), values.shape[1])) for _ in range(3))
        whitened = []
        for k, response in enumerate(values.T):
            rows = np.flatnonzero(np.isfinite(response))
            covariance = covariances[k][np.ix_(rows, rows)]
            whitened.append((rows, covariance, response[rows], beside[rows]))
            if rows.size < _LEAST_POINTS:
                continue
            root: Array = np.asarray(np.linalg.cholesky(covariance), float)
            y, x, s = (_without(root, beside[rows], each[rows]) for each in (response[:, None], columns, steps))
            y = y[:, 0]
            own = np.einsum("ij,ij->j", x, x) + 1e-12
            size[:, k] = x.T @ y / own
            gain[:, k] = 0.5 * size[:, k] ** 2 * own
            # A part at once and a rest that settles: two columns.
            rest, now = 2.0 * x[:, two] - s[:, place[two]], s[:, place[two]]
            a, b, c = (np.einsum("ij,ij->j", u, v) for u, v in ((now, now), (now, rest), (rest, rest)))
            u, v, det = now.T @ y, rest.T @ y, np.maximum(a * c - b * b, 1e-12 * a * c + 1e-300)
            first_part, second = (c * u - b * v) / det, (a * v - b * u) / det
            both = first_part + second
            with np.errstate(divide="ignore", invalid="ignore"):
                parts[two, k] = first_part / both
            is_one_change = (parts[two, k] > 0.05) & (parts[two, k] < 0.95)
            size[two, k] = both
            gain[two, k] = np.where(is_one_change, 0.5 * (first_part * u + second * v), -np.inf)
            misfit = (y @ y - 2.0 * gain[:, k].max()) / max(1, rows.size - 3 - beside.shape[1])
            gain[:, k] /= max(1.0, misfit)
        middle = seconds.mean(axis=1)
        return cls(middle, seconds, float(np.median(np.diff(middle))), courses, gain, size, parts, whitened)

    def event(self, seen: _Seen, digits: Array, shown: NDArray[np.bool_] | Literal[True] = True) -> Event | None:
        """Onset, duration and size of a change in the channels that show it, out of some; None where that which shows it most does not, or
        where it has no onset here.
        """
        size, u = self.sizes(self.best([seen.channel]))
        part = (np.abs(size) > _TAKES_PART * u) & (np.abs(size) > digits) & shown
        if not part[seen.channel]:
            return None
        channels = list(np.flatnonzero(part))
        best = self.best(channels)
        size, u = self.sizes(best)
        onset, duration, u_course = self.intervals(best, channels)
        # What began before the first onset that was tried has no onset here, and what settles from the first readings on is a warm-up.
        settled_s = best.duration_s / _TIME_CONSTANTS if best.settles else 0.0
        if onset.low <= self.courses[0].onset_s or onset.value < self.instants[0, 0] + settled_s:
            return None
        # Courses that fit nearly as well may have sizes that are far apart.
        u = np.hypot(u, u_course)
        part &= np.abs(size) > 2.0 * u
        if not part[seen.channel]:
            return None
        return Event(
            columns=np.empty((0, 1)),
            parameters={"time_s": onset.value, "duration_min": duration.value / 60.0, "course": best.words},
            units=("um",),
            event_s=onset.value,
            course=best,
            onset=onset,
            duration=duration,
            size=np.where(part, size, 0.0),
            size_u=np.where(part, u, 0.0),
            p_value=min(1.0, float(np.exp(seen.log_p))),
            answer=self.answer(best, seen.channel),
        )

    def best(self, channels: list[int]) -> Course:
        """The course that fits these channels best, with the share at once that the one which shows it most has."""
        parts = np.array([one.at_once > 0.0 for one in self.courses])
        number = int(np.argmax(self.gain[:, channels].sum(axis=1) - _SECOND_PART * parts))
        course = self.courses[number]
        if not course.at_once:
            return course
        strongest = channels[int(np.argmax(self.gain[number, channels]))]
        return course._replace(at_once=float(self.parts[number, strongest]))

    def sizes(self, course: Course, every: slice = slice(None)) -> tuple[Array, Array]:
        """Size of a course in every channel by these points, and its standard uncertainty, um; infinite where they are too few."""
        size, u = np.zeros(len(self.whitened)), np.full(len(self.whitened), np.inf)
        shares = course.at(self.instants.ravel()).reshape(self.instants.shape).mean(axis=1)
        for k, (rows, covariance, response, beside) in enumerate(self.whitened):
            some = np.arange(rows.size)[every]
            if some.size < _LEAST_POINTS + beside.shape[1] - 1:
                continue
            root = np.linalg.cholesky(covariance[np.ix_(some, some)])
            y, x = (_without(root, beside[some], each[:, None])[:, 0] for each in (response[some], shares[rows[some]]))
            own = float(x @ x)
            size[k] = float(x @ y) / max(own, 1e-12)
            misfit = float(((y - size[k] * x) ** 2).sum()) / (some.size - 1 - beside.shape[1])
            u[k] = np.sqrt(max(1.0, misfit) / own) if own > 1e-9 else np.inf
        return size, u

    def intervals(self, best: Course, channels: list[int]) -> tuple[Interval, Interval, Array]:
        """Onset and duration, s, with all values that fit nearly as well, and what these leave open of the sizes, um."""
        total = self.gain[:, channels].sum(axis=1)
        fits = total >= total.max() - _WITHIN
        weights = np.exp(total[fits] - total.max())
        middle = np.average(self.size[fits], axis=0, weights=weights)
        u = np.sqrt(np.average((self.size[fits] - middle) ** 2, axis=0, weights=weights))
        tried, lasting = (np.array([getattr(one, name) for one in self.courses]) for name in ("onset_s", "duration_s"))
        onsets, all_onsets, durations, all_durations = tried[fits], np.unique(tried), lasting[fits], np.unique(lasting)

        def beside(values: Array, edge: float, by: int) -> float:
            return float(values[np.clip(np.searchsorted(values, edge) + by, 0, values.size - 1)])

        onset = Interval(best.onset_s, beside(all_onsets, onsets.min(), -1), beside(all_onsets, onsets.max(), 1))
        shortest = beside(all_durations, durations.min(), -1) if durations.min() else 0.0
        longest = beside(all_durations, durations.max(), 1) if durations.max() < all_durations[-1] else np.inf
        return onset, Interval(best.duration_s, shortest, longest), u

    def answer(self, course: Course, channel: int) -> Answer:
        """What every other point says of the size of a change in a channel that the points between show."""
        (size, u), (other, other_u) = (
            [float(one[channel]) for one in self.sizes(course, slice(k, None, 2))] for k in (0, 1)
        )
        if not np.isfinite(u + other_u) or not size:
            return Answer(where=_EVERY_OTHER)
        slope = other / size
        return Answer(
            slope, float(np.hypot(other_u, slope * u)) / abs(size), self.seconds.size // 2, where=_EVERY_OTHER
        )


def _is_a_course(events: list[Event]) -> NDArray[np.bool_]:
    """Channels (channels,) in which changes without a sudden part lie over one another: a smooth course can be made of any such."""
    slow = sorted((one for one in events if one.duration.value and not one.course.at_once), key=lambda one: one.onset)
    over = np.zeros(events[0].size.size, bool)
    for place, one in enumerate(slow):
        ends = one.onset.value + one.duration.value
        over |= np.any(
            [(one.size != 0.0) & (two.size != 0.0) for two in slow[place + 1 :] if two.onset.value < ends], axis=0
        )
    return over


def _lasting(events: list[Event]) -> list[Event]:
    """The events that no other takes back: what returns is no lasting change, and a wrong one is made good by the next look."""

    def is_taken_back(one: Event) -> bool:
        return any(
            abs(other.onset.value - one.onset.value) <= max(one.duration.value, other.duration.value)
            and np.sum((other.size + one.size) ** 2) < _TAKEN_BACK * np.sum(one.size**2)
            for other in events
        )

    return [one for one in events if not is_taken_back(one)]


def _is_settled(
    shorter: tuple[_Look, Course, Array, Array], longer: tuple[_Look, Course, Array, Array], channel: int
) -> bool:
    """Whether a longer look at a change makes it no larger."""
    looked, course, size, u = shorter
    room = course.duration_s < 0.3 * looked.seconds.size * looked.spacing_s
    return room and bool(np.abs(longer[2] - size)[channel] < _SAME_SIZE * max(u[channel], longer[3][channel]))


def _changes(values: Array, gap: int, mean: int) -> Array:
    """Mean of `mean` cells after a gap less that of as many before it (windows, columns); NaN where half of either is missing."""
    known = np.isfinite(values)
    zero = np.zeros((1, values.shape[1]))
    total = np.concatenate([zero, np.cumsum(np.where(known, values, 0.0), axis=0)])
    count = np.concatenate([zero, np.cumsum(known, axis=0)])
    total, count = total[mean:] - total[:-mean], count[mean:] - count[:-mean]
    mean_of = np.where(count >= 0.5 * mean, total / np.maximum(count, 1.0), np.nan)
    return np.asarray(mean_of[gap + mean :] - mean_of[: mean_of.shape[0] - gap - mean])


def _leading(moved: Array, windows: float) -> Array:
    """Leading combinations (columns, kept) of the changes (n, columns) of temperatures and loads, no more than the windows determine."""
    some = moved[:: max(1, len(moved) // _ROWS)]
    spread = some.std(axis=0)
    weights = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > 1e-12)
    _, size, directions = np.linalg.svd(some * weights, full_matrices=False)
    kept = min(int(windows / _PER_COLUMN), int((size > 1e-6 * max(float(size[0]), 1e-300)).sum()))
    return np.asarray(weights[:, None] * directions[:kept].T)


def _robust_slopes(changes: Array, courses: Array) -> Array:
    """Slopes (columns,) of changes (n,) against those of temperatures and loads (n, columns), beside a rate (Huber)."""
    some = slice(None, None, max(1, changes.size // _ROWS))
    y, design = changes[some], np.column_stack([courses[some], np.ones(changes[some].size)])
    weights, slopes = np.ones(y.size), np.zeros(design.shape[1])
    for _ in range(_ITERATIONS):
        weighted = design * weights[:, None]
        slopes = np.linalg.lstsq(weighted.T @ design, weighted.T @ y, rcond=None)[0]
        left = np.abs(y - design @ slopes)
        weights = np.minimum(1.0, _HUBER * MAD_TO_SIGMA * float(np.median(left)) / np.maximum(left, 1e-300))
    return np.asarray(slopes[:-1])


def _log_p(excursions: Array, width: int) -> tuple[int, float]:
    """Place of the largest of many excursions, and the logarithm of the probability that any is as large.

    The largest of every window of `width` are taken as independent. Beyond their median they are exponential, whose scale is estimated
    without the largest ones, which may be events (type II censoring, Epstein and Sobel 1953); a further one is then Lomax distributed.
    """
    excursions = excursions**_TAIL
    windows = excursions.size // width
    padded = np.nan_to_num(excursions[: windows * width], nan=-1.0).reshape(windows, width).max(axis=1)
    largest = np.sort(padded[padded >= 0.0])[::-1]
    at = int(np.nanargmax(excursions)) if np.isfinite(excursions).any() else 0
    above = largest.size // 2
    censored = max(_CENSORED, int(_CENSORED_SHARE * largest.size))
    freedom = above - censored
    if freedom < _LEAST_FREEDOM:
        return at, 0.0
    median = largest[above]
    beyond = largest[:above] - median
    scale = (beyond[censored:].sum() + censored * beyond[censored]) / freedom
    if scale <= 0.0:
        return at, 0.0
    return at, float(np.log(above) - freedom * np.log1p((excursions[at] - median) / (freedom * scale)))


def _noise_and_walk(values: Array, longest: int) -> tuple[float, float]:
    """Variances of a reading's noise and of a random walk's step from cell to cell, by the medians of changes over several times."""
    lags = np.unique(np.geomspace(1, max(2, min(longest, values.size // 4)), 8).astype(int))
    variances = []
    for lag in lags:
        changes = np.abs(values[lag:] - values[:-lag])
        changes = changes[np.isfinite(changes)]
        variances.append((MAD_TO_SIGMA * float(np.median(changes))) ** 2 if changes.size else np.nan)
    known = np.isfinite(variances) & (np.asarray(variances) > 0.0)
    if not known.any():
        return 1e-12, 1e-12
    variance, lags = np.asarray(variances)[known], lags[known]
    noise, walk = optimize.nnls(np.column_stack([2.0 / variance, lags / variance]), np.ones(variance.size))[0]
    least = 1e-3 * float(variance.min())
    return max(float(noise), least), max(float(walk), least / longest)


def _without(root: Array, beside: Array, columns: Array) -> Array:
    """Columns (points, n) whitened by the root of their covariance, without what others (points, p) explain of them."""
    basis = np.linalg.qr(linalg.solve_triangular(root, beside, lower=True))[0]
    return _freed(root, basis, columns)


def _freed(root: Array, basis: Array, columns: Array) -> Array:
    """Columns (points, n) whitened by the root of their covariance, without what an orthonormal basis (points, p) explains of them."""
    laid = linalg.solve_triangular(root, columns, lower=True)
    return np.asarray(laid - basis @ (basis.T @ laid))


def _laid(courses: list[Course], instants: Array) -> Array:
    """Shares of every course on points whose cells have instants (points, cells), s (points, courses)."""
    return np.column_stack([one.at(instants.ravel()).reshape(instants.shape).mean(axis=1) for one in courses])
