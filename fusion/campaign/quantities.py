"""Values that carry their unit: ``"5 mm"`` to a number in the unit that the calculation uses."""

from __future__ import annotations

import math
import re

from fusion.errors import FusionError

#: Accepted units per canonical unit, as ``(factor, offset)``: canonical = value * factor + offset.
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "mm": {
        "nm": (1e-6, 0.0), "um": (1e-3, 0.0), "mm": (1.0, 0.0), "cm": (10.0, 0.0), "m": (1e3, 0.0), "in": (25.4, 0.0),
    },
    "um": {"nm": (1e-3, 0.0), "um": (1.0, 0.0), "mm": (1e3, 0.0), "m": (1e6, 0.0), "in": (25.4e3, 0.0)},
    "degC": {"degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5.0 / 9.0, -160.0 / 9.0)},
    "K": {"mK": (1e-3, 0.0), "K": (1.0, 0.0), "degC": (1.0, 0.0), "degF": (5.0 / 9.0, 0.0)},
    "s": {"ms": (1e-3, 0.0), "s": (1.0, 0.0), "min": (60.0, 0.0), "h": (3600.0, 0.0)},
    "ppm": {"ppb": (1e-3, 0.0), "ppm": (1.0, 0.0), "um/m": (1.0, 0.0), "%": (1e4, 0.0)},
    "ppm/K": {"ppm/K": (1.0, 0.0), "um/m/K": (1.0, 0.0), "1/K": (1e6, 0.0)},
    "mm/min": {"mm/min": (1.0, 0.0), "m/min": (1e3, 0.0), "mm/s": (60.0, 0.0)},
    "px": {"px": (1.0, 0.0)},
}  # fmt: skip
_SPELLINGS = {
    "µm": "um", "μm": "um", "°C": "degC", "℃": "degC", "C": "degC", "°F": "degF", "F": "degF", "sec": "s",
    "µm/m": "um/m", "μm/m": "um/m", "ppm/degC": "ppm/K", "ppm/°C": "ppm/K", "um/(m K)": "um/m/K", "µm/m/K": "um/m/K",
    "K^-1": "1/K", "pixel": "px", "pixels": "px",
}  # fmt: skip
#: Units written out, in any case.
_WORDS = {
    "deg c": "degC", "degree c": "degC", "degrees c": "degC", "celsius": "degC", "degree celsius": "degC", "degrees celsius": "degC",
    "kelvin": "K", "deg f": "degF", "fahrenheit": "degF", "micron": "um", "microns": "um", "micrometer": "um", "micrometers": "um",
    "micrometre": "um", "micrometres": "um", "millimeter": "mm", "millimetre": "mm", "second": "s", "seconds": "s", "minute": "min",
    "minutes": "min", "hr": "h", "hrs": "h", "hour": "h", "hours": "h",
}  # fmt: skip
_EXAMPLES = {
    "mm": "5 mm", "um": "5 um", "degC": "22 degC", "K": "1 K", "s": "37 s",
    "ppm": "0.25 ppm", "ppm/K": "11.7 ppm/K", "mm/min": "300 mm/min", "px": "4 px",
}  # fmt: skip
_KINDS = {
    "mm": "a length", "um": "a displacement", "degC": "a temperature", "K": "a temperature difference", "s": "a time",
    "ppm": "a share of a length", "ppm/K": "an expansion coefficient", "mm/min": "a feed rate",
    "px": "a number of pixels",
}  # fmt: skip
#: Between a value and its standard uncertainty.
_PLUS_MINUS = re.compile(r"\s*(?:\+/?-|±)\s*")
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*")


class QuantityError(FusionError):
    """A value whose number or unit cannot be understood; the message says what to write instead."""


def unit_name(text: str) -> str:
    """Return the house spelling of a unit (``"°C"`` -> ``"degC"``), or the text itself where none is known.

    Parameters
    ----------
    text : str
        Unit as it was written.
    """
    text = text.strip()
    return _SPELLINGS.get(text) or _WORDS.get(text.lower(), text)


def conversion(unit: str, target: str) -> tuple[float, float]:
    """Return ``(factor, offset)`` that bring values in `unit` to the canonical unit `target`.

    Parameters
    ----------
    unit : str
        Unit as it was written.
    target : str
        Canonical unit: mm, um, degC, K (a difference), s, ppm, ppm/K, mm/min or px.

    Returns
    -------
    tuple of float
        ``value * factor + offset`` is in the unit `target`.

    Raises
    ------
    QuantityError
        If `unit` does not measure what `target` measures.
    """
    known = _UNITS[target]
    name = unit_name(unit)
    if name not in known:
        raise QuantityError(f'"{unit}" is not a unit of {_KINDS[target]}; use one of {", ".join(known)}')
    return known[name]


def read_quantity(value: object, target: str) -> float:
    """Return a number with unit, written as text, in the canonical unit.

    Parameters
    ----------
    value : object
        Text such as ``"5 mm"``; anything else is refused, a bare number because its unit would be a guess.
    target : str
        Canonical unit, a key of `_UNITS`.

    Raises
    ------
    QuantityError
        If the value is not text, is not a finite number, or carries no unit or a wrong one.
    """
    example = f'write for example "{_EXAMPLES[target]}"'
    if isinstance(value, bool) or not isinstance(value, str):
        raise QuantityError(f"{_KINDS[target]} needs its unit in the value; {example}")
    match = _QUANTITY.fullmatch(value)
    if match is None:
        raise QuantityError(f"this is not {_KINDS[target]} with a unit; {example}")
    number, unit = match.groups()
    if unit is None:
        raise QuantityError(f"{_KINDS[target]} needs its unit in the value; {example}")
    factor, offset = conversion(unit, target)
    result = float(number) * factor + offset
    if not math.isfinite(result):
        raise QuantityError(f"the number is not finite; {example}")
    return result


def read_option(option: str, text: str, target: str) -> float:
    """Return the value of an option of the command in its canonical unit.

    Parameters
    ----------
    option : str
        As it is written, ``"--spacing"``.
    text : str
        Its value, ``"25 mm"``.
    target : str
        Canonical unit, as `read_quantity` takes it.

    Raises
    ------
    QuantityError
        As `read_quantity`, with the option and what was written.
    """
    try:
        return read_quantity(text, target)
    except QuantityError as error:
        raise QuantityError(f'{option} "{text}": {error}') from None


def split_uncertainty(text: str) -> tuple[str, str | None]:
    """Return value and standard uncertainty of a text such as ``"22 +- 1 degC"``, each with its unit.

    Parameters
    ----------
    text : str
        Value, ``+-`` or ``±``, and standard uncertainty; a unit at the end belongs to both.

    Returns
    -------
    value, uncertainty : str
        ``"22 degC"`` and ``"1 degC"``; the uncertainty is None where none is given.

    Examples
    --------
    >>> split_uncertainty("1.2 m +- 5 cm"), split_uncertainty("0.97 ± 0.01"), split_uncertainty("22 degC")
    (('1.2 m', '5 cm'), ('0.97', '0.01'), ('22 degC', None))
    """
    value, *uncertainty = _PLUS_MINUS.split(text.strip(), maxsplit=1)
    if not uncertainty:
        return value, None
    bare, stated = _QUANTITY.fullmatch(value), _QUANTITY.fullmatch(uncertainty[0])
    if bare is not None and bare.group(2) is None and stated is not None and stated.group(2) is not None:
        value = f"{value} {stated.group(2)}"
    return value, uncertainty[0]
