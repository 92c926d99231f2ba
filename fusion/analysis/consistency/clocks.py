"""Which clock is the odd one: every two recordings of a test are held against each other, and the one that contradicts the others is named.

Clocks are wrong by time zones, summer time and hours mistaken, so by quarters of an hour. Every piece of evidence says which lateness of
one recording against another it contradicts. The clock of a recording is named where moving it, and it alone, leaves no contradiction.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.alignment.align import covered_share
from fusion.analysis.consistency.checks import Check, Severity, judge
from fusion.common import Array

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
#: What a wrong clock makes doubtful by itself: checks that wait until it is right.
_WAITING = (
    *("environment_coverage", "drivers_coverage", "sensors_coverage", "frames_coverage", "frames_gaps", "camera_phase"),
    *("camera_rate", "material_course", "material_still", "material_rise", "environment_columns", "sensors_rise"),
    *("expansion_coefficient", "sensitivity", "axis_line"),
)
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

    def moved(self, quarters: int) -> str:
        """What the campaign file has to say where the clock is late by quarters of an hour more."""
        return f'{self.key} = "{self.offset_s + QUARTER_S * quarters:g} s" under [{self.table}]'

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


def check_clocks(recordings: Sequence[Recording], compared: Sequence[Evidence] = ()) -> list[Check]:
    """Check the clocks of all recordings of a test against each other, by their times and by `compared` courses."""
    known = [one for one in recordings if one.sorted.size]
    if len(known) < 2:
        return []
    gathered = [*_of_times(known), *compared]
    evidence = [one for one in gathered if not _outvoted(one, gathered)]
    against = [one for one in evidence if one.cost[_ZERO] > 1.0]
    late: dict[str, list[int]] = {}
    if sum(one.weight for one in against) >= _ENOUGH:
        late = {one.name: quarters for one in known if (quarters := _lateness(one.name, evidence))}
    odd = next(iter(late)) if len(late) == 1 else None
    checks = [
        _named(one, late[odd], known, against) if one.name == odd else _sound(one, evidence, noticed=bool(against))
        for one in known
    ]
    return [*checks, _undecided(known, late, against, odd)]


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


def _words(quarters: int) -> str:
    """A lateness as it is read."""
    minutes = 15 * abs(quarters)
    return f"{f'{minutes / 60:g} h' if minutes % 60 == 0 else f'{minutes} min'} {'late' if quarters > 0 else 'early'}"


def _named(odd: Recording, possible: Sequence[int], known: Sequence[Recording], against: Sequence[Evidence]) -> Check:
    """The doubt of the one clock that contradicts the others."""
    quarters, *others_possible = possible
    fit = f" ({', '.join(_words(k) for k in others_possible[:2])} would do as well)" if others_possible else ""
    why = _by_file(known, against, odd=odd.name)
    *first, last = (one.file for one in known if one.name != odd.name)
    return judge(
        f"{odd.name}_clock",
        15.0 * quarters,
        0.0,
        f"The clock of {odd.file} is {_words(quarters)}{fit}: so taken, it agrees with {', '.join(first)} and {last}, which agree among "
        "themselves; "
        f"as it stands, it contradicts {why}.",
        f"Check clock and time zone of {odd.file}; to take its clock as {_words(quarters)}, write {odd.moved(quarters)}. Leave the other "
        "files as they are.",
        passed=False,
    )


def _by_file(known: Sequence[Recording], against: Sequence[Evidence], *, odd: str) -> str:
    """The other recordings that one contradicts, each with what shows it."""
    shown = {
        one.file: dict.fromkeys(each.what for each in against if {each.first, each.second} == {odd, one.name})
        for one in known
        if one.name != odd
    }
    return "; ".join(f"{file} ({', '.join(whats)})" for file, whats in shown.items() if whats)


def _sound(one: Recording, evidence: Sequence[Evidence], *, noticed: bool) -> Check:
    """The passed check of a clock, with what it could have shown."""
    told = all(
        sum(each.weight for each in evidence if each.cost[each.at(one.name, hour)] > 1.0) >= _ENOUGH
        for hour in (-_HOUR, _HOUR)
    )
    if noticed:
        return judge(
            f"{one.name}_clock", 0.0, 0.0, f"The clock of {one.file} is not the one that contradicts the others."
        )
    limits = (
        "one of an hour would have been" if told else "whether it is an hour off cannot be told from these recordings"
    )
    return judge(f"{one.name}_clock", 0.0, 0.0, f"No clock offset of {one.file} detected; {limits}.")


def _undecided(
    known: Sequence[Recording], late: dict[str, list[int]], against: Sequence[Evidence], odd: str | None
) -> Check:
    """Whether clocks disagree of which none can be named."""
    files = {one.name: one.file for one in known}
    if odd is not None:
        return judge("clocks", 0.0, 0.0, f"That of {files[odd]} is the only clock that contradicts the others.")
    if sum(one.weight for one in against) < _ENOUGH:
        return judge("clocks", 0.0, 0.0, f"The clocks of {', '.join(files.values())} do not contradict one another.")
    between = {
        (one.first, one.second): [each.what for each in against if (each.first, each.second) == (one.first, one.second)]
        for one in against
    }
    pairs = [f"{files[first]} and {files[second]} ({', '.join(whats)})" for (first, second), whats in between.items()]
    possible = [one for one in known if one.name in late]
    either = " or ".join(f"{one.file} is taken as {_words(late[one.name][0])}" for one in possible)
    keys = " or ".join(one.moved(late[one.name][0]) for one in possible)
    which = (
        f"they agree where {either}, and no other recording decides which" if either else "no single clock explains it"
    )
    named = [one.file for one in known if any(one.name in pair for pair in between)]
    return judge(
        "clocks",
        15.0 * max((abs(likeliest) for likeliest, *_ in late.values()), default=0),
        0.0,
        f"The clocks disagree: {'; '.join(pairs)}: {which}.",
        f"Check clocks and time zones of {' and '.join(named)}{f'; then write {keys}' if keys else ''}.",
        passed=False,
    )


def without_consequences(checks: Sequence[Check], accepted: Collection[str] = ()) -> list[Check]:
    """Leave out what cannot be judged until a doubted clock is right; a refusal among it is that of the clock."""
    latest = list({check.code: check for check in checks}.values())
    doubted = [check for check in latest if is_doubted_clock(check) and check.code not in accepted]
    if not doubted:
        return latest
    waiting = [check for check in latest if check.code in _WAITING and not check.passed]
    if waiting:
        severity = max((check.severity for check in waiting), key=list(Severity).index)
        codes = f" To be judged when the clocks are right: {', '.join(check.code for check in waiting)}."
        latest = [
            replace(one, severity=severity, evidence=one.evidence + codes) if one in doubted else one for one in latest
        ]
    return [check for check in latest if check not in waiting]


def is_doubted_clock(check: Check) -> bool:
    """Whether a check says that a clock is wrong."""
    return not check.passed and (check.code == "clocks" or check.code.endswith("_clock"))
