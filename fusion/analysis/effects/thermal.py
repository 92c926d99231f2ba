"""Heat: expansion with the seen field, its delayed copies, and sources out of the camera's sight."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fusion.analysis.alignment.readings import Readings
from fusion.analysis.effects.effect import (
    LAGS_MIN,
    Candidate,
    Parameters,
    Prior,
    Separable,
    effect,
    first_order_responses,
    lacks,
    thermal_states,
    um_per,
    unit_of_state,
    unmeasured_expansion,
)
from fusion.common import Array

# Geometry that changes with a thermal state: bending, reversal, and the cyclic error of the screw.

#: Shortest lead of a screw that is tried where the targets are spaced unevenly.
SHORTEST_LEAD_MM = 4.0
#: Smallest amplitude of a wave at the targets that is more than rounding.
_VISIBLE = 1e-6
#: Share of a step by which a target may lie beside a grid that all targets have in common.
_OFF_GRID = 0.005


@effect(masked_by=unmeasured_expansion, patterned=True, like_expansion=True)
def angular_growth(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """States times the square of the position."""
    for state, parameters in thermal_states(readings, near):
        yield Candidate((state * readings.share**2)[:, None], parameters, (unit_of_state(readings, parameters),))


@effect(patterned=True)
def reversal_drift(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """States times half the direction of approach; in a test of one approach, where they are a common drift, a rival of all others."""
    for state, parameters in thermal_states(readings, near):
        yield Candidate((state * 0.5 * readings.sign)[:, None], parameters, (unit_of_state(readings, parameters),))


def _spatial_frequencies(readings: Readings) -> Array:
    """Frequencies along the axis (1/mm) from two periods over the travel up to what the targets can show."""
    travel, grid = float(np.ptp(readings.positions_mm)), _grid_mm(readings)
    highest = travel * (0.5 / grid if grid else 1.0 / SHORTEST_LEAD_MM)
    return np.asarray(np.arange(2.0, highest + 1e-9, 0.5) / travel)


def _grid_mm(readings: Readings) -> float | None:
    """Longest step of which all distances are multiples: a lead and its alias look alike there, also where targets lack."""
    place = readings.positions_mm - readings.positions_mm.min()
    shortest, travel = float(np.diff(np.sort(place)).min()), float(place.max())
    parts = np.arange(1, 1 + max(1, int(2.0 * shortest / SHORTEST_LEAD_MM)))
    steps = travel / np.round(travel * parts / shortest)
    fits = [step for step in steps if np.abs(place / step - np.round(place / step)).max() < _OFF_GRID]
    return max(fits, default=None)


def _aliased_lead_mm(readings: Readings, frequency: float) -> str:
    """Leads between 2 and 50 mm that targets on a grid show as the same frequency."""
    grid = _grid_mm(readings)
    if grid is None:
        return f"{1 / frequency:.3g} mm (targets unevenly spaced: no alias)"
    orders = np.arange(0, int(0.5 * grid) + 2)
    leads = {1 / f for k in orders for f in (k / grid + frequency, k / grid - frequency) if 1 / 50 <= f <= 0.5}
    return ", ".join(f"{lead:.3g}" for lead in sorted(leads, reverse=True)) + " mm"


def hidden_leads_mm(readings: Readings) -> str:
    """Leads between 2 and 50 mm of which targets on a grid see one phase only."""
    grid = _grid_mm(readings) or 0.0
    leads = [grid / k for k in range(1, int(grid / 2.0) + 1) if 2.0 <= grid / k <= 50.0]
    return ", ".join(f"{lead:.3g}" for lead in leads) + " mm" if leads else ""


def _hidden_leads(readings: Readings) -> str:
    """Leads of which evenly spaced targets see one phase only, in words."""
    hidden = hidden_leads_mm(readings)
    return lacks("leads", hidden=hidden) if hidden else ""


@effect(patterned=True, like_expansion=True, limitation=_hidden_leads)
def pitch_error(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Waves along the axis times slow states."""
    states = list(thermal_states(readings, near))
    if near is None:
        states = [pair for pair in states if pair[1]["time_constant_min"] in {0.0, 40.0, 60.0}]
    frequencies = _spatial_frequencies(readings)
    if near is None and frequencies.size > readings.positions_mm.size:
        # Uneven targets leave a hundred and more waves to try; each then follows one course of every kind only.
        states = [p for p in states if p[1]["time_constant_min"] != 0.0 and p[1].get("start") != "at rest"]
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


#: Standard uncertainty of what an axis expands by: steels and cast irons lie between 9 and 14 ppm/K, and what holds the axis takes part.
EXPANSION_U_PPM_PER_K = 2.0
#: Name of the declared model of a record: every displacement a linear function of the temperatures.
QUASI_STATIC = "quasi_static"
#: Prefix of the series that are temperature sensors of a record.
SENSOR_PREFIX = "temperature "
#: Patterns along the axis by the powers of the position that they hold.
_SHAPES = {"flat": (0,), "linear": (1,), "flat and linear": (0, 1)}
#: Time constant of a second body that the search tries, as a share of the first one's.
_SECOND_BODY_TRIED = (0.25,)


def needs_field(readings: Readings) -> str | None:
    """Say that a campaign without thermal frames cannot show an effect, or return None."""
    return None if "mean_rise" in readings.series else lacks("field")


def _needs_driver(readings: Readings) -> str | None:
    return None if readings.drivers else lacks("driver")


@effect(needs=needs_field, follows_field=True, prior=Prior(11.7, EXPANSION_U_PPM_PER_K), declarable=True)
def axis_expansion(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Integral of the seen rise along the measured line: K mm times 1e-6 is 1e-3 um per ppm/K."""
    yield Candidate((readings.at(readings.series["axis_integral"]) * 1e-3)[:, None], {}, ("ppm/K",))


@effect(needs=needs_field, follows_field=True, declarable=True)
def table_offset(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Mean rise of the seen table."""
    yield Candidate(readings.at(readings.series["mean_rise"])[:, None], {}, ("um/K",))


@effect(needs=needs_field, follows_field=True, excited_by="field")
def thermal_lag(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Delayed copies of the seen temperatures, flat and along the axis."""
    # Between two frames the field is a straight line; a shorter lag is not in the data.
    frames_min = float(np.median(np.diff(readings.series["mean_rise"].seconds))) / 60.0
    late = (
        first_order_responses(readings.series[name], near, LAGS_MIN, ratio=1.5, second=_SECOND_BODY_TRIED)
        for name in ("mean_rise", "axis_integral")
    )
    for (mean, response), (integral, _) in zip(*late, strict=True):
        if float(response["time_constant_min"]) < 2.0 * frames_min:
            continue
        offset, axis = readings.at(mean), readings.at(integral) * 1e-3
        yield Candidate(offset[:, None], {**response, "shape": "flat"}, ("um/K",))
        yield Candidate(axis[:, None], {**response, "shape": "linear"}, ("ppm/K",))
        both: Parameters = {**response, "shape": "flat and linear"}
        yield Candidate(np.column_stack([offset, axis]), both, ("um/K", "ppm/K"))
        # A bed that is warmer above than below bends; with the Abbe offset its angle makes an error that grows along the axis.
        bending = (readings.at(readings.series["mean_rise"]) - offset) * readings.share
        yield Candidate(bending[:, None], {**response, "shape": "bending"}, ("um/K",))


@effect(needs=_needs_driver, masked_by=unmeasured_expansion, excited_by="driver")
def unseen_heat_source(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Responses to the logged drivers, flat and along the axis."""
    for name in readings.drivers:
        unit = um_per(readings.series[name].units)
        for lagged, response in first_order_responses(
            readings.series[name], near, LAGS_MIN, ratio=1.5, second=_SECOND_BODY_TRIED
        ):
            settled = readings.at(lagged)
            # What the body was before the log began is not known; its memory of it dies away with the same time constant.
            memory = np.exp(-readings.seconds / (60.0 * float(response["time_constant_min"])))
            for shape, along in _SHAPES.items():
                parameters: Parameters = {"follows": name, **response, "shape": shape}
                follow = [settled * readings.share**power for power in along]
                start = [memory * readings.share**power for power in along]
                units = (unit,) * len(along)
                yield Candidate(np.column_stack(follow), {**parameters, "start": "settled"}, units)
                both, units = np.column_stack([*follow, *start]), units + ("um",) * len(along)
                yield Candidate(both, {**parameters, "start": "free"}, units, beside=len(along))


#: What shows the table itself (camera, sensors along the axis, the sensor of the material), and the pressure of the air, which moves no
#: part of a machine.
_NO_INFLUENCE = frozenset(
    {"mean_rise", "axis_integral", "local_rise", "patch_mean_rise", "patch_axis_integral"}
    | {"material_temperature", "air_pressure"}
)


def _logged(readings: Readings) -> list[str]:
    """Names of the series that are logged beside the field and the drivers."""
    return [name for name in readings.series if name not in _NO_INFLUENCE and name not in readings.drivers]


@effect(
    needs=lambda readings: None if _logged(readings) else lacks("log"),
    masked_by=unmeasured_expansion,
    excited_by="driver",
)
def logged_influence(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Delayed copies of every logged series, flat and along the axis."""
    for name in _logged(readings):
        unit = um_per(readings.series[name].units)
        for lagged, response in first_order_responses(readings.series[name], near, LAGS_MIN, ratio=1.5):
            late = readings.at(lagged)
            # Beside a level of 20 degC or 1000 hPa, which the static profile holds, what changes would count as rounding.
            late = late - late.mean()
            for shape, along in _SHAPES.items():
                parameters: Parameters = {"follows": name, **response, "shape": shape}
                columns = np.column_stack([late * readings.share**power for power in along])
                yield Candidate(columns, parameters, (unit,) * len(along))


@effect(declarable=True)
def quasi_static(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Rise of every temperature sensor."""
    sensors = [series for name, series in readings.series.items() if name.startswith(SENSOR_PREFIX)]
    yield Candidate(np.column_stack([readings.at(series) for series in sensors]), {}, ("um/K",) * len(sensors))
