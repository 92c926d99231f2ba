"""The part ``iso230_3`` of results.json: distortion by temperature over the test."""

from __future__ import annotations

from typing import Literal

from fusion.results.parts import Iso230Condition, Number, Quantity, ResultPart

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
    """Values."""


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
