"""What the loop finds in measured records into which something was planted, or from which something was taken: docs/hide-and-seek.md.

``python -m tests.soak.test_hide_and_seek`` prints the page's table; as a test it holds that nothing is named that is not there. Every
case is a file that is run as a user would run it. Instants, sensors and courses were chosen before anything was looked at.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from fusion.campaign.remote import FOLDER_VARIABLE
from fusion.pipeline.run import run_campaign
from fusion.results.loop import RecordLoop

pytestmark = pytest.mark.slow

#: A spindle test of 46.3 h: 16 temperatures, 5 displacements, speed, a row every 15 s.
_SPINDLE = "CAIVIAC__FL_THERMAL/data/data.xlsx"
#: Cells under a charge of one hour: current, temperature, strain, a row every second.
_CELLS = "ARTS-Laboratory__dataset-electrothermal-deformation-characterization-for-samsung-30Q-cell/data"
_CELL_COLUMNS = ("time (s)", "current (A)", "voltage", "power", "cell (°C)", "strain (um)", "ambient (°C)")
_STEP_S = 15.0
_SPINDLE_KEYS = 'time = "time (s)"\ntemperatures = ["t*"]\ndisplacements = ["ch*"]\n'
_CELL_KEYS = (
    'time = "time (s)"\ntemperatures = ["cell*", "ambient*"]\ndisplacements = ["strain*"]\ndrivers = ["current*"]\n'
)
_SPEED = 'drivers = ["spindle*"]\n'
#: The first part of what a spindle record always holds: its heat, which is in the driver and in no temperature.
_HEAT = frozenset({"unseen_heat_source"})


@dataclass(frozen=True)
class Case:
    """One record with a known truth.

    Attributes
    ----------
    name : str
        What was done to the record, as the page says it.
    truth : frozenset of str
        Effects that may be named; any other name is wrong.
    sought : str
        The one that was planted, empty where none was; ``sensor NAME`` for a sensor at fault.
    table : callable
        Returns the record.
    keys : str
        Lines of the campaign file under ``[record]``.
    """

    name: str
    truth: frozenset[str]
    sought: str
    table: Callable[[], pd.DataFrame]
    keys: str


def _real_path(name: str) -> Path:
    """Path of a measured file; the cells are read from the folder of the environment variable only."""
    return Path(os.environ[FOLDER_VARIABLE]) / name


def _spindle() -> pd.DataFrame:
    table = pd.read_excel(_real_path(_SPINDLE), engine="openpyxl")
    return table.rename(columns={table.columns[0]: "time (s)"})


def _cell(name: str) -> pd.DataFrame:
    table = pd.read_csv(_real_path(f"{_CELLS}/{name}/Q30_{name}_1C.csv"), names=_CELL_COLUMNS, encoding="utf-8-sig")
    # The gauge records strain; per metre of length that is as many micrometres.
    return table.assign(**{"strain (um)": 1e6 * table["strain (um)"]})


def _displacements(table: pd.DataFrame) -> list[str]:
    return [name for name in table if name.startswith(("ch", "strain"))]


def _temperatures(table: pd.DataFrame) -> list[str]:
    return [name for name in table if "°C" in name]


def _added(
    course: Callable[[pd.DataFrame], np.ndarray], read: Callable[[], pd.DataFrame]
) -> Callable[[], pd.DataFrame]:
    """Return the reader of a record to whose displacements a course (um) is added, smaller from channel to channel."""

    def planted() -> pd.DataFrame:
        table = read()
        size = course(table)
        for place, name in enumerate(_displacements(table)):
            table[name] += size / (1.0 + 0.25 * place)
        return table

    return planted


def _step(size_um: float, share: float) -> Callable[[pd.DataFrame], np.ndarray]:
    return lambda table: size_um * (np.arange(len(table)) >= share * len(table))


def _wave(size_um: float, period_min: float) -> Callable[[pd.DataFrame], np.ndarray]:
    return lambda table: size_um * np.sin(2 * np.pi * table["time (s)"].to_numpy() / (60.0 * period_min))


def _lagged(values: np.ndarray, minutes: float) -> np.ndarray:
    keep = np.exp(-_STEP_S / (60.0 * minutes))
    return lfilter([1.0 - keep], [1.0, -keep], values)


def _late(size_um: float, minutes: float, sensor: int) -> Callable[[pd.DataFrame], np.ndarray]:
    """Course of a part that follows one temperature late, of a given rms."""

    def course(table: pd.DataFrame) -> np.ndarray:
        rise = table[_temperatures(table)[sensor]].to_numpy()
        lagged = _lagged(rise - rise[0], minutes)
        return size_um * lagged / lagged.std()

    return course


def _duty(size_um: float, seed: int) -> Callable[[pd.DataFrame], np.ndarray]:
    """Course of a part that an unlogged load heats, switched at random about every two hours, of a given rms."""

    def course(table: pd.DataFrame) -> np.ndarray:
        switched = np.random.default_rng(seed).random(len(table)) < _STEP_S / 7200.0
        state = _lagged((np.cumsum(switched) % 2).astype(float), 40.0)
        return size_um * (state - state[0]) / state.std()

    return course


def _fault(kind: str, sensor: int, share: float, size_K: float = 0.0) -> Callable[[], pd.DataFrame]:
    """Return the reader of the spindle record with one faulty temperature from an instant on."""

    def planted() -> pd.DataFrame:
        table = _spindle()
        name, first = _temperatures(table)[sensor], int(share * len(table))
        values = table[name].to_numpy().copy()
        since_h = _STEP_S / 3600.0 * np.arange(len(table) - first)
        values[first:] = {
            "jumps": values[first:] + size_K,
            "breaks within 15 min": values[first:] + size_K * np.minimum(since_h / 0.25, 1.0),
            "drifts for 5 h": values[first:] + size_K * np.minimum(since_h / 5.0, 1.0),
            "sticks": np.full(values.size - first, values[first]),
        }[kind]
        return table.assign(**{name: values})

    return planted


def _repeats(place: int, first: float, last: float) -> Callable[[], pd.DataFrame]:
    """Return the reader of the spindle record of which one column repeats a value for a part of the time."""

    def planted() -> pd.DataFrame:
        table = _spindle()
        name = [*_temperatures(table), *_displacements(table)][place]
        values = table[name].to_numpy(copy=True)
        here = slice(*(int(share * len(table)) for share in (first, last)))
        values[here] = values[here.start]
        return table.assign(**{name: values})

    return planted


def _misread(kind: str, place: int) -> Callable[[], pd.DataFrame]:
    """Return the reader of the spindle record with one displacement misread: eleven failed homings of 4.3 mm, or cut off at a value."""

    def planted() -> pd.DataFrame:
        table = _spindle()
        name = _displacements(table)[place]
        values = table[name].to_numpy(copy=True)
        if kind == "glitches":
            values[np.random.default_rng(23).choice(values.size, 11, replace=False)] += 4300.0
        else:
            values = np.minimum(values, np.quantile(values, 0.85))
        return table.assign(**{name: values})

    return planted


def cases() -> Iterator[Case]:
    """The cases in the order of the page."""
    keys = _SPINDLE_KEYS + _SPEED
    yield Case("spindle, unchanged", _HEAT, "unseen_heat_source", _spindle, keys)
    yield Case("spindle without its speed column", frozenset(), "", _spindle, _SPINDLE_KEYS)
    for size in (2.0, 4.0, 6.0):
        for share in (0.31, 0.58):
            made = _added(_step(size, share), _spindle)
            yield Case(
                f"spindle + step of {size:g} µm at {share:.0%}", _HEAT | {"step_event"}, "step_event", made, keys
            )
    for size in (0.5, 1.0, 2.0):
        for period in (97.0, 190.0):
            made = _added(_wave(size, period), _spindle)
            name = f"spindle + wave of {size:g} µm, {period:g} min"
            yield Case(name, _HEAT | {"periodic_disturbance"}, "periodic_disturbance", made, keys)
    for size in (2.0, 6.0):
        made = _added(_late(size, 90.0, 4), _spindle)
        name = f"spindle + {size:g} µm rms that follows t5 90 min late"
        yield Case(name, _HEAT | {"thermal_lag"}, "thermal_lag", made, keys)
    for size in (2.0, 6.0):
        yield Case(
            f"spindle + {size:g} µm rms of a load that no log holds", _HEAT, "", _added(_duty(size, 5), _spindle), keys
        )
    faults = (("jumps", 5.0), ("breaks within 15 min", 28.0), ("drifts for 5 h", 5.0), ("sticks", 0.0))
    for kind, size in faults:
        for sensor, share in ((2, 0.37), (9, 0.66), (12, 0.9)):
            name = f"spindle, t{sensor + 1} {kind}{f' by {size:g} K' if size else ''} at {share:.0%}"
            yield Case(name, _HEAT | {"sensor_fault"}, f"sensor t{sensor + 1}", _fault(kind, sensor, share, size), keys)
    # A sixth of the record: a sound column of it repeats a value for at most some minutes.
    for place, sensor in ((4, "t5"), (16, "ch1"), (18, "ch3")):
        name = f"spindle, {sensor} repeats one value from 30% to 47%"
        yield Case(name, _HEAT, f"sensor {sensor}", _repeats(place, 0.3, 0.47), keys)
    for kind, name in (("glitches", "eleven failed homings of 4.3 mm"), ("clipped", "cut off above its 85 % quantile")):
        for place in (0, 3):
            yield Case(f"spindle, ch{place + 1}: {name}", _HEAT, f"sensor ch{place + 1}", _misread(kind, place), keys)
    for name in ("S001", "S002"):
        yield Case(f"cell {name}, unchanged", frozenset(), "", lambda name=name: _cell(name), _CELL_KEYS)
    slipped = frozenset({"step_event"})
    yield Case("cell S003, whose gauge slips by 44 µm/m", slipped, "step_event", lambda: _cell("S003"), _CELL_KEYS)
    for size in (5.0, 15.0):
        made = _added(_step(size, 0.4), lambda: _cell("S001"))
        yield Case(f"cell S001 + step of {size:g} µm/m at 40 %", slipped, "step_event", made, _CELL_KEYS)


@dataclass(frozen=True)
class Answer:
    """What a run said of a case."""

    verdict: str
    names: tuple[str, ...]
    unconfirmed: tuple[str, ...]
    unnamed: tuple[str, ...]
    sensors: tuple[str, ...]
    before_um: float
    after_um: float


def ask(case: Case) -> Answer:
    """Run a case as a user would, without drawing its report."""
    with tempfile.TemporaryDirectory() as base, mock.patch("fusion.report.page.render_report", return_value=""):
        folder = Path(base)
        case.table().to_csv(folder / "record.csv", index=False)
        text = f'[campaign]\ntitle = "{case.name}"\n\n[record]\nfile = "record.csv"\n{case.keys}'
        (folder / "campaign.toml").write_text(text, encoding="utf-8")
        loop = run_campaign(folder / "campaign.toml", folder / "out").loop
    assert isinstance(loop, RecordLoop)
    return Answer(
        loop.verdict,
        tuple(step.effect for step in loop.named),
        tuple(step.effect for step in loop.steps if step not in loop.named),
        tuple(loop.unconfirmed_effects),
        tuple(f"{one.sensor.split('(')[0]} {one.state.replace('_', ' ')}" for one in loop.sensor_faults),
        loop.rmse_declared_um,
        loop.rmse_final_um,
    )


def wrong_names(case: Case, answer: Answer) -> list[str]:
    """What was named, or left out as faulty, although it is not so."""
    wrong = {*answer.names, *answer.unconfirmed} - case.truth
    return sorted(wrong | (_left_out(answer) - {case.sought}))


def _left_out(answer: Answer) -> set[str]:
    """Columns that were left out, whole or the readings at fault."""
    names = (name.removesuffix(" left out") for name in answer.sensors if name.endswith(" left out"))
    return {f"sensor {name.removesuffix(' readings')}" for name in names}


def judged(case: Case, answer: Answer) -> str:
    """The page's judgement in a word or two."""
    wrong = wrong_names(case, answer)
    if wrong:
        return f"**wrong: {', '.join(wrong)}**"
    if not case.sought:
        return "right: no name"
    if case.sought in answer.names:
        return "found"
    if case.sought.startswith("sensor"):
        if case.sought in _left_out(answer):
            return "found"
        return "suspected" if f"{case.sought} suspected" in map("sensor {}".format, answer.sensors) else "missed"
    if case.sought in answer.unconfirmed:
        return "found, not confirmed"
    return "significant, without a name" if case.sought in answer.unnamed else "missed"


def row(case: Case, answer: Answer) -> str:
    """A row of the page's table."""
    said = [
        *answer.names,
        *(f"{name} (not confirmed)" for name in answer.unconfirmed),
        *map("sensor {}".format, answer.sensors),
    ]
    errors = f"{answer.before_um:.2f} → {answer.after_um:.2f}"
    return f"| {case.name} | {', '.join(said) or 'nothing'} | {answer.verdict} | {errors} | {judged(case, answer)} |"


HEADING = "| record | named | verdict | held-out error before → after / µm | judged |\n|---|---|---|---|---|"


@pytest.mark.real_data
@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in cases()])
def test_nothing_is_named_that_is_not_there(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    answer = ask(case)
    with capsys.disabled():
        print(f"\n{row(case, answer)}", flush=True)
    assert not wrong_names(case, answer)


if __name__ == "__main__":
    print(HEADING)
    for one in cases():
        print(row(one, ask(one)), flush=True)
