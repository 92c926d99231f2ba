"""What happens at an instant or in a rhythm: a slip of the set-up, and disturbances that switch in a fixed period."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Separable, Wave
from fusion.effects.jumps import cycle_starts, event_instants, instants_near

#: Periods that are tried at most: all down to 3 min in a record of 7.5 h, down to 11 min in one of 28 h.
_MOST_PERIODS = 300
#: So many readings have waves that are held: they take 60 MB, and the search 1/20 less time than if computed for every block.
_HELD_READINGS = 12_000


def _step_event(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps at the instants that can be tried."""
    tried = event_instants(readings) if near is None or near.event_s is None else instants_near(readings, near.event_s)
    place, alike = np.zeros(readings.seconds.size, int), np.ones((1, 1))
    for instant in tried:
        late = Separable((readings.seconds >= instant,), place, alike)
        yield Candidate(late, {"time_s": float(instant)}, ("um",), instant)


def periods_min(readings: Readings) -> Array:
    """Periods that are tried: evenly spaced in frequency at half the resolution of the recording, from 3 min to a third of it.

    Periods that the cycle or its parts would imitate are left out: every slow change of the profile has lines there.

    Parameters
    ----------
    readings : n readings

    Returns
    -------
    (k,) ndarray, min
        Longest first.
    """
    span = _span_min(readings)
    return np.asarray(1.0 / off_the_cycle(readings, np.arange(3.0 / span, 1.0 / 3.0, 0.5 / span, dtype=np.float64)))


def _span_min(readings: Readings) -> float:
    return float(readings.seconds[-1] - readings.seconds[0]) / 60.0


def off_the_cycle(readings: Readings, frequencies: Array) -> Array:
    """Leave out frequencies within four lines of the cycle's own frequency or a multiple of it.

    Parameters
    ----------
    readings : n readings
    frequencies : (k,) ndarray, 1/min

    Returns
    -------
    ndarray, 1/min
        Those that are kept; one line is the inverse of the duration.
    """
    cycle = 60.0 / float(np.median(np.diff(cycle_starts(readings))))
    order = np.maximum(1.0, np.round(frequencies / cycle))
    return np.asarray(frequencies[np.abs(frequencies - order * cycle) > 4.0 / _span_min(readings)])


def _periodic_disturbance(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Waves in time, flat or along the axis."""
    # A long campaign tells so many periods apart that the shortest are left out: the search stays linear in the readings.
    periods = (
        periods_min(readings)[:_MOST_PERIODS]
        if near is None
        else _close_periods(readings, float(near.parameters["period_min"]))
    )
    place, share = readings.target_index, readings.positions_mm / readings.span_mm
    weights = {"flat": np.ones((share.size, 2)), "linear": np.column_stack([share, share])}
    for period in periods:
        waves: tuple[Array | Wave, ...] = tuple(
            Wave(shape, readings.seconds, 60.0 * period) for shape in (np.cos, np.sin)
        )
        if readings.seconds.size <= _HELD_READINGS:
            waves = tuple(map(np.asarray, waves))
        for shape, weight in weights.items():
            yield Candidate(
                Separable(waves, place, weight), {"period_min": float(period), "shape": shape}, ("um", "um")
            )


def _close_periods(readings: Readings, chosen_min: float) -> Array:
    """Periods about a chosen one, as close as the recording can separate; none beyond those of the search."""
    span = _span_min(readings)
    near = 1.0 / chosen_min + np.linspace(-0.5, 0.5, 21) / span
    near = near[(near > 2.999 / span) & (near < 1.001 / 3.0)]
    return np.asarray(1.0 / off_the_cycle(readings, near))


STEP_EVENT = Effect(
    name="step_event",
    physics="A mount, clamp or optic slips once, or the laser gets a new zero: all readings after that instant are shifted.",
    source="level shift at one instant",
    candidates=_step_event,
    repeats=True,
    label="sudden step or new zero",
    remedy="Ask whether the laser was zeroed or its beam broken at that time; if not, look at the clamping of optics and laser head.",
)
PERIODIC_DISTURBANCE = Effect(
    name="periodic_disturbance",
    physics="Cooling, coolant or air conditioning switches in a fixed rhythm.",
    source="line in the spectrum of the readings' own times",
    candidates=_periodic_disturbance,
    repeats=True,
    label="periodic disturbance",
    remedy="Compare its period with coolant, hydraulics and air conditioning.",
)
