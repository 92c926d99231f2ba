"""Parts of results.json on the thermograms and the readings of the axis: registration, ISO 230-2, drift, anomalies, hotspots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

from pydantic import Field, model_validator

from fusion.results.parts import (
    AreaPart,
    ByDirection,
    Iso230Check,
    Iso230Condition,
    Iso230Tolerance,
    Number,
    OtherEvaluation,
    Quantity,
    ResultPart,
    Sensitivity,
)

# Parts of results.json on the attribution of the drift to parts of the temperature field.

Attribution = Literal["attributable", "not attributable", "not separable"]


class AssociationPart(ResultPart):
    """How closely a part of the drift follows the rise of a place."""

    p_value: Number
    """p-value, family-wise over everything that was tested."""
    sensitivity_um_per_K: Sensitivity
    """Drift per rise, um/K, at the far end of travel for parts that grow along the axis; u over the drifts and lags that the data allow."""
    sensitivity_interval_um_per_K: tuple[Number, Number] | None = None
    """Limits of it at this lag with 95 % for everything that was tested at once, um/K: they hold 0 where p is above 0.05."""
    lag_s: Number
    """Time constant between temperature and drift, s."""
    detectable_um_per_K: Number
    """Detection limit at 80 % power, um/K."""


class TestedPart(AssociationPart):
    """What one mode or region shows in one part of the drift."""

    __test__ = False

    p_given_leading_mode: Number = None
    """p-value given the leading mode; modes only."""


class CandidatePart(ResultPart):
    """A thermal mode, a cell of the plan or a region as a candidate for the source."""

    name: str
    """Number of the mode or name of the region; empty for a cell."""
    x_mm: Number
    """Place on the plan, x, mm."""
    y_mm: Number
    """Place on the plan, y, mm."""
    area: AreaPart | None = None
    """The area that is the place; (x_mm, y_mm) is its strongest cell, of a region its middle."""


class SourcePart(CandidatePart, AssociationPart):
    """The leading candidate for the source of the drift."""

    kind: Literal["mode", "cell", "region"]
    """What it is."""
    part: str
    """Part of the drift that follows it: common, proportional, reversal, joint."""
    equivalent_places_mm: tuple[tuple[Number, Number], ...]
    """Other places (x, y) that explain the drift equally well, mm."""


class PlacePart(CandidatePart):
    """A thermal mode or a region with its test results."""

    parts: Mapping[str, TestedPart]
    """Test results by part of the drift."""


class SensorSetPart(ResultPart):
    """One number of contact sensors: the sensor that it adds, and what the set loses compared with the camera."""

    x_mm: Number
    """Place of the added sensor, x, mm."""
    y_mm: Number
    """Place of the added sensor, y, mm."""
    loss_um: Number
    """Increase of the root mean square error on left-out cycles compared with the camera, um."""
    loss_upper_limit_um: Number
    """Upper limit of that, um."""
    significant: bool
    """Whether the increase is significant."""


class SensorsPart(ResultPart):
    """Contact sensors as a replacement of the camera."""

    block_length_s: Number
    """Length of the blocks of left-out cycles, s."""
    camera_reduction_um: Number
    """Root mean square of the drift on left-out cycles that the camera explains, um."""
    camera_reduction_significant: bool
    """Whether that is significant."""
    sets: tuple[SensorSetPart, ...]
    """Sets of one, two, ... sensors."""


class DutyPart(ResultPart):
    """A load that was switched at random."""

    name: str
    """Column of the drivers' log."""
    cause: bool
    """Whether randomisation shows that it moves the axis, at whatever place its heat acts."""
    p_value: Number
    """Share of schedules drawn from the same law that the drift follows as closely, family-wise over the loads."""
    drift_at_full_duty_um: Quantity
    """Drift at the far end of travel at full duty, um."""
    time_constants_s: tuple[Number, ...]
    """Time constants of the first and the second body, s; the second is 0 for one body."""


class CorrelationPart(ResultPart):
    """Attribution of the drift to parts of the temperature field."""

    p_resolution: Number = None
    """Smallest p-value that the number of simulations can show: a p-value equal to it is an upper limit."""

    verdict: Attribution
    """Whether the drift is shown to follow a part of the field."""
    excitation: str
    """How the heat sources were excited."""
    false_alarm_rate: Number
    """Rate of false alarms on series simulated from the drift that was fitted, without a source, 1."""
    source: SourcePart
    """The leading candidate."""
    recommended_test: str
    """Recommended further test."""
    unexplained_drift_um_per_h: Mapping[str, Number]
    """Unexplained random walk in one hour, um, by part of the drift."""
    modes: tuple[PlacePart, ...]
    """Thermal modes."""
    regions: tuple[PlacePart, ...]
    """Regions of the campaign and hotspots."""
    sensors: SensorsPart
    """How well contact sensors would replace the camera."""
    randomised_duty: tuple[DutyPart, ...] | None
    """Loads that were switched at random; null where none was."""


Cause = Literal["structural", "local_temperature", "stick_slip", "step", "link", "undetermined"]
Direction = Literal["positive", "negative", "both"]
CAUSES: tuple[Cause, ...] = get_args(Cause)


class RejectedFrame(ResultPart):
    """A thermogram that was not used."""

    file: str
    """File, relative to the campaign file."""
    index: int
    """Number of the frame in its file, from 0."""
    reason: str
    """Why it was not used."""


class RegistrationPart(ResultPart):
    """Registration of the thermograms to the plan."""

    rms_mm: Number
    """Root mean square of the registration residuals of the fiducials, mm; null where four fiducials determine the plan exactly."""
    position_u_mm: Number = None
    """Standard uncertainty of a place on the plan, root mean square over its cells, mm."""
    fiducials_listed: int = 0
    """Number of fiducials in the list, without markers."""
    unchecked: tuple[str, ...] = ()
    """Fiducials whose place the others do not check."""
    contradicted_hints: tuple[str, ...] = ()
    """Fiducials far from their rough pixel positions."""
    area_ratio: Number = None
    """Median ratio of the imaged to the listed area of the discs; null for points."""
    span: Number = None
    """Share of the plan's area that the fiducials in use span."""
    edge_spread_px: Quantity | None = None
    """Standard deviation of the blur of lens and pixel that the discs show, px; null for points."""
    margin_px: Number = None
    """Distance from discs and from the plan's edge within which pixels are left out, px: 2, or three edge spreads where these are more."""
    fiducials_u_mm: Number = 0.0
    """Stated standard uncertainty of the places in the list, mm; at 0 a wrong scale of the whole list is in no uncertainty."""
    mirrored: bool = False
    """Whether the plan appears as in a mirror."""
    model: str = ""
    """Lens model."""
    homography: tuple[tuple[float, ...], ...] = ()
    """Homography of the first registration, (3, 3): from sensor (column, row) without lens distortion, px, to plan (x, y), mm."""
    distortion: tuple[float, ...] = ()
    """Distortion (k1, k2, p1, p2), OpenCV's, of (place on the sensor - principal point) / focal length."""
    focal_length_px: Number = None
    """Unit of the coordinates that are distorted, px."""
    principal_point_px: tuple[float, ...] = ()
    """Centre of the distortion (column, row), px."""
    leave_one_out_mm: Mapping[str, Number]
    """Distance by which each fiducial is missed when it takes no part in the registration, mm, by name."""
    frames_rejected: tuple[RejectedFrame, ...]
    """Thermograms that were not used."""


class CameraStepPart(ResultPart):
    """A step of the camera's zero that was taken out of all frames that follow."""

    time: str
    """Time of the first frame after the step, UTC."""
    step_K: Quantity
    """Size of the step, K."""


class CameraPart(ResultPart):
    """The thermal camera: damaged frames, and what was corrected before the fields were made."""

    frames_checked: int
    """Thermograms whose pixels were checked."""
    frames_damaged: tuple[RejectedFrame, ...]
    """Thermograms that were left out by this check; they are among those of the registration that were not used."""
    steps: tuple[CameraStepPart, ...]
    """Steps of the camera's zero (flat-field corrections) that were taken out."""
    drift_K: Number
    """Range of the drift with the temperature of the housing that was taken out, K; 0 where none is significant."""
    largest_correction_K: Number
    """Largest correction of a thermogram, K; 0 where nothing was corrected."""
    largest_u_K: Number
    """Largest standard uncertainty of the camera's zero since the first thermogram, K; null where only the table is in view."""


class AlignmentPart(ResultPart):
    """Both instruments on one clock."""

    clock_offset_s: Quantity
    """Camera clock minus laser clock, s; u is 0 where the campaign states the offset and null where it is assumed."""


class Iso230Contribution(ResultPart):
    """One input of the uncertainty budget of ISO 230-2 values."""

    contributor: str
    """Name of the input."""
    u: Number
    """Its standard uncertainty (k = 1), in ``unit``; null where it is not one number."""
    unit: str
    """Unit of ``u``."""
    origin: str
    """Whether it was stated, assumed or measured, and how."""
    A_um: Number
    """Contribution to the standard uncertainty of A, um."""
    R_um: Number
    """Contribution to the standard uncertainty of R, um."""
    E_um: Number
    """Contribution to the standard uncertainty of E, um."""
    M_um: Number
    """Contribution to the standard uncertainty of M, um."""
    B_um: Number
    """Contribution to the standard uncertainty of B, um."""
    mean_reversal_um: Number
    """Contribution to the standard uncertainty of the mean reversal error, um."""
    unidirectional_um: Mapping[str, Number] = Field(default_factory=dict)
    """Contribution to the standard uncertainty of A, R and E of each direction that was measured, by ``A_positive`` and so on, um."""


class Iso230Direction(ResultPart):
    """Axis values of one direction of approach; null where it was not measured."""

    A_um: Quantity
    """Unidirectional positioning accuracy, um."""
    R_um: Quantity
    """Unidirectional positioning repeatability, um."""
    E_um: Quantity
    """Unidirectional systematic positioning error, um."""


class Iso230Window(ResultPart):
    """Axis values by ISO 230-2:2014, clause 3, of one window of cycles, with their uncertainty budget."""

    unit: Literal["um", "arcsec"] = "um"
    """Unit of all values here: of a rotary axis arcsec, in the fields whose names end in ``_um`` too."""
    window: str
    """Cycles that were evaluated."""
    cycles: tuple[int, ...]
    """Numbers of these cycles; empty in results of versions that did not write them."""
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
    mean_reversal_um: Quantity
    """Mean reversal error of the axis with its sign, um."""
    B_of_scatter_um: Number
    """B that scatter alone gives in half of such tests of an axis without reversal error, um."""

    positive: Iso230Direction
    """Values of the approach in positive direction."""
    negative: Iso230Direction
    """Values of the approach in negative direction."""
    u_without_sampling_um: Mapping[str, Number]
    """Standard uncertainty of A, R, E, M, B and mean_reversal, and of A, R and E of each direction that was measured (``A_positive``),
    without the sampling of the cycles, um; that of each value holds it."""
    contributions: tuple[Iso230Contribution, ...]
    """Inputs of the budget."""

    @property
    def approach(self) -> Literal["positive", "negative"] | None:
        """The only direction of approach that the window holds; None where it holds both."""
        if self.E_um.value is not None:
            return None
        if self.positive.E_um.value is not None:
            return "positive"
        return "negative" if self.negative.E_um.value is not None else None


class Iso230Range(ResultPart):
    """Smallest and largest value of a quantity over the windows of a test."""

    lowest: Number
    """Smallest value, um."""
    highest: Number
    """Largest value, um."""


class Iso230WithTable(ResultPart):
    """A of the readings of this test had a compensation table corrected them, each window by the profile that all other cycles show."""

    quoted_um: Number
    """In the quoted window, um."""
    lowest_um: Number
    """Smallest value of any window of the standard's number of cycles, um."""
    highest_um: Number
    """Largest value: a table is right in one thermal state only, um."""


class Iso230Part(Iso230Window):
    """Axis values by ISO 230-2:2014; those at this level are to quote: of the cycles that were chosen, else of the last window."""

    window_rule: str = ""
    """How that window was chosen. ``settled_rule`` before schema 4."""
    first: Iso230Window | None = None
    """The first window, which may be a cold start."""
    range_um: Mapping[str, Iso230Range] = Field(default_factory=dict)
    """Range of A, R, E, M and B over all windows of the standard's number of cycles, um."""
    with_table: Iso230WithTable | None = None
    """A with a compensation table in this thermal state and in the others; null where no other cycles tell. New in schema 4."""
    tolerances: tuple[Iso230Tolerance, ...] = ()
    """The quoted window against the tolerances that the campaign states."""
    windows: int = 0
    """How many windows of five cycles, laid back from the last one of the test, are judged beside it. New in schema 4."""
    windows_otherwise: int = 0
    """How many of them would be judged otherwise in any of the tolerances. New in schema 4."""
    checks: tuple[Iso230Check, ...] = ()
    """Conditions that the standard asks of a test."""
    is_acceptance_test: bool | None = None
    """Whether every one of them is met: where one is not, no decision is an acceptance by ISO 230-2; null where the readings do not show
    all of them, and in results of versions that did not write it. New in schema 4."""
    conditions: tuple[Iso230Condition, ...] = ()
    """Conditions of the test as they were stated or logged."""
    other_standards: tuple[OtherEvaluation, ...] = ()
    """The quoted window by other standards."""


class NeighboursPart(ResultPart):
    """Standard deviations of neighbour differences and the conventional ones, per link from one target to the next."""

    conventional_s_um: ByDirection
    """Conventional standard deviation (n - 1), drift included, um."""
    pair_s_um: ByDirection
    """Standard deviation of the differences between neighbouring targets (n - 1), um."""
    ratio: ByDirection
    """Conventional standard deviation over that of the differences, 1."""


class DriftPart(ResultPart):
    """Joint estimate of profile and drift, per target."""

    profile_um: ByDirection
    """Positioning deviation without drift, at the mean thermal state of the test, um."""
    profile_u_um: ByDirection
    """Standard uncertainty of the profile, um."""
    scatter_um: ByDirection
    """Standard deviation of a reading after profile and drift were subtracted, um."""
    position_mm: tuple[Number, ...] = ()
    """Positions of the targets, mm."""
    range_um: tuple[Number, ...] = ()
    """Largest minus smallest drift of every target during the test, mean of both approaches, um."""
    range_u_um: tuple[Number, ...] = ()
    """Standard uncertainty of that, um; at least that of a change between the means of both halves of the readings."""

    @model_validator(mode="after")
    def _one_of_each_target(self) -> DriftPart:
        """Refuse ranges without a target or an uncertainty."""
        if self.range_um and not len(self.position_mm) == len(self.range_um) == len(self.range_u_um):
            raise ValueError("position_mm, range_um and range_u_um have one value for each target")
        return self


class Evidence(ResultPart):
    """What the cause of an anomaly rests on; of a link, what compares it with scatter of the two targets beside it."""

    kind: Literal["scatter", "link", "slow", "step", "periodic"]
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
    probability_structural: Number = None
    """Probability of mechanical scatter."""
    probability_link: Number = None
    """Probability of a jump between the target and the one before, against scatter of either; of a link only."""
    jump_um: Number = None
    """Standard deviation of the jumps of a link, um."""
    jump_u_um: Number = None
    """Its standard uncertainty, um."""
    link_before_ratio: Number = None
    """Standard deviation of the differences to the target before (equation 6) over the median of all links, 1."""
    link_after_ratio: Number = None
    """The same of the differences to the target behind, 1."""
    probability_stick_slip: Number = None
    """Probability of stick-slip."""
    probability_slow: Number = None
    """Probability of a slow motion without a known cause."""
    probability_step: Number = None
    """Probability of one step; null where it is excluded, since its p is above its level."""
    probability_local_temperature: Number = None
    """Probability of a local temperature; null where it is excluded, since its p is above its level, absent where no
    camera sees the target."""
    scatter_typical_um: Number = None
    """Median scatter of the other targets, um."""
    scatter_positive_um: Number = None
    """Scatter of the approach in positive direction, um."""
    scatter_negative_um: Number = None
    """Scatter of the approach in negative direction, um."""
    serial_p: Number
    """p-value of the order of the readings, of a link that of its jumps, in time."""
    approach_gain_nats: Number = None
    """Gain in log-likelihood of an effect bound to the direction of approach, nats."""
    step_p: Number = None
    """p-value of one step (parametric bootstrap)."""
    step_um: Number = None
    """Height of the step, um."""
    step_u_um: Number = None
    """Standard uncertainty of the height, um."""
    step_cycle: int | None = None
    """First cycle after the step."""
    step_held_out_nats: Number = None
    """Gain of the step on the direction that it was not fitted to, nats."""
    temperature_p: Number = None
    """p-value of the local temperature (parametric bootstrap)."""
    temperature_um_per_K: Number = None
    """Displacement per local rise, um/K."""
    temperature_u_um_per_K: Number = None
    """Standard uncertainty of the displacement per rise, of the fit and of the scale of the rise, um/K."""
    temperature_scale_u_um_per_K: Number = None
    """The part of it from the scale of the rise, um/K."""
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


class AnomalyPart(ResultPart):
    """A target that stands out from the others."""

    target: int = Field(ge=1)
    """Target number, from 1."""
    position_mm: Number = None
    """Its position, mm."""
    p_resolution: Number = None
    """Smallest p-value that the number of simulations can show: a p-value equal to it is an upper limit."""
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


class HotspotPart(ResultPart):
    """A place that warms more than its surroundings, in any cycle."""

    name: str = ""
    """Its name, the same as among the regions of the correlation."""
    centroid_x_mm: Number = None
    """Middle of its area, x, mm."""
    centroid_y_mm: Number = None
    """Middle of its area, y, mm."""
    area: AreaPart | None = None
    """Its area: the connected cells around the peak whose rise exceeds that at half of the peak's prominence."""
    x_mm: Number
    """Place of the peak on the plan, x, mm."""
    y_mm: Number
    """Place of the peak on the plan, y, mm."""
    x_u_mm: Number = None
    """Standard uncertainty of its x from noise, shape and registration, mm."""
    y_u_mm: Number = None
    """Standard uncertainty of its y, mm."""
    masked: bool = False
    """Whether the peak lies on or beside cells that are not seen, as under a fiducial: place and rise follow from the shape around."""
    at_edge: bool = False
    """Whether its area reaches the edge of the seen plan, beyond which its true peak may lie."""
    peak_rise_K: Number
    """Rise of the peak since the first cycle in the cycle of its largest rise, K."""
    peak_rise_u_K: Number = None
    """Standard uncertainty of that rise from noise, shape and what all cells share, K."""
    cycle: int | None = None
    """Cycle of its largest rise: of several that noise does not tell apart the last one of the test, or else the middle one."""
    time: str | None = None
    """Time of that cycle, UTC."""
    onset_cycle: int | None = None
    """First cycle in which it stands out from its surroundings and from the noise."""
    onset_time: str | None = None
    """Time of that cycle, UTC."""
    end_cycle: int | None = None
    """Last cycle in which it stands out; null where it does so to the end of the test."""
    end_time: str | None = None
    """Time of that cycle, UTC; null where it stands out to the end of the test."""
    targets: tuple[int, ...]
    """Targets whose drift follows it."""
    p_value: Number
    """p-value of its strongest part of the drift, family-wise over everything that was tested."""
    lag_s: Number
    """Time constant between its temperature and the drift, s."""
