"""What kind of file something is, told by its content: the campaign's own files, recordings, logs and plans."""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from fusion.campaign.quantities import unit_name
from fusion.toml_file import TomlError, read_toml
from interferometry.errors import InterferometryError
from interferometry.io.encodings import decode_text
from interferometry.io.faults import LaserFormatError
from interferometry.io.headings import CHINESE_WORDS, read_heading
from thermography.inspection import is_flir_file
from thermography.io.flir import index_frames
from thermography.io.frame_readers import find_reader
from thermography.io.temperature_frames import TemperatureReader
from thermography.io.text_frames import TextReader

#: Bytes that are read to tell the kind of a text.
_START = 65_536
#: Longest reason why a file is not understood, characters.
_LONGEST_REASON = 160
_TABLES = ("thermography", "plan", "interferometry", "record", "drivers", "sensors")
_RECIPE = ("test", "duty", "laser", "effect", "camera", "material")
_HEADING = re.compile(r"\s*(.+?)\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*")
_NUMBER = re.compile(r"[-+]?\d+(?:[.,]\d*)?(?:[eE][-+]?\d+)?")
#: Reason of a table whose columns nobody can know.
_BARE = (
    "a table of numbers without headings; write a first line that names every column with its unit, such as "
    "time [s],spindle [degC],nose [um]"
)
_TEMPERATURE_UNITS, _LENGTH_UNITS, _TIME_UNITS = ("degC", "K", "degF"), ("um", "nm", "mm"), ("s", "ms", "min", "h")


class Kind(StrEnum):
    """Kinds of files, in the words of a message."""

    CAMPAIGN = "campaign file"
    RECIPE = "recipe of a simulation"
    FRAMES = "thermal frames"
    STACK = "frames of temperatures"
    DEVIATIONS = "deviations"
    ENVIRONMENT = "environment log"
    FIDUCIALS = "fiducials"
    REGIONS = "regions of the plan"
    PLACES = "places of contact sensors"
    LENS = "lens calibration"
    DRIVERS = "log of drivers"
    RECORD = "record of temperatures and displacements"
    UNKNOWN = "not understood"
    UNREADABLE = "cannot be opened"


@dataclass(frozen=True)
class Recognised:
    """A file and its kind.

    Attributes
    ----------
    path : Path
        The file.
    kind : Kind
        Its kind.
    reason : str
        Why it is not understood or cannot be opened; empty for every other kind.
    headings : tuple of str
        Of a table, the headings of its columns.
    """

    path: Path
    kind: Kind
    reason: str = ""
    headings: tuple[str, ...] = ()


def recognise(path: Path) -> Recognised:
    """Tell the kind of a file by its content.

    Parameters
    ----------
    path : Path
        An existing file, or a link whose file is gone.

    Returns
    -------
    Recognised
        A table with the columns of a kind is of that kind, also where its rows are faulty: its reader says what is wrong.
    """
    if path.is_symlink() and not path.exists():
        return Recognised(path, Kind.UNREADABLE, f"a link to {path.readlink()}, where there is no file")
    if path.exists() and not path.is_file():
        return Recognised(path, Kind.UNREADABLE, "is a pipe, a socket or a device; name a file")
    if path.suffix.lower() == ".toml":
        return _toml(path)
    if is_flir_file(path):
        references, rejected = index_frames([path])
        return Recognised(path, Kind.FRAMES) if references else Recognised(path, Kind.UNKNOWN, rejected[0].reason)
    reader = find_reader(path)
    if isinstance(reader, TemperatureReader) and not isinstance(reader, TextReader):
        return Recognised(path, Kind.STACK)
    if reader is not None and not isinstance(reader, TextReader):
        reason = f"counts that the plug-in {reader.name} reads; name the files in thermography.frames, a run tells what they hold"
        return Recognised(path, Kind.UNKNOWN, reason)
    text = _text_start(path)
    if text is not None and ("camera_matrix" in text or "cameraMatrix" in text):
        return Recognised(path, Kind.LENS)
    # The readers of tables load what frames do not need.
    from interferometry.io.readers import is_environment_log, read_deviations

    try:
        headings = _headings(text) if text is not None else _sheet_headings(path)
        kind = _by_headings(headings)
        if kind is Kind.REGIONS and _names_each_once(path):
            kind = Kind.PLACES
        if kind is None:
            kind = Kind.ENVIRONMENT if is_environment_log(path) else Kind.DEVIATIONS
        if kind is Kind.DEVIATIONS and not _holds_deviations(path):
            read_deviations(path, rotary=True)
    except InterferometryError as error:
        # Text may be one frame of temperatures; what is neither is refused as the table that it is not.
        if isinstance(reader, TextReader) and reader.holds_a_frame(path):
            return Recognised(path, Kind.STACK)
        if text is not None and _is_bare(_headings(text)):
            return Recognised(path, Kind.UNKNOWN, _BARE)
        return Recognised(path, Kind.UNKNOWN, _shortened(str(error).removeprefix(f"{path}").lstrip(":, ")))
    return Recognised(path, kind, headings=headings)


def column_unit(heading: str) -> str:
    """Return the unit in a heading such as ``"t1 [degC]"``; empty where it has none.

    Parameters
    ----------
    heading : str
        Heading of a column.
    """
    match = _HEADING.fullmatch(heading)
    return unit_name(match.group(2)) if match else ""


def is_temperature(heading: str) -> bool:
    """Return whether a heading is that of a temperature.

    Parameters
    ----------
    heading : str
        Heading of a column.
    """
    return column_unit(heading) in _TEMPERATURE_UNITS


def is_displacement(heading: str) -> bool:
    """Return whether a heading is that of a displacement.

    Parameters
    ----------
    heading : str
        Heading of a column.
    """
    return column_unit(heading) in _LENGTH_UNITS


def is_time(heading: str) -> bool:
    """Return whether a heading is that of the time: ``time`` or ``date`` in a language that is read, or a column in units of time.

    Parameters
    ----------
    heading : str
        Heading of a column.
    """
    return read_heading(heading).role in ("time", "date") or column_unit(heading) in _TIME_UNITS


def _holds_deviations(path: Path) -> bool:
    """Whether a file has the columns of deviations, whatever is in them; where not, its reader says what is missing."""
    from interferometry.io.delimited import read_grids
    from interferometry.io.ecmc import is_ecmc_log
    from interferometry.io.long_table import find_long_table
    from interferometry.io.wide_table import find_wide_table

    with path.open("rb") as stream:
        start = stream.read(4096)
    if b"HEADER::" in start or is_ecmc_log(start):
        return True
    return any(find_long_table(grid) is not None or find_wide_table(grid) is not None for grid in read_grids(path))


def _shortened(reason: str) -> str:
    """Return a reason that repeats no whole line of a file."""
    return reason if len(reason) <= _LONGEST_REASON else f"{reason[:_LONGEST_REASON]} ..."


def _toml(path: Path) -> Recognised:
    """Tell campaign files from recipes by their tables."""
    try:
        content, _ = read_toml(path)
    except (TomlError, UnicodeDecodeError) as error:
        return Recognised(path, Kind.UNKNOWN, f"this is not TOML: {error}")
    if any(name in content for name in _RECIPE):
        return Recognised(path, Kind.RECIPE)
    if any(name in content for name in _TABLES):
        return Recognised(path, Kind.CAMPAIGN)
    return Recognised(path, Kind.UNKNOWN, "neither a campaign nor a recipe: no table of either")


def _text_start(path: Path) -> str | None:
    """Return the beginning of a text; None where the file is no text."""
    with path.open("rb") as file:
        start = file.read(_START)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return start.decode("utf-16", errors="ignore")
    if b"\0" in start:
        return None
    if len(start) == _START and b"\n" in start:
        # A character may be cut in two by the end of what was read.
        start = start[: start.rindex(b"\n")]
    try:
        return decode_text(path, start, chinese_words=CHINESE_WORDS)
    except LaserFormatError:
        return None


def _headings(text: str) -> tuple[str, ...]:
    """Return the fields of the first line that is neither empty nor a comment."""
    line = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    delimiter = max(",;\t", key=line.count)
    return tuple(name.strip() for name in next(csv.reader([line], delimiter=delimiter), []))


def _is_bare(first: tuple[str, ...]) -> bool:
    """Whether the first line of a table holds numbers where the headings should be."""
    return len(first) > 1 and all(_NUMBER.fullmatch(field.lstrip("\ufeff")) for field in first)


def _by_headings(headings: tuple[str, ...]) -> Kind | None:
    """Return the kind whose columns these are, None where they are of no kind of its own."""
    names = set(headings)
    if {"name", "x_mm", "y_mm"} <= names:
        if "diameter_mm" in names:
            return Kind.FIDUCIALS
        return Kind.REGIONS
    if _is_record(headings):
        return Kind.RECORD
    if "time" in names and len(headings) > 1 and all(column_unit(name) for name in headings if name != "time"):
        return Kind.DRIVERS
    return None


def _names_each_once(path: Path) -> bool:
    """Whether every name of a table has one place, as that of a sensor; a region has a line for each of its corners."""
    from interferometry.io.delimited import read_table

    names = [fields["name"].strip() for _, fields in read_table(path, ("name",)).records() if fields is not None]
    return len(names) > 1 and len(set(names)) == len(names)


def _is_record(headings: tuple[str, ...]) -> bool:
    """Whether columns are a time, temperatures and displacements, each with its unit."""
    return (
        any(is_time(name) for name in headings)
        and any(is_temperature(name) for name in headings)
        and any(is_displacement(name) for name in headings)
    )


def _sheet_headings(path: Path) -> tuple[str, ...]:
    """Return the headings of the first sheet of a spreadsheet; none where the file is neither that nor text."""
    from interferometry.io.workbook import is_workbook, read_sheets

    content = path.read_bytes()
    if not is_workbook(content):
        return ()
    _, rows = next(iter(read_sheets(path, content).items()))
    return tuple(name.strip() for name in rows[0][1]) if rows else ()
