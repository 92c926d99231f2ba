"""Logged tables of every clock, unit, layout and locale are read rightly, asked about, marked or refused: quoted in docs/measured.csv."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pytest

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
                or np.abs(values - truth[: since.size]).max() > 0.01 + 1e-3 * np.abs(truth).max()
            ):
                wrong += [] if any(one.startswith(name) for one in guessed) else [name]
    return "wrong: " + ", ".join(wrong) if wrong else "marked" if guessed else "right"


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


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_no_spelling_of_a_clock_is_wrong_in_silence(tmp_path: Path, spelling: str) -> None:
    answers = []
    for k, date in enumerate(DATES):
        (folder := tmp_path / str(k)).mkdir()
        answers.append(judged_spelling(folder, spelling, *date))
    print(f"{spelling}: {', '.join(answers)}")
    assert not any(answer.startswith("wrong") for answer in answers)


def test_some_tables_of_the_matrix(tmp_path: Path) -> None:
    """The quick form: every 59th table, so that all clocks, units, layouts and locales come up."""
    answers, wrong = counted(tmp_path, list(cells())[::59])
    assert not wrong and answers["right"] >= 8


@pytest.mark.slow
def test_no_table_of_the_matrix_is_wrong_in_silence(tmp_path: Path) -> None:
    answers, wrong = counted(tmp_path, list(cells()))
    print(dict(answers))
    assert not wrong, wrong
