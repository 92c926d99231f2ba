"""Files and folders looked into one after the other: none of them stops the others, and a series of frames is summed up."""

from __future__ import annotations

import codecs
import itertools
import os
import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from errno import EINVAL, ENOENT
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fusion
import interferometry
from fusion.campaign.values import column_unit, in_order, is_time
from fusion.common import FusionError
from fusion.common.messages import unforeseen
from fusion.common.toml_files import TomlError, read_toml
from fusion.results.folder import MANIFEST
from fusion.results.numbers import duration, join, moment, print_unit, span
from fusion.results.progress import clock_notices, counted, left_out_notices, listed
from fusion.results.store import GLOBAL_ATTRIBUTES, PRODUCTS, read_json_object
from interferometry.common import InterferometryError
from interferometry.io.faults import LaserFormatError
from thermography.common import ThermographyError
from thermography.evaluation import tabulate_regions
from thermography.inspection import (
    check_series,
    describe_camera,
    describe_evaluation,
    describe_scene,
    describe_stack,
    inspect_file,
)
from thermography.io import other_cameras
from thermography.io.flir import FrameReference, index_frames
from thermography.io.frame import CameraParameters
from thermography.io.sequence import camera_names
from thermography.registration.plan import read_fiducials

if TYPE_CHECKING:
    import xarray as xr

    from fusion.campaign.columns import Column, TableProposal


# Products of a run: NetCDF, maps as OpenEXR, results and provenance as JSON.

_EXR, _HDF5 = b"\x76\x2f\x31\x01", b"\x89HDF\r\n\x1a\n"
#: Texts of a run by their name, and how they are described.
_TEXTS = {
    "report.html": "page of a run, for a browser",
    "results.json": "results of a run: thermofuse report FOLDER writes its page",
    "provenance.json": "provenance of a run: inputs, products and their SHA-256",
    "manifest.json": "list of the files of a run",
}


def is_product(path: Path) -> bool:
    """Return whether a file is an OpenEXR map or what a run has written."""
    with path.open("rb") as file:
        start = file.read(8)
    if start == _HDF5:
        import h5py

        with h5py.File(path) as file:
            return "thermofuse run" in str(file.attrs.get("history", ""))
    return start.startswith(_EXR) or (path.name in _TEXTS and start.lstrip().startswith((b"{", b"<")))


def describe_product(path: Path) -> list[str]:
    """Return what a product holds: size, times, and the range of every quantity with its unit."""
    if path.name in _TEXTS:
        title = "" if path.suffix == ".html" else read_json_object(path).get("campaign", "")
        return [f"{_TEXTS[path.name]}{f'; campaign {title}' if title else ''}"]
    if path.suffix == ".nc":
        return list(_describe_dataset(path))
    return list(_describe_maps(path))


def _describe_dataset(path: Path) -> Iterator[str]:
    import xarray as xr

    with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as product:
        sizes = ", ".join(f"{name} {size}" for name, size in product.sizes.items())
        yield f"product of a run, {product.attrs[GLOBAL_ATTRIBUTES[1]]}: {sizes}"
        for name in next((kind for stem, kind in PRODUCTS.items() if stem == path.stem), product.data_vars):
            if name in product.variables and product[name].size and product[name].dtype.kind in "fM":
                yield f"{name} {span(product[name].values, product[name].attrs.get('units', ''), '.4g')}"
        if path.stem == "fields":
            yield "thermofuse export RESULTS --format png, gif or mp4 draws every cycle"


def _describe_maps(path: Path) -> Iterator[str]:
    from thermography.io.files import read_header, read_maps

    maps, header = read_maps(path), read_header(path)
    rows, columns = next(iter(maps.values())).shape
    known = [f"{name.replace('_', ' ')} {header[name]}" for name in ("cycle", "time", "cell_size_mm") if name in header]
    yield f"OpenEXR maps of {columns} x {rows} cells: {', '.join(known) or 'no word of a run in the header'}"
    yield from (
        f"{name} {span(values, str(header.get(name, '')), '.4g')}" for name, values in maps.items() if name != "mask"
    )


# What kind of file something is: each kind declared once, with how it is recognised by its content, read and described.

#: Bytes that are read to tell the kind of a text, and lines that tell a list of pixels.
_START, _LOOKED_INTO_LINES = 65_536, 8
#: Longest reason why a file is not understood, characters: with a line of the file and the remedy.
_LONGEST_REASON = 480
_TABLES = ("thermography", "plan", "interferometry", "record", "drivers", "sensors")
_RECIPE = ("test", "duty", "laser", "effect", "camera", "material")
#: Units of the temperatures and of the displacements of a record.
_OF_A_RECORD = ({"degC", "K", "degF"}, {"um", "nm", "mm", "in", "mil"})
#: How JSON begins, of an object or of a list.
_JSON = re.compile(r'\s*[{[]\s*["{[]')
#: Fewest names of a line that heads a table, and no remark above a picture.
_NAMED = 4
#: Columns of a table of places on the plan.
_PLACE = {"name", "x_mm", "y_mm"}


@dataclass(frozen=True)
class FileKind:
    """A kind of file, in the words of a message, and how it is recognised, read and described.

    ``sniff`` recognises it; ``read`` returns its content; ``describe`` says in lines what was read; ``key`` of the campaign file names such
    a file; ``may_be`` recognises what no kind sniffs; ``unused`` is what can be done with a file that a campaign does not use.
    """

    words: str
    sniff: Callable[[Recognised], bool] = lambda found: False
    read: Callable[[Path], Any] = lambda path: None
    describe: Callable[[Recognised], list[str]] = lambda found: []
    key: str = ""
    may_be: Callable[[Recognised], bool] = lambda found: False
    unused: str = ""


@dataclass(eq=False)
class Recognised:
    """A file and its kind, or why it is not understood or cannot be opened; each of its parts is read once, when it is needed."""

    path: Path
    kind: Kind
    reason: str = ""

    @cached_property
    def content(self) -> Any:
        """What the reader of its kind returns."""
        if self.kind is Kind.RECORD and not isinstance(self.logged, str):
            return self.logged
        return self.kind.value.read(self.path)

    @property
    def temperatures(self) -> TableProposal | None:
        """Proposal for temperatures without a displacement, as a log of the air; None of a file that holds something else."""
        # A file that is not understood may have failed before it was looked at as a table.
        logged = vars(self).get("logged", "") if self.kind in (Kind.RECORD, Kind.UNKNOWN) else ""
        return None if isinstance(logged, str) or logged.lacking != ["displacement"] else logged

    @property
    def headings(self) -> tuple[str, ...]:
        """Headings of a record, as its first line or, where that holds none, its proposed columns have them."""
        return self.first_line if _names_a_record(self) else tuple(one.heading for one in self.content.columns)

    @cached_property
    def tables(self) -> Container[str]:
        """Names of the tables of a TOML file; none of another one."""
        try:
            return read_toml(self.path)[0] if self.path.suffix.lower() == ".toml" else ()
        except (TomlError, UnicodeDecodeError) as error:
            raise FusionError(f"this is not TOML: {error}") from None

    @cached_property
    def reader(self) -> other_cameras.FrameReader | None:
        """Reader of frames that recognises the file."""
        return other_cameras.find_reader(self.path)

    @cached_property
    def text(self) -> str | None:
        """Beginning of a text; None where the file is no text."""
        # Not before: frames are looked into without xarray.
        from interferometry.io.tables import decode_text

        with self.path.open("rb") as file:
            start = file.read(_START)
        if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return start.decode("utf-16", errors="ignore")
        if b"\0" in start:
            return None
        if len(start) == _START and b"\n" in start:
            # A character may be cut in two by the end of what was read.
            start = start[: start.rindex(b"\n")]
        try:
            return decode_text(self.path, start)
        except LaserFormatError:
            return None

    @cached_property
    def first_line(self) -> tuple[str, ...]:
        """Fields of the first line that is neither empty nor a comment, or of the first line of a spreadsheet; none of other files."""
        from interferometry.io.spreadsheets import is_workbook, read_sheets
        from interferometry.io.tables import delimiter_of, fields_of, find_header

        if self.text is not None:
            _, line = find_header(self.text.splitlines())
            fields = fields_of(line, delimiter_of(line) or ",")
        elif is_workbook(self.path.read_bytes()):
            fields = next(iter(read_sheets(self.path).values()))[0][1]
        else:
            fields = []
        return tuple(name.strip() for name in fields)

    @cached_property
    def of_a_laser(self) -> bool:
        """Whether its first line names readings of a test, whatever stands beside them."""
        from interferometry.io.tables import read_heading

        roles = {read_heading(name).role for name in self.first_line}
        return len(roles & {"cycle", "direction", "target", "position", "measured", "deviation"}) > 1

    @cached_property
    def logged(self) -> TableProposal | str:
        """Proposal for a table of something over time; why the file is none, or "" where it is one of readings, whatever it lacks."""
        try:
            return "" if self.of_a_laser else resolve_name("fusion.campaign.columns:propose_table")(self.path)
        except (FusionError, InterferometryError) as error:
            return str(error)


def _is_recipe(found: Recognised) -> bool:
    return any(name in found.tables for name in _RECIPE)


def _is_campaign(found: Recognised) -> bool:
    if found.tables != () and not any(name in found.tables for name in _TABLES):
        raise FusionError("neither a campaign nor a recipe: no table of either")
    return found.tables != ()


def _holds_counts(found: Recognised) -> bool:
    reader = found.reader
    if reader is None and (what := other_cameras.name_unread(found.path)):
        raise FusionError(what)
    if reader is None or isinstance(reader, other_cameras.TemperatureReader):
        return False
    if not other_cameras.is_of_flir(reader):
        raise FusionError(
            f"counts that the plug-in {reader.name} reads; name the files in thermography.frames, a run reads them"
        )
    references, rejected = index_frames([found.path])
    if not references:
        raise ThermographyError(rejected[0].reason)
    return True


def _holds_temperatures(found: Recognised) -> bool:
    if isinstance(found.reader, other_cameras.TextReader):
        _refuse_list_of_pixels(found)
        return found.text is not None and found.reader.begins_a_frame(found.text)
    return isinstance(found.reader, other_cameras.TemperatureReader)


def _refuse_list_of_pixels(found: Recognised) -> None:
    """Refuse a picture as a list of x, y, temperature: its columns would pass for displacements along x and y."""
    if tuple(name.lower() for name in found.first_line[:2]) in (("x", "y"), ("column", "row"), ("row", "column")):
        places = re.findall(r"^\s*(\d+)\W+(\d+)(?![\d.])", found.text or "", re.MULTILINE)[:_LOOKED_INTO_LINES]
        x, y = np.array(places or [(0, 0)], int).T
        if len(places) > 2 and (np.ptp(x) == len(x) - 1) != (np.ptp(y) == len(y) - 1):
            raise FusionError(
                "a list of pixels; export the picture as a table of its temperatures alone, a line per row"
            )


def _may_hold_a_frame(found: Recognised) -> bool:
    # Hundreds of columns with a time among their names are a logged table.
    named = len(found.first_line) >= _NAMED and any(map(is_time, found.first_line))
    return isinstance(found.reader, other_cameras.TextReader) and not named and found.reader.holds_a_frame(found.path)


def _is_lens(found: Recognised) -> bool:
    return any(name in (found.text or "") for name in ("camera_matrix", "cameraMatrix"))


def _lists_fiducials(found: Recognised) -> bool:
    return {*_PLACE, "diameter_mm"} <= set(found.first_line)


def _lists_places(found: Recognised) -> bool:
    return set(found.first_line) >= _PLACE


def _lists_sensors(found: Recognised) -> bool:
    # A sensor has one place; a region has a line for each of its corners.
    names = _read_names(found.path) if _lists_places(found) else []
    return 1 < len(names) == len(set(names))


def _names_a_record(found: Recognised) -> bool:
    from interferometry.io.readings import holds_deviations

    if found.of_a_laser and holds_deviations(found.path):
        return False
    units = {column_unit(name) for name in found.first_line}
    return any(map(is_time, found.first_line)) and all(units & of_role for of_role in _OF_A_RECORD)


def _logs_drivers(found: Recognised) -> bool:
    units = [column_unit(name) for name in found.first_line if name != "time"]
    return "time" in found.first_line and len(found.first_line) > 1 and all(units) and not _logs_environment(found)


def _logs_environment(found: Recognised) -> bool:
    from interferometry.io.readings import ENVIRONMENT_COLUMNS, holds_environment, is_environment_log
    from interferometry.io.tables import read_heading

    if not is_environment_log(found.path):
        return False
    whole, roles = holds_environment(found.path), {read_heading(name).role for name in found.first_line}
    if whole and roles <= {"time", *(name for _, name, *_ in ENVIRONMENT_COLUMNS)}:
        return True
    # A record may log the air pressure too; and temperatures beside it that lack what a laser needs are a series that drift may follow.
    logged = found.logged
    return isinstance(logged, str) or (bool(logged.lacks) and (whole or logged.lacking != ["displacement"]))


def _holds_deviations(found: Recognised) -> bool:
    from interferometry.io.readings import holds_deviations

    if _JSON.match(found.text or ""):
        raise FusionError(
            "JSON, which is not read; write it as CSV with a column for each value, by pandas.read_json(FILE, lines=True).to_csv(...)"
        )
    if not holds_deviations(found.path):
        interferometry.read_deviations(found.path, rotary=True)  # says what is missing
    return True


def _read_names(path: Path) -> list[str]:
    from interferometry.io.tables import read_table

    return [
        fields["name"].strip()
        for _, fields in read_table(path, ("name", "x_mm", "y_mm")).records()
        if fields is not None
    ]


def _later(name: str) -> Callable[[Path], Any]:
    """Return a reader that is loaded when it is called: other files are described without what it needs."""
    return lambda path: resolve_name(name)(path)


def _describe_recipe(found: Recognised) -> list[str]:
    title = found.content.get("campaign", {}).get("title", "")
    return [f"recipe of a simulation, {title}".rstrip(", "), f"thermofuse simulate {found.path} --out FOLDER"]


def _describe_campaign(found: Recognised) -> list[str]:
    campaign = found.content
    named = ("thermography", "plan", "interferometry", "drivers", "record")
    tables = [f"[{name}]" for name in named if getattr(campaign, name) is not None]
    frames = len(campaign.frame_paths())
    files = f"{counted(frames, 'file')} of thermal frames, {len(campaign.input_files())} files in all"
    return [
        f"campaign, {campaign.campaign.title}",
        f"{join(tables)}, every key is understood",
        *([files] if frames else []),
        f"thermofuse check {campaign.path} checks them",
    ]


def _describe_frames(found: Recognised) -> list[str]:
    return [line.removeprefix(f"{found.path}: ").removeprefix("  ") for line in found.content.lines()]


def _describe_lens(found: Recognised) -> list[str]:
    lens = found.content
    column, row = lens.principal_point_px
    return [f"lens, focal length {lens.focal_length_px:.1f} px, centre {column:.1f}, {row:.1f} px"]


def _describe_fiducials(found: Recognised) -> list[str]:
    listed = found.content
    points = sum(one.is_point for one in listed)
    markers = sum(one.marker is not None for one in listed)
    kinds = ((len(listed) - points - markers, "disc"), (points, "point"), (markers, "marker"))
    columns, rows = [one.x_mm for one in listed], [one.y_mm for one in listed]
    return [
        f"fiducials, {join([counted(count, noun) for count, noun in kinds if count])}, "
        f"x {min(columns):g} to {max(columns):g} mm, y {min(rows):g} to {max(rows):g} mm",
        f"{sum(one.hint_px is not None for one in listed)} with a rough place in the frame",
    ]


def _describe_places(found: Recognised) -> list[str]:
    return [
        f"places of {counted(len(found.content), 'contact sensor')} on the plan: {join(found.content)}",
        "[sensors] of a campaign file names it as places, with the file of their temperatures",
    ]


def _describe_regions(found: Recognised) -> list[str]:
    names = [region.name for region in found.content]
    return [f"{counted(len(names), 'region')} of the plan: {join(names)}"]


#: Columns alike in role and unit that are described one by one.
_COLUMNS_ALIKE = 12


def _describe_record(found: Recognised) -> list[str]:
    table = found.content
    sheet = f"sheet {table.keys['sheet']!r}, " if "sheet" in table.keys else ""
    held = join([column.heading for column in table.of("time")])
    without = "times not understood" if table.asked.get("every") else "without times"
    time = f"time in the column {held}" if held else "a line for every change" if "long" in table.keys else without
    doubts = [f"{key} = {table.keys[key]}" for key in table.asked if key in table.keys]
    if "time_unit" in table.asked:
        doubts = [f"times {table.asked['time_unit']}, in {table.keys['time_unit']}?"]
    lacks = [f"warning: {fault}" for fault in (table.lacks, table.asked.get("every"), table.refused) if fault]
    return [
        f"record, {sheet}{counted(table.rows, 'row')}, {time}",
        *(f"{doubt}, which nothing states" for doubt in doubts),
        *_course(table.time, table.reference, "row"),
        *_columns(table),
        *lacks,
        *_warnings(table),
    ]


def _columns(table: TableProposal) -> Iterator[str]:
    """Say of each column what it is taken for, its unit and where that stands, and its range; of many alike together."""
    alike: dict[tuple[str, str, str], list[Column]] = {}
    for column in table.columns:
        how = column.remark or (f"by its {column.told}" if column.told else "")
        alike.setdefault((column.role, column.unit, how), []).append(column)
    for (role, unit, how), columns in alike.items():
        if role == "time":
            continue
        words = ", ".join(filter(None, ("unused" if role == "out" else role, print_unit(unit) if unit else "", how)))
        if len(columns) <= _COLUMNS_ALIKE:
            yield from (f"{one.heading}: {words}{f', {one.span}' if one.span else ''}" for one in columns)
            continue
        names = f"{columns[0].heading} ... {columns[-1].heading} ({len(columns)} columns)"
        known = [limit for one in columns if one.span for limit in (one.low, one.high)]
        yield f"{names}: {words}" + (f", {span(known)}" if known else "")


def _course(times: NDArray[np.datetime64], reference: str, noun: str) -> Iterator[str]:
    """Say from when to when something was logged, how often, and where there are gaps."""
    from interferometry.io.tables import DATED, NO_ZONE

    timed = np.sort(times[~np.isnat(times)])
    if timed.size == 0:
        return
    length = duration(float((timed[-1] - timed[0]) / np.timedelta64(1, "s")))
    zone, dated = "" if reference == NO_ZONE else None, timed[0] >= DATED

    def at(time: np.datetime64) -> str:
        return moment(time, zone) if dated else f"{time.astype('M8[ns]').astype(np.int64) / 1e9:.10g} s"

    ends = f"{at(timed[0])} to {at(timed[-1])}"
    yield f"{ends}, {length}, {reference}" if dated else f"{ends} after a start that is not stated, {length}"
    if timed.size > 1:
        gaps = [
            f"{at(end)}, {duration(float((start - end) / np.timedelta64(1, 's')))}"
            for (_, end), (start, _) in itertools.pairwise(Recording("", timed).stretches())
        ]
        step_s = float(np.median(np.diff(timed).astype("m8[ns]").astype(np.int64))) * 1e-9
        rate = f"{1 / step_s:.3g} {noun}s per second" if step_s > 0 else f"{noun}s of one time"
        every = f"a {noun} every {duration(step_s)}" if step_s >= 1 else rate
        yield f"{every}, {counted(len(gaps), 'gap')}{': ' + listed(gaps) if gaps else ''}"


def _describe_log(found: Recognised) -> list[str]:
    log = found.content
    name = "drivers" if found.kind is Kind.DRIVERS else "environment"
    lines = [
        f"{name}, {counted(log.sizes['time'], 'row')}",
        *_course(log["time"].values, log["time"].attrs["reference"], "row"),
    ]
    for variable, values in log.data_vars.items():
        lines.append(f"{variable} {span(values, values.attrs['units'], '.2f')}")
    return lines + _warnings(log)


def _describe_deviations(found: Recognised) -> list[str]:
    from interferometry.inspection import describe_test

    deviations = found.content
    values, time, position = (deviations[name] for name in ("deviation", "time", "position"))
    timed = time.values[~np.isnat(time.values)]
    when = (
        f"{moment(timed.min())} to {moment(timed.max())}, times {time.attrs['origin']}, {time.attrs['reference']}"
        if timed.size
        else "no times: thermofuse run evaluates them by ISO 230-2, and needs one per reading for drift and causes"
    )
    return [
        f"deviations, {counted(deviations.sizes['cycle'], 'cycle')}, {counted(deviations.sizes['target'], 'target')} from "
        f"{position.values.min():g} to {position.values.max():g} {position.attrs['units']}, "
        f"{int(np.isfinite(values).sum())} of {values.size} readings",
        f"deviation {span(values, values.attrs['units'], '.3f')}",
        when,
        *describe_test(deviations),
        *_warnings(deviations),
    ]


def _warnings(table: xr.Dataset) -> list[str]:
    notices = [*left_out_notices(table, "left_out"), *clock_notices(table)]
    return [f"warning: {notice.message} {notice.remedy}" for notice in notices]


class Kind(Enum):
    """Kinds of files, in the order in which a file is held against them."""

    PRODUCT = FileKind(
        "product of a run", lambda found: is_product(found.path), lambda path: path, lambda found: describe_product(found.path),
        unused=", no input of a campaign",
    )  # fmt: skip
    # A name of a package, as fusion.load_campaign, loads what it needs when it is called: pydantic, xarray.
    RECIPE = FileKind("recipe of a simulation", _is_recipe, lambda path: read_toml(path)[0], _describe_recipe)
    CAMPAIGN = FileKind("campaign file", _is_campaign, lambda path: fusion.load_campaign(path), _describe_campaign)
    FRAMES = FileKind("thermal frames", _holds_counts, inspect_file, _describe_frames, "thermography.frames")
    STACK = FileKind(
        "frames of temperatures", _holds_temperatures, other_cameras.read_stack, lambda found: describe_stack(found.content),
        "thermography.frames", may_be=lambda found: _may_hold_a_frame(found),
        unused=", not mixed with the frames of a FLIR camera",
    )  # fmt: skip
    LENS = FileKind(
        "lens calibration",
        _is_lens,
        _later("thermography.registration.projection:read_lens"),
        _describe_lens,
        "thermography.lens",
    )
    FIDUCIALS = FileKind("fiducials", _lists_fiducials, read_fiducials, _describe_fiducials, "plan.fiducials")
    PLACES = FileKind(
        "places of contact sensors", _lists_sensors, _read_names, _describe_places, "sensors.places",
        unused=", for [sensors] together with [plan]: docs/reference/campaign-file.md",
    )  # fmt: skip
    REGIONS = FileKind(
        "regions of the plan",
        _lists_places,
        _later("fusion.analysis.attribution.modes:read_regions"),
        _describe_regions,
        "plan.regions",
    )
    RECORD = FileKind(
        "record of temperatures and displacements", _names_a_record, _later("fusion.campaign.columns:propose_table"), _describe_record,
        "record.file",
        may_be=lambda found: not isinstance(found.logged, str) and found.logged.may_be_record,
        unused="; the runs of one record have the same columns, another record is a campaign of its own",
    )  # fmt: skip
    DRIVERS = FileKind("log of drivers", _logs_drivers, lambda path: fusion.read_drivers(path), _describe_log, "drivers.file")  # fmt: skip
    ENVIRONMENT = FileKind(
        "environment log", _logs_environment, lambda path: interferometry.read_environment(path), _describe_log,
        "interferometry.environment",
    )  # fmt: skip
    DEVIATIONS = FileKind(
        "deviations", _holds_deviations, lambda path: interferometry.read_deviations(path, rotary=True), _describe_deviations,
        "interferometry.deviations", unused="; one campaign takes one file of deviations: join the tables of one test",
    )  # fmt: skip
    UNKNOWN = FileKind("not understood")
    UNREADABLE = FileKind("cannot be opened")


def recognise(path: Path) -> Recognised:
    """Tell the kind of a file by its content; one on which a reader fails, in whatever way, is not understood and stops no other."""
    found = Recognised(path, Kind.UNKNOWN)
    try:
        found.kind = _kind_of(found)
    except Exception as error:
        found.kind, found.reason = _why_not(path, error)
    # Of ten thousand frames as text nobody needs the beginnings together.
    vars(found).pop("text", None)
    return found


def _why_not(path: Path, error: Exception) -> tuple[Kind, str]:
    """Return the kind of a file that a reader failed on, and why in words: its own, or that nobody has foreseen it."""
    if isinstance(error, OSError):
        return Kind.UNREADABLE, str(error.strerror or error)
    if isinstance(error, (FusionError, ThermographyError, InterferometryError)):
        return Kind.UNKNOWN, str(error).removeprefix(str(path)).lstrip(":, ")
    return Kind.UNKNOWN, f"{unforeseen(error)}; please report it with the file"


def _kind_of(found: Recognised) -> Kind:
    """Return the kind of a file by its content; raise why it has none."""
    path = found.path
    if path.is_symlink() and not path.exists():
        raise FileNotFoundError(ENOENT, f"a link to {path.readlink()}, where there is no file")
    if path.exists() and not path.is_file():
        raise OSError(EINVAL, "is a pipe, a socket or a device; name a file")
    try:
        return next(kind for kind in Kind if kind.value.sniff(found))
    except InterferometryError as error:
        if (kind := next((one for one in Kind if one.value.may_be(found)), None)) is not None:
            return kind
        if not isinstance(found.logged, str):
            raise FusionError(found.logged.lacks) from error
        _, reason = _why_not(path, FusionError(found.logged) if found.logged else error)
        raise FusionError(reason if len(reason) <= _LONGEST_REASON else f"{reason[:_LONGEST_REASON]} ...") from error


# What a folder holds for a campaign: frames by pattern, readings, logs, the plan, and what is not understood.

#: Files of folders that hold results, not inputs.
_RESULTS = ("results.json", MANIFEST)
#: Files of a series, those of one folder and ending, that decide whether it holds thermal frames.
_LOOKED_INTO = 3


@dataclass(frozen=True)
class FolderContent:
    """Files of a folder by what a campaign needs them for.

    ``frames`` are patterns relative to the folder, ``frame_files`` the files that they match; ``unknown`` holds files that are not
    understood, links whose file is gone, pipes, sockets and devices; ``of_temperatures`` tells whether the frames hold temperatures of
    another camera and not FLIR counts.
    """

    folder: Path
    frames: tuple[str, ...] = ()
    frame_files: tuple[Path, ...] = ()
    files: dict[Kind, tuple[Recognised, ...]] = field(default_factory=dict)
    unknown: tuple[Recognised, ...] = ()
    of_temperatures: bool = False

    def of(self, kind: Kind) -> tuple[Recognised, ...]:
        """Return the files of a kind, sorted by name."""
        return self.files.get(kind, ())

    def relative(self, path: Path) -> str:
        """Return a path as a campaign file in the folder writes it."""
        return Path(os.path.relpath(path, self.folder)).as_posix()


def scan_folder(folder: Path, *, within: Path | None = None) -> FolderContent:
    """Look at every file of a folder and its subfolders; links that lead out of `within` are not followed."""
    paths = list(input_files(folder, within=within))
    series = thermal_series(paths)
    thermal = {path for members in series.values() for path in members}
    patterns, frames = [], []
    found = [recognise(path) for path in paths if path not in thermal]
    for (parent, suffix), members in series.items():
        # A long series is read whole by the run, which names the frames that it leaves out.
        looked = [recognise(path) for path in members[:_LOOKED_INTO]]
        if any(one.kind is Kind.FRAMES for one in looked):
            patterns.append((parent.relative_to(folder) / f"*{suffix}").as_posix())
            frames += members
        else:
            found += [Recognised(path, Kind.UNKNOWN, looked[0].reason) for path in members]
    known: dict[Kind, list[Recognised]] = {}
    for one in found:
        known.setdefault(one.kind, []).append(one)
    unknown = [*known.pop(Kind.UNKNOWN, []), *known.pop(Kind.UNREADABLE, [])]
    of_temperatures = not patterns and Kind.STACK in known
    if of_temperatures:
        frames = [one.path for one in known.pop(Kind.STACK)]
        for (parent, suffix), members in _by_series(frames).items():
            whole = members == _by_series(paths)[parent, suffix]
            patterns += [
                path.relative_to(folder).as_posix() for path in ([parent / f"*{suffix}"] if whole else members)
            ]
    files = {kind: tuple(members) for kind, members in known.items()}
    return FolderContent(folder, tuple(patterns), tuple(frames), files, tuple(unknown), of_temperatures)


def thermal_series(paths: Iterable[Path]) -> dict[tuple[Path, str], list[Path]]:
    """Return the thermal files of a FLIR camera by folder and ending."""
    return _by_series(path for path in paths if is_thermal(path))


def is_thermal(path: Path) -> bool:
    """Return whether a path is a file of a FLIR camera that can be opened."""
    try:
        return path.is_file() and other_cameras.is_of_flir(other_cameras.find_reader(path))
    except OSError:
        return False


def _by_series(paths: Iterable[Path]) -> dict[tuple[Path, str], list[Path]]:
    series: dict[tuple[Path, str], list[Path]] = {}
    for path in paths:
        series.setdefault((path.parent, path.suffix), []).append(path)
    return series


def input_files(folder: Path, seen: set[Path] | None = None, *, within: Path | None = None) -> Iterator[Path]:
    """Yield the files of a folder and its subfolders, sorted, without hidden ones, results of a run, and links out of `within`."""
    seen = set() if seen is None else seen
    if folder.resolve() in seen:
        return
    seen.add(folder.resolve())
    for path in in_order(folder.iterdir()):
        if path.name.startswith(".") or (within is not None and leads_out(path, within)):
            continue
        if not path.is_dir():
            yield path
        elif not any((path / name).is_file() for name in _RESULTS):
            yield from input_files(path, seen, within=within)


def leads_out(path: Path, folder: Path) -> bool:
    """Return whether a path is a symbolic link to a place outside a folder."""
    return path.is_symlink() and not path.resolve().is_relative_to(folder.resolve())


#: Thermal files of one folder and ending that are described one by one; more are a series.
_ONE_BY_ONE = 3


@dataclass(frozen=True)
class Inspected:
    """What was found in a file or a series.

    ``label`` is its path, or the pattern of a series; ``fault`` says why it cannot be used; ``named`` tells whether it was asked for by
    name, and not found in a folder.
    """

    label: str
    kind: Kind
    lines: tuple[str, ...] = ()
    fault: str = ""
    named: bool = True

    @property
    def fails(self) -> bool:
        """Whether something that was asked for, or that is of a known kind, cannot be used."""
        return bool(self.fault) and (self.named or self.kind is not Kind.UNKNOWN)

    @property
    def warnings(self) -> list[str]:
        """Warnings among the lines."""
        return [line for line in map(str.strip, self.lines) if line.startswith("warning: ")]

    @property
    def content(self) -> list[str]:
        """The other lines."""
        return [line for line in map(str.strip, self.lines) if not line.startswith("warning: ")]

    def shown(self, *, quiet: bool = False) -> list[str]:
        """Return the lines for the terminal; `quiet` leaves faults and warnings, each with its file."""
        if self.fault:
            return [f"{self.label}: {self.kind.value.words}: {self.fault}"] if self.fails or not quiet else []
        if quiet:
            return [f"{self.label}: {line}" for line in self.warnings]
        return [f"{self.label}: {self.lines[0]}", *(f"  {line}" for line in self.lines[1:])]

    def as_json(self) -> dict[str, Any]:
        """Return it as a mapping of JSON's own types."""
        lines = [] if self.fault else [line.strip() for line in self.shown()]
        return {"file": self.label, "kind": self.kind.value.words, "lines": lines, "fault": self.fault}


def inspect_paths(paths: Sequence[Path], *, within: Path | None = None) -> Iterator[Inspected]:
    """Look into files and folders; links in these that lead out of `within` are not followed."""
    named, files = set(paths), _files(paths, within)
    for path in paths:
        if path.is_dir() and not any(True for _ in input_files(path, within=within)):
            fault = "contains no file to inspect (hidden files and results are skipped); name the folder of the measured files"
            yield Inspected(str(path), Kind.UNKNOWN, fault=fault, named=True)
    series = thermal_series(files) | _by_series(path for path in files if path.suffix == ".exr")
    summed_up = {path: members for members in series.values() if len(members) > _ONE_BY_ONE for path in members}
    for path in files:
        members = summed_up.get(path, [])
        if not members:
            yield _inspect(path, named=path in named)
        elif path == members[0]:
            yield _inspect_series(members, label=str(path.parent / f"*{path.suffix}"))


def write_frames(paths: Sequence[Path], folder: Path, formats: Sequence[str]) -> Iterator[str]:
    """Write the frames of all thermal files for other programs, see `thermography.pictures.export_frames`; say what was written."""
    from thermography.pictures import export_frames  # loads xarray, which nothing else here needs

    frames, rejected = index_frames([path for path in _files(paths) if is_thermal(path)])
    if frames:
        yield from (f"written: {path}" for path in export_frames(frames, folder, formats))
    yield from (f"left out: {one.reason}" for one in rejected)


def _files(paths: Sequence[Path], within: Path | None = None) -> list[Path]:
    """Return files, and those of folders, each once."""
    found = (input_files(path, within=within) if path.is_dir() else [path] for path in paths)
    return list(dict.fromkeys(file for files in found for file in files))


def _inspect(path: Path, *, named: bool) -> Inspected:
    """Look into one file."""
    found = recognise(path)
    if found.reason:
        return Inspected(str(path), found.kind, fault=found.reason, named=named)
    try:
        return Inspected(str(path), found.kind, tuple(found.kind.value.describe(found)), named=named)
    except Exception as error:
        kind, fault = _why_not(path, error)
        return Inspected(str(path), found.kind if kind is Kind.UNKNOWN else kind, fault=fault, named=named)


def _inspect_series(paths: Sequence[Path], *, label: str) -> Inspected:
    """Sum up a series of thermal files, or of maps, by its first file."""
    if paths[0].suffix == ".exr":
        first = _inspect(paths[0], named=False)
        return replace(
            first, label=label, lines=(f"{counted(len(paths), 'file')}, the first: {first.lines[0]}", *first.lines[1:])
        )
    try:
        return Inspected(label, Kind.FRAMES, tuple(describe_series(paths, label=label)))
    except Exception as error:
        kind, fault = _why_not(Path(label), error)
        return Inspected(label, kind, fault=fault, named=False)


# What was recorded when, as bars of text on one time axis.

_FULL, _EMPTY = "█", "·"
#: Samples further apart than this many times their usual distance have a gap between them.
_GAP_STEPS = 10.0


@dataclass(frozen=True)
class Recording:
    """One recording of a campaign: its samples (n,) in UTC on the laser's clock, empty where it has no times."""

    name: str
    times: NDArray[np.datetime64]

    def stretches(self) -> list[tuple[np.datetime64, np.datetime64]]:
        """Return start and end of every stretch without a gap."""
        times = np.sort(self.times[~np.isnat(self.times)]).astype("datetime64[ns]")
        if times.size == 0:
            return []
        steps = np.diff(times).astype(np.int64)
        moving = steps[steps > 0]
        usual = float(np.median(moving)) if moving.size else 0.0
        cuts = np.flatnonzero(steps > _GAP_STEPS * usual) if usual else np.array([], dtype=int)
        starts, ends = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [times.size - 1]])
        return list(zip(times[starts], times[ends], strict=True))


def time_bars(recordings: Sequence[Recording], *, width: int = 60, zone: str = "UTC") -> list[str]:
    """Return a bar per recording, filled where it has samples, above one time axis in a zone."""
    from interferometry.io.tables import DATED

    stretches = {recording.name: recording.stretches() for recording in recordings}
    ends = [end for parts in stretches.values() for part in parts for end in part]
    if not ends:
        return []
    first, last = min(ends), max(ends)
    label = max(len(name) for name in (*stretches, zone))
    lines = []
    for name, parts in stretches.items():
        gaps = f"  {counted(len(parts) - 1, 'gap')}" if len(parts) > 1 else ""
        lines.append(f"{name:<{label}}  {_bar(parts, first, last, width)}{gaps}")
    length = duration(float((last - first) / np.timedelta64(1, "s")))
    if first < DATED:
        return [*lines, f"{'':<{label}}  {'start':<{width - len(length)}}{length}"]
    left, right = (np.datetime_as_string(time, unit="m").replace("T", " ") for time in (first, last))
    middle = f"{length:^{max(width - len(left) - len(right), 0)}}"
    return [*lines, f"{zone:<{label}}  {left}{middle}{right}"]


def _bar(
    parts: Sequence[tuple[np.datetime64, np.datetime64]], first: np.datetime64, last: np.datetime64, width: int
) -> str:
    """Return a bar whose characters are filled where a stretch touches their share of the time."""
    if not parts:
        return f"{'no times':{_EMPTY}<{width}}"
    whole = max(float((last - first) / np.timedelta64(1, "ns")), 1.0)
    filled = np.zeros(width, dtype=bool)
    for start, end in parts:
        low, high = (float((time - first) / np.timedelta64(1, "ns")) / whole * width for time in (start, end))
        filled[min(int(low), width - 1) : max(int(np.ceil(high)), int(low) + 1)] = True
    return "".join(_FULL if is_filled else _EMPTY for is_filled in filled)


# A series of thermal frames in about ten lines: one camera? gaps in time? the same settings? anything left out?


def describe_series(paths: Sequence[Path], *, label: str) -> list[str]:
    """Return what a series of thermal files holds."""
    frames, rejected = index_frames(paths)
    if not frames:
        raise ThermographyError(f"{label}: no frame can be read; {rejected[0].reason}")
    names = camera_names(frames).astype(str)
    cameras = Counter(names.tolist())
    size = f"{frames[0].shape[1]} x {frames[0].shape[0]}" if len(cameras) == 1 else f"{len(cameras)} cameras or sizes"
    lines = [f"thermal frames, {counted(len(paths), 'file')}, {counted(len(frames), 'frame')} of {size}"]
    for name, count in cameras.most_common():
        chosen = frames.choose(names == name)
        if len(cameras) > 1:
            lines.append(f"{counted(count, 'frame')} of {name}")
        try:
            evaluation = tabulate_regions(chosen)
            rejected += evaluation.rejected
        except ThermographyError:
            evaluation = None
        about = [
            describe_camera(chosen),
            *_times(chosen),
            f"settings {_settings(chosen)}",
            *describe_evaluation(evaluation),
        ]
        lines += [f"{'' if len(cameras) == 1 else '  '}{line}" for line in about]
    if len(cameras) > 1:
        lines.append(
            "warning: frames of several cameras or sizes are no series; beside a laser those of the one with most of them are taken"
        )
    if rejected:
        reasons = listed(f"{one.path.name}: {one.reason.removeprefix(f'{one.path}').lstrip(': ')}" for one in rejected)
        lines.append(f"warning: {counted(len(rejected), 'frame')} left out: {reasons}")
    of_series = check_series(frames) if len(cameras) == 1 else []
    return lines + [f"warning: {each.message} {each.remedy}" for each in of_series]


def _times(frames: Sequence[FrameReference]) -> Iterator[str]:
    """Say when the frames were taken, how far apart, and where there are gaps."""
    times = np.array([frame.time for frame in frames], dtype="datetime64[ns]")
    if np.isnat(times).all():
        yield "no times: the frames give no course over time"
        return
    zones = sorted({frame.utc_offset_minutes or 0 for frame in frames})
    zone = join([f"{minutes / 60:+g} h" if minutes else "UTC" for minutes in zones])
    yield from _course(times, f"camera set to {zone}", "frame")


def _settings(frames: Sequence[FrameReference]) -> str:
    """Say which settings are stored, and which of them vary."""
    stored = describe_scene(frames[0].parameters)
    # Each camera has its own calibration: what differs in it is no setting.
    names = [each.name for each in fields(CameraParameters) if not each.name.startswith(("planck", "atmosphere_"))]
    varying = [name for name in names if len({getattr(frame.parameters, name) for frame in frames}) > 1]
    return f"{stored}: {'the same in all frames' if not varying else f'of the first frame; not the same in all: {join(varying)}'}"
