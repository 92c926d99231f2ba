"""The form of a campaign file: a field for every key that its schema knows, read as text and written back where it changed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import count
from typing import Any, NamedTuple

import panel as pn

from fusion.app.parts import Parts, column, heading
from fusion.app.setup.campaign import CampaignText
from fusion.app.setup.labels import CHOICES, HINTS, LABELS, TITLES, UNITS
from fusion.campaign.config import campaign_schema
from fusion.campaign.draft import TO_FILL
from fusion.campaign.values import read_quantity
from fusion.common import FusionError
from fusion.results.numbers import print_unit
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
#: Keys without which a campaign cannot run.
_NEEDED = ("campaign.title", "plan.size.0", "plan.size.1", "plan.axis.origin.0", "plan.axis.origin.1", _DIRECTION)
#: Keys that nearly every test states; they stand first, all others of their table are folded below.
_FIRST = (
    *_NEEDED, "campaign.axis", "campaign.time_zone", "thermography.emissivity", "thermography.reflected_temperature",
    "thermography.clock_offset", "thermography.table", "plan.cell_size", "interferometry.expansion_coefficient",
    "interferometry.dead_path", "thermal_test.kind", "thermal_test.sensor_calibration", "thermal_test.mounting_length",
    "thermal_test.mounting_expansion",
)  # fmt: skip
#: Tables all of whose keys stand first: what a signed sheet names.
_WHOLE = ("acceptance", "report")
#: Tables with one row for each of several things: what one of them is called, and how many rows are shown where none is stated.
_ROWS = {"report.instrument": ("Instrument", 1), "thermal_test.tilts": ("Tilt", 0)}
_LASER, _RECORD = ("interferometry",), ("record",)
#: Keys that say something only where one of these tables is there.
_ONLY_WITH = {
    **dict.fromkeys(("campaign.axis", "report.sign_convention", "report.warm_up", "report.machine_compensation"), _LASER + _RECORD),
    **dict.fromkeys(("report.sensor_places", "thermal_test.kind"), _LASER + _RECORD),
    **dict.fromkeys(("thermography.clock_offset", "thermography.table", "report.axis_travel", "report.screw_lead"), _LASER),
    **dict.fromkeys(("report.feed", "report.dwell"), _LASER),
    **dict.fromkeys(
        [f"report.{of}_temperature_{when}" for of in ("air", "material") for when in ("before", "after")], _LASER
    ),
    **dict.fromkeys(("thermal_test.sensor_calibration", "thermal_test.mounting_length", "thermal_test.mounting_expansion"), _RECORD),
    **dict.fromkeys([f"thermal_test.tilts.{key}" for key in ("name", "channels.0", "channels.1", "distance")], _RECORD),
}  # fmt: skip
#: A number without its unit, maybe with an uncertainty: the label names the unit.
_BARE = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(\s*(\+-|±)\s*(\d+\.?\d*|\.\d+))?")


@cache
def known_fields() -> dict[str, Field]:
    """Return a field for every key of a campaign file that holds text, a number or a list of texts, by its dotted name."""
    schema = campaign_schema()
    fields = {_name(field): field for field in _fields_of((), schema, schema["$defs"])}
    return {name: _labelled(name, field) for name, field in fields.items()}


def _labelled(name: str, field: Field) -> Field:
    """Return a field under its label, which names the unit of a quantity."""
    label, unit = LABELS.get(name, field.label), UNITS.get(name, field.unit)
    label += f" ({print_unit(unit)})" if unit else ""
    return field._replace(label=label, unit=unit, hint=HINTS.get(name, field.hint), needed=name in _NEEDED)


def _name(field: Field) -> str:
    parts = [*field.table, field.line, field.key, field.item]
    return ".".join(str(part) for part in parts if part is not None)


def _fields_of(table: tuple[str, ...], model: Mapping[str, Any], models: Mapping[str, Any]) -> Iterator[Field]:
    """Yield the fields of a table and of the tables in it."""
    for key, given in model["properties"].items():
        spec, optional = _resolved(given, models)
        inner, _ = _resolved(spec.get("items") or spec.get("additionalProperties") or {}, models)
        if "properties" in spec:
            yield from _fields_of((*table, key), spec, models)
        elif "properties" in inner:
            # Corners of a region are drawn, roles of columns are chosen beside their values.
            if (named := ".".join((*table, key))) in _ROWS:
                yield from [Field((*table, key), "name", "")] if "name" not in inner["properties"] else []
                yield from _fields_of(tuple(named.split(".")), inner, models)
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


#: Tables that only hold together with keys that the file does not have yet, or that the files of FLIR cameras do not need.
_WITH_OTHERS = ("plan.axis", "thermography.stack", "record.header_rows", "record.long", "drivers.header_rows")


def _is_there(name: str, field: Field, campaign: CampaignText) -> bool:
    """Whether a campaign file has a table, or may be given it without more, and a key of it says something beside what was measured."""
    table, top = field.table, field.table[0]
    if top == "plan" and is_picture(campaign):
        return False
    if campaign.value(*table, field.key) is None and name in _ONLY_WITH:
        return any(campaign.value(one) is not None for one in _ONLY_WITH[name])
    if top in ("report", "accept", "thermal_test") or campaign.value(*table) is not None:
        return True
    if top in ("acceptance", "model"):
        return campaign.value("interferometry") is not None
    return len(table) > 1 and ".".join(table) not in _WITH_OTHERS and campaign.value(top) is not None


def form_fields(campaign: CampaignText, names: Iterable[str] = ()) -> dict[str, Field]:
    """Return the fields of the tables that a campaign file has or may be given; of a table with rows those of every row, a new one, and
    as many as `names` of fields mean.
    """
    found: dict[str, Field] = {}
    for name, field in known_fields().items():
        if not _is_there(name, field, campaign):
            continue
        table = ".".join(field.table)
        if table in _ROWS:
            typed = [
                int(one.removeprefix(f"{table}.").partition(".")[0]) for one in names if one.startswith(f"{table}.")
            ]
            count = max(len(_rows(campaign, field.table)), *typed, 0) + 1
            found |= {_name(one): one for one in (field._replace(line=line) for line in range(count))}
        else:
            found[name] = field
    return found


def _rows(campaign: CampaignText, table: tuple[str, ...]) -> list[dict[Any, Any]]:
    """Return the rows of a list of tables, or of tables by name, whose names are values of theirs."""
    found = campaign.value(*table) or []
    if isinstance(found, dict):
        return [{"name": name, **row} for name, row in found.items()]
    return [dict(row) for row in found]


def read_fields(campaign: CampaignText) -> dict[str, str]:
    """Return the fields of a campaign file with their present texts, empty where nothing is written."""
    return {name: _shown(_value(campaign, field), field) for name, field in form_fields(campaign).items()}


def _value(campaign: CampaignText, field: Field) -> Any:
    if field.line is None:
        value = campaign.value(*field.table, field.key)
    else:
        rows = _rows(campaign, field.table)
        value = rows[field.line].get(field.key) if field.line < len(rows) else None
    return value if field.item is None else _items(value, field.items)[field.item]


def write_fields(campaign: CampaignText, texts: Mapping[str, str]) -> CampaignText:
    """Write the fields that were changed."""
    fields = form_fields(campaign, texts)
    values: dict[Any, Any] = {}
    rows: dict[tuple[str, ...], list[dict[Any, Any]]] = {}
    wrong = []
    for name, typed in texts.items():
        field, text = fields[name], typed.strip()
        if text == _shown(_value(campaign, field), field):
            continue
        try:
            value = _written(text, field)
        except FusionError as error:
            wrong.append(f"{field.label}: {error}")
            continue
        if field.line is None:
            place, present = values, campaign.value(*field.table, field.key)
            key: Any = (*field.table, field.key)
        else:
            lines = rows.setdefault(field.table, _rows(campaign, field.table))
            lines += [{} for _ in range(field.line + 1 - len(lines))]
            place, key = lines[field.line], field.key
            present = place.get(key)
        if field.item is not None:
            items = place.get(key) or [one or TO_FILL for one in _items(present, field.items)]
            items[field.item] = value or TO_FILL
            value = items if field.needed or set(items) != {TO_FILL} else None
        place[key] = value
    if wrong:
        raise FieldError("\n".join(wrong))
    return campaign.with_values({**values, **{table: _table_of(table, lines) for table, lines in rows.items()}})


def _table_of(table: tuple[str, ...], rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return rows as the campaign file holds them, without empty ones: a list of tables, or tables by name; None where nothing is left."""
    kept = [{key: value for key, value in row.items() if value} for row in rows]
    kept = [row for row in kept if row]
    if ".".join(table) == "thermal_test.tilts":
        names = [row.pop("name", "") for row in kept]
        if "" in names or len(set(names)) < len(names):
            raise FieldError("every tilt needs a name of its own")
        return dict(zip(names, kept, strict=True)) or None
    return kept or None


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
    text = with_unit(text, field.unit)
    if field.unit and "+-" not in text and "±" not in text:
        read_quantity(text, field.unit)
    return text


def with_unit(text: str, unit: str) -> str:
    """Return a quantity as it was typed; a number alone with the unit that its label names."""
    return f"{text} {unit}" if unit and _BARE.fullmatch(text) else text


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
            title = TITLES.get(table, table)
            if table in _ROWS:
                shown = [fields[name] for name in names]
                parts += [heading(title, level=3), self._rows(table, shown, texts, _rows(campaign, shown[0].table))]
                continue
            first = [name for name in names if name in _FIRST or table in _WHOLE]
            # A draft marks what has to be filled in: that is never folded.
            first += [name for name in names if name not in first and _is_marked(campaign, fields[name])]
            others = {name: fields[name] for name in names if name not in first}
            if first:
                group = [self._widget(name, fields[name], texts[name]) for name in first]
                parts += [heading(title, level=3), _side_by_side(*group)]
            if others:
                parts.append(
                    self._folded(f"{title}: {counted(len(others), 'more field' if first else 'field')}", others, texts)
                )
        self.view[:] = parts

    def _rows(
        self, table: str, fields: Sequence[Field], texts: Mapping[str, str], stated: Sequence[object]
    ) -> pn.viewable.Viewable:
        """Return the rows of a table one below another, each with its number and a button that removes it; the last button adds one."""
        called, least = _ROWS[table]
        of_row = [field for field in fields if field.line == 0]
        below, places = column(), count()

        def number() -> None:
            for k, (title, *_) in enumerate(below, start=1):
                title.object = f"<h4>{called} {k}</h4>"

        def add(event: object = None) -> None:
            line = next(places)
            named = {_name(one): one for one in (field._replace(line=line) for field in of_row)}
            widgets = [self._widget(name, one, texts.get(name, ""), width=210) for name, one in named.items()]
            remove = pn.widgets.Button(label="Remove")
            row = column(heading("", level=4), _side_by_side(*widgets, remove))

            def take_away(event: object) -> None:
                # What is written in no field of a row is taken out of the file.
                self.write(dict.fromkeys(named, ""))
                below.remove(row)
                number()

            remove.on_click(take_away)
            below.append(row)
            number()

        for _ in range(max(len(stated), least)):
            add()
        button = pn.widgets.Button(label=f"Add {'an' if called[0] in 'AEIOU' else 'a'} {called.lower()}")
        button.on_click(add)
        return column(below, button)

    def _folded(self, title: str, fields: Mapping[str, Field], texts: Mapping[str, str]) -> pn.Card:
        card = pn.Card(title=title, collapsed=True, sizing_mode="stretch_width", margin=(4, 10))

        def unfold(event: object) -> None:
            if not card.objects:
                card[:] = [_side_by_side(*(self._widget(name, field, texts[name]) for name, field in fields.items()))]

        card.param.watch(unfold, "collapsed")
        return card

    def _widget(self, name: str, field: Field, text: str, *, width: int = 250) -> pn.widgets.Widget:
        if field.options:
            options = {CHOICES.get(one, one): one for one in field.options}
            widget = pn.widgets.Select(label=field.label, options=options, value=text, width=width)
        else:
            widget = pn.widgets.TextInput(label=field.label, value=text, placeholder=field.hint, width=width)
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


def _side_by_side(*widgets: pn.widgets.Widget) -> pn.FlexBox:
    """Return fields whose boxes are in line, however many lines their labels take."""
    return pn.FlexBox(*widgets, align_items="flex-end")


def _is_marked(campaign: CampaignText, field: Field) -> bool:
    """Whether a draft marks a key as one to be filled in."""
    found: Any = campaign.content
    for part in (*field.table, field.key):
        found = found.get(part) if isinstance(found, dict) else None
    return TO_FILL in found if isinstance(found, list) else found == TO_FILL
