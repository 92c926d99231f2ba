"""Which clock is the odd one: every two recordings of a test are held against each other, and the one that contradicts the others is named.

Clocks are wrong by time zones, summer time and hours mistaken, so by quarters of an hour. Every piece of evidence says which lateness of
one recording against another it contradicts. The clock of a recording is named where moving it, and it alone, leaves no contradiction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.alignment.align import covered_share
from fusion.analysis.consistency.checks import CLOCK, LOG, Found, Rule, judge
from fusion.common import Array
from fusion.results.parts import Figures

#: Lateness that is tried, in quarters of an hour: as far as time zones lie apart; a log of another day is no clock's doing.
QUARTERS = np.arange(-56, 57)
QUARTER_S = 900.0
#: First and last times agree within a step of the slower recording, at least within the first and at most within the second, s.
_SAME_ENDS_S = (120.0, 300.0)
#: Share of the readings that a recording has to cover, and that it covers on the right clock.
_LEAST_COVERED, _COVERED_SHIFTED = 0.9, 0.95
#: Weight of the evidence that has to contradict the stated clocks; that of times alone is 1, as loggers are started by hand.
_ENOUGH, TIMES, COURSES = 2.0, 1.0, 2.0
#: Lateness by which it is said whether a wrong clock would have been noticed: an hour.
_HOUR = 4
#: Notices whose remedy follows from a wrong clock alone.
FOLLOWING_NOTICES = ("readings_outside_frames", "frames_outside_cycles")


@dataclass(frozen=True)
class Recording:
    """One recording of a test.

    Attributes
    ----------
    name : that of its check, before ``_clock``
    file : as messages name it
    times : on the stated clock
    table, key : of the campaign file, that move the clock
    offset_s : that it states already, s
    """

    name: str
    file: str
    times: NDArray[np.datetime64]
    table: str
    key: str = "clock_offset"
    offset_s: float = 0.0

    @property
    def sorted(self) -> NDArray[np.datetime64]:
        """All known times in their order."""
        known: NDArray[np.datetime64] = np.sort(self.times[~np.isnat(self.times)].astype("datetime64[ns]"))
        return known


@dataclass(frozen=True)
class Evidence:
    """What two recordings say of how late the second is against the first.

    Attributes
    ----------
    first, second : names of the recordings
    cost : over `QUARTERS`, above 1 where that lateness is contradicted
    near : over `QUARTERS`, by how much worse it is than the best, without tolerance for the delays of physics
    weight : of a contradiction
    what : is compared
    """

    first: str
    second: str
    cost: Array
    near: Array
    weight: float
    what: str

    def at(self, recording: str, quarters: int) -> int:
        """Place in `cost` where a recording is taken as late by quarters of an hour, and the others are right."""
        return _ZERO + quarters * ((recording == self.second) - (recording == self.first))


_ZERO = int(np.flatnonzero(QUARTERS == 0)[0])


def compare_clocks(recordings: Sequence[Recording], compared: Sequence[Evidence] = ()) -> dict[str, Found]:
    """Compare the clocks of all recordings of a test, by their times and by `compared` courses; what is found of each, by its check."""
    known = [one for one in recordings if one.sorted.size]
    if len(known) < 2:
        return {}
    gathered = [*_of_times(known), *compared]
    evidence = [one for one in gathered if not _outvoted(one, gathered)]
    against = [one for one in evidence if one.cost[_ZERO] > 1.0]
    late: dict[str, list[int]] = {}
    if sum(one.weight for one in against) >= _ENOUGH:
        late = {one.name: quarters for one in known if (quarters := _lateness(one.name, evidence))}
    odd = next(iter(late)) if len(late) == 1 else None
    found = {
        f"{one.name}_clock": _named(one, late[odd], known, against)
        if one.name == odd
        else _sound(one, evidence, noticed=bool(against))
        for one in known
    }
    return {**found, "clocks": _undecided(known, late, against, odd)}


def _outvoted(one: Evidence, evidence: Sequence[Evidence]) -> bool:
    """Whether the stated clocks are contradicted by one kind of evidence of two recordings, and confirmed by two others: an effect
    that nobody declared looks like a delay.
    """
    admitted = one.cost <= 1.0
    others = [each for each in evidence if each is not one and (each.first, each.second) == (one.first, one.second)]
    confirming = [each for each in others if not admitted[_ZERO] and (each.cost[admitted] > 1.0).all()]
    return sum(bool(each.cost[_ZERO] <= 1.0) for each in confirming) >= _ENOUGH


def _lateness(name: str, evidence: Sequence[Evidence]) -> list[int]:
    """Quarters of an hour by which a recording alone may be late for all evidence to agree, the likeliest first."""
    admitted = [
        int(quarters)
        for quarters in QUARTERS
        if quarters and all(one.cost[one.at(name, int(quarters))] <= 1.0 for one in evidence)
    ]
    return sorted(admitted, key=lambda k: (sum(one.near[one.at(name, k)] for one in evidence), abs(k)))


def _of_times(recordings: Sequence[Recording]) -> Iterator[Evidence]:
    """What the times alone say: recordings that begin and end together, and those that do not cover the readings."""
    # A recording of one moment has no ends.
    for one, other in combinations([each for each in recordings if each.sorted.size > 1], 2):
        ends = (other.sorted[[0, -1]] - one.sorted[[0, -1]]) / np.timedelta64(1, "s")
        quarters = round(float(ends.mean()) / QUARTER_S)
        steps = [float(np.median(np.diff(times.sorted) / np.timedelta64(1, "s"))) for times in (one, other)]
        apart = float(np.abs(ends - QUARTER_S * quarters).max())
        if apart <= np.clip(max(steps), *_SAME_ENDS_S) and abs(quarters) <= QUARTERS[-1]:
            cost = np.where(quarters == QUARTERS, 0.0, 2.0)
            yield Evidence(one.name, other.name, cost, cost, TIMES, "first and last times")
        if one.name == "laser":
            covered = np.array([covered_share(one.sorted, other.sorted, late_s=QUARTER_S * k) for k in QUARTERS])
            if covered.max() >= _COVERED_SHIFTED:
                cost = np.where(covered >= _LEAST_COVERED, 0.0, 2.0)
                yield Evidence(one.name, other.name, cost, 1.0 - covered, TIMES, "readings covered")


def _named(odd: Recording, possible: Sequence[int], known: Sequence[Recording], against: Sequence[Evidence]) -> Found:
    """The doubt of the one clock that contradicts the others."""
    others = [one for one in known if one is not odd]
    shown = {one.file: _whats(against, odd.name, one.name) for one in others}
    agreeing = [one.file for one in others]
    return judge(15.0 * possible[0], 0.0, passed=False, odd=odd, possible=possible, shown=shown, agreeing=agreeing)


def _whats(against: Sequence[Evidence], *names: str) -> list[str]:
    """What two recordings contradict each other in."""
    return list(dict.fromkeys(one.what for one in against if {one.first, one.second} == {*names}))


def _sound(one: Recording, evidence: Sequence[Evidence], *, noticed: bool) -> Found:
    """The passed check of a clock, with what it could have shown."""
    told = all(
        sum(each.weight for each in evidence if each.cost[each.at(one.name, hour)] > 1.0) >= _ENOUGH
        for hour in (-_HOUR, _HOUR)
    )
    return judge(0.0, 0.0, odd=one, noticed=noticed, told=told)


def _undecided(
    known: Sequence[Recording], late: dict[str, list[int]], against: Sequence[Evidence], odd: str | None
) -> Found:
    """Whether clocks disagree of which none can be named."""
    files = {one.name: one.file for one in known}
    passed = odd is not None or sum(one.weight for one in against) < _ENOUGH
    pairs = dict.fromkeys((one.first, one.second) for one in against)
    named = {name for pair in pairs for name in pair}
    return judge(
        0.0 if passed else 15.0 * max((abs(likeliest) for likeliest, *_ in late.values()), default=0),
        0.0,
        passed=passed,
        alone=None if odd is None else files[odd],
        files=list(files.values()),
        pairs=[(files[first], files[second], _whats(against, first, second)) for first, second in pairs],
        possible=[(one, late[one.name][0]) for one in known if one.name in late],
        named=[one.file for one in known if one.name in named],
    )


def _clock(code: str, figures: tuple[Figures, ...]) -> Rule:
    """The check of one clock, of what all recordings together show."""

    def find(clocks: Mapping[str, Found]) -> Found | None:
        """Every two recordings, at every quarter of an hour up to 14 h ([below](#inconsistent-clocks)): doubted where evidence of weight
        `_ENOUGH` contradicts the stated clocks, and this one moved alone ends every contradiction; `clocks` where several could be that
        one, or none; a contradiction where it leaves so few common times that a coverage would refuse.
        """
        return clocks.get(code)

    return Rule(code, "clocks", figures, find)


LASER_CLOCK = _clock("laser_clock", CLOCK)
CAMERA_CLOCK = _clock("camera_clock", CLOCK)
ENVIRONMENT_CLOCK = _clock("environment_clock", LOG)
DRIVERS_CLOCK = _clock("drivers_clock", LOG)
SENSORS_CLOCK = _clock("sensors_clock", CLOCK)
CLOCKS = _clock("clocks", CLOCK)
