"""Parts of results.json on the attribution of the drift to parts of the temperature field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from fusion.products.results_part import AreaPart, Number, Quantity, ResultPart, Sensitivity

Attribution = Literal["attributable", "not attributable", "not separable"]


class SourcePart(ResultPart):
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
    area: AreaPart | None = None
    """The area that is the place; (x_mm, y_mm) is its strongest cell, of a region its middle."""
    p_value: Number
    """p-value, family-wise over everything that was tested."""
    sensitivity_um_per_K: Sensitivity
    """Drift per rise, um/K, at the far end of travel for the parts that grow along the axis."""
    lag_s: Number
    """Time constant between temperature and drift, s."""
    detectable_um_per_K: Number
    """Detection limit at 80 % power, um/K."""
    equal_places_mm: tuple[tuple[Number, Number], ...]
    """Other places (x, y) that explain the drift as well, mm."""


class TestedPart(ResultPart):
    """What one mode or region shows in one part of the drift."""

    __test__ = False

    p_value: Number
    """p-value, family-wise over everything that was tested."""
    sensitivity_um_per_K: Sensitivity
    """Drift per rise, um/K."""
    lag_s: Number
    """Time constant between temperature and drift, s."""
    detectable_um_per_K: Number
    """Detection limit at 80 % power, um/K."""
    p_beside_leader: Number = None
    """p-value given the leading mode; modes only."""


class PlacePart(ResultPart):
    """A thermal mode or a region as a candidate for the source."""

    name: str
    """Name."""
    x_mm: Number
    """Place on the plan, x, mm."""
    y_mm: Number
    """Place on the plan, y, mm."""
    area: AreaPart | None = None
    """The area that is the place; (x_mm, y_mm) is the strongest cell of a mode, the middle of a region."""
    parts: Mapping[str, TestedPart]
    """Test results by part of the drift."""


class SensorSetPart(ResultPart):
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


class SensorsPart(ResultPart):
    """Contact sensors in place of the camera."""

    within_s: Number
    """Length of the runs of left-out cycles, s."""
    camera_gain_um: Number
    """Root mean square that the camera takes out of the drift on left-out cycles, um."""
    camera_gain_decided: bool
    """Whether the data show that the camera takes anything out."""
    sets: tuple[SensorSetPart, ...]
    """Sets of one, two, ... sensors."""


class DutyPart(ResultPart):
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


class CorrelationPart(ResultPart):
    """Attribution of the drift to parts of the temperature field."""

    least_p: Number = None
    """Smallest p-value that the number of simulations can show: a p-value equal to it is an upper limit."""

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
