"""The campaign file, checked completely before anything is computed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
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
from pydantic_core import PydanticCustomError

from fusion.campaign.messages import as_written, describe, find_line, first_faults, key_lines, near_file, suggest
from fusion.campaign.needed_tables import check_tables
from fusion.campaign.quantities import split_uncertainty
from fusion.campaign.standard_test import AcceptanceTable, ReportTable, UncertaintyTable
from fusion.campaign.value_types import (
    Celsius,
    Feed,
    Fraction,
    FractionU,
    KelvinU,
    Metres,
    MetresU,
    Millimetres,
    PartsPerMillion,
    PartsPerMillionU,
    PixelPatch,
    Pixels,
    PositiveMillimetres,
    PositiveSeconds,
    Seconds,
    TimeZone,
    area_mm2,
    check_pattern,
    corner_words,
    matching_files,
    not_a_file,
)
from fusion.effects.effect import Effect
from fusion.effects.library import library
from fusion.effects.thermal import QUASI_STATIC
from fusion.errors import FusionError
from fusion.products.store import is_text
from fusion.toml_file import TomlError, read_toml

#: What a record may be declared with: every displacement a linear function of the temperatures.
RECORD_EFFECTS = (QUASI_STATIC,)
#: Effects that need positions along an axis; a record that declares them is run without, and the results say so.
_ALONG_AN_AXIS = ("axis_expansion", "table_offset")
#: Attribute of ``[thermography]`` -> its key, of what files of temperatures are corrected for already.
_CORRECTED_BY_THE_CAMERA = {
    "atmospheric_temperature_degC": "atmospheric_temperature",
    "relative_humidity": "relative_humidity",
    "object_distance_m": "object_distance",
    "window_transmission": "window_transmission",
    "window_temperature_degC": "window_temperature",
}


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
        path = info.context.folder / name
        path = path if "\0" in name else Path(os.path.realpath(path))
        if text := not_a_file(path):
            raise PydanticCustomError("file", "{text}", {"text": text})
        if not os.path.isfile(path):  # noqa: PTH113 - a name that is too long raises there, and is told here
            text = f"no such file {path}; {near_file(path)}paths are relative to the campaign file"
            raise PydanticCustomError("file", "{text}", {"text": text})
    return name


def _matching(pattern: str, info: ValidationInfo) -> str:
    """Accept a pattern that matches at least one file."""
    if isinstance(info.context, _Surroundings):
        check_pattern(info.context.folder, pattern)
        found = matching_files(info.context.folder, pattern)
        # Every link, and one file of each folder: where that is a part of the system, all are.
        doubtful = {path if path.is_symlink() else path.parent: path for path in found}.values()
        lost = [path for path in doubtful if not path.exists()]
        strange = next((text for path in doubtful if (text := not_a_file(path))), "")
        unnamed = [path for path in found if not is_text(str(path).removeprefix(str(info.context.folder)))]
        if lost:
            text = f"{lost[0]} is a link to a file that is gone; bring it back or remove the link"
        elif strange:
            text = strange
        elif unnamed:
            text = f"{str(unnamed[0])!a} has a name that is no text in UTF-8; rename it"
        elif not found:
            text = f"matches no file in {info.context.folder}; paths are relative to the campaign file"
        else:
            return pattern
        raise PydanticCustomError("pattern", "{text}", {"text": text})
    return pattern


def _filled(patterns: tuple[str, ...]) -> tuple[str, ...]:
    """Accept a list that is not empty; `min_length` would count a pattern without a match as absent."""
    if not patterns:
        raise PydanticCustomError("too_short", "this list is empty")
    return patterns


def _declarable(name: str, info: ValidationInfo) -> str:
    """Accept an effect that can be declared for this kind of campaign: one whose columns are known before the readings."""
    if not isinstance(info.context, _Surroundings):
        return name
    effects = info.context.effects
    if info.context.record:
        allowed: tuple[str, ...] = RECORD_EFFECTS
        accepted = name in (*allowed, *_ALONG_AN_AXIS)
    else:
        allowed = tuple(
            effect.name
            for effect in effects.values()
            if effect.declarable and (info.context.temperatures or not effect.follows_field)
        )
        accepted = name in allowed
    if accepted:
        return name
    choice = f"can be declared here: {', '.join(allowed)}"
    unmeasured = name in effects and effects[name].declarable and effects[name].follows_field
    if unmeasured and not info.context.record:
        text = (
            "this effect follows the temperature of the table, which this campaign does not measure; add [thermography] with [plan], or "
            f"[sensors], or remove the effect; {choice}"
        )
    elif name in effects and not effects[name].declarable:
        lacking = (
            "the columns of this effect need a fitted model"
            if effects[name].errs_camera
            else "the parameters of this effect are not known beforehand"
        )
        text = f"{lacking}; remove it, the closed loop tries it anyway; {choice}"
    elif name in (*effects, *RECORD_EFFECTS):
        text = f"this effect has no meaning for a {'record' if info.context.record else 'campaign with positions'}; {choice}"
    else:
        text = f"unknown effect; {suggest(name, (*effects, *RECORD_EFFECTS))}{choice}"
    raise PydanticCustomError("effect", "{text}", {"text": text})


def _each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    """Accept a list that names everything once."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        text = f"{', '.join(repeated)} named more than once; name each effect once"
        raise PydanticCustomError("repeated", "{text}", {"text": text})
    return names


ExistingFile = Annotated[str, AfterValidator(_existing)]
FramePatterns = Annotated[
    tuple[Annotated[str, AfterValidator(_matching)], ...],
    AfterValidator(_filled),
    Field(json_schema_extra={"minItems": 1}),
]
#: Names or patterns of the runs of a record, a single one without brackets too.
RunPatterns = Annotated[
    tuple[Annotated[str, AfterValidator(_matching)], ...],
    BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
]
DeclaredEffects = Annotated[tuple[Annotated[str, AfterValidator(_declarable)], ...], AfterValidator(_each_once)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class CampaignTable(_Table):
    """``[campaign]``: what was measured."""

    title: str = Field(min_length=1)
    axis: str = Field(default="", max_length=20)
    time_zone: TimeZone | None = None


#: Keys that may be written with their standard uncertainty, ``"0.97 +- 0.01"``; it is kept under the name with ``_u``.
_WITH_UNCERTAINTY = (
    "emissivity",
    "reflected_temperature",
    "atmospheric_temperature",
    "relative_humidity",
    "object_distance",
    "window_transmission",
    "window_temperature",
    "temperature",
    "expansion_coefficient",
)


class _Measured(_Table):
    """A table in which a value may be written with its standard uncertainty."""

    @model_validator(mode="before")
    @classmethod
    def _split(cls, content: object) -> object:
        """Give the uncertainty of ``"value +- uncertainty"`` a key of its own."""
        if not isinstance(content, dict):
            return content
        parted = dict(content)
        for name in _WITH_UNCERTAINTY:
            if isinstance(content.get(name), str):
                parted[name], u = split_uncertainty(content[name])
                if u is not None:
                    parted.setdefault(f"{name}_u", u)
        return parted


class StateTable(_Measured):
    """One of ``states`` of a region: a cycle in which a contact sensor measured the region's temperature."""

    cycle: int = Field(ge=1)
    temperature_degC: Celsius = Field(alias="temperature")
    temperature_u_K: KelvinU = Field(default=0.1, alias="temperature_u")


class SurfaceTable(_Measured):
    """``[[thermography.region]]``: a part of the table with an emissivity of its own, given or from two states."""

    name: str = Field(min_length=1)
    rectangle_mm: tuple[tuple[Millimetres, Millimetres], tuple[Millimetres, Millimetres]] | None = Field(
        default=None, alias="rectangle"
    )
    polygon_mm: tuple[tuple[Millimetres, Millimetres], ...] | None = Field(default=None, alias="polygon")
    emissivity: Fraction | None = None
    emissivity_u: FractionU | None = None
    states: tuple[StateTable, StateTable] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> SurfaceTable:
        if (self.rectangle_mm is None) == (self.polygon_mm is None):
            text = f"region {self.name} needs either rectangle (two opposite corners) or polygon (its corners in order)"
            raise PydanticCustomError("region", "{text}", {"text": text})
        if self.polygon_mm is not None and len(self.polygon_mm) < 3:
            text = f"the polygon of region {self.name} has {len(self.polygon_mm)} corners; it needs at least 3"
            raise PydanticCustomError("region", "{text}", {"text": text})
        if (self.emissivity is None) == (self.states is None):
            text = f'region {self.name} needs either emissivity, for example "0.35 +- 0.05", or states (two cycles of known temperature)'
            raise PydanticCustomError("region", "{text}", {"text": text})
        if area_mm2(self.corners_mm) == 0.0:
            text = f"region {self.name} with the corners {corner_words(self.corners_mm)} has no area; give corners that enclose one"
            raise PydanticCustomError("region", "{text}", {"text": text})
        if self.states is not None and self.states[0].cycle == self.states[1].cycle:
            text = (
                f"both states of region {self.name} are cycle {self.states[0].cycle}; name two cycles in which its temperature differs, as "
                "one state cannot tell emissivity and reflection apart"
            )
            raise PydanticCustomError("region", "{text}", {"text": text})
        return self

    @property
    def corners_mm(self) -> tuple[tuple[float, float], ...]:
        """Corners (x, y) of the region in order, mm."""
        if self.polygon_mm is not None:
            return self.polygon_mm
        assert self.rectangle_mm is not None
        (x0, y0), (x1, y1) = self.rectangle_mm
        return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


class StackTable(_Table):
    """``[thermography.stack]``: what files of temperatures of other cameras do not hold themselves."""

    unit: Literal["degC", "K"] | None = None
    scale: float = Field(default=1.0, gt=0.0)
    offset: float = 0.0
    variable: str | None = None
    time_in_name: str | None = None
    times: ExistingFile | None = None
    start: str | None = None
    interval_s: PositiveSeconds | None = Field(default=None, alias="interval")
    time_zone: TimeZone = "UTC"
    emissivity: Fraction | None = None
    reflected_temperature_degC: Celsius | None = Field(default=None, alias="reflected_temperature")

    @model_validator(mode="after")
    def _says_times_once(self) -> StackTable:
        given = [name for name in ("time_in_name", "times", "start") if getattr(self, name) is not None]
        if len(given) > 1:
            text = f"{' and '.join(given)} each say when the frames were taken; keep one"
            raise PydanticCustomError("times", "{text}", {"text": text})
        return self


class ThermographyTable(_Measured):
    """``[thermography]``: the frames, the camera parameters that override the stored ones, and standard uncertainties."""

    frames: FramePatterns
    emissivity: Fraction | None = None
    emissivity_u: FractionU | None = None
    reflected_temperature_degC: Celsius | None = Field(default=None, alias="reflected_temperature")
    reflected_temperature_u_K: KelvinU | None = Field(default=None, alias="reflected_temperature_u")
    atmospheric_temperature_degC: Celsius | None = Field(default=None, alias="atmospheric_temperature")
    atmospheric_temperature_u_K: KelvinU | None = Field(default=None, alias="atmospheric_temperature_u")
    relative_humidity: Fraction | None = None
    relative_humidity_u: FractionU | None = None
    object_distance_m: Metres | None = Field(default=None, alias="object_distance")
    object_distance_u_m: MetresU | None = Field(default=None, alias="object_distance_u")
    window_transmission: Fraction | None = None
    window_transmission_u: FractionU | None = None
    window_temperature_degC: Celsius | None = Field(default=None, alias="window_temperature")
    window_temperature_u_K: KelvinU | None = Field(default=None, alias="window_temperature_u")
    camera_offset_u_K: KelvinU | None = Field(default=None, alias="camera_offset_u")
    camera_scale_u: FractionU | None = None
    camera_drift_u_K: KelvinU | None = Field(default=None, alias="camera_drift_u")
    region: tuple[SurfaceTable, ...] = ()
    clock_offset_s: Seconds | None = Field(default=None, alias="clock_offset")
    window_s: PositiveSeconds | None = Field(default=None, alias="window")
    table: Literal["still", "moving"] = "still"
    reference_patch_px: PixelPatch | None = Field(default=None, alias="reference_patch")
    lens: ExistingFile | None = None
    stack: StackTable | None = None

    @model_validator(mode="after")
    def _recalculates_what_is_known(self) -> ThermographyTable:
        if self.stack is None:
            return self
        corrected = [name for name in _CORRECTED_BY_THE_CAMERA if getattr(self, name) is not None]
        if corrected:
            text = f"{_CORRECTED_BY_THE_CAMERA[corrected[0]]} is corrected in temperatures already; set it in the camera's program"
            raise PydanticCustomError("stack", "{text}", {"text": text})
        if self.emissivity is not None and self.stack.emissivity is None:
            text = (
                "another emissivity can only be calculated from the one that the camera's program used: write that as emissivity under "
                "[thermography.stack]"
            )
            raise PydanticCustomError("stack", "{text}", {"text": text})
        return self


class AxisTable(_Table):
    """``[plan.axis]``: where the measured line lies on the plan."""

    origin_mm: tuple[Millimetres, Millimetres] = Field(alias="origin")
    direction: tuple[float, float]

    @model_validator(mode="after")
    def _has_length(self) -> AxisTable:
        if self.direction == (0.0, 0.0):
            raise PydanticCustomError("direction", "the direction [0, 0] points nowhere; write for example [-1, 0]")
        return self


class PlanTable(_Table):
    """``[plan]``: the table plan in millimetres and its fiducials; or, by ``registration = "pixels"``, the picture itself."""

    registration: Literal["fiducials", "pixels"] = "fiducials"
    size_mm: tuple[PositiveMillimetres, PositiveMillimetres] | None = Field(default=None, alias="size")
    cell_size_mm: PositiveMillimetres | None = Field(default=None, alias="cell_size")
    cell_px: Pixels | None = None
    fiducials: ExistingFile | None = None
    regions: ExistingFile | None = None
    axis: AxisTable | None = None

    @property
    def in_pixels(self) -> bool:
        """Whether the picture itself is the plan, whose lengths are then in px."""
        return self.registration == "pixels"

    @model_validator(mode="after")
    def _cells_fit(self) -> PlanTable:
        if self.cell_size_mm is None or self.size_mm is None:
            return self
        along = [length / self.cell_size_mm for length in self.size_mm]
        cells = along[0] * along[1]
        if any(abs(count - round(count)) > 1e-6 for count in along):
            text = (
                f"cell_size {self.cell_size_mm:g} mm does not divide a plan of {self.size_mm[0]:g} x {self.size_mm[1]:g} mm; "
                "choose one that divides both sides"
            )
            raise PydanticCustomError("cells", "{text}", {"text": text})
        if min(self.size_mm) < 2 * self.cell_size_mm or cells > 4e6:
            text = (
                f"cell_size {self.cell_size_mm:g} mm on a plan of {self.size_mm[0]:g} x {self.size_mm[1]:g} mm "
                f"makes {cells:.0f} cells; choose it for at least 2 cells per side and at most 4 million in all"
            )
            raise PydanticCustomError("cells", "{text}", {"text": text})
        return self


class SensorsTable(_Table):
    """``[sensors]``: temperatures of contact sensors over time, and the places of the sensors on the plan."""

    file: ExistingFile
    places: ExistingFile
    time_zone: TimeZone | None = None
    temperature_u_K: KelvinU = Field(default=0.2, alias="temperature_u")


class InterferometryTable(_Measured):
    """``[interferometry]``: the readings, and the parameters of the laser's compensation."""

    deviations: ExistingFile
    sheet: str | None = None
    environment: ExistingFile | None = None
    time_zone: TimeZone | None = None
    dead_path_mm: Millimetres = Field(default=0.0, alias="dead_path")
    expansion_coefficient_ppm_per_K: PartsPerMillion = Field(default=11.7, alias="expansion_coefficient")
    expansion_coefficient_u_ppm_per_K: PartsPerMillionU | None = Field(default=None, alias="expansion_coefficient_u")
    feed_mm_per_min: Feed | None = Field(default=None, alias="feed")
    dwell_s: PositiveSeconds | None = Field(default=None, alias="dwell")
    compensation: Literal["as recorded", "redo"] = "as recorded"
    material_temperature: Literal["logged", "camera"] = "logged"
    material_sensor_mm: tuple[Millimetres, Millimetres] | None = Field(default=None, alias="material_sensor")
    environment_factor_mm: tuple[Millimetres, Millimetres] | None = Field(default=None, alias="environment_factor")
    uncertainty: UncertaintyTable = UncertaintyTable()

    @model_validator(mode="after")
    def _redo_is_asked_for(self) -> InterferometryTable:
        """Refuse keys that say how a compensation is done again where none is."""
        given = ['material_temperature = "camera"'] if self.material_temperature == "camera" else []
        given += ["environment_factor"] if self.environment_factor_mm is not None else []
        if given and self.compensation != "redo":
            text = (
                f'{" and ".join(given)} without compensation = "redo", to which it belongs; add that, or leave it out'
            )
            raise PydanticCustomError("compensation", "{text}", {"text": text})
        return self

    @model_validator(mode="after")
    def _coefficient_u_once(self) -> InterferometryTable:
        """Refuse two standard uncertainties of one coefficient."""
        one, other = self.expansion_coefficient_u_ppm_per_K, self.uncertainty.expansion_coefficient_ppm_per_K
        if one is not None and other is not None and one != other:
            text = (
                f"the standard uncertainty of the expansion coefficient is {one:g} ppm/K beside the coefficient and {other:g} ppm/K under "
                "[interferometry.uncertainty]; state it once"
            )
            raise PydanticCustomError("twice", "{text}", {"text": text})
        return self


class DriversTable(_Table):
    """``[drivers]``: other logged quantities, and the law by which some of them were switched at random."""

    file: ExistingFile
    time_zone: TimeZone | None = None
    randomised: tuple[str, ...] = ()
    mean_dwell_s: PositiveSeconds | None = Field(default=None, alias="mean_dwell")
    least_dwell_s: Seconds = Field(default=0.0, alias="least_dwell")

    @model_validator(mode="after")
    def _law_is_whole(self) -> DriversTable:
        if bool(self.randomised) != (self.mean_dwell_s is not None):
            text = "randomised and mean_dwell belong together: which columns were switched at random, and the mean time between"
            raise PydanticCustomError("law", text)
        if self.mean_dwell_s is not None and not 0.0 <= self.least_dwell_s < self.mean_dwell_s:
            text = f"least_dwell {self.least_dwell_s:g} s must be shorter than mean_dwell {self.mean_dwell_s:g} s, and not negative"
            raise PydanticCustomError("law", "{text}", {"text": text})
        return self


class RecordTable(_Table):
    """``[record]``: temperature sensors and displacement channels over time, in one table per run (CSV or XLSX).

    Columns are named as in the file's heading, ``"name [unit]"`` or ``"name (unit)"``; ``*`` stands for any text. ``test`` names the runs
    that are held out; left out: the last one.
    """

    file: ExistingFile | None = None
    files: RunPatterns = ()
    test: RunPatterns = ()
    sheet: str | None = None
    time: str
    start: str | None = None
    time_zone: TimeZone | None = None
    temperatures: tuple[str, ...] = Field(min_length=1)
    displacements: tuple[str, ...] = Field(min_length=1)
    drivers: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _runs_are_whole(self, info: ValidationInfo) -> RecordTable:
        if (self.file is None) == (not self.files):
            text = 'write either file = "run.csv", or files = ["run_*.csv"] (names or patterns) for several runs of one test'
            raise PydanticCustomError("runs", "{text}", {"text": text})
        if self.test and not self.files:
            text = "test names runs among files; write files = [...] instead of file, or leave test out: the last fifth is held out"
            raise PydanticCustomError("runs", "{text}", {"text": text})
        if isinstance(info.context, _Surroundings) and self.test:
            runs, test = (_each_match(info.context.folder, patterns) for patterns in (self.files, self.test))
            strange = [path.name for path in test if path not in runs]
            if strange:
                text = f"test names {', '.join(strange)}, which files does not; the runs are {', '.join(path.name for path in runs)}"
                raise PydanticCustomError("runs", "{text}", {"text": text})
            if len(test) == len(runs):
                text = f"test names all {len(runs)} runs, which leaves none to learn from; name fewer"
                raise PydanticCustomError("runs", "{text}", {"text": text})
        return self


class ModelTable(_Table):
    """``[model]``: the effects that are known to act."""

    declared: DeclaredEffects = ("axis_expansion", "table_offset")


class AcceptTable(_Table):
    """``[accept]``: what the user knows of the inputs, so that it is no doubt any more."""

    doubts: Annotated[tuple[str, ...], AfterValidator(_each_once)] = ()


class Campaign(_Table):
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
    acceptance: AcceptanceTable = AcceptanceTable()
    report: ReportTable = ReportTable()

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
        return (self.folder / name).resolve()

    def frame_paths(self) -> tuple[Path, ...]:
        """Return the thermal files that the glob patterns match, each once, sorted by name."""
        if self.thermography is None:
            return ()
        return tuple(
            sorted({path for pattern in self.thermography.frames for path in matching_files(self.folder, pattern)})
        )

    def record_paths(self) -> tuple[Path, ...]:
        """Return the tables of the record's runs, each once, in the order in which the campaign file names them."""
        if self.record is None:
            return ()
        return (
            _each_match(self.folder, self.record.files)
            if self.record.file is None
            else (self.resolve(self.record.file),)
        )

    def test_paths(self) -> tuple[Path, ...]:
        """Return the tables of the runs that the campaign file holds out; empty where it names none."""
        return () if self.record is None else _each_match(self.folder, self.record.test)

    def input_files(self) -> dict[str, Path]:
        """Return every file that the campaign reads, keyed by its path relative to the campaign file."""
        files = {relative_name(self.path, self.folder): self.path}
        for table in ("thermography", "plan", "interferometry", "sensors", "drivers", "record"):
            files |= self.files_of(table)
        return files

    def files_of(self, table: str) -> dict[str, Path]:
        """Return the files that one table of the campaign names, keyed by their path relative to the campaign file."""
        names: list[str | None] = []
        if table == "plan" and self.plan is not None:
            names = [self.plan.fiducials, self.plan.regions]
        elif table == "interferometry" and self.interferometry is not None:
            names = [self.interferometry.deviations, self.interferometry.environment]
        elif table == "sensors" and self.sensors is not None:
            names = [self.sensors.file, self.sensors.places]
        elif table == "drivers" and self.drivers is not None:
            names = [self.drivers.file]
        elif table == "thermography" and self.thermography is not None:
            stack = self.thermography.stack
            names = [self.thermography.lens, None if stack is None else stack.times]
        paths = list({"thermography": self.frame_paths, "record": self.record_paths}.get(table, tuple)())
        paths += [self.resolve(name) for name in names if name is not None]
        return {relative_name(path, self.folder): path for path in paths}


def campaign_schema() -> dict[str, Any]:
    """Return the JSON Schema of the campaign file, quantities as they are written there."""
    schema = Campaign.model_json_schema()
    del schema["properties"]["path"]
    schema["required"] = [name for name in schema["required"] if name != "path"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "thermofuse campaign"}


def relative_name(path: Path, folder: Path) -> str:
    """Return `path` as seen from `folder`, with forward slashes, or its bare name where it lies elsewhere.

    Parameters
    ----------
    path : Path
        Absolute path.
    folder : Path
        Folder of the campaign file.
    """
    try:
        return path.relative_to(folder).as_posix()
    except ValueError:
        return path.name


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
    fusion.campaign.config.CampaignError: ...absent.toml: no such campaign file; check the name or give its full path
    """
    path = Path(path).resolve()
    if path.is_dir():
        raise CampaignError(f"{path} is a folder; name the campaign file in it, for example {path / 'campaign.toml'}")
    try:
        content, text = read_toml(path)
    except FileNotFoundError:
        raise CampaignError(f"{path}: no such campaign file; check the name or give its full path") from None
    except UnicodeDecodeError as error:
        raise CampaignError(f"{path}: byte {error.start} is not UTF-8; save the campaign file as UTF-8 text") from None
    except TomlError as error:
        raise CampaignError(f"{path}: this is not TOML: {error}; see the campaign file in the README") from None
    lines = key_lines(text)

    def place(key: tuple[str, ...]) -> str:
        return f"{path}, line {find_line(lines, key)}"

    faults = check_tables(content, place)
    content.pop("path", None)
    measured = "thermography" in content or "sensors" in content
    surroundings = _Surroundings(path.parent, library() if effects is None else effects, "record" in content, measured)
    try:
        campaign = Campaign.model_validate({**content, "path": path}, context=surroundings)
    except ValidationError as error:
        ordered = sorted(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
        details = [item for item in ordered if not (faults and item["type"] == "missing" and len(item["loc"]) == 1)]
        faults += [describe(as_written(item, content), Campaign, place) for item in details]
    if faults:
        raise CampaignError("\n".join(first_faults(faults, path)))
    return campaign


def _each_match(folder: Path, patterns: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the files that patterns match, each once, in the order of the patterns and of the names that one pattern matches."""
    return tuple(dict.fromkeys(path for pattern in patterns for path in sorted(matching_files(folder, pattern))))
