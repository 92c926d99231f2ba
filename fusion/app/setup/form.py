"""The form of a campaign file: a field for every key that its schema knows, read as text and written back where it changed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import panel as pn

from fusion.app.parts import Parts, column, heading
from fusion.app.setup.campaign import CampaignText
from fusion.campaign.config import campaign_schema
from fusion.campaign.values import read_quantity
from fusion.common import FusionError
from fusion.pipeline.draft import TO_FILL
from fusion.results.progress import counted

#: Directions along the plan, as `thermofuse init` names them.
DIRECTIONS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}
#: A drawn direction within this angle of a side of the plan is along it, degrees.
_ALONG_DEG = 3.0


class FieldError(FusionError):
    """Values that cannot be written into a campaign file; the message has a line for each."""


class Field(NamedTuple):
    """One value that somebody types: a key of a table, an item of a list of fixed length, or a key of a line of a list of tables.

    `kind` is "text", "number" or "list" of texts; `unit` is that of a quantity; `needed` where a campaign cannot run without it.
    """

    table: tuple[str, ...]
    key: str
    label: str
    kind: str = "text"
    unit: str = ""
    hint: str = ""
    options: tuple[str, ...] = ()
    item: int | None = None
    items: int = 0
    line: int | None = None
    needed: bool = False


_DIRECTION = "plan.axis.direction"
#: Headings of the tables that are always shown with their keys; those of others are taken from the schema.
_TITLES = {
    "campaign": "Test", "thermography": "Camera", "plan": "Plan", "plan.axis": "Axis on the plan", "interferometry": "Laser",
    "record": "Record", "acceptance": "Tolerances", "report": "Machine, people and conditions, as the report names them",
    "report.instrument": "Instruments",
}  # fmt: skip
_AS_STORED, _SPINDLE = "as stored in the frames", "Spindle at axis position 0"
#: What the schema does not say of the keys that nearly every test states; they stand first, all others of their table are folded below.
_FIRST: dict[str, dict[str, Any]] = {
    "campaign.title": {"label": "Title of the report", "needed": True},
    "campaign.axis": {"label": "Axis that was measured", "hint": "X"},
    "campaign.time_zone": {"label": "Time zone of times without one", "hint": "Europe/Vienna"},
    "thermography.emissivity": {"label": "Emissivity of the table", "hint": _AS_STORED},
    "thermography.reflected_temperature": {"hint": _AS_STORED},
    "thermography.clock_offset": {"label": "Camera clock minus laser clock", "hint": "0 s"},
    "thermography.table": {"label": "The table in the frames"},
    "plan.size.0": {"label": "Width of the plan (x)", "hint": "700 mm", "needed": True},
    "plan.size.1": {"label": "Height of the plan (y)", "hint": "180 mm", "needed": True},
    "plan.cell_size": {"label": "Size of a cell of the field"},
    "plan.axis.origin.0": {"label": f"{_SPINDLE}, x", "hint": "500 mm", "needed": True},
    "plan.axis.origin.1": {"label": f"{_SPINDLE}, y", "hint": "90 mm", "needed": True},
    _DIRECTION: {"label": "It moves, as the position grows", "hint": "left", "needed": True},
    "interferometry.expansion_coefficient": {"hint": "11.7 +- 0.3 ppm/K"},
    "interferometry.dead_path": {"label": "Dead path of the laser", "hint": "0 mm"},
}
#: Tables all of whose keys stand first: what a signed sheet names.
_WHOLE = ("acceptance", "report", "report.instrument")


@cache
def known_fields() -> dict[str, Field]:
    """Return a field for every key of a campaign file that holds text, a number or a list of texts, by its dotted name."""
    schema = campaign_schema()
    fields = {_name(field): field for field in _fields_of((), schema, schema["$defs"])}
    return {name: field._replace(**_FIRST.get(name, {})) for name, field in fields.items()}


def _name(field: Field) -> str:
    parts = [*field.table, field.line, field.key, field.item]
    return ".".join(str(part) for part in parts if part is not None)


def _fields_of(table: tuple[str, ...], model: Mapping[str, Any], models: Mapping[str, Any]) -> Iterator[Field]:
    """Yield the fields of a table and of the tables in it."""
    for key, given in model["properties"].items():
        spec, optional = _resolved(given, models)
        inner, _ = _resolved(spec.get("items") or {}, models)
        if "properties" in spec:
            yield from _fields_of((*table, key), spec, models)
        elif "properties" in inner:
            keys = list(_fields_of((*table, key), inner, models))
            # Tables of lists, such as the corners of a region, are drawn, not typed.
            yield from keys if len(keys) == len(inner["properties"]) and {one.kind for one in keys} == {"text"} else ()
        elif ".".join((*table, key)) == _DIRECTION:
            yield Field(table, key, "")
        elif "prefixItems" in spec:
            for item, one in enumerate(spec["prefixItems"]):
                yield _field(table, key, _resolved(one, models)[0])._replace(item=item, items=len(spec["prefixItems"]))
        elif spec.get("type") != "object":
            field = _field(table, key, spec)
            absent = "" if optional else str(given.get("default", field.options[:1] and field.options[0]) or "")
            yield field._replace(options=tuple(dict.fromkeys((absent, *field.options))) if field.options else ())


def _resolved(spec: Mapping[str, Any], models: Mapping[str, Any]) -> tuple[Mapping[str, Any], bool]:
    """Return what a value may be beside nothing, and whether it may be nothing."""
    choices = [one for one in spec.get("anyOf", [spec]) if one.get("type") != "null"]
    chosen = choices[0] if choices else spec
    if "$ref" in chosen:
        chosen = models[chosen["$ref"].rpartition("/")[2]]
    return chosen, len(choices) < len(spec.get("anyOf", [spec]))


def _field(table: tuple[str, ...], key: str, spec: Mapping[str, Any]) -> Field:
    """Return the field of a key by its schema."""
    kind = {"array": "list", "number": "number", "integer": "number"}.get(spec.get("type", ""), "text")
    example = str(spec.get("examples", [""])[0])
    words = re.sub(r" u$", ", standard uncertainty", key.replace("_", " "))
    options = tuple(str(one) for one in spec.get("enum", ()))
    return Field(table, key, words[:1].upper() + words[1:], kind, example.partition(" ")[2], example, options)


def is_picture(campaign: CampaignText) -> bool:
    """Whether the picture itself is the plan, which has no size in mm."""
    return campaign.value("plan", "registration") == "pixels" or campaign.value("plan") is None


#: Tables that only hold together with keys that the file does not have yet.
_WITH_OTHERS = ("plan.axis", "record.header_rows", "record.long", "drivers.header_rows")


def _is_there(table: tuple[str, ...], campaign: CampaignText) -> bool:
    """Whether a campaign file has a table, or may be given it without more."""
    top = table[0]
    if top == "plan" and is_picture(campaign):
        return False
    if top == "acceptance":
        return campaign.value("interferometry") is not None
    if top in ("report", "accept") or campaign.value(*table) is not None:
        return True
    if top == "model":
        return campaign.value("interferometry") is not None
    return len(table) > 1 and ".".join(table) not in _WITH_OTHERS and campaign.value(top) is not None


def form_fields(campaign: CampaignText) -> dict[str, Field]:
    """Return the fields of the tables that a campaign file has or may be given; of a list of tables those of every line and a new one."""
    found: dict[str, Field] = {}
    for name, field in known_fields().items():
        if not _is_there(field.table, campaign):
            continue
        if field.table == ("report", "instrument"):
            lines = len(campaign.value(*field.table) or ()) + 1
            found |= {_name(one): one for one in (field._replace(line=line) for line in range(lines))}
        else:
            found[name] = field
    return found


def read_fields(campaign: CampaignText) -> dict[str, str]:
    """Return the fields of a campaign file with their present texts, empty where nothing is written."""
    return {name: _shown(_value(campaign, field), field) for name, field in form_fields(campaign).items()}


def _value(campaign: CampaignText, field: Field) -> Any:
    if field.line is not None:
        lines = campaign.value(*field.table) or []
        return lines[field.line].get(field.key) if field.line < len(lines) else None
    value = campaign.value(*field.table, field.key)
    return value if field.item is None else _items(value, field.items)[field.item]


def write_fields(campaign: CampaignText, texts: Mapping[str, str]) -> CampaignText:
    """Write the fields that were changed."""
    fields, before = form_fields(campaign), read_fields(campaign)
    values: dict[tuple[str, ...], Any] = {}
    wrong = []
    for name, typed in texts.items():
        field, text = fields[name], typed.strip()
        if text == before[name]:
            continue
        key = (*field.table, field.key)
        try:
            value = _written(text, field)
        except FusionError as error:
            wrong.append(f"{field.label}: {error}")
            continue
        if field.line is not None:
            lines = values.setdefault(field.table, [dict(one) for one in campaign.value(*field.table) or []])
            lines += [{} for _ in range(field.line + 1 - len(lines))]
            lines[field.line] = {**lines[field.line], field.key: value}
            continue
        if field.item is not None:
            items = values.get(key) or [one or TO_FILL for one in _items(campaign.value(*key), field.items)]
            items[field.item] = value or TO_FILL
            value = items if field.needed or set(items) != {TO_FILL} else None
        values[key] = value
    if wrong:
        raise FieldError("\n".join(wrong))
    return campaign.with_values({key: _without_empty(value) for key, value in values.items()})


def _without_empty(value: Any) -> Any:
    """Return a list of tables without keys and tables in which nothing is written; other values as they are."""
    if not (isinstance(value, list) and value and isinstance(value[0], dict)):
        return value
    kept = [{key: text for key, text in line.items() if text} for line in value]
    return [line for line in kept if line] or None


def missing(campaign: CampaignText) -> list[str]:
    """Return what has to be filled in before a campaign can run: labels of fields, and other lines as they stand."""
    fields = form_fields(campaign)
    needed = {name: field for name, field in fields.items() if field.needed}
    labels = [needed[name].label for name, text in read_fields(campaign).items() if name in needed and text == ""]
    known = ("#", *(f"{field.key} = " for field in known_fields().values() if field.needed))
    lines = [line.partition("   #")[0] for line in campaign.text.splitlines() if f'"{TO_FILL}"' in line]
    return [*labels, *(line for line in lines if not line.startswith(known))]


def direction_text(dx: float, dy: float) -> str:
    """Return a direction on the plan as the field shows it: along a side by its word, else as two numbers."""
    length = math.hypot(dx, dy)
    for word, (x, y) in DIRECTIONS.items():
        if (dx * x + dy * y) / length >= math.cos(math.radians(_ALONG_DEG)):
            return word
    return f"{dx / length:.4f}, {dy / length:.4f}"


def read_direction(text: str) -> tuple[float, float]:
    """Return the direction that a field shows."""
    if text in DIRECTIONS:
        return DIRECTIONS[text]
    try:
        x, y = (float(part) for part in text.strip("[] ").split(","))
    except ValueError:
        x = y = 0.0
    if not (math.isfinite(x) and math.isfinite(y)) or x == y == 0.0:
        raise FieldError(f'"{text}" is no direction; write right, left, down, up, or two numbers such as -1, 0')
    return x, y


def _items(value: Any, count: int) -> list[Any]:
    return value if isinstance(value, list) and len(value) == count else [None] * count


def _shown(value: Any, field: Field) -> str:
    if value is None:
        return field.options[0] if field.options else ""
    if (*field.table, field.key) == tuple(_DIRECTION.split(".")):
        return direction_text(*value) if isinstance(value, list) and any(value) else ""
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _written(text: str, field: Field) -> Any:
    """Return a value as the campaign file holds it; None takes it away, a mark stands for what has to be filled in."""
    if not text:
        return TO_FILL if field.needed else None
    if (*field.table, field.key) == tuple(_DIRECTION.split(".")):
        return list(read_direction(text))
    if field.kind == "list":
        return [part.strip() for part in text.split(",") if part.strip()]
    if field.kind == "number":
        try:
            return int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
        except ValueError:
            # With an uncertainty or as a percentage it is text, which the check of the file reads.
            if not re.match(r"[+-]?\.?\d", text):
                raise FieldError(f'"{text}" is no number; write digits, with a point before the decimals') from None
    if field.unit and "+-" not in text and "±" not in text:
        read_quantity(text, field.unit)
    return text


# The fields as widgets.


class Form:
    """Fields of a campaign file, in groups by table; `on_change` takes the name of a field whose text has changed.

    Keys that few tests state are folded, and get their widgets when they are first unfolded.
    """

    def __init__(self, on_change: Callable[[str], None]) -> None:
        self._on_change = on_change
        self._widgets: dict[str, pn.widgets.Widget] = {}
        self.view = column()

    def show(self, campaign: CampaignText) -> None:
        """Show the fields of a campaign file."""
        self._widgets = {}
        fields, texts = form_fields(campaign), read_fields(campaign)
        tables: dict[str, list[str]] = {}
        for name, field in fields.items():
            tables.setdefault(".".join(field.table), []).append(name)
        parts: Parts = []
        for table, names in tables.items():
            first = [name for name in names if name in _FIRST or table in _WHOLE]
            # A draft marks what has to be filled in: that is never folded.
            first += [name for name in names if name not in first and _is_marked(campaign, fields[name])]
            others = {name: fields[name] for name in names if name not in first}
            if first:
                group = [self._widget(name, fields[name], texts[name]) for name in first]
                parts += [heading(_TITLES.get(table, table), level=3), pn.FlexBox(*group)]
            if others:
                parts.append(
                    self._folded(f"[{table}]: {counted(len(others), 'more key' if first else 'key')}", others, texts)
                )
        self.view[:] = parts

    def _folded(self, title: str, fields: Mapping[str, Field], texts: Mapping[str, str]) -> pn.Card:
        card = pn.Card(title=title, collapsed=True, sizing_mode="stretch_width", margin=(4, 10))

        def unfold(event: object) -> None:
            if not card.objects:
                card[:] = [pn.FlexBox(*(self._widget(name, field, texts[name]) for name, field in fields.items()))]

        card.param.watch(unfold, "collapsed")
        return card

    def _widget(self, name: str, field: Field, text: str) -> pn.widgets.Widget:
        if field.options:
            widget = pn.widgets.Select(label=field.label, options=list(field.options), value=text, width=250)
        else:
            widget = pn.widgets.TextInput(label=field.label, value=text, placeholder=field.hint, width=250)
        widget.param.watch(lambda event: self._on_change(name), "value")
        self._widgets[name] = widget
        return widget

    @property
    def texts(self) -> dict[str, str]:
        """Present texts by name of the field, of all that were shown."""
        return {name: str(widget.value) for name, widget in self._widgets.items()}

    def write(self, texts: Mapping[str, str]) -> None:
        """Write texts into fields, where the campaign file has them."""
        for name in texts.keys() & self._widgets.keys():
            self._widgets[name].value = texts[name]


def _is_marked(campaign: CampaignText, field: Field) -> bool:
    """Whether a draft marks a key as one to be filled in."""
    found: Any = campaign.content
    for part in (*field.table, field.key):
        found = found.get(part) if isinstance(found, dict) else None
    return TO_FILL in found if isinstance(found, list) else found == TO_FILL
