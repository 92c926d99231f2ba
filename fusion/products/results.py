"""results.json as typed models: every finding of a run, its unit, and the JSON Schema that is made from them.

The parts are in `results_axis`, `results_attribution` and `results_loop`. A number is None (``null`` in the file) where the data do not
determine it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag, ValidationError

from fusion.errors import FusionError
from fusion.products.results_attribution import CorrelationPart, DutyPart, SourcePart
from fusion.products.results_axis import (
    CAUSES,
    AlignmentPart,
    AnomalyPart,
    CameraPart,
    DriftPart,
    HotspotPart,
    Iso230Part,
    NeighboursPart,
    RegistrationPart,
)
from fusion.products.results_inputs import InputsPart
from fusion.products.results_loop import (
    AxisLoop,
    Coefficient,
    Loop,
    RecordLoop,
    ResidualPart,
    StepPart,
    Unexplained,
    Verdict,
)
from fusion.products.results_part import ByDirection, Number, Quantity, ResultPart, TimePart
from fusion.products.results_radiometry import ContactSensorPart, FieldPart, RadiometryPart
from fusion.products.store import Product, plain, require_own

__all__ = [
    "CAUSES",
    "AnomalyPart",
    "AxisLoop",
    "ByDirection",
    "Coefficient",
    "CorrelationPart",
    "DriftPart",
    "DutyPart",
    "Iso230Part",
    "Loop",
    "Notice",
    "Outcome",
    "Quantity",
    "RecordLoop",
    "ResidualPart",
    "Results",
    "ResultsError",
    "SourcePart",
    "StepPart",
    "Unexplained",
    "Verdict",
    "assemble",
    "read_results",
    "results_schema",
]

SCHEMA_VERSION = 2
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
    effect_um: Annotated[Number, Field(description="Size of the effect on the drift, um; null where not known.")] = None


class PluginPart(ResultPart):
    """An effect that another installed distribution added."""

    name: str
    """Name of its entry point."""
    origin: str
    """Module and object."""
    distribution: str
    """Installed distribution that brought it."""
    version: str
    """Version of that distribution."""


def _loop_tag(loop: Any) -> str:
    """Return which loop a value is, so that a fault is reported against that one model: only a record has channels."""
    keys = loop if isinstance(loop, Mapping) else type(loop).model_fields if isinstance(loop, ResultPart) else ()
    return "record" if "channels" in keys else "axis"


class Results(ResultPart):
    """results.json of a run; a part that a campaign does not have is absent."""

    model_config = ConfigDict(title="thermofuse results")

    schema_version: Literal[2] = Field(alias="schema")
    """Version of this layout."""
    campaign: str
    """Title of the campaign."""
    warnings: tuple[Notice, ...]
    """Everything that was left out, is doubtful, or was not possible."""
    plugins: tuple[PluginPart, ...] = ()
    """Effects of other distributions that took part in the run."""
    inputs: InputsPart | None = None
    """Consistency of the inputs."""
    time: TimePart | None = None
    """When the readings were taken; absent where the campaign states no time of day."""
    registration: RegistrationPart | None = None
    """Registration of the thermograms to the plan."""
    camera: CameraPart | None = None
    """The thermal camera: damaged frames and corrections."""
    radiometry: RadiometryPart | None = None
    """Uncertainty of temperatures and rises."""
    field: FieldPart | None = None
    """The temperature fields in short."""
    sensors: tuple[ContactSensorPart, ...] | None = None
    """Contact sensors on the table."""
    alignment: AlignmentPart | None = None
    """Both instruments on one clock."""
    iso230: Iso230Part | None = None
    """Axis values by ISO 230-2."""
    neighbours: NeighboursPart | None = None
    """Neighbour differences."""
    drift: DriftPart | None = None
    """Joint estimate of profile and drift."""
    anomalies: tuple[AnomalyPart, ...] | None = None
    """Targets that stand out."""
    hotspots: tuple[HotspotPart, ...] | None = None
    """Places that warm more than their surroundings."""
    correlation: CorrelationPart | None = None
    """Attribution of the drift to parts of the field."""
    loop: (
        Annotated[Annotated[AxisLoop, Tag("axis")] | Annotated[RecordLoop, Tag("record")], Discriminator(_loop_tag)]
        | None
    ) = None
    """Closed loop."""

    def as_json(self) -> dict[str, Any]:
        """Return the content of results.json in JSON's own types; parts and keys that were never set are absent."""
        return self.model_dump(mode="json", exclude_unset=True)


def assemble(title: str, parts: Mapping[str, Any], warnings: Sequence[Notice]) -> Results:
    """Return the results of a run from what the stages found, checked against the models.

    Parameters
    ----------
    title : str
        Title of the campaign.
    parts : mapping
        Parts of results.json by key, as in `Results`; NumPy values are allowed, a number that is not finite becomes None.
    warnings : sequence of Notice
        Everything that was left out.

    Raises
    ------
    pydantic.ValidationError
        If a part does not keep its model: a fault of the stage that made it.
    """
    notices = [asdict(notice) for notice in warnings]
    return Results.model_validate(plain({"schema": SCHEMA_VERSION, "campaign": title, "warnings": notices, **parts}))


def read_results(folder: Path) -> Results:
    """Read ``results.json`` of a results folder.

    Parameters
    ----------
    folder : Path
        Results folder of a finished run.

    Raises
    ------
    ResultsError
        If the file is absent, is not JSON, or was written by another version.
    DamagedProductError
        If it is not what the run of the folder wrote.
    """
    path = folder / "results.json"
    if not path.is_file():
        raise ResultsError(f"{folder}: there is no results.json in it; name the results folder of a finished run")
    try:
        results = Results.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        raise _foreign(path, _first_fault(error)) from None
    # Also bytes that are no text, numbers of thousands of digits, and brackets without end.
    except (ValueError, RecursionError) as error:
        raise _foreign(path, f"not JSON: {error}") from None
    require_own(folder, [path.name])
    return results


def _foreign(path: Path, fault: str) -> ResultsError:
    """Return the error of a file that this version did not write."""
    return ResultsError(f"{path}: not the results of this version of thermofuse ({fault}); run the campaign again")


def _first_fault(error: ValidationError) -> str:
    """Return the first fault with its place in the file, and how many there are."""
    if error.error_count() > _MOST_FAULTS:
        return f"{error.error_count()} values are not what they should be"
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    # The tag that a loop was told apart by follows its key and is no place in the file.
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
    dataset : Dataset or DataTree
        Its product.
    parts : dict
        Its parts of results.json by key, as in `Results`.
    notices : tuple of Notice
        What it left out.
    """

    dataset: Product
    parts: dict[str, Any]
    notices: tuple[Notice, ...] = ()
