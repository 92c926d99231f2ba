"""What a campaign file says that somebody types: read from it as text, and written back where it was changed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fusion.app.setup.campaign_text import CampaignText
from fusion.campaign.quantities import read_quantity
from fusion.errors import FusionError
from fusion.starting.questions import TO_FILL

#: Directions along the plan, as `thermofuse init` names them.
DIRECTIONS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}
#: A drawn direction within this angle of a side of the plan is along it, degrees.
_ALONG_DEG = 3.0


class FieldError(FusionError):
    """Values that cannot be written into a campaign file; the message has a line for each."""


@dataclass(frozen=True)
class Field:
    """One value that somebody types.

    Attributes
    ----------
    name : str
        Of the field.
    table : tuple of str
        Table of the campaign file; the field is shown where the file has it.
    key : str
        Key in the table.
    label : str
        What is asked.
    unit : str
        Canonical unit of a quantity; empty for text.
    item : int or None
        Item of a list of two; None where the value is no list.
    options : tuple of str
        What can be chosen; empty where anything can be typed.
    hint : str
        An example.
    needed : bool
        Whether a campaign cannot run without it.
    """

    name: str
    table: tuple[str, ...]
    key: str
    label: str
    unit: str = ""
    item: int | None = None
    options: tuple[str, ...] = ()
    hint: str = ""
    needed: bool = False


FIELDS = (
    Field("title", ("campaign",), "title", "Title of the report", needed=True),
    Field("axis", ("campaign",), "axis", "Axis that was measured", hint="X"),
    Field("time_zone", ("campaign",), "time_zone", "Time zone of times without one", hint="Europe/Vienna"),
    Field("emissivity", ("thermography",), "emissivity", "Emissivity of the table", hint="as stored in the frames"),
    Field(
        "reflected",
        ("thermography",),
        "reflected_temperature",
        "Reflected temperature",
        "degC",
        hint="as stored in the frames",
    ),
    Field("clock_offset", ("thermography",), "clock_offset", "Camera clock minus laser clock", "s", hint="0 s"),
    Field("table", ("thermography",), "table", "The table in the frames", options=("still", "moving")),
    Field("width", ("plan",), "size", "Width of the plan (x)", "mm", 0, hint="700 mm", needed=True),
    Field("height", ("plan",), "size", "Height of the plan (y)", "mm", 1, hint="180 mm", needed=True),
    Field("cell", ("plan",), "cell_size", "Size of a cell of the field", "mm", hint="5 mm"),
    Field("origin_x", ("plan", "axis"), "origin", "Spindle at axis position 0, x", "mm", 0, hint="500 mm", needed=True),
    Field("origin_y", ("plan", "axis"), "origin", "Spindle at axis position 0, y", "mm", 1, hint="90 mm", needed=True),
    Field("direction", ("plan", "axis"), "direction", "It moves, as the position grows", hint="left", needed=True),
    Field(
        "expansion", ("interferometry",), "expansion_coefficient", "Expansion coefficient", "ppm/K", hint="11.7 ppm/K"
    ),
    Field("dead_path", ("interferometry",), "dead_path", "Dead path of the laser", "mm", hint="0 mm"),
    Field("machine", ("report",), "machine", "Machine, as the report names it", hint="not stated"),
)
_NAMED = {field.name: field for field in FIELDS}


def read_fields(campaign: CampaignText) -> dict[str, str]:
    """Return the fields of a campaign file with their present texts, empty where nothing is written.

    Parameters
    ----------
    campaign : CampaignText
        Opened file.

    Returns
    -------
    dict of str to str
        By name of the field; those of tables that the file does not have are left out, but for ``report``.
    """
    return {
        field.name: _shown(campaign.value(*field.table, field.key), field)
        for field in FIELDS
        if field.table == ("report",) or campaign.value(*field.table) is not None
    }


def write_fields(campaign: CampaignText, texts: Mapping[str, str]) -> CampaignText:
    """Write the fields that were changed.

    Parameters
    ----------
    campaign : CampaignText
        Opened file.
    texts : mapping of str to str
        New texts by name of the field.

    Raises
    ------
    FieldError
        If a quantity has no number or no unit, or a direction is none.
    """
    before = read_fields(campaign)
    values: dict[tuple[str, ...], Any] = {}
    faults = []
    for name, typed in texts.items():
        field, text = _NAMED[name], typed.strip()
        if text == before.get(name, ""):
            continue
        key = (*field.table, field.key)
        try:
            value = _written(text, field)
        except FusionError as error:
            faults.append(f"{field.label}: {error}")
            continue
        if field.item is None:
            values[key] = value
        else:
            stated = campaign.value(*key)
            is_pair = isinstance(stated, list) and len(stated) == 2
            pair = values.get(key) or [one or TO_FILL for one in (stated if is_pair else (None, None))]
            pair[field.item] = value
            values[key] = pair
    if faults:
        raise FieldError("\n".join(faults))
    return campaign.with_values(values)


def missing(campaign: CampaignText) -> list[str]:
    """Return what has to be filled in before a campaign can run: labels of fields, and other lines as they stand.

    Parameters
    ----------
    campaign : CampaignText
        Opened file.
    """
    texts = read_fields(campaign)
    labels = [field.label for field in FIELDS if field.needed and texts.get(field.name, "written") == ""]
    known = tuple(f"{field.key} = " for field in FIELDS if field.needed)
    lines = [
        line.partition("   #")[0]
        for line in campaign.text.splitlines()
        if f'"{TO_FILL}"' in line and not line.startswith("#")
    ]
    return [*labels, *(line for line in lines if not line.startswith(known))]


def direction_text(dx: float, dy: float) -> str:
    """Return a direction on the plan as the field shows it: along a side by its word, else as two numbers.

    Parameters
    ----------
    dx, dy : float
        Components along x and y, not both zero.
    """
    length = math.hypot(dx, dy)
    for word, (x, y) in DIRECTIONS.items():
        if (dx * x + dy * y) / length >= math.cos(math.radians(_ALONG_DEG)):
            return word
    return f"{dx / length:.4f}, {dy / length:.4f}"


def read_direction(text: str) -> tuple[float, float]:
    """Return the direction that a field shows.

    Parameters
    ----------
    text : str
        A word of `DIRECTIONS`, or two numbers.

    Raises
    ------
    FieldError
        If it is neither, or points nowhere.
    """
    if text in DIRECTIONS:
        return DIRECTIONS[text]
    try:
        x, y = (float(part) for part in text.strip("[] ").split(","))
    except ValueError:
        x = y = 0.0
    if not (math.isfinite(x) and math.isfinite(y)) or x == y == 0.0:
        raise FieldError(f'"{text}" is no direction; write right, left, down, up, or two numbers such as -1, 0')
    return x, y


def _shown(value: Any, field: Field) -> str:
    if field.item is not None:
        value = value[field.item] if isinstance(value, list) and len(value) == 2 else None
    if value is None:
        return field.options[0] if field.options else ""
    if field.name == "direction":
        return direction_text(*value) if isinstance(value, list) and any(value) else ""
    return str(value)


def _written(text: str, field: Field) -> Any:
    """Return a value as the campaign file holds it; None takes it away, a mark stands for what has to be filled in."""
    if not text:
        return TO_FILL if field.needed else None
    if field.name == "direction":
        x, y = read_direction(text)
        return [x, y]
    if field.unit and "+-" not in text and "±" not in text:
        read_quantity(text, field.unit)
    return text
