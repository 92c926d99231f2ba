"""Health of temperature sensors before any model: each one is predicted from the others, from the loads and from its own past.

What a sensor does beyond that prediction is held against its own record. A fault is one excursion far above everything else the sensor
does in the same time; what a machine does, its switchings included, comes back with similar size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import sample_noise
from fusion.alignment.sensor_changes import (
    Excursion,
    Grid,
    Ramp,
    fit_ramp,
    largest_excursion,
    lay_grid,
    level_beyond_prediction,
    predicted_changes,
)

#: Probability of naming any sensor of a sound record.
FAMILY_LEVEL = 0.01
#: Power with which the distribution of a sound sensor's largest excursions falls at the slowest: Student's t with 4 degrees of freedom.
TAIL_INDEX = 4.0
#: Readings outside are none, degC: colder than any shop, hotter than a motor winding of class H may be (180 degC, IEC 60085).
PLAUSIBLE_DEGC = (-40.0, 200.0)
#: Implausible readings in a row that are no single error of transmission.
_LEAST_IMPLAUSIBLE = 3
#: A signal ends where the last share of the record is missing.
_ENDED_SHARE = 0.02
#: Equal readings in a row from which a sensor may stick.
_LEAST_REPEATED = 20
#: A sensor finer than its noise repeats a reading this often in a row at most.
_ORDINARY_RUN = 3
#: The others move where the sensor's prediction moves by so many times what the prediction misses otherwise (95 %).
_MOVES = 3.0
#: Share of what past and loads leave of a sensor's changes that the others predict: below, what it does alone may be true.
_PREDICTABLE = 0.5
#: Excursion of another sensor over its next largest that counts as its response to a source beside the suspected sensor.
_RESPONSE = 2.0
#: A switching is no excuse for what exceeds the response to so many others.
_LEAST_SWITCHINGS = 3
#: A change within two samples that are at most so far apart is faster than any part of a machine warms, s.
_FAST_S = 60.0
#: Windows in which the noise of a sensor is compared, and fewest on either side of its change.
_NOISE_WINDOWS, _LEAST_NOISE_WINDOWS = 24, 3
#: Fewest samples of such a window.
_NOISE_SAMPLES = 20
#: Quietest window after over noisiest window before that makes a sensor suspected.
_NOISIER = 3.0
#: Fewest blocks that anything is told from.
_LEAST_BLOCKS = 60


class Kind(StrEnum):
    """What a sensor does."""

    NO_SIGNAL = "no signal"
    STUCK = "stuck"
    JUMP = "jump"
    RAMP = "ramp"
    NOISE = "noise"


@dataclass(frozen=True)
class SensorFault:
    """What is wrong with a sensor, or may be.

    Attributes
    ----------
    sensor : int
        Place among the sensors.
    kind : Kind
        What it does.
    is_clear : bool
        Whether nothing that a machine does looks like it; else the sensor is suspected.
    onset_s, onset_u_s : float, s
        When it began, since the first sample, and the standard uncertainty of that.
    size : float
        Change beyond the prediction, K; of noise its ratio, 1; nan of a signal that is none.
    ratio, limit : float
        Excursion over the next largest of the sensor, and the limit; nan where none is compared.
    reason : str
        Why it is only suspected; empty where it is clear.
    """

    sensor: int
    kind: Kind
    is_clear: bool
    onset_s: float
    onset_u_s: float
    size: float
    ratio: float = np.nan
    limit: float = np.nan
    reason: str = ""

    @property
    def words(self) -> str:
        """What the sensor does and from when on, as it follows its name."""
        return describe_fault(self.kind, self.size if np.isfinite(self.size) else None, self.onset_s, self.onset_u_s)


def describe_fault(kind: str, size: float | None, onset_s: float | None, onset_u_s: float | None) -> str:
    """Return what a sensor does and from when on, as it follows the sensor's name.

    Parameters
    ----------
    kind : str
        One of :class:`Kind`.
    size : float or None, K
        Change; of noise its ratio; None where there is no signal.
    onset_s, onset_u_s : float or None, s
        When it began, and the standard uncertainty of that.
    """
    told = f"{abs(size or 0.0):.2g}"
    words = {
        Kind.NO_SIGNAL: "gives no signal",
        Kind.STUCK: "repeats one reading",
        Kind.JUMP: f"jumps by {told} K",
        Kind.RAMP: f"ramps by {told} K",
        Kind.NOISE: f"has {told} times its noise",
    }
    onset_h, onset_u_h = (onset_s or 0.0) / 3600.0, (onset_u_s or 0.0) / 3600.0
    return f"{words[Kind(kind)]} from {onset_h:.2f} h on (standard uncertainty {onset_u_h:.1g} h)"


def excursion_limit(tests: int) -> float:
    """Ratio of the largest excursion to the next that a sound record exceeds with probability :data:`FAMILY_LEVEL`.

    Parameters
    ----------
    tests : int
        Number of sensors times number of durations.

    Returns
    -------
    float

    Notes
    -----
    Where P(X > x) falls as x^-a, the ratio of the two largest of any number of independent values exceeds r with probability r^-a (Renyi
    1953, Acta Math. Acad. Sci. Hung. 4, 191). Lighter tails exceed it less often.
    """
    return float((tests / FAMILY_LEVEL) ** (1.0 / TAIL_INDEX))


def examine_sensors(seconds: Array, temperature: Array, drivers: Array | None = None) -> list[SensorFault]:
    """Examine temperature sensors.

    Parameters
    ----------
    seconds : (n,) ndarray, s
        Times, increasing.
    temperature : (n, sensors) ndarray, degC
        Readings; NaN where there is none.
    drivers : (n, k) ndarray, optional
        Logged loads, in any unit; what follows their switchings is no fault.

    Returns
    -------
    list of SensorFault
        At most one per sensor, in the order of the sensors; empty where too little was logged to tell.

    Notes
    -----
    docs/method/sensor-health.md.
    """
    if seconds.size < _LEAST_BLOCKS or temperature.shape[1] == 0:
        return []
    lost = _without_signal(seconds, temperature)
    kept = [k for k in range(temperature.shape[1]) if k not in {fault.sensor for fault in lost}]
    plausible = np.where(_implausible(temperature), np.nan, temperature)
    kept = [k for k in kept if np.isfinite(plausible[:, k]).sum() >= _LEAST_BLOCKS]
    grids = lay_grid(seconds, plausible, drivers)
    if not kept or grids is None:
        return lost
    faults = [*lost, *_stuck(seconds, plausible, grids[-1], kept)]
    kept = [k for k in kept if k not in {fault.sensor for fault in faults}]
    faults += _changed(grids, kept)
    named = {fault.sensor for fault in faults}
    faults += [fault for fault in _noisier(seconds, plausible, grids[-1], kept) if fault.sensor not in named]
    return sorted(faults, key=lambda fault: fault.sensor)


def _implausible(temperature: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return (temperature < PLAUSIBLE_DEGC[0]) | (temperature > PLAUSIBLE_DEGC[1])


def _without_signal(seconds: Array, temperature: Array) -> list[SensorFault]:
    """Sensors whose readings are none for a while, or end before the record does."""
    step = float(np.median(np.diff(seconds)))
    faults = []
    for k in range(temperature.shape[1]):
        outside = _implausible(temperature[:, k])
        length, first, _ = _longest_run(outside.astype(float), wanted=1.0)
        readings = np.flatnonzero(np.isfinite(temperature[:, k]))
        if length >= _LEAST_IMPLAUSIBLE:
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, float(seconds[first]), step, np.nan))
        elif readings.size and seconds[-1] - seconds[readings[-1]] > _ENDED_SHARE * (seconds[-1] - seconds[0]):
            faults.append(SensorFault(k, Kind.NO_SIGNAL, True, float(seconds[readings[-1]]) + step, step, np.nan))
    return faults


def _longest_run(values: Array, wanted: float | None = None) -> tuple[int, int, int]:
    """Length of the longest run of equal values (of one value, where it is wanted), its first place, and the length of the next longest."""
    if values.size == 0:
        return 0, 0, 0
    starts = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    lengths = np.diff(np.r_[starts, values.size])
    if wanted is not None:
        chosen = values[starts] == wanted
        starts, lengths = starts[chosen], lengths[chosen]
    if lengths.size == 0:
        return 0, 0, 0
    longest = int(lengths.argmax())
    rest = np.delete(lengths, longest)
    return int(lengths[longest]), int(starts[longest]), int(rest.max(initial=0))


def _stuck(seconds: Array, temperature: Array, grid: Grid, kept: Sequence[int]) -> list[SensorFault]:
    """Sensors that repeat one reading to the last digit far longer than ever before, while the others move."""
    limit = excursion_limit(len(kept))
    faults = []
    for k in kept:
        known = np.flatnonzero(np.isfinite(temperature[:, k]))
        length, first, ordinary = _longest_run(temperature[known, k])
        if length < max(_LEAST_REPEATED, limit * ordinary):
            continue
        run = known[first : first + length]
        others = [j for j in kept if j != k]
        repeating = [bool(np.ptp(temperature[run, j]) == 0.0) for j in others]
        # A logger that stands still repeats all of them.
        if others and np.mean(repeating) >= 0.5:
            continue
        first_s, last_s = float(seconds[run[0]]), float(seconds[run[-1]])
        inside = (grid.seconds >= first_s) & (grid.seconds <= last_s)
        moved = _moved_alone(grid, k, [j for j, same in zip(others, repeating, strict=True) if not same], inside)
        if ordinary <= _ORDINARY_RUN or moved:
            step, ratio = float(np.median(np.diff(seconds))), length / max(ordinary, 1)
            faults.append(SensorFault(k, Kind.STUCK, True, first_s, step, 0.0, ratio, limit))
    return faults


def _moved_alone(grid: Grid, sensor: int, others: list[int], inside: NDArray[np.bool_]) -> bool:
    """Whether the prediction of a sensor moves while it stands still, beyond what the prediction misses elsewhere."""
    if not others:
        return False
    changes = predicted_changes(grid, sensor, others, grid.durations()[-1])
    within = inside[changes.before] & inside[changes.after]
    if not within.any() or within.all():
        return False
    missed = float(np.quantile(np.abs(changes.residual[~within]), 0.95))
    return bool(np.abs(changes.residual[within]).max() > _MOVES * missed)


@dataclass(frozen=True)
class _Suspicion:
    """The strongest excursion of a sensor: over the limit where `excess` is above 1."""

    sensor: int
    excess: float
    found: Excursion
    grid: Grid


def _changed(grids: list[Grid], kept: Sequence[int]) -> list[SensorFault]:
    """Sensors that jump or ramp away from their prediction."""
    faults: list[SensorFault] = []
    left = list(kept)
    while left:
        suspicions = [_strongest(grids, k, [j for j in left if j != k], len(kept)) for k in left]
        over = sorted((one for one in suspicions if one.excess > 1.0), key=lambda one: -one.excess)
        if not over:
            break
        # A faulty predictor disturbs the prediction of the others: each is judged without all that deviate at that time.
        together = [one for one in over if _overlap(one, over[0])]
        places = {one.sensor for one in together}
        sound = [j for j in left if j not in places]
        again = [_strongest(grids, one.sensor, sound, len(kept)) for one in together]
        survivors = [one for one in again if one.excess > 1.0 and _overlap(one, over[0])]
        named = survivors or [over[0]]
        responding = _responds(grids, named[0], sound)
        faults += [_describe(grids, one, sound, responding=responding, alone=len(survivors) == 1) for one in named]
        left = [j for j in left if j not in {one.sensor for one in named}]
    return faults


def _strongest(grids: list[Grid], sensor: int, others: list[int], sensors: int) -> _Suspicion:
    """The strongest excursion of a sensor from what others, loads and its past predict, over all durations."""
    limit = excursion_limit(sensors * sum(len(grid.durations()) for grid in grids))
    chosen = None
    for grid in grids:
        for duration in grid.durations():
            found = largest_excursion(predicted_changes(grid, sensor, others, duration))
            if found is not None and (chosen is None or found.ratio / limit > chosen.excess):
                chosen = _Suspicion(sensor, found.ratio / limit, found, grid)
    if chosen is None:
        return _Suspicion(sensor, 0.0, Excursion(0, 0, 0, 0.0), grids[-1])
    return chosen


def _overlap(one: _Suspicion, other: _Suspicion) -> bool:
    """Whether two suspicions are of the same time."""
    (first, last), (begin, end) = ((s.grid.seconds[s.found.first], s.grid.seconds[s.found.last]) for s in (one, other))
    return bool(first <= end and begin <= last)


def _responds(grids: list[Grid], suspicion: _Suspicion, others: list[int]) -> bool:
    """Whether another sensor, predicted without the suspected one, shows the largest excursion of its record at that time or soon after."""
    coarse = grids[-1]
    begin = float(suspicion.grid.seconds[suspicion.found.first])
    for duration in coarse.durations():
        end = float(suspicion.grid.seconds[suspicion.found.last]) + 2.0 * duration * coarse.step_s
        for k in others:
            found = largest_excursion(predicted_changes(coarse, k, [j for j in others if j != k], duration))
            if found is not None and found.ratio >= _RESPONSE and begin <= coarse.seconds[found.peak] <= end:
                return True
    return False


def _describe(
    grids: list[Grid], suspicion: _Suspicion, sound: list[int], *, responding: bool, alone: bool
) -> SensorFault:
    """Kind, onset and clearness of a change."""
    found, coarse = suspicion.found, grids[-1]
    ramp = _timed(grids, suspicion, sound)
    fine_s, duration_s = grids[0].step_s, ramp.end_s - ramp.begin_s
    quick = duration_s <= max(2.0 * fine_s, _FAST_S)
    kind = Kind.JUMP if quick else Kind.RAMP
    fast = quick and fine_s <= _FAST_S
    switched, otherwise = coarse.switchings(ramp.begin_s - 2.0 * coarse.step_s, ramp.end_s + 2.0 * coarse.step_s)
    reasons = {
        "another sensor deviates at the same time": not alone,
        "other sensors respond, so that it may be a source of heat": responding,
        "a load was switched then, too rarely to compare": switched and otherwise < _LEAST_SWITCHINGS,
        "too little of what it does is predicted by the others to tell a fault from a source of heat": not (
            fast or _shared_by_others(coarse, suspicion.sensor, sound) >= _PREDICTABLE
        ),
    }
    reason = next((words for words, holds in reasons.items() if holds), "")
    limit = found.ratio / suspicion.excess
    return SensorFault(
        suspicion.sensor, kind, not reason, ramp.begin_s, ramp.begin_u_s, ramp.size_K, found.ratio, limit, reason
    )


def _shared_by_others(grid: Grid, sensor: int, others: list[int]) -> float:
    """Largest share, over the durations, of what past and loads leave of a sensor's changes that the others predict (median squares)."""
    shares = [0.0]
    for duration in grid.durations():
        alone, left = (
            float(np.median(predicted_changes(grid, sensor, used, duration).residual ** 2)) for used in ([], others)
        )
        if alone > 0.0:
            shares.append(1.0 - left / alone)
    return max(shares)


def _timed(grids: list[Grid], suspicion: _Suspicion, sound: list[int]) -> Ramp:
    """Begin, end and size of a change: on the grid where it stands out, and on the fine one where it takes a block or two."""
    grid, found = suspicion.grid, suspicion.found
    level = level_beyond_prediction(grid, suspicion.sensor, sound)
    ramp = fit_ramp(grid.seconds[found.first : found.last + 1], level[found.first : found.last + 1])
    fine = grids[0]
    if fine is grid or ramp.end_s - ramp.begin_s > 3.0 * grid.step_s:
        return ramp
    inside = (fine.seconds >= ramp.begin_s - 2.0 * grid.step_s) & (fine.seconds <= ramp.end_s + 2.0 * grid.step_s)
    return fit_ramp(fine.seconds[inside], fine.temperature[inside, suspicion.sensor])


def _noisier(seconds: Array, temperature: Array, grid: Grid, kept: Sequence[int]) -> list[SensorFault]:
    """Sensors whose noise grows for good, apart from what the noise of all does."""
    size = seconds.size // _NOISE_WINDOWS
    if size < _NOISE_SAMPLES:
        return []
    scale = np.full((_NOISE_WINDOWS, len(kept)), np.nan)
    for place, k in enumerate(kept):
        digits = np.diff(np.unique(temperature[np.isfinite(temperature[:, k]), k]))
        least = float(digits.min(initial=np.inf)) / np.sqrt(12.0)
        for window in range(_NOISE_WINDOWS):
            values = temperature[window * size : (window + 1) * size, k]
            values = values[np.isfinite(values)]
            if values.size - 2 >= _NOISE_SAMPLES // 2:
                scale[window, place] = max(sample_noise(values), least)
    with np.errstate(all="ignore"):
        course = np.log(scale) - np.log(np.nanmedian(scale, axis=0))
    limit = excursion_limit(len(kept))
    faults = []
    for place, k in enumerate(kept):
        others = np.delete(course, place, axis=1)
        common = np.median(others, axis=1) if others.shape[1] else 0.0
        own = course[:, place] - common
        if not np.isfinite(own).all():
            continue
        splits = range(_LEAST_NOISE_WINDOWS, _NOISE_WINDOWS - _LEAST_NOISE_WINDOWS + 1)
        apart = np.array([np.exp(own[at:].min() - own[:at].max()) for at in splits])
        at = splits[int(apart.argmax())]
        ratio = float(np.exp(np.median(own[at:]) - np.median(own[:at])))
        if apart.max() < _NOISIER:
            continue
        onset, window_s = float(seconds[at * size]), size * float(np.median(np.diff(seconds)))
        switched, otherwise = grid.switchings(onset - window_s, onset + window_s)
        rarely = switched and otherwise < _LEAST_SWITCHINGS
        reason = "a load was switched then, too rarely to compare" if rarely else ""
        if not reason and apart.max() < limit:
            reason = "the noise of a sound sensor may grow as much beside a machine that runs faster"
        faults.append(
            SensorFault(
                k,
                Kind.NOISE,
                not reason,
                onset,
                0.5 * window_s,
                ratio,
                float(apart.max()),
                _NOISIER if reason else limit,
                reason,
            )
        )
    return faults
