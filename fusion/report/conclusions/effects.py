"""Added effects in words: what each is, what it follows, when it happened, and what to check."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion.products.results_loop import AxisStep, RecordStep, StepPart
from fusion.products.results_part import TimePart
from fusion.report.wording import duration, effect_words, measured, moment, number, print_unit

#: Effects as something that a machine or an instrument has, in a sentence.
_PHRASES = {
    "axis_expansion": "the expansion of the axis",
    "table_offset": "a shift with the table's mean temperature",
    "quasi_static": "displacements in proportion to the temperatures",
    "thermal_lag": "a part of the machine that follows the seen temperatures late",
    "unseen_heat_source": "a heat source that {unseen}",
    "dead_path": "the laser's dead path",
    "air_index": "the refractive index of the air",
    "material_compensation": "the laser's material compensation",
    "angular_growth": "a growing pitch or yaw of the axis",
    "reversal_drift": "a reversal error that changes",
    "step_event": "a sudden step",
    "periodic_disturbance": "a rhythm",
    "pitch_error": "a changing pitch error of the screw",
    "camera_offset": "a jump of the camera's zero",
    "reflected_source": "a reflection in the thermograms",
    "laser_warm_up": "the laser's warm-up",
    "sensor_fault": "a faulty sensor",
}


def phrase(name: str, *, record: bool) -> str:
    """Return an effect as something that the machine has.

    Parameters
    ----------
    name : str
        Name as in results.json.
    record : bool
        Whether sensors took the temperatures, instead of a camera.

    Examples
    --------
    >>> phrase("unseen_heat_source", record=False)
    'a heat source that the camera does not see'
    """
    unseen = "no sensor sees" if record else "the camera does not see"
    return _PHRASES[name].format(unseen=unseen) if name in _PHRASES else effect_words(name).name


def step_phrase(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return an added effect with what it follows, or when it happened.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    time : TimePart or None
        The part ``time`` of the results, for local time; None: UTC.
    record : bool
        Whether sensors took the temperatures, instead of a camera.
    """
    instant = when(step, time)
    details = (_follows(step.parameters), time_constant(step), _height(step), f"at {instant}" if instant else "")
    told = ", ".join(text for text in details if text)
    return phrase(step.effect, record=record) + (f" ({told})" if told else "")


def _follows(parameters: Mapping[str, Any]) -> str:
    """What an effect follows."""
    if "follows" not in parameters:
        return ""
    named = {"mean_rise": "the table's mean temperature", "warm_up": "one warm-up from the start"}
    followed = str(parameters["follows"])
    return f"follows {named.get(followed, f'the logged {followed}')}"


def time_constant(step: StepPart) -> str:
    """Return time constant or period of an effect with the range that fits as well; empty where it has none.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    """
    for name, words in (("time_constant_min", "time constant"), ("period_min", "period")):
        value = step.parameters.get(name)
        if isinstance(value, int | float) and value > 0:
            ends = [float(end) for end in step.parameter_ranges.get(name, ()) if isinstance(end, int | float)]
            known = f" [{number(ends[0], 2)} to {number(ends[1], 2)}]" if len(ends) == 2 else ""
            return f"{words} {number(float(value), 2)} min{known}"
    return ""


def _height(step: StepPart) -> str:
    """Height of a step."""
    if step.effect != "step_event" or not isinstance(step, AxisStep):
        return ""
    height = step.coefficients[0]
    return measured(height.value, height.u, print_unit(height.unit))


def when(step: StepPart, time: TimePart | None) -> str:
    """Return when an event happened: time of day and cycle, or time since the start; empty for an effect that lasts.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    time : TimePart or None
        The part ``time`` of the results, for local time; None: UTC.
    """
    told = [moment(step.event_time, time.zone if time else None)] if step.event_time else []
    if isinstance(step, AxisStep) and step.event_cycle is not None:
        told.append(f"cycle {step.event_cycle}")
    if isinstance(step, RecordStep) and step.event_s is not None:
        told.append(f"{duration(step.event_s)} after the start")
    return ", ".join(told)


def action(step: StepPart, time: TimePart | None, *, record: bool) -> str:
    """Return what to check on machine or instruments where an effect was missing; empty where the effect states nothing.

    Parameters
    ----------
    step : StepPart
        One of ``loop.steps``.
    time : TimePart or None
        The part ``time`` of the results, for local time; None: UTC.
    record : bool
        Whether sensors took the temperatures, instead of a camera.
    """
    followed, instant = str(step.parameters.get("follows", "")), when(step, time)
    if step.effect == "step_event" and instant:
        text = f"Look up {instant} in the logs of machine and laser: was the laser zeroed, its beam broken, a clamp or an optic moved?"
    elif step.effect == "unseen_heat_source" and followed:
        where = "no sensor sits" if record else "the camera does not look"
        text = (
            f'The missing heat follows the logged load "{followed}" ({time_constant(step)}): find what that load heats where {where} '
            "(motor, drive, screw bearing, spindle, hydraulics), and put a temperature sensor there for the next test."
        )
    else:
        text = effect_words(step.effect).remedy
    if step.confirmed or not text:
        return text
    return f"Not confirmed, so only where nothing else is found: {text[0].lower()}{text[1:]}"
