"""Logged tables whose times are text, in every form that docs/formats.md names, with what people's files have besides rows.

Every row holds what its clock shows, in seconds since the first row of the test, as a number of its own: what was read is compared with it.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import xarray as xr

from fusion.campaign.config import load_campaign
from fusion.campaign.draft import Asker, write_campaign
from fusion.campaign.inputs import read_record
from fusion.campaign.inspect import Kind as Contents
from fusion.campaign.inspect import inspect_paths
from fusion.campaign.logs import read_drivers
from fusion.common import FusionError
from fusion.pipeline.record import read_record_source
from interferometry.io.readings import read_environment
from tests.soak.fuzz.harness import Kind

#: Of every so many records all is read that `check` reads: sensors are examined, blocks are laid.
_CHECKED = 8
_GERMAN = ("Jan", "Feb", "März", "Apr", "Mai", "Juni", "Juli", "Aug", "Sept", "Okt", "Nov", "Dez")


@dataclass(frozen=True)
class Form:
    """How times are written: text of an instant of a test with its start, whether it needs no format, and whether a clock may go back."""

    write: Callable[[datetime, datetime], str]
    plain: bool = True
    dated: bool = True


def _of(pattern: str, **options: bool) -> Form:
    return Form(lambda at, start: at.strftime(pattern), **options)


def _elapsed(at: datetime, start: datetime) -> str:
    seconds = round((at - start).total_seconds())
    return f"{seconds // 3600:02d}:{seconds % 3600 // 60:02d}:{seconds % 60:02d}"


def _short(at: datetime) -> str:
    return f"{at.hour}:{at:%M:%S}"


FORMS: dict[str, Form] = {
    "ISO": _of("%Y-%m-%dT%H:%M:%S"),
    "ISO with a space": _of("%Y-%m-%d %H:%M:%S"),
    "ISO in UTC": _of("%Y-%m-%dT%H:%M:%SZ"),
    "ISO with a zone": _of("%Y-%m-%dT%H:%M:%S+01:00"),
    "ISO with a fraction": _of("%Y-%m-%d %H:%M:%S.%f"),
    "ISO of minutes": _of("%Y-%m-%d %H:%M"),
    "day, month": Form(lambda at, start: f"{at.day}.{at.month}.{at.year} {_short(at)}"),
    "day, month by slashes": Form(lambda at, start: f"{at.day:02d}/{at.month:02d}/{at.year} {at:%H:%M:%S}"),
    "month, day": Form(lambda at, start: f"{at.month}/{at.day}/{at.year} {at:%I:%M:%S %p}"),
    "English month": _of("%d %b %Y %H:%M:%S"),
    "German month": Form(lambda at, start: f"{at.day}. {_GERMAN[at.month - 1]} {at.year} {at:%H:%M:%S}"),
    "Chinese": Form(lambda at, start: f"{at.year}年{at.month}月{at.day}日 {_short(at)}"),
    "Klipper": _of("%Y/%m/%d-%H:%M:%S", plain=False),
    "without separators": _of("%Y%m%d_%H%M%S", plain=False),
    "two digits of the year": _of("%d.%m.%y %H:%M:%S", plain=False),
    "two digits, month first": _of("%m/%d/%y %H:%M:%S", plain=False),
    "short month": _of("%d-%b-%y %H:%M:%S", plain=False),
    "time of day": _of("%H:%M:%S", plain=False, dated=False),
    "time of day of 12 hours": _of("%I:%M:%S %p", plain=False, dated=False),
    "elapsed": Form(_elapsed, plain=False, dated=False),
    "date and time": _of("%Y-%m-%d|%H:%M:%S", plain=False),
    "date and time of 12 hours": _of("%m/%d/%Y|%I:%M:%S %p", plain=False),
    "date and time with points": _of("%d.%m.%Y|%H:%M:%S", plain=False),
}


def _clock(rng: np.random.Generator, form: Form, rows: int) -> np.ndarray:
    """Return what the clock shows at every row, s: pauses, and where dates are written restarts, steps back and the year 2000."""
    step = float(rng.choice([60.0, 120.0, 300.0]))
    shown = step * np.arange(rows)
    kind = rng.choice(
        ["even", "pause", "restart", "set back", "2000", "newest first"], p=[0.4, 0.2, 0.1, 0.1, 0.15, 0.05]
    )
    at = int(rng.integers(rows // 4, 3 * rows // 4))
    if kind == "pause":
        shown[at:] += step * int(rng.integers(2, 60))
    elif form.dated and kind == "restart":
        shown[at:] -= shown[at]
    elif form.dated and kind == "set back":
        shown[at:] -= step * int(rng.integers(1, 5))
    elif form.dated and kind == "2000":
        shown[at:] -= (_START - datetime(2000, 1, 1)).total_seconds()
    return shown[::-1] if form.dated and kind == "newest first" else shown


_START = datetime(2026, 3, 13, 21, 40)


def made(
    rng: np.random.Generator, heads: tuple[str, ...], columns: Callable[[np.ndarray], list[np.ndarray]], *, plain: bool
) -> bytes:
    """Return a table; ``columns`` gives the values of its other columns."""
    names = [name for name, form in FORMS.items() if form.plain or not plain]
    form = FORMS[names[int(rng.integers(len(names)))]]
    mark = str(rng.choice([",", ";", "\t"]))
    comma = mark != "," and rng.random() < 0.5
    rows = int(rng.integers(40, 80))
    shown = _clock(rng, form, rows)
    texts = [form.write(_START + timedelta(seconds=at), _START) for at in shown.tolist()]
    pair = "|" in texts[0]
    times = [text.split("|") for text in texts]
    head = mark.join([*(("Date", "Time") if pair else ("time",)), *heads])
    numbers = np.column_stack([*columns(np.arange(rows) / rows), shown])
    lines = []
    for time, values in zip(times, numbers.tolist(), strict=True):
        cells = [f"{value:.2f}" for value in values]
        lines.append([*time, *(cell.replace(".", ",") if comma else cell for cell in cells)])
    width = len(lines[0])
    table = [mark.join(line) for line in lines]
    for _ in range(int(rng.integers(0, 4))):
        at = int(rng.integers(1, len(table)))
        own = lines[int(rng.integers(rows))]
        other = (
            mark.join([*([""] * len(times[0])), *own[len(times[0]) :]]),
            mark.join([rng.choice(["NaN", "n/a", "--", "?"]), *own[1:]]),
            mark.join([*own, "9"]),
            head,
            mark.join(["s", *["degC"] * (width - 1)]),
            "*** spindle started ***" + mark * (width - 1),
            mark * (width - 1),
            "",
        )
        table.insert(at, other[int(rng.integers(len(other)))])
    ends = (
        [mark * (width - 1)] * int(rng.integers(1, 30)),
        ["End of file"],
        [mark.join(["Mean", *lines[0][1:]]), mark.join(["Max", *lines[1][1:]])],
        ["", "", f"{rows} rows"],
        [f"# {rows} rows"],
        [mark.join([*([""] * len(times[0])), *lines[0][len(times[0]) :]])] * int(rng.integers(1, 3 * rows)),
    )
    table += ends[int(rng.integers(len(ends)))] if rng.random() < 0.5 else []
    comments = ["# logger 7"] if rng.random() < 0.2 else []
    end = str(rng.choice(["\n", "\r\n"]))
    text = end.join([*comments, head, *table]) + (end if rng.random() < 0.8 else "")
    return text.encode(str(rng.choice(["utf-8", "utf-8-sig", "utf-16"])))


def record_table(_: bytes, rng: np.random.Generator) -> bytes:
    """Return a record: two temperatures, a displacement, and what the clock shows."""
    return made(
        rng,
        ("T1 [degC]", "T2 [degC]", "X [um]", "shown [1]"),
        lambda share: [20 + 8 * share, 20 + 3 * share**2, 30 * share + rng.normal(0, 0.2, share.size)],
        plain=False,
    )


def driver_table(_: bytes, rng: np.random.Generator) -> bytes:
    """Return a log of drivers."""
    return made(rng, ("duty [1]", "shown [1]"), lambda share: [np.round(share * 4) / 4], plain=True)


def environment_table(_: bytes, rng: np.random.Generator) -> bytes:
    """Return an environment log."""
    heads = (
        "air temperature [degC]", "air pressure [hPa]", "relative humidity [%]", "material temperature [degC]", "shown [1]",
    )  # fmt: skip
    return made(rng, heads, lambda share: [20 + share, 1000 + share, 45 + share, 20 + 2 * share], plain=True)


def rows_of(path: Path, *, of_a_log: bool) -> int:
    """Return the rows below the header; in a log of the instruments lines without a value, and comments, are none."""
    content = path.read_bytes()
    text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    lines = text.splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    if not of_a_log:
        return sum(bool(line.strip(" ")) for line in lines[head + 1 :])
    return sum(bool(line.strip(",;\t ")) and not line.startswith("#") for line in lines[head + 1 :])


def agree(table: xr.Dataset, shown: np.ndarray, rows: int) -> None:
    """Every row is read or named, and the time of each is what its clock showed."""
    named = json.loads(table.attrs["left_out"])
    assert table.sizes["time"] + len(named) == rows
    assert len({one["line"] for one in named}) == len(named)
    seconds = (table["time"].values - table["time"].values[0]) / np.timedelta64(1, "s")
    assert np.abs(seconds - (shown - shown[0])).max() < 1e-6
    assert (np.diff(seconds) >= 0.0).all()


def read_timed_record(path: Path) -> None:
    """Recognise a record, draft its campaign, and read it as `check` does."""
    folder = Path(tempfile.mkdtemp(dir=path.parent))
    try:
        shutil.copy(path, folder / "log.csv")
        (looked,) = inspect_paths([folder])
        assert looked.kind is Contents.RECORD, looked.fault
        drafted, missing = write_campaign(folder, Asker(None))
        if missing:
            raise FusionError("; ".join(missing))
        campaign = load_campaign(drafted)
        table = read_record(campaign)
        shown = table["driver"].sel(driver_name="shown").values
        agree(table, shown, rows_of(path, of_a_log=False))
        if path.stat().st_size % _CHECKED == 0:
            read_record_source(campaign)
    finally:
        shutil.rmtree(folder)


def read_timed_drivers(path: Path) -> None:
    """Read a log of drivers."""
    table = read_drivers(path)
    agree(table, table["shown"].values, rows_of(path, of_a_log=True))


def read_timed_environment(path: Path) -> None:
    """Read an environment log."""
    table = read_environment(path)
    agree(table, table["shown"].values, rows_of(path, of_a_log=True))


def kinds_of_timed_tables() -> list[Kind]:
    """Return the kinds of tables whose times are text."""
    return [
        Kind("timed_record.csv", [b""], record_table, read_timed_record, 1.0),
        Kind("timed_drivers.csv", [b""], driver_table, read_timed_drivers, 2.0),
        Kind("timed_environment.csv", [b""], environment_table, read_timed_environment, 2.0),
    ]
