"""Episodes in what was logged or seen: isolated jumps, sensors that stick, and the instants at which a reading could step."""

from __future__ import annotations

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import ENVIRONMENT, Readings, Series

#: Instants per cycle at which an event is tried: a knock may come at any target, and is dated to a quarter of a cycle.
_EVENTS_PER_CYCLE = 4
#: More instants than this are thinned, so that a long campaign takes no longer per reading; a closer look dates an event all the same.
_MOST_INSTANTS = 240
#: An event needs this many cycles on either side, or it cannot be told from an outlier.
_EVENT_MARGIN_CYCLES = 2
#: A jump in a log or in the field counts as one where it exceeds its neighbours' changes this many times (robust sigma).
_JUMP_SIGMAS = 8.0


def cycle_starts(readings: Readings) -> Array:
    """Time of the first reading of every cycle, s."""
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
    """The gaps between readings up to the next instants that were tried: an event can be dated no better than by its neighbours."""
    starts = cycle_starts(readings)
    reach = float(np.median(np.diff(starts))) / _EVENTS_PER_CYCLE * _stride(starts.size)
    return np.unique(readings.seconds[np.abs(readings.seconds - instant) <= reach])


def jumps(series: Series) -> list[tuple[float, float, float]]:
    """Isolated jumps of a series: time before and after (s) and size, where one change stands far out of its neighbours.

    A change is compared with the median of the six around it, in units of the series' own robust scatter of that difference.
    """
    values = series.values if series.values.ndim == 1 else series.values.mean(axis=1)
    changes = np.diff(values)
    if changes.size < 9:
        return []
    excess = np.empty_like(changes)
    for k in range(changes.size):
        low, high = max(0, k - 3), min(changes.size, k + 4)
        excess[k] = changes[k] - np.median(np.delete(changes[low:high], k - low))
    scatter = 1.4826 * np.median(np.abs(excess - np.median(excess)))
    # A log in steps of its resolution has no finer scatter than one step.
    steps = np.abs(changes[changes != 0.0])
    resolution = float(steps.min()) if steps.size and np.unique(np.round(steps, 9)).size < steps.size / 2 else 0.0
    found = np.flatnonzero(np.abs(excess) > _JUMP_SIGMAS * max(scatter, resolution, 1e-9))
    return [(float(series.seconds[k]), float(series.seconds[k + 1]), float(excess[k])) for k in found]


def sensor_jumps(readings: Readings) -> list[tuple[str, float, float, float]]:
    """Isolated jumps in the environment log: sensor, time before and after (s), size in the sensor's unit."""
    present = [name for name in ENVIRONMENT if name in readings.series]
    return [(name, *jump) for name in present for jump in jumps(readings.series[name])]


def stuck_sensors(readings: Readings) -> list[tuple[str, float]]:
    """Sensors that stop to move until the end of the log, and since when (s): a run of equal values ten times the usual one."""
    found = []
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
            found.append((name, float(series.seconds[last])))
    return found
