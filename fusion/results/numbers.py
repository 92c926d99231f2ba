"""Numbers, uncertainties, units, times and places as text: significant digits, a true minus sign, the zone of a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike

#: Least p-value that is stated: below it a p-value is the tail of a distribution that no number of simulations or readings has shown.
LEAST_P = 0.001
#: What is smaller, in any unit that is printed (a femtometre, a nanokelvin), is rounding of the arithmetic.
_ROUNDING = 1e-9


def number(value: float | None, digits: int = 3, *, least: float = _ROUNDING) -> str:
    """Return a number with significant digits and a true minus sign; a size below `least`, where a table has one, as that bound."""
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) < _ROUNDING:
        return "0"
    if abs(value) < least:
        return f"< {exact(least)}"
    return fixed(value, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def exact(value: float | None) -> str:
    """Return a number that is stated, such as a position, with no more digits than it has and a true minus sign; a dash without one."""
    if value is None:
        return "–"
    # Ten digits hold a micrometre in ten metres, and no rounding of the arithmetic.
    return np.format_float_positional(value or 0.0, precision=10, fractional=False, trim="-").replace("-", "−")


def fixed(value: float | None, decimals: int) -> str:
    """Return a number with so many decimals and a true minus sign; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:z.{decimals}f}".replace("-", "−")


def decimals_of(u: float) -> int:
    """Return how many decimals show an expanded uncertainty with two significant digits (GUM 7.2.6)."""
    return max(0, 1 - math.floor(math.log10(2 * u))) if u > 0 and math.isfinite(2 * u) else 2


def measured(value: float | None, u: float | None, unit: str = "", *, decimals: int | None = None) -> str:
    """Return ``value ± U unit`` with the expanded uncertainty U = 2 u, both to the same decimal place."""
    tail = f" {unit}" if unit else ""
    if value is None or not math.isfinite(value):
        return "–"
    if u is None or not math.isfinite(2 * u) or u < _ROUNDING:
        return f"{number(value)}{tail}"
    places = decimals_of(u) if decimals is None else decimals
    return f"{value:z.{places}f} ± {2 * u:.{places}f}{tail}".replace("-", "−")


def print_unit(unit: str) -> str:
    """Return a unit as it is printed."""
    return {"degC": "°C", "percent": "%", "1": ""}.get(unit, unit.replace("um", "µm"))


def span(values: ArrayLike, unit: str = "", form: str = ".5g") -> str:
    """Return the smallest and the largest value, without those that are none, with their unit."""
    every = np.asarray(values)
    known = every[~np.isnat(every) if every.dtype.kind == "M" else ~np.isnan(every)]
    if known.size == 0:
        return "without values"
    low, high = (moment(one) if known.dtype.kind == "M" else f"{one:{form}}" for one in (known.min(), known.max()))
    return f"{low} to {high} {print_unit(unit)}".rstrip()


def small(value: float | None) -> str:
    """Return a size in µm, values below a nanometre as such."""
    return "below 0.001" if value is not None and value < 1e-3 else number(value, 2)


def gain(value: float | None) -> str:
    """Return a gain in log-likelihood to one decimal."""
    return "–" if value is None else f"{value:z.1f}".replace("-", "−")


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{100 * share:g} %"


def p_cell(p: float | None, least: float | None = None) -> str:
    """Return a p-value for a table: to two digits, as a bound up to `LEAST_P` and at `least`, the resolution of simulations."""
    if p is None or not math.isfinite(p):
        return "–"
    if least and p <= least * (1.0 + 1e-9):
        digit = math.floor(math.log10(p))
        rounded = math.ceil(round(p / 10.0**digit, 6)) * 10.0**digit
        return f"≤ {rounded:.{max(0, -digit)}f}"
    return f"< {LEAST_P:g}" if p <= LEAST_P else f"{p:.2g}"


def p_words(p: float | None, least: float | None = None) -> str:
    """Return a p-value in a sentence, see `p_cell`."""
    cell = p_cell(p, least)
    if cell.startswith("≤"):
        return f"p {cell}, resolution of the Monte Carlo test"
    return f"p {cell}" if cell.startswith("<") else f"p = {cell}"


def alike(values: Sequence[float | None], *, distinct: bool = True) -> list[str]:
    """Return numbers that are compared with as many decimals each: so many that the smallest has two digits and the largest no more than
    five, more where `distinct`.
    """
    known = [value for value in values if value is not None and math.isfinite(value) and value]
    smallest, largest = (math.floor(math.log10(of(map(abs, known), default=1.0))) for of in (min, max))
    decimals = max(0, min(1 - smallest, 4 - largest))
    differ = len(set(known))
    while distinct and decimals < 4 and len({round(value, decimals) for value in known}) < differ:
        decimals += 1
    return [fixed(value, decimals) for value in values]


def duration(seconds: float | None) -> str:
    """Return a time span, as rounded, in seconds below 2 min, in minutes below 2 h, in hours above."""
    if seconds is None or not math.isfinite(seconds):
        return "–"
    if seconds < 0:
        return f"−{duration(-seconds)}"
    if 0 < seconds < 2:
        return f"{seconds:.2g} s"
    if round(seconds) < 120:
        return f"{seconds:.0f} s"
    if round(seconds / 60) < 120:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def moment(time: np.datetime64 | str, zone: str | None = None, *, seconds: bool = False) -> str:
    """Return a UTC time to the minute or second with its zone, local to a zone of the IANA data base where one is named, without one where
    it is "", not stated; NaT is a dash.
    """
    stamp = np.datetime64(time.removesuffix("Z")) if isinstance(time, str) else time
    if np.isnat(stamp):
        return "–"
    at = datetime.fromisoformat(np.datetime_as_string(stamp, unit="s")).replace(tzinfo=UTC)
    local = at if not zone else at.astimezone(ZoneInfo(zone))
    return f"{local:{'%Y-%m-%d %H:%M:%S' if seconds else '%Y-%m-%d %H:%M'}} {'(no zone)' if zone == '' else local.tzname()}"


def place(x: float | None, y: float | None) -> str:
    """Return a place on the plan to the millimetre."""
    across, down = ("–" if value is None else f"{value:z.0f}".replace("-", "−") for value in (x, y))
    return f"x {across} mm, y {down} mm"


def join(items: Sequence[str]) -> str:
    """Return ``a, b and c``."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


def lower_first(text: str) -> str:
    """Return a sentence as it goes on after a colon."""
    return text[:1].lower() + text[1:]


def upper_first(text: str) -> str:
    """Return a text as it begins a sentence."""
    return text[:1].upper() + text[1:]
