"""The campaign file, checked completely before anything is computed."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails

from fusion.analysis.effects.effect import Effect
from fusion.analysis.effects.library import library
from fusion.analysis.effects.thermal import QUASI_STATIC
from fusion.campaign.values import (
    FILE_KEYS,
    TIME_UNITS,
    Celsius,
    Cycles,
    Feed,
    Fraction,
    FractionU,
    KelvinU,
    Metres,
    MetresU,
    MicrometresU,
    Millimetres,
    PartsPerMillion,
    PartsPerMillionU,
    PixelPatch,
    Point,
    PositiveMicrometres,
    PositiveMillimetres,
    PositiveSeconds,
    Seconds,
    ShareOfLengthU,
    TimeUnit,
    TimeZone,
    area,
    check_pattern,
    corner_words,
    in_order,
    matching_files,
    not_a_file,
    split_uncertainty,
    stored_path,
)
from fusion.common import FusionError, campaign_file, suggest
from fusion.common.messages import near_file
from fusion.common.toml_files import TomlError, describe, first_faults, place_in, read_toml
from fusion.results.store import is_text
from thermofuse.units import UnitName

# Which tables a campaign file needs: any subset of the two instruments, with the plan where temperatures have places;
# or a record.

_REMEDY = 'write registration = "fiducials" with at least four places on the table that are known in mm'


def contradictions(campaign: Campaign) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield key and fault of tables that cannot be combined, or that lack those they build on."""
    tables = ("thermography", "plan", "interferometry", "sensors")
    camera, plan, laser, sensors = (getattr(campaign, name) for name in tables)
    if campaign.record is not None:
        if others := "], [".join(name for name in tables if getattr(campaign, name) is not None):
            fault = (
                f"[record] cannot be combined with [{others}]; remove one or the other, a record is analysed on its own"
            )
            yield ("record",), fault
    elif camera is None and laser is None:
        fault = "there is no instrument; a campaign needs [interferometry], or [thermography] with [plan], or all three"
        yield (), f"{fault}; or a [record] instead"
    else:
        if camera is not None and laser is not None and camera.window_s is not None:
            fault = "thermography.window divides the frames where no laser gives cycles; here [interferometry] does"
            yield ("thermography", "window"), f"{fault}: remove the key"
        if plan is None:
            if camera is not None or sensors is not None:
                name = "sensors" if camera is None else "thermography"
                yield (name,), f"[{name}] needs the table [plan], on which its temperatures are placed; add it"
        elif plan.in_pixels:
            yield from _against_pixels(campaign)
        else:
            # What a plan in millimetres lacks for the instruments that are there.
            moving = camera is not None and camera.table == "moving"
            needed = {
                "size": plan.size_mm is None,
                "cell_size": plan.cell_size_mm is None and camera is not None,
                "fiducials": plan.fiducials is None and camera is not None,
                "axis": plan.axis is None and (moving or (laser is not None and (camera or sensors) is not None)),
            }
            for name in (name for name, lacks in needed.items() if lacks):
                yield ("plan",), f"[plan] lacks {name}; add it"


def _against_pixels(campaign: Campaign) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what has no place on a plan that is the picture itself, because it is in millimetres."""
    camera = campaign.thermography
    if camera is None:
        fault = 'registration = "pixels" makes the picture of a camera the plan, and there is no [thermography]'
        yield ("plan", "registration"), f"{fault}; write size and axis in mm instead"
        return
    conflicts = {
        ("interferometry",): (campaign.interferometry, "[interferometry] needs the measured line on the plan, in mm"),
        ("sensors",): (campaign.sensors, "[sensors] needs the places of the sensors on the plan, in mm"),
        ("thermography", "lens"): (camera.lens, "a lens calibration is used only with a plan in mm"),
        ("thermography", "region"): (
            any(region.unit == "mm" for region in camera.region),
            "a region is in mm; write its points in px",
        ),
        ("thermography", "table"): (camera.table == "moving", 'it holds for a table at rest, and table = "moving"'),
    }
    for key, (given, why) in conflicts.items():
        if given:
            yield key, f'plan.registration = "pixels", but {why}; {_REMEDY}, or remove {".".join(key)}'


# What a campaign file says of the positioning test as a test by ISO 230-2: uncertainties, tolerances, and the
# conditions of the test.

#: Unit at the end of an attribute, which the key in the file does not have.
_UNIT = re.compile(r"_(mm|m|um|degC|K|s|ppm|ppm_per_K|mm_per_min|px)$")
#: Tables with which a key says something.
_AXIS, _RECORD, _TEST = ("interferometry",), ("record",), ("interferometry", "record")


def key(default: Any, *labels: str, example: Any = "", about: str = "", rows: int | None = None, **parts: Any) -> Any:
    """Declare a key for file, draft, form, sheet and reference; `fusion.campaign.schema.Key` describes its parts."""
    limits = {name: parts.pop(name) for name in ("ge", "gt", "min_length", "max_length") if name in parts}
    parts |= {"labels": labels} if len(labels) > 1 else {}
    parts |= {} if rows is None else {"rows": rows}
    title, examples = labels[0] if labels else None, [example] if example else None
    return Field(default, title=title, description=about or None, examples=examples, json_schema_extra=parts, **limits)


def _own_words(name: str, info: object) -> str:
    """Return what a key without a label is called."""
    words = _UNIT.sub("", name).replace("_", " ")
    return f"Standard uncertainty of the {words[:-2]}" if words.endswith(" u") else f"{words[:1].upper()}{words[1:]}"


class Table(BaseModel):
    """Base of all tables of a campaign file: an unknown key is a fault, and a key is the attribute without its unit."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        alias_generator=lambda name: _UNIT.sub("", name),
        field_title_generator=_own_words,
    )


class UncertaintyTable(Table, title="Standard uncertainties (k = 1)"):
    """``[interferometry.uncertainty]``: standard uncertainties (k = 1) of ISO 230-2:2014 Annex A; left out: assumed, and said so."""

    device_ppm: ShareOfLengthU | None = key(None, "Laser with its air compensation")
    alignment_ppm: ShareOfLengthU | None = key(None, "Alignment of the beam (cosine error)")
    material_temperature_K: KelvinU | None = key(None, "Material temperature of the compensation")
    expansion_coefficient_ppm_per_K: PartsPerMillionU | None = key(None, about="stated here or with the coefficient")
    environmental_variation_um: MicrometresU | None = key(
        None, "Environmental variation, E / √12 of a drift test", absent="drift within the five cycles"
    )


_Limit = PositiveMicrometres | None


class AcceptanceTable(Table, title="Tolerances of the axis, and the cycles that are judged (ISO 230-2)"):
    """``[acceptance]``: tolerances of the axis, of which a quantity without one is not judged, and the cycles whose values are quoted."""

    A_um: _Limit = key(None, "A: bidirectional accuracy", example="20 um", ask=True)
    R_um: _Limit = key(None, "R: bidirectional repeatability", example="10 um", ask=True)
    E_um: _Limit = key(None, "E: bidirectional systematic deviation", example="15 um", ask=True)
    M_um: _Limit = key(None, "M: range of the mean bidirectional deviation", example="10 um", ask=True)
    B_um: _Limit = key(None, "B: reversal", example="5 um", ask=True)
    A_unidirectional_um: _Limit = key(None, "A↑, A↓: unidirectional accuracy", example="15 um", ask=True)
    R_unidirectional_um: _Limit = key(None, "R↑, R↓: unidirectional repeatability", example="8 um", ask=True)
    E_unidirectional_um: _Limit = key(None, "E↑, E↓: unidirectional systematic deviation", example="12 um", ask=True)
    cycles: Cycles | None = key(
        None,
        "Cycles whose values are quoted and judged",
        example="10-14",
        about="to be chosen before the values are known",
        absent="the last five whole cycles",
        show=True,
    )

    def limits(self) -> dict[str, float]:
        """Return the tolerances that are stated, um, by the symbol of their quantity."""
        stated = {name.removesuffix("_um"): value for name, value in self if name.endswith("_um")}
        return {symbol: float(value) for symbol, value in stated.items() if value is not None}


class InstrumentTable(Table, title="Instruments"):
    """``[[report.instrument]]``: an instrument of the test."""

    name: str = key(..., "Instrument", example="laser interferometer", ask=True, min_length=1)
    serial_number: str = key("", "Its serial number", ask=True)
    calibrated: date | None = key(None, "Day of its calibration", example="2026-01-15", ask=True)
    certificate: str = key("", "Certificate of its calibration", ask=True)


class ReportTable(Table, title="Machine, people and conditions, as the sheet to sign names them"):
    """``[report]``: conditions of the test as ISO 230-2 asks for them, as the sheet names and orders them, "not stated" where left out."""

    report_number: str = key("", about="that the sheet bears", ask=True)
    customer: str = key("", about="for whom the test was made", ask=True)
    machine: str = key("", example="name of the machine", about="by which tests are put together", ask=True)
    machine_serial_number: str = key("", "Serial number of the machine", ask=True)
    control: str = key("", about="make and version of the machine's control", ask=True)
    location: str = key("", about="where the machine stands", ask=True)
    operator: str = key("", about="who made the test", ask=True)
    approved_by: str = key("", about="who signs", ask=True)
    sign_convention: str = key(
        "", example="actual minus target position", about="what a positive deviation means", ask=True, of=_TEST
    )
    axis_travel_mm: PositiveMillimetres | None = key(None, "Travel of the axis", example="900 mm", ask=True, of=_AXIS)
    screw_lead_mm: PositiveMillimetres | None = key(
        None, "Lead of the screw", example="10 mm", about="targets at whole leads are named", ask=True, of=_AXIS
    )
    feed_mm_per_min: Feed | None = key(None, "Feed between the targets", example="5000 mm/min", ask=True, of=_AXIS)
    dwell_s: PositiveSeconds | None = key(None, "Dwell at a target", example="3 s", ask=True, of=_AXIS)
    warm_up: str = key("", "Warm-up", about="what the machine did before the test", ask=True, of=_TEST)
    machine_compensation: str = key(
        "", "Compensation of the machine", about='"none", or the file of the table that was active', ask=True, of=_TEST
    )
    air_temperature_before_degC: Celsius | None = key(
        None, "Air temperature before the test", absent="as logged", show=True, of=_AXIS
    )
    air_temperature_after_degC: Celsius | None = key(
        None, "Air temperature after the test", absent="as logged", show=True, of=_AXIS
    )
    material_temperature_before_degC: Celsius | None = key(
        None, "Material temperature before the test", absent="as logged", show=True, of=_AXIS
    )
    material_temperature_after_degC: Celsius | None = key(
        None, "Material temperature after the test", absent="as logged", show=True, of=_AXIS
    )
    sensor_places: str = key("", "Places of the sensors", ask=True, of=_TEST)
    remarks: str = key("", about="whatever else the sheet has to say", show=True)
    instrument: tuple[InstrumentTable, ...] = key((), "Instrument", rows=1)


#: What a record may be declared with: every displacement a linear function of the temperatures.
RECORD_EFFECTS = (QUASI_STATIC,)
#: Effects that need positions along an axis; a record that declares them is run without, and the results say so.
_ALONG_AN_AXIS = ("axis_expansion", "table_offset")
#: What a plan of pixels does not have.
_IN_MILLIMETRES = ("size_mm", "cell_size_mm", "fiducials", "fiducials_u_mm", "regions", "axis")
#: What files of temperatures are corrected for already.
_CORRECTED_BY_THE_CAMERA = (
    "atmospheric_temperature_degC", "relative_humidity", "object_distance_m", "window_transmission", "window_temperature_degC",
)  # fmt: skip


class CampaignError(FusionError):
    """A campaign that cannot be run; the message names file, line, key, value and remedy."""


@dataclass(frozen=True)
class _Surroundings:
    """What the values of a campaign file are checked against: its folder, the effects, whether it holds a record, and temperatures."""

    folder: Path
    effects: Mapping[str, Effect]
    record: bool
    temperatures: bool


def _existing(name: str, info: ValidationInfo) -> str:
    """Accept the name of a file that exists."""
    if isinstance(info.context, _Surroundings):
        path = stored_path(info.context.folder, name)
        if text := not_a_file(path):
            raise ValueError(text)
        if not os.path.isfile(path):  # noqa: PTH113 - no file has a name that is too long, or with a NUL
            raise ValueError(f"no such file {path}; {near_file(path)}paths are relative to the campaign file")
    return name


def _matching(pattern: str, info: ValidationInfo) -> str:
    """Accept a pattern that matches at least one file."""
    if isinstance(info.context, _Surroundings):
        folder = info.context.folder
        check_pattern(folder, pattern)
        found = matching_files(folder, pattern)
        if not found:
            raise ValueError(f"matches no file in {folder}; paths are relative to the campaign file")
        for path in found:
            if path.is_symlink() and not path.exists():
                raise ValueError(f"{path} is a link to a file that does not exist; restore the file or remove the link")
            if not is_text(str(path).removeprefix(str(folder))):
                raise ValueError(f"{str(path)!a} has a name that is not valid UTF-8; rename it")
    return pattern


def _filled(patterns: tuple[str, ...]) -> tuple[str, ...]:
    """Accept a list that is not empty; `min_length` would count a pattern without a match as absent."""
    if not patterns:
        raise ValueError("this list is empty; fill it in")
    return patterns


def _declarable(name: str, info: ValidationInfo) -> str:
    """Accept an effect that can be declared for this kind of campaign: one whose columns are known before the readings."""
    if not isinstance(info.context, _Surroundings):
        return name
    effects, record, warmth = info.context.effects, info.context.record, info.context.temperatures
    known = [one.name for one in effects.values() if one.declarable and (warmth or not one.follows_field)]
    allowed = RECORD_EFFECTS if record else tuple(known)
    if name in (*allowed, *(_ALONG_AN_AXIS if record else ())):
        return name
    choice = f"can be declared here: {', '.join(allowed)}"
    if not record and name in effects and effects[name].declarable:
        text = (
            "this effect follows the temperature of the table, which this campaign does not measure; add [thermography] with [plan], or "
            f"[sensors], or remove the effect; {choice}"
        )
    elif name in effects and not effects[name].declarable:
        lacking = "the parameters of this effect are not known beforehand"
        if effects[name].errs_camera:
            lacking = "the columns of this effect need a fitted model"
        text = f"{lacking}; remove it, the closed loop tries it anyway; {choice}"
    elif name in (*effects, *RECORD_EFFECTS):
        text = f"this effect does not apply to a {'record' if record else 'campaign with positions'}; {choice}"
    else:
        text = f"unknown effect; {suggest(name, (*effects, *RECORD_EFFECTS))}{choice}"
    raise ValueError(text)


def _each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    """Accept a list that names everything once."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{', '.join(repeated)} named more than once; name each effect once")
    return names


ExistingFile = Annotated[str, AfterValidator(_existing)]
_Patterns = tuple[Annotated[str, AfterValidator(_matching)], ...]
FramePatterns = Annotated[_Patterns, AfterValidator(_filled), Field(json_schema_extra={"minItems": 1})]
#: Names or patterns of the runs of a record, a single one without brackets too.
RunPatterns = Annotated[_Patterns, BeforeValidator(lambda value: (value,) if isinstance(value, str) else value)]
DeclaredEffects = Annotated[tuple[Annotated[str, AfterValidator(_declarable)], ...], AfterValidator(_each_once)]


def _key(table: Table, name: str) -> str:
    """Return the key of an attribute as the file writes it."""
    return type(table).model_fields[name].alias or name


_ZONE = "Time zone of times without one"


class CampaignTable(Table, title="Test"):
    """``[campaign]``: what was measured."""

    title: str = key(..., "Title of the report", needed=True, min_length=1)
    axis: str = key("", "Axis that was measured", example="X", ask=True, of=_TEST, max_length=20)
    time_zone: TimeZone | None = key(
        None, _ZONE, example="Europe/Vienna", absent='shown as logged, "(no zone)", and taken as UTC', ask=True
    )


class _Measured(Table):
    """A table in which a value may be written with its standard uncertainty, ``"0.97 +- 0.01"``: the key with ``_u`` takes it."""

    @model_validator(mode="before")
    @classmethod
    def _split(cls, content: object) -> object:
        """Give the uncertainty of ``"value +- uncertainty"`` a key of its own."""
        if not isinstance(content, dict):
            return content
        parted, known = dict(content), {field.alias for field in cls.model_fields.values()}
        for name in (str(field.alias).removesuffix("_u") for field in cls.model_fields.values()):
            if f"{name}_u" in known and isinstance(content.get(name), str):
                parted[name], u = split_uncertainty(content[name])
                if u is not None:
                    parted.setdefault(f"{name}_u", u)
        return parted


class StateTable(_Measured):
    """One of ``states`` of a region: a cycle in which a contact sensor measured the region's temperature."""

    cycle: int = key(..., "Number of the cycle", ge=1)
    temperature_degC: Celsius = key(..., "Temperature that the contact sensor measured in it")
    temperature_u_K: KelvinU = 0.1


_SHAPES = ("spot", "line", "rectangle", "ellipse", "polygon")


class RegionTable(_Measured):
    """``[[thermography.region]]``: a place in the picture, or a part of the table, maybe with an emissivity of its own.

    The emissivity is given or comes from two states.
    """

    name: str = key(..., "Name of the region", min_length=1)
    spot: Point | None = key(None, about="a point: column and row in px, or x and y in mm, as of every shape")
    line: tuple[Point, Point] | None = key(None, about="its two ends")
    rectangle: tuple[Point, Point] | None = key(None, about="two opposite corners")
    ellipse: tuple[Point, Point] | None = key(None, about="two opposite corners of the rectangle around it")
    polygon: tuple[Point, ...] | None = key(None, about="its corners in order")
    emissivity: Fraction | None = key(None, "Emissivity of the region, 0 to 1", absent="that of the frames")
    emissivity_u: FractionU | None = None
    states: tuple[StateTable, StateTable] | None = key(
        None, about="two cycles in which a contact sensor measured the region, from which its emissivity follows"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> RegionTable:
        given = [shape for shape in _SHAPES if getattr(self, shape) is not None]
        if len(given) != 1:
            raise ValueError(
                f"region {self.name} needs one of spot (a point), line (its ends), rectangle or ellipse (two opposite corners of the "
                "rectangle around it), polygon (its corners in order)"
            )
        if self.shape == "polygon" and len(self._points) < 3:
            raise ValueError(f"the polygon of region {self.name} has {len(self._points)} corners; it needs at least 3")
        if len({length.unit for point in self._points for length in point}) > 1:
            raise ValueError(f"region {self.name} mixes px of the picture and mm of the plan; write all in one unit")
        if self.shape not in ("spot", "line") and area(self.corners) == 0.0:
            raise ValueError(
                f"region {self.name} with the corners {corner_words(self.corners)} {self.unit} has no area; give corners that enclose one"
            )
        if self.emissivity is not None and self.states is not None:
            raise ValueError(
                f"region {self.name} states its emissivity and the two states that would show it; keep one"
            )
        if self.states is not None and not self.is_surface:
            raise ValueError(
                f"the emissivity of region {self.name} comes from two states only on a plan in mm, for a rectangle or polygon"
            )
        if self.states is not None and self.states[0].cycle == self.states[1].cycle:
            raise ValueError(
                f"both states of region {self.name} are cycle {self.states[0].cycle}; name two cycles in which its temperature differs, as "
                "one state cannot tell emissivity and reflection apart"
            )
        return self

    @property
    def shape(self) -> str:
        """Which of the shapes it is."""
        return next(shape for shape in _SHAPES if getattr(self, shape) is not None)

    @property
    def unit(self) -> str:
        """Unit of its points: px of the picture, or mm on the plan."""
        return self._points[0][0].unit

    @property
    def points(self) -> tuple[tuple[float, float], ...]:
        """The points that give it, (column, row) px or (x, y) mm."""
        return tuple((across.value, down.value) for across, down in self._points)

    @property
    def _points(self) -> tuple[Point, ...]:
        return (self.spot,) if self.spot is not None else getattr(self, self.shape)

    @property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """Corners of a rectangle, an ellipse's rectangle or a polygon in order."""
        if self.polygon is not None:
            return self.points
        (x0, y0), (x1, y1) = self.points
        return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))

    @property
    def is_surface(self) -> bool:
        """Whether it is a part of the table that the fields are calibrated on with an emissivity of its own."""
        stated = self.emissivity is not None or self.states is not None
        return stated and self.unit == "mm" and self.shape in ("rectangle", "polygon")


class StackTable(Table, title="Files of temperatures"):
    """``[thermography.stack]``: what files of temperatures of other cameras do not hold themselves."""

    unit: Literal["degC", "K"] | None = key(None, "Unit of the temperatures")
    scale: float = key(1.0, "Temperature of one count", example="0.04", gt=0.0)
    offset: float = key(0.0, "Temperature of count 0")
    variable: str | None = key(None, "Variable of the file")
    axes: Literal["frame, row, column", "row, column, frame"] | None = key(
        None, "Order of the axes of a NumPy array", about="where its shape does not tell it"
    )
    time_in_name: str | None = key(None, "Pattern of the time in the name", example="%Y%m%d_%H%M%S")
    times: ExistingFile | None = key(
        None, "File of the times of the frames", example="times.csv", about="its columns are file, frame, time"
    )
    start: str | None = key(None, "Time of the first frame")
    interval_s: PositiveSeconds | None = key(None, "Time from one frame to the next")
    time_zone: TimeZone = key("UTC", _ZONE, example="Europe/Vienna", show=True)
    emissivity: Fraction | None = key(None, "Emissivity set in the camera's program, 0 to 1", example="0.95", show=True)
    reflected_temperature_degC: Celsius | None = key(
        None, "Reflected temperature set in the camera's program", show=True
    )

    @model_validator(mode="after")
    def _says_times_once(self) -> StackTable:
        given = [name for name in ("time_in_name", "times", "start") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} each say when the frames were taken; keep one")
        return self


_STORED = "as stored in the frames"
_ESTIMATED = "estimated where the table moves in view, else 0 s"
_TABLE = {"still": "at rest in every frame", "moving": "moves with the axis"}


class ThermographyTable(_Measured, title="Camera"):
    """``[thermography]``: the frames, the camera parameters that override the stored ones, and standard uncertainties."""

    frames: FramePatterns = key(
        ..., "Files of frames", about="radiometric JPEG, .seq, .csq, .fff; other cameras: the page on file formats"
    )
    emissivity: Fraction | None = key(
        None, "Emissivity of the surface, 0 to 1", example="0.95 +- 0.02", absent=_STORED, ask=True
    )
    emissivity_u: FractionU | None = key(None, absent="assumed, and named so")
    reflected_temperature_degC: Celsius | None = key(
        None, about="apparent temperature of what the surface reflects", absent=_STORED, show=True
    )
    reflected_temperature_u_K: KelvinU | None = None
    atmospheric_temperature_degC: Celsius | None = key(
        None, "Temperature of the air before the camera", absent=_STORED, show=True
    )
    atmospheric_temperature_u_K: KelvinU | None = None
    relative_humidity: Fraction | None = key(
        None, "Relative humidity, 0 to 1", example="0.45", absent=_STORED, show=True
    )
    relative_humidity_u: FractionU | None = None
    object_distance_m: Metres | None = key(None, "Distance from camera to surface", absent=_STORED, show=True)
    object_distance_u_m: MetresU | None = None
    window_transmission: Fraction | None = key(
        None, "Transmission of a window before the lens, 0 to 1", example="0.95 +- 0.01"
    )
    window_transmission_u: FractionU | None = None
    window_temperature_degC: Celsius | None = key(None, "Temperature of that window")
    window_temperature_u_K: KelvinU | None = None
    camera_offset_u_K: KelvinU | None = key(
        None,
        "Standard uncertainty of the camera, as an offset",
        about="cancels in a rise",
        absent="that of an uncooled camera",
    )
    camera_scale_u: FractionU | None = key(
        None, "Standard uncertainty of the camera, share of the reading", example="1.2 %", about="does not cancel"
    )
    camera_drift_u_K: KelvinU | None = key(
        None,
        "Standard uncertainty of the change of the camera's zero between cycles",
        about="at least what the frames leave",
    )
    reflected_change_u_K: KelvinU | None = key(
        None,
        "Standard uncertainty of the change of the reflected temperature between cycles",
        absent="what discs or the logged air show; else assumed, and named so",
    )
    region: tuple[RegionTable, ...] = ()
    clock_offset_s: Seconds | None = key(
        None, "Camera clock minus laser clock", example="0 s", absent=_ESTIMATED, show=True, of=_AXIS
    )
    window_s: PositiveSeconds | None = key(None, "Time over which frames are averaged", about="of a camera alone")
    table: Literal["still", "moving"] = key("still", "The table in the frames", show=True, of=_AXIS, choices=_TABLE)
    reference_patch_px: PixelPatch | None = key(
        None,
        *(f"Patch of constant temperature, {one} (px)" for one in ("first column", "first row", "columns", "rows")),
    )
    lens: ExistingFile | None = key(
        None, "Calibration of the lens (OpenCV)", example="lens.yaml", about="camera_matrix, distortion_coefficients"
    )
    stack: StackTable | None = None

    @property
    def surfaces(self) -> tuple[RegionTable, ...]:
        """Regions of the table with an emissivity of their own."""
        return tuple(region for region in self.region if region.is_surface)

    @model_validator(mode="after")
    def _recalculates_what_is_known(self) -> ThermographyTable:
        if self.stack is None:
            return self
        corrected = [_key(self, name) for name in _CORRECTED_BY_THE_CAMERA if getattr(self, name) is not None]
        if corrected:
            raise ValueError(
                f"{corrected[0]} is already corrected for in temperatures; set it in the camera's software"
            )
        if self.emissivity is not None and self.stack.emissivity is None:
            raise ValueError(
                "another emissivity can only be calculated from the one that the camera's software used: write that as emissivity under "
                "[thermography.stack]"
            )
        return self


class AxisTable(Table, title="Axis on the plan"):
    """``[plan.axis]``: where the measured line lies on the plan."""

    origin_mm: tuple[Millimetres, Millimetres] = key(
        ..., *(f"Spindle at axis position 0, {one}" for one in "xy"), example=("500 mm", "90 mm"), needed=True
    )
    direction: tuple[float, float] = key(
        ...,
        "How that point moves as the position grows",
        example="left",
        about="[-1, 0] left, [0, 1] down",
        needed=True,
    )

    @model_validator(mode="after")
    def _has_length(self) -> AxisTable:
        if self.direction == (0.0, 0.0):
            raise ValueError("the direction [0, 0] has no length; write for example [-1, 0]")
        return self


_REGISTRATION = {"fiducials": "by fiducials, in mm", "pixels": "the picture is the plan, in px"}


class PlanTable(Table, title="Plan of the table"):
    """``[plan]``: the table plan in millimetres and its fiducials; or, by ``registration = "pixels"``, the picture itself."""

    registration: Literal["fiducials", "pixels"] = key(
        "fiducials", "How the frames are placed on the plan", choices=_REGISTRATION
    )
    size_mm: tuple[PositiveMillimetres, PositiveMillimetres] | None = key(
        None, "Width of the plan, x", "Height of the plan, y", example=("700 mm", "180 mm"), needed=True
    )
    cell_size_mm: PositiveMillimetres | None = key(
        None, "Size of a cell of the field", about="it divides both sides", ask=True
    )
    fiducials: ExistingFile | None = key(
        None, "Table of the fiducials", about="name,x_mm,y_mm,diameter_mm[,column_px,row_px,marker]"
    )
    fiducials_u_mm: PositiveMillimetres | None = key(
        None,
        "Uncertainty of their places (k = 1)",
        about="not given: the table is exact but for the scatter that the frames show",
    )
    regions: ExistingFile | None = key(
        None, "Table of the parts that are tested as sources", about="name,x_mm,y_mm of their corners"
    )
    axis: AxisTable | None = None

    @property
    def in_pixels(self) -> bool:
        """Whether the picture itself is the plan, whose lengths are then in px."""
        return self.registration == "pixels"

    @model_validator(mode="after")
    def _has_one_unit(self) -> PlanTable:
        given = [_key(self, name) for name in _IN_MILLIMETRES if getattr(self, name) is not None]
        if self.in_pixels and given:
            raise ValueError(
                f'{", ".join(given)} in millimetres cannot be combined with registration = "pixels", where the picture is the plan; remove '
                "one of them"
            )
        return self

    @model_validator(mode="after")
    def _cells_fit(self) -> PlanTable:
        if self.cell_size_mm is None or self.size_mm is None:
            return self
        along = [length / self.cell_size_mm for length in self.size_mm]
        cells, sides = along[0] * along[1], f"a plan of {self.size_mm[0]:g} x {self.size_mm[1]:g} mm"
        if any(abs(count - round(count)) > 1e-6 for count in along):
            fault = f"does not divide {sides}; choose one that divides both sides"
            raise ValueError(f"cell_size {self.cell_size_mm:g} mm {fault}")
        if min(self.size_mm) < 2 * self.cell_size_mm or cells > 4e6:
            fault = f"makes {cells:.0f} cells; choose it for at least 2 cells per side and at most 4 million in all"
            raise ValueError(f"cell_size {self.cell_size_mm:g} mm on {sides} {fault}")
        return self


_LATE = "by how much the clock is late"


class SensorsTable(Table, title="Contact sensors"):
    """``[sensors]``: temperatures of contact sensors over time, and the places of the sensors on the plan."""

    file: ExistingFile = key(
        ..., "Log of the contact sensors", about='a time, then a column "name [degC]" for each sensor'
    )
    places: ExistingFile = key(
        ..., "Table of their places on the plan", about="name,x_mm,y_mm; two over half of the travel replace the camera"
    )
    time_zone: TimeZone | None = key(None, _ZONE)
    clock_offset_s: Seconds = key(0.0, f"Contact sensors: {_LATE}")
    temperature_u_K: KelvinU = key(0.2, "Standard uncertainty of a contact sensor")


class InterferometryTable(_Measured, title="Laser"):
    """``[interferometry]``: the readings, and the parameters of the laser's compensation."""

    deviations: ExistingFile = key(
        ..., "Table of the deviations", about="cycle,direction,target,position_mm,time,deviation_um"
    )
    sheet: str | None = key(None, "Sheet of the workbook")
    directions: Literal["positive first", "negative first", "positive", "negative"] | None = key(
        None,
        "Directions of successive runs",
        about="of a table that names none and whose order of positions does not tell it",
        choices={
            "positive first": "runs alternate, the first towards larger positions",
            "negative first": "runs alternate, the first towards smaller positions",
            "positive": "every run towards larger positions",
            "negative": "every run towards smaller positions",
        },
    )
    position_unit: UnitName | None = key(None, "Unit of the positions", about="of a table that states none")
    deviation_unit: UnitName | None = key(None, "Unit of the deviations", about="of a table that states none")
    environment: ExistingFile | None = key(
        None, "Log of air and material", example="environment.csv", about="and of what else the drift may follow"
    )
    time_zone: TimeZone | None = key(None, _ZONE)
    clock_offset_s: Seconds = key(0.0, f"Readings: {_LATE}")
    environment_clock_offset_s: Seconds = key(0.0, f"Log of air and material: {_LATE}")
    dead_path_mm: Millimetres = key(0.0, "Dead path of the laser", example="0 mm", ask=True)
    expansion_coefficient_ppm_per_K: PartsPerMillion = key(
        11.7, example="11.7 +- 0.3 ppm/K", about="of scale or workpiece", absent="11.7 ppm/K, within 2 ppm/K", ask=True
    )
    expansion_coefficient_u_ppm_per_K: PartsPerMillionU | None = None
    feed_mm_per_min: Feed | None = key(
        None, "Feed between the targets", about="with dwell, it places the readings of a .rtl more closely in time"
    )
    dwell_s: PositiveSeconds | None = key(None, "Dwell at a target")
    compensation: Literal["as recorded", "redo"] = key(
        "as recorded", "Compensation of the readings", choices={"redo": "again, with the logged conditions"}
    )
    material_temperature: Literal["logged", "camera"] = key(
        "logged", "Material temperature of the compensation", choices={"camera": "as the camera sees it"}
    )
    material_sensor_mm: tuple[Millimetres, Millimetres] | None = key(
        None,
        *(f"Material sensor, {one}" for one in "xy"),
        example=("350 mm", "90 mm"),
        about="its place on the plan, where the camera's rise is compared with it",
    )
    environment_factor_mm: tuple[Millimetres, Millimetres] | None = key(
        None, *(f"Environment factor at the {one}" for one in ("start", "end")), example=("0.316382 um", "0.316385 um")
    )
    uncertainty: UncertaintyTable = UncertaintyTable()

    @property
    def recompensates(self) -> bool:
        """Whether the environment log enters the readings: compensated again, or corrected for a dead path."""
        return self.compensation == "redo" or self.dead_path_mm != 0.0

    @model_validator(mode="after")
    def _redo_is_requested(self) -> InterferometryTable:
        """Refuse keys that say how a compensation is done again where none is."""
        given = ['material_temperature = "camera"'] if self.material_temperature == "camera" else []
        given += ["environment_factor"] if self.environment_factor_mm is not None else []
        named = " and ".join(given)
        if given and self.compensation != "redo":
            raise ValueError(f'{named} without compensation = "redo", to which it belongs; add that, or leave it out')
        return self

    @model_validator(mode="after")
    def _coefficient_u_once(self) -> InterferometryTable:
        """Refuse two standard uncertainties of one coefficient."""
        one, other = self.expansion_coefficient_u_ppm_per_K, self.uncertainty.expansion_coefficient_ppm_per_K
        if one is not None and other is not None and one != other:
            raise ValueError(
                f"the standard uncertainty of the expansion coefficient is {one:g} ppm/K with the coefficient and {other:g} ppm/K under "
                "[interferometry.uncertainty]; state it once"
            )
        return self


class ColumnTable(Table):
    """A line of ``[record.columns]``: what a column holds, and its unit; ``"degC"`` alone states the unit, from which the role follows.

    ``range`` is what its sensor can read, as ``["-20 degC", "300 degC"]``; numbers outside are no readings.
    """

    role: Literal["temperature", "displacement", "driver"] | None = key(
        None, "What the column holds", absent="as its unit says"
    )
    unit: str = key("", "Unit of the column, or of one count")
    range: tuple[Celsius, Celsius] | None = key(
        None, "What its sensor can read", about="numbers outside are no readings"
    )


#: A unit alone, or a table with role and unit.
StatedColumn = Annotated[
    ColumnTable,
    BeforeValidator(
        lambda value: {"unit": value} if isinstance(value, str) else value, json_schema_input_type=str | ColumnTable
    ),
]


class HeaderRows(Table, title="Lines of the table"):
    """``header_rows`` of a record: lines of the file, from 1, that hold the names, the units and the first values."""

    names: int | None = key(None, "Line of the names", ge=1)
    units: int | None = key(None, "Line of the units", ge=1)
    values: int = key(..., "First line of values", ge=1)

    @model_validator(mode="after")
    def _values_come_last(self) -> HeaderRows:
        if self.values <= max(self.names or 0, self.units or 0):
            raise ValueError(f"the values begin at line {self.values}, above the names or the units; correct the lines")
        return self


#: One heading, two of a date and a time of day, or those of its parts, as Day, Hour and Minute.
Headings = Annotated[
    tuple[str, ...],
    Field(min_length=1, max_length=7),
    BeforeValidator(
        lambda value: (value,) if isinstance(value, str) else value, json_schema_input_type=str | tuple[str, ...]
    ),
]


_TIMES = "Column of the times"


class LongTable(Table, title="Record with a line for every change"):
    """``long`` of a record: headings of a table with a line for every change, its time, its channel and its value."""

    time: Headings = key(..., _TIMES)
    channel: str = key(..., "Column of the channels")
    value: str = key(..., "Column of the values")


class LoggedTable(Table):
    """How a logged table is laid out, and role and unit of its columns, where the table does not say it itself."""

    sheet: str | None = key(None, "Sheet of the workbook")
    time: Headings | None = key(None, _TIMES, about='or two columns, ["Date", "Time"]')
    every_s: PositiveSeconds | None = key(
        None, "Time from one row to the next", example="60 s", about="where the table has no times"
    )
    time_format: str | None = key(
        None,
        "How the times are written (strptime)",
        example="%Y/%m/%d-%H:%M:%S",
        about="where they are not read without",
    )
    date_order: Literal["day first", "month first", "year first"] | None = key(
        None, "What stands first in dates of numbers", about="where no date of the table tells it"
    )
    time_unit: TimeUnit | None = key(
        None, "Unit of times that are numbers", example="min", about=", ".join(TIME_UNITS), absent="that in the heading"
    )
    guessed: tuple[str, ...] = key(
        (), "Keys and columns whose unit was taken from the values", about="and is not stated; remove what was checked"
    )
    start: str | None = key(None, "Time from which they count")
    time_zone: TimeZone | None = key(None, _ZONE)
    header_rows: HeaderRows | None = None
    missing: tuple[float | str, ...] = key((), "Marks for no reading")
    columns: dict[str, StatedColumn] = key({}, about="role and unit of every column, by its heading")


class DriversTable(LoggedTable, title="Logged quantities"):
    """``[drivers]``: other logged quantities, and the law by which some of them were switched at random."""

    file: ExistingFile = key(
        ..., "Table of the logged quantities", about='a time, then columns "name [unit]"; or laid out as in a record'
    )
    clock_offset_s: Seconds = key(0.0, f"Logged quantities: {_LATE}")
    randomised: tuple[str, ...] = key((), "Loads that were switched at random", about="as thermofuse plan proposes")
    mean_dwell_s: PositiveSeconds | None = key(None, "Mean time between their switchings")
    least_dwell_s: Seconds = key(0.0, "Shortest time between their switchings")

    @property
    def layout(self) -> LoggedTable | None:
        """How its table is laid out, None where nothing is stated and its headings say everything."""
        return self if self.model_fields_set & LoggedTable.model_fields.keys() - {"time_zone"} else None

    @model_validator(mode="after")
    def _law_is_whole(self) -> DriversTable:
        if bool(self.randomised) != (self.mean_dwell_s is not None):
            raise ValueError(
                "randomised and mean_dwell belong together: which columns were switched at random, and the mean time between"
            )
        if self.mean_dwell_s is not None and not 0.0 <= self.least_dwell_s < self.mean_dwell_s:
            raise ValueError(
                f"least_dwell {self.least_dwell_s:g} s must be shorter than mean_dwell {self.mean_dwell_s:g} s, and not negative"
            )
        return self


class RecordTable(LoggedTable, title="Record"):
    """``[record]``: temperature sensors and displacement channels over time, in one table per run (text or XLSX).

    Columns are named as in the file's heading; ``*`` matches any text. Roles are stated either by ``temperatures``, ``displacements`` and
    ``drivers`` or by ``columns``. ``test`` names the runs that are held out; left out: the last one.
    """

    file: ExistingFile | None = key(None, "Table of the record")
    files: RunPatterns = key((), "Tables of the runs of one test", about="in place of file; each run has its own zero")
    test: RunPatterns = key((), "Runs that are held out", absent="the last one, run_10 after run_9")
    long: LongTable | None = None
    temperatures: tuple[str, ...] = key((), "Columns of temperatures", about="as in the heading; * matches any text")
    displacements: tuple[str, ...] = key((), "Columns of displacements")
    drivers: tuple[str, ...] = key((), "Columns of what makes heat")

    @model_validator(mode="after")
    def _times_are_stated_once(self) -> RecordTable:
        if sum(way is not None for way in (self.time, self.every_s, self.long)) != 1:
            raise ValueError(
                'write one of time = "heading of the times", every = "60 s" (a table without times, from one row to the next), or '
                'long = {time = "...", channel = "...", value = "..."} (a line for every change)'
            )
        return self

    @model_validator(mode="after")
    def _roles_are_stated_once(self) -> RecordTable:
        if self.temperatures and self.displacements:
            named = next((name for name, column in self.columns.items() if column.role is not None), None)
            if named is not None:
                raise ValueError(
                    f'columns gives "{named}" a role, and temperatures and displacements give roles too; state them in one of both places'
                )
        elif self.temperatures or self.displacements or self.drivers or not self.columns:
            raise ValueError(
                'a record needs temperatures = [...] and displacements = [...], or the roles in [record.columns], for example "T1" = "degC"'
            )
        return self

    @model_validator(mode="after")
    def _runs_are_whole(self, info: ValidationInfo) -> RecordTable:
        if (self.file is None) == (not self.files):
            raise ValueError(
                'write either file = "run.csv", or files = ["run_*.csv"] (names or patterns) for several runs of one test'
            )
        if self.test and not self.files:
            raise ValueError(
                "test names runs among files; write files = [...] instead of file, or leave test out: the last fifth is held out"
            )
        if isinstance(info.context, _Surroundings) and self.test:
            runs, test = (_each_match(info.context.folder, patterns) for patterns in (self.files, self.test))
            strange = [path.name for path in test if path not in runs]
            if strange:
                raise ValueError(
                    f"test names {', '.join(strange)}, which files does not; the runs are {', '.join(path.name for path in runs)}"
                )
            if len(test) == len(runs):
                raise ValueError(f"test names all {len(runs)} runs, which leaves none for training; name fewer")
        return self


class TiltTable(Table, title="Tilts from two displacements of one direction"):
    """Two displacements of one direction whose difference is a tilt, and the distance of their sensors along the tool or the axis."""

    channels: tuple[str, str] = key(..., "First displacement", "Second displacement")
    distance_mm: Annotated[PositiveMillimetres, Field(gt=0.0)] = key(..., "Distance of their sensors", example="150 mm")


_TESTED = {
    "environment": "environment (temperature variation)",
    "spindle": "spindle running",
    "linear axis": "linear axis moving",
    "rotary axis": "rotary axis moving",
}


class ThermalTestTable(Table, title="Test of thermal effects (ISO 230-3)"):
    """``[thermal_test]``: what a test by ISO 230-3 needs to be told."""

    kind: Literal["environment", "spindle", "linear axis", "rotary axis"] | None = key(
        None, "What was tested", example="spindle", ask=True, of=_TEST, choices=_TESTED
    )
    tilts: dict[str, TiltTable] = key({}, "Tilt", rows=0, of=_RECORD)
    sensor_calibration: FractionU | None = key(
        None,
        "Standard uncertainty of the sensitivity of the displacement sensors",
        example="0.5 %",
        absent="1 %",
        show=True,
        of=_RECORD,
    )
    mounting_length_mm: PositiveMillimetres | None = key(
        None, "Length of the mounting of the sensors", example="100 mm", absent="not budgeted", show=True, of=_RECORD
    )
    mounting_expansion_ppm_per_K: PartsPerMillion = key(11.7, "Its expansion coefficient", show=True, of=_RECORD)


class ModelTable(Table, title="Model of the drift"):
    """``[model]``: the effects that are known to act."""

    declared: DeclaredEffects = key(("axis_expansion", "table_offset"), "Effects that are known to act", of=_AXIS)


class AcceptTable(Table, title="Doubts that are settled"):
    """``[accept]``: what the user knows of the inputs, so that it is no doubt any more."""

    doubts: Annotated[tuple[str, ...], AfterValidator(_each_once)] = key(
        (), "Codes of the doubts that you know of", about="every code is in results.json"
    )


#: Endings of the files that make a sheet a laboratory's own.
_OF_SHEET = {"logo": (".png", ".jpg", ".jpeg"), "word_template": (".docx",), "page_template": (".html", ".htm")}


class SheetTable(Table, title="The sheet to sign: head, templates and language"):
    """``[sheet]``: what makes the sheet that of a laboratory; its language is that of the report's first screen, too."""

    head: str = key("", "Head of the sheet", example="Example Laboratory; Street 1; Town", about="a line for each ;")
    logo: ExistingFile | None = key(None, "Logo", example="logo.png", about="PNG or JPEG, beside the head")
    word_template: ExistingFile | None = key(
        None, "Template of the sheet in Word", example="letterhead.docx", about="its header, footer and styles are kept"
    )
    page_template: ExistingFile | None = key(
        None,
        "Template of the sheet as page and PDF",
        example="letterhead.html",
        about="HTML in which {{ sheet }} stands",
    )
    language: Literal["en", "de"] = key("en", "Language", choices={"en": "English", "de": "German"})

    @model_validator(mode="after")
    def _files_are_of_their_kind(self) -> SheetTable:
        for name, endings in _OF_SHEET.items():
            written = getattr(self, name)
            if written and Path(written).suffix.lower() not in endings:
                raise ValueError(f"{name} = {written}: its name has to end in {' or '.join(endings)}")
        return self


class Campaign(Table):
    """A checked campaign file. Paths are absolute; every number is in the unit that its name states."""

    path: Path = Field(exclude=True)
    campaign: CampaignTable
    thermography: ThermographyTable | None = None
    plan: PlanTable | None = None
    interferometry: InterferometryTable | None = None
    sensors: SensorsTable | None = None
    drivers: DriversTable | None = None
    record: RecordTable | None = None
    model: ModelTable = ModelTable()
    accept: AcceptTable = AcceptTable()
    acceptance: AcceptanceTable = key(AcceptanceTable(), of=_AXIS)
    report: ReportTable = ReportTable()
    sheet: SheetTable = SheetTable()
    thermal_test: ThermalTestTable = ThermalTestTable()

    @model_validator(mode="before")
    @classmethod
    def _picture_is_the_plan(cls, content: Any) -> Any:
        """Where a camera measures alone and no plan is given, the picture is the plan."""
        alone = "thermography" in content and not {"plan", "interferometry", "sensors", "record"} & set(content)
        return {**content, "plan": {"registration": "pixels"}} if alone else content

    @property
    def folder(self) -> Path:
        """Folder that the relative paths of the campaign start from."""
        return self.path.parent

    @property
    def declared(self) -> tuple[str, ...]:
        """Declared effects; where the file names none, those that follow the table's temperature, if it was measured."""
        measured = self.thermography is not None or self.sensors is not None
        return self.model.declared if measured or "declared" in self.model.model_fields_set else ()

    def zone_of(self, table: Literal["interferometry", "sensors", "drivers", "record"]) -> str | None:
        """Return the zone of times that the files of a table give without one; None where neither it nor ``[campaign]`` states it."""
        stated = getattr(self, table)
        return (stated.time_zone if stated is not None else None) or self.campaign.time_zone

    def resolve(self, name: str) -> Path:
        """Return the absolute path of a file named in the campaign."""
        return stored_path(self.folder, name).resolve()

    def frame_paths(self) -> tuple[Path, ...]:
        """Return the thermal files that the glob patterns match, each once, sorted by name."""
        patterns = () if self.thermography is None else self.thermography.frames
        return tuple(in_order({path for pattern in patterns for path in matching_files(self.folder, pattern)}))

    def record_paths(self) -> tuple[Path, ...]:
        """Return the tables of the record's runs, each once, in the order in which the campaign file names them."""
        if self.record is None:
            return ()
        file, patterns = self.record.file, self.record.files
        return _each_match(self.folder, patterns) if file is None else (self.resolve(file),)

    def test_paths(self) -> tuple[Path, ...]:
        """Return the tables of the runs that the campaign file holds out; empty where it names none."""
        return () if self.record is None else _each_match(self.folder, self.record.test)

    def input_files(self) -> dict[str, Path]:
        """Return every file that the campaign reads, keyed by its path relative to the campaign file."""
        files = {relative_name(self.path, self.folder): self.path}
        for table in FILE_KEYS:
            files |= self.files_of(table)
        return files

    def files_of(self, table: str) -> dict[str, Path]:
        """Return the files that one table of the campaign names, keyed by their path relative to the campaign file."""
        stated = getattr(self, table)
        if stated is None:
            return {}
        paths = list({"thermography": self.frame_paths, "record": self.record_paths}.get(table, tuple)())
        for key in FILE_KEYS.get(table, ()) if table != "record" else ():
            name = reduce(lambda within, part: getattr(within, part, None), key.split("."), stated)
            paths += [self.resolve(name)] if isinstance(name, str) else []
        return {relative_name(path, self.folder): path for path in paths}


def campaign_schema() -> dict[str, Any]:
    """Return the JSON Schema of the campaign file, quantities as they are written there."""
    schema = Campaign.model_json_schema()
    del schema["properties"]["path"]
    schema["required"] = [name for name in schema["required"] if name != "path"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "thermofuse campaign"}


def relative_name(path: Path, folder: Path) -> str:
    """Return the name of a file of a campaign, another one for every file: its path as seen from the folder, with forward slashes."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return path.as_posix()


def load_campaign(path: str | Path, *, effects: Mapping[str, Effect] | None = None) -> Campaign:
    """Read and check a campaign file, before anything is computed.

    Parameters
    ----------
    path : str or Path
        The TOML file; relative paths inside it start from its folder.
    effects : mapping of str to Effect, optional
        Effects by name, of which ``[model] declared`` may hold the declarable ones; left out: the library with the user's own.

    Returns
    -------
    Campaign
        Numbers in the unit that their name states; the files that it names exist.

    Raises
    ------
    CampaignError
        With every fault, one per line: file, line, key, value, remedy.

    Notes
    -----
    The README shows a whole file; `campaign_schema` describes every key. Quantities are written with their unit, ``"5 mm"``.

    Examples
    --------
    >>> load_campaign("absent.toml")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    fusion.campaign.config.CampaignError: ...absent.toml: no such campaign file; ...
    """
    path = campaign_file(Path(path).resolve())
    try:
        content, text = read_toml(path)
    except FileNotFoundError:
        raise CampaignError(f"{path}: no such campaign file; check the name, or let thermofuse init write it") from None
    except UnicodeDecodeError as error:
        raise CampaignError(f"{path}: byte {error.start} is not UTF-8; save the campaign file as UTF-8 text") from None
    except TomlError as error:
        raise CampaignError(f"{path}: this is not TOML: {error}; see the campaign file in the README") from None
    place = place_in(path, text)
    if "path" in content:
        raise CampaignError(f"{place(('path',))}: unknown key path; remove it")
    measured = "thermography" in content or "sensors" in content
    surroundings = _Surroundings(path.parent, library() if effects is None else effects, "record" in content, measured)
    try:
        campaign = Campaign.model_validate({**content, "path": path}, context=surroundings)
    except ValidationError as error:
        ordered = sorted(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
        faults = [describe(_as_written(item, content), Campaign, place) for item in ordered]
    else:
        faults = [f"{place(key)}: {fault}" for key, fault in contradictions(campaign)]
    if faults:
        raise CampaignError(first_faults(faults, path))
    return campaign


def _as_written(item: ErrorDetails, content: Mapping[str, Any]) -> ErrorDetails:
    """Return the fault of an uncertainty under the key that states it: ``emissivity = "0.97 +- 2"`` has no line ``emissivity_u``."""
    *outer, name = item["loc"] or ("",)
    if not str(name).endswith("_u"):
        return item
    written = str(name).removesuffix("_u")
    try:
        table: Any = reduce(lambda within, part: within[part], outer, content)  # type: ignore[index]
        return item if name in table else {**item, "loc": (*outer, written), "input": table[written]}
    except (KeyError, IndexError, TypeError):
        return item


def _each_match(folder: Path, patterns: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the files that patterns match, each once, in the order of the patterns and of the names that one pattern matches."""
    return tuple(dict.fromkeys(path for pattern in patterns for path in in_order(matching_files(folder, pattern))))
