"""The candidates of the effects: columns per reading for given time constants, instants, periods.

Units: every column is in um per unit of its coefficient. Sources stand with the effects in :mod:`fusion.effects.library`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion._typing import Array
from fusion.alignment.readings import Readings, Series
from fusion.effects.jumps import cycle_starts, event_instants, instants_near, jumps, sensor_jumps, stuck_sensors
from interferometry.compensation import air_index

Parameters = dict[str, float | str]

#: First-order time constants that are tried, minutes: from a thin part to a column or bed. Neighbours are so close that their
#: responses to any input correlate by more than 0.98, so that a finer grid would find nothing more.
LAGS_MIN = (5.0, 7.5, 11.0, 17.0, 25.0, 38.0, 57.0, 86.0, 130.0, 195.0)
#: A coarser choice for states that only scale another pattern.
_STATE_LAGS_MIN = (10.0, 20.0, 40.0, 80.0, 160.0)
WARM_UPS_MIN = (15.0, 30.0, 60.0, 120.0)
LASER_WARM_UPS_MIN = (3.0, 6.0, 12.0, 24.0)
#: Periods that are tried at most: all down to 3 min in a record of 7.5 h, down to 11 min in one of 28 h.
MOST_PERIODS = 300
#: Shortest lead of a screw that is tried where the targets are spaced unevenly.
SHORTEST_LEAD_MM = 4.0


@dataclass(frozen=True)
class Prior:
    """What is known of a coefficient before the test: its mean and standard uncertainty, in the coefficient's unit."""

    mean: float
    u: float


@dataclass(frozen=True)
class Candidate:
    """One way an effect could enter: columns (n, q) in um per unit coefficient, and the parameters that made them.

    ``prior`` is what is known of the first coefficient beforehand, None where nothing is. The last ``beside`` columns may be there without
    the effect; what they explain is no evidence for it.
    """

    columns: Array
    parameters: Mapping[str, float | str]
    units: tuple[str, ...]
    event_s: float | None = None
    prior: Prior | None = None
    beside: int = 0

    def on(self, used: NDArray[np.bool_]) -> Candidate:
        """The same candidate with its columns at some of the readings."""
        return replace(self, columns=self.columns[used])


def _column(*columns: Array) -> Array:
    return np.column_stack(columns)


def axis_expansion_column(readings: Readings) -> Array:
    """Expansion of the seen table along the measured line, um per ppm/K: K mm times 1e-6 is 1e-3 um."""
    return readings.at(readings.series["axis_integral"]) * 1e-3


def table_offset_column(readings: Readings) -> Array:
    """Mean rise of the seen table, um per um/K."""
    return readings.at(readings.series["mean_rise"])


def declared_candidates(name: str) -> Callable[[Readings, Mapping[str, float], Candidate | None], Iterator[Candidate]]:
    """Return the one candidate of a declared effect."""

    def candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
        if name == "axis_expansion":
            yield Candidate(_column(axis_expansion_column(readings)), {}, ("ppm/K",))
        else:
            yield Candidate(_column(table_offset_column(readings)), {}, ("um/K",))

    return candidates


def warm_up(readings: Readings, minutes: float) -> Array:
    """Approach to a steady state from the first reading on, 0 to 1, (n,)."""
    if minutes <= 0.0:
        return np.ones_like(readings.seconds)
    return 1.0 - np.exp(-readings.seconds / (60.0 * minutes))


def _near(near: Candidate | None, parameter: str, grid: Iterable[float], *, ratio: float) -> tuple[float, ...]:
    """The grid of a parameter, or a finer one within a factor of what was found and of the grid's ends.

    Zero has no factor, and so no finer grid.
    """
    tried = tuple(grid)
    found = 0.0 if near is None else float(near.parameters[parameter])
    if found == 0.0:
        return tried
    least, most = 0.999 * min(value for value in tried if value > 0.0) / ratio, 1.001 * max(tried) * ratio
    finer = (float(found * factor) for factor in np.geomspace(1 / ratio, ratio, 11))
    return tuple(value for value in finer if least <= value <= most)


#: Time constants of a second body, as shares of the first one's: heat may reach a part through another. The search tries one, a closer
#: look these.
_SECOND_BODY = (0.25, 0.5, 1.0)
_SECOND_BODY_TRIED = (0.25,)


def _responses(
    series: Series,
    near: Candidate | None,
    grid: Iterable[float],
    *,
    ratio: float,
    at_rest: float | None = None,
    second: Iterable[float] = (),
) -> Iterator[tuple[Series, Parameters]]:
    """First-order responses over a grid of time constants, and those of two bodies in series where ``second`` names shares to try."""
    shares = tuple(second) if near is None else _SECOND_BODY
    for minutes in _near(near, "time_constant_min", grid, ratio=ratio):
        first = series.lagged(60.0 * minutes, at_rest=at_rest)
        yield first, {"time_constant_min": minutes}
        for behind in (share * minutes for share in shares if minutes > 0.0):
            found: Parameters = {"time_constant_min": minutes, "second_time_constant_min": behind}
            yield first.lagged(60.0 * behind), found


def _states(readings: Readings, near: Candidate | None) -> Iterator[tuple[Array, Parameters]]:
    """Thermal states that a part of the machine may follow: lagged table, lagged drivers, a plain warm-up."""
    if "mean_rise" in readings.series:
        for lagged, found in _responses(readings.series["mean_rise"], near, (0.0, *_STATE_LAGS_MIN), ratio=2.0):
            yield readings.at(lagged), {"follows": "mean_rise", **found}
    for name in readings.drivers:
        for start, at_rest in (("settled", None), ("at rest", 0.0)):
            grid = (5.0, *_STATE_LAGS_MIN)
            for lagged, found in _responses(readings.series[name], near, grid, ratio=2.0, at_rest=at_rest):
                yield readings.at(lagged), {"follows": name, "start": start, **found}
    for minutes in _near(near, "time_constant_min", WARM_UPS_MIN, ratio=2.0):
        yield warm_up(readings, minutes), {"follows": "warm_up", "time_constant_min": minutes}


def thermal_lag_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Lagged copies of the seen temperatures."""
    # Between two frames the field is a straight line; a shorter lag is not in the data.
    frames_min = float(np.median(np.diff(readings.series["mean_rise"].seconds))) / 60.0
    for minutes in _near(near, "time_constant_min", LAGS_MIN, ratio=1.5):
        if minutes < 2.0 * frames_min:
            continue
        axis = readings.at(readings.series["axis_integral"].lagged(60.0 * minutes)) * 1e-3
        offset = readings.at(readings.series["mean_rise"].lagged(60.0 * minutes))
        yield Candidate(_column(offset), {"time_constant_min": minutes, "shape": "flat"}, ("um/K",))
        yield Candidate(_column(axis), {"time_constant_min": minutes, "shape": "linear"}, ("ppm/K",))
        both: Parameters = {"time_constant_min": minutes, "shape": "flat and linear"}
        yield Candidate(_column(offset, axis), both, ("um/K", "ppm/K"))


def unseen_heat_source_candidates(
    readings: Readings, _: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """Responses to the logged drivers."""
    for name in readings.drivers:
        unit = readings.series[name].units
        for lagged, response in _responses(readings.series[name], near, LAGS_MIN, ratio=1.5, second=_SECOND_BODY_TRIED):
            settled = readings.at(lagged)
            # What the body was before the log began is not known; its memory of it dies away with the same time constant.
            memory = np.exp(-readings.seconds / (60.0 * float(response["time_constant_min"])))
            for shape, along in (
                ("flat", (1.0,)),
                ("linear", (readings.share,)),
                ("flat and linear", (1.0, readings.share)),
            ):
                found: Parameters = {"follows": name, **response, "shape": shape}
                known = [settled * factor for factor in along]
                start = [memory * factor for factor in along]
                per = (_per(unit),) * len(along)
                yield Candidate(_column(*known), {**found, "start": "settled"}, per)
                units = per + ("um",) * len(along)
                yield Candidate(_column(*known, *start), {**found, "start": "free"}, units, beside=len(along))


def refractivity_change_ppm(readings: Readings) -> Array:
    """Change of the index of air since the first reading, ppm (Ciddor), (n,)."""
    air = [readings.at(readings.series[name]) for name in ("air_temperature", "air_pressure", "relative_humidity")]
    index = air_index(*air)
    return np.asarray((index - index[0]) * 1e6, float)


def dead_path_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, the same at all positions."""
    yield Candidate(_column(refractivity_change_ppm(readings) * 1e-3), {}, ("mm",))


def air_index_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """The index of air, along the axis."""
    yield Candidate(_column(refractivity_change_ppm(readings) * 1e-3 * readings.position_mm), {}, ("1",))


def material_compensation_candidates(
    readings: Readings, _: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """The material probe, along the axis."""
    material = readings.at(readings.series["material_temperature"])
    yield Candidate(_column((material - material[0]) * readings.position_mm * 1e-3), {}, ("ppm/K",))


def angular_growth_candidates(
    readings: Readings, _: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """States times the square of the position."""
    for state, found in _states(readings, near):
        yield Candidate(_column(state * readings.share**2), found, (_state_unit(readings, found),))


def reversal_drift_candidates(
    readings: Readings, _: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """States times half the direction of approach."""
    for state, found in _states(readings, near):
        yield Candidate(_column(state * 0.5 * readings.sign), found, (_state_unit(readings, found),))


def _state_unit(readings: Readings, found: Mapping[str, float | str]) -> str:
    follows = str(found["follows"])
    return "um" if follows == "warm_up" else _per(readings.series[follows].units)


def _per(unit: str) -> str:
    """Unit of a shift per unit of what drives it; a share has none."""
    return "um" if unit == "1" else f"um/({unit})"


def step_event_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps at the instants that can be tried."""
    instants = (
        event_instants(readings) if near is None or near.event_s is None else instants_near(readings, near.event_s)
    )
    for instant in instants:
        yield Candidate(
            _column((readings.seconds >= instant).astype(float)), {"time_s": float(instant)}, ("um",), instant
        )


def periods_min(readings: Readings) -> Array:
    """Periods that are tried: evenly spaced in frequency at half the resolution of the record, 3 min to a third of it.

    Periods that the cycle or its halves would imitate are left out: every slow change of the profile has lines there.
    """
    span = _span_min(readings)
    return np.asarray(1.0 / off_the_cycle(readings, np.arange(3.0 / span, 1.0 / 3.0, 0.5 / span, dtype=np.float64)))


def _span_min(readings: Readings) -> float:
    return float(readings.seconds[-1] - readings.seconds[0]) / 60.0


def off_the_cycle(readings: Readings, frequencies: Array) -> Array:
    """Those frequencies (1/min) that are not within four lines of the cycle or its parts."""
    cycle = 60.0 / float(np.median(np.diff(cycle_starts(readings))))
    order = np.maximum(1.0, np.round(frequencies / cycle))
    return np.asarray(frequencies[np.abs(frequencies - order * cycle) > 4.0 / _span_min(readings)])


def periodic_disturbance_candidates(
    readings: Readings, _: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """Waves in time, flat or along the axis."""
    # A long campaign tells so many periods apart that the shortest are left out: the search stays linear in the readings.
    periods = (
        periods_min(readings)[:MOST_PERIODS]
        if near is None
        else _close_periods(readings, float(near.parameters["period_min"]))
    )
    for period in periods:
        phase = 2 * np.pi * readings.seconds / (60.0 * period)
        waves = _column(np.cos(phase), np.sin(phase))
        yield Candidate(waves, {"period_min": float(period), "shape": "flat"}, ("um", "um"))
        linear = waves * readings.share[:, None]
        yield Candidate(linear, {"period_min": float(period), "shape": "linear"}, ("um", "um"))


def spatial_frequencies(readings: Readings) -> Array:
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


def aliased_lead_mm(readings: Readings, frequency: float) -> str:
    """Leads between 2 and 50 mm that evenly spaced targets show as the same frequency."""
    spacing = np.diff(np.sort(readings.positions_mm))
    if not _evenly_spaced(readings):
        return f"{1 / frequency:.3g} mm (targets unevenly spaced: no alias)"
    sampling = 1.0 / spacing.mean()
    orders = np.arange(0, int(0.5 / sampling) + 2)
    leads = {1 / f for k in orders for f in (k * sampling + frequency, k * sampling - frequency) if 1 / 50 <= f <= 0.5}
    return ", ".join(f"{lead:.3g}" for lead in sorted(leads, reverse=True)) + " mm"


def hidden_leads_mm(readings: Readings) -> str:
    """Leads between 2 and 50 mm of which evenly spaced targets see one phase only; empty where the spacing is uneven."""
    if not _evenly_spaced(readings):
        return ""
    spacing = float(np.ptp(readings.positions_mm)) / (readings.positions_mm.size - 1)
    leads = [spacing / k for k in range(1, int(spacing / 2.0) + 1) if 2.0 <= spacing / k <= 50.0]
    return ", ".join(f"{lead:.3g}" for lead in leads) + " mm" if leads else ""


def _close_periods(readings: Readings, found_min: float) -> Array:
    """Periods around one that was found, as close as the record can tell apart; none that the search would not have tried."""
    span = _span_min(readings)
    near = 1.0 / found_min + np.linspace(-0.5, 0.5, 21) / span
    near = near[(near > 2.999 / span) & (near < 1.001 / 3.0)]
    return np.asarray(1.0 / off_the_cycle(readings, near))


def pitch_error_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Waves along the axis times slow states."""
    states = list(_states(readings, near))
    if near is None:
        states = [pair for pair in states if pair[1]["time_constant_min"] in {0.0, 40.0, 60.0}]
    if near is None and not _evenly_spaced(readings):
        # Uneven targets leave a hundred and more waves to try; each then follows one course of every kind only.
        states = [p for p in states if p[1]["time_constant_min"] != 0.0 and p[1].get("start") != "at rest"]
    frequencies = spatial_frequencies(readings)
    if near is not None:
        close = 1.0 / float(near.parameters["period_mm"]) + np.linspace(-0.25, 0.25, 5) / np.ptp(readings.positions_mm)
        # A wave longer than half the travel is a bending, not a screw's.
        frequencies = close[(close > 0.999 * frequencies[0]) & (close < 1.001 * frequencies[-1])]
    for frequency in frequencies:
        phase = 2 * np.pi * frequency * readings.position_mm
        waves = _column(np.cos(phase), np.sin(phase))
        for state, found in states:
            parameters: Parameters = {
                **found,
                "period_mm": float(1 / frequency),
                "possible_leads": aliased_lead_mm(readings, frequency),
            }
            yield Candidate(waves * state[:, None], parameters, (_state_unit(readings, found),) * 2)


def laser_warm_up_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Exponentials along the axis, with or without dead path."""
    for minutes in _near(near, "time_constant_min", LASER_WARM_UPS_MIN, ratio=2.0):
        settling = 1.0 - warm_up(readings, minutes)
        linear = settling * readings.position_mm * 1e-3
        yield Candidate(_column(linear), {"time_constant_min": minutes, "shape": "linear"}, ("ppm",))
        both: Parameters = {"time_constant_min": minutes, "shape": "linear with dead path"}
        yield Candidate(_column(linear, settling), both, ("ppm", "um"))


def camera_offset_candidates(
    readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """What a jump of the field does to the prediction of the model."""
    weight = _field_weight(readings, coefficients)
    for before, after, size in jumps(readings.series["mean_rise"]):
        seen = np.clip((readings.seconds - before) / (after - before), 0.0, 1.0)
        parameters: Parameters = {"time_s": after, "jump_of_the_field_K": size}
        yield Candidate(_column(seen * weight), parameters, ("K",), event_s=after)


def _field_weight(readings: Readings, coefficients: Mapping[str, float]) -> Array:
    """What one kelvin of false uniform rise does to the model's prediction, um per K (n,)."""
    offset = coefficients.get("table_offset", 0.0)
    return -(offset + coefficients.get("axis_expansion", 0.0) * readings.position_mm * 1e-3)


def reflected_source_candidates(
    readings: Readings, coefficients: Mapping[str, float], near: Candidate | None
) -> Iterator[Candidate]:
    """What a switching patch does to the prediction of the model."""
    false_rise = readings.at(readings.series["patch_mean_rise"])
    false_integral = readings.at(readings.series["patch_axis_integral"]) * 1e-3
    wrong = (
        coefficients.get("table_offset", 0.0) * false_rise + coefficients.get("axis_expansion", 0.0) * false_integral
    )
    yield Candidate(_column(-wrong), {}, ("1",))


def sensor_fault_candidates(readings: Readings, _: Mapping[str, float], near: Candidate | None) -> Iterator[Candidate]:
    """Steps and ramps along the axis where a sensor jumps or sticks."""
    for name, before, after, size in sensor_jumps(readings):
        late = (readings.seconds >= 0.5 * (before + after)).astype(float)
        jumped: Parameters = {"sensor": name, "time_s": after, "jump": size}
        yield Candidate(_column(late * readings.position_mm * 1e-3), jumped, ("ppm",), event_s=after)
    for name, start in stuck_sensors(readings):
        since = np.clip(readings.seconds - start, 0.0, None) / 3600.0
        stuck: Parameters = {"sensor": name, "time_s": start, "jump": 0.0}
        yield Candidate(_column(since * readings.position_mm * 1e-3), stuck, ("ppm/h",), event_s=start)
