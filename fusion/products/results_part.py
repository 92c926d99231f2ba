"""What the parts of results.json have in common: their base class, types of values, and quantities with an uncertainty.

A number is None (``null`` in the file) where the data do not determine it.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, BaseModel, ConfigDict

Number = float | None


class ResultPart(BaseModel):
    """Base class of every part: immutable, without unknown keys, each field described by its docstring."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, serialize_by_alias=True, allow_inf_nan=False
    )


class Quantity(ResultPart):
    """A measured value with its standard uncertainty."""

    value: Number
    """Estimate, in the unit that the key ends with."""
    u: Number
    """Standard uncertainty (k = 1), same unit; null where it is not known."""


class Sensitivity(Quantity):
    """A quantity per kelvin of the rise with both parts of its standard uncertainty."""

    u_fit: Number = None
    """The part of the fit, the rise taken as exact."""
    u_scale: Number = None
    """The part of the scale of the rise (emissivity, reflections, air, camera)."""


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


class PixelAreaPart(ResultPart):
    """A place on a plan that is the picture itself, as the rectangle around its cells, from the upper left corner of the picture."""

    x_low_px: float
    """Smallest x, px."""
    x_high_px: float
    """Largest x, px."""
    y_low_px: float
    """Smallest y, px."""
    y_high_px: float
    """Largest y, px."""


def _of_time(text: str) -> str:
    try:
        datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("no time by ISO 8601") from None
    return text


def _known_zone(name: str) -> str:
    try:
        ZoneInfo(name)
    # Also a name that is too long for a file, or leads out of the data base.
    except (LookupError, ValueError, OSError):
        raise ValueError("no zone of the IANA data base") from None
    return name


TimeText = Annotated[str, AfterValidator(_of_time)]


class TimePart(ResultPart):
    """When the readings were taken."""

    first: TimeText
    """Time of the first reading, UTC."""
    last: TimeText
    """Time of the last reading, UTC."""
    zone: Annotated[str, AfterValidator(_known_zone)] | None
    """Zone that the campaign states, by its name in the IANA data base; null where it states none."""
