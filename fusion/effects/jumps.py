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
    """Time of the first reading of every cycle.

    Parameters
    ----------
    readings : n readings, sorted by time

    Returns
    -------
    (cycles,) ndarray, s
    """
    # Readings are sorted by time, so the first of a cycle is its earliest.
    _, first = np.unique(readings.cycle, return_index=True)
    return np.asarray(readings.seconds[first])


def event_instants(readings: Readings) -> Array:
    """Instants at which an event is tried: quarters of every cycle that has enough cycles on both sides, fewer in a long campaign.

    Parameters
    ----------
    readings : n readings

    Returns
    -------
    (k,) ndarray, s
        Empty where there are fewer than six cycles.
    """
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
    """Instants of a closer look: the readings up to the next instants that were tried.

    Parameters
    ----------
    readings : n readings
    instant : s since the first reading

    Returns
    -------
    (k,) ndarray, s
        An event cannot be dated more closely than by its neighbouring readings.
    """
    starts = cycle_starts(readings)
    reach = float(np.median(np.diff(starts))) / _EVENTS_PER_CYCLE * _stride(starts.size)
    return np.unique(readings.seconds[np.abs(readings.seconds - instant) <= reach])


def jumps(series: Series) -> list[tuple[float, float, float]]:
    """Detect isolated jumps of a series.

    Parameters
    ----------
    series : sampled values; of several columns their mean is taken

    Returns
    -------
    list of (before_s, after_s, size)
        Times of the samples beside the jump, and its size in the unit of the series. A change is compared with the median of the six
        changes around it, in units of the robust scatter of that difference.
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
    far = np.flatnonzero(np.abs(excess) > _JUMP_SIGMAS * max(scatter, resolution, 1e-9))
    return [(float(series.seconds[k]), float(series.seconds[k + 1]), float(excess[k])) for k in far]


def sensor_jumps(readings: Readings) -> list[tuple[str, float, float, float]]:
    """Detect isolated jumps in the environment log.

    Parameters
    ----------
    readings : with the logged series

    Returns
    -------
    list of (sensor, before_s, after_s, size)
        Size in the sensor's unit.
    """
    present = [name for name in ENVIRONMENT if name in readings.series]
    return [(name, *jump) for name in present for jump in jumps(readings.series[name])]


def stuck_sensors(readings: Readings) -> list[tuple[str, float]]:
    """Detect sensors whose reading stays constant to the end of the log.

    Parameters
    ----------
    readings : with the logged series

    Returns
    -------
    list of (sensor, start_s)
        Sensors with a final run of equal values that is ten times as long as 95 % of their runs, and when that run begins.
    """
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
