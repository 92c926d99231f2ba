"""What happens at an instant or in a rhythm: a slip of the set-up, and disturbances that switch in a fixed period."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fusion.analysis.alignment.readings import ENVIRONMENT, Readings, Series
from fusion.analysis.effects.effect import Candidate, Parameters, Separable, Wave, effect
from fusion.common import Array
from thermography.common import MAD_TO_SIGMA

# Episodes in what was logged or seen: isolated jumps, sensors that stick, and the instants at which a reading could
# step.

#: Instants per cycle at which an event is tried: a knock may come at any target, and is dated to a quarter of a cycle.
_EVENTS_PER_CYCLE = 4
#: More instants than this are thinned, so that a long campaign takes no longer per reading; a closer look dates an event all the same.
_MOST_INSTANTS = 240
#: An event needs this many cycles on either side, or it cannot be told from an outlier.
_EVENT_MARGIN_CYCLES = 2
#: A jump in a log or in the field counts as one where it exceeds its neighbours' changes this many times (robust sigma).
_JUMP_SIGMAS = 8.0


def cycle_starts(readings: Readings) -> Array:
    """Time of the first reading of every cycle."""
    # Readings are sorted by time, so the first of a cycle is its earliest.
    _, first = np.unique(readings.cycle, return_index=True)
    return np.asarray(readings.seconds[first])


def event_instants(readings: Readings) -> Array:
    """Instants at which an event is tried: quarters of every cycle that has enough cycles on both sides, fewer in a long campaign."""
    starts = cycle_starts(readings)
    margin = _EVENT_MARGIN_CYCLES
    if starts.size <= 2 * margin + 1:
        return np.empty(0)
    inner = starts[margin : starts.size - margin + 1]
    parts = np.arange(_EVENTS_PER_CYCLE) / _EVENTS_PER_CYCLE
    return np.asarray((inner[:-1, None] + np.diff(inner)[:, None] * parts).ravel()[:: _stride(starts.size)])


def _stride(cycles: int) -> int:
    """Every how many quarters of a cycle an event is tried."""
    return max(1, int(np.ceil(_EVENTS_PER_CYCLE * cycles / _MOST_INSTANTS)))


def instants_near(readings: Readings, instant: float) -> Array:
    """Instants of a closer look: the readings up to the next instants that were tried."""
    starts = cycle_starts(readings)
    reach = float(np.median(np.diff(starts))) / _EVENTS_PER_CYCLE * _stride(starts.size)
    return np.unique(readings.seconds[np.abs(readings.seconds - instant) <= reach])


def detect_jumps(series: Series) -> list[tuple[float, float, float]]:
    """Detect isolated jumps of a series."""
    values = series.values if series.values.ndim == 1 else series.values.mean(axis=1)
    changes = np.diff(values)
    if changes.size < 9:
        return []
    excess = np.empty_like(changes)
    for k in range(changes.size):
        low, high = max(0, k - 3), min(changes.size, k + 4)
        excess[k] = changes[k] - np.median(np.delete(changes[low:high], k - low))
    scatter = MAD_TO_SIGMA * np.median(np.abs(excess - np.median(excess)))
    # A log in steps of its resolution has no finer scatter than one step.
    steps = np.abs(changes[changes != 0.0])
    resolution = float(steps.min()) if steps.size and np.unique(np.round(steps, 9)).size < steps.size / 2 else 0.0
    far = np.flatnonzero(np.abs(excess) > _JUMP_SIGMAS * max(scatter, resolution, 1e-9))
    return [(float(series.seconds[k]), float(series.seconds[k + 1]), float(excess[k])) for k in far]


def detect_sensor_jumps(readings: Readings) -> list[tuple[str, float, float, float]]:
    """Detect isolated jumps in the environment log."""
    present = [name for name in ENVIRONMENT if name in readings.series]
    return [(name, *jump) for name in present for jump in detect_jumps(readings.series[name])]


def detect_stuck_sensors(readings: Readings) -> list[tuple[str, float]]:
    """Detect sensors whose reading stays constant to the end of the log."""
    stuck = []
    for name in ("air_temperature", "air_pressure", "material_temperature"):
        if name not in readings.series:
            continue
        series = readings.series[name]
        moved = np.flatnonzero(np.diff(series.values) != 0.0)
        if moved.size < 10:
            continue
        last = int(moved[-1]) + 1
        usual = float(np.quantile(np.diff(moved), 0.95))
        if series.values.size - last > 10 * usual:
            stuck.append((name, float(series.seconds[last])))
    return stuck


#: Periods that are tried at most: all down to 3 min in a record of 7.5 h, down to 11 min in one of 28 h.
_MOST_PERIODS = 300
#: Shortest period that is tried.
_SHORTEST_MIN = 3.0
#: Numbers of harmonics of a closer look, and orders of which a wave that was chosen may be: a square wave has the odd ones, whose power
#: falls with the square of the order, while the drift hides the slow ones.
_HARMONICS, _ORDERS = (1, 3, 7), (2, 3, 5)
#: So many readings have waves that are held: they take 60 MB, and the search 1/20 less time than if computed for every block.
_HELD_READINGS = 12_000


@effect(repeats=True)
def step_event(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps of zero, scale and reversal at the instants that can be tried."""
    tried = event_instants(readings) if near is None or near.event_s is None else instants_near(readings, near.event_s)
    place, approach = readings.site, np.tile([0.5, -0.5], readings.targets.size)
    along = np.repeat(1e-3 * readings.positions_mm, 2)
    weights = {"flat": (np.ones(approach.size), "um"), "linear": (along, "um/m"), "reversal": (approach, "um")}
    if np.unique(readings.sign).size < 2:
        del weights["reversal"]
    for instant in tried:
        late = (readings.seconds >= instant,)
        for shape, (weight, unit) in weights.items():
            parameters: Parameters = {"time_s": float(instant), "shape": shape}
            yield Candidate(Separable(late, place, weight[:, None]), parameters, (unit,), instant)


def periods_min(readings: Readings) -> Array:
    """Periods that are tried: evenly spaced in frequency at half the resolution of the recording, from 3 min to a third of it.

    So many lines as there are readings hold all that these can tell, however long the pauses between them.
    """
    span = _span_min(readings)
    highest = min(1.0 / _SHORTEST_MIN, (2.75 + 0.5 * readings.seconds.size) / span)
    return np.asarray(1.0 / off_the_cycle(readings, np.arange(3.0 / span, highest, 0.5 / span, dtype=np.float64)))


def _span_min(readings: Readings) -> float:
    return float(readings.seconds[-1] - readings.seconds[0]) / 60.0


def off_the_cycle(readings: Readings, frequencies: Array) -> Array:
    """Leave out frequencies within four lines of the cycle's own frequency or a multiple of it."""
    return np.asarray(frequencies[_off(readings, frequencies)])


def _off(readings: Readings, frequencies: Array) -> NDArray[np.bool_]:
    cycle = 60.0 / float(np.median(np.diff(cycle_starts(readings))))
    order = np.maximum(1.0, np.round(frequencies / cycle))
    return np.asarray(np.abs(frequencies - order * cycle) > 4.0 / _span_min(readings))


@effect(repeats=True)
def periodic_disturbance(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Waves in time, flat or along the axis."""
    place, share = readings.target_index, readings.positions_mm / readings.span_mm
    weights = {"flat": np.ones((share.size, 2)), "linear": np.column_stack([share, share])}
    for period, harmonics in _rhythms(readings, near):
        orders = np.arange(harmonics) + 1
        orders = orders[(orders == 1) | ((period >= _SHORTEST_MIN * orders) & _off(readings, orders / period))]
        waves: tuple[Array | Wave, ...] = tuple(
            Wave(shape, readings.seconds, 60.0 * period / order) for order in orders for shape in (np.cos, np.sin)
        )
        if readings.seconds.size <= _HELD_READINGS:
            waves = tuple(map(np.asarray, waves))
        course: Parameters = {"course": f"no sine, {orders.size} harmonics"} if orders.size > 1 else {}
        for shape, weight in weights.items():
            columns = Separable(waves, place, np.tile(weight, orders.size))
            parameters: Parameters = {"period_min": float(period), "shape": shape, **course}
            yield Candidate(columns, parameters, ("um",) * len(waves))


def _rhythms(readings: Readings, near: Candidate | None) -> list[tuple[float, int]]:
    """Periods, and harmonics of each; of what switches the wave that was chosen may be a harmonic, which is not another effect."""
    if near is None:
        # A long campaign tells so many periods apart that the shortest are left out: the search stays linear in the readings.
        return [(period, 1) for period in periods_min(readings)[:_MOST_PERIODS].tolist()]
    close = _close_periods(readings, float(near.parameters["period_min"])).tolist()
    slow = [order * period for period in close for order in _ORDERS if 3.0 * order * period <= _span_min(readings)]
    return [(period, some) for period in close for some in _HARMONICS] + [(period, _HARMONICS[-1]) for period in slow]


def _close_periods(readings: Readings, chosen_min: float) -> Array:
    """Periods about a chosen one, as close as the recording can separate; none beyond those of the search."""
    span = _span_min(readings)
    near = 1.0 / chosen_min + np.linspace(-0.5, 0.5, 21) / span
    near = near[(near > 2.999 / span) & (near < 1.001 / _SHORTEST_MIN)]
    return np.asarray(1.0 / off_the_cycle(readings, near))
