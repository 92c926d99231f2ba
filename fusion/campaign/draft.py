"""A campaign file for a folder: what its files tell, what was answered, and marked lines for the rest."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from fusion.campaign.columns import ROLES, UNIT_NOT_KNOWN, ColumnsError, TableProposal, propose_runs
from fusion.campaign.inspect import FolderContent, Kind, Recognised, scan_folder
from fusion.campaign.schema import Key, keys_of, known_keys
from fusion.campaign.values import column_conversion, role_of_unit
from fusion.common import CAMPAIGN_FILE, FusionError
from fusion.results.progress import counted
from fusion.results.store import is_text, write_text
from interferometry.common import InterferometryError
from interferometry.io.readings import NotStated
from interferometry.io.tables import NO_ZONE
from thermography.io.other_cameras import AXES, StackError, read_stack
from thermography.registration.plan import Fiducial

# What the files of a folder cannot tell: asked at the terminal, or left as a marked line to be filled in.

#: Mark of a line that somebody has to fill in before the campaign can run.
TO_FILL = "FILL IN"
#: ``ask(question, default)`` returns the answer; an empty one leaves the line to be filled in.
Ask = Callable[[str, str], str]


T = TypeVar("T")


@dataclass(frozen=True)
class Asker:
    """Answers to questions from the terminal, or from defaults where ``ask`` is None; ``say`` shows what a question is about."""

    ask: Ask | None
    say: Callable[[str], None] = lambda text: None

    def text(self, question: str, default: str) -> str:
        """Return an answer of any text."""
        return default if self.ask is None else self.ask(question, default)

    def checked(self, question: str, default: str, check: Callable[[str], T]) -> T:
        """Return what `check` makes of an answer; one that it refuses is asked for again, after the reason."""
        while True:
            try:
                return check(self.text(question, default).strip())
            except ValueError as error:
                if self.ask is None:
                    raise
                self.say(str(error))

    def value(self, key: Key, default: str = "") -> str:
        """Return the answer to a key of the campaign file, empty where nothing is stated."""
        absent = "to be filled in" if key.needed else key.absent or "not stated"
        example = f", such as {key.example}" if key.example else ""
        question = "; ".join(filter(None, (key.label, key.about))) + ("" if default else f"{example}; empty: {absent}")
        return self.checked(question, default, lambda answer: answer and key.check(answer))

    def unit(self, question: str, target: str, default: str) -> str:
        """Return the unit of a column that can be converted to `target`."""

        def check(answer: str) -> str:
            column_conversion(answer, target)
            return answer

        return self.checked(question, default, check)

    def choice(self, question: str, names: tuple[str, ...]) -> str:
        """Return one of several names; the first where nothing is asked."""

        def check(answer: str) -> str:
            if answer not in names:
                raise DraftError(f'"{answer}" is not one of the choices')
            return answer

        return names[0] if len(names) == 1 else self.checked(f"{question} ({', '.join(names)})", names[0], check)


_TITLE = "Title of the report"
#: Beginning of a drafted file, by which its examples in comments are distinguished from comments that somebody wrote.
DRAFTED = "# Written by thermofuse init."
#: How places of the frames can be given.
_PLACES = ("pixels", "fiducials")
#: Heading of the files that the campaign file does not name.
_NOT_USED = "# Files in this folder that are not used:"
#: Kinds that no campaign reads.
_NO_INPUT = (Kind.CAMPAIGN, Kind.RECIPE, Kind.PRODUCT)
#: Values above this are kelvins and no temperatures of a machine table in degC, and above the other they may be in degF.
_WARMEST_DEGC, _COLDEST_DEGF = 150.0, 45.0
#: Kelvins of a table that are no tenths of a degree and no other count.
_COLDEST_K, _WARMEST_K = 230.0, 400.0
#: The name of an axis as a word of its own, and the line of a header that holds it: its heading, or the channel of an ecmc log's targets.
_AXIS = re.compile(r"(?<![^\W_])([XYZABC]\d?|[UVW])(?:[-_ ]?ax[ei]s?|[-_ ]?achse)?(?![^\W_])", re.IGNORECASE)
_AXIS_LINE = re.compile(r"^\W*(?:axis|axe|achse|TGT_SET_PV)\b.*", re.IGNORECASE | re.MULTILINE)
#: Bytes of a file in which a header is looked for.
_HEADER = 4096


#: Directions along the plan.
DIRECTIONS = {"right": (1, 0), "left": (-1, 0), "down": (0, 1), "up": (0, -1)}
#: Most quantities that a question shows as its example.
_MOST = 4


class DraftError(FusionError):
    """A folder for which no campaign file can be written; the message says why and what to do."""


def write_campaigns(folder: Path, asker: Asker) -> list[tuple[Path, list[str]]]:
    """Look at a folder and write a commented campaign file into it; of several tests without frames, one for each in a folder of its own.

    Returns every file with its lines that are left to be filled in.
    """
    _refuse_place(folder)
    content = scan_folder(folder.resolve())
    tests = separate_tests(content)
    if not tests:
        return [write_campaign(folder, asker, content)]
    stems = Counter(test.path.with_suffix("") for test in tests)
    written: list[tuple[Path, list[str]]] = []
    answers: dict[str, str] = {}
    for test in tests:
        once = Asker(asker.ask and _asking_once(asker.ask, answers), asker.say)
        own = test.path.with_suffix("")
        if stems[own] > 1 or own.is_file():
            own = own.with_name(f"{test.path.name.replace('.', '_')}_campaign")
        own.mkdir(exist_ok=True)
        files = {**content.files, Kind.DEVIATIONS: (test,)}
        written.append(write_campaign(own, once, replace(content, folder=own, files=files)))
    return written


def separate_tests(content: FolderContent) -> Sequence[Recognised]:
    """Return the tests of a folder that are campaigns of their own: several without frames."""
    tests = content.of(Kind.DEVIATIONS)
    return () if content.frames or len(tests) < 2 else tests


def _asking_once(ask: Ask, answers: dict[str, str]) -> Ask:
    """Ask for one of several campaigns what `answers` of those before do not say, and for no title: each has the name of its file."""
    answered: set[str] = set()

    def answer(question: str, default: str) -> str:
        if question == _TITLE:
            return default
        # A question that comes again for the same campaign is one whose answer was refused.
        if question in answered or question not in answers:
            answers[question] = ask(question, default)
        answered.add(question)
        return answers[question]

    return answer


def _refuse_place(folder: Path) -> None:
    """Refuse a folder that takes no new campaign file."""
    path = folder / CAMPAIGN_FILE
    if not folder.is_dir():
        raise DraftError(f"{folder}: no such folder; name the folder that holds the files of the measurement")
    if path.exists():
        raise DraftError(f"{path} exists already and is not replaced; thermofuse check {path} says what it lacks")
    if (folder / "results.json").is_file():
        raise DraftError(
            f"{folder}: holds the results of a run; name the folder that holds the files of the measurement"
        )


def write_campaign(folder: Path, asker: Asker, content: FolderContent | None = None) -> tuple[Path, list[str]]:
    """Write a commented campaign file into a folder; `content` is what it takes, left out: everything in the folder."""
    _refuse_place(folder)
    path, content = folder / CAMPAIGN_FILE, content or scan_folder(folder.resolve())
    lines = list(draft_lines(content, asker))
    unnamed = next((line for line in lines if not is_text(line)), None)
    if unnamed is not None:
        raise DraftError(f"{folder}: the name of a file in it is not UTF-8 ({unnamed!a}); give that file another name")
    write_text(path, "\n".join(lines) + "\n")
    return path, [
        f"line {number}: {line}"
        for number, line in enumerate(lines, start=1)
        if f'"{TO_FILL}"' in line and not line.startswith("#")
    ]


def draft_lines(content: FolderContent, asker: Asker) -> Iterator[str]:
    """Yield the lines of a campaign file, last the files of the folder that it does not name."""
    lines = list(_used_lines(content, asker))
    yield from lines
    yield from _not_used(content, lines)


def _used_lines(content: FolderContent, asker: Asker) -> Iterator[str]:
    """Yield what names and asks for everything that the campaign uses."""
    readings, records = content.of(Kind.DEVIATIONS), content.of(Kind.RECORD)
    if not (content.frames or readings or records):
        others = [one for kind, files in content.files.items() if kind not in _NO_INPUT for one in files]
        told = [*content.unknown, *others]
        unknown = "; ".join(f"{content.relative(one.path)}: {one.reason or one.kind.value.words}" for one in told[:3])
        logs = [
            one.logged for one in told if one.kind in (Kind.UNKNOWN, Kind.DRIVERS) and not isinstance(one.logged, str)
        ]
        apart = all(any(log.of(role) for log in logs) for role in ("temperature", "displacement"))
        raise DraftError(
            f"{content.folder}: neither thermal frames nor deviations nor a record of temperatures and displacements in it"
            + (f" ({unknown})" if unknown else "; name the folder that holds the files of the measurement")
            + (
                "; write the rows of all loggers into one table with the columns of all, empty where a logger has none"
                if apart
                else ""
            )
        )
    yield f"{DRAFTED} Every quantity carries its unit in the value; paths start from the folder of this file."
    yield f'# A line with "{TO_FILL}" has to be completed; thermofuse check {CAMPAIGN_FILE} says what is still missing.'
    yield ""
    yield "[campaign]"
    yield f"title = {_quoted(asker.text(_TITLE, content.folder.name or 'Campaign'))}"
    if readings:
        yield from _axis(readings[0], asker)
    yield from _time_zone(readings, asker)
    if content.frames:
        yield from _thermography(content, asker, along_axis=bool(readings))
        yield from _plan(content, asker, along_axis=bool(readings))
    if readings:
        yield from _interferometry(content, asker)
        yield from _report(asker, linear=_attributes(readings[0]).get("units") != "arcsec")
    if content.frames or readings:
        yield from _drivers(content)
    else:
        yield from _record(content, records, asker)
        yield from _report(asker, linear=False)
        yield from _thermal_test(asker)


def unused_files(path: Path) -> list[str]:
    """Return what a campaign file of `write_campaign` says of the files next to it that it does not name."""
    lines = path.read_text(encoding="utf-8").splitlines()
    start = lines.index(_NOT_USED) + 1 if _NOT_USED in lines else len(lines)
    return [line.removeprefix("#   ") for line in lines[start:]]


def _not_used(content: FolderContent, lines: Sequence[str]) -> Iterator[str]:
    """Yield as comments every file with measurements that no line names, and what was not understood."""
    active = "\n".join(line for line in lines if not line.startswith("#"))
    measured = [one for kind, files in content.files.items() if kind not in _NO_INPUT for one in files]
    left = [one for one in measured if _quoted(content.relative(one.path)) not in active]
    if left or content.unknown:
        yield from ("", _NOT_USED)
        offered = "; [drivers] above names it in comments"
        for one in (*left, *content.unknown):
            name = content.relative(one.path)
            if one.temperatures is not None:
                words = f"temperatures without a displacement{offered if f'# file = {_quoted(name)}' in lines else ''}"
            else:
                words = _plain(one.reason) or f"{one.kind.value.words}{one.kind.value.unused}"
            yield f"#   {_plain(name)}: {words}"


def _axis(readings: Recognised, asker: Asker) -> Iterator[str]:
    """Yield the axis of a file of deviations: as its header, its name or its folder says, else as answered."""
    path = readings.path
    with path.open("rb") as stream:
        header = " ".join(_AXIS_LINE.findall(stream.read(_HEADER).decode("utf-8", errors="replace")))
    stated = json.loads(_attributes(readings).get("user_text", "{}")).get("axis", "")
    for source in (stated, header, path.stem, path.parent.name):
        found = {name.upper() for name in _AXIS.findall(source)}
        if len(found) == 1:
            yield f'axis = "{found.pop()}"   # as the file or its name says'
            return
    axis = known_keys()["campaign.axis"]
    yield _line(axis, asker.text(f"Axis that {path.name} is of; empty: not stated", ""))


def _time_zone(readings: Sequence[Recognised], asker: Asker) -> Iterator[str]:
    """Yield the zone of times that the readings give without one."""
    without = [one.path.name for one in readings if _attributes(one).get("reference") == NO_ZONE]
    if not without:
        yield _line(known_keys()["campaign.time_zone"])
        return
    zone = asker.text("Time zone of the times of the deviations, an IANA name such as Europe/Vienna", "UTC")
    doubt = "   # taken, as the file gives none: check it" if asker.ask is None else ""
    yield f"time_zone = {_quoted(zone)}{doubt}"


def _thermography(content: FolderContent, asker: Asker, *, along_axis: bool) -> Iterator[str]:
    yield from ("", "[thermography]")
    yield f"frames = [{', '.join(_quoted(pattern) for pattern in content.frames)}]   # {counted(len(content.frame_files), 'file')}"
    if content.of_temperatures:
        yield from _stack(content, asker, along_axis=along_axis)
        return
    keys = [one for one in keys_of("thermography") if along_axis or not one.of]
    yield from _lines(keys, {one.key: asker.value(one) for one in keys if one.ask})
    yield from _optional("lens", content, Kind.LENS)


def _stack(content: FolderContent, asker: Asker, *, along_axis: bool) -> Iterator[str]:
    """Yield what files of temperatures do not hold themselves."""
    first = content.frame_files[0]
    try:
        _, contents, values = read_stack(first)
    except StackError:
        # Of an array both orders of whose axes make pictures.
        yield f'axes = "{TO_FILL}"   # {" or ".join(AXES)}'
        _, contents, values = read_stack(first, AXES[0])
    known = {one.key: one for one in keys_of("thermography", "stack")}
    yield _line(known_keys()["thermography.camera_offset_u"])
    yield from [_line(known_keys()["thermography.table"])] if along_axis else []
    yield from _optional("lens", content, Kind.LENS)
    yield from ("", "[thermography.stack]                     # temperatures of another camera: docs/formats.md")
    if values.dtype.kind in "iu":
        yield _line(known["scale"], asker.value(known["scale"]) or TO_FILL)
    if not contents.unit:
        middle = float(np.nanmedian(values))
        units = tuple(sorted(("degC", "K"), key=("K" if middle > _WARMEST_DEGC else "degC").__ne__))
        # Degrees Celsius of a table, or its kelvins; whole numbers may be tenths of either.
        usual = middle <= _COLDEST_DEGF or _COLDEST_K < middle < _WARMEST_K
        whole = bool((values == np.round(values))[np.isfinite(values)].all())
        in_doubt = asker.ask is None and (not usual or whole)
        unit = TO_FILL if in_doubt else asker.choice("Unit of the temperatures", units)
        yield f"unit = {_quoted(unit)}   # of °F: degC with scale = 0.5556, offset = -17.78"
    if contents.times is None and (contents.frames > 1 or len(content.frame_files) > 1):
        pattern = _time_in_name(first.name)
        if pattern:
            yield f"time_in_name = {_quoted(pattern)}   # local time: write its time_zone below"
        else:
            yield f"{_line(known['start'], TO_FILL)}; or times, or time_in_name"
            yield from (_line(known[key]) for key in ("times", "time_in_name"))
    if contents.frames > 1 and contents.times is None and contents.elapsed is None:
        yield _line(known["interval"], asker.value(known["interval"]) or TO_FILL)
    yield from _lines(known.values(), {})


def _time_in_name(name: str) -> str:
    """Return the pattern of a date and a time of day in a name, "" where there is none."""
    found = re.search(r"(?:19|20)\d{2}([-_]?)\d{2}\1\d{2}([-_T ]+)\d{2}([-_.]?)\d{2}\3\d{2}", name)
    # A clock of twelve hours is asked.
    if found is None or re.match(r"[-_. ]?[AP]M(?![A-Z])", name[found.end() :], re.IGNORECASE):
        return ""
    day, between, clock = found.groups()
    return f"%Y{day}%m{day}%d{between}%H{clock}%M{clock}%S"


def _plan(content: FolderContent, asker: Asker, *, along_axis: bool) -> Iterator[str]:
    listed = content.of(Kind.FIDUCIALS)
    if not (listed or along_axis):
        where = asker.choice(
            "No table of fiducials was found: places in pixels of the picture, or on a plan in mm", _PLACES
        )
        if where == "pixels":
            yield from ("", "[plan]")
            yield 'registration = "pixels"                  # no fiducials were found: the picture is the plan, without millimetres'
            yield "# for a plan in mm: size, cell_size and fiducials (at least four places on the table that are known in mm)"
            return
    yield ""
    yield "[plan]                                   # the table in mm: x to the right, y down, from one corner"
    fiducials: list[Fiducial] = listed[0].content if listed else []
    width, height = _extent(fiducials)
    known = known_keys()
    guess = "   # guessed from the fiducials, with the same margin on both sides: check it"
    yield _pair("plan.size", asker, width, height) + (guess if asker.ask is None and width else "")
    cell = known["plan.cell_size"]
    yield _line(cell, asker.value(cell, cell.example) or TO_FILL)
    name = _quoted(content.relative(listed[0].path) if listed else TO_FILL)
    yield f"fiducials = {name}   # {known['plan.fiducials'].about}"
    if not listed:
        yield "# a table of at least four places that are known in mm, discs on the table or picked points; init finds it in the folder"
    yield from _others("fiducials", content, listed)
    yield from _optional("regions", content, Kind.REGIONS)
    if not along_axis:
        return
    yield from ("", "[plan.axis]")
    yield f"{_pair('plan.axis.origin', asker)}   # plan point under the spindle at axis position 0"
    direction = known["plan.axis.direction"]
    chosen = asker.ask and DIRECTIONS[asker.choice(direction.label, tuple(DIRECTIONS))]
    yield f"direction = {list(chosen) if chosen else _quoted(TO_FILL)}   # {direction.told}"


def _pair(name: str, asker: Asker, *defaults: str) -> str:
    """Return the line of a key of two items with the answers to both."""
    items = [known_keys()[f"{name}.{item}"] for item in (0, 1)]
    answers = [asker.value(one, default) for one, default in zip(items, defaults or ("", ""), strict=True)]
    if not any(answers) and not items[0].needed:
        return f"# {items[0].key} = {_toml([one.example for one in items])}   # {items[0].about}"
    return f"{items[0].key} = {_toml([answer or TO_FILL for answer in answers])}"


def _interferometry(content: FolderContent, asker: Asker) -> Iterator[str]:
    readings = {content.relative(one.path): one for one in content.of(Kind.DEVIATIONS)}
    chosen = asker.choice("Which file holds the deviations", tuple(readings))
    yield from ("", "[interferometry]")
    yield f"deviations = {_quoted(chosen)}"
    yield from (f"# deviations = {_quoted(name)}   # also found" for name in readings if name != chosen)
    yield from _optional("environment", content, Kind.ENVIRONMENT)
    known = _attributes(readings[chosen])
    if known.get("units") == "arcsec":
        yield "# a rotary axis: neither expansion nor dead path enter its angles"
        return
    keys = {one.name.removeprefix("interferometry."): one for one in keys_of("interferometry")}
    yield from (_line(keys[key], asker.value(keys[key]) or TO_FILL) for key in known.get("lacking", "").split())
    if not content.of(Kind.ENVIRONMENT):
        yield _line(keys["environment"])
    elif content.frame_files:
        yield _pair("interferometry.material_sensor", asker)
    yield from (_line(one, asker.value(one, one.default) or TO_FILL) for one in keys.values() if one.ask)
    if known.get("origin") == "reconstructed":
        yield from (_line(keys[key]) for key in ("feed", "dwell"))


def _attributes(readings: Recognised) -> dict[str, str]:
    """Return what is known of a file of deviations and of its times; nothing where it cannot be read, which the check says."""
    try:
        deviations = readings.content
        known = {**deviations.attrs, **deviations["time"].attrs, "units": deviations["deviation"].attrs["units"]}
        return {str(name): str(value) for name, value in known.items()}
    except NotStated as error:
        return {"lacking": " ".join(error.keys)}
    except InterferometryError:
        return {}


def _report(asker: Asker, *, linear: bool) -> Iterator[str]:
    """Yield what the sheet to sign prints: machine, people and conditions, of a test along a linear axis its tolerances and motion too."""
    keys = keys_of("report", of="interferometry" if linear else "record")
    if linear:
        judged = keys_of("acceptance")
        tolerances = {one.key: one for one in judged if one.ask}
        yield from _section("acceptance", judged, _by_name(asker, "Tolerances of the axis by ISO 230-2", tolerances))
    motion = {one.key.rpartition("_")[2]: one for one in keys if one.unit and one.ask}
    asked = [one for one in keys if one.ask and one not in motion.values()]
    answers = _by_name(asker, ", ".join(one.label for one in motion.values()), motion) if motion else {}
    answers["machine"] = asker.text("Machine; empty: the names on the sheet to sign stay to be filled in", "").strip()
    if answers["machine"]:
        answers |= {one.key: asker.value(one) for one in asked if one.key != "machine"}
    yield from _section("report", keys, answers)
    name, *others = keys_of("report", "instrument")
    named = {name.key: asker.value(name) if answers["machine"] else ""}
    yield from _section(
        "[report.instrument]", [name, *others], named | {one.key: asker.value(one) for one in others if named[name.key]}
    )


def _by_name(asker: Asker, question: str, keys: Mapping[str, Key]) -> dict[str, str]:
    """Return quantities by their keys that are answered by names in one line, such as "A 20 um, R 10 um"."""

    def check(answer: str) -> dict[str, str]:
        pairs = [part.strip().replace("=", " ").partition(" ")[::2] for part in answer.split(",") if answer]
        for name, quantity in pairs:
            if name not in keys:
                raise DraftError(f'"{name}" is none of {", ".join(keys)}')
            keys[name].check(quantity)
        return {keys[name].key: quantity.strip() for name, quantity in pairs}

    example = ", ".join(f"{name} {one.example}" for name, one in [*keys.items()][:_MOST])
    return asker.checked(f"{question}, such as {example}; empty: not stated", "", check)


def _thermal_test(asker: Asker) -> Iterator[str]:
    """Yield what the sheet of ISO 230-3 needs to be told of a record."""
    keys = keys_of("thermal_test")
    unstated, *kinds = ("not stated", *keys[0].options[1:])
    kind = asker.choice("What was tested by ISO 230-3", (unstated, *kinds))
    yield from _section("thermal_test", keys, {} if kind == unstated else {keys[0].key: kind})
    yield f"# [thermal_test.tilts]   # {keys_of('thermal_test', 'tilts')[0].title}"
    yield '# A = {channels = ["Y1", "Y2"], distance = "150 mm"}'


def _section(name: str, keys: Collection[Key], answers: Mapping[str, str]) -> Iterator[str]:
    """Yield a table of the file, in comments where nothing of it was answered."""
    title = next(iter(keys)).title
    yield from ("", f"{'' if any(answers.values()) else '# '}[{name}]   # {title}")
    yield from _lines(keys, answers)


def _lines(keys: Iterable[Key], answers: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of keys that are answered or shown."""
    yield from (_line(one, answers.get(one.key, "")) for one in keys if one.first)


def _line(key: Key, answer: str = "") -> str:
    """Return the line of a key with its answer, else its example as a comment with what it is."""
    if answer and answer != TO_FILL:
        return f"{key.key} = {_written(key, answer)}"
    line = f"{key.key} = {_quoted(answer)}" if answer else f"# {key.key} = {_written(key, key.example)}"
    return f"{line}   # {key.remark}" if key.remark else line


def _written(key: Key, text: str) -> str:
    """Return a text as the file holds it: numbers and dates without quotes."""
    bare = key.kind == "date" or (key.kind == "number" and re.fullmatch(r"[\d.]+", text))
    return text if bare else _quoted(text)


def _drivers(content: FolderContent) -> Iterator[str]:
    if content.of(Kind.DRIVERS):
        yield from ("", "[drivers]")
        yield from _optional("file", content, Kind.DRIVERS)
    else:
        # Drivers have no line for every change.
        logs = ((one.temperatures, content.relative(one.path)) for one in (*content.of(Kind.RECORD), *content.unknown))
        yield from next((_offered(table, name) for table, name in logs if table and "long" not in table.keys), ())
    if content.frames and content.of(Kind.DEVIATIONS):
        yield from ("", "[model]", 'declared = ["axis_expansion", "table_offset"]')


def _record(content: FolderContent, records: Sequence[Recognised], asker: Asker) -> Iterator[str]:
    """Yield a record: all files with the columns of the first, in whatever order, are runs of one test."""
    first = records[0]
    runs = [one for one in records if sorted(one.headings) == sorted(first.headings)]
    name = content.relative(first.path)
    table = _confirmed(propose_runs([one.content for one in runs]), name, asker)
    yield from ("", "[record]                                 # temperatures and displacements over time")
    names = [_quoted(content.relative(one.path)) for one in runs]
    yield f"files = [{', '.join(names)}]" if len(names) > 1 else f"file = {names[0]}"
    yield from (f"{key} = {_toml(value)}" for key, value in table.keys.items())
    yield from _others("file", content, [one for one in records if one not in runs], all_of_them=True)
    yield from ("", "[record.columns]                         # a column without a line here is left out")
    for column in table.columns:
        stated = column.unit if column.remark == UNIT_NOT_KNOWN else ""
        remark = f"   # {_plain(', '.join(filter(None, (column.span, stated, column.remark))))}".rstrip("# ")
        if column.role in ROLES[1:-1]:
            unit = TO_FILL if stated and asker.ask is None else column.unit
            yield f"{_quoted(column.heading)} = {_toml({'role': column.role, 'unit': unit})}{remark}"
        elif column.role == "out":
            unit = column.unit or "1"
            example = _toml({"role": role_of_unit(unit), "unit": unit})
            yield f"# {_quoted(_plain(column.heading))} = {example}{remark}"


def _offered(table: TableProposal, name: str) -> Iterator[str]:
    """Yield a log of temperatures as drivers, in comments."""
    yield from (
        "",
        "# [drivers]                              # temperatures that the drift may follow: remove each # to use them",
    )
    yield f"# file = {_quoted(name)}"
    yield from (f"# {key} = {_toml(value)}" for key, value in table.keys.items())
    yield "# [drivers.columns]"
    used = (one for one in table.columns if one.role in ROLES[1:-1])
    yield from (f"# {_quoted(one.heading)} = {_toml({'role': one.role, 'unit': one.unit})}" for one in used)


def _confirmed(table: TableProposal, name: str, asker: Asker) -> TableProposal:
    """Return a table as somebody wants its columns to be taken: as proposed, or corrected, with what its file does not tell."""
    if asker.ask is None and table.lacks:
        raise DraftError(f"{table.path}: {table.lacks}")
    while asker.ask is not None:
        asker.say(f"{name}, {counted(table.rows, 'row')}:")
        for line in (*table.lines(), *filter(None, [table.lacks])):
            asker.say(line)
        number, lacking = len(table.columns), next(iter(table.lacking), "")
        example = f"{number} = {lacking}" if lacking else "3-5 = temperature degC; 7 = out"
        question = f"Column of the {lacking}, such as" if lacking else "Columns as shown; or corrections, such as"
        answer = asker.text(f'{question} "{example}"', "").strip()
        try:
            table = table.corrected(answer)
        except ColumnsError as error:
            asker.say(str(error))
            continue
        if not answer:
            break
    keys = dict(table.keys)
    for key, shown in table.asked.items():
        if key in ("time_format", "date_order", "start") or (key == "sheet" and asker.ask):
            written = keys[key] if key == "sheet" else " ".join(column.first[0] for column in table.of("time"))
            choices = (keys[key], *(one for one in shown.split(" or ") if one not in ("", keys[key])))
            keys[key] = asker.choice(f"{known_keys()[f'record.{key}'].label}, such as {written}", choices)
        elif key == "sheet" or (key == "time_unit" and table.of("time")[0].remark and not asker.ask):
            keys[key] = TO_FILL
        elif key == "time_unit":
            units = (keys[key], *(unit for unit in ("s", "min", "h", "d") if unit != keys[key]))
            keys[key] = asker.choice(f"Unit of the times in {table.of('time')[0].heading}, {shown}", units)
        else:
            keys[key] = asker.value(known_keys()["record.every"], "60 s" if asker.ask else "") or TO_FILL
    guessed = [column for column in table.of("displacement") if column.remark and column.remark != UNIT_NOT_KNOWN]
    not_known = [column for column in table.columns if column.remark == UNIT_NOT_KNOWN and column.role in ROLES[1:3]]
    for role, unit in dict.fromkeys(
        (column.role, column.unit) for column in guessed + (not_known if asker.ask else [])
    ):
        group = [column for column in (*guessed, *not_known) if (column.role, column.unit) == (role, unit)]
        about = ", ".join(f"{column.heading} ({column.span})" for column in group)
        target, one = ("um", "0.0125 mm") if role == "displacement" else ("degC", "0.1 degC")
        answer = asker.unit(f"Unit of {about}; of counts or volts what one is, such as {one}", target, unit)
        taken = {
            column: replace(column, unit=answer, remark="" if column in not_known else column.remark)
            for column in group
        }
        table = replace(table, columns=tuple(taken.get(column, column) for column in table.columns))
    assumed = [key for key in table.asked if keys.get(key, TO_FILL) != TO_FILL and key != "every"]
    assumed += [
        column.heading
        for column in table.columns
        if column in guessed or (column.role in ROLES[1:-1] and column.is_guessed)
    ]
    return replace(table, keys=keys | ({"guessed": assumed} if assumed and asker.ask is None else {}))


def _optional(key: str, content: FolderContent, kind: Kind) -> Iterator[str]:
    """Yield the line of a file that a campaign may have."""
    listed = content.of(kind)
    if listed:
        yield f"{key} = {_quoted(content.relative(listed[0].path))}"
        yield from _others(key, content, listed)


def _others(
    key: str, content: FolderContent, listed: Sequence[Recognised], *, all_of_them: bool = False
) -> Iterator[str]:
    """Yield files that could stand in place of the first as comments."""
    for one in listed if all_of_them else listed[1:]:
        yield f"# {key} = {_quoted(content.relative(one.path))}   # also found"


def _extent(fiducials: Sequence[Fiducial]) -> tuple[str, str]:
    """Return width and height of a plan on which the fiducials have about the same margin on both sides; empty without fiducials."""
    if not fiducials:
        return "", ""
    radius = max(one.diameter_mm for one in fiducials) / 2.0

    def side(places: Sequence[float]) -> str:
        tens = max(round((min(places) + max(places)) / 10.0), math.ceil((max(places) + radius) / 10.0))
        return f"{10 * tens} mm"

    return side([one.x_mm for one in fiducials]), side([one.y_mm for one in fiducials])


def _toml(value: object) -> str:
    """Return a value as TOML writes it on one line."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return _quoted(value) if isinstance(value, str) else str(value)


def _quoted(text: str) -> str:
    """Return a text as a TOML string."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(text: str) -> str:
    """Return a text that stays on its line of comment."""
    return "".join(letter if letter.isprintable() else " " for letter in text)
