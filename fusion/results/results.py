"""results.json as typed models: every finding of a run, its unit, and the JSON Schema that is made from them.

The parts are in `fusion.results.parts`, `axis` and `loop`. A number is None (``null`` in the file) where the data do not
determine it.
"""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationError

from fusion.common import FusionError
from fusion.results import axis, parts
from fusion.results.loop import AxisLoop, RecordLoop
from fusion.results.numbers import measured, p_words, print_unit
from fusion.results.store import Product, plain, read_json, require_own
from thermofuse.resources import vocabulary

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA_VERSION = 4
#: Parts that earlier versions wrote in pixels where a camera measured alone; every picture is evaluated instead.
_OF_A_PICTURE = ("registration", "camera", "radiometry", "field", "hotspots")
#: Keys of schema 2 and earlier that have another name now.
RENAMED_KEYS = vocabulary("renamed")["keys"]
#: The same for the tests of the residual, the keys of ``p_values``.
RENAMED_TESTS = vocabulary("renamed")["tests"]
_UNKNOWN_APPROACH = {f"{name}_um": {"value": None, "u": None} for name in "ARE"}
#: What the first results by ISO 230-2 lack, which hold one window without its budget.
_WITHOUT_BUDGET: dict[str, Any] = {
    "cycles": [],
    "positive": _UNKNOWN_APPROACH,
    "negative": _UNKNOWN_APPROACH,
    "u_without_sampling_um": {},
    "contributions": [],
}
#: Earlier results name a condition by its words alone; keys that differ from those words.
_CONDITIONS = vocabulary("renamed")["conditions"]
#: Objects whose keys are names of a campaign: fiducials and channels.
_NAMED_BY_THE_CAMPAIGN = ("leave_one_out_mm", "channels", "rms_by_channel_um")
#: Faults of a file of which the first is named: each one that is written out takes a kilobyte.
_MOST_FAULTS = 1_000
#: Characters of the place of a fault: a key may be as long as the file.
_LONGEST_PLACE = 200


class ResultsError(FusionError):
    """A results.json that this version cannot read; the message names the file and what to do."""


@dataclass(frozen=True)
class Notice:
    """Something left out or doubtful: what it is, by how much it may move the result, and what to do about it."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    code: Annotated[str, Field(description="Short name, for programs.")]
    message: Annotated[str, Field(description="One sentence with counts and names, for people.")]
    remedy: Annotated[str, Field(description="What would remove the warning; empty where nothing has to be done.")]
    effect_um: Annotated[
        parts.Number, Field(description="Size of the effect on the drift, um; null where not known.")
    ] = None

    @classmethod
    def of(cls, words: str, *, code: str = "", effect_um: float | None = None, **facts: object) -> Notice:
        """Return the notice whose words stand in ``data/vocabulary/notices.toml`` by its code, with the facts of a run."""
        said = vocabulary("notices")[words]
        message, remedy = (said.get(part, "").format(effect_um=effect_um, **facts) for part in ("message", "remedy"))
        return cls(code or words, message, remedy, effect_um)


def _loop_tag(loop: Any) -> str:
    """Return which loop a value is, so that a fault is reported against that one model: only a record has channels."""
    keys = loop if isinstance(loop, Mapping) else type(loop).model_fields if isinstance(loop, parts.ResultPart) else ()
    return "record" if "channels" in keys else "axis"


class _Heading(parts.ResultPart):
    """What every results.json begins with."""

    schema_version: Literal[4] = Field(alias="schema")
    """Version of this layout."""
    campaign: str
    """Title of the campaign."""
    warnings: tuple[Notice, ...]
    """Everything that was left out, is doubtful, or was not possible."""


class Parts(parts.ResultPart):
    """What the stages of a run find, set one after the other; a part that a campaign does not have is never set."""

    model_config = ConfigDict(frozen=False)

    plugins: tuple[parts.PluginPart, ...] = ()
    """Effects of other distributions that took part in the run."""
    inputs: parts.InputsPart | None = None
    """Consistency of the inputs."""
    time: parts.TimePart | None = None
    """When the readings were taken; absent where the campaign states no time of day."""
    thermograms: parts.ThermogramsPart | None = None
    """Pictures of a camera that measures alone."""
    regions: tuple[parts.TemperatureRegionPart, ...] | None = None
    """Temperatures of the whole picture and of regions in it, by camera; beside a laser only where regions are stated or stored."""
    registration: axis.RegistrationPart | None = None
    """Registration of the thermograms to the plan."""
    camera: axis.CameraPart | None = None
    """The thermal camera: damaged frames and corrections."""
    radiometry: parts.RadiometryPart | None = None
    """Uncertainty of temperatures and rises."""
    field: parts.FieldPart | None = None
    """The temperature fields in short."""
    sensors: tuple[parts.ContactSensorPart, ...] | None = None
    """Contact sensors on the table."""
    alignment: axis.AlignmentPart | None = None
    """Both instruments on one clock."""
    iso230: axis.Iso230Part | None = None
    """Axis values by ISO 230-2."""
    iso230_3: tuple[parts.ThermalTest, ...] | None = None
    """Distortion by temperature, by ISO 230-3: of every run of a record, or of a linear axis."""
    neighbours: axis.NeighboursPart | None = None
    """Neighbour differences."""
    drift: axis.DriftPart | None = None
    """Joint estimate of profile and drift."""
    anomalies: tuple[axis.AnomalyPart, ...] | None = None
    """Targets that stand out."""
    hotspots: tuple[axis.HotspotPart, ...] | None = None
    """Places that warm more than their surroundings."""
    correlation: axis.CorrelationPart | None = None
    """Attribution of the drift to parts of the field."""
    loop: (
        Annotated[Annotated[AxisLoop, Tag("axis")] | Annotated[RecordLoop, Tag("record")], Discriminator(_loop_tag)]
        | None
    ) = None
    """Closed loop."""

    def take(self, more: Parts) -> None:
        """Set all that other parts hold, as results.json would hold it: a number that is not determined is None."""
        for name, part in Parts.model_validate(plain(more)):
            if name in more.model_fields_set:
                setattr(self, name, part)


@dataclass(frozen=True)
class Report:
    """The report of a run, one file; a notebook shows it in a frame."""

    path: Path

    def _repr_html_(self) -> str:
        page = escape(self.path.read_text(encoding="utf-8"), quote=True)
        return f'<iframe srcdoc="{page}" title="report" style="width: 100%; height: 45rem"></iframe>'

    def open_in_browser(self) -> None:
        """Open the report in the browser of the system."""
        webbrowser.open(self.path.resolve().as_uri())


class Results(Parts, _Heading):
    """results.json of a run; a part that a campaign does not have is absent."""

    model_config = ConfigDict(title="thermofuse results", frozen=True)
    _folder: ClassVar[Path | None] = None

    def __str__(self) -> str:
        return "\n".join(f"{name}: {text}" for name, text in self._summary())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._summary())
        return f"<table>{''.join(rows)}</table>"

    def of_folder(self, folder: Path) -> Results:
        """Return itself as the results of a folder."""
        object.__setattr__(
            self, "_folder", folder.resolve()
        )  # no part of the content: equal results are equal in any folder
        return self

    def report(self) -> Report:
        """Return report.html of the run: shown in a notebook, and opened by its `open_in_browser`."""
        if self._folder is None or not (self._folder / "report.html").is_file():
            raise ResultsError(f"{self.campaign}: there is no report.html; read the results of a run by read_results")
        return Report(self._folder / "report.html")

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the errors of the closed loop on the hold-out set; see `fusion.results.plots.plot_loop`."""
        from fusion.results.plots import plot_loop

        if self.loop is None:
            raise ResultsError(
                f"{self.campaign}: there is no closed loop to plot; the products beside the results have plots"
            )
        return plot_loop(self.loop, ax)

    def _summary(self) -> list[tuple[str, str]]:
        """Return names and figures of what was found, in short; sentences, conditions and remedies are the report's."""
        rows = [("campaign", self.campaign)]
        if self.inputs is not None:
            doubts = ", ".join(check.code for check in self.inputs.doubts)
            rows.append(("inputs", f"{self.inputs.state}{f' ({doubts})' if doubts else ''}"))
        if self.iso230 is not None:
            unit, side = print_unit(self.iso230.unit), self.iso230.approach
            of_side = self.iso230 if side is None else getattr(self.iso230, side)
            values = {name: getattr(of_side, f"{name}_um") for name in ("ARE" if side else "ARBEM")}
            told = ", ".join(f"{name} {measured(one.value, one.u, unit)}" for name, one in values.items())
            from_side = f", {side} approach" if side else ""
            rows.append(("ISO 230-2 (k = 2)", f"{self.iso230.window}{from_side}: {told}"))
        if self.anomalies is not None:
            named = (
                f"position {one.target}: {one.cause}, {p_words(one.p_value, one.p_resolution)}"
                for one in self.anomalies
            )
            rows.append(("anomalies", "; ".join(named) or "none"))
        if self.loop is not None:
            rows += self.loop.rows()
        return [*rows, ("warnings", str(len(self.warnings)))]

    def as_json(self) -> dict[str, Any]:
        """Return the content of results.json in JSON's own types; parts and keys that were never set are absent."""
        return self.model_dump(mode="json", exclude_unset=True)


def assemble(title: str, parts: Parts | Mapping[str, Any], warnings: Sequence[Notice]) -> Results:
    """Return the results of a run from what the stages found, checked against the models."""
    notices = [asdict(notice) for notice in warnings]
    return Results.model_validate({"schema": SCHEMA_VERSION, "campaign": title, "warnings": notices, **plain(parts)})


def read_results(folder: str | Path) -> Results:
    """Read the results of a finished run.

    Parameters
    ----------
    folder : str or Path
        The results folder, or the ``results.json`` in it.

    Returns
    -------
    Results
        The content of its ``results.json``, as `run_campaign` returned it.

    Raises
    ------
    ResultsError
        The folder holds no results, or those of another version.

    Notes
    -----
    The products beside them are NetCDF. ``xarray.open_datatree("results/deviations.nc")`` holds the readings, and in groups what functions
    return: ``["estimate"]`` is the Dataset of `estimate_drift`, ``["quoted"]`` that of the ISO 230-2 window in the report.

    Examples
    --------
    >>> read_results("results").loop.verdict  # doctest: +SKIP
    'explained'
    """
    folder = Path(folder)
    path = folder / "results.json"
    if folder.name == path.name and folder.is_file():
        folder, path = folder.parent, folder
    if not path.is_file():
        raise ResultsError(f"{folder}: there is no results.json in it; name the results folder of a finished run")
    try:
        content = read_json(path, constant=_refuse_constant)
        results = Results.model_validate(in_this_schema(content))
    except ValidationError as error:
        raise _foreign(path, _first_fault(error)) from None
    # Also bytes that are no text, and numbers of thousands of digits.
    except ValueError as error:
        raise _foreign(path, f"not JSON: {error}") from None
    require_own(folder, [path.name])
    return results.of_folder(folder)


def in_this_schema(content: Any) -> Any:
    """Return the content of a results.json with the keys of this schema."""
    registration = content.get("registration") if isinstance(content, dict) else None
    if isinstance(registration, dict) and registration.get("model") == "picture":
        content = {name: part for name, part in content.items() if name not in _OF_A_PICTURE}
    if not isinstance(content, dict) or content.get("schema") not in range(1, SCHEMA_VERSION):
        return content
    renamed = {**_renamed(content), "schema": SCHEMA_VERSION}
    if isinstance(iso230 := renamed.get("iso230"), dict):
        renamed["iso230"] = _quoted_on_top(iso230)
    return renamed


def _quoted_on_top(iso230: dict[str, Any]) -> dict[str, Any]:
    """Return the part ``iso230`` of schema 3 and earlier, whose top is the first window, with the quoted window at its top."""
    quoted = iso230.get("settled") or iso230.get("first") or _WITHOUT_BUDGET
    if not isinstance(quoted, dict):
        return iso230
    return {name: value for name, value in iso230.items() if name != "settled"} | quoted


def _renamed(part: Any, key: str = "") -> Any:
    """Return a part of results.json, which stands under a key, with the keys of this schema."""
    if isinstance(part, list):
        return [_renamed(one, key) for one in part]
    if not isinstance(part, dict):
        return part
    if key == "conditions" and isinstance(name := part.get("name"), str):
        known = "instrument" if name.startswith("Instrument") else name.lower().replace(" ", "_")
        part = {"key": _CONDITIONS.get(name, known), **part}
    if "rmse_um" in part:
        # The spread of an error within its own hold-out set was no interval of the error.
        part = {name: value for name, value in part.items() if name not in ("low_um", "high_um")}
    names = RENAMED_TESTS if key == "p_values" else {} if key in _NAMED_BY_THE_CAMPAIGN else RENAMED_KEYS
    return {names.get(name, name): _renamed(one, name) for name, one in part.items()}


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _foreign(path: Path, fault: str) -> ResultsError:
    """Return the error of a file that this version did not write."""
    return ResultsError(f"{path}: not the results of this version of thermofuse ({fault}); run the campaign again")


def _first_fault(error: ValidationError) -> str:
    """Return the first fault with its place in the file, and how many there are."""
    if error.error_count() > _MOST_FAULTS:
        return f"{error.error_count()} values are invalid"
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    # The tag that a loop was distinguished by follows its key and is no place in the file.
    keys = [key for level, key in enumerate(first["loc"]) if not (level == 1 and first["loc"][0] == "loop")]
    place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).removeprefix(".")
    others = error.error_count() - 1
    return f"{place[:_LONGEST_PLACE]}: {first['msg']}" + (f", and {others} more" if others else "")


def results_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of results.json, made from the models.

    Returns
    -------
    dict
        Every field with its description and unit; a number is null where the data do not determine it.

    Raises
    ------
    pydantic.PydanticInvalidForJsonSchema
        If a model has a type that JSON Schema cannot express: a fault of the models.

    Notes
    -----
    Draft 2020-12 of JSON Schema, https://json-schema.org/draft/2020-12.

    Examples
    --------
    >>> schema = results_schema()
    >>> schema["title"], schema["required"]
    ('thermofuse results', ['schema', 'campaign', 'warnings'])
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Results.model_json_schema()}


@dataclass(frozen=True)
class Outcome(Generic[Product]):
    """What a stage found.

    Attributes
    ----------
    dataset : its product
    parts : its parts of results.json
    notices : what it left out
    """

    dataset: Product
    parts: Parts
    notices: tuple[Notice, ...] = ()
