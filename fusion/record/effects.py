"""The library of effects for a record: the same physics as along an axis, every channel with coefficients of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fusion.effects.effect import Candidate, Effect
from fusion.effects.events import periods_min
from fusion.effects.jumps import jumps
from fusion.effects.library import LIBRARY, library
from fusion.effects.states import LAGS_MIN
from fusion.record.blocks import EXPONENTS, Record

#: Name of the mean of all sensors among the sensors that may lag.
MEAN = "mean of all"
#: A load acts at once (bearings widen with the speed), warms the part beside it, then what that part is joined to: states a factor of
#: four apart in their time constants.
_CHAIN = (0.0, 0.25, 1.0, 4.0)
#: Time constants of the middle part, min.
_SOURCE_MIN = (5.0, 10.0, 20.0, 40.0, 80.0)
#: An event needs this share of the record on either side to be told from a drift.
_EVENT_MARGIN = 0.05
#: Instants at which an event is tried.
_EVENT_INSTANTS = 200
#: Shares of a block that a closer look tries as the part of it that lies after an event; coarser, and one event needs two steps.
_SHARES = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
#: A sensor's jump belongs to the sensor alone where it exceeds that of the others' mean so many times.
_OWN_JUMP = 5.0
#: A sensor that jumps alone more often is a quick one close to a source, not a faulty one.
_MOST_FAULTS = 2
#: Fewer periods than this are no rhythm: any slow drift looks like them.
_LEAST_PERIODS = 6.0

_ALONG_AN_AXIS = "a record has no positions"


@dataclass(frozen=True)
class RecordEffect:
    """A named effect in a record.

    Attributes
    ----------
    name : as in the library of :mod:`fusion.effects.library`
    candidates : from the record (and a candidate near which to look closer) to columns (blocks, q) that every channel follows with its
        own coefficients
    needs : why it cannot be tried with this record, or None
    excited_by, repeats : as in the library
    """

    name: str
    candidates: Callable[[Record, Candidate | None], Iterator[Candidate]]
    needs: Callable[[Record], str | None]
    excited_by: str = ""
    repeats: bool = False


def _thermal_lag(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """Lagged copies of one sensor, or of the mean of all."""
    block_min = record.block_s / 60.0
    named = {name: record.rise[:, k] for k, name in enumerate(record.sensors)}
    named[MEAN] = record.rise.mean(axis=1)
    for name, rise in named.items():
        if near is not None and near.parameters["sensor"] != name:
            continue
        for minutes in _around(near, LAGS_MIN):
            if minutes >= 2.0 * block_min:
                lagged = record.series(rise, "K").lagged(60.0 * minutes).values
                yield Candidate(lagged[:, None], {"sensor": name, "time_constant_min": minutes}, ("um/K",))


def _unseen_heat_source(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """States of a chain of parts that a driver heats, in proportion to the driver and to its square."""
    for name, powers in record.drivers.items():
        if near is not None and near.parameters["follows"] != name:
            continue
        for minutes in _around(near, _SOURCE_MIN):
            states = [
                record.series(powers[exponent], "1").lagged(60.0 * minutes * share).values
                for share in _CHAIN
                for exponent in EXPONENTS
            ]
            parameters: dict[str, float | str] = {
                "follows": name,
                "time_constant_min": minutes,
                "chain": "at once, " + ", ".join(f"{minutes * share:.3g} min" for share in _CHAIN[1:]),
            }
            yield Candidate(np.column_stack(states), parameters, ("um",) * len(states))


def _step_event(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """A level shift at one instant, in every channel by its own amount."""
    first, last = record.seconds[0], record.seconds[-1]
    margin = _EVENT_MARGIN * (last - first)
    if near is None or near.event_s is None:
        every = max(1, record.seconds.size // _EVENT_INSTANTS)
        instants = record.seconds[::every]
    else:
        instants = record.seconds[np.abs(record.seconds - near.event_s) <= 0.01 * (last - first)]
    for instant in instants:
        if first + margin <= instant <= last - margin:
            for share in (0.0,) if near is None else _SHARES:
                yield _step(record, float(instant), share)


def _step(record: Record, instant: float, share: float) -> Candidate:
    """A shift from the block at an instant on, and for a share of the block before, in which it came."""
    late = (record.seconds >= instant).astype(float)
    place = int(np.argmax(late))
    if record.run[place - 1] == record.run[place]:
        late[place - 1] = share
    return Candidate(late[:, None], {"time_s": instant - share * record.block_s}, ("um",), instant)


def _periodic_disturbance(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """Waves in time."""
    shortest = 4.0 * record.block_s / 60.0
    if near is None:
        periods = periods_min(record.view())
    else:
        span = float(record.seconds[-1] - record.seconds[0]) / 60.0
        periods = 1.0 / (1.0 / float(near.parameters["period_min"]) + np.linspace(-0.5, 0.5, 21) / span)
    longest = float(record.seconds[-1] - record.seconds[0]) / 60.0 / _LEAST_PERIODS
    for period in periods[(periods >= shortest) & (periods <= longest)]:
        phase = 2 * np.pi * record.seconds / (60.0 * period)
        yield Candidate(np.column_stack([np.cos(phase), np.sin(phase)]), {"period_min": float(period)}, ("um", "um"))


def sensor_faults(record: Record) -> list[tuple[int, float, float]]:
    """Detect sensors that jump alone.

    A jump that the other sensors share is no fault, nor is one at which a driver was switched.

    Parameters
    ----------
    record : on its blocks

    Returns
    -------
    list of (place, time_s, size_K)
        Place among the sensors.
    """
    faults = []
    switched = record.switched()
    for k in range(len(record.sensors)):
        others = np.delete(record.rise, k, axis=1)
        common = others.mean(axis=1) if others.shape[1] else np.zeros(record.seconds.size)
        own = []
        for before, after, size in (
            jump for run in record.series(record.rise[:, k], "K").runs() for jump in jumps(run)
        ):
            at = np.searchsorted(record.seconds, (before, after))
            alone = abs(size) > _OWN_JUMP * abs(common[at[1]] - common[at[0]])
            if alone and not switched[at[0] : at[1] + 1].any():
                own.append((k, after, size))
        if len(own) <= _MOST_FAULTS:
            faults += own
    return faults


def _sensor_fault(record: Record, near: Candidate | None) -> Iterator[Candidate]:
    """What the jump of a sensor does to the prediction: a step, since the displacement does not follow it."""
    for k, instant, size in sensor_faults(record):
        if near is None or near.event_s == instant:
            late = (record.seconds >= instant).astype(float)
            parameters: dict[str, float | str] = {"sensor": record.sensors[k], "time_s": instant, "jump_K": size}
            yield Candidate(late[:, None], parameters, ("um",), instant)


def _around(near: Candidate | None, grid: tuple[float, ...]) -> tuple[float, ...]:
    if near is None:
        return grid
    chosen = float(near.parameters["time_constant_min"])
    return tuple(float(chosen * factor) for factor in np.geomspace(0.6, 1.6, 7))


_CANDIDATES = {
    "thermal_lag": _thermal_lag,
    "unseen_heat_source": _unseen_heat_source,
    "step_event": _step_event,
    "periodic_disturbance": _periodic_disturbance,
    "sensor_fault": _sensor_fault,
}


def _needs(name: str) -> Callable[[Record], str | None]:
    """Why an effect of the library cannot be tried with a record."""

    def needs(record: Record) -> str | None:
        if name == "unseen_heat_source" and not record.drivers:
            return "nothing that drives a heat source was logged; name speed, load or duty as record.drivers"
        if name == "sensor_fault" and not sensor_faults(record):
            return "no sensor jumps alone"
        return None

    return needs


def record_library(effects: Mapping[str, Effect] | None = None) -> tuple[dict[str, RecordEffect], dict[str, str]]:
    """Effects that can act in a record, and why the others of the library are not tried.

    Parameters
    ----------
    effects : the library by name; the built-in one with the user's own by default. A user's own effect takes part as it is, with the record
        laid out as readings of one place

    Returns
    -------
    effects : by name
    not_tried : reasons by name
    """
    built_in = {effect.name for effect in LIBRARY}
    adapted, not_tried = {}, {}
    for name, effect in (library() if effects is None else effects).items():
        if name in _CANDIDATES:
            adapted[name] = RecordEffect(name, _CANDIDATES[name], _needs(name), effect.excited_by, effect.repeats)
        elif name in built_in:
            not_tried[name] = _ALONG_AN_AXIS
        else:
            adapted[name] = RecordEffect(name, _as_it_is(effect), _own_needs(effect), effect.excited_by, effect.repeats)
    return adapted, not_tried


def _as_it_is(effect: Effect) -> Callable[[Record, Candidate | None], Iterator[Candidate]]:
    return lambda record, near: effect.candidates(record.view(), {}, near)


def _own_needs(effect: Effect) -> Callable[[Record], str | None]:
    return lambda record: effect.needs(record.view())
