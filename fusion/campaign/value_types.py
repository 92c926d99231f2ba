"""Values of a campaign file as types: quantities with their unit, shares, patches, time zones, patterns; each names what is wrong."""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from fusion.campaign.messages import suggest
from fusion.campaign.quantities import QuantityError, read_quantity
from fusion.toml_file import OF_THE_SYSTEM

#: Folders of a pattern, each of which is searched within the one before.
_MOST_PARTS = 64
#: Most files and folders that are looked through for one pattern: a test of 10,000 cycles with 100 frames in each.
_MOST_SEARCHED = 1_000_000
_WILDCARD = re.compile(r"[*?[]")


def _quantity(unit: str) -> BeforeValidator:
    """Return a validator from text with unit to a number in `unit`."""

    def validate(value: object) -> float:
        try:
            return read_quantity(value, unit)
        except QuantityError as error:
            raise PydanticCustomError("quantity", "{text}", {"text": str(error)}) from None

    return BeforeValidator(validate)


def _within(low: float, high: float, meaning: str) -> AfterValidator:
    """Return a validator that accepts ``low < value <= high``."""

    def validate(value: float) -> float:
        if not low < value <= high:
            text = f"{meaning} lies above {low:g} and up to {high:g}"
            raise PydanticCustomError("range", "{text}", {"text": text})
        return value

    return AfterValidator(validate)


def _share_u(value: float) -> float:
    """Accept a standard uncertainty that is a share: 0 to 1."""
    if not 0.0 <= value <= 1.0:
        text = (
            f'the standard uncertainty {value:g} of a share lies outside 0 to 1; write a number such as 0.02, or "2 %"'
        )
        raise PydanticCustomError("range", "{text}", {"text": text})
    return value


def _fraction(value: object) -> object:
    """Accept ``"45 %"`` beside ``0.45``."""
    if isinstance(value, str) and (match := re.fullmatch(r"\s*([\d.]+)\s*%\s*", value)):
        return float(match.group(1)) / 100.0
    return value


def _written(example: str) -> WithJsonSchema:
    """How a quantity looks in the file, for the JSON Schema."""
    return WithJsonSchema({"type": "string", "description": "number with unit", "examples": [example]})


Millimetres = Annotated[float, _quantity("mm"), _written("5 mm")]
PositiveMillimetres = Annotated[float, _quantity("mm"), _within(0.0, 1e5, "this length in mm"), _written("5 mm")]
Metres = Annotated[float, _quantity("mm"), AfterValidator(lambda mm: mm / 1e3), _written("1.2 m")]
Celsius = Annotated[float, _quantity("degC"), _within(-273.15, 3000.0, "a temperature in degC"), _written("22 degC")]
#: A camera whose clock was never set may be decades off; nanoseconds in 64 bits hold 292 years.
Seconds = Annotated[float, _quantity("s"), _within(-3e9, 3e9, "this time in s"), _written("37 s")]
PositiveSeconds = Annotated[float, _quantity("s"), _within(0.0, 1e6, "this time in s"), _written("2 s")]
Pixels = Annotated[int, _quantity("px"), _within(0.0, 1e5, "this number of pixels"), _written("4 px")]
PositiveMicrometres = Annotated[float, _quantity("um"), _within(0.0, 1e6, "this displacement in um"), _written("10 um")]
PartsPerMillion = Annotated[
    float, _quantity("ppm/K"), _within(-10.0, 200.0, "an expansion coefficient in ppm/K"), _written("11.7 ppm/K")
]
Feed = Annotated[float, _quantity("mm/min"), _within(0.0, 1e6, "a feed rate in mm/min"), _written("300 mm/min")]
Fraction = Annotated[float, BeforeValidator(_fraction), _within(0.0, 1.0, "this fraction")]
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
        text = f'there is no such time zone; {suggest(name, available_timezones())}write an IANA name such as "Europe/Vienna", or "UTC"'
        raise PydanticCustomError("zone", "{text}", {"text": text}) from None
    return name


TimeZone = Annotated[str, AfterValidator(_zone)]


def _patch(values: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """Accept a patch that holds a pixel."""
    if min(values[:2]) < 0 or min(values[2:]) < 1:
        text = (
            "this patch holds no pixel of a frame; write first column and first row, from 0 on, and the number of columns and of rows, at "
            "least 1 each, for example [8, 8, 24, 16]"
        )
        raise PydanticCustomError("patch", "{text}", {"text": text})
    return values


#: First column and row, number of columns and rows.
PixelPatch = Annotated[tuple[int, int, int, int], AfterValidator(_patch)]


def area_mm2(corners: tuple[tuple[float, float], ...]) -> float:
    """Return the area of a polygon by Gauss's formula, without its sense.

    Parameters
    ----------
    corners : tuple of (x, y), mm
        In order.
    """
    pairs = zip(corners, (*corners[1:], corners[0]), strict=True)
    return abs(sum(x * y_next - x_next * y for (x, y), (x_next, y_next) in pairs)) / 2.0


def corner_words(corners: tuple[tuple[float, float], ...]) -> str:
    """Return the corners of a polygon for a message.

    Parameters
    ----------
    corners : tuple of (x, y), mm
        In order.
    """
    return ", ".join(f"({x:g}, {y:g})" for x, y in corners) + " mm"


def not_a_file(path: str | Path) -> str:
    """Return why a path that is there is no file of somebody, or nothing.

    Parameters
    ----------
    path : str or Path
        What a campaign file names.
    """
    if "\0" in str(path):
        return ""
    real = os.path.realpath(path)
    if real.startswith(OF_THE_SYSTEM):
        return f"{path} is a part of the system and no file that was written; name a measured file"
    if os.path.isdir(real):  # noqa: PTH112 - a name that is too long is none
        return f"{path} is a folder; name a file in it"
    if os.path.exists(real) and not os.path.isfile(real):  # noqa: PTH110, PTH113
        return f"{path} is a pipe, a socket or a device; name a file"
    return ""


def matching_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files that a pattern matches; a link whose file is gone counts, so that it is missed.

    Parameters
    ----------
    folder : Path
        Of the campaign file, from which relative patterns start.
    pattern : str
        As `pathlib.Path.glob` takes it, relative or absolute.
    """
    there = [path for path in _matches(folder, pattern) if path.is_file() or (path.is_symlink() and not path.exists())]
    if Path(pattern).anchor:
        return there
    real = {place: place.resolve() for place in {path.parent for path in there}}
    return [
        real[path.parent] / path.name if not path.is_symlink() else path.resolve() if path.exists() else path
        for path in there
    ]


def matching_pipes(folder: Path, pattern: str) -> list[Path]:
    """Return the pipes, sockets and devices that a pattern matches, none of which is ever opened.

    Parameters
    ----------
    folder : Path
        Of the campaign file, from which relative patterns start.
    pattern : str
        As `matching_files` takes it.
    """
    return [path for path in _matches(folder, pattern) if path.exists() and not (path.is_file() or path.is_dir())]


def _matches(folder: Path, pattern: str) -> list[Path]:
    """Return all that a pattern matches, folders too; nothing where it is too long for a name."""
    given = Path(pattern)
    try:
        return list(
            Path(given.anchor).glob(str(given.relative_to(given.anchor))) if given.anchor else folder.glob(pattern)
        )
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return []
        raise


def check_pattern(folder: Path, pattern: str) -> None:
    """Refuse a pattern for which a whole disk would be searched.

    Parameters
    ----------
    folder : Path
        Of the campaign file, from which relative patterns start.
    pattern : str
        As `matching_files` takes it.

    Raises
    ------
    PydanticCustomError
        It has more than 64 folders, or searches folders of any depth below the root of a disk, or would look at more than 1,000,000 files
        and folders.
    """
    parts = Path(pattern).parts
    if len(parts) > _MOST_PARTS:
        raise PydanticCustomError(
            "pattern", f"has more than {_MOST_PARTS} folders; name the files from a folder nearer to them"
        )
    wild = [k for k, part in enumerate(parts) if _WILDCARD.search(part)]
    if "**" not in parts and len(wild) < 2:
        return
    start = Path(os.path.realpath(folder.joinpath(*parts[: wild[0]])))
    advice = f"name the folder of the files before the first wildcard, for example {start / 'thermal' / '*.jpg'}"
    if "**" in parts and start == Path(start.anchor):
        text = f"would search folders of any depth (**) below {start}, the root of a disk; {advice}"
        raise PydanticCustomError("pattern", "{text}", {"text": text})
    searched = 0
    for looked_at in _looked_at(start, parts[wild[0] :]):
        searched += looked_at
        if searched > _MOST_SEARCHED:
            text = f"would search more than {_MOST_SEARCHED:,} files and folders in {start}; {advice}"
            raise PydanticCustomError("pattern", "{text}", {"text": text})


def _looked_at(start: Path, parts: tuple[str, ...]) -> Iterator[int]:
    """Number of entries of each folder that is listed for a pattern; a fault of the disk is left to what matches the files."""
    for k, part in enumerate(parts):
        if not _WILDCARD.search(part) or parts[k - 1 : k] == ("**",):  # Whose folders are counted already.
            continue
        before = parts[: k + 1] if part == "**" else parts[:k]
        with contextlib.suppress(OSError):
            for listed in start.glob("/".join(before) + "/") if before else [start]:
                with contextlib.suppress(OSError):
                    yield len(os.listdir(listed))  # noqa: PTH208 - names alone
