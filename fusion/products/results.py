"""results.json as typed models: every finding of a run, its unit, and the JSON Schema that is made from them.

A number is None (``null`` in the file) where the data do not determine it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fusion.errors import FusionError
from fusion.products.store import Product, plain

SCHEMA_VERSION = 1
Cause = Literal["structural", "local_temperature", "stick_slip", "step", "undetermined"]
Direction = Literal["positive", "negative", "both"]
Attribution = Literal["attributable", "not attributable", "not separable"]
Verdict = Literal["complete", "explained", "partial", "unexplained"]
CAUSES: tuple[Cause, ...] = get_args(Cause)

Number = float | None
#: Value of a parameter of an effect: a number in the unit that its name ends with, or a word.
Parameter = float | int | str
#: Range of a parameter that fits as well: its ends (None where the data set none), or the other words.
Range = tuple[Number, ...] | tuple[str, ...]


class ResultsError(FusionError):
    """A results.json that this version cannot read; the message names the file and what to do."""


class _Part(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, serialize_by_alias=True, allow_inf_nan=False
    )


@dataclass(frozen=True)
class Notice:
    """Something left out or doubtful: what it is, by how much it may move the result, and what to do about it."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    code: Annotated[str, Field(description="Short name, for programs.")]
    message: Annotated[str, Field(description="One sentence with counts and names, for people.")]
    remedy: Annotated[str, Field(description="What would remove the warning; empty where nothing has to be done.")]
    effect_um: Annotated[Number, Field(description="Size of the effect on the drift, um; null where not known.")] = None


class Quantity(_Part):
    """A measured value with its standard uncertainty."""

    value: Number
    """Estimate, in the unit that the key ends with."""
    u: Number
    """Standard uncertainty (k = 1), same unit; null where it is not known."""


class ByDirection(_Part):
    """One value per target for each direction of approach; a direction that was not measured is absent."""

    positive: tuple[Number, ...] = ()
    """Values of the approach in positive direction, in the order of the targets."""
    negative: tuple[Number, ...] = ()
    """Values of the approach in negative direction, in the order of the targets."""

    def values(self) -> list[float]:
        """Return the values of both directions that are determined."""
        return [value for value in (*self.positive, *self.negative) if value is not None]


class RejectedFrame(_Part):
    """A thermogram that was not used."""

    file: str
    """File, relative to the campaign file."""
    index: int
    """Number of the frame in its file, from 0."""
    reason: str
    """Why it was not used."""


class RegistrationPart(_Part):
    """Registration of the thermograms to the plan."""

    rms_mm: Number
    """Root mean square of the registration residuals of the fiducials, mm."""
    leave_one_out_mm: Mapping[str, Number]
    """Distance by which each fiducial is missed when it takes no part in the registration, mm, by name."""
    frames_rejected: tuple[RejectedFrame, ...]
    """Thermograms that were not used."""


class AlignmentPart(_Part):
    """Both instruments on one clock."""

    clock_offset_s: Quantity
    """Camera clock minus laser clock, s; u is 0 where the campaign states the offset and null where it is assumed."""


class Iso230Part(_Part):
    """Axis values by ISO 230-2:2014, clause 4, of one window of cycles."""

    window: str
    """Cycles that were evaluated."""
    B_um: Quantity
    """Reversal error B of the axis, um."""
    R_um: Quantity
    """Bidirectional positioning repeatability R, um."""
    E_um: Quantity
    """Bidirectional systematic positioning error E, um."""
    M_um: Quantity
    """Mean bidirectional positioning error M, um."""
    A_um: Quantity
    """Bidirectional positioning accuracy A, um."""


class NeighboursPart(_Part):
    """Standard deviations of neighbour differences beside the conventional ones, per link from one target to the next."""

    conventional_s_um: ByDirection
    """Conventional standard deviation (n - 1), drift included, um."""
    pair_s_um: ByDirection
    """Standard deviation of the differences between neighbouring targets (n - 1), um."""
    ratio: ByDirection
    """Conventional standard deviation over that of the differences, 1."""


class DriftPart(_Part):
    """Joint estimate of profile and drift, per target."""

    profile_um: ByDirection
    """Positioning deviation without drift, at the mean thermal state of the test, um."""
    profile_u_um: ByDirection
    """Standard uncertainty of the profile, um."""
    scatter_um: ByDirection
    """Standard deviation of a reading after profile and drift were subtracted, um."""


class Evidence(_Part):
    """What the cause of an anomaly rests on."""

    kind: Literal["scatter", "slow", "step", "periodic"]
    """What stands out."""
    extra_um: Number
    """Size of what stands out beyond the other targets, um."""
    probability: Number
    """Probability of the leading explanation among those that were compared."""
    support: tuple[str, ...] = Field(alias="for")
    """Sentences for the leading explanation."""
    against: tuple[str, ...]
    """Sentences against it, the runner-up first."""
    check: str
    """What to inspect on the machine."""
    probability_structural: Number
    """Probability of scatter of the structure."""
    probability_stick_slip: Number
    """Probability of stick-slip."""
    probability_slow: Number
    """Probability of a slow motion without a known cause."""
    probability_step: Number
    """Probability of one step."""
    probability_local_temperature: Number = None
    """Probability of a local temperature; absent where the camera does not see the target."""
    scatter_typical_um: Number
    """Median scatter of the other targets, um."""
    scatter_positive_um: Number
    """Scatter of the approach in positive direction, um."""
    scatter_negative_um: Number
    """Scatter of the approach in negative direction, um."""
    serial_p: Number
    """p-value of the order of the readings in time."""
    approach_gain_nats: Number
    """Gain in log-likelihood of an effect bound to the direction of approach, nats."""
    step_p: Number
    """p-value of one step (parametric bootstrap)."""
    step_um: Number
    """Height of the step, um."""
    step_u_um: Number
    """Standard uncertainty of the height, um."""
    step_cycle: int
    """First cycle after the step."""
    step_held_out_nats: Number
    """Gain of the step on the direction that it was not fitted to, nats."""
    temperature_p: Number = None
    """p-value of the local temperature (parametric bootstrap)."""
    temperature_um_per_K: Number = None
    """Displacement per local rise, um/K."""
    temperature_u_um_per_K: Number = None
    """Standard uncertainty of the displacement per rise, um/K."""
    temperature_lag_s: Number = None
    """Time constant between local rise and displacement, s."""
    temperature_held_out_nats: Number = None
    """Gain of the local temperature on the direction that it was not fitted to, nats."""
    temperature_warm_up_share: Number = None
    """Share of the local rise that one warm-up curve explains, 1."""

    def numbers(self) -> dict[str, float | int | None]:
        """Return the numbers that the diagnosis states, by name."""
        sentences = {"kind", "support", "against", "check"}
        return {name: value for name, value in self if name in self.model_fields_set - sentences}


class AnomalyPart(_Part):
    """A target that stands out from the others."""

    target: int = Field(ge=1)
    """Target number, from 1."""
    direction: Direction
    """Direction of approach that stands out."""
    p_value: Number
    """p-value, family-wise over all targets and both directions."""
    scatter_um: Number
    """Standard deviation of its readings after profile and drift were subtracted, um."""
    cause: Cause
    """Cause, ``undetermined`` where the data do not decide."""
    evidence: Evidence
    """What the cause rests on."""


class HotspotPart(_Part):
    """A place that warms more than its surroundings."""

    x_mm: Number
    """Place of the peak on the plan, x, mm."""
    y_mm: Number
    """Place of the peak on the plan, y, mm."""
    peak_rise_K: Number
    """Rise of the peak since the first cycle, K."""
    targets: tuple[int, ...]
    """Targets whose drift follows it."""
    p_value: Number
    """p-value of its strongest part of the drift, family-wise over everything that was tested."""
    lag_s: Number
    """Time constant between its temperature and the drift, s."""


class SourcePart(_Part):
    """The leading candidate for the source of the drift."""

    kind: Literal["mode", "cell", "region"]
    """Thermal mode, cell of the plan, or region."""
    name: str
    """Number of the mode or name of the region; empty for a cell."""
    part: str
    """Part of the drift that follows it: common, proportional, reversal, joint."""
    x_mm: Number
    """Place on the plan, x, mm."""
    y_mm: Number
    """Place on the plan, y, mm."""
    p_value: Number
    """p-value, family-wise over everything that was tested."""
    sensitivity_um_per_K: Quantity
    """Drift per rise, um/K, at the far end of travel for the parts that grow along the axis."""
    lag_s: Number
    """Time constant between temperature and drift, s."""
    detectable_um_per_K: Number
    """Detection limit at 80 % power, um/K."""
    equal_places_mm: tuple[tuple[Number, Number], ...]
    """Other places (x, y) that explain the drift as well, mm."""


class TestedPart(_Part):
    """What one mode or region shows in one part of the drift."""

    __test__ = False

    p_value: Number
    """p-value, family-wise over everything that was tested."""
    sensitivity_um_per_K: Quantity
    """Drift per rise, um/K."""
    lag_s: Number
    """Time constant between temperature and drift, s."""
    detectable_um_per_K: Number
    """Detection limit at 80 % power, um/K."""
    p_beside_leader: Number = None
    """p-value beside the leading mode; modes only."""


class PlacePart(_Part):
    """A thermal mode or a region as a candidate for the source."""

    name: str
    """Name."""
    x_mm: Number
    """Place on the plan, x, mm."""
    y_mm: Number
    """Place on the plan, y, mm."""
    parts: Mapping[str, TestedPart]
    """Test results by part of the drift."""


class SensorSetPart(_Part):
    """One number of contact sensors: the sensor that it adds, and what the set loses beside the camera."""

    x_mm: Number
    """Place of the added sensor, x, mm."""
    y_mm: Number
    """Place of the added sensor, y, mm."""
    loss_um: Number
    """Root mean square that the set loses beside the camera on left-out cycles, um."""
    loss_at_most_um: Number
    """Upper limit of the loss, um."""
    decided: bool
    """Whether the data show that it loses."""


class SensorsPart(_Part):
    """Contact sensors in place of the camera."""

    within_s: Number
    """Length of the runs of left-out cycles, s."""
    camera_gain_um: Number
    """Root mean square that the camera takes out of the drift on left-out cycles, um."""
    camera_gain_decided: bool
    """Whether the data show that the camera takes anything out."""
    sets: tuple[SensorSetPart, ...]
    """Sets of one, two, ... sensors."""


class DutyPart(_Part):
    """A load that was switched at random."""

    name: str
    """Column of the drivers' log."""
    cause: bool
    """Whether randomisation shows that it causes drift."""
    p_value: Number
    """Share of schedules drawn from the same law that the drift follows as closely, family-wise over the loads."""
    drift_at_full_duty_um: Quantity
    """Drift at the far end of travel at full duty, um."""
    time_constants_s: tuple[Number, ...]
    """Time constants of the first and the second body, s; the second is 0 for one body."""


class CorrelationPart(_Part):
    """Attribution of the drift to parts of the temperature field."""

    verdict: Attribution
    """Whether a part of the field is shown to go with the drift."""
    excitation: str
    """How the heat sources were excited."""
    false_alarm_rate: Number
    """Rate of false alarms on simulations without a source, 1."""
    source: SourcePart
    """The leading candidate."""
    would_tell: str
    """Which further test would decide what is open."""
    unexplained_drift_um_per_h: Mapping[str, Number]
    """Random walk in one hour that nothing explains, um, by part of the drift."""
    modes: tuple[PlacePart, ...]
    """Thermal modes."""
    regions: tuple[PlacePart, ...]
    """Regions of the campaign and hotspots."""
    sensors: SensorsPart
    """What contact sensors in place of the camera would lose."""
    randomised_duty: tuple[DutyPart, ...] | None
    """Loads that were switched at random; null where none was."""


class Nothing(_Part):
    """An empty object: there is none."""


class RunnerUp(_Part):
    """The next best effect of a round of the search."""

    effect: str
    """Name of the effect."""
    behind_by: Number
    """Log-likelihood gain beyond chance that it lies behind the chosen effect, nats."""
    p_value: Number
    """Its own p-value, family-wise over the search."""


class Coefficient(_Part):
    """A coefficient of an effect, fitted to all cycles."""

    value: Number
    """Estimate."""
    u: Number
    """Standard uncertainty."""
    unit: str
    """Unit of value and uncertainty."""
    prior: Number = None
    """What was expected beforehand; absent where nothing was."""
    prior_u: Number = None
    """Standard uncertainty of what was expected."""


class DeclaredCoefficient(Coefficient):
    """A coefficient of a declared effect."""

    effect: str
    """Name of the effect."""


class StepPart(_Part):
    """An effect that the closed loop added."""

    effect: str
    """Name of the effect."""
    parameters: Mapping[str, Parameter]
    """Parameters; a name ends with its unit."""
    parameter_ranges: Mapping[str, Range]
    """Values of the parameters that fit as well (profile likelihood, 95 %)."""
    p_value: Number
    """p-value that let it in, family-wise over the search."""
    rmse_before_um: Number
    """Root mean square error on the hold-out without it, um."""
    rmse_after_um: Number
    """Root mean square error on the hold-out with it, um."""
    rms_um: Number
    """Root mean square of its contribution, um."""
    tied: tuple[str, ...]
    """Effects that these data cannot tell from it."""
    runner_up: RunnerUp | Nothing
    """The next best effect."""
    confirmed: str
    """How it was confirmed."""


class AxisStep(StepPart):
    """An effect that the closed loop added along an axis."""

    coefficients: tuple[Coefficient, ...]
    """Coefficients of its columns."""
    held_out_p: Number
    """p-value of its gain on readings that its coefficients were not fitted to."""
    event_cycle: int | None
    """Cycle in which an event happened; null for an effect that is no event."""


class RecordStep(StepPart):
    """An effect that the closed loop added on a record."""

    rms_by_channel_um: Mapping[str, Number]
    """Root mean square of its contribution, um, by channel."""
    chained_rmse_before_um: Number
    """Error of the forward-chained parts before it, um."""
    chained_rmse_after_um: Number
    """Error of the forward-chained parts with it, um."""
    rejected: Mapping[str, str]
    """Effects of the same round that were rejected, with the reason."""
    event_s: Number
    """Instant of an event, s from the start; null for an effect that is no event."""


class Unexplained(_Part):
    """Structure that the final model leaves."""

    shape: str
    """What it looks like; empty where nothing is left."""
    rms_um: Number
    """Its root mean square, um."""
    p_value: Number
    """p-value of any structure in the residual, family-wise over the shapes."""
    nearest: str
    """Effect that comes closest to it; empty where none does."""


class AxisUnexplained(Unexplained):
    """Structure that the final model leaves along an axis."""

    nearest_p: Number
    """p-value of the nearest effect in the search."""
    nearest_share: Number
    """Share of the structure that the nearest effect explains, 1."""


class RecordUnexplained(Unexplained):
    """Structure that the final model leaves of a record."""

    p_values: Mapping[str, Number]
    """p-value by shape, each shape by itself."""
    variance_share: Number
    """Share of the displacements' variance on the hold-out that is left, mean over the channels, 1."""


class Nuisance(_Part):
    """Drift that the model lets wander beside profile and effects."""

    kind: Literal["random walk", "integrated random walk"]
    """Stochastic model of this drift."""
    common_rms_um: Number
    """Root mean square of the part that all targets share, um."""
    stretch_rms_um: Number
    """Root mean square of the stretch at the far end of travel, um."""
    common_um_per_sqrt_h: Number = None
    """Process noise of the common part of a random walk, um/sqrt(h)."""
    stretch_um_per_sqrt_h: Number = None
    """Process noise of the stretch of a random walk, um/sqrt(h)."""
    common_um_in_1_h: Number = None
    """What the common part of an integrated random walk reaches in one hour, um."""
    stretch_um_in_1_h: Number = None
    """What the stretch of an integrated random walk reaches in one hour, um."""


class HoldOutQuestion(_Part):
    """The one question that was put to the hold-out."""

    effect: str
    """Name of the effect."""
    parameters: Mapping[str, Parameter]
    """Parameters; a name ends with its unit."""
    rmse_before_um: Number
    """Root mean square error on the hold-out without it, um."""
    rmse_after_um: Number
    """Root mean square error on the hold-out with it, um."""
    p_value: Number
    """p-value of its gain on the hold-out."""
    entered: bool
    """Whether it entered the model."""


class CandidateScore(_Part):
    """Best candidate of one effect in one round of the search."""

    effect: str
    """Name of the effect."""
    parameters: Mapping[str, Parameter]
    """Parameters of the best candidate; empty where none can be told from the model."""
    gain: Number
    """Gain in log-likelihood, nats."""
    excess_gain: Number
    """Gain beyond the mean gain where nothing is missing, nats."""
    p_value: Number
    """p-value of the gain for this effect alone."""
    family_wise_p: Number
    """p-value of the gain, family-wise over the search."""


class AxisScore(CandidateScore):
    """Best candidate of one effect along an axis."""

    held_out_gain: Number
    """Gain on readings that its coefficients were not fitted to, nats."""
    held_out_p: Number
    """p-value of that gain."""
    share_not_separable: Number
    """Share of the candidates that are collinear with the model, 1."""


class RecordScorePart(CandidateScore):
    """Best candidate of one effect on a record."""

    chained_rmse_before_um: Number
    """Error of the forward-chained parts before the round, um."""
    chained_rmse_after_um: Number
    """Error of the forward-chained parts with it, um; null where it was not tried."""
    chosen: bool
    """Whether it entered the model."""
    rejected: str
    """Why it did not enter; empty where it did or was not tried."""


class DetectionLimit(_Part):
    """How large an effect must be to be detected with these readings."""

    effect: str
    """Name of the effect."""
    detectable_um: Number
    """Root mean square detected with 80 % power, median over the candidates, um; null where none can be told from the model."""
    best_um: Number
    """The same for the candidate that is easiest to detect, um."""
    worst_um: Number
    """The same for the candidate that is hardest to detect, um."""
    visible_share: Number
    """Share of the effect's root mean square that profile and declared effects leave, 1."""
    looks_like: tuple[str, ...]
    """Effects that are collinear with what is visible of it."""
    note: str
    """What stands in the way; empty where nothing does."""


class FieldCorrection(_Part):
    """An error of the camera that was taken out of the fields."""

    effect: str
    """``camera_offset`` or ``reflected_source``."""
    text: str
    """What was wrong, in one sentence."""
    size_K: Number
    """Largest size of the error, K."""
    size_u_K: Number
    """Standard uncertainty of the size, K."""
    first_cycle: int
    """First cycle whose field it touches."""


class ResidualPart(_Part):
    """Tests of the residual of one model."""

    p_values: Mapping[str, Number]
    """p-value by shape (permutation test), each shape by itself."""
    drift_common_um: Number
    """Root mean square of the unexplained drift that all targets share, um."""
    drift_stretch_um: Number
    """Root mean square of the unexplained stretch at the far end of travel, um."""
    event_s: Number
    """Instant of the strongest shift, s from the first reading."""
    period_min: Number
    """Period of the strongest rhythm, min."""
    period_is_cycle: bool
    """Whether that period is the cycle's own or a part of it."""


class ResidualTestsPart(_Part):
    """Tests of the residual before and after the closed loop."""

    declared: ResidualPart
    """Residual of the declared model."""
    final: ResidualPart
    """Residual of the final model."""


class Loop(_Part):
    """What the closed loop found, whatever it was closed on."""

    declared: tuple[str, ...]
    """Declared effects."""
    held_out: str
    """What was held out."""
    noise_floor_um: Number
    """Standard deviation of a single reading or block mean that no model explains, um."""
    rmse_persistence_um: Number
    """Root mean square error on the hold-out of repeating the last value, um."""
    rmse_declared_um: Number
    """Root mean square error on the hold-out of the declared model, um."""
    rmse_final_um: Number
    """Root mean square error on the hold-out of the final model, um."""
    steps: tuple[StepPart, ...]
    """Effects that were added, in turn."""
    verdict: Verdict
    """complete: nothing lacks; explained: effects were added, nothing is left; partial: something is left; unexplained: no effect fits."""
    unexplained: Unexplained
    """What is left."""
    not_tried: Mapping[str, str]
    """Effects that were not tried, with the reason."""
    blocked: Mapping[str, str]
    """Effects that were tried and not admitted, with the reason."""


class AxisLoop(Loop):
    """What the closed loop found along an axis."""

    declared_coefficients: tuple[DeclaredCoefficient, ...]
    """Coefficients of the declared effects."""
    steps: tuple[AxisStep, ...]
    """Effects that were added, in turn."""
    unexplained: AxisUnexplained
    """What is left."""
    nuisance: Nuisance
    """Drift without a cause in the final model."""
    sealed_question: HoldOutQuestion | Nothing
    """The one question that was put to the hold-out."""
    search: tuple[tuple[AxisScore, ...], ...]
    """Scores of every round of the search."""
    identifiability: tuple[DetectionLimit, ...]
    """Detection limits of the effects."""
    field_corrections: tuple[FieldCorrection, ...]
    """Errors of the camera that were taken out of the fields."""
    residual_tests: ResidualTestsPart
    """Tests of the residual."""


class ChannelErrors(_Part):
    """Errors of one channel of a record on the hold-out."""

    rmse_persistence_um: Number
    """Root mean square error of repeating the last value, um."""
    rmse_declared_um: Number
    """Root mean square error of the declared model, um."""
    rmse_final_um: Number
    """Root mean square error of the final model, um."""
    noise_um: Number
    """Standard deviation of a block mean that no model explains, um."""
    variance_share: Number
    """Share of the displacement's variance on the hold-out that is left, 1."""


class ChainedPart(_Part):
    """One part of a record, predicted by the whole procedure on the time before it; errors are means over the channels."""

    first_h: Number
    """Start of the part, h."""
    last_h: Number
    """End of the part, h."""
    effects: tuple[str, ...]
    """Effects found before it."""
    rmse_persistence_um: Number
    """Root mean square error of repeating the last value, um."""
    rmse_declared_um: Number
    """Root mean square error of the declared model, um."""
    rmse_final_um: Number
    """Root mean square error of the final model, um."""


class RecordLoop(Loop):
    """What the closed loop found on a record; errors are means over the channels."""

    steps: tuple[RecordStep, ...]
    """Effects that were added, in turn."""
    unexplained: RecordUnexplained
    """What is left."""
    channels: Mapping[str, ChannelErrors]
    """Errors by channel."""
    chained: tuple[ChainedPart, ...]
    """Forward-chained parts."""
    search: tuple[tuple[RecordScorePart, ...], ...]
    """Scores of every round of the search."""


class CheckPart(_Part):
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
    """What to correct; empty where the check is passed."""
    endangers: str
    """Figures that are wrong if the doubt is right."""


class InputsPart(_Part):
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


class Results(_Part):
    """results.json of a run; a part that a campaign does not have is absent."""

    model_config = ConfigDict(title="thermofuse results")

    schema_version: Literal[1] = Field(alias="schema")
    """Version of this layout."""
    campaign: str
    """Title of the campaign."""
    warnings: tuple[Notice, ...]
    """Everything that was left out, is doubtful, or was not possible."""
    inputs: InputsPart | None = None
    """Consistency of the inputs."""
    registration: RegistrationPart | None = None
    """Registration of the thermograms to the plan."""
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
    loop: AxisLoop | RecordLoop | None = None
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
    """
    path = folder / "results.json"
    if not path.is_file():
        raise ResultsError(f"{folder}: there is no results.json in it; name the results folder of a finished run")
    try:
        return Results.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except (json.JSONDecodeError, ValidationError) as error:
        raise ResultsError(
            f"{path}: not the results of this version of thermofuse ({str(error).splitlines()[0]}); run the campaign again"
        ) from None


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
