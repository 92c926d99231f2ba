"""Geometry that changes with a thermal state: bending, reversal, and the cyclic error of the screw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion._typing import Array
from fusion.alignment.readings import Readings
from fusion.effects.effect import Candidate, Effect, Parameters, Separable
from fusion.effects.states import thermal_states, unit_of_state, unmeasured_expansion

#: Shortest lead of a screw that is tried where the targets are spaced unevenly.
SHORTEST_LEAD_MM = 4.0
#: Smallest amplitude of a wave at the targets that is more than rounding.
_VISIBLE = 1e-6


def _needs_both_directions(readings: Readings) -> str | None:
    return None if np.unique(readings.sign).size == 2 else "only one direction of approach was measured"


def _angular_growth(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """States times the square of the position."""
    for state, parameters in thermal_states(readings, near):
        yield Candidate((state * readings.share**2)[:, None], parameters, (unit_of_state(readings, parameters),))


def _reversal_drift(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """States times half the direction of approach."""
    for state, parameters in thermal_states(readings, near):
        yield Candidate((state * 0.5 * readings.sign)[:, None], parameters, (unit_of_state(readings, parameters),))


def _spatial_frequencies(readings: Readings) -> Array:
    """Frequencies along the axis (1/mm) from two periods over the travel up to what the targets can show.

    Evenly spaced targets show every lead as one of the waves that are longer than two spacings; uneven ones tell leads apart, down to the
    shortest lead that is tried, as long as the step between frequencies is no wider than half the resolution of the travel.
    """
    positions = np.sort(readings.positions_mm)
    travel = positions[-1] - positions[0]
    highest = 0.5 * (positions.size - 1) if _evenly_spaced(readings) else travel / SHORTEST_LEAD_MM
    return np.arange(2.0, highest + 1e-9, 0.5) / travel


def _evenly_spaced(readings: Readings) -> bool:
    """Whether targets are so even that a lead and its alias look alike: to a hundredth of the spacing."""
    spacing = np.diff(np.sort(readings.positions_mm))
    return bool(np.ptp(spacing) < 0.01 * spacing.mean())


def _aliased_lead_mm(readings: Readings, frequency: float) -> str:
    """Leads between 2 and 50 mm that evenly spaced targets show as the same frequency."""
    spacing = np.diff(np.sort(readings.positions_mm))
    if not _evenly_spaced(readings):
        return f"{1 / frequency:.3g} mm (targets unevenly spaced: no alias)"
    sampling = 1.0 / spacing.mean()
    orders = np.arange(0, int(0.5 / sampling) + 2)
    leads = {1 / f for k in orders for f in (k * sampling + frequency, k * sampling - frequency) if 1 / 50 <= f <= 0.5}
    return ", ".join(f"{lead:.3g}" for lead in sorted(leads, reverse=True)) + " mm"


def hidden_leads_mm(readings: Readings) -> str:
    """Leads between 2 and 50 mm of which evenly spaced targets see one phase only.

    Parameters
    ----------
    readings : with the positions of the targets

    Returns
    -------
    str
        In mm, longest first; empty where the spacing is uneven.
    """
    if not _evenly_spaced(readings):
        return ""
    spacing = float(np.ptp(readings.positions_mm)) / (readings.positions_mm.size - 1)
    leads = [spacing / k for k in range(1, int(spacing / 2.0) + 1) if 2.0 <= spacing / k <= 50.0]
    return ", ".join(f"{lead:.3g}" for lead in leads) + " mm" if leads else ""


def _pitch_error(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Waves along the axis times slow states."""
    states = list(thermal_states(readings, near))
    if near is None:
        states = [pair for pair in states if pair[1]["time_constant_min"] in {0.0, 40.0, 60.0}]
    if near is None and not _evenly_spaced(readings):
        # Uneven targets leave a hundred and more waves to try; each then follows one course of every kind only.
        states = [p for p in states if p[1]["time_constant_min"] != 0.0 and p[1].get("start") != "at rest"]
    frequencies = _spatial_frequencies(readings)
    if near is not None:
        close = 1.0 / float(near.parameters["period_mm"]) + np.linspace(-0.25, 0.25, 5) / np.ptp(readings.positions_mm)
        # A wave longer than half the travel is a bending, not a screw's.
        frequencies = close[(close > 0.999 * frequencies[0]) & (close < 1.001 * frequencies[-1])]
    place = readings.target_index
    measured = np.unique(place)
    for frequency in frequencies:
        phase = 2 * np.pi * frequency * readings.positions_mm
        waves = np.column_stack([np.cos(phase), np.sin(phase)])
        # Targets at every half wave show one phase only; what is left of the other is rounding.
        waves = waves[:, np.abs(waves[measured]).max(axis=0) > _VISIBLE]
        for state, followed in states:
            parameters: Parameters = {
                **followed,
                "period_mm": float(1 / frequency),
                "possible_leads": _aliased_lead_mm(readings, frequency),
            }
            along = Separable((state,) * waves.shape[1], place, waves)
            yield Candidate(along, parameters, (unit_of_state(readings, followed),) * waves.shape[1])


def _hidden_leads(readings: Readings) -> str:
    """Leads of which evenly spaced targets see one phase only, in words."""
    hidden = hidden_leads_mm(readings)
    return f"evenly spaced targets hide leads of {hidden}; space them unevenly to see all" if hidden else ""


ANGULAR_GROWTH = Effect(
    name="angular_growth",
    physics="Guide or table bends as it warms; the Abbe offset turns the growing angle into an error that is quadratic along the axis.",
    source="Abbe principle, Bryan 1979: 1 arcsec x 100 mm = 0.48 um",
    candidates=_angular_growth,
    masked_by=unmeasured_expansion,
    patterned=True,
    label="growing pitch or yaw of the axis",
    remedy="Measure pitch and yaw while the machine warms up; keep the Abbe offset short.",
)
REVERSAL_DRIFT = Effect(
    name="reversal_drift",
    physics="Backlash or wind-up changes with temperature: both directions move apart by the same amount at every position.",
    source="ISO 230-2, reversal value B",
    candidates=_reversal_drift,
    needs=_needs_both_directions,
    patterned=True,
    label="reversal that changes with time",
    remedy="Check screw preload, gibs and the scale's coupling; measure the reversal warm and cold.",
)
PITCH_ERROR = Effect(
    name="pitch_error",
    physics="The cyclic error of the screw changes as it warms: a wave along the axis whose size follows a thermal state.",
    source="periodic error of the lead; aliased where the spacing is a multiple of the lead",
    candidates=_pitch_error,
    patterned=True,
    limitation=_hidden_leads,
    label="pitch error of the screw",
    remedy="Repeat with a target spacing that is no multiple of the screw's lead.",
)
