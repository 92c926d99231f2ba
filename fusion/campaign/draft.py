"""A campaign file for a folder: what its files tell, what was answered, and marked lines for the rest."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np

from fusion.campaign.columns import ROLES, ColumnsError, TableProposal, propose_runs
from fusion.campaign.inspect import FolderContent, Kind, Recognised, scan_folder
from fusion.campaign.values import QuantityError, column_conversion, read_quantity, role_of_unit
from fusion.common import FusionError
from fusion.results.progress import counted
from fusion.results.store import is_text, write_text
from interferometry.common import InterferometryError
from interferometry.io.tables import NO_ZONE
from thermography.io.other_cameras import read_stack
from thermography.registration.plan import Fiducial

# What the files of a folder cannot tell: asked at the terminal, or left as a marked line to be filled in.

#: Mark of a line that somebody has to fill in before the campaign can run.
TO_FILL = "FILL IN"
#: ``ask(question, default)`` returns the answer; an empty one leaves the line to be filled in.
Ask = Callable[[str, str], str]


@dataclass(frozen=True)
class Asker:
    """Answers to questions from the terminal, or from defaults where ``ask`` is None; ``say`` shows what a question is about."""

    ask: Ask | None
    say: Callable[[str], None] = lambda text: None

    def text(self, question: str, default: str) -> str:
        """Return an answer of any text."""
        return default if self.ask is None else self.ask(question, default)

    def quantity(self, question: str, unit: str, default: str = "") -> str:
        """Return a number with unit as the campaign file writes it, quoted; the mark of a line to fill in where there is no answer."""
        while True:
            answer = self.text(question, default).strip()
            if not answer:
                return json.dumps(TO_FILL)
            try:
                read_quantity(answer, unit)
            except QuantityError as error:
                if self.ask is None:
                    raise
                self.say(str(error))
                continue
            return json.dumps(answer, ensure_ascii=False)

    def unit(self, question: str, target: str, default: str) -> str:
        """Return the unit of a column that can be converted to `target`."""
        while True:
            answer = self.text(question, default).strip()
            try:
                column_conversion(answer, target)
            except QuantityError as error:
                self.say(str(error))
                continue
            return answer

    def choice(self, question: str, names: tuple[str, ...]) -> str:
        """Return one of several names; the first where nothing is asked."""
        while True:
            answer = self.text(f"{question} ({', '.join(names)})", names[0]) if len(names) > 1 else names[0]
            if answer in names:
                return answer
            self.say(f'"{answer}" is not one of the choices')


_FILE = "campaign.toml"
_TITLE = "Title of the report"
#: Beginning of a drafted file, by which its examples in comments are distinguished from comments that somebody wrote.
DRAFTED = "# Written by thermofuse init."
#: How places of the frames can be given.
_PLACES = ("pixels", "fiducials")
#: Heading of the files that the campaign file does not name.
_NOT_USED = "# Files in this folder that are not used:"
#: Kinds that no campaign reads.
_NO_INPUT = (Kind.CAMPAIGN, Kind.RECIPE)
#: Values above this are kelvins and no temperatures of a machine table in degC.
_WARMEST_DEGC = 150.0
#: The name of an axis as a word of its own, and the line of a header that holds it: its heading, or the channel of an ecmc log's targets.
_AXIS = re.compile(r"(?<![^\W_])([XYZABC]\d?|[UVW])(?:[-_ ]?ax[ei]s?|[-_ ]?achse)?(?![^\W_])", re.IGNORECASE)
_AXIS_LINE = re.compile(r"^\W*(?:axis|axe|achse|TGT_SET_PV)\b.*", re.IGNORECASE | re.MULTILINE)
#: Bytes of a file in which a header is looked for.
_HEADER = 4096


#: The line that says whether the table moves in the frames.
_STILL = 'table = "still"                          # every frame shows the table at axis position 0; "moving": frames during motion'
#: What a sheet to sign states beside the machine, by its key under [report], as it is asked for; the same of an instrument.
_SHEET = {
    "machine_serial_number": "Serial number of the machine",
    "control": "Control",
    "customer": "Customer",
    "location": "Location of the machine",
    "operator": "Operator",
    "approved_by": "Who approves the report",
    "report_number": "Number of the report",
    "sign_convention": "Sign convention of the deviations",
    "warm_up": "Warm-up before the test",
    "machine_compensation": "Compensation that was active in the machine",
    "sensor_places": "Places of the sensors",
}
_INSTRUMENT = {"serial_number": "Serial number of the instrument", "certificate": "Certificate of its calibration"}
#: Tolerances of an axis with an example, and what each is of.
_TOLERANCES = {
    "A": ("20 um", "bidirectional accuracy"),
    "R": ("10 um", "bidirectional repeatability"),
    "E": ("15 um", "bidirectional systematic deviation"),
    "M": ("10 um", "range of the mean bidirectional deviation"),
    "B": ("5 um", "reversal"),
    "A_unidirectional": ("15 um", "of either approach"),
    "R_unidirectional": ("8 um", "of either approach"),
    "E_unidirectional": ("12 um", "of either approach"),
}
#: Conditions of a positioning test that are asked for together: key under [report] and an example.
_MOTION = {
    "travel": ("axis_travel", "900 mm"),
    "lead": ("screw_lead", "10 mm"),
    "feed": ("feed", "5000 mm/min"),
    "dwell": ("dwell", "3 s"),
}
_KINDS = ("not stated", "spindle", "environment", "linear axis", "rotary axis")


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
    path = folder / _FILE
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
    path, content = folder / _FILE, content or scan_folder(folder.resolve())
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
        told = [*content.unknown, *others][:3]
        unknown = "; ".join(f"{content.relative(one.path)}: {one.reason or one.kind.value.words}" for one in told)
        raise DraftError(
            f"{content.folder}: neither thermal frames nor deviations nor a record of temperatures and displacements in it"
            + (f" ({unknown})" if unknown else "; name the folder that holds the files of the measurement")
        )
    yield f"{DRAFTED} Every quantity carries its unit in the value; paths start from the folder of this file."
    yield f'# A line with "{TO_FILL}" has to be completed; thermofuse check {_FILE} says what is still missing.'
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
        yield from (
            f"#   {_plain(content.relative(one.path))}: {one.kind.value.words}{one.kind.value.unused}" for one in left
        )
        yield from (f"#   {_plain(content.relative(one.path))}: {_plain(one.reason)}" for one in content.unknown)


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
    answer = asker.text(f"Axis that {path.name} is of; empty: not stated", "")
    yield f"axis = {_quoted(answer)}" if answer else '# axis = "X"'


def _time_zone(readings: Sequence[Recognised], asker: Asker) -> Iterator[str]:
    """Yield the zone of times that the readings give without one."""
    without = [one.path.name for one in readings if _attributes(one).get("reference") == NO_ZONE]
    if not without:
        yield '# time_zone = "Europe/Vienna"            # only where files give times without their zone'
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
    emissivity = asker.text(
        "Emissivity of the surface, such as 0.95 or 0.95 +- 0.02; empty: as stored in the frames", ""
    )
    example = '# emissivity = "0.95 +- 0.02"            # left out: as stored in the frames'
    yield f"emissivity = {_quoted(emissivity)}" if emissivity else example
    yield '# reflected_temperature = "22 degC"        # this and the next three: left out = as stored in the frames'
    yield '# atmospheric_temperature = "22 degC"'
    yield "# relative_humidity = 0.45"
    yield '# object_distance = "1.2 m"'
    if along_axis:
        yield '# clock_offset = "0 s"                     # camera clock minus laser clock; 0 s where both follow one time server'
        yield _STILL
    yield from _optional("lens", content, Kind.LENS)


def _stack(content: FolderContent, asker: Asker, *, along_axis: bool) -> Iterator[str]:
    """Yield what files of temperatures do not hold themselves."""
    first = content.frame_files[0]
    _, contents, values = read_stack(first)
    yield '# camera_offset_u = "1 K"                  # accuracy in the camera\'s data sheet; left out = that of an uncooled camera'
    yield from [_STILL] if along_axis else []
    yield from _optional("lens", content, Kind.LENS)
    yield from ("", "[thermography.stack]                     # temperatures of another camera: docs/formats.md")
    if values.dtype.kind in "iu":
        yield f'scale = {_quoted(TO_FILL)}   # of one count, for example 0.04 with unit = "K"'
    if not contents.unit:
        guess = "K" if np.nanmedian(values) > _WARMEST_DEGC else "degC"
        yield f"unit = {_quoted(asker.choice('Unit of the temperatures', tuple(sorted(('degC', 'K'), key=guess.__ne__))))}"
    if contents.times is None and (contents.frames > 1 or len(content.frame_files) > 1):
        pattern = _time_in_name(first.name)
        if pattern:
            yield f"time_in_name = {_quoted(pattern)}   # local time: write its time_zone below"
        else:
            yield f'start = {_quoted(TO_FILL)}   # or times = "times.csv" (file,frame,time), or time_in_name = "%Y%m%d_%H%M%S"'
    if contents.frames > 1 and contents.times is None:
        yield f"interval = {asker.quantity('Time from one frame to the next', 's')}"
    yield '# time_zone = "Europe/Vienna"              # of these times; left out = UTC'
    yield "# emissivity = 0.95                        # as it was set in the camera's program, with reflected_temperature"


def _time_in_name(name: str) -> str:
    """Return the pattern of a date and a time of day in a name, "" where there is none."""
    found = re.search(r"(?:19|20)\d{2}([-_]?)\d{2}\1\d{2}([-_T ]+)\d{2}([-_.]?)\d{2}\3\d{2}", name)
    if found is None:
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
    sides = {"Width (x)": width, "Height (y)": height}
    size = [asker.quantity(f"{name} of the plan", "mm", default) for name, default in sides.items()]
    guess = "   # guessed from the fiducials, with the same margin on both sides: check it"
    guessed = guess if asker.ask is None and width else ""
    yield f"size = [{', '.join(size)}]{guessed}"
    yield f"cell_size = {asker.quantity('Size of a cell of the field; it divides both sides', 'mm', '5 mm')}"
    name = _quoted(content.relative(listed[0].path) if listed else TO_FILL)
    yield f"fiducials = {name}   # name,x_mm,y_mm,diameter_mm[,column_px,row_px]"
    if not listed:
        yield "# a table of at least four places that are known in mm: discs on the table, or points picked by hand with their pixel"
        yield "# (column_px,row_px) and an empty diameter; init finds it in the folder"
    yield from _others("fiducials", content, listed)
    yield from _optional("regions", content, Kind.REGIONS)
    if not along_axis:
        return
    yield from ("", "[plan.axis]")
    x = asker.quantity("Plan point under the spindle at axis position 0, x", "mm")
    y = asker.quantity("Plan point under the spindle at axis position 0, y", "mm")
    yield f"origin = [{x}, {y}]   # plan point under the spindle at axis position 0"
    yield f"direction = {_direction(asker)}   # how that point moves as the axis position grows: [1, 0] right, [-1, 0] left, [0, 1] down"


def _interferometry(content: FolderContent, asker: Asker) -> Iterator[str]:
    readings = {content.relative(one.path): one for one in content.of(Kind.DEVIATIONS)}
    chosen = asker.choice("Which file holds the deviations", tuple(readings))
    yield from ("", "[interferometry]")
    yield f"deviations = {_quoted(chosen)}"
    yield from (f"# deviations = {_quoted(name)}   # also found" for name in readings if name != chosen)
    yield from _optional(
        "environment", content, Kind.ENVIRONMENT, lacking='# environment = "environment.csv"   # none was found'
    )
    known = _attributes(readings[chosen])
    if known.get("units") == "arcsec":
        yield "# a rotary axis: neither expansion nor dead path enter its angles"
        return
    if content.frame_files and content.of(Kind.ENVIRONMENT):
        yield _material_sensor(asker)
    coefficient = asker.quantity(
        "Expansion coefficient of the part that carries the scale or the workpiece", "ppm/K", "11.7 ppm/K"
    )
    yield f"expansion_coefficient = {coefficient}"
    yield f"dead_path = {asker.quantity('Dead path of the laser', 'mm', '0 mm')}"
    if known.get("origin") == "reconstructed":
        yield '# feed = "300 mm/min"                     # with dwell: places the readings of this file more closely in time'
        yield '# dwell = "2 s"'


def _material_sensor(asker: Asker) -> str:
    """Return the line with the place of the material sensor, which confirms the scale of the temperatures."""
    example = (
        '# material_sensor = ["350 mm", "90 mm"]   # its place on the plan: confirms the scale of the temperatures'
    )
    question = "Plan point of the material temperature sensor, such as 350 mm, 90 mm; empty: not known"
    while answer := asker.text(question, "").strip():
        parts = [part.strip() for part in answer.split(",")]
        try:
            for part in parts:
                read_quantity(part, "mm")
        except QuantityError as error:
            asker.say(str(error))
            continue
        if len(parts) == 2:
            return f"material_sensor = [{_quoted(parts[0])}, {_quoted(parts[1])}]"
        asker.say(f'"{answer}" is not x and y')
    return example


def _attributes(readings: Recognised) -> dict[str, str]:
    """Return what is known of a file of deviations and of its times; nothing where it cannot be read, which the check says."""
    try:
        deviations = readings.content
        known = {**deviations.attrs, **deviations["time"].attrs, "units": deviations["deviation"].attrs["units"]}
        return {str(name): str(value) for name, value in known.items()}
    except InterferometryError:
        return {}


def _report(asker: Asker, *, linear: bool) -> Iterator[str]:
    """Yield what the sheet to sign prints: machine, people and conditions, of a test along a linear axis its tolerances and motion too."""
    motion = {}
    if linear:
        yield from _acceptance(asker)
        asked = "Travel of the axis, lead of the screw, feed and dwell, such as"
        units = {name: example.partition(" ")[2] for name, (_, example) in _MOTION.items()}
        example = ", ".join(f"{name} {value}" for name, (_, value) in _MOTION.items())
        motion = _by_name(asker, f"{asked} {example}; empty: not stated", units)
    machine = asker.text("Machine; empty: the names on the sheet to sign stay to be filled in", "").strip()
    mark = "" if machine or motion else "# "
    yield ""
    yield f"{mark}[report]                               # identity and conditions of the test, for the sheet to sign"
    yield f"{'' if machine else '# '}machine = {_quoted(machine or 'name of the machine')}"
    for key, question in _SHEET.items():
        answer = asker.text(f"{question}; empty: not stated", "").strip() if machine else ""
        yield f"{key} = {_quoted(answer)}" if answer else f'# {key} = ""'
    if linear:
        for name, (key, example) in _MOTION.items():
            yield f"{key} = {_quoted(motion[name])}" if name in motion else f"# {key} = {_quoted(example)}"
        for of in ("air", "material"):
            yield f'# {of}_temperature_before = "20.0 degC"    # left out: as logged'
            yield f'# {of}_temperature_after = "20.0 degC"'
    yield '# remarks = ""'
    name = asker.text("Instrument; empty: not stated", "").strip() if machine else ""
    mark = "" if name else "# "
    yield from ("", f"{mark}[[report.instrument]]", f"{mark}name = {_quoted(name or 'laser interferometer')}")
    for key, question in _INSTRUMENT.items():
        answer = asker.text(f"{question}; empty: not stated", "").strip() if name else ""
        yield f"{key} = {_quoted(answer)}" if answer else f'# {key} = ""'
    yield _calibrated(asker) if name else "# calibrated = 2026-01-15"


def _acceptance(asker: Asker) -> Iterator[str]:
    """Yield the tolerances of the axis."""
    question = "Tolerances of the axis by ISO 230-2, such as A 20 um, R 10 um; empty: none"
    stated = _by_name(asker, question, dict.fromkeys(_TOLERANCES, "um"))
    yield from (
        "",
        f"{'' if stated else '# '}[acceptance]                           # tolerances: what has none is not judged",
    )
    for symbol, (example, of) in _TOLERANCES.items():
        line = f"{symbol} = {_quoted(stated.get(symbol, example))}"
        yield line if symbol in stated else f"# {line}   # {of}"


def _by_name(asker: Asker, question: str, units: dict[str, str]) -> dict[str, str]:
    """Return quantities that are answered by their names in one line, such as "A 20 um, R 10 um"."""
    while answer := asker.text(question, "").strip():
        pairs = [part.strip().replace("=", " ").partition(" ")[::2] for part in answer.split(",")]
        found = {name: quantity.strip() for name, quantity in pairs}
        try:
            for name, quantity in found.items():
                if name not in units:
                    raise DraftError(f'"{name}" is none of {", ".join(units)}')
                read_quantity(quantity, units[name])
        except (DraftError, QuantityError) as error:
            asker.say(str(error))
            continue
        return found
    return {}


def _thermal_test(asker: Asker) -> Iterator[str]:
    """Yield what the sheet of ISO 230-3 needs to be told of a record."""
    kind = asker.choice("What was tested by ISO 230-3", _KINDS)
    mark = "# " if kind == _KINDS[0] else ""
    yield from ("", f"{mark}[thermal_test]                         # test of thermal effects by ISO 230-3")
    others = ", ".join(f'"{one}"' for one in _KINDS[2:])
    yield f'# kind = "spindle"                       # or {others}' if mark else f"kind = {_quoted(kind)}"
    yield '# sensor_calibration = "0.5 %"           # standard uncertainty of the sensitivity of the displacement sensors; left out: 1 %'
    yield '# mounting_length = "100 mm"             # of what holds sensors and target; left out: its expansion is not in the uncertainty'
    yield '# mounting_expansion = "11.7 ppm/K"'
    yield "# [thermal_test.tilts]                   # two displacements of one direction whose difference is a tilt"
    yield '# A = {channels = ["Y1", "Y2"], distance = "150 mm"}'


def _calibrated(asker: Asker) -> str:
    """Return the line with the day of the last calibration."""
    while answer := asker.text("Day of its calibration, such as 2026-01-15; empty: not stated", "").strip():
        try:
            return f"calibrated = {date.fromisoformat(answer)}"
        except ValueError:
            asker.say(f'"{answer}" is no day; write year-month-day')
    return "# calibrated = 2026-01-15"


def _drivers(content: FolderContent) -> Iterator[str]:
    if content.of(Kind.DRIVERS):
        yield from ("", "[drivers]")
        yield from _optional("file", content, Kind.DRIVERS)
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
        remark = f"   # {_plain(', '.join(filter(None, (column.span, column.remark))))}".rstrip("# ")
        if column.role in ROLES[1:-1]:
            yield f"{_quoted(column.heading)} = {_toml({'role': column.role, 'unit': column.unit})}{remark}"
        elif column.role == "out":
            unit = column.unit or "1"
            example = _toml({"role": role_of_unit(unit), "unit": unit})
            yield f"# {_quoted(_plain(column.heading))} = {example}{remark}"


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
        if key == "time_format":
            written = " ".join(column.first[0] for column in table.of("time"))
            question = f"Times such as {written} are written, %d the day and %m the month"
            keys[key] = asker.choice(question, (keys[key], shown))
        elif key == "time_unit":
            units = (keys[key], *(unit for unit in ("s", "min", "h") if unit != keys[key]))
            keys[key] = asker.choice(f"Unit of the times in {table.of('time')[0].heading}, {shown}", units)
        else:
            keys[key] = json.loads(asker.quantity("Time from one row to the next", "s", "60 s" if asker.ask else ""))
    guessed = [column for column in table.of("displacement") if column.remark]
    for unit in dict.fromkeys(column.unit for column in guessed):
        group = [column for column in guessed if column.unit == unit]
        about = ", ".join(f"{column.heading} ({column.span})" for column in group)
        answer = asker.unit(f"Unit of {about}; of counts one count, such as 0.0125 mm", "um", unit)
        taken = {column: replace(column, unit=answer) for column in group}
        table = replace(table, columns=tuple(taken.get(column, column) for column in table.columns))
    return replace(table, keys=keys)


def _optional(key: str, content: FolderContent, kind: Kind, *, lacking: str = "") -> Iterator[str]:
    """Yield the line of a file that a campaign may have."""
    listed = content.of(kind)
    if listed:
        yield f"{key} = {_quoted(content.relative(listed[0].path))}"
        yield from _others(key, content, listed)
    elif lacking:
        yield lacking


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


def _direction(asker: Asker) -> str:
    """Return the direction of the axis on the plan as a list of two numbers."""
    known = {"right": "[1, 0]", "left": "[-1, 0]", "down": "[0, 1]", "up": "[0, -1]"}
    if asker.ask is None:
        return _quoted(TO_FILL)
    return known[asker.choice("How that point moves over the plan as the axis position grows", tuple(known))]


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
