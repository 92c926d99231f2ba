"""The campaign file as text with values: drafted as `thermofuse init` does, or read back; its comments stay where values change."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import panel as pn
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array

from fusion.app.parts import PathError, allowed_folder, allowed_path, column, file_name, heading, paragraph, table
from fusion.campaign.values import read_quantity
from fusion.common import FusionError
from fusion.pipeline.draft import DRAFTED, TO_FILL, Asker, draft_lines
from fusion.pipeline.inspect import Inspected, Kind, inspect_paths, scan_folder
from fusion.results.store import write_atomically

_FILE = "campaign.toml"
#: Where the version of a campaign file goes that is replaced.
_BEFORE = "campaign.toml.before"

#: Names of tables and of the key in them.
Key = tuple[str, ...]


class CampaignTextError(FusionError):
    """A campaign file that cannot be opened or saved; the message says why and what to do."""


@dataclass(frozen=True)
class CampaignText:
    """A campaign file that is being written; `saved` is its content when it was opened or saved, None where there is none yet."""

    path: Path
    text: str
    saved: str | None

    def value(self, *key: str) -> Any:
        """Return a value."""
        found: Any = tomllib.loads(self.text)
        for name in key:
            found = found.get(name) if isinstance(found, dict) else None
        return _without_marks(found)

    def with_values(self, values: Mapping[Key, object]) -> CampaignText:
        """Return it with other values; comments and everything else stay."""
        text = self.text
        for (*tables, name), value in values.items():
            if value is not None:
                text = _uncommented(text, tables, name)
        document = tomlkit.parse(text)
        for (*tables, name), value in values.items():
            if value is None and self.value(*tables, name) is None:
                continue
            table: Any = document
            for each in tables:
                table = table.setdefault(each, tomlkit.table())
                if not isinstance(table, MutableMapping):
                    raise CampaignTextError(
                        f"{self.path}: {each} is no table; write [{'.'.join(tables)}] above its keys in an editor"
                    )
            _set(table, name, value)
        return replace(self, text=tomlkit.dumps(document))

    def save(self) -> CampaignText:
        """Write it into its folder; the version before stays beside it."""
        present = _read(self.path) if self.path.exists() else None
        if present != self.saved:
            raise CampaignTextError(
                f"{self.path} was changed by another page or program since it was opened here; look into the folder again to see its values"
            )
        if present == self.text:
            return self
        if present is not None:
            _write(self.path.with_name(_BEFORE), present)
        # New lines end as those of the file do.
        text = self.text.replace("\r\n", "\n").replace("\n", "\r\n") if "\r\n" in (present or "") else self.text
        _write(self.path, text)
        return CampaignText(self.path, text, text)


def open_campaign(folder: Path) -> CampaignText:
    """Open the campaign file of a folder, or draft one where there is none."""
    path = folder / _FILE
    if path.exists():
        return read_campaign(path)
    return CampaignText(path, "\n".join(draft_lines(scan_folder(folder), Asker(None))) + "\n", None)


def read_campaign(path: Path) -> CampaignText:
    """Read a campaign file."""
    try:
        text = _read(path)
        tomllib.loads(text)
        tomlkit.parse(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, TOMLKitError) as error:
        raise CampaignTextError(
            f"{path}: this is not TOML ({error}); correct it in an editor, or move it away"
        ) from None
    return CampaignText(path, text, text)


def _read(path: Path) -> str:
    """Return the text of a file with its line endings as they are."""
    return path.read_bytes().decode("utf-8")


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda part: part.write_bytes(text.encode("utf-8")))


def _uncommented(text: str, tables: Sequence[str], name: str) -> str:
    """Return a drafted text in which the example of a key in a comment of its table is written as the key itself."""
    if not text.startswith(DRAFTED):
        return text
    header, example = f"[{'.'.join(tables)}]", f"# {name} = "
    lines, inside = text.splitlines(keepends=True), False
    for index, line in enumerate(lines):
        if line.startswith("["):
            inside = line.startswith(header)
        if inside and line.startswith(f"{name} = "):
            return text
        if inside and line.startswith(example):
            with suppress(tomllib.TOMLDecodeError):
                tomllib.loads(line.removeprefix("# "))
                return "".join([*lines[:index], line.removeprefix("# "), *lines[index + 1 :]])
    return text


def _set(table: Any, name: str, value: object) -> None:
    """Set, replace or take away one key."""
    if value is None:
        del table[name]
    elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        entries = tomlkit.aot()
        for item in value:
            entry = tomlkit.table()
            entry.update(item)
            entry.add(tomlkit.nl())
            entries.append(entry)
        table[name] = entries
    elif isinstance(value, list) and isinstance(table.get(name), Array) and len(table[name]) == len(value):
        # Item by item: comments between them stay.
        for index, item in enumerate(value):
            if table[name][index] != item:
                table[name][index] = item
    else:
        table[name] = value


def _without_marks(found: Any) -> Any:
    """Return a value with None in place of every mark of what has to be filled in."""
    if isinstance(found, list):
        return [_without_marks(item) for item in found]
    return None if found == TO_FILL else found


# What a campaign file says that somebody types: read from it as text, and written back where it was changed.

#: Directions along the plan, as `thermofuse init` names them.
DIRECTIONS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}
#: A drawn direction within this angle of a side of the plan is along it, degrees.
_ALONG_DEG = 3.0


class FieldError(FusionError):
    """Values that cannot be written into a campaign file; the message has a line for each."""


class Field(NamedTuple):
    """One value that somebody types: a key of a table, or an item of a list of two; `needed` where a campaign cannot run without it."""

    table: tuple[str, ...]
    key: str
    label: str
    #: Of a quantity; empty for text.
    unit: str = ""
    hint: str = ""
    item: int | None = None
    options: tuple[str, ...] = ()
    needed: bool = False


_TEST, _CAMERA, _PLAN, _LASER, _RECORD, _REPORT = (
    ("campaign",), ("thermography",), ("plan",), ("interferometry",), ("record",), ("report",)
)  # fmt: skip
_AXIS = ("plan", "axis")
#: Headings of the tables, in order.
GROUPS = {
    _TEST: "Test", _CAMERA: "Camera", _PLAN: "Plan", _AXIS: "Axis on the plan", _LASER: "Laser", _RECORD: "Record",
    _REPORT: "Report"
}  # fmt: skip
_AS_STORED, _SPINDLE = "as stored in the frames", "Spindle at axis position 0"
FIELDS = {
    "title": Field(_TEST, "title", "Title of the report", needed=True),
    "axis": Field(_TEST, "axis", "Axis that was measured", hint="X"),
    "time_zone": Field(_TEST, "time_zone", "Time zone of times without one", hint="Europe/Vienna"),
    "emissivity": Field(_CAMERA, "emissivity", "Emissivity of the table", hint=_AS_STORED),
    "reflected": Field(_CAMERA, "reflected_temperature", "Reflected temperature", "degC", _AS_STORED),
    "clock_offset": Field(_CAMERA, "clock_offset", "Camera clock minus laser clock", "s", "0 s"),
    "table": Field(_CAMERA, "table", "The table in the frames", options=("still", "moving")),
    "width": Field(_PLAN, "size", "Width of the plan (x)", "mm", "700 mm", 0, needed=True),
    "height": Field(_PLAN, "size", "Height of the plan (y)", "mm", "180 mm", 1, needed=True),
    "cell": Field(_PLAN, "cell_size", "Size of a cell of the field", "mm", "5 mm"),
    "origin_x": Field(_AXIS, "origin", f"{_SPINDLE}, x", "mm", "500 mm", 0, needed=True),
    "origin_y": Field(_AXIS, "origin", f"{_SPINDLE}, y", "mm", "90 mm", 1, needed=True),
    "direction": Field(_AXIS, "direction", "It moves, as the position grows", hint="left", needed=True),
    "expansion": Field(_LASER, "expansion_coefficient", "Expansion coefficient", "ppm/K", "11.7 ppm/K"),
    "dead_path": Field(_LASER, "dead_path", "Dead path of the laser", "mm", "0 mm"),
    "every": Field(_RECORD, "every", "Time from one row to the next", "s", "60 s"),
    "time_unit": Field(_RECORD, "time_unit", "Unit of the times", options=("s", "min", "h", "ms")),
    "machine": Field(_REPORT, "machine", "Machine, as the report names it", hint="not stated"),
}


def is_picture(campaign: CampaignText) -> bool:
    """Whether the picture itself is the plan, which has no size in mm."""
    return campaign.value("plan", "registration") == "pixels" or campaign.value("plan") is None


def read_fields(campaign: CampaignText) -> dict[str, str]:
    """Return the fields of a campaign file with their present texts, empty where nothing is written."""
    # Only a table without times, or with times without a unit, has these keys.
    record = tomllib.loads(campaign.text).get("record", {})
    return {
        name: _shown(campaign.value(*field.table, field.key), field)
        for name, field in FIELDS.items()
        if field.table == _REPORT
        or (field.key in record if field.table == _RECORD else campaign.value(*field.table) is not None)
        if field.table != _PLAN or not is_picture(campaign)
    }


def write_fields(campaign: CampaignText, texts: Mapping[str, str]) -> CampaignText:
    """Write the fields that were changed."""
    before = read_fields(campaign)
    values: dict[tuple[str, ...], Any] = {}
    wrong = []
    for name, typed in texts.items():
        field, text = FIELDS[name], typed.strip()
        if text == before.get(name, ""):
            continue
        key = (*field.table, field.key)
        try:
            value = _written(text, field)
        except FusionError as error:
            wrong.append(f"{field.label}: {error}")
            continue
        if field.item is not None:
            pair = values.get(key) or [one or TO_FILL for one in _pair(campaign.value(*key))]
            pair[field.item] = value
            value = pair
        values[key] = value
    if wrong:
        raise FieldError("\n".join(wrong))
    return campaign.with_values(values)


def missing(campaign: CampaignText) -> list[str]:
    """Return what has to be filled in before a campaign can run: labels of fields, and other lines as they stand."""
    needed = {name: field for name, field in FIELDS.items() if field.needed}
    labels = [needed[name].label for name, text in read_fields(campaign).items() if name in needed and text == ""]
    known = ("#", *(f"{field.key} = " for field in needed.values()))
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


def _pair(value: Any) -> list[Any]:
    return value if isinstance(value, list) and len(value) == 2 else [None, None]


def _shown(value: Any, field: Field) -> str:
    if field.item is not None:
        value = _pair(value)[field.item]
    if value is None:
        return field.options[0] if field.options else ""
    if field.key == "direction":
        return direction_text(*value) if isinstance(value, list) and any(value) else ""
    return str(value)


def _written(text: str, field: Field) -> Any:
    """Return a value as the campaign file holds it; None takes it away, a mark stands for what has to be filled in."""
    if not text:
        return TO_FILL if field.needed else None
    if field.key == "direction":
        return list(read_direction(text))
    if field.unit and "+-" not in text and "±" not in text:
        read_quantity(text, field.unit)
    return text


# The fields of a campaign file as widgets.


class Form:
    """Fields of a campaign file, in groups by table; `on_change` takes the name of a field whose text has changed."""

    def __init__(self, on_change: Callable[[str], None]) -> None:
        self._on_change = on_change
        self._widgets: dict[str, pn.widgets.Widget] = {}
        self.view = column()

    def show(self, campaign: CampaignText) -> None:
        """Show the fields that a campaign file has."""
        self._widgets = {}
        for name, text in read_fields(campaign).items():
            field = FIELDS[name]
            if field.options:
                widget = pn.widgets.Select(label=field.label, options=list(field.options), value=text, width=250)
            else:
                widget = pn.widgets.TextInput(label=field.label, value=text, placeholder=field.hint, width=250)
            widget.param.watch(lambda event, name=name: self._on_change(name), "value")
            self._widgets[name] = widget
        parts = []
        for name_of_table, title in GROUPS.items():
            group = [widget for name, widget in self._widgets.items() if FIELDS[name].table == name_of_table]
            parts += [heading(title, level=3), pn.FlexBox(*group)] if group else []
        self.view[:] = parts

    @property
    def texts(self) -> dict[str, str]:
        """Present texts by name of the field."""
        return {name: str(widget.value) for name, widget in self._widgets.items()}

    def write(self, texts: Mapping[str, str]) -> None:
        """Write texts into fields, where the campaign file has them."""
        for name in texts.keys() & self._widgets.keys():
            self._widgets[name].value = texts[name]


# What was recognised in a folder, with its warnings, in the words of `thermofuse inspect`.


def found_in_folder(folder: Path) -> list[pn.viewable.Viewable]:
    """Return what a folder holds, as parts of a screen."""
    looked_into = list(inspect_paths([folder]))
    if [one.label for one in looked_into] == [str(folder)]:
        return [paragraph(f"{folder} holds no file; put the files of the measurement into it", kind="fault")]
    usable = [one for one in looked_into if not one.fault]
    parts = [heading("What was recognised", level=3)]
    if usable:
        rows = [(name_in(folder, one), one.kind.value, content_of(one)) for one in usable]
        parts.append(table(("file or series", "kind", "content"), rows, caption=f"Files in {folder}", stacked=True))
    for one in looked_into:
        name = name_in(folder, one)
        if one.kind is Kind.CAMPAIGN and Path(name).parent != Path():
            told = f"{name} is the campaign file of a folder below; to open it, look into {folder / Path(name).parent}"
            parts.append(paragraph(told, kind="warning"))
        parts += [paragraph(f"{name}: {line}", kind="warning") for line in warnings_of(one)]
        if one.fault:
            parts.append(paragraph(f"{name} is not used: {one.fault}", kind="fault" if one.fails else "warning"))
    return parts


def name_in(folder: Path, one: Inspected) -> str:
    """Return the name of a file or a series within its folder."""
    return one.label.removeprefix(str(folder)).lstrip("/\\")


def content_of(one: Inspected) -> str:
    """Return what a file holds as sentences on one line, without its path and its warnings."""
    first, *rest = one.lines
    told = [first.removeprefix(one.label).lstrip(": "), *rest]
    return "; ".join(line.strip() for line in told if not line.startswith("  warning"))


def warnings_of(one: Inspected) -> list[str]:
    """Return the warnings of a file without the word."""
    return [line.strip().removeprefix("warning: ") for line in one.lines if line.startswith("  warning")]


# Files that are dropped on the page go into the folder of the measurement.

#: Largest file that is taken, MB: it passes through the memory of the browser and of the application.
LARGEST_MB = 100


class UploadError(FusionError):
    """A file that is not taken; the message says why and what to do."""


def store_upload(root: Path, folder: Path, name: str, content: bytes | str) -> Path:
    """Write a file that was dropped on the page."""
    inside = allowed_folder(root, folder)
    data = content.encode("utf-8") if isinstance(content, str) else content
    if len(data) > LARGEST_MB * 1_000_000:
        raise UploadError(f"{name} is larger than {LARGEST_MB} MB; copy it into {inside} with the file manager")
    path = allowed_path(root, inside / file_name(name))
    if path.parent != inside:
        raise PathError(f"{name} leads out of {inside}; give the file a name without folders")
    if path.exists():
        raise UploadError(f"{path} exists already and is not replaced; give the file another name")
    return write_atomically(path, lambda part: part.write_bytes(data))
