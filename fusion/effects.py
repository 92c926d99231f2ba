"""L4 - The library of effects: what a measured drift may contain, each with its physics, its columns and its parameters.

An effect offers *members*: columns per reading for given nonlinear parameters (a time constant, an instant, a period). Which member
fits, and whether the effect deserves to be named at all, is decided in :mod:`fusion.loop`. Signatures: effects.md of the facts
(shape along the axis, sign with the direction of approach, course in time); physics by the sources named with each effect.

A user's own effect is an :class:`Effect` under the entry-point group ``thermofuse.effects``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points

import numpy as np
from numpy.typing import NDArray

from fusion.episodes import cycle_starts, event_instants, instants_near, jumps, sensor_jumps, stuck_sensors
from fusion.readings import Readings
from interferometry.compensation import air_index

Array = NDArray[np.float64]
Parameters = dict[str, float | str]

#: First-order time constants that are tried, minutes: from a thin part to a column or bed. Neighbours are so close that their
#: responses to any input correlate by more than 0.98, so that a finer grid would find nothing more.
LAGS_MIN = (5.0, 7.5, 11.0, 17.0, 25.0, 38.0, 57.0, 86.0, 130.0, 195.0)
#: A coarser choice for states that only scale another pattern.
_STATE_LAGS_MIN = (10.0, 20.0, 40.0, 80.0, 160.0)
WARM_UPS_MIN = (15.0, 30.0, 60.0, 120.0)
LASER_WARM_UPS_MIN = (3.0, 6.0, 12.0, 24.0)


@dataclass(frozen=True)
class Member:
    """One way an effect could enter: columns (n, q) in um per unit coefficient, and the parameters that made them."""

    columns: Array
    parameters: Mapping[str, float | str]
    units: tuple[str, ...]
    event_s: float | None = None


@dataclass(frozen=True)
class Effect:
    """A named effect.

    Attributes
    ----------
    name : as in results.json
    physics : one paragraph for the report
    source : where the signature comes from
    members : from the readings, the coefficients of the current model and, for a closer look, a member near which to search, to the
        members that can be tried
    needs : why it cannot be tried with these readings, or None
    excited_by : ``"field"`` or ``"driver"`` where the effect is only told apart by switching of that kind, else ``""``
    """

    name: str
    physics: str
    source: str
    members: Callable[[Readings, Mapping[str, float], Member | None], Iterator[Member]]
    needs: Callable[[Readings], str | None] = field(default=lambda readings: None)
    excited_by: str = ""


def _column(*columns: Array) -> Array:
    return np.column_stack(columns)


def axis_expansion_column(readings: Readings) -> Array:
    """Expansion of the seen table along the measured line, um per ppm/K: K mm times 1e-6 is 1e-3 um."""
    return readings.at(readings.series["axis_integral"]) * 1e-3


def table_offset_column(readings: Readings) -> Array:
    """Mean rise of the seen table, um per um/K."""
    return readings.at(readings.series["mean_rise"])


def _declared(name: str) -> Callable[[Readings, Mapping[str, float], Member | None], Iterator[Member]]:
    def members(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
        if name == "axis_expansion":
            yield Member(_column(axis_expansion_column(readings)), {}, ("ppm/K",))
        else:
            yield Member(_column(table_offset_column(readings)), {}, ("um/K",))

    return members


def _needs_field(readings: Readings) -> str | None:
    return None if "mean_rise" in readings.series else "the campaign holds no thermal frames"


def _needs_driver(readings: Readings) -> str | None:
    return (
        None
        if readings.drivers
        else "nothing that drives a heat source was logged; log duty, speed or load as [drivers]"
    )


def _needs_air(readings: Readings) -> str | None:
    missing = [name for name in ("air_temperature", "air_pressure", "relative_humidity") if name not in readings.series]
    return f"the environment log has no {', '.join(missing)}" if missing else None


def _needs_material(readings: Readings) -> str | None:
    return None if "material_temperature" in readings.series else "the environment log has no material_temperature"


def warm_up(readings: Readings, minutes: float) -> Array:
    """Approach to a steady state from the first reading on, 0 to 1, (n,)."""
    if minutes <= 0.0:
        return np.ones_like(readings.seconds)
    return 1.0 - np.exp(-readings.seconds / (60.0 * minutes))


def _near(near: Member | None, parameter: str, grid: Iterable[float], *, ratio: float) -> tuple[float, ...]:
    """The grid of a parameter, or a finer one within a factor of what was found."""
    if near is None:
        return tuple(grid)
    found = float(near.parameters[parameter])
    return (0.0,) if found == 0.0 else tuple(float(found * factor) for factor in np.geomspace(1 / ratio, ratio, 11))


def _states(readings: Readings, near: Member | None) -> Iterator[tuple[Array, Parameters]]:
    """Thermal states that a part of the machine may follow: lagged table, lagged drivers, a plain warm-up."""
    if "mean_rise" in readings.series:
        for minutes in _near(near, "time_constant_min", (0.0, *_STATE_LAGS_MIN), ratio=2.0):
            lagged = readings.series["mean_rise"].lagged(60.0 * minutes)
            yield readings.at(lagged), {"follows": "mean_rise", "time_constant_min": minutes}
    for name in readings.drivers:
        for minutes in _near(near, "time_constant_min", (5.0, *_STATE_LAGS_MIN), ratio=2.0):
            for start, at_rest in (("settled", None), ("at rest", 0.0)):
                lagged = readings.series[name].lagged(60.0 * minutes, at_rest=at_rest)
                yield readings.at(lagged), {"follows": name, "time_constant_min": minutes, "start": start}
    for minutes in _near(near, "time_constant_min", WARM_UPS_MIN, ratio=2.0):
        yield warm_up(readings, minutes), {"follows": "warm_up", "time_constant_min": minutes}


def _thermal_lag(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    # Between two frames the field is a straight line; a shorter lag is not in the data.
    frames_min = float(np.median(np.diff(readings.series["mean_rise"].seconds))) / 60.0
    for minutes in _near(near, "time_constant_min", LAGS_MIN, ratio=1.5):
        if minutes < 2.0 * frames_min:
            continue
        axis = readings.at(readings.series["axis_integral"].lagged(60.0 * minutes)) * 1e-3
        offset = readings.at(readings.series["mean_rise"].lagged(60.0 * minutes))
        yield Member(_column(offset), {"time_constant_min": minutes, "shape": "flat"}, ("um/K",))
        yield Member(_column(axis), {"time_constant_min": minutes, "shape": "linear"}, ("ppm/K",))
        both: Parameters = {"time_constant_min": minutes, "shape": "flat and linear"}
        yield Member(_column(offset, axis), both, ("um/K", "ppm/K"))


def _unseen_heat_source(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    for name in readings.drivers:
        unit = readings.series[name].units
        for minutes in _near(near, "time_constant_min", LAGS_MIN, ratio=1.5):
            settled = readings.at(readings.series[name].lagged(60.0 * minutes))
            # What the body was before the log began is not known; its memory of it dies away with the same time constant.
            memory = np.exp(-readings.seconds / (60.0 * minutes))
            for shape, along in (
                ("flat", (1.0,)),
                ("linear", (readings.share,)),
                ("flat and linear", (1.0, readings.share)),
            ):
                found: Parameters = {"follows": name, "time_constant_min": minutes, "shape": shape}
                known = [settled * factor for factor in along]
                start = [memory * factor for factor in along]
                per = (f"um/({unit})",) * len(along)
                yield Member(_column(*known), {**found, "start": "settled"}, per)
                yield Member(_column(*known, *start), {**found, "start": "free"}, per + ("um",) * len(along))


def refractivity_change_ppm(readings: Readings) -> Array:
    """Change of the index of air since the first reading, ppm (Ciddor), (n,)."""
    air = [readings.at(readings.series[name]) for name in ("air_temperature", "air_pressure", "relative_humidity")]
    index = air_index(*air)
    return np.asarray((index - index[0]) * 1e6, float)


def _dead_path(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    yield Member(_column(refractivity_change_ppm(readings) * 1e-3), {}, ("mm",))


def _air_index(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    yield Member(_column(refractivity_change_ppm(readings) * 1e-3 * readings.position_mm), {}, ("1",))


def _material_compensation(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    material = readings.at(readings.series["material_temperature"])
    yield Member(_column((material - material[0]) * readings.position_mm * 1e-3), {}, ("ppm/K",))


def _angular_growth(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    for state, found in _states(readings, near):
        yield Member(_column(state * readings.share**2), found, (_state_unit(readings, found),))


def _reversal_drift(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    for state, found in _states(readings, near):
        yield Member(_column(state * 0.5 * readings.sign), found, (_state_unit(readings, found),))


def _state_unit(readings: Readings, found: Mapping[str, float | str]) -> str:
    follows = str(found["follows"])
    return "um" if follows == "warm_up" else f"um/({readings.series[follows].units})"


def _needs_both_directions(readings: Readings) -> str | None:
    return None if np.unique(readings.sign).size == 2 else "only one direction of approach was measured"


def _step_event(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    instants = (
        event_instants(readings) if near is None or near.event_s is None else instants_near(readings, near.event_s)
    )
    for instant in instants:
        yield Member(_column((readings.seconds >= instant).astype(float)), {"time_s": float(instant)}, ("um",), instant)


def periods_min(readings: Readings) -> Array:
    """Periods that are tried: evenly spaced in frequency at half the resolution of the record, 3 min to a third of it.

    Periods that the cycle or its halves would imitate are left out: every slow change of the profile has lines there.
    """
    span = float(readings.seconds[-1] - readings.seconds[0]) / 60.0
    frequencies = np.arange(3.0 / span, 1.0 / 3.0, 0.5 / span)
    cycle = 60.0 / float(np.median(np.diff(cycle_starts(readings))))
    order = np.maximum(1.0, np.round(frequencies / cycle))
    return np.asarray(1.0 / frequencies[np.abs(frequencies - order * cycle) > 4.0 / span])


def _periodic_disturbance(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    periods = periods_min(readings) if near is None else _close_periods(readings, float(near.parameters["period_min"]))
    for period in periods:
        phase = 2 * np.pi * readings.seconds / (60.0 * period)
        waves = _column(np.cos(phase), np.sin(phase))
        yield Member(waves, {"period_min": float(period), "shape": "flat"}, ("um", "um"))
        linear = waves * readings.share[:, None]
        yield Member(linear, {"period_min": float(period), "shape": "linear"}, ("um", "um"))


def spatial_frequencies(readings: Readings) -> Array:
    """Frequencies along the axis (1/mm) from two periods over the travel up to what the target spacing can show."""
    positions = np.sort(readings.positions_mm)
    travel = positions[-1] - positions[0]
    return np.arange(2.0, 0.5 * (positions.size - 1) + 1e-9, 0.5) / travel


def aliased_lead_mm(readings: Readings, frequency: float) -> str:
    """Leads between 2 and 50 mm that evenly spaced targets show as the same frequency."""
    spacing = np.diff(np.sort(readings.positions_mm))
    if np.ptp(spacing) > 1e-6 * spacing.mean():
        return f"{1 / frequency:.3g} mm (targets unevenly spaced: no alias)"
    sampling = 1.0 / spacing.mean()
    orders = np.arange(0, int(0.5 / sampling) + 2)
    leads = {1 / f for k in orders for f in (k * sampling + frequency, k * sampling - frequency) if 1 / 50 <= f <= 0.5}
    return ", ".join(f"{lead:.3g}" for lead in sorted(leads, reverse=True)) + " mm"


def _close_periods(readings: Readings, found_min: float) -> Array:
    """Periods around one that was found, as close as the record can tell apart."""
    span = float(readings.seconds[-1] - readings.seconds[0]) / 60.0
    return np.asarray(1.0 / (1.0 / found_min + np.linspace(-0.5, 0.5, 21) / span))


def _pitch_error(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    slow = {0.0, 40.0, 60.0}
    states = [pair for pair in _states(readings, near) if near is not None or pair[1]["time_constant_min"] in slow]
    frequencies = spatial_frequencies(readings)
    if near is not None:
        frequencies = 1.0 / float(near.parameters["period_mm"]) + np.linspace(-0.25, 0.25, 5) / np.ptp(
            readings.positions_mm
        )
    for frequency in frequencies:
        phase = 2 * np.pi * frequency * readings.position_mm
        waves = _column(np.cos(phase), np.sin(phase))
        for state, found in states:
            parameters: Parameters = {
                **found,
                "period_mm": float(1 / frequency),
                "possible_leads": aliased_lead_mm(readings, frequency),
            }
            yield Member(waves * state[:, None], parameters, (_state_unit(readings, found),) * 2)


def _laser_warm_up(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    for minutes in _near(near, "time_constant_min", LASER_WARM_UPS_MIN, ratio=2.0):
        settling = 1.0 - warm_up(readings, minutes)
        linear = settling * readings.position_mm * 1e-3
        yield Member(_column(linear), {"time_constant_min": minutes, "shape": "linear"}, ("ppm",))
        both: Parameters = {"time_constant_min": minutes, "shape": "linear with dead path"}
        yield Member(_column(linear, settling), both, ("ppm", "um"))


def _camera_offset(readings: Readings, coefficients: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    weight = _field_weight(readings, coefficients)
    for before, after, size in jumps(readings.series["mean_rise"]):
        seen = np.clip((readings.seconds - before) / (after - before), 0.0, 1.0)
        parameters: Parameters = {"time_s": after, "jump_of_the_field_K": size}
        yield Member(_column(seen * weight), parameters, ("K",), event_s=after)


def _field_weight(readings: Readings, coefficients: Mapping[str, float]) -> Array:
    """What one kelvin of false uniform rise does to the model's prediction, um per K (n,)."""
    offset = coefficients.get("table_offset", 0.0)
    return -(offset + coefficients.get("axis_expansion", 0.0) * readings.position_mm * 1e-3)


def _needs_jump(readings: Readings) -> str | None:
    if "mean_rise" not in readings.series:
        return "the campaign holds no thermal frames"
    return None if jumps(readings.series["mean_rise"]) else "no frame jumps against its neighbours"


def _reflected_source(readings: Readings, coefficients: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    false_rise = readings.at(readings.series["patch_mean_rise"])
    false_integral = readings.at(readings.series["patch_axis_integral"]) * 1e-3
    wrong = (
        coefficients.get("table_offset", 0.0) * false_rise + coefficients.get("axis_expansion", 0.0) * false_integral
    )
    yield Member(_column(-wrong), {}, ("1",))


def _needs_patch(readings: Readings) -> str | None:
    if "patch_mean_rise" not in readings.series:
        return "no patch of the field switches faster than heat can flow"
    return None


def _sensor_fault(readings: Readings, _: Mapping[str, float], near: Member | None) -> Iterator[Member]:
    for name, before, after, size in sensor_jumps(readings):
        late = (readings.seconds >= 0.5 * (before + after)).astype(float)
        jumped: Parameters = {"sensor": name, "time_s": after, "jump": size}
        yield Member(_column(late * readings.position_mm * 1e-3), jumped, ("ppm",), event_s=after)
    for name, start in stuck_sensors(readings):
        since = np.clip(readings.seconds - start, 0.0, None) / 3600.0
        stuck: Parameters = {"sensor": name, "time_s": start, "jump": 0.0}
        yield Member(_column(since * readings.position_mm * 1e-3), stuck, ("ppm/h",), event_s=start)


def _needs_sensor_episode(readings: Readings) -> str | None:
    if sensor_jumps(readings) or stuck_sensors(readings):
        return None
    return "no logged sensor jumps or sticks"


LIBRARY: tuple[Effect, ...] = (
    Effect(
        "axis_expansion",
        "The table lengthens along the measured line as it warms: one coefficient times the integral of the seen rise.",
        "ISO/TR 16015; steel 11.7 ppm/K",
        _declared("axis_expansion"),
        _needs_field,
    ),
    Effect(
        "table_offset",
        "Everything between table and laser moves together with the table's mean temperature: the same shift at all positions.",
        "ISO 230-3, thermal distortion",
        _declared("table_offset"),
        _needs_field,
    ),
    Effect(
        "thermal_lag",
        "A remote or massive part follows the seen table late, with a time constant of its own, and goes on moving after it.",
        "first-order response of a lumped heat capacity",
        _thermal_lag,
        _needs_field,
        excited_by="field",
    ),
    Effect(
        "unseen_heat_source",
        "A source out of the camera's sight (spindle, motor, bearing) warms with the logged load and moves the reading with its "
        "own time constant.",
        "Mayr et al. 2012, CIRP Annals 61, 771",
        _unseen_heat_source,
        _needs_driver,
        excited_by="driver",
    ),
    Effect(
        "dead_path",
        "Air between the interferometer and its zero is not compensated: the reading shifts with the index of air.",
        "Ciddor 1996; ISO 230-1",
        _dead_path,
        _needs_air,
    ),
    Effect(
        "air_index",
        "The index of air is not, or wrongly, compensated along the measured length.",
        "Ciddor 1996: -0.955 ppm/K, +0.268 ppm/hPa",
        _air_index,
        _needs_air,
    ),
    Effect(
        "material_compensation",
        "The expansion coefficient or the place of the material probe is wrong: a stretch that follows the probe.",
        "ISO 230-2, 7.1; ISO/TR 16015",
        _material_compensation,
        _needs_material,
    ),
    Effect(
        "angular_growth",
        "Guide or table bends as it warms; the Abbe offset turns the growing angle into an error that is quadratic along the axis.",
        "Abbe principle, Bryan 1979: 1 arcsec x 100 mm = 0.48 um",
        _angular_growth,
    ),
    Effect(
        "reversal_drift",
        "Backlash or wind-up changes with temperature: both directions move apart by the same amount at every position.",
        "ISO 230-2, reversal value B",
        _reversal_drift,
        _needs_both_directions,
    ),
    Effect(
        "step_event",
        "A mount, clamp or optic slips once: all readings after that instant are shifted.",
        "level shift at one instant",
        _step_event,
    ),
    Effect(
        "periodic_disturbance",
        "Cooling, coolant or air conditioning switches in a fixed rhythm.",
        "line in the spectrum of the readings' own times",
        _periodic_disturbance,
    ),
    Effect(
        "pitch_error",
        "The cyclic error of the screw changes as it warms: a wave along the axis whose size follows a thermal state.",
        "periodic error of the lead; aliased where the spacing is a multiple of the lead",
        _pitch_error,
    ),
    Effect(
        "camera_offset",
        "The camera's zero steps between two frames (flat-field correction): the field is wrong from then on, the machine did not move.",
        "uniform jump of the field without a jump of the readings",
        _camera_offset,
        _needs_jump,
    ),
    Effect(
        "reflected_source",
        "A warm body mirrors in the table: a patch of the field changes faster than heat can flow, and the readings do not follow.",
        "reflection of (1 - emissivity) of the surroundings",
        _reflected_source,
        _needs_patch,
    ),
    Effect(
        "laser_warm_up",
        "The laser's wavelength settles during the first minutes: a stretch, and a shift by the dead path, that die away.",
        "frequency stabilisation of a He-Ne laser",
        _laser_warm_up,
    ),
    Effect(
        "sensor_fault",
        "A sensor of the environment unit jumps or sticks, and the instrument's own compensation believes it.",
        "jump or frozen value in the environment log",
        _sensor_fault,
        _needs_sensor_episode,
    ),
)


def library() -> dict[str, Effect]:
    """All effects by name: the built-in ones, then those that users registered as ``thermofuse.effects``."""
    found = {effect.name: effect for effect in LIBRARY}
    for point in entry_points(group="thermofuse.effects"):
        effect = point.load()
        found[effect.name] = effect
    return found
