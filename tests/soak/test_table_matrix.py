"""Logged tables of every clock, unit, layout and locale, and tables of deviations, are read rightly, asked about, marked or refused: quoted
in docs/measured.csv.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import interferometry
from fusion.campaign.config import load_campaign
from fusion.campaign.draft import TO_FILL, Asker, write_campaign
from fusion.campaign.inputs import read_record
from fusion.common import FusionError
from interferometry.common import InterferometryError

pytestmark = pytest.mark.long

#: 36 h from the evening of a day whose number and month differ, a row every ten minutes.
_START = datetime(2026, 3, 9, 21, 40)
_SECONDS = 600.0 * np.arange(217)
_WARM = 1.0 - np.exp(-_SECONDS / 7200.0)
_TRUTH = {"T bed": 20.013 + 9.02 * _WARM, "T2 (air)": 21.507 + 2.01 * _WARM, "X pos": 45.04 * _WARM - 0.33}
_NAMES = ("Time", *_TRUTH, "speed")


@dataclass(frozen=True)
class Units:
    """How a table states its units, empty where it does not, and what its numbers are in: number = (value - offset) / factor."""

    time: str = ""
    temperature: str = ""
    displacement: str = ""
    second: float = 1.0
    kelvin: float = 1.0
    offset: float = 0.0
    um: float = 1.0


_F = {"kelvin": 1 / 1.8, "offset": -32.0 / 1.8}
_K = {"offset": -273.15}
UNITS = {
    "s, degC, um": Units("s", "degC", "um"),
    "ms, °C, µm": Units("ms", "°C", "µm", second=1e-3),
    "min, K, mm": Units("min", "K", "mm", second=60.0, um=1e3, **_K),
    "h, degF, in": Units("h", "degF", "in", second=3600.0, um=25400.0, **_F),
    "days, ºC, nm": Units("days", "ºC", "nm", second=86400.0, um=1e-3),
    "1/100 s, ℃, mil": Units("1/100 s", "℃", "mil", second=0.01, um=25.4),
    "Stunden, gradC, Mikrometer": Units("Stunden", "gradC", "Mikrometer", second=3600.0),
    "weeks, mK, m": Units("weeks", "mK", "m", second=604800.0, kelvin=1e-3, um=1e6, **_K),
    "none: s, degC, um": Units(),
    "none: min, degC, mm": Units(second=60.0, um=1e3),
    "none: h, degF, in": Units(second=3600.0, um=25400.0, **_F),
    "none: ms, K, nm": Units(second=1e-3, um=1e-3, **_K),
    "unknown": Units("years", "centi", "furlong", second=31557600.0, kelvin=0.01, um=201.168e6),
    "displacement alone": Units("", "", "um"),
}


def _elapsed(seconds: float) -> str:
    return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{int(seconds % 60):02d}"


#: Texts of a time; None for a number in the unit of time.
CLOCKS: dict[str, Callable[[float], str] | None] = {
    "number": None,
    "ISO": lambda s: f"{_START + timedelta(seconds=s):%Y-%m-%d %H:%M:%S}",
    "12 hours": lambda s: f"{_START + timedelta(seconds=s):%m/%d/%Y %I:%M:%S %p}",
    "elapsed": _elapsed,
}
#: Delimiter, decimal mark, mark of thousands.
LOCALES = {"English": (",", ".", ""), "German": (";", ",", ""), "tabs and commas": ("\t", ",", "")}
LAYOUTS = (
    "brackets", "quotient", "row of units", "aligned", "aligned with blank units", "footer and second header", "workbook with a cover",
)  # fmt: skip


def _cells(clock: Callable[[float], str] | None, units: Units, decimal: str) -> list[list[str]]:
    """Return the rows of the table as text, seven digits of every number."""

    def number(value: float) -> str:
        return f"{value:.12g}".replace(".", decimal)

    columns = [
        [number(s / units.second) if clock is None else clock(s) for s in _SECONDS],
        *(
            [number(value) for value in np.round((_TRUTH[name] - units.offset) / units.kelvin, 6)]
            for name in ("T bed", "T2 (air)")
        ),
        [number(value) for value in np.round(_TRUTH["X pos"] / units.um, 12)],
        [str(int(3000 * (s // 14400 % 2))) for s in _SECONDS],
    ]
    return [list(row) for row in zip(*columns, strict=True)]


def write_table(folder: Path, clock: str, unit: str, layout: str, locale: str) -> Path:
    """Write one table of the matrix."""
    units, (mark, decimal, _) = UNITS[unit], LOCALES[locale]
    stated = [
        units.time if CLOCKS[clock] is None else "",
        units.temperature,
        units.temperature,
        units.displacement,
        "1/min",
    ]
    rows = _cells(CLOCKS[clock], units, decimal)
    one_row = {
        "quotient": [f"{name} / {text}" if text else name for name, text in zip(_NAMES, stated, strict=True)],
    }.get(layout, [f"{name} [{text}]" if text else name for name, text in zip(_NAMES, stated, strict=True)])
    of_units = layout in ("row of units", "aligned with blank units")
    rows = [*([list(_NAMES), stated] if of_units else [one_row]), *rows]
    if layout == "footer and second header":
        rows = [
            *rows[:100],
            rows[0],
            *rows[100:],
            ["", *rows[-1][1:]],
            ["Mean", *rows[9][1:]],
            ["End of file", *[""] * 4],
        ]
    if layout == "workbook with a cover":
        book = openpyxl.Workbook()
        book.active.append(["Machine", "Mill 7"])
        book.active.append(["Operator", "A. N."])
        sheet = book.create_sheet("Data")
        for row in rows:
            sheet.append(
                [
                    float(cell.replace(",", ".")) if k and cell[:1] in "-0123456789" else cell
                    for k, cell in enumerate(row)
                ]
            )
        if CLOCKS[clock] is None:
            for row in list(sheet.rows)[1:]:
                row[0].value = float(str(row[0].value).replace(",", "."))
        book.save(folder / "log.xlsx")
        return folder / "log.xlsx"
    if layout.startswith("aligned"):
        width = [max(len(row[k]) for row in rows) + 3 for k in range(len(rows[0]))]
        left = locale == "German"
        lines = [
            "".join(f"{cell:{'<' if left else '>'}{w}}" for cell, w in zip(row, width, strict=True)) for row in rows
        ]
    else:
        lines = [mark.join(f'"{cell}"' if mark in cell else cell for cell in row) for row in rows]
    (folder / "log.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "log.txt"


#: Clocks of one column each: heading, text of an instant and of the seconds since the first; {} stands for day and month.
_GPS, _1904, _1970 = datetime(1980, 1, 5, 23, 59, 42), datetime(1904, 1, 1), datetime(1970, 1, 1)


def _since(epoch: datetime, factor: float = 1.0) -> Callable[[datetime, float], str]:
    return lambda at, s: f"{(at - epoch).total_seconds() * factor:.0f}"


SPELLINGS: dict[str, tuple[str, str | Callable[[datetime, float], str]]] = {
    "slashes": ("Time", "{}/%Y %H:%M:%S"),
    "years of two digits": ("Time", "{}/%y %H:%M"),
    "AM and PM": ("Time", "{}/%Y %I:%M:%S %p"),
    "a. m. and p. m.": ("Fecha y hora", lambda at, s: "{}/%Y %I:%M:%S " + ("a. m." if at.hour < 12 else "p. m.")),
    "milliseconds behind a colon": ("Time", "{}/%Y %H:%M:%S:000"),
    "date and time": ("Date;Time", "{}/%Y;%H:%M:%S"),
    "EST": ("Time", "%Y-%m-%d %H:%M:%S EST"),
    "place in the heading": ("Date Time: Europe/Berlin", "%Y-%m-%d %H:%M:%S"),
    "no marks": ("Time", "%Y%m%d%H%M%S"),
    "parts": ("Year;Month;Day;Hour;Minute;Second", "%Y;%m;%d;%H;%M;%S"),
    "day, hour, minute": ("Day;Hour;Minute", "%d;%H;%M"),
    "Unix s": ("Timestamp", _since(_1970)),
    "Unix us": ("Timestamp", _since(_1970, 1e6)),
    "Unix ns": ("Timestamp", _since(_1970, 1e9)),
    "GPS s": ("GPS time (s)", _since(_GPS)),
    "LabVIEW s": ("Timestamp", _since(_1904)),
    "MJD": ("MJD", lambda at, s: f"{(at - datetime(1858, 11, 17)) / timedelta(days=1):.7f}"),
    "days and hours": ("Elapsed", lambda at, s: f"{int(s // 86400)}.{_elapsed(s % 86400):0>8}"),
    "minutes and seconds": ("Elapsed", lambda at, s: f"{int(s // 60):02d}:{int(s % 60):02d}"),
    "mm:ss": ("Time [mm:ss]", lambda at, s: f"{int(s // 60):02d}:{int(s % 60):02d}"),
    "HHMMSS": ("Time", lambda at, s: f"{int(at.strftime('%H%M%S'))}"),
    "centiminutes": ("Time [1/100 min]", lambda at, s: f"{s / 0.6:.0f}"),
    "counter of 32 bits": ("Time [ms]", lambda at, s: f"{(4291967296 + int(1000 * s)) % 4294967296}"),
    "12 hours without AM": ("Time", "%I:%M:%S"),
    "end of daylight saving": ("Time", lambda at, s: f"{at - timedelta(hours=s > 7200):%Y-%m-%d %H:%M:%S}"),
}  # fmt: skip
#: Spellings whose dates have no meaning of their own.
_UNDATED = (
    "day, hour, minute", "days and hours", "minutes and seconds", "mm:ss", "HHMMSS", "centiminutes", "counter of 32 bits",
    "12 hours without AM",
)  # fmt: skip
_AHEAD_H = {"EST": -5, "place in the heading": 1}
#: First number of a date, and whether the test goes over a midnight.
DATES = tuple(itertools.product(("%d/%m", "%m/%d"), (True, False)))


def judged_spelling(folder: Path, spelling: str, order: str, over_midnight: bool) -> str:
    """Say what the command makes of a table in one spelling."""
    heading, written = SPELLINGS[spelling]
    start = datetime(2026, 3, 9, 21 if over_midnight else 9, 40)
    seconds = _SECONDS if over_midnight else _SECONDS[:61]
    lines = [";".join([heading, "T bed [degC]", "T2 (air) [degC]", "X pos [um]"])]
    for k, s in enumerate(seconds.tolist()):
        at = start + timedelta(seconds=s)
        text = (
            written(at, s) if callable(written) else at.strftime(written.format(order) if "{" in written else written)
        )
        text = at.strftime(text.replace("{}", order)) if "{}" in text else text
        lines.append(";".join([text, *(f"{truth[k]:.6f}" for truth in _TRUTH.values())]))
    (folder / "log.txt").write_text("\n".join(lines) + "\n")
    first = None if spelling in _UNDATED else start - timedelta(hours=_AHEAD_H.get(spelling, 0))
    return judged(folder, seconds, first)


def judged(folder: Path, since: np.ndarray = _SECONDS, first: datetime | None = None) -> str:
    """Say what the command makes of the table: right, marked (what is wrong is listed as a guess), asked, refused, or what is wrong."""
    try:
        path, missing = write_campaign(folder, Asker(None))
        if missing:
            assert TO_FILL in path.read_text()
            return "asked"
        campaign = load_campaign(path)
        data = read_record(campaign)
    except (FusionError, InterferometryError):
        return "refused"
    assert campaign.record is not None
    guessed = campaign.record.guessed
    wrong = []
    seconds = (data["time"].values - data["time"].values[0]) / np.timedelta64(1, "s")
    if seconds.size != since.size or np.abs(seconds - since).max() > 0.02:
        wrong += [] if {"time_unit", "time_format"} & {*guessed} else ["time"]
    if first is not None and abs(data["time"].values[0] - np.datetime64(first)) > np.timedelta64(1, "s"):
        wrong += [] if {"time_unit", "date_order", "start"} & {*guessed} else ["date"]
    for role, dimension in (("temperature", "sensor"), ("displacement", "channel")):
        expected = {name: truth for name, truth in _TRUTH.items() if (name[0] == "T") == (role == "temperature")}
        read = {str(name): data[role].sel({dimension: name}).values for name in data[dimension].values}
        wrong += [
            f"{name} as a {role}"
            for name in read
            if not name.startswith(tuple(one.partition(" (")[0] for one in expected))
        ]
        for name, truth in expected.items():
            values = next((one for heading, one in read.items() if heading.startswith(name.partition(" (")[0])), None)
            if values is None:
                wrong.append(f"{name} left out")
            elif (
                values.size != since.size
                or np.nanmax(np.abs(values - truth[: since.size])) > 0.01 + 1e-3 * np.abs(truth).max()
            ):
                wrong += [] if any(one.startswith(name) for one in guessed) else [name]
    return "wrong: " + ", ".join(wrong) if wrong else "marked" if guessed else "right"


@dataclass(frozen=True)
class Oddity:
    """What is odd in a table: its headings, the cells of a row by the truth, and lines that stand at places in it, beginning with another
    header.
    """

    heads: tuple[str, str, str] = ("T bed [°C]", "T2 (air) [°C]", "X pos [µm]")
    cells: Callable[[int, float, float, float], tuple[object, object, object]] = lambda k, bed, air, x: (bed, air, x)
    units_row: tuple[str, ...] = ()
    lines: tuple[tuple[int, tuple[object, ...]], ...] = ()
    time: str = "Time [s]"
    second: float = 1.0


def _f(celsius: float) -> float:
    return 1.8 * celsius + 32.0


def _marked(*marks: object) -> Oddity:
    """A table in which the bed, and at the last mark all columns, give marks in place of readings."""

    def cells(k: int, bed: float, air: float, x: float) -> tuple[object, object, object]:
        at = {7 + 40 * j: mark for j, mark in enumerate(marks)}
        return at.get(k, bed), at.get(k - 3, air), x

    return Oddity(cells=cells)


_HEADS = ("T bed", "T2 (air)", "X pos")
ODDITIES = {
    "T bed x10": Oddity(("T bed x10", *_HEADS[1:]), lambda k, a, b, x: (10 * a, b, x)),
    "T bed x10 [°C]": Oddity(("T bed x10 [°C]", "T2 (air) [°C]", "X pos [µm]"), lambda k, a, b, x: (10 * a, b, x)),
    "T bed*10": Oddity(("T bed*10", "T2 (air) [°C]", "X pos [µm]"), lambda k, a, b, x: (10 * a, b, x)),
    "x10 in brackets": Oddity(("T bed (x10 °C)", "T2 (air) [°C]", "X pos (x10 µm)"), lambda k, a, b, x: (10 * a, b, 10 * x)),
    "x1000 beside mm": Oddity(("T bed [°C]", "T2 (air) [°C]", "X pos x1000 (mm)")),
    "shares": Oddity(("T bed (0.1 °C)", "T2 (air) [1/10 °C]", "X pos (1e-3 mm)"), lambda k, a, b, x: (10 * a, 10 * b, x)),
    "shares without brackets": Oddity(("T bed 0.1 degC", "T2 (air) [°C]", "X pos 0.1 um"), lambda k, a, b, x: (10 * a, b, 10 * x)),
    "m°C and nm": Oddity(("T bed (m°C)", "T2 (air) [°C]", "X pos [nm]"), lambda k, a, b, x: (1e3 * a, b, 1e3 * x)),
    "tenths": Oddity(("T bed [°F]", "T2 (air) [°F]", "X pos (tenths)"), lambda k, a, b, x: (_f(a), _f(b), x / 2.54)),
    "thou": Oddity(("T bed (degF)", "T2 (air) [deg F]", "X pos (thou)"), lambda k, a, b, x: (_f(a), _f(b), x / 25.4)),
    "µin": Oddity(("T bed [F]", "T2 (air) [°F]", "X pos [µin]"), lambda k, a, b, x: (_f(a), _f(b), x / 0.0254)),
    "raw": Oddity(("T bed (raw)", "T2 (air) [°C]", "X pos (steps)"), lambda k, a, b, x: (round(16 * a), b, round(8 * x))),
    "HOBO": Oddity(
        ("T bed, °F (LGR S/N: 12, SEN S/N: 7)", "T2 (air), °F (LGR S/N: 12, SEN S/N: 8)", "X pos, mm"),
        lambda k, a, b, x: (_f(a), _f(b), x / 1e3),
    ),
    "row of units": Oddity(_HEADS, lambda k, a, b, x: (_f(a), b, x / 0.0254), ("s", "°F", "°C", "µin")),
    "units in cells": Oddity(_HEADS, lambda k, a, b, x: (f"{_f(a):.9g} °F", f"{b:.9g}°C", f"{x / 1e3:.9g} mm")),
    "two units in cells": Oddity(
        _HEADS, lambda k, a, b, x: (f"{a:.9g} °C", f"{b:.9g} °C", f"{x:.9g} um" if k < 130 else f"{x / 1e3:.9g} mm")
    ),
    "second header in other units": Oddity(
        cells=lambda k, a, b, x: (a, b, x) if k < 100 else (_f(a), b, x / 1e3),
        lines=((100, ("Time [s]", "T bed [°F]", "T2 (air) [°C]", "X pos [mm]")),),
    ),
    "second row of units": Oddity(
        _HEADS, lambda k, a, b, x: (a, b, x) if k < 100 else (_f(a), _f(b), x / 1e3), ("s", "°C", "°C", "µm"),
        ((100, ("s", "°F", "°F", "mm")),),
    ),
    "second header of exchanged columns": Oddity(
        cells=lambda k, a, b, x: (a, b, x) if k < 100 else (x, b, a),
        lines=((100, ("Time [s]", "X pos [µm]", "T2 (air) [°C]", "T bed [°C]")),),
    ),
    "second header, the same": Oddity(lines=((100, ("Time [s]", "T bed [°C]", "T2 (air) [°C]", "X pos [µm]")),)),
    "sum in a cell": Oddity(lines=((217, (130200, 24.5, 22.5, "22 avg")),)),
    "mean, max, std": Oddity(lines=tuple((217, (name, 24.5, 22.5, 22)) for name in ("Mean", "Max:", "Std Dev"))),
    "mean as last row": Oddity(lines=((217, (129600, 24.5, 22.5, 22)),)),
    "85 and -127": _marked(85.0, -127.0),
    "-7999 and NAN": _marked(-7999, "NAN"),
    "OL": _marked("OL", "Over", "-OVER"),
    "9999": _marked(9999, 6999, -999.9),
    "3276.7": _marked(3276.7, -3276.8, 32767),
    "9.9e37": _marked(9.9e37, "---", "#N/A"),
    "t [m]": Oddity(time="t [m]", second=60.0),
    "Temps (mn)": Oddity(time="Temps (mn)", second=60.0),
    "Temps": Oddity(time="Temps", second=60.0),
    "a probe that is called T": Oddity(("T bed [°C]", "T2 (air) [°C]", "X pos [µm]"), time="elapsed (min)", second=60.0),
    "centi": Oddity(("T bed [centi]", "T2 (air) [°C]", "X pos [furlong]"), lambda k, a, b, x: (100 * a, b, x / 1e3)),
}  # fmt: skip


def write_odd(folder: Path, oddity: str, clock: str, locale: str) -> None:
    """Write one odd table."""
    odd, (mark, decimal, _) = ODDITIES[oddity], LOCALES[locale]

    def written(cell: object) -> str:
        return str(cell).replace(".", decimal) if not isinstance(cell, str) or cell[:1].isdigit() else cell

    def time(seconds: float) -> object:
        return round(seconds / odd.second, 9) if (form := CLOCKS[clock]) is None else form(seconds)

    rows: list[tuple[object, ...]] = []
    values = zip(*(_TRUTH[name] for name in _HEADS), strict=True)
    for k, (seconds, (bed, air, x)) in enumerate(zip(_SECONDS, values, strict=True)):
        rows += [one for at, one in odd.lines if at == k]
        rows.append((time(seconds), *odd.cells(k, bed, air, x)))
    for _, (first, *others) in (one for one in odd.lines if one[0] == 217):
        rows.append((first if isinstance(first, str) else time(float(str(first))), *others))
    heads = [odd.time if CLOCKS[clock] is None else "Time", *odd.heads]
    lines = [heads, *([odd.units_row] if odd.units_row else []), *([written(cell) for cell in row] for row in rows)]
    text = "\n".join(mark.join(f'"{cell}"' if mark in cell else cell for cell in line) for line in lines)
    (folder / "log.csv").write_text(text + "\n", encoding="utf-8")


#: Deviations by cycle, direction and target, um, and how headings call the runs; None where they name no direction.
_POSITIONS = np.array([0.0, 100.0, 200.0, 300.0, 400.0])
_DEVIATIONS = np.arange(3)[:, None, None] * 0.1 + np.array([0.0, 2.0])[:, None] + 0.01 * _POSITIONS
_RUNS = {"1+": ("{}+", "{}-"), "F1": ("F{}", "R{}"), "→ 1": ("→ {}", "← {}"), "X1f": ("X{}f", "X{}b"), "Run 1": None}
#: How the unit is stated: above the table, in every heading, factor of the numbers; "measured": positions in place of deviations.
_STATED = {
    "none": ("", "", 1.0), "none, mm": ("", "", 1e-3), "none, 0.1 um": ("", "", 10.0), "title": ("Deviations in 0.1 µm", "", 10.0),
    "um": ("", " [µm]", 1.0), "mm": ("", " [mm]", 1e-3), "tenths": ("", " (tenths)", 1 / 2.54),
    "title, tenths": ("Deviations [tenths]", "", 1 / 2.54),
    "measured": ("", "", 1.0), "x10": ("Deviations x10 [µm]", "", 10.0),
}  # fmt: skip


def _deviations(folder: Path, runs: str, stated: str, locale: str) -> str:
    """Write a table of deviations by run, and say what its reader makes of it."""
    (mark, decimal, _), (title, unit, factor) = LOCALES[locale], _STATED[stated]
    if (names := _RUNS[runs]) is not None:
        heads = [names[d].format(cycle + 1) + unit for cycle in range(3) for d in (0, 1)]
    else:
        heads = [f"Run {k + 1}{unit}" for k in range(6)]
    values = _DEVIATIONS.reshape(6, 5).T * factor
    values = _POSITIONS[:, None] + values / 1e3 if stated == "measured" else values
    rows = [
        ["Position [mm]", *heads],
        *([f"{p:g}", *map("{:.6f}".format, row)] for p, row in zip(_POSITIONS, values, strict=True)),
    ]
    lines = [mark.join(rows[0]), *(mark.join(cell.replace(".", decimal) for cell in row) for row in rows[1:])]
    (folder / "laser.csv").write_text("\n".join([*filter(None, [title]), *lines]) + "\n", encoding="utf-8")
    try:
        read = interferometry.read_deviations(folder / "laser.csv")
    except InterferometryError as error:
        return "asked" if "state " in str(error) else "refused"
    right = read["deviation"].shape == (3, 2, 5) and np.allclose(read["deviation"].values, _DEVIATIONS, atol=1e-3)
    return "right" if right else "wrong"


def cells() -> Iterator[tuple[str, str, str, str]]:
    """Yield clock, unit, layout and locale of every table."""
    return itertools.product(CLOCKS, UNITS, LAYOUTS, LOCALES)


def counted(tmp_path: Path, chosen: list[tuple[str, str, str, str]]) -> tuple[Counter[str], list[str]]:
    """Count the answers to some tables, and name those that are wrong."""
    answers, wrong = Counter[str](), []
    for k, cell in enumerate(chosen):
        (folder := tmp_path / str(k)).mkdir()
        write_table(folder, *cell)
        answer = judged(folder)
        answers[answer.partition(":")[0]] += 1
        wrong += [f"{', '.join(cell)}: {answer}"] if answer.startswith("wrong") else []
    return answers, wrong


def answers_to(tmp_path: Path, spelling: str, dates: Iterable[tuple[str, bool]]) -> list[str]:
    """Answers to tables in one spelling, one for each order of its date and length of the test."""
    answers = []
    for k, date in enumerate(dates):
        (folder := tmp_path / f"{k} {spelling}").mkdir()
        answers.append(judged_spelling(folder, spelling, *date))
    return answers


def test_a_spelling_of_a_clock_is_not_wrong_in_silence(tmp_path: Path) -> None:
    """The quick form: the dates in turn."""
    dates = itertools.cycle(DATES)
    answers = {spelling: answers_to(tmp_path, spelling, [next(dates)]) for spelling in SPELLINGS}
    assert not [spelling for spelling, (answer,) in answers.items() if answer.startswith("wrong")]


@pytest.mark.slow
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_no_spelling_of_a_clock_is_wrong_in_silence(tmp_path: Path, spelling: str) -> None:
    answers = answers_to(tmp_path, spelling, DATES)
    print(f"{spelling}: {', '.join(answers)}")
    assert not any(answer.startswith("wrong") for answer in answers)


def test_some_tables_of_the_matrix(tmp_path: Path) -> None:
    """The quick form: every 79th table, so that all clocks, units, layouts and locales come up."""
    answers, wrong = counted(tmp_path, list(cells())[::79])
    assert not wrong and answers["right"] >= 8


def counted_odd(tmp_path: Path, every: int) -> tuple[Counter[str], Counter[str], list[str]]:
    """Count the answers to odd records and to tables of deviations, and name those that are wrong."""
    wrong, records, tests = [], Counter[str](), Counter[str]()
    for k, cell in enumerate([*itertools.product(ODDITIES, ("number", "ISO", "12 hours"), LOCALES)][::every]):
        (folder := tmp_path / f"odd{k}").mkdir()
        write_odd(folder, *cell)
        records[(answer := judged(folder)).partition(":")[0]] += 1
        wrong += [f"{', '.join(cell)}: {answer}"] if answer.startswith("wrong") else []
    for k, cell in enumerate([*itertools.product(_RUNS, _STATED, LOCALES)][::every]):
        (folder := tmp_path / f"laser{k}").mkdir()
        tests[answer := _deviations(folder, *cell)] += 1
        wrong += [f"deviations {', '.join(cell)}"] if answer == "wrong" else []
    return records, tests, wrong


def test_some_odd_tables(tmp_path: Path) -> None:
    """The quick form: every 13th table."""
    records, tests, wrong = counted_odd(tmp_path, 13)
    assert not wrong and records["right"] >= 8 and tests["right"] >= 2


@pytest.mark.slow
def test_no_odd_table_is_wrong_in_silence(tmp_path: Path) -> None:
    records, tests, wrong = counted_odd(tmp_path, 1)
    print(dict(records), dict(tests), len(wrong))
    assert not wrong, wrong


@pytest.mark.slow
def test_no_table_of_the_matrix_is_wrong_in_silence(tmp_path: Path) -> None:
    answers, wrong = counted(tmp_path, list(cells()))
    print(dict(answers))
    assert not wrong, wrong
