"""Values of a campaign file as types: quantities with their unit, shares, patches, time zones, patterns; each names what is wrong."""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal, NamedTuple
from unicodedata import normalize
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from fusion.common import FusionError, suggest
from thermofuse.resources import with_degree_sign
from thermofuse.units import OF_LOGGERS, UNITS, find_unit

# Values that carry their unit: ``"5 mm"`` to a number in the unit that the calculation uses.

#: Days that are counted from a date: number of 1970-01-01.
DAY_NUMBERS: Mapping[str, float] = {name: -unit.offset for name, unit in UNITS.items() if unit.kind == "day"}
#: Units of times that are numbers.
TIME_UNITS = (*(name for name, unit in UNITS.items() if unit.kind == "time"), *DAY_NUMBERS)
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


_CYCLES = re.compile(r"\s*(\d{1,99})(?:\s*-\s*(\d{1,99}))?\s*")
#: Heading of a column with its unit, ``"name [unit]"`` or ``"name(unit)"``, and as HOBOware has it, ``"name, unit"``.
_HEADING = re.compile(r"\s*(.+?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*")
#: The same with the unit before the name, or within it.
_WITHIN = re.compile(r"[\[(]([^\[\]()]+)[\])](?!\.\d+$)")
#: The same as ISO 80000 writes it, ``"T1 / °C"``; without spaces of a time alone, as m/s is a unit.
_QUOTIENT = re.compile(
    r"\s*(?:(.+?)(?:\s+/\s+|,\s*|\s+in\s+)|(t|time|zeit)/|(time|zeit|timestamp|elapsed|(?-i:t))_(?=m?s|min|h))(\S.*?)\s*",
    re.IGNORECASE,
)
#: A number and the unit beside it.
BESIDE = re.compile(r"([-+−]?[\d.,]*\d(?:[eE][-+]?\d+)?)\s*([^\s\d].*)")
#: Numbers of logger and sensor that HOBOware writes behind a heading.
_SERIAL = re.compile(r"\s*\((?:LGR|SEN)[^()]*\)")
#: A factor beside a name: whether the numbers were multiplied by it or are to be is not known.
_TIMES = re.compile(
    r"\s*[\[(]?\s*(/\s*10+|[×*·]\s*\d[\d.,]*|(?<![^\W_])x\s*(?:10+|0?[.,]\d+)|(?:[×*·]\s*|(?<![^\W_])x\s*)?(?:10\^-?|1[eE]-?)\d+)\s*[\])]?\s*$|^\s*(\d[\d.,eE^-]*\s*[x×*·])\s*"
)


class QuantityError(FusionError):
    """A value whose number or unit cannot be understood; the message says what to write instead."""


def unit_name(text: str) -> str:
    """Return the house spelling of a unit (``"°C"`` -> ``"degC"``), or the text itself where none is known."""
    return unit.name if (unit := find_unit(text)) else with_degree_sign(text)


def name_and_unit(heading: str) -> tuple[str, str]:
    """Return name and unit of the heading of a column; the unit is empty where it has none, and none that is known where a factor stands
    beside it.

    >>> name_and_unit("Temp, °F (LGR S/N: 12, SEN S/N: 7)"), name_and_unit("Z x1000 (mm)"), name_and_unit("T / 0.1 °C")
    (('Temp', 'degF'), ('Z', 'x1000 mm'), ('T', '0.1 degC'))
    """
    text = _SERIAL.sub("", heading).strip()
    name, unit = text, ""
    over, _, below = text.rpartition("/")
    if match := _HEADING.fullmatch(text):
        name, unit = match[1], unit_name(match[2])
    elif (match := _QUOTIENT.fullmatch(text)) and is_unit(match[4]):
        name, unit = match[1] or match[2] or match[3], unit_name(match[4])
    elif (
        over
        and (whole := find_unit(below))
        and whole.kind in ("temperature", "length")
        and not (is_unit(over) or is_unit(text))
    ):
        name, unit = over, whole.name
    elif (match := _WITHIN.search(text)) and find_unit(match[1]):
        name, unit = f"{text[: match.start()]}{text[match.end() :]}".strip(), unit_name(match[1])
    if (
        find_unit(unit) is None
        and (beside := BESIDE.fullmatch(unit))
        and (whole := find_unit(beside[2]))
        and whole.kind != "time"
    ):
        return text, ""  # Z (100 mm): where it is
    if (times := _TIMES.search(name)) and times[0] != name:
        return name.replace(times[0], ""), f"{(times[1] or times[2]).strip()} {unit}".strip()
    return name, unit


def has_unit(text: str) -> bool:
    """Whether a text holds a number with its unit."""
    return (match := BESIDE.fullmatch(text)) is not None and is_unit(match[2])


def conversion(unit: str, target: str) -> tuple[float, float]:
    """Return ``(factor, offset)`` that bring values in `unit` to the canonical unit `target`."""
    found, wanted = find_unit(unit), UNITS[target]
    if found is None or found.kind != wanted.kind:
        known = ", ".join(name for name, one in UNITS.items() if one.kind == wanted.kind)
        raise QuantityError(f'"{unit}" is not a unit of {_KINDS[target]}; use one of {known}')
    return found.factor / wanted.factor, 0.0 if target == "K" else (found.offset - wanted.offset) / wanted.factor


def canonical_unit(unit: str) -> str:
    """Return the canonical unit of what a unit measures."""
    return unit if unit in _KINDS else next(name for name in _KINDS if UNITS[name].kind == UNITS[unit].kind)


def column_conversion(unit: str, target: str) -> tuple[float, float]:
    """Return ``(factor, offset)`` of a column in `unit`, which may be that of one count: ``"0.0125 mm"``."""
    count = _QUANTITY.fullmatch(unit)
    if count is not None and count[2] and (whole := find_unit(count[2])) and whole.kind == UNITS[target].kind:
        factor, offset = conversion(count[2], target)
        return float(count[1]) * factor, offset
    return conversion(unit, target)


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that columns of loggers have."""
    return find_unit(text) is not None or text.strip("[]() ") in OF_LOGGERS


def role_of_unit(unit: str) -> Literal["temperature", "displacement", "driver"]:
    """Return what a column in a unit holds where nothing else says so: a temperature, a displacement, or anything else."""
    for target, role in (("degC", "temperature"), ("um", "displacement")):
        with suppress(QuantityError):
            column_conversion(unit, target)
            return role  # type: ignore[return-value]
    return "driver"


def column_unit(heading: str) -> str:
    """Return the unit in a heading such as ``"t1 [degC]"``; empty where it has none."""
    return name_and_unit(heading)[1]


def is_time(heading: str) -> bool:
    """Return whether a heading is that of the time: ``time`` or ``date`` in a language that is read, or a column in units of time."""
    from interferometry.io.tables import read_heading

    return read_heading(heading).role in ("time", "date") or column_unit(heading) in TIME_UNITS


def read_quantity(value: object, target: str) -> float:
    """Return a number with unit, written as text, in the canonical unit."""
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
    """Return the value of an option of the command in its canonical unit."""
    try:
        return read_quantity(text, target)
    except QuantityError as error:
        raise QuantityError(f'{option} "{text}": {error}') from None


def read_cycles(value: object) -> tuple[int, int]:
    """Return the first and the last of a range of cycles written as text; a single number is both."""
    match = _CYCLES.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise QuantityError('this is not a window of cycles; write for example "1-5"')
    first, last = int(match[1]), int(match[2] or match[1])
    if first > last:
        raise QuantityError(f'this window ends before it begins; write for example "{last}-{first}"')
    return first, last


def split_uncertainty(text: str) -> tuple[str, str | None]:
    """Return value and standard uncertainty of a text such as ``"22 +- 1 degC"``, each with its unit; one at the end belongs to both.

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


#: Keys of a campaign file that name files, by table; a list holds patterns.
FILE_KEYS: Mapping[str, tuple[str, ...]] = {
    "thermography": ("frames", "lens", "stack.times"),
    "plan": ("fiducials", "regions"),
    "interferometry": ("deviations", "environment"),
    "sensors": ("file", "places"),
    "drivers": ("file",),
    "record": ("file", "files", "test"),
    "sheet": ("logo", "word_template", "page_template"),
}
#: Folders of a pattern, each of which is searched within the one before.
_MAX_PARTS = 64


def _quantity(unit: str) -> BeforeValidator:
    """Return a validator from text with unit to a number in `unit`."""
    return BeforeValidator(lambda value: read_quantity(value, unit))


def _within(low: float, high: float, meaning: str) -> AfterValidator:
    """Return a validator that accepts ``low < value <= high``."""

    def validate(value: float) -> float:
        if not low < value <= high:
            raise ValueError(f"{meaning} must be above {low:g} and at most {high:g}")
        return value

    return AfterValidator(validate)


def _share_u(value: float) -> float:
    """Accept a standard uncertainty that is a share: 0 to 1."""
    if not 0.0 <= value <= 1.0:
        fault = f"the standard uncertainty {value:g} of a share lies outside 0 to 1"
        raise ValueError(f'{fault}; write a number such as 0.02, or "2 %"')
    return value


def _fraction(value: object) -> object:
    """Accept ``"45 %"`` as well as ``0.45``."""
    if isinstance(value, str) and (match := re.fullmatch(r"\s*([\d.]+)\s*%\s*", value)):
        return float(match.group(1)) / 100.0
    return value


def _written(example: str) -> WithJsonSchema:
    """How a quantity looks in the file, for the JSON Schema."""
    return WithJsonSchema({"type": "string", "format": "quantity", "examples": [example]})


Millimetres = Annotated[float, _quantity("mm"), _within(-1e5, 1e5, "this length in mm"), _written("5 mm")]
PositiveMillimetres = Annotated[float, _quantity("mm"), _within(0.0, 1e5, "this length in mm"), _written("5 mm")]
Metres = Annotated[float, _quantity("mm"), AfterValidator(lambda mm: mm / 1e3), _written("1.2 m")]
Celsius = Annotated[float, _quantity("degC"), _within(-273.15, 3000.0, "a temperature in degC"), _written("22 degC")]
#: A camera whose clock was never set may be decades off; nanoseconds in 64 bits hold 292 years.
Seconds = Annotated[float, _quantity("s"), _within(-3e9, 3e9, "this time in s"), _written("37 s")]
PositiveSeconds = Annotated[float, _quantity("s"), _within(0.0, 1e6, "this time in s"), _written("2 s")]
PositiveMicrometres = Annotated[float, _quantity("um"), _within(0.0, 1e6, "this displacement in um"), _written("10 um")]
PartsPerMillion = Annotated[
    float, _quantity("ppm/K"), _within(-10.0, 200.0, "an expansion coefficient in ppm/K"), _written("11.7 ppm/K")
]
Feed = Annotated[float, _quantity("mm/min"), _within(0.0, 1e6, "a feed rate in mm/min"), _written("300 mm/min")]
Fraction = Annotated[float, BeforeValidator(_fraction), _within(1e-6, 1.0, "this fraction")]
#: Standard uncertainties.
FractionU = Annotated[
    float, BeforeValidator(_fraction), AfterValidator(_share_u), Field(json_schema_extra={"minimum": 0, "maximum": 1})
]
PartsPerMillionU = Annotated[
    float, _quantity("ppm/K"), _within(1e-3, 200.0, "a standard uncertainty in ppm/K"), _written("0.5 ppm/K")
]
KelvinU = Annotated[float, _quantity("K"), Field(ge=0.0), _written("1 K")]
ShareOfLengthU = Annotated[float, _quantity("ppm"), Field(ge=0.0), _written("0.25 ppm")]
MicrometresU = Annotated[float, _quantity("um"), Field(ge=0.0), _written("0.4 um")]
MetresU = Annotated[float, _quantity("mm"), AfterValidator(lambda mm: mm / 1e3), Field(ge=0.0), _written("5 cm")]


def _zone(name: str) -> str:
    """Accept the IANA name of a time zone."""
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError(
            f'there is no such time zone; {suggest(name, available_timezones())}write an IANA name such as "Europe/Vienna", or "UTC"'
        ) from None
    return name


TimeZone = Annotated[str, AfterValidator(_zone)]


def _time_unit(text: str) -> str:
    """Accept a unit of times that are numbers."""
    if (name := unit_name(text)) not in TIME_UNITS:
        raise ValueError(f"this is not a unit of a time; use one of {', '.join(TIME_UNITS)}")
    return name


TimeUnit = Annotated[str, AfterValidator(_time_unit), WithJsonSchema({"type": "string", "enum": [*TIME_UNITS]})]


def _several(cycles: tuple[int, int]) -> tuple[int, int]:
    """Accept more than one cycle."""
    if cycles[0] == cycles[1]:
        raise ValueError(
            "one cycle has no standard deviation, and with it neither R nor A nor an uncertainty; write the first and the last of "
            'several, five for a test by ISO 230-2, for example "1-5"'
        )
    return cycles


#: First and last of several cycles.
Cycles = Annotated[
    tuple[int, int],
    BeforeValidator(read_cycles),
    AfterValidator(_several),
    WithJsonSchema({"type": "string", "format": "cycles", "examples": ["10-14"]}),
]


def _patch(values: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """Accept a patch that holds a pixel."""
    if min(values[:2]) < 0 or min(values[2:]) < 1:
        raise ValueError(
            "this patch contains no pixel of a frame; write first column and first row, from 0 on, and the number of columns and of rows, "
            "at least 1 each, for example [8, 8, 24, 16]"
        )
    return values


#: First column and row, number of columns and rows.
PixelPatch = Annotated[tuple[int, int, int, int], AfterValidator(_patch)]


class Length(NamedTuple):
    """A coordinate: px of the picture, or mm on the plan."""

    value: float
    unit: str


def _length(value: object) -> Length:
    """Return a coordinate that is written with its unit."""
    in_pixels = (
        isinstance(value, str) and (match := _QUANTITY.fullmatch(value)) and unit_name(match.group(2) or "") == "px"
    )
    unit = "px" if in_pixels else "mm"
    return Length(read_quantity(value, unit), unit)


_Coordinate = Annotated[Length, BeforeValidator(_length), _written("120 px")]
#: Column and row of the picture, or x and y on the plan.
Point = tuple[_Coordinate, _Coordinate]


def area(corners: tuple[tuple[float, float], ...]) -> float:
    """Return the area of a polygon by Gauss's formula, without its sense."""
    pairs = zip(corners, (*corners[1:], corners[0]), strict=True)
    return abs(sum(x * y_next - x_next * y for (x, y), (x_next, y_next) in pairs)) / 2.0


def corner_words(corners: tuple[tuple[float, float], ...]) -> str:
    """Return the corners of a polygon for a message."""
    return ", ".join(f"({x:g}, {y:g})" for x, y in corners)


def stored_path(folder: Path, name: str) -> Path:
    """Return the path of a name below a folder, each part in the Unicode normal form in which it lies there: é is one character or two."""
    path = folder
    for part in Path(name).parts:
        inside, path = path, path / part
        if part.isascii() or os.path.lexists(path) or not os.path.isdir(inside):  # noqa: PTH112 - a name that is too long is none
            continue
        alike = [one for one in os.listdir(inside) if normalize("NFC", one) == normalize("NFC", part)]  # noqa: PTH208
        path = inside / alike[0] if alike else path
    return path


def not_a_file(path: Path) -> str:
    """Return why something that is there is no file, or nothing."""
    if os.path.isdir(path):  # noqa: PTH112 - a name that no file can have is none
        return f"{path} is a folder; name a file in it"
    if os.path.exists(path) and not os.path.isfile(path):  # noqa: PTH110, PTH113
        return f"{path} is a pipe, a socket or a device; name a file"
    return ""


def matching_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files that a pattern matches; a link whose file is gone counts, so that it is missed."""
    there = [path for path in _matches(folder, pattern) if path.is_file() or (path.is_symlink() and not path.exists())]
    if Path(pattern).anchor:
        return there
    real = {place: place.resolve() for place in {path.parent for path in there}}
    return [
        real[path.parent] / path.name if not path.is_symlink() else path.resolve() if path.exists() else path
        for path in there
    ]


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return paths sorted by the names of folders and files, the numbers in them by size.

    >>> [path.name for path in in_order([Path("run_10.csv"), Path("run_9.csv")])]
    ['run_9.csv', 'run_10.csv']
    """

    def by_numbers(path: Path) -> tuple[list[list[str | int]], Path]:
        # Between two numbers stands a text: like is compared with like.
        parts = (re.split(r"(\d+)", part) for part in path.parts)
        return [[int(one) if k % 2 else one for k, one in enumerate(part)] for part in parts], path

    return sorted(paths, key=by_numbers)


def matching_pipes(folder: Path, pattern: str) -> list[Path]:
    """Return the pipes, sockets and devices that a pattern matches, none of which is ever opened."""
    return [path for path in _matches(folder, pattern) if path.exists() and not (path.is_file() or path.is_dir())]


def _matches(folder: Path, pattern: str) -> list[Path]:
    """Return all that a pattern matches, folders too; nothing where it is too long for a name."""
    # What is there under this name is meant: brackets may stand in the name of a folder.
    start, parts = folder, Path(pattern).parts
    while parts and os.path.lexists(inside := stored_path(start, parts[0])):
        start, parts = inside, parts[1:]
    if not parts:
        return [start]
    try:
        named = str(Path(*parts))
        forms = dict.fromkeys([named, *(normalize(form, named) for form in ("NFC", "NFD"))])
        return [path for form in forms for path in start.glob(form)]
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return []
        raise


def check_pattern(folder: Path, pattern: str) -> None:
    """Refuse a pattern that names no file, and one for which a whole disk would be searched."""
    parts = Path(pattern).parts
    if not parts or parts == (Path(pattern).anchor,):
        raise ValueError('names a folder; name the files in it, for example "thermal/*.jpg"')
    if len(parts) > _MAX_PARTS:
        raise ValueError(f"has more than {_MAX_PARTS} folders; name the files from a folder closer to them")
    if "**" not in parts:
        return
    first = next(k for k, part in enumerate(parts) if set(part) & set("*?["))
    start = folder.joinpath(*parts[:first]).resolve()
    if start == Path(start.anchor):
        raise ValueError(
            f"would search folders of any depth (**) below {start}, the root of a disk; name the folder of the files before the first "
            f"wildcard, for example {start / 'thermal' / '*.jpg'}"
        )
