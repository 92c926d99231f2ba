"""The campaign file of a folder on the screen *Set up*: recordings, fiducials, plan and form, saved and checked."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from fusion.app import parts as ui
from fusion.app.setup import plan as places
from fusion.app.setup.campaign import CampaignText, open_campaign
from fusion.app.setup.plan import FrameView, Placed, Plan, PlanView, RegionsView
from fusion.app.setup.times import TimesView, recordings_of
from fusion.campaign.columns import ROLES, TableProposal
from fusion.campaign.draft import DIRECTIONS, TO_FILL, Asker, separate_tests, write_campaigns
from fusion.campaign.inspect import FolderContent, Kind, Recording, scan_folder
from fusion.campaign.schema import Key, known_keys
from fusion.campaign.values import QuantityError, read_quantity
from fusion.common import FusionError
from fusion.common.messages import BAD_INPUT
from fusion.pipeline.check import CampaignCheck, check_campaign
from fusion.results.progress import counted
from interferometry.common import InterferometryError
from thermography.common import ThermographyError
from thermography.registration.plan import Fiducial, PlanGrid, read_fiducials

# The form: a field for every key that the schema of the campaign file knows, read as text and written back where it changed.

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
        self.view, self.required = ui.column(), ui.column()

    def show(self, campaign: CampaignText) -> None:
        """Show the fields of a campaign file."""
        self._widgets = {}
        fields, texts = form_fields(campaign), read_fields(campaign)
        required = [one for one in fields.values() if not one.row and (one.needed or _is_marked(campaign, one))]
        marked = [one._replace(label=f"{one.label} *") for one in required]
        self.required[:] = [ui.heading("Required (*)", level=3), self._side_by_side(marked, texts)] if marked else []
        tables: dict[tuple[str, ...], list[Key]] = {}
        for field in fields.values():
            if field not in required:
                tables.setdefault(field.table, []).append(field)
        parts: ui.Parts = []
        for table, listed in tables.items():
            title = listed[0].title
            if listed[0].row:
                parts += [ui.heading(title, level=3), self._rows(listed, texts, _rows(campaign, table))]
                continue
            # What init asks for or shows is never folded.
            first = [one for one in listed if one.first]
            others = [one for one in listed if not one.first]
            if first:
                parts += [ui.heading(title, level=3), self._side_by_side(first, texts)]
            if others:
                parts.append(
                    self._folded(f"{title}: {counted(len(others), 'more field' if first else 'field')}", others, texts)
                )
        self.view[:] = parts

    def _rows(self, fields: Sequence[Key], texts: Mapping[str, str], stated: Sequence[object]) -> pn.viewable.Viewable:
        """Return the rows of a table one below another, each with its number and a button that removes it; the last button adds one."""
        of_row = [field for field in fields if field.line == 0]
        called, least = of_row[0].row, of_row[0].rows
        below, places = ui.column(), count()

        def number() -> None:
            for k, (title, *_) in enumerate(below, start=1):
                title.object = f"<h4>{called} {k}</h4>"

        def add(event: object = None) -> None:
            line = next(places)
            row_fields = [field._replace(line=line) for field in of_row]
            remove = pn.widgets.Button(label="Remove")
            row = ui.column(ui.heading("", level=4), self._side_by_side(row_fields, texts, remove, width=210))

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
        return ui.column(below, button)

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
        return ui.beside(*widgets, *others, **{"align-items": "flex-end"})

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


# The columns of a record: first values, role and unit of each, as `thermofuse init` proposes them.


class ColumnsView:
    """First rows of a table, and a field for the role and the unit of every column."""

    def __init__(self) -> None:
        self._widgets: dict[str, tuple[pn.widgets.Select, pn.widgets.TextInput]] = {}
        self.view = ui.column()

    def show(self, proposed: TableProposal | None, stated: Mapping[str, Mapping[str, str]]) -> None:
        """Show the columns of a table with the roles and units that a campaign file states."""
        self._widgets = {}
        if proposed is None:
            self.view[:] = []
            return
        rows = [(one.heading, *one.first, one.span, one.remark) for one in proposed.columns]
        width = max(map(len, rows))
        rows = [(*row[:-2], *[""] * (width - len(row)), *row[-2:]) for row in rows]
        first = [f"row {k}" for k in range(1, width - 2)]
        shown = ui.table(
            ("column", *first, "range", "remark"),
            rows,
            caption=f"{proposed.path.name}, {counted(proposed.rows, 'row')}",
        )
        for one in proposed.columns:
            if one.role != "time":
                now = stated.get(one.heading, {"role": "out", "unit": one.unit})
                self._widgets[one.heading] = (
                    pn.widgets.Select(
                        label=f"{one.heading} holds", options=list(ROLES[1:]), value=now["role"], width=150
                    ),
                    pn.widgets.TextInput(
                        label=f"Unit of {one.heading}", value=now["unit"], placeholder="degC", width=150
                    ),
                )
        told = ui.note("Columns that are out are not read. A unit may be that of one count, such as 0.0125 mm.")
        pairs = [pn.Row(*pair) for pair in self._widgets.values()]
        self.view[:] = [ui.heading("Columns of the record", level=3), shown, told, ui.beside(*pairs)]

    @property
    def stated(self) -> dict[str, dict[str, Any]]:
        """Role and unit of every column that is not out, as the campaign file holds them."""
        return {
            name: {"role": role.value, "unit": unit.value.strip()}
            for name, (role, unit) in self._widgets.items()
            if role.value != "out"
        }


@dataclass(frozen=True)
class Opened:
    """What was read from a folder: its campaign file or the draft of one, the first thermogram (row, column; degC) with the fiducials
    found in it, what was recorded when, the axis positions of the targets, the table of a record, what could not be shown, and how many
    tests of an axis the folder holds where each is a campaign of its own.
    """

    folder: Path
    campaign: CampaignText
    frame: NDArray[np.float64] | None
    placed: Placed
    recordings: list[Recording]
    positions_mm: tuple[float, ...]
    table: TableProposal | None
    remarks: list[str]
    tests: int = 0


def open_folder(root: Path, folder: Path) -> Opened:
    """Read what the screen shows of a folder."""
    content, campaign = scan_folder(folder, within=root), open_campaign(folder, root)
    remarks: list[str] = []
    tests = len(separate_tests(content)) if campaign.saved is None else 0
    if tests:
        remarks.append(
            f"{tests} tests of an axis are in this folder, each a campaign of its own in a folder of its own; thermofuse fleet runs them "
            "all. Shown is the first alone."
        )
    frame, placed = None, Placed()
    if content.frames:
        try:
            frame = places.first_thermogram(content.frame_files, of_temperatures=content.of_temperatures)
            listed = listed_fiducials(root, campaign)
            placed = places.find(frame, listed, grid_of(campaign)) if listed else places.place([], frame.shape)
        except BAD_INPUT as error:
            remarks.append(str(error))
    table = None
    if campaign.value("record", "columns") is not None and content.of(Kind.RECORD):
        table = content.of(Kind.RECORD)[0].content
    return Opened(folder, campaign, frame, placed, recordings_of(content), positions_of(content), table, remarks, tests)


def listed_fiducials(root: Path, campaign: CampaignText) -> list[Fiducial]:
    """Return the fiducials that a campaign file names; none where it names no list."""
    name = campaign.value("plan", "fiducials")
    return read_fiducials(ui.allowed_path(root, campaign.path.parent / name)) if isinstance(name, str) else []


def grid_of(campaign: CampaignText) -> PlanGrid | None:
    """Return the plan that a campaign file states, None where its sides are missing."""
    try:
        width, height = (read_quantity(side, "mm") for side in campaign.value("plan", "size") or [None, None])
        cell = campaign.value("plan", "cell_size")
        return PlanGrid(width, height, read_quantity(cell, "mm") if cell else width)
    except (QuantityError, ThermographyError, ValueError, TypeError):
        return None


def positions_of(content: FolderContent) -> tuple[float, ...]:
    """Return the axis positions of the targets in a folder, mm; none where its deviations cannot be read."""
    for one in content.of(Kind.DEVIATIONS)[:1]:
        with suppress(InterferometryError):
            return tuple(np.unique(one.content["position"].values).tolist())
    return ()


class CampaignEditor:
    """The campaign file of an opened folder, drawn and typed, saved and checked."""

    def __init__(self, state: ui.State) -> None:
        self._state = state
        self._opened: Opened | None = None
        self._form = Form(self._on_field)
        self._frame = FrameView(self._draw_plan)
        self._regions = RegionsView(self._draw_plan)
        self._columns = ColumnsView()
        self._plan = PlanView(
            lambda x, y: self._form.write(
                {"plan.axis.origin.0": f"{round(x):g} mm", "plan.axis.origin.1": f"{round(y):g} mm"}
            ),
            lambda dx, dy: self._form.write({"plan.axis.direction": direction_text(dx, dy)}),
            self._regions.take_point,
            self._regions.take_corners,
        )
        self._times = TimesView(lambda offset: self._form.write({"thermography.clock_offset": f"{offset:g} s"}))
        self._save = pn.widgets.Button(label="Save campaign.toml and check it", color="primary")
        self._go = pn.widgets.Button(label="Go to Run", visible=False)
        self._split = pn.widgets.Button(label="Write a campaign for each test", color="primary")
        self._remarks, self._checked = ui.column(), ui.column()
        pictures = (self._times.view, self._frame.view, self._plan.view, self._regions.view)
        answer = ui.column(self._checked, styles={"max-height": "38vh", "overflow-y": "auto"})
        self.saving = ui.column(ui.beside(self._save, self._go), answer)
        shown = (self._form.required, *pictures, self._columns.view, self._form.view)
        self.view = ui.column(self._remarks, *shown)
        self._save.on_click(self._on_save)
        self._split.on_click(self._on_split)
        self._go.on_click(lambda event: setattr(state, "screen", "Run"))

    def show(self, opened: Opened) -> None:
        """Show what was read."""
        self._opened = opened
        remarks = [ui.paragraph(remark, kind="warning") for remark in opened.remarks]
        self._remarks[:] = [*remarks, *([self._split] if opened.tests else [])]
        self._form.show(opened.campaign)
        self._columns.show(opened.table, opened.campaign.value("record", "columns") or {})
        regions = opened.campaign.value("thermography", "region")
        picture = is_picture(opened.campaign)
        self._regions.show(list(regions) if isinstance(regions, list) else [], "px" if picture else "mm")
        for view in (self._frame, self._plan, self._regions):
            view.view.visible = opened.frame is not None and not (picture and view is self._frame)
        self._times.show(opened.recordings, self._offset_s())
        if opened.frame is not None:
            self._frame.show(opened.frame, opened.placed, grid_of(opened.campaign))
        self._checked[:] = []
        self._go.visible = False
        if self._state.folder != opened.folder:
            # Looking again into the same folder leaves what was chosen on another screen meanwhile.
            self._state.folder = opened.folder
            self._state.campaign = None if opened.campaign.saved is None else opened.campaign.path

    def _quantity(self, name: str, unit: str) -> float | None:
        """Return the quantity in a field; None where there is none."""
        try:
            return read_quantity(with_unit(self._form.texts.get(name, ""), unit), unit)
        except QuantityError:
            return None

    def _offset_s(self) -> float:
        return self._quantity("thermography.clock_offset", "s") or 0.0

    def _on_field(self, name: str) -> None:
        if name == "thermography.clock_offset":
            self._times.move(self._offset_s())
        elif name.startswith("plan."):
            self._draw_plan()

    def _draw_plan(self) -> None:
        """Draw the plan from the fields, the fiducials and the regions; nothing where its sides are missing."""
        sides = ("plan.size.0", "plan.size.1", "plan.axis.origin.0", "plan.axis.origin.1")
        width, height, x, y = (self._quantity(name, "mm") for name in sides)
        opened = self._opened
        if opened is not None and opened.frame is not None and is_picture(opened.campaign):
            height, width = (float(size) for size in opened.frame.shape)
        if opened is None or not width or not height or width <= 0 or height <= 0:
            return
        try:
            direction = read_direction(self._form.texts.get("plan.axis.direction", ""))
        except FieldError:
            direction = None
        origin = None if x is None or y is None else (x, y)
        unit = "px" if is_picture(opened.campaign) else "mm"
        plan = Plan(width, height, origin, direction, opened.positions_mm, tuple(self._regions.outlines), unit)
        self._plan.show(plan, self._frame.placed, opened.frame)

    async def _on_split(self, event: object) -> None:
        """Write a campaign for each test of the folder, as `thermofuse init` does, and show where they are."""
        assert self._opened is not None
        with ui.disabled_during(self._split), ui.telling(self._remarks):
            written = await asyncio.to_thread(write_campaigns, self._opened.folder, Asker(None))
            told = [
                f"{path}{': to be filled in: ' + ', '.join(lacking) if lacking else ''}" for path, lacking in written
            ]
            done = ui.paragraph("Written; look into their folders above to complete and run them:", kind="done")
            ui.schedule_parts(self._remarks, [done, ui.bullets(told)])

    async def _on_save(self, event: object) -> None:
        """Write the campaign file and the list of fiducials, and check both."""
        if self._opened is None:
            return
        with ui.disabled_during(self._save), ui.telling(self._checked):
            ui.schedule_parts(self._checked, [])
            campaign = self._write(self._opened)
            lacking = missing(campaign)
            if lacking:
                told = ui.paragraph("Saved. Before it can run, fill in:", kind="warning")
                ui.schedule_parts(self._checked, [told, ui.bullets(lacking)])
                return
            ui.schedule_parts(self._checked, [ui.note("Checking ...")])
            checked = await asyncio.to_thread(check_campaign, campaign.path)
            ui.schedule_update(lambda: self._ready(campaign.path, checked))

    def _ready(self, campaign: Path, checked: CampaignCheck) -> None:
        """Show the check of the saved file, and lead on to the run."""
        self._checked[:] = told_of_check(checked)
        self._go.visible = not checked.faults
        self._state.campaign = campaign

    def _write(self, opened: Opened) -> CampaignText:
        """Write what the screen shows; the list of fiducials where it was changed here."""
        campaign = write_fields(opened.campaign, self._form.texts)
        regions = self._regions.regions
        stated = campaign.value("thermography", "region")
        if regions != (stated or []) and (regions or isinstance(stated, list)):
            campaign = campaign.with_values({("thermography", "region"): regions or None})
        if opened.table is not None and self._columns.stated != campaign.value("record", "columns"):
            campaign = campaign.with_values({("record", "columns"): self._columns.stated})
        placed = self._frame.placed
        if opened.frame is not None and placed.fiducials != opened.placed.fiducials:
            written = places.write_picked(opened.folder, placed)
            campaign = campaign.with_values({("plan", "fiducials"): written.name})
        saved = campaign.save()
        self._opened = replace(opened, campaign=saved, placed=placed)
        if form_fields(saved).keys() != form_fields(opened.campaign).keys():
            # An instrument was added: there is room for another one.
            self._form.show(saved)
        return saved


def told_of_check(checked: CampaignCheck) -> ui.Parts:
    """Return a check of a campaign as parts of a screen."""
    doubts = [ui.paragraph(f"{one.evidence} {one.remedy}", kind="warning") for one in checked.doubts]
    if checked.faults:
        told = ("Saved, but not ready to run:", *checked.faults)
        return [*(ui.paragraph(one, kind="fault") for one in told), *doubts]
    notices = [ui.paragraph(f"{one.message} {one.remedy}".strip(), kind="warning") for one in checked.notices]
    ready = f"Saved and ready to run: {len(checked.checks) - len(checked.doubts)} checks passed."
    return [ui.paragraph(ready, kind="done"), ui.bullets(checked.content), *doubts, *notices]
