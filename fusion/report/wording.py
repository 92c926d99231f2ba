"""Numbers, times, places and conditions as a reader meets them: significant digits, unit, uncertainty, zone."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from functools import cache
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fusion.effects.library import describe_effect
from fusion.products.results_inputs import Figures, InputsPart
from fusion.products.results_part import Quantity

_FIGURE_WORDS: dict[Figures, str] = {
    "positions": "what the laser shows alone (deviations, drift, ISO 230-2 values, positions that stand out)",
    "field": "what the camera shows alone (temperatures and their rise)",
    "attribution": "which part of the field goes with the drift",
}


#: Inputs of the radiometry in words, with their unit.
INPUT_NAMES = {
    "emissivity": "emissivity",
    "reflected_temperature_K": "reflected apparent temperature / K",
    "atmospheric_temperature_K": "temperature of the air / K",
    "relative_humidity": "relative humidity",
    "object_distance_m": "distance / m",
    "window_transmission": "transmission of the window",
    "window_temperature_K": "temperature of the window / K",
    "camera_offset_K": "camera, constant part / K",
    "camera_scale": "camera, share of the reading in °C",
    "camera_drift_K": "camera, drift of its zero between cycles / K",
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


def p_cell(p: float | None, least: float | None = None) -> str:
    """Return a p-value for a table: to two digits, as a bound below 0.001 and where it is the smallest that can be shown.

    Parameters
    ----------
    p : float or None
        None and NaN are shown as a dash.
    least : float, optional
        Smallest p-value that the number of simulations can show; a p-value equal to it is an upper limit, rounded up.

    Examples
    --------
    >>> p_cell(0.212, 0.002), p_cell(0.0035714, 0.0035714), p_cell(1e-6)
    ('0.21', '≤ 0.004', '< 0.001')
    """
    if p is None or not math.isfinite(p):
        return "–"
    if least and p <= least * (1.0 + 1e-9):
        digit = math.floor(math.log10(p))
        rounded = math.ceil(round(p / 10.0**digit, 6)) * 10.0**digit
        return f"≤ {rounded:.{max(0, -digit)}f}"
    return "< 0.001" if p < 0.001 else f"{p:.2g}"


def p_words(p: float | None, least: float | None = None) -> str:
    """Return a p-value in a sentence, see `p_cell`.

    Parameters
    ----------
    p : float or None
        None and NaN are shown as a dash.
    least : float, optional
        Smallest p-value that the number of simulations can show.

    Examples
    --------
    >>> p_words(0.212), p_words(0.002, 0.002)
    ('p = 0.21', 'p ≤ 0.002, limit of the simulation')
    """
    cell = p_cell(p, least)
    if cell.startswith("≤"):
        return f"p {cell}, limit of the simulation"
    return f"p {cell}" if cell.startswith("<") else f"p = {cell}"


def alike(values: Sequence[float | None], digits: int = 2, *, distinct: bool = True) -> list[str]:
    """Return numbers that are compared with as many decimals each, so many that the smallest has the digits.

    Parameters
    ----------
    values : sequence of float or None
        In one unit; None and values that are not finite are shown as a dash.
    digits : int
        Significant digits of the smallest one.
    distinct : bool
        Whether there are more where two that differ would read alike.

    Examples
    --------
    >>> alike([1.938, 0.4643]), alike([0.733, 0.7331])
    (['1.94', '0.46'], ['0.7330', '0.7331'])
    """
    known = [value for value in values if value is not None and math.isfinite(value) and value]
    smallest = min(map(abs, known), default=1.0)
    decimals = max(0, digits - 1 - math.floor(math.log10(smallest)))
    differ = len(set(known))
    while distinct and decimals < 4 and len({round(value, decimals) for value in known}) < differ:
        decimals += 1
    return [
        "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}".replace("-", "−")
        for value in values
    ]


def duration(seconds: float | None) -> str:
    """Return a time span in seconds below 2 min, in minutes below 2 h, in hours above.

    Parameters
    ----------
    seconds : float or None
        Time span, s; None and NaN are shown as a dash.
    """
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if 0 < seconds < 2:
        return f"{seconds:.2g} s"
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


def place(x: float | None, y: float | None, unit: str = "mm") -> str:
    """Return a place on the plan to the millimetre, or to the pixel.

    Parameters
    ----------
    x, y : float or None
        Plan coordinates.
    unit : str
        mm, or px where the picture is the plan.
    """
    across, down = ("–" if value is None else f"{value:z.0f}" for value in (x, y))
    return f"x {across} {unit}, y {down} {unit}"


def region_words(name: str) -> str:
    """Return the name of a region in the report: the disc about a hotspot is not the area of the hotspot itself.

    Parameters
    ----------
    name : str
        Name in the results.
    """
    return re.sub(r"^hotspot (?=\d+$)", "disc about hotspot ", name)


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
    "last_value": "last cycle simply repeated",
    "mean": "mean of the cycles before",
    "least_squares": "least squares on all that was logged",
    "ridge": "ridge regression on the same",
    "ridge_with_lags": "ridge regression with lagged copies",
}


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


def untouched(inputs: InputsPart | None, there: Collection[Figures] = tuple(_FIGURE_WORDS)) -> str:
    """Return one sentence on what holds whatever becomes of the doubts, empty where nothing is doubted or nothing is left.

    Parameters
    ----------
    inputs : InputsPart or None
        The part ``inputs`` of the results.
    there : collection of Figures
        What the run has.
    """
    if inputs is None or not inputs.doubts:
        return ""
    held = [words for figure, words in _FIGURE_WORDS.items() if figure in there and not inputs.premises(figure)]
    return f"Not touched by that: {join(held)}." if held else ""
