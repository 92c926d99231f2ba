"""Logs that lie: missing, ending early, columns exchanged, sensors that stand still."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd

from tests.soak.lies.folder import Plant, edit_column, edit_table, key
from tests.soak.lies.lie import Lie

ENVIRONMENT = r"environment"
DRIVERS = r"drivers|duty|load"
MATERIAL = r"material"


def first_half(table: pd.DataFrame) -> pd.DataFrame:
    return table.head(len(table) // 2)


def exchanged(table: pd.DataFrame) -> pd.DataFrame:
    air, material = "air_temperature_degC", "material_temperature_degC"
    return table.assign(**{air: table[material], material: table[air]})


def backwards(table: pd.DataFrame) -> pd.DataFrame:
    """The values in reverse order, with the times in order."""
    turned = table.iloc[::-1].reset_index(drop=True)
    return turned.assign(time=table["time"].to_numpy())


def of_another_hour(table: pd.DataFrame) -> pd.DataFrame:
    """The values that were logged three quarters of an hour later, those of the start at the end."""
    values = pd.DataFrame(np.roll(table.to_numpy(), -45, axis=0), columns=table.columns)
    return values.assign(time=table["time"].to_numpy())


def in_percent_from_the_middle(duty: np.ndarray) -> np.ndarray:
    return np.where(np.arange(duty.size) < duty.size // 2, 1.0, 100.0) * duty


def of_another_test(duty: np.ndarray) -> np.ndarray:
    """A load of the same kind, drawn anew."""
    rng = np.random.default_rng(5)
    changes = np.cumsum(rng.random(duty.size) < 1.0 / 25.0)
    return np.round(rng.random(changes[-1] + 1)[changes], 3)


def events(table: pd.DataFrame) -> pd.DataFrame:
    """A row where the load changes, and none between."""
    return table[table["duty [1]"].diff().fillna(1.0) != 0.0]


def starts(duty: np.ndarray) -> np.ndarray:
    """A mark in the minute in which the load grows."""
    return (np.diff(duty, prepend=0.0) > 0.0).astype(float)


def in_blocks(duty: np.ndarray) -> np.ndarray:
    """Means over 40 min."""
    block = np.arange(duty.size) // 40
    return np.round(np.bincount(block, duty) / np.bincount(block), 3)[block]


def load(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    return edit_column("drivers.csv", "duty [1]", change)


LIES = (
    Lie("environment log missing for the second half", ENVIRONMENT, edit_table("environment.csv", first_half)),
    Lie("environment log missing", ENVIRONMENT, key("interferometry", "environment", None)),
    Lie("columns of air and material exchanged", MATERIAL + "|air", edit_table("environment.csv", exchanged)),
    Lie("environment log backwards in time", ENVIRONMENT, edit_table("environment.csv", backwards)),
    Lie("environment log with the values of another hour", ENVIRONMENT, edit_table("environment.csv", of_another_hour)),
    Lie(
        "material sensor stands still",
        MATERIAL,
        edit_column("environment.csv", "material_temperature_degC", lambda c: np.full(c.size, c[0])),
    ),
    Lie(
        "material sensor in the coolant: 8 K too high",
        MATERIAL,
        edit_column("environment.csv", "material_temperature_degC", lambda c: c + 8.0),
    ),
    Lie("drivers log missing for the second half", DRIVERS, edit_table("drivers.csv", first_half)),
    Lie("drivers log with the load of another test", DRIVERS, edit_column("drivers.csv", "duty [1]", of_another_test)),
    Lie("drivers log stands still", DRIVERS, edit_column("drivers.csv", "duty [1]", lambda d: np.full(d.size, d[0]))),
    Lie("drivers log inverted (1 - load)", DRIVERS, edit_column("drivers.csv", "duty [1]", lambda d: 1.0 - d)),
    Lie(
        "drivers log in percent from the middle on",
        DRIVERS,
        edit_column("drivers.csv", "duty [1]", in_percent_from_the_middle),
    ),
    Lie("drivers log of events", DRIVERS, edit_table("drivers.csv", events)),
    Lie("drivers log of starts", DRIVERS, load(starts)),
    Lie("drivers log of an energy counter", DRIVERS, load(lambda d: np.cumsum(d).round(3))),
    Lie("drivers log in blocks of 40 min", DRIVERS, load(in_blocks)),
    Lie("drivers log clipped at a fifth", DRIVERS, load(lambda d: np.minimum(d, 0.2))),
    Lie("drivers log of a switch", DRIVERS, load(lambda d: (d > 0.5).astype(float))),
    Lie("drivers log backwards in time", DRIVERS, load(lambda d: d[::-1])),
    Lie("drivers log once an hour", DRIVERS, edit_table("drivers.csv", lambda table: table.iloc[::60])),
)
