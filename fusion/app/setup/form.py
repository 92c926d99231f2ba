"""The form of a campaign file: a field for every key that its schema knows, read as text and written back where it changed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import count
from typing import Any

import panel as pn

from fusion.app.parts import Parts, beside, column, heading
from fusion.app.setup.campaign import CampaignText
from fusion.campaign.draft import DIRECTIONS, TO_FILL
from fusion.campaign.schema import Key, known_keys
from fusion.common import FusionError
from fusion.results.progress import counted

#: A drawn direction within this angle of a side of the plan is along it, degrees.
_ALONG_DEG = 3.0


class FieldError(FusionError):
    """Values that cannot be written into a campaign file; the message has a line for each."""


_DIRECTION = ("plan", "axis", "direction")
#: A number without its unit, maybe with an uncertainty: the label names the unit.
_BARE = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(\s*(\+-|±)\s*(\d+\.?\d*|\.\d+))?")


def is_picture(campaign: CampaignText) -> bool:
    """Whether the picture itself is the plan, which has no size in mm."""
    return campaign.value("plan", "registration") == "pixels" or campaign.value("plan") is None


def _is_there(one: Key, campaign: CampaignText) -> bool:
    """Whether a campaign file has a table, or may be given it without more, and a key of it says something beside what was measured."""
    if one.table[0] == "plan" and is_picture(campaign):
        return False
    if one.of and campaign.value(*one.table, one.key) is None:
        return any(campaign.value(table) is not None for table in one.of)
    return all(campaign.value(*table) is not None for table in one.within)


def form_fields(campaign: CampaignText, names: Iterable[str] = ()) -> dict[str, Key]:
    """Return the fields of the tables that a campaign file has or may be given; of a table with rows those of every row, a new one, and
    as many as `names` of fields mean.
    """
    found: dict[str, Key] = {}
    for name, field in known_keys().items():
        if not _is_there(field, campaign):
            continue
        if field.row:
            table = ".".join(field.table)
            typed = [
                int(one.removeprefix(f"{table}.").partition(".")[0]) for one in names if one.startswith(f"{table}.")
            ]
            count = max(len(_rows(campaign, field.table)), *typed, 0) + 1
            found |= {one.name: one for one in (field._replace(line=line) for line in range(count))}
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


def _value(campaign: CampaignText, field: Key) -> Any:
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
            wrong.append(f"{field.shown}: {error}")
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
    if table == ("thermal_test", "tilts"):
        names = [row.pop("name", "") for row in kept]
        if "" in names or len(set(names)) < len(names):
            raise FieldError("every tilt needs a name of its own")
        return dict(zip(names, kept, strict=True)) or None
    return kept or None


def missing(campaign: CampaignText) -> list[str]:
    """Return what has to be filled in before a campaign can run: labels of fields, and other lines as they stand."""
    fields = form_fields(campaign)
    needed = {name: field for name, field in fields.items() if field.needed}
    labels = [needed[name].shown for name, text in read_fields(campaign).items() if name in needed and text == ""]
    known = ("#", *(f"{field.key} = " for field in known_keys().values() if field.needed))
    lines = [line.partition("   #")[0].rstrip() for line in campaign.text.splitlines() if f'"{TO_FILL}"' in line]
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


def _shown(value: Any, field: Key) -> str:
    if value is None:
        return field.options[0] if field.options else ""
    if (*field.table, field.key) == _DIRECTION:
        return direction_text(*value) if isinstance(value, list) and any(value) else ""
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _written(text: str, field: Key) -> Any:
    """Return a value as the campaign file holds it; None takes it away, a mark stands for what has to be filled in."""
    if not text:
        return TO_FILL if field.needed else None
    if (*field.table, field.key) == _DIRECTION:
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
    return text if "+-" in text or "±" in text else field.check(text)


def with_unit(text: str, unit: str) -> str:
    """Return a quantity as it was typed; a number alone with the unit that its label names."""
    return f"{text} {unit}" if unit and _BARE.fullmatch(text) else text


# The fields as widgets.


class Form:
    """Fields of a campaign file, in groups by table, those without which it cannot run in a group of their own (`required`); `on_change`
    takes the name of a field whose text has changed.

    Keys that few tests state are folded, and get their widgets when they are first unfolded.
    """

    def __init__(self, on_change: Callable[[str], None]) -> None:
        self._on_change = on_change
        self._widgets: dict[str, pn.widgets.Widget] = {}
        self.view, self.required = column(), column()

    def show(self, campaign: CampaignText) -> None:
        """Show the fields of a campaign file."""
        self._widgets = {}
        fields, texts = form_fields(campaign), read_fields(campaign)
        required = [one for one in fields.values() if not one.row and (one.needed or _is_marked(campaign, one))]
        marked = [one._replace(label=f"{one.label} *") for one in required]
        self.required[:] = [heading("Required (*)", level=3), self._side_by_side(marked, texts)] if marked else []
        tables: dict[tuple[str, ...], list[Key]] = {}
        for field in fields.values():
            if field not in required:
                tables.setdefault(field.table, []).append(field)
        parts: Parts = []
        for table, listed in tables.items():
            title = listed[0].title
            if listed[0].row:
                parts += [heading(title, level=3), self._rows(listed, texts, _rows(campaign, table))]
                continue
            # What init asks for or shows is never folded.
            first = [one for one in listed if one.first]
            others = [one for one in listed if not one.first]
            if first:
                parts += [heading(title, level=3), self._side_by_side(first, texts)]
            if others:
                parts.append(
                    self._folded(f"{title}: {counted(len(others), 'more field' if first else 'field')}", others, texts)
                )
        self.view[:] = parts

    def _rows(self, fields: Sequence[Key], texts: Mapping[str, str], stated: Sequence[object]) -> pn.viewable.Viewable:
        """Return the rows of a table one below another, each with its number and a button that removes it; the last button adds one."""
        of_row = [field for field in fields if field.line == 0]
        called, least = of_row[0].row, of_row[0].rows
        below, places = column(), count()

        def number() -> None:
            for k, (title, *_) in enumerate(below, start=1):
                title.object = f"<h4>{called} {k}</h4>"

        def add(event: object = None) -> None:
            line = next(places)
            row_fields = [field._replace(line=line) for field in of_row]
            remove = pn.widgets.Button(label="Remove")
            row = column(heading("", level=4), self._side_by_side(row_fields, texts, remove, width=210))

            def take_away(event: object) -> None:
                # What is written in no field of a row is taken out of the file.
                self.write({one.name: "" for one in row_fields})
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

    def _folded(self, title: str, fields: Sequence[Key], texts: Mapping[str, str]) -> pn.Card:
        card = pn.Card(title=title, collapsed=True, sizing_mode="stretch_width", margin=(4, 10))

        def unfold(event: object) -> None:
            if not card.objects:
                card[:] = [self._side_by_side(fields, texts)]

        card.param.watch(unfold, "collapsed")
        return card

    def _side_by_side(
        self, fields: Sequence[Key], texts: Mapping[str, str], *others: pn.widgets.Widget, width: int = 250
    ) -> pn.Row:
        """Return fields whose boxes are in line, however many lines their labels take."""
        widgets = [self._widget(field, texts.get(field.name, ""), width=width) for field in fields]
        return beside(*widgets, *others, **{"align-items": "flex-end"})

    def _widget(self, field: Key, text: str, *, width: int) -> pn.widgets.Widget:
        if field.options:
            options = {field.choices.get(one, one or "not stated"): one for one in field.options}
            widget = pn.widgets.Select(label=field.shown, options=options, value=text, width=width)
        else:
            hint = f"left out: {field.absent}" if field.absent else field.example
            widget = pn.widgets.TextInput(label=field.shown, value=text, placeholder=hint, width=width)
        widget.param.watch(lambda event: self._on_change(field.name), "value")
        self._widgets[field.name] = widget
        return widget

    @property
    def texts(self) -> dict[str, str]:
        """Present texts by name of the field, of all that were shown."""
        return {name: str(widget.value) for name, widget in self._widgets.items()}

    def write(self, texts: Mapping[str, str]) -> None:
        """Write texts into fields, where the campaign file has them."""
        for name in texts.keys() & self._widgets.keys():
            self._widgets[name].value = texts[name]


def _is_marked(campaign: CampaignText, field: Key) -> bool:
    """Whether a draft marks a key as one to be filled in."""
    found: Any = campaign.content
    for part in (*field.table, field.key):
        found = found.get(part) if isinstance(found, dict) else None
    return TO_FILL in found if isinstance(found, list) else found == TO_FILL
