"""What parts of results.json share: their base class, types of values, quantities with an uncertainty, and the prediction of a table.

The analysis makes the parts. A number that the data do not determine is NaN there, ``null`` in the file and None when it is read; a key
that does not apply is never set, and absent.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from inspect import cleandoc, getsource
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Literal, TypeGuard
from zoneinfo import ZoneInfo

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from fusion.common import FusionError
from fusion.results.numbers import LEAST_P
from fusion.results.store import read_json

Number = float | None
#: A p-value; ``LEAST_P`` stands for any smaller one.
PValue = Annotated[Number, AfterValidator(lambda p: p if p is None else max(p, LEAST_P))]


def determined(number: Number) -> float:
    """Return a number as the analysis has it: NaN where the data do not determine it."""
    return math.nan if number is None else number


class ResultPart(BaseModel):
    """Base class of every part: immutable, without unknown keys, each field described by its docstring."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        # What nobody validates alone is built as a part of what holds it.
        defer_build=True,
        serialize_by_alias=True,
        # A result of the analysis may add arrays to its part, which are not written.
        arbitrary_types_allowed=True,
    )

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Describe every key by the text below its field.

        pydantic itself would read these texts out of the source whenever a model is imported, a tenth of a second of every command.
        """
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for one in cls.__mro__:
            for name, text in _texts_below(one).items() if issubclass(one, ResultPart) else ():
                properties[cls.model_fields[name].serialization_alias or name].setdefault("description", text)
        return schema


def _texts_below(model: type) -> dict[str, str]:
    """The text below each field of a model, from its source; none where that is not installed."""
    try:
        (tree,) = ast.parse(dedent(getsource(model))).body
    except OSError:
        return {}
    assert isinstance(tree, ast.ClassDef)
    return {
        field.target.id: cleandoc(below.value.value)
        for field, below in pairwise(tree.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
    }


class Quantity(ResultPart):
    """A measured value with its standard uncertainty."""

    value: Number
    """Estimate, in the unit that the key ends with."""
    u: Number
    """Standard uncertainty (k = 1), same unit; null where it is not known."""


class Sensitivity(Quantity):
    """A quantity per kelvin of the rise with both parts of its standard uncertainty, which are absent where it is not per kelvin."""

    u_fit: Number = None
    """The part of the fit, the rise taken as exact."""
    u_scale: Number = None
    """The part of the scale of the rise (emissivity, reflections, air, camera)."""

    @property
    def fitted_u(self) -> float:
        """Its standard uncertainty with the rise taken as exact."""
        return determined(self.u if self.u_fit is None else self.u_fit)

    @property
    def expected(self) -> float:
        """What of its value was expected beforehand; 0 where nothing was."""
        return 0.0


class ByDirection(ResultPart):
    """One value per target for each direction of approach; a direction that was not measured is absent."""

    positive: tuple[Number, ...] = ()
    """Values of the approach in positive direction, in the order of the targets."""
    negative: tuple[Number, ...] = ()
    """Values of the approach in negative direction, in the order of the targets."""

    def values(self) -> list[float]:
        """Return the values of both directions that are determined."""
        return [value for value in (*self.positive, *self.negative) if value is not None]


class AreaPart(ResultPart):
    """A place on the plan as the rectangle around its cells."""

    x_low_mm: float
    """Smallest x, mm."""
    x_high_mm: float
    """Largest x, mm."""
    y_low_mm: float
    """Smallest y, mm."""
    y_high_mm: float
    """Largest y, mm."""


def _of_time(text: str) -> str:
    try:
        datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("not a time by ISO 8601") from None
    return text


def _known_zone(name: str) -> str:
    try:
        ZoneInfo(name or "UTC")
    # Also a name that is too long for a file, or leads out of the data base.
    except (LookupError, ValueError, OSError):
        raise ValueError("not a zone of the IANA database") from None
    return name


TimeText = Annotated[str, AfterValidator(_of_time)]


class PluginPart(ResultPart):
    """An effect that another installed distribution added."""

    name: str
    """Name of its entry point."""
    origin: str
    """Module and object, ``package.module:object``."""
    distribution: str
    """Installed distribution that brought it."""
    version: str
    """Version of that distribution."""


class TimePart(ResultPart):
    """When the readings were taken."""

    first: TimeText
    """Time of the first reading, UTC."""
    last: TimeText
    """Time of the last reading, UTC."""
    zone: Annotated[str, AfterValidator(_known_zone)] | None
    """Zone in which times are shown: as the campaign states it, by its name in the IANA data base; null for UTC; empty, as logged, where
    neither campaign nor files give one."""

    @property
    def day(self) -> str:
        """Day of the first reading in that zone, ISO 8601."""
        first = datetime.fromisoformat(self.first)
        return first.replace(tzinfo=first.tzinfo or UTC).astimezone(ZoneInfo(self.zone or "UTC")).date().isoformat()


# results.json, part ``inputs``: whether instruments, logs and physics agree.

#: What a run concludes, by what it rests on: ``positions`` on the laser alone (deviations, drift, ISO 230-2 values, positions that stand
#: out), ``field`` on the camera alone, ``attribution`` (which part of the field the drift follows) and ``causes`` (the model) on both.
Figures = Literal["positions", "field", "attribution", "causes"]


class CheckPart(ResultPart):
    """One consistency check of the inputs."""

    code: str
    """Short name; under ``[accept] doubts`` of the campaign file it says that the doubt is known."""
    value: Number
    """What was found, in the unit that the evidence names."""
    limit: Number
    """Limit that the value is held against."""
    passed: bool
    """Whether the inputs agree."""
    evidence: str
    """One sentence with the numbers."""
    remedy: str
    """What to correct, or what would confirm the input; empty where the check is passed and verified."""
    endangers: str
    """Results that are wrong if the doubt is justified."""
    assumption: str
    """Assumption behind the results that depend on it, as it follows "only if"."""
    conditional: tuple[Figures, ...]
    """Results that hold only under that assumption."""
    verified: bool = True
    """False where the check is passed because nothing contradicts the input, and nothing confirms it either."""


class InputsPart(ResultPart):
    """Whether instruments, logs and physics agree."""

    state: Literal["sound", "doubted", "corrected"]
    """``doubted``: a check is not passed and not accepted, so that causes hold only if the input is right."""
    accepted: tuple[str, ...]
    """Codes of the doubts that the campaign file accepts."""
    checks: tuple[CheckPart, ...]
    """Every check, also those that are passed."""

    @property
    def doubts(self) -> tuple[CheckPart, ...]:
        """Checks that are not passed and not accepted."""
        return tuple(check for check in self.checks if not check.passed and check.code not in self.accepted)

    @property
    def unverified(self) -> tuple[CheckPart, ...]:
        """Checks that are passed without confirming the input, and not accepted."""
        return tuple(check for check in self.checks if not check.verified and check.code not in self.accepted)

    def assumptions(self, *figures: Figures) -> tuple[str, ...]:
        """Return what has to be right for some figures to hold; nothing where no doubt and nothing unverified touches them."""
        open_checks = (*self.doubts, *self.unverified)
        return tuple(dict.fromkeys(one.assumption for one in open_checks if set(one.conditional) & set(figures)))


# Parts of the ISO 230-2 evaluation in results.json that a test sheet shows in addition to the values: tolerances, conditions,
# other standards.


Decision = Literal["pass", "fail", "not decided within the uncertainty", "not measured"]


def is_determined(value: Number) -> TypeGuard[float]:
    """Tell whether the data determine a number: where they do not, it is NaN in the analysis and None in a part."""
    return value is not None and math.isfinite(value)


def decide(value: Number, expanded_u: Number, limit: float) -> Decision:
    """Judge a quantity with its expanded uncertainty U (k = 2) against its upper limit; undecided without an uncertainty.

    Pass and fail keep a guard band of U = 2 u: less than 2.5 % of false decisions at the limit. ILAC-G8:09/2019 names 1.65 u (0.83 U, less
    than 5 %) for ISO 14253-1:2017, whose text was not consulted; what is decided here is decided so there.
    """
    if not is_determined(value):
        return "not measured"
    if not is_determined(expanded_u):
        return "not decided within the uncertainty"
    if value + expanded_u <= limit:
        return "pass"
    return "fail" if value - expanded_u > limit else "not decided within the uncertainty"


class Iso230Tolerance(ResultPart):
    """A quantity judged against its tolerance."""

    quantity: str
    """Symbol of the quantity, with the direction of approach where it is unidirectional."""
    limit_um: float
    """Tolerance, um."""
    value_um: Number
    """Value in the quoted window, um."""
    expanded_u_um: Number
    """Its expanded uncertainty (k = 2), um."""
    decision: Decision
    """By ISO 14253-1 with a guard band of the expanded uncertainty: pass up to the tolerance less it, fail from the tolerance plus it."""
    windows_otherwise: int = 0
    """How many of the windows of five cycles would be judged otherwise. New in schema 4."""


class Iso230Check(ResultPart):
    """A condition that ISO 230-2 asks of a test."""

    name: str
    """The requirement."""
    met: bool | None
    """Whether it is met; null where the readings do not show it."""
    evidence: str
    """What was found."""


class Iso230Condition(ResultPart):
    """A condition of the test as it was stated or logged."""

    key: str
    """Which one, whatever its name: the key under which the campaign file states it, or ``date``, ``axis``, ``measured_travel``,
    ``air_temperature``, ``material_temperature``, ``compensation``. Instruments share one. New in schema 4."""
    name: str
    """What it is."""
    text: str
    """With its unit; empty where it is not stated."""


class OtherEvaluation(ResultPart):
    """A quantity of the quoted window by another standard."""

    standard: str
    """Which standard."""
    name: str
    """Name of the quantity, with its symbol."""
    value_um: Number
    """um."""
    definition: str
    """How it is calculated."""


# results.json, part ``radiometry``: uncertainty of temperatures and rises, and the budget that it comes from.


class BudgetEntry(ResultPart):
    """One input that all frames share, and what it contributes."""

    input: str
    """Name of the input; ends with its unit where it has one."""
    value: Number
    """Value that the frames were calibrated with; null for a property of the camera that has none."""
    u: Number
    """Standard uncertainty, in the unit of the value."""
    source: Literal["stated", "assumed", "measured"]
    """Whether the campaign file states the uncertainty, a default was assumed, or the frames showed it."""
    temperature_u_K: Number
    """Contribution to the standard uncertainty of the mean temperature of the last cycle, K, to first order."""
    rise_u_percent: Number
    """Contribution to the standard uncertainty of a rise, in percent of the rise, to first order; null for the camera's zero, which
    contributes its u to every rise, and for the change of what is reflected, which contributes (1 - emissivity) / emissivity of it."""


class TwoParts(ResultPart):
    """Standard uncertainty in two parts, means over the cells of the last cycle."""

    noise_K: Number
    """From pixel noise and registration: it differs from cell to cell and from cycle to cycle, K."""
    common_K: Number
    """From what all cells and frames share: emissivity, reflections, air, window, camera, K."""
    total_K: Number
    """Both combined, K."""


class SurfacePart(ResultPart):
    """A part of the table with an emissivity of its own."""

    name: str
    """Name of the region; empty for the rest of the table."""
    emissivity: Quantity
    """Emissivity, 1."""
    source: Literal["stated", "assumed", "two states", "frames"]
    """Where the emissivity comes from."""
    cells: int
    """Cells of the plan."""
    rise_scale_u: Number
    """Standard uncertainty of its rises that is the same share of all of them, 1; null where it is not seen."""
    monte_carlo_ratio: Number
    """Propagation of distributions over first order, of the rise; applied where it differs from 1 by more than 5 %."""


class RadiometryPart(ResultPart):
    """Uncertainty of temperatures and rises."""

    temperature_u: TwoParts
    """Of the temperature of a cell."""
    rise_u: TwoParts
    """Of the rise of a cell since the first cycle."""
    rise_scale_u: Number
    """Standard uncertainty of all rises that is the same share of each, mean over the plan, 1."""
    budget: tuple[BudgetEntry, ...]
    """Inputs that all frames share."""
    surfaces: tuple[SurfacePart, ...]
    """Surfaces of one emissivity each."""
    edge_cells: int
    """Cells that were left empty because they see two surfaces."""


class FieldPart(ResultPart):
    """The temperature fields in short: how many, over which time, and the rise."""

    fields: int
    """Cycles, or windows of time where no laser gives cycles, that have a field."""
    frames: int
    """Thermograms that were used."""
    duration_s: Number
    """From the first thermogram to the last, s."""
    mean_rise_K: Quantity
    """Rise of the last field since the first, mean over the plan, with what all cells share as its uncertainty, K."""
    largest_rise_K: Quantity
    """Largest rise of a cell in any field, K; null where no cell is seen twice."""
    largest_cycle: int | None
    """Cycle or window of that rise."""
    largest_after_s: Number
    """From the first field to that one, s."""
    largest_x_mm: Number = None
    """Place of that cell, x, mm."""
    largest_y_mm: Number = None
    """Place of that cell, y, mm."""


class PicturePlace(ResultPart):
    """A pixel of one picture."""

    file: str
    """File of the picture, as seen from the campaign file."""
    frame: int
    """Index of the picture in its file, from 0."""
    time: str | None
    """When it was taken, UTC; null where the file does not say it."""
    column_px: int
    """Column, from 0 at the left edge."""
    row_px: int
    """Row, from 0 at the upper edge."""


class TemperatureRegionPart(ResultPart):
    """The whole picture, or a spot, box, ellipse, line or polygon of it, over the pictures of one camera."""

    name: str
    """As the file or the campaign names it."""
    kind: Literal["spot", "box", "ellipse", "line", "polygon"]
    """What it is; the whole picture is a box."""
    camera: str
    """Camera and size of its pictures."""
    pictures: int
    """Pictures in which it is evaluated."""
    emissivity: Number
    """Emissivity with which it is evaluated, 1."""
    maximum_degC: Quantity
    """Highest temperature in any picture, degC; where pixels are above the calibrated range, the end of that range, without uncertainty."""
    maximum_at: PicturePlace
    """Where and when that is."""
    minimum_degC: Quantity
    """Lowest temperature in any picture, degC; where pixels are below the calibrated range, the end of that range, without uncertainty."""
    minimum_at: PicturePlace
    """Where and when that is."""
    mean_degC: Quantity
    """Mean over its pixels within the calibrated range and over the pictures, degC."""
    overrange_pictures: int
    """Pictures with pixels above the calibrated range."""
    overrange_pixels: int
    """Most such pixels in one picture."""
    underrange_pictures: int
    """Pictures with pixels below the calibrated range, or without a temperature."""
    underrange_pixels: int
    """Most such pixels in one picture."""


class CameraPicturesPart(ResultPart):
    """The pictures of one camera."""

    name: str
    """Model, serial number, and size in pixels."""
    pictures: int
    """Number of its pictures."""
    first: str | None
    """Time of the first, UTC; null where none has a time."""
    last: str | None
    """Time of the last, UTC."""


class DifferencePart(ResultPart):
    """The last picture of a series minus the first."""

    seconds: float
    """Time between them, s."""
    mean_K: Quantity
    """Mean over the pixels, K."""
    largest_K: Quantity
    """Largest change of a pixel in either direction, K; without uncertainty where the camera moved, or may have."""
    largest_column_px: int
    """Its column, from 0 at the left edge."""
    largest_row_px: int
    """Its row, from 0 at the upper edge."""


class ThermogramsPart(ResultPart):
    """Pictures of a camera that measures alone."""

    pictures: int
    """Pictures that were evaluated."""
    cameras: tuple[CameraPicturesPart, ...]
    """Cameras that took them."""
    series: str
    """Camera of the series; empty where no camera took most of them."""
    scene: Literal["one picture", "still", "moved", "unlike", "no series"]
    """What the series shows: the same from the same place, from another place, or something else."""
    largest_shift_px: Number
    """Largest shift of a picture against the first, px; null where pictures cannot be compared."""
    emissivity: Number
    """Emissivity with which the hottest picture is calibrated, 1."""
    indicated_degC: Number
    """Highest temperature that its pixels indicate, degC; not calibrated where it lies beyond the camera's range."""
    difference: DifferencePart | None = None
    """Last minus first; absent where they do not show the same."""


class ContactSensorPart(ResultPart):
    """A contact sensor on the table."""

    name: str
    """Name of its column."""
    file: str
    """File of its temperatures, as the campaign names it."""
    x_mm: float
    """Place on the plan, x, mm."""
    y_mm: float
    """Place on the plan, y, mm."""
    rise_K: Number
    """Last temperature minus the first of the common time with the camera, of a faulty sensor the last before its fault, K."""
    camera_rise_K: Number
    """The camera's rise of the cell at its place over its own common time, K; null without a camera or where the cell is not seen."""
    used: bool
    """Whether it takes part in what is calculated; a faulty one does not."""
    fault: str
    """What is wrong with it, in words; empty where it is sound."""
    fault_time: str | None
    """From when on, UTC; null where it is sound."""


# What a compensation table is predicted to leave, as it is stored beside the table.

#: What the name of the file adds to that of the table.
PREDICTION_ENDING = ".prediction.json"


class TablePredictionError(FusionError):
    """A prediction that cannot be read; the message names the file and what to do."""


#: Positions in mm and corrections in um are below it.
_LARGEST_IN_TABLE = 1e5


class TablePrediction(ResultPart):
    """Values by ISO 230-2 that a test of the same axis with an active table is predicted to show."""

    schema_version: Literal[2] = 2
    """Version of this layout."""
    table: str
    """Name of the file of the table."""
    campaign: str
    """Title of the test that the table was made from."""
    results_sha256: str
    """SHA-256 of its results.json."""
    cycles: int
    """Cycles of the test that is predicted."""
    position_mm: tuple[float, ...]
    """Points of the table, mm."""
    correction_um: ByDirection
    """What the table takes out of the deviations at its points, beyond one that was active during the test of the campaign, um."""
    predicted_um: Mapping[str, Quantity]
    """A, E, M and B of ISO 230-2, um; their uncertainty is that of table and readings, without what both tests have in common."""
    not_predicted: str = ""
    """Why nothing is predicted; empty where it is."""

    @model_validator(mode="after")
    def _of_an_axis(self) -> TablePrediction:
        """Refuse what no table of an axis holds, as a file that was damaged does."""
        predicted = [number for one in self.predicted_um.values() for number in (one.value, one.u)]
        numbers = [*self.position_mm, *self.correction_um.values(), *filter(None, predicted)]
        if not max(map(abs, numbers), default=0.0) < _LARGEST_IN_TABLE:
            raise ValueError(f"a position, correction or prediction is not below {_LARGEST_IN_TABLE:g}")
        return self

    def correction_at(self, position_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the table takes out by the positive and by the negative approach, um, at positions (n,), mm."""
        sides = (self.correction_um.positive, self.correction_um.negative)
        forward, reverse = (np.interp(position_mm, self.position_mm, np.array(one, float)) for one in sides)
        return forward, reverse


def read_table_prediction(path: Path) -> TablePrediction:
    """Read the prediction of a table; either file may be named."""
    file = path if path.name.endswith(PREDICTION_ENDING) else path.with_name(path.name + PREDICTION_ENDING)
    try:
        return TablePrediction.model_validate(read_json(file))
    except FileNotFoundError:
        raise TablePredictionError(
            f"{file} is missing; name the table that was loaded, as thermofuse export wrote it with its prediction beside it"
        ) from None
    except (OSError, ValueError) as error:
        raise TablePredictionError(
            f"{file}: is damaged or no prediction of a table ({type(error).__name__}); export the table again"
        ) from None


# The part ``iso230_3``: distortion by temperature over the test.

TestKind = Literal["environment", "spindle", "linear axis", "rotary axis", "not stated"]


class ThermalCourse(ResultPart):
    """A quantity over time, thinned."""

    name: str
    """Name of the displacement, tilt or sensor."""
    unit: str
    """Unit: um, um/m, arcsec or degC."""
    hours: tuple[float, ...]
    """Time since the start of the test, h."""
    values: tuple[Number, ...]
    """Temperatures; of everything else the change since the first value."""


class ThermalDistortion(ResultPart):
    """How far a displacement, a tilt or a temperature moved: largest minus smallest value, in its unit."""

    name: str
    """Name."""
    unit: str
    """Unit: um, um/m, arcsec or K."""
    first_hour: Quantity
    """Over the first 60 min; null of a shorter test."""
    whole: Quantity
    """Over the whole test."""
    last_hour: Quantity
    """Over the last 60 min; null of a shorter test."""
    change: Quantity
    """Last value less the first."""
    settling_min: Number
    """Time after which it stays within a tenth of its range about its mean of the last 60 min; null where it does not for two hours at
    least."""


class ThermalContribution(ResultPart):
    """A source of the uncertainty of one quantity over the whole test."""

    name: str
    """Displacement or tilt."""
    source: str
    """Name of the source."""
    u: Number
    """Contribution to the standard uncertainty, in the unit of the quantity; null where it is not known, and then it is not contained."""
    origin: str
    """Whether it was stated, assumed or measured, and how."""


class ThermalTest(ResultPart):
    """A test by ISO 230-3."""

    run: str = ""
    """Run of the record; absent where there is one."""
    kind: TestKind
    """Which of the four tests."""
    duration_h: Number
    """Length of the test, h."""
    distortions: tuple[ThermalDistortion, ...]
    """Displacements and tilts."""
    temperatures: tuple[ThermalDistortion, ...]
    """Temperatures."""
    contributions: tuple[ThermalContribution, ...]
    """Budget of the distortions over the whole test."""
    courses: tuple[ThermalCourse, ...]
    """Displacements, tilts and temperatures over time."""
    remarks: tuple[str, ...]
    """What is computed where no open text states a definition, and what was not evaluated."""
    conditions: tuple[Iso230Condition, ...] = ()
    """Whose test of which machine it was, with what, and under which conditions."""
