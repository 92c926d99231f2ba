"""Numbers and verdicts as a reader meets them: significant digits, unit, uncertainty, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fusion.effects.library import describe_effect
from fusion.products.results import Results
from fusion.products.results_inputs import Figures, InputsPart
from fusion.products.results_loop import Loop, RecordLoop
from fusion.products.results_part import Quantity

_FIGURE_WORDS: dict[Figures, str] = {
    "positions": "what the laser shows alone (deviations, drift, ISO 230-2 values, positions that stand out)",
    "field": "what the camera shows alone (temperatures and their rise)",
    "attribution": "which part of the field goes with the drift",
}


#: Parts of the drift as the correlation names them, in plain words.
CHANNELS = {
    "common": "drift common to all positions",
    "proportional": "drift that grows with position",
    "reversal": "drift of the reversal",
    "joint": "common and growing drift together",
}


class EffectWords(NamedTuple):
    """An effect as a reader meets it.

    Attributes
    ----------
    name : str
        Its name in words.
    remedy : str
        What to check on the machine or the measurement where the effect was missing; empty where the effect states none.
    """

    name: str
    remedy: str


@cache
def effect_words(name: str) -> EffectWords:
    """Return the words of an effect.

    Parameters
    ----------
    name : str
        Name as in results.json; that of a user's effect that is not installed here has spaces for underscores and no remedy.
    """
    effect = describe_effect(name)
    return EffectWords(name.replace("_", " "), "") if effect is None else EffectWords(effect.words, effect.remedy)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with significant digits and a true minus sign.

    Parameters
    ----------
    value : float or None
        None and values that are not finite are shown as a dash.
    digits : int
        Significant digits.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def decimals_of(u: float) -> int:
    """Return how many decimals show an expanded uncertainty with two significant digits (GUM 7.2.6).

    Parameters
    ----------
    u : float
        Standard uncertainty; 2 decimals where it is not positive or not finite.
    """
    return max(0, 1 - math.floor(math.log10(2 * u))) if u > 0 and math.isfinite(u) else 2


def measured(value: float | None, u: float | None, unit: str = "", *, decimals: int | None = None) -> str:
    """Return ``value ± U unit`` with the expanded uncertainty U = 2 u, both to the same decimal place.

    Parameters
    ----------
    value : float or None
        Estimate; None and values that are not finite are shown as a dash.
    u : float or None
        Standard uncertainty, same unit; None or 0 where there is none, then the value has three significant digits.
    unit : str
        Unit as it is printed; `print_unit` makes it from the unit of a variable.
    decimals : int, optional
        Decimal places; left out: U has two significant digits.
    """
    tail = f" {unit}" if unit else ""
    if value is None or not math.isfinite(value):
        return "–"
    if u is None or not math.isfinite(u) or u <= 0:
        return f"{number(value)}{tail}"
    places = decimals_of(u) if decimals is None else decimals
    return f"{value:.{places}f} ± {2 * u:.{places}f}{tail}".replace("-", "−")


def quantity(found: Quantity, unit: str = "") -> str:
    """Return a quantity of the results as ``value ± U unit``, see `measured`.

    Parameters
    ----------
    found : Quantity
        Estimate and standard uncertainty.
    unit : str
        Unit as it is printed.
    """
    return measured(found.value, found.u, unit)


def print_unit(unit: str) -> str:
    """Return a unit as it is printed.

    Parameters
    ----------
    unit : str
        Unit of a variable, for example ``um/K``.
    """
    return {"degC": "°C", "percent": "%", "1": ""}.get(unit, unit.replace("um", "µm"))


def p_value(p: float | None) -> str:
    """Return a p-value to two digits, or as a bound below 0.001.

    Parameters
    ----------
    p : float or None
        None and NaN are shown as a dash.
    """
    if p is None or not math.isfinite(p):
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.2g}"


def duration(seconds: float | None) -> str:
    """Return a time span in seconds below 2 min, in minutes below 2 h, in hours above.

    Parameters
    ----------
    seconds : float or None
        Time span, s; None and NaN are shown as a dash.
    """
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def moment(time: np.datetime64 | str, zone: str | None = None) -> str:
    """Return a time to the minute with its zone.

    Parameters
    ----------
    time : datetime64 or str
        UTC, or a time as results.json writes it; NaT is shown as a dash.
    zone : str, optional
        Name of a zone in the IANA data base, for local time; None: UTC.

    Examples
    --------
    >>> moment("2026-03-09T06:30:00Z"), moment("2026-03-09T06:30:00Z", "Europe/Vienna")
    ('2026-03-09 06:30 UTC', '2026-03-09 07:30 CET')
    """
    stamp = np.datetime64(time.removesuffix("Z")) if isinstance(time, str) else time
    if np.isnat(stamp):
        return "–"
    at = datetime.fromisoformat(np.datetime_as_string(stamp, unit="s")).replace(tzinfo=UTC)
    local = at if zone is None else at.astimezone(ZoneInfo(zone))
    return f"{local:%Y-%m-%d %H:%M} {local.tzname()}"


def place(x_mm: float | None, y_mm: float | None) -> str:
    """Return a place on the plan to the millimetre.

    Parameters
    ----------
    x_mm, y_mm : float or None
        Plan coordinates, mm.
    """
    x, y = ("–" if value is None else f"{value:.0f}" for value in (x_mm, y_mm))
    return f"x {x} mm, y {y} mm"


def join(items: Sequence[str]) -> str:
    """Return ``a, b and c``.

    Parameters
    ----------
    items : sequence of str
        An empty one gives an empty text.
    """
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


#: Plain predictions of the hold-out in words, by their key in ``loop.baselines``.
BASELINES = {
    "last_value": "last value repeated",
    "mean": "mean of the training part",
    "least_squares": "least squares on all that was logged",
    "ridge": "ridge regression on the same",
    "ridge_with_lags": "ridge regression with lagged copies",
}


def verdict_headline(loop: Loop) -> str:
    """Return one sentence that states what the closed loop found.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    confirmed = [step for step in loop.steps if step.confirmed]
    added = join([effect_words(step.effect).name for step in confirmed])
    noun, pronoun = ("an effect", "it") if len(confirmed) == 1 else (f"{len(confirmed)} effects", "them")
    lacked = f"The declared model lacked {noun}: {added}. "
    return {
        "complete": "The declared model explains the drift; nothing in these data shows that an effect is missing.",
        "explained": f"{lacked}With {pronoun}, nothing is left that these data can show.",
        "partial": f"{lacked}With {pronoun}, something without a name is left{_left(loop)}.",
        "unexplained": f"Something is left that no effect of the library explains{_left(loop)}.",
        "no_skill": (
            "The model predicts no better than repeating the last value or the mean: these data cannot tell whether an effect is "
            f"missing{_left(loop)}."
        ),
    }[loop.verdict]


def _left(loop: Loop) -> str:
    """What is left, in brackets: a shape, significant effects without a name, effects that were not confirmed."""
    parts = [loop.unexplained.shape] if loop.unexplained.shape else []
    parts += [
        f"{effect_words(name).name} is significant, p {p_value(p)}, and was not admitted"
        for name, p in loop.unnamed.items()
    ]
    parts += [f"{effect_words(step.effect).name} is not confirmed" for step in loop.steps if not step.confirmed]
    return f" ({'; '.join(parts)})" if parts else ""


def verdict_numbers(loop: Loop) -> str:
    """Return the sentence with the errors on the hold-out and the noise beside them.

    Parameters
    ----------
    loop : Loop
        The part ``loop`` of the results.
    """
    record = isinstance(loop, RecordLoop)
    where, noise = ("the held-out part", "a block mean") if record else ("held-out cycles", "single readings")
    declared, final = number(loop.rmse_declared_um, 2), number(loop.rmse_final_um, 2)
    errors = f"{declared} µm with the declared model, {final} µm after" if loop.steps else f"{declared} µm"
    plain = f"{number(loop.rmse_persistence_um, 2)} µm for repeating the last value"
    return f"Error on {where}: {errors}, {plain}; the noise of {noise} is {number(loop.noise_floor_um, 2)} µm."


def conditional_headline(results: Results) -> str:
    """Return the headline of a run, conditional where an input is doubted.

    Parameters
    ----------
    results : Results
        Results of a run.
    """
    headline = verdict_headline(results.loop) if results.loop else "Evaluated without a model of the drift."
    return conditional(headline, results.inputs, "causes")


def conditional(sentence: str, inputs: InputsPart | None, *figures: Figures) -> str:
    """Return a sentence with the conditions under which it holds.

    Parameters
    ----------
    sentence : str
        What is concluded.
    inputs : InputsPart or None
        The part ``inputs`` of the results.
    *figures : Figures
        What the sentence rests on.
    """
    right = premise(inputs, *figures)
    return f"Only if {right}: {sentence[0].lower()}{sentence[1:]}" if right else sentence


def condition(inputs: InputsPart | None, *figures: Figures) -> str:
    """Return the conditions of a number in brackets, empty where there are none.

    Parameters
    ----------
    inputs : InputsPart or None
        The part ``inputs`` of the results.
    *figures : Figures
        What the number rests on.
    """
    right = premise(inputs, *figures)
    return f"(only if {right})" if right else ""


def premise(inputs: InputsPart | None, *figures: Figures) -> str:
    """Return what has to be right for some figures to hold, as it follows "only if"; empty where no doubt touches them.

    Parameters
    ----------
    inputs : InputsPart or None
        The part ``inputs`` of the results.
    *figures : Figures
        What is concluded.
    """
    premises = inputs.premises(*figures) if inputs else ()
    return join(premises) if len(premises) <= 2 else f"{len(premises)} doubted inputs are right"


def untouched(inputs: InputsPart | None) -> str:
    """Return one sentence on what holds whatever becomes of the doubts, empty where nothing is doubted or nothing is left.

    Parameters
    ----------
    inputs : InputsPart or None
        The part ``inputs`` of the results.
    """
    if inputs is None or not inputs.doubts:
        return ""
    held = [words for figure, words in _FIGURE_WORDS.items() if not inputs.premises(figure)]
    return f"Not touched by that: {join(held)}." if held else ""


def next_steps(results: Results) -> list[str]:
    """Return what to do next: first doubted inputs, then what the loop found, then the anomalies, then the remedies of the warnings.

    Parameters
    ----------
    results : Results
        Results of a run.

    Returns
    -------
    list of str
        Sentences, each once; one that says so where nothing has to be done.
    """
    steps = [check.remedy for check in results.inputs.doubts] if results.inputs else []
    if results.loop is not None:
        steps += [effect_words(step.effect).remedy for step in results.loop.steps]
        if results.loop.verdict in {"partial", "unexplained", "no_skill"}:
            steps.append(
                "Log more of what happens at the machine (duty, coolant, doors, air) in the next test: what is left has no name."
            )
    steps += [f"Position {anomaly.target}: {anomaly.evidence.check}" for anomaly in results.anomalies or ()]
    steps += [warning.remedy for warning in results.warnings]
    unique = list(dict.fromkeys(step for step in steps if step))
    return unique or ["Nothing has to be done: use the profile and its uncertainty as they are."]
